r"""What a checkup finds in laboratories made of real recordings, with and without its protocol.

    python benchmarks/checkup_labs.py --data ../shared/data --authors ../shared/hidden_effects/authors \
        --half blind --seed 1 --json out/checkup.json

A laboratory is one sensor in one session: rows of an unloaded sensor (rest), then rows of one that is pressed
by hand on a force plate, or five grasps of a gripper where the effect is a temperature. The segments of the
pressed rows are read off the force: where it stands still (hold), changes slowly (loops), fast (fast) or
mostly tangentially (slides). The pressed logs have no rest in air: those of F2 have the same sensor's
unloaded log before them, those of F1 another's of the same laboratory; the force of these rows is noise of
5 mN, which is made up. Logs fade into each other within half a second, as a touch begins.

Effects are put in by the forms of authors' generators (`discrepancy_recordings.py`), each in all of the
laboratory. practice: F1 and the seventeenth author. blind: F2 and grasps, the twelfth and thirteenth author,
28 laboratories with one effect, one of each kind before any twice, and 12 with none, drawn by --seed. Each is
diagnosed as a plain log and with its protocol.
"""

import argparse
import collections
import dataclasses
import os
import pathlib

import numpy as np
from discrepancy_recordings import Authors, _recording, code_hash, judge, table
from records import write_json
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

from biotac_mj.recordings.protocol import Protocol, Segment
from biotac_mj.shards import Task, run_tasks

_REST, _PRESSED = 40.0, 70.0  # [s] of a session
_STILL = 0.35  # [N/s] below which the force stands still
_FAST = 3.0  # [N/s] beyond which it changes fast
_LEAST = 2.0  # [s] of a segment
_FADE = 0.5  # [s] in which one log goes over into the next, as a touch begins
_PLATE = 5e-3  # [N] noise of a plate that nothing touches


@dataclasses.dataclass
class Lab:
    """half; name; sensor: F1, F2 or THING/FINGER of a gripper; start: [s] of its rest and of its pressed
    rows; author: module, or "" with nothing hidden; piece: number in that author's plan."""

    half: str
    name: str
    sensor: str
    start: tuple = (0.0, 0.0)
    author: str = ""
    piece: int = -1


def plan(authors: Authors, half: str, seed: int) -> list:
    """Laboratories of a half: one of each kind of effect, then further ones at random, and some with none."""
    rng = np.random.default_rng(seed)
    names, sensors = (
        (("seventeenth",), ("F1",)) if half == "practice" else (("twelfth", "thirteenth"), ("F2",))
    )
    kinds = collections.defaultdict(list)
    for name in names:
        for i, spec in enumerate(authors.module(name).plan()):
            if len(spec.kinds) == 1 and not spec.outside:
                kinds[spec.kinds[0]].append((name, i))
    order = [(kind, *some[k]) for kind, some in sorted(kinds.items()) for k in rng.permutation(len(some))]
    first = [next(one for one in order if one[0] == kind) for kind in sorted(kinds)]
    more = [one for one in order if one not in first]
    more = [more[k] for k in rng.permutation(len(more))]
    count = len(order) if half == "practice" else 28
    grasps = [
        f"{thing}/{finger}"
        for thing in ("acrylic_211", "car_sponge_101", "steel_vase_702")
        for finger in "01"
    ]
    labs = []
    for kind, name, i in [*first, *more][:count] + [("none", "", -1)] * 12:
        spec = authors.module(name).plan()[i] if name else None
        # a grasp has no rest before it, and a thermistor
        grasp = half != "practice" and (kind == "thermal" or not name and rng.random() < 0.2)
        sensor = str(rng.choice(grasps)) if grasp else str(rng.choice(sensors))
        start = (
            float(rng.uniform(*((2, 45) if half == "practice" else (95, 135)))),
            float(rng.uniform(2, 110)),
        )
        hidden = "+".join("".join(form) if isinstance(form, tuple) else form for form in _forms(spec))
        labs.append(Lab(half, f"{len(labs):03d} {sensor} {kind} {hidden}", sensor, start, name, i))
    return labs


def _forms(spec):
    return () if spec is None else getattr(spec, "forms", None) or spec.effects


def build(lab: Lab, authors: Authors):
    """(case, Protocol) of a laboratory."""
    sources = authors.module("sources")
    data = pathlib.Path(authors.data)
    if lab.sensor in ("F1", "F2"):
        at_rest, pressed = sources.source(data, "U"), sources.source(data, lab.sensor)
        rows = slice(*np.searchsorted(at_rest.time, [lab.start[0], lab.start[0] + _REST]))
        touched = slice(*np.searchsorted(pressed.time, [lab.start[1], lab.start[1] + _PRESSED]))
        count, rng = rows.stop - rows.start, np.random.default_rng(int(lab.name[:3]))
        x = np.rint(_joined([at_rest.x[rows], pressed.x[touched]], at_rest.rate))
        force = _joined([rng.normal(0, _PLATE, (count, 3)), pressed.force[touched]], at_rest.rate)
        count -= round(_FADE * at_rest.rate)
        source = sources.Source(x, np.arange(len(x)) / at_rest.rate, at_rest.rate, force)
        source.rest = np.median(at_rest.x[rows], 0)
        rest_time = count / source.rate
        segments = [
            Segment("rest", 0.0, rest_time, "air"),
            *_read_off(pressed.force[touched], source.rate, rest_time),
        ]
    else:
        thing, finger = lab.sensor.split("/")
        trials = [sources.source(data, f"phac/{thing}_{k:02d}/F{finger}") for k in range(1, 6)]
        x = np.rint(_joined([t.x for t in trials], 100.0))
        tdc = np.rint(_joined([t.tdc for t in trials], 100.0))
        source = sources.Source(x, np.arange(len(x)) / 100.0, 100.0, tdc=tdc)
        long = 10.0 - _FADE
        segments = [Segment("hold", long * k, long * (k + 1), thing) for k in range(5)]
    base = lab.sensor + "+f" if lab.sensor[0] == "F" else f"phac/{lab.sensor}"
    return _hidden(lab, authors, source, base), Protocol(tuple(segments))


