"""The sensor as a folder for MuJoCo Menagerie: python scripts/make_menagerie.py [--out out/menagerie]

Plain MJCF that needs nothing of this package: core, nail, clamp and skin as they are at rest, one rigid body.
What a Menagerie folder has (model, scene, LICENSE, README, CHANGELOG, picture) and how its XML is written is
what that project's `make all` checks; `tests/test_menagerie.py` checks the same. Menagerie wants an issue
before a pull request.
"""

import argparse
import importlib.resources
import pathlib
import shutil

import mujoco
import numpy as np

from biotac_mj import __version__
from biotac_mj.geometry import load_skin
from biotac_mj.sensor.channels import ELECTRODES
from biotac_mj.skin.rubber.material import PRESETS
from biotac_mj.view.offscreen import Offscreen, find_gl, stage

NAME = "syntouch_biotac"
_ROOT = pathlib.Path(__file__).resolve().parents[1]
_RELEASED = "2026-11-25"

_MODEL = """<mujoco model="biotac">
  <compiler meshdir="assets"/>

  <default>
    <default class="biotac">
      <default class="visual">
        <geom type="mesh" group="2" contype="0" conaffinity="0" mass="0"/>
      </default>
      <default class="collision">
        <geom type="mesh" group="3" mass="0" friction="{friction}" condim="4"/>
      </default>
      <default class="electrode">
        <site type="sphere" size="0.0004" rgba="0.85 0.85 0.85 1" group="4"/>
      </default>
    </default>
  </default>

  <asset>
    <mesh class="biotac" file="skin.obj"/>
    <mesh class="biotac" file="core.obj"/>
    <mesh class="biotac" file="nail.obj"/>
    <mesh class="biotac" file="clamp.obj"/>
  </asset>

  <worldbody>
    <body name="biotac" childclass="biotac">
      <inertial pos="{pos}" mass="{mass}" fullinertia="{inertia}"/>
      <geom name="skin_visual" class="visual" mesh="skin" rgba="0.25 0.6 0.4 1"/>
      <geom name="core_visual" class="visual" mesh="core" rgba="0.25 0.25 0.28 1"/>
      <geom name="nail_visual" class="visual" mesh="nail" rgba="0.75 0.75 0.78 1"/>
      <geom name="clamp_visual" class="visual" mesh="clamp" rgba="0.75 0.75 0.78 1"/>
      <geom name="skin_collision" class="collision" mesh="skin"/>
      <geom name="clamp_collision" class="collision" mesh="clamp"/>
{electrodes}
    </body>
  </worldbody>
</mujoco>
"""

_SCENE = """<mujoco model="biotac scene">
  <include file="biotac.xml"/>

  <statistic center="-0.008 0 0" extent="0.05"/>

  <visual>
    <headlight diffuse="0.6 0.6 0.6" ambient="0.3 0.3 0.3" specular="0 0 0"/>
    <rgba haze="0.15 0.25 0.35 1"/>
    <global azimuth="120" elevation="-20"/>
  </visual>

  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.3 0.5 0.7" rgb2="0 0 0" width="512" height="3072"/>
    <texture type="2d" name="groundplane" builtin="checker" mark="edge" rgb1="0.2 0.3 0.4" rgb2="0.1 0.2 0.3"
      markrgb="0.8 0.8 0.8" width="300" height="300"/>
    <material name="groundplane" texture="groundplane" texuniform="true" texrepeat="5 5" reflectance="0.2"/>
  </asset>

  <worldbody>
    <light pos="0 0 1" dir="0 0 -1" directional="true"/>
    <geom name="floor" size="0 0 0.05" pos="0 0 -0.03" type="plane" material="groundplane"/>
    <body name="ball" pos="-0.01 0 0.03">
      <freejoint/>
      <geom name="ball" size="0.005" mass="0.01" rgba="0.85 0.45 0.15 1"/>
    </body>
  </worldbody>
</mujoco>
"""

