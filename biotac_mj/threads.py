"""Threads of the host: one thread for BLAS, whose threads wait for each other on matrices this small, and
several for skins.

A skin's kernels release Python's lock, and a solve is a function of its arguments, so results are equal to
the bit for any number of threads."""

import concurrent.futures
import contextlib
import functools
import os
from collections.abc import Callable, Iterator, Sequence

from threadpoolctl import ThreadpoolController


@functools.cache
def _libraries():
    return ThreadpoolController().select(user_api="blas").lib_controllers


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Limits BLAS to one thread; takes some microseconds if it has one already."""
    changed = [(library, n) for library in _libraries() if (n := library.get_num_threads() or 1) > 1]
    for library, _ in changed:
        library.set_num_threads(1)
    try:
        yield
    finally:
        for library, n in changed:
            library.set_num_threads(n)


def cores() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.lru_cache(maxsize=4)
def _pool(threads: int, process: int):
    return concurrent.futures.ThreadPoolExecutor(threads, thread_name_prefix="biotac_mj")


def run_in_threads(tasks: Sequence[Callable[[], None]], threads: int) -> None:
    """Calls independent tasks in up to `threads` threads. When all have ended, raises the exception of the
    first task that failed."""
    if threads < 2 or len(tasks) < 2:
        for task in tasks:
            task()
        return
    pool = _pool(threads, os.getpid())  # a forked process has none of its parent's threads
    with single_thread():  # for all of them, so that no task changes it during another one
        running = [pool.submit(task) for task in tasks]
        concurrent.futures.wait(running)
    for one in running:
        one.result()
