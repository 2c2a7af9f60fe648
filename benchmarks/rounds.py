"""Rounds of experiments on hidden laboratories: contacts that `biotac next` designs against random ones.

    python benchmarks/hidden_lab.py --seal 12 --seed 7 --out labs/
    python benchmarks/rounds.py labs/ --first 12 --more 6 --rounds 3 --jobs 60 --minutes 8 --json OUT

Round 1 is random and the same for all; each further round takes as many contacts from one pool within the
same bounds, by design or at random, each at most twice, unless one explanation is decided. A name is right
where a hidden effect's id is among _MEANT; that of a modulus is where the laboratory's is another one. After
each round the gap is measured with a tool and at a place that no round touches as well. Run again, it goes on
where it stopped; what is not done after --minutes is counted as far as it came."""

import argparse
import concurrent.futures
import dataclasses
import functools
import json
import multiprocessing
import pathlib
import time

import numpy as np
from hidden_lab import carried_out, clean, generator_of, off, opened, read_plan
from poses_blind import MEANT, gap
from records import read_json, write_json

ARMS = "designed", "random"
# The generator's drifts are those of all electrodes within a trajectory.
_MEANT = MEANT | {"drift": {"drift"}}
_OTHER_TOOL, _UNTOUCHED, _UNSEEN = "geom:sphere:0.005", (-3.5e-3, -1e-3), 4  # [m] along; contacts there
_BIN = 15  # names whose stated confidence is set beside how many are right
_OTHER_MODULUS = 0.15  # of its logarithm, from which on it is another one


def _trajectories(contacts, readings, name):
    from biotac_mj.discrepancy import Trajectory

    return [
        Trajectory(
            f"{name}-{c['id']}",
            c["tool"],
            c["clock"],
            c["time"],
            c["pos"],
            np.tile(c["turn"], (len(c["time"]), 1, 1)),
            electrodes,
            pdc,
            None,
            force,
        )
        for c, (electrodes, pdc, force) in zip(contacts, readings)
    ]


def _plan(contacts, clock):
    """These contacts in their order."""
    from biotac_mj.discrepancy.trajectories.contacts import trajectory_of
    from biotac_mj.discrepancy.trajectories.design import Plan, Planned

    out = []
    for contact, at, mat in contacts:
        one = trajectory_of(contact, at, mat, clock, f"contact{len(out) + 1}", 19)
        clock += float(one.time[-1]) + 4.0
        out.append(Planned(contact, one, "given"))
    return Plan(out, {}, [])


def _record(report, seconds):
    beliefs = report.beliefs
    return {
        "verdict": report.verdict,
        "named": [[e.id, *e.ties] for e in report.effects],
        "confidence": [e.confidence for e in report.effects],
        "suspected": [[e.id, e.confidence] for e in report.not_named if e.confirmed],
        "closed": report.closed,
        "decided": beliefs.decided,
        "explanations": [[one.ids, one.weight] for one in beliefs.explanations],
        "tried": [
            [
                {"id": one.effect.id, "overlap": one.fit.overlap}
                | {key: getattr(one, key) for key in ("gain", "p", "rejections", "ties")}
                for one in step
            ]
            for step in report.search.rounds
        ],
        "contacts": len(report.selection) + len(report.locked),
        "seconds": seconds,
    }


def in_place(report, data):
    """What stands in place of the effects that a report names, on other trajectories: per trajectory
    (n, width) what constants alone, fitted again, do more than those beside the effects, and the same with a
    Gaussian process of what they leave of the fitted trajectories."""
    from biotac_mj.discrepancy.trajectories.likelihood import kernel

    c, null, fields = report.comparison, report.null, report.comparison.sim.fields(data, progress=False)
    alone, beside = (
        c.predict(c.sim.run(data, fields, False, nuisance=fit.nuisance)) for fit in (null, report.fit)
    )
    constants = [a - b for a, b in zip(alone, beside)]
    known, left = ([of[i] for i in report.selection] for of in (c.trajectories, null.posed(c)))
    left = np.concatenate([one * c.sigmas[i] for one, i in zip(left, report.selection)])
    every = kernel(known + data, [np.arange(len(t.time)) for t in known + data])
    own, across = every[: len(left), : len(left)], every[len(left) :, : len(left)]
    noise = (c.noises / (null.amplitude * null.size)) ** 2
    values, vectors = np.linalg.eigh(own)
    process = across @ vectors @ ((vectors.T @ left) / (np.maximum(values, 0.0)[:, None] + noise))
    parts = np.split(process, np.cumsum([len(t.time) for t in data])[:-1])
    return constants, [a + b for a, b in zip(constants, parts)]


