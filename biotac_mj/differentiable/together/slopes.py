"""Samples that touch in all steps of a press of many worlds, and what they feel by what moves there: one list
on the device, made at once, since nothing in it depends on cotangents."""

import dataclasses
import typing

import numpy as np
import torch
import warp as wp

from ..linear.samples import SampleSlopes, combine_slopes, differentiate_on_device
from ..touching import Touching

if typing.TYPE_CHECKING:
    from .skin import RecordOfWorlds, SkinOfWorlds

__all__ = ["Touched", "touched_by_core", "touched_by_geoms"]


@dataclasses.dataclass(frozen=True)
class Touched:
    """Samples of one surface, step by step; tensors of the device.

    Attributes:
      at: of `touching`, whose numbers are those of a single step. slopes: theirs.
      step, world, kind, face: (m,). start: (nstep + 1,) where each step's begin, on the host.
      before: (m,) number in this list of the sample when the step before ended; -1: it did not touch then,
        -2: it sticks to where it was then, without having touched the same geom.
    """

    at: Touching
    slopes: SampleSlopes
    step: torch.Tensor
    world: torch.Tensor
    kind: torch.Tensor
    face: torch.Tensor
    start: np.ndarray
    before: torch.Tensor


def touched_by_geoms(
    worlds: "SkinOfWorlds",
    records: "list[RecordOfWorlds]",
    x: torch.Tensor,
    stiffness: torch.Tensor,
    pos: torch.Tensor,
    mat: torch.Tensor,
    friction: torch.Tensor,
) -> Touched:
    """Of the outer surface.

    Args:
      x: (nstep + 1, nvert, nworld, 3) nodes, before each step and after the last [m].
      stiffness: (nworld,) of contact [Pa/m].
      pos, mat: (nworld, nstep, ngeom, 3) [m], the same of (3, 3). friction: (nworld, ngeom).
    """
    old, before, stick, last = [], [], [], None
    for record in records:
        here, held = record.touches, record.held
        k = _number(held.sample, here)
        k[k >= 0] = np.where(held.geom[k[k >= 0]] == record.geoms[k >= 0], k[k >= 0], -1)
        old.append(k)
        stick.append(held.anchor[k[k >= 0]])
        if last is None:
            same, first = np.full(len(here), -1), 0
        else:
            same = _number(last.touches, here)
            same[same >= 0] += first
            first += len(last.touches)
        before.append(np.where(k >= 0, same, -2))
        last = record
    sample, geom = (np.concatenate([getattr(r, k) for r in records]) for k in ("touches", "geoms"))
    counts = [len(record.touches) for record in records]
    old, before, stick = (worlds.tensor(np.concatenate(a)) for a in (old, before, stick))
    met = [
        worlds.tensor(np.concatenate([getattr(r, k) for r in records])) for k in ("weight", "plane", "area")
    ]

    def posed(step, world, kind):
        then = (step - 1).clamp(min=0)
        return *(a[world, step, kind] for a in (pos, mat)), *(a[world, then, kind] for a in (pos, mat))

    made = worlds, worlds.data.outer, worlds.geoms, sample, geom, counts, x, stiffness, posed, friction
    return _made(*made, old, stick, before, met)


def touched_by_core(
    worlds: "SkinOfWorlds", records: "list[RecordOfWorlds]", x: torch.Tensor, stiffness: torch.Tensor
) -> Touched:
    """Of the inner surface, see `touched_by_geoms`: the core never moves, and has no friction."""
    sample, counts = np.concatenate([r.on_core for r in records]), [len(r.on_core) for r in records]
    geoms = worlds.model.core(worlds.nworld)
    pos, mat = (wp.to_torch(getattr(geoms.struct, name))[0] for name in ("pos", "mat"))

    def posed(_step, world, _kind):
        return pos[world], mat[world], pos[world], mat[world]

    none = torch.full((len(sample),), -1, device=x.device)
    made = worlds, worlds.data.core, geoms, sample, sample % worlds.nworld, counts, x, stiffness, posed
    return _made(*made, x.new_zeros((worlds.nworld, 1)), none, x.new_zeros((0, 3)), none)


def _number(sorted_, wanted):
    """Where each of `wanted` is in a sorted list, -1: nowhere."""
    if not len(sorted_):
        return np.full(len(wanted), -1)
    at = np.searchsorted(sorted_, wanted).clip(max=len(sorted_) - 1)
    return np.where(sorted_[at] == wanted, at, -1)


def _made(
    worlds, state, geoms, sample, geom, counts, x, stiffness, posed, friction, old, held, before, met=None
):
    """Of a surface; posed: poses of samples' geoms, and those when the step began, by step, world and geom;
    held: where samples that are old stick; met: weight, plane, area, where edges may be met."""
    w, nvert = worlds.nworld, x.shape[1]
    weights = worlds.tensor(worlds.weights)
    step = worlds.tensor(np.repeat(np.arange(len(counts)), counts))
    sample, geom = worlds.tensor(sample), worlds.tensor(geom)
    world, kind = sample % w, geom // w
    of_world = sample // w
    face, weight = of_world // len(weights), weights[of_world % len(weights)]
    node = worlds.tensor(state.surface.face_np.astype(np.int64))[face] * w + world[:, None]
    flat, row = x.view(-1, 3), (step * (nvert * w))[:, None] + node
    last, point = (torch.einsum("ma,mak->mk", weight, flat[row + k * nvert * w]) for k in (0, 1))
    poses = posed(step, world, kind)
    ends = (point, *poses[:2]), (last, *poses[2:])
    local, stick = (torch.einsum("mki,mk->mi", turn, end - origin) for end, origin, turn in ends)
    stick[old >= 0] = held
    area = wp.to_torch(state.surface.area).double()[face] / len(weights)
    plane = x.new_zeros((len(sample), 4))
    if met:
        weight, plane, area = met
        point = torch.einsum("ma,mak->mk", weight, flat[row + nvert * w])
    at = Touching(sample, geom, node, weight, area, plane, point, last, local, old, stick, w)
    given = kind, plane, local, stick, friction[world, kind], stiffness[world] * area
    own = differentiate_on_device(geoms.struct, *given, worlds.model.options.stick_ratio)
    slopes = combine_slopes(torch, _skew, at, own, poses)
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Touched(at, slopes, step, world, kind, face, start, before)


def _skew(v):
    """`geometry.rigid.skew` of tensors."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape, 3)
