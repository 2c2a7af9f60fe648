"""Bags of a simulated press, as a driver of the real sensor fills them: read back they are its sensordata."""

import numpy as np
import pytest

from biotac_mj import cli
from biotac_mj.press import PressOptions, press
from biotac_mj.press.record import write_skin
from biotac_mj.recordings import load
from biotac_mj.recordings.formats.bags import FORMS, write_bag
from biotac_mj.recordings.verbs import _FORMS
from biotac_mj.sensor.channels import CHANNELS


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    record, _ = press(PressOptions(skin="coarse", tier="condensed", depth=3e-4), progress=False)
    path = tmp_path_factory.mktemp("press") / "skin.h5"
    write_skin(record, path)
    return record, path


def agree(one, record):
    np.testing.assert_array_equal(one.electrodes, record.counts[:, :19])
    others = [getattr(one, name) for name in CHANNELS[19:]]
    others = [value[:, -1] if value.ndim == 2 else value for value in others]
    np.testing.assert_array_equal(np.stack(others, axis=1), record.counts[:, 19:])
    np.testing.assert_array_equal(one.pac, record.pac)
    np.testing.assert_allclose(one.time, record.time, atol=1e-9)


def test_a_press_is_a_recording(pressed):
    record, path = pressed
    (one,) = load(path)
    agree(one, record)
    assert one.object == "sphere_7mm" and "simulated" in one.source
    np.testing.assert_array_equal(one.force, record.force)
    np.testing.assert_array_equal(one.object_pos, record.indenter_pos)
    assert np.ptp(record.pac) > 2 and np.ptp(record.counts[:, :19], axis=0).max() > 20


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("ros", [1, 2])
def test_a_bag_read_back_is_the_sensordata(pressed, tmp_path, capsys, ros, form):
    pytest.importorskip("rosbags", reason="needs rosbags: pip install 'biotac-mj[ros]'")
    record, path = pressed
    out = tmp_path / ("press.bag" if ros == 1 else "press")
    words = ["export", str(path), f"--ros{ros}", str(out), "--form", form]
    assert cli.main(words) == 0 and f"{len(record.time)} rows on /" in capsys.readouterr().out
    (one,) = load(out)
    agree(one, record)
    np.testing.assert_array_equal(one.force, record.force)
    np.testing.assert_array_equal(one.object_pos, record.indenter_pos)
    np.testing.assert_allclose(one.object_quat, record.indenter_quat, atol=1e-15)
    if ros == 1:  # a file is written anew, a folder is left
        assert cli.main(words) == 0
    else:
        with pytest.raises(ValueError, match="press is there already: a bag of ROS 2 is a new folder"):
            write_bag(out, one, 2)


def test_what_cannot_be_exported_is_said(tmp_path, capsys, monkeypatch, pressed):
    pytest.importorskip("rosbags", reason="needs rosbags: pip install 'biotac-mj[ros]'")
    rows = np.full((500, 19), 3000) + np.arange(500)[:, None] % 5
    np.savetxt(tmp_path / "e.txt", rows, "%d")
    assert cli.main(["export", str(tmp_path / "e.txt"), "--ros1", str(tmp_path / "o.bag")]) == 2
    assert "has no raw counts of pac, pdc, tac, tdc in every row" in capsys.readouterr().err


def test_the_library_that_is_needed_is_named(pressed, tmp_path, capsys, monkeypatch):
    import sys

    for name in ("rosbags", "rosbags.rosbag1"):
        monkeypatch.setitem(sys.modules, name, None)
    assert cli.main(["export", str(pressed[1]), "--ros2", str(tmp_path / "o")]) == 2
    assert "it needs pip install 'biotac-mj[ros]'" in capsys.readouterr().err
    assert FORMS == _FORMS
