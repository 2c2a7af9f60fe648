"""The inverse of a stiffness by the blocks of a dissection."""

import numpy as np
import pytest
import scipy.sparse.linalg
import scipy.spatial
import warp as wp

from biotac_mj.skin.precondition.block_inverse import DissectedInverse
from biotac_mj.skin.precondition.block_products import Product
from biotac_mj.skin.precondition.right_hand_sides import LOW, RAISE
from biotac_mj.skin.program import Launcher, Program


@pytest.fixture(scope="module")
def stiffness():
    """Of springs between the points of a slab and their neighbours, which is held at one end."""
    rng = np.random.default_rng(0)
    points = np.stack(np.meshgrid(*(np.arange(n) for n in (24, 8, 3)), indexing="ij"), -1).reshape(-1, 3)
    points = points + 0.2 * rng.uniform(-1, 1, points.shape)
    pairs = scipy.spatial.cKDTree(points).query_pairs(1.9, output_type="ndarray")
    along = points[pairs[:, 1]] - points[pairs[:, 0]]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    spring = rng.uniform(0.5, 2.0, len(pairs))[:, None, None] * along[:, :, None] * along[:, None, :]
    blocks = np.array([[1, -1], [-1, 1]])[:, None, :, None] * spring[:, None, :, None, :]
    at = (3 * pairs[:, :, None] + np.arange(3)).reshape(len(pairs), 6)
    rows, columns = np.repeat(at, 6, axis=1), np.tile(at, (1, 6))
    K = scipy.sparse.coo_matrix((blocks.reshape(-1), (rows.ravel(), columns.ravel()))).tocsc()
    held = np.repeat(np.where(points[:, 0] < 0.5, 10.0, 1e-4), 3)
    return (K + scipy.sparse.diags(held)).tocsc(), points


def written(product, inverse, b):
    """Right-hand sides (3 n, worlds) as `sides.write_node` writes them."""
    side = product.side.numpy()
    rows = (inverse.row[:, None] + np.arange(3)).ravel()
    raised = (float(RAISE) * b).astype(np.float32)
    high = raised.astype(np.float16)
    each = [high, (raised - high.astype(np.float32)).astype(np.float16), high]
    for copy in range(inverse.copies):
        side[rows, copy, : b.shape[1]] = each[copy]
    return rows


@pytest.mark.parametrize(
    ("thirds", "close"), [pytest.param(False, 2e-3, marks=pytest.mark.slow), (True, 1e-5)]
)
def test_a_product_is_the_inverse_and_its_own_entries(stiffness, thirds, close):
    K, points = stiffness
    inverse = DissectedInverse(K, points, wp.get_device("cpu"), thirds)
    assert inverse.copies == 2 + thirds and inverse.npiece > 1
    b = np.random.default_rng(3).normal(size=(K.shape[0], 5))
    b[:, 1] = 0.0
    b[7, 1] = 1.0  # one force
    b[:, 2] = 0.1
    b /= np.linalg.norm(b, axis=0)
    product = Product(inverse, 5)
    rows = written(product, inverse, b)
    Program("cpu", product.run).run()
    z = product.answer.numpy().sum(1)[rows, :5] / float(RAISE) * inverse.back
    many = Product(inverse, 40)  # halves are rows, with few sides columns
    written(many, inverse, b)
    Program("cpu", many.run).run()
    assert many.answer.shape[1] == 1 and product.answer.shape[1] == (1 if thirds else 2)
    np.testing.assert_allclose(
        many.answer.numpy()[rows, 0, :5],
        product.answer.numpy().sum(1)[rows, :5],
        rtol=0,
        atol=2e-5 * abs(many.answer.numpy()).max(),
    )
    exact = scipy.sparse.linalg.spsolve(K, b)
    assert (np.linalg.norm(z - exact, axis=0) < close * np.linalg.norm(exact, axis=0)).all()
    half, rest = (a.numpy().astype(float) for a in (inverse.half, inverse.rest))
    entries = (half + rest / float(LOW)) * inverse.scale
    np.testing.assert_allclose(entries, entries.T, rtol=0, atol=2e-6 * inverse.scale)
    # contact cancels most of what a force does: both must be the same to much more than half precision
    own = entries @ b
    assert (np.linalg.norm(z - own, axis=0) < 1e-5 * np.linalg.norm(own, axis=0)).all()


@pytest.mark.parametrize("nodes", [1, 2, 40])
def test_pieces_without_joints_are_inverted(nodes):
    """A single node, and two parts that only what holds them joins."""
    rng = np.random.default_rng(nodes)
    points = rng.uniform(0, 1, (nodes, 3)) + np.where(np.arange(nodes) < nodes // 2, 0.0, 9.0)[:, None]
    parts = [rng.normal(size=(3 * n, 3 * n)) for n in (nodes // 2, nodes - nodes // 2) if n]
    K = scipy.sparse.block_diag([a @ a.T + 3 * np.eye(len(a)) for a in parts]).tocsc()
    inverse = DissectedInverse(K, points, wp.get_device("cpu"), False)
    b = rng.normal(size=(3 * nodes, 2)) / np.sqrt(3 * nodes)
    product = Product(inverse, 2)
    rows = written(product, inverse, b)
    Program("cpu", product.run).run()
    z = product.answer.numpy().sum(1)[rows, :2] / float(RAISE) * inverse.back
    exact = np.linalg.solve(K.toarray(), b)
    assert np.linalg.norm(z - exact) < 2e-3 * np.linalg.norm(exact)


def test_a_soft_direction_takes_thirds(stiffness):
    """Nearly all that half precision knows is the soft direction: of the others too little is left."""
    K, points = stiffness
    value, vector = scipy.sparse.linalg.eigsh(K, k=1, sigma=0.0)
    soft = scipy.sparse.csc_matrix(K.toarray() - (1 - 1e-6) * value[0] * np.outer(vector, vector))
    assert DissectedInverse(K, points, wp.get_device("cpu"), False).copies == 2
    assert DissectedInverse(soft, points, wp.get_device("cpu"), False).copies == 3


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("thirds", [False, True])
@pytest.mark.parametrize("worlds", [1, 3, 9, 40])
def test_products_on_cuda_are_right_for_any_number_of_worlds(stiffness, thirds, worlds):
    K, points = stiffness
    inverse = DissectedInverse(K, points, wp.get_device("cuda:0"), thirds)
    b = np.random.default_rng(5).normal(size=(K.shape[0], worlds))
    b /= np.linalg.norm(b, axis=0)
    exact = scipy.sparse.linalg.spsolve(K, b).reshape(b.shape)
    rows = (inverse.row[:, None] + np.arange(3)).ravel()
    product = Product(inverse, worlds)
    raised = (float(RAISE) * b).astype(np.float32)
    high = raised.astype(np.float16)
    side = product.side.numpy()
    for copy, h in enumerate([high, (raised - high).astype(np.float16), high][: inverse.copies]):
        side[rows, copy, :worlds] = h
    product.side.assign(side)
    product.run(Launcher(wp.get_device("cuda:0")))
    z = product.answer.numpy().sum(1)[rows, :worlds] / float(RAISE) * inverse.back
    assert (np.linalg.norm(z - exact, axis=0) < 2e-3 * np.linalg.norm(exact, axis=0)).all()
