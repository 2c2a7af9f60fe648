"""Recordings of real sensors with hidden effects: what `biotac diagnose --electrodes` names.

    python benchmarks/discrepancy_recordings.py DATA --half practice --json out/practice.json
    python benchmarks/discrepancy_recordings.py --fit out/mixed.json out/second.json out/third.json
    python benchmarks/discrepancy_recordings.py --left-out out/mixed.json out/second.json out/third.json

DATA is a folder of recordings (`authors/first.py`). --fit writes the confidence's weights; "mixed" has
pieces of either half and further forms. Other authors' recordings: --half second, third, fourth, fifth,
seventh, eighth, ninth, tenth, eleventh, twelfth, thirteenth, fourteenth, fifteenth, sixteenth,
seventeenth (`benchmarks/authors/second.py` and so on; --counts of the third: rounds; the last thirteen's are
as many as they are; the last eleven's are read from a file, with its clock).
Of each piece `detectable` says what an observer sees who has the signal without what is hidden
(`discrepancy_observer.py`).
--left-out names each author's by weights fitted on the others' alone. A run goes on where it ended.
"""

import argparse
import functools
import hashlib
import json
import pathlib
import tempfile
import time

import numpy as np
from authors import (
    eighth,
    eleventh,
    fifteenth,
    fifth,
    first,
    fourteenth,
    fourth,
    ninth,
    seventeenth,
    seventh,
    sixteenth,
    tenth,
    third,
    thirteenth,
    twelfth,
)
from authors import second as foreign  # its names and what may be said of them include the first's
from discrepancy_observer import SEEN, seen_nats

__all__ = ["code_hash", "fit", "judge", "table"]


_NATURAL = functools.reduce(
    dict.__or__,
    (
        author.NATURAL
        for author in (
            foreign,
            seventh,
            eighth,
            ninth,
            tenth,
            eleventh,
            twelfth,
            thirteenth,
            fourteenth,
            fifteenth,
            sixteenth,
            seventeenth,
        )
    ),
)


def right(effect: dict, case) -> str | None:
    """The hidden effect that a named one is, on its channel; "natural" for what the base has by itself."""
    ids = {effect["id"], *effect["ties"]}
    for name, channels in zip(case.truth, case.channels):
        if name == "lost" and not _near(effect.get("places", ()), case):
            continue
        if foreign.ACCEPTED[name] & ids and (
            name not in foreign.SINGLE or {f"e{k + 1}" for k in channels} & set(effect["channels"])
        ):
            return name
    return "natural" if _NATURAL[case.base] & {effect["id"]} else None


def _near(places, case):
    """Whether one of some times [s] is a gap of the case, within a tenth of a second."""
    return any(np.abs(np.asarray(case.gaps) / case.rate - t).min(initial=1.0) < 0.1 for t in places)


def _as_said(finding):
    """What decides whether a finding is right."""
    return {
        "id": finding.id,
        "ties": finding.ties,
        "channels": [f"e{k + 1}" for k in finding.channels],
        "places": finding.clues.get("places", ()),
    }


def _recording(case):
    """The case as the diagnosis reads it: from a file where it has a clock of its own, or is tared."""
    from biotac_mj.discrepancy import PlainRecording, read_recording

    time = case.time
    if time is None and case.counts.min() < 0:
        time = np.arange(len(case.counts)) / case.rate
    if time is None:
        return PlainRecording(case.counts, case.force, case.tdc, case.rate)
    names, columns = ["time", *(f"e{k + 1}" for k in range(19))], [time[:, None], case.counts]
    if case.tdc is not None:
        names, columns = [*names, "tdc"], [*columns, case.tdc[:, None]]
    if case.force is not None:
        names, columns = [*names, "fx", "fy", "fz"], [*columns, case.force]
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "log.csv"
        np.savetxt(path, np.hstack(columns), "%.9g", ",", header=",".join(names), comments="")
        return read_recording(path)


