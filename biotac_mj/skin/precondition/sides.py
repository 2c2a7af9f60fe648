"""Right-hand sides of the dense inverse and its answers: how vectors of nodes travel through a product in
half precision.

A right-hand side travels as the sum of two halves, see `dense.DenseInverse`.
"""

import warp as wp

from ..newton.worlds import Worlds, total_of
from ..types import real, single, vec3

__all__ = [
    "LOW",
    "STIFF",
    "TINY",
    "entry",
    "load_balance",
    "load_gradient",
    "load_residual",
    "measure_along",
    "measure_norm",
    "pull_of_liquid",
    "read_along",
    "read_answer",
    "small_rows",
    "small_side",
]

wp.set_module_options({"enable_backward": False})

STIFF = wp.constant(
    1.0e5
)  # [N/m] of the liquid's direction as it is scaled: like that of contact, so that single precision suffices
TINY = wp.constant(1.0e-30)
LOW = wp.constant(2048.0)  # what the second half is magnified by


@wp.func
def write_halves(b: wp.vec3, row: int, column: int, nworld: int, out: wp.array2d(dtype=wp.float16)):
    for a in range(3):
        high = wp.float16(b[a])
        out[row + a, column] = high
        out[row + a, column + nworld] = wp.float16((b[a] - float(high)) * LOW)


@wp.func
def read_halves(
    x: wp.array2d(dtype=float), rest: wp.array2d(dtype=float), row: int, column: int, nworld: int
):
    """The answer of both halves, and of the inverse's remainder where it has one."""
    y = wp.vec3()
    for a in range(3):
        y[a] = x[row + a, column] + x[row + a, column + nworld] / LOW
        if rest.shape[0] > 0:
            y[a] += rest[row + a, column] / LOW
    return y


@wp.func
def entry(half: wp.array2d(dtype=wp.float16), rest: wp.array2d(dtype=wp.float16), row: int, column: int):
    """Of the inverse."""
    value = float(half[row, column])
    if rest.shape[0] > 0:
        value += float(rest[row, column]) / LOW
    return value


@wp.func
def pull_of_liquid(st: Worlds, w: int):
    """The liquid's direction is its gradient times this."""
    return wp.sqrt(float(st.kappa[w]) / STIFF)


@wp.kernel
def load_gradient(
    free_index: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    norm: wp.array2d(dtype=float),
    on: wp.array(dtype=int),
    side_out: wp.array2d(dtype=wp.float16),
):
    i, w = wp.tid()
    j = free_index[i]
    if on[w] == 1 and j >= 0:
        write_halves(single(gradient[i, w]) / norm[1, w], 3 * j, w, on.shape[0], side_out)


@wp.kernel
def load_residual(
    free_index: wp.array(dtype=int),
    r: wp.array2d(dtype=wp.vec3),
    norm: wp.array2d(dtype=float),
    on: wp.array(dtype=int),
    side_out: wp.array2d(dtype=wp.float16),
):
    i, w = wp.tid()
    j = free_index[i]
    if on[w] == 1 and j >= 0:
        write_halves(r[i, w] / norm[0, w], 3 * j, w, on.shape[0], side_out)


@wp.kernel
def measure_norm(part: wp.array3d(dtype=real), on: wp.array(dtype=int), norm_out: wp.array2d(dtype=float)):
    w, t = wp.tid()
    if on[w] == 0:
        return
    rr = total_of(part, 0, w, t)
    if t == 0:
        norm_out[0, w] = wp.max(float(wp.sqrt(rr)), TINY)


@wp.kernel
def read_along(
    # In:
    chunk: int,
    free_index: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    answer: wp.array2d(dtype=float),
    rest: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    scale: float,
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    along_out: wp.array2d(dtype=wp.vec3),
    part_out: wp.array3d(dtype=real),
):
    """What the liquid's direction does everywhere, and to itself."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    pull = pull_of_liquid(st, w)
    factor = norm[1, w] * pull * scale * float(st.softness[w])
    gg = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, free_index.shape[0])):
        j = free_index[i]
        along = wp.vec3()
        if j >= 0:
            along = read_halves(answer, rest, 3 * j, w, on.shape[0]) * factor
            gg += real(wp.dot(pull * single(gradient[i, w]), along))
        along_out[i, w] = along
    part_out[1, c, w] = gg


@wp.kernel
def measure_along(
    chunk: int,
    r: wp.array2d(dtype=wp.vec3),
    along: wp.array2d(dtype=wp.vec3),
    on: wp.array(dtype=int),
    part_out: wp.array3d(dtype=real),
):
    """What the residual does to the liquid's volume: the inverse is symmetric."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    total = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, r.shape[0])):
        total += real(wp.dot(r[i, w], along[i, w]))
    part_out[0, c, w] = total


