"""Text logs: columns of numbers, one row per sample, with or without names."""

import csv
import dataclasses
import datetime
import gzip
import io
import pathlib
import re
import zlib

import numpy as np

from ...reading import Unfit
from .names import COUNTED, UNITS, is_time, place_of

_HEX = re.compile(r"0x[0-9a-f]+", re.I)
_BARE_HEX = re.compile(r"(?=.*\d)[0-9a-f]{1,4}", re.I)  # without 0x, up to 16 bits
_TIME_OF_DAY = re.compile(r"\[?(\d{1,2}):(\d{2}):(\d{1,2}(?:\.\d*)?)\]?")
_DAY = 86400.0  # [s]
_CLOCKS = "seconds, a time of day as 12:34:56.7, or date and time in one word as 2026-01-31T12:34:56.7"
_LIST = re.compile(r"[\[(](\s*[-+.\deE]+(?:[\s,]+[-+.\deE]+)+,?\s*)[\])]")
_START = 4096  # characters to search for a list
_KNOWN_UNITS = {"s", "sec", "ms", "us", "ns", *UNITS}
_EMPTY = ("", "nan", "-nan", "none", "null", "na", "n/a")  # cells without a number
_MOST = 2**30  # bytes that are read at once: 4 hours of a native log; guards against decompression bombs


@dataclasses.dataclass
class Table:
    """A log as text.

    Attributes:
      path: of the file, for errors.
      names: of the columns, as in the header; None without a header.
      lines: (n,) line number of each row. cells: n rows of words, all of one length.
      notes: what was ignored or interpreted.
    """

    path: pathlib.Path
    names: list[str] | None
    lines: list[int]
    cells: list[list[str]]
    notes: list[str] = dataclasses.field(default_factory=list)

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.cells[0])

    def lost(self, column: int) -> bool:
        """Whether most cells of a column are empty or nan, as of a dead electrode."""
        return np.mean([row[column].lower() in _EMPTY for row in self.cells]) > 0.5

    def numbers(self, columns: list[int], names: list[str], gaps: bool | list[bool] = False) -> np.ndarray:
        """(n, len(columns)) numbers of these columns, called `names` in errors.

        Args:
          gaps: whether empty cells and nan are read as NaN, of all columns or of each.

        Raises:
          ValueError: a cell is not a finite number; the text has line, column and remedy.
        """
        cells = [[row[k] for k in columns] for row in self.cells]
        try:
            value = np.array(cells, dtype=float)
            good = np.isfinite(value)
        except ValueError:
            value = None
        if value is None or not good.all():
            empty = np.array([[c.lower() in _EMPTY for c in row] for row in cells]) & gaps
            value = np.array([[_number(c) for c in row] for row in cells])
            value[empty] = np.nan
            good = empty | np.isfinite(value)
        if not good.all():
            (r, c), count = np.argwhere(~good)[0], (~good).sum()
            raise ValueError(
                f"{self.path}, line {self.lines[r]}: {names[c]} is {cells[r][c][:40]!r}, not a finite number "
                f"({count} such cells): {_remedy(cells[r][c], r)}"
            )
        return value

    def clock(self, column: int, name: str) -> np.ndarray:
        """(n,) times of this column [s]: numbers; dates (ISO 8601) since 1970, UTC unless stated; or times of
        day (12:34:56.7), continued past midnight.

        Raises:
          ValueError: as `numbers`; or a cell has another form than the first one.
        """
        first = self.cells[0][column]
        read = next((read for read in (_date, _time_of_day) if read(first) is not None), None)
        if read is None or _is_number(first):
            return self.numbers([column], [name])[:, 0]
        found = [read(row[column]) for row in self.cells]
        if None in found:
            r = found.index(None)
            raise ValueError(
                f"{self.path}, line {self.lines[r]}: {name} is {self.cells[r][column][:40]!r}, no time as "
                f"{first[:40]!r} in line {self.lines[0]}: correct or remove the line"
            )
        time = np.array(found)
        if read is _time_of_day:
            time += _DAY * np.cumsum(np.diff(time, prepend=time[0]) < -_DAY / 2)
        return time


