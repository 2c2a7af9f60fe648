"""The step as a function: batches, order, repetition, failure, and what it refuses."""

import dataclasses

import numpy as np
import pytest
import trimesh
import warp as wp
from blocks import shell, skin

from biotac_mj.geometry import load_skin
from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, step
from biotac_mj.skin.newton import convergence
from biotac_mj.skin.newton.worlds import INSIDE_CORE
from biotac_mj.skin.state_arrays import StateArrays
from biotac_mj.skin.step import SkinStep

PATH = np.linspace(0, 1.2e-3, 5)


def finger(shuffle=None, law="corotational", **options):
    """A ball of rubber, liquid and core of 20 mm, held below."""
    vert, elem, inner = shell(10e-3, 8.5e-3, subdivisions=2, layers=2)
    if shuffle is not None:
        elem = np.random.default_rng(shuffle).permutation(elem)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=7e-3)
    geometry = skin(
        vert,
        elem,
        np.flatnonzero(vert[:, 2] < -6e-3),
        inner_face=inner,
        core=(ball.vertices, ball.faces),
        name="ball",
    )
    if shuffle is not None:
        geometry = dataclasses.replace(
            geometry, outer_face=np.random.default_rng(shuffle).permutation(geometry.outer_face)
        )
    return SkinModel(geometry, Material(law), SkinOptions(**{"max_newton": 60, **options}))


@pytest.fixture(scope="module")
def model():
    return finger()


def geoms(nworld=1):
    return GeomSet(
        ["sphere", "box"], [(3.5e-3,), (2e-3, 2e-3, 2e-3)], [0.7, 0.3], [0, 1], [0, 5e-4], nworld=nworld
    )


def pose(s, world=0):
    """Sphere from above, dragged sideways; box from the side, in worlds 1 and 2 elsewhere; world 2 lets go at
    the end."""
    leave = 4e-3 if world == 2 and s > 0.8e-3 else 0.0
    return [[0.3 * s, 1e-3 * world, 13.5e-3 - s + leave], [12e-3 - 0.5 * s + leave, 0, 1e-3 * world]]


def press(model, worlds, path=PATH, material=None):
    """Data and geoms after a press in the given worlds."""
    data, touching = SkinData(model, len(worlds), material), geoms(len(worlds))
    for s in path:
        touching.set_pose([pose(s, w) for w in worlds])
        step(model, data, touching)
        assert data.converged.all()
    return data, touching


@pytest.mark.parametrize("tolerance, apart", [(1e-3, 1e-6), pytest.param(1e-9, 1e-9, marks=pytest.mark.slow)])
def test_a_world_of_a_batch_is_the_world_alone(tolerance, apart):
    """A batch sums in another order and its preconditioner rounds to single precision, so the paths to
    balance differ, by far less than the tolerance, and what they lead to does not."""
    model = finger(tolerance=tolerance, max_newton=200)
    batch, touching = press(model, [0, 1, 2])
    tangent = batch.tangent(touching)
    for w in range(3):
        alone, one = press(model, [w])
        np.testing.assert_allclose(
            batch.vert_xpos[w], alone.vert_xpos[0], rtol=0, atol=apart * 1e-3
        )  # of the way pressed
        np.testing.assert_allclose(
            batch.wrench[w], alone.wrench[0], rtol=0, atol=20 * apart * abs(batch.wrench).max()
        )
        stiff = max(20 * apart, tolerance)  # water makes much of little volume
        np.testing.assert_allclose(
            batch.pressure[w], alone.pressure[0], rtol=0, atol=stiff * abs(batch.pressure).max()
        )
        np.testing.assert_allclose(
            tangent[w], alone.tangent(one)[0], rtol=0, atol=1e-5 * abs(tangent).max()
        )  # rows are single precision
    assert abs(batch.wrench[2]).max() < 1e-9 < abs(batch.wrench[0]).max()
    assert abs(batch.wrench[0] - batch.wrench[1]).max() > 1e-2  # the worlds do differ


