"""The store of data sets: what is written is read, lazily and across shards; bad input is named."""

import dataclasses
import json

import h5py
import numpy as np
import pytest

from biotac_mj.data import (
    COLUMNS,
    Interaction,
    TactileSet,
    nodes_of,
    shard_path,
    split_by_interaction,
    split_by_object,
    write_shard,
)
from biotac_mj.data.lerobot import export_lerobot
from biotac_mj.data.schema import DISPLACEMENT_SCALE
from biotac_mj.data.splits import assign
from biotac_mj.data.trajectories import export_mujoco
from biotac_mj.geometry import load_skin
from biotac_mj.geometry.design import Design, read_design

PAD = Design(
    "pad",
    "pad (2 electrodes)",
    [[0, 0, -5], [3, 0, -5]],
    [[0, 5, 0]],
    sensor="a",
    sensors={"a": {"rest": [3000.0, 3000.0]}},
)
OBJECTS = ("sphere_7mm", "ring_7mm", "peg_round_6mm")


@pytest.fixture(scope="module")
def skin():
    return load_skin("coarse")


def make(skin, number, n=5, labelled=False, **changes):
    rng = np.random.default_rng(number)
    fields = dict(
        id=f"one-{number:03d}",
        object=OBJECTS[number % 3],
        kind="press",
        split="train",
        seed=number,
        parameters={"depth": 1e-3, "name": "x"},
        time=0.05 * np.arange(n),
        displacement=rng.normal(0, 3e-4, (n, skin.nvert, 3)).astype(np.float32),
        wrench=rng.normal(size=(n, 6)),
        contact_force=rng.normal(size=(n, len(nodes_of(skin)), 3)),
        pressure=rng.normal(size=n),
        impedance=rng.uniform(1e3, 1e4, (n, 19)),
        counts=rng.integers(0, 4096, (n, 23)),
        indenter_pos=rng.normal(size=(n, 3)),
        indenter_quat=rng.normal(size=(n, 4)),
        converged=rng.random(n) < 0.8,
    )
    if labelled:
        fields |= dict(measured_counts=rng.uniform(0, 4095, (n, 23)), measured_wrench=rng.normal(size=(n, 6)))
    return Interaction(**(fields | changes))


@pytest.fixture(scope="module")
def folder(skin, tmp_path_factory):
    """Three shards, 10 interactions of different lengths, the last shard labelled."""
    out = tmp_path_factory.mktemp("set")
    kept = []
    for shard, numbers in enumerate(([0, 1, 2, 3], [4, 5], [6, 7, 8, 9])):
        ones = [make(skin, k, n=3 + k, labelled=shard == 2) for k in numbers]
        write_shard(shard_path(out, shard), ones, skin, {"material": "default", "tier": "full"})
        kept += ones
    return out, kept


def test_everything_written_is_read(folder, skin):
    out, kept = folder
    with TactileSet(out) as data:
        assert len(data) == 10 and data.nstep == sum(len(one.time) for one in kept)
        assert data.attributes == {"material": "default", "tier": "full"} and data.versions["mujoco"]
        for i, one in enumerate(kept):
            back = data.interaction(i)
            assert (back.id, back.object, back.kind, back.split, back.seed, back.parameters) == (
                one.id, one.object, one.kind, one.split, one.seed, one.parameters)  # fmt: skip
            for name in COLUMNS:
                value, stored = getattr(one, name), getattr(back, name)
                assert (value is None) == (stored is None)
                if name == "displacement":
                    np.testing.assert_allclose(stored, value, atol=0.501 * DISPLACEMENT_SCALE, rtol=0)
                elif value is not None:
                    np.testing.assert_allclose(stored, value, rtol=1e-6)
        np.testing.assert_array_equal(data.geometry.elem, skin.elem)
        np.testing.assert_array_equal(data.geometry.electrode_pos, skin.electrode_pos)
        np.testing.assert_allclose(data.vert_xpos(7), skin.vert + data["displacement"][7], atol=1e-8)


def test_columns_index_like_numpy(folder):
    out, kept = folder
    whole = np.concatenate([one.wrench for one in kept]).astype(np.float32)
    rng = np.random.default_rng(0)
    with TactileSet(out) as data:
        column = data["wrench"]
        assert column.shape == whole.shape and column.dtype == whole.dtype
        indices = [
            3,
            -1,
            slice(None),
            slice(5, 40, 3),
            slice(40, 5, -2),
            rng.permutation(len(whole)),
            rng.integers(0, len(whole), 30),
            rng.random(len(whole)) < 0.3,
            np.zeros(0, int),
        ]
        for index in indices:
            np.testing.assert_array_equal(column[index], whole[index])
        with pytest.raises(IndexError):
            column[len(whole)]
        big = np.concatenate([one.displacement for one in kept])
        picked = rng.integers(0, len(big), 12)
        np.testing.assert_allclose(
            data["displacement"][picked], big[picked], atol=0.501 * DISPLACEMENT_SCALE, rtol=0
        )


