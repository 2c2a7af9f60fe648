"""Peers on a GPU: mujoco_warp's flex on the same tetrahedra, held nodes and path as `peer_flex`, many worlds at once."""

import time

import mujoco
import numpy as np
import peer_flex
import warp as wp

from biotac_mj.geometry import SkinGeometry

__all__ = ["press"]


def press(geometry: SkinGeometry, material, radius: float, path: np.ndarray, direction: np.ndarray, worlds: int, device: str) -> dict:
    """Drives a sphere along a path in every world, one step of 2 ms for each point, in a captured graph, then holds it.

    Args:
      See `peer_flex.press`; worlds: how many; device: of Warp.

    Returns:
      ms_per_step: wall time of a step of all worlds while the sphere moves; setup_s: of making and compiling; steps: how many moved;
      force: (3,) of the skin on the sphere at the end in the first world [N]; contacts: how many it has there.
    """
    import mujoco_warp as mjw

    begin = time.perf_counter()
    model = mujoco.MjModel.from_xml_string(peer_flex.model_xml(geometry, material, radius, path[0] - 1e-5 * direction))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with wp.ScopedDevice(device):
        m = mjw.put_model(model)
        d = mjw.put_data(model, data, nworld=worlds, nconmax=256, njmax=1024)

        def place(center):
            d.mocap_pos.assign(np.tile(center, (worlds, 1, 1)).astype(np.float32))

        place(path[0])
        mjw.step(m, d)  # compiles
        with wp.ScopedCapture() as capture:
            mjw.step(m, d)
        wp.synchronize()
        setup = time.perf_counter() - begin
        begin = time.perf_counter()
        for center in path[1:]:
            place(center)
            wp.capture_launch(capture.graph)
        wp.synchronize()
        moving = time.perf_counter() - begin
        for _ in range(peer_flex.SETTLE):
            wp.capture_launch(capture.graph)
        mjw.get_data_into(data, model, d)
    moves = len(path) - 1
    return {
        "ms_per_step": 1e3 * moving / moves,
        "setup_s": setup,
        "steps": moves,
        "force": peer_flex.force_on_sphere(model, data),
        "contacts": int(data.ncon),
    }
