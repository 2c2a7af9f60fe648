"""A sensor that was measured is not quite the simulated one: find what is missing, name it, add it, and see
the gap shrink.

    python examples/find_the_missing_effect.py --seed 3 --out out/missing.png

The "measurement" is synthetic: the condensed skin with one effect that the seed chooses, another modulus,
slips of the pose, noise and 12 bits. Everything that is fitted starts from raw counts and newtons."""

import argparse
import pathlib

import numpy as np
from scipy.spatial.transform import Rotation

from biotac_mj import load_skin
from biotac_mj.discrepancy import CATALOGUE, Simulator, Trajectory, diagnose
from biotac_mj.press import approach

# What may hide, and how large (kept apart from the catalogue's own bounds).
HIDDEN = {
    "relax": {"g": 0.3, "tau": 0.8},
    "mount": {"compliance": 1.0e-4},
    "latency": {"delay": 0.07},
    "warmup": {"a": -0.2, "tau": 60.0},
    "stiffen": {"c2": 0.4},
    "saturate": {"strength": 0.7, "knee": 200.0},
}


def presses(count, seed):
    """Trajectories without readings: press, hold, come up, at places on the pad."""
    rng, skin, out, clock = np.random.default_rng(seed), load_skin("coarse"), [], 0.0
    for i in range(count):
        point, normal = approach.surface_point(skin, rng.uniform(-0.014, -0.005), rng.uniform(-0.4, 0.4))
        depth, speed, hold = (
            rng.uniform(0.5e-3, 1.4e-3),
            np.exp(rng.uniform(np.log(1e-3), np.log(1e-2))),
            np.exp(rng.uniform(np.log(0.3), np.log(4))),
        )
        d = np.concatenate(
            [[-2e-5] * 3, np.linspace(-2e-5, depth, 7)[1:], [depth] * 5, np.linspace(depth, -2e-5, 6)[1:]]
        )
        t = np.concatenate([[0.1] * 2, [depth / speed / 6] * 6, [hold / 5] * 5, [depth / speed / 5] * 5])
        t = np.concatenate([[0], np.cumsum(t)])
        mat = Rotation.align_vectors([-normal], [[0.0, 1.0, 0.0]])[0].as_matrix()
        n = len(t)
        out.append(
            Trajectory(
                f"press {i}",
                ["sphere_7mm", "sphere_14mm"][i % 2],
                clock,
                t,
                point - np.outer(d, normal),
                np.tile(mat, (n, 1, 1)),
                np.full((n, 19), 2000.0),
                np.full(n, 2000.0),
                None,
                np.zeros((n, 3)),
            )
        )
        clock += t[-1] + 5
    return out


def measure(sim, trajectories, effect, seed):
    """The same trajectories with what a sensor with that effect reads (synthetic)."""
    rng = np.random.default_rng(seed)
    slips = [rng.normal(0, 2e-5, 3) for _ in trajectories]
    runs = sim.run(trajectories, None, True, [effect], 1.1, slips)
    out = []
    for t, r in zip(trajectories, runs):
        counts = np.clip(np.rint(r.counts + 3.5 * rng.standard_normal(r.counts.shape)), 0, 4095)
        pdc, force = (
            np.rint(r.pdc + rng.standard_normal(len(r.pdc))),
            r.force + 0.006 * rng.standard_normal(r.force.shape),
        )
        out.append(Trajectory(t.id, t.tool, t.clock, t.time, t.pos, t.mat, counts, pdc, None, force))
    return out


def picture(report, truth, path):
    """Left: evidence of the first round; right: residual per channel on the held-out presses, before and
    after."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 2])
    y = np.arange(len(report.tried))[::-1]
    left.barh(
        y,
        [one["evidence_nats"] for one in report.tried],
        color=["tab:blue" if one["id"] == truth else "0.7" for one in report.tried],
    )
    left.set_yticks(y, [one["id"] for one in report.tried])
    left.set_xlabel("nats per press left out (blue: the truth)")
    x, sigma, proof = np.arange(report.comparison.width), report.comparison.sigma, report.proof
    right.bar(x - 0.2, np.array(proof.before["channels"]) / sigma, 0.4, color="0.6", label="as simulated")
    right.bar(
        x + 0.2,
        np.array(proof.after["channels"]) / sigma,
        0.4,
        color="tab:blue",
        label="with the effect found",
    )
    right.set_xticks(x, [*(f"e{k + 1}" for k in range(19)), "pdc", "Fx", "Fy", "Fz"], fontsize=7)
    right.set_ylabel("RMS / (noise, resolution)")
    right.set_title(f"held-out presses; hidden: {truth} (synthetic); {report.verdict}", fontsize=9)
    right.legend(fontsize=8)
    pathlib.Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("--seed", type=int, default=0)
    args.add_argument("--count", type=int, default=14, help="presses")
    args.add_argument("--out", default="out/find_the_missing_effect.png")
    args.add_argument("--quiet", action="store_true")
    args = args.parse_args(argv)
    rng = np.random.default_rng(args.seed)
    truth = str(rng.choice(list(HIDDEN)))
    hidden = next(e for e in CATALOGUE if e.id == truth)
    sim = Simulator(skin="coarse")
    data = measure(
        sim, presses(args.count, args.seed), (hidden, {**hidden.default(), **HIDDEN[truth]}), args.seed + 1
    )
    report = diagnose(sim, data, progress=not args.quiet)
    print(f"hidden: {truth} {HIDDEN[truth]}\nverdict: {report.verdict}")
    for effect in report.effects:
        for name, size in list(effect.parameters.items())[:3]:
            print(f"  {name} {size}")
    force, electrodes = report.gap["force"], report.gap["electrodes"]
    print(
        f"gap closed on held-out presses: {report.closed:.0%}; force {force.before:.4f} -> "
        f"{force.after:.4f} N, electrodes {electrodes.before:.2f} -> {electrodes.after:.2f} counts RMS"
    )
    picture(report, truth, args.out)
    return report, truth


if __name__ == "__main__":
    main()
