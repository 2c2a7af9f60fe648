"""Derivatives of MuJoCo's own part of a step, for given skin wrenches, by central differences.

The model is stepped without the plugin, which takes microseconds, so no skin is solved for a difference.
Positions are perturbed along tangents, like `mj_integratePos`."""

import copy

import mujoco
import numpy as np

from ...coupling.implicit.kinematics import Kinematics
from ...coupling.implicit.rules import beta_of
from ...coupling.instance import Instance
from ...coupling.structs import DataView, ModelView, c_structs
from ...geometry.rigid import displacement

_EPS = 1e-6  # central difference: rounding and curvature errors are then both about 1e-10
_SOLVED = 1e-13, 200  # least tolerance and iterations of MuJoCo's solver, whose residual enters differences


class Start:
    """Initial state of a step: arrays by the names of mjData. `skins`: wrenches (ngroup, 6) of each."""

    NAMES = ("qpos", "qvel", "act", "ctrl", "qfrc_applied", "xfrc_applied", "mocap_pos", "mocap_quat")

    def __init__(self, data: mujoco.MjData):
        for name in (*self.NAMES, "qacc_warmstart", "eq_active"):
            setattr(self, name, np.array(getattr(data, name)))
        self.time = data.time


class Bodies:
    """A model's bodies without the skins.

    Attributes:
      sizes: of the tangents: "qpos" nv, "qvel" nv, "act" na, "ctrl" nu, "qfrc_applied" nv, "mocap_pos"
        3 nmocap, "mocap_quat" 3 nmocap. ny: of qpos, qvel and act together.
    """

    def __init__(self, model: mujoco.MjModel, instances: list[Instance]):
        self.model = bare = copy.copy(model)
        option = bare.opt
        option.tolerance = min(option.tolerance, _SOLVED[0])
        option.iterations = max(option.iterations, _SOLVED[1])
        self.data = mujoco.MjData(bare)
        # MuJoCo makes no model without its plugins: the step runs with a plugin count of zero
        struct = c_structs("mjModel").from_address(bare._address)
        struct.nplugin = 0
        view = ModelView(bare._address)
        seen = DataView(self.data._address, view)
        self.instances = instances
        self._kinematics = [Kinematics(view, seen, [one.touching]) for one in instances]
        nv, na, nu, nm = model.nv, model.na, model.nu, model.nmocap
        names = "qpos", "qvel", "act", "ctrl", "qfrc_applied", "mocap_pos", "mocap_quat"
        self.sizes = dict(zip(names, (nv, nv, na, nu, nv, 3 * nm, 3 * nm)))
        self.ny, self.nv = 2 * nv + na, nv
        slots = [slot for one in instances if one.two_way for slot in one.slots.values()]
        self._slots = np.array(slots, int)

    def _put(self, start, moved):
        """Sets the data to the initial state, perturbed by tangents by name."""
        data = self.data
        for name in Start.NAMES:
            getattr(data, name)[:] = getattr(start, name)
        data.qacc_warmstart[:], data.eq_active[:] = start.qacc_warmstart, start.eq_active
        data.time = start.time
        data.eq_active[self._slots] = 0  # wrenches of the skins are given
        for name, value in moved.items():
            if name == "qpos":
                mujoco.mj_integratePos(self.model, data.qpos, value, 1.0)
            elif name == "mocap_quat":
                for i, turn in enumerate(value.reshape(-1, 3)):
                    mujoco.mju_quatIntegrate(data.mocap_quat[i], turn, 1.0)
            else:
                into = getattr(data, name)
                into += value.reshape(into.shape)

    def _step(self, start, wrenches, moved):
        """Steps; the result is in the data."""
        self._put(start, moved)
        data = self.data
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        for one, bodies, wrench in zip(self.instances, self._kinematics, wrenches):
            if one.two_way and wrench.any():
                data.qfrc_applied += np.einsum("ni,nij->j", wrench, bodies.jacobians())
        mujoco.mj_step(self.model, data)

    def _end(self):
        data = self.data
        return data.qpos.copy(), data.qvel.copy(), data.act.copy(), data.sensordata.copy()

    def _difference(self, one, other):
        out = np.empty(self.nv)
        mujoco.mj_differentiatePos(self.model, out, 1.0, other[0], one[0])
        return np.concatenate([out, *(a - b for a, b in zip(one[1:], other[1:]))])

    def mismatch(self, start: Start, wrenches: list, qvel: np.ndarray) -> float:
        """Largest difference between the velocities (nv,) after a step and those that given wrenches produce
        [m/s, rad/s]."""
        self._step(start, wrenches, {})
        return float(np.abs(self.data.qvel - qvel).max(initial=0.0))

    def step_slopes(self, start: Start, wrenches: list, names: tuple) -> tuple[dict, list]:
        """Derivatives of the step's result (qpos, qvel, act and sensordata, concatenated tangents) by its
        initial state: {name: (ny + nsensordata, size)}, and by the skins' wrenches: for each (ny +
        nsensordata, 6 ngroup)."""
        out = {}
        for name in {*names, "qpos", "qvel", "act", "qfrc_applied"}:
            columns = []
            for unit in np.eye(self.sizes[name]):
                ends = []
                for sign in (_EPS, -_EPS):
                    self._step(start, wrenches, {name: sign * unit})
                    ends.append(self._end())
                columns.append(self._difference(*ends) / (2 * _EPS))
            rows = self.ny + self.model.nsensordata
            out[name] = np.array(columns).T if columns else np.zeros((rows, 0))
        self._put(start, {})
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        by_wrench = []
        for one, bodies in zip(self.instances, self._kinematics):
            jacobian = np.zeros((6 * one.setup.ngroup, self.nv))
            if one.two_way:
                jacobian = bodies.jacobians().reshape(jacobian.shape)
            by_wrench.append(out["qfrc_applied"] @ jacobian.T)
        return out, by_wrench

    def pose_slopes(self, start: Start, after: np.ndarray, gammas: list, names: tuple) -> list:
        """Derivatives of the geom poses at which skins are solved in a step.

        Args:
          start: of the step. after: (nv,) velocities at its end.
          gammas: Newmark's gamma (ngroup,) of the step for each skin that was solved for velocities at both
            ends; None: it was solved for those at the start.
          names: of further variables.

        Returns:
          for each skin {name: (6 ngeom, size)}: translations [m] and rotation vectors about the geoms'
          origins, in the
            BioTac frame, by the name of the variable; "after" are velocities at the end of the step.
        """

        def geom_poses(qvel, moved, one):
            data = self.data
            self._put(start, {name: value for name, value in moved.items() if name not in ("qvel", "after")})
            data.qvel[:] = qvel
            mujoco.mj_kinematics(self.model, data)
            mujoco.mj_comPos(self.model, data)
            mujoco.mj_comVel(self.model, data)
            bodies = self._kinematics[self.instances.index(one)]
            return one.touching.geom_pose(*bodies.predict(one.model.opt.timestep))

        def slopes_of(one, gamma):
            weight = {"qvel": 1.0}  # of velocities in the pose of the solve
            if gamma is not None:
                weight = {"after": beta_of(gamma), "qvel": gamma - 0.5 - beta_of(gamma)}
            speed = weight["qvel"] * start.qvel + weight.get("after", 0.0) * after
            slopes = {}
            for name in {"qpos", *weight, *set(names) & {"mocap_pos", "mocap_quat"}}:
                columns, ngeom = [], len(one.touching.geoms)
                for unit in np.eye(self.sizes.get(name, self.nv)):
                    (p1, m1), (p0, m0) = (
                        geom_poses(
                            speed + sign * weight[name] * unit if name in weight else speed,
                            {name: sign * unit},
                            one,
                        )
                        for sign in (_EPS, -_EPS)
                    )
                    turn = displacement(p1, m1, p0, m0)[:, 3:]
                    columns.append(np.concatenate([p1 - p0, turn], 1).ravel() / (2 * _EPS))
                slopes[name] = np.array(columns).T if columns else np.zeros((6 * ngeom, 0))
            return slopes

        out = []
        for one, gamma in zip(self.instances, gammas):
            members = [None] if gamma is None else np.unique(gamma).tolist() or [None]
            slopes = slopes_of(one, members[0])
            for other in members[1:]:  # of bodies that step otherwise
                rows = np.repeat((gamma == other)[one.touching.group], 6)
                for name, value in slopes_of(one, other).items():
                    slopes[name][rows] = value[rows]
            out.append(slopes)
        return out
