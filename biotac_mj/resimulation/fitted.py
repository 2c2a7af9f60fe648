"""Poses of a plate pressed on a sensor by hand, fitted to force and electrodes."""

import dataclasses

import numpy as np
from scipy.ndimage import median_filter

from ..data.generation.plan import Motion
from ..data.importers import measured
from ..geometry.design import SINGLES
from ..geometry.skin_geometry import SkinGeometry
from ..matching.fit import SIGNS, Rows, Setup, fit_constants, fit_states, rows_of
from ..matching.response import Response, log_changes
from ..matching.states import PlateStates, frame, plate_states
from ..recordings import Recording
from ..sensor.channels import counts_from_log_impedance
from ..sensor.film import FilmConduction
from ..skin import PRESETS, Material, SkinOptions
from .touch import MOST, Touch

PLATE = "geom:plane"
_LOADED = 0.5  # [N] least force for a fitted pose, as in `matching`
_LEAD = 5e-6  # [m] distance of row 0 before first touch
_SMOOTH = 5  # rows of the running median of states, which are fitted separately
_CHUNK = 2000  # rows per fit: each needs its own table in memory
_EVERY = 10  # every tenth loaded row is used for the fit of the constants
_FEWEST = 8  # rows of a touch


def plate_path(
    geometry: SkinGeometry, state: np.ndarray, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A plate's poses (n, 3) [m] and (n, 3, 3) through states (n, 4) at depths (n,) from first touch [m], and
    its axes (n, 3, 3), rows along, across and towards the core.

    From row to row it rolls on the skin without sliding, except for differences of the drags. Its frame has
    +y towards the core."""
    outer = geometry.vert[np.unique(geometry.outer_face)]
    axes = np.array([frame(*angles) for angles in state[:, :2]])
    along, across, inwards = np.swapaxes(axes, 0, 1)
    height = outer @ inwards.T
    first = height.argmin(0)  # the node of first touch
    level = height.min(0) + depth
    mat = np.stack([np.cross(inwards, across), inwards, across], 2)
    drag = (state[:, 2:3] * along + state[:, 3:] * across) * depth[:, None]
    pos = np.empty((len(state), 3))
    pos[0] = outer[first[0]] + drag[0] + depth[0] * inwards[0]
    for k in range(1, len(state)):
        middle = outer[first[[k - 1, k]]].mean(0)
        here = middle + mat[k] @ mat[k - 1].T @ (pos[k - 1] - middle) + drag[k] - drag[k - 1]
        pos[k] = here + (level[k] - here @ inwards[k]) * inwards[k]
    return pos, mat, axes


def fitted_touches(
    recording: Recording,
    geometry: SkinGeometry,
    material: Material,
    options: SkinOptions,
    rate: float,
    block: float,
    progress: bool = True,
) -> tuple[list[Touch], Material, list[str]]:
    """Touches of `block` seconds [s] each, with fitted rest rows between them.

    Args:
      rate: [Hz] of the used rows, at most.

    Returns:
      touches, the material with the fitted Young's modulus, and notes.

    Raises:
      ValueError: no raw counts, no force, or too few loaded rows.
    """
    found = measured(recording)
    electrodes = found.counts[:, : -len(SINGLES)].astype(float)
    if recording.force is not None and not np.isfinite(recording.force).all():
        bad = ~np.isfinite(recording.force).all(1)
        raise ValueError(f"{recording.name} has {bad.sum()} rows without force: cut it to those that have it")
    constant_rows = rows_of(electrodes, recording.force, _EVERY)
    states = plate_states(geometry, material, options, quiet=not progress)
    film = FilmConduction(geometry, sensor=None, electrode_radius=PRESETS["calibrated"].electrode_radius)
    response = Response(states, log_changes(states, film))
    const, _ = fit_constants(response, constant_rows, Setup())
    due = np.floor(recording.time * rate + 1e-6)
    taken = np.flatnonzero(np.r_[True, np.diff(due) > 0])
    force = recording.force[taken] @ SIGNS
    loaded = (np.linalg.norm(force, axis=1) > _LOADED) & (force[:, 2] > 0)
    taken, force = taken[loaded], force[loaded]
    rows = Rows(electrodes[taken], force, taken / len(recording))
    parts = [fit_states(response, rows[k : k + _CHUNK], const, Setup()) for k in range(0, len(rows), _CHUNK)]
    state = np.concatenate([part.state for part in parts])
    misfit = np.sqrt(((np.concatenate([part.counts for part in parts]) - rows.counts) ** 2).mean(1))
    time = recording.time[taken]
    gap = 4 / rate
    out, begin = [], 0
    for k in range(1, len(taken) + 1):
        if k < len(taken) and time[k] - time[k - 1] < gap and time[k] - time[begin] < block:
            if k - begin < MOST - 1:
                continue
        piece, begin = slice(begin, k), k
        if piece.stop - piece.start >= _FEWEST - 1:
            out.append(
                _touch(recording, found, taken[piece], state[piece], force[piece], const, states, geometry)
            )
            out[-1].motion.parameters["misfit_counts"] = float(np.median(misfit[piece]))
    if not out:
        raise ValueError(
            f"{recording.name} has no touch of {_FEWEST} rows, and {len(taken)} under load at {rate:g} Hz: "
            "take a higher --at-most, a longer --block or a longer recording"
        )
    notes = [
        *found.notes,
        f"the plate's poses were fitted from force and electrodes (median misfit {np.median(misfit):.0f} "
        "counts), row 0 of each touch is the fitted rest: neither was measured",
        f"Young's modulus that fits the forces: {const.modulus / 1e6:.2f} MPa",
    ]
    return out, dataclasses.replace(material, youngs_modulus=const.modulus), notes


def _touch(recording, found, rows, state, force, const, states: PlateStates, geometry):
    state = median_filter(state, (_SMOOTH, 1), mode="nearest")
    n = geometry.design.nelectrode
    deep = Response(states, np.repeat(states.depth[..., None], n, -1))
    depth = np.maximum(deep.at_load(force[:, 2] / const.modulus)(state, False)[0][:, 0], 0.0)
    pos, mat, axes = plate_path(geometry, state, depth)
    push = state[0, 2] * axes[0, 0] + state[0, 3] * axes[0, 1] + axes[0, 2]
    time = recording.time[rows]
    step = np.median(np.diff(time))
    counts = np.concatenate([found.counts[rows[:1]], found.counts[rows]])
    counts[0, n:] = np.nan  # only electrodes are fitted
    counts[0, :n] = counts_from_log_impedance(
        const.offset + const.drifted(rows[:1] / len(recording))[:, None]
    )[0]
    wrench = np.full((len(rows) + 1, 6), np.nan, np.float32)
    wrench[0, :3] = 0
    wrench[1:, :3] = -np.einsum("nk,nkj->nj", force, axes)
    pac = None if found.pac is None else np.concatenate([found.pac[rows[:1]], found.pac[rows]])
    parameters = {"poses": "fitted", "tare": "fitted", "recording": recording.name}
    motion = Motion(
        "resimulated",
        parameters | {"rows": [int(rows[0]), int(rows[-1])]},
        np.concatenate([pos[:1] - (depth[0] + _LEAD) * push, pos]),
        np.concatenate([mat[:1], mat]),
    )
    return Touch(motion, np.concatenate([[time[0] - step], time]), counts, pac, wrench)
