"""From the accelerations that mujoco_warp's constraint solver finds to those with which its integrator moves
the bodies: `coupling/implicit/integrator.py` for all worlds at once, by mujoco_warp's own stages.

The rows answer to the former, a, but the skins to the latter, a'. The force c = beta h^2 S J (a - a')
corrects that. It moves the bodies too: Newton's method finds it, with the slope
1 - beta h^2 S J (R - H^-1 M R), where R are the accelerations by unit wrenches on the bodies while all rows
hold, and H is the integrator's matrix: of free bodies all of it, since fast spin makes much of it
antisymmetric, of other trees its symmetric part."""

import copy
import typing

import mujoco
import numpy as np
import warp as wp

from ...coupling.implicit.compliance import holds, substitute
from ...coupling.implicit.rounds import Model, make_model
from ...coupling.implicit.rules import MAX_CORRECTIONS, poorly_corrected
from ...geometry.rigid_warp import LEVER
from ...kernels import add_zeros, kernel_module, set_fields
from ...skin.block import block_max, sync
from ...skin.condensed.elimination import eliminate
from ...skin.program import Launcher
from ...skin.types import real, vec6
from .factor import Cones, Factor

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

kernel_module(__name__)


BLOCK = 64  # threads that correct the forces of a world
_MAX_CORRECTIONS = wp.constant(MAX_CORRECTIONS)
_CORRECTED = wp.constant(wp.float64(1e-5))  # of the skins' wrenches: accelerations are of single precision
_poorly_corrected = wp.func(poorly_corrected)
_FAST, _IMPLICIT = (
    int(getattr(mujoco.mjtIntegrator, f"mjINT_{name}")) for name in ("IMPLICITFAST", "IMPLICIT")
)
_ACTUATION, _SPRING, _DAMPER, _EULERDAMP = (
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    for name in ("ACTUATION", "SPRING", "DAMPER", "EULERDAMP")
)

# what mujoco_warp's kinematics writes
_POSES = "xpos xquat xmat xanchor xaxis xipos ximat geom_xpos geom_xmat site_xpos site_xmat".split()


@wp.struct
class Correction:
    """Correction of the forces of all skins [group, world]: what is added to them, and their remaining error
    (`Coupled.amiss`). One search for all skins of a world, since several may hold the same body."""

    force: wp.array2d(dtype=vec6)
    amiss: wp.array2d(dtype=vec6)
    rounds: wp.array(dtype=int)
    going: wp.array(dtype=int)  # whether another is to be found
    # [world, dof, unit wrench] accelerations of the constraint solver, of the integrator
    found: wp.array3d(dtype=real)
    moved: wp.array3d(dtype=real)
    matrix: wp.array2d(dtype=float)  # the slope of each world, what is amiss being the last entry of a row
    # of the skins: whether each acts [group], `Rounds.square`, Jacobians [group, world, dof], models
    acts: wp.array(dtype=int)
    square: wp.array2d(dtype=real)
    jacobian: wp.array3d(dtype=vec6)
    model: Model


def corrections(groups: int, nworld: int, nv: int) -> Correction:
    """None so far, on Warp's default device, of `groups` bodies of all skins, in models of nv degrees of
    freedom."""
    out, n = Correction(), 6 * groups
    add_zeros(out, "force amiss square", groups, nworld)
    add_zeros(out, "rounds going", nworld)
    add_zeros(out, "found moved", nworld, nv, n)
    add_zeros(out, "matrix", nworld, n * (n + 1))
    add_zeros(out, "jacobian", groups, nworld, nv)
    return set_fields(out, acts=wp.ones(groups, dtype=int), model=make_model(groups, nworld))


@wp.func
def _scale(i: int):
    """By which entry i of a wrench is divided, so that torques compare with forces."""
    return wp.where(i % 6 < 3, real(1.0), real(LEVER))


@wp.func
def _largest(m: vec6):
    size = real(0.0)
    for i in range(6):
        size = wp.max(size, wp.abs(m[i]) / _scale(i))
    return size


