"""The standard press of `speed.py`, timed: with the skin's public interface alone, which older checkouts have
too."""

import gc
import json
import sys
import time

import numpy as np
import warp as wp

from biotac_mj.geometry import load_skin
from biotac_mj.skin import PRESETS, GeomSet, SkinData, SkinModel, SkinOptions, prepare_step, step

__all__ = ["RADIUS", "clocks", "press", "press_seconds"]

RADIUS = 3.5e-3  # [m]


def clocks() -> np.ndarray:
    """Wall and processor time [s]."""
    return np.array([time.perf_counter(), time.process_time()])


def press(model: SkinModel, path: np.ndarray, worlds: int = 1) -> tuple[np.ndarray, np.ndarray, int]:
    """One press in all worlds, by a step that is there: allocated, compiled, and on CUDA recorded (older
    checkouts record in the first step).

    Returns:
      forces (increments, worlds, 3) [N], wall and processor seconds (increments, 2), number of steps that did
      not converge.
    """
    data = SkinData(model, worlds)
    geoms = GeomSet(
        ["sphere"], [(RADIUS,)], [model.material.friction], nworld=worlds, device=str(model.device)
    )
    geoms.set_pose(path[:1])
    ready = prepare_step(model, data, geoms)
    if hasattr(ready, "record"):
        ready.record()
    force, seconds = [], []
    for center in path[1:]:
        begin = clocks()
        geoms.set_pose(center[None])
        step(model, data, geoms)
        force.append(data.wrench[:, 0, :3].copy())  # on the host: nothing is left running
        seconds.append(clocks() - begin)
    return np.array(force), np.array(seconds), int(data.nonconverged.sum())


def press_seconds(skin, element, liquid, device, worlds, path, material="paper") -> float:
    """The press in this process, after a few steps that compile: seconds of the processor on the CPU, of wall
    time on CUDA."""
    path, options = np.array(path), SkinOptions(element=element, liquid=liquid)
    model = SkinModel(load_skin(skin), PRESETS[material], options, device=device)
    press(model, path[:3], worlds)
    gc.collect()  # a collection takes 0.1 s and falls where it likes
    return float(press(model, path, worlds)[1].sum(0)[1 if device == "cpu" else 0])


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_WARNING
    print(press_seconds(*json.loads(sys.argv[1])))