def _joined(parts, rate):
    """Rows of parts (n, ...), each fading into the next as a touch begins."""
    out, rows = parts[0], round(_FADE * rate)
    ramp = np.linspace(0, 1, rows + 2)[1:-1].reshape(-1, *[1] * (out.ndim - 1))
    for part in parts[1:]:
        both = (1 - ramp) * out[-rows:] + ramp * part[:rows]
        out = np.concatenate([out[:-rows], both, part[rows:]])
    return out


def _hidden(lab, authors, source, base):
    """The case: what is read of the source with what an author hides in it."""
    module = authors.module(lab.author or ("seventeenth" if lab.half == "practice" else "thirteenth"))
    name = "source" if hasattr(module, "source") else "_source"
    setattr(module, name, lambda data, log: source)  # the author reads this laboratory, whatever it asks for
    spec = module.plan()[max(lab.piece, 0)]
    if hasattr(spec, "rows"):
        spec = dataclasses.replace(spec, base=base, first=0, rows=len(source.x))
    else:
        spec = dataclasses.replace(spec, base=base.split("+")[0].split("/")[0], part=None, force="+f" in base)
    if not lab.author:
        clean = {"forms": ()} if hasattr(spec, "forms") else {"effects": ()}
        spec = dataclasses.replace(spec, level=None, **clean)
    case, _ = module.make(spec, authors.data)
    return authors.words.Case(**case)


def _read_off(force, rate, begin):
    """Segments of pressed rows (n, 3) [N] that begin at a time [s]."""
    smooth = gaussian_filter1d(force, 0.1 * rate, axis=0)
    speed = np.abs(np.diff(smooth, axis=0, prepend=smooth[:1])) * rate
    normal, along = (uniform_filter1d(v, round(rate)) for v in (speed[:, 2], np.hypot(*speed[:, :2].T)))
    kind = np.where(
        np.maximum(normal, along) < _STILL, 0, np.where(along > normal, 3, np.where(normal > _FAST, 2, 1))
    )
    edges = np.flatnonzero(np.diff(kind, prepend=-1, append=-1))
    out = []
    for first, last in zip(edges[:-1], edges[1:]):
        if (last - first) / rate >= _LEAST or not out:
            start = out[-1].stop if out else begin
            out.append(
                Segment(("hold", "loops", "fast", "slides")[kind[first]], start, begin + last / rate, "plate")
            )
        else:  # too short for a segment: it belongs to the one before
            out[-1] = dataclasses.replace(out[-1], stop=begin + last / rate)
    return out


class Judge:
    """Work of `shards.run_tasks`: the records of a laboratory."""

    def __init__(self, folder: str, data: str, half: str, seed: int):
        self.given = folder, data, half, seed

    def __call__(self, values, folder, report):
        authors = Authors(*self.given[:2], [])
        labs = plan(authors, *self.given[2:])
        for number in values:
            case, protocol = build(labs[number], authors)
            record = {"half": labs[number].half, "seed": self.given[3], "key": [labs[number].name]}
            try:
                recording = _recording(case)
                record["plain"] = judge(case, recording, authors)
                record["checkup"] = judge(case, recording, authors, protocol)
            except ValueError as refused:
                record["refused"] = str(refused)
            yield record
            report(1)


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("--data", required=True, metavar="DIR", help="folder of recordings")
    args.add_argument("--authors", required=True, metavar="DIR", help="folder of the authors' modules")
    args.add_argument("--half", default="practice", choices=("practice", "blind"))
    args.add_argument("--seed", type=int, default=52, help="of the laboratories that are drawn")
    args.add_argument("--jobs", type=int, default=os.cpu_count(), metavar="N", help="processes")
    args.add_argument("--json", required=True, metavar="OUT")
    options = args.parse_args(argv)
    authors = Authors(options.authors, options.data, [])
    todo = [Task(number) for number in range(len(plan(authors, options.half, options.seed)))]
    jobs = min(options.jobs, len(todo))
    processes = {f"process {k}": {"OMP_NUM_THREADS": "1"} for k in range(jobs)} if jobs > 1 else None
    work, rows, code = Judge(options.authors, options.data, options.half, options.seed), [], code_hash()
    for row in run_tasks(work, todo, ".", "laboratories", "laboratory", processes=processes):
        rows.append(row)
        write_json(options.json, {"code": code, "labs": rows})
    for row in (r for r in rows if "refused" in r):
        print(row["key"], row["refused"])
    rows = [r for r in rows if "refused" not in r]
    for way in ("plain", "checkup"):
        print(f"{way}, code {code}", table([r[way] for r in rows]), sep="\n", end="\n\n")


if __name__ == "__main__":
    main()
