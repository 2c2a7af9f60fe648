r"""What a checkup finds in laboratories made of real recordings, with and without its protocol.

    python benchmarks/checkup_labs.py --data ../shared/data --authors ../shared/hidden_effects/authors \
        --half blind --seed 1 --json out/checkup.json

A laboratory is one sensor that goes through the steps of `biotac checkup`, shortened. Where nothing touches
its rows are those of an unloaded sensor's log, one after another; where something does, those of one that is
pressed by hand on a force plate, from another place of that log for each touch. In between and in taps the
change of ln Z goes from one to the other, each electrode by a power of its own, and the force with it: how
touches begin and end is made up, and so is the plate's noise of 5 mN. The log of F2 has the same sensor's
unloaded log, that of F1 another's of the same laboratory. Neither has a second temperature ('warm' is rest
after load): an effect of temperature is put into five grasps of a gripper, which has a thermistor.

Effects are put in by the forms of authors' generators (`discrepancy_recordings.py`), each in all of the
laboratory. practice: F1, the eleventh and the seventeenth author. blind: F2 and grasps, the twelfth and
thirteenth author, 28 laboratories with one effect, one of each kind before any twice, and 12 with none, drawn
by --seed. Each is diagnosed as a plain log and with its protocol.
"""

import argparse
import collections
import dataclasses
import os
import pathlib

import numpy as np
from discrepancy_recordings import Authors, _recording, code_hash, judge, table
from records import write_json

from biotac_mj.recordings.protocol import STEPS, Protocol, Segment
from biotac_mj.sensor.channels import counts_from_log_impedance, log_impedance
from biotac_mj.shards import Task, run_tasks

_MOVE = 1.0  # [s] between steps
# [s] of steps
_STEPS = dict(rest=40, taps=10, hold=20, release=10, loops=20, fast=10, slides=15, warm=15)
# touches of a step: how many, [s] in which one begins and ends, part of the time it lasts, share of a press
_TOUCHES = dict(taps=(20, 0.06, 0.5, 0.5), hold=(1, 3.0, 1.0, 1.0), loops=(5, 1.9, 1.0, 1.0))
_TOUCHES |= dict(fast=(8, 0.15, 0.7, 1.0), slides=(3, 0.5, 0.95, 0.7))
_POWERS = 0.3  # spread of the logarithm of an electrode's power
_FADE = 0.5  # [s] in which one grasp goes over into the next
_PLATE = 5e-3  # [N] noise of a plate that nothing touches


@dataclasses.dataclass
class Lab:
    """half; name; sensor: F1, F2 or THING/FINGER of a gripper; start: [s] in the log at rest; author: module,
    or "" with nothing hidden; piece: number in that author's plan."""

    half: str
    name: str
    sensor: str
    start: float = 0.0
    author: str = ""
    piece: int = -1


def plan(authors: Authors, half: str, seed: int) -> list:
    """Laboratories of a half: one of each kind of effect, then further ones at random, and some with none."""
    rng = np.random.default_rng(seed)
    names, sensors = (
        (("eleventh", "seventeenth"), ("F1",)) if half == "practice" else (("twelfth", "thirteenth"), ("F2",))
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
        grasp = kind == "thermal" or half != "practice" and not name and rng.random() < 0.2
        sensor = str(rng.choice(grasps)) if grasp else str(rng.choice(sensors))
        start = float(rng.uniform(0, 40))
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
        source, segments = _session(lab, sources.source(data, "U"), sources.source(data, lab.sensor), sources)
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


def _session(lab, at_rest, pressed, sources):
    """Source and segments of a sensor that goes through the steps, from its logs at rest and pressed."""
    rate, rng = at_rest.rate, np.random.default_rng([int(lab.name[:3]), int(1e6 * lab.start)])
    segments, stop = [], 0.0
    for kind, seconds in _STEPS.items():
        start, stop = stop + _MOVE, stop + _MOVE + seconds
        segments.append(Segment(kind, start, stop, "plate" if STEPS[kind].touched else "air"))
    rows = slice(*np.searchsorted(at_rest.time, [lab.start, lab.start + stop]))
    # rows that the bus repeats do so in both logs: new ones are put together, and repeated as at rest
    held, fresh = at_rest.held[rows], np.cumsum(~at_rest.held[rows])
    load, force = log_impedance(pressed.x[~pressed.held]), pressed.force[~pressed.held]
    share, of, time = np.zeros(len(held)), np.zeros(len(held), int), at_rest.time[rows] - lab.start
    for one in segments:
        if not STEPS[one.kind].touched:
            continue
        number, ramp, part, most = _TOUCHES[one.kind]
        begins = np.linspace(one.start, one.stop, number, endpoint=False)
        places = rng.integers(len(load) - (one.stop - one.start) * rate, size=number)
        for begin, place in zip(begins, places):
            touch = slice(*np.searchsorted(time, [begin, begin + part * (one.stop - one.start) / number]))
            passed = time[touch] - begin
            inside = np.clip(np.minimum(passed, passed[-1] - passed) / ramp, 0, 1)
            share[touch] = most * rng.uniform(0.8, 1.0) * np.sin(0.5 * np.pi * inside) ** 2
            if one.kind == "loops":  # at one place
                place = places[0] + fresh[touch.start] - fresh[np.searchsorted(time, one.start)]
            of[touch] = place + fresh[touch] - fresh[touch.start]
    z, power = log_impedance(at_rest.x[rows]), np.exp(_POWERS * rng.standard_normal(19))
    x = counts_from_log_impedance(z + share[:, None] ** power * (load[of] - z))
    new = np.maximum.accumulate(np.where(held, 0, np.arange(len(held))))
    force = share[:, None] * force[of] + rng.normal(0, _PLATE, (len(held), 3))
    source = sources.Source(np.rint(x)[new], time, rate, force)
    source.rest = np.median(at_rest.x[rows], 0)
    return source, segments


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
