"""PointNet++ on 128 nodes of the skin: the fully supervised baseline of Narang et al. (ICRA 2021).

The points' neighbours are constant (the skin bends by a few millimetres), so sampling and grouping are done
once on the rest shape (Qi et al., 2017, repeat them for every cloud)."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import nn

from ...geometry.solid import farthest_points
from .electrode_vae import mlp

_POINTS, _NEIGHBOURS = (128, 32, 8), 16  # of the levels; in each group


class PointNet(nn.Module):
    """Displacements of all nodes -> electrodes, through set abstraction over 128, 32 and 8 points.

    Args:
      vert: (nvert, 3) rest positions [m]. free: nodes to sample from (those that can move).
      nelectrode: electrodes. dropout: in the head.
    """

    def __init__(self, vert: np.ndarray, free: np.ndarray, nelectrode: int, dropout: float = 0.3):
        super().__init__()
        vert, free = np.asarray(vert, float), np.asarray(free)
        if len(free) < _POINTS[0]:
            raise ValueError(
                f"the skin has {len(free)} free nodes: {_POINTS[0]} points cannot be sampled from them"
            )
        sample = free[farthest_points(vert[free], _POINTS[0])]
        self.register_buffer("sample", torch.as_tensor(sample), persistent=False)
        place = vert[sample]
        size = np.abs(place - place.mean(0)).max()
        self.register_buffer(
            "rest", torch.as_tensor((place - place.mean(0)) / size, dtype=torch.float32), persistent=False
        )
        self.stages = nn.ModuleList()
        width = 3
        for i, (count, out) in enumerate(zip(_POINTS[1:], (64, 128))):
            centre = farthest_points(place, count)
            k = min(_NEIGHBOURS, len(place))
            group = cKDTree(place).query(place[centre], k)[1]
            relative = (place[group] - place[centre][:, None]) / size
            self.register_buffer(f"group{i}", torch.as_tensor(group), persistent=False)
            self.register_buffer(
                f"relative{i}", torch.as_tensor(relative, dtype=torch.float32), persistent=False
            )
            self.stages.append(nn.Sequential(mlp([width + 3, out, out, out]), nn.ELU()))
            place, width = place[centre], out
        self.register_buffer(
            "place", torch.as_tensor((place - place.mean(0)) / size, dtype=torch.float32), persistent=False
        )
        self.whole = nn.Sequential(mlp([width + 3, 256, 256]), nn.ELU())
        self.head = mlp([256, 256, 128, nelectrode], dropout)

    def forward(self, u: torch.Tensor) -> torch.Tensor:
        """(batch, nelectrode) of u (batch, nvert, 3), displacements divided by their scale."""
        x = u[:, self.sample]
        for i, stage in enumerate(self.stages):
            x = x[:, getattr(self, f"group{i}")]
            place = getattr(self, f"relative{i}").expand(len(x), -1, -1, -1)
            x = stage(torch.cat([x, place], -1)).amax(2)
        x = self.whole(torch.cat([x, self.place.expand(len(x), -1, -1)], -1)).amax(1)
        return self.head(x)
