"""Loads trimesh so that Ctrl-C works during the import."""

import signal
import threading


def _load():
    """Loads trimesh, and delays Ctrl-C until it is loaded: trimesh takes any exception during the import of
    an optional package, also a KeyboardInterrupt, for a missing package."""
    before = signal.getsignal(signal.SIGINT)
    waits = callable(before) and threading.current_thread() is threading.main_thread()
    came = []
    if waits:
        signal.signal(signal.SIGINT, lambda *signal_and_frame: came.append(signal_and_frame))
    try:
        import trimesh
    finally:
        if waits:
            signal.signal(signal.SIGINT, before)
    if came:
        before(*came[0])
    return trimesh


trimesh = _load()
