"""`biotac samples`: synthetic files in the forms that diagnose and train read, touched and not."""

import functools

import numpy as np
import pytest

from biotac_mj import cli, samples
from biotac_mj.data import TactileSet
from biotac_mj.recordings import load_one
from biotac_mj.recordings.own import rest_of
from biotac_mj.sensor.channels import REST_COUNTS


@pytest.mark.slow
def test_samples_are_what_the_verbs_read(tmp_path, capsys):
    folder = tmp_path / "samples"
    assert cli.main(["samples", str(folder), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert (
        said.startswith("synthetic") and f"biotac diagnose {folder}/log.csv --object sphere_7mm  # " in said
    )
    rows, _ = load_one(folder / "electrodes.txt", force=folder / "forces.txt")
    load = np.linalg.norm(rows.force, axis=1)
    assert len(rows) >= 800 and (load < 1e-9).mean() > 0.3 and (load > 0.3).mean() > 0.1
    logged, _ = load_one(folder / "log.csv")
    every = slice(0, samples._EVERY * len(logged), samples._EVERY)
    np.testing.assert_array_equal(logged.electrodes, rows.electrodes[every])
    assert logged.object_pos.shape == (len(logged), 3) and np.ptp(logged.object_pos, axis=0).min() > 1e-3
    with TactileSet(folder / "set") as made:
        assert len(made) == samples.TOUCHES == 20 and made.labelled.all() and made["converged"][:].all()
    words = ["--electrodes", f"{folder}/electrodes.txt", "--force", f"{folder}/forces.txt", "--quiet"]
    assert cli.main(["diagnose", *words, "--out", str(tmp_path / "report")]) == 0
    said = capsys.readouterr().out
    assert "named: shared impedance gain (warm-up)" in said.replace("  ", " ")  # samples.EFFECT, by name
    assert "not loaded" not in said  # touches long and slow enough to be taken for touches


@pytest.mark.slow
def test_touches_repeat_by_their_seed():
    one, two, other = (samples.record_touches(seed, touches=1) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.electrodes, two.electrodes)
    assert np.abs(one.object_pos[-1] - other.object_pos[-1]).max() > 1e-4
    assert np.linalg.norm(one.force, axis=1).max() > 0.1 > np.linalg.norm(one.force[:1000], axis=1).max()


def test_files_of_somebody_else_are_left(tmp_path, monkeypatch):
    whole = samples.record_touches
    recorded = functools.cache(lambda seed: whole(seed, touches=1))
    monkeypatch.setattr(samples, "record_touches", recorded)
    monkeypatch.setattr(samples, "resimulate", lambda *given, **more: None)
    samples.make_samples(tmp_path / "ours", progress=False)
    samples.make_samples(tmp_path / "ours", progress=False)  # the same: an interrupted set may go on
    with pytest.raises(ValueError, match=r"electrodes.txt is there and is no sample of seed 1: choose anoth"):
        samples.make_samples(tmp_path / "ours", seed=1, progress=False)
    (tmp_path / "log.csv").write_text("mine")
    with pytest.raises(ValueError, match=r"log.csv is there and is no sample of seed 0: choose another fold"):
        samples.make_samples(tmp_path, progress=False)
    assert (tmp_path / "log.csv").read_text() == "mine" and not (tmp_path / "forces.txt").exists()


def test_a_force_of_exactly_nothing_is_a_rest():
    """Simulated forces are 0 to the bit in most rows: these are the rest, not none of them."""
    touch = np.clip(np.sin(np.arange(600) / 40) - 0.5, 0, 1)
    counts = REST_COUNTS["1"] - np.linspace(50, 400, 19) * touch[:, None]
    force = np.column_stack([0 * touch, 0 * touch, -2 * touch])
    np.testing.assert_allclose(rest_of(counts, 100.0, force)["rest"], REST_COUNTS["1"], atol=1)
