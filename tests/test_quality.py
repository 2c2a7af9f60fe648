"""What is wrong with a log as a log: each fault alone, what only looks like one, and that all verbs say the
same. Counts are synthetic."""

import json

import numpy as np
import pytest
from grids import covering, first
from logs import BUS, LOGGER, RATE, noisy, overflowing, pressed, through_a_bus, touched, unloaded
from scipy import ndimage, signal

from biotac_mj import cli
from biotac_mj.discrepancy import read_recording
from biotac_mj.quality.again import logged_twice
from biotac_mj.quality.check import check
from biotac_mj.quality.clock import clock_faults, guessed_rate, missing_rows
from biotac_mj.quality.codes import put_back
from biotac_mj.quality.confidence import NAMED, confidence
from biotac_mj.quality.evidence import sign_flip
from biotac_mj.quality.lines import hum
from biotac_mj.quality.log import Log
from biotac_mj.quality.noise import running_median
from biotac_mj.quality.repeats import repeated_rows
from biotac_mj.quality.sample_hold import sample_and_hold
from biotac_mj.quality.stuck import stuck_or_clipped
from biotac_mj.recordings import Recording, findings
from biotac_mj.sensor.channels import electrode_noise


def as_read(counts):
    return np.clip(np.rint(counts), 0, 4095)


def faults(counts, rate=RATE, **given):
    return check(Log(as_read(counts), rate, **given)).faults


def named(counts, rate=RATE, **given):
    """(id, channels) of each fault."""
    return [(f.id, f.channels) for f in faults(counts, rate, **given)]


ALL = tuple(range(19))


# --- arrays ---


@pytest.mark.parametrize("mode", ["nearest", "mirror"])
def test_a_running_median_is_scipys(mode):
    x = np.random.default_rng(0).normal(size=(60, 3))
    np.testing.assert_array_equal(running_median(x, 7, mode), ndimage.median_filter(x, (7, 1), mode=mode))


def test_few_blocks_are_told_from_chance_by_all_their_signs():
    gain = np.array([0.5, -0.1, 0.9, 0.4, 0.2])
    signs = 1 - 2 * ((np.arange(32)[:, None] >> np.arange(5)) & 1)
    assert sign_flip(gain) == np.mean(signs @ gain >= gain.sum() - 1e-12)


def test_repeated_rows_may_differ_in_four_of_nineteen():
    e, rng = unloaded(seconds=20)
    x = noisy(e, rng)
    twice = np.repeat(x, 2, axis=0)
    twice[1::2, :4] += 1
    assert repeated_rows(twice).sum() == len(x) and not repeated_rows(x).any()
    assert guessed_rate(x) == (100.0, "assumed: the bus rate")
    rows = np.sort(np.concatenate([np.arange(2000), np.arange(0, 2000, 4)]))
    assert guessed_rate(x[rows])[0] == pytest.approx(125, abs=1)


@pytest.mark.parametrize("channels", (1, 2, 5, 30))
def test_any_number_of_channels(channels):
    """A channel that is stuck, and rows that are held, of fewer or more channels than a BioTac has."""
    rng = np.random.default_rng(channels)
    counts = as_read(2500 + 6 * rng.standard_normal((4000, channels)))
    assert not faults(counts)
    held = counts.copy()
    held[1000:1200] = held[1000]
    if channels > 1:  # one alone repeats by chance
        assert [f.id for f in faults(held, clocked=True)] == ["freeze"]
    if channels > 2:  # others tell what noise is
        counts[1000:2500, 0] = 2500
        assert named(counts) == [("stuck", (0,))]


def test_a_log_without_counts_is_told_by_what_never_changes():
    volts = np.random.default_rng(0).normal(2.5, 0.01, (900, 19))
    volts[:, 3] = 2.5
    assert named(volts * 1000, in_counts=False) == [("stuck", (3,))]
    with pytest.raises(ValueError, match=r"counts have shape \(5,\): \(n, c\) is needed"):
        Log(np.zeros(5))


@pytest.mark.parametrize("seed", (0, pytest.param(1, marks=pytest.mark.slow)))
def test_sound_logs_have_no_fault(seed):
    e, rng = unloaded(seed)
    for counts in (noisy(e, rng), noisy(pressed(seed)[0], rng), touched(seed)[0]):
        assert not faults(counts)
    assert not faults(through_a_bus(touched(seed)[0]), LOGGER)


