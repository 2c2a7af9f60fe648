"""Diagnosis with poses of what no change of the skin makes (synthetic: the sensor of springs): electrodes in
each other's place, that drift, stand off or scatter; and what the skin answers to friction and to a turned
sensor."""

import dataclasses
import types

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_discrepancy_workflow import Springs, measured, plans, run_of

from biotac_mj.discrepancy import diagnose, load_simulator
from biotac_mj.discrepancy.trajectories.base import exchanges
from biotac_mj.discrepancy.trajectories.base.exchanges import exchanged
from biotac_mj.discrepancy.trajectories.base.nuisance import Nuisance
from biotac_mj.discrepancy.trajectories.base.rests import rested
from biotac_mj.discrepancy.trajectories.fitting import fit_effects
from biotac_mj.discrepancy.trajectories.model.differences import differences, softer, spots
from biotac_mj.discrepancy.trajectories.model.fields import Fields
from biotac_mj.discrepancy.trajectories.model.simulator import Simulator
from biotac_mj.discrepancy.trajectories.search import screened
from biotac_mj.discrepancy.trajectories.trajectory import measurement_noise
from biotac_mj.discrepancy.trajectories.whitening import Comparison
from biotac_mj.effects.catalogue import by_id
from biotac_mj.effects.rubber import modulus_of
from biotac_mj.geometry.design import BIOTAC
from biotac_mj.sensor.channels import log_impedance
from biotac_mj.sensor.presets import SENSORS
from biotac_mj.skin.settings import plain, read_material


def changed(change, **kw):
    """Trajectories of springs, their electrodes changed by change(counts, session's clock, rng)."""
    rng = np.random.default_rng(7)
    return [
        dataclasses.replace(t, electrodes=np.rint(change(t.electrodes.copy(), t.clock + t.time, rng)))
        for t in measured([], **kw)
    ]


def ring(counts, clock, rng):
    counts[:, [2, 9, 13]] = counts[:, [9, 13, 2]]
    return counts


def fitted(data):
    """A comparison of the springs with data, the base model's fit, and all trajectories."""
    comparison = Comparison(Springs(), data, Springs().fields(data, False), measurement_noise(data))
    chosen = np.arange(len(data))
    return comparison, fit_effects(comparison, [], chosen), chosen


def test_exchanges_and_lead_pairs_are_found_only_where_present():
    assert exchanged(*fitted(changed(ring, n=8))).reads == ((2, 9), (9, 13), (13, 2))
    pairs = {(4, 3): 0.25, (3, 4): 0.12, (15, 14): 0.3}
    plain = by_id("crosstalk")
    for hidden, free in ((pairs, {f"e{i + 1}_hears_e{j + 1}" for i, j in pairs}), ({}, set(plain.free))):
        comparison, fit, chosen = fitted(changed(heard(hidden), n=8))
        ((_, effect, *_),) = screened(comparison, fit, [plain], chosen)
        assert exchanged(comparison, fit, chosen) is None and set(effect.free) == free


def test_a_ring_exchange_is_found_despite_a_contrary_contact(monkeypatch):
    """Nats as in a session of another author, and one electrode that another would fit in one contact."""
    gains = {(5, 18): [36, 66, 104, 75, 146, 58, 50], (9, 5): [37, 25, 71, 52, 55, 49, 62]}
    gains |= {(18, 9): [13, 4, 9, 0, 153, -13, 25], (1, 2): [90, 0, 0, 0, 0, 0, 0], (2, 1): [5] * 7}

    def evidence(comparison, i, predicted):
        out = -200.0 * (1 - np.eye(19))
        for (shows, shown), nats in gains.items():
            out[shows, shown] = nats[i]
        return out

    monkeypatch.setattr(exchanges, "_in_place_of", evidence)
    sim = types.SimpleNamespace(design=BIOTAC)
    comparison = types.SimpleNamespace(measured=[0.0] * 7, sim=sim)
    fit = types.SimpleNamespace(raw=lambda c: [0.0] * 7)
    assert exchanged(comparison, fit, np.arange(7)).reads == ((5, 18), (9, 5), (18, 9))
    gains |= {(18, 9): [13, 4, 9, 0, 60, -13, -55]}
    assert exchanged(comparison, fit, np.arange(7)) is None


