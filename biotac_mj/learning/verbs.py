"""Arguments of the verbs `biotac learn train`, `judge` and `predict`."""

import argparse
import os
import pathlib
from collections.abc import Callable

from ..arguments import SEED, add_ray, device, output_file, output_folder, real, whole
from ..fields import refuse_unknown
from ..files import check_output, check_output_file, quoted
from ..reading import read_json
from ..recordings.verbs import add_load_arguments, add_which


def add_verbs(verbs: argparse._SubParsersAction, verb: Callable[..., argparse.ArgumentParser]) -> None:
    """Adds them to argparse's subparsers; verb(verbs, name, run, text) makes one."""
    _add_train(verbs, verb)
    _add_judge(verbs, verb)
    _add_predict(verbs, verb)


def _add_train(verbs, verb):
    v = verb(
        verbs,
        "train",
        _train,
        "Train on SOURCE. Into one FILE.safetensors: of a recording with force, or of a set, a model that "
        "reads force and place from electrodes. Into a folder: all networks on a labelled set, continued if "
        "it was interrupted; attach(signal=FILE) takes their weights from there.",
    )
    v.add_argument("source", metavar="SOURCE", help="a recording, or a set")
    v.add_argument(
        "--force", metavar="FILE", help="force of a recording: text, 3 columns of force [N] row by row"
    )
    add_which(v)
    text = "FILE.safetensors, or a folder of predictions, errors and weights"
    v.add_argument("--out", type=_model_or_folder, default="out/train", metavar="FILE|DIR", help=text)
    v.add_argument(
        "--fraction", type=real(0.2, 0.95), default=0.7, help="fraction of a recording, in time, for training"
    )
    v.add_argument("--seed", type=SEED, default=0, help="seed of one model's random numbers")
    text = "seeds of divisions, weights and batches (default: 0 to 4, on a CPU 0)"
    v.add_argument("--seeds", type=SEED, nargs="+", help=text)
    text = (
        "trajectory (72/18/10 %% of interactions), or the object held out for the test, several "
        "with + (default: trajectory ring_7mm, on a CPU trajectory)"
    )
    v.add_argument("--splits", nargs="+", metavar="NAME", help=text)
    text = "latent projection and PointNet++, hours without a GPU (default: on a GPU)"
    v.add_argument("--paper", action=argparse.BooleanOptionalAction, help=text)
    v.add_argument(
        "--config", metavar="FILE", help="JSON with settings of LearningConfig (docs/lab/learning.md)"
    )
    v.add_argument(
        "--steps", type=whole(1, 10_000_000), help="steps of each training (default: the config's)"
    )
    v.add_argument("--device", type=device, default="cpu", help="device of torch: cpu, cuda")
    add_ray(v)
    v.add_argument("--quiet", action="store_true", help="no progress bar")


_ON_CPU = {"seeds": [0], "splits": ["trajectory"], "paper": False}  # minutes of training
_ON_GPU = {"seeds": [0, 1, 2, 3, 4], "splits": ["trajectory", "ring_7mm"], "paper": True}


def _table_or_folder(text):
    table = text.endswith((".csv", ".h5"))
    return (output_file() if table else output_folder("contact.png", "contact.json"))(text)


def _model_or_folder(text):
    return (output_file() if text.endswith(".safetensors") else output_folder())(text)


def _train(args):
    if args.out.endswith(".safetensors"):
        return _train_one(args)
    if args.force or args.which:
        raise ValueError(
            f"--force and --recording go with one model: give --out FILE.safetensors, not {args.out}"
        )
    if os.path.isfile(args.source) and not args.source.endswith(".h5"):
        raise ValueError(
            f"{args.source} is no set: a folder of networks is trained on one; of a recording with force one "
            "model is trained, give --out FILE.safetensors"
        )
    _train_all(args)


def _train_one(args):
    """Trains one model and writes it to one file."""
    source = pathlib.Path(args.source)
    if any(source.glob("shard-*.h5")):
        from .instants.examples import from_set
        from .instants.reader import judge

        return _save_reader(args, *judge(from_set(source), args.seed))
    if any(source.glob("*-*.npz")):
        raise ValueError(
            f"{source} holds trained networks: attach(signal=FILE) takes its *.safetensors as they are"
        )
    from ..recordings import load_one
    from .instants.examples import from_recording
    from .instants.reader import judge_in_time

    recording, notes = load_one(args.source, args.which, force=args.force)
    for note in notes:
        print(f"  note: {note}")
    _save_reader(args, *judge_in_time(from_recording(recording), args.fraction, args.seed))


