"""A Shadow Hand rolls a rod between its thumb and two fingers."""

import dataclasses
import functools
import math
import os
import pathlib

import numpy as np
import torch
import warp as wp

from .fixture import HeldSettings, HeldTask
from .hand import _PAD, build, find_pinch


@dataclasses.dataclass(frozen=True)
class Settings(HeldSettings):
    """Numbers of the task; see `HeldSettings` too. The encoders' error matters: exact joint angles, which
    differ by 1e-3 rad, determine the rod's place to 0.1 mm, and those of a hand do not.

    Attributes:
      target: range of the target place, a distance along the fingers, towards their tips, from the middle of
        their pads [m].
      rate, reach: largest change of a pad's goal in a decision, and in total [m].
      offset: range of the rod's initial place, across and along the pads [m].
      tolerance: error that counts as a success [m].
      held: reward of a decision with the rod in the grip; near: scale of the error in the reward [m].
      lead: shift of the goals of the fingers' pads, opposite to the thumb's, while they close [m]: soft
        servos yield along the pads, and a rod comes to lie 5 mm from their middle.
    """

    decisions: int = 12
    prepare: int = 17
    encoder: float = 5e-3
    gentle: float = 4.0
    target: tuple = (-1e-3, 3e-3)
    rate: float = 0.8e-3
    reach: float = 8e-3
    close: float = 0.4
    offset: tuple = (4e-3, 3e-3)
    mass: tuple = (8e-3, 30e-3)
    tolerance: float = 0.4e-3
    held: float = 0.2
    near: float = 0.7e-3
    twist: float = 1e-4
    lost: float = 20e-3
    lead: float = 4e-3


_LATE = 2.0  # delay of a rod behind the goals of the pads [decisions]
_TARGET = -2  # in what is sensed of the body


