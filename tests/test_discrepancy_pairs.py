"""What single electrodes and channels show of an effect beside others, diagnosed with poses (synthetic: the
sensor of springs)."""

import dataclasses
import types

import numpy as np
import pytest
from test_discrepancy_base_model import changed
from test_discrepancy_workflow import Springs, measured

from biotac_mj.discrepancy import diagnose, load_simulator
from biotac_mj.discrepancy.trajectories import composition
from biotac_mj.discrepancy.trajectories.base.channels import narrowed
from biotac_mj.discrepancy.trajectories.base.nuisance import Nuisance
from biotac_mj.discrepancy.trajectories.fitting import fit_effects
from biotac_mj.discrepancy.trajectories.trajectory import measurement_noise
from biotac_mj.discrepancy.trajectories.whitening import Comparison
from biotac_mj.discrepancy.trajectories.workflow import _compared
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
    nothing = compared(measured([]))
    assert narrowed(*nothing[:2], gain, nothing[2]) is gain
    assert narrowed(*nothing[:2], drift, nothing[2]) is drift
    every = {e: float(v) for e, v in zip(gain.params, np.random.default_rng(0).normal(0, 0.15, 19))}
    scattered = compared(measured([(gain, every)]))
    assert narrowed(*scattered[:2], gain, scattered[2]) is gain  # all of them: manufacturing
    two = compared(changed(bent))
    bending = narrowed(*two[:2], gain, two[2])
    assert bending.free == ["e7", "e15"]
    ((_, size),) = fit_effects(two[0], [(bending, bending.default())], two[2]).effects
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
    assert (
        fit.evidence(comparison) - without.evidence(comparison)
    ).min() > 4  # e^4 times as likely, every one of six
    alone = {"fraction": 0.01, "liquid": 0.3}
    assert by_id("hyster").rejection_reason(alone) == by_id("hyster_load").rejection_reason(alone) == "liquid"


@pytest.mark.slow  # quick: the loop by itself, and an offset that begins late
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


def test_one_trajectory_in_four_may_be_astray_whatever_is_named():
    data = measured([], n=12)

    def astray(every):
        off = 60 * np.random.default_rng(0).normal(size=(12, 19)) * (np.arange(12) % every == 0)[:, None]
        off[::every] -= off[::every].mean(0)  # all is compared about the mean rest
        return compared([dataclasses.replace(t, electrodes=t.electrodes + o) for t, o in zip(data, off)])

    comparison, null, chosen = astray(4)
    square, before, after, left, _ = _compared(comparison, null, null, chosen)
    assert (square[0] > 20).sum() == 3 and before == after and before["level"] < 1.1 and left < 0.1
    comparison, null, chosen = astray(2)
    assert _compared(comparison, null, null, chosen)[1]["level"] > 1.1


@pytest.mark.slow  # quick: electrodes that stand off
def test_an_offset_that_begins_after_the_first_touch_is_one():
    data = [
        t if k == 0 else dataclasses.replace(t, electrodes=t.electrodes + 41.0 * (np.arange(19) == 4))
        for k, t in enumerate(measured([], n=8))
    ]
    report = diagnose(Springs(), data, progress=False)
    assert [e.id for e in report.effects] == ["offset"], report.verdict
    ((name, size),) = report.effects[0].parameters.items()
    assert name == "e5" and size.value == pytest.approx(41, abs=3)


