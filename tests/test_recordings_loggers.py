"""What loggers of users leave: rows of units, cut lines, gaps, merged clocks, lists in cells, NumPy, MATLAB
and HDF5 files with names of their own. The sensor is synthetic."""

import h5py
import numpy as np
import pytest
import scipy.io
from recorded import synthetic, write_bag, write_btd

from biotac_mj import cli
from biotac_mj.geometry.design import BIOTAC
from biotac_mj.recordings import faults, load
from biotac_mj.recordings.formats.names import is_time, place_of
from biotac_mj.sensor.channels import log_impedance

ONE = synthetic()
NAMES = [f"e{i}" for i in range(1, 20)]
E, F, T = ONE.electrodes, ONE.force, ONE.time


def table(path, columns, names, *, units=None, cut=""):
    rows = [",".join("" if np.isnan(v) else f"{v:.6f}" for v in row) for row in np.column_stack(columns)]
    path.write_text("\n".join([",".join(names), *([",".join(units)] if units else []), *rows, cut]))
    return path


def read(*paths):
    (one,) = load(list(paths))
    return one


def said(one, text):
    assert any(text in note for note in one.notes), one.notes


def same(one, rows=slice(None)):
    np.testing.assert_allclose(one.electrodes, E[rows], atol=1e-5)
    np.testing.assert_allclose(one.time - one.time[0], T[rows] - T[rows][0], atol=1e-5)


def test_a_row_of_units_counts(tmp_path):
    units = ["ms", *["counts"] * 19, "mN", "mN", "mN"]
    one = read(
        table(tmp_path / "r.csv", [1e3 * T, E, 1e3 * F], ["time", *NAMES, "Fx", "Fy", "Fz"], units=units)
    )
    same(one)
    np.testing.assert_allclose(one.force, F, atol=1e-6)
    said(one, "line 2 was taken for units")


@pytest.mark.parametrize("cut", ["5.0", "5.0,2000,20"])
def test_a_last_line_that_was_cut_off_is_left_out(tmp_path, cut):
    one = read(table(tmp_path / "r.csv", [T, E], ["time", *NAMES], cut=cut))
    same(one)
    said(one, f"left out the last line, {len(E) + 2}, which was cut off")


def test_rows_that_lack_an_electrode_are_left_out(tmp_path):
    gaps = E.copy()
    gaps[7, 3], gaps[20:24] = np.nan, np.nan
    names = ["time", *NAMES, "Fx", "Fy", "Fz"]
    one = read(table(tmp_path / "r.csv", [T, gaps, F], names))
    rows = np.delete(np.arange(len(E)), [7, 20, 21, 22, 23])
    same(one, rows)
    np.testing.assert_allclose(one.force, F[rows], atol=1e-6)
    said(one, "1 rows lack an electrode, mostly e4: they were left out")
    said(one, "left out 4 rows that have no electrode")


@pytest.mark.parametrize("timed", [False, True])
@pytest.mark.parametrize("value", [np.nan, -1.0, 65535.0])
def test_a_dead_electrode_leaves_a_log_readable(value, timed, tmp_path):
    """Whatever a logger writes for it; it reads 0 then, which is named, and is a fault of that electrode."""
    dead = E.copy()
    dead[:, 4] = value
    columns, names = ([T, dead], ["time", *NAMES]) if timed else ([dead], [*NAMES])
    one = read(table(tmp_path / "r.csv", columns, names))
    np.testing.assert_array_equal(one.electrodes, np.where(np.arange(19) == 4, 0, E))
    said(one, "e5")
    said(one, "taken for dead, 0 there")
    assert [fault.channels for fault in faults(one) if fault.id == "stuck"] == [(4,)]
    assert one.rest_correlation == pytest.approx(correlation_without(4))


def correlation_without(k):
    here, known = (np.delete(log_impedance(of), k, -1) for of in (E, BIOTAC.rest_counts))
    return np.corrcoef(np.median(here, 0), known)[0, 1]


