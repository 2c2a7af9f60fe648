"""The proof: what is written as a sensor file is what is judged, group by group, on held-out data."""

import dataclasses
import types

import numpy as np
import pytest
from test_discrepancy_workflow import Springs, measured

from biotac_mj.discrepancy import diagnose
from biotac_mj.discrepancy.report.text import summary
from biotac_mj.discrepancy.trajectories import beliefs, proof, search, workflow
from biotac_mj.discrepancy.trajectories.base.nuisance import Nuisance
from biotac_mj.discrepancy.trajectories.fitting import Fit, fit_effects
from biotac_mj.discrepancy.trajectories.proof import _closed, borne_out, proved
from biotac_mj.discrepancy.trajectories.settings import SETTINGS
from biotac_mj.discrepancy.trajectories.workflow import about_rests
from biotac_mj.effects.catalogue import by_id

LATE = by_id("latency"), {"delay": 0.06}
ASIDE = np.arange(8, 12)


@pytest.fixture(scope="module")
def late():
    """A comparison with late electrodes, and its fit with the constants alone."""
    sim = Springs()
    data = measured([LATE], n=12)
    comparison = about_rests(sim, data, sim.fields(data, progress=False), 5e-5)
    return comparison, fit_effects(comparison, [], np.arange(8))


def amended(null, *effects):
    errors = np.full(len(effects), SETTINGS.law)
    return Fit(list(effects), null.nuisance, [], np.zeros((0, 0)), 0.0, law_errors=errors)


def test_an_effect_that_helps_is_accepted_by_its_residuals(late):
    comparison, null = late
    found = amended(null, LATE)
    proof = proved(comparison, null, found, ASIDE)
    assert proof.fit is found and proof.closed > 0.8
    written = dataclasses.replace(found, nuisance=null.nuisance.written)
    about, lines = comparison.posed(written.raw(comparison, ASIDE), written.effects, written.nuisance)
    for i, residual in zip(ASIDE, proof.residuals[1]):
        np.testing.assert_array_equal(residual, about.unposed(i, lines[i]))


def test_another_law_is_borne_out_and_a_wrong_effect_is_not(late):
    """Electrodes that are late are told in part by a low-pass; PDC needs no gain."""
    comparison, null = late
    law, other = by_id("lowpass"), by_id("pdc_gain")
    near = fit_effects(comparison, [(law, {"tau": 0.05})], np.arange(8), null)
    assert borne_out(comparison, null, near, ASIDE)
    pressure = (other, {**other.default(), "gain": 0.05})
    wrong = dataclasses.replace(null, effects=[pressure], law_errors=np.array([SETTINGS.law]))
    assert not borne_out(comparison, null, wrong, ASIDE)
    assert not borne_out(comparison, near, null, ASIDE)


def test_what_makes_one_group_worse_is_not_taken(late):
    """The electrodes would be right, and pressure a fifth too large."""
    comparison, null = late
    other = by_id("pdc_gain")
    proof = proved(comparison, null, amended(null, LATE, (other, {**other.default(), "gain": 0.2})), ASIDE)
    assert not proof.fit.effects and proof.closed == 0 and proof.after == proof.before


def test_constants_that_make_it_worse_are_not_taken(late):
    comparison, null = late
    softer = dataclasses.replace(null, nuisance=Nuisance(log_modulus=-0.5))
    proof = proved(comparison, softer, softer, ASIDE)
    assert proof.fit.nuisance == Nuisance() and np.isnan(proof.closed)
    proof = proved(comparison, null, null, ASIDE)
    assert proof.fit is null  # the modulus of the data is another one


def test_where_nothing_is_named_nothing_else_is_written():
    data = measured([], n=8)
    report = diagnose(Springs(), data, effects=[by_id("latency")], progress=False)
    assert not report.effects and report.proof.after == report.proof.before
    written = report.apply(Springs())
    assert not written.effects and written.modulus == report.fit.nuisance.modulus


def test_errors_of_poses_are_taken_out_of_residuals(late):
    """Of poses that slip by as much as is stated, most of what that does is taken out, and noise stays."""
    comparison, null = late
    written = dataclasses.replace(null, nuisance=null.nuisance.written)
    about, lines = comparison.posed(written.raw(comparison), [], written.nuisance)
    proof = proved(comparison, null, null, ASIDE)
    for i, residual in zip(ASIDE, proof.residuals[0]):
        u, s, _ = about._basis[i]
        along = u.T @ (lines[i] / comparison.sigmas[i]).ravel()
        left = u.T @ (residual / comparison.sigmas[i]).ravel()
        np.testing.assert_allclose(left, along / (1 + s**2), atol=1e-9)


