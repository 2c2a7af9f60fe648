"""The synthetic measured sensor: conduction in three dimensions, drift, relaxation, noise, and that the
simulator leaves it alone."""

import dataclasses
import pathlib

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import biotac_mj
from biotac_mj.data.generation.liquid_conduction import LiquidConduction
from biotac_mj.data.generation.synthetic_sensor import Meter, SensorVariation, SyntheticSensor, Waves, relax
from biotac_mj.geometry import load_skin
from biotac_mj.geometry.making.pads import column_tetrahedra
from biotac_mj.sensor.channels import counts_from_impedance, impedance_from_counts
from biotac_mj.sensor.film import EXCITATION, FilmConduction

TET_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


@pytest.fixture(scope="module")
def skin():
    return load_skin("coarse")


@pytest.fixture(scope="module")
def liquid(skin):
    return LiquidConduction(skin, EXCITATION)


@pytest.fixture(scope="module")
def meter(skin):
    drawn = SensorVariation.draw(0)
    warming = dataclasses.replace(drawn.sensor, warm_up=5.0)
    return Meter(dataclasses.replace(drawn, sensor=warming), skin, skin.vert, 0)


def dent(skin, depth, x=-9.5e-3, width=2.5e-3):
    """The skin with a bell-shaped dent in the pad, which no finite elements made."""
    weight = np.exp(-(((skin.vert[:, 0] - x) ** 2 + skin.vert[:, 2] ** 2) / width**2)) * (skin.vert[:, 1] < 0)
    return skin.vert + depth * weight[:, None] * [0, 1, 0]


def test_columns_fill_prisms_conformingly():
    rng = np.random.default_rng(0)
    n = 5
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    cell = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangle = np.concatenate(
        [np.stack([cell, cell + n, cell + 1], 1), np.stack([cell + n, cell + n + 1, cell + 1], 1)]
    )
    triangle = np.array([np.roll(row, k) for row, k in zip(triangle, rng.integers(0, 3, len(triangle)))])
    new = rng.permutation(n * n)  # numbers in no order
    point = np.empty((n * n, 3))
    point[new] = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    elem = column_tetrahedra(new[triangle], n * n, 2)
    node = np.concatenate([point + [0, 0, h] for h in (0.0, 1.0, 3.0)])
    volume = np.linalg.det(node[elem][:, 1:] - node[elem][:, :1]) / 6
    assert (volume > 0).all() and abs(volume.sum() - 16 * 3) < 1e-12
    # conforming: every inner face belongs to two tetrahedra, so the boundary has the area of the block
    face = np.sort(elem[:, TET_FACES].reshape(-1, 3), axis=1)
    face, count = np.unique(face, axis=0, return_counts=True)
    corner = node[face[count == 1]]
    area = (
        np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() / 2
    )
    assert count.max() == 2 and abs(area - (2 * 16 + 4 * 4 * 3)) < 1e-9


def test_the_liquid_is_all_there(liquid, skin):
    nodes = liquid.nodes(liquid.gap(skin.vert))
    corner = nodes[liquid.elem]
    volume = np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6
    assert (volume > 0).all()
    assert 330e-9 < volume.sum() < 369e-9  # of 369 mm3; thinner than 0.1 mm is left out


def test_linear_potentials_are_exact(liquid, skin):
    # a field of constant gradient has no sources inside and the energy of its square over the liquid
    nodes = liquid.nodes(liquid.gap(dent(skin, 0.8e-3)))
    matrix = liquid.matrix(nodes)
    slope = np.array([30.0, -10.0, 20.0])
    current = matrix @ (nodes @ slope)
    corner = nodes[liquid.elem]
    volume = np.abs(np.linalg.det(corner[:, 1:] - corner[:, :1]).sum() / 6)
    assert abs((nodes @ slope) @ current - slope @ slope * volume) < 1e-9 * slope @ slope * volume
    face, count = np.unique(
        np.sort(liquid.elem[:, TET_FACES].reshape(-1, 3), axis=1), axis=0, return_counts=True
    )
    inside = np.setdiff1d(np.arange(len(nodes)), face[count == 1])
    assert len(inside) > 2000
    assert np.abs(current[inside]).max() < 1e-9 * np.abs(current).max()


