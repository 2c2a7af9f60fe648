"""Plain recordings with hidden effects that are made here, in numpy, and real ones where they are at hand."""

import itertools
import json
import pathlib

import numpy as np
import pytest
from scipy import stats

from biotac_mj.discrepancy import Recording, diagnose_recording, read_recording
from biotac_mj.discrepancy.evidence import benjamini_hochberg, max_t, sign_flip, wilson
from biotac_mj.discrepancy.recordings.effects.noises import differenced_correlation, pole_of
from biotac_mj.discrepancy.recordings.report import summary, verdict_dict, write_report
from biotac_mj.discrepancy.recordings.shapes import fit_shapes

REAL = pathlib.Path(__file__).parents[1] / "../shared/data/epfl_flat_press"
real = pytest.mark.skipif(
    not REAL.exists(), reason="../shared/data/epfl_flat_press (real recordings, evaluation only) is not here"
)
RATE = 100.0


def unloaded(seed=0, seconds=60):
    rng = np.random.default_rng(seed)
    return np.tile(rng.uniform(2100, 3300, 19), (int(seconds * RATE), 1)), rng


def noisy(counts, rng, size=4.0):
    return np.clip(np.rint(counts + size * rng.standard_normal(counts.shape)), 0, 4095)


def pressed(seed=0, seconds=80):
    """Counts and force of a synthetic hand: three force components and a place, all changing in holds and
    ramps."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE)
    kernel = np.hanning(31) / np.hanning(31).sum()

    def holds(low, high):
        x = np.repeat(rng.uniform(low, high, n // 150 + 2), rng.integers(100, 200, n // 150 + 2))
        return np.convolve(np.resize(x, n + 30), kernel, "valid")[:n]

    f = np.column_stack([holds(-1, 1), holds(-1, 1), holds(-5, -0.5)])
    state = np.column_stack([f, holds(-1, 1), holds(-1, 1)])
    z = (
        rng.uniform(-1, -0.2, 19)
        + 0.1 * state @ rng.standard_normal((5, 19))
        + 0.01 * (state[:, 2:3] * state[:, 3:4]) @ rng.standard_normal((1, 19))
    )
    return 4095 / (1 + np.exp(z)), f + 0.01 * rng.standard_normal(f.shape), rng


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


def test_adjusted_p_values_are_those_of_scipy():
    p = np.array([0.01, 0.04, 0.03, 0.5, 0.002])
    np.testing.assert_allclose(benjamini_hochberg(p), stats.false_discovery_control(p))
    low, high = wilson(3, 20)
    reference = stats.binomtest(3, 20).proportion_ci(method="wilson")
    np.testing.assert_allclose([low, high], [reference.low, reference.high], atol=1e-4)


def test_family_wise_error_of_the_cells_is_kept():
    rng = np.random.default_rng(0)
    false = sum((max_t(rng.standard_normal((14, 40)), draws=400)[1] < 0.05).any() for _ in range(60))
    assert false <= 8  # 5 % of 60 is 3, and 8 has a chance of 1 %
    hit = rng.standard_normal((14, 40))
    hit[:, 7] += 2.5
    assert max_t(hit)[1].argmin() == 7


def test_shape_fit_finds_a_warm_up_and_nothing_in_noise():
    rng = np.random.default_rng(1)
    t = np.arange(600) * 0.25
    fit = fit_shapes(t, -0.2 * (1 - np.exp(-t / 60)) + 0.002 * rng.standard_normal(600))
    assert fit.kind == "exponential" and abs(fit.tau - 60) < 4 and abs(fit.amplitude + 0.2) < 0.005
    assert fit.interval["tau"][0] < 60 < fit.interval["tau"][1]
    assert sum(fit_shapes(t, rng.standard_normal(600)) is not None for _ in range(20)) <= 1


def test_colour_of_noise_is_told_from_differences():
    rng = np.random.default_rng(2)
    x = np.zeros(200_000)
    e = rng.standard_normal(len(x))
    for i in range(1, len(x)):
        x[i] = 0.6 * x[i - 1] + e[i]
    d = np.diff(x, n=3)
    measured = (d[1:] * d[:-1]).mean() / (d**2).mean()
    assert abs(measured - differenced_correlation(0.6)) < 0.01
    assert abs(pole_of(measured) - 0.6) < 0.03


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
        ((" ".join(["0.5"] * 19) + "\n") * 500, "look like volts"),
        ((" ".join(["-40"] * 19) + "\n") * 500, "raw counts 0..4095 are needed, not tared"),
        ((" ".join(["2000"] * 19) + "\n") * 50, "too few to fit on one part"),
        ((" ".join(["nan"] * 19) + "\n") * 500, "cut the recording there"),
    ],
)
def test_bad_recordings_are_refused_with_the_reason(tmp_path, text, message):
    path = tmp_path / "e.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_recording(path)


def test_missing_and_uneven_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_recording(tmp_path / "none.txt")
    e, rng = unloaded(seconds=6)
    np.savetxt(tmp_path / "e.txt", noisy(e, rng), fmt="%d")
    np.savetxt(tmp_path / "f.txt", np.zeros((599, 3)))
    with pytest.raises(ValueError, match="599 rows and --electrodes .* has 600"):
        read_recording(tmp_path / "e.txt", tmp_path / "f.txt")
    with pytest.raises(ValueError, match="give newtons"):
        Recording(noisy(e, rng), np.full((600, 3), 2500.0))


def test_rate_is_guessed_from_repeated_rows():
    e, rng = unloaded(seconds=20)
    x = noisy(e, rng)
    repeated = x[np.sort(np.concatenate([np.arange(2000), np.arange(0, 2000, 4)]))]
    assert abs(Recording(repeated).rate - 125) < 1
    assert Recording(x).rate == 100 and "assumed" in Recording(x).rate_source


# --- effects  ---


@pytest.mark.parametrize("seed", range(4))
def test_without_effect_there_is_no_disagreement(seed):
    e, rng = unloaded(seed)
    assert diagnose_recording(Recording(noisy(e, rng))).verdict == "no significant disagreement"
    e, _, rng = pressed(seed)
    assert diagnose_recording(Recording(noisy(e, rng))).verdict == "no significant disagreement"


def test_warm_up_is_named_and_carried_on_into_the_part_kept_aside():
    e, rng = unloaded()
    t = np.arange(len(e)) / RATE
    z = (4095 / e - 1) * np.exp(-0.25 * (1 - np.exp(-t / 25)))[:, None]
    d = diagnose_recording(Recording(noisy(4095 / (z + 1), rng)))
    assert ids(d) == ["warmup"] and d.verdict.startswith("named: shared impedance gain")
    value, low, high = d.findings[0].parameters["tau"]
    assert abs(value - 25) < 2.5 and d.findings[0].verified
    assert d.gap["electrodes at rest"]["drift_variance_removed"] > 0.9


def test_one_channel_drifts_jumps_sticks_or_is_swapped():
    e, rng = unloaded(3)
    n = len(e)
    drift = noisy(e, rng)
    drift[:, 4] = np.rint(drift[:, 4] + 90 * np.arange(n) / n)
    d = diagnose_recording(Recording(drift))
    assert ids(d) == ["drift"] and d.findings[0].channels == (4,)
    stuck = noisy(e, rng)
    stuck[1000:2200, 7] = stuck[1000, 7]
    d = diagnose_recording(Recording(stuck))
    assert ids(d) == ["stuck"] and d.findings[0].channels == (7,) and abs(d.findings[0].start - 10) < 0.2
    swap = noisy(e, rng)
    swap[2000:, [2, 11]] = swap[2000:, [11, 2]]
    d = diagnose_recording(Recording(swap))
    assert (
        ids(d) == ["swap"] and set(d.findings[0].channels) == {2, 11} and abs(d.findings[0].start - 20) < 0.5
    )


def test_electronics_show_in_the_noise():
    e, rng = unloaded(4)
    t = np.arange(len(e)) / RATE
    d = diagnose_recording(Recording(noisy(e + 4 * np.sin(2 * np.pi * 17.3 * t)[:, None], rng)))
    assert ids(d) == ["hum"] and abs(d.findings[0].theta["frequency"] - 17.3) < 0.02
    x = e + 6 * rng.standard_normal(e.shape)
    y = x.copy()
    for i in range(1, len(y)):
        y[i] = y[i - 1] + (1 - np.exp(-0.01 / 0.03)) * (x[i] - y[i - 1])
    d = diagnose_recording(Recording(np.rint(y)))
    assert ids(d) == ["lowpass"] and abs(d.findings[0].theta["tau"] - 0.03) < 0.006
    near = np.abs(np.subtract.outer(np.arange(19), np.arange(19))) == 1
    d = diagnose_recording(
        Recording(np.rint(e + 6 * rng.standard_normal(e.shape) @ (np.eye(19) + 0.15 * near)))
    )
    assert ids(d) == ["crosstalk"] and abs(d.findings[0].theta["kappa"] - 0.15) < 0.04
    d = diagnose_recording(Recording(8 * np.rint(noisy(e, rng) / 8)))
    assert ids(d) == ["quantise"] and d.findings[0].theta["step"] == 8


def test_latency_against_the_force_is_measured():
    e, force, rng = pressed(5)
    late = np.concatenate([np.repeat(e[:1], 12, axis=0), e[:-12]])
    d = diagnose_recording(Recording(noisy(late, rng), force))
    found = next(f for f in d.findings if f.id == "latency")
    assert abs(found.theta["delay"] - 0.12) < 0.01 and found.verified
    assert "latency" not in ids(diagnose_recording(Recording(noisy(e, rng), force)))


def test_memory_between_force_and_electrodes_is_named_and_measured():
    """Relaxation by its differential equation, a loop by friction elements in parallel with a spring: neither
    is a low-pass nor a delay."""
    e, force, rng = pressed(10)
    slow, relaxed = force[0].copy(), np.empty_like(force)
    for i, f in enumerate(force):
        slow += (f - slow) * 0.01 / 1.2
        relaxed[i] = f + 0.3 * (f - slow)
    d = diagnose_recording(Recording(noisy(e, rng), relaxed))
    (found,) = d.findings
    assert found.id == "relax" and found.verified and not found.ties
    assert abs(found.theta["fraction"] - 0.3) < 0.06 and abs(found.theta["tau"] - 1.2) < 0.3
    spring, kernel = np.zeros(3), np.hanning(23)[1:-1]
    clean = np.stack(
        [np.convolve(np.pad(x, 10, mode="edge"), kernel / kernel.sum(), "valid") for x in force.T], axis=1
    )
    width, loop = 0.3 * force.std(0), np.zeros_like(force)
    for i in range(1, len(force)):
        spring = np.maximum(np.minimum(spring + clean[i] - clean[i - 1], width), -width)
        loop[i] = 0.5 * spring
    d = diagnose_recording(Recording(noisy(e, rng), force + loop))
    found = d.findings[0]
    assert found.id == "hyster" and abs(found.theta["fraction"] - 0.5) < 0.15, d.verdict
    assert ids(diagnose_recording(Recording(noisy(e, rng), force))) == []


def test_a_tie_says_what_would_tell_it_apart():
    """A memory shorter than the movements: the relaxation is tied with hysteresis, and the summary gives the
    experiment."""
    e, force, rng = pressed(13)
    slow, relaxed = force[0].copy(), np.empty_like(force)
    for i, f in enumerate(force):
        slow += (f - slow) * 0.01 / 0.25
        relaxed[i] = f + 0.3 * (f - slow)
    d = diagnose_recording(Recording(noisy(e, rng), relaxed))
    assert d.findings[0].id == "relax" and "hyster" in d.findings[0].ties
    assert "to tell it from rate-independent hysteresis: hold 0, 1 and 30 s at the same depth" in summary(d)


def test_a_force_view_is_an_ordinary_ridge_regression_by_blocks():
    from biotac_mj.discrepancy.recordings.load_search import BETWEEN, ForceView

    e, force, rng = pressed(11)
    view = ForceView(noisy(e, rng), force, np.arange(len(e)) < 5000, np.arange(19), RATE)
    relax = next(b for b in BETWEEN if b.id == "relax")
    theta = {"fraction": 0.3, "tau": 1.6}
    x = relax.unsee(view.x, RATE, theta)[:: view.step]
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
    np.testing.assert_allclose(view.errors([(relax, theta)])[4], expected, rtol=1e-4)
    np.testing.assert_allclose(view.table(relax, [theta])[0, 4], expected.mean(), rtol=1e-4)


def test_gain_of_one_electrode_under_load():
    e, _, rng = pressed(6)
    k = int(np.argmax(e.std(0)))
    half = len(e) * 2 // 5
    e[half:, k] = np.median(e[:, k]) + 1.5 * (e[half:, k] - np.median(e[:, k]))
    d = diagnose_recording(Recording(noisy(e, rng)))
    assert any(f.id == "gain" and f.channels == (k,) for f in d.findings), d.verdict


def test_a_channel_that_comes_back_is_an_event_and_no_fault():
    """Two seconds away from the others name nothing, but are noted; the same step for good is a jump of the
    channel."""
    e, _, rng = pressed(12)
    counts = noisy(e, rng)
    movement = np.convolve(np.abs(np.diff(np.log(4095 / e - 1), axis=0)).sum(1), np.ones(160), "same")
    first = 2500 + int(movement[2500:3500].argmin())  # while the hand holds still
    for last, named in ((first + 200, []), (len(e), ["drift"])):
        moved = counts.copy()
        moved[first:last, 8] = np.clip(moved[first:last, 8] - 350, 0, 4095)
        d = diagnose_recording(Recording(moved))
        assert ids(d) == named and any(
            "e9 leaves the others" in n and "comes back" in n for n in d.notes
        ) == (not named), d.verdict


def test_what_has_no_name_is_called_unknown():
    e, rng = unloaded(7)
    t = np.arange(len(e)) / len(e)
    for k in (1, 5, 6, 11, 14):
        e[:, k] += 30 * np.sin(2 * np.pi * (3 + k) * t + k)
    d = diagnose_recording(Recording(noisy(e, rng)))
    assert "unknown" in d.verdict and "again and again" in d.verdict


def test_the_report_says_what_it_cannot_know(tmp_path):
    e, rng = unloaded()
    d = diagnose_recording(Recording(noisy(e, rng)))
    text = summary(d)
    assert "no force: latency, relaxation and hysteresis" in text and "not loaded: gains, saturation" in text
    files = write_report(d, tmp_path)
    assert all(f.exists() for f in files) and not list(tmp_path.glob(".*"))
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    assert verdict == json.loads(json.dumps(verdict_dict(d))) and verdict["effects"] == []


def test_the_verb_writes_a_verdict(tmp_path, capsys):
    from biotac_mj.cli import main

    e, rng = unloaded(9)
    np.savetxt(tmp_path / "e.txt", noisy(e, rng), fmt="%d")
    assert (
        main(["diagnose", "--electrodes", str(tmp_path / "e.txt"), "--out", str(tmp_path / "r"), "--quiet"])
        == 0
    )
    assert "verdict: no significant disagreement" in capsys.readouterr().out
    assert (tmp_path / "r" / "report.html").exists()
    assert main(["diagnose"]) == 2
    assert "nothing to diagnose" in capsys.readouterr().err


@real
def test_the_real_unloaded_sensor_warms_up():
    d = diagnose_recording(read_recording(REAL / "SynImpF2.txt"))
    assert ids(d) == ["warmup"] and d.locked == 0.4
    assert d.gap["electrodes at rest"]["variance_removed"] > 0.9
    assert d.gap["electrodes at rest"]["drift_variance_removed"] > 0.9


@real
def test_the_real_pressed_sensor_is_described_better_with_what_was_found():
    d = diagnose_recording(read_recording(REAL / "SynImpF1.txt", REAL / "ForceData.txt"))
    assert "warmup" in ids(d) and d.locked == 0.3
    assert len(d.gap) == 3
    for view in d.gap.values():
        assert view["after"] < view["before"]


# --- which amendments a view takes  ---


def test_what_is_seen_of_a_force_is_undone():
    from biotac_mj.discrepancy.recordings.effects.loads import Hysteresis, Latency, LoadLowPass, Relaxation

    _, force, _ = pressed(3)
    force = np.cumsum(force - force.mean(0), axis=0)
    force = force / force.std(0)  # smooth
    for effect, theta in (
        (Latency(), {"delay": 0.073, "start": 0.0, "end": np.inf}),
        (Latency(), {"delay": 0.073, "start": 20.0, "end": 50.0}),
        (LoadLowPass(), {"tau": 0.04}),
        (Relaxation(), {"fraction": 0.3, "tau": 1.5}),
        (
            Hysteresis(),
            {"fraction": 0.2, "width": np.full(3, 0.1)},
        ),  # its loop follows the force that is asked for: the least exact
    ):
        seen = effect.see(force, RATE, theta)
        left = (effect.unsee(seen, RATE, theta) - force)[100:-100].std()
        assert left < 0.2 * (seen - force).std(), effect.id


def test_the_part_kept_aside_does_not_choose():
    """Choices of amendments are the same whatever the last rows hold."""
    from biotac_mj.discrepancy.recordings.session import Session
    from biotac_mj.discrepancy.recordings.views import choose

    e, force, rng = pressed(8)
    z = (4095 / e - 1) * np.exp(-0.3 * (1 - np.exp(-np.arange(len(e)) / 2500)))[:, None]
    counts = noisy(4095 / (z + 1), rng)
    d = diagnose_recording(Recording(counts, force))
    assert "warmup" in ids(d)
    fit, views = d.session.fit, list(d.gap)
    chosen = choose(d.session, d.session.findings, views)
    counts[~fit], force[~fit] = counts[~fit][::-1], -force[~fit]
    other = Session(Recording(counts, force), fit)
    again = choose(other, d.session.findings, views)
    assert chosen == again and any(c.time != "none" for v in views for c in chosen[v][0])
    for name, view in d.gap.items():
        assert (
            view["after"] < view["before"]
            or name == "force from electrodes"
            and view["after"] == view["before"]
        )


def test_a_channel_that_is_stuck_in_a_trial_alone_is_left_out_of_it():
    """Masked for most of the first rows, usable on the whole: trials have one electrode less than the
    report."""
    e, force, rng = pressed(9)
    z = (4095 / e - 1) * np.exp(-0.4 * np.arange(len(e)) / len(e))[:, None]
    counts = noisy(4095 / (z + 1), rng)
    counts[: len(e) * 35 // 100, 6] = counts[0, 6]
    d = diagnose_recording(Recording(counts))
    assert {"stuck", "warmup"} <= set(ids(d))
    view = d.gap["each electrode from the others"]
    assert view["after"] < view["before"] and len(view["channels_after"]) == 19


def test_a_trend_that_turns_round_is_not_carried_on():
    """A gain that comes and goes: carried on it would be wrong, and earlier turns inside the part fitted say
    so."""
    from biotac_mj.discrepancy.recordings.views import Choice, _best

    asked = [Choice("carried on"), Choice("held"), Choice("none")]
    trials = np.array([[0.0, 0, 0], [0.3, 0.2, 0], [-0.2, -0.2, 0], [0.1, -0.05, 0]])
    assert asked[_best(asked, trials, trials[1:].mean(0), wary=True)].time == "held"
    assert asked[_best(asked, trials[:3], trials[:3].mean(0), wary=True)].time == "none"
    assert (
        asked[_best(asked, trials[:1] - [0.5, 0.6, 0], np.array([-0.5, -0.6, 0]), wary=True)].time == "none"
    )
    assert asked[_best(asked, 0 * trials, np.zeros(3), wary=False)].time == "carried on"


def test_the_benchmarks_generator_shares_no_code_with_what_it_judges():
    source = (
        pathlib.Path(__file__).parents[1] / "benchmarks/discrepancy_recordings_generator.py"
    ).read_text()
    assert "biotac_mj" not in source and "import numpy" in source