def test_an_effect_is_judged_on_trajectories_unseen_by_the_base(monkeypatch):
    """Synthetic evidence: a deep press is foreseen badly, with the effect or without; the effect helps."""
    chosen, effect = np.arange(8), by_id("relax")
    before = types.SimpleNamespace(effects=[], evidence=lambda c: np.full(8, -5.0))
    after = types.SimpleNamespace(effects=[(effect, effect.default())], evidence=lambda c: np.full(8, -2.0))
    unseen = {id(before): np.array([-6.0] * 7 + [-30.0]), id(after): np.array([-3.0] * 7 + [-26.0])}
    monkeypatch.setattr(composition, "left_out", lambda c, fit, *args: unseen[id(fit)])
    monkeypatch.setattr(composition, "_energy", lambda *args: 1.0)
    monkeypatch.setattr(composition, "_refused", lambda *args: [])
    before.mean_square = lambda c: np.full(8, 2.0)
    comparison = types.SimpleNamespace(trajectories=[types.SimpleNamespace(time=np.zeros(20))] * 8)
    begun = composition._Begun(comparison, before, before, chosen, 0)
    one = composition._candidate(comparison, effect, after, begun, chosen, 0, [])
    np.testing.assert_array_equal(one.gain, [3.0] * 7 + [4.0])
    # too little even where it was fitted: not fitted again
    after.evidence = lambda c: np.full(8, -4.9)
    np.testing.assert_allclose(
        composition._candidate(comparison, effect, after, begun, chosen, 0, []).gain, 0.1
    )


@pytest.mark.parametrize(
    "size, error, refused", [(0.04, 0.01, True), (0.12, 0.01, False), (0.12, 0.12, True)]
)
def test_gains_that_places_of_electrodes_make_are_no_finding(size, error, refused):
    gain = by_id("gain")
    theta = {e: size * (-1) ** k for k, e in enumerate(gain.params)}
    names = [("gain", e) for e in theta]
    fit = types.SimpleNamespace(
        effects=[(gain, theta)],
        names=names,
        covariance=np.diag(np.full(19, error**2)),
        nuisance=Nuisance(),
    )
    one = types.SimpleNamespace(effect=gain, fit=fit, nats=9.0, share=0.5, energy=1.0, p=1e-4)
    assert ("places" in composition._refused(None, one, np.arange(8), [], True)) == refused


@pytest.mark.parametrize("name, refused", [("crosstalk", True), ("asper", True), ("mount", False)])
def test_what_takes_up_anything_is_asked_for_more(name, refused):
    effect = by_id(name)
    fit = types.SimpleNamespace(effects=[(effect, effect.default())], nuisance=Nuisance())
    one = types.SimpleNamespace(effect=effect, fit=fit, nats=1.6, share=0.5, energy=1.0, p=1e-4)
    assert ("vague" in composition._refused(None, one, np.arange(8), [], True)) == refused


def test_a_pdc_gain_is_not_small_next_to_common_changes():
    """Synthetic: a warm-up of all electrodes, and PDC that shows a tenth more."""
    warm, pdc = by_id("warmup"), by_id("pdc_gain")
    hidden = [(warm, {**warm.default(), "a": -0.25}), (pdc, {"gain": 0.1})]
    comparison, null, chosen = compared(measured(hidden))
    current = fit_effects(comparison, hidden[:1], chosen, null)
    both = fit_effects(comparison, hidden, chosen, current)
    begun = composition._Begun(comparison, current, null, chosen, 0)
    squares = [f.mean_square(comparison)[chosen].mean() for f in (null, current, both)]
    of_all = (squares[1] - squares[2]) / (squares[0] - squares[2])
    assert composition._energy(comparison, both, begun, chosen) > max(0.2, 4 * of_all)


@pytest.mark.parametrize("nats, within", [(1.0, True), (12.0, False)])
def test_another_effect_is_no_pose_scatter_if_a_turn_explains(nats, within):
    """Poses that scatter by 0.3 mm beside a turn of 0.7 degrees, where 0.05 mm were stated."""
    effect = by_id("misalign")
    comparison = types.SimpleNamespace(stated=5e-5, scatter=lambda *args: 3e-4)
    fit = types.SimpleNamespace(effects=[], nuisance=None)
    theta = {**effect.default(), "roll": 0.0127}
    assert composition._repeatable(comparison, fit, effect, theta, np.arange(10), nats) == within