def judge(case, clean: np.ndarray, recording) -> dict:
    """Diagnoses the recording of one case and scores it."""
    from biotac_mj.discrepancy import diagnose_recording
    from biotac_mj.discrepancy.recordings.confidence import NAMED, clues, family
    from biotac_mj.discrepancy.recordings.report import verdict_dict

    began = time.process_time()
    d = diagnose_recording(recording)
    verdict = verdict_dict(d)
    named = []
    for f, e in zip([*d.findings, *d.late], verdict["effects"]):
        named.append(
            {
                "id": e["id"],
                "ties": e["ties"],
                "channels": e["channels"],
                "confidence": e["confidence"],
                "confirmed": e["confirmed"],
                "right": _named(f, case),
                "family": family(f),
                "clues": clues(f),
                "p": f.p,
            }
        )
    weak = [
        {
            "id": f.id,
            "family": family(f),
            "clues": clues(f),
            "p": f.p,
            "confidence": f.confidence,
            "right": _named(f, case),
            "contradicted": f.confidence >= NAMED,
        }
        for f in d.rejected
    ]
    return {
        "base": case.base,
        "force": case.force is not None,
        "truth": case.truth,
        "forms": case.forms,
        "seen": case.seen,
        "detectable": seen_nats(case.counts, clean, case.force) if case.truth else 0.0,
        "channels": case.channels,
        "rows": len(case.counts),
        "seconds": time.process_time() - began,
        "verdict": verdict["verdict"],
        "named": named,
        "weak": weak,
        "unknown": d.rest.significant,
        "left": d.rest.kind,
        "rest": d.rest.clues,
        "closed": closed(d, case, clean),
        "views": {k: (v["before"], v["after"]) for k, v in d.gap.items()},
    }


def judge_electronics(case, clean: np.ndarray, recording) -> dict:
    """As `judge`, of what needs no model of the load alone, in a tenth of the time: evidence to fit to."""
    from biotac_mj.discrepancy.recordings.confidence import NAMED, clues, confidence, family
    from biotac_mj.discrepancy.recordings.search import electronics
    from biotac_mj.discrepancy.recordings.session import Session

    rows, found = np.arange(len(recording)), []
    session = Session(recording, rows < round(len(rows) * (0.6 if recording.force is None else 0.7)))

    def take(f):
        f.confidence = confidence(f, sum(family(g) == family(f) for g in found))
        found.append(f)
        if f.confidence >= NAMED and f.p < FLIPS:
            session.accept(f)
        return f.confidence >= NAMED and f.p < FLIPS

    electronics(session, take)
    said = [
        {"id": f.id, "family": family(f), "clues": clues(f), "p": f.p, "right": _named(f, case)}
        | {"confidence": f.confidence, "contradicted": False}
        for f in found
    ]
    return {"base": case.base, "truth": case.truth, "forms": case.forms, "named": [], "weak": said}


# what cannot be had back: noise that was added, digits that were dropped
GONE = {"noise", "quantise", "lost"}
SHARED = {"warmup", "fluidloss", "count_offset", "thermal"}
# what a base has some of by itself: of the clean counts as much is taken out
OWN = SHARED | {"latency", "lowpass", "relax", "hyster"}


def closed(diagnosis, case, clean: np.ndarray) -> float | None:
    """Share of the hidden change of the counts, on the part kept aside, that the right findings take out.

    A shared drift, a latency and a memory are taken out together with those that the sensor has by itself, so
    the clean counts are amended alike before they are compared.
    """
    from biotac_mj.sensor.channels import counts_from_log_impedance, log_impedance

    if not case.truth or len(clean) != len(case.counts) or GONE & set(case.truth):
        return None
    rows, rate = ~diagnosis.session.fit, case.rate
    hidden = np.sqrt(np.mean((case.counts - clean)[rows] ** 2))
    if hidden < 1e-9:
        return None
    if not diagnosis.recording.absolute:  # on the rest that was assumed
        clean = clean + np.median(diagnosis.recording.electrodes - case.counts, axis=0)

    def amended(d):
        mine = [f for f in d.findings if _named(f, case) not in (None, "natural")]
        if SHARED & set(case.truth):
            mine += [
                f for f in d.findings if len(f.channels) > 12 and f.correct is not None and f not in mine
            ]
        out = d.session.without(*(f for f in d.findings if f not in mine)).filled()
        for f in mine:
            if f.seen is not None and "width" not in f.seen[1]:  # a loop is of newtons, not of ln Z
                out = counts_from_log_impedance(f.seen[0].unsee(log_impedance(out), rate, f.seen[1]))
        return out

    if OWN & set(case.truth):
        from biotac_mj.discrepancy import PlainRecording, diagnose_recording

        clean = amended(
            diagnose_recording(PlainRecording(np.clip(np.rint(clean), 0, 4095), case.force, case.tdc, rate))
        )
    return float(1 - np.sqrt(np.mean((amended(diagnosis) - clean)[rows] ** 2)) / hidden)