def test_what_the_sessions_clock_does_to_electrodes_is_no_wiring():
    def warmer(counts, clock, rng):
        return ring(counts + 40 * np.sqrt(clock / 60)[:, None] * np.cos(np.arange(19)), clock, rng)

    assert exchanged(*fitted(changed(warmer, n=8))).reads == ((2, 9), (9, 13), (13, 2))


@pytest.mark.slow  # quick: the exchange by itself
def test_three_electrodes_in_a_ring_are_exchanged_only_there(tmp_path):
    report = diagnose(Springs(), changed(ring, n=10), progress=False)
    assert [e.id for e in report.effects] == ["swap"], report.verdict
    names = set(report.effects[0].parameters)
    assert names == {"e3_reads_e10", "e10_reads_e14", "e14_reads_e3"}
    assert all(abs(p.value - 1) < 0.1 for p in report.effects[0].parameters.values()) and report.closed > 0.9
    report.apply(Springs()).save(tmp_path / "amended.yaml")
    ((effect, theta),) = load_simulator(tmp_path / "amended.yaml").effects
    assert set(effect.reads) == {(2, 9), (9, 13), (13, 2)} and set(theta) == names


@pytest.mark.slow
def test_one_that_shows_anothers_counts_beside_it_is_no_exchange():
    def copied(counts, clock, rng):
        counts[:, 2] = counts[:, 9]
        return counts

    report = diagnose(Springs(), changed(copied), progress=False)
    assert "swap" not in [e.id for e in report.effects]


def heard(pairs):
    """A change of `changed`: shares of another electrode's change {(electrode, other): share}, from 0."""

    def change(counts, clock, rng):
        out = counts.copy()
        for (i, j), share in pairs.items():
            out[:, i] += share * (counts[:, j] - counts[0, j])
        return out

    return change


@pytest.mark.slow  # quick: the pairs by themselves
def test_leads_side_by_side_are_cross_talk_and_no_gains(tmp_path):
    """Two pairs, one louder than the other: neither a distance nor the order of sampling has it."""
    pairs = {(4, 3): 0.25, (3, 4): 0.12, (15, 14): 0.3}
    report = diagnose(Springs(), changed(heard(pairs), n=10), progress=False)
    assert [e.id for e in report.effects] == ["crosstalk"], report.verdict
    found = {name: p.value for name, p in report.effects[0].parameters.items()}
    assert found["e5_hears_e4"] == pytest.approx(0.25, abs=0.06)
    assert found["e16_hears_e15"] == pytest.approx(0.3, abs=0.06)
    report.apply(Springs()).save(tmp_path / "amended.yaml")
    ((effect, theta),) = load_simulator(tmp_path / "amended.yaml").effects
    assert (4, 3) in effect.hears.values() and theta["e5_hears_e4"] == pytest.approx(found["e5_hears_e4"])


@pytest.mark.slow
def test_an_oversensitive_electrode_is_a_gain_not_cross_talk():
    def louder(counts, clock, rng):
        counts[:, 4] += 0.4 * (counts[:, 4] - counts[0, 4])
        return counts

    report = diagnose(Springs(), changed(louder, n=10), progress=False)
    assert [e.id for e in report.effects] == ["gain"] and not report.effects[0].ties, report.verdict


def test_a_gain_that_gives_back_what_the_modulus_took_is_none():
    """A force that is cut off at 0.35 N asked for 0.58 times the modulus, and PDC for 1.7 times that."""
    effect = by_id("pdc_gain")
    assert effect.undoes({"gain": 0.703}, np.log(0.58))
    assert not effect.undoes({"gain": 0.703}, 0.0)
    assert not effect.undoes({"gain": 0.3}, np.log(0.58))
    assert not effect.undoes({"gain": -0.4}, np.log(0.58))


@pytest.mark.slow
def test_pressure_that_stays_while_force_relaxes_is_no_gain():
    class Late(type(by_id("relax"))):
        """The film creeps on and keeps the liquid's pressure up."""

        def apply(self, run, theta):
            pressure = run.pressure
            super().apply(run, theta)
            run.pressure = pressure

    theta = {"g": 0.3, "film": 0.0, "liquid": 0.0, "tau": 0.6}
    report = diagnose(Springs(), measured([(Late(), theta)]), progress=False)
    (found,) = report.effects
    assert {found.id, *found.ties} & {"relax", "creep"}, report.verdict
    value = {name: p.value for name, p in found.parameters.items()}
    assert value.get("g", value.get("n")) == pytest.approx(-value["liquid"], rel=0.3)
    alone = {"g": 0.01, "film": 0.0, "liquid": 0.4, "tau": 0.6}
    assert (
        by_id("relax").rejection_reason(alone)
        == by_id("creep").rejection_reason({**alone, "n": 0.01})
        == "liquid"
    )
    assert by_id("relax").rejection_reason(theta | {"liquid": -0.3}) is None