def test_worlds_in_another_order(model):
    one, _ = press(model, [0, 1])
    other, _ = press(model, [1, 0])
    np.testing.assert_allclose(
        one.vert_xpos, other.vert_xpos[::-1], rtol=0, atol=1e-9
    )  # a millionth of the way pressed


def test_the_same_input_gives_the_same_bits():
    results = []
    for _ in range(2):
        data, touching = press(finger(), [0])
        results.append((data.vert_xpos, data.wrench, data.tangent(touching), data.pressure))
    for a, b in zip(*results, strict=True):
        assert (a == b).all()


def test_order_of_tetrahedra_and_faces_does_not_matter():
    tight = dict(tolerance=1e-9, max_newton=200)
    one, _ = press(finger(**tight), [0])
    other, _ = press(finger(shuffle=1, **tight), [0])
    np.testing.assert_allclose(one.vert_xpos, other.vert_xpos, rtol=0, atol=1e-8 * 20e-3)
    np.testing.assert_allclose(one.wrench, other.wrench, rtol=0, atol=1e-6 * abs(one.wrench).max())


def test_each_world_has_its_material(model):
    soft = [
        dataclasses.replace(model.material, youngs_modulus=s * model.material.youngs_modulus)
        for s in (1.0, 0.8)
    ]
    data, _ = press(model, [0, 0], material=soft)
    alone = SkinModel(
        model.geometry, soft[1], dataclasses.replace(model.options, contact_stiffness=model.contact_stiffness)
    )
    expected, _ = press(alone, [0])
    # other preconditioners take other ways: what the tolerance of 1e-3 leaves
    np.testing.assert_allclose(data.wrench[1], expected.wrench[0], rtol=0, atol=5e-3 * abs(data.wrench).max())
    assert np.linalg.norm(data.wrench[1, 0, :3]) < 0.9 * np.linalg.norm(data.wrench[0, 0, :3])


def test_tolerance_bounds_the_error(model):
    """The estimated error is in the energy norm; forces are off by no more than that many parts."""
    exact, _ = press(finger(tolerance=1e-8, max_newton=200), [0])
    rough, _ = press(model, [0])
    assert (rough.error <= model.options.tolerance).all()
    scale = np.linalg.norm(exact.wrench[0, :, :3], axis=1).max()
    assert abs(rough.wrench - exact.wrench)[..., :3].max() < 5 * model.options.tolerance * scale


def test_reset_starts_over(model):
    first, touching = press(model, [0])
    expected = first.vert_xpos
    first.set_external(np.ones((1, model.nvert, 3)))
    first.reset()
    assert (first.vert_xpos[0] == model.geometry.vert).all()
    assert not first.wrench.size and first.nonconverged[0] == 0 and first.external is None
    touching = geoms()
    for s in PATH:
        touching.set_pose(pose(s))
        step(model, first, touching)
    assert (first.vert_xpos == expected).all()


def test_load_goes_on_where_it_was_read(model):
    """A single world's state: positions, increment, motion, sticking contacts, pressure."""
    data, touching = press(model, [0], PATH[:-1])
    again, other = SkinData(model), geoms()
    StateArrays(again, other).load(StateArrays(data, touching).save())
    other.set_pose(pose(PATH[-2]))
    for d, g in ((data, touching), (again, other)):
        g.set_pose(pose(PATH[-1]))
        step(model, d, g)
    assert (data.vert_xpos == again.vert_xpos).all()
    assert (data.wrench == again.wrench).all()


# --- failure  ---


