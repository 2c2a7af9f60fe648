"""The same kernels on CUDA: needs a CUDA device and torch."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import warp as wp

from biotac_mj.geometry import load_skin
from biotac_mj.skin import GeomSet, SkinData, SkinModel, SkinOptions, launch_step, prepare_step, step
from biotac_mj.skin.precondition.batched_inverse import invert
from biotac_mj.skin.program import Launcher

CUDA = wp.is_cuda_available()
pytestmark = pytest.mark.skipif(not CUDA, reason="needs a CUDA device")


def press(device, depths, x=(-0.012,), liquid=True, skin="coarse"):
    """Spheres of 7 mm diameter at positions x along the pad, one world each, pressed to each depth in turn
    [m]."""
    geometry = load_skin(skin)
    model = SkinModel(
        geometry, "default", SkinOptions(liquid=liquid, tolerance=1e-6, max_newton=40), device=device
    )
    data = SkinData(model, nworld=len(x))
    geoms = GeomSet(["sphere"], [(0.0035,)], friction=[0.5], nworld=len(x), device=device)
    wrench = []
    for depth in depths:
        geoms.set_pose([[[at, -0.00825 + depth - 0.0035, 0.0]] for at in x])
        step(model, data, geoms)
        assert data.converged.all()
        wrench.append(data.wrench[:, 0].copy())
    return np.array(wrench), data.vert_xpos, data.pressure


@pytest.mark.parametrize("liquid", [True, False])
def test_cuda_equals_cpu(liquid):
    # both stop at an energy error of 1e-6; the forces may differ by about as much
    depths = np.arange(1, 9) * 1e-4
    cpu, x_cpu, p_cpu = press("cpu", depths, liquid=liquid)
    gpu, x_gpu, p_gpu = press("cuda:0", depths, liquid=liquid)
    peak = np.abs(cpu).max()
    assert peak > 0.1
    np.testing.assert_allclose(gpu, cpu, atol=1e-4 * peak)
    np.testing.assert_allclose(x_gpu, x_cpu, atol=1e-8)
    np.testing.assert_allclose(p_gpu, p_cpu, atol=1e-3 * max(p_cpu.max(), 1))


def test_worlds_of_a_batch_do_not_touch_each_other():
    depths = np.arange(1, 6) * 1e-4
    together, x, _ = press("cuda:0", depths, x=(-0.014, -0.012, -0.008))
    alone, x_alone, _ = press("cuda:0", depths, x=(-0.012,))
    np.testing.assert_allclose(together[:, 1], alone[:, 0], atol=1e-4 * np.abs(alone).max())
    np.testing.assert_allclose(x[1], x_alone[0], atol=1e-8)


@pytest.mark.parametrize("rows", [5, 32, 61, 96, 127, 190, 193, 200, 263, 381, 385])
def test_small_systems_are_inverted_whatever_their_size(rows):
    """Neither symmetric nor with a large diagonal: pivots are anywhere in a column. One world is off."""
    rng = np.random.default_rng(rows)
    capacity, extra = 400, rows % 3
    A = np.zeros((3, capacity, capacity), np.float32)
    A[:, :rows, :rows] = rng.standard_normal((3, rows, rows)) + 2.0 * np.eye(rows)[rng.permutation(rows)]
    given, found = wp.array(A, device="cuda:0"), wp.zeros(A.shape, dtype=float, device="cuda:0")
    size = wp.full(3, (rows - extra) // 3, dtype=int, device="cuda:0")
    on = wp.array([1, 0, 1], dtype=int, device="cuda:0")
    invert(Launcher("cuda:0"), extra, size, on, given, found)
    B = found.numpy()[:, :rows, :rows].astype(float)
    assert not B[1].any()
    for w in (0, 2):
        exact = np.linalg.inv(A[w, :rows, :rows].astype(float))
        assert abs(B[w] - exact).max() < 1e-5 * np.linalg.cond(A[w, :rows, :rows]) * abs(exact).max()
    np.testing.assert_array_equal(B[0] != 0, np.ones((rows, rows), bool))


# --- the device step  ---


def random_worlds(n, seed):
    rng = np.random.default_rng(seed)
    return [
        dict(
            x=rng.uniform(-0.015, -0.009),
            side=rng.uniform(-2e-3, 2e-3),
            depth=rng.uniform(0.5, 1),
            friction=rng.uniform(0, 0.8),
            modulus=rng.uniform(0.7, 1.4),
            bulk=rng.choice([0.0, 1e6, 2.2e9, np.inf]),
            fill=rng.uniform(-3, 3) * 1e-9,
        )
        for _ in range(n)
    ]


def make(model, worlds):
    rubber = [
        dataclasses.replace(model.material, youngs_modulus=w["modulus"] * model.material.youngs_modulus)
        for w in worlds
    ]
    data = SkinData(model, len(worlds), rubber)
    geoms = GeomSet(["sphere"], [(0.0035,)], nworld=len(worlds), device=str(model.device))
    geoms.set_friction([[w["friction"]] for w in worlds])
    data.set_liquid([w["bulk"] for w in worlds], [w["fill"] if w["bulk"] else 0.0 for w in worlds])
    return data, geoms


def centres(worlds, depth):
    return np.array([[[w["x"], -0.00825 + w["depth"] * depth - 0.0035, w["side"]]] for w in worlds])


DEPTHS = (1e-4, 2.5e-4, 4e-4)


def test_64_random_worlds_are_each_alone_on_the_cpu():
    """Pose, friction, modulus and liquid differ; both stop at an energy error of 1e-5."""
    options = SkinOptions(liquid=True, tolerance=1e-5, max_newton=60)
    models = {
        device: SkinModel(load_skin("coarse"), "default", options, device=device)
        for device in ("cpu", "cuda:0")
    }
    worlds = random_worlds(64, seed=1)
    data, geoms = make(models["cuda:0"], worlds)
    together = []
    for depth in DEPTHS:
        geoms.set_pose(centres(worlds, depth))
        step(models["cuda:0"], data, geoms)
        assert data.converged.all()
        together.append(data.wrench[:, 0, :3])
    for i, world in enumerate(worlds):
        alone, one = make(models["cpu"], [world])
        for depth, wrench in zip(DEPTHS, together):
            one.set_pose(centres([world], depth))
            step(models["cpu"], alone, one)
            assert alone.converged.all()
            np.testing.assert_allclose(
                wrench[i], alone.wrench[0, 0, :3], rtol=0, atol=1e-3 * np.abs(together[-1]).max()
            )
        np.testing.assert_allclose(data.vert_xpos[i], alone.vert_xpos[0], rtol=0, atol=5e-7)
        np.testing.assert_allclose(data.pressure[i], alone.pressure[0], rtol=0.01, atol=5.0)


def test_a_nan_world_in_a_callers_graph_disturbs_no_other():
    """Poses are written on the device; the step is replayed with what else the caller's graph holds."""
    model = SkinModel(load_skin("coarse"), "default", SkinOptions(liquid=True), device="cuda:0")
    worlds = random_worlds(20, seed=2)
    results = []
    for spoil in (False, True):
        data, geoms = make(model, worlds)
        prepare_step(model, data, geoms)
        path = [
            wp.array(np.swapaxes(centres(worlds, d), 0, 1), dtype=wp.vec3d, ndim=2, device="cuda:0")
            for d in DEPTHS
        ]
        pose = wp.clone(path[0])
        with wp.ScopedCapture("cuda:0") as capture:
            wp.copy(geoms.struct.pos, pose)
            launch_step(model, data, geoms)
        for at in path:
            wp.copy(pose, at)
            if spoil:
                spoiled = pose.numpy()
                spoiled[0, 7, 1] = np.nan
                pose.assign(spoiled)
            wp.capture_launch(capture.graph)
        results.append((data.converged, data.nonconverged, data.wrench, data.vert_xpos))
    (sound, _, wrench, x), (converged, lost, other, y) = results
    assert sound.all() and np.flatnonzero(~converged).tolist() == [7] and lost[7] == 3
    rest = np.arange(20) != 7
    np.testing.assert_array_equal(other[rest], wrench[rest])
    np.testing.assert_array_equal(y[rest], x[rest])
    assert np.isfinite(y[7]).all() and (y[7] == model.rest.vert).all()


