"""Forces of the elements' corners, their tangent times a direction, and stress.

Positions and forces are in double precision: a filled skin under light contact balances forces far larger
than its load, and their rounding errors would show. Tangents have the precision of directions. In double
precision, deformation gradients and rotations are stored from force to product; in single, on CUDA, it is
faster to compute them again than to read them. A thread has an element, or, for few worlds on CUDA, one of
its integration points: `lanes` threads share an element, and all write the same."""

import functools
import types

import warp as wp

from ...kernels import kernel_module
from ..block import lane_sum
from ..types import DOUBLE, Precision, mat33, real, vec3
from .element_points import Kind, material_functions
from .points import Mesh, Rubber, deformation_of


@functools.cache
def element_kernels(
    corners: int, corotational: bool, precision: Precision, extended: bool
) -> types.SimpleNamespace:
    """Kernels of one kind of element, law and rubber. The corotational law has kernels of its own, since the
    other laws need more registers."""
    kind = Kind(corners, corotational, precision, extended)
    found = {"force": _force_kernel(kind), "product": _product_kernel(kind), **_reading_kernels(kind)}
    return types.SimpleNamespace(gradients=kind.gradients, **found)


def _force_kernel(kind: Kind) -> wp.Kernel:
    """Forces of the elements."""
    corners, averaged, is_single = kind.corners, kind.averaged, kind.is_single
    corotational, gradients = kind.corotational, kind.gradients(DOUBLE)
    positions = wp.types.matrix(shape=(3, corners), dtype=real)
    f, sum_forces = material_functions(kind), lane_sum(positions, real)

    @wp.kernel(**kind.placement)
    def force(
        # In:
        lanes: int,
        cap: real,
        rubber: Rubber,
        mesh: Mesh,
        shape: wp.array(dtype=gradients),
        x: wp.array2d(dtype=vec3),
        on: wp.array(dtype=int),
        # Out:
        pressure_out: wp.array2d(dtype=real),
        deformation_out: wp.array2d(dtype=mat33),
        rotation_out: wp.array2d(dtype=mat33),
        corner_out: wp.array2d(dtype=vec3),
        inverted_out: wp.array(dtype=int),
    ):
        e, w, lane = wp.tid()
        if on[w] == 0:
            return
        X = positions()
        for a in range(wp.static(corners)):
            v = x[mesh.elem[a, e], w]
            for c in range(3):
                X[c, a] = v[c]
        mu = rubber.mu[w]
        lam = rubber.lam[w]
        local = f.local_lame(mu, lam, cap)
        npoint = wp.static(kind.npoint)
        if wp.static(is_single):  # no constant: unrolled, a loop would need more registers than there are
            npoint = mesh.weight.shape[1]
        else:
            lane = 0
            lanes = 1
        pressure = real(0.0)
        if wp.static(averaged):
            if lam > local:
                pressure = f.averaged_pressure(lam - local, rubber.law, mesh, x, e, w, lane, lanes)
                pressure_out[e, w] = pressure
        C = positions()
        for q in range(lane, npoint, lanes):
            i = npoint * e + q
            F = X * shape[q] * mesh.inverse[e, q]
            bad = f.flaw(rubber, F)
            if bad > 0:
                wp.atomic_max(inverted_out, w, bad)
            R = f.rotation(F)
            if wp.static(not is_single):
                deformation_out[i, w] = F
                if wp.static(corotational):
                    rotation_out[i, w] = R
            P = f.stress_of(rubber, e, i, w, mu, local, pressure, F, R)
            C -= (
                f.weighted_volume(rubber, mesh, e, q, w) * P * wp.transpose(mesh.inverse[e, q])
            ) * wp.transpose(shape[q])
        C = sum_forces(C, lanes)
        for a in range(wp.static(corners)):
            corner_out[wp.static(corners) * e + a, w] = vec3(C[0, a], C[1, a], C[2, a])

    return force


