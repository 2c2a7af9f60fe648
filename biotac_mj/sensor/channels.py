"""Channels and the data sheet's formulas between counts and physical units.

Source of the formulas and gains: SynTouch BioTac SP product manual (same electronics as the BioTac). Counts
are 12 bit, 0..4095, and may be fractional here: the acquisition rounds and clips.

Formulas that the acquisition needs use numpy's names and casts, so that `acquisition.py` compiles the same
text for the device: Warp takes np.exp for wp.exp and np.float64 for wp.float64.
"""

import numpy as np
from numpy.typing import ArrayLike

from ..geometry.design import BIOTAC

# The BioTac's; other designs have their own (`geometry.design`).
NELECTRODE, NPAC = BIOTAC.nelectrode, BIOTAC.npac  # sensing electrodes; PAC's samples of a frame
ELECTRODES, CHANNELS = BIOTAC.electrodes, BIOTAC.channels
FULL_SCALE = 4095.0
# [C] of the heated core by the manual's formula: 47 to 50 in four sensors (TDC 1890 to 2103 counts), mean
# 48.4 in two
REST_TEMPERATURE = 48.4

DIVIDER = 10e3  # [ohm]
_PDC_GAIN = 36.5  # [Pa] per count
# CHOSEN: the manual gives no offset. Leaves a range of 76 kPa above rest; a real sensor's offset depends on
# its filling
PDC_REST = 2000.0
_PAC_GAIN = 0.37  # [Pa] per count
_MIDDLE = PAC_REST = TAC_REST = FULL_SCALE / 2
_SERIES, _PARALLEL = 155183.0, 46555.0  # of the thermistor's divider
_TDC_SCALE, _ZERO_CELSIUS = 4025.0, 273.15  # [K]
_TAC_SCALE = -41.07  # [C/s]
# MEASURED: fraction of the formula's slope at mid-scale that recordings show: 1537 counts per C/s, from TAC
# and TDC of 30 traces of two sensors (PHAC-2, holds of steel, acrylic and sponge), instead of 6603.
_TAC_FRACTION = 0.233
_HOTTEST = -0.1  # [C/s] of the manual's formula at which TAC's circuit saturates
# MEASURED: noise of a resting PAC, n[i] = PAC_COLOUR n[i - 1] + PAC_NOISE white [counts]. Fitted to the
# spectrum, 25 to 1000 Hz, of 7.6 s of a resting BioTac SP (native log); error in 25 Hz bands at most 1.3 dB,
# 0.5 dB RMS. `benchmarks/vibration.py` repeats the fit.
PAC_COLOUR, PAC_NOISE = 0.238, 3.806
_NOISE_SLOPE, _NOISE_LEVEL = 15.8, 6.6  # [counts]

# Published rest counts of three sensors, e1..e19. They are data, not parameters: only the cell constants
# derive from them.
REST_COUNTS = {name: np.array(BIOTAC.sensors[name]["rest"], dtype=float) for name in BIOTAC.published}


def counts_from_impedance(impedance: ArrayLike) -> np.ndarray:
    """Electrode counts E = 4095 / (Z / 10 kohm + 1). impedance [ohm], any shape; more liquid, lower Z, higher
    E."""
    return np.float64(FULL_SCALE) / (impedance / np.float64(DIVIDER) + np.float64(1.0))


def impedance_from_counts(counts: ArrayLike) -> np.ndarray:
    """Z = (4095 / E - 1) * 10 kohm [ohm]; infinite at E = 0."""
    with np.errstate(divide="ignore"):
        return (FULL_SCALE / np.asarray(counts, dtype=float) - 1) * DIVIDER


def log_impedance(counts: ArrayLike) -> np.ndarray:
    """ln(Z / 10 kohm) = ln(4095 / E - 1) of counts, any shape. 0 and 4095 are moved by half a count, so that
    it stays finite."""
    return np.log(FULL_SCALE / np.clip(counts, 0.5, FULL_SCALE - 0.5) - 1)


def counts_from_log_impedance(log_z: ArrayLike) -> np.ndarray:
    """Counts (fractional) from ln(Z / 10 kohm), any shape: inverse of `log_impedance`, clipped to 12 bits."""
    return FULL_SCALE / (1 + np.exp(np.clip(log_z, -9.1, 9.1)))


def counts_from_pressure(pressure: ArrayLike) -> np.ndarray:
    """PDC counts: 36.5 Pa per count, with the chosen offset of 2000 counts. pressure: above rest [Pa]."""
    return np.float64(PDC_REST) + pressure / np.float64(_PDC_GAIN)


def pressure_from_counts(counts: ArrayLike) -> np.ndarray:
    """Pressure above rest [Pa] of PDC counts."""
    return (np.asarray(counts, dtype=float) - PDC_REST) * _PDC_GAIN


def saturated(change: ArrayLike, fraction: ArrayLike, knee: ArrayLike) -> np.ndarray:
    """A change of counts that loses a fraction of its excess over the knee [counts]."""
    size = np.where(change < np.float64(0.0), -change, change)
    lost = np.where(size > knee, size - knee, np.float64(0.0)) * fraction
    return change - np.where(change < np.float64(0.0), -lost, lost)


def counts_from_pac(pressure: ArrayLike) -> np.ndarray:
    """PAC counts: 0.37 Pa per count about mid-scale. pressure: already band-passed [Pa]."""
    return np.float64(_MIDDLE) + pressure / np.float64(_PAC_GAIN)


