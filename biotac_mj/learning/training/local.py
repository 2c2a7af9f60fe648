"""Our model: film features over each electrode, target d ln Z, with the simulation's film as a teacher."""

import functools
from collections.abc import Callable

import numpy as np
import torch

from ...geometry.skins import mesh_of_same_design
from ...sensor.channels import FULL_SCALE
from ..networks.graph import SparseMatrix
from ..networks.heads import LocalHead
from ..networks.points import SkinPoints
from . import fitting
from .arrays import Arrays
from .config import LearningConfig
from .features import FilmFeatures, Pod, mirror_matrix, mirror_order
from .fitting import TrainingOptions, root_mean_square

MODES = 32  # components of the mesh that a head reads


def film_with_gains(arrays: Arrays, fit: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Change of counts (n, nelectrode) of the simulation's own film in rows (n,), with one gain of d ln Z for
    each electrode fitted to labelled rows `fit`."""
    z = arrays.film_change()
    gain = (z[fit] * arrays.log_change(fit)).sum(0) / z[fit].square().sum(0).clamp(min=1e-9)
    return counts_change(gain * z[rows], arrays.tare[rows])


def counts_change(log_change: torch.Tensor, tare: torch.Tensor) -> torch.Tensor:
    """Change of counts from d ln Z and the counts at rest, `tare`, each (n, nelectrode)."""
    tare = tare.clamp(0.5, FULL_SCALE - 0.5)
    return FULL_SCALE / (1 + (FULL_SCALE / tare - 1) * log_change.exp()) - tare


class Features:
    """Features of all rows of a set, and of their mirror images in z, computed once.

    Args:
      arrays: Arrays. config: LearningConfig.

    Attributes:
      film: FilmFeatures. local: (n, nelectrode, k) of all rows. mirrored: the same for the mirrored
        touches.
    """

    def __init__(self, arrays: Arrays, config: LearningConfig):
        self.arrays, self.config = arrays, config
        self.film = FilmFeatures(arrays.geometry).to(arrays.device)
        self.local = self._local(lambda u: u)

    @functools.cached_property
    def mirrored(self) -> torch.Tensor:
        return self._local(self.mirror)

    @functools.cached_property
    def _matrix(self):
        return SparseMatrix(mirror_matrix(self.arrays.geometry)).to(self.arrays.device)

    def mirror(self, u: torch.Tensor) -> torch.Tensor:
        """Fields (n, nvert, 3) of the touches mirrored in the plane z = 0."""
        return self._matrix.fields(u) * torch.tensor([1.0, 1.0, -1.0], device=u.device)

    @torch.no_grad()
    def _local(self, change):
        return torch.cat([self.film(change(u)) for u in self.arrays.field.split(256)])

    @torch.no_grad()
    def components(self, pod: Pod, mirrored: bool = False) -> torch.Tensor:
        """(n, modes) components of all rows."""
        change = self.mirror if mirrored else lambda u: u.float()
        return torch.cat([pod(change(u)) for u in self.arrays.field.split(512)])

    @functools.cached_property
    def at_points(self) -> tuple[SkinPoints, Arrays]:
        """Points at which the paper's networks read the skin, and the set there."""

        own = mesh_of_same_design(self.arrays.geometry, "coarse")
        points = SkinPoints.choose(self.config.mesh_points, self.config.mesh_factors, own)
        return points, self.arrays.at_points(points)


def train_head(
    features: Features,
    train: np.ndarray,
    validation: np.ndarray,
    config: LearningConfig,
    seed: int,
    pod: tuple,
    progress: Callable[[int], object] | None = None,
) -> Callable[[torch.Tensor], torch.Tensor]:
    """Trains one head: first on d ln Z of the simulation's own film in all training interactions, labelled or
    not, and in their mirror images if the fingertip is symmetric; then on the sensor.

    Args:
      features: Features. train, validation: numbers of interactions.
      pod: (Pod, components, mirrored components), fitted on the training interactions.

    Returns:
      function (rows) -> (k, nelectrode) predicted change of counts; the head is its attribute `head`.
    """
    a = features.arrays
    torch.manual_seed(seed)
    pod, now, then = pod
    order, nelectrode = mirror_order(a.geometry), a.counts.shape[1]
    head = LocalHead(features.film.count, min(MODES, now.shape[1]), nelectrode, config.width).to(a.device)
    head.scale.copy_(features.local[a.rows(train)].square().mean((0, 1)).sqrt() + 1e-6)
    head.damp.copy_((pod.scale / pod.scale[0]).sqrt()[: len(head.damp)])

    def output(rows, flip=False):
        local = features.mirrored if flip else features.local
        pods = then if flip else now
        return head(local[rows], pods[rows][:, :MODES])

    def predict(rows):
        return counts_change(output(rows), a.tare[rows])

    def loss(rows):
        return root_mean_square(predict(rows) - a.change(rows)) / config.scale

    labelled, check = a.rows(train, labelled=True), a.rows(validation, labelled=True)
    target = a.film_change()

    def teacher_loss(rows):
        value = root_mean_square(output(rows) - target[rows])
        if order is None:
            return value
        return value + 0.5 * root_mean_square(output(rows, True) - target[rows][:, order])

    options = TrainingOptions(2 * config.batch, config.steps, 2 * config.learning_rate, seed=seed)
    fitting.train(head, teacher_loss, a.rows(train), options, progress=progress)
    rate = 0.5 * config.learning_rate
    options = TrainingOptions(config.batch, config.steps, rate, weight_decay=0.01, seed=seed)
    error = lambda: root_mean_square(predict(check) - a.change(check))  # noqa: E731
    fitting.train(head, loss, labelled, options, error, progress)

    @torch.no_grad()
    def evaluate(rows):
        return torch.cat([predict(r) for r in rows.split(2048)])

    evaluate.head = head
    return evaluate
