"""Importers, each on a small file written to the published layout; bad files are named."""

import csv

import h5py
import numpy as np
import pytest

from biotac_mj import cli
from biotac_mj.data import TactileSet, split_by_interaction
from biotac_mj.data.importers import import_recordings, interactions
from biotac_mj.recordings import Recording, load
from biotac_mj.recordings.formats.text import RUPPEL as RUPPEL_COLUMNS
from biotac_mj.sensor.channels import CHANNELS


def read(path, block=None, **options):
    """Interactions of a file."""
    return [one for recording in load(path, **options) for one in interactions(recording, block)]


def nvidia(path, lengths=(6, 4, 5, 7), seed=0, flat=False, **changes):
    """Trajectories of 0.1 mm steps at places some millimetres apart; indenter types 0, 0, 2, 5."""
    rng = np.random.default_rng(seed)
    location = np.concatenate(
        [
            rng.uniform(-5e-3, 5e-3, 3) + 5e-3 * k + 1e-4 * np.arange(n)[:, None] * [0, 1, 0]
            for k, n in enumerate(lengths)
        ]
    )
    n = len(location)
    kind = np.repeat([0, 0, 2, 5], lengths)
    data = dict(
        electrode_vals=rng.integers(1500, 3500, (n, 19)).astype(float),
        contact_loc=location,
        force_vec=rng.normal(size=(n, 3)),
        indenter_type=kind if flat else kind[:, None],
    )
    with h5py.File(path, "w") as file:
        for name, value in (data | changes).items():
            if value is not None:
                file[f"{name}/data"] = value
    return data


@pytest.mark.parametrize("flat", [True, False])
def test_files_of_nvidia_are_read(tmp_path, flat):
    data = nvidia(tmp_path / "biotac1.hdf5", flat=flat)
    ones = read(tmp_path / "biotac1.hdf5")
    assert [len(one.time) for one in ones] == [6, 4, 5, 7]
    assert [one.object for one in ones] == ["indenter_0", "indenter_0", "indenter_2", "indenter_5"]
    np.testing.assert_allclose(
        np.concatenate([one.measured_counts[:, :19] for one in ones]), data["electrode_vals"]
    )
    np.testing.assert_allclose(
        np.concatenate([one.measured_wrench[:, :3] for one in ones]), data["force_vec"], rtol=1e-6
    )
    np.testing.assert_allclose(np.concatenate([one.contact_pos for one in ones]), data["contact_loc"])
    assert all(
        np.isnan(one.measured_wrench[:, 3:]).all() and np.isnan(one.measured_counts[:, 19:]).all()
        for one in ones
    )
    assert (
        ones[2].parameters["notes"] == ["rows 10 to 14 of biotac1.hdf5"]
        and ones[0].kind == "recorded"
        and ones[0].labelled
    )
    names = [f"thing{k}" for k in range(6)]
    assert read(tmp_path / "biotac1.hdf5", objects=names)[3].object == "thing5"


def test_nvidia_trajectories_end_at_half_a_millimetre(tmp_path):
    location = np.array([0, 0.4e-3, 0.89e-3, 1.38e-3, 1.89e-3, 2.0e-3])[:, None] * [1, 0, 0]
    nvidia(
        tmp_path / "b.hdf5",
        contact_loc=location,
        electrode_vals=np.full((6, 19), 2000.0),
        force_vec=np.zeros((6, 3)),
        indenter_type=None,
    )
    assert [len(one.time) for one in read(tmp_path / "b.hdf5")] == [4, 2]


def test_nvidia_set_splits_by_trajectory(tmp_path):
    paths = []
    for k in (1, 2, 3):
        paths.append(tmp_path / f"biotac{k}.hdf5")
        nvidia(paths[-1], seed=k)
    assert import_recordings(paths, tmp_path / "set") == 12
    with TactileSet(tmp_path / "set") as data:
        assert len(data) == 12 and data.labelled.all() and data.nstep == 3 * 22
        assert set(data.split) == {"train", "validation", "test"}
        split = split_by_interaction(data, fractions=(0.5, 0.25, 0.25))
        assert len(split.test) == 3
        assert data.parameters(5)["source"] == "biotac2.hdf5"


