"""What `biotac generate`, `biotac import-data` and `biotac export-data` do with their arguments."""

__all__ = ["generate_verb"]


def generate_verb(args) -> None:
    """`biotac generate`; raises ValueError or FileNotFoundError for what cannot be."""
    from .generate import GenerateOptions, generate

    options = GenerateOptions(
        count=args.count,
        labelled=min(359, args.count) if args.labelled is None else args.labelled,
        steps=args.steps,
        rate=args.rate,
        seed=args.seed,
        objects=tuple(args.objects),
        kinds=tuple(args.kinds),
        skin=args.skin,
        tier=args.tier,
        material=args.material,
        element=args.element,
        liquid=args.liquid,
        batch=args.batch,
        measured_seed=args.measured_seed,
        measured_skin=args.measured_skin,
        device=args.device,
    )
    report = generate(args.out, options, args.workers, not args.quiet)
    stages = ", ".join(f"{name} {value:g} s" for name, value in report.seconds.items() if name != "all")
    print(f"{report.interactions} interactions, {report.steps} time steps, {report.nonconverged} of them not converged")
    print(f"{report.made} shards made in {report.seconds['all']:g} s ({stages}) on {report.device}")
    print(f"{report.bytes / 1e6:.1f} MB in {args.out}")
