"""The `biotac` command: one verb per job. The work of a verb lives beside this file and is loaded when the
verb is used."""

import argparse
import errno
import os
import sys
import traceback

from .arguments import SEED, Parser, add_ray, check_device, device, output_file, output_folder, real, whole
from .files import check_output_file

__all__ = ["main", "parser"]

# Names that the help shows without loading what defines them (tests hold them together).
INDENTERS = (
    "sphere_3-5mm sphere_7mm sphere_14mm cylinder_short_3-5mm cylinder_short_7mm cylinder_long_7mm "
    "cube_14mm ring_7mm"
).split()
TIERS = ("full", "condensed")
MATERIALS = ("default", "paper", "rubber", "ansys", "calibrated")
SKINS = ("coarse", "default", "fine")
PEGS = "peg_round_4mm peg_round_8mm peg_square_5mm peg_square_10mm peg_hexagon_8mm peg_triangle_8mm".split()
OBJECTS = (*INDENTERS, *PEGS, "table_surface", "table_edge", "table_corner")
INTERACTIONS = ("press", "slide", "twist", "tap")
CONFIGURATIONS = ("deformable_shell", "shell_with_core", "solid_with_core", "solid")


class _Formatter(argparse.ArgumentDefaultsHelpFormatter):
    """Defaults where they say something."""

    def _get_help_string(self, action):
        return action.help if action.default in (None, False, True) else super()._get_help_string(action)


_INDENTER_HELP = (
    f"one of {', '.join(INDENTERS)} (the number is a diameter); or geom:TYPE:SIZE[,SIZE...] with MuJoCo's "
    "sphere, capsule, cylinder, "
    "ellipsoid, box or plane and its sizes in metres, as in geom:capsule:0.003,0.005; or mesh:FILE in metres"
)
_LOCATION_HELP = (
    "where: X; or X ANGLE, around the finger in degrees, 0 on the pad's midline, positive towards +z; or X "
    "Y Z, moved to the nearest point "
    "of the skin. BioTac frame: tip at -x, pad at -y, nail at +y"
)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    from . import __version__

    top = Parser(prog="biotac", description="A SynTouch BioTac fingertip in MuJoCo.")
    top.add_argument("--version", action="version", version=f"biotac_mj {__version__}")
    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    _add_press(verbs)
    _add_samples(verbs)
    _add_view(verbs)
    _add_mount(verbs)
    _add_import_mesh(verbs)
    _add_calibrate(verbs)
    _add_compare(verbs)
    _add_diagnose(verbs)
    _add_generate(verbs)
    _add_data(verbs)
    _add_recordings(verbs)
    _add_resimulation(verbs)
    _add_learning(verbs)
    return top


def _verb(verbs, name, run, text):
    verb = verbs.add_parser(name, help=text, description=text, formatter_class=_Formatter)
    verb.set_defaults(run=run)
    return verb


def _add_skin(verb, seed="of the sensor's noise"):
    verb.add_argument(
        "--skin",
        default="default",
        help=f"mesh of the skin: {', '.join(SKINS)}, or a file made by `biotac import-mesh`",
    )
    verb.add_argument(
        "--tier",
        default="full",
        choices=TIERS,
        help="full finite elements, or the condensed skin for real time on one core",
    )
    verb.add_argument(
        "--material", default="default", help=f"{', '.join(MATERIALS)}, a .json file of a material, or JSON"
    )
    verb.add_argument(
        "--liquid",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="liquid under the skin (default: the material's choice)",
    )
    verb.add_argument("--seed", type=SEED, default=0, help=seed)
    verb.add_argument(
        "--device", type=device, default="cpu", help="where the skin is solved: cpu, cuda:0 ..."
    )
    _add_options(verb)


def _add_sensor(verb, touched):
    verb.add_argument(
        "--sensor",
        type=_choice,
        metavar="NAME",
        help="which sensor (default: 1): 1, 2, 3, epfl_f1, epfl_f2, phac_f0, phac_f1, btd_sp, random or JSON",
    )
    verb.add_argument(
        "--randomise",
        nargs="+",
        metavar="EFFECT",
        help="effects that are drawn: gain dead crosstalk pdc_gain relax warmup fluidloss drift",
    )
    verb.add_argument(
        "--effects",
        metavar="FILE.yaml",
        help="a sensor that `biotac diagnose` amended: its base model and effects (sensor_amended.yaml)",
    )
    for name, example in (("thermal", "steel"), ("texture", "cork")):
        verb.add_argument(
            f"--{name}",
            nargs="+",
            type=_choice,
            metavar="MATERIAL",
            help=f"of what {touched}, as in {example}, or JSON; of several one is drawn (default: left out)",
        )


