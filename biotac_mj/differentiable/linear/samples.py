"""What a touching sample feels, as a function of what it depends on: Warp's adjoint of the contact's own
functions.

In the geom's frame a sample's force and its new anchor depend on where it is and on where it sticks, on the
coefficient of friction and on the stiffness of its springs; turning and moving the geom is left to `linear`.
All six numbers of a sample have copies of these side by side, so that one backward pass gives all slopes."""

import dataclasses
import types
from collections.abc import Callable

import numpy as np
import torch
import warp as wp

from ...geometry.rigid import skew
from ...skin.contact.posed import Geoms
from ...skin.contact.shapes import distance
from ...skin.contact.touch import smooth_push, smooth_stick_or_slip, stick_or_slip
from ...skin.types import real, vec3
from ..touching import Touching, flat

__all__ = [
    "SampleJacobians",
    "SampleSlopes",
    "combine_slopes",
    "differentiate_on_device",
    "differentiate_samples",
    "of_corners",
    "slopes_of_samples",
]

_OUTPUTS = 6  # force, anchor


@wp.kernel(module=f"{__name__}.adjoint", enable_backward=True)
def _feel(
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
    """One of the numbers of a sample [sample, number]: force [N], anchor [m]."""
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
        push = smooth_push(k, width, gap)[0]
    most = friction[i, o] * push
    held = vec3()
    anchor = y
    if most > real(0.0):
        if width > real(0.0):
            held, _K, anchor = smooth_stick_or_slip(y, stick[i, o], normal, most, k * stick_ratio, width)
        else:
            held, _K, anchor = stick_or_slip(y, stick[i, o], normal, most, k * stick_ratio)
    force = push * normal + held
    if o < 3:
        felt_out[i, o] = force[o]
    else:
        felt_out[i, o] = anchor[o - 3]


@dataclasses.dataclass(frozen=True)
class SampleJacobians:
    """Derivatives of force and anchor (m, 6) of m samples in their geoms' frames.

    Attributes:
      force: (m, 3) [N]. anchor: (m, 3) [m].
      by_local, by_stick: (m, 6, 3). by_friction, by_stiffness: (m, 6), the latter by the sample's springs.
      slips: (m,) whether it slips.
    """

    force: np.ndarray
    anchor: np.ndarray
    by_local: np.ndarray
    by_stick: np.ndarray
    by_friction: np.ndarray
    by_stiffness: np.ndarray
    slips: np.ndarray


def differentiate_samples(
    geoms: Geoms,
    geom: np.ndarray,
    plane: np.ndarray,
    local: np.ndarray,
    stick: np.ndarray,
    friction: np.ndarray,
    stiffness: np.ndarray,
    stick_ratio: float,
    smoothing: float = 0.0,
) -> SampleJacobians:
    """Force and anchor of samples that touch, with their derivatives.

    Args:
      geoms: struct of the geoms.
      geom: (m,) which one each sample touches, whatever the world. plane: (m, 4), see `Touching`.
      local: (m, 3) where it is, stick: (m, 3) where it sticks, in the geom's frame [m].
      friction: (m,). stiffness: (m,) of its springs [N/m].
      stick_ratio: `SkinOptions.stick_ratio`. smoothing: half width of first touch, see `press` [m].
    """
    m = len(geom)

    device = geoms.size.device

    def copies(value, dtype):
        value = np.repeat(np.asarray(value, float)[:, None], _OUTPUTS, 1)
        return wp.array(np.ascontiguousarray(value), dtype=dtype, device=device, requires_grad=True)

    inputs = [copies(local, vec3), copies(stick, vec3), copies(friction, real), copies(stiffness, real)]
    felt = wp.zeros((m, _OUTPUTS), dtype=real, device=device, requires_grad=True)
    which = wp.array(np.ascontiguousarray(geom, np.int32), dtype=int, device=device)
    felt.grad.fill_(1.0)
    met = wp.array(np.asarray(plane, float), dtype=wp.vec4d, device=device)
    _central_differences(
        stick_ratio, smoothing, which, geoms, met, inputs, [a.grad for a in inputs], felt, felt.grad
    )
    value, slopes = felt.numpy(), [a.grad.numpy().copy() for a in inputs]
    slips = (np.asarray(friction) > 0) & (value[:, 3:] != stick).any(1)
    return SampleJacobians(value[:, :3].copy(), value[:, 3:].copy(), *slopes, slips)


def differentiate_on_device(
    geoms: Geoms,
    geom: torch.Tensor,
    plane: torch.Tensor,
    local: torch.Tensor,
    stick: torch.Tensor,
    friction: torch.Tensor,
    stiffness: torch.Tensor,
    stick_ratio: float,
) -> SampleJacobians:
    """`differentiate_samples` of tensors that lie where the geoms do, in tensors."""
    m = len(geom)
    given = [
        a[:, None].expand(m, _OUTPUTS, *a.shape[1:]).contiguous() for a in (local, stick, friction, stiffness)
    ]
    slopes = [torch.zeros_like(a) for a in given]
    felt = torch.zeros((m, _OUTPUTS), dtype=torch.float64, device=local.device)
    kinds = vec3, vec3, real, real
    inputs, grads = ([wp.from_torch(a, dtype=t) for a, t in zip(arrays, kinds)] for arrays in (given, slopes))
    ends = [wp.from_torch(a, dtype=real) for a in (felt, torch.ones_like(felt))]
    which = wp.from_torch(geom.int(), dtype=wp.int32)
    met = wp.from_torch(plane.contiguous(), dtype=wp.vec4d)
    _central_differences(stick_ratio, 0.0, which, geoms, met, inputs, grads, *ends)
    slips = (friction > 0) & (felt[:, 3:] != stick).any(1)
    return SampleJacobians(felt[:, :3], felt[:, 3:], *slopes, slips)


def _central_differences(stick_ratio, width, which, geoms, plane, inputs, grads, felt, felt_grad):
    """Forwards, then backwards: as a tape would, which takes longer to find out what to do than this
    takes."""
    if not len(which):
        return
    given, device = [stick_ratio, width, which, geoms, plane, *inputs], geoms.size.device
    wp.launch(_feel, felt.shape, given, [felt], device=device)
    wp.launch(
        _feel, felt.shape, given, [felt], device=device,
        adj_inputs=[stick_ratio, width, None, geoms, None, *grads], adj_outputs=[felt_grad], adjoint=True,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class SampleSlopes:
    """Derivatives of what m samples feel, their force in the BioTac frame and their anchor in the geom's, by
    what moves there. Blocks of six rows: force, anchor.

    Attributes:
      own: in the geoms' frames.
      by_point: (m, 6, 3) by where the sample is. by_springs: (m, 6, 1) by the stiffness of its springs.
      by_pose: (m, 6, 6) by the geom's translation and rotation vector about its origin. by_friction:
        (m, 6, 1). by_stick: (m, 6, 3) by where it sticks, in the geom's frame.
      old, new: numbers of samples that touched the same geom when the step began, and of the k others, which
        stick to where they were then. by_last: (k, 6, 3), by_pose_last: (k, 6, 6) of these.
      collect: (m, 6, 3) wrench on the geom by force. wrench_by_node: (m, 6, 9) by the corners of its face.
    """

    own: SampleJacobians
    by_point: np.ndarray
    by_springs: np.ndarray
    by_pose: np.ndarray
    by_friction: np.ndarray
    by_stick: np.ndarray
    old: np.ndarray
    new: np.ndarray
    by_last: np.ndarray
    by_pose_last: np.ndarray
    collect: np.ndarray
    wrench_by_node: np.ndarray


def slopes_of_samples(
    at: Touching, geoms: Geoms, springs: np.ndarray, stick_ratio: float, smoothing: float = 0.0
) -> SampleSlopes:
    """Of samples that touch, with springs (m,) [N/m]."""
    pos, mat, pos_last, mat_last, friction = (
        flat(getattr(geoms, name))[at.geom] for name in ("pos", "mat", "pos_last", "mat_last", "friction")
    )
    given = at.kind, at.plane, at.local, at.stick, friction, springs
    own = differentiate_samples(geoms, *given, stick_ratio, smoothing)
    return combine_slopes(np, skew, at, own, (pos, mat, pos_last, mat_last))


def combine_slopes(
    xp: types.ModuleType, skew: Callable, at: Touching, own: SampleJacobians, poses: tuple
) -> SampleSlopes:
    """From the geoms' frames to the BioTac's.

    Args:
      xp, skew: numpy and `geometry.rigid.skew`, or torch and the same of tensors; the others are its arrays.
      poses: pos (m, 3) and mat (m, 3, 3) of each sample's geom, the same when the step began.
    """
    pos, R, pos_last, R_last = poses
    RT = R.swapaxes(1, 2)

    def outward(J):  # forces into the BioTac frame
        return xp.concatenate([R @ J[:, :3], J[:, 3:]], 1)

    by_local = outward(own.by_local)
    by_point, by_springs = by_local @ RT, outward(own.by_stiffness[..., None])
    # the geom moves: the sample goes the other way in its frame, and what is felt turns with it
    moved = by_local @ xp.concatenate([-RT, RT @ skew(at.point - pos)], 2)
    force = xp.einsum("mij,mj->mi", R, own.force)
    moved[:, :3, 3:] -= skew(force)
    by_stick = outward(own.by_stick)
    old, new = (xp.argwhere(side).ravel() for side in (at.old >= 0, at.old < 0))
    then = R_last[new].swapaxes(1, 2)
    last = xp.concatenate([-then, then @ skew(at.last[new] - pos_last[new])], 2)
    # wrench: -sum F, -sum p x F
    one = xp.zeros_like(R)
    one[:, [0, 1, 2], [0, 1, 2]] = 1.0
    collect = xp.concatenate([-one, -skew(at.point)], 1)
    turn = xp.concatenate([xp.zeros_like(R), skew(force)], 1)
    wrench = collect @ of_corners(at.weight, by_point)[:, :3] + of_corners(at.weight, turn)
    return SampleSlopes(
        own, by_point, by_springs, moved, outward(own.by_friction[..., None]), by_stick, old, new,
        by_stick[new] @ then, by_stick[new] @ last, collect, wrench,
    )  # fmt: skip


def of_corners(weight: np.ndarray, block: np.ndarray) -> np.ndarray:
    """(m, r, 9) by the corners of faces, of blocks (m, r, 3) by a point that has weights (m, 3) on them."""
    return (block[:, :, None, :] * weight[:, None, :, None]).reshape(*block.shape[:2], 9)
