"""Networks from features of the deformed skin to d ln Z of the electrodes; their output is exactly zero for a
skin at rest."""

import torch
from torch import nn

from .electrode_vae import mlp


class FromRest(nn.Module):
    """A network's output minus that for zero input, the skin at rest.

    Args:
      net: module. work: method to call; default: the module itself.
    """

    def __init__(self, net: nn.Module, work: str = "__call__"):
        super().__init__()
        self.net, self.work, self._rest = net, work, None

    def train(self, mode: bool = True) -> "FromRest":
        self._rest = None  # weights may change
        return super().train(mode)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(n, ...) of x (n, ...)."""
        work = getattr(self.net, self.work)
        if self.training or torch.is_grad_enabled():
            y = work(torch.cat([x, torch.zeros_like(x[:1])]))
            return y[:-1] - y[-1:]
        if self._rest is None or self._rest.device != x.device:
            self._rest = work(torch.zeros_like(x[:1]))
        return work(x) - self._rest


class LocalHead(nn.Module):
    """One head for all electrodes on the features over each, a linear layer for each electrode, and a small
    residual on the whole mesh.

    The shared head has the data of all electrodes, separate ones that of one each; and it cannot recognise an
    indenter.

    Args:
      features: per electrode. modes: components of the mesh for the residual. nelectrode: electrodes.
      width: of its layers.

    Attributes:
      damp: (modes,) factors on the components: at unit variance, the last ones would be mostly noise.
    """

    def __init__(self, features: int, modes: int, nelectrode: int, width: int = 128, dropout: float = 0.1):
        super().__init__()
        self.register_buffer("scale", torch.ones(features))
        self.register_buffer("damp", torch.ones(modes))
        self.embedding = nn.Parameter(0.1 * torch.randn(nelectrode, 8))
        self.shared = mlp([features + 8, width, width, 1], dropout)
        self.own = nn.Parameter(torch.zeros(nelectrode, features))
        self.residual = mlp([modes, width, nelectrode], 0.3)
        with torch.no_grad():
            self.residual[-1].weight.mul_(0.1)

    def forward(self, local: torch.Tensor, pod: torch.Tensor) -> torch.Tensor:
        """(n, nelectrode) of local (n, nelectrode, features) and pod (n, modes)."""
        x = local / self.scale
        own = (x * self.own).sum(-1)
        return (
            self._curved(nn.Module.__call__, x, pod * self.damp)
            + own
            - self._curved(steady, torch.zeros_like(x[:1]), torch.zeros_like(pod[:1]))
        )

    def _curved(self, apply, x, pod):
        embedding = self.embedding.expand(len(x), -1, -1)
        return apply(self.shared, torch.cat([x, embedding], -1))[..., 0] + apply(self.residual, pod)


def steady(net: nn.Sequential, x: torch.Tensor) -> torch.Tensor:
    """The network without dropout: a head's output at rest must not be random in training."""
    for layer in net:
        x = x if isinstance(layer, nn.Dropout) else layer(x)
    return x
