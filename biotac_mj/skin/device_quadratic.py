"""Ten-node tetrahedra as the device step evaluates them: see `quadratic` for the element and
`device_elasticity` for the precision.

Forces stay double to the end: an inflated skin that is hardly touched balances forces far larger than its
  load, and their rounding would be
felt. Tangents are single.

On CUDA the four integration points of an element are four threads of a warp, which exchange what they know:
the mean dilatation, and their stresses, of which each thread makes the forces of its share of the ten nodes.
On the CPU, where this is for tests, one thread loops."""

import functools

import numpy as np
import warp as wp

from .device_elasticity import Linear, narrow, polar_mixed, polar_single, widen
from .material import dilatation, dilatation_gradient, dilatation_hessian, stress, stress_derivative
from .quadratic import POINTWISE, QuadraticTetrahedra
from .types import mat33, real, vec3

__all__ = ["Quadratic", "device_elements"]

wp.set_module_options({"enable_backward": False})

_INVERTED = (
    0.02  # det F below which a step of the line search is refused where the law cannot recover from inversion
)
_ABREAST = 8  # worlds whose threads lie side by side: what they read does too

# the threads of an element's points are `group` lanes apart
_LANES = """
    const int lane = threadIdx.x & 31;
    const int base = lane - ((lane / group) & 3) * group;
    const unsigned mask = ((1u | 1u << group | 1u << (2 * group) | 1u << (3 * group))) << base;
"""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    {_LANES}
    float total = 0.0f;
    for (int k = 0; k < 4; ++k) total += __shfl_sync(mask, value, base + k * group);
    return total;
#else
    return value;
#endif
""")
def sum_of_points(value: float, group: int) -> float: ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    {_LANES}
    wp::mat_t<3, 3, float> B;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) B.data[i][j] = __shfl_sync(mask, A.data[i][j], base + q * group);
    return B;
#else
    return A;
#endif
""")
def of_point(A: wp.mat33, q: int, group: int) -> wp.mat33: ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    {_LANES}
    wp::mat_t<3, 3, double> B;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) B.data[i][j] = __shfl_sync(mask, A.data[i][j], base + q * group);
    return B;
#else
    return A;
