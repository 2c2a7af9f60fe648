"""Sensors that differ: presets, draws from their spread, effects that a running sensor has."""

import dataclasses
import json

import numpy as np
import pytest
import warp as wp

from biotac_mj.coupling.config import Config
from biotac_mj.effects.catalogue import by_id
from biotac_mj.effects.effect import Run
from biotac_mj.effects.sensing import DeadTaxels
from biotac_mj.effects.sensors import RANDOM, draw_effects, read_randomise, take_sensor, with_effects
from biotac_mj.geometry.design import designs
from biotac_mj.sensor.acquisition import Acquisition, BatchAcquisition
from biotac_mj.sensor.channels import (
    PDC_REST,
    REST_COUNTS,
    counts_from_impedance,
    impedance_from_counts,
    pressure_from_counts,
)
from biotac_mj.sensor.presets import MEASURED, NAMES, PER_DEGREE, SENSORS, Sensor, read_sensor

FILM = impedance_from_counts(REST_COUNTS["1"])  # what a film gives at rest
DT, FRAME = 5e-3, 0.01


def run(sensor, n=60, impedance=None, pressure=None, noise=False, seed=0):
    """Rows of counts (n,) of a sensor: electrodes (n, 19), pdc, pac (n, 22), tac, tdc; arrays are rows'."""
    acquisition = Acquisition(seed=seed, noise=noise, sensor=sensor, film_rest=FILM, film_every_step=True)
    state = np.zeros(acquisition.nstate)
    acquisition.reset(state, FILM)
    rows = []
    for i in range(n):
        z = FILM if impedance is None else impedance[i]
        acquisition.advance(state, i * FRAME, FRAME, z, 0.0 if pressure is None else pressure[i])
        rows.append(acquisition.readings(state))
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


@pytest.mark.parametrize("name", SENSORS)
def test_a_preset_rests_where_it_was_measured_with_its_noise(name):
    sensor = dataclasses.replace(SENSORS[name], warm_up=0.0)
    rows = run(sensor, 600, noise=True)
    for channel in ("pdc", "tdc", "tac", "pac"):
        rest, noise = getattr(sensor, f"{channel}_rest"), getattr(sensor, f"{channel}_noise")
        deviation = noise if channel != "pac" else noise / np.sqrt(1 - sensor.pac_colour**2)
        assert rows[channel].mean() == pytest.approx(rest, abs=0.5 + 0.1 * deviation), channel
        assert rows[channel].std() <= 1.2 * np.sqrt(deviation**2 + 0.25) + 0.02, channel
    np.testing.assert_allclose(rows["electrodes"].mean(0), sensor.rest, atol=1.5)
    if sensor.noise is not None:
        expected = np.sqrt(np.square(sensor.noise) + 1 / 12)
        np.testing.assert_allclose(
            rows["electrodes"].std(0), expected, rtol=0.15, atol=0.12
        )  # rounding of small noise


def test_warm_up_moves_all_electrodes_and_tdc():
    sensor = Sensor(warm_up=3.0, warm_time=0.2)
    rows = run(sensor, 400)
    expected = counts_from_impedance(sensor.impedance * np.exp(-3.0 * PER_DEGREE))
    np.testing.assert_allclose(rows["electrodes"][-1], expected, atol=0.51)
    assert rows["tdc"][-1] > rows["tdc"][0] + 20


