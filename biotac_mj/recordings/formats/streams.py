"""Combines named columns of files and topics into recordings: assigns sensor, clock and unit."""

import dataclasses
import os
import re

import numpy as np

from ...geometry.design import BIOTAC, design_named, designs
from ...quality.clock import BUS_RATE, CLOCK_FAULT, guessed_rate
from ...sensor.channels import FULL_SCALE
from ..recording import CHANNELS, FIELDS, Recording, designed
from .names import is_stamp, is_time, other_unit, place_of, unit_of

_OF_ONE_SENSOR = {"force", "torque", "sensor_pos", "sensor_quat"}
_HOLE = 0.25  # [s] longest gap of a force or pose log that is interpolated
# Raw counts of a resting electrode are thousands (four sensors: 2000 to 3500) and fall to 259 at 10 N; tared
# ones change by 500 at most.
_RAW_MEDIAN = 400.0
_RAW_OTHERS = 900.0  # PAC, TDC and TAC rest at about 2000, PDC at 1072 to 2100 in six sensors
_LARGEST_TARED, _LARGEST_VOLTS = 8.0, 5.5  # counts that any touch exceeds; [V] of any converter
_RESTART = 1.0  # [s] least backward step of a restarted clock; less is jitter
_EPOCH = 1e11  # larger clocks count fractions of seconds since 1970 (1e11 s are the year 5138)
# [Hz] row rates of BioTac logs; outside, the clock is not in seconds
_SLOWEST, _FASTEST = 0.5, 1e4
_USUAL = (20.0, 5e3)  # typical ones
SECONDS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # of a second
# fractions of backward steps: one in five is not a restarted clock, and nearly all mean that the log is
# reversed
_SHUFFLED, _REVERSED = 0.2, 0.98


@dataclasses.dataclass(eq=False)
class Stream:
    """Columns of one file or topic with common rows.

    Attributes:
      source: file or topic. sensor: name, "" for all. fields: name -> (n,) or (n, k).
      called: the sensor's own identification, such as its serial number, or "".
      time: (n,) [s], None without times.
      rate: [Hz] implied by the format, if there is no time. object, notes: see Recording.
      unit: of the electrodes as written in the file, "" for counts or if none is.
    """

    source: str
    sensor: str
    fields: dict[str, np.ndarray]
    time: np.ndarray | None = None
    rate: float | None = None
    object: str = ""
    notes: list[str] = dataclasses.field(default_factory=list)
    called: str = ""
    unit: str = ""

    @property
    def has_channels(self) -> bool:
        """Whether it has a sensor's channels."""
        return any(name in CHANNELS for name in self.fields)

    def __len__(self):
        return len(next(iter(self.fields.values())))


def make_streams(source: str, columns: dict[str, np.ndarray], notes: list[str] | None = None) -> list[Stream]:
    """Groups named columns by sensor. Unknown names are ignored with a note.

    Args:
      source: for texts. columns: name -> (n,), or (n, k), (k, n) for whole fields; anything for unknown
        names.

    Raises:
      ValueError: electrodes, an axis or the clock are incomplete, or nothing is recognised.
    """
    notes, time, unused, found, called = list(notes or ()), None, [], {}, {}
    columns = _with_whole_stamps(columns)
    units, clock, written = {}, _clock_name(columns), {}
    for name, value in columns.items():
        place, unit = place_of(name), other_unit(name)
        if unit:
            written[place.sensor] = unit
        if name == clock:
            time = _seconds(np.asarray(value, float).ravel(), name)
        elif place is None:
            unused.append(name)
        else:
            pieces = found.setdefault(place.sensor, {}).setdefault(place.field, {})
            if place in pieces:
                what = f"{place.field} {'' if place.column is None else place.column}".strip()
                raise ValueError(
                    f"{source} has two columns for {what}, {called[place]} and {name}: rename one of them"
                )
            unit, factor = unit_of(name)
            pieces[place], called[place] = factor * np.asarray(value, float), name
            if factor != 1.0:
                units.setdefault(unit, []).append(name)
    if not found:
        names = ", ".join(list(columns)[:8])
        raise ValueError(
            f"{source} has nothing that is known of a BioTac ({names or 'no columns'}): name the columns "
            "e1, e2, ..., pdc, pac1, pac2, ..., tdc, tac, Fx, Fy, Fz, time; "
            "docs/howto/file_formats.md has all names"
        )
    notes += [f"{source}: {', '.join(names)} are read as {unit}" for unit, names in units.items()]
    streams, own = [], {} if clock else _own_clocks(columns, found)
    if own:
        named = {name for name, _ in own.values()}
        unused = [name for name in unused if name not in named]
    if unused:
        notes.append(f"{source}: left out {', '.join(unused[:12])}{' ...' if len(unused) > 12 else ''}")
    for sensor, fields in found.items():
        whole = {}
        for field, pieces in fields.items():
            value, said = _whole(source, field, pieces)
            named = design_named(sensor) if field == "electrodes" else None
            if named is not None and value.shape[1] != named.nelectrode:
                raise ValueError(
                    f"{source} has {value.shape[1]} electrodes called {sensor}, and a {named.title} has "
                    f"more: give all of its columns, or rename these if they are of a {designed(value).title}"
                )
            notes += said
            if value is not None and np.isfinite(value).any():
                whole[field] = value
        notes += _normalise(source, whole)
        if whole:
            clock = own[sensor][1] if sensor in own else time
            streams.append(Stream(source, sensor, whole, clock, notes=notes, unit=written.get(sensor, "")))
    lengths = {len(value) for stream in streams for value in stream.fields.values()}
    lengths |= set() if time is None else {len(time)}
    each = [{len(p.time), *map(len, p.fields.values())} for p in streams if p.time is not None]
    if len(lengths) > 1 and not (len(each) == len(streams) and all(len(rows) == 1 for rows in each)):
        raise ValueError(
            f"{source} has columns of {', '.join(map(str, sorted(lengths)))} rows: one log has one length"
        )
    if not streams or 0 in lengths:
        raise ValueError(
            f"{source} has no rows, or no channel, force or pose that is whole ({', '.join(columns)})"
        )
    return [one for stream in _connected(streams) for one in _without_gaps(stream)]


