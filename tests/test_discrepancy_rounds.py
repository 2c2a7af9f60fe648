"""The next experiment and rounds: expected evidence against closed forms, plans within bounds, evidence that
adds up."""

import csv
import dataclasses
import json
import types

import numpy as np
import pytest
import yaml
from test_discrepancy_workflow import Springs, measured

from biotac_mj.discrepancy import diagnose
from biotac_mj.discrepancy.trajectories.base.nuisance import Nuisance
from biotac_mj.discrepancy.trajectories.beliefs import Beliefs, Explanation, _effect, _posed, pooled, weights
from biotac_mj.discrepancy.trajectories.contacts import Bounds, drawn, trajectory_of
from biotac_mj.discrepancy.trajectories.design import Separation, _solved, planned
from biotac_mj.discrepancy.trajectories.fitting import Fit
from biotac_mj.discrepancy.trajectories.plan_files import COLUMNS, write_plan
from biotac_mj.discrepancy.trajectories.trajectory import read_trajectories
from biotac_mj.effects.catalogue import CATALOGUE, by_id
from biotac_mj.effects.rubber import SPOT, Spots

BOUNDS = Bounds(force=1.2, depth=1.2e-3, tools=("sphere_7mm", "sphere_14mm"))


class Shown:
    """An explanation whose residuals and their derivatives are given, contact by contact."""

    def __init__(self, residuals, columns, information, weight):
        self.shown, self.information, self.weight = list(zip(residuals, columns)), information, weight

    def residuals(self, comparison, known=None):
        return self.shown


def separation(seed=0, contacts=3, rows=12, k=2):
    rng = np.random.default_rng(seed)
    ones = [
        Shown(
            rng.normal(0, 0.3, (contacts, rows)),
            rng.normal(0, 0.2, (contacts, rows, k)),
            3.0 * np.eye(k),
            weight,
        )
        for weight in (0.6, 0.4)
    ]
    comparison = type("Contacts", (), {"trajectories": [None] * contacts})
    return ones, Separation(ones, comparison)


def test_expected_evidence_is_gaussian_with_free_parameters():
    """x'(1 + S L^-1 S')^-1 x / 2, with all contacts stacked, one of them made twice."""
    ones, found = separation()
    times = np.array([1.0, 0.0, 2.0])
    nats = found.nats(times)
    for a, b in ((0, 1), (1, 0)):
        picked = [0, 2, 2]
        x = np.concatenate([ones[b].shown[u][0] - ones[a].shown[u][0] for u in picked])
        S = np.concatenate([ones[b].shown[u][1] for u in picked])
        covariance = np.eye(len(x)) + S @ np.linalg.solve(ones[b].information, S.T)
        assert nats[a, b] == pytest.approx(0.5 * x @ np.linalg.solve(covariance, x), rel=1e-9)


def test_a_greedy_plan_is_worth_more_than_any_contact_twice():
    _, found = separation(contacts=6)
    picked = np.bincount(found.chosen(2), minlength=6).astype(float)
    assert picked.sum() == 2
    assert found.worth(picked) >= max(found.worth(2.0 * one) for one in np.eye(6)) - 1e-9


def test_explanations_that_show_the_same_are_not_told_apart():
    rng = np.random.default_rng(1)
    same = rng.normal(0, 1, (4, 9)), np.zeros((4, 9, 1)), np.eye(1)
    other = rng.normal(0, 1, (4, 9)), *same[1:]
    comparison = type("Contacts", (), {"trajectories": [None] * 4})
    found = Separation([Shown(*same, 0.4), Shown(*same, 0.4), Shown(*other, 0.2)], comparison)
    assert found.alike(20) == [(0, 1)]


def test_weights_follow_the_evidence_and_the_number_of_effects():
    first, second = weights([-100.0, -110.0], [1, 1])
    assert first / second == pytest.approx(np.exp(10))
    more = weights([-100.0, -100.0], [1, 2])
    assert more[0] / more[1] > 20
    # what the likelihood leaves out comes again in every contact
    ten, twenty = (weights([-100.0, -200.0], [1, 1], contacts) for contacts in (10, 20))
    assert np.log(ten[0] / ten[1]) == pytest.approx(2 * np.log(twenty[0] / twenty[1]))


def explained(*names, own=0.0, off=0.0):
    """A Fit of 12 contacts with these effects, whose poses are off by the same [m]."""
    effects, offsets = [(by_id(name), by_id(name).default()) for name in names], np.full((12, 3), off)
    return Fit(effects, Nuisance(), [], np.zeros((0, 0)), own, offsets=offsets, own_evidence=own)


def test_errors_of_poses_are_evidence_of_every_contact():
    """They are another in each, whatever the likelihood leaves out of all; not where a likelier explanation
    without an offset of all poses leaves them as small."""
    comparison = types.SimpleNamespace(repeatability=5e-5)
    null, found = explained(off=6e-5), explained("depth0", own=22.0)
    scatter = 18 * (6 / 5) ** 2
    assert _posed(comparison, found, [null, found]) == pytest.approx(min(scatter, 22.0))
    for other, known in ((explained("stiffen", own=50.0), 0.0), (explained("stiffen", own=9.0), 22.0)):
        fits = [null, other, found]
        assert _posed(comparison, found, fits) == pytest.approx(known)
        assert _posed(comparison, other, fits) == 0.0
    both, alone = explained("stiffen", "depth0", own=60.0), explained("stiffen", own=9.0, off=1e-5)
    assert _posed(comparison, both, [null, alone, both]) == pytest.approx(18 * (1 / 5) ** 2)


