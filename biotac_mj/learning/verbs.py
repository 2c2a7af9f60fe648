"""The verbs `biotac train`, `evaluate`, `predict` and `contact-patch`: their arguments here, their work
beside it."""

import argparse
import os
import pathlib
from collections.abc import Callable

from ..arguments import SEED, add_ray, device, output_file, output_folder, real, whole
from ..fields import refuse_unknown
from ..files import check_output_file
from ..reading import read_json
from ..recordings.verbs import add_load_arguments, add_which

__all__ = ["add_verbs"]


def add_verbs(verbs: argparse._SubParsersAction, verb: Callable[..., argparse.ArgumentParser]) -> None:
    """Adds them to argparse's subparsers; verb(verbs, name, run, text) makes one."""
    _add_train(verbs, verb)
    _add_evaluate(verbs, verb)
    _add_predict(verbs, verb)
    _add_contact_patch(verbs, verb)


def _add_train(verbs, verb):
    v = verb(
        verbs, "train", _train, "Train and test all models on a data set; goes on where it was interrupted."
    )
    v.add_argument(
        "set", metavar="SET", help="data set with labelled interactions, made by `biotac generate`"
    )
    v.add_argument(
        "--out",
        type=output_folder(),
        default="out/train",
        metavar="DIR",
        help="folder of predictions, errors and weights",
    )
    v.add_argument(
        "--seeds",
        type=SEED,
        nargs="+",
        help="of divisions, weights and batches (default: 0 to 4, on a CPU 0)",
    )
    v.add_argument(
        "--splits",
        nargs="+",
        metavar="NAME",
        help="trajectory (72/18/10 %% of interactions), or the object that training never sees, several "
        "with + (default: trajectory ring_7mm, on a CPU trajectory)",
    )
    v.add_argument(
        "--only",
        nargs="+",
        metavar="NAME",
        help="of our models (default: all, on a CPU pod_taught local_taught)",
    )
    v.add_argument(
        "--paper",
        action=argparse.BooleanOptionalAction,
        help="latent projection and PointNet++, hours without a GPU (default: on a GPU)",
    )
    v.add_argument(
        "--config", metavar="FILE", help="JSON with settings of LearningConfig (docs/lab/learning.md)"
    )
    v.add_argument("--steps", type=whole(1, 10_000_000), help="of each training (default: the config's)")
    v.add_argument("--limit", type=whole(1, 10_000_000), help="interactions to read, the first ones")
    v.add_argument("--device", type=device, default="cpu", help="of torch: cpu, cuda")
    add_ray(v)
    v.add_argument("--quiet", action="store_true", help="no progress bar")


# what a CPU trains in minutes, where nothing else is said: the best head, and one without film features
_ON_CPU = {"seeds": [0], "splits": ["trajectory"], "only": ["pod_taught", "local_taught"], "paper": False}
_ON_GPU = {"seeds": [0, 1, 2, 3, 4], "splits": ["trajectory", "ring_7mm"], "only": None, "paper": True}


def _train(args):
    import dataclasses

    from .training.config import LearningConfig, without_gone
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
    settings = without_gone(settings)
    refuse_unknown(settings, [f.name for f in dataclasses.fields(LearningConfig)], args.config)
    if cpu:
        settings = {"members": 1} | settings
    if args.steps:
        settings |= {"steps": args.steps, "paper_steps": 4 * args.steps, "mesh_steps": 4 * args.steps}
    train_all(
        args.set,
        args.out,
        args.seeds,
        args.splits,
        LearningConfig(**settings),
        args.device,
        args.paper,
        args.only,
        args.limit,
        progress=not args.quiet,
        ray=args.ray,
    )
    print(f"written: {args.out}; judge it with `biotac evaluate {args.out}`")


def _check_device(name):
    import torch

    if name != "cpu" and not (
        torch.cuda.is_available() and torch.device(name).index in (None, *range(torch.cuda.device_count()))
    ):
        raise ValueError(
            f"--device {name} is not here: torch finds {torch.cuda.device_count()} GPUs; take cpu"
        )


