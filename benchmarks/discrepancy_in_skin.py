"""What the reduced forms of constitutive effects miss: one press, with the effect on the forces and inside
the finite elements.

    python benchmarks/discrepancy_in_skin.py --json out/in_skin.json

A sphere of 7 mm is pressed 1.2 mm into the pad, held, drawn back to half, held, pressed again and taken away.
Printed are the largest change that the effect makes inside the skin while touched and what the reduced form
misses of it (RMS over those rows); then the same after the release, at the most."""

import argparse
import json
import pathlib
import time

import numpy as np

CASES = (
    ("relax", {"g": 0.3, "tau": 1.0}),
    ("relax", {"g": 0.1, "tau": 0.3}),
    ("creep", {"n": 0.04}),
    ("mullins", {"softening": 0.2, "width": 0.6}),
    ("stiffen", {"c2": 0.15}),
    ("stiffen", {"c2": -0.15}),
    ("inhomog", {"along": 0.3, "across": 0.0}),
    ("hyster", {"fraction": 0.1, "width": 0.2e-3}),
    ("hyster", {"fraction": 0.1, "width": 0.4e-3}),
)


def press(depth=1.2e-3, rows=8):
    """A Trajectory: in 1 s, held for 2 s, half way out in 0.5 s, held for 1.5 s, in again to the same depth
    and out."""
    from biotac_mj.discrepancy.trajectories.trajectory import Trajectory
    from biotac_mj.geometry import load_skin

    touch = load_skin("coarse").vert
    near = touch[(abs(touch[:, 0] + 12e-3) < 2e-3) & (abs(touch[:, 2]) < 2e-3)]
    surface = near[:, 1].min()
    knots = np.array([0, 1.0, 3.0, 3.5, 5.0, 5.5, 6.5])
    depths = np.array([-0.1e-3, depth, depth, depth / 2, depth / 2, depth, -0.1e-3])
    t = np.unique(np.concatenate([np.linspace(a, b, rows + 1) for a, b in zip(knots[:-1], knots[1:])]))
    pos = np.column_stack([np.full(len(t), -12e-3), surface + np.interp(t, knots, depths), np.zeros(len(t))])
    return Trajectory(
        "press", "sphere_7mm", 0.0, t, pos, np.tile(np.eye(3), (len(t), 1, 1)), np.full((len(t), 19), 2500.0)
    )


def compare(effect, theta, trajectory, sim, plain):
    """Row of the table: largest change and what the reduced form misses, touched and released [N, Pa,
    counts]; processor time [s]."""
    from biotac_mj.effects.catalogue import by_id

    effects = [(by_id(effect), theta)]
    began = time.process_time()
    inside = sim.run([trajectory], effects=effects)[0]
    ended = time.process_time()
    reduced = sim.run([trajectory], fields_of(plain, trajectory), False, effects)[0]
    out = {"effect": effect, **theta, "seconds": ended - began}
    touching = inside.normal_force > 1e-3
    gone = np.arange(len(touching)) > np.flatnonzero(touching)[-1]
    for name, value in (
        ("force", lambda r: r.normal_force),
        ("pressure", lambda r: r.pressure),
        ("counts", lambda r: r.counts),
    ):
        a, b, c = value(plain), value(inside), value(reduced)
        change, miss = np.abs(b - a), np.abs(c - b)
        out |= {
            f"{name}_changes": float(change[touching].max()),
            f"{name}_missed": float(np.sqrt((miss[touching] ** 2).mean())),
            f"{name}_after": float(change[gone].max()),
            f"{name}_after_missed": float(miss[gone].max()),
        }
    return out


def fields_of(plain, trajectory):
    """Fields of the elastic skin, so that the reduced form need not solve it again."""
    from biotac_mj.discrepancy.trajectories.model.fields import Fields

    base = [{"force": plain.force, "pressure": plain.pressure, "log_z": plain.log_z}]
    none = [{k: np.zeros_like(v) for k, v in base[0].items()}]
    return Fields(base, dict.fromkeys("xyz", none), [trajectory])


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("--skin", default="coarse")
    args.add_argument("--rows", type=int, default=8, help="rows of each of the six parts of the press")
    args.add_argument("--only", help="one effect")
    args.add_argument("--json")
    args = args.parse_args(argv)
    from biotac_mj.discrepancy.trajectories.model.in_skin import InSkinSimulator

    sim, trajectory = InSkinSimulator(skin=args.skin), press(rows=args.rows)
    began = time.process_time()
    plain = sim.run([trajectory], effects=[])[0]
    print(f"elastic skin: {time.process_time() - began:.0f} s of processor time", flush=True)
    rows = [
        compare(effect, theta, trajectory, sim, plain)
        for effect, theta in CASES
        if args.only in (None, effect)
    ]
    names = ("force", "N"), ("pressure", "Pa"), ("counts", "")
    print(
        f"{'':<26}"
        + "".join(f"{f'{n} {unit} changes':>20}{'missed':>8}" for n, unit in names)
        + f"{'released: Pa':>14}{'missed':>8}{'counts':>8}{'s':>5}"
    )
    for r in rows:
        label = f"{r['effect']} " + ", ".join(
            f"{k} {r[k]:g}" for k in ("g", "tau", "n", "softening", "c2", "along", "fraction") if k in r
        )
        label += f", {1e3 * r['width']:g} mm" if r["effect"] == "hyster" else ""
        cells = "".join(f"{r[f'{n}_changes']:>20.3g}{r[f'{n}_missed']:>8.2g}" for n, _ in names)
        print(
            f"{label:<26}{cells}{r['pressure_after']:>14.3g}{r['pressure_after_missed']:>8.2g}{r['counts_after']:>8.2g}{r['seconds']:>5.0f}"
        )
    if args.json:
        path = pathlib.Path(args.json)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
