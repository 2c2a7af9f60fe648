"""The sensor's temperatures as a differentiable PyTorch function: the equations of `sensor.heat_formulas` on
tensors, for one sensor.

All bodies are processed in parallel. Temperatures are smooth except in areas: where one stops growing, and
where the pad is full, derivatives are one-sided."""

import dataclasses
import functools
import math
import numbers

import torch

from ...sensor import heat as own
from ...sensor import heat_formulas
from ...sensor.formulas import formulas_by_name, with_names
from ...sensor.heat import HeatParameters, half_space
from ..tensors import TORCH, real_tensor

__all__ = ["temperatures"]

_SURFACE, _STORE, _TAKEN = 1 + own.NCELL, 2 + own.NCELL, own.MADE + 3
_LEAST = 1e-12  # [m^2], as in `sensor.heat`
_formulas = formulas_by_name(heat_formulas, functools.partial(with_names, names=TORCH))
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
    if not (isinstance(dt, numbers.Real) and math.isfinite(dt) and dt > 0):
        raise ValueError(f"dt is {dt}: give a positive time of a step [s]")
    unknown = set(constants) - set(_CONSTANTS)
    if unknown:
        raise ValueError(f"no constants {', '.join(sorted(unknown))}: choose from {', '.join(_CONSTANTS)}")
    values = {name: float(torch.as_tensor(value).detach()) for name, value in constants.items()}
    q = dataclasses.asdict(HeatParameters(**values)) | constants  # raises for invalid values
    q = {name: torch.as_tensor(value, dtype=torch.float64, device="cpu") for name, value in q.items()}
    states = []
    for a, f in zip(area, force):
        begin = _step(q, begin, a, f, dt)
        states.append(begin)
    return torch.stack(states) if states else begin.new_zeros(0, size)


