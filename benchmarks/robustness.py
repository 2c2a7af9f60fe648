"""Random presses through the public interface: does a skin ever lose its way?

    python benchmarks/robustness.py --presses 20000 --json out/robustness.json [--seed 0]
    [--tier full|condensed|both] [--skin coarse|default] [--worlds W] [--device cuda:0] [--minutes M]

A press: one of six shapes of random size and edge, anywhere on the skin, up to 35 degrees off its normal, on
a random rubber (a preset or a law with nu up to 0.4999), with and without liquid, friction law and adhesion.
It comes near, presses, slides and turns, presses again or gives way, and leaves, each in steps of their own
length from 2 um to 10 mm. One in ten asks for more than there is room for. Every row is appended to OUT.jsonl
when its batch is done; the same command goes on where it was stopped, or where --minutes ended it. Presses
depend on seed, tier, skin and worlds alone. With --worlds as many presses run at once, each on its own geom
and path, all on one rubber of different moduli.

A pose is infeasible where the geom comes nearer to the rigid core than ROOM times the thickness of the skin:
rubber squeezed to nothing. Steps to such poses are counted apart, and need not converge.
presses, steps; not_converged: steps to feasible poses that did not; infeasible: steps to poses that are;
nan: steps with a number that is not finite; exceptions: presses that raised; stuck: presses with more than
three steps to feasible poses in a row that did not converge; slowest_s: processor seconds of the slowest step
(on a GPU seconds; of a batch: of all its worlds together), slowest_ratio: over the median of its press's
steps in contact. Of the full tier also, for each world by itself, most_work: evaluations and products of the
dearest step, which hang on nothing but the input, work_ratio: over the median of its press's steps in
contact, above_20: presses where that is above 20."""

import argparse
import dataclasses
import functools
import gc
import json
import math
import os
import pathlib
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(pathlib.Path(__file__).parent))

import numpy as np
import trimesh
import warp as wp
from records import write_json
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from biotac_mj.geometry import load_skin
from biotac_mj.skin import (
    PRESETS,
    ContactLaw,
    GeomSet,
    Material,
    SkinData,
    SkinModel,
    SkinOptions,
    bake_distance_grid,
    step,
)
from biotac_mj.skin.condensed import CondensedSkin, CondensedStep, LinearSkin, Memory
from biotac_mj.skin.contact.posed import Geoms
from biotac_mj.skin.contact.shapes import distance
from biotac_mj.skin.types import real, vec3

__all__ = ["main", "press_batch", "summary"]

KINDS = ("sphere", "box", "capsule", "cylinder", "ellipsoid", "mesh")
STEPS = 2e-6, 10e-3  # shortest and longest [m]
MOST = 12  # steps of a stretch of the way
LARGEST = "slowest_s", "slowest_ratio", "most_work", "work_ratio"
AWAY = 10.0  # where the geoms are that a world does not use [m]
BACK = 60e-3  # from which a geom comes [m]
ROOM = 0.15  # of the skin's thickness
SAME_RUBBER = 8  # presses in a row, at least, on one model: its factor is made once


@wp.kernel(enable_backward=False)
def _clearance(points: wp.array(dtype=vec3), geoms: Geoms, out: wp.array2d(dtype=real)):
    """Distance of the nearest of some points from each geom."""
    g, w = wp.tid()
    R = wp.transpose(geoms.mat[g, w])
    nearest = real(1.0e3)
    for i in range(points.shape[0]):
        y = R * (points[i] - geoms.pos[g, w])
        dn = distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
        nearest = wp.min(nearest, dn[3])
    out[g, w] = nearest


def clearance(points: wp.array, geoms: GeomSet) -> np.ndarray:
    """(nworld, ngeom) least distance of the points from each geom where it is [m]."""
    out = wp.zeros((geoms.count, geoms.nworld), dtype=real, device=geoms.device)
    wp.launch(_clearance, out.shape, [points, geoms.struct], [out], device=geoms.device)
    return out.numpy().T


def _log_uniform(rng, low, high):
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


# --- what presses on what ---


