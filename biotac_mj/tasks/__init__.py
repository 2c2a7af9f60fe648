"""Tasks by touch: the BioTac as a dm_control Entity, a suite of tasks with scripted controllers, Gymnasium,
robot hands.

    env = biotac_mj.tasks.load("finger", "press", task_kwargs={"random": 0})

dm_control is the extra `control`, Gymnasium the extra `gymnasium`; importing this package needs neither.
"""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from .biotac import ESTIMATED as ESTIMATED
    from .biotac import PRIVILEGED as PRIVILEGED
    from .biotac import TACTILE as TACTILE
    from .biotac import BioTac as BioTac
    from .copying import Copyable as Copyable
    from .environments import register as register
    from .hands import Mount as Mount
    from .hands import attach_to_hand as attach_to_hand
    from .scripted import make_controller as make_controller
    from .suite import load as load
    from .suite import tasks as tasks

_EXTRA = {"dm_control": "control", "gymnasium": "gymnasium"}
_get, __dir__ = lazy(__name__)


def __getattr__(name):
    try:
        return _get(name)
    except ModuleNotFoundError as error:
        package = (error.name or "").split(".")[0]
        if package not in _EXTRA:
            raise
        raise ModuleNotFoundError(
            f"{error}: pip install 'biotac-mj[{_EXTRA[package]}]'", name=error.name
        ) from error
