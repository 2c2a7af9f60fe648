"""Hyperelastic laws: energy density, first Piola-Kirchhoff stress, its directional derivative; rotations.

The four laws take the same two Lame-like constants and differ in the energy W(F):

  corotational W = mu |F - R|^2 + lambda/2 tr(R^T F - I)^2            R the rotation of F: polar decomposition
  svk          W = lambda/2 tr(E)^2 + mu tr(E^2)                      E = (F^T F - I)/2, St. Venant-Kirchhoff
  neo_hookean  W = mu/2 (J^(-2/3) tr(F^T F) - 3) + kappa/2 (J - 1)^2  isochoric split: ANSYS, CalculiX
  linear       W = lambda/2 tr(e)^2 + mu e:e                          e = sym(F) - I: small rotations only

None of them prevents total compression or inversion: at a sharp edge, or between a geom and the core, there
would be an equilibrium. Below a fifth of the volume, all but the linear law therefore have a barrier,

  W += mu J0 f(J / J0),   f(t) = (1 - t)^3 / t,   J = det F < J0 = 0.2,

which is zero above with two derivatives, and unbounded below. Newton's method may pass inverted shapes: below
J = 0.02, f and J^(-2/3) continue as parabolas, so that it can return.
"""

import enum
import typing

import warp as wp

from ..types import double, mat33, narrow, real, single, vec3, widen

COMPRESSED = wp.constant(wp.float64(0.2))  # J0
_FLAT = wp.constant(wp.float64(0.02))  # J below which the parabolas continue


class Law(enum.IntEnum):
    """Numbers of the laws in kernels."""

    COROTATIONAL = 0
    SVK = 1
    NEO_HOOKEAN = 2
    LINEAR = 3


LAWS = {law.name.lower(): int(law) for law in Law}


@wp.func
def axial(A: mat33):
    """Twice the axial vector of the skew part of A."""
    return wp.vec3d(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1])


@wp.func
def rotation_by_steps(F: wp.mat33):
    """The rotation with the largest trace of R^T F, by steps (Mueller et al. 2016); F may be inverted or
    flat.

    It uses few registers, since a rare case must not slow down the usual one.
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
    """Rotation of the polar decomposition in single precision, by Newton's iteration if det F > 0.001."""
    if wp.determinant(F) < 1.0e-3:
        return rotation_by_steps(F)
    X = F
    for _ in range(12):
        Y = 0.5 * (X + wp.transpose(wp.inverse(X)))
        change = wp.ddot(Y - X, Y - X)
        X = Y
        if change < 1.0e-8:  # the next error is the square of this one
            break
    return X


@wp.func
def orthogonal(R: mat33):
    """Makes a rotation with rounding errors of single precision orthogonal."""
    return R * (real(1.5) * wp.identity(n=3, dtype=real) - real(0.5) * wp.transpose(R) * R)


@wp.func
def rotation_step(S: mat33):
    """Newton step to the rotation with the largest trace, in the frame of R, of at most 0.3 rad; S = R^T F.

    Single precision suffices, since a small step is accurate to its own digits.
    """
    s = narrow(S)
    H = wp.trace(s) * wp.identity(n=3, dtype=float) - 0.5 * (s + wp.transpose(s))
    turn = single(axial(S))
    if H[0, 0] > 0.0 and H[0, 0] * H[1, 1] > H[0, 1] * H[1, 0] and wp.determinant(H) > 0.0:
        turn = wp.inverse(H) * turn
    else:  # far from the solution, as in `rotation_by_steps`
        turn = turn / (wp.abs(wp.trace(s)) + 1.0e-9)
    return turn * wp.min(1.0, 0.3 / (wp.length(turn) + 1.0e-9))


@wp.func
def polar_upright(F: mat33):
    """Rotation of the polar decomposition to double precision, from the one in single precision and one
    Newton step. It is less accurate if the determinant is small."""
    R = orthogonal(widen(polar_single(narrow(F))))
    S = wp.transpose(R) * F
    # the step is about 1e-7: single precision gives the remaining digits
    s = narrow(S)
    turn = wp.inverse(wp.trace(s) * wp.identity(n=3, dtype=float) - s) * single(axial(S))
    return R + R * wp.skew(double(turn))


@wp.func
def inverse_transposed(F: mat33):
    a = vec3(F[0, 0], F[1, 0], F[2, 0])
    b = vec3(F[0, 1], F[1, 1], F[2, 1])
    c = vec3(F[0, 2], F[1, 2], F[2, 2])
    bc = wp.cross(b, c)
    over = real(1.0) / wp.dot(a, bc)
    return wp.matrix_from_cols(over * bc, over * wp.cross(c, a), over * wp.cross(a, b))


