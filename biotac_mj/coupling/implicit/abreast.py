"""Solves of several skins side by side, in threads of the host.

A skin's kernels run without Python's lock, and its solve is a function of its arguments, so results are the
same to the bit for any number of threads."""

import concurrent.futures
import functools
import os
from collections.abc import Callable, Sequence

from ...threads import single_thread

__all__ = ["run_abreast"]


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
