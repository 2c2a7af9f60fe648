"""Memory that was freed, given back to the system."""

import ctypes
import functools

__all__ = ["give_back"]


@functools.cache
def _trim():
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):  # not glibc
        return None


def give_back() -> None:
    """Lets the system have what is free between living blocks. glibc keeps it: the large temporary arrays of
    one skin after another leave holes that the next ones do not fit. Elsewhere it does nothing."""
    trim = _trim()
    if trim is not None:
        trim(0)
