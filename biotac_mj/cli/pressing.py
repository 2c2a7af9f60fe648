"""The verbs `biotac press`, `view`, `play`, `design`, and of groups `samples`, `list`, `mount` and `mesh`."""

import argparse

from ..arguments import SEED, check_device, output_file, output_folder, quantity, real, whole
from ..files import check_output_file, quoted, refuse_inputs
from ..reading import reading
from .common import add_results, add_sensor, add_skin, add_verb
from .names import INDENTER_HELP, LOCATION_HELP, TASKS

_LONGEST_STEP = 0.1  # [s] quasi-static presses use longer internal steps
_LONG_HOLD = 5.0  # [s] a longer one is more likely of milliseconds, and needs its unit


def add_press(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(
        verbs,
        "press",
        _press,
        "Press an indenter into the BioTac; writes readings.csv, skin.h5 and press.png.",
    )
    verb.add_argument("--indenter", default="sphere_7mm", metavar="NAME", help=INDENTER_HELP)
    text = f"{LOCATION_HELP} (default: -12mm on a BioTac, else the middle of the pad)"
    verb.add_argument("--location", nargs="+", metavar=("X", "ANGLE | Y Z"), help=text)
    for name, default, text in (
        ("direction", None, "of the press (default: inward normal of the skin there)"),
        ("slide-direction", [1.0, 0.0, 0.0], "of the slide"),
    ):
        number = real(-1e9, 1e9)
        verb.add_argument(
            f"--{name}", type=number, nargs=3, default=default, metavar=("X", "Y", "Z"), help=text
        )
    hold, step = quantity("time", plain=_LONG_HOLD), quantity("time", _LONGEST_STEP, 0.0)
    for name, kind, default, metavar, text in (
        ("depth", quantity("length"), "2mm", "LENGTH", "from first touch"),
        ("slide", quantity("length"), "0mm", "LENGTH", "along the skin after the press"),
        ("speed", quantity("speed"), "10mm/s", "SPEED", "of press and slide"),
        ("hold", hold, "20ms", "TIME", "rest at the end of press and slide"),
        ("timestep", step, "4ms", "TIME", "of MuJoCo; the sensor reads a frame every 10 ms"),
    ):
        verb.add_argument(f"--{name}", type=kind, default=default, metavar=metavar, help=text)
    coupling = verb.add_mutually_exclusive_group()
    text = "the indenter's path is prescribed (default)"
    coupling.add_argument("--one-way", dest="two_way", action="store_false", default=False, help=text)
    text = "a compliant servo with mass pushes the indenter"
    coupling.add_argument("--two-way", dest="two_way", action="store_true", default=False, help=text)
    text = "between skin and indenter (default: the material's)"
    verb.add_argument("--friction", type=real(0, 100), metavar="MU", help=text)
    add_skin(verb)
    add_sensor(verb, "the indenter is")
    add_results(verb, "out/press", "folder of the results", "readings.csv", "skin.h5", "press.png")
    text = "MuJoCo's render in press.png; without it, or without a GL library, matplotlib draws the surfaces"
    verb.add_argument("--render", action=argparse.BooleanOptionalAction, default=True, help=text)


def _press(args):
    import pathlib
    import sys
    import warnings

    from ..quiet import headers

    headers()  # in the background, while the rest is imported
    from ..press import PressOptions, press, render, report
    from ..press.record import write_readings, write_skin

    same = (
        "indenter depth slide tier liquid timestep speed hold two_way friction seed device options sensor "
        "randomise thermal texture"
    )
    options = PressOptions(
        **{name: getattr(args, name) for name in same.split()},
        location=args.location and tuple(args.location),
        direction=args.direction and tuple(args.direction),
        slide_direction=tuple(args.slide_direction),
        # defaults are taken from the effects' file
        material=None if args.material == "default" else args.material,
        skin=None if args.skin == "default" else args.skin,
        signal=None if args.signal == "physics" else args.signal,
        effects=args.effects or None,
    )
    check_device(args.device)
    said = set()

    def warn(message, *_, **__):  # at once: a press that meets the core takes long
        if str(message) not in said:
            said.add(str(message))
            print(f"biotac: note: {message}", file=sys.stderr, flush=True)

    with warnings.catch_warnings():
        warnings.showwarning = warn
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
    failed, steps = int(record.nonconverged[-1]), len(record.time)
    wrong = f"{failed} of {steps} steps did not converge, their readings may be wrong: press less deep"
    if 2 * failed > steps:
        raise ValueError(wrong)
    if failed:
        warn(wrong)


def add_samples(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(
        verbs,
        "samples",
        _samples,
        "Write synthetic sample files for diagnose and train: electrodes.txt, forces.txt, log.csv, set.",
    )
    files = output_folder("electrodes.txt", "forces.txt", "log.csv")
    verb.add_argument("out", type=files, metavar="DIR", help="folder to make")
    text = "seed of touches and noise; 0 is in the package, others take minutes of simulation"
    verb.add_argument("--seed", type=SEED, default=0, help=text)
    verb.add_argument("--quiet", action="store_true", help="no progress bar")


def _samples(args):
    from ..samples import OBJECT, make_samples

    electrodes, forces, log, made = map(quoted, make_samples(args.out, args.seed, not args.quiet))
    print("synthetic, made by the simulation. Next:")
    print(f"  biotac diagnose --electrodes {electrodes} --force {forces}")
    print(f"  biotac diagnose {log} --object {OBJECT}  # a minute or two: the skin is solved again and again")
    print(f"  biotac learn train {electrodes} --force {forces} --out force.safetensors")
    print(f"  biotac learn train {made} --no-paper --out trained  # minutes")


def add_view(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(
        verbs,
        "view",
        _view,
        "Open MuJoCo's viewer on a BioTac and a ball to press it with: "
        "double-click the ball, then drag with ctrl and right button.",
    )
    add_skin(verb)
    text = "write a picture of the ball lying on the pad instead of opening a window"
    verb.add_argument("--render", type=output_file(picture=True), metavar="FILE", help=text)
    text = "how long to simulate before --render"
    verb.add_argument(
        "--seconds", type=quantity("time", 60.0, 0.0), default="300ms", metavar="TIME", help=text
    )
    _add_hand(verb)


def _add_hand(verb):
    text = "MJCF of a hand: with BioTacs on its fingertips and a ball"
    verb.add_argument("--hand", metavar="FILE", help=text)
    text = "with --hand: file of `biotac hand mount` for an unknown hand"
    verb.add_argument("--mount", metavar="FILE", help=text)


def _view(args):
    from ..view import view

    view(render=args.render, seconds=args.seconds, hand=args.hand, mount=args.mount, **_displayed_skin(args))


_SKIN = "skin", "tier", "material", "liquid", "options"


def _displayed_skin(args):
    """The displayed skin."""
    check_device(args.device)
    return {name: getattr(args, name) for name in (*_SKIN, "seed", "device")}


def add_play(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(
        verbs,
        "play",
        _play,
        "A page in the browser with skin, electrodes and traces: of recorded presses, of a press with "
        "sliders for depth and place (coarse skin, condensed tier), or of a policy that does a task by "
        "touch, with the BioTacs that it learned with (extra web). Settings of the skin replace these.",
    )
    text = f"skin.h5 of presses, one or several; or a task: {', '.join(TASKS)}"
    verb.add_argument("recording", nargs="*", metavar="FILE", help=text)
    add_skin(verb)
    verb.set_defaults(skin=None, tier=None, material=None)
    _add_hand(verb)
    verb.add_argument("--port", type=whole(1, 65535), help="port of the page (default: 8080)")
    text = (
        "in a task, what acts (default: the policy that comes with the package); script uses "
        "the true state, random draws actions; electrodes is that of roll_rod without PAC"
    )
    verb.add_argument("--policy", metavar="FILE", help=text)
    verb.add_argument(
        "--episodes", type=whole(1, 100000), help="in a task, number of episodes to score without a picture"
    )
    verb.add_argument("--json", action="store_true", help="with --episodes: scores as JSON, with the card")
    verb.add_argument(
        "--render", type=output_file(".gif"), metavar="FILE.gif", help="in a task, picture of one episode"
    )
    verb.add_argument("--window", action="store_true", help="in a task, MuJoCo's viewer in place of the page")


def _play(args):
    of_task = ("policy", "episodes", "json", "render", "window")
    if len(args.recording) == 1 and args.recording[0] in TASKS:
        check_device(args.device)
        if args.policy not in (None, "script", "random", "electrodes"):  # before seconds of imports
            trained = "`python -m biotac_mj.tasks.batched.training TASK --out FOLDER`"
            with reading(args.policy, "policy", f"give script, random, or a file that {trained} wrote"):
                pass
        if args.mount:
            raise ValueError("--mount is not of a task: leave it out")
        from ..view.policy import play_task

        more = {name: getattr(args, name) for name in (*of_task, "hand", "port", "device", "seed")}
        biotac = {name: value for name in _SKIN if (value := getattr(args, name)) is not None}
        play_task(args.recording[0], biotac=biotac, **more)
        return
    given = [f"--{name}" for name in of_task if getattr(args, name)]
    if given:
        said = " ".join(args.recording) or "nothing"
        raise ValueError(f"{given[0]} is of one task, and {said} is none: pass one of {', '.join(TASKS)}")
    remedy = "make one with `biotac press --out DIR` and give DIR/skin.h5, or give a task"
    for path in args.recording:  # the page's own error knows no tasks
        with reading(path, "recording", f"{remedy}: {', '.join(TASKS)}"):
            pass
    from ..view import view

    more = dict(hand=args.hand, mount=args.mount, recording=args.recording or None, port=args.port or 8080)
    quick = {"skin": "coarse", "tier": "condensed", "material": "default"}  # a press takes a second or two
    shown = {name: value for name, value in _displayed_skin(args).items() if value is not None}
    view(web=True, **more, **quick | shown)


def add_hands(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    add_verb(verbs, "list", _hands, "List the known hands of attach_to_hand, and their fingers.")


def _hands(args):
    from ..tasks.hands import HANDS

    for name, mounts in HANDS.items():
        print(f"{name:<{max(map(len, HANDS))}} fingers {', '.join(mounts)}")
    print("any other: `biotac hand mount HAND.xml --body LINK ...` finds the place and draws it")


def add_mount(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(
        verbs,
        "mount",
        "tasks.mounting.mount_verb",
        "Find the pose of a BioTac on a hand's link, for attach_to_hand(mount=FILE), and draw it.",
    )
    verb.add_argument("hand", metavar="HAND.xml", help="MJCF of the hand")
    verb.add_argument(
        "--body", nargs="+", required=True, metavar="NAME", help="the links with the fingertips"
    )
    for name, text in (
        ("tip", "direction of the fingertip in the link's frame (default: the link's longest axis)"),
        ("pad", "direction of the pad (default: to opposite links, or in which its joint bends it)"),
        ("pos", "of the BioTac's frame [m] (default: it ends where the link ends)"),
    ):
        verb.add_argument(f"--{name}", type=real(-1e3, 1e3), nargs=3, metavar=("X", "Y", "Z"), help=text)
    text = "geoms that the BioTac replaces (default: all of the link)"
    verb.add_argument("--replaces", nargs="*", metavar="GEOM", help=text)
    verb.add_argument(
        "--out", type=output_file(), default="mount.yaml", metavar="FILE", help="file of the mounts"
    )
    picture = output_file(picture=True)
    verb.add_argument("--picture", type=picture, metavar="PNG", help="the link before and after")


def add_import_mesh(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(verbs, "mesh", _import_mesh, "Import a skin, check it, and store it for --skin.")
    verb.add_argument(
        "path", metavar="PATH", help="folder with .tet and .obj files, or a .tet, .msh, .vtu ... file"
    )
    text = "where to store it (default: PATH's name with .npz, in the current folder)"
    verb.add_argument("--out", type=output_file(".npz"), metavar="FILE.npz", help=text)


def _import_mesh(args):
    import pathlib

    from ..geometry import import_mesh
    from ..geometry.card import skin_numbers

    source = pathlib.Path(args.path)
    out = pathlib.Path(args.out or f"{source.resolve().stem}.npz")
    check_output_file(out)
    refuse_inputs("--out", out, source)
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
    print(f"  stored in {out}: use it with --skin {quoted(out)}")


def add_design(verbs: argparse._SubParsersAction) -> None:
    """Adds its jobs to the command line."""
    verb = add_verb(verbs, "new", _new_design, "Make a custom pad: a folder for attach(design=FOLDER).")
    made = output_folder("default.npz", new="design.json")
    verb.add_argument(
        "folder", type=made, metavar="FOLDER", help="folder of the design; its name is the design's"
    )
    length, axes = quantity("length", 0.1, 1e-4), ("ALONG", "ACROSS", "DEPTH")
    for name, text in (
        ("dome", "shell: half an ellipsoid of these semi axes over a core, with liquid"),
        ("block", "solid rubber of this size on a flat backing"),
        ("core", "semi axes of the core under a dome"),
    ):
        verb.add_argument(f"--{name}", type=length, nargs=3, metavar=axes, help=text)
    verb.add_argument("--mesh", metavar="FILE", help=".msh, .tet or .vtu [m], its rim or back on y = 0")
    verb.add_argument("--core-mesh", metavar="FILE.obj", help="surface of the core [m]")
    verb.add_argument("--thickness", type=length, default="1.5mm", help="thickness of a dome's shell")
    text = "of the tetrahedra (default: 1.2mm, of a block so much that all its front may touch at once)"
    verb.add_argument("--edge", type=length, help=text)
    text = "columns x y z [mm]: x to the fingertip, z out of the nail (default: no electrodes)"
    verb.add_argument("--electrodes", metavar="FILE", help=text)
    text = "columns x y z [mm] of the excitation electrodes, which --electrodes needs"
    verb.add_argument("--excitation", metavar="FILE", help=text)
    verb = add_verb(verbs, "show", _show_design, "Describe a fingertip.")
    verb.add_argument("design", metavar="DESIGN", help="biotac, biotac_sp, or a folder made by `new`")


def _new_design(args):
    from ..sensor.own_design import PadShape, new_design

    def mm(lengths):
        return tuple(1e3 * length for length in lengths or ())

    core = args.core_mesh or mm(args.core) or None
    edge = args.edge and 1e3 * args.edge
    shape = PadShape(mm(args.dome), mm(args.block), args.mesh, core, 1e3 * args.thickness, edge)
    new_design(args.folder, shape, _places(args.electrodes), _places(args.excitation))
    args.design = args.folder
    _show_design(args)


def _show_design(args):
    from ..geometry.design import read_design
    from ..geometry.skins import skin_of_design, skin_reference

    design = read_design(args.design)
    skin = skin_reference(skin_of_design(args.design, None))[1]
    print(f"  {design.title}: {skin.nvert} nodes, {skin.nelem} tetrahedra")
    liquid = "liquid under the skin" if len(skin.inner_face) else "solid, leave the liquid out: liquid=False"
    at = ", x y z [mm] in its frame:" if design.nelectrode else ""
    print(f"  {liquid}; {', '.join(design.discs) or 'no electrodes'}{at}")
    for name, pos in zip(design.electrodes, 1e3 * skin.electrode_pos):
        print(f"  {name:4}" + "".join(f"{length:8.2f}" for length in pos))
    for what, source in design.sources.items():
        print(f"  {what}: {source}")


def _places(path):
    """Positions (n, 3) in a text file [mm]; () without a file."""
    from ..recordings.formats.columns import read_columns

    return read_columns(path, ["x", "y", "z"]) if path else ()
