"""Contacts estimated from electrodes, on random presses of foreign synthetic sensors: another mesh, law and
modulus than the simulation that is inverted, liquid in three dimensions, gains and cross-talk of their own.

    python benchmarks/estimate.py --json OUT              # presses of sensors 1 to 20, and the table
    python benchmarks/estimate.py --json OUT --first 101 --sensors 4 --fit   # the spread of sensors, again
    python benchmarks/estimate.py --json OUT --first 6 --sensors 4 --binds   # search, or what can be known

Goes on where it was stopped. The inversion knows nothing of a sensor, or ten labelled touches of it. Beside
it stand the network of `biotac learn predict inverse`, as it comes, and regressions on the same ten
touches."""

import argparse
import json
import pathlib
import time

import numpy as np
from records import read_json, write_json

from biotac_mj.data.generation.plan import plan_motions
from biotac_mj.data.generation.synthetic_sensor import SensorVariation, SyntheticSensor
from biotac_mj.data.schema import nodes_of
from biotac_mj.differentiable import Estimator, Touch, change_of, pressure_change
from biotac_mj.differentiable.estimation import belief, estimate
from biotac_mj.differentiable.estimation import presses as tables
from biotac_mj.geometry import load_skin
from biotac_mj.learning.patch import estimate as estimate_by_network
from biotac_mj.learning.training.inverse import contact_centre

INDENTER = "sphere_7mm"
LEAST = 0.1  # [N] of a press that counts: less is a touch
LABELLED, TOUCHES = 1000, 10  # the first labelled press's number, and how many there are
CONFIDENCE = 0.95
ALIKE = 0.92e6  # [Pa] at which the sensors' skin is as stiff as the inverted one's, in the mean of 50 presses
HERE = 1.2e-3, 0.35  # [m], of ln of the force: presses nearer to one that they are
# the constants of `belief` that --fit seeks, by their ln
SPREADS = (
    "_GAIN", "_NEAR", "_SHARE", "_SHIFT", "_EACH", "_FLOOR", "_FILL", "_PRESSURE", "_MODULUS", "_TILT",
    "_OFF", "_LEVEL", "_ABSOLUTE", "_COMMON", "_KILOPASCAL", "FORCE",
)  # fmt: skip


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
    """Appends what is missing: so many presses of each sensor, and its labelled ones."""
    there = {(row["sensor"], row["number"]) for row in presses}
    for seed in sensors:
        wanted = [*range(number), *range(LABELLED, LABELLED + TOUCHES)]
        missing = [n for n in wanted if (seed, n) not in there]
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