def test_contacts_begin_at_the_skin_and_keep_within_bounds():
    sim = Springs()
    found = drawn(sim, BOUNDS, 12)
    assert len(found) > 6
    for contact, at, mat in found:
        t = trajectory_of(contact, at, mat, 0.0, "one", 19)
        assert t.depth.max() <= BOUNDS.depth + 1e-12 and t.depth[0] == 0
        np.testing.assert_allclose(mat @ mat.T, np.eye(3), atol=1e-12)
        assert np.linalg.norm(at[1:]) < 12e-3  # on the finger
        load = np.linalg.norm(sim.solve([t])[0]["force"], axis=1)
        assert load.max() < BOUNDS.force
        assert np.abs(np.diff(t.pos, axis=0)).sum() > 2 * contact.depth


def test_a_contact_is_within_reach_on_its_whole_path():
    bounds = dataclasses.replace(BOUNDS, reach=(-9e-3, -7e-3))
    found = drawn(Springs(), bounds, 24)
    assert len(found) > 22 and sum(abs(c.slide) > 2e-4 for c, _, _ in found) > 5
    for contact in found:
        x = trajectory_of(*contact, 0.0, "one", 19).pos[:, 0]
        assert bounds.reach[0] - 1e-12 <= x.min() and x.max() <= bounds.reach[1] + 1e-12


@pytest.mark.parametrize("change", [{"force": 0.0}, {"depth": 9e-3}, {"reach": (1e-3, -1e-3)}, {"tools": ()}])
def test_bad_bounds_are_refused(change):
    with pytest.raises(ValueError, match="give"):
        Bounds(**change)


@pytest.fixture(scope="module")
def first():
    """A low-pass filter, in eight presses."""
    effect = by_id("lowpass")
    data = measured([(effect, {**effect.default(), "tau": 0.02})], n=8)
    some = [by_id(name) for name in ("lowpass", "latency", "depth0")]
    return data, some, diagnose(Springs(), data, effects=some, progress=False)


def test_a_plan_looks_for_effects_that_no_contact_has_shown():
    """Presses that never slide do not show friction, and what is decided about a filter leaves it open."""
    some = [by_id(name) for name in ("lowpass", "friction")]
    data = measured([(some[0], {**some[0].default(), "tau": 0.02})], n=8)
    beliefs = diagnose(Springs(), data, effects=some, progress=False).beliefs
    assert [one.ids for one in beliefs.unseen] == [["lowpass", "friction"]]
    plan = planned(beliefs, Springs(), BOUNDS, 4, 24, progress=False)
    assert any(one.contact.slide for one in plan.contacts)


def test_a_plan_tells_whether_a_suspected_effect_is_there(first):
    """It contradicts nothing that has a name, and is a question all the same."""
    _, some, report = first
    found, *_ = report.beliefs.explanations
    later = some[1], some[1].default() | {"delay": 0.02}
    both = dataclasses.replace(found, effects=[*found.effects, later], weight=0.3, information=None)
    both = dataclasses.replace(both, information=np.eye(len(list(both.moves()))))
    beliefs = dataclasses.replace(report.beliefs, explanations=[found, both], unseen=[])
    plan = planned(beliefs, Springs(), BOUNDS, 2, 12, progress=False)
    assert plan.nats[found.name, both.name] > 0


def test_a_contact_that_shows_what_no_data_show_is_chosen():
    """An effect of one contact in four, on which names that are decided are silent."""
    left = np.zeros((4, 9)), np.ones((4, 9, 1)), 1e6 * np.eye(1)
    shown = np.zeros((4, 9))
    shown[2, :3] = 2.0
    comparison = type("Contacts", (), {"trajectories": [None] * 4})
    first = Shown(*left, 1.0)
    assert Separation([first], comparison, [Shown(shown, *left[1:], 0.03)]).chosen(1) == [2]
    assert Separation([first], comparison).chosen(1) != [2]


def test_a_plan_tells_more_than_random_contacts(first, tmp_path):
    _, _, report = first
    beliefs = report.beliefs
    plan = planned(beliefs, Springs(), BOUNDS, 6, 24, progress=False)
    assert len(plan.contacts) == 6 and all(one.reason for one in plan.contacts)
    # fast ones: by speed a filter and a delay are told apart
    speeds = [one.contact.speed for one in plan.contacts]
    everywhere = [c.speed for c, _, _ in drawn(Springs(), BOUNDS, 24)]
    assert np.median(speeds) > np.median(everywhere)
    files = write_plan(plan, tmp_path / "plan.csv")
    assert all(f.stat().st_size for f in files)
    rows = list(csv.DictReader((tmp_path / "plan.csv").open()))
    assert list(rows[0]) == COLUMNS.split()
    t = plan.contacts[0].trajectory
    at = np.array([[float(r[f"object_pos_{a}"]) for a in "xyz"] for r in rows if r["contact"] == "1"])
    np.testing.assert_allclose(at, t.pos, atol=1e-7)
    documents = list(yaml.safe_load_all((tmp_path / "plan.yaml").read_text()))
    assert len(documents) == 6 and len(documents[0]["points"]) == len(t.time)
    last = documents[0]["points"][-1]["time_from_start"]
    assert last["sec"] + 1e-9 * last["nanosec"] == pytest.approx(t.time[-1])


