"""The batch's examples run headless; a simulator without a callback is served between its steps."""

import importlib.util
import pathlib
import sys

import mujoco
import numpy as np
import pytest
import warp as wp

pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
sys.path.insert(0, str(pathlib.Path(__file__).parent))

# ruff: noqa: E402
from test_batch import ball_spec, press_spec, shell

import biotac_mj
from biotac_mj import batch


def example(name):
    path = pathlib.Path(__file__).resolve().parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_presses_in_mujoco_warp(tmp_path):
    figure = tmp_path / "batch.png"
    record = example("batch_mujoco_warp").main(nworld=3, steps=10, depth=1e-3, skin=shell(), figure=figure)
    force = np.linalg.norm(record["force"], axis=2)
    assert record["failed"] == 0 and (force[-1] > 0.1).all() and (np.diff(force, axis=0) >= 0).all()
    assert (
        record["electrodes"].shape == (10, 3, 19)
        and np.abs(record["electrodes"][-1] - record["electrodes"][0]).max() > 20
    )
    assert figure.stat().st_size > 10_000


def test_poses_between_the_steps_of_another_simulator():
    """MuJoCo itself stands for it: forces on the bodies are those of the engine plugin, one-way, at the same
    poses."""
    spec = press_spec()
    exact = {"skin": {"tolerance": 1e-5}}
    handle = biotac_mj.attach(
        spec,
        body="world",
        skin=shell(),
        readings="none",
        coupling="one-way",
        options=exact,
        pos=[0.01, 0.02, 0.03],
        quat=[0.8, 0.6, 0, 0],
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    plain = press_spec()
    batch.add(
        plain, body="world", skin=shell(), coupling="one-way", pos=[0.01, 0.02, 0.03], quat=[0.8, 0.6, 0, 0]
    )
    mjm = plain.compile()
    skins = batch.make(mjm, 2, device="cpu", skin=shell(), readings=False, options=exact)
    frame = np.array([[1, 0, 0], [0, 0.28, -0.96], [0, 0.96, 0.28]])
    for k in range(8):
        local = np.array([-9e-3, -10.6e-3 + 1e-4 * k, 7e-4])
        data.mocap_pos[0] = frame @ local + [0.01, 0.02, 0.03]
        mujoco.mj_step(model, data)
        arrays = [
            np.stack([a, a]).astype(np.float32) for a in (data.xpos, data.xmat.reshape(-1, 3, 3), data.xipos)
        ]
        skins.step(*arrays)
    expected = handle.read(data, "contact_force")
    assert np.linalg.norm(expected[:3]) > 0.1
    np.testing.assert_allclose(
        skins.readings()["contact_force"].numpy()[1], expected, atol=2e-3 * np.abs(expected).max()
    )
    force = skins.xfrc_applied.numpy()[0]
    pin, core = model.body("pin").id, model.body(handle.body).id
    np.testing.assert_allclose(force[core, :3], frame @ expected[:3], atol=2e-3 * np.abs(expected).max())
    np.testing.assert_allclose(force[pin, :3], -force[core, :3], atol=1e-6)
    arm = data.xipos[pin] - data.xipos[core]  # the two wrenches balance about any point
    np.testing.assert_allclose(force[pin, 3:] + force[core, 3:] + np.cross(arm, force[pin, :3]), 0, atol=1e-7)
    with pytest.raises(ValueError, match=r"xpos has shape \(1, 3, 3\) of float32: pass \(2, 3, 3\)"):
        skins.step(arrays[0][:1], *arrays[1:])


def test_wp_arrays_are_taken_as_they_are():
    spec = ball_spec()
    batch.add(spec, body="world", skin=shell(), coupling="one-way")
    mjm = spec.compile()
    skins = batch.make(mjm, 1, device="cpu", skin=shell(), readings=False)
    data = mujoco.MjData(mjm)
    data.qpos[0] = 4e-4
    mujoco.mj_kinematics(mjm, data)
    mujoco.mj_comPos(mjm, data)
    arrays = [data.xpos, data.xmat.reshape(-1, 3, 3), data.xipos]
    kinds = (wp.vec3, wp.mat33, wp.vec3)
    skins.step(
        *(wp.array(a[None].astype(np.float32), dtype=k, ndim=2, device="cpu") for a, k in zip(arrays, kinds))
    )
    first = skins.xfrc_applied.numpy().copy()
    skins.reset()
    skins.step(*(a[None].astype(np.float32) for a in arrays))
    np.testing.assert_array_equal(first, skins.xfrc_applied.numpy())
    assert first[0, mjm.body("ball").id, 1] < 0 or np.abs(first).max() == 0


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device: poses on it, a batch on the CPU")
def test_poses_on_another_device_are_refused():
    """Their memory is not there to read."""
    spec = ball_spec()
    batch.add(spec, body="world", skin=shell(), coupling="one-way")
    mjm = spec.compile()
    skins = batch.make(mjm, 1, device="cpu", skin=shell(), readings=False)
    poses = (wp.zeros((1, mjm.nbody, *rest), dtype=float, device="cuda:0") for rest in ((3,), (3, 3), (3,)))
    with pytest.raises(ValueError, match="xpos is on cuda:0, the batch on cpu: bring it there"):
        skins.step(*poses)