def test_what_stands_at_its_bound_hides_no_effect_like_it():
    """Electrodes 48 ms late look like those of a frame before, five times over."""
    late = by_id("latency")
    comparison, fit, chosen = fitted(measured([(late, {"delay": 48e-3})]))
    assert fit.nuisance.at_bound("age") and not fit.nuisance.at_bound("mesh")
    assert fit_effects(comparison, [(late, late.default())], chosen, fit).score > fit.score + 20


@pytest.mark.slow
def test_an_electrode_that_drifts_by_itself_is_named():
    """By a logarithm of time, which is no power of it."""

    def drifting(counts, clock, rng):
        counts[:, 4] += 60 * np.log1p(clock / 8) / np.log1p(100 / 8)
        return counts

    report = diagnose(Springs(), changed(drifting, n=10), progress=False)
    assert [e.id for e in report.effects] == ["electrode_drift"], report.verdict
    size = {name: p.value for name, p in report.effects[0].parameters.items()}
    assert 40 < size["e5"] < 80 and set(size) == {"e5", "q"}


@pytest.mark.slow
def test_a_sensor_with_own_rests_has_no_electrode_standing_off():
    other = np.random.default_rng(1).normal(0, 150, 19)
    report = diagnose(Springs(), changed(lambda c, clock, rng: c + other), progress=False)
    assert not report.effects and report.verdict == "no significant disagreement"


def test_trembling_poses_are_still_and_clean_after_the_touch():
    """As of a robot: a micrometre from row to row, and a log that is cut right before the touch."""
    rng, data = np.random.default_rng(3), []
    for t in measured([]):
        rows = np.r_[2 : len(t.time)]
        more = np.r_[rows, np.full(4, rows[-1])]  # the object waits beside the skin
        late = t.time[-1] + 0.05 * np.arange(1, 5)
        counts = np.rint(t.electrodes[more])
        counts[-4:] += 3 * rng.normal(size=(4, 19))
        pos = t.pos[more] + 1e-6 * rng.normal(size=(len(more), 3))
        part = {k: getattr(t, k)[more] for k in ("mat", "pdc", "force")}
        data.append(
            dataclasses.replace(t, time=np.r_[t.time[rows], late], pos=pos, electrodes=counts, **part)
        )
    noise = measurement_noise(data)["electrodes"]  # true: 3; what moves has steps of tens of counts
    assert 2 <= noise.min() and noise.max() < 5


def test_an_offset_is_what_poses_are_off_by_along_their_headings():
    data, effect = measured([]), by_id("depth0")
    sim = Springs()
    turns = Rotation.from_rotvec(np.outer(np.linspace(-0.9, 0.9, len(data)), [1, 0, 0])).as_matrix()
    tilted = [dataclasses.replace(t, mat=np.tile(turn, (len(t.time), 1, 1))) for t, turn in zip(data, turns)]
    hidden = (effect, {"dz": -2e-4})
    fields = sim.fields(tilted, progress=False)
    seen = [
        dataclasses.replace(t, electrodes=r.counts, pdc=r.pdc, force=r.force)
        for t, r in zip(tilted, sim.run(tilted, fields, False, [hidden]))
    ]
    wide = Comparison(sim, seen, fields, measurement_noise(seen), 3e-4)
    along = [pose @ t.heading for pose, t in zip(wide.poses([], Nuisance()), seen)]
    np.testing.assert_allclose(along, -2e-4, atol=0.6e-4)
    assert np.abs(wide.poses([hidden], Nuisance())).max() < 1e-5


