"""One press of an indenter into a BioTac with `mj_step`: where it goes, the scene, the run.

What is kept and written of it is in `press_record` and `press_report`.
"""

import dataclasses
import time

import mujoco
import numpy as np
import tqdm

from . import approach, plugin, press_indenter
from .geometry.rigid import matrix, quaternion, quaternion_from_y
from .geometry.skin_geometry import SkinGeometry
from .press_record import PressRecord
from .sensor.channels import CHANNELS

__all__ = ["Path", "PressOptions", "build_scene", "plan_path", "press", "render", "see_through"]

_LEAD = 5e-6  # the indenter starts this far before first touch [m]
_PREFIX = "biotac_"
# The servo of a two-way press: 50 kN/m gives way by 0.02 mm per newton; with this mass it moves at 200 rad/s,
# slow against a 4 ms step.
_SERVO_STIFFNESS, _SERVO_MASS = 5e4, 1.25


@dataclasses.dataclass(frozen=True)
class PressOptions:
    """What a press is.

    Attributes:
      indenter: see `press_indenter.make_indenter`.
      location: (x [m], angle around the finger [rad]) or (x, y, z) [m], moved to the nearest point of the
        skin.
      direction: of the press (3,); None is the inward normal of the skin at the location.
      depth: travel from first touch [m].
      slide: travel along slide_direction after the press [m].
      slide_direction: (3,), of which the part across `direction` counts.
      material: name of a preset of the skin.
      liquid: whether there is liquid under the skin; None takes the material's choice.
      skin: "coarse", "default", "fine" or a file.
      tier: of the skin's solution, "full" or "condensed".
      timestep: [s]. speed: of the indenter [m/s]. hold: rest at the end of the press and of the slide [s].
      two_way: a servo with mass pushes the indenter and gives way, instead of a prescribed path.
      friction: Coulomb coefficient; None takes the material's.
      seed: of the sensor's noise.
      device: of the skin, "cpu" or "cuda:0".
    """

    indenter: str = "sphere_7mm"
    location: tuple = (-12e-3, 0.0)
    direction: tuple | None = None
    depth: float = 2.4e-3
    slide: float = 0.0
    slide_direction: tuple = (1.0, 0.0, 0.0)
    material: str = "default"
    liquid: bool | None = None
    skin: str = "default"
    tier: str = "full"
    timestep: float = 4e-3
    speed: float = 10e-3
    hold: float = 0.02
    two_way: bool = False
    friction: float | None = None
    seed: int = 0
    device: str = "cpu"

    def __post_init__(self):
        for name, least in (("depth", 0), ("timestep", 0), ("speed", 0)):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > least):
                raise ValueError(f"{name} is {getattr(self, name)}: it must be a positive number")
        for name in ("slide", "hold"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name} is {getattr(self, name)}: it must be zero or a positive number")
        if len(self.location) not in (2, 3):
            raise ValueError(
                f"location {self.location} has {len(self.location)} numbers: give x and an angle, or x, y "
                "and z"
            )
        for name in ("location", "direction", "slide_direction"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                raise ValueError(f"{name} {value} contains NaN or infinite numbers")
        for name in ("direction", "slide_direction"):
            value = getattr(self, name)
            if value is not None and (len(value) != 3 or not np.linalg.norm(value)):
                raise ValueError(f"{name} {value} is no direction: give three numbers that are not all zero")


@dataclasses.dataclass(frozen=True)
class Path:
    """Way of an indenter's frame, which only translates.

    Attributes:
      start: (3,) its origin at first touch [m].
      quat: (4,) its orientation.
      direction, slide_direction: (3,) unit vectors, across each other.
      depth, slid: (n,) travel at each step [m]; row 0 is the start before first touch.
    """

    start: np.ndarray
    quat: np.ndarray
    direction: np.ndarray
    slide_direction: np.ndarray
    depth: np.ndarray
    slid: np.ndarray

    def position(self, depth: float, slid: float = 0.0) -> np.ndarray:
        """(3,) origin of the frame after travels [m]."""
        return self.start + depth * self.direction + slid * self.slide_direction


def plan_path(geometry: SkinGeometry, indenter: press_indenter.Indenter, options: PressOptions) -> Path:
    """Where the indenter goes: from 5 um before it first touches the resting skin, in even steps to the
    depth, then along the skin.

    Raises:
      ValueError: no skin at the location, an indenter that passes it, a direction out of the skin, or a slide
        along the direction.
    """
    if len(options.location) == 2:
        point, normal = approach.surface_point(geometry, *options.location)
    else:
        point, normal = approach.nearest_point(geometry, options.location)
    direction = -normal if options.direction is None else np.asarray(options.direction, float)
    direction = direction / np.linalg.norm(direction)
    if direction @ normal >= 0:
        raise ValueError(
            f"direction {direction.round(3).tolist()} leaves the skin at {(1e3 * point).round(2).tolist()} "
            "mm: it must point into it"
        )
    across = np.asarray(options.slide_direction, float)
    across = across - (across @ direction) * direction
    if options.slide and np.linalg.norm(across) < 1e-3 * np.linalg.norm(options.slide_direction):
        raise ValueError("slide_direction is along the press: give one across it")
    across = across / max(np.linalg.norm(across), 1e-30)

    quat = quaternion_from_y(direction)
    spec = mujoco.MjSpec()
    back = 0.05 + np.abs(indenter.vert).max()  # clear of the finger
    press_indenter.add_indenter(
        spec, spec.worldbody.add_body(pos=point - back * direction, quat=quat), indenter, exact=False
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    travel = approach.first_touch(geometry, model, data, direction)
    start = point + (travel - back) * direction

    step = options.speed * options.timestep

    def ramp(length):
        count = int(np.ceil(length / step - 1e-9))
        return length * np.arange(1, count + 1) / max(count, 1)

    rest = np.zeros(int(round(options.hold / options.timestep)))
    down, along = ramp(options.depth), ramp(options.slide)
    depth = np.concatenate(
        [
            [-_LEAD],
            down,
            rest + options.depth,
            0 * along + options.depth,
            (rest if options.slide else rest[:0]) + options.depth,
        ]
    )
    slid = np.concatenate([[0], 0 * down, rest, along, (rest if options.slide else rest[:0]) + options.slide])
    return Path(start, quat, direction, across, depth, slid)


def build_scene(indenter: press_indenter.Indenter, path: Path, options: PressOptions):
    """The BioTac on a fixed body, the indenter on a mocap body or, two-way, on slide joints with servos; a
    camera named "press".

    Returns:
      spec, and the handle of `biotac_mj.attach`.

    Raises:
      ValueError: a two-way press with a plane, which cannot move in MuJoCo.
    """
    from .coupling import attach
    from .skin.material import material

    chosen = material(options.material)
    friction = chosen.friction if options.friction is None else options.friction
    spec = mujoco.MjSpec()
    spec.option.timestep = options.timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = np.zeros(3)
    _stage(spec)
    spec.worldbody.add_body(name="finger")

    body = spec.worldbody.add_body(
        name="indenter", pos=path.position(-_LEAD), quat=path.quat, mocap=not options.two_way
    )
    look = dict(contype=0, conaffinity=0, friction=[friction, 0.005, 1e-4], rgba=[0.85, 0.45, 0.15, 0.35])
    if options.two_way:
        if indenter.type == "plane":
            raise ValueError(
                "a plane cannot be pushed by a servo, MuJoCo keeps planes fixed: press it one-way, or use a "
                "flat geom:box"
            )
        body.mass, body.inertia, body.explicitinertial = _SERVO_MASS, [1e-3] * 3, True
        for name, axis in (("press", path.direction), ("slide", path.slide_direction))[
            : 2 if options.slide else 1
        ]:
            body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=matrix(path.quat).T @ axis)
            servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=_SERVO_STIFFNESS, dampratio=1.0)
    press_indenter.add_indenter(spec, body, indenter, **look)
    handle = attach(
        spec,
        body="finger",
        prefix=_PREFIX,
        skin=options.skin,
        tier=options.tier,
        material=options.material,
        liquid=chosen.liquid if options.liquid is None else options.liquid,
        coupling="two-way" if options.two_way else "one-way",
        geoms=["indenter"],
        rounding={"indenter": indenter.rounding} if indenter.rounding else None,
        friction=friction,
        seed=options.seed,
        device=options.device,
    )
    see_through(spec, handle)
    return spec, handle


