"""Recordings: the file, importers on synthetic logs of every form, what they find, and the real sets where
they
are."""

import dataclasses
import sys
import types

import h5py
import numpy as np
import pytest
from grids import first
from recorded import synthetic, write_bag, write_btd, write_csv, write_mat

from biotac_mj import cli
from biotac_mj.recordings import FIELDS, Recording, findings, load, load_one, read, write
from biotac_mj.recordings.formats.joining import guess_unit, join
from biotac_mj.recordings.formats.messages import Topic
from biotac_mj.recordings.formats.names import is_time, other_unit, place_of, unit_of
from biotac_mj.recordings.live import streams_of_lines
from biotac_mj.recordings.picture import pac_spectrum
from biotac_mj.sensor.channels import REST_COUNTS

ONE = synthetic()
BUS = ("electrodes", "pdc", "pac", "tdc", "tac")


def agree(found, wanted, fields, atol=1e-6):
    for name in fields:
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=atol, err_msg=name)


@pytest.mark.parametrize(("order", "said"), [(slice(None), False), (slice(None, None, -1), True)])
def test_columns_in_another_order_are_said(order, said):
    one = dataclasses.replace(ONE, electrodes=ONE.electrodes[:, order])
    assert any("rest levels are unlike" in line for line in findings(one)) == said


@pytest.mark.parametrize("date", ["2026-01-01T00:00:{:06.3f}Z", "2026-01-01 00:00:{:06.3f}"])
def test_a_clock_of_dates(tmp_path, date):
    head, *rows = (["time", *(f"e{i}" for i in range(1, 20))], *ONE.electrodes[:9].astype(int).tolist())
    words = [",".join(map(str, [date.format(0.01 * k), *row])) for k, row in enumerate(rows)]
    (tmp_path / "r.csv").write_text("\n".join([",".join(head), *words]))
    one = load_one(tmp_path / "r.csv")[0]
    assert one.rate_source == "the file's times"
    np.testing.assert_allclose(one.time - one.time[0], 0.01 * np.arange(9), atol=1e-6)


@pytest.mark.parametrize("clock", ["{}", "[{}]"])
@pytest.mark.parametrize("named", [True, False])
def test_a_clock_of_times_of_day_goes_on_over_midnight(tmp_path, clock, named):
    head, *rows = (["time", *(f"e{i}" for i in range(1, 20))], *ONE.electrodes[:9].astype(int).tolist())
    times = [f"23:59:59.{95 + k}" if k < 5 else f"00:00:00.0{k - 5}" for k in range(9)]
    words = [" ".join(map(str, [clock.format(time), *row])) for time, row in zip(times, rows)]
    (tmp_path / "r.txt").write_text("\n".join([" ".join(head)] * named + words))
    one, said = load_one(tmp_path / "r.txt")
    assert one.rate_source == "the file's times" and not said
    np.testing.assert_allclose(one.time, 86400 - 0.05 + 0.01 * np.arange(9), atol=1e-6)
    agree(one, ONE.rows(slice(0, 9)), ["electrodes"])


def test_what_is_written_is_read(tmp_path):
    other = Recording(
        np.arange(3.0), np.full((3, 19), -5.0), name="tared", units={"electrodes": "tared counts"}
    )
    write(tmp_path / "r.h5", [ONE, other])
    one, two = read(tmp_path / "r.h5")
    assert (
        one.fields == ONE.fields and two.fields == ["electrodes"] and two.unit("electrodes") == "tared counts"
    )
    agree(one, ONE, ("time", *ONE.fields), 0)
    assert [getattr(one, w) for w in ("name", "object", "source", "frame")] == [
        "synthetic",
        "ball",
        "synthetic",
        "the file's",
    ]
    with h5py.File(tmp_path / "r.h5") as file:  # absent, not zero
        assert set(file["tared"]) == {"time", "electrodes"}
        assert file["synthetic/force"].attrs["unit"] == "N"
    (again, _) = load_one(tmp_path / "r.h5", "tared")
    assert again.name == "tared"
    with pytest.raises(ValueError, match="names of their own, synthetic"):
        write(tmp_path / "s.h5", [ONE, ONE])
    assert not (tmp_path / "s.h5").exists()


def test_nothing_is_left_where_writing_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "os.replace", lambda *a: (_ for _ in ()).throw(OSError(28, "No space left on device"))
    )
    with pytest.raises(OSError, match="No space"):
        write(tmp_path / "r.h5", [ONE])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("turned", [(), (0,), (1,), (0, 1)])
