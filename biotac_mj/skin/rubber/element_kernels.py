"""Forces of the elements' corners, their tangent times a direction, stress and energy.

Positions and forces are double to the end: an inflated skin that is hardly touched balances forces far larger
than its load, and their rounding would be felt. Tangents have the precision of directions. In double,
deformation gradients and rotations are kept from force to product; in single, on CUDA, reading them back
would cost more than computing them again.

On CUDA the four integration points of an element are four threads of a warp, which exchange what they know:
the mean dilatation, and their stresses, of which each thread makes the forces of its share of the ten nodes.
Elsewhere one thread has an element.
"""

import functools
import types

import warp as wp

from ..types import Precision, mat33, real, vec3
from .lanes import (
    THREADS,
    any_lane,
    deformation_of_ten,
    deformation_of_ten_single,
    gradient_of_ten,
    place,
    push_of_points,
    push_of_points_single,
    sum_of_points,
    sum_of_points_single,
)
from .law import (
    LAWS,
    dilatation,
    dilatation_gradient,
    dilatation_hessian,
    energy_density,
    polar,
    polar_single,
    polar_upright,
    squeezed_derivative,
    squeezed_energy,
    squeezed_stress,
    stress,
    stress_derivative,
)
from .points import Mesh, Rubber, deformation_of, point_functions

__all__ = ["element_kernels"]

wp.set_module_options({"enable_backward": False})

# det F below which a step of the line search is refused where friction elements measure isochoric strain
_FLAT = 0.02


def _deep_module():
    """Where the CPU's product is compiled. Warp lets LLVM look for numbers to work on abreast in 4 operations
    behind each other, to compile faster; in 12 it finds what saves a quarter of this kernel's time."""
    flags = wp.config.cpu_compiler_flags
    deep = flags and flags.replace("-slp-recursion-max-depth=4", "-slp-recursion-max-depth=12")
    return {"module": "unique", "module_options": {"cpu_compiler_flags": deep}}