def _choice(text):
    """A name, or JSON of a dict."""
    import json

    if text.endswith((".yaml", ".yml")):
        raise argparse.ArgumentTypeError(f"{text!r} is a sensor file: give it as --effects {text}")
    if not text.startswith("{"):
        return text
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no JSON ({error})") from error


def _of_sensor(args):
    """Settings of a press or a set from the arguments of `_add_sensor`."""
    one = {name: getattr(args, name) for name in ("thermal", "texture")}
    one = {name: v[0] if v and len(v) == 1 else v for name, v in one.items()}  # of several one is drawn
    return {"sensor": args.sensor, "randomise": args.randomise, **one}


def _add_options(verb, name="--options", of="the skin"):
    verb.add_argument(
        name,
        metavar="JSON",
        help=f"further settings of {of}, JSON or a file of it: "
        '{"skin": {"contact_law": {"adhesion": 0.05}}, "modulus": "factors.npy"} (docs/features.md)',
    )


def _add_press(verbs):
    verb = _verb(
        verbs,
        "press",
        _press,
        "Press an indenter into the BioTac; writes readings.csv, skin.h5 and press.png.",
    )
    verb.add_argument("--indenter", default="sphere_7mm", metavar="NAME", help=_INDENTER_HELP)
    verb.add_argument(
        "--location", type=real(-1e3, 1e3), nargs="+", default=[-12.0], metavar="MM", help=_LOCATION_HELP
    )
    verb.add_argument(
        "--direction",
        type=real(-1e9, 1e9),
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="of the press (default: inward normal of the skin there)",
    )
    verb.add_argument("--depth", type=real(), default=2.4, metavar="MM", help="travel from first touch")
    verb.add_argument(
        "--slide", type=real(), default=0.0, metavar="MM", help="travel along the skin after the press"
    )
    verb.add_argument(
        "--slide-direction",
        type=real(-1e9, 1e9),
        nargs=3,
        default=[1.0, 0.0, 0.0],
        metavar=("X", "Y", "Z"),
        help="of the slide",
    )
    verb.add_argument("--speed", type=real(), default=10.0, metavar="MM/S", help="of press and slide")
    verb.add_argument(
        "--hold", type=real(), default=20.0, metavar="MS", help="rest at the end of press and slide"
    )
    verb.add_argument("--timestep", type=real(), default=4.0, metavar="MS", help="of MuJoCo")
    ways = verb.add_mutually_exclusive_group()
    ways.add_argument(
        "--one-way",
        dest="two_way",
        action="store_false",
        default=False,
        help="the indenter's path is prescribed (default)",
    )
    ways.add_argument(
        "--two-way",
        dest="two_way",
        action="store_true",
        default=False,
        help="a servo with mass pushes the indenter and gives way",
    )
    verb.add_argument(
        "--mu",
        type=real(0, 100),
        default=None,
        help="friction between skin and indenter (default: the material's)",
    )
    _add_skin(verb)
    _add_sensor(verb, "the indenter is")
    files = output_folder("readings.csv", "skin.h5", "press.png")
    verb.add_argument("--out", type=files, default="out/press", metavar="DIR", help="folder of the results")
    verb.add_argument(
        "--render",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="MuJoCo's render in press.png; "
        "without it, or without a GL library, matplotlib draws the surfaces",
    )
    verb.add_argument("--quiet", action="store_true", help="no progress bar")


