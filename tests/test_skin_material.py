"""The laws against finite differences of their energies, closed forms and rotation."""

import numpy as np
import pytest
import warp as wp
from blocks import box, place, skin
from forces import energy_of
from scipy.linalg import polar as scipy_polar
from scipy.optimize import brentq

from biotac_mj.skin import PRESETS, GeomSet, Material, SkinData, SkinModel, SkinOptions, material, step
from biotac_mj.skin.program import Launcher
from biotac_mj.skin.rubber.element_forces import ElementForces
from biotac_mj.skin.rubber.law import LAWS, polar, polar_single
from biotac_mj.skin.rubber.points import Rubber
from biotac_mj.skin.rubber.tetrahedra import Tetrahedra
from biotac_mj.skin.types import DOUBLE, mat33, narrow, real, vec3, widen

MU, LAM = 1.3, 2.1


class Law:
    """Energy, stress and its derivative for many deformation gradients at once: unit tetrahedra whose edges
    are the columns of F."""

    def __init__(self, name):
        self.law = LAWS[name]

    def _parts(self, n):
        """Unit tetrahedra, each with nodes of its own, and their rubber."""
        vert = np.tile(np.concatenate([np.zeros((1, 3)), np.eye(3)]), (n, 1))
        elem = np.arange(4 * n, dtype=np.int32).reshape(n, 4)
        tetrahedra = Tetrahedra(vert, elem, self.law, wp.get_device("cpu"))
        rubber = Rubber()
        rubber.law = self.law
        rubber.mu, rubber.lam = wp.array([MU], dtype=real), wp.array([LAM], dtype=real)
        return tetrahedra, rubber

    @staticmethod
    def _array(F):
        x = np.zeros((len(F), 4, 3))
        x[:, 1:] = np.swapaxes(F, 1, 2)
        return wp.array(x.reshape(-1, 1, 3), dtype=vec3, ndim=2)

    def energy(self, F):
        tetrahedra, rubber = self._parts(len(F))
        return 6 * energy_of(tetrahedra, rubber, (), self._array(F))[:, 0]  # of a volume of 1 / 6

    def stress(self, F, dF=None):
        elements, n, launcher = ElementForces(*self._parts(len(F)), (), DOUBLE), len(F), Launcher("cpu")
        on, inverted = (wp.full(1, k, dtype=int) for k in (1, 0))
        elements.evaluate_corners(launcher, self._array(F), on, inverted)
        corner = -6 * elements.corner_force.numpy()
        if dF is not None:
            elements.multiply_corners(launcher, self._array(F), self._array(dF), on)
            corner = 6 * elements.corner.numpy()
        return np.swapaxes(corner[:, 0].reshape(n, 4, 3)[:, 1:], 1, 2)


def gradients(law, rng, n=40):
    """Random deformation gradients: near rest, strongly deformed, and inverted where the law allows it."""
    mild = np.eye(3) + 0.1 * rng.standard_normal((n, 3, 3))
    strong = np.eye(3) + 0.6 * rng.standard_normal((20 * n, 3, 3))
    singular = np.linalg.svd(strong)[1]
    det = np.linalg.det(strong)
    upright = strong[(det > 0.3) & (singular[:, 2] > 0.2)][:n]
    if law == "neo_hookean":
        return np.concatenate([mild, upright])
    # the corotational law's rotation is not unique where the two smallest singular values of an inverted F
    # are equal
    inverted = strong[(det < -0.2) & (singular[:, 1] - singular[:, 2] > 0.2)][:n]
    return np.concatenate([mild, upright, inverted])


def central(f, h):
    """Derivative at zero of f by central differences of fourth order: with h = 1e-3 truncation and rounding
    are both about 1e-11."""
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)


@wp.kernel(enable_backward=False)
def rotate(F: wp.array(dtype=mat33), double_out: wp.array(dtype=mat33), single_out: wp.array(dtype=mat33)):
    i = wp.tid()
    double_out[i] = polar(F[i])
    single_out[i] = widen(polar_single(narrow(F[i])))