@wp.kernel
def small_rows(
    # In:
    has_liquid: int,
    inverse: wp.array2d(dtype=wp.float16),
    rest: wp.array2d(dtype=wp.float16),
    scale: float,
    free: wp.array(dtype=int),
    free_index: wp.array(dtype=int),
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    r: wp.array2d(dtype=wp.vec3),
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    u_out: wp.array2d(dtype=float),
    largest_out: wp.array(dtype=float),
):
    """What the residual does at the touching nodes, by their rows of the inverse: for few worlds. A block of
    threads for each row."""
    w, k, t = wp.tid()
    if on[w] == 0:
        return
    if k == 0 and t == 0:
        largest_out[w] = 0.0
    s = k // 3
    if s >= size[w]:
        return
    row = 3 * free_index[node[s, w]] + k % 3
    y = float(0.0)
    for j in range(t, free.shape[0], wp.block_dim()):
        v = r[free[j], w]
        for b in range(3):
            y += entry(inverse, rest, row, 3 * j + b) * v[b]
    total = wp.tile_extract(wp.tile_sum(wp.tile(y)), 0)
    if t == 0:
        u_out[w, has_liquid + k] = total * scale * float(st.softness[w])


@wp.kernel
def small_side(
    # In:
    has_liquid: int,
    row: wp.array(dtype=int),
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    answer: wp.array2d(dtype=float),
    rest: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    scale: float,
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    u_out: wp.array2d(dtype=float),
    largest_out: wp.array(dtype=float),
):
    """The same from the product of the whole inverse: for many worlds."""
    s, w = wp.tid()
    if on[w] == 0:
        return
    if s == 0:
        largest_out[w] = 0.0
    if s < size[w]:
        y = read_halves(answer, rest, 3 * row[node[s, w]], w, on.shape[0]) * (
            norm[0, w] * scale * float(st.softness[w])
        )
        for a in range(3):
            u_out[w, has_liquid + 3 * s + a] = y[a]


@wp.kernel
def load_balance(
    # In:
    has_liquid: int,
    free_index: wp.array(dtype=int),
    slot: wp.array2d(dtype=int),
    r: wp.array2d(dtype=wp.vec3),
    gradient: wp.array2d(dtype=vec3),
    q: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    largest: wp.array(dtype=float),
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    side_out: wp.array2d(dtype=wp.float16),
):
    """The residual less what contact and liquid answer, as a right-hand side."""
    i, w = wp.tid()
    j = free_index[i]
    if on[w] == 0 or j < 0:
        return
    b = r[i, w]
    s = slot[i, w]
    if s >= 0:
        row = has_liquid + 3 * s
        b -= wp.vec3(q[w, row], q[w, row + 1], q[w, row + 2])
    if has_liquid == 1:
        b -= q[w, 0] * pull_of_liquid(st, w) * single(gradient[i, w])
    write_halves(b / (norm[0, w] + 2.0 * largest[w]), 3 * j, w, on.shape[0], side_out)


@wp.kernel
def read_answer(
    # In:
    chunk: int,
    free_index: wp.array(dtype=int),
    answer: wp.array2d(dtype=float),
    rest: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    largest: wp.array(dtype=float),
    scale: float,
    r: wp.array2d(dtype=wp.vec3),
    gradient: wp.array2d(dtype=vec3),
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    z_out: wp.array2d(dtype=wp.vec3),
    part_out: wp.array3d(dtype=real),
):
    """The result, and its scalar products with the residual and with the gradient of the liquid's volume."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    back = (norm[0, w] + 2.0 * largest[w]) * scale * float(st.softness[w])
    rz = real(0.0)
    gz = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, free_index.shape[0])):
        z = wp.vec3()
        j = free_index[i]
        if j >= 0:
            z = back * read_halves(answer, rest, 3 * j, w, on.shape[0])
            rz += real(wp.dot(r[i, w], z))
            if gradient.shape[0] > 0:
                gz += real(wp.dot(single(gradient[i, w]), z))
        z_out[i, w] = z
    part_out[0, c, w] = rz
    part_out[1, c, w] = gz
