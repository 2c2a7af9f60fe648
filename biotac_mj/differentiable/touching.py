"""Which samples of a surface touch, where they are in their geom's frame, and where they stick.

All worlds of a skin are looked at together: samples, geoms and nodes have the numbers that they have in
arrays [item, world] read row by row, item * nworld + world."""

import dataclasses

import numpy as np
import torch
import warp as wp

from ..skin.contact.posed import Geoms, meet
from ..skin.contact.shapes import distance
from ..skin.data import ContactState
from ..skin.types import real, vec3

__all__ = ["Held", "Touching", "at_sharp_edges", "flat", "look", "numbers_of_touching", "rows"]

_NEARER = (
    0.25  # of a sample's spacing, by which another side of a geom is nearer: 90 degrees, no tessellation
)


@dataclasses.dataclass(frozen=True)
class Held:
    """What a surface remembers when a step begins.

    Attributes:
      sample, geom: (n,) samples and the geoms they touched. anchor: (n, 3) in those geoms' frames [m].
    """

    sample: np.ndarray
    geom: np.ndarray
    anchor: np.ndarray

    @classmethod
    def none(cls) -> "Held":
        """Nothing."""
        return cls(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)))

    @classmethod
    def of(cls, state: ContactState) -> "Held":
        """What the surface remembers now."""
        sample, geom = numbers_of_touching(state.anchor_geom)
        return cls(sample, geom, rows(state.anchor, sample))

    def give(self, state: ContactState) -> None:
        """The inverse of `of`."""
        state.anchor_geom.fill_(-1)
        set_rows(state.anchor_geom, self.sample, self.geom // state.anchor_geom.shape[1])
        set_rows(state.anchor, self.sample, self.anchor)


def numbers_of_touching(geom: wp.array) -> tuple[np.ndarray, np.ndarray]:
    """Samples (n,) that have a geom in an array [sample, world], which has -1 for none, and these geoms."""
    if geom.device.is_cuda:  # no more than these are copied
        found = wp.to_torch(geom).ravel()
        sample = torch.nonzero(found >= 0).ravel()
        sample, found = (a.cpu().numpy() for a in (sample, found[sample]))
    else:
        found = geom.numpy().ravel()
        sample = np.flatnonzero(found >= 0)
        found = found[sample]
    return sample, found.astype(int) * geom.shape[1] + sample % geom.shape[1]


def rows(array: wp.array, number: np.ndarray) -> np.ndarray:
    """(n, ...) of an array [item, world] by number; of CUDA no more than these are copied."""
    if not array.device.is_cuda:
        return flat(array)[number]
    return wp.to_torch(array).flatten(0, 1)[torch.from_numpy(number).to(str(array.device))].cpu().numpy()


def set_rows(array: wp.array, number: np.ndarray, value: np.ndarray) -> None:
    """The inverse of `rows`."""
    if not array.device.is_cuda:
        flat(array)[number] = value
        return
    at = wp.to_torch(array).flatten(0, 1)
    at[torch.from_numpy(number).to(at.device)] = torch.from_numpy(value).to(at.device, at.dtype)


def flat(array: wp.array) -> np.ndarray:
    """An array [item, world] row by row; on the CPU its own memory."""
    found = array.numpy()
    return found.reshape(-1, *found.shape[2:])


@dataclasses.dataclass(frozen=True)
class Touching:
    """m samples that touch, as the last evaluation of the forces found them.

    Attributes:
      sample, geom: (m,). nworld: of the skin. node: (m, 3) of their faces. weight: (m, 3) barycentric, of
        where they push. area: (m,) that each stands for [m^2].
      plane: (m, 4) normal and offset [m], in the geom's frame, of what they meet of an edge; else zeros.
      point, last: (m, 3) where they push, and where they were when the step began [m].
      local: (m, 3) in the geom's frame.
      old: (m,) number in `Held` of those that touched the same geom when the step began, else -1.
      stick: (m, 3) where they stick if they do, in the geom's frame.
    """

    sample: np.ndarray
    geom: np.ndarray
    node: np.ndarray
    weight: np.ndarray
    area: np.ndarray
    plane: np.ndarray
    point: np.ndarray
    last: np.ndarray
    local: np.ndarray
    old: np.ndarray
    stick: np.ndarray
    nworld: int = 1

    @property
    def world(self) -> np.ndarray:
        """(m,) of each sample."""
        return self.sample % self.nworld

    @property
    def kind(self) -> np.ndarray:
        """(m,) numbers of the geoms, whatever the world."""
        return self.geom // self.nworld


def look(
    state: ContactState, weights: np.ndarray, geoms: Geoms, x: np.ndarray, x_last: np.ndarray, held: Held
) -> Touching:
    """Finds them.

    Args:
      state: of the surface, after an evaluation. weights: (s, 3) of the samples of a face.
      geoms: with poses of the end and of the beginning of the step.
      x, x_last: (nvert nworld, 3) nodes then [m]. held: when the step began.
    """
    nworld, count = state.trial_geom.shape[1], state.trial_geom.size
    sample, geom = numbers_of_touching(state.trial_geom)
    face, weight = sample // nworld // len(weights), weights[sample // nworld % len(weights)]
    node = state.surface.face_np[face] * nworld + (sample % nworld)[:, None]
    point, last = (np.einsum("ma,mak->mk", weight, at[node]) for at in (x, x_last))
    number = np.full(count, -1)
    number[held.sample] = np.arange(len(held.sample))
    old = number[sample]
    old[old >= 0] = np.where(held.geom[old[old >= 0]] == geom[old >= 0], old[old >= 0], -1)
    pos, mat, pos_last, mat_last = (flat(a) for a in (geoms.pos, geoms.mat, geoms.pos_last, geoms.mat_last))
    stick = _inside(last, pos_last[geom], mat_last[geom])
    stick[old >= 0] = held.anchor[old[old >= 0]]
    local = _inside(point, pos[geom], mat[geom])
    at, plane, part = _met(geoms, geom, local, weight, x[node])
    area = state.surface.area.numpy()[face] / len(weights) * part
    point = np.einsum("ma,mak->mk", at, x[node])
    return Touching(sample, geom, node, at, area, plane, point, last, local, old, stick, nworld)


@wp.kernel(module=f"{__name__}.met", enable_backward=False)
def _meet(
    # In:
    geom: wp.array(dtype=int),
    geoms: Geoms,
    local: wp.array(dtype=vec3),
    weight: wp.array(dtype=vec3),
    corner: wp.array2d(dtype=vec3),
    # Out:
    at_out: wp.array(dtype=vec3),
    plane_out: wp.array(dtype=wp.vec4d),
    part_out: wp.array(dtype=real),
):
    i = wp.tid()
    nworld = geoms.pos.shape[1]
    g = geom[i] // nworld
    y = local[i]
    dn = distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
    u = corner[i, 1] - corner[i, 0]
    v = corner[i, 2] - corner[i, 0]
    met = meet(geoms, g, geom[i] % nworld, y, dn, weight[i], u, v, 1)
    at_out[i] = met.at
    part_out[i] = met.part
    plane_out[i] = wp.vec4d()
    if wp.length_sq(met.at - weight[i]) > real(0.0):
        n = met.normal
        plane_out[i] = wp.vec4d(n[0], n[1], n[2], met.gap - wp.dot(n, y))


def _met(geoms, geom, local, weight, corner):
    """Where samples push (m, 3), the planes (m, 4) of edges that they meet, and their part in it (m,)."""
    m, edged = len(geom), geoms.window.numpy().any()
    at, plane, part = weight.copy(), np.zeros((m, 4)), np.ones(m)
    if not (m and edged):
        return at, plane, part
    with wp.ScopedDevice(geoms.size.device):
        given = [wp.array(geom, dtype=int), geoms, *(wp.array(a, dtype=vec3) for a in (local, weight))]
        given += [wp.array(corner, dtype=vec3, ndim=2)]
        out = [wp.array(a, dtype=kind) for a, kind in ((at, vec3), (plane, wp.vec4d), (part, real))]
        wp.launch(_meet, m, given, out)
    return tuple(a.numpy() for a in out)


def _inside(point, pos, mat):
    return np.einsum("mki,mk->mi", mat, point - pos)


@wp.kernel(module=f"{__name__}.behind", enable_backward=False)
def _look_behind(
    # In:
    geom: wp.array(dtype=int),
    geoms: Geoms,
    local: wp.array(dtype=vec3),
    spacing: wp.array(dtype=real),
    # Out:
    sharp_out: wp.array(dtype=int),
):
    """Whether a sample that goes its spacing deeper comes out on another side."""
    i = wp.tid()
    g = geom[i]
    reach = spacing[i]
    if geoms.kind[g] == 7:  # of a mesh the distance is exact near its surface alone
        reach = wp.min(reach, real(0.4) * geoms.grids.spacing[geoms.grid[g]])
    kind, size, rounding, grid = geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grid[g]
    here = distance(kind, size, rounding, geoms.grids, grid, local[i])
    behind = local[i] - reach * vec3(here[0], here[1], here[2])
    there = distance(kind, size, rounding, geoms.grids, grid, behind)
    sharp_out[i] = wp.where(there[3] > here[3] - real(1.0 - _NEARER) * reach, 1, 0)


def at_sharp_edges(geoms: Geoms, at: Touching) -> np.ndarray:
    """(m,) whether samples touch where their geom is finer than they lie apart: at an edge that is not
    rounded. There the push jumps from one of its sides to another, and a step may have several balances."""
    m = len(at.sample)
    if not m:
        return np.zeros(0, bool)
    with wp.ScopedDevice(geoms.size.device):
        sharp = wp.zeros(m, dtype=int)
        inputs = [
            wp.array(at.kind, dtype=int), geoms, wp.array(at.local, dtype=vec3),
            wp.array(np.sqrt(at.area), dtype=real),
        ]  # fmt: skip
        wp.launch(_look_behind, m, inputs, [sharp])
    return sharp.numpy() > 0