def _press(args):
    import math
    import pathlib

    from .press import PressOptions, press, render, report
    from .press.record import write_readings, write_skin

    location = [1e-3 * v for v in args.location]
    if len(location) < 3:
        location = [location[0], math.radians(args.location[1]) if len(location) == 2 else 0.0]
    settings = dict(
        indenter=args.indenter,
        location=tuple(location),
        direction=args.direction and tuple(args.direction),
        depth=1e-3 * args.depth,
        slide=1e-3 * args.slide,
        slide_direction=tuple(args.slide_direction),
        material=args.material,
        liquid=args.liquid,
        skin=args.skin,
        tier=args.tier,
        timestep=1e-3 * args.timestep,
        speed=1e-3 * args.speed,
        hold=1e-3 * args.hold,
        two_way=args.two_way,
        friction=args.mu,
        seed=args.seed,
        device=args.device,
        options=args.options,
        **_of_sensor(args),
    )
    if args.effects:
        from .effects.amended import amend_settings

        settings = amend_settings(settings, PressOptions, args.effects)
    options = PressOptions(**settings)
    check_device(args.device)
    record, picture = press(options, render=render if args.render else None, progress=not args.quiet)
    out = pathlib.Path(args.out)
    files = [out / "readings.csv", out / "skin.h5", out / "press.png"]
    write_readings(record, files[0])
    write_skin(record, files[1])
    report.write_picture(record, files[2], picture)
    if args.render and picture is None:
        print(
            "no GL library works here: "
            "press.png shows the surfaces drawn by matplotlib (libosmesa6 or libegl1 would do)"
        )
    print(report.table(record, files))


def _add_samples(verbs):
    verb = _verb(
        verbs,
        "samples",
        _samples,
        "Make synthetic samples of what diagnose and train read: electrodes.txt, forces.txt, log.csv, set.",
    )
    verb.add_argument("out", type=output_folder(), metavar="DIR", help="folder to make")
    verb.add_argument("--seed", type=SEED, default=0, help="of touches and noise")
    verb.add_argument("--quiet", action="store_true", help="no progress bar")


def _samples(args):
    from .samples import OBJECT, make_samples

    electrodes, forces, log, made = make_samples(args.out, args.seed, not args.quiet)
    print("synthetic, made by the simulation. Next:")
    print(f"  biotac diagnose --electrodes {electrodes} --force {forces}")
    print(f"  biotac diagnose {log} --object {OBJECT}  # some minutes: the skin is solved again and again")
    print(f"  biotac train {made} --no-paper --seeds 0 --splits trajectory")


def _add_view(verbs):
    verb = _verb(
        verbs,
        "view",
        _view,
        "Open MuJoCo's viewer on a BioTac and a ball to press it with: "
        "double-click the ball, then drag with ctrl and right button.",
    )
    _add_skin(verb)
    verb.add_argument(
        "--render",
        type=output_file(),
        metavar="FILE",
        help="write a picture of the ball lying on the pad instead of opening a window",
    )
    verb.add_argument("--seconds", type=real(0, 60), default=0.3, help="how long to simulate before --render")
    verb.add_argument(
        "--hand",
        metavar="FILE",
        help="MJCF of a Shadow Hand (Menagerie): show it with five BioTacs and a ball instead",
    )
    verb.add_argument(
        "--web",
        action="store_true",
        help="a page in the browser with skin, electrodes and traces (extra web)",
    )
    verb.add_argument(
        "--recording", metavar="FILE", help="with --web: play the skin.h5 of a press instead of a simulation"
    )
    verb.add_argument("--port", type=whole(1, 65535), default=8080, help="of the page")


def _view(args):
    from .view import view

    check_device(args.device)
    view(
        skin=args.skin,
        tier=args.tier,
        material=args.material,
        liquid=args.liquid,
        seed=args.seed,
        device=args.device,
        render=args.render,
        seconds=args.seconds,
        hand=args.hand,
        web=args.web,
        recording=args.recording,
        port=args.port,
        options=args.options,
    )


def _add_mount(verbs):
    verb = _verb(
        verbs,
        "mount",
        _mount,
        "Find where a BioTac goes on a hand's link, for attach_to_hand(mount=FILE), and draw it.",
    )
    verb.add_argument("hand", metavar="HAND.xml", help="MJCF of the hand")
    verb.add_argument(
        "--body", nargs="+", required=True, metavar="NAME", help="the links with the fingertips"
    )
    for name, text in (
        ("tip", "where the fingertip points in the link's frame (default: its longest way)"),
        ("pad", "where the pad looks there (default: where its joint bends it to)"),
        ("pos", "of the BioTac's frame there [m] (default: it ends where the link ends)"),
    ):
        verb.add_argument(f"--{name}", type=real(-1e3, 1e3), nargs=3, metavar=("X", "Y", "Z"), help=text)
    verb.add_argument(
        "--replaces",
        nargs="*",
        metavar="GEOM",
        help="geoms that the BioTac stands for (default: all of the link)",
    )
    verb.add_argument("--out", type=output_file(), default="mount.yaml", metavar="FILE", help="the mounts")
    verb.add_argument("--picture", type=output_file(), metavar="PNG", help="the link before and after")


