"""Nearly incompressible rubber pressed onto the core: no step may pass for a balance that a skin cannot
have."""

import pathlib
import sys

import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation

from biotac_mj.geometry import load_skin
from biotac_mj.skin import PRESETS, GeomSet, Material, SkinData, SkinModel, SkinOptions, step
from biotac_mj.skin.contact.meshes import bake_distance_grid
from biotac_mj.skin.contact.posed import Geoms
from biotac_mj.skin.contact.shapes import distance_bound
from biotac_mj.skin.forces import Forces
from biotac_mj.skin.precondition import dense, sparse
from biotac_mj.skin.precondition.pushed_forward import PushForward
from biotac_mj.skin.program import Launcher
from biotac_mj.skin.state_arrays import StateArrays
from biotac_mj.skin.step import prepare_step

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "benchmarks"))
import rubber  # noqa: E402

NOTHING = GeomSet([], [])


def _sphere_at(geoms, depth):
    geoms.set_pose([[-0.012, -0.00825 + depth - 3.5e-3, 0.0]])
    return geoms


@pytest.fixture(scope="module")
def model():
    return SkinModel(load_skin("coarse"), "ansys")


@wp.kernel(enable_backward=False)
def _bound(geoms: Geoms, p: wp.array(dtype=wp.vec3d), out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    out[i] = distance_bound(geoms.kind[0], geoms.size[0], geoms.rounding[0], geoms.grids, geoms.grid[0], p[i])


def test_distance_outside_a_grid_is_a_close_lower_bound():
    body = trimesh.creation.box((4e-3, 6e-3, 10e-3))
    grid = bake_distance_grid(body.vertices, body.faces, spacing=4e-4, margin=3e-3)
    geoms = GeomSet(["mesh"], [(0, 0, 0)], [0.0], grids=[grid])
    p = np.random.default_rng(0).uniform(-3e-2, 3e-2, (2000, 3))
    out = wp.zeros(len(p), dtype=wp.float64, device="cpu")
    wp.launch(
        _bound,
        dim=len(p),
        inputs=[geoms.struct, wp.array(p, dtype=wp.vec3d, device="cpu")],
        outputs=[out],
        device="cpu",
    )
    exact = np.linalg.norm(np.maximum(np.abs(p) - [2e-3, 3e-3, 5e-3], 0), axis=1)
    beyond = (np.abs(p) > np.array([2e-3, 3e-3, 5e-3]) + 4e-3).any(1)
    assert beyond.sum() > 1000
    bound = out.numpy()[beyond]
    assert (bound <= exact[beyond]).all() and (bound > 0.7 * exact[beyond] - 4e-4).all()


def _pressed_in(model):
    """Nodes of the inner surface that start within 1.3 mm of the core's belly, half a millimetre in it."""
    x = model.geometry.vert.copy()
    nodes = np.intersect1d(np.unique(model.core_surface.face_np), model.free)
    nodes = nodes[(x[nodes, 1] < -6.3e-3) & (np.abs(x[nodes, 0] + 9e-3) < 3e-3)]
    assert len(nodes) > 3
    x[nodes, 1] = -4.8e-3
    return x, nodes


@pytest.mark.parametrize("trial", [5e-2, np.nan])
def test_a_trial_far_away_does_not_make_the_skin_lose_the_core(model, trial):
    """A face that a bad trial of Newton's method put beyond the core's distance grid, or nowhere, meets the
    core when it is back."""
    x, nodes = _pressed_in(model)

    def core_force(first):
        data = SkinData(model)
        solved = prepare_step(model, data, NOTHING)
        for place in first:
            data.x.numpy()[:, 0] = place
            solved.evaluate_forces()
        return data.core_force[0].copy()

    away = model.geometry.vert.copy()
    away[nodes, 1] -= trial
    plain = core_force([x])
    assert np.linalg.norm(plain[nodes].sum(0)) > 10
    np.testing.assert_array_equal(core_force([x, away, x]), plain)


def test_a_shape_that_no_skin_can_have_is_not_converged(model):
    data = SkinData(model)
    solved = prepare_step(model, data, NOTHING)

    def possible(x):
        data.x.numpy()[:, 0] = x
        data.worlds.unfinished.fill_(1)
        data.worlds.failed.zero_()
        solved._launcher = Launcher("cpu")
        # as in a step, forces come first: they find what is inverted
        data.worlds.inverted.zero_()
        solved.k.elements.evaluate_corners(
            solved._launcher, data.x, data.worlds.unfinished, data.worlds.inverted
        )
        solved._end_try()
        return data.worlds.failed.numpy()[0] == 0

    rest = model.geometry.vert
    assert possible(rest)
    assert possible(1.05 * rest)
    assert not possible(_pressed_in(model)[0])
    element = model.geometry.elem[np.isin(model.geometry.elem, model.fixed).sum(1) == 0][0]
    folded = rest.copy()
    folded[element[0]] += 1.2 * (
        rest[element[1:4]].mean(0) - rest[element[0]]
    )  # a corner through the face opposite
    assert not possible(folded)


@pytest.mark.slow
def test_skin_that_lost_the_core_is_reported(monkeypatch):
    """Pressed through a core that it cannot feel, the skin finds a balance at every depth; none of those
    deeper in the core than the limit counts, and it stays where it is within."""
    contact, model = Forces._evaluate_contact, SkinModel(load_skin("coarse"), "default")

    def blind(self, program, state, *arguments):
        if state is not self.d.core:
            contact(self, program, state, *arguments)

    def press():
        data, geoms = SkinData(model), GeomSet(["sphere"], [(3.5e-3,)], friction=[0.0])
        good, deepest, volume = [], [], []
        for depth in np.arange(2e-4, 2.5e-3, 2e-4):
            step(model, data, _sphere_at(geoms, depth))
            volume.append(data.volume[0])
            good.append(bool(data.converged[0]))
            deepest.append(rubber.shape(model, data.vert_xpos[0])[1])
        np.testing.assert_allclose(volume, model.liquid_volume, rtol=1e-5)  # kept, on the core too
        return good, np.array(deepest)

    good, deepest = press()
    assert all(good) and deepest.max() < 5e-5
    monkeypatch.setattr(Forces, "_evaluate_contact", blind)
    good, deepest = press()
    assert not good[-1] and good[0] and deepest.max() < model.crushed_depth


@pytest.mark.parametrize("law", ["neo_hookean", "corotational"])
def test_the_inverse_is_carried_by_what_keeps_volume(law):
    """Of a skin that is turned and stretched as a whole: the isochoric part of that, or the rotation; where
    it is inside out, nothing."""
    skin = SkinModel(load_skin("coarse"), Material(law, 1e6, 0.499), SkinOptions(liquid=False))
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    stretch = np.array([[1.3, 0.1, 0.0], [0.1, 0.9, 0.05], [0.0, 0.05, 1.1]])
    F = turn @ stretch
    x = np.stack([skin.rest.vert @ F.T, skin.rest.vert @ np.diag([1.0, 1.0, -1.0])], axis=1)
    carrier = PushForward(skin.elements, wp.array(x, dtype=wp.vec3d, ndim=2, device="cpu"))
    carrier.measure(np.array([0, 1]))
    wanted = F / np.cbrt(np.linalg.det(F)) if law == "neo_hookean" else turn
    np.testing.assert_allclose(carrier.matrix[:, 0], np.broadcast_to(wanted, (skin.nvert, 3, 3)), atol=1e-9)
    np.testing.assert_array_equal(carrier.matrix[:, 1], np.broadcast_to(np.eye(3), (skin.nvert, 3, 3)))


@pytest.mark.slow  # quick: the same of the sparse one's matrices, above
def test_carried_the_dense_inverse_takes_fewer_products(monkeypatch):
    """For the same balance, and tangents of bodies that are those of the inverse at rest."""

    def press():
        # by the default tolerance the two balances are up to 0.43 % of their force apart, by the processor
        model = SkinModel(load_skin("coarse"), "ansys", SkinOptions(tolerance=1e-4))
        data = SkinData(model, 2, preconditioner="dense")
        geoms, products = GeomSet(["sphere"], [(3.5e-3,)], friction=[0.5], nworld=2), 0
        for depth in (0, 3e-4, 6e-4):
            step(model, data, _sphere_at(geoms, depth))
            assert data.converged.all()
            products += data.worlds.work.numpy()[-1]
        return products, data.wrench[-1, 0, :3].copy(), data.tangent(geoms)[-1, 0]

    pushed, force, tangent = press()
    monkeypatch.setattr(dense, "pushes_forward", lambda *of: False)
    rest, force_at_rest, tangent_at_rest = press()
    assert pushed < 0.6 * rest
    np.testing.assert_allclose(force, force_at_rest, atol=3e-3 * np.abs(force).max())
    np.testing.assert_allclose(tangent, tangent_at_rest, atol=2e-2 * np.abs(tangent[:3, :3]).max())


@pytest.mark.slow  # quick: balances of rubber near nu 0.5
def test_carried_the_inverse_takes_fewer_products(model, monkeypatch):
    """In each of two worlds and alone, for the same balance; the small system is that of the same inverse."""

    def press(worlds):
        data = SkinData(model, worlds)
        geoms, products = GeomSet(["sphere"], [(3.5e-3,)], friction=[0.5], nworld=worlds), 0
        for depth in np.linspace(0, 8e-4, 5):  # with too few products for a lone world's factor of its own
            step(model, data, _sphere_at(geoms, depth))
            assert data.converged.all()
            products += data.worlds.work.numpy()[-1]
        return products, data.wrench[-1, 0, :3].copy()

    (alone, force), (both, force_of_two) = press(1), press(2)
    assert both == alone
    np.testing.assert_allclose(force_of_two, force, rtol=1e-9)
    monkeypatch.setattr(sparse, "pushes_forward", lambda *of: False)
    rest, force_at_rest = press(2)
    assert alone < 0.7 * rest
    np.testing.assert_allclose(force, force_at_rest, atol=3e-3 * np.abs(force).max())


@pytest.mark.slow
def test_a_step_with_a_renewed_factor_is_a_function_of_its_state(model, monkeypatch):
    """The factor of the deformed shape is made within a step and forgotten with it: fresh SkinData at that
    state steps alike, bitwise."""
    made = []
    monkeypatch.setattr(sparse, "_FACTOR", 5)
    factor_at = SkinModel.factor_at
    monkeypatch.setattr(SkinModel, "factor_at", lambda self, x: made.append(1) or factor_at(self, x))
    data, geoms = SkinData(model), GeomSet(["sphere"], [(3.5e-3,)], friction=[0.5])
    for depth in (0, 3e-4, 6e-4):
        step(model, data, _sphere_at(geoms, depth))
        assert data.converged.all()
    state = StateArrays(data, geoms).save()
    made.clear()
    step(model, data, _sphere_at(geoms, 9e-4))
    assert made and data.converged.all() and data.preconditioner.factor is not model.factor
    fresh, geoms = SkinData(model), GeomSet(["sphere"], [(3.5e-3,)], friction=[0.5])
    StateArrays(fresh, geoms).load(state)
    _sphere_at(geoms, 6e-4).advance()
    step(model, fresh, _sphere_at(geoms, 9e-4))
    np.testing.assert_array_equal(fresh.vert_xpos, data.vert_xpos)
    np.testing.assert_array_equal(fresh.wrench, data.wrench)
    made.clear()
    step(model, data, geoms)  # where the sphere is
    assert not made and data.preconditioner.factor is model.factor
    enclosed = [
        trimesh.Trimesh(v, model.geometry.inner_face, process=False).volume
        for v in (model.geometry.vert, fresh.vert_xpos[0])
    ]
    assert abs((enclosed[1] - enclosed[0]) / model.liquid_volume) < 2e-6  # the liquid's volume is kept


@pytest.mark.slow
@pytest.mark.parametrize("indenter, least, most", [("sphere_7mm", 2.8, 3.6), ("cube_14mm", 13.0, 17.0)])
def test_the_preset_bears_a_press_to_the_core(model, indenter, least, most):
    """Every step in balance; force grows with depth, on the core steeply; no element inverted, no skin in the
    core, liquid kept."""
    found = rubber.press("coarse", indenter)
    force = np.array(found["force_N"])
    assert found["not_converged"] == 0 and found["steps"] == 24
    assert (np.diff(force) > 0).all() and least < force[-1] < most
    assert np.diff(force)[-1] > 20 * np.diff(force)[3]
    assert found["least_jacobian"] > 0.5 and found["deepest_in_core_um"] < 60
    assert np.abs(found["pressure_Pa"]).max() < 3e3
    assert (
        PRESETS["ansys"].poissons_ratio == 0.499
        and PRESETS["ansys"].friction == 0.186
        and PRESETS["ansys"].youngs_modulus == 2.8e5
    )
