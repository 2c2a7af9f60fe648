"""Steady-state counts without rounding, as differentiable PyTorch functions.

Time-dependent effects of `Sensor` (warm-up, relaxation, loss, drift, low-pass and latency) and noise are not
included."""

import torch

from ...sensor import channels
from ...sensor.channels import DIVIDER, FULL_SCALE, PDC_REST, counts_from_impedance, counts_from_pressure
from ...sensor.formulas import with_names
from ...sensor.presets import Sensor
from ..tensors import TORCH

_thermistor_counts, _temperature_exponent, _heating_exponent, _saturated = (
    with_names(getattr(channels, name), TORCH)
    for name in ("thermistor_counts", "temperature_exponent", "heating_exponent", "saturated")
)


def electrode_counts(
    impedance: torch.Tensor, rest: torch.Tensor, sensor: Sensor | None = None
) -> torch.Tensor:
    """Counts of the electrodes.

    Args:
      impedance: (..., nelectrode) of the film [ohm]. rest: (nelectrode,) of the film at rest [ohm].
      sensor: for rest counts, mixing, power and saturation; None: `Sensor()`.
    """
    sensor = Sensor() if sensor is None else sensor
    base = torch.tensor(sensor.rest, dtype=torch.float64)
    own = DIVIDER * (FULL_SCALE / base - 1)
    change = counts_from_impedance(own * (impedance / torch.as_tensor(rest)) ** sensor.power) - base
    if sensor.mixing:
        change = change @ torch.tensor(sensor.mixing, dtype=torch.float64).T
    return base + _saturated(change, *sensor.saturation)


def pdc_counts(pressure: torch.Tensor, sensor: Sensor | None = None) -> torch.Tensor:
    """Counts (...) of PDC at a pressure above rest [Pa]."""
    sensor = Sensor() if sensor is None else sensor
    return sensor.pdc_rest + sensor.pdc_gain * (counts_from_pressure(pressure) - PDC_REST)


def tdc_counts(temperature: torch.Tensor) -> torch.Tensor:
    """Counts (...) of TDC at a temperature of the thermistor [C]."""
    return _thermistor_counts(_temperature_exponent(torch.as_tensor(temperature, dtype=torch.float64)))


def tac_counts(rate: torch.Tensor) -> torch.Tensor:
    """Counts (...) of TAC at a constant rate of the thermistor [C/s]; constant where the circuit is
    saturated."""
    return _thermistor_counts(_heating_exponent(torch.as_tensor(rate, dtype=torch.float64)))
