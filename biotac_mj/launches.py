"""A launch of a kernel on the CPU, made once and run many times."""

import ctypes
import functools
import os
import threading
from collections.abc import Callable, Sequence

import warp as wp

try:
    from warp._src.context import _build_cpu_args_structs as _pack
except ImportError:
    _pack = None

__all__ = ["one_at_a_time", "recorded"]

# Warp's kernels of the CPU take two addresses, bounds and arguments, which only its own code says: it was
# read in these versions
_KNOWN = ("1.19.",)

_tiles = threading.Lock()
_with_tiles = set()  # modules of which a kernel of tiles was recorded


def _forget_lock():
    global _tiles
    _tiles = threading.Lock()


if hasattr(os, "register_at_fork"):  # a child has none of the threads that may hold it
    os.register_at_fork(after_in_child=_forget_lock)


def one_at_a_time(launch: Callable[[], None]) -> None:
    """Runs a kernel on the CPU that has tiles, or whose module has: where they lie is told by one address for
    all threads, which every kernel of the module sets."""
    with _tiles:
        launch()


def _in_turn(launch, module):
    def run():
        if module in _with_tiles:
            one_at_a_time(launch)
        else:
            launch()

    return run


def recorded(
    kernel: wp.Kernel,
    dim: int | Sequence[int],
    inputs: Sequence,
    outputs: Sequence = (),
    tiled: bool = False,
) -> Callable[[], None]:
    """What runs a kernel over dim on the CPU with these arguments, numbers and structs as they are now.

    Warp's own record of a launch (`wp.Launch`) packs its arguments each time it is launched, which takes 2.4
    us for seven of them where many a kernel here takes as long; this takes 0.1. tiled: a kernel of tiles. Of
    these, and of others of their modules, one runs at a time.
    """
    launch, options = (wp.launch_tiled, {"block_dim": 1}) if tiled else (wp.launch, {})
    command = launch(
        kernel, dim=dim, inputs=list(inputs), outputs=list(outputs), device="cpu", record_cmd=True, **options
    )
    if tiled:
        _with_tiles.add(kernel.module)
    if _pack is None or command.block_dim > 1 or not wp.__version__.startswith(_KNOWN):
        return _in_turn(command.launch, kernel.module)
    arguments, _ = _pack(command.kernel, command.hooks, command.params, False)
    again = functools.partial(command.hooks.forward, ctypes.byref(command.params[0]), ctypes.byref(arguments))
    run = _in_turn(again, kernel.module)
    run.kept = command, inputs, outputs  # their memory is what is worked on
    return run
