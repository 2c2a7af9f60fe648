"""Forces of the elements' corners, their tangent times a direction, and stress.

Positions and forces are in double precision: a filled skin under light contact balances forces far larger
than its load, and their rounding errors would show. Tangents have the precision of directions. In double
precision, deformation gradients and rotations are stored from force to product; in single, on CUDA, it is
faster to compute them again than to read them. A thread has an element."""

import functools
import types

import warp as wp

from ..types import Precision, mat33, real, vec3
from .element_points import Kind, material_functions
from .points import Mesh, Rubber, deformation_of

wp.set_module_options({"enable_backward": False})


def _deep_module():
    """Module and compiler options of the product on the CPU. Warp limits LLVM's search for SIMD operations to
    a depth of 4; a depth of 12 saves a sixth of this kernel's time for the corotational law, 2 % of a press,
    and nothing for the others."""
    flags = wp.config.cpu_compiler_flags
    deep = flags and flags.replace("-slp-recursion-max-depth=4", "-slp-recursion-max-depth=12")
    return {"module": "unique", "module_options": {"cpu_compiler_flags": deep}}


@functools.cache
def element_kernels(
    corners: int, corotational: bool, precision: Precision, options: tuple
) -> types.SimpleNamespace:
    """Kernels of one kind of element, law and rubber. The corotational law has kernels of its own, since the
    other laws need more registers."""
    kind = Kind(corners, corotational, precision, options)
    found = {"force": _force_kernel(kind), "product": _product_kernel(kind), **_reading_kernels(kind)}
    return types.SimpleNamespace(gradients=kind.gradients, **found)


