"""Arguments that several verbs share."""

import argparse
import importlib
from collections.abc import Callable

from ..arguments import SEED, check_device, device, output_folder
from .names import MATERIALS, SKINS, TIERS


class _Formatter(argparse.ArgumentDefaultsHelpFormatter):
    """Adds informative defaults to the help."""

    def _get_help_string(self, action):
        if isinstance(action.default, list):
            words = (f"{v:g}" if isinstance(v, float) else str(v) for v in action.default)
            return f"{action.help} (default: {' '.join(words)})"
        says_nothing = action.default is None or isinstance(action.default, bool)  # 0 and 1 say something
        return action.help if says_nothing else super()._get_help_string(action)


def add_verb(
    verbs: argparse._SubParsersAction, name: str, run: Callable[[argparse.Namespace], None] | str, text: str
) -> argparse.ArgumentParser:
    """A verb that calls run(args); as text, run is a function's module and name in this package, which is
    imported then, after a look at the device."""
    verb = verbs.add_parser(name, help=text, description=text, formatter_class=_Formatter)
    verb.set_defaults(run=_imported(run) if isinstance(run, str) else run)
    return verb


def _imported(place):
    module, _, function = place.rpartition(".")

    def run(args):
        if getattr(args, "ray", None) is None and hasattr(args, "device"):  # a cluster has its own devices
            check_device(args.device)
        getattr(importlib.import_module(f"biotac_mj.{module}"), function)(args)

    return run


def add_skin(verb: argparse.ArgumentParser, seed: str = "of the sensor's noise") -> None:
    """Adds the skin, its rubber, tier, device and the seed; seed: its purpose."""
    text = (
        f"mesh of the skin: {', '.join(SKINS)}, of a BioTac SP biotac_sp/coarse and so on, a folder of "
        "`biotac design new`, or a file made by `biotac lab mesh`"
    )
    verb.add_argument("--skin", default="default", help=text)
    text = "full finite elements, or the condensed skin, fast and less exact, for hands and control"
    verb.add_argument("--tier", default="full", choices=TIERS, help=text)
    verb.add_argument(
        "--material", default="default", help=f"{', '.join(MATERIALS)}, a .json file of a material, or JSON"
    )
    add_liquid(verb, None, "liquid under the skin (default: by the material)")
    verb.add_argument("--seed", type=SEED, default=0, help=seed)
    add_device(verb)
    add_options(verb)


def add_liquid(verb: argparse.ArgumentParser, default: bool | None, text: str, of: str = "") -> None:
    """Adds --liquid and --no-liquid, or --OF-liquid."""
    name = f"--{of}liquid"
    verb.add_argument(name, action=argparse.BooleanOptionalAction, default=default, help=text)


def add_device(verb: argparse.ArgumentParser) -> None:
    """Adds the device of the skin."""
    text = "where the skin is solved: cpu, cuda:0 ..."
    verb.add_argument("--device", type=device, default="cpu", help=text)


def add_sensor(verb: argparse.ArgumentParser, touched: str) -> None:
    """Adds the sensor, and the material of `touched`."""
    text = (
        "which sensor (default: 1): 1, 2, 3, epfl_f1, epfl_f2, phac_f0, phac_f1, btd_sp, random, JSON, "
        "or a file of it"
    )
    verb.add_argument("--sensor", type=choice, metavar="NAME", help=text)
    text = (
        "source of the electrodes: physics (the film), latent_projection or learned (networks, "
        "extra learning), or a file *.safetensors of `biotac learn train`"
    )
    verb.add_argument("--signal", default="physics", metavar="NAME", help=text)
    text = "random effects: gain dead crosstalk pdc_gain relax warmup fluidloss drift"
    verb.add_argument("--randomise", nargs="+", metavar="EFFECT", help=text)
    text = "sensor file of `biotac diagnose`, with base model and effects (sensor_amended.yaml)"
    verb.add_argument("--effects", metavar="FILE.yaml", help=text)
    for names, what, example in (
        (["--thermal"], "for heat: what {} made of", "steel"),
        (["--texture", "--textures"], "for texture: what {} made of", "cork"),
    ):
        text = (
            f"{what.format(touched)}, such as {example}, or JSON; of several one is drawn at random "
            "(default: none)"
        )
        verb.add_argument(*names, action=_Drawn, nargs="+", type=choice, metavar="MATERIAL", help=text)


def add_results(verb: argparse.ArgumentParser, folder: str, text: str, *names: str) -> None:
    """Adds --out, a folder to which files of these names are written, and --quiet."""
    verb.add_argument("--out", type=output_folder(*names), default=folder, metavar="DIR", help=text)
    verb.add_argument("--quiet", action="store_true", help="no progress bar")


def choice(text: str) -> str | dict:
    """A name, JSON of a dict, or a file of it (.json)."""
    import json

    if text.endswith((".yaml", ".yml")):
        raise argparse.ArgumentTypeError(f"{text!r} is a sensor file: give it as --effects {text}")
    if text.endswith(".json"):
        from ..reading import read_json

        try:
            return read_json(text, "sensor or material", "give a name, JSON, or a file of it")
        except (FileNotFoundError, ValueError) as error:
            raise argparse.ArgumentTypeError(str(error)) from None
    if not text.startswith("{"):
        return text
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no JSON ({error})") from error


class _Drawn(argparse.Action):
    """One value, or a list of values from which one is drawn."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: list, option: str
    ) -> None:
        setattr(namespace, self.dest, values[0] if len(values) == 1 else values)


def add_options(verb: argparse.ArgumentParser) -> None:
    """Adds further settings as JSON."""
    text = (
        "further settings of the skin, JSON or a file of it: "
        '{"skin": {"contact_law": {"adhesion": 0.05}}, "modulus": "factors.npy"} (docs/features.md)'
    )
    verb.add_argument("--options", metavar="JSON", help=text)