def _share(hidden, said, noise):
    """Share of what is hidden (n, width) per trajectory that is said, by their noise (width,)."""
    left, before = (
        sum((((h - by * s) / noise) ** 2).sum() for h, s in zip(hidden, said)) for by in (1.0, 0.0)
    )
    return float(1 - np.sqrt(left / before))


def _contacts(args):
    """The simulator, bounds, and contacts of round 1, of the pool, and of the tool and place that no round
    touches."""
    from biotac_mj.discrepancy import Simulator
    from biotac_mj.discrepancy.trajectories.contacts import Bounds, drawn

    sim = Simulator(skin="coarse", tier="condensed", cache=str(args.cache))
    bounds = Bounds(force=2.0, depth=1.3e-3, tools=("sphere_7mm", "sphere_14mm"))
    other = dataclasses.replace(bounds, tools=(_OTHER_TOOL,), reach=_UNTOUCHED)
    asked = (bounds, args.first, 1), (bounds, args.pool, 2), (other, _UNSEEN, 3)
    return sim, bounds, *(drawn(sim, *one) for one in asked)


def solved(number, args):
    """Solves the skin of one contact of all, which the cache keeps."""
    sim, _, begin, pool, unseen = _contacts(args)
    sim.fields([_plan([(begin + pool + unseen)[number]], 0.0).contacts[0].trajectory], progress=False)
    return number


def run(task, args):
    """Rounds of (a laboratory, an arm); as far as they have come they lie beside the results."""
    path, arm = task
    from biotac_mj.discrepancy import diagnose
    from biotac_mj.discrepancy.trajectories.design import planned
    from biotac_mj.discrepancy.trajectories.plan_files import write_poses

    sensor = opened(path.read_bytes())
    lab = generator_of(sensor, "coarse", "condensed")
    sim, bounds, begin, pool, unseen = _contacts(args)
    number, free = int(path.stem.split("_")[1]), {}  # of noise, with and without what is hidden

    def measured(plan, turn, kind=arm):
        file = args.cache / f"{path.stem}_{kind}_{turn}.csv"
        write_poses(plan, file)
        contacts = read_plan(file)
        name = f"{kind}{turn}"
        both = (
            _trajectories(contacts, clean(lab, sensor, contacts, turn, effects), name)
            for effects in (True, False)
        )
        free.update((a.id, (a, b, slip)) for a, b, slip in zip(*both, off(sensor, contacts, turn)))
        return _trajectories(contacts, carried_out(lab, sensor, contacts, turn), name)

    def hidden(t):
        """(n, width) what is hidden in a trajectory."""
        shown, bare = (np.column_stack([one.electrodes, one.pdc, one.force]) for one in free[t.id][:2])
        return shown - bare

    def closed(report, data, ids, posed=False):
        """Share of what is hidden in some trajectories (ids) of data that the amended sensor repeats; posed:
        where the objects were, and not where they were meant to be."""
        shown, bare, slip = zip(*(free[t.id] for t in data))
        # the base is the sensor's own
        return gap(
            shown, bare, report.apply(sim), ids, False, report.comparison.noise, slip if posed else None
        )

    def judged(data, turn):
        began = time.process_time()
        report = diagnose(sim, data, progress=False)
        record = _record(report, time.process_time() - began)
        if report.effects and sensor["effects"]:  # of nothing hidden there is no share
            record["true"] = closed(report, data, {data[i].id for i in report.locked})
            other = measured(_plan(unseen, _end(data)), turn, "unseen")
            for key, posed in (("unseen", True), ("unseen_meant", False)):
                record[key] = closed(report, other, {t.id for t in other}, posed)
            rest = np.mean([hidden(t)[0] for t in data], axis=0)  # about which all is compared
            about = [hidden(t) - rest for t in other]
            some = in_place(report, other)
            record["in_place"] = [_share(about, said, report.comparison.noises) for said in some]
        return report, record

    row = {"lab": path.stem, "arm": arm, "truth": sensor}
    first = _part(args, path, ARMS[0])
    same = json.loads(first.read_text())["rounds"][0] if arm != ARMS[0] and first.exists() else None
    if same is not None and same["decided"]:  # as the other arm ended
        return row | {"rounds": [same] * args.rounds}
    data = measured(_plan(begin, 0.0), 1, "first")
    report, record = judged(data, 1) if same is None else (None, same)
    row["rounds"] = [record]
    for turn in range(2, args.rounds + 1):
        write_json(_part(args, path, arm), row)  # a run may be cut off
        if row["rounds"][-1]["decided"]:
            row["rounds"].append(row["rounds"][-1])
            continue
        began = time.process_time()
        if arm == ARMS[0]:
            plan = planned(report.beliefs, sim, bounds, args.more, pool, progress=False)
        else:
            picked = np.random.default_rng([number, turn]).choice(2 * len(pool), args.more, replace=False)
            plan = _plan([pool[k % len(pool)] for k in picked], _end(data))
        design = time.process_time() - began
        if plan.contacts:
            data = data + measured(plan, turn)
        report, record = judged(data, turn)
        row["rounds"].append(record | {"design_seconds": design, "alike": plan.alike})
        print(path.stem, arm, turn, record["verdict"][:80], flush=True)
    write_json(_part(args, path, arm), row)
    return row


