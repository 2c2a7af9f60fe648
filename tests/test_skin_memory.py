"""Relaxation and Mullins softening inside the elements, against closed forms of bars and of prescribed
homogeneous deformations."""

import copy
import dataclasses

import numpy as np
import pytest
from bars import AREA, LENGTH, NOTHING, NOW, E, bar, batch, cube, deform, pull, pull_worlds
from blocks import nodal_areas, place, shell, skin
from forces import begin, check_tangent, commit
from grids import covering
from scipy.special import erf

from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, step
from biotac_mj.skin.rubber.law import LAWS
from biotac_mj.skin.state_arrays import StateArrays

G, TAU = 0.4, 0.7
SERIES = ((G, TAU),)


@pytest.mark.parametrize("element, law", covering(["linear", "quadratic"], ["corotational", "svk", "linear"]))
def test_force_of_a_stretched_bar_relaxes_as_the_series_says(law, element):
    prony = ((0.4, 0.7), (0.2, 8.0))
    model = bar(law, element, prony=prony)
    data, elastic = SkinData(model), SkinModel(model.geometry, Material(law, E, 0.0), model.options)
    stretch = 1.2
    long_term = pull(elastic, SkinData(elastic), stretch, None)
    exact = {"linear": E * 0.2, "corotational": E * 0.2, "svk": E * stretch * (stretch**2 - 1) / 2}[
        law
    ] * AREA
    assert long_term == pytest.approx(exact, rel=1e-6)
    time = 0.0
    for dt in (NOW, 0.05, 0.4, 2.0, 0.1, 30.0):
        time += dt
        expected = long_term * (1 + sum(g * np.exp(-time / tau) for g, tau in prony))
        assert pull(model, data, stretch, dt) == pytest.approx(expected, rel=1e-6)


def test_faster_is_stiffer():
    """A ramp of the `linear` law: F = E A k (t + g tau (1 - exp(-t / tau))), whatever the steps."""
    for rate, n in ((1e-3, 7), (0.1, 7), (10.0, 3)):
        model = bar(prony=SERIES)
        data = SkinData(model)
        end = 0.01 / rate
        for k in range(n):
            force = pull(model, data, 1 + 0.01 * (k + 1) / n, end / n)
        expected = E * AREA * rate * (end + G * TAU * (1 - np.exp(-end / TAU)))
        assert force == pytest.approx(expected, rel=1e-6)


def test_a_loaded_bar_creeps():
    """Compliance of the standard solid: (1 - g / (1 + g) exp(-t / (tau (1 + g)))) / E."""
    model = bar(held=False, prony=SERIES)
    data = SkinData(model)
    vert = model.geometry.vert
    end = vert[:, 0] == LENGTH
    face = np.array([f for f in model.geometry.outer_face if end[f].all()])
    load = np.zeros((1, model.nvert, 3))
    load[0, :, 0] = 1e4 * nodal_areas(vert, face)
    data.set_external(load)
    step(model, data, NOTHING, NOW)
    time, dt = 0.0, 0.02
    for k in range(60):
        strain = (data.vert_xpos[0, end, 0].mean() - LENGTH) / LENGTH
        expected = 1e4 / E * (1 - G / (1 + G) * np.exp(-time / (TAU * (1 + G))))
        assert strain == pytest.approx(expected, rel=2e-4), k  # second order in dt
        step(model, data, NOTHING, dt)
        time += dt
    assert data.converged.all()


