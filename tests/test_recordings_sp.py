"""Logs of the BioTac SP are read as such, whatever form they have."""

import gzip
import re

import numpy as np
import pytest
from recorded import synthetic, write_btd

from biotac_mj.discrepancy import diagnose_recording, read_recording
from biotac_mj.geometry.design import read_design
from biotac_mj.recordings import Recording, load, load_one
from biotac_mj.recordings import write as write_recordings
from biotac_mj.recordings.formats.joining import join
from biotac_mj.recordings.inspection import findings
from biotac_mj.recordings.live import streams_of_lines
from biotac_mj.recordings.picture import pac_spectrum
from biotac_mj.sensor.presets import sensors_of

SP = read_design("biotac_sp")
RNG = np.random.default_rng(0)
COUNTS = np.rint(sensors_of(SP)["sp_mf"].rest + RNG.normal(0, 4, (200, 24))).astype(int)


def write(path, header, rows, mark=","):
    text = "\n".join([*([mark.join(header)] if header else []), *(mark.join(map(str, row)) for row in rows)])
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())
    return path


@pytest.mark.parametrize("named", [True, False])
def test_a_table_of_24_columns_is_an_sp(tmp_path, named):
    path = write(tmp_path / "slip.csv", [f"ff_e{k + 1}" for k in range(24)] if named else None, COUNTS)
    one, _ = load_one(path)
    np.testing.assert_array_equal(one.electrodes, COUNTS)
    assert one.design == SP and "BioTac SP (24 electrodes)" in findings(one)[0]
    assert not any("unlike" in line for line in findings(one))
    np.testing.assert_array_equal(one.counts()[0], COUNTS)


def test_fingers_of_a_table_of_grasps_are_one_recording_each(tmp_path):
    names = [f"{finger}_biotac_{k + 1}" for finger in ("ff", "th") for k in range(24)]
    rows = [["mug", 0, *row, *row[::-1]] for row in COUNTS.tolist()]
    found = load([write(tmp_path / "grasps.csv.gz", ["object", "slipped", *names], rows)])
    assert [one.design for one in found] == [SP, SP]
    np.testing.assert_array_equal(found[1].electrodes, COUNTS[:, ::-1])


def test_a_table_of_hand_messages_omits_fingers_without_sensor(tmp_path):
    header = ["rosbagTimestamp", "tactiles", *["-", "pac0", "pac1", "pdc", "tac", "tdc", "electrodes"] * 2]
    quoted = [f'"{row}"' for row in COUNTS.tolist()]
    nothing = [0, 0, -22072, 0, 0, f'"{[0] * 24}"']
    rows = [
        [1542626996852673190 + i * 10_000_000, "", *nothing, 2055, 2053, 1676 + i % 2, 2010, 2263, row]
        for i, row in enumerate(quoted)
    ]
    one, _ = load_one(write(tmp_path / "hand.csv", header, rows))
    np.testing.assert_array_equal(one.electrodes, COUNTS)
    assert one.pdc[1] == 1677 and one.rate == pytest.approx(100, rel=1e-6)
    assert any("all electrodes are zero, no sensor there" in note for note in one.notes)


def test_other_numbers_of_electrodes_are_refused_by_name(tmp_path):
    path = write(tmp_path / "log.csv", [f"e{k + 1}" for k in range(22)], COUNTS[:, :22])
    with pytest.raises(
        ValueError, match="22 columns of electrodes, e1 to e22: a BioTac has 19 electrodes and"
    ):
        load_one(path)


def test_an_sp_s_missing_columns_are_named(tmp_path):
    names = [f"e{k + 1}" for k in range(24) if k != 6]
    path = write(tmp_path / "log.csv", names, np.delete(COUNTS, 6, axis=1))
    with pytest.raises(ValueError, match="no columns e7: its header must name e1..e24"):
        load_one(path)


def test_diagnose_takes_one_finger_and_says_which_it_is(tmp_path):
    rng, n = np.random.default_rng(0), 400
    columns = [f"{finger}_biotac_{k}" for finger in ("ff", "mf") for k in range(1, 25)]
    rest = np.r_[SP.rest_counts, SP.rest_counts - 50]
    rows = np.c_[0.01 * np.arange(n), rest + rng.normal(0, 4, (n, 48))]
    write(tmp_path / "log.csv", ["time", *columns], rows)
    first, second = (read_recording(tmp_path / "log.csv", which=name) for name in (None, "mf"))
    assert first.warnings[0].startswith("2 recordings are in") and "--recording takes" in first.warnings[0]
    assert not [line for line in second.warnings if "recordings are in" in line]
    assert first.design == second.design == SP
    np.testing.assert_allclose((first.electrodes - second.electrodes).mean(0), 50, atol=2)
    said = diagnose_recording(second, progress=False)
    assert said.data.startswith("read as BioTac SP (24 electrodes), 400 rows")
    assert said.details["recording"]["design"] == "biotac_sp"


