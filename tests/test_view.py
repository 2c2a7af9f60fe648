"""View: the scene carries a ball's weight, is rendered with coloured electrodes, and is stepped while its
window is open."""

import contextlib

import mujoco
import numpy as np
import pytest
from matplotlib.image import imread

from biotac_mj.coupling.show import PAD_UP
from biotac_mj.view import offscreen, window


def test_render_shows_ball_and_electrodes(tmp_path, capsys):
    if offscreen.find_gl() is None:
        with pytest.raises(ValueError, match="no GL library to render with"):
            window.view(skin="coarse", render=tmp_path / "view.png")
        return
    window.view(skin="coarse", render=tmp_path / "view.png", seconds=0.1)
    assert "wrote" in capsys.readouterr().out
    image = imread(tmp_path / "view.png")[..., :3]
    red, green, blue = np.moveaxis(image, -1, 0)
    assert ((red > 1.3 * green) & (red > 1.6 * blue)).mean() > 0.02  # the ball
    assert ((green > 1.1 * red) & (green > 1.1 * blue)).mean() > 0.1  # the skin


def test_window_is_stepped_until_it_is_closed(monkeypatch):
    from mujoco import viewer

    seen = {}

    class Window:
        left = 75
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
    window.view(skin="coarse")
    data = seen["data"]
    assert (
        np.linalg.norm(Window.cam.lookat) < 0.02 and Window.cam.distance < 0.1
    )  # looks at the fingertip, not past it
    assert seen["syncs"] == 75 and data.time == pytest.approx(75 * 4e-3)
    # the ball of 100 g has come to rest: the pad, up here, carries it
    assert np.abs(data.qvel).max() < 1e-3
    force = np.empty(3)
    mujoco.mju_rotVecQuat(force, data.sensor("biotac_contact_force").data[:3], PAD_UP)
    assert force[2] == pytest.approx(-0.1 * 9.81, rel=0.01)
