"""Clocks and units that a file says somewhere else than in a column's name."""

import h5py
import numpy as np
import scipy.io
from recorded import synthetic

from biotac_mj.recordings import load, warnings

ONE, TWO = synthetic(80, rate=50.0), synthetic(60, seed=1)
ZERO = ONE.time[0]


def text(path, columns, header=""):
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="", fmt="%.9g")
    return path


def names(prefix=""):
    return ",".join(f"{prefix}e{k}" for k in range(1, 20))


def test_units_that_attributes_say(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["electrodes"] = ONE.electrodes
        for name, value, unit in (
            ("time", 1e3 * (ONE.time - ZERO), "ms"),
            ("object_pos", 1e3 * ONE.object_pos, "mm"),
            ("object_quat", ONE.object_quat[:, [1, 2, 3, 0]], "x y z w"),
            ("force", ONE.force / 9.80665, "kgf"),
            ("torque", ONE.force, "oz in"),
        ):
            file[name] = value
            file[name].attrs["unit"] = unit
    (one,) = load(tmp_path / "a.h5")
    np.testing.assert_allclose(one.time, ONE.time - ZERO, atol=1e-9)
    np.testing.assert_allclose(one.object_pos, ONE.object_pos, atol=1e-12)
    np.testing.assert_allclose(one.object_quat, ONE.object_quat, atol=1e-12)
    np.testing.assert_allclose(one.force, ONE.force, atol=1e-12)
    assert one.torque is None and any("left out torque, whose unit is 'oz in'" in note for note in one.notes)


def test_groups_beside_that_of_the_electrodes(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["biotac/electrodes"], file["biotac/time"] = ONE.electrodes, ONE.time
        file["ft/force"], file["ft/time"] = ONE.force[::2], ONE.time[::2]
        file["calibration/force"] = np.ones((5, 3))
    (one,) = load(tmp_path / "a.h5")
    np.testing.assert_allclose(one.force[::2], ONE.force[::2])
    assert any("left out group calibration" in note for note in one.notes)


def test_each_struct_has_its_own_clock(tmp_path):
    fingers = {name: {"time": r.time, "electrodes": r.electrodes} for name, r in (("ff", ONE), ("th", TWO))}
    scipy.io.savemat(tmp_path / "a.mat", fingers)
    for one, true in zip(load(tmp_path / "a.mat"), (ONE, TWO)):
        np.testing.assert_allclose(one.time, true.time)
        assert (one.electrodes == true.electrodes).all()


def test_seconds_and_nanoseconds_are_one_clock(tmp_path):
    time = ONE.time + 0.007
    stamp = [np.floor(time), np.round(1e9 * (time % 1)), ONE.electrodes]
    for k, header in enumerate(("secs,nsecs", "header.stamp.secs,header.stamp.nsecs", "sec,nanosec")):
        (one,) = load(text(tmp_path / f"{k}.csv", stamp, f"{header},{names()}"))
        np.testing.assert_allclose(np.diff(one.time), np.diff(time), atol=1e-8)


def test_row_numbers_are_no_clock_and_an_unused_rate_is_said(tmp_path):
    rows = text(tmp_path / "a.txt", [np.arange(80), ONE.electrodes])
    assert abs(load(rows, rate=50.0)[0].rate - 50) < 1e-9
    timed = load(text(tmp_path / "b.txt", [ONE.time, ONE.electrodes]), rate=20.0)[0]
    assert abs(timed.rate - 50) < 1e-6 and any("--rate is not needed" in note for note in timed.notes)


def test_places_that_look_like_millimetres_are_doubted(tmp_path):
    header = f"time,{names()},px,py,pz"
    place = np.column_stack([np.linspace(-12, 0, 80), np.zeros(80), np.zeros(80)])
    far, near = (
        load(text(tmp_path / f"{k}.csv", [ONE.time, ONE.electrodes, k * place], header))[0]
        for k in (1.0, 1e-3)
    )
    assert any("contact_pos moves over 12 m" in line for line in warnings(far)) and not warnings(near)