def test_a_step_that_does_not_converge_keeps_the_last_good_state():
    model = finger(max_newton=1)
    data, touching = SkinData(model, 2), geoms(2)
    easy = finger()
    for s in PATH[:3]:
        touching.set_pose([pose(s), pose(-1e-3)])
        step(easy, data, touching)
        assert data.converged.all()
    good = [np.copy(a) for a in (data.vert_xpos, data.wrench, data.contact_force, data.pressure)]
    before = data.nonconverged.copy()
    touching.set_pose([pose(1.4e-3), pose(-1e-3)])  # too deep for one iteration
    step(model, data, touching)
    assert data.converged.tolist() == [False, True]
    assert (data.nonconverged - before).tolist() == [1, 0]
    for kept, now in zip(good, (data.vert_xpos, data.wrench, data.contact_force, data.pressure)):
        np.testing.assert_allclose(now, kept, rtol=0, atol=1e-9 * max(abs(kept).max(), 1e-3))


def test_after_a_failed_step_smaller_ones_go_on():
    """What failed leaves no trace: the press goes on to the answer that it would have had."""
    easy, hasty = finger(tolerance=1e-5, max_newton=200), finger(max_newton=1)
    data, touching = press(easy, [0], PATH[:2])
    touching.set_pose(pose(1.4e-3))
    step(hasty, data, touching)
    assert not data.converged[0]
    for s in PATH[2:]:
        touching.set_pose(pose(s))
        step(easy, data, touching)
    expected, _ = press(easy, [0])
    np.testing.assert_allclose(data.wrench, expected.wrench, rtol=0, atol=1e-3 * abs(expected.wrench).max())


# --- bad input  ---


DEEP = [[0, 0, 8e-3], [1.0, 0, 0]]  # the sphere is 2.5 mm inside the core


