"""The sensor's temperatures as a differentiable PyTorch function, for one sensor: the
source of the kernel `sensor.heat.step_heat`, run on tensors.

Temperatures depend smoothly on the contact areas, except where an area stops growing or covers the whole pad:
there the derivatives are one-sided."""

import dataclasses
import functools
import math
import types
from collections.abc import Iterable

import torch

from ...fields import as_real, refuse_unknown
from ...sensor import heat as own
from ...sensor.formulas import with_globals
from ...sensor.heat import HeatParameters
from ..tensors import real_tensor

_UNITS = {
    "area": "square metres, 0 or more",
    "force": "newtons, 0 or more",
    "begin": "a state of finite numbers",
}
_CONSTANTS = [field.name for field in dataclasses.fields(HeatParameters)][1:]


def temperatures(
    area: torch.Tensor, force: torch.Tensor, dt: float, begin: torch.Tensor, constants: dict | None = None
) -> torch.Tensor:
    """States (nstep, nstate) of a sensor's heat after each step, with the layout of `sensor.heat`: TDC from
    [:, THERMISTOR], the electrodes' factor from [:, ABOVE].

    Args:
      area, force: (nstep, nbody) contact area [m^2] and normal force [N] of each body.
      dt: of a step [s].
      begin: (nstate,) initial state, from `HeatParameters.rest` or `begin_heat`; it includes power and
        materials of the bodies.
      constants: numbers by the names of `HeatParameters`, except its power; omitted ones have their defaults.

    Raises:
      ValueError: incompatible shapes, values that are not finite or negative, an unknown or invalid constant,
        or a time step that is not positive.
    """
    constants = constants or {}
    given = {"area": area, "force": force, "begin": begin}
    area, force, begin = (real_tensor(name, value).cpu() for name, value in given.items())
    if area.ndim != 2 or force.shape != area.shape:
        raise ValueError(
            f"area has shape {tuple(area.shape)} and force {tuple(force.shape)}: pass (nstep, nbody) of both"
        )
    size = own.state_size(area.shape[1])
    if begin.shape != (size,):
        raise ValueError(f"begin has shape {tuple(begin.shape)}: {area.shape[1]} bodies make it ({size},)")
    for name, value, least in (("area", area, 0.0), ("force", force, 0.0), ("begin", begin, -math.inf)):
        if not (torch.isfinite(value) & (value >= least)).all():
            raise ValueError(f"{name} is negative or no number somewhere: give {_UNITS[name]}")
    as_real("dt", dt, 0.0, above=True, unit="s")
    refuse_unknown(constants, _CONSTANTS, "constants")
    values = {name: float(torch.as_tensor(value).detach()) for name, value in constants.items()}
    q = dataclasses.asdict(HeatParameters(**values)) | constants  # raises for invalid values
    q = {name: torch.as_tensor(value, dtype=torch.float64, device="cpu") for name, value in q.items()}
    own_numbers, states = [list(q.values())], []
    row, scratch = _Row(begin), _Row([None] * size)
    for a, f in zip(area, force):
        _step_heat(_constant(float(dt)), own_numbers, _Row(a), _Row(f), row, scratch)
        states.append(torch.stack(row.numbers))
    return torch.stack(states) if states else begin.new_zeros(0, size)


class _Row:
    """One world's row of numbers, each a tensor: an array [world, number] for `step_heat`."""

    def __init__(self, numbers: Iterable[torch.Tensor]):
        self.numbers = list(numbers)
        self.shape = 1, len(self.numbers)

    def __getitem__(self, at):
        return self.numbers[at[1]]

    def __setitem__(self, at, value):
        self.numbers[at[1]] = value


@functools.cache
def _constant(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


# Warp's names in `sensor.heat`; at a kink, slopes are those of the side with contact
_WARP = types.SimpleNamespace(
    tid=lambda: 0,
    max=lambda a, b: a if a >= b else b,
    min=lambda a, b: a if a <= b else b,
    where=lambda condition, a, b: a if condition else b,
    pow=torch.pow,
)
_rates, _branches = map(torch.from_numpy, own.half_space()[:2])
_names = {"wp": _WARP, "real": _constant, "_rates": _rates, "_branches": _branches}
_step_heat = with_globals(own, _names)["step_heat"]
