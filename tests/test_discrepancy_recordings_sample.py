"""What is done to the shipped sample, which has a warm-up, is what is found. Data are synthetic."""

import numpy as np
import pytest
import yaml
from grids import covering

from biotac_mj.discrepancy import PlainRecording, diagnose_recording, read_recording
from biotac_mj.discrepancy.evidence import further_off
from biotac_mj.discrepancy.recordings.proof import blocks
from biotac_mj.discrepancy.recordings.session import Session
from biotac_mj.effects.sensor_file import write_sensor_file
from biotac_mj.samples import make_samples
from biotac_mj.sensor.channels import counts_from_log_impedance, log_impedance
from biotac_mj.sensor.presets import PER_DEGREE


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    """Counts (n, 19) and forces (n, 3)."""
    folder = tmp_path_factory.mktemp("sample")
    make_samples(folder / "samples", progress=False)
    return [np.loadtxt(folder / "samples" / name) for name in ("electrodes.txt", "forces.txt")]


def test_a_warm_up_lies_within_its_interval(sample):
    (warm,) = diagnose_recording(PlainRecording(*sample, rate=100.0)).findings
    for value, low, high in warm.parameters.values():
        assert low < value < high


@pytest.mark.parametrize("alone", (0, 1))
def test_the_amended_sensor_warms_up_as_reported(sample, alone, tmp_path):
    """In less time than a tenth of the log; also beside an electrode that drifts by itself."""
    time = np.arange(len(sample[0])) / 100.0
    still = sample[0].mean(0) + np.random.default_rng(0).standard_normal(sample[0].shape)
    counts = counts_from_log_impedance(log_impedance(still) - 0.2 * (1 - np.exp(-time / 3.0))[:, None])
    counts[:, 4] += alone * np.linspace(0, 150, len(time))
    diagnosis = diagnose_recording(PlainRecording(np.rint(counts), rate=100.0))
    (warm,) = [f for f in diagnosis.findings if f.id == "warmup"]
    write_sensor_file(tmp_path / "own.yaml", diagnosis.sensor())
    own = yaml.safe_load((tmp_path / "own.yaml").read_text())["sensor"]
    assert own["warm_time"] == warm.parameters["tau"][0] < 0.1 * time[-1]
    assert own["warm_up"] * -PER_DEGREE == pytest.approx(warm.parameters["a"][0])
    share = np.delete(own["warm_share"], 4 if alone else [])
    np.testing.assert_allclose(share, np.delete(warm.fraction, 4 if alone else []))
    np.testing.assert_allclose(own["rest"], sample[0].mean(0), atol=30)
    assert not alone or own["warm_share"][4] > 1.3 * warm.fraction[4]  # both raise counts


def test_an_electrode_without_numbers_is_drawn_and_said(sample, tmp_path):
    counts = sample[0].copy()
    counts[:, 6] = np.nan
    names = ",".join(f"e{k + 1}" for k in range(19))
    np.savetxt(tmp_path / "log.csv", counts, "%g", delimiter=",", header=names, comments="")
    diagnosis = diagnose_recording(read_recording(tmp_path / "log.csv", rate=100.0))
    assert any("e7: no number in most rows: taken for dead" in line for line in diagnosis.warnings)
    titles = [one.title for (one,) in diagnosis.panels()]
    assert titles[0].startswith("e7: ") and "stuck channel" in titles[0]
    assert len({title.split(":")[0] for title in titles}) == len(titles) == 4  # others warm up


@pytest.mark.parametrize("with_force, change", covering((False, True), (250.0, -250.0)))
def test_a_slow_common_change_is_of_the_session(sample, change, with_force):
    """In counts, of a sensor that is warm by then: not told from what goes on in ln Z, and no step."""
    counts, force = (part[2600:] for part in sample)
    drifted = np.rint(counts + change * np.linspace(0, 1, len(counts))[:, None])
    diagnosis = diagnose_recording(PlainRecording(drifted, force if with_force else None, rate=100.0))
    (found,) = diagnosis.findings
    assert found.kind.drifts and found.verified and found.written
    assert {found.id, *found.ties} >= {"warmup", "count_offset"}
    for gap in diagnosis.gap.values():
        assert gap.after < 1.01 * gap.before


def test_what_makes_held_out_rows_worse_is_not_written(sample):
    """A warm-up that is taken back as soon as the rows fitted end."""
    counts, _ = sample
    last = round(0.6 * len(counts))
    back = counts.copy()
    back[last:] += counts[:last].mean(0) - counts[last:].mean(0)
    diagnosis = diagnose_recording(PlainRecording(np.rint(back), rate=100.0))
    for gap in diagnosis.gap.values():
        assert gap.after <= gap.before * 1.01
    for finding in diagnosis.findings:
        assert finding.written or finding.kind.name in " ".join(diagnosis.amended)
    assert "warm_up" not in diagnosis.sensor().base["sensor"]


@pytest.mark.parametrize("first", (0, 1))
def test_errors_are_compared_where_a_finding_is_all_the_load(sample, first):
    """Without it the sensor is at rest, or with it."""
    counts, _ = sample
    still = np.rint(counts[0] + np.random.default_rng(0).standard_normal(counts.shape))
    fit = np.arange(len(counts)) < 0.6 * len(counts)
    sessions = [Session(PlainRecording(x, rate=100.0), fit) for x in (counts, still)]
    assert [one.loaded for one in sessions] == [True, False]
    before, after = blocks(sessions[first], sessions[1 - first])
    assert before.shape == after.shape and (np.argmax([before.mean(), after.mean()]) == first)


def test_more_than_chance_is_further_off():
    rng = np.random.default_rng(0)
    before = rng.chisquare(10, (8, 1))
    assert further_off(before, before + 1.0)
    assert not further_off(before, before - 1.0)
    apart = before + np.r_[3.0, -3.0, 3.0, -3.0, 3.0, -3.0, 3.0, -2.9][:, None]
    assert not further_off(before, apart)
    assert further_off(before, apart, np.zeros(1))
