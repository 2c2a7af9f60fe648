"""Plain recordings with hidden effects that are made here, in numpy, and real ones where they are at hand."""

import itertools
import json
import os
import pathlib
import re

import numpy as np
import pytest
from logs import RATE, noisy, overflowing, pressed, touched, unloaded
from verdicts import check_verdict

from biotac_mj.discrepancy import PlainRecording, diagnose_recording, read_recording
from biotac_mj.discrepancy.evidence import max_t
from biotac_mj.discrepancy.recordings.candidates import KINDS
from biotac_mj.discrepancy.recordings.detectors.jumps import edges, jumped
from biotac_mj.discrepancy.recordings.detectors.latency import ForceView
from biotac_mj.discrepancy.recordings.detectors.levels import levels
from biotac_mj.discrepancy.recordings.detectors.order import slipped
from biotac_mj.discrepancy.recordings.detectors.process import process
from biotac_mj.discrepancy.recordings.detectors.trends import Trend, sharp, trends
from biotac_mj.discrepancy.recordings.proof import prove
from biotac_mj.discrepancy.recordings.recording import as_plain
from biotac_mj.discrepancy.recordings.session import Session
from biotac_mj.discrepancy.report.files import write_report
from biotac_mj.discrepancy.report.text import summary
from biotac_mj.effects.catalogue import entries
from biotac_mj.effects.effect import shifted
from biotac_mj.effects.logged import LOGGED
from biotac_mj.quality.evidence import sign_flip
from biotac_mj.recordings import Recording, load_one
from biotac_mj.recordings.recording import CLOCKED
from biotac_mj.sensor.channels import counts_from_log_impedance, log_impedance

DATA = os.environ.get("BIOTAC_RECORDINGS", pathlib.Path(__file__).parents[1] / "../shared/data")
REAL = pathlib.Path(DATA) / "epfl_flat_press"
real = pytest.mark.skipif(
    not REAL.exists(),
    reason="no real recordings (evaluation only) in ../shared/data or in $BIOTAC_RECORDINGS",
)


def session_of(counts):
    """Of counts that are rounded as a converter does, the first 60 % fitted."""
    recording = PlainRecording(np.clip(np.rint(counts), 0, 4095), rate=RATE)
    return Session(recording, np.arange(len(counts)) < 0.6 * len(counts))


def test_a_few_seconds_of_a_fast_log_are_read():
    """Parts of 857 rows at 300 Hz are shorter than the windows of a second that models are fitted on."""
    counts, force, rng = pressed(seconds=8.57)
    counts[500:] = counts[500:][:, np.r_[1, 0, 2:19]]  # two channels exchanged
    found = diagnose_recording(PlainRecording(noisy(counts, rng), force, rate=300.0))
    assert found.to_dict()["verdict"]


def ids(diagnosis):
    return [f.id for f in diagnosis.findings]


# --- statistics  ---


def test_sign_flip_is_the_exact_permutation_test():
    gain = np.array([0.5, -0.1, 0.9, 0.4, 0.2])
    count = sum(
        np.mean(np.array(s) * gain) >= gain.mean() - 1e-12 for s in itertools.product([-1, 1], repeat=5)
    )
    assert sign_flip(gain) == count / 32
    assert sign_flip(np.ones(30)) < 0.001


def test_family_wise_error_of_the_cells_is_kept():
    rng = np.random.default_rng(0)
    false = sum((max_t(rng.standard_normal((14, 40)))[1] < 0.05).any() for _ in range(60))
    assert false <= 8  # 5 % of 60 is 3, and 8 has a chance of 1 %
    hit = rng.standard_normal((14, 40))
    hit[:, 7] += 2.5
    assert max_t(hit)[1].argmin() == 7


def test_courses_find_a_warm_up_a_step_and_nothing_in_noise():
    rng = np.random.default_rng(1)
    t = np.arange(48) * 2.0
    level = -0.2 * (1 - np.exp(-t / 30)) + 0.002 * rng.standard_normal(48)
    best = trends(level, t)[0].continued(level, t)
    assert best.kind == "smooth" and abs(best.size - 0.19) < 0.02 and best.p < 0.01
    assert np.ptp(best(np.linspace(94, 150, 9))) < 0.08  # the damped trend goes on, and not away
    best = trends(0.1 * (t > 41) + 0.01 * rng.standard_normal(48), t)[0]
    assert best.kind == "step" and abs(best.onset - 41) < 2.1 and abs(best.jump - 0.1) < 0.02
    assert sum(trends(rng.standard_normal(48), t)[0].p < 0.02 for _ in range(20)) <= 2


# --- reading  ---


@pytest.mark.parametrize(
    "text, message",
    [
        ("1 2 3\n", "3 columns, 19 are needed"),
        ("", "is empty: 19 columns of numbers"),
        (
            " ".join(["x1"] + ["5"] * 18) + "\n" + " ".join(["5"] * 18 + ["oops"]) + "\n",
            "line 1: e1 is 'x1', not a finite number",
        ),
        ((" ".join(["0.5"] * 19) + "\n") * 500, "look like normalised values"),
        ((" ".join(["-40"] * 19) + "\n") * 500, "no electrode changes from -40, .* record again"),
        ((" ".join(["2000"] * 19) + "\n") * 50, "too few to fit on one part"),
        (
            ",".join(["time", *(f"e{i}" for i in range(1, 20))]) + "\n0" + ",2000" * 19 + "\n",
            "1 rows are too few to fit on one part",  # of which no clock is known
        ),
        ((" ".join(["nan"] * 19) + "\n") * 500, "cut the file there"),
    ],
)
def test_bad_recordings_are_refused_with_the_reason(tmp_path, text, message):
    path = tmp_path / "e.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_recording(path)