def test_rotations_equal_scipys():
    """Also of inverted gradients, of which scipy's has a reflection: there the smallest singular vector
    turns."""
    F = gradients("corotational", np.random.default_rng(7))
    u, s, vt = np.linalg.svd(F)
    u[:, :, 2] *= np.sign(np.linalg.det(F))[:, None]
    expected = u @ vt
    upright = np.linalg.det(F) > 0
    np.testing.assert_allclose(expected[upright], [scipy_polar(f)[0] for f in F[upright]], atol=1e-13)
    double, single = (wp.zeros(len(F), dtype=mat33) for _ in range(2))
    wp.launch(rotate, len(F), [wp.array(F, dtype=mat33)], [double, single])
    # in single precision, where rotations only steer, some inverted ones are a little off
    np.testing.assert_allclose(single.numpy()[upright], expected[upright], atol=1e-6)
    assert np.quantile(abs(single.numpy() - expected).max((1, 2)), 0.9) < 1e-5
    np.testing.assert_allclose(double.numpy(), expected, atol=2e-12)


@pytest.mark.parametrize("law", LAWS)
def test_stress_is_the_energys_gradient(law):
    rng = np.random.default_rng(1)
    F = gradients(law, rng)
    dF = rng.standard_normal(F.shape)
    expected = central(lambda s: Law(law).energy(F + s * dF), 1e-3)
    work = np.einsum("nij,nij->n", Law(law).stress(F), dF)
    np.testing.assert_allclose(
        work, expected, rtol=1e-7, atol=1e-7 * abs(expected).max()
    )  # fp64, see `central`


@pytest.mark.parametrize("law", LAWS)
def test_the_tangent_is_the_derivative_of_stress(law):
    rng = np.random.default_rng(2)
    F = gradients(law, rng)
    dF = rng.standard_normal(F.shape)
    dF /= np.linalg.norm(dF, axis=(1, 2), keepdims=True)
    expected = central(lambda s: Law(law).stress(F + s * dF), 1e-3)
    scale = np.linalg.norm(expected, axis=(1, 2))
    error = np.linalg.norm(Law(law).stress(F, dF) - expected, axis=(1, 2)) / scale
    assert error.max() < 1e-7


@pytest.mark.parametrize("law", LAWS)
def test_derivative_is_symmetric(law):
    rng = np.random.default_rng(3)
    F = gradients(law, rng)
    a, b = rng.standard_normal((2, *F.shape))
    one = np.einsum("nij,nij->n", Law(law).stress(F, a), b)
    other = np.einsum("nij,nij->n", Law(law).stress(F, b), a)
    np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10 * abs(one).max())


@pytest.mark.parametrize("law", [law for law in LAWS if law != "linear"])
def test_rotation_turns_the_stress(law):
    rng = np.random.default_rng(4)
    F = gradients(law, rng)
    Q, _ = np.linalg.qr(rng.standard_normal(F.shape))
    Q *= np.sign(np.linalg.det(Q))[:, None, None]
    np.testing.assert_allclose(Law(law).energy(Q @ F), Law(law).energy(F), rtol=1e-10)
    np.testing.assert_allclose(Law(law).stress(Q @ F), Q @ Law(law).stress(F), atol=1e-9)


def test_all_laws_agree_at_small_strain():
    """One linearisation: with kappa = lambda + 2/3 mu for the isochoric split."""
    strain = 1e-6 * np.random.default_rng(5).standard_normal((10, 3, 3))
    strain = (strain + np.swapaxes(strain, 1, 2)) / 2
    trace = np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    for law in LAWS:
        lame = LAM - 2 / 3 * MU if law == "neo_hookean" else LAM
        # what differs is of second order: some ten products of two strains of up to 3e-6
        np.testing.assert_allclose(
            Law(law).stress(np.eye(3) + strain), lame * trace + 2 * MU * strain, atol=1e-10
        )


def neo_hookean_cauchy(stretch, mu, kappa):
    """Principal Cauchy stresses: Holzapfel, Nonlinear Solid Mechanics, eqs 6.84-6.86 with this volumetric
    energy."""
    J = np.prod(stretch)
    return mu * J ** (-5 / 3) * (stretch**2 - np.mean(stretch**2)) + kappa * (J - 1)


