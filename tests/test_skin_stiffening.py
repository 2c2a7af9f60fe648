"""Stiffening of every law: Yeoh's closed forms in large strain, forces against differences of an energy
written down here, robustness."""

import dataclasses

import numpy as np
import pytest
from bars import NOTHING, E, bar, batch, cube, deform, pull, pull_worlds
from blocks import box, skin
from forces import Elements, gradients
from grids import covering
from scipy.linalg import polar
from scipy.optimize import minimize

from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, step
from biotac_mj.skin.rubber.law import LAWS

PATH = (1.05, 1.1, 1.15, 1.12)  # stretches of a bar, whose elements at the end bear each jump first


def invariant(law, F):
    """q of `stiffening.py`: 2 |dev A|^2 of the law's strain, the isochoric first invariant less 3 for
    neo_hookean."""
    eye = np.eye(3)
    if law == "neo_hookean":
        return np.linalg.det(F) ** (-2 / 3) * np.sum(F * F, axis=(-2, -1)) - 3
    C = np.swapaxes(F, -1, -2) @ F
    if law == "corotational":
        A = np.array([polar(f)[1] for f in F.reshape(-1, 3, 3)]).reshape(F.shape) - eye
    else:
        A = (C - eye) / 2 if law == "svk" else (F + np.swapaxes(F, -1, -2)) / 2 - eye
    deviator = A - np.trace(A, axis1=-2, axis2=-1)[..., None, None] / 3 * eye
    return 2 * np.sum(deviator**2, axis=(-2, -1))


def beyond(s, q):
    """Energy over mu / 2 beyond q."""
    return s * q**2 if s >= 0 else (np.sqrt(1 - 4 * s * q) - 1) / (-2 * s) - q


@pytest.mark.parametrize("element, s", covering(["linear", "quadratic"], [0.0, 0.7, -0.4]))
def test_uniaxial_and_equibiaxial_rubber(element, s):
    """Differences of Cauchy stress of an isochoric stretch: mu (a^2 - b^2) h'(I1 - 3), with Yeoh's h' = 1 + 2
    s (I1 - 3)."""
    model = cube("neo_hookean", element, nu=0.45, stiffening=s)
    data, mu = SkinData(model), model.material.mu
    for stretch in (0.6, 0.9, 1.3, 1.8):
        for F in (np.diag([stretch, stretch**-0.5, stretch**-0.5]), np.diag([stretch, stretch, stretch**-2])):
            q = np.trace(F @ F) - 3
            growth = 1 + 2 * s * q if s >= 0 else (1 - 4 * s * q) ** -0.5
            cauchy = deform(model, data, F, None) @ F
            for i in (0, 1):
                expected = mu * (F[i, i] ** 2 - F[2, 2] ** 2) * growth
                assert cauchy[i, i] - cauchy[2, 2] == pytest.approx(expected, rel=1e-8, abs=1e-6 * mu)


@pytest.mark.parametrize("s, t", [(0.5, 1.2e6), (0.5, -1.2e6), (-0.4, 0.2e6)])
def test_a_bar_with_free_sides(s, t):
    """Pulled by a traction t: the stretches (a, b, b) that make W - t a least, found here by themselves, bear
    t, nothing aside."""
    model = cube("neo_hookean", "quadratic", nu=0.4, stiffening=s)
    mu, kappa = model.material.mu, model.material.bulk

    def energy(ab):
        a, b = ab
        J = a * b * b
        q = J ** (-2 / 3) * (a * a + 2 * b * b) - 3
        return (mu / 2 * (q + beyond(s, q)) + kappa / 2 * (J - 1) ** 2 - t * a) / mu

    a, b = minimize(
        energy, [1.0, 1.0], method="Nelder-Mead", options={"xatol": 1e-11, "fatol": 1e-15, "maxiter": 4000}
    ).x
    assert abs(a - 1) > 0.25
    P = deform(model, SkinData(model), np.diag([a, b, b]), None)
    assert P[0, 0] == pytest.approx(t, rel=1e-5) and abs(P[1, 1]) < 1e-5 * abs(t)


@pytest.mark.parametrize("element, law", covering(["linear", "quadratic"], LAWS))
@pytest.mark.parametrize("s", [0.9, -0.5])
def test_force_is_the_energys_gradient(law, element, s):
    model = cube(law, element, stiffening=s)
    plain, rng = cube(law, element), np.random.default_rng(6)
    rest = model.geometry.vert
    x = rest @ (np.eye(3) + 0.25 * rng.standard_normal((3, 3))).T + 1e-4 * rng.standard_normal(rest.shape)
    p = 1e-4 * rng.standard_normal(rest.shape)

    def energy(h):
        F, volume = gradients(model.elements, x + h * p)
        return volume @ (model.material.mu / 2 * beyond(s, invariant(law, F)))

    h = 1e-2
    expected = -(8 * (energy(h) - energy(-h)) - (energy(2 * h) - energy(-2 * h))) / (12 * h)
    force = Elements(SkinData(model)).force(x) - Elements(SkinData(plain)).force(x)
    assert np.vdot(force, p) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("law", LAWS)
