"""Baselines of a sensor's electrodes: an electrode measures ln Z, so of two that rest at other counts one
shows more of the same touch. At 3150 counts 90 counts more are a gain of -7 %."""

import copy
import dataclasses
import typing
from collections.abc import Sequence

import numpy as np

from ....sensor.channels import DIVIDER, counts_from_log_impedance, log_impedance

if typing.TYPE_CHECKING:
    from ..model.fields import Fields
    from ..model.simulator import Simulator
    from ..trajectory import Trajectory

_LOG_DIVIDER = float(np.log(DIVIDER))
_LEAST, _MOST = 40.0, 4055.0  # [counts] beyond which an electrode is at the end of what it can read
# Electrodes that rest elsewhere, which comparisons about the rest leave out.
_FAR = 8.0  # robust standard deviations of the other electrodes, which differ from sensor to sensor
_ROBUST = 1.4826  # standard deviation of a normal variable by its median absolute deviation
_STANDING = 12.0  # [counts]
_FEW = 4  # where more stand off, it is the base model or the sensor that is another


def rested(
    sim: "Simulator",
    fields: "Fields",
    data: "list[Trajectory]",
    reads: Sequence[tuple[int, int]] = (),
) -> tuple["Simulator", "Fields"]:
    """The simulator and its fields of the data with electrodes that rest at their mean counts before touch;
    one that stands off (`_standing`), which is no matter of its impedance, or reads nothing, stays.

    Args:
      fields: as the simulator solved them. reads: (electrode, the one it shows), whose rest that is."""
    own = np.mean([one["log_z"][0] for one in fields.base], axis=0) - _LOG_DIVIDER
    rest, simulated = np.mean([t.electrodes[0] for t in data], axis=0), counts_from_log_impedance(own)
    if reads:
        shows, read = np.transpose(reads)
        rest[read] = rest[shows]
    difference = rest - simulated
    off = (
        np.isin(np.arange(len(difference)), _standing(difference - np.median(difference)))
        | (rest < _LEAST)
        | (rest > _MOST)
    )
    shift = np.where(off, 0.0, log_impedance(rest) - own)
    new = copy.copy(sim)
    new.log_rest = shift
    base, quick = ([one | {"log_z": one["log_z"] + shift} for one in f] for f in (fields.base, fields.quick))
    return new, dataclasses.replace(fields, base=base, quick=quick)


def _standing(other):
    """Indices of baselines that deviate from the model's, by differences (nelectrode,) about their median
    [counts]; none if many do."""
    away = np.abs(other)
    which = np.flatnonzero(away > max(_FAR * _ROBUST * np.median(away), _STANDING))
    return which if len(which) <= _FEW else which[:0]
