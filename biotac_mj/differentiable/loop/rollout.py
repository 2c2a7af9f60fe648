"""`rollout`: steps of MuJoCo with BioTacs as a differentiable PyTorch function."""

import copy
import dataclasses

import mujoco
import numpy as np
import torch

from ...coupling.handle import handles
from ...fields import as_real, as_whole
from ...plugin.engine import world_of
from ..readings.counts import electrode_counts, pdc_counts
from ..readings.film import impedance
from ..skin import refuse_beyond
from ..tensors import real_tensor
from .bodies import Bodies, Start
from .skins import Cotangent, LoopSkin

AGREE = 1e-8  # [m] between bodies and skins, see `rollout`
_STATE, _DRIVEN = ("qpos", "qvel", "act"), ("ctrl", "qfrc_applied", "mocap_pos", "mocap_quat")
_RANK = 1e-10  # of the largest: wrenches that move no body in contact with a skin
_NONE = 1e-15  # norm of an invalid quaternion
_LEVER = np.array([1.0] * 3 + [100.0] * 3)  # 1 / m: converts torques to forces for comparison


@dataclasses.dataclass
class Rolled:
    """Result of a rollout, as differentiable tensors of double precision; all (..., nstep, ...).

    Attributes:
      qpos, qvel, act: MuJoCo's state at the end of each step.
      sensordata: MuJoCo's own sensors at the start of each step, as after `mj_step`. The BioTacs' own sensors
        have their counts and no gradient.
      nodes: of each BioTac, by its name in `handles`, (nvert, 3) in its frame [m].
      wrench: of each, (ngroup, 6) of the skin on each body that may touch it, `Handle.linear_model`'s bodies:
        torque about the frame's origin, in its frame [N, N m].
      pressure: of each, of the liquid above rest [Pa].
      lost: per world, number of steps in which bodies and skins did not agree. mismatch: per world, the
        largest difference between a velocity and MuJoCo's result for these wrenches [m/s, rad/s], which the
        gradient ignores.
      readings: of each BioTac, as in its model.
    """

    qpos: torch.Tensor
    qvel: torch.Tensor
    act: torch.Tensor
    sensordata: torch.Tensor
    nodes: dict
    wrench: dict
    pressure: dict
    lost: list
    mismatch: list
    readings: dict

    def electrodes(self, name: str = "biotac_", step: int = -1) -> torch.Tensor:
        """(..., nelectrode) counts of a BioTac's electrodes after a step, without noise, rounding and
        time-dependent effects.

        Raises:
          ValueError: its readings have no film.
        """
        film, nodes = getattr(self.readings[name], "film", None), self.nodes[name][..., step, :, :]
        if film is None:
            raise ValueError(f"the readings of BioTac {name!r} have no film: attach it with readings=True")
        each = [impedance(film, one) for one in nodes.reshape(-1, *nodes.shape[-2:])]
        counts = electrode_counts(torch.stack(each), film.rest, self.readings[name].sensor)
        return counts.reshape(*nodes.shape[:-2], -1)

    def pdc(self, name: str = "biotac_") -> torch.Tensor:
        """(..., nstep) counts of PDC, likewise."""
        return pdc_counts(self.pressure[name], self.readings[name].sensor)


