"""The preconditioner of `preconditioner.py` for all worlds at once, without a look back at the host.

Woodbury's identity in two products with the dense inverse of the rest stiffness: one finds what the residual does at the touching
nodes, then the forces of contact and liquid that answer there, q = (I + D W)^-1 D u, join the residual, and the second gives the result.
A right-hand side travels as the sum of two halves (see `factor.DenseFactor`). The small systems hold the liquid first, then three
rows for each touching node; G = (I + D W)^-1 D is made explicitly, so that applying it is one short product.
"""

import numpy as np
import warp as wp

from .contact import Geoms  # noqa: F401 - the struct's module is loaded before kernels that share its arrays
from .device_nodes import block_index
from .device_worlds import Worlds
from .types import mat33, real, vec3

__all__ = ["DevicePreconditioner"]

wp.set_module_options({"enable_backward": False})

_STIFF = wp.constant(1.0e5)  # [N/m] of the liquid's direction as it is scaled: like that of contact, so that single precision suffices
_LOW = wp.constant(2048.0)  # what the second half is magnified by
_TINY = wp.constant(1.0e-30)


@wp.kernel
def find_touched(
    # In:
    chunk: int,
    free_index: wp.array(dtype=int),
    outer_start: wp.array(dtype=int),
    outer_slot: wp.array(dtype=int),
    outer_touching: wp.array2d(dtype=int),
    core_start: wp.array(dtype=int),
    core_slot: wp.array(dtype=int),
    core_touching: wp.array2d(dtype=int),
    on: wp.array(dtype=int),
    # Out:
    slot_out: wp.array2d(dtype=int),
    count_out: wp.array2d(dtype=int),
    any_out: wp.array2d(dtype=int),
):
    """Marks the free nodes of touching faces and counts them by chunks."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    count = int(0)
    touched = int(0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, free_index.shape[0])):
        here = int(0)
        for k in range(outer_start[i], outer_start[i + 1]):
            here = wp.max(here, outer_touching[outer_slot[k] // 3, w])
        if core_start.shape[0] > 0:
            for k in range(core_start[i], core_start[i + 1]):
                here = wp.max(here, core_touching[core_slot[k] // 3, w])
        touched = wp.max(touched, here)
        if free_index[i] < 0:
            here = 0
        slot_out[i, w] = here
        count += here
    count_out[c, w] = count
    any_out[c, w] = touched


@wp.kernel
def survey(
    # In:
    capacity: int,
    part: wp.array3d(dtype=real),
    any_part: wp.array2d(dtype=int),
    st: Worlds,
    # In and out:
    count: wp.array2d(dtype=int),
    # Out:
    size_out: wp.array(dtype=int),
    any_out: wp.array(dtype=int),
    norm_out: wp.array2d(dtype=float),
    full_out: wp.array(dtype=int),
):
    """Where each chunk's touching nodes go in the small system; norms of the residual and of the liquid's direction."""
    w = wp.tid()
    if st.active[w] == 0:
        return
    total = int(0)
    touched = int(0)
    rr = real(0.0)
    gg = real(0.0)
    for c in range(count.shape[0]):
        here = count[c, w]
        count[c, w] = total
        total += here
        touched = wp.max(touched, any_part[c, w])
        rr += part[0, c, w]
        gg += part[2, c, w]
    if total > capacity:  # the rest is left to conjugate gradients
        full_out[0] = wp.max(full_out[0], total)
        total = capacity
    size_out[w] = total
    any_out[w] = touched
    norm_out[0, w] = wp.max(float(wp.sqrt(rr)), _TINY)
    norm_out[1, w] = wp.max(float(wp.sqrt(gg)), _TINY)


@wp.func
def write_halves(b: wp.vec3, row: int, column: int, nworld: int, out: wp.array2d(dtype=wp.float16)):
    for a in range(3):
        high = wp.float16(b[a])
        out[row + a, column] = high
        out[row + a, column + nworld] = wp.float16((b[a] - float(high)) * _LOW)


@wp.func
def read_halves(x: wp.array2d(dtype=float), row: int, column: int, nworld: int):
    return wp.vec3(
        x[row, column] + x[row, column + nworld] / _LOW,
        x[row + 1, column] + x[row + 1, column + nworld] / _LOW,
        x[row + 2, column] + x[row + 2, column + nworld] / _LOW,
    )


@wp.func
def lowered(v: vec3):
    return wp.vec3(float(v[0]), float(v[1]), float(v[2]))


@wp.kernel
def load_sides(
    # In:
    chunk: int,
    capacity: int,
    free_index: wp.array(dtype=int),
    first: wp.array2d(dtype=int),
    r: wp.array2d(dtype=wp.vec3),
    gradient: wp.array2d(dtype=vec3),
    norm: wp.array2d(dtype=float),
    on: wp.array(dtype=int),
    # In and out:
    slot: wp.array2d(dtype=int),
    # Out:
    node_out: wp.array2d(dtype=int),
    side_out: wp.array2d(dtype=wp.float16),
):
    """Numbers the touching nodes; residual and liquid's direction as right-hand sides."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    nworld = on.shape[0]
    at = first[c, w]
    for i in range(c * chunk, wp.min((c + 1) * chunk, free_index.shape[0])):
        if slot[i, w] == 1 and at < capacity:
            slot[i, w] = at
            node_out[at, w] = i
            at += 1
        else:
            slot[i, w] = -1
        j = free_index[i]
        if j >= 0:
            write_halves(r[i, w] / norm[0, w], 3 * j, w, nworld, side_out)
            if gradient.shape[0] > 0:
                write_halves(lowered(gradient[i, w]) / norm[1, w], 3 * j, 2 * nworld + w, nworld, side_out)


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
    w = wp.tid()
    if on[w] == 0:
        return
    rr = real(0.0)
    for c in range(part.shape[1]):
        rr += part[0, c, w]
    norm_out[0, w] = wp.max(float(wp.sqrt(rr)), _TINY)