def test_four_rows_an_electrode_are_enough():
    e, rng = unloaded(seconds=0.76)
    assert not diagnose_recording(PlainRecording(noisy(e, rng), rate=RATE)).findings
    with pytest.raises(ValueError, match="75 rows are too few .* at least 76 of this BioTac .* series"):
        PlainRecording(noisy(e, rng)[:75])


def test_short_series_of_a_sensor_are_diagnosed_together(tmp_path):
    """Neither rows that are lost, nor jumps, nor sharp samples are told where one series ends."""
    e, rng = pressed()[0], np.random.default_rng(1)
    parts = [noisy(e[250 * k : 250 * k + 250], rng) for k in rng.permutation(32)[:24]]
    paths = [tmp_path / f"s{k}.txt" for k in range(24)]
    for path, part in zip(paths, parts):
        np.savetxt(path, part, fmt="%d")
    together = read_recording(paths)
    assert together.name == "s0 and 23 more" and together.joints == tuple(range(250, 6000, 250))
    assert "s0, s1, s2, s3, s4 ... are taken for series of one sensor" in together.warnings[0]
    np.testing.assert_array_equal(np.flatnonzero(np.diff(together.tick) != 1) + 1, together.joints)
    found = diagnose_recording(together)
    assert found.verdict == "no significant disagreement" and found.session.loaded
    as_one = diagnose_recording(PlainRecording(np.concatenate(parts), rate=RATE))
    assert [f.id for f in as_one.findings] == ["lost_rows"]


def test_levels_of_short_series_tell_no_warm_up(tmp_path):
    """They differ by what is touched."""
    e, rng = pressed()[0], np.random.default_rng(1)
    paths = [tmp_path / f"s{k}.txt" for k in range(8)]
    for k, (path, part) in enumerate(zip(paths, rng.permutation(32))):
        counts = noisy(e[250 * part : 250 * part + 250], rng)
        np.savetxt(path, np.rint((1.0 if k < 3 else 1.03) * counts), fmt="%d")
    found = diagnose_recording(read_recording(paths))
    assert not found.findings and any("put together" in line for line in found.notes)


def test_series_of_two_sensors_are_not_put_together(tmp_path):
    for name, count in (("a", 19), ("b", 24)):
        np.savetxt(tmp_path / f"{name}.txt", np.random.default_rng(0).integers(2000, 2100, (99, count)), "%d")
    with pytest.raises(ValueError, match="b has 24 electrodes in counts at 100 Hz, a 19"):
        read_recording([tmp_path / "a.txt", tmp_path / "b.txt"])
    with pytest.raises(ValueError, match="force and tdc are files beside one recording"):
        read_recording([tmp_path / "a.txt", tmp_path / "b.txt"], force="f.txt")


def test_missing_and_uneven_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_recording(tmp_path / "none.txt")
    e, rng = unloaded(seconds=6)
    np.savetxt(tmp_path / "e.txt", noisy(e, rng), fmt="%d")
    np.savetxt(tmp_path / "f.txt", np.zeros((599, 3)))
    with pytest.raises(ValueError, match="e.txt has 600 rows and .*f.txt has 599"):
        read_recording(tmp_path / "e.txt", tmp_path / "f.txt")
    with pytest.raises(ValueError, match="give newtons"):
        PlainRecording(noisy(e, rng), np.full((600, 3), 2500.0))


def test_what_makes_a_recording_doubtful_is_said(tmp_path):
    """A force plate that is off, a clock that runs back."""
    e, rng = unloaded(seconds=6)
    e = noisy(e, rng)
    time = np.arange(600) / RATE - np.where(np.arange(600) < 300, 0, 50)
    header = ",".join(["time", *(f"e{i + 1}" for i in range(19)), "Fx", "Fy", "Fz"])
    table = np.column_stack([time, e, np.zeros((600, 3))])
    np.savetxt(tmp_path / "e.csv", table, "%.6g", ",", header=header, comments="")
    recording = read_recording(tmp_path / "e.csv")
    said = "the force never changes from 0 N", "the clock starts anew in row 300, 50 s back"
    assert len(recording.warnings) == 2
    d = diagnose_recording(recording)
    write_report(d, tmp_path)
    page = (tmp_path / "report.html").read_text()
    for text in said:
        assert f"warning: {text}" in summary(d) and f"<b>Warning:</b> {text}" in page
        assert any(text in line for line in d.to_dict()["warnings"])
    assert read_recording(tmp_path / "e.csv", rate=RATE).warnings == recording.warnings
    # the general form of a recording tells the same
    again = diagnose_recording(load_one(tmp_path / "e.csv").recording)
    assert again.to_dict() == d.to_dict()
    assert again.recording.warnings == recording.warnings
    with pytest.raises(TypeError, match="recording is ndarray: pass a Recording or a PlainRecording"):
        diagnose_recording(e)
    with pytest.raises(ValueError, match="has no electrodes: give a recording that has them"):
        diagnose_recording(Recording(np.arange(600.0), pdc=np.arange(600.0)))
    np.savetxt(tmp_path / "dead.txt", np.zeros((600, 19)), "%d")
    with pytest.raises(ValueError, match="no electrode changes from 0, .* record again"):
        read_recording(tmp_path / "dead.txt")


