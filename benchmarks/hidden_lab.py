"""A laboratory with a hidden sensor: carries out a plan of contacts and returns what the sensor read.

    python benchmarks/hidden_lab.py --seal 12 --seed 7 --out labs/    # draws hidden sensors
    python benchmarks/hidden_lab.py --sensor labs/lab_03.sealed --plan plan.csv --out measured.h5

A sealed sensor is one of `discrepancy_generator` (synthetic): its skin is solved with the laboratory's own
way through the poses, its effects have other forms than the catalogue's, and its base is another one than the
simulator that is compared: modulus, footprint and film, an error of every pose, noise, rounding. A plan is
the CSV of `biotac next`. Nothing here imports `biotac_mj.discrepancy`. `labs/seal.json` holds hashes only."""

import argparse
import base64
import csv
import hashlib
import json
import pathlib
import zlib

import numpy as np
from discrepancy_generator import FORMS, HIDDEN, OUTSIDE, Generator, slips
from records import write_json

__all__ = ["carried_out", "clean", "draw", "off", "opened", "read_plan", "seal"]

# of 30 laboratories; wrong-base: a rubber that is half as stiff, or twice
_OF_30 = {"single": 15, "pair": 5, "none": 4, "outside": 4, "wrong-base": 2}
# in an order in which the first ones have all kinds in their proportion
_KINDS = [kind for _, kind in sorted(((k + 0.5) / n, kind) for kind, n in _OF_30.items() for k in range(n))]
_STIFF = 1.7  # factor on the modulus of a wrong base, or one by it
_BASE = {"modulus": 0.2, "film": 0.2}  # standard deviations of logarithms
_FOOTPRINT = 0.03  # largest
_POSE = 30e-6  # [m] standard deviation of every trial's pose


def draw(count: int, seed: int) -> list[dict]:
    """Hidden sensors: kind, effects [(name, size, form)], settings of the base, seed."""
    rng, out = np.random.default_rng([seed, 52]), []
    names = list(rng.permutation(list(HIDDEN)))
    for k in range(count):
        kind = _KINDS[k % len(_KINDS)]
        many = {"none": 0, "wrong-base": 0, "pair": 2}.get(kind, 1)
        if kind == "outside":
            picked = list(rng.choice(list(OUTSIDE), 1))
        else:
            if len(names) < many:
                names = list(rng.permutation(list(HIDDEN)))
            picked = [names.pop() for _ in range(many)]
        sizes = HIDDEN | OUTSIDE
        effects = [
            (str(n), float(np.exp(rng.uniform(*np.log(sizes[n])))), int(rng.integers(FORMS.get(n, 1))))
            for n in picked
        ]
        base = {name: float(np.exp(rng.normal(0, sd))) for name, sd in _BASE.items()}
        base["footprint"] = float(rng.uniform(0, _FOOTPRINT))
        if kind == "wrong-base":
            base["modulus"] = float(_STIFF ** rng.choice([-1, 1]))
        out.append({"kind": kind, "effects": effects, "base": base, "seed": int(rng.integers(2**31))})
    return out


def seal(sensor: dict) -> bytes:
    """A sensor as bytes that nobody reads by accident."""
    return base64.b85encode(zlib.compress(json.dumps(sensor).encode()))


def opened(sealed: bytes) -> dict:
    """A sensor from its bytes."""
    return json.loads(zlib.decompress(base64.b85decode(sealed)))


def read_plan(path: pathlib.Path | str) -> list[dict]:
    """Contacts of a plan, as the generator takes them."""
    from biotac_mj.geometry.rigid import matrix

    rows = {}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            rows.setdefault(int(row["contact"]), []).append(row)
    out = []
    for number, some in rows.items():
        table = {
            name: np.array([float(r[name]) for r in some])
            for name in some[0]
            if name not in ("contact", "object")
        }
        pos = np.stack([table[f"object_pos_{a}"] for a in "xyz"], axis=1)
        turn = matrix([table[f"object_q{a}"][0] for a in "wxyz"])
        out.append(
            {
                "id": f"c{number:02d}",
                "tool": some[0]["object"],
                "clock": float(table["time"][0]),
                "time": table["time"] - table["time"][0],
                "pos": pos,
                "turn": turn,
                "heading": turn[:, 1],
                "depth": (pos - pos[0]) @ turn[:, 1],
            }
        )
    return out


