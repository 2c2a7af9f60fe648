"""Linearised contact of the samples of a surface.

In the geom's frame a sample's force and its new anchor depend on its position, its old anchor, the
coefficient of friction and the contact stiffness: Warp's adjoint of the contact's own functions. The six
output numbers of a sample have copies of these inputs, so that one backward pass gives all derivatives.
Rotation and translation of the geom are explicit."""

import dataclasses

import torch
import warp as wp

from ...kernels import kernel_module
from ...skin.contact.posed import Geoms
from ...skin.contact.shapes import distance
from ...skin.contact.touch import smooth_stick_or_slip, smooth_traction, stick_or_slip
from ...skin.data import ContactState
from ...skin.types import real, vec3
from ..tensors import add_rows, skew
from ..touching import Touching, rows
from .inverse import FaceBlocks

_OUTPUTS = 6  # force, anchor


@wp.kernel(module=kernel_module(f"{__name__}.adjoint"), enable_backward=True)
def _sample_outputs(
    # In:
    stick_ratio: real,
    width: real,
    geom: wp.array(dtype=int),
    geoms: Geoms,
    plane: wp.array(dtype=wp.vec4d),
    local: wp.array2d(dtype=vec3),
    stick: wp.array2d(dtype=vec3),
    friction: wp.array2d(dtype=real),
    stiffness: wp.array2d(dtype=real),
    # Out:
    felt_out: wp.array2d(dtype=real),
):
    """One of the six outputs of a sample [sample, number]: force [N], anchor [m]."""
    i, o = wp.tid()
    g = geom[i]
    y = local[i, o]
    k = stiffness[i, o]
    normal = vec3(plane[i][0], plane[i][1], plane[i][2])
    gap = wp.dot(normal, y) + plane[i][3]
    if wp.length_sq(normal) == real(0.0):
        dn = distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
        normal = vec3(dn[0], dn[1], dn[2])
        gap = dn[3]
    push = -k * gap
    if width > real(0.0):
        push = smooth_traction(k, width, gap)[0]
    most = friction[i, o] * push
    stick_force = vec3()
    anchor = y
    if most > real(0.0):
        if width > real(0.0):
            stick_force, _K, anchor = smooth_stick_or_slip(
                y, stick[i, o], normal, most, k * stick_ratio, width
            )
        else:
            stick_force, _K, anchor = stick_or_slip(y, stick[i, o], normal, most, k * stick_ratio)
    force = push * normal + stick_force
    if o < 3:
        felt_out[i, o] = force[o]
    else:
        felt_out[i, o] = anchor[o - 3]


@dataclasses.dataclass(frozen=True)
class SampleJacobians:
    """Derivatives of force and anchor (m, 6) of m samples in their geoms' frames.

    Attributes:
      force: (m, 3) [N]. anchor: (m, 3) [m].
      by_local, by_stick: (m, 6, 3). by_friction, by_stiffness: (m, 6), the latter by the sample's stiffness.
    """

    force: torch.Tensor
    anchor: torch.Tensor
    by_local: torch.Tensor
    by_stick: torch.Tensor
    by_friction: torch.Tensor
    by_stiffness: torch.Tensor


def differentiate_samples(
    geoms: Geoms,
    kind: torch.Tensor,
    plane: torch.Tensor,
    local: torch.Tensor,
    stick: torch.Tensor,
    friction: torch.Tensor,
    stiffness: torch.Tensor,
    stick_ratio: float,
    smoothing: float = 0.0,
) -> SampleJacobians:
    """Force and anchor of samples in contact, with their derivatives.

    Args:
      geoms: struct of the geoms; tensors are on its device.
      kind: (m,) geom of each sample, independent of the world. plane: (m, 4), see `Touching`.
      local: (m, 3) position, stick: (m, 3) anchor, in the geom's frame [m].
      friction: (m,). stiffness: (m,) of the sample [N/m].
      stick_ratio: `SkinOptions.stick_ratio`. smoothing: half width of first touch, see `press` [m].
    """
    m, types = len(kind), (vec3, vec3, real, real)
    given = [
        a[:, None].expand(m, _OUTPUTS, *a.shape[1:]).contiguous() for a in (local, stick, friction, stiffness)
    ]
    slopes = [torch.zeros_like(a) for a in given]
    felt = torch.zeros((m, _OUTPUTS), dtype=torch.float64, device=local.device)
    if m:
        inputs, grads = ([wp.from_torch(a, dtype=t) for a, t in zip(of, types)] for of in (given, slopes))
        ends = [wp.from_torch(a, dtype=real) for a in (felt, torch.ones_like(felt))]
        which = wp.from_torch(kind.int(), dtype=wp.int32)
        met = wp.from_torch(plane.contiguous(), dtype=wp.vec4d)
        constants, device = [stick_ratio, smoothing, which, geoms, met], geoms.size.device
        # forward and backward launches as a tape would do them, whose bookkeeping takes longer than the
        # launches
        wp.launch(_sample_outputs, felt.shape, [*constants, *inputs], ends[:1], device=device)
        wp.launch(
            _sample_outputs, felt.shape, [*constants, *inputs], ends[:1], device=device, adjoint=True,
            adj_inputs=[stick_ratio, smoothing, None, geoms, None, *grads], adj_outputs=ends[1:],
        )  # fmt: skip
    return SampleJacobians(felt[:, :3], felt[:, 3:], *slopes)


