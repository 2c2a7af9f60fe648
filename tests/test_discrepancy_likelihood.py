"""The likelihood of data under a model that is nearly right, against densities that are computed whole."""

import dataclasses
import types

import numpy as np
import pytest
from test_discrepancy_workflow import Springs, measured

from biotac_mj.discrepancy.evidence import asked
from biotac_mj.discrepancy.trajectories.fitting import fit_effects
from biotac_mj.discrepancy.trajectories.likelihood import kernel, of
from biotac_mj.discrepancy.trajectories.model.fields import Curve
from biotac_mj.discrepancy.trajectories.remarks import of_search
from biotac_mj.discrepancy.trajectories.search import found, screened
from biotac_mj.discrepancy.trajectories.settings import SETTINGS
from biotac_mj.discrepancy.trajectories.signatures import Signatures
from biotac_mj.discrepancy.trajectories.trajectory import measurement_noise
from biotac_mj.discrepancy.trajectories.whitening import Comparison
from biotac_mj.effects.catalogue import by_id

SOME = [by_id(name) for name in ("relax", "latency", "depth0", "stiffen", "gain")]


def compared(hidden=(), n=6, seed=0):
    data = measured(list(hidden), n=n, seed=seed)
    comparison = Comparison(Springs(), data, Springs().fields(data, False), measurement_noise(data))
    chosen = np.arange(len(data))
    return comparison, fit_effects(comparison, [], chosen), chosen


@pytest.fixture(scope="module")
def plain():
    return compared()


def test_evidence_is_the_density_of_noise_poses_and_discrepancy(plain):
    comparison, chosen = plain[0], np.arange(2)
    likelihood = of(comparison, chosen)
    amplitude = np.linspace(0.5, 2.0, comparison.width)
    residual = likelihood.stacked(comparison.raw([]))
    poses = likelihood.poses(np.zeros((6, 3)))[:3]  # of the first
    log, weights, _ = likelihood.evidence(
        likelihood.turned(residual), poses, likelihood.variance(amplitude, likelihood.size)
    )
    data = [comparison.trajectories[i] for i in chosen]
    K = kernel(data, [np.arange(len(t.time)) for t in data])
    n, w = residual.shape
    whole = np.zeros((n, w, n, w))
    for c in range(w):
        whole[:, c, :, c] = (amplitude[c] * likelihood.size[c]) ** 2 * K
        whole[:, c, :, c] += np.eye(n) * likelihood.noise[c] ** 2
    columns = np.zeros((3, n, w))
    columns[:, : len(data[0].time)] = comparison.repeatability * np.array(comparison.moved(0))
    columns = columns.reshape(3, -1)
    whole = whole.reshape(n * w, n * w) + columns.T @ columns
    factor = np.linalg.cholesky(whole)
    white = np.linalg.solve(factor, residual.ravel())
    expected = -0.5 * white @ white - np.log(np.diag(factor)).sum()
    assert log == pytest.approx(expected, rel=1e-8)
    np.testing.assert_allclose(
        weights, columns @ np.linalg.solve(whole, residual.ravel()), rtol=1e-5, atol=1e-9
    )


def test_a_likelihood_knows_no_rest_of_other_trajectories(plain):
    """Others may touch in row 0, by poses that are not fitted; what the own ones' rest moves by is known."""
    comparison, chosen = plain[0], np.arange(1, 4)
    data = list(comparison.trajectories)
    data[0] = dataclasses.replace(data[0], electrodes=data[0].electrodes + 300.0, pdc=data[0].pdc + 50.0)
    other = Comparison(Springs(), data, comparison.fields, comparison.noise)
    some, same = (of(c, chosen).stacked(c.measured) for c in (comparison, other))
    np.testing.assert_allclose(same, some, atol=1e-9)
    likelihood, offsets = of(comparison, chosen), np.zeros((6, 3))
    offsets[1, 1], by = 1e-4, 1e-7  # it touches from the first row on
    before, after = (
        likelihood.turned(likelihood.stacked(comparison.raw([], offsets=o)))
        for o in (offsets, offsets + by * (np.arange(18) == 4).reshape(6, 3))
    )
    moved = likelihood.poses(offsets)[1] / comparison.repeatability
    np.testing.assert_allclose((before - after) / by, moved, atol=0.03 * np.abs(moved).max())


def test_trajectories_apart_share_laws_and_no_discrepancy(plain):
    """What the model misses in the others tells nothing of them; what a law lacks there does."""
    comparison, every = plain[0], np.arange(6)
    own, whole = of(comparison, every, every[4:]), of(comparison, every)
    covariance, joint = ((k._vectors * k._scale) @ k._vectors.T for k in (own, whole))
    first = sum(len(t.time) for t in comparison.trajectories[:4])
    assert np.abs(covariance[:first, first:]).max() < 1e-9 < np.abs(joint[:first, first:]).max()
    for part in (slice(first), slice(first, None)):
        np.testing.assert_allclose(covariance[part, part], joint[part, part], atol=1e-9)
    np.testing.assert_array_equal(own.error_modes, whole.error_modes)


