"""Counts of `discrepancy.py` against the bars, and the confusion matrix."""

import collections
import pathlib

import numpy as np
from discrepancy_generator import HIDDEN, OUTSIDE
from scipy.stats import binomtest

__all__ = ["answer", "confusion", "table"]

_MODULUS = 0.15  # of the logarithm of the generator's: so much is none of the stated one
_DETECTABLE = 10.0  # [nats per trajectory]


def answer(row) -> str:
    """The verdict in one word: the first name, "unknown" (also where names explain too little), or "no
    disagreement"."""
    if row["verdict"].startswith("no significant"):
        return "no disagreement"
    return "unknown" if "unknown" in row["verdict"] or not row["named"] else row["named"][0]


def right(row, k) -> bool:
    """Whether the k-th name given is hidden in the data, or stands tied with what is; a base of another
    modulus is."""
    base = {"modulus"} if abs(np.log(row["settings"]["modulus"])) > _MODULUS else set()
    return bool({row["named"][k], *row["ties"][k]} & {*row["truth"], *base})


def _share(hits, total) -> str:
    if not total:
        return "-"
    interval = binomtest(hits, total).proportion_ci(method="wilson")
    return f"{hits}/{total} = {hits / total:.0%} ({interval.low:.0%} .. {interval.high:.0%})"


def table(rows) -> str:
    """Counts with Wilson's 95 % intervals."""
    lines, by = [], collections.defaultdict(list)
    for r in rows:
        by[r["kind"]].append(r)
    judged = [r for r in rows if r["kind"] != "left-out"]
    given = [
        (r, k)
        for r in judged
        if answer(r) not in ("unknown", "no disagreement")
        for k in range(len(r["named"]))
    ]
    lines.append(
        f"a given name is right (ties count): {_share(sum(right(r, k) for r, k in given), len(given))}"
    )
    lines.append(
        f"  the name itself: {_share(sum(r['named'][k] in r['truth'] for r, k in given), len(given))}"
    )
    single = by["single"]
    for what, some in (
        ("all", single),
        ("10 nats per trajectory", [r for r in single if r["nats"] >= _DETECTABLE]),
    ):
        lines.append(
            f"single, {what}: top-1 {_share(sum(r['named'][:1] == r['truth'] for r in some), len(some))}"
        )
        lines.append(f"  with ties {_share(sum(bool(r['named']) and right(r, 0) for r in some), len(some))}, "
                     f"exactly it {_share(sum(r['named'] == r['truth'] for r in some), len(some))}, "
                     f"abstained {_share(sum(answer(r) == 'unknown' for r in some), len(some))}")  # fmt: skip
    for kind in ("none", "wrong-base"):
        some = by[kind]
        named = [r for r in some if any(not right(r, k) for k in range(len(r["named"])))]
        lines.append(
            f"{kind}: falsely named something {_share(len(named), len(some))}, "
            f"unhedged {_share(sum(any(not t for t in r['ties']) for r in named), len(some))}, "
            f"unknown {_share(sum(answer(r) == 'unknown' for r in some), len(some))}"
        )
    for kind in ("outside", "left-out"):
        some = by[kind]
        lines.append(
            f"{kind}: abstained {_share(sum(answer(r) == 'unknown' for r in some), len(some))}, "
            f"nothing seen {_share(sum(answer(r) == 'no disagreement' for r in some), len(some))}"
        )
    pair = by["pair"]
    lines.append(
        f"pairs: both {_share(sum(set(r['truth']) <= set(r['named']) for r in pair), len(pair))}, "
        f"exactly {_share(sum(set(r['truth']) == set(r['named']) for r in pair), len(pair))}, "
        "at least one "
        f"{_share(sum(bool(set(r['truth']) & set(r['named'])) for r in pair), len(pair))}"
    )
    closed = [r["closed"] for r in single + pair if answer(r) not in ("unknown", "no disagreement")]
    if closed:
        lines.append(
            f"gap closed on held-out trajectories: median {np.median(closed):.0%}, quartiles "
            f"{np.quantile(closed, 0.25):.0%} .. "
            f"{np.quantile(closed, 0.75):.0%}, of {len(closed)} cases with a name"
        )
    for law, same in (("same law", True), ("another law", False)):
        inside = _covered(single, same)
        lines.append(f"95 % intervals, {law}: {_share(sum(inside), len(inside))}")
    lines += [reliability(judged), *_rivals(judged), *_by_effect(single)]
    return "\n".join(lines)