@pytest.mark.parametrize("clock", [False, True])
def test_text_either_way_round(tmp_path, turned, clock):
    """With a clock as the first column or row, or without; each file by itself."""
    for k, (name, value) in enumerate((("e.txt", ONE.electrodes), ("f.txt.gz", ONE.force))):
        value = np.c_[ONE.time, value] if clock else value
        np.savetxt(tmp_path / name, value.T if k in turned else value, "%.6f")
    (one,) = load([tmp_path / "e.txt", tmp_path / "f.txt.gz"], rate=None if clock else 50)
    agree(one, ONE, ("electrodes", "force"), 2e-6)
    assert one.fields == ["electrodes", "force"]
    if clock:
        agree(one, ONE, ("time",), 1e-6)
    else:
        assert one.rate == pytest.approx(50)
    for k, rows in enumerate((19, 3)):
        said = f"{rows + clock} x 420, time along its rows: turned"
        assert any(said in note for note in one.notes) == (k in turned)


def test_few_rows_of_text(tmp_path):
    """Electrodes may lie either way round however few they are; 19 rows of forces are none of these."""
    np.savetxt(tmp_path / "e.txt", ONE.electrodes[:7].T, "%d")
    agree(load_one(tmp_path / "e.txt")[0], ONE.rows(slice(0, 7)), ("electrodes",))
    np.savetxt(tmp_path / "e.txt", ONE.electrodes[:19], "%d")
    np.savetxt(tmp_path / "f.txt", ONE.force[:19])
    (one,) = load([tmp_path / "e.txt", tmp_path / "f.txt"])
    agree(one, ONE.rows(slice(0, 19)), ("electrodes", "force"))


def test_a_clock_that_jitters_keeps_its_rows(tmp_path):
    """Steps that run back by less than a second are no rows in a wrong order."""
    time = ONE.time.copy()
    time[::3] += 0.012
    write_csv(tmp_path / "r.csv", types.SimpleNamespace(**vars(ONE) | {"time": time}))
    (one,) = load(tmp_path / "r.csv")
    assert len(one) > 0.6 * len(ONE) and any("does not increase were left out" in n for n in one.notes)