def _train_all(args):
    import dataclasses

    from .training.config import LearningConfig
    from .training.experiment import train_all

    cpu = args.device == "cpu"
    if args.ray is None:  # a cluster has its own devices
        _check_device(args.device)
    for name, value in (_ON_CPU if cpu else _ON_GPU).items():
        if getattr(args, name) is None:
            setattr(args, name, value)
    settings = (
        read_json(args.config, "config", "give a file of JSON (docs/lab/learning.md)") if args.config else {}
    )
    refuse_unknown(settings, [f.name for f in dataclasses.fields(LearningConfig)], args.config)
    if cpu:
        settings = {"members": 1} | settings
    if args.steps:
        settings |= {"steps": args.steps, "paper_steps": 4 * args.steps, "mesh_steps": 4 * args.steps}
    on = args.source, args.out, args.seeds, args.splits
    how = dict(progress=not args.quiet, ray=args.ray)
    train_all(*on, LearningConfig(**settings), args.device, args.paper, **how)
    print(f"written: {args.out}; judge it with `biotac learn judge {quoted(args.out)}`")


def _check_device(name):
    import torch

    if name != "cpu" and not (
        torch.cuda.is_available() and torch.device(name).index in (None, *range(torch.cuda.device_count()))
    ):
        raise ValueError(
            f"--device {name} is not here: torch finds {torch.cuda.device_count()} GPUs; take cpu"
        )


def _add_judge(verbs, verb):
    v = verb(
        verbs,
        "judge",
        _judge,
        "Evaluate models, with the mean or no change as baselines: networks on held-out data; or, on a "
        "recording of a real sensor, codes of its electrodes and regressions of its force.",
    )
    text = (
        "a folder that `biotac learn train` wrote, or a recording: reconstruction is judged, force too "
        "if it has one; with --model, a recording with force or a set"
    )
    v.add_argument("source", nargs="?", metavar="SOURCE", help=text)
    v.add_argument(
        "--model", metavar="FILE.safetensors", help="of `biotac learn train`, to be judged on SOURCE"
    )
    _add_tare(v)
    v.add_argument(
        "--force", metavar="FILE", help="force of a recording: text, 3 columns of force [N] row by row"
    )
    add_which(v)
    text = (
        "labelled set of another sensor: error of the film and of --weights, after a mixing of their "
        "electrodes was fitted to 0, 5, 20 of its touches"
    )
    v.add_argument("--new-sensor", metavar="SET", help=text)
    v.add_argument(
        "--weights", metavar="FILE", help="forward model for --new-sensor (default: latent_projection)"
    )
    text = "with --new-sensor, file for the adapted sensor, which attach(effects=FILE) takes"
    v.add_argument("--sensor", type=output_file(), metavar="FILE.yaml", help=text)
    v.add_argument(
        "--fraction", type=real(), default=0.7, help="fraction of the recording, in time, for training"
    )
    v.add_argument("--seed", type=SEED, default=0, help="seed of the recording's networks")
    text = "file of the results, with a plot (default: out/judge/..., or in the folder)"
    v.add_argument("--json", type=output_file(), metavar="FILE", help=text)
    v.add_argument("--quiet", action="store_true", help="no progress bar")


def _judge(args):
    if bool(args.new_sensor) == bool(args.source):
        raise ValueError(
            "give one of a folder that `biotac learn train` wrote, a recording (and --force FILE), and "
            "--new-sensor"
        )
    bag = args.source and os.path.isfile(os.path.join(args.source, "metadata.yaml"))  # of ROS 2
    recorded = bool(args.source) and (bag or not os.path.isdir(args.source))
    if args.tare and not args.model:
        raise ValueError("--tare goes with --model: give both, or neither")
    for name, given in (("force", args.force), ("recording", args.which)):
        if given and not recorded:
            raise ValueError(f"--{name} goes with a recording: give both, or neither")
    for name in ("weights", "sensor"):
        if getattr(args, name) and not args.new_sensor:
            raise ValueError(f"--{name} goes with --new-sensor: give both, or neither")
    if args.json is None:
        name = "model" if args.model else "recording" if recorded else "new_sensor"
        folder = args.source and not recorded and not args.model
        args.json = f"{args.source}/evaluation.json" if folder else f"out/judge/{name}.json"
        check_output_file(args.json)
    if args.model:
        _judge_model(args, recorded)
    elif recorded:
        _judge_recording(args)
    elif args.source:
        from .report import evaluate_models, table

        print(table(evaluate_models(args.source, args.json)))
    else:
        _judge_new_sensor(args)


