"""Contact against Hertz, Coulomb and Newton's third law."""

import numpy as np
import pytest
import warp as wp
from blocks import boundary, box, faces_on, half_space, place, shell, skin
from grids import covering

from biotac_mj.geometry.surface import face_areas, node_areas, pressure_area
from biotac_mj.skin import ContactLaw, GeomSet, Material, SkinData, SkinModel, SkinOptions, prepare_step, step
from biotac_mj.skin.contact.faces import face_samples
from biotac_mj.skin.contact.meshes import bake_distance_grid
from biotac_mj.skin.contact.touch import CONSISTENT, CURRENT, LAGGED, RECORDED
from biotac_mj.skin.touched import Touched

DOWN = np.diag([1.0, -1.0, -1.0])  # a plane that faces -z
TIGHT = dict(max_newton=200, max_cg=200)


def pad(law="linear", nu=0.0, E=1e6, cells=(6, 6, 3), size=(1e-2, 1e-2, 4e-3), **options):
    """A pad of 10 x 10 x 4 mm, held at z = 0, to be touched from above."""
    vert, elem = box([np.linspace(0, s, n + 1) for s, n in zip(size, cells)], jitter=0.2)
    geometry = skin(
        vert,
        elem,
        np.flatnonzero(vert[:, 2] == 0),
        outer_face=faces_on(vert, boundary(elem), 2, size[2]),
        name="pad",
    )
    return SkinModel(geometry, Material(law, E, nu), SkinOptions(**{**TIGHT, "tolerance": 1e-6, **options}))


def plane_at(geoms, x, z, mat=DOWN, y=0.0):
    geoms.set_pose([[x, y, z]], [mat])


# --- normal contact  ---


def test_plane_on_a_pad_is_two_springs_in_series():
    """nu = 0: the pad is a bar of E / h, the contact a layer of springs k: pressure = d / (h / E + 1 / k)."""
    model, h, depth = pad(), 4e-3, 5e-5
    data, geoms = SkinData(model), GeomSet(["plane"], [()])
    plane_at(geoms, 0, h - depth)
    step(model, data, geoms)
    expected = depth / (h / 1e6 + 1 / model.contact_stiffness) * 1e-4
    np.testing.assert_allclose(data.wrench[0, 0, :3], [0, 0, expected], rtol=1e-5, atol=1e-5 * expected)
    np.testing.assert_allclose(
        data.wrench[0, 0, 3:], np.cross([5e-3, 5e-3, h], [0, 0, expected]), rtol=2e-2, atol=1e-6 * expected
    )


def hertz_force(d, R, E, nu):
    return 4 / 3 * E / (1 - nu**2) * np.sqrt(R) * d**1.5


def hertz(cells, depths, R=10e-3, E=1e6, nu=0.3, k=40 * 180e3):
    """Forces and contact areas (by touched faces, by pressed nodes) of a sphere on a block with `cells` cells
    per contact radius under the sphere, coarser away from it.

    The block is cut out of the half-space 4.5 contact radii away: sides and bottom go where the half-space's
    points go under Hertz's force at one point (the spread of the load matters less than 0.5 % there). Contact
    springs 40 times stiffer than usual give way by 0.1 %."""
    radius = np.sqrt(R * depths[-1])
    vert, elem, held, top = half_space(cells, radius, 1.3, 1.5)
    options = SkinOptions(tolerance=1e-3, contact_stiffness=k * E, **TIGHT)
    data = SkinData(SkinModel(skin(vert, elem, held, outer_face=top), Material("linear", E, nu), options))
    geoms = GeomSet(["sphere"], [(R,)])
    forces, areas, touched = [], [], Touched(data, np.array([0]), 1)
    none = wp.zeros((1, 1), dtype=wp.spatial_vectord), wp.zeros((1, 1), dtype=wp.spatial_matrixd)
    for d in depths:
        x, y, z = vert[held].T
        rho, F, G = np.linalg.norm(vert[held], axis=1), hertz_force(d, R, E, nu), E / 2 / (1 + nu)
        # Johnson, Contact Mechanics, eq. 3.18, for a load along -z on the half-space z < 0
        lateral_share = F / (4 * np.pi * G) * (-z / rho**3 - (1 - 2 * nu) / (rho * (rho - z)))
        u = np.stack(
            [
                lateral_share * x,
                lateral_share * y,
                -F / (4 * np.pi * G) * (z**2 / rho**3 + 2 * (1 - nu) / rho),
            ],
            1,
        )
        place(data, held, vert[held] + u)
        geoms.set_pose([[0, 0, R - d]])
        step(data.model, data, geoms)
        assert data.converged.all()
        forces.append(data.wrench[0, 0, 2])
        touched.end(*none)
        nodes = np.unique(top)
        share = node_areas(top, np.linalg.norm(face_areas(vert, top), axis=1), len(vert))[nodes]
        pressed = pressure_area(np.linalg.norm(data.contact_force[:, nodes], axis=2), share)[0]
        areas.append([touched.area.numpy()[0, 0], pressed])
    return np.array(forces), np.array(areas)