@pytest.mark.parametrize("unit, factor", [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_a_clock_that_can_only_count_parts_of_seconds(tmp_path, unit, factor):
    """Its steps are too long for seconds, and one unit alone makes them those of a log."""
    write_csv(tmp_path / "r.csv", dataclasses.replace(ONE, time=ONE.time * factor), time="stamp")
    (one,) = load(tmp_path / "r.csv")
    np.testing.assert_allclose(one.time, ONE.time, rtol=1e-6)
    assert any(f"it was taken for {unit}" in note for note in one.notes)


def test_a_clock_before_the_electrodes(tmp_path):
    np.savetxt(tmp_path / "e.txt", np.c_[ONE.time, ONE.electrodes], "%.4f")
    (one,) = load(tmp_path / "e.txt")
    agree(one, ONE, ("time", "electrodes"))


@pytest.mark.parametrize(
    "base, prefix, time",
    [
        (1, "", "time"),
        (0, "field.bt_data0.", "timestamp"),
        (1, "ele_", "%time"),
        (1, "", "time_ms"),
        (1, "", "t_ns"),
    ],
)
def test_columns_are_found_by_their_names(tmp_path, base, prefix, time):
    factor = 1e3 if time.endswith("ms") else 1e9 if time.endswith("ns") else 1.0
    rename = {f"ele_e{i}": f"ele_{i}" for i in range(1, 20)}
    rename |= {f"ele_{c}": c for c in ("pdc", "tac", "tdc", *(f"pac{i}" for i in range(1, 23)))}
    write_csv(
        tmp_path / "r.csv", dataclasses.replace(ONE, time=ONE.time * factor), base, prefix, time, rename
    )
    (one,) = load(tmp_path / "r.csv")
    agree(one, ONE, ONE.fields, 1e-5)
    np.testing.assert_allclose(one.time, ONE.time, rtol=1e-6)


@pytest.mark.parametrize(
    "stamp, found",
    [(lambda t: 1_453_306_500_000_000_000 + 1e9 * t, True), (np.zeros_like, False)],
    ids=["sent", "never set"],
)
def test_stamps_of_headers_are_the_clock_where_there_is_no_other(tmp_path, stamp, found):
    """As `rostopic echo -p` writes them, in nanoseconds; 100 Hz were taken for granted."""
    names = ["field.header.stamp", *(f"field.bt_data0.electrode_data{k}" for k in range(19))]
    path, halves = tmp_path / "r.csv", 0.5 * ONE.time  # 200 Hz
    rows = np.c_[stamp(halves), ONE.electrodes]
    np.savetxt(path, rows, "%.0f", delimiter=",", header=",".join(names), comments="")
    (one,) = load(path)
    assert one.rate == pytest.approx(2 * ONE.rate if found else 100.0, rel=1e-3)
    np.savetxt(
        path, np.c_[rows, ONE.time], "%.6f", delimiter=",", header=",".join([*names, "time"]), comments=""
    )
    (one,) = load(path)
    np.testing.assert_allclose(one.time, ONE.time, atol=1e-5)


def test_units_in_names_are_those_of_the_numbers(tmp_path):
    """They are what the numbers are in, and said; without one they are N and m."""
    rename = {"force_x": "Fx_mN", "force_y": "Fy [mN]", "force_z": "Fz (mN)"}
    lines = [",".join(["time", *(f"e{i + 1}" for i in range(19)), *rename.values(), "object_pos_x_mm"])]
    lines[0] += ",object_pos_y [cm],object_pos_z_um"
    for k in range(len(ONE.time)):
        row = [ONE.time[k], *ONE.electrodes[k], *(1e3 * ONE.force[k]), 12.0, 3.0, 40.0]
        lines.append(",".join(f"{v:.9g}" for v in row))
    (tmp_path / "r.csv").write_text("\n".join(lines) + "\n")
    (one,) = load(tmp_path / "r.csv")
    np.testing.assert_allclose(one.force, ONE.force, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(one.object_pos, np.tile([12e-3, 3e-2, 40e-6], (len(ONE.time), 1)))
    said = " ".join(one.notes)
    assert "Fx_mN, Fy [mN], Fz (mN) are read as mN" in said and "object_pos_y [cm] are read as cm" in said
    assert unit_of("Fx") == unit_of("e1") == ("", 1.0) and unit_of("Tz_Nmm") == ("Nmm", 1e-3)
    assert unit_of("Fz_N") == ("N", 1.0)


@pytest.mark.parametrize(
    "unit, newtons",
    [
        ("gf", 9.80665e-3),
        ("kgf", 9.80665),
        ("lbf", 4.4482216152605),
        ("g", 9.80665e-3),
        ("kg", 9.80665),
        ("cN", 0.01),
        ("daN", 10.0),
    ],
)
def test_forces_by_weight_are_newtons(unit, newtons, tmp_path):
    """In a column's name, with and without brackets, and in a row of units."""
    names = [f"e{i + 1}" for i in range(19)]
    rows = np.column_stack([ONE.electrodes, ONE.force / newtons])
    for k, (axes, units) in enumerate(
        (
            ([f"F{x}_{unit}" for x in "xyz"], ""),
            ([f"F{x} [{unit}]" for x in "xyz"], ""),
            (["Fx", "Fy", "Fz"], unit),
        )
    ):
        head = [",".join(names + axes), *([",".join(["counts"] * 19 + [unit] * 3)] if units else [])]
        lines = [",".join(f"{v:.9g}" for v in row) for row in rows]
        (tmp_path / f"{k}.csv").write_text("\n".join(head + lines) + "\n")
        (one,) = load(tmp_path / f"{k}.csv")
        np.testing.assert_allclose(one.force, ONE.force, rtol=1e-6, atol=1e-8)
        assert f"are read as {unit}" in " ".join(one.notes)


def test_quaternions_that_are_none_are_said(tmp_path):
    lines = ["time," + ",".join(f"e{i + 1}" for i in range(19)) + ",object_qw,object_qx,object_qy,object_qz"]
    for k in range(len(ONE.time)):
        quat = (1, 0, 0, 0) if k > 2 else (0, 0, 0, 0)
        lines.append(",".join(f"{v:.9g}" for v in (ONE.time[k], *ONE.electrodes[k], *quat)))
    (tmp_path / "r.csv").write_text("\n".join(lines) + "\n")
    (one,) = load(tmp_path / "r.csv")
    assert "object_quat of 3 rows is no unit quaternion" in " ".join(one.notes)


def test_names_in_the_wild():
    wanted = {
        "F0Electrodes": ("f0", "electrodes", None),
        "field.bt_data1.electrode_data17": ("field_bt_data1", "electrodes", 17),
        "ele3": ("", "electrodes", 3),
        "pac22": ("", "pac", 22),
        "F1pdc": ("f1", "pdc", None),
        "Fx": ("", "force", 0),
        "wrench.force.z": ("", "force", 2),
        "posy": ("", "sensor_pos", 1),
        "ow": ("", "sensor_quat", 0),
        "px": ("", "contact_pos", 0),
        "px_mm": ("", "contact_pos", 0),
        "py [mm]": ("", "contact_pos", 1),
        "thumb.pz_cm": ("thumb", "contact_pos", 2),
        "object_px": ("", "object_pos", 0),
        "pos_x_mm": ("", "sensor_pos", 0),
        "object/pose/position/x": ("", "object_pos", 0),
        "tool_qw": ("", "object_quat", 0),
    }
    for name, place in wanted.items():
        assert place_of(name) == place, name
    for name in (
        "JPos",
        "time1",
        "tare1",
        "x",
        "field.bt_time.electrode_ns_offset3",
        "bt_position",
        "tip_x_m",
        "depth",
    ):
        assert place_of(name) is None, name
    assert not other_unit("py [mm]")
    assert is_time("%time") and is_time("time [ms]") and not is_time("times_seven")


def test_empty_cells_are_gaps_in_force_and_errors_in_electrodes(tmp_path):
    write_csv(tmp_path / "r.csv", ONE)
    lines = (tmp_path / "r.csv").read_text().splitlines()
    k = lines[0].split(",").index("Fx")
    words = lines[8].split(",")
    words[k] = ""
    (tmp_path / "r.csv").write_text("\n".join([*lines[:8], ",".join(words), *lines[9:]]))
    (one,) = load(tmp_path / "r.csv")
    assert np.isnan(one.force[7, 0]) and np.isfinite(one.force).sum() == 3 * len(ONE) - 1
    assert any("force: not there in 0.1%" in line for line in findings(one))


def test_poses_on_another_clock_are_interpolated_and_holes_stay(tmp_path):
    write_csv(tmp_path / "a_bio.csv", ONE)
    time = np.arange(4.5, 8.0, 1 / 150)
    time = time[(time < 6.0) | (time > 7.0)]
    turn = np.column_stack(
        [time, np.sin(time), 0 * time, 0 * time, 0 * time, 0 * time, np.sin(time / 2), np.cos(time / 2)]
    )
    turn[::2, 4:] *= -1  # the same attitude
    np.savetxt(
        tmp_path / "a_cp.csv", turn, "%.9f", ",", header="timestamp,posx,posy,posz,ox,oy,oz,ow", comments=""
    )
    (tmp_path / "a_cv.csv").write_text("timestamp,x,y\n1,-nan,2\n")
    (given,) = load(sorted(tmp_path.glob("a_*.csv")))
    (one,) = load(tmp_path / "a_bio.csv")  # the other is found beside it
    agree(one, given, one.fields)
    assert given.notes[-1] == "left out a_cv.csv"
    there = np.isfinite(one.sensor_pos).all(1)
    want = (one.time < 6.0) | ((one.time > 7.0) & (one.time <= time[-1]))
    assert (there == want).mean() > 0.99 and not there[(one.time > 6.02) & (one.time < 6.98)].any()
    np.testing.assert_allclose(one.sensor_pos[there, 0], np.sin(one.time[there]), atol=1e-4)
    attitude = np.abs(one.sensor_quat[there, 0])
    np.testing.assert_allclose(attitude, np.abs(np.cos(one.time[there] / 2)), atol=1e-4)


@pytest.mark.parametrize("packed", [False, True])
def test_native_logs_are_read(tmp_path, packed):
    short = ONE.rows(slice(0, 40))
    write_btd(tmp_path / "t.btd", short, packed=packed, sensors=2)
    one, two = load(tmp_path / "t.btd")
    agree(one, short, ("time", *BUS), 1e-5)
    agree(two, short, BUS)
    assert any("SYNTHETIC01" in note for note in one.notes) and one.name == "t_bt1"


def test_lost_frames_of_a_native_log_are_counted(tmp_path):
    keep = np.ones(40, bool)
    keep[[7, 8, 30]] = False
    write_btd(tmp_path / "t.btd", ONE.rows(slice(0, 40)))
    head, *body = (tmp_path / "t.btd").read_text().split("Begin File\n")
    lines = [line for line in body[0].splitlines() if keep[int(line.split()[2])]]
    (tmp_path / "t.btd").write_text(
        head + "Begin File\n" + "\n".join(lines[:-3]) + "\n"
    )  # and the last is not whole
    (one,) = load(tmp_path / "t.btd")
    assert len(one) == 36 and any("own numbers lack 3 of 39" in note for note in one.notes)
    assert any(
        "2 gaps, the longest of 2 rows before row 8; about 3 rows were dropped" in f for f in findings(one)
    )


def test_files_of_matlab_are_read(tmp_path):
    write_mat(tmp_path / "steel_01_02_HOLD.mat", ONE)
    one, two = load(tmp_path / "steel_01_02_HOLD.mat")
    agree(one, ONE, BUS)
    np.testing.assert_array_equal(two.electrodes, ONE.electrodes + 5)
    assert (one.name, two.name, one.object) == ("steel_01_02_HOLD_f0", "steel_01_02_HOLD_f1", "steel_01")
    assert one.rate == pytest.approx(100) and any("left out JPos" in note for note in one.notes)


def test_matlab_structs_and_73(tmp_path):
    import scipy.io

    inside = {
        "biotac": {"electrodes": ONE.electrodes, "time": ONE.time, "force": ONE.force},
        "object": "cork",
    }
    scipy.io.savemat(tmp_path / "a.mat", {"log": inside["biotac"], "object": "cork"})
    (one,) = load(tmp_path / "a.mat")
    agree(one, ONE, ("electrodes", "force"))
    assert one.object == "cork"
    with h5py.File(tmp_path / "b.mat", "w", userblock_size=512) as file:
        file["log/electrodes"], file["log/force"], file["log/pdc"] = (
            ONE.electrodes.T,
            ONE.force.T,
            ONE.pdc[:, None],
        )
    with open(tmp_path / "b.mat", "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")
    (one,) = load(tmp_path / "b.mat")
    agree(one, ONE, ("electrodes", "force", "pdc"))


@pytest.mark.parametrize("ros", [1, "SQLITE3", "MCAP"])
def test_bags_of_ros_are_read(tmp_path, ros):
    pytest.importorskip("rosbags", reason="needs rosbags: pip install 'biotac-mj[ros]'")
    path = write_bag(tmp_path, ONE, ros)
    (one,) = load(path)
    agree(one, ONE, ("time", *BUS, "force", "torque"))


def test_a_bag_without_its_library_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(ValueError, match=r"a.bag is a bag of ROS: it needs pip install 'biotac-mj\[ros\]'"):
        load(tmp_path / "a.bag")


def message(**fields):
    """One of ROS 2's Python classes, as rosidl makes them."""
    made = type("Message", (), {"__slots__": [f"_{name}" for name in fields], **fields})()
    return made


def test_messages_of_any_package():
    topic = Topic("/rh/tactile")
    for k in range(30):
        stamp = types.SimpleNamespace(sec=7, nanosec=10_000_000 * k)
        header = message(stamp=stamp)
        fingers = [
            message(
                pac0=2000 + k, pac1=2001 + k, pdc=1500, tac=2040, tdc=2000, electrodes=[3000 + f + k] * 19
            )
            for f in range(2)
        ]
        assert topic.add(message(header=header, tactiles=fingers), 0.0)
    assert not topic.add(message(data="hello"), 0.0)
    one, two = join(topic.streams())
    assert (
        (two.electrodes - one.electrodes == 1).all() and one.time[0] == 7 and one.rate == pytest.approx(100)
    )
    assert np.isnan(one.pac[:, :20]).all() and (one.pac[:, 21] == 2001 + np.arange(30)).all()
    assert any("PAC has 2 of 22" in note for note in one.notes)


def test_two_poses_of_one_body_are_said():
    """Two topics without a word that tells them apart."""
    topics = Topic("/biotac"), Topic("/robot/pose"), Topic("/finger/pose")
    for k in range(20):
        topics[0].add(message(electrodes=[3000 + k] * 19), 0.01 * k)
        for axis, topic in enumerate(topics[1:]):
            position = message(x=1.0 + axis, y=0.0, z=0.0)
            turn = message(x=0.0, y=0.0, z=0.0, w=1.0)
            topic.add(message(pose=message(position=position, orientation=turn)), 0.01 * k)
    (one,) = join([stream for topic in topics for stream in topic.streams()])
    assert (one.sensor_pos == [1, 0, 0]).all() and (one.sensor_quat == [1, 0, 0, 0]).all()
    assert "finger_pose: left out sensor_pos, sensor_quat, which is in another file too" in one.notes


def test_lines_of_a_serial_port():
    times = 100 + 0.01 * np.arange(20)
    lines = [(",".join(f"{v:.0f}" for v in row) + "\r\n").encode() for row in ONE.electrodes[:20]]
    (one,) = join(streams_of_lines("/dev/ttyUSB0", lines, times, None))
    np.testing.assert_array_equal(one.electrodes, ONE.electrodes[:20])
    np.testing.assert_allclose(one.time, times)
    header = [b",".join(b"e%d" % k for k in range(19, 0, -1)) + b"\n"]
    (one,) = join(streams_of_lines("p", header + lines, np.r_[0, times], None))
    np.testing.assert_array_equal(one.electrodes, ONE.electrodes[:20, ::-1])
    np.testing.assert_allclose(one.time, times)
    with pytest.raises(ValueError, match="sends 19 numbers a line, 2 were expected"):
        streams_of_lines("p", lines, times, ["pdc", "tdc"])


def test_recording_from_a_port(tmp_path, serial_port, capsys):
    out = tmp_path / "r.h5"
    command = "recording record --serial /dev/x --seconds 0.2 --object air --out".split()
    assert cli.main([*command, str(out)]) == 0
    (one,) = read(out)
    assert (
        (np.diff(one.electrodes[:, 18]) == 1).all() and one.electrodes[0, 18] == 3002 and one.object == "air"
    )
    assert "e1 never changes: is it dead?" in capsys.readouterr().out


@pytest.mark.parametrize("ros", ["rclpy", "rospy"])
def test_topics_of_ros_are_recorded(tmp_path, monkeypatch, ros):
    """Stand-ins for ROS' libraries: a hand that sends as often as it is asked, or asks to be called back."""
    sent = []

    def hand():
        sent.append(3000 + len(sent))
        stamp = types.SimpleNamespace(
            secs=5, nsecs=10_000_000 * len(sent), sec=5, nanosec=10_000_000 * len(sent)
        )
        data = [message(pdc_data=1500, electrode_data=np.full(19, min(sent[-1], 4095)))]
        return message(header=message(stamp=stamp), bt_data=data)

    def module(name, **names):
        made = types.ModuleType(name)
        vars(made).update(names, __spec__=types.SimpleNamespace())
        monkeypatch.setitem(sys.modules, name, made)
        if "." in name:
            setattr(sys.modules[name.rpartition(".")[0]], name.rpartition(".")[2], made)

    called = []
    if ros == "rclpy":
        node = types.SimpleNamespace(
            get_topic_names_and_types=lambda: [("/hand", ["biotac_sensors/msg/BioTacHand"])],
            create_subscription=lambda kind, name, back, qos: called.append(back),
            destroy_node=lambda: None,
        )
        spin = lambda node, timeout_sec: called and called[0](hand())  # noqa: E731
        module("rclpy", init=lambda: 0, create_node=lambda name: node, spin_once=spin, shutdown=lambda: 0)
        module("rclpy.qos", qos_profile_sensor_data=None)
        module("rosidl_runtime_py")
        module("rosidl_runtime_py.utilities", get_message=lambda name: name)
    else:

        def subscriber(name, kind, back, callback_args, queue_size):
            for _ in range(30):
                kind = {"type": "biotac_sensors/BioTacHand"}
                back(types.SimpleNamespace(_buff=b"", _connection_header=kind), callback_args)
            return types.SimpleNamespace(unregister=lambda: None)

        kind = type("Hand", (), {"deserialize": lambda self, raw: hand()})
        module("rospy", init_node=lambda *a, **k: 0, Subscriber=subscriber, AnyMsg=object)
        module("roslib")
        module("roslib.message", get_message_class=lambda name: kind)
    out = tmp_path / "r.h5"
    assert cli.main(["recording", "record", "--topic", "/hand", "--seconds", "0.05", "--out", str(out)]) == 0
    (one,) = read(out)
    assert (
        len(sent) >= 10
        and one.electrodes[:, 0].tolist() == np.minimum(sent, 4095).tolist()
        and one.rate == pytest.approx(100)
    )


def test_recording_without_libraries_says_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("biotac_mj.recordings.live._is_here", lambda name: False)
    for words, said in (("--topic /biotac_pub", "rclpy or rospy"), ("--serial /dev/x", "biotac-mj[serial]")):
        assert cli.main(["recording", "record", *words.split(), "--out", str(tmp_path / "r.h5")]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1


def test_units_are_told_from_the_values():
    tared = ONE.electrodes - REST_COUNTS["1"]
    for value, unit in (
        (ONE.electrodes, "counts"),
        (np.rint(tared), "tared counts"),
        (np.abs(np.rint(tared)), "tared counts without sign"),
        # pressed hard for most of the time, after it rested
        (
            np.where(
                np.arange(len(ONE))[:, None] < 9,
                np.sign(np.arange(-4.0, 5))[np.arange(len(ONE)) % 9][:, None],
                -700.0,
            ),
            "tared counts",
        ),
        (ONE.electrodes / 4095, "normalised"),
        (ONE.electrodes / 4095 * 3.3, "volts"),
        (2 * ONE.electrodes / 4095 - 1, "normalised"),
        (np.zeros((9, 19)), "tared counts without sign"),
    ):
        assert guess_unit(value) == unit


def test_rest_like_published_sensors():
    assert ONE.rest_correlation > 0.95
    assert dataclasses.replace(ONE, electrodes=ONE.electrodes[:, ::-1]).rest_correlation < 0.8


def test_scaled_and_tared_counts(tmp_path):
    np.savetxt(tmp_path / "e.txt", ONE.electrodes / 4095, "%.6f")
    (one,) = load(tmp_path / "e.txt")
    with pytest.raises(
        ValueError, match="normalised values; raw counts 0..4095 are needed: import them again with"
    ):
        one.counts()
    (one,) = load(tmp_path / "e.txt", scale=4095)
    np.testing.assert_allclose(one.counts()[0], ONE.electrodes, atol=0.01)
    tared = Recording(
        ONE.time, np.rint(ONE.electrodes - REST_COUNTS["1"]), units={"electrodes": "tared counts"}
    )
    counts, notes = tared.counts()
    mean = np.mean(list(REST_COUNTS.values()), axis=0)
    np.testing.assert_allclose(counts, ONE.electrodes - REST_COUNTS["1"] + mean, atol=0.51)
    assert "an assumption" in notes[0]


def test_held_and_dropped_rows_are_found():
    rng = np.random.default_rng(1)
    value = np.repeat(ONE.electrodes, 3, axis=0)
    held = Recording(np.arange(len(value)) / 300, value)
    assert held.repeated.mean() == pytest.approx(2 / 3, abs=0.01)
    assert any("values are held, new ones come at 100 Hz" in line for line in findings(held))
    keep = np.sort(rng.choice(len(ONE), len(ONE) - 20, replace=False))
    keep = np.union1d(keep, [0, len(ONE) - 1])
    (said,) = [line for line in findings(ONE.rows(keep)) if line.startswith("warning: clock: ")]
    assert f"about {len(ONE) - len(keep)} rows were dropped" in said
    assert findings(ONE)[1] == "clock: no gap" and not ONE.repeated.any()


@pytest.mark.parametrize("hz", (100, 117.3, 300, 400, 640, 900))
def test_stamps_in_whole_milliseconds_give_the_mean_rate(hz):
    """Rows that are missing are none of it while a step is longer than a tick; a clean grid keeps its rate
    where one in a hundred rows is."""
    even = np.round(np.arange(6000) / hz, 3)
    assert _rate(even) == pytest.approx(hz, rel=2e-3)
    assert not any("gap" in line for line in findings(_at(even)) if "no gap" not in line)
    if hz < 650:
        gone = [*range(300, 330), 500, 510, *range(900, 907)]
        assert _rate(np.delete(even, gone)) == pytest.approx(hz, rel=2e-3)
    grid = np.arange(6000) / 1000
    assert _rate(np.delete(grid, np.arange(50, 6000, 100) + np.arange(60) % 7)) == pytest.approx(1000)


def _at(time):
    counts = np.rint(2500 + 4 * np.random.default_rng(0).standard_normal((len(time), 19)))
    return Recording(time, electrodes=counts)


def _rate(time):
    return _at(time).rate


def test_a_rate_is_guessed_from_held_rows(tmp_path):
    keep = np.sort(np.r_[np.arange(420), np.arange(0, 420, 5)])  # a logger at 120 Hz on a bus of 100
    np.savetxt(tmp_path / "e.txt", ONE.electrodes[keep], "%d")
    (one,) = load(tmp_path / "e.txt")
    assert one.rate == pytest.approx(120, rel=0.01) and "a logger faster than the bus" in one.rate_source


def write_clock(path, time):
    """A log with these times."""
    write_csv(path, ONE)
    head, *rows = path.read_text().splitlines()
    rows = [f"{t:.4f}" + line[line.index(",") :] for t, line in zip(time, rows)]
    path.write_text("\n".join([head, *rows]))


def test_a_clock_with_faults(tmp_path):
    time = ONE.time.copy()
    time[100] = time[99]  # repeated
    time[200:] -= 6.0  # a new start
    write_clock(tmp_path / "r.csv", time)
    (one,) = load(tmp_path / "r.csv")
    assert len(one) == 419 and (np.diff(one.time) > 0).all()
    assert "1 rows whose time does not increase were left out" in one.notes
    assert any("starts anew in row 200, 6 s back" in note for note in one.notes)
    assert sum("starts anew" in line for line in findings(one)) == 1
    assert any(line.startswith("warning: the clock starts anew") for line in findings(one))
    assert any("starts anew" in line for line in load_one(tmp_path / "r.csv")[1])
    np.testing.assert_array_equal(one.electrodes, np.delete(ONE.electrodes, 100, 0))


def test_saturated_and_dead_electrodes_are_named():
    value = ONE.electrodes.copy()
    value[:, 4] = 4095
    value[:21, 7] = 0
    value[200:221, 9] = 0
    value[190:200, 9] *= np.linspace(0.9, 0, 10).round(1)
    value[221:231, 9] *= np.linspace(0, 0.9, 10).round(1)
    said = findings(dataclasses.replace(ONE, electrodes=value))
    assert any(line.startswith("warning: e5 never changes: is it dead?") for line in said)
    assert any(line.startswith("saturated (0 or 4095 counts): e8 5.0%, e10 5.") for line in said)


def test_a_clock_that_runs_back_a_little(tmp_path):
    write_clock(tmp_path / "r.csv", ONE.time - np.where(np.arange(420) < 200, 0, 0.5))
    _, said = load_one(tmp_path / "r.csv")
    assert len(said) == 1 and "runs back 1 times, by 0.5 s at most, first in row 200: rows until" in said[0]


def of_all(value):
    return {"electrodes": np.full((420, 19), float(value))}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        pytest.param(
            of_all(0),
            "no electrode changes from 0, this is no recording of a touch: no power",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            of_all(4095),
            "no electrode changes from 4095, this is no recording of a touch: a broken wire",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            of_all(2000),
            "no electrode changes from 2000, this is no recording of a touch: a logger",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"electrodes": np.tile(ONE.electrodes[:1], (420, 1))},
            "no electrode changes, this is no",
            marks=pytest.mark.slow,
        ),
        ({"force": -np.zeros((420, 3))}, "the force never changes from 0 N: is its sensor connected"),
        pytest.param(
            {"pdc": np.full(420, 1500.0)}, "PDC never changes from 1500 counts", marks=pytest.mark.slow
        ),
        pytest.param(
            {"pac": np.full((420, 22), 2047.0)}, "PAC never changes from 2047 counts", marks=pytest.mark.slow
        ),
        pytest.param({"tdc": np.zeros(420)}, "TDC never changes from 0 counts", marks=pytest.mark.slow),
        ({"tdc": np.full(420, 2000.0), "tac": np.full(420, 2042.0)}, None),
        pytest.param({}, None, marks=pytest.mark.slow),
    ],
)
def test_what_stands_still_is_said_at_import_and_kept(changes, said, tmp_path, capsys):
    one = dataclasses.replace(ONE, units={"electrodes": "tared counts"}, **changes)
    write(tmp_path / "r.h5", [one])
    # of what is not said one verb is enough
    for words in (["recording", "import", "--out", "again.h5"], ["recording", "show", "--out", "show.png"])[
        : 2 if said else 1
    ]:
        *verb, option, name = words
        assert cli.main([*verb, str(tmp_path / "r.h5"), option, str(tmp_path / name)]) == 0
        lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
        found = [line for line in lines if line.startswith("warning: ")]
        assert len(found) == (said is not None) and all(said in line for line in found), lines


def test_a_driver_that_keeps_one_sample_of_pac():
    value = np.full((420, 22), np.nan)
    value[:, -1] = 2047
    assert any("PAC never changes" in line for line in findings(dataclasses.replace(ONE, pac=value)))
    value[:, -1] = ONE.pac[:, -1]
    assert not any("PAC never" in line for line in findings(dataclasses.replace(ONE, pac=value)))


def test_spectrum_has_the_line_and_the_power():
    frequency, power, frames = pac_spectrum(ONE)
    assert frequency[np.argmax(power)] == pytest.approx(300, abs=13) and frames == len(ONE)
    assert np.trapezoid(power, frequency) == pytest.approx(40**2 / 2 + 3**2, rel=0.05)
    assert pac_spectrum(dataclasses.replace(ONE, pac=None)) is None


def test_commands_import_and_show_a_recording(tmp_path, capsys):
    write_csv(tmp_path / "r.csv", ONE)
    rec, png = str(tmp_path / "rec.h5"), tmp_path / "show.png"
    assert cli.main(["recording", "import", str(tmp_path / "r.csv"), "--object", "ring", "--out", rec]) == 0
    said = capsys.readouterr().out
    assert "420 rows, 4.19 s, 100 Hz" in said and "units: counts: electrodes, pdc, pac, tdc, tac" in said
    (one,) = read(rec)
    agree(one, ONE, ONE.fields, 1e-5)
    assert one.object == "ring"
    assert cli.main(["recording", "show", rec, "--out", str(png)]) == 0
    assert "object ring" in capsys.readouterr().out
    import matplotlib.image

    drawn = matplotlib.image.imread(png)
    assert drawn.shape[0] > 1000 and drawn[..., :3].std() > 0.05
    assert cli.main(["recording", "show", rec, "--recording", "jelly", "--out", str(png)]) == 2
    assert "has 0 recordings called 'jelly': choose one of r" in capsys.readouterr().err


@pytest.mark.parametrize(
    "gone", first([(), ("electrodes",), ("pac", "tdc"), ("pdc", "tac", "force", "torque", "object_pos")])
)
def test_a_picture_of_whatever_there_is(tmp_path, gone):
    from biotac_mj.recordings import draw

    one = dataclasses.replace(ONE, **dict.fromkeys(gone))
    draw(one, tmp_path / "a.png")
    draw(one.rows(slice(0, 1)), tmp_path / "b.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000 < 2 * (tmp_path / "b.png").stat().st_size


# what is known of the real sets: files, recordings, rows, rate, unit, fields beside the electrodes
REAL = {
    "epfl_flat_press/SynImpF1.txt epfl_flat_press/ForceData.txt": (1, 22508, 116.3, "counts", "force"),
    "epfl_f2/SynImpF2.txt.gz epfl_f2/ForceData.txt.gz": (1, 23671, 116.9, "counts", "force"),
    "phac_hold/steel_vase_702_03_HOLD.mat": (2, 1000, 100, "counts", "pdc pac tdc tac"),
    "btd/btsp_touch.btd.gz": (1, 2124, 100, "counts", "pdc pac tdc tac"),
    "slides_20/mat12_1_bio.csv.gz": (
        1, None, 100, "tared counts without sign", "pdc pac tdc tac force torque sensor_pos sensor_quat"),
    "scraping/sense_R_LF.txt.gz scraping/sense_R_RF.txt.gz": (
        2, 1122, 302.4, "tared counts", "sensor_pos sensor_quat"),
}  # fmt: skip


@pytest.mark.parametrize("files", REAL)
def test_real_sets_are_read_with_rate_and_unit(shared, files):
    many, rows, rate, unit, fields = REAL[files]
    found = load([shared / "data" / name for name in files.split()])
    assert len(found) == many
    for one in found:
        assert rows in (None, len(one)) and one.rate == pytest.approx(rate, rel=1e-3)
        assert one.unit("electrodes") == unit and one.fields == [
            "electrodes",
            *(f for f in FIELDS if f in fields.split()),
        ]
    counts = found[0].counts()[0]
    assert counts.shape == (len(found[0]), 19) and 0 <= counts.min() and counts.max() <= 4095


def test_one_recording_of_a_file_is_chosen_by_its_name(tmp_path):
    time, path = np.arange(9.0), tmp_path / "two.h5"
    write(path, [Recording(time, pdc=time, name=name) for name in "ab"])
    assert load_one(path, recording="b").recording.name == "b"
    first, notes = load_one(path)
    assert first.name == "a" and "2 recordings are in" in notes[0]
