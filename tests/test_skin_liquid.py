"""The liquid against closed forms: volume, its gradient, its pressure inside an elastic sphere."""

import dataclasses

import numpy as np
import pytest
import trimesh
from blocks import boundary, nodal_areas, place, shell, skin

from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, liquid, prepare_step, step

TIGHT = dict(max_newton=200, max_cg=200)
DOWN = np.diag([1.0, -1.0, -1.0])


def sphere(law="neo_hookean", E=2.8e5, nu=0.45, bulk=2.2e9, filled=True, core=None, tolerance=1e-4):
    """A rubber ball of 10 mm radius with a cavity of 8 mm, glued to the ground by its lower pole."""
    vert, elem, inner = shell(10e-3, 8e-3, subdivisions=2, layers=2)
    geometry = skin(vert, elem, np.flatnonzero(vert[:, 2] < -8.5e-3), inner_face=inner, core=core)
    return SkinModel(
        geometry,
        Material(law, E, nu),
        SkinOptions(liquid=filled, bulk_modulus=bulk, tolerance=tolerance, **TIGHT),
    )


def press(model, depths):
    """Presses a plane from above; yields the data after each depth."""
    data, geoms = SkinData(model), GeomSet(["plane"], [()])
    for depth in depths:
        geoms.set_pose([[0, 0, 10e-3 - depth]], [DOWN])
        step(model, data, geoms)
        assert data.converged.all()
        yield data


def cavity(model, x):
    """Volume that the inner surface encloses, by trimesh."""
    return trimesh.Trimesh(x, model.geometry.inner_face[:, ::-1], process=False).volume


def test_rest_volume_is_cavity_less_core():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=5e-3)
    model = sphere()
    assert model.liquid_volume == pytest.approx(cavity(model, model.geometry.vert), rel=1e-12)
    with_core = sphere(core=(ball.vertices, ball.faces))
    assert with_core.liquid_volume == pytest.approx(model.liquid_volume - ball.volume, rel=1e-12)


def test_gradient_of_the_volume():
    model = sphere()
    rng = np.random.default_rng(0)
    x = model.geometry.vert + 5e-4 * rng.standard_normal((model.nvert, 3))
    p = rng.standard_normal(x.shape)
    gradient = liquid.volume_gradient(x, model.geometry.inner_face)
    near, far = [cavity(model, x + h * p) - cavity(model, x - h * p) for h in (1e-6, 2e-6)]
    assert np.vdot(gradient, p) == pytest.approx(
        (8 * near - far) / 12e-6, rel=1e-8
    )  # exact: the volume is cubic
    assert (
        abs(gradient.sum(0)).max() < 1e-12 * abs(gradient).sum()
    )  # a closed surface has no area vector: the pressure moves nothing


def test_volume_is_conserved_and_gives_the_pressure():
    """Pressed by a seventh of its height, the filled ball keeps its volume; the empty one does not."""
    model, K = sphere(), 2.2e9
    v0 = model.liquid_volume
    for data in press(model, np.linspace(0, 3e-3, 11)[1:]):
        change = cavity(model, data.vert_xpos[0]) / v0 - 1
        assert data.volume[0] == pytest.approx(v0 * (1 + change), rel=1e-12)
        assert abs(change) < 1e-5
        # a relative change of 1e-6 keeps ten digits of the sixteen
        assert data.pressure[0] == pytest.approx(-K * change, rel=1e-6)
    assert data.pressure[0] > 1e3
    *_, empty = press(sphere(filled=False), np.linspace(0, 3e-3, 11)[1:])
    assert cavity(model, empty.vert_xpos[0]) / v0 - 1 < -0.02
    assert data.wrench[0, 0, 2] > 1.05 * empty.wrench[0, 0, 2]
    equator = abs(model.geometry.vert[:, 2]) < 3e-3
    bulge = np.linalg.norm(data.vert_xpos[0, equator, :2], axis=1) - np.linalg.norm(
        model.geometry.vert[equator, :2], axis=1
    )
    assert bulge.mean() > 1e-4  # what is pressed away comes out at the side