@pytest.mark.law
@pytest.mark.parametrize(
    "cells, largest", [((2, 3), 0.2), pytest.param((4, 6), 0.06, marks=pytest.mark.slow)]
)
def test_forces_on_a_sphere_come_to_those_of_hertz(cells, largest):
    """From the stiff side, with order 1.5 or better: the contact's edge falls between nodes."""
    depths = np.array([30e-6, 60e-6])  # contact radii of 0.55 and 0.77 mm; `cells` are per 0.77 mm
    exact = hertz_force(depths, 10e-3, 1e6, 0.3)
    forces, areas = (np.array(both) for both in zip(*(hertz(n, depths) for n in cells)))
    np.testing.assert_allclose(areas[1] / (np.pi * 10e-3 * depths[:, None]), 1, atol=0.1)
    errors = forces / exact - 1
    assert (errors[1] > 0).all() and (errors[1] < largest).all(), errors
    ratio = cells[1] / cells[0]
    assert (errors[0] > errors[1] * ratio).all()  # at least first order
    assert np.log2(forces[1, 1] / forces[1, 0]) == pytest.approx(1.5, abs=0.05)
    if largest < 0.1:
        limit = (errors[1] * ratio**1.5 - errors[0]) / (ratio**1.5 - 1)
        assert (abs(limit) < 0.02).all(), limit


# --- friction  ---


def slide(model, geoms, depth, path):
    """Tangential and normal force on a plane pressed in by `depth` and moved along x to each of `path`; the
    data."""
    data, h, forces = SkinData(model), 4e-3, []
    plane_at(geoms, 0, h + 1e-6)
    step(model, data, geoms)
    for x in path:
        plane_at(geoms, x, h - depth)
        step(model, data, geoms)
        assert data.converged.all()
        assert_cone(model, data, geoms, 0.5)
        forces.append(data.wrench[0, 0, [0, 2]])
    return np.array(forces), data


def assert_cone(model, data, geoms, mu):
    """No sample pulls, and none pushes sideways with more than mu times its normal force."""
    force = data.outer.sample_force.numpy()[:, 0][data.outer.trial_geom.numpy()[:, 0] >= 0]
    assert len(force)
    normal = -force[:, 2]  # the plane faces down
    assert (normal >= 0).all()
    assert (np.linalg.norm(force[:, :2], axis=1) <= mu * normal * (1 + 1e-9) + 1e-15).all()


def test_sticks_then_slips_at_mu():
    """The share of tangential in normal force grows with the drag up to mu, then stays."""
    mu, depth = 0.5, 1e-4
    geoms = GeomSet(["plane"], [()], friction=[mu])
    path = np.concatenate([[0], np.linspace(0, 4e-4, 21)[1:]])
    forces, _ = slide(pad(nu=0.3), geoms, depth, path)
    ratio = -forces[:, 0] / forces[:, 1]
    assert abs(ratio[0]) < 1e-2
    assert (np.diff(ratio) > -1e-6).all() and ratio.max() < mu * (1 + 1e-6)
    # simple shear until slip: G A / h with the stick's springs in series, edges slip a little
    assert ratio[2] < mu * 0.4
    np.testing.assert_allclose(ratio[-5:], mu, rtol=1e-2)
    assert np.ptp(ratio[-5:]) < 1e-3


