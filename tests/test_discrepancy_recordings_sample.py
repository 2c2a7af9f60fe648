"""What is done to the shipped sample, which has a warm-up, is what is found. Data are synthetic."""

import numpy as np
import pytest

from biotac_mj.discrepancy import PlainRecording, diagnose_recording
from biotac_mj.discrepancy.evidence import further_off
from biotac_mj.discrepancy.recordings.detectors.latency import clock_offset
from biotac_mj.discrepancy.recordings.proof import blocks
from biotac_mj.discrepancy.recordings.session import Session
from biotac_mj.samples import make_samples

LIMIT = 3200.0  # [counts] above which eight electrodes rest


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    """Counts (n, 19) and forces (n, 3)."""
    folder = tmp_path_factory.mktemp("sample")
    make_samples(folder / "samples", progress=False)
    return [np.loadtxt(folder / "samples" / name) for name in ("electrodes.txt", "forces.txt")]


def test_many_electrodes_may_rest_at_a_limit(sample):
    """Which is where they are most of the time, and no other electrode drifts for it."""
    counts, force = sample
    clipped = np.minimum(counts, LIMIT)
    found = diagnose_recording(PlainRecording(clipped, force, rate=100.0)).findings
    limited = {f.channels[0] for f in found if f.id == "saturate"}
    most = (clipped == LIMIT).mean(0)
    assert limited == set(np.flatnonzero((most > 0.5) & (most < 1)))
    assert {f.id for f in found} == {"saturate", "stuck", "warmup"}


def test_a_step_of_all_is_an_offset_beside_the_warm_up(sample):
    counts, force = sample
    stepped = counts - 40.0 * (np.arange(len(counts)) >= len(counts) // 2)[:, None]
    diagnosis = diagnose_recording(PlainRecording(stepped, force, rate=100.0))
    found = {f.id: f for f in diagnosis.findings}
    assert set(found) == {"warmup", "count_offset"}
    change, low, high = found["count_offset"].parameters["change"]
    assert low < -40 < high and change == pytest.approx(-40, abs=2)
    assert found["count_offset"].start == pytest.approx(45.0, abs=0.02)
    assert diagnosis.gap["each electrode from the others"].closed > 0.5


def test_a_warm_up_lies_within_its_interval(sample):
    (warm,) = diagnose_recording(PlainRecording(*sample, rate=100.0)).findings
    for value, low, high in warm.parameters.values():
        assert low < value < high


@pytest.mark.parametrize("seconds", (25, 40))
def test_touches_that_come_again_are_no_second_clock(sample, seconds):
    counts, force = sample
    rows = seconds * 100
    for first in range(0, len(counts) - rows + 1, 1000):
        part = PlainRecording(counts[first : first + rows], force[first : first + rows], rate=100.0)
        assert clock_offset(Session(part, np.arange(rows) < 0.7 * rows)) is None


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
        assert finding.written or finding.id in " ".join(diagnosis.amended)
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
