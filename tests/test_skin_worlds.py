"""Many worlds at once against each of them alone, and CUDA's dense preconditioner of single precision, on the
CPU, against the sparse one."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from blocks import four_nodes
from grids import covering
from test_skin_step import finger

from biotac_mj.geometry import load_skin
from biotac_mj.geometry.core_surface import CoreSurface
from biotac_mj.skin import (
    ContactLaw,
    GeomSet,
    Material,
    SkinData,
    SkinModel,
    SkinOptions,
    launch_step,
    prepare_step,
    step,
)
from biotac_mj.skin.contact.touch import CONSISTENT, CURRENT, LAGGED
from biotac_mj.skin.newton.convergence import check_convergence
from biotac_mj.skin.newton.load_path import choose_increment, end_try
from biotac_mj.skin.newton.worlds import CONVERGED, INSIDE_CORE, NOT_CONVERGED, NOT_FINITE
from biotac_mj.skin.program import Launcher
from biotac_mj.skin.state_arrays import StateArrays
from biotac_mj.skin.types import DOUBLE, SINGLE, real

TYPES, SIZES = ["sphere", "box"], [(3.5e-3,), (2e-3, 2e-3, 2e-3)]
START = 13.5e-3  # z of the sphere's centre where it touches the ball [m]


@pytest.fixture(scope="module")
def model():
    return finger(tolerance=1e-5)


def geom_set(nworld, friction=0.5):
    return GeomSet(TYPES, SIZES, friction=[friction, 0.2], rounding=[0, 5e-4], nworld=nworld)


def poses(worlds, depth):
    """Sphere pressed on the ball from above and dragged, a box from the side: places and depths differ from
    world to world."""
    sphere = [[1e-3 * w["place"] + 0.3 * depth, 1e-3 * w["side"], START - depth * w["depth"]] for w in worlds]
    box = [[12e-3 - 0.5 * depth * w["depth"], 0, 0] for w in worlds]
    return np.stack([sphere, box], 1)


def random_worlds(n, seed):
    rng = np.random.default_rng(seed)
    return [
        dict(
            place=rng.uniform(0, 2),
            depth=rng.uniform(0.5, 1),
            side=rng.uniform(-1, 1),
            friction=rng.uniform(0, 0.8),
            modulus=rng.uniform(0.7, 1.4),
            bulk=rng.choice([0.0, 1e6, 2.2e9, np.inf]),
            fill=rng.uniform(-3, 3) * 1e-9,
        )
        for _ in range(n)
    ]


def walk(model, worlds, preconditioner, depths):
    rubber = [
        dataclasses.replace(model.material, youngs_modulus=w["modulus"] * model.material.youngs_modulus)
        for w in worlds
    ]
    data, geoms = SkinData(model, len(worlds), rubber, preconditioner=preconditioner), geom_set(len(worlds))
    geoms.set_friction([[w["friction"], 0.2] for w in worlds])
    data.set_liquid([w["bulk"] for w in worlds], [w["fill"] if w["bulk"] else 0.0 for w in worlds])
    for depth in depths:
        geoms.set_pose(poses(worlds, depth))
        step(model, data, geoms)
        assert data.converged.all()
    return data, geoms


DEPTHS = (1e-4, 2e-4, 3e-4, 4e-4)


@pytest.mark.parametrize("kind", [pytest.param("dense", marks=pytest.mark.slow), "sparse"])
def test_random_worlds_together_are_each_alone(model, kind):
    """Pose, friction, modulus, bulk modulus (none, soft, water, infinite) and fill differ. Both stop at an
    energy error of 1e-5."""
    worlds = random_worlds(6, seed=3)
    together, geoms = walk(model, worlds, kind, DEPTHS)
    tangent = together.tangent(geoms)
    peak = abs(together.wrench[..., :3]).max()
    assert peak > 0.1 and np.ptp(together.pressure) > 100
    for i, world in enumerate(worlds):
        alone, one = walk(model, [world], "sparse", DEPTHS)
        np.testing.assert_allclose(
            together.wrench[i, 0, :3], alone.wrench[0, 0, :3], rtol=0, atol=1e-3 * peak
        )
        np.testing.assert_allclose(together.vert_xpos[i], alone.vert_xpos[0], rtol=0, atol=2e-7)
        np.testing.assert_allclose(together.pressure[i], alone.pressure[0], rtol=0.01, atol=2.0)
        np.testing.assert_allclose(together.volume[i], alone.volume[0], rtol=1e-6)
        np.testing.assert_allclose(
            tangent[i], alone.tangent(one)[0], rtol=0, atol=0.02 * abs(tangent[i]).max()
        )


def test_more_worlds_than_are_solved_finely(model):
    """Few and many worlds take other kernels (rows of the inverse or a product, samples or faces): the same
    answers."""
    worlds = random_worlds(3, seed=5)
    few, _ = walk(model, worlds, "dense", DEPTHS[:2])
    many, _ = walk(model, worlds * 6, "dense", DEPTHS[:2])
    for i in range(18):
        np.testing.assert_allclose(
            many.wrench[i], few.wrench[i % 3], rtol=0, atol=1e-4 * abs(few.wrench).max()
        )
        np.testing.assert_allclose(many.vert_xpos[i], few.vert_xpos[i % 3], rtol=0, atol=2e-8)


def test_worlds_that_fail_are_told_and_leave_the_others_alone(model):
    """NaN pose, NaN modulus: last good state. A geom inside the core: as far as it comes. A reason each, and
    bit for bit the same in the sound worlds."""
    worlds = random_worlds(5, seed=7)
    data, geoms = walk(model, worlds, "dense", DEPTHS[:2])
    sound, others = walk(model, worlds, "dense", DEPTHS[:2])
    good = data.vert_xpos, data.wrench
    bad = poses(worlds, DEPTHS[2])
    others.set_pose(bad)
    start, bad[2, 0, 2] = poses(worlds, DEPTHS[1])[2, 0], 8e-3
    geoms.set_pose(bad)
    at = geoms.struct.pos.numpy().copy()
    at[0, 0, 0] = np.nan
    geoms.struct.pos.assign(at)
    stiff = data.rubber.mu.numpy().copy()
    data.rubber.mu.assign(np.where(np.arange(5) == 4, np.nan, stiff))
    launch_step(model, data, geoms)
    step(model, sound, others)
    assert data.worlds.reason.numpy().tolist() == [NOT_FINITE, CONVERGED, INSIDE_CORE, CONVERGED, NOT_FINITE]
    assert data.nonconverged.tolist() == [1, 0, 1, 0, 1] and data.converged.tolist() == [
        False,
        True,
        False,
        True,
        False,
    ]
    assert (data.vert_xpos[[1, 3]] == sound.vert_xpos[[1, 3]]).all() and (
        data.wrench[[1, 3]] == sound.wrench[[1, 3]]
    ).all()
    assert (data.vert_xpos[[0, 4]] == good[0][[0, 4]]).all()
    np.testing.assert_allclose(data.wrench[0], good[1][0], rtol=0, atol=1e-6 * abs(good[1]).max())
    reached = data.load_factor
    assert reached[[0, 1, 3, 4]].tolist() == [0, 1, 1, 0] and 0.05 < reached[2] < 0.9
    at = geoms.struct.pos_last.numpy()[0, 2]
    np.testing.assert_allclose(at, start + reached[2] * (bad[2, 0] - start), rtol=0, atol=1e-12)
    assert np.linalg.norm(data.wrench[2, 0, :3]) > 3 * np.linalg.norm(good[1][2, 0, :3])
    # what was wrong is mended: the worlds go on to where the sound ones are, but for friction where one was
    # pressed deep
    data.rubber.mu.assign(stiff)
    geoms.set_pose(poses(worlds, DEPTHS[2]))
    step(model, data, geoms)
    assert data.converged.all() and data.nonconverged.tolist() == [1, 0, 1, 0, 1]
    force, expected = (d.wrench[[0, 1, 3, 4]][..., :3] for d in (data, sound))
    np.testing.assert_allclose(force, expected, rtol=0, atol=5e-3 * abs(expected).max())


@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_worlds_that_are_not_wanted_wait(model, kind):
    """A step of every second world, then one of the others: bit for bit a step of all."""
    worlds = random_worlds(4, seed=9)
    (data, geoms), (at_once, others) = (walk(model, worlds, kind, DEPTHS[:2]) for _ in range(2))

    def state(data, geoms):
        arrays = data.x, data.x_last, data.increment, data.outer.anchor, geoms.struct.pos_last
        return [a.numpy().copy() for a in (*arrays, data.worlds.last_pressure, data.worlds.nonconverged)]

    before = state(data, geoms)
    for g in (geoms, others):
        g.set_pose(poses(worlds, DEPTHS[2]))
    step(model, at_once, others)
    for wanted in ([1, 0, 1, 0], [0, 1, 0, 1]):
        data.worlds.wanted.assign(wanted)
        step(model, data, geoms)
        if wanted[0]:
            for now, then in zip(state(data, geoms), before, strict=True):
                by_world = (np.moveaxis(a, min(1, a.ndim - 1), 0) for a in (now, then))
                assert all((a == b).all() for a, b in list(zip(*by_world))[1::2])
    for now, expected in zip(state(data, geoms), state(at_once, others), strict=True):
        assert (now == expected).all()
    assert (data.wrench == at_once.wrench).all() and (data.load_factor == 1).all()


def test_a_step_that_does_not_converge():
    hasty = finger(max_newton=1)
    data, geoms = SkinData(hasty, 2, preconditioner="dense"), geom_set(2)
    geoms.set_pose([poses([dict(place=1, depth=1, side=0)], d)[0] for d in (1.4e-3, -5e-3)])
    step(hasty, data, geoms)
    assert data.worlds.reason.numpy().tolist() == [NOT_CONVERGED, CONVERGED]
    assert (data.vert_xpos[0] == hasty.geometry.vert).all()


def test_contact_beyond_capacity_converges_to_the_same_result(model, monkeypatch):
    worlds = random_worlds(1, seed=9)
    enough, _ = walk(model, worlds, "dense", DEPTHS)
    monkeypatch.setattr(SkinData, "contact_capacity", 3)
    tight, _ = walk(model, worlds, "dense", DEPTHS)
    assert tight.preconditioner.full.numpy()[0] > 3 and enough.preconditioner.full.numpy()[0] == 0
    np.testing.assert_allclose(tight.wrench, enough.wrench, rtol=0, atol=2e-3 * abs(enough.wrench).max())


@pytest.mark.parametrize(
    "law, poisson",
    [("neo_hookean", 0.45), ("svk", 0.3), pytest.param("neo_hookean", 0.49, marks=pytest.mark.slow)],
)
def test_other_laws_and_elements(law, poisson):
    """Laws with inverted tetrahedra to refuse; above 0.45 the inverse is kept as two halves."""
    model = SkinModel(
        finger().geometry,
        Material(law, 2.8e5, poisson, 0.2, element="linear"),
        SkinOptions(tolerance=1e-5, max_newton=60),
    )
    results = []
    for kind in ("sparse", "dense"):
        data, geoms = SkinData(model, preconditioner=kind), geom_set(1)
        for depth in DEPTHS:
            geoms.set_pose(poses([dict(place=1, depth=1, side=0)], depth)[0])
            step(model, data, geoms)
            assert data.converged.all()
        results.append((data.wrench, data.vert_xpos, data.iterations))
    (wrench, x, _), (other, y, _) = results
    np.testing.assert_allclose(other, wrench, rtol=0, atol=1e-3 * abs(wrench).max())
    np.testing.assert_allclose(y, x, rtol=0, atol=1e-7)


def test_slip_that_goes_with_the_push():
    """Where slip is coupled to the push the springs of contact are not symmetric, nor is what the liquid and
    the touching nodes do to each other."""
    model = finger()
    data, geoms = SkinData(model), geom_set(1, friction=0.3)
    world = dict(place=1, depth=1, side=0)
    for depth in DEPTHS[:2]:
        geoms.set_pose(poses([world], depth)[0])
        step(model, data, geoms)
    answers = []
    for kind in ("sparse", "dense"):
        again, other = SkinData(model, preconditioner=kind), geom_set(1, friction=0.3)
        other.set_pose([[0.1, 0.1, 0.1]] * 2)
        step(model, again, other)
        StateArrays(again, other).load(StateArrays(data, geoms).save())
        other.set_pose(poses([world], DEPTHS[1])[0] + [[1e-3, 0, -2e-4], [0, 0, 0]])
        ready = prepare_step(model, again, other)
        for coupled in (0, 1):
            again.worlds.friction_mode.fill_(CONSISTENT if coupled else CURRENT)
            ready.evaluate_forces()
            again.worlds.active.fill_(1)
            ready.M.begin_step(ready._launcher, again.x)
            ready._precondition()
            answers.append(ready.k.p.numpy()[:, 0].copy())
    symmetric, exact, _, z = answers
    assert abs(symmetric - exact).max() > 0.05 * abs(exact).max()  # it slips
    np.testing.assert_allclose(z, exact, rtol=0, atol=1e-3 * abs(exact).max())


@pytest.mark.law
def test_worlds_move_as_single_skins_do():
    """Backward Euler with both dampings, on a core that is shaken: the same positions and velocities."""
    options = SkinOptions(
        liquid=False,
        dynamics="implicit",
        mass_damping=5.0,
        stiffness_damping=1e-4,
        tolerance=1e-6,
        max_newton=60,
    )
    model = SkinModel(finger().geometry, "default", options)
    results = []
    for kind in ("sparse", "dense"):
        data, geoms = SkinData(model, 2, preconditioner=kind), geom_set(2)
        geoms.set_pose([[0.1, 0.1, 0.1]] * 2)
        for k in range(1, 5):
            step(
                model,
                data,
                geoms,
                1e-3,
                core_pos=[[0, 2e-4 * np.sin(k), 0], [0, 0, 1e-4 * k]],
                core_mat=np.tile(np.eye(3), (2, 1, 1)),
            )
        results.append((data.vert_xpos, data.velocity.numpy()))
    (x, v), (y, u) = results
    assert abs(x - model.geometry.vert).max() > 1e-6
    np.testing.assert_allclose(y, x, rtol=0, atol=1e-3 * abs(x - model.geometry.vert).max())
    np.testing.assert_allclose(u, v, rtol=0, atol=1e-3 * abs(v).max())


def test_loads_reset_and_reading_a_state(model):
    data, geoms = SkinData(model, preconditioner="dense"), geom_set(1)
    load = np.zeros((1, model.nvert, 3))
    load[0, model.geometry.vert[:, 2].argmax(), 2] = -5e-2
    data.set_external(load)
    geoms.set_pose([[0.1, 0.1, 0.1]] * 2)
    step(model, data, geoms)
    np.testing.assert_allclose(data.reaction[0], [0, 0, 5e-2], atol=1e-4)  # what holds the ball pushes back
    data.reset()
    assert (data.vert_xpos[0] == model.rest.vert).all() and not data.wrench.any()
    step(model, data, geoms)
    assert abs(data.vert_xpos[0] - model.rest.vert).max() < 1e-9
    world = dict(place=1, depth=1, side=0)
    for depth in DEPTHS[:2]:
        geoms.set_pose(poses([world], depth)[0])
        step(model, data, geoms)
    again, other = SkinData(model, preconditioner="dense"), geom_set(1)
    prepare_step(model, again, other)
    StateArrays(again, other).load(StateArrays(data, geoms).save())
    other.set_pose(poses([world], DEPTHS[1])[0])
    for d, g in ((data, geoms), (again, other)):
        g.set_pose(poses([world], DEPTHS[2])[0])
        step(model, d, g)
    np.testing.assert_allclose(again.wrench, data.wrench, rtol=0, atol=1e-9 * abs(data.wrench).max())


def test_what_is_refused(model):
    with pytest.raises(ValueError, match="unknown preconditioner 'lu': choose one of sparse, dense"):
        SkinData(model, preconditioner="lu")
    with pytest.raises(
        ValueError, match="geoms are for 2 worlds and the data for 1: make both for the same number"
    ):
        launch_step(model, SkinData(model), geom_set(2))
    data = SkinData(model, 2)
    with pytest.raises(ValueError, match="bulk_modulus is .*: pass numbers >= 0 .Pa., math.inf"):
        data.set_liquid(bulk_modulus=[-1.0, 1e6])
    with pytest.raises(ValueError, match="fill_volume is .*: pass finite numbers .m.3. above minus the"):
        data.set_liquid(fill_volume=-1.0)
    dry = SkinModel(model.geometry, "default", SkinOptions(liquid=False))
    with pytest.raises(
        ValueError, match=r"this model has no liquid: make it with SkinOptions\(liquid=True\)"
    ):
        SkinData(dry).set_liquid(1e6)


@pytest.mark.parametrize("element", [pytest.param("quadratic", marks=pytest.mark.slow), "linear"])
def test_shapes_that_no_skin_can_have_are_refused(element):
    """Each in its own world: rest, a tetrahedron turned inside out, an inner surface inside the core."""
    geometry = load_skin("coarse") if element == "quadratic" else four_nodes("coarse")
    model = SkinModel(geometry, "default", SkinOptions(element=element))
    data, geoms = SkinData(model, 3), GeomSet(["sphere"], [(3.5e-3,)], nworld=3)
    ready = prepare_step(model, data, geoms)
    x = np.repeat(geometry.vert[:, None], 3, 1)
    corner = geometry.elem[np.isin(geometry.elem, model.fixed).sum(1) == 0][0][:4]
    x[corner[0], 1] += 1.2 * (geometry.vert[corner[1:]].mean(0) - geometry.vert[corner[0]])
    inner = np.unique(model.core_surface.face_np)
    inner = inner[geometry.vert[inner, 1] < -5e-3]
    x[inner, 2, 1] += 3e-3  # the pad's inside, pushed up into the core
    data.x.assign(x)
    data.worlds.unfinished.fill_(1)
    data.worlds.failed.zero_()
    ready.evaluate_forces()
    ready._end_try()
    assert data.worlds.failed.numpy().tolist() == [0, 1, 1]
    data.worlds.inverted.zero_()  # the core alone
    data.worlds.failed.zero_()
    data.worlds.unfinished.fill_(1)
    ready._end_try()
    assert data.worlds.failed.numpy().tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    "element, law", covering(["linear", "quadratic"], ["corotational", "svk", "neo_hookean", "linear"])
)
def test_elements_of_single_precision_are_those_of_double(law, element):
    """Forces to double, tangents to single precision, turned and stretched; nu 0.49 feels the mean
    dilatation."""
    geometry = load_skin("coarse")
    model = SkinModel(geometry, Material(law, 1e6, 0.49), SkinOptions(element=element))
    data, rng = SkinData(model, 2), np.random.default_rng(0)
    turn = np.array([[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]])
    vert = np.repeat(model.geometry.vert[:, None], 2, axis=1) @ turn.T * 1.03
    data.x.assign(vert + 1e-5 * rng.standard_normal(vert.shape))
    p, program, found = rng.standard_normal(vert.shape).astype(np.float32), Launcher("cpu"), []
    on, inverted = wp.ones(2, dtype=int), wp.zeros(2, dtype=int)
    for precision in (DOUBLE, SINGLE):
        data._chosen = SimpleNamespace(precision=precision)
        elements = data.element_forces()
        elements.evaluate_corners(program, data.x, on, inverted)
        elements.multiply_corners(program, data.x, wp.array(p, dtype=precision.vec, ndim=2), on)
        found.append((elements.corner_force.numpy(), elements.corner.numpy()))
    (force, product), (other, rough) = found
    np.testing.assert_allclose(other, force, rtol=0, atol=3e-7 * np.abs(force).max())
    np.testing.assert_allclose(rough, product, rtol=0, atol=2e-6 * np.abs(product).max())
    assert (inverted.numpy() == 0).all()


@pytest.mark.law
def test_one_dense_world_equals_a_sparse_one(model):
    """Its inverse is applied in one pass, see `symmetric_product`."""
    worlds = random_worlds(1, seed=5)
    together, _ = walk(model, worlds, "dense", DEPTHS)
    alone, _ = walk(model, worlds, "sparse", DEPTHS)
    scale = np.abs(alone.wrench).max()
    np.testing.assert_allclose(together.wrench, alone.wrench, rtol=0, atol=1e-3 * scale)
    np.testing.assert_allclose(together.vert_xpos, alone.vert_xpos, rtol=0, atol=5e-7)


DEVICES = [
    "cpu",
    pytest.param("cuda:0", marks=pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")),
]


@pytest.mark.law
@pytest.mark.parametrize("element", ["linear", pytest.param("quadratic", marks=pytest.mark.slow)])
@pytest.mark.parametrize("device", DEVICES)
def test_an_inverted_element_or_crossed_core_is_no_balance(element, device):
    """The check that ends every step, with nodes put where a sound step never leaves them; the other worlds
    pass, one of them with a node up to 0.4 mm inside the core: pressed, not crushed."""
    rubber = Material("neo_hookean", 2.8e5, 0.45)
    law = {"inverted": rubber, "crushed": dataclasses.replace(rubber, law="linear")}  # no element is inverted
    options, sphere = SkinOptions(element=element), GeomSet(["sphere"], [(0.0035,)], nworld=3, device=device)
    sphere.set_pose([[0.1, 0, 0]])
    model = SkinModel(load_skin("coarse"), rubber, options, device=device)
    inner = np.setdiff1d(model.core_surface.face_np, model.geometry.fixed)
    at = model.geometry.vert[inner]
    # the pad looks along -y, the core lies above its inner surface
    node = inner[(abs(at[:, 0] + 0.012) + abs(at[:, 2]) + 1e3 * (at[:, 1] > 0)).argmin()]
    surface = CoreSurface(model.geometry.core_vert, model.geometry.core_face)
    gap = float(surface.closest(model.geometry.vert[node][None])[0][0])
    assert model.crushed_depth == options.max_core_depth and 1e-4 < gap < 2e-3
    for spoil in ("inverted", "crushed"):
        model = SkinModel(load_skin("coarse"), law[spoil], options, device=device)
        data = SkinData(model, 3)
        ready = prepare_step(model, data, sphere)
        x = data.x.numpy().copy()
        if spoil == "inverted":
            corner = np.setdiff1d(model.geometry.elem[:, 0], model.geometry.fixed)[0]
            x[corner, 1] += 20 * (x[:, 1].mean(0) - x[corner, 1])
        else:
            x[node, 1, 1] += gap + 1e-3
            x[node, 2, 1] += gap + 4e-4
        data.x.assign(x)
        data.worlds.unfinished.fill_(1)
        data.worlds.failed.zero_()
        ready.evaluate_forces()  # as at the end of every step
        ready._end_try()
        assert data.worlds.failed.numpy().tolist() == [0, 1, 0], spoil


def test_worlds_have_the_contact_of_their_own_modulus():
    """Contact stiffness and the range of adhesion follow from each world's rubber, whichever world is
    first."""
    soft, stiff = (Material("neo_hookean", E, 0.4) for E in (3e5, 1.5e6))
    options = SkinOptions(contact_law=ContactLaw(adhesion=0.05), tolerance=1e-8, max_newton=200, liquid=False)

    def pressed(materials):
        n, model = len(materials), SkinModel(finger().geometry, materials[0], options)
        data, geoms = SkinData(model, n, materials), GeomSet(["sphere"], [(3.5e-3,)], nworld=n)
        for depth in (0.0, 2e-4, 4e-4):
            geoms.set_pose([[0, 0, START - depth]])
            step(model, data, geoms)
            assert data.converged.all()
        return data.wrench[:, 0, 2], data.laws.range

    force, reach = zip(*(pressed([m]) for m in (soft, stiff)))
    force, reach = np.concatenate(force), np.concatenate(reach)
    assert force[1] > 2 * force[0] > 0.01 and reach[0] == pytest.approx(5**0.5 * reach[1])
    for order in ([0, 1], [1, 0]):
        together, ranges = pressed([(soft, stiff)[k] for k in order])
        np.testing.assert_allclose(together, force[order], rtol=1e-6)
        np.testing.assert_allclose(ranges, reach[order], rtol=1e-12)


@pytest.mark.parametrize("rz, balanced", [(1e-12, True), (-1e-12, True), (1e-6, False), (-1e-6, False)])
def test_a_preconditioner_that_is_not_positive_ends_no_step(rz, balanced):
    """The error is sqrt(|r . z| / work): a negative product is no smaller an error than a positive one."""
    data = SkinData(finger())
    st = data.worlds
    st.active.fill_(1)
    st.touched.fill_(1)
    st.iteration_limit.fill_(30)
    st.work_limit.fill_(750)
    part, norms = (np.zeros((k, 1, 1)) for k in (2, 4))
    part[0], norms[0], norms[1] = rz, 1e-4, 1.0  # residual squared [N^2], work of the load [J]
    arrays = [wp.array(a, dtype=real, ndim=3, device="cpu") for a in (part, norms)]
    any_active = wp.zeros(1, dtype=int, device="cpu")
    wp.launch_tiled(
        check_convergence,
        dim=[1],
        inputs=[1e-4, 1e-4, 750, 0, data.rest_pressure, *arrays, st],
        outputs=[any_active],
        block_dim=1,
        device="cpu",
    )
    assert bool(st.active.numpy()[0]) is not balanced and bool(any_active.numpy()[0]) is not balanced
    assert st.error.numpy()[0] == pytest.approx(abs(rz) ** 0.5, rel=1e-6)


@pytest.mark.parametrize(
    "viscosity, increment, rz, balanced",
    [(0.0, 0.0, 0.9, True), (3.0, 0.0, 0.1, False), (3.0, 0.25, 0.2, True), (3.0, 0.25, 0.3, False)],
)
def test_viscous_skin_is_in_balance_within_an_increment(viscosity, increment, rz, balanced):
    """Where a bound of its error says so: what the stiffer rubber tells, times one plus the lag. rz: over
    what is allowed."""
    data = SkinData(finger())
    st, tolerance = data.worlds, 1e-3
    values = {
        "active": 1,
        "touched": 1,
        "iteration_limit": 30,
        "work_limit": 750,
        "viscosity": viscosity,
        "increment": increment,
    }
    for name, value in values.items():
        getattr(st, name).fill_(value)
    part, norms = (np.zeros((k, 1, 1)) for k in (2, 4))
    part[0], norms[0], norms[1] = rz * tolerance**2, 1e-4, 1.0
    arrays = [wp.array(a, dtype=real, ndim=3, device="cpu") for a in (part, norms)]
    bounds = [tolerance, tolerance, 750, 0, data.rest_pressure]
    given = [*bounds, *arrays, st, wp.zeros(1, dtype=int, device="cpu")]
    wp.launch_tiled(check_convergence, dim=[1], inputs=given, block_dim=1, device="cpu")
    assert bool(st.active.numpy()[0]) is not balanced


@pytest.mark.parametrize(
    "start, rounds, error, trial, after",
    [
        (
            5,
            0,
            0.9,
            1.0,
            dict(unfinished=0, reason=CONVERGED, load_factor=1.0),
        ),  # found again at once: its own
        (
            3,
            0,
            0.9,
            1.0,
            dict(moving=1, restores=0, accepted=0, rounds=1, load_factor=0.5),
        ),  # once more, from here
        (3, 1, 0.9, 1.0, dict(moving=1, restores=0, accepted=0, rounds=2, load_factor=0.5)),
        (3, 2, 0.9, 1.0, dict(moving=1, restores=1, accepted=1, rounds=3, load_factor=1.0)),  # it slips on
        (3, 2, 0.09, 1.0, dict(moving=1, restores=0, accepted=0, rounds=3, load_factor=0.5)),
        (
            5,
            2,
            0.09,
            0.75,
            dict(moving=1, restores=1, accepted=1, rounds=0, load_factor=0.75, trial_factor=1.0),
        ),
    ],
)
def test_lagged_friction_bounds_converge_or_slip_goes_on(start, rounds, error, trial, after):
    st = SkinData(finger()).worlds
    values = {
        "unfinished": 1,
        "friction_mode": LAGGED,
        "iterations": 5,
        "start_iterations": start,
        "rounds": rounds,
        "start_error": error,
    }
    values |= {"trial_factor": trial, "load_factor": 0.5, "increment": trial - 0.5, "reason": NOT_CONVERGED}
    for name, value in values.items():
        getattr(st, name).fill_(value)
    flags = [wp.zeros(1, dtype=int, device="cpu") for _ in range(2)]
    wp.launch(end_try, 1, [st, flags[0]], device="cpu")
    wp.launch(choose_increment, 1, [1 / 32, 2500, 0, st, *flags], device="cpu")
    assert {name: getattr(st, name).numpy()[0] for name in after} == after
