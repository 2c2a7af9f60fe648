"""Many hands at once in mujoco_warp, with PyTorch tensors: what a policy sees, does and is paid for."""

import dataclasses
import functools
import math
import pathlib
import typing

import mujoco
import numpy as np
import warp as wp

from ...fields import as_whole
from .bank import Bank
from .scene import _PAD, Rod, build, find_pinch

if typing.TYPE_CHECKING:
    import torch

__all__ = ["RollRod", "Settings", "rolled"]

_CHANNELS = ("electrodes", "pdc")  # that a policy feels, of each finger
_COUNTS = 100.0  # by which their changes are divided
_CHOICES = {"begin": ("open", "held"), "goal": ("angle", "place"), "actions": ("servos", "pads")}


@dataclasses.dataclass(frozen=True)
class Settings:
    """The task's numbers.

    Attributes:
      timestep: of the simulation [s]. substeps: of them in a decision. decisions: in an episode.
      target: the rod is to be rolled by an angle between these [rad]; fingers that only
        close roll it by -0.25.
      rate: how far a decision moves a servo's goal at most [rad]; reach: from where it began [rad].
      close, hold, release: [s] fingers close until `close`; a soft fixture holds the rod until `hold` and
        lets it go until `release`.
      offset: how far off the rod begins, across and along the pads [m].
      mass: of the rod, between these [kg]. friction: of the skins, between these.
      tolerance: within which of its target the rod is where it should be [rad].
      held: reward of a decision in which the rod is held; near: how far off its target it still pays [rad].
      stiffness [N/m], damping [N s/m], twist [N m s]: of the fixture.
      lost: how far the rod's middle may go before it is lost [m].
      begin: of an episode: "open", fingers around the rod in its fixture, or "held": a state that is drawn
        from those in which the worlds held their rods after `prepare` decisions of closing, with what the
        rod there weighs and how it rubs (made once, by `prepare_held`).
      goal: "angle", or "place": the rod is to lie a told distance along the fingers, toward their tips, from
        the middle of their pads [m]; `target`, `tolerance` and `near` are then in metres.
      actions: "servos", eleven that move; or "pads": six, of the pads of two fingers and the thumb across the
        rod and towards it, `rate` and `reach` then in metres.
      lead: how far the goals of the fingers' pads are moved one way, and the thumb's the other, while they
        close [m]: soft servos give way along the pads, and a rod comes to lie 5 mm from their middle.
      encoder: deviation of the joints' angles as observed [rad], anew in each decision; of their velocities
        it is this by the time of a decision. Exact angles tell where a rod lies between soft fingers.
      gentle: a finger that feels more loses the episode [N].
      work: of one solve of a skin at most (`SkinOptions.max_work`); rounds: in which skins and bodies look
        for their balance in a step. A step waits for the worst of its worlds.
    """

    timestep: float = 4e-3
    substeps: int = 10
    decisions: int = 50
    target: tuple = (-0.5, 0.0)
    rate: float = 0.015
    reach: float = 0.3
    close: float = 0.4
    hold: float = 0.5
    release: float = 0.7
    offset: tuple = (2e-3, 3e-3)
    mass: tuple = (8e-3, 30e-3)
    friction: tuple = (0.5, 0.9)
    tolerance: float = 0.06
    held: float = 0.2
    near: float = 0.1
    stiffness: float = 60.0
    damping: float = 1.0
    twist: float = 1e-4
    lost: float = 20e-3
    begin: str = "open"
    prepare: int = 25
    goal: str = "angle"
    actions: str = "servos"
    lead: float = 0.0
    encoder: float = 0.0
    gentle: float = math.inf
    work: int = 40
    rounds: int = 4
    loss: float = 0.6


@wp.struct
class _Fixture:
    """What holds the rod in the beginning: stiffness [N/m], damping [N s/m, N m s], until when [s]."""

    body: int
    qpos: int
    qvel: int
    hold: float
    release: float
    stiffness: float
    damping: float
    twist: float
    gravity: wp.vec3