def test_softening_by_work_stays_at_every_load():
    """Three equal presses: each is softer than the one before, from its first row on; the last ones at all
    loads by what is lost for good."""
    effect, session, peaks = by_id("damage"), {}, []
    for _ in range(60):
        run = run_of()
        run.session = session
        before = run.normal_force
        effect.apply(run, {"damage": 0.3, "work": 2e-3})
        peaks.append(run.normal_force.max() / before.max())
    assert 0.7 < peaks[2] < peaks[1] < peaks[0] < 1
    loaded = before > 0
    np.testing.assert_allclose(run.normal_force[loaded] / before[loaded], 0.7, atol=0.005)
    np.testing.assert_allclose(run.pressure, 0.7 * run_of().pressure, atol=0.005 * run_of().pressure.max())


@pytest.mark.parametrize("side", (1.0, -1.0))
def test_a_clamp_gives_way_to_the_side_it_is_pressed_to(side):
    """By torque over compliance, so that two sides tilt it two ways; the object goes less deep."""
    effect, run = by_id("rocking_torque"), run_of()
    run.heading = np.array([0.0, 0.0, side])
    run.force = -np.outer(800 * run.depth, run.heading)
    run.pos = np.tile([-0.01, 0.0, -0.007 * side], (len(run.time), 1))
    effect.apply(run, {**effect.default(), "yaw": 0.3, "behind": 8e-3})
    load = run.normal_force.max()
    tilt = 0.3 * 18e-3 * load
    at = int(np.argmax(run.normal_force))
    np.testing.assert_allclose(np.abs(run.turn[at]), [0, tilt, 0], atol=1e-12)
    assert (run.offset[at] @ run.heading) == pytest.approx(-18e-3 * tilt)
    # the fingertip turns as what presses it says: x toward the tip goes with the push
    fingertip = np.cross(-run.turn[at], [-18e-3, 0, 0])
    assert fingertip @ run.heading > 0


def test_the_force_is_given_in_the_frame_of_the_poses():
    """A sensor turned by 3 degrees is pressed from elsewhere; in the frame of the poses the object presses as
    it is seen to."""
    data, turn, exact = plans(2), by_id("misalign"), True
    theta = {**turn.default(), "roll": 0.05}
    for t, run in zip(data, Springs().run(data, None, exact, [(turn, theta)])):
        push = run.force[np.argmax(np.linalg.norm(run.force, axis=1))]
        assert np.linalg.norm(np.cross(push, t.heading)) < 4e-3 * np.linalg.norm(push)


def test_load_dependent_friction_is_interpolated_from_solutions():
    run, n = run_of(), 40
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, n, 23))
    run.answers = {"friction": first, "friction2": second}
    before, theta = run_of(), {"exponent": 0.4, "log_mu": -0.2}
    by_id("fric_load").apply(run, theta)
    log_mu = -0.2 - 0.4 * np.log(np.maximum(before.normal_force, 0.05))
    expected = before.pressure + log_mu * first[:, 3] + log_mu**2 * second[:, 3]
    np.testing.assert_allclose(run.pressure, expected)
    np.testing.assert_allclose(
        run.log_z[7], before.log_z[7] + log_mu[7] * first[7, 4:] + log_mu[7] ** 2 * second[7, 4:]
    )


def test_the_load_comes_back_by_less_than_it_went():
    """A loop as wide as twice the fraction of the peak, whatever the speed; the film has as much play."""
    effect, runs = by_id("hyster_load"), [run_of(), run_of()]
    runs[1].time = runs[1].time * 30
    before = runs[0].normal_force.copy()
    for run in runs:
        effect.apply(run, {"fraction": 0.1, "film": 0.05, "width": 0.2})
    np.testing.assert_allclose(runs[0].force, runs[1].force)
    up, down = (np.interp(0.5 * before.max(), x, y) for x, y in _branches(before, runs[0].normal_force))
    assert (up - down) / before.max() == pytest.approx(0.2, abs=0.01)
    change = run_of().log_z - run_of().log_z[0]
    assert np.abs(runs[0].log_z[0] + change - runs[0].log_z).max() == pytest.approx(
        0.05 * np.abs(change).max(), rel=0.01
    )


def _branches(x, y):
    top = int(np.argmax(x))
    return (x[:top], y[:top]), (x[:top:-1], y[:top:-1])