def _judge_new_sensor(args):
    from .training.few_shot import evaluate_new_sensor
    from .weights import shipped

    weights = args.weights or shipped("latent_projection")
    one = evaluate_new_sensor(args.new_sensor, weights, args.json, sensor=args.sensor)
    table = one["median_rms_counts"]
    counts = list(table["no change"])
    print("median RMS of a touch in counts, after so many touches")
    print(f"  {'':<30}" + "".join(f"{k:>8}" for k in counts))
    for name, found in table.items():
        print(f"  {name:<30}" + "".join(f"{found[k]:8.1f}" if k in found else f"{'':8}" for k in counts))
    if args.sensor:
        print(
            f"written: {args.sensor}, the film with {one['adapted']}: of no change, gains and mixing the "
            "simplest that, fitted to the weaker half of the touches, is not significantly worse on the "
            f"stronger, up to {one['largest_force']:.2g} N; use it with attach(effects={args.sensor!r})"
        )


def _judge_model(args, recorded):
    from ..files import write_json
    from .instants.examples import from_recording, from_set
    from .instants.reader import Reader, judge_on

    reader = Reader.load(args.model)
    if recorded:
        from ..recordings import load_one

        recording, notes = load_one(args.source, args.which, force=args.force)
        data = from_recording(recording, args.tare)
    else:
        data, notes = from_set(args.source), []
    scores = judge_on(reader, data)
    if scores["known"] >= 0.005:
        notes = [*notes, f"the model learned from {scores['known']:.0%} of these rows: they are no test"]
    _say_errors(scores)
    useless = [name for row in scores["targets"].values() for name in row["useless"]]
    for note in [*notes, *([f"{', '.join(useless)}: no better than the mean here"] if useless else [])]:
        print(f"  note: {note}")
    write_json(args.json, scores)
    print(f"written: {args.json}")


def _save_reader(args, reader, scores):
    from .instants.reader import TARGETS

    reader.save(args.out)
    tested = f", {scores['test']} more give the errors" if "test" in scores else " and give the errors"
    print(
        f"model that reads electrodes, {scores['train']} trajectories train, {scores['aside']} held out "
        f"calibrate the intervals{tested}"
    )
    _say_errors(scores)
    _note_useless(reader.meta)
    useless = reader.meta["useless"]
    good = ", ".join(n for target in scores["targets"] for n in TARGETS[target] if n not in useless)
    use = f"; use {good if useless else 'it'} with `biotac learn predict {quoted(args.out)} RECORDING`"
    print(f"written: {args.out}{use if good else ''}")


def _say_errors(scores):
    for name, row in scores["targets"].items():
        unseen = "" if scores.get("known") else "unseen "
        covered = "" if row["covered"] is None else f", {100 * row['covered']:.0f} % of {unseen}rows inside"
        error = ""
        if row["rmse"] is not None:
            mean = f"the mean {row['rmse_of_mean']:.4g}"
            error = f"RMSE of a component {row['rmse']:.4g} {row['unit']} ({mean}), "
        print(f"  {name:<12}{error}intervals +- {row['half']:.3g} {row['unit']}{covered}")


def _note_useless(meta):
    if useless := meta.get("useless"):
        print(f"  note: {', '.join(useless)}: no better than the mean: do not use these, record more touches")


def _add_tare(v):
    text = "number of first rows whose mean is the sensor at rest, for models of changes"
    v.add_argument("--tare", type=whole(1, 10_000_000), metavar="ROWS", help=text)


