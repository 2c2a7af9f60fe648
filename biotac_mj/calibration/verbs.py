"""Runs `biotac lab calibrate` and `biotac lab compare`."""

import argparse
import pathlib

import tqdm

from ..files import check_output
from ..geometry.design import BIOTAC
from ..geometry.skins import design_of, mesh_of_same_design
from ..skin.rubber.material import material
from ..skin.settings import plain, read_dict, read_material, read_settings
from .comparison import PAPER, comparison_table, evaluate, plan_indentations, references
from .configurations import CONFIGURATIONS, configuration
from .fit import calibrate, parameter
from .indentation import plan_shear, read_indentation, write_indentation
from .reference import STAND_IN, stand_in
from .refinement import refined
from .refinement import skin as named_skin
from .report import calibration_table, write_json, write_picture

# arguments for the synthetic skin only, and their defaults
_TRUTH = {"truth": "rubber", "truth_skin": None, "noise": 0.01, "truth_liquid": None}
_REFERENCE = {"skin": "coarse", "element": "quadratic"}  # of the stand-in


def _complete(args, defaults, used, remedy):
    """Sets defaults; raises ValueError for arguments that have no effect."""
    for name, value in defaults.items():
        if getattr(args, name) is None:
            setattr(args, name, value)
        elif not used:
            raise ValueError(f"--{name.replace('_', '-')} belongs to our own synthetic skin: {remedy}")


def _body(name, skin, liquid, options):
    """A configuration with the options of the command line."""
    given = read_dict(options, "options")
    modulus = read_settings(None, given).modulus  # raises for unknown names
    return configuration(name, skin, modulus, **{"liquid": liquid, **plain(given.get("skin") or {})})


def calibrate_verb(args: argparse.Namespace) -> None:
    """`biotac lab calibrate`; raises ValueError or FileNotFoundError for invalid input. args.forces_of:
    (configuration, material, parameters, indentation, device) -> the argument `forces` of `calibrate`, and
    the name of its method for derivatives."""
    if args.synthetic == (args.data is not None):
        raise ValueError("give either a file of force-deflection data, or --synthetic")
    _complete(args, _TRUTH, args.synthetic, "give --synthetic in place of DATA, or leave it out")
    parameters = [parameter(text) for text in args.fit]
    out = pathlib.Path(args.out)
    body = _body(args.configuration, args.skin, args.liquid, args.options)
    if args.synthetic:
        check_output(out, "synthetic.csv")
        args.truth_skin = args.truth_skin or str(mesh_of_same_design(args.skin, "default"))
        design, truly = design_of(args.skin), named_skin(args.truth_skin).design
        if truly != design:
            raise ValueError(
                f"--skin {args.skin} is of {design.title}, --truth-skin {args.truth_skin} of {truly.title}: "
                "take meshes of one of them"
            )
        met = mesh_of_same_design(args.skin, "coarse")
        plan = plan_shear(args.indenter or "sphere_7mm", direction=args.direction, skin=met)
        data = stand_in(
            plan, args.truth, args.truth_skin, args.noise, args.seed, args.truth_liquid, device=args.device
        )
        write_indentation(data, out / "synthetic.csv")
        truth = read_material(args.truth)
        print(
            f"data: our own skin, {args.truth} on mesh {args.truth_skin}, E {truth.youngs_modulus:g} Pa, "
            f"nu {truth.poissons_ratio:g}, "
            f"mu {truth.friction:g}, noise {args.noise:g} N; kept in {out / 'synthetic.csv'}"
        )
    else:
        data = read_indentation(args.data, args.indenter, args.direction)
    finer = refined(body.geometry) if args.correct else None
    start = read_material(args.material)
    forces, how = args.forces_of(body, start, parameters, data, args.device)
    result = calibrate(
        body,
        start,
        data,
        parameters,
        device=args.device,
        progress=not args.quiet,
        finer=finer,
        forces=forces,
        starts=args.starts,
    )
    write_json(result, out / "calibration.json")
    write_picture(result, out / "calibration.png")
    print(calibration_table(result))
    print(f"slopes by {how}")
    print(f"wrote {out / 'calibration.json'} and {out / 'calibration.png'}")


def compare_verb(args: argparse.Namespace) -> None:
    """`biotac lab compare`; raises ValueError or FileNotFoundError for invalid input. args.forces_of: see
    `calibrate_verb`. When called again, it continues with what the cache has."""
    if args.count < 1:
        raise ValueError(f"--count is {args.count}: compare at least one indentation for each indenter")
    if design_of(args.skin) != BIOTAC:
        raise ValueError(
            f"--skin {args.skin} is of {design_of(args.skin).title}: the configurations compared are the "
            "paper's of a BioTac; take a skin of it, or `biotac lab calibrate`"
        )
    _complete(args, {"reference_material": "rubber"}, not args.data, "leave it out, or --data")
    chosen = [
        _body(
            name,
            args.skin if CONFIGURATIONS[name][0] is None else "coarse",
            args.liquid and CONFIGURATIONS[name][0] is None,
            args.options,
        )
        for name in args.configurations
    ]
    given = args.material and read_material(args.material)
    out = pathlib.Path(args.out)
    if args.data:
        cases = [_measured(text) for text in args.data]
        calibration, cases = (None, cases) if given else (cases[0], cases[1:])
        reference = "measured data"
    else:
        truth = {"material": args.reference_material, "device": args.device, **_REFERENCE}
        plans = plan_indentations(args.count, args.indenters, args.seed, skin=args.skin)
        with _bar("reference", len(plans), args.quiet) as bar:
            cases = references(plans, bar.update, **truth)
        calibration = None if given else stand_in(plan_shear(), **truth)
        element, skin = _REFERENCE["element"], _REFERENCE["skin"]
        reference = f"{STAND_IN} ({args.reference_material}, {element} elements, skin {skin})"
    results = [_compared(body, given, calibration, cases, args) for body in chosen]
    write_json({"reference": reference, "paper": PAPER, "configurations": results}, out / "compare.json")
    for result in results:
        m = result.material
        print(
            f"{result.configuration}: E {m.youngs_modulus:.4g} Pa, nu {m.poissons_ratio:.4f}, "
            f"mu {m.friction:.4f}"
        )
    print(comparison_table(results, reference))
    print(f"wrote {out / 'compare.json'}")


def _compared(body, given, calibration, cases, args):
    """Calibrates a configuration, unless its material is given, and evaluates it."""
    fitted = None
    if not given:
        wanted = [parameter(name) for name in ("E", "nu", "mu")]
        forces, _ = args.forces_of(body, material("paper"), wanted, calibration, args.device)
        settings = dict(device=args.device, progress=not args.quiet, forces=forces)
        fitted = calibrate(body, material("paper"), calibration, **settings)
        if not args.quiet:
            print(f"{body.name}\n{calibration_table(fitted)}", flush=True)
    with _bar(body.name, len(cases), args.quiet) as bar:
        return evaluate(body, given or fitted.material, cases, fitted, args.device, bar.update)


def _measured(text):
    indenter, separator, path = text.partition("=")
    if not separator:
        raise ValueError(
            f"--data {text!r} does not say what pressed: write INDENTER=FILE, as in sphere_7mm=press.csv"
        )
    return read_indentation(path, indenter)


def _bar(name, total, quiet):
    return tqdm.tqdm(total=total, desc=name, unit="indentation", disable=quiet or None, leave=False)
