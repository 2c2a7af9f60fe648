"""What the parameters of stiffen and hyster are as constants of the rubber, measured on presses; the tables
of `effects/in_skin.py`.

    python benchmarks/discrepancy_in_skin_maps.py --json out/in_skin_maps.json

- stiffen: the skin is pressed with the coefficient s = c2 / c1 in its elements; printed is the c2 of the
  reduced form that gives the same force (least squares up to 1.2 mm), and at how much of the force it misses;
  then for other tools, places and beyond touching the core.
- hyster: twice in to 1.2 mm and out with a friction branch of every strain; for each width of the reduced
  form the strain and the branch's modulus over its fraction that come nearest, and how much of the effect
  stays (RMS).
- inhomog: presses at several places with a modulus that varies along and across, against the factor of the
  reduced form.
- lost: steps that found no balance in presses of 2 mm, through the contact with the core, and out, and their
  processor time.
"""

import argparse
import json
import pathlib
import time

import numpy as np

S = (-400, -120, -40, -12, -4, -1, 1, 4, 12, 40, 120, 400, 1000)
STRAINS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)
WIDTHS = (0.05e-3, 0.1e-3, 0.2e-3, 0.3e-3, 0.4e-3, 0.6e-3)
PLACE = (-12e-3, 0.0)


def press(depths, skin="coarse", tool="sphere_7mm", place=PLACE, modulus=None, **constants):
    """Force along the press [N] and pressure [Pa] at each depth [m] below where the tool meets the surface,
    NaN where a step was lost, and the processor time of each step [s]."""
    from biotac_mj.data.generation.simulate import Scene
    from biotac_mj.geometry import load_skin
    from biotac_mj.skin import Material, SkinData, SkinModel, SkinOptions, step

    model = SkinModel(
        load_skin(skin), Material(**constants), SkinOptions(liquid=True, tolerance=3e-4), modulus=modulus
    )
    data, scene = SkinData(model), Scene([tool], "cpu", model.material.friction)
    model.factor  # noqa: B018 - made here, the steps' time is without it
    vert = model.geometry.vert
    near = vert[(abs(vert[:, 0] - place[0]) < 2e-3) & (abs(vert[:, 2] - place[1]) < 2e-3)]
    out = []
    for depth in depths:
        scene.place(np.array([[place[0], near[:, 1].min() + depth, place[1]]]), np.eye(3)[None])
        began = time.process_time()
        step(model, data, scene.geoms)
        good = 1.0 if data.converged[0] else np.nan
        out.append((good * abs(data.wrench[0, 0, 1]), good * data.pressure[0], time.process_time() - began))
    return np.array(out).T


def same_force(depths, plain, force):
    """c2 of the reduced form that comes nearest to a force, and its RMS miss as a share of the change."""
    weight = plain * (depths / 1.5e-3) ** 2
    c2 = weight @ (force - plain) / (weight @ weight)
    return c2, np.linalg.norm(plain + c2 * weight - force) / np.linalg.norm(force - plain)


def stiffening():
    depths = np.linspace(-0.1e-3, 1.2e-3, 14)
    plain = press(depths)[0]
    rows = []
    print("stiffen: s, c2 of the same force to 1.2 mm, missed")
    for s in S:
        c2, miss = same_force(depths, plain, press(depths, stiffening=float(s))[0])
        rows.append({"s": s, "c2": c2, "missed": miss})
        print(f"{s:>6} {c2:>9.4f} {miss:>6.0%}", flush=True)
    print("the same s = 12 elsewhere")
    others = (
        ("cube_14mm", PLACE, 1.2e-3, "coarse"),
        ("sphere_3-5mm", PLACE, 1.0e-3, "coarse"),
        ("sphere_7mm", (-7e-3, 0.0), 1.2e-3, "coarse"),
        ("sphere_7mm", (-12e-3, 4e-3), 1.2e-3, "coarse"),
        ("sphere_7mm", PLACE, 2.0e-3, "coarse"),
        ("sphere_7mm", PLACE, 1.2e-3, "default"),
    )
    for tool, place, deepest, skin in others:
        depths = np.arange(-0.1e-3, deepest + 1e-6, 0.1e-3)
        plain, force = (press(depths, skin, tool, place, stiffening=s)[0] for s in (0.0, 12.0))
        good = np.isfinite(plain + force)
        c2, miss = same_force(depths[good], plain[good], force[good])
        rows.append(
            {
                "s": 12,
                "tool": tool,
                "place": place,
                "deepest": deepest,
                "skin": skin,
                "c2": c2,
                "missed": miss,
            }
        )
        print(
            f"{tool:<12}{1e3 * place[0]:>5.0f}{1e3 * place[1]:>4.0f} mm, {1e3 * deepest:.1f} mm deep, "
            f"{skin:<8}{c2:>9.4f} {miss:>6.0%}",
            flush=True,
        )
    return rows


