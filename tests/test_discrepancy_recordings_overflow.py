"""Counts that lost their upper bits: put back, said, and named nothing else."""

import numpy as np
import pytest
from test_discrepancy_recordings import RATE, noisy, pressed, unloaded

from biotac_mj.discrepancy import PlainRecording, diagnose_recording
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
    fixed, said = unwrapped(PlainRecording(cut, rate=RATE))
    assert "overflow at 1024" in said
    np.testing.assert_array_equal(fixed.electrodes, whole)


@pytest.mark.slow  # quick: upper bits that are put back, and ten rows beyond the end
def test_an_overflow_is_unknown_and_hides_nothing():
    whole, cut = overflowing(1, 19, 1024, 900)
    sound, d = (diagnose_recording(PlainRecording(x, rate=RATE)) for x in (whole, cut))
    assert d.rest.significant and "overflow at 1024" in d.verdict
    assert [(f.id, f.channels) for f in d.findings] == [(f.id, f.channels) for f in sound.findings]


def test_flipped_bits_and_drop_outs_are_no_overflow():
    counts, rng = unloaded(4, 40)
    x = noisy(counts, rng)
    rows = rng.choice(len(x), 30, replace=False)
    x[rows, 5] = np.rint(x[rows, 5]).astype(int) ^ 1024
    x[:, 7] += 2048 - np.median(x[:, 7])
    x[rng.choice(len(x), 30, replace=False), 7] = 0
    assert unwrapped(PlainRecording(np.clip(x, 0, 4095), rate=RATE))[1] == ""


def test_ten_rows_beyond_the_end_of_a_large_band_are_an_overflow():
    """An electrode that crosses 2048 once; a wire that is off for ten rows leaves from anywhere."""
    e, _, rng = pressed(3, 30)
    counts = noisy(e, rng)
    dip = 2060 - 80 * np.exp(-(((np.arange(len(e)) - 1500) / 12) ** 2))
    counts[:, 4] = np.rint(dip + 0.5 * rng.standard_normal(len(e)))
    cut, off = counts.copy(), counts.copy()
    cut[:, 4] %= 2048
    assert (np.abs(np.diff(cut[:, 4])) > 1000).sum() == 2
    found, said = unwrapped(PlainRecording(cut))
    assert "of e5" in said and "at 2048" in said
    assert np.abs(np.diff(found.electrodes[:, 4])).max() < 100
    off[:, 4] -= 300
    off[1490:1500, 4] = 4
    assert not unwrapped(PlainRecording(off))[1] and not unwrapped(PlainRecording(counts))[1]
