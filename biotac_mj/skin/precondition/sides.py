"""Right-hand sides of the dissected inverse and its answers: how vectors of nodes travel through a product in
half precision.

Only free nodes of the inner surface have a gradient of the liquid's volume: they are `wet`. A right-hand
side travels as the sum of two halves, see `dissected`. It is as long as RAISE, or 16 times that
with what contact and liquid answer, so that the second half is a normal one down to 1e-7 of it."""

import warp as wp

from ..newton.worlds import Worlds, total_of
from ..types import real, single, vec3

__all__ = [
    "LOW",
    "RAISE",
    "STIFF",
    "TINY",
    "entry",
    "load_balance",
    "load_gradient",
    "load_residual",
    "measure_norm",
    "measure_swelling",
    "pull_of_liquid",
    "read_along",
    "read_answer",
    "small_side",
]

wp.set_module_options({"enable_backward": False})

STIFF = wp.constant(
    1.0e5
)  # [N/m] of the liquid's direction as it is scaled: like that of contact, so that single precision suffices
TINY = wp.constant(1.0e-30)
LOW = wp.constant(2048.0)  # what the second half of an entry is magnified by
RAISE = wp.constant(64.0)


@wp.func
def write_node(b: wp.vec3, row: int, column: int, out: wp.array3d(dtype=wp.float16)):
    """As often as the columns of the matrix want it, see `dissected`."""
    for a in range(3):
        value = RAISE * b[a]
        high = wp.float16(value)
        out[row + a, 0, column] = high
        out[row + a, 1, column] = wp.float16(value - float(high))
        if out.shape[1] == 3:
            out[row + a, 2, column] = high


@wp.func
def read_node(x: wp.array2d(dtype=float), row: int, column: int):
    return wp.vec3(x[row, column], x[row + 1, column], x[row + 2, column]) / RAISE


@wp.func
def onward(matrix: wp.array2d(dtype=wp.mat33), i: int, w: int, motion: wp.vec3):
    """The motion of node i that one of the resting skin stands for, see `carried`; without matrices the
    same."""
    if matrix.shape[0] > 0:
        return matrix[i, w] * motion
    return motion


@wp.func
def back(matrix: wp.array2d(dtype=wp.mat33), i: int, w: int, force: wp.vec3):
    """The force on the resting skin that one on node i stands for."""
    if matrix.shape[0] > 0:
        return wp.transpose(matrix[i, w]) * force
    return force


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
    row: wp.array(dtype=int),
    wet: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    norm: wp.array2d(dtype=float),
    on: wp.array(dtype=int),
    matrix: wp.array2d(dtype=wp.mat33),
    side_out: wp.array3d(dtype=wp.float16),
):
    i, w = wp.tid()
    j = row[i]
    if on[w] == 1 and j >= 0:
        g = wp.vec3()
        if wet[i] == 1:
            g = single(gradient[i, w]) / norm[1, w]
        write_node(back(matrix, i, w, g), j, w, side_out)


@wp.kernel
def load_residual(
    row: wp.array(dtype=int),
    r: wp.array2d(dtype=wp.vec3),
    norm: wp.array2d(dtype=float),
    on: wp.array(dtype=int),
    matrix: wp.array2d(dtype=wp.mat33),
    side_out: wp.array3d(dtype=wp.float16),
):
    i, w = wp.tid()
    j = row[i]
    if on[w] == 1 and j >= 0:
        write_node(back(matrix, i, w, r[i, w] / norm[0, w]), j, w, side_out)


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
    row: wp.array(dtype=int),
    wet: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    answer: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    scale: float,
    st: Worlds,
    on: wp.array(dtype=int),
    matrix: wp.array2d(dtype=wp.mat33),
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
    for i in range(c * chunk, wp.min((c + 1) * chunk, row.shape[0])):
        j = row[i]
        along = wp.vec3()
        if j >= 0:
            along = onward(matrix, i, w, read_node(answer, j, w) * factor)
            if wet[i] == 1:
                gg += real(wp.dot(pull * single(gradient[i, w]), along))
        along_out[i, w] = along
    part_out[1, c, w] = gg


