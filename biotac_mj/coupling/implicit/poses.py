"""Poses, Jacobians and accelerations of the bodies that touch BioTacs, from an engine's own arrays: MuJoCo's
in double precision, those of mujoco_warp in single, which lead with the world.

Ours are [group, world] and double. A wrench or a small motion has its linear part first. Everything is in the
BioTac frame, about its origin, unless stated otherwise."""

from typing import Any

import warp as wp

from ...geometry.rigid_warp import is_finite, rotation
from ...kernels import kernel_module, set_fields
from ...skin.types import double, mat33, real, vec3, vec6, widen
from .rounds import Rounds, follow

kernel_module(__name__)


def _motion(scalar, vector, matrix, spatial):
    """`Motion` in one precision."""

    @wp.struct
    class Motion:
        """Poses and velocities of all bodies, the fields of an engine's Model and Data by their names."""

        body_rootid: wp.array(dtype=int)
        body_isdofancestor: wp.array2d(dtype=int)
        xpos: wp.array2d(dtype=vector)
        xmat: wp.array2d(dtype=matrix)
        subtree_com: wp.array2d(dtype=vector)
        cvel: wp.array2d(dtype=spatial)
        cdof: wp.array2d(dtype=spatial)

    return Motion


_PRECISIONS = ((wp.float32, wp.vec3, wp.mat33, wp.spatial_vector), (real, vec3, mat33, vec6))
_MOTION = {types[0]: _motion(*types) for types in _PRECISIONS}


def _motion_of(m, d):
    out = _MOTION[d.qvel.dtype]()
    own = {name: getattr(m if name.startswith("body") else d, name) for name in out._cls.vars}
    return set_fields(out, **own)


@wp.func
def _ahead_pos(b: int, w: int, h: real, motion: Any):
    """Position of a body after time h at its present velocity."""
    pos = double(motion.xpos[w, b])
    spin = double(wp.spatial_top(motion.cvel[w, b]))
    arm = pos - double(motion.subtree_com[w, motion.body_rootid[b]])
    return pos + h * (double(wp.spatial_bottom(motion.cvel[w, b])) + wp.cross(spin, arm))


@wp.func
def _ahead_mat(b: int, w: int, h: real, motion: Any):
    return rotation(h * double(wp.spatial_top(motion.cvel[w, b]))) * widen(motion.xmat[w, b])


@wp.kernel
def relative_poses(
    # In:
    core: int,
    body: wp.array(dtype=int),
    xpos: wp.array2d(dtype=Any),
    xmat: wp.array2d(dtype=Any),
    # Out:
    pos_out: wp.array2d(dtype=vec3),
    mat_out: wp.array2d(dtype=mat33),
):
    """Poses of the touching bodies now [group, world]."""
    g, w = wp.tid()
    turn = wp.transpose(widen(xmat[w, core]))
    pos_out[g, w] = turn * (double(xpos[w, body[g]]) - double(xpos[w, core]))
    mat_out[g, w] = turn * widen(xmat[w, body[g]])


@wp.kernel
def advance_groups(
    # In:
    core: int,
    body: wp.array(dtype=int),
    horizon: wp.array2d(dtype=real),
    motion: Any,
    # Out:
    pos_out: wp.array2d(dtype=vec3),
    mat_out: wp.array2d(dtype=mat33),
):
    """Poses of the touching bodies after a horizon [s] at present velocities [group, world]."""
    g, w = wp.tid()
    b = body[g]
    h = horizon[g, w]
    frame = wp.transpose(_ahead_mat(core, w, h, motion))
    origin = _ahead_pos(core, w, h, motion)
    pos_out[g, w] = frame * (_ahead_pos(b, w, h, motion) - origin)
    mat_out[g, w] = frame * _ahead_mat(b, w, h, motion)


@wp.kernel
def relative_jacobians(
    # In:
    core: int,
    body: wp.array(dtype=int),
    motion: Any,
    pos: wp.array2d(dtype=vec3),
    mat: wp.array2d(dtype=mat33),
    # Out:
    jacobian_out: wp.array3d(dtype=vec6),
):
    """Jacobians of the touching bodies relative to the BioTac, column i by thread i; pos, mat of
    `advance_groups`."""
    g, w, i = wp.tid()
    b = body[g]
    sign = real(motion.body_isdofancestor[b, i] - motion.body_isdofancestor[core, i])
    # the bodies' own columns differ in sign alone: both are about the BioTac's origin
    j = vec6()
    if sign != real(0.0) and is_finite(pos[g, w], mat[g, w]):  # what is lost takes no part in the dynamics
        turn = wp.transpose(widen(motion.xmat[w, core]))
        spin = double(wp.spatial_top(motion.cdof[w, i]))
        root = motion.body_rootid[wp.where(sign > real(0.0), b, core)]
        arm = double(motion.xpos[w, core]) - double(motion.subtree_com[w, root])
        linear = sign * (turn * (double(wp.spatial_bottom(motion.cdof[w, i])) + wp.cross(spin, arm)))
        angular = sign * (turn * spin)
        j = vec6(linear[0], linear[1], linear[2], angular[0], angular[1], angular[2])
    jacobian_out[g, w, i] = j


