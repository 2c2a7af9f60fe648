"""Short representations of values, in one line, for error messages."""

import re
import reprlib


class _Short(reprlib.Repr):
    """Chooses by the type itself, since reprlib uses the type's name, and several types are called
    `array`."""

    def __init__(self):
        super().__init__()
        self.maxstring = self.maxother = 60

    def repr1(self, x: object, level: int) -> str:
        own = type(x).__module__ in ("builtins", "array", "collections")
        return super().repr1(x, level) if own else self.repr_instance(x, level)

    def repr_int(self, x: int, level: int) -> str:
        try:
            return super().repr_int(x, level)
        except ValueError:  # Python writes no number of more than 4300 digits
            return f"a number of {x.bit_length()} bits"


_short = _Short()


def short_repr(value: object) -> str:
    """The value's repr in one line, without its middle if it is long."""
    return re.sub(r"\s*\n\s*", " ", _short.repr(value))