def _product_kernel(kind: Kind) -> wp.Kernel:
    """Tangents of the elements times a direction."""
    corners, averaged, is_single = kind.corners, kind.averaged, kind.is_single
    corotational, precision, gradients = kind.corotational, kind.precision, kind.gradients(kind.precision)
    scalar, vec, thin = precision.scalar, precision.vec, precision.narrow
    directions = wp.types.matrix(shape=(3, corners), dtype=scalar)
    f, sum_number, sum_forces = (
        material_functions(kind),
        lane_sum(scalar, scalar),
        lane_sum(directions, scalar),
    )

    @wp.func
    def point_state(
        i: int,
        w: int,
        X: directions,
        slopes: gradients,
        B: precision.mat,
        F: wp.array2d(dtype=mat33),
        R: wp.array2d(dtype=mat33),
    ):
        """Deformation gradient and rotation of point i; slopes: of the shape functions there."""
        if wp.static(is_single):
            here = X * slopes * B
            return here, f.rotation_thin(here)
        elif wp.static(corotational):
            return F[i, w], R[i, w]
        else:
            return F[i, w], mat33()

    @wp.kernel(**kind.placement)
    def product(
        # In:
        lanes: int,
        cap: real,
        rubber: Rubber,
        mesh: Mesh,
        shape: wp.array(dtype=gradients),
        x: wp.array2d(dtype=vec3),
        p: wp.array2d(dtype=vec),
        on: wp.array(dtype=int),
        pressure: wp.array2d(dtype=real),
        deformation_in: wp.array2d(dtype=mat33),
        rotation_in: wp.array2d(dtype=mat33),
        # Out:
        corner_out: wp.array2d(dtype=vec),
    ):
        e, w, lane = wp.tid()
        if on[w] == 0:
            return
        D = directions()
        X = directions()  # positions from the first node: their differences have the digits that are needed
        first = mesh.elem[0, e]
        for a in range(1, wp.static(corners)):
            n = mesh.elem[a, e]
            d = p[n, w] - p[first, w]
            for c in range(3):
                D[c, a] = d[c]
            if wp.static(is_single):
                v = x[n, w] - x[first, w]
                for c in range(3):
                    X[c, a] = scalar(v[c])
        mu = rubber.mu[w]
        lam = rubber.lam[w]
        local = f.local_lame(mu, lam, cap)
        npoint = wp.static(kind.npoint)
        if wp.static(is_single):  # as in `force`
            npoint = mesh.weight.shape[1]
        else:
            lane = 0
            lanes = 1
        mean_pressure = real(0.0)
        stiff = scalar(0.0)
        if wp.static(averaged):
            if lam > local:
                mean_pressure = pressure[e, w]
                mean = scalar(0.0)
                for q in range(lane, npoint, lanes):
                    B = thin(mesh.inverse[e, q])
                    i = wp.static(kind.npoint) * e + q
                    F, R = point_state(i, w, X, shape[q], B, deformation_in, rotation_in)
                    dF = D * shape[q] * B
                    mean += scalar(mesh.weight[e, q]) * wp.ddot(f.direction_of(rubber.law, F, R), dF)
                stiff = scalar((lam - local) / mesh.volume[e]) * sum_number(mean, lanes)
        C = directions()
        for q in range(lane, npoint, lanes):
            i = npoint * e + q
            B = thin(mesh.inverse[e, q])
            F, R = point_state(i, w, X, shape[q], B, deformation_in, rotation_in)
            dF = D * shape[q] * B
            dP = f.change_of(rubber, e, i, w, mu, local, mean_pressure, F, R, dF)
            if wp.static(averaged):
                if lam > local:
                    dP += stiff * f.direction_of(rubber.law, F, R)
            C += (scalar(f.weighted_volume(rubber, mesh, e, q, w)) * dP * wp.transpose(B)) * wp.transpose(
                shape[q]
            )
        C = sum_forces(C, lanes)
        for a in range(wp.static(corners)):
            corner_out[wp.static(corners) * e + a, w] = vec(C[0, a], C[1, a], C[2, a])

    return product


def _reading_kernels(kind: Kind) -> dict[str, wp.Kernel]:
    """Stress, and slopes at the integration points."""
    npoint, module, deformation = kind.npoint, kind.module, deformation_of(kind.corners)
    thin, wide = kind.precision.narrow, kind.precision.widen
    f = material_functions(kind)

    @wp.kernel(module=kernel_module(f"{module}.read"))
    def cauchy(
        # In:
        cap: real,
        rubber: Rubber,
        mesh: Mesh,
        x: wp.array2d(dtype=vec3),
        # Out:
        cauchy_out: wp.array2d(dtype=mat33),
        von_mises_out: wp.array2d(dtype=real),
    ):
        """Mean Cauchy stress of element e, and its von Mises stress [Pa]."""
        e, w = wp.tid()
        mu = rubber.mu[w]
        lam = rubber.lam[w]
        local = f.local_lame(mu, lam, cap)
        pressure = f.averaged_pressure(lam - local, rubber.law, mesh, x, e, w, 0, 1)
        sigma = mat33()
        for q in range(wp.static(npoint)):
            F = deformation(mesh, e, q, x, w)
            P = f.stress_of(rubber, e, wp.static(npoint) * e + q, w, mu, local, pressure, F, f.rotation(F))
            fraction = f.weighted_volume(rubber, mesh, e, q, w) / mesh.volume[e] / wp.determinant(F)
            sigma += fraction * (P * wp.transpose(F))
        deviator = sigma - wp.trace(sigma) / real(3.0) * wp.identity(n=3, dtype=real)
        cauchy_out[e, w] = sigma
        von_mises_out[e, w] = wp.sqrt(real(1.5) * wp.ddot(deviator, deviator))

    @wp.kernel(module=kernel_module(f"{module}.points"))
    def point_slopes(
        # In:
        cap: real,
        rubber: Rubber,
        mesh: Mesh,
        x: wp.array2d(dtype=vec3),
        change: wp.array2d(dtype=mat33),
        # Out:
        stress_out: wp.array2d(dtype=mat33),
        change_out: wp.array2d(dtype=mat33),
        dilatation_out: wp.array2d(dtype=real),
        direction_out: wp.array2d(dtype=mat33),
    ):
        """See `ElementForces.point_slopes`."""
        e, w = wp.tid()
        mu = rubber.mu[w]
        lam = rubber.lam[w]
        local = f.local_lame(mu, lam, cap)
        pressure = f.averaged_pressure(lam - local, rubber.law, mesh, x, e, w, 0, 1)
        for q in range(wp.static(npoint)):
            i = wp.static(npoint) * e + q
            F = deformation(mesh, e, q, x, w)
            R = f.rotation(F)
            stress_out[i, w] = f.stress_of(rubber, e, i, w, mu, local, pressure, F, R)
            dP = f.change_of(rubber, e, i, w, mu, local, pressure, thin(F), thin(R), thin(change[i, w]))
            change_out[i, w] = wide(dP)
            dilatation_out[i, w] = f.theta(rubber.law, F, R)
            direction_out[i, w] = wide(f.direction_of(rubber.law, thin(F), thin(R)))

    return {"cauchy": cauchy, "point_slopes": point_slopes}
