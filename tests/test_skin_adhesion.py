"""Adhesion inside the contact: work, hysteresis, instability, third law, Maugis and Dugdale's sphere, the
plugin's state."""

import copy

import numpy as np
import pytest
from blocks import boundary, box, faces_on, half_space, place, skin
from scipy.optimize import brentq
from test_skin_contact import pad, plane_at

from biotac_mj.geometry import load_skin
from biotac_mj.skin import (
    ContactLaw,
    GeomSet,
    Material,
    SkinData,
    SkinModel,
    SkinOptions,
    bake_distance_grid,
    step,
)

HEIGHT, AREA, BAR = 4e-3, 1e-4, 1e6 / 4e-3  # of the pad; its stiffness per area at nu = 0 [Pa/m]


def approach(law, gaps, data=None, **options):
    """Force [N] of a plane brought to each of the gaps [m] over the pad, and the data; pull is negative."""
    data = data or SkinData(pad(contact_law=law, **options))
    geoms, force = GeomSet(["plane"], [()]), []
    plane_at(geoms, 0, HEIGHT + gaps[0])
    for gap in gaps:
        plane_at(geoms, 0, HEIGHT + gap)
        step(data.model, data, geoms)
        assert data.converged.all()
        force.append(data.wrench[0, 0, 2])
    return np.array(force), data


def work(force, gaps):
    """Of the pull [J], up to where the plane is let go."""
    return np.trapezoid(np.maximum(-force, 0), gaps)


@pytest.mark.parametrize("hysteresis", [pytest.param(1.0, marks=pytest.mark.slow), 3.0])
def test_pulling_a_flat_punch_off_takes_the_work_of_adhesion(hysteresis):
    """Stable softening, slower than the pad: nothing is lost but W A, on the way in it is gained."""
    W, reach = 0.03, 6e-5
    law = ContactLaw(adhesion=W, adhesion_hysteresis=hysteresis, adhesion_range=reach)
    assert 2 * W * hysteresis / reach**2 < 0.5 * BAR
    down, up = np.linspace(7e-5, -1e-5, 121), np.linspace(-1e-5, 7e-5, 121)
    inward, data = approach(law, down)
    outward, data = approach(law, up, data)
    assert work(inward, down) == pytest.approx(-W * AREA, rel=1e-3)
    assert work(outward, up) == pytest.approx(hysteresis * W * AREA, rel=1e-3)
    # the loop is what parting takes more than joining gave
    loop = -np.trapezoid(inward, down) - np.trapezoid(outward, up)
    assert loop == pytest.approx((hysteresis - 1) * W * AREA, abs=1e-3 * W * AREA)
    assert outward[-1] == 0 and (data.outer.anchor_geom.numpy() == -1).all()
    again, _ = approach(law, down, data)  # out of range all is forgotten
    np.testing.assert_allclose(again, inward, rtol=1e-3, atol=1e-5)


def test_a_short_range_snaps_at_the_peak():
    """Softening faster than the pad: it parts at the peak traction, and what the springs held is lost."""
    W, reach = 0.05, 1e-5
    law, peak = ContactLaw(adhesion=W, adhesion_range=reach), 2 * W / reach
    assert peak / reach > 3 * BAR
    _, data = approach(law, np.linspace(2e-5, -1e-5, 16))
    up = np.linspace(-1e-5, 6e-5, 141)
    force, data = approach(law, up, data)
    stiffness = AREA / (1 / BAR + 1 / data.model.contact_stiffness)
    last = np.flatnonzero(force < 0)[-1]
    assert force.min() == force[last] == pytest.approx(-peak * AREA, rel=0.03)  # to the size of a step
    assert (force[last + 1 :] == 0).all()
    assert work(force[: last + 1], up[: last + 1]) == pytest.approx(
        force[last] ** 2 / (2 * stiffness), rel=0.01
    )
    assert work(force, up) > 3 * W * AREA


def test_adhesion_pulls_before_it_touches():
    """What is out of range is not felt; within, the traction is that of the law at the gap that the pad's
    stretch leaves."""
    W, reach = 0.03, 6e-5
    peak = 2 * W / reach
    gaps = np.array([1.01, 0.99, 0.7, 0.4]) * reach
    force, data = approach(ContactLaw(adhesion=W, adhesion_range=reach), gaps)
    slope = peak / (reach - peak / data.model.contact_stiffness)
    assert force[0] == 0 and (data.outer.anchor_geom.numpy() == -1).all()  # pulled, never touched
    np.testing.assert_allclose(force[1:], -slope * (reach - gaps[1:]) * BAR / (BAR - slope) * AREA, rtol=1e-3)


