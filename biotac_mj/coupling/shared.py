"""Objects that several BioTacs share: made once, and freed with the last BioTac."""

import ctypes
import functools
import threading
import weakref
from collections.abc import Callable, Hashable


@functools.cache
def _malloc_trim():
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):  # not glibc
        return None


def trim_memory() -> None:
    """Lets the system have what is free between living blocks. glibc keeps it: the large temporary arrays of
    one skin after another leave holes that the next ones do not fit. Elsewhere it does nothing."""
    trim = _malloc_trim()
    if trim is not None:
        trim(0)


class Shared:
    """Values by key. One lives as long as anybody holds it; the last few live on, for whoever comes next.

    Args:
      keep: how many.
    """

    def __init__(self, keep: int):
        self._keep, self._last, self._living = keep, [], weakref.WeakValueDictionary()
        self._lock, self._past = threading.RLock(), []

    def get(self, key: Hashable, make: Callable[[], object]) -> object:
        """The value of a key, made if there is none; by one thread, while the others wait."""
        with self._lock:
            left = None
            if self._living.get(key) is None:
                left = self._last, self._past
                self._last, self._past = self._last[len(self._last) + 1 - self._keep :], []
        if left is not None and any(left):  # freed when the lock is free, and before another needs the memory
            del left
            trim_memory()
        with self._lock:
            value = self._living.get(key)
            if value is None:
                value = self._living[key] = make()
            before = self._last, self._past  # what leaves them is freed when the lock is free again
            self._last = [*(one for one in self._last if one is not value), value][-self._keep :]
            self._past = [one for one in self._past if one is not value]
        del before
        return value

    def turn(self) -> None:
        """Objects that are alive now may be freed as soon as something else is made."""
        with self._lock:
            self._past, self._last = [*self._past, *self._last][-self._keep :], []

    def forget(self) -> None:
        """Makes every key's next value anew, whoever still holds one."""
        with self._lock:
            before = self._last, self._past
            self._last, self._past, self._living = [], [], weakref.WeakValueDictionary()
        del before