def pac_from_counts(counts: ArrayLike) -> np.ndarray:
    """Band-passed pressure [Pa] of PAC counts."""
    return (np.asarray(counts, dtype=float) - _MIDDLE) * _PAC_GAIN


def thermistor_counts(exponent: ArrayLike) -> np.ndarray:
    """TDC or TAC counts 4095 r of the manual's ln((155183 - 46555 r) / r)."""
    return np.float64(FULL_SCALE) * np.float64(_SERIES) / (np.exp(exponent) + np.float64(_PARALLEL))


def temperature_exponent(temperature: ArrayLike) -> np.ndarray:
    """The manual's logarithm for TDC at a temperature [C]."""
    return np.float64(_TDC_SCALE) / (temperature + np.float64(_ZERO_CELSIUS))


def heating_exponent(rate: ArrayLike) -> np.ndarray:
    """The manual's logarithm for TAC at dT/dt [C/s] above the value at mid-scale (see
    `heating_from_counts`)."""
    total = np.float64(_TAC_FRACTION) * rate + np.float64(_STEADY)
    # As the total approaches zero from below, the counts vanish; above zero the circuit is saturated.
    return np.float64(_TAC_SCALE) / np.where(total < np.float64(_HOTTEST), total, np.float64(_HOTTEST))


def temperature_from_counts(counts: ArrayLike) -> np.ndarray:
    """Temperature [C] of TDC counts: 4025 / ln((155183 - 46555 r) / r) - 273.15, r = TDC / 4095."""
    return _TDC_SCALE / _thermistor_log(counts) - _ZERO_CELSIUS


def counts_from_temperature(temperature: ArrayLike) -> np.ndarray:
    """TDC counts of a temperature [C], the inverse of `temperature_from_counts`."""
    return thermistor_counts(temperature_exponent(temperature))


def heating_from_counts(counts: ArrayLike) -> np.ndarray:
    """dT/dt [C/s] of TAC counts, above the value at mid-scale.

    The manual's -41.07 / ln((155183 - 46555 r) / r), r = TAC / 4095, is never zero, so it cannot be an
    absolute rate. The difference from its value at mid-scale, where TAC rests, is zero in the steady state.
    Divided by the measured fraction of the slope it spans -1.1 to +3.4 C/s; cooling raises TAC."""
    return (_TAC_SCALE / _thermistor_log(counts) - _STEADY) / _TAC_FRACTION


def electrode_noise(counts: ArrayLike) -> np.ndarray:
    """Standard deviation [counts] of an unloaded electrode that reads `counts`.

    min(15.8 (1 - E / 4095), 6.6): proportional to the voltage over the liquid, then constant. Fitted to 22508
    rows of an unloaded sensor (EPFL flat press, high-passed at about 1 Hz), RMS error 0.34 counts over its 19
    electrodes, E 2120-3250; lower counts were not measured. Rows at different times and electrodes are
    uncorrelated there (below 0.02), so the noise is drawn white and independent."""
    slope = np.float64(_NOISE_SLOPE) * (np.float64(1.0) - counts / np.float64(FULL_SCALE))
    level = np.where(slope < np.float64(_NOISE_LEVEL), slope, np.float64(_NOISE_LEVEL))
    return np.where(level > np.float64(0.0), level, np.float64(0.0))


def _thermistor_log(counts):
    r = np.asarray(counts, dtype=float) / FULL_SCALE
    with np.errstate(divide="ignore"):
        return np.log((_SERIES - _PARALLEL * r) / r)


_STEADY = float(_TAC_SCALE / _thermistor_log(_MIDDLE))  # the manual's formula where TAC rests


_LEAST, _MOST_FORCE = 8, 100.0  # a resting electrode has thousands of counts; a BioTac bears 50 N


def check_counts(counts: np.ndarray, where: str) -> None:
    """Raises ValueError for values that are not raw counts of electrodes.

    Args:
      counts: (n, nelectrode). where: name of their source, for the text.
    """
    bad = ~((counts >= 0) & (counts <= FULL_SCALE))
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise ValueError(
            f"{where}: e{column + 1} of row {row} is {counts[row, column]:g}: raw counts 0..4095 are "
            "needed, not tared, scaled or in ohm; import counts of 16 bits with --scale 0.0625"
        )
    if counts.size and counts.max() <= _LEAST:
        raise ValueError(
            f"{where}: no electrode exceeds {counts.max():g} counts: these look like volts or normalised "
            "values; raw counts 0..4095 are needed"
        )


def check_force(force: np.ndarray, where: str) -> None:
    """Raises ValueError for values that cannot be forces in newtons.

    Args:
      force: any shape, NaN if not measured. where: name of its source, for the text.
    """
    largest = np.nanmax(np.abs(force), initial=0)
    if not largest <= _MOST_FORCE:
        raise ValueError(
            f"{where}: the force reaches {largest:.4g}: a BioTac bears {_MOST_FORCE:g} N; give newtons, "
            "these look like mN or raw counts"
        )


def check_temperature(what: str, value: float, most: float, why: str) -> None:
    """Raises ValueError for an impossible temperature [C], or one above `most`, with the reason `why`."""
    if not -_ZERO_CELSIUS < value <= most:
        raise ValueError(
            f"{what} is {value} C: give a finite number above {-_ZERO_CELSIUS}, up to {most:.4g} ({why})"
        )
