"""Old spellings that still work, and say the new one at the caller's line."""

import functools
import inspect
import sys
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

__all__ = ["keywords_after", "say_new_name"]

_PACKAGE = __name__.partition(".")[0]
_Function = TypeVar("_Function", bound=Callable[..., Any])


def say_new_name(text: str) -> None:
    """A FutureWarning at the line that used the old spelling: the first outside this package, however many
    wrappers are between."""
    frame = sys._getframe(1)
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in (_PACKAGE, "importlib"):
        frame = frame.f_back
    registry = frame.f_globals.setdefault("__warningregistry__", {})
    module = frame.f_globals.get("__name__")
    warnings.warn_explicit(
        text, FutureWarning, frame.f_code.co_filename, frame.f_lineno, module, registry=registry
    )


def keywords_after(last: str, *names: str) -> Callable[[_Function], _Function]:
    """For a function whose arguments after `last` are given by name: by place they still come, with a
    FutureWarning.

    Args:
      last: the last argument that has a place.
      names: those that had one after it, in their old order; none: all, in the order of the signature.
    """

    def decorate(function):
        parameters = list(inspect.signature(function).parameters)
        places = parameters.index(last) + 1
        placed = names or tuple(parameters[places:])

        @functools.wraps(function)
        def call(*args, **settings):
            old = dict(zip(placed, args[places:]))
            if len(args) - places > len(placed) or old.keys() & settings.keys():
                return function(*args, **settings)  # Python says what is wrong
            if old:
                given = ", ".join(f"{name}=..." for name in old)
                say_new_name(f"{function.__name__} takes what comes after {last} by name: write {given}")
            return function(*args[:places], **old, **settings)

        return call

    return decorate
