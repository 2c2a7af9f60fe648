"""Blind benchmark of the discrepancy workflow: hidden effects, none, pairs, outside the catalogue, and a
mildly wrong base model.

    python benchmarks/discrepancy.py --seeds practice --counts none=2,single=1 --json out/discrepancy.json
    python benchmarks/discrepancy.py --seeds blind --jobs 8 --counts
    none=60,single=10,outside=40,pair=40,wrong-base=20

Every case is drawn, measured by `discrepancy_generator` (synthetic) and sealed (a hash of the truth stands in
its record); run again, it goes on where it stopped. Beside the verdicts stand the answers of rivals
(`discrepancy_rivals`).
`--jobs N` shares the cases among N processes, `--ray ADDRESS` among the machines of a Ray cluster
(docs/howto/cluster.md).
Kinds: none, single, outside, pair, wrong-base, and left-out, a single effect that is taken out of the
catalogue, for calibration. Counts are for each effect with single and left-out, else for the kind. Fields
of the plans are solved before the cases are shared out."""

import argparse
import functools
import hashlib
import json
import pathlib
import time

import numpy as np
import tqdm
from discrepancy_generator import FORMS, HIDDEN, OUTSIDE, Generator, plan
from discrepancy_rivals import cells, f1, rivals
from discrepancy_table import confusion, table
from records import read_json, write_json

from biotac_mj.arguments import add_ray
from biotac_mj.shards import Task, run_tasks

SEEDS = {"development": 0, "practice": 10_000, "blind": 1_400_000}
KINDS = ("none", "single", "outside", "pair", "wrong-base", "left-out")
# Of wrong bases: footprint, mesh, modulus, and the last two at once.
BASES = (
    {"footprint": 0.05},
    {"skin": "default"},
    {"modulus": 1.7},
    {"skin": "default", "modulus": 1 / 1.7},
)