@pytest.mark.parametrize("held", [[0], [0, 1]], ids=["uniaxial", "equibiaxial"])
@pytest.mark.parametrize("stretch", [0.6, 1.8])
def test_neo_hookean_block_at_large_strain(held, stretch):
    """Drawn by the faces along the held axes, the rest finds the stretch that is free of stress: a scalar
    root."""
    rubber = Material("neo_hookean", 1e6, 0.4)
    free = [i for i in range(3) if i not in held]

    def solution(stretch):
        def stretches(other):
            return np.array([stretch if i in held else other for i in range(3)])

        other = brentq(
            lambda s: neo_hookean_cauchy(stretches(s), rubber.mu, rubber.bulk)[free[0]], 0.3, 3, xtol=1e-14
        )
        return stretches(other), neo_hookean_cauchy(stretches(other), rubber.mu, rubber.bulk)

    vert, elem = box([np.linspace(0, 1, 5)] * 3, jitter=0.2)
    fixed = np.flatnonzero(np.isin(vert[:, held], [0, 1]).any(1))
    data = SkinData(SkinModel(skin(vert, elem, fixed), rubber, SkinOptions(tolerance=1e-4, max_newton=100)))
    nothing = GeomSet([], [])
    for now in np.linspace(1, stretch, 9)[1:]:
        stretches, cauchy = solution(now)
        place(data, fixed, vert[fixed] * stretches)
        step(data.model, data, nothing)
        assert data.converged.all()
    # without load the solver's tolerance is absolute, 1e-10 of the square root of the energy: displacements
    # to about 1e-9
    np.testing.assert_allclose(data.vert_xpos[0], vert * stretches, atol=1e-8)
    sigma, mises = data.stress()
    exact = 1e-6 * rubber.youngs_modulus
    np.testing.assert_allclose(sigma[0], np.broadcast_to(np.diag(cauchy), sigma[0].shape), atol=exact)
    np.testing.assert_allclose(mises, abs(cauchy[held[0]] - cauchy[free[0]]), atol=exact)
    # the forces that hold the faces do the first Piola-Kirchhoff stress' virtual work: sum f X^T = P V, in a
    # unit cube
    nominal = -np.einsum("ni,nj->ij", data.force.numpy()[fixed, 0], vert[fixed])
    np.testing.assert_allclose(nominal, np.diag(np.prod(stretches) * cauchy / stretches), atol=exact)


def test_bulk_and_shear_modulus():
    m = Material(youngs_modulus=9e5, poissons_ratio=0.25)
    # E = 9 K mu / (3 K + mu), lambda = K - 2/3 mu
    assert 9 * m.bulk * m.mu / (3 * m.bulk + m.mu) == pytest.approx(9e5)
    assert m.lame == pytest.approx(m.bulk - 2 / 3 * m.mu)


@pytest.mark.parametrize("values, text", [
    (dict(law="steel"), "unknown material law 'steel': choose one of corotational, svk, neo_hookean, linear"),
    (dict(poissons_ratio=0.5), "outside .-1, 0.5.: an incompressible rubber needs nu below 0.5"),
    (dict(poissons_ratio=-1.0), "outside .-1, 0.5."),
    (dict(youngs_modulus=float("nan")), "youngs_modulus is nan: pass a finite number"),
    (dict(youngs_modulus=0.0), "must be from 100"),
    (dict(youngs_modulus=0.65), r"0.65 Pa must be from 100 to 1e.15 .give it in Pa: 0.65 MPa is 650000"),
    (dict(density=-1.0), "must be from 100"),
    (dict(friction=-0.1), "material friction is -0.1: give a finite number >= 0"),
])  # fmt: skip
def test_bad_constants_are_refused(values, text):
    with pytest.raises(ValueError, match=text):
        Material(**values)


def test_presets_are_found_by_name():
    assert material("paper") is PRESETS["paper"]
    assert not material("paper").liquid
    with pytest.raises(
        ValueError,
        match="unknown material 'jelly': choose one of default, paper, rubber, .*or pass a Material",
    ):
        material("jelly")
