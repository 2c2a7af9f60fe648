"""The checkup: its protocol, recording while it is said, and what its segments tell. Data are synthetic."""

import types

import numpy as np
import pytest
from grids import first
from logs import tapped
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from biotac_mj import cli
from biotac_mj.discrepancy import PlainRecording, diagnose_recording
from biotac_mj.discrepancy.recordings.candidates import Candidate
from biotac_mj.discrepancy.recordings.detectors.memory import remembered
from biotac_mj.discrepancy.recordings.search import _beside, _everywhere
from biotac_mj.discrepancy.recordings.segments import free_rows
from biotac_mj.discrepancy.recordings.session import Session
from biotac_mj.quality.check import sample_faults
from biotac_mj.quality.log import Log
from biotac_mj.quality.noise import sound_noise
from biotac_mj.quality.still import at_rest, between_rests
from biotac_mj.recordings import Recording, read, write
from biotac_mj.recordings.protocol import SCHEMA, STEPS, Protocol, Segment, read_protocol, write_protocol

RATE = 100.0
REST, TOUCHED = 20.0, 40.0  # [s]
PROTOCOL = Protocol((Segment("rest", 0.0, REST, "air"), Segment("fast", REST, REST + TOUCHED, "table")))


def session(change=lambda x, touched: x, seed=0):
    """(n, 19) counts of a synthetic sensor that rests and is then pressed at many places; `change`: what an
    effect makes of what it reads (n, 19), given which rows are touched (n,)."""
    rng = np.random.default_rng(seed)
    n, t = int(RATE * (REST + TOUCHED)), np.arange(int(RATE * (REST + TOUCHED))) / RATE
    rest = np.linspace(2400, 3400, 19)
    touched = t >= REST
    walk = np.cumsum(rng.standard_normal((n, 4)), axis=0)
    presses = (gaussian_filter1d(walk, 8, axis=0) - gaussian_filter1d(walk, 150, axis=0)) * touched[:, None]
    presses = np.tanh(presses / 8)
    x = rest + 120 * presses @ rng.standard_normal((4, 19))
    x += rng.standard_normal((n, 19)) * sound_noise(np.broadcast_to(rest, (1, 19)))
    counts = np.clip(np.rint(change(x, touched)), 0, 4095)
    return counts


def found(counts, protocol=PROTOCOL):
    """{(id, electrodes)} of what a checkup names."""
    diagnosis = diagnose_recording(PlainRecording(counts, rate=RATE), protocol=protocol)
    return {(f.id, f.channels) for f in diagnosis.findings}


def put(k, value):
    def change(x, touched):
        x = x.copy()
        x[:, k] = value(x, touched)
        return x

    return change


def drifting_at_rest(x, touched):
    return x[:, 4] + np.where(touched, 0, 25 * np.minimum(np.arange(len(x)) / RATE / 15, 1))


@pytest.mark.slow  # quick: spikes, and the CLI below
def test_a_checkup_names_what_the_plain_log_does_not_tell():
    """In the stretch that shows it, and there alone."""
    recording = PlainRecording(session(put(4, drifting_at_rest)), rate=RATE)
    assert "drift" not in {f.id for f in diagnose_recording(recording).findings}
    findings = diagnose_recording(recording, protocol=PROTOCOL).findings
    (drift,) = [f for f in findings if f.id == "drift"]
    assert drift.channels == (4,) and drift.end <= REST


def test_a_checkup_names_nothing_of_a_sound_sensor():
    assert found(session()) == set()


def resting(change=None, seed=0):
    """(n, 19) counts of a log in which nothing touches."""
    rng = np.random.default_rng(seed)
    level = np.broadcast_to(np.linspace(2000, 3400, 19), (4000, 19))
    x = level + sound_noise(level) * rng.standard_normal(level.shape)
    return np.rint(x if change is None else change(x, sound_noise(level), rng))


def struck(x, noise, rng):
    x[rng.choice(np.arange(10, 3990), 8, replace=False)] += 3 * noise[0]
    return x


def shaking(x, noise, rng):
    x[:, 2] += 1.5 * noise[0, 2] * gaussian_filter1d(rng.standard_normal(len(x)), 3) * np.sqrt(6 * np.pi**0.5)
    return x


