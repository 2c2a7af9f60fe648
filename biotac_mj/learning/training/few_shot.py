"""A new sensor with few touches: what a trained model makes of it as it is, and after a gain for each
electrode was fitted."""

import itertools
import json
import pathlib
from collections.abc import Sequence

import numpy as np
import torch
from scipy.stats import t as t_quantile

from ...files import replacing
from ...sensor.channels import FULL_SCALE, NELECTRODE
from ..protocol import interaction_errors
from ..weights import load_forward
from .arrays import load_arrays
from .local import counts_change

__all__ = ["adapt", "evaluate_new_sensor"]

_FLOOR = 2.5  # [counts] RMS of a touch that no gain explains: noise and rounding of the trained sensor
_SCATTER = np.geomspace(0.01, 0.64, 7)  # of gains, from touch to touch and between electrodes
_WITHIN, _BETWEEN, _COMMON = 0.1, 0.05, 0.2  # probable scatters, and that of the common gain around 1


def adapt(predicted: np.ndarray, measured: np.ndarray, owner: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Gains (19,) that bring predicted d ln Z (n, 19) of a new sensor's touches to measured ones; 1 where the
    touches do not ask for any.

    Every touch gives every electrode a gain by least squares in counts. Those scatter from touch to touch,
    and the electrodes' own gains scatter around a common one; both scatters are taken from the touches
    themselves (the likeliest of a grid, weighed by what other synthetic sensors showed), and each gain is the
    posterior mean given them: empirical Bayes with random effects. They are believed where touches left out,
    one after another, are predicted better with the others' gains than without (one-sided, 90 %).

    Args:
      predicted, measured: (n, 19) d ln Z. owner: (n,) touch of each row. slope: (n, 19) d counts / d ln Z
        [counts].

    Raises:
      ValueError: shapes that differ, or no rows.
    """
    predicted, measured, slope, owner = (np.asarray(v, float) for v in (predicted, measured, slope, owner))
    if (
        predicted.shape != measured.shape
        or predicted.shape != slope.shape
        or predicted.shape[1:] != (NELECTRODE,)
        or not len(predicted)
    ):
        raise ValueError(
            f"predicted {predicted.shape}, measured {measured.shape}, slope {slope.shape}: the same rows "
            "(n, 19) are needed, at least one"
        )
    touches = [owner == k for k in np.unique(owner)]
    if len(touches) < 3:
        return np.ones(NELECTRODE)
    # changes of counts, to first order
    x, y = ([slope[t] * predicted[t] for t in touches], [slope[t] * measured[t] for t in touches])
    square = np.stack([(a**2).sum(0) for a in x]) + 1e-12
    gain = np.stack([(a * b).sum(0) for a, b in zip(x, y)]) / square
    noise = _FLOOR**2 * np.array([[len(a)] for a in x]) / square
    better = []
    for k, (a, b) in enumerate(zip(x, y)):
        others = np.arange(len(touches)) != k
        error = [
            np.sqrt(((g * a - b) ** 2).mean(1)).mean() for g in (1.0, _posterior(gain[others], noise[others]))
        ]
        better.append(np.log(error[0] / error[1]))  # of touches light and hard alike
    sure = (
        np.mean(better) > t_quantile.ppf(0.9, len(better) - 1) * np.std(better, ddof=1) / len(better) ** 0.5
    )
    return _posterior(gain, noise) if sure else np.ones(NELECTRODE)


def _posterior(gain, noise):
    """Means (19,) of the electrodes' gains, given those of the touches (touches, 19) and the variances of
    their noise."""
    best, result = -np.inf, None
    for within, between in itertools.product(_SCATTER, _SCATTER):
        weight = 1 / (within**2 + noise)
        mean = (weight * gain).sum(0) / weight.sum(0)  # of each electrode
        each = between**2 + 1 / weight.sum(0)
        precision = 1 / _COMMON**2 + (1 / each).sum()
        common = (1 / _COMMON**2 + (mean / each).sum()) / precision
        # marginal likelihood of all gains, and how probable the scatters are
        spread = (
            (weight * (gain - mean) ** 2).sum()
            + ((mean - common) ** 2 / each).sum()
            + (common - 1) ** 2 / _COMMON**2
        )
        size = -np.log(weight).sum() + np.log(weight.sum(0)).sum() + np.log(each).sum() + np.log(precision)
        score = (
            -0.5 * (spread + size)
            - 0.5 * (np.log(within / _WITHIN) ** 2 + np.log(between / _BETWEEN) ** 2) / np.log(2) ** 2
        )
        if score > best:
            best, trust = score, between**2 / each
            result = trust * mean + (1 - trust) * common
    return result


def evaluate_new_sensor(
    path: pathlib.Path | str,
    weights: pathlib.Path | str,
    out: pathlib.Path | str,
    touches: Sequence[int] = (0, 1, 5, 20),
    draws: int = 10,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> dict:
    """Median RMS error [counts] on touches of a sensor that the model has not seen, after gains were fitted
    to k of its touches.

    Args:
      path: labelled set of that sensor. weights: forward model. out: JSON. draws: random choices of the k
        touches, averaged.

    Raises:
      ValueError: fewer than 10 labelled touches.
    """
    arrays = load_arrays(path, device)
    model = load_forward(weights, arrays.geometry).to(device)
    labelled = np.flatnonzero(arrays.labelled)
    if len(labelled) < 10:
        raise ValueError(
            f"{path} has {len(labelled)} labelled interactions: "
            "at least 10 are needed to adapt on some and judge on others"
        )
    predicted = _log_changes(model, arrays)
    rows = arrays.rows(labelled, labelled=True)
    p, y = predicted[rows].cpu().numpy(), arrays.log_change(rows).cpu().numpy()
    tare, truth, owner = (
        arrays.tare[rows],
        arrays.change(rows).cpu().numpy(),
        arrays.owner[rows].cpu().numpy(),
    )
    counts = arrays.counts[rows].cpu().numpy().clip(0.5, FULL_SCALE - 0.5)
    slope = counts * (1 - counts / FULL_SCALE)  # of counts = FULL_SCALE Z / (Z + R)
    rng = np.random.default_rng(seed)
    table = {"tare": float(np.median(interaction_errors(np.zeros_like(truth), truth, owner)[1]))}
    without = {}
    for k in touches:
        if k >= len(labelled) - 5:
            continue
        values = []
        for _ in range(draws if k else 1):
            chosen = np.isin(owner, rng.choice(labelled, k, replace=False))
            gain = adapt(p[chosen], y[chosen], owner[chosen], slope[chosen]) if k else np.ones(NELECTRODE)
            changes = (
                counts_change(torch.as_tensor(g * p, dtype=torch.float32, device=device), tare).cpu().numpy()
                for g in (gain, 1.0)
            )
            values.append(
                [
                    np.median(interaction_errors(c[~chosen], truth[~chosen], owner[~chosen])[1])
                    for c in changes
                ]
            )
        table[str(k)], without[str(k)] = np.mean(values, axis=0).tolist()
    result = {
        "schema": "biotac_mj.learning.new_sensor/1",
        "data": "synthetic",
        "set": str(path),
        "weights": str(weights),
        "interactions": len(labelled),
        "median_rms_counts_after_touches": table,
        "as_it_is_on_the_same_touches": without,
    }
    out = pathlib.Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(out) as temporary:
        pathlib.Path(temporary).write_text(json.dumps(result, indent=1))
    return result


def _log_changes(model, arrays):
    """(n, 19) of all rows; a window begins with each interaction, at rest."""
    position = torch.arange(len(arrays.owner), device=arrays.device) - arrays.first
    out = torch.zeros(len(position), NELECTRODE, device=arrays.device)
    average = torch.zeros(len(arrays.objects), *model.memory, device=arrays.device) if model.window else None
    for k in range(int(position.max()) + 1):
        row = (position == k).nonzero()[:, 0]
        who = arrays.owner[row]
        for part, mine in zip(row.split(512), who.split(512)):
            u = arrays.field[part].float()
            if average is None:
                out[part] = model.log_change(u)[0]
            else:
                dt = (arrays.time[part] - arrays.time[part - 1 if k else part]).view(-1, 1, 1)
                out[part], average[mine] = model.log_change(u, average[mine], dt)
    return out
