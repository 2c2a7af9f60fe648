"""The verbs `biotac lab calibrate`, `compare` and `estimate`."""

import argparse

from ..arguments import SEED, output_file, real, whole
from ..recordings.verbs import add_load_arguments
from .common import add_device, add_liquid, add_options, add_results, add_verb
from .names import CONFIGURATIONS, INDENTER_HELP, INDENTERS, MATERIALS, SKINS


def add_calibrate(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(
        verbs,
        "calibrate",
        "calibration.verbs.calibrate_verb",
        "Fit E, nu, mu (and other parameters) to the forces of one indentation with shear.",
    )
    text = "CSV of the indentation (docs/lab/calibration.md), or skin.h5 of a press"
    verb.add_argument("data", nargs="?", metavar="DATA", help=text)
    text = "instead of DATA: our own skin of --truth pressed and slid, with --noise"
    verb.add_argument("--synthetic", action="store_true", help=text)
    verb.add_argument(
        "--truth", help="material of the synthetic skin; a preset, including its liquid (default: rubber)"
    )
    verb.add_argument(
        "--truth-skin",
        help="mesh of the synthetic skin; refined:NAME cuts each tetrahedron into eight (default: the "
        "default one of --skin's design)",
    )
    said = "liquid under the synthetic skin (default: as the preset --truth has it)"
    add_liquid(verb, None, said, "truth-")
    text = "noise of each synthetic force component, standard deviation (default: 0.01)"
    verb.add_argument("--noise", type=real(0, 1e3), metavar="N", help=text)
    verb.add_argument("--seed", type=SEED, default=0, help="seed of that noise")
    verb.add_argument(
        "--indenter", default=None, metavar="NAME", help=f"indenter, required for CSV: {INDENTER_HELP}"
    )
    text = "the indenter's tip points there (default: +y)"
    verb.add_argument("--direction", type=real(-1e9, 1e9), nargs=3, metavar=("X", "Y", "Z"), help=text)
    verb.add_argument(
        "--configuration", default="shell_with_core", choices=CONFIGURATIONS, help="what is fitted"
    )
    verb.add_argument(
        "--skin", default="coarse", help=f"its mesh: {', '.join(SKINS)}, or a file; solids come as coarse"
    )
    text = "correct the fit by a refined mesh, to remove the discretisation error"
    verb.add_argument("--correct", action="store_true", help=text)
    text = f"law and starting values: {', '.join(MATERIALS)}, or a material's or calibration's .json"
    verb.add_argument("--material", default="paper", help=text)
    add_options(verb)
    add_liquid(verb, False, "liquid under the skin; matters for E and nu")
    text = "parameters, optionally with bounds"
    verb.add_argument("--fit", nargs="+", default=["E", "nu", "mu"], metavar="NAME[:LOW:HIGH]", help=text)
    text = "number of starting points, used if they may improve the fit: forces may jump in the parameters"
    verb.add_argument("--starts", type=whole(1, 100), default=1, help=text)
    add_device(verb)
    files = "calibration.json", "calibration.png"
    verb.set_defaults(forces_of=_forces_of)
    add_results(verb, "out/calibrate", f"folder of {' and '.join(files)}", *files)


def _forces_of(*given):
    try:
        from ..differentiable.fit import forces_of
    except ModuleNotFoundError:
        return None, "differences (gradients need PyTorch, pip install 'biotac-mj[learning]')"
    return forces_of(*given)


def add_compare(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(
        verbs,
        "compare",
        "calibration.verbs.compare_verb",
        "Compare the paper's four configurations with a reference over many indentations.",
    )
    verb.add_argument(
        "--configurations",
        nargs="+",
        default=list(CONFIGURATIONS),
        choices=CONFIGURATIONS,
        metavar="NAME",
        help="configurations to compare",
    )
    text = "measured indentations instead of our reference; the first one is for calibration"
    verb.add_argument("--data", nargs="+", metavar="INDENTER=FILE", help=text)
    text = "indenters of the reference"
    verb.add_argument(
        "--indenters", nargs="+", default=INDENTERS, choices=INDENTERS, metavar="NAME", help=text
    )
    verb.add_argument(
        "--count", type=whole(1, 10_000), default=1, help="random indentations for each indenter"
    )
    verb.add_argument("--seed", type=SEED, default=0, help="seed of the indentations")
    verb.add_argument(
        "--reference-material",
        help="material of the reference: a preset, including its liquid (default: rubber)",
    )
    verb.add_argument("--skin", default="coarse", help=f"mesh of the shells: {', '.join(SKINS)}, or a file")
    verb.add_argument(
        "--material",
        help="given to all configurations, preset or a material's or calibration's .json (default: "
        "each is calibrated first)",
    )
    add_options(verb)
    add_liquid(verb, False, "liquid in the shells")
    add_device(verb)
    verb.set_defaults(forces_of=_forces_of)
    add_results(verb, "out/compare", "folder of compare.json", "compare.json")


def add_estimate(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(
        verbs,
        "estimate",
        "differentiable.estimation.verbs.estimate_verb",
        "Find the contact, its place on the undeformed skin and its force with intervals, that makes the "
        "simulated electrodes read what a recording says.",
    )
    verb.add_argument(
        "file", metavar="FILE", help="a recording as `biotac recording show` reads it, or a row of counts"
    )
    verb.add_argument(
        "--recording", metavar="NAME", help="name of the recording, in a file of several (default: the first)"
    )
    add_load_arguments(verb)
    verb.add_argument(
        "--rest", type=whole(1, 10**6), default=1, help="first rows, whose mean is the sensor at rest"
    )
    verb.add_argument(
        "--sensor", metavar="NAME", help="sensor of the rest counts if no row is without contact, such as 1"
    )
    verb.add_argument(
        "--row", type=int, nargs="+", help="rows to estimate (default: the one that differs most from rest)"
    )
    text = (
        "a recording of the same sensor with force and contact_pos [m] in the BioTac frame, on the "
        "undeformed skin, --rest rows first: its touches calibrate this sensor"
    )
    verb.add_argument("--known", metavar="FILE", help=text)
    verb.add_argument("--touches", type=whole(1, 1000), default=10, help="number of these touches")
    text = f"indenter (default: that of a simulated press, else sphere_7mm): {INDENTER_HELP}"
    verb.add_argument("--indenter", metavar="NAME", help=text)
    verb.add_argument(
        "--skin",
        help=f"mesh: {', '.join(SKINS)}, or a file (default: that of a simulated press, else coarse, of the "
        "recording's design)",
    )
    verb.add_argument(
        "--material",
        help=f"{', '.join(MATERIALS)}, or a material's or calibration's .json; force scales with its modulus",
    )
    add_options(verb)
    verb.add_argument(
        "--out", type=output_file(), default="out/estimate.csv", metavar="FILE", help=".csv or .json"
    )
    verb.add_argument("--quiet", action="store_true", help="no progress bar")
