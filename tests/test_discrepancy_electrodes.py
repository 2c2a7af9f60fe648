"""What one electrode or some do in a synthetic recording: jumps, exchanges for a while, signs."""

import numpy as np
import pytest
from logs import noisy, pressed
from test_discrepancy_recordings import ids

from biotac_mj.discrepancy import PlainRecording, diagnose_recording
from biotac_mj.discrepancy.recordings.detectors.jumps import edges, jumped
from biotac_mj.discrepancy.recordings.detectors.levels import _ahead, levels
from biotac_mj.discrepancy.recordings.detectors.order import slipped
from biotac_mj.discrepancy.recordings.rest import rest
from biotac_mj.discrepancy.recordings.session import Session

RATE = 100.0


def session(counts, share=0.6):
    fit = np.arange(len(counts)) < share * len(counts)
    return Session(PlainRecording(counts, rate=RATE), fit)


@pytest.mark.parametrize("back", (pytest.param(False, marks=pytest.mark.slow), True))
def test_a_jump_of_one_electrode_is_found_in_a_few_seconds(back):
    counts, _, rng = pressed(3, 14)
    counts = noisy(counts, rng)
    when = slice(400, 1000 if back else None)
    counts[when, 6] += 300
    found = jumped(session(counts))
    assert [f.channels for f in found] == [(6,)]
    assert abs(found[0].start - 4.0) < 0.02
    left = found[0].correct(counts, np.arange(len(counts)) / RATE)[when, 6] - counts[when, 6]
    assert np.median(left) == pytest.approx(-300, abs=15)
    assert abs(found[0].parameters["change"][0] - 300) < 15
    assert "drift" in ids(diagnose_recording(PlainRecording(counts, rate=RATE)))


def test_what_several_do_at_once_is_no_jump_of_one():
    counts, _, rng = pressed(3, 14)
    counts = noisy(counts, rng)
    assert not edges(session(counts))
    counts[400:, 6:12] += 150
    assert not edges(session(counts))


def touched(seed=5, seconds=60, noise=2.0):
    """Counts of a synthetic finger that is touched hard at random places, held and let go within a few rows,
    each time at rest in between."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE)
    counts, at = np.tile(rng.uniform(2100, 3300, 19), (n, 1)), 60
    places = rng.standard_normal((19, 3))
    while at < n - 220:
        up, hold, down = int(rng.integers(8, 30)), int(rng.integers(20, 80)), int(rng.integers(4, 8))
        rise = np.linspace(0, 1, up) ** 1.5
        shape = np.r_[rise, np.ones(hold), np.linspace(1, 0, down) ** 0.7]
        near = np.exp(-((places - rng.standard_normal(3)) ** 2).sum(1) / 2)
        size = near * rng.uniform(150, 900) * rng.choice([1, 1, -0.4])
        for k in range(19):  # each is let go when its place is
            rows = slice(at + k % 6, at + k % 6 + len(shape))
            counts[rows, k] += size[k] * shape
        at += len(shape) + int(rng.integers(40, 120))
    return noisy(counts, rng, noise), rng


def test_a_hard_release_is_no_jump():
    """One electrode feels a touch that ends within one row; after it it reads as before it, and one that
    jumped does not."""
    counts, _ = touched()
    last = 5800
    counts[last - 90 : last, 10] += np.rint(150 * np.linspace(0, 1, 90) ** 0.3)
    assert 10 in edges(session(counts))
    assert not jumped(session(counts))
    counts, _ = touched()
    counts[last:, 10] += 150
    assert [f.channels for f in jumped(session(counts))] == [(10,)]


def test_what_is_sharp_is_unusual():
    """A loose lead, and halves that are exchanged."""
    counts, rng = touched()
    usual = rest(session(counts)).features["sharp"]
    loose = counts.copy()
    for row in rng.integers(100, 5900, 12):
        loose[row : row + 4, 4] += 90
    assert rest(session(loose)).features["sharp"] > usual
    halves = np.r_[counts[2870:], counts[:2870]]
    halves[3129:] += np.rint(80 * rng.standard_normal(19))
    assert rest(session(halves)).features["sharp"] > usual


def test_electrodes_that_change_together_stand_out_of_the_others():
    """Two that drift at rest, each its own way: neither is told by the other."""
    rng, t = np.random.default_rng(0), np.linspace(0, 1, 3000)
    counts = np.tile(rng.uniform(2100, 3300, 19), (3000, 1))
    for k, tau in ((4, 0.2), (17, 0.3)):
        counts[:, k] += 90 * (1 - np.exp(-t / tau))
    d = diagnose_recording(PlainRecording(noisy(counts, rng), rate=RATE))
    assert {(f.id, f.channels) for f in d.findings} == {("drift", (k,)) for k in (4, 17)}
    first, *others = d.to_dict()["tried"]  # what was found, and what these data could have shown
    assert first["id"] == "drift" and first["confidence"] > 0.5
    assert {"spikes", "stuck"} <= {one["id"] for one in others} and "latency" not in {
        one["id"] for one in others
    }
    assert _ahead(np.log([9.0, 8, *[1] * 17]), 0) > 2  # a connector may have two
    assert _ahead(np.log([9.0, 8, 7, *[1] * 16]), 0) < 0.3


def test_a_jump_may_be_a_gain_where_something_moves():
    counts, _, rng = pressed(3, 40)
    resting = np.tile(counts[:1], (len(counts), 1))
    for one, ties in ((counts, ("gain", "flip")), (resting, ())):
        changed = one.copy()
        changed[1270:, 6] += 150
        (jump,) = jumped(session(noisy(changed, rng)))
        assert jump.ties == ties and jump.channels == (6,)


def test_a_trend_of_one_resting_electrode_needs_no_long_log():
    rng = np.random.default_rng(0)
    counts = np.tile(rng.uniform(2100, 3300, 19), (1500, 1))
    assert levels(session(noisy(counts, rng)), set()) is None
    counts[:, 4] += 40 * np.sin(np.linspace(0, 6, 1500))
    found = levels(session(noisy(counts, rng)), set())
    assert found.id == "drift" and found.channels == (4,)


def exchanged_for_a_while():
    """Counts, and the same with three channels exchanged from 10 to 22 s."""
    counts, _, rng = pressed(5, 60)
    counts = noisy(counts, rng)
    wrong = counts.copy()
    wrong[1000:2200, [2, 7, 11]] = counts[1000:2200][:, [7, 11, 2]]
    return counts, wrong


def test_channels_exchanged_for_a_while_are_named():
    counts, wrong = exchanged_for_a_while()
    found = slipped(session(wrong))
    assert found.id == "swap" and set(found.channels) == {2, 7, 11}
    assert slipped(session(counts)) is None


def test_channels_exchanged_for_a_while_are_put_back():
    counts, wrong = exchanged_for_a_while()
    found = slipped(session(wrong))
    assert abs(found.start - 10) < 0.3 and abs(found.end - 22) < 0.3
    again = found.correct(wrong, np.arange(len(wrong)) / RATE)
    assert (again == counts).mean() > 0.998


@pytest.mark.slow
def test_seconds_that_are_sent_again_are_unknown():
    counts, _, rng = pressed(2)
    counts = noisy(counts, rng)
    assert not diagnose_recording(PlainRecording(counts, rate=RATE)).rest.significant
    counts[3000:4200] = np.resize(counts[2900:3000], (1200, 19))
    assert diagnose_recording(PlainRecording(counts, rate=RATE)).rest.significant
