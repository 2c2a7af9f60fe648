"""What `biotac estimate` does with its arguments."""

import argparse
import csv
import dataclasses
import json
import pathlib

import numpy as np
from tqdm import tqdm

from ..files import replacing
from ..geometry import load_skin
from ..recordings import Recording, load_one
from ..sensor.presets import read_sensor
from ..skin.settings import read_dict, read_settings
from .estimate import Estimate, Estimator

__all__ = ["estimate_verb"]

_AXES = {"centre": "xyz", "centre_error": "xyz", "force": "xyz", "force_error": "xyz", "pos": "xyz"} | {
    "quat": "wxyz"
}


def estimate_verb(args: argparse.Namespace) -> None:
    """`biotac estimate`; raises ValueError or FileNotFoundError for what cannot be."""
    recording, notes = load_one(
        args.file, args.recording, rate=args.rate, scale=args.scale, object_name=args.object
    )
    counts, assumed = recording.counts()
    for note in (*notes, *assumed):
        print(f"note: {note}")
    rest, rows = _rest(args, counts), _rows(args, recording, counts)
    settings = read_settings(args.material, read_dict(args.options, "options"))
    if settings.modulus is not None:
        raise ValueError("an estimate knows no modulus by element: leave it out of --options")
    estimator = Estimator(load_skin(args.skin), args.indenter, settings.material, settings.options)
    found = [
        estimator(counts[row], rest)
        for row in tqdm(rows, desc="estimate", unit="row", disable=args.quiet, leave=False)
    ]
    for row, one in zip(rows, found):
        centre, error = 1e3 * one.centre, 1e3 * one.centre_error
        print(
            f"row {row}: centre {_pairs(centre, error)} mm, force {one.size:.3f} +- {one.size_error:.3f} N, "
            f"{100 * one.missed:.0f} % of the change unexplained"
            + ("" if one.settled else "; NOT settled")
            + (f"; {one.lost} steps lost" if one.lost else "")
        )
    _write(args.out, recording, rows, found)
    print(f"written: {args.out}; +- are 95 % for a sensor like the simulated one, of {args.material} rubber")


def _rest(args, counts):
    if len(counts) > args.rest:
        return counts[: args.rest].mean(0)
    if args.sensor is None:
        raise ValueError(
            f"--rest {args.rest} takes all of the {len(counts)} rows: leave some to look at, or name a "
            "--sensor whose rest it is"
        )
    return np.array(read_sensor(args.sensor).rest)


def _rows(args, recording: Recording, counts):
    if args.row is None:
        return [int(np.abs(counts - _rest(args, counts)).sum(1).argmax())]
    for row in args.row:
        if not -len(counts) <= row < len(counts):
            raise ValueError(f"--row {row}: {recording.name} has {len(counts)} rows")
    return [row % len(counts) for row in args.row]


def _pairs(value, error):
    return " ".join(f"{v:.2f} +- {e:.2f}" for v, e in zip(value, error))


def _write(path, recording: Recording, rows: list, found: list[Estimate]):
    path = pathlib.Path(path)
    table = []
    for row, one in zip(rows, found):
        line = {"row": row, "time": float(recording.time[row])}
        for name, value in dataclasses.asdict(one).items():
            if name in _AXES:
                line |= {f"{name}_{axis}": float(v) for axis, v in zip(_AXES[name], value)}
            else:
                line[name] = value
        table.append(line)
    with replacing(path) as temporary:
        if path.suffix == ".json":
            temporary.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
            return
        with open(temporary, "w", newline="") as file:
            writer = csv.DictWriter(file, table[0])
            writer.writeheader()
            writer.writerows(table)