def test_under_pressure_at_rest_a_modulus_is_more_than_a_factor():
    """The liquid bears a part of the load, which softer rubber leaves as it is."""
    sim = Simulator(material="calibrated")
    material = plain(read_material("calibrated"))
    soft = Simulator(material=material | {"youngs_modulus": 0.7 * material["youngs_modulus"]})
    data = plans(2)
    base, true = sim.solve(data), soft.solve(data)
    fields = Fields(base, differences(softer(sim), data, base), data)
    for one, run, stiff in zip(true, sim.run(data, fields, False, modulus=0.7), base):
        peak = int(np.argmax(np.abs(one["force"][:, 1])))
        for value, said, before in zip(
            (one["force"][peak, 1], one["pressure"][peak]),
            (run.force[peak, 1], run.pressure[peak]),
            (stiff["force"][peak, 1], stiff["pressure"][peak]),
        ):
            assert value / before > 0.74 and said == pytest.approx(value, rel=0.02)
        change = np.abs(one["log_z"] - stiff["log_z"]).max()
        assert np.abs(run.log_z - one["log_z"]).max() < 0.2 * change
    alone = Simulator(material="calibrated", modulus=0.7).run(data)  # as an amended sensor's
    np.testing.assert_allclose(alone[0].force, sim.run(data, fields, False, modulus=0.7)[0].force)
    assert softer(Simulator(material="default")) == []


def test_spots_are_where_trajectories_touch_again():
    places = [(-8.0, 0.0)] * 3 + [(-8.5, 0.5)] * 2 + [(-16.0, 3.0)] * 2 + [(-2.0, -4.0)]
    data = [
        dataclasses.replace(t, pos=t.pos - t.pos[0] + 1e-3 * np.array([x, -6.0, z]))
        for t, (x, z) in zip(plans(8), places)
    ]
    names = spots(data)
    assert len(names) == 2 and names[1].startswith("at_-16.0_") and names[1].endswith("_3.0")
    at = np.array([[float(v) * 1e-3 for v in names[0].split("_")[1:]], [0.0, 0.0, 0.02]])
    np.testing.assert_allclose(modulus_of({names[0]: 0.5})(at), [np.exp(0.5), 1.0], atol=1e-6)
    effect = by_id("spots").given([*names, "x", "bubble"])
    assert list(effect.params) == names and by_id("spots").given([]).applicable(data)


def test_an_amended_sensor_has_its_spots_wherever_it_touches():
    name = "at_-9.0_-6.5_0.0"
    sim = Springs(effects=[(by_id("spots").given([name]), {name: 0.5})])
    assert name not in spots(plans(1)) and name in sim.fields(plans(1), progress=False).slopes


class Elsewhere(Springs):
    """Springs of other electrodes, which rest some 150 counts apart (synthetic)."""

    apart = np.random.default_rng(3).normal(0, 0.2, 19)

    def solve(self, *args, **kw):
        return [one | {"log_z": one["log_z"] + self.apart} for one in super().solve(*args, **kw)]


def test_electrodes_answer_by_where_they_rest():
    """An electrode that rests elsewhere shows more or less of the same touch, which is no gain."""
    sim, data = Springs(), measured([], of=Elsewhere(), n=8)
    own, fields = rested(sim, sim.fields(data, False), data)
    np.testing.assert_allclose(own.log_rest, Elsewhere.apart, atol=0.01)
    noise, chosen = measurement_noise(data), np.arange(8)
    told = fit_effects(Comparison(own, data, fields, noise), [], chosen)
    assert abs(told.nuisance.stands_off) < 0.2
    square = told.mean_square(Comparison(own, data, fields, noise))
    assert square.max() < 1.3
    plain = Comparison(sim, data, sim.fields(data, False), noise)
    assert fit_effects(plain, [], chosen).mean_square(plain).mean() > 2 * square.mean()
    report = diagnose(sim, data, effects=[by_id("gain"), by_id("relax")], progress=False)
    assert not report.effects and report.verdict == "no significant disagreement"
    rest = report.apply(Simulator()).sensor["rest"]
    mean = np.mean([t.electrodes[0] for t in data], axis=0)
    z = np.exp(np.linspace(-0.9, -0.3, 19))  # where springs rest
    np.testing.assert_allclose(
        log_impedance(np.array(rest)) - log_impedance(SENSORS["1"].rest),
        (1 - report.fit.nuisance.stands_off) * (log_impedance(mean) - np.log(z)),
        atol=1e-3,
    )
