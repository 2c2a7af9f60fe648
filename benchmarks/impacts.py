"""Does a blow give bodies energy that nobody put in? One or two bodies are thrown at a finger.

    python benchmarks/impacts.py --cases 100 --seed 0 --json OUT [--tier condensed] [--skin coarse]
    [--integrators Euler implicit implicitfast RK4] [--only 17 23]

A case: spheres, boxes, capsules, cylinders and ellipsoids of 3 to 40 mm and 1 g to 1 kg, thrown at up to
1 m/s with spin at a finger that is fixed, on a hinge or free, in steps of 1 to 4 ms, without gravity, mostly
at the pad, else from any side; two bodies may pinch it or strike one after the other. All are synthetic.

`growth` is the most by which the kinetic energy of all bodies exceeds that of the start, as a share of it,
less `flight`: what they gain in the same steps where nothing touches them (MuJoCo's Euler takes gyroscopic
and centrifugal terms explicitly). Rows by integrator: cases, those whose growth is over 5 %, the largest,
steps in touch, those of them that did not settle, the slowest step [s].
"""

import argparse
import copy
import pathlib
import time
import warnings

import mujoco
import numpy as np
from records import write_json

import biotac_mj
from biotac_mj import plugin

__all__ = ["case", "follow", "main"]

INTEGRATORS = "Euler", "implicit", "implicitfast", "RK4"
KINDS = "sphere", "box", "capsule", "cylinder", "ellipsoid"
TIP = {"body": "finger", "quat": [np.sqrt(0.5), -np.sqrt(0.5), 0, 0], "pos": [6.2e-3, 0, 0]}
TOP = 8.31e-3  # of the pad over the finger's axis [m]
SECONDS = 0.1  # of a case
MOST = 0.05  # growth that is called bad
GHOST = 'contype="0" conaffinity="0"'


def _finger(rng):
    """XML of a finger, its degrees of freedom and the case in words."""
    kind, own = str(rng.choice(["fixed", "hinged", "free"])), 10 ** rng.uniform(-2, -0.5)
    if kind == "fixed":
        return '<body name="finger"/>', 0, kind
    box = f'<geom type="box" size=".008 .008 .008" pos="{rng.uniform(-0.03, 0.03)} 0 -.01" mass="{own}" '
    box += f"{GHOST}/>"
    joint, dofs = "<freejoint/>", 6
    if kind == "hinged":
        axis = rng.choice(["0 1 0", "0 0 1", "1 0 0"])
        joint, dofs = f'<joint axis="{axis}" pos=".04 0 -.005" damping="{rng.choice([0, 2e-5])}"/>', 1
    return f'<body name="finger">{joint}{box}</body>', dofs, f"{kind} {1e3 * own:.3g} g"


def _body(rng, name, gap):
    """XML of a body on its way to the finger from some side, mostly to the pad, its velocity (6,) and what it
    is in words. gap: [m] at most between them."""
    mass, kind = 10 ** rng.uniform(-3, 0), str(rng.choice(KINDS))
    size, quat = rng.uniform(1.5e-3, 10 ** rng.uniform(-2.6, -1.7), 3), rng.normal(size=4)
    reach = {"box": np.linalg.norm(size), "sphere": size[0], "ellipsoid": size.max()}.get(
        kind, size[:2].sum() if kind == "capsule" else np.linalg.norm(size[:2])
    )
    toward, at_pad = rng.normal(size=3), rng.random() < 0.6
    toward = toward * [0.3, 0.3, 0.0] + [0, 0, 1] if at_pad else toward * [0.5, 1, 1]
    toward /= np.linalg.norm(toward)
    pos = [rng.uniform(-0.006, 0.006), 0, 0] + toward * (TOP + reach + 10 ** rng.uniform(-4, np.log10(gap)))
    speed, velocity = rng.uniform(0.05, 1.0), np.zeros(6)
    velocity[:3] = -speed * (toward + 0.2 * rng.normal(size=3) * (rng.random() < 0.5))
    velocity[3:] = rng.normal(size=3) * 10 ** rng.uniform(-1, 1.3)
    pos, quat, size = (" ".join(f"{v:.9g}" for v in numbers) for numbers in (pos, quat, size))
    xml = f'<body name="{name}" pos="{pos}" quat="{quat}"><freejoint/><geom type="{kind}" size="{size}" '
    xml += f'mass="{mass}" friction="{rng.uniform(0.0, 1.5)}"/></body>'
    return xml, velocity, f"{kind} {1e3 * mass:.3g} g {speed:.2f} m/s"