@wp.kernel
def find_drift(
    # In:
    h: real,
    jacobian: wp.array3d(dtype=vec6),
    qvel: wp.array2d(dtype=Any),
    # In and out:
    r: Rounds,
):
    """Motions of the touching bodies at present velocities, in the step h and in the horizon."""
    g, w = wp.tid()
    velocity = vec6()
    for i in range(jacobian.shape[2]):
        velocity += real(qvel[w, i]) * jacobian[g, w, i]
    r.straight[g, w] = h * velocity
    r.drift[g, w] = r.horizon[g, w] * velocity


@wp.kernel
def accelerate(
    # In:
    h: real,
    jacobian: wp.array3d(dtype=vec6),
    qacc: wp.array2d(dtype=Any),
    # In and out:
    r: Rounds,
):
    """Moves the bodies by accelerations (nworld, nv), see `rounds.follow`."""
    g, w = wp.tid()
    gain = vec6()
    for i in range(jacobian.shape[2]):
        gain += real(qacc[w, i]) * jacobian[g, w, i]
    follow(r, g, w, h, gain)


@wp.kernel
def advance_core(
    # In:
    core: int,
    h: real,
    square: real,
    motion: Any,
    qacc: wp.array2d(dtype=Any),
    # Out:
    pos_out: wp.array(dtype=vec3),
    mat_out: wp.array(dtype=mat33),
    pos_end_out: wp.array(dtype=vec3),
    mat_end_out: wp.array(dtype=mat33),
):
    """Poses of the BioTac frame in the world: now, and after h at present velocities, moved by `square` times
    J a."""
    w = wp.tid()
    here = double(motion.xpos[w, core])
    arm = here - double(motion.subtree_com[w, motion.body_rootid[core]])
    linear = vec3()
    angular = vec3()
    if square > real(0.0):
        for i in range(motion.cdof.shape[1]):
            if motion.body_isdofancestor[core, i] != 0:
                spin = double(wp.spatial_top(motion.cdof[w, i]))
                a = square * real(qacc[w, i])
                linear += a * (double(wp.spatial_bottom(motion.cdof[w, i])) + wp.cross(spin, arm))
                angular += a * spin
    pos_out[w] = here
    mat_out[w] = widen(motion.xmat[w, core])
    pos_end_out[w] = _ahead_pos(core, w, h, motion) + linear
    mat_end_out[w] = rotation(angular) * _ahead_mat(core, w, h, motion)


# an overload that a launch makes would change the module after it was compiled
for _real, _vec3, _mat33, _ in _PRECISIONS:
    _kinds = {name: wp.array2d(dtype=_real) for name in ("qvel", "qacc")}
    _kinds |= {"xpos": wp.array2d(dtype=_vec3), "xmat": wp.array2d(dtype=_mat33), "motion": _MOTION[_real]}
    for _kernel in (relative_poses, advance_groups, relative_jacobians, find_drift, accelerate, advance_core):
        _names = [a.label for a in _kernel.adj.args if a.label in _kinds]
        wp.overload(_kernel, {name: _kinds[name] for name in _names})


class Bodies:
    """Launches (kernel, dim, arguments) for the bodies of one BioTac. m, d: Model and Data of mujoco_warp, or
    what has the same arrays by the same names.

    Args:
      core: id of the BioTac's body. body: (group,) of int, ids of the touching ones.
    """

    def __init__(self, core: int, body: wp.array):
        self._own = [core, body]

    def here(self, d: Any, pos: wp.array, mat: wp.array) -> tuple:
        """Finds poses of now."""
        return relative_poses, pos.shape, [*self._own, d.xpos, d.xmat, pos, mat]

    def ahead(self, m: Any, d: Any, horizon: wp.array, pos: wp.array, mat: wp.array) -> tuple:
        """Finds poses after a horizon [group, world] [s] without acceleration."""
        return advance_groups, pos.shape, [*self._own, horizon, _motion_of(m, d), pos, mat]

    def jacobians(self, m: Any, d: Any, pos: wp.array, mat: wp.array, jacobian: wp.array) -> tuple:
        """Finds the Jacobians [group, world, dof], after poses."""
        return relative_jacobians, jacobian.shape, [*self._own, _motion_of(m, d), pos, mat, jacobian]

    def drift(self, m: Any, d: Any, step: float, jacobian: wp.array, r: Rounds) -> tuple[tuple, tuple]:
        """Two that find where the bodies go without acceleration to where the skin is solved."""
        ahead = self.ahead(m, d, r.horizon, r.start_pos, r.start_mat)
        return ahead, (find_drift, r.pos.shape, [real(step), jacobian, d.qvel, r])

    def accelerate(self, step: float, jacobian: wp.array, qacc: wp.array, r: Rounds) -> tuple:
        """Finds where they go with accelerations (nworld, nv)."""
        return accelerate, r.pos.shape, [real(step), jacobian, qacc, r]

    def core_motion(self, m: Any, d: Any, step: float, square: float, qacc: wp.array, out: list) -> tuple:
        """Finds poses `out` of the BioTac in the world, see `advance_core`."""
        known = [self._own[0], real(step), real(square), _motion_of(m, d), qacc]
        return advance_core, out[0].shape, [*known, *out]