def _mount(args):
    from .tasks.mounting import mount_verb

    mount_verb(args)


def _add_import_mesh(verbs):
    verb = _verb(
        verbs, "import-mesh", _import_mesh, "Read a skin from elsewhere, check it, and store it for --skin."
    )
    verb.add_argument("path", help="folder with .tet and .obj files, or a .tet, .msh, .vtu ... file")
    verb.add_argument(
        "--out",
        metavar="FILE.npz",
        help="where to store it (default: PATH's name with .npz, in the current folder)",
    )


def _import_mesh(args):
    import pathlib

    from .geometry import import_mesh
    from .geometry.card import skin_numbers

    source = pathlib.Path(args.path)
    out = pathlib.Path(args.out or f"{source.resolve().stem}.npz")
    if out.suffix != ".npz":
        raise ValueError(f"--out {out} does not end in .npz: give a name that does, so that --skin finds it")
    check_output_file(out)
    geometry = import_mesh(source)
    numbers = skin_numbers(geometry)
    units = {"angle": "deg", "volume": "mm3", "thickness": "mm"}
    low, high = numbers.pop("box")
    gaps = numbers.pop("gaps")
    for name, value in numbers.items():
        unit = next((u for key, u in units.items() if key in name), "")
        print(f"  {name:<56}{value if isinstance(value, int) else f'{value:.3f}':>10} {unit}")
    for axis, a, b in zip("xyz", low, high):
        print(f"  {'box ' + axis:<56}{a:>10.3f} .. {b:.3f} mm")
    print(f"  {'gap of the electrodes to the skin':<56}{min(gaps):>10.3f} .. {max(gaps):.3f} mm")
    geometry.save(out)
    print(f"  stored in {out}: use it with --skin {out}")


def _add_calibrate(verbs):
    verb = _verb(
        verbs,
        "calibrate",
        _calibrate,
        "Fit E, nu, mu (and other parameters) to the forces of one indentation with shear.",
    )
    verb.add_argument(
        "data",
        nargs="?",
        metavar="DATA",
        help="CSV of the indentation (docs/lab/calibration.md), or skin.h5 of a press",
    )
    verb.add_argument(
        "--synthetic",
        action="store_true",
        help="instead of DATA: our own skin of --truth pressed and slid, with --noise",
    )
    verb.add_argument(
        "--truth", default="rubber", help="material of the synthetic skin; a preset, its liquid with it"
    )
    verb.add_argument(
        "--truth-skin",
        default="default",
        help="mesh of the synthetic skin; refined:NAME cuts each tetrahedron into eight",
    )
    verb.add_argument(
        "--truth-liquid",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="(default: as the preset --truth has it)",
    )
    verb.add_argument(
        "--noise",
        type=real(0, 1e3),
        default=0.01,
        metavar="N",
        help="of each synthetic force component, standard deviation",
    )
    verb.add_argument("--seed", type=SEED, default=0, help="of that noise")
    verb.add_argument(
        "--indenter", default=None, metavar="NAME", help=f"what pressed, needed with CSV: {_INDENTER_HELP}"
    )
    verb.add_argument(
        "--direction",
        type=real(-1e9, 1e9),
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="the indenter's tip points there (default: +y)",
    )
    verb.add_argument(
        "--configuration", default="shell_with_core", choices=CONFIGURATIONS, help="what is fitted"
    )
    verb.add_argument(
        "--skin", default="coarse", help=f"its mesh: {', '.join(SKINS)}, or a file; solids come as coarse"
    )
    verb.add_argument(
        "--correct",
        action="store_true",
        help="correct the fit by the mesh refined: the material, not the mesh's stiffness",
    )
    verb.add_argument(
        "--material",
        default="paper",
        help=f"law and starting values: {', '.join(MATERIALS)}, or a material's or calibration's .json",
    )
    _add_options(verb)
    _add_options(verb, "--truth-options", "the synthetic skin")
    verb.add_argument(
        "--liquid",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="liquid under the skin; matters for E and nu",
    )
    verb.add_argument(
        "--fit",
        nargs="+",
        default=["E", "nu", "mu"],
        metavar="NAME[:LOW:HIGH]",
        help="parameters, with bounds if you like",
    )
    verb.add_argument(
        "--device", type=device, default="cpu", help="where the skin is solved: cpu, cuda:0 ..."
    )
    verb.add_argument(
        "--out",
        type=output_folder("calibration.json", "calibration.png", "synthetic.csv"),
        default="out/calibrate",
        metavar="DIR",
        help="folder of calibration.json and calibration.png",
    )
    verb.add_argument("--quiet", action="store_true", help="no progress bar")


