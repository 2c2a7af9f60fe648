"""One thread of BLAS: over the small matrices of a skin and its film, more only wait for each other."""

import contextlib
import functools
from collections.abc import Iterator

from threadpoolctl import ThreadpoolController

__all__ = ["single_thread"]


@functools.cache
def _libraries():
    return ThreadpoolController().select(user_api="blas").lib_controllers


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Holds BLAS to one thread; some microseconds where it is held to one already."""
    changed = [(library, n) for library in _libraries() if (n := library.get_num_threads() or 1) > 1]
    for library, _ in changed:
        library.set_num_threads(1)
    try:
        yield
    finally:
        for library, n in changed:
            library.set_num_threads(n)
