"""What can be named in a recording: the catalogue, a finding with its parameters, and how it is taken out
of the counts."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ...effects.catalogue import CATALOGUE

__all__ = ["KINDS", "Finding", "Kind", "Parameter"]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """unit; bounds low, high; source of the bounds."""

    unit: str
    low: float
    high: float
    source: str


@dataclasses.dataclass(frozen=True)
class Kind:
    """An effect of the catalogue: stage is one of `effects.effect.STAGES`; confusable: id -> what would tell
    them apart."""

    id: str
    name: str
    stage: str
    physics: str
    params: dict
    confusable: dict


@dataclasses.dataclass
class Finding:
    """An effect that was found.

    Attributes:
      id: of KINDS; channels: electrode numbers from 0; parameters: name -> (value, low, high), nan where no
        interval is known.
      nats: evidence on blocks left out; p: sign flips of these blocks; start, end [s]; ties: ids that the
        evidence does not part; note: in words.
      clues: numbers that the confidence is made of (`confidence.py`); confidence 0..1.
      correct: (counts (n, 19), time (n,)) -> counts without the effect, or None; mask: (n, 19) bool of
        samples that are no measurement, or None; seen: (effect, theta) between force and electrodes, or None.
      beyond: of what is masked, 1: it lay above what was recorded, -1: below, 0: nothing is known of it.
      gap: name, unit, before, after, noise on the rows kept aside; verified: whether they confirm it, None
        where they cannot.
    """

    id: str
    channels: tuple
    parameters: dict
    nats: float
    p: float
    start: float
    end: float
    note: str = ""
    ties: tuple = ()
    clues: dict = dataclasses.field(default_factory=dict)
    confidence: float = 0.0
    correct: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    mask: np.ndarray | None = None
    beyond: int = 0
    seen: tuple | None = None
    gap: dict = dataclasses.field(default_factory=dict)
    verified: bool | None = None

    @property
    def kind(self) -> Kind:
        return KINDS[self.id]


def _shipped(name, extra_ties=(), **params):
    """Kind of an effect that the catalogue of simulators has, with parameters that recordings name
    otherwise."""
    effect = next(e for e in CATALOGUE if e.id == name)
    known = {k: Parameter(p.unit, p.low, p.high, p.source) for k, p in effect.params.items()}
    return Kind(
        name,
        effect.name,
        effect.stage,
        effect.physics,
        params or known,
        dict(effect.confusable) | dict(extra_ties),
    )


_COUNTS = Parameter("counts", -4095, 4095, "12-bit range")
_TIME = Parameter("s", 0, 1e6, "the record")
_WARM = {
    "a": Parameter("ln Z", -1.5, 1.5, "-0.23 over 190 s measured; 10-17 % of full scale (Mongeon 2015)"),
    "tau": Parameter("s", 1, 1e5, "minutes"),
}
KINDS = {
    k.id: k
    for k in (
        _shipped(
            "warmup",
            {
                "count_offset": "load and unload: an offset keeps its counts",
                "count_gain": "rest levels that differ more",
            },
            **_WARM,
        ),
        _shipped(
            "fluidloss",
            {
                "count_offset": "load and unload: an offset keeps its counts",
                "count_gain": "rest levels that differ more",
            },
        ),
        _shipped("thermal"),
        Kind(
            "count_offset",
            "common offset in counts",
            "A",
            "reference or supply: the same counts on every electrode",
            {"change": _COUNTS},
            {"warmup": "log TDC; load and unload", "count_gain": "rest levels that differ more"},
        ),
        Kind(
            "count_gain",
            "common gain in counts",
            "A",
            "reference or supply: every count in proportion",
            {"change": Parameter("1", -0.9, 0.9, "supplies")},
            {"count_offset": "rest levels that differ more"},
        ),
        Kind(
            "drift",
            "drift or jump of an electrode",
            "A",
            "an offset of one channel's amplifier or contact",
            {"change": _COUNTS},
            {
                "gain": "load and unload",
                "warmup": "one electrode or all",
                "crosstalk": "press beside the electrode that is heard",
            },
        ),
        _shipped(
            "gain",
            {"drift": "load and unload", "crosstalk": "press beside the electrode that is heard"},
        ),
        Kind(
            "flip",
            "sign of an electrode reversed",
            "A",
            "an electrode answers the load with the other sign",
            {"factor": Parameter("1", -5, -0.05, "polarity")},
            {"gain": "press beside the electrode"},
        ),
        Kind(
            "swap",
            "exchanged channels",
            "A",
            "electrodes carry each other's signal: cable or channel order",
            {"onset": _TIME},
            {"gain": "an exchange changes two channels at once"},
        ),
        Kind(
            "stuck",
            "stuck channel",
            "A",
            "an electrode repeats one count although its noise would change it",
            {"value": _COUNTS},
            {"saturate": "press harder: a stuck channel does not leave its value"},
        ),
        Kind(
            "freeze",
            "held rows",
            "A",
            "rows are repeated or carried on by noise alone: bus or logger",
            {"seconds": Parameter("s", 0, 1e4, "longer than any bus period")},
            {"stuck": "one channel or all", "lowpass": "a tap: a filter has no steps"},
        ),
        Kind(
            "lost_rows",
            "lost rows",
            "A",
            "the record jumps: rows were dropped between two that follow each other",
            {"seconds": Parameter("s", 0, 1e4, "what the load did meanwhile")},
            {"freeze": "the clock of the logger"},
        ),
        _shipped(
            "saturate",
            {
                "stuck": "a clipped channel leaves the limit when the load goes back",
                "flip": "press less, so that it stays off the limit",
            },
            level=_COUNTS,
        ),
        Kind(
            "quantise",
            "coarse quantisation",
            "A",
            "values lie on multiples of more than one count",
            {"step": Parameter("counts", 2, 512, "3 to 11 of 12 bits")},
            {"stuck": "a coarse channel takes several values"},
        ),
        Kind(
            "spikes",
            "spikes or dropouts of single samples",
            "A",
            "a few samples leave the trace and come back at once",
            {"rate": Parameter("1/min", 0, 6000, "up to every tenth sample")},
            {"noise": "noise is in every sample"},
        ),
        Kind(
            "hum",
            "mains hum or another periodic disturbance",
            "A",
            "A sin(2 pi f t): mains, its alias, or a machine",
            {
                "amplitude": Parameter("counts", 0.3, 500, "1-10 counts"),
                "frequency": Parameter("Hz", 0.2, 2000, "half the rate"),
            },
            {"noise": "noise has no line"},
        ),
        _shipped("lowpass", {"freeze": "a held row keeps its value"}),
        _shipped("crosstalk", {"common_noise": "cross-talk falls off with distance"}),
        Kind(
            "common_noise",
            "noise common to all channels",
            "A",
            "one noise is added to every channel: reference, supply",
            {"correlation": Parameter("1", 0.05, 1, "0.001 in a real sensor")},
            {"crosstalk": "cross-talk falls off with distance"},
        ),
        Kind(
            "noise",
            "excess noise of an electrode",
            "A",
            "an electrode's white noise is larger than the others' law",
            {"factor": Parameter("1", 1.5, 100, "a real sensor follows the law within 20 %")},
            {"spikes": "single samples"},
        ),
        _shipped("latency"),
        Kind(
            "relax",
            "relaxation after load changes",
            "C",
            "force answers a change of deformation at once and relaxes towards a part of it",
            {
                "fraction": Parameter("1", -0.6, 1.0, "0.02-0.3 of silicone; with the liquid's flow more"),
                "tau": Parameter("s", 0.1, 60, "0.5 s and 4-7 s (PDC)"),
            },
            {
                "creep": "a hold of 100 s: a plateau or none",
                "hyster": "hold 0, 1 and 30 s at the same depth",
                "lowpass": "longer holds",
                "latency": "a tap",
            },
        ),
        Kind(
            "hyster",
            "rate-independent hysteresis",
            "C",
            "loading and unloading differ, whatever the speed",
            {
                "fraction": Parameter("1", -1, 1, "loops of soft tactile sensors: 13-24 % of full scale"),
                "width": Parameter("N", 0.01, 5, "the record"),
            },
            {"relax": "hold 0, 1 and 30 s at the same depth", "latency": "two speeds a decade apart"},
        ),
    )
}
