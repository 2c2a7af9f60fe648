"""A step that is too hard for one solve: the geoms are moved in parts from where they were to where they are
asked to be, and the skin follows from balance to balance, as far as it can."""

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .step import Effort, Memory, Outcome

__all__ = ["follow"]

_PART = 1e-3  # the geoms move at most so far at once [m]
_LEAST = 1e-5  # no part is tried that is shorter [m]
_LEVER = 1e-2  # at which turning counts as moving, about the size of a fingertip [m]
_EFFORT = 1.5e5  # of a step's first way, for each outer node: about 0.25 s on the coarse skin
_ANOTHER = 0.5  # of that, for another way where the first one leads nowhere
_SMALL = 1000  # outer nodes of a skin whose steps cost no less for being smaller
_SHARE, _SHORT = 0.125, 1e-4  # of a short motion that failed at once, and [m]: the first part at least
_AT_ONCE = 5e4  # of that, what the step at once may take
_ONE = 0.6  # of what is left, that a part may take: a shorter one takes less
_SPENT = 0.05  # of the effort: so little is not worth a part


def follow(
    skin: Any,
    memory: Memory,
    pos: np.ndarray,
    mat: np.ndarray,
    near: Memory | None = None,
    allowed: float = 1.0,
) -> tuple[Outcome, np.ndarray]:
    """The step of a CondensedSkin from a memory to poses (ngeom, 3) [m], (ngeom, 3, 3), at
    once where that can be, else in parts; and the displacements (nvert, 3) [m].

    Where geoms are so deep inside the core that no skin fits, it follows them to where one does; `reached` is
    then the share of their way into the skin. allowed: of what a hard step may cost."""
    first = skin.patience * _EFFORT * max(skin.nouter, _SMALL)
    most = (1 + _ANOTHER) * first
    effort = Effort(allowed * first)
    skin.pose(memory, pos, mat)
    if not skin.search.deep(pos, mat):
        out, u = _follow(skin, memory, pos, mat, near, effort)
    else:
        shallow, outside = skin.search.shallow(pos, mat), skin.search.outside(pos, mat)
        share = np.linalg.norm(shallow - outside) / np.linalg.norm(pos - outside)
        known = memory if memory.started else _outside(skin, shallow, mat)
        out, u = _follow(skin, known, shallow, mat, None, effort)
        out = dataclasses.replace(out, converged=False, reached=share * out.reached)
    return dataclasses.replace(out, cost=effort.spent / most), u


def _follow(skin, memory, pos, mat, near, effort):
    most = effort.left
    motion, first = skin.pose(memory, pos, mat), 1.0
    turned = np.abs(mat - memory.geom_mat).max(initial=0.0) if memory.started else 0.0
    far = np.abs(motion).max(initial=0.0) + _LEVER * turned
    if far <= _PART:
        effort.allow(min(1.0, _AT_ONCE * max(skin.nouter, _SMALL) / effort.left))
        found = skin.attempt(memory, None, pos, mat, effort, near=near)
        if found:
            return found
        first = min(1.0, max(_SHARE, _SHORT / max(far, 1e-12)))
    if skin.untouched(pos, mat):  # the skin lets go
        return skin.at_rest(pos, mat, motion), np.zeros_like(skin.rest)
    known = None
    if memory.started:
        out, u, blocked = _go(skin, memory, pos, mat, effort, first)
        if not blocked and out.reached > 0:
            return out, u
        if far <= _PART and len(memory.force):
            known = out, u
            if effort.left < _SPENT * most:
                return known
        effort.renew(_ANOTHER * most)
    # the way there, if there is one, leads through the core or does not begin; or nobody knows it
    out, u, _ = _go(skin, _outside(skin, pos, mat), pos, mat, effort)
    # a skin that presses is not given up for one that hardly touches yet
    return (out, u) if known is None or out.converged else known


def _go(skin, memory, pos, mat, effort, first=1.0):
    """From a memory to poses in parts: outcome, displacements, whether the core is in the way."""
    turn = Rotation.from_matrix(mat @ memory.geom_mat.transpose(0, 2, 1)).as_rotvec()
    move = pos - memory.geom_pos
    length = max(float((np.linalg.norm(move, axis=1) + _LEVER * np.linalg.norm(turn, axis=1)).max()), 1e-12)
    at, part, found, blocked, iterations = 0.0, min(first, _PART / length), None, False, 0
    spent, from_pos, from_mat = _SPENT * effort.left, memory.geom_pos, memory.geom_mat
    u = None
    while at < 1:
        to = at + part
        pose = from_pos + to * move, Rotation.from_rotvec(to * turn).as_matrix() @ from_mat
        if to > 1 - 1e-9:
            to, pose = 1.0, (pos, mat)
        effort.allow(_ONE)
        moved = (to - at) * length
        new = skin.attempt(memory, u, *pose, effort, moved, passing=to < 1)
        if new:
            found, at, part = new, to, min(2 * part, _PART / length, 1 - to)
            memory, u = found[0].memory, found[1]
            iterations += found[0].iterations
            continue
        blocked |= skin.search.deep(*pose)
        part /= 2
        if part * length < _LEAST or effort.left < spent:
            break
    out, u = found or skin.hold(memory)
    out = dataclasses.replace(out, converged=at == 1.0, iterations=iterations, reached=at)
    return out, u, blocked and at < 1


def _outside(skin, pos, mat):
    """Memory of the resting skin with the geoms moved out of it."""
    out = skin.search.outside(pos, mat)
    return skin.at_rest(out, mat, np.zeros_like(out)).memory
