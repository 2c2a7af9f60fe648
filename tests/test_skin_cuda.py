"""The same kernels on CUDA: needs a CUDA device and torch."""

import numpy as np
import pytest
import warp as wp

from biotac_mj.geometry import load_skin
from biotac_mj.skin import GeomSet, SkinData, SkinModel, SkinOptions, step

CUDA = wp.is_cuda_available()
pytestmark = pytest.mark.skipif(not CUDA, reason="needs a CUDA device")


def press(device, depths, x=(-0.012,), liquid=True, skin="coarse"):
    """Spheres of 7 mm diameter at positions x along the pad, one world each, pressed to each depth in turn [m]."""
    geometry = load_skin(skin)
    model = SkinModel(geometry, "default", SkinOptions(liquid=liquid, tolerance=1e-6, max_newton=40), device=device)
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