@wp.func
def pull_of_liquid(st: Worlds, w: int):
    """The liquid's direction is its gradient times this."""
    return wp.sqrt(float(st.kappa[w]) / _STIFF)


@wp.kernel
def measure_liquid(
    # In:
    chunk: int,
    has_along: int,
    free_index: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    answer: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    scale: float,
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    along_out: wp.array2d(dtype=wp.vec3),
    part_out: wp.array3d(dtype=real),
):
    """Scalar products of the liquid's direction with the answers to the residual and to itself."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    nworld = on.shape[0]
    pull = pull_of_liquid(st, w)
    soft = scale * float(st.softness[w])
    gy = real(0.0)
    gg = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, free_index.shape[0])):
        j = free_index[i]
        if j >= 0:
            g = pull * lowered(gradient[i, w])
            y = read_halves(answer, 3 * j, w, nworld)
            gy += real(wp.dot(g, y) * (norm[0, w] * soft))
            if has_along == 1:
                along = read_halves(answer, 3 * j, 2 * nworld + w, nworld) * (norm[1, w] * pull * soft)
                along_out[i, w] = along
                gg += real(wp.dot(g, along))
    part_out[0, c, w] = gy
    part_out[1, c, w] = gg


@wp.kernel
def small_compliance(
    # In:
    inverse: wp.array2d(dtype=wp.float16),
    scale: float,
    free_index: wp.array(dtype=int),
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    has_liquid: int,
    along: wp.array2d(dtype=wp.vec3),
    part: wp.array3d(dtype=real),
    st: Worlds,
    # Out:
    W_out: wp.array3d(dtype=float),
):
    """W over the liquid's direction and the touching nodes, by blocks."""
    w, i, j = wp.tid()
    if st.active[w] == 0:
        return
    if i == 0 and j == 0 and has_liquid == 1:
        gg = real(0.0)
        for c in range(part.shape[1]):
            gg += part[1, c, w]
        W_out[w, 0, 0] = float(gg)
    n = size[w]
    if i >= n or j >= n:
        return
    soft = scale * float(st.softness[w])
    a = 3 * free_index[node[i, w]]
    b = 3 * free_index[node[j, w]]
    row = has_liquid + 3 * i
    column = has_liquid + 3 * j
    for k in range(3):
        for l in range(3):
            W_out[w, row + k, column + l] = float(inverse[a + k, b + l]) * soft
    if j == 0 and has_liquid == 1:
        v = along[node[i, w], w]
        for k in range(3):
            W_out[w, 0, row + k] = v[k]
            W_out[w, row + k, 0] = v[k]


