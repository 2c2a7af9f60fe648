"""Linear tetrahedra against what they must do exactly, against scikit-fem, and against beams and spheres in
closed form."""

import numpy as np
import pytest
import skfem
from blocks import boundary, box, faces_on, nodal_areas, place, shell, skin
from forces import Elements
from skfem.helpers import ddot, identity, mul, sym_grad, trace, transpose

from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, step
from biotac_mj.skin.rubber.law import LAWS
from biotac_mj.skin.types import SINGLE

NOTHING = GeomSet([], [])
TIGHT = dict(max_newton=200, max_cg=200)


def block(
    law="corotational", E=1e6, nu=0.3, cells=4, size=1e-2, jitter=0.25, held=lambda v: v[:, 1] == 0, **options
):
    """An irregular cube of 10 mm, held at y = 0."""
    vert, elem = box([np.linspace(0, size, cells + 1)] * 3, jitter)
    return SkinModel(
        skin(vert, elem, np.flatnonzero(held(vert))),
        Material(law, E, nu),
        SkinOptions(**{**TIGHT, **options}),
    )


def forces(model, x):
    """Nodal elastic forces (nvert, 3) at positions x, and the elements, whose `product` is the tangent
    there."""
    elements = Elements(SkinData(model))
    return elements.force(x), elements


@pytest.mark.parametrize("law", LAWS)
def test_affine_displacements_go_on_inside(law):
    """An affine displacement of the boundary of an irregular block goes on inside, exactly."""
    vert, elem = box([np.linspace(0, 1e-2, 5)] * 3, jitter=0.3)
    outside = np.flatnonzero(np.isin(vert, [0, 1e-2]).any(1))
    model = SkinModel(
        skin(vert, elem, outside), Material(law, 1e6, 0.3), SkinOptions(tolerance=1e-5, **TIGHT)
    )
    data = SkinData(model)
    A = np.array([[0.05, 0.03, -0.02], [-0.04, -0.06, 0.01], [0.02, 0.05, 0.04]])
    place(data, outside, vert[outside] @ (np.eye(3) + A).T + 1e-3)
    step(model, data, NOTHING)
    assert data.converged.all()
    error = abs(data.vert_xpos[0] - (vert @ (np.eye(3) + A).T + 1e-3)).max()
    assert error < 1e-10 * 1e-2  # of the block's size: rounding, as the interpolation is exact


@pytest.mark.parametrize("law", [law for law in LAWS if law != "linear"])
def test_rigid_motion_makes_no_force(law):
    model = block(law)
    vert = model.geometry.vert
    Q, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))
    Q *= np.sign(np.linalg.det(Q))
    f, _ = forces(model, vert @ Q.T + 0.05)
    # 10 um of stretch make forces of about E L 1e-5 = 0.1 N; rounding of coordinates near 0.05 m leaves E L
    # eps
    assert abs(f).max() < 1e-10


@pytest.mark.parametrize("law", LAWS)
def test_hessian_at_rest_is_the_rest_stiffness(law):
    model = block(law)
    g, m = model.geometry, model.material
    K = model.elements.rest_stiffness(m.mu, m.lame)
    p = np.random.default_rng(0).standard_normal((g.nvert, 3))
    _, elements = forces(model, g.vert)
    np.testing.assert_allclose(
        elements.product(p).ravel(), K @ p.ravel(), rtol=0, atol=1e-10 * abs(K @ p.ravel()).max()
    )
    assert abs(K - K.T).max() < 1e-12 * abs(K).max()
    rigid = np.concatenate(
        [np.tile(np.eye(3), (g.nvert, 1)), np.concatenate([np.cross(np.eye(3), v).T for v in g.vert])], 1
    )
    assert abs(K @ rigid).max() < 1e-10 * abs(K).max()


@pytest.mark.parametrize("law", LAWS)
def test_forces_balance_and_hessian_is_their_derivative(law):
    model = block(law)
    rng = np.random.default_rng(1)
    x = model.geometry.vert * [1.2, 0.9, 1.1] + 2e-4 * rng.standard_normal((model.nvert, 3))
    p, q = rng.standard_normal((2, model.nvert, 3))
    f, elements = forces(model, x)
    size = abs(f).max()
    assert abs(f.sum(0)).max() < 1e-11 * size * len(f)
    if law != "linear":  # small strain has no torque balance about the deformed positions
        assert abs(np.cross(x, f).sum(0)).max() < 1e-11 * size * len(f) * 1e-2
    Kp = elements.product(p)
    h = 1e-8  # of the edges of 2.5 mm: fourth order differences, truncation (h/2.5e-3)^4, rounding 1e-16/1e-5
    near, far = [forces(model, x + s * p)[0] - forces(model, x - s * p)[0] for s in (h, 2 * h)]
    fd = -(8 * near - far) / (12 * h)
    np.testing.assert_allclose(Kp, fd, rtol=0, atol=1e-7 * abs(Kp).max())
    assert np.vdot(q, Kp) == pytest.approx(np.vdot(p, elements.product(q)), rel=1e-10)


