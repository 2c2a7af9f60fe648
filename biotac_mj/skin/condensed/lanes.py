"""The compliance between candidates and the rows of a system, by one thread with a processor's vectors, or by
the threads of a block."""

import warp as wp


# By one thread the compliance between the candidates is kept, contiguous: B has rows of length m, one for
# each candidate's coordinate, which are gathered when they are first used, and P what they have in the
# columns of a matrix. So a processor's vectors do many columns at a time.
@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    const int* __restrict at = listed.data + (long long)world * listed.shape[1];
    int* __restrict old = last.data + (long long)world * last.shape[1];
    int* __restrict there = ready.data + (long long)world * ready.shape[1];
    bool same = old[0] == n;
    for (int j = 0; j < n && same; ++j) same = old[1 + j] == at[j];
    if (same) return;
    old[0] = n;
    for (int j = 0; j < n; ++j) old[1 + j] = at[j];
    for (int i = 0; i < m; ++i) there[i] = there[i] < most ? there[i] : most;
#endif
""")
def keep_rows(
    world: int,
    n: int,
    listed: wp.array2d(dtype=int),
    last: wp.array2d(dtype=int),
    m: int,
    most: int,
    ready: wp.array2d(dtype=int),
):
    """Leaves the first m of `ready` at `most` at most, unless the first n listed are the last ones: of other
    candidates nothing is known (0), of other columns the rows of B (1)."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    const int* __restrict at = coordinate.data + (long long)world * coordinate.shape[1];
    const int* __restrict take = place.data + (long long)world * place.shape[1];
    int* __restrict there = ready.data + (long long)world * ready.shape[1];
    for (int i = row; i < row + count; ++i) {
        float* __restrict b = B.data + (long long)world * B.shape[1] + (long long)i * m;
        const float* __restrict c = C.data + at[i] * (long long)C.shape[1];
        if (there[i] == 0) {
            there[i] = 1;
            for (int j = 0; j < m; ++j) b[j] = c[at[j]];
        }
        if (n == 0 || there[i] == 2) continue;
        there[i] = 2;
        float* __restrict p = P.data + (long long)world * P.shape[1] + (long long)i * n;
        for (int j = 0; j < n; ++j) p[j] = b[take[j]];
    }
#endif
""")
def gather_rows(
    C: wp.array2d(dtype=float),
    world: int,
    m: int,
    coordinate: wp.array2d(dtype=int),
    row: int,
    count: int,
    ready: wp.array2d(dtype=int),
    B: wp.array2d(dtype=float),
    n: int,
    place: wp.array2d(dtype=int),
    P: wp.array2d(dtype=float),
):
    """Makes `count` rows of B from `row` on the entries of C at the candidates' coordinates, and those of P
    what these have at n listed places, unless n is 0 or `ready` 2."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    float* __restrict a = A.data + (long long)world * A.shape[1] + (long long)row * wide;
    const float* __restrict b = push.data + (long long)world * push.shape[1];
    for (int j = 0; j < n; ++j) a[j] = -held * b[j];
    a[row] += 1.0f;
#endif
""")
def begin_row(
    A: wp.array2d(dtype=float),
    world: int,
    n: int,
    wide: int,
    row: int,
    held: float,
    push: wp.array2d(dtype=float),
):
    """Makes n entries of a row of A, whose length is `wide`, those of the identity less held times
    push[world]."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    float* __restrict a = A.data + (long long)world * A.shape[1] + (long long)row * wide;
    float *__restrict b = a + wide, *__restrict d = b + wide;
    const float* __restrict c = P.data + (long long)world * P.shape[1] + (long long)at * n;
    const float x0 = x.data[0][0], x1 = x.data[0][1], x2 = x.data[0][2];
    const float y0 = x.data[1][0], y1 = x.data[1][1], y2 = x.data[1][2];
    const float z0 = x.data[2][0], z1 = x.data[2][1], z2 = x.data[2][2];
    for (int j = 0; j < n; ++j) {
        const float u = c[j], v = c[n + j], w = c[2 * n + j];
        a[j] += x0 * u + x1 * v + x2 * w;
        b[j] += y0 * u + y1 * v + y2 * w;
        d[j] += z0 * u + z1 * v + z2 * w;
    }
#endif
""")
def add_rows(
    A: wp.array2d(dtype=float),
    world: int,
    n: int,
    wide: int,
    row: int,
    x: wp.mat33,
    P: wp.array2d(dtype=float),
    at: int,
):
    """Adds x times three rows of P to three rows of A, whose length is `wide`, in n columns."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    float* __restrict a = A.data + (long long)world * A.shape[1] + (long long)row * wide;
    const float* __restrict c = P.data + (long long)world * P.shape[1] + (long long)at * n;
    for (int j = 0; j < n; ++j) a[j] += x * c[j];