@pytest.mark.parametrize(
    "changes, text",
    [
        (dict(electrode_vals=None), "has no electrode_vals/data: give an HDF5 file with"),
        (dict(force_vec=np.zeros((22, 6))), r"force_vec/data of .* has shape \(22, 6\), \(22, 3\) is needed"),
        (dict(indenter_type=np.zeros(7)), "indenter_type/data .* has 7 entries for 22 samples"),
        (dict(electrode_vals=np.full((22, 19), -3.5)), "e1 of row 0 is -3.5: raw counts 0..4095"),
    ],
)
def test_bad_nvidia_files_are_named(tmp_path, changes, text):
    nvidia(tmp_path / "b.hdf5", **changes)
    with pytest.raises(ValueError, match=text):
        read(tmp_path / "b.hdf5")


def test_missing_and_foreign_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="a.hdf5: no such file"):
        read(tmp_path / "a.hdf5")
    (tmp_path / "a.hdf5").write_text("no")
    with pytest.raises(ValueError, match="a.hdf5 is no .hdf5 file, whatever its name says"):
        read(tmp_path / "a.hdf5")
    nvidia(tmp_path / "b.hdf5")
    with pytest.raises(ValueError, match="has indenter type 2, but 2 object names were given"):
        read(tmp_path / "b.hdf5", objects=["a", "b"])


def ruppel(path, header=True, order=None, n=30):
    """30 rows at 10 ms with a gap of two seconds after 12 of them."""
    rng = np.random.default_rng(3)
    time = 100.0 + 0.01 * np.arange(n) + 2.0 * (np.arange(n) >= 12)
    value = np.column_stack(
        [
            time,
            rng.normal(0, 5e-3, (n, 3)),
            rng.normal(size=(n, 3)),
            rng.integers(1900, 2200, (n, 2)),
            rng.integers(1000, 3000, (n, 3)),
            rng.integers(1500, 3500, (n, 19)),
        ]
    )
    order = list(range(len(RUPPEL_COLUMNS))) if order is None else order
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        if header:
            writer.writerow([RUPPEL_COLUMNS[i] for i in order])
        writer.writerows([[f"{row[i]:.9g}" for i in order] for row in value])
    return value


@pytest.mark.parametrize("header, order", [(True, None), (False, None), (True, list(range(31))[::-1])])
def test_tables_of_ruppel_are_read(tmp_path, header, order):
    value = ruppel(tmp_path / "data.csv", header, order)
    ones = read(tmp_path / "data.csv")
    assert [len(one.time) for one in ones] == [12, 18]
    counts = np.concatenate([one.measured_counts for one in ones])
    np.testing.assert_allclose(counts[:, :19], value[:, 12:])
    for name, column in (("pac", 8), ("pdc", 9), ("tac", 10), ("tdc", 11)):
        np.testing.assert_allclose(counts[:, CHANNELS.index(name)], value[:, column])
    np.testing.assert_allclose(
        np.concatenate([one.measured_wrench[:, :3] for one in ones]), value[:, 4:7], rtol=1e-6
    )
    np.testing.assert_allclose(np.concatenate([one.contact_pos for one in ones]), value[:, 1:4], rtol=1e-8)
    np.testing.assert_allclose(np.concatenate([one.time for one in ones]), value[:, 0])


def test_bad_csv_is_named(tmp_path):
    path = tmp_path / "data.csv"
    path.write_text("time,px,py\n0,1,2\n")
    with pytest.raises(ValueError, match="data.csv has no rows, or no channel"):
        read(path)
    path.write_text("")
    with pytest.raises(ValueError, match="data.csv is empty"):
        read(path)
    ruppel(path)
    lines = path.read_text().splitlines()
    lines[4] = lines[4].replace(lines[4].split(",")[9], "many", 1)
    path.write_text("\n".join(lines))
    with pytest.raises(ValueError, match="data.csv, line 5: pdc is 'many', not a finite number"):
        read(path)