@functools.cache
def element_kernels(
    corners: int, corotational: bool, precision: Precision, options: tuple
) -> types.SimpleNamespace:
    """Kernels of one kind of element, law and rubber. The corotational law has its own: what the others need
    would take registers from it."""
    law_name = "corotational" if corotational else "laws"
    module = f"{__name__}.{corners}_{law_name}_{precision.name}_{'_'.join(options)}"
    npoint = 1 if corners == 4 else 4
    averaged = corners == 10
    # a module of their own where they are not wanted: they take longest to compile
    serial = f"{module}.serial" if averaged and precision.name == "single" else module
    scalar, vec, mat = precision.scalar, precision.vec, precision.mat
    thin, wide = precision.narrow, precision.widen
    is_single = precision.name == "single"
    polar_thin = polar_single if is_single else polar
    # a step never ends inside out: on CUDA registers are worth more than the digits of such a rotation
    polar_full = polar_upright if is_single else polar
    positions = wp.types.matrix(shape=(3, corners), dtype=real)
    directions = wp.types.matrix(shape=(3, corners), dtype=scalar)
    gradients = wp.types.matrix(shape=(corners, 3), dtype=real)
    thin_gradients = wp.types.matrix(shape=(corners, 3), dtype=scalar)
    beyond = [name for name in options if name != "modulus"]
    uneven = "modulus" in options
    at, deformation = point_functions(options), deformation_of(corners)
    beyond_stress, beyond_derivative = at.beyond_stress, at.beyond_derivative

    @wp.func
    def rotation(F: mat33):
        if wp.static(corotational):
            return polar_full(F)
        return mat33()

    @wp.func
    def rotation_thin(F: mat):
        if wp.static(corotational):
            return polar_thin(F)
        return mat()

    @wp.func
    def theta(law: int, F: mat33, R: mat33):
        if wp.static(corotational):
            return wp.ddot(R, F) - real(3.0)
        return dilatation(law, F, R)

    @wp.func
    def stress_of(
        rubber: Rubber, e: int, i: int, w: int, mu: real, lam: real, pressure: real, F: mat33, R: mat33
    ):
        """First Piola stress, of the mean dilatation too."""
        if wp.static(corotational):
            P = (mu + mu) * (F - R) + (lam * (wp.ddot(R, F) - real(3.0)) + pressure) * R
        else:
            P = stress(rubber.law, mu, lam, F, R)
            if wp.static(averaged):
                P += pressure * dilatation_gradient(rubber.law, F, R)
        if wp.static(len(beyond) > 0):
            P += beyond_stress(rubber, e, i, w, mu, lam, F, R)
        return P + squeezed_stress(rubber.law, mu, F)

    @wp.func
    def direction_of(law: int, F: mat, R: mat):
        """Derivative of the dilatation."""
        if wp.static(corotational):
            return R
        return thin(dilatation_gradient(law, wide(F), wide(R)))

    @wp.func
    def change_of(
        rubber: Rubber, e: int, i: int, w: int, mu: real, lam: real, pressure: real, F: mat, R: mat, dF: mat
    ):
        """Derivative of the stress along dF at this point's pressure."""
        if wp.static(corotational):
            m = scalar(mu)
            l = scalar(lam)
            Rt = wp.transpose(R)
            S = Rt * F
            A = Rt * dF
            trace_s = wp.trace(S)
            turn = vec(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1])
            dR = R * wp.skew(wp.inverse(trace_s * wp.identity(n=3, dtype=scalar) - S) * turn)
            dP = (
                scalar(2.0) * m * (dF - dR)
                + l * wp.trace(A) * R
                + (l * (trace_s - scalar(3.0)) + scalar(pressure)) * dR
            )
            if wp.static(len(beyond) > 0):
                dP += thin(beyond_derivative(rubber, e, i, w, mu, lam, wide(F), wide(R), wide(dF)))
            return dP + squeezed_derivative(rubber.law, m, F, dF)
        D = wide(dF)
        Q = wide(R)
        G = wide(F)
        total = stress_derivative(rubber.law, mu, lam, G, Q, D)
        if wp.static(averaged):
            total += pressure * dilatation_hessian(rubber.law, G, Q, D)
        if wp.static(len(beyond) > 0):
            total += beyond_derivative(rubber, e, i, w, mu, lam, G, Q, D)
        return thin(total) + squeezed_derivative(rubber.law, scalar(mu), F, dF)

    @wp.func
    def share(rubber: Rubber, mesh: Mesh, e: int, q: int, w: int):
        """Volume of a point, times the factor on the rubber's modulus there."""
        if wp.static(uneven):
            return mesh.weight[e, q] * rubber.modulus[e, w]
        return mesh.weight[e, q]

    @wp.func
    def local_lame(mu: real, lam: real, cap: real):
        if wp.static(averaged):
            return wp.min(lam, cap * mu)
        return lam

    @wp.func
    def flaw(law: int, F: mat33):
        """Of a point: 2 inside out, 1 flatter than the law bears, 3 both; small strain knows neither."""
        found = int(0)
        if law != wp.static(LAWS["linear"]):
            volume = wp.determinant(F)
            if not (volume > real(0.0)):
                found = 2
            if wp.static("hysteresis" in options):
                if law == wp.static(LAWS["neo_hookean"]) and not (volume > real(_FLAT)):
                    found += 1
        return found

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

    if averaged and is_single:  # a thread for each point: for CUDA

        @wp.kernel(module=module, enable_backward=False, launch_bounds=(THREADS, 5))
        def force(
            # In:
            group: int,
            nworld: int,
            cap: real,
            rubber: Rubber,
            mesh: Mesh,
            x: wp.array2d(dtype=vec3),
            on: wp.array(dtype=int),
            # Out:
            pressure_out: wp.array2d(dtype=real),
            corner_out: wp.array2d(dtype=vec3),
            inverted_out: wp.array(dtype=int),
        ):
            at = place(wp.tid(), group, nworld)
            e = at[0]
            q = at[1]
            w = wp.min(at[2], nworld - 1)
            active = wp.where(at[2] < nworld, on[w], 0)
            if any_lane(active) == 0:
                return
            F = deformation_of_ten(mesh.of_element, mesh.shape, mesh.inverse, e, q, x, w)
            R = rotation(F)
            bad = flaw(rubber.law, F)
            if active == 1 and bad > 0:
                wp.atomic_max(inverted_out, w, bad)
            mu = rubber.mu[w]
            lam = rubber.lam[w]
            local = wp.min(lam, cap * mu)
            mean = sum_of_points(mesh.weight[e, q] * theta(rubber.law, F, R), group)
            pressure = real(0.0)
            if lam > local:
                pressure = (lam - local) * mean / mesh.volume[e]
                if active == 1 and q == 0:
                    pressure_out[e, w] = pressure
            back = -share(rubber, mesh, e, q, w) * wp.transpose(mesh.inverse[e, q])
            H = stress_of(rubber, e, 4 * e + q, w, mu, local, pressure, F, R) * back
            push = push_of_points(H, mesh.shape, q, group)
            if active == 1:
                corner_out[10 * e + q, w] = push[0]
                corner_out[10 * e + q + 4, w] = push[1]
                if q < 2:
                    corner_out[10 * e + q + 8, w] = push[2]

    if averaged and is_single:

        @wp.kernel(module=module, enable_backward=False, launch_bounds=(THREADS, 6))
        def product(
            # In:
            group: int,
            nworld: int,
            cap: real,
            rubber: Rubber,
            mesh: Mesh,
            x: wp.array2d(dtype=vec3),
            p: wp.array2d(dtype=wp.vec3),
            on: wp.array(dtype=int),
            pressure: wp.array2d(dtype=real),
            # Out:
            corner_out: wp.array2d(dtype=wp.vec3),
        ):
            at = place(wp.tid(), group, nworld)
            e = at[0]
            q = at[1]
            w = wp.min(at[2], nworld - 1)
            active = wp.where(at[2] < nworld, on[w], 0)
            if any_lane(active) == 0:
                return
            F = deformation_of_ten_single(mesh.of_element, mesh.shape_single, mesh.inverse_single, e, q, x, w)
            dF = gradient_of_ten(mesh.of_element, mesh.shape_single, mesh.inverse_single, e, q, p, w)
            R = rotation_thin(F)
            mu = rubber.mu[w]
            lam = rubber.lam[w]
            local = wp.min(lam, cap * mu)
            felt = real(0.0)
            if lam > local:
                felt = pressure[e, w]
            dP = change_of(rubber, e, 4 * e + q, w, mu, local, felt, F, R, dF)
            G = direction_of(rubber.law, F, R)
            mean = sum_of_points_single(float(mesh.weight[e, q]) * wp.ddot(G, dF), group)
            if lam > local:
                dP += float((lam - local) / mesh.volume[e]) * mean * G
            H = float(share(rubber, mesh, e, q, w)) * dP * wp.transpose(mesh.inverse_single[e, q])
            push = push_of_points_single(H, mesh.shape_single, q, group)
            if active == 1:
                corner_out[10 * e + q, w] = push[0]
                corner_out[10 * e + q + 4, w] = push[1]
                if q < 2:
                    corner_out[10 * e + q + 8, w] = push[2]

    @wp.kernel(module=serial, enable_backward=False)
    def force_serial(
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
            C -= (share(rubber, mesh, e, q, w) * P * wp.transpose(mesh.inverse[e, q])) * wp.transpose(
                shape[q]
            )
        for a in range(wp.static(corners)):
            corner_out[wp.static(corners) * e + a, w] = vec3(C[0, a], C[1, a], C[2, a])

    @wp.func
    def point_state(
        e: int,
        q: int,
        w: int,
        X: positions,
        shape: wp.array(dtype=gradients),
        mesh: Mesh,
        kept_deformation: wp.array2d(dtype=mat33),
        kept_rotation: wp.array2d(dtype=mat33),
    ):
        """Deformation gradient and rotation of a point."""
        i = wp.static(npoint) * e + q
        if wp.static(is_single):
            F = thin(X * shape[q] * mesh.inverse[e, q])
            return F, rotation_thin(F)
        elif wp.static(corotational):
            return kept_deformation[i, w], kept_rotation[i, w]
        else:
            return kept_deformation[i, w], mat33()

    @wp.kernel(enable_backward=False, **({"module": serial} if is_single else _deep_module()))
    def product_serial(
        # In:
        cap: real,
        rubber: Rubber,
        mesh: Mesh,
        shape: wp.array(dtype=gradients),
        x: wp.array2d(dtype=vec3),
        p: wp.array2d(dtype=vec),
        on: wp.array(dtype=int),
        pressure: wp.array2d(dtype=real),
        kept_deformation: wp.array2d(dtype=mat33),
        kept_rotation: wp.array2d(dtype=mat33),
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
        felt = real(0.0)
        stiff = scalar(0.0)
        if wp.static(averaged):
            if lam > local:
                felt = pressure[e, w]
                mean = scalar(0.0)
                for q in range(wp.static(npoint)):
                    B = thin(mesh.inverse[e, q])
                    F, R = point_state(e, q, w, X, shape, mesh, kept_deformation, kept_rotation)
                    dF = D * narrow_gradients(shape[q]) * B
                    mean += scalar(mesh.weight[e, q]) * wp.ddot(direction_of(rubber.law, F, R), dF)
                stiff = scalar((lam - local) / mesh.volume[e]) * mean
        C = directions()
        for q in range(wp.static(npoint)):
            B = thin(mesh.inverse[e, q])
            g = narrow_gradients(shape[q])
            F, R = point_state(e, q, w, X, shape, mesh, kept_deformation, kept_rotation)
            dF = D * g * B
            dP = change_of(rubber, e, wp.static(npoint) * e + q, w, mu, local, felt, F, R, dF)
            if wp.static(averaged):
                if lam > local:
                    dP += stiff * direction_of(rubber.law, F, R)
            C += (scalar(share(rubber, mesh, e, q, w)) * dP * wp.transpose(B)) * wp.transpose(g)
        for a in range(wp.static(corners)):
            corner_out[wp.static(corners) * e + a, w] = vec(C[0, a], C[1, a], C[2, a])

    @wp.func
    def averaged_pressure(excess: real, law: int, mesh: Mesh, x: wp.array2d(dtype=vec3), e: int, w: int):
        """What an element's mean dilatation makes of the part of lambda that is not local."""
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
        """Mean Cauchy stress of each element, and the von Mises stress of this mean."""
        e, w = wp.tid()
        mu = rubber.mu[w]
        lam = rubber.lam[w]
        local = local_lame(mu, lam, cap)
        pressure = averaged_pressure(lam - local, rubber.law, mesh, x, e, w)
        sigma = mat33()
        for q in range(wp.static(npoint)):
            F = deformation(mesh, e, q, x, w)
            P = stress_of(rubber, e, wp.static(npoint) * e + q, w, mu, local, pressure, F, rotation(F))
            part = share(rubber, mesh, e, q, w) / mesh.volume[e] / wp.determinant(F)
            sigma += part * (P * wp.transpose(F))
        deviator = sigma - wp.trace(sigma) / real(3.0) * wp.identity(n=3, dtype=real)
        cauchy_out[e, w] = sigma
        von_mises_out[e, w] = wp.sqrt(real(1.5) * wp.ddot(deviator, deviator))

    @wp.kernel(module=f"{module}.read", enable_backward=False)
    def energy(
        # In:
        cap: real,
        rubber: Rubber,
        mesh: Mesh,
        x: wp.array2d(dtype=vec3),
        # Out:
        energy_out: wp.array2d(dtype=real),
    ):
        """Elastic energy of each element by its law."""
        e, w = wp.tid()
        mu = rubber.mu[w]
        lam = rubber.lam[w]
        local = local_lame(mu, lam, cap)
        mean = real(0.0)
        total = real(0.0)
        for q in range(wp.static(npoint)):
            F = deformation(mesh, e, q, x, w)
            R = rotation(F)
            mean += mesh.weight[e, q] * theta(rubber.law, F, R)
            density = energy_density(rubber.law, mu, local, F, R) + squeezed_energy(rubber.law, mu, F)
            total += share(rubber, mesh, e, q, w) * density
        factor = share(rubber, mesh, e, 0, w) / mesh.weight[e, 0]
        energy_out[e, w] = total + factor * real(0.5) * (lam - local) * mean * mean / mesh.volume[e]

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

    found = {
        "force_serial": force_serial,
        "product_serial": product_serial,
        "cauchy": cauchy,
        "energy": energy,
        "point_slopes": point_slopes,
    }
    if averaged and is_single:
        found |= {"force": force, "product": product}
    return types.SimpleNamespace(gradients=gradients, **found)