def _calibrate(args):
    from .calibration import verbs

    check_device(args.device)
    verbs.calibrate_verb(args)


def _add_compare(verbs):
    verb = _verb(
        verbs,
        "compare",
        _compare,
        "Compare the paper's four configurations with a reference over many indentations.",
    )
    verb.add_argument(
        "--configurations",
        nargs="+",
        default=list(CONFIGURATIONS),
        choices=CONFIGURATIONS,
        metavar="NAME",
        help="which",
    )
    verb.add_argument(
        "--data",
        nargs="+",
        metavar="INDENTER=FILE",
        help="measured indentations, not our stand-in; the first calibrates",
    )
    verb.add_argument(
        "--indenters", nargs="+", default=INDENTERS, choices=INDENTERS, metavar="NAME", help="which"
    )
    verb.add_argument(
        "--count", type=whole(1, 10_000), default=1, help="random indentations for each indenter"
    )
    verb.add_argument("--seed", type=SEED, default=0, help="of the indentations")
    verb.add_argument(
        "--reference-material", default="rubber", help="of the stand-in: a preset, its liquid with it"
    )
    verb.add_argument("--reference-skin", default="coarse", help="mesh of the stand-in")
    verb.add_argument(
        "--reference-element",
        default="quadratic",
        choices=("linear", "quadratic"),
        help="elements of the stand-in",
    )
    verb.add_argument("--skin", default="coarse", help=f"mesh of the shells: {', '.join(SKINS)}, or a file")
    verb.add_argument(
        "--material",
        help="given to all configurations, preset or a material's or calibration's .json (default: "
        "each is calibrated first)",
    )
    _add_options(verb)
    _add_options(verb, "--reference-options", "the stand-in")
    verb.add_argument(
        "--liquid", action=argparse.BooleanOptionalAction, default=False, help="liquid in the shells"
    )
    verb.add_argument(
        "--device", type=device, default="cpu", help="where the skin is solved: cpu, cuda:0 ..."
    )
    files = output_folder("compare.json", "compare.kept")
    verb.add_argument(
        "--out", type=files, default="out/compare", metavar="DIR", help="folder of compare.json"
    )
    verb.add_argument("--quiet", action="store_true", help="no progress bar")


def _compare(args):
    from .calibration import verbs

    check_device(args.device)
    verbs.compare_verb(args)


def _add_learning(verbs):
    from .learning.verbs import add_verbs

    add_verbs(verbs, _verb)


def _add_generate(verbs):
    verb = _verb(
        verbs,
        "generate",
        _generate,
        "Make a synthetic data set of random interactions; goes on where it was interrupted.",
    )
    verb.add_argument("--count", type=whole(1, 10_000_000), default=2600, help="interactions")
    verb.add_argument("--steps", type=whole(8, 2000), default=20, help="time steps of each")
    verb.add_argument("--rate", type=real(1e-3, 1e6), default=20.0, metavar="HZ", help="of the time steps")
    verb.add_argument(
        "--labelled",
        type=whole(0, 10_000_000),
        help="of them, how many get the synthetic measured sensor's counts too (default: 359)",
    )
    verb.add_argument(
        "--recordings",
        type=whole(0, 10_000_000),
        default=0,
        help="further interactions of which only the synthetic sensor's counts are kept",
    )
    verb.add_argument(
        "--objects", nargs="+", default=list(OBJECTS), choices=OBJECTS, metavar="NAME", help="what touches"
    )
    verb.add_argument(
        "--kinds",
        nargs="+",
        default=list(INTERACTIONS),
        choices=INTERACTIONS,
        metavar="KIND",
        help="how it moves",
    )
    verb.add_argument(
        "--element",
        choices=("linear", "quadratic"),
        help="of the skin (default: the material's, or the mesh's)",
    )
    verb.add_argument(
        "--batch",
        type=whole(1, 100_000),
        default=160,
        help="worlds at most that are solved together; a shard holds one batch",
    )
    verb.add_argument(
        "--measured-batch",
        type=whole(1, 100_000),
        default=90,
        help="the same where the synthetic measured sensor takes part",
    )
    verb.add_argument("--measured-seed", type=SEED, default=0, help="number of the synthetic measured sensor")
    verb.add_argument("--measured-skin", default="fine", help="mesh of the synthetic measured sensor")
    verb.add_argument(
        "--workers",
        type=whole(0, 1024),
        help="processes that compute electrode readings (default: one per core)",
    )
    verb.add_argument(
        "--vary",
        metavar="JSON",
        help="drawn anew for each interaction, JSON or a file of it: "
        '{"youngs_modulus": [1e6, 2e6], "adhesion": [0, 0.1]}',
    )
    _add_skin(verb, seed="of all random numbers: the same seed gives the same files on the same device")
    _add_sensor(verb, "the objects are")
    verb.add_argument(
        "--out",
        type=output_folder("generate.json"),
        default="out/set",
        metavar="DIR",
        help="folder of the set",
    )
    add_ray(verb)
    verb.add_argument("--quiet", action="store_true", help="no progress bar")


