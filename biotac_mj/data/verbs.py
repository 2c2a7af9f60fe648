"""Runs `biotac data generate`, `biotac data import` and `biotac data export`."""

import argparse
import dataclasses


def generate_verb(args: argparse.Namespace) -> None:
    """`biotac data generate`; raises ValueError or FileNotFoundError for invalid input."""
    from ..effects.amended import amend_settings
    from .generation.generate import GenerateOptions, generate

    settings = {field.name: getattr(args, field.name) for field in dataclasses.fields(GenerateOptions)}
    settings |= {"randomise": tuple(args.randomise or ())}
    if args.labelled is None:
        settings["labelled"] = min(359, args.count)
    if args.effects:
        settings = amend_settings(settings, GenerateOptions, args.effects)
    options = GenerateOptions(**settings)
    report = generate(args.out, options, args.workers, not args.quiet, args.ray)
    stages = ", ".join(f"{name} {value:g} s" for name, value in report.seconds.items() if name != "all")
    print(
        f"{report.interactions} interactions, {report.steps} time steps, "
        f"{report.nonconverged} of them not converged"
    )
    print(
        f"{report.made} shards made in {report.seconds['all']:g} s ({stages}) on {report.devices} x "
        f"{report.device}"
    )
    print(f"{report.bytes / 1e6:.1f} MB in {args.out}")


def import_verb(args: argparse.Namespace) -> None:
    """`biotac data import`; raises ValueError or FileNotFoundError for invalid input."""
    from .importers import import_recordings
    from .store import TactileSet

    count = import_recordings(
        args.files,
        args.out,
        args.seed,
        args.block,
        report=lambda line: print(f"warning: {line}"),
        force=args.force,
        rate=args.rate,
        scale=args.scale,
        object_name=args.object,
        objects=args.objects,
    )
    with TactileSet(args.out) as data:
        objects = ", ".join(sorted(set(data.object.tolist())))
        print(f"{count} interactions, {data.nstep} time steps, objects {objects}; in {args.out}")


def export_verb(args: argparse.Namespace) -> None:
    """`biotac data export`; raises ValueError or FileNotFoundError for invalid input."""
    from .store import TactileSet

    if args.form == "mujoco" and args.rate is not None:
        raise ValueError("--rate is of --form lerobot: states of MuJoCo have their own times, leave it out")
    with TactileSet(args.set) as data:
        counts = "measured_counts" if args.measured or (data.kind == "recorded").all() else "counts"
        if args.form == "mujoco":
            from .trajectories import export_mujoco

            out = export_mujoco(data, args.out, counts, not args.quiet)
            print(f"wrote {out}: models, and states and sensor data of MuJoCo")
        else:
            from .lerobot import VERSION, export_lerobot

            try:
                out = export_lerobot(data, args.out, counts, not args.quiet, args.rate)
            except ImportError as error:
                raise ValueError(str(error)) from error
            print(f"wrote {out} in the layout of LeRobotDataset {VERSION}")
        if "converged" in data.columns:
            chosen = data.labelled if counts == "measured_counts" else slice(None)
            good = data["converged"][data.steps(chosen)]
            if not good.all():
                print(
                    f"note: {(~good).sum()} of {len(good)} time steps of the set did not converge and are "
                    "exported, too: `converged` is false there, leave them out of training"
                )
