"""The scene of a press: BioTac on a fixed body, indenter, camera and light."""

import mujoco
import numpy as np

from ..coupling.handle import Handle
from ..coupling.show import OBJECT
from ..geometry import load_skin
from ..geometry.rigid import matrix, quaternion
from ..view.offscreen import stage
from .indenter import Indenter, add_indenter
from .path import LEAD, Path, PressOptions

_PREFIX = "biotac_"
_FOVY, _ASPECT = 40.0, 1.4  # of the camera [deg], width over height


# The servo of a two-way press: 50 kN/m deflects by 0.02 mm per newton; with this mass its frequency is 200
# rad/s, which a 4 ms step resolves.
_SERVO_STIFFNESS, _SERVO_MASS = 5e4, 1.25


def build_scene(indenter: Indenter, path: Path, options: PressOptions) -> tuple[mujoco.MjSpec, Handle]:
    """The BioTac on a fixed body, the indenter on a mocap body or, two-way, on slide joints with servos; a
    camera named "press".

    Returns:
      spec, and the handle of `biotac_mj.attach`.

    Raises:
      ValueError: a two-way press with a plane, which cannot move in MuJoCo.
    """
    from ..coupling import attach
    from ..skin.settings import read_material

    settings = options.settings.amended()
    friction = settings.contact.friction
    if friction is None:
        friction = read_material(settings.skin.material).friction
    spec = mujoco.MjSpec()
    spec.option.timestep = options.timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = np.zeros(3)
    stage(spec)
    spec.worldbody.add_body(name="finger")

    body = spec.worldbody.add_body(
        name="indenter", pos=path.position(-LEAD), quat=path.quat, mocap=not options.two_way
    )
    look = dict(contype=0, conaffinity=0, friction=[friction, 0.005, 1e-4], rgba=[*OBJECT, 0.35])
    if options.two_way:
        if indenter.type == "plane":
            raise ValueError(
                "a plane cannot be pushed by a servo, MuJoCo keeps planes fixed: "
                "press it one-way, or use a flat geom:box"
            )
        body.mass, body.inertia, body.explicitinertial = _SERVO_MASS, [1e-3] * 3, True
        for name, axis in (("press", path.direction), ("slide", path.slide_direction))[
            : 2 if options.slide else 1
        ]:
            body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=matrix(path.quat).T @ axis)
            servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=_SERVO_STIFFNESS, dampratio=1.0)
    add_indenter(spec, body, indenter, **look)
    handle = attach(
        spec,
        body="finger",
        prefix=_PREFIX,
        settings=settings,
        coupling="two-way" if options.two_way else "one-way",
        geoms=["indenter"],
        rounding={"indenter": indenter.rounding} if indenter.rounding else None,
        friction=friction,
        thermal=None if options.thermal is None else {"indenter": options.thermal},
        textures=None if options.texture is None else {"indenter": options.texture},
        on_error="raise",
    )
    see_through(spec, handle)
    skin = load_skin(handle.config.skin)
    finger = np.concatenate([skin.vert, skin.nail_vert, skin.clamp_vert])
    _add_camera(spec, finger, indenter.vert @ matrix(path.quat).T + path.start)
    return spec, handle


def see_through(spec: mujoco.MjSpec, handle: Handle) -> None:
    """Makes the skin of an attached BioTac translucent and its electrodes larger, so that their colours are
    visible."""
    spec.skin(handle.prefix + "skin").rgba[3] = 0.45
    for name in handle.design.electrodes:
        spec.site(handle.prefix + name).size[0] = 7e-4


def _add_camera(spec, finger, indenter):
    """A camera that sees all of a finger (n, 3), and of an indenter (m, 3) [m] what is near it."""
    # from the side of the pad, which points up in the picture
    eye, up = np.array([-0.45, -0.55, -0.70]), np.array([0.0, -1.0, 0.0])
    z = eye / np.linalg.norm(eye)
    x = np.cross(up, z) / np.linalg.norm(np.cross(up, z))
    quat = quaternion(np.stack([x, np.cross(z, x), z], axis=1))
    low, high = finger.min(0), finger.max(0)
    reach = np.linalg.norm(high - low) / 2
    shown = np.concatenate([finger, np.clip(indenter, low - reach, high + reach)])
    middle = (shown.min(0) + shown.max(0)) / 2
    right, above, ahead = ((shown - middle) @ np.stack([x, np.cross(z, x), z], axis=1)).T
    slope = np.tan(np.radians(_FOVY / 2))
    away = (ahead + np.maximum(np.abs(above), np.abs(right) / _ASPECT) / slope).max()
    spec.worldbody.add_camera(name="press", pos=middle + 1.05 * away * z, quat=quat, fovy=_FOVY)
