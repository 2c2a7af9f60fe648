"""The `biotac` command: one verb per job. The work of a verb is in its folder, which is imported on use."""

import contextlib
import errno
import functools
import os
import signal
import sys
import threading
import traceback
from collections.abc import Sequence

from ..arguments import Parser
from ..plugin.errors import interrupt
from .diagnosing import add_checkup, add_diagnose, add_next
from .fitting import add_calibrate, add_compare, add_estimate
from .names import CONFIGURATIONS, INDENTERS, INTERACTIONS, MATERIALS, OBJECTS, SKINS, TIERS
from .pressing import (
    add_design,
    add_hands,
    add_import_mesh,
    add_mount,
    add_play,
    add_press,
    add_samples,
    add_view,
)
from .sets import add_data, add_generate

__all__ = [
    "CONFIGURATIONS",
    "INDENTERS",
    "INTERACTIONS",
    "MATERIALS",
    "OBJECTS",
    "SKINS",
    "TIERS",
    "main",
    "parser",
]


_GROUPS = {
    "recording": "Logs of a real sensor: import, show, record, export.",
    "learn": "Models that read electrodes or predict them: train, judge, predict.",
    "data": "Sets of interactions: generate, import, export, resimulate, samples.",
    "hand": "BioTacs on robot hands: list, mount.",
    "design": "Fingertips other than the BioTac: new, show.",
    "lab": "Material and method: calibrate, compare, estimate, mesh.",
}


@functools.cache  # 26 verbs with 300 options take longer than many a verb's check of bad input
def parser() -> Parser:
    """The command line."""
    from .. import __version__
    from ..learning.verbs import add_verbs as add_learning
    from ..recordings.verbs import add_verbs as add_recordings
    from ..resimulation.verbs import add_verb as add_resimulation
    from .common import add_verb

    top = Parser(
        prog="biotac",
        description="A SynTouch BioTac fingertip in MuJoCo. Quantities have units, as in 1.5mm or -12deg; a "
        "plain number is in SI units.",
    )
    top.add_argument("--version", action="version", version=f"biotac_mj {__version__}")
    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    for add in (add_press, add_view, add_play, add_diagnose, add_next, add_checkup):
        add(verbs)
    groups = {}
    for name, text in _GROUPS.items():
        made = verbs.add_parser(name, help=text, description=text)
        groups[name] = made.add_subparsers(dest="job", required=True, metavar="JOB")
    add_recordings(groups["recording"], add_verb)
    add_learning(groups["learn"], add_verb)
    for add in (add_generate, add_data, add_samples):
        add(groups["data"])
    add_resimulation(groups["data"], add_verb)
    for add in (add_hands, add_mount):
        add(groups["hand"])
    add_design(groups["design"])
    for add in (add_calibrate, add_compare, add_estimate, add_import_mesh):
        add(groups["lab"])
    return top


# remedies for errors of the operating system
_REMEDIES = {
    errno.ENOSPC: "free some space on that disk, or choose another --out",
    errno.EDQUOT: "free some of your quota, or choose another --out",
    errno.EFBIG: "choose an --out where larger files may be",
    errno.EROFS: "choose another --out",
    errno.EACCES: "choose another place, or ask for the right to it",
    errno.EPERM: "choose another place, or ask for the right to it",
    errno.ENAMETOOLONG: "give a shorter name",
}


def _one_line(error) -> str:
    """An error in one line: cause and remedy."""
    if isinstance(error, OSError) and error.errno:
        where = f"{error.filename}: " if error.filename else ""
        text = f"{where}{error.strerror}: {_REMEDIES.get(error.errno, 'check the path, then try again')}"
    elif isinstance(error, MemoryError):
        text = "this needs more memory than there is: ask for fewer steps, worlds or interactions at once"
    else:
        text = str(error)
    return " ".join(text.split())


# packages that verbs import on use, and the extra that installs each
_EXTRAS = dict.fromkeys(("torch", "safetensors"), "learning") | {
    "dm_control": "control",
    "gymnasium": "gymnasium",
    "mujoco_warp": "batch",
    "pyarrow": "lerobot",
    "rosbags": "ros",
    "skfem": "data",
    "viser": "web",
}


def _unexpected(error: Exception) -> int:
    if os.environ.get("BIOTAC_TRACEBACK"):
        raise error
    place = traceback.extract_tb(error.__traceback__)[-1]
    print(
        f"biotac: error: unexpected {type(error).__name__} in {os.path.basename(place.filename)}, line "
        f"{place.lineno}: {_one_line(error)[:200]}; BIOTAC_TRACEBACK=1 shows all of it, please report it",
        file=sys.stderr,
    )
    return 70


@contextlib.contextmanager
def _tidy(ended):
    """Makes SIGTERM stop a verb like Ctrl-C, so that unfinished files and processes are cleaned up; the
    signal is noted in the list `ended`."""

    def end(number, frame):
        ended.append(number)
        interrupt(number, frame)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a verb; bad input, and a press in which most steps fail, is one line on stderr and exit code 2.

    Unexpected errors are one line too, with exit code 70; BIOTAC_TRACEBACK=1 in the environment shows the
    traceback.
    """
    for name in ("stdout", "stderr"):  # None if closed, as in some services
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))
    ended = []
    try:
        with _tidy(ended):
            args = parser().parse_args(argv)
            args.run(args)
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of the output is gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, OSError, MemoryError) as error:
        print(f"biotac: error: {_one_line(error)}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get((error.name or "").split(".")[0])
        if extra is None:
            return _unexpected(error)
        print(
            f"biotac: error: this verb needs {error.name}: pip install 'biotac-mj[{extra}]'", file=sys.stderr
        )
        return 2
    except KeyboardInterrupt:
        print("biotac: stopped", file=sys.stderr)
        return 128 + (ended or [signal.SIGINT])[0]
    except Exception as error:
        return _unexpected(error)
    return 0
