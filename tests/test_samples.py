"""`biotac data samples`: synthetic files in the forms that diagnose and train read, touched and not."""

import pathlib
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest

from biotac_mj import cli, samples
from biotac_mj.data import TactileSet
from biotac_mj.discrepancy import PlainRecording, diagnose_recording
from biotac_mj.learning.instants.examples import from_recording
from biotac_mj.learning.instants.reader import judge_in_time
from biotac_mj.learning.instants.real import evaluate_recording
from biotac_mj.recordings import load_one, of_simulation
from biotac_mj.recordings.own import rest_of
from biotac_mj.samples import simulated
from biotac_mj.samples.contents import EVERY
from biotac_mj.sensor.channels import REST_COUNTS


def test_samples_are_what_the_verbs_read(tmp_path, capsys):
    folder = tmp_path / "samples"
    assert cli.main(["data", "samples", str(folder), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert (
        said.startswith("synthetic") and f"biotac diagnose {folder}/log.csv --object sphere_7mm  # " in said
    )
    rows, _ = load_one(folder / "electrodes.txt", force=folder / "forces.txt")
    load = np.linalg.norm(rows.force, axis=1)
    assert len(rows) >= 800 and (load < 1e-9).mean() > 0.3 and (load > 0.3).mean() > 0.1
    logged, _ = load_one(folder / "log.csv")
    every = slice(0, EVERY * len(logged), EVERY)  # of the first round
    np.testing.assert_array_equal(logged.electrodes, rows.electrodes[every])
    assert logged.object_pos.shape == (len(logged), 3) and np.ptp(logged.object_pos, axis=0).min() > 1e-3
    with TactileSet(folder / "set") as made:
        assert len(made) == samples.TOUCHES == 50 and made.labelled.all() and made["converged"][:].all()


def test_commands_that_verbs_print_run_as_they_stand(tmp_path, capsys):
    """In a folder with a space too: those of samples, of an import and of a checkup."""
    folder = tmp_path / "my samples"
    assert cli.main(["data", "samples", str(folder), "--quiet"]) == 0
    log, protocol = str(folder / "my log.h5"), str(folder / "my protocol.yaml")
    assert cli.main(["recording", "import", str(folder / "log.csv"), "--out", log]) == 0
    assert cli.main(["checkup", "--out", protocol]) == 0
    printed = re.findall(r"\bbiotac ((?:diagnose|learn|recording) [^`\n]*)", capsys.readouterr().out)
    words = [shlex.split(line, comments=True) for line in printed]
    for line in words:
        cli.parser().parse_args(line)
    paths = [word for line in words for word in line if word.startswith(str(tmp_path))]
    assert len(words) == 6 and len(paths) == 8 and all(pathlib.Path(path).exists() for path in paths)


@pytest.mark.parametrize("rows", [slice(None), slice(6000)])
def test_the_samples_without_force_show_the_warm_up_alone(tmp_path, rows):
    """No sound electrode has its sign reversed, nor drifts by the warm-up seen through a reversed sign."""
    samples.make_samples(tmp_path)
    counts = np.loadtxt(tmp_path / "electrodes.txt")[rows]
    found = diagnose_recording(PlainRecording(counts, rate=100.0)).findings
    assert [f.id for f in found] == ["warmup"] and found[0].of_all


def test_an_exchange_is_found_beside_electrodes_alike(tmp_path):
    """Others that go on where they were could as well go on where the exchanged ones are."""
    samples.make_samples(tmp_path)
    counts = np.loadtxt(tmp_path / "electrodes.txt")
    counts[4500:, [2, 13]] = counts[4500:, [13, 2]]
    swap, warmup = diagnose_recording(PlainRecording(counts, rate=100.0)).findings
    assert (swap.id, swap.channels, warmup.id) == ("swap", (2, 13), "warmup")
    assert abs(swap.start - 45) < 0.02


def test_samples_take_no_simulation(tmp_path):
    """Those of the default seed: the solver is not even loaded."""
    code = f"import sys; from biotac_mj.cli import main; main(['data', 'samples', {str(tmp_path / 's')!r}]); "
    code += "sys.exit('warp' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=120).returncode == 0
    assert (tmp_path / "s" / "set" / "shard-00000.h5").is_file()


@pytest.mark.slow
def test_force_is_learned_from_the_samples(tmp_path, capsys):
    """Far better than the mean of what trained, on the last rounds: what README promises of them."""
    folder, model = tmp_path / "samples", str(tmp_path / "m.safetensors")
    samples.make_samples(folder)
    recording, _ = load_one(folder / "electrodes.txt", force=folder / "forces.txt")
    result = evaluate_recording(recording, tmp_path / "r.json", network=False, progress=False)
    errors = result["force_regression"]["models"]
    assert result["force_regression"]["best"] == "drift_aware"
    assert (np.array(errors["drift_aware"]["rmse"]) < 0.5 * np.array(errors["predict_mean"]["rmse"])).all()
    reader, scores = judge_in_time(from_recording(recording))
    assert scores["targets"]["force"]["rmse"] < 0.5 * scores["targets"]["force"]["rmse_of_mean"]
    assert cli.main(["learn", "train", str(folder / "set"), "--out", model]) == 0  # enough for intervals
    said = capsys.readouterr().out
    assert "(the mean 0." in said and "note" not in said and "place" in said


@pytest.mark.slow
def test_what_was_put_into_the_samples_is_diagnosed(tmp_path, capsys):
    folder = tmp_path / "samples"
    samples.make_samples(folder)
    words = ["--electrodes", f"{folder}/electrodes.txt", "--force", f"{folder}/forces.txt", "--quiet"]
    assert cli.main(["diagnose", *words, "--out", str(tmp_path / "report")]) == 0
    said = capsys.readouterr().out
    assert "found: shared impedance gain (warm-up)" in said.replace("  ", " ")  # samples.EFFECT, by name
    assert "not loaded" not in said  # touches long and slow enough to be taken for touches


@pytest.mark.slow
def test_the_shipped_samples_are_what_is_simulated(tmp_path):
    """To the noise of a count and a few microns; else run scripts/make_samples.py."""
    samples.make_samples(tmp_path)
    again = simulated.record_touches(samples.SHIPPED_SEED)
    shipped = np.loadtxt(tmp_path / "electrodes.txt")
    assert np.abs(shipped - again.electrodes).max() <= 2
    np.testing.assert_allclose(np.loadtxt(tmp_path / "forces.txt"), again.force, atol=2e-3)
    simulated.make_set(again, tmp_path / "again", samples.SHIPPED_SEED, progress=False)
    with TactileSet(tmp_path / "set") as one, TactileSet(tmp_path / "again") as other:
        for name, close in (("displacement", 5e-6), ("counts", 3), ("wrench", 5e-3)):
            difference = one[name][:].astype(float) - other[name][:]
            assert np.ptp(one[name][:]) > 100 * close and np.abs(difference).max() < close


@pytest.mark.slow
def test_touches_repeat_by_their_seed():
    one, two, other = (simulated.record_touches(seed, touches=1) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.electrodes, two.electrodes)
    assert np.abs(one.object_pos[-1] - other.object_pos[-1]).max() > 1e-4
    assert np.linalg.norm(one.force, axis=1).max() > 0.1 > np.linalg.norm(one.force[:1000], axis=1).max()


@pytest.mark.parametrize("seed", [0, 1])  # one is shipped, the other simulated
def test_files_of_somebody_else_are_left(tmp_path, monkeypatch, seed):
    def recorded(seed):
        """Any recording, which has all channels."""
        draw, unit = np.random.default_rng(seed), [[1.0, 0, 0, 0]] * 50
        reads = [
            {"electrodes": draw.integers(4096, size=19), "pac": draw.integers(4096, size=22)}
            | {name: draw.integers(4096, size=1) for name in ("pdc", "tac", "tdc")}
            | {"contact_force": draw.normal(size=6)}
            for _ in unit
        ]
        place = draw.uniform(size=(50, 3))
        return of_simulation(np.arange(50) / 100, reads, object_pos=place, object_quat=np.array(unit))

    monkeypatch.setattr(simulated, "record_touches", recorded)
    monkeypatch.setattr(simulated, "resimulate", lambda *given, **more: None)
    samples.make_samples(tmp_path / "ours", seed, progress=False)
    samples.make_samples(tmp_path / "ours", seed, progress=False)  # the same: an interrupted set may go on
    text = f"electrodes.txt is there and is no sample of seed {1 - seed}: choose another folder, or remove it"
    with pytest.raises(ValueError, match=text):
        samples.make_samples(tmp_path / "ours", seed=1 - seed, progress=False)
    (tmp_path / "log.csv").write_text("mine")
    with pytest.raises(
        ValueError, match=f"log.csv is there and is no sample of seed {seed}: choose another f"
    ):
        samples.make_samples(tmp_path, seed, progress=False)
    assert (tmp_path / "log.csv").read_text() == "mine" and not (tmp_path / "forces.txt").exists()


def test_a_set_of_somebody_else_is_left(tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "shard-00001.h5").write_text("mine")
    with pytest.raises(
        ValueError, match="shard-00001.h5 is there and is no sample of seed 0: choose another"
    ):
        samples.make_samples(tmp_path)
    assert not (tmp_path / "electrodes.txt").exists()


def test_a_force_of_exactly_nothing_is_a_rest():
    """Simulated forces are 0 to the bit in most rows: these are the rest, not none of them."""
    touch = np.clip(np.sin(np.arange(600) / 40) - 0.5, 0, 1)
    counts = REST_COUNTS["1"] - np.linspace(50, 400, 19) * touch[:, None]
    force = np.column_stack([0 * touch, 0 * touch, -2 * touch])
    np.testing.assert_allclose(rest_of(counts, 100.0, force)["rest"], REST_COUNTS["1"], atol=1)