def test_the_step_must_be_ready_before_a_capture():
    model = SkinModel(load_skin("coarse"), "default", SkinOptions(), device="cuda:0")
    model.factor  # noqa: B018
    data, geoms = make(model, random_worlds(1, 0))
    with pytest.raises(
        ValueError, match=r"call prepare_step\(model, data, geoms\) before the capture begins"
    ):
        with wp.ScopedCapture("cuda:0"):
            launch_step(model, data, geoms)


@pytest.mark.parametrize("nworld", [1, 3, 20])
def test_a_press_done_twice_is_the_same_to_the_bit(nworld):
    model = SkinModel(load_skin("coarse"), "default", SkinOptions(liquid=True), device="cuda:0")
    worlds, results = random_worlds(nworld, seed=3), []
    for _ in range(2):
        data, geoms = make(model, worlds)
        for depth in DEPTHS:
            geoms.set_pose(centres(worlds, depth))
            step(model, data, geoms)
        results.append((data.wrench, data.vert_xpos, data.pressure))
    for first, second in zip(*results):
        np.testing.assert_array_equal(first, second)


_FEW_LANES = """
import numpy as np, warp as wp
from biotac_mj.skin.block import sum_of_lanes, sync
from biotac_mj.skin.types import real, vec3

@wp.kernel(enable_backward=False)
def add_up(lanes: int, out: wp.array2d(dtype=real)):
    w, t = wp.tid()
    for h in range(t / lanes, out.shape[1], wp.block_dim() / lanes):
        total = sum_of_lanes(vec3(real(h + 1), real(t % lanes), real(w)), lanes)
        if t % lanes == 0:
            out[w, h] = total[0] + real(1000.0) * total[1]
    sync()

for lanes in (1, 2, 8, 32):
    for sums in (1, 3, 5):
        out = wp.zeros((4, sums), dtype=real, device="cuda:0")
        wp.launch_tiled(add_up, dim=[4], inputs=[lanes], outputs=[out], device="cuda:0", block_dim=256)
        wanted = lanes * (np.arange(sums) + 1) + 1000 * lanes * (lanes - 1) / 2
        assert (out.numpy() == wanted).all(), (lanes, sums, out.numpy())
"""


def test_a_sum_of_few_lanes_does_not_wait_for_others(tmp_path):
    """Those of the warp that have nothing to add are at the next barrier; a shuffle that named them would
    wait for ever."""
    script = tmp_path / "few_lanes.py"
    script.write_text(_FEW_LANES)
    subprocess.run([sys.executable, script], check=True, timeout=300)
