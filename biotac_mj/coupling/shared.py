"""What several BioTacs have in common: made once, and not freed before the last of them is gone."""

import threading
import weakref
from collections.abc import Callable, Hashable

from ..freed import give_back

__all__ = ["Shared"]


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
            give_back()
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
        """What lives on until now does so no longer than until something else is made."""
        with self._lock:
            self._past, self._last = [*self._past, *self._last][-self._keep :], []

    def forget(self) -> None:
        """Makes every key's next value anew, whoever still holds one."""
        with self._lock:
            before = self._last, self._past
            self._last, self._past, self._living = [], [], weakref.WeakValueDictionary()
        del before
