"""Film and acquisition of many worlds against the single sensor's."""

import numpy as np
import pytest
import warp as wp

from biotac_mj.geometry import load_skin
from biotac_mj.sensor import channels
from biotac_mj.sensor.acquisition import Acquisition, BatchAcquisition
from biotac_mj.sensor.acquisition_kernels import NSTATE, SAMPLED, SAMPLED_PDC
from biotac_mj.sensor.film import BatchFilm, FilmConduction
from biotac_mj.sensor.film.systems import edges

DT = 2e-3


@pytest.fixture(scope="module")
def film():
    return FilmConduction(load_skin("coarse"))


def dented(film, count, seed=0):
    """(count, nvert, 3) skins pushed towards the core at random places, some onto it: synthetic."""
    rng, vert = np.random.default_rng(seed), film.geometry.vert
    foot = film.core.closest(vert)[1]
    out = []
    for _ in range(count):
        center = np.array([rng.uniform(-16e-3, -2e-3), -6e-3, rng.uniform(-4e-3, 4e-3)])
        share = rng.uniform(0.6, 1.1) * np.exp(-((np.linalg.norm(vert - center, axis=1) / 4e-3) ** 2))
        out.append(vert + share[:, None] * (foot - vert) + 2e-5 * rng.normal(size=vert.shape))
    return np.stack(out)


def as_warp(x):
    return wp.array(np.ascontiguousarray(np.swapaxes(x, 0, 1)), dtype=wp.vec3d, ndim=2)


def test_worlds_are_those_of_the_single_sensor(film):
    x = dented(film, 5)
    batch = BatchFilm(film, 5)
    batch.solve_film(as_warp(x), wp.ones(5, dtype=int))
    expected = film.impedance(x)
    change = channels.counts_from_impedance(expected) - channels.counts_from_impedance(film.rest)
    assert np.abs(change).max() > 50  # something happened
    np.testing.assert_array_equal(batch.impedance.numpy(), expected)
    assert batch.valid.numpy().all()


def test_film_at_rest_before_the_first_solve(film):
    np.testing.assert_allclose(BatchFilm(film, 2).impedance.numpy()[1], film.impedance(film.geometry.vert))


@pytest.mark.parametrize("band", [True, False])
def test_the_elimination_is_that_of_a_dense_system(film, band):
    """Resistances W' A^-1 W of the discs, from the same faces and weights, twice."""
    batch, due = BatchFilm(film, 2, band=band), wp.ones(2, dtype=int)
    disc = batch._pattern.disc.numpy()
    n, nface, (which, over) = len(film.node), len(film.face), film._pair
    i, j = edges(film.face)
    for seed in range(2):
        batch.solve_film(as_warp(dented(film, 2, seed)), due)
        for given, system in zip(batch._given.numpy().T, batch._system.numpy()):
            A, W = np.zeros((n, n)), np.zeros((n, len(film._pos)))
            for row, column, sign in ((i, j, -1), (j, i, -1), (i, i, 1), (j, j, 1)):
                np.add.at(A, (row, column), sign * given[: 3 * nface])
            A[0, 0] *= 2
            np.add.at(W, (film.face[over], which[:, None]), given[3 * nface :].reshape(-1, 3))
            np.testing.assert_allclose(W.sum(0), 1)
            np.testing.assert_allclose(-system[disc], W.T @ np.linalg.solve(A, W), rtol=1e-10)


def test_the_band_and_the_sparse_factor_are_the_same_film(film):
    x, due = dented(film, 4), wp.ones(4, dtype=int)
    folded = x[2]
    folded[film.node] = folded[film.node[::-1]]  # no film: what each finds must be said by both
    band, sparse = BatchFilm(film, 4, band=True), BatchFilm(film, 4, band=False)
    for batch in (band, sparse):
        batch.solve_film(as_warp(x), due)
        assert batch.valid.numpy().tolist() == [1, 1, 0, 1]
    assert np.abs(sparse.impedance.numpy()[0] / film.rest - 1).max() > 0.03
    np.testing.assert_allclose(sparse.impedance.numpy(), band.impedance.numpy(), rtol=1e-11)


@pytest.mark.parametrize("largest", [0.0, 1e-5, 1e-4, 1e-3, 5e-3])
def test_the_nearest_triangle_is_found_after_any_motion(film, largest):
    rng, x = np.random.default_rng(3), film.geometry.vert.copy()
    x += rng.uniform(0, largest, len(x))[:, None] * rng.normal(size=x.shape) / np.sqrt(3)
    middle, thickness = film.film(x)
    distance, foot, _ = film.core.closest(x[film.node])
    outside = distance > film.residual_film
    assert outside.sum() > 500
    np.testing.assert_allclose(thickness, np.maximum(distance, film.residual_film), atol=1e-11)
    np.testing.assert_allclose(
        middle[outside], 0.5 * (x[film.node] + foot)[outside], atol=2e-8
    )  # the foot may be either of two that are as far


def test_only_worlds_that_are_due_are_solved(film):
    x = dented(film, 3)
    batch = BatchFilm(film, 3)
    batch.solve_film(as_warp(x), wp.array([0, 1, 0], dtype=int))
    z = batch.impedance.numpy()
    np.testing.assert_array_equal(z[0], z[2])
    np.testing.assert_allclose(z[0], batch.rest)
    assert np.abs(z[1] / z[0] - 1).max() > 0.03