@pytest.mark.parametrize(
    "change, name, channels",
    [(struck, "spikes", range(19)), (shaking, "noise", (2,))],
)
def test_at_rest_what_is_more_than_noise_is_found(change, name, channels):
    """Of which the searches for any log find none: a load does as much."""
    log = Log(resting(change))
    assert not sample_faults(log).faults
    assert [(f.id, f.channels) for f in at_rest(log)] == [(name, tuple(channels))]


@pytest.mark.parametrize("seed", range(4))
def test_at_rest_noise_alone_has_no_fault(seed):
    assert at_rest(Log(resting(seed=seed))) == []


def breathing(x, noise, rng):
    louder = 2.5 * np.sin(np.arange(len(x)) / 400) ** 2
    x[:, 3] += louder * noise[0, 3] * rng.standard_normal(len(x))
    return x


def test_at_rest_noise_that_breathes_has_no_spikes():
    assert "spikes" not in {f.id for f in at_rest(Log(resting(breathing)))}


RESTS = (slice(0, 2000), slice(2000, 4000))


def coupled(x, noise, rng):
    x[:, 5] += 0.4 * (x[:, 6] - x[:, 5])
    return x


def shared(x, noise, rng):
    return x + 0.6 * noise * rng.standard_normal((len(x), 1))


def turned_down(x, noise, rng):
    x[2000:, 3] += 0.5 * (x[2000:, 3].mean() - x[2000:, 3])
    return x


def filtered(x, noise, rng):
    x[2000:, 3] = lfilter([0.5], [1, -0.5], x[2000:, 3] - x[0, 3]) + x[0, 3]
    return x


@pytest.mark.parametrize(
    "change, name, ties, channels",
    [
        (coupled, "crosstalk", (), (5, 6)),
        (shared, "common_noise", (), range(19)),
        (turned_down, "gain", ("lowpass",), (3,)),
        (filtered, "gain", ("lowpass",), (3,)),
    ],
)
def test_noise_tells_what_electrodes_share_and_their_gain(change, name, ties, channels):
    (fault,) = between_rests(Log(resting(change)), RESTS)
    assert (fault.id, fault.ties, fault.channels) == (name, ties, tuple(channels))


@pytest.mark.parametrize("seed", range(4))
def test_independent_noise_of_two_rests_tells_nothing(seed):
    assert between_rests(Log(resting(seed=seed)), RESTS) == []


@pytest.mark.slow  # quick: the noise of two rests above
def test_noise_is_compared_while_all_electrodes_warm_up():
    """Of which each rest by itself has a trend of all electrodes, too."""

    def warming(x, touched):
        colder = 0.05 * np.exp(-np.arange(len(x)) / RATE / 15)
        disturbed = 0.8 * np.random.default_rng(3).standard_normal((len(x), 1))
        return x * (1 - colder[:, None]) + disturbed * sound_noise(x[:1])

    assert ("common_noise", tuple(range(19))) in found(session(warming))


