"""What a finding's clues say of its being right: a score for every family, and the rate of right names among
practice findings with such a score, by weights that had not seen their author
(`benchmarks/discrepancy_recordings.py --fit`)."""

import json
import pathlib

import numpy as np

from .findings import Finding

__all__ = [
    "FAMILIES",
    "NAMED",
    "clues",
    "confidence",
    "family",
    "farthest",
    "probability",
    "strange",
    "unusual",
]

FAMILIES = {
    "shared": ("warmup", "thermal"),
    "loss": ("fluidloss",),
    "supply": ("count_offset", "count_gain"),
    "one": ("drift",),
    "process": ("drift",),
    "jump": ("drift",),
    "answer": ("gain", "flip"),
    "order": ("swap",),
    "samples": ("freeze", "quantise"),
    "single": ("spikes",),
    "still": ("stuck",),
    "limit": ("saturate",),
    "lost": ("lost_rows",),
    "rail": ("saturate",),
    "cut": ("quantise",),
    "line": ("hum",),
    "colour": ("lowpass",),
    "pairs": ("crosstalk",),
    "heard": ("crosstalk",),
    "slip": ("swap",),  # from one row to the next
    "common": ("common_noise",),
    "size": ("noise",),
    "late": ("latency",),
    "memory": ("relax", "hyster"),
    "wiring": ("swap", "flip", "gain", "crosstalk"),
    "clock": ("lost_rows",),
    "rows": ("spikes",),  # of all electrodes
    "louder": ("gain",),
    "everyone": ("noise",),  # of all electrodes
    "lag": ("lowpass", "latency"),  # of one electrode
}
# confidence from which a finding is named: nine of ten are right by weights of the other authors alone
NAMED = 0.7
_FAR = 6.0  # spreads: what lies beyond is unusual, whatever it is
_FITTED = pathlib.Path(__file__).with_name("confidence.json")
_WEIGHTS = json.loads(_FITTED.read_text())
# of families that the fitted file does not have, since no author hid enough of them: the rate of right names
# over nats beyond what is needed, each sensor judged by the others (`benchmarks/sound_sensors.py --judge`);
# of wiring that of seven authors' practice, where what is outside the catalogue looks like it, too.
# What a clock says is no inference; rows in which most electrodes leave and come back no real recording has,
# nor channels that go on where others were
_UNFITTED = {
    # over correlation beyond what real sensors reach
    "heard": {"intercept": 0.0, "weights": {"heard": 1.0}, "worth": [[-0.1, 0.0], [0.0, 0.85], [0.15, 0.95]]},
    "clock": {"intercept": 0.0, "weights": {}, "worth": [[0.0, 0.98]]},
    "rows": {"intercept": 0.0, "weights": {}, "worth": [[0.0, 0.95]]},
    "slip": {"intercept": 0.0, "weights": {}, "worth": [[0.0, 0.95]]},
    "cut": {"intercept": 0.0, "weights": {}, "worth": [[0.0, 0.9]]},
    "rail": {"intercept": 0.0, "weights": {}, "worth": [[0.0, 0.9]]},
    "wiring": {
        "intercept": 0.0,
        "weights": {"whole": 1.0},
        "worth": [[-1.0, 0.0], [0.0, 0.75], [100.0, 0.9]],
    },
    # nats a block of a drift beside a load: 1.7 at most in 42 real recordings without one
    "process": {
        "intercept": 0.0,
        "weights": {"likelier": 1.0},
        "worth": [[0.7, 0.0], [1.8, 0.5], [2.2, 0.85], [6.0, 0.93]],
    },
    "everyone": {"intercept": 0.0, "weights": {}, "worth": [[0.0, 0.9]]},
    "louder": {"intercept": 0.0, "weights": {"both": 1.0}, "worth": [[-1.0, 0.0], [0.0, 0.9], [15.0, 0.97]]},
}


def family(finding: Finding) -> str:
    """Key of FAMILIES."""
    if "whole" in finding.clues:  # by what sound sensors have in common
        return "wiring"
    if "both" in finding.clues:  # answers and noise
        return "louder"
    if finding.seen is not None:  # a low-pass may be of the noise alone
        return "late" if finding.id == "latency" else "memory"
    if "everyone" in finding.clues:
        return "everyone"
    if "cut" in finding.clues:  # digits of one channel
        return "cut"
    if "rail" in finding.clues:  # an end of the converter
        return "rail"
    if "clock" in finding.clues:
        return "clock"
    if "rows" in finding.clues:
        return "rows"
    if "heard" in finding.clues:  # in the multiplexer's order
        return "heard"
    if "places" in finding.clues and finding.id != "lost_rows":  # the same counts on all, from row to row
        return "step"
    if "slip" in finding.clues:
        return "slip"
    if "edge" in finding.clues:
        return "jump"
    if "likelier" in finding.clues:  # beside a load
        return "process"
    if "lag" in finding.clues:  # of one electrode
        return "lag"
    if "spread" in finding.clues:  # one that no longer answers is told as a gain is
        return "answer"
    return next(name for name, ids in FAMILIES.items() if finding.id in ids)


def clues(finding: Finding) -> dict:
    """The finding's numbers, by name."""
    return {k: v for k, v in finding.clues.items() if isinstance(v, float)}


def confidence(finding: Finding) -> float:
    """Probability that the name is right, at most the rate of the surest ones seen."""
    return min(probability(family(finding), clues(finding)), _WEIGHTS["most"])


def unusual(given: dict, kind: str, weights: dict = _WEIGHTS) -> float:
    """p of the clues of what is left (`rest.py`): the share of practice recordings without an effect, of the
    same kind, of which some clue lies as far above what is usual."""
    known = weights[kind]
    far = farthest(given, known["usual"])
    return (1 + sum(o >= far for o in known["others"])) / (1 + len(known["others"]))


def strange(given: dict, kind: str, limit: float, weights: dict = _WEIGHTS) -> list[str]:
    """Clues of what is left that are as unusual as `unusual` has to be for p up to a limit, the most unusual
    first."""
    known = weights[kind]
    alone = {k: farthest(given, {k: u}) for k, u in known["usual"].items()}
    number = 1 + len(known["others"])
    p = {k: (1 + sum(o >= far for o in known["others"])) / number for k, far in alone.items()}
    return sorted((k for k in p if p[k] <= limit), key=lambda k: -alone[k])


def farthest(given: dict, usual: dict) -> float:
    """How far the most unusual clue lies above what is usual of a recording as long, in spreads."""
    seconds = given["seconds"]
    return max(
        min(max((given.get(k, 0.0) - middle - slope * seconds) / spread, 0.0), _FAR)
        for k, (middle, slope, spread) in usual.items()
    )


def probability(family: str, given: dict, weights: dict = _WEIGHTS) -> float:
    """Of a family's clues: the rate of right names at their score, between the rates that were seen."""
    known = weights.get(family) or _UNFITTED[family]
    total = known["intercept"] + sum(w * given.get(k, 0.0) for k, w in known["weights"].items())
    return float(np.interp(total, *zip(*known["worth"])))