@pytest.mark.parametrize("began", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_geom_deep_inside_the_core_presses_as_far_as_it_comes(model, began):
    """From above the skin, or found there: then it comes from where it clears the skin. What it reached is a
    balance of its own, from which the press goes back to where it would have been."""
    data, touching = SkinData(model), geoms()
    if began:
        touching.set_pose(pose(0))
        step(model, data, touching)
    for _ in range(2):
        touching.set_pose(DEEP)
        step(model, data, touching)
        assert not data.converged[0] and 0 <= data.load_factor[0] < 1
    assert data.nonconverged[0] == 2 and data.worlds.reason.numpy()[0] == INSIDE_CORE
    where = touching.struct.pos_last.numpy()[0, 0]
    assert 9e-3 < where[2] < 12e-3 and (touching.struct.pos.numpy()[0, 0] == DEEP[0]).all()
    pressed, tangent = data.wrench[0, 0], data.tangent(touching)[0, 0]
    assert pressed[2] > 1 and np.trace(tangent[:3, :3]) > 1e3
    touching.set_pose([where, DEEP[1]])
    step(model, data, touching)
    assert data.converged[0]
    np.testing.assert_allclose(data.wrench[0, 0], pressed, rtol=0, atol=3e-3 * abs(pressed).max())
    touching.set_pose(pose(1e-3))
    step(model, data, touching)
    assert data.converged[0] and data.load_factor[0] == 1
    expected, _ = press(model, [0], [0, 1e-3])
    np.testing.assert_allclose(data.wrench[0, 0, 2], expected.wrench[0, 0, 2], rtol=0.05)


def test_a_step_in_parts_is_the_steps_to_their_ends(model, monkeypatch):
    """Where the whole way fails, its parts lead to where steps to their ends do, friction with them, what is
    led too (after a part failed: the second way, of which the last half is too long once); a turned geom
    turns on the way."""
    end_try, failing = SkinStep._end_try, []

    def stubborn(self):
        self._launcher.call(lambda: self.st.failed.fill_(1) if failing and failing.pop() else None)
        end_try(self)

    monkeypatch.setattr(SkinStep, "_end_try", stubborn)
    exact = finger(tolerance=1e-8, max_newton=200)
    exact.spacing = 0.0  # the box's fillets are sides, beside whose edges led friction comes to rest
    from_depth, to_depth, angle = 0.6e-3, 1.0e-3, 0.2

    def turned(share):
        turn, a = np.tile(np.eye(3), (2, 1, 1)), angle * share
        turn[1] = [[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]]
        return turn

    def go(ends, script):
        data, touching = press(exact, [0], [from_depth])
        failing[:] = script  # taken from the end
        for share in ends:
            touching.set_pose(pose(from_depth + share * (to_depth - from_depth)), turned(share))
            step(exact, data, touching)
            assert data.converged[0] and data.load_factor[0] == 1
        assert not failing
        return data.vert_xpos, data.wrench, touching.struct.mat_last.numpy()

    whole, *_ = go([1.0], [])
    for script, ends in [([0, 0, 1], (0.25, 0.75, 1.0)), ([0, 0, 0, 0, 1, 1], (0.125, 0.25, 0.5, 0.75, 1.0))]:
        parts, steps = go([1.0], script), go(ends, [])
        np.testing.assert_allclose(parts[0], steps[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(parts[1], steps[1], rtol=0, atol=1e-5 * abs(steps[1]).max())
        np.testing.assert_allclose(parts[2], steps[2], rtol=0, atol=1e-15)
        assert 1e-8 < abs(parts[0] - whole).max() < 2e-5
    partway, touching = press(exact, [0], [0.6e-3])
    failing[:] = [1] * 20 + [0, 1]
    touching.set_pose(pose(to_depth), turned(1.0))
    step(exact, partway, touching)
    assert partway.load_factor[0] == 0.25 and not partway.converged[0]
    np.testing.assert_allclose(touching.struct.mat_last.numpy()[1, 0], turned(0.25)[1], atol=1e-12)


@pytest.mark.parametrize("liquid, friction, radius, down, aside", [
    (False, 1.128, 3.3e-3, (-0.5e-3, -0.8e-3), 1.5e-3),
    (True, 0.7125, 3.2e-3, (-0.3e-3, -0.3e-3), 0.3e-3),
    (True, 1.132, 1.7e-3, (-0.7e-3, -0.6e-3), 1.5e-3),
])  # fmt: skip
def test_skin_creeps_where_newton_goes_round_in_circles(liquid, friction, radius, down, aside):
    """A ball that is dragged across the skin in one step: without creep this went in parts, or got stuck.
    What is found is a balance without viscosity, in which the skin stays, and the same to the bit again.
    The processor's rounding decides of single drags, so of three nearly alike two have to go whole."""
    skin, whole = finger(liquid=liquid), 0
    for mu in friction + np.array([-4e-3, 0.0, 4e-3]):
        found = []
        for _ in range(2):
            data, ball, parts = SkinData(skin), GeomSet(["sphere"], [(radius,)], [mu]), []
            for x, z in [(0, 0.5e-3), (0, down[0]), (aside, down[1]), (aside, down[1])]:
                before = data.vert_xpos
                ball.set_pose([[x, 0, 10e-3 + radius + z]])
                step(skin, data, ball)
                assert data.converged[0] and data.error[0] <= skin.options.tolerance
                assert data.worlds.viscosity.numpy()[0] == 0
                parts.append(data.worlds.increment.numpy()[0] != 0)
            assert data.iterations[0] <= 2 and abs(data.vert_xpos - before).max() < 2e-6
            found.append(data.vert_xpos)
        assert (found[0] == found[1]).all()
        whole += not any(parts)
    assert whole >= 2


@pytest.mark.parametrize(
    "kind, size, edge", [("box", (3e-3, 3e-3, 3e-3), 5e-4), ("capsule", (2e-3, 4e-3), 0)]
)
def test_liquid_makes_a_long_step_no_dearer(kind, size, edge):
    """Pressed 0.9 mm in one step, and left in the next: where lengths went by the pressure that the curvature
    of its volume makes, a filled skin took two to four times the work of one without liquid."""
    works = []
    for liquid in (False, True):
        skin = finger(liquid=liquid)
        data, geom = SkinData(skin), GeomSet([kind], [size], [0.5], rounding=[edge])
        for z in (0.5e-3, -0.9e-3, 0.5e-3):
            geom.set_pose([[0, 0, 10e-3 + size[0] + z]], [[[0, 0, 1], [0, 1, 0], [-1, 0, 0]]])
            step(skin, data, geom)
            assert data.converged[0] and data.worlds.increment.numpy()[0] == 0
            works.append(int(data.worlds.work.numpy()[0]))
            if z < 0:
                assert np.linalg.norm(data.wrench[0, 0, :3]) > 0.5
    dry, wet = works[1:3], works[4:]
    assert all(w <= d + 3 for w, d in zip(wet, dry, strict=True)) and dry[0] > 10


def test_creep_spares_most_drags_their_parts():
    """Single drags hang on rounding; of nine like the first one above, two went whole without creep."""
    skin, whole = finger(liquid=False), 0
    for friction in 1.13 * (1 + 5e-3 * np.arange(-4, 5)):
        data, ball = SkinData(skin), GeomSet(["sphere"], [(3.3e-3,)], [friction])
        for x, z in [(0, 0.5e-3), (0, -0.5e-3), (1.5e-3, -0.8e-3)]:
            ball.set_pose([[x, 0, 13.3e-3 + z]])
            step(skin, data, ball)
            assert data.converged[0]
        whole += data.worlds.increment.numpy()[0] == 0
    assert whole >= 5


@pytest.mark.parametrize("error, stale, lag", [(0.02, 0, 4.0), (4e-3, 10, 4.0), (4e-3, 2, 0.0)])
def test_viscosity_acts_near_balance_only_without_progress(model, error, stale, lag):
    """Rounding ends within some iterations; a circle of four times the tolerance does not."""
    st = SkinData(model, 1).worlds
    state = {"active": 1, "alpha": 1.0, "tries": 1, "error": error, "last_error": 0.9 * error}
    for name, value in {
        **state,
        "iterations": 30,
        "start_iterations": 0,
        "since": 30 - stale,
        "viscosity": 0.0,
    }.items():
        getattr(st, name).fill_(value)
    wp.launch(convergence.choose_viscosity, 1, [model.options.tolerance, st], device="cpu")
    assert st.viscosity.numpy()[0] == lag


@pytest.mark.parametrize("adhesion", [0.0, 0.05])
def test_a_skin_that_is_left_comes_to_rest_in_one_step(adhesion):
    """From a deep press, beside a skin that is still touched; also where adhesion held it."""
    model = finger(contact_law={"adhesion": adhesion})
    rest = SkinData(model, 1).vert_xpos[0]
    data, touching = press(model, [0, 0], PATH[:3])
    away = [[0, 0, 30e-3], [30e-3, 0, 0]]
    touching.set_pose([away, pose(1.4e-3)])
    step(model, data, touching)
    assert data.converged.all()
    np.testing.assert_allclose(data.vert_xpos[0], rest, rtol=0, atol=1e-9)
    assert not data.wrench[0].any() and data.wrench[1].any()


def test_numbers_of_worlds_must_agree(model):
    with pytest.raises(
        ValueError, match="geoms are for 2 worlds and the data for 1: make both for the same number"
    ):
        step(model, SkinData(model), geoms(2))
    with pytest.raises(ValueError, match="pass one corotational material for each of the 2 worlds"):
        SkinData(model, 2, [Material()])
    with pytest.raises(ValueError, match="pass one corotational material for each of the 1 worlds"):
        SkinData(model, 1, [Material("svk")])


@pytest.mark.parametrize("options, text", [
    (dict(dynamics="explicit"), "unknown dynamics 'explicit': choose one of quasistatic, implicit"),
    (dict(bulk_modulus=-1.0), "bulk_modulus is -1.0: pass a positive finite number"),
    (dict(tolerance=0.0), "tolerance is 0.0: give a finite number > 0"),
    (dict(stick_ratio=float("nan")), "stick_ratio is nan: pass a finite number"),
    (dict(contact_stiffness=0.0), "contact_stiffness is 0.0: give a finite number > 0 .Pa/m."),
    (dict(max_newton=0), "max_newton is 0: pass a number from 1"),
    (dict(mass_damping=-1.0), "mass_damping is -1.0: give a finite number >= 0"),
    (dict(stiffness_damping=float("nan")), "stiffness_damping is nan: pass a finite number"),
    (dict(core_clearance=float("nan")), "core_clearance is nan: pass a finite number"),
    (dict(max_core_depth=-1e-3), "max_core_depth is -0.001: give a finite number >= 0"),
])  # fmt: skip
def test_bad_options_are_refused(options, text):
    with pytest.raises(ValueError, match=text):
        SkinOptions(**options)


@pytest.mark.slow
def test_the_factor_of_the_deformed_shape_finds_the_same_balance(monkeypatch):
    """Nearly incompressible rubber whose first try fails is solved with another factor: the same answer, and
    the next step begins with the old one."""

    def press(fail):
        model = SkinModel(
            load_skin("coarse"),
            Material("neo_hookean", 2.8e5, 0.49),
            SkinOptions(tolerance=1e-5, max_newton=60),
        )
        data, geoms = SkinData(model), GeomSet(["sphere"], [(3.5e-3,)], friction=[0.0])
        one_try, end_try, tries = SkinStep._try, SkinStep._end_try, []

        def noted(self):
            self._launcher.call(lambda: tries.append(self.M.factor))
            one_try(self)

        def failing(self):
            self._launcher.call(lambda: self.st.failed.fill_(1) if len(tries) <= fail else None)
            end_try(self)

        monkeypatch.setattr(SkinStep, "_try", noted)
        monkeypatch.setattr(SkinStep, "_end_try", failing)
        for depth in (2e-4, 4e-4):
            tries.clear()
            geoms.set_pose([[-0.012, -0.00825 + depth - 3.5e-3, 0.0]])
            step(model, data, geoms)
            assert data.converged.all() and len(tries) in ((1,), (3, 4))[fail]
            assert tries[0] is model.factor
        monkeypatch.undo()
        return data, model, tries

    plain, _, _ = press(0)
    other, model, tries = press(1)
    assert tries[1] is not model.factor
    assert np.abs(plain.wrench).max() > 0.01
    np.testing.assert_allclose(other.vert_xpos, plain.vert_xpos, atol=2e-8)
    np.testing.assert_allclose(other.wrench, plain.wrench, atol=1e-4 * np.abs(plain.wrench).max())


@pytest.mark.parametrize(
    "name, value",
    [("dynamics", "implicit"), ("samples", 5), ("core_contact", False), ("contact_stiffness", 1e10)],
)
def test_options_that_the_data_was_not_made_for_are_refused(name, value):
    model = finger()
    data, geoms = SkinData(model), GeomSet([], [])
    step(model, data, geoms)
    model.options = dataclasses.replace(model.options, **{name: value})
    with pytest.raises(ValueError, match=rf"the model's {name} changed since its SkinData was made"):
        step(model, data, geoms, 1e-3)


@pytest.mark.parametrize(
    "options, match",
    [
        (
            dict(liquid=False, fill_volume=1e-8),
            r"fill_volume and rest_pressure are of the liquid, and this skin has",
        ),
        (dict(liquid=False, rest_pressure=1e3), r"turn it on \(liquid=True, --liquid\)"),
        (dict(mass_damping=1.0), r"act on a skin in motion: add dynamics='implicit'"),
        (dict(stiffness_damping=1e-4), r"act on a skin in motion"),
    ],
)
def test_options_that_could_not_act_are_refused(options, match):
    with pytest.raises(ValueError, match=match):
        SkinModel(finger().geometry, "default", SkinOptions(**options))