def rollout(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    nstep: int | None = None,
    qpos: torch.Tensor | None = None,
    qvel: torch.Tensor | None = None,
    act: torch.Tensor | None = None,
    ctrl: torch.Tensor | None = None,
    qfrc_applied: torch.Tensor | None = None,
    mocap_pos: torch.Tensor | None = None,
    mocap_quat: torch.Tensor | None = None,
    agree: float = AGREE,
) -> Rolled:
    """Steps a model with BioTacs by `mj_step`; reverse-mode differentiable by all tensors.

    What is differentiated, and how:
      The skins by the implicit function theorem: each step's equilibrium is solved again from its result to a
      tolerance of 1e-6, and linearised with friction, core, liquid and memory of the rubber (`press`).
      Bodies and skins jointly: a step is v' = v + h a(W), with skins solved at the pose of Newmark's formula
        in v and
      v', and so is its adjoint. Newmark's gamma is a constant: for a step that is too long for its contact
      (docs/design.md), its dependence on stiffness is ignored.
      MuJoCo's part, its own contacts and constraints, actuators, integrator and sensors, by central
      differences of 1e-6 for given skin wrenches: exact where it is smooth, one-sided or a mean of both sides
      at a kink. The solver's `tolerance` should be small (1e-10).

    Not differentiated: rounding, noise and time-dependent effects in the readings; heat and PAC; the skin's
    state in `data`, a constant; constants of the skins and of the model; the limit of a skin's energy, which
    `mismatch` shows; for a skin at rest reached by geoms that move more than 0.5 mm per step, the point of
    first contact. Callbacks, other plugins and sleep are ignored.

    Spinning bodies are stepped slightly differently from `mj_step`, whose wrenches contain a term of
    stiffness times rotation times displacement that has no gradient: 0.2 % of the spin of a ball that starts
    to roll at 11 rad/s. Without rotation, steps equal those of `mj_step`. Verified against central
    differences: slides, hinges, free and mocap bodies, one and two BioTacs; not one-way skins, nor rubber
    with memory.

    Args:
      model: with BioTacs of the full tier, on the CPU. Their skins should be solved to a small tolerance:
        attach with options={"skin": {"tolerance": 1e-6}}.
      data: initial state of skins and of all that is not given; it is not changed.
      nstep: number of steps; None: that of the controls.
      qpos, qvel, act: (nq,), (nv,), (na,) initial values, or with a leading nworld. A quaternion's cotangent
        is along rotations.
      ctrl, qfrc_applied: (nstep, nu), (nstep, nv), or (nworld, nstep, ...). mocap_pos, mocap_quat: (nstep,
        nmocap, 3), (nstep, nmocap, 4), likewise. None: those of data.
      agree: [m] largest difference between the bodies and the poses of the skins' solves: smaller than in a
        simulation (2e-6), since a gradient ignores it. This takes more rounds.

    Raises:
      ValueError: incompatible shapes, values that are not finite, no BioTac, or features without gradient:
        the condensed tier, a skin on a GPU, another BioTac's skin, ellipsoids, implicit dynamics, a
        contact_law, a rest_pressure, Runge-Kutta, a custom skin.
    """
    if not isinstance(model, mujoco.MjModel) or not isinstance(data, mujoco.MjData):
        raise ValueError("model and data are needed: an MjModel and its MjData")
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        raise ValueError("gradients through RK4 are not there: take implicitfast, implicit or Euler")
    if len(data.qpos) != model.nq or len(data.plugin_state) != model.npluginstate:
        raise ValueError("data is of another model: make it with MjData(model)")
    if nstep is not None:
        nstep = as_whole("nstep", nstep, 1)
    as_real("agree", agree, 0.0, above=True, unit="m")
    for name in (*_STATE, *_DRIVEN, "xfrc_applied"):
        if not np.isfinite(getattr(data, name)).all():
            raise ValueError(f"data.{name} is not finite: the simulation has diverged, or it was set so")
    given = {"qpos": qpos, "qvel": qvel, "act": act, "ctrl": ctrl, "qfrc_applied": qfrc_applied}
    given |= {"mocap_pos": mocap_pos, "mocap_quat": mocap_quat}
    given = {name: real_tensor(name, value).cpu() for name, value in given.items() if value is not None}
    shape = {name: np.shape(getattr(data, name)) for name in (*_STATE, *_DRIVEN)}
    lengths, worlds = {int(nstep)} if nstep is not None else set(), set()
    for name, value in given.items():
        own, driven = len(shape[name]), name in _DRIVEN
        if tuple(value.shape[value.ndim - own :]) != shape[name] or value.ndim - own - driven not in (0, 1):
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}: pass {('nstep',) * driven + shape[name]}, or with "
                "nworld before"
            )
        if not torch.isfinite(value).all():
            raise ValueError(f"{name} is not finite")
        if driven:
            lengths.add(value.shape[-own - 1])
        if value.ndim - own - driven:
            worlds.add(len(value))
    if len(lengths) != 1 or lengths == {0} or len(worlds) > 1 or worlds == {0}:
        raise ValueError(
            f"numbers of steps {sorted(lengths)} and of worlds {sorted(worlds)}: give nstep, or what drives, "
            "of one length, and worlds of one number"
        )
    (nstep,), nworld, single = lengths, max(worlds, default=1), not worlds
    names, runs = tuple(given), [_Run(model, data, nstep, agree) for _ in range(nworld)]
    ends = []
    for w, run in enumerate(runs):
        own = [v[w] if v.ndim > len(shape[n]) + (n in _DRIVEN) else v for n, v in given.items()]
        ends.append(_Rollout.apply(run, names, *own))
    out = [torch.stack(one) for one in zip(*ends)]
    if single:
        out = [one[0] for one in out]
    skins, per = runs[0].skins, [out[i::3] for i in (4, 5, 6)]
    each = [{s.name: value for s, value in zip(skins, one)} for one in per]
    readings = {s.name: s.instance.setup.skin.readings for s in skins}
    return Rolled(*out[:4], *each, [r.lost for r in runs], [r.mismatch for r in runs], readings)


