"""One world alone: the dense inverse times two vectors, each entry of its upper triangle read once, and what
is made of the result.

A product with the inverse costs what reading it costs. One pass gives the answers to the residual and to the
liquid's gradient together; what contact answers needs only rows of the touching nodes. For many worlds
products with the blocks of a dissection are better, see `dissected`."""

import functools
import typing

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..newton.worlds import Worlds
from ..program import Launcher
from ..types import real, single, vec3
from . import small
from .sides import LOW, entry, pull_of_liquid

__all__ = ["DenseInverse", "OneWorld"]

wp.set_module_options({"enable_backward": False})

_TILE = 192  # rows and columns; threads of a block too
_SOUND = 0.1  # of the inverse that rounding leaves at least, in every direction
_PARTS = 8  # threads that share a node's sum over the touching ones

# A block's 192 threads as 8 groups of 24; a thread holds 8 columns and walks over every eighth row. Of the
# tile (I, J) above the diagonal both products are made: with x_J for the rows I, and of the transposed tile
# with x_I for the rows J. Fixed order: no atomics.
_TILE_PRODUCT = """
    const int t = threadIdx.x, c = t % 24, g = t / 24;
    __shared__ float sums[2 * 192 * 25];
    const long long n = A.shape[1];
    const long long start = (192LL * I) * n + 192LL * J + 8 * c;
    const float* v = X.data;
    float x0[8], x1[8], s0[8], s1[8];
    #pragma unroll
    for (int k = 0; k < 8; ++k) {
        x0[k] = v[192 * J + 8 * c + k];
        x1[k] = v[n + 192 * J + 8 * c + k];
        s0[k] = s1[k] = 0.0f;
    }
    const bool two = rest.shape[0] > 0;
    #pragma unroll 8
    for (int r = g; r < 192; r += 8) {
        const uint4 packed = __ldg((const uint4*)((const unsigned short*)A.data + start + r * n));
        const unsigned words[4] = {packed.x, packed.y, packed.z, packed.w};
        float f[8];
        #pragma unroll
        for (int k = 0; k < 8; ++k) {
            const unsigned short bits = (unsigned short)(k & 1 ? words[k / 2] >> 16 : words[k / 2] & 0xffffu);
            asm("cvt.f32.f16 %0, %1;" : "=f"(f[k]) : "h"(bits));
        }
        if (two) {
            const uint4 low = __ldg((const uint4*)((const unsigned short*)rest.data + start + r * n));
            const unsigned lows[4] = {low.x, low.y, low.z, low.w};
            #pragma unroll
            for (int k = 0; k < 8; ++k) {
                const unsigned both = lows[k / 2];
                const unsigned short bits = (unsigned short)(k & 1 ? both >> 16 : both & 0xffffu);
                float value;
                asm("cvt.f32.f16 %0, %1;" : "=f"(value) : "h"(bits));
                f[k] += value * (1.0f / 2048.0f);
            }
        }
        const float y0 = v[192 * I + r], y1 = v[n + 192 * I + r];
        float d0 = 0.0f, d1 = 0.0f;
        #pragma unroll
        for (int k = 0; k < 8; ++k) {
            d0 += f[k] * x0[k];
            d1 += f[k] * x1[k];
            s0[k] += f[k] * y0;
            s1[k] += f[k] * y1;
        }
        sums[r * 25 + c] = d0;
        sums[192 * 25 + r * 25 + c] = d1;
    }
    __syncthreads();
    const long long blocks = P.shape[1];
    float p0 = 0.0f, p1 = 0.0f;
    for (int k = 0; k < 24; ++k) {
        p0 += sums[t * 25 + k];
        p1 += sums[192 * 25 + t * 25 + k];
    }
    P.data[J * n + 192 * I + t] = p0;
    P.data[(blocks + J) * n + 192 * I + t] = p1;
    if (I != J) {
        __syncthreads();
        #pragma unroll
        for (int k = 0; k < 8; ++k) {
            sums[g * 192 + 8 * c + k] = s0[k];
            sums[(8 + g) * 192 + 8 * c + k] = s1[k];
        }
        __syncthreads();
        p0 = p1 = 0.0f;
        for (int k = 0; k < 8; ++k) {
            p0 += sums[k * 192 + t];
            p1 += sums[(8 + k) * 192 + t];
        }
        P.data[I * n + 192 * J + t] = p0;
        P.data[(blocks + I) * n + 192 * J + t] = p1;
    }
    __syncthreads();
"""


