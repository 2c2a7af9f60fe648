"""A BioTac with a ball on its upward pad, in MuJoCo's viewer or as a picture. The plugin draws skin and
electrodes."""

import functools
import os
import pathlib
import sys
import time
from collections.abc import Sequence

import mujoco
import numpy as np

from .. import plugin
from ..coupling.handle import Handle
from ..coupling.show import OBJECT, PAD_UP
from ..files import picture_kind, replacing
from ..geometry.rigid import matrix
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.skins import place_of
from ..press import approach
from ..press.scene import see_through
from ..reading import reading
from .offscreen import frame_bodies, show_bodies, stage

_RADIUS, _MASS = 5e-3, 0.1  # of the ball [m], [kg]: 1 N on the pad
_BALL = "biotac_ball"  # in a hand's model, which may have a ball of its own
_EYE = -0.8, -0.6, 0.4  # direction of the camera in the BioTac frame
_PUSH = 0.5  # force [N] of the ball on the pad of a hand's finger
_SPRINGS = 50.0, 10.0, 50.0  # [N/m] of its slides: soft onto the pad, which may give way by some 10 mm


def build_scene(
    skin: str | pathlib.Path | SkinGeometry = "default", **attach_options: object
) -> tuple[mujoco.MjSpec, Handle]:
    """A fixed BioTac and a ball above its pad with three translational joints and weak springs, which keep it
    over the pad.

    Args:
      skin: name, file or SkinGeometry.
      attach_options: see `biotac_mj.attach`.

    Returns:
      Spec, and the handle of `biotac_mj.attach`.
    """
    from ..coupling import attach
    from ..geometry import SkinGeometry, load_skin

    geometry = skin if isinstance(skin, SkinGeometry) else load_skin(skin)
    top, _ = approach.surface_point(geometry, *place_of(geometry))
    spec = mujoco.MjSpec()
    spec.option.timestep = 4e-3
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    stage(spec)
    spec.stat.center, spec.stat.extent = [-0.008, 0, 0.004], 0.03
    ball = spec.worldbody.add_body(name="ball", pos=[top[0], -top[2], -top[1] + _RADIUS + 2e-4])
    ball.mass, ball.inertia, ball.explicitinertial = _MASS, [1e-6] * 3, True
    _add_slides(ball, (20.0, 20.0, 0.0))
    ball.add_geom(
        name="ball",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[_RADIUS, 0, 0],
        contype=0,
        conaffinity=0,
        rgba=[*OBJECT, 0.35],
    )
    handle = attach(spec, body="world", quat=PAD_UP, skin=skin, geoms=["ball"], **attach_options)
    see_through(spec, handle)
    return spec, handle


