"""Verdicts on recordings with poses against what was hidden in them, as `truth.json` beside the cases says.

    python benchmarks/poses_blind.py CASES VERDICTS [--clean CLEAN [--nats]] [--json OUT]

CASES holds truth.json, a list of {"file": "case_01/...", "effects": [{"id": ...}], "tier", "outside"} (or
{"cases": that list}), VERDICTS a folder of `biotac diagnose --out` for each case, CLEAN the same recordings
without effect and noise, files of the same names. An id of the truth counts as found where an effect's id or
one of its ties is among those of MEANT. What is missing in VERDICTS is not judged.

The gap, with CLEAN: of what the hidden effect does to the held-out trajectories (recording less
clean one, in units of their noise, and less it), the share that the amended simulator repeats (with its
effects, less without), as 1 - RMS left / RMS before. Only where the effect is larger than half the noise.

With --nats, how much of each hidden effect the data show: evidence per trajectory [nats] of recording less
clean one beside noise and scatter of poses, and of what of it no error of the base model can mimic. Ten and
more are called detectable, as in `benchmarks/discrepancy.py`."""

import argparse
import dataclasses
import json
import pathlib

import numpy as np
from discrepancy_rivals import nuisance_space, stacked
from records import read_json, write_json

DETECTABLE = 10.0  # nats per trajectory
MEANT = {  # what authors call an effect -> ids of the catalogue that are right for it
    "adhesion": {"adhesion"},
    "another_modulus": {"modulus"},
    "common_drift": {"drift"},
    "cross_talk": {"crosstalk"},
    "depth_offset": {"depth0", "depth"},
    "drift": {"electrode_drift"},
    "exchange": {"swap"},
    "fluid_loss": {"fluidloss"},
    "friction": {"friction"},
    "gain": {"gain"},
    "hysteresis": {"hyster", "hyster_load"},
    "latency": {"latency"},
    "load_dependent_friction": {"fric_load"},
    "local_stiffness": {"spots", "inhomog"},
    "lost_liquid": {"fluidloss"},
    "misalignment": {"misalign"},
    "noise": {"noise"},
    "offset": {"offset"},
    "permutation": {"swap"},
    "relaxation": {"relax", "creep"},
    "rocking": {"rocking", "rocking_torque"},
    "softening": {"mullins", "damage"},
    "stiffening": {"stiffen"},
    "stiffness": {"modulus"},
    "warm_up": {"warmup", "thermal"},
}


def read_truth(folder):
    """{case: entry} of a folder's truth.json; a case is the part of the file's path that begins so."""
    entries = json.loads((pathlib.Path(folder) / "truth.json").read_text())
    entries = entries["cases"] if isinstance(entries, dict) else entries
    return {next(p for p in e["file"].split("/") if p.startswith("case")): e for e in entries}


def judged(entry, verdict):
    """Of one case: ids with their ties, whether each is right, whether each hidden effect is among them."""
    named = [{e["id"], *e["ties"]} for e in verdict["effects"]]
    want = [] if entry.get("outside") else [MEANT.get(e["id"], {e["id"]}) for e in entry["effects"]]
    right = [any(ids & w for w in want) for ids in named]
    return named, right, [any(ids & w for ids in named) for w in want]


def score(truth, verdicts):
    """Counts of {case: entry} and {case: verdict}: [hits, of]; of pairs [both, one or more, of]."""
    out = {
        "names": [0, 0],
        "single": {},
        "pairs": [0, 0, 0],
        "false": [0, 0],
        "outside": [0, 0],
        "stated": [],
    }
    for case, verdict in sorted(verdicts.items()):
        entry = truth[case]
        named, right, hit = judged(entry, verdict)
        out["names"] = [out["names"][0] + sum(right), out["names"][1] + len(right)]
        out["stated"] += [(e["confidence"], ok) for e, ok in zip(verdict["effects"], right)]
        if entry.get("outside"):
            cell, good = out["outside"], not named and "unknown" in verdict["verdict"]
        elif not hit:
            cell, good = out["false"], bool(named)
        elif len(hit) == 1:
            cell, good = out["single"].setdefault(entry.get("tier", "any"), [0, 0]), hit[0]
        else:
            out["pairs"][1] += any(hit)
            cell, good = out["pairs"], all(hit)
        cell[0] += good
        cell[-1] += 1
    return out


def _read(path, entry):
    """Trajectories of a case's file, as `biotac diagnose` takes them."""
    from biotac_mj.discrepancy.trajectories.recorded import trajectories_of
    from biotac_mj.discrepancy.trajectories.trajectory import read_trajectories
    from biotac_mj.recordings import load

    if path.suffix == ".csv":
        return trajectories_of(list(load(str(path), object_name=entry.get("object"))), "coarse")[0]
    return read_trajectories(path)


