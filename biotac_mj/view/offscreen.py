"""Pictures without a window, by MuJoCo's renderer with any working GL library.

`mujoco.Renderer` uses the library that MUJOCO_GL names when mujoco is imported. Here the library is searched
when it is needed, and first tested in another process, since a broken one may crash the process."""

import contextlib
import functools
import importlib
import os
import subprocess
import sys
from collections.abc import Sequence

import mujoco
import numpy as np

_MARGIN = 1.1  # size of the picture over that of the framed geoms
SHOWN = 3  # MuJoCo draws geom groups below this by default

_PROBE = """
import importlib, os, sys
os.environ["MUJOCO_GL"] = "disable"
import mujoco
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 100).free()
context.free()
"""


@functools.cache
def _works(gl):
    environ = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    try:
        return (
            subprocess.run(
                [sys.executable, "-c", _PROBE, gl], env=environ, capture_output=True, timeout=60
            ).returncode
            == 0
        )
    except (OSError, subprocess.TimeoutExpired):
        return False


def find_gl() -> str | None:
    """The GL library to render with: "egl", "osmesa" or "cgl"; None without any.

    MUJOCO_GL=egl and MUJOCO_GL=osmesa allow only that one, MUJOCO_GL=disable none; otherwise the libraries of
    the system are tried."""
    wanted_library = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted_library in ("disable", "disabled", "off", "false", "0"):
        return None
    candidates = (
        [wanted_library]
        if wanted_library in ("egl", "osmesa")
        else ["cgl"]
        if sys.platform == "darwin"
        else ["egl", "osmesa"]
    )
    return next((gl for gl in candidates if _works(gl)), None)


def _take_platform(gl):
    """Sets PyOpenGL's platform, which its first import chooses (dm_control's viewer takes GLX, for example,
    with which EGL finds no display). MuJoCo's functions are bound at their first call, so this comes
    before."""
    os.environ["PYOPENGL_PLATFORM"] = gl
    loaded = sys.modules.get("OpenGL.platform")
    if loaded and gl != "cgl" and type(loaded.PLATFORM).__module__ != f"OpenGL.platform.{gl}":
        loaded._load()


class Offscreen:
    """A GL context and a scene of one model; a context manager.

    Args:
      model: its `vis.global_.offwidth` and `offheight` limit the picture, and are increased if necessary.
      width, height: of the picture [pixel].
      gl: result of `find_gl`.

    Raises:
      ValueError: gl is None, or no picture of that size can be drawn.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, gl: str | None):
        if gl is None:
            raise ValueError(
                "no GL library to render with: install libosmesa6 or libegl1, or unset MUJOCO_GL"
            )
        model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
        model.vis.global_.offheight = max(height, model.vis.global_.offheight)
        self.model, self.rect = model, mujoco.MjrRect(0, 0, width, height)
        _take_platform(gl)
        with contextlib.ExitStack() as stack:
            self._context = importlib.import_module(f"mujoco.{gl}").GLContext(width, height)
            stack.callback(self._context.free)
            self._context.make_current()
            try:
                self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
            except mujoco.FatalError as error:
                raise ValueError(
                    f"no picture of {width} x {height} pixels can be drawn here ({error}): ask for a "
                    "smaller one"
                ) from None
            stack.callback(self._mjr.free)
            self._stack = stack.pop_all()
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        self._scene = mujoco.MjvScene(model, maxgeom=5000)

    def __enter__(self):
        return self

    def __exit__(self, *exc_info):
        self.close()

    def close(self) -> None:
        """Frees the context; further calls do nothing."""
        self._stack.close()

    def render(
        self, data: mujoco.MjData, camera: mujoco.MjvCamera, option: mujoco.MjvOption | None = None
    ) -> np.ndarray:
        """Draws the model with data, including the geoms of plugins; returns (height, width, 3) uint8."""
        self._context.make_current()
        option = option or mujoco.MjvOption()
        mujoco.mjv_updateScene(
            self.model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        mujoco.mjr_render(self.rect, self._scene, self._mjr)
        pixels = np.empty((self.rect.height, self.rect.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, self.rect, self._mjr)
        return pixels[::-1]


def stage(spec: mujoco.MjSpec) -> None:
    """Sets the scene of all pictures: light from the camera, a white background, and a small near plane."""
    spec.stat.extent, spec.visual.map.znear = 0.2, 0.02
    spec.visual.headlight.ambient[:], spec.visual.headlight.diffuse[:] = 0.5, 0.6
    for texture in [t for t in spec.textures if t.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX]:
        spec.delete(texture)
    flat = dict(type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT)
    spec.add_texture(name="biotac_sky", width=8, height=48, rgb1=[1, 1, 1], rgb2=[1, 1, 1], **flat)


def show_bodies(spec: mujoco.MjSpec) -> None:
    """Shows all bodies of a model, also those with collision geoms only, without sites (which are as large as
    the volume of a touch sensor) and tendons."""
    for body in spec.bodies:
        if all(geom.group >= SHOWN for geom in body.geoms):
            for geom in body.geoms:
                geom.group = 0
    for other in (*spec.sites, *spec.tendons):
        other.group = mujoco.mjNGROUP - 1


def directions(camera: mujoco.MjvCamera) -> tuple[np.ndarray, np.ndarray]:
    """Where a free camera looks and what it shows upwards: unit vectors (3,) in the world."""
    turn, lift = np.radians([camera.azimuth, camera.elevation])
    away = np.array([np.cos(turn), np.sin(turn), 0.0])
    above = np.array([0.0, 0.0, 1.0])
    return np.cos(lift) * away + np.sin(lift) * above, np.cos(lift) * above - np.sin(lift) * away


def frame_bodies(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    bodies: Sequence[int],
    camera: mujoco.MjvCamera,
    aspect: float = 4 / 3,
) -> None:
    """Moves a free camera, without turning it, so that the geoms of some bodies fill the picture.

    Args:
      bodies: their ids. camera: its azimuth and elevation [deg] are kept.
      aspect: width of the picture over its height.
    """
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies) & (model.geom_group < SHOWN))
    forward, up = directions(camera)
    axes = np.array([np.cross(forward, up), up, forward])
    corners = np.array([np.ravel(c) for c in np.meshgrid(*3 * [[-1.0, 1.0]])]).T
    local = model.geom_aabb[geoms, None, :3] + corners * model.geom_aabb[geoms, None, 3:]
    turned = np.einsum("gij,gcj->gci", data.geom_xmat[geoms].reshape(-1, 3, 3), local)
    seen = (data.geom_xpos[geoms, None] + turned).reshape(-1, 3) @ axes.T
    center = (seen.min(0) + seen.max(0)) / 2
    half = np.tan(np.radians(model.vis.global_.fovy) / 2)
    off = np.abs(seen - center)
    far = np.maximum(off[:, 0] / (half * aspect), off[:, 1] / half) - (seen - center)[:, 2]
    camera.lookat[:], camera.distance = center @ axes, _MARGIN * far.max()
