"""Touches of a recording: rows, the object's path in the BioTac frame, readings."""

import dataclasses

import numpy as np

from ..data.generation.clearance import Placed, surface_samples
from ..data.generation.plan import Motion
from ..data.importers import measured
from ..geometry.design import SINGLES
from ..geometry.rigid import matrix
from ..geometry.skin_geometry import SkinGeometry
from ..recordings import Recording
from ..recordings.own import rest_of

MOST = 2000  # rows of a touch: its nodes are in memory
_FEWEST = 8  # rows: fewer do not show a press, and `biotac diagnose` rejects them
_GAP = 0.5  # [s] without a row ends a touch
_TARE = 0.5  # [s] before a touch whose mean is the sensor at rest
_INSIDE = 0.1e-3  # [m] least distance from the core, for the skin
_CHUNK = 512  # poses per batch


@dataclasses.dataclass(frozen=True, eq=False)
class Touch:
    """One contact of m rows; row 0 is at rest, and its readings are the sensor's tare.

    Attributes:
      motion: of the object. time: (m,) [s]. counts: (m, nchannel). pac: (m, npac) or None.
      wrench: (m, 6) of the skin on the object, BioTac frame, NaN if unknown.
    """

    motion: Motion
    time: np.ndarray
    counts: np.ndarray
    pac: np.ndarray | None
    wrench: np.ndarray


def pose(numbers: tuple | list) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and rotation (3, 3) of x y z [m], or of these and a quaternion w x y z.

    Raises:
      ValueError: neither three nor seven finite numbers, or an invalid quaternion.
    """
    numbers = np.asarray(numbers, float)
    if numbers.shape not in ((3,), (7,)) or not np.isfinite(numbers).all():
        raise ValueError(f"{numbers.tolist()} is no pose: give x y z [m], or these and qw qx qy qz")
    quat = numbers[3:] if len(numbers) == 7 else np.array([1.0, 0, 0, 0])
    if abs(np.linalg.norm(quat) - 1) > 0.01:
        raise ValueError(f"the quaternion {quat.tolist()} has no unit length: scale it")
    return numbers[:3], matrix(quat / np.linalg.norm(quat))


def biotac_poses(
    recording: Recording, mount: tuple | list, resting: tuple | list | None = None
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """The object's frame in the BioTac frame.

    Args:
      mount: pose of the BioTac frame in the frame of the recorded sensor's pose or, for a stationary sensor
        without one, in that of the object's.
      resting: pose of a stationary object without a recorded one.

    Returns:
      (n, 3) [m] and (n, 3, 3), NaN in rows without a pose; and assumptions.

    Raises:
      ValueError: no pose of the object; the text has a remedy.
    """
    n, notes = len(recording), []
    if recording.object_pos is None and resting is None:
        raise ValueError(
            f"{recording.name} has no pose of the object: record object_pos, give --object-pose X Y Z where "
            "it stood still, or --poses fitted for a plate pressed by hand"
        )
    if resting is not None:
        at, turn = (np.broadcast_to(x, (n, *x.shape)) for x in pose(resting))
    else:
        at, turn = recording.object_pos, recording.object_quat
        if turn is None:
            notes.append("the object's attitude was not recorded: it is taken as upright")
            turn = np.tile([1.0, 0, 0, 0], (n, 1))
        turn = matrix(turn)
    there, mounted = pose(mount)
    if recording.sensor_pos is not None and recording.sensor_quat is not None:
        base = matrix(recording.sensor_quat)
        there, mounted = recording.sensor_pos + base @ there, base @ mounted
    else:
        notes.append("the sensor's pose was not recorded: it stood still where --mount says")
        mounted = np.broadcast_to(mounted, (n, 3, 3))
    back = np.swapaxes(mounted, 1, 2)
    return np.einsum("nij,nj->ni", back, at - there), back @ turn, notes


def touches_of(
    recording: Recording,
    name: str,
    mount: tuple | list,
    resting: tuple | list | None,
    rate: float,
    geometry: SkinGeometry,
    device: str = "cpu",
) -> tuple[list[Touch], list[str]]:
    """All touches of a recording with poses, and notes.

    Args:
      name: of the object, see `data.objects.make_object`. mount, resting: see `biotac_poses`.
      rate: [Hz] of the used rows, at most; geometry: the skin at rest.

    Raises:
      ValueError: no poses, no contact, or no rows at rest where they are needed.
    """
    found = measured(recording)
    pos, mat, notes = biotac_poses(recording, mount, resting)
    notes = [*found.notes, *notes]
    if recording.force is not None and recording.frame != "BioTac":
        notes.append(
            f"its forces are in {recording.frame} frame, of which nothing is known: they are left out of the "
            "set; a Recording whose forces are in the BioTac frame says so by frame='BioTac'"
        )
    known = np.flatnonzero(np.isfinite(pos).all(1) & np.isfinite(mat).all((1, 2)))
    if not len(known):
        raise ValueError(f"{recording.name} has no row with a whole pose: record position and quaternion")
    due = np.floor(recording.time[known] * rate + 1e-6)
    taken = known[np.r_[True, np.diff(due) > 0]]
    pos, mat = pos[taken], mat[taken]
    skin, core = (
        _distances(name, pos, mat, surface_samples(vert, face, device, order), device)
        for vert, face, order in (
            (geometry.vert, geometry.outer_face, 3),
            (geometry.core_vert, geometry.core_face, 1),
        )
    )
    time, contact = recording.time[taken], skin < 0
    cut = np.flatnonzero((np.diff(contact.astype(int)) != 0) | (np.diff(time) > _GAP)) + 1
    pieces = [p for p in np.split(np.arange(len(taken)), cut) if contact[p[0]]]
    if not pieces:
        raise ValueError(
            f"{name} never meets the skin in {recording.name}: it comes no nearer than "
            f"{1e3 * skin.min():.1f} mm (2 mm is as far as is looked); check --object, --mount and units"
        )
    rest, out, short = None, [], []
    rejected = {"begin with no row before the touch": 0, "reach into the core": 0}
    for piece in pieces:
        begins = piece[0] > 0 and time[piece[0]] - time[piece[0] - 1] < _GAP
        if not begins:
            rejected["begin with no row before the touch"] += 1
            continue
        rows = np.arange(piece[0] - 1, min(piece[-1] + 2, len(taken)))[:MOST]
        deep = np.flatnonzero(core[rows] < _INSIDE)
        if len(deep):
            rejected["reach into the core"] += 1
            rows = rows[: deep[0]]
        if len(rows) < _FEWEST:
            short.append(len(rows))
            continue
        before = _before(recording.time, known, taken, contact, rows[0])
        if len(before) < 2 and rest is None:
            rest = _rest(recording, found)
        tare = found.counts[before].mean(0) if len(before) > 1 else rest
        out.append(_touch(recording, found, taken[rows], pos[rows], mat[rows], tare))
    if short:
        rejected[f"have fewer than {_FEWEST} rows at {rate:g} Hz, {max(short)} at most"] = len(short)
    notes += [f"{count} touches {why}: they were cut or left out" for why, count in rejected.items() if count]
    if not out:
        misplaced = len(short) < len(pieces) or rejected["reach into the core"]
        raise ValueError(
            f"none of the {len(pieces)} touches of {recording.name} can be simulated: "
            + "; ".join(f"{count} {why}" for why, count in rejected.items() if count)
            + ": take a higher --at-most, or log more rows of a touch"
            + "; check --mount and --object" * bool(misplaced)
        )
    return out, notes


def _distances(name, pos, mat, points, device):
    """(n,) distance of an object's poses to the nearest of points [m]."""
    parts = []
    for k in range(0, len(pos), _CHUNK):
        placed = Placed(name, len(pos[k : k + _CHUNK]), device)
        placed.place(pos[k : k + _CHUNK], mat[k : k + _CHUNK])
        parts.append(placed.nearest(points))
    return np.concatenate(parts)


