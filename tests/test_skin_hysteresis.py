"""Friction elements beside the law: Prandtl and Ishlinskii's closed forms, radial return written down here,
work, speed, replay."""

import copy
import dataclasses

import numpy as np
import pytest
from bars import LENGTH, NOTHING, E, bar, batch, cube, deform, pull, pull_worlds
from blocks import nodal_areas
from forces import begin, check_tangent, commit, gradients
from grids import covering

from biotac_mj.skin import GeomSet, Material, SkinData, step
from biotac_mj.skin.rubber.law import LAWS
from biotac_mj.skin.state import SavedState
from biotac_mj.skin.state_arrays import StateArrays

BRANCHES = ((0.6, 0.02), (0.3, 0.08))
PATH = (1.05, 1.1, 1.07, 1.12)  # stretches of a bar


def clipped(path, limit):
    """Prandtl's element: what is left of a path, from zero on, when it drags a friction of this strength
    along."""
    out, slip = [], 0.0
    for value in path:
        slip = np.clip(slip, value - limit, value + limit)
        out.append(value - slip)
    return np.array(out)


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_shear_of_the_linear_law(element):
    """tau = mu (gamma + sum of g play(gamma; sqrt(3) strain)): a von Mises strain e is a shear of sqrt(3)
    e."""
    model = cube("linear", element, hysteresis=BRANCHES)
    data, mu = SkinData(model), model.material.mu
    path = np.array([0.01, 0.05, 0.3, 0.2, 0.28, -0.1, -0.3, 0.3, 0.0])
    got = []
    for gamma in path:
        F = np.eye(3)
        F[0, 1] = gamma
        got.append(deform(model, data, F, None)[0, 1])
    expected = mu * (path + sum(g * clipped(path, 3**0.5 * e) for g, e in BRANCHES))
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9 * abs(expected).max())


def test_a_pulled_bar_with_free_sides():
    """Linear law, traction t: modulus 9 K m / (3 K + m), m = mu (1 + g), until the von Mises strain is
    reached; then the friction's stress 3 g mu e lies beside the law's own and t = E strain + 2/3 (1 + nu) of
    it."""
    g, slips, nu = 0.8, 0.01, 0.3
    model = bar("linear", "linear", nu=nu, held=False, hysteresis=((g, slips),))
    vert = model.geometry.vert
    end = vert[:, 0] == LENGTH
    face = np.array([f for f in model.geometry.outer_face if end[f].all()])
    stiff, bulk = model.material.mu * (1 + g), model.material.bulk
    young = 9 * bulk * stiff / (3 * bulk + stiff)
    still = 3 * g * model.material.mu * slips
    lateral = (3 * bulk - 2 * stiff) / (2 * (3 * bulk + stiff))
    limit = young * 1.5 * slips / (1 + lateral)  # traction at which the friction slips
    for traction, expected in (
        (0.5 * limit, 0.5 * limit / young),
        (3 * limit, (3 * limit - 2 / 3 * (1 + nu) * still) / E),
    ):
        data = SkinData(model)
        load = np.zeros((1, model.nvert, 3))
        load[0, :, 0] = traction * nodal_areas(vert, face)
        data.set_external(load)
        step(model, data, NOTHING)
        assert data.converged[0]
        # the cube of elements at the free end: the held one may not narrow
        cells = (vert[model._elem][:, :, 0] > 0.74 * LENGTH).all(1)
        strain = gradients(model.elements, data.vert_xpos[0])[0][cells, 0, 0].mean() - 1
        assert strain == pytest.approx(expected, rel=0.01)


