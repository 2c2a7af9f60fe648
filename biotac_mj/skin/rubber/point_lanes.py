"""Functions for the integration points of an element on CUDA, which are four lanes of a warp: deformation
gradients, and exchange between the lanes."""

import warp as wp

from ..types import mat33, real, vec3

__all__ = [
    "GROUPED_WORLDS",
    "THREADS",
    "any_lane",
    "deformation_of_ten",
    "deformation_of_ten_single",
    "gradient_of_ten",
    "place",
    "corner_forces",
    "corner_forces_single",
    "sum_of_points",
    "sum_of_points_single",
]

GROUPED_WORLDS = 8  # worlds whose threads are neighbours, so that they read neighbouring numbers
# threads of a block on CUDA. The kernels prescribe the blocks of a multiprocessor, which limits registers but
# hides the latency of reads
THREADS = 128

# The threads of an element's points are `group` lanes apart. All lanes of a warp take part in an exchange,
# also those of skipped worlds, since a mask of the active lanes would have to be computed at every exchange.
_BASE = """
    const int lane = threadIdx.x & 31;
    const int base = lane - ((lane / group) & 3) * group;
"""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, on);
#else
    return on;
#endif
""")
def any_lane(on: int) -> int: ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    {_BASE}
    double total = 0.0;
    for (int k = 0; k < 4; ++k) total += __shfl_sync(0xffffffffu, value, base + k * group);
    return total;
#else
    return value;
#endif
""")
def sum_of_points(value: real, group: int) -> real: ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    {_BASE}
    float total = 0.0f;
    for (int k = 0; k < 4; ++k) total += __shfl_sync(0xffffffffu, value, base + k * group);
    return total;
#else
    return value;
#endif
""")
def sum_of_points_single(value: float, group: int) -> float: ...


# Pointers instead of Warp's indices, whose arithmetic would be two fifths of these kernels; arrays are
# contiguous.
_DEFORMATION = """
    const int* node = elem.data + 12 * e;
    const char* at = (const char*)(x.data + w);
    const unsigned row = x.shape[1] * sizeof(x.data[0]);
    const WIDE* first = (const WIDE*)(at + (unsigned long long)(unsigned)node[0] * row);
    const SCALAR* g = (const SCALAR*)(shape.data + 10 * q);
    const wp::mat_t<3, 3, SCALAR> B = inverse.data[4 * e + q];
    wp::mat_t<3, 3, SCALAR> F;
    #pragma unroll
    for (int a = 1; a < 10; ++a) {
        const WIDE* p = (const WIDE*)(at + (unsigned long long)(unsigned)node[a] * row);
        for (int i = 0; i < 3; ++i) {
            const SCALAR d = SCALAR(p[i] - first[i]);
            for (int j = 0; j < 3; ++j) F.data[i][j] += d * g[3 * a + j];
        }
    }
    return wp::mul(F, B);
"""
_CORNERS = f"""
#if defined(__CUDA_ARCH__)
    {_BASE}
    const int third = q + 8 < 9 ? q + 8 : 9;
    const SCALAR* g = (const SCALAR*)shape.data;
    wp::mat_t<3, 3, SCALAR> C;
    #pragma unroll
    for (int k = 0; k < 4; ++k) {{
        const SCALAR* of[3] = {{g + 3 * (10 * k + q), g + 3 * (10 * k + q + 4), g + 3 * (10 * k + third)}};
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {{
                const SCALAR h = __shfl_sync(0xffffffffu, H.data[i][j], base + k * group);
                for (int c = 0; c < 3; ++c) C.data[c][i] += h * of[c][j];
            }}
    }}
    return C;
#else
    return H;
#endif
"""


def _typed(snippet, wide, scalar):
    """The snippet with the C++ types of inputs and results."""
    for name, type in (("WIDE", wide), ("SCALAR(", f"static_cast<{scalar}>("), ("SCALAR", scalar)):
        snippet = snippet.replace(name, type)
    return snippet


@wp.func_native(_typed(_DEFORMATION, "double", "double"))
def deformation_of_ten(
    elem: wp.array2d(dtype=int),
    shape: wp.array2d(dtype=vec3),
    inverse: wp.array2d(dtype=mat33),
    e: int,
    q: int,
    x: wp.array2d(dtype=vec3),
    w: int,
) -> mat33: ...


@wp.func_native(_typed(_DEFORMATION, "double", "float"))
def deformation_of_ten_single(
    elem: wp.array2d(dtype=int),
    shape: wp.array2d(dtype=wp.vec3),
    inverse: wp.array2d(dtype=wp.mat33),
    e: int,
    q: int,
    x: wp.array2d(dtype=vec3),
    w: int,
) -> wp.mat33: ...


@wp.func_native(_typed(_DEFORMATION, "float", "float"))
def gradient_of_ten(
    elem: wp.array2d(dtype=int),
    shape: wp.array2d(dtype=wp.vec3),
    inverse: wp.array2d(dtype=wp.mat33),
    e: int,
    q: int,
    x: wp.array2d(dtype=wp.vec3),
    w: int,
) -> wp.mat33: ...


# Rows: forces on the nodes q, q + 4 and q + 8 (at most 9) by the stresses H of all points.
@wp.func_native(_typed(_CORNERS, "double", "double"))
def corner_forces(H: mat33, shape: wp.array2d(dtype=vec3), q: int, group: int) -> mat33: ...


@wp.func_native(_typed(_CORNERS, "float", "float"))
def corner_forces_single(H: wp.mat33, shape: wp.array2d(dtype=wp.vec3), q: int, group: int) -> wp.mat33: ...


@wp.func_native(f"""
    // a group has {GROUPED_WORLDS} worlds or one: shifts, and one division
    const unsigned bits = group == 1 ? 0 : {GROUPED_WORLDS.bit_length() - 1}, i = t;
    const unsigned rest = i >> bits >> 2, blocks = (nworld + group - 1) >> bits, e = rest / blocks;
    return wp::vec_t<3, int>(e, i >> bits & 3, (rest - e * blocks << bits) + (i & group - 1));
""")
def place(t: int, group: int, nworld: int) -> wp.vec3i:
    """Element, point and world of a thread."""
