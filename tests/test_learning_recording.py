"""`biotac learn judge --electrodes`: synthetic logs with known answers, leakage, and whatever files people
have."""

import json
import pathlib

import numpy as np
import pytest

from biotac_mj.cli import main
from biotac_mj.learning.instants.force import causal_average, fit_force
from biotac_mj.learning.instants.linear import best_ridge, ridge, ridges
from biotac_mj.learning.instants.real import evaluate_recording
from biotac_mj.recordings import load_one
from biotac_mj.sensor.channels import REST_COUNTS, counts_from_log_impedance, log_impedance

PRESS = pathlib.Path(__file__).parents[1] / "../shared/data/epfl_flat_press"


def synthetic_log(n=3000, drift=-0.2, seed=0):
    """Counts (n, 19) and force (n, 3): ln Z is linear in the force, and all electrodes drift together in ln
    Z."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    force = walk - causal_average(walk, 200.0)
    force /= force.std(0)
    log_z = log_impedance(REST_COUNTS["1"]) + force @ (0.05 * rng.normal(size=(3, 19)))
    log_z += (drift * (1 - np.exp(-np.arange(n) / n)))[:, None]
    return np.rint(np.clip(counts_from_log_impedance(log_z) + rng.normal(size=(n, 19)), 0, 4095)), force


def evaluated(electrodes, force, out, **settings):
    """What is said of these files."""
    recording, _ = load_one(electrodes, force=force)
    return evaluate_recording(recording, out, progress=False, **settings)


def write(folder, counts, force=None, delimiter=" "):
    np.savetxt(folder / "e.txt", counts, "%d", delimiter=delimiter)
    if force is not None:
        np.savetxt(folder / "f.txt", force)
    return folder / "e.txt", folder / "f.txt"


def test_log_impedance_and_back():
    counts = np.array([1.0, 500, 2047.5, 4000])
    np.testing.assert_allclose(counts_from_log_impedance(log_impedance(counts)), counts)
    assert log_impedance(2047.5) == 0
    assert np.isfinite(log_impedance(np.array([0.0, 4095]))).all()


def test_ridge_is_least_squares_and_ignores_constant_features():
    rng = np.random.default_rng(0)
    x = np.column_stack([rng.normal(size=(100, 4)), np.ones(100)])
    y = x[:, :4] @ rng.normal(size=(4, 2)) + 3
    w, b = ridge(x, y, 1e-12)
    np.testing.assert_allclose(x @ w + b, y, atol=1e-8)
    assert (w[4] == 0).all()


@pytest.mark.slow  # quick: the evaluation of a log
def test_drift_is_handled_where_plain_regression_fails():
    counts, force = synthetic_log()
    model = fit_force(counts, force, 2100)
    w, b = ridge(counts[:2100], force[:2100], 1e-4)
    plain = np.sqrt(((counts @ w + b - force)[2100:] ** 2).mean(0))
    ours = np.sqrt(((model.prediction - force)[2100:] ** 2).mean(0))
    assert (ours < plain).all() and ours.max() < 0.15


def test_each_ridge_is_the_least_of_its_own_sum():
    """Where the sum that it minimises has no slope, by weights and offset."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(60, 5)) * [1, 2, 0.1, 5, 1] + 3, rng.normal(size=(60, 2))
    strengths = (1e-4, 0.3, 2.0)
    for strength, (w, b) in zip(strengths, ridges(x, y, strengths)):
        left = y - x @ w - b
        np.testing.assert_allclose(left.mean(0), 0, atol=1e-12)
        np.testing.assert_allclose(x.T @ left / len(x), strength * x.var(0)[:, None] * w, atol=1e-12)


def test_the_best_ridge_is_that_of_groups_left_out():
    """A target that is each group's own noise wants the strongest ridge, one that follows x the weakest."""
    rng = np.random.default_rng(0)
    owner = np.repeat(np.arange(12), 10)
    x = rng.normal(size=(12, 6))[owner] + 0.01 * rng.normal(size=(120, 6))
    y = np.column_stack([x @ rng.normal(size=6), rng.normal(size=12)[owner]])
    strengths = (1e-6, 100.0)
    w, b = best_ridge(x, y, owner, strengths, 4)
    for column, strength in enumerate(strengths):
        wanted, offset = ridge(x, y[:, [column]], strength)
        np.testing.assert_allclose(w[:, column], wanted[:, 0], rtol=1e-9)
        assert b[column] == pytest.approx(offset[0])


def test_nothing_of_the_test_part_and_nothing_later_is_used():
    counts, force = synthetic_log(1200)
    whole = fit_force(counts, force, 800).prediction
    changed = force.copy()
    changed[800:] = 99  # its answers
    fewer = fit_force(counts[:1000], changed[:1000], 800)
    np.testing.assert_allclose(fewer.prediction, whole[:1000], atol=1e-12)