@wp.kernel
def begin_correction(going: wp.array(dtype=int), c: Correction):
    """Begins one in the worlds that are going, before mujoco_warp's answer. Skins that do not act, or hold no
    body, take none, whatever their last models took."""
    w = wp.tid()
    c.rounds[w] = 0
    c.going[w] = going[w]
    for k in range(wp.where(going[w] == 1, c.force.shape[0], 0)):
        if c.acts[k] == 0 or not holds(c.model, k, w):
            c.force[k, w] = vec6()


@wp.kernel
def find_amiss(
    # In:
    found: wp.array2d(dtype=float),
    moved: wp.array2d(dtype=float),
    # In and out:
    c: Correction,
    # Out:
    again_out: wp.array(dtype=int),
):
    """After mujoco_warp's answer a, a' [world, dof]: what the correction lacks, and which worlds need another
    one; sets again[0] where one does. One block per world."""
    w, t = wp.tid()
    if c.going[w] == 0:
        return
    wrong = real(0.0)
    most = real(0.0)
    largest = real(0.0)
    for k in range(t, c.jacobian.shape[0], wp.block_dim()):
        excess = vec6()
        if c.acts[k] == 1 and holds(c.model, k, w):
            motion = vec6()
            for i in range(c.jacobian.shape[2]):
                motion += c.square[k, w] * real(found[w, i] - moved[w, i]) * c.jacobian[k, w, i]
            excess = c.model.tangent0[k, w] * motion
            largest = wp.max(largest, _largest(c.model.wrench0[k, w]))
        lacks = excess - c.force[k, w]
        c.amiss[k, w] = -lacks
        wrong = wp.max(wrong, _largest(lacks))
        most = wp.max(most, _largest(excess))
    wrong, most, largest = block_max(wrong), block_max(most), block_max(largest)
    if t == 0:
        c.going[w] = 0
        if c.rounds[w] < _MAX_CORRECTIONS and _poorly_corrected(wrong, most, largest, _CORRECTED):
            c.rounds[w] = c.rounds[w] + 1
            c.going[w] = 1
            again_out[0] = 1


@wp.kernel
def respond(
    # In:
    held: wp.array3d(dtype=real),
    damped: wp.array3d(dtype=real),
    inertia: wp.array2d(dtype=float),
    rownnz: wp.array(dtype=int),
    rowadr: wp.array(dtype=int),
    colind: wp.array(dtype=int),
    free: wp.array(dtype=int),
    dofadr: wp.array(dtype=int),
    driven: wp.array3d(dtype=float),
    # In and out:
    c: Correction,
):
    """Accelerations by a unit wrench on a body. held, damped: factors of M with all rows, of the
    integrator's matrix. free, driven: see `Integrator`."""
    w, column = wp.tid()
    if c.going[w] == 0:
        return
    n = c.jacobian.shape[2]
    for i in range(n):
        c.found[w, i, column] = c.jacobian[column / 6, w, i][column % 6]
        c.moved[w, i, column] = real(0.0)
    substitute(held, w, column, c.found)
    for i in range(n):
        for k in range(rownnz[i]):
            j = colind[rowadr[i] + k]
            m = real(inertia[w, rowadr[i] + k])
            c.moved[w, i, column] = c.moved[w, i, column] + m * c.found[w, j, column]
            if i != j:
                c.moved[w, j, column] = c.moved[w, j, column] + m * c.found[w, i, column]
    substitute(damped, w, column, c.moved)
    for b in range(free.shape[0]):
        first = dofadr[free[b]]
        force = vec6()
        for i in range(first, first + 6):
            for k in range(rownnz[i]):
                j = colind[rowadr[i] + k]
                m = real(inertia[w, rowadr[i] + k])
                force[i - first] = force[i - first] + m * c.found[w, j, column]
                if i != j:
                    force[j - first] = force[j - first] + m * c.found[w, i, column]
        for i in range(first, first + 6):
            moved = real(0.0)
            for k in range(6):
                moved += real(driven[k, w, i]) * force[k]
            c.moved[w, i, column] = moved


