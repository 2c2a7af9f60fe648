"""Force and electrodes that are not of the same time, and noise that begins in the part kept aside: said, and
no longer 'no significant disagreement'."""

import numpy as np
import pytest
from logs import RATE, noisy, pressed

from biotac_mj.discrepancy import PlainRecording
from biotac_mj.discrepancy.recordings.apart import apart
from biotac_mj.discrepancy.recordings.rest import rest
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
    assert apart(said(*logged)) is None


@pytest.mark.parametrize("seconds, when", [(3.4, "after"), (-5.0, "before")])
def test_a_force_of_another_clock_is_said_with_its_shift(logged, seconds, when):
    counts, force = logged
    session = said(counts, np.roll(force, round(seconds * RATE), axis=0))
    text = apart(session)
    assert f"{abs(seconds)} s {when} them" in text
    assert text in rest(session, [], []).text


def test_a_force_of_other_touches_is_said(logged):
    counts, _ = logged
    assert "at different times" in apart(said(counts, pressed(7, 30)[1][::-1]))


def test_noise_that_begins_late_is_said_of_its_electrode(logged):
    counts = logged[0].copy()
    recording = PlainRecording(counts, rate=RATE)
    fit = recording.time < 0.6 * recording.time[-1]
    assert "noise of" not in rest(Session(recording, fit), [], []).text
    late = slice(round(0.65 * len(counts)), None)
    counts[late, 9] += np.random.default_rng(0).normal(0, 30, counts[late].shape[0])
    session = Session(PlainRecording(np.clip(np.rint(counts), 0, 4095), rate=RATE), fit)
    found = rest(session, [], [])
    assert found.significant and "the noise of e10 is" in found.text