@pytest.mark.parametrize(
    "element, law", covering(["linear", "quadratic"], [law for law in LAWS if law != "linear"])
)
def test_two_jumps_and_a_turn(law, element):
    """Large strains: P = F (S + sum of g (jumps of what remembers) exp(-their age / tau)), turned with the
    body."""
    rng = np.random.default_rng(2)
    first, second = (np.eye(3) + 0.15 * rng.standard_normal((3, 3)) for _ in range(2))
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    model, elastic = cube(law, element, prony=((G, TAU),)), cube(law, element)

    def piola(F):
        return np.linalg.solve(F, deform(elastic, SkinData(elastic), F, None))

    def memory(F):
        if law != "neo_hookean":
            return piola(F)
        C = F.T @ F
        return (
            elastic.material.mu
            * np.linalg.det(F) ** (-2 / 3)
            * (np.eye(3) - np.trace(C) / 3 * np.linalg.inv(C))
        )

    data = SkinData(model)
    deform(model, data, first, NOW)
    deform(model, data, first, 0.5)
    deform(model, data, second, NOW)
    got = deform(model, data, second, 0.3)
    over = G * (memory(first) * np.exp(-0.8 / TAU) + (memory(second) - memory(first)) * np.exp(-0.3 / TAU))
    expected = second @ (piola(second) + over)
    np.testing.assert_allclose(got, expected, atol=1e-6 * abs(expected).max())
    turned = deform(model, data, turn @ second, NOW)
    np.testing.assert_allclose(turned, turn @ expected, atol=1e-6 * abs(expected).max())


@pytest.mark.law
@pytest.mark.parametrize(
    "element, law, beside",
    covering(
        ["linear", "quadratic"],
        LAWS,
        [{}, {"stiffening": 0.8, "hysteresis": ((0.7, 0.05), (0.2, 10.0))}, {"stiffening": -0.6}],
    ),
)
def test_the_tangent_is_the_forces_derivative(law, element, beside):
    model = cube(law, element, prony=((G, TAU), (0.1, 3.0)), mullins=(1.6, 2e3, 0.1), **beside)
    data, rng = SkinData(model), np.random.default_rng(4)
    rest = model.geometry.vert
    data.x.numpy()[:, 0] = rest @ (np.eye(3) + 0.25 * rng.standard_normal((3, 3))).T
    begin(data, 0.3)
    commit(data)  # a past, and a largest energy to be below of
    x = rest @ (np.eye(3) + 0.1 * rng.standard_normal((3, 3))).T + 2e-4 * rng.standard_normal(rest.shape)
    begin(data, 0.2)
    directions = 1e-4 * rng.standard_normal(rest.shape), rng.standard_normal(rest.shape)
    force = check_tangent(data, SkinData(cube(law, element)), x, directions, 1e-3, 2e-7)
    soft = force(0.0)
    data.rubber.worst.zero_()
    assert abs(force(0.0) - soft).max() > 1e-3 * abs(soft).max()  # it was softened


@pytest.mark.law
@pytest.mark.parametrize("law", ["corotational", "neo_hookean", "svk"])
def test_no_energy_comes_out_of_a_cycle(law):
    """Work of closed cycles of the deformation: zero for the elastic law, positive with memory, at any
    speed."""
    rng = np.random.default_rng(5)
    kinds = {
        "elastic": {},
        "prony": {"prony": ((G, TAU), (0.3, 0.05))},
        "mullins": {"mullins": (1.5, 3e3, 0.0)},
    }
    for name, memory in kinds.items():
        model = cube(law, "linear", **memory)
        for dt in (0.002, 0.05, 1.0):
            a, b = 0.12 * rng.standard_normal((2, 3, 3))
            angle = np.linspace(0, 2 * np.pi, 49)
            path = np.eye(3) + (1 - np.cos(angle))[:, None, None] * a + np.sin(angle)[:, None, None] * b
            data = SkinData(model)
            P = np.array([deform(model, data, F, dt) for F in path])
            work = np.einsum("tij,tij->", (P[1:] + P[:-1]) / 2, np.diff(path, axis=0))
            scale = np.einsum("tij,tij->t", (P[1:] + P[:-1]) / 2, np.diff(path, axis=0)).clip(0).sum()
            assert abs(work) < 2e-3 * scale if name == "elastic" else work > 5e-3 * scale, (name, dt)


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_softening_of_a_cycle(element):
    """A bar of svk without lateral strain: W = E (s^2 - 1)^2 / 8, P = eta E s (s^2 - 1) / 2 below the largest
    stretch, eta = 1 beyond."""
    r, m, beta = 1.8, 5e3, 0.2
    model = bar("svk", element, mullins=(r, m, beta))
    data = SkinData(model)
    worst = 0.0
    for stretch in (1.1, 1.2, 1.3, 1.2, 1.05, 1.0, 1.15, 1.29, 1.3, 1.4, 1.2):
        energy = E * (stretch**2 - 1) ** 2 / 8
        worst = max(worst, energy)
        eta = 1 - erf((worst - energy) / (m + beta * worst)) / r
        expected = eta * E * stretch * (stretch**2 - 1) / 2 * AREA
        assert pull(model, data, stretch, None) == pytest.approx(expected, rel=1e-6, abs=1e-6)
    data.reset()
    assert pull(model, data, 1.2, None) == pytest.approx(E * 1.2 * 0.22 * AREA, rel=1e-6)