#endif
""")
def of_point_double(A: mat33, q: int, group: int) -> mat33: ...


@wp.struct
class Mesh:
    elem: wp.array2d(dtype=int)  # [10, element]
    shape: wp.array2d(dtype=vec3)  # gradients in the parent element [point, node]
    inverse: wp.array2d(dtype=mat33)  # of the parent's map [element, point]
    weight: wp.array2d(dtype=real)
    volume: wp.array(dtype=real)


@wp.func
def deformation(mesh: Mesh, e: int, q: int, x: wp.array2d(dtype=vec3), w: int):
    """Deformation gradient of point q."""
    F = mat33()
    first = x[mesh.elem[0, e], w]
    for a in range(1, 10):
        F += wp.outer(x[mesh.elem[a, e], w] - first, mesh.shape[q, a])
    return F * mesh.inverse[e, q]


@wp.func
def gradient(mesh: Mesh, e: int, q: int, p: wp.array2d(dtype=wp.vec3), w: int):
    """The same of a direction, in single precision."""
    F = wp.mat33()
    first = p[mesh.elem[0, e], w]
    for a in range(1, 10):
        g = mesh.shape[q, a]
        F += wp.outer(p[mesh.elem[a, e], w] - first, wp.vec3(float(g[0]), float(g[1]), float(g[2])))
    return F * narrow(mesh.inverse[e, q])


@wp.func
def corner_force(H: wp.mat33, mesh: Mesh, q: int, a: int):
    g = mesh.shape[q, a]
    return H * wp.vec3(float(g[0]), float(g[1]), float(g[2]))


@wp.func
def place(t: int, group: int, nworld: int):
    """Element, point and world of a thread."""
    blocks = (nworld + group - 1) // group
    rest = t // (4 * group)
    return wp.vec3i(rest // blocks, (t // group) % 4, (rest % blocks) * group + t % group)


@functools.cache
def _kernels(corotational):
    """(force, product) kernels; the corotational law's own: what the others need would take registers from
    it."""

    @wp.func
    def rotation(F: mat33):
        if wp.static(corotational):
            return polar_mixed(F)
        return mat33()

    @wp.func
    def theta(law: int, F: mat33, R: mat33):
        if wp.static(corotational):
            return wp.ddot(R, F) - real(3.0)
        return dilatation(law, F, R)

    @wp.func
    def force_of(law: int, mu: real, lam: real, pressure: real, F: mat33, R: mat33, back: mat33):
        """Stress, of the mean dilatation too, times `back`."""
        if wp.static(corotational):
            P = (mu + mu) * (F - R) + (lam * (wp.ddot(R, F) - real(3.0)) + pressure) * R
        else:
            P = stress(law, mu, lam, F, R) + pressure * dilatation_gradient(law, F, R)
        return P * back

    @wp.func
    def direction_of(law: int, F: wp.mat33, R: wp.mat33):
        if wp.static(corotational):
            return R
        return narrow(dilatation_gradient(law, widen(F), widen(R)))

    @wp.func
    def rotation_single(F: wp.mat33):
        if wp.static(corotational):
            return polar_single(F)
        return wp.mat33()

    @wp.func
    def change_of(law: int, mu: real, lam: real, pressure: real, F: wp.mat33, R: wp.mat33, dF: wp.mat33):
        """Derivative of the stress along dF at this point's pressure."""
        if wp.static(corotational):
            m = float(mu)
            Rt = wp.transpose(R)
            S = Rt * F
            A = Rt * dF
            trace_s = wp.trace(S)
            turn = wp.vec3(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1])
            dR = R * wp.skew(wp.inverse(trace_s * wp.identity(n=3, dtype=float) - S) * turn)
            return (
                2.0 * m * (dF - dR)
                + float(lam) * wp.trace(A) * R
                + (float(lam) * (trace_s - 3.0) + float(pressure)) * dR
            )
        D, Q, G = widen(dF), widen(R), widen(F)
        return narrow(stress_derivative(law, mu, lam, G, Q, D) + pressure * dilatation_hessian(law, G, Q, D))

    @wp.kernel(module="unique", enable_backward=False)
    def force(
        # In:
        group: int,
        nworld: int,
        law: int,
        mu: wp.array(dtype=real),
        lam: wp.array(dtype=real),
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
        w = at[2]
        if w >= nworld:
            return
        if on[w] == 0:
            return
        F = deformation(mesh, e, q, x, w)
        R = rotation(F)
        if not wp.static(corotational):
            if law == 2 and not (wp.determinant(F) > real(_INVERTED)):
                inverted_out[w] = 1
        local = wp.min(lam[w], real(POINTWISE) * mu[w])
        weight = mesh.weight[e, q]
        pressure = real(0.0)
        if lam[w] > local:
            mean = real(sum_of_points(float(weight * theta(law, F, R)), group))
            pressure = (lam[w] - local) * mean / mesh.volume[e]
            if q == 0:
                pressure_out[e, w] = pressure
        H = force_of(law, mu[w], local, pressure, F, R, -weight * wp.transpose(mesh.inverse[e, q]))
        first, second, third = vec3(), vec3(), vec3()
        for k in range(4):
            K = of_point_double(H, k, group)
            first += K * mesh.shape[k, q]
            second += K * mesh.shape[k, q + 4]
            third += K * mesh.shape[k, wp.min(q + 8, 9)]
        corner_out[10 * e + q, w] = first
        corner_out[10 * e + q + 4, w] = second
        if q < 2:
            corner_out[10 * e + q + 8, w] = third

    @wp.kernel(module="unique", enable_backward=False)
    def product(
        # In:
        group: int,
        nworld: int,
        law: int,
        mu: wp.array(dtype=real),
        lam: wp.array(dtype=real),
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
        w = at[2]
        if w >= nworld:
            return
        if on[w] == 0:
            return
        F = narrow(deformation(mesh, e, q, x, w))
        dF = gradient(mesh, e, q, p, w)
        R = rotation_single(F)
        local = wp.min(lam[w], real(POINTWISE) * mu[w])
        weight = float(mesh.weight[e, q])
        felt = real(0.0)
        if lam[w] > local:
            felt = pressure[e, w]
        dP = change_of(law, mu[w], local, felt, F, R, dF)
        if lam[w] > local:
            G = direction_of(law, F, R)
            mean = sum_of_points(weight * wp.ddot(G, dF), group)
            dP += float((lam[w] - local) / mesh.volume[e]) * mean * G
        H = weight * dP * wp.transpose(narrow(mesh.inverse[e, q]))
        first, second, third = wp.vec3(), wp.vec3(), wp.vec3()
        for k in range(4):
            K = of_point(H, k, group)
            first += corner_force(K, mesh, k, q)
            second += corner_force(K, mesh, k, q + 4)
            third += corner_force(K, mesh, k, wp.min(q + 8, 9))
        corner_out[10 * e + q, w] = first
        corner_out[10 * e + q + 4, w] = second
        if q < 2:
            corner_out[10 * e + q + 8, w] = third

    @wp.kernel(module="unique", enable_backward=False)
    def force_serial(
        # In:
        law: int,
        mu: wp.array(dtype=real),
        lam: wp.array(dtype=real),
        mesh: Mesh,
        x: wp.array2d(dtype=vec3),
        on: wp.array(dtype=int),
        # Out:
        pressure_out: wp.array2d(dtype=real),
        corner_out: wp.array2d(dtype=vec3),
        inverted_out: wp.array(dtype=int),
    ):
        e, w = wp.tid()
        if on[w] == 0:
            return
        local = wp.min(lam[w], real(POINTWISE) * mu[w])
        mean = float(0.0)
        for q in range(4):
            F = deformation(mesh, e, q, x, w)
            mean += float(mesh.weight[e, q] * theta(law, F, rotation(F)))
            if law == 2 and not (wp.determinant(F) > real(_INVERTED)):
                inverted_out[w] = 1
        pressure = (lam[w] - local) * real(mean) / mesh.volume[e]
        pressure_out[e, w] = pressure
        for a in range(10):
            corner_out[10 * e + a, w] = vec3()
        for q in range(4):
            F = deformation(mesh, e, q, x, w)
            H = force_of(
                law,
                mu[w],
                local,
                pressure,
                F,
                rotation(F),
                -mesh.weight[e, q] * wp.transpose(mesh.inverse[e, q]),
            )
            for a in range(10):
                corner_out[10 * e + a, w] = corner_out[10 * e + a, w] + H * mesh.shape[q, a]

    @wp.kernel(module="unique", enable_backward=False)
    def product_serial(
        # In:
        law: int,
        mu: wp.array(dtype=real),
        lam: wp.array(dtype=real),
        mesh: Mesh,
        x: wp.array2d(dtype=vec3),
        p: wp.array2d(dtype=wp.vec3),
        on: wp.array(dtype=int),
        pressure: wp.array2d(dtype=real),
        # Out:
        corner_out: wp.array2d(dtype=wp.vec3),
    ):
        e, w = wp.tid()
        if on[w] == 0:
            return
        local = wp.min(lam[w], real(POINTWISE) * mu[w])
        mean = float(0.0)
        for q in range(4):
            F = narrow(deformation(mesh, e, q, x, w))
            mean += float(mesh.weight[e, q]) * wp.ddot(
                direction_of(law, F, rotation_single(F)), gradient(mesh, e, q, p, w)
            )
        for a in range(10):
            corner_out[10 * e + a, w] = wp.vec3()
        for q in range(4):
            F = narrow(deformation(mesh, e, q, x, w))
            R = rotation_single(F)
            dP = change_of(law, mu[w], local, pressure[e, w], F, R, gradient(mesh, e, q, p, w))
            dP += float((lam[w] - local) / mesh.volume[e]) * mean * direction_of(law, F, R)
            H = float(mesh.weight[e, q]) * dP * wp.transpose(narrow(mesh.inverse[e, q]))
            for a in range(10):
                corner_out[10 * e + a, w] = corner_out[10 * e + a, w] + corner_force(H, mesh, q, a)

    return force, product, force_serial, product_serial


@wp.kernel
def flag_points_inside_out(
    mesh: Mesh, x: wp.array2d(dtype=vec3), asked: wp.array(dtype=int), failed_out: wp.array(dtype=int)
):
    """Marks worlds with an integration point whose determinant is not positive."""
    e, q, w = wp.tid()
    if asked[w] == 1 and not (wp.determinant(deformation(mesh, e, q, x, w)) > real(0.0)):
        failed_out[w] = 1


class Quadratic:
    """Ten-node tetrahedra for all worlds.

    Attributes:
      start, slot: CSR lists of the corners of each node. corner_force, corner: what `force` and `product`
        wrote last [slot, world] [N].
    """

    def __init__(self, elements, nworld):
        self.law, self.device, self._nworld = elements.law, elements.device, nworld
        self._group = _ABREAST if nworld >= _ABREAST else 1
        blocks = -(-nworld // self._group)
        self._count = elements.nelem
        self._threads = 4 * self._count * blocks * self._group
        self._block_dim = 256 if nworld >= _ABREAST else 64
        self.start, self.slot = elements.start, elements.slot
        mesh = Mesh()
        with wp.ScopedDevice(self.device):
            mesh.elem = wp.array(np.ascontiguousarray(elements.elem.numpy().T), dtype=int, ndim=2)
            mesh.shape = wp.array(elements.shape.numpy(), dtype=vec3, ndim=2)
            mesh.inverse, mesh.weight, mesh.volume = elements.inverse, elements.weight, elements.volume
            self._mesh = mesh
            self._pressure = wp.zeros((self._count, nworld), dtype=real)
            self.corner_force = wp.zeros((10 * self._count, nworld), dtype=vec3)
            self.corner = wp.zeros((10 * self._count, nworld), dtype=wp.vec3)
        self._kernels = _kernels(self.law == 0)

    def force(self, mu, lam, x, on, inverted):
        """Forces of the corners at x [nvert, nworld] in the worlds that are on; marks worlds whose law cannot
        bear the deformation."""
        self._launch(0, [self.law, mu, lam, self._mesh, x, on], [self._pressure, self.corner_force, inverted])

    def product(self, mu, lam, x, p, on):
        """Tangent at x, where `force` was evaluated last, times p, by corners."""
        self._launch(1, [self.law, mu, lam, self._mesh, x, p, on, self._pressure], [self.corner])

    def refuse_inverted(self, x, asked, failed):
        """Marks worlds with an inverted element at x."""
        dim = (self._count, 4, self._nworld)
        wp.launch(flag_points_inside_out, dim, [self._mesh, x, asked], [failed], device=self.device)

    def _launch(self, which, inputs, outputs):
        if self.device.is_cuda:
            inputs = [self._group, self._nworld, *inputs]
            wp.launch(
                self._kernels[which],
                self._threads,
                inputs,
                outputs,
                device=self.device,
                block_dim=self._block_dim,
            )
        else:
            wp.launch(
                self._kernels[2 + which], (self._count, self._nworld), inputs, outputs, device=self.device
            )


def device_elements(elements, nworld):
    """The formulation as the device step needs it."""
    return (Quadratic if isinstance(elements, QuadraticTetrahedra) else Linear)(elements, nworld)
