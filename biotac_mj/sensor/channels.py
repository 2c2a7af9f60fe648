"""Channels and the data sheet's formulas between counts and physical units.

Source of the formulas and gains: SynTouch BioTac SP product manual (same electronics as the BioTac). Counts
  are 12 bit, 0..4095, and may
be fractional here: rounding and clipping are the acquisition's job.
"""

import numpy as np

__all__ = [
    "CHANNELS",
    "FULL_SCALE",
    "OTHER_NOISE",
    "REST_COUNTS",
    "REST_TEMPERATURE",
    "counts_from_heating",
    "counts_from_impedance",
    "counts_from_log_impedance",
    "counts_from_pac",
    "counts_from_pressure",
    "counts_from_temperature",
    "electrode_noise",
    "heating_from_counts",
    "impedance_from_counts",
    "log_impedance",
    "pac_from_counts",
    "pressure_from_counts",
    "temperature_from_counts",
]

CHANNELS = tuple(f"e{i}" for i in range(1, 20)) + ("pdc", "pac", "tdc", "tac")
FULL_SCALE = 4095.0
REST_TEMPERATURE = 31.0  # [C] of the heated core

_DIVIDER = 10e3  # [ohm]
_PDC_GAIN = 36.5  # [Pa] per count
# CHOSEN: the manual gives no offset. Leaves 76 kPa above rest; the offset of a real sensor depends on its
# filling
_PDC_REST = 2000.0
_PAC_GAIN = 0.37  # [Pa] per count
_MIDDLE = FULL_SCALE / 2
OTHER_NOISE = 1.0  # [counts] of pdc, pac, tdc, tac: CHOSEN, none was measured
_NOISE_SLOPE, _NOISE_LEVEL = 15.8, 6.6  # [counts]

# Published rest counts of three sensors, e1..e19. They are data, not parameters: nothing is derived from them
# but the cell constants.
REST_COUNTS = {
    "1": np.array(
        [
            2075,
            3105,
            3146,
            2865,
            3136,
            2830,
            2451,
            2601,
            2634,
            2773,
            2334,
            3131,
            3177,
            2916,
            3158,
            2832,
            3019,
            3182,
            3224.0,
        ]
    ),
    "2": np.array(
        [
            2668,
            3224,
            3239,
            3003,
            3165,
            2849,
            2798,
            2873,
            2912,
            3017,
            2605,
            3202,
            3221,
            3025,
            3164,
            2874,
            3158,
            3203,
            3026.0,
        ]
    ),
    "3": np.array(
        [
            2990,
            3442,
            3404,
            3199,
            3333,
            3049,
            3146,
            3234,
            3238,
            3299,
            3021,
            3461,
            3426,
            3217,
            3334,
            3014,
            3399,
            3357,
            3092.0,
        ]
    ),
}


def counts_from_impedance(impedance):
    """Electrode counts E = 4095 / (Z / 10 kohm + 1). impedance [ohm], any shape; more liquid, lower Z, higher
    E."""
    return FULL_SCALE / (np.asarray(impedance, dtype=float) / _DIVIDER + 1)


def impedance_from_counts(counts):
    """Z = (4095 / E - 1) * 10 kohm [ohm]; infinite at E = 0."""
    with np.errstate(divide="ignore"):
        return (FULL_SCALE / np.asarray(counts, dtype=float) - 1) * _DIVIDER


def log_impedance(counts):
    """ln(Z / 10 kohm) = ln(4095 / E - 1) of counts, any shape; 0 and 4095 are taken as half a count away, so
    that it stays finite."""
    return np.log(FULL_SCALE / np.clip(counts, 0.5, FULL_SCALE - 0.5) - 1)


def counts_from_log_impedance(log_z):
    """Counts (fractional) of ln(Z / 10 kohm), any shape: the inverse of `log_impedance`, held where 12 bits
    end."""
    return FULL_SCALE / (1 + np.exp(np.clip(log_z, -9.1, 9.1)))


def counts_from_pressure(pressure):
    """PDC counts: 36.5 Pa per count over a rest count that is chosen (2000). pressure: above rest [Pa]."""
    return _PDC_REST + np.asarray(pressure, dtype=float) / _PDC_GAIN


def pressure_from_counts(counts):
    """Pressure above rest [Pa] of PDC counts."""
    return (np.asarray(counts, dtype=float) - _PDC_REST) * _PDC_GAIN


def counts_from_pac(pressure):
    """PAC counts: 0.37 Pa per count about mid-scale. pressure: already band-passed [Pa]."""
    return _MIDDLE + np.asarray(pressure, dtype=float) / _PAC_GAIN


def pac_from_counts(counts):
    """Band-passed pressure [Pa] of PAC counts."""
    return (np.asarray(counts, dtype=float) - _MIDDLE) * _PAC_GAIN


def temperature_from_counts(counts):
    """Temperature [C] of TDC counts: 4025 / ln((155183 - 46555 r) / r) - 273.15, r = TDC / 4095."""
    return 4025 / _thermistor_log(counts) - 273.15


def counts_from_temperature(temperature):
    """TDC counts of a temperature [C], the inverse of `temperature_from_counts`."""
    return FULL_SCALE * 155183 / (np.exp(4025 / (np.asarray(temperature, dtype=float) + 273.15)) + 46555)


def heating_from_counts(counts):
    """dT/dt [C/s] of TAC counts, above the value at mid-scale.

    The manual's -41.07 / ln((155183 - 46555 r) / r), r = TAC / 4095, is never zero, so it cannot be an
    absolute rate. The difference from its value at mid-scale, where TAC rests, is zero in the steady state
    and spans a plausible range (about -0.25 to +0.8 C/s); cooling raises TAC."""
    return _heating(counts) - _heating(_MIDDLE)


def counts_from_heating(rate):
    """TAC counts of dT/dt [C/s], the inverse of `heating_from_counts`; 0 where the core heats faster than the
    formula can say."""
    total = np.asarray(rate, dtype=float) + _heating(_MIDDLE)
    # As the total nears zero from below the counts vanish; beyond that the circuit is saturated.
    log = -41.07 / np.minimum(total, -0.1)
    return FULL_SCALE * 155183 / (np.exp(log) + 46555)


def electrode_noise(counts):
    """Standard deviation [counts] of an unloaded electrode that reads `counts`.

    min(15.8 (1 - E / 4095), 6.6): in proportion to the voltage over the liquid, then level. Fitted to 22508
    rows of an unloaded sensor (EPFL flat press, high-passed at about 1 Hz), RMS error 0.34 counts over its 19
    electrodes, E 2120-3250; below that nothing was measured. Rows that differ in time and electrodes are
    uncorrelated there (below 0.02), so the noise is drawn white and independent."""
    return np.minimum(
        np.maximum(_NOISE_SLOPE * (1 - np.asarray(counts, dtype=float) / FULL_SCALE), 0), _NOISE_LEVEL
    )


def _thermistor_log(counts):
    r = np.asarray(counts, dtype=float) / FULL_SCALE
    with np.errstate(divide="ignore"):
        return np.log((155183 - 46555 * r) / r)


def _heating(counts):
    return -41.07 / _thermistor_log(counts)
