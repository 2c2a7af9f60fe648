"""Converts tared logs to raw counts with an assumed baseline."""

import numpy as np

from ..geometry.design import BIOTAC, design_of_channels
from ..sensor.channels import FULL_SCALE

_EDGE = 1.0  # [counts] distance of the results from the ends of the converter
_WHOLE = 0.02  # [counts] rounding of logs of whole counts minus a mean


def with_baseline(values: np.ndarray) -> np.ndarray:
    """(n, nelectrode) counts from tared values (n, nelectrode): plus the mean rest counts of known sensors,
    shifted as little as keeps all of an electrode's values off the ends of the converter. If values differ by
    whole counts, as after subtraction of a mean, the results are whole."""
    rest = (design_of_channels(values.shape[1]) or BIOTAC).rest_counts.round()
    turn = np.exp(2j * np.pi * values)
    fraction = np.angle(turn.mean(0)) / (2 * np.pi)  # fractional count common to all values of an electrode
    whole = np.abs(values - fraction - np.rint(values - fraction)).max(0) < _WHOLE
    out = np.where(whole, np.rint(values - fraction), values)
    low, high = np.floor(_EDGE - out.min(0)), np.ceil(FULL_SCALE - _EDGE - out.max(0))
    # a range larger than the converter's means that the values were scaled: the ends are lost
    return np.clip(out + np.clip(rest, low, np.maximum(low, high)), _EDGE, FULL_SCALE - _EDGE)