@wp.kernel
def _hold(
    fixture: _Fixture,
    time: wp.array(dtype=float),
    mass: wp.array(dtype=float),
    place: wp.array(dtype=wp.vec3),
    qpos: wp.array2d(dtype=float),
    qvel: wp.array2d(dtype=float),
    xfrc_applied: wp.array2d(dtype=wp.spatial_vector),
):
    w = wp.tid()
    f = fixture
    share = wp.clamp((f.release - time[w]) / (f.release - f.hold), 0.0, 1.0)
    pos = wp.vec3(qpos[w, f.qpos], qpos[w, f.qpos + 1], qpos[w, f.qpos + 2])
    vel = wp.vec3(qvel[w, f.qvel], qvel[w, f.qvel + 1], qvel[w, f.qvel + 2])
    turn = wp.quat(qpos[w, f.qpos + 4], qpos[w, f.qpos + 5], qpos[w, f.qpos + 6], qpos[w, f.qpos + 3])
    spin = wp.quat_rotate(turn, wp.vec3(qvel[w, f.qvel + 3], qvel[w, f.qvel + 4], qvel[w, f.qvel + 5]))
    force = share * (f.stiffness * (place[w] - pos) - f.damping * vel - mass[w] * f.gravity)
    xfrc_applied[w, f.body] = wp.spatial_vector(force, -share * f.twist * spin)


def rolled(begun: "torch.Tensor", now: "torch.Tensor") -> "torch.Tensor":
    """Angles (n,) [rad], -pi to pi, by which attitudes `now` (n, 4), w x y z, are turned against `begun` (4,)
    about their own third axis: the twist of conj(begun) now."""
    import torch

    w, x, y, z = begun
    along = w * now[:, 3] - z * now[:, 0] - x * now[:, 2] + y * now[:, 1]
    turned = 2 * torch.atan2(along, now @ begun)
    return torch.remainder(turned + torch.pi, 2 * torch.pi) - torch.pi