W, R, E, NU = (
    0.5,
    10e-3,
    1e6,
    0.3,
)  # of the sphere on a half-space; E* and the unit of depth in which JKR's curve is one for all
MODULUS = E / (1 - NU**2)
DEPTH = (np.pi**2 * W**2 * R / MODULUS**2) ** (1 / 3)


def sphere_on_half_space(cells, law, depths):
    """Forces [pi W R] of a sphere at depths [DEPTH] in a fine block, as in `test_skin_contact.hertz`, until
    it has come off."""
    radius = 1.3 * (9 * np.pi * W * R**2 / (2 * MODULUS)) ** (
        1 / 3
    )  # of JKR's contact without load, and a margin
    vert, elem, held, top = half_space(cells, radius, 1.6, 1.9)
    options = SkinOptions(contact_law=law, max_newton=60, max_cg=200)
    data = SkinData(SkinModel(skin(vert, elem, held, outer_face=top), Material("linear", E, NU), options))
    x, y, z = vert[held].T
    rho, G = np.linalg.norm(vert[held], axis=1), E / 2 / (1 + NU)
    side = (-z / rho**3 - (1 - 2 * NU) / (rho * (rho - z))) / (
        4 * np.pi * G
    )  # Johnson, Contact Mechanics, eq. 3.18, for one newton
    follow = np.stack([side * x, side * y, -(z**2 / rho**3 + 2 * (1 - NU) / rho) / (4 * np.pi * G)], 1)
    geoms, forces, F = GeomSet(["sphere"], [(R,)]), [], 0.0
    for d in depths:
        place(data, held, vert[held] + F * follow)
        geoms.set_pose([[0, 0, R - d * DEPTH]])
        step(data.model, data, geoms)
        assert data.converged.all()
        F = data.wrench[0, 0, 2]
        forces.append(F / (np.pi * W * R))
        if F == 0 and any(forces):
            break
    return np.array(forces)


def maugis(tabor):
    """Pull-off of a sphere [pi W R] between DMT (-2) and JKR (-1.5): Pietrement and Troyon (2000) for Maugis'
    theory (1992)."""
    c = 4.04 * (1.157 * tabor) ** 1.4
    return -7 / 4 + (c - 1) / (c + 1) / 4


@pytest.mark.slow  # quick: a punch, and JKR's sphere
@pytest.mark.parametrize("cells, reach, within", [(4, 4e-5, 0.06), (6, 2.45e-5, 0.03)])  # 8 cells: 0.7 %
def test_a_sphere_sticks_as_maugis_says(cells, reach, within):
    path = np.concatenate([np.linspace(-0.9 * reach / DEPTH, 2, 9), np.linspace(2, -3, 61)])
    forces = sphere_on_half_space(cells, ContactLaw(adhesion=W, adhesion_range=reach), path)
    tabor = (R * W**2 / MODULUS**2) ** (1 / 3) * 2 / reach
    assert forces[-1] == 0  # it came off
    assert forces.min() == pytest.approx(maugis(tabor), rel=within)
    assert -2 < forces.min() < -1.45


def jkr(depth):
    """Force of Johnson, Kendall and Roberts' sphere at a depth [pi W R], [DEPTH]: by its contact radius."""
    radius = brentq(lambda a: a**2 / R - np.sqrt(2 * np.pi * a * W / MODULUS) - depth * DEPTH, 1e-4, 1e-2)
    return (4 * MODULUS * radius**3 / (3 * R) - np.sqrt(8 * np.pi * W * MODULUS * radius**3)) / (
        np.pi * W * R
    )


@pytest.mark.slow
def test_adhesion_force_at_a_given_depth_follows_jkr():
    """About pi W R whatever the depth: the pull and what the wider contact bears cancel to first order."""
    path = np.concatenate([np.linspace(-1, 2.5, 15), np.linspace(2.5, 1.25, 6)])
    change = sphere_on_half_space(4, ContactLaw(adhesion=W, adhesion_range=4e-5), path)
    change = (change - np.pad(sphere_on_half_space(4, None, path[2:]), (2, 0)))[
        10:
    ]  # without adhesion it begins at the surface
    hertz = 4 / 3 * MODULUS * np.sqrt(R) * (path[10:] * DEPTH) ** 1.5 / (np.pi * W * R)
    np.testing.assert_allclose(change, [jkr(d) for d in path[10:]] - hertz, atol=0.15)