class Return:
    """Radial return in the law's strain, for one homogeneous deformation after another."""

    def __init__(self, law, mu, branches):
        self.law, self.mu, self.branches = law, mu, branches
        self.slip = np.zeros((len(branches), 3, 3))

    def strain(self, F):
        if self.law == "linear":
            return (F + F.T) / 2 - np.eye(3)
        scale = np.linalg.det(F) ** (-2 / 3) if self.law == "neo_hookean" else 1.0
        return (scale * F.T @ F - np.eye(3)) / 2

    def energy(self, F):
        """Potential of a step from the present slip [J/m^3]; the derivative is the stress."""
        total = 0.0
        for (g, e), slip in zip(self.branches, self.slip):
            T = self.strain(F) - slip
            size, r = np.linalg.norm(T - np.trace(T) / 3 * np.eye(3)), 1.5**0.5 * e
            total += g * self.mu * (size**2 if size <= r else 2 * r * size - r**2)
        return total

    def stress(self, F):
        h, P = 1e-4, np.zeros((3, 3))
        for i in range(3):
            for j in range(3):
                d = np.zeros((3, 3))
                d[i, j] = 1
                f = [self.energy(F + k * h * d) for k in (2, 1, -1, -2)]
                P[i, j] = (8 * (f[1] - f[2]) - (f[0] - f[3])) / (12 * h)
        return P

    def commit(self, F):
        for b, (_, e) in enumerate(self.branches):
            T = self.strain(F) - self.slip[b]
            T -= np.trace(T) / 3 * np.eye(3)
            size, r = np.linalg.norm(T), 1.5**0.5 * e
            if size > r:
                self.slip[b] += (1 - r / size) * T


@pytest.mark.parametrize("element, law", covering(["linear", "quadratic"], LAWS))
def test_large_strains_and_a_turn(law, element):
    rng = np.random.default_rng(3)
    model, elastic = cube(law, element, hysteresis=BRANCHES), cube(law, element)
    data, other = SkinData(model), Return(law, model.material.mu, BRANCHES)
    for _ in range(6):
        F = np.eye(3) + 0.15 * rng.standard_normal((3, 3))
        expected = deform(elastic, SkinData(elastic), F, None) + other.stress(F)
        got = deform(model, data, F, None)
        np.testing.assert_allclose(got, expected, atol=1e-6 * abs(expected).max())
        other.commit(F)
    if law != "linear":
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        np.testing.assert_allclose(
            deform(model, data, turn @ F, None), turn @ got, atol=1e-7 * abs(got).max()
        )


@pytest.mark.law
@pytest.mark.parametrize("element, law", covering(["linear", "quadratic"], LAWS))
def test_the_tangent_is_the_forces_derivative(law, element):
    """Among points that slip and points that hold; symmetric."""
    model = cube(law, element, hysteresis=((0.7, 0.05), (0.2, 1.0)))
    data, rng = SkinData(model), np.random.default_rng(4)
    rest = model.geometry.vert
    data.x.numpy()[:, 0] = rest @ (np.eye(3) + 0.2 * rng.standard_normal((3, 3))).T
    begin(data)
    commit(data)
    x = rest @ (np.eye(3) + 0.03 * rng.standard_normal((3, 3))).T + 1e-4 * rng.standard_normal(rest.shape)
    data.x.numpy()[:, 0] = x
    directions = 1e-4 * rng.standard_normal(rest.shape), rng.standard_normal(rest.shape)
    check_tangent(data, SkinData(cube(law, element)), x, directions, 1e-4, 1e-6)
    before = data.rubber.slip.numpy().copy()
    commit(data)
    slipped = abs(data.rubber.slip.numpy() - before).max((-1, -2, -3)) > 0
    assert slipped[0].any() and not slipped[1].any()


@pytest.mark.parametrize("law", LAWS)
def test_loops_do_not_know_speed_and_take_work(law):
    """The same loop ten times as fast gives the same stresses; every closed cycle takes work, a loop of shear
    4 g mu y (c - y)."""
    rng = np.random.default_rng(5)
    model = cube(law, "linear", hysteresis=BRANCHES)
    a, b = 0.12 * rng.standard_normal((2, 3, 3))
    angle = np.linspace(0, 4 * np.pi, 65)
    path = np.eye(3) + (1 - np.cos(angle))[:, None, None] * a + np.sin(angle)[:, None, None] * b
    loops = []
    for dt in (0.1, 0.01, None):
        data = SkinData(model)
        loops.append(np.array([deform(model, data, F, dt) for F in path]))
    np.testing.assert_allclose(loops[1], loops[0], rtol=1e-9)
    np.testing.assert_array_equal(loops[2], loops[0])
    for part in (slice(0, 33), slice(32, 65)):  # the first cycle and the second, which closes in stress too
        P, F = loops[0][part], path[part]
        done = np.einsum("tij,tij->t", (P[1:] + P[:-1]) / 2, np.diff(F, axis=0))
        assert done.sum() > 0.02 * done.clip(0).sum()
    np.testing.assert_allclose(loops[0][32], loops[0][64], atol=0.05 * abs(loops[0]).max())


