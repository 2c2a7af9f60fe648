"""Two fingertips insert a peg into a hole."""

import dataclasses

import mujoco
import torch

from .fixture import HeldSettings, HeldTask
from .machine import carriage, new_spec, servo

_PAD = 8.2e-3  # from the BioTac's axis to its pad [m]
_POINT = 12e-3  # from the BioTac's origin to where the pads meet the peg, toward the tip [m]
_RADIUS, _HALF, _ABOVE = 5e-3, 20e-3, 10e-3  # of the peg; from its middle up to where it is held [m]
_GAP = 1e-3  # between pads and peg before they close [m]
_WALL = 15e-3  # half the thickness of the plate with the hole, and the width of what is around it [m]
_TIP_DOWN = {  # w x y z: tip along -z, pads that face each other
    "left": (0.5**0.5, 0.0, -(0.5**0.5), 0.0),
    "right": (0.0, 0.5**0.5, 0.0, 0.5**0.5),
}


@dataclasses.dataclass(frozen=True)
class Settings(HeldSettings):
    """Numbers of the task; see `HeldSettings` too.

    Attributes:
      tilt: largest tilt of the peg in the grip [rad]. shift: largest shift along the pads' breadth [m]. off:
        largest distance of the hole across [m]. gap: range of the height of the peg's tip over its edge [m].
      clearance: between peg and hole on each side [m].
      depth: of the tip in the hole for a success [m].
      rate, reach: change of the goals of x, z [m] and pitch [rad] by a decision, and in total.
      squeeze: distance of the fingers' goals inside the peg [m].
      near: scale of the distance across from the hole in the reward [m].
    """

    decisions: int = 45
    prepare: int = 17
    encoder: float = 2e-5
    gentle: float = 8.0
    tilt: float = 0.25
    shift: float = 1e-3
    off: float = 0.5e-3
    gap: tuple = (3e-3, 5e-3)
    clearance: float = 0.6e-3
    depth: float = 7e-3
    rate: tuple = (0.5e-3, 0.8e-3, 0.025)
    reach: tuple = (12e-3, 20e-3, 0.5)
    squeeze: float = 4e-3
    near: float = 2e-3