@wp.kernel
def measure_swelling(
    # In:
    chunk: int,
    row: wp.array(dtype=int),
    wet: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    answer: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    scale: float,
    st: Worlds,
    on: wp.array(dtype=int),
    matrix: wp.array2d(dtype=wp.mat33),
    # Out:
    part_out: wp.array3d(dtype=real),
):
    """What the residual does to the liquid's volume, of the answer to it."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    factor = norm[0, w] * pull_of_liquid(st, w) * scale * float(st.softness[w])
    total = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, row.shape[0])):
        if wet[i] == 1:
            y = onward(matrix, i, w, read_node(answer, row[i], w))
            total += real(wp.dot(single(gradient[i, w]), y))
    part_out[0, c, w] = real(factor) * total


@wp.kernel
def small_side(
    # In:
    has_liquid: int,
    row: wp.array(dtype=int),
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    answer: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    scale: float,
    st: Worlds,
    on: wp.array(dtype=int),
    matrix: wp.array2d(dtype=wp.mat33),
    # Out:
    u_out: wp.array2d(dtype=float),
    largest_out: wp.array(dtype=float),
):
    """What the residual does at the touching nodes."""
    s, w = wp.tid()
    if on[w] == 0:
        return
    if s == 0:
        largest_out[w] = 0.0
    if s < size[w]:
        i = node[s, w]
        y = onward(matrix, i, w, read_node(answer, row[i], w) * (norm[0, w] * scale * float(st.softness[w])))
        for a in range(3):
            u_out[w, has_liquid + 3 * s + a] = y[a]


@wp.kernel
def load_balance(
    # In:
    has_liquid: int,
    row: wp.array(dtype=int),
    slot: wp.array2d(dtype=int),
    r: wp.array2d(dtype=wp.vec3),
    wet: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    q: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    largest: wp.array(dtype=float),
    st: Worlds,
    on: wp.array(dtype=int),
    matrix: wp.array2d(dtype=wp.mat33),
    # Out:
    side_out: wp.array3d(dtype=wp.float16),
):
    """The residual less what contact and liquid answer, as a right-hand side."""
    i, w = wp.tid()
    j = row[i]
    if on[w] == 0 or j < 0:
        return
    b = r[i, w]
    s = slot[i, w]
    if s >= 0:
        at = has_liquid + 3 * s
        b -= wp.vec3(q[w, at], q[w, at + 1], q[w, at + 2])
    if has_liquid == 1 and wet[i] == 1:
        b -= q[w, 0] * pull_of_liquid(st, w) * single(gradient[i, w])
    write_node(back(matrix, i, w, b / (norm[0, w] + 2.0 * largest[w])), j, w, side_out)


@wp.kernel
def read_answer(
    # In:
    chunk: int,
    row: wp.array(dtype=int),
    answer: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    largest: wp.array(dtype=float),
    scale: float,
    r: wp.array2d(dtype=wp.vec3),
    wet: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    st: Worlds,
    on: wp.array(dtype=int),
    matrix: wp.array2d(dtype=wp.mat33),
    # Out:
    z_out: wp.array2d(dtype=wp.vec3),
    part_out: wp.array3d(dtype=real),
):
    """The result, and its scalar products with the residual and with the gradient of the liquid's volume."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    factor = (norm[0, w] + 2.0 * largest[w]) * scale * float(st.softness[w])
    rz = real(0.0)
    gz = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, row.shape[0])):
        z = wp.vec3()
        j = row[i]
        if j >= 0:
            z = onward(matrix, i, w, factor * read_node(answer, j, w))
            rz += real(wp.dot(r[i, w], z))
            if wet.shape[0] > 0 and wet[i] == 1:
                gz += real(wp.dot(single(gradient[i, w]), z))
        z_out[i, w] = z
    part_out[0, c, w] = rz
    part_out[1, c, w] = gz