# --- channels that stand still ---


def test_single_channels_stick_and_spike():
    e, rng = unloaded(3, 30)
    stuck = noisy(e, rng)
    stuck[1000:1600, 7] = stuck[1000, 7]
    (found,) = faults(stuck)
    assert (found.id, found.channels) == ("stuck", (7,)) and abs(found.start - 10) < 0.3
    spiked = noisy(e, rng)
    spiked[100::150, 2] = 0
    assert named(spiked) == [("spikes", (2,))]


@pytest.mark.parametrize("value, share", first([0, 4095, None], [0.35, 0.8]))
def test_a_broken_wire_is_said(value, share):
    """At an end of what it reads, or at its last value, and where it breaks when most is over."""
    e, _, rng = pressed(4, 40)
    counts = noisy(e, rng)
    start = int(share * len(counts))
    counts[start:, 11] = counts[start, 11] if value is None else value
    (found,) = faults(counts)
    assert (found.id, found.channels) == ("stuck", (11,)) and abs(found.start - start / RATE) < 1.0


@pytest.mark.parametrize("share, end", covering([0.25, 0.55], [0, 4095]))
def test_a_wire_that_breaks_at_rest_is_said(end, share):
    """Of a sensor with so little noise that a value which stays is no news by itself."""
    e, rng = unloaded(seconds=10)
    counts = noisy(e, rng, 0.4)
    assert not faults(counts)
    counts[round(share * len(counts)) :, 12] = end
    (found,) = faults(counts)
    assert (found.id, found.channels) == ("stuck", (12,)) and abs(found.start - share * 10) < 0.3


def test_an_electrode_that_trembles_from_the_first_row_is_stuck():
    """Its own noise is not what it would have, nor does it go on at a limit."""
    e, _, rng = pressed(6)
    counts = noisy(e, rng)
    counts[:, 9] = round(counts[:, 9].mean()) + (rng.random(len(counts)) < 0.04)
    assert named(counts) == [("stuck", (9,))]


def test_values_far_beyond_an_electrodes_range_are_no_limit():
    e, _, rng = pressed(3)
    e = noisy(e, rng)
    broken, clipped = e.copy(), e.copy()
    for a in (900, 2000, 3100, 4300, 5600, 6800):
        broken[a : a + 300, 6] = 4095
    clipped[:, 6] = np.minimum(e[:, 6], np.quantile(e[:, 6], 0.8))
    for name, counts in (("stuck", broken), ("saturate", clipped)):
        checked = check(Log(as_read(counts)))
        assert {f.id for f in (*checked.faults, *checked.weak)} == {name}