class RollRod:
    """A Shadow Hand holds a rod between its thumb and two fingers and rolls it by a told angle. Where the rod
    lies, what it weighs and how it rubs differ between worlds and are not told.

    Interface: Isaac Lab's (`reset`, `step` with torch tensors on one device, worlds that end begin anew by
    themselves). Observations are a dict of groups: "body" (num_envs, 39, or with pads' actions 34): angles of
    thirteen joints from where they began, their velocities / 10 rad/s, goals of eleven servos from where they
    would be [rad] (of six pads' movements, in shares of `reach`), what is told [rad or mm], the time;
    "touch" (num_envs, 60): changes of 19 electrodes and PDC of each finger since the fingers were open, in
    hundreds of counts; "state" (num_envs, 6), for a critic alone: angle [rad], place [mm], error / `near`,
    forces of the fingers [N]. Reward of a decision: 0.2 while the rod is held, and exp(-(error / near)^2)
    when the fixture has let it go; where a place is told (`Settings.goal`) 1 / (1 + (error / near)^2).

    Args:
      hand: Menagerie's shadow_hand/right_hand.xml.
      num_envs: worlds. device: of Warp and torch. seed: of what is drawn.
      skin, material, tier: of the BioTacs, as for `biotac_mj.attach`.
      settings: the task's numbers. rod: what is rolled.

    Attributes:
      num_envs, num_actions (11, of pads 6), max_episode_length, device.
      model: the MjModel. batches: {finger: `biotac_mj.batch.Batch`}.
      good: (k,) worlds that held their rod when states were kept, where episodes begin with it held.
      episode_length_buf: (num_envs,) decisions since the reset, a torch tensor.

    Raises:
      FileNotFoundError: no such hand. ValueError: another hand, or a number that cannot be.
    """

    def __init__(
        self,
        hand: pathlib.Path | str,
        num_envs: int = 256,
        device: str | None = None,
        seed: int = 0,
        skin: str = "coarse",
        material: str | None = None,
        tier: str = "condensed",
        settings: Settings = Settings(),  # noqa: B008 - frozen
        rod: Rod = Rod(),  # noqa: B008 - frozen
    ):
        import mujoco_warp as mjw
        import torch

        from ... import batch

        self.num_envs, self.cfg = as_whole("num_envs", num_envs, 1), settings
        for name, choice in _CHOICES.items():
            if getattr(settings, name) not in choice:
                raise ValueError(f"{name}={getattr(settings, name)!r}: choose one of {', '.join(choice)}")
        self.num_actions = 11 if settings.actions == "servos" else 6
        where = wp.get_device(device)
        self.device = f"cuda:{where.ordinal}" if where.is_cuda else "cpu"
        self.max_episode_length = settings.decisions
        self._draw = torch.Generator(self.device).manual_seed(as_whole("seed", seed, 0))
        spec, prefixes = build(hand, rod, settings.timestep, True, skin=skin)
        self.model = mjm = spec.compile()
        self.pinch = pinch = find_pinch(mjm, rod)
        start = mujoco.MjData(mjm)
        start.qpos[:] = pinch.qpos
        mujoco.mj_forward(mjm, start)
        n, s = self.num_envs, settings
        with wp.ScopedDevice(where):
            self._m = m = mjw.put_model(mjm)
            # a world whose solver stops early is no reason to print from the GPU
            m.opt.warn_overflow &= ~(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS)
            self._d = d = mjw.put_data(mjm, start, nworld=n, nconmax=40, njmax=200)
            body = mjm.body("rod").id
            mass = self._uniform(*s.mass, n)
            self._give_mass(body, mass.cpu().numpy(), rod.mass)
            friction = self._uniform(*s.friction, n).cpu().numpy()
            self.batches = {
                finger: batch.attach(
                    mjm,
                    m,
                    d,
                    prefix=p,
                    skin=skin,
                    material=material,
                    tier=tier,
                    friction=friction,
                    seed=1000 * i + seed,
                    options={"skin": {"max_work": s.work}, "rounds": s.rounds, "loss": s.loss},
                )
                for i, (finger, p) in enumerate(prefixes.items())
            }
            self._place = torch.zeros(n, 3, device=self.device)
            joint = mjm.joint("rod")
            fixture = _Fixture()
            fixture.body, fixture.qpos, fixture.qvel = body, joint.qposadr[0], joint.dofadr[0]
            fixture.hold, fixture.release = s.hold, s.release
            fixture.stiffness, fixture.damping, fixture.twist = s.stiffness, s.damping, s.twist
            fixture.gravity = wp.vec3(*mjm.opt.gravity)
            inputs = [fixture, d.time, wp.from_torch(mass), wp.from_torch(self._place, dtype=wp.vec3)]
            inputs += [d.qpos, d.qvel, d.xfrc_applied]
            self._hold = functools.partial(wp.launch, _hold, n, inputs)
        self._read(mjm, d, prefixes, torch)
        self._bank = None
        self._begin(self._everyone)
        self._run = self._substep
        self._substep()  # takes the memory that a capture must find
        if where.is_cuda:
            with wp.ScopedCapture(device=where) as capture:
                self._substep()
            self._run = functools.partial(wp.capture_launch, capture.graph)
        if s.begin == "held":
            self.prepare_held()
        self.reset()

    def _uniform(self, low, high, *shape):
        import torch

        return low + (high - low) * torch.rand(*shape, generator=self._draw, device=self.device)

    def _give_mass(self, body, mass, usual):
        """The rod's mass and inertia of each world, and what MuJoCo derives from them: without the mass of
        the subtree its centre of mass would be elsewhere."""
        m, n, ratio = self._m, self.num_envs, mass / usual
        dofs = slice(*(m.body_dofadr.numpy()[body] + np.array([0, 6])))
        self._rods = []
        for name, where, factor in (
            ("body_mass", body, ratio),
            ("body_inertia", body, ratio),
            ("body_subtreemass", body, ratio),
            ("body_invweight0", body, 1 / ratio),
            ("dof_invweight0", dofs, 1 / ratio),
        ):
            one = getattr(m, name)
            many = np.repeat(one.numpy()[:1], n, axis=0)
            if name == "body_subtreemass":
                many[:, 0] += mass - usual
            many[:, where] *= factor.reshape(n, *[1] * (many[:, where].ndim - 1))
            setattr(m, name, wp.array(many, dtype=one.dtype))
            self._rods.append(getattr(m, name))

    def _read(self, mjm, d, prefixes, torch):
        """Views of mujoco_warp's arrays, and where episodes begin."""
        p, n, s = self.pinch, self.num_envs, self.cfg
        tensor = functools.partial(torch.as_tensor, device=self.device)
        self._qpos, self._qvel, self._ctrl = (wp.to_torch(a) for a in (d.qpos, d.qvel, d.ctrl))
        self._sensed = wp.to_torch(d.sensordata)
        self._joints, self._actuators = tensor(p.joints), tensor(p.actuators)
        dofs = [mjm.jnt_dofadr[list(mjm.jnt_qposadr).index(a)] for a in p.joints]
        self._dofs = tensor(np.array(dofs))
        self._start = tensor(p.qpos, dtype=torch.float32)
        self._opened, self._closed = (tensor(c, dtype=torch.float32) for c in (p.opened, p.closed))
        self._closed += tensor(p.pads @ (s.lead * np.array([-1, -1, 1, 0, 0, 0])), dtype=torch.float32)
        self._limits = tensor(mjm.actuator_ctrlrange[p.actuators].T, dtype=torch.float32)
        self._rod = int(mjm.joint("rod").qposadr[0])
        names = [f"{q}{c}" for q in prefixes.values() for c in _CHANNELS]
        spans = [np.arange(mjm.sensor(x).adr[0], mjm.sensor(x).adr[0] + mjm.sensor(x).dim[0]) for x in names]
        self._felt = tensor(np.concatenate(spans))
        forces = [mjm.sensor(f"{q}contact_force").adr[0] + np.arange(3) for q in prefixes.values()]
        self._forces = tensor(np.array(forces))
        self._axes = [tensor(x, dtype=torch.float32) for x in (np.cross(p.normal, p.axis), p.axis, p.centre)]
        zeros = functools.partial(torch.zeros, device=self.device)
        self._everyone = torch.ones(n, dtype=torch.bool, device=self.device)
        self._cores = tensor(np.array([mjm.body(f"{q}core").id for q in prefixes.values()]))
        self._xpos, self._xmat = wp.to_torch(d.xpos), wp.to_torch(d.xmat)
        self._pads = tensor(p.pads.T, dtype=torch.float32) if self.num_actions == 6 else None
        self.episode_length_buf = zeros(n, dtype=torch.long)
        self._target, self._moved = zeros(n), zeros(n, self.num_actions)
        self._tare = zeros(n, len(self._felt))
        self._age = zeros(n, dtype=torch.long)  # decisions since the fingers were open

    def _substep(self):
        import mujoco_warp as mjw

        self._hold()
        mjw.step(self._m, self._d)

    @property
    def qpos(self) -> "torch.Tensor":
        """(num_envs, nq) of the model, a view."""
        return self._qpos

    @property
    def qvel(self) -> "torch.Tensor":
        """(num_envs, nv) of the model, a view."""
        return self._qvel

    @property
    def sensordata(self) -> "torch.Tensor":
        """(num_envs, nsensordata) of the model, a view."""
        return self._sensed

    @property
    def target(self) -> "torch.Tensor":
        """(num_envs,) told angles [rad]."""
        return self._target

    @property
    def angle(self) -> "torch.Tensor":
        """(num_envs,) by which the rod is rolled about its axis [rad]."""
        place = slice(self._rod + 3, self._rod + 7)
        return rolled(self._start[place], self._qpos[:, place])

    @property
    def held(self) -> "torch.Tensor":
        """(num_envs,) whether the rod is still between the fingers."""
        away = self._qpos[:, self._rod : self._rod + 3] - self._axes[2]
        return away.norm(dim=1) < self.cfg.lost

    @property
    def place(self) -> "torch.Tensor":
        """(num_envs,) how far the rod's middle is from the middle of the fingers' pads, toward their tips
        [m], when the last step began."""
        rod = self._qpos[:, None, self._rod : self._rod + 3]
        fingers = self._cores[:2]  # of the thumb it is another
        off = rod - self._xpos[:, fingers]
        return (off[..., None] * self._xmat[:, fingers]).sum(-2)[..., 0].mean(1).neg() + _PAD[0]

    @property
    def error(self) -> "torch.Tensor":
        """(num_envs,) how far the rod is from its target [rad or m]."""
        return ((self.angle if self.cfg.goal == "angle" else self.place) - self._target).abs()

    @property
    def force(self) -> "torch.Tensor":
        """(num_envs, 3) that each finger feels [N]; not observed."""
        return self._sensed[:, self._forces].norm(dim=2)

    def reset(self, seed: int | None = None) -> tuple[dict, dict]:
        """All worlds begin anew: observations, extras.

        Args:
          seed: of what is drawn from now on; None goes on.
        """
        import torch

        if seed is not None:
            self._draw.manual_seed(as_whole("seed", seed, 0))
        self._begin(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))
        return self.observe(), {}

    def step(self, actions: "torch.Tensor") -> tuple:
        """One decision of all worlds.

        Args:
          actions: (num_envs, num_actions), of which -1 to 1 counts: how the servos' goals move.

        Returns:
          observations (of worlds that ended: of their new episode), reward (num_envs,), terminated
          (num_envs,) (the rod is lost), truncated (num_envs,), extras: "time_outs", "success" (num_envs,)
          (the episode ends with the rod held and within the tolerance of its target), "error" (num_envs,)
          [rad], and "log": means over the episodes that ended.

        Raises:
          ValueError: actions of another shape.
        """
        import torch

        if actions.shape != (self.num_envs, self.num_actions):
            raise ValueError(
                f"actions has shape {tuple(actions.shape)}: pass ({self.num_envs}, {self.num_actions})"
            )
        s = self.cfg
        waits = (self._age == 0)[:, None]  # while it tares
        move = torch.where(waits, 0.0, s.rate * actions.to(self.device).clamp(-1, 1))
        self._advance(move)
        held, error = self.held & (self.force.max(1).values <= s.gentle), self.error
        free = (self._age * s.substeps * s.timestep > s.release).float()
        off = (error / s.near) ** 2
        paid = torch.exp(-off) if s.goal == "angle" else 1 / (1 + off)
        reward = held * (s.held + free * paid)
        terminated = ~held | ~torch.isfinite(reward)
        reward = torch.nan_to_num(reward)
        truncated = (self.episode_length_buf >= s.decisions) & ~terminated
        done = terminated | truncated
        extras = {"time_outs": truncated}
        good = truncated & (error < s.tolerance)
        extras["log"] = {
            "/success": good[done].float().mean() if done.any() else torch.zeros(()),
            "/held": truncated[done].float().mean() if done.any() else torch.zeros(()),
            "/error": error[truncated].mean() if truncated.any() else torch.zeros(()),
        }
        extras["success"], extras["error"] = good, error
        self._begin(done)
        return self.observe(), reward, terminated, truncated, extras

    def _advance(self, move):
        """A decision: servos' goals go by `move` (num_envs, num_actions), and time goes on."""
        import torch

        s, waits = self.cfg, (self._age == 0)[:, None]
        self._moved[:] = (self._moved + move).clamp(-s.reach, s.reach)
        closing = (self._age * s.substeps * s.timestep / s.close).clamp(0, 1)[:, None]
        moved = self._moved if self._pads is None else self._moved @ self._pads
        goal = self._opened + closing * (self._closed - self._opened) + moved
        self._ctrl[:, self._actuators] = goal.clamp(self._limits[0], self._limits[1])
        for _ in range(s.substeps):
            self._run()
        self.episode_length_buf += 1
        self._age += 1
        # nothing is touched yet
        self._tare[:] = torch.where(waits, self._sensed[:, self._felt], self._tare)

    def prepare_held(self, seed: int | None = None) -> int:
        """Has all worlds close their fingers on a rod, and keeps where they hold it: what later episodes
        begin with, where `settings.begin` is "held". All worlds begin anew.

        Args:
          seed: of what is drawn from now on; None goes on.

        Returns:
          how many worlds held theirs.

        Raises:
          RuntimeError: none did. ValueError: a number of worlds that cannot be, see `Bank`.
        """
        import torch

        if seed is not None:
            self._draw.manual_seed(as_whole("seed", seed, 0))
        self._bank, still = None, torch.zeros(self.num_envs, self.num_actions, device=self.device)
        self._begin(self._everyone)
        for _ in range(self.cfg.prepare):
            self._advance(still)
        force = self.force
        good = self.held & (force.min(1).values > 0.02) & (force.max(1).values <= self.cfg.gentle)
        good &= torch.isfinite(self._qpos).all(1) & torch.isfinite(self._qvel).all(1)
        self.good = good.nonzero()[:, 0]
        if not len(self.good):
            raise RuntimeError(
                f"no world of {self.num_envs} holds its rod after {self.cfg.prepare} decisions"
            )
        roots = [self._d, self._rods, *self.batches.values()]
        self._bank = Bank(self.num_envs, roots, [self._tare, self._moved, self._age])
        self._bank.keep()
        self._begin(self._everyone)
        return len(self.good)

    def observe(self) -> dict:
        """{"body": (num_envs, 39 or 34), "touch": (num_envs, 60), "state": (num_envs, 6)}, see the class."""
        import torch

        s, touched = self.cfg, (self._age > 0)[:, None]
        touch = torch.where(touched, (self._sensed[:, self._felt] - self._tare) / _COUNTS, 0.0)
        angles = self._qpos[:, self._joints] - self._start[self._joints]
        velocities = self._qvel[:, self._dofs]
        if s.encoder:
            noise = torch.randn(2, *angles.shape, generator=self._draw, device=self.device) * s.encoder
            angles, velocities = angles + noise[0], velocities + noise[1] / (s.substeps * s.timestep)
        time = self.episode_length_buf[:, None] / self.cfg.decisions
        moved = self._moved / self.cfg.reach if self._pads is not None else self._moved
        told = self._target if self.cfg.goal == "angle" else 1e3 * self._target
        body = [angles, velocities / 10.0, moved, told[:, None], time]
        state = [
            self.angle[:, None],
            1e3 * self.place[:, None],
            self.error[:, None] / self.cfg.near,
            self.force,
        ]
        return {"body": torch.cat(body, dim=1), "touch": touch, "state": torch.cat(state, dim=1)}

    def _begin(self, which):
        """Worlds (num_envs,) of bool begin anew."""
        import mujoco_warp as mjw
        import torch

        s, n = self.cfg, self.num_envs
        target = self._uniform(*s.target, n)
        self._target = torch.where(which, target, self._target)
        self.episode_length_buf = torch.where(which, 0, self.episode_length_buf)
        if self._bank:
            worlds = which.nonzero()[:, 0]
            drawn = torch.randint(len(self.good), (n,), generator=self._draw, device=self.device)
            self._bank.give(worlds, self.good[drawn[worlds]])
            return
        mask = wp.from_torch(which)
        for one in self.batches.values():
            one.reset(mask)
        mjw.reset_data(self._m, self._d, mask)
        across, along, centre = self._axes
        off = self._uniform(-1, 1, n, 2)
        place = centre + s.offset[0] * off[:, :1] * across + s.offset[1] * off[:, 1:] * along
        some = which[:, None]
        begun = self._start.expand(n, -1).clone()
        begun[:, self._rod : self._rod + 3] = place
        self._qpos[:] = torch.where(some, begun, self._qpos)
        self._place[:] = torch.where(some, place, self._place)
        self._moved[:] = torch.where(some, 0.0, self._moved)
        self._age[:] = torch.where(which, 0, self._age)
        self._ctrl[:, self._actuators] = torch.where(some, self._opened, self._ctrl[:, self._actuators])

    def close(self) -> None:
        """Nothing is left to close."""