class InsertPeg(HeldTask):
    """Two fingers hold a peg over a hole, tilted and off their middle, put it upright and insert it. Tilt,
    shift, mass and friction of the peg and the place of the hole differ between worlds and are not observed.

    Actions: across, up, and pitch. Observations: "body" (num_envs, 10): changes of these three joints [cm,
    rad], velocities, goals as fractions of `reach`, the time; "state" (num_envs, 6): tilt
    [rad], tip across from the hole [mm], depth [mm], pitch of the grip against the peg [rad], forces [N].
    Reward of a decision with the peg in the grip: 0.1, up to 0.3 more for a tip near the hole's axis, and up
    to 0.6 more for its depth. Success: `depth` by the end.
    """

    num_actions, body = 3, "peg"
    settings = Settings()
    camera = ((0.0, 0.0, 0.028), 0.16, 60.0, -15.0)

    def _scene(self, skin):
        from ... import batch

        s, spec = self.cfg, new_spec(self.cfg.timestep)
        peg = spec.worldbody.add_body(name="peg", pos=[0, 0, _HALF + _RADIUS])
        peg.add_freejoint(name="peg")
        kind, box = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX
        peg.add_geom(name="peg", type=kind, size=[_RADIUS, _HALF, 0], mass=0.02, rgba=[0.85, 0.45, 0.15, 1])
        plate = spec.worldbody.add_body(name="plate", mocap=True, pos=[0, 0, -0.05])
        inner, half = _RADIUS + s.clearance, _WALL / 2
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):  # walls around the hole, the first two the longer
            size = [half if x else inner, half if y else inner + _WALL, _WALL / 2]
            pos = [x * (inner + half), y * (inner + half), -_WALL / 2]
            plate.add_geom(type=box, size=size, pos=pos, rgba=[0.75, 0.6, 0.4, 1])
        wrist = spec.worldbody
        for name, axis in (("x", (1, 0, 0)), ("z", (0, 0, 1)), ("pitch", (0, 1, 0))):
            wrist = carriage(wrist, name, (0, 0, _HALF + _RADIUS + _ABOVE) if name == "x" else (0, 0, 0))
            servo(spec, wrist, name, axis, 20.0 if name == "pitch" else 3000.0, hinge=name == "pitch")
        prefixes, touching = {}, {"geoms": ["peg"]}
        for finger, side in (("left", 1), ("right", -1)):
            body = carriage(wrist, finger, (0, side * (_RADIUS + _GAP + _PAD), _POINT))
            servo(spec, body, finger, (0, -side, 0), 1000.0)
            more = dict(quat=_TIP_DOWN[finger], prefix=f"biotac_{finger}_", skin=skin)
            prefixes[finger] = batch.add(spec, body=finger, **more, **touching)
        return spec, prefixes, touching

    def _read(self, mjm, prefixes):
        super()._read(mjm, prefixes)
        names = ("x", "z", "pitch")
        self._joints = torch.tensor([int(mjm.joint(k).qposadr[0]) for k in names], device=self.device)
        self._dofs = torch.tensor([int(mjm.joint(k).dofadr[0]) for k in names], device=self.device)
        self._moving = torch.tensor([mjm.actuator(k).id for k in names], device=self.device)
        self._fingers = torch.tensor([mjm.actuator(k).id for k in prefixes], device=self.device)
        self._plate = self.mocap_pos[:, 0]

    @property
    def axis(self) -> torch.Tensor:
        """(num_envs, 3) the peg's, upwards."""
        w, x, y, z = self.quat.unbind(1)
        return torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=1)

    @property
    def tip(self) -> torch.Tensor:
        """(num_envs, 3) middle of the peg's lower end, from the hole's [m]."""
        return self.pos - _HALF * self.axis - self._plate

    @property
    def depth(self) -> torch.Tensor:
        """(num_envs,) of the tip below the edge of the hole [m]; above the plate 0 or less."""
        return _RADIUS - self.tip[:, 2]

    @property
    def held(self) -> torch.Tensor:
        """(num_envs,) whether the peg is still between the fingers."""
        joints = self.qpos[:, self._joints]
        grip = torch.stack([joints[:, 0], 0 * joints[:, 0], joints[:, 1] + self._grip_height], dim=1)
        away = self.pos + _ABOVE * self.axis - grip
        return away.norm(dim=1) < self.cfg.lost

    _grip_height = _HALF + _RADIUS + _ABOVE  # [m]

    def script(self) -> torch.Tensor:
        """Puts the peg upright, its tip over the hole, and goes down."""
        tilt = torch.atan2(self.axis[:, 0], self.axis[:, 2])
        aside = self.tip[:, 0]
        ready = (tilt.abs() < 0.04) & (aside.abs() < 0.8e-3) | (self.depth > 1e-3)
        wanted = torch.stack([-aside, torch.where(ready, -1.0, 0.0), -tilt], dim=1)
        scale = torch.tensor([self.cfg.rate[0], 1.0, self.cfg.rate[2]], device=self.device)
        return (wanted / scale).clamp(-1, 1)

    def _judge(self):
        s, depth = self.cfg, self.depth
        aside = self.tip[:, :2].norm(dim=1)
        far = (depth + s.gap[1]) / (s.depth + s.gap[1])  # of the way down from where it began
        paid = 0.1 + 0.3 / (1 + (aside / s.near) ** 2) + 0.6 * far.clamp(0, 1)
        return paid, self.held, depth >= s.depth, (s.depth - depth).clamp(min=0.0)

    def _command(self):
        self._ctrl[:, self._moving] = self._moved
        self._ctrl[:, self._fingers] = (self._closing() * (_GAP + self.cfg.squeeze)).expand(-1, 2)

    def _sense_body(self, off, speed_off):
        place, speed = self.qpos[:, self._joints] + off, self.qvel[:, self._dofs] + speed_off
        scale = torch.tensor([100.0, 100.0, 1.0], device=self.device)
        time = self.episode_length_buf[:, None] / self.cfg.decisions
        return [place * scale, speed * scale, self._moved / self._reach, time]

    def _state(self):
        tilt, tip = torch.atan2(self.axis[:, 0], self.axis[:, 2]), self.tip
        pitch = self.qpos[:, self._joints[2]]
        columns = [tilt, 1e3 * tip[:, 0], 1e3 * self.depth, pitch - tilt]
        return [torch.stack(columns, dim=1), self.force]

    def _draw_goals(self, which):
        """The hole is elsewhere in each episode."""
        s, n = self.cfg, self.num_envs
        aside, gap = self._uniform(-s.off, s.off, n), self._uniform(*s.gap, n)
        hole = torch.stack([aside, 0 * aside, -gap], dim=1)
        self._plate[:] = hole.where(which[:, None], self._plate)

    def _place(self, some):
        s, n = self.cfg, self.num_envs
        tilt, shift = self._uniform(-s.tilt, s.tilt, n), self._uniform(-s.shift, s.shift, n)
        zero = torch.zeros_like(tilt)
        pos = torch.stack([shift - _ABOVE * tilt.sin(), zero, self._grip_height - _ABOVE * tilt.cos()], dim=1)
        turn = torch.stack([(tilt / 2).cos(), zero, (tilt / 2).sin(), zero], dim=1)
        self._put(some, pos)
        self.quat[:] = turn.where(some, self.quat)