def test_softened_stress_relaxes():
    """The softened stress relaxes: after a jump, a hold and a jump back P = s (eta S2 + g (S1 e1 + (eta S2 -
    S1) e2))."""
    r, m = 2.0, 1e4
    model = bar("svk", prony=((G, TAU),), mullins=(r, m, 0.0))
    data = SkinData(model)
    pull(model, data, 1.3, NOW)
    pull(model, data, 1.3, 0.4)
    pull(model, data, 1.1, NOW)
    force = pull(model, data, 1.1, 0.2)
    one, two = E * (1.3**2 - 1) / 2, E * (1.1**2 - 1) / 2
    two *= 1 - erf(E * (0.69**2 - 0.21**2) / 8 / m) / r
    over = G * (one * np.exp(-0.6 / TAU) + (two - one) * np.exp(-0.2 / TAU))
    assert force == pytest.approx(1.1 * (two + over) * AREA, rel=1e-6)


def test_memory_is_saved_replayed_and_forgotten():
    model = bar(
        "corotational",
        "quadratic",
        nu=0.3,
        prony=SERIES,
        mullins=(2.0, 1e4, 0.1),
        hysteresis=((0.5, 0.03),),
        stiffening=0.4,
    )
    data = SkinData(model)
    path = [(1.2, 0.1), (1.25, 0.3), (1.1, 0.2)]
    once = [pull(model, data, *p) for p in path]
    saved = StateArrays(data, GeomSet([], [])).save()
    went_on = pull(model, data, 1.15, 0.5)
    again = SkinData(model)
    StateArrays(again, GeomSet([], [])).load(saved)
    assert pull(model, again, 1.15, 0.5) == pytest.approx(went_on, rel=1e-9)
    data.reset()
    assert [pull(model, data, *p) for p in path] == once  # bit by bit
    for value in StateArrays(SkinData(model), GeomSet([], [])).save_of("rubber").values():
        assert abs(value).max() < 1e-14  # rounding at rest


def test_worlds_remember_each_their_own():
    model = bar("corotational", prony=SERIES, hysteresis=((0.3, 0.05),))
    data, alone = SkinData(model, 2), SkinData(model)
    end = np.flatnonzero(model.geometry.vert[:, 0] == LENGTH)
    for stretch, dt in ((1.2, 0.1), (1.2, 0.3), (1.1, 0.1)):
        place(data, end, model.geometry.vert[end])
        for array in (data.x, data.x_last):
            array.numpy()[end, 1] = model.geometry.vert[end] * [stretch, 1, 1]
        step(model, data, GeomSet([], [], nworld=2), dt)
        force = pull(model, alone, stretch, dt)
    reactions = -data.force.numpy()[end, :, 0].sum(0)
    assert abs(reactions[0]) < 1e-9 and reactions[1] == pytest.approx(force, rel=1e-9)


PATH = ((1.05, 0.1), (1.1, 0.05), (1.1, 0.4), (1.07, 0.1))  # stretches of a bar, and when


