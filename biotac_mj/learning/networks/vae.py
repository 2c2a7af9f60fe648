"""Variational autoencoders: what the mesh's and the electrodes' have in common."""

import torch
from torch import nn

__all__ = ["VAE"]


class VAE(nn.Module):
    """A subclass has `encode`, mean and log variance (n, latent) each of x (n, ...), and `decode`, back from
    a code (n, latent)."""

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Reconstruction from a sampled code in training, from its mean otherwise; with mean and log
        variance."""
        mean, log_variance = self.encode(x)
        z = mean + torch.randn_like(mean) * torch.exp(0.5 * log_variance) if self.training else mean
        return self.decode(z), mean, log_variance

    def loss(self, x: torch.Tensor, weight: float, kind: str = "mse") -> torch.Tensor:
        """Error of the reconstruction of x (n, ...), summed over a sample, and divergence of the codes times
        `weight`; kind: "mse", or "l1" of absolute errors."""
        got, mean, log_variance = self(x)
        error = (got - x).abs() if kind == "l1" else (got - x).square()
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1)
        return error.flatten(1).sum(1).mean() + weight * divergence.mean()
