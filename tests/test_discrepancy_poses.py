"""Recordings with poses on their way to a diagnosis (synthetic: nobody measured them)."""

import dataclasses
import json
import pathlib
import sys
import types

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biotac_mj.discrepancy import Trajectory
from biotac_mj.discrepancy.report.verdict import Gap, Verdict
from biotac_mj.discrepancy.trajectories.recorded import trajectories_of
from biotac_mj.discrepancy.trajectories.trajectory import read_trajectories, write_trajectories
from biotac_mj.geometry import load_skin
from biotac_mj.press.approach import surface_point
from biotac_mj.recordings import Recording, faults, load
from biotac_mj.sensor.channels import REST_COUNTS

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "benchmarks"))

DEPTHS = (0.6e-3, 1.0e-3, 0.8e-3)


def presses():
    """Three presses of a sphere from 2 mm away at 100 Hz in the BioTac's frame; force on the sensor."""
    point, normal = surface_point(load_skin("coarse"), -0.008, 0.1)
    way = [
        np.concatenate([np.linspace(-2e-3, d, 60), np.full(20, d), np.linspace(d, -2e-3, 60)]) for d in DEPTHS
    ]
    depth = np.concatenate(way)
    rng = np.random.default_rng(0)
    force = 800 * np.maximum(depth, 0)[:, None] * -normal
    turn = Rotation.align_vectors([-normal], [[0.0, 1.0, 0.0]])[0]
    n = len(depth)
    return Recording(
        np.arange(n) / 100,
        electrodes=np.rint(
            REST_COUNTS["1"] - 2e5 * np.maximum(depth, 0)[:, None] + rng.normal(0, 2, (n, 19))
        ),
        pdc=np.rint(2000 + 1e5 * np.maximum(depth, 0)),
        force=force,
        object_pos=point - np.outer(depth, normal),
        object_quat=np.tile(np.roll(turn.as_quat(), 1), (n, 1)),
        name="three",
        object="sphere_7mm",
    )


def test_a_recording_is_cut_into_its_contacts():
    found, notes = trajectories_of([presses()])
    assert len(found) == 3 and any("turned round" in note for note in notes)
    for t, depth in zip(found, DEPTHS):
        assert len(t.time) <= 41 and abs(t.depth.max() - depth) < 0.06e-3  # from the last row before touch
        assert (t.force @ t.heading).min() < -0.4 and t.depth[-1] <= 0 and t.pdc is not None and t.tdc is None
    clocks = [t.clock for t in found]
    assert np.all(np.diff(clocks) > 1.0)


def test_row_0_is_at_rest_if_the_pose_is_off_by_over_a_row(tmp_path):
    """The object is 0.15 mm deeper than it says, as with other poses and a skin that bulges; the depth still
    counts from the row before the touch, and a file keeps that."""
    one = presses()
    depth = np.concatenate(
        [
            np.concatenate([np.linspace(-2e-3, d, 60), np.full(20, d), np.linspace(d, -2e-3, 60)])
            for d in DEPTHS
        ]
    )
    counts = np.rint(REST_COUNTS["1"] - 2e5 * np.maximum(depth + 0.15e-3, 0)[:, None])
    found, _ = trajectories_of([dataclasses.replace(one, electrodes=np.tile(counts[:, :1], (1, 19)))])
    write_trajectories(tmp_path / "three.h5", found)
    for t, again, deepest in zip(found, read_trajectories(tmp_path / "three.h5"), DEPTHS, strict=True):
        assert np.all(t.electrodes[0] == counts[0, 0]) and np.all(t.electrodes[t.touch] < counts[0, 0] - 10)
        assert t.touch == 1 and t.depth[0] == t.depth[1] == 0 and abs(t.depth.max() - deepest) < 0.06e-3
        np.testing.assert_allclose(again.depth, t.depth, atol=1e-9)


