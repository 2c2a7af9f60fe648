"""Arguments of the verbs `biotac recording import`, `export`, `show` and `record`."""

import argparse
import os
from collections.abc import Callable

from ..arguments import output_file, output_folder, quantity, real, whole
from ..files import quoted, refuse_existing

_FORMS = ("biotac_sensors", "tactile_msgs")


def add_verbs(verbs: argparse._SubParsersAction, verb: Callable[..., argparse.ArgumentParser]) -> None:
    """Adds them to argparse's subparsers; verb(verbs, name, run, text) makes one."""
    v = verb(
        verbs,
        "import",
        _import,
        "Read recordings of real BioTacs (text, CSV, MATLAB, .btd, ROS bags, HDF5) into one file; "
        "reports clock gaps, dropped and repeated rows, units, rate.",
    )
    v.add_argument("files", nargs="+", metavar="FILE", help="files of a sensor, and of its forces and poses")
    add_load_arguments(v)
    recording = output_file(".h5", new=True)
    v.add_argument("--out", type=recording, required=True, metavar="FILE.h5", help="file to write")
    v = verb(
        verbs,
        "export",
        _export,
        "Write a recording, or the skin.h5 of a simulated press, as the bag of a driver of the real sensor.",
    )
    v.add_argument(
        "file", metavar="FILE", help="skin.h5 of a press, or any file of `biotac recording import`"
    )
    add_which(v)
    add_load_arguments(v)
    bag = v.add_mutually_exclusive_group(required=True)
    bag.add_argument("--ros1", type=output_file(".bag", new=True), metavar="OUT.bag", help="a bag of ROS 1")
    bag.add_argument(
        "--ros2", type=output_folder(new=""), metavar="OUT", help="a bag of ROS 2: a folder to make"
    )
    v.add_argument("--form", default="biotac_sensors", choices=_FORMS, help="package of the messages")
    v = verb(verbs, "show", _show, "Draw a recording: electrodes, pressure, vibration, temperature, force.")
    v.add_argument("files", nargs="+", metavar="FILE", help="output or input of `biotac recording import`")
    add_which(v)
    add_load_arguments(v)
    picture = output_file(picture=True)
    v.add_argument("--out", type=picture, default="out/show.png", metavar="PNG", help="file of the picture")
    v = verb(
        verbs, "record", _record, "Record a running sensor: a topic of ROS, or lines from a serial port."
    )
    source = v.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--topic", nargs="+", metavar="NAME", help="topic of ROS 1 or 2, those of poses and forces too"
    )
    source.add_argument("--serial", metavar="PORT", help="as /dev/ttyUSB0, each line a row of numbers")
    v.add_argument("--baud", type=whole(50, 10**8), default=115200, help="baud rate of --serial")
    text = "names in --serial's lines, as time e1 e2 pdc (default: a header, or all electrodes in order)"
    v.add_argument("--columns", nargs="+", metavar="NAME", help=text)
    text = "duration (default: 10s, or that of the protocol)"
    v.add_argument("--seconds", type=quantity("time", 1e6, 0.01), metavar="TIME", help=text)
    text = (
        "announce the steps of a checkup from this plan (`biotac checkup`); when each was done is "
        "written beside the recording, as OUT_timeline.yaml"
    )
    v.add_argument("--protocol", metavar="FILE.yaml", help=text)
    v.add_argument("--object", metavar="NAME", help="name of the touching object")
    v.add_argument("--out", type=recording, required=True, metavar="FILE.h5", help="file to write")


def add_which(verb: argparse.ArgumentParser) -> None:
    """Adds the choice of a file's recording as `which`."""
    verb.add_argument(
        "--recording", dest="which", metavar="NAME", help="name, if the file has several (default: the first)"
    )


def add_load_arguments(
    verb: argparse.ArgumentParser, touched: str = "object that touched (default: from the files)"
) -> None:
    """Adds arguments for what files do not contain. touched: help of --object."""
    verb.add_argument(
        "--rate", type=real(0.5, 1e4), metavar="HZ", help="rate of rows without times (default: guessed)"
    )
    verb.add_argument(
        "--scale", type=real(1e-9, 1e9), help="counts per unit of the channels: 4095 if they are normalised"
    )
    verb.add_argument("--object", metavar="NAME", help=touched)


def load_given(args: argparse.Namespace) -> list:
    """Recordings of a command's files."""
    from .importers import load

    return load(args.files, rate=args.rate, scale=args.scale, object_name=args.object)


def _import(args):
    _written(args.out, load_given(args))


def _written(path, recordings):
    """Writes recordings and prints what is in them."""
    from .inspection import findings
    from .recording import write

    write(path, recordings)
    for one in recordings:
        print(f"{one.name}: " + "\n  ".join(findings(one)))
    print(f"written: {path}; see it with `biotac recording show {quoted(path)}`")


def _export(args):
    from .formats.bags import write_bag
    from .importers import load_one

    recording, notes = load_one(
        args.file, args.which, rate=args.rate, scale=args.scale, object_name=args.object
    )
    out, ros = (args.ros1, 1) if args.ros1 else (args.ros2, 2)
    topics = write_bag(out, recording, ros, args.form)
    for note in notes:
        print(f"  note: {note}")
    print(f"written: {out}, {len(recording)} rows on {', '.join(topics)}")


def _show(args):
    from .importers import choose
    from .inspection import findings
    from .picture import draw

    one, others = choose(load_given(args), " ".join(args.files), args.which)
    draw(one, args.out)
    print(f"{one.name}: " + "\n  ".join([*findings(one), *others]))
    print(f"written: {args.out}")


def _record(args):
    timeline = f"{os.path.splitext(args.out)[0]}_timeline.yaml" if args.protocol else None
    recordings = _prompted(args, timeline) if timeline else _recorded(args, args.seconds or 10.0)
    _written(args.out, recordings)
    if timeline:
        print(f"written: {timeline}; next: biotac diagnose {quoted(args.out)} --protocol {quoted(timeline)}")


def _recorded(args, seconds):
    from .live import record_serial, record_topics

    if args.topic:
        return record_topics(args.topic, seconds, args.object)
    return record_serial(args.serial, args.baud, seconds, args.columns, args.object)


def _prompted(args, timeline):
    """Records while the steps of the protocol are announced; writes their timeline."""
    from .protocol import Prompter, read_protocol, write_protocol

    plan = read_protocol(args.protocol)
    refuse_existing(timeline)
    with Prompter(plan, lambda line: print(line, flush=True)) as prompter:
        recordings = _recorded(args, args.seconds or plan.seconds)
    write_protocol(timeline, prompter.timeline(recordings[0].time))
    return recordings
