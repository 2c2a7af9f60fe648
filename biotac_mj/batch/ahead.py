"""Finds the kernels that a step launches, without launching any, so that they can be compiled beside each
other. Otherwise Warp compiles each when a step first meets it, and some take a minute.

mujoco_warp's collisions of convex shapes take longest, with one kernel for each pair of types. So these are
compiled first, one level below the compiler's highest. That takes half as long, and does not slow a step down
(docs/lab/batch.md)."""

import contextlib
import threading
import typing
from collections.abc import Callable, Iterator

import mujoco
import numpy as np
import warp as wp

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

_CONVEX, _LEVEL = "ccd_kernel", 2  # of 3


def kernels_of_step(
    mjm: mujoco.MjModel, m: "mjw.Model", callback: object | None = None
) -> list[tuple[wp.Module, int]]:
    """Modules of the kernels of a step of the model and of a reset, each with the block size of its launches,
    slow ones first: the argument of `skin.program.compile_ahead`. Launches of size zero, which Warp skips,
    are left out.

    Args:
      callback: mujoco_warp's, called instead of the model's; None: none is called.
    """
    import mujoco_warp as mjw

    own = m.callback
    try:
        m.callback = type(own)() if callback is None else callback
        with wp.ScopedDevice(m.qpos0.device):
            d = mjw.make_data(mjm)
            found = launched_by(lambda: (mjw.reset_data(m, d), mjw.step(m, d)))
    finally:
        m.callback = own
    convex = [module for module, _ in found if _CONVEX in module.name]
    if wp.config.optimization_level is None:
        for module in convex:  # once: a module whose options are set again is compiled again
            if module.options["optimization_level"] != _LEVEL:
                wp.set_module_options({"optimization_level": _LEVEL}, module)
    return sorted(found, key=lambda launched: launched[0] not in convex)


def launched_by(call: Callable[[], object]) -> list[tuple[wp.Module, int]]:
    """Modules of the kernels that a call launches, with the threads of their blocks; it launches none."""
    found = {}
    with _noted(found):
        call()
    return list(found)


@contextlib.contextmanager
def _noted(found: dict) -> Iterator[None]:
    """This thread's launches are written into `found` instead; loops are gone through once, and both sides of
    branches."""
    here = threading.get_ident()

    def note(kernel, dim, *_, block_dim=256, **__):
        if np.prod(dim):
            found[kernel.module, block_dim] = None

    def suggest(kernel, *_, **__):  # the caller launches with the module's number of threads
        threads = kernel.module.options["block_dim"]
        note(kernel, 1, block_dim=threads)
        return threads, 1

    def both(_condition, on_true=None, on_false=None, stream=None, **given):
        for body in (on_true, on_false):
            if body is not None:
                body(**given)

    def once(_condition, while_body=None, stream=None, **given):
        while_body(**given)

    instead = dict(launch=note, launch_tiled=note, get_suggested_block_size=suggest)
    instead |= dict(capture_if=both, capture_while=once)
    real = {name: getattr(wp, name) for name in instead}

    def chosen(name):
        def call(*given, **named):
            return (instead if threading.get_ident() == here else real)[name](*given, **named)

        return call

    try:
        for name in instead:
            setattr(wp, name, chosen(name))
        yield
    finally:
        for name, function in real.items():
            setattr(wp, name, function)