def test_labels_are_nan_where_nothing_was_measured(folder):
    out, kept = folder
    with TactileSet(out) as data:
        np.testing.assert_array_equal(data.labelled, [False] * 6 + [True] * 4)
        measured = data["measured_counts"][:]
        has = np.isin(data.owner(), np.flatnonzero(data.labelled))
        assert np.isnan(measured[~has]).all()
        np.testing.assert_allclose(
            measured[has], np.concatenate([one.measured_counts for one in kept[6:]]), rtol=1e-6
        )
        assert data.steps([1, 8]).tolist() == [*range(3, 7), *range(data.start[8], data.stop[8])]
        assert data.steps(data.object == "ring_7mm").tolist() == [
            s for i in (1, 4, 7) for s in range(data.start[i], data.stop[i])
        ]


def test_same_arguments_give_the_same_bytes(skin, tmp_path):
    for name in ("a.h5", "b.h5"):
        write_shard(tmp_path / name, [make(skin, 0), make(skin, 1)], skin, {"seed": 3})
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    write_shard(tmp_path / "b.h5", [make(skin, 0), make(skin, 2)], skin, {"seed": 3})
    assert (tmp_path / "a.h5").read_bytes() != (tmp_path / "b.h5").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5", "b.h5"]  # no temporary files are left


def test_recordings_need_no_skin(tmp_path):
    one = Interaction(
        "r", "plate", "recorded", "test", 0, {}, np.arange(3.0), measured_counts=np.full((3, 23), 7.0)
    )
    write_shard(shard_path(tmp_path, 0), [one])
    with TactileSet(tmp_path) as data:
        assert data.columns == ("time", "measured_counts") and data.geometry is None
        with pytest.raises(ValueError, match="no column 'displacement': it has time, measured_counts"):
            data["displacement"]
        with pytest.raises(ValueError, match="no skin.*biotac data generate"):
            data.vert_xpos(0)


@pytest.mark.parametrize(
    "changes, text",
    [
        (dict(kind="poke"), "kind 'poke': choose one of press"),
        (dict(split="dev"), "split 'dev': choose one of train"),
        (dict(time=np.array([0.0, 0.1, 0.1, 0.2, 0.3])), "does not increase"),
        (dict(wrench=np.zeros((5, 3))), r"wrench of interaction 'one-000' has shape \(5, 3\): \(5, 6\)"),
        (dict(pressure=np.array([0, 1, np.nan, 3, 4])), "pressure .* NaN"),
        (dict(displacement=np.zeros((5, 7, 3))), r"displacement .* \(5, 7, 3\)"),
        (dict(displacement=None, contact_force=np.zeros((5, 2, 3))), "contact_force"),
    ],
)
def test_what_does_not_fit_is_named(skin, tmp_path, changes, text):
    with pytest.raises(ValueError, match=text):
        write_shard(tmp_path / "x.h5", [make(skin, 0, **changes)], skin)
    assert not list(tmp_path.iterdir())


def test_bad_shards_are_named(skin, tmp_path):
    with pytest.raises(ValueError, match="no interactions to write"):
        write_shard(tmp_path / "x.h5", [], skin)
    with pytest.raises(ValueError, match="'one-000' occurs twice"):
        write_shard(tmp_path / "x.h5", [make(skin, 0), make(skin, 0)], skin)
    with pytest.raises(ValueError, match="'one-001' has other columns than 'one-000'"):
        write_shard(tmp_path / "x.h5", [make(skin, 0), make(skin, 1, pressure=None)], skin)
    with pytest.raises(ValueError, match="displaced by 9.00 mm: the store reaches 8.19 mm"):
        write_shard(tmp_path / "x.h5", [make(skin, 0, displacement=np.full((5, skin.nvert, 3), 9e-3))], skin)


