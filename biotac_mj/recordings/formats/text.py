"""Text: matrices in either orientation, and tables with named columns."""

import pathlib
import re

import numpy as np

from ...geometry.design import designs
from ...sensor.channels import ELECTRODES, NPAC
from .columns import Table, parse_table
from .names import is_part_of_stamp, is_stamp, is_time, other_unit, place_of
from .streams import Stream, make_streams

# Ruppel et al. (IAS-15, 2019): a table that may come without a header
RUPPEL = ("time", "px", "py", "pz", "fx", "fy", "fz", "pac0", "pac1", "pdc", "tac", "tdc", *ELECTRODES)
_SINGLE = ("pdc", "tdc", "tac")
_XYZ, _WXYZ = ("x", "y", "z"), ("x", "y", "z", "w")
# Matrices without names: role -> names of their columns; further columns may follow if `more`
_ROLES = {
    "electrodes": (ELECTRODES, False),
    "force": (("Fx", "Fy", "Fz"), False),
    "wrench": (("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"), False),
    "position": (tuple(f"pos{a}" for a in _XYZ), True),
    "orientation": (tuple(f"q{a}" for a in _WXYZ), True),
    **{name: ((name,), False) for name in _SINGLE},
    "pac": (tuple(f"pac{k}" for k in range(1, NPAC + 1)), False),
    "ruppel": (RUPPEL, False),
}
_TURNED = ("electrodes", "force", "wrench")  # may have time along the columns
# row length that no table of a BioTac reaches; a table with fewer rows and columns is a few samples
_LONG = 40


def read_text(path: pathlib.Path, content: bytes, role: str | None = None) -> list[Stream]:
    """Streams of a text file.

    Args:
      path: for names and errors. content: of the file, not packed.
      role: electrodes, force or tdc, the required content; None: by names and shape.

    Raises:
      ValueError: no table of numbers, or an ambiguous one; the text has line and remedy.
    """
    names = _ROLES[role][0] if role else None
    needed = f"{len(names)} columns of numbers, {_range(names)}" if names else "columns of numbers"
    table = parse_table(path, content, needed)
    known = [name for name in table.names or () if place_of(name) or is_time(name)]
    if any(place_of(name) for name in known):
        return _named(table, role)
    return read_matrix(table, role)


def _named(table, role):
    """A table with a header. Empty cells are missing values. For electrodes that are not dead they need a
    clock, since rows without electrodes are dropped."""
    columns, known = {}, [name for name in table.names if place_of(name) or is_time(name)]
    clock = _clock(table)
    twice = [name for name in dict.fromkeys(known) if known.count(name) > 1]
    if twice:
        raise ValueError(f"{table.path} has several columns called {', '.join(twice)}: rename or remove them")
    for k, name in enumerate(table.names):
        place = place_of(name)
        if place is not None:
            gaps = place.field != "electrodes" or clock is not None or table.lost(k)
            columns[name] = table.numbers([k], [name], gaps=gaps)[:, 0]
        elif name == clock:
            columns[name] = table.clock(k, name)
        else:
            columns[name] = _stamps(table, k, name)
    notes = [
        *table.notes,
        *([] if clock or any(map(is_stamp, table.names)) else _like_clocks(table, columns)),
    ]
    streams = make_streams(table.path.name, columns, notes)
    if role and not any(role in stream.fields for stream in streams):
        raise ValueError(f"{table.path} has no columns {_range(_ROLES[role][0])}: its header must name them")
    if role in ("force", "tdc"):  # beside the electrodes of another file
        wanted = {role, "torque"} if role == "force" else {role}
        for stream in streams:
            stream.fields = {name: value for name, value in stream.fields.items() if name in wanted}
        streams = [stream for stream in streams if stream.fields]
    return streams


def _clock(table):
    """Name of the clock column, None without: the first that can be read, or the first if none can."""
    clocks = [(k, name) for k, name in enumerate(table.names) if is_time(name) and place_of(name) is None]
    for k, name in clocks:
        try:
            table.clock(k, name)
            return name
        except ValueError:
            pass
    return clocks[0][1] if clocks else None


def _like_clocks(table, columns):
    """Note on a table without a clock that has a column like one."""
    for k, name in enumerate(table.names):
        if name not in columns or len(columns[name]) or len(table.cells) < 3:
            continue  # known
        try:
            step = np.diff(table.clock(k, name))
        except ValueError:
            continue
        if (step > 0).all() and not (step == 1).all():  # not a row counter
            return [f"{table.path.name}: {name} increases from row to row: call it time if it is the clock"]
    return []


def _stamps(table, column, name):
    """A clock of stamps, () of anything else: unused columns may have any content."""
    try:
        return table.clock(column, name) if is_stamp(name) or is_part_of_stamp(name) else ()
    except ValueError:
        return ()


