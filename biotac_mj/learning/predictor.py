"""The trained forward model: deformed skin -> d ln Z -> impedances and counts, one sensor or many."""

import numpy as np
import torch
from torch import nn

from ..geometry.skin_geometry import SkinGeometry
from ..geometry.surface import node_normals
from .networks.graph import SparseMatrix
from .networks.heads import FromRest, LocalHead
from .networks.points import SkinPoints
from .training.arrays import Arrays
from .training.config import LearningConfig
from .training.features import FilmFeatures, Pod
from .training.paper import network_change


class _Served(nn.Module):
    """Base of models that read a deformed skin of `nvert` nodes in place of the film."""

    nvert: int

    def _check(self, displacement):
        if displacement.shape[1:] != (self.nvert, 3):
            raise ValueError(
                f"displacement has shape {tuple(displacement.shape)}: this model reads (n, {self.nvert}, 3)"
            )
        captured = displacement.is_cuda and torch.cuda.is_current_stream_capturing()  # has no values yet
        if not captured and not torch.isfinite(displacement).all():
            raise ValueError(
                "displacement holds values that are not finite: the skin's step did not converge; "
                "keep the last good state"
            )


class PointsModel(_Served):
    """A network that reads one skin at fixed points; made by `weights.load_forward` and `load_inverse`.

    Args:
      net: LatentProjection, or PointNet. points: SkinPoints. geometry: the skin that it reads.
      config: of the training. meta: description in the weights' file.
    """

    def __init__(
        self, net: nn.Module, points: SkinPoints, geometry: SkinGeometry, config: LearningConfig, meta: dict
    ):
        super().__init__()
        self.meta, self.nvert, self.config = meta, geometry.nvert, config
        self.unit = 1e-3 / config.mesh_scale
        self.net = net
        self.to_points = SparseMatrix(points.reading(geometry))
        self.electrodes = FromRest(net)
        self.field = self.to_nodes = None
        if hasattr(net, "inverse"):
            self.field, self.to_nodes = FromRest(net, "inverse"), SparseMatrix(points.spreading(geometry))
            outer = np.unique(geometry.outer_face)
            self.register_buffer("outer", torch.as_tensor(outer), persistent=False)
            inward = torch.as_tensor(
                -node_normals(geometry.vert, geometry.outer_face)[outer], dtype=torch.float32
            )
            self.register_buffer("inward", inward, persistent=False)

    @torch.no_grad()
    def log_change(self, displacement: torch.Tensor) -> torch.Tensor:
        """d ln Z (n, nelectrode) relative to rest, for displacements (n, nvert, 3) [mm]; raises like
        `ForwardModel.log_change`."""
        self._check(displacement)
        return self.electrodes(self.unit * self.to_points.fields(displacement))

    def change(self, arrays: Arrays, rows: torch.Tensor) -> torch.Tensor:
        """(k, nelectrode) predicted change of counts in rows of a set."""
        output = self.log_change(arrays.field[rows].float())
        return network_change(output, arrays.tare[rows], self.config)

    @torch.no_grad()
    def through_code(self, displacement: torch.Tensor) -> torch.Tensor:
        """Displacements (n, nvert, 3) [mm] reconstructed from the points and the mesh VAE's code."""
        u = self.unit * self.to_points.fields(displacement)
        return self.to_nodes.fields(self.net.mesh.decode(self.net.mesh.encode(u)[0])) / self.unit

    @torch.no_grad()
    def forward(self, log_change: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Displacements (n, nvert, 3) [mm] for d ln Z (n, nelectrode), and indentation of the outer nodes
        (n, nouter) [mm], at least 0."""
        field = self.to_nodes.fields(self.field(log_change)) / self.unit
        return field, (field[:, self.outer] * self.inward).sum(2).clamp(min=0)


class ForwardModel(_Served):
    """Ensemble of heads on film features and mesh components; made by `weights.load_forward`.

    Args:
      geometry: SkinGeometry of the training. meta: description in the weights' file. modes: components.
    """

    def __init__(self, geometry: SkinGeometry, meta: dict, modes: int):
        super().__init__()
        self.meta, self.nvert = meta, geometry.nvert
        self.pod, self.film = Pod(geometry.nvert, modes), FilmFeatures(geometry)
        sizes = self.film.count, modes, geometry.design.nelectrode, meta["width"]
        self.members = nn.ModuleList(LocalHead(*sizes) for _ in range(meta["members"]))

    @torch.no_grad()
    def log_change(self, displacement: torch.Tensor) -> torch.Tensor:
        """d ln Z (n, nelectrode) relative to rest.

        Args:
          displacement: (n, nvert, 3) tensor [mm].

        Raises:
          ValueError: wrong number of nodes, or displacements that are not finite.
        """
        self._check(displacement)
        features = self.film(displacement), self.pod(displacement)
        return torch.stack([member(*features) for member in self.members]).mean(0)