def _without_gaps(stream):
    """A stream without the rows that lack an electrode, as in logs of several clocks merged by time. A
    force or pose in few of the other rows becomes a separate stream, so that it is interpolated to them."""
    electrodes = stream.fields.get("electrodes")
    if electrodes is None:
        return [stream]
    electrodes = stream.fields["electrodes"] = _with_dead(stream, electrodes)
    there = np.isfinite(electrodes).all(1)
    if stream.time is None or there.all():
        return [stream]
    some = np.isfinite(electrodes).any(1) & ~there
    least = int(np.isfinite(electrodes[some]).sum(0).argmin())
    lack = f"rows lack an electrode, mostly e{least + 1}"
    if some.sum() > there.sum():
        raise ValueError(
            f"{stream.source}: {some.sum()} of {len(there)} {lack}: a gap cannot be guessed; all "
            f"{electrodes.shape[1]} are needed in a row"
        )
    # rows without any electrode are another sensor's, or were lost
    if some.any():
        stream.notes.append(f"{stream.source}: {some.sum()} {lack}: they were left out")
    if none := (~there & ~some).sum():
        stream.notes.append(f"{stream.source}: left out {none} rows that have no electrode")
    others = []
    for name in [name for name in stream.fields if name not in CHANNELS]:
        value = stream.fields[name]
        have = np.isfinite(value).reshape(len(value), -1).all(1)
        if have[there].mean() < 0.5 and have.sum() > 1:
            own = {name: stream.fields.pop(name)[have]}
            others.append(Stream(stream.source, stream.sensor, own, stream.time[have], notes=stream.notes))
    stream.fields = {name: value[there] for name, value in stream.fields.items()}
    stream.time = stream.time[there]
    return [stream, *others]


def _with_dead(stream, electrodes):
    """Electrodes (n, nelectrode) in which those without a number in most of the rows of the others read 0, as
    dead ones do; they are named in a note."""
    read = np.isfinite(electrodes)
    logged = read.sum(1) > electrodes.shape[1] / 2
    dead = read[logged].mean(0) < 0.5 if logged.any() else np.zeros(electrodes.shape[1], bool)
    if not dead.any():
        return electrodes
    stream.notes.append(f"{stream.source}: {_named(dead)}: no number in most rows: taken for dead, 0 there")
    return np.where(dead & ~read & logged[:, None], 0.0, electrodes)


def _named(electrodes):
    """Names of electrodes (nelectrode,) bool."""
    return ", ".join(f"e{k + 1}" for k in np.flatnonzero(electrodes))


def _connected(streams):
    """Streams without absent sensors: messages of a hand have an entry for each finger, of zeros without a
    sensor."""
    dumb = [p for p in streams if "electrodes" in p.fields and not p.fields["electrodes"].any()]
    rest = [stream for stream in streams if not any(stream is one for one in dumb)]
    if not dumb or not any("electrodes" in stream.fields for stream in rest):
        return streams
    named = ", ".join(stream.sensor or "no name" for stream in dumb)
    for stream in rest:
        stream.notes = [
            *stream.notes,
            f"{stream.source}: left out {named}: all electrodes are zero, no sensor there",
        ]
    return rest


def _with_whole_stamps(columns):
    """Columns, with `header.stamp` computed from `header.stamp.secs` and `.nsecs`, as ROS tools write
    them."""
    out = dict(columns)
    for name, value in columns.items():
        found = re.fullmatch(r"(.*?)(secs?)", name, re.I)
        for rest in ("nsecs", "nsec", "nanosec", "nanosecs") if found else ():
            other = next((n for n in columns if n.lower() == (found[1] + rest).lower()), None)
            if other and np.size(value) == np.size(columns[other]) > 0:
                seconds, streams = (np.asarray(out.pop(n), float).ravel() for n in (name, other))
                stem = found[1].rstrip("._ /")
                out[stem if is_time(stem) or is_stamp(stem) else "time"] = seconds + 1e-9 * streams
                return out
    return out