@wp.func
def polar(F: mat33):
    """Rotation of the polar decomposition to double precision for any F, for the CPU."""
    if wp.determinant(F) >= real(1.0e-3):
        X = F
        for _ in range(2):  # always needed: without a test the processor can start the next point meanwhile
            X = real(0.5) * (X + inverse_transposed(X))
        for _ in range(20):
            Y = real(0.5) * (X + inverse_transposed(X))
            change = wp.ddot(Y - X, Y - X)
            X = Y
            if change < real(1.0e-16):  # the next error is the square of this one
                break
        return X
    R = widen(polar_single(narrow(F)))  # `rotation_by_steps` may not have converged
    steps = int(15)  # a variable: unrolled, the loop would double the time to compile
    for _ in range(steps):
        R = orthogonal(R)
        turn = rotation_step(wp.transpose(R) * F)
        R = R + R * wp.skew(double(turn))
    return R


@wp.func
def cofactor(F: typing.Any):
    """dJ / dF of the determinant J, in the precision of F."""
    a = wp.vector(F[0, 0], F[1, 0], F[2, 0])
    b = wp.vector(F[0, 1], F[1, 1], F[2, 1])
    c = wp.vector(F[0, 2], F[1, 2], F[2, 2])
    return wp.matrix_from_cols(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))


@wp.func
def cofactor_change(F: typing.Any, dF: typing.Any):
    """Directional derivative of `cofactor`."""
    a = wp.vector(F[0, 0], F[1, 0], F[2, 0])
    b = wp.vector(F[0, 1], F[1, 1], F[2, 1])
    c = wp.vector(F[0, 2], F[1, 2], F[2, 2])
    da = wp.vector(dF[0, 0], dF[1, 0], dF[2, 0])
    db = wp.vector(dF[0, 1], dF[1, 1], dF[2, 1])
    dc = wp.vector(dF[0, 2], dF[1, 2], dF[2, 2])
    return wp.matrix_from_cols(
        wp.cross(db, c) + wp.cross(b, dc),
        wp.cross(dc, a) + wp.cross(c, da),
        wp.cross(da, b) + wp.cross(a, db),
    )


@wp.func
def isochoric(J: real):
    """J^(-2/3) and its two derivatives."""
    j = wp.max(J, _FLAT)
    over = J - j  # negative on the parabola
    value = wp.pow(j, -real(2.0) / real(3.0))
    slope = -real(2.0) / real(3.0) * value / j
    bend = -real(5.0) / real(3.0) * slope / j
    return vec3(value + (slope + real(0.5) * bend * over) * over, slope + bend * over, bend)


@wp.func
def energy_density(law: int, mu: real, lam: real, F: mat33, R: mat33):
    """W(F) [J/m^3]; for neo_hookean `lam` is the bulk modulus."""
    eye = wp.identity(n=3, dtype=real)
    if law == Law.COROTATIONAL:
        tr = wp.trace(wp.transpose(R) * F) - real(3.0)
        return mu * wp.ddot(F - R, F - R) + real(0.5) * lam * tr * tr
    if law == Law.SVK:
        E = real(0.5) * (wp.transpose(F) * F - eye)
        return real(0.5) * lam * wp.trace(E) * wp.trace(E) + mu * wp.ddot(E, E)
    if law == Law.NEO_HOOKEAN:
        J = wp.determinant(F)
        shear = isochoric(J)[0] * wp.ddot(F, F) - real(3.0)
        return real(0.5) * (mu * shear + lam * (J - real(1.0)) * (J - real(1.0)))
    e = real(0.5) * (F + wp.transpose(F)) - eye
    return real(0.5) * lam * wp.trace(e) * wp.trace(e) + mu * wp.ddot(e, e)


@wp.func
def stress(law: int, mu: real, lam: real, F: mat33, R: mat33):
    """First Piola-Kirchhoff stress P = dW/dF [Pa]."""
    eye = wp.identity(n=3, dtype=real)
    if law == Law.COROTATIONAL:
        return real(2.0) * mu * (F - R) + lam * (wp.trace(wp.transpose(R) * F) - real(3.0)) * R
    if law == Law.SVK:
        E = real(0.5) * (wp.transpose(F) * F - eye)
        return F * (lam * wp.trace(E) * eye + real(2.0) * mu * E)
    if law == Law.NEO_HOOKEAN:
        J = wp.determinant(F)
        a = isochoric(J)
        return mu * a[0] * F + (real(0.5) * mu * a[1] * wp.ddot(F, F) + lam * (J - real(1.0))) * cofactor(F)
    e = real(0.5) * (F + wp.transpose(F)) - eye
    return lam * wp.trace(e) * eye + real(2.0) * mu * e