def hysteresis():
    down = np.linspace(0, 1.2e-3, 13)
    depths = np.concatenate([down, down[-2:0:-1], down[2:], down[-2:0:-1]])
    plain, g = press(depths)[0], 0.3
    response = np.array([(press(depths, hysteresis=((g, e),))[0] - plain) / g for e in STRAINS])
    strains = np.geomspace(STRAINS[0], STRAINS[-1], 400)
    fine = np.array(
        [np.interp(np.log(strains), np.log(STRAINS), response[:, k]) for k in range(len(depths))]
    ).T
    rows = []
    print("hyster: width mm, strain, g / fraction, missed")
    for width in WIDTHS:
        z = np.zeros(len(depths))
        for i in range(1, len(z)):
            z[i] = np.clip(z[i - 1] + depths[i] - depths[i - 1], -width, width)
        wanted = plain * z / width
        ratio = fine @ wanted / (fine * fine).sum(1)
        miss = np.linalg.norm(ratio[:, None] * fine - wanted, axis=1) / np.linalg.norm(wanted)
        k = miss.argmin()
        rows.append({"width": width, "strain": strains[k], "ratio": ratio[k], "missed": miss[k]})
        print(f"{1e3 * width:>6.2f} {strains[k]:>9.5f} {ratio[k]:>8.2f} {miss[k]:>6.0%}", flush=True)
    return rows


def places():
    from biotac_mj.effects.rubber import modulus_of

    depths, rows = np.array([-0.1e-3, 0.2e-3, 0.4e-3, 0.6e-3, 0.8e-3]), []
    print("inhomog: along, across [1/cm], place mm, force changes by, reduced form")
    for place in ((-6e-3, 0.0), (-10e-3, 0.0), (-14e-3, 0.0), (-10e-3, 4e-3), (-10e-3, -4e-3)):
        plain = press(depths, place=place)[0][-1]
        for along, across in ((0.3, 0.0), (0.0, 0.3)):
            theta = {"along": along, "across": across}
            change = press(depths, place=place, modulus=modulus_of(theta))[0][-1] / plain - 1
            wanted = float(modulus_of(theta)(np.array([[place[0], 0.0, place[1]]]))[0] - 1)
            rows.append({**theta, "place": place, "change": change, "reduced": wanted})
            print(
                f"{along:>5} {across:>5} {1e3 * place[0]:>5.0f}{1e3 * place[1]:>4.0f} {change:>8.3f} "
                f"{wanted:>8.3f}",
                flush=True,
            )
    return rows


def lost():
    depths, rows = np.concatenate([np.linspace(0, 2e-3, 21), np.linspace(1.8e-3, 0, 10)]), []
    laws = {
        "corotational": {},
        "svk": {"law": "svk"},
        "corotational, four nodes": {"element": "linear"},
        "neo_hookean": {
            "law": "neo_hookean",
            "youngs_modulus": 2.8e5,
            "poissons_ratio": 0.45,
            "friction": 0.186,
        },
    }
    options = [
        {},
        {"stiffening": 1.0},
        {"stiffening": 12.0},
        {"stiffening": 120.0},
        {"stiffening": -12.0},
        {"hysteresis": ((0.5, 0.003),)},
        {"hysteresis": ((4.0, 0.001),)},
        {"modulus": lambda at: np.maximum(1 + 100 * (at[:, 0] + 8e-3), 0.1)},
        {"hysteresis": ((0.5, 0.003),), "stiffening": 12.0},
    ]
    print("lost: steps of", len(depths), "and processor time")
    for law, base in laws.items():
        for extra in options:
            force, _, seconds = press(depths, **base, **extra)
            named = {k: "along" if k == "modulus" else v for k, v in extra.items()}
            rows.append({"law": law, **named, "lost": int(np.isnan(force).sum()), "seconds": seconds.sum()})
            print(
                f"{law:<26}{str(named):<58}{rows[-1]['lost']:>4} {rows[-1]['seconds']:>5.1f} s "
                f"{np.nanmax(force):>6.2f} N",
                flush=True,
            )
    return rows


PARTS = {"stiffen": stiffening, "hyster": hysteresis, "inhomog": places, "lost": lost}


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("--only", choices=PARTS)
    args.add_argument("--json")
    args = args.parse_args(argv)
    out = {name: part() for name, part in PARTS.items() if args.only in (None, name)}
    if args.json:
        path = pathlib.Path(args.json)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(out, indent=1))


if __name__ == "__main__":
    main()
