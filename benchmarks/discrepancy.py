"""Blind benchmark of the discrepancy workflow: hidden effects, none, pairs, outside the catalogue, and a mildly wrong base model.

    python benchmarks/discrepancy.py --seeds practice --kinds none single --count 1 --json out/discrepancy.json

Every case is drawn, measured by `discrepancy_generator` and sealed (a hash of the truth is printed before its verdict); run again, it
goes on
where it stopped. Beside the verdicts stand two baselines: least RMS in sample, and BIC with samples taken as independent.
"""

import argparse
import collections
import hashlib
import json
import pathlib

import numpy as np
from discrepancy_generator import HIDDEN, OUTSIDE, Generator, plan

SEEDS = {"development": 0, "practice": 10_000, "blind": 700_000}
KINDS = ("none", "single", "outside", "pair", "wrong base")


def cases(kinds, count, seeds):
    """(kind, name, effects, seed, generator settings)."""
    out = []
    for kind in kinds:
        if kind not in KINDS:
            raise ValueError(f"unknown kind {kind!r}: choose from {', '.join(KINDS)}")
        table = {"single": list(HIDDEN), "outside": list(OUTSIDE)}.get(kind, [kind])
        for name in table:
            for i in range(count):
                seed = SEEDS[seeds] + int(hashlib.sha256(f"{kind}{name}{i}".encode()).hexdigest()[:6], 16) % 9_000
                rng = np.random.default_rng(seed)
                settings = {"modulus": float(rng.uniform(0.85, 1.15)), "skin": "coarse", "footprint": 0.0}
                if kind == "wrong base":
                    settings.update({"skin": "default"} if i % 2 else {"footprint": 0.05})
                names = {"single": [name], "outside": [name], "pair": list(rng.choice(list(HIDDEN), 2, replace=False))}.get(kind, [])
                sizes = {**HIDDEN, **OUTSIDE}
                effects = [(str(n), float(np.exp(rng.uniform(*np.log(sizes[n]))))) for n in names]
                out.append((kind, f"{kind}: {name} #{i}", effects, seed, settings))
    return out


def baselines(comparison, chosen):
    """Names by least RMS in sample and by BIC with every sample independent, both on the linearised signatures."""
    from biotac_mj.discrepancy.catalogue import CATALOGUE
    from biotac_mj.discrepancy.fitting import fit_effects
    from biotac_mj.discrepancy.workflow import _columns, _nuisance

    null = fit_effects(comparison, [], chosen)
    base = null.residuals(comparison)
    q = _nuisance(comparison, null, base, chosen)
    y = np.concatenate([base[i].ravel() for i in chosen])
    y = y - q @ (q.T @ y)
    out = []
    for effect in CATALOGUE:
        if effect.applicable([comparison.trajectories[i] for i in chosen]):
            continue
        for shape in effect.grid:
            S = _columns(comparison, null, effect, shape, base, chosen)
            S = S - q @ (q.T @ S)
            w, *_ = np.linalg.lstsq(S, y, rcond=None)
            rss = float(((y - S @ w) ** 2).sum())
            out.append((rss, len(y) * np.log(rss / len(y)) + S.shape[1] * np.log(len(y)), effect.id))
    none = len(y) * np.log(float(y @ y) / len(y))
    best = min(out, key=lambda o: o[1])
    return min(out)[2], best[2] if best[1] < none else "none"


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("--kinds", nargs="+", default=list(KINDS), metavar="KIND")
    args.add_argument("--count", type=int, default=1, help="cases of each effect, or of the kind")
    args.add_argument("--seeds", choices=SEEDS, default="development")
    args.add_argument("--trajectories", type=int, default=16)
    args.add_argument("--cache", default="out/discrepancy_fields")
    args.add_argument("--json", default="out/discrepancy.json")
    args.add_argument("--figure", default="out/discrepancy.png")
    args.add_argument("--no-baselines", action="store_true")
    args = args.parse_args(argv)
    from biotac_mj.discrepancy import Simulator, Trajectory, diagnose
    from biotac_mj.discrepancy.workflow import threshold_hash

    path = pathlib.Path(args.json)
    rows = json.loads(path.read_text()) if path.exists() else []
    done = {(r["case"], r["seeds"], r["thresholds"]) for r in rows}
    plans = plan(5, args.trajectories)
    sim = Simulator(cache=args.cache)
    generators, fields = {}, None
    print(f"thresholds {threshold_hash()}")
    for kind, name, effects, seed, settings in cases(args.kinds, args.count, args.seeds):
        if (name, args.seeds, threshold_hash()) in done:
            continue
        seal = hashlib.sha256(json.dumps([effects, settings, seed]).encode()).hexdigest()[:12]
        key = settings["skin"]
        if key not in generators:
            generators[key] = Generator(key)
        generator = generators[key]
        generator.modulus, generator.footprint = settings["modulus"], settings["footprint"]
        measured = generator.measure(plans, effects, seed)
        data = [
            Trajectory(p["id"], p["tool"], p["clock"], p["time"], p["pos"], np.tile(p["turn"], (len(p["time"]), 1, 1)), e, pdc, None, f)
            for p, (e, pdc, f) in zip(plans, measured)
        ]
        fields = sim.fields(data, progress=False) if fields is None else fields
        report = diagnose(sim, data, fields=fields, progress=False)
        named = [e["id"] for e in report.effects]
        ties = sorted({t for e in report.effects for t in e["ties"]})
        least, bic = ("", "") if args.no_baselines else baselines(report.comparison, report.selection)
        rows.append(
            {
                "case": name, "kind": kind, "seeds": args.seeds, "thresholds": threshold_hash(), "seal": seal, "verdict": report.verdict, "named": named,  # noqa: E501
                "ties": ties, "truth": [e for e, _ in effects], "sizes": [s for _, s in effects], "settings": settings, "closed": report.closed,  # noqa: E501
                "nats": report.ranking[0][1] if report.ranking else 0.0, "confidence": [e["confidence"] for e in report.effects],
                "least_rms": least, "bic": bic,
            }
        )  # fmt: skip
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".tmp")
        temporary.write_text(json.dumps(rows, indent=1))
        temporary.replace(path)
        print(f"{seal} {name:<28} {report.verdict[:110]} | least RMS {least}, BIC {bic}", flush=True)
    rows = [r for r in rows if r["seeds"] == args.seeds and r["thresholds"] == threshold_hash()]
    print(table(rows))
    confusion(rows, args.figure)