def open_bytes(path: pathlib.Path | str) -> bytes:
    """Content of a file, gzipped or not.

    Raises:
      FileNotFoundError: no such file. ValueError: it is damaged, or larger than 1 GB.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: no such file: check its name, or give a recording (docs/howto/file_formats.md)"
        )
    with open(path, "rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    try:
        with gzip.open(path, "rb") if packed else open(path, "rb") as file:
            content = file.read(_MOST + 1)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{path} is a damaged .gz file ({error}): copy it again") from None
    if len(content) > _MOST:
        raise ValueError(f"{path} holds more than {_MOST >> 30} GB: cut it into pieces")
    return content


def parse_table(path: pathlib.Path | str, content: bytes, needed: str = "columns of numbers") -> Table:
    """Parses text with columns of numbers, separated by blanks, tabs, commas, semicolons or bars. Lines that
    begin with # or % are comments. Numbers may have decimal commas, between commas if quoted.

    A header is one line without any number, or the last comment before the numbers if it has one word per
    column. A line of known units may follow it. Cells that are lists of numbers, like `"[1, 2, 3]"`, become
    separate columns. An incomplete last line is ignored: the logger was stopped while it wrote.

    Args:
      needed: description of the expected content, for errors.

    Raises:
      ValueError: no text, no rows, rows of different length or of another one than the header's, or one
        without any number.
    """
    path = pathlib.Path(path)
    if b"\0" in content[:4096] and not content.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise ValueError(
            f"{path} is no recording: it holds bytes, not text; docs/howto/file_formats.md lists what is read"
        )
    wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    text = content.decode("utf-16" if wide else "utf-8-sig", errors="replace")
    text, lists = _unpacked(text)
    comment, rows, notes = "", [], []
    for i, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if line.startswith(("#", "%")):
            comment = comment if rows else line.lstrip("#% ")
        elif line:
            rows.append((i, line))
    if not rows:
        raise ValueError(f"{path} is empty: {needed}, one row per sample, are needed")
    mark = _mark(rows[len(rows) // 2][1])
    split = [(i, _words(line, mark)) for i, line in rows]
    names = None
    for i, row in split[:2]:
        if any(map(_HEX.fullmatch, row)):
            raise Unfit(f"{path}, line {i}: {_remedy(next(filter(_HEX.fullmatch, row)))}")
    if not any(map(_is_number, split[0][1])):
        names = [_name(word) or f"column {k}" for k, word in enumerate(split.pop(0)[1], 1)]
        names = [
            f"{name}_{k}" if name in lists else name
            for name in names
            for k in (range(lists[name]) if name in lists else (0,))
        ]
        if len(split) > 1 and (units := _units(split[0][1], names)):
            names = units
            notes.append(f"{path.name}: line {split.pop(0)[0]} was taken for units")
        if not split:
            raise ValueError(f"{path} is empty: it has a header and no rows; one for each sample is needed")
    elif [word for word in split[0][1] if word] in _numberings(len(split[0][1])) and len(split) > 1:
        split.pop(0)  # a table saved with column numbers as names
    width = len(split[0][1])
    if names and width > len(names) and all(row[len(names) :] == [""] for _, row in split):
        width = len(names)  # a separator at the end of every row
    elif not names and all(row[-1] == "" for _, row in split):
        width -= 1
    cells = [row[:-1] if len(row) == width + 1 and row[-1] == "" else row for _, row in split]
    if len(cells) > 2 and len(cells[-1]) < width == len(cells[-2]):
        cells.pop()
        notes.append(f"{path.name}: left out the last line, {split.pop()[0]}, which was cut off")
    if (
        names is None
        and len(_words(comment, mark)) == width
        and not any(map(_is_number, _words(comment, mark)))
    ):
        names = [_name(word) for word in _words(comment, mark)]
    if names and len(names) != width and any(place_of(name) or is_time(name) for name in names):
        raise Unfit(
            f"{path}, line {split[0][0]}: {width} columns, and the header names {len(names)}: "
            "which is which? Name every column, also one that counts the rows, and no other"
        )
    for (i, _), row in zip(split, cells):
        if names and not any(map(_is_number, row)) and any(row):
            words = ", ".join(word[:12] for word in row[:3] if word) + (", ..." if len(row) > 3 else "")
            if all(map(_BARE_HEX.fullmatch, row)):
                raise Unfit(f"{path}, line {i}: {_remedy(row[0])}")
            raise Unfit(
                f"{path}, line {i}: no number in it ({words}): remove all lines but one of the header, such "
                "as a row of units; a clock's unit is part of its name, as in time_ms"
            )
        if len(row) != width:
            raise Unfit(
                f"{path}, line {i}: {len(row)} columns, {width} are needed as in line {split[0][0]}: was the "
                "log cut off there? Correct or remove the line"
            )
    return Table(path, names, [i for i, _ in split], cells, notes)


def read_columns(path: pathlib.Path | str, names: list | tuple) -> np.ndarray:
    """(n, len(names)) numbers of a text file, gzipped or not; see `parse_table`.

    A file without a header has exactly these columns in this order. A header with all the names, in any order
    and among others, upper or lower case, selects the columns; another header is ignored.

    Raises:
      FileNotFoundError: no such file.
      ValueError: no rows, another number of columns, a header without some of the names, or a cell that is
        not a finite number; the text has line, column and remedy.
    """
    range_ = f"{names[0]}..{names[-1]}" if len(names) > 3 else " ".join(names)
    if not pathlib.Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file; give a text file with {len(names)} columns, {range_}")
    table = parse_table(path, open_bytes(path), f"{len(names)} columns of numbers, {range_}")
    header = [name.lower() for name in table.names or ()]
    missing = [name for name in names if name.lower() not in header]
    if not missing and table.width != len(header):
        raise ValueError(
            f"{path}, line {table.lines[0]}: {table.width} columns, and the header names {len(header)}: "
            "give each row a number for every name"
        )
    if not missing:
        return table.numbers([header.index(name.lower()) for name in names], list(names))
    if header and len(missing) < len(names):
        raise ValueError(f"{path} has no columns {', '.join(missing)}: its header must name {range_}")
    if table.width != len(names):
        raise ValueError(
            f"{path}, line {table.lines[0]}: {table.width} columns, {len(names)} are needed ({range_}); "
            "leave out times and other channels, or name all columns in a header"
        )
    return table.numbers(list(range(len(names))), list(names))


def _unpacked(text):
    """(text, columns): cells that are lists of numbers, like "[1, 2, 3]" or (1 2 3), split into cells, and
    the number of elements of each such column; (text, {}) if there are none."""
    head, _, rest = text.partition("\n")
    mark = next((one for one in ";|\t," if one in head), ",")
    if "-" in head.split(mark):
        head = mark.join(_of_elements(head.strip().split(mark)))
        text = f"{head}\n{rest}"
    if not _LIST.search(rest[:_START]) or _LIST.search(head):
        return text, {}
    try:
        rows = [row for row in csv.reader(io.StringIO(text), delimiter=mark) if row]
    except csv.Error:  # a cell beyond the reader's limit: the parser of lines reports the cause
        return text, {}
    found = [[_LIST.fullmatch(cell.strip()) for cell in row] for row in rows[1:]]
    many = {_name(name): len(one[1].replace(",", " ").split()) for name, one in zip(rows[0], found[0]) if one}
    if not many:
        return text, {}
    out = [mark.join(rows[0])]
    for row, lists in zip(rows[1:], found):
        words = [one[1].replace(",", " ").split() if one else [cell] for cell, one in zip(row, lists)]
        out.append(mark.join(word for cell in words for word in cell))
    return "\n".join(out), many


def _of_elements(names):
    """Column names for a header in which a dash without a column begins each element of a list, as tools for
    ROS messages write it: tactiles, -, pdc, -, pdc are tactiles, tactiles_0_pdc, tactiles_1_pdc."""
    out, number, whose = [], -1, ""
    for name in names:
        if name == "-":
            number, whose = number + 1, whose if number >= 0 else out[-1] if out else ""
        else:
            out.append(name if number < 0 else f"{whose}_{number}_{name}")
    return out


def _units(row, names):
    """Names with the units in the row below them, None if it has none."""
    words = [re.sub(r"[\s()\[\]*.·]", "", word).lower() for word in row]
    if len(words) != len(names) or not any(words) or not set(words) <= _KNOWN_UNITS | COUNTED:
        return None
    return [f"{name}_{word}" if word in _KNOWN_UNITS else name for name, word in zip(names, words)]


def _numberings(width):
    """Forms of a row that numbers at least three columns; electrode counts never match."""
    return [
        [str(k + base) for k in range(width - less)] for base in (0, 1) for less in (0, 1) if width - less > 2
    ]


def _mark(line):
    """Separator of the numbers in a line; None: blanks or tabs."""
    line = re.sub('"[^"]*"', "", line)
    number = re.compile(r"[-+]?(\d+(,\d+)?|\d*\.\d+|\d+\.)(e[-+]?\d+)?|nan", re.I)
    decimals = all(map(number.fullmatch, line.split()))
    marks = ";|" if decimals and len(line.split()) > 1 else ";|,"
    return next((mark for mark in marks if mark in line), None)


def _words(line, mark):
    if '"' in line:
        line = "".join(part.replace(",", ".") if k % 2 else part for k, part in enumerate(line.split('"')))
    return [word.strip() if mark == "," else word.strip().replace(",", ".") for word in line.split(mark)]


def _name(word):
    return word.strip("'% #")


def _remedy(cell, row=None):
    """Remedy for a cell that is not a number. row: of the table; the first may contain units."""
    if _HEX.fullmatch(cell):
        return f"{cell} is hexadecimal: write decimal numbers, here {int(cell, 16)}"
    if _BARE_HEX.fullmatch(cell) and not _is_number(cell):
        return f"is {cell} hexadecimal? Write decimal numbers, here {int(cell, 16)}"
    if re.search(r"\d[:/-]\d", cell):
        return f"is this a time? What is read is {_CLOCKS}, in a column that the header calls time"
    if row == 0 and re.search("[a-z]", cell, re.I) and cell.lower() not in ("nan", "inf", "-nan", "-inf"):
        return "is this line a row of units, or of the header? Remove it"
    return "a gap cannot be guessed; write the number, or cut the file there"


def _date(text):
    """Seconds since 1970 of a date, None if it is none."""
    try:
        date = datetime.datetime.fromisoformat(text.replace(",", "."))
    except ValueError:
        return None
    return (date if date.tzinfo else date.replace(tzinfo=datetime.UTC)).timestamp()


def _time_of_day(text):
    """Seconds since midnight of 12:34:56.7, None if it is no time of day."""
    found = _TIME_OF_DAY.fullmatch(text.replace(",", "."))
    if found is None:
        return None
    hours, minutes, seconds = int(found[1]), int(found[2]), float(found[3])
    return 3600.0 * hours + 60.0 * minutes + seconds if hours < 24 and minutes < 60 and seconds < 61 else None


def _number(text):
    try:
        return float(text)
    except ValueError:
        return np.inf


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return False
    return True
