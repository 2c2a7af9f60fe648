"""Stress, its derivative and dilatation at an integration point of one kind of element, law and rubber."""

import functools
import types
from typing import NamedTuple

import warp as wp

from ...kernels import kernel_module
from ..block import lane_sum
from ..types import Precision, mat33, real, vec3
from .law import (
    Law,
    barrier_derivative,
    barrier_stress,
    dilatation,
    dilatation_gradient,
    dilatation_hessian,
    polar,
    polar_single,
    polar_upright,
    stress,
    stress_derivative,
)
from .points import Mesh, Rubber, beyond_derivative, beyond_stress, deformation_of, has_effects

# of kernels for many worlds: threads of a block, and blocks that a multiprocessor has registers for. Fewer
# threads would wait for memory, more have no room for what they hold
BOUNDS = 128, 3
# det F below which the line search rejects a step of rubber with friction elements, whose strain is isochoric
_FLAT = 0.02


class Kind(NamedTuple):
    """One kind of element, law and rubber, which has kernels of its own."""

    corners: int
    corotational: bool
    precision: Precision
    extended: bool  # by effects beyond the law, or a modulus that differs between elements

    @property
    def npoint(self) -> int:
        return 1 if self.corners == 4 else 4

    @property
    def averaged(self) -> bool:
        """Whether the mean dilatation of an element has a stiffness of its own."""
        return self.corners == 10

    @property
    def is_single(self) -> bool:
        return self.precision.name == "single"

    @property
    def module(self) -> str:
        law = "corotational" if self.corotational else "laws"
        rubber = "extended" if self.extended else "plain"
        return f"{__package__}.elements.{self.corners}_{law}_{self.precision.name}_{rubber}"

    def gradients(self, precision: Precision) -> type:
        """Type of the shape functions' gradients by parent coordinates."""
        return wp.types.matrix(shape=(self.corners, 3), dtype=precision.scalar)

    @property
    def placement(self) -> dict:
        """Module and launch bounds of a kernel for many worlds."""
        module = kernel_module(self.module, inlined=True)
        return {"module": module, "launch_bounds": BOUNDS if self.is_single else None}


@functools.cache
def material_functions(kind: Kind) -> types.SimpleNamespace:
    """Stress, its derivative and dilatation at an integration point."""
    corotational, averaged, extended = kind.corotational, kind.averaged, kind.extended
    scalar, vec, mat = kind.precision.scalar, kind.precision.vec, kind.precision.mat
    thin, wide = kind.precision.narrow, kind.precision.widen
    polar_thin = polar_single if kind.is_single else polar
    # no step ends with an inverted element: on CUDA registers matter more than the digits of its rotation
    polar_full = polar_upright if kind.is_single else polar
    deformation, sum_number = deformation_of(kind.corners), lane_sum(real, real)

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
    def averaged_pressure(
        excess: real, law: int, mesh: Mesh, x: wp.array2d(dtype=vec3), e: int, w: int, lane: int, lanes: int
    ):
        """Pressure of an element's mean dilatation, for the part `excess` of lambda that is not local
        [Pa]; summed by `lanes` threads."""
        mean = real(0.0)
        for q in range(lane, mesh.weight.shape[1], lanes):
            F = deformation(mesh, e, q, x, w)
            mean += mesh.weight[e, q] * theta(law, F, rotation(F))
        return excess * sum_number(mean, lanes) / mesh.volume[e]

    @wp.func
    def stress_of(
        rubber: Rubber, e: int, i: int, w: int, mu: real, lam: real, pressure: real, F: mat33, R: mat33
    ):
        """First Piola stress [Pa], with the pressure of the mean dilatation."""
        if wp.static(corotational):
            P = (mu + mu) * (F - R) + (lam * (wp.ddot(R, F) - real(3.0)) + pressure) * R
        else:
            P = stress(rubber.law, mu, lam, F, R)
            if wp.static(averaged):
                P += pressure * dilatation_gradient(rubber.law, F, R)
        if wp.static(extended):
            if has_effects(rubber, w):
                P += beyond_stress(rubber, e, i, w, mu, lam, F, R)
        return P + barrier_stress(rubber.law, mu, F)

    @wp.func
    def direction_of(law: int, F: mat, R: mat):
        """Derivative of the dilatation by F."""
        if wp.static(corotational):
            return R
        return thin(dilatation_gradient(law, wide(F), wide(R)))

    @wp.func
    def change_of(
        rubber: Rubber, e: int, i: int, w: int, mu: real, lam: real, pressure: real, F: mat, R: mat, dF: mat
    ):
        """Derivative of the stress along dF, at constant pressure of the mean dilatation."""
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
            if wp.static(extended):
                if has_effects(rubber, w):
                    dP += thin(beyond_derivative(rubber, e, i, w, mu, lam, wide(F), wide(R), wide(dF)))
            return dP + barrier_derivative(rubber.law, m, F, dF)
        D = wide(dF)
        Q = wide(R)
        G = wide(F)
        total = stress_derivative(rubber.law, mu, lam, G, Q, D)
        if wp.static(averaged):
            total += pressure * dilatation_hessian(rubber.law, G, Q, D)
        if wp.static(extended):
            if has_effects(rubber, w):
                total += beyond_derivative(rubber, e, i, w, mu, lam, G, Q, D)
        return thin(total) + barrier_derivative(rubber.law, scalar(mu), F, dF)

    @wp.func
    def weighted_volume(rubber: Rubber, mesh: Mesh, e: int, q: int, w: int):
        """Volume of point q times the element's factor on the modulus [m^3]."""
        if wp.static(extended):
            if rubber.modulus.shape[0] > 0:
                return mesh.weight[e, q] * rubber.modulus[e, w]
        return mesh.weight[e, q]

    @wp.func
    def local_lame(mu: real, lam: real, cap: real):
        if wp.static(averaged):
            return wp.min(lam, cap * mu)
        return lam

    @wp.func
    def flaw(rubber: Rubber, F: mat33):
        """Defect of a point: 2 inverted, 1 flatter than the law allows, 3 both. Small strain has none."""
        found = int(0)
        if rubber.law != Law.LINEAR:
            volume = wp.determinant(F)
            if not (volume > real(0.0)):
                found = 2
            if rubber.branch.shape[0] > 0 and rubber.law == Law.NEO_HOOKEAN and not (volume > real(_FLAT)):
                found += 1
        return found

    return types.SimpleNamespace(
        rotation=rotation,
        rotation_thin=rotation_thin,
        theta=theta,
        averaged_pressure=averaged_pressure,
        stress_of=stress_of,
        direction_of=direction_of,
        change_of=change_of,
        weighted_volume=weighted_volume,
        local_lame=local_lame,
        flaw=flaw,
    )
