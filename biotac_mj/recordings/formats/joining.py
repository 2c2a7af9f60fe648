"""Joins streams to recordings: sensor, clock and unit of their rows."""

import dataclasses
import os

import numpy as np

from ...geometry.design import BIOTAC
from ...quality.clock import BUS_RATE, CLOCK_FAULT, guessed_rate
from ...sensor.channels import FULL_SCALE
from ..recording import CHANNELS, Recording, designed
from .streams import SECONDS, Stream, electrode_names

_OF_ONE_SENSOR = {"force", "torque", "sensor_pos", "sensor_quat"}
_HOLE = 0.25  # [s] longest gap of a force or pose log that is interpolated
# Raw counts of a resting electrode are thousands (four sensors: 2000 to 3500) and fall to 259 at 10 N; tared
# ones change by 500 at most.
_RAW_MEDIAN = 400.0
_RAW_OTHERS = 900.0  # PAC, TDC and TAC rest at about 2000, PDC at 1072 to 2100 in six sensors
_LARGEST_TARED, _LARGEST_VOLTS = 8.0, 5.5  # counts that any touch exceeds; [V] of any converter
_RESTART = 1.0  # [s] least backward step of a restarted clock; less is jitter
# [Hz] row rates of BioTac logs; outside, the clock is not in seconds
_SLOWEST, _FASTEST = 0.5, 1e4
_USUAL = (20.0, 5e3)  # typical ones
# fractions of backward steps: one in five is not a restarted clock, and nearly all mean that the log is
# reversed
_SHUFFLED, _REVERSED = 0.2, 0.98


def join(
    streams: list[Stream],
    rate: float | None = None,
    object_name: str | None = None,
    scale: float | None = None,
) -> list[Recording]:
    """Makes recordings of the streams with channels and interpolates forces and poses of the others to their
    rows.

    Args:
      rate: [Hz] of rows without times; None: the format's, else guessed from repeated rows, else 100.
      object_name: what touched; None: as in the files.
      scale: factor on channels, counts per unit.

    Raises:
      ValueError: no sensor, incompatible clocks or lengths, or invalid values.
    """
    sensors = [stream for stream in streams if "electrodes" in stream.fields] or [
        p for p in streams if p.has_channels
    ]
    others = [stream for stream in streams if stream not in sensors]
    if not sensors:
        raise ValueError(
            f"{', '.join(dict.fromkeys(p.source for p in streams))}: no electrodes: give the sensor's own "
            "file too"
        )
    names = {stream.sensor for stream in sensors}
    common = os.path.commonprefix(sorted(names)).rpartition("_")[0] if len(names) > 1 else ""
    made, taken = [], {}
    owners = {id(one): _owners(one, sensors) for one in others}
    common_to_all = [
        one
        for one in others
        if not owners[id(one)] and one.sensor not in names and not (one.has_channels and one.sensor)
    ]
    doubtful = _doubtful(common_to_all) if len(sensors) > 1 else set()
    for stream in sensors:
        mine = [one for one in others if stream in owners[id(one)]]
        mine += [_without(one, doubtful) for one in common_to_all]
        stem = stream.source.split(".")[0]
        many = sum(p.source == stream.source for p in sensors) > 1
        name = f"{stem}_{stream.sensor.removeprefix(common).strip('_')}" if many and stream.sensor else stem
        taken[name] = taken.get(name, 0) + 1
        name = f"{name}_{taken[name]}" if taken[name] > 1 else name
        made.append(_recording(name, stream, mine, _rows_clock(sensors, stream, rate), object_name, scale))
    return made


def _owners(one, sensors):
    """The sensors that a force or pose is named after: `ff_wrench` belongs to `ff_biotac`."""
    words = {id(s): set(f"{s.sensor}_{s.called}".lower().split("_")) for s in sensors}
    common = set.intersection(*words.values()) if len(sensors) > 1 else set()
    own = {word for word in set(one.sensor.lower().split("_")) - common if word and not word.isdigit()}
    return [s for s in sensors if s.sensor == one.sensor or own & words[id(s)]]


def _doubtful(others):
    """Fields that several streams have for one sensor, with names that match no sensor."""
    names = {}
    for one in others:
        for field in _OF_ONE_SENSOR & set(one.fields):
            names.setdefault(field, set()).add(one.sensor)
    return {field for field, of in names.items() if len(of) > 1}


def _without(stream, fields):
    """A stream without these fields, and a note."""
    there = [field for field in stream.fields if field in fields]
    if not there:
        return stream
    unused = {key: value for key, value in stream.fields.items() if key not in there}
    said = f"{stream.source}: left out {', '.join(there)} of {stream.sensor or 'no name'}: no name says whose"
    return dataclasses.replace(stream, fields=unused, notes=[*stream.notes, said])


