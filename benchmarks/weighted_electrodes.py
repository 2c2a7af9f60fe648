"""Place and force by Lin, Fishel and Loeb's weighted electrodes, against where and how hard synthetic skin is
pressed:

    python benchmarks/weighted_electrodes.py [--presses 96] [--skin default] [--json OUT]

Spheres of three sizes press at random places, in one batch each, then move along the skin. Every other press
teaches the three scales of force, the rest judge."""

import argparse
import json
import pathlib

import mujoco
import mujoco_warp as mjw
import numpy as np

from biotac_mj import batch
from biotac_mj.data.contact import contact_labels
from biotac_mj.geometry import load_skin
from biotac_mj.sensor.weighted import WeightedElectrodes

DT, REST, DOWN, ALONG = 5e-3, 6, 24, 16  # [s]; steps untouched, into the skin, along it
SPAN, ANGLE = (-14e-3, -2e-3), np.deg2rad(40)  # of places along the finger [m], around it
RADII = (2e-3, 3.5e-3, 6e-3)  # [m]
DEPTH, SLIDE = (0.4e-3, 1.8e-3), 1e-3  # [m] at the end; along the skin at most
LEAST = 0.1  # [N]: samples with less are left out


def reach(geometry, base, out, radius):
    """(n,) how far from `base` along `out` a sphere's centre is that first touches the skin at rest [m]."""
    outer, found = geometry.vert[np.unique(geometry.outer_face)], []
    for b, o in zip(base, out):
        height = (outer - b) @ o
        off = np.linalg.norm(outer - b - height[:, None] * o, axis=1)
        near = off < radius
        found.append((height[near] + np.sqrt(radius**2 - off[near] ** 2)).max())
    return np.array(found)


def press(nworld, skin, radius, seed):
    """change (nworld, n, 19) [counts], place (nworld, n, 3) [m] and force (nworld, n, 3) [N] of presses."""
    rng, geometry = np.random.default_rng(seed), load_skin(skin)
    spec = mujoco.MjSpec()
    spec.option.timestep = DT
    sphere = spec.worldbody.add_body(name="sphere", mocap=True, pos=[0, -0.05, 0])
    sphere.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0])
    batch.add(spec, body="world", skin=skin)
    mjm = spec.compile()
    mjd = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, mjd)
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=nworld)
    biotac = batch.attach(mjm, m, d, skin=skin, tier="condensed", seed=1000 * seed)

    angle, depth = rng.uniform(-ANGLE, ANGLE, nworld), rng.uniform(*DEPTH, nworld)
    zero, slide = np.zeros(nworld), rng.uniform(-SLIDE, SLIDE, (nworld, 2))
    base = np.stack([rng.uniform(*SPAN, nworld), zero, zero], 1)
    out = np.stack([zero, -np.cos(angle), np.sin(angle)], 1)
    way = slide[:, :1] * [1, 0, 0] + slide[:, 1:] * np.cross(out, [1, 0, 0])
    touch, outer, rows, rest = reach(geometry, base, out, radius), np.unique(geometry.outer_face), [], []
    electrodes, force = mjm.sensor("biotac_electrodes"), mjm.sensor("biotac_contact_force")
    for step in range(REST + DOWN + ALONG):
        part, moved = np.clip([(step - REST) / DOWN, (step - REST - DOWN) / ALONG], 0, 1)
        height = touch + 5e-4 - part * (5e-4 + depth)
        at = base + height[:, None] * out + moved * way
        d.mocap_pos.assign(at[:, None].astype(np.float32))
        mjw.step(m, d)
        data = d.sensordata.numpy().astype(float)
        counts = data[:, electrodes.adr[0] :][:, : electrodes.dim[0]]
        if step < REST:
            rest.append(counts)
        elif step >= REST + DOWN // 2:
            vert, nodal = biotac.vert_xpos, np.swapaxes(biotac.skin.data.outer.node_force.numpy(), 0, 1)
            labels = contact_labels(geometry, vert - geometry.vert, nodal[:, outer])
            rows.append((counts - np.mean(rest, 0), labels["contact_pos"], data[:, force.adr[0] :][:, :3]))
    return [np.stack(column, 1) for column in zip(*rows)]


def judge(presses, skin):
    """Errors of place and force, and the scale."""
    found = [press(presses // len(RADII), skin, radius, k) for k, radius in enumerate(RADII)]
    change, place, force = (np.concatenate(column) for column in zip(*found))
    teaches = np.arange(len(change)) % 2 == 0
    size = np.linalg.norm(force, axis=-1)
    formula, felt = WeightedElectrodes(load_skin(skin)), size > LEAST
    known = felt & teaches[:, None]
    own = formula.fitted(change[known], force[known])
    asked = felt & ~teaches[:, None]
    change, place, force, size = change[asked], place[asked], force[asked], size[asked]
    off = 1e3 * np.linalg.norm(formula.place(change) - place, axis=1)
    out = {"skin": skin, "samples": int(asked.sum()), "without_place": float(np.isnan(off).mean())}
    out |= {"place_median_mm": float(np.nanmedian(off)), "place_p90_mm": float(np.nanpercentile(off, 90))}
    rises = 1e3 * np.linalg.norm(formula.place(-np.abs(change)) - place, axis=1)
    out["place_with_rises_median_mm"] = float(np.nanmedian(rises))
    out |= {"scale": own.scale, "force_median_N": float(np.median(size))}
    for name, one in (("fitted", own), ("shipped", formula)):
        found = one.force(change)
        error = np.linalg.norm(found - force, axis=1)
        along = (found * force).sum(1) / np.maximum(np.linalg.norm(found, axis=1) * size, 1e-12)
        out[name] = {
            "median_N": float(np.median(error)),
            "median_share": float(np.median(error / size)),
            "direction_median_deg": float(np.degrees(np.median(np.arccos(np.clip(along, -1, 1))))),
            "r2": (1 - ((found - force) ** 2).sum(0) / ((force - force.mean(0)) ** 2).sum(0)).tolist(),
        }
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--presses", type=int, default=96)
    parser.add_argument("--skin", default="default")
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()
    text = json.dumps(judge(args.presses, args.skin), indent=1)
    print(text)
    if args.json:
        args.json.write_text(text)