def _step(q, state, area, force, dt):
    """`sensor.heat.step_heat`: layers are eliminated into the one inside, the core is solved, then the layers
    are back-substituted."""
    n = own.NCELL
    bodies = state[own.BODIES :].reshape(-1, own.BODY)
    effusivity, temperature, conductivity = bodies[:, own.MADE : _TAKEN].unbind(1)
    layer = q["conductivity"] * n / q["thickness"]
    store = q["capacity"] * q["thickness"] / n / dt
    touched = area * _formulas.fitting(q["area"], area.sum())

    # separated areas stay for a while, then skin and bodies change columns
    had, skin = bodies[:, 0], bodies[:, 1:_SURFACE]
    late = _formulas.lingering(q["capacity"], q["thickness"], q["gap"], q["conductivity"], dt)
    over = (had - touched).clamp(min=0.0)
    room = (0.5 * q["area"] - touched.sum()).clamp(min=0.0)
    late = _formulas.roomed(late, room, late * over.sum())
    left = (1 - late) * over
    bare = q["area"] - had.sum()
    free = state[own.FREE : own.BODIES]
    for parted, cells in zip(left, skin):
        free, bare = _formulas.mixed(free, bare, cells, parted), bare + parted
    patch = torch.maximum(had - left, touched)
    skin = _mix(skin, had - left, free, patch - (had - left))
    bare = q["area"] - patch.sum()
    taken = bodies[:, _TAKEN]
    taken = torch.where(
        taken > touched, _formulas.spread_sideways(taken, touched, effusivity, conductivity, dt), taken
    )
    grown = (touched - taken).clamp(min=0.0)
    body = _mix(bodies[:, _SURFACE : own.MADE], taken, temperature[:, None], grown)
    surface, stores = body[:, 0], body[:, 1:]
    taken = taken + grown

    # free skin, from the air inwards
    outside = _formulas.between_cells(layer, q["air"])
    inlets = [layer] * (n - 1) + [_formulas.between_cells(layer, q["gap"])]
    free, free_fraction, known, pull = _inwards(free, store, inlets, outside * q["ambient"], outside)
    liquid_known, liquid_pull = bare * known, bare * pull

    # skin on bodies: all of a column shares the flux through its touching area
    on = patch > 0
    rate, branch, fast, slow = half_space()
    rate, branch = torch.from_numpy(rate), torch.from_numpy(branch)
    fraction = (touched / torch.where(on, patch, 1.0)).clamp(max=1.0)
    pressure = force / touched.clamp(min=_LEAST)
    h = _formulas.contact_conductance(q["contact"], pressure, q["conductivity"], conductivity)
    touch = _formulas.between_cells(layer, h)
    onto = touch * touched / taken.clamp(min=1e-30)
    c = _formulas.branch_conductance(effusivity[:, None], branch, rate, dt)
    known = effusivity * slow * temperature + (c * stores).sum(1)
    pull = effusivity * slow + c.sum(1)
    surface, surface_fraction, _, _ = _formulas.eliminate(effusivity * fast / dt, surface, known, pull, onto)
    press = fraction * _formulas.between_cells(layer, q["film"])
    column, column_fraction, known, pull = _inwards(
        skin.T, store, [layer] * (n - 1) + [press], fraction * touch * surface,
        fraction * touch * (1 - surface_fraction),
    )  # fmt: skip
    thermistor_known, thermistor_pull = (patch * known).sum(), (patch * pull).sum()

    near, near_fraction, thermistor_known, thermistor_pull = _formulas.eliminate(
        q["near"] / dt, state[own.THERMISTOR], thermistor_known, thermistor_pull, q["spread"]
    )
    liquid, liquid_fraction, liquid_known, liquid_pull = _formulas.eliminate(
        q["liquid"] / dt, state[own.LIQUID], liquid_known, liquid_pull, q["inside"]
    )
    core = _formulas.core_temperature(
        (q["core"] - q["near"]) / dt, state[own.CORE], state[own.POWER], q["mount"], q["ambient"],
        thermistor_known, thermistor_pull, liquid_known, liquid_pull,
    )  # fmt: skip

    # back-substitution outwards
    near = near + near_fraction * core
    liquid = liquid + liquid_fraction * core
    free = _follow(free, free_fraction, liquid)
    column = _follow(column, column_fraction, near)
    surface = surface + surface_fraction * column[n - 1]
    stores = _formulas.relaxed(stores, surface[:, None], rate, dt)
    lost = q["mount"] * (core - q["ambient"]) + bare * outside * (free[n - 1] - q["ambient"])
    given = torch.where(on, touched * touch * (column[n - 1] - surface), 0.0).sum()
    head = [near, core, liquid, state[own.LOST] + dt * lost, state[own.GIVEN] + dt * given]
    head += [state[own.POWER], state[own.REFERENCE], liquid - state[own.REFERENCE]]
    moved = torch.cat([torch.stack(column, 1), surface[:, None], stores], 1)
    moved = torch.where(on[:, None], moved, torch.cat([skin, body], 1))
    fixed = bodies[:, own.MADE : _TAKEN]
    bodies = torch.cat([patch[:, None], moved, fixed, taken[:, None]], 1)
    return torch.cat([torch.stack(head), torch.stack(free), bodies.ravel()])


def _mix(old, area, new, added):
    """(nbody, k) with new values on an added area (nbody,); unchanged without one."""
    grows = (added > 0)[:, None]
    area = torch.where(grows, area[:, None], 1.0)
    return torch.where(grows, _formulas.mixed(old, area, new, added[:, None]), old)


def _inwards(layers, store, inner, known, pull):
    """Cells of a column, inside first, each eliminated into the one inside it: their constant terms and
    factors, and `known` and `pull` of the innermost. `inner`: conductances to the next cell inside, outermost
    first."""
    cells, fractions = [], []
    for cell, conductance in zip(reversed(layers.unbind(0)), inner):
        cell, fraction, known, pull = _formulas.eliminate(store, cell, known, pull, conductance)
        cells.insert(0, cell)
        fractions.insert(0, fraction)
    return cells, fractions, known, pull


def _follow(cells, fractions, inside):
    out = []
    for cell, fraction in zip(cells, fractions):
        inside = cell + fraction * inside
        out.append(inside)
    return out