def test_rate_is_guessed_from_repeated_rows():
    e, rng = unloaded(seconds=20)
    x = noisy(e, rng)
    repeated = x[np.sort(np.concatenate([np.arange(2000), np.arange(0, 2000, 4)]))]
    assert abs(PlainRecording(repeated).rate - 125) < 1
    assert PlainRecording(x).rate == 100 and "assumed" in PlainRecording(x).rate_source


# --- effects: synthetic base signals  ---


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_without_effect_there_is_no_disagreement(seed):
    e, rng = unloaded(seed)
    assert diagnose_recording(PlainRecording(noisy(e, rng))).verdict == "no significant disagreement"
    e, _, rng = pressed(seed)
    assert diagnose_recording(PlainRecording(noisy(e, rng))).verdict == "no significant disagreement"


@pytest.mark.slow  # quick: a drift under load, and a jump of one electrode
@pytest.mark.parametrize("shape", (pytest.param("sigmoid", marks=pytest.mark.slow), "step"))
def test_a_shape_of_its_own_is_charged_to_its_channel(shape):
    """150 counts on e6 over white noise, unloaded and under load: e6, and no other electrode."""
    for make in (unloaded, pressed):
        e, rng = make(4)[0], np.random.default_rng(5)
        x = (np.arange(len(e)) / len(e) - 0.35) / 0.04
        e = e.copy()
        e[:, 5] += 150 / (1 + np.exp(-x)) if shape == "sigmoid" else 150 * (x > 0)
        d = diagnose_recording(PlainRecording(noisy(e, rng)))
        assert ids(d) == ["drift"] and d.findings[0].channels == (5,), d.verdict
        assert d.findings[0].gap.after < 0.25 * d.findings[0].gap.before


def warmed(e, rng, weak=None):
    share = 1 + 0.12 * rng.standard_normal(19)
    if weak is not None:
        share[weak] = 0.65
    t = np.arange(len(e)) / RATE
    z = np.log(4095 / e - 1) - 0.3 * np.sqrt(t / t[-1])[:, None] * share
    return 4095 / (1 + np.exp(z))


@pytest.mark.parametrize("make", [pytest.param(unloaded, marks=pytest.mark.slow), pressed])
def test_a_shared_drift_with_own_shares_is_one_effect(make):
    """Electrodes that differ by 12 % in their share, one at 65 %, in a form that is not the exponential
    that is reported."""
    e, rng = make(2, 40)[0], np.random.default_rng(3)
    d = diagnose_recording(PlainRecording(noisy(warmed(e, rng, weak=10), rng)))
    assert ids(d) == ["warmup"], d.verdict
    assert d.findings[0].verified and d.findings[0].parameters["a"][0] < 0


def test_an_electrode_with_most_of_a_common_loss_has_no_drift():
    """What all lose is taken out with equal shares; what is left of an electrode that lost 1.35 times as much
    may be its share, of one that lost twice as much it is a drift."""
    e, rng = unloaded(7, 60)
    lost = 0.15 * np.linspace(0, 1, len(e)) ** 2
    noise = 4 * rng.standard_normal(e.shape)
    shared = levels(session_of(counts_from_log_impedance(log_impedance(e) + lost[:, None]) + noise), set())
    assert shared.id == "fluidloss"
    for share, drifts in ((1.35, False), (2.0, True)):
        shares = np.where(np.arange(19) == 9, share, 1.0)
        s = session_of(counts_from_log_impedance(log_impedance(e) + np.outer(lost, shares)) + noise)
        s.accept(shared)
        found = levels(s, {(None,)})
        assert (found is not None and found.channels == (9,)) is drifts, share


def test_the_sign_of_a_shared_drift_tells_loss_from_warm_up():
    e, rng = unloaded(6)
    t = np.arange(len(e)) / len(e)
    z = np.log(4095 / e - 1) + 0.25 * t[:, None] ** 0.7
    d = diagnose_recording(PlainRecording(noisy(4095 / (1 + np.exp(z)), rng)))
    assert ids(d) == ["fluidloss"] and "warmup" in d.findings[0].ties


def test_temperature_is_told_by_the_thermistor():
    e, rng = unloaded(8)
    t = np.arange(len(e)) / len(e)
    tdc = 2000 + 40 * np.sin(2 * np.pi * t) + 20 * t
    z = np.log(4095 / e - 1) - 0.002 * (tdc - 2000)[:, None]
    d = diagnose_recording(PlainRecording(noisy(4095 / (1 + np.exp(z)), rng), None, np.rint(tdc)))
    assert ids(d) == ["thermal"] and d.findings[0].verified


def late(e, k, change, share=0.35):
    out, start = e.copy(), int(share * len(e))
    out[start:, k] = change(e[start:, k], e[:, k])
    return out


@pytest.mark.slow
def test_electrodes_that_are_swapped_under_load_are_found():
    e, _, rng = pressed(6, seconds=120)
    mixed = noisy(e, rng)
    start = len(e) * 2 // 5
    mixed[start:, [2, 9, 14]] = mixed[start:, [14, 2, 9]]
    d = diagnose_recording(PlainRecording(mixed))
    assert ids(d)[0] == "swap" and set(d.findings[0].channels) == {2, 9, 14}, d.verdict
    assert abs(d.findings[0].start - start / RATE) < 0.5


