"""Combines named columns of files and topics into recordings: assigns sensor, clock and unit."""

import dataclasses
import re

import numpy as np

from ...geometry.design import design_named, designs
from ..recording import CHANNELS, FIELDS, designed
from .names import is_stamp, is_time, other_unit, place_of, unit_of

_EPOCH = 1e11  # larger clocks count fractions of seconds since 1970 (1e11 s are the year 5138)
SECONDS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # of a second


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
    stream.notes.append(
        f"{stream.source}: {electrode_names(dead)}: no number in most rows: taken for dead, 0 there"
    )
    return np.where(dead & ~read & logged[:, None], 0.0, electrodes)


def electrode_names(electrodes: np.ndarray) -> str:
    """Names of those electrodes (nelectrode,) of bool that are marked, in one line."""
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
