"""Threads of the host: one of BLAS, since over the small matrices of a skin and its film more only wait for
each other, and skins side by side in several.

A skin's kernels run without Python's lock, and its solve is a function of its arguments, so results are the
same to the bit for any number of threads."""

import concurrent.futures
import contextlib
import functools
import os
from collections.abc import Callable, Iterator, Sequence

from threadpoolctl import ThreadpoolController

__all__ = ["cores", "run_abreast", "single_thread"]


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


def cores() -> int:
    """How many processor cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.lru_cache(maxsize=4)
def _pool(threads: int, process: int):
    return concurrent.futures.ThreadPoolExecutor(threads, thread_name_prefix="biotac_mj")


def run_abreast(tasks: Sequence[Callable[[], None]], threads: int) -> None:
    """Calls tasks that do not wait for each other in up to so many threads; what the first of them raises is
    raised when all have ended."""
    if threads < 2 or len(tasks) < 2:
        for task in tasks:
            task()
        return
    pool = _pool(threads, os.getpid())  # a forked process has none of its parent's threads
    with single_thread():  # held for all of them, so that none changes it while another one is busy
        running = [pool.submit(task) for task in tasks]
        concurrent.futures.wait(running)
    for one in running:
        one.result()
