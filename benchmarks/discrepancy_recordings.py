"""Recordings of real sensors with hidden effects: what `biotac diagnose --electrodes` names.

    python benchmarks/discrepancy_recordings.py DATA --half practice --json out/practice.json
    python benchmarks/discrepancy_recordings.py --fit out/practice.json

DATA is a folder of recordings (`recordings_foreign.py`). --fit writes the confidence's weights from
practice; the other half is run once, afterwards (--half blind). A run goes on where its JSON ends.
"""

import argparse
import hashlib
import json
import pathlib
import time

import numpy as np
import recordings_foreign as foreign

__all__ = ["code_hash", "fit", "judge", "table"]


def right(effect: dict, case) -> str | None:
    """The hidden effect that a named one is, on its channel; "natural" for what the base has by itself."""
    ids = {effect["id"], *effect["ties"]}
    for name, channels in zip(case.truth, case.channels):
        if foreign.ACCEPTED[name] & ids and (
            name not in foreign.SINGLE or {f"e{k + 1}" for k in channels} & set(effect["channels"])
        ):
            return name
    return "natural" if foreign.NATURAL[case.base] & {effect["id"]} else None


def judge(case, clean: np.ndarray) -> dict:
    """Runs one case and scores it."""
    from biotac_mj.discrepancy import Recording, diagnose_recording
    from biotac_mj.discrepancy.recordings.confidence import clues, family
    from biotac_mj.discrepancy.recordings.report import verdict_dict

    began = time.process_time()
    recording = Recording(case.counts, case.force, case.tdc, case.rate)
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
                "right": right(e, case),
                "family": family(f),
                "clues": clues(f),
            }
        )
    weak = [
        {
            "id": f.id,
            "family": family(f),
            "clues": clues(f),
            "confidence": f.confidence,
            "right": right({"id": f.id, "ties": f.ties, "channels": [f"e{k + 1}" for k in f.channels]}, case),
        }
        for f in d.rejected
    ]
    return {
        "base": case.base,
        "force": case.force is not None,
        "truth": case.truth,
        "forms": case.forms,
        "channels": case.channels,
        "rows": len(case.counts),
        "seconds": time.process_time() - began,
        "verdict": verdict["verdict"],
        "named": named,
        "weak": weak,
        "unknown": d.rest.significant,
        "loaded": d.session.loaded,
        "rest": d.rest.clues,
        "closed": closed(d, case, clean),
        "views": {k: (v["before"], v["after"]) for k, v in d.gap.items()},
    }


# what cannot be had back: noise that was added, digits that were dropped
GONE = {"noise", "quantise", "lost"}
SHARED = {"warmup", "fluidloss", "count_offset", "thermal"}


def closed(diagnosis, case, clean: np.ndarray) -> float | None:
    """Share of the hidden change of the counts, on the part kept aside, that the right findings take out.

    A shared drift is taken out together with the one that the sensor has by itself, so the clean counts are
    amended alike before they are compared.
    """
    if not case.truth or len(clean) != len(case.counts) or GONE & set(case.truth):
        return None
    rows, rate = ~diagnosis.session.fit, case.rate
    hidden = np.sqrt(np.mean((case.counts - clean)[rows] ** 2))
    if hidden < 1e-9:
        return None

    def amended(d):
        mine = [f for f in d.findings if _named(f, case) not in (None, "natural")]
        if SHARED & set(case.truth):
            mine += [
                f for f in d.findings if len(f.channels) > 12 and f.correct is not None and f not in mine
            ]
        out = d.session.without(*(f for f in d.findings if f not in mine)).filled()
        for f in mine:
            if f.seen is not None and "delay" in f.seen[1]:
                out = f.seen[0].unsee(out, rate, f.seen[1])
        return out

    if SHARED & set(case.truth):
        from biotac_mj.discrepancy import Recording, diagnose_recording

        clean = amended(
            diagnose_recording(Recording(np.clip(np.rint(clean), 0, 4095), case.force, case.tdc, rate))
        )
    return float(1 - np.sqrt(np.mean((amended(diagnosis) - clean)[rows] ** 2)) / hidden)