def test_the_loop_of_shear_has_its_area():
    g, e = BRANCHES[0]
    model = cube("linear", "linear", hysteresis=(BRANCHES[0],))
    data, mu = SkinData(model), model.material.mu
    cycle = 0.2 * np.concatenate(
        [np.linspace(0, 1, 21), np.linspace(1, -1, 81)[1:], np.linspace(-1, 1, 81)[1:]]
    )
    stress = []
    for gamma in cycle:
        F = np.eye(3)
        F[0, 1] = gamma
        stress.append(deform(model, data, F, None)[0, 1])
    gamma, stress = cycle[20:], np.array(stress)[20:]
    area = np.sum((stress[1:] + stress[:-1]) / 2 * np.diff(gamma))
    y = 3**0.5 * e
    assert area == pytest.approx(
        4 * g * mu * y * (0.2 - y), rel=0.01
    )  # corners of the loop fall between the steps


def test_one_step_is_many_on_a_straight_way():
    F = np.eye(3) + 0.1 * np.random.default_rng(8).standard_normal((3, 3))
    model = cube("linear", "linear", hysteresis=BRANCHES)
    once, often = SkinData(model), SkinData(model)
    straight = [deform(model, often, np.eye(3) + k / 20 * (F - np.eye(3)), None) for k in range(1, 21)][-1]
    np.testing.assert_allclose(straight, deform(model, once, F, None), rtol=1e-9)


def test_slip_is_saved_replayed_and_forgotten():
    model = cube("neo_hookean", "quadratic", hysteresis=BRANCHES)
    data, rng = SkinData(model), np.random.default_rng(9)
    path = np.eye(3) + 0.1 * rng.standard_normal((4, 3, 3))
    once = [deform(model, data, F, None) for F in path[:3]]
    saved = StateArrays(data, GeomSet([], [])).save()
    assert saved.slip.shape == (len(BRANCHES), 4 * model.nelem, 6)
    went_on = deform(model, data, path[3], None)
    again = SkinData(model)
    StateArrays(again, GeomSet([], [])).load(SavedState(slip=saved.slip))
    np.testing.assert_allclose(deform(model, again, path[3], None), went_on, rtol=1e-12)
    data.reset()
    np.testing.assert_array_equal([deform(model, data, F, None) for F in path[:3]], once)


def test_a_step_that_fails_slips_nowhere():
    model = bar("corotational", "linear", hysteresis=BRANCHES)
    data = SkinData(model, 2)
    before = data.rubber.slip.numpy().copy()
    data.x.numpy()[:, 1] = model.geometry.vert * [1.2, 1, 1]
    commit(data, [True, False])
    np.testing.assert_array_equal(data.rubber.slip.numpy(), before)
    commit(data, [True, True])
    slip = abs(data.rubber.slip.numpy())  # [branch, point, world]
    assert slip[:, :, 0].max() < 1e-12 < 1e-3 < slip[:, :, 1].max()


@pytest.mark.parametrize("element, law", covering(["linear", "quadratic"], ["linear", "neo_hookean"]))
def test_materials_of_worlds_differ(law, element):
    """Each world has friction of its own, also none."""
    values = (((0.0, 0.02), (0.0, 0.08)), BRANCHES, ((1.5, 0.05), (0.4, 0.01)))
    model = bar(law, element, nu=0.4, hysteresis=BRANCHES)
    materials = [dataclasses.replace(model.material, hysteresis=value) for value in values]
    together, alone, own = batch(model, materials, lambda m, data: [pull_worlds(m, data, s) for s in PATH])
    peak = abs(together).max()
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-9 * peak)
    np.testing.assert_allclose(together, own, rtol=0, atol=1e-6 * peak)  # of models: the solver's tolerance
    assert abs(np.diff(together, axis=1)).max() > 0.05 * peak
    plain = bar(law, element, nu=0.4)
    data = SkinData(plain)
    elastic = [pull(plain, data, s, None) for s in PATH]
    np.testing.assert_allclose(together[:, 0], elastic, rtol=0, atol=1e-6 * peak)


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_directions_in_single_precision(element):
    """The same answer with those of CUDA."""
    model = bar("neo_hookean", element, nu=0.4, hysteresis=BRANCHES)
    data = [SkinData(model, preconditioner=p) for p in ("sparse", "dense")]
    force = np.array([[pull(model, d, s, None) for s in PATH] for d in data])
    np.testing.assert_allclose(force[1], force[0], rtol=0, atol=1e-4 * abs(force).max())


