"""Quadratic tetrahedra: their derivatives, what they must do exactly, other codes' answers, and rubber that must not lock."""

import numpy as np
import pytest
import skfem
import warp as wp
from blocks import box, skin
from skfem.helpers import ddot, div, sym_grad

from biotac_mj.skin import Material, SkinData, SkinModel, SkinOptions
from biotac_mj.skin.data import view
from biotac_mj.skin.material import LAWS
from biotac_mj.skin.quadratic import QuadraticTetrahedra, quadratic
from biotac_mj.skin.types import vec3

TIGHT = dict(max_newton=200, max_cg=200)
CPU = wp.get_device("cpu")


def block(law, nu=0.3, cells=2, jitter=0.25, **options):
    vert, elem = box([np.linspace(0, 1e-2, cells + 1)] * 3, jitter)
    geometry = skin(vert, elem, np.flatnonzero(vert[:, 1] == 0))
    return SkinModel(geometry, Material(law, 1e6, nu), SkinOptions(element="quadratic", **{**TIGHT, **options}))


def state(model, amplitude=4e-4, seed=0):
    """Data at a random deformation."""
    data = SkinData(model)
    view(data.x)[:, 0] += amplitude * np.random.default_rng(seed).uniform(-1, 1, (model.nvert, 3))
    return data


def force(model, data, x):
    view(data.x)[:, 0] = x
    model.elasticity.force(data.elastic, data.mu, data.lam, data.x, data.force)
    return data.force.numpy()[:, 0].copy()


@pytest.mark.parametrize("nu", [0.3, 0.4999])  # full integration, and mostly mean dilatation
@pytest.mark.parametrize("law", LAWS)
def test_derivatives(law, nu):
    """Force is minus the energy's gradient, the product is the force's derivative: central differences along a random direction."""
    model = block(law, nu)
    data = state(model)
    x, h = data.x.numpy()[:, 0].copy(), 1e-8
    p = np.random.default_rng(1).standard_normal(x.shape)
    energy = []
    for sign in (1, -1):
        view(data.x)[:, 0] = x + sign * h * p
        energy.append(model.elasticity.energy(data.mu, data.lam, data.x).sum())
    slope, work = (energy[0] - energy[1]) / (2 * h), -(force(model, data, x) * p).sum()
    assert work == pytest.approx(slope, rel=1e-6)
    change = (force(model, data, x + h * p) - force(model, data, x - h * p)) / (2 * h)
    force(model, data, x)
    model.elasticity.product(data.elastic, data.mu, data.lam, data.x, wp.array(p[:, None], dtype=vec3, ndim=2), data.product)
    product = data.product.numpy()[:, 0]
    assert abs(product + change).max() < 1e-6 * abs(change).max()


@pytest.mark.parametrize("nu", [0.3, 0.4999])
@pytest.mark.parametrize("law", LAWS)
def test_rest_stiffness(law, nu):
    """The assembled matrix is the tangent at rest, so that it can precondition."""
    model = block(law, nu)
    data = SkinData(model)
    force(model, data, model.geometry.vert)
    p = np.random.default_rng(2).standard_normal((model.nvert, 3))
    model.elasticity.product(data.elastic, data.mu, data.lam, data.x, wp.array(p[:, None], dtype=vec3, ndim=2), data.product)
    wanted = (model.elasticity.rest_stiffness(model.material.mu, model.material.lame) @ p.ravel()).reshape(-1, 3)
    assert abs(data.product.numpy()[:, 0] - wanted).max() < 1e-10 * abs(wanted).max()


def test_stiffness_equals_scikit_fem():
    """Compressible: the energy of any nodal displacement is scikit-fem's with its own P2 tetrahedra."""
    vert, elem = box([np.linspace(0, 1e-2, 3)] * 3, 0.2)
    refined, elem10 = quadratic(skin(vert, elem, [0]))
    material = Material("linear", 1e6, 0.3)
    basis = skfem.Basis(skfem.MeshTet(vert.T.copy(), elem.T.astype(np.int64)), skfem.ElementVector(skfem.ElementTetP2()), intorder=2)
    mu, lame = material.mu, material.lame
    form = skfem.BilinearForm(lambda u, v, w: 2 * mu * ddot(sym_grad(u), sym_grad(v)) + lame * div(u) * div(v))
    stiffness = form.assemble(basis)
    where = basis.doflocs.T.round(9)
    mine = {tuple(v): i for i, v in enumerate(refined.vert.round(9))}
    order = np.array([mine[tuple(v)] for v in where[::3]])
    assert (where[::3] == where[2::3]).all()  # scikit-fem's coordinates x, y, z of a node follow each other
    u = np.random.default_rng(0).standard_normal((len(refined.vert), 3))
    ours = u.ravel() @ QuadraticTetrahedra(refined.vert, elem10, LAWS["linear"], CPU).rest_stiffness(mu, lame) @ u.ravel()
    theirs = u[order].ravel()
    assert ours == pytest.approx(theirs @ stiffness @ theirs, rel=1e-12)