@pytest.mark.parametrize(
    "element, law, name",
    covering(["linear", "quadratic"], ["corotational", "neo_hookean"], ["prony", "mullins"]),
)
def test_materials_of_worlds_differ(law, element, name):
    """Each world relaxes and softens by its own numbers, also by none."""
    values = {
        "prony": (((0.0, 1.0), (0.0, 1.0)), ((G, TAU), (0.1, 3.0)), ((1.2, 0.05), (0.3, 20.0))),
        "mullins": (None, (1.8, 5e2, 0.2), (1.2, 2e3, 0.0)),
    }[name]
    model = bar(law, element, nu=0.4, **{name: values[1]})
    materials = [dataclasses.replace(model.material, **{name: value}) for value in values]
    together, alone, own = batch(
        model, materials, lambda m, data: [pull_worlds(m, data, *where) for where in PATH]
    )
    peak = abs(together).max()
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-9 * peak)
    np.testing.assert_allclose(together, own, rtol=0, atol=1e-6 * peak)  # of models: the solver's tolerance
    assert abs(np.diff(together, axis=1)).max() > 0.02 * peak
    plain = bar(law, element, nu=0.4)
    data = SkinData(plain)
    elastic = [pull(plain, data, *where) for where in PATH]
    np.testing.assert_allclose(together[:, 0], elastic, rtol=0, atol=1e-6 * peak)


@pytest.mark.parametrize("element, law", covering(["linear", "quadratic"], LAWS))
def test_directions_in_single_precision(law, element):
    """The same answer with those of CUDA, with all that a material can have."""
    more = {"prony": ((G, TAU), (0.2, 0.1)), "mullins": (2.0, 2e3, 0.1), "hysteresis": ((0.5, 0.03),)}
    model = bar(law, element, nu=0.4, stiffening=0.5, **more)
    data = [SkinData(model, preconditioner=p) for p in ("sparse", "dense")]
    force = np.array([[pull(model, d, *where) for where in PATH] for d in data])
    np.testing.assert_allclose(force[1], force[0], rtol=0, atol=1e-4 * abs(force).max())
    states = [StateArrays(d, GeomSet([], [])).save_of("rubber") for d in data]
    most = max(abs(value).max() for value in states[0].values())
    for value, other in zip(states[0].values(), states[1].values()):
        assert abs(other - value).max() < 1e-3 * most


@pytest.mark.parametrize(
    "element, law", covering(["linear", "quadratic"], [law for law in LAWS if law != "linear"])
)
def test_stress_of_elements_is_that_on_the_surface(law, element):
    """Cauchy stress P F^T / J of homogeneous steps, P from the forces on the cube's surface, with all that a
    material can have."""
    more = {
        "prony": ((G, TAU), (0.2, 0.1)),
        "mullins": (2.0, 2e3, 0.1),
        "hysteresis": ((0.5, 0.03),),
        "stiffening": 0.5,
    }
    model, rng = cube(law, element, modulus=np.full(48, 1.7), **more), np.random.default_rng(6)
    data = SkinData(model)
    for dt in (0.1, 0.4, 0.05):
        F = np.eye(3) + 0.12 * rng.standard_normal((3, 3))
        expected = deform(model, data, F, dt) @ F.T / np.linalg.det(F)
        cauchy, mises = data.stress()
        np.testing.assert_allclose(
            cauchy[0], np.broadcast_to(expected, cauchy[0].shape), atol=1e-6 * abs(expected).max()
        )
        deviator = expected - np.trace(expected) / 3 * np.eye(3)
        np.testing.assert_allclose(mises[0], 1.5**0.5 * np.linalg.norm(deviator), rtol=1e-5)