def test_a_plan_solves_what_its_explanations_use():
    """A spot that earlier contacts touched, and of each curve its middle: nothing is fitted to a plan."""
    data, spot = measured([], n=4), "at_-8.0_-6.5_0.0"
    fields, fitted = Springs().fields(data, False, [spot]), Springs().fields(data, False)
    assert [name for name in fields.slopes if name.startswith(SPOT)] == [spot]
    assert len(fields.deeper.solved) == len(fields.film.solved) == 3 < len(fitted.deeper.solved)
    one = Explanation([(Spots([spot]), {spot: 0.3})], Nuisance(), 0.0, np.eye(1))
    assert _solved(one, fields) and not _solved(one, fitted)


def test_beliefs_are_the_same_after_saving(first, tmp_path):
    data, some, report = first
    report.beliefs.save(tmp_path / "round", Springs(), data)
    kept, sim = Beliefs.load(tmp_path)
    assert (
        kept.text == report.beliefs.text and sim.skin == "coarse" and kept.further == report.beliefs.further
    )
    for a, b in zip(kept.explanations, report.beliefs.explanations):
        assert a.ids == b.ids and a.nuisance == b.nuisance and a.weight == b.weight
        np.testing.assert_array_equal(a.information, b.information)
        assert [theta for _, theta in a.effects] == [theta for _, theta in b.effects]
    json.loads((tmp_path / "round" / "beliefs.json").read_text(), parse_constant=pytest.fail)


def test_rounds_share_one_clock_and_count_trajectories_once(first, tmp_path):
    data, _, report = first
    report.beliefs.save(tmp_path / "round", Springs(), data)
    more = measured([], n=6, seed=5)
    both = pooled([tmp_path], more)
    assert len(both) == len(data) + len(more) == len({t.id for t in both})
    assert min(t.clock for t in both[len(data) :]) > max(t.clock + t.time[-1] for t in both[: len(data)])
    report.beliefs.save(tmp_path / "next" / "round", Springs(), both)
    again = pooled([tmp_path, tmp_path / "next"], [])
    assert len(again) == len(both)
    assert len(read_trajectories(tmp_path / "next" / "round" / "measured.h5")) == len(both)


def test_a_report_without_poses_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="biotac diagnose"):
        Beliefs.load(tmp_path)


def test_more_effects_do_not_contradict_an_explanation():
    def one(names, weight):
        effects = [(by_id(n), by_id(n).default()) for n in names]
        return Explanation(effects, Nuisance(), 0.0, np.eye(1), weight)

    some = [one(["relax"], 0.6), one(["relax", "latency"], 0.37), one(["creep"], 0.03)]
    beliefs = Beliefs(some, 5e-5, {}, 0.0)
    assert beliefs.odds == pytest.approx(0.97 / 0.03) and beliefs.decided
    doubted = Beliefs(some, 5e-5, {}, 0.0, ["power-law relaxation may be as good"])
    assert not doubted.decided and "if it is one of these, " in doubted.text and "power-law" in doubted.text
    more = Beliefs(some, 5e-5, {}, 0.0, further=0.1)
    assert more.distinguished and not more.decided and "may be there as well, 10%" in more.text


def test_excluded_effects_are_less_likely_than_unseen_ones():
    """Of effects that are not there: relaxation, which presses show, and liquid lost, which springs do not
    know."""
    some = [by_id(name) for name in ("latency", "relax", "fluidloss")]
    data = measured([(some[0], {**some[0].default(), "delay": 0.06})], n=8)
    beliefs = diagnose(Springs(), data, effects=some, progress=False).beliefs
    likely = {one.ids[-1]: one.weight for one in beliefs.unseen}
    assert likely["fluidloss"] > 10 * likely["relax"]
    assert beliefs.further == pytest.approx(
        sum(likely.values()) / (beliefs.explanations[0].weight + sum(likely.values()))
    )


@pytest.mark.parametrize("entry", CATALOGUE, ids=lambda e: e.id)
def test_an_effect_that_is_read_back_has_its_parameters(entry):
    """Of a realistic size, as in what may be there unseen; every parameter can be moved."""
    start = Explanation([], Nuisance(), 0.0, np.zeros((0, 0)))
    theta = start.with_unseen(entry, 0.0).effects[0][1]
    read = _effect(entry.id, theta, entry.design)
    assert read.params.keys() == theta.keys()
    moved = Explanation([(read, theta)], Nuisance(), 0.0, np.zeros((0, 0))).moves()
    assert len(list(moved)) >= len(theta)
