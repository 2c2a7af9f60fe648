"""Logs from which a rest was subtracted, put on an assumed one."""

import numpy as np

from ..geometry.design import BIOTAC, design_of_channels
from ..sensor.channels import FULL_SCALE

__all__ = ["on_a_rest"]

_EDGE = 1.0  # [counts] by which what is put on a rest stays off the ends of the converter
_WHOLE = 0.02  # [counts] by which a log of whole counts, of which a mean was subtracted, is written inexactly


def on_a_rest(values: np.ndarray) -> np.ndarray:
    """(n, nelectrode) counts of tared values (n, nelectrode): the mean rest of known sensors, moved no
    farther than keeps all of an electrode's values off the ends of the converter. Where values differ by
    whole counts, as those do from which a mean was subtracted, the counts are whole."""
    rest = (design_of_channels(values.shape[1]) or BIOTAC).rest_counts.round()
    turn = np.exp(2j * np.pi * values)
    part = np.angle(turn.mean(0)) / (2 * np.pi)  # of a count that all values of an electrode have in common
    whole = np.abs(values - part - np.rint(values - part)).max(0) < _WHOLE
    out = np.where(whole, np.rint(values - part), values)
    low, high = np.floor(_EDGE - out.min(0)), np.ceil(FULL_SCALE - _EDGE - out.max(0))
    # one that moves by more than the converter reads was scaled: its ends are lost
    return np.clip(out + np.clip(rest, low, np.maximum(low, high)), _EDGE, FULL_SCALE - _EDGE)
