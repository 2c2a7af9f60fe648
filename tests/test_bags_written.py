"""Bags of a simulated press, as a driver of the real sensor fills them: read back they are its sensordata."""

import numpy as np
import pytest

from biotac_mj import cli
from biotac_mj.press import PressOptions, press
from biotac_mj.press.record import write_skin
from biotac_mj.recordings import load, of_simulation, write_bag
from biotac_mj.recordings.formats.bags import FORMS
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
    words = ["recording", "export", str(path), f"--ros{ros}", str(out), "--form", form]
    assert cli.main(words) == 0 and f"{len(record.time)} rows on /" in capsys.readouterr().out
    (one,) = load(out)
    agree(one, record)
    np.testing.assert_array_equal(one.force, record.force)
    np.testing.assert_array_equal(one.object_pos, record.indenter_pos)
    np.testing.assert_allclose(one.object_quat, record.indenter_quat, atol=1e-15)
    with pytest.raises(SystemExit):  # what is there may be a sensor's own
        cli.main(words)
    assert f"{out} is there already: give a new name" in capsys.readouterr().err
    with pytest.raises(ValueError, match="press(.bag)? is there already: give a new name"):
        write_bag(out, one, ros)


@pytest.fixture
def loop():
    """A ball that falls onto a fingertip in a loop of one's own: times, what was read, sensordata's force."""
    import mujoco
    from test_hands import springs

    import biotac_mj

    spec = mujoco.MjSpec.from_string("""<mujoco><option timestep=".01"/><worldbody>
      <site name="tip" quat="1 -1 0 0"/>
      <body pos="-.01 0 .0135"><joint type="slide" axis="0 0 1"/><geom size=".005" mass=".1"/></body>
      </worldbody></mujoco>""")
    finger = biotac_mj.attach(spec, site="tip", **springs())
    model = spec.compile()
    data = mujoco.MjData(model)
    time, reads, force = [], [], []
    for _ in range(20):
        mujoco.mj_step(model, data)
        time.append(data.time)
        read = finger.read(data)  # of springs, whose numbers are no counts
        reads.append({k: v if k == "contact_force" else v.round() % 4096 for k, v in read.items()})
        force.append(data.sensor("biotac_contact_force").data[:3].copy())
    return time, reads, np.array(force)


def test_a_loop_of_ones_own_is_a_recording_and_a_bag(loop, tmp_path):
    time, reads, force = loop
    recording = of_simulation(time, reads, object="ball")
    np.testing.assert_array_equal(recording.electrodes, [row["electrodes"] for row in reads])
    np.testing.assert_array_equal(recording.tac, [row["tac"][0] for row in reads])
    np.testing.assert_array_equal(recording.force, -force)  # on the ball
    assert recording.frame == "BioTac" and recording.object == "ball" and np.ptp(force) > 0.1
    pytest.importorskip("rosbags", reason="needs rosbags: pip install 'biotac-mj[ros]'")
    assert write_bag(tmp_path / "bag", recording) == ["/biotac_pub", "/wrench"]
    (again,) = load(tmp_path / "bag")
    for name in ("electrodes", "pdc", "pac", "tdc", "tac", "force"):
        np.testing.assert_array_equal(getattr(again, name), getattr(recording, name))
    np.testing.assert_allclose(again.time, time, atol=1e-9)


def test_rows_that_are_no_reading_are_said(loop):
    time, reads, _ = loop
    for rows, text in (
        ([*reads[:1], reads[1]["electrodes"]], "row 1 has no electrodes, pdc, pac, tdc, tac, contact_force"),
        ([{k: v for k, v in reads[0].items() if k != "pac"}], "row 0 has no pac: give what finger.read"),
        (reads[1:], "20 times for 19 rows: give one for each, and one at least"),
        ([], "20 times for 0 rows"),
    ):
        with pytest.raises(ValueError, match=text):
            of_simulation(time, rows)


def test_what_cannot_be_exported_is_said(tmp_path, capsys, monkeypatch, pressed):
    pytest.importorskip("rosbags", reason="needs rosbags: pip install 'biotac-mj[ros]'")
    rows = np.full((500, 19), 3000) + np.arange(500)[:, None] % 5
    np.savetxt(tmp_path / "e.txt", rows, "%d")
    assert cli.main(["recording", "export", str(tmp_path / "e.txt"), "--ros1", str(tmp_path / "o.bag")]) == 2
    assert "has no raw counts of pac, pdc, tac, tdc in every row" in capsys.readouterr().err


def test_the_library_that_is_needed_is_named(pressed, tmp_path, capsys, monkeypatch):
    import sys

    for name in ("rosbags", "rosbags.rosbag1"):
        monkeypatch.setitem(sys.modules, name, None)
    assert cli.main(["recording", "export", str(pressed[1]), "--ros2", str(tmp_path / "o")]) == 2
    assert "it needs pip install 'biotac-mj[ros]'" in capsys.readouterr().err
    assert FORMS == _FORMS