def rubber(rng: np.random.Generator, tier: str) -> tuple[Material, SkinOptions]:
    """A preset, or a law with random constants; liquid or none; sometimes a law of contact."""
    if rng.random() < 0.4:
        chosen = PRESETS[rng.choice(sorted(PRESETS))]
    else:
        nu = rng.choice([rng.uniform(0.2, 0.45), 0.5 - _log_uniform(rng, 1e-4, 5e-2)])
        law = str(rng.choice(["corotational", "neo_hookean"]))
        chosen = Material(law, _log_uniform(rng, 1e5, 3e6), float(nu))
    law = None
    if tier == "full" and rng.random() < 0.25:
        law = ContactLaw(rng.uniform(0, 1), adhesion=float(rng.choice([0.0, 0.05])))
    return chosen, SkinOptions(liquid=bool(rng.random() < 0.5), contact_law=law)


@functools.lru_cache(maxsize=1)
def skin_model(skin: str, seed: int, tier: str, device: str, number: int) -> SkinModel:
    """The model of so many batches, with the nodes of its outer surface, and its twin on the CPU."""
    rng = np.random.default_rng([seed, number, 1])
    made = rubber(rng, tier)
    model = SkinModel(load_skin(skin), *made, device=device)
    if tier == "condensed" and model.device.is_cuda:
        model.twin = SkinModel(load_skin(skin), *made)
    g = model.geometry
    model.outside = wp.array(g.vert[np.unique(g.outer_face)], dtype=vec3, device=device)
    return model


def some_geoms(rng: np.random.Generator, count: int, nworld: int, device: str) -> GeomSet:
    """One geom for each press at hand, of every kind in turn."""
    types = [KINDS[k] for k in (rng.permutation(6)[np.arange(count) % 6])]
    sizes, rounding, grids = [], [], []
    for kind in types:
        size = [_log_uniform(rng, 1e-3, 1.5e-2) for _ in range(3)]
        edge = rng.choice([0.0, rng.uniform(0.05, 0.9)]) * min(size)
        rounding.append(edge if kind in ("box", "cylinder") else 0.0)
        sizes.append(
            () if kind == "mesh" else size[: {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)]
        )
        if kind == "mesh":  # the hull of a cloud, with edges and corners of its own
            hull = trimesh.convex.convex_hull(rng.standard_normal((24, 3)) * size)
            grids.append(bake_distance_grid(np.array(hull.vertices), np.array(hull.faces), cells=48))
    groups = list(range(count))
    friction = rng.uniform(0, 1.2, count)
    return GeomSet(types, sizes, friction, groups, rounding, grids, nworld=nworld, device=device)


@dataclasses.dataclass
class Way:
    """One press: (n, 3) positions and (n, 3, 3) rotations of its geom, from clear of the skin."""

    pos: np.ndarray
    mat: np.ndarray


def draw_ways(rng: np.random.Generator, model: SkinModel, geoms: GeomSet, use: np.ndarray) -> list[Way]:
    """A way for each world, of its geom use[w]."""
    g, n = model.geometry, geoms.nworld
    corner = g.vert[g.outer_face]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    far = cKDTree(g.vert[g.fixed]).query(corner.mean(1))[0]
    weight = np.linalg.norm(area, axis=1) * (far > 1e-3)
    face = rng.choice(len(corner), n, p=weight / weight.sum())
    point = np.einsum("nk,nki->ni", rng.dirichlet(np.ones(3), n), corner[face])
    inward = -area[face] / np.linalg.norm(area[face], axis=1, keepdims=True)
    tilt = Rotation.from_rotvec(rng.uniform(0, np.radians(35), (n, 1)) * _units(rng, n))
    inward = tilt.apply(inward)
    mat = Rotation.random(n, random_state=rng).as_matrix()

    def travel_to(points, room):
        """How far each geom goes along its direction until so near to the points (n,) [m]."""
        t = np.full(n, -BACK)
        for _ in range(60):
            _pose(geoms, use, point + t[:, None] * inward, mat)
            left = clearance(points, geoms)[np.arange(n), use] - room
            t = np.minimum(t + left, BACK)
            if left.max() < 1e-7:
                break
        return t

    touch, core = travel_to(model.outside, 0.0), travel_to(model.core_vert, 0.0)
    return [
        _draw_way(rng, point[w] + touch[w] * inward[w], inward[w], mat[w], core[w] - touch[w])
        for w in range(n)
    ]