def _recording(name, stream, others, rows_clock, object_name, scale):
    notes, sources = list(stream.notes), [stream.source]
    clock = stream.time
    if clock is None:  # a file logged row by row with it may have one
        clock = next((o.time for o in others if o.time is not None and len(o) == len(stream)), None)
    if clock is None:
        (time, said), keep = rows_clock, slice(None)
    else:
        (time, keep, more), said = _clock(stream.source, clock), "the file's times"
        notes += more
        if rows_clock[1] == "given":
            notes.append(f"{stream.source}: --rate is not needed, the file has times")
    fields = {key: value[keep] for key, value in stream.fields.items()}
    for other in others:
        placed, more = _placed(stream, other, time, keep) if other.fields else ({}, [])
        notes += [n for n in (*other.notes, *more) if n not in notes]
        twice = [key for key in placed if key in fields]
        if twice:
            notes.append(f"{other.source}: left out {', '.join(twice)}, which is in another file too")
        fields |= {key: value for key, value in placed.items() if key not in twice}
        sources += [other.source]
    if "pac" in fields:
        design = designed(fields["electrodes"]) if "electrodes" in fields else BIOTAC
        fields["pac"], more = _frame_of_pac(stream.source, fields["pac"], design.npac)
        notes += more
    there = [key for key in CHANNELS if key in fields]
    if scale is not None:
        fields |= {key: fields[key] * scale for key in there}
        notes.append(f"channels were multiplied by {scale:g}")
    elif stream.unit:
        raise ValueError(
            f"{stream.source}: the electrodes are in {stream.unit}; raw counts 0..4095 are needed: give "
            "--scale, counts for one of their units"
        )
    unit = "counts"
    if "electrodes" in fields:
        read = fields["electrodes"]
        beyond = ((read < 0) | (read > FULL_SCALE)).all(0) & (np.ptp(read, axis=0) == 0)
        if beyond.any() and not beyond.all() and guess_unit(read[:, ~beyond]) == "counts":
            said_is = f"{electrode_names(beyond)} always {', '.join(f'{v:g}' for v in read[0, beyond])}"
            notes.append(f"{stream.source}: {said_is}, beyond 0..4095: taken for dead, 0 there")
            fields["electrodes"] = np.where(beyond, 0.0, read)
        unit = guess_unit(fields["electrodes"])
    # also treat the other channels as tared or scaled, unless they rest at thousands of raw counts
    units = {
        key: unit for key in there if key == "electrodes" or np.abs(np.nanmedian(fields[key])) < _RAW_OTHERS
    }
    what = stream.object or next((o.object for o in others if o.object), "")
    return Recording(
        time,
        **fields,
        name=name.replace("/", "_"),
        object=what if object_name is None else object_name,
        source=", ".join(dict.fromkeys(sources)),
        rate_source=said,
        notes=tuple(dict.fromkeys(notes)),
        units=units,
    )


def _frame_of_pac(source, value, npac):
    """((n, npac), notes) of PAC (n, k): drivers keep some samples of a frame; the last is the latest."""
    given = value.shape[1]
    if given > npac:
        kept = f"the last {npac} are kept: another sensor has more"
        return value[:, -npac:], [f"{source}: PAC has {given} samples of a frame, {kept}"]
    if given == npac:
        return value, []
    missing = np.full((len(value), npac - given), np.nan)
    return np.hstack([missing, value]), [f"{source}: PAC has {given} of {npac} samples of a frame"]


def guess_unit(electrodes: np.ndarray) -> str:
    """One of `recording.UNITS` for electrodes (n, nelectrode). Values taken for counts may still be rejected
    later."""
    value = electrodes[np.isfinite(electrodes).all(1)]
    if not len(value):
        return "counts"
    largest, whole = np.abs(value).max(), (value == np.rint(value)).all()
    if largest <= _LARGEST_TARED and not whole:
        return "volts" if value.min() >= 0 and 1.5 < largest <= _LARGEST_VOLTS else "normalised"
    about_rest = ((value < 0).any(0) & (value > 0).any(0)).mean() > 0.5  # at any contact force
    if np.median(np.abs(np.median(value, 0))) >= _RAW_MEDIAN and not about_rest:
        return "counts"
    return "tared counts" if value.min() < 0 else "tared counts without sign"


def _rows_clock(sensors, stream, rate):
    """((n,) [s], source of the rate) for rows without times, common to all sensors logged together."""
    n = len(stream)
    if rate is not None:
        return np.arange(n) / rate, "given"
    if stream.rate is not None:
        return np.arange(n) / stream.rate, "the format's"
    electrodes = [one.fields["electrodes"] for one in sensors if len(one) == n and "electrodes" in one.fields]
    guess, why = guessed_rate(*electrodes)
    return np.arange(n) / guess, why


def _check_order(name, step):
    """Raises ValueError if rows are not sorted by time."""
    if len(step) and (step < 0).mean() > _REVERSED:
        raise ValueError(f"{name}: the time runs back from row to row: turn the rows around")
    if len(step) and (back := (step < -_RESTART).mean()) > _SHUFFLED:
        raise ValueError(
            f"{name}: the rows are not in the order of their times ({back:.0%} of the steps run back by more "
            f"than {_RESTART:g} s): sort them, all files of the recording alike"
        )