@pytest.mark.parametrize("law", LAWS)
def test_directions_in_single_precision(law):
    """The tangent that CUDA and the dense preconditioner use, to the digits of single precision."""
    model = block(law)
    rng = np.random.default_rng(1)
    x = model.geometry.vert * [1.2, 0.9, 1.1] + 2e-4 * rng.standard_normal((model.nvert, 3))
    p = rng.standard_normal((model.nvert, 3))
    data = SkinData(model)
    double, single = Elements(data), Elements(data, SINGLE)
    force = double.force(x)  # to double precision both, by other ways to the rotation
    np.testing.assert_allclose(single.force(x), force, rtol=0, atol=1e-11 * abs(force).max())
    Kp = double.product(p)
    np.testing.assert_allclose(single.product(p), Kp, rtol=0, atol=1e-5 * abs(Kp).max())


# --- scikit-fem  ---


def skfem_basis(vert, elem):
    mesh = skfem.MeshTet(vert.T.copy(), elem.T.astype(np.int64).copy())
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP1()))
    # scikit-fem may number nodes in its own way: nodal_dofs[c, i] of the mesh's vertex i
    assert np.array_equal(mesh.p.T, vert)
    return basis, basis.nodal_dofs


def body_force(basis, dofs, density):
    load = skfem.LinearForm(lambda v, w: density[0] * v[0] + density[1] * v[1] + density[2] * v[2]).assemble(
        basis
    )
    return load, load[dofs].T


@skfem.BilinearForm
def linear_form(u, v, w):
    e = sym_grad(u)
    return w["lam"] * trace(e) * trace(sym_grad(v)) + 2 * w["mu"] * ddot(e, sym_grad(v))


def test_linear_elasticity_equals_scikit_fem():
    model = block("linear", tolerance=1e-8)
    g, m = model.geometry, model.material
    basis, dofs = skfem_basis(g.vert, g.elem)
    load, nodal = body_force(basis, dofs, [2e5, -4e5, 1e5])
    K = linear_form.assemble(basis, lam=m.lame, mu=m.mu)
    u = skfem.solve(*skfem.condense(K, load, D=dofs[:, model.fixed].ravel()))[dofs].T
    data = SkinData(model)
    data.set_external(nodal[None])
    step(model, data, NOTHING)
    assert data.converged.all()
    ours = data.vert_xpos[0] - g.vert
    np.testing.assert_allclose(
        ours, u, rtol=0, atol=1e-6 * abs(u).max()
    )  # the solver's tolerance 1e-8 times its margin
    np.testing.assert_allclose(data.reaction[0], -nodal.sum(0), rtol=1e-6)


def first_piola(law, mu, lam, F):
    """P(F) written with scikit-fem's helpers: independent of the kernels."""
    if law == "svk":
        E = 0.5 * (mul(transpose(F), F) - identity(F))
        return mul(F, lam * trace(E) * identity(F) + 2 * mu * E)
    J = np.linalg.det(np.moveaxis(F, (0, 1), (-2, -1)))
    G = np.moveaxis(np.linalg.inv(np.moveaxis(F, (0, 1), (-2, -1))), (-2, -1), (1, 0))
    kappa = lam + 2 / 3 * mu
    return mu * J ** (-2 / 3) * (F - ddot(F, F) / 3 * G) + kappa * (J - 1) * J * G


def skfem_newton(law, basis, dofs, load, fixed, mu, lam):
    """Newton's method with scikit-fem; the tangent by complex steps of P, so that no derivative is shared
    with the kernels."""

    def gradient(w):
        return w["u"].grad + identity(w["u"].grad)

    @skfem.LinearForm
    def residual(v, w):
        return ddot(first_piola(law, mu, lam, gradient(w)), v.grad)

    @skfem.BilinearForm
    def tangent(du, v, w):
        return ddot(np.imag(first_piola(law, mu, lam, gradient(w) + 1e-30j * du.grad)) / 1e-30, v.grad)

    u = basis.zeros()
    held = dofs[:, fixed].ravel()
    for share in np.linspace(0, 1, 5)[1:]:
        for _ in range(20):
            r = share * load - residual.assemble(basis, u=basis.interpolate(u))
            r[held] = 0
            if abs(r).max() < 1e-12 * abs(load).max():
                break
            u += skfem.solve(*skfem.condense(tangent.assemble(basis, u=basis.interpolate(u)), r, D=held))
        else:
            raise AssertionError("scikit-fem's Newton did not converge")
    return u[dofs].T