_README = """# SynTouch BioTac Description (MJCF)

## Changelog

See [CHANGELOG.md](./CHANGELOG.md) for a full history of changes.

## Overview

This package contains a simplified description (MJCF) of the SynTouch BioTac, a tactile fingertip: rubber skin
around a rigid core, with liquid between them and 19 electrodes on the core.

<p float="left">
  <img src="biotac.png" width="400">
</p>

**The skin is rigid here.** This is what plain MJCF can say of the sensor: shape, mass, contact, and where the
electrodes sit. A skin that deforms, the liquid and what the electrodes read are simulated by
biotac_mj, the library that this model is from.

The fingertip points along -x, the pad looks along -y, the nail along +y; the plate at +x is what holds it.

## How it was made

1. The surfaces are parametric, made from published dimensions; they are no scan of a sensor. `skin.obj` is
   the outer surface of the skin at rest.
2. Electrodes (sites `e1` to `e19`) are where Lin, Fishel and Loeb (2013) have them.
3. Mass (3.965 g) and inertia are integrated over the geometry, with densities of silicone, resin and water.
4. The skin collides as its convex hull. Its friction is that of the rubber in "Sim-to-Real for Robotic
   Tactile Sensing via Physics-Based Simulation and Learned Latent Projections" (Narang et al., ICRA 2021).

## License

This model is released under an [Apache-2.0 License](LICENSE).
"""

_CHANGELOG = f"""# Changelog – SynTouch BioTac Description

All notable changes to this model will be documented in this file.

## [{_RELEASED}]
- Initial release, from biotac_mj {__version__}.
"""


def write_folder(out: pathlib.Path) -> pathlib.Path:
    """Writes out/syntouch_biotac and returns it; without a picture where no GL library works."""
    folder = pathlib.Path(out) / NAME
    (folder / "assets").mkdir(parents=True, exist_ok=True)
    with importlib.resources.as_file(importlib.resources.files("biotac_mj")) as package:
        spec = mujoco.MjSpec.from_file(str(package / "mjcf" / "biotac.xml"))
        for part in ("core", "nail", "clamp"):
            shutil.copy(package / "assets" / f"{part}.obj", folder / "assets")
    _write_skin(folder / "assets" / "skin.obj")
    core = spec.body("core")
    sites = [
        f'      <site name="{s.name}" class="electrode" pos="{_text(s.pos)}"/>'
        for s in core.sites
        if s.name in ELECTRODES
    ]
    model = _MODEL.format(
        friction=_text([PRESETS["default"].friction]),
        pos=_text(core.ipos),
        mass=_text([core.mass]),
        inertia=_text(core.fullinertia),
        electrodes="\n".join(sites),
    )
    files = {"biotac.xml": model, "scene.xml": _SCENE, "README.md": _README, "CHANGELOG.md": _CHANGELOG}
    for name, text in files.items():
        (folder / name).write_text(text)
    shutil.copy(_ROOT / "LICENSE", folder)
    _draw(folder)
    return folder


def _text(numbers):
    return " ".join(f"{x:.4g}" for x in np.ravel(numbers) + 0.0)


def _write_skin(path):
    """The outer surface of the coarse skin at rest, as OBJ [m]."""
    skin = load_skin("coarse")
    node, face = np.unique(skin.outer_face, return_inverse=True)
    lines = [f"v {_text(v)}" for v in skin.vert[node]]
    lines += ["f {} {} {}".format(*f) for f in face.reshape(-1, 3) + 1]
    path.write_text("\n".join(lines) + "\n")


def _draw(folder):
    gl = find_gl()
    if gl is None:
        return print("biotac.png left out: no GL library works here")
    from matplotlib.image import imsave

    spec = mujoco.MjSpec.from_file(str(folder / "biotac.xml"))
    stage(spec)
    spec.geom("skin_visual").rgba[3] = 0.35  # the electrodes are under it
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (-0.007, 0, 0), 0.045, 55, 20
    option.sitegroup[4] = 1
    with Offscreen(model, 640, 480, gl) as screen:
        imsave(folder / "biotac.png", screen.render(data, camera, option))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/menagerie"))
    print(write_folder(parser.parse_args().out))