def turned(counts):
    """All channels one place on, as where a frame is read from the second word."""
    return np.roll(counts, 1, axis=1)


def alike(counts):
    """Two neighbours exchanged."""
    return counts[:, np.r_[:4, 5, 4, 6:19]]


@pytest.mark.parametrize("act, moved", [pytest.param(turned, 19, marks=pytest.mark.slow), (alike, 2)])
@pytest.mark.parametrize("seconds", (16, pytest.param(80, marks=pytest.mark.slow)))
def test_channels_that_go_on_where_others_were_are_exchanged(act, moved, seconds):
    """From one row to the next, also in a recording too short to tell a load from drift, and for a while."""
    counts, _, rng = pressed(seconds=seconds)
    counts[:, 5] += counts[:, 4].mean() - counts[:, 5].mean() + 250
    at, end = int(0.3 * len(counts)), int(0.5 * len(counts))
    for rows in (slice(at, None), slice(at, end)):
        changed = counts.copy()
        changed[rows] = act(counts[rows])
        found = diagnose_recording(PlainRecording(noisy(changed, rng, 3), rate=RATE)).findings
        assert [f.id for f in found] == ["swap"] and len(found[0].channels) == moved
        assert found[0].start == pytest.approx(at / RATE, abs=0.02)
        put_back = found[0].correct(changed, np.arange(len(counts)) / RATE)
        np.testing.assert_array_equal(put_back, counts)


def test_channels_that_only_jump_at_once_are_not_exchanged():
    counts, _, rng = pressed()
    counts[3000:, [4, 7]] += [150, -130]
    assert slipped(session_of(noisy(counts, rng, 3))) is None
    counts[3000:, 4] -= counts[3000, 4] - counts[2999, 7]
    counts[3000:, 7] -= counts[3000, 7] - counts[2999, 4]
    assert slipped(session_of(noisy(counts, rng, 3))).channels == (4, 7)


def test_a_wave_that_all_channels_have_is_taken_out():
    """One that is no sine and wanders is one finding. Against the known clean counts, on the held-out
    rows."""
    e, _, rng = pressed(7, 40)
    clean, t = noisy(e, rng), np.arange(len(e)) / RATE
    wave = 8 * np.sign(np.sin(2 * np.pi * 31.7 * t + 0.5 * np.sin(0.1 * t)))
    d = diagnose_recording(PlainRecording(np.clip(np.rint(clean + wave[:, None]), 0, 4095)))
    assert ids(d).count("hum") == 1, d.verdict
    left = (d.session.filled() - clean)[~d.session.fit]
    assert np.sqrt(np.mean(left**2)) < 0.5 * np.sqrt(np.mean(wave**2))


@pytest.mark.parametrize(
    "name, rows", [("latency", 12), ("latency", 9), ("force_late", -7), ("force_late", -18)]
)
def test_latency_is_measured(name, rows):
    """Of the electrodes, or of the force, which is no property of the sensor."""
    e, force, rng = pressed(5, 40)
    d = diagnose_recording(PlainRecording(noisy(e, rng)[100 - rows : -20 - rows], force[100:-20]))
    found = next(f for f in d.findings if f.id in ("latency", "force_late"))
    assert found.id == name and abs(found.parameters["delay"][0] - abs(rows) / RATE) < 0.01 and found.verified
    assert ("shift it so much earlier" in summary(d)) == (name == "force_late")
    assert ("latency" in [effect.id for effect, _ in d.sensor().effects]) == (rows == 9)


def test_a_frame_is_no_latency_and_a_metronome_no_rhythm():
    """A sound log's electrodes are up to one frame late, and a robot presses at an even pace."""
    e, force, rng = pressed(5, 40)
    t = np.arange(len(e)) / RATE
    late = np.column_stack([np.interp(t - 0.007, t, column) for column in e.T])
    assert "latency" not in ids(diagnose_recording(PlainRecording(noisy(late, rng), force)))
    bent = np.cos(2 * np.pi * 1.5 * t)[:, None] * [1.0, 0.3] + [0.0, 1.0]  # the same press again and again
    said = {}
    for name, own in (("with", np.column_stack([bent, bent[:, :1]])), ("without", None)):
        x = 2500 + 100 * bent @ rng.standard_normal((2, 19))
        own = None if own is None else own + 0.01 * rng.standard_normal(own.shape)
        said[name] = diagnose_recording(PlainRecording(noisy(x, rng), own)).rest.text
    assert "rhythm" in said["without"] and "rhythm" not in said["with"], said


@pytest.mark.slow  # quick: a clock that changes its pace, and lost rows
def test_a_clock_that_leaps_is_unknown_and_no_lost_row(tmp_path):
    """By an hour, while the electrodes go on; where they are elsewhere afterwards an hour is missing. A clock
    that is set back is unknown, too."""
    e, _, rng = pressed(4, 24)
    names = ",".join(["time_s", *(f"e{k + 1}" for k in range(19))])

    def said(time, rows):
        table = np.column_stack([time, noisy(e[rows], rng)])
        np.savetxt(
            tmp_path / "log.csv", table, ["%.3f"] + 19 * ["%d"], delimiter=",", header=names, comments=""
        )
        return diagnose_recording(read_recording(tmp_path / "log.csv"))

    rows = np.arange(len(e))
    leaps = said(rows / RATE + 3600.0 * (rows >= 1000), rows)
    assert "lost_rows" not in ids(leaps) and "unknown: the clock leaps by 3600 s" in leaps.verdict
    gone = np.delete(rows, np.arange(900, 1100))
    lost = said(rows[gone] / RATE + 3600.0 * (gone >= 1000), gone)
    assert "lost_rows" in ids(lost) and "leaps" not in lost.verdict
    back = said(rows / RATE - 5.0 * (rows >= 1000), rows)
    assert "unknown: the clock starts anew" in back.verdict, back.verdict