def generator_of(sensor: dict, skin: str, tier: str) -> Generator:
    """The sensor's skin."""
    from biotac_mj.sensor.film import FilmConduction

    lab = Generator(skin, sensor["base"]["modulus"], sensor["base"]["footprint"], tier)
    thick = sensor["base"]["film"] * lab.film.residual_film
    lab.film = FilmConduction(lab.geometry, sensor="1", residual_film=thick)
    return lab


def carried_out(lab: Generator, sensor: dict, contacts: list[dict], turn: int = 0) -> list[tuple]:
    """Per contact counts (n, 19), pdc (n,) and force (n, 3); turn: number of the round, whose noise and pose
    errors are its own."""
    return lab.measure(contacts, [tuple(e) for e in sensor["effects"]], sensor["seed"] + turn, _POSE)


def clean(lab: Generator, sensor: dict, contacts: list[dict], turn: int, effects: bool) -> list[tuple]:
    """The same by the same poses without noise and rounding, with and without the hidden effects."""
    hidden = [tuple(e) for e in sensor["effects"]] if effects else []
    return lab.clean(contacts, hidden, sensor["seed"] + turn, _POSE)


def off(sensor: dict, contacts: list[dict], turn: int) -> np.ndarray:
    """(contacts, 3) by which their objects were off [m]."""
    return slips(len(contacts), sensor["seed"] + turn, _POSE)


def _write(path, contacts, readings):
    from biotac_mj.data.schema import Interaction
    from biotac_mj.data.store import write_shard
    from biotac_mj.geometry.rigid import quaternion

    rows = []
    for c, (electrodes, pdc, force) in zip(contacts, readings):
        n = len(c["time"])
        counts, wrench = np.full((n, 23), np.nan, np.float32), np.full((n, 6), np.nan, np.float32)
        counts[:, :19], counts[:, 19], wrench[:, :3] = electrodes, pdc, force
        rows.append(
            Interaction(
                c["id"],
                c["tool"],
                "recorded",
                "train",
                0,
                {"clock": c["clock"], "touch": 0},
                c["time"],
                indenter_pos=c["pos"],
                indenter_quat=np.tile(quaternion(c["turn"]), (n, 1)),
                measured_counts=counts,
                measured_wrench=wrench,
            )
        )
    write_shard(pathlib.Path(path), rows)


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("--seal", type=int, metavar="N", help="draw so many hidden sensors into --out")
    args.add_argument("--seed", type=int, default=0, help="of --seal")
    args.add_argument("--sensor", type=pathlib.Path, help="a sealed one")
    args.add_argument("--plan", type=pathlib.Path, help="CSV of `biotac next`")
    args.add_argument("--round", type=int, default=0, help="number of the round")
    args.add_argument("--skin", default="coarse")
    args.add_argument("--tier", choices=("condensed", "full"), default="condensed")
    args.add_argument("--out", type=pathlib.Path, required=True)
    args = args.parse_args(argv)
    if args.seal:
        args.out.mkdir(parents=True, exist_ok=True)
        hashes = {}
        for k, sensor in enumerate(draw(args.seal, args.seed)):
            path = args.out / f"lab_{k:02d}.sealed"
            path.write_bytes(seal(sensor))
            hashes[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
        write_json(args.out / "seal.json", hashes)
        return
    if not (args.sensor and args.plan):
        raise SystemExit("give --sensor SEALED and --plan plan.csv, or --seal N")
    sensor, contacts = opened(args.sensor.read_bytes()), read_plan(args.plan)
    lab = generator_of(sensor, args.skin, args.tier)
    _write(args.out, contacts, carried_out(lab, sensor, contacts, args.round))
    print(f"{len(contacts)} contacts measured: {args.out}")


if __name__ == "__main__":
    main()
