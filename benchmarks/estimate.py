"""Contacts estimated from electrodes, on random presses of foreign synthetic sensors: another mesh, law and
modulus than the simulation that is inverted, liquid in three dimensions, gains and cross-talk of their own.

    python benchmarks/estimate.py --json OUT              # presses of sensors 401 to 420, and the table

Goes on where it was stopped. The inversion knows nothing of a sensor; or what its ten other presses told,
without labels or with. `constants known` is an oracle: the same estimate for who knows this sensor's
constants. Beside it stand the network of `biotac contact-patch`, as it comes, and regressions on the same ten
labelled presses."""

import argparse
import json
import pathlib
import time

import numpy as np

from biotac_mj.data.generation.plan import plan_motions
from biotac_mj.data.generation.synthetic_sensor import SensorVariation, SyntheticSensor, Waves
from biotac_mj.data.schema import nodes_of
from biotac_mj.differentiable import Belief, Estimator, Touch, change_of, pressure_change
from biotac_mj.differentiable.estimation import estimate
from biotac_mj.differentiable.estimation.belief import believe, constants_at
from biotac_mj.geometry import load_skin
from biotac_mj.learning.patch import estimate as estimate_by_network
from biotac_mj.learning.training.inverse import contact_centre
from biotac_mj.sensor.core_surface import CoreSurface

INDENTER = "sphere_7mm"
LEAST = 0.1  # [N] of a press that counts: less is a touch
CONFIDENCE = 0.95


def press(sensor: SyntheticSensor, number: int) -> dict:
    """A random press: counts of it and of the rest before (20,), force [N] and centre (3,) [m]."""
    geometry = sensor.model.geometry
    motion = plan_motions(geometry, INDENTER, [[sensor.seed, number]], 8, ("press",))[0]
    fields = sensor.simulate(INDENTER, [motion])
    force = np.linalg.norm(fields.wrench[0, :, :3], axis=1)
    at = np.array([0, int((force * fields.converged[0]).argmax())])
    x, moment = fields.vert_xpos(geometry.vert, 0)[at], np.array([0.0, 1.0])
    counts, _ = sensor.meter().measure(x, moment, fields.pressure[0, at], 3600.0, number)
    felt = np.linalg.norm(fields.contact_force[0, at[1]], axis=1)
    centre = contact_centre(felt[None], geometry.vert[nodes_of(geometry)])[0]
    return {
        "sensor": sensor.seed, "number": number, "rest": counts[0, :20].tolist(),
        "counts": counts[1, :20].tolist(), "force_N": float(force[at[1]]), "centre": centre.tolist(),
    }  # fmt: skip


def simulate(presses: list, sensors: range, number: int, save) -> None:
    """Appends what is missing: so many presses of each sensor."""
    there = {(row["sensor"], row["number"]) for row in presses}
    for seed in sensors:
        missing = [n for n in range(number) if (seed, n) not in there]
        sensor = SyntheticSensor(seed, "default") if missing else None
        for n in missing:
            presses.append(press(sensor, n))
            save()


def touch_of(row: dict) -> Touch:
    """A press as one that is known."""
    counts, rest = np.array(row["counts"]), np.array(row["rest"])
    change = change_of(counts[:19], rest[:19])
    return Touch(change, pressure_change(counts[19], rest[19]), row["force_N"], np.array(row["centre"]))