def _own_clocks(columns, sensors):
    """{sensor: (name, (n,) [s])} of clocks named after their sensors, such as `ff_time` for
    `ff_electrodes`."""
    out = {}
    for name, value in columns.items():
        plain = re.sub(r"[\[\]. /:()\-]+", "_", name.strip().lower()).strip("_")
        for sensor in sensors:
            if sensor and sensor not in out and plain.startswith(f"{sensor}_"):
                if is_time(plain[len(sensor) + 1 :]) and place_of(name) is None and np.size(value) > 1:
                    out[sensor] = name, _seconds(np.asarray(value, float).ravel(), name)
    return out


def _clock_name(columns):
    """Name of the clock column, None if there is none. Drivers may leave header stamps at zero; these are no
    clock."""
    clocks = (name for name in columns if is_time(name) and place_of(name) is None)
    named = next((name for name in clocks if np.size(columns[name])), None)
    stamps = (name for name in columns if is_stamp(name) and _increases(columns[name]))
    return named or next(stamps, None)


def _increases(value):
    value = np.ravel(value)
    return (
        value.dtype.kind in "iuf" and len(value) > 1 and (np.diff(value) >= 0).all() and value[0] < value[-1]
    )


def _whole(source, field, pieces):
    """((n,) or (n, k), notes) of a field, None if it is incomplete."""
    width = FIELDS[field].width
    (first, value), *_ = pieces.items()
    if first.column is None and (len(pieces) == 1 or field == "pac"):
        return _oriented(source, field, value, width)
    place = {p.column: v.ravel() for p, v in pieces.items() if p.column is not None}
    base = 0 if 0 in place else 1
    if field == "pac":
        return np.stack([place[number] for number in sorted(place)], 1), []
    if field == "electrodes":
        last, known = max(place) - base + 1, sorted(design.nelectrode for design in designs())
        if last > known[0] and last not in known:  # the electrodes cannot be identified
            raise ValueError(
                f"{source} has {len(place)} columns of electrodes, e{min(place)} to e{max(place)}: "
                f"{_known()}; name all of one of them, and no others"
            )
        count = max(last, known[0])
        missing = [f"e{i + 1}" for i in range(count) if i + base not in place]
        if missing:
            missing = ", ".join(missing)
            raise ValueError(f"{source} has no columns {missing}: its header must name e1..e{count}")
        return np.stack([place[i + base] for i in range(len(place))], 1), []
    if set(place) != set(range(width)):
        lack = f"left out {field}, of which only {len(place)} of {width} columns are there"
        return None, [f"{source}: {lack}: add the others, of zeros if they were not measured"]
    return np.stack([place[i] for i in range(width)], 1), []


def _known():
    """Known fingertips, in words."""
    return " and ".join(f"a {d.title.replace('(', 'has ').rstrip(')')}" for d in designs())


def _oriented(source, field, value, width):
    """A whole field with time along its rows."""
    value = np.squeeze(value) if value.ndim > 2 or width == 0 else value
    if not width or (field == "pac" and value.ndim == 1):
        if value.ndim > 1:
            raise ValueError(f"{source}: {field} has shape {value.shape}: one number a row is needed")
        return value.reshape(-1, 1) if field == "pac" else value.reshape(-1), []
    if field in ("electrodes", "pac"):  # rows of time first
        counts = [design.widths[field] for design in designs()]
        width = next((n for n in reversed(value.shape) if value.ndim == 2 and n in counts), width)
    if value.ndim == 2 and value.shape[1] == width:
        return value, []
    if value.ndim == 2 and value.shape[0] == width:
        return value.T, [f"{source}: {field} is {width} x {value.shape[1]}, time along its rows: turned"]
    if field in CHANNELS:
        raise ValueError(f"{source}: {field} has shape {value.shape}: (n, {width}) or ({width}, n) is needed")
    return None, [f"{source}: left out {field} of shape {value.shape}"]  # such as positions of joints


def _normalise(source, fields):
    """Scales quaternions to unit length and drops invalid ones; returns notes."""
    notes = []
    for name in [name for name in fields if name.endswith("quat")]:
        length = np.linalg.norm(fields[name], axis=1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            fields[name] = np.where(np.abs(length - 1) < 0.1, fields[name] / length, np.nan)
        none = int((np.isfinite(length) & ~np.isfinite(fields[name]).all(1, keepdims=True)).sum())
        if none:
            notes.append(f"{source}: {name} of {none} rows is no unit quaternion w x y z: left out")
        if not np.isfinite(fields[name]).any():
            del fields[name]
    return notes


def _seconds(time, name):
    """A clock in seconds: its unit is in its name, or it is an epoch in fractions of seconds."""
    factor = next(
        (f for unit, f in SECONDS.items() if re.sub("ecs?$", "", name.lower().rstrip("]) ")).endswith(unit)),
        1,
    )
    if factor == 1 and len(time) and np.nanmedian(time) > _EPOCH:
        factor = 10.0 ** (-3 * np.ceil(np.log10(np.nanmedian(time) / _EPOCH) / 3))
    return time * factor


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
            said_is = f"{_named(beyond)} always {', '.join(f'{v:g}' for v in read[0, beyond])}"
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