def read_matrix(table: Table, role: str | None = None) -> list[Stream]:
    """Streams of a matrix without names; role: as for `read_text`.

    Raises:
      ValueError: an ambiguous width, or cells that are not numbers.
    """
    path, width, n = table.path, table.width, len(table.cells)
    for name in table.names or ():
        other_unit(name)
    role = "ruppel" if width == len(RUPPEL) else role or _role(path, n, width)
    names, more = _ROLES[role]
    if role == "electrodes":
        names = _electrodes(n, width)
    notes = list(table.notes)
    if role in _TURNED and not _fits(width, names) and _across(n, width, names):
        notes.append(f"{path.name} is {n} x {width}, time along its rows: turned")
        value = table.numbers(list(range(width)), [f"column {k + 1}" for k in range(width)]).T
        clock = n == len(names) + 1
        if clock and not (np.diff(value[:, 0]) > 0).all():
            raise ValueError(
                f"{path}: {n} rows of {width} numbers could be a clock above {len(names)} rows "
                f"({_range(names)}), but those of line {table.lines[0]} do not increase: turn the table, and "
                "name its columns in a header"
            )
        return make_streams(path.name, dict(zip(["time", *names] if clock else names, value.T)), notes)
    clock = width == len(names) + 1 and not more  # in the first column
    columns = ["time", *names] if clock else [*names, *(f"column {k + 1}" for k in range(len(names), width))]
    called = columns[:width] if len(columns) > width else columns
    if clock:
        value = np.column_stack([table.clock(0, "time"), _matrix(table, role, 1, called)])
    else:
        value = _matrix(table, role, 0, called)
    if width < len(names) or (width > len(names) and not (more or clock)):
        raise ValueError(_wrong_width(table, names))
    if clock and not (np.diff(value[:, 0]) > 0).all():
        raise ValueError(_wrong_width(table, names))
    if clock and n > 2 and value[0, 0] in (0, 1) and (np.diff(value[:, 0]) == 1).all():
        notes.append(f"{path.name}: the first column counts the rows: it was not taken for a clock")
        value, clock = value[:, 1:], False
    if role == "electrodes" and width == len(names) and n > _LONG and (np.diff(value[:, 0]) > 0).all():
        raise ValueError(
            f"{path}: the first of {width} columns rises in every row, as a clock does, which leaves "
            f"{width - 1} electrodes: give those of a {' or a '.join(design.title for design in designs())}, "
            "or name the columns in a header"
        )
    if role == "electrodes" and n == width == len(names):
        notes.append(f"{path.name} is {n} x {n}: its rows were taken for time")
    if more and width > len(names):
        notes.append(f"{path.name}: left out columns {len(names) + 1} to {width}")
    if role == "orientation":
        notes.append(f"{path.name}: taken for quaternions x y z w, ROS' order")
    return make_streams(path.name, dict(zip(columns if clock else names, value.T)), notes)


def _matrix(table, role, first, called):
    """Numbers of all columns from the first on; dead electrodes beside others may have none."""
    columns = list(range(first, table.width))
    lost = [role == "electrodes" and table.lost(k) for k in columns]
    return table.numbers(columns, called[first:], lost if not all(lost) else False)


def _fits(count, names):
    """Whether the number of columns or rows matches the names, with or without a clock in front."""
    return count in (len(names), len(names) + 1)


def _across(n, width, names):
    """Whether n rows have those names with time along the columns: always for 19 rows, for others if long."""
    known = [design.nelectrode for design in designs()]
    return n == len(names) in known or (_fits(n, names) and width >= _LONG)


def _electrodes(n, width):
    """Names of the electrodes of the fingertip whose number matches the table's columns or rows."""
    known = [design.electrodes for design in designs()]
    wide, long = ([names for names in known if _fits(count, names)] for count in (width, n))
    return next(iter([*wide, *(names for names in long if _across(n, width, names))]), ELECTRODES)


def _role(path, n, width):
    name = path.name.lower()
    if width >= 4 and re.search("orient|quat|rotation", name):
        return "orientation"
    if width >= 3 and re.search("pos", name):
        return "position"
    channel = re.search("(?:^|[^a-z])(pac|pdc|tdc|tac)(?:[^a-z]|$)", name)
    if channel and _fits(width, _ROLES[channel[1]][0]):
        return channel[1]
    wrench = re.search("force|wrench|ft|cw", name)
    kinds = ("electrodes", "force", "wrench") if wrench else ("electrodes", "force")
    columns = {kind: _electrodes(n, width) if kind == "electrodes" else _ROLES[kind][0] for kind in kinds}
    for fits in (lambda names: _fits(width, names), lambda names: _across(n, width, names)):
        for kind, names in columns.items():
            if fits(names):
                return kind
    raise ValueError(
        f"{path}: a table of {n} rows and {width} columns without names could be anything: give the "
        f"electrodes ({_known()}), 3 columns (force [N]), the clock before them if you like, or name all "
        "columns in a header, as e1, e2, ..., pdc, pac1, pac2, ..., tdc, tac, Fx, Fy, Fz, time"
    )


def _wrong_width(table, names):
    where = f"{table.path}, line {table.lines[0]}"
    said = f"{where}: {table.width} columns, {len(names)} are needed ({_range(names)})"
    if names == ELECTRODES:
        said = f"{said}, as of one of: {_known()}"
    if table.names:
        named = ", ".join([name for name in table.names if not is_time(name)][:8])
        return f"{said}; nothing in its header is known of a BioTac ({named}): name them {_range(names)}"
    return f"{said}; or name all columns in a header"


def _known():
    return ", ".join(design.title for design in designs())


def _range(names):
    return f"{names[0]}..{names[-1]}" if len(names) > 3 else " ".join(names)
