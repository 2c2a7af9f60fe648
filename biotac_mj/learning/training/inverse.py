"""From electrodes to the skin: displacements, contact forces and the contact patch."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import nn

from ...sensor.channels import check_counts, log_impedance
from ..networks.electrode_vae import mlp
from ..networks.heads import steady
from . import fitting
from .arrays import Arrays
from .config import LearningConfig
from .features import Pod, mirror_order, orthogonal_modes
from .fitting import TrainingOptions, root_mean_square

PATCH = 0.15  # fraction of the largest nodal force above which a node is in the patch


class InverseHead(nn.Module):
    """d ln Z of the electrodes -> displacements of all nodes and contact force on the outer ones, through
    components of both.

    Args:
      pod: Pod of the displacements. force_modes: components of the force. nouter: outer nodes.
      nelectrode: electrodes.
    """

    def __init__(self, pod: Pod, force_modes: int, nouter: int, nelectrode: int):
        super().__init__()
        self.pod = pod
        self.modes = pod.basis.shape[1]
        self.register_buffer("force_basis", torch.zeros(nouter, force_modes))
        self.register_buffer("force_scale", torch.ones(force_modes))
        self.register_buffer("scale", torch.ones(nelectrode))
        self.net = mlp([nelectrode, 256, 256, self.modes + force_modes], 0.2)

    def codes(self, log_change: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Components of displacement (n, modes), relative to the root mean square of the first, and of force,
        for d ln Z (n, nelectrode)."""
        out = self.net(log_change / self.scale) - steady(self.net, torch.zeros_like(log_change[:1]))
        return out.split([self.modes, self.force_basis.shape[1]], 1)

    def forward(self, log_change: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Displacements (n, nvert, 3) [mm] and norm of the contact force (n, nouter) [N], at least 0."""
        u, f = self.codes(log_change)
        field = (u * self.pod.scale[0]) @ self.pod.basis.T
        return field.view(len(u), self.pod.nvert, 3), ((f * self.force_scale[0]) @ self.force_basis.T).clamp(
            min=0
        )


def train_inverse(
    arrays: Arrays,
    train: np.ndarray,
    validation: np.ndarray,
    config: LearningConfig,
    pod: tuple,
    seed: int = 0,
    progress: Callable[[int], object] | None = None,
) -> InverseHead:
    """Trains on the simulation's own film of all training interactions, labelled or not, and, where the
    fingertip is symmetric, of their mirror images, then on labelled ones. pod: (Pod, components of all rows,
    those of the mirrored touches).

    The loss weighs components by their size, so it is the error of the fields.
    """
    torch.manual_seed(seed)
    basis, now, then = pod
    rows, check = arrays.rows(train, labelled=True), arrays.rows(validation, labelled=True)
    force = arrays.force[rows].float()
    modes = min(64, *force.shape)
    head = InverseHead(basis, modes, force.shape[1], arrays.counts.shape[1]).to(arrays.device)
    for kept, found in zip((head.force_basis, head.force_scale), orthogonal_modes(force, modes)):
        kept.copy_(found)
    log_change = torch.zeros_like(arrays.counts)
    both = torch.cat([rows, check])
    log_change[both] = arrays.log_change(both)
    head.scale.copy_(log_change[rows].square().mean(0).sqrt() + 1e-3)
    every, film = arrays.rows(train), arrays.film_change()
    forces = torch.zeros(len(log_change), modes, device=arrays.device)
    for chunk in torch.cat([every, check]).split(4096):
        forces[chunk] = arrays.force[chunk].float() @ head.force_basis / head.force_scale[0]
    size = basis.scale / basis.scale[0]
    order = mirror_order(arrays.geometry)

    def error(r, flip=False, source=log_change):
        x = source[r]
        u, f = head.codes(x[:, order] if flip else x)
        value = root_mean_square(u - (then if flip else now)[r] * size)
        return value if flip else value + 0.3 * root_mean_square(f - forces[r])

    def symmetric(r):
        value = error(r, source=film)
        return value if order is None else value + 0.5 * error(r, True, film)

    options = TrainingOptions(2 * config.batch, 2 * config.steps, 2 * config.learning_rate, seed=seed)
    fitting.train(head, symmetric, every, options, progress=progress)
    rate = 0.5 * config.learning_rate
    options = TrainingOptions(config.batch, config.steps, rate, weight_decay=0.01, seed=seed)
    fitting.train(head, error, rows, options, lambda: error(check), progress)
    return head


def field_errors(got: torch.Tensor, truth: torch.Tensor) -> dict:
    """Errors [mm] of fields (n, nvert, 3) [mm], each (n,): mean of all nodes, of those displaced by more than
    50 um, of the largest displacement."""
    size = truth.norm(dim=2)
    error = (got - truth).norm(dim=2)
    moved = (size > 0.05).float()
    return {
        "mean": error.mean(1).cpu().numpy(),
        "moved": ((error * moved).sum(1) / moved.sum(1).clamp(min=1)).cpu().numpy(),
        "largest": (got.norm(dim=2).amax(1) - size.amax(1)).abs().cpu().numpy(),
    }


def contact_centre(force: np.ndarray, place: np.ndarray, patch: float = PATCH) -> np.ndarray:
    """(n, 3) force-weighted centre of the patch [m], NaN without contact. force (n, nouter) or a substitute,
    place (nouter, 3) [m] of the nodes; patch: fraction of the largest value above which nodes are in it."""
    force = np.asarray(force, float)
    weight = np.where(force > patch * force.max(1, keepdims=True), force, 0)
    total = weight.sum(1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(total > 1e-6, weight @ place / total, np.nan)


def patch_overlap(got: np.ndarray, truth: np.ndarray, patch: float = PATCH) -> np.ndarray:
    """(n,) intersection over union of the nodes above `patch` of the largest value in got (n, nouter), and
    above PATCH of the largest force in truth; NaN without contact."""
    a = got > patch * got.max(1, keepdims=True)
    b = truth > PATCH * truth.max(1, keepdims=True)
    union = (a | b).sum(1)
    return np.where(truth.max(1) > 1e-6, (a & b).sum(1) / np.maximum(union, 1), np.nan)


def patch_of_push(push: np.ndarray, force: np.ndarray) -> float:
    """Fraction of the largest indentation above which outer nodes best agree with the contact patch.

    Args:
      push: (n, nouter) indentation of nodes. force: (n, nouter) contact force.
    """
    fractions = np.arange(0.1, 0.96, 0.05)
    return float(max(fractions, key=lambda fraction: np.nanmean(patch_overlap(push, force, fraction))))


@torch.no_grad()
def inverse_errors(arrays: Arrays, model: Callable, rows: torch.Tensor, patch: float = PATCH) -> dict:
    """Errors of an inverse model, each (n,): of the field as `field_errors`, of the patch's centre [mm] and
    its overlap, NaN below 0.1 N.

    Args:
      model: rows (k,) -> field (k, nvert, 3) [mm] and force or indentation (k, nouter).
      rows: (n,) of the set. patch: see `contact_centre`.
    """
    place, found = arrays.geometry.vert[arrays.outer], []
    for r in rows.split(512):
        field, push = model(r)
        truth, push = arrays.force[r].float().cpu().numpy(), push.cpu().numpy()
        off = 1e3 * np.linalg.norm(contact_centre(push, place, patch) - contact_centre(truth, place), axis=1)
        touching = truth.sum(1) > 0.1
        own = {"centre": np.where(touching, off, np.nan)}
        own["overlap"] = np.where(touching, patch_overlap(push, truth, patch), np.nan)
        found.append(field_errors(field, arrays.field[r].float()) | own)
    return {k: np.concatenate([f[k] for f in found]) for k in found[0]}


def log_change_of(counts: ArrayLike, tare: ArrayLike) -> np.ndarray:
    """d ln Z (n, nelectrode) of raw counts (n, nelectrode) relative to the counts at rest, tare (nelectrode,)
    or (n, nelectrode).

    Raises:
      ValueError: different channels, values that are not finite, or outside 0..4095.
    """
    counts, tare = np.asarray(counts, float), np.asarray(tare, float)
    if counts.shape[-1:] != tare.shape[-1:]:
        raise ValueError(
            f"counts have shape {counts.shape} and the tare {tare.shape}: give the same electrodes of both"
        )
    for name, value in (("counts", counts), ("tare", tare)):
        check_counts(np.atleast_2d(value), name)
    return log_impedance(counts) - log_impedance(tare)
