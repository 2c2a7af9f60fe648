"""Probability that a fault of a log, or what a diagnosis finds in it, is correctly named: logistic regression
on its features."""

import json
import pathlib

import numpy as np

from .fault import Fault

# A fault is named from this confidence on, and removed from the counts before further searches. Of 12 names
# with a confidence of 0.6 to 0.65, in 209 logs by three authors, 9 were right.
NAMED = 0.6
_CHANCE = 0.02  # largest p of a named fault
# factor of the logit, fitted to 221 names from two authors whose data did not fit the weights: for stated
# 0.74, 0.84, 0.92 and 0.98, 72, 71, 88 and 94 % were right
NEW = 0.73
_MOST = 0.99  # fraction of the most confident names that were right
# weight of log(1 + other candidates of the same detector): several channels with one fault each more often
# have a common cause
PER_CANDIDATE = -1.2445
# a faulty connector or cable affects two channels, so one further candidate is no counter-evidence
PAIRS = {"still", "one"}
# detector -> intercept and, per feature, weight, lower and upper bound of the training data. Fitted to hidden
# effects of eleven authors in recordings of real sensors; "gone" (one of one was right), "loud" and "memory"
# to 98 checkups by two authors (`benchmarks/discrepancy_confidence.py`)
WEIGHTS: dict = json.loads(pathlib.Path(__file__).with_name("confidence.json").read_text())


def probability(detector: str, features: dict, others: int = 0, weights: dict = WEIGHTS) -> float:
    """Probability from a detector's features, each clipped to the range of the training data.

    Args:
      others: other candidates of the same detector in the log. weights: as WEIGHTS.
    """
    if detector not in weights:
        return 0.0
    own = weights[detector]
    logit = own["intercept"] + PER_CANDIDATE * np.log1p(max(others - (detector in PAIRS), 0))
    for name, (weight, low, high) in own["features"].items():
        logit += weight * np.clip(features.get(name, 0.0), low, high)
    return min(1 / (1 + float(np.exp(-NEW * logit))), _MOST)


def decades(p: float) -> float:
    """What a probability by chance says, as a feature: at most twelve zeros of it."""
    return -float(np.log10(max(p, 1e-12)))


def confidence(fault: Fault, others: int = 0) -> float:
    """Probability that the fault is correctly named. others: see `probability`."""
    features = fault.features | {"decades": decades(fault.p)}
    return probability(fault.detector, features, others) if fault.detector else _MOST


def clear(fault: Fault) -> bool:
    """Whether a fault is named."""
    return fault.confidence >= NAMED and fault.p < _CHANCE
