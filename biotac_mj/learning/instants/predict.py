"""`biotac learn predict`: runs a saved model on a recording."""

import pathlib

import numpy as np

from ...files import hdf5, replacing
from ...recordings import load_one
from .reader import TARGETS, UNITS, Prediction, Reader

SUFFIXES = (".csv", ".h5", ".hdf5")


def predict(
    model: pathlib.Path | str,
    source: pathlib.Path | str,
    recording: str | None = None,
    tare: int | None = None,
    **load: object,
) -> tuple[np.ndarray, Prediction, dict]:
    """Runs a model on all rows.

    Args:
      model: reads electrodes. source: file of a recording. recording, load: of `recordings.load_one`.
      tare: number of first rows of a recording whose mean is the sensor at rest.

    Returns:
      times (n,) [s], Prediction, and the model's description, with "notes" on the recording.

    Raises:
      FileNotFoundError, ValueError: no such file, a model that does not fit, or a missing tare.
    """
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
    return found.time, reader.predict(counts, rest, pdc), meta


def write_prediction(path: pathlib.Path | str, time: np.ndarray, found: Prediction, meta: dict) -> None:
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
            file["time"], file["novelty"] = time, found.novelty
            for name, value in found.value.items():
                file[name], file[f"{name}_half"] = value, found.half[name]
                file[name].attrs["unit"] = file[f"{name}_half"].attrs["unit"] = UNITS[name]
        return
    columns = {"time": time}
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
