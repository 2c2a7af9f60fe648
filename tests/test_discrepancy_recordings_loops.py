"""Hysteresis that electrodes say of each other, without a force. All of it is synthetic."""

import numpy as np
import pytest
from test_discrepancy_recordings_noise import session_of, touched

from biotac_mj.discrepancy import PlainRecording, diagnose_recording
from biotac_mj.discrepancy.recordings.families.memory.between import lagged
from biotac_mj.discrepancy.recordings.families.memory.loops import looping


def looped(counts, share=0.8, width=0.4):
    """Counts (n, 19) that lag behind each electrode's own turning points, by a width in its deviations."""
    out, held, half = counts.copy(), counts[0].copy(), width * counts.std(0)
    for row, now in zip(out, counts):
        held = np.clip(held, now - half, now + half)
        row += share * (held - now)
    return np.rint(out)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_loop_of_each_electrode_is_found_and_undone(seed):
    counts = touched(seed)[0]
    hidden = looped(counts)
    session = session_of(hidden)
    found = looping(session)
    assert found.id == "hyster" and found.clues["looped"] > 0.05 and found.p < 0.01
    undone = found.correct(hidden, session.recording.time)
    assert np.std(undone - counts) < 0.7 * np.std(hidden - counts)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_has_no_loop_has_none(seed):
    """The same load as it is, run backwards with a loop, amplified, and with a memory that fades."""
    counts = touched(seed)[0]
    fades = counts + 0.4 * (counts - lagged(counts, 2.0, 100.0))
    for other in (counts, looped(counts)[::-1], counts.mean(0) + 1.5 * (counts - counts.mean(0)), fades):
        assert looping(session_of(np.rint(other))) is None


@pytest.mark.slow  # quick: a loop of each electrode is found and undone
def test_a_loop_is_named_once_and_proved_where_nothing_was_fitted():
    counts, force, _ = touched(0)
    d = diagnose_recording(PlainRecording(looped(counts), force, rate=100.0))
    named = [f for f in d.findings if f.id == "hyster"]
    assert len(named) == 1 and named[0].verified and named[0].gap["after"] < 0.8 * named[0].gap["before"]