@dataclasses.dataclass(frozen=True)
class SampleSlopes:
    """Derivatives of m samples' force in the BioTac frame and anchor in the geom's frame. Blocks of six rows:
    force, anchor.

    Attributes:
      by_point: (m, 6, 3) by the sample's position. by_springs: (m, 6) by its stiffness.
      by_pose: (m, 6, 6) by the geom's translation and rotation vector about its origin. by_friction: (m, 6).
        by_stick: (m, 6, 3) by the old anchor, in the geom's frame.
      old, new: numbers of samples with the same geom as at the start of the step, and of the k others, which
        are anchored at their position then. by_last: (k, 6, 3), by_pose_last: (k, 6, 6) of these.
      collect: (m, 6, 3) wrench on the geom by force. wrench_by_node: (m, 6, 9) by the corners of its face.
    """

    by_point: torch.Tensor
    by_springs: torch.Tensor
    by_pose: torch.Tensor
    by_friction: torch.Tensor
    by_stick: torch.Tensor
    old: torch.Tensor
    new: torch.Tensor
    by_last: torch.Tensor
    by_pose_last: torch.Tensor
    collect: torch.Tensor
    wrench_by_node: torch.Tensor


def slopes_of_samples(
    at: Touching, geoms: Geoms, springs: torch.Tensor, stick_ratio: float, smoothing: float = 0.0
) -> SampleSlopes:
    """Derivatives of samples in contact, with stiffness springs (m,) [N/m]."""
    pos, R, pos_last, R_last, friction = (
        rows(getattr(geoms, name))[at.geom] for name in ("pos", "mat", "pos_last", "mat_last", "friction")
    )
    given = at.kind, at.plane, at.local, at.stick, friction, springs
    own, RT = differentiate_samples(geoms, *given, stick_ratio, smoothing), R.transpose(1, 2)

    def outward(J):  # forces into the BioTac frame
        return torch.cat([R @ J[:, :3], J[:, 3:]], 1)

    by_local, by_stick = outward(own.by_local), outward(own.by_stick)
    by_point = by_local @ RT
    # if the geom moves, the sample moves the opposite way in its frame, and the outputs rotate with it
    by_pose = by_local @ torch.cat([-RT, RT @ skew(at.point - pos)], 2)
    force = torch.einsum("mij,mj->mi", R, own.force)
    by_pose[:, :3, 3:] -= skew(force)
    old, new = (torch.nonzero(side).ravel() for side in (at.old >= 0, at.old < 0))
    then = R_last[new].transpose(1, 2)
    last = torch.cat([-then, then @ skew(at.last[new] - pos_last[new])], 2)
    # wrench: -sum F, -sum p x F
    one = torch.eye(3, dtype=R.dtype, device=R.device).expand_as(R)
    collect = torch.cat([-one, -skew(at.point)], 1)
    turn = torch.cat([torch.zeros_like(R), skew(force)], 1)
    wrench_by_node = _of_corners(at.weight, collect @ by_point[:, :3] + turn)
    by_springs, by_friction = (outward(J[..., None])[..., 0] for J in (own.by_stiffness, own.by_friction))
    return SampleSlopes(
        by_point, by_springs, by_pose, by_friction, by_stick, old, new,
        by_stick[new] @ then, by_stick[new] @ last, collect, wrench_by_node,
    )  # fmt: skip


def _of_corners(weight, block):
    """(m, r, 9) derivatives by the corners of faces, from those (m, r, 3) by a point with weights (m, 3) on
    them."""
    return (block[:, :, None, :] * weight[:, None, :, None]).reshape(*block.shape[:2], 9)


