"""Rubber that is not the same everywhere: a factor on Young's modulus for every element."""

import numpy as np
import pytest
from bars import AREA, LENGTH, E, bar, batch, cube, deform, pull, pull_worlds
from blocks import box, skin
from forces import Elements
from grids import covering

from biotac_mj.geometry.edge_nodes import with_edge_nodes
from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, step
from biotac_mj.skin.rubber.law import LAWS
from biotac_mj.skin.types import SINGLE


def halves(p):
    """Three times as stiff where the bar is moved."""
    return np.where(p[:, 0] < LENGTH / 2, 1.0, 3.0)


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_two_moduli_in_series(element):
    """nu = 0: k = 1 / (L1 / (E1 A) + L2 / (E2 A)), and in large strain of svk the stretches that bear the
    same force."""
    model = bar("linear", element, modulus=halves)
    force = pull(model, SkinData(model), 1.3, None)
    assert force == pytest.approx(0.3 * E * AREA * 2 / (1 + 1 / 3), rel=1e-6)
    model = bar("svk", element, modulus=halves)
    data = SkinData(model)
    force = pull(model, data, 1.3, None)
    middle = data.vert_xpos[0, np.isclose(model.geometry.vert[:, 0], LENGTH / 2), 0]
    assert np.ptp(middle) < 1e-7 * LENGTH
    soft = middle.mean() / (LENGTH / 2)
    for stretch, factor in ((soft, 1), (2.6 - soft, 3)):
        assert force == pytest.approx(factor * E * stretch * (stretch**2 - 1) / 2 * AREA, rel=1e-5)
    cauchy = data.stress()[0][0, :, 0, 0]
    sides = halves(model.geometry.vert[model._elem[:, :4]].mean(1))
    for side in (1, 3):  # no lateral strain at nu = 0: first Piola and Cauchy stress are the same
        np.testing.assert_allclose(cauchy[sides == side], force / AREA, rtol=1e-4)


@pytest.mark.parametrize("element, law", covering(["linear", "quadratic"], LAWS))
def test_one_factor_for_all_is_another_modulus(law, element):
    """One: the same bits. Two: the stress of twice E, with memory, softening (in energy), friction and
    stiffening in place."""
    F = np.eye(3) + 0.1 * np.random.default_rng(1).standard_normal((3, 3))
    plain, one = cube(law, element), cube(law, element, modulus=lambda p: np.ones(len(p)))
    np.testing.assert_array_equal(
        deform(one, SkinData(one), F, None), deform(plain, SkinData(plain), F, None)
    )
    more = {
        "prony": ((0.3, 0.5),),
        "mullins": (2.0, 2e3, 0.2),
        "hysteresis": ((0.5, 0.03),),
        "stiffening": 0.6,
    }
    stress = []
    for model in (
        cube(law, element, modulus=np.full(48, 2.0), **more),
        cube(law, element, young=2 * E, **more),
    ):
        data = SkinData(model)
        stress.append(
            [deform(model, data, np.eye(3) + share * (F - np.eye(3)), 0.1) for share in (1.0, 0.4, 0.7)]
        )
    np.testing.assert_allclose(stress[0], stress[1], rtol=1e-10, atol=1e-10 * np.abs(stress).max())


@pytest.mark.law
@pytest.mark.parametrize("element, law", covering(["linear", "quadratic"], ["corotational", "neo_hookean"]))
def test_the_tangent_is_the_forces_derivative(law, element):
    rng = np.random.default_rng(3)
    model = cube(law, element, nu=0.49, modulus=lambda p: rng.uniform(0.3, 3, len(p)))
    data, rest = SkinData(model), model.geometry.vert
    x = rest @ (np.eye(3) + 0.1 * rng.standard_normal((3, 3))).T + 2e-4 * rng.standard_normal(rest.shape)
    p = 1e-4 * rng.standard_normal(rest.shape)

    elements = Elements(data)

    def force(h):
        return elements.force(x + h * p)

    h = 1e-3
    expected = -(8 * (force(h) - force(-h)) - (force(2 * h) - force(-2 * h))) / (12 * h)
    force(0.0)
    product = elements.product(p)
    np.testing.assert_allclose(product, expected, atol=2e-7 * abs(expected).max())
    single = Elements(data, SINGLE)
    single.force(x)
    np.testing.assert_allclose(single.product(p), product, rtol=0, atol=1e-5 * abs(product).max())
    # the factor that preconditions is that of the same rubber
    elements.force(rest)
    K = model.elements.rest_stiffness(model.material.mu, model.material.lame)
    np.testing.assert_allclose(
        elements.product(p), (K @ p.ravel()).reshape(-1, 3), atol=1e-9 * abs(K @ p.ravel()).max()
    )


def slab(**kw):
    vert, elem = box([np.linspace(0, 1.2e-2, 7), np.linspace(0, 4e-3, 3), np.linspace(0, 6e-3, 4)])
    options = SkinOptions(element=kw.pop("element", "quadratic"), liquid=False, tolerance=1e-5)
    return SkinModel(
        skin(vert, elem, np.flatnonzero(vert[:, 1] == 0)), Material("corotational", E, 0.4), options, **kw
    )


def pressed(model, x):
    """Force of a ball pressed 0.4 mm into the slab at x [N], and the iterations it took."""
    data, ball = SkinData(model), GeomSet(["sphere"], [(3e-3, 0, 0)])
    count = 0
    for depth in (0.0, 0.2e-3, 0.4e-3):
        ball.set_pose(np.array([[x, 7e-3 - depth, 3e-3]]), np.eye(3)[None])
        step(model, data, ball)
        assert data.converged[0]
        count += data.iterations[0]
    return data.wrench[0, 0, 1], count


