"""Rounds of experiments on hidden laboratories: contacts that `biotac next` designs against random ones.

    python benchmarks/hidden_lab.py --seal 12 --seed 7 --out labs/
    python benchmarks/rounds.py labs/ --first 7 --more 4 --rounds 3 --json OUT

Round 1 is random and the same for all; each further round takes as many contacts from one pool within the
same bounds, by design or at random, each at most twice. A name is right where a hidden effect's id is among
`poses_blind.MEANT`. Run again, it goes on where it stopped."""

import argparse
import pathlib
import time

import numpy as np
from hidden_lab import carried_out, generator_of, opened, read_plan
from poses_blind import MEANT, gap
from records import read_json, write_json

ARMS = "designed", "random"


def _trajectories(contacts, readings, turn):
    from biotac_mj.discrepancy import Trajectory

    return [
        Trajectory(
            f"r{turn}-{c['id']}",
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
        one = trajectory_of(contact, at, mat, clock, f"contact{len(out) + 1}")
        clock += float(one.time[-1]) + 4.0
        out.append(Planned(contact, one, "given"))
    return Plan(out, {}, [])


def _record(report, seconds):
    beliefs = report.beliefs
    return {
        "verdict": report.verdict,
        "named": [[e.id, *e.ties] for e in report.effects],
        "confidence": [e.confidence for e in report.effects],
        "closed": report.closed,
        "decided": beliefs.decided,
        "explanations": [[one.ids, one.weight] for one in beliefs.explanations],
        "contacts": len(report.selection) + len(report.locked),
        "seconds": seconds,
    }


def run(path, args):
    """Rounds of one laboratory, both arms."""
    from biotac_mj.discrepancy import Simulator, diagnose
    from biotac_mj.discrepancy.trajectories.contacts import Bounds, drawn
    from biotac_mj.discrepancy.trajectories.design import planned
    from biotac_mj.discrepancy.trajectories.plan_files import write_plan

    sensor = opened(path.read_bytes())
    lab = generator_of(sensor, "coarse", "condensed")
    sim = Simulator(skin="coarse", tier="condensed", cache=str(args.cache))
    bounds = Bounds(force=2.0, depth=1.3e-3, tools=("sphere_7mm", "sphere_14mm"))
    begin, pool = (drawn(sim, bounds, count, seed) for count, seed in ((args.first, 1), (args.pool, 2)))
    number, clean = int(path.stem.split("_")[1]), {}

    def measured(plan, turn):
        file = args.cache / f"{path.stem}_{turn}.csv"
        write_plan(plan, file)
        contacts = read_plan(file)
        clean.update(
            (t.id, t)
            for t in _trajectories(contacts, carried_out(lab, sensor, contacts, turn, clean=True), turn)
        )
        return _trajectories(contacts, carried_out(lab, sensor, contacts, turn), turn)

    def judged(data):
        began = time.process_time()
        report = diagnose(sim, data, progress=False)
        record = _record(report, time.process_time() - began)
        if report.effects:
            aside = {data[i].id for i in report.locked}
            modulus = any(e.id == "modulus" for e in report.effects)
            record["true"] = gap(data, [clean[t.id] for t in data], report.apply(sim), aside, modulus)
        return report, record

    first = measured(_plan(begin, 0.0), 1)
    report, record = judged(first)
    out = {arm: [record] for arm in ARMS}
    for arm in ARMS:
        data, now = first, report
        for turn in range(2, args.rounds + 1):
            end = max(t.clock + t.time[-1] for t in data) + 60.0
            began = time.process_time()
            if arm == "designed":
                plan = planned(now.beliefs, sim, bounds, args.more, pool, progress=False)
            else:
                picked = np.random.default_rng([number, turn]).choice(2 * len(pool), args.more, replace=False)
                plan = _plan([pool[k % len(pool)] for k in picked], end)
            design = time.process_time() - began
            data = data + measured(plan, turn)
            now, record = judged(data)
            out[arm].append(record | {"design_seconds": design, "alike": plan.alike})
            print(path.stem, arm, turn, record["verdict"][:80], flush=True)
    return {"lab": path.stem, "truth": sensor, "arms": out}


def counted(rows):
    """Per arm and round: names right and given, singles found, decided rightly and wrongly, false names, and
    unknown outside the catalogue."""
    table = {}
    for arm in ARMS:
        for turn in range(max((len(r["arms"][arm]) for r in rows), default=0)):
            c = dict.fromkeys(
                "labs right names found hidden decided wrongly false clean unknown outside".split(), 0
            )
            for row in rows:
                record, truth = row["arms"][arm][turn], row["truth"]
                want = (
                    [] if truth["kind"] == "outside" else [MEANT.get(e[0], {e[0]}) for e in truth["effects"]]
                )
                right = [any(set(ids) & w for w in want) for ids in record["named"]]
                c["labs"] += 1
                c["right"] += sum(right)
                c["names"] += len(right)
                c["found"] += sum(any(set(ids) & w for ids in record["named"]) for w in want)
                c["hidden"] += len(want)
                best = set(record["explanations"][0][0])
                true = len(best) == len(want) and all(best & w for w in want) and truth["kind"] != "outside"
                c["decided"] += bool(record["decided"] and true)
                c["wrongly"] += bool(record["decided"] and not true)
                c["clean"] += truth["kind"] == "none"
                c["false"] += bool(truth["kind"] == "none" and record["named"])
                c["outside"] += truth["kind"] == "outside"
                c["unknown"] += truth["kind"] == "outside" and "unknown" in record["verdict"]
            table[f"{arm}, round {turn + 1}"] = c
    return table


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("labs", type=pathlib.Path)
    args.add_argument("--first", type=int, default=7, help="contacts of round 1")
    args.add_argument("--more", type=int, default=4, help="contacts of each further round")
    args.add_argument("--rounds", type=int, default=3)
    args.add_argument("--pool", type=int, default=16, help="contacts that further rounds choose from")
    args.add_argument("--share", default="0/1", help="i/n: every n-th laboratory from the i-th on")
    args.add_argument("--cache", type=pathlib.Path, default=pathlib.Path("out/rounds"))
    args.add_argument("--json", default="out/rounds.json")
    args = args.parse_args(argv)
    args.cache.mkdir(parents=True, exist_ok=True)
    rows = read_json(args.json, [])
    i, n = map(int, args.share.split("/"))
    for path in sorted(args.labs.glob("lab_*.sealed"))[i::n]:
        if all(row["lab"] != path.stem for row in rows):
            rows.append(run(path, args))
            write_json(args.json, rows)
    for name, counts in counted(rows).items():
        print(name, counts)


if __name__ == "__main__":
    main()
