"""Types of the command line's arguments, which check their text before any work begins."""

import argparse
import difflib
import math
import pathlib
import re
import sys
from collections.abc import Callable, Iterator, Sequence

from .files import check_output, check_output_file, picture_kind, refuse_existing, refuse_inputs
from .units import SI, UNITS, number_of, question, read_quantity

# verbs of earlier versions that have another name now
_FORMER = {
    "contact-patch": "learn predict inverse",
    "evaluate": "learn judge",
    "import-data": "data import",
    "import-mesh": "lab mesh",
}


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, with exit code 2. Options must be written in full, since an
    abbreviation may become ambiguous when options are added."""

    def __init__(self, *args: object, **settings: object):
        super().__init__(*args, **{"allow_abbrev": False} | settings)
        # -12mm and -1e-3 are numbers, not options
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def parse_known_args(
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """As in argparse, but a verb reports unknown arguments itself, before missing ones."""
        if args is not None and not self._subparsers:
            for before, word in zip(("", *args), args):
                if re.fullmatch(r"--[\w-]+=--", word):  # to argparse of some versions none, of others "--"
                    self.error(f"no value in {word}: give one, or leave the option out")
                if empty := re.fullmatch(r"(--[\w-]+=)?\s*", word):
                    where = (empty[1] or before).rstrip("=")
                    after = f" at {where}" if where.startswith("--") else ""
                    self.error(f"an empty argument{after}: give a value, or leave it out")
            known = [name for name in self._option_string_actions if name.startswith("--")]
            for given in (word.split("=")[0] for word in args if word.startswith("--") and word != "--"):
                if given not in known:
                    meant = [name for name in known if name.startswith(given)]
                    if given == "--design" and "--skin" in known:  # of Python
                        meant = ["--skin biotac_sp/coarse"]
                    near = (meant + difflib.get_close_matches(given, known, 1))[:1]
                    self.error(f"no option {given}{f': did you mean {near[0]}?' if near else ''}")
        words = sys.argv[1:] if args is None else args
        if self._subparsers and not words:
            self.print_help()  # without a verb, print the verbs
        elif self._subparsers and re.match("--.", words[0]) and words[0] not in self._option_string_actions:
            self.error(f"{words[0]} stands before the verb: give the verb first, then its options")
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"nothing takes {' '.join(unknown)}")
        if not self._subparsers:
            self._refuse_inputs(found)
        return found, unknown

    def _refuse_inputs(self, found):
        """Raises ValueError if an output file is also named by another argument."""
        given = [
            (action, value) for action in self._actions for value in _flat(getattr(found, action.dest, ""))
        ]
        # INDENTER=FILE is a file too
        read = [
            part
            for _, text in given
            if not isinstance(text, _Output)
            for part in (text, text.partition("=")[2])
        ]
        for action, out in given:
            for file in getattr(out, "files", ()):
                option = (*action.option_strings, action.metavar or action.dest)[0]
                refuse_inputs(option, file, *read, given=out)

    def _check_value(self, action, value):
        """Checks a choice; suggests the group of a verb that belongs to one."""
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            homes = [
                f"`{inner.prog}`"
                for group in action.choices.values()
                for found in group._actions
                if isinstance(found, argparse._SubParsersAction)
                for name, inner in found.choices.items()
                if name == value
            ]
            homes += [f"`biotac {_FORMER[value]}`"] if value in _FORMER else []
            if homes:
                self.error(f"no verb {value}: it is {' or '.join(homes)}")
        super()._check_value(action, value)

    def error(self, message: str) -> None:
        text = " ".join(message.split())
        self.exit(2, f"biotac: error: {text} (`{self.prog} --help` shows what can be given)\n")


def whole(low: int, high: int) -> Callable[[str], int]:
    """A whole number in a range."""
    return _number(int, "a whole number", low, high)


def real(low: float = -math.inf, high: float = math.inf) -> Callable[[str], float]:
    """A finite number in a range."""
    return _number(float, "a finite number", low, high)


def quantity(
    kind: str, most: float = math.inf, least: float = -math.inf, plain: float = math.inf
) -> Callable[[str], float]:
    """A length, angle, time or speed (`units.UNITS`) in SI: a number with a unit, or a plain number of SI.

    Args:
      most, least: limits, in SI. plain: limit of a number without a unit, which the usual unit may be missing
        from.
    """
    usual, factor = list(UNITS[kind].items())[1]

    def read(text):
        try:
            value = read_quantity("it", text, kind)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
        if not least <= value <= most:
            asked = question(number_of(text), most, kind, least).rstrip()
            limits = f"{least / factor:.4g} to {most / factor:.4g} {usual} can be given"
            raise argparse.ArgumentTypeError(
                f"{text!r} is {value:g} {SI[kind]}: {limits}{asked and f'; {asked}'}"
            )
        if abs(value) > plain and not text.strip()[-1].isalpha():
            raise argparse.ArgumentTypeError(
                f"{text!r} is {value:g} {SI[kind]}: {question(value, plain, kind)}write {value:g}{SI[kind]} "
                "if not"
            )
        return value

    return read


def _number(kind, called, low, high):
    limits = f" from {low:g} to {high:g}" if math.isfinite(low) or math.isfinite(high) else ""

    def read(text):
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high or value in (math.inf, -math.inf):
            raise argparse.ArgumentTypeError(f"{text[:40]!r} is not {called}{limits}")
        return value

    return read


SEED = whole(0, 2**31 - 1)


def device(text: str) -> str:
    """The name of a device; whether it exists is checked later."""
    if not re.fullmatch(r"cpu|cuda(:\d{1,3})?(,cuda:\d{1,3})*", text):
        raise argparse.ArgumentTypeError(f"{text!r} is no device: give cpu, or cuda:0")
    return text


def add_ray(parser: argparse.ArgumentParser) -> None:
    """Adds --ray."""
    text = "address of a Ray cluster that shares the work (docs/howto/cluster.md); local: processes here"
    parser.add_argument("--ray", metavar="ADDRESS", help=text)


def check_device(names: str) -> None:
    """Raises ValueError for devices that do not exist; names: of Warp, separated by commas."""
    import warp

    from .quiet import quiet_warp

    quiet_warp()
    there = [one.alias for one in warp.get_devices()]
    for name in names.split(","):
        if name not in (*there, *("cuda" for one in there if one != "cpu")):
            raise ValueError(f"--device {name} is not here: choose one of {', '.join(there)}")


class _Output(str):
    """A path of the command line; files: that will be written there."""

    files: tuple[pathlib.Path, ...] = ()


def _flat(value: object) -> Iterator[str]:
    """The texts of an argument, which may be nested lists."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, (list, tuple)):
        for one in value:
            yield from _flat(one)


def output_folder(*names: str, new: str | None = None) -> Callable[[str], str]:
    """Type of a folder to which files of these names can be written; no other argument may name them.

    Args:
      new: a file in it that must not exist, see `files.refuse_existing`; "" for the folder itself.
    """

    def check(text):
        check_output(text, *names)
        if new is not None:
            refuse_existing(pathlib.Path(text, new))
        return tuple(pathlib.Path(text) / name for name in names)

    return _output(check)


def output_file(suffix: str = "", new: bool = False, picture: bool = False) -> Callable[[str], str]:
    """Type of a file that can be written; no other argument may name it.

    Args:
      suffix: of its name; "" for any. new: whether it must not exist, see `files.refuse_existing`.
      picture: whether its name must be a picture's.
    """

    def check(text):
        check_output_file(text)
        if new:
            refuse_existing(text)
        if picture:
            picture_kind(text)
        if not text.endswith(suffix):
            raise ValueError(f"{text} does not end in {suffix}: give a name that does")
        return (pathlib.Path(text),)

    return _output(check)


def _output(check):
    def read(text):
        out = _Output(text)
        try:
            out.files = check(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
        return out

    return read
