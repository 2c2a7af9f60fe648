"""What a finding's clues, and how many of its family stand beside it in the report, say of its being right:
one logistic over all families, fitted to practice of several authors
(`benchmarks/discrepancy_confidence.py`)."""

import json
import pathlib

import numpy as np

from ...quality.confidence import NAMED, as_probability
from ...quality.confidence import probability as of_a_fault
from .candidates import Candidate

__all__ = [
    "FAMILIES",
    "NAMED",
    "clues",
    "confidence",
    "crowd",
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
    "order": ("swap", "flip"),
    "slip": ("swap",),  # from one row to the next
    "late": ("latency",),
}
# faults of an electrode's own, which a connector or an amplifier may give to two: the other of a pair is no
# argument against either. Of 295 pieces of five authors twelve names more, all right; of what is of
# all electrodes (samples) one, wrong
_PAIRS = {"one"}
_FAR = 6.0  # spreads: what lies beyond is unusual, whatever it is
_FITTED = pathlib.Path(__file__).with_name("confidence.json")
_WEIGHTS = json.loads(_FITTED.read_text())
# of families whose weights are not fitted with the others': a drift beside a load, by nats a block and by how
# far it stands out of the next electrode's, fitted alone to 333 candidates of nine authors, 68 of them right
_UNFITTED = {
    "process": {"intercept": -3.51, "clues": {"likelier": [1.29, 0.7, 6.0], "apart": [0.59, -2.4, 1.0]}},
}


def family(finding: Candidate) -> str:
    """Key of FAMILIES, or the detector of a fault of the log."""
    if "detector" in finding.clues:
        return finding.clues["detector"]
    if "slip" in finding.clues:
        return "slip"
    if "edge" in finding.clues:
        return "jump"
    if "likelier" in finding.clues:  # beside a load
        return "process"
    return next(name for name, ids in FAMILIES.items() if finding.id in ids)


def clues(finding: Candidate) -> dict:
    """The finding's numbers, by name."""
    return {k: v for k, v in finding.clues.items() if isinstance(v, float)}


def confidence(finding: Candidate, beside: int = 0) -> float:
    """Probability that the name is right.

    Args:
      beside: other candidates of the same family in the recording. What many electrodes have, each by itself,
        has one cause more often than many.
    """
    return probability(family(finding), clues(finding), beside)


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


def crowd(family: str, beside: int) -> float:
    """What other candidates of a family say against each: the logarithm of one more than those that count."""
    return float(np.log1p(max(beside - (family in _PAIRS), 0)))


def probability(family: str, given: dict, beside: int = 0, weights: dict = _WEIGHTS) -> float:
    """Of a family's clues, each no farther out than practice had it, and of `beside` (see `confidence`)."""
    known = weights["names"]
    if family in known["families"]:
        own, total = known["families"][family], known["intercept"]
    elif family in _UNFITTED:
        own, total = _UNFITTED[family], 0.0
    else:
        return of_a_fault(family, given, beside)
    total += own["intercept"] + known["beside"] * crowd(family, beside)
    for name, (weight, low, high) in own["clues"].items():
        total += weight * np.clip(given.get(name, 0.0), low, high)
    return as_probability(total)
