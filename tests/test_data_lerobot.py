"""Export to LeRobot's layout, read back with pyarrow as its reader does; lerobot itself where it is
installed."""

import json

import h5py
import numpy as np
import pytest
from recorded import synthetic

from biotac_mj import cli
from biotac_mj.data import Interaction, TactileSet, shard_path, write_shard
from biotac_mj.data.lerobot import export_lerobot
from biotac_mj.recordings import write

parquet = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow: pip install 'biotac-mj[lerobot]'")


ORDER = [0, 2, 3, 1, 4]  # train, validation, test


def ordered(data):
    """Rows of the set in the order of the export."""
    return np.concatenate([np.arange(data.start[k], data.stop[k]) for k in ORDER])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two shards of five interactions, the second labelled; no skin, so that it is quick."""
    out = tmp_path_factory.mktemp("set")
    rng = np.random.default_rng(0)
    for shard, numbers in enumerate(([0, 1, 2], [3, 4])):
        ones = []
        for k in numbers:
            n = 6 + k
            label = (
                {"measured_counts": rng.uniform(0, 4095, (n, 23)), "measured_wrench": rng.normal(size=(n, 6))}
                if shard
                else {}
            )
            columns = dict(
                wrench=rng.normal(size=(n, 6)),
                counts=rng.integers(0, 4096, (n, 23)),
                contact_pos=np.where(np.arange(n)[:, None] > 1, rng.normal(size=(n, 3)), np.nan),
                contact_depth=rng.random(n),
                indenter_pos=rng.normal(size=(n, 3)),
                indenter_quat=rng.normal(size=(n, 4)),
                converged=np.arange(n) != 4,
                **label,
            )
            what, kind = ["ring_7mm", "sphere_7mm"][k % 2], ["press", "tap"][k // 3]
            split = ["train", "test", "train", "validation", "test"][k]
            ones.append(Interaction(f"{k:03d}", what, kind, split, k, {}, 0.05 * np.arange(n), **columns))
        write_shard(shard_path(out, shard), ones)
    return out


@pytest.fixture(scope="module")
def exported(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("export") / "lerobot"
    with TactileSet(folder) as data:
        export_lerobot(data, out, progress=False)
    return out


def test_the_documented_files_are_there(exported):
    files = sorted(p.relative_to(exported).as_posix() for p in exported.rglob("*") if p.is_file())
    assert files == [
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        "source.json",
    ]
    info = json.loads((exported / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 20 and info["chunks_size"] == 1000
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (5, 40, 4)
    assert info["data_path"].format(chunk_index=0, file_index=0) == files[0] and info["splits"] == {
        "train": "0:2",
        "validation": "2:3",
        "test": "3:5",
    }
    assert info["features"]["observation.tactile.electrodes"]["names"] == [f"e{i}" for i in range(1, 20)]
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
        assert info["features"][name]["shape"] == [1]


def test_frames_are_the_steps(exported, folder):
    table = parquet.read_table(exported / "data/chunk-000/file-000.parquet")
    info = json.loads((exported / "meta/info.json").read_text())
    assert set(table.column_names) == set(info["features"])
    for name, feature in info["features"].items():
        kind = str(table.schema.field(name).type)
        width = feature["shape"][0]
        assert kind == (
            {"float32": "float", "int64": "int64", "bool": "bool"}[feature["dtype"]]
            if width == 1
            else f"fixed_size_list<element: float>[{width}]"
        )
    rows = table.to_pydict()
    with TactileSet(folder) as data:
        order = ordered(data)
        np.testing.assert_array_equal(rows["observation.tactile.electrodes"], data["counts"][order][:, :19])
        np.testing.assert_array_equal(rows["observation.tactile.tac"], data["counts"][order][:, 22])
        pose = np.hstack([data["indenter_pos"][order], data["indenter_quat"][order]]).astype(np.float32)
        np.testing.assert_array_equal(rows["observation.state"], pose)
        # 0 where nothing touches, so that what normalises all rows has numbers
        touched = np.nan_to_num(data["contact_pos"][order])
        np.testing.assert_array_equal(rows["observation.contact.pos"], touched)
        np.testing.assert_array_equal(rows["observation.contact.depth"], data["contact_depth"][order])
        assert "observation.contact.area" not in rows and (touched == 0).all(1).any()
        np.testing.assert_array_equal(rows["converged"], data["converged"][order])
        length = (data.stop - data.start)[ORDER]
        np.testing.assert_array_equal(rows["episode_index"], np.repeat(np.arange(5), length))
        np.testing.assert_allclose(rows["timestamp"], data["time"][order], atol=1e-6)
        last = np.cumsum(length) - 1
        following = np.arange(data.nstep) + 1
        following[last] = last
        np.testing.assert_array_equal(rows["action"], pose[following])
    assert rows["index"] == list(range(40))


def test_episodes_and_tasks_point_where_they_should(exported, folder):
    episodes = parquet.read_table(exported / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    tasks = parquet.read_table(exported / "meta/tasks.parquet")
    names = dict(zip(tasks["task_index"].to_pylist(), tasks["task"].to_pylist()))
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    frames = parquet.read_table(exported / "data/chunk-000/file-000.parquet").to_pydict()
    with TactileSet(folder) as data:
        begun = 0
        for number, (k, row) in enumerate(zip(ORDER, episodes, strict=True)):
            length, begin = data.stop[k] - data.start[k], begun
            begun += length
            assert (row["episode_index"], row["length"]) == (number, length)
            assert (row["dataset_from_index"], row["dataset_to_index"]) == (begin, begun)
            assert (row["data/chunk_index"], row["data/file_index"], row["meta/episodes/file_index"]) == (
                0,
                0,
                0,
            )
            assert (
                row["tasks"]
                == [f"{data.kind[k]} with {data.object[k]}"]
                == [names[frames["task_index"][begin]]]
            )
            force = data["wrench"][data.start[k] : data.stop[k]]
            np.testing.assert_allclose(row["stats/observation.force/max"], force.max(0), rtol=1e-6)


def test_statistics_are_those_of_all_frames(exported, folder):
    stats = json.loads((exported / "meta/stats.json").read_text())["observation.tactile.electrodes"]
    with TactileSet(folder) as data:
        value = data["counts"][:][:, :19].astype(float)
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(stats[name], getattr(value, name)(0), rtol=1e-9)
    assert stats["count"] == [40]


def test_measured_counts_of_labelled_interactions(folder, tmp_path, capsys):
    assert (
        cli.main(["data", "export", str(folder), "--measured", "--quiet", "--out", str(tmp_path / "m")]) == 0
    )
    said = capsys.readouterr().out
    assert "LeRobotDataset v3.0" in said and "note: 2 of 19 time steps of the set did not converge" in said
    source = json.loads((tmp_path / "m/source.json").read_text())
    assert source["interaction"] == ["003", "004"] and source["force"] == "of the skin on the object"
    with TactileSet(folder) as data:
        assert source["frame"] == data.frame and data.frame.startswith("BioTac: tip at -x")
    rows = parquet.read_table(tmp_path / "m/data/chunk-000/file-000.parquet").to_pydict()
    with TactileSet(folder) as data:
        np.testing.assert_array_equal(
            rows["observation.tactile.electrodes"], data["measured_counts"][data.steps([3, 4])][:, :19]
        )
    with pytest.raises(SystemExit):
        cli.main(["data", "export", str(folder), "--quiet", "--out", str(tmp_path / "m")])
    assert "is there already" in capsys.readouterr().err


def test_a_recording_is_exported_with_what_it_has(tmp_path):
    """A synthetic log with a clock that shakes, a force without torque and no pose."""
    rng = np.random.default_rng(0)
    time = 0.01 * np.arange(50) + rng.uniform(-1e-3, 1e-3, 50)
    counts, force = rng.integers(2000, 3000, (50, 19)), rng.normal(size=(50, 3))
    log = tmp_path / "log.csv"
    head = ",".join(["time", *(f"e{i + 1}" for i in range(19)), "pdc", "Fx", "Fy", "Fz"])
    np.savetxt(log, np.c_[time, counts, counts[:, 0], force], "%.9g", ",", header=head, comments="")
    assert cli.main(["data", "import", str(log), "--out", str(tmp_path / "set")]) == 0
    assert cli.main(["data", "export", str(tmp_path / "set"), "--quiet", "--out", str(tmp_path / "o")]) == 0
    table = parquet.read_table(tmp_path / "o/data/chunk-000/file-000.parquet")
    np.testing.assert_array_equal(table["observation.tactile.electrodes"].to_pylist(), counts)
    np.testing.assert_allclose(table["observation.force"].to_pylist(), force, rtol=1e-5)
    np.testing.assert_array_equal(table["observation.tactile.pdc"].to_pylist(), counts[:, 0])
    info = json.loads((tmp_path / "o/meta/info.json").read_text())
    assert info["fps"] == 100
    features = {name for name in info["features"] if name.startswith(("observation", "action"))}
    assert features == {"observation.force", "observation.tactile.electrodes", "observation.tactile.pdc"}
    assert set(info["features"]) == set(table.column_names)
    source = json.loads((tmp_path / "o/source.json").read_text())
    assert source["synthetic"] is False and source["force"] == "as recorded"
    with h5py.File(tmp_path / "set/shard-00000.h5") as file:  # not the BioTac's, which nobody knows
        assert source["frame"] == file.attrs["frame"] == "the file's"


def test_all_of_pac_and_dropped_rows_of_a_recording(tmp_path):
    """A synthetic log at 100 Hz that lacks rows: frames hold the nearest; PAC keeps its 22 samples."""
    one = synthetic(n=60)
    write(tmp_path / "log.h5", [one.rows(np.r_[0:20, 24:60])])
    assert cli.main(["data", "import", str(tmp_path / "log.h5"), "--out", str(tmp_path / "set")]) == 0
    for out, words, n, hold in (("o", [], 60, 1), ("half", ["--rate", "50"], 30, 2)):
        words = ["data", "export", str(tmp_path / "set"), "--quiet", "--out", str(tmp_path / out), *words]
        assert cli.main(words) == 0
        table = parquet.read_table(tmp_path / out / "data/chunk-000/file-000.parquet").to_pydict()
        wanted = np.arange(0, 60, hold)
        wanted = np.where((wanted > 19) & (wanted < 24), np.where(wanted < 22, 19, 24), wanted)
        assert len(table["timestamp"]) == n
        np.testing.assert_array_equal(table["observation.tactile.pac"], one.pac[wanted])
        np.testing.assert_array_equal(table["observation.tactile.electrodes"], one.electrodes[wanted])
        assert json.loads((tmp_path / out / "meta/info.json").read_text())["fps"] == 100 // hold


def test_what_cannot_be_exported_is_named(tmp_path):
    one = Interaction("a", "x", "recorded", "test", 0, {}, np.arange(3.0), measured_counts=np.zeros((3, 23)))
    write_shard(shard_path(tmp_path / "s", 0), [one])
    with TactileSet(tmp_path / "s") as data, pytest.raises(ValueError, match="no column 'counts'"):
        export_lerobot(data, tmp_path / "o", progress=False)
    full = dict(
        wrench=np.zeros((3, 6)),
        counts=np.zeros((3, 23)),
        indenter_pos=np.zeros((3, 3)),
        indenter_quat=np.zeros((3, 4)),
    )
    write_shard(
        shard_path(tmp_path / "u", 0),
        [Interaction("a", "x", "press", "test", 0, {}, np.array([0, 0.1, 0.3]), **full)],
    )
    with TactileSet(tmp_path / "u") as data:
        with pytest.raises(ValueError, match="time steps of the set are not even"):
            export_lerobot(data, tmp_path / "o", progress=False)
        with pytest.raises(ValueError, match="no column 'measured_counts'"):
            export_lerobot(data, tmp_path / "o", "measured_counts", progress=False)
    row = {name: value[:1] for name, value in full.items()}
    write_shard(
        shard_path(tmp_path / "r", 0), [Interaction("a", "x", "press", "test", 0, {}, np.zeros(1), **row)]
    )
    with TactileSet(tmp_path / "r") as data, pytest.raises(ValueError, match="one row .* too few .* --rate"):
        export_lerobot(data, tmp_path / "o", progress=False)
    assert not (tmp_path / "o").exists() and not list(tmp_path.glob(".lerobot-*"))
    with TactileSet(tmp_path / "r") as data:
        export_lerobot(data, tmp_path / "o", rate=100, progress=False)  # as the refusal says
    assert json.loads((tmp_path / "o/meta/info.json").read_text())["total_frames"] == 1


def test_lerobot_reads_it(exported, monkeypatch):
    lerobot = pytest.importorskip(
        "lerobot.datasets.lerobot_dataset", reason="needs lerobot, which pins an older torch"
    )
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    data = lerobot.LeRobotDataset("local/biotac", root=exported)
    assert (
        len(data) == 40
        and data.num_episodes == 5
        and tuple(data[7]["observation.tactile.electrodes"].shape) == (19,)
    )
    assert data[7]["task"] == "press with sphere_7mm"
