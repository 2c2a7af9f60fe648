"""Presses of the condensed tier in many worlds at once.

    python benchmarks/condensed_worlds.py --json out/condensed_worlds.json --device cuda:0

A sphere of 7 mm goes 0.96 mm into the pad in steps of 0.04 mm, the same in all worlds, default material
with liquid. Milliseconds a step (mean without the first, and largest), and of the press for each world. No
film: what the skin costs alone."""

import argparse
import pathlib
import sys
import time

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))

__all__ = ["main"]

STEPS, BY, RADIUS = 25, 4e-5, 7e-3


def press(skin, nworld, device):
    """Seconds of each step, and the force of the first world at the end [N]."""
    import warp as wp

    from biotac_mj.coupling.config import Config
    from biotac_mj.coupling.steppers.fem import shared_model, skin_settings
    from biotac_mj.geometry.skins import skin_reference
    from biotac_mj.skin import GeomSet, SkinData
    from biotac_mj.skin.condensed import CondensedStep, LinearSkin
    from biotac_mj.skin.settings import Settings

    settings = Settings(*skin_settings(Config(name="press_", skin=skin)))
    geometry = skin_reference(skin)[1]
    model, twin = (shared_model(geometry, settings, where) for where in (device, "cpu"))
    geoms = GeomSet(["sphere"], [(RADIUS, 0, 0)], friction=[0.8], nworld=nworld, device=device)
    data = SkinData(model, nworld)
    step = CondensedStep(model, LinearSkin.of(twin), data, geoms)
    tangent = wp.zeros((1, nworld), dtype=wp.spatial_matrixd, device=device)
    geoms.struct.pos_last.fill_(wp.vec3d(np.nan, np.nan, np.nan))
    geoms.struct.mat.assign(np.tile(np.eye(3), (1, nworld, 1, 1)))
    taken = []
    for k in range(STEPS):
        pos = [-12e-3, twin.rest.vert[:, 1].min() - RADIUS + k * BY, 0]
        geoms.struct.pos.assign(np.tile(pos, (1, nworld, 1)))
        wp.synchronize_device(device)
        begin = time.perf_counter()
        step.launch(tangent)
        wp.synchronize_device(device)
        taken.append(time.perf_counter() - begin)
        if (data.worlds.reason.numpy() != 0).any():
            raise RuntimeError(f"step {k} found no balance")
    return np.array(taken), data.geom_memory(1, 1)[2].numpy()[0, 0, :3].tolist()


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", type=pathlib.Path, required=True, help="file to write")
    parser.add_argument("--device", default="cuda:0", help="of Warp")
    parser.add_argument("--skins", default="coarse,default", help="comma-separated")
    parser.add_argument("--worlds", default="1,128,1024,4096", help="comma-separated")
    options = parser.parse_args(arguments)
    import warp as wp
    from records import write_json

    rows = []
    for skin in options.skins.split(","):
        press(skin, 1, options.device)  # compiles, and makes what is kept
        for nworld in map(int, options.worlds.split(",")):
            taken, force = press(skin, nworld, options.device)
            row = {"skin": skin, "worlds": nworld, "step_ms": 1e3 * float(taken[1:].mean())}
            row |= {"slowest_ms": 1e3 * float(taken[1:].max()), "press_ms": 1e3 * float(taken.sum()) / nworld}
            rows.append(row | {"force_n": force})
            print(", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    write_json(options.json, {"device": wp.get_device(options.device).name, "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
