r"""What `biotac diagnose --electrodes` names in recordings of real sensors with hidden effects.

The 120 pieces of the sixteenth and the 120 of the seventeenth author:

    python benchmarks/discrepancy_recordings.py ../shared/data --authors ../shared/hidden_effects/authors \
        --half sixteenth seventeenth --json out/recordings.json

DATA is the folder of recordings into which the effects are put. These two authors need `epfl_flat_press`,
`epfl_f2`, `phac_hold`, `slides_20`, `scraping` and `btd` of it.
--authors: the folder of generators, one module an author, with `vocabulary.py` and `sources.py`, imported
from there. --half: names of modules, or a half of the first author's: practice, blind, mixed. --counts: of
the first two authors' plans, recordings without effect on each base, of each effect, pairs; of the third's
its rounds. A run goes on where it ended: pieces that OUT holds by the same code are not diagnosed again.
`discrepancy_confidence.py` fits the confidence's weights to what OUT holds.
"""

import argparse
import functools
import hashlib
import importlib
import importlib.util
import os
import pathlib
import sys
import tempfile
import time

import numpy as np
import tqdm
from records import read_json, write_json

from biotac_mj.shards import Task, run_tasks

__all__ = ["Authors", "Judge", "code_hash", "right", "table"]

_HALVES = ("practice", "blind", "mixed")  # of the first author's


class Authors:
    """The generators in a folder: their pieces, and which names are right.

    Args:
      folder: of modules, imported as the package `authors`, the name by which they import each other.
      data: of the recordings. counts: of the plans that can be shorter, see the module's text.

    Raises:
      FileNotFoundError: the folder is not one of generators.
    """

    def __init__(self, folder: str, data: str, counts: list[int]):
        file = pathlib.Path(folder) / "__init__.py"
        if not file.is_file() or not file.with_name("vocabulary.py").is_file():
            raise FileNotFoundError(f"{folder} has no vocabulary.py: give the folder of the authors' modules")
        package = importlib.util.spec_from_file_location("authors", file)  # the folder's modules are in it
        sys.modules["authors"] = importlib.util.module_from_spec(package)
        package.loader.exec_module(sys.modules["authors"])
        self.folder, self.data, self.counts = file.parent, data, counts
        self.words = self.module("second")  # its names and what may be said of them include the first's

    def module(self, name: str):
        if not (self.folder / f"{name}.py").is_file():
            known = (*_HALVES, *sorted(path.stem for path in self.folder.glob("[!_]*.py")))
            raise ValueError(f"no author {name!r} in {self.folder}: choose from {', '.join(known)}")
        return importlib.import_module(f"authors.{name}")

    @functools.cached_property
    def natural(self) -> dict:
        """base: ids of what it has by itself."""
        modules = [self.module(path.stem) for path in sorted(self.folder.glob("[!_]*.py"))]
        return {base: ids for m in modules for base, ids in getattr(m, "NATURAL", {}).items()}

    def pieces(self, half: str) -> list:
        """(key, function that makes case and clean counts) of an author's pieces, in mixed order, so that a
        run that was stopped holds some of each."""
        module = self.module("first" if half in _HALVES else half)
        cases, make, key = getattr(self, f"_of_{half}", functools.partial(self._of_any, half))(module)
        order = np.random.default_rng(0).permutation(len(cases))
        return [(key(*cases[i]), functools.partial(make, *cases[i])) for i in order]

    def _of_any(self, half, module):
        if half in (*_HALVES, "second", "third"):  # a case is a base, effects and a seed
            which = (half,) if half in _HALVES else ()
            cases = module.plan(*which, *self.counts)
            make = functools.partial(module.make, *which, module.bases(self.data, *which))
            return cases, make, lambda base, effects, seed: (base, "+".join(effects), seed)

        def make(spec):
            case, clean = module.make(spec, self.data)
            return self.words.Case(**case), clean

        plan = module.plan(self.data) if half == "seventh" else module.plan()
        return [(spec,) for spec in plan], make, lambda spec: (spec.name,)

    def _of_fourth(self, module):
        sources = module.sources(self.data)

        def make(base, effects, seed):
            piece = module.make(sources, base, effects, seed)
            clean = piece.pop("clean")
            return self.words.Case(**piece), clean

        def key(base, effects, seed):
            return base, "+".join(f"{kind}{form}" for kind, form in effects), seed

        return module.PLAN, make, key

    def _of_fifth(self, module):
        def make(name):
            piece = module.make(name, self.data)
            return self.words.Case(**piece.case), piece.clean

        return [(piece["id"],) for piece in module.plan()], make, lambda name: (name,)


