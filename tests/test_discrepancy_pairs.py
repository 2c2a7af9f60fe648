"""What single electrodes and channels show of an effect beside others, diagnosed with poses (synthetic: the
sensor of springs)."""

import dataclasses

import numpy as np
import pytest
from test_discrepancy_base_model import changed
from test_discrepancy_workflow import Springs, measured

from biotac_mj.discrepancy import diagnose, load_simulator
from biotac_mj.discrepancy.trajectories.fitting import fit_effects
from biotac_mj.discrepancy.trajectories.search import screened
from biotac_mj.discrepancy.trajectories.trajectory import measurement_noise
from biotac_mj.discrepancy.trajectories.whitening import Comparison
from biotac_mj.effects.catalogue import by_id


def compared(data):
    comparison = Comparison(Springs(), data, Springs().fields(data, False), measurement_noise(data))
    chosen = np.arange(len(data))
    return comparison, fit_effects(comparison, [], chosen), chosen


def bent(counts, clock, rng):
    """One answers by a third less, one by two fifths more where it answers little."""
    change = counts - counts[0]
    counts[:, 6] -= 0.34 * change[:, 6]
    counts[:, 14] += 0.42 * change[:, 14] / (1 + 1.5e-3 * np.abs(change[:, 14]))
    return counts


@pytest.mark.slow  # quick: which electrodes are singled out, and how their gains bend
def test_two_gains_that_bend_are_those_of_two_electrodes(tmp_path):
    report = diagnose(Springs(), changed(bent, n=10), progress=False)
    assert [e.id for e in report.effects] == ["gain"], report.verdict
    size = {name: p.value for name, p in report.effects[0].parameters.items()}
    assert set(size) == {"e7", "e15", "fade"} and size["e7"] < -0.25 and 0.3 < size["e15"] < 0.6
    report.apply(Springs()).save(tmp_path / "amended.yaml")
    ((effect, theta),) = load_simulator(tmp_path / "amended.yaml").effects
    assert theta["fade"] == pytest.approx(size["fade"]) and theta["e15"] == pytest.approx(size["e15"])
    assert theta["e1"] == 0


def test_electrodes_are_singled_out_only_where_few_stand_out():
    gain, drift = by_id("gain"), by_id("electrode_drift")

    def narrowed(comparison, null, effect, chosen):
        return screened(comparison, null, [effect], chosen)[0][1]

    nothing = compared(measured([]))
    assert narrowed(*nothing[:2], gain, nothing[2]) is gain
    assert narrowed(*nothing[:2], drift, nothing[2]) is drift
    every = {e: float(v) for e, v in zip(gain.params, np.random.default_rng(0).normal(0, 0.15, 19))}
    scattered = compared(measured([(gain, every)]))
    assert narrowed(*scattered[:2], gain, scattered[2]) is gain  # all of them: manufacturing
    # nor are leads of all pairs cross-talk, however well that many explain
    assert len(narrowed(*scattered[:2], by_id("crosstalk"), scattered[2]).free) <= 5
    two = compared(changed(bent))
    bending = narrowed(*two[:2], gain, two[2])
    assert bending.free == ["e7", "e15"]
    begin = bending.default() | bending.grid[1]
    ((_, size),) = fit_effects(two[0], [(bending, begin)], two[2]).effects
    assert size["e7"] < -0.25 and 0.2 < size["e15"] < 0.6 and size["fade"] > 0.1
    assert narrowed(*two[:2], drift, two[2]) is drift


class Loop(type(by_id("hyster"))):
    """The liquid's pressure has no loop."""

    def apply(self, run, theta):
        pressure = run.pressure
        super().apply(run, theta)
        run.pressure = pressure


def looping(**kw):
    return measured([(Loop(), {"fraction": 0.15, "film": 0.0, "width": 0.15e-3})], **kw)


def test_a_loop_of_the_force_alone_takes_none_from_the_liquid():
    comparison, without, chosen = compared(looping(n=6))
    law = by_id("hyster").given(["liquid"])
    fit = fit_effects(comparison, [(law, law.default())], chosen)
    ((_, loop),) = fit.effects
    assert loop["fraction"] == pytest.approx(0.15, abs=0.04)
    assert loop["liquid"] == pytest.approx(-loop["fraction"], abs=0.04)
    assert fit.score - without.score > 24  # e^4 times as likely, by each of six
    alone = {"fraction": 0.01, "liquid": 0.3}
    assert by_id("hyster").rejection_reason(alone) == by_id("hyster_load").rejection_reason(alone) == "liquid"


@pytest.mark.slow  # quick: the loop by itself
def test_a_loop_of_the_force_alone_is_found_beside_a_drift():
    """What the drift's law lacks is no offset of its electrode."""
    data = [
        dataclasses.replace(
            t, electrodes=t.electrodes - np.outer(58 * ((t.clock + t.time) / 100) ** 0.7, np.arange(19) == 6)
        )
        for t in looping()
    ]
    report = diagnose(Springs(), data, progress=False)
    assert {e.id for e in report.effects} == {"electrode_drift", "hyster"}, report.verdict
    loop = {n: p.value for e in report.effects if e.id == "hyster" for n, p in e.parameters.items()}
    assert loop["fraction"] == pytest.approx(0.15, abs=0.04)
    assert loop["liquid"] == pytest.approx(-loop["fraction"], abs=0.04)


def test_a_deep_press_takes_no_power_from_light_ones():
    data = measured([])
    light = int(np.argmin([np.abs(t.force).max() for t in data]))
    deep = int(np.argmax([np.abs(t.force).max() for t in data]))
    more = [dataclasses.replace(t, force=t.force * (20 if k == deep else 1)) for k, t in enumerate(data)]
    before, after = compared(data)[0].sigmas, compared(more)[0].sigmas
    np.testing.assert_allclose(after[light, -3:], before[light, -3:], rtol=0.1)  # noise is told by all
    assert after[deep, -3:].mean() > 5 * before[deep, -3:].mean()


def test_noise_is_told_at_rest_where_measured_poses_tremble():
    """By some micrometres, where a row moves by a hundred."""
    rng = np.random.default_rng(0)
    data = [dataclasses.replace(t, pos=t.pos + 3e-6 * rng.normal(size=t.pos.shape)) for t in measured([])]
    true = measurement_noise(measured([]))
    for name, most in (("electrodes", 1.15), ("force", 1.2)):
        assert np.median(measurement_noise(data)[name] / true[name]) < most


def test_a_gain_of_pdc_is_seen_beside_what_all_channels_bear():
    """Synthetic: a warm-up of all electrodes, and PDC that shows a tenth more."""
    warm, pdc = by_id("warmup"), by_id("pdc_gain")
    hidden = [(warm, {**warm.default(), "a": -0.25}), (pdc, {"gain": 0.1})]
    comparison, null, chosen = compared(measured(hidden))
    current = fit_effects(comparison, hidden[:1], chosen, null)
    both = fit_effects(comparison, hidden, chosen, current)
    assert both.score - current.score > 10
    assert both.effects[1][1]["gain"] == pytest.approx(0.1, abs=0.03)