@functools.cache
def _kernel():
    @wp.func_native(_TILE_PRODUCT)
    def multiply_tile(
        I: int,
        J: int,
        A: wp.array2d(dtype=wp.float16),
        rest: wp.array2d(dtype=wp.float16),
        X: wp.array2d(dtype=float),
        P: wp.array3d(dtype=float),
    ): ...

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=_TILE)
    def multiply_tiles(
        row: wp.array(dtype=int),
        column: wp.array(dtype=int),
        A: wp.array2d(dtype=wp.float16),
        rest: wp.array2d(dtype=wp.float16),
        X: wp.array2d(dtype=float),
        P: wp.array3d(dtype=float),
    ):
        b, _t = wp.tid()
        multiply_tile(row[b], column[b], A, rest, X, P)

    return multiply_tiles


@wp.kernel
def sum_tiles(part: wp.array3d(dtype=float), y_out: wp.array2d(dtype=float)):
    k, i = wp.tid()
    total = float(0.0)
    for c in range(part.shape[1]):
        total += part[k, c, i]
    y_out[k, i] = total


class DenseInverse:
    """The dense inverse of a stiffness as a half-precision matrix; sums are in single precision.

    Rounding the matrix (4e-4) makes a slightly different but still symmetric preconditioner, which costs
    nothing as long as everything is computed from the same rounded entries. Nearly incompressible rubber
    gives way to changes of volume lambda / mu times less than to others: rounded to half precision the
    inverse no longer knows how much less. Of a skin that hangs from little it is not even positive: what it
    gives way as a whole is far more than what single nodes do. A second matrix then
    has what rounding took. Made by torch on CUDA, by numpy on the CPU.

    Args:
      stiffness: scipy sparse matrix, positive definite. device: Warp device.
      two: there is a second matrix; False: where the rounded one alone is not (soundly) positive definite.

    Attributes:
      half, rest: Warp arrays (padded, padded) of the inverse over `scale`, and of what rounding took times
        `sides.LOW`, empty where that is not kept.
    """

    def __init__(self, stiffness: sp.csc_matrix, device: wp.Device, two: bool):
        if device.is_cuda:
            import torch

            made = torch.tensor(stiffness.toarray(), device=wp.device_to_torch(device))
            made = torch.cholesky_inverse(torch.linalg.cholesky(made))
            size, self.scale = len(made), float(made.abs().max())
            self.padded = -(-size // _TILE) * _TILE
            inside = (slice(size), slice(size))
            half = made.new_zeros((self.padded, self.padded), dtype=torch.float16)
            half[inside] = made / self.scale
            rest = half[:0]
            if not two:
                kept = half[inside] - (_SOUND / self.scale) * made
                two = bool(torch.linalg.cholesky_ex(kept).info)
                del kept
            if two:
                rest = torch.zeros_like(half)
                rest[inside] = (made / self.scale - half[inside]) * LOW
            self._kept = half, rest  # whose memory the arrays share
            self.half, self.rest = wp.from_torch(half), wp.from_torch(rest)
        else:
            inverse = np.linalg.inv(stiffness.toarray())
            self.scale, self.padded = float(np.abs(inverse).max()), len(inverse)
            inverse /= self.scale
            half = inverse.astype(np.float16)
            if not two:
                try:
                    np.linalg.cholesky(half - _SOUND * inverse)
                except np.linalg.LinAlgError:
                    two = True
            rest = ((inverse - half) * LOW).astype(np.float16)[: None if two else 0]
            self.half, self.rest = (wp.array(a, dtype=wp.float16, ndim=2, device="cpu") for a in (half, rest))


class OneWorld:
    """What the preconditioner asks of the inverse, for one world.

    Args:
      model: the SkinModel. capacity: touching nodes at most. chunk: nodes summed by one thread.
      launch: of a kernel, as `DensePreconditioner` does it.
    """

    def __init__(self, model: typing.Any, capacity: int, chunk: int, launch: typing.Callable):
        self.inverse, self.device = model.dense_inverse, model.device
        n, rows = model.nvert, self.inverse.padded
        self._chunk, self._launch, self._capacity = chunk, launch, capacity
        self._liquid, self._nodes, self._chunks = int(model.has_liquid), n, -(-n // chunk)
        index = np.full(n, -1, np.int32)
        index[model.free] = np.arange(len(model.free))
        with wp.ScopedDevice(self.device):
            self._index = wp.array(index, dtype=int)
            self.along = wp.zeros((n if self._liquid else 0, 1), dtype=wp.vec3)
            self._part = wp.zeros((2, self._chunks, 1), dtype=real)
            self._pair, self._answer = (wp.zeros((2, rows), dtype=float) for _ in range(2))
            self._corrections = wp.zeros((_PARTS, n), dtype=wp.vec3)
            if self.device.is_cuda:
                blocks = rows // _TILE
                self._tiles = [wp.array(t, dtype=int) for t in np.triu_indices(blocks)]
                self._sums = wp.zeros((2, blocks, rows), dtype=float)
        if not self.device.is_cuda:
            self._matrix = self.inverse.half.numpy().astype(np.float32)
            if len(self.inverse.rest):
                self._matrix += self.inverse.rest.numpy() / np.float32(LOW)

    def meet(
        self,
        program: Launcher,
        first: bool,
        st: Worlds,
        on: wp.array,
        r: wp.array,
        gradient: wp.array,
        norm: wp.array,
        touch: tuple,
        W_out: wp.array,
        u_out: wp.array,
        largest_out: wp.array,
    ) -> None:
        """See `many_worlds.ManyWorlds`: a single pass over the inverse."""
        self._launch(program, load_pair, self._nodes, [self._index, r, gradient, on], [self._pair])
        self._multiply(program)
        given = [int(first), self._chunk, self._liquid, self._index, *touch, r, gradient, self._answer]
        self._launch(
            program,
            read_pair,
            max(self._chunks, 3 * self._capacity),
            [*given, self.inverse.scale, st, on, self.along],
            [u_out, largest_out, self._part],
        )
        if self._liquid:
            program.launch_blocks(small.sum_liquid, [1], [self._part, on, int(first)], [W_out, u_out])

    def balance(
        self,
        program: Launcher,
        st: Worlds,
        on: wp.array,
        r: wp.array,
        gradient: wp.array,
        norm: wp.array,
        touch: tuple,
        slot: wp.array,
        q: wp.array,
        largest: wp.array,
        z_out: wp.array,
        part_out: wp.array,
    ) -> None:
        """See `many_worlds.ManyWorlds`: by rows of the touching nodes."""
        inverse, index = self.inverse, self._index
        rows = [self._liquid, inverse.half, inverse.rest, index, *touch, q, on]
        self._launch(program, correct, (_PARTS, self._nodes), rows, [self._corrections])
        given = [self._chunk, self._liquid, index, self._answer, self._corrections, self.along, q]
        self._launch(
            program,
            read_corrected,
            self._chunks,
            [*given, inverse.scale, r, gradient, st, on],
            [z_out, part_out],
        )

    def _multiply(self, program):
        x, y = self._pair, self._answer
        if not self.device.is_cuda:
            a, b = x.numpy(), y.numpy()
            program.call(lambda: np.matmul(a, self._matrix, out=b))  # the matrix is symmetric
            return
        inputs = [*self._tiles, self.inverse.half, self.inverse.rest, x]
        program.launch(_kernel(), (len(self._tiles[0]), _TILE), inputs, [self._sums], _TILE)
        program.launch(sum_tiles, y.shape, [self._sums], [y], 128)


@wp.kernel
def load_pair(
    free_index: wp.array(dtype=int),
    r: wp.array2d(dtype=wp.vec3),
    gradient: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    x_out: wp.array2d(dtype=float),
):
    i = wp.tid()
    j = free_index[i]
    if on[0] == 0 or j < 0:
        return
    for a in range(3):
        x_out[0, 3 * j + a] = r[i, 0][a]
        if gradient.shape[0] > 0:
            x_out[1, 3 * j + a] = float(gradient[i, 0][a])


@wp.kernel
def read_pair(
    # In:
    first: int,
    chunk: int,
    has_liquid: int,
    free_index: wp.array(dtype=int),
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    r: wp.array2d(dtype=wp.vec3),
    gradient: wp.array2d(dtype=vec3),
    answer: wp.array2d(dtype=float),
    scale: float,
    st: Worlds,
    on: wp.array(dtype=int),
    # In and out:
    along: wp.array2d(dtype=wp.vec3),
    # Out:
    u_out: wp.array2d(dtype=float),
    largest_out: wp.array(dtype=float),
    part_out: wp.array3d(dtype=real),
):
    """What the residual does at the touching nodes and to the liquid's volume; at first, what the liquid's
    direction does everywhere."""
    c = wp.tid()
    if on[0] == 0:
        return
    back = scale * float(st.softness[0])
    if c == 0:
        largest_out[0] = 0.0
    if c < 3 * size[0]:
        u_out[0, has_liquid + c] = back * answer[0, 3 * free_index[node[c // 3, 0]] + c % 3]
    if has_liquid == 0 or c >= part_out.shape[1]:
        return
    pull = pull_of_liquid(st, 0)
    gy = real(0.0)
    gg = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, free_index.shape[0])):
        j = free_index[i]
        if first == 1:
            v = wp.vec3()
            if j >= 0:
                v = (pull * back) * wp.vec3(answer[1, 3 * j], answer[1, 3 * j + 1], answer[1, 3 * j + 2])
                gg += real(wp.dot(pull * single(gradient[i, 0]), v))
            along[i, 0] = v
        gy += real(wp.dot(r[i, 0], along[i, 0]))
    part_out[0, c, 0] = gy
    part_out[1, c, 0] = gg


@wp.kernel
def correct(
    # In:
    has_liquid: int,
    inverse: wp.array2d(dtype=wp.float16),
    rest: wp.array2d(dtype=wp.float16),
    free_index: wp.array(dtype=int),
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    q: wp.array2d(dtype=float),
    on: wp.array(dtype=int),
    # Out:
    part_out: wp.array2d(dtype=wp.vec3),
):
    """What the answers of contact do everywhere, a share of the touching nodes each."""
    k, i = wp.tid()
    j = free_index[i]
    if on[0] == 0 or j < 0:
        return
    total = wp.vec3()
    for s in range(k, size[0], part_out.shape[0]):
        row = 3 * free_index[node[s, 0]]
        for b in range(3):
            v = wp.vec3(
                entry(inverse, rest, row + b, 3 * j),
                entry(inverse, rest, row + b, 3 * j + 1),
                entry(inverse, rest, row + b, 3 * j + 2),
            )
            total += q[0, has_liquid + 3 * s + b] * v
    part_out[k, i] = total


@wp.kernel
def read_corrected(
    # In:
    chunk: int,
    has_liquid: int,
    free_index: wp.array(dtype=int),
    answer: wp.array2d(dtype=float),
    part: wp.array2d(dtype=wp.vec3),
    along: wp.array2d(dtype=wp.vec3),
    q: wp.array2d(dtype=float),
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
    c = wp.tid()
    if on[0] == 0:
        return
    back = scale * float(st.softness[0])
    rz = real(0.0)
    gz = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, free_index.shape[0])):
        z = wp.vec3()
        j = free_index[i]
        if j >= 0:
            z = wp.vec3(answer[0, 3 * j], answer[0, 3 * j + 1], answer[0, 3 * j + 2])
            for k in range(part.shape[0]):
                z -= part[k, i]
            z *= back
            if has_liquid == 1:
                z -= q[0, 0] * along[i, 0]
            rz += real(wp.dot(r[i, 0], z))
            if gradient.shape[0] > 0:
                gz += real(wp.dot(single(gradient[i, 0]), z))
        z_out[i, 0] = z
    part_out[0, c, 0] = rz
    part_out[1, c, 0] = gz
