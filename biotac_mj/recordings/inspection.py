"""Inspects how a recording was logged: clock, units, and faults of the log (`quality`)."""

import numpy as np

from ..quality.check import check
from ..quality.clock import CLOCK_FAULT, clock_faults
from ..quality.fault import Fault
from ..quality.log import Log
from ..sensor.channels import FULL_SCALE
from .recording import CHANNELS, CLOCKED, REST_LIKE, Recording, check_recording, with_baseline

_REPEATED = 0.02  # fraction of repeated rows; fewer occur by chance
_MOST_TRAVEL = 3.0  # [m] largest travel of a finger or an object; robots reach two
_STILL = 20  # rows; fewer may be equal by chance in a working channel
_ENDS = {0.0: "no power, or a plug that is out", FULL_SCALE: "a broken wire, or no liquid in the sensor"}


def findings(recording: Recording) -> list[str]:
    """Findings, one line each: first the content, last the importer's notes. Lines that begin with "warning:
    " come from `faults` and `remarks`.

    Raises:
      TypeError: not a Recording.
    """
    check_recording(recording)
    n, rate = len(recording), recording.rate
    duration = recording.time[-1] - recording.time[0]
    wrong = faults(recording)
    out = [
        f"{n} rows, {duration:.2f} s, {rate:.4g} Hz ({recording.rate_source}); {', '.join(recording.fields)}"
        + (f"; object {recording.object}" if recording.object else "")
        + (f"; {recording.design.title}" if recording.design else "")
    ]
    return (
        out
        + _no_gap(recording, wrong)
        + _repeated(recording, wrong)
        + _units(recording)
        + _levels(recording, wrong)
        + [f"warning: {line}" for line in (*(fault.message for fault in wrong), *remarks(recording))]
        + _missing(recording)
        + [note for note in recording.notes if not note.startswith(CLOCK_FAULT)]
    )


def faults(recording: Recording) -> list[Fault]:
    """Faults of a recording as a log, as in `biotac diagnose`.

    Raises:
      TypeError: not a Recording.
    """
    check_recording(recording)
    log, of_the_clock = _log(recording)
    return of_the_clock + ([] if log is None else check(log).faults)


def warnings(recording: Recording) -> list[str]:
    """Reasons to doubt a recording, one line each: its `faults` and `remarks`.

    Raises:
      TypeError: not a Recording.
    """
    return [*(fault.message for fault in faults(recording)), *remarks(recording)]


def remarks(recording: Recording) -> list[str]:
    """Reasons for doubt other than single electrodes, one line each: no electrode changes, channels or a
    force are constant, a clock ran back.

    Raises:
      TypeError: not a Recording.
    """
    check_recording(recording)
    return [
        *_stuck_electrodes(recording),
        *_stuck_others(recording),
        *_far(recording),
        *(note for note in recording.notes if note.startswith(CLOCK_FAULT)),
    ]


def check_clock(recording: Recording, counts: np.ndarray | None) -> tuple[np.ndarray | None, list[Fault]]:
    """(n,) number of rows missing before each by the file's clock, None if unknown, and faults of that clock.
    counts: (n, nelectrode) of the electrodes, or None."""
    if recording.rate_source != CLOCKED:
        return None, []
    changed = any(note.startswith(CLOCK_FAULT) or "were left out" in note for note in recording.notes)
    return clock_faults(recording.time, counts, complete=not changed)


def _log(recording):
    """The rows with all electrodes as a log, None if fewer than two, and faults of the clock."""
    value, unit = recording.electrodes, recording.unit("electrodes")
    whole = np.zeros(len(recording), bool) if value is None else np.isfinite(value).all(1)
    if whole.sum() < 2:
        return None, check_clock(recording, None)[1]
    missing, wrong = check_clock(recording, value)
    force = recording.force
    log = Log(
        with_baseline(value[whole]) if unit.startswith("tared") else value[whole],
        recording.rate,
        recording.rate_source == CLOCKED,
        missing=None if missing is None else missing[whole],
        other_device=force[whole] if force is not None and np.isfinite(force[whole]).all() else None,
        in_counts=unit.endswith("counts") or unit.startswith("tared"),
        converter=unit == "counts",
        signed=not unit.endswith("without sign"),
    )
    return log, wrong


