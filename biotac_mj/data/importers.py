"""Recordings of real sensors, as they were published or logged, into the native store: interactions of kind
"recorded", no simulation."""

import csv
import pathlib

import h5py
import numpy as np

from ..reading import Array, read_hdf5, reading
from ..sensor.channels import CHANNELS, ELECTRODES, NELECTRODE, check_counts, check_force
from .columns import read_columns
from .schema import Interaction
from .splits import assign
from .store import shard_path, write_shard

__all__ = ["FORMATS", "RUPPEL_COLUMNS", "import_recordings", "read_nvidia", "read_ruppel", "read_text"]

_NVIDIA = {
    "electrode_vals/data": Array(("n", NELECTRODE)),
    "contact_loc/data": Array(("n", 3)),
    "force_vec/data": Array(("n", 3)),
}
_REACH = 0.5  # [m] a contact further from the file's origin is not in metres
_JUMP = 0.5e-3  # [m] between two samples of one trajectory of NVIDIA's files
_GAP = 0.5  # [s] without a sample ends an interaction of a log with times
RUPPEL_COLUMNS = (
    "time",
    "px",
    "py",
    "pz",
    "fx",
    "fy",
    "fz",
    "pac0",
    "pac1",
    "pdc",
    "tac",
    "tdc",
    *ELECTRODES,
)


def read_nvidia(
    path: pathlib.Path | str, rate: float = 100.0, objects: list | None = None
) -> list[Interaction]:
    """NVIDIA's biotac{1,2,3}.hdf5 (Sundaralingam et al., ICRA 2019; Narang et al., 2021): one interaction for
    each trajectory.

    Keys electrode_vals/data (n, 19), contact_loc/data (n, 3) [m], force_vec/data (n, 3) [N],
    indenter_type/data (n,) or (n, 1); the last may be missing. A trajectory ends where contact_loc jumps by
    more than 0.5 mm or the indenter changes.

    Args:
      path: the file.
      rate: of the samples [Hz]; the file has no times.
      objects: names of indenter types 0, 1, ...; None calls them indenter_0 and so on.

    Returns:
      Interactions: contact points as `indenter_pos` and forces as `measured_wrench`, both in the file's frame
        (the torque is NaN).

    Raises:
      FileNotFoundError, ValueError: no such file, or one of another layout; the text names the key.
    """
    path, what = pathlib.Path(path), "recording of NVIDIA's"
    remedy = f"give an HDF5 file with {', '.join(_NVIDIA)} and indenter_type/data, one row for each sample"
    data, _ = read_hdf5(path, what, remedy, _NVIDIA)
    electrodes, place, force = data.values()
    n = len(electrodes)
    if not n:
        raise ValueError(f"{path} has no samples: {remedy}")
    kind = _indenter_types(path, n)
    if np.abs(place).max() > _REACH:
        raise ValueError(f"contact_loc/data of {path} reaches {np.abs(place).max():.3g}: metres are needed")
    jump = np.linalg.norm(np.diff(place, axis=0), axis=1) > _JUMP
    pieces = _pieces(jump | (np.diff(kind) != 0), n)
    out = []
    for number, (a, b) in enumerate(pieces):
        k = kind[a]
        if objects is not None and not 0 <= k < len(objects):
            raise ValueError(
                f"{path} has indenter type {k}, but {len(objects)} object names were given: name all of them"
            )
        name = f"indenter_{k}" if objects is None else objects[k]
        out.append(
            _recorded(
                f"{path.stem}-{number:05d}",
                name,
                np.arange(b - a) / rate,
                electrodes[a:b],
                force[a:b],
                place[a:b],
                {"format": "nvidia", "rows": [a, b], "rate": rate, "frame": "the file's"},
                path,
            )
        )
    return out