def test_a_ball_feels_the_modulus_below_it():
    """A modulus that rises along x by 1/cm: the ball feels that of its place, as the reduced form says, in as
    many iterations."""
    field = lambda p: 1 + 100 * (p[:, 0] - 6e-3)  # noqa: E731
    even, uneven = slab(), slab(modulus=field)
    for x in (3e-3, 6e-3, 9e-3):
        (plain, few), (force, count) = pressed(even, x), pressed(uneven, x)
        assert force / plain == pytest.approx(1 + 100 * (x - 6e-3), rel=0.03), x
        assert count <= few + 2


@pytest.mark.parametrize("element, law", covering(["linear", "quadratic"], ["corotational", "neo_hookean"]))
def test_worlds_have_each_their_own(law, element):
    """Beside materials of their own, in all their numbers."""
    more = [
        dict(prony=((0.3, 0.5),), mullins=(2.0, 2e3, 0.2), hysteresis=((0.5, 0.03),), stiffening=0.6),
        dict(prony=((0.9, 0.1),), mullins=(1.3, 5e2, 0.0), hysteresis=((0.1, 0.01),), stiffening=-0.3),
        dict(prony=((0.0, 1.0),), mullins=None, hysteresis=((0.0, 1.0),), stiffening=0.0),
    ]
    model = bar(law, element, nu=0.4, modulus=lambda p: np.ones(len(p)), **more[0])
    materials = [
        Material(law, young, nu, **m) for young, nu, m in zip((E, 2 * E, 0.7 * E), (0.4, 0.3, 0.45), more)
    ]
    modulus = np.random.default_rng(4).uniform(0.8, 1.25, (3, model.nelem))
    path = ((1.05, 0.1), (1.1, 0.05), (1.1, 0.4), (1.07, 0.1))
    together, alone, own = batch(
        model, materials, lambda m, data: [pull_worlds(m, data, *where) for where in path], modulus
    )
    peak = abs(together).max()
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-9 * peak)
    np.testing.assert_allclose(together, own, rtol=0, atol=1e-6 * peak)  # of models: the solver's tolerance
    plain = bar(law, element, nu=0.45, young=0.7 * E, modulus=modulus[2])
    data = SkinData(plain)
    elastic = [pull(plain, data, *where) for where in path]
    np.testing.assert_allclose(together[:, 2], elastic, rtol=0, atol=1e-6 * peak)


@pytest.mark.parametrize("law", ["neo_hookean", "corotational"])
def test_directions_in_single_precision(law):
    """The same answer with those of CUDA."""
    model = bar(law, "quadratic", nu=0.4, modulus=halves)
    data = [SkinData(model, preconditioner=p) for p in ("sparse", "dense")]
    force = np.array([[pull(model, d, s, None) for s in (1.05, 1.1, 1.07)] for d in data])
    np.testing.assert_allclose(force[1], force[0], rtol=0, atol=1e-4 * abs(force).max())


def test_inertia_is_not_scaled():
    one, two = slab(), slab(modulus=lambda p: np.full(len(p), 2.0))
    np.testing.assert_array_equal(one.elements.node_volume, two.elements.node_volume)


@pytest.mark.parametrize("element, parts", [("quadratic", 1), ("linear", 8)])
def test_elements_of_a_ten_node_geometry_keep_their_factors(element, parts):
    vert, elem = box([np.linspace(0, 1e-2, 3)] * 3)
    geometry = with_edge_nodes(skin(vert, elem, np.flatnonzero(vert[:, 0] == 0)))
    factor = np.random.default_rng(2).uniform(0.5, 2, len(elem))
    model = SkinModel(geometry, Material(), SkinOptions(element=element), modulus=factor)
    assert model.nelem == parts * len(elem)
    at = geometry.vert[model._elem[:, :4]].mean(1)
    home = [
        np.argmin(np.linalg.norm(vert[elem].mean(1) - p, axis=1)) for p in at.reshape(-1, parts, 3).mean(1)
    ]
    np.testing.assert_array_equal(
        model.modulus.reshape(-1, parts), np.repeat(factor[home], parts).reshape(-1, parts)
    )


def test_what_cannot_be_is_refused():
    with pytest.raises(
        ValueError,
        match=r"modulus has shape \(3,\): give one factor for each of the 48 elements of .*, shape \(48,\)",
    ):
        cube("linear", "linear", modulus=[1, 2, 3])
    with pytest.raises(
        ValueError, match=r"modulus has shape \(\): give one factor for each of the 48 positions"
    ):
        cube("linear", "linear", modulus=lambda p: 2.0)
    for bad in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(
            ValueError, match="1 of the 48 factors of modulus are not positive finite numbers"
        ):
            cube("linear", "linear", modulus=np.r_[bad, np.ones(47)])
    model = cube("corotational", "linear", modulus=np.full(48, 2.0))
    with pytest.raises(ValueError, match="modulus of their own and the model has none: make it with modulus"):
        SkinData(cube("corotational", "linear"), modulus=np.ones((1, 48)))
    for bad in (np.ones(48), np.ones((2, 48)), np.full((1, 48), np.nan), np.zeros((1, 48))):
        with pytest.raises(ValueError, match=r"pass positive factors of shape \(1, 48\)"):
            SkinData(model, modulus=bad)
