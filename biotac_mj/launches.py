"""A launch of a kernel on the CPU, made once and run many times."""

import ctypes
import functools
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

try:
    from warp._src.context import _build_cpu_args_structs as _pack
except ImportError:
    _pack = None

__all__ = ["in_a_row", "recorded", "repeated"]

# Warp's kernels of the CPU take two addresses, bounds and arguments, which only its own code says: it was
# read in these versions
_KNOWN = ("1.19.",)

wp.set_module_options({"enable_backward": False})


# Each of `count` entries of four numbers is a launch (0, kernel, bounds, arguments), or others that are gone
# through while a flag is not zero (1, flag, their entries, how many).
@wp.func_native("""
    struct Row {
        static void run(const unsigned long long* entry, unsigned long long count) {
            for (unsigned long long k = 0; k < count; ++k, entry += 4)
                if (entry[0] == 0)
                    ((void (*)(void*, void*))entry[1])((void*)entry[2], (void*)entry[3]);
                else
                    while (*(volatile int*)entry[1]) run((const unsigned long long*)entry[2], entry[3]);
        }
    };
    Row::run((const unsigned long long*)entries.data, entries.shape[0]);
""")
def _run_entries(entries: wp.array2d(dtype=wp.uint64)): ...


@wp.kernel
def _run_row(entries: wp.array2d(dtype=wp.uint64)):
    _run_entries(entries)


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
    addresses = ctypes.addressof(command.params[0]), ctypes.addressof(arguments)
    run.entry = 0, ctypes.cast(command.hooks.forward, ctypes.c_void_p).value, *addresses
    return run


def in_a_row(launches: Sequence[Callable[[], None]]) -> list[Callable[[], None]]:
    """The same, with what was `recorded` or `repeated` one after another as one function each: Python, whose
    threads take turns, is asked once for all of them."""
    made, row = [], []
    for launch in (*launches, None):
        if hasattr(launch, "entry"):
            row.append(launch)
            continue
        made += row if len(row) < 2 else [_row(row)]
        row = []
        if launch:
            made.append(launch)
    return made


def _row(launches):
    entries = np.array([one.entry for one in launches], np.uint64)
    run = recorded(_run_row, 1, [wp.array(entries, dtype=wp.uint64, ndim=2, device="cpu")])
    run.kept = *run.kept, launches
    return run


def repeated(flag: wp.array, launches: Sequence[Callable[[], None]]) -> Callable[[], None]:
    """Goes through launches while flag[0], of the CPU, is not zero."""
    launches = in_a_row(launches)
    on = ctypes.cast(flag.ptr, ctypes.POINTER(ctypes.c_int32))  # read faster than through numpy

    def run():
        while on[0]:
            for launch in launches:
                launch()

    if launches and all(hasattr(one, "entry") for one in launches):
        entries = np.array([one.entry for one in launches], np.uint64)
        run.entry = 1, flag.ptr, entries.ctypes.data, len(entries)
        run.kept = flag, entries, launches
    return run
