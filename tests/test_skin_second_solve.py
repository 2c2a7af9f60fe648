"""Worlds that find no balance among many, solved once more by themselves (`skin.second_solve`)."""

import numpy as np
import pytest
import warp as wp
from test_skin_step import finger

from biotac_mj.skin import ContactLaw, GeomSet, Material, SkinData, SkinModel, SkinOptions, step
from biotac_mj.skin.newton.worlds import NOT_CONVERGED
from biotac_mj.skin.second_solve import SingleWorld

DEPTHS = (-1e-4, 4e-4, 1.2e-3, 1.0e-3)  # [m]
SHARE = np.array([0.3, 1.0, -1.0])  # of the depth, in each world; the last touches nothing


DEVICES = ["cpu", *(["cuda:0"] if wp.is_cuda_available() else [])]


def model_of(material=None, device="cpu", **options):
    """A ball whose steps may take so little work that conjugate gradients must not have to help much."""
    ball, options = finger(), {"max_work": 44, "tolerance": 1e-4, "max_newton": 60} | options
    return SkinModel(ball.geometry, material or ball.material, SkinOptions(**options), device)


def press(model, preconditioner, second_solve, monkeypatch, share=SHARE, load=None):
    """Presses of some worlds, of which the dense small system holds four touching nodes."""
    monkeypatch.setattr(SkinData, "contact_capacity", 4)
    data = SkinData(model, len(share), preconditioner=preconditioner)
    data.set_external(load)
    geoms = GeomSet(["sphere"], [(3.5e-3,)], nworld=len(share), device=model.device)
    steps = []
    for depth in DEPTHS:
        geoms.set_pose([[[0.3 * depth, 0, 13.5e-3 - depth * s]] for s in share])
        step(model, data, geoms, 0.01, second_solve=second_solve)
        now = [data.converged, data.load_factor, data.wrench[:, 0], data.tangent(geoms)[:, 0], data.vert_xpos]
        now.append(data.worlds.increment.numpy())
        steps.append([a.copy() for a in now])
    return steps, data


MATERIALS = {
    "rubber": (None, {}, 1e-3),
    # the rest goes at once; with a work of 44 the last bit of the liquid's volume decides whether it is found
    "memory": (Material("neo_hookean", 5e5, 0.45, prony=((0.2, 0.05),)), {"max_work": 36}, 0.03),
    "law": (None, {"contact_law": ContactLaw(0.5)}, 1e-3),
    "filled": (None, {"rest_pressure": 2e3, "liquid": True}, 1e-3),
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", MATERIALS)
def test_what_conjugate_gradients_do_not_find(kind, device, monkeypatch):
    material, options, off = MATERIALS[kind]
    model = model_of(material, device, **options)
    left, data_left = press(model, "dense", False, monkeypatch)
    found, data = press(model, "dense", True, monkeypatch)
    true, _ = press(model_of(material, **options), "sparse", True, monkeypatch)
    assert data_left.nonconverged[1] > 1 and data_left.load_factor[1] < 1 and not data_left.nonconverged[2]
    np.testing.assert_array_equal(data.nonconverged, 0)
    for a, b in zip(found, true, strict=True):
        assert a[0].all() and (a[1] == 1).all()
        np.testing.assert_allclose(a[4], b[4], atol=1e-6)
        np.testing.assert_allclose(a[2], b[2], rtol=off, atol=1e-3)
        size = np.linalg.norm(b[3][:, :3, :3], axis=(1, 2))
        np.testing.assert_allclose(np.linalg.norm(a[3][:, :3, :3], axis=(1, 2)), size, rtol=0.05)
    for a, b in zip(found, left, strict=True):  # the others do not notice
        np.testing.assert_array_equal(a[4][2], b[4][2])


@pytest.mark.parametrize("device", DEVICES)
def test_side_by_side(device, monkeypatch):
    """The same to the bit in any number of threads, also where there are fewer than worlds and one skin is
    several of them in turn; loads on the nodes go along."""
    model, share = model_of(device=device), np.array([1.0, 0.95, -1.0, 0.9, 0.85, 1.0])
    load = np.zeros((len(share), model.nvert, 3))
    load[:, model.free[::7], 2] = 1e-3 * np.arange(len(share))[:, None]
    found = []
    for threads in (1, 2, 3, 8):
        monkeypatch.setattr("biotac_mj.skin.second_solve.cores", lambda threads=threads: threads)
        steps, data = press(model, "dense", True, monkeypatch, share, load)
        (one,) = data.steps.values()
        found.append(steps)
        # five worlds are lost at once on the CPU, four on CUDA, which sums in another order
        assert (
            min(threads, 4) <= len(one._second_solve._single_worlds) <= min(threads, 5)
            and not data.nonconverged.any()
        )
    for steps in found[1:]:
        for a, b in zip(steps, found[0], strict=True):
            for value, expected in zip(a, b, strict=True):
                np.testing.assert_array_equal(value, expected)
    true, _ = press(model_of(), "sparse", True, monkeypatch, share, load)
    for a, b in zip(found[0], true, strict=True):
        np.testing.assert_allclose(a[4], b[4], atol=1e-6)
    assert np.ptp(true[2][4][[0, 5]], axis=0).max() > 1e-5  # alike but for their loads


def test_skin_that_sticks(monkeypatch):
    """Motion and increment of each step are those of all of it, and what sticks is remembered: asked for the
    same pose again, the skin bears the same."""
    monkeypatch.setattr(SkinData, "contact_capacity", 4)
    model, begun, second_solve = model_of(), None, []
    data = SkinData(model, preconditioner="dense")
    geoms = GeomSet(["sphere"], [(3.5e-3,)], friction=[0.8])
    for depth in DEPTHS:
        pos, x = np.array([0.3 * depth, 0, 13.5e-3 - depth]), data.vert_xpos[0]
        geoms.set_pose([pos])
        step(model, data, geoms)
        assert data.converged[0]
        np.testing.assert_allclose(data.increment.numpy()[:, 0], data.vert_xpos[0] - x, atol=1e-12)
        if begun is not None:
            np.testing.assert_allclose(data.motion[0, 0], pos - begun, atol=1e-12)
        begun, wrench = pos, data.wrench[0, 0]
        second_solve.append(data.worlds.increment.numpy()[0])  # a step in parts, to gradients
        step(model, data, geoms)
        assert data.iterations[0] == 0
        np.testing.assert_allclose(data.wrench[0, 0], wrench, atol=1e-5)
    assert np.count_nonzero(second_solve) > 1
    sideways, push = -wrench[0], wrench[2]
    assert 0.05 < sideways / push < 0.8


def test_not_for_ever(monkeypatch):
    """What has no balance alone either is asked for twice, and then not until one was found."""
    tried = []

    def find_nothing(self):
        tried.append(self.data.worlds.nonconverged.numpy()[0])
        self.data.worlds.reason.fill_(int(NOT_CONVERGED))

    monkeypatch.setattr(SingleWorld, "_run", find_nothing)
    monkeypatch.setattr(SkinData, "contact_capacity", 4)
    model = model_of()
    data, geoms = SkinData(model, preconditioner="dense"), GeomSet(["sphere"], [(3.5e-3,)])
    for depth in (-1e-4, 1.2e-3, 1.2e-3, 1.2e-3, 1.2e-3, -1e-3, 1.2e-3):
        geoms.set_pose([[0, 0, 13.5e-3 - depth]])
        step(model, data, geoms)
    assert tried == [1, 2, 5] and data.nonconverged == 5