def test_an_electrode_that_broke_is_dead_from_then_on(tmp_path):
    broke = E.copy()
    broke[len(E) // 4 :, 4] = np.nan
    one = read(table(tmp_path / "r.csv", [T, broke], ["time", *NAMES]))
    np.testing.assert_array_equal(one.electrodes, np.nan_to_num(broke))
    said(one, "e5: no number in most rows: taken for dead, 0 there")


@pytest.mark.parametrize("lost", [False, True])
def test_rows_that_lack_an_electrode_were_not_lost_by_the_logger(lost, tmp_path):
    gaps = E.copy()
    gaps[40:44, slice(None) if lost else 3] = np.nan
    one = read(table(tmp_path / "r.csv", [T, gaps], ["time", *NAMES]))
    assert ("lost_rows" in [fault.id for fault in faults(one)]) == lost


def test_logs_that_were_merged_by_time(tmp_path):
    """Two sensors and a force plate, each with its own clock: no row has all."""
    plate = np.arange(T[0] - 0.1, T[-1] + 0.1, 0.004) + 0.0011
    pressed = np.column_stack([np.sin(plate), np.cos(plate), 2 * np.sin(plate)])
    clock = np.concatenate([T, T + 0.003, plate])
    cells = np.full((len(clock), 41), np.nan)
    cells[: len(T), :19], cells[len(T) : 2 * len(T), 19:38], cells[2 * len(T) :, 38:] = E, E + 2, pressed
    order = np.argsort(clock)
    names = ["time", *(f"ff_{n}" for n in NAMES), *(f"th_{n}" for n in NAMES), "Fx", "Fy", "Fz"]
    ff, th = load(table(tmp_path / "all.csv", [clock[order], cells[order]], names))
    for one, late, more in ((ff, 0, 0), (th, 0.003, 2)):
        np.testing.assert_allclose(one.time, T + late, atol=1e-5)
        np.testing.assert_allclose(one.electrodes, E + more, atol=1e-5)
        np.testing.assert_allclose(one.force[:, 0], np.sin(one.time), atol=1e-4)
        said(one, "interpolated from 250 Hz")


@pytest.mark.parametrize("form", ["[{}]", "({})", "[{}\n]"])
def test_lists_in_cells_are_columns(tmp_path, form):
    rows = [f'{t:.3f},"{form.format(", ".join(f"{v:g}" for v in row))}",7' for t, row in zip(T, E)]
    (tmp_path / "r.csv").write_text("\n".join(["Time,bt.electrode_data,pdc", *rows]))
    same(read(tmp_path / "r.csv"))


def test_what_clocks_and_counts_are_called():
    names = [
        "datetime",
        "rosbagTimestamp",
        "Time_Stamp",
        "elapsed time (ms)",
        "time_msec",
        "Time [sec]",
        "t_us",
    ]
    assert all(map(is_time, names))
    assert not any(map(is_time, ["sample", "date", "runtime", "duration", "time_constant", "tx"]))
    assert place_of("PDC (counts)").field == "pdc" and place_of("e7 [bits]").column == 7
    assert place_of("PDC (kPa)") is None


def test_milliseconds_by_a_longer_name(tmp_path):
    one = read(table(tmp_path / "r.csv", [2e3 * T, E], ["elapsed time (msec)", *NAMES]))  # half the rate
    np.testing.assert_allclose(one.time, 2 * T, atol=1e-5)


def test_of_two_clocks_the_one_that_can_be_read(tmp_path):
    path = table(tmp_path / "r.csv", [T, T, E], ["timestamp", "time", *NAMES])
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *("3/5/24 12:30," + row.partition(",")[2] for row in rows)]))
    same(read(path))


def test_a_column_like_a_clock_is_said(tmp_path):
    one = read(table(tmp_path / "r.csv", [T, E], ["Zeit", *NAMES]))
    said(one, "Zeit increases from row to row: call it time if it is the clock")
    one = read(table(tmp_path / "n.csv", [np.arange(len(T)), E], ["number", *NAMES]))
    assert not any("increases" in note for note in one.notes)


@pytest.mark.parametrize("names", [True, False])
def test_files_of_numpy_are_read(tmp_path, names):
    if names:
        np.savez(tmp_path / "r.npz", electrodes=E, force=F, time=T, other=np.array("x"))
        one = read(tmp_path / "r.npz")
        np.testing.assert_allclose(one.force, F)
        said(one, "left out other")
    else:
        np.save(tmp_path / "r.npy", np.column_stack([T, E]))
        one = read(tmp_path / "r.npy")
    same(one)


@pytest.mark.parametrize("form", ["datetime64", "timedelta64", "words"])
def test_numpy_clock_of_dates(tmp_path, form):
    since = np.rint(1e9 * T).astype("m8[ns]")
    date = np.datetime64("2026-01-31T12:34:56") + since
    clock = {"datetime64": date, "timedelta64": since, "words": date.astype(str)}[form]
    np.savez(tmp_path / "r.npz", electrodes=E, time=clock)
    same(read(tmp_path / "r.npz"))


@pytest.mark.parametrize(
    ("value", "text"), [(np.array([{}, 1]), "no NumPy file"), (np.zeros((2, 3, 19)), r"shape \(2, 3, 19\)")]
)
def test_numpy_that_is_no_table(tmp_path, value, text):
    np.save(tmp_path / "r.npy", value, allow_pickle=True)
    with pytest.raises(ValueError, match=text):
        load(tmp_path / "r.npy")


def test_a_spreadsheet_is_said(tmp_path):
    (tmp_path / "r.xlsx").write_bytes(b"PK\x03\x04" + bytes(300))
    with pytest.raises(ValueError, match="save its table as CSV"):
        load(tmp_path / "r.xlsx")