def _named(finding, case):
    return right(_as_said(finding), case)


def code_hash() -> str:
    """Of everything that decides a verdict."""
    folder = pathlib.Path(__file__).parents[1] / "biotac_mj/discrepancy"
    files = [folder / "evidence.py", folder / "noise.py", *sorted((folder / "recordings").rglob("*.*"))]
    return hashlib.sha256(
        b"".join(f.read_bytes() for f in files if f.suffix in (".py", ".json"))
    ).hexdigest()[:12]


def table(rows: list) -> str:
    """The scores in words."""
    names = [n for r in rows for n in r["named"] if n["right"] != "natural"]
    none = [r for r in rows if not r["truth"]]
    outside = [r for r in rows if set(r["truth"]) & foreign.OUTSIDE]
    single = [r for r in rows if len(r["truth"]) == 1 and r not in outside]
    pairs = [r for r in rows if len(r["truth"]) == 2]

    def first(r):
        return any(n["right"] == r["truth"][0] for n in r["named"])

    def say(text, hits, total):
        return f"{text:<56}{hits:>4} of {total:<4}{hits / max(total, 1):>6.0%}"

    # of lost rows no clean signal is beside them
    plain = [r for r in single if r.get("detectable") is None or r["detectable"] >= SEEN]
    lines = [
        say("names that are right", sum(n["right"] is not None for n in names), len(names)),
        say("single effects named", sum(first(r) for r in single), len(single)),
        say(f"  of those that an observer sees ({SEEN:g} nats)", sum(map(first, plain)), len(plain)),
        say(
            "  and nothing else",
            sum(first(r) and all(n["right"] for n in r["named"]) for r in single),
            len(single),
        ),
        say(
            "falsely named where nothing is hidden",
            sum(any(n["right"] is None for n in r["named"]) for r in none),
            len(none),
        ),
        say("  or called unknown", sum(r["unknown"] for r in none), len(none)),
        say("outside the catalogue: unknown", sum(r["unknown"] for r in outside), len(outside)),
        say(
            "  and nothing wrong named",
            sum(r["unknown"] and all(n["right"] for n in r["named"]) for r in outside),
            len(outside),
        ),
        say(
            "pairs: both named",
            sum(len({n["right"] for n in r["named"]} & set(r["truth"])) == 2 for r in pairs),
            len(pairs),
        ),
        say(
            "  one of them",
            sum(bool({n["right"] for n in r["named"]} & set(r["truth"])) for r in pairs),
            len(pairs),
        ),
    ]
    for text, mine in (("named ones", [r for r in single if first(r)]), ("all", single)):
        shares = [r["closed"] for r in mine if r["closed"] is not None]
        if shares:
            low, middle, high = np.quantile(shares, [0.25, 0.5, 0.75])
            lines.append(
                f"gap closed on the part kept aside, {text}: median {middle:.0%}, quartiles {low:.0%} "
                f"{high:.0%}, {len(shares)} cases"
            )
    seconds = [r["seconds"] for r in rows]
    lines.append(f"processor time: median {np.median(seconds):.1f} s, most {max(seconds):.1f} s")
    for effect in dict.fromkeys(e for r in rows for e in r["truth"]):
        mine = [r for r in rows if r["truth"] == [effect]]
        wrong = [
            f"{n['id']} {n['channels'][0]}" if len(n["channels"]) < 12 else n["id"]
            for r in mine
            for n in r["named"]
            if n["right"] is None
        ]
        missed = [f"{r['base']}{r['forms']}{'?' if r['unknown'] else ''}" for r in mine if not first(r)]
        lines.append(
            f"{effect:<14}{sum(first(r) for r in mine)} of {len(mine)}  "
            f"wrong: {', '.join(wrong)}  missed: {', '.join(missed)}"
        )
    wrong = [
        f"{r['base']}: {n['id']} {n['channels'][:1]}" for r in none for n in r["named"] if n["right"] is None
    ]
    lines += ["none: " + ", ".join(wrong), "confidence   names  right"]
    everything = [n for r in rows for n in r["named"]]
    edges = [0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.01]
    for a, b in zip(edges[:-1], edges[1:]):
        mine = [n for n in everything if a <= n["confidence"] < b]
        if mine:
            said = np.mean([n["confidence"] for n in mine])
            lines.append(
                f"{said:<13.2f}{len(mine):>5}{np.mean([n['right'] is not None for n in mine]):>7.0%}"
            )
    return "\n".join(lines)


