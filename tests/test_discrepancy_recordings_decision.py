"""What is named and what is unknown: the decision over a whole report."""

import numpy as np
import pytest
from logs import RATE, noisy, tapped, unloaded
from scipy.ndimage import gaussian_filter1d

from biotac_mj.discrepancy import PlainRecording, diagnose_recording
from biotac_mj.discrepancy.recordings import search
from biotac_mj.discrepancy.recordings.candidates import Candidate
from biotac_mj.quality.confidence import NAMED, confidence, probability


def sure(detector, features, beside):
    return confidence(Candidate("drift", (3,), 0.0, 1.0, "", detector=detector, features=features), beside)


def test_a_name_is_less_sure_beside_others_of_its_detector():
    features = {"edge": 4.0, "isolation": 3.4}
    alone, three, eight = (sure("jump", features, beside) for beside in (0, 2, 7))
    assert alone > NAMED and alone > three > eight


def test_the_other_of_a_pair_is_no_argument_against_an_electrode():
    features = {"lead": 3.3, "wandering": 2.3}
    alone, pair, many = (sure("one", features, beside) for beside in (0, 1, 6))
    assert alone == pair > NAMED > many
    edge = {"edge": 4.0, "isolation": 3.4}
    assert sure("jump", edge, 0) > sure("jump", edge, 1)


@pytest.mark.parametrize(
    "stated, right", [(0.74, 28 / 39), (0.845, 20 / 28), (0.92, 64 / 73), (0.98, 76 / 81)]
)
def test_confidence_is_that_of_authors_who_were_blind(stated, right):
    """What the weights say of forms that they were fitted to, and how many names of two authors whose forms
    they had not seen were right there; both errors and a bin's spread together are some 0.06."""
    weights = {"any": {"intercept": np.log(stated / (1 - stated)), "features": {}}}
    assert abs(probability("any", {}, 0, weights) - right) < 0.07


def test_what_the_part_kept_aside_contradicts_is_unknown(monkeypatch):
    e, rng = unloaded(3, 40)
    coarse = PlainRecording(8 * np.rint(noisy(e, rng) / 8), rate=RATE)
    assert [f.id for f in diagnose_recording(coarse).findings] == ["quantise"]
    monkeypatch.setattr(search, "prove", lambda session, finding: setattr(finding, "verified", False))
    d = diagnose_recording(coarse)
    assert not d.findings and d.verdict.startswith("unknown: coarse quantisation")
    assert "the held-out ones contradict it" in d.verdict


@pytest.mark.parametrize("rows", (1, 2, 5, 12, 30))
def test_what_a_touch_does_sharply_is_no_fault(rows):
    """The force tells that it was one; spikes of an electrode are found beside touches."""
    counts, force, _ = tapped(rows)
    assert (
        diagnose_recording(PlainRecording(counts, force, rate=RATE)).verdict == "no significant disagreement"
    )
    free = np.flatnonzero(np.abs(force[:, 2]) < 0.05)[50::150]
    counts[free, 4] -= 300
    (found,) = diagnose_recording(PlainRecording(counts, force, rate=RATE)).findings
    assert (found.id, found.channels) == ("spikes", (4,))


def test_what_jumps_together_without_a_force_is_unknown():
    """Eight at once: the force says that nothing touches there."""
    counts, force, _ = tapped(12)
    free = np.flatnonzero(np.abs(force[:, 2]) < 0.05)[50::150]
    counts[free, :8] -= 300
    verdict = diagnose_recording(PlainRecording(counts, force, rate=RATE)).verdict
    assert verdict.startswith("unknown") and "change from one row to the next" in verdict


@pytest.mark.parametrize("rows", (5, 12))
def test_sharp_touches_without_force_are_no_fault(rows):
    assert not diagnose_recording(PlainRecording(tapped(rows)[0], rate=RATE)).significant


def test_rows_of_another_sensor_are_no_touches():
    """All electrodes go there and back, by the same each time."""
    counts, rng = unloaded(3, 12)
    hand = gaussian_filter1d(rng.standard_normal((len(counts), 3)), 12, axis=0)
    counts = counts + 60 * hand @ rng.standard_normal((3, 19))
    other = rng.normal(0, 60, 19)
    assert not diagnose_recording(PlainRecording(noisy(counts, rng), rate=RATE)).significant
    for row in range(100, len(counts) - 100, 150):
        counts[row : row + 5 + row % 19] += other
    assert diagnose_recording(PlainRecording(noisy(counts, rng), rate=RATE)).verdict.startswith("unknown")


def test_what_one_electrode_does_in_company_is_of_touch():
    """A tap that one electrode feels most, for a row or two, and others a little."""
    counts, rng = unloaded(3, 40)
    for row in range(200, 3800, 90):
        begin = row + rng.integers(60)
        some = slice(begin, begin + rng.integers(1, 3))
        counts[some] -= 26
        counts[some, 2] -= 200
    found = diagnose_recording(PlainRecording(noisy(counts, rng), rate=RATE))
    assert not found.findings and "e3" not in found.verdict