@wp.func
def add_rows(
    i: int,
    w: int,
    row: int,
    shift: int,
    start: wp.array(dtype=int),
    slots: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    touching: wp.array2d(dtype=int),
    block: wp.array2d(dtype=mat33),
    slot: wp.array2d(dtype=int),
    D: wp.array3d(dtype=float),
):
    for k in range(start[i], start[i + 1]):
        s = slots[k]
        f = s // 3
        if touching[f, w] == 1:
            a = s % 3
            for b in range(3):
                j = slot[face[f][b], w]
                if j >= 0:
                    K = block[6 * f + block_index(wp.min(a, b), wp.max(a, b)), w]
                    for c in range(3):
                        for d in range(3):
                            D[w, row + c, shift + 3 * j + d] = D[w, row + c, shift + 3 * j + d] + float(K[c, d])


@wp.kernel
def small_stiffness(
    # In:
    has_liquid: int,
    outer_face: wp.array(dtype=wp.vec3i),
    outer_start: wp.array(dtype=int),
    outer_slot: wp.array(dtype=int),
    outer_touching: wp.array2d(dtype=int),
    outer_block: wp.array2d(dtype=mat33),
    core_face: wp.array(dtype=wp.vec3i),
    core_start: wp.array(dtype=int),
    core_slot: wp.array(dtype=int),
    core_touching: wp.array2d(dtype=int),
    core_block: wp.array2d(dtype=mat33),
    slot: wp.array2d(dtype=int),
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    on: wp.array(dtype=int),
    # Out:
    D_out: wp.array3d(dtype=float),
):
    """D: the contact's tangent over the touching nodes, by rows of nodes, and the liquid's stiffness."""
    w, s = wp.tid()
    if on[w] == 0:
        return
    n = size[w]
    if s == 0 and has_liquid == 1:
        for k in range(1 + 3 * n):
            D_out[w, 0, k] = 0.0
        D_out[w, 0, 0] = _STIFF
    if s >= n:
        return
    row = has_liquid + 3 * s
    for c in range(3):
        for k in range(has_liquid + 3 * n):
            D_out[w, row + c, k] = 0.0
    i = node[s, w]
    add_rows(i, w, row, has_liquid, outer_start, outer_slot, outer_face, outer_touching, outer_block, slot, D_out)
    if core_start.shape[0] > 0:
        add_rows(i, w, row, has_liquid, core_start, core_slot, core_face, core_touching, core_block, slot, D_out)


@wp.kernel
def small_system(
    # In:
    has_liquid: int,
    size: wp.array(dtype=int),
    D: wp.array3d(dtype=float),
    W: wp.array3d(dtype=float),
    on: wp.array(dtype=int),
    # Out:
    A_out: wp.array3d(dtype=float),
):
    """A = I + D W by entries; D is sparse."""
    w, i, j = wp.tid()
    if on[w] == 0:
        return
    n = has_liquid + 3 * size[w]
    if i >= n or j >= n:
        return
    total = float(0.0)
    if i == j:
        total = 1.0
    for k in range(n):
        d = D[w, i, k]
        if d != 0.0:
            total += d * W[w, k, j]
    A_out[w, i, j] = total


