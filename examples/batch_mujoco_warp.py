"""Thousands of presses at once in mujoco_warp, every world with its own place, rubber and friction: python
examples/batch_mujoco_warp.py

On a GPU the whole step (bodies, skins, liquids, films, counts) is one CUDA graph: nothing goes back to the
host until the press is over."""

import argparse
import dataclasses
import pathlib
import time

import mujoco
import mujoco_warp as mjw
import numpy as np
import tqdm
import warp as wp
from scipy.spatial import cKDTree

from biotac_mj import batch
from biotac_mj.geometry import load_skin
from biotac_mj.skin.rubber.material import material

RADIUS, DT = 3.5e-3, 2e-3  # [m], [s]


@wp.kernel
def move_spheres(inwards: wp.array(dtype=wp.vec3), mocap_pos: wp.array2d(dtype=wp.vec3)):
    w = wp.tid()
    mocap_pos[w, 0] = mocap_pos[w, 0] + inwards[w]


def scene(skin):
    """A sphere that goes where it is told, under the pad of a BioTac that is fixed."""
    spec = mujoco.MjSpec()
    spec.option.timestep = DT
    sphere = spec.worldbody.add_body(name="sphere", mocap=True)
    sphere.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0])
    batch.add(spec, body="world", skin=skin)
    return spec.compile()


def first_touch(skin, axis, outwards):
    """How far from points (n, 3) of the finger's axis a sphere's centre is when it just touches the skin's
    nodes (n,) [m]."""
    geometry = load_skin(skin) if isinstance(skin, str) else skin
    nodes = cKDTree(geometry.vert[np.unique(geometry.outer_face)])
    near, far = np.full(len(axis), 5e-3), np.full(len(axis), 25e-3)
    for _ in range(20):
        middle = 0.5 * (near + far)
        inside = nodes.query(axis + middle[:, None] * outwards)[0] < RADIUS
        near, far = np.where(inside, middle, near), np.where(inside, far, middle)
    return far


def main(nworld=None, steps=50, depth=1.5e-3, skin="default", device=None, figure=None, seed=0):
    """Presses; returns dict of youngs_modulus (nworld,), depth (steps,), force (steps, nworld, 3), electrodes
    (steps, nworld, 19). nworld: None is 1024 on a GPU, 16 on a CPU."""
    nworld = nworld or (1024 if wp.get_device(device).is_cuda else 16)
    rng = np.random.default_rng(seed)
    rubber = dataclasses.asdict(material("default"))
    youngs_modulus = rubber["youngs_modulus"] * rng.uniform(0.5, 1.5, nworld)
    along, angle = rng.uniform(-13e-3, -5e-3, nworld), rng.uniform(-0.5, 0.5, nworld)
    outwards = np.stack([0 * angle, -np.cos(angle), np.sin(angle)], axis=1)
    start = np.stack([along, 0 * along, 0 * along], axis=1)
    start += first_touch(skin, start, outwards)[:, None] * outwards

    mjm = scene(skin)
    with wp.ScopedDevice(device):
        m, d = mjw.put_model(mjm), mjw.make_data(mjm, nworld=nworld)
        biotac = batch.attach(
            mjm,
            m,
            d,
            skin=skin,
            material=[{**rubber, "youngs_modulus": e} for e in youngs_modulus],
            friction=rng.uniform(0.3, 1.0, nworld),
        )
        size = biotac.nbytes / nworld
        print(f"{nworld} worlds take {size / 1e6:.2f} MB each: about {80e9 / size:.0f} fit into 80 GB")
        d.mocap_pos.assign(start[:, None].astype(np.float32))
        inwards = wp.array(-outwards * depth / steps, dtype=wp.vec3)

        def step():
            wp.launch(move_spheres, nworld, [inwards, d.mocap_pos])
            mjw.step(m, d)

        force, electrodes = np.zeros((steps, nworld, 3)), np.zeros((steps, nworld, 19))
        at = {name: mjm.sensor(f"biotac_{name}").adr[0] for name in ("contact_force", "electrodes", "status")}
        graph, failed, seconds = None, 0, []
        for k in tqdm.trange(steps, desc=f"{nworld} presses", unit="step"):
            began = time.perf_counter()
            if graph:
                wp.capture_launch(graph)
            else:
                step()
            wp.synchronize_device()
            seconds.append(time.perf_counter() - began)
            if k == 0 and wp.get_device().is_cuda:
                with wp.ScopedCapture() as capture:
                    step()
                graph = capture.graph
            read = d.sensordata.numpy()
            force[k], electrodes[k] = (
                read[:, at["contact_force"] :][:, :3],
                read[:, at["electrodes"] :][:, :19],
            )
            failed += int((read[:, at["status"]] != 1).sum())
    rest = np.median(seconds[1:])
    print(
        f"{1e3 * rest:.2f} ms per step: {1e6 * rest / nworld:.1f} us per world and step, "
        f"{nworld / rest / steps:.0f} presses per second"
    )
    print(f"{failed} of {steps * nworld} steps found no balance; force at {1e3 * depth:.1f} mm: "
          f"{np.linalg.norm(force[-1], axis=1).mean():.2f} N on average")  # fmt: skip
    record = dict(
        youngs_modulus=youngs_modulus,
        depth=depth * np.arange(1, steps + 1) / steps,
        force=force,
        electrodes=electrodes,
        failed=failed,
    )
    if figure:
        draw(record, figure)
    return record


def draw(record, path, shown=200):
    """Force over depth and counts over force, coloured by Young's modulus."""
    from matplotlib.figure import Figure

    size = np.linalg.norm(record["force"], axis=2)
    change = record["electrodes"][:, :, 16] - record["electrodes"][0, :, 16]
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    scale = np.ptp(record["youngs_modulus"]) or 1.0
    colors = (record["youngs_modulus"] - record["youngs_modulus"].min()) / scale
    from matplotlib import colormaps

    for w in range(min(shown, size.shape[1])):
        color = colormaps["viridis"](colors[w])
        left.plot(1e3 * record["depth"], size[:, w], color=color, lw=0.7)
        right.plot(size[:, w], change[:, w], color=color, lw=0.7)
    left.set(
        xlabel="depth [mm]", ylabel="force [N]", title=f"{size.shape[1]} presses, colour: Young's modulus"
    )
    right.set(
        xlabel="force [N]", ylabel="change of E17 [counts]", title="the electrode under the pad's middle"
    )
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    print(path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--nworld", type=int, help="default 1024 on a GPU, 16 on a CPU")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--skin", default="default")
    parser.add_argument("--figure", default="out/batch.png")
    main(**vars(parser.parse_args()))
