"""Logs as text: named columns of numbers, one row per sample."""

import pathlib

import numpy as np

__all__ = ["read_columns"]


def read_columns(path: pathlib.Path | str, names: list | tuple | None) -> np.ndarray:
    """(n, len(names)) numbers of a text file, blanks, tabs, commas or semicolons between them; lines that
    begin with # or % are comments.

    Without a header the file has these columns in this order and no others. A header (one line without any
    number) that has all the names, in any order and among others, says which columns they are, upper or lower
    case; one of other words is passed over.

    Args:
      path: file. names: of the columns.

    Raises:
      FileNotFoundError: no such file.
      ValueError: no rows, another number of columns, a header without some of the names, or a cell that is no
        finite number; the text names line, column and remedy.
    """
    path, wanted = pathlib.Path(path), [name.lower() for name in names]
    range_ = f"{names[0]}..{names[-1]}" if len(names) > 3 else " ".join(names)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give a text file with {len(names)} columns, {range_}")
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    rows = [(i, line.replace(",", " ").replace(";", " ").split()) for i, line in enumerate(lines, 1)]
    rows = [(i, row) for i, row in rows if row and not row[0].startswith(("#", "%"))]
    order, width = list(range(len(names))), len(names)
    if rows and not any(map(_is_number, rows[0][1])):
        header = [cell.strip("\"'").lower() for cell in rows.pop(0)[1]]
        missing = [name for name, low in zip(names, wanted) if low not in header]
        if not missing:
            order, width = [header.index(name) for name in wanted], len(header)
        elif len(missing) < len(names):
            raise ValueError(f"{path} has no columns {', '.join(missing)}: its header must name {range_}")
    if not rows:
        raise ValueError(
            f"{path} is empty: {len(names)} columns of numbers, {range_}, one row per sample, are needed"
        )
    for i, row in rows:
        if len(row) != width:
            raise ValueError(
                f"{path}, line {i}: {len(row)} columns, {width} are needed ({range_}); leave out times and "
                "other channels, or name all "
                "columns in a header"
            )
    cells = [[row[k] for k in order] for _, row in rows]
    try:
        value = np.array(cells, dtype=float)
        good = np.isfinite(value)
    except ValueError:
        good = np.array([[_is_number(cell) and np.isfinite(float(cell)) for cell in row] for row in cells])
    if not good.all():
        (r, c), count = np.argwhere(~good)[0], (~good).sum()
        raise ValueError(
            f"{path}, line {rows[r][0]}: {names[c]} is {cells[r][c]!r}, not a finite number ({count} such "
            "cells): a gap cannot be guessed; "
            "cut the recording there or log it again"
        )
    return value


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return False
    return True
