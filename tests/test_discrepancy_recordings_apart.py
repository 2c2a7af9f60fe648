"""Force and electrodes that are not of the same time: said, and no longer 'no significant disagreement'."""

import numpy as np
import pytest
from logs import RATE, noisy, pressed

from biotac_mj.discrepancy import PlainRecording, diagnose_recording
from biotac_mj.discrepancy.recordings.detectors.latency import clock_offset
from biotac_mj.discrepancy.recordings.session import Session


@pytest.fixture(scope="module")
def logged():
    """Counts and force of a pressed sensor (synthetic)."""
    counts, force, rng = pressed(1, 30)
    return noisy(counts, rng, 2.0), force


def said(counts, force):
    recording = PlainRecording(counts, force=force, rate=RATE)
    return Session(recording, recording.time < 0.7 * recording.time[-1])


def test_a_force_that_belongs_to_the_electrodes_is_not_blamed(logged):
    assert clock_offset(said(*logged)) is None


@pytest.mark.parametrize("seconds, when", [(3.4, "after"), (-5.0, "before")])
def test_a_force_of_another_clock_is_said_with_its_shift(logged, seconds, when):
    counts, force = logged
    session = said(counts, np.roll(force, round(seconds * RATE), axis=0))
    text = clock_offset(session)
    assert f"{abs(seconds)} s {when} them" in text
    assert text in diagnose_recording(session.recording).verdict


def test_a_force_of_other_touches_is_said(logged):
    counts, _ = logged
    assert "at different times" in clock_offset(said(counts, pressed(7, 30)[1][::-1]))