def test_it_agrees_with_the_film_as_an_independent_model_should(liquid, skin):
    film = FilmConduction(
        skin, sensor=None, conductivity=liquid.conductivity, residual_film=liquid.residual_film
    )
    ratio = liquid.impedance(skin.vert) / film.impedance(skin.vert)
    assert 0.7 < ratio.min() and ratio.max() < 1.2 and ratio.std() > 0.01  # other electrodes, other equations
    for depth in (0.5e-3, 1.2e-3):
        x = dent(skin, depth)
        change = np.log(liquid.impedance(x) / liquid.impedance(skin.vert))
        other = np.log(film.impedance(x) / film.impedance(skin.vert))
        far = np.arange(19) != 16
        assert change.argmax() == 16 and np.corrcoef(change[far], other[far])[0, 1] > 0.99
        assert (
            0.9 < (change[far] / other[far]).max() < 1.4
        )  # beside the dent: the current's way is narrowed alike
        assert (
            1.2 < change[16] / other[16] < 3.0
        )  # under it the film is as thick as the electrode is wide: there the models part


def test_finer_columns_change_little(skin, monkeypatch, liquid):
    from biotac_mj.data.generation import liquid_conduction

    monkeypatch.setattr(liquid_conduction, "_LAYERS", (0.0, 0.08, 0.18, 0.3, 0.5, 0.75, 1.0))
    fine = LiquidConduction(skin, EXCITATION).impedance(skin.vert)
    np.testing.assert_allclose(liquid.impedance(skin.vert), fine, rtol=0.06)


def test_impedance_goes_with_resistivity(skin, liquid):
    half = LiquidConduction(skin, EXCITATION, conductivity=liquid.conductivity / 2)
    np.testing.assert_allclose(half.impedance(skin.vert), 2 * liquid.impedance(skin.vert), rtol=1e-10)


def test_skin_on_the_core_keeps_a_film(liquid, skin):
    z = liquid.impedance(dent(skin, 2.5e-3))  # deep into the core
    assert np.isfinite(z).all() and z[16:18].max() > 2 * liquid.impedance(skin.vert)[16:18].max()


def test_relaxation_is_that_of_its_equation():
    # y = s + sum a (s - l), l' = (s - l) / tau, integrated numerically
    time = np.linspace(0, 3, 61)
    signal = np.interp(time, [0, 0.5, 1.5, 1.6, 3], [0, 1, 1, 0, 0])
    share, tau = np.array([0.3, 0.1]), np.array([0.5, 4.0])
    answer = solve_ivp(
        lambda t, low: (np.interp(t, time, signal) - low) / tau,
        (0, 3),
        [0.0, 0.0],
        t_eval=time,
        max_step=1e-3,
        rtol=1e-8,
    )
    expected = signal + (share[:, None] * (signal - answer.y)).sum(0)
    np.testing.assert_allclose(relax(time, signal, share, tau), expected, atol=1e-5)
    both = relax(time, np.stack([signal, 2 * signal], 1), share, tau)
    np.testing.assert_allclose(both[:, 1], 2 * expected, atol=2e-5)
    assert expected[-1] < -0.01 and expected[10] > 1.1  # undershoots after release, overshoots at the top


def test_drift_is_one_gain_for_all_electrodes(meter, skin):
    time = 0.05 * np.arange(8)
    still = np.repeat(skin.vert[None], 8, 0)
    start = np.array([0.0, 60.0, 300.0, 2000.0])
    log_z = np.array(
        [
            np.log(impedance_from_counts(meter.measure(still, time, np.zeros(8), s, seed=1)[0][0, :19]))
            for s in start
        ]
    )
    change = log_z - log_z[0]
    each = change - change.mean(1, keepdims=True)
    assert np.abs(each).max() < 0.004  # noise of a mean of 50 frames
    v = meter.variation
    temperature = meter.temperature(start)
    np.testing.assert_allclose(change.mean(1), -0.071 * (temperature - temperature[0]), atol=0.003)
    # what the warm-up alone does
    assert abs(temperature[-1] - temperature[0] - 5.0) < 4 * v.ambient


