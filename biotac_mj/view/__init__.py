"""What a BioTac looks like: in MuJoCo's viewer, in a picture, in the browser."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from .window import build_hand as build_hand
    from .window import build_scene as build_scene
    from .window import view as view

_HOME = {
    "build_hand": ".window",
    "build_scene": ".window",
    "view": ".window",
}

__all__ = list(_HOME)
__getattr__, __dir__ = lazy(__name__, _HOME)
