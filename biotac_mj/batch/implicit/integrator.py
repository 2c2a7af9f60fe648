"""From the accelerations that mujoco_warp's constraint solver finds to those with which its integrator moves
the bodies: `coupling/implicit/integrator.py` for all worlds at once, by mujoco_warp's own stages.

The rows answer to the former, a, but the skins to the latter, a'. The force beta h^2 S J (a - a') corrects
that. It moves the bodies too, so it is found in rounds. Formulas in `coupling/implicit/rules.py`."""

import typing

import mujoco
import warp as wp

from ...coupling.implicit.rules import (
    MAX_CORRECTIONS,
    Seen,
    accelerated,
    place_of,
    poorly_corrected,
    remember,
)
from ...geometry.rigid_warp import LEVER
from ..kernels import Model

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

__all__ = [
    "Correction",
    "Integrator",
    "begin_correction",
    "correct",
    "corrections",
    "find_amiss",
    "leave_out",
]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec6 = wp.spatial_vectord

_MAX_CORRECTIONS = wp.constant(MAX_CORRECTIONS)
_CORRECTED = wp.constant(wp.float64(1e-4))  # of the skins' wrenches: accelerations are of single precision
_poorly_corrected = wp.func(poorly_corrected)
_FAST, _IMPLICIT = (
    int(getattr(mujoco.mjtIntegrator, f"mjINT_{name}")) for name in ("IMPLICITFAST", "IMPLICIT")
)
_ACTUATION, _SPRING, _DAMPER, _EULERDAMP = (
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    for name in ("ACTUATION", "SPRING", "DAMPER", "EULERDAMP")
)


@wp.struct
class Correction:
    """Of the forces of all skins [group, world]: what is added to them, what they still lack
    (`Coupled.amiss`), and the rounds that led there: one search for all skins of a world, since they may hold
    one body."""

    force: wp.array2d(dtype=vec6)
    amiss: wp.array2d(dtype=vec6)
    rounds: wp.array(dtype=int)
    # largest entries [N] of what is amiss, of what is to be corrected, of the skins' wrenches
    wrong: wp.array(dtype=real)
    most: wp.array(dtype=real)
    largest: wp.array(dtype=real)
    seen: Seen


def corrections(groups: int, nworld: int) -> Correction:
    """None so far, on Warp's default device, of `groups` bodies of all skins."""
    out = Correction()
    out.force, out.amiss = (wp.zeros((groups, nworld), dtype=vec6) for _ in range(2))
    out.rounds = wp.zeros(nworld, dtype=int)
    out.wrong, out.most, out.largest = (wp.zeros(nworld, dtype=real) for _ in range(3))
    out.seen = remember(groups, nworld)
    return out


@wp.func
def _scaled(m: vec6, lever: real):
    """A wrench in which torques compare with forces."""
    return vec6(m[0], m[1], m[2], m[3] / lever, m[4] / lever, m[5] / lever)


@wp.func
def _largest(m: vec6):
    size = real(0.0)
    for i in range(6):
        size = wp.max(size, wp.abs(m[i]))
    return size


@wp.kernel
def begin_correction(c: Correction):
    w = wp.tid()
    c.rounds[w] = 0
    c.seen.count[w] = 0
    c.wrong[w] = real(0.0)
    c.most[w] = real(0.0)
    c.largest[w] = real(0.0)


@wp.kernel
def find_amiss(
    # In:
    first: int,
    square: wp.array(dtype=real),
    jacobian: wp.array3d(dtype=vec6),
    found: wp.array2d(dtype=float),
    moved: wp.array2d(dtype=float),
    model: Model,
    # In and out:
    c: Correction,
):
    """After mujoco_warp's answer a, a' [world, dof]: what the correction of one skin lacks, whose bodies
    begin at `first`."""
    w = wp.tid()
    now = place_of(c.seen, w)
    for g in range(jacobian.shape[0]):
        k = first + g
        way = vec6()
        for i in range(jacobian.shape[2]):
            way += square[w] * real(found[w, i] - moved[w, i]) * jacobian[g, w, i]
        excess = model.tangent0[g, w] * way
        lacks = excess - c.force[k, w]
        c.amiss[k, w] = -lacks
        c.seen.x[now, k, w] = _scaled(c.force[k, w], real(LEVER))
        c.seen.residual[now, k, w] = _scaled(lacks, real(LEVER))
        c.wrong[w] = wp.max(c.wrong[w], _largest(c.seen.residual[now, k, w]))
        c.most[w] = wp.max(c.most[w], _largest(_scaled(excess, real(LEVER))))
        c.largest[w] = wp.max(c.largest[w], _largest(_scaled(model.wrench0[g, w], real(LEVER))))


@wp.kernel
def leave_out(first: int, count: int, c: Correction):
    """A skin that takes no part, in the place of `find_amiss`."""
    w = wp.tid()
    now = place_of(c.seen, w)
    for k in range(first, first + count):
        c.force[k, w] = vec6()
        c.amiss[k, w] = vec6()
        c.seen.x[now, k, w] = vec6()
        c.seen.residual[now, k, w] = vec6()


