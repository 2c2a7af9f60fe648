"""`biotac learn predict`: runs a saved model on a recording, or on a data set's deformations."""

import pathlib

import numpy as np
import torch

from ...files import hdf5, replacing
from ...recordings import load_one
from ..protocol import conformal_width
from ..report import predictions_of, report_of
from ..training.arrays import load_arrays
from ..training.experiment import division_of
from ..weights import amend, describe, load_forward
from .reader import TARGETS, UNITS, Prediction, Reader, check_intervals

SUFFIXES = (".csv", ".h5", ".hdf5")
_LEVEL = 0.9
_KIND = "ensemble"  # of models saved by `biotac learn train`


def predict(
    model: pathlib.Path | str,
    source: pathlib.Path | str,
    recording: str | None = None,
    tare: int | None = None,
    **load: object,
) -> tuple[dict[str, np.ndarray], Prediction, dict]:
    """Runs a model on all rows.

    Args:
      model: reads electrodes, or, for direction "forward", a skin's deformation.
      source: file of a recording; for a forward model a data set. recording, load: of `recordings.load_one`.
      tare: number of first rows of a recording whose mean is the sensor at rest.

    Returns:
      columns that identify the row ("time" [s], for a set "interaction"), Prediction, and the model's
      description, with "notes" on the recording.

    Raises:
      FileNotFoundError, ValueError: no such file, a model that does not fit, or a missing tare.
    """
    meta = describe(model)
    if meta.get("direction") == "forward":
        return *_forward(model, source, meta), meta
    reader = Reader.load(model)
    found, notes = load_one(source, recording, **load)
    counts, assumed = found.counts()
    rest = pdc = None
    if tare is not None:
        if not 1 <= tare < len(counts):
            raise ValueError(f"--tare {tare}: {found.name} has {len(counts)} rows, some must be left")
        rest = counts[:tare].mean(0)
        if found.pdc is not None and np.isfinite(found.pdc).all():
            pdc = found.pdc - found.pdc[:tare].mean()  # tared or raw counts
    meta = reader.meta | {"notes": notes + assumed}
    return {"time": found.time}, reader.predict(counts, rest, pdc), meta


def _forward(model, source, meta):
    if "half" not in meta:
        raise ValueError(f"{model} has no intervals: write it with `biotac learn train TRAINED --out FILE`")
    check_intervals(model, meta, {"half": list[float], "usual": float})
    if len(meta["half"]) != len(meta["channels"]):
        raise ValueError(
            f"half of the description of {model} has {len(meta['half'])} numbers, "
            f"{len(meta['channels'])} are needed: write it with `biotac learn train TRAINED --out FILE`"
        )
    arrays = load_arrays(source)
    network = load_forward(model, arrays.geometry)
    tare = torch.where(torch.isfinite(arrays.tare), arrays.tare, arrays.simulated[arrays.first])
    value, strange = [], []
    for rows in torch.arange(len(arrays.owner)).split(256):
        u = arrays.field[rows].float()
        value.append(network.counts(u, tare[rows]).numpy())
        strange.append(_beyond(network.pod, u))
    strange = np.concatenate(strange) / meta["usual"]
    value = np.concatenate(value)
    half = np.asarray(meta["half"]) * (1 + strange)[:, None]
    where = {"interaction": arrays.owner.numpy(), "time": arrays.time.numpy().astype(float)}
    return where, Prediction({"electrodes": value}, {"electrodes": half}, strange)


def _beyond(pod, u):
    """(n,) RMS [mm] of the residual of displacements (n, nvert, 3) [mm] outside a model's components."""
    return (pod.decode(pod(u)) - u).square().mean((1, 2)).sqrt().numpy()


def save_forward_model(folder: pathlib.Path | str, out: pathlib.Path | str) -> None:
    """Writes the forward model of the trajectory split, with 90 % intervals from its validation interactions;
    `attach(signal=FILE)` takes it.

    Args:
      folder: of `biotac learn train`.

    Raises:
      FileNotFoundError: seed 0 of the trajectory split was not trained. ValueError: too few interactions.
    """
    folder = pathlib.Path(folder)
    source = folder / "forward-trajectory.safetensors"
    if not source.is_file():
        raise FileNotFoundError(f"no {source}: train seed 0 of the split trajectory")
    report, found = report_of(folder / "trajectory-0.json"), predictions_of(folder / "trajectory-0.npz")
    arrays = load_arrays(report["set"])
    pod = load_forward(source, arrays.geometry).pod
    check = division_of(report["set"], "trajectory", 0).validation
    rows = arrays.rows(check, labelled=True)
    strange = np.concatenate([_beyond(pod, arrays.field[r].float()) for r in rows.split(256)])
    usual = float(np.quantile(strange, 0.95))
    kept = ~found["test"]
    error = (found[f"predicted_{_KIND}"] - found["truth"])[kept] / (1 + strange / usual)[:, None]
    half = conformal_width(error, found["owner"][kept], 1 - _LEVEL)
    if not np.isfinite(half).all():
        raise ValueError(
            f"{len(check)} validation interactions are too few for intervals of 90 %: train on more"
        )
    amend(source, out, {"half": half.tolist(), "usual": usual, "level": _LEVEL})


def write_prediction(
    path: pathlib.Path | str, where: dict[str, np.ndarray], found: Prediction, meta: dict
) -> None:
    """Writes a table (.csv: a column for each number and its half width) or arrays (.h5).

    Raises:
      ValueError: another suffix.
    """
    path = pathlib.Path(path)
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{path} ends in {path.suffix or 'nothing'}: give one of {', '.join(SUFFIXES)}")
    if path.suffix != ".csv":
        with hdf5(path) as file:
            file.attrs["schema"] = "biotac_mj.prediction/1"
            file.attrs["level"] = meta["level"]
            for name, value in {**where, "novelty": found.novelty}.items():
                file[name] = value
            for name, value in found.value.items():
                file[name], file[f"{name}_half"] = value, found.half[name]
                file[name].attrs["unit"] = file[f"{name}_half"].attrs["unit"] = UNITS[name]
        return
    columns = dict(where)
    for name, value in found.value.items():
        names = TARGETS[name] or [f"e{i + 1}" for i in range(value.shape[1])]
        columns |= dict(zip(names, value.T))
        columns |= {f"{one}_half": half for one, half in zip(names, found.half[name].T)}
    columns["novelty"] = found.novelty
    with replacing(path) as temporary:
        table = np.column_stack(list(columns.values()))
        # a clock may count from 1970: ten digits before the point
        form = ["%.6f" if name == "time" else "%.6g" for name in columns]
        np.savetxt(temporary, table, form, ",", header=",".join(columns), comments="")