@pytest.mark.slow
def test_what_no_count_resolves_is_not_said():
    """A rhythm of a third of a count, plain in 300 s; of two counts it is said as what it is."""
    e, rng = unloaded(1, seconds=300)
    wave = np.sin(2 * np.pi * 2.2 * np.arange(len(e)) / RATE)[:, None]
    small = diagnose_recording(PlainRecording(noisy(e + 0.35 * wave, rng, 1.5)))
    assert small.verdict == "no significant disagreement", small.verdict
    large = diagnose_recording(PlainRecording(noisy(e + 2.0 * wave, rng, 1.5)))
    assert re.search(r"unknown: a rhythm of 2\.[12] Hz and up to 2 counts", large.verdict)


def test_a_small_jump_is_told_while_the_load_moves():
    """40 counts at noise of 4 on an electrode that the load takes through hundreds; a touch's step of 200
    that passes within a quarter of a second, twice, and another that stays are none of the electronics."""
    e, _, rng = pressed(8, 40)
    e += 4 * rng.standard_normal(e.shape)
    e[1500:, 3] += 40
    for at, long in ((700, 20), (1900, 25), (2900, 2000)):
        e[at : at + long, 11] += 200
    found = edges(session_of(e))
    assert list(found) == [3] and abs(found[3][0].time - 15.0) < 0.02
    assert 25 < found[3][0].step < 55


@pytest.mark.xfail(strict=True, reason="eight jumps among touches are neither named nor unknown")
@pytest.mark.slow  # quick: a small jump while the load moves
def test_common_jumps_under_load_are_not_single_electrodes():
    """Eight that jump are unknown: what moves so many has one cause."""
    e, _, rng = pressed(8, 40)
    e += 4 * rng.standard_normal(e.shape)
    for k in range(8):
        e[700 + 180 * k :, 2 * k] += 200
    d = diagnose_recording(PlainRecording(np.clip(np.rint(e), 0, 4095)))
    alone = [f for f in d.findings if f.id == "drift" and len(f.channels) == 1]
    assert len(alone) < 3 and d.rest.significant, d.verdict


@pytest.mark.slow
def test_two_drifting_electrodes_are_named_and_four_are_likely():
    """A connector may have two, and neither speaks against the other; what four have is more often one."""
    t = np.arange(6000) / 6000
    for number, named in ((2, {(1,), (5,)}), (4, set())):
        e, rng = unloaded(4, 60)
        for k in range(number):
            e[:, 4 * k + 1] += (-1) ** k * 60 * np.clip(t - 0.2, 0, None)
        d = diagnose_recording(PlainRecording(noisy(e, rng)))
        assert {f.channels for f in d.findings if f.id == "drift"} == named, d.verdict
        assert d.rest.significant == (not named), d.verdict


def test_what_begins_with_the_last_rows_fitted_is_said():
    """A jump for which these rows are too few, and which began before the held-out ones."""
    e, rng = unloaded(3, 30)
    e[1770:, 6] += 40  # of 1800 rows fitted
    d = diagnose_recording(PlainRecording(noisy(e, rng)))
    assert [(f.id, f.channels) for f in (*d.findings, *d.late)] == [("drift", (6,))], d.verdict


def test_a_ramp_after_rest_is_no_step():
    """What is flat for two thirds and then falls is sharp nowhere; a step beside a course is."""
    rng, time = np.random.default_rng(0), np.arange(48) + 0.5
    level = 0.01 * rng.standard_normal(48)
    assert sharp(level + np.maximum(time - 30, 0) * 0.05, time, 30.0) == 0
    assert sharp(level + 0.01 * time + 0.5 * (time > 30), time, 30.0) > 5


@pytest.mark.parametrize("seconds", (28, 80))
def test_a_drift_under_load_is_charged_to_its_electrode(seconds):
    """A random walk of 25 counts RMS on an electrode that the load takes through hundreds; without it no
    electrode stands out."""
    e, _, rng = pressed(9, seconds)
    e = e + 4 * rng.standard_normal(e.shape)
    walk = np.cumsum(rng.standard_normal(len(e)))

    def nats():
        every = process(session_of(e).model())
        return np.array([every.nats(i) for i in range(19)])

    assert nats().max() < 5
    e[:, 12] += 25 * (walk - walk.mean()) / walk.std()
    found = nats()
    assert found.argmax() == 12 and found[12] > max(25, 2 * np.delete(found, 12).max())


def test_a_slow_gain_under_load_is_a_drift_tied_with_it():
    """An electrode that loses half of its answers about its rest within 80 s drifts, by what the others say;
    a drift that turns while the load does what it did is tied with nothing."""
    e, _, rng = pressed(9, 80)
    e = e + 4 * rng.standard_normal(e.shape)
    at, rest = np.linspace(0, 1, len(e)), e[:, 12].min() - 100
    lost = e.copy()
    lost[:, 12] = rest + (1 - 0.5 * at) * (e[:, 12] - rest)
    found = levels(session_of(lost), set())
    assert found.channels == (12,) and found.ties == ("gain",)
    e[:, 12] += 200 * np.sin(7 * at)
    found = levels(session_of(e), set())
    assert found.channels == (12,) and found.ties == ()