def test_sticking_is_reversible():
    """No creep inside the cone: back where it came from, the drag is gone; along the way it is linear."""
    geoms = GeomSet(["plane"], [()], friction=[0.5])
    path = 1e-6 * np.array([0, 4, 8, 8, 8, 8, 4, 0])
    forces, _ = slide(pad(), geoms, 1e-4, path)
    tangential = -forces[:, 0]
    np.testing.assert_allclose(tangential, tangential[2] * path / 8e-6, atol=1e-4 * tangential[2])
    G, A, h = 0.5e6, 1e-4, 4e-3
    assert (
        0.8 * G * A / h < tangential[2] / 8e-6 < G * A / h
    )  # a bit softer than simple shear, as the sides are free


def test_frictionless_sliding_has_no_drag():
    geoms = GeomSet(["plane"], [()], friction=[0.0])
    data, model = None, pad(nu=0.3, law="corotational")
    data = SkinData(model)
    for x in np.linspace(0, 2e-3, 6):
        plane_at(geoms, x, 4e-3 - 2e-4)
        step(model, data, geoms)
        assert data.converged.all()
        assert data.wrench[0, 0, 2] > 1
        assert abs(data.wrench[0, 0, :2]).max() < 1e-12 * data.wrench[0, 0, 2]  # normals of a plane are exact


def test_slip_follows_the_drag():
    """After a turn by 90 degrees the drag turns with the motion."""
    mu, h = 0.5, 4e-3
    geoms, model = GeomSet(["plane"], [()], friction=[mu]), pad(nu=0.3)
    data = SkinData(model)
    for x, y in [*[(s, 0) for s in np.linspace(0, 4e-4, 9)], *[(4e-4, s) for s in np.linspace(0, 2e-3, 21)]]:
        plane_at(geoms, x, h - 1e-4, y=y)
        step(model, data, geoms)
        assert_cone(model, data, geoms, mu)
    force = data.wrench[0, 0]
    assert force[1] == pytest.approx(-mu * force[2], rel=1e-2)
    assert abs(force[0]) < 0.05 * mu * force[2]


def weigh(angle, mu, weight=1.0, iterations=60):
    """Puts a rigid slab of `weight` on the pad, gravity leaning by `angle`: whether the pad holds it, and
    where (x, z) it comes to rest.

    The slab's position follows from the balance of forces by Newton's method with the skin's own tangent.
    """
    model, h = pad(nu=0.3, E=1e6), 4e-3
    data, geoms = SkinData(model), GeomSet(["plane"], [()], friction=[mu])
    position, target = np.array([0.0, h - 1e-5]), None
    for k in range(iterations):
        plane_at(geoms, position[0], position[1])
        step(model, data, geoms)
        share = min(1.0, (k + 1) / 10)  # gravity turns bit by bit
        target = weight * np.array([-np.sin(share * angle), np.cos(share * angle)])
        missing = data.wrench[0, 0, [0, 2]] - target
        if share == 1 and np.linalg.norm(missing) < 1e-4 * weight:
            return True, position
        tangent = data.tangent(geoms)[0, 0][np.ix_([0, 2], [0, 2])]
        move = np.linalg.solve(tangent + 1e-3 * tangent[1, 1] * np.eye(2), missing)
        position = position + np.clip(move, -1e-4, 1e-4)
    return False, position


@pytest.mark.parametrize("mu", [0.3, pytest.param(0.8, marks=pytest.mark.slow)])
def test_slab_on_an_incline(mu):
    """Sticks below, slips above tan(angle) = mu: found within one per cent."""
    held, rest = weigh(np.arctan(0.99 * mu), mu)
    assert held and 0 < rest[0] < 5e-4
    held, gone = weigh(np.arctan(1.01 * mu), mu)
    assert not held and gone[0] > 5e-4


