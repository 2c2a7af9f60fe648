"""Our models: principal components or local film features, target d ln Z, with the simulation's film as a
teacher."""

import functools
import typing
from collections.abc import Callable

import numpy as np
import torch

from ...sensor.channels import FULL_SCALE
from ..networks.graph import SparseMatrix
from ..networks.heads import LocalHead, PodHead, averages
from . import fitting
from .features import ELECTRODE_MIRROR, FilmFeatures, mirror_matrix
from .fitting import Checkpoints, TrainingOptions, root_mean_square

if typing.TYPE_CHECKING:
    from ..networks.points import SkinPoints
    from .arrays import Arrays
    from .config import LearningConfig
    from .features import Pod

__all__ = ["Features", "counts_change", "film_with_gains", "train_head"]


def film_with_gains(arrays: "Arrays", fit: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Change of counts (n, 19) of the simulation's own film in rows (n,), with one gain of d ln Z for each
    electrode fitted to labelled rows `fit`."""
    z = arrays.film_change()
    gain = (z[fit] * arrays.log_change(fit)).sum(0) / z[fit].square().sum(0).clamp(min=1e-9)
    return counts_change(gain * z[rows], arrays.tare[rows])


def counts_change(log_change: torch.Tensor, tare: torch.Tensor) -> torch.Tensor:
    """Change of counts (n, 19) from d ln Z (n, 19) and the counts at rest, `tare` (n, 19)."""
    tare = tare.clamp(0.5, FULL_SCALE - 0.5)
    return FULL_SCALE / (1 + (FULL_SCALE / tare - 1) * log_change.exp()) - tare


class Features:
    """Features of all rows of a set, and of their mirror images in z, computed once.

    Args:
      arrays: Arrays. config: LearningConfig.

    Attributes:
      film: FilmFeatures. local: (n, 19, k) current features, then these minus their causal averages.
        mirrored: the same for the mirrored touches, or None.
    """

    def __init__(self, arrays: "Arrays", config: "LearningConfig"):
        self.arrays, self.config = arrays, config
        self.film = FilmFeatures(arrays.geometry).to(arrays.device)
        self.local = self._local(lambda u: u)
        self.mirrored = self.matrix = None
        if config.mirror:
            self.matrix = SparseMatrix(mirror_matrix(arrays.geometry)).to(arrays.device)
            self.mirrored = self._local(self.mirror)

    def mirror(self, u: torch.Tensor) -> torch.Tensor:
        """Fields (n, nvert, 3) of the touches mirrored in the plane z = 0."""
        return self.matrix.fields(u) * torch.tensor([1.0, 1.0, -1.0], device=u.device)

    @torch.no_grad()
    def _local(self, change):
        a = self.arrays
        value = torch.cat([self.film(change(u)) for u in a.field.split(256)])
        return (
            torch.cat([value, averages(value, a.first, a.time, self.config.window)], -1)
            if self.config.window
            else value
        )

    @torch.no_grad()
    def components(self, pod: "Pod", mirrored: bool = False) -> torch.Tensor:
        """(n, modes) components of all rows."""
        change = self.mirror if mirrored else lambda u: u.float()
        return torch.cat([pod(change(u)) for u in self.arrays.field.split(512)])

    @functools.cached_property
    def at_points(self) -> tuple["SkinPoints", "Arrays"]:
        """Points at which the paper's networks read the skin, and the set there."""
        from ..networks.points import SkinPoints

        points = SkinPoints.choose(self.config.mesh_points, self.config.mesh_factors)
        return points, self.arrays.at_points(points)


def train_head(
    features: Features,
    train: np.ndarray,
    validation: np.ndarray,
    config: "LearningConfig",
    kind: str = "local",
    window: bool = True,
    teach: bool = True,
    mirror: bool = False,
    log: bool = True,
    seed: int = 0,
    pod: tuple | None = None,
    checkpoints: Checkpoints | None = None,
) -> Callable[[torch.Tensor], torch.Tensor]:
    """Trains one head.

    Args:
      features: Features. train, validation: numbers of interactions.
      kind: "pod" or "local". window: with causal averages. teach: first learn d ln Z of the simulation's own
        film on all training interactions, labelled or not, and on their mirror images, since the simulation
        is symmetric. mirror: also use mirrored measured touches, though no sensor is symmetric. log: target d
        ln Z relative to a known tare; False: tared counts.
      pod: (Pod, components, mirrored components or None), fitted on the training interactions.

    Returns:
      function (rows) -> (k, 19) predicted change of counts; the head is its attribute `head`.
    """
    a = features.arrays
    torch.manual_seed(seed)
    pod, now, then = pod
    base = features.film.count
    width = features.local.shape[2] if window else base
    mirror = mirror and features.mirrored is not None
    order = torch.as_tensor(ELECTRODE_MIRROR, device=a.device)
    if kind == "pod":
        head = PodHead(now.shape[1], config.width).to(a.device)
    else:
        head = LocalHead(width, min(32, now.shape[1]), config.width).to(a.device)
        rows = a.rows(train)
        head.scale.copy_(features.local[rows][..., :width].square().mean((0, 1)).sqrt() + 1e-6)

    head.damp.copy_((pod.scale / pod.scale[0]).sqrt()[: len(head.damp)])

    def output(rows, flip=False):
        local = features.mirrored if flip else features.local
        pods = then if flip else now
        return head(local[rows][..., :width], pods[rows][:, : 32 if kind == "local" else None])

    def predict(rows, flip=False):
        d = output(rows, flip)
        tare = a.tare[rows]
        return counts_change(d, tare[:, order] if flip else tare) if log else d * config.scale

    def loss(rows):
        truth = a.change(rows)
        value = root_mean_square(predict(rows) - truth)
        if mirror:
            value = value + 0.5 * root_mean_square(predict(rows, True) - truth[:, order])
        return value / config.scale

    labelled, check = a.rows(train, labelled=True), a.rows(validation, labelled=True)
    if teach and log:
        target = a.film_change()

        def teacher_loss(rows):
            value = root_mean_square(output(rows) - target[rows])
            return (
                value + 0.5 * root_mean_square(output(rows, True) - target[rows][:, order])
                if features.mirrored is not None
                else value
            )

        options = TrainingOptions(
            2 * config.batch, config.steps, 2 * config.learning_rate, seed=seed, graph=config.graphs
        )
        fitting.train(head, teacher_loss, a.rows(train), options, checkpoints=checkpoints)
    rate = config.learning_rate * (0.5 if teach else 1)
    options = TrainingOptions(
        config.batch, config.steps, rate, weight_decay=0.01, seed=seed, graph=config.graphs
    )
    error = lambda: root_mean_square(predict(check) - a.change(check))  # noqa: E731
    fitting.train(head, loss, labelled, options, error, checkpoints)

    @torch.no_grad()
    def evaluate(rows):
        return torch.cat([predict(r) for r in rows.split(2048)])

    evaluate.head, evaluate.pod, evaluate.width = head, pod, width
    return evaluate
