"""The paper's networks (Narang et al., ICRA 2021) on one split: two VAEs, projections between their codes,
and PointNet++. They read the skin at `SkinPoints`."""

from collections.abc import Callable

import numpy as np
import torch
from torch import nn

from ..networks.electrode_vae import ElectrodeVAE, mlp
from ..networks.heads import FromRest
from ..networks.mesh_vae import MeshVAE
from ..networks.pointnet import PointNet
from ..networks.points import SkinPoints
from . import fitting
from .arrays import Arrays, spread_rows
from .config import LearningConfig
from .fitting import TrainingOptions, fast_products, root_mean_square
from .local import counts_change


class LatentProjection(nn.Module):
    """Displacements -> code of 128 -> code of 8 -> electrodes, and back.

    Args:
      points: SkinPoints. config: LearningConfig. nelectrode: electrodes.
    """

    def __init__(self, points: SkinPoints, config: LearningConfig, nelectrode: int):
        super().__init__()
        self.mesh = MeshVAE(
            points.levels,
            config.mesh_first,
            config.mesh_channels,
            config.mesh_last,
            config.mesh_hidden,
            config.mesh_latent,
            config.mesh_order,
        )
        self.electrode = ElectrodeVAE(
            nelectrode, hidden=config.electrode_hidden, latent=config.electrode_latent
        )
        self.to_electrode = mlp(
            [self.mesh.latent, *config.forward_hidden, self.electrode.latent], config.dropout
        )
        self.to_mesh = mlp([self.electrode.latent, *config.inverse_hidden, self.mesh.latent], config.dropout)

    def forward(self, u: torch.Tensor) -> torch.Tensor:
        """(n, nelectrode) for u (n, npoint, 3), displacements / mesh_scale: d ln Z, or tared counts /
        2048."""
        return self.electrode.decode(self.to_electrode(self.mesh.encode(u)[0]))

    def inverse(self, y: torch.Tensor) -> torch.Tensor:
        """(n, npoint, 3) displacements / mesh_scale for y (n, nelectrode)."""
        return self.mesh.decode(self.to_mesh(self.electrode.encode(y)[0]))


def make_pointnet(points: SkinPoints, config: LearningConfig, nelectrode: int) -> PointNet:
    """The baseline, on 128 of the points."""
    return PointNet(points.place, np.arange(len(points.place)), nelectrode, dropout=config.dropout)


def network_target(arrays: Arrays, rows: torch.Tensor, config: LearningConfig) -> torch.Tensor:
    """(k, nelectrode) target of the networks in rows of a set."""
    return arrays.log_change(rows) if config.logarithm else arrays.change(rows) / config.scale


def network_change(output: torch.Tensor, tare: torch.Tensor, config: LearningConfig) -> torch.Tensor:
    """Change of counts from a network's output, for counts `tare` at rest, each (k, nelectrode)."""
    return counts_change(output, tare) if config.logarithm else config.scale * output


def _wrong(output, arrays, rows, config):
    """Loss of outputs: RMS of counts / scale."""
    got = network_change(output, arrays.tare[rows], config)
    return root_mean_square(got - arrays.change(rows)) / config.scale