# --- balance and tangent  ---


@pytest.mark.law
@pytest.mark.parametrize("law, with_core", covering(["linear", "corotational", "neo_hookean"], [False, True]))
def test_action_equals_reaction(law, with_core):
    """Force and torque of geom, core and held nodes on the skin cancel."""
    import trimesh

    vert, elem, inner = shell(10e-3, 8e-3, subdivisions=2, layers=2)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=7e-3)
    core = (ball.vertices, ball.faces) if with_core else None
    geometry = skin(vert, elem, np.flatnonzero(vert[:, 2] < -6e-3), inner_face=inner, core=core)
    model = SkinModel(
        geometry, Material(law, 1e6, 0.3), SkinOptions(liquid=with_core, tolerance=1e-6, **TIGHT)
    )
    data = SkinData(model)
    geoms = GeomSet(
        ["sphere", "box"],
        [(3e-3,), (2e-3, 2e-3, 2e-3)],
        friction=[0.6, 0.3],
        groups=[0, 1],
        rounding=[0, 1e-3],
    )
    for k in range(8):
        d = 2.5e-4 * (k + 1)
        geoms.set_pose([[1e-4 * k, 0, 13e-3 - d], [12e-3 - d / 2, 0, 1e-3]])
        step(model, data, geoms)
        assert data.converged.all()
    on_skin = (
        data.contact_force[0] + data.core_force[0] + data.liquid_force[0]
    )  # the liquid's has no sum but where skin lies on the core
    x, held = data.vert_xpos[0], model.fixed
    holding = -data.force.numpy()[held, 0]
    size = np.linalg.norm(data.wrench[0, :, :3], axis=1).sum()
    assert (np.linalg.norm(data.core_force[0].sum(0)) > 0.05 * size) == with_core
    # 1e-4 of F is what the facts ask for; the solver's tolerance is 1e-6 in energy
    np.testing.assert_allclose(-data.wrench[0, :, :3].sum(0), data.contact_force[0].sum(0), atol=1e-12 * size)
    np.testing.assert_allclose(
        -data.wrench[0, :, 3:].sum(0), np.cross(x, data.contact_force[0]).sum(0), atol=1e-14 * size
    )
    np.testing.assert_allclose(data.reaction[0], holding.sum(0))
    np.testing.assert_allclose(on_skin.sum(0) + data.reaction[0], 0, atol=1e-4 * size)
    if law != "linear":
        torque = np.cross(x, on_skin).sum(0) + np.cross(x[held], holding).sum(0)
        np.testing.assert_allclose(torque, 0, atol=1e-4 * size * 1e-2)


def evaluate(model, data, geoms, x):
    """Nodal contact forces at positions x with what the last step left, and their tangent as a product."""
    here = prepare_step(model, data, geoms)
    data.x.assign(x[:, None])
    here.evaluate_forces()

    def product(p):
        touching, p = data.outer.touching.numpy().copy(), p[:, None]
        total = here.multiply_tangent(p)
        data.outer.touching.zero_()
        rest = here.multiply_tangent(p)  # of the rubber
        data.outer.touching.assign(touching)
        return (total - rest)[:, 0]

    return data.contact_force[0], product


