"""What the reduced forms of adhesion, fric_load, fluidloss and asper miss: presses and slides with the effect
after the skin and inside it.

    python benchmarks/discrepancy_contact.py --json out/contact.json

Printed are: how the pressure of the nodes under a sphere of 7 mm grows with its load (the map from
fric_load's exponent to the contact's); how hard the sphere sticks when it is drawn off, against Johnson,
Kendall and Roberts; the comparisons. Forces are signed: positive pushes."""

import argparse
import json
import pathlib
import time

import numpy as np

RADIUS, PLACES = 3.5e-3, (-12e-3, -11e-3, -10e-3)
ADHESION = (0.02, 0.05, 0.1)  # [J/m^2]; parting takes three times that
EXPONENTS = (0.1, 0.3, -0.1)


def first_touch(skin, x):
    """Height y of the sphere's centre where it meets the pad's nodes at x, coming from -y on the midline
    [m]."""
    outer = skin.vert[np.unique(skin.outer_face)]
    away = np.hypot(outer[:, 0] - x, outer[:, 2])
    near = (away < RADIUS) & (outer[:, 1] < 0)
    return (outer[near, 1] - np.sqrt(RADIUS**2 - away[near] ** 2)).min()


def pressure_map(skin):
    """Exponent and pressure at 1 N [Pa] of the nodes' pressure under the sphere, as friction of exponent 0.3
    and 0.6 weighs it; scatter."""
    from biotac_mj.geometry import load_skin
    from biotac_mj.skin import GeomSet, SkinData, SkinModel, SkinOptions, step

    geometry = load_skin(skin)
    model = SkinModel(geometry, "default", SkinOptions(liquid=True))
    face, b = model.outer.face_np, model.sample.numpy()
    area = np.bincount(face.ravel(), np.repeat(model.outer.area.numpy() / 3, 3), model.nvert)
    load, weighed = [], {0.3: [], 0.6: []}
    for x in PLACES:
        data, geoms, y = SkinData(model), GeomSet(["sphere"], [(RADIUS,)]), first_touch(geometry, x)
        for depth in np.arange(0, 1.41e-3, 1e-4):
            geoms.set_pose([[x, y + depth, 0]])
            step(model, data, geoms)
            force = data.outer.sample_force.numpy()[:, 0].reshape(len(face), -1, 3)
            push = np.linalg.norm(force, axis=2) * (data.outer.trial_geom.numpy()[:, 0] >= 0).reshape(
                len(face), -1
            )
            if push.sum() < 0.1:
                continue
            node = np.zeros(model.nvert)
            np.add.at(node, face, np.einsum("fs,sc->fc", push, b))
            pressure = np.einsum("sc,fc->fs", b, (node / np.where(area > 0, area, 1))[face])
            load.append(push.sum())
            for n, out in weighed.items():
                out.append((np.maximum(pressure, 3e3)[push > 0] ** -n * push[push > 0]).sum() / push.sum())
    rows = []
    for n, out in weighed.items():
        slope, level = np.polyfit(np.log(load), np.log(out), 1)
        scatter = np.std(np.log(out) - slope * np.log(load) - level)
        rows.append(
            {
                "skin": skin,
                "n": n,
                "power": -slope / n,
                "at_1_N": float(np.exp(level) ** (-1 / n)),
                "scatter": float(scatter),
            }
        )
    return rows


def sticking(skin, W, reach=None, depth=1e-4):
    """Least force while the sphere comes and while it leaves in steps of 2.5 um, at three places [N]; JKR's;
    iterations, failed steps."""
    from biotac_mj.geometry import load_skin
    from biotac_mj.skin import ContactLaw, GeomSet, SkinData, SkinModel, SkinOptions, step

    geometry, law = load_skin(skin), ContactLaw(adhesion=W, adhesion_hysteresis=3.0, adhesion_range=reach)
    model = SkinModel(geometry, "default", SkinOptions(liquid=True, contact_law=law, tolerance=1e-4))
    pulls, iterations, failed, steps, began = [], 0, 0, 0, time.process_time()
    path = np.concatenate([np.arange(-1e-4, depth, 2.5e-6), np.arange(depth, -2e-4, -2.5e-6)])
    for x in PLACES:
        data, geoms, y, force = (
            SkinData(model),
            GeomSet(["sphere"], [(RADIUS,)], [0.78]),
            first_touch(geometry, x),
            [],
        )
        for d in path:
            geoms.set_pose([[x, y + d, 0]])
            step(model, data, geoms)
            force.append(data.wrench[0, 0, 1])
            iterations, failed, steps = (
                iterations + int(data.iterations[0]),
                failed + int(not data.converged[0]),
                steps + 1,
            )
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
        "iterations": iterations / steps,
        "failed": failed,
        "steps": steps,
        "seconds": time.process_time() - began,
    }


