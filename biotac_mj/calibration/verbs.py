"""What `biotac calibrate` and `biotac compare` do with their arguments."""

import pathlib

import tqdm

from ..skin.material import PRESETS, material
from .comparison import PAPER, comparison_table, evaluate, plan_indentations, references
from .configurations import CONFIGURATIONS, configuration
from .fit import calibrate
from .indentation import plan_shear, read_indentation, write_indentation
from .reference import STAND_IN, stand_in
from .refinement import refined
from .report import calibration_table, read_material, write_json, write_picture

__all__ = ["calibrate_verb", "compare_verb"]


def _material(text):
    return material(text) if text in PRESETS or not text.endswith(".json") else read_material(text)


def calibrate_verb(args) -> None:
    """`biotac calibrate`; raises ValueError or FileNotFoundError for what cannot be."""
    if args.synthetic == (args.data is not None):
        raise ValueError("give either a file of force-deflection data, or --synthetic")
    out = pathlib.Path(args.out)
    body = configuration(args.configuration, args.skin, liquid=args.liquid)
    if args.synthetic:
        plan = plan_shear(args.indenter or "sphere_7mm", direction=args.direction)
        data = stand_in(plan, args.truth, args.truth_skin, args.noise, args.seed, args.truth_liquid, device=args.device)
        write_indentation(data, out / "synthetic.csv")
        truth = material(args.truth)
        print(f"data: our own skin, {args.truth} on mesh {args.truth_skin}, E {truth.youngs_modulus:g} Pa, nu {truth.poissons_ratio:g}, "
              f"mu {truth.friction:g}, noise {args.noise:g} N; kept in {out / 'synthetic.csv'}")  # fmt: skip
    else:
        data = read_indentation(args.data, args.indenter, args.direction)
    finer = refined(body.geometry) if args.correct else None
    result = calibrate(body, _material(args.material), data, args.fit, device=args.device, progress=not args.quiet, finer=finer)
    write_json(result, out / "calibration.json")
    write_picture(result, out / "calibration.png")
    print(calibration_table(result))
    print(f"wrote {out / 'calibration.json'} and {out / 'calibration.png'}")


def compare_verb(args) -> None:
    """`biotac compare`; raises ValueError or FileNotFoundError for what cannot be."""
    if args.count < 1:
        raise ValueError(f"--count is {args.count}: compare at least one indentation for each indenter")
    chosen = [configuration(name, args.skin if CONFIGURATIONS[name][0] is None else "coarse",
                            liquid=args.liquid and CONFIGURATIONS[name][0] is None) for name in args.configurations]  # fmt: skip
    given = args.material and _material(args.material)
    if args.data:
        cases = [_measured(text) for text in args.data]
        calibration, cases = (None, cases) if given else (cases[0], cases[1:])
        reference = "measured data"
    else:
        settings = dict(material=args.reference_material, skin=args.reference_skin, element=args.reference_element, device=args.device)
        plans = plan_indentations(args.count, args.indenters, args.seed, skin=args.skin)
        with _bar("reference", len(plans), args.quiet) as bar:
            cases = references(plans, bar.update, **settings)
        calibration = None if given else stand_in(plan_shear(), **settings)
        reference = f"{STAND_IN} ({args.reference_material}, {args.reference_element} elements, skin {args.reference_skin})"
    results = []
    for body in chosen:
        fitted = None if given else calibrate(body, material("paper"), calibration, device=args.device, progress=not args.quiet)
        with _bar(body.name, len(cases), args.quiet) as bar:
            results.append(evaluate(body, given or fitted.material, cases, fitted, args.device, bar.update))
    out = pathlib.Path(args.out) / "compare.json"
    write_json({"reference": reference, "paper": PAPER, "configurations": results}, out)
    for result in results:
        m = result.material
        print(f"{result.configuration}: E {m.youngs_modulus:.4g} Pa, nu {m.poissons_ratio:.4f}, mu {m.friction:.4f}")
    print(comparison_table(results, reference))
    print(f"wrote {out}")


def _measured(text):
    indenter, separator, path = text.partition("=")
    if not separator:
        raise ValueError(f"--data {text!r} does not say what pressed: write INDENTER=FILE, as in sphere_7mm=press.csv")
    return read_indentation(path, indenter)


def _bar(name, total, quiet):
    return tqdm.tqdm(total=total, desc=name, unit="indentation", disable=quiet, leave=False)