@wp.kernel
def speed_up(
    stopped: wp.array(dtype=int), step: float, qacc: wp.array2d(dtype=float), qvel: wp.array2d(dtype=float)
):
    """Velocities at the end of the step, in worlds where a solid part of a BioTac stops a body."""
    w, i = wp.tid()
    if stopped[w] == 1:
        qvel[w, i] = qvel[w, i] + step * qacc[w, i]


@wp.kernel
def write_slope(c: Correction):
    """Writes the slope; a skin that does not act is not corrected."""
    w, k, column = wp.tid()
    if c.going[w] == 0:
        return
    n = c.found.shape[2]
    motion = vec6()
    lacks = vec6()
    if c.acts[k] == 1:
        for i in range(c.jacobian.shape[2]):
            motion += c.square[k, w] * (c.found[w, i, column] - c.moved[w, i, column]) * c.jacobian[k, w, i]
        motion = c.model.tangent0[k, w] * motion
        lacks = -c.amiss[k, w]
    for b in range(6):
        row = 6 * k + b
        value = wp.where(row == column, real(1.0), real(0.0))
        value -= motion[b] * _scale(column) / _scale(row)
        c.matrix[w, row * (n + 1) + column] = float(value)
        if column == 0:
            c.matrix[w, row * (n + 1) + n] = float(lacks[b] / _scale(row))


@wp.kernel(module=kernel_module(f"{__name__}.step"))  # with blocks of its own size
def step(c: Correction):
    """A step of Newton's method, by the threads of a block."""
    w, t = wp.tid()
    if c.going[w] == 0:
        return
    n = c.found.shape[2]
    if eliminate(c.matrix, w, n, 1) == 0:
        return
    for k in range(t, c.force.shape[0], wp.block_dim()):
        change = vec6()
        for b in range(6):
            row = 6 * k + b
            change[b] = _scale(row) * real(c.matrix[w, row * (n + 1) + n])
        c.force[k, w] = c.force[k, w] + change
    sync()