class _Run:
    """One world's steps, with the data for their adjoint."""

    def __init__(self, model, data, nstep, agree):
        self.model, self.nstep = model, nstep
        self.data = copy.copy(data)
        world = world_of(model, self.data)
        if world is None:
            raise ValueError("the model has no BioTac: attach one, or differentiate with mjd_transitionFD")
        world.tolerance = agree
        self.skins = [
            LoopSkin(name, world.instances[int(model.body_plugin[model.body(handle.body).id])])
            for name, handle in handles(model).items()
        ]
        for skin in self.skins:
            refuse_beyond(skin.stepper.model)
        self.bodies = Bodies(model, [s.instance for s in self.skins])
        self.lost, self.mismatch = 0, 0.0

    def step(self, given):
        """Runs all steps; returns their results."""
        data, out = self.data, []
        self.starts, self.kept, self.qvel = [], [], []
        for name in set(_STATE) & set(given):
            getattr(data, name)[:] = given[name]
        self.begin, self.qpos = [s.stepper.used(s.part()) for s in self.skins], data.qpos.copy()
        self.long = []  # norms of the given mocap quaternions
        for t in range(self.nstep):
            for name in set(_DRIVEN) & set(given):
                getattr(data, name)[:] = given[name][t]
            self.long.append(np.linalg.norm(data.mocap_quat, axis=1))
            data.mocap_quat[:] /= np.maximum(self.long[-1], _NONE)[:, None]
            mujoco.mj_normalizeQuat(self.model, data.qpos)
            before = [s.part().copy() for s in self.skins]
            self.starts.append(Start(data))
            mujoco.mj_step(self.model, data)
            kept = [s.keep(b) for s, b in zip(self.skins, before)]
            self.kept.append(kept)
            wrenches = [k.wrench for k in kept]
            self.qvel.append(data.qvel.copy())
            self.mismatch = max(self.mismatch, self.bodies.mismatch(self.starts[-1], wrenches, data.qvel))
            self.lost += any(s.instance.setup.parts(s.instance.state)[0][1] != 1.0 for s in self.skins)
            row = [data.qpos.copy(), data.qvel.copy(), data.act.copy(), data.sensordata.copy()]
            for s, k in zip(self.skins, kept):
                row += [s.nodes(k.state).copy(), k.wrench, np.array(s.pressure(k.state))]
            out.append(row)
        self.ends = [row[0] for row in out]
        return [np.array(one) for one in zip(*out)]

    def back(self, names, cotangents):
        """Cotangents of the inputs, by name, from those of the outputs."""
        model, bodies, nv = self.model, self.bodies, self.model.nv
        qpos, qvel, act, sensors, *own = cotangents
        y = np.zeros(bodies.ny)
        skins = [Cotangent.none(s.skin) for s in self.skins]
        driven = {n: np.zeros((self.nstep, *np.shape(getattr(self.data, n)))) for n in names if n in _DRIVEN}
        for s in self.skins:
            s.skin.begin_solves()
        for t in reversed(range(self.nstep)):
            y[:nv] += _along(model, self.ends[t], qpos[t])
            y[nv : 2 * nv] += qvel[t]
            y[2 * nv :] += act[t]
            for i, s in enumerate(self.skins):
                skins[i].x[: s.nvert, 0] += torch.from_numpy(own[3 * i][t])
                skins[i].pressure += float(own[3 * i + 2][t])
            wrenches = [own[3 * i + 1][t] for i in range(len(self.skins))]
            y, more, skins = self._back(t, np.concatenate([y, sensors[t]]), wrenches, skins, tuple(driven))
            for name, value in more.items():
                if name == "mocap_quat":
                    turns = zip(self.starts[t].mocap_quat, value.reshape(-1, 3), self.long[t])
                    driven[name][t] = [_to_quat(q, w) / max(n, _NONE) for q, w, n in turns]
                else:
                    driven[name][t] = value.reshape(driven[name][t].shape)
        state = {"qpos": _from_along(model, self.qpos, y[:nv]), "qvel": y[nv : 2 * nv], "act": y[2 * nv :]}
        return driven | {name: state[name] for name in names if name in state}

    def _back(self, t, end, wrenches, skins, names):
        """Adjoint of one step: cotangents of its initial state (ny,), of its controls by name, and of the
        skins."""
        bodies, kept, start, nv = self.bodies, self.kept[t], self.starts[t], self.model.nv
        by, by_wrench = bodies.step_slopes(start, [k.wrench for k in kept], names)
        solved_at_end = [s.instance.two_way and not k.idle for s, k in zip(self.skins, kept)]
        gammas = [k.gamma if later else None for k, later in zip(kept, solved_at_end)]
        poses = bodies.pose_slopes(start, self.qvel[t], gammas, names)
        before = [self.begin if t == 0 else [k.state for k in self.kept[t - 1]]][0]
        linear, base, units, bases = [], [], [], []
        for i, (s, k) in enumerate(zip(self.skins, kept)):
            if k.resting:
                (
                    linear.append(None),
                    base.append(skins[i].pose.numpy().ravel()),
                    units.append([]),
                    bases.append(None),
                )
                continue
            one = s.linear(before[i], k, s.instance.model.opt.timestep)
            pushed = wrenches[i].ravel() + by_wrench[i].T @ end
            linear.append(one)
            base.append(one.pull(skins[i], pushed.reshape(-1, 6)))
            # directions in which cotangents of velocities return as wrenches
            back = by_wrench[i][nv : 2 * nv].T if solved_at_end[i] else np.zeros((len(pushed), 0))
            scale = np.tile(_LEVER, len(pushed) // 6)[:, None]
            left, size, _ = np.linalg.svd(scale * back, full_matrices=False)
            left = left[:, size > _RANK * size.max(initial=0.0)] / scale
            bases.append(np.linalg.lstsq(left, back, rcond=None)[0])
            zero = Cotangent.none(s.skin)
            units.append([one.pull(zero, column.reshape(-1, 6)) for column in left.T])
        # cotangents w of the final velocities satisfy a linear system, as the poses depend on them
        w, loop = np.zeros(nv), np.eye(nv)
        for i, one in enumerate(linear):
            if not solved_at_end[i]:
                continue
            slope = poses[i]["after"]
            w += slope.T @ (base[i] if one is None else base[i].pose)
            if one is not None and units[i]:
                loop -= slope.T @ np.stack([u.pose for u in units[i]], 1) @ bases[i]
        w = np.linalg.solve(loop, w)
        end = end.copy()
        end[nv : 2 * nv] += w
        y = np.concatenate([by[name].T @ end for name in _STATE])
        more = {name: by[name].T @ end for name in names}
        out = []
        for i, (s, one) in enumerate(zip(self.skins, linear)):
            if one is None:
                pose, after = base[i], Cotangent.none(s.skin)
            else:
                whole = base[i].plus(units[i], bases[i] @ w) if units[i] else base[i]
                pose, after = whole.pose, one.before(whole)
            out.append(after)
            for name, slope in poses[i].items():
                if name in more:
                    more[name] = more[name] + slope.T @ pose
                elif name != "after":
                    part = slice(0, nv) if name == "qpos" else slice(nv, 2 * nv)
                    y[part] += slope.T @ pose
        return y, more, out


class _Rollout(torch.autograd.Function):
    """One world."""

    @staticmethod
    def forward(context, run, names, *given):
        context.run, context.names = run, names
        out = run.step({name: value.detach().numpy() for name, value in zip(names, given)})
        return tuple(torch.from_numpy(np.asarray(one, float)) for one in out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(context, *cotangents):
        found = context.run.back(context.names, [one.numpy() for one in cotangents])
        return None, None, *(torch.from_numpy(np.asarray(found[name], float)) for name in context.names)


def _quats(model):
    """Indices of quaternions in positions, and of their rotations in velocities."""
    for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr):
        free = int(kind == mujoco.mjtJoint.mjJNT_FREE)
        if free or kind == mujoco.mjtJoint.mjJNT_BALL:
            yield slice(q + 3 * free, q + 3 * free + 4), slice(v + 3 * free, v + 3 * free + 3)


def _plain(model):
    """Indices of other positions and their velocities."""
    for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr):
        count = {mujoco.mjtJoint.mjJNT_FREE: 3, mujoco.mjtJoint.mjJNT_BALL: 0}.get(mujoco.mjtJoint(kind), 1)
        for i in range(count):
            yield q + i, v + i


def _along(model, qpos, cotangent):
    """(nv,) cotangent along tangents from a cotangent (nq,)."""
    out = np.zeros(model.nv)
    for q, v in _plain(model):
        out[v] = cotangent[q]
    for q, v in _quats(model):
        out[v] = 0.5 * _times(qpos[q] * [1, -1, -1, -1], cotangent[q])[1:]
    return out


def _from_along(model, qpos, tangent):
    """Inverse of `_along`: the cotangent along rotations, for quaternions of any norm."""
    out = np.zeros(model.nq)
    for q, v in _plain(model):
        out[q] = tangent[v]
    for q, v in _quats(model):
        out[q] = _to_quat(qpos[q], tangent[v]) / max(qpos[q] @ qpos[q], _NONE)
    return out


def _to_quat(quat, turn):
    return 2.0 * _times(quat, np.append(0.0, turn))


def _times(a, b):
    out = np.empty(4)
    mujoco.mju_mulQuat(out, np.ascontiguousarray(a), np.ascontiguousarray(b))
    return out
