"""A launch of a kernel on the CPU, made once and run many times."""

import ctypes
import functools
from collections.abc import Callable, Sequence

import warp as wp

try:
    from warp._src.context import _build_cpu_args_structs as _pack
except ImportError:
    _pack = None

__all__ = ["recorded"]

# Warp's kernels of the CPU take two addresses, bounds and arguments, which only its own code says: it was
# read in these versions
_KNOWN = ("1.19.",)


def recorded(
    kernel: wp.Kernel,
    dim: int | Sequence[int],
    inputs: Sequence,
    outputs: Sequence = (),
    tiled: bool = False,
) -> Callable[[], None]:
    """What runs a kernel over dim on the CPU with these arguments, numbers and structs as they are now.

    Warp's own record of a launch (`wp.Launch`) packs its arguments each time it is launched, which takes 2.4
    us for seven of them where many a kernel here takes as long; this takes 0.1. tiled: a kernel of blocks, of
    one thread each here. No kernel may have Warp's tiles: they would lie in one place for all threads of the
    host, and each kernel of their module would begin to fill it anew (`skin.types.sum_of_block` has none).
    """
    launch, options = (wp.launch_tiled, {"block_dim": 1}) if tiled else (wp.launch, {})
    command = launch(
        kernel, dim=dim, inputs=list(inputs), outputs=list(outputs), device="cpu", record_cmd=True, **options
    )
    if _pack is None or command.block_dim > 1 or not wp.__version__.startswith(_KNOWN):
        return command.launch
    arguments, _ = _pack(command.kernel, command.hooks, command.params, False)
    run = functools.partial(command.hooks.forward, ctypes.byref(command.params[0]), ctypes.byref(arguments))
    run.kept = command, inputs, outputs  # their memory is what is worked on
    return run