@fast_products()
def train_latent_projection(
    arrays: Arrays,
    points: SkinPoints,
    train: np.ndarray,
    validation: np.ndarray,
    config: LearningConfig,
    seed: int = 0,
    progress: Callable[[int], object] | None = None,
) -> tuple[LatentProjection, dict]:
    """Trains both VAEs, freezes them, trains the projections.

    Args:
      arrays: of `Arrays.at_points`. train, validation: numbers of interactions. seed: of weights and batches.

    Returns:
      the networks, and the validation curves of the four trainings: {name: [[step, error]]}.
    """
    torch.manual_seed(seed)
    model = LatentProjection(points, config, arrays.counts.shape[1]).to(arrays.device)
    curves = {name: [] for name in ("mesh", "electrode", "to_electrode", "to_mesh")}
    unit = 1e-3 / config.mesh_scale
    mesh_rows, mesh_check = arrays.rows(train), spread_rows(arrays.rows(validation), 512)
    vae, electrode = model.mesh, model.electrode

    def field(rows):
        return unit * arrays.field[rows].float()

    def mesh_validate():
        return sum(float((vae(field(r))[0] - field(r)).square().sum()) for r in mesh_check.split(64))

    options = TrainingOptions(config.mesh_batch, config.mesh_steps, config.learning_rate, decay=config.decay,
                              seed=seed, graph=False)  # fmt: skip
    mesh_loss = lambda rows: vae.loss(field(rows), config.mesh_kl)  # noqa: E731
    fitting.train(vae, mesh_loss, mesh_rows, options, mesh_validate, progress, curves["mesh"])

    rows, check = arrays.rows(train, labelled=True), arrays.rows(validation, labelled=True)
    both = torch.cat([rows, check])
    y = torch.zeros_like(arrays.counts)
    y[both] = network_target(arrays, both, config)
    options = TrainingOptions(config.batch, config.paper_steps, config.learning_rate, decay=config.decay,
                              seed=seed)  # fmt: skip

    electrode_loss = lambda r: electrode.loss(y[r], config.electrode_kl)  # noqa: E731
    error = lambda: (electrode(y[check])[0] - y[check]).square().mean()  # noqa: E731
    fitting.train(electrode, electrode_loss, rows, options, error, progress, curves["electrode"])

    for network in (vae, electrode):
        network.requires_grad_(False)
    with torch.no_grad():
        codes = [vae.encode(field(r)) for r in both.split(256)]
        z_m, s_m = torch.cat([c[0] for c in codes]), torch.cat([(0.5 * c[1]).exp() for c in codes])
        z_e, v_e = electrode.encode(y[both])
        s_e = (0.5 * v_e).exp()
        rest = vae.encode(torch.zeros_like(field(both[:1])))[0]
    place = torch.full((len(arrays.counts),), -1, dtype=torch.long, device=arrays.device)
    place[both] = torch.arange(len(both), device=arrays.device)

    def codes_of(r):
        i = place[r]
        if not (config.sample_codes and model.training):
            return z_m[i], z_e[i]
        return z_m[i] + s_m[i] * torch.randn_like(z_m[i]), z_e[i] + s_e[i] * torch.randn_like(z_e[i])

    def forward_loss(r):
        a, b = codes_of(r)
        if config.projection_loss == "latent":
            return root_mean_square(model.to_electrode(a) - b)
        got = electrode.decode(model.to_electrode(torch.cat([a, rest])))
        return _wrong(got[:-1] - got[-1:], arrays, r, config)

    def inverse_loss(r):
        a, b = codes_of(r)
        return root_mean_square(model.to_mesh(b) - a)

    for name, loss in (("to_electrode", forward_loss), ("to_mesh", inverse_loss)):
        error = lambda loss=loss: loss(check)  # noqa: E731
        fitting.train(getattr(model, name), loss, rows, options, error, progress, curves[name])
    return model.eval(), curves


@fast_products()
def train_pointnet(
    arrays: Arrays,
    points: SkinPoints,
    train: np.ndarray,
    validation: np.ndarray,
    config: LearningConfig,
    seed: int = 0,
    progress: Callable[[int], object] | None = None,
) -> PointNet:
    """Trains the baseline on labelled interactions only; arrays: of `Arrays.at_points`. Input and output are
    those of `LatentProjection`."""
    torch.manual_seed(seed)
    unit = 1e-3 / config.mesh_scale
    net = make_pointnet(points, config, arrays.counts.shape[1]).to(arrays.device)
    rows, check = arrays.rows(train, labelled=True), arrays.rows(validation, labelled=True)
    from_rest = FromRest(net)

    def loss(r):
        return _wrong(from_rest(unit * arrays.field[r].float()), arrays, r, config)

    def validate():
        return sum(float(loss(r)) * len(r) for r in check.split(1024)) / len(check)

    options = TrainingOptions(config.batch, config.paper_steps, config.learning_rate, decay=config.decay,
                              seed=seed, graph=False)  # fmt: skip
    fitting.train(from_rest, loss, rows, options, validate, progress)
    return net.eval()
