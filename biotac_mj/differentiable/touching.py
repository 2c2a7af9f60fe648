"""Samples of a surface in contact, their positions in their geom's frame, and their anchors.

Samples, geoms and nodes of all worlds are numbered by rows of arrays [item, world], item * nworld + world.
All tensors are on the skin's device."""

import dataclasses
import typing

import torch
import warp as wp

from ..kernels import kernel_module
from ..skin.contact.posed import MESH, Geoms, meet
from ..skin.contact.shapes import distance
from ..skin.data import ContactState
from ..skin.types import real, vec3

_NEARER = 0.25  # of a sample's spacing, distance to another side of a geom: finds 90 degrees, no tessellation


@dataclasses.dataclass(frozen=True)
class Anchors:
    """Anchors of a surface at the start of a step.

    Attributes:
      sample, geom: (n,) samples and the geoms they touched. anchor: (n, 3) in those geoms' frames [m].
    """

    sample: torch.Tensor
    geom: torch.Tensor
    anchor: torch.Tensor

    @classmethod
    def none(cls, device: torch.device | str = "cpu") -> typing.Self:
        """Nothing."""
        number = torch.zeros(0, dtype=torch.int64, device=device)
        return cls(number, number, torch.zeros((0, 3), dtype=torch.float64, device=device))

    @classmethod
    def of(cls, state: ContactState) -> typing.Self:
        """The surface's current anchors."""
        sample, geom = touching_samples(state.anchor_geom)
        return cls(sample, geom, rows(state.anchor)[sample])

    def give(self, state: ContactState) -> None:
        """Inverse of `of`."""
        geoms = rows(state.anchor_geom)
        geoms.fill_(-1)
        geoms[self.sample] = (self.geom // state.anchor_geom.shape[1]).int()
        rows(state.anchor)[self.sample] = self.anchor


def rows(array: wp.array) -> torch.Tensor:
    """View of an array [item, world], row by row."""
    return wp.to_torch(array, requires_grad=False).flatten(0, 1)


def touching_samples(geom: wp.array) -> tuple[torch.Tensor, torch.Tensor]:
    """Samples (n,) with a geom in an array [sample, world], which has -1 for none, and these geoms."""
    found, nworld = rows(geom), geom.shape[1]
    sample = torch.nonzero(found >= 0).ravel()
    return sample, found[sample].long() * nworld + sample % nworld


@dataclasses.dataclass(frozen=True)
class Touching:
    """m samples in contact, from the last evaluation of the forces.

    Attributes:
      sample, geom: (m,). nworld: of the skin. face: (m,) of each. node: (m, 3) of the face. weight: (m, 3)
        barycentric coordinates of the contact point. area: (m,) of each [m^2].
      plane: (m, 4) normal and offset [m], in the geom's frame, of the touched part of an edge; else zeros.
      point, last: (m, 3) contact points at the end and start of the step [m].
      local: (m, 3) in the geom's frame.
      old: (m,) number in `Anchors` of those with the same geom at the start of the step, else -1.
      stick: (m, 3) anchors while sticking, in the geom's frame.
    """

    sample: torch.Tensor
    geom: torch.Tensor
    face: torch.Tensor
    node: torch.Tensor
    weight: torch.Tensor
    area: torch.Tensor
    plane: torch.Tensor
    point: torch.Tensor
    last: torch.Tensor
    local: torch.Tensor
    old: torch.Tensor
    stick: torch.Tensor
    nworld: int

    @property
    def world(self) -> torch.Tensor:
        """(m,) world of each sample."""
        return self.sample % self.nworld

    @property
    def kind(self) -> torch.Tensor:
        """(m,) numbers of the geoms, independent of the world."""
        return self.geom // self.nworld


def find_touching(
    state: ContactState,
    weights: torch.Tensor,
    geoms: Geoms,
    x: torch.Tensor,
    x_last: torch.Tensor,
    anchors: Anchors,
) -> Touching:
    """Finds the samples in contact.

    Args:
      state: of the surface, after an evaluation. weights: (s, 3) of the samples of a face.
      geoms: with poses at the end and the start of the step.
      x, x_last: (nvert, nworld, 3) nodes then [m]. anchors: at the start of the step.
    """
    nworld, s = state.trial_geom.shape[1], len(weights)
    sample, geom = touching_samples(state.trial_geom)
    world, of_surface = sample % nworld, sample // nworld
    kind, weight = of_surface // s, weights[of_surface % s]
    node = wp.to_torch(state.surface.face)[kind].long() * nworld + world[:, None]
    corner = x.reshape(-1, 3)[node]
    point, last = (torch.einsum("ma,mak->mk", weight, at) for at in (corner, x_last.reshape(-1, 3)[node]))
    number = torch.full((state.trial_geom.size,), -1, device=sample.device)
    number[anchors.sample] = torch.arange(len(anchors.sample), device=sample.device)
    old = number[sample]
    known = torch.nonzero(old >= 0).ravel()
    old[known[anchors.geom[old[known]] != geom[known]]] = -1
    known = old >= 0
    poses = (rows(getattr(geoms, name))[geom] for name in ("pos", "mat", "pos_last", "mat_last"))
    pos, mat, pos_last, mat_last = poses
    stick, local = _in_frame(last, pos_last, mat_last), _in_frame(point, pos, mat)
    stick[known] = anchors.anchor[old[known]]
    at, plane, fraction = _meet_edges(geoms, geom, local, weight, corner)
    area = wp.to_torch(state.surface.area).double()[kind] / s * fraction
    point = torch.einsum("ma,mak->mk", at, corner)
    face = kind * nworld + world
    return Touching(sample, geom, face, node, at, area, plane, point, last, local, old, stick, nworld)


@wp.kernel(module=kernel_module(f"{__name__}.met"))
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
    part_out[i] = met.weight
    plane_out[i] = wp.vec4d()
    if wp.length_sq(met.at - weight[i]) > real(0.0):
        n = met.normal
        plane_out[i] = wp.vec4d(n[0], n[1], n[2], met.gap - wp.dot(n, y))


def _meet_edges(geoms, geom, local, weight, corner):
    """Contact points of samples (m, 3), the planes (m, 4) of touched edges, and the fraction of their area in
    contact (m,)."""
    m = len(geom)
    at, plane, fraction = weight.clone(), weight.new_zeros((m, 4)), weight.new_ones(m)
    if m and geoms.window.numpy().any():
        arrays = (
            (local, vec3),
            (weight, vec3),
            (corner, vec3),
            (at, vec3),
            (plane, wp.vec4d),
            (fraction, real),
        )
        made = [wp.from_torch(a.contiguous(), dtype=kind) for a, kind in arrays]
        given = [wp.from_torch(geom.int(), dtype=wp.int32), geoms, *made[:3]]
        wp.launch(_meet, m, given, made[3:], device=geoms.size.device)
    return at, plane, fraction


def _in_frame(point, pos, mat):
    return torch.einsum("mki,mk->mi", mat, point - pos)


@wp.kernel(module=kernel_module(f"{__name__}.behind"))
def _leaves_other_side(
    # In:
    geom: wp.array(dtype=int),
    geoms: Geoms,
    local: wp.array(dtype=vec3),
    spacing: wp.array(dtype=real),
    # Out:
    sharp_out: wp.array(dtype=int),
):
    """Whether a sample that moves deeper by its spacing leaves on another side."""
    i = wp.tid()
    g = geom[i]
    reach = spacing[i]
    if geoms.kind[g] == MESH:  # for a mesh the distance is exact only near its surface
        reach = wp.min(reach, real(0.4) * geoms.grids.spacing[geoms.grid[g]])
    kind, size, rounding, grid = geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grid[g]
    here = distance(kind, size, rounding, geoms.grids, grid, local[i])
    behind = local[i] - reach * vec3(here[0], here[1], here[2])
    there = distance(kind, size, rounding, geoms.grids, grid, behind)
    sharp_out[i] = wp.where(there[3] > here[3] - real(1.0 - _NEARER) * reach, 1, 0)


def at_sharp_edges(geoms: Geoms, at: Touching) -> torch.Tensor:
    """(m,) whether samples touch their geom where it is finer than their spacing: at an edge that is not
    rounded. There the contact force jumps from one side to another, and a step may have several
    equilibria."""
    sharp = torch.zeros(len(at.sample), dtype=torch.int32, device=at.sample.device)
    if len(sharp):
        arrays = (at.local, vec3), (at.area.sqrt(), real)
        local, spacing = (wp.from_torch(a.contiguous(), dtype=kind) for a, kind in arrays)
        inputs = [wp.from_torch(at.kind.int(), dtype=wp.int32), geoms, local, spacing]
        wp.launch(_leaves_other_side, len(sharp), inputs, [wp.from_torch(sharp)], device=geoms.size.device)
    return sharp > 0
