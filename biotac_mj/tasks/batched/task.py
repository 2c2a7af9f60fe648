"""Base class of the tasks in batches: worlds in mujoco_warp with PyTorch tensors, decisions, episodes,
observations."""

import abc
import dataclasses
import functools
import math

import mujoco
import numpy as np
import torch
import warp as wp

from ...fields import as_whole, check_choice
from ...short_repr import short_repr
from ...view.offscreen import stage
from .bank import Bank
from .touch import OBSERVE, Touch, as_deviations

_FELT = 0.02  # force of a finger that holds something, at least [N]


@dataclasses.dataclass(frozen=True)
class TaskSettings:
    """Numbers of a task.

    Attributes:
      timestep: of the simulation [s]. substeps: time steps in a decision. decisions: in an episode.
      prepare: decisions that close the fingers before an episode. States with the object in the grip are
        stored once, and each episode starts from one of them at random.
      encoder: standard deviation of observed joint positions [rad or m], new in each decision; that of
        velocities is this divided by the time of a decision.
      rate: change of an actuator's goal by an action of 1; reach: largest total change; one number, or one
        for each action [m or rad].
      gentle: largest force of a finger, beyond which the episode is lost [N].
      friction: range of the skins' friction.
      work: limit of one solve of a skin (`SkinOptions.max_work`). rounds: limit of rounds of skins and bodies
        in a step. A step takes as long as its slowest world. loss: loss factor of the rubber.
    """

    timestep: float = 4e-3
    substeps: int = 10
    decisions: int = 50
    prepare: int = 0
    encoder: float = 0.0
    rate: float | tuple = 1e-3
    reach: float | tuple = 1e-2
    gentle: float = math.inf
    friction: tuple = (0.5, 0.9)
    work: int = 240
    rounds: int = 4
    loss: float = 0.2