@pytest.mark.slow  # quick: what a few do under load
def test_what_a_few_electrodes_do_at_rest_is_no_load():
    """Four electrodes sway by 40 counts, each at its own time, in a hold of 12 s: unknown, beside recordings
    at rest and not beside touches, in which as much is usual."""
    e, rng = unloaded(2, 12)
    quiet = diagnose_recording(PlainRecording(noisy(e, rng, 2.0)))
    assert quiet.rest.kind == "still" and not quiet.rest.significant
    time = np.arange(len(e))[:, None] / RATE
    swing = np.sin(2 * np.pi * 1.3 * time + rng.uniform(0, 6, 4)) * np.sin(0.5 * time)
    e = e.copy()
    e[:, [1, 4, 11, 14]] += 40 * swing
    d = diagnose_recording(PlainRecording(noisy(e, rng, 2.0)))
    assert d.rest.kind == "still" and d.rest.significant, d.verdict


@pytest.mark.slow  # quick: what has no name of overflows and clocks
def test_what_has_no_name_is_called_unknown_under_load_too():
    e, rng = unloaded(7)
    t = np.arange(len(e)) / len(e)
    for k in (1, 5, 6, 11, 14):
        e[:, k] += 60 * np.sin(2 * np.pi * (3 + k) * t + k)
    d = diagnose_recording(PlainRecording(noisy(e, rng)))
    assert "unknown" in d.verdict, d.verdict
    e, _, rng = pressed(9)
    for k in (3, 8, 12, 17):  # gains that change every few seconds
        middle = np.median(e[:, k])
        e[:, k] = middle + (e[:, k] - middle) * np.repeat(rng.uniform(0.4, 1.6, 40), len(e) // 40)
    d = diagnose_recording(PlainRecording(noisy(e, rng)))
    assert "unknown" in d.verdict and {c["channel"] for c in d.rest.cells} <= {"e4", "e9", "e13", "e18"}, (
        d.verdict
    )


# --- numbers that mean what they say  ---


@pytest.mark.slow
def test_every_after_is_computed_on_rows_kept_aside():
    """The same first rows, other last rows: other numbers after, the same fit."""
    e, rng = unloaded(2)
    counts = noisy(warmed(e, rng), rng)
    first = diagnose_recording(PlainRecording(counts))
    other = counts.copy()
    other[first.session.fit.sum() :] += 60
    second = diagnose_recording(PlainRecording(other))
    a, b = first.findings[0], second.findings[0]
    assert a.parameters == b.parameters and a.p == b.p and a.confidence == b.confidence
    assert b.gap.after > 2 * a.gap.after and a.gap.noise > 0
    assert 0 < a.p < 0.01


def test_what_the_part_kept_aside_contradicts_is_not_named():
    """A drift that turns round and goes twice as far the other way."""
    e, rng = unloaded(2)
    t = np.arange(len(e)) / len(e)
    e[:, 4] += 100 * np.where(t < 0.6, np.sin(np.pi * t / 1.2) ** 2, 1 - 12 * (t - 0.6))
    d = diagnose_recording(PlainRecording(noisy(e, rng)))
    assert not any(f.verified is False for f in d.findings)
    assert any(f.id == "drift" and f.channels == (4,) for f in d.session.weak) or d.findings[0].verified, (
        d.verdict
    )


@pytest.mark.slow
def test_the_report_leads_with_the_largest_gap(tmp_path):
    e, rng = unloaded(3)
    e = warmed(e, rng)
    e[2000:, 3] -= 400
    d = diagnose_recording(PlainRecording(noisy(e, rng)))
    assert len(d.findings) == 2 and ids(d)[0] == "drift"
    assert d.findings[0].gap.taken > d.findings[1].gap.taken > 0
    files = write_report(d, tmp_path)
    assert all(f.exists() for f in files) and not list(tmp_path.glob(".*"))
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64") == 2 and 'src="curves' not in page  # one file, to be sent
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    assert verdict == json.loads(json.dumps(d.to_dict()))
    check_verdict(verdict)


def test_parameters_are_those_of_the_simulators_effects():
    """What is found can be given to the catalogue's effect of that id."""
    from biotac_mj.effects.catalogue import CATALOGUE

    for effect in CATALOGUE:
        if effect.id in ("warmup", "fluidloss", "thermal", "latency"):
            assert set(KINDS[effect.id].params) == set(effect.params), effect.id


def test_summary_says_what_it_cannot_know():
    e, rng = unloaded()
    text = summary(diagnose_recording(PlainRecording(noisy(e, rng))))
    assert "no force: latency" in text and "not loaded: saturation" in text


def test_an_effect_is_searched_or_listed_as_not_identifiable():
    """A log shows each entry of the catalogue, or the report lists the data that are required."""
    e, rng = unloaded()
    d = diagnose_recording(PlainRecording(noisy(e, rng)))
    missing = {name for line in d.notes for name in line.partition(": ")[2].split(", ")}
    assert not missing & {"stuck channel", "drift or jump of an electrode", "liquid lost over the session"}
    for effect in (*entries("poses"), *LOGGED):
        effect = KINDS.get(effect.id, effect)
        has = {"rest", "sign", "time"}  # raw counts for a minute, and nothing else
        assert (effect.name in missing) == bool(effect.requires - has), effect.id


def test_what_no_bound_allows_has_no_name():
    """Two thirds of the liquid in half a minute are more than a leak loses."""
    e, rng = unloaded(seconds=30)
    lost = np.log(1 - 0.67 * np.linspace(0, 1, len(e)))[:, None]
    counts = counts_from_log_impedance(log_impedance(e) - lost)
    found = diagnose_recording(PlainRecording(noisy(counts, rng), rate=RATE)).findings
    assert "fluidloss" not in [f.id for f in found] and all(f.possible for f in found)


def test_a_straight_drift_is_no_long_warm_up():
    time = np.linspace(0.0, 200.0, 50)
    straight = Trend("smooth", np.nan, time, -0.1 * time / 200, 0.0, np.ones(16), 0.0)
    found = KINDS["warmup"].of_trend(time, straight(time), np.ones(19), np.ones(19))
    (a, low, _), (tau, *_) = found["a"], found["tau"]
    assert low <= a < -0.1 and a > -1.0 and KINDS["warmup"].possible(found)
    assert a * (1 - np.exp(-200 / tau)) == pytest.approx(-0.1, rel=0.05)


def test_the_warm_up_of_no_change_is_none():
    found = KINDS["warmup"].of_trend(np.linspace(0.0, 200.0, 50), np.zeros(50), np.ones(19), np.ones(19))
    assert found["a"][0] == 0.0


@pytest.mark.parametrize("seconds", (5, 9))
def test_short_touches_have_no_warm_up_and_still_logs_do(seconds):
    """What the report says cannot be told from touches is not named; one touch in one window is enough."""

    def said(counts, rng, climb=40):
        counts = counts + climb * np.linspace(0, 1, len(counts))[:, None]
        d = diagnose_recording(PlainRecording(noisy(counts, rng), rate=RATE))
        return ids(d), any("too short" in one and "warm-up" in one for one in d.notes)

    counts, _, rng = pressed(seconds=seconds)
    assert said(counts, rng) == ([], True)
    found, short = said(*unloaded(seconds=seconds))
    assert {"warmup", "fluidloss"} & set(found) and not short
    once, rng = unloaded(seconds=seconds)
    once[len(once) // 8 : len(once) // 6] -= rng.uniform(20, 200, 19)
    assert said(once, rng, climb=0) == ([], True)


@pytest.mark.parametrize("back", (-1.0, 0.5))
def test_what_a_report_prints_of_a_trend_decides_on_it(back):
    """A warm-up that goes on in the first quarter held out, and then turns back, or by half."""
    e, rng = unloaded()
    time = np.linspace(0, 1, len(e))
    climb = np.interp(time, [0, 0.7, 0.78, 1], [0, 1, back, back])[:, None]
    session = session_of(noisy(e + 100 * climb, rng))
    found = levels(session, set())
    session.accept(found)
    prove(session, found)
    assert found.verified and found.gap.gained and "first quarter" in found.gap.name


@pytest.mark.slow  # quick: what a summary says it cannot know
def test_a_force_too_short_to_tell_touches_from_drift_says_so():
    e, force, rng = pressed(seconds=15)
    said = summary(diagnose_recording(PlainRecording(noisy(e, rng), force)))
    assert re.search(r"too short to tell touches from drift, record \d+ s or more", said)


@pytest.mark.slow
def test_touches_not_separable_from_drift_ask_for_a_recording():
    """A recording as long as it asks for will do; touches as slow as a drift never do."""

    def said(counts, force, rng):
        """The notes, and whether saturation was searched: exactly where no note lists it."""
        d = diagnose_recording(PlainRecording(noisy(counts, rng), force))
        searched = "saturation of the change" in {one["name"] for one in d.tried}
        assert searched != any("saturation" in one for one in d.notes)
        return "\n".join(d.notes), searched

    short, _ = said(*pressed(seconds=15))
    assert "too short to tell touches from drift" in short and "not loaded" not in short
    seconds = int(re.search(r"record (\d+) s or more", short)[1])
    enough, less = (said(*pressed(seconds=s)) for s in (seconds, seconds - 1))
    assert "too short" in less[0] and "too short" not in enough[0] and enough[1] and not less[1]
    e, rng = unloaded()
    rise = np.linspace(0, 1, len(e))[:, None] ** 2
    slow, none = (said(e + 60 * rise, size * rise * [0, 0, -1], rng)[0] for size in (2, 0))
    assert "touches could not be told from drift, record some" in slow and "not loaded" not in slow
    assert "not loaded: saturation" in none


@pytest.mark.slow
def test_a_force_without_noise_is_said_to_have_none():
    e, force, rng = pressed()
    with_noise = summary(diagnose_recording(PlainRecording(noisy(e, rng), force)))
    force[: len(force) // 2] = 0
    without = summary(diagnose_recording(PlainRecording(noisy(e, rng), force)))
    last = [
        [x for x in text.splitlines() if x.strip().startswith("force from electrodes")][0].split()
        for text in (with_noise, without)
    ]
    assert float(last[0][-2]) == pytest.approx(0.01, rel=0.1) and last[1][-2:] == ["none", "N"]


def test_the_verb_writes_a_verdict(tmp_path, capsys):
    from biotac_mj.cli import main

    e, rng = unloaded(9, 20)
    np.savetxt(tmp_path / "e.txt", noisy(e, rng), fmt="%d")
    assert (
        main(["diagnose", "--electrodes", str(tmp_path / "e.txt"), "--out", str(tmp_path / "r"), "--quiet"])
        == 0
    )
    assert "verdict: no significant disagreement" in capsys.readouterr().out
    assert (tmp_path / "r" / "report.html").exists()
    assert main(["diagnose"]) == 2
    assert "nothing to diagnose" in capsys.readouterr().err


def test_a_force_view_is_an_ordinary_ridge_regression_by_blocks():
    e, force, rng = pressed(11)
    view = ForceView(noisy(e, rng), force, np.arange(len(e)) < 5000, np.arange(19), RATE)
    x = shifted(view.x, view.time, -0.1)[:: view.step]
    a, b = view.edges[4:6]
    train = np.r_[0:a, b : len(x)]
    A = np.concatenate([np.ones((len(x), 1)), x], axis=1)
    ridge = np.sqrt(np.r_[0, 1e-4 * (x**2).sum(0)])
    w = np.linalg.lstsq(
        np.concatenate([A[train], np.diag(ridge)]),
        np.concatenate([view.target[train], np.zeros((A.shape[1], 3))]),
        rcond=None,
    )[0]
    expected = np.log(((view.target[a:b] - A[a:b] @ w) ** 2).mean(0))
    np.testing.assert_allclose(view.at_delay(0.1)[4], expected.mean(), rtol=1e-4)


# --- real recordings  ---


@real
def test_the_real_unloaded_sensor_warms_up_and_nothing_else():
    d = diagnose_recording(read_recording(REAL / "SynImpF2.txt"))
    assert ids(d) == ["warmup"] and not d.late and not d.rest.significant and d.locked == 0.4
    assert d.gap["electrodes at rest"].after ** 2 < 0.1 * d.gap["electrodes at rest"].before ** 2


@real
@pytest.mark.slow  # quick: warm-up and latency by themselves, and the real sensor that nothing presses
def test_findings_describe_the_real_pressed_sensor_better():
    d = diagnose_recording(read_recording(REAL / "SynImpF1.txt", REAL / "ForceData.txt"))
    assert {"warmup", "latency"} <= set(ids(d)) and d.locked == 0.3
    for view in d.gap.values():
        assert view.after < view.before


@real
@pytest.mark.parametrize("most", [1, pytest.param(None, marks=pytest.mark.slow)])
def test_a_gripped_sensor_shows_its_temperature(most):
    from scipy.io import loadmat

    found = 0
    paths = sorted((REAL.parent / "phac_hold").glob("steel*.mat"))[:most]
    for path in paths:
        data = loadmat(path)
        d = diagnose_recording(PlainRecording(data["F0Electrodes"].T, None, data["F0tdc"].ravel(), 100.0))
        found += any("thermal" in {f.id, *f.ties} for f in d.findings)
    assert found > len(paths) / 2


@pytest.mark.parametrize(
    ("there", "rows", "text"),
    [(slice(3, 1000), (3, 1000), "only rows 4 to 1000 took part"), (slice(0, 300), None, "it took no part")],
)
def test_a_force_that_is_not_there_in_all_rows(there, rows, text):
    """As where forces of another clock were interpolated and began later."""
    rng = np.random.default_rng(0)
    force = np.full((1000, 3), np.nan)
    force[there] = rng.normal(size=force[there].shape)
    counts = np.rint(2500 + rng.normal(0, 3, (1000, 19)))
    one = as_plain(Recording(np.arange(1000) / 100, electrodes=counts, force=force))
    assert any(text in line for line in one.warnings), one.warnings
    begin, end = rows or (0, 1000)
    np.testing.assert_array_equal(one.electrodes, counts[begin:end])
    assert (one.force is None) if rows is None else np.isfinite(one.force).all()


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


@pytest.mark.parametrize("each", (3, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 4))))
def test_rows_of_a_slow_bus_are_counted_and_no_fault(each):
    """Bins are of two rows there, of which one at most is new."""
    counts, _, _ = touched(seconds=8.5)
    at = np.arange(len(counts))
    found = diagnose_recording(
        PlainRecording(counts[at - at % each], rate=RATE, rate_source=CLOCKED), progress=False
    )
    assert not found.findings and f"{1 - 1 / each:.0%} repeat the one before" in summary(found)


@pytest.mark.slow  # quick: upper bits that are put back
def test_an_overflow_is_unknown_and_hides_nothing():
    whole, cut = overflowing(1, 19, 1024, 900)
    sound, d = (diagnose_recording(PlainRecording(x, rate=RATE)) for x in (whole, cut))
    assert d.rest.significant and "overflow at 1024" in d.verdict
    assert [(f.id, f.channels) for f in d.findings] == [(f.id, f.channels) for f in sound.findings]


def test_a_loose_contact_is_unknown():
    e, rng = unloaded(4)
    counts = noisy(e, rng)
    for n, row in enumerate(range(300, 5700, 450)):
        counts[row : row + 1 + n % 3, 5] -= 300
    d = diagnose_recording(PlainRecording(counts))
    assert "spikes" not in ids(d) and d.rest.significant, d.verdict
    assert "e6 jumps away and returns" in d.verdict