@wp.kernel
def correct(c: Correction, again: wp.array(dtype=int)):
    """After `find_amiss` of all skins: another correction of the worlds where too much is amiss; sets
    again[0] where it is."""
    w = wp.tid()
    wrong = c.wrong[w]
    most = c.most[w]
    largest = c.largest[w]
    c.wrong[w] = real(0.0)
    c.most[w] = real(0.0)
    c.largest[w] = real(0.0)
    if c.rounds[w] == _MAX_CORRECTIONS or not _poorly_corrected(wrong, most, largest, _CORRECTED):
        return
    accelerated(c.seen, w, real(1.0))
    for g in range(c.force.shape[0]):
        c.force[g, w] = _scaled(c.seen.to[g, w], real(1.0) / real(LEVER))
    c.rounds[w] = c.rounds[w] + 1
    again[0] = 1


def _damping_inputs() -> list[str]:
    """What mujoco_warp's kernel of joint damping reads, by name: 4.0 adds the damping by actuators to what
    3.17 has."""
    from mujoco_warp._src import forward

    return [arg.label for arg in forward._compute_damping_deriv.adj.args if arg.label != "deriv_out"]


class Integrator:
    """mujoco_warp's integrator as far as the accelerations with which it advances.

    Attributes:
      differs: whether they are others than the constraint solver's.
      qacc: (nworld, nv) wp.array float, what `integrate` found.
      inertia: (nworld, nM) wp.array float, M - h D as far as that is symmetric, laid out as mujoco_warp's M.
    """

    def __init__(self, m: "mjw.Model", d: "mjw.Data"):
        kind, off = int(m.opt.integrator), int(m.opt.disableflags)
        self._kind, smooth = kind, _ACTUATION | _SPRING | _DAMPER
        if kind in (_FAST, _IMPLICIT):
            self.differs = kind == _IMPLICIT or off & smooth != smooth
        else:
            damped = [getattr(m, name) for name in _damping_inputs() if "_damping" in name]
            self.differs = not off & (_DAMPER | _EULERDAMP) and any(x.numpy().any() for x in damped)
        self.qacc, self.inertia = d.qacc, d.M
        if not self.differs:
            return
        self.qacc = wp.zeros_like(d.qacc)
        self._matrix, self._now = wp.zeros_like(d.M), wp.zeros_like(d.M)
        self._factor, self._diagonal = wp.zeros_like(d.qLD), wp.zeros_like(d.qLDiagInv)
        self.inertia = self._matrix
        if kind == _IMPLICIT:
            self._matrix, self._now = wp.zeros_like(d.qLU), wp.zeros_like(d.qLU)
        elif kind != _FAST:
            self._damping = wp.zeros_like(d.qacc)

    def take_matrices(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Takes M - h D at this step's state, after mujoco_warp's actuation stage. Launches only."""
        from mujoco_warp._src import derivative, forward

        if self._kind == _IMPLICIT:
            forward.implicit_qlu(m, d)  # into d.qLU, which mujoco_warp itself fills when it integrates
            wp.copy(self._matrix, d.qLU)
            derivative.deriv_smooth_vel(m, d, self.inertia)  # its symmetric part
        elif self._kind == _FAST:
            derivative.deriv_smooth_vel(m, d, self._matrix)
            free = [m.body_dofadr, m.M_rownnz, m.M_rowadr, m.body_freeadr, d.M]
            self._launch(forward._implicit_free_body_reset_m, (d.nworld, m.body_freeadr.size), free)
        else:
            wp.copy(self._matrix, d.M)
            damping = [d.qvel if name == "qvel_in" else getattr(m, name) for name in _damping_inputs()]
            wp.launch(
                forward._compute_damping_deriv,
                dim=self._damping.shape,
                inputs=damping,
                outputs=[self._damping],
                device=self.qacc.device,
            )
            rows = [m.opt.timestep, m.M_rownnz, m.M_rowadr, self._damping]
            self._launch(forward._euler_damp_qfrc, self._damping.shape, rows)

    def integrate(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Finds `qacc` after mujoco_warp's constraint solver. Launches only."""
        from mujoco_warp._src import forward, smooth

        if self._kind == _IMPLICIT:
            wp.copy(self._now, self._matrix)  # is factored in place
            smooth.factor_solve_lu(m, d, self._now, self.qacc, d.efc.Ma)
        else:
            smooth.factor_solve_i(m, d, self._matrix, self._factor, self._diagonal, self.qacc, d.efc.Ma)
        if self._kind in (_FAST, _IMPLICIT):
            forward.implicit_free_body(m, d, d.efc.Ma, self.qacc, solve=True)

    def _launch(self, kernel, dim, inputs):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[self._matrix], device=self.qacc.device)
