"""Views of a BioTac: MuJoCo's viewer, pictures, a page in the browser."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from .offscreen import Offscreen as Offscreen
    from .offscreen import find_gl as find_gl
    from .window import build_hand as build_hand
    from .window import build_scene as build_scene
    from .window import view as view

__getattr__, __dir__ = lazy(__name__)