def test_the_way_to_another_place_is_no_part_of_a_contact():
    """A logger that drops rows: a jump over the finger right after the release, else the skin would be
    dragged through it; of short contacts every row is kept."""
    one = presses()
    here = np.r_[0:55:6, 55:90:2, 90:140:6]  # of the first press
    rows = np.concatenate([here + 140 * k for k in range(3)])
    away = rows % 140 > 134
    pos = one.object_pos[rows] + np.outer(away, [0.0, 0.0, 0.02])
    cut = {k: getattr(one, k)[rows] for k in ("time", "electrodes", "pdc", "force", "object_quat")}
    found, _ = trajectories_of([dataclasses.replace(one, object_pos=pos, **cut)])
    assert len(found) == 3
    for t in found:
        assert np.linalg.norm(np.diff(t.pos, axis=0), axis=1).max() < 2e-3 and t.depth[-1] < 0
        assert np.isclose(np.diff(t.time), 0.02).sum() == 17


def test_the_sensors_pose_takes_object_and_force_to_its_frame():
    here = presses()
    turn, shift = Rotation.from_rotvec([0.3, -0.8, 0.5]), np.array([0.4, -0.1, 0.2])
    quat = (turn * Rotation.from_quat(np.roll(here.object_quat, -1, axis=1))).as_quat()
    there = dataclasses.replace(
        here,
        object_pos=turn.apply(here.object_pos) + shift,
        object_quat=np.roll(quat, 1, axis=1),
        force=turn.apply(here.force),
        sensor_pos=np.tile(shift, (len(here), 1)),
        sensor_quat=np.tile(np.roll(turn.as_quat(), 1), (len(here), 1)),
    )
    for a, b in zip(trajectories_of([here])[0], trajectories_of([there])[0], strict=True):
        np.testing.assert_allclose(a.pos, b.pos, atol=1e-12)
        np.testing.assert_allclose(a.force, b.force, atol=1e-9)


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(object_quat=None), "lacks the object's pose: give object_pos_x"),
        (dict(object=""), "add --object"),
        (dict(object="teapot"), "unknown object 'teapot'"),
        (dict(object_pos=presses().object_pos + 0.03), "never meets the skin, the smallest gap is"),
    ],
)
def test_what_cannot_be_used_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        trajectories_of([dataclasses.replace(presses(), **change)])


def as_csv(path, one):
    """Writes a recording with poses and returns its path."""
    columns = {"time": one.time, **{f"e{k + 1}": one.electrodes[:, k] for k in range(19)}, "pdc": one.pdc}
    columns |= {f"F{a}": one.force[:, k] for k, a in enumerate("xyz")}
    columns |= {f"object_pos_{a}": one.object_pos[:, k] for k, a in enumerate("xyz")}
    columns |= {f"object_q{a}": one.object_quat[:, k] for k, a in enumerate("wxyz")}
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    return path


def test_a_csv_with_poses_goes_to_the_workflow_with_poses(tmp_path, monkeypatch):
    """From the file to what is diagnosed, with the skin, object and repeatability of the command line."""
    from biotac_mj.cli import main
    from biotac_mj.discrepancy.trajectories import workflow

    one = presses()
    path = as_csv(tmp_path / "three.csv", one)
    assert load(path)[0].object_pos is not None
    seen = {}

    def diagnose(sim, data, **settings):
        seen.update(sim=sim, data=data, **settings)
        raise ValueError("enough")

    monkeypatch.setattr(workflow, "diagnose", diagnose)
    out = ["--out", str(tmp_path / "report"), "--quiet"]
    main(
        ["diagnose", str(path), "--object", "sphere_7mm", "--skin", "fine", "--repeatability", "0.2mm", *out]
    )
    expected = trajectories_of([one])[0]
    assert (
        seen["sim"].skin == "fine" and seen["repeatability"] == 0.2e-3 and len(seen["data"]) == len(expected)
    )
    for a, b in zip(seen["data"], expected):
        np.testing.assert_allclose(a.pos, b.pos, atol=1e-8)
        np.testing.assert_allclose(a.electrodes, b.electrodes)