@pytest.mark.law
@pytest.mark.parametrize("mode", ["frictionless", "stick", "slip", "coupled"])
def test_the_contact_tangent_is_the_forces_derivative(mode):
    """The blocks are minus the derivative of the forces; where slipping, by tangential moves only (the normal
    force is lagged there), unless slip is coupled to the push, as in steps that were too long."""
    h, mu = 4e-3, {"frictionless": 0.0, "stick": 5.0, "slip": 0.1, "coupled": 0.1}[mode]
    angle = 0.2
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    model, geoms = pad(nu=0.3, law="corotational"), GeomSet(["plane"], [()], friction=[mu])
    data = SkinData(model)
    mat = turn @ DOWN
    for s in np.linspace(0, 3e-4, 4):
        plane_at(geoms, 1e-2 - s, h, mat)  # the plane's foot stands on the pad's edge
        step(model, data, geoms)
    assert data.wrench[0, 0, 2] > 0.1
    x = data.vert_xpos[0]
    rng = np.random.default_rng(0)
    p = rng.standard_normal(x.shape)
    normal = mat[:, 2]
    if mode == "slip":
        p -= (p @ normal)[:, None] * normal
    if mode in ("slip", "coupled"):  # a step ends on the edge between stick and slip: go on a bit
        plane_at(geoms, 1e-2 - 4e-4, h, mat)
    data.worlds.friction_mode.fill_(CONSISTENT if mode == "coupled" else CURRENT)
    size = 1e-9
    force, product = evaluate(model, data, geoms, x)
    drag = np.linalg.norm(force.sum(0) - force.sum(0) @ normal * normal)
    share = {"frictionless": 0.0, "slip": mu, "coupled": mu}.get(mode)
    assert share is None or drag == pytest.approx(share * (force.sum(0) @ normal), rel=1e-2, abs=1e-9)
    touching = data.outer.trial_geom.numpy().copy()
    expected = product(p)
    fd = (evaluate(model, data, geoms, x - size * p)[0] - evaluate(model, data, geoms, x + size * p)[0]) / (
        2 * size
    )
    same = (touching == data.outer.trial_geom.numpy()).all()
    assert same  # no sample came or went
    # linear springs and a plane: exact but for rounding 1e-16 / 1e-9 and, slipping, the return's curvature
    np.testing.assert_allclose(
        fd, expected, atol=(1e-6 if mode in ("frictionless", "stick") else 1e-4) * abs(expected).max()
    )


def test_led_friction_does_not_know_the_push():
    """Bounded as where it was forces: the same where the push has doubled, with a symmetric tangent that is
    minus the derivative of the forces."""
    h, mu = 4e-3, 0.1
    model, geoms = pad(nu=0.3, law="corotational"), GeomSet(["plane"], [()], friction=[mu])
    data = SkinData(model)
    for k in range(3):
        plane_at(geoms, 5e-3 + 2e-4 * k, h - 1e-4 * k)
        step(model, data, geoms)
    x, forces = data.vert_xpos[0], {}
    for mode in (RECORDED, LAGGED, CURRENT):
        data.worlds.friction_mode.fill_(mode)
        if mode != RECORDED:
            plane_at(geoms, 6e-3, h - 2.02e-4)
        force, product = evaluate(model, data, geoms, x)
        forces[int(mode)] = force.sum(0)
        if mode == LAGGED:
            p = np.random.default_rng(0).standard_normal(x.shape)
            expected, size = product(p), 1e-9
            ends = [evaluate(model, data, geoms, x + s * size * p)[0] for s in (-1, 1)]
            np.testing.assert_allclose(
                (ends[0] - ends[1]) / (2 * size), expected, atol=1e-4 * abs(expected).max()
            )
    assert forces[CURRENT][2] < 1.5 * forces[RECORDED][2] < 0 and forces[LAGGED][2] == pytest.approx(
        forces[CURRENT][2]
    )
    assert forces[CURRENT][0] == pytest.approx(-mu * forces[CURRENT][2], rel=1e-3)
    assert forces[LAGGED][0] == pytest.approx(-mu * forces[RECORDED][2], rel=1e-3)


def test_friction_of_a_lagged_bound_does_not_end_with_the_push():
    """Where a sample leaves the geom, else the forces would have no potential, in which a solve with held
    bounds descends."""
    h, mu = 4e-3, 0.1
    model, geoms = pad(nu=0.3, law="corotational"), GeomSet(["plane"], [()], friction=[mu])
    data = SkinData(model)
    for k in range(3):
        plane_at(geoms, 5e-3 + 2e-4 * k, h - 1e-4 * k)
        step(model, data, geoms)
    x, forces = data.vert_xpos[0], []
    for mode, z in ((RECORDED, h - 2e-4), (LAGGED, h)):
        data.worlds.friction_mode.fill_(mode)
        plane_at(geoms, 6e-3, z)
        forces.append(evaluate(model, data, geoms, x)[0].sum(0))
    assert forces[0][2] < -0.1 and forces[1][2] == 0.0
    assert forces[1][0] == pytest.approx(-mu * forces[0][2], rel=1e-3)


