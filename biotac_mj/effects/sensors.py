"""Effects that a simulated sensor can have while it runs, and draws of them: named physical randomisation.

The classes are those that `biotac diagnose` fits to data. Those of the counts are linear in the electrodes'
changes from rest, so `Effect.apply` itself says what they do: one electrode at a time is moved by a count."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from ..sensor.channels import FULL_SCALE, NELECTRODE, PDC_REST
from ..sensor.presets import Sensor, generator, read_sensor
from ..shown import shown
from .effect import Effect, Run
from .electrodes import SESSION
from .rubber import Relaxation
from .sensing import CrossTalk, DeadTaxels, Drift, FluidLoss, Gain, PressureGain, WarmUp

__all__ = ["RANDOM", "RUNNING", "draw_effects", "read_randomise", "take_sensor", "with_effects"]

RANDOM = {
    effect.id: effect
    for effect in (
        Gain(),
        DeadTaxels(),
        CrossTalk(),
        PressureGain(),
        Relaxation(),
        WarmUp(),
        FluidLoss(),
        Drift(),
    )
}


def _counted(sensor, effect, theta):
    """Of effects on the counts: what they make of each electrode's change, and of PDC's."""
    log_z = np.log(sensor.impedance)
    counts = np.array(sensor.rest) + np.eye(NELECTRODE)
    run = Run.of_counts(counts, log_z, pdc=np.full(NELECTRODE, PDC_REST + 1.0))
    effect.apply(run, theta)
    mixing = (run.counts - np.array(sensor.rest)).T
    before = np.array(sensor.mixing) if sensor.mixing else np.eye(NELECTRODE)
    return {"mixing": mixing @ before, "pdc_gain": sensor.pdc_gain * float(run.pdc[0] - PDC_REST)}


def _relaxation(sensor, effect, theta):
    return {"relaxation": (theta["g"], theta["tau"])}


def _warm_up(sensor, effect, theta):
    return {"warm_up": -theta["a"] / sensor.per_degree, "warm_time": theta["tau"]}


def _loss(sensor, effect, theta):
    return {"loss": sensor.loss + theta["rate"]}


def _drift(sensor, effect, theta):
    return {"drift": tuple(np.full(NELECTRODE, sensor.drift) + theta["rate"])}


def _thermal(sensor, effect, theta):
    return {"per_degree": theta["alpha"]} if theta["alpha"] else {}


def _asperities(sensor, effect, theta):
    return {"power": sensor.power * float(np.exp(theta["log_p"]))}


def _saturation(sensor, effect, theta):
    return {"saturation": (theta["strength"], theta["knee"])}


def _lowpass(sensor, effect, theta):
    return {"lowpass": sensor.lowpass + theta["tau"]}


def _latency(sensor, effect, theta):
    return {"latency": sensor.latency + theta["delay"]}


def _offset(sensor, effect, theta):
    return {"rest": tuple(np.array(sensor.rest) + [theta[e] for e in effect.params])}


def _noise(sensor, effect, theta):
    before = sensor.electrode_noise(np.array(sensor.rest))
    return {"noise": tuple(np.hypot(before, [theta[e] for e in effect.params]))}


def _electrode_drift(sensor, effect, theta):
    rates = (
        np.array([theta.get(f"e{k + 1}", 0.0) for k in range(NELECTRODE)]) / SESSION
    )  # a straight line to there
    return {"drift": tuple(np.full(NELECTRODE, sensor.drift) + rates)}


def _exchange(sensor, effect, theta):
    """Channels with their rests; a channel's counts by ln Z are those about the rest that it shows."""
    before, shown = np.array(sensor.rest), np.eye(NELECTRODE)
    for (i, j), share in zip(effect.reads, (theta[name] for name in effect.params)):
        shown[i] += share * (np.eye(NELECTRODE)[j] - np.eye(NELECTRODE)[i])
    rest = shown @ before
    by_log = [counts * (1 - counts / FULL_SCALE) for counts in (before, rest)]
    mixing = shown * (by_log[0] / by_log[1])
    return {"rest": tuple(rest), "mixing": mixing @ (sensor.mixing or np.eye(NELECTRODE))}


_BECOMES = {
    "relax": _relaxation,
    "thermal": _thermal,
    "warmup": _warm_up,
    "fluidloss": _loss,
    "asper": _asperities,
    "saturate": _saturation,
    "lowpass": _lowpass,
    "latency": _latency,
    "drift": _drift,
    "offset": _offset,
    "electrode_drift": _electrode_drift,
    "swap": _exchange,
    "noise": _noise,
}
# ids of effects that act in the sensor itself; what relaxes is the rubber, of which a sensor alone knows PDC
RUNNING = {*RANDOM, *_BECOMES} - {"relax"}


def with_effects(sensor: Sensor, effects: list[tuple[Effect, dict]]) -> Sensor:
    """The sensor with effects [(Effect, theta)], of RUNNING or "relax"."""
    for effect, theta in effects:
        sensor = dataclasses.replace(sensor, **_BECOMES.get(effect.id, _counted)(sensor, effect, theta))
    return sensor


def read_randomise(value: object) -> dict[str, float]:
    """{name of RANDOM: size} of names, or of such a dict; size 1 is a real sensor's.

    Raises:
      ValueError: an unknown name, or a size that is no number >= 0.
    """
    if isinstance(value, (list, tuple)):
        value = dict.fromkeys(map(str, value), 1.0)
    if not isinstance(value, Mapping):
        raise ValueError(
            f"randomise is {shown(value)}: give names of {', '.join(RANDOM)}, or a dict of their sizes"
        )
    for name, size in value.items():
        if name not in RANDOM:
            raise ValueError(f"cannot randomise {shown(name)}: choose from {', '.join(RANDOM)}")
        if isinstance(size, bool) or not isinstance(size, (int, float)) or not 0 <= size < np.inf:
            raise ValueError(
                f"randomise {shown(name)} by {shown(size)}: give a number >= 0, 1 is a real sensor's"
            )
    return dict(value)


def draw_effects(randomise: object, rng: np.random.Generator) -> list[tuple[Effect, dict]]:
    """[(Effect, theta)] drawn for one sensor; see `read_randomise`."""
    return [(RANDOM[name], RANDOM[name].draw(rng, size)) for name, size in read_randomise(randomise).items()]


def take_sensor(settings: dict, seed: ArrayLike = 0) -> tuple[Sensor, dict, bool]:
    """What settings of readings say of the sensor.

    Args:
      settings: with "sensor" (see `presets.read_sensor`) and "randomise" (see `read_randomise`), or without.
      seed: of what is drawn, whole numbers.

    Returns:
      the sensor, the other settings, and whether another seed would give another sensor.

    Raises:
      ValueError: a name or number that cannot be.
    """
    rest = {name: value for name, value in settings.items() if name not in ("sensor", "randomise")}
    choice, randomise = settings.get("sensor", "1"), settings.get("randomise", {})
    effects = draw_effects(randomise, generator(seed, 0xEF))
    sensor = with_effects(read_sensor(choice, seed), effects)
    drawn = choice == "random" or (isinstance(choice, Mapping) and choice.get("like") == "random")
    return sensor, rest, bool(drawn or randomise)