@wp.kernel
def invert_serial(
    has_liquid: int,
    size: wp.array(dtype=int),
    on: wp.array(dtype=int),
    A: wp.array3d(dtype=float),
    pivot: wp.array2d(dtype=int),
    B_out: wp.array3d(dtype=float),
):
    """Inverse by Gauss-Jordan exchange with row pivots, one thread for each world: for the CPU."""
    w = wp.tid()
    if on[w] == 0:
        return
    n = has_liquid + 3 * size[w]
    for i in range(n):
        pivot[w, i] = -1  # of row i: the column that it was exchanged with
    for k in range(n):
        p = int(-1)
        best = float(-1.0)
        for i in range(n):
            if pivot[w, i] < 0 and wp.abs(A[w, i, k]) > best:
                best = wp.abs(A[w, i, k])
                p = i
        pivot[w, p] = k
        d = 1.0 / A[w, p, k]
        for j in range(n):
            if j != k:
                A[w, p, j] = A[w, p, j] * d
        A[w, p, k] = d
        for i in range(n):
            if i != p:
                f = A[w, i, k]
                if f != 0.0:
                    for j in range(n):
                        if j != k:
                            A[w, i, j] = A[w, i, j] - f * A[w, p, j]
                    A[w, i, k] = -f * d
    # row i of the exchanged matrix gives unknown pivot[i]; its column k belongs to the right-hand side of the row with pivot k
    for i in range(n):
        for j in range(n):
            B_out[w, pivot[w, i], j] = A[w, i, pivot[w, j]]


@wp.kernel
def small_answer(
    # In:
    has_liquid: int,
    size: wp.array(dtype=int),
    D: wp.array3d(dtype=float),
    B: wp.array3d(dtype=float),
    on: wp.array(dtype=int),
    # Out:
    G_out: wp.array3d(dtype=float),
):
    """G = B D, stored transposed: threads that sum one entry each then read side by side. D is symmetric."""
    w, j, i = wp.tid()
    if on[w] == 0:
        return
    n = has_liquid + 3 * size[w]
    if i >= n or j >= n:
        return
    total = float(0.0)
    for k in range(n):
        d = D[w, j, k]
        if d != 0.0:
            total += B[w, i, k] * d
    G_out[w, j, i] = total


@wp.kernel
def small_side(
    # In:
    has_liquid: int,
    free_index: wp.array(dtype=int),
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    answer: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    scale: float,
    part: wp.array3d(dtype=real),
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    u_out: wp.array2d(dtype=float),
    largest_out: wp.array(dtype=float),
):
    """What the residual does to the liquid's volume and at the touching nodes."""
    w, s = wp.tid()
    if on[w] == 0:
        return
    if s == 0:
        largest_out[w] = 0.0
        if has_liquid == 1:
            gy = real(0.0)
            for c in range(part.shape[1]):
                gy += part[0, c, w]
            u_out[w, 0] = float(gy)
    if s < size[w]:
        y = read_halves(answer, 3 * free_index[node[s, w]], w, on.shape[0]) * (norm[0, w] * scale * float(st.softness[w]))
        for a in range(3):
            u_out[w, has_liquid + 3 * s + a] = y[a]


@wp.kernel
def small_forces(
    # In:
    has_liquid: int,
    size: wp.array(dtype=int),
    G: wp.array3d(dtype=float),
    u: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    q_out: wp.array2d(dtype=float),
    largest_out: wp.array(dtype=float),
):
    """q = G u, and a bound of what it pushes with."""
    w, i = wp.tid()
    if on[w] == 0:
        return
    n = has_liquid + 3 * size[w]
    if i >= n:
        return
    total = float(0.0)
    for k in range(n):
        total += G[w, k, i] * u[w, k]
    q_out[w, i] = total
    bound = wp.abs(total)
    if i < has_liquid:
        bound *= norm[1, w] * pull_of_liquid(st, w)
    wp.atomic_max(largest_out, w, bound)


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
        b -= q[w, 0] * pull_of_liquid(st, w) * lowered(gradient[i, w])
    write_halves(b / (norm[0, w] + 2.0 * largest[w]), 3 * j, w, on.shape[0], side_out)


