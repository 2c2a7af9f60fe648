"""Sets the thresholds and the confidence of diagnosis (`biotac_mj.discrepancy.trajectories.thresholds`) from
practice seeds; prints them for the constant table.

    python benchmarks/discrepancy.py --seeds practice --json p.json \\
        --counts none=30,single=6,left-out=3,outside=20,pair=30,wrong-base=12
    python benchmarks/discrepancy_calibrate.py p.json

Left-out cases (the hidden effect is taken out of the catalogue) teach abstention: each name given there is
wrong."""

import argparse
import json
import pathlib

import numpy as np
from discrepancy_table import right
from scipy.optimize import minimize

from biotac_mj.discrepancy.trajectories.thresholds import THRESHOLDS, terms

_RIDGE = 0.5
_LEFT_OUT = 0.25  # weight of a case whose effect is not in the catalogue: about one in ten of all


def names(rows):
    """One entry for every name given: x (terms of the confidence), what was left, whether it is right."""
    out = []
    for r in rows:
        trace = r["trace"]
        for k, name in enumerate(r["named"]):
            c = next(c for step in reversed(trace["rounds"]) for c in step if c["id"] == name)
            if k and c["nats"] <= THRESHOLDS["further"]:
                continue  # present thresholds refuse it
            x = terms(c["nats"], trace["inside"], trace["left"], c["lead"], len(r["ties"][k]))
            out.append(
                {
                    "x": x,
                    "inside": trace["inside"],
                    "after": trace["after"],
                    "right": right(r, k),
                    "exact": name in r["truth"],
                    "row": r,
                    "name": name,
                    "candidate": c,
                    "ties": len(r["ties"][k]),
                }
            )
    return out


def logistic(x, y, weight):
    """Weights of a ridge logistic regression."""
    x, y = np.asarray(x, float), np.asarray(y, float)

    def loss(w):
        z = x @ w
        return np.sum(weight * (np.logaddexp(0, z) - y * z)) + _RIDGE * (w[1:] ** 2).sum() / 2

    return minimize(loss, np.zeros(x.shape[1])).x


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("json", nargs="+")
    args.add_argument(
        "--write", action="store_true", help="put the weights of the confidence into thresholds.py"
    )
    args = args.parse_args(argv)
    rows = [r for f in args.json for r in json.loads(pathlib.Path(f).read_text())]
    quiet = [r for r in rows if r["kind"] in ("none", "wrong-base")]
    for key in ("level", "peak"):
        for kind in ("none", "wrong-base"):
            v = [r["trace"]["before"][key] for r in quiet if r["kind"] == kind]
            print(f"{key} {kind}: median {np.median(v):.2f}, largest {np.sort(v)[-4:].round(2)}")
    print("candidates where nothing is hidden (nats, p, id):")
    some = sorted(
        ((c["nats"], c["p"], c["id"], r["case"]) for r in quiet for c in r["trace"]["rounds"][0]),
        reverse=True,
    )[:12]
    print("\n".join(f"  {n:.2f} {p:.3f} {i} {c}" for n, p, i, c in some))
    print("true effects of single cases in the first round (nats), sorted:")
    some = sorted(
        (next((c["nats"] for c in r["trace"]["rounds"][0] if c["id"] == r["truth"][0]), -9), r["case"])
        for r in rows
        if r["kind"] == "single"
    )
    print("  " + ", ".join(f"{n:.1f} {c[8:]}" for n, c in some))
    print("second names: nats, share, energy, right")
    for e in names([r for r in rows if r["kind"] in ("single", "pair", "outside", "left-out")]):
        k = e["row"]["named"].index(e["name"])
        if k or not e["right"]:
            c = e["candidate"]
            print(
                f"  {e['row']['case']:<26} {e['name']:<11} {k} nats {c['nats']:6.1f} share "
                f"{c['share']:7.2f} energy {c['energy']:6.3f} "
                f"inside {e['inside']:.2f} level {e['after']['level']:.2f} peak {e['after']['peak']:.2f} "
                + ("right" if e["right"] else "WRONG")
            )
    print("share closed -> names kept, right; abstention outside and left out")
    every = names([r for r in rows if r["kind"] != "left-out"])
    for s in (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95):
        kept = [e for e in every if e["inside"] >= s]
        shut = [r for r in rows if r["kind"] in ("outside", "left-out")]
        gone = {
            k: [r["trace"]["inside"] < s or not r["named"] for r in shut if r["kind"] == k]
            for k in ("outside", "left-out")
        }
        print(f"  {s}: {len(kept)}/{len(every)} kept, right {np.mean([e['right'] for e in kept]):.3f}, "
              + ", ".join(f"{k} {np.mean(v):.2f}" for k, v in gone.items()))  # fmt: skip
    data = names(rows)
    weight = np.array([_LEFT_OUT if e["row"]["kind"] == "left-out" else 1.0 for e in data])
    w = logistic([e["x"] for e in data], [e["exact"] for e in data], weight)
    weights = tuple(round(float(v), 3) for v in w)
    print("CONFIDENCE =", weights, "of", len(data), "names,", sum(e["exact"] for e in data), "right")
    if args.write:
        path = pathlib.Path(__file__).parents[1] / "biotac_mj/discrepancy/trajectories/thresholds.py"
        lines = [
            f"CONFIDENCE = {weights}" if line.startswith("CONFIDENCE = ") else line
            for line in path.read_text().splitlines()
        ]
        path.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
