"""What several BioTacs have in common, made once and freed with the last of them."""

import threading
import weakref
from collections.abc import Callable, Hashable

__all__ = ["Shared"]


class Shared:
    """Values by key. One lives as long as anybody holds it; the last few live on, for who comes next.

    Args:
      keep: how many.
    """

    def __init__(self, keep: int):
        self._keep, self._last, self._living = keep, [], weakref.WeakValueDictionary()
        self._lock = threading.RLock()

    def get(self, key: Hashable, make: Callable[[], object]) -> object:
        """The value of a key, made if there is none; by one thread, while the others wait."""
        with self._lock:
            value = self._living.get(key)
            if value is None:
                value = self._living[key] = make()
            before = self._last  # what leaves it is freed when the lock is free again
            self._last = [*(one for one in before if one is not value), value][-self._keep :]
        return value

    def forget(self) -> None:
        """Makes every key's next value anew, whoever still holds one."""
        with self._lock:
            self._last, self._living = [], weakref.WeakValueDictionary()