@pytest.mark.law
@pytest.mark.parametrize("law", ["svk", pytest.param("neo_hookean", marks=pytest.mark.slow)])
def test_hyperelasticity_equals_scikit_fem(law):
    model = block(law, cells=3, tolerance=1e-7)
    g, m = model.geometry, model.material
    basis, dofs = skfem_basis(g.vert, g.elem)
    load, nodal = body_force(basis, dofs, [1.5e7, 2e7, -0.5e7])
    u = skfem_newton(law, basis, dofs, load, model.fixed, m.mu, m.lame)
    data = SkinData(model)
    for share in (0.5, 1.0):
        data.set_external(share * nodal[None])
        step(model, data, NOTHING)
        assert data.converged.all()
    assert abs(u).max() > 2e-3  # a fifth of the block's size: far from linear
    np.testing.assert_allclose(data.vert_xpos[0] - g.vert, u, rtol=0, atol=1e-5 * abs(u).max())


# --- closed forms  ---


def cantilever_tip(n, length=50e-3, height=10e-3, force=1e-3, E=1e6):
    """Tip deflection of a cantilever of square section with n cells across the height."""
    vert, elem = box([np.linspace(0, length, 5 * n + 1)] + [np.linspace(0, height, n + 1)] * 2)
    model = SkinModel(
        skin(vert, elem, np.flatnonzero(vert[:, 0] == 0)),
        Material("linear", E, 0.0),
        SkinOptions(tolerance=1e-6, **TIGHT),
    )
    data = SkinData(model)
    weight = nodal_areas(vert, faces_on(vert, boundary(elem), 0, length)) / height**2
    load = np.zeros((1, len(vert), 3))
    load[0, :, 1] = -force * weight
    data.set_external(load)
    step(model, data, NOTHING)
    assert data.converged.all()
    return -(weight * (data.vert_xpos[0] - vert)[:, 1]).sum()


def test_cantilever_converges_to_timoshenko():
    """nu = 0, so that the clamp is the beam theory's; linear tetrahedra converge from the stiff side with the
    square of their size."""
    length, height, force, E = 50e-3, 10e-3, 1e-3, 1e6
    inertia, shear = height**4 / 12, 5 / 6 * height**2 * E / 2
    exact = force * length**3 / (3 * E * inertia) + force * length / shear
    tips = np.array([cantilever_tip(n) for n in (2, 4, 8)])
    assert (np.diff(tips) > 0).all() and tips[-1] < exact
    errors = 1 - tips / exact
    order = np.log2(errors[:-1] / errors[1:])
    assert order[0] < order[1] and 1.7 < order[1] < 2.1, (order, errors)  # 2 in the limit
    assert errors[-1] < 0.06
    extrapolated = tips[2] + (tips[2] - tips[1]) / 3
    assert extrapolated == pytest.approx(exact, rel=0.01)


def test_a_bar_under_traction_strains_uniformly():
    """Uniaxial traction: strain p / E along, -nu p / E across, at any point but near no clamp: the held nodes
    go where they belong."""
    p, E, nu = 1e3, 1e6, 0.45
    vert, elem = box([np.linspace(0, 2e-2, 7), np.linspace(0, 1e-2, 4), np.linspace(0, 1e-2, 4)], jitter=0.2)
    corners = np.flatnonzero((vert[:, 0] == 0) & np.isin(vert[:, 1:], [0, 1e-2]).all(1))
    strain = np.array([p / E, -nu * p / E, -nu * p / E])
    model = SkinModel(
        skin(vert, elem, corners), Material("linear", E, nu), SkinOptions(tolerance=1e-8, **TIGHT)
    )
    data = SkinData(model)
    place(data, corners, vert[corners] * (1 + strain))
    face, load = boundary(elem), np.zeros((1, len(vert), 3))
    for sign, x in ((-1, 0.0), (1, 2e-2)):
        load[0, :, 0] += sign * p * nodal_areas(vert, faces_on(vert, face, 0, x))
    data.set_external(load)
    step(model, data, NOTHING)
    np.testing.assert_allclose(data.vert_xpos[0] - vert, vert * strain, rtol=0, atol=1e-6 * 2e-2 * strain[0])
    cauchy, mises = data.stress()
    np.testing.assert_allclose(mises[0], p, rtol=5e-3)  # Cauchy stress sees the strain of 1e-3 in the area