def test_action_equals_reaction_while_it_sticks():
    vert, elem = box([np.linspace(0, 1e-2, 9), np.linspace(0, 1e-2, 9), np.linspace(0, 4e-3, 4)])
    top = faces_on(vert, boundary(elem), 2, 4e-3)
    law = ContactLaw(adhesion=0.2, adhesion_hysteresis=3.0, friction_exponent=0.3)
    options = SkinOptions(contact_law=law, tolerance=1e-6, max_newton=200, max_cg=200)
    model = SkinModel(
        skin(vert, elem, np.flatnonzero(vert[:, 2] == 0), outer_face=top),
        Material("corotational", 1e6, 0.3),
        options,
    )
    data, geoms = (
        SkinData(model),
        GeomSet(["sphere", "box"], [(3e-3,), (2e-3, 2e-3, 1e-3)], [0.6, 0.3], [0, 1], [0, 5e-4]),
    )
    for k, d in enumerate([1e-5, 2e-4, 3e-4, 1e-4, 2e-5, -1e-5]):
        geoms.set_pose([[2.5e-3 + 2e-5 * k, 3e-3, 7e-3 - d], [7e-3, 7e-3 - 1e-5 * k, 5e-3 - d]])
        step(model, data, geoms)
        assert data.converged.all()
    wrench = data.wrench[0]
    assert (wrench[:, 2] < -1e-3).all()  # both are held
    size, x = np.linalg.norm(wrench[:, :3], axis=1).sum(), data.vert_xpos[0]
    np.testing.assert_allclose(-wrench[:, :3].sum(0), data.contact_force[0].sum(0), atol=1e-12 * size)
    np.testing.assert_allclose(
        -wrench[:, 3:].sum(0), np.cross(x, data.contact_force[0]).sum(0), atol=1e-14 * size
    )
    np.testing.assert_allclose(data.contact_force[0].sum(0) + data.reaction[0], 0, atol=1e-4 * size)


def test_worlds_have_laws_of_their_own():
    gaps = [2e-5, -1e-5, 5e-6, 1.2e-5]
    law = ContactLaw(adhesion=0.05, adhesion_range=3e-5)
    model, geoms = pad(contact_law=law), GeomSet(["plane"], [()], nworld=3)
    data = SkinData(model, 3)
    data.laws.set(adhesion=[0.0, 0.05, 0.02])
    forces = []
    for gap in gaps:
        plane_at(geoms, 0, HEIGHT + gap)
        step(model, data, geoms)
        forces.append(data.wrench[:, 0, 2].copy())
    alone, _ = approach(law, gaps)
    np.testing.assert_allclose(np.array(forces)[:, 1], alone, rtol=1e-4)
    less, _ = approach(ContactLaw(adhesion=0.02, adhesion_range=3e-5), gaps)
    np.testing.assert_allclose(np.array(forces)[:, 2], less, rtol=1e-4, atol=1e-6)
    plain, _ = approach(None, gaps)
    np.testing.assert_allclose(np.array(forces)[:, 0], plain, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(data.laws.range, [0, 3e-5, 3e-5])


def test_a_step_that_finds_no_balance_is_counted():
    """Snapping off with too few iterations: the last good state stays, sticking."""
    model = pad(contact_law=ContactLaw(adhesion=0.05, adhesion_range=1e-5), max_newton=1)
    data, geoms = SkinData(model), GeomSet(["sphere"], [(5e-3,)])
    held = None
    for d in [*np.linspace(-2e-5, 1e-4, 25), *np.linspace(1e-4, -1e-4, 41)]:
        geoms.set_pose([[5e-3, 5e-3, HEIGHT + 5e-3 - d]])
        before = data.wrench.copy()
        step(model, data, geoms)
        if not data.converged[0] and data.load_factor[0] == 0:
            held = before
            np.testing.assert_allclose(data.wrench, held, rtol=1e-9, atol=1e-12)
    assert held is not None and data.nonconverged[0] > 0


def test_default_range_is_what_the_mesh_resolves():
    """sqrt(4 W h / E*): finer faces, a shorter range."""
    ranges = []
    for cells in (6, 12):
        data = SkinData(
            pad(cells=(cells, cells, 3), contact_law=ContactLaw(adhesion=0.1, adhesion_hysteresis=2.0))
        )
        face, vert = data.outer.surface.face_np, data.model.geometry.vert
        edge = np.mean(
            [np.linalg.norm(vert[face[:, a]] - vert[face[:, b]], axis=1) for a, b in ((0, 1), (1, 2), (2, 0))]
        )
        np.testing.assert_allclose(data.laws.range, np.sqrt(4 * 0.2 * edge / 1e6), rtol=1e-12)
        ranges.append(data.laws.range[0])
    assert ranges[1] < 0.75 * ranges[0]


@pytest.mark.parametrize(
    "law, text",
    [
        (dict(adhesion=-0.1), "adhesion is -0.1: give a finite number >= 0 .J/m.2."),
        (dict(adhesion=np.nan), "adhesion is nan: pass a finite number"),
        (dict(adhesion_hysteresis=0.5), "give a finite number >= 1"),
        (dict(adhesion_range=0.0), "adhesion_range is 0.0: give a finite number > 0 .m."),
        (dict(friction_exponent=5.0), "from -1 to 2; 0 is Coulomb's law"),
        (dict(friction_pressure=0.0), "friction_pressure is 0.0: give a finite number > 0 .Pa."),
        (dict(adhesive=1.0), "did you mean 'adhesion'"),
        (0.05, "contact_law is 0.05: pass a ContactLaw, or a dict"),
    ],
)
def test_laws_that_cannot_be_are_refused(law, text):
    with pytest.raises(ValueError, match=text):
        SkinOptions(contact_law=law)


@pytest.mark.slow
def test_what_cannot_be_solved_is_refused():
    with pytest.raises(ValueError, match="is too short for a work of 0.05 J/m\\^2: .* take a range above"):
        SkinData(pad(contact_law=ContactLaw(adhesion=0.05, adhesion_range=1e-7)))
    model = pad(contact_law=ContactLaw(adhesion=0.05))
    from biotac_mj.skin.condensed import CondensedSkin

    with pytest.raises(ValueError, match="knows Coulomb's law alone: leave contact_law out"):
        CondensedSkin(model, GeomSet(["plane"], [()]))
    data = SkinData(model, 2)
    with pytest.raises(ValueError, match="adhesion has shape \\(3,\\): pass one number or \\(2,\\)"):
        data.laws.set(adhesion=[0.1, 0.1, 0.1])
    with pytest.raises(ValueError, match="adhesion is -1.0"):
        data.laws.set(adhesion=[0.1, -1.0])
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2, radius=2e-4)
    fine = GeomSet(["mesh"], [()], grids=[bake_distance_grid(ball.vertices, ball.faces, spacing=3e-5)])
    fine.set_pose([[5e-3, 5e-3, 7e-3]])
    one = SkinData(model)
    with pytest.raises(ValueError, match="the distance to a mesh geom is exact within 12 um"):
        step(model, one, fine)


