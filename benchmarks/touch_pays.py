"""What touch buys: policies of three tasks, each with six kinds of touch, and what is left of them on another
skin and another sensor.

    python benchmarks/touch_pays.py --json out/touch_pays.json --device cuda:0 [--tasks insert_peg ...]
        [--observe electrodes none ...] [--seeds 0 1 2 3 4] [--worlds 512] [--minutes 10] [--policies DIR]
        [--hand DIR/shadow_hand/right_hand.xml] [--transfer 64 [--to tier]]
    python benchmarks/touch_pays.py --score out/policies --transfer 16 --json OUT     # of policies that are
    python benchmarks/touch_pays.py --table OUT [OUT ...] [--draw FILE.png]

The policies of a task learn side by side, in shares of one batch, for --minutes in all; those that feel
learned electrodes in a batch of their own. Success is that of one more episode in each world, from beginnings
that no policy has seen, without exploration; its interval is Wilson's, of 95 %.

--transfer N: the same policies, side by side in N worlds each, with the default skin in the full tier, on
other random sensors with another gain of PDC and three effects that learning did not have (UNSEEN). --to tier
changes the tier alone, --to skin the tier and the skin."""

import argparse
import functools
import gc
import itertools
import json
import pathlib
import sys
import time

sys.path.insert(0, str(pathlib.Path(__file__).parent))

__all__ = ["CHANGES", "UNSEEN", "draw", "main", "table", "transfer"]

UNSEEN = ("dead", "crosstalk", "relax")
_TIER = {"tier": "full"}
_SKIN = {"skin": "default", **_TIER}
CHANGES = {
    "tier": _TIER,
    "skin": _SKIN,
    "sensor": {"sensor": "random", "randomise": (*UNSEEN, "pdc_gain"), **_SKIN},
}  # of the environment in which a policy learned


def transfer(paths: list[pathlib.Path], worlds: int, to: str = "sensor", **own: object) -> list[dict]:
    """Scores of policies of one task in other worlds, in which they play side by side; those that feel
    learned electrodes in worlds of their own.

    Args:
      paths: of the policies. worlds: of each. to: of CHANGES. own: further keywords of `make`.
    """
    from biotac_mj.tasks.batched.playing import HELD_OUT, acting, env_of, play
    from biotac_mj.tasks.batched.policy import read_card

    found, cards = [], {path: read_card(path) for path in sorted(paths)}
    for learned in (False, True):
        some = [path for path, card in cards.items() if (card["observe"] == "learned") == learned]
        if not some:
            continue
        signal = "learned" if learned else "electrodes"
        more = {"seed": HELD_OUT, **CHANGES[to], **own}
        env = env_of(cards[some[0]], worlds * len(some), observe=signal, **more)
        acts = []
        for i, path in enumerate(some):
            own_worlds = slice(i * worlds, (i + 1) * worlds)
            act = acting(cards[path]["task"], path, env.device)[1]
            acts.append((own_worlds, functools.partial(_in_worlds, act, own_worlds)))
        for path, score in zip(some, play(env, acts), strict=True):
            found.append({name: cards[path][name] for name in ("task", "observe", "seed")} | score)
    return found


def _in_worlds(act, worlds, env):
    return act(env)[worlds]


def table(found: dict) -> str:
    """What was found, in Markdown."""
    moved = {(r["task"], r["observe"], r["seed"]): r for r in found.get("transfer", [])}
    lines = [
        f"{found['device']}; success, 95 % interval\n",
        "| task | observe | seed | minutes | decisions | success | other skin and sensor |",
        "|---|---|---|---|---|---|---|",
    ]
    for card in found["policies"]:
        name = card["task"], card["observe"], card["seed"]
        cells = [*map(str, name), f"{card['minutes']:.1f}", str(card["decisions"]), _rate(card)]
        lines.append(f"| {' | '.join([*cells, _rate(moved[name]) if name in moved else ''])} |")
    lines += [
        "",
        "| task | observe | all seeds | lowest and highest seed | against none: p | other skin, sensor |",
        "|---|---|---|---|---|---|",
    ]
    groups = {}
    for card in found["policies"]:
        groups.setdefault((card["task"], card["observe"]), []).append(card)
    for name, cards in groups.items():
        seeds = [c["success"] for c in cards if "success" in c] or [float("nan")]
        there = [moved[n] for c in cards if (n := (*name, c["seed"])) in moved]
        cells = [*name, _rate(_pooled(cards)), f"{min(seeds):.2f}, {max(seeds):.2f}"]
        cells += [_against(cards, groups.get((name[0], "none"))), _rate(_pooled(there))]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def draw(found: dict, path: pathlib.Path) -> None:
    """A picture of success by task and kind of touch: all seeds with their interval, each seed, and what is
    left on the other skin and sensor."""
    from matplotlib.figure import Figure

    from biotac_mj.tasks.batched import OBSERVE

    there, tasks = (list(dict.fromkeys(c[name] for c in found["policies"])) for name in ("observe", "task"))
    kinds = [kind for kind in OBSERVE if kind in there]
    groups = {"policies": found["policies"], "transfer": found.get("transfer", [])}
    figure = Figure(figsize=(2.6 * len(tasks) + 1.0, 3.2), layout="constrained")
    for axis, task in zip(figure.subplots(1, len(tasks), sharey=True, squeeze=False)[0], tasks, strict=True):
        for row, kind in enumerate(kinds):
            for part, color, shift in (("policies", "C0", 0.0), ("transfer", "C1", 0.25)):
                some = [s for s in groups[part] if (s["task"], s["observe"]) == (task, kind)]
                score = _pooled(some)
                if not score:
                    continue
                axis.barh(row + shift, score["success"], 0.22, color=color, alpha=0.5)
                axis.plot([score["low"], score["high"]], 2 * [row + shift], color=color, lw=2)
                seeds = [s["success"] for s in some if "success" in s]
                axis.plot(seeds, len(seeds) * [row + shift], "k.", ms=4)
        axis.set(title=task, xlim=(0, 1), ylim=(len(kinds) - 0.5, -0.5), xlabel="success")
        axis.set_yticks(range(len(kinds)), kinds)
    told = "as it learned" + (" (blue), other skin and sensor (orange)" if groups["transfer"] else "")
    figure.suptitle(f"Synthetic sensors, {found['device']}; {told}", fontsize=9)
    figure.savefig(path, dpi=120)