def _add_evaluate(verbs, verb):
    v = verb(
        verbs,
        "evaluate",
        _evaluate,
        "Judge learned models: trained ones on a data set, "
        "or electrode code and force regression on a recording of a real sensor.",
    )
    v.add_argument(
        "folder",
        nargs="?",
        metavar="DIR",
        help="what `biotac train` wrote; or a recording, as --electrodes; or, with --save, a data set",
    )
    v.add_argument(
        "--electrodes",
        metavar="FILE",
        help="a recording of any kind that `biotac import` reads; reconstruction is judged, force too if "
        "it has one",
    )
    v.add_argument("--force", metavar="FILE", help="beside it: text, 3 columns of force [N] row by row")
    add_which(v)
    v.add_argument(
        "--known",
        metavar="FILE",
        help="with --electrodes: another sensor's recording with force; judges what it teaches with few "
        "touches of this one",
    )
    v.add_argument(
        "--touches", type=whole(5, 10_000), help="labelled ones that go with --known (default: 20)"
    )
    v.add_argument(
        "--new-sensor",
        metavar="SET",
        help="labelled set of another sensor: error after 0, 1, 5, 20 of its touches, with --weights",
    )
    v.add_argument(
        "--weights", metavar="FILE", help="forward model for --new-sensor (default: the package's)"
    )
    v.add_argument(
        "--ship",
        type=output_folder(),
        metavar="FOLDER",
        help="copy the trained weights there, each with a card",
    )
    v.add_argument(
        "--save",
        type=output_file(),
        metavar="FILE.safetensors",
        help="keep a model for `biotac predict`: of a recording or a set one that reads electrodes, of what "
        "`biotac train` wrote one that predicts them, for attach(signal=FILE)",
    )
    v.add_argument(
        "--fraction", type=real(), default=0.7, help="of the recording's rows, in time, that train"
    )
    v.add_argument("--seed", type=SEED, default=0, help="of the recording's networks")
    v.add_argument(
        "--json",
        type=output_file(),
        metavar="FILE",
        help="where the numbers go, a plot beside them (default: out/evaluate/...)",
    )
    v.add_argument("--quiet", action="store_true", help="no progress bar")


def _evaluate(args):
    if sum(map(bool, (args.electrodes, args.new_sensor, args.folder))) > 1:
        raise ValueError("DIR, --electrodes and --new-sensor are judged one at a time: leave the others out")
    bag = args.folder and os.path.isfile(os.path.join(args.folder, "metadata.yaml"))  # of ROS 2
    if args.folder and (bag or os.path.isfile(args.folder)) and not args.electrodes:
        args.folder, args.electrodes = None, args.folder
    for name, given in (("force", args.force), ("recording", args.which), ("known", args.known)):
        if given and not args.electrodes:
            raise ValueError(f"--{name} goes with --electrodes: give both, or neither")
    if args.touches is not None and not args.known:
        raise ValueError("--touches goes with --known: give both, or neither")
    if args.weights and not args.new_sensor:
        raise ValueError("--weights goes with --new-sensor: give both, or neither")
    if args.save and (args.new_sensor or not args.save.endswith(".safetensors")):
        raise ValueError(
            f"--save {args.save}: give FILE.safetensors, and a recording, a set or a folder of `biotac train`"
        )
    if args.folder and args.save and any(pathlib.Path(args.folder).glob("shard-*.h5")):
        return _evaluate_set(args)
    if args.ship and not args.folder:
        raise ValueError("--ship copies what `biotac train` wrote: give its DIR, or leave it out")
    if args.json is None:
        name = "recording" if args.electrodes else "new_sensor"
        args.json = f"{args.folder}/evaluation.json" if args.folder else f"out/evaluate/{name}.json"
        check_output_file(args.json)
    if args.electrodes:
        _evaluate_recording(args)
    elif args.new_sensor:
        from .training.few_shot import evaluate_new_sensor
        from .weights import shipped

        one = evaluate_new_sensor(args.new_sensor, args.weights or shipped("forward"), args.json)
        same = one["as_it_is_on_the_same_touches"]
        for name, value in one["median_rms_counts_after_touches"].items():
            text = "predict the tare" if name == "tare" else f"{name} touches"
            beside = f" (without adaptation {same[name]:.2f})" if name in same and name != "0" else ""
            print(f"  {text:<20}{value:>8.2f} counts, median RMS per interaction{beside}")
    elif args.folder:
        _evaluate_models(args)
    else:
        raise ValueError(
            "nothing to evaluate: give a folder that `biotac train` wrote, "
            "or --electrodes FILE (and --force FILE)"
        )


def _evaluate_models(args):
    from .report import evaluate_models, table
    from .shipping import check_shippable, ship

    if args.ship:
        check_shippable(args.folder)
    result = evaluate_models(args.folder, args.json)
    print(table(result))
    if args.ship:
        print("written: " + ", ".join(map(str, ship(args.folder, result, args.ship))))

    if args.save:
        from .instants.predict import save_forward_model

        save_forward_model(args.folder, args.save)
        print(f"written: {args.save}")


def _evaluate_set(args):
    from .instants.examples import from_set
    from .instants.reader import judge

    _save_reader(args, *judge(from_set(args.folder), args.seed))


def _save_reader(args, reader, scores):
    reader.save(args.save)
    print(f"model that reads electrodes, {scores['train']} trajectories train, {scores['aside']} kept aside")
    useless = []
    for name, row in scores["targets"].items():
        covered = "" if row["covered"] is None else f", {100 * row['covered']:.0f} % of unseen rows inside"
        error = ""
        if row["rmse"] is not None:
            error = f"RMSE {row['rmse']:.4g} {row['unit']} (the mean {row['rmse_of_mean']:.4g}), "
            useless += [name] * (row["rmse"] >= row["rmse_of_mean"])
        print(f"  {name:<12}{error}intervals +- {row['half']:.3g} {row['unit']}{covered}")
    if useless:
        print(f"  note: {', '.join(useless)}: no better than the mean: do not use it, record more touches")
    print(f"written: {args.save}; use it with `biotac predict {args.save} RECORDING`")