class BatchTask(abc.ABC):
    """Many worlds with BioTacs in which a policy acts by touch.

    The interface is that of Isaac Lab: `reset` and `step` take and return torch tensors on one device, and
    worlds whose episode ends are reset at once. Observations are a dict of groups: "body" (num_envs, n),
    proprioception and goals; "touch" (num_envs, m), see `Touch.observe`; "state" (num_envs, k), the true
    state, for a critic. n and m are widths of one decision times `history`.

    Args:
      num_envs: number of worlds. device: of Warp and torch. seed: of all random draws.
      observe: content of "touch", one of `touch.OBSERVE`; "learned" takes the electrodes of the shipped
        latent projections in place of the film's.
      history: number of decisions in "body" and "touch", the last one first; a younger episode repeats its
        first decision.
      model_error: standard deviations of relative errors of changes of counts, constant in an episode,
        for the error of this tier: of electrodes, PDC and PAC, see `Touch.with_errors`; or one
        number.
      settings: numbers of the task; None: the class's own.
      biotac: settings of the BioTacs, as for `biotac_mj.batch.attach`; by default coarse and condensed.

    Attributes:
      num_envs, num_actions, max_episode_length, device, observes, history, model_error, biotac.
      model: the MjModel. batches: {finger: `biotac_mj.batch.Batch`}. prefixes: {finger: of its names}.
      qpos (num_envs, nq), qvel (num_envs, nv), sensordata (num_envs, nsensordata), mocap_pos (num_envs,
        nmocap, 3) [m]: of the model, views.
      good: (k,) worlds whose states were stored for the beginning of episodes.
      episode_length_buf: (num_envs,) decisions since the reset, a torch tensor.

    Raises:
      ValueError: a choice or a number that cannot be.
    """

    num_actions: int
    settings = TaskSettings()  # of the class
    gamma = 0.95  # discount of a decision in learning
    study = 0.4  # time of imitation between updates over that of acting
    same_in_tiers = False  # whether the same actions move the object alike in both tiers of the skin
    camera: tuple  # lookat (3,) [m], distance [m], azimuth, elevation [deg] of a picture

    def __init__(
        self,
        num_envs: int = 256,
        device: str | None = None,
        seed: int = 0,
        observe: str = "electrodes",
        settings: TaskSettings | None = None,
        history: int = 1,
        model_error: float | tuple[float, float, float] = 0.0,
        **biotac: object,
    ):
        import mujoco_warp as mjw

        from ... import batch

        check_choice("observe is", observe, OBSERVE)
        self.num_envs, self.observes = as_whole("num_envs", num_envs, 1), observe
        self.history = as_whole("history", history, 1)
        self.model_error = as_deviations(model_error)
        self.cfg = s = self.settings if settings is None else settings
        if not isinstance(s, type(self.settings)):
            own = f"dataclasses.replace({type(self).__name__}.settings, ...)"
            raise ValueError(f"settings are {short_repr(s)}: pass the task's, {own}")
        where = wp.get_device(device)
        self.device = f"cuda:{where.ordinal}" if where.is_cuda else "cpu"
        self.max_episode_length = s.decisions
        self._draw = torch.Generator(self.device).manual_seed(as_whole("seed", seed, 0))
        options = {"skin": {"max_work": s.work}, "rounds": s.rounds, "loss": s.loss}
        biotac = {"skin": "coarse", "tier": "condensed", "options": options} | biotac
        if observe == "learned":
            biotac = {"signal": "latent_projection"} | biotac
        self.biotac = biotac
        spec, prefixes, touching = self._scene(biotac["skin"])
        self.prefixes = prefixes
        stage(spec)
        self.model = mjm = spec.compile()
        n = self.num_envs
        start = mujoco.MjData(mjm)
        start.qpos[:] = self._find_start(mjm)
        mujoco.mj_forward(mjm, start)
        with wp.ScopedDevice(where):
            self._m = m = mjw.put_model(mjm)
            # a world whose solver stops early is no reason to print from the GPU
            m.opt.warn_overflow &= ~(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS)
            self._d = d = mjw.put_data(mjm, start, nworld=n, nconmax=40, njmax=200)
            self._varied = self._vary()
            friction = self._uniform(*s.friction, n).cpu().numpy()
            own = {"friction": friction} | touching | biotac
            self.batches = {
                finger: batch.attach(mjm, m, d, prefix=p, seed=seed, **own) for finger, p in prefixes.items()
            }
        tensor = functools.partial(torch.as_tensor, device=self.device)
        self.qpos, self.qvel, self._ctrl = (wp.to_torch(a) for a in (d.qpos, d.qvel, d.ctrl))
        self.sensordata, self.mocap_pos = wp.to_torch(d.sensordata), wp.to_torch(d.mocap_pos)
        self._start = tensor(start.qpos, dtype=torch.float32)
        of_prefix = dict(zip(prefixes.values(), self.batches.values(), strict=True))
        self._touch = Touch(mjm, self.sensordata, of_prefix, biotac["skin"])
        forces = [mjm.sensor(f"{p}contact_force").adr[0] + np.arange(3) for p in prefixes.values()]
        self._forces = tensor(np.array(forces))
        self._everyone = torch.ones(n, dtype=torch.bool, device=self.device)
        self.episode_length_buf = torch.zeros(n, dtype=torch.long, device=self.device)
        self._rate, self._reach = (tensor(x, dtype=torch.float32) for x in (s.rate, s.reach))
        self._moved = torch.zeros(n, self.num_actions, device=self.device)
        # decisions since the last frame in which nothing was touched
        self._age = torch.zeros(n, dtype=torch.long, device=self.device)
        self._bank = self._past = self._errors = self._blur = None
        with wp.ScopedDevice(where):
            self._read(mjm, prefixes)
            self._begin(self._everyone)
            self._run = self._substep
            self._substep()  # takes the memory that a capture must find
            if where.is_cuda:
                with wp.ScopedCapture(device=where) as capture:
                    self._substep()
                self._run = functools.partial(wp.capture_launch, capture.graph)
        if s.prepare:
            self.prepare_held()
        self.reset()

    # what a task defines

    @abc.abstractmethod
    def _scene(self, skin):
        """MjSpec, {finger: prefix} of its BioTacs, and keywords of `batch.attach` that say what they
        touch."""

    def _find_start(self, mjm):
        """Initial positions (nq,) of all worlds."""
        return mjm.qpos0

    def _vary(self):
        """Gives worlds models of their own; returns the arrays that belong to a world's state."""
        return []

    @abc.abstractmethod
    def _read(self, mjm, prefixes):
        """Takes views and addresses."""

    @abc.abstractmethod
    def _place(self, some):
        """Puts worlds, (num_envs, 1) of bool, where an episode or its preparation begins; draws."""

    def _draw_goals(self, which):  # noqa: B027 - most have no goal
        """Draws the goals of worlds (num_envs,) of bool."""

    def _act(self):  # noqa: B027 - most tasks have none
        """Further forces before a substep; launches only."""

    @abc.abstractmethod
    def _command(self):
        """Writes the controls for the goals `_moved`."""

    @abc.abstractmethod
    def _sense_body(self, off, speed_off):
        """[(num_envs, k)] of proprioception, with errors `off` of positions [rad or m] and `speed_off` of
        velocities; linear in both."""

    @abc.abstractmethod
    def _state(self):
        """[(num_envs, k)] of the true state for a critic."""

    @abc.abstractmethod
    def _judge(self):
        """After a decision: reward, whether the object is in the grip, success and error, (num_envs,)
        each."""

    @property
    @abc.abstractmethod
    def held(self) -> torch.Tensor:
        """(num_envs,) whether the object is still in the grip, or the finger near its target."""

    @abc.abstractmethod
    def script(self) -> torch.Tensor:
        """Actions (num_envs, num_actions), of which -1 to 1 counts, of a controller that uses the true state
        and solves the task."""

    def change_goal(self, sensed: dict, wish: torch.Tensor) -> tuple[dict, torch.Tensor]:
        """What was `sensed` in n worlds, and what the script wished to do there (n, num_actions), with other
        goals, where the task has observed ones."""
        return sensed, wish

    # what they share

    @property
    def rest_counts(self) -> torch.Tensor:
        """(num_envs, nfinger, k) of electrodes, PDC and PAC when nothing was touched; 0 before."""
        return self._touch.tare

    @property
    def force(self) -> torch.Tensor:
        """(num_envs, nfinger) contact force of each finger [N]; not observed."""
        return self.sensordata[:, self._forces].norm(dim=2)

    def _moves(self, actions):
        """Changes of the goals by actions (num_envs, num_actions)."""
        return self._rate * actions

    def reset(self, seed: int | None = None) -> tuple[dict, dict]:
        """Resets all worlds; returns observations, extras.

        Args:
          seed: of the random draws from now on; None: continue.
        """
        if seed is not None:
            self._draw.manual_seed(as_whole("seed", seed, 0))
        self._begin(self._everyone)
        self._sense(self._everyone)
        return self.observe(), {}

    def step(self, actions: torch.Tensor) -> tuple:
        """One decision of all worlds.

        Args:
          actions: (num_envs, num_actions), of which -1 to 1 counts; a tensor, or what becomes one.

        Returns:
          observations (of worlds that ended: of their new episode), reward (num_envs,), terminated
          (num_envs,) (what is held is lost, or a finger felt more than `gentle`), truncated (num_envs,),
          extras: "time_outs", "success" (num_envs,) (the episode ends where it should), "error" (num_envs,),
          "log": means over the episodes that ended, and if some did "final": observations before the reset.

        Raises:
          ValueError: actions of another shape.
        """
        actions = torch.as_tensor(actions, dtype=torch.float32, device=self.device)
        if actions.shape != (self.num_envs, self.num_actions):
            raise ValueError(
                f"actions has shape {tuple(actions.shape)}: pass ({self.num_envs}, {self.num_actions})"
            )
        waits = (self._age == 0)[:, None]  # while it tares
        self._advance(torch.where(waits, 0.0, self._moves(actions.clamp(-1, 1))))
        paid, on, good, error = self._judge()
        on &= self.force.max(1).values <= self.cfg.gentle
        reward = on * paid
        terminated = ~on | ~torch.isfinite(reward)
        reward = torch.nan_to_num(reward)
        truncated = (self.episode_length_buf >= self.cfg.decisions) & ~terminated
        done = terminated | truncated
        success = truncated & good
        log = {
            "/success": success[done].float().mean() if done.any() else torch.zeros(()),
            "/held": truncated[done].float().mean() if done.any() else torch.zeros(()),
            "/error": error[truncated].mean() if truncated.any() else torch.zeros(()),
        }
        extras = {"time_outs": truncated, "success": success, "error": error, "log": log}
        self._sense()
        if done.any():
            extras["final"] = self.observe()
            self._begin(done)
            self._sense(done)
        return self.observe(), reward, terminated, truncated, extras

    def stagger(self) -> None:
        """Sets random ages of the episodes, so that a learner's batches contain all ages."""
        self.episode_length_buf[:] = self._integers(self.cfg.decisions)

    def observe(self, choice: str | None = None) -> dict:
        """{"body", "touch", "state"}, see the class.

        Args:
          choice: of `touch.OBSERVE` in place of the environment's own, of the same sensors.
        """
        body, noise, changes = self._past
        touch = self._touch.with_errors(changes, self._errors[:, None])
        touch = self._touch.observe(choice or self.observes, touch)
        state, body = torch.cat(self._state(), dim=1), body + noise
        return {"body": body.flatten(1), "touch": touch.flatten(1), "state": state}

    def alike(self, choice: str) -> torch.Tensor:
        """Numbers (n,) of what `sense_anew` gives, one for all electrodes of a finger: divided by deviations
        of their own, those that hardly change would count as much as the others, and their errors more."""
        wide = self.history * self._past[0].shape[2]  # of body
        touch = np.tile(wide + self._touch.alike(choice), self.history)
        return torch.as_tensor(np.concatenate([np.arange(wide), touch]), device=self.device)

    def sensed(self) -> dict:
        """{"body" (num_envs, history, n), "changes" (num_envs, history, nfinger, k), "world" (num_envs,)} of
        the last decisions, without the encoders' error and the model's, for `sense_anew`."""
        body, _, changes = self._past
        return {"body": body, "changes": changes, "world": torch.arange(self.num_envs, device=self.device)}

    def sense_anew(
        self,
        choice: str,
        body: torch.Tensor,
        changes: torch.Tensor,
        world: torch.Tensor,
        missing: int = 0,
        measured: torch.Tensor | None = None,
        model_error: tuple[float, ...] | None = None,
    ) -> torch.Tensor:
        """Observations (n, m) of body and touch for what was `sensed` in n worlds, with new errors of
        encoders and model.

        Args:
          choice: of `touch.OBSERVE`. missing: number of random electrodes of each finger that read no change.
          measured: errors of this tier, see `training.tier_errors`; each world gets those of a random episode
            times a random factor, 0.5 +- 0.7, so that neither tier is strange.
          model_error: deviations of the others, see `Touch.draw_errors`; None: the environment's.
        """
        # an episode that is young repeats its first decision, with its errors
        repeats = (body[:, 1:] == body[:, :-1]).all(2)
        first = torch.arange(1, self.history, device=self.device).where(~repeats, 0)
        first = torch.nn.functional.pad(first, (1, 0)).cummax(1).values
        noise = self._noise(body).gather(1, first[..., None].expand_as(body))
        if measured is not None:
            n = len(body)
            which = torch.randint(measured.shape[1], (n, 1), generator=self._draw, device=self.device)
            factor = 0.5 + 0.7 * torch.randn(n, 1, 1, 1, generator=self._draw, device=self.device)
            off = measured[first[:, -1:] - first, which]  # of the same decision
            changes = changes + factor * off * self._touch.rms(changes)
        changes = self._touch.without(changes, missing, self._draw) if missing else changes
        errors = self._touch.draw_errors((len(body), 1), model_error or self.model_error, self._draw)
        touch = self._touch.observe(choice, self._touch.with_errors(changes, errors), world)
        return torch.cat([(body + noise).flatten(1), touch.flatten(1)], dim=1)

    def prepare_held(self, seed: int | None = None) -> int:
        """Closes the fingers of all worlds (`settings.prepare`), and stores the states of those with the
        object in the grip, its mass and friction included. Later episodes start from them. Resets all worlds.

        Args:
          seed: of the random draws from now on; None: continue.

        Returns:
          how many worlds held theirs.

        Raises:
          RuntimeError: none did.
        """
        if seed is not None:
            self._draw.manual_seed(as_whole("seed", seed, 0))
        self._bank, still = None, torch.zeros_like(self._moved)
        self._begin(self._everyone)
        for _ in range(self.cfg.prepare):
            self._advance(still)
        force = self.force
        good = self.held & (force.min(1).values > _FELT) & (force.max(1).values <= self.cfg.gentle)
        good &= torch.isfinite(self.qpos).all(1) & torch.isfinite(self.qvel).all(1)
        self.good = good.nonzero()[:, 0]
        if not len(self.good):
            raise RuntimeError(
                f"no world of {self.num_envs} holds its body after {self.cfg.prepare} decisions"
            )
        varied = [wp.to_torch(a) for a in (*self._varied, self._m.geom_friction) if len(a) == self.num_envs]
        own = [self._touch.tare, self._moved, self._age, *varied]
        self._bank = Bank(self._d, list(self.batches.values()), own)
        self._bank.keep()
        self._begin(self._everyone)
        self._sense(self._everyone)
        return len(self.good)

    def __reduce__(self):
        raise TypeError("a batch can be neither copied nor pickled: make another with the same arguments")

    def close(self) -> None:  # noqa: B027
        """Does nothing; part of the interface."""

    def _advance(self, move):
        """A decision: changes the goals by `move` (num_envs, num_actions) and simulates."""
        waits, reach = (self._age == 0)[:, None, None], self._reach
        self._moved[:] = torch.minimum(torch.maximum(self._moved + move, -reach), reach)
        self._command()
        for _ in range(self.cfg.substeps):
            self._run()
        self.episode_length_buf += 1
        self._age += 1
        # nothing is touched yet
        self._touch.tare[:] = torch.where(waits, self._touch.channels, self._touch.tare)

    def _sense(self, begun=None):
        """Adds the latest readings to the history; begun: instead, those of worlds (num_envs,) of bool that
        were reset become all of theirs."""
        touched = (self._age > 0)[:, None, None]
        changes = torch.where(touched, self._touch.channels - self._touch.tare, 0.0)
        body = torch.cat(self._sense_body(0.0, 0.0), dim=1)
        now = [body, self._noise(body), changes]
        if begun is None:
            pairs = zip(now, self._past, strict=True)
            self._past = [torch.cat([one[:, None], past[:, :-1]], dim=1) for one, past in pairs]
            return
        errors = self._touch.draw_errors((self.num_envs,), self.model_error, self._draw)
        first = [one[:, None].expand(-1, self.history, *one.shape[1:]) for one in now]
        self._errors, *self._past = (
            new if self._past is None else new.where(begun.view(-1, *[1] * (new.ndim - 1)), old)
            for new, old in zip((errors, *first), (self._errors, *(self._past or now)), strict=True)
        )

    def _substep(self):
        import mujoco_warp as mjw

        with wp.ScopedDevice(self.device):
            self._act()
            mjw.step(self._m, self._d)

    def _begin(self, which):
        """Resets worlds (num_envs,) of bool."""
        import mujoco_warp as mjw

        if not which.any():
            return
        self.episode_length_buf[which] = 0
        worlds = which.nonzero()[:, 0]
        if self._bank:
            self._bank.give(worlds, self.good[self._integers(len(self.good))[worlds]])
        self._touch.reseed(worlds, self._integers(2**31))
        if self._bank:
            self._draw_goals(which)
            return
        mask, some = wp.from_torch(which), which[:, None]
        for one in self.batches.values():
            one.reset(mask)
        with wp.ScopedDevice(self.device):
            mjw.reset_data(self._m, self._d, mask)
        self.qpos[:] = torch.where(some, self._start, self.qpos)
        self._place(some)
        self._draw_goals(which)
        self._moved[:] = torch.where(some, 0.0, self._moved)
        self._age[:] = torch.where(which, 0, self._age)
        self._command()

    def _uniform(self, low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=self._draw, device=self.device)

    def _integers(self, high):
        return torch.randint(high, (self.num_envs,), generator=self._draw, device=self.device)

    def _noise(self, body):
        """Random errors of encoders in proprioception (..., k)."""
        if self._blur is None:
            s = self.cfg
            off = self._sense_body(s.encoder, s.encoder / (s.substeps * s.timestep))
            self._blur = (torch.cat(off, dim=1) - torch.cat(self._sense_body(0.0, 0.0), dim=1))[0]
        return self._blur * torch.randn(body.shape, generator=self._draw, device=self.device)

    def _give_mass(self, name, mass):
        """A free body's mass (num_envs,) [kg] and inertia of each world, and what MuJoCo derives from them:
        without the mass of the subtree its centre of mass would be elsewhere. Returns the arrays."""
        m, n, made = self._m, self.num_envs, []
        body = self.model.body(name).id
        usual = self.model.body_mass[body]
        ratio = mass / usual
        dofs = slice(*(m.body_dofadr.numpy()[body] + np.array([0, 6])))
        for field, where, factor in (
            ("body_mass", body, ratio),
            ("body_inertia", body, ratio),
            ("body_subtreemass", body, ratio),
            ("body_invweight0", body, 1 / ratio),
            ("dof_invweight0", dofs, 1 / ratio),
        ):
            one = getattr(m, field)
            many = np.repeat(one.numpy()[:1], n, axis=0)
            if field == "body_subtreemass":
                many[:, 0] += mass - usual
            many[:, where] *= factor.reshape(n, *[1] * (many[:, where].ndim - 1))
            setattr(m, field, wp.array(many, dtype=one.dtype))
            made.append(getattr(m, field))
        return made