def test_evaluation_of_a_log_with_and_without_force(tmp_path):
    counts, force = synthetic_log(2400)
    counts[:, 5] = 4095  # a dead channel
    e, f = write(tmp_path, counts, force, ",")
    result = evaluated(e, f, tmp_path / "r.json", network=False)
    assert result == json.loads((tmp_path / "r.json").read_text()) and result["train_rows"] == 1680
    assert (tmp_path / "r.png").stat().st_size > 20_000
    # three forces and a drift fit into a code of 8: what is left is the noise of 1 count and rounding, less
    # what eight components take up
    assert result["reconstruction"]["models"]["pca8"]["test"]["rms"] < 1.2
    assert result["force_regression"]["models"]["drift_aware"]["rmse"][0] < 0.2
    assert any("e6 reads 0 or 4095 in 100.0 %" in note for note in result["notes"])
    result = evaluated(e, None, tmp_path / "r2.json", network=False)
    assert "force_regression" not in result and any("no force:" in note for note in result["notes"])


def test_a_force_that_does_not_change_is_not_judged(tmp_path):
    counts, force = synthetic_log(600)
    force[:, 1] = 0.0
    force[:420, 2] = 1.0  # the part that trains
    e, f = write(tmp_path, counts, force)
    result = evaluated(e, f, tmp_path / "r.json", network=False)
    json.loads((tmp_path / "r.json").read_text(), parse_constant=pytest.fail)  # NaN
    for row in result["force_regression"]["models"].values():
        assert row["rmse"][1] is None and row["r2"][1] is None and row["rmse"][0] > 0 and row["rmse"][2] > 0
    assert "Fy never changes: it is not judged" in result["notes"]
    assert any("Fz does not change in the training rows" in note for note in result["notes"])
    e, f = write(tmp_path, counts, 0 * force)
    with pytest.raises(ValueError, match="e: the force never changes, so that it cannot be learned"):
        evaluated(e, f, tmp_path / "r.json", network=False)


def test_verb_prints_a_table(tmp_path, capsys, monkeypatch):
    pytest.importorskip("torch")
    import biotac_mj.learning.instants.real as real

    monkeypatch.setattr(real, "_STEPS", (20, 20))
    counts, force = synthetic_log(800)
    e, f = write(tmp_path, counts, force)
    assert (
        main(["learn", "judge", str(e), "--force", str(f), "--json", str(tmp_path / "o.json"), "--quiet"])
        == 0
    )
    text = capsys.readouterr().out
    assert "electrode_vae" in text and "drift_aware" in text
    assert set(json.loads((tmp_path / "o.json").read_text())["reconstruction"]["models"]) >= {
        "pca8",
        "electrode_vae",
    }


def test_bad_files_are_named(tmp_path, capsys):
    counts, force = synthetic_log(600)
    e, f = write(tmp_path, counts, force)

    def refused(text, edit, force_file=None):
        rows = edit(e.read_text().splitlines())
        bad = tmp_path / "bad.txt"
        bad.write_text("\n".join(rows))
        with pytest.raises(ValueError, match=text):
            evaluated(bad, force_file, tmp_path / "never.json", network=False)

    refused(
        "line 3: 18 columns, 19 are needed as in line 1",
        lambda r: [*r[:2], " ".join(r[2].split()[:18]), *r[3:]],
    )
    refused(
        "line 4: e1 is 'nan', not a finite number",
        lambda r: [*r[:3], "nan " + " ".join(r[3].split()[1:]), *r[4:]],
    )
    refused(
        r"e1 of row \d+ is 5000: raw counts 0..4095 are needed",
        lambda r: ["5000 " + " ".join(r[0].split()[1:]), *r[1:]],
    )
    refused("line 1: e1 is 'x', not a finite number", lambda r: ["x " + " ".join(r[0].split()[1:]), *r[1:]])
    refused("has 100 rows: at least 400", lambda r: r[:100])
    refused("is empty", lambda r: ["# nothing"])
    refused("no electrode changes", lambda r: [r[0]] * 600)
    refused("bad.txt has 599 rows and f.txt has 600", lambda r: r[:-1], f)
    with pytest.raises(FileNotFoundError, match="no such file"):
        evaluated(tmp_path / "none.txt", None, tmp_path / "never.json")
    with pytest.raises(ValueError, match="fraction 0.99"):
        evaluated(e, None, tmp_path / "x.json", fraction=0.99)
    assert main(["learn", "judge"]) == 2 and "give one of a folder" in capsys.readouterr().err
    assert (
        main(["learn", "judge", str(tmp_path)]) == 2
        and "run `biotac learn train SET" in capsys.readouterr().err
    )


@pytest.mark.slow
@pytest.mark.skipif(not PRESS.is_dir(), reason="real recording ../shared/data/epfl_flat_press is not here")
def test_real_press_beats_the_bars(tmp_path):
    result = evaluated(PRESS / "SynImpF1.txt", PRESS / "ForceData.txt", tmp_path / "r.json")
    models = result["reconstruction"]["models"]
    assert models["electrode_vae"]["test"]["rms"] < 14.1
    assert (
        np.array(result["force_regression"]["models"]["drift_aware"]["rmse"]) < [0.235, 0.406, 0.340]
    ).all()