def test_small_strains_do_not_stiffen(law):
    """Twice the strain, twice the stress, to second order in the strain: the same tangent at rest."""
    F = np.eye(3) + 1e-5 * np.random.default_rng(7).standard_normal((3, 3))
    plain, stiff = (
        deform(m, SkinData(m), F, None) for m in (cube(law, "linear"), cube(law, "linear", stiffening=1.5))
    )
    np.testing.assert_allclose(stiff, plain, atol=1e-8 * abs(plain).max())


@pytest.mark.parametrize("law, s", covering(["corotational", "neo_hookean"], [1.5, -0.5]))
def test_absurd_presses_leave_a_sound_state(law, s):
    """A ball pushed at once through nearly the whole slab: whatever becomes of the step, no NaN, no inverted
    element called a balance."""
    vert, elem = box([np.linspace(0, 1e-2, 4), np.linspace(0, 4e-3, 3), np.linspace(0, 1e-2, 4)])
    material = Material(law, E, 0.45, stiffening=s, friction=0.3)
    model = SkinModel(
        skin(vert, elem, np.flatnonzero(vert[:, 1] == 0)),
        material,
        SkinOptions(element="quadratic", liquid=False),
    )
    data, ball = SkinData(model), GeomSet(["sphere"], [(3e-3, 0, 0)])
    forces = []
    for depth in (-0.1e-3, 0.5e-3, 3.6e-3, 0.5e-3):
        ball.set_pose(np.array([[5e-3, 7e-3 - depth, 5e-3]]), np.eye(3)[None])
        step(model, data, ball)
        assert np.isfinite(data.vert_xpos).all() and np.isfinite(data.force.numpy()).all()
        F, _ = gradients(model.elements, data.vert_xpos[0])
        assert not data.converged[0] or np.linalg.det(F).min() > 0
        forces.append(data.wrench[0, 0, 1] if data.converged[0] else None)
    assert forces[0] == 0 and forces[1] == pytest.approx(forces[3], rel=0.02) and forces[3] > 0.1


def test_without_stiffening_nothing_is_added():
    assert SkinData(cube("corotational", "linear")).memory is None
    assert Material(stiffening=0).extensions == () and Material(stiffening=0.2).extensions == ("stiffening",)
    assert not Material(stiffening=0.2).remembers


@pytest.mark.parametrize("element, law", covering(["linear", "quadratic"], ["corotational", "neo_hookean"]))
def test_worlds_stiffen_each_its_own_way(law, element):
    """Without, Yeoh's and Knowles's rubber in one batch."""
    model = bar(law, element, nu=0.4, stiffening=0.7)
    materials = [dataclasses.replace(model.material, stiffening=s) for s in (0.0, 0.7, -0.4)]
    together, alone, own = batch(model, materials, lambda m, data: [pull_worlds(m, data, s) for s in PATH])
    peak = abs(together).max()
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-9 * peak)
    np.testing.assert_allclose(together, own, rtol=0, atol=1e-6 * peak)  # of models: the solver's tolerance
    assert abs(np.diff(together, axis=1)).max() > 0.01 * peak


@pytest.mark.parametrize("law", LAWS)
def test_directions_in_single_precision(law):
    """The same answer with those of CUDA."""
    model = bar(law, "quadratic", nu=0.4, stiffening=0.7)
    data = [SkinData(model, preconditioner=p) for p in ("sparse", "dense")]
    force = np.array([[pull(model, d, s, None) for s in PATH] for d in data])
    np.testing.assert_allclose(force[1], force[0], rtol=0, atol=1e-4 * abs(force).max())
    assert all(d.iterations[0] > 0 for d in data)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="stiffening is nan: pass a finite number"):
        Material(stiffening=np.nan)
    model = cube("corotational", "linear", stiffening=0.3)
    plain = cube("corotational", "linear")
    with pytest.raises(ValueError, match="a world's material has stiffening and the model's has not"):
        SkinData(plain, material=[model.material])
    from biotac_mj.skin.condensed import CondensedSkin

    with pytest.raises(ValueError, match="condensed tier is elastic: leave stiffening out"):
        CondensedSkin(model, NOTHING)
