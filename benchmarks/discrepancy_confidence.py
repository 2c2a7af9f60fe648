"""Fits the confidence of findings in plain recordings to pieces with hidden effects.

    python benchmarks/discrepancy_confidence.py out/first.json out/second.json
    python benchmarks/discrepancy_confidence.py out/first.json out/second.json --left-out
    python benchmarks/discrepancy_confidence.py out/checkup.json --checkup

JSON are files of `discrepancy_recordings.py`. The weights go into `biotac_mj/quality/confidence.json`, in
which those of faults of the log stay, and what is usual of what is left into
`biotac_mj/discrepancy/recordings/usual.json`. --checkup prints what stands in the first of what a checkup
alone finds, by files of `checkup_labs.py`.
--parts: only these of them, detectors or kinds of recordings.
--left-out writes nothing: the table of each author's pieces, named by weights that are fitted to the other
authors' alone.
"""

import argparse
import json
import pathlib

import numpy as np
from discrepancy_recordings import table
from records import read_json, write_json

from biotac_mj.discrepancy.recordings.rest import farthest
from biotac_mj.quality.confidence import NAMED, NEW, PER_CANDIDATE, decades, probability

__all__ = ["authors_left_out", "fit"]

_PACKAGE = pathlib.Path(__file__).parents[1] / "biotac_mj"
_FITTED = {
    "weights": _PACKAGE / "quality/confidence.json",
    "usual": _PACKAGE / "discrepancy/recordings/usual.json",
}

# features that a detector's confidence is made of, and their signs: more evidence never speaks against a name
FEATURES = {
    "shared": {"nats": 1, "uneven": -1, "seconds": 1},
    "loss": {"lead": 1, "turns": -1, "seconds": 1},
    "supply": {"lead": 1, "room": 1},
    "one": {"lead": 1, "wandering": 1},
    "process": {"likelier": 1, "wandering": 1},
    "jump": {"edge": 1, "isolation": 1},
    "slip": {},
    "late": {"gain": 1, "size": 1},
    "lag": {"explained": 1},
}
CHECKUP = {"gone": {}, "loud": {"decades": 1}, "memory": {"decades": 1}}
_ROWS = ("rhythm", "sharp", "sharp1")
# of what is left: each may be what no name fits. Under a load levels are in recordings without an effect what
# they are in others
LEFT = {
    "loaded": _ROWS,
    "short": _ROWS,
    "moving": ("rhythm", "sharp1", "low6"),
    "still": ("level3", *_ROWS, "low1", "low6"),
}
UNKNOWN = 0.1  # of recordings without an effect, that are as unusual as is called unknown
RIDGE = {"detector": 0.3, "feature": 0.5}
FEATURE = 0.5  # nats for a standard deviation of a feature, before anything is known of it
OUT = 5.0  # standard deviations beyond which a feature says no more
NATURAL = 0.1  # weight of what a sensor has by itself, which is told surely and says little of what is hidden
FLIPS = 0.02  # p of sign flips of blocks, above which nothing is named
LEAST = 0.25  # spread of a feature of what is left


def fit(rows: list) -> dict:
    """Weights of the confidence, and what is usual of recordings without an effect."""
    left = {kind: [r for r in rows if r["left"] == kind and not r["truth"]] for kind in LEFT}
    usual = {kind: _usual([r["rest"] for r in mine], LEFT[kind]) for kind, mine in left.items() if mine}
    cases = _candidates(rows)
    weights = {
        name: _logistic([c for c in cases if c["detector"] == name], FEATURES[name]) for name in FEATURES
    }
    return {"weights": {name: w for name, w in weights.items() if w}, "usual": usual}


def of_checkups(rows: list) -> dict:
    """(intercept, features) of `quality.confidence` for what a checkup alone finds, and how many names of it
    are right, of how many."""
    names = [n | {"beside": 0, "features": {"decades": decades(n["p"])}} for r in rows for n in r["named"]]
    out = {}
    for detector, features in CHECKUP.items():
        mine = [n for n in names if n["detector"] == detector]
        if fitted := _logistic(mine, features):
            weights = {
                k: (round(w / NEW, 3), *np.round(ends, 1).tolist())
                for k, (w, *ends) in fitted["features"].items()
            }
            right = sum(n["right"] is not None for n in mine)
            out[detector] = round(fitted["intercept"] / NEW, 3), weights, right, len(mine)
    return out


def _candidates(rows):
    """What neither sign flips nor the held-out part contradict, each with the number of others of its
    detector in the piece, but for faults of the log."""
    out = []
    for i, row in enumerate(rows):
        every = [n["detector"] for n in (*row["named"], *row["weak"])]
        mine = [*row["named"], *(n for n in row["weak"] if not n["contradicted"] and n["p"] < FLIPS)]
        out += [n | {"row": i, "beside": max(every.count(n["detector"]) - 1 - n["pair"], 0)} for n in mine]
    return [n for n in out if n["detector"] in FEATURES]


