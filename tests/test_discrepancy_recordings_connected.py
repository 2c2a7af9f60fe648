"""Electrodes that are connected to each other: unknown, and no drift of either."""

import pytest
from logs import RATE, noisy, pressed, unloaded

from biotac_mj.discrepancy import PlainRecording, diagnose_recording
from biotac_mj.discrepancy.recordings.connected import part_connected
from biotac_mj.discrepancy.recordings.session import Session

PAIR = [2, 14]


def connected(seed, since):
    """Counts of a pressed sensor (synthetic) of which two electrodes read their mean from a row on."""
    counts, _, rng = pressed(seed, 30)
    counts[since:, PAIR] = counts[since:, PAIR].mean(1, keepdims=True)
    return noisy(counts, rng, 2.0)


@pytest.mark.parametrize("seed", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_connected_electrodes_are_unknown_and_none_drifts(seed):
    d = diagnose_recording(PlainRecording(connected(seed, 1200), rate=RATE))
    assert "e3 and e15 read the same" in d.verdict and d.rest.significant
    assert not [f for f in d.findings if len(f.channels) < 12 and set(f.channels) & set(PAIR)]
    hole = d.session.masked[:, PAIR].all(1)
    assert not hole[:1150].any() and hole[1250:].mean() > 0.95


def test_sound_electrodes_and_a_shared_drift_are_not_connected():
    loaded, _, rng = pressed(2, 30)
    still, rng = unloaded(3, 60)
    still[:, 5] = still[:, 6]  # alike at rest, where nothing moves but what all have in common
    for counts in (loaded, still):
        recording = PlainRecording(noisy(counts, rng, 2.0), rate=RATE)
        session = Session(recording, recording.time < 0.6 * recording.time[-1])
        part_connected(session)
        assert not session.unnamed and not session.masked.any()