def _before(time, known, taken, contact, first):
    """Rows of the recording without contact, up to half a second before row `first` of the used ones."""
    last = np.flatnonzero(contact[:first])
    low = taken[last[-1]] + 1 if len(last) else 0
    rows = known[(known >= low) & (known <= taken[first])]
    return rows[time[rows] > time[taken[first]] - _TARE]


def _rest(recording, found):
    """(nchannel,) counts at rest of a sensor that is always in contact, by its force."""
    if recording.force is None:
        raise ValueError(
            f"{recording.name} has no two rows before a touch, and no force to find its rest from: "
            "log half a second before each touch"
        )
    rest = found.counts.mean(0)
    there = np.isfinite(recording.force).all(1)
    electrodes = found.counts[there, : -len(SINGLES)].astype(float)
    rest[: -len(SINGLES)] = rest_of(electrodes, recording.rate, recording.force[there])["rest"]
    return rest


def _touch(recording, found, rows, pos, mat, tare):
    counts = found.counts[rows].copy()
    counts[0] = tare
    wrench = np.full((len(rows), 6), np.nan, np.float32)
    if recording.frame == "BioTac" and found.wrench is not None:
        wrench = found.wrench[rows]
    parameters = {"poses": "recorded", "recording": recording.name, "rows": [int(rows[0]), int(rows[-1])]}
    return Touch(
        Motion("resimulated", parameters, pos, mat),
        recording.time[rows],
        counts,
        None if found.pac is None else found.pac[rows],
        wrench,
    )
