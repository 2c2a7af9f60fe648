"""The sparse factor: against scipy's LU, and what nested dissection promises."""

import dataclasses

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg  # noqa: F401

from biotac_mj.geometry import load_skin
from biotac_mj.skin import Material, SkinModel
from biotac_mj.skin.precondition.nested_dissection import dissect
from biotac_mj.skin.precondition.supernodal import Elimination, SupernodalFactor, elimination_of


@pytest.fixture(scope="module", params=[0.3165, pytest.param(0.4999, marks=pytest.mark.slow)])
def model(request):
    return SkinModel(load_skin("coarse"), Material("neo_hookean", 1e6, request.param))


def test_solves_agree_with_lu(model):
    K, free = model.stiffness, model.free
    factor = SupernodalFactor(K, Elimination(K, model.geometry.vert[free]), free)
    rng = np.random.default_rng(0)
    rhs = rng.standard_normal((model.nvert, 7, 3))  # fixed nodes too: not looked at
    rhs[:, 2] = 0
    rhs[free[100], 2, 1] = 1  # a unit force: fronts without load are left out
    out = factor.solve(rhs)
    assert not out[model.fixed].any()
    lu = sp.linalg.splu(K.tocsc())
    for k in range(7):  # four together, two, and one
        exact = lu.solve(rhs[free, k].ravel())
        wrong = out[free, k].ravel() - exact
        assert wrong @ (K @ wrong) < (1e-4 * (model.material.poissons_ratio > 0.4) + 3e-6) ** 2 * (
            exact @ (K @ exact)
        )
        np.testing.assert_array_equal(
            factor.solve(rhs[:, k : k + 1])[:, 0], out[:, k]
        )  # whatever is solved beside it


def test_rows_are_answers_to_unit_forces(model):
    factor, nodes = model.factor, model.free[[5, 300, 40]]
    unit = np.zeros((model.nvert, 9, 3))
    unit[np.repeat(nodes, 3), np.arange(9), np.arange(9) % 3] = 1
    wanted = factor.solve(unit)[model.free].swapaxes(0, 1).reshape(9, -1).astype(np.float32)
    np.testing.assert_array_equal(factor.rows(nodes), wanted)


def test_operator_is_symmetric(model):
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, model.nvert, 1, 3))
    solve = model.factor.solve
    one, other = (solve(a)[model.free] * b[model.free]).sum(), (solve(b)[model.free] * a[model.free]).sum()
    size = np.sqrt(
        (solve(a)[model.free] * a[model.free]).sum() * (solve(b)[model.free] * b[model.free]).sum()
    )
    assert abs(one - other) < 1e-6 * size
    assert model.factor_at(model.geometry.vert).elimination is model.factor.elimination


def test_another_matrix_of_the_same_pattern(model):
    K, free = model.stiffness, model.free
    elimination = Elimination(K, model.geometry.vert[free])
    scale = sp.diags(np.linspace(1, 2, K.shape[0]))
    other = (scale @ K @ scale).tocsc()
    b = np.random.default_rng(2).standard_normal((model.nvert, 1, 3))
    x = SupernodalFactor(other, elimination, free).solve(b)[free].ravel()
    exact = sp.linalg.spsolve(other, b[free].ravel())
    assert np.linalg.norm(x - exact) < 1e-4 * np.linalg.norm(exact)


def test_skins_of_one_mesh_share_their_elimination(model):
    """Whatever their rubber; not those whose nodes lie elsewhere."""
    shape = model.geometry
    other = SkinModel(shape, Material("corotational", 3e5, 0.4)).factor
    assert other.elimination is model.factor.elimination
    turned = dataclasses.replace(shape, vert=shape.vert[:, [0, 2, 1]] * [1, 1, -1])
    K = SkinModel(turned, model.material).stiffness
    assert elimination_of(K, turned.vert[model.free]) is not other.elimination


def test_dissection_separates(model):
    n = len(model.free)
    coo = model.stiffness.tocoo()
    near = sp.coo_matrix((np.ones(len(coo.row)), (coo.row // 3, coo.col // 3)), shape=(n, n)).tocsr()
    groups = dissect(near, model.geometry.vert[model.free])
    np.testing.assert_array_equal(np.sort(np.concatenate(groups)), np.arange(n))
    middle = groups[-1]  # of the first cut
    rest = np.setdiff1d(np.arange(n), middle)
    parts, label = sp.csgraph.connected_components(near[rest][:, rest])
    assert parts >= 2 and np.bincount(label).max() < 0.65 * n and len(middle) < 0.05 * n
    elimination = Elimination(model.stiffness, model.geometry.vert[model.free])
    entries = sum(
        (end - begin) * (end - begin + 1) / 2 + (end - begin) * len(later)
        for begin, end, later, _ in elimination.fronts
    )
    lu = sp.linalg.splu(
        model.stiffness.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0,
        options={"SymmetricMode": True},
    )
    assert entries < 1.3 * lu.L.nnz  # nearly as good as minimum degree, although leaves are full


@pytest.mark.parametrize("n", [1, 2, 60])
def test_chains_and_loose_parts(n):
    """Springs in a row, two rows that do not touch, everything held to the ground a little."""
    chain = sp.diags([-np.ones(n - 1), np.r_[2.0 * np.ones(n)], -np.ones(n - 1)], [-1, 0, 1]) + 0.1 * sp.eye(
        n
    )
    matrix = sp.kron(
        sp.block_diag([chain, chain]), sp.csr_matrix([[2.0, 1, 0], [1, 3, 0], [0, 0, 1]])
    ).tocsc()
    points = np.zeros((2 * n, 3))
    points[:, 0], points[n:, 1] = np.tile(np.arange(n), 2), 1
    b = np.random.default_rng(3).standard_normal((2 * n, 2, 3))
    x = SupernodalFactor(matrix, Elimination(matrix, points), np.arange(2 * n)).solve(b)
    for k in range(2):
        np.testing.assert_allclose(
            x[:, k].ravel(), np.linalg.solve(matrix.toarray(), b[:, k].ravel()), atol=1e-5
        )


def test_matrices_that_are_not_positive_definite_are_refused():
    matrix = sp.csc_matrix(np.diag([1.0, 1, 1, 1, -1, 1]))
    with pytest.raises(ValueError, match="not positive definite: check for inverted elements"):
        SupernodalFactor(matrix, Elimination(matrix, np.eye(3)[:2]), np.arange(2))
