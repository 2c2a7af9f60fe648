"""Probability that a finding's name is right: a logistic regression of its detector's features, fitted to the
hidden effects of several authors (`benchmarks/discrepancy_confidence.py`)."""

import functools
import json
import pathlib

from ...quality import confidence as of_log
from ...quality.confidence import NAMED, WEIGHTS

__all__ = ["NAMED", "USUAL", "confidence", "farthest"]

_FITTED = json.loads(pathlib.Path(__file__).with_name("confidence.json").read_text())
# kind of recordings -> what is usual of those without an effect (`farthest`), and the limit that one in ten
# of them exceeds
USUAL: dict = _FITTED["usual"]
_WEIGHTS = WEIGHTS | {name: (w["intercept"], w["features"]) for name, w in _FITTED["weights"].items()}
_FAR = 6.0  # spreads: what lies beyond is unusual, whatever it is

# of a candidate's name; what many electrodes have, each by itself, has one cause more often than many
confidence = functools.partial(of_log.confidence, weights=_WEIGHTS)


def farthest(features: dict, usual: dict) -> tuple[float, str]:
    """Largest deviation of a recording's features above their usual values, in spreads, and the feature's
    name.

    Args:
      features: with the logarithm of the recording's seconds. usual: name -> (median, its change with the
        logarithm of the seconds, spread).
    """
    seconds = features["seconds"]
    return max(
        (
            (min(max((features[name] - middle - slope * seconds) / spread, 0.0), _FAR), name)
            for name, (middle, slope, spread) in usual.items()
            if name in features
        ),
        default=(0.0, ""),
    )