def case(seed: int, number: int, integrator: str, skin: str, tier: str, **settings) -> tuple:
    """Model, data, handle and the case in words. The same case for every integrator."""
    rng = np.random.default_rng([seed, number])
    while True:
        finger, dofs, told = _finger(rng)
        count = 1 + int(rng.random() < 0.35)
        bodies, velocities, words = zip(*(_body(rng, f"thrown{i}", 5e-3 + 0.02 * i) for i in range(count)))
        dt = float(rng.choice([0.001, 0.002, 0.003, 0.004]))
        spec = mujoco.MjSpec.from_string(
            f'<mujoco><option timestep="{dt}" integrator="{integrator}" gravity="0 0 0"/>'
            f"<worldbody>{finger}{''.join(bodies)}</worldbody></mujoco>"
        )
        handle = biotac_mj.attach(spec, **TIP, skin=skin, tier=tier, readings="none", **settings)
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        if not (handle.read(data, "contact_force").any() or data.ncon):  # nothing has paid for what overlaps
            break
    data.qvel[dofs:] = np.concatenate(velocities)
    return model, data, handle, f"{1e3 * dt:g} ms, {integrator}, {told}, {', '.join(words)}"


def follow(model: mujoco.MjModel, data: mujoco.MjData, handle: object, rows: list | None = None) -> dict:
    """Makes the case's steps; what was seen. rows: gets one for each step in touch."""
    mujoco.mj_forward(model, data)
    start, alone = _kinetic(model, data), _Alone(model)
    seen = dict(growth=0.0, flight=0.0, touched=0, unsettled=0, slowest_s=0.0, nan=False)
    before = start
    for k in range(round(SECONDS / model.opt.timestep)):
        gain = alone.gain(data)
        begin = time.process_time()
        mujoco.mj_step(model, data)
        seen["slowest_s"] = max(seen["slowest_s"], time.process_time() - begin)
        if not np.isfinite(data.qvel).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            plugin.clear_errors()
            return {**seen, "nan": True, "growth": np.inf}
        plugin.check()
        now, status = _kinetic(model, data), handle.read(data, "status")
        if handle.read(data, "contact_force").any() or data.ncon:
            seen["touched"] += 1
            seen["unsettled"] += int(status[0] != 1)
            if rows is not None:
                rows.append((k, now / start, (now - before) / start, status.round(4).tolist(), data.ncon))
        seen["flight"] += max(gain, 0.0) / start
        seen["growth"] = max(seen["growth"], now / start - 1.0 - seen["flight"])
        before = now
    return seen


class _Alone:
    """What bodies gain in a step that nothing touches, by MuJoCo's integrator alone."""

    def __init__(self, model):
        self.model = copy.copy(model)
        off = ("CONTACT", "EQUALITY", "SPRING", "DAMPER", "SENSOR")  # neither skin nor contacts
        for flag in off:
            self.model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
        self.data = mujoco.MjData(self.model)

    def gain(self, data):
        self.data.qpos, self.data.qvel = data.qpos, data.qvel
        before = _kinetic(self.model, self.data)
        mujoco.mj_step(self.model, self.data)
        return _kinetic(self.model, self.data) - before


def _kinetic(model, data):
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_crb(model, data)
    mujoco.mj_comVel(model, data)
    mujoco.mj_energyVel(model, data)
    return float(data.energy[1])


def main(arguments: list[str] | None = None) -> dict:
    """Throws; writes and prints the totals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tier", choices=["full", "condensed"], default="condensed")
    parser.add_argument("--skin", default="coarse")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=100, help="of each integrator")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of the cases, with a row for each step")
    parser.add_argument("--integrators", nargs="+", choices=INTEGRATORS, default=INTEGRATORS)
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    found = {name: [] for name in args.integrators}
    for number in args.only or range(args.cases):
        for name in args.integrators:
            *made, told = case(args.seed, number, name, args.skin, args.tier)
            rows = [] if args.only else None
            seen = follow(*made, rows)
            found[name].append({"case": told, "seed": [args.seed, number], **seen})
            bad = "BAD" if seen["growth"] > MOST else ""
            print(f"{number:4d} {told:110s} growth {seen['growth']:8.2g} flight {seen['flight']:.2g} "
                  f"touched {seen['touched']:3d} unsettled {seen['unsettled']:3d} "
                  f"slowest {seen['slowest_s']:.2f} s {bad}", flush=True)  # fmt: skip
            for row in rows or ():
                print("    ", *row)
    result = {
        name: {
            "cases": len(rows),
            "bad": sum(row["growth"] > MOST for row in rows),
            "nan": sum(row["nan"] for row in rows),
            "largest": max(row["growth"] for row in rows),
            **{key: sum(row[key] for row in rows) for key in ("touched", "unsettled")},
            "slowest_s": max(row["slowest_s"] for row in rows),
        }
        for name, rows in found.items()
    }
    for name, row in result.items():
        print(f"{name:13s} {row}")
    told = {"tier": args.tier, "skin": args.skin, "seed": args.seed, "limit": MOST}
    if args.json:
        write_json(args.json, {**told, "by_integrator": result, "cases": found})
    return result


if __name__ == "__main__":
    main()
