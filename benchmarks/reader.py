"""Intervals and novelty of a model that reads electrodes, on synthetic sets that are made here.

python benchmarks/reader.py --out DIR --json OUT

Ordinary touches are divided by whole touches, several times: the model is fitted, its intervals are sized on
the held-out ones, and sets of other seeds, of other objects and of sensors drawn at random say how many rows
they cover. What training did not
have is told from those unseen touches by the mean logarithm of a touch's novelty: a skin that was filled
further, two balls at once, an electrode that stays at rest or reads nothing. Every touch finds the sensor as
warm as it happens to be. Everything is simulated."""

import argparse
import dataclasses
import json
import pathlib
import sys

import numpy as np
import trimesh
from records import write_json

from biotac_mj.data import Interaction, TactileSet, shard_path, write_shard
from biotac_mj.data.generation.clearance import Placed, first_touch, surface_samples
from biotac_mj.data.generation.generate import GenerateOptions, generate
from biotac_mj.data.generation.plan import Motion
from biotac_mj.data.generation.readings import read_motion
from biotac_mj.data.generation.simulate import simulate
from biotac_mj.data.splits import assign
from biotac_mj.geometry import load_skin
from biotac_mj.geometry.rigid import rotation
from biotac_mj.learning.instants.examples import Examples, from_set
from biotac_mj.learning.instants.reader import Reader, fit_reader
from biotac_mj.sensor.channels import counts_from_log_impedance, log_impedance
from biotac_mj.sensor.film import FilmConduction
from biotac_mj.skin import SkinModel
from biotac_mj.skin.settings import read_material

OBJECTS = ("sphere_3-5mm", "sphere_7mm", "sphere_14mm", "cube_14mm")
OTHERS = ("ring_7mm", "cylinder_short_7mm", "peg_hexagon_8mm")
STEPS, RATE = 8, 20.0
FILL = 2e-7  # [m3] more liquid than at rest
BALLS = ((3.5e-3, 9e-3), (2.5e-3, 11e-3), (5e-3, 10e-3))  # [m] radius, and apart along the finger
# of ln Z: how far warm-up takes the sensor presets epfl_f1 and epfl_f2 (0.42, 0.38)
WARMTH = 0.4
SHARES = (0.75, 0.25, 0.0)  # of the touches: train, size the intervals; unseen ones are a set of their own


def ordinary(folder: pathlib.Path, count: int, tier: str, **more: object) -> Examples:
    """A generated set, made where it is not there; more: of GenerateOptions."""
    settings = dict(labelled=0, steps=STEPS, rate=RATE, skin="coarse", objects=OBJECTS, batch=50) | more
    generate(folder, GenerateOptions(count=count, tier=tier, **settings), workers=0)
    return from_set(folder)


