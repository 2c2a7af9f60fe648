"""Starts Warp: without its list of devices and modules, which would mix with a program's own output, and on a
machine without kernels with its headers."""

import concurrent.futures
import contextlib
import functools
import os
import pathlib
import sys
import tempfile
import threading

import warp as wp

# written to standard error by C code of Warp 1.19, at every log level
_NO_GPU = b"Could not find or load the NVIDIA CUDA driver"


def quiet_warp() -> None:
    """Starts Warp with its warnings only, without the one about a missing GPU. Does nothing with
    BIOTAC_VERBOSE=1, or if the user has set a log level."""
    if wp.config.log_level == wp.LOG_INFO and os.environ.get("BIOTAC_VERBOSE", "0") in ("", "0"):
        wp.config.log_level = wp.LOG_WARNING
        with _without(_NO_GPU):
            wp.init()


@contextlib.contextmanager
def _without(words):
    """Removes lines with these words from the process's standard error, to which C code writes directly."""
    try:
        kept = os.dup(2)
    except OSError:  # there is none
        yield
        return
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            said.seek(0)
            for line in said:
                if words not in line:
                    os.write(2, line)


def announce_compilation(device: wp.DeviceLike) -> None:
    """Prints a note to standard error if Warp must first compile the skin's kernels for a kind of device."""
    cuda = wp.get_device(device).is_cuda
    if not _compiled("cu" if cuda else "cpp"):
        kind, time = ("CUDA", "a minute or two") if cuda else ("the CPU", "half a minute")
        print(f"biotac_mj: compiling kernels for {kind}, once on this machine: {time}", file=sys.stderr)


def _compiled(kind):
    """Whether kernels of the skin are in Warp's cache, as files of that kind."""
    return any(pathlib.Path(wp.config.kernel_cache_dir).glob(f"wp_biotac_mj.skin.*/*.{kind}"))


@functools.cache
def headers() -> concurrent.futures.Future | None:
    """Begins to precompile Warp's headers for the CPU, which takes 4 s: as long as what a press imports
    beside it. Returns the number of the thread that has them; None where kernels are in the cache."""
    quiet_warp()
    wp.init()  # quiet_warp does not where the user has set a log level
    if _compiled("cpp"):
        return None
    pool = concurrent.futures.ThreadPoolExecutor(1)
    found = pool.submit(_precompile)
    pool.shutdown(wait=False)
    return found


def _precompile():
    from . import launches  # a small module

    wp.load_module(wp.get_module(launches.__name__), "cpu", block_dim=1)
    return threading.get_ident()