def test_random_sensors_differ_as_the_measured_do():
    rng_sensors = [read_sensor("random", seed) for seed in range(200)]
    assert read_sensor("random", 7) == rng_sensors[7] != rng_sensors[8]
    for field in ("pdc_rest", "tdc_rest", "pac_noise", "tac_noise"):
        measured = [m[field] for m in MEASURED.values() if field in m]
        drawn = [getattr(s, field) for s in rng_sensors]
        assert min(measured) <= min(drawn) < max(drawn) <= max(measured)
        assert np.ptp(drawn) > 0.8 * np.ptp(measured)
    rest = np.array([s.rest for s in rng_sensors])
    patterns = np.array([SENSORS[n].rest for n in SENSORS if n not in ("btd_sp", "1")])
    assert 0.5 < (rest.std(0) / patterns.std(0, ddof=1)).mean() < 1.5
    gains = np.array([np.diag(s.mixing) for s in rng_sensors])
    assert gains.std() == pytest.approx(0.1, rel=0.1)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="sensor is 'f9': pass one of '1', .*'epfl_f1'"):
        read_sensor("f9")
    with pytest.raises(ValueError, match=r"sensor has 'colour': did you mean 'pac_colour'\? choose from"):
        read_sensor({"colour": 1})
    with pytest.raises(ValueError, match="rest of a sensor has 2 electrodes, and the skin is of BioTac"):
        read_sensor({"rest": [1, 2]})
    for wrong, said in (
        ({"pdc_noise": -1.0}, "pdc_noise of a sensor is -1.0: give 0 or more"),
        ({"noise": [-1.0] * 19}, "noise of a sensor is .*: give 0 or more each"),
        ({"latency": 0.2}, "latency of a sensor is 0.2: give 0 or more, at most 0.11"),
        ({"warm_time": 0}, "warm_time of a sensor is 0.0: give more than 0"),
        ({"power": -1}, "power of a sensor is -1.0: give more than 0"),
        ({"pac_colour": 1}, "pac_colour of a sensor is 1.0: give 0 or more, less than 1"),
        ({"per_degree": 0}, "per_degree of a sensor is 0.0: give another number than 0"),
        ({"relaxation": [2, 1]}, "relaxation of a sensor is .2.0, 1.0.: give a fraction from 0 to 1 and a"),
        ({"saturation": [0, 0]}, "saturation of a sensor is .0.0, 0.0.: give a fraction from 0 to 1 and a"),
        ({"loss": 10**400}, "loss of a sensor is 1000.*000: give a number, finite"),
    ):
        with pytest.raises(ValueError, match=said):
            read_sensor(wrong)
    with pytest.raises(ValueError, match="cannot randomise 'gremlins': choose from gain, dead"):
        read_randomise(["gremlins"])
    assert read_sensor({"like": "phac_f0", "pdc_rest": 900}).pdc_rest == 900
    assert set(NAMES) == {*SENSORS, "random"}


def rows_of_effect(effect, theta, impedance, pressure):
    """What `Effect.apply` makes of a trajectory: counts (n, 19) and pdc (n,), as `diagnose` does it."""
    n = len(impedance)
    time = FRAME * (1 + np.arange(n))
    log_z, rest = np.log(impedance), np.log(FILM)
    r = Run(
        time, time, "sphere", np.array([0, 1.0, 0]), np.zeros(n), np.zeros(3), 0, np.zeros((n, 3)),
        np.zeros((n, 3)), np.array(pressure, float), log_z, None, {}, rest_log_z=rest,
    )  # fmt: skip
    if effect.stage == "A":
        r.counts, r.pdc = counts_from_impedance(np.exp(r.log_z)), PDC_REST + r.pressure / 36.5
        effect.apply(r, theta)
        return r.counts, r.pdc
    effect.apply(r, theta)
    return counts_from_impedance(np.exp(r.log_z)), PDC_REST + r.pressure / 36.5


THETA = {
    "gain": {f"e{k + 1}": 0.3 * np.sin(k) for k in range(19)},
    "dead": {f"e{k + 1}": float(k in (3, 11)) for k in range(19)},
    "crosstalk": {"kappa": 0.15, "length": 3.0, "scan": 0.1, "common": -0.1},
    "pdc_gain": {"gain": 0.4},
    "relax": {"g": 0.3, "tau": 0.4},
    "warmup": {"a": -0.2, "tau": 0.5},
    "fluidloss": {"rate": 500.0},
    "drift": {"rate": 30.0},
}


@pytest.mark.parametrize("name", RANDOM)
def test_a_running_sensor_has_an_effect_as_diagnose_does(name):
    """`Effect.apply` on a whole trajectory against the acquisition, frame by frame."""
    n, k = 80, np.arange(19)
    push = np.clip(np.arange(n) / 40, 0, 1)[:, None]
    impedance = FILM * np.exp(push * 0.6 * np.sin(k))
    pressure = 5e3 * push[:, 0]
    sensor = with_effects(Sensor(), [(RANDOM[name], THETA[name])])
    mine = run(sensor, n, impedance, pressure)
    counts, pdc = rows_of_effect(RANDOM[name], THETA[name], impedance, pressure)
    plain = run(Sensor(), n, impedance, pressure)
    # a slot lies up to a frame before the row's time: what that is worth is what it is without the effect
    slack = 1.5 + np.abs(np.diff(counts, axis=0)).max(0)
    assert (np.abs(mine["electrodes"] - counts)[1:] <= slack).all()
    assert (np.abs(mine["pdc"] - pdc)[1:] <= 1.5 + np.abs(np.diff(pdc)).max()).all()
    change = max(np.abs(mine[c] - plain[c]).max() for c in ("electrodes", "pdc"))
    assert change > 15  # it does something
    settled = np.abs(mine["electrodes"] - counts)[-5:].max()
    assert settled <= 1.5 or name in ("warmup", "fluidloss", "drift")


