"""`biotac diagnose`, `biotac next` and `biotac checkup`."""

import argparse
import dataclasses
import os
import pathlib
import typing
from collections.abc import Sequence

from ..files import quoted

if typing.TYPE_CHECKING:
    from ..recordings.recording import Recording
    from .plates.diagnosis import PlateDiagnosis
    from .recordings.diagnosis import RecordingDiagnosis
    from .recordings.recording import PlainRecording
    from .report.verdict import Verdict

_OF_POSES = ("object", "effects", "skin", "material", "options", "repeatability", "in_skin", "earlier")


def diagnose_verb(args: argparse.Namespace) -> None:
    """Runs the verb: on a log, on flat presses of one or more sensors (--simulate), or on data with poses."""
    if args.electrodes and args.data:
        raise ValueError(
            f"{args.data[:80]} and --electrodes {args.electrodes[0][:80]} are both given: leave one out"
        )
    if not (args.electrodes or args.data):
        raise ValueError(
            "nothing to diagnose: give DATA (HDF5 of measured trajectories) or --electrodes FILE (a "
            "column of raw counts for each electrode)"
        )
    recordings = []
    if args.data and _is_recording(args.data):
        from ..recordings import load
        from ..recordings.importers import choose

        recordings = load(args.data, force=args.force, tdc=args.tdc, rate=args.rate, object_name=args.object)
        if args.which:
            recordings = [choose(recordings, args.data, args.which)[0]]
        if all(one.object_pos is None for one in recordings):
            args.electrodes = [args.data]
    elif args.which and not args.electrodes:
        raise ValueError(f"--recording is of a log, and {args.data[:80]} holds trajectories: leave it out")
    if args.data and args.object and not recordings:
        raise ValueError(f"{args.data[:80]} records what touched: leave --object out")
    if args.also and not args.simulate or args.simulate and not (args.electrodes and args.force):
        raise ValueError(
            "--simulate needs a flat press with its force, and --also needs --simulate: give "
            "--electrodes E.txt --force F.txt --simulate"
        )
    idle = [name for name in _OF_POSES if getattr(args, name)] if args.electrodes else []
    if idle:
        raise ValueError(
            f"{' and '.join('--' + name.replace('_', '-') for name in idle)} can act only on a simulation "
            f"along poses, and {args.electrodes[0]} has none: leave out, or give a recording with poses "
            "of the object"
        )
    if args.protocol and not args.electrodes:
        raise ValueError(
            "--protocol is of a plain recording, and this data has the object's poses: leave it out"
        )
    if args.electrodes:
        _of_log(args)
    else:
        _of_poses(args, recordings)


def _reported(verdict: "Verdict", folder: pathlib.Path) -> None:
    """Writes a report and prints its summary."""
    from .report.files import write_report
    from .report.text import summary

    command = verdict.next_command.replace("REPORT", quoted(folder))
    verdict = dataclasses.replace(verdict, next_command=command)
    files = write_report(verdict, folder)
    print(summary(verdict))
    print("  " + " ".join(map(str, files[:3])))


def _of_log(args):
    from .recordings.recording import read_recording
    from .recordings.search import diagnose_recording

    protocol = None
    if args.protocol:
        from ..recordings.protocol import read_protocol

        protocol = read_protocol(args.protocol)
    recording = read_recording(args.electrodes, args.force, args.tdc, args.rate, args.which)
    others = [read_recording(*pair) for pair in args.also or ()]  # before the work
    tared = [one for one in (recording, *others) if args.simulate and not one.absolute]
    if tared:  # simulated states have a rest
        raise ValueError(
            f"{tared[0].name}: --simulate needs raw counts 0..4095, these are {tared[0].unit}: leave it "
            "out, or give the log from before its rest was subtracted"
        )
    diagnosis = diagnose_recording(recording, args.locked, not args.quiet, protocol=protocol)
    if args.simulate:
        diagnose_with_states([recording, *others], pathlib.Path(args.out), args.quiet, first=diagnosis)
    else:
        _reported(diagnosis, pathlib.Path(args.out))