def _named(finding, case):
    return right(
        {"id": finding.id, "ties": finding.ties, "channels": [f"e{k + 1}" for k in finding.channels]}, case
    )


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

    lines = [
        say("names that are right", sum(n["right"] is not None for n in names), len(names)),
        say("single effects named", sum(first(r) for r in single), len(single)),
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
    shares = [r["closed"] for r in single if r["closed"] is not None and first(r)]
    lines.append(
        f"gap closed on the part kept aside, named ones: median {np.median(shares):.0%}, quartiles "
        f"{np.quantile(shares, 0.25):.0%} {np.quantile(shares, 0.75):.0%}, {len(shares)} cases"
    )
    shares = [r["closed"] for r in single if r["closed"] is not None]
    lines.append(f"  all: median {np.median(shares):.0%}, {len(shares)} cases")
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
    edges = [0.6, 0.75, 0.85, 0.92, 0.97, 1.01]
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
    "shared": {"nats": 1, "size": 1, "lead": 1},
    "one": {"nats": 1, "stands": 1, "counts": 1, "turns": -1, "lead": 1},
    "answer": {"nats": 1, "factor": 1, "seconds": 1},
    "order": {"nats": 1, "ratio": 1, "left": -1},
    "samples": {"blocks": 1},
    "limit": {"nats": 1, "blocks": 1},
    "lost": {"ratio": 1, "score": 1},
    "line": {"score": 1, "amplitude": 1},
    "colour": {"ratio": 1},
    "pairs": {"share": 1, "kappa": 1},
    "common": {"share": 1, "kappa": 1},
    "size": {"factor": 1, "stands": 1},
    "force": {"gain": 1, "size": 1},
    "left_loaded": {"fast3": 1, "level1": 1, "aside3": 1},
    "left_unloaded": {"counts1": 1, "counts3": 1},
}


def fit(rows: list) -> dict:
    """Weights of the confidence's logistic functions, by family: ridge on standardised clues, signs kept."""
    from scipy.optimize import minimize

    out = {}
    everything = [n for r in rows for n in (*r["named"], *r["weak"])]
    for family, signs in CLUES.items():
        mine = [n for n in everything if n["family"] == family]
        if family.startswith("left"):  # effects without a name, against recordings without an effect
            mine = [
                {"clues": r["rest"], "right": "outside" if r["truth"] else None}
                for r in rows
                if (r["base"] == "pressed") == (family == "left_loaded")
                and (not r["truth"] or set(r["truth"]) & foreign.OUTSIDE)
            ]
        if not mine:
            continue
        x = np.array([[n["clues"].get(k, 0.0) for k in signs] for n in mine])
        y = np.array([n["right"] is not None for n in mine], float)
        mean, sd = x.mean(0), np.maximum(x.std(0), 0.1)
        z = (x - mean) / sd

        def loss(w, z=z, y=y, signs=signs):
            t = w[0] + z @ w[1:]
            return np.sum(np.logaddexp(0, t) - y * t) + 0.1 * np.sum(
                (w[1:] - np.array([*signs.values()])) ** 2
            )

        bounds = [(None, None), *((0, None) if s > 0 else (None, 0) for s in signs.values())]
        w = minimize(loss, np.zeros(1 + len(signs)), method="L-BFGS-B", bounds=bounds).x
        out[family] = {
            "intercept": float(w[0] - (w[1:] / sd) @ mean),
            "weights": dict(zip(signs, (w[1:] / sd).tolist())),
            "cases": len(mine),
            "right": int(y.sum()),
        }
    return out


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("data", nargs="?")
    args.add_argument("--half", choices=("practice", "blind", "mixed"), default="practice")
    args.add_argument(
        "--counts", default="9,5,20", help="recordings without effect on each base, of each effect, pairs"
    )
    args.add_argument("--only", nargs="*")
    args.add_argument("--json")
    args.add_argument("--fit", metavar="JSON")
    args = args.parse_args(argv)
    if args.fit:
        path = pathlib.Path(__file__).parents[1] / "biotac_mj/discrepancy/recordings/confidence.json"
        path.write_text(
            json.dumps(fit(json.loads(pathlib.Path(args.fit).read_text())["cases"]), indent=1) + "\n"
        )
        return
    path = pathlib.Path(args.json)
    rows = json.loads(path.read_text())["cases"] if path.exists() else []
    done = {tuple(r["key"]) for r in rows}
    sources = foreign.bases(args.data, args.half)
    cases = foreign.plan(args.half, *map(int, args.counts.split(",")))
    # in mixed order, so that a run that was stopped holds some of each
    for base, effects, seed in (cases[i] for i in np.random.default_rng(0).permutation(len(cases))):
        key = (base, "+".join(effects), seed)
        if key in done or args.only and not set(args.only) & {*effects, "none" if not effects else ""}:
            continue
        case, clean = foreign.make(args.half, sources, base, effects, seed)
        rows.append({"key": key, **judge(case, clean)})
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"code": code_hash(), "cases": rows}))
    print(table(rows))


if __name__ == "__main__":
    main()
