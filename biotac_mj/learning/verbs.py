"""The verbs `biotac train`, `biotac evaluate` and `biotac contact-patch`: their arguments here, their work beside it."""

__all__ = ["add_verbs"]


def add_verbs(verbs, verb):
    """Adds the three to argparse's subparsers; verb(verbs, name, run, text) makes one."""
    _add_evaluate(verbs, verb)


def _add_evaluate(verbs, verb):
    v = verb(
        verbs,
        "evaluate",
        _evaluate,
        "Judge learned models: trained ones on a data set, or electrode code and force regression on a recording of a real sensor.",
    )
    v.add_argument("--electrodes", metavar="FILE", help="a recording: text, 19 columns of raw counts e1..e19; reconstruction is judged")
    v.add_argument("--force", metavar="FILE", help="beside it: text, 3 columns of force [N]; force from electrodes is judged too")
    v.add_argument("--fraction", type=float, default=0.7, help="of the recording's rows, in time, that train")
    v.add_argument("--seed", type=int, default=0, help="of the recording's networks")
    v.add_argument("--json", metavar="FILE", help="where the numbers go, a plot beside them (default: out/evaluate/...)")
    v.add_argument("--quiet", action="store_true", help="no progress bar")


def _evaluate(args):
    if args.electrodes:
        _evaluate_recording(args)
    else:
        raise ValueError("nothing to evaluate: give --electrodes FILE (and --force FILE)")


def _evaluate_recording(args):
    from .real import evaluate_recording

    result = evaluate_recording(
        args.electrodes, args.force, args.json or "out/evaluate/recording.json", args.fraction, args.seed, progress=not args.quiet
    )
    table = result["reconstruction"]
    print(f"reconstruction through a code of 8, counts ({result['train_rows']} rows train, {result['rows'] - result['train_rows']} unseen)")
    print(f"  {'':<28}{'train RMS':>10}{'test RMS':>10}{'median row':>12}")
    for name, row in table["models"].items():
        print(f"  {name:<28}{row['train']['rms']:>10.2f}{row['test']['rms']:>10.2f}{row['test']['median_row']:>12.2f}")
    print(f"  noise of the sensor, at most {table['noise_rms']:.2f}")
    if "force_regression" in result:
        print("force from electrodes, RMSE on the unseen rows, N")
        print(f"  {'':<28}{'Fx':>10}{'Fy':>10}{'Fz':>10}")
        for name, row in result["force_regression"]["models"].items():
            print(f"  {name:<28}" + "".join(f"{e:>10.3f}" for e in row["rmse"]))
    for note in result["notes"]:
        print(f"  note: {note}")
    print(f"written: {args.json or 'out/evaluate/recording.json'}, {result['plot']} ({result['seconds']} s)")