def _generate(args):
    from .data import verbs

    if args.ray is None:  # a cluster has its own devices
        check_device(args.device)
    verbs.generate_verb(args)


def _add_diagnose(verbs):
    verb = _verb(
        verbs,
        "diagnose",
        _diagnose,
        "Name what the simulation misses in measured data; writes report.html and verdict.json.",
    )
    verb.add_argument(
        "data",
        nargs="?",
        metavar="DATA",
        help="HDF5 of measured trajectories, or a recording, with the object's poses or without "
        "(docs/lab/discrepancy.md)",
    )
    verb.add_argument(
        "--object", metavar="NAME", help="what touched in DATA, where it does not say, as sphere_7mm"
    )
    verb.add_argument(
        "--repeatability",
        type=real(1e-4, 5),
        metavar="MM",
        help="by which poses differ from trial to trial (default: 0.05)",
    )
    verb.add_argument("--skin", help="mesh that simulates DATA (default: coarse, or what --sensor says)")
    verb.add_argument(
        "--sensor",
        metavar="FILE.yaml",
        help="the simulator that is compared with DATA (default: our own sensor)",
    )
    verb.add_argument(
        "--electrodes",
        metavar="FILE",
        help="plain recording instead: text, 19 columns of raw counts, one row per sample",
    )
    verb.add_argument("--force", metavar="FILE", help="beside --electrodes: Fx Fy Fz [N] row by row")
    verb.add_argument(
        "--tdc", metavar="FILE", help="beside --electrodes: raw counts of the thermistor row by row"
    )
    verb.add_argument(
        "--rate",
        type=real(1e-3, 1e6),
        default=None,
        metavar="HZ",
        help="rows per second (default: guessed from repeated rows, else 100)",
    )
    verb.add_argument(
        "--simulate",
        action="store_true",
        help="flat presses with --force: fit each row's pose in simulated states (made the first time, in "
        "minutes) and say in which stage of the model the rest disagrees",
    )
    verb.add_argument(
        "--also",
        nargs=2,
        action="append",
        metavar=("E", "F"),
        help="electrodes and force of another sensor: with --simulate what both share is the base model's",
    )
    kept = (
        "of the data, kept aside for the proof (default: "
        "0.4 of the rows, 0.3 with --force, a quarter of the trajectories)"
    )
    verb.add_argument("--locked", type=real(0.05, 0.9), default=None, metavar="SHARE", help=kept)
    verb.add_argument("--tier", default="condensed", choices=TIERS, help="skin that simulates DATA")
    verb.add_argument(
        "--material", help="of the skin that simulates DATA: a preset, a .json file of a material, or JSON"
    )
    _add_options(verb)
    verb.add_argument(
        "--in-skin",
        action="store_true",
        help="constitutive effects inside the finite elements (full tier) in the proof",
    )
    verb.add_argument(
        "--device", type=device, default="cpu", help="of the full tier: cpu, or a CUDA device such as cuda:0"
    )
    files = output_folder("report.html", "verdict.json", "sensor_amended.yaml")
    verb.add_argument("--out", type=files, default="out/diagnose", metavar="DIR", help="folder of the report")
    verb.add_argument("--quiet", action="store_true", help="no progress bar")


