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
from .hand import _PAD, Rod, build, find_pinch

__all__ = ["PLACE", "RollRod", "Settings", "rolled"]

_CHOICES = {"goal": ("angle", "place"), "actions": ("servos", "pads")}


@dataclasses.dataclass(frozen=True)
class Settings(HeldSettings):
    """Numbers of the task; see `HeldSettings` too. With `prepare` the fingers close in so many decisions, and
    episodes start with the rod in the grip.

    Attributes:
      target: range of the target angle [rad]; fingers that only close roll the rod by -0.25.
      rate: largest change of a servo's goal in a decision [rad]; reach: in total [rad].
      offset: range of the rod's initial place, across and along the pads [m].
      tolerance: error that counts as a success [rad].
      held: reward of a decision with the rod in the grip; near: scale of the error in the reward [rad].
      goal: "angle"; or "place": a distance along the fingers, towards their tips, from the middle of their
        pads [m], with `target`, `tolerance` and `near` in metres.
      actions: "servos", eleven joints; or "pads": six movements of the pads of two fingers and the thumb,
        across the rod and towards it, with `rate` and `reach` in metres.
      lead: shift of the goals of the fingers' pads, opposite to the thumb's, while they close [m]: soft
        servos yield along the pads, and a rod comes to lie 5 mm from their middle.
    """

    target: tuple = (-0.5, 0.0)
    rate: float = 0.015
    reach: float = 0.3
    close: float = 0.4
    hold: float = 0.5
    release: float = 0.7
    offset: tuple = (2e-3, 3e-3)
    mass: tuple = (8e-3, 30e-3)
    tolerance: float = 0.06
    held: float = 0.2
    near: float = 0.1
    twist: float = 1e-4
    lost: float = 20e-3
    goal: str = "angle"
    actions: str = "servos"
    lead: float = 0.0


# The rod is rolled to a given place on the pads. Exact joint angles, which differ by 1e-3 rad, determine the
# place to 0.1 mm; the encoders of a hand do not.
PLACE = Settings(
    decisions=12,
    prepare=17,
    hold=0.4,
    release=0.55,
    goal="place",
    target=(-1e-3, 3e-3),
    tolerance=0.4e-3,
    near=0.7e-3,
    offset=(4e-3, 3e-3),
    lead=4e-3,
    encoder=5e-3,
    actions="pads",
    rate=0.8e-3,
    reach=8e-3,
    gentle=4.0,
)


_LATE = 2.0  # delay of a rod behind the goals of the pads [decisions]


def rolled(begun: torch.Tensor, now: torch.Tensor) -> torch.Tensor:
    """Angles (n,) [rad], -pi to pi, by which attitudes `now` (n, 4), w x y z, are turned against `begun` (4,)
    about their own third axis: the twist of conj(begun) now."""
    w, x, y, z = begun
    along = w * now[:, 3] - z * now[:, 0] - x * now[:, 2] + y * now[:, 1]
    turned = 2 * torch.atan2(along, now @ begun)
    return torch.remainder(turned + torch.pi, 2 * torch.pi) - torch.pi


