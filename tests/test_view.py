"""View: the scene carries a ball's weight, is rendered with coloured electrodes, and is stepped while its
window is open."""

import contextlib
import os
import subprocess
import sys
import types

import mujoco
import numpy as np
import pytest
from blocks import four_nodes
from matplotlib.image import imread

from biotac_mj.coupling.show import PAD_UP
from biotac_mj.view import offscreen, window


def test_render_shows_ball_and_electrodes(tmp_path, capsys):
    if offscreen.find_gl() is None:
        with pytest.raises(ValueError, match="no GL library to render with"):
            window.view(skin="coarse", render=tmp_path / "view.png")
        return
    window.view(skin=four_nodes("coarse"), render=tmp_path / "view.png", seconds=0.1)
    assert "wrote" in capsys.readouterr().out
    image = imread(tmp_path / "view.png")[..., :3]
    red, green, blue = np.moveaxis(image, -1, 0)
    assert ((red > 1.3 * green) & (red > 1.6 * blue)).mean() > 0.02  # the ball
    assert ((green > 1.1 * red) & (green > 1.1 * blue)).mean() > 0.1  # the skin


def test_any_hand_is_shown_with_a_ball_on_its_first_finger(tmp_path, capsys):
    """By its mounts, or by its name; the springs' half newton is felt."""
    from test_hands import mounts, small_hand, springs

    from biotac_mj import cli
    from biotac_mj.tasks.mounts import write_mounts

    hand, mount = tmp_path / "hand.xml", tmp_path / "mount.yaml"
    hand.write_text(small_hand().to_xml())
    write_mounts(mount, mounts())
    assert cli.main(["play", "--hand", str(hand)]) == 2
    assert "known (shadow_hand, " in (said := capsys.readouterr().err) and "--mount FILE" in said
    assert cli.main(["play", "--mount", str(mount)]) == 2
    assert "is of a hand: give its model too, --hand FILE" in capsys.readouterr().err
    spec, handles = window.build_hand(hand, mount=mount, **springs())
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.joint("biotac_ball_y").qfrc_passive[0] == pytest.approx(0.5)
    push = []
    for _ in range(20):
        for joint in ("aJ1", "aJ2"):  # the finger has no motors
            data.joint(joint).qpos[:], data.joint(joint).qvel[:] = 0, 0
        mujoco.mj_step(model, data)
        push.append([handle.read(data, "contact_force")[1] for handle in handles.values()])
    one, other = np.array(push).T
    assert 0.3 < one[5:].mean() < 0.8 and not other.any()


@pytest.mark.parametrize("azimuth, elevation", [(150, -35), (20, 10)])
def test_what_is_framed_fills_the_picture(azimuth, elevation):
    """Nothing of it reaches the border; another body may."""
    if (gl := offscreen.find_gl()) is None:
        pytest.skip("no GL library to render with")
    spec = mujoco.MjSpec()
    offscreen.stage(spec)
    for k, (size, pos) in enumerate((((0.02, 0.1, 0.05), (0.1, 0, 0)), ((0.06, 0.02, 0.01), (0, 0.2, 0.1)))):
        body = spec.worldbody.add_body(name=f"b{k}", pos=pos)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, rgba=[0, 0, 0, 1])
    spec.worldbody.add_body(name="far").add_geom(size=[0.01, 0, 0], pos=[0, 0, -3], rgba=[1, 1, 1, 1])
    model = spec.compile()
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    mujoco.mj_forward(model, data)
    camera.azimuth, camera.elevation = azimuth, elevation
    offscreen.frame_bodies(model, data, [model.body("b0").id, model.body("b1").id], camera)
    with offscreen.Offscreen(model, 400, 300, gl) as screen:
        dark = screen.render(data, camera).max(-1) < 60
    assert not np.concatenate([dark[0], dark[-1], dark[:, 0], dark[:, -1]]).any()
    rows, columns = np.flatnonzero(dark.any(1)), np.flatnonzero(dark.any(0))
    assert max(np.ptp(rows) / 300, np.ptp(columns) / 400) > 0.75


def test_fingers_that_hang_on_the_world_are_framed_together():
    spec, handles = mujoco.MjSpec(), {}
    for name, x in (("a", -0.05), ("b", 0.05)):
        finger = spec.worldbody.add_body(name=name, pos=[x, 0, 0])
        finger.add_geom(size=[0.01, 0, 0])
        handles[name] = types.SimpleNamespace(body=name)
    ball = spec.worldbody.add_body(name="biotac_ball")
    ball.add_geom(size=[0.005, 0, 0])
    for _ in range(3):
        ball.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE)
    model = spec.compile()
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    mujoco.mj_forward(model, data)
    window._point_at_hand(spec, handles, model, data, camera)
    assert np.allclose(camera.lookat, 0, atol=0.01) and 0.1 < camera.distance < 0.5


_AFTER_ANOTHER = """
import OpenGL.GL  # as dm_control's viewer does; its platform is GLX's from here on
import mujoco
from biotac_mj.view.offscreen import Offscreen, find_gl
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
for _ in range(2):
    with Offscreen(model, 64, 48, find_gl()) as screen:
        assert screen.render(data, mujoco.MjvCamera()).std() > 1
"""


def test_pictures_where_somebody_else_chose_opengls_platform():
    if offscreen.find_gl() is None:
        pytest.skip("no GL library to render with: install libosmesa6 or libegl1")
    environ = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    command = [sys.executable, "-c", _AFTER_ANOTHER]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def test_window_is_stepped_until_it_is_closed(monkeypatch):
    from mujoco import viewer

    seen = {}

    class Window:
        left = 300
        cam = mujoco.MjvCamera()

        def is_running(self):
            self.left -= 1
            return self.left >= 0

        def sync(self):
            seen["syncs"] = seen.get("syncs", 0) + 1

    @contextlib.contextmanager
    def launch_passive(model, data):
        seen.update(model=model, data=data)
        yield Window()

    monkeypatch.setattr(viewer, "launch_passive", launch_passive)
    monkeypatch.setenv("DISPLAY", ":0")
    window.view(skin=four_nodes("coarse"))
    data = seen["data"]
    assert (
        np.linalg.norm(Window.cam.lookat) < 0.02 and Window.cam.distance < 0.1
    )  # looks at the fingertip, not past it
    assert seen["syncs"] == 300 and data.time == pytest.approx(300 * 4e-3)
    # the ball of 100 g has come to rest: the pad, up here, carries it
    assert np.abs(data.qvel).max() < 1e-3
    force = np.empty(3)
    mujoco.mju_rotVecQuat(force, data.sensor("biotac_contact_force").data[:3], PAD_UP)
    assert force[2] == pytest.approx(-0.1 * 9.81, rel=0.01)