def two_contacts(
    folder: pathlib.Path, count: int, tier: str, ball: float, apart: float, seed: int
) -> Examples:
    """Touches of two balls [m] at once on the straight part of the pad, made where they are not there."""
    path = shard_path(folder, 0)
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        balls = [trimesh.creation.icosphere(subdivisions=3, radius=ball) for _ in range(2)]
        for one, side in zip(balls, (-0.5, 0.5)):
            one.apply_translation([side * apart, -ball, 0])
        trimesh.util.concatenate(balls).export(folder / "two_balls.obj")
        name = f"mesh:{folder / 'two_balls.obj'}"
        model, rng = SkinModel(load_skin("coarse"), read_material("default")), np.random.default_rng(seed)
        angle, along = rng.uniform(-0.5, 0.5, count), rng.uniform(-9e-3, -4e-3, count)
        points = surface_samples(model.geometry.vert, model.geometry.outer_face, "cpu")
        mat = rotation(angle[:, None] * [1.0, 0, 0])
        begin = along[:, None] * [1.0, 0, 0] - 0.05 * mat[:, :, 1]
        one, side = Placed(f"geom:sphere:{ball}", count), [apart / 2, 0, 0]
        later, sooner = (
            first_touch(one, points, begin + s, mat, mat[:, :, 1]) for s in (side, np.negative(side))
        )
        # turned so that both balls meet the skin at once
        mat = mat @ rotation(np.arctan((later - sooner) / apart)[:, None] * [0, 0, 1.0])
        ahead = mat[:, :, 1]
        begin = along[:, None] * [1.0, 0, 0] - 0.05 * ahead
        met = first_touch(Placed(name, count), points, begin, mat, ahead)
        depth = rng.uniform(0.6e-3, 1.6e-3, count)[:, None] * np.linspace(0, 1, STEPS) - 5e-6
        travel = met[:, None] + depth
        motions = [
            Motion("press", {}, begin[k] + travel[k][:, None] * ahead[k], np.tile(mat[k], (STEPS, 1, 1)))
            for k in range(count)
        ]
        time = np.arange(STEPS) / RATE
        fields, film, ones = (
            simulate(model, name, motions, time=time, tier=tier),
            FilmConduction(model.geometry),
            [],
        )
        for k, motion in enumerate(motions):
            vert = fields.vert_xpos(model.geometry.vert, k)
            read = read_motion(film, vert, time, fields.pressure[k], k)
            columns = {
                "displacement": vert - model.geometry.vert,
                "contact_force": None if fields.contact_force is None else fields.contact_force[k],
                "wrench": fields.wrench[k],
                "counts": read.counts,
                "converged": fields.converged[k],
            }
            ones.append(Interaction(f"two-{k}", "two_balls", motion.kind, "test", k, {}, time, **columns))
        write_shard(path, ones, model.geometry)
    return from_set(folder)


def dead(data: Examples, reads: str, seed: int = 0) -> Examples:
    """The same with one electrode of each touch that stays at its rest (the one that answered most) or reads
    nothing (any)."""
    which = np.random.default_rng(seed).integers(19, size=data.owner.max() + 1)
    if reads == "rest":
        for k in np.unique(data.owner):
            which[k] = np.abs(data.log_change[data.owner == k]).max(0).argmax()
    which = which[data.owner]
    counts, rows = data.counts.copy(), np.arange(len(data.owner))
    counts[rows, which] = data.tare[rows, which] if reads == "rest" else 0
    return dataclasses.replace(data, counts=counts)


def shifted(data: Examples, shift: np.ndarray) -> Examples:
    """The same of a sensor whose ln Z, at rest too, is larger by shift (n, 19) or (19,)."""
    counts, tare = (
        np.rint(counts_from_log_impedance(log_impedance(x) + shift)) for x in (data.counts, data.tare)
    )
    return dataclasses.replace(data, counts=counts, tare=tare)


def warmed(data: Examples, seed: int) -> Examples:
    """The same, every touch at its own time since the sensor was switched on."""
    warmth = np.random.default_rng(seed).uniform(0, WARMTH, data.owner.max() + 1)
    return shifted(data, -warmth[data.owner][:, None])


def filling(folder: pathlib.Path) -> np.ndarray:
    """(19,) change of ln Z at rest by the liquid that a set's skin has more; the set's own film takes it out,
    as if the cell constants were fitted anew."""
    with TactileSet(folder) as data:
        film = FilmConduction(load_skin("coarse"))
        rest = film.geometry.vert + data["displacement"][data.start[:1]][0]
        return np.log(film.impedance(rest) / film.rest)


def strangeness(reader: Reader, data: Examples) -> np.ndarray:
    """Mean logarithm of the novelty of each touch (k,)."""
    novelty = np.log(reader.predict(data.counts, data.tare, data.pdc).novelty + 1e-9)
    return np.array([novelty[data.owner == k].mean() for k in np.unique(data.owner)])