def right(effect: dict, case, authors: Authors) -> str | None:
    """The hidden effect that a named one is, on its channel; "natural" for what the base has by itself.

    Args:
      effect: id, ties, channels ("e1"), places: times [s] of what was lost.
    """
    words, ids = authors.words, {effect["id"], *effect["ties"]}
    for name, channels in zip(case.truth, case.channels):
        if name == "lost" and not _near(effect["places"], case):
            continue
        if words.ACCEPTED[name] & ids and (
            name not in words.SINGLE or {f"e{k + 1}" for k in channels} & set(effect["channels"])
        ):
            return name
    return "natural" if effect["id"] in authors.natural[case.base] else None


def _near(places, case):
    """Whether one of some times [s] is a gap of the case, within a tenth of a second."""
    return any(np.abs(np.asarray(case.gaps) / case.rate - t).min(initial=1.0) < 0.1 for t in places)


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


class Judge:
    """Work of `shards.run_tasks`: of a half and a number among its pieces the record of that piece, or of
    why it has none."""

    def __init__(self, folder: str, data: str, counts: list[int]):
        self.given = folder, data, counts

    def __call__(self, values, folder, report):
        authors = Authors(*self.given)
        pieces = functools.cache(authors.pieces)
        for half, number in values:
            key, make = pieces(half)[number]
            case, _ = make()
            try:
                recording = _recording(case)
            except ValueError as refused:
                yield {"half": half, "key": [*key], "refused": str(refused)}
            else:
                yield {"half": half, "key": [*key], **judge(case, recording, authors)}
            report(1)


def judge(case, recording, authors: Authors, protocol=None) -> dict:
    """Diagnoses the recording of one case, by a checkup's protocol if there is one, and scores it."""
    from biotac_mj.discrepancy import diagnose_recording
    from biotac_mj.quality.confidence import NAMED, PAIRS

    began = time.process_time()
    d = diagnose_recording(recording, protocol=protocol)
    verdict = d.to_dict()

    def scored(finding, effect):
        return {name: effect[name] for name in ("id", "ties", "channels", "confidence", "p")} | {
            "right": right(effect | {"places": finding.places}, case, authors),
            "detector": finding.detector,
            "pair": finding.detector in PAIRS,
            "features": finding.features,
        }

    return {
        "base": case.base,
        "force": case.force is not None,
        "truth": case.truth,
        "forms": case.forms,
        "channels": case.channels,
        "rows": len(case.counts),
        "seconds": time.process_time() - began,
        "verdict": verdict["verdict"],
        "named": [scored(*pair) for pair in zip([*d.findings, *d.late], verdict["effects"])],
        "weak": [
            scored(f, effect) | {"contradicted": f.confidence >= NAMED}
            for f, effect in zip(d.session.weak, verdict["not_named"])
        ],
        "outside": bool(set(case.truth) & authors.words.OUTSIDE),
        "unknown": d.rest.significant,
        "left": d.rest.kind,
        "rest": d.rest.features,
    }


def code_hash() -> str:
    """Of everything that decides a verdict."""
    package = pathlib.Path(__file__).parents[1] / "biotac_mj"
    folders = (package / "quality", package / "discrepancy/recordings")
    files = [package / "discrepancy/evidence.py", *(f for one in folders for f in sorted(one.rglob("*.*")))]
    data = b"".join(f.read_bytes() for f in files if f.suffix in (".py", ".json"))
    return hashlib.sha256(data).hexdigest()[:12]