@pytest.mark.parametrize("kind", ["sparse", "dense"])
def test_a_pressure_that_is_mended_is_that_of_the_skin(kind, monkeypatch):
    """The last step of Newton's method leads to a pressure, and the volume is brought there without it:
    forces and volume there are what they are said to be, and the pressure is right."""

    def pressures(tolerance):
        model = sphere(tolerance=tolerance)
        data, geoms = SkinData(model, preconditioner=kind), GeomSet(["plane"], [()])
        mended, found = 0, []
        for depth in np.linspace(0, 3e-3, 16)[1:]:
            geoms.set_pose([[0, 0, 10e-3 - depth]], [DOWN])
            step(model, data, geoms)
            assert data.converged.all()
            now, force, volume = data.pressure[0], data.force.numpy().copy(), data.volume[0]
            mended += data.worlds.pressure_correction.numpy()[0] != 0
            assert volume == pytest.approx(cavity(model, data.vert_xpos[0]), rel=1e-12)
            prepare_step(model, data, geoms).evaluate_forces()
            assert data.pressure[0] == pytest.approx(now, rel=1e-3)
            np.testing.assert_allclose(data.force.numpy(), force, atol=2e-3 * abs(force).max())
            found.append(now)
        return mended, np.array(found)

    mended, loose = pressures(1e-3)
    assert mended > 0
    np.testing.assert_allclose(loose, pressures(1e-7)[1], rtol=2e-2, atol=1.0)


@pytest.mark.parametrize("bulk", [pytest.param(1e5, marks=pytest.mark.slow), 2e6])
def test_filled_sphere_under_outer_pressure(bulk):
    """Lame's thick sphere under p_o outside and the liquid's -3 K u(a) / a inside, both scalar."""
    a, b, E, nu, outer = 6e-3, 10e-3, 1e6, 0.3, 1e3
    radial = (1 - 2 * nu) * a / (E * (b**3 - a**3)), (1 + nu) * a * b**3 / (2 * E * (b**3 - a**3))
    # u(a) = p_i (a^3 s + t) - p_o (b^3 s + t): Timoshenko and Goodier, section 136
    by_inner, by_outer = radial[0] * a**3 + radial[1], radial[0] * b**3 + radial[1]
    inner_pressure = 3 * bulk / a * by_outer * outer / (1 + 3 * bulk / a * by_inner)

    def displacement(r):
        s = (1 - 2 * nu) * r / (E * (b**3 - a**3))
        t = (1 + nu) * a**3 * b**3 / (2 * E * (b**3 - a**3) * r**2)
        return inner_pressure * (a**3 * s + t) - outer * (b**3 * s + t)

    vert, elem, inner = shell(b, a, subdivisions=3, layers=5)
    held = [np.linalg.norm(vert - b * axis, axis=1).argmin() for axis in np.eye(3)]
    geometry = skin(vert, elem, held, inner_face=inner)
    model = SkinModel(
        geometry,
        Material("linear", E, nu),
        SkinOptions(liquid=True, bulk_modulus=bulk, tolerance=1e-5, **TIGHT),
    )
    data = SkinData(model)
    place(data, held, vert[held] * (1 + displacement(b) / b))
    surface = boundary(elem)
    surface = surface[np.linalg.norm(vert[surface].mean(1), axis=1) > (a + b) / 2]
    data.set_external((-outer * nodal_areas(vert, surface)[:, None] * vert / b)[None])
    step(model, data, GeomSet([], []))
    assert data.converged.all()
    # facets (the polyhedron's area lacks 1 %) and five layers: per cent; 3 % as for the empty sphere
    assert data.pressure[0] == pytest.approx(inner_pressure, rel=0.03)


@pytest.mark.parametrize("taken_out", [1e-7, 2e-7])
def test_light_touch_of_a_skin_that_has_lost_liquid(taken_out):
    """Pressure above rest is what the sensor reads; it is some kilopascals below the surroundings' there."""

    def pressure(tolerance):
        model = sphere(tolerance=tolerance)
        options = dataclasses.replace(model.options, fill_volume=-taken_out)
        model = SkinModel(model.geometry, model.material, options)
        assert model.rest.pressure < -3e3
        top = 10e-3 - model.rest.vert[:, 2].max()
        return [data.pressure[0] for data in press(model, top + np.array([4e-5, 1e-4, 2e-4]))][-1]

    exact = pressure(1e-6)
    assert 20 < exact < 100
    assert pressure(1e-3) == pytest.approx(exact, rel=0.03)


def test_pressure_stays_where_nothing_moves():
    """Of a liquid that keeps its volume: pressure is an unknown, found step by step."""
    held = [data.pressure[0] for data in press(sphere(bulk=np.inf, tolerance=1e-3), [3e-4] + 10 * [6e-4])]
    assert held[0] < 100 < 200 < held[1]
    assert held[4:] == [held[4]] * 7
    assert held[4] == pytest.approx(held[1], rel=0.02)


def test_core_that_does_not_fit():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=9e-3)
    text = (
        r"the core \(\d+ mm\^3\) does not fit into the cavity \(\d+ mm\^3\): check the meshes' frames "
        r"and units"
    )
    with pytest.raises(ValueError, match=text):
        sphere(core=(ball.vertices, ball.faces))