def gap(measured, clean, sim, aside, modulus=False, noise=None, offsets=None):
    """Share of what is hidden that an amended simulator repeats on trajectories `aside` (ids), or None where
    that is too small to be seen. modulus: whether the simulator's is one of the effects named, and no
    calibration. noise: of the sensor, as `measurement_noise` gives it, where `measured` has none itself: a
    few contacts tell their own by a third too little or too much, which counts as a gap. offsets:
    (trajectories, 3) by which objects were off [m], where that is known: no model has to repeat it."""
    from biotac_mj.discrepancy.trajectories.trajectory import measurement_noise

    expected = float(noise is None)  # square of noise
    noise = measurement_noise(measured) if noise is None else noise
    fields = sim.fields(measured, progress=False)
    rows = [i for i, t in enumerate(measured) if t.id in aside]
    with_ = sim.run(measured, fields, rows, offsets=offsets)
    bare = dataclasses.replace(sim, effects=[], modulus=1.0 if modulus else sim.modulus)
    without = bare.run(measured, fields, False if offsets is None else rows, offsets=offsets)
    left = before = count = 0.0
    for i in rows:
        t, c, a, b = measured[i], clean[i], with_[i], without[i]
        parts = [(t.electrodes - c.electrodes, a.counts - b.counts, noise["electrodes"])]
        if t.pdc is not None:
            parts.append(((t.pdc - c.pdc)[:, None], (a.pdc - b.pdc)[:, None], noise["pdc"]))
        if t.force is not None:
            parts.append((t.force - c.force, a.force - b.force, noise["force"]))
        for hidden, said, sigma in parts:
            left += ((((hidden - said) / sigma) ** 2) - expected).sum()
            before += (((hidden / sigma) ** 2) - expected).sum()
            count += hidden.size
    if before < 0.25 * count:
        return None
    return float(1 - np.sqrt(max(left, 0.0) / before))


def shown(measured, clean, sim):
    """Nats per trajectory that are hidden in recordings beside clean ones: all of it, and without what errors
    of the base model mimic (modulus, footprint, film, tier, ...)."""
    from biotac_mj.discrepancy.trajectories.fitting import fit_effects
    from biotac_mj.discrepancy.trajectories.whitening import REPEATABILITY
    from biotac_mj.discrepancy.trajectories.workflow import about_rests

    every = np.arange(len(measured))
    comparison = about_rests(sim, measured, sim.fields(measured, progress=False), REPEATABILITY)
    modulus = fit_effects(comparison, [], every).nuisance.modulus
    comparison = dataclasses.replace(comparison, modulus=modulus)
    fit = fit_effects(comparison, [], every)
    free = dataclasses.replace(comparison, trajectories=clean).measured  # about rests of their own
    hidden = [comparison.vector(i, m - c) for i, (m, c) in enumerate(zip(comparison.measured, free))]
    y = stacked(comparison, hidden, every)
    q = nuisance_space(comparison, fit, comparison.vectors(fit.effects, fit.nuisance), every)
    edges, rows = np.cumsum([0, *(v.size for v in hidden)]), [len(t.time) for t in measured]

    def nats(y):
        square = [(y[a:b] ** 2).sum() / n for a, b, n in zip(edges[:-1], edges[1:], rows)]
        return float(np.mean([0.5 * n * np.log(max(s, 1.0)) for n, s in zip(rows, square)]))

    return nats(y), nats(y - q @ (q.T @ y))


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    args.add_argument("cases", type=pathlib.Path)
    args.add_argument("verdicts", type=pathlib.Path)
    args.add_argument("--clean", type=pathlib.Path)
    args.add_argument("--nats", action="store_true", help="what the data show of it; the coarse skin's")
    args.add_argument("--json")
    args = args.parse_args(argv)
    if args.nats and not args.clean:
        raise SystemExit("--nats needs the same recordings without effect and noise: --clean CLEAN")
    truth, verdicts, gaps, seen = read_truth(args.cases), {}, {}, {}
    for case in truth:
        if verdict := read_json(args.verdicts / case / "verdict.json", None):
            verdicts[case] = verdict
    for case, verdict in sorted(verdicts.items()):
        entry = truth[case]
        named, right, hit = judged(entry, verdict)
        names = ["|".join(sorted(ids)) for ids in named] or verdict["verdict"][:40]
        hidden = "outside" if entry.get("outside") else [e["id"] for e in entry["effects"]]
        print(case, entry.get("tier", ""), hidden, "->", names, "" if all(right) and all(hit) else "MISS")
        file = args.clean and args.clean / case / pathlib.Path(entry["file"]).name
        if file and file.exists() and verdict["effects"]:
            from biotac_mj.discrepancy.trajectories.model.sensor_file import load_simulator

            sim = load_simulator(args.verdicts / case / "sensor_amended.yaml")
            sim.cache = str(args.verdicts / case / "fields")
            aside = set(verdict["trajectories"]["kept_aside"])
            measured, clean = (_read(p, entry) for p in (args.cases / case / file.name, file))
            modulus = any(e["id"] == "modulus" for e in verdict["effects"])
            closed = gap(measured, clean, sim, aside, modulus)
            if closed is not None:
                gaps[case] = closed
                said = verdict["share_closed"]
                own = "none" if said is None else f"{said:.0%}"
                print(f"  closed {closed:.0%} of the known gap (the report's own share: {own})")
        if args.nats and file.exists() and entry["effects"]:
            from biotac_mj.discrepancy import Simulator

            sim = Simulator(skin="coarse", tier="full", cache=str(args.verdicts / case / "fields"))
            seen[case] = shown(*(_read(p, entry) for p in (args.cases / case / file.name, file)), sim)
            print("  shows {:.1f} nats a trajectory, {:.1f} beside the base model".format(*seen[case]))
    out = score(truth, verdicts)
    if seen:
        out["nats"] = seen
        able = {c for c in seen if seen[c][1] >= DETECTABLE and len(truth[c]["effects"]) == 1}
        cells = score(truth, {c: v for c, v in verdicts.items() if c in able})["single"].values()
        print(f"single and detectable: {sum(c[0] for c in cells)} of {sum(c[1] for c in cells)}")
    if gaps:
        out["gap"] = {"median": float(np.median(list(gaps.values()))), "cases": gaps}
    print({k: v for k, v in out.items() if k not in ("stated", "gap", "nats")})
    if gaps:
        print(f"gap closed, median of {len(gaps)}: {out['gap']['median']:.0%}")
    if args.json:
        write_json(args.json, out)


if __name__ == "__main__":
    main()
