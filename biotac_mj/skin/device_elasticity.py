"""Elements as the device step evaluates them: positions in double precision, forces of corners and tangents
in single.

A force keeps the strain's digits, not the position's: deformation gradients come from double-precision edges,
and what is rounded to single precision is the force of one corner, to 6e-8 of itself. Tangents only steer
Newton's method, so they are single throughout.
Nothing is kept between `force` and `product`: reading back costs more than computing the rotation again.
"""

import numpy as np
import warp as wp

from .elasticity import LinearTetrahedra, edge_matrix, incidence
from .material import axial, stress, stress_derivative
from .types import mat33, real, vec3

__all__ = ["Linear", "narrow", "polar_mixed", "polar_single", "widen"]

wp.set_module_options({"enable_backward": False})

_INVERTED = (
    0.02  # det F below which a step of the line search is refused where the law cannot recover from inversion
)


@wp.func
def turn_towards(F: wp.mat33):
    """The rotation with the largest trace of R^T F, turned there step by step (Mueller et al. 2016): F may be
    inverted or flat.

    As `material.polar_rotation`'s SVD, in fewer registers: the rare case must not slow the usual one.
    """
    q = wp.quat_identity(float)
    for _ in range(60):
        R = wp.quat_to_matrix(q)
        turn = wp.vec3()
        along = float(1.0e-9)
        for c in range(3):
            r = wp.vec3(R[0, c], R[1, c], R[2, c])
            f = wp.vec3(F[0, c], F[1, c], F[2, c])
            turn += wp.cross(r, f)
            along += wp.dot(r, f)
        turn = turn / wp.abs(along)
        angle = wp.length(turn)
        if angle < 1.0e-7:
            break
        q = wp.normalize(wp.quat_from_axis_angle(turn / angle, angle) * q)
    return wp.quat_to_matrix(q)


@wp.func
def polar_single(F: wp.mat33):
    """Rotation of the polar decomposition in single precision, by Newton's iteration where that is safe."""
    if wp.determinant(F) < 1.0e-3:
        return turn_towards(F)
    X = F
    for _ in range(12):
        Y = 0.5 * (X + wp.transpose(wp.inverse(X)))
        change = wp.ddot(Y - X, Y - X)
        X = Y
        if change < 1.0e-8:  # the next error is the square of this one
            break
    return X


@wp.func
def widen(A: wp.mat33):
    return mat33(
        real(A[0, 0]), real(A[0, 1]), real(A[0, 2]),
        real(A[1, 0]), real(A[1, 1]), real(A[1, 2]),
        real(A[2, 0]), real(A[2, 1]), real(A[2, 2]),
    )  # fmt: skip


@wp.func
def narrow(A: mat33):
    return wp.mat33(
        float(A[0, 0]), float(A[0, 1]), float(A[0, 2]),
        float(A[1, 0]), float(A[1, 1]), float(A[1, 2]),
        float(A[2, 0]), float(A[2, 1]), float(A[2, 2]),
    )  # fmt: skip


@wp.func
def polar_mixed(F: mat33):
    """The same to double precision: the single-precision rotation, made orthogonal, then turned by what is
    left (error squared)."""
    R = widen(polar_single(narrow(F)))
    eye = wp.identity(n=3, dtype=real)
    R = R * (real(1.5) * eye - real(0.5) * wp.transpose(R) * R)
    S = wp.transpose(R) * F
    # what is left is 1e-7: single precision gives the rest of its digits
    s = narrow(S)
    a = axial(S)
    turn = wp.inverse(wp.trace(s) * wp.identity(n=3, dtype=float) - s) * wp.vec3(
        float(a[0]), float(a[1]), float(a[2])
    )
    return R + R * wp.skew(vec3(real(turn[0]), real(turn[1]), real(turn[2])))


@wp.func
def edges_single(p: wp.array2d(dtype=wp.vec3), t: wp.vec4i, w: int):
    p0 = p[t[0], w]
    return wp.matrix_from_cols(p[t[1], w] - p0, p[t[2], w] - p0, p[t[3], w] - p0)


@wp.func
def write_single(H: wp.mat33, e: int, w: int, corner_out: wp.array2d(dtype=wp.vec3)):
    f1 = wp.vec3(H[0, 0], H[1, 0], H[2, 0])
    f2 = wp.vec3(H[0, 1], H[1, 1], H[2, 1])
    f3 = wp.vec3(H[0, 2], H[1, 2], H[2, 2])
    corner_out[4 * e, w] = -f1 - f2 - f3
    corner_out[4 * e + 1, w] = f1
    corner_out[4 * e + 2, w] = f2
    corner_out[4 * e + 3, w] = f3


# the corotational law has kernels of its own: what other laws need would take registers from it


@wp.kernel
def corotational_force(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array(dtype=wp.vec4i),
    inverse_edges: wp.array(dtype=mat33),
    volume: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    # Out:
    corner_out: wp.array2d(dtype=wp.vec3),
    inverted_out: wp.array(dtype=int),
):
    e, w = wp.tid()
    if on[w] == 0:
        return
    B = inverse_edges[e]
    F = edge_matrix(x, elem[e], w) * B
    R = polar_mixed(F)
    m = mu[w]
    P = (m + m) * (F - R) + (lam[w] * (wp.ddot(R, F) - real(3.0))) * R
    H = -volume[e] * P * wp.transpose(B)
    write_single(narrow(H), e, w, corner_out)


