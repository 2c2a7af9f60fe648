"""The electrode VAE of Narang et al. (ICRA 2021), 19-256-128-64-8 and mirrored for a BioTac."""

from collections.abc import Sequence

import torch
from torch import nn

from .vae import VAE


def mlp(widths: Sequence[int], dropout: float = 0.0) -> nn.Sequential:
    """Fully connected layers with ELU between them (not after the last); dropout after each hidden layer."""
    layers = []
    for i, (a, b) in enumerate(zip(widths, widths[1:])):
        layers.append(nn.Linear(a, b))
        if i < len(widths) - 2:
            layers.append(nn.ELU())
            if dropout:
                layers.append(nn.Dropout(dropout))
    return nn.Sequential(*layers)


class ElectrodeVAE(VAE):
    """Code of the electrodes. The paper's "64, 8" is read as a hidden layer of 64 and heads of 8 for mean
    and log variance.

    Args:
      nelectrode: electrodes. hidden: widths of the encoder. latent: size of the code.
    """

    def __init__(self, nelectrode: int, hidden: Sequence[int] = (256, 128, 64), latent: int = 8):
        super().__init__()
        self.latent = latent
        self.encoder = mlp([nelectrode, *hidden, 2 * latent])
        self.decoder = mlp([latent, *hidden[::-1], nelectrode])

    def encode(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log variance of the code, (n, latent) each, of x (n, nelectrode)."""
        mean, log_variance = self.encoder(x).chunk(2, -1)
        return mean, log_variance.clamp(-14, 4)

    def decode(self, z: torch.Tensor) -> torch.Tensor:
        """(n, nelectrode) of codes z (n, latent)."""
        return self.decoder(z)
