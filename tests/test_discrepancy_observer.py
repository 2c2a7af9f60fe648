"""What the benchmark of recordings counts as detectable."""

import sys

import numpy as np
import pytest
from test_discrepancy_recordings import pressed


@pytest.fixture
def seen_nats(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    from discrepancy_observer import SEEN, seen_nats

    yield lambda *args: (seen_nats(*args), SEEN)
    sys.modules.pop("discrepancy_observer")


def test_an_observer_sees_a_drift_and_nothing_within_rounding(seen_nats):
    """60 counts of one electrode, half a count; the share of another electrode's counts by its noise."""
    e, force, rng = pressed(3, 30)
    clean = np.rint(e + 4 * rng.standard_normal(e.shape))
    t = np.linspace(0, 1, len(clean))
    drift, little, share = clean.copy(), clean.copy(), clean.copy()
    drift[:, 6] += 60 * t**2
    little[:, 6] += 0.5 * t
    share[:, 6] += 0.4 * (clean[:, 11] - clean[:, 11].mean())
    (most, seen), (least, _), (heard, _) = (seen_nats(x, clean, force) for x in (drift, little, share))
    assert most > 2 * seen and heard > seen and least < 0.1 * seen
    assert seen_nats(clean, clean) == (0.0, seen)
    assert seen_nats(clean[10:], clean)[0] is None


def test_the_last_stage_of_a_hidden_effect_is_told(repo, monkeypatch):
    monkeypatch.syspath_prepend(repo / "benchmarks")
    from discrepancy_stages import stage

    def piece(named=(), **weak):
        found = {"right": "gain", "p": 0.001, "confidence": 0.4, "contradicted": False} | weak
        return {"truth": ["gain"], "named": [{"right": n} for n in named], "weak": [found]}

    assert stage(piece(["gain"])) == "named" and stage(piece([None])) == "below 0.5"
    assert stage(piece(contradicted=True)) == "kept aside" and stage(piece(confidence=0.55)) == "0.5 or more"
    assert stage(piece(p=0.1)) == "blocks differ" and stage(piece(right=None)) == "no candidate"
