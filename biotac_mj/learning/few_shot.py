"""A new sensor with few touches: what a trained model makes of it as it is, and after a gain for each electrode was fitted."""

import json
import pathlib

import numpy as np
import torch

from ..press_record import replacing
from .arrays import load_arrays
from .local import counts_change
from .protocol import interaction_errors
from .weights import load_forward

__all__ = ["adapt", "evaluate_new_sensor"]


def adapt(predicted, measured, strength=1.0) -> np.ndarray:
    """Gains (19,) that bring predicted d ln Z (n, 19) to measured ones; ridge towards 1.

    Args:
      strength: of the ridge, in units of the mean square of all predictions times the number of rows it equals: 1 weighs as 20 rows.
    """
    predicted, measured = np.asarray(predicted, float), np.asarray(measured, float)
    if predicted.shape != measured.shape or predicted.shape[1:] != (19,) or not len(predicted):
        raise ValueError(f"predicted {predicted.shape} and measured {measured.shape}: the same rows (n, 19), at least one, are needed")
    weight = 20 * strength * (predicted**2).mean()
    return ((predicted * measured).sum(0) + weight) / ((predicted**2).sum(0) + weight)


def evaluate_new_sensor(path, weights, out, touches=(0, 1, 5, 20), draws=10, seed=0, device="cpu") -> dict:
    """Median RMS error [counts] on touches of a sensor that the model has not seen, after gains were fitted to k of its touches.

    Args:
      path: labelled set of that sensor. weights: forward model. out: JSON. draws: random choices of the k touches, averaged.

    Raises:
      ValueError: fewer than 10 labelled touches.
    """
    arrays = load_arrays(path, device)
    model = load_forward(weights, arrays.geometry).to(device)
    labelled = np.flatnonzero(arrays.labelled)
    if len(labelled) < 10:
        raise ValueError(f"{path} has {len(labelled)} labelled interactions: at least 10 are needed to adapt on some and judge on others")
    predicted = _log_changes(model, arrays)
    rows = arrays.rows(labelled, labelled=True)
    p, y = predicted[rows].cpu().numpy(), arrays.log_change(rows).cpu().numpy()
    tare, truth, owner = arrays.tare[rows], arrays.change(rows).cpu().numpy(), arrays.owner[rows].cpu().numpy()
    rng = np.random.default_rng(seed)
    table = {"tare": float(np.median(interaction_errors(np.zeros_like(truth), truth, owner)[1]))}
    for k in touches:
        if k >= len(labelled) - 5:
            continue
        values = []
        for _ in range(draws if k else 1):
            chosen = np.isin(owner, rng.choice(labelled, k, replace=False))
            gain = adapt(p[chosen], y[chosen]) if k else np.ones(19)
            change = counts_change(torch.as_tensor(gain * p, dtype=torch.float32, device=device), tare).cpu().numpy()
            values.append(np.median(interaction_errors(change[~chosen], truth[~chosen], owner[~chosen])[1]))
        table[str(k)] = float(np.mean(values))
    result = {"schema": "biotac_mj.learning.new_sensor/1", "data": "synthetic", "set": str(path), "weights": str(weights),
              "interactions": len(labelled), "median_rms_counts_after_touches": table}  # fmt: skip
    out = pathlib.Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(out) as temporary:
        pathlib.Path(temporary).write_text(json.dumps(result, indent=1))
    return result


def _log_changes(model, arrays):
    """(n, 19) of all rows; a window begins with each interaction, at rest."""
    position = torch.arange(len(arrays.owner), device=arrays.device) - arrays.first
    out = torch.zeros(len(position), 19, device=arrays.device)
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