def test_contact_tangent_where_slip_is_a_power_of_the_push():
    """Of friction that falls with the load, coupled to the push: a plane goes straight down, so that the
    pressure of the nodes rises as that of the samples."""
    h, exponent = 4e-3, 0.6
    law = ContactLaw(exponent, friction_pressure=1e6)
    model, geoms = pad(nu=0.3, contact_law=law), GeomSet(["plane"], [()], friction=[0.3])
    data = SkinData(model)
    for k in range(3):
        plane_at(geoms, 5e-3 + 2e-4 * k, h - 1e-4 * k, DOWN)
        step(model, data, geoms)
    x = data.vert_xpos[0].copy()
    x[:, 2] = np.where(x[:, 2] > 0.9 * h, h - 1e-4, x[:, 2])  # flat: a push alike everywhere
    plane_at(geoms, 6e-3, h - 1.01e-4, DOWN)
    data.worlds.friction_mode.fill_(CONSISTENT)
    size, down = 1e-9, np.tile([0, 0, -1.0], (len(x), 1))
    force, product = evaluate(model, data, geoms, x)
    expected = product(down).sum(0)
    after, before = (evaluate(model, data, geoms, x + s * size * down)[0].sum(0) for s in (1, -1))
    drag, push = force.sum(0)[0], -force.sum(0)[2]
    assert drag > 0.5 * push > 0.01  # it slips
    slope = (before - after) / (2 * size)
    np.testing.assert_allclose(slope, expected, atol=0.02 * abs(expected[0]))
    np.testing.assert_allclose(slope[0] / slope[2], (1 - exponent) * -drag / push, rtol=0.02)


@pytest.mark.parametrize("law", ["linear", "corotational"])
def test_tangent_of_a_touching_body(law):
    """What the coupling takes for d wrench / d pose, against central differences of steps.

    The skin behind the contact is taken at rest and the contact's extent as it is, so the derivative is
    matched to a quarter only."""
    h = 4e-3
    model = pad(nu=0.3, law=law, cells=(8, 8, 4))
    geoms = GeomSet(["sphere"], [(5e-3,)], friction=[0.0])
    center = np.array([5e-3, 5e-3, h + 5e-3 - 2e-4])

    def wrench(offset):
        data = SkinData(model)
        geoms.set_pose([center + offset])
        step(model, data, geoms)
        assert data.converged.all()
        return data.wrench[0, 0], data

    _, data = wrench(np.zeros(3))
    tangent = data.tangent(geoms)[0, 0]
    np.testing.assert_allclose(tangent, tangent.T, atol=1e-12 * abs(tangent).max())
    assert np.linalg.eigvalsh(tangent).min() > -1e-9 * np.linalg.eigvalsh(tangent).max()
    delta = 1e-5
    stiffness = -(wrench([0, 0, delta])[0] - wrench([0, 0, -delta])[0])[2] / (2 * delta)
    assert tangent[2, 2] == pytest.approx(stiffness, rel=0.25)


def test_tangent_of_a_plane_is_its_stiffness():
    """Linear, frictionless, all touching: the tangent is exact; rotations about the origin turn into
    torques."""
    model, h, depth = pad(nu=0.3), 4e-3, 1e-4
    geoms = GeomSet(["plane"], [()])

    def wrench(z, angle=0.0):
        data = SkinData(model)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        geoms.set_pose([turn @ [5e-3, 5e-3, z]], [turn @ DOWN])
        step(model, data, geoms)
        assert data.converged.all()
        return data.wrench[0, 0], data

    _, data = wrench(h - depth)
    tangent = data.tangent(geoms)[0, 0]
    delta = 1e-6
    normal = -(wrench(h - depth + delta)[0] - wrench(h - depth - delta)[0]) / (2 * delta)
    np.testing.assert_allclose(tangent[:3, 2], normal[:3], rtol=1e-3, atol=1e-3 * normal[2])
    np.testing.assert_allclose(tangent[3:, 2], normal[3:], rtol=1e-3, atol=1e-3 * abs(normal[3:]).max())


