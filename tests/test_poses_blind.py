"""Scoring of verdicts on recordings with poses (synthetic verdicts)."""

import dataclasses
import json
import pathlib
import sys
import types

import numpy as np
import pytest
from test_discrepancy_workflow import Springs, measured

from biotac_mj.discrepancy import Trajectory
from biotac_mj.effects.catalogue import by_id

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "benchmarks"))

import poses_blind

REST = 2500.0


def truth(ids, tier="full", outside=False):
    return {"effects": [{"id": i} for i in ids], "tier": tier, "outside": outside}


def verdict(*effects, text="found: one"):
    return {"verdict": text, "effects": [{"id": i, "ties": list(t), "confidence": 0.9} for i, *t in effects]}


def test_verdicts_are_counted_as_hidden_and_named(tmp_path):
    hidden = {
        "case_0": truth(["relaxation"]),
        "case_1": truth(["fluid_loss"], "condensed"),
        "case_2": truth(["gain", "drift"]),
        "case_3": truth([]),
        "case_4": truth(["outside"], outside=True),
        "case_5": truth(["outside"], outside=True),
        "case_6": truth([]),
    }
    (tmp_path / "truth.json").write_text(
        json.dumps([{**t, "file": f"x/{c}/a.csv"} for c, t in hidden.items()])
    )
    found = {
        "case_0": verdict(["creep", "relax"]),
        "case_1": verdict(["warmup"]),
        "case_2": verdict(["gain"]),
        "case_3": verdict(["asper"]),
        "case_4": verdict(text="unknown (nothing)"),
        "case_5": verdict(text="no significant disagreement"),
    }
    out = poses_blind.score(poses_blind.read_truth(tmp_path), found)
    assert out["names"] == [2, 4] and out["pairs"] == [0, 1, 1] and out["false"] == [1, 1]
    assert out["single"] == {"full": [1, 1], "condensed": [0, 1]} and out["outside"] == [1, 2]
    assert [ok for _, ok in out["stated"]] == [True, False, True, False]
    found["case_1"] = verdict(["warmup", "fluidloss"])
    assert poses_blind.score(hidden, found)["single"]["condensed"] == [1, 1]
    (tmp_path / "truth.json").write_text(
        json.dumps({"cases": [{**hidden["case_0"], "file": "case_0/a.csv"}]})
    )
    assert list(poses_blind.read_truth(tmp_path)) == ["case_0"]


@dataclasses.dataclass
class Amended:
    """A simulator whose effects are gains of all electrodes."""

    effects: list
    modulus: float = 1.0

    def fields(self, data, progress):
        return None

    def run(self, data, fields, exact, offsets=None):
        by = self.modulus + sum(theta["by"] for _, theta in self.effects)
        deeper = np.zeros((len(data), 3)) if offsets is None else offsets
        depth = [t.depth + off[1] for t, off in zip(data, deeper)]
        rows = [(REST + by * (d / 1e-3 * 200)[:, None] * np.ones(19), len(d)) for d in depth]
        return [types.SimpleNamespace(counts=c, pdc=np.zeros(n), force=np.zeros((n, 3))) for c, n in rows]


def test_the_known_gap_closes_as_far_as_the_amendment_repeats():
    """A gain of 1.3 that the clean recording lacks; an amendment of half of it leaves half."""
    rng, n = np.random.default_rng(0), 40
    pos = np.zeros((n, 3))
    pos[:, 1] = np.concatenate([np.zeros(8), np.linspace(0, 1e-3, 12), np.full(20, 1e-3)])
    change = 2e5 * pos[:, 1:2] * np.ones(19)
    clean = Trajectory(
        "a", "sphere_7mm", 0.0, np.arange(n) / 50, pos, np.tile(np.eye(3), (n, 1, 1)), REST + change
    )
    shown = dataclasses.replace(clean, electrodes=REST + 1.3 * change)
    noisy = dataclasses.replace(clean, electrodes=shown.electrodes + rng.normal(0, 2, (n, 19)))
    known = {"electrodes": np.full(19, 2.0), "pdc": None, "force": None}
    for said, share in ((0.3, 1.0), (0.15, 0.5), (0.0, 0.0)):
        sim = Amended([(by_id("gain"), {"by": said})])
        assert abs(poses_blind.gap([noisy], [clean], sim, {"a"}) - share) < 0.06
        exact = poses_blind.gap([shown], [clean], sim, {"a"}, noise=known)  # without noise of its own
        assert exact == pytest.approx(share, abs=1e-6)
    deep, sim = 2e5 * 2e-4, Amended([(by_id("gain"), {"by": 0.3})])  # where the object was
    both = [
        dataclasses.replace(t, electrodes=t.electrodes + by * deep) for t, by in ((shown, 1.3), (clean, 1))
    ]
    meant, found = (
        poses_blind.gap(*([one] for one in both), sim, {"a"}, noise=known, offsets=off)
        for off in (None, [[0, 2e-4, 0]])
    )
    assert meant < 0.85 and found > 0.999
    assert poses_blind.gap([clean], [clean], Amended([]), {"a"}) is None
    stiffer = Amended([], modulus=1.3)
    assert poses_blind.gap([noisy], [clean], stiffer, {"a"}, modulus=True) > 0.94
    assert poses_blind.gap([noisy], [clean], stiffer, {"a"}) < 0.06


def test_what_the_base_model_mimics_is_not_shown():
    """Synthetic springs: another modulus shows in every press, and not beside a modulus that is fitted."""
    late = [(by_id("relax"), {**by_id("relax").default(), "g": 0.35})]
    clean, stiff, relaxing = (measured(e, n=8, modulus=m) for e, m in (([], 1.0), ([], 1.3), (late, 1.0)))
    nats, beside = poses_blind.shown(stiff, clean, Springs())
    assert nats > 5 and beside < 0.2 * nats
    nats, beside = poses_blind.shown(relaxing, clean, Springs())
    assert nats > 5 and beside > 0.3 * nats
    assert max(poses_blind.shown(clean, clean, Springs())) == 0.0