@pytest.mark.law
def test_slip_is_in_the_plugins_state():
    """Pressed and drawn back in mj_step: less force on the way out, and a copy of mjData replays it bit by
    bit."""
    import mujoco

    import biotac_mj

    spec = mujoco.MjSpec.from_string(
        """<mujoco><option timestep="0.02" gravity="0 0 0"/><worldbody><body name="finger"/>
        <body name="ball" mocap="true" pos="0 0 0.0164"><geom type="sphere" size="0.008"/></body>
        </worldbody></mujoco>"""
    )
    material = {"hysteresis": [[1.0, 0.02]], "stiffening": 0.3, "element": "linear"}
    pose = {"pos": [0.0062, 0, 0], "quat": [0.5**0.5, -(0.5**0.5), 0, 0]}  # pad up
    handle = biotac_mj.attach(spec, body="finger", skin="coarse", material=material, readings="none", **pose)
    model = spec.compile()
    data = mujoco.MjData(model)
    force = []
    for down in (1, 2, 3, 4, 3, 2):
        data.mocap_pos[0, 2] = 0.0164 - 2e-4 * down
        mujoco.mj_step(model, data)
        force.append(abs(handle.read(data, "contact_force")[1]))
    assert force[4] < 0.97 * force[2] and force[5] < 0.97 * force[1] and force[1] > 0
    twin = copy.copy(data)
    for _ in range(2):
        mujoco.mj_step(model, data)
        mujoco.mj_step(model, twin)
    np.testing.assert_array_equal(data.plugin_state, twin.plugin_state)
    biotac_mj.plugin.check()


def test_stiffening_alone_has_no_state():
    """A skin that stiffens but does not remember comes to rest as any other."""
    from types import SimpleNamespace

    from biotac_mj.coupling.steppers.fem import FemStepper
    from biotac_mj.geometry import load_skin

    def config(**material):
        return SimpleNamespace(
            material={"element": "linear", **material},
            options={},
            liquid=None,
            coupling="one-way",
            device="cpu",
        )

    plain, stiff = (
        FemStepper(config(**material), load_skin("coarse"), []) for material in ({}, {"stiffening": 0.4})
    )
    assert plain.nstate == stiff.nstate
    state = np.zeros(stiff.nstate)
    stiff.reset(state)
    assert stiff.resting(state)


def test_what_cannot_be_is_refused():
    for hysteresis, text in (
        (((0.1,),), "pass \\(\\(g, strain\\), ...\\)"),
        (((-0.1, 1.0),), "g must be >= 0"),
        (((0.1, 0.0),), "positive"),
    ):
        with pytest.raises(ValueError, match=text):
            Material(hysteresis=hysteresis)
    assert (
        Material(hysteresis=[[0.1, 2]]) == Material(hysteresis=((0.1, 2.0),))
        and Material(hysteresis=((0.1, 2.0),)).remembers
    )
    model = cube("corotational", "linear", hysteresis=BRANCHES)
    other = [dataclasses.replace(model.material, hysteresis=BRANCHES[:1])]
    for materials in (other, [model.material] + other):
        with pytest.raises(ValueError, match="has 1 terms of hysteresis and the model's 2: give it as many"):
            SkinData(model, len(materials), material=materials)
    from biotac_mj.skin.condensed import CondensedSkin

    with pytest.raises(ValueError, match="leave hysteresis out"):
        CondensedSkin(model, NOTHING)