def test_face_samples_integrate_linear_fields():
    for order in (1, 2, 3, 4):
        samples = face_samples(order)
        assert samples.shape == (order**2, 3)
        np.testing.assert_allclose(samples.sum(1), 1)
        np.testing.assert_allclose(samples.mean(0), 1 / 3)
        assert (samples > 0).all()
        assert len(np.unique(samples.round(9), axis=0)) == order**2


def test_what_is_read_is_kept():
    data = SkinData(pad())
    before, force = data.vert_xpos, data.contact_force
    data.x.numpy()[0] = 7.0
    data.outer.node_force.fill_(1.0)
    assert (data.vert_xpos[0, 0] == 7.0).all() and not (before == 7.0).any() and not force.any()


# --- faces that are left alone  ---


def _course(model, geoms, poses, forget, mat=None, change=None):
    """Nodes and wrenches over poses (n, 3), all faces looked at in every step or not."""
    data, found = SkinData(model), []
    for k, pos in enumerate(poses):
        if change and k == len(poses) // 2:
            change(data)
        if forget:
            data.outer.clearances.clearance.zero_()
        geoms.set_pose([pos], None if mat is None else [mat])
        step(model, data, geoms)
        found.append(np.concatenate([data.vert_xpos.ravel(), data.wrench.ravel()]))
    return np.array(found)


def _sharp():
    """A pyramid on its tip in a grid that misses the tip, over a sample of the pad."""
    angle = np.arange(4) * np.pi / 2
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    vert = 30e-3 * np.concatenate([rim, [[0, 0, 0], [0, 0, -1]]])
    face = np.array([[4, i, (i + 1) % 4] for i in range(4)] + [[5, (i + 1) % 4, i] for i in range(4)])
    grid = bake_distance_grid(vert, face, spacing=2e-3, margin=3e-3)
    model = pad(cells=(2, 2, 2))  # faces so large that samples are looked at where the grid tells
    x, first = SkinData(model).vert_xpos[0], model.outer.face_np[0]
    at = model.sample.numpy()[0] @ x[first] + [0, 0, 30e-3]
    return model, GeomSet(["mesh"], [(0, 0, 0)], [0.5], grids=[grid]), at, np.arange(3e-3, -1e-3, -1e-4), {}


def _rounded():
    """A column of a metre with a rotation as single precision has it, which comes down as slowly as that
    rounding takes it up."""
    at, gaps = np.array([5e-3, 5e-3, 4e-3 + 1.0]), 4e-6 - 4e-7 * np.arange(40)
    box = GeomSet(["box"], [(2e-3, 2e-3, 1.0)], [0.5])
    return pad(), box, at, gaps, {"mat": np.eye(3) * (1 + 2e-7)}


def _shortened():
    """A ball within the reach of an adhesion that ends."""
    model = pad(contact_law=ContactLaw(adhesion=0.5), contact_stiffness=2e10)
    gaps = np.r_[4e-4, 2e-4, 1e-5, -2e-5, -1e-5, np.full(5, -1e-5)]
    ball = GeomSet(["sphere"], [(3.5e-3,)], [0.5])
    return model, ball, np.array([5e-3, 5e-3, 7.5e-3]), gaps, {"change": lambda d: d.laws.set(adhesion=0.0)}


@pytest.mark.parametrize("scene", [_sharp, _rounded, _shortened])
def test_faces_that_touch_are_not_left_alone(scene):
    """A face that was clear is left alone until it may have come near; what is found is the same to the
    bit."""
    model, geoms, at, gaps, options = scene()
    poses = at + gaps[:, None] * [0.0, 0.0, 1.0]
    sparing, whole = (_course(model, geoms, poses, forget, **options) for forget in (False, True))
    assert np.abs(whole[-1, -6:]).max() > 1e-6
    np.testing.assert_array_equal(sparing, whole)