class Slope:
    """Steps of Newton's method to the corrections of all worlds.

    Args:
      m: mujoco_warp Model. nworld: number of worlds. cones: of its Data.
    """

    def __init__(self, m: "mjw.Model", nworld: int, cones: Cones):
        self._held, self._damped = (Factor(m, nworld, cones) for _ in range(2))

    def find(self, m: "mjw.Model", d: "mjw.Data", integrator: "Integrator", c: Correction) -> None:
        """Corrects the forces, after mujoco_warp's constraint solver and `find_amiss`. Launches only."""
        device = d.qpos.device
        self._held.find(m, d, c.going, d.M)
        self._damped.find(m, d, c.going, integrator.inertia, springs=False)
        factors = [self._held.L, self._damped.L, d.M, m.M_rownnz, m.M_rowadr, m.M_colind]
        free = [integrator.free, m.body_dofadr, integrator.driven]
        worlds, _, columns = c.found.shape
        wp.launch(respond, (worlds, columns), [*factors, *free, c], device=device)
        wp.launch(write_slope, (worlds, columns // 6, columns), [c], device=device)
        Launcher(device).launch_blocks(step, [worlds], [c], block_dim=BLOCK)


def _damping_inputs() -> list[str]:
    """Names of the inputs of mujoco_warp's kernel of joint damping: 4.0 adds the damping by actuators to
    those of 3.17."""
    from mujoco_warp._src import forward

    return [arg.label for arg in forward._compute_damping_deriv.adj.args if arg.label != "deriv_out"]


@wp.kernel
def accept_accelerations(
    going: wp.array(dtype=int),
    # In and out:
    found: wp.array2d(dtype=float),
    accepted: wp.array2d(dtype=float),
):
    w, i = wp.tid()
    if going[w] == 1:
        accepted[w, i] = found[w, i]
    else:
        found[w, i] = accepted[w, i]


def accept(going: wp.array, found: wp.array, accepted: wp.array) -> None:
    """Takes accelerations (nworld, nv) that were found in worlds that are going (nworld,), and puts back
    those of the others. Launches only."""
    wp.launch(accept_accelerations, found.shape, [going], [found, accepted], device=found.device)


class Integrator:
    """mujoco_warp's integrator as far as the accelerations with which it advances.

    Attributes:
      differs: whether they are others than the constraint solver's.
      qacc: (nworld, nv) wp.array float, what `integrate` found.
      inertia: (nworld, nM) wp.array float, M - h D as far as that is symmetric, laid out as mujoco_warp's M.
      free: wp.array int, numbers of the free bodies, whose velocity products it has in D. driven: (6, nworld,
        nv) wp.array float, their accelerations by a unit of the force on each of their degrees of freedom.
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
        self.qacc, self._found = wp.zeros_like(d.qacc), wp.zeros_like(d.qacc)
        free = m.body_freeadr.numpy() if kind in (_FAST, _IMPLICIT) else np.zeros(0, np.int32)
        unit = np.zeros((6, *d.qacc.shape), np.float32)
        for k, force in enumerate(unit):
            force[:, m.body_dofadr.numpy()[free] + k] = 1.0
        with wp.ScopedDevice(d.qacc.device):
            self.free, self._unit = wp.array(free, dtype=int), wp.array(unit, dtype=float)
            self.driven = wp.zeros_like(self._unit)
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
        if len(self.free):
            for k in range(6):
                forward.implicit_free_body(m, d, self._unit[k], self.driven[k], solve=True)

    def integrate(self, m: "mjw.Model", d: "mjw.Data", going: wp.array) -> None:
        """Finds `qacc` of the worlds that are going (nworld,), after mujoco_warp's constraint solver.
        Launches only."""
        from mujoco_warp._src import forward, smooth

        if self._kind == _IMPLICIT:
            wp.copy(self._now, self._matrix)  # is factored in place
            smooth.factor_solve_lu(m, d, self._now, self._found, d.efc.Ma)
        else:
            smooth.factor_solve_i(m, d, self._matrix, self._factor, self._diagonal, self._found, d.efc.Ma)
        if self._kind in (_FAST, _IMPLICIT):
            forward.implicit_free_body(m, d, d.efc.Ma, self._found, solve=True)
        accept(going, self._found, self.qacc)

    def _launch(self, kernel, dim, inputs):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[self._matrix], device=self.qacc.device)


class Ends:
    """Poses of the bodies of a mujoco_warp Data after the step that it is in: joints move along arcs, while
    the skin is solved along straight lines, and mujoco_warp has no callback after it integrates."""

    def __init__(self, d: "mjw.Data"):
        # kinematics leaves what never moves as it is
        self._own = {name: wp.clone(getattr(d, name)) for name in ("qpos", "qvel", *_POSES)}

    def find(self, m: "mjw.Model", d: "mjw.Data", qacc: wp.array) -> "mjw.Data":
        """`d` after a step with the integrator's accelerations (nworld, nv), as far as velocities and poses.
        Launches only."""
        import mujoco_warp as mjw
        from mujoco_warp._src import forward

        end, step, device = copy.copy(d), m.opt.timestep, d.qpos.device
        for name, array in self._own.items():
            setattr(end, name, array)
        wp.launch(
            forward._next_velocity,
            dim=d.qvel.shape,
            inputs=[step, d.qvel, qacc, 1.0],
            outputs=[end.qvel],
            device=device,
        )
        joints = [m.jnt_type, m.jnt_qposadr, m.jnt_dofadr]
        wp.launch(
            forward._next_position,
            dim=(d.nworld, m.njnt),
            inputs=[step, *joints, d.qpos, end.qvel, 1.0],
            outputs=[end.qpos],
            device=device,
        )
        mjw.kinematics(m, end)
        return end
