"""The scene: a Shadow Hand, palm up, with BioTacs on thumb, first and middle finger, and a free rod."""

import dataclasses
import pathlib

import mujoco
import numpy as np
from scipy.optimize import least_squares

from ..hands import attach_to_hand

FINGERS = ("ff", "mf", "th")
JOINTS = tuple(f"{f}J{i}" for f in ("FF", "MF") for i in (4, 3, 2, 1)) + tuple(
    f"THJ{i}" for i in (5, 4, 3, 2, 1)
)
_ACTUATORS = ("FFJ4", "FFJ3", "FFJ0", "MFJ4", "MFJ3", "MFJ0", "THJ5", "THJ4", "THJ3", "THJ2", "THJ1")
_PAD = np.array([-12e-3, -8.0e-3, 0.0])  # where a pad meets the rod, in the BioTac frame [m]
_RADIUS, _HALF_LENGTH, _MASS = 10e-3, 30e-3, 15e-3  # of the rod, a capsule [m], [kg]
_GAP = 1e-3  # between pads and rod before they close [m]
_MARGIN = 0.1  # that joints stay away from their ends [rad]
# a precision grip to begin the search with [rad]: knuckles bent, thumb opposed
_GUESS = np.array([0, 0.9, 0.5, 0.5, 0, 0.9, 0.5, 0.5, 0.3, 1.0, 0, 0.2, 0.4])
_STARTS = 20
_SQUEEZE = np.array([12e-3, 12e-3, -6e-3])  # of the pads along the normal [m]
_DAMPING = 5e-3  # [m/rad], below which a joint is no lever


@dataclasses.dataclass(frozen=True)
class Pinch:
    """Start of hand and rod, and closing of the fingers.

    Attributes:
      qpos: (nq,) pads `_GAP` away from the rod.
      joints: (13,) addresses in qpos of JOINTS. actuators: (11,) of the three fingers.
      opened, closed: (11,) controls: as in qpos, and with pads that want to be in the rod.
      axis, normal: (3,) of the rod; from the thumb to the fingers.
      centre: (3,) of the rod [m].
      pads: (11, 6) changes of the controls that move the pads of the two fingers and the thumb across the
        rod (three columns) and towards it (three) by a metre.
    """

    qpos: np.ndarray
    joints: np.ndarray
    actuators: np.ndarray
    opened: np.ndarray
    closed: np.ndarray
    axis: np.ndarray
    normal: np.ndarray
    centre: np.ndarray
    pads: np.ndarray


def build(
    hand: pathlib.Path | str, timestep: float, batch: bool, **settings: object
) -> tuple[mujoco.MjSpec, dict]:
    """The model's spec, and what `attach_to_hand` returns.

    Args:
      hand: Menagerie's shadow_hand/right_hand.xml. timestep: [s].
      batch: for mujoco_warp; else with the engine plugin.
      settings: of `attach_to_hand`.

    Raises:
      FileNotFoundError: there is no such file. ValueError: it is of another hand.
    """
    path = pathlib.Path(hand)
    if not path.is_file():
        raise FileNotFoundError(
            f"no hand {path}: give shadow_hand/right_hand.xml of MuJoCo Menagerie "
            "(https://github.com/google-deepmind/mujoco_menagerie)"
        )
    spec = mujoco.MjSpec.from_file(str(path))
    there = {joint.name.removeprefix("rh_") for joint in spec.joints}
    if missing := set(JOINTS) - there:
        raise ValueError(f"{path} has no joint {min(missing)}: give Menagerie's shadow_hand/right_hand.xml")
    spec.option.timestep, spec.option.integrator = timestep, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.iterations, spec.option.ls_iterations = 30, 20  # single precision: 1e-8 is out of its reach
    spec.option.tolerance = 1e-6
    for body in spec.bodies:
        body.gravcomp = 1.0
    for geom in spec.geoms:  # its links do not meet one another, which saves pairs of meshes
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = 0, 1
    spec.add_texture(  # projected along the rod: stripes show how far it is rolled
        name="rod",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[1, 1, 1],
        rgb2=[0.35, 0.35, 0.35],
        width=128,
        height=128,
    )
    stripes = spec.add_material(name="rod", texrepeat=[3, 3])
    stripes.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "rod"
    body = spec.worldbody.add_body(name="rod", pos=[0, 0, 1])
    body.add_freejoint(name="rod")
    body.add_geom(
        name="rod",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[_RADIUS, _HALF_LENGTH, 0],
        mass=_MASS,
        material="rod",
        rgba=[0.85, 0.45, 0.15, 1],
    )
    return spec, attach_to_hand(spec, "shadow_hand", fingers=FINGERS, batch=batch, **settings)


