"""The mesh VAE of Narang et al. (ICRA 2021): COMA's graph convolutions on the tetrahedral skin, with a code
of 128."""

from collections.abc import Sequence

import torch
from torch import nn

from .graph import ChebConv, SparseMatrix
from .hierarchy import Level
from .vae import VAE


class MeshVAE(VAE):
    """Code of a displacement field.

    Encoder: convolution to `channels[0]` ("conv 128"), a convolution and a selection of nodes for each
    factor, a last convolution, fully connected layers to mean and log variance. The decoder mirrors it, with
    interpolation before each convolution.

    Args:
      levels: of `build_hierarchy`, one more than entries in `channels`.
      first: channels of the first convolution. channels: of those before each downsampling. last: of the one
        after them.
      hidden: width of the fully connected layer. latent: size of the code. order: K of the convolutions.
    """

    def __init__(
        self,
        levels: list[Level],
        first: int = 128,
        channels: Sequence[int] = (128, 128, 256, 64),
        last: int = 64,
        hidden: int = 512,
        latent: int = 128,
        order: int = 6,
    ):
        super().__init__()
        if len(levels) != len(channels) + 1:
            raise ValueError(
                f"{len(levels)} levels for {len(channels)} stages of channels: "
                "one more level than stages is needed"
            )
        self.nvert, self.latent, self.order = levels[0].laplacian.shape[0], latent, order
        self.coarsest = levels[-1].laplacian.shape[0]
        graphs = [SparseMatrix(level.laplacian, symmetric=True) for level in levels]
        ups = [SparseMatrix(level.up) for level in levels[:-1]]
        stages = list(zip(graphs, [level.keep for level in levels[:-1]], ups))
        widths = [first, *channels]
        self.encode_convs = nn.ModuleList(
            [ChebConv(graphs[0], 3, first, order)]
            + [ChebConv(g, a, b, order, keep=keep) for (g, keep, _), a, b in zip(stages, widths, widths[1:])]
            + [ChebConv(graphs[-1], channels[-1], last, order)]
        )
        self.encode_dense = nn.Sequential(
            nn.Linear(self.coarsest * last, hidden), nn.ELU(), nn.Linear(hidden, 2 * latent)
        )
        self.decode_dense = nn.Sequential(
            nn.Linear(latent, hidden), nn.ELU(), nn.Linear(hidden, self.coarsest * last), nn.ELU()
        )
        self.decode_convs = nn.ModuleList(
            [ChebConv(graphs[-1], last, channels[-1], order)]
            + [
                ChebConv(g, b, a, order, up=up)
                for (g, _, up), a, b in reversed(list(zip(stages, widths, widths[1:])))
            ]
            + [ChebConv(graphs[0], first, 3, order, bias=False)]
        )
        self.last = last

    def encode(self, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log variance of the code, (batch, latent) each.

        Args:
          u: (batch, nvert, 3) displacements, divided by their scale.
        """
        x = nn.functional.elu(self.encode_convs[0](u.transpose(0, 1).contiguous()))
        for conv in self.encode_convs[1:]:
            x = nn.functional.elu(conv(x))
        mean, log_variance = self.encode_dense(x.transpose(0, 1).flatten(1)).chunk(2, -1)
        return mean, log_variance.clamp(-14, 4)

    def decode(self, z: torch.Tensor) -> torch.Tensor:
        """(batch, nvert, 3) of codes z (batch, latent)."""
        x = self.decode_dense(z).view(len(z), self.coarsest, self.last).transpose(0, 1)
        for conv in self.decode_convs[:-1]:
            x = nn.functional.elu(conv(x))
        return self.decode_convs[-1](x).transpose(0, 1)
