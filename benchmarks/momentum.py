"""Is the force that a BioTac reports the force that acted? Free bodies are thrown at a finger.

    python benchmarks/momentum.py --tier condensed --steps 2000 --json OUT [--seed 0] [--skin coarse]
    [--integrators Euler implicit implicitfast RK4] [--off 0.25] [--solver CG --iterations 3]
    python benchmarks/momentum.py --worlds 8 --steps 600 --json OUT

A case: a sphere, box, capsule or ellipsoid of 1 g to 1 kg that is dropped, thrown at up to 1 m/s with spin,
or grazes a finger that is fixed or floats; timesteps of 0.5 to 5 ms, with and without gravity. In each step
in which the skin or its solid parts (core, nail, clamp) hold the body, the change of its momentum, less what
gravity gave, is compared with the force that the finger's `contact_force` reports.

Cases go on, each integrator in turn, until each has as many checked steps. Rows: checked steps; those that
did not settle, in which push was withheld, in which the solid parts touched; those whose force is off by more
than a quarter (`--off`) of the larger of both, and of 0.05 of the body's weight; how many of these `status`
called settled; the largest such error; what 99 % of the steps stay below. All are synthetic.

With `--worlds` a case is a mujoco_warp batch of as many throws of its body, in the full tier, and
`off_of_last_solve` counts the steps in which the wrench of the skin's last solve, without the solid parts, is
off so far.
"""

import argparse
import pathlib
import warnings

import mujoco
import numpy as np
from impacts import GHOST, INTEGRATORS, TIP, TOP
from records import write_json

import biotac_mj
from biotac_mj import Handle, plugin

__all__ = ["check", "main", "scene"]

KINDS = "sphere", "box", "capsule", "ellipsoid"
SECONDS = 0.08  # of a case
LEAST = 0.05  # of the body's weight: smaller forces are not compared by ratio


def throw(rng: np.random.Generator, integrator: str) -> tuple:
    """A finger and a body over it: spec, whether the finger floats, how the body comes, the case in words."""
    mass, dt = 10 ** rng.uniform(-3, 0), float(rng.choice([5e-4, 1e-3, 2e-3, 3e-3, 5e-3]))
    kind, way = str(rng.choice(KINDS)), str(rng.choice(["drop", "throw", "graze"]))
    size, quat = 10 ** rng.uniform(-2.5, -1.8, 3), rng.normal(size=4)
    # how far from its centre no body of this kind and size reaches
    height = TOP + (
        np.linalg.norm(size) if kind == "box" else size[:2].sum() if kind == "capsule" else size.max()
    )
    floats, own = bool(way != "drop" and rng.random() < 0.4), 10 ** rng.uniform(-2, -0.7)
    finger = '<body name="finger"/>'
    if floats:
        offset = rng.uniform(-0.03, 0.03)
        finger = (
            f'<body name="finger"><freejoint/><geom type="box" size=".008 .008 .008" pos="{offset} 0 -.01" '
            f'mass="{own}" {GHOST}/></body>'
        )
    x, y = rng.uniform(-0.006, 0.006, 2)
    gravity = -9.81 if way == "drop" or (not floats and rng.random() < 0.5) else 0.0
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{dt}" integrator="{integrator}" gravity="0 0 {gravity}"/>'
        f'<worldbody>{finger}<body name="thrown" pos="{x} {y} {height + 1e-4}" '
        f'quat="{" ".join(map(str, quat))}"><freejoint/><geom name="thrown" type="{kind}" mass="{mass}" '
        f'size="{" ".join(map(str, size))}" friction="{rng.uniform(0.1, 1.2)}"/></body></worldbody></mujoco>'
    )
    told = f"{1e3 * dt:g} ms, {integrator}, finger {'floats' if floats else 'fixed'}, gravity {gravity}"
    return spec, floats, way, f"{kind} {1e3 * mass:.3g} g, {way}, {told}"


def velocity(rng: np.random.Generator, way: str) -> np.ndarray:
    """(6,) of the body."""
    out = np.zeros(6)
    out[2] = -{"drop": 0.0, "throw": rng.uniform(0.05, 1.0), "graze": rng.uniform(0.02, 0.2)}[way]
    if way == "graze":
        out[:2] = rng.normal(size=2) * rng.uniform(0.1, 0.7)
    out[3:] = rng.normal(size=3) * 10 ** rng.uniform(-1, 1.3)
    return out


