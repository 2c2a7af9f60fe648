"""Kernel launches on the CPU, packed once and run many times. Not by Warp's own capture on the CPU: while
that records, it takes the launches of all threads."""

import ctypes
import functools
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from .kernels import kernel_module

try:
    from warp._src.context import _build_cpu_args_structs as _pack
except ImportError:
    _pack = None

# versions of Warp in whose code the signature of CPU kernels was checked: addresses of bounds and arguments
_KNOWN = ("1.19.",)

kernel_module(__name__)


# Each of `count` entries of four numbers is a launch (0, kernel, bounds, arguments), or a loop over other
# entries while a flag is not zero (1, flag, entries, their number).
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
    """A function that runs a kernel over dim on the CPU, with the present values of numbers and structs.

    Warp's record of a launch (`wp.Launch`) packs its arguments at each launch, which takes 2.4 us for seven
    arguments, as long as many kernels here; this takes 0.1 us. tiled: a kernel of blocks, which have one
    thread on the CPU. Kernels must not have Warp tiles, whose memory all host threads share
    (`skin.block.block_sum` has none)."""
    launch, options = (wp.launch_tiled, {"block_dim": 1}) if tiled else (wp.launch, {})
    command = launch(
        kernel, dim=dim, inputs=list(inputs), outputs=list(outputs), device="cpu", record_cmd=True, **options
    )
    if _pack is None or command.block_dim > 1 or not wp.__version__.startswith(_KNOWN):
        return command.launch
    arguments, _ = _pack(command.kernel, command.hooks, command.params, False)
    run = functools.partial(command.hooks.forward, ctypes.byref(command.params[0]), ctypes.byref(arguments))
    run.references = command, inputs, outputs  # keeps their memory alive
    addresses = ctypes.addressof(command.params[0]), ctypes.addressof(arguments)
    run.entry = 0, ctypes.cast(command.hooks.forward, ctypes.c_void_p).value, *addresses
    return run


def in_a_row(launches: Sequence[Callable[[], None]]) -> list[Callable[[], None]]:
    """Joins consecutive `recorded` and `repeated` launches to single functions, so that Python's lock is
    taken once for all of them."""
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
    run.references = *run.references, launches
    return run


def repeated(flag: wp.array, launches: Sequence[Callable[[], None]]) -> Callable[[], None]:
    """A function that repeats launches while flag[0] (on the CPU) is not zero."""
    launches = in_a_row(launches)
    on = ctypes.cast(flag.ptr, ctypes.POINTER(ctypes.c_int32))  # read faster than through numpy

    def run():
        while on[0]:
            for launch in launches:
                launch()

    if launches and all(hasattr(one, "entry") for one in launches):
        entries = np.array([one.entry for one in launches], np.uint64)
        run.entry = 1, flag.ptr, entries.ctypes.data, len(entries)
        run.references = flag, entries, launches
    return run