def regress(known: list[Touch], asked: list[Touch], width: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Centres and forces by ridge regression on ln Z and pressure; width: of a Gaussian kernel, None is
    linear. The penalty is the one that serves best when each touch in turn is left out."""

    def seen(touches):
        return np.array([np.append(touch.change, 0.2 * touch.pressure) for touch in touches])

    def kernel(a, b):
        return a @ b.T if width is None else np.exp(-0.5 * ((a[:, None] - b) ** 2).sum(-1) / width**2)

    x, y = seen(known), np.array([[np.log(t.force), *(1e3 * t.centre / 5)] for t in known])
    about, gram, best = y.mean(0), kernel(x, x), None
    for penalty in (1e-3, 1e-2, 1e-1, 1.0):
        inverse = np.linalg.inv(gram + penalty * np.eye(len(x)))
        out = ((inverse @ (y - about) / np.diag(inverse)[:, None]) ** 2).sum()
        if best is None or out < best[0]:
            best = out, about + kernel(seen(asked), x) @ inverse @ (y - about)
    return 5e-3 * best[1][:, 1:], np.exp(best[1][:, 0])


def constants(seed: int, geometry) -> Belief:
    """Of a sensor, as they were drawn; relief and film of each electrode where it lies."""
    v, belief = SensorVariation.draw(seed), believe()
    mean, spread = belief.mean.copy(), np.sqrt(np.diagonal(belief.covariance)).copy()
    foot = CoreSurface(geometry.core_vert, geometry.core_face).closest(
        geometry.electrode_pos + v.electrode_shift
    )[1]
    moved = 1e3 * (foot - geometry.electrode_pos)[:, [0, 2]]
    each = moved - moved.mean(0)
    own = Waves((seed, 1), v.film_spread, v.film_length)(foot)
    gain = np.diag(v.mixing)  # with what is shared, a thirtieth
    known = {
        "gain": gain - 1,
        "shift": moved.mean(0),
        "each": each.T.ravel(),
        "floor": np.log(v.film / 45e-6),
        "floor_each": own,
        "relief": 1e4 * Waves((seed, 2), v.texture, v.texture_length)(foot),
        "share": (v.mixing / gain[:, None] - np.eye(19)).sum(1).mean(),
        "fill": 115.6 * (v.rest_pressure / (0.0097 * v.youngs_modulus) - 1),
        "ratio": v.poissons_ratio - 0.385,
        "modulus": np.log(v.youngs_modulus / 0.86e6),
        "uneven": [v.uneven["along"], v.uneven["across"]],
    }
    for name, value in known.items():
        at = constants_at[name]
        mean[at], spread[at] = value, 0.05 * spread[at]
    return Belief(mean, np.diag(spread**2))


def evaluate(presses: list, estimator: Estimator) -> dict:
    """Errors of all ways."""
    skin = load_skin("default")
    nodes = skin.vert[np.unique(skin.outer_face)]
    off, ratio, within, wide, half = {}, {}, {}, {}, {}
    begin, forces = time.process_time(), []

    def note(way, centre, force, touches):
        off.setdefault(way, []).extend(np.linalg.norm(np.array(centre) - [t.centre for t in touches], axis=1))
        ratio.setdefault(way, []).extend(force / np.array([t.force for t in touches]))

    def tell(way, found, touches):
        for one, touch in zip(found, touches):
            errors = np.append(np.log(touch.force / one.size), touch.centre - one.centre)
            widths = np.append(np.log(one.high / one.size), one.centre_error)
            half.setdefault(way, []).append(widths)
            within.setdefault(way, []).append(np.abs(errors) < widths)
            wide.setdefault(way, []).append(np.abs(errors) / widths * np.repeat(estimate.WIDE, (1, 3)))
        note(way, [one.centre for one in found], [one.size for one in found], touches)

    for seed in sorted({row["sensor"] for row in presses}):
        rows = [row for row in presses if row["sensor"] == seed and row["force_N"] > LEAST]
        touches = [touch_of(row) for row in rows]
        bare = [touch.unlabelled for touch in touches]
        dry = [Touch(touch.change) for touch in touches]
        forces += [touch.force for touch in touches]
        tell("nothing known", [estimator.of(touch) for touch in bare], touches)
        tell("nothing known, without PDC", [estimator.of(touch) for touch in dry], touches)
        drawn = constants(seed, skin)
        tell("constants known", [estimator.of(touch, drawn) for touch in bare], touches)
        tell("its other presses", estimator.together(bare), touches)
        tell("its other presses, without PDC", estimator.together(dry), touches)
        session = estimator.learn(touches)
        labelled = [session.without(i) for i in range(len(touches))]
        tell("its other presses, labelled", [estimator.of(t, one) for t, one in zip(bare, labelled)], touches)
        for way, width in (("linear regression", None), ("kernel regression", 0.5)):
            for i, touch in enumerate(touches):
                note(way, *regress(touches[:i] + touches[i + 1 :], [touch], width), [touch])
        patches = [
            estimate_by_network(np.array(r["counts"])[None, :19], np.array(r["rest"])[:19], skin)[1]
            for r in rows
        ]
        note(
            "network",
            [contact_centre(felt, nodes)[0] for felt in patches],
            [f.sum() for f in patches],
            touches,
        )
        print(f"sensor {seed}: {len(rows)} presses", flush=True)
    out = {"presses": len(forces), "median_force_N": float(np.median(forces)), "ways": {}}
    for way in off:
        one = out["ways"][way] = {
            "presses": len(off[way]),
            "centre_mm": [1e3 * float(np.nanpercentile(off[way], q)) for q in (25, 50, 75)],
            "force_percent": [
                100 * float(np.percentile(np.abs(np.array(ratio[way]) - 1), q)) for q in (25, 50, 75)
            ],
        }
        if way in within:
            one["within"] = np.mean(within[way], 0).tolist()  # force, centre along x, y, z
            widths = np.median(half[way], 0)
            one["median_interval"] = {
                "force_factor": np.exp(widths[0]),
                "centre_mm": (1e3 * widths[1:]).tolist(),
            }
            far = np.array(wide[way])
            one["widths_that_hold"] = [
                float(np.quantile(part, CONFIDENCE)) for part in (far[:, 0], far[:, 1:])
            ]
    return out | {"seconds": time.process_time() - begin}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=pathlib.Path, required=True)
    parser.add_argument("--presses", type=int, default=11, help="of each sensor")
    parser.add_argument("--first", type=int, default=401, help="sensor")
    parser.add_argument("--sensors", type=int, default=20)
    given = parser.parse_args()
    kept = json.loads(given.json.read_text()) if given.json.exists() else {"presses": []}

    def save():
        given.json.write_text(json.dumps(kept, indent=1))

    sensors = range(given.first, given.first + given.sensors)
    simulate(kept["presses"], sensors, given.presses, save)
    estimator = Estimator(load_skin("coarse"), INDENTER)
    presses = [row for row in kept["presses"] if row["sensor"] in sensors]
    kept["summary"] = evaluate(presses, estimator)
    save()
    print(json.dumps(kept["summary"], indent=1))


if __name__ == "__main__":
    main()
