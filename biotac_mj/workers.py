"""Processes that work for another one and end when it does, however it ends."""

import multiprocessing
import os
import signal
import threading

__all__ = ["end_with_parent"]


def end_with_parent() -> None:
    """Called in a process that multiprocessing started: it ends as soon as the one that started it is gone,
    killed or not, instead of waiting for ever for more to do. Ctrl-C, which a terminal sends to all, is left
    to that one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end, args=(multiprocessing.parent_process(),), daemon=True).start()


def _end(parent):
    parent.join()
    os._exit(1)
