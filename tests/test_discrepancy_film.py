"""Rough walls in the film's conductance and liquid lost under the skin."""

import dataclasses

import numpy as np
import pytest

import biotac_mj.data.generation.simulate as simulation
from biotac_mj.discrepancy.trajectories.model.differences import differences, filled, sunk
from biotac_mj.discrepancy.trajectories.model.fields import Fields
from biotac_mj.discrepancy.trajectories.model.in_skin import InSkinSimulator
from biotac_mj.discrepancy.trajectories.model.simulator import Simulator
from biotac_mj.discrepancy.trajectories.trajectory import Trajectory
from biotac_mj.effects.catalogue import by_id
from biotac_mj.effects.in_film import RoughFilm, SeveralFilms, SunkFilm, drain, remaining_liquid
from biotac_mj.effects.in_skin import memory_of
from biotac_mj.geometry import load_skin
from biotac_mj.sensor.film import FilmConduction
from biotac_mj.skin import SkinData, SkinModel, SkinOptions


@pytest.fixture(scope="module")
def film():
    return FilmConduction(load_skin("coarse"))


def thinner(film, fraction):
    """The skin with the film `fraction` times as thick everywhere."""
    x = film.geometry.vert.copy()
    middle, thickness = film.film(x)
    foot = 2 * middle - x[film.node]
    x[film.node] = foot + fraction * (x[film.node] - foot)
    np.testing.assert_allclose(
        film.film(x)[1], np.maximum(fraction * thickness, film.residual_film), rtol=0.02
    )
    return x


def test_a_rough_film_conducts_as_a_power_of_its_thickness(film):
    """A film 0.8 times as thick with power 2 is one 0.64 times as thick, but for where its middle lies; at
    rest nothing changes."""
    rough, rest = RoughFilm(film, 2.0), film.geometry.vert
    np.testing.assert_allclose(rough.impedance(rest), film.impedance(rest), rtol=1e-12)
    np.testing.assert_array_equal(
        RoughFilm(film, 1.0).film(thinner(film, 0.8))[1].round(12), film.film(thinner(film, 0.8))[1].round(12)
    )
    np.testing.assert_allclose(
        rough.impedance(thinner(film, 0.8)), film.impedance(thinner(film, 0.64)), rtol=0.03
    )


def test_a_skin_that_has_sunk_leaves_a_thinner_film(film):
    """By as much everywhere, so that thin places lose the larger share; never all of it."""
    rest = film.geometry.vert
    np.testing.assert_allclose(SunkFilm(film, 0.0).impedance(rest), film.impedance(rest), rtol=1e-12)
    little, more = (np.log(SunkFilm(film, d).impedance(rest) / film.impedance(rest)) for d in (2e-5, 4e-5))
    assert (little > 0).all() and (more > 1.9 * little).all() and np.ptp(little / little.mean()) > 0.2
    assert np.isfinite(SunkFilm(film, 5e-3).impedance(rest)).all()


def test_films_laid_together_are_what_each_is_alone(film):
    alone, together = ([film.with_residual_film(t) for t in (2e-5, 5e-5, 2e-4)] for _ in range(2))
    together = SeveralFilms(together)
    for x in (thinner(film, 0.2), thinner(film, 0.1)):
        expected = np.stack([one.impedance(x) for one in alone])
        assert (expected[0] > expected[-1]).all()
        np.testing.assert_array_equal(together.impedance(x), expected)


def test_a_skin_that_sinks_is_lost_liquid(monkeypatch):
    """Solved once with the skin nearer to the core, in air: the hour's 0.1 mm by its difference. What lies
    under the two films is solved once."""
    solved = []
    monkeypatch.setattr(
        simulation, "simulate", lambda *a, own=simulation.simulate, **k: solved.append(a) or own(*a, **k)
    )
    t = np.linspace(0, 1, 8)
    pos = np.tile([-12e-3, -30e-3, 0], (8, 1))
    air = Trajectory("a", "sphere_7mm", 0.0, t, pos, np.tile(np.eye(3), (8, 1, 1)), np.full((8, 19), 2500.0))
    sim, both = Simulator(), [air, dataclasses.replace(air, clock=3600.0)]
    base = sim.solve(both)
    fields = Fields(base, differences([*sunk(sim), *filled(sim)], both, base), both)
    assert len(solved) == 2  # the base and less liquid
    lost = by_id("fluidloss").given(["sink"])
    theta = {**lost.default(), "sink": 0.1e-3, "suction": 1e4}
    fresh, late = sim.run(both, fields, False, [(lost, theta)])
    film = sim.skin_and_film(0.0, 0.0)[1]
    rest = film.geometry.vert
    change = np.log(SunkFilm(film, 60e-6).impedance(rest) / film.impedance(rest))
    np.testing.assert_allclose(late.log_z[0] - base[1]["log_z"][0], change * 0.1 / 0.06, rtol=0.02)
    np.testing.assert_allclose(fresh.log_z[0], base[0]["log_z"][0], atol=1e-9)
    assert late.pressure[0] - fresh.pressure[0] == pytest.approx(-2e3, rel=1e-3)


def test_a_drained_skin_holds_what_is_left():
    """Its liquid's volume, counted by the divergence theorem, and suction; the share of the session's
    clock."""
    model = SkinModel(load_skin("coarse"), "default", SkinOptions(liquid=True))
    data = SkinData(model)
    drain(model, data, 0.95)
    assert data.converged.all() and data.volume[0] == pytest.approx(0.95 * model.liquid_volume, rel=1e-5)
    assert -1e4 < data.pressure[0] < -500
    assert remaining_liquid(0.2, 900.0) == pytest.approx(0.95) and remaining_liquid(
        5.0, 3600.0
    ) == pytest.approx(0.2)
    assert remaining_liquid(0.2, 900.0, 0.03) == pytest.approx(0.92)


def test_effects_become_the_film():
    effects = [
        (by_id("fluidloss"), {"rate": 0.1}),
        (by_id("asper"), {"log_p": 0.2}),
        (by_id("gain"), {}),
        (by_id("asper"), {"log_p": -0.1}),
    ]
    inside = memory_of(effects)
    assert inside.film == {"loss": 0.1, "power": pytest.approx(np.exp(0.1))} and [
        e.id for e, _ in inside.rest
    ] == ["gain"]
    assert memory_of([(by_id("fluidloss"), {"rate": 0.0}), (by_id("asper"), {"log_p": 0.0})]).film == {}


def test_liquid_lost_raises_impedances_and_sucks():
    """In air, an hour apart: unlike its reduced form, the film thins where the skin gives way."""
    t = np.linspace(0, 1, 8)
    pos = np.tile([-12e-3, -30e-3, 0], (8, 1))
    air = Trajectory("a", "sphere_7mm", 0.0, t, pos, np.tile(np.eye(3), (8, 1, 1)), np.full((8, 19), 2500.0))
    sim, effects = InSkinSimulator(), [(by_id("fluidloss"), {"rate": 0.1})]
    fresh, late = sim.run([air, dataclasses.replace(air, clock=3600.0)], effects=effects)
    change = late.log_z[0] - fresh.log_z[0]
    assert (change > 0).all() and change.mean() < -np.log(0.9) and np.ptp(change) > 0.005
    assert late.pressure[0] < -1e3 and abs(fresh.pressure[0]) < 100
