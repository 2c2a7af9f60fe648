"""Choices that the paper leaves open, in one place, saved with every result."""

import dataclasses

import numpy as np

from ...fields import check_choice, check_types

_MOST = {"dropout": 1.0, "decay": 1.0 + 1e-9, "members": 1000}


@dataclasses.dataclass(frozen=True)
class LearningConfig:
    """Choices of models and training, where the paper (Narang et al., ICRA 2021) leaves them open.

    Attributes:
      mesh_order: K of the Chebyshev convolutions: 6, as in COMA and ACROSS.
      mesh_scale: displacements are divided by this length [m] instead of node-wise z-scores, which would
        amplify solver noise at fixed nodes.
      mesh_kl, electrode_kl: weight of the divergence, summed over the code, relative to the squared error
        summed over the field (in units of its scale), without annealing.
      mesh_points: number of points of the coarse skin at which the paper's networks read any skin.
      mesh_channels, mesh_first, mesh_last, mesh_hidden, mesh_latent: of the paper; heads for mean and log
        variance follow the hidden layer; no normalisation layers, no activation at the output, no bias in
        the last convolution. mesh_factors: ratios of the numbers of points of successive levels.
      electrode_hidden, electrode_latent: of the paper.
      forward_hidden, inverse_hidden: the paper's widths are read as hidden layers, followed by a linear layer
        to the code.
      sample_codes: train projections on samples of the codes instead of their means; evaluation uses means.
      projection_loss: "latent" (RMS between codes, the paper's) or "decoded" (RMS in the electrodes).
      logarithm: the paper's networks and PointNet++ learn d ln Z, so that they work for sensors with other
        counts at rest; False: tared counts, the paper's, for comparison only.
      dropout: of the projections, the paper's.
      learning_rate, decay: Adam's, and its factor per epoch; the decay of 20 epochs is spread over any
        training length.
      batch, steps: of our models. paper_steps: of the paper's electrode VAE, its projections and PointNet++,
        with the same batch; mesh_batch, mesh_steps: of its mesh VAE. The paper gives none. The best
        state on the validation interactions is kept.
      scale: unit of counts, 2048 for the paper's, after subtraction of row 0 of each interaction, before
        touch.
      pod: number of principal components of the mesh. width: of our networks.
      members: networks that are averaged in our model.
    """

    mesh_order: int = 6
    mesh_scale: float = 1e-3
    mesh_kl: float = 1e-3
    electrode_kl: float = 1e-5
    mesh_points: int = 686
    mesh_first: int = 128
    mesh_channels: tuple[int, ...] = (128, 128, 256, 64)
    mesh_factors: tuple[int, ...] = (2, 2, 4, 2)
    mesh_last: int = 64
    mesh_hidden: int = 512
    mesh_latent: int = 128
    electrode_hidden: tuple[int, ...] = (256, 128, 64)
    electrode_latent: int = 8
    forward_hidden: tuple[int, ...] = (256, 128, 128)
    inverse_hidden: tuple[int, ...] = (128, 128, 256)
    sample_codes: bool = False
    projection_loss: str = "latent"
    logarithm: bool = True
    dropout: float = 0.3
    learning_rate: float = 1e-3
    decay: float = 0.95
    batch: int = 256
    steps: int = 1000
    paper_steps: int = 4000
    mesh_batch: int = 64
    mesh_steps: int = 4000
    scale: float = 2048.0
    pod: int = 128
    width: int = 128
    members: int = 3

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, list):
                object.__setattr__(self, field.name, tuple(value))
        check_types(self)
        for field in dataclasses.fields(self):
            value = np.asarray(getattr(self, field.name))
            most = _MOST.get(field.name, np.inf)
            if value.dtype.kind in "if" and not (np.isfinite(value) & (value >= 0) & (value < most)).all():
                limit = f" and below {most:g}" if np.isfinite(most) else ""
                raise ValueError(f"{field.name} is {value.tolist()}: it must not be negative{limit}")
            if value.dtype.kind == "i" and not value.all():
                raise ValueError(f"{field.name} is {value.tolist()}: it must be at least 1")
        for name in ("mesh_scale", "learning_rate", "scale", "decay"):
            if not getattr(self, name):
                raise ValueError(f"{name} is 0: it must be positive")
        check_choice("unknown projection_loss", self.projection_loss, ("latent", "decoded"))
        if len(self.mesh_channels) != len(self.mesh_factors):
            raise ValueError(
                f"mesh_channels {self.mesh_channels} and mesh_factors {self.mesh_factors} must be equally "
                "many"
            )