def find_pinch(model: mujoco.MjModel) -> Pinch:
    """A precision grip: two pads on one side of the rod, the thumb's on the other.

    The servos are soft: pads press by wanting to be `_SQUEEZE` deep in the rod.
    """
    data = mujoco.MjData(model)
    joints = [model.joint(f"rh_{name}") for name in JOINTS]
    address = np.array([joint.qposadr[0] for joint in joints])
    low, high = np.array([joint.range for joint in joints]).T
    core = [model.body(f"biotac_{finger}_core").id for finger in FINGERS]

    def pads(angle):
        data.qpos[address] = angle
        mujoco.mj_kinematics(model, data)
        turn = data.xmat[core].reshape(-1, 3, 3)
        return data.xpos[core] + turn @ _PAD, -turn[:, :, 1]

    def frame(pad):
        axis = pad[0] - pad[1]
        axis = axis / np.linalg.norm(axis)
        across = pad[:2].mean(0) - pad[2]
        normal = across - axis * (axis @ across)
        return axis, normal, axis @ across

    def grip(angle):
        pad, out = pads(angle)
        _, normal, slant = frame(pad)
        width = np.linalg.norm(normal)
        return np.concatenate(
            [
                [400 * (width - 2 * (_RADIUS + _GAP)), 200 * slant],
                (out - normal / width * np.array([-1, -1, 1])[:, None]).ravel(),
                0.5 * (angle - _GUESS),
                coupled(angle),
                0.5 * (angle[1:3] - angle[5:7]),
            ]
        )

    def coupled(angle):  # one tendon bends the last two joints
        return 0.7 * (angle[[2, 6]] - angle[[3, 7]])

    edge = np.where(np.isin(JOINTS, ("FFJ1", "FFJ2", "MFJ1", "MFJ2")), 0.5 * _MARGIN, _MARGIN)
    rng = np.random.default_rng(0)
    starts = _GUESS + 0.3 * rng.standard_normal((_STARTS, len(JOINTS)))
    found = [
        least_squares(
            grip, np.clip(x, low + edge + 1e-3, high - edge - 1e-3), bounds=(low + edge, high - edge)
        )
        for x in starts
    ]
    opened = min(found, key=lambda one: one.cost).x
    pad, out = pads(opened)
    axis, normal, _ = frame(pad)
    normal /= np.linalg.norm(normal)
    centre = 0.5 * (pad[:2].mean(0) + pad[2])
    goal = pad - _SQUEEZE[:, None] * normal

    def press(angle):
        there, facing = pads(angle)
        parts = (
            400 * (there - goal).ravel(),
            0.1 * (facing - out).ravel(),
            0.1 * (angle - opened),
            coupled(angle),
        )
        return np.concatenate(parts)

    closed = least_squares(press, opened, bounds=(low, high)).x
    qpos = model.qpos0.copy()
    qpos[address] = opened
    place = model.joint("rod").qposadr[0]
    qpos[place : place + 3] = centre
    turn = np.stack([np.cross(normal, axis), normal, axis], axis=1)
    mujoco.mju_mat2Quat(qpos[place + 3 : place + 7], turn.ravel())
    actuators = np.array([model.actuator(f"rh_A_{name}").id for name in _ACTUATORS])
    moves = _pad_moves(pads, opened, np.cross(normal, axis), normal, axis)
    controls = _controls(opened), _controls(closed)
    return Pinch(qpos, address, actuators, *controls, axis, normal, centre, moves)


def _pad_moves(pads, angle, across, normal, axis):
    """(11, 6) controls by metre, see `Pinch`. pads: function (13,) -> (3, 3), (3, 3)."""
    h = 1e-5
    columns = [(pads(angle + h * e)[0] - pads(angle - h * e)[0]) / (2 * h) for e in np.eye(len(angle))]
    out, own = np.zeros((13, 6)), (slice(0, 4), slice(4, 8), slice(8, 13))
    for k, joints in enumerate(own):
        # the last two joints of a finger bend together
        bend = np.eye(5) if k == 2 else np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1]])
        lever = np.stack([across, normal, axis]) @ np.array([c[k] for c in columns[joints]]).T @ bend
        inverse = lever.T @ np.linalg.inv(lever @ lever.T + _DAMPING**2 * np.eye(3))
        towards = 1 if k == 2 else -1  # the normal points from the thumb to the fingers
        out[joints, k], out[joints, 3 + k] = bend @ inverse[:, 0], towards * (bend @ inverse[:, 1])
    return np.stack([_controls(column) for column in out.T], axis=1)


def _controls(angle):
    """(11,) of (13,) joint angles: the tendons' are sums."""
    ff, mf, th = angle[:4], angle[4:8], angle[8:]
    return np.array([ff[0], ff[1], ff[2] + ff[3], mf[0], mf[1], mf[2] + mf[3], *th])