def _force_kernel(kind: Kind) -> wp.Kernel:
    """Forces of the elements."""
    corners, npoint, averaged, is_single = kind.corners, kind.npoint, kind.averaged, kind.is_single
    corotational, module, gradients = kind.corotational, kind.module, kind.gradients
    positions = wp.types.matrix(shape=(3, corners), dtype=real)
    f = material_functions(kind)
    rotation, theta, stress_of, weighted_volume = f.rotation, f.theta, f.stress_of, f.weighted_volume
    local_lame, flaw = f.local_lame, f.flaw

    @wp.kernel(module=module, enable_backward=False)
    def force(
        # In:
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
        e, w = wp.tid()
        if on[w] == 0:
            return
        X = positions()
        for a in range(wp.static(corners)):
            v = x[mesh.elem[a, e], w]
            for c in range(3):
                X[c, a] = v[c]
        mu = rubber.mu[w]
        lam = rubber.lam[w]
        local = local_lame(mu, lam, cap)
        pressure = real(0.0)
        if wp.static(averaged):
            if lam > local:
                mean = real(0.0)
                for q in range(wp.static(npoint)):
                    F = X * shape[q] * mesh.inverse[e, q]
                    mean += mesh.weight[e, q] * theta(rubber.law, F, rotation(F))
                pressure = (lam - local) * mean / mesh.volume[e]
                pressure_out[e, w] = pressure
        C = positions()
        for q in range(wp.static(npoint)):
            F = X * shape[q] * mesh.inverse[e, q]
            bad = flaw(rubber.law, F)
            if bad > 0:
                wp.atomic_max(inverted_out, w, bad)
            R = rotation(F)
            if wp.static(not is_single):
                deformation_out[wp.static(npoint) * e + q, w] = F
                if wp.static(corotational):
                    rotation_out[wp.static(npoint) * e + q, w] = R
            P = stress_of(rubber, e, wp.static(npoint) * e + q, w, mu, local, pressure, F, R)
            C -= (
                weighted_volume(rubber, mesh, e, q, w) * P * wp.transpose(mesh.inverse[e, q])
            ) * wp.transpose(shape[q])
        for a in range(wp.static(corners)):
            corner_out[wp.static(corners) * e + a, w] = vec3(C[0, a], C[1, a], C[2, a])

    return force


def _product_kernel(kind: Kind) -> wp.Kernel:
    """Tangents of the elements times a direction."""
    corners, npoint, averaged, is_single = kind.corners, kind.npoint, kind.averaged, kind.is_single
    corotational, module, gradients = kind.corotational, kind.module, kind.gradients
    scalar, vec, thin = kind.precision.scalar, kind.precision.vec, kind.precision.narrow
    positions = wp.types.matrix(shape=(3, corners), dtype=real)
    directions = wp.types.matrix(shape=(3, corners), dtype=scalar)
    thin_gradients = wp.types.matrix(shape=(corners, 3), dtype=scalar)
    f = material_functions(kind)
    rotation_thin, direction_of, change_of = f.rotation_thin, f.direction_of, f.change_of
    weighted_volume, local_lame = f.weighted_volume, f.local_lame

    @wp.func
    def narrow_gradients(g: gradients):
        if wp.static(is_single):
            out = thin_gradients()
            for a in range(wp.static(corners)):
                for c in range(3):
                    out[a, c] = scalar(g[a, c])
            return out
        else:  # Warp compiles what follows a return
            return g

    @wp.func
    def point_state(
        e: int,
        q: int,
        w: int,
        X: positions,
        shape: wp.array(dtype=gradients),
        mesh: Mesh,
        deformation_in: wp.array2d(dtype=mat33),
        rotation_in: wp.array2d(dtype=mat33),
    ):
        """Deformation gradient and rotation of point q."""
        i = wp.static(npoint) * e + q
        if wp.static(is_single):
            F = thin(X * shape[q] * mesh.inverse[e, q])
            return F, rotation_thin(F)
        elif wp.static(corotational):
            return deformation_in[i, w], rotation_in[i, w]
        else:
            return deformation_in[i, w], mat33()

    @wp.kernel(enable_backward=False, **({"module": module} if is_single else _deep_module()))
    def product(
        # In:
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
        e, w = wp.tid()
        if on[w] == 0:
            return
        X = positions()
        D = directions()
        p0 = p[mesh.elem[0, e], w]
        for a in range(wp.static(corners)):
            n = mesh.elem[a, e]
            d = p[n, w] - p0
            for c in range(3):
                D[c, a] = d[c]
            if wp.static(is_single):
                v = x[n, w]
                for c in range(3):
                    X[c, a] = v[c]
        mu = rubber.mu[w]
        lam = rubber.lam[w]
        local = local_lame(mu, lam, cap)
        mean_pressure = real(0.0)
        stiff = scalar(0.0)
        if wp.static(averaged):
            if lam > local:
                mean_pressure = pressure[e, w]
                mean = scalar(0.0)
                for q in range(wp.static(npoint)):
                    B = thin(mesh.inverse[e, q])
                    F, R = point_state(e, q, w, X, shape, mesh, deformation_in, rotation_in)
                    dF = D * narrow_gradients(shape[q]) * B
                    mean += scalar(mesh.weight[e, q]) * wp.ddot(direction_of(rubber.law, F, R), dF)
                stiff = scalar((lam - local) / mesh.volume[e]) * mean
        C = directions()
        for q in range(wp.static(npoint)):
            B = thin(mesh.inverse[e, q])
            g = narrow_gradients(shape[q])
            F, R = point_state(e, q, w, X, shape, mesh, deformation_in, rotation_in)
            dF = D * g * B
            dP = change_of(rubber, e, wp.static(npoint) * e + q, w, mu, local, mean_pressure, F, R, dF)
            if wp.static(averaged):
                if lam > local:
                    dP += stiff * direction_of(rubber.law, F, R)
            C += (scalar(weighted_volume(rubber, mesh, e, q, w)) * dP * wp.transpose(B)) * wp.transpose(g)
        for a in range(wp.static(corners)):
            corner_out[wp.static(corners) * e + a, w] = vec(C[0, a], C[1, a], C[2, a])

    return product


def _reading_kernels(kind: Kind) -> dict[str, wp.Kernel]:
    """Stress, and slopes at the integration points."""
    npoint, module, deformation = kind.npoint, kind.module, deformation_of(kind.corners)
    thin, wide = kind.precision.narrow, kind.precision.widen
    f = material_functions(kind)
    rotation, theta, stress_of, direction_of = f.rotation, f.theta, f.stress_of, f.direction_of
    change_of, weighted_volume, local_lame = f.change_of, f.weighted_volume, f.local_lame

    @wp.func
    def averaged_pressure(excess: real, law: int, mesh: Mesh, x: wp.array2d(dtype=vec3), e: int, w: int):
        """Pressure of an element's mean dilatation, for the part `excess` of lambda that is not local
        [Pa]."""
        mean = real(0.0)
        for q in range(wp.static(npoint)):
            F = deformation(mesh, e, q, x, w)
            mean += mesh.weight[e, q] * theta(law, F, rotation(F))
        return excess * mean / mesh.volume[e]

    @wp.kernel(module=f"{module}.read", enable_backward=False)
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
        local = local_lame(mu, lam, cap)
        pressure = averaged_pressure(lam - local, rubber.law, mesh, x, e, w)
        sigma = mat33()
        for q in range(wp.static(npoint)):
            F = deformation(mesh, e, q, x, w)
            P = stress_of(rubber, e, wp.static(npoint) * e + q, w, mu, local, pressure, F, rotation(F))
            fraction = weighted_volume(rubber, mesh, e, q, w) / mesh.volume[e] / wp.determinant(F)
            sigma += fraction * (P * wp.transpose(F))
        deviator = sigma - wp.trace(sigma) / real(3.0) * wp.identity(n=3, dtype=real)
        cauchy_out[e, w] = sigma
        von_mises_out[e, w] = wp.sqrt(real(1.5) * wp.ddot(deviator, deviator))

    @wp.kernel(module=f"{module}.points", enable_backward=False)
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
        local = local_lame(mu, lam, cap)
        pressure = averaged_pressure(lam - local, rubber.law, mesh, x, e, w)
        for q in range(wp.static(npoint)):
            i = wp.static(npoint) * e + q
            F = deformation(mesh, e, q, x, w)
            R = rotation(F)
            stress_out[i, w] = stress_of(rubber, e, i, w, mu, local, pressure, F, R)
            dP = change_of(rubber, e, i, w, mu, local, pressure, thin(F), thin(R), thin(change[i, w]))
            change_out[i, w] = wide(dP)
            dilatation_out[i, w] = theta(rubber.law, F, R)
            direction_out[i, w] = wide(direction_of(rubber.law, thin(F), thin(R)))

    return {"cauchy": cauchy, "point_slopes": point_slopes}
