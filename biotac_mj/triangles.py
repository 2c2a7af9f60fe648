"""trimesh, with Ctrl-C while it is loaded."""

import signal
import threading

__all__ = ["trimesh"]


def _load():
    """Loads trimesh, and lets Ctrl-C wait for the end of it: whatever is raised while trimesh loads what it
    needs, a KeyboardInterrupt too, it takes for a package that is not there, and goes on without."""
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