def test_hdf5_of_ones_own(tmp_path):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["electrodes"], file["force"], file["time"] = E, F, T
    same(read(tmp_path / "r.h5"))
    with h5py.File(tmp_path / "trials.h5", "w") as file:
        for k, rows in enumerate((slice(0, 100), slice(100, 300))):
            file[f"trial{k}/electrodes"], file[f"trial{k}/time"] = E[rows], T[rows]
    first, second = load(tmp_path / "trials.h5")
    same(first, slice(0, 100))
    same(second, slice(100, 300))


def test_matlab_with_names_of_ones_own(tmp_path):
    scipy.io.savemat(tmp_path / "r.mat", {"data": {"E": E, "Pdc": np.full(len(E), 1500.0), "t": T}})
    one = read(tmp_path / "r.mat")
    same(one)
    said(one, "E, the only array of as many, was taken for the electrodes")


@pytest.mark.parametrize("cells", [True, False])
def test_trials_of_a_matlab_file(tmp_path, cells):
    parts = [slice(0, 100), slice(100, 300)]
    if cells:
        held = {name: np.empty(2, object) for name in ("electrodes", "time")}
        for k, rows in enumerate(parts):
            held["electrodes"][k], held["time"][k] = E[rows], T[rows]
    else:
        kinds = [("electrodes", "O"), ("time", "O")]
        held = {"trial": np.array([(E[rows], T[rows]) for rows in parts], dtype=kinds)}
    scipy.io.savemat(tmp_path / "r.mat", held)
    first, second = load(tmp_path / "r.mat")
    same(first, parts[0])
    same(second, parts[1])
    assert first.name != second.name


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("more", [b"", b" 0 0 0 0"])
def test_the_log_of_the_library_in_c(tmp_path, timed, more):
    """Lines of a .btd without its header, of three sensors or five; times only if it was built so."""
    write_btd(tmp_path / "t.btd", ONE.rows(slice(0, 40)))
    lines = (tmp_path / "t.btd").read_bytes().partition(b"Begin File")[2].split(b"\n")[1:]
    if not timed:
        lines = [b"0.000000 " + line.split(b" ", 1)[1] for line in lines if line.strip()]
    (tmp_path / "output.txt").write_bytes(b"\n".join(line + more + b" " for line in lines if line.strip()))
    one = read(tmp_path / "output.txt")
    same(one, slice(0, 40))
    np.testing.assert_allclose(one.pac, ONE.pac[:40])
    assert any("no times: frames are 10 ms long" in note for note in one.notes) != timed


def rostopic(folder, finger, changes=0.0):
    """A field of each channel, as `rostopic echo -b BAG -p TOPIC` prints it."""
    stamps = np.rint(1e9 * (1.6e9 + T)).astype(np.int64)
    for name, value in (("electrode", E), ("pac", ONE.pac), ("pdc", ONE.pdc), ("tac", ONE.tac)):
        value = value.reshape(len(T), -1) + changes
        names = ["field"] if value.shape[1] == 1 else [f"field{k}" for k in range(value.shape[1])]
        rows = [",".join([str(t), *(f"{v:.0f}" for v in row)]) for t, row in zip(stamps, value)]
        (folder / f"run_{name}{finger}.txt").write_text("\n".join([",".join(["%time", *names]), *rows]))
    return sorted(folder.glob(f"run_*{finger}.txt"))


def test_fields_of_a_topic_as_rostopic_prints_them(tmp_path):
    first, second = rostopic(tmp_path, 1), rostopic(tmp_path, 2, 5.0)
    one = read(*first)
    same(one)
    for found, more in ((one, 0), *zip(load([*first, *second]), (0, 5))):
        for name in ("electrodes", "pac", "pdc", "tac"):
            wanted = np.rint(getattr(ONE, name)) + more
            np.testing.assert_allclose(getattr(found, name), wanted, atol=1e-5, err_msg=name)


def test_other_channels_of_another_time_stay_alone(tmp_path):
    table(tmp_path / "e.csv", [T, E], ["time", *NAMES])
    table(tmp_path / "p.csv", [T + 1e5, ONE.pdc], ["time", "pdc"])
    first, second = load([tmp_path / "e.csv", tmp_path / "p.csv"])
    assert first.fields == ["electrodes"] and second.fields == ["pdc"]


def test_verbs_take_hdf5_of_ones_own_and_bags_that_are_folders(tmp_path, capsys):
    """What is said is that of a recording: too few rows."""
    pytest.importorskip("rosbags")
    bag = write_bag(tmp_path, ONE.rows(slice(0, 50)), "SQLITE3")
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["electrodes"], file["time"] = E[:50], T[:50]
    for source in (bag, tmp_path / "r.h5"):
        for verb in ("diagnose", "learn judge"):
            assert cli.main([*verb.split(), str(source)]) == 2
            assert "50 rows" in capsys.readouterr().err, (verb, source)