def table(rows) -> str:
    """Counts against the bars."""
    lines = []
    by = collections.defaultdict(list)
    for r in rows:
        by[r["kind"]].append(r)
    single = by["single"]
    given = [r for r in rows if r["named"] and "unknown" not in r["verdict"]]
    right = [r for r in given if r["named"][0] in r["truth"] or set(r["ties"]) & set(r["truth"])]
    lines.append(f"a given name is right: {len(right)}/{len(given)}")
    if single:
        strong = [r for r in single if r["nats"] >= 10]
        lines.append(f"top-1, single effects: {sum(r['named'][:1] == r['truth'] for r in single)}/{len(single)}")
        lines.append(f"  of them 10 nats per trajectory: {sum(r['named'][:1] == r['truth'] for r in strong)}/{len(strong)}")
        lines.append(
            f"  baseline least RMS: {sum([r['least_rms']] == r['truth'] for r in single)}/{len(single)}, BIC: {sum([r['bic']] == r['truth'] for r in single)}/{len(single)}"  # noqa: E501
        )
        closed = [r["closed"] for r in single if r["closed"] == r["closed"] and r["named"]]
        lines.append(f"  gap closed on trajectories kept aside, median: {np.median(closed):.0%}" if closed else "  nothing named")
    for kind in ("none", "wrong base"):
        if by[kind]:
            named = sum(bool(r["named"]) for r in by[kind])
            lines.append(
                f"{kind}: named something {named}/{len(by[kind])}; BIC {sum(r['bic'] not in ('none', '') for r in by[kind])}, least RMS always"  # noqa: E501
            )
    if by["outside"]:
        lines.append(f"outside the catalogue: abstained {sum('unknown' in r['verdict'] for r in by['outside'])}/{len(by['outside'])}")
    if by["pair"]:
        lines.append(f"pairs: both named {sum(set(r['truth']) <= set(r['named']) for r in by['pair'])}/{len(by['pair'])}, "
                     f"one {sum(bool(set(r['truth']) & set(r['named'])) for r in by['pair'])}/{len(by['pair'])}")  # fmt: skip
    return "\n".join(lines)


def confusion(rows, path):
    """Truth against the first name, as a figure."""
    from matplotlib.figure import Figure

    truths = [*HIDDEN, *OUTSIDE, "none", "wrong base"]
    names = sorted({r["named"][0] for r in rows if r["named"]} | set(HIDDEN)) + ["unknown", "no disagreement"]
    matrix = np.zeros((len(truths), len(names)), int)
    for r in rows:
        if r["kind"] == "pair":
            continue
        truth = r["truth"][0] if r["truth"] else r["kind"]
        name = (
            "no disagreement"
            if r["verdict"].startswith("no significant")
            else "unknown"
            if r["verdict"].startswith("unknown") or not r["named"]
            else r["named"][0]
        )
        matrix[truths.index(truth), names.index(name)] += 1
    figure = Figure(figsize=(9, 7), layout="constrained")
    ax = figure.subplots()
    ax.imshow(matrix, cmap="Blues")
    for i, j in zip(*np.nonzero(matrix)):
        ax.text(j, i, matrix[i, j], ha="center", va="center", fontsize=8)
    ax.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    ax.set_yticks(range(len(truths)), truths, fontsize=8)
    ax.set_xlabel("first name given")
    ax.set_ylabel("hidden (synthetic data)")
    pathlib.Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