def trajectory(knots, depths, along, rows):
    """A Trajectory of the 7 mm sphere: times [s], depths [m] below first touch and places x [m] of its
    corners; rows of each part."""
    from biotac_mj.discrepancy.trajectories.trajectory import Trajectory
    from biotac_mj.geometry import load_skin

    t = np.concatenate(
        [[knots[0]], *[np.linspace(a, b, n + 1)[1:] for a, b, n in zip(knots[:-1], knots[1:], rows)]]
    )
    tip = first_touch(load_skin("coarse"), along[0]) + RADIUS
    pos = np.column_stack([np.interp(t, knots, along), tip + np.interp(t, knots, depths), np.zeros(len(t))])
    return Trajectory(
        "a", "sphere_7mm", 0.0, t, pos, np.tile(np.eye(3), (len(t), 1, 1)), np.full((len(t), 19), 2500.0)
    )


def both(sim, path, effect, theta, none):
    """Runs without the effect, with it inside the contact, and in its reduced form."""
    from biotac_mj.discrepancy.trajectories.model.fields import Fields
    from biotac_mj.effects.catalogue import by_id

    plain, inside = (sim.run([path], effects=[(by_id(effect), th)])[0] for th in (none, theta))
    base = [{"force": plain.force, "pressure": plain.pressure, "log_z": plain.log_z}]
    still = [{k: np.zeros_like(v) for k, v in base[0].items()}]
    reduced = sim.run(
        [path], Fields(base, dict.fromkeys("xyz", still), [path]), False, [(by_id(effect), theta)]
    )[0]
    return plain, inside, reduced


def adhesion(sim, rows):
    """Press of 1 mm: changes of the signed normal force [N], deep (above 0.1 mm) and at the edge of contact,
    and of counts."""
    knots, depths = np.arange(5.0), np.array([-0.1e-3, 0.1e-3, 1e-3, 0.1e-3, -0.15e-3])
    path = trajectory(knots, depths, np.full(5, PLACES[0]), (40, rows, rows, 50))
    deep, out = slice(41, 40 + 2 * rows), []
    for W in ADHESION:
        plain, inside, reduced = both(sim, path, "adhesion", {"W": W}, {"W": 1e-12})
        force = [-r.force @ path.heading for r in (plain, inside, reduced)]
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
                "reduced_counts": float(np.abs(reduced.counts - plain.counts).max()),
            }
        )
    return out


