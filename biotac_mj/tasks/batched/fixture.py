"""What holds a free body while fingers close on it: a spring that lets go."""

import functools
from collections.abc import Callable

import mujoco
import warp as wp

__all__ = ["hold"]


@wp.struct
class _Fixture:
    """What holds the body in the beginning: stiffness [N/m], damping [N s/m, N m s], until when [s]."""

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
    share = wp.clamp((f.release - time[w]) / (f.release - f.hold), 0.0, 1.0)
    pos = wp.vec3(qpos[w, f.qpos], qpos[w, f.qpos + 1], qpos[w, f.qpos + 2])
    vel = wp.vec3(qvel[w, f.qvel], qvel[w, f.qvel + 1], qvel[w, f.qvel + 2])
    turn = wp.quat(qpos[w, f.qpos + 4], qpos[w, f.qpos + 5], qpos[w, f.qpos + 6], qpos[w, f.qpos + 3])
    spin = wp.quat_rotate(turn, wp.vec3(qvel[w, f.qvel + 3], qvel[w, f.qvel + 4], qvel[w, f.qvel + 5]))
    weight = body_mass[w, f.body] * f.gravity
    force = share * (f.stiffness * (place[w] - pos) - f.damping * vel - weight)
    xfrc_applied[w, f.body] = wp.spatial_vector(force, -share * f.twist * spin)


def hold(
    mjm: mujoco.MjModel,
    m: object,
    d: object,
    name: str,
    place: wp.array,
    until: tuple[float, float],
    stiffness: float,
    damping: float,
    twist: float,
) -> Callable:
    """A function that launches the fixture of a step.

    Args:
      mjm, m, d: the MjModel, mujoco_warp's Model with a mass of the body in each world, and its Data.
      name: of the body and of its free joint. place: (nworld,) vec3 where it is held [m].
      until: when it begins to let go and when it is gone [s].
      stiffness [N/m], damping [N s/m], twist [N m s]: of the fixture.
    """
    joint = mjm.joint(name)
    fixture = _Fixture()
    fixture.body, fixture.qpos, fixture.qvel = mjm.body(name).id, joint.qposadr[0], joint.dofadr[0]
    fixture.hold, fixture.release = until
    fixture.stiffness, fixture.damping, fixture.twist = stiffness, damping, twist
    fixture.gravity = wp.vec3(*mjm.opt.gravity)
    inputs = [fixture, d.time, m.body_mass, place, d.qpos, d.qvel, d.xfrc_applied]
    return functools.partial(wp.launch, _hold, d.nworld, inputs)