def _logistic(cases, signs):
    """Intercept, and of each feature weight, least and most: a logistic regression whose weights are drawn to
    what is thought of them and never against their sign. None without cases."""
    from scipy.optimize import minimize
    from scipy.special import expit

    if not cases:
        return None
    right = np.array([c["right"] is not None for c in cases], float)
    weight = np.array([NATURAL if c["right"] == "natural" else 1.0 for c in cases])
    beside = PER_CANDIDATE * np.log1p([c["beside"] for c in cases])
    x = np.array([[c["features"].get(name, 0.0) for name in signs] for c in cases]).reshape(len(cases), -1)
    middle, spread = x.mean(0), np.maximum(x.std(0), 0.1)
    A = np.column_stack([np.ones(len(cases)), np.clip((x - middle) / spread, -OUT, OUT)])
    sign = np.array([*signs.values()])
    prior = np.r_[0.0, FEATURE * sign]
    ridge = np.r_[RIDGE["detector"], np.full(len(sign), RIDGE["feature"])]

    def loss(w):
        t, away = A @ w + beside, w - prior
        value = np.sum(weight * (np.logaddexp(0, t) - right * t)) + 0.5 * np.sum(ridge * away**2)
        return value, A.T @ (weight * (expit(t) - right)) + ridge * away

    bounds = [(None, None), *((0, None) if s > 0 else (None, 0) for s in sign)]
    w = minimize(loss, np.zeros(A.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds).x
    slope = w[1:] / spread
    ends = zip(slope, middle - OUT * spread, middle + OUT * spread)
    return {
        "intercept": float(w[0] - slope @ middle),
        "features": {name: [*map(float, end)] for name, end in zip(signs, ends)},
    }


def _usual(rest, features):
    """What is usual of recordings without an effect: feature -> (median, change with the logarithm of the
    seconds, spread of the upper side), and how far the most unusual feature lies in one of ten."""
    x = np.array([[r[name] for name in features] for r in rest])
    seconds = np.array([r["seconds"] for r in rest])
    slope = _slopes(x, seconds)
    middle, high = np.quantile(x - np.outer(seconds, slope), [0.5, 0.9], axis=0)
    usual = np.column_stack([middle, slope, np.maximum((high - middle) / 1.28, LEAST)])
    known = dict(zip(features, usual.tolist()))
    return {
        "features": known,
        "limit": float(np.quantile([farthest(r, known)[0] for r in rest], 1 - UNKNOWN)),
    }


def _slopes(x, t):
    """(c,) medians of the slopes between pairs of rows x (n, c) that lie apart in t (n,), 0 of too few."""
    i, j = np.triu_indices(len(t), 1)
    apart = np.abs(t[i] - t[j]) > 0.3 * max(np.ptp(t), 1e-9)
    if len(t) < 8 or np.ptp(t) < 0.5:
        return np.zeros(x.shape[1])
    return np.median((x[i] - x[j])[apart] / (t[i] - t[j])[apart, None], axis=0)


def authors_left_out(rows: list) -> list:
    """Rows as they would be named and called unknown, from the evidence they hold, with confidences whose
    weights come from the other authors' recordings alone. Faults of the log keep their names."""
    out = []
    for author in dict.fromkeys(r["half"] for r in rows):
        fitted = fit([r for r in rows if r["half"] != author])
        mine = [r for r in rows if r["half"] == author]
        lacking = sorted({r["left"] for r in mine} - fitted["usual"].keys())
        if lacking:
            kinds = " and ".join(lacking)
            raise SystemExit(f"without {author}'s no {kinds} recording has no effect: give more pieces")
        said = [[n for n in r["named"] if n["detector"] not in FEATURES] for r in mine]
        for n in _candidates(mine):
            p = probability(n["detector"], n["features"], n["beside"], fitted["weights"])
            if p >= NAMED:
                said[n["row"]].append(n | {"confidence": p})
        for r, names in zip(mine, said):
            usual = fitted["usual"][r["left"]]
            unknown = farthest(r["rest"], usual["features"])[0] > usual["limit"]
            out.append(r | {"named": names, "unknown": unknown})
    return out


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("json", nargs="+", metavar="JSON")
    args.add_argument("--parts", nargs="+", metavar="NAME")
    args.add_argument("--left-out", action="store_true")
    args.add_argument("--checkup", action="store_true")
    options = args.parse_args(argv)
    documents = [json.loads(pathlib.Path(path).read_text()) for path in options.json]
    if options.checkup:
        labs = [lab["checkup"] for d in documents for lab in d["labs"] if "checkup" in lab]
        for detector, weights in of_checkups(labs).items():
            print(detector, *weights)
        return
    rows = [r for d in documents for r in d["cases"]]
    rows = [r for r in rows if "refused" not in r]
    if options.left_out:
        rows = authors_left_out(rows)
        for author in dict.fromkeys(r["half"] for r in rows):
            print(author, table([r for r in rows if r["half"] == author]), sep="\n", end="\n\n")
        print("all", table(rows), sep="\n")
        return
    for part, values in fit(rows).items():
        some = {name: v for name, v in values.items() if name in (options.parts or values)}
        write_json(_FITTED[part], read_json(_FITTED[part], {}) | some)


if __name__ == "__main__":
    main()