def _indenter_types(path, n):
    """(n,) whole numbers; zeros where the file has none."""
    name = "indenter_type/data"
    with reading(path, "recording of NVIDIA's", "fetch it again"), h5py.File(path) as file:
        kind = np.asarray(file[name][()], float).reshape(-1) if name in file else np.zeros(n)
    if len(kind) != n or not (np.isfinite(kind) & (kind == np.rint(kind))).all():
        raise ValueError(
            f"{name} of {path} has {len(kind)} entries for {n} samples, or some that are no whole numbers: "
            "it must have the number of the indenter for each sample"
        )
    return kind.astype(int)


def read_ruppel(path: pathlib.Path | str, object: str = "sphere_4mm") -> list[Interaction]:  # noqa: A002 - the column's name
    """Ruppel et al.'s CSV (IAS-15, 2019): time, contact point, force, pac0, pac1, pdc, tac, tdc, e1..e19; a
    sphere of 2 mm radius.

    With or without a header (RUPPEL_COLUMNS in any order, or these 31 columns in this order). An interaction
    ends where time jumps by more than 0.5 s or runs back. Of the two PAC samples the later is kept.

    Raises:
      FileNotFoundError, ValueError: no such file, a missing column, a row that is no numbers; the text names
        it.
    """
    path = pathlib.Path(path)
    with reading(path, "recording", f"give a CSV file with columns {', '.join(RUPPEL_COLUMNS)}"):
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    if not rows:
        raise ValueError(
            f"{path} is empty: it needs {len(RUPPEL_COLUMNS)} columns, {', '.join(RUPPEL_COLUMNS)}"
        )
    order, first = list(range(len(RUPPEL_COLUMNS))), 0
    if not _is_number(rows[0][0]):
        header, first = [name.strip().lower() for name in rows[0]], 1
        missing = [name for name in RUPPEL_COLUMNS if name not in header]
        if missing:
            raise ValueError(
                f"{path} has no column {', '.join(missing)}: its header must have {', '.join(RUPPEL_COLUMNS)}"
            )
        order = [header.index(name) for name in RUPPEL_COLUMNS]
    if not rows[first:]:
        raise ValueError(f"{path} has a header and no rows: one for each sample is needed")
    value = _numbers(
        path,
        [[row[i] if i < len(row) else "" for i in order] for row in rows[first:]],
        first + 1,
        RUPPEL_COLUMNS,
    )
    column = {name: value[:, i] for i, name in enumerate(RUPPEL_COLUMNS)}
    step = np.diff(column["time"])
    out = []
    for number, (a, b) in enumerate(_pieces((step > _GAP) | (step <= 0), len(value))):
        extra = {
            "pdc": column["pdc"][a:b],
            "pac": column["pac1"][a:b],
            "tac": column["tac"][a:b],
            "tdc": column["tdc"][a:b],
        }
        out.append(
            _recorded(
                f"{path.stem}-{number:05d}",
                object,
                column["time"][a:b],
                value[a:b, 12:],
                value[a:b, 4:7],
                value[a:b, 1:4],
                {"format": "ruppel", "rows": [a, b], "frame": "the file's"},
                path,
                extra,
            )
        )
    return out


def read_text(
    path: pathlib.Path | str,
    force: pathlib.Path | str | None = None,
    rate: float = 100.0,
    block: float | None = None,
    object: str = "plate",
) -> list[Interaction]:  # noqa: A002
    """A log of 19 columns e1..e19 without times, and perhaps one of 3 columns Fx Fy Fz [N] beside it
    (`data.columns`).

    Args:
      path: electrodes. force: forces, as many rows.
      rate: of the rows [Hz].
      block: cuts the log into interactions of this length [s]; None keeps it whole. Cutting hides drift:
        neighbours are alike.
      object: what touched.

    Raises:
      FileNotFoundError, ValueError: no such file, a wrong number of columns or rows, text that is no number.
    """
    if not (np.isfinite(rate) and rate > 0) or (block is not None and not block > 0):
        raise ValueError(f"rate is {rate} Hz and block is {block} s: both must be positive")
    path = pathlib.Path(path)
    counts = read_columns(path, ELECTRODES)
    newtons = None if force is None else read_columns(force, ("Fx", "Fy", "Fz"))
    if newtons is not None and len(newtons) != len(counts):
        raise ValueError(
            f"{path} has {len(counts)} rows and {force} has {len(newtons)}: "
            "they must be samples of the same instants"
        )
    n = len(counts)
    size = n if block is None else max(1, int(round(block * rate)))
    out = []
    for number, a in enumerate(range(0, n, size)):
        b = min(a + size, n)
        out.append(
            _recorded(
                f"{path.stem}-{number:05d}",
                object,
                np.arange(a, b) / rate,
                counts[a:b],
                None if newtons is None else newtons[a:b],
                None,
                {"format": "text", "rows": [a, b], "rate": rate},
                path,
            )
        )
    return out


