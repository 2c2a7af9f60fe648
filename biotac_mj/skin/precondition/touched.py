"""Which nodes touch: numbered for each world, and listed for all of them together."""

import warp as wp

from ..newton.worlds import Worlds, total_of
from ..types import real
from .sides import TINY

__all__ = ["copy_rows", "find_touched", "list_wanted", "survey"]

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
    wanted_out: wp.array(dtype=int),
):
    """Lists the free nodes of touching faces of each world, as they come, and marks them for all."""
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
        wanted_out[i] = 1
        found_out[wp.atomic_add(count, w, 1), w] = i
    slot_out[i, w] = -1


@wp.kernel
def survey(
    # In:
    capacity: int,
    part: wp.array3d(dtype=real),
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
    rr = total_of(part, 0, w, t)
    gg = total_of(part, 2, w, t)
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


@wp.kernel
def list_wanted(
    # In and out:
    wanted: wp.array(dtype=int),
    # Out:
    place_out: wp.array(dtype=int),
    node_out: wp.array(dtype=int),
    count_out: wp.array(dtype=int),
    fits_out: wp.array(dtype=int),
    changed_out: wp.array(dtype=int),
):
    """Numbers the nodes that touch in any world, and forgets them; says whether they are others than
    before."""
    _w, t = wp.tid()
    n = wanted.shape[0]
    room = node_out.shape[0]
    share = (n + wp.block_dim() - 1) // wp.block_dim()
    mine = int(0)
    for i in range(t * share, wp.min((t + 1) * share, n)):
        mine += wanted[i]
    at = wp.untile(wp.tile_scan_exclusive(wp.tile(mine)))
    changed = int(0)
    for i in range(t * share, wp.min((t + 1) * share, n)):
        place_out[i] = at
        if wanted[i] == 1:
            if at < room:
                if node_out[at] != i:
                    changed = 1
                node_out[at] = i
            at += 1
        wanted[i] = 0
    any_changed = wp.tile_extract(wp.tile_sum(wp.tile(changed)), 0)
    if t == wp.block_dim() - 1:
        if count_out[0] != wp.min(at, room):
            any_changed += 1
        changed_out[0] = any_changed
        count_out[0] = wp.min(at, room)
        fits_out[0] = 0
        if at <= room:
            fits_out[0] = 1


@wp.kernel
def copy_rows(
    # In:
    inverse: wp.array2d(dtype=wp.float16),
    free_index: wp.array(dtype=int),
    node: wp.array(dtype=int),
    count: wp.array(dtype=int),
    changed: wp.array(dtype=int),
    # Out:
    rows_out: wp.array2d(dtype=wp.float16),
):
    """Rows of the inverse of the listed nodes, where these are others than before."""
    if changed[0] == 0:
        return
    r, c = wp.tid()
    s = r // 3
    if s < count[0]:
        rows_out[r, c] = inverse[3 * free_index[node[s]] + r % 3, c]
