"""`biotac diagnose`."""

import argparse
import pathlib

__all__ = ["diagnose_verb"]


def diagnose_verb(args: argparse.Namespace) -> None:
    """Runs the verb: plain recordings with --electrodes, else the full workflow on a data file."""
    if args.electrodes and args.data:
        raise ValueError("give either DATA (an HDF5 file with --sensor) or --electrodes, not both")
    if not (args.electrodes or args.data):
        raise ValueError(
            "nothing to diagnose: give DATA (HDF5 of measured trajectories) or --electrodes FILE (19 "
            "columns of raw counts)"
        )
    if args.electrodes:
        from .recordings.recording import read_recording
        from .recordings.report import summary, write_report
        from .recordings.search import diagnose_recording

        recording = read_recording(args.electrodes, args.force, args.tdc, args.rate)
        diagnosis = diagnose_recording(recording, args.locked, progress=not args.quiet)
        files = write_report(diagnosis, pathlib.Path(args.out))
        print(summary(diagnosis))
        print("  " + " ".join(str(f) for f in files[:2]))
        return
    from .trajectories.report import diagnose_data

    diagnose_data(args)