@wp.func
def stress_derivative(law: int, mu: real, lam: real, F: mat33, R: mat33, dF: mat33):
    """Directional derivative of the stress, dP = (d2W/dF2) : dF [Pa]."""
    eye = wp.identity(n=3, dtype=real)
    if law == Law.COROTATIONAL:
        Rt = wp.transpose(R)
        S = Rt * F
        A = Rt * dF
        trace_s = wp.trace(S)
        w = wp.inverse(trace_s * eye - S) * axial(A)
        dR = R * wp.skew(w)
        return real(2.0) * mu * (dF - dR) + lam * (wp.trace(A) * R + (trace_s - real(3.0)) * dR)
    if law == Law.SVK:
        Ft = wp.transpose(F)
        E = real(0.5) * (Ft * F - eye)
        A = Ft * dF
        dE = real(0.5) * (A + wp.transpose(A))
        return dF * (lam * wp.trace(E) * eye + real(2.0) * mu * E) + F * (
            lam * wp.trace(dE) * eye + real(2.0) * mu * dE
        )
    if law == Law.NEO_HOOKEAN:
        J = wp.determinant(F)
        a = isochoric(J)
        I1 = wp.ddot(F, F)
        G = cofactor(F)
        dJ = wp.ddot(G, dF)
        along_G = mu * (a[1] * wp.ddot(F, dF) + real(0.5) * a[2] * I1 * dJ) + lam * dJ
        along_dG = real(0.5) * mu * a[1] * I1 + lam * (J - real(1.0))
        return mu * (a[0] * dF + a[1] * dJ * F) + along_G * G + along_dG * cofactor_change(F, dF)
    de = real(0.5) * (dF + wp.transpose(dF))
    return lam * wp.trace(de) * eye + real(2.0) * mu * de


@wp.func
def dilatation(law: int, F: mat33, R: mat33):
    """The measure theta of volume change that multiplies `lam` in the energy: W = W(lam = 0) + lam/2
    theta^2."""
    eye = wp.identity(n=3, dtype=real)
    if law == Law.COROTATIONAL:
        return wp.trace(wp.transpose(R) * F) - real(3.0)
    if law == Law.SVK:
        return real(0.5) * (wp.ddot(F, F) - real(3.0))
    if law == Law.NEO_HOOKEAN:
        return wp.determinant(F) - real(1.0)
    return wp.trace(F - eye)


@wp.func
def dilatation_gradient(law: int, F: mat33, R: mat33):
    """d theta / dF."""
    if law == Law.COROTATIONAL:
        return R
    if law == Law.SVK:
        return F
    if law == Law.NEO_HOOKEAN:
        return cofactor(F)
    return wp.identity(n=3, dtype=real)


@wp.func
def dilatation_hessian(law: int, F: mat33, R: mat33, dF: mat33):
    """Directional derivative of `dilatation_gradient`, (d2 theta / dF2) : dF."""
    if law == Law.COROTATIONAL:
        Rt = wp.transpose(R)
        S = Rt * F
        return R * wp.skew(wp.inverse(wp.trace(S) * wp.identity(n=3, dtype=real) - S) * axial(Rt * dF))
    if law == Law.SVK:
        return dF
    if law == Law.NEO_HOOKEAN:
        return cofactor_change(F, dF)
    return mat33()


@wp.func
def barrier(J: typing.Any):
    """f and its two derivatives with t at t = J / J0, in the precision of J."""
    one = type(J)(1.0)
    flat = type(J)(_FLAT)
    limit = type(J)(COMPRESSED)
    t = wp.max(J, flat) / limit
    over = J / limit - t  # as in `isochoric`
    bend = (one + one) / (t * t * t) - (one + one)
    slope = one + one + one - (t + t) - one / (t * t)
    value = one / t - (one + one + one) + ((one + one + one) - t) * t
    return wp.vector(value + (slope + bend * over / (one + one)) * over, slope + bend * over, bend)


@wp.func
def barrier_stress(law: int, mu: real, F: mat33):
    """First Piola stress of the barrier [Pa]."""
    J = wp.determinant(F)
    if law == Law.LINEAR or J >= COMPRESSED:
        return mat33()
    return mu * barrier(J)[1] * cofactor(F)


@wp.func
def barrier_derivative(law: int, mu: typing.Any, F: typing.Any, dF: typing.Any):
    """Directional derivative of the barrier's stress [Pa], in the precision of F."""
    J = wp.determinant(F)
    limit = type(J)(COMPRESSED)
    if law == Law.LINEAR or J >= limit:
        return F - F
    f = barrier(J)
    G = cofactor(F)
    return mu * (f[2] / limit * wp.ddot(G, dF) * G + f[1] * cofactor_change(F, dF))