def see_through(spec, handle):
    """Makes the skin of an attached BioTac translucent and its electrodes larger, so that their colours are
    seen."""
    spec.skin(handle.prefix + "skin").rgba[3] = 0.45
    for i in range(1, 20):
        spec.site(f"{handle.prefix}e{i}").size[0] = 7e-4


def _stage(spec):
    """Camera, light and a white background."""
    # from beside the pad, which looks up in the picture
    eye, up = np.array([-0.45, -0.55, -0.70]), np.array([0.0, -1.0, 0.0])
    z = eye / np.linalg.norm(eye)
    x = np.cross(up, z) / np.linalg.norm(np.cross(up, z))
    quat = quaternion(np.stack([x, np.cross(z, x), z], axis=1))
    spec.worldbody.add_camera(name="press", pos=0.036 * z + [-0.008, -0.003, 0], quat=quat, fovy=40)
    spec.worldbody.add_light(
        pos=[-0.1, -0.3, -0.1],
        dir=[0.6, 0.9, -0.1],
        diffuse=[0.5] * 3,
        specular=[0.1] * 3,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=False,
    )
    spec.visual.headlight.ambient[:], spec.visual.headlight.diffuse[:], spec.visual.headlight.specular[:] = (
        0.35,
        0.35,
        0.05,
    )
    sky = spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        width=8,
        height=48,
    )
    sky.rgb1, sky.rgb2 = [1.0] * 3, [1.0] * 3