def _units(rng, n):
    v = rng.standard_normal((n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def _draw_way(rng, start, inward, mat, room):
    """Stretches of a way, of which each has steps of its own length. room: between skin and core [m]."""
    most = room * (1.2 if rng.random() < 0.1 else 0.75)
    pos, turn = [start - 1e-3 * inward], [np.zeros(3)]

    def go(depth, aside, spin, size):
        """Straight to a depth, so far aside, in steps of this size, as many as a stretch may have."""
        end = start + depth * inward + aside
        length = np.linalg.norm(end - pos[-1])
        count = int(np.clip(np.ceil(length / size), 1, MOST))
        share = min(count * size / length, 1.0) if length else 1.0
        here, spun = pos[-1], turn[-1]
        for k in range(1, count + 1):
            pos.append(here + share * k / count * (end - here))
            turn.append(spun + share * k / count * spin)

    def size(low=STEPS[0], high=STEPS[1]):
        return _log_uniform(rng, low, high)

    along = np.cross(inward, _units(rng, 1)[0])
    along /= np.linalg.norm(along)
    aside, still = rng.choice([0.0, rng.uniform(0, 4e-3)]) * along, np.zeros(3)
    depth = rng.uniform(0.05, 1) * most
    go(rng.uniform(0, 0.5) * depth, still, still, size(1e-4))
    go(depth, still, still, size(3e-5))
    go(depth, aside, rng.choice([0.0, rng.uniform(0, 0.5)]) * _units(rng, 1)[0], size())
    go(rng.uniform(0, 1) * depth, aside, still, size())
    go(rng.uniform(0, 1) * depth, aside, still, size(3e-5))
    go(-1e-3, aside, still, size(3e-4))
    return Way(np.array(pos), Rotation.from_rotvec(turn).as_matrix() @ mat)


def _pose(geoms, use, pos, mat):
    """Puts geom use[w] of world w to pos[w], mat[w], and the others away."""
    n = geoms.nworld
    all_pos = np.full((n, geoms.count, 3), AWAY) * np.arange(1, geoms.count + 1)[:, None]
    all_mat = np.tile(np.eye(3), (n, geoms.count, 1, 1))
    all_pos[np.arange(n), use], all_mat[np.arange(n), use] = pos, mat
    geoms.set_pose(all_pos, all_mat)


# --- pressing ---


class Full:
    """Skins of the full tier: a world for each press."""

    def __init__(self, model: SkinModel, geoms: GeomSet, use: np.ndarray, rng: np.random.Generator):
        scale = [_log_uniform(rng, 0.5, 2.0) for _ in use]
        E = model.material.youngs_modulus
        rubbers = [dataclasses.replace(model.material, youngs_modulus=s * E) for s in scale]
        self.model, self.geoms, self.use = model, geoms, use
        self.data = SkinData(model, len(use), rubbers)

    def press(self, pos, mat):
        """Steps to these poses; (nworld,) converged, reached, all finite, force [N], work."""
        _pose(self.geoms, self.use, pos, mat)
        step(self.model, self.data, self.geoms)
        d = self.data
        wrench = d.wrench
        numbers = [d.vert_xpos, wrench, d.pressure, d.tangent(self.geoms)]
        finite = np.all([np.isfinite(a).reshape(len(wrench), -1).all(1) for a in numbers], 0)
        force = np.linalg.norm(wrench[..., :3].sum(1), axis=1)
        return d.converged, d.load_factor, finite, force, d.worlds.work.numpy()


class Worlds:
    """Skins of the condensed tier: a world for each press."""

    def __init__(self, model: SkinModel, geoms: GeomSet, use: np.ndarray, rng: np.random.Generator):
        scale = [_log_uniform(rng, 0.5, 2.0) for _ in use]
        E = model.material.youngs_modulus
        rubbers = [dataclasses.replace(model.material, youngs_modulus=s * E) for s in scale]
        self.geoms, self.use = geoms, use
        self.data, n = SkinData(model, len(use), rubbers), len(use)
        twin = model if not model.device.is_cuda else model.twin
        self.step = CondensedStep(model, LinearSkin.of(twin), self.data, geoms)
        self.tangent = wp.zeros((geoms.ngroup, n), dtype=wp.spatial_matrixd, device=model.device)

    def press(self, pos, mat):
        """See `Full.press`; work: evaluations of contact and what costs as much."""
        _pose(self.geoms, self.use, pos, mat)
        self.step.launch(self.tangent)
        d = self.data
        wrench = d.wrench
        numbers = [d.vert_xpos, wrench, d.pressure, np.swapaxes(self.tangent.numpy(), 0, 1)]
        finite = np.all([np.isfinite(a).reshape(len(wrench), -1).all(1) for a in numbers], 0)
        force = np.linalg.norm(wrench[..., :3].sum(1), axis=1)
        return d.converged, d.load_factor, finite, force, self.step.spent.numpy()


class Condensed:
    """A skin of the condensed tier."""

    def __init__(self, model: SkinModel, geoms: GeomSet, use: np.ndarray, rng: np.random.Generator):
        self.skin, self.memory = CondensedSkin(model, geoms), Memory.rest(geoms.count)

    def press(self, pos, mat):
        """See `Full.press`."""
        out = self.skin.solve(self.memory, pos, mat)
        self.memory = out.memory
        numbers = [out.vert_xpos, out.wrench, out.tangent]
        finite = all(np.isfinite(a).all() for a in numbers)
        force = np.linalg.norm(out.wrench[:, :3].sum(0))
        return (*(np.array([x]) for x in (out.converged, out.load_factor, finite, force, 0)),)


def press_batch(skin: str, seed: int, tier: str, device: str, worlds: int, number: int) -> list[dict]:
    """The presses of a batch; a row for each."""
    rng = np.random.default_rng([seed, number, 0])
    model = skin_model(skin, seed, tier, device, number // max(1, SAME_RUBBER // worlds))
    use = np.arange(worlds) % min(worlds, 12)
    geoms = some_geoms(rng, use.max() + 1, worlds, device)
    ways = draw_ways(rng, model, geoms, use)
    thickness = _thickness(skin)
    kind = Full if tier == "full" else Condensed if worlds == 1 and device == "cpu" else Worlds
    pressing, rows = kind(model, geoms, use, rng), []
    told = {"nu": model.material.poissons_ratio, "law": model.material.law, "liquid": model.has_liquid}
    told |= {"rubber": model.material.youngs_modulus, "contact_law": model.options.contact_law is not None}
    rows = [
        {"press": number * worlds + w, "geom": geoms.types[use[w]], **told, "steps": 0, "not_converged": 0,
         "infeasible": 0, "nan": 0, "stuck": False, "exception": None, "most_N": 0.0, "failures": []}
        for w in range(worlds)
    ]  # fmt: skip
    seconds, touching, in_a_row = [], [], np.zeros(worlds, int)
    works, touched = [[] for _ in rows], np.zeros(worlds, bool)
    clock = time.process_time if device == "cpu" else time.perf_counter
    gc.disable()  # a collection takes 0.1 s, and is no step's
    for k in range(max(len(way.pos) for way in ways)):
        at = [min(k, len(way.pos) - 1) for way in ways]
        pos, mat = (np.array([getattr(way, name)[i] for way, i in zip(ways, at)]) for name in ("pos", "mat"))
        _pose(geoms, use, pos, mat)
        room = clearance(model.core_vert, geoms)[np.arange(worlds), use]
        began = clock()
        try:
            converged, reached, finite, force, work = pressing.press(pos, mat)
        except Exception as error:  # counted, whatever it is: none is expected
            for row in rows:
                row["exception"] = f"step {k}: {type(error).__name__}: {error}"
            break
        if k:
            seconds.append(clock() - began)
            touching.append(force.max() > 0)
        for w, row in enumerate(rows):
            if k > at[w]:
                continue
            feasible = room[w] > ROOM * thickness
            row["steps"] += 1
            if k and (force[w] > 0 or touched[w]):  # a step that leaves the skin is one of the contact
                works[w].append(int(work[w]))
            touched[w] = force[w] > 0
            row["nan"] += int(not finite[w])
            row["infeasible"] += int(not feasible)
            row["most_N"] = max(row["most_N"], round(float(force[w]), 3))
            failed = feasible and not converged[w]
            in_a_row[w] = in_a_row[w] + 1 if failed else 0
            row["not_converged"] += int(failed)
            row["stuck"] |= bool(in_a_row[w] > 3)
            if failed:
                row["failures"].append([k, round(1e3 * float(room[w]), 3), round(float(reached[w]), 4)])
    gc.enable()
    if np.any(touching):
        slowest = max(seconds)
        ratio = slowest / np.median(np.array(seconds)[np.array(touching)])
        for row in rows:
            row |= {"slowest_s": slowest, "slowest_ratio": float(ratio)}
    for row, work in zip(rows, works):
        if any(work):
            row |= {"most_work": max(work), "work_ratio": max(work) / max(float(np.median(work)), 1.0)}
    return rows


@functools.cache
def _thickness(skin):
    """Of the skin, on the average of its outer surface [m]."""
    g = load_skin(skin)
    inner, outer = np.unique(g.inner_face), np.unique(g.outer_face)
    return float(np.median(cKDTree(g.vert[inner]).query(g.vert[outer])[0]))


def summary(rows: list[dict]) -> dict:
    """The totals of rows."""
    total = {name: sum(row[name] for row in rows) for name in ("steps", "not_converged", "infeasible", "nan")}
    return {
        "presses": len(rows),
        **total,
        "exceptions": sum(row["exception"] is not None for row in rows),
        "stuck": sum(row["stuck"] for row in rows),
        **{name: max((row.get(name, 0) for row in rows), default=0) for name in LARGEST},
        "above_20": sum(row.get("work_ratio", 0) > 20 for row in rows),
    }


def main(arguments: list[str] | None = None) -> dict:
    """Runs what is missing and writes the totals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--presses", type=int, default=200)
    parser.add_argument("--json", type=pathlib.Path, default="out/benchmarks/robustness.json")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tier", choices=["full", "condensed", "both"], default="both")
    parser.add_argument("--skin", default="coarse")
    parser.add_argument("--worlds", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--minutes", type=float, default=math.inf, help="after which no batch begins")
    args = parser.parse_args(arguments)
    args.json.parent.mkdir(parents=True, exist_ok=True)
    wp.config.quiet = True
    end = time.monotonic() + 60 * args.minutes
    tiers = ["full", "condensed"] if args.tier == "both" else [args.tier]
    lines, results = args.json.with_suffix(".jsonl"), {}
    lines.parent.mkdir(parents=True, exist_ok=True)
    kept = {}
    if lines.exists():
        for line in lines.read_text().splitlines():
            batch = json.loads(line)
            kept[tuple(batch["key"])] = batch["rows"]
    for tier in tiers:
        device, worlds = args.device, args.worlds
        rows = []
        count = -(-args.presses // len(tiers) // worlds)
        for number in tqdm(range(count), desc=tier, unit="batch"):
            key = (tier, args.skin, args.seed, worlds, number)
            if key not in kept:
                if time.monotonic() > end:
                    break
                kept[key] = press_batch(args.skin, args.seed, tier, device, worlds, number)
                with lines.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"key": key, "rows": kept[key]}) + "\n")
            rows += kept[key]
        results[tier] = {"skin": args.skin, "seed": args.seed, "device": device, **summary(rows)}
    total = summary([row for key, rows in kept.items() if key[1:3] == (args.skin, args.seed) for row in rows])
    found = {**total, "tiers": results}
    write_json(args.json, found)
    print(json.dumps(found, indent=1))
    return found


if __name__ == "__main__":
    main()