def cases(counts, seeds, plans=4):
    """Dicts: kind, case, effects (list of name, size), seed, settings of the generator, plan; kinds mixed, so
    that a part is a sample."""
    out = []
    for kind, count in counts.items():
        if kind not in KINDS:
            raise ValueError(f"unknown kind {kind!r}: choose from {', '.join(KINDS)}")
        names = {"single": list(HIDDEN), "left-out": list(HIDDEN), "outside": list(OUTSIDE)}.get(kind, [kind])
        if kind == "outside":
            drawn = [(names[i % len(names)], i // len(names)) for i in range(count)]
        else:
            drawn = [(name, i) for i in range(count) for name in names]
        for order, (name, i) in enumerate(drawn):
            seed = (
                SEEDS[seeds] + int(hashlib.sha256(f"{kind}{name}{i}".encode()).hexdigest()[:8], 16) % 600_000
            )
            rng = np.random.default_rng([seed, SEEDS[seeds]])
            settings = {"modulus": float(rng.uniform(0.85, 1.15)), "skin": "coarse", "footprint": 0.0}
            if kind == "wrong-base":
                settings.update(BASES[i % len(BASES)])
            hidden = {
                "pair": list(rng.choice(list(HIDDEN), 2, replace=False)),
                "none": [],
                "wrong-base": [],
            }.get(kind, [name])
            sizes = {**HIDDEN, **OUTSIDE}
            effects = [
                (str(n), float(np.exp(rng.uniform(*np.log(sizes[n])))), int(rng.integers(FORMS.get(n, 1))))
                for n in hidden
            ]
            out.append(
                {
                    "kind": kind,
                    "case": f"{kind}: {name} #{i}",
                    "effects": effects,
                    "seed": seed,
                    "settings": settings,
                    "plan": (order + i) % plans,
                    "at": (order + 0.5) / len(drawn),
                }
            )
    return sorted(out, key=lambda c: c["at"])


@functools.lru_cache(maxsize=1)
def code_hash() -> str:
    """Names the code that is judged: effects, their evidence, thresholds, and the rivals."""
    import biotac_mj

    home = pathlib.Path(biotac_mj.__file__).parent
    files = [*(home / "effects").glob("*.py"), *(home / "discrepancy/trajectories").rglob("*.py")]
    files += [home / "discrepancy/evidence.py", pathlib.Path(__file__).with_name("discrepancy_rivals.py")]
    return hashlib.sha256(b"".join(f.read_bytes() for f in sorted(files))).hexdigest()[:12]


def comparable(name, size) -> dict:
    """True values of the catalogue's parameters where the hidden law has them; (value, whether both laws are
    the same)."""
    same = {
        "asper": {"log_p": np.log(1 + size)},
        "latency": {"delay": size},
        "gain": {
            f"e{k + 1}": g
            for k, g in enumerate(size * np.random.default_rng(int(size * 1e6)).standard_normal(19))
        },
    }
    other = {
        "relax": {"g": size},
        "hyster": {"fraction": size},
        "stiffen": {"c2": size},
        "mullins": {"softening": size},
        "fluidloss": {"rate": 36 * size},
        "warmup": {"a": -size},
        "lowpass": {"tau": size},
        "drift": {"rate": size},
    }
    return {k: (float(v), name in same) for k, v in {**same, **other}.get(name, {}).items()}


class Worker:
    """Work of `shards.run_tasks`, its simulator, generators, and the fields of the plans. A task is the
    number of a plan, whose result is it and its fields, or a case, whose result is its record."""

    def __init__(self, args, fields=None):
        self.args, self.generators, self.fields = args, {}, fields or {}

    def __call__(self, values, folder, report):
        if not hasattr(self, "sim"):
            self._begin()
        for value in values:
            if isinstance(value, int):
                yield value, self.fields_of(value)
                report(1)
                continue
            try:
                yield self.run(value)
            except Exception as error:  # one bad case must not end the run: it is tried again next time
                yield {"case": value["case"], "error": f"{type(error).__name__}: {error}"}
            report(1)

    def _begin(self):
        import warp as wp

        wp.config.quiet = True
        from biotac_mj.discrepancy import Simulator

        args = self.args
        self.plans = [plan(SEEDS[args.seeds] + 5 + k, args.trajectories) for k in range(args.plans)]
        self.sim = Simulator(cache=args.cache, tier=args.tier, device=args.device)

    def trajectories(self, k, measured):
        from biotac_mj.discrepancy import Trajectory

        return [
            Trajectory(
                p["id"],
                p["tool"],
                p["clock"],
                p["time"],
                p["pos"],
                np.tile(p["turn"], (len(p["time"]), 1, 1)),
                e,
                pdc,
                None,
                f,
            )
            for p, (e, pdc, f) in zip(self.plans[k], measured)
        ]

    def fields_of(self, k):
        if k not in self.fields:
            blank = [
                (
                    np.full((len(p["time"]), 19), 2000.0),
                    np.full(len(p["time"]), 2000.0),
                    np.zeros((len(p["time"]), 3)),
                )
                for p in self.plans[k]
            ]
            self.fields[k] = self.sim.fields(self.trajectories(k, blank), progress=False)
        return self.fields[k]

    def generator(self, skin):
        if skin not in self.generators:
            self.generators[skin] = Generator(skin, tier=self.args.tier, device=self.args.device)
        return self.generators[skin]

    def run(self, case) -> dict:
        """The record of a case: truth, verdict and all numbers that thresholds are set on."""
        from biotac_mj.discrepancy import CATALOGUE, diagnose

        began = time.process_time()
        effects, settings = case["effects"], case["settings"]
        generator = self.generator(settings["skin"])
        generator.modulus, generator.footprint = settings["modulus"], settings["footprint"]
        data = self.trajectories(
            case["plan"], generator.measure(self.plans[case["plan"]], effects, case["seed"])
        )
        catalogue = [e for e in CATALOGUE if case["kind"] != "left-out" or e.id != effects[0][0]]
        report = diagnose(
            self.sim, data, effects=catalogue, fields=self.fields_of(case["plan"]), progress=False
        )
        used = time.process_time() - began
        answers = (
            {} if self.args.no_rivals or case["kind"] == "left-out" else self.judge(case, report, generator)
        )
        return {
            "case": case["case"],
            "kind": case["kind"],
            "seeds": self.args.seeds,
            "tier": self.args.tier,
            "code": code_hash(),
            "plan": case["plan"],
            "seed": case["seed"],
            "settings": settings,
            "truth": [e for e, *_ in effects],
            "sizes": [s for _, s, _ in effects],
            "forms": [f for *_, f in effects],
            "seal": hashlib.sha256(json.dumps([effects, settings, case["seed"]]).encode()).hexdigest()[:12],
            "verdict": report.verdict,
            "named": [e.id for e in report.effects],
            "ties": [list(e.ties) for e in report.effects],
            "confidence": [e.confidence for e in report.effects],
            "closed": report.closed,
            "nats": report.tried[0]["evidence_nats"] / len(report.selection) if report.tried else 0.0,
            "where": len(report.where),
            "before": report.proof.before,
            "after": report.proof.after,
            "parameters": [
                {name: [p.value, p.low, p.high] for name, p in e.parameters.items()} for e in report.effects
            ],
            "comparable": {e: comparable(e, s) for e, s, _ in effects},
            "answers": answers,
            "seconds": used,
        }

    def judge(self, case, report, generator):
        """What each method names, how well it tells where (F1 of channel x phase), and by how much its
        modulus is off without and with what it names (logarithms); our own beside the rivals."""
        from biotac_mj.discrepancy.trajectories.fitting import fit_effects

        c, chosen = report.comparison, report.selection
        plans, seed = self.plans[case["plan"]], case["seed"]
        with_, without = (generator.clean(plans, some, seed) for some in (case["effects"], []))
        truth = {}
        for i in range(len(plans)):
            parts = [np.column_stack(one[i]) for one in (with_, without)]
            truth[i] = (parts[0] - parts[0][0]) - (parts[1] - parts[1][0])
        truth = cells(c, chosen, truth)
        null = fit_effects(c, [], chosen)
        base = null.raw(c)
        true = np.log(case["settings"]["modulus"])
        out = {}
        for name, (effects, modulus) in {"ours": (report.fit.effects, None), **rivals(c, chosen)}.items():
            change = [a - b for a, b in zip(base, c.raw(effects, null.nuisance))]
            if modulus is None:
                start = report.fit if name == "ours" else fit_effects(c, effects, chosen, null)
                modulus = start.nuisance.log_modulus
            out[name] = {
                "named": [e.id for e, _ in effects],
                "f1": f1(cells(c, chosen, change), truth),
                "bias": [null.nuisance.log_modulus - true, modulus - true],
            }
        return out


def _counts(text):
    return {k: int(v) for k, v in (part.split("=") for part in text.split(","))}


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("--counts", type=_counts, default=dict.fromkeys(KINDS[:5], 1), metavar="KIND=N,...")
    args.add_argument("--seeds", choices=SEEDS, default="development")
    args.add_argument("--jobs", type=int, default=1, help="processes")
    add_ray(args)
    args.add_argument("--share", default="0/1", help="i/n: every n-th case from the i-th on")
    args.add_argument("--plans", type=int, default=4, help="sets of trajectories, taken in turn")
    args.add_argument("--trajectories", type=int, default=16)
    args.add_argument("--tier", choices=("condensed", "full"), default="condensed")
    args.add_argument("--device", default="cpu", help="of the full tier")
    args.add_argument("--cache", default="out/discrepancy_fields")
    args.add_argument("--json", default="out/discrepancy.json")
    args.add_argument("--figure", default="", help="PNG of the confusion matrix")
    args.add_argument("--no-rivals", action="store_true")
    args.add_argument("--table", nargs="+", metavar="JSON", help="only count what these files hold")
    args = args.parse_args(argv)
    if args.table:
        rows = [r for f in args.table for r in json.loads(pathlib.Path(f).read_text())]
        print(
            f"code {', '.join(sorted({r['code'] for r in rows}))}; tier "
            f"{', '.join(sorted({r['tier'] for r in rows}))}"
        )
        print(table(rows))
        if args.figure:
            confusion(rows, args.figure)
        return
    rows = read_json(args.json, [])
    done = {(r["case"], r["plan"], r["seeds"], r["tier"], r["code"]) for r in rows}
    i, n = (int(v) for v in args.share.split("/"))
    todo = [
        c
        for c in cases(args.counts, args.seeds, args.plans)[i::n]
        if (c["case"], c["plan"], args.seeds, args.tier, code_hash()) not in done
    ]
    print(f"code {code_hash()}, {len(todo)} cases to do", flush=True)
    if todo:
        began = time.time()
        where = dict(ray=args.ray, gpus=int(args.device != "cpu"))
        if args.jobs > 1:
            where["processes"] = {f"process {k}": {} for k in range(args.jobs)}
        args.cache = str(pathlib.Path(args.cache).resolve())
        plans = sorted({case["plan"] for case in todo})
        # each plan's skin is solved once, before the cases that all need it are shared out
        fields = dict(run_tasks(Worker(args), map(Task, plans), ".", "fields", "plan", **where))
        print(f"fields there after {time.time() - began:.0f} s", flush=True)
        found = run_tasks(Worker(args, fields), map(Task, todo), ".", "cases", "case", **where)
        _collect(found, rows, args.json)
    rows = [r for r in rows if (r["seeds"], r["tier"], r["code"]) == (args.seeds, args.tier, code_hash())]
    print(table(rows))
    if args.figure:
        confusion(rows, args.figure)


def _collect(results, rows, path):
    for row in results:
        if "error" in row:
            tqdm.tqdm.write(f"FAILED {row['case']}: {row['error']}")
            continue
        rows.append(row)
        write_json(path, rows)
        tqdm.tqdm.write(
            f"{row['seal']} {row['case']:<24} {row['seconds']:5.1f} s  {row['verdict'][:110]} | "
            + ", ".join(f"{k}: {' '.join(a['named'][:3])}" for k, a in row["answers"].items() if k != "ours")
        )


if __name__ == "__main__":
    import discrepancy

    discrepancy.main()  # so that other processes find what they are sent by its module's name