def friction(sim, rows):
    """Slides of 3 mm at three depths, back and forth: slope and level of the ratio of drag to load over
    Coulomb's; what is missed."""
    knots, along = np.arange(8.0), np.array([-1, -1, 1, 1, -1, -1, 1, 1]) * 1.5e-3 - 11e-3
    depths = np.array([-0.1, 0.2, 0.2, 0.6, 0.6, 1.4, 1.4, -0.1]) * 1e-3
    path = trajectory(knots, depths, along, (rows,) * 7)
    sliding = np.concatenate([np.arange(k * rows + rows // 2, (k + 1) * rows + 1) for k in (1, 3, 5)])
    out = []
    for exponent in EXPONENTS:
        plain, inside, reduced = both(sim, path, "fric_load", {"exponent": exponent}, {"exponent": 1e-12})
        load, row = inside.normal_force[sliding], {"exponent": exponent}
        drag = [
            np.linalg.norm(np.delete(r.force[sliding], 1, axis=1), axis=1) for r in (plain, inside, reduced)
        ]
        ratio = (drag[1] / load) / (drag[0] / plain.normal_force[sliding])
        slope, level = np.polyfit(np.log(load), np.log(ratio), 1)
        row |= {
            "slope": slope,
            "level": float(np.exp(level)),
            "scatter": float(np.std(np.log(ratio) - slope * np.log(load) - level)),
        }
        touching = plain.normal_force > 1e-3
        for name, value in (
            ("drag", lambda r: r.force[:, 0]),
            ("normal", lambda r: r.normal_force),
            ("counts", lambda r: r.counts),
        ):
            a, b, c = (value(r)[touching] for r in (plain, inside, reduced))
            row |= {
                f"{name}_changes": float(np.abs(b - a).max()),
                f"{name}_missed": float(np.sqrt(((c - b) ** 2).mean())),
                f"{name}_missed_most": float(np.abs(c - b).max()),
            }
        out.append(row)
    return out


def film(sim, rows):
    """Press of 1 mm, held: largest changes inside the film, in the reduced form, and its error RMS
    (electrodes); at rest and while held."""
    import dataclasses

    path = trajectory(
        np.arange(4.0), np.array([-0.1e-3, 1e-3, 1e-3, -0.1e-3]), np.full(4, PLACES[0]), (rows, 4, rows)
    )
    out = []
    for effect, theta, clock in (
        ("asper", {"log_p": 0.3}, 0.0), ("asper", {"log_p": -0.3}, 0.0),
        ("fluidloss", {"rate": 0.2}, 900.0), ("fluidloss", {"rate": 0.2}, 3600.0),
    ):  # fmt: skip
        none = dict.fromkeys(theta, 1e-12)
        plain, inside, reduced = both(sim, dataclasses.replace(path, clock=clock), effect, theta, none)
        row = {"effect": effect, **dict(zip(("parameter", "clock"), (*theta.values(), clock)))}
        for when, k in (("rest", 0), ("held", rows + 2)):
            a, b, c = (r.counts[k] for r in (plain, inside, reduced))
            row |= {
                f"{when}_counts": float(np.abs(b - a).max()),
                f"{when}_reduced": float(np.abs(c - a).max()),
                f"{when}_missed": float(np.sqrt(((c - b) ** 2).mean())),
            }
        k = rows + 2
        row |= {
            "N_plain": float(plain.normal_force[k]),
            "N_inside": float(inside.normal_force[k]),
            "Pa_plain": float(plain.pressure[k]),
            "Pa_inside": float(inside.pressure[k]),
            "Pa_rest": float(inside.pressure[0]),
        }
        out.append(row)
    return out


def table(rows):
    """Prints dicts as a table."""

    def cell(v):
        if isinstance(v, str):
            return v
        return " ".join(f"{x:.3g}" for x in v) if isinstance(v, list) else f"{v:.3g}"

    columns = list(rows[0])
    width = [max(len(c), *(len(cell(r[c])) for r in rows)) + 2 for c in columns]
    print("".join(f"{c:>{w}}" for c, w in zip(columns, width)))
    for r in rows:
        print("".join(f"{cell(r[c]):>{w}}" for c, w in zip(columns, width)))
    print(flush=True)


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument(
        "--skins",
        default="coarse,default",
        help="of the pressure's map and of the sticking; comparisons are on the coarse one",
    )
    args.add_argument("--rows", type=int, default=12, help="rows of each part of press and slide")
    args.add_argument("--only", help="first letters of one table")
    args.add_argument("--json")
    args = args.parse_args(argv)
    from biotac_mj.discrepancy.trajectories.model.in_skin import InSkinSimulator

    skins, sim, out = args.skins.split(","), InSkinSimulator(), {}
    for name, make in (
        (
            "pressure of nodes [Pa] = at_1_N load^power",
            lambda: [row for skin in skins for row in pressure_map(skin)],
        ),
        (
            "sticking [N]",
            lambda: [
                sticking(skin, W, reach)
                for skin in skins
                for W, reach in ((0.05, None), (0.05, 4e-5), (0.2, None))
            ],
        ),
        ("adhesion, press of 1 mm [N]", lambda: adhesion(sim, args.rows)),
        ("fric_load, slides [N]", lambda: friction(sim, args.rows)),
        ("film: rough walls, liquid lost", lambda: film(sim, args.rows)),
    ):
        if args.only and not name.startswith(args.only):
            continue
        began = time.process_time()
        out[name] = make()
        print(f"{name}: {time.process_time() - began:.0f} s of processor time")
        table(out[name])
    if args.json:
        path = pathlib.Path(args.json)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(out, indent=1))


if __name__ == "__main__":
    main()
