"""A fingertip finds the rim of a plate by touch and follows it."""

import dataclasses

import mujoco
import torch

from .machine import carriage, new_spec, servo
from .task import BatchTask, TaskSettings

_PAD = 8.2e-3  # from the BioTac's axis to its pad [m]
_POINT = -9e-3  # x of the pad's point that is to stay on the rim, BioTac frame [m]
_ROUNDING = 1e-3  # of the rim [m]
_AXES = ("x", "y", "z", "yaw")
_PAD_DOWN = (0.5**0.5, 0.5**0.5, 0.0, 0.0)  # w x y z: tip along -x, pad along -z


@dataclasses.dataclass(frozen=True)
class Settings(TaskSettings):
    """Numbers of the task; see `TaskSettings` too.

    Attributes:
      radius: of the plate [m]. gap: initial height of the pad over it [m]. inside: initial distance inside
        its rim [m]. turn: initial angle of the rim to the finger [rad].
      rate, reach: change of the goals of x, y, z [m] and yaw [rad] by a decision, and in total.
      on_rim: distance from the rim at which the pad is on it [m]. forces: range of the pressing force [N].
      speed: along the rim for the full reward [m/s]. distance: distance along it for a success [m].
      lost: distance from the rim at which the episode is lost [m].
    """

    decisions: int = 60
    encoder: float = 2e-5
    gentle: float = 4.0
    radius: float = 0.045
    gap: tuple = (0.5e-3, 2.5e-3)
    inside: tuple = (1e-3, 5e-3)
    turn: tuple = (-0.3, 0.3)
    rate: tuple = (0.5e-3, 0.5e-3, 0.25e-3, 0.04)
    reach: tuple = (40e-3, 15e-3, 8e-3, 1.2)
    on_rim: float = 1.5e-3
    forces: tuple = (0.15, 3.0)
    speed: float = 8e-3
    distance: float = 8e-3
    lost: float = 10e-3


class FollowEdge(BatchTask):
    """A finger starts above a round plate, some millimetres inside its rim. It moves down, finds the rim on
    its right, and follows it tip first. Height, distance and direction of the rim differ between worlds and
    are not observed.

    Actions: along the finger (tip first), to its left, up, and its turn. Observations: "body" (num_envs, 13):
    changes of four joints [cm, rad], velocities, goals as fractions of `reach`, the time;
    "state" (num_envs, 4): distance outside the rim [mm], turn against it [rad], height of the pad over the
    plate [mm], force [N]. Reward of a decision, where the pad presses with a force between `forces`: 0.1, up
    to 0.3 more near the rim, and on it up to 0.6 more for the speed along it. Success: `distance` along
    the rim, on it, by the end."""

    num_actions = 4
    camera = ((-0.02, 0.012, -0.01), 0.12, 125.0, -25.0)
    settings = Settings()

    def _scene(self, skin):
        from ... import batch

        spec = new_spec(self.cfg.timestep)
        plate = spec.worldbody.add_body(name="plate", mocap=True, pos=[0, 0, -0.05])
        kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, [self.cfg.radius, 4e-3, 0]
        plate.add_geom(name="plate", type=kind, size=size, pos=[0, 0, -4e-3], rgba=[0.75, 0.6, 0.4, 1])
        body = spec.worldbody
        for name, axis in zip(_AXES, ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 1)), strict=True):
            body = carriage(body, name)
            servo(spec, body, name, axis, 20.0 if name == "yaw" else 3000.0, hinge=name == "yaw")
        batch.add(spec, body="yaw", quat=_PAD_DOWN, skin=skin, geoms=["plate"])
        return spec, {"finger": "biotac_"}, {"geoms": ["plate"], "rounding": {"plate": _ROUNDING}}

    def _read(self, mjm, prefixes):
        self._plate = self.mocap_pos[:, 0]
        self._along, self._last = (torch.zeros(self.num_envs, *k, device=self.device) for k in ((), (2,)))

    def _moves(self, actions):
        forward, lateral, up, turn = (self._rate * actions).unbind(1)
        c, s = self._moved[:, 3].cos(), self._moved[:, 3].sin()
        return torch.stack([-c * forward - s * lateral, c * lateral - s * forward, up, turn], dim=1)

    def _pad(self):
        """(num_envs, 2) place of the pad's point [m]."""
        yaw = self.qpos[:, 3]
        return self.qpos[:, :2] + _POINT * torch.stack([yaw.cos(), yaw.sin()], dim=1)

    def _pose(self):
        """(num_envs,) distance outside the rim [m], turn of the finger against it [rad], and (num_envs, 2)
        the tangent of the rim, tip first."""
        away = self._pad() - self._plate[:, :2]
        distance = away.norm(dim=1)
        tangent = torch.stack([away[:, 1], -away[:, 0]], dim=1) / distance[:, None]
        yaw = self.qpos[:, 3]
        c, s = yaw.cos(), yaw.sin()
        turn = torch.atan2(tangent[:, 1] * c - tangent[:, 0] * s, -tangent[:, 0] * c - tangent[:, 1] * s)
        return distance - self.cfg.radius, turn, tangent

    @property
    def held(self) -> torch.Tensor:
        return self._pose()[0].abs() < self.cfg.lost

    def script(self) -> torch.Tensor:
        s, (off, turn, _), force = self.cfg, self._pose(), self.force[:, 0]
        touching = force > 0.05
        forward = (off.abs() < 1e-3).float() * 0.8
        lateral = (off / s.rate[1]).clamp(-1, 1)
        up = torch.where(touching, (force - 0.8).clamp(-0.5, 0.5), -1.0)
        actions = torch.stack([forward, lateral, up, (-turn / s.rate[3]).clamp(-1, 1)], dim=1)
        return actions * torch.stack([touching, touching, force > -1, touching], dim=1)

    def _judge(self):
        s, (off, _, tangent), force = self.cfg, self._pose(), self.force[:, 0]
        pad = self._pad()
        travel = ((pad - self._last) * tangent).sum(1)
        self._last[:] = pad
        pressing = ((force > s.forces[0]) & (force < s.forces[1])).float()
        on = pressing * (off.abs() < s.on_rim)
        self._along += on * travel
        speed = (travel / (s.substeps * s.timestep * s.speed)).clamp(0, 1)
        paid = pressing * (0.1 + 0.3 / (1 + (off / s.on_rim) ** 2)) + 0.6 * on * speed
        return paid, self.held, self._along >= s.distance, (s.distance - self._along).clamp(min=0.0)

    def _command(self):
        self._ctrl[:] = self._moved

    def _sense_body(self, off, speed_off):
        place, speed = self.qpos + off, self.qvel + speed_off
        scale = torch.tensor([100.0, 100.0, 100.0, 1.0], device=self.device)
        time = self.episode_length_buf[:, None] / self.cfg.decisions
        return [place * scale, speed * scale, self._moved / self._reach, time]

    def _state(self):
        off, turn, _ = self._pose()
        height = self.qpos[:, 2] - _PAD - self._plate[:, 2]
        return [1e3 * off[:, None], turn[:, None], 1e3 * height[:, None], self.force]

    def _place(self, some):
        s, n = self.cfg, self.num_envs
        turn, gap = self._uniform(*s.turn, n), self._uniform(*s.gap, n)
        within = s.radius - self._uniform(*s.inside, n)
        plate = torch.stack([_POINT - within * turn.sin(), within * turn.cos(), -_PAD - gap], dim=1)
        self._plate[:] = plate.where(some, self._plate)
        self._along.masked_fill_(some[:, 0], 0.0)
        self._last[:] = self._pad().where(some, self._last)
