"""Core, nail and clamp in a mujoco_warp Model: `add` made them before the skin's friction was known."""

import typing

import mujoco
import numpy as np
import warp as wp

from ..coupling.config import Config

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw


def set_solids(mjm: mujoco.MjModel, m: "mjw.Model", core: int, friction: np.ndarray, priority: int) -> None:
    """Gives the geoms of body `core`, and their pairs, the skins' friction (nworld,) and contact priority, as
    `biotac_mj.attach` does. Values that differ from those of `add` were set by the user, and stay."""
    left = Config()
    solid = np.flatnonzero(mjm.geom_bodyid == core)
    _set(m, "geom_friction", solid, slice(0, 1), np.full(len(solid), left.friction), friction[:, None])
    rank = m.geom_priority.numpy().copy()
    rank[solid] = np.where(rank[solid] == left.priority, priority, rank[solid])
    m.geom_priority.assign(rank)
    first = np.isin(mjm.pair_geom1, solid)
    pair = np.flatnonzero(first != np.isin(mjm.pair_geom2, solid))
    other = mjm.geom_friction[np.where(first, mjm.pair_geom2, mjm.pair_geom1)[pair], 0]
    was, now = (np.maximum(value, other) for value in (left.friction, friction[:, None]))
    _set(m, "pair_friction", pair, slice(0, 2), was, now)


def _set(m, name, items, parts, was, now):
    """Makes numbers (n,) of items of an array of the Model, where these they are, others (nworld, n or 1):
    of all worlds, or of each."""
    array = getattr(m, name)
    now = np.broadcast_to(now, (len(now), len(items)))
    if not len(items) or np.array_equal(now, np.broadcast_to(was, now.shape)):
        return
    table = array.numpy()
    if (now != now[0]).any():
        table = table[np.arange(len(now)) % len(table)]
    table, now = table.copy(), now[: len(table)]
    part = table[:, items, parts]
    table[:, items, parts] = np.where(np.isclose(part, was[:, None]), now[:, :, None], part)
    if len(table) == len(array):
        array.assign(table)
    else:
        setattr(m, name, wp.array(table, dtype=array.dtype, device=array.device))