def evaluate(presses: list, estimator: Estimator) -> dict:
    """Errors of all ways."""
    skin = load_skin("default")
    nodes = skin.vert[np.unique(skin.outer_face)]
    off, ratio, within, wide, half = {}, {}, {}, {}, {}
    begin, forces = time.process_time(), []

    def note(way, centre, force, touches):
        off.setdefault(way, []).extend(np.linalg.norm(np.array(centre) - [t.centre for t in touches], axis=1))
        ratio.setdefault(way, []).extend(force / np.array([t.force for t in touches]))

    for seed in sorted({row["sensor"] for row in presses}):
        rows = [row for row in presses if row["sensor"] == seed and row["force_N"] > LEAST]
        asked, known = ([r for r in rows if (r["number"] >= LABELLED) == w] for w in (False, True))
        touches, labelled = [touch_of(row) for row in asked], [touch_of(row) for row in known]
        forces += [touch.force for touch in touches]
        for way, of in (("nothing known", None), ("ten touches known", estimator.learn(labelled))):
            found = []
            for row, touch in zip(asked, touches):
                counts, rest = np.array(row["counts"]), np.array(row["rest"])
                one = estimator(counts[:19], rest[:19], (counts[19], rest[19]), of)
                found.append(one)
                errors = np.append(np.log(touch.force / one.size), touch.centre - one.centre)
                widths = np.append(np.log(one.high / one.size), one.centre_error)
                half.setdefault(way, []).append(widths)
                within.setdefault(way, []).append(np.abs(errors) < widths)
                wide.setdefault(way, []).append(np.abs(errors) / widths * np.repeat(estimate.WIDE, (1, 3)))
            note(way, [one.centre for one in found], [one.size for one in found], touches)
        for way, width in (("linear regression", None), ("kernel regression", 0.5)):
            note(way, *regress(labelled, touches, width), touches)
        patches = [
            estimate_by_network(np.array(r["counts"])[None, :19], np.array(r["rest"])[:19], skin)[1]
            for r in asked
        ]
        note(
            "network",
            [contact_centre(felt, nodes)[0] for felt in patches],
            [f.sum() for f in patches],
            touches,
        )
    out = {"presses": len(forces), "median_force_N": float(np.median(forces)), "ways": {}}
    for way in off:
        one = out["ways"][way] = {
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


def fit(presses: list, estimator: Estimator) -> dict:
    """The spreads under which the presses, where they were and with the force they had, are likeliest."""
    table, touches = estimator.presses, [touch_of(row) for row in presses if row["force_N"] > LEAST]
    off = [np.linalg.norm(table.outcome[:, 1:4] - touch.centre, axis=1) for touch in touches]
    among = np.unique(np.concatenate([np.flatnonzero(d < belief.AWAY) for d in off]))

    def cost():
        posterior, total = belief.Posterior(table, estimator.geometry, belief.believe(19), True, among), 0.0
        for touch, d in zip(touches, off):
            near = d[among] < belief.AWAY
            if near.any():
                likely = belief.likelihood(posterior, touch, belief.believe(19))[0][near]
                total -= likely.max() + np.log(np.exp(likely - likely.max()).mean())
        return total / len(touches)

    best, step = cost(), 0.4
    while step > 0.1:
        before = best
        for name in SPREADS:
            here = getattr(belief, name)
            for factor in (np.exp(step), np.exp(-step)):
                setattr(belief, name, here * factor)
                there = cost()
                if there < best - 1e-4:
                    best = there
                    break
                setattr(belief, name, here)
        if before - best < 1e-2:
            step /= 2
    return {"cost": best} | {name: float(getattr(belief, name)) for name in SPREADS}


def binds(presses: list, estimator: Estimator, draws: int = 10) -> dict:
    """Is another press likelier than the true one, on a table five times finer; and how well those are found
    that are drawn, at the same places, from all that is believed of sensors: no estimate can do better."""
    touches = [(row["sensor"], touch_of(row)) for row in presses if row["number"] < LABELLED]
    touches = [(sensor, touch) for sensor, touch in touches if touch.force > LEAST]
    known, table, geometry = belief.believe(19), estimator.presses, estimator.geometry
    posterior, rng = belief.Posterior(table, geometry, known), np.random.default_rng(0)
    before = tables._FINER
    try:
        tables._FINER = 5
        fine = tables.Presses(estimator.skin, geometry, INDENTER)
    finally:
        tables._FINER = before

    def likeliest(signal, force, centre):
        """Of the finer table, near a press."""
        off = np.linalg.norm(fine.outcome[:, 1:4] - centre, axis=1) / HERE[0]
        near = np.flatnonzero((off < 1.3) & (np.abs(fine.outcome[:, 0] - force) < 1.7 * HERE[1]))
        if not len(near):
            return -np.inf
        likely, outcome = belief.Posterior(fine, geometry, known, True, near)(signal)
        off = np.linalg.norm(outcome[:, 1:4] - centre, axis=1)
        here = (off < HERE[0]) & (np.abs(outcome[:, 0] - known.force - force) < HERE[1])
        return likely[here].max(initial=-np.inf)

    ahead, off, ratio = [], [], []
    for sensor, touch in touches:
        force = np.log(touch.force * ALIKE / SensorVariation.draw(sensor).youngs_modulus)
        likely, outcome = posterior(touch.signal)
        best = outcome[likely.argmax()]
        found = max(likely.max(), likeliest(touch.signal, best[0] - known.force, best[1:4]))
        ahead.append(found - likeliest(touch.signal, force, touch.centre))
        far = np.linalg.norm(table.outcome[:, 1:4] - touch.centre, axis=1) / 0.5e-3
        i = (far**2 + ((table.outcome[:, 0] - force) / 0.15) ** 2).argmin()
        tilts, turned = belief._TILT * table.by_press[i, :2], belief._TILT * table.outcome_by[i, :2]
        for _ in range(draws):
            own, tilt = rng.multivariate_normal(known.mean, known.covariance), rng.normal(size=2)
            left = rng.multivariate_normal(
                np.zeros(20), posterior.noise[i] - tilts.T @ tilts, check_valid="ignore"
            )
            signal = posterior.signal[i] + posterior.design[i] @ own + tilt @ tilts + left
            truth = table.outcome[i] + tilt @ turned + own[-2] * table.outcome_by[i, 2]
            truth[0] += rng.normal(known.force, np.sqrt(known.force_variance))
            likely, outcome = posterior(signal)
            share = np.exp(likely - likely.max())
            mean = share @ outcome / share.sum()
            off.append(1e3 * np.linalg.norm(mean[1:4] - truth[1:4]))
            ratio.append(100 * abs(np.expm1(mean[0] - truth[0])))
    ahead, quarters = np.array(ahead), (25, 50, 75)
    return {
        "presses": len(touches),
        "likelier_than_the_truth_nats": np.percentile(ahead, quarters).tolist(),
        "within_two_nats": float((ahead < 2).mean()),
        "truth_is_likelier": int((ahead < 0).sum()),
        "drawn_centre_mm": np.percentile(off, quarters).tolist(),
        "drawn_force_percent": np.percentile(ratio, quarters).tolist(),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=pathlib.Path, default="out/benchmarks/estimate.json")
    parser.add_argument("--presses", type=int, default=10, help="of each sensor")
    parser.add_argument("--first", type=int, default=1, help="sensor")
    parser.add_argument("--sensors", type=int, default=20)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--binds", action="store_true")
    given = parser.parse_args()
    given.json.parent.mkdir(parents=True, exist_ok=True)
    kept = read_json(given.json, {"presses": []})

    def save():
        write_json(given.json, kept)

    sensors = range(given.first, given.first + given.sensors)
    simulate(kept["presses"], sensors, given.presses, save)
    estimator = Estimator(load_skin("coarse"), INDENTER)
    presses = [row for row in kept["presses"] if row["sensor"] in sensors]
    name = "fit" if given.fit else "binds" if given.binds else "summary"
    kept[name] = {"fit": fit, "binds": binds, "summary": evaluate}[name](presses, estimator)
    save()
    print(json.dumps(kept[name], indent=1))


if __name__ == "__main__":
    main()
