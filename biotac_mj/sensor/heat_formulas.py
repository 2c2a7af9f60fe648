"""Scalar equations of a step of the sensor's heat. `heat.step_heat` calls them for one body after another, in
place, `differentiable.temperatures` on tensors of all bodies.

Areas [m^2], temperatures [C], conductances [W/K], or per area [W/(m^2 K)]; stores are heat capacities over
the time step."""

import math

import numpy as np

from .formulas import Number

__all__ = [
    "between_cells",
    "branch_conductance",
    "contact_conductance",
    "core_temperature",
    "eliminate",
    "fitting",
    "lingering",
    "mixed",
    "relaxed",
    "roomed",
    "spread_sideways",
]

_LEAST = 1e-12  # [m^2]
_FOUR_PI = 4 * math.pi


def contact_conductance(coefficient: Number, pressure: Number, rubber: Number, body: Number) -> Number:
    """h = a k (p / 10 kPa)^0.95 with the harmonic mean k of both conductivities: conforming rough surfaces
    (Yovanovich, 1981; Cooper, Mikic and Yovanovich, 1969, with the exponent 0.985). The slope of the
    asperities over their height and the hardness are one fitted coefficient a [1/m]."""
    mean = np.float64(2.0) * rubber * body / (rubber + body)
    least = np.where(pressure > np.float64(1.0), pressure, np.float64(1.0))
    return coefficient * mean * np.pow(least / np.float64(1.0e4), np.float64(0.95))


def between_cells(layer: Number, other: Number) -> Number:
    """Conductance from the middle of an outermost cell, whose neighbours are `layer` away, through a
    conductance `other` in series."""
    return np.float64(1.0) / (np.float64(0.5) / layer + np.float64(1.0) / other)


def fitting(skin: Number, wanted: Number) -> Number:
    """Fraction of the bodies' contact area that fits on the sensor's skin: the nail's side stays free."""
    least = np.where(wanted > np.float64(_LEAST), wanted, np.float64(_LEAST))
    room = np.float64(0.5) * skin / least
    return np.where(room < np.float64(1.0), room, np.float64(1.0))


def lingering(capacity: Number, thickness: Number, gap: Number, conductivity: Number, dt: Number) -> Number:
    """Fraction of the skin separated before a step that stays in its column after it."""
    warming = capacity * thickness * (np.float64(1.0) / gap + np.float64(0.5) * thickness / conductivity)
    return warming / (warming + dt)


def roomed(late: Number, room: Number, parted: Number) -> Number:
    """The fraction that stays, limited by the pad's room for separated skin."""
    least = np.where(parted > np.float64(_LEAST), parted, np.float64(_LEAST))
    fraction = room / least
    return late * np.where(fraction < np.float64(1.0), fraction, np.float64(1.0))


def mixed(old: Number, area: Number, new: Number, added: Number) -> Number:
    """Temperature of an area after another one is added."""
    return (old * area + new * added) / (area + added)


def spread_sideways(
    taken: Number, touched: Number, effusivity: Number, conductivity: Number, dt: Number
) -> Number:
    """Area of a body that is or was recently touched: a spot of radius r spreads over a disc twice as large
    in r^2 / 4 D, D = (k / e)^2."""
    ratio = effusivity / conductivity
    time = taken * ratio * ratio / np.float64(_FOUR_PI)
    return touched + (taken - touched) * time / (time + dt)


def eliminate(
    store: Number, cell: Number, known: Number, pull: Number, inner: Number
) -> tuple[Number, Number, Number, Number]:
    """Eliminates a cell into the one inside it, at a conductance `inner`. `store` is the cell's heat
    capacity, `known` and `pull` the constant term and coefficient from outside. Returns the cell's constant
    term, its factor on the inner cell, and the inner cell's `known` and `pull`."""
    total = store + pull + inner
    cell = (store * cell + known) / total
    fraction = inner / total
    return cell, fraction, inner * cell, inner - inner * fraction


def branch_conductance(effusivity: Number, conductance: Number, rate: Number, dt: Number) -> Number:
    """Conductance of a relaxing store of a half-space in a step of backward Euler."""
    return effusivity * conductance / (np.float64(1.0) + dt * rate)


def relaxed(store: Number, surface: Number, rate: Number, dt: Number) -> Number:
    """A relaxing store after the step, behind a surface of that temperature."""
    a = dt * rate
    return (store + a * surface) / (np.float64(1.0) + a)


def core_temperature(
    store: Number,
    core: Number,
    power: Number,
    mount: Number,
    ambient: Number,
    thermistor_known: Number,
    thermistor_pull: Number,
    liquid_known: Number,
    liquid_pull: Number,
) -> Number:
    """Temperature of the core after its two neighbours, the part near the thermistor and the liquid, were
    eliminated into it."""
    return (store * core + power + mount * ambient + thermistor_known + liquid_known) / (
        store + mount + thermistor_pull + liquid_pull
    )
