"""Fits the confidence of findings in plain recordings to pieces with hidden effects.

    python benchmarks/discrepancy_confidence.py out/first.json out/second.json
    python benchmarks/discrepancy_confidence.py out/first.json out/second.json --left-out

JSON are files of `discrepancy_recordings.py`. The weights go into
`biotac_mj/discrepancy/recordings/confidence.json`; those of faults of the log stay in `quality.confidence`.
--parts: only these of them, names, left_... or a family.
--left-out writes nothing: the table of each author's pieces, named by weights that are fitted to the other
authors' alone.
"""

import argparse
import json
import pathlib

import numpy as np
from discrepancy_recordings import table
from records import read_json, write_json

__all__ = ["authors_left_out", "fit"]

_WEIGHTS = pathlib.Path(__file__).parents[1] / "biotac_mj/discrepancy/recordings/confidence.json"

# clues that a family's confidence is made of, and their signs: more evidence never speaks against a name
CLUES = {
    "shared": {"nats": 1, "uneven": -1, "seconds": 1},
    "loss": {"lead": 1, "turns": -1, "seconds": 1},
    "supply": {"lead": 1, "room": 1},
    "one": {"lead": 1, "apart": 1},
    "jump": {"edge": 1, "alone": 1},
    "order": {"nats": 1, "ratio": 1},
    "late": {"gain": 1, "size": 1},
    "process": {"likelier": 1},
}
# of what is left: each may be what no name fits. Under a load levels, changes against the others and what
# electrodes have to do with each other later on are in recordings without an effect what they are in others
LEFT = {
    "left_loaded": ("rhythm", "rhythm1", "sharp", "sharp1", "again", "swells"),
    "left_short": ("rhythm", "rhythm1", "sharp", "sharp1", "again", "swells"),
    "left_moving": ("rhythm", "rhythm1", "sharp1", "low6", "again", "swells"),
    "left_still": (
        "counts1",
        "level3",
        "stands",
        "rhythm",
        "rhythm1",
        "sharp",
        "sharp1",
        "low1",
        "low6",
        "again",
        "swells",
    ),
}
# of a family's own intercept, of a clue from half a nat for a standard deviation, and of what stands beside
RIDGE = {"family": 0.3, "clue": 0.5, "beside": 2.0}
CLUE = 0.5  # nats for a standard deviation of a clue, before anything is known of it
OUT = 5.0  # standard deviations beyond which a clue says no more
NATURAL = 0.1  # weight of what a sensor has by itself, which is told surely and says little of what is hidden
FLIPS = 0.02  # p of sign flips of blocks, above which nothing is named
LEAST = 0.25  # spread of a clue of what is left


def _nameable(row):
    """What was found and neither sign flips nor the part kept aside contradict."""
    return [*row["named"], *(n for n in row["weak"] if not n["contradicted"] and n.get("p", 0.0) < FLIPS)]


def fit(rows: list) -> dict:
    """Weights of the confidence, and what is usual of recordings without an effect."""
    left = {name: [r for r in rows if r.get("left") == name] for name in LEFT}
    usual = {name: _usual(mine, LEFT[name]) for name, mine in left.items() if mine}
    return {"names": _logistic(_candidates(rows))} | usual


def _candidates(rows):
    """What may be named, each with the number of others of its family in the piece, but for faults of the
    log, whose weights are in `quality.confidence`."""
    from biotac_mj.quality.confidence import WEIGHTS

    out = []
    for i, row in enumerate(rows):
        every = [n["family"] for n in (*row["named"], *row["weak"])]
        out += [n | {"row": i, "beside": every.count(n["family"]) - 1} for n in _nameable(row)]
    return [n for n in out if n["family"] not in WEIGHTS]