def test_filled_skin_rests():
    """Rest on the filling is relaxed and virgin: nothing moves when time passes."""
    vert, elem, inner = shell(10e-3, 7e-3, subdivisions=1, layers=2)
    material = Material("corotational", E, 0.3, liquid=True, prony=((G, TAU),), mullins=(2.0, 1e3, 0.0))
    model = SkinModel(
        skin(vert, elem, np.flatnonzero(vert[:, 0] > 5e-3), inner_face=inner),
        material,
        SkinOptions(rest_pressure=2e4),
    )
    data = SkinData(model)
    at_rest = data.vert_xpos.copy()
    for dt in (1e-3, 1.0):
        step(model, data, NOTHING, dt)
        assert data.converged.all() and data.iterations[0] == 0
    np.testing.assert_array_equal(data.vert_xpos, at_rest)


@pytest.mark.law
def test_memory_is_in_the_plugins_state():
    """Pressed and held, the force relaxes in mj_step; a copy of mjData replays it bit by bit, and a reset
    forgets."""
    import mujoco

    import biotac_mj

    spec = mujoco.MjSpec.from_string(
        """<mujoco><option timestep="0.02" gravity="0 0 0"/><worldbody><body name="finger"/>
        <body name="ball" mocap="true" pos="0 0 0.0164"><geom type="sphere" size="0.008"/></body>
        </worldbody></mujoco>"""
    )
    material = {"prony": [[0.5, 0.1]], "element": "linear"}
    pose = {"pos": [0.0062, 0, 0], "quat": [0.5**0.5, -(0.5**0.5), 0, 0]}  # pad up
    handle = biotac_mj.attach(spec, body="finger", skin="coarse", material=material, readings="none", **pose)
    model = spec.compile()
    data = mujoco.MjData(model)
    force = []
    for k in range(8):
        data.mocap_pos[0, 2] -= 2e-4 * (k < 3)
        mujoco.mj_step(model, data)
        force.append(abs(handle.read(data, "contact_force")[1]))
    # held since the third step; its overstress of about 0.5 (1 - exp(-0.6)) / 0.6 falls by exp(-0.2) a step,
    # the rest stays
    over = np.diff(force[2:])
    assert (over < 0).all() and force[2] > 1.2 * force[7]
    np.testing.assert_allclose(over[1:] / over[:-1], np.exp(-0.2), rtol=0.05)
    twin = copy.copy(data)
    for _ in range(2):
        mujoco.mj_step(model, data)
        mujoco.mj_step(model, twin)
    np.testing.assert_array_equal(data.plugin_state, twin.plugin_state)
    mujoco.mj_resetData(model, data)
    mujoco.mj_step(model, data)
    assert handle.read(data, "contact_force")[1] == 0
    biotac_mj.plugin.check()


def test_what_cannot_be_is_refused():
    nothing = "energy would come"
    for prony, text in (
        (((0.1,),), "pass \\(\\(g, tau\\), ...\\)"),
        (((-0.1, 1.0),), nothing),
        (((0.1, 0.0),), nothing),
    ):
        with pytest.raises(ValueError, match=text):
            Material(prony=prony)
    with pytest.raises(ValueError, match="r must be above 1"):
        Material(mullins=(0.9, 1.0, 0.0))
    assert Material(prony=[[0.1, 2]], mullins=[2, 1e3, 0]) == Material(
        prony=((0.1, 2.0),), mullins=(2.0, 1e3, 0.0)
    )
    model = bar(prony=SERIES)
    for dt in (None, 0.0, np.nan):
        with pytest.raises(ValueError, match="relaxes in time, needs the time step: pass dt > 0"):
            step(model, SkinData(model), NOTHING, dt)
    with pytest.raises(ValueError, match="has 0 terms of prony and the model's 1: give it as many"):
        SkinData(model, material=[Material("linear", E, 0.0)])
    with pytest.raises(ValueError, match="a world's material has mullins and the model's has not"):
        SkinData(model, material=[dataclasses.replace(model.material, mullins=(2.0, 1e3, 0.0))])
    from biotac_mj.skin.condensed import CondensedSkin

    with pytest.raises(ValueError, match="condensed tier is elastic"):
        CondensedSkin(model, NOTHING)
