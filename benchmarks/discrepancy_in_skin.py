"""What the reduced forms of effects of rubber, contact and film miss: presses and slides of a 7 mm sphere on
the coarse skin, with the effect after the skin and inside it.

    python benchmarks/discrepancy_in_skin.py --json out/in_skin.json [--only relax adhesion ...]

- relax, creep, mullins, stiffen, inhomog, hyster: pressed 1.2 mm into the pad, held, drawn back to half,
  held, pressed again and taken away. The largest change that the effect makes inside the skin while touched
  and what the reduced form misses of it (RMS over those rows); then the same after the release, at the most.
- adhesion: a press of 1 mm; changes of the signed normal force (positive pushes), deep (above 0.1 mm) and at
  the edge of contact.
- sticking: how hard the sphere sticks when it is drawn off, against Johnson, Kendall and Roberts.
- fric_load: slides of 3 mm at three depths, back and forth; slope and level of the ratio of drag to load
  over Coulomb's.
- film (asper, fluidloss): a press of 1 mm, held; changes at rest and while held.

`discrepancy_in_skin_maps.py` measures the constants by which reduced forms become constants of the skin."""

import argparse
import dataclasses
import pathlib
import time

import numpy as np
from records import write_json

__all__ = ["main", "table"]

RADIUS, PLACES = 3.5e-3, (-12e-3, -11e-3, -10e-3)  # of the sphere, x of the presses [m]
RUBBER = (
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
ADHESION = (0.02, 0.05, 0.1)  # [J/m^2]; parting takes three times that
EXPONENTS = (0.1, 0.3, -0.1)
FILM = (
    ("asper", {"log_p": 0.3}, 0.0),
    ("asper", {"log_p": -0.3}, 0.0),
    ("fluidloss", {"rate": 0.2}, 900.0),
    ("fluidloss", {"rate": 0.2}, 3600.0),
)


def first_touch(skin, x):
    """Height y of the sphere's centre where it meets the pad's nodes at x, coming from -y on the midline
    [m]."""
    outer = skin.vert[np.unique(skin.outer_face)]
    away = np.hypot(outer[:, 0] - x, outer[:, 2])
    near = (away < RADIUS) & (outer[:, 1] < 0)
    return (outer[near, 1] - np.sqrt(RADIUS**2 - away[near] ** 2)).min()


def surface(vert, x, z=0.0):
    """Lowest y of the nodes within 2 mm of a place on the pad [m]."""
    return vert[(abs(vert[:, 0] - x) < 2e-3) & (abs(vert[:, 2] - z) < 2e-3), 1].min()


def trajectory(knots, depths, rows, along=PLACES[0], tip=None):
    """A Trajectory of the sphere: times [s], depths [m] and places x [m] of its corners; rows of each
    stretch. Depths are below `tip`, the height y of the sphere's front [m]; None: at first touch."""
    from biotac_mj.discrepancy.trajectories.trajectory import Trajectory
    from biotac_mj.geometry import load_skin

    along = np.broadcast_to(along, len(knots))
    rows = np.broadcast_to(rows, len(knots) - 1)
    stretches = [np.linspace(a, b, n + 1)[1:] for a, b, n in zip(knots[:-1], knots[1:], rows)]
    t = np.concatenate([[knots[0]], *stretches])
    tip = first_touch(load_skin("coarse"), along[0]) + RADIUS if tip is None else tip
    pos = np.column_stack([np.interp(t, knots, along), tip + np.interp(t, knots, depths), np.zeros(len(t))])
    turn = np.tile(np.eye(3), (len(t), 1, 1))
    return Trajectory("press", "sphere_7mm", 0.0, t, pos, turn, np.full((len(t), 19), 2500.0))


def solved(sim, path, effect, theta):
    """The run with the effect inside the skin."""
    from biotac_mj.effects.catalogue import by_id

    return sim.run([path], effects=[(by_id(effect), theta)])[0]


def reduced(sim, path, effect, theta, plain):
    """The run with the effect in its reduced form, on the fields of a run without it, which are not solved
    again."""
    from biotac_mj.discrepancy.trajectories.model.fields import Fields
    from biotac_mj.effects.catalogue import by_id

    base = [{"force": plain.force, "pressure": plain.pressure, "log_z": plain.log_z}]
    still = [{name: np.zeros_like(v) for name, v in base[0].items()}]
    fields = Fields(base, dict.fromkeys("xyz", still), [path])
    return sim.run([path], fields, False, [(by_id(effect), theta)])[0]


def three(sim, path, effect, theta):
    """Runs without the effect, with it inside the skin, and in its reduced form."""
    plain, inside = (solved(sim, path, effect, th) for th in (dict.fromkeys(theta, 1e-12), theta))
    return plain, inside, reduced(sim, path, effect, theta, plain)


def missed(runs, name, value, rows):
    """Of some rows of three runs: the largest change of a value, and the RMS of what the reduced form
    misses."""
    plain, inside, form = (value(run)[rows] for run in runs)
    return {
        f"{name}_changes": float(np.abs(inside - plain).max()),
        f"{name}_missed": float(np.sqrt(((form - inside) ** 2).mean())),
    }


def rubber(sim, rows, wanted):
    from biotac_mj.geometry import load_skin

    knots = np.array([0, 1.0, 3.0, 3.5, 5.0, 5.5, 6.5])
    depths = np.array([-0.1, 1.2, 1.2, 0.6, 0.6, 1.2, -0.1]) * 1e-3
    path = trajectory(knots, depths, rows, tip=surface(load_skin("coarse").vert, PLACES[0]))
    plain, out = sim.run([path], effects=[])[0], []
    for effect, theta in RUBBER:
        if effect not in wanted:
            continue
        began = time.process_time()
        inside = solved(sim, path, effect, theta)
        row = {"effect": effect, "parameters": " ".join(f"{k} {v:g}" for k, v in theta.items())}
        row["seconds"] = time.process_time() - began
        runs = plain, inside, reduced(sim, path, effect, theta, plain)
        touching = inside.normal_force > 1e-3
        gone = np.arange(len(touching)) > np.flatnonzero(touching)[-1]
        for name, value in (
            ("force", lambda r: r.normal_force),
            ("pressure", lambda r: r.pressure),
            ("counts", lambda r: r.counts),
        ):
            row |= missed(runs, name, value, touching)
            a, b, c = (value(run)[gone] for run in runs)
            row |= {f"{name}_after": float(np.abs(b - a).max())}
            row |= {f"{name}_after_missed": float(np.abs(c - b).max())}
        out.append(row)
    return out


def adhesion(sim, rows):
    depths = np.array([-0.1e-3, 0.1e-3, 1e-3, 0.1e-3, -0.15e-3])
    path = trajectory(np.arange(5.0), depths, (40, rows, rows, 50))
    deep, out = slice(41, 40 + 2 * rows), []
    for W in ADHESION:
        runs = plain, inside, form = three(sim, path, "adhesion", {"W": W})
        force = [-run.force @ path.heading for run in runs]
        change, said = force[1] - force[0], force[2] - force[0]
        edge = np.r_[0 : deep.start, deep.stop : len(change)]
        out.append(
            {
                "W": W,
                "inside_deep": float(change[deep].min()),
                "reduced_deep": float(said[deep].min()),
                "inside_edge": float(change[edge].min()),
                "reduced_edge": float(said[edge].min()),
                "jkr_deep": -3 * np.pi * W * RADIUS,
                "counts": float(np.abs(inside.counts - plain.counts).max()),
                "reduced_counts": float(np.abs(form.counts - plain.counts).max()),
            }
        )
    return out


def sticking(skin, W, reach=None, depth=1e-4):
    """Least force while the sphere comes and while it leaves in steps of 2.5 um, at three places [N]; JKR's;
    iterations, failed steps."""
    from biotac_mj.geometry import load_skin
    from biotac_mj.skin import ContactLaw, GeomSet, SkinData, SkinModel, SkinOptions, step

    geometry, law = load_skin(skin), ContactLaw(adhesion=W, adhesion_hysteresis=3.0, adhesion_range=reach)
    model = SkinModel(geometry, "default", SkinOptions(liquid=True, contact_law=law, tolerance=1e-4))
    path = np.concatenate([np.arange(-1e-4, depth, 2.5e-6), np.arange(depth, -2e-4, -2.5e-6)])
    pulls, iterations, failed, began = [], [], 0, time.process_time()
    for x in PLACES:
        data, geoms = SkinData(model), GeomSet(["sphere"], [(RADIUS,)], [0.78])
        y, force = first_touch(geometry, x), []
        for d in path:
            geoms.set_pose([[x, y + d, 0]])
            step(model, data, geoms)
            force.append(data.wrench[0, 0, 1])
            iterations.append(int(data.iterations[0]))
            failed += int(not data.converged[0])
        turn = np.argmax(path)
        pulls.append((-max(force[:turn]), -max(force[turn:])))
        assert force[-1] == 0, "the sphere never came off: draw it further"
    return {
        "skin": skin,
        "W": W,
        "range": float(data.laws.range[0]),
        "edge": data.laws.edge,
        "in": [p[0] for p in pulls],
        "out": [p[1] for p in pulls],
        "jkr_in": -1.5 * np.pi * W * RADIUS,
        "jkr_out": -4.5 * np.pi * W * RADIUS,
        "iterations": float(np.mean(iterations)),
        "failed": failed,
        "steps": len(iterations),
        "seconds": time.process_time() - began,
    }


def friction(sim, rows):
    along = np.array([-1, -1, 1, 1, -1, -1, 1, 1]) * 1.5e-3 - 11e-3
    depths = np.array([-0.1, 0.2, 0.2, 0.6, 0.6, 1.4, 1.4, -0.1]) * 1e-3
    path = trajectory(np.arange(8.0), depths, rows, along)
    sliding = np.concatenate([np.arange(k * rows + rows // 2, (k + 1) * rows + 1) for k in (1, 3, 5)])
    out = []
    for exponent in EXPONENTS:
        runs = plain, inside, _ = three(sim, path, "fric_load", {"exponent": exponent})
        load = inside.normal_force[sliding]
        drag = [np.linalg.norm(np.delete(run.force[sliding], 1, axis=1), axis=1) for run in (plain, inside)]
        ratio = (drag[1] / load) / (drag[0] / plain.normal_force[sliding])
        slope, level = np.polyfit(np.log(load), np.log(ratio), 1)
        scatter = float(np.std(np.log(ratio) - slope * np.log(load) - level))
        row = {"exponent": exponent, "slope": slope, "level": float(np.exp(level)), "scatter": scatter}
        touching = plain.normal_force > 1e-3
        row |= missed(runs, "drag", lambda r: r.force[:, 0], touching)
        row |= missed(runs, "normal", lambda r: r.normal_force, touching)
        out.append(row | missed(runs, "counts", lambda r: r.counts, touching))
    return out


def film(sim, rows):
    path = trajectory(np.arange(4.0), np.array([-0.1e-3, 1e-3, 1e-3, -0.1e-3]), (rows, 4, rows))
    held, out = rows + 2, []
    for effect, theta, clock in FILM:
        runs = plain, inside, form = three(sim, dataclasses.replace(path, clock=clock), effect, theta)
        (parameter,) = theta.values()
        row = {"effect": effect, "parameter": parameter, "clock": clock}
        for when, k in (("rest", 0), ("held", held)):
            row |= missed(runs, when, lambda r: r.counts, k)
            row[f"{when}_reduced"] = float(np.abs(form.counts[k] - plain.counts[k]).max())
        row |= {"N_plain": float(plain.normal_force[held]), "N_inside": float(inside.normal_force[held])}
        row |= {"Pa_plain": float(plain.pressure[held]), "Pa_inside": float(inside.pressure[held])}
        out.append(row | {"Pa_rest": float(inside.pressure[0])})
    return out


def table(rows: list[dict]) -> None:
    """Prints dicts of the same keys."""

    def cell(v):
        if isinstance(v, str):
            return v
        return " ".join(f"{x:.3g}" for x in v) if isinstance(v, (list, tuple)) else f"{v:.3g}"

    columns = list(rows[0])
    width = [max(len(c), *(len(cell(r[c])) for r in rows)) + 2 for c in columns]
    print("".join(f"{c:>{w}}" for c, w in zip(columns, width)))
    for r in rows:
        print("".join(f"{cell(r[c]):>{w}}" for c, w in zip(columns, width)))
    print(flush=True)


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = list(dict.fromkeys(effect for effect, _ in RUBBER))
    every = [*names, "adhesion", "sticking", "fric_load", "film"]
    args.add_argument("--only", nargs="+", choices=every, default=every)
    args.add_argument("--skins", default="coarse,default", help="of the sticking")
    args.add_argument("--rows", type=int, default=12, help="rows of each stretch of a press and slide")
    args.add_argument("--json", type=pathlib.Path)
    args = args.parse_args(argv)
    from biotac_mj.discrepancy.trajectories.model.in_skin import InSkinSimulator

    sim, out = InSkinSimulator(), {}
    reaches = (0.05, None), (0.05, 4e-5), (0.2, None)
    makes = {
        "rubber": lambda: rubber(sim, args.rows, args.only),
        "adhesion": lambda: adhesion(sim, args.rows),
        "sticking": lambda: [sticking(s, *one) for s in args.skins.split(",") for one in reaches],
        "fric_load": lambda: friction(sim, args.rows),
        "film": lambda: film(sim, args.rows),
    }
    wanted = [name for name in makes if set(args.only) & ({*names} if name == "rubber" else {name})]
    for name in wanted:
        began = time.process_time()
        out[name] = makes[name]()
        print(f"{name} [N, Pa, counts]: {time.process_time() - began:.0f} s of processor time")
        table(out[name])
        if args.json:
            write_json(args.json, out)


if __name__ == "__main__":
    main()
