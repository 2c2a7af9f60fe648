"""The forward model as it is used: deformed skin -> d ln Z -> impedances and counts, one sensor or many."""

import typing

import numpy as np
import torch
from torch import nn

from ..sensor.channels import NELECTRODE
from .networks.heads import LocalHead, PodHead, next_average
from .training.features import FilmFeatures, Pod
from .training.local import counts_change

if typing.TYPE_CHECKING:
    from ..geometry.skin_geometry import SkinGeometry

__all__ = ["ForwardModel"]


class ForwardModel(nn.Module):
    """Ensemble of heads on film features and components of the mesh; made by `weights.load_forward`.

    Args:
      geometry: SkinGeometry that it was trained on. meta: what the weights' file says. modes: components.

    Attributes:
      window: time constants [s] of the causal averages; () for a model without memory.
    """

    def __init__(self, geometry: "SkinGeometry", meta: dict, modes: int):
        super().__init__()
        self.meta, self.window = meta, tuple(meta["window"])
        self.nvert = geometry.nvert
        self.local = meta["kind"]["kind"] == "local"
        self.pod = Pod(geometry.nvert, modes)
        self.film = FilmFeatures(geometry) if self.local else None
        width = FilmFeatures.count * (1 + len(self.window))
        make = (
            (lambda: LocalHead(width, modes, meta["width"]))
            if self.local
            else (lambda: PodHead(modes, meta["width"]))
        )
        self.members = nn.ModuleList(make() for _ in range(meta["members"]))

    @property
    def memory(self) -> tuple[int, int, int]:
        """Shape of what a window remembers for one sensor: (len(window), 19, features)."""
        return (len(self.window), NELECTRODE, FilmFeatures.count)

    @torch.no_grad()
    def log_change(
        self, displacement: torch.Tensor, average: torch.Tensor | None = None, dt: float | torch.Tensor = 0.0
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """d ln Z against the rest.

        Args:
          displacement: (n, nvert, 3) tensor [mm].
          average: (n, *memory) causal averages before this step, or None: a skin that has been as it is for
            long.
          dt: since the last call [s].

        Returns:
          (n, 19) and the averages after the step.

        Raises:
          ValueError: wrong number of nodes, or displacements that are not finite.
        """
        if displacement.shape[1:] != (self.nvert, 3):
            raise ValueError(
                f"displacement has shape {tuple(displacement.shape)}: this model reads (n, {self.nvert}, 3)"
            )
        if not torch.isfinite(displacement).all():
            raise ValueError(
                "displacement holds values that are not finite: the skin's step did not converge; "
                "keep the last good state"
            )
        pod, local = self.pod(displacement), None
        if self.local:
            now = self.film(displacement)
            parts = [now]
            if self.window:
                if average is None:
                    average = now[:, None].expand(-1, len(self.window), -1, -1)
                else:
                    average = next_average(average.transpose(0, 1), now, dt, self.window).transpose(0, 1)
                parts += [now - average[:, k] for k in range(len(self.window))]
            local = torch.cat(parts, -1)
        return torch.stack([m(local, pod) for m in self.members]).mean(0), average

    def counts(self, displacement: torch.Tensor, tare: np.ndarray | torch.Tensor) -> torch.Tensor:
        """(n, 19) counts, fractional, for displacements (n, nvert, 3) [mm] and counts at rest, tare (19,) or
        (n, 19)."""
        tare = torch.as_tensor(tare, dtype=torch.float32, device=displacement.device)
        return counts_change(self.log_change(displacement)[0], tare) + tare
