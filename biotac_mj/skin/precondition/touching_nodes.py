"""The touching nodes of each world, numbered."""

import warp as wp

from ...kernels import kernel_module
from ..newton.nodes import SurfaceForces
from ..newton.worlds import Worlds, total_of
from ..types import real
from .right_hand_sides import TINY

kernel_module(__name__)


@wp.kernel
def list_touching_nodes(
    # In:
    free_index: wp.array(dtype=int),
    outer: SurfaceForces,
    core: SurfaceForces,
    on: wp.array(dtype=int),
    # In and out:
    count: wp.array(dtype=int),
    # Out:
    slot_out: wp.array2d(dtype=int),
    found_out: wp.array2d(dtype=int),
    any_out: wp.array(dtype=int),
):
    """Appends node i to the list of its world if it is free and a face at it touches."""
    i, w = wp.tid()
    if on[w] == 0:
        return
    here = int(0)
    for k in range(outer.start[i], outer.start[i + 1]):
        here = wp.max(here, outer.touching[outer.slot[k] // 3, w])
    if core.start.shape[0] > 0:
        for k in range(core.start[i], core.start[i + 1]):
            here = wp.max(here, core.touching[core.slot[k] // 3, w])
    if here == 1:
        any_out[w] = 1
    if free_index[i] < 0:
        here = 0
    if here == 1:
        found_out[wp.atomic_add(count, w, 1), w] = i
    slot_out[i, w] = -1


@wp.kernel
def number_touching_nodes(
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
    """Numbers the touching nodes of world w in ascending order, computes the norms of the residual and of the
    volume's gradient, and empties the list."""
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
        if n > capacity:  # conjugate gradients correct for the others
            full_out[0] = wp.max(full_out[0], n)
        norm_out[0, w] = wp.max(float(wp.sqrt(rr)), TINY)
        norm_out[1, w] = wp.max(float(wp.sqrt(gg)), TINY)
