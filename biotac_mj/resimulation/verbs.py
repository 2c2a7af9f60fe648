"""Arguments of the verb `biotac data resimulate`."""

import argparse
from collections.abc import Callable

from ..arguments import SEED, add_ray, check_device, device, output_folder, real, whole
from ..files import quoted
from ..recordings.verbs import add_load_arguments, add_which

_TEXT = "X Y Z [m], then QW QX QY QZ where it is turned"


def add_verb(verbs: argparse._SubParsersAction, verb: Callable[..., argparse.ArgumentParser]) -> None:
    """Adds it to argparse's subparsers; verb(verbs, name, run, text) makes one."""
    v = verb(
        verbs,
        "resimulate",
        _resimulate,
        "Drive the simulated skin along a recording: a set of deformations and measured electrodes; "
        "continues an interrupted run.",
    )
    v.add_argument(
        "recording", metavar="FILE", help="recording of any kind that `biotac recording import` reads"
    )
    v.add_argument("--force", metavar="FILE", help="its forces: text, 3 columns [N] row by row")
    add_which(v)
    add_load_arguments(v, "object: a name of `biotac data generate --objects`, geom:... or mesh:FILE")
    text = "recorded with the file, or fitted from force and electrodes: a plate pressed by hand"
    v.add_argument("--poses", choices=("recorded", "fitted"), default="recorded", help=text)
    for name, text in (
        ("mount", "pose of the BioTac frame in the frame of the sensor's recorded pose (default: the same)"),
        ("object-pose", "of a stationary object without recorded pose"),
    ):
        v.add_argument(f"--{name}", type=real(-1e3, 1e3), nargs="+", metavar="X", help=f"{text}: {_TEXT}")
    v.add_argument(
        "--at-most", type=real(0.1, 1e4), default=20.0, metavar="HZ", help="most simulated rows per second"
    )
    v.add_argument(
        "--block", type=real(0.1, 1e6), default=5.0, metavar="S", help="length of a touch with fitted poses"
    )
    v.add_argument("--skin", help="mesh of the skin (default: the default of the recording's design)")
    v.add_argument("--material", default="default", help="preset, .json file or JSON of the rubber")
    v.add_argument("--options", metavar="JSON", help="further settings of the skin (docs/features.md)")
    v.add_argument("--batch", type=whole(1, 10_000), default=8, help="touches in a shard, parallel on a GPU")
    v.add_argument("--workers", type=whole(0, 1024), help="processes for the readings (default: one a core)")
    v.add_argument("--seed", type=SEED, default=0, help="seed of the split, and of the simulated noise")
    v.add_argument("--device", type=device, default="cpu", help="where the skin is solved: cpu, cuda:0 ...")
    v.add_argument(
        "--out", type=output_folder("resimulate.json"), required=True, metavar="DIR", help="folder of the set"
    )
    add_ray(v)
    v.add_argument("--quiet", action="store_true", help="no progress bar")


def _resimulate(args):
    from ..recordings import load_one
    from .resimulate import ResimulateOptions, resimulate

    if args.ray is None:  # a cluster has its own devices
        check_device(args.device)
    recording, notes = load_one(
        args.recording, args.which, force=args.force, rate=args.rate, scale=args.scale
    )
    same = "object poses block skin material options batch seed device".split()
    settings = {name: getattr(args, name) for name in same}
    poses = {name: tuple(value) for name in ("mount", "object_pose") if (value := getattr(args, name))}
    options = ResimulateOptions(rate=args.at_most, **settings, **poses)
    report = resimulate(recording, args.out, options, args.workers, not args.quiet, args.ray)
    print(
        f"{report.interactions} touches, {report.steps} time steps, {report.nonconverged} of them not "
        f"converged; {report.made} shards made"
    )
    print(f"simulated and measured electrodes agree: median correlation {report.agreement:.2f}")
    if report.force_rms == report.force_rms:
        print(f"simulated and measured force differ by {report.force_rms:.2f} N RMS")
    for note in [*notes, *report.notes]:
        print(f"  note: {note}")
    print(f"written: {args.out}; next `biotac learn train {quoted(args.out)}`")