def remembering(memory, force=True):
    """What a sensor is found to remember that is touched twice for 20 s between rests; memory: (what touches
    do to the electrodes (n, 19)) -> what is added."""
    n, rng = int(RATE * 100), np.random.default_rng(2)
    t = np.arange(n) / RATE
    load = np.maximum(-np.sin(2 * np.pi * t / 5), 0)[:, None] * (t // 20 % 2)[:, None]
    change = load * rng.normal(0, 150, 19)
    level = np.linspace(2400, 3400, 19) + 0.3 * t[:, None]
    x = level + change + memory(change)
    counts = np.rint(x + sound_noise(np.broadcast_to(level[:1], (1, 19))) * rng.standard_normal(x.shape))
    plate = load * [0.1, 0.2, -4.0] + rng.normal(0, 0.005, (n, 3)) if force else None
    kinds = ("rest", "loops", "release", "loops", "release")
    protocol = Protocol(tuple(Segment(kind, 20 * k, 20 * k + 20) for k, kind in enumerate(kinds)))
    recording = PlainRecording(counts, plate, rate=RATE)
    return remembered(Session(recording, np.ones(n, bool)), free_rows(recording, protocol, 0.0))


def relaxing(change):
    slow = lfilter([0.005], [1, -0.995], change, axis=0)  # 2 s
    return -0.2 * slow


def sticking(change):
    follows = np.zeros_like(change)
    width = 0.1 * np.abs(change).max(0)
    for i in range(1, len(change)):
        follows[i] = np.clip(follows[i - 1], change[i] - width, change[i] + width)
    return follows - change


@pytest.mark.parametrize("force", [True, False])
def test_what_decays_after_touches_is_relaxation(force):
    found = remembering(relaxing, force)
    assert found.id == "relax" and found.parameters["tau"][0] == 2.0
    assert found.parameters["g"][0] == pytest.approx(0.2, abs=0.08) and found.of_all


def test_what_stays_after_touches_is_hysteresis():
    found = remembering(sticking)
    assert found.id == "hyster_load" and found.parameters["fraction"][0] == pytest.approx(0.1, abs=0.03)


@pytest.mark.parametrize("force", [True, False])
def test_a_sensor_without_memory_has_none_found(force):
    assert remembering(np.zeros_like, force) is None


@pytest.mark.slow
def test_rests_together_tell_a_jump_under_touches():
    """By less than the electrodes tell of each other while they are touched."""
    protocol = Protocol((*PROTOCOL.segments, Segment("release", REST + TOUCHED, 2 * REST + TOUCHED)))
    counts = np.concatenate([session(), session()[: int(RATE * REST)]])
    step = 6 / (1 + np.exp(-(np.arange(len(counts)) / RATE - REST - 20) / 3))
    counts[:, 4] += np.rint(step)
    assert ("drift", (4,)) not in found(counts, None)
    assert ("drift", (4,)) in found(counts, protocol)


def test_taps_are_sharper_than_a_plate_without_a_fault():
    """A plate that shows the taps too late or not at all tells of no touch; the protocol does."""
    counts, force, rng = tapped(12)
    recording = PlainRecording(counts, 0.01 * rng.standard_normal(force.shape), rate=RATE)
    taps, slow = (Protocol((Segment(kind, 0.0, 40.0),)) for kind in ("taps", "loops"))
    assert diagnose_recording(recording, protocol=slow).significant
    assert not diagnose_recording(recording, protocol=taps).significant


def test_one_cause_of_an_electrode_is_likelier_than_two():
    """A drift of one that is stuck is none; beside hum, of another one, or of all electrodes it is one."""
    some = [("drift", (3,)), ("drift", (4,)), ("stuck", (3,)), ("hum", (4,)), ("warmup", tuple(range(19)))]
    findings = [Candidate(id=name, channels=where, start=0.0, end=1.0, message="") for name, where in some]
    assert _beside(types.SimpleNamespace(findings=findings)) == findings[:1]


def test_what_an_electrode_goes_beyond_elsewhere_is_no_limit():
    limit = types.SimpleNamespace(beyond=1, channels=(4,), parameters={"level": (2700.0, 2699.0, 2701.0)})
    counts = np.full((1000, 19), 2600.0)
    counts[:200, 4] = 2700
    assert _everywhere(limit, counts)
    counts[900:, 4] = 2750
    assert not _everywhere(limit, counts)


def test_noise_under_touches_is_no_fault_of_an_electrode():
    rng = np.random.default_rng(4)

    def shaken(x, touched):
        when = (np.arange(len(x)) > 38 * RATE) & (np.arange(len(x)) < 57 * RATE)
        return x[:, 4] + 20 * when * rng.standard_normal(len(x))

    assert found(session(put(4, shaken))) == set()


def test_a_checkup_finds_spikes_while_nothing_touches():
    rng = np.random.default_rng(1)
    rows = rng.choice(int(RATE * REST) - 20, 8, replace=False) + 10

    def spiked(x, touched):
        x[rows] += 15.0
        return x

    recording = PlainRecording(session(spiked), rate=RATE)
    assert "spikes" not in {f.id for f in diagnose_recording(recording).findings}
    (found,) = [f for f in diagnose_recording(recording, protocol=PROTOCOL).findings if f.id == "spikes"]
    assert found.of_all and found.end < REST


@pytest.mark.parametrize("live", first([0, 1, 2]))
def test_a_stretch_in_which_electrodes_stand_still_is_diagnosed(live):
    def stand(x, touched):
        return np.where(touched[:, None] | (np.arange(19) < live), x, x[0])

    assert not {id_ for id_, _ in found(session(stand))} & {"gain", "crosstalk", "swap", "lowpass"}


def test_a_protocol_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "protocol.yaml"
    write_protocol(path, Protocol.planned("table"))
    again = read_protocol(path)
    assert again == Protocol.planned("table")
    assert [one.kind for one in again.segments] == list(STEPS)
    assert {one.against for one in again.segments} == {"air", "table"}


@pytest.mark.parametrize(
    "segments, says",
    [
        ("[]", "has no segments"),
        ("[{kind: tap, start: 3, stop: 4}]", "did you mean 'taps'"),
        ("[{kind: taps, start: 2, stop: 1}]", "must end after it starts"),
        ("[{kind: taps, start: 0, stop: 3}, {kind: rest, start: 2, stop: 4}]", "before 'taps' ends"),
        ("[{kind: taps, start: 0}]", "has no stop"),
        ("[]\nsegment: []", "did you mean 'segments'"),
    ],
)
def test_a_protocol_that_cannot_be_is_refused(tmp_path, segments, says):
    path = tmp_path / "protocol.yaml"
    path.write_text(f"schema: {SCHEMA}\nsegments: {segments}\n")
    with pytest.raises(ValueError, match=says):
        read_protocol(path)


def test_rows_of_a_protocol_are_by_the_clock():
    time = np.array([0.0, 0.5, 1.0, 7.0, 8.0])
    protocol = Protocol((Segment("rest", 0, 1), Segment("taps", 5, 7.5), Segment("rest", 20, 30)))
    assert [rows.tolist() for rows in protocol.rows(time)] == [[0, 1], [3]]
    assert [rows.tolist() for rows in protocol.rows(time, "rest")] == [[0, 1]]


def test_recording_says_the_steps_and_keeps_their_times(tmp_path, serial_port, capsys):
    plan, out = tmp_path / "protocol.yaml", tmp_path / "r.h5"
    write_protocol(plan, Protocol((Segment("rest", 0.1, 0.3, "air"), Segment("taps", 0.4, 0.6, "pen"))))
    command = ["recording", "record", "--serial", "/dev/x", "--protocol", str(plan), "--out", str(out)]
    written, times = plan.read_text(), tmp_path / "r_timeline.yaml"
    assert cli.main(command) == 0
    assert plan.read_text() == written  # a plan serves many recordings
    said = capsys.readouterr().out
    assert STEPS["rest"].line in said and f"against pen: {STEPS['taps'].line}" in said
    assert f"biotac diagnose {out} --protocol {times}" in said
    (one,), timeline = read(out), read_protocol(times)
    assert [s.kind for s in timeline.segments] == ["rest", "taps"] and timeline.segments[1].against == "pen"
    assert timeline.segments[0].start == pytest.approx(0.1, abs=0.09)
    rows = timeline.rows(one.time - one.time[0])
    assert len(rows) == 2 and all(len(some) > 10 for some in rows)
    out.unlink()
    assert cli.main(command) == 2  # before it records
    assert f"{times} is there already: give a new name" in capsys.readouterr().err and not out.exists()


def test_a_checkup_is_printed_and_diagnosed_from_the_cli(tmp_path, capsys):
    plan = tmp_path / "protocol.yaml"
    assert cli.main(["checkup", "--out", str(plan)]) == 0
    said = capsys.readouterr().out
    assert all(step.line in said for step in STEPS.values()) and "recording record" in said
    with pytest.raises(SystemExit):  # whose times may have been measured
        cli.main(["checkup", "--out", str(plan)])
    assert "is there already: give a new name" in capsys.readouterr().err
    counts, log = session(put(4, drifting_at_rest)), tmp_path / "log.h5"
    write(log, [Recording(50.0 + np.arange(len(counts)) / RATE, counts, name="log")])
    write_protocol(plan, PROTOCOL)
    command = ["diagnose", str(log), "--protocol", str(plan), "--out", str(tmp_path / "report"), "--quiet"]
    assert cli.main(command) == 0
    assert "drift or jump of an electrode [acquisition], e5" in capsys.readouterr().out
    assert cli.main(["diagnose", str(tmp_path / "no.h5"), "--protocol", str(plan)]) == 2