def area(usual: np.ndarray, strange: np.ndarray) -> float:
    """Share of pairs in which the strange one has the higher score."""
    more = (strange[:, None] > usual).mean() + 0.5 * (strange[:, None] == usual).mean()
    return float(more)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder of the sets")
    parser.add_argument(
        "--json", type=pathlib.Path, default="out/benchmarks/reader.json", help="where the numbers go"
    )
    parser.add_argument("--count", type=int, default=2000, help="ordinary touches that are divided")
    parser.add_argument("--unseen", type=int, default=240, help="ordinary touches that are not")
    parser.add_argument("--few", type=int, default=48, help="touches of each other kind")
    parser.add_argument("--tier", default="condensed", help="of the ordinary skin; full knows contact places")
    parser.add_argument("--divisions", type=int, default=5)
    parser.add_argument("--seed", type=int, default=31, help="of the unseen touches and of all other kinds")
    given = parser.parse_args(argv)
    given.json.parent.mkdir(parents=True, exist_ok=True)
    data = warmed(ordinary(given.out / "ordinary", given.count, given.tier), given.seed)
    plain = ordinary(given.out / f"unseen-{given.seed}", given.unseen, given.tier, seed=given.seed)
    unseen = warmed(plain, given.seed + 3)
    fill = {"skin": {"fill_volume": FILL}}
    folder = given.out / f"filled-{given.seed}"
    filled = ordinary(folder, given.few, given.tier, seed=given.seed + 1, options=fill)
    filled = warmed(filled, given.seed + 4)
    cases = {"more liquid": shifted(filled, filling(folder)), "more liquid, rest as before": filled}
    for k, (ball, apart) in enumerate(BALLS):
        folder = given.out / f"two-{1e3 * ball:g}-{1e3 * apart:g}-{given.seed}"
        two = two_contacts(folder, given.few, given.tier, ball, apart, given.seed + 2)
        cases[f"two balls of {1e3 * ball:g} mm, {1e3 * apart:g} mm apart"] = warmed(two, given.seed + 5 + k)
    for what in ("rest", "nothing"):
        cases[f"an electrode reads {what}"] = dead(unseen, what, given.seed)
    other = {"objects": {"objects": OTHERS}, "sensors": {"sensor": "random"}}
    judged = {"touches": unseen}
    for k, (name, more) in enumerate(other.items()):
        folder = given.out / f"{name}-{given.seed}"
        judged[name] = ordinary(folder, given.unseen // 2, given.tier, seed=given.seed + 10 + k, **more)
    covered, areas, errors = {}, {}, {}
    names = np.unique(data.owner)
    for seed in range(given.divisions):
        part = assign(len(names), seed, SHARES)
        reader = fit_reader(data, names[part == "train"], names[part == "validation"], seed=seed)
        for what, one in judged.items():
            found = reader.predict(one.counts, one.tare, one.pdc)
            truth = one.targets | {"electrodes": one.counts}
            for name, value in found.value.items():
                error = np.abs(value - truth[name])
                there = np.isfinite(error).all(1)
                inside, key = (error <= found.half[name])[there], f"{name}, unseen {what}"
                covered.setdefault(key, []).append(float(inside.mean()))
                errors.setdefault(key, []).append(float(np.sqrt((error[there] ** 2).mean())))
        usual = strangeness(reader, unseen)
        for name, case in cases.items():
            areas.setdefault(name, []).append(area(usual, strangeness(reader, case)))
    out = {
        "touches": len(names),
        "unseen": given.unseen,
        "divisions": given.divisions,
        "covered_by_90": {k: [float(np.mean(v)), float(np.std(v))] for k, v in covered.items()},
        "rmse": {k: float(np.mean(v)) for k, v in errors.items()},
        "novelty_area": {k: [float(np.mean(v)), float(np.min(v))] for k, v in areas.items()},
    }
    write_json(given.json, out)
    print(json.dumps(out, indent=1))


if __name__ == "__main__":
    try:
        main()
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"reader: {error}")