def test_an_electrode_with_a_limit_may_be_stuck_as_well():
    """At an end of the converter for the last quarter, where nothing is measured any more."""
    e, _, rng = pressed(3)
    counts = noisy(e, rng)
    counts[:, 6] = np.minimum(counts[:, 6], np.quantile(counts[:, 6], 0.8))
    counts[-len(counts) // 4 :, 6] = 0
    found = [f for f in stuck_or_clipped(Log(as_read(counts))) if f.channels == (6,)]
    assert {f.id for f in found} == {"saturate", "stuck"} and all(f.mask[:, 6].any() for f in found)
    assert next(f for f in found if f.id == "stuck").mask[-len(counts) // 4 :, 6].all()


def test_codes_that_a_converter_prefers_are_no_limit():
    """Nor is the rest of a log that tells how far, and not which way."""
    rng = np.random.default_rng(0)
    x = noisy(np.full((4500, 19), 2700.0), rng)
    x[:, 6] = np.array([2965, 2976, 2991, 2998])[rng.integers(0, 4, len(x))]
    assert not stuck_or_clipped(Log(x))
    folded, _, _ = touched()
    folded = -np.maximum(np.abs(folded - folded[:1]) - 20, 0)
    assert not [f for f in stuck_or_clipped(Log(folded, converter=False)) if f.beyond > 0]


def test_each_of_several_electrodes_may_be_limited():
    """Five at ends of their own; of five that stand still for a while within what they read none is."""
    e, _, rng = pressed(5)
    own, calm = e.copy(), noisy(e, np.random.default_rng(1))
    for k in (2, 5, 8, 11, 14):
        own[:, k] = np.minimum(e[:, k] + 4 * rng.standard_normal(len(e)), np.quantile(e[:, k], 0.75))
        calm[4000:4200, k] = np.round(np.median(calm[4000:4200, k]))
    own = np.where(np.isin(np.arange(19), (2, 5, 8, 11, 14)), np.rint(own), noisy(e, rng))
    assert [c for i, c in named(own) if i == "saturate"] == [(2,), (5,), (8,), (11,), (14,)]
    assert "saturate" not in {i for i, _ in named(calm)}


def test_a_filter_is_no_limit_and_a_limit_may_begin_late():
    """A filtered electrode stands still in the middle of its range, too."""
    counts, _, _ = touched()
    filtered, late = counts.copy(), counts.copy()
    filtered[:, 6] = signal.medfilt(counts[:, 6], 61)
    late[1500:, 6] = np.minimum(counts[1500:, 6], np.quantile(counts[1500:, 6], 0.6))
    assert late[:1500, 6].max() > late[1500:, 6].max() + 50
    assert stuck_or_clipped(Log(filtered)) == []
    assert [(f.id, f.channels) for f in stuck_or_clipped(Log(late))] == [("saturate", (6,))]


def test_a_limit_that_gives_way_is_one():
    counts, _, rng = pressed(3)
    counts = noisy(counts, rng)
    level = np.quantile(counts[:, 4], 0.2)
    counts[:, 4] = np.where(counts[:, 4] < level, level + 0.04 * (counts[:, 4] - level), counts[:, 4])
    assert named(counts) == [("saturate", (4,))]


@pytest.mark.parametrize("end", (0, 4095))
def test_rows_at_an_end_of_the_converter_are_no_overflow(end):
    """Ten rows in which nothing was measured. A load that takes an electrode there and back is none."""
    for e, rng in (unloaded(1, 20), (pressed(1, 20)[0], np.random.default_rng(1))):
        counts = noisy(e, rng)
        x = counts.copy()
        x[1000:1010] = end
        (found,) = faults(x)
        assert (found.id, found.channels) == ("lost_rows", ALL) and found.mask[1000:1010].all()
        lines = findings(Recording(np.arange(len(x)) / RATE, x, units={"electrodes": "counts"}))
        assert not any("saturated" in line for line in lines)
        way = np.clip((13 - np.abs(np.arange(2000) - 1004.5)) / 8, 0, 1)
        x = counts.copy()
        x[:, 6] += np.rint(way * (end - x[:, 6]))
        assert (x[1000:1010, 6] == end).all() and not faults(x)


@pytest.mark.parametrize("size", (0.6, 1.2, 4.0))
def test_an_electrode_that_stands_still_for_a_part_is_stuck(size):
    """Whatever its noise is, for half a second and more; where values stay for long by themselves none is."""
    e, _, rng = pressed(2, 30)
    counts = noisy(e, rng, size)
    seldom = 2000 + np.cumsum(rng.choice([-1, 0, 1], counts.shape, p=[0.01, 0.98, 0.01]), axis=0)
    assert not faults(counts) and not stuck_or_clipped(Log(seldom))
    for rows in (50, 300, 1200):
        x = counts.copy()
        x[1000 : 1000 + rows, 6] = x[1000, 6]
        (found,) = faults(x)
        assert (found.id, found.channels) == ("stuck", (6,))
        assert abs(found.start - 10) < 0.1 and abs(found.end - 10 - rows / RATE) < 0.1


# --- codes ---


def test_values_may_be_coarse_from_a_time_on():
    """Multiples of six and one, from 13 s on, of all electrodes or of two, which have no limit there."""
    e, rng = unloaded(4)
    counts = noisy(e, rng)
    for channels in (ALL, (3, 9)):
        x = counts.copy()
        x[1300:, channels] = 6 * np.round(x[1300:, channels] / 6) + 1
        (one,) = faults(x)
        assert one.id == "quantise" and one.channels == channels
        assert one.parameters["step"][0] == 6 and abs(one.start - 13) < 0.2 and one.p < 1e-6


def test_digits_of_one_channel_and_an_end_of_the_converter():
    """One electrode's lowest bits are zero; another is pushed to 4095 by the load and comes back. Coarse
    values of all repeat rows by chance and jump, which is no second fault, and so are counts of 500 steps."""
    e, _, rng = pressed(4, 40)
    one, k = noisy(e, rng), int(np.ptp(e, axis=0).argmax())
    one[:, k] -= one[:, k] % 16
    assert named(one) == [("quantise", (k,))]
    top = e.copy()
    top[:, 6] += 4095 - np.quantile(e[:, 6], 0.8)
    assert named(noisy(top, rng)) == [("saturate", (6,))]
    whole, _ = unloaded(5, seconds=20)
    x = noisy(whole, rng, 3.0)
    assert named(np.rint(x / 16) * 16) == [("quantise", ALL)]
    assert named(np.rint(np.rint(noisy(e, rng) / 4095 * 500) * 4095 / 500)) == [("quantise", ALL)]


@pytest.mark.parametrize("number", [2, 19])
def test_lost_upper_bits_are_put_back(number):
    whole, cut = overflowing(1, number, 1024, 900)
    fixed, (fault,) = put_back(Log(cut))
    assert fault.id == "overflow" and "overflow at 1024" in fault.message and len(fault.channels) == number
    np.testing.assert_array_equal(fixed.counts, whole)
    assert named(cut) == [("overflow", fault.channels)] and named(whole) == []


def test_flipped_bits_and_drop_outs_are_no_overflow():
    counts, rng = unloaded(4, 40)
    x = noisy(counts, rng)
    rows = rng.choice(len(x), 30, replace=False)
    x[rows, 5] = np.rint(x[rows, 5]).astype(int) ^ 1024
    x[:, 7] += 2048 - np.median(x[:, 7])
    x[rng.choice(len(x), 30, replace=False), 7] = 0
    assert put_back(Log(as_read(x)))[1] == []


# --- spikes ---


def test_spikes_are_told_by_the_noise_around_them():
    e, rng = unloaded(5, seconds=10)
    counts = noisy(e, rng, 0.4)
    assert not faults(counts)
    counts[50::70, 4] -= 12
    assert named(counts) == [("spikes", (4,))]


def test_what_leaves_for_more_than_a_sample_is_a_contact():
    """A loose contact: 12 times for one to three rows."""
    e, rng = unloaded(4)
    counts = noisy(e, rng)
    for n, row in enumerate(range(300, 5700, 450)):
        counts[row : row + 1 + n % 3, 5] -= 300
    (found,) = faults(counts)
    assert (found.id, found.channels) == ("contact", (5,)) and "e6 jumps away and returns" in found.message


def test_rows_where_all_electrodes_jump_are_common_spikes():
    """A supply that gives way for a row; a touch, which needs some rows to come and go, is none."""
    e, rng = unloaded(5, seconds=10)
    e[300:312] -= 80 * np.hanning(12)[:, None]
    counts = noisy(e, rng)
    assert not faults(counts)
    counts[[150, 420, 421, 700]] = 0
    assert named(counts) == [("spikes", ALL)]
    for row in (0, 1, -2, -1):  # also a single one, also at an end
        counts = noisy(e, rng)
        counts[row] -= 600
        assert named(counts) == [("spikes", ALL)], row


def test_common_spikes_are_chance_by_the_fourth_power_of_time():
    """Four of them, in a log four times as long: Poisson's law."""
    chance = []
    for seconds in (10, 40):
        counts = noisy(*unloaded(5, seconds=seconds))
        counts[[150, 420, 421, 700]] = 0
        (found,) = faults(counts)
        chance.append(found.p)
    assert chance[1] == pytest.approx(4**4 * chance[0], rel=0.05, abs=0)


@pytest.mark.parametrize("every, size", [(7, -90), (10, 60), (50, 60)])
def test_rows_that_are_off_again_and_again_are_one_fault(every, size):
    """They come as evenly as a hum does, and what lies between them looks held."""
    e, rng = unloaded(every, seconds=40)
    e[3::every] += size
    assert named(noisy(e, rng)) == [("spikes", ALL)]


# --- hum ---


@pytest.mark.parametrize("hz", (49.95, *(pytest.param(f, marks=pytest.mark.slow) for f in (48.9, 20.3))))
def test_weak_hum_is_named(hz):
    """4 counts at noise of 4, up to half of the rate, where a beat makes it small for seconds; and from four
    tenths of the rows on."""
    e, rng = unloaded(2)
    time = np.arange(len(e)) / RATE
    wave = 4 * np.sin(2 * np.pi * hz * time + 0.4)[:, None] * rng.uniform(0.6, 1.4, 19)
    for on in (time >= 0, time > 0.4 * time[-1]):
        (found,) = faults(noisy(e + wave * on[:, None], rng))
        assert found.id == "hum" and abs(found.parameters["frequency"][0] - hz) < 0.1
    one = noisy(e + 1.5 * wave[:, [4]] * np.eye(19)[4], rng)
    (found,) = hum(Log(one))
    assert 4 in found.channels and confidence(found) >= NAMED


@pytest.mark.parametrize("hz", (12.5, 49.95))
def test_hum_and_an_electrode_that_stands_still_are_both_named(hz):
    """Also where a beat makes the hum small for seconds, in which others stand nearly still."""
    e, _, rng = pressed(1, 30)
    wave = 8 * np.sin(2 * np.pi * hz * np.arange(len(e)) / RATE)[:, None] * rng.uniform(0.6, 1.4, 19)
    counts = noisy(e + wave, rng)
    counts[1000:1450, 6] = counts[1000, 6]
    both = faults(counts)
    assert {(f.id, f.channels) for f in both} == {("hum", ALL), ("stuck", (6,))}
    (stuck,) = (f for f in both if f.id == "stuck")
    assert abs(stuck.start - 10) < 0.1 and abs(stuck.end - 14.5) < 0.1


def test_motion_of_the_hand_is_no_hum():
    """Load at 1 Hz for the whole log; a line above the load's band is one."""
    e, _, rng = pressed(7)
    t = np.arange(len(e)) / RATE
    direction = rng.standard_normal(19)
    z = np.log(4095 / e - 1) + 0.08 * np.sin(2 * np.pi * t + 0.5 * np.sin(0.3 * t))[:, None] * direction
    e = 4095 / (1 + np.exp(z))
    assert not faults(noisy(e, rng))
    line = 8 * np.sign(np.sin(2 * np.pi * 31.7 * t))[:, None]
    assert "hum" in {i for i, _ in named(noisy(e + line, rng))}


@pytest.mark.parametrize("clock", ["sensor", "logger"])
def test_a_line_is_found_by_the_clock_that_sampled_it(clock):
    """A logger that repeats rows tears a wave that the sensor sampled evenly; what came in behind the bus is
    even in the logger's rows."""
    counts, _, _ = touched()
    noise = electrode_noise(counts.mean(0))

    def wave(rows, rate):
        return 2 * noise[4] * np.sin(2 * np.pi * 46.0 * np.arange(rows) / rate)

    if clock == "sensor":
        counts[:, 4] += np.rint(wave(len(counts), BUS))
        counts = through_a_bus(counts)
    else:
        counts = through_a_bus(counts)
        counts[:, 4] += np.rint(wave(len(counts), LOGGER))
    (found,) = hum(Log(counts, LOGGER))
    assert found.channels == (4,) and abs(found.parameters["frequency"][0] - 46.0) < 0.1
    rest = found.correct(counts, np.arange(len(counts)) / RATE)
    assert np.std(rest[:, 4] - counts[:, 4]) > noise[4] and (rest[:, :4] == counts[:, :4]).all()
    assert hum(Log(through_a_bus(touched()[0]), LOGGER)) == []


# --- rows ---


def test_rows_that_no_bus_repeats_are_held():
    """A slower bus repeats rows evenly, or now and then one more: a logger may hold them for longer."""
    read = through_a_bus(touched()[0])
    rng, n = np.random.default_rng(1), len(read)
    at = np.arange(n)
    again = rng.random(n) < 0.15
    again[0] = False
    last = np.maximum.accumulate(np.where(again, 0, at))
    late = np.where(at < 0.4 * n, at, at - at % 3)

    def held(rows):
        return bool(sample_and_hold(Log(read[rows], LOGGER, True)))

    assert not any(map(held, (at, last, late, at - at % 3)))
    assert held(np.where((at > 500) & (at < 600), 500, at))


def test_lost_rows_are_found_where_they_were():
    e, _, rng = pressed(12, 50)
    keep = np.ones(len(e), bool)
    keep[2000:2300] = keep[4000:4250] = False
    (found,) = faults(noisy(e, rng, 2.0)[keep])
    assert found.id == "lost_rows" and abs(found.start - 20) < 0.05


def test_rows_that_follow_held_ones_are_not_lost():
    e, _, rng = pressed(12, 50)
    x = noisy(e, rng, 2.0)
    for row in (2000, 4000):
        x[row : row + 250] = x[row - 1]
    assert ("lost_rows", ALL) not in named(x)


def test_rows_are_lost_only_if_the_other_device_lost_them_too():
    counts, force, _ = touched(seed=3, seconds=60)
    keep = np.ones(len(counts), bool)
    for row in (900, 1730, 3110):
        keep[row : row + 130] = False
    n, x = keep.sum(), counts[keep]
    assert named(x) == named(x, other_device=force[keep]) == [("lost_rows", ALL)]
    assert named(x, other_device=force[:n]) == named(x, missing=np.zeros(n, int)) == [("jump", ())]


def test_halves_that_are_exchanged_are_no_lost_rows():
    counts, _, _ = touched(seed=8)
    third = len(counts) // 3
    assert named(np.r_[counts[third:], counts[:third]]) == [("order", ())]


def test_rows_that_are_logged_twice_are_one_fault():
    """A block and scattered rows, late; also of a quiet sensor, whose rows may be equal by chance."""
    e, _, rng = pressed(3, 50)
    for size in (0.6, 4.0):
        counts = noisy(e, rng, size)
        (fault,) = faults(np.r_[counts[:3000], counts[2000:2500], counts[3000:]])
        assert fault.id == "again" and (fault.start, fault.end) == (30.0, 34.99)
        assert fault.message.startswith(
            "500 rows come again, in all electrodes: rows 3001 to 3500 are as from"
        )
        assert fault.mask[3000:3500].all() and fault.mask.sum() == 500 * 19
    late = counts.copy()
    late[1000:1200:20] = counts[990:1190:20]
    assert [f.id for f in logged_twice(Log(late))] == ["again"] and logged_twice(Log(late))[0].p < 1e-6


def test_rows_that_are_equal_by_chance_are_not_logged_twice():
    """Of a sensor with so little noise that half of the rows come again."""
    e, rng = unloaded(6, 20)
    counts = noisy(e, rng, 0.25)
    (fault,) = logged_twice(Log(counts))
    assert fault.mask.all(1).mean() > 0.3 and fault.p > 0.5 and not faults(counts)


# --- clocks ---


def test_rows_that_the_clock_misses_are_lost():
    """At rest, where no jump tells of them. Clocks that only tremble, whose stamps come late or that are as
    coarse as the rows miss none."""
    rng, n = np.random.default_rng(7), 2000
    even = np.arange(n) / RATE
    few = np.delete(np.arange(n), [*range(300, 330), *range(900, 907)])
    many = np.flatnonzero(rng.random(n) < 0.7)
    late = even + 0.85 / RATE * (rng.random(n) < 0.01)
    missing = missing_rows(even[few])
    assert missing.sum() == 37 and np.flatnonzero(missing).tolist() == [300, 870]
    (found,) = faults(noisy(*unloaded(7, 20))[few], missing=missing)
    assert found.id == "lost_rows" and found.parameters["seconds"][0] == pytest.approx(0.37)
    assert found.places == (3.0, 8.7) and found.message.startswith("clock: 2 gaps, the longest of 30 rows")
    assert abs(missing_rows(even[many]).sum() - (n - len(many))) <= 2
    trembling = even + rng.uniform(-0.25, 0.25, n) / RATE
    assert abs(missing_rows(trembling[few]).sum() - 37) <= 2
    coarse = np.floor(np.arange(n) / 97.0 * RATE) / RATE
    for time in (trembling, even + rng.uniform(-0.4, 0.4, n) / RATE, late, coarse):
        missing = missing_rows(np.maximum.accumulate(time) + 1e-9 * np.arange(n))
        assert missing is None or not missing.any()


@pytest.mark.parametrize("pace", (1.0, 1.35))
def test_a_clock_that_changes_its_pace_is_said(pace):
    rng = np.random.default_rng(0)
    step = np.where(np.arange(2000) < 700, 0.01, 0.01 * pace) + 2e-3 * rng.random(2000)
    _, found = clock_faults(np.cumsum(step), None)
    said = [f.message[:50] for f in found]
    assert said == (["the clock changes its pace: rows lie 11 ms apart i"] if pace > 1 else [])


def test_a_clock_that_leaps_misses_no_row():
    """By an hour, while the electrodes go on; where they are elsewhere afterwards an hour is missing."""
    counts, rows = noisy(*pressed(4, 24)[::2]), np.arange(2400)
    missing, (fault,) = clock_faults(rows / RATE + 3600.0 * (rows >= 1000), counts)
    assert not missing.any() and fault.id == "clock" and "leaps by 3600 s before row 1001" in fault.message
    gone = np.delete(rows, np.arange(900, 1100))
    missing, found = clock_faults(gone / RATE + 3600.0 * (gone >= 1000), counts[gone])
    assert missing.max() > 3600 * RATE and not found


# --- verbs ---


def held(x):
    return np.r_[x[:1000], np.repeat(x[1000:1001], 200, axis=0), x[1200:]]


def spoiled():
    """Logs with faults: name -> changes of counts (n, 19), each of which is one fault."""

    def of_one(k, change):
        def act(x):
            x = x.copy()
            change(x, k)
            return x

        return act

    several = (
        of_one(2, lambda x, k: np.copyto(x[:, k], 2000)),  # dead
        of_one(5, lambda x, k: np.copyto(x[800:1500, k], x[800, k])),  # stuck
        of_one(7, lambda x, k: np.minimum(x[:, k], np.quantile(x[:, k], 0.7), out=x[:, k])),  # clipped
        of_one(11, lambda x, k: np.copyto(x[100::130, k], 0)),  # spikes
    )
    return {
        "several": several,
        "coarse": [lambda x: 8 * np.rint(x / 8)],
        "held": [held],
        "hum": [lambda x: x + np.rint(6 * np.sin(2 * np.pi * 31.7 * np.arange(len(x)) / RATE))[:, None]],
        "gap": [lambda x: x],
        "twice": [lambda x: np.r_[x[:1200], x[500:1200], x[1200:]]],
        "overflow": [lambda x: overflowing(1, 3, 1024, 900)[1]],
    }


@pytest.mark.parametrize("name", spoiled())
def test_show_import_and_diagnose_say_the_same(tmp_path, capsys, name):
    """Each fault of a file once, in the same words."""
    counts, changes = touched(seconds=30)[0], spoiled()[name]
    for change in changes:
        counts = change(counts)
    time = np.arange(len(counts)) / RATE
    keep = np.delete(np.arange(len(counts)), np.arange(1000, 1030) if name == "gap" else [])
    log, rec, out = (str(tmp_path / one) for one in ("log.csv", "rec.h5", "out"))
    header = ",".join(["time", *(f"e{k + 1}" for k in range(19))])
    np.savetxt(log, np.column_stack([time, counts])[keep], "%.9g", ",", header=header, comments="")
    found = [f.message for f in faults(counts[keep], clocked=True, missing=missing_rows(time[keep]))]
    assert len(found) == len(changes)
    assert name != "twice" or found[0].endswith("logged twice")
    for words in (
        ["recording", "import", log, "--out", rec],
        ["recording", "show", rec, "--out", str(tmp_path / "show.png")],
        ["diagnose", "--electrodes", rec, "--out", out],
    ):
        assert cli.main(words) == 0
        said = capsys.readouterr().out
        for message in found:
            assert message in said, words[0]
            assert words[0] == "diagnose" or said.count(message) == 1
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    told = [*(e["note"] for e in verdict["effects"]), *verdict["warnings"], verdict["remainder"]["text"]]
    assert [sum(message in line for line in told) for message in found] == [1] * len(found)


def test_what_is_wrong_is_said_of_recordings_in_other_units():
    """Of volts what never changes, of tared counts all but the ends of the converter."""
    counts, _, _ = touched(seconds=20)
    counts[500:1200, 3] = counts[500, 3]
    time = np.arange(len(counts)) / RATE
    for unit, value in (("tared counts", counts - counts[0]), ("counts", counts)):
        said = findings(Recording(time, value, units={"electrodes": unit}))
        assert sum("e4 is constant" in line for line in said) == 1, said
    volts = counts / 1000
    volts[:, 9] = 1.0
    said = findings(Recording(time, volts, units={"electrodes": "volts"}))
    assert [line for line in said if line.startswith("warning")] == [
        "warning: e10 never changes: is it dead? Models that use it are wrong there"
    ]


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_log_in_which_nothing_has_noise_is_read_in_silence():
    """Eighteen constant columns and one that counts rows: numpy warned of slices that are all NaN."""
    counts = np.full((300, 19), 3000.0)
    counts[:, 18] += np.arange(300)
    assert "never changes" in findings(Recording(np.arange(300) / 450, counts))[-1]


def test_a_clock_that_cannot_be_right_misses_no_row(tmp_path):
    """One that leaps is said once; one that starts anew or stands still does not count rows."""
    counts, _, _ = touched(seconds=20)
    n = len(counts)
    even = np.arange(n) / RATE
    clocks = {
        "leaps by 3600 s": even + 3600.0 * (np.arange(n) >= 1000),
        "starts anew in row 800": even - 8.0 * (np.arange(n) >= 800),
        "does not increase were left out": np.repeat(even[: n // 2] * 2, 2),
    }
    header = ",".join(["time", *(f"e{k + 1}" for k in range(19))])
    for said, time in clocks.items():
        table = np.column_stack([time, counts])
        np.savetxt(tmp_path / "log.csv", table, "%.9g", ",", header=header, comments="")
        read = read_recording(tmp_path / "log.csv")
        assert read.missing is None or not read.missing.any()
        assert len(read.warnings) == 1 and said in read.warnings[0]


def slow(seed, rate, size=1.2):
    """Counts of touches that come within 0.4 s and go within 0.3 s."""
    t, rng = np.arange(800) / rate, np.random.default_rng(seed)
    begin = np.arange(4, t[-1] - 3, 5.5)
    touches = [np.clip(np.minimum((t - a) / 0.4, (a + 2 - t) / 0.3), 0, 1) for a in begin]
    load = sum(rng.uniform(0.5, 3) * touch for touch in touches)
    counts = rng.uniform(1800, 3300, 19) + np.tanh(load[:, None]) * rng.normal(-40, 60, 19)
    return np.rint(counts + rng.normal(0, size, counts.shape)), rng


@pytest.mark.parametrize("rate", (20.0, 25.0, 40.0))
def test_slow_logs_hold_no_values_where_a_load_moves(rate):
    """Of few rows in a touch there are few large differences among small ones, as of held values."""
    for seed in (5, 9, 14, 15):
        assert check(Log(slow(seed, rate)[0], rate)).faults == []


def test_a_log_in_which_nothing_changes_is_said_once():
    counts = np.tile(np.linspace(1800, 3000, 19).round(), (1000, 1))
    lines = findings(Recording(np.arange(1000) / RATE, counts, units={"electrodes": "counts"}))
    assert sum(line.startswith("warning") for line in lines) == 1 and not faults(counts)


def test_spikes_of_nearly_a_band_are_no_overflow():
    """Of 500 counts up and 400 down, one or two of an electrode, 12 counts from a band of 512."""
    for seed in (0, 1, 2):
        rng = np.random.default_rng(seed)
        counts = rng.uniform(1800, 3300, 19) + rng.normal(0, 1.2, (6000, 19))
        row = rng.choice(6000, 40, False)
        counts[row, rng.integers(0, 19, 40)] += rng.choice([-400, 500], 40)
        assert not check(Log(np.rint(counts), 1000.0)).faults


@pytest.mark.parametrize("begins, ends", [(0.5, 1.0), (0.0, 0.5), (0.3, 0.75)])
def test_noise_may_begin_and_end_within_a_log(begins, ends):
    counts, _, rng = pressed(11)
    counts = noisy(counts, rng)
    rows = slice(round(begins * len(counts)), round(ends * len(counts)))
    counts[rows, 4] += np.rint(12 * rng.standard_normal(rows.stop - rows.start))
    (fault,) = check(Log(counts)).faults
    assert (fault.id, fault.channels) == ("noise", (4,))
    length = len(counts) / RATE
    assert fault.start == pytest.approx(begins * length, abs=length / 15)
    assert fault.end == pytest.approx(ends * length, abs=length / 15)