def test_the_kernel_is_a_covariance():
    data = measured([], n=3)
    K = kernel(data, [np.arange(len(t.time)) for t in data])
    np.testing.assert_allclose(K, K.T)
    assert np.linalg.eigvalsh(K).min() > -1e-9 and K.max() == pytest.approx(0.9 * 1.03**2 + 0.1)


def test_what_a_model_misses_is_as_much_as_was_hidden(plain):
    """Synthetic: a bump of 40 counts on one electrode that goes with place and depth."""
    comparison, null, _ = plain
    assert np.exp(np.log(null.amplitude).mean()) < SETTINGS.beyond
    data = [
        dataclasses.replace(
            t, electrodes=t.electrodes + np.outer(40 * (t.depth / 1e-3) ** 2, np.arange(19) == 5)
        )
        for t in comparison.trajectories
    ]
    other = Comparison(Springs(), data, Springs().fields(data, False), measurement_noise(data))
    amplitude = fit_effects(other, [], np.arange(len(data))).amplitude
    assert amplitude.argmax() == 5 and amplitude[5] > 3 * null.amplitude[5]


@pytest.mark.parametrize("seed", range(4))
def test_data_with_nothing_in_them_show_no_effect(seed, monkeypatch):
    """Nor do data that are drawn from the model of them: a ratio of densities is one on average."""
    kept, columns = {}, Signatures.columns

    def once(signatures, effect, shape):  # of one fit: data that are drawn do not change them
        key = effect.id, *effect.params, *sorted(shape.items())
        return kept[key] if key in kept else kept.setdefault(key, columns(signatures, effect, shape))

    comparison, null, chosen = compared(seed=seed)
    assert screened(comparison, null, SOME, chosen)[0][0] < asked(len(SOME))
    search = found(comparison, null, SOME, chosen)
    assert not search.found and all(c.p > SETTINGS.rate for c in search.rounds[0])
    monkeypatch.setattr(Signatures, "columns", once)
    likelihood, rng, ratios = of(comparison, chosen), np.random.default_rng(seed), []
    sd = np.sqrt(likelihood.variance(null.amplitude, null.size))
    for _ in range(40):
        y = np.tensordot(rng.standard_normal(len(null.columns)), null.columns, 1)
        y = y + sd * rng.standard_normal(sd.shape)
        drawn = dataclasses.replace(null, y=y)
        ratios += [np.exp(gain) for gain, *_ in screened(comparison, drawn, SOME, chosen)]
    assert np.mean(ratios) < 1.5 and np.mean(np.array(ratios) > len(SOME) / SETTINGS.rate) < SETTINGS.rate


@pytest.mark.parametrize("name, size", [("friction", -0.9), ("latency", 0.08), ("relax", 0.4)])
def test_a_fit_with_an_effect_more_is_hardly_less_likely(plain, name, size):
    """Wherever straight lines lead: a fit begins from no effect, so it loses its prior's volume at most."""
    from biotac_mj.discrepancy.trajectories.search import _fitted

    comparison, null, chosen = plain
    effect = by_id(name)
    main = next(iter(effect.params))
    far = {**effect.default(), main: -size if effect.params[main].low < 0 else size}
    fit = _fitted(comparison, effect, far, 0.0, null, chosen)
    assert fit.score > null.score - 10


def test_what_would_hardly_show_is_said(plain):
    comparison, null, chosen = plain
    effect = by_id("latency")
    signatures = Signatures(comparison, null, chosen)
    (column,) = signatures.columns(effect, effect.grid[0])
    ((*_, shown),) = screened(comparison, null, [effect], chosen)
    assert shown == pytest.approx(0.5 * signatures.own(column[None])[0] @ column)
    (line,) = of_search(types.SimpleNamespace(unseen=[(0.0, effect, shown), (0.0, by_id("relax"), 0.1)]))
    assert by_id("relax").name in line and effect.name not in line


def test_a_second_law_of_the_same_is_no_second_effect():
    relax = by_id("relax")
    hidden = [(relax, {**relax.default(), "g": 0.3, "tau": 0.5})]
    comparison, null, chosen = compared(hidden, n=8)
    some = [*SOME, by_id("creep")]
    search = found(comparison, null, some, chosen)
    assert [c.effect.id for c in search.found] == ["relax"]
    assert search.fit.effects[0][1]["g"] == pytest.approx(0.3, abs=0.05)
    own = of(comparison, chosen)

    def missed(fit):  # logarithm of how much larger than noise data are
        beyond = np.log(own.variance(fit.amplitude, fit.size).mean(0) / own.noise**2)
        return np.mean([beyond[part].mean() for part in own.groups])

    assert missed(search.fit) < 0.3 * missed(null)


