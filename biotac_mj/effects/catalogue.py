"""The catalogue: effects of the skin, its contact, the transduction, the acquisition and the set-up."""

from .contact import Adhesion, Friction, FrictionLoad
from .effect import Effect
from .electrodes import ElectrodeDrift, Exchange, Noise, Offset
from .rubber import (
    Damage,
    Hysteresis,
    Inhomogeneity,
    LoadHysteresis,
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

__all__ = ["CATALOGUE", "by_id"]

CATALOGUE = (
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


_BESIDE = (Noise(),)  # what a sensor file may hold and no prediction has


def by_id(name: str, extra: tuple | list = ()) -> Effect:
    """The effect of that id.

    Raises:
      ValueError: unknown; the text lists the ids.
    """
    for effect in (*extra, *CATALOGUE, *_BESIDE):
        if effect.id == name:
            return effect
    raise ValueError(
        f"unknown effect {name!r}: choose from {', '.join(e.id for e in CATALOGUE)}, or pass your own Effect"
    )
