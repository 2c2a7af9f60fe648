"""Estimates from touch for controllers: tared readings, and a regression of hidden quantities on them."""

import dataclasses
import functools
import hashlib
import importlib.resources
import json
import typing
import warnings

import numpy as np

from ..reading import read_npz
from ..sensor.channels import FULL_SCALE

if typing.TYPE_CHECKING:
    from ..coupling.config import Config

_TARE = 5  # frames averaged before any contact
_PDC_SCALE, _LOG_SCALE = 100.0, 0.1  # scale features to order one
_SMOOTHING = 0.5  # weight of the newest frame


class Touch:
    """Readings of all BioTacs of a task from its observations: tared over the first frames, low-passed.

    Attributes:
      tared: whether the tare is complete.
    """

    def __init__(self):
        self._frames, self._rest, self._value = [], None, None

    @property
    def tared(self) -> bool:
        return self._rest is not None

    def update(self, observation: dict) -> np.ndarray:
        """(nbiotac, 20) changes from rest: of ln Z of the electrodes in tenths, of PDC in hundreds of counts.

        Raises:
          ValueError: the observation has no electrodes.
        """
        names = sorted(
            name.removesuffix("electrodes") for name in observation if name.endswith("/electrodes")
        )
        if not names:
            raise ValueError("no electrodes in the observation: load the task with observe='tactile'")
        counts = np.stack([observation[n + "electrodes"] for n in names])
        raw = np.concatenate(
            [
                np.log(FULL_SCALE / np.clip(counts, 1, FULL_SCALE - 1) - 1) / _LOG_SCALE,
                np.stack([observation[n + "pdc"] for n in names]) / _PDC_SCALE,
            ],
            axis=1,
        )
        if not self.tared:
            self._frames.append(raw)
            self._value = np.zeros_like(raw)
            if len(self._frames) == _TARE:
                self._rest = np.mean(self._frames, axis=0)
            return self._value.copy()
        self._value = self._value + _SMOOTHING * (raw - self._rest - self._value)
        return self._value.copy()


def features(touch: np.ndarray) -> np.ndarray:
    """(n, 251) features of (n, 20): the touch, and constant, linear and quadratic terms of its normalised
    shape."""
    shape = 10 * touch / (np.abs(touch).sum(axis=1, keepdims=True) + 1.0)
    i, j = np.triu_indices(touch.shape[1])
    return np.concatenate([np.ones((len(touch), 1)), shape, shape[:, i] * shape[:, j], touch], axis=1)


@dataclasses.dataclass(frozen=True)
class Estimator:
    """Ridge regression of hidden quantities on one BioTac's touch and quadratic features of its shape, fitted
    by `scripts/fit_estimators.py`.

    Attributes:
      scale: (251,) of the features; weight: (251, nestimated); error: (nestimated,) RMS on held-out episodes.
    """

    scale: np.ndarray
    weight: np.ndarray
    error: np.ndarray

    def __call__(self, touch) -> np.ndarray:
        """(nbiotac, nestimated) of (nbiotac, 20)."""
        return (features(touch) / self.scale) @ self.weight


class CalibrationWarning(UserWarning):
    """An estimator is used with a BioTac that differs from the one of its fit."""


def fitted_on(config: "Config") -> dict:
    """Identification of a BioTac for an estimator, from its `coupling.Config`: digest of its skin, tier,
    material, liquid, friction, readings."""
    from ..geometry import load_skin

    skin, digest = load_skin(config.skin), hashlib.sha256()
    for array in (skin.vert, skin.elem, skin.outer_face, skin.fixed, skin.electrode_pos):
        digest.update(np.ascontiguousarray(array).tobytes())
    return {
        "skin": digest.hexdigest()[:16],
        "tier": config.tier,
        "stepper": config.stepper,
        "material": config.material or "default",
        "liquid": config.liquid,
        "friction": round(config.friction, 6),
        "readings": config.readings,
        "skin options": config.options.get("skin", {}),
    }


def check_fitted_on(name: str, stored: dict, config: "Config") -> None:
    """Warns (CalibrationWarning) if the estimator `name` of a calibration was fitted for another BioTac than
    that of a `Config`."""
    now, text = fitted_on(config), stored.get(f"{name}/fitted_on")
    then = {} if text is None else json.loads(str(text))
    differ = [key for key in now if then.get(key) != now[key]]
    if differ:
        was = ", ".join(f"{key} {then.get(key, 'unknown')!r} (here {now[key]!r})" for key in differ)
        warnings.warn(
            f"the estimator {name!r} was fitted on a BioTac with {was}: how far its estimates are off is "
            "unknown. Fit it for this one with "
            f"`python scripts/fit_estimators.py --estimators {name} --skin SKIN --tier TIER --material "
            "MATERIAL --out FILE`, then make_controller(task, env, calibration=FILE)",
            CalibrationWarning,
            stacklevel=3,
        )


@functools.cache
def load_calibration(path: str | None = None) -> dict:
    """Arrays of a file of `python scripts/fit_estimators.py`; None: the package's,
    `biotac_mj/tasks/calibration.npz`."""
    if path is None:
        with importlib.resources.as_file(importlib.resources.files(__package__) / "calibration.npz") as own:
            return load_calibration(str(own))
    return read_npz(path, "calibration", "make one with `python scripts/fit_estimators.py`")


def load_estimator(task: str, stored: dict | None = None) -> Estimator:
    """The calibrated estimator of a task ("grip" for hold and lift), from a calibration or the package's.

    Raises:
      ValueError: the task has none.
    """
    stored = load_calibration() if stored is None else stored
    if f"{task}/weight" not in stored:
        raise ValueError(
            f"no calibration of task {task!r}: run `python scripts/fit_estimators.py --estimators {task}`"
        )
    return Estimator(*(stored[f"{task}/{part}"] for part in ("scale", "weight", "error")))
