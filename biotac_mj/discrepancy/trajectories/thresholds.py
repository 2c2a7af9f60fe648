"""Thresholds of acceptance and abstention, and the confidence of a name: constants, with their hash.

Set on 155 practice cases (benchmarks/discrepancy_calibrate.py) before a blind one was drawn.
`promising`, `partly`, `further`, `apart`, `shared` and `vague` came later, from cases of other authors
(docs/lab/discrepancy.md).
"""

import hashlib
import json

import numpy as np

__all__ = ["CONFIDENCE", "THRESHOLDS", "confidence", "terms", "threshold_hash"]

THRESHOLDS = {
    "p": 0.02,  # sign flips over trajectories
    "promising": 0.1,  # the same while others that are there may hide an effect
    # the same for what explains many times what is asked: few trajectories show a law that only deep presses
    # have, and flips of eight count the six that are silent
    "much": 5.0,  # [nats per trajectory]
    "much_p": 0.05,
    "gain": 0.7,  # [nats per trajectory] mean gain of evidence on trajectories left out
    "further": 1.5,  # the same for an effect beside others; twice that beside one that it is confused with
    "vague": 2.0,  # the same for what takes up something of nearly anything
    "share": 0.15,  # of the closable log mean square that one effect has to close
    "energy": 0.004,  # of the mean square that all effects take away, that each has to take away by itself
    "form": 0.015,  # the same for one that is confused with an effect already there
    # the same once all that is left is noise; of a third effect, and of what takes up nearly anything, always
    "little": 0.05,
    "shared": 0.9,  # of what it has alone, below which an effect shares what it explains with those before it
    "partly": 0.5,  # of the closable log mean square below which what all close is worth no name
    "distinct": 0.2,  # the same where nothing but its equivalents explains it:
    "other": 4.0,  # times as many nats as any other
    # of what the others leave, that a further effect has to close to be named where the rest stays unknown
    "apart": 0.25,
    "named": 0.8,  # of the closable log mean square that all have to close, else the rest is unknown
    # mean square of whitened residuals beyond which something is wrong even if nothing has a name (1: noise)
    "significant": 1.1,
    "peak": 2.5,  # the same of the worst channel
    # standard errors over trajectories by which a name has to lead, else the other is named with it
    "tie": 1.64,
    "alike": 0.97,  # share of its evidence beyond which the other is named with it too
    "equivalent": 0.8,  # the same where the other is another law for what looks alike
    # standard errors within which the one with fewer parameters comes first: the one-standard-error rule of
    # cross-validation (Breiman et al. 1984, Classification and Regression Trees, 3.4.3)
    "simpler": 1.0,
    "most": 3,  # effects
    "refit": 6,  # effects that are refitted after the screen, at most,
    "screened": 0.25,  # if they reach this share of what is asked of them there
}
# Logistic of a confidence; terms: 1, log1p(nats), share of the excess closed, log of what is left, lead over
# the runner-up [z], tied.
CONFIDENCE = (-0.84, 0.583, 1.103, -1.437, 0.064, 0.476)


def threshold_hash() -> str:
    """Names the thresholds that a verdict was reached with."""
    return hashlib.sha256(json.dumps([THRESHOLDS, CONFIDENCE], sort_keys=True).encode()).hexdigest()[:12]


def confidence(nats: float, closed: float, left: float, lead: float, ties: int) -> float:
    """Probability that a name is the right one.

    Args:
      nats: per trajectory, left out. closed: share of the excess that all effects close. left: mean log mean
        square that remains.
      lead: over the runner-up, in standard errors over trajectories. ties: how many others do as well.
    """
    return float(1 / (1 + np.exp(-np.dot(CONFIDENCE, terms(nats, closed, left, lead, ties)))))


def terms(nats: float, closed: float, left: float, lead: float, ties: int) -> list:
    """What CONFIDENCE weighs."""
    return [1.0, np.log1p(max(nats, 0.0)), closed, max(left, 0.0), min(max(lead, 0.0), 10.0), float(ties > 0)]
