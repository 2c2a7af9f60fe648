"""Bodies that give way while a skin of the full tier is solved."""

import numpy as np
import pytest
import warp as wp
from blocks import boundary, box, faces_on, skin

from biotac_mj.geometry.rigid import displace
from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, step
from biotac_mj.skin.newton import bodies
from biotac_mj.skin.newton.worlds import BLOCK
from biotac_mj.skin.types import real

HEIGHT, R = 4e-3, 5e-3
POS = np.array([[3e-3, 5e-3, HEIGHT + R + 1e-4], [8e-3, 5e-3, HEIGHT + R + 1e-4]])
DOWN = np.array([[0.0, 2e-4, -6e-4], [1e-4, 0.0, -5e-4]])  # on the way of the step


@pytest.fixture(scope="module")
def pad():
    """Of rubber, 12 x 10 x 4 mm, held at z = 0."""
    sides = zip((12e-3, 10e-3, HEIGHT), (12, 10, 3))
    vert, elem = box([np.linspace(0, s, n + 1) for s, n in sides], jitter=0.2)
    top = faces_on(vert, boundary(elem), 2, HEIGHT)
    geometry = skin(vert, elem, np.flatnonzero(vert[:, 2] == 0), outer_face=top, name="pad")
    return SkinModel(geometry, Material("neo_hookean", 3e5, 0.4), SkinOptions(tolerance=1e-5))


def compliance(mass, h=4e-3):
    """(2, 2, 6, 6) of two balls that a spring between them holds together, about the origin [m/N]."""
    A = np.zeros((2, 6, 2, 6))
    for g, p in enumerate(POS):
        rigid = np.zeros((6, 6))  # motion about the origin of forces and torques about it
        lever = np.array([[0, -p[2], p[1]], [p[2], 0, -p[0]], [-p[1], p[0], 0]])
        inertia = np.diag([mass] * 3 + [0.4 * mass * R**2] * 3)
        to_own = np.block([[np.eye(3), np.zeros((3, 3))], [-lever, np.eye(3)]])  # wrench about its own centre
        rigid = to_own.T @ np.linalg.inv(inertia) @ to_own
        A[g, :, g] = h**2 * rigid
    A = A.reshape(12, 12)
    tie = np.zeros(12)
    tie[[2, 8]] = 1, -1
    A -= np.outer(A @ tie, tie @ A) / (1 / 500 + tie @ A @ tie)
    return A.reshape(2, 6, 2, 6).swapaxes(1, 2)


def solved(pad, preconditioner, bodies=None, at=None, nworld=1):
    """After a first step that presses the balls slightly, and one that leads to `at`. Friction holds: what
    slips depends on the way, by little, and tangents by more."""
    data = SkinData(pad, nworld, preconditioner=preconditioner)
    geoms = GeomSet(["sphere"] * 2, [(R,)] * 2, friction=[5.0, 5.0], groups=[0, 1], nworld=nworld)
    if bodies is not None:
        data.make_bodies_compliant(2)
    upright = np.stack([np.eye(3)] * 2)
    way = (POS, upright), (POS + 0.4 * DOWN, upright), at or (POS + DOWN, upright)
    for number, pose in enumerate(way):
        geoms.set_pose(*pose)
        if number == 0:
            geoms.advance()
            continue
        if bodies is not None and number == 2:
            A, predicted = bodies
            b = data.bodies
            b.compliance.assign(np.repeat(A[:, :, None], nworld, 2))
            b.predicted.assign(np.repeat(predicted[:, None], nworld, 1))
            b.origin.assign(np.repeat((POS + DOWN)[:, None], nworld, 1))
            b.arm.assign(np.repeat((POS + 0.4 * DOWN)[:, None], nworld, 1))
        step(pad, data, geoms)
        assert data.converged.all()
    return data, geoms


@pytest.mark.parametrize("mass", [2e-3, 2e-1])
@pytest.mark.parametrize("preconditioner, nworld", [("sparse", 1), ("dense", 2)])
def test_bodies_go_where_the_skin_leaves_them(pad, preconditioner, nworld, mass):
    """Their poses are those to which the wrenches bring them, and wrenches, tangents and nodes those of a
    skin that was asked for these poses."""
    A, predicted = compliance(mass), np.array([[0, 0, 0.05, 0, 0, 0], [0, 0, 0.02, 0, 0, 0]])
    data, geoms = solved(pad, preconditioner, (A, predicted), nworld=nworld)
    for w in range(nworld):
        pos, mat = geoms.struct.pos_last.numpy()[:, w], geoms.struct.mat_last.numpy()[:, w]
        motion = np.einsum("ghij,hj->gi", A, data.wrench[w] - predicted)
        expected = displace(POS + DOWN, np.stack([np.eye(3)] * 2), motion, POS + 0.4 * DOWN, 0 * POS)
        np.testing.assert_allclose(pos, expected[0], atol=1e-7)
        np.testing.assert_allclose(mat, expected[1], atol=1e-5)
        assert np.abs(pos - POS - DOWN).max() > 1e-5  # they give way
    there, asked = solved(pad, preconditioner, at=(pos, mat), nworld=nworld)
    np.testing.assert_allclose(data.wrench, there.wrench, rtol=2e-3, atol=2e-3 * np.abs(there.wrench).max())
    np.testing.assert_allclose(data.vert_xpos, there.vert_xpos, atol=5e-7)
    stiff = there.tangent(asked)
    np.testing.assert_allclose(data.tangent(geoms), stiff, rtol=0.02, atol=2e-3 * np.abs(stiff).max())


def test_bodies_that_cannot_move_are_posed(pad):
    data, _ = solved(pad, "sparse", (np.zeros((2, 2, 6, 6)), np.zeros((2, 6))))
    there, _ = solved(pad, "sparse")
    np.testing.assert_allclose(data.wrench, there.wrench, rtol=1e-4, atol=1e-5)


@wp.kernel(enable_backward=False)
def inverted(n: int, M: wp.array3d(dtype=real), pivot: wp.array2d(dtype=int)):
    w, t = wp.tid()
    bodies._invert(w, t, n, M, pivot)


@pytest.mark.parametrize("idle", [[], [0], [1, 3], [0, 1, 2, 3]])
def test_idle_bodies_are_left_out_of_the_elimination(idle):
    """1 + S A of four bodies, S zero for those that are idle, against numpy's inverse."""
    rng, n = np.random.default_rng(0), 24
    stiffness, compliance = np.zeros((n, n)), (root := rng.normal(size=(n, n))) @ root.T
    pivot = np.zeros((1, n), int)
    for g in range(4):
        own = slice(6 * g, 6 * g + 6)
        if g in idle:
            pivot[0, own] = -1
        else:
            stiffness[own, own] = (root := rng.normal(size=(6, 6))) @ root.T
    matrix = np.eye(n) + stiffness @ compliance
    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        M, p = wp.array(matrix[None], dtype=real), wp.array(pivot, dtype=int)
        wp.launch_tiled(inverted, dim=[1], inputs=[n, M, p], block_dim=BLOCK)
        np.testing.assert_allclose(M.numpy()[0], np.linalg.inv(matrix), atol=1e-10)
