"""What the reduced forms of constitutive effects miss: one press, with the effect on the forces and inside the finite elements.

    python benchmarks/discrepancy_in_skin.py --json out/in_skin.json

A sphere of 7 mm is pressed 1.2 mm into the pad, held, drawn back to half, held, pressed again and taken away. Printed are the largest
value of the elastic skin, the largest change that the effect makes inside the skin, and what the reduced form misses of it (RMS over rows).
"""

import argparse
import json
import pathlib
import time

import numpy as np

CASES = (
    ("relax", {"g": 0.3, "tau": 1.0}), ("relax", {"g": 0.1, "tau": 0.3}), ("creep", {"n": 0.04}), ("mullins", {"softening": 0.2}),
)  # fmt: skip


def press(depth=1.2e-3, rows=8):
    """A Trajectory: in 1 s, held for 2 s, half way out in 0.5 s, held for 1.5 s, in again to the same depth and out."""
    from biotac_mj.discrepancy.trajectories import Trajectory
    from biotac_mj.geometry import load_skin

    touch = load_skin("coarse").vert
    near = touch[(abs(touch[:, 0] + 12e-3) < 2e-3) & (abs(touch[:, 2]) < 2e-3)]
    surface = near[:, 1].min()
    knots = np.array([0, 1.0, 3.0, 3.5, 5.0, 5.5, 6.5])
    depths = np.array([-0.1e-3, depth, depth, depth / 2, depth / 2, depth, -0.1e-3])
    t = np.unique(np.concatenate([np.linspace(a, b, rows + 1) for a, b in zip(knots[:-1], knots[1:])]))
    pos = np.column_stack([np.full(len(t), -12e-3), surface + np.interp(t, knots, depths), np.zeros(len(t))])
    return Trajectory("press", "sphere_7mm", 0.0, t, pos, np.tile(np.eye(3), (len(t), 1, 1)), np.full((len(t), 19), 2500.0))


def compare(effect, theta, trajectory, skin):
    """Row of the table: largest value, largest change, what the reduced form misses [N, Pa, counts]; seconds of processor time."""
    from biotac_mj.discrepancy.catalogue import by_id
    from biotac_mj.discrepancy.in_skin import InSkinSimulator

    sim = InSkinSimulator(skin=skin, tier="full")
    began = time.process_time()
    plain = sim.run([trajectory], effects=[])[0]
    effects = [(by_id(effect), theta)]
    middle = time.process_time()
    inside = sim.run([trajectory], effects=effects)[0]
    ended = time.process_time()
    reduced = sim.run([trajectory], sim_fields(plain, sim, trajectory), False, effects)[0]
    out = {"effect": effect, **theta, "elastic_s": middle - began, "in_skin_s": ended - middle}
    for name, value in (("force", lambda r: r.normal_force), ("pressure", lambda r: r.pressure), ("counts", lambda r: r.counts)):
        a, b, c = value(plain), value(inside), value(reduced)
        signature = np.abs(b - a).max()
        out |= {f"{name}_largest": float(np.abs(a - a[0]).max()), f"{name}_signature": float(signature),
                f"{name}_missed": float(np.sqrt(((c - b) ** 2).mean())), f"{name}_missed_most": float(np.abs(c - b).max())}  # fmt: skip
    return out


def sim_fields(plain, sim, trajectory):
    """Fields of the elastic skin, so that the reduced form need not solve it again."""
    from biotac_mj.discrepancy.simulator import Fields

    base = [{"force": plain.force, "pressure": plain.pressure, "log_z": plain.log_z}]
    none = [{k: np.zeros_like(v) for k, v in base[0].items()}]
    return Fields(base, dict.fromkeys("xyz", none), [trajectory])


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("--skin", default="coarse")
    args.add_argument("--rows", type=int, default=8, help="rows of each of the six parts of the press")
    args.add_argument("--json")
    args = args.parse_args(argv)
    rows = [compare(effect, theta, press(rows=args.rows), args.skin) for effect, theta in CASES]
    names = ("force", 9, "N"), ("pressure", 13, "Pa"), ("counts", 9, "")
    print(f"{'effect':<30}" + "".join(f"{f'{n} {unit}':>{w}}{'changes':>9}{'missed':>9}" for n, w, unit in names) + f"{'s':>7}")
    for r in rows:
        label = f"{r['effect']} " + ", ".join(f"{k} {r[k]:g}" for k in ("g", "tau", "n", "softening") if k in r)
        cells = "".join(f"{r[f'{n}_largest']:>{w}.4g}{r[f'{n}_signature']:>9.3g}{r[f'{n}_missed']:>9.2g}" for n, w, _ in names)
        print(f"{label:<30}{cells}{r['in_skin_s']:>7.0f}")
    if args.json:
        path = pathlib.Path(args.json)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
