"""Faults of rows and of noise in plain recordings, and what only looks like them. All of it is synthetic."""

import numpy as np
import pytest
from scipy import signal
from scipy.ndimage import uniform_filter1d

from biotac_mj.discrepancy import PlainRecording, diagnose_recording, read_recording
from biotac_mj.discrepancy.recordings.confidence import NAMED, confidence
from biotac_mj.discrepancy.recordings.families.levels.jumps import edges, jumped
from biotac_mj.discrepancy.recordings.families.noise.colour import coloured
from biotac_mj.discrepancy.recordings.families.noise.correlated import correlated
from biotac_mj.discrepancy.recordings.families.noise.dull import dulled
from biotac_mj.discrepancy.recordings.families.noise.heard import heard
from biotac_mj.discrepancy.recordings.families.noise.lines import humming
from biotac_mj.discrepancy.recordings.families.noise.size import noisy as noisy_ones
from biotac_mj.discrepancy.recordings.families.samples.sampling import sampling_faults
from biotac_mj.discrepancy.recordings.families.samples.still import standing_still
from biotac_mj.discrepancy.recordings.search import electronics
from biotac_mj.discrepancy.recordings.session import Session
from biotac_mj.recordings.recording import CLOCKED
from biotac_mj.sensor.channels import electrode_noise

RATE, BUS = 118.0, 100.0