@pytest.mark.slow  # quick: state of slip and memory in the plugin; punches that are pulled off
def test_sticking_is_in_the_plugins_state():
    """In mj_step, both ways: a light ball hangs on the pad against gravity, which a copy of mjData replays;
    without adhesion it falls."""
    import mujoco

    import biotac_mj

    radius, x = 8e-3, -6.2e-3
    outer = load_skin("coarse").vert[np.unique(load_skin("coarse").outer_face)]
    away = np.hypot(outer[:, 0] - x, outer[:, 2])
    under = (away < radius) & (outer[:, 1] < 0)
    touch = (
        outer[under, 1] - np.sqrt(radius**2 - away[under] ** 2)
    ).min()  # pad down: the BioTac's y is the world's z

    def hang(law, height):
        spec = mujoco.MjSpec.from_string(
            f"""<mujoco><option timestep="0.002"/><worldbody><body name="finger"/>
            <body name="ball" pos="0 0 {touch + height}"><joint type="slide" axis="0 0 1"/>
            <geom type="sphere" size="{radius}" mass="1e-4"/>
            </body></worldbody></mujoco>"""
        )
        pose = {"pos": [-x, 0, 0], "quat": [0.5**0.5, 0.5**0.5, 0, 0]}
        options = {"skin": {"element": "linear", "contact_law": law}}
        handle = biotac_mj.attach(
            spec, body="finger", skin="coarse", liquid=False, readings="none", options=options, **pose
        )
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, 40)
        biotac_mj.plugin.check()
        return model, data, handle

    assert hang(None, 5e-6)[1].qpos[0] < -0.02  # falls
    law = {"adhesion": 0.5, "adhesion_range": 1e-4}
    assert hang(law, -3e-4)[1].qpos[0] < -0.02  # out of range
    model, data, handle = hang(law, -2e-5)  # starts off the skin: it has to be pulled up
    assert 0 < data.qpos[0] < 2e-4 and handle.read(data, "status")[1] == 0
    mujoco.mj_step(model, data, 100)
    assert handle.read(data, "contact_force")[1] == pytest.approx(
        -1e-4 * 9.81, rel=0.02
    )  # pulls the BioTac along -y, by the ball's weight
    twin = copy.copy(data)
    mujoco.mj_step(model, data, 3)
    mujoco.mj_step(model, twin, 3)
    np.testing.assert_array_equal(data.plugin_state, twin.plugin_state)
    biotac_mj.plugin.check()
