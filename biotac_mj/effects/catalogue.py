"""The catalogue: all effects that a sensor may have, of the skin, its contact, the transduction, the
acquisition, the set-up and the log."""

from .contact import Adhesion, Friction, FrictionLoad
from .effect import Effect, Entry
from .electrodes import ElectrodeDrift, Exchange, Noise, Offset
from .logged import LOGGED
from .rubber import (
    Damage,
    Hysteresis,
    Inhomogeneity,
    LoadHysteresis,
    Modulus,
    Mullins,
    PowerCreep,
    Relaxation,
    Spots,
    Stiffening,
)
from .sensing import (
    Asperities,
    Bubble,
    CrossTalk,
    DeadTaxels,
    Drift,
    FluidLoss,
    ForceZero,
    Gain,
    Latency,
    LowPass,
    PressureGain,
    Saturation,
    Thermal,
    WarmUp,
)
from .setup import DepthZero, Misalignment, Mount, Radius, Rocking, RockingTorque

_SENSOR = (
    Relaxation(),
    PowerCreep(),
    Hysteresis(),
    LoadHysteresis(),
    Mullins(),
    Damage(),
    Stiffening(),
    Inhomogeneity(),
    Spots(),
    Bubble(),
    FluidLoss(),
    Friction(),
    FrictionLoad(),
    Adhesion(),
    Radius(),
    Misalignment(),
    DepthZero(),
    Mount(),
    Rocking(),
    RockingTorque(),
    Thermal(),
    WarmUp(),
    Asperities(),
    Gain(),
    CrossTalk(),
    Saturation(),
    LowPass(),
    Latency(),
    Drift(),
    ElectrodeDrift(),
    Offset(),
    Exchange(),
    PressureGain(),
    ForceZero(),
)


# not searched: measured beforehand, or drawn
_NOT_SEARCHED = (Noise(), DeadTaxels(), Modulus())


def entries(fits: str) -> tuple[Entry, ...]:
    """The effects that are searched in "poses" or in a "log"."""
    return tuple(e for e in (*_SENSOR, *_NOT_SEARCHED, *LOGGED) if fits in e.fits)


CATALOGUE = entries("poses")


def name_of(id_: str) -> str:
    """Name of the effect with that id, in its form for logs if it has one; the id if there is none."""
    found = [e for e in (*LOGGED, *_SENSOR, *_NOT_SEARCHED) if e.id == id_]
    return found[0].name if found else id_


def by_id(name: str) -> Effect:
    """The effect with that id, in its form for simulators.

    Raises:
      ValueError: unknown; the text lists the ids.
    """
    for effect in (*CATALOGUE, *_NOT_SEARCHED):
        if effect.id == name:
            return effect
    raise ValueError(f"unknown effect {name!r}: choose from {', '.join(e.id for e in CATALOGUE)}")
