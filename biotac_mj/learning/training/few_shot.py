"""Adaptation to a new sensor with few touches: errors of the film and of a trained model, unadapted and with
a mixing of their electrodes fitted to the touches."""

import pathlib
from collections.abc import Sequence

import numpy as np
import torch

from ...effects.sensor_file import SensorFile, write_sensor_file
from ...files import write_json
from ...sensor.channels import FULL_SCALE
from ..protocol import interaction_errors, is_better
from ..weights import load_forward
from .arrays import load_arrays
from .local import counts_change

_PENALTIES = np.geomspace(1e-4, 1e2, 13)  # of a mixing, relative to the mean square of its inputs


def fit_gains(predicted: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Gains (nelectrode,) by least squares of changes of counts, predicted and measured (n, nelectrode)."""
    return (predicted * measured).sum(0) / np.maximum((predicted**2).sum(0), 1e-9)


def fit_mixing(predicted: np.ndarray, measured: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Matrix (nelectrode, k) from predicted changes of counts (n, k) to measured ones (n, nelectrode): gains,
    cross-talk and common coupling of a sensor, and coefficients of further columns.

    Ridge regression towards gains (Hoerl and Kennard, 1970). Leave-one-touch-out cross-validation selects the
    penalty, and whether the gains are common or one per electrode. Fewer than three touches give the common
    gain only.

    Args:
      predicted: (n, k), the electrodes first. owner: (n,) touch of each row.

    Raises:
      ValueError: incompatible shapes, or no rows.
    """
    x, y, owner = np.asarray(predicted, float), np.asarray(measured, float), np.asarray(owner)
    if len(x) != len(y) or len(owner) != len(y) or not len(y) or x.shape[1] < y.shape[1]:
        raise ValueError(
            f"predicted {x.shape}, measured {y.shape}, owner {owner.shape}: the same rows are needed, at "
            "least one, and a column for each electrode"
        )
    touches = [owner == k for k in np.unique(owner)]
    squares = np.stack([x[t].T @ x[t] for t in touches])  # (touches, k, k)
    products = np.stack([y[t].T @ x[t] for t in touches])  # (touches, n, k)
    square, product = squares.sum(0), products.sum(0)
    if len(touches) < 3:
        return _ridge(square, product, np.inf, _common_gain)
    choices = [(penalty, prior) for prior in (_common_gain, _own_gains) for penalty in (*_PENALTIES, np.inf)]
    errors = np.zeros((len(choices), len(touches)))
    for k, touch in enumerate(touches):
        for i, choice in enumerate(choices):
            mixing = _ridge(square - squares[k], product - products[k], *choice)
            errors[i, k] = np.sqrt(((x[touch] @ mixing.T - y[touch]) ** 2).mean(1)).mean()
    return _ridge(square, product, *choices[int(errors.mean(1).argmin())])


def _ridge(square, product, penalty, prior):
    """Matrix (n, k) of ridge regression towards a prior, from x'x (k, k) and y'x (n, k)."""
    n, k = product.shape
    begin = np.eye(n, k) * prior(np.diag(square)[:n], np.diag(product))[:, None]
    if np.isinf(penalty):
        return begin
    size = penalty * np.trace(square) / k + 1e-9
    return begin + np.linalg.solve(square + size * np.eye(k), (product - begin @ square).T).T


def simplest_mixing(predicted: np.ndarray, measured: np.ndarray, owner: np.ndarray) -> tuple[str, np.ndarray]:
    """The first of "no change", "gains" and "mixing" that none after it is significantly better than, and its
    matrix (nelectrode, nelectrode) fitted to all touches; arguments as for `fit_mixing`.

    They are compared on the stronger half of the touches, fitted to the weaker half: a sensor is used in
    contacts beyond its touches, where coefficients that these leave open do harm.
    """
    fits = {
        "no change": lambda x, y, owner: np.eye(y.shape[1]),
        "gains": lambda x, y, owner: np.diag(fit_gains(x, y)),
        "mixing": fit_mixing,
    }
    touches, size = interaction_errors(np.zeros_like(measured), measured, owner)
    aside = np.isin(owner, touches[np.argsort(size)[len(size) // 2 :]])
    best = least = None
    for name, fit in fits.items():
        matrix = fit(predicted[~aside], measured[~aside], owner[~aside])
        error = predicted[aside] @ matrix.T - measured[aside]
        if least is None or is_better(error, least, owner[aside]):
            best, least = name, error
    return best, fits[best](predicted, measured, owner)


def _common_gain(square, product):
    return np.full(len(square), product.sum() / max(square.sum(), 1e-9))


def _own_gains(square, product):
    return product / np.maximum(square, 1e-9)


def evaluate_new_sensor(
    path: pathlib.Path | str,
    weights: pathlib.Path | str,
    out: pathlib.Path | str,
    touches: Sequence[int] = (0, 5, 20),
    draws: int = 10,
    sensor: pathlib.Path | str | None = None,
) -> dict:
    """Median RMS error [counts] on touches of an unseen sensor, after gains or a mixing were fitted to k of
    its touches; with no change, and the simulated film with the same fits, as baselines.

    Args:
      path: labelled set of that sensor. weights: forward model. out: JSON. draws: random choices of the k
        touches, averaged. Every model is evaluated on the same other touches.
      sensor: YAML file for `attach(effects=)`: the sensor's rest counts, the film's `simplest_mixing`.

    Returns:
      "median_rms_counts": {model: {k: error}}; for k = 0 the model is unchanged. With `sensor`
      also "adapted", what `simplest_mixing` chose, and "largest_force" [N] of the touches.

    Raises:
      ValueError: fewer than 10 labelled touches.
    """
    arrays = load_arrays(path)
    model = load_forward(weights, arrays.geometry)
    labelled = np.flatnonzero(arrays.labelled)
    if len(labelled) < 10:
        raise ValueError(
            f"{path} has {len(labelled)} labelled interactions: "
            "at least 10 are needed to adapt on some and judge on others"
        )
    rows = arrays.rows(labelled, labelled=True)
    tare, truth = arrays.tare[rows], arrays.change(rows).cpu().numpy()
    owner = arrays.owner[rows].cpu().numpy()
    by_network = torch.cat([model.log_change(arrays.field[r].float()) for r in rows.split(512)])
    film, network = (counts_change(z, tare).cpu().numpy() for z in (arrays.film_change()[rows], by_network))
    inputs = {"film": film, "weights": network, "film and weights": np.concatenate([film, network], 1)}

    def rms(predicted, keep):
        whole = np.clip(tare.cpu().numpy() + predicted, 0, FULL_SCALE) - tare.cpu().numpy()
        return float(np.median(interaction_errors(whole[keep], truth[keep], owner[keep])[1]))

    rng, table = np.random.default_rng(0), {}
    for k in touches:
        if k > len(labelled) - 5:
            continue
        found = {}
        for _ in range(draws if k else 1):
            chosen = np.isin(owner, rng.choice(labelled, k, replace=False))
            predictions = {"no change": np.zeros_like(truth), "film": film, "weights": network}
            if k:
                x, y, touched = film[chosen], truth[chosen], owner[chosen]
                predictions["film with gains"] = fit_gains(x, y) * film
                predictions["weights with gains"] = fit_gains(network[chosen], y) * network
                for name, value in inputs.items():
                    predictions[f"{name} with mixing"] = value @ fit_mixing(value[chosen], y, touched).T
            for name, value in predictions.items():
                found.setdefault(name, []).append(rms(value, ~chosen))
        for name, values in found.items():
            table.setdefault(name, {})[str(k)] = float(np.mean(values))
    result = {
        "schema": "biotac_mj.learning.new_sensor/2",
        "data": arrays.sensor,
        "set": str(path),
        "weights": str(weights),
        "interactions": len(labelled),
        "median_rms_counts": table,
    }
    if sensor is not None:
        own = {"rest": arrays.counts[arrays.first[rows].unique()].mean(0).tolist()}
        result["adapted"], mixing = simplest_mixing(film, truth, owner)
        result["largest_force"] = float(arrays.force[rows].float().sum(1).max())
        own |= {"mixing": mixing.tolist()} if result["adapted"] != "no change" else {}
        write_sensor_file(sensor, SensorFile({"sensor": own, "signal": "physics"}, [], {}))
    write_json(out, result)
    return result
