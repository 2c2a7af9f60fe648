"""Graph convolutions, hierarchy, VAEs, PointNet++, features: against dense algebra, closed forms and finite
differences."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from learning_set import dent  # noqa: E402
from scipy.sparse import csr_matrix  # noqa: E402

from biotac_mj.geometry import load_skin  # noqa: E402
from biotac_mj.learning.networks.graph import ChebConv, SparseMatrix  # noqa: E402
from biotac_mj.learning.networks.heads import LocalHead  # noqa: E402
from biotac_mj.learning.networks.hierarchy import build_hierarchy  # noqa: E402
from biotac_mj.learning.networks.mesh_vae import MeshVAE  # noqa: E402
from biotac_mj.learning.networks.pointnet import PointNet  # noqa: E402
from biotac_mj.learning.training.config import LearningConfig  # noqa: E402
from biotac_mj.learning.training.features import (  # noqa: E402
    FilmFeatures,
    Pod,
    mirror_matrix,
    mirror_order,
)
from biotac_mj.learning.training.fitting import TrainingOptions, _schedule, train  # noqa: E402


@pytest.fixture(scope="module")
def skin():
    return load_skin("coarse")


@pytest.fixture(scope="module")
def levels(skin):
    return build_hierarchy(skin.vert, skin.tets)


def random_laplacian(n=23, seed=0):
    rng = np.random.default_rng(seed)
    a = (rng.random((n, n)) < 0.3) * rng.random((n, n))
    a = a + a.T
    return csr_matrix(-a / np.abs(np.linalg.eigvalsh(a)).max())


@pytest.mark.parametrize(("inputs", "outputs"), [(3, 7), (7, 3)])  # forward recurrence and Clenshaw's
def test_chebyshev_convolution_is_the_dense_polynomial(inputs, outputs):
    matrix = random_laplacian()
    torch.manual_seed(0)
    conv = ChebConv(SparseMatrix(matrix, symmetric=True), inputs, outputs, order=6)
    x = torch.randn(23, 4, inputs)
    value, vector = np.linalg.eigh(matrix.toarray())
    wanted = np.zeros((23, 4, outputs))
    for k in range(6):  # T_k(cos t) = cos(k t)
        polynomial = vector @ np.diag(np.cos(k * np.arccos(np.clip(value, -1, 1)))) @ vector.T
        wanted += np.einsum("nm,mbi,io->nbo", polynomial, x.numpy(), conv.weight[k].detach().numpy())
    np.testing.assert_allclose(conv(x).detach().numpy(), wanted, atol=2e-5)
    conv.keep = torch.tensor([3, 20, 5])
    np.testing.assert_allclose(conv(x).detach().numpy(), wanted[[3, 20, 5]], atol=2e-5)


@pytest.mark.parametrize(("inputs", "outputs"), [(3, 7), (7, 3)])
@pytest.mark.parametrize("way", ["coarser", "finer"])
def test_dense_matrices_of_a_gpu_are_the_recurrence(inputs, outputs, way):
    # values and gradients; `dense` runs anywhere, `forward` takes it on CUDA
    matrix = random_laplacian()
    up = csr_matrix(np.random.default_rng(3).random((23, 6)))
    torch.manual_seed(0)
    change = dict(keep=np.array([3, 20, 5])) if way == "coarser" else dict(up=SparseMatrix(up))
    conv = ChebConv(SparseMatrix(matrix, symmetric=True), inputs, outputs, order=6, bias=False, **change)
    found = []
    for product in (conv, conv.dense):
        x = torch.randn(
            23 if way == "coarser" else 6, 4, inputs, generator=torch.Generator().manual_seed(1)
        ).requires_grad_()
        conv.weight.grad = None
        y = product(x)
        (y * torch.linspace(-1, 1, y.numel()).view_as(y)).sum().backward()
        found.append((y.detach(), x.grad, conv.weight.grad.clone()))
    assert found[0][0].shape == (3 if way == "coarser" else 23, 4, outputs)
    for a, b in zip(*found):
        np.testing.assert_allclose(a.numpy(), b.numpy(), atol=3e-5 * float(a.abs().max()))


def test_sparse_product_has_the_right_gradient():
    matrix = csr_matrix(
        np.random.default_rng(1).normal(size=(5, 8)) * (np.random.default_rng(2).random((5, 8)) < 0.5)
    )
    x = torch.randn(8, 3, requires_grad=True)
    weight = torch.randn(5, 3)
    (SparseMatrix(matrix)(x) * weight).sum().backward()
    np.testing.assert_allclose(x.grad.numpy(), matrix.toarray().T @ weight.numpy(), atol=1e-6)


def test_hierarchy_reproduces_linear_fields_wall_by_wall(skin, levels):
    sizes = [level.laplacian.shape[0] for level in levels]
    assert sizes == [skin.nvert, *(int(np.ceil(skin.nvert / f)) for f in (4, 16, 64, 128))]
    here = skin.vert
    for level in levels[:-1]:
        np.testing.assert_allclose(level.up @ np.ones(len(level.keep)), 1, atol=1e-12)
        # [m], from a small ridge where neighbours lie in a plane
        np.testing.assert_allclose(level.up @ here[level.keep], here, atol=2e-6)
        here = here[level.keep]
    for level in levels:
        eigenvalue = np.linalg.eigvalsh(level.laplacian.toarray()) if level.laplacian.shape[0] < 800 else None
        assert eigenvalue is None or (eigenvalue.min() >= -1 - 1e-9 and eigenvalue.max() <= 1 + 1e-9)


def test_mesh_vae_learns_and_has_the_papers_sizes(skin, levels):
    full = MeshVAE(levels)
    assert full.latent == 128 and full.order == 6
    assert [conv.weight.shape[2] for conv in full.encode_convs] == [128, 128, 128, 256, 64, 64]
    torch.manual_seed(0)
    small = MeshVAE(levels, first=8, channels=(8, 8, 8, 8), last=8, hidden=32, latent=4)
    bases = torch.tensor(
        np.stack([1e3 * dent(skin, [x, -7e-3, 0], 1e-3, 3e-3, 0) for x in (-12e-3, -6e-3)]),
        dtype=torch.float32,
    )
    x = torch.einsum("bk,kni->bni", torch.rand(8, 2), bases)
    optimizer = torch.optim.Adam(small.parameters(), 1e-2)
    first = None
    for _ in range(25):
        loss = (small(x)[0] - x).square().sum((1, 2)).mean()
        optimizer.zero_grad(), loss.backward(), optimizer.step()
        first = first or loss.item()
    assert loss.item() < 0.4 * first


def test_pod_is_the_truncated_singular_value_decomposition():
    torch.manual_seed(0)
    field = (torch.randn(60, 5) * torch.tensor([5.0, 3, 2, 1, 0.5])) @ torch.randn(5, 33)
    pod = Pod.fit(field.view(60, 11, 3), torch.arange(60), modes=3)
    u, s, v = np.linalg.svd(field.numpy(), full_matrices=False)
    wanted = u[:, :3] * s[:3] @ v[:3]
    np.testing.assert_allclose(
        pod.decode(pod(field.view(60, 11, 3))).numpy().reshape(60, 33), wanted, atol=1e-4
    )
    np.testing.assert_allclose(pod(field.view(60, 11, 3)).square().mean(0), 1, rtol=1e-3)


def test_film_features_of_a_uniform_approach(skin):
    features = FilmFeatures(skin)
    rest = features(torch.zeros(1, skin.nvert, 3))
    assert rest.abs().max() < 1e-6
    u = torch.zeros(1, skin.nvert, 3)
    depth = 0.1
    u[0, features.node] = -depth * features.away  # [mm] every inner node goes straight towards the core
    got = features(u)[0]
    gap = features.gap.numpy()
    thinner = np.log(np.maximum(gap - depth, 0.05) / gap)
    np.testing.assert_allclose(
        got[:, :3].numpy().T.ravel(), (features.patch.numpy() @ thinner).reshape(3, 19).ravel(), atol=1e-4
    )
    assert (
        got[:, 3:6] >= -got[:, :3] - 1e-5
    ).all()  # Jensen: ln of the mean of 1/h is at least the mean of ln 1/h


def test_mirrored_touch_is_seen_by_the_mirrored_electrodes(skin):
    features, matrix = FilmFeatures(skin), mirror_matrix(skin)
    np.testing.assert_allclose(np.asarray(matrix.sum(1)).ravel(), 1, atol=1e-12)
    order = mirror_order(skin)
    np.testing.assert_allclose(skin.electrode_pos[order], skin.electrode_pos * [1, 1, -1], atol=1e-5)
    u = 1e3 * dent(skin, [-9e-3, -6e-3, 3.5e-3], 0.8e-3, 3e-3, 0.2e-3)
    flipped = matrix @ u * [1, 1, -1]
    a, b = (features(torch.tensor(x, dtype=torch.float32)[None])[0].numpy() for x in (u, flipped))
    side = np.abs(skin.electrode_pos[:, 2]) > 5e-4
    error = np.abs(b[side] - a[order][side]).max()
    assert (
        error < 0.1 * np.abs(a).max()
    )  # the mesh itself is symmetric to a few hundredths of a millimetre only


def test_a_head_is_zero_at_rest():
    torch.manual_seed(0)
    head = LocalHead(5, 6, 19).eval()
    assert head(torch.zeros(2, 19, 5), torch.zeros(2, 6)).abs().max() < 1e-6
    assert head(torch.randn(2, 19, 5), torch.randn(2, 6)).abs().max() > 1e-3


def test_pointnet_reads_only_its_nodes(skin):
    free = np.setdiff1d(np.arange(skin.nvert), skin.fixed)
    net = PointNet(skin.vert, free, 19).eval()
    assert len(set(net.sample.tolist())) == 128
    u = torch.randn(2, skin.nvert, 3)
    out = net(u)
    other = u.clone()
    rest = np.setdiff1d(np.arange(skin.nvert), net.sample.numpy())
    other[:, rest] = 0
    assert out.shape == (2, 19) and torch.equal(out, net(other)) and not torch.equal(out, net(2 * u))
    with pytest.raises(ValueError, match="cannot be sampled"):
        PointNet(skin.vert, free[:50], 19)


def test_config_names_what_is_wrong():
    with pytest.raises(ValueError, match="unknown projection_loss 'pixels': choose one of latent, decoded"):
        LearningConfig(projection_loss="pixels")
    with pytest.raises(ValueError, match="must not be negative"):
        LearningConfig(steps=-1)
    with pytest.raises(ValueError, match="equally many"):
        LearningConfig(mesh_factors=(4, 4))


def test_the_rate_is_one_cycle_or_falls_by_a_factor():
    def rates(decay):
        optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], torch.tensor(3.0))
        schedule, out = _schedule(optimizer, 3.0, 1000, decay), []
        for _ in range(1000):
            out.append(float(optimizer.param_groups[0]["lr"]))
            optimizer.step(), schedule.step()
        return np.array(out)

    cycled = rates(None)
    assert cycled[0] == pytest.approx(0.24) and cycled[-1] < 1e-4
    assert cycled.max() == pytest.approx(6.0) and cycled.argmax() == 149
    np.testing.assert_allclose(rates(0.9), 3 * 0.9 ** (0.02 * np.arange(1000)), rtol=1e-5)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_replayed_steps_train_as_launched_ones_do():
    x = torch.randn(300, 19, device="cuda", generator=torch.Generator("cuda").manual_seed(0))
    y = x @ torch.randn(19, 5, device="cuda", generator=torch.Generator("cuda").manual_seed(1))
    found = []
    for graph in (False, True):
        torch.manual_seed(0)
        net = torch.nn.Sequential(torch.nn.Linear(19, 32), torch.nn.ELU(), torch.nn.Linear(32, 5)).cuda()
        loss = lambda r, net=net: (net(x[r]) - y[r]).square().mean()  # noqa: E731
        rows = torch.arange(300, device="cuda")
        whole = lambda loss=loss, rows=rows: loss(rows)  # noqa: E731
        options = TrainingOptions(64, 300, 3e-3, decay=0.95, graph=graph)
        found.append(float(train(net, loss, rows, options, whole)))
    assert abs(found[0] - found[1]) < 0.02 * found[0] and found[0] < 0.5
