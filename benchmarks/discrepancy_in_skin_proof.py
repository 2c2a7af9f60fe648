"""Rubber with stiffening, friction or a modulus that varies inside a sensor: what `diagnose` names, and how
much of the gap the amended simulator closes with the effect on the forces and with the effect inside the
elements.

    python benchmarks/discrepancy_in_skin_proof.py --json out/in_skin_proof.json

The measurement is synthetic: the full tier's skin with these constants in its elements, 10 % stiffer than
the simulator's, slips of the pose of 20 um, noise and 12 bits; presses of two spheres. The share closed is
that of the trajectories kept aside."""

import argparse
import json
import pathlib
import time

import numpy as np

RUBBERS = {
    "stiffening 30": {"material": {"stiffening": 30.0}},
    "stiffening 60": {"material": {"stiffening": 60.0}},
    "friction (1.0, 0.003)": {"material": {"hysteresis": ((1.0, 0.003),)}},
    "modulus 0.3 along": {"modulus": {"along": 0.3, "across": 0.0}},
    "modulus 0.3 along, 0.2 across": {"modulus": {"along": 0.3, "across": 0.2}},
}


def presses(count, seed):
    """Trajectories without readings: in, held, out, at places on the pad."""
    from scipy.spatial.transform import Rotation

    from biotac_mj import load_skin
    from biotac_mj.discrepancy import Trajectory
    from biotac_mj.press import approach

    rng, skin, out, clock = np.random.default_rng(seed), load_skin("coarse"), [], 0.0
    for i in range(count):
        point, normal = approach.surface_point(skin, rng.uniform(-0.014, -0.005), rng.uniform(-0.4, 0.4))
        depth, speed, hold = (
            rng.uniform(0.5e-3, 1.4e-3),
            np.exp(rng.uniform(np.log(1e-3), np.log(1e-2))),
            rng.uniform(0.3, 3),
        )
        d = np.concatenate(
            [[-2e-5] * 3, np.linspace(-2e-5, depth, 7)[1:], [depth] * 5, np.linspace(depth, -2e-5, 6)[1:]]
        )
        t = np.concatenate(
            [[0], np.cumsum([0.1] * 2 + [depth / speed / 6] * 6 + [hold / 5] * 5 + [depth / speed / 5] * 5)]
        )
        turn = np.tile(Rotation.align_vectors([-normal], [[0.0, 1.0, 0.0]])[0].as_matrix(), (len(t), 1, 1))
        none = np.full((len(t), 19), 2000.0), np.full(len(t), 2000.0), None, np.zeros((len(t), 3))
        out.append(
            Trajectory(
                f"press {i}",
                ["sphere_7mm", "sphere_14mm"][i % 2],
                clock,
                t,
                point - np.outer(d, normal),
                turn,
                *none,
            )
        )
        clock += t[-1] + 5
    return out


def measure(trajectories, rubber, skin, seed):
    """The trajectories with the readings of a sensor made of this rubber (synthetic)."""
    import dataclasses

    from biotac_mj import load_skin
    from biotac_mj.discrepancy.trajectories.model.in_skin import solve_with_memory
    from biotac_mj.effects.rubber import modulus_of
    from biotac_mj.sensor.film import FilmConduction
    from biotac_mj.skin import Material, SkinModel, SkinOptions

    rng, geometry = np.random.default_rng(seed), load_skin(skin)
    modulus = modulus_of(rubber["modulus"]) if "modulus" in rubber else None
    model = SkinModel(
        geometry, Material(**rubber.get("material", {})), SkinOptions(liquid=True), modulus=modulus
    )
    poses = [(t.tool, t.pos + rng.normal(0, 2e-5, 3)) for t in trajectories]
    out = []
    for t, one in zip(trajectories, solve_with_memory(model, FilmConduction(geometry), trajectories, poses)):
        counts = 4095 / (np.exp(one["log_z"]) / 1e4 + 1) + 3.5 * rng.standard_normal((len(t.time), 19))
        pdc = 2000 + 1.1 * one["pressure"] / 36.5 + rng.standard_normal(len(t.time))
        force = 1.1 * one["force"] + 0.006 * rng.standard_normal((len(t.time), 3))
        out.append(
            dataclasses.replace(
                t, electrodes=np.clip(np.rint(counts), 0, 4095), pdc=np.rint(pdc), force=force
            )
        )
    return out


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    args.add_argument("--skin", default="coarse", help="of the sensor; the simulator has the coarse one")
    args.add_argument("--count", type=int, default=12, help="presses")
    args.add_argument("--seed", type=int, default=5)
    args.add_argument("--only", choices=RUBBERS)
    args.add_argument("--json")
    args = args.parse_args(argv)
    from biotac_mj.discrepancy import Simulator, diagnose
    from biotac_mj.discrepancy.trajectories.model.in_skin import InSkinSimulator

    trajectories, rows = presses(args.count, args.seed), []
    began = time.process_time()
    fields = Simulator(tier="full").fields(trajectories, progress=False)
    print(f"fields: {time.process_time() - began:.0f} s of processor time", flush=True)
    for name, rubber in RUBBERS.items():
        if args.only not in (None, name):
            continue
        data = measure(trajectories, rubber, args.skin, args.seed)
        for kind, sim in (("on the forces", Simulator(tier="full")), ("inside", InSkinSimulator())):
            began = time.process_time()
            found = diagnose(sim, data, progress=False, fields=fields)
            parameters = {e.id: {name: p.value for name, p in e.parameters.items()} for e in found.effects}
            rows.append(
                {
                    "rubber": name,
                    "effects act": kind,
                    "verdict": found.verdict,
                    "parameters": parameters,
                    "closed": found.closed,
                    "rms": {k: (found.before[k], found.after[k]) for k in ("electrodes", "pdc", "force")},
                    "seconds": time.process_time() - began,
                }
            )
            print(
                f"{name:<32}{kind:<15}closed {found.closed:>6.2f}  {rows[-1]['seconds']:>4.0f} s  "
                f"{found.verdict}",
                flush=True,
            )
    if args.json:
        path = pathlib.Path(args.json)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