def _part(args, path, arm):
    """Where a laboratory's rounds lie as far as they have come."""
    return pathlib.Path(args.json).with_suffix("") / f"{path.stem}_{arm}.json"


def _end(data):
    """When a further round may begin [s]."""
    return max(t.clock + t.time[-1] for t in data) + 60.0


def counted(rows):
    """Per arm and round: names right and given, singles found, both of pairs, decided rightly and wrongly,
    false names, unknown outside the catalogue, and the median gap closed on held-out contacts and by another
    tool elsewhere."""
    table = {}
    for arm in ARMS:
        own = [r for r in rows if r["arm"] == arm]
        for turn in range(max((len(r["rounds"]) for r in own), default=0)):
            some = [(r["rounds"][turn], r["truth"]) for r in own if len(r["rounds"]) > turn]
            table[f"{arm}, round {turn + 1}"] = _counted(some)
        last = [(r["rounds"][-1], r["truth"]) for r in own]
        table[f"{arm}, as far as it came"] = _counted(last) | _stated(last)
    return table


def _judged(record, truth):
    """Names [(ids, confidence)] that count, what is hidden, whether each name is right, and whether each
    hidden effect is named."""
    want = [] if truth["kind"] == "outside" else [_MEANT.get(e[0], {e[0]}) for e in truth["effects"]]
    other = abs(np.log(truth["base"]["modulus"])) > _OTHER_MODULUS
    named = [(set(ids), sure) for ids, sure in zip(record["named"], record["confidence"])]
    named = [(ids, sure) for ids, sure in named if not (other and "modulus" in ids)]
    right = [any(ids & w for w in want) for ids, _ in named]
    return named, want, right, [any(ids & w for ids, _ in named) for w in want]


def _stated(some):
    """Of bins of names, the least sure first: mean confidence that is stated, and share that is right."""
    names = []
    for record, truth in some:
        named, _, right, _ = _judged(record, truth)
        names += [(sure, ok) for (_, sure), ok in zip(named, right) if sure is not None]
    names.sort()
    bins = [names[k : k + _BIN] for k in range(0, len(names), _BIN)]
    return {"stated": [[round(float(v), 3) for v in np.mean(one, axis=0)] for one in bins]}