@wp.kernel
def read_answer(
    # In:
    chunk: int,
    free_index: wp.array(dtype=int),
    answer: wp.array2d(dtype=float),
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
            z = back * read_halves(answer, 3 * j, w, on.shape[0])
            rz += real(wp.dot(r[i, w], z))
            if gradient.shape[0] > 0:
                gz += real(wp.dot(lowered(gradient[i, w]), z))
        z_out[i, w] = z
    part_out[0, c, w] = rz
    part_out[1, c, w] = gz


class DevicePreconditioner:
    """For all worlds of one SkinData: `update` after each evaluation of the forces, then `apply`.

    Args:
      model: the SkinModel.
      surfaces: (outer, core) contact states, core None where there is none.
      nworld: number of worlds.
      chunk: nodes summed by one thread.
      capacity: touching nodes that the small systems hold; contact beyond is left to conjugate gradients, which then take longer.
    """

    def __init__(self, model, surfaces, nworld, chunk, capacity):
        self.m, self.nworld, self.chunk, self.capacity = model, nworld, chunk, capacity
        self.device = model.device
        self.liquid = int(model.has_liquid)
        n, nchunk = model.nvert, -(-model.nvert // chunk)
        self._chunks, self._nodes = (nchunk, nworld), (n, nworld)
        index = np.full(n, -1, np.int32)
        index[model.free] = np.arange(len(model.free))
        self._inverse = _Inverse(model)
        rows, size = self._inverse.padded, self.liquid + 3 * capacity
        with wp.ScopedDevice(self.device):
            self._free = wp.array(index, dtype=int)
            none = wp.zeros(0, dtype=int), wp.zeros((0, nworld), dtype=int), wp.zeros(0, dtype=wp.vec3i), wp.zeros((0, nworld), dtype=mat33)
            self.slot = wp.zeros(self._nodes, dtype=int)
            self.node = wp.zeros((capacity, nworld), dtype=int)
            self.size = wp.zeros(nworld, dtype=int)
            self.any_touch = wp.zeros(nworld, dtype=int)
            self.full = wp.zeros(1, dtype=int)
            self._count, self._any = wp.zeros(self._chunks, dtype=int), wp.zeros(self._chunks, dtype=int)
            self._norm = wp.zeros((2, nworld), dtype=float)
            self._largest = wp.zeros(nworld, dtype=float)
            self._along = wp.zeros(self._nodes if self.liquid else (0, nworld), dtype=wp.vec3)
            self._part = wp.zeros((2, *self._chunks), dtype=real)
            self._D, self._W, self._A, self._G = (wp.zeros((nworld, size, size), dtype=float) for _ in range(4))
            self._pivot = wp.zeros((nworld, size), dtype=int)
            self._u, self._q = wp.zeros((nworld, size), dtype=float), wp.zeros((nworld, size), dtype=float)
            columns = (4 if self.liquid else 2) * nworld
            self._sides, self._answers = wp.zeros((rows, columns), dtype=wp.float16), wp.zeros((rows, columns), dtype=float)
            two = 2 * nworld
            # in place of the first half of the larger arrays where these are of the same shape
            self._side = wp.zeros((rows, two), dtype=wp.float16) if self.liquid else self._sides
            self._answer = wp.zeros((rows, two), dtype=float) if self.liquid else self._answers
        self._surfaces = []
        for state in surfaces:
            if state is None:
                self._surfaces.append((none[2], none[0], none[0], none[1], none[3]))
            else:
                s = state.surface
                self._surfaces.append((s.face, s.start, s.slot, state.touching, state.block))

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim, inputs, outputs, device=self.device)

    def update(self, st, part, r, gradient, z_out, part_out):
        """Takes the tangents of contact and liquid; z is the approximate inverse of the new tangent times r.

        Args:
          st: Worlds, of which the active ones are looked at.
          part: (3, nchunk, nworld) squares of r and of the gradient as its first and third.
          r: [nvert, nworld] residual, zero at fixed nodes. gradient: of the liquid's volume [nvert, nworld], or of length zero.
          z_out: [nvert, nworld]. part_out: (2, nchunk, nworld) r . z and gradient . z.
        """
        on, m = st.active, self.capacity
        (outer, core), size = self._surfaces, self.liquid + 3 * self.capacity
        self._launch(find_touched, self._chunks, [self.chunk, self._free, *outer[1:4], *core[1:4], on], [self.slot, self._count, self._any])
        self._launch(survey, self.nworld, [m, part, self._any, st, self._count], [self.size, self.any_touch, self._norm, self.full])
        self._launch(load_sides, self._chunks, [self.chunk, m, self._free, self._count, r, gradient, self._norm, on, self.slot],
                     [self.node, self._sides])  # fmt: skip
        self._inverse.multiply(self._sides, self._answers)
        if self.liquid:
            self._measure(1, self._answers, gradient, st, on)
        self._launch(small_compliance, (self.nworld, m, m),
                     [self._inverse.half, self._inverse.scale, self._free, self.node, self.size, self.liquid, self._along, self._part, st],
                     [self._W])  # fmt: skip
        self._launch(small_stiffness, (self.nworld, m), [self.liquid, *outer, *core, self.slot, self.node, self.size, on], [self._D])
        self._launch(small_system, (self.nworld, size, size), [self.liquid, self.size, self._D, self._W, on], [self._A])
        self._invert(on)
        self._launch(small_answer, (self.nworld, size, size), [self.liquid, self.size, self._D, self._W, on], [self._G])
        self._balance(self._answers, st, on, r, gradient, z_out, part_out)

    def apply(self, st, part, r, gradient, z_out, part_out):
        """z = approximate inverse of the tangent times r in the running worlds; `part` holds the square of r by chunks."""
        on = st.running
        self._launch(measure_norm, self.nworld, [part, on], [self._norm])
        self._launch(load_residual, self._nodes, [self._free, r, self._norm, on], [self._side])
        self._inverse.multiply(self._side, self._answer)
        if self.liquid:
            self._measure(0, self._answer, gradient, st, on)
        self._balance(self._answer, st, on, r, gradient, z_out, part_out)

    def _measure(self, has_along, answer, gradient, st, on):
        self._launch(measure_liquid, self._chunks,
                     [self.chunk, has_along, self._free, gradient, answer, self._norm, self._inverse.scale, st, on],
                     [self._along, self._part])  # fmt: skip

    def _invert(self, on):
        """The inverse of A, in W's place."""
        if self.device.is_cuda:
            from .device_native import invert

            invert(self.liquid, self.size, on, self._A, self._pivot, self._W)
        else:
            self._launch(invert_serial, self.nworld, [self.liquid, self.size, on, self._A, self._pivot], [self._W])

    def _balance(self, answer, st, on, r, gradient, z_out, part_out):
        inverse = self._inverse
        self._launch(small_side, (self.nworld, self.capacity),
                     [self.liquid, self._free, self.node, self.size, answer, self._norm, inverse.scale, self._part, st, on],
                     [self._u, self._largest])  # fmt: skip
        self._launch(small_forces, self._u.shape, [self.liquid, self.size, self._G, self._u, self._norm, st, on], [self._q, self._largest])
        self._launch(load_balance, self._nodes,
                     [self.liquid, self._free, self.slot, r, gradient, self._q, self._norm, self._largest, st, on], [self._side])  # fmt: skip
        inverse.multiply(self._side, self._answer)
        self._launch(read_answer, self._chunks,
                     [self.chunk, self._free, self._answer, self._norm, self._largest, inverse.scale, r, gradient, st, on],
                     [z_out, part_out])  # fmt: skip


class _Inverse:
    """The dense inverse of the rest stiffness in half precision: by torch on CUDA, by numpy on the CPU (where it is for tests)."""

    def __init__(self, model):
        if model.device.is_cuda:
            factor = model.factor
            self.scale, self.padded, self._matrix = factor.scale, factor.padded, factor.inverse
            self.half = wp.from_torch(factor.inverse)
        else:
            inverse = np.linalg.inv(model._stiffness.toarray())
            self.scale, self.padded = float(np.abs(inverse).max()), len(inverse)
            rounded = (inverse / self.scale).astype(np.float16)
            self.half = wp.array(rounded, dtype=wp.float16, device="cpu")
            self._matrix = rounded.astype(np.float32)
        self._on_device = {}

    def multiply(self, side, answer):
        """answer = inverse times side, (padded, columns) half -> single."""
        if isinstance(self._matrix, np.ndarray):
            np.matmul(self._matrix, side.numpy().astype(np.float32), out=answer.numpy())
            return
        import torch

        if side.ptr not in self._on_device:  # views are made once, not while a graph is recorded
            self._on_device[side.ptr] = wp.to_torch(side), wp.to_torch(answer)
        b, x = self._on_device[side.ptr]
        stream = torch.cuda.ExternalStream(side.device.stream.cuda_stream, device=b.device)
        with torch.cuda.stream(stream):
            torch.mm(self._matrix, b, out_dtype=torch.float32, out=x)