def _add_predict(verbs, verb):
    v = verb(
        verbs,
        "predict",
        _predict,
        "Force, contact place and electrodes of a recording by a kept model, with intervals and novelty.",
    )
    v.add_argument("model", metavar="MODEL", help="what `biotac evaluate --save` wrote")
    v.add_argument(
        "source", metavar="FILE", help="a recording; of a model that predicts electrodes, a set with its skin"
    )
    add_which(v)
    add_load_arguments(v)
    v.add_argument(
        "--tare",
        type=whole(1, 10_000_000),
        metavar="ROWS",
        help="first rows, whose mean is the sensor at rest, for a model that reads changes",
    )
    v.add_argument(
        "--out", type=output_file(), default="out/predict.csv", metavar="FILE", help="table .csv, or .h5"
    )


def _predict(args):
    import numpy as np

    from .instants.predict import SUFFIXES, predict, write_prediction

    if not args.out.endswith(SUFFIXES):
        raise ValueError(f"--out {args.out} ends in none of {', '.join(SUFFIXES)}: give such a name")
    load = dict(rate=args.rate, scale=args.scale, object_name=args.object)
    where, found, meta = predict(args.model, args.source, args.which, args.tare, **load)
    write_prediction(args.out, where, found, meta)
    strange = found.novelty
    print(
        f"{len(strange)} rows: {', '.join(found.value)}, intervals of {100 * meta['level']:.0f} %; novelty "
        f"{np.median(strange):.2f} in the median, {100 * (strange > 1).mean():.0f} % of rows above 1 "
        "(usual: 5)"
    )
    for note in meta.get("notes", ()):
        print(f"  note: {note}")
    if np.median(strange) > 1:
        print("  note: most rows are unlike those that the model was trained on: do not trust it here")
    print(f"written: {args.out}")


def _add_contact_patch(verbs, verb):
    v = verb(
        verbs,
        "contact-patch",
        _contact_patch,
        "Estimate how the skin is deformed and where it is touched, from electrode counts.",
    )
    v.add_argument(
        "source",
        metavar="FILE",
        help="a recording of any kind that `biotac import` reads, or readings.csv of `biotac press`",
    )
    v.add_argument("--tare", type=int, default=1, help="first rows whose mean is the sensor at rest")
    v.add_argument(
        "--row",
        type=int,
        help="which row to draw, -1 the last (default: the one with the largest force; where none was "
        "recorded, the one that differs most from rest)",
    )
    v.add_argument("--skin", default="default", help="mesh that the weights were trained on")
    v.add_argument(
        "--weights",
        metavar="FILE",
        help="inverse weights (default: those that come with the package, trained on synthetic data)",
    )
    v.add_argument(
        "--out",
        type=output_folder("contact.png", "contact.json"),
        default="out/contact",
        metavar="DIR",
        help="folder of contact.png and contact.json",
    )


def _contact_patch(args):
    from .patch import contact_patch

    one = contact_patch(args.source, args.out, args.tare, args.row, args.skin, args.weights)
    x, y, z = one["centre_mm"]
    print(
        f"row {one['row']}: patch centre {x:.2f} {y:.2f} {z:.2f} mm, {one['area_mm2']:.1f} mm2, "
        f"force about {one['force']:.2f} N"
        + ("" if one["recorded"] is None else f" (recorded: {one['recorded']:.2f} N)")
    )
    for note in one["notes"]:
        print(f"  note: {note}")
    print(f"deepest {one['deepest_mm']:.2f} mm; written: {args.out}/contact.png, contact.json (all rows)")


def _evaluate_recording(args):
    from ..recordings import load_one
    from .instants.real import evaluate_recording

    recording, notes = load_one(args.electrodes, args.which, force=args.force)
    examples = None
    if args.save:
        from .instants.examples import from_recording

        examples = from_recording(recording)  # refuses before the work what cannot be kept after it
    result = evaluate_recording(
        recording,
        args.json,
        args.fraction,
        args.seed,
        progress=not args.quiet,
        known=load_one(args.known)[0] if args.known else None,
        touches=args.touches or 20,
    )
    table = result["reconstruction"]
    print(
        f"reconstruction through a code of 8, counts ({result['train_rows']} rows train, "
        f"{result['rows'] - result['train_rows']} unseen)"
    )
    print(f"  {'':<28}{'train RMS':>10}{'test RMS':>10}{'median row':>12}")
    for name, row in table["models"].items():
        print(
            "  "
            f"{name:<28}{row['train']['rms']:>10.2f}{row['test']['rms']:>10.2f}{row['test']['median_row']:>12.2f}"
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
    if examples:
        from .instants.reader import judge_in_time

        _save_reader(args, *judge_in_time(examples, args.fraction, args.seed))