def scene(rng: np.random.Generator, integrator: str, skin: str, tier: str, **settings) -> tuple:
    """A finger and a body on its way: model, data, handle and the case in words."""
    spec, floats, way, told = throw(rng, integrator)
    handle = biotac_mj.attach(spec, **TIP, skin=skin, tier=tier, readings="none", **settings)
    model = spec.compile()
    data, first = mujoco.MjData(model), 6 * floats
    data.qvel[first : first + 6] = velocity(rng, way)
    return model, data, handle, f"{told}, {-data.qvel[first + 2]:.2f} m/s"


def check(model: mujoco.MjModel, data: mujoco.MjData, handle: Handle, steps: int) -> list[dict]:
    """Makes so many steps; a row for each in which the finger held the body."""
    body, core = model.body("thrown"), data.body(handle.body)
    joint, mass = int(body.dofadr[0]), float(body.mass[0])
    thrown = model.geom("thrown").id
    rows = []
    for k in range(steps):
        before = data.qvel[joint : joint + 3].copy()
        mujoco.mj_kinematics(model, data)
        frame = core.xmat.reshape(3, 3).copy()  # at the step's start, as that of its force is
        mujoco.mj_step(model, data)
        plugin.check()
        took = mass * ((data.qvel[joint : joint + 3] - before) / model.opt.timestep - model.opt.gravity)
        told = -frame @ handle.read(data, "contact_force")[:3]
        solid = sum(thrown in c.geom for c in data.contact if c.efc_address >= 0)
        size = max(np.linalg.norm(took), np.linalg.norm(told))
        if size < 1e-9 and not solid:
            continue
        status = handle.read(data, "status")
        off = np.linalg.norm(took - told) / max(size, LEAST * mass * 9.81)
        rows.append(
            dict(step=k, took=took.round(6).tolist(), told=told.round(6).tolist(), off=float(off),
                 solid=solid, settled=bool(status[0] == 1), rounds=int(status[5]), reached=float(status[6]),
                 withheld=float(status[7]))
        )  # fmt: skip
    return rows


def batch_scene(rng: np.random.Generator, integrator: str, skin: str, nworld: int) -> tuple:
    """As many throws of one body: model, mujoco_warp's Model and Data, the batch and the case in words."""
    import mujoco_warp as mjw

    from biotac_mj import batch as batches

    spec, floats, way, told = throw(rng, integrator)
    batches.add(spec, **TIP, skin=skin)
    model = spec.compile()
    data, first = mujoco.MjData(model), 6 * floats
    mujoco.mj_forward(model, data)
    m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=nworld, nconmax=32, njmax=128)
    batch = batches.attach(model, m, d, skin=skin, readings=False)
    qvel = np.zeros((nworld, model.nv), np.float32)
    qvel[:, first : first + 6] = [velocity(rng, way) for _ in range(nworld)]
    d.qvel.assign(qvel)
    return model, m, d, batch, told


def check_batch(model: mujoco.MjModel, m: object, d: object, batch: object, steps: int) -> list[dict]:
    """As `check`, for all worlds; with how far off the skin's last solve is."""
    import mujoco_warp as mjw

    body, core = model.body("thrown"), model.body("biotac_core").id
    at, mass, thrown = slice(body.dofadr[0], body.dofadr[0] + 3), float(body.mass[0]), model.geom("thrown").id
    begin = {c: int(model.sensor(f"biotac_{c}").adr[0]) for c in ("status", "contact_force")}
    least, rows = LEAST * mass * 9.81, []
    for k in range(steps):
        before = d.qvel.numpy()[:, at].astype(float)
        mjw.step(m, d)
        took = mass * ((d.qvel.numpy()[:, at] - before) / model.opt.timestep - model.opt.gravity)
        read, frame = d.sensordata.numpy().astype(float), d.xmat.numpy()[:, core]
        force = read[:, begin["contact_force"] :][:, :3, None]
        told, solved = -(frame @ force)[..., 0], (frame @ batch.wrench[:, 0, :3, None])[..., 0]
        count = int(d.nacon.numpy()[0])
        mine = (d.contact.geom.numpy()[:count] == thrown).any(1) & (
            d.contact.efc_address.numpy()[:count, 0] >= 0
        )
        solid = np.bincount(d.contact.worldid.numpy()[:count][mine], minlength=d.nworld)
        for w, status in enumerate(read[:, begin["status"] :][:, :8]):
            size = max(np.linalg.norm(took[w]), np.linalg.norm(told[w]))
            if size < 0.02 * least and not solid[w]:  # velocities are of single precision
                continue
            off, off_of_solve = (
                float(np.linalg.norm(took[w] - x[w])) / max(size, least) for x in (told, solved)
            )
            rows.append(
                dict(step=k, world=w, took=took[w].round(6).tolist(), told=told[w].round(6).tolist(), off=off,
                     off_of_solve=off_of_solve, solid=int(solid[w]), settled=bool(status[0] == 1),
                     rounds=int(status[5]), reached=float(status[6]), withheld=float(status[7]))
            )  # fmt: skip
    return rows


