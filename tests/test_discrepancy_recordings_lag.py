"""Electrodes that follow a load later than the others do. Data are synthetic."""

import numpy as np
import pytest
from logs import RATE, noisy, pressed
from scipy.signal import lfilter

from biotac_mj.discrepancy import PlainRecording, diagnose_recording
from biotac_mj.discrepancy.recordings.detectors.lagging import lagging
from biotac_mj.discrepancy.recordings.session import Session

SLOW = 0.08  # [s]


def filtered(counts, k, tau):
    out, b = counts.copy(), np.exp(-1 / (tau * RATE))
    out[:, k] = lfilter([1 - b], [1, -b], counts[:, k] - counts[0, k]) + counts[0, k]
    return out


def session_of(counts):
    return Session(PlainRecording(counts, rate=RATE), np.arange(len(counts)) < 0.6 * len(counts))


def test_a_filtered_electrode_is_late_and_no_other():
    counts, _, rng = pressed(8)
    recording = PlainRecording(noisy(filtered(counts, 5, SLOW), rng, 1.0), rate=RATE)
    found = [f for f in diagnose_recording(recording).findings if f.id == "lowpass"]
    assert [(f.channels, f.ties, f.verified) for f in found] == [((5,), ("latency",), True)]
    assert 0.3 * SLOW < found[0].parameters["tau"][0] < 1.5 * SLOW


@pytest.mark.parametrize("seed", range(3))
def test_sound_electrodes_are_not_late(seed):
    counts, _, rng = pressed(seed)
    assert "lowpass" not in {f.id for f in diagnose_recording(PlainRecording(noisy(counts, rng))).findings}


def test_what_held_out_touches_do_not_show_is_contradicted():
    counts, _, rng = pressed(8)
    late, first = filtered(counts, 5, SLOW), round(0.6 * len(counts))
    found = lagging(session_of(noisy(np.concatenate([late[:first], counts[first:]]), rng, 1.0)))
    assert found is not None and found.channels == (5,) and found.verified is False
