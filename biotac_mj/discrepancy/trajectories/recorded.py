"""Recordings with the object's poses as trajectories, cut into contacts where the object meets the skin."""

import dataclasses

import numpy as np

from ...data.generation.clearance import Placed, surface_samples
from ...geometry.skins import load_skin
from ...recordings.recording import Recording
from .trajectory import Trajectory

_ROWS = 40  # of a contact: the skin is solved in each, and more of them share their errors
_AFTER = 0.3  # [s] of a contact's end, without touch
# [m] from the skin, or from row to row: on the way elsewhere, where a straight line may cross the finger
_LEFT = 2e-3
# [m] from the skin where nothing touches, whatever the pose, the skin's mesh and its bulge are off by. In the
# last row before the touch logs had 0.1 N and a hundred counts already, and all is compared about row 0.
_APART = 0.4e-3
_WAIT = 50  # median steps of a contact from that row to the touch, at most


def trajectories_of(recordings: list[Recording], skin: str = "coarse") -> tuple[list[Trajectory], list[str]]:
    """The contacts of recordings that hold the object's pose, and notes on what was assumed.

    Where the sensor's pose is there too, object and force are taken to its frame, else they are in it. A
    force that pulls during contact is that on the sensor, and its sign is changed. At most 40 rows of each
    contact are kept, evenly by travel and time, after one row of the approach in which nothing touches.

    Args:
      skin: a touch begins at its undeformed surface.

    Raises:
      ValueError: no pose, no name of the object, no raw counts, or no touch; the text names the remedy.
    """
    geometry = load_skin(skin)
    surface = surface_samples(geometry.vert, geometry.outer_face, "cpu")
    out, notes, clock = [], [], 0.0
    for recording in recordings:
        pos, mat, force = _in_sensor(recording)
        counts, assumed = recording.counts()
        placed = Placed(recording.object, len(recording))
        placed.place(pos, mat)
        gap = placed.nearest(surface)
        found = [
            _contact(recording, clock, rows, free, pos, mat, force, counts)
            for rows, free in _contacts(recording.time, pos, gap)
        ]
        if not found:
            raise ValueError(
                f"{recording.name}: {recording.object} never meets the skin, the smallest gap is "
                f"{1e3 * gap.min():.2f} mm: give poses of its tip in the BioTac's frame, or the sensor's too"
            )
        notes += [f"{recording.name}: {note}" for note in assumed]
        out += found
        clock += float(recording.time[-1] - recording.time[0]) + 1.0
    turned = [np.sum((t.force @ t.heading)[t.depth > 0]) > 0 for t in out if t.force is not None]
    if turned and np.mean(turned) > 0.5:
        notes.append("the force is that on the sensor: turned round")
        out = [t if t.force is None else dataclasses.replace(t, force=-t.force) for t in out]
    return out, notes


def _in_sensor(recording):
    """Position (n, 3), rotation (n, 3, 3) of the object and force (n, 3) or None in the BioTac's frame."""
    from scipy.spatial.transform import Rotation

    where = recording.name
    if recording.object_pos is None or recording.object_quat is None:
        raise ValueError(
            f"{where} lacks the object's pose: give object_pos_x .. z [m] and object_qw .. qz in its rows"
        )
    if not recording.object:
        raise ValueError(f"{where} does not say what touched: add --object, as sphere_7mm")
    values = [recording.object_pos, recording.object_quat, recording.sensor_pos, recording.sensor_quat]
    if not all(np.isfinite(v).all() for v in values if v is not None):
        raise ValueError(f"{where} has rows without a pose: cut them off, a pose cannot be guessed")

    def turn(quat):
        return Rotation.from_quat(quat, scalar_first=True).as_matrix()

    pos, mat, force = recording.object_pos, turn(recording.object_quat), recording.force
    if recording.sensor_pos is not None and recording.sensor_quat is not None:
        back = turn(recording.sensor_quat).transpose(0, 2, 1)
        pos = np.einsum("nij,nj->ni", back, pos - recording.sensor_pos)
        mat = back @ mat
        force = None if force is None else np.einsum("nij,nj->ni", back, force)
    return pos, mat, force


def _contacts(time, pos, gap):
    """For every contact its rows (k,), the last one before it, those of it and the following ones near the
    skin; and a row of the approach without touch, or None."""
    travel = np.linalg.norm(np.diff(pos, axis=0, prepend=pos[:1]), axis=1)
    touch = np.concatenate([[False], gap <= 0, [False]])
    change = np.diff(touch.astype(int))
    first, last = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    first, last = first[first > 0], last[first > 0]  # one that is there from the beginning has no rest
    out = []
    for k, (a, b) in enumerate(zip(first, last)):
        end = first[k + 1] - 1 if k + 1 < len(first) else len(time)
        near = (time[b:end] < time[b - 1] + _AFTER) & (gap[b:end] < _LEFT) & (travel[b:end] < _LEFT)
        after = b + int(np.logical_and.accumulate(near).sum())
        rows = np.arange(a - 1, after)
        approach = np.arange(last[k - 1] if k else 0, a - 1)
        if len(rows) >= 8:
            late = time[a - 1] - time[approach] < _WAIT * np.median(np.diff(time[rows]))
            free = approach[(gap[approach] > _APART) & (gap[approach] < _LEFT) & late]
            out.append((rows, int(free[-1]) if len(free) else None))
    return out


def _contact(recording, clock, rows, free, pos, mat, force, counts):
    """A Trajectory of rows of a recording, thinned, behind the one in which nothing touches."""
    time = recording.time[rows]
    if len(rows) > _ROWS:
        travel = np.linalg.norm(np.diff(pos[rows], axis=0), axis=1)
        gone = np.concatenate(
            [[0], np.cumsum(travel / max(travel.sum(), 1e-9) + np.diff(time) / np.ptp(time))]
        )
        rows = rows[np.unique(np.searchsorted(gone, np.linspace(0, gone[-1] * (1 - 1e-9), _ROWS)))]

    touch = 0 if free is None else 1
    rows = np.r_[free, rows] if touch else rows
    time = recording.time[rows]

    def of(value, unit="counts"):
        there = value is not None and np.isfinite(value[rows]).all()
        return np.asarray(value[rows], float) if there and unit == "counts" else None

    return Trajectory(
        f"{recording.name}-{rows[0]}",
        recording.object,
        clock + float(time[0] - recording.time[0]),
        time - time[0],
        pos[rows],
        mat[rows],
        counts[rows],
        of(recording.pdc, recording.unit("pdc")),
        of(recording.tdc, recording.unit("tdc")),
        of(force),
        touch,
    )