def _logistic(cases):
    """One logistic over all families: a common intercept, one of each family drawn to none, clues of each
    drawn to what is thought of them and never against their sign, and what stands beside."""
    from scipy.optimize import minimize
    from scipy.special import expit

    from biotac_mj.discrepancy.recordings.confidence import crowd

    names = sorted({c["family"] for c in cases})
    right = np.array([c["right"] is not None for c in cases], float)
    weight = np.array([NATURAL if c["right"] == "natural" else 1.0 for c in cases])
    of = np.array([names.index(c["family"]) for c in cases])
    columns = [
        np.ones(len(cases)),
        np.array([crowd(c["family"], c["beside"]) for c in cases]),
        *(of == np.arange(len(names))[:, None]),
    ]
    prior, ridge, signs = [0.0] * len(columns), [1e-6, RIDGE["beside"]], [0] * len(columns)
    ridge += [RIDGE["family"]] * len(names)
    scales = []
    for i, name in enumerate(names):
        for clue, sign in CLUES.get(name, {}).items():
            x = np.array([c["clues"].get(clue, 0.0) for c in cases])
            middle, spread = x[of == i].mean(), max(x[of == i].std(), 0.1)
            scales.append((name, clue, middle, spread))
            columns.append(np.where(of == i, np.clip((x - middle) / spread, -OUT, OUT), 0.0))
            prior, ridge, signs = [*prior, CLUE * sign], [*ridge, RIDGE["clue"]], [*signs, sign]
    A, prior, ridge = np.column_stack(columns), np.array(prior), np.array(ridge)

    def loss(w):
        t, away = A @ w, w - prior
        value = np.sum(weight * (np.logaddexp(0, t) - right * t)) + 0.5 * np.sum(ridge * away**2)
        return value, A.T @ (weight * (expit(t) - right)) + ridge * away

    bounds = [(0 if s > 0 else None, 0 if s < 0 else None) for s in signs]
    w = minimize(loss, np.zeros(A.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds).x
    families = {
        name: {
            "intercept": float(w[2 + i]),
            "clues": {},
            "cases": int((of == i).sum()),
            "right": int(right[of == i].sum()),
        }
        for i, name in enumerate(names)
    }
    for (name, clue, middle, spread), v in zip(scales, w[2 + len(names) :]):
        own = families[name]
        own["clues"][clue] = [float(v / spread), float(middle - OUT * spread), float(middle + OUT * spread)]
        own["intercept"] -= float(v * middle / spread)
    return {"intercept": float(w[0]), "beside": float(w[1]), "families": families}


def _one_family(shipped, fitted, name):
    """Puts a family's weights among those of another fit, with the intercept that both have in common."""
    own = fitted["families"][name]
    own["intercept"] += fitted["intercept"] - shipped["intercept"]
    shipped["families"][name] = own


def _usual(rows, clues):
    """What is usual of recordings without an effect: clue -> (median, change with the logarithm of the
    seconds, spread of the upper side), and how far the most unusual clue of each lies."""
    from biotac_mj.discrepancy.recordings.confidence import farthest

    rest = [r["rest"] for r in rows if not r["truth"]]
    x = np.array([[r[k] for k in clues] for r in rest])
    seconds = np.array([r["seconds"] for r in rest])
    slope = _slopes(x, seconds)
    middle, high = np.quantile(x - np.outer(seconds, slope), [0.5, 0.9], axis=0)
    usual = np.column_stack([middle, slope, np.maximum((high - middle) / 1.28, LEAST)])
    known = dict(zip(clues, usual.tolist()))
    return {"usual": known, "others": sorted(farthest(r, known) for r in rest)}


def _slopes(x, t):
    """(c,) medians of the slopes between pairs of rows x (n, c) that lie apart in t (n,), 0 of too few."""
    i, j = np.triu_indices(len(t), 1)
    apart = np.abs(t[i] - t[j]) > 0.3 * max(np.ptp(t), 1e-9)
    if len(t) < 8 or np.ptp(t) < 0.5:
        return np.zeros(x.shape[1])
    return np.median((x[i] - x[j])[apart] / (t[i] - t[j])[apart, None], axis=0)


def authors_left_out(rows: list, named: float, unknown: dict) -> list:
    """Rows as they would be named and called unknown, from the evidence they hold, with confidences whose
    weights come from the other authors' recordings alone."""
    from biotac_mj.discrepancy.recordings.confidence import probability, unusual
    from biotac_mj.discrepancy.recordings.rest import LIKELY

    out = []
    for author in dict.fromkeys(r["half"] for r in rows):
        weights = fit([r for r in rows if r["half"] != author])
        mine = [r for r in rows if r["half"] == author]
        said, likely = [[] for _ in mine], set()
        for n in _candidates(mine):
            p = probability(n["family"], n["clues"], n["beside"], weights)
            if p >= named:
                said[n["row"]].append({"channels": ["e1"] * 19} | n | {"confidence": p})
            elif p >= LIKELY and n["family"] != "shared":
                likely.add(n["row"])
        for i, (r, names) in enumerate(zip(mine, said)):
            p = unusual(r["rest"], r["left"], weights)
            out.append(r | {"named": names, "unknown": p <= unknown[r["left"]] or i in likely})
    return out


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("json", nargs="+", metavar="JSON")
    args.add_argument("--parts", nargs="+", metavar="NAME")
    args.add_argument("--left-out", action="store_true")
    options = args.parse_args(argv)
    rows = [r for path in options.json for r in json.loads(pathlib.Path(path).read_text())["cases"]]
    rows = [r for r in rows if "refused" not in r]
    if options.left_out:
        from biotac_mj.discrepancy.recordings.confidence import NAMED
        from biotac_mj.discrepancy.recordings.rest import UNKNOWN

        rows = authors_left_out(rows, NAMED, UNKNOWN)
        for author in dict.fromkeys(r["half"] for r in rows):
            print(author, table([r for r in rows if r["half"] == author]), sep="\n", end="\n\n")
        print("all", table(rows), sep="\n")
        return
    fitted, shipped = fit(rows), read_json(_WEIGHTS, {})
    for name in options.parts or fitted:
        if name in fitted:
            shipped[name] = fitted[name]
        else:
            _one_family(shipped["names"], fitted["names"], name)
    write_json(_WEIGHTS, shipped)


if __name__ == "__main__":
    main()