class RollRod(HeldTask):
    """A Shadow Hand holds a rod between its thumb and two fingers and rolls it by a given angle, or to a
    given place on the pads (`PLACE`). The rod's initial place, mass and friction differ between worlds and
    are not observed.

    Observations: "body" (num_envs, 39, or with pads' actions 34): changes of thirteen joint angles,
    their velocities / 10 rad/s, changes of the goals of eleven servos [rad] (of six movements of pads, as
    fractions of `reach`), the target [rad or mm], the time; "touch": changes since the fingers were open;
    "state" (num_envs, 6): angle [rad], place [mm], error / `near`, forces of the fingers [N]. Reward of a
    decision: 0.2 with the rod in the grip, and after its release exp(-(error / near)^2), for a place
    (`Settings.goal`) 1 / (1 + (error / near)^2).

    Args:
      hand: Menagerie's shadow_hand/right_hand.xml; None looks for it in the folder that the variable
        MENAGERIE_ROOT names.
      rod: its shape and mass. The others: see `BatchTask`.

    Raises:
      FileNotFoundError: no such hand. ValueError: another hand, or a number that cannot be.
    """

    body = "rod"
    gamma = 0.9  # a decision is paid at once; with 0.97 noise hides what it gave
    settings = Settings()

    def __init__(
        self,
        hand: pathlib.Path | str | None = None,
        num_envs: int = 256,
        *args: object,
        settings: Settings | None = None,
        rod: Rod = Rod(),  # noqa: B008 - frozen
        **keywords: object,
    ):
        s = self.settings if settings is None else settings
        for name, choice in _CHOICES.items():
            if getattr(s, name) not in choice:
                raise ValueError(f"{name}={getattr(s, name)!r}: choose one of {', '.join(choice)}")
        self.num_actions = 11 if s.actions == "servos" else 6
        menagerie = pathlib.Path(os.environ.get("MENAGERIE_ROOT", "mujoco_menagerie"))
        self._hand = hand or menagerie / "shadow_hand" / "right_hand.xml"
        self._rod_made = rod
        super().__init__(num_envs, *args, settings=s, **keywords)

    def _scene(self, skin):
        return *build(self._hand, self._rod_made, self.cfg.timestep, True, skin=skin), {}

    def _find_start(self, mjm):
        self.pinch = find_pinch(mjm, self._rod_made)
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
        self._pads = tensor(p.pads.T, dtype=torch.float32) if self.num_actions == 6 else None
        self._target = torch.zeros(self.num_envs, device=self.device)
        # at the last decision of a script; none in an episode that begins
        self._place_before = torch.full((self.num_envs,), torch.nan, device=self.device)

    @property
    def target(self) -> torch.Tensor:
        """(num_envs,) target angles [rad], or positions [m]."""
        return self._target

    @property
    def angle(self) -> torch.Tensor:
        """(num_envs,) by which the rod is rolled about its axis [rad]."""
        return rolled(self._start[self._at + 3 : self._at + 7], self.quat)

    @property
    def held(self) -> torch.Tensor:
        """(num_envs,) whether the rod is still between the fingers."""
        return (self.pos - self._axes[2]).norm(dim=1) < self.cfg.lost

    @property
    def place(self) -> torch.Tensor:
        """(num_envs,) how far the rod's middle is from the middle of the fingers' pads, toward their tips
        [m], when the last step began."""
        fingers = self._cores[:2]  # of the thumb it is another
        off = self.pos[:, None] - self._xpos[:, fingers]
        return (off[..., None] * self._xmat[:, fingers]).sum(-2)[..., 0].mean(1).neg() + _PAD[0]

    @property
    def error(self) -> torch.Tensor:
        """(num_envs,) how far the rod is from its target [rad or m]."""
        return ((self.angle if self.cfg.goal == "angle" else self.place) - self._target).abs()

    def script(self) -> torch.Tensor:
        """Moves the fingers' pads against the thumb, by the rod's place that is predicted for two decisions
        later, since it follows with this delay.

        Raises:
          ValueError: the settings are not those of a place.
        """
        if self.cfg.goal != "place" or self.cfg.actions != "pads":
            raise ValueError("a script rolls the rod to a place by its pads: take settings=PLACE")
        place = self.place
        coming = place + _LATE * torch.nan_to_num(place - self._place_before)
        self._place_before[:] = place
        move = ((self._target - coming) / self.cfg.rate).clamp(-1, 1)[:, None]
        return move * torch.tensor([1.0, 1.0, -1.0, 0.0, 0.0, 0.0], device=self.device)

    def _judge(self):
        s, error = self.cfg, self.error
        free = (self._age * s.substeps * s.timestep > s.release).float()
        off = (error / s.near) ** 2
        paid = off.neg().exp() if s.goal == "angle" else 1 / (1 + off)
        return s.held + free * paid, self.held, error < s.tolerance, error

    def _command(self):
        moved = self._moved if self._pads is None else self._moved @ self._pads
        goal = self._opened + self._closing() * (self._closed - self._opened) + moved
        self._ctrl[:, self._actuators] = goal.clamp(self._limits[0], self._limits[1])

    def _sense_body(self, off, speed_off):
        s = self.cfg
        angles = self._qpos[:, self._joints] - self._start[self._joints] + off
        velocities = self._qvel[:, self._dofs] + speed_off
        time = self.episode_length_buf[:, None] / s.decisions
        moved = self._moved / s.reach if self._pads is not None else self._moved
        goal = self._target if s.goal == "angle" else 1e3 * self._target
        return [angles, velocities / 10.0, moved, goal[:, None], time]

    def _state(self):
        error = self.error[:, None] / self.cfg.near
        return [self.angle[:, None], 1e3 * self.place[:, None], error, self.force]

    def _draw_goals(self, which):
        self._target = self._target.where(~which, self._uniform(*self.cfg.target, self.num_envs))
        self._place_before.masked_fill_(which, torch.nan)

    def _place(self, some):
        s, n = self.cfg, self.num_envs
        across, along, centre = self._axes
        off = self._uniform(-1, 1, n, 2)
        place = centre + s.offset[0] * off[:, :1] * across + s.offset[1] * off[:, 1:] * along
        self._put(some, place)