def test_noise_is_that_of_a_real_sensor(meter, skin):
    time = 0.011 * np.arange(400)
    still = np.repeat(skin.vert[None], 400, 0)
    counts, pac = meter.measure(still, time, np.zeros(400), 5000.0, seed=7)
    assert pac.shape == (400, 22) and (pac[1:, -1] == counts[1:, 20]).all()
    counts = counts[1:, :19]
    spread = np.diff(counts, axis=0).std(0) / np.sqrt(2)  # differences: slow drift leaves them alone
    expected = np.hypot(meter.variation.sensor.electrode_noise(counts.mean(0)), 0.29)  # and rounding
    np.testing.assert_allclose(spread, expected, rtol=0.25)
    assert (counts == np.rint(counts)).all()


def test_sensors_differ_as_measured_ones_do():
    drawn = [SensorVariation.draw(k) for k in range(40)]
    modulus = np.array([v.youngs_modulus for v in drawn])
    fill = np.array([v.rest_pressure for v in drawn]) / modulus
    assert 0.47e6 < modulus.min() < 0.6e6 and 1.2e6 < modulus.max() < 1.36e6
    assert fill.min() < 0.002 and 0.017 < fill.max() < 0.0194
    gain = np.array([np.diag(v.mixing) for v in drawn])
    assert 0.2 < np.log(gain[np.isfinite(np.log(gain))]).std() < 0.4
    film = np.array([v.film for v in drawn])
    assert 20e-6 < film.min() < 30e-6 and 70e-6 < film.max() < 100e-6
    assert SensorVariation.draw(3).youngs_modulus == modulus[3] != modulus[4]


def test_a_relief_is_smooth_and_of_its_size():
    waves = Waves((1, 2), 0.2e-3, 2e-3)
    at = np.random.default_rng(0).uniform(-1, 1, (20000, 3)) * 20e-3
    value = waves(at)
    assert abs(value.mean()) < 0.02e-3 and abs(value.std() - 0.2e-3) < 0.03e-3
    far = value[:, None] * np.stack([waves(at + [d, 0, 0]) for d in (0.2e-3, 2e-3, 8e-3)], 1)
    near, one, beyond = far.mean(0) / value.var()
    assert near > 0.98 and abs(one - np.exp(-0.5)) < 0.15 and abs(beyond) < 0.35


def test_the_relief_thickens_the_liquid_and_changes_are_mixed(skin):
    plain = LiquidConduction(skin, EXCITATION)
    raised = LiquidConduction(skin, EXCITATION, relief=lambda at: np.full(len(at), 0.2e-3))
    gap = plain.gap(skin.vert)
    n = len(gap)
    thick = [np.linalg.norm(one.nodes(gap)[-n:] - one.core_point, axis=1) for one in (plain, raised)]
    np.testing.assert_allclose(thick[1], np.maximum(gap + 0.2e-3, raised.residual_film), atol=1e-9)
    assert (raised.impedance(skin.vert) < plain.impedance(skin.vert)).all()


def test_rest_reads_the_rest_counts(meter, skin):
    got = counts_from_impedance(meter.impedance(skin.vert[None])[0])
    np.testing.assert_allclose(got, meter.variation.sensor.rest, rtol=1e-9)


def test_simulator_does_not_use_it():
    package = pathlib.Path(biotac_mj.__file__).parent
    users = [
        p.relative_to(package).as_posix()
        for p in package.rglob("*.py")
        if "synthetic_sensor" in p.read_text() or "liquid_conduction" in p.read_text()
    ]
    assert {u.split("/")[0] for u in users} <= {"data"}


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        ValueError, match=r"needs scikit-fem: pip install 'biotac-mj\[data\]', or take --labelled 0"
    ):
        SyntheticSensor(0, "coarse")


def test_an_electrode_without_liquid_is_named(skin):
    with pytest.raises(ValueError, match="no liquid over X1"):
        LiquidConduction(skin, [(-8e-3, np.pi), *EXCITATION[1:]])  # under the nail, where the skin is bonded