def summary(rows: list[dict], most: float) -> dict:
    """Of checked steps."""
    bad = [row for row in rows if row["off"] > most]
    errors = np.array([row["off"] for row in rows] or [0.0])
    told = {}
    if rows and "off_of_solve" in rows[0]:
        told["off_of_last_solve"] = sum(bool(row["off_of_solve"] > most) for row in rows)
        told["worst_of_last_solve"] = float(max(row["off_of_solve"] for row in rows))
    return {
        "steps": len(rows),
        "unsettled": sum(not row["settled"] for row in rows),
        "withheld": sum(row["withheld"] > 0 for row in rows),
        "solid": sum(row["solid"] > 0 for row in rows),
        "off": len(bad),
        "off_settled": sum(row["settled"] for row in bad),
        "off_without_solid": sum(not row["solid"] for row in bad),
        "worst": float(errors.max()),
        "of_99_percent": float(np.quantile(errors, 0.99)),
        **told,
    }


def main(arguments: list[str] | None = None) -> dict:
    """Throws until each integrator has its steps; writes and prints the totals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tier", choices=["full", "condensed"], default="condensed")
    parser.add_argument("--skin", default="coarse")
    parser.add_argument("--steps", type=int, default=2000, help="in touch, of all integrators together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--integrators", nargs="+", choices=INTEGRATORS, default=INTEGRATORS[:3])
    parser.add_argument("--off", type=float, default=0.25)
    parser.add_argument("--solver", choices=["CG", "Newton", "PGS"], help="of constraints in `mj_step`")
    parser.add_argument("--iterations", type=int, help="of that solver at most")
    parser.add_argument("--worlds", type=int, help="of a mujoco_warp batch; else the engine plugin")
    parser.add_argument("--json", type=pathlib.Path, default="out/benchmarks/momentum.json")
    args = parser.parse_args(arguments)
    args.json.parent.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore")
    found = {name: [] for name in args.integrators}
    cases, number = [], 0
    for name, rows in found.items():
        while len(rows) < args.steps / len(found):
            rng = np.random.default_rng([args.seed, number])
            number += 1
            if args.worlds:
                *made, told = batch_scene(rng, name, args.skin, args.worlds)
            else:
                *made, told = scene(rng, name, args.skin, args.tier)
                option = made[0].opt
                option.solver = getattr(mujoco.mjtSolver, f"mjSOL_{args.solver}", option.solver)
                option.iterations = args.iterations or option.iterations
            of_case = check_batch if args.worlds else check
            steps = of_case(*made, int(SECONDS / made[0].opt.timestep))
            rows += steps
            cases.append({"case": told, "seed": [args.seed, number - 1], "rows": steps})
            print(f"{told:95s} {summary(steps, args.off)}", flush=True)
    result = {name: summary(rows, args.off) for name, rows in found.items()}
    result["all"] = summary([row for rows in found.values() for row in rows], args.off)
    told = {
        "tier": "full" if args.worlds else args.tier,
        "worlds": args.worlds,
        "skin": args.skin,
        "seed": args.seed,
        "limit": args.off,
    }
    write_json(args.json, {**told, "by_integrator": result, "cases": cases})
    for name, row in result.items():
        print(f"{name:13s} {row}")
    return result


if __name__ == "__main__":
    main()
