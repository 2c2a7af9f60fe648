"""Counts that lost their upper bits: put back, said, and named nothing else."""

import numpy as np
import pytest
from test_discrepancy_recordings import RATE, noisy, pressed, unloaded

from biotac_mj.discrepancy import Recording, diagnose_recording
from biotac_mj.discrepancy.recordings.overflow import unwrapped


def overflowing(seed, number, band, since):
    """Counts of a pressed sensor (synthetic), whole and with upper bits lost of the channels that go over a
    boundary most often."""
    counts, _, rng = pressed(seed, 30)
    whole = noisy(counts, rng, 3.0)
    over = np.abs(np.diff(whole[since:] // band, axis=0)).sum(0)
    channels, cut = np.argsort(-over)[:number], whole.copy()
    cut[since:, channels] %= band
    return whole, cut


@pytest.mark.parametrize("number", [2, 19])
def test_lost_upper_bits_are_put_back(number):
    whole, cut = overflowing(1, number, 1024, 900)
    fixed, said = unwrapped(Recording(cut, rate=RATE))
    assert "overflow at 1024" in said
    np.testing.assert_array_equal(fixed.electrodes, whole)


def test_an_overflow_is_unknown_and_hides_nothing():
    whole, cut = overflowing(1, 19, 1024, 900)
    sound, d = (diagnose_recording(Recording(x, rate=RATE)) for x in (whole, cut))
    assert d.rest.significant and "overflow at 1024" in d.verdict
    assert [(f.id, f.channels) for f in d.findings] == [(f.id, f.channels) for f in sound.findings]


def test_flipped_bits_and_drop_outs_are_no_overflow():
    counts, rng = unloaded(4, 40)
    x = noisy(counts, rng)
    rows = rng.choice(len(x), 30, replace=False)
    x[rows, 5] = np.rint(x[rows, 5]).astype(int) ^ 1024
    x[:, 7] += 2048 - np.median(x[:, 7])
    x[rng.choice(len(x), 30, replace=False), 7] = 0
    assert unwrapped(Recording(np.clip(x, 0, 4095), rate=RATE))[1] == ""
