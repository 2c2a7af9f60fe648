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
from ..tensors import add_rows
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


class LinearSurface:
    """Linearised samples of a surface in contact at the end of a step.

    Args:
      at: the samples. geoms: what they touch. state: of the surface.
      stiffness: (nworld,) of contact [Pa/m].
      stick_ratio, smoothing: see `differentiate_samples`.
      core: whether it is the inner surface, whose geom, the core, is no input and has no friction.

    Attributes:
      force: (m, 3) of the samples [N]. by_node: (m, 3, 9) by the nodes of their faces.
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
        names = "pos", "mat", "pos_last", "mat_last", "friction"
        pos, R, pos_last, R_last, friction = (rows(getattr(geoms, name))[at.geom] for name in names)
        springs = stiffness[at.world] * at.area
        given = at.kind, at.plane, at.local, at.stick, friction, springs
        self._own = own = differentiate_samples(geoms, *given, stick_ratio, smoothing)
        self._by_area = springs / wp.to_torch(state.surface.area).double()[at.face // at.nworld]
        self._R, self._R_last, self.force = R, R_last, _times(R, own.force)
        self._arm, self._last_arm = at.point - pos, at.last - pos_last
        self._old = torch.nonzero(at.old >= 0).ravel()  # the others are anchored where they were
        by_point = R @ own.by_local[:, :3] @ R.mT
        self.by_node = (by_point[:, :, None, :] * at.weight[:, None, :, None]).reshape(-1, 3, 9)
        one = torch.eye(3, dtype=springs.dtype, device=springs.device)
        self.spread = (at.weight[:, :, None, None] * one).reshape(-1, 9, 3)

    def blocks(self) -> FaceBlocks:
        """Derivatives of nodal forces by nodes, summed by faces."""
        return FaceBlocks.of(self.at.face, self.at.node, self.spread @ self.by_node)

    def at_nodes(self, force: torch.Tensor, nodal: torch.Tensor) -> None:
        """Adds forces of the samples (m, 3) to nodal forces (nvert, nworld, 3)."""
        add_rows(nodal.view(-1, 3), self.at.node, _times(self.spread, force))

    def points(self, x: torch.Tensor) -> torch.Tensor:
        """(m, 3) tangents of the contact points from those of the nodes (nvert, nworld, 3)."""
        return torch.einsum("ma,mak->mk", self.at.weight, x.reshape(-1, 3)[self.at.node])

    def push(self, given: dict, x: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Tangents of the samples' forces, and of their anchors in the geom's frame (m, 3), from those of the
        step's inputs, see `step.GIVEN`, and of the nodes; None: they are held."""
        at, own = self.at, self._own
        springs = at.area * given["contact_stiffness"][at.world]
        springs = springs + self._by_area * given[self._area].reshape(-1)[at.face]
        felt = own.by_stiffness * springs[:, None]
        moved = torch.zeros_like(at.point) if x is None else self.points(x)
        if not self._core:  # relative to the geom, which carries the force along
            move, turn = given["pose"].reshape(-1, 6)[at.geom].split(3, 1)
            moved = moved - move - torch.linalg.cross(turn, self._arm)
            felt = felt + own.by_friction * given["friction"].reshape(-1)[at.geom][:, None]
            move_last, turn_last = given["pose_last"].reshape(-1, 6)[at.geom].split(3, 1)
            last = self.points(given["x_last"]) - move_last - torch.linalg.cross(turn_last, self._last_arm)
            stick = _times(self._R_last.mT, last).index_copy(
                0, self._old, given["anchor"][at.sample[self._old]]
            )
            felt = felt + _times(own.by_stick, stick)
        felt = felt + _times(own.by_local, _times(self._R.mT, moved))
        force = _times(self._R, felt[:, :3])
        return force if self._core else force + torch.linalg.cross(turn, self.force), felt[:, 3:]


def _times(matrix, vector):
    return torch.einsum("mij,mj->mi", matrix, vector)