def test_bad_sets_are_named(skin, tmp_path):
    with pytest.raises(FileNotFoundError, match="no shards .*biotac data generate"):
        TactileSet(tmp_path)
    with pytest.raises(FileNotFoundError, match="no shards"):
        TactileSet(tmp_path / "absent.h5")
    (tmp_path / "shard-00000.h5").write_bytes(b"not a file of this kind")
    with pytest.raises(ValueError, match="is no readable shard"):
        TactileSet(tmp_path)
    write_shard(shard_path(tmp_path, 0), [make(skin, 0)], skin)
    with h5py.File(shard_path(tmp_path, 0), "a") as file:
        file.attrs["schema"] = "biotac_mj.data/0"
    with pytest.raises(ValueError, match="schema 'biotac_mj.data/0': this version reads 'biotac_mj.data/1'"):
        TactileSet(tmp_path)
    write_shard(shard_path(tmp_path, 0), [make(skin, 0)], skin)
    with h5py.File(shard_path(tmp_path, 0), "a") as file:
        file.attrs["channels"] = file.attrs["channels"][::-1]
    with pytest.raises(ValueError, match="channels in the order tac tdc pac pdc e19 .*: e1 e2 .* is needed"):
        TactileSet(tmp_path)
    write_shard(shard_path(tmp_path, 0), [make(skin, 0)], skin)
    write_shard(shard_path(tmp_path, 1), [make(skin, 0)], skin)
    with pytest.raises(ValueError, match="'one-000' occurs in two shards"):
        TactileSet(tmp_path)
    moved = dataclasses.replace(skin, vert=1.01 * skin.vert)
    write_shard(shard_path(tmp_path, 1), [make(moved, 1)], moved)
    with pytest.raises(ValueError, match="differs from .* in its skin"):
        TactileSet(tmp_path)


def test_splits_divide_interactions_and_objects(folder):
    out, _ = folder
    with TactileSet(out) as data:
        split = split_by_interaction(data, seed=1, fractions=(0.5, 0.25, 0.25))
        assert sorted(np.concatenate([split.train, split.validation, split.test]).tolist()) == list(range(10))
        for part in (split.train, split.validation, split.test):
            assert data.labelled[part].any() and not data.labelled[part].all()
        again = split_by_interaction(data, seed=1, fractions=(0.5, 0.25, 0.25))
        assert json.dumps([p.tolist() for p in dataclasses.astuple(again)]) == json.dumps(
            [p.tolist() for p in dataclasses.astuple(split)]
        )
        unseen = split_by_object(data, "ring_7mm")
        assert (data.object[unseen.test] == "ring_7mm").all() and (data.object == "ring_7mm").sum() == len(
            unseen.test
        )
        assert "ring_7mm" not in data.object[np.concatenate([unseen.train, unseen.validation])]
        with pytest.raises(
            ValueError, match="no object 'cube_14mm': it has peg_round_6mm, ring_7mm, sphere_7mm"
        ):
            split_by_object(data, "cube_14mm")
        with pytest.raises(ValueError, match="validation part of the split of .* is empty"):
            split_by_interaction(data, fractions=(0.9, 0.0, 0.1))


def test_a_split_has_the_fractions_of_the_paper():
    part = assign(359, seed=0)
    assert [int((part == name).sum()) for name in ("train", "validation", "test")] == [258, 65, 36]
    assert (assign(359, seed=0) == part).all() and (assign(359, seed=1) != part).any()
    with pytest.raises(ValueError, match="add up to 1"):
        assign(10, fractions=(0.5, 0.5, 0.5))


@pytest.mark.parametrize("design", [read_design("biotac_sp"), PAD], ids=lambda design: design.name)
def test_a_set_has_the_frame_of_its_design(tmp_path, design):
    n, counts = 3, np.full((3, len(design.channels)), 2000.0)
    pac = np.arange(n * design.npac).reshape(n, design.npac)
    pose = {"indenter_pos": np.zeros((n, 3)), "indenter_quat": np.tile([1.0, 0, 0, 0], (n, 1))}
    columns = pose | {"wrench": np.zeros((n, 6)), "counts": counts, "pac": pac, "measured_pac": pac}
    one = Interaction("a", "ball", "press", "train", 0, {}, 0.01 * np.arange(n), **columns)
    write_shard(shard_path(tmp_path / "set", 0), [one], design=design)
    with TactileSet(tmp_path / "set") as data:
        np.testing.assert_array_equal(data["pac"][:], pac)
        with pytest.raises(ValueError, match="the exported model is a BioTac"):
            export_mujoco(data, tmp_path / "models")
        pytest.importorskip("pyarrow")
        export_lerobot(data, tmp_path / "export", progress=False)
    features = json.loads((tmp_path / "export" / "meta" / "info.json").read_text())["features"]
    assert features["observation.tactile.pac"]["shape"] == [design.npac]