def _unnamed_unit(usual):
    """Unit and its seconds for a clock whose usual step is too long for a BioTac log in seconds, if exactly
    one unit makes it plausible; (None, 1) otherwise."""
    fits = [
        (unit, f)
        for unit, f in SECONDS.items()
        if 1 / usual < _SLOWEST and _USUAL[0] <= 1 / (usual * f) <= _USUAL[1]
    ]
    return fits[0] if len(fits) == 1 else (None, 1.0)


def _clock(name, time):
    """(increasing time, kept rows, notes)."""
    notes = []
    good = np.isfinite(time)
    if not good.all():
        notes.append(f"{(~good).sum()} rows without a time were left out")
    rows = np.flatnonzero(good)
    time = time[rows].copy()
    step = np.diff(time)
    _check_order(name, step)
    usual = np.median(step[step > 0]) if (step > 0).any() else 1 / BUS_RATE
    unit, factor = _unnamed_unit(usual)
    if unit:
        time, step, usual = time * factor, step * factor, usual * factor
        notes.append(f"{name}: the time goes on by {usual / factor:.4g} a row: it was taken for {unit}")
    for k in np.flatnonzero(step < -_RESTART):
        time[k + 1 :] += time[k] - time[k + 1] + _RESTART
        notes.append(
            f"{CLOCK_FAULT}starts anew in row {rows[k + 1]}, {usual - step[k]:.3g} s back: later rows were "
            f"put {_RESTART:g} s after it; if these are two recordings, cut the log there"
        )
    back = np.flatnonzero((step < 0) & (step >= -_RESTART))
    if len(back):
        notes.append(
            f"{CLOCK_FAULT}runs back {len(back)} times, by {usual - step[back].min():.3g} s at most, first "
            f"in row {rows[back[0] + 1]}: rows until it had caught up were left out"
        )
    latest = np.maximum.accumulate(np.concatenate([[-np.inf], time[:-1]])) if len(time) else time
    keep = time > latest
    if (~keep).any():
        fraction = (~keep).mean()
        if fraction > 0.5:
            raise ValueError(
                f"{name}: the time of {fraction:.0%} of the rows does not increase: this is no clock"
            )
        notes.append(f"{(~keep).sum()} rows whose time does not increase were left out")
    if not keep.any():
        raise ValueError(f"{name}: no row has a time")
    if not _SLOWEST <= 1 / usual <= _FASTEST:
        raise ValueError(
            f"{name}: {1 / usual:.3g} rows per second are no log of a BioTac: is the time in seconds? "
            "Name the column time_ms, time_us or time_ns"
        )
    return time[keep], rows[keep], notes


def _placed(stream, other, time, keep):
    """Fields of another stream, interpolated to these times, and notes."""
    if other.time is None or stream.time is None:
        if len(other) != len(stream):
            raise ValueError(
                f"{stream.source} has {len(stream)} rows and {other.source} has {len(other)}: they must be "
                "logged row by row together; cut both to the time they share (a clock gap cannot be guessed)"
            )
        return {k: v[keep] for k, v in other.fields.items()}, []
    if stream.time is other.time:
        return {k: v[keep] for k, v in other.fields.items()}, []
    clock, rows, notes = _clock(other.source, other.time)
    if clock[0] > time[-1] or clock[-1] < time[0]:
        raise ValueError(
            f"{stream.source} and {other.source} have no time in common: are their clocks the same?"
        )
    placed = {
        k: _interpolated(k, time, clock, v[rows]).reshape(-1, *v.shape[1:]) for k, v in other.fields.items()
    }
    placed = {k: v for k, v in placed.items() if np.isfinite(v).any()}
    have = [np.isfinite(other.fields[k][rows]).reshape(len(rows), -1).all(1) for k in placed]
    clock = clock[np.any(have, 0)] if have else clock[:0]
    within = np.mean((time >= clock[0]) & (time <= clock[-1])) if len(clock) else 0
    notes.append(
        f"{', '.join(placed)} of {other.source}: interpolated from {1 / np.median(np.diff(clock)):.0f} Hz"
        + (f", there for {within:.0%} of the rows" if within < 1 else "")
        if len(clock) > 1
        else f"{other.source} has one row"
    )
    return placed, notes


def _interpolated(name, time, clock, value):
    """(len(time), k) interpolated between the rows of value (n, k); NaN outside and in long gaps."""
    good = np.isfinite(value).reshape(len(value), -1).all(1)
    clock, value = clock[good], value[good].reshape(good.sum(), -1)
    if len(clock) < 2:
        return np.full((len(time), value.shape[1]), np.nan)
    if name.endswith("quat"):  # q and -q are one orientation: continue with the nearer one
        value = (
            value
            * np.cumprod(
                np.where((value * np.roll(value, 1, 0)).sum(1) < 0, -1, 1) ** (np.arange(len(value)) > 0)
            )[:, None]
        )
    out = np.stack([np.interp(time, clock, column, np.nan, np.nan) for column in value.T], 1)
    after = np.clip(np.searchsorted(clock, time), 1, len(clock) - 1)
    out[clock[after] - clock[after - 1] > max(_HOLE, 3 * np.median(np.diff(clock)))] = np.nan
    if name.endswith("quat"):
        out /= np.linalg.norm(out, axis=1, keepdims=True)
    return out