def diagnose_with_states(
    recordings: "list[PlainRecording]",
    folder: pathlib.Path,
    quiet: bool = False,
    effects: tuple | None = None,
    first: "RecordingDiagnosis | None" = None,
) -> "PlateDiagnosis":
    """Diagnoses recordings of flat presses against simulated states, prints and writes what it found, beside
    what `first` found in the first of them alone.

    Args:
      effects: those that are tried; None: all of the catalogue. first: None: it is diagnosed.

    Raises:
      ValueError: a recording without force, or with too few loaded rows.
    """
    from ..effects.plate import PLATE
    from ..geometry.design import check_nelectrode
    from ..geometry.skins import load_skin, shipped_skin
    from ..recordings.recording import designed
    from .plates import tables
    from .plates.diagnosis import diagnose_presses

    effects = PLATE if effects is None else effects
    for k, one in enumerate(recordings):
        if one.force is None:
            raise ValueError(f"{one.name}: no force, which a fit of states needs: give Fx Fy Fz [N]")
        if [r.name for r in recordings].count(one.name) > 1:
            one.name = f"{one.name} ({k + 1})"
    design = designed(recordings[0].electrodes)
    for one in recordings:
        check_nelectrode(design, one.electrodes.shape[1], one.name)
    geometry = load_skin(shipped_skin(design, "coarse"))  # states of the default's take ten times as long
    base, states = tables.base_response(geometry, quiet)
    response = tables.with_effects(base, states, geometry, effects, quiet)
    found = diagnose_presses(recordings, response, effects, quiet, first)
    _reported(found, folder)
    return found


def _of_poses(args: argparse.Namespace, recordings: "Sequence[Recording]") -> None:
    """recordings: with poses, in place of a file of trajectories."""
    from ..geometry.design import BIOTAC
    from ..geometry.skins import shipped_skin
    from ..recordings.inspection import warnings
    from ..recordings.recording import designed
    from ..skin.settings import read_dict
    from .trajectories import workflow
    from .trajectories.beliefs import pooled
    from .trajectories.model.in_skin import InSkinSimulator
    from .trajectories.model.sensor_file import load_simulator
    from .trajectories.model.simulator import Simulator
    from .trajectories.recorded import trajectories_of
    from .trajectories.trajectory import read_trajectories
    from .trajectories.whitening import REPEATABILITY

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
    given = {name: getattr(args, name) for name in ("skin", "material", "options") if getattr(args, name)}
    if args.options:
        given["options"] = read_dict(args.options, "options")
    sim = dataclasses.replace(sim, device=args.device, cache=str(home / "fields"), **given)
    if args.device != "cpu" and sim.tier != "full":
        raise ValueError(f"--device {args.device} is for the full tier: add --tier full, or leave it out")
    if recordings:
        data, notes = trajectories_of(list(recordings), sim.skin)
    data = pooled(args.earlier or (), data)
    report = workflow.diagnose(
        sim,
        data,
        repeatability=args.repeatability or REPEATABILITY,
        locked=0.25 if args.locked is None else args.locked,
        progress=not args.quiet,
    )
    report.beliefs.save(out / "round", sim, data)
    doubts = [f"{one.name}: {line}" for one in recordings for line in warnings(one)]
    _reported(dataclasses.replace(report, notes=[*notes, *report.notes], warnings=doubts), out)


def next_verb(args: argparse.Namespace) -> None:
    """Runs the verb on a report's folder: `biotac next REPORT --budget 20 --out plan.csv`."""
    import numpy as np

    from .evidence import ODDS
    from .trajectories.beliefs import Beliefs
    from .trajectories.contacts import Bounds
    from .trajectories.design import planned
    from .trajectories.plan_files import write_plan

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
    print(f"then: biotac diagnose MEASURED --earlier {quoted(args.report)} --out NEXT")


def checkup_verb(args: argparse.Namespace) -> None:
    """Says the steps of a checkup and writes them as a protocol."""
    from ..recordings.protocol import STEPS, Protocol, write_protocol

    plan = Protocol.planned(args.against or "")
    for number, one in enumerate(plan.segments, 1):
        step = STEPS[one.kind]
        print(f"{number}. {one.start:.0f} to {one.stop:.0f} s, {one.kind}: {step.line} Tells {step.tells}.")
    write_protocol(args.out, plan)
    print(
        f"written: {args.out}; next: `biotac recording record --topic NAME --protocol {quoted(args.out)} "
        "--out checkup.h5` prompts the steps; or record by other means, and write into it when each was done"
    )


def _is_recording(path):
    """Whether a file is a recording: no HDF5, one of `biotac recording import`, or one of somebody else's."""
    import h5py

    from ..reading import reading

    if os.path.isdir(path):
        return os.path.isfile(os.path.join(path, "metadata.yaml"))  # a bag of ROS 2
    if not os.path.isfile(path):
        return False  # what reads it says so
    if not h5py.is_hdf5(path):
        return True
    with reading(path, "recording", "copy it again"), h5py.File(path) as file:
        schema = str(file.attrs.get("schema", ""))
        return not schema or schema.startswith("biotac_mj.recording")
