"""Contacts estimated from electrodes, on random presses of foreign synthetic sensors: another mesh, law and
modulus than the simulation that is inverted, liquid in three dimensions, gains and cross-talk of their own.

    python benchmarks/estimate.py --json OUT

Goes on where it was stopped. Beside the inversion of the simulator, which knows none of these sensors, stands
the network of `biotac contact-patch`, as it comes. Forces go with the modulus, which differs: so their errors
are stated as they are, and with one factor for each sensor, from its other presses."""

import argparse
import json
import pathlib
import time

import numpy as np

from biotac_mj.data.plan import plan_motions
from biotac_mj.data.schema import nodes_of
from biotac_mj.data.synthetic_sensor import SyntheticSensor
from biotac_mj.differentiable import Estimator
from biotac_mj.geometry import load_skin
from biotac_mj.learning.patch import estimate as estimate_by_network
from biotac_mj.learning.training.inverse import contact_centre

INDENTER = "sphere_7mm"
LEAST = 0.1  # [N] of a press that counts: less is a touch


def press(sensor: SyntheticSensor, number: int) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """A random press: counts (19,) of it and of the rest before, force [N] and centre (3,) [m]."""
    geometry = sensor.model.geometry
    motion = plan_motions(geometry, INDENTER, [[sensor.seed, number]], 8, ("press",))[0]
    fields = sensor.simulate(INDENTER, [motion])
    force = np.linalg.norm(fields.wrench[0, :, :3], axis=1)
    at = np.array([0, int((force * fields.converged[0]).argmax())])
    x, moment = fields.vert_xpos(geometry.vert, 0)[at], np.array([0.0, 1.0])
    counts, _ = sensor.meter().measure(x, moment, fields.pressure[0, at], 3600.0, number)
    felt = np.linalg.norm(fields.contact_force[0, at[1]], axis=1)
    centre = contact_centre(felt[None], geometry.vert[nodes_of(geometry)])[0]
    return counts[1, :19], counts[0, :19], float(force[at[1]]), centre


def measure(sensor: SyntheticSensor, number: int, estimator: Estimator) -> dict:
    """One press by both."""
    counts, rest, force, centre = press(sensor, number)
    row = {"sensor": sensor.seed, "number": number, "force_N": force}
    if force < LEAST:
        return row
    begin = time.process_time()
    try:
        found = estimator(counts, rest)
    except ValueError as error:
        return row | {"refused": str(error)}
    skin = load_skin("default")
    _, felt = estimate_by_network(counts[None], rest, skin)
    place = contact_centre(felt, skin.vert[np.unique(skin.outer_face)])[0]
    off = np.abs(found.centre - centre)
    return row | {
        "seconds": time.process_time() - begin,
        "centre_mm": 1e3 * float(np.linalg.norm(found.centre - centre)),
        "estimated_N": found.size,
        "within": [bool(w) for w in off < found.centre_error] + [abs(found.size - force) < found.size_error],
        "missed": found.missed, "lost": found.lost, "settled": found.settled,
        "network_centre_mm": 1e3 * float(np.linalg.norm(place - centre)),
        "network_N": float(felt.sum()),
    }  # fmt: skip


def summary(rows: list) -> dict:
    """Medians of errors, of both."""
    rows = [row for row in rows if "estimated_N" in row]
    sensor, force = np.array([row["sensor"] for row in rows]), np.array([row["force_N"] for row in rows])
    out = {"presses": len(rows), "sensors": len(set(sensor)), "median_force_N": float(np.median(force))}
    out["within"] = np.mean([row["within"] for row in rows], 0).tolist()
    for name, centre, size in (
        ("inversion", "centre_mm", "estimated_N"), ("network", "network_centre_mm", "network_N")
    ):  # fmt: skip
        ratio = np.array([row[size] for row in rows]) / force
        others = [np.delete(ratio, i)[np.delete(sensor, i) == s] for i, s in enumerate(sensor)]
        factor = np.array([np.median(part) if len(part) else 1.0 for part in others])
        out[name] = {
            "centre_mm": float(np.nanmedian([row[centre] for row in rows])),
            "force_percent": 100 * float(np.median(np.abs(ratio - 1))),
            "force_percent_one_factor": 100 * float(np.median(np.abs(ratio / factor - 1))),
        }
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=pathlib.Path, required=True)
    parser.add_argument("--presses", type=int, default=200)
    parser.add_argument("--sensors", type=int, default=4)
    parser.add_argument("--sensor-skin", default="default")
    given = parser.parse_args()
    rows = json.loads(given.json.read_text())["rows"] if given.json.exists() else []
    estimator, sensors = Estimator(load_skin("coarse"), INDENTER), {}
    for k in range(len(rows), given.presses):
        seed, number = 1 + k % given.sensors, k // given.sensors
        if seed not in sensors:
            sensors[seed] = SyntheticSensor(seed, given.sensor_skin)
        rows.append(measure(sensors[seed], number, estimator))
        given.json.write_text(json.dumps({"rows": rows}, indent=1))
    out = summary(rows)
    given.json.write_text(json.dumps({"rows": rows, "summary": out}, indent=1))
    print(json.dumps(out, indent=1))


if __name__ == "__main__":
    main()
