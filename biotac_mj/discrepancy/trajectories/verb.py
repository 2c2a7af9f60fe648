"""`biotac diagnose` of data with poses, and `biotac next`, which plans what to measure then."""

import argparse
import dataclasses
import pathlib
from collections.abc import Sequence

import numpy as np

from ...geometry.design import BIOTAC
from ...geometry.skins import shipped_skin
from ...recordings.recording import Recording, designed
from ...skin.settings import read_dict
from ..report.text import summary
from .beliefs import ODDS, Beliefs, pooled
from .contacts import Bounds
from .design import planned
from .model.in_skin import InSkinSimulator
from .model.sensor_file import load_simulator
from .model.simulator import Simulator
from .plan_files import write_plan
from .recorded import trajectories_of
from .report import verdict_of, write_report
from .trajectory import read_trajectories
from .whitening import REPEATABILITY
from .workflow import diagnose

__all__ = ["diagnose_data", "plan_next"]


def diagnose_data(args: argparse.Namespace, recordings: Sequence[Recording] = ()) -> None:
    """`biotac diagnose measured.h5 --effects sensor.yaml --out report/`; recordings: with poses, in place of
    a file of trajectories."""
    out, notes = pathlib.Path(args.out), []
    data = [] if recordings else read_trajectories(args.data)
    if args.effects:
        sim = load_simulator(args.effects)
    else:
        counts = (recordings or data)[0].electrodes
        skin = args.skin or shipped_skin(BIOTAC if counts is None else designed(counts), "coarse")
        sim = InSkinSimulator(skin=skin) if args.in_skin else Simulator(skin=skin, tier=args.tier)
    if args.in_skin and not isinstance(sim, InSkinSimulator):
        raise ValueError(
            f"{args.effects} has constitutive effects in their reduced form: write `constitutive: "
            "in_skin` into it, or leave --in-skin out"
        )
    # run again after an interruption, or in a further round
    home = pathlib.Path(args.earlier[0]) if args.earlier else out
    changes = {"device": args.device, "cache": str(home / "fields")}
    if args.skin:
        changes["skin"] = args.skin
    if args.material:
        changes["material"] = args.material
    if args.options:
        changes["options"] = read_dict(args.options, "options")
    sim = dataclasses.replace(sim, **changes)
    if args.device != "cpu" and sim.tier != "full":
        raise ValueError(f"--device {args.device} is for the full tier: add --tier full, or leave it out")
    if recordings:
        data, notes = trajectories_of(list(recordings), sim.skin)
    data = pooled(args.earlier or (), data)
    report = diagnose(
        sim,
        data,
        repeatability=args.repeatability if args.repeatability else REPEATABILITY,
        locked=0.25 if args.locked is None else args.locked,
        progress=not args.quiet,
    )
    report.notes[:0] = notes
    files = write_report(report, sim, out)
    report.beliefs.save(out / "round", sim, data)
    print(summary(verdict_of(report, out)))
    print("  " + " ".join(str(f) for f in files[:3]))


def plan_next(args: argparse.Namespace) -> None:
    """`biotac next REPORT --budget 20 --out plan.csv`."""
    beliefs, sim = Beliefs.load(args.report)
    print(beliefs.text)
    if beliefs.decided:
        return
    reach = tuple(args.reach or (-14e-3, -4e-3))
    bounds = Bounds(args.force, args.depth, reach, args.around, args.tilt, tuple(args.tools))
    sim = sim.but(cache=str(pathlib.Path(args.report) / "fields"))
    plan = planned(beliefs, sim, bounds, args.budget, args.candidates, args.seed, not args.quiet)
    for a, b in plan.alike:
        print(f"no contact within these bounds tells {a} from {b}, however often it is made")
    if not plan.contacts:
        return
    for k, one in enumerate(plan.contacts):
        print(f"{k + 1:3d}. {one.contact.text}\n     {one.reason}")
    first = max(plan.nats.items(), key=lambda item: item[1], default=None)
    if first:
        least = min(plan.nats.items(), key=lambda item: item[1])
        print(f"expected of all: {first[1]:.0f} nats for {' against '.join(first[0])},", end=" ")
        print(f"{least[1]:.1f} for {' against '.join(least[0])}; {np.log(ODDS):.0f} are {ODDS:.0f} to 1")
    files = write_plan(plan, args.out)
    print("  " + " ".join(map(str, files)))
    print(f"then: biotac diagnose MEASURED --earlier {args.report} --out NEXT")
