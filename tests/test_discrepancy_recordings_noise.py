"""Faults of rows and of noise in plain recordings, and what only looks like them. All of it is synthetic."""

import numpy as np
import pytest
from biotac_mj.discrepancy.recordings.families.noise.lines import humming
from biotac_mj.discrepancy.recordings.families.samples.sampling import sampling_faults
from biotac_mj.discrepancy.recordings.families.samples.still import standing_still
from scipy import signal

from biotac_mj.discrepancy import PlainRecording, diagnose_recording, read_recording
from biotac_mj.discrepancy.recordings.families.levels.jumps import edges, jumped
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


@pytest.mark.parametrize("pace", (1.0, 1.35))
def test_a_clock_that_changes_its_pace_is_unknown(tmp_path, pace):
    counts, _, rng = touched(seconds=20)
    step = np.where(np.arange(len(counts)) < 700, 0.01, 0.01 * pace) + 2e-3 * rng.random(len(counts))
    table = np.column_stack([np.cumsum(step), counts])
    header = ",".join(["time", *(f"e{k + 1}" for k in range(19))])
    np.savetxt(tmp_path / "log.csv", table, "%.6g", ",", header=header, comments="")
    said = read_recording(tmp_path / "log.csv").warnings
    assert any(line.startswith("the clock changes its pace: rows lie 11 ms") for line in said) == (pace > 1)


@pytest.mark.parametrize("each", (3, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 4))))
def test_held_rows_of_a_short_log_leave_enough_to_go_on(each):
    """Bins are of two rows there, of which one at most is new."""
    counts, _, _ = touched(seconds=8.5)
    at = np.arange(len(counts))
    found = diagnose_recording(
        PlainRecording(counts[at - at % each], rate=BUS, rate_source=CLOCKED), progress=False
    )
    assert [f.id for f in found.findings] == ["freeze"]
