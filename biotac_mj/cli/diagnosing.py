"""The verbs `biotac diagnose`, `biotac next` and `biotac checkup`."""

import argparse
import math

from ..arguments import SEED, check_device, device, output_file, quantity, real, whole
from .common import add_options, add_results, add_verb
from .names import TIERS


def add_diagnose(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    from ..recordings.verbs import add_which

    verb = add_verb(
        verbs,
        "diagnose",
        _diagnose,
        "Find effects in measured data that the simulation lacks; writes report.html and verdict.json.",
    )
    text = (
        "HDF5 of measured trajectories, or a recording, with the object's poses or without "
        "(docs/lab/discrepancy.md)"
    )
    verb.add_argument("data", nargs="?", metavar="DATA", help=text)
    verb.add_argument(
        "--object", metavar="NAME", help="object in DATA, if the file does not name it, such as sphere_7mm"
    )
    text = "scatter of poses between trials (default: 0.05mm)"
    verb.add_argument("--repeatability", type=quantity("length", 5e-3, 1e-7), metavar="LENGTH", help=text)
    text = "folders of earlier reports, whose trajectories are added to DATA"
    verb.add_argument("--earlier", nargs="+", metavar="REPORT", help=text)
    verb.add_argument("--skin", help="mesh that simulates DATA (default: that of --effects, or coarse)")
    text = "simulator to compare with DATA: a sensor_amended.yaml (default: our own sensor)"
    verb.add_argument("--effects", metavar="FILE.yaml", help=text)
    text = (
        "plain recording instead: text, a column of raw counts for each electrode, one row per sample; "
        "or any file of `biotac recording import`; or several, each a series of one sensor"
    )
    verb.add_argument("--electrodes", nargs="+", metavar="FILE", help=text)
    add_which(verb)
    verb.add_argument("--force", metavar="FILE", help="with --electrodes: Fx Fy Fz [N] row by row")
    verb.add_argument(
        "--tdc", metavar="FILE", help="with --electrodes: raw counts of the thermistor row by row"
    )
    text = (
        "plain recording of a checkup: when each step was done, as `biotac recording record --protocol` "
        "wrote it"
    )
    verb.add_argument("--protocol", metavar="FILE.yaml", help=text)
    text = "rows per second (default: guessed from repeated rows, else 100)"
    verb.add_argument("--rate", type=real(1e-3, 1e6), default=None, metavar="HZ", help=text)
    text = (
        "flat presses with --force: fit each row's pose in simulated states (computed once, in "
        "minutes) and report the stage of the model that disagrees"
    )
    verb.add_argument("--simulate", action="store_true", help=text)
    text = "electrodes and force of another sensor, with --simulate: common errors are the base model's"
    verb.add_argument("--also", nargs=2, action="append", metavar=("E", "F"), help=text)
    kept = (
        "fraction of the data held out for the test (default: "
        "0.4 of the rows, 0.3 with --force, a quarter of the trajectories)"
    )
    verb.add_argument("--locked", type=real(0.05, 0.9), default=None, metavar="FRACTION", help=kept)
    text = "skin that simulates DATA; condensed is faster, but its own error may look like an effect"
    verb.add_argument("--tier", default="full", choices=TIERS, help=text)
    verb.add_argument(
        "--material",
        help="material of the skin that simulates DATA: a preset, a .json file of a material, or JSON",
    )
    add_options(verb)
    text = "constitutive effects inside the finite elements (full tier) in the proof"
    verb.add_argument("--in-skin", action="store_true", help=text)
    text = "device of the full tier: cpu, or a CUDA device such as cuda:0"
    verb.add_argument("--device", type=device, default="cpu", help=text)
    files = "report.html", "verdict.json", "sensor_amended.yaml"
    add_results(verb, "out/diagnose", "folder of the report", *files)


def add_next(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(
        verbs,
        "next",
        "discrepancy.verbs.next_verb",
        "Plan contacts that separate the explanations left by a diagnosis; writes poses over time.",
    )
    verb.add_argument(
        "report", metavar="REPORT", help="folder that `biotac diagnose` of data with poses wrote"
    )
    verb.add_argument("--budget", type=whole(1, 500), default=20, metavar="N", help="contacts, at most")
    verb.add_argument("--force", type=real(0.05, 50), default=3.0, metavar="N", help="largest force")
    verb.add_argument("--depth", type=quantity("length", 2.5e-3, 1e-4), default="1.5mm", help="largest depth")
    text = "along the finger, tip at -x (default: -14mm -4mm)"
    verb.add_argument(
        "--reach", nargs=2, type=quantity("length", 5e-3, -25e-3), metavar=("FROM", "TO"), help=text
    )
    quarter = quantity("angle", math.pi / 2, 0.0)
    verb.add_argument("--around", type=quarter, default="30deg", help="largest angle around the finger")
    verb.add_argument("--tilt", type=quarter, default="20deg", help="largest tilt from the skin's normal")
    verb.add_argument("--tools", nargs="+", default=["sphere_7mm"], metavar="NAME", help="to touch with")
    verb.add_argument(
        "--candidates", type=whole(4, 500), default=32, metavar="N", help="contacts to choose from"
    )
    verb.add_argument("--seed", type=SEED, default=0, help="seed of the contacts to choose from")
    verb.add_argument(
        "--out", type=output_file(), default="out/plan.csv", metavar="FILE.csv", help="file of the plan"
    )
    verb.add_argument("--quiet", action="store_true", help="no progress bar")


def add_checkup(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(
        verbs,
        "checkup",
        "discrepancy.verbs.checkup_verb",
        "Print the steps of a checkup of a sensor, three minutes by hand, and write them as a protocol.",
    )
    verb.add_argument("--against", metavar="NAME", help="object that the sensor will be pressed on")
    out = output_file(new=True)
    verb.add_argument(
        "--out", type=out, default="out/protocol.yaml", metavar="FILE.yaml", help="file of the protocol"
    )


def _diagnose(args):
    from ..discrepancy import verbs

    if args.tier == "full":
        check_device(args.device)
    verbs.diagnose_verb(args)