def _rivals(rows):
    """Every method on the same cases: first name, false names, where (F1), and the modulus that it leaves."""
    rows = [r for r in rows if r["answers"]]
    lines = [f"methods, {len(rows)} cases:"] if rows else []
    for name in rows[0]["answers"] if rows else ():
        of = [(r, _given(r) if name == "ours" else r["answers"][name]["named"]) for r in rows]
        single, quiet = (
            [(r, n) for r, n in of if r["kind"] in kinds] for kinds in (("single",), ("none", "wrong-base"))
        )
        named = [(r, n) for r, some in of for n in some]
        false = sum(n not in r["truth"] for r, n in named)
        shown = [a for r, _ in of if r["truth"] for a in [r["answers"][name]]]
        bias = np.array([a["bias"] for r in rows if r["kind"] == "single" for a in [r["answers"][name]]])
        size = np.exp(np.median(np.abs(bias), axis=0)) - 1 if len(bias) else [np.nan] * 2
        lines.append(
            f"  {name}: first name right {_share(sum(n[:1] == r['truth'] for r, n in single), len(single))}, "
            f"names that are wrong {_share(false, len(named))}, "
            f"named where nothing is {_share(sum(bool(n) for _, n in quiet), len(quiet))}, "
            f"where: F1 {np.mean([a['f1'] for a in shown] or [np.nan]):.2f}, "
            f"modulus off by {size[0]:.1%} without, {size[1]:.1%} with what is named (median)"
        )
    return lines


def _given(row):
    return row["named"] if answer(row) not in ("unknown", "no disagreement") else []


def _by_effect(rows):
    """What became of every single effect, form by form."""
    by = collections.defaultdict(list)
    for r in rows:
        by[r["truth"][0]].append(
            f"{r['forms'][0]} {answer(r)}{'' if not r['named'] or right(r, 0) else ' (wrong)'}"
        )
    return [f"  {name}: {'; '.join(sorted(found))}" for name, found in sorted(by.items())]


def _covered(rows, same):
    out = []
    for r in rows:
        for name, values in zip(r["named"], r["parameters"]):
            for key, (truth, alike) in r["comparable"].get(name, {}).items():
                if alike == same:
                    out.append(values[key][1] <= truth <= values[key][2])
    return out


def reliability(rows) -> str:
    """Brier score and expected calibration error of the stated confidence that a name is right, over names
    given."""
    pairs = [
        (c, r["named"][k] in r["truth"])
        for r in rows
        if answer(r) not in ("unknown", "no disagreement")
        for k, c in enumerate(r["confidence"])
    ]
    if not pairs:
        return "confidence: no names"
    c, hit = np.array(pairs, float).T
    bins = np.clip((c * 5).astype(int), 0, 4)
    error = sum(
        abs(c[bins == b].mean() - hit[bins == b].mean()) * (bins == b).mean()
        for b in range(5)
        if (bins == b).any()
    )
    shown = ", ".join(
        f"{c[bins == b].mean():.2f} -> {hit[bins == b].mean():.2f} ({(bins == b).sum()})"
        for b in range(5)
        if (bins == b).any()
    )
    return (
        f"confidence -> share right: {shown}; "
        f"Brier {np.mean((c - hit) ** 2):.3f}, calibration error {error:.3f}"
    )


def confusion(rows, path):
    """Truth against the first name, as a figure."""
    from matplotlib.figure import Figure

    truths = [*HIDDEN, *OUTSIDE, "none", "wrong-base"]
    shown = [r for r in rows if r["kind"] not in ("pair", "left-out")]
    names = [
        *HIDDEN,
        *sorted({answer(r) for r in shown} - set(HIDDEN) - {"unknown", "no disagreement"}),
        "unknown",
        "no disagreement",
    ]
    matrix = np.zeros((len(truths), len(names)), int)
    for r in shown:
        matrix[truths.index(r["truth"][0] if r["truth"] else r["kind"]), names.index(answer(r))] += 1
    figure = Figure(figsize=(7.4, 7.6), layout="constrained")
    ax = figure.subplots()
    ax.imshow(matrix / np.maximum(matrix.sum(1, keepdims=True), 1), cmap="Blues", vmax=1.4)
    for i, j in zip(*np.nonzero(matrix)):
        ax.text(j, i, matrix[i, j], ha="center", va="center", fontsize=8)
    ax.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    ax.set_yticks(range(len(truths)), truths, fontsize=8)
    ax.axhline(len(HIDDEN) - 0.5, color="0.6", lw=0.7)
    ax.axvline(len(HIDDEN) - 0.5, color="0.6", lw=0.7)
    ax.set_xlabel("first name given, or abstention")
    ax.set_ylabel("hidden (synthetic data)")
    tiers, seeds = ({r[k] for r in shown} for k in ("tier", "seeds"))
    ax.set_title(
        f"{len(shown)} cases without pairs; seeds {', '.join(seeds)}; tier {', '.join(tiers)}", fontsize=9
    )
    pathlib.Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