@wp.kernel
def linear_force(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array(dtype=wp.vec4i),
    inverse_edges: wp.array(dtype=mat33),
    volume: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    # Out:
    corner_out: wp.array2d(dtype=wp.vec3),
    inverted_out: wp.array(dtype=int),
):
    e, w = wp.tid()
    if on[w] == 0:
        return
    B = inverse_edges[e]
    F = edge_matrix(x, elem[e], w) * B
    if law == 2:
        if not (wp.determinant(F) > real(_INVERTED)):
            inverted_out[w] = 1
    H = -volume[e] * stress(law, mu[w], lam[w], F, mat33()) * wp.transpose(B)
    write_single(narrow(H), e, w, corner_out)


@wp.kernel
def corotational_product(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array(dtype=wp.vec4i),
    inverse_edges: wp.array(dtype=mat33),
    volume: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    p: wp.array2d(dtype=wp.vec3),
    on: wp.array(dtype=int),
    # Out:
    corner_out: wp.array2d(dtype=wp.vec3),
):
    e, w = wp.tid()
    if on[w] == 0:
        return
    t = elem[e]
    B = narrow(inverse_edges[e])
    F = narrow(edge_matrix(x, t, w)) * B
    dF = edges_single(p, t, w) * B
    m = float(mu[w])
    l = float(lam[w])
    R = polar_single(F)
    Rt = wp.transpose(R)
    S = Rt * F
    A = Rt * dF
    trace_s = wp.trace(S)
    turn = wp.vec3(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1])
    dR = R * wp.skew(wp.inverse(trace_s * wp.identity(n=3, dtype=float) - S) * turn)
    dP = 2.0 * m * (dF - dR) + l * (wp.trace(A) * R + (trace_s - 3.0) * dR)
    write_single(float(volume[e]) * dP * wp.transpose(B), e, w, corner_out)


@wp.kernel
def linear_product(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array(dtype=wp.vec4i),
    inverse_edges: wp.array(dtype=mat33),
    volume: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    p: wp.array2d(dtype=wp.vec3),
    on: wp.array(dtype=int),
    # Out:
    corner_out: wp.array2d(dtype=wp.vec3),
):
    e, w = wp.tid()
    if on[w] == 0:
        return
    t = elem[e]
    B = narrow(inverse_edges[e])
    F = narrow(edge_matrix(x, t, w)) * B
    dF = edges_single(p, t, w) * B
    dP = narrow(stress_derivative(law, mu[w], lam[w], widen(F), mat33(), widen(dF)))
    write_single(float(volume[e]) * dP * wp.transpose(B), e, w, corner_out)


@wp.kernel
def flag_turned_inside_out(
    # In:
    elem: wp.array(dtype=wp.vec4i),
    inverse_edges: wp.array(dtype=mat33),
    x: wp.array2d(dtype=vec3),
    asked: wp.array(dtype=int),
    # Out:
    failed_out: wp.array(dtype=int),
):
    """Marks worlds with a tetrahedron whose determinant is not positive."""
    e, w = wp.tid()
    if asked[w] == 1 and not (wp.determinant(edge_matrix(x, elem[e], w) * inverse_edges[e]) > real(0.0)):
        failed_out[w] = 1


class Linear:
    """Linear tetrahedra in an order in which neighbours in the list are neighbours in space, so that caches
    serve nodes to all of them."""

    def __init__(self, elements: LinearTetrahedra, nworld):
        elem, inverse, volume = elements._elem, elements._inverse_edges, elements._volume
        order = np.argsort(elem.min(1), kind="stable")
        start, slot = incidence(elements.nvert, elem[order])
        self.law, self.device = elements.law, elements.device
        with wp.ScopedDevice(self.device):
            self._mesh = [
                wp.array(elem[order], dtype=wp.vec4i),
                wp.array(inverse[order], dtype=mat33),
                wp.array(volume[order], dtype=real),
            ]
            self.start, self.slot = wp.array(start, dtype=int), wp.array(slot, dtype=int)
            self.corner = self.corner_force = wp.zeros((4 * len(elem), nworld), dtype=wp.vec3)
        self._dim = (len(elem), nworld)

    def force(self, mu, lam, x, on, inverted):
        kernel = corotational_force if self.law == 0 else linear_force
        wp.launch(
            kernel,
            self._dim,
            [self.law, mu, lam, *self._mesh, x, on],
            [self.corner, inverted],
            device=self.device,
        )

    def refuse_inverted(self, x, asked, failed):
        wp.launch(
            flag_turned_inside_out, self._dim, [*self._mesh[:2], x, asked], [failed], device=self.device
        )

    def product(self, mu, lam, x, p, on):
        kernel = corotational_product if self.law == 0 else linear_product
        wp.launch(
            kernel, self._dim, [self.law, mu, lam, *self._mesh, x, p, on], [self.corner], device=self.device
        )