def _add_slides(ball, stiffness):
    """Three slides of a ball, sprung [N/m]."""
    for name, axis, k in zip("xyz", np.eye(3), stiffness):
        joint = ball.add_joint(name=f"{ball.name}_{name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        joint.stiffness[0], joint.damping[0] = k, 0.5


def build_hand(
    path: pathlib.Path | str,
    skin: str | pathlib.Path | SkinGeometry = "coarse",
    mount: pathlib.Path | str | None = None,
    **attach_options: object,
) -> tuple[mujoco.MjSpec, dict]:
    """A hand with BioTacs, and a ball that springs press against the pad of the first.

    Args:
      path: MJCF of a hand in `HANDS`, or of the hand of `mount`, a file of `biotac hand mount`.
      skin: name, file or SkinGeometry; attach_options: see `biotac_mj.attach`.

    Returns:
      Spec, and {finger: handle} of `biotac_mj.attach_to_hand`.

    Raises:
      FileNotFoundError: no such file.
      ValueError: it is no hand, or an unknown one.
    """
    from ..geometry import load_skin
    from ..tasks.hands import HANDS, attach_to_hand, known_hand
    from ..tasks.mounts import read_mounts

    with reading(path, "hand", "give the MJCF of one, MuJoCo Menagerie's shadow_hand/right_hand.xml say"):
        spec = mujoco.MjSpec.from_file(str(path))
    known = None if mount else known_hand(spec)
    if not mount and not known:
        raise ValueError(
            f"{path} is none of the hands that are known ({', '.join(HANDS)}): find its mounts with "
            "`biotac hand mount`, and give their file, --mount FILE"
        )
    mounts = read_mounts(mount) if mount else HANDS[known]
    spec.option.timestep, spec.option.integrator = 4e-3, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    stage(spec)
    show_bodies(spec)
    geometry = skin if isinstance(skin, SkinGeometry) else load_skin(skin)
    ball = _ball_before(spec, next(iter(mounts.values())), geometry)
    ball.add_geom(name=_BALL, size=[_RADIUS, 0, 0], mass=_MASS, rgba=[*OBJECT, 1])
    return spec, attach_to_hand(spec, mounts, skin=skin, **attach_options)


def _ball_before(spec, mount, geometry):
    """Adds a body without gravity, which springs press against the pad of a mounted BioTac."""
    from ..tasks.hands import find_link

    model = spec.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    link = data.body(find_link(spec, mount.body).name)
    place, _ = approach.surface_point(geometry, *place_of(geometry))
    pos, quat = np.zeros(3), np.zeros(4)
    mujoco.mju_mulQuat(quat, link.xquat, mount.quat)
    mujoco.mju_rotVecQuat(pos, place - [0, _RADIUS + 2e-4, 0], quat)
    pos += link.xpos + link.xmat.reshape(3, 3) @ mount.pos
    ball = spec.worldbody.add_body(name=_BALL, pos=pos, quat=quat, gravcomp=1)
    _add_slides(ball, _SPRINGS)
    spec.joint(f"{_BALL}_y").springref = _PUSH / _SPRINGS[1]
    return ball


def view(
    skin: str | pathlib.Path | SkinGeometry = "default",
    tier: str = "full",
    render: pathlib.Path | str | None = None,
    seconds: float = 0.3,
    hand: pathlib.Path | str | None = None,
    mount: pathlib.Path | str | None = None,
    web: bool = False,
    recording: pathlib.Path | str | Sequence | None = None,
    port: int = 8080,
    **attach_options: object,
) -> object:
    """Opens the viewer and steps in real time, if the machine is fast enough; or renders; or serves a page.

    Args:
      skin, tier, attach_options: see `biotac_mj.attach`.
      render: path of a picture to write after `seconds` [s] instead.
      hand, mount: files of a hand to show instead of one BioTac, with the condensed tier, and of its mounts
        if it is unknown; see `build_hand`.
      web: serve a page in the browser (`web`) at `port`: of a press, whose depth and location sliders set; of
        the simulation of a hand; or of the file `recording`, or several files side by side.

    Raises:
      ValueError: no display for a window, or no GL library to render with.
    """
    from ..skin.settings import read_dict

    if mount and not hand:
        raise ValueError(f"--mount {mount} is of a hand: give its model too, --hand FILE")
    if render is not None and web:
        raise ValueError(f"web serves a page and render={render} writes a picture: choose one of them")
    if recording and not web:
        raise ValueError("a recording is shown in the browser: add web=True")
    if web and not recording and hand is None:
        from .web_play import play_press

        return play_press(dict(skin=skin, tier=tier, **attach_options), port=port)
    if recording:
        from .web_play import play_file

        one = isinstance(recording, (str, os.PathLike))
        return play_file(*[recording] if one else recording, port=port)
    if render is not None:
        picture_kind(render)  # check before the work
    linux = sys.platform.startswith("linux")
    if (
        render is None
        and not web
        and linux
        and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    ):
        raise ValueError(
            "no display to open a window on: use `biotac view --render FILE.png` or `biotac play`, or set "
            "DISPLAY"
        )
    attach_options["options"] = read_dict(attach_options.get("options"), "options")
    if hand is None:
        spec, handle = build_scene(skin, tier=tier, **attach_options)
        handles, point_camera = {"biotac": handle}, lambda model, data, camera: _point_camera(camera)
    else:
        spec, handles = build_hand(hand, mount=mount, tier="condensed", **attach_options)
        point_camera = functools.partial(_point_at_hand, spec, handles)
    model = spec.compile()
    data = mujoco.MjData(model)
    if render is not None:
        return _render(model, data, render, seconds, point_camera)
    mujoco.mj_forward(model, data)
    if web:
        from .web_play import play_model

        point_camera(model, data, camera := mujoco.MjvCamera())
        return play_model(model, data, handles, camera, port=port)
    from mujoco import viewer

    with viewer.launch_passive(model, data) as window:
        point_camera(model, data, window.cam)
        while window.is_running():
            begin = time.perf_counter()
            mujoco.mj_step(model, data)
            plugin.check()
            window.sync()
            time.sleep(max(0.0, model.opt.timestep - (time.perf_counter() - begin)))


def _point_camera(camera):
    """Points the camera at the pad, from the side and above."""
    camera.lookat[:] = [-0.008, 0, 0.004]
    camera.distance, camera.azimuth, camera.elevation = 0.05, 60, -25


def _point_at_hand(spec, handles, model, data, camera):
    """Frames the subtree of the last common ancestor of the links with BioTacs, and the ball."""
    from ..tasks.mounting import side_view

    ball = spec.body(_BALL)
    look = side_view(ball.pos, matrix(ball.quat), _EYE)
    camera.azimuth, camera.elevation = look.azimuth, look.elevation
    chains = [_ancestors(model, model.body(handle.body).id) for handle in handles.values()]
    common = set.intersection(*map(set, chains))
    # bodies come after their parents; fingers on the world body have no common ancestor
    tops = {max(common)} if common else {chain[-1] for chain in chains}
    framed = [b for b in range(model.nbody) if tops.intersection(_ancestors(model, b))]
    framed.append(model.body(_BALL).id)
    frame_bodies(model, data, framed, camera)


def _ancestors(model, body):
    """A body and its ancestors, without the world."""
    out = []
    while body:
        out.append(body)
        body = model.body_parentid[body]
    return out


def _render(model, data, path, seconds, point_camera):
    from matplotlib.image import imsave

    from .offscreen import Offscreen, find_gl

    with Offscreen(model, 1000, 750, find_gl()) as screen:
        while data.time < seconds:
            mujoco.mj_step(model, data)
            plugin.check()
        camera = mujoco.MjvCamera()
        point_camera(model, data, camera)
        picture = screen.render(data, camera)
    with replacing(path) as temporary:
        imsave(temporary, picture, format=picture_kind(path))
    print(f"  wrote {path}: {data.time:.2f} s after the ball was let go")