def test_a_verdict_on_poses_warns_of_all_that_import_names(tmp_path, monkeypatch):
    """An electrode that stands still for a second. No effect is searched."""
    from biotac_mj.cli import main
    from biotac_mj.discrepancy.trajectories import workflow

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Found(Verdict):
        beliefs: object

    def diagnose(sim, data, **settings):
        beliefs = types.SimpleNamespace(save=lambda *_: None)
        words = dict.fromkeys(("kind", "name", "data", "aside"), "none")
        return Found(
            **words, significant=False, effects=[], gap={"force": Gap("N", 1.0, 1.0, 1.0)}, beliefs=beliefs
        )

    monkeypatch.setattr(workflow, "diagnose", diagnose)
    one, out = presses(), tmp_path / "report"
    one.electrodes[100:200, 4] = one.electrodes[100, 4]
    path = as_csv(tmp_path / "three.csv", one)
    assert main(["diagnose", str(path), "--object", "sphere_7mm", "--out", str(out), "--quiet"]) == 0
    said = faults(load(path)[0])
    assert any("e5" in fault.message for fault in said)
    verdict = json.loads((out / "verdict.json").read_text())
    assert verdict["warnings"] == [f"three: {fault.message}" for fault in said]


def test_plans_of_the_generator_are_trajectories():
    """A clock with a gap is refused, so no plan of any seed may have one."""
    from discrepancy_generator import plan

    for one in (p for seed in range(12) for p in plan(seed, 16)):
        n = len(one["time"])
        Trajectory(
            one["id"],
            one["tool"],
            one["clock"],
            one["time"],
            one["pos"],
            np.tile(one["turn"], (n, 1, 1)),
            np.full((n, 19), 2000.0),
        )
        np.testing.assert_allclose(one["turn"][:, 1], one["heading"], atol=1e-6)


def test_rivals_find_what_is_linear_and_planted():
    """Blocks of noise as a library: sparse regression and BIC take the two that are in the data, and sparse
    regression, which asks trajectories left out, takes none where there is none."""
    from discrepancy_rivals import _bic, _sparse, f1

    rng = np.random.default_rng(0)
    library = [(None, {}, rng.standard_normal((600, 2))) for _ in range(8)]
    noise, owner = rng.standard_normal(600), np.arange(600) // 50
    planted = 2 * library[2][2][:, 0] - 1.5 * library[5][2][:, 1] + noise
    assert set(_sparse(library, planted, owner)) == set(_bic(library, planted)) == {2, 5}
    assert _sparse(library, noise, owner) == _bic(library, noise) == []
    assert f1({1, 2}, {2, 3}) == 0.5 and f1(set(), set()) == 1.0


@pytest.mark.slow
@pytest.mark.xfail(reason="a latency in data of the other tier has no name", strict=True)
def test_a_csv_with_poses_is_diagnosed(tmp_path):
    """From a CSV (synthetic: this project's skin, a hidden latency, another modulus) to the verdict."""
    from biotac_mj.cli import main
    from biotac_mj.discrepancy import Simulator
    from biotac_mj.effects.catalogue import by_id

    sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "examples"))
    from find_the_missing_effect import measure, presses

    data = measure(Simulator(), presses(16, 0)[::2], (by_id("latency"), {"delay": 0.08}), 1)
    rows = [
        np.column_stack(
            [
                t.clock + t.time,
                t.electrodes,
                t.pdc,
                -t.force,
                t.pos,
                np.roll(Rotation.from_matrix(t.mat).as_quat(), 1, axis=1),
            ]
        )
        for t in data
    ]
    names = ["time", *(f"e{k + 1}" for k in range(19)), "pdc", "Fx", "Fy", "Fz"]
    names += [f"object_pos_{a}" for a in "xyz"] + [f"object_q{a}" for a in "wxyz"]
    path, out = tmp_path / "log.csv", tmp_path / "report"
    np.savetxt(path, np.concatenate(rows), delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    settings = ["--object", "sphere_7mm", "--skin", "coarse", "--repeatability", "0.03mm"]
    assert main(["diagnose", str(path), *settings, "--out", str(out), "--quiet"]) == 0
    verdict = json.loads((out / "verdict.json").read_text())
    assert [e["id"] for e in verdict["effects"]] == ["latency"] and verdict["share_closed"] > 0.8
    assert verdict["repeatability_m"] >= 3e-5  # trials may scatter more than stated
    assert any("turned round" in note for note in verdict["cannot_be_known"])
    value = verdict["effects"][0]["parameters"][0]
    assert value["interval95"][0] < 0.08 < value["interval95"][1]
