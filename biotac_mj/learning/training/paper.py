"""The paper's way (Narang et al., ICRA 2021) on one split: two VAEs, projections between their codes,
PointNet++ beside them."""

import typing

import numpy as np
import torch
from torch import nn

from ..networks.electrode_vae import ElectrodeVAE, mlp
from ..networks.hierarchy import build_hierarchy
from ..networks.mesh_vae import MeshVAE
from ..networks.pointnet import PointNet
from .fitting import Watch, cycle, fast_products, root_mean_square

if typing.TYPE_CHECKING:
    from .arrays import Arrays
    from .config import LearningConfig

__all__ = ["LatentProjection", "train_latent_projection", "train_pointnet"]


class LatentProjection(nn.Module):
    """Displacements -> code of 128 -> code of 8 -> electrodes, and back.

    Args:
      mesh: MeshVAE. electrode: ElectrodeVAE. config: LearningConfig.
    """

    def __init__(self, mesh: MeshVAE, electrode: ElectrodeVAE, config: "LearningConfig"):
        super().__init__()
        self.mesh, self.electrode = mesh, electrode
        self.to_electrode = mlp([mesh.latent, *config.forward_hidden, electrode.latent], config.dropout)
        self.to_mesh = mlp([electrode.latent, *config.inverse_hidden, mesh.latent], config.dropout)

    def forward(self, u: torch.Tensor) -> torch.Tensor:
        """(n, 19) tared counts / 2048 of u (n, nvert, 3), displacements / mesh_scale."""
        return self.electrode.decode(self.to_electrode(self.mesh.encode(u)[0]))

    def inverse(self, y: torch.Tensor) -> torch.Tensor:
        """(n, nvert, 3) displacements / mesh_scale of y (n, 19), tared counts / 2048."""
        return self.mesh.decode(self.to_mesh(self.electrode.encode(y)[0]))


@fast_products()
def train_latent_projection(
    arrays: "Arrays",
    train: np.ndarray,
    validation: np.ndarray,
    config: "LearningConfig",
    seed: int = 0,
    watch: Watch | None = None,
) -> LatentProjection:
    """Trains both VAEs, freezes them, trains the projections.

    Args:
      arrays: Arrays. train, validation: numbers of interactions. seed: of weights and batches.
    """
    torch.manual_seed(seed)
    device, geometry = arrays.device, arrays.geometry
    unit = 1e-3 / config.mesh_scale
    mesh_rows, mesh_check = arrays.rows(train), arrays.rows(validation)
    mesh_check = mesh_check[
        torch.linspace(0, len(mesh_check) - 1, min(256, len(mesh_check))).long().to(device)
    ]
    levels = build_hierarchy(geometry.vert, geometry.tets, config.mesh_factors)
    vae = MeshVAE(
        levels,
        config.mesh_first,
        config.mesh_channels,
        config.mesh_last,
        config.mesh_hidden,
        config.mesh_latent,
        config.mesh_order,
    ).to(device)

    def field(rows):
        return unit * arrays.field[rows].float()

    def mesh_loss(rows):
        u = field(rows)
        return _vae_loss(u, *vae(u), config.mesh_kl, config.reconstruction)

    def mesh_validate():
        return sum(float((vae(field(r))[0] - field(r)).square().sum()) for r in mesh_check.split(64))

    cycle(
        vae,
        mesh_loss,
        mesh_rows,
        config.mesh_batch,
        config.mesh_steps,
        config.learning_rate,
        mesh_validate,
        checks=4,
        decay=config.decay,
        seed=seed,
        graph=False,
        watch=watch,
    )

    rows, check = arrays.rows(train, labelled=True), arrays.rows(validation, labelled=True)
    y = torch.zeros_like(arrays.counts)
    for part in (rows, check):
        y[part] = arrays.change(part) / config.scale
    electrode = ElectrodeVAE(hidden=config.electrode_hidden, latent=config.electrode_latent).to(device)

    def electrode_loss(r):
        return _vae_loss(y[r], *electrode(y[r]), config.electrode_kl, config.reconstruction)

    cycle(electrode, electrode_loss, rows, config.batch, config.paper_steps, config.learning_rate,
          lambda: (electrode(y[check])[0] - y[check]).square().mean(), decay=config.decay, seed=seed,
          graph=config.graphs, watch=watch)  # fmt: skip

    model = LatentProjection(vae, electrode, config).to(device)
    for part in (vae, electrode):
        part.requires_grad_(False)
    both = torch.cat([rows, check])
    with torch.no_grad():
        codes = [vae.encode(field(r)) for r in both.split(256)]
        z_m, s_m = torch.cat([c[0] for c in codes]), torch.cat([(0.5 * c[1]).exp() for c in codes])
        z_e, v_e = electrode.encode(y[both])
        s_e = (0.5 * v_e).exp()
    place = torch.full((len(arrays.counts),), -1, dtype=torch.long, device=device)
    place[both] = torch.arange(len(both), device=device)

    def codes_of(r):
        i = place[r]
        if not (config.sample_codes and model.training):
            return z_m[i], z_e[i]
        return z_m[i] + s_m[i] * torch.randn_like(z_m[i]), z_e[i] + s_e[i] * torch.randn_like(z_e[i])

    def forward_loss(r):
        a, b = codes_of(r)
        if config.projection_loss == "decoded":
            return root_mean_square(electrode.decode(model.to_electrode(a)) - y[r])
        return root_mean_square(model.to_electrode(a) - b)

    def inverse_loss(r):
        a, b = codes_of(r)
        return root_mean_square(model.to_mesh(b) - a)

    kind = dict(
        batch=config.batch,
        steps=config.paper_steps,
        learning_rate=config.learning_rate,
        decay=config.decay,
        seed=seed,
    )
    kind |= dict(graph=config.graphs, watch=watch)
    cycle(model.to_electrode, forward_loss, rows, validate=lambda: forward_loss(check), **kind)
    cycle(model.to_mesh, inverse_loss, rows, validate=lambda: inverse_loss(check), **kind)
    return model.eval()


@fast_products()
def train_pointnet(
    arrays: "Arrays",
    train: np.ndarray,
    validation: np.ndarray,
    config: "LearningConfig",
    seed: int = 0,
    watch: Watch | None = None,
) -> PointNet:
    """Trains the baseline on labelled interactions alone; input displacements / mesh_scale, output tared
    counts / 2048."""
    torch.manual_seed(seed)
    geometry, unit = arrays.geometry, 1e-3 / config.mesh_scale
    free = np.setdiff1d(np.arange(geometry.nvert), geometry.fixed)
    net = PointNet(geometry.vert, free, dropout=config.dropout).to(arrays.device)
    rows, check = arrays.rows(train, labelled=True), arrays.rows(validation, labelled=True)

    def loss(r):
        return root_mean_square(net(unit * arrays.field[r].float()) - arrays.change(r) / config.scale)

    def validate():
        return sum(float(loss(r)) * len(r) for r in check.split(1024)) / len(check)

    cycle(
        net,
        loss,
        rows,
        config.batch,
        config.paper_steps,
        config.learning_rate,
        validate,
        decay=config.decay,
        seed=seed,
        graph=False,
        watch=watch,
    )
    return net


def _vae_loss(x, got, mean, log_variance, weight, kind):
    error = (got - x).abs() if kind == "l1" else (got - x).square()
    divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1)
    return error.flatten(1).sum(1).mean() + weight * divergence.mean()
