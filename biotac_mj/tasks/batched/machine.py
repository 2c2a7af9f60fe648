"""Machines of carriages with position servos, as MjSpecs for mujoco_warp."""

import mujoco
import numpy as np

_MASS, _INERTIA = 0.15, 1e-4  # of a carriage [kg], [kg m^2]


def new_spec(timestep: float) -> mujoco.MjSpec:
    """Without bodies; timestep [s]."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = timestep, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.iterations, spec.option.ls_iterations = 30, 20  # single precision: 1e-8 is out of its reach
    spec.option.tolerance = 1e-6
    return spec


def carriage(parent: "mujoco._specs.MjsBody", name: str, pos: tuple = (0, 0, 0)) -> "mujoco._specs.MjsBody":
    """A body that carries and does not fall."""
    body = parent.add_body(name=name, pos=pos, gravcomp=1.0)
    body.mass, body.inertia, body.explicitinertial = _MASS, [_INERTIA] * 3, True
    return body


def servo(
    spec: mujoco.MjSpec,
    body: "mujoco._specs.MjsBody",
    name: str,
    axis: tuple,
    stiffness: float,
    hinge: bool = False,
) -> None:
    """Moves a body against its parent, critically damped for one carriage.

    Args:
      axis: of the slide or hinge. stiffness: [N/m] or [N m/rad].
    """
    kind = mujoco.mjtJoint.mjJNT_HINGE if hinge else mujoco.mjtJoint.mjJNT_SLIDE
    body.add_joint(name=name, type=kind, axis=axis)
    inertia = _INERTIA if hinge else _MASS
    actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=stiffness, kv=2 * np.sqrt(stiffness * inertia))