def curve(function, at=(-2.0, 0.0, 1.0, 3.0)):
    at = np.array(at)
    return Curve(at, [np.tile(function(at)[:, None, None], (1, 5, 2))])


def test_a_curve_has_no_turns_that_what_was_solved_lacks():
    at = np.linspace(-3.0, 4.0, 71)
    straight = curve(lambda x: 2 * x)
    for one in (straight, curve(lambda x: np.maximum(x - 0.5, 0.0)), curve(lambda x: np.exp(0.3 * x) - 1)):
        values, slopes = (np.array([f(0, x)[0, 0] for x in at]) for f in (one.at, one.slope))
        np.testing.assert_allclose(
            [one.at(0, x)[0, 0] for x in one.solved], one.changes[0][:, 0, 0], atol=1e-12
        )
        assert (np.diff(values) > -1e-12).all()  # what rises where it was solved rises between
        by = [(one.at(0, x + 1e-6) - one.at(0, x - 1e-6))[0, 0] / 2e-6 for x in at]
        np.testing.assert_allclose(slopes, by, atol=1e-5)
    np.testing.assert_allclose([straight.at(0, x)[3, 1] for x in at], 2 * at, atol=1e-12)
    hinge = curve(lambda x: np.maximum(x, 0.0))
    assert hinge.at(0, -1.0).max() == 0 and hinge.slope(0, -0.5).max() == 0  # what does not touch yet
    rows = straight.at(0, np.arange(5.0))
    np.testing.assert_allclose(rows, np.tile(2 * np.arange(5.0)[:, None], (1, 2)))


def test_what_a_law_lacks_goes_with_what_its_effect_does(plain):
    """One process for all channels, of nearly the law's error everywhere."""
    comparison = plain[0]
    likelihood = of(comparison, np.arange(2))
    change = np.random.default_rng(0).normal(size=likelihood.stacked(comparison.raw([])).shape)
    rows = likelihood._vectors @ likelihood.laws([change], np.array([0.2]))
    process = rows / change
    np.testing.assert_allclose(process, np.broadcast_to(process[:, :, :1], process.shape), atol=1e-6)
    size = np.sqrt((process[:, :, 0] ** 2).sum(0))
    assert 0.15 < size.min() and size.max() < 0.2 + 1e-6
    assert len(likelihood.laws([], np.zeros(0))) == 0


@pytest.fixture(scope="module")
def laws():
    """Synthetic: relaxation as the law has it, and 40 % more of it when deep, less when not: the effect, and
    what is fitted to each."""
    relax = by_id("relax")
    hidden = [(relax, {**relax.default(), "g": 0.3, "tau": 0.5})]
    without, true = measured([], n=8), measured(hidden, n=8)
    other = []
    for a, b in zip(without, true):
        more = 0.4 * np.sign(b.depth - 0.6 * b.depth.max())[:, None]
        change = {k: getattr(b, k) - getattr(a, k) for k in ("electrodes", "force")}
        changed = {k: getattr(b, k) + more * v for k, v in change.items()}
        changed["pdc"] = b.pdc + more[:, 0] * (b.pdc - a.pdc)
        other.append(dataclasses.replace(b, **changed))
    return hidden, [
        Comparison(Springs(), data, Springs().fields(data, False), measurement_noise(data))
        for data in (true, other)
    ]


def test_data_say_how_far_a_law_is_off(laws):
    hidden, compared = laws
    errors = [fit_effects(one, hidden, np.arange(8)).law_errors[0] for one in compared]
    assert errors[0] < SETTINGS.law < errors[1], errors


def test_fits_beside_a_law_that_errs_end_where_the_truth_is(laws):
    """From no effect as from what is hidden."""
    hidden, (_, other) = laws
    chosen = np.arange(8)
    null = fit_effects(other, [], chosen)
    none = [(effect, {**theta, "g": 0.0}) for effect, theta in hidden]
    far, near = (fit_effects(other, start, chosen, null) for start in (none, hidden))
    assert far.score > near.score - 5 > null.score + 100
    assert far.effects[0][1]["g"] == pytest.approx(near.effects[0][1]["g"], abs=0.03)


def test_effects_that_act_in_other_channels_do_not_overlap(plain):
    """A drift of one electrode beside a gain of another and of the same one, and beside relaxation of all."""
    comparison, _, chosen = plain
    drift = by_id("electrode_drift").only(["e7"])
    drift = drift, drift.default() | {"e7": 50.0}

    def overlap(effect, **theta):
        return fit_effects(comparison, [(effect, effect.default() | theta), drift], chosen).overlap

    gain = by_id("gain")
    elsewhere, same = overlap(gain.only(["e3"]), e3=0.2), overlap(gain.only(["e7"]), e7=0.2)
    assert elsewhere < 0.05 < 0.3 < same
    assert overlap(by_id("relax"), g=0.2) < 0.5 * same