class RollRod(HeldTask):
    """A Shadow Hand holds a rod between its thumb and two fingers and rolls it to a given place on the pads.
    The rod's initial place, mass and friction differ between worlds and are not observed.

    Actions: movements of the pads of two fingers and the thumb, across the rod and towards it. Observations:
    "body" (num_envs, 34): changes of thirteen joint angles, their velocities / 10 rad/s, changes of the goals
    of six movements of pads, as fractions of `reach`, the target [mm], the time; "touch": changes since the
    fingers were open; "state" (num_envs, 5): place [mm], error / `near`, forces of the fingers [N]. Reward of
    a decision: 0.2 with the rod in the grip, and after its release 1 / (1 + (error / near)^2).

    Args:
      hand: Menagerie's shadow_hand/right_hand.xml; None looks for it in the folder that the variable
        MENAGERIE_ROOT names.
      The others: see `BatchTask`.

    Raises:
      FileNotFoundError: no such hand. ValueError: another hand, or a number that cannot be.
    """

    body = "rod"
    num_actions = 6
    gamma = 0.9  # a decision is paid at once; with 0.97 noise hides what it gave
    settings = Settings()
    study = 0.9
    same_in_tiers = True

    def __init__(
        self, hand: pathlib.Path | str | None = None, num_envs: int = 256, *args: object, **keywords: object
    ):
        menagerie = pathlib.Path(os.environ.get("MENAGERIE_ROOT", "mujoco_menagerie"))
        self._hand = hand or menagerie / "shadow_hand" / "right_hand.xml"
        super().__init__(num_envs, *args, **keywords)

    def _scene(self, skin):
        return *build(self._hand, self.cfg.timestep, True, skin=skin), {}

    def _find_start(self, mjm):
        self.pinch = find_pinch(mjm)
        x, y, _ = self.pinch.axis  # along the rod: its roll between the pads is seen best
        self.camera = self.pinch.centre, 0.1, math.degrees(math.atan2(y, x)) + 20.0, -15.0
        return self.pinch.qpos

    def _read(self, mjm, prefixes):
        super()._read(mjm, prefixes)
        p, s, d = self.pinch, self.cfg, self._d
        tensor = functools.partial(torch.as_tensor, device=self.device)
        self._joints, self._actuators = tensor(p.joints), tensor(p.actuators)
        dofs = [mjm.jnt_dofadr[list(mjm.jnt_qposadr).index(a)] for a in p.joints]
        self._dofs = tensor(np.array(dofs))
        self._opened, self._closed = (tensor(c, dtype=torch.float32) for c in (p.opened, p.closed))
        self._closed += tensor(p.pads @ (s.lead * np.array([-1, -1, 1, 0, 0, 0])), dtype=torch.float32)
        self._limits = tensor(mjm.actuator_ctrlrange[p.actuators].T, dtype=torch.float32)
        self._axes = [tensor(x, dtype=torch.float32) for x in (np.cross(p.normal, p.axis), p.axis, p.centre)]
        self._cores = tensor(np.array([mjm.body(f"{q}core").id for q in prefixes.values()]))
        self._xpos, self._xmat = wp.to_torch(d.xpos), wp.to_torch(d.xmat)
        self._pads = tensor(p.pads.T, dtype=torch.float32)
        self._target = torch.zeros(self.num_envs, device=self.device)
        # at the last decision of a script; none in an episode that begins
        self._place_before = torch.full((self.num_envs,), torch.nan, device=self.device)

    @property
    def target(self) -> torch.Tensor:
        """(num_envs,) target places [m]."""
        return self._target

    @property
    def held(self) -> torch.Tensor:
        """(num_envs,) whether the rod is still between the fingers."""
        return (self.pos - self._axes[2]).norm(dim=1) < self.cfg.lost

    @property
    def place(self) -> torch.Tensor:
        """Distance (num_envs,) of the rod's middle from the middle of the fingers' pads, toward their tips
        [m], when the last step began."""
        fingers = self._cores[:2]  # of the thumb it is another
        off = self.pos[:, None] - self._xpos[:, fingers]
        return (off[..., None] * self._xmat[:, fingers]).sum(-2)[..., 0].mean(1).neg() + _PAD[0]

    @property
    def error(self) -> torch.Tensor:
        """Distance (num_envs,) of the rod from its target [m]."""
        return (self.place - self._target).abs()

    def script(self) -> torch.Tensor:
        """Moves the fingers' pads against the thumb, by the rod's place that is predicted for two decisions
        later, since it follows with this delay."""
        place = self.place
        coming = place + _LATE * torch.nan_to_num(place - self._place_before)
        self._place_before[:] = place
        return self._roll(self._target - coming)

    def change_goal(self, sensed: dict, wish: torch.Tensor) -> tuple[dict, torch.Tensor]:
        body, target = sensed["body"].clone(), self._uniform(*self.cfg.target, len(wish))
        off = target - 1e-3 * body[:, 0, _TARGET]
        body[..., _TARGET] = 1e3 * target[:, None]
        return {**sensed, "body": body}, wish + self._roll(off)

    def _roll(self, distance):
        """Actions that move the fingers' pads by distances (n,) [m] against the thumb."""
        return torch.outer(distance / self.cfg.rate, torch.tensor([1.0, 1, -1, 0, 0, 0], device=self.device))

    def _judge(self):
        s, error = self.cfg, self.error
        free = (self._age * s.substeps * s.timestep > s.release).float()
        paid = 1 / (1 + (error / s.near) ** 2)
        return s.held + free * paid, self.held, error < s.tolerance, error

    def _command(self):
        goal = self._opened + self._closing() * (self._closed - self._opened) + self._moved @ self._pads
        self._ctrl[:, self._actuators] = goal.clamp(self._limits[0], self._limits[1])

    def _sense_body(self, off, speed_off):
        s = self.cfg
        angles = self.qpos[:, self._joints] - self._start[self._joints] + off
        velocities = self.qvel[:, self._dofs] + speed_off
        time = self.episode_length_buf[:, None] / s.decisions
        return [angles, velocities / 10.0, self._moved / s.reach, 1e3 * self._target[:, None], time]

    def _state(self):
        error = self.error[:, None] / self.cfg.near
        return [1e3 * self.place[:, None], error, self.force]

    def _draw_goals(self, which):
        self._target = self._target.where(~which, self._uniform(*self.cfg.target, self.num_envs))
        self._place_before.masked_fill_(which, torch.nan)

    def _place(self, some):
        s, n = self.cfg, self.num_envs
        across, along, centre = self._axes
        off = self._uniform(-1, 1, n, 2)
        place = centre + s.offset[0] * off[:, :1] * across + s.offset[1] * off[:, 1:] * along
        self._put(some, place)
