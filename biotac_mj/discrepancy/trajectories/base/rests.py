"""Where a sensor's electrodes rest: an electrode answers by ln Z, so of two that rest at other counts one
shows more of the same touch. At 3150 counts 90 counts more are a gain of -7 %."""

import dataclasses
import typing
from collections.abc import Sequence

import numpy as np

from ....sensor.presets import read_sensor
from .offsets import standing

if typing.TYPE_CHECKING:
    from ..fields import Fields
    from ..simulator import Simulator
    from ..trajectory import Trajectory

__all__ = ["measured_rests", "rested"]

_LEAST, _MOST = 40.0, 4055.0  # [counts] beyond which an electrode is at the end of what it can read


def measured_rests(
    sim: "Simulator", data: "list[Trajectory]", reads: Sequence[tuple[int, int]] = ()
) -> np.ndarray:
    """(19,) mean counts before the touch; nan where one stands off (`offsets`), which is no matter of
    its impedance, or reads nothing. reads: (electrode, the one it shows), whose rest that is."""
    rest = np.mean([t.electrodes[0] for t in data], axis=0)
    if reads:
        shows, shown = np.transpose(reads)
        rest[shown] = rest[shows]
    other = rest - read_sensor(sim.sensor).rest
    away = standing(other - np.median(other))[0]
    unknown = np.isin(np.arange(19), away) | (rest < _LEAST) | (rest > _MOST)
    return np.where(unknown, np.nan, rest)


def rested(sim: "Simulator", fields: "Fields", rest: np.ndarray) -> tuple["Simulator", "Fields"]:
    """The simulator, and fields of it, with electrodes that rest at these counts (19,), where finite."""
    new = sim.rested(rest)
    shift = np.log(read_sensor(new.sensor).impedance / read_sensor(sim.sensor).impedance)
    base, quick = ([one | {"log_z": one["log_z"] + shift} for one in f] for f in (fields.base, fields.quick))
    return new, dataclasses.replace(fields, base=base, quick=quick)
