"""`biotac diagnose`, `biotac next` and `biotac checkup`."""

import argparse
import os
import pathlib

__all__ = ["checkup_verb", "diagnose_verb", "next_verb"]


_OF_POSES = ("object", "effects", "skin", "material", "options", "repeatability", "in_skin", "earlier")


def diagnose_verb(args: argparse.Namespace) -> None:
    """Runs the verb: plain recordings with --electrodes, else the full workflow on a data file."""
    if args.electrodes and args.data:
        raise ValueError(
            f"{args.data[:80]} and --electrodes {args.electrodes[:80]} are both given: leave one of them out"
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
            args.electrodes = args.data
    elif args.which and not args.electrodes:
        raise ValueError(f"--recording is of a log, and {args.data[:80]} holds trajectories: leave it out")
    if args.data and args.object and not recordings:
        raise ValueError(f"{args.data[:80]} says itself what touched: leave --object out")
    if args.also and not args.simulate or args.simulate and not (args.electrodes and args.force):
        raise ValueError(
            "--simulate needs a flat press with its force, and --also needs --simulate: give "
            "--electrodes E.txt --force F.txt --simulate"
        )
    idle = [name for name in _OF_POSES if getattr(args, name)] if args.electrodes else []
    if idle:
        raise ValueError(
            f"{' and '.join('--' + name.replace('_', '-') for name in idle)} act on what is simulated along "
            f"poses, and {args.electrodes} has none: leave out, or give a recording with the object's poses"
        )
    if args.protocol and not args.electrodes:
        raise ValueError(
            "--protocol is of a plain recording, and this data has the object's poses: leave it out"
        )
    if args.electrodes:
        from .recordings.recording import read_recording
        from .recordings.report import verdict_of, write_report
        from .recordings.search import diagnose_recording
        from .report.text import summary

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
        files = write_report(diagnosis, pathlib.Path(args.out))
        print(summary(verdict_of(diagnosis)))
        print("  " + " ".join(str(f) for f in files[:2]))
        if args.simulate:
            from .simulated.verb import diagnose_with_states

            diagnose_with_states([recording, *others], pathlib.Path(args.out), args.quiet, first=diagnosis)
        return
    from .trajectories.verb import diagnose_data

    diagnose_data(args, recordings)


def next_verb(args: argparse.Namespace) -> None:
    """Runs the verb on a report's folder."""
    from .trajectories.verb import plan_next

    plan_next(args)


def checkup_verb(args: argparse.Namespace) -> None:
    """Says the steps of a checkup and writes them as a protocol."""
    from ..recordings.protocol import STEPS, Protocol, write_protocol

    plan = Protocol.planned(args.against or "")
    for number, one in enumerate(plan.segments, 1):
        step = STEPS[one.kind]
        print(f"{number}. {one.start:.0f} to {one.stop:.0f} s, {one.kind}: {step.line} Tells {step.tells}.")
    write_protocol(args.out, plan)
    print(
        f"written: {args.out}; next: `biotac recording record --topic NAME --protocol {args.out} --out "
        "checkup.h5` prompts the steps; or record by other means, and write into it when each was done"
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