def table(rows: list) -> str:
    """The scores of pieces, each with what was missed and what was named wrongly."""
    names = [n for r in rows for n in r["named"] if n["right"] != "natural"]
    none, outside = [r for r in rows if not r["truth"]], [r for r in rows if r["outside"]]
    single = [r for r in rows if len(r["truth"]) == 1 and not r["outside"]]
    pairs = [{n["right"] for n in r["named"]} & set(r["truth"]) for r in rows if len(r["truth"]) == 2]

    def found(r):
        return any(n["right"] == r["truth"][0] for n in r["named"])

    def wrong(r):
        return [n for n in r["named"] if n["right"] is None]

    lines = [
        f"{text:<44}{sum(hits):>4} of {len(hits):<4}{sum(hits) / max(len(hits), 1):>6.0%}"
        for text, hits in {
            "names that are right": [n["right"] is not None for n in names],
            "single effects named": [found(r) for r in single],
            "  and nothing else": [found(r) and not wrong(r) for r in single],
            "falsely named where nothing is hidden": [bool(wrong(r)) for r in none],
            "  or called unknown": [r["unknown"] for r in none],
            "outside the catalogue: unknown": [r["unknown"] for r in outside],
            "  and nothing wrong named": [r["unknown"] and not wrong(r) for r in outside],
            "pairs: both named": [len(both) == 2 for both in pairs],
            "  one of them or both": [bool(both) for both in pairs],
        }.items()
    ]
    seconds = [r["seconds"] for r in rows]
    lines.append(f"processor time: median {np.median(seconds):.1f} s, most {max(seconds):.1f} s")
    for effect in sorted({r["truth"][0] for r in rows if len(r["truth"]) == 1}):
        mine = [r for r in rows if r["truth"] == [effect]]
        ids = ", ".join(f"{n['id']} {n['channels'][0]}" for r in mine for n in wrong(r))
        missed = ", ".join(f"{r['base']} {r['forms']}{'?' * r['unknown']}" for r in mine if not found(r))
        count = f"{sum(map(found, mine))} of {len(mine)}"
        lines.append(f"{effect:<16}{count:<10}wrong: {ids or '-'}  missed: {missed or '-'}")
    ids = ", ".join(f"{r['base']}: {n['id']}" for r in none for n in wrong(r))
    return "\n".join([*lines, f"{'none':<26}wrong: {ids or '-'}"])


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("data", metavar="DATA", help="folder of recordings")
    args.add_argument("--authors", required=True, metavar="DIR", help="folder of the authors' modules")
    args.add_argument("--half", nargs="+", default=["seventeenth"], metavar="NAME")
    args.add_argument("--counts", default=[9, 5, 20], type=lambda text: [*map(int, text.split(","))])
    args.add_argument("--jobs", type=int, default=os.cpu_count(), metavar="N", help="processes")
    args.add_argument("--json", required=True, metavar="OUT")
    options = args.parse_args(argv)
    given = options.authors, options.data, options.counts
    try:
        authors = Authors(*given)
        pieces = {(half, i): key for half in options.half for i, (key, _) in enumerate(authors.pieces(half))}
    except (ValueError, FileNotFoundError) as error:
        args.error(str(error))
    code = code_hash()
    kept = read_json(options.json, {"cases": []})
    rows = kept["cases"] if kept.get("code") == code else []
    done = {(r["half"], *r["key"]) for r in rows}
    todo = [Task(value) for value, key in pieces.items() if (value[0], *key) not in done]
    jobs = min(options.jobs, len(todo))
    processes = {f"process {k}": {"OMP_NUM_THREADS": "1"} for k in range(jobs)} if jobs > 1 else None
    for row in run_tasks(Judge(*given), todo, ".", "pieces", "piece", processes=processes):
        rows.append(row)
        write_json(options.json, {"code": code, "cases": rows})
    for row in (r for r in rows if "refused" in r):
        tqdm.tqdm.write(f"{row['half']} {row['key']}: {row['refused']}")
    rows = [r for r in rows if "refused" not in r and r["half"] in options.half]
    for half in options.half:
        print(half, table([r for r in rows if r["half"] == half]), sep="\n", end="\n\n")
    print("all", table(rows), sep="\n")


if __name__ == "__main__":
    main()
