"""Speed of the standard press inside mujoco_warp: BioTacs in every world, stepped by `mjw.step` in one
captured CUDA graph.

    python benchmarks/batch.py --json out/batch.json [--skins default] [--worlds 1,128,1024] [--increments 60]

The press of `speed.py` (its sphere, path and increments) with the default material and liquid, two-way
coupling, films, acquisition and all sensors, at MuJoCo's 2 ms. Everything between two steps is on the device;
`ms_per_step` is the mean over the press between synchronisations.
mb_per_world: device memory that grows with the number of worlds (skins and sensors); mb_used: all that the
process holds on the device beyond what it held before, mujoco_warp, torch and the model's inverse
included. largest_nworld: what fits into 80 GB."""

import argparse
import gc
import pathlib
import sys
import time

sys.path.insert(0, str(pathlib.Path(__file__).parent))

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from records import write_json
from speed import INCREMENTS, RADIUS, standard_path

from biotac_mj import batch
from biotac_mj.geometry import load_skin

__all__ = ["main", "time_batch"]

CARD = 80e9  # [bytes]


@wp.kernel
def follow(path: wp.array(dtype=wp.vec3), count: wp.array(dtype=int), mocap_pos: wp.array2d(dtype=wp.vec3)):
    w = wp.tid()
    mocap_pos[w, 0] = path[count[0]]


@wp.kernel
def advance(count: wp.array(dtype=int)):
    count[0] = count[0] + 1


def time_batch(skin: str, worlds: int, increments: int, element=None, senses=False) -> dict:
    """A row of the table; senses: with heat and vibration."""
    path, _ = standard_path(load_skin(skin), increments)
    spec = mujoco.MjSpec()
    spec.option.timestep = 2e-3
    sphere = spec.worldbody.add_body(name="sphere", mocap=True, pos=path[0])
    sphere.add_geom(name="sphere", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0])
    batch.add(spec, body="world", skin=skin)
    mjm = spec.compile()
    mjd = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, mjd)
    device = wp.get_device()
    before = device.free_memory if device.is_cuda else 0
    began = time.perf_counter()
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=worlds)
    biotac = batch.attach(
        mjm,
        m,
        d,
        skin=skin,
        options={"skin": {"element": element}} if element else None,
        **({"thermal": {"sphere": "steel"}, "textures": {"sphere": "cork"}} if senses else {}),
    )
    points, count = wp.array(path[1:].astype(np.float32), dtype=wp.vec3), wp.zeros(1, dtype=int)

    def step():
        wp.launch(follow, worlds, [points, count, d.mocap_pos])
        wp.launch(advance, 1, [count])
        mjw.step(m, d)

    step()  # compiles; the skins go back to rest
    if device.is_cuda:
        with wp.ScopedCapture() as capture:
            step()
    biotac.reset()
    count.zero_()
    wp.synchronize_device()
    setup = time.perf_counter() - began
    status, force = (mjm.sensor(f"biotac_{name}").adr[0] for name in ("status", "contact_force"))
    seconds, lost, peak = [], 0, 0.0
    for _ in range(increments):
        began = time.perf_counter()
        wp.capture_launch(capture.graph) if device.is_cuda else step()
        wp.synchronize_device()
        seconds.append(time.perf_counter() - began)
        read = d.sensordata.numpy()
        lost += int((read[:, status] != 1).sum())
        peak = float(np.linalg.norm(read[:, force : force + 3], axis=1).max())
    used = before - device.free_memory if device.is_cuda else 0
    size = biotac.nbytes / worlds
    fixed = used - size * worlds
    return {
        "device": device.name,
        "skin": skin,
        "worlds": worlds,
        "senses": senses,
        "ms_per_step": 1e3 * float(np.mean(seconds)),
        "ms_median_step": 1e3 * float(np.median(seconds)),
        "ms_slowest_step": 1e3 * max(seconds),
        "ms_per_press_and_world": 1e3 * sum(seconds) / worlds,
        "mb_per_world": size / 1e6,
        "mb_used": used / 1e6,
        "largest_nworld": int((CARD - max(fixed, 0)) / size),
        "not_converged": lost,
        "force_N": peak,
        "setup_s": setup,
    }


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--json", type=pathlib.Path, default="out/benchmarks/batch.json", help="file to write"
    )
    parser.add_argument("--skins", default="default", help="comma-separated")
    parser.add_argument("--worlds", default="1,128,1024", help="comma-separated")
    parser.add_argument("--increments", type=int, default=INCREMENTS, help="how many increments of 0.04 mm")
    parser.add_argument("--senses", action="store_true", help="each once more with heat and vibration")
    options = parser.parse_args(arguments)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    wp.config.log_level = wp.LOG_WARNING
    rows = []
    for skin in options.skins.split(","):
        sizes = [(int(w), s) for w in options.worlds.split(",") for s in (False, True)[: 1 + options.senses]]
        for worlds, senses in sizes:
            row = time_batch(skin, worlds, options.increments, senses=senses)
            rows.append(row)
            print(
                "  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()),
                flush=True,
            )
            gc.collect()
    write_json(options.json, {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
