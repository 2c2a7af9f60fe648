"""Variational autoencoders: what the mesh's and the electrodes' have in common."""

import torch
from torch import nn


class VAE(nn.Module):
    """A subclass has `encode`, mean and log variance (n, latent) each of x (n, ...), and `decode`, back from
    a code (n, latent)."""

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Reconstruction from a sampled code in training, from its mean otherwise; with mean and log
        variance."""
        mean, log_variance = self.encode(x)
        z = mean + torch.randn_like(mean) * torch.exp(0.5 * log_variance) if self.training else mean
        return self.decode(z), mean, log_variance

    def loss(self, x: torch.Tensor, weight: float) -> torch.Tensor:
        """Squared error of the reconstruction of x (n, ...), summed over a sample, and the codes' divergence
        times `weight`."""
        got, mean, log_variance = self(x)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1)
        return (got - x).square().flatten(1).sum(1).mean() + weight * divergence.mean()