# clues that a family's confidence is made of, and their signs: more evidence never speaks against a name
CLUES = {
    "shared": {"nats": 1, "uneven": -1, "seconds": 1},
    "loss": {"lead": 1, "turns": -1, "seconds": 1},
    "supply": {"lead": 1, "room": 1},
    "one": {"lead": 1, "apart": 1},
    "lag": {"gain": 1, "lag": 1},
    "jump": {"edge": 1, "alone": 1},
    "answer": {"nats": 1, "spread": -1, "sharp": 1, "side": 1},
    "order": {"nats": 1, "ratio": 1},
    "samples": {"nats": 1},
    "single": {"nats": 1, "alone": 1},
    "still": {"nats": 1, "share": 1, "runs": -1},
    "limit": {"nats": 1, "blocks": 1, "runs": 1},
    "lost": {"times": 1, "score": 1},
    "line": {"score": 1},
    "colour": {"ratio": 1, "quiet": 1, "even": 1},
    "pairs": {"rest": 1, "loaded": 1},
    "common": {"factor": 1},
    "size": {"apart": 1, "stands": 1},
    "late": {"gain": 1, "size": 1},
    "memory": {"gain": 1, "blocks": 1},
    "wiring": {"whole": 1},
    "louder": {"both": 1},
    "heard": {"heard": 1},
    "rows": {"nats": 1},
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
    """What may be named, each with the number of others of its family in the piece."""
    out = []
    for i, row in enumerate(rows):
        every = [n["family"] for n in (*row["named"], *row["weak"])]
        out += [n | {"row": i, "beside": every.count(n["family"]) - 1} for n in _nameable(row)]
    return out


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
    for author in dict.fromkeys(r["by"] for r in rows):
        weights = fit([r for r in rows if r["by"] != author])
        mine = [r for r in rows if r["by"] == author]
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


_FILES = {
    "seventh": seventh,
    "eighth": eighth,
    "ninth": ninth,
    "tenth": tenth,
    "eleventh": eleventh,
    "twelfth": twelfth,
    "thirteenth": thirteenth,
    "fourteenth": fourteenth,
    "fifteenth": fifteenth,
    "sixteenth": sixteenth,
    "seventeenth": seventeenth,
}


def pieces(half: str, data: str, counts: str) -> list:
    """(key, kinds, author, function that makes case and clean counts) of an author's pieces, in mixed order,
    so that a run that was stopped holds some of each."""
    if half == "fourth":
        sources, cases = fourth.sources(data), fourth.PLAN

        def make(base, effects, seed):
            piece = fourth.make(sources, base, effects, seed)
            clean = piece.pop("clean")
            return foreign.Case(**piece), clean

        def key(base, effects, seed):
            return base, "+".join(f"{kind}{form}" for kind, form in effects), seed

        author, kinds = fourth, [tuple(kind for kind, _ in effects) for _, effects, _ in cases]
    elif half == "fifth":
        author, cases = fifth, [(p["id"],) for p in fifth.plan()]
        kinds = [tuple(kind for kind, _ in p["effects"]) for p in fifth.plan()]

        def make(name):
            piece = fifth.make(name, data)
            return foreign.Case(**piece.case), piece.clean

        def key(name):
            return (name,)
    elif half in _FILES:
        author = _FILES[half]
        cases = [(spec,) for spec in (seventh.plan(data) if half == "seventh" else author.plan())]
        kinds = [spec.kinds for (spec,) in cases]

        def make(spec):
            case, clean = author.make(spec, data)
            return foreign.Case(**case), clean

        def key(spec):
            return (spec.name,)
    else:
        author = {"second": foreign, "third": third}.get(half, first)
        which = (half,) if author is first else ()
        sources = author.bases(data, *which)
        cases = author.plan(*which, *map(int, counts.split(",")))
        make = functools.partial(author.make, *which, sources)

        def key(base, effects, seed):
            return base, "+".join(effects), seed

        kinds = [effects for _, effects, _ in cases]
    return [
        (key(*cases[i]), kinds[i], author.__name__, functools.partial(make, *cases[i]))
        for i in np.random.default_rng(0).permutation(len(cases))
    ]


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("data", nargs="?")
    args.add_argument(
        "--half",
        choices=["practice", "blind", "mixed", "second", "third", "fourth", "fifth", *_FILES],
        default="practice",
    )
    args.add_argument(
        "--counts", default="9,5,20", help="recordings without effect on each base, of each effect, pairs"
    )
    args.add_argument("--only", nargs="*")
    args.add_argument("--json")
    args.add_argument(
        "--electronics", action="store_true", help="only evidence that needs no model of the load"
    )
    args.add_argument("--fit", metavar="JSON", nargs="+")
    args.add_argument(
        "--parts", nargs="+", help="of --fit: only names, left_... or a family, the others stay as they are"
    )
    args.add_argument("--left-out", metavar="JSON", nargs="+", help="each author by the others' weights")
    args = args.parse_args(argv)
    if args.fit:
        path = pathlib.Path(__file__).parents[1] / "biotac_mj/discrepancy/recordings/confidence.json"
        rows = [r for name in args.fit for r in json.loads(pathlib.Path(name).read_text())["cases"]]
        fitted, shipped = fit(rows), json.loads(path.read_text())
        for name in args.parts or fitted:
            if name in fitted:
                shipped[name] = fitted[name]
            else:
                _one_family(shipped["names"], fitted["names"], name)
        path.write_text(json.dumps(shipped, indent=1) + "\n")
        return
    if args.left_out:
        from biotac_mj.discrepancy.recordings.confidence import NAMED
        from biotac_mj.discrepancy.recordings.rest import UNKNOWN

        rows = [r for name in args.left_out for r in json.loads(pathlib.Path(name).read_text())["cases"]]
        rows = authors_left_out(rows, NAMED, UNKNOWN)
        for author in dict.fromkeys(r["by"] for r in rows):
            print(author, table([r for r in rows if r["by"] == author]), sep="\n", end="\n\n")
        print("all", table(rows), sep="\n")
        return
    from biotac_mj.discrepancy.recordings.recording import MIN_ROWS

    path = pathlib.Path(args.json)
    rows = json.loads(path.read_text())["cases"] if path.exists() else []
    done = {tuple(r["key"]) for r in rows}
    for key, kinds, author, make in pieces(args.half, args.data, args.counts):
        if key in done or args.only and not set(args.only) & {*kinds, "none" if not kinds else ""}:
            continue
        case, clean = make()
        if len(case.counts) < MIN_ROWS:  # refused
            continue
        try:
            recording = _recording(case)
        except ValueError as refused:
            print(*key, refused)
            continue
        judged = (judge_electronics if args.electronics else judge)(case, clean, recording)
        rows.append({"key": key, "by": author, **judged})
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"code": code_hash(), "cases": rows}))
    if not args.electronics:
        print(table(rows))


if __name__ == "__main__":
    main()
