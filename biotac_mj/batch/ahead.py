"""Finds the kernels that a step launches, without launching any, so that they can be compiled beside each
other. Otherwise Warp compiles each when a step first meets it, and some take a minute.

mujoco_warp's collisions of convex shapes take longest, with one kernel for each pair of types. So these are
compiled first, one level below the compiler's highest. That takes half as long, and does not slow a step down
(docs/lab/batch.md)."""

import typing

import mujoco
import warp as wp

from ..skin.program import launched_by

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
