"""A spring that holds a free body while fingers close on it, and then releases it."""

import dataclasses
import functools

import torch
import warp as wp

from ...kernels import kernel_module
from .task import BatchTask, TaskSettings

kernel_module(__name__)


@wp.struct
class _Fixture:
    """The spring: stiffness [N/m], damping [N s/m], twist [N m s], times of its release [s]."""

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
    body_mass: wp.array2d(dtype=float),
    place: wp.array(dtype=wp.vec3),
    qpos: wp.array2d(dtype=float),
    qvel: wp.array2d(dtype=float),
    xfrc_applied: wp.array2d(dtype=wp.spatial_vector),
):
    w = wp.tid()
    f = fixture
    fraction = wp.clamp((f.release - time[w]) / (f.release - f.hold), 0.0, 1.0)
    pos = wp.vec3(qpos[w, f.qpos], qpos[w, f.qpos + 1], qpos[w, f.qpos + 2])
    vel = wp.vec3(qvel[w, f.qvel], qvel[w, f.qvel + 1], qvel[w, f.qvel + 2])
    turn = wp.quat(qpos[w, f.qpos + 4], qpos[w, f.qpos + 5], qpos[w, f.qpos + 6], qpos[w, f.qpos + 3])
    spin = wp.quat_rotate(turn, wp.vec3(qvel[w, f.qvel + 3], qvel[w, f.qvel + 4], qvel[w, f.qvel + 5]))
    weight = body_mass[w, f.body] * f.gravity
    force = fraction * (f.stiffness * (place[w] - pos) - f.damping * vel - weight)
    xfrc_applied[w, f.body] = wp.spatial_vector(force, -fraction * f.twist * spin)


@dataclasses.dataclass(frozen=True)
class HeldSettings(TaskSettings):
    """Numbers of a task whose fingers hold a free body; see `TaskSettings` too.

    Attributes:
      mass: of the body, between these [kg].
      close, hold, release: [s] fingers close until `close`; a spring holds the body until `hold` and is
        released until `release`.
      stiffness [N/m], damping [N s/m], twist [N m s]: of the spring.
      lost: distance from its place in the grip at which the body counts as lost [m].
    """

    mass: tuple = (10e-3, 30e-3)
    close: float = 0.3
    hold: float = 0.4
    release: float = 0.55
    stiffness: float = 60.0
    damping: float = 1.0
    twist: float = 2e-5
    lost: float = 12e-3


class HeldTask(BatchTask):
    """A task whose fingers close on a free body, which a fixture holds until then. Its mass differs between
    worlds."""

    body: str  # name of it and of its joint

    def _vary(self):
        return self._give_mass(self.body, self._uniform(*self.cfg.mass, self.num_envs).cpu().numpy())

    def _read(self, mjm, prefixes):
        s, joint = self.cfg, mjm.joint(self.body)
        self._at = int(joint.qposadr[0])  # of the body's pose
        self._held_at = torch.zeros(self.num_envs, 3, device=self.device)
        place = wp.from_torch(self._held_at, dtype=wp.vec3)
        fixture = _Fixture()
        fixture.body, fixture.qpos, fixture.qvel = mjm.body(self.body).id, self._at, joint.dofadr[0]
        for name in ("hold", "release", "stiffness", "damping", "twist"):
            setattr(fixture, name, getattr(s, name))
        fixture.gravity = wp.vec3(*mjm.opt.gravity)
        d = self._d
        inputs = [fixture, d.time, self._m.body_mass, place, d.qpos, d.qvel, d.xfrc_applied]
        self._act = functools.partial(wp.launch, _hold, d.nworld, inputs)

    @property
    def pos(self) -> torch.Tensor:
        """(num_envs, 3) of the body [m], a view."""
        return self.qpos[:, self._at : self._at + 3]

    @property
    def quat(self) -> torch.Tensor:
        """(num_envs, 4) of the body, w x y z, a view."""
        return self.qpos[:, self._at + 3 : self._at + 7]

    def _closing(self):
        """Closed fraction of the fingers (num_envs, 1), 0 to 1."""
        s = self.cfg
        return (self._age * s.substeps * s.timestep / s.close).clamp(0, 1)[:, None]

    def _put(self, some, pos):
        """Puts the body of worlds, (num_envs, 1) of bool, to pos (num_envs, 3) [m], and holds it there."""
        self.pos[:] = pos.where(some, self.pos)
        self._held_at[:] = pos.where(some, self._held_at)
