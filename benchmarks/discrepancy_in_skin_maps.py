"""What the parameters of stiffen, hyster, inhomog and fric_load are as constants of the skin, measured on
presses; the tables of `effects/in_skin.py`.

    python benchmarks/discrepancy_in_skin_maps.py --json out/in_skin_maps.json

- stiffen: the skin is pressed with the coefficient s = c2 / c1 in its elements; printed is the c2 of the
  reduced form that gives the same force (least squares up to 1.2 mm), and at how much of the force it misses;
  then for other tools, places and beyond touching the core.
- hyster: twice in to 1.2 mm and out with a friction branch of every strain; for each width of the reduced
  form the strain and the branch's modulus over its fraction that come nearest, and how much of the effect
  stays (RMS).
- inhomog: presses at several places with a modulus that varies along and across, against the factor of the
  reduced form.
- fric_load: exponent and pressure at 1 N of the nodes' pressure under a sphere of 7 mm, as friction of
  exponent n weighs it, by which an exponent over the load becomes one over the pressure.
"""

import argparse
import pathlib

import numpy as np
from discrepancy_in_skin import PLACES, RADIUS, first_touch, surface, table
from records import write_json

S = (-400, -120, -40, -12, -4, -1, 1, 4, 12, 40, 120, 400, 1000)
STRAINS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)
WIDTHS = (0.05e-3, 0.1e-3, 0.2e-3, 0.3e-3, 0.4e-3, 0.6e-3)
PLACE = (-12e-3, 0.0)


def press(depths, skin="coarse", tool="sphere_7mm", place=PLACE, modulus=None, **constants):
    """Force along the press [N] at each depth [m] below where the tool meets the surface, NaN where a step
    was lost."""
    from biotac_mj.data.generation.simulate import Scene
    from biotac_mj.geometry import load_skin
    from biotac_mj.skin import Material, SkinData, SkinModel, SkinOptions, step

    model = SkinModel(
        load_skin(skin), Material(**constants), SkinOptions(liquid=True, tolerance=3e-4), modulus=modulus
    )
    data, scene = SkinData(model), Scene([tool], "cpu", model.material.friction)
    begin, force = surface(model.geometry.vert, *place), []
    for depth in depths:
        scene.place(np.array([[place[0], begin + depth, place[1]]]), np.eye(3)[None])
        step(model, data, scene.geoms)
        force.append(abs(data.wrench[0, 0, 1]) if data.converged[0] else np.nan)
    return np.array(force)


def same_force(depths, plain, force):
    """c2 of the reduced form that comes nearest to a force, and its RMS miss as a share of the change."""
    good = np.isfinite(plain + force)
    depths, plain, force = depths[good], plain[good], force[good]
    weight = plain * (depths / 1.5e-3) ** 2
    c2 = weight @ (force - plain) / (weight @ weight)
    missed = np.linalg.norm(plain + c2 * weight - force) / np.linalg.norm(force - plain)
    return {"c2": float(c2), "missed": float(missed)}


def stiffening():
    usual = ("sphere_7mm", PLACE, 1.2e-3, "coarse")
    others = (
        ("cube_14mm", PLACE, 1.2e-3, "coarse"),
        ("sphere_3-5mm", PLACE, 1.0e-3, "coarse"),
        ("sphere_7mm", (-7e-3, 0.0), 1.2e-3, "coarse"),
        ("sphere_7mm", (-12e-3, 4e-3), 1.2e-3, "coarse"),
        ("sphere_7mm", PLACE, 2.0e-3, "coarse"),
        ("sphere_7mm", PLACE, 1.2e-3, "default"),
    )
    rows, plain = [], {}
    for s, case in [*((s, usual) for s in S), *((12, case) for case in others)]:
        tool, place, deepest, skin = case
        depths = np.arange(-0.1e-3, deepest + 1e-6, 0.1e-3)
        if case not in plain:
            plain[case] = press(depths, skin, tool, place)
        row = {"s": s, "tool": tool, "place": place, "deepest": deepest, "skin": skin}
        force = press(depths, skin, tool, place, stiffening=float(s))
        rows.append(row | same_force(depths, plain[case], force))
    return rows


def hysteresis():
    down = np.linspace(0, 1.2e-3, 13)
    depths = np.concatenate([down, down[-2:0:-1], down[2:], down[-2:0:-1]])
    plain, g = press(depths), 0.3
    response = np.array([(press(depths, hysteresis=((g, e),)) - plain) / g for e in STRAINS])
    strains = np.geomspace(STRAINS[0], STRAINS[-1], 400)
    fine = np.array(
        [np.interp(np.log(strains), np.log(STRAINS), response[:, k]) for k in range(len(depths))]
    ).T
    rows = []
    for width in WIDTHS:
        z = np.zeros(len(depths))
        for i in range(1, len(z)):
            z[i] = np.clip(z[i - 1] + depths[i] - depths[i - 1], -width, width)
        wanted = plain * z / width
        ratio = fine @ wanted / (fine * fine).sum(1)
        miss = np.linalg.norm(ratio[:, None] * fine - wanted, axis=1) / np.linalg.norm(wanted)
        k = miss.argmin()
        row = {"width": width, "strain": strains[k], "g_over_fraction": ratio[k], "missed": miss[k]}
        rows.append({name: float(v) for name, v in row.items()})
    return rows


def places():
    from biotac_mj.effects.rubber import modulus_of

    depths, rows = np.array([-0.1e-3, 0.2e-3, 0.4e-3, 0.6e-3, 0.8e-3]), []
    for place in ((-6e-3, 0.0), (-10e-3, 0.0), (-14e-3, 0.0), (-10e-3, 4e-3), (-10e-3, -4e-3)):
        plain = press(depths, place=place)[-1]
        for along, across in ((0.3, 0.0), (0.0, 0.3)):
            theta = {"along": along, "across": across}
            change = press(depths, place=place, modulus=modulus_of(theta))[-1] / plain - 1
            wanted = modulus_of(theta)(np.array([[place[0], 0.0, place[1]]]))[0] - 1
            rows.append({**theta, "place": place, "change": float(change), "reduced": float(wanted)})
    return rows


def pressures():
    return [row for skin in ("coarse", "default") for row in pressures_of(skin)]


def pressures_of(skin):
    """Of presses at three places, for friction of exponent 0.3 and 0.6; with the scatter of the powers."""
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
            touched = (data.outer.trial_geom.numpy()[:, 0] >= 0).reshape(len(face), -1)
            push = np.linalg.norm(force, axis=2) * touched
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
        scatter = float(np.std(np.log(out) - slope * np.log(load) - level))
        at_1_N = float(np.exp(level) ** (-1 / n))
        rows.append({"skin": skin, "n": n, "power": -slope / n, "at_1_N": at_1_N, "scatter": scatter})
    return rows


PARTS = {"stiffen": stiffening, "hyster": hysteresis, "inhomog": places, "fric_load": pressures}


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("--only", choices=PARTS)
    args.add_argument("--json", type=pathlib.Path)
    args = args.parse_args(argv)
    out = {}
    for name, part in PARTS.items():
        if args.only in (None, name):
            out[name] = part()
            print(name)
            table(out[name])
    if args.json:
        write_json(args.json, out)


if __name__ == "__main__":
    main()