@pytest.mark.parametrize("given", [2, 31])
def test_pac_has_the_frame_of_an_sp(tmp_path, given):
    pac = RNG.integers(2000, 2100, (200, given))
    header = [*(f"e{k + 1}" for k in range(24)), *(f"pac{k + 1}" for k in range(given))]
    one, _ = load_one(write(tmp_path / "log.csv", header, np.c_[COUNTS, pac]))
    assert one.pac.shape == (200, SP.npac) and np.isnan(one.pac[:, :-given]).all()
    np.testing.assert_array_equal(one.pac[:, -given:], pac)
    assert any("PAC has 2 of 31 samples of a frame" in note for note in one.notes) == (given == 2)
    write_recordings(tmp_path / "log.h5", [one])
    np.testing.assert_array_equal(load_one(tmp_path / "log.h5")[0].pac, one.pac)


def test_more_pac_than_a_frame_has_is_said(tmp_path):
    header = [*(f"e{k + 1}" for k in range(19)), *(f"pac{k + 1}" for k in range(31))]
    rows = np.c_[COUNTS[:, :19], RNG.integers(2000, 2100, (200, 31))]
    one, _ = load_one(write(tmp_path / "log.csv", header, rows))
    assert any("PAC has 31 samples of a frame, the last 22 are kept" in note for note in one.notes)


def test_the_spectrum_of_pac_counts_no_sample_twice():
    """Rows 10 ms apart, frames of 14 ms: a tone of 300 Hz is one line."""
    time = 0.01 * np.arange(1, 201)
    sample = np.floor(time[:, None] * 2200 + 1e-6) + np.arange(1 - SP.npac, 1)
    pac = np.round(2047 + 40 * np.sin(2 * np.pi * 300 / 2200 * sample))
    one = Recording(time, electrodes=COUNTS, pac=pac)
    frequency, power, _ = pac_spectrum(one)
    assert frequency[power.argmax()] == 300 and power.max() > 1e3 * np.sort(power)[-4]


def test_lines_of_a_serial_port_of_an_sp_need_no_names():
    lines = [b",".join(b"%d" % (2000 + k) for k in range(24)) + b"\n"] * 5
    (one,) = join(streams_of_lines("port", lines, 0.01 * np.arange(5), None))
    assert one.design == read_design("biotac_sp") and (one.electrodes == 2000 + np.arange(24)).all()


def test_a_recording_of_a_pad_of_one_s_own_is_refused_by_name():
    said = "own has 6 electrodes: a recording is one of a BioTac .19 .* or a BioTac SP .24"
    with pytest.raises(ValueError, match=said):
        Recording(0.01 * np.arange(3), electrodes=np.full((3, 6), 2000.0), name="own")


def named(path, prefix, count):
    header = ",".join(f"{prefix}e{i + 1}" for i in range(count))
    np.savetxt(path, np.full((9, count), 2e3), "%d", ",", header=header, comments="")
    return path


@pytest.mark.parametrize("prefix", ["biotac_sp_", "left/BioTacSP/", "BTSP-1 "])
def test_names_tell_an_sp_before_the_count_does(prefix, tmp_path):
    assert load_one(named(tmp_path / "log.csv", prefix, 24))[0].design == SP
    with pytest.raises(ValueError, match="19 electrodes called .*, and a BioTac SP .24 .* has more"):
        load_one(named(tmp_path / "log.csv", prefix, 19))


@pytest.mark.parametrize("prefix", ["biotac_", "bt_spare_", "grasp/bt_"])
def test_other_names_leave_it_to_the_count(prefix, tmp_path):
    for count in (19, 24):
        assert load_one(named(tmp_path / "log.csv", prefix, count))[0].design.nelectrode == count


def test_a_native_log_of_an_sp_is_told_by_its_serial_number(tmp_path):
    """Public logs of SPs have 19 of their electrodes, and count of rows alone makes a BioTac of them."""
    write_btd(tmp_path / "log.btd", synthetic(60))
    said = "serial number is that of a BioTac SP .24 electrodes., of which this log has 19"
    assert not any(re.search(said, note) for note in load_one(tmp_path / "log.btd")[0].notes)
    text = (tmp_path / "log.btd").read_bytes().replace(b"SYNTHETIC01", b"BTSP050400018017")
    (tmp_path / "sp.btd").write_bytes(text)
    assert any(re.search(said, note) for note in load_one(tmp_path / "sp.btd")[0].notes)


@pytest.mark.parametrize("count", [23, 18])
def test_a_clock_is_no_electrode(tmp_path, count):
    rng = np.random.default_rng(0)
    counts = rng.integers(2000, 2100, (200, count))
    np.savetxt(tmp_path / "log.txt", np.column_stack([0.01 * np.arange(200), counts]), fmt="%g")
    with pytest.raises(ValueError, match=f"as a clock does, which leaves {count} electrodes"):
        load(tmp_path / "log.txt")