#endif
""")
def add_row(
    A: wp.array2d(dtype=float),
    world: int,
    n: int,
    wide: int,
    row: int,
    x: float,
    P: wp.array2d(dtype=float),
    at: int,
):
    """Adds x times a row of P to a row of A in n columns."""
    ...


# By one thread the sums of `dot_column` or `dot_columns` of many columns at once, in the same order: 4096 of
# them after the other, which stay near, of rows that are read in long pieces.
_SUMS = """
#if !defined(__CUDA_ARCH__)
    const int* __restrict at = listed.data + (long long)world * listed.shape[1];
    const float* __restrict f = factor.data + (long long)world * factor.shape[1];
    for (int first = 0; first < n; first += 4096) {{
        const int most = n - first < 4096 ? n - first : 4096;
        float* __restrict total = sum.data + (long long)world * sum.shape[1] + first;
        const {kind} *__restrict c0, *__restrict c1, *__restrict c2, *__restrict c3;
        for (int j = 0; j < most; ++j) total[j] = 0.0f;
        int a = 0;
        for (; a + 4 <= count; a += 4) {{
            c0 = {row0}, c1 = {row1}, c2 = {row2}, c3 = {row3};
            const float f0 = {scale0}, f1 = {scale1}, f2 = {scale2}, f3 = {scale3};
            for (int j = 0; j < most; ++j) {{
                const float p = {entry0} * f0;
                const float q = {entry1} * f1;
                const float r = {entry2} * f2;
                const float s = {entry3} * f3;
                const float pq = p + q;
                const float pqr = pq + r;
                const float pqrs = pqr + s;
                total[j] += pqrs;
            }}
        }}
        for (; a < count; ++a) {{
            c0 = {row0};
            const float f0 = {scale0};
            for (int j = 0; j < most; ++j) {{
                const float p = {entry0} * f0;
                total[j] += p;
            }}
        }}
    }}
#endif
"""


def _sums(kind, row, scale, entry):
    names = {f"row{k}": row.format(k=f"at[a + {k}]") for k in range(4)}
    names |= {f"scale{k}": scale.format(k=f"a + {k}") for k in range(4)}
    names |= {f"entry{k}": entry.format(c=f"c{k}[j]") for k in range(4)}
    return _SUMS.format(kind=kind, **names)


@wp.func_native(
    _sums("float", "B.data + (long long)world * B.shape[1] + (long long){k} * n + first", "f[{k}]", "{c}")
)
def sum_rows(
    B: wp.array2d(dtype=float),
    world: int,
    n: int,
    count: int,
    listed: wp.array2d(dtype=int),
    factor: wp.array2d(dtype=float),
    sum: wp.array2d(dtype=float),
):
    """Makes the first n of sum[world] the sums over listed rows of B of `gather_rows`, whose length is n."""
    ...


@wp.func_native(
    _sums(
        "wp::half",
        "C.data + {k} * (long long)C.shape[1] + first",
        "f[{k}] * largest.data[at[{k}]]",
        "wp::half_to_float({c})",
    )
)
def sum_rows(  # noqa: F811
    C: wp.array2d(dtype=wp.float16),
    largest: wp.array(dtype=float),
    world: int,
    n: int,
    count: int,
    listed: wp.array2d(dtype=int),
    factor: wp.array2d(dtype=float),
    sum: wp.array2d(dtype=float),
):
    """Makes the first n of sum[world] `dot_columns` of the first n columns."""
    ...


# Sums over listed rows load sixteen rows at once, since a load takes long. The order of the sum is the same
# everywhere.
_DOT = """
    const int* at = listed.data + (long long)world * listed.shape[1];
    const float* f = factor.data + (long long)world * factor.shape[1];
    const int whole = count - count % 4;
    #pragma unroll 4
    for (int a = 0; a < whole; a += 4) {{
{four}
    }}
    for (int a = whole; a < count; ++a) {{
{one}
    }}
"""


@wp.func_native(
    """
    const float* c = C.data + column;
    const long long wide = C.shape[1];
    float total = 0.0f;
"""
    + _DOT.format(
        four="""
        const float p = c[at[a] * wide] * f[a];
        const float q = c[at[a + 1] * wide] * f[a + 1];
        const float r = c[at[a + 2] * wide] * f[a + 2];
        const float s = c[at[a + 3] * wide] * f[a + 3];
        const float pq = p + q;
        const float pqr = pq + r;
        const float pqrs = pqr + s;
        total += pqrs;""",
        one="""
        const float p = c[at[a] * wide] * f[a];
        total += p;""",
    )
    + "    return total;"
)
def dot_column(
    C: wp.array2d(dtype=float),
    column: int,
    world: int,
    count: int,
    listed: wp.array2d(dtype=int),
    factor: wp.array2d(dtype=float),
) -> float:
    """Sum over the first `count` rows listed[world] of their factors times their entries in a column."""
    ...


@wp.func_native(
    """
    const long long wide = C.shape[1];
    float x = 0.0f, y = 0.0f, z = 0.0f;
"""
    + _DOT.format(
        four="""
        float v[4][3];
        for (int b = 0; b < 4; ++b) {
            const int k = at[a + b];
            const float scale = f[a + b] * largest.data[k];
            const wp::half* c = C.data + k * wide + column;
            for (int i = 0; i < 3; ++i) v[b][i] = scale * wp::half_to_float(c[i]);
        }
        for (int i = 0; i < 3; ++i)
            for (int b = 1; b < 4; ++b) v[0][i] += v[b][i];
        x += v[0][0];
        y += v[0][1];
        z += v[0][2];""",
        one="""
        const int k = at[a];
        const float scale = f[a] * largest.data[k];
        const wp::half* c = C.data + k * wide + column;
        const float u = scale * wp::half_to_float(c[0]);
        const float v = scale * wp::half_to_float(c[1]);
        const float w = scale * wp::half_to_float(c[2]);
        x += u;
        y += v;
        z += w;""",
    )
    + "    return wp::vec_t<3, float>(x, y, z);"
)
def dot_columns(
    C: wp.array2d(dtype=wp.float16),
    largest: wp.array(dtype=float),
    column: int,
    world: int,
    count: int,
    listed: wp.array2d(dtype=int),
    factor: wp.array2d(dtype=float),
) -> wp.vec3:
    """The same of three columns next to each other, each row's entries times what is `largest` in it."""
    ...