def test_a_failing_film_keeps_its_impedance_and_no_other(film):
    x = dented(film, 4)
    good, bad = BatchFilm(film, 4), BatchFilm(film, 4)
    due = wp.ones(4, dtype=int)
    for batch in (good, bad):
        batch.solve_film(as_warp(x), due)
    moved = dented(film, 4, seed=1)
    good.solve_film(as_warp(moved), due)
    moved[1, film.node[7]] = np.nan
    moved[2, film.node] += [0, -6e-3, 0]  # off the electrodes
    bad.solve_film(as_warp(moved), due)
    assert bad.valid.numpy().tolist() == [1, 0, 0, 1] and good.valid.numpy().all()
    now = bad.impedance.numpy()
    np.testing.assert_array_equal(now[[0, 3]], good.impedance.numpy()[[0, 3]])
    np.testing.assert_allclose(now[[1, 2]], film.impedance(x[[1, 2]]), rtol=1e-4)


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("dt", [2e-4, 2e-3, 15e-3])
@pytest.mark.parametrize("every_step", [False, True])
def test_acquisition_is_that_of_the_single_sensor(film, noise, dt, every_step):
    nworld, rng = 3, np.random.default_rng(0)
    rest = film.impedance(film.geometry.vert)
    batch = BatchAcquisition(rest, nworld, seed=2**63, noise=noise, film_every_step=every_step)
    singles = [Acquisition(seed=2**63 + w, noise=noise, film_every_step=every_step) for w in range(nworld)]
    states = np.zeros((nworld, NSTATE))
    for single, state in zip(singles, states):
        single.reset(state, rest)
    valid, time, asked = wp.ones(nworld, dtype=int), 0.0, 0
    for step in range(60):
        z = rest * rng.uniform(0.5, 2, (nworld, 19))
        pressure = 3000 * np.sin(50 * time + np.arange(nworld)) + rng.normal(size=nworld)
        warm = 31 + 0.05 * np.sin(3 * time + np.arange(nworld))
        needs = [single.needs_impedance(state, time, dt) for single, state in zip(singles, states)]
        asked += needs[0]
        assert batch.find_due(dt).numpy().tolist() == needs
        for w, single in enumerate(singles):
            single.advance(states[w], time, dt, z[w] if needs[w] else None, pressure[w], warm[w])
        wp.copy(batch.temperature, wp.array(warm, dtype=wp.float64))
        batch.advance(dt, wp.array(z, dtype=wp.float64, ndim=2), valid, wp.array(pressure, dtype=wp.float64))
        time += dt
        np.testing.assert_allclose(batch.state.numpy(), states, rtol=1e-9, atol=1e-9, err_msg=f"step {step}")
    assert 0 < asked < 61
    np.testing.assert_allclose(batch.time.numpy(), time)


def test_an_impedance_that_is_not_valid_is_held(film):
    rest = film.impedance(film.geometry.vert)
    batch = BatchAcquisition(rest, 2, noise=False, film_every_step=True)
    nothing = wp.zeros(2, dtype=wp.float64)
    for _ in range(6):
        batch.find_due(DT)
        batch.advance(
            DT,
            wp.array(np.tile(2 * rest, (2, 1)), dtype=wp.float64, ndim=2),
            wp.array([1, 0], dtype=int),
            nothing,
        )
    sampled = batch.state.numpy()[:, SAMPLED:SAMPLED_PDC]
    np.testing.assert_allclose(sampled[0], channels.counts_from_impedance(2 * rest), atol=0.5)
    np.testing.assert_allclose(sampled[1], channels.counts_from_impedance(rest), atol=0.5)


def test_reset_of_some_worlds(film):
    rest = film.impedance(film.geometry.vert)
    batch = BatchAcquisition(rest, 3)
    start = batch.state.numpy().copy()
    for _ in range(5):
        batch.find_due(DT)
        batch.advance(
            DT,
            wp.array(np.tile(2 * rest, (3, 1)), dtype=wp.float64, ndim=2),
            wp.ones(3, dtype=int),
            wp.full(3, 500.0, wp.float64),
        )
    before = batch.state.numpy().copy()
    batch.reset(wp.array([False, True, False], dtype=bool))
    np.testing.assert_array_equal(batch.state.numpy()[1], start[1])
    np.testing.assert_array_equal(batch.state.numpy()[[0, 2]], before[[0, 2]])
    np.testing.assert_allclose(batch.time.numpy(), [5 * DT, 0, 5 * DT])


def test_seeds_that_do_not_fit_are_refused(film):
    rest = film.impedance(film.geometry.vert)
    with pytest.raises(ValueError, match="2 seeds for 3 worlds: pass one for each"):
        BatchAcquisition(rest, 3, seed=[1, 2])
    with pytest.raises(ValueError, match="seed is -1"):
        BatchAcquisition(rest, 2, seed=-1)


def test_a_film_refuses_arrays_of_another_device(film):
    class Elsewhere:
        device = "another device"

    with pytest.raises(
        ValueError, match="the film is on cpu, x on another device .*: make both where the film is"
    ):
        BatchFilm(film, 1).solve_film(Elsewhere(), wp.ones(1, dtype=int))