class LinearSurface:
    """Linearised samples of a surface in contact at the end of a step.

    Args:
      at: the samples. geoms: what they touch. state: of the surface.
      stiffness: (nworld,) of contact [Pa/m].
      stick_ratio, smoothing: see `differentiate_samples`.
      core: whether it is the inner surface, whose geom, the core, is no input and has no friction.

    Attributes:
      slopes: of the samples. by_node: (m, 6, 9) by the nodes of their faces.
      spread: (m, 9, 3) forces on these nodes by the samples' forces.
    """

    def __init__(
        self,
        at: Touching,
        geoms: Geoms,
        state: ContactState,
        stiffness: torch.Tensor,
        stick_ratio: float,
        smoothing: float = 0.0,
        core: bool = False,
    ):
        self.at, self._core, self._area = at, core, "core_area" if core else "area"
        springs = stiffness[at.world] * at.area
        self.slopes = slopes_of_samples(at, geoms, springs, stick_ratio, smoothing)
        self._by_area = springs / wp.to_torch(state.surface.area).double()[at.face // at.nworld]
        self.by_node = _of_corners(at.weight, self.slopes.by_point)
        one = torch.eye(3, dtype=springs.dtype, device=springs.device)
        self.spread = (at.weight[:, :, None, None] * one).reshape(-1, 9, 3)

    def blocks(self) -> FaceBlocks:
        """Derivatives of nodal forces by nodes, summed by faces."""
        return FaceBlocks.of(self.at.face, self.at.node, self.spread @ self.by_node[:, :3])

    def at_samples(self, nodal: torch.Tensor) -> torch.Tensor:
        """(m, 3) cotangents of the samples' forces from those of nodal forces (nvert, nworld, 3)."""
        felt = nodal.reshape(-1, 3)[self.at.node].reshape(-1, 9)
        return torch.einsum("mij,mi->mj", self.spread, felt)

    def at_nodes(self, force: torch.Tensor, nodal: torch.Tensor) -> None:
        """Adds forces of the samples (m, 3) to nodal forces (nvert, nworld, 3)."""
        add_rows(nodal.view(-1, 3), self.at.node, torch.einsum("mij,mj->mi", self.spread, force))

    def pull(self, force: torch.Tensor, anchor: torch.Tensor | None, given: dict) -> None:
        """Adds to cotangents of the step's inputs, see `step.GIVEN`, those from forces and anchors of the
        samples (m, 3)."""
        s, at = self.slopes, self.at
        rows = 3 if anchor is None else 6
        felt = force if anchor is None else torch.cat([force, anchor], 1)
        by_springs = (s.by_springs[:, :rows] * felt).sum(1)
        add_rows(given["contact_stiffness"], at.world, at.area * by_springs)
        add_rows(given[self._area].view(-1), at.face, self._by_area * by_springs)
        if self._core:
            return
        add_rows(given["pose"].view(-1, 6), at.geom, torch.einsum("mij,mi->mj", s.by_pose, felt))
        add_rows(given["friction"].view(-1), at.geom, (s.by_friction * felt).sum(1))
        anchors = torch.einsum("mij,mi->mj", s.by_stick[s.old], felt[s.old])
        add_rows(given["anchor"], at.sample[s.old], anchors)
        felt = felt[s.new]
        last = torch.einsum("mij,mi->mj", s.by_pose_last, felt)
        add_rows(given["pose_last"].view(-1, 6), at.geom[s.new], last)
        last = torch.einsum("mij,mi->mj", _of_corners(at.weight[s.new], s.by_last), felt)
        add_rows(given["x_last"].view(-1, 3), at.node[s.new], last)

    def push(self, given: dict) -> tuple[torch.Tensor, torch.Tensor]:
        """Tangents of the samples' forces and anchors (m, 3) from those of the step's inputs, at fixed
        nodes."""
        s, at = self.slopes, self.at
        springs = at.area * given["contact_stiffness"][at.world]
        springs = springs + self._by_area * given[self._area].reshape(-1)[at.face]
        felt = s.by_springs * springs[:, None]
        if not self._core:
            felt = felt + torch.einsum("mij,mj->mi", s.by_pose, given["pose"].reshape(-1, 6)[at.geom])
            felt = felt + s.by_friction * given["friction"].reshape(-1)[at.geom][:, None]
            anchors = given["anchor"][at.sample[s.old]]
            felt[s.old] += torch.einsum("mij,mj->mi", s.by_stick[s.old], anchors)
            last = given["pose_last"].reshape(-1, 6)[at.geom[s.new]]
            felt[s.new] += torch.einsum("mij,mj->mi", s.by_pose_last, last)
            last = given["x_last"].reshape(-1, 3)[at.node[s.new]].reshape(-1, 9)
            by_last = _of_corners(at.weight[s.new], s.by_last)
            felt[s.new] += torch.einsum("mij,mj->mi", by_last, last)
        return felt[:, :3], felt[:, 3:]