def _no_gap(recording, wrong):
    missing, _ = check_clock(recording, None)
    gap = any(fault.detector == "clock" for fault in wrong)
    return [] if missing is None or gap or len(recording) < 3 else ["clock: no gap"]


def _repeated(recording, wrong):
    repeated = recording.repeated
    if not repeated.any() or any(fault.held for fault in wrong):
        return []
    text = f"repeated rows: {repeated.sum()} ({repeated.mean():.1%})"
    if repeated.mean() > _REPEATED:
        text += f", values are held, new ones come at {recording.rate * (1 - repeated.mean()):.3g} Hz"
    return [text]


def _units(recording):
    units = {}
    for name in CHANNELS:
        if getattr(recording, name) is not None:
            units.setdefault(recording.unit(name), []).append(name)
    out = [f"units: {'; '.join(f'{unit}: ' + ', '.join(names) for unit, names in units.items())}"]
    if "tared counts without sign" in units and not _dead(recording):
        out.append(
            "the sign is lost: values are never negative and rest near zero; use energies, not waveforms"
        )
    return out


def _dead(recording):
    """Whether all electrodes read the same from the first row to the last."""
    value = recording.electrodes
    return value is not None and np.nanmax(value) == np.nanmin(value)


def _stuck_electrodes(recording):
    value = recording.electrodes
    if value is None or len(value) < 2 or (np.nanmax(value, 0) > np.nanmin(value, 0)).any():
        return []
    level = float(np.nanmax(value))
    read, cause = ("", "a logger that stood still")
    if _dead(recording):
        read, cause = f" from {level:g}", _ENDS.get(level, cause)
    return [
        f"no electrode changes{read}, this is no recording of a touch: {cause}? Check the sensor, then "
        "record again"
    ]


def _stuck_others(recording):
    out = []
    for name in recording.fields:
        if name == "electrodes" or name not in (*CHANNELS, "force") or len(recording) < _STILL:
            continue
        value = getattr(recording, name).reshape(len(recording), -1)
        value = value[:, np.isfinite(value).any(0)]  # drivers omit samples of PAC's frames
        low, high = np.nanmin(value, 0), np.nanmax(value, 0)
        # TDC and TAC of a sensor at rest may stay at one count; the others have noise
        lives = name in ("tdc", "tac") and float(low[0]) not in _ENDS
        if lives or (low < high).any():
            continue
        what = "the force" if name == "force" else name.upper()
        level = " ".join(f"{one:g}" for one in dict.fromkeys((low + 0.0).tolist()))  # no -0
        out.append(
            f"{what} never changes from {level} {recording.unit(name)}: is its sensor connected and on? "
            "Record again, or leave it out"
        )
    return out


def _far(recording):
    """Warnings on positions that are probably in millimetres."""
    out = []
    for name in recording.fields:
        if name.endswith("_pos"):
            value = getattr(recording, name)
            travel = np.nanmax(np.nanmax(value, 0) - np.nanmin(value, 0))
            if travel > _MOST_TRAVEL:
                out.append(
                    f"{name} moves over {travel:.3g} m: are these millimetres? Say so in the names of its "
                    f"columns ({name}_x_mm), and import it again"
                )
    return out


def _levels(recording, wrong):
    out, value = [], recording.electrodes
    if value is None:
        return out
    if recording.unit("electrodes") == "counts" and not _dead(recording):
        ends, whole = (value <= 0) | (value >= FULL_SCALE), np.isfinite(value).all(1)
        for fault in (one for one in wrong if one.mask is not None):  # reported above
            ends[whole] &= ~fault.mask
        fraction = ends.mean(0)
        full = [f"e{i + 1} {fraction[i]:.1%}" for i in np.flatnonzero(fraction > 0.001)]
        if full:
            out.append(f"saturated (0 or 4095 counts): {', '.join(full)}")
    if recording.rest_correlation < REST_LIKE and not _dead(recording):
        out.append(
            f"rest levels are unlike known ones of a {recording.design.title.split(' (')[0]} (correlation "
            f"{recording.rest_correlation:.2f}): is this another sensor, or are the columns in another order "
            f"than e1..e{recording.design.nelectrode}?"
        )
    return out


def _missing(recording):
    out = []
    for name in recording.fields:
        value = getattr(recording, name).reshape(len(recording), -1)
        fraction = 1 - np.isfinite(value).mean()
        if fraction > 0 and name != "pac":
            out.append(f"{name}: not there in {fraction:.1%} of its values")
    return out
