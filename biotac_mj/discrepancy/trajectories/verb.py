"""`biotac diagnose` of data with poses."""

import argparse
import dataclasses
import pathlib
from collections.abc import Sequence

from ...recordings.recording import Recording
from ...skin.settings import read_dict
from ..report.text import summary
from .model.in_skin import InSkinSimulator
from .model.sensor_file import load_simulator
from .model.simulator import Simulator
from .recorded import trajectories_of
from .report import verdict_of, write_report
from .trajectory import read_trajectories
from .whitening import REPEATABILITY
from .workflow import diagnose

__all__ = ["diagnose_data"]


def diagnose_data(args: argparse.Namespace, recordings: Sequence[Recording] = ()) -> None:
    """`biotac diagnose measured.h5 --effects sensor.yaml --out report/`; recordings: with poses, in place of
    a file of trajectories."""
    out, notes = pathlib.Path(args.out), []
    if args.effects:
        sim = load_simulator(args.effects)
    else:
        sim = InSkinSimulator() if args.in_skin else Simulator(tier=args.tier)
    if args.in_skin and not isinstance(sim, InSkinSimulator):
        raise ValueError(
            f"{args.effects} has constitutive effects in their reduced form: write `constitutive: "
            "in_skin` into it, or leave --in-skin out"
        )
    changes = {"device": args.device, "cache": str(out / "fields")}  # run again after an interruption
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
    else:
        data = read_trajectories(args.data)
    report = diagnose(
        sim,
        data,
        repeatability=1e-3 * args.repeatability if args.repeatability else REPEATABILITY,
        locked=0.25 if args.locked is None else args.locked,
        progress=not args.quiet,
    )
    report.notes[:0] = notes
    files = write_report(report, sim, out)
    print(summary(verdict_of(report)))
    print("  " + " ".join(str(f) for f in files[:3]))
