"""Which nodes touch: numbered for each world."""

import warp as wp

from ..newton.worlds import Worlds, total_of
from ..types import real
from .sides import TINY

__all__ = ["find_touched", "survey"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def find_touched(
    # In:
    free_index: wp.array(dtype=int),
    outer_start: wp.array(dtype=int),
    outer_slot: wp.array(dtype=int),
    outer_touching: wp.array2d(dtype=int),
    core_start: wp.array(dtype=int),
    core_slot: wp.array(dtype=int),
    core_touching: wp.array2d(dtype=int),
    on: wp.array(dtype=int),
    # In and out:
    count: wp.array(dtype=int),
    # Out:
    slot_out: wp.array2d(dtype=int),
    found_out: wp.array2d(dtype=int),
    any_out: wp.array(dtype=int),
):
    """Lists the free nodes of touching faces of each world, as they come."""
    i, w = wp.tid()
    if on[w] == 0:
        return
    here = int(0)
    for k in range(outer_start[i], outer_start[i + 1]):
        here = wp.max(here, outer_touching[outer_slot[k] // 3, w])
    if core_start.shape[0] > 0:
        for k in range(core_start[i], core_start[i + 1]):
            here = wp.max(here, core_touching[core_slot[k] // 3, w])
    if here == 1:
        any_out[w] = 1
    if free_index[i] < 0:
        here = 0
    if here == 1:
        found_out[wp.atomic_add(count, w, 1), w] = i
    slot_out[i, w] = -1


@wp.kernel
def survey(
    # In:
    capacity: int,
    partial: wp.array3d(dtype=real),
    st: Worlds,
    found: wp.array2d(dtype=int),
    # In and out:
    count: wp.array(dtype=int),
    # Out:
    slot_out: wp.array2d(dtype=int),
    node_out: wp.array2d(dtype=int),
    size_out: wp.array(dtype=int),
    norm_out: wp.array2d(dtype=float),
    full_out: wp.array(dtype=int),
):
    """Numbers the touching nodes of each world in their order; norms of the residual and of the liquid's
    gradient. Starts the list anew."""
    w, t = wp.tid()
    if st.active[w] == 0:
        return
    n = count[w]
    rr = total_of(partial, 0, w, t)
    gg = total_of(partial, 2, w, t)
    for k in range(t, n, wp.block_dim()):
        i = found[k, w]
        at = int(0)
        for l in range(n):
            if found[l, w] < i:
                at += 1
        if at < capacity:
            slot_out[i, w] = at
            node_out[at, w] = i
    if t == 0:
        count[w] = 0
        size_out[w] = wp.min(n, capacity)
        if n > capacity:  # the rest is left to conjugate gradients
            full_out[0] = wp.max(full_out[0], n)
        norm_out[0, w] = wp.max(float(wp.sqrt(rr)), TINY)
        norm_out[1, w] = wp.max(float(wp.sqrt(gg)), TINY)
