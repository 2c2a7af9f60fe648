"""From the accelerations that MuJoCo's constraint solver finds to those with which its integrator moves the
bodies.

Euler, implicitfast and implicit treat velocity-dependent forces implicitly, after the solver. They advance
with a' = (M - h D)^-1 M a, where D is the derivative with respect to the velocities: of joint damping
(Euler), or of all smooth forces (the other two). Where h D is much larger than M, as with a light object
on a damped joint, a' is a small part of a.

They go by the forces that M a should balance, not by a. The two differ where MuJoCo's solver has not
finished, as with a light body between the skin and a heavy one."""

import mujoco
import numpy as np

from ..structs import LIBRARY, DataView, ModelView
from .springs import Springs

_EULER, _FAST, _IMPLICIT = (
    int(getattr(mujoco.mjtIntegrator, f"mjINT_{name}")) for name in ("EULER", "IMPLICITFAST", "IMPLICIT")
)
_NO_DAMPER, _NO_EULERDAMP = (
    int(mujoco.mjtDisableBit.mjDSBL_DAMPER),
    int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP),
)
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_NEGLIGIBLE = 1e-9  # h D relative to M


class Integrator:
    """(M - h D)^-1 M of the kinematic trees that `bodies` belong to; the others' accelerations are left as
    they are.

    Left out: what Euler takes from the damping of actuators.

    Attributes:
      by_forces: whether bodies are moved by the forces, since the last `take_matrices`.
      inertia: (nM,) M - h D as far as that is symmetric, laid out as MuJoCo's M.
    """

    def __init__(self, model: ModelView, bodies: set | list):
        self.model = model
        trees = np.unique([t for t in model.body_treeid[list(bodies)] if t >= 0])
        self.dofs = np.flatnonzero(np.isin(model.dof_treeid, trees))
        place = np.full(model.nv, -1)
        place[self.dofs] = np.arange(len(self.dofs))
        trees, size = np.unique(model.dof_treeid[self.dofs], return_counts=True)
        free = model.dof_treeid[model.jnt_dofadr[model.jnt_type == _FREE]]
        self._lone = np.isin(model.dof_treeid[self.dofs], np.intersect1d(trees[size == 6], free))
        self._mass = self._entries(place, model.M_rownnz, model.M_colind)
        self._derivative = self._entries(place, model.D_rownnz, model.D_colind)
        below = self._derivative[1] >= self._derivative[2]
        self._lower = tuple(part[below] for part in self._derivative)

    def _entries(self, place, count, column):
        """Indices, rows and columns of a sparse matrix's entries in the rows of `dofs`; trees have no entries
        in common."""
        row = place[np.repeat(np.arange(len(count)), count)]
        entry = np.flatnonzero(row >= 0)
        return entry, row[entry], place[column[entry]]

    def take_matrices(self, data: DataView) -> bool:
        """Takes M and D at this step's state, after MuJoCo's actuation stage; returns whether a' differs from
        a."""
        size, h = len(self.dofs), self.model.opt.timestep
        derivative, self._step = np.zeros((size, size)), None
        self.by_forces = self.model.opt.integrator in (_FAST, _IMPLICIT)
        if self.by_forces:
            fast = self.model.opt.integrator == _FAST
            derivative = self._derived(data, not fast, fast)
        elif self.model.opt.integrator == _EULER and not self.model.opt.disableflags & (
            _NO_DAMPER | _NO_EULERDAMP
        ):
            self.by_forces = self.model.dof_damping.any() or self.model.dof_dampingpoly.any()
            speed, high = np.abs(data.qvel[self.dofs]), self.model.dof_dampingpoly[self.dofs]
            damping = self.model.dof_damping[self.dofs] + 2 * high[:, 0] * speed + 3 * high[:, 1] * speed**2
            derivative[np.diag_indices(size)] = -damping
        entry, row, column = self._mass
        inertia = np.zeros((size, size))
        inertia[row, column] = inertia[column, row] = data.M[entry]
        scale = 1 / np.sqrt(inertia.diagonal())
        if self.model.opt.integrator == _FAST and data.qvel[self.dofs[self._lone]].any():
            # of lone free bodies implicitfast has the velocity products in D, too
            derivative = np.where(self._lone[:, None], self._derived(data, True), derivative)
        if h * np.abs(scale[:, None] * derivative * scale).max(initial=0.0) < _NEGLIGIBLE:
            return False
        self._step = np.linalg.solve(inertia - h * derivative, inertia)
        self.inertia = data.M.copy()
        self.inertia[entry] -= 0.5 * h * (derivative[row, column] + derivative[column, row])
        return True

    def _derived(self, data, products, symmetric=False):
        """(n, n) derivative of the smooth forces in the velocities, maybe with that of velocity products. As
        symmetric the lower triangle stands for both, as in implicitfast."""
        LIBRARY.mjd_smooth_vel(self.model.address, data.address, int(products))
        entry, row, column = self._lower if symmetric else self._derivative
        out = np.zeros((len(self.dofs), len(self.dofs)))
        out[row, column] = value = data.qDeriv[entry]
        if symmetric:
            out[column, row] = value
        return out

    def integrated(self, acceleration: np.ndarray) -> np.ndarray:
        """(..., nv) a' of a (..., nv)."""
        out = acceleration.copy()
        if self._step is not None:
            out[..., self.dofs] = acceleration[..., self.dofs] @ self._step.T
        return out

    def accelerations(self, data: DataView, found: np.ndarray) -> np.ndarray:
        """(nv,) a', with which MuJoCo will move the bodies; found: a (nv,) of its constraint solver."""
        if self.by_forces:
            found = data.moved_by((data.qfrc_smooth + data.qfrc_constraint)[None])[0]
        return self.integrated(found)

    def answer(
        self, acceleration: np.ndarray, springs: Springs, stiffness: np.ndarray, correction: np.ndarray
    ) -> np.ndarray:
        """(nv,) accelerations a of (M + C) a + K a' = f, where MuJoCo's constraint solver has found those of
        (M + C) a + K a = f + `correction` (nv,), with the stiffness K (nv, nv) of the skins, and C of the
        other rows that hold: these may be others in each round."""
        springs.take(None)
        springs.factor(None)
        L = springs.L.numpy()[0]
        held = L @ L.T
        driven = stiffness.copy()
        driven[:, self.dofs] = stiffness[:, self.dofs] @ self._step
        return np.linalg.solve(held + driven, (held + stiffness) @ acceleration - correction)