def _counted(some):
    keys = "labs right names found singles both pairs decided wrongly false clean unknown outside contacts"
    c = dict.fromkeys(keys.split(), 0)
    for record, truth in some:
        kind = truth["kind"]
        named, want, right, found = _judged(record, truth)
        best = set(record["explanations"][0][0])
        true = len(best) == len(want) and all(best & w for w in want) and kind != "outside"
        c["labs"] += 1
        c["contacts"] += record["contacts"]
        c["right"] += sum(right)
        c["names"] += len(right)
        c["found"] += kind == "single" and all(found)
        c["singles"] += kind == "single"
        c["both"] += kind == "pair" and all(found)
        c["pairs"] += kind == "pair"
        c["decided"] += bool(record["decided"] and true)
        c["wrongly"] += bool(record["decided"] and not true)
        c["clean"] += kind in ("none", "wrong-base")
        c["false"] += bool(kind in ("none", "wrong-base") and named)
        c["outside"] += kind == "outside"
        c["unknown"] += kind == "outside" and "unknown" in record["verdict"]
    c = {k: int(v) for k, v in c.items()}
    for name, key in (("closed", "true"), ("elsewhere", "unseen")):
        known = [record[key] for record, _ in some if record.get(key) is not None]
        c |= {name: float(np.median(known)) if known else None, f"{name}_of": len(known)}
    return c


def done(tasks, args, rows):
    """Runs (laboratory, arm) in so many processes, and adds their rows as they come."""
    if args.jobs == 1:
        for task in tasks:
            rows.append(run(task, args))
            write_json(args.json, rows)
        return
    until = time.monotonic() + 60 * args.minutes
    context = multiprocessing.get_context("spawn")
    solved(0, args)  # compiles what all need
    _, _, begin, more, unseen = _contacts(args)
    with concurrent.futures.ProcessPoolExecutor(args.jobs, context) as pool:
        rest = range(1, len(begin) + len(more) + len(unseen))
        for _ in pool.map(functools.partial(_tried, solved, args=args), rest):
            pass
        print(f"skins solved, {until - time.monotonic():.0f} s are left", flush=True)
        work = [pool.submit(_tried, run, task, args=args) for task in tasks]
        try:
            for one in concurrent.futures.as_completed(work, max(until - time.monotonic(), 1.0)):
                if one.result() is not None:
                    rows.append(one.result())
                    write_json(args.json, rows)
        except concurrent.futures.TimeoutError:
            for process in list(pool._processes.values()):
                process.kill()
            pool.shutdown(wait=False, cancel_futures=True)
    there = {(row["lab"], row["arm"]) for row in rows}
    for path, arm in tasks:
        part = _part(args, path, arm)
        if (path.stem, arm) not in there and part.exists():
            rows.append(json.loads(part.read_text()))
    write_json(args.json, rows)


def _tried(function, what, args):
    """What a function gives, or None and a line of why."""
    try:
        return function(what, args)
    except Exception as error:  # one laboratory must not end the run
        print(f"FAILED {what}: {type(error).__name__}: {error}", flush=True)
        return None


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("labs", type=pathlib.Path)
    args.add_argument("--first", type=int, default=12, help="contacts of round 1")
    args.add_argument("--more", type=int, default=6, help="contacts of each further round")
    args.add_argument("--rounds", type=int, default=3)
    args.add_argument("--pool", type=int, default=16, help="contacts that further rounds choose from")
    args.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS), metavar="ARM")
    args.add_argument("--share", default="0/1", help="i/n: every n-th laboratory from the i-th on")
    args.add_argument("--jobs", type=int, default=1, help="processes")
    args.add_argument("--minutes", type=float, default=60.0, help="with --jobs, after which it ends")
    args.add_argument("--cache", type=pathlib.Path, default=pathlib.Path("out/rounds"))
    args.add_argument("--json", default="out/rounds.json")
    args = args.parse_args(argv)
    for folder in (args.cache, pathlib.Path(args.json).with_suffix("")):
        folder.mkdir(parents=True, exist_ok=True)
    rows = read_json(args.json, [])
    i, n = map(int, args.share.split("/"))
    paths = sorted(args.labs.glob("lab_*.sealed"))[i::n]
    there = {(row["lab"], row["arm"]) for row in rows}
    tasks = [(path, arm) for arm in args.arms for path in paths]  # the second arm has round 1 of the first
    done([(path, arm) for path, arm in tasks if (path.stem, arm) not in there], args, rows)
    for name, counts in counted(rows).items():
        print(name, counts)


if __name__ == "__main__":
    import rounds

    rounds.main()  # so that other processes find what they are sent by its module's name