class Stopped(Springs):
    """Springs that meet something hard where the object is deepest."""

    def solve(self, trajectories, offset=None, *args, **more):
        out = super().solve(trajectories, offset, *args, **more)
        for i, (t, one) in enumerate(zip(trajectories, out)):
            by = 0.0 if offset is None else offset[i] @ t.heading
            deeper = np.maximum((t.pos - t.pos[0]) @ t.heading + by - t.depth.max(), 0)
            one["force"] = one["force"] - np.outer(2e4 * deeper, t.heading)
        return out


def test_a_pose_is_found_where_the_skin_meets_the_core():
    """Straight lines from the recorded poses do not know of what a slip of 15 um meets."""
    sim = Stopped()
    data = measured([], modulus=1.0, of=sim, n=8)
    comparison = about_rests(sim, data, sim.fields(data, progress=False), 2e-5)
    raw = comparison.raw([])
    about, lines = comparison.posed(raw, [], Nuisance())
    force = comparison.groups["force"]
    straight, found = (
        [np.sqrt(np.mean(one.unposed(i, r[i])[:, force] ** 2)) for i in range(len(data))]
        for one, r in ((comparison, raw), (about, lines))
    )
    assert max(straight) > 0.02 and max(found) < 0.007


def test_what_is_left_beyond_resolution_is_not_of_the_base():
    comparison = types.SimpleNamespace(noises=np.ones(2), sigmas=[np.full(2, 2.0)])
    residuals = np.full((5, 2), 10.0), np.full((5, 2), 6.0)
    sides = [(None, [r], float(((r**2).mean(1) - 1).sum())) for r in residuals]
    expected = 1 - np.sqrt(35 / 99), 1 - np.sqrt((35 - 3) / (99 - 3))
    assert _closed(comparison, *sides, 0.05, [0]) == pytest.approx(expected)


def test_what_closes_little_of_its_gap_has_no_name(late, monkeypatch):
    """Electrodes that are late by a twelfth of what they are make the data far likelier all the same."""
    comparison, null = late
    late, little = (
        dataclasses.replace(null, effects=[(LATE[0], {"delay": by})], law_errors=np.array([SETTINGS.law]))
        for by in (0.06, 0.005)
    )
    assert borne_out(comparison, null, late, ASIDE)
    assert not borne_out(comparison, null, little, ASIDE)
    monkeypatch.setattr(proof, "SETTINGS", dataclasses.replace(SETTINGS, explained=0.0))
    assert borne_out(comparison, null, little, ASIDE)


def test_what_the_amended_sensor_leaves_out_has_no_name(monkeypatch):
    """Late electrodes of which held-out trajectories are likelier, where a channel group would be further
    off with them: no finding, no confidence, no decision and no plan to tell them from others."""
    monkeypatch.setattr(proof, "_worse", lambda comparison, *_: True)
    data = measured([LATE], n=12)
    report = diagnose(Springs(), data, effects=[LATE[0], by_id("lowpass")], progress=False)
    assert not report.effects and not report.apply(Springs()).effects
    assert report.verdict.startswith("unknown: ") and report.significant
    assert {(e.id, e.confirmed, e.confidence) for e in report.not_named} == {("latency", False, None)}
    assert not report.beliefs.distinguished and [e.ids for e in report.beliefs.explanations] == [[]]


def test_of_effects_that_tie_the_confirmed_one_has_the_name(monkeypatch):
    """As if held-out trajectories contradicted a low-pass, which explains the fitted ones best."""
    data = measured([(by_id("lowpass"), {"tau": 0.08})], n=12)
    upheld = workflow.borne_out
    monkeypatch.setattr(search, "not_distinguished", lambda best, other, law_error: True)
    monkeypatch.setattr(
        workflow,
        "borne_out",
        lambda comparison, smaller, larger, aside: (
            "lowpass" not in {e.id for e, _ in larger.effects} and upheld(comparison, smaller, larger, aside)
        ),
    )
    report = diagnose(Springs(), data, effects=[LATE[0], by_id("lowpass")], progress=False)
    assert [(e.id, e.ties, e.confirmed) for e in report.effects] == [("latency", {}, True)], report.verdict
    assert report.tried[0]["id"] == "lowpass" and not report.not_named
    assert not any("lowpass" in e.ids for e in report.beliefs.explanations)


def test_what_is_less_likely_than_not_is_suspected(monkeypatch):
    """As if what the likelihood leaves out made nearly all of the evidence."""
    monkeypatch.setattr(beliefs, "_CONTACTS", 1e-3)
    report = diagnose(Springs(), measured([LATE], n=8), effects=[LATE[0], by_id("lowpass")], progress=False)
    assert not report.effects and not report.apply(Springs()).effects and not report.beliefs.decided
    assert report.verdict.startswith("unknown: suspected, and less likely than not: ") and report.significant
    (one,) = report.not_named
    assert one.id == "latency" and one.confirmed and one.confidence < 0.5
    assert one.name in report.next_experiment
    assert f"suspected, less likely than not: {one.name}" in summary(report)