def _rate(score):
    if "success" not in score:
        return "not played"
    return f"{score['success']:.2f} ({score['low']:.2f} to {score['high']:.2f})"


def _pooled(scores):
    """One score of the episodes of all seeds."""
    from biotac_mj.tasks.batched.playing import interval

    played = [score for score in scores if "success" in score]
    count = sum(score["episodes"] for score in played)
    return interval(sum(map(_hits, played)), count) if count else {}


def _hits(score):
    return round(score["success"] * score["episodes"])


def _against(cards, none):
    """Of seeds, where there are several (paired t test of their rates), else of the episodes (Fisher's)."""
    from scipy.stats import fisher_exact, ttest_rel

    if not none or cards is none:
        return ""
    rates = [{c["seed"]: c["success"] for c in group if "success" in c} for group in (cards, none)]
    both = sorted(rates[0].keys() & rates[1].keys())
    if len(both) > 1:
        columns = ([rate[seed] for seed in both] for rate in rates)
        return f"{ttest_rel(*columns, alternative='greater').pvalue:.2g}"
    pairs = [_pooled(group) for group in (cards, none)]
    if not all(pairs):
        return ""
    counts = [[_hits(score), score["episodes"] - _hits(score)] for score in pairs]
    return f"{fisher_exact(counts, 'greater').pvalue:.2g}"


def _learn(options, tasks, own, written):
    """Trains what is wanted, task by task; cards."""
    from biotac_mj.tasks.batched.training import of_runs, train

    cards = []
    for task in tasks:
        own_batch = [o for o in options.observe if o == "learned"]
        for some in filter(None, ([o for o in options.observe if o not in own_batch], own_batch)):
            runs = list(itertools.product(some, options.seeds))
            begin = time.perf_counter()
            env = of_runs(task, runs, options.worlds, options.device, own.get(task, {}).get("hand"))
            about = {"setup_s": round(time.perf_counter() - begin, 1)}
            where = options.minutes, options.policies, about, options.resume, options.taught
            cards += train(env, task, runs, *where)
            written(cards)
            del env
            gc.collect()  # the next task takes the device's memory
    return cards


def _joined(files):
    """What several files have, each policy once."""
    found = dict(files[0])
    for part in ("policies", "transfer"):
        every = {(r["task"], r["observe"], r["seed"]): r for file in files for r in file.get(part, [])}
        found[part] = list(every.values())
    return found


def main(arguments=None) -> int:
    from biotac_mj.cli.names import TASKS

    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", type=pathlib.Path, help="file to write")
    parser.add_argument("--table", type=pathlib.Path, nargs="+", help="print the table of files, and end")
    parser.add_argument("--draw", type=pathlib.Path, help="with --table, a picture to write")
    parser.add_argument("--score", type=pathlib.Path, help="folder of policies that are scored, not trained")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--observe", nargs="+", default=["electrodes", "none"], help="kinds of touch")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--worlds", type=int, default=512, help="of each policy")
    parser.add_argument("--minutes", type=float, default=10.0, help="of learning, of each task")
    parser.add_argument("--taught", type=float, default=0.7, help="part of it in which policies imitate")
    parser.add_argument("--device", help="of Warp")
    parser.add_argument("--policies", type=pathlib.Path, default=pathlib.Path("out/policies"), help="folder")
    parser.add_argument("--resume", action="store_true", help="go on from what is in --policies")
    parser.add_argument("--hand", type=pathlib.Path, help="shadow_hand/right_hand.xml of MuJoCo Menagerie")
    parser.add_argument("--transfer", type=int, default=0, help="worlds of another skin and sensor")
    parser.add_argument("--to", choices=CHANGES, default="sensor", help="the last change of --transfer")
    options = parser.parse_args(arguments)
    if options.table:
        found = _joined([json.loads(path.read_text(encoding="utf-8")) for path in options.table])
        print(table(found))
        if options.draw:
            draw(found, options.draw)
        return 0
    if options.json is None:
        parser.error("--json FILE to write, or --table FILE to print")
    import warp as wp
    from records import write_json

    from biotac_mj.tasks.batched.policy import read_card

    own = {"roll_rod": {"hand": options.hand}} if options.hand else {}
    found = {"device": wp.get_device(options.device).name, "worlds": options.worlds, "policies": []}

    def written(cards):
        found["policies"] = cards
        write_json(options.json, found)

    folder = options.score or options.policies
    if not options.score:
        _learn(options, options.tasks, own, written)
    else:
        paths = sorted(folder.glob("*.safetensors"))
        written([card for path in paths if (card := read_card(path))["task"] in options.tasks])
    if options.transfer:
        found["transfer"] = []
        for task in options.tasks:
            paths = sorted(folder.glob(f"{task}-*.safetensors"))
            more = {"device": options.device, **own.get(task, {})}
            found["transfer"] += transfer(paths, options.transfer, options.to, **more) if paths else []
            written(found["policies"])
    print(table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