def _diagnose(args):
    from .discrepancy import verbs

    if args.tier == "full":
        check_device(args.device)
    verbs.diagnose_verb(args)


def _add_data(verbs):
    from .recordings.verbs import add_load_arguments

    verb = _verb(
        verbs,
        "import-data",
        _import_data,
        "Read recordings of real sensors, whatever `biotac import` reads, into a set.",
    )
    verb.add_argument("files", nargs="+", metavar="FILE", help="each becomes a shard")
    verb.add_argument("--force", metavar="FILE", help="forces row by row, text of 3 columns [N]")
    verb.add_argument(
        "--block",
        type=real(1e-3, 1e9),
        metavar="S",
        help="cut into interactions of this length (they end at gaps of half a second in any case)",
    )
    verb.add_argument(
        "--objects", nargs="+", metavar="NAME", help="NVIDIA's files: names of indenter types 0, 1, ..."
    )
    add_load_arguments(verb)
    verb.add_argument("--seed", type=SEED, default=0, help="of the split by interaction")
    verb.add_argument("--out", type=output_folder(), required=True, metavar="DIR", help="folder of the set")
    verb = _verb(
        verbs, "export-data", _export_data, "Write a set in the directory layout of LeRobotDataset v3.0."
    )
    verb.add_argument("set", metavar="SET", help="folder of shards")
    verb.add_argument(
        "--measured",
        action="store_true",
        help="measured counts, of interactions that have them, not simulated ones",
    )
    verb.add_argument(
        "--rate",
        type=real(0.1, 1e4),
        metavar="HZ",
        help="of frames, which hold the nearest rows (default: the set's)",
    )
    verb.add_argument("--out", type=output_folder(), required=True, metavar="DIR", help="folder to make")
    verb.add_argument("--quiet", action="store_true", help="no progress bar")


def _add_recordings(verbs):
    from .recordings.verbs import add_verbs

    add_verbs(verbs, _verb)


def _add_resimulation(verbs):
    from .resimulation.verbs import add_verb

    add_verb(verbs, _verb)


def _import_data(args):
    from .data import verbs

    verbs.import_verb(args)


def _export_data(args):
    from .data import verbs

    verbs.export_verb(args)


# what is said of errors of the system beside their own text
_REMEDIES = {
    errno.ENOSPC: "free some space on that disk, or choose another --out",
    errno.EDQUOT: "free some of your quota, or choose another --out",
    errno.EFBIG: "choose an --out where larger files may be",
    errno.EROFS: "choose another --out",
    errno.EACCES: "choose another place, or ask for the right to it",
    errno.EPERM: "choose another place, or ask for the right to it",
    errno.ENAMETOOLONG: "give a shorter name",
}


def _said(error) -> str:
    """An error in one line: cause and remedy."""
    if isinstance(error, OSError) and error.errno:
        where = f"{error.filename}: " if error.filename else ""
        text = f"{where}{error.strerror}: {_REMEDIES.get(error.errno, 'check the path, then try again')}"
    elif isinstance(error, MemoryError):
        text = "this needs more memory than there is: ask for fewer steps, worlds or interactions at once"
    else:
        text = str(error)
    return " ".join(text.split())


def main(argv=None) -> int:
    """Runs a verb; bad input is one line on stderr and exit code 2.

    What nobody expected is one line too, with exit code 70; BIOTAC_TRACEBACK=1 in the environment shows all.
    """
    try:
        args = parser().parse_args(argv)
        args.run(args)
        sys.stdout.flush()
    except BrokenPipeError:  # who read the output has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, OSError, MemoryError) as error:
        print(f"biotac: error: {_said(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("biotac: stopped", file=sys.stderr)
        return 130
    except Exception as error:
        if os.environ.get("BIOTAC_TRACEBACK"):
            raise
        place = traceback.extract_tb(error.__traceback__)[-1]
        print(
            f"biotac: error: unexpected {type(error).__name__} in {os.path.basename(place.filename)}, line "
            f"{place.lineno}: {_said(error)[:200]}; BIOTAC_TRACEBACK=1 shows all of it, please report it",
            file=sys.stderr,
        )
        return 70
    return 0


if __name__ == "__main__":
    sys.exit(main())