def touched(seed=0, seconds=40, rate=BUS):
    """Counts (n, 19), force (n, 3) and a generator: touches of a second at changing places, as noisy as
    a sensor is."""
    rng = np.random.default_rng(seed)
    n = int(seconds * rate)
    kernel = np.hanning(41) / np.hanning(41).sum()
    steps = np.repeat(rng.uniform(-1, 1, (n // 120 + 2, 5)), 120, axis=0)[: n + 40]
    state = np.column_stack([np.convolve(x, kernel, "valid") for x in steps.T])
    clean = rng.uniform(2100, 3200, 19) + 120 * state @ rng.standard_normal((5, 19))
    clean = np.clip(clean, 200, 3900)
    counts = np.rint(clean + electrode_noise(clean) * rng.standard_normal(clean.shape))
    force = state[:, :3] * [1.0, 1.0, 4.0] + 0.01 * rng.standard_normal((n, 3))
    return np.clip(counts, 0, 4095), force, rng


def through_a_bus(counts):
    """As a logger of RATE writes what a bus brings a hundred times a second."""
    rows = int(len(counts) * RATE / BUS)
    return counts[np.minimum((np.arange(rows) * BUS / RATE).astype(int), len(counts) - 1)]


def session_of(counts, rate=BUS, force=None):
    recording = PlainRecording(counts, force, rate=rate)
    return Session(recording, np.arange(len(counts)) < 0.6 * len(counts))


def held(counts, source=CLOCKED):
    recording, found = PlainRecording(counts, rate=RATE, rate_source=source), []
    session = Session(recording, np.arange(len(counts)) < 0.6 * len(counts))
    sampling_faults(session, lambda f: found.append(f.id) or False)
    return "freeze" in found


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
        counts[:, 4] += np.rint(wave(len(counts), RATE))
    session = session_of(counts, RATE)
    found = humming(session)
    assert found.channels == (4,) and abs(found.parameters["frequency"][0] - 46.0) < 0.1
    rest = found.correct(counts, session.recording.time)
    assert np.std(rest[:, 4] - counts[:, 4]) > noise[4] and (rest[:, :4] == counts[:, :4]).all()
    assert humming(session_of(through_a_bus(touched()[0]), RATE)) is None


def test_rows_that_no_bus_repeats_are_held():
    """Where the rate is only said, rows that all repeat may be of a faster logger."""
    read = through_a_bus(touched()[0])
    rng, n = np.random.default_rng(1), len(read)
    at = np.arange(n)
    again = rng.random(n) < 0.15
    again[0] = False
    last = np.maximum.accumulate(np.where(again, 0, at))
    late = np.where(at < 0.4 * n, at, at - at % 3)
    assert not held(read)
    assert held(read[last]) and held(read[last], "given")
    assert held(read[late]) and held(read[late], "given")
    assert held(read[at - at % 3]) and not held(read[at - at % 3], "given")


def test_a_filter_is_no_limit_and_a_limit_may_begin_late():
    """A filtered electrode stands still in the middle of its range, too."""
    counts, _, _ = touched()
    filtered, late = counts.copy(), counts.copy()
    filtered[:, 6] = signal.medfilt(counts[:, 6], 61)
    late[1500:, 6] = np.minimum(counts[1500:, 6], np.quantile(counts[1500:, 6], 0.6))
    assert late[:1500, 6].max() > late[1500:, 6].max() + 50
    assert standing_still(session_of(filtered)) == []
    assert [(f.id, f.channels) for f in standing_still(session_of(late))] == [("saturate", (6,))]
    assert dulled(session_of(filtered)).channels == (6,) and confidence(dulled(session_of(filtered))) > NAMED


@pytest.mark.parametrize("channels", ([4], [2, 8, 13]))
def test_electrodes_that_are_noisy_alike_are_all_named(channels):
    counts, _, rng = touched()
    counts[:, channels] += 3 * electrode_noise(counts[:, channels]) * rng.standard_normal((len(counts), 1))
    counts[:, channels] += (
        3 * electrode_noise(counts[:, channels]) * rng.standard_normal((len(counts), len(channels)))
    )
    found = noisy_ones(session_of(np.rint(counts)))
    assert sorted(f.channels for f in found) == [(k,) for k in channels]


def test_noise_of_all_electrodes_is_beside_the_law():
    counts, _, rng = touched()
    assert noisy_ones(session_of(counts)) == []
    loud = np.rint(counts + 2 * electrode_noise(counts) * rng.standard_normal(counts.shape))
    (found,) = noisy_ones(session_of(loud))
    assert len(found.channels) == 19
    assert found.parameters["factor"][0] == pytest.approx(np.sqrt(5), rel=0.15)
    loud[: len(loud) // 3] = counts[: len(counts) // 3]  # since some time
    (found,) = noisy_ones(session_of(loud))
    assert len(found.channels) == 19 and found.start > 0


@pytest.mark.parametrize("channels", ((6,), (3, 11)))
def test_a_filter_of_some_electrodes_takes_their_noise(channels):
    """A load of 2 Hz is hardly late through a mean of five rows, and the noise is gone."""
    counts, _, _ = touched()
    found = dulled(session_of(counts))
    assert found is None or confidence(found) < NAMED
    counts[:, channels] = np.rint(uniform_filter1d(counts[:, channels], 5, axis=0))
    found = dulled(session_of(counts))
    assert found.channels == channels and confidence(found) >= NAMED and found.p < 0.02
    counts[:, channels] = np.rint(np.median(counts[:, channels], axis=0))  # dead, and no filter
    found = dulled(session_of(counts))
    assert found is None or confidence(found) < NAMED


def test_a_sharp_filter_leaves_no_colour_and_no_noise():
    counts, _, _ = touched(0, 60)
    assert (found := coloured(session_of(counts))) is None or confidence(found) < NAMED
    sharp = np.rint(signal.sosfiltfilt(signal.butter(6, 0.1, output="sos"), counts, axis=0))
    found = coloured(session_of(sharp))
    assert found.clues["ratio"] < 0.5 and confidence(found) >= NAMED
    # from a quarter of the rows on it is too unsure as one that is always there
    n, taken = len(counts) // 4, []
    counts[n:] = np.rint(signal.sosfiltfilt(signal.butter(2, 0.12, output="sos"), counts, axis=0))[n:]
    assert confidence(coloured(session_of(counts))) < NAMED
    electronics(session_of(counts), lambda f: confidence(f) >= NAMED and not taken.append(f))
    assert [f.id for f in taken] == ["lowpass"] and taken[0].start > 0


@pytest.mark.slow  # quick: spikes are told by the noise around them
def test_large_samples_of_a_noisy_electrode_are_no_spikes():
    counts, force, rng = touched()
    counts[:, 6] += np.rint(30 * rng.standard_t(2.5, len(counts)))
    named = diagnose_recording(PlainRecording(np.clip(counts, 0, 4095), force, rate=BUS)).findings
    (noise,) = [f for f in named if f.channels == (6,)]
    assert noise.id == "noise" and noise.ties == ("spikes",)


@pytest.mark.slow  # quick: electrodes that are connected
def test_a_loose_contact_is_no_noise_but_unknown():
    counts, _, rng = touched()
    loose = np.zeros(len(counts), bool)
    for row in rng.integers(0, len(counts) - 60, 40):
        loose[row : row + int(rng.exponential(12)) + 2] = True
    counts[loose, 6] += np.rint(500 + 90 * rng.standard_normal(loose.sum()))
    session = session_of(np.clip(counts, 0, 4095))
    assert noisy_ones(session) == [] and session.unnamed[0].startswith(
        "e7 is again and again off to one side"
    )
    assert diagnose_recording(session.recording).rest.significant


@pytest.mark.parametrize("always", (True, False))
def test_a_filter_is_there_in_every_block_and_a_fast_touch_is_not(always):
    rng = np.random.default_rng(0)
    white = rng.standard_normal((6400, 19))
    dull = np.apply_along_axis(np.convolve, 0, white, [0.3, 0.4, 0.3], "same")
    touch = np.ones(6400) if always else (np.arange(6400) % 3200 > 400)
    counts = np.rint(2600 + 6 * dull * touch[:, None] + 1.5 * white * (1 - touch)[:, None])
    assert (coloured(session_of(counts)) is not None) == always


@pytest.mark.parametrize("stays", (True, False))
def test_a_touch_that_one_electrode_alone_feels_is_no_jump(stays):
    counts, _, _ = touched()
    change = np.zeros(len(counts))
    change[1310:] = -400
    if not stays:  # it is there from one row to the next, and goes with the load
        change *= np.clip((1310 + 90 - np.arange(len(counts))) / 40, 0, 1)
    counts[:, 16] += np.rint(change)
    session = session_of(counts)
    assert list(edges(session)) == [16]
    assert [f.channels for f in jumped(session)] == ([(16,)] if stays else [])


def jumps(counts, force, missing=None):
    d = diagnose_recording(PlainRecording(counts, force, rate=BUS, missing=missing))
    return "lost_rows" in {f.id for f in d.findings}, "all electrodes jump" in d.rest.text


@pytest.mark.slow
def test_rows_are_lost_only_if_what_lies_beside_them_misses_them_too():
    counts, force, _ = touched(seed=3, seconds=60)
    keep = np.ones(len(counts), bool)
    for row in (900, 1730, 3110):
        keep[row : row + 130] = False
    n = keep.sum()
    assert jumps(counts[keep], None) == (True, False)
    assert jumps(counts[keep], force[keep]) == (True, False)
    assert jumps(counts[keep], force[:n]) == (False, True)
    assert jumps(counts[keep], None, np.zeros(n, int)) == (False, True)


@pytest.mark.slow  # quick: exchanges, and lost rows
def test_halves_that_are_exchanged_are_no_lost_rows():
    counts, _, _ = touched(seed=8)
    half = len(counts) // 3
    assert jumps(np.r_[counts[half:], counts[:half]], None) == (False, True)


@pytest.mark.parametrize("share", (0.0, 0.5))
def test_cross_talk_that_begins_late_has_its_time_and_is_taken_out_from_there(share):
    counts, _, _ = touched()
    late = np.arange(len(counts)) >= 0.3 * len(counts)
    mixed = counts.copy()
    mixed[:, 3] += share * late * (counts[:, 2] - counts[:, 2].mean())
    found = heard(session_of(np.rint(mixed)))
    if not share:
        assert found is None
        return
    assert found.channels == (2, 3)
    time = np.arange(len(counts)) / BUS
    assert 0.299 <= found.start / time[-1] <= 0.41  # two thirds of what is fitted
    after = time > found.start
    without, with_it = ((x - counts)[after, 3].std() for x in (found.correct(mixed, time), mixed))
    assert without < 0.4 * with_it
    np.testing.assert_array_equal(found.correct(mixed, np.zeros(len(counts))), mixed)


@pytest.mark.parametrize("pace", (1.0, 1.35))
def test_a_clock_that_changes_its_pace_is_unknown(tmp_path, pace):
    counts, _, rng = touched(seconds=20)
    step = np.where(np.arange(len(counts)) < 700, 0.01, 0.01 * pace) + 2e-3 * rng.random(len(counts))
    table = np.column_stack([np.cumsum(step), counts])
    header = ",".join(["time", *(f"e{k + 1}" for k in range(19))])
    np.savetxt(tmp_path / "log.csv", table, "%.6g", ",", header=header, comments="")
    said = read_recording(tmp_path / "log.csv").warnings
    assert any(line.startswith("the clock changes its pace: rows lie 11 ms") for line in said) == (pace > 1)


@pytest.mark.parametrize("wired", (True, False))
def test_cross_talk_is_between_few_and_a_load_between_all(wired):
    counts, _, rng = touched()
    size = electrode_noise(counts[0])
    if wired:  # the order of the multiplexer
        counts = 0.7 * counts + 0.3 * np.roll(counts, 1, axis=1)
    else:  # three dimensions that change from row to row
        counts += 0.25 * size * (rng.standard_normal((len(counts), 3)) @ rng.standard_normal((3, 19)))
    found = correlated(session_of(np.rint(counts)))
    assert (found is not None and found.id == "crosstalk") == wired


@pytest.mark.parametrize("each", (3, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 4))))
def test_held_rows_of_a_short_log_leave_enough_to_go_on(each):
    """Bins are of two rows there, of which one at most is new."""
    counts, _, _ = touched(seconds=8.5)
    at = np.arange(len(counts))
    found = diagnose_recording(
        PlainRecording(counts[at - at % each], rate=BUS, rate_source=CLOCKED), progress=False
    )
    assert [f.id for f in found.findings] == ["freeze"]