def _add_predict(verbs, verb):
    v = verb(
        verbs,
        "predict",
        _predict,
        "Predict from a recording: force, contact position and electrodes with intervals and novelty; "
        "or, with inverse weights, deformation and contact of the skin.",
    )
    text = (
        "what `biotac learn train --out FILE.safetensors` wrote; or inverse weights: of those that come "
        "with the package and saw synthetic data alone, inverse (with force) or latent_projection"
    )
    v.add_argument("model", metavar="MODEL", help=text)
    v.add_argument("source", metavar="FILE", help="a recording")
    add_which(v)
    add_load_arguments(v)
    _add_tare(v)
    text = (
        "with inverse weights, number of the row to draw, -1 the last (default: the largest force's; "
        "where none was recorded, the one that differs most from rest)"
    )
    v.add_argument("--row", type=int, help=text)
    v.add_argument("--skin", default="default", help="mesh of inverse weights; of latent_projection any")
    text = (
        "table .csv or .h5 (default: out/predict.csv); of inverse weights the folder of contact.png and "
        "contact.json (default: out/contact)"
    )
    v.add_argument("--out", type=_table_or_folder, metavar="FILE|DIR", help=text)


def _predict(args):
    from .weights import is_inverse

    if is_inverse(args.model):
        return _predict_patch(args)
    if args.row is not None:
        raise ValueError("--row goes with inverse weights, which draw one: leave it out")
    _predict_instants(args)


def _predict_instants(args):
    import numpy as np

    from .instants.predict import SUFFIXES, predict, write_prediction

    args.out = args.out or "out/predict.csv"
    if not args.out.endswith(SUFFIXES):
        raise ValueError(f"--out {args.out} ends in none of {', '.join(SUFFIXES)}: give such a name")
    load = dict(rate=args.rate, scale=args.scale, object_name=args.object)
    time, found, meta = predict(args.model, args.source, args.which, args.tare, **load)
    write_prediction(args.out, time, found, meta)
    strange = found.novelty
    print(
        f"{len(strange)} rows: {', '.join(found.value)}, intervals of {100 * meta['level']:.0f} %; novelty "
        f"{np.median(strange):.2f} in the median, {100 * (strange > 1).mean():.0f} % of rows above 1 "
        "(usual: 5)"
    )
    for note in meta.get("notes", ()):
        print(f"  note: {note}")
    _note_useless(meta)
    if np.median(strange) > 1:
        print("  note: most rows are unlike those that the model was trained on: do not trust it here")
    print(f"written: {args.out}")


def _predict_patch(args):
    from .patch import contact_patch

    args.out = args.out or "out/contact"
    check_output(args.out, "contact.png", "contact.json")
    one = contact_patch(args.source, args.out, args.tare or 1, args.row, args.skin, args.model)
    x, y, z = one["centre_mm"]
    print(
        f"row {one['row']}: patch centre {x:.2f} {y:.2f} {z:.2f} mm, {one['area_mm2']:.1f} mm2"
        + ("" if one["force"] is None else f", force about {one['force']:.2f} N")
        + ("" if one["recorded"] is None else f" (recorded: {one['recorded']:.2f} N)")
    )
    for note in one["notes"]:
        print(f"  note: {note}")
    print(f"deepest {one['deepest_mm']:.2f} mm; written: {args.out}/contact.png, contact.json (all rows)")


def _judge_recording(args):
    from ..recordings import load_one
    from .instants.real import evaluate_recording

    recording, notes = load_one(args.source, args.which, force=args.force)
    result = evaluate_recording(recording, args.json, args.fraction, args.seed, progress=not args.quiet)
    table = result["reconstruction"]
    print(
        f"reconstruction through a code of 8, counts ({result['train_rows']} rows train, "
        f"{result['rows'] - result['train_rows']} unseen)"
    )
    print(f"  {'':<28}{'train RMS':>10}{'test RMS':>10}{'median row':>12}")
    for name, row in table["models"].items():
        print(
            f"  {name:<28}{row['train']['rms']:>10.2f}{row['test']['rms']:>10.2f}"
            f"{row['test']['median_row']:>12.2f}"
        )
    print(f"  noise of the sensor, at most {table['noise_rms']:.2f}")
    if "force_regression" in result:
        print("force from electrodes, RMSE on the unseen rows, N")
        print(f"  {'':<28}{'Fx':>10}{'Fy':>10}{'Fz':>10}")
        for name, row in result["force_regression"]["models"].items():
            print(f"  {name:<28}" + "".join(f"{'-' if e is None else f'{e:.3f}':>10}" for e in row["rmse"]))
    for note in [*notes, *result["notes"]]:
        print(f"  note: {note}")
    print(f"written: {args.json}, {result['plot']} ({result['seconds']} s)")