def test_text_files_of_counts_and_forces_are_joined(tmp_path):
    rng = np.random.default_rng(0)
    counts, force = rng.integers(1500, 3500, (50, 19)), rng.normal(size=(50, 3)).round(6)
    np.savetxt(tmp_path / "e.txt", counts, fmt="%d", newline=" \n")
    np.savetxt(tmp_path / "f.txt", force, fmt="%.6f", delimiter=",")
    (one,) = read(tmp_path / "e.txt", force=tmp_path / "f.txt", rate=100.0)
    np.testing.assert_array_equal(one.measured_counts[:, :19], counts)
    np.testing.assert_allclose(one.measured_wrench[:, :3], force, rtol=1e-6)
    assert one.time[-1] == pytest.approx(0.49)
    blocks = read(tmp_path / "e.txt", block=0.2, force=tmp_path / "f.txt")
    assert [len(b.time) for b in blocks] == [20, 20, 10] and blocks[1].time[0] == pytest.approx(0.2)
    (tmp_path / "g.txt").write_text("1 2 3\n")
    with pytest.raises(ValueError, match="e.txt has 50 rows and g.txt has 1"):
        read(tmp_path / "e.txt", force=tmp_path / "g.txt")
    (tmp_path / "g.txt").write_text("1 2 3 4\n")
    with pytest.raises(ValueError, match=r"g.txt, line 1: 4 columns, 19 are needed \(e1..e19\)"):
        read(tmp_path / "g.txt")


def test_the_command_says_what_it_has_read(tmp_path, capsys):
    nvidia(tmp_path / "biotac1.hdf5")
    out = str(tmp_path / "set")
    assert cli.main(["data", "import", str(tmp_path / "biotac1.hdf5"), "--out", out]) == 0
    said = capsys.readouterr().out
    assert "4 interactions, 22 time steps, objects indenter_0, indenter_2, indenter_5" in said
    np.savetxt(tmp_path / "e.txt", np.full((50, 19), 4095), "%d")
    assert "warning: " not in said
    assert cli.main(["data", "import", str(tmp_path / "e.txt"), "--out", str(tmp_path / "dead")]) == 0
    assert "warning: e: no electrode changes from 4095" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        cli.main(["data", "import", str(tmp_path / "biotac1.hdf5"), "--out", out])
    assert "is there already" in capsys.readouterr().err
    pytest.importorskip("torch")
    assert (
        cli.main(["learn", "train", out, "--out", str(tmp_path / "trained")]) == 2
    )  # nothing says how the skin moved
    assert (
        "has no column displacement, only" in capsys.readouterr().err and not (tmp_path / "trained").exists()
    )


def test_what_was_not_recorded_stays_away(tmp_path):
    """Tared electrodes are put on an assumed rest, which is said; a pose with a hole is none."""
    time = np.concatenate([np.arange(5), 100 + np.arange(5)]) / 100
    pos = np.zeros((10, 3))
    pos[7] = np.nan
    one = Recording(
        time,
        np.full((10, 19), -50.0),
        tdc=np.ones(10),
        object_pos=pos,
        units={"electrodes": "tared counts", "tdc": "tared counts"},
    )
    first, second = interactions(one)
    assert first.indenter_pos is not None and second.indenter_pos is None and first.measured_wrench is None
    assert (
        2000 < first.measured_counts[0, :19].mean() < 3500
        and "an assumption" in first.parameters["notes"][-1]
    )
    assert np.isnan(first.measured_counts[:, 19:]).all()


def test_real_flat_press_in_place(shared, tmp_path):
    folder = shared / "data" / "epfl_flat_press"
    assert (
        import_recordings(
            [folder / "SynImpF1.txt"],
            tmp_path / "set",
            block=10.0,
            force=folder / "ForceData.txt",
            rate=100.0,
        )
        == 23
    )
    with TactileSet(tmp_path / "set") as data:
        assert data.nstep == 22508
        force = data["measured_wrench"][:][:, :3]
        np.testing.assert_allclose(force, np.loadtxt(folder / "ForceData.txt"), rtol=1e-6)
        np.testing.assert_array_equal(data["measured_counts"][:][:, :19], np.loadtxt(folder / "SynImpF1.txt"))
