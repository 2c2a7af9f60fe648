"""Runs `biotac lab estimate`."""

import argparse
import csv
import dataclasses
import json
import pathlib
import sys

import numpy as np
from tqdm import tqdm

from ...files import replacing
from ...geometry import load_skin
from ...geometry.skins import shipped_skin
from ...recordings import Recording, load_one
from ...recordings.formats.pressed import settings_of
from ...recordings.recording import designed
from ...sensor.acquisition_kernels import SLOT_RATE
from ...sensor.presets import read_sensor
from ...skin.settings import read_dict, read_settings
from .belief import Touch
from .estimate import Estimate, Estimator, at_instant, change_of, pressure_change, touch_of

_VECTORS = "centre", "centre_error", "force"
_ADDED = "sensor", "randomise", "effects", "signal", "friction", "thermal"  # keywords of a press
_TOUCHING = 0.1  # [N] least force of a labelled touch


def estimate_verb(args: argparse.Namespace) -> None:
    """`biotac lab estimate`; raises ValueError or FileNotFoundError for invalid input."""
    recording, notes = load_one(
        args.file, args.recording, rate=args.rate, scale=args.scale, object_name=args.object
    )
    counts, assumed = recording.counts()
    for note in (*notes, *assumed):
        print(f"note: {note}")
    if args.sensor is not None and len(counts) > args.rest:
        raise ValueError(
            f"--sensor {args.sensor[:40]} is for a file without a row untouched, and of these {len(counts)} "
            f"the first {args.rest} are (--rest): leave it out"
        )
    rest, rows = _rest(args, counts), _rows(args, recording, counts)
    pressed = settings_of(args.file, recording)
    pdc = _pdc(recording)
    read = _instants(recording, counts, pdc, pressed is not None)
    for row in rows:  # check before the work
        try:
            touch_of(read(row)[0], rest)
        except ValueError as error:
            raise ValueError(f"row {row} of {recording.name}: {error}") from None
    skin, indenter, settings, film = _inverted(args, pressed, designed(counts))
    simulated = pressed is not None and _is_the_simulated_one(args, pressed, settings.material)
    estimator = Estimator(load_skin(skin), indenter, settings.material, settings.options, not args.quiet)
    belief = estimator.learn(_touches(args)) if args.known else None
    pdc_rest = None if pdc is None or len(counts) <= args.rest else pdc[: args.rest].mean()

    def estimate(row):
        then, pressure, moved = read(row)
        pressure = None if pdc_rest is None else (pressure, pdc_rest)
        if simulated:
            return estimator.fit(then, rest, pressure, args.rest, film, moved)
        return estimator(then, rest, pressure, belief)

    if simulated and not args.quiet:
        print(f"note: fitting a press to each of {len(rows)} rows, seconds to minutes each", file=sys.stderr)
    found = [
        estimate(row)
        for row in tqdm(rows, desc="estimate", unit="row", disable=args.quiet or None, leave=False)
    ]
    for row, one in zip(rows, found):
        print(
            f"row {row}: centre {_pairs(1e3 * one.centre, 1e3 * one.centre_error)} mm, force {one.size:.3g} "
            f"N ({one.low:.3g} to {one.high:.3g}), {100 * one.unexplained:.0f} % of the change unexplained"
        )
        if one.deepest:
            print(
                f"  note: row {row} is most like the deepest press that is simulated there, 0.6 mm from the "
                "core: it may be deeper, and its force larger"
            )
    _write(args.out, recording, rows, found)
    whose = "any sensor, whose gains, film and rubber are unknown"
    if simulated:
        whose = "the simulated sensor that made this press"
    elif args.known:
        whose = f"a sensor known by {args.touches} touches at most"
    print(f"written: {args.out}; +- and (to) are 95 % for {whose}")
    print("  centre: on the line of force, nearest to the middle of the contact on the undeformed skin")
    if not (simulated or args.known):
        print("  the force is known to a factor only: touches of the same sensor (--known) narrow it")


def _instants(recording, counts, pdc, simulated):
    """A function of a row: electrodes (nelectrode,) and PDC, of a press of the simulator at the row's time,
    and their deviations by motion."""
    design = designed(counts)
    values = counts if pdc is None else np.column_stack([counts, pdc])
    if not simulated:
        return lambda row: (counts[row], values[row, -1], np.zeros(values.shape[1]))
    late = np.zeros(values.shape[1])
    # all electrodes are of the first step of a frame, see `Acquisition.needs_impedance`
    slots = 2 * np.arange(design.nelectrode) + 1
    late[: len(slots)] = slots / SLOT_RATE - 0.5 * np.median(np.diff(recording.time))

    def read(row):
        found, moved = at_instant(recording.time, values, row, design.slots / SLOT_RATE, late)
        return found[: counts.shape[1]], found[-1], moved

    return read