FORMATS = {"nvidia": read_nvidia, "ruppel": read_ruppel, "text": read_text}


def import_recordings(
    paths: list, out: pathlib.Path | str, format: str | None = None, seed: int = 0, **options: object
) -> int:  # noqa: A002
    """Reads files and writes a set, a shard for each file, split by interaction.

    Args:
      paths: files of one format.
      out: folder of the set; it must not hold one already.
      format: of FORMATS; None goes by the ending: .hdf5 and .h5 nvidia, .csv ruppel, others text.
      seed: of the split.
      options: of the format's reader.

    Returns:
      how many interactions.

    Raises:
      ValueError, FileNotFoundError: see the readers.
    """
    paths, out = [pathlib.Path(path) for path in paths], pathlib.Path(out)
    if len(set(paths)) < len(paths):
        raise ValueError("a file is given twice: give each once")
    if list(out.glob("shard-*.h5")):
        raise ValueError(f"{out} holds a set already: choose another folder, or delete it")
    if format is None:
        format = {".hdf5": "nvidia", ".h5": "nvidia", ".csv": "ruppel"}.get(paths[0].suffix, "text")  # noqa: A001
    if format not in FORMATS:
        raise ValueError(f"unknown format {format!r}: choose one of {', '.join(FORMATS)}")
    groups = [FORMATS[format](path, **options) for path in paths]
    part = iter(assign(sum(len(group) for group in groups), seed))
    for number, group in enumerate(groups):
        for one in group:
            one.split = str(next(part))
        write_shard(
            shard_path(out, number), group, attributes={"format": format, "source": paths[number].name}
        )
    return sum(len(group) for group in groups)


def _recorded(name, what, time, electrodes, force, point, parameters, path, extra=None):
    """An Interaction of measured things only."""
    check_counts(electrodes, str(path), parameters["rows"][0])
    if force is not None:
        check_force(force, str(path))
    counts = np.full((len(time), len(CHANNELS)), np.nan, np.float32)
    counts[:, :NELECTRODE] = electrodes
    for channel, value in (extra or {}).items():
        counts[:, CHANNELS.index(channel)] = value
    wrench = None
    if force is not None:
        wrench = np.full((len(time), 6), np.nan, np.float32)
        wrench[:, :3] = force
    parameters = {**parameters, "rows": [int(row) for row in parameters["rows"]], "source": path.name}
    return Interaction(
        name,
        what,
        "recorded",
        "train",
        0,
        parameters,
        np.asarray(time, float),
        indenter_pos=point,
        measured_counts=counts,
        measured_wrench=wrench,
    )


def _pieces(cut, n):
    """Pieces (first, beyond) of n rows; cut (n - 1,) says after which rows one ends."""
    edge = np.flatnonzero(cut) + 1
    return list(zip(np.r_[0, edge].tolist(), np.r_[edge, n].tolist())) if n else []


def _numbers(path, rows, first, names):
    try:
        value = np.array(rows, float)
        if np.isfinite(value).all():
            return value
    except ValueError:
        pass
    for i, row in enumerate(rows):
        for name, cell in zip(names, row):
            if not (_is_number(cell) and np.isfinite(float(cell))):
                raise ValueError(
                    f"line {first + i} of {path}: {name} is {cell!r}, not a finite number; "
                    "correct or remove the line"
                )
    raise ValueError(f"{path} has rows of different length: every row needs {len(names)} columns")


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return False
    return True