def lame_sphere(a, b, p, E, nu, r):
    """Radial displacement of a thick sphere under internal pressure (Timoshenko and Goodier, section 136)."""
    return p * a**3 / (E * (b**3 - a**3)) * ((1 - 2 * nu) * r + (1 + nu) * b**3 / (2 * r**2))


def sphere_errors(nu, subdivisions, layers):
    """Relative errors of the growth of a pressurised sphere at its inner and outer radius."""
    a, b, p, E = 6e-3, 10e-3, 1e3, 1e6
    vert, elem, inner = shell(b, a, subdivisions, layers)
    radius = np.linalg.norm(vert, axis=1)
    exact = vert / radius[:, None] * lame_sphere(a, b, p, E, nu, radius)[:, None]
    held = [
        np.linalg.norm(vert - b * axis, axis=1).argmin() for axis in np.eye(3)
    ]  # they go where they belong: no other force
    model = SkinModel(skin(vert, elem, held), Material("linear", E, nu), SkinOptions(tolerance=1e-5, **TIGHT))
    data = SkinData(model)
    place(data, held, (vert + exact)[held])
    edge = vert[inner[:, 1:]] - vert[inner[:, :1]]
    load = np.zeros((1, len(vert), 3))
    np.add.at(
        load[0], inner.ravel(), np.repeat(-p * np.cross(edge[:, 0], edge[:, 1]) / 6, 3, axis=0)
    )  # normals point into the cavity
    data.set_external(load)
    step(model, data, NOTHING)
    assert data.converged.all()
    errors = []
    for r in (a, b):
        here = abs(radius - r) < 1e-9
        errors.append(
            ((data.vert_xpos[0] - vert)[here] * vert[here] / r).sum(1).mean() / lame_sphere(a, b, p, E, nu, r)
            - 1
        )
    return np.abs(errors)


# 2 % is what good codes accept; nearly incompressible, linear tetrahedra are a little too stiff still with
# six layers
@pytest.mark.parametrize("nu, tolerance", [pytest.param(0.3, 0.02, marks=pytest.mark.slow), (0.45, 0.03)])
def test_thick_sphere_under_pressure(nu, tolerance):
    coarse, fine = sphere_errors(nu, 2, 3), sphere_errors(nu, 3, 6)
    assert (fine < tolerance).all(), fine
    assert (coarse > 2.5 * fine).all(), (coarse, fine)  # towards the square of the size: 4


@pytest.mark.parametrize("change, text", [
    (lambda v, e: (v, np.concatenate([e[:1, [0, 2, 1, 3]], e[1:]])), "1 of 384 tetrahedra are inverted or "
                                                                     "degenerate .first: 0, volume -"),
    (lambda v, e: (v * [1, 1, 0], e), "384 of 384 tetrahedra are inverted or degenerate .*repair the mesh "
                                      "or swap two nodes"),
    (lambda v, e: (np.where(np.arange(len(v))[:, None] == 3, np.nan, v), e), "skin 'block' has 1 nodes that "
                                                                             "are NaN or infinite: repair"),
])  # fmt: skip
def test_bad_meshes_are_refused(change, text):
    vert, elem = change(*box([np.linspace(0, 1e-2, 5)] * 3))
    with pytest.raises(ValueError, match=text):
        SkinModel(skin(vert, elem, [0, 1, 2], outer_face=[[0, 1, 2]]))


def test_a_skin_without_fixed_nodes_is_refused():
    vert, elem = box([np.linspace(0, 1e-2, 3)] * 3)
    with pytest.raises(
        ValueError,
        match="skin 'block' has no fixed nodes: it would float away; fix those on core, nail and clamp",
    ):
        SkinModel(skin(vert, elem, []))


@pytest.mark.parametrize("force, text", [
    (np.zeros((1, 5, 3)), r"external forces have shape \(1, 5, 3\): pass finite numbers of shape \(1, 125, "
                          r"3\)"),
    (np.full((1, 125, 3), np.nan), "pass finite numbers"),
])  # fmt: skip
def test_bad_loads_are_refused(force, text):
    with pytest.raises(ValueError, match=text):
        SkinData(block()).set_external(force)