def _is_the_simulated_one(args, pressed, material):
    """Whether a press is of the simulated sensor itself: its own skin under its own geom, whether these are
    given or not, elastic, with readings by physics and without effects."""
    given = {name: getattr(args, name) for name in ("skin", "indenter", "material", "options", "known")}
    asked = [name for name, value in given.items() if value not in (None, pressed.get(name))]
    added = [name for name in _ADDED if pressed.get(name) is not None]
    added += [f"options['{name}']" for name in ("readings", "modulus") if name in pressed["options"]]
    added += material.extensions
    if pressed["tier"] != "full":
        added.append(f"tier {pressed['tier']!r}")
    why = [f"--{name} was given" for name in asked] + [f"it was made with {name}" for name in added]
    if why:
        print(f"note: a press of this simulator, taken for one of any sensor: {', '.join(why)}")
    return not why


def _inverted(args, pressed, design):
    """Skin, geom, settings and film: those of the press by default, else general defaults."""
    own = {name: value for name, value in (pressed or {}).items() if value is not None}
    options = own.pop("options", {})
    if args.options:
        options = {"skin": {}, **read_dict(args.options, "options")}
        own.pop("liquid", None)
    film, options = options.get("film"), {k: v for k, v in options.items() if args.options or k == "skin"}
    liquid = {"liquid": own["liquid"]} if "liquid" in own else {}
    settings = read_settings(args.material or own.get("material"), options, **liquid)
    if settings.modulus is not None:
        raise ValueError("an estimate does not support moduli by element: leave them out of --options")
    skin, indenter = own.get("skin", shipped_skin(design, "coarse")), own.get("indenter", "sphere_7mm")
    return args.skin or skin, args.indenter or indenter, settings, film


def _touches(args):
    """The strongest row of each of the first touches of the labelled recording."""
    recording, _ = load_one(args.known, rate=args.rate, scale=args.scale)
    if recording.force is None or recording.contact_pos is None:
        raise ValueError(
            f"{args.known} has no force or no contact_pos: give a recording of the same sensor that has "
            "both, in the BioTac frame, as `biotac data import` writes"
        )
    counts, _ = recording.counts()
    rest, pdc = _rest(args, counts), _pdc(recording)
    size = np.linalg.norm(recording.force, axis=1)
    usable = (size > _TOUCHING) & np.isfinite(recording.contact_pos).all(1)
    begins = np.flatnonzero(np.diff(usable.astype(int), prepend=0) == 1)
    touches = []
    for part in np.split(np.arange(len(size)), begins)[1:][: args.touches]:
        row = part[np.where(usable[part], size[part], 0).argmax()]
        pressure = np.nan if pdc is None else pressure_change(pdc[row], pdc[: args.rest].mean())
        touches.append(
            Touch(change_of(counts[row], rest), pressure, float(size[row]), recording.contact_pos[row])
        )
    if not touches:
        raise ValueError(f"{args.known} has no row above {_TOUCHING} N with its place: give touches")
    return touches


def _pdc(recording):
    usable = recording.pdc is not None and recording.unit("pdc") == "counts"
    return recording.pdc if usable and np.isfinite(recording.pdc).all() else None


def _rest(args, counts):
    if len(counts) > args.rest:
        return counts[: args.rest].mean(0)
    if args.sensor is None:
        raise ValueError(
            f"--rest {args.rest} takes all of the {len(counts)} rows: leave some to look at, or name a "
            "--sensor whose rest it is"
        )
    return np.array(read_sensor(args.sensor, design=designed(counts)).rest)


def _rows(args, recording: Recording, counts):
    if args.row is None:
        return [int(np.abs(counts - _rest(args, counts)).sum(1).argmax())]
    for row in args.row:
        if not -len(counts) <= row < len(counts):
            raise ValueError(
                f"--row {row}: {recording.name} has {len(counts)} rows, give 0 to {len(counts) - 1}, or "
                "-1 for the last"
            )
    return [row % len(counts) for row in args.row]


def _pairs(value, error):
    return " ".join(f"{v:.2f} +- {e:.2f}" for v, e in zip(value, error))


def _write(path, recording: Recording, rows: list, found: list[Estimate]):
    path = pathlib.Path(path)
    table = []
    for row, one in zip(rows, found):
        line = {"row": row, "time": float(recording.time[row])}
        for name, value in dataclasses.asdict(one).items():
            if name in _VECTORS:
                line |= {f"{name}_{axis}": float(v) for axis, v in zip("xyz", value)}
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
