"""Recordings of real sensors as data sets: interactions of kind "recorded", without simulation."""

import pathlib
import typing
from collections.abc import Callable, Sequence

import numpy as np

from ..files import refuse_existing
from ..geometry.design import SINGLES
from ..recordings import Recording, load, warnings
from .schema import Interaction
from .splits import assign
from .store import shard_path, write_shard

_GAP = 0.5  # [s] without a sample ends an interaction


class Measured(typing.NamedTuple):
    """Rows of a recording as a set's columns.

    Attributes:
      counts: (n, nchannel), NaN if a channel was not recorded. pac: (n, npac), None without raw counts.
      wrench: (n, 6) in the recording's frame, None without forces. notes: assumptions.
    """

    counts: np.ndarray
    pac: np.ndarray | None
    wrench: np.ndarray | None
    notes: list[str]


def measured(recording: Recording) -> Measured:
    """Columns of a data set from a recording.

    Raises:
      ValueError: the electrodes cannot be converted to raw counts.
    """
    electrodes, notes = recording.counts()
    n, first = electrodes.shape
    counts = np.full((n, first + len(SINGLES)), np.nan, np.float32)
    counts[:, :first] = electrodes
    pac = None
    for column, channel in enumerate(SINGLES, first):
        value = getattr(recording, channel)
        if value is not None and recording.unit(channel) == "counts":
            counts[:, column] = value[:, -1] if channel == "pac" else value
            pac = value.astype(np.float32) if channel == "pac" else pac
    wrench = None
    if recording.force is not None or recording.torque is not None:
        wrench = np.full((n, 6), np.nan, np.float32)
        for columns, value in ((slice(0, 3), recording.force), (slice(3, 6), recording.torque)):
            wrench[:, columns] = np.nan if value is None else value
    return Measured(counts, pac, wrench, notes)


def interactions(recording: Recording, block: float | None = None) -> list[Interaction]:
    """A recording, split where its clock has a gap of more than 0.5 s.

    Electrodes become `measured_counts`, PAC also `measured_pac`, forces `measured_wrench`; the object's pose
    becomes `indenter_pos`, the contact position `contact_pos`, in the recording's frame.

    Args:
      block: also splits into this length [s]. Neighbouring blocks have the same drift, so they are similar.

    Raises:
      ValueError: the electrodes cannot be converted to raw counts.
    """
    n, found = len(recording), measured(recording)
    cut = set(np.flatnonzero(np.diff(recording.time) > _GAP) + 1)
    if block is not None:
        number = np.floor((recording.time - recording.time[0]) / block + 1e-9)
        cut |= set(np.flatnonzero(np.diff(number)) + 1)
    edge = [0, *sorted(int(k) for k in cut), n]
    description = {"source": recording.source, "frame": recording.frame, "rate": recording.rate_source}
    out = []
    for a, b in zip(edge, edge[1:]):
        rows = slice(a, b)
        out.append(
            Interaction(
                recording.name if len(edge) == 2 else f"{recording.name}-{len(out):05d}",
                recording.object or "unknown",
                "recorded",
                "train",
                0,
                {**description, "rows": [a, b], "notes": [*recording.notes, *found.notes]},
                recording.time[rows],
                contact_pos=None if recording.contact_pos is None else recording.contact_pos[rows],
                indenter_pos=_whole(recording.object_pos, rows),
                indenter_quat=_whole(recording.object_quat, rows),
                measured_counts=found.counts[rows],
                measured_pac=None if found.pac is None else found.pac[rows],
                measured_wrench=None if found.wrench is None else found.wrench[rows],
            )
        )
    return out


def _whole(value, rows):
    """Rows of a pose, None if some are missing."""
    return value[rows] if value is not None and np.isfinite(value[rows]).all() else None


def import_recordings(
    paths: Sequence[pathlib.Path | str],
    out: pathlib.Path | str,
    seed: int = 0,
    block: float | None = None,
    report: Callable[[str], object] | None = None,
    **options: object,
) -> int:
    """Reads files and writes a set, a shard for each file, with a split by interaction.

    Args:
      paths: files. out: folder of the set; it must not contain one.
      seed: of the split. block: see `interactions`. options: of `recordings.load`.
      report: called with each remark on a recording.

    Returns:
      number of interactions.

    Raises:
      ValueError, FileNotFoundError: see `recordings.load` and `interactions`.
    """
    paths, out = [pathlib.Path(path) for path in paths], pathlib.Path(out)
    if len(set(paths)) < len(paths):
        raise ValueError("a file is given twice: give each once")
    refuse_existing(*out.glob("shard-*.h5"))
    groups, kinds = [], set()
    for path in paths:
        found = load(path, **options)
        kinds |= {r.design for r in found}
        groups.append([one for r in found for one in interactions(r, block)])
        for one, line in [(r, line) for r in found for line in warnings(r) if report]:
            report(f"{one.name}: {line}")
    if len(kinds) > 1:
        titles = " and of ".join(sorted(one.title for one in kinds))
        raise ValueError(f"the files hold sensors of {titles}: make a set of each")
    design = kinds.pop()
    subset = iter(assign(sum(len(group) for group in groups), seed))
    for number, group in enumerate(groups):
        for one in group:
            one.split = str(next(subset))
        # a column exists in all interactions of a shard or in none
        for name in ("contact_pos", "indenter_pos", "indenter_quat", "measured_pac", "measured_wrench"):
            if any(getattr(one, name) is None for one in group):
                for one in group:
                    setattr(one, name, None)
        about = {"source": paths[number].name}
        write_shard(shard_path(out, number), group, attributes=about, design=design)
    return sum(len(group) for group in groups)