def test_pdc_undershoots_after_release_and_comes_back():
    sensor = with_effects(Sensor(), [(by_id("relax"), {"g": 0.2, "tau": 1.0})])
    pressure = np.where(np.arange(600) < 300, 10e3, 0.0)
    pdc = pressure_from_counts(run(sensor, 600, pressure=pressure)["pdc"])
    assert pdc[302] < -1e3 and abs(pdc[-1]) < 0.1 * abs(pdc[302])


def test_dead_taxels_are_drawn_one_by_one():
    drawn = [DeadTaxels().draw(np.random.default_rng(i), 5.0) for i in range(300)]
    share = np.mean([list(theta.values()) for theta in drawn])
    assert share == pytest.approx(0.1, abs=0.02)


def test_draws_stay_within_the_bounds_and_follow_the_seed():
    for seed in range(50):
        for effect, theta in draw_effects(dict.fromkeys(RANDOM, 3.0), np.random.default_rng(seed)):
            for name, p in effect.params.items():
                assert p.low <= theta[name] <= p.high, (effect.id, name)
    a, b, c = (take_sensor({"randomise": ["gain", "relax"]}, seed)[0] for seed in (1, 1, 2))
    assert a == b != c


def test_resets_of_a_batch_draw_again():
    sensors = [read_sensor("random", i) for i in range(64)]
    batch = BatchAcquisition(FILM, 3, seed=5, noise=False, sensor=sensors, redraw=True)
    again = BatchAcquisition(FILM, 3, seed=5, noise=False, sensor=sensors, redraw=True)
    mask = wp.array([True, False, True], dtype=bool)
    seen = [batch.state.numpy().copy()]
    for _ in range(6):  # the first is the beginning
        batch.reset(mask)
        again.reset(mask)
        seen.append(batch.state.numpy().copy())
        np.testing.assert_array_equal(batch.state.numpy(), again.state.numpy())
    seen = np.array(seen)
    assert len(np.unique(seen[:, 0], axis=0)) > 3 and len(np.unique(seen[:, 1], axis=0)) == 1
    assert (seen[0, 0] != seen[0, 2]).any()
    with pytest.raises(ValueError, match="64 sensors for 3 worlds"):
        BatchAcquisition(FILM, 3, sensor=sensors)


def test_worlds_of_a_batch_are_single_sensors():
    sensors = [read_sensor("random", 3), SENSORS["phac_f1"], take_sensor({"randomise": list(RANDOM)}, 4)[0]]
    batch = BatchAcquisition(FILM, 3, seed=2, sensor=sensors, film_every_step=True)
    states, rng = np.zeros((3, batch.state.shape[1])), np.random.default_rng(0)
    ones = [Acquisition(2 + w, sensor=s, film_rest=FILM, film_every_step=True) for w, s in enumerate(sensors)]
    for one, state in zip(ones, states, strict=True):
        one.reset(state, FILM)
    np.testing.assert_allclose(batch.state.numpy(), states, rtol=1e-9)
    for i in range(20):
        z, p = FILM * rng.uniform(0.5, 2, (3, 19)), rng.normal(0, 3e3, 3)
        batch.find_due(DT)
        as_wp = wp.array(z, dtype=wp.float64, ndim=2)
        batch.advance(DT, as_wp, wp.ones(3, dtype=int), wp.array(p, dtype=wp.float64))
        for w, one in enumerate(ones):
            wanted = one.needs_impedance(states[w], i * DT, DT)
            one.advance(states[w], i * DT, DT, z[w] if wanted else None, p[w])
        np.testing.assert_allclose(batch.state.numpy(), states, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "field", [{"rest": None}, {"mixing": 5}, {"pdc_rest": True}, {"pdc_gain": 1e300}, {"relaxation": [2, 1]},
              {"relaxation": [-1, 1]}, {"noise": [-1] * 19}],
)  # fmt: skip
def test_a_number_that_cannot_be_is_named(field):
    with pytest.raises(ValueError, match=next(iter(field))):
        read_sensor(field)


def test_numbers_of_numpy_are_numbers():
    sensor = {"pdc_rest": np.float32(900), "rest": np.full(19, 2000)}
    options = json.loads(Config(options={"readings": {"sensor": sensor}}).strings()["options"])
    assert read_sensor(options["readings"]["sensor"]).pdc_rest == 900
    with pytest.raises(ValueError, match="holds <object"):
        Config(options={"readings": {"sensor": object()}}).strings()


@pytest.mark.parametrize("design", designs(), ids=lambda design: design.name)
def test_a_sensor_written_as_its_fields_is_read_again(design):
    sensor = read_sensor(None, design=design)
    assert sensor.mixing == () and read_sensor(dataclasses.asdict(sensor), design=design) == sensor
