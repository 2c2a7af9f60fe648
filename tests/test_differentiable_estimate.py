"""Contacts from electrodes: those of the skin's own presses are found again, and the verb says so."""

import csv
import json

import numpy as np
import pytest

from biotac_mj import cli
from biotac_mj.calibration.forward import steps_of
from biotac_mj.differentiable import Estimator, estimate
from biotac_mj.geometry import load_skin
from biotac_mj.sensor.channels import counts_from_impedance, impedance_from_counts
from biotac_mj.sensor.presets import Sensor

REST = np.array(Sensor().rest)


@pytest.fixture(scope="module", autouse=True)
def small_table():
    """Presses of a part of the pad."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimate, "_ALONG", np.array([-0.014, -0.012, -0.010, -0.008]))
        patch.setattr(estimate, "_AROUND", np.radians([-20.0, 0, 20, 40]))
        patch.setattr(estimate, "_DEPTHS", np.linspace(0, 1.2e-3, 4))
        yield


@pytest.fixture(scope="module")
def estimator():
    return Estimator(load_skin("coarse"))


@pytest.fixture(scope="module")
def pressed(estimator):
    """Counts of a press that no node of the table is, its force and where the ball's centre is."""
    plan = estimator._plan((-0.0112, 0.17), 0.9e-3)
    steps, _ = steps_of(plan)
    trajectory = estimator._follow(steps.pos, steps.mat)
    ratio = estimator._read(trajectory.steps[-1]) / estimator._rest
    counts = counts_from_impedance(impedance_from_counts(REST) * ratio)
    return counts, -trajectory.steps[-1].wrench[0, :3], steps.pos[-1, 0]


def test_a_press_is_found_again(estimator, pressed):
    counts, force, pos = pressed
    found = estimator(counts, REST)
    assert found.settled and not found.lost and found.missed < 0.03
    assert np.linalg.norm(found.pos - pos) < 0.2e-3
    assert found.force == pytest.approx(force, abs=0.05 * np.linalg.norm(force))
    assert found.size == pytest.approx(np.linalg.norm(found.force))
    # a ball's centre, the contact and the force are on one line
    arm = found.centre - found.pos
    assert np.linalg.norm(np.cross(arm, found.force)) < 0.3 * np.linalg.norm(arm) * found.size
    assert np.linalg.norm(arm) == pytest.approx(3.5e-3, abs=1.2e-3)


def test_what_all_electrodes_share_is_free(estimator, pressed):
    """Warmer liquid moves nothing."""
    counts, _, pos = pressed
    warm = counts_from_impedance(0.95 * impedance_from_counts(counts))
    found = estimator(warm, REST)
    assert np.linalg.norm(found.pos - pos) < 0.3e-3


def test_noise_makes_intervals_wide(estimator, pressed):
    counts, force, _ = pressed
    exact = estimator(counts, REST)
    noisy = estimator(counts + 12 * np.random.default_rng(0).normal(size=19), REST)
    assert (noisy.centre_error > 2 * exact.centre_error).all() and noisy.size_error > 2 * exact.size_error
    assert abs(noisy.size - np.linalg.norm(force)) < noisy.size_error


def test_what_is_no_contact_is_refused(estimator):
    with pytest.raises(ValueError, match="which may be noise: choose a row under load"):
        estimator(REST + 1.0, REST)
    with pytest.raises(
        ValueError, match="rest are not 19 numbers between 1 and 4094: an electrode at its end"
    ):
        estimator(REST, np.full(19, 4095.0))
    with pytest.raises(ValueError, match="ellipsoid are not there: take a mesh"):
        Estimator(load_skin("coarse"), "geom:ellipsoid:0.003,0.003,0.004")


def test_the_verb(pressed, tmp_path, capsys):
    counts, force, _ = pressed
    header = ",".join(f"e{i + 1}" for i in range(19))
    lines = [",".join(f"{v:.0f}" for v in row) for row in (REST, counts)]
    (tmp_path / "two.csv").write_text("\n".join([header, *lines]) + "\n")
    (tmp_path / "one.csv").write_text("\n".join([header, lines[1]]) + "\n")
    given = ["estimate", str(tmp_path / "two.csv"), "--quiet", "--out"]
    assert cli.main([*given, str(tmp_path / "found.csv")]) == 0
    said = capsys.readouterr().out
    assert "row 1: centre" in said and "unexplained" in said
    with open(tmp_path / "found.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert float(row["size"]) == pytest.approx(np.linalg.norm(force), rel=0.1)
    one = ["estimate", str(tmp_path / "one.csv"), "--quiet", "--out", str(tmp_path / "found.json")]
    assert cli.main([*one, "--sensor", "1"]) == 0
    (same,) = json.loads((tmp_path / "found.json").read_text())
    assert same["size"] == pytest.approx(float(row["size"]), rel=1e-6) and same["row"] == 0
    for wrong, said in (
        (one, "takes all of the 1 rows: leave some to look at, or name a --sensor"),
        ([*given, str(tmp_path / "no.csv"), "--row", "7"], "--row 7: two has 2 rows"),
        ([*given, str(tmp_path / "no.csv"), "--row", "0"], "which may be noise"),
        ([*given, str(tmp_path / "no.csv"), "--material", "calibrated"], "rest_pressure are not there"),
    ):
        capsys.readouterr()
        assert cli.main(wrong) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "no.csv").exists()