def _read(handle, data):
    """What one step left: (3,) force of the skin on the indenter [N], (23,) counts, non-converged steps."""
    counts = np.concatenate(
        [handle.read(data, "electrodes"), *(handle.read(data, name)[-1:] for name in CHANNELS[19:])]
    )  # of PAC's 22 the latest
    return -handle.read(data, "contact_force")[:3], counts, handle.read(data, "status")[1]


def press(options: PressOptions = PressOptions(), render=None, progress: bool = True):  # noqa: B008 - frozen
    """Presses.

    Args:
      options: what to press where.
      render: called with (model, data) at the end; its result is returned beside the record.
      progress: whether to show a progress bar.

    Returns:
      record: PressRecord.
      picture: what `render` returned, None without it.

    Raises:
      ValueError, FileNotFoundError: an option is not possible; the text names cause and remedy.
    """
    from .geometry import load_skin

    geometry = load_skin(options.skin)
    indenter = press_indenter.make_indenter(options.indenter)
    path = plan_path(geometry, indenter, options)
    spec, handle = build_scene(indenter, path, options)
    try:
        model = spec.compile()
        data = mujoco.MjData(model)
    except (ValueError, mujoco.FatalError):
        plugin.check()  # says why, where MuJoCo only says that
        raise
    rows, picture = [], None
    last = len(path.depth) - 1
    begin = time.perf_counter()
    for step in tqdm.trange(last + 1, desc="press", unit="step", disable=not progress, leave=False):
        travel = np.array([path.depth[step], path.slid[step]])
        if options.two_way:
            data.ctrl[:] = (travel + [_LEAD, 0])[: model.nu]
            mujoco.mj_step(model, data)
            travel[: model.nq] = data.qpos - [_LEAD, 0][: model.nq]
        else:
            data.mocap_pos[0] = path.position(*travel)
            mujoco.mj_step(model, data)
        plugin.check()
        rows.append(
            (
                data.time,
                travel[0],
                path.position(*travel),
                handle.vert_xpos(model, data),
                *_read(handle, data),
            )
        )
    seconds = time.perf_counter() - begin
    if render is not None:
        picture = render(model, data)
    times, depth, position, xpos, force, counts, nonconverged = (np.array(column) for column in zip(*rows))
    record = PressRecord(
        geometry=geometry,
        parameters={
            **dataclasses.asdict(options),
            "direction": path.direction.tolist(),
            "start": path.start.tolist(),
        },
        time=times,
        depth=depth,
        force=force,
        counts=counts,
        nonconverged=nonconverged,
        vert_xpos=xpos.astype(np.float32),
        indenter_pos=position,
        indenter_quat=np.tile(path.quat, (len(times), 1)),
        indenter_vert=indenter.vert,
        indenter_face=indenter.face,
        seconds=seconds,
    )
    return record, picture


def render(model, data, width: int = 900, height: int = 640):
    """(height, width, 3) uint8 of the scene through the camera "press"; None where no GL library works."""
    from .offscreen import Offscreen, find_gl

    gl = find_gl()
    if gl is None:
        return None
    camera = mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera("press").id
    with Offscreen(model, width, height, gl) as screen:
        return screen.render(data, camera)
