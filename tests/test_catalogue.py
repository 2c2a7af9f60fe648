"""The catalogue of effects: what stands in it, and that nothing outside it decides by an effect's id."""

import ast
import pathlib

import numpy as np
import pytest
from imports import modules

from biotac_mj.discrepancy.recordings.recording import PlainRecording
from biotac_mj.discrepancy.recordings.search import diagnose_recording
from biotac_mj.effects.catalogue import CATALOGUE, entries
from biotac_mj.effects.effect import STAGES, Effect, Param, Run
from biotac_mj.effects.logged import LOGGED
from biotac_mj.sensor.channels import counts_from_log_impedance

# Strings in comparisons, sets and keys of dicts outside effects/ that are equal to an id and name something
# else, by module. None decides by an effect's id: what a search has to know is an attribute of the entry.
LEFT = {
    "discrepancy.recordings.amended": 1,  # a field of Sensor
    "discrepancy.recordings.detectors.latency": 1,  # a feature of a finding
    "discrepancy.simulated.tables": 1,  # a setting of FilmConduction
    "discrepancy.trajectories.composition": 1,  # a threshold
    "discrepancy.trajectories.model.differences": 4,  # settings of skin and film, differences of the skin
    "discrepancy.trajectories.model.simulator": 1,  # a difference of the skin
    "discrepancy.trajectories.thresholds": 1,
}


def decisions(tree, ids):
    """(line, column, id) of strings equal to an id in comparisons, sets, keys of dicts and look-ups."""
    found = set()

    def strings(node):
        found.update(
            (c.lineno, c.col_offset, c.value)
            for c in ast.walk(node)
            if isinstance(c, ast.Constant) and isinstance(c.value, str) and c.value in ids
        )

    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            for side in (node.left, *node.comparators):
                if isinstance(side, (ast.Constant, ast.Tuple, ast.List, ast.Set)):
                    strings(side)
        elif isinstance(node, ast.Set):
            strings(node)
        elif isinstance(node, ast.Dict):
            for key in filter(None, node.keys):
                strings(key)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("by_id"):
            strings(node)
    return sorted(found)


def test_decisions_are_found():
    code = 'if e.id == "gain" or e.id in ("swap", "x"):\n    {"drift": 1}[by_id("noise").id]\nf("gain")\n'
    found = decisions(ast.parse(code), {"gain", "swap", "drift", "noise"})
    assert [name for _, _, name in found] == ["gain", "swap", "drift", "noise"]


def test_no_decision_by_an_id_outside_the_catalogue():
    ids, found = {e.id for e in entries()}, {}
    for name, path in modules().items():
        name = name.removeprefix("biotac_mj.")
        if name.startswith("discrepancy"):
            found[name] = len(decisions(ast.parse(pathlib.Path(path).read_text()), ids))
    found = {name: number for name, number in found.items() if number}
    assert found == LEFT, "make a decision by an effect's id an attribute of the effect"


@pytest.mark.parametrize("fits", ["poses", "log", "plate"])
def test_ids_stand_once_and_parameters_lie_within_bounds(fits):
    found = entries(fits)
    assert len({e.id for e in found}) == len(found) > 10
    for effect in found:
        assert effect.stage in STAGES and effect.name and effect.physics and effect.params, effect.id
        for name, p in effect.params.items():
            assert p.low < p.high and p.unit and p.source, (effect.id, name)
            assert p.low <= p.start <= p.high or fits == "log", (effect.id, name)


def test_the_search_with_poses_has_the_effects_that_it_can_fit():
    assert entries("poses") == CATALOGUE and len(CATALOGUE) == 34
    assert {e.id for e in entries("log")} - {e.id for e in CATALOGUE} == {
        *("count_offset", "count_gain", "flip", "stuck", "freeze"),
        *("lost_rows", "quantise", "spikes", "hum"),
    }


def test_effects_confused_with_each_other_are_known():
    ids = {e.id for e in entries()} | {"base"}  # what the base model is off by
    for effect in entries():
        assert {*effect.confusable, *effect.kin, *effect.refit_with} <= ids, effect.id


# --- faults of a log, put into counts


def at_rest(seconds=60, seed=0):
    """Counts of a sensor that nothing touches, their rests [ln ohm], and their noise's generator."""
    rng, n = np.random.default_rng(seed), int(100 * seconds)
    log_z = np.log(1e4) + rng.uniform(-1, -0.2, 19)
    return np.tile(counts_from_log_impedance(log_z), (n, 1)), log_z, rng


FAULTS = {
    "count_offset": {"change": 40.0},
    "count_gain": {"change": 0.02},
    "drift": {"change": 60.0},
    "flip": {"factor": -1.0},
    "swap": {"onset": 30.0},
    "stuck": {"value": 900.0},
    "freeze": {"seconds": 5.0},
    "saturate": {"level": 2500.0},
    "quantise": {"step": 32.0},
    "spikes": {"rate": 120.0},
    "hum": {"amplitude": 8.0, "frequency": 12.5},
    "common_noise": {"correlation": 0.5},
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_of_its_electrodes_and_its_time(name):
    """Electrodes 3, 8 and 12 from 20 to 40 s; what drifts keeps its level."""
    counts, log_z, rng = at_rest()
    counts = counts + 3 * rng.standard_normal(counts.shape)
    kind = type(next(e for e in LOGGED if e.id == name))
    run = Run.of_counts(counts, log_z, np.arange(len(counts)) / 100)
    kind([3, 8, 12], 20.0, 40.0).apply(run, FAULTS[name])
    changed = np.abs(run.counts - counts) > 1e-9
    rows = changed.any(1).nonzero()[0]
    assert changed.any() and not np.delete(changed, [3, 8, 12], axis=1).any()
    assert rows[0] >= 2000 and (rows[-1] <= 4000 or name == "drift")


def test_lost_rows_leave_no_gap_in_the_clock():
    counts, log_z, _ = at_rest()
    time = np.arange(len(counts)) / 100
    run = Run.of_counts(counts + time[:, None], log_z, time)
    kind = type(next(e for e in LOGGED if e.id == "lost_rows"))
    kind(start=20.0).apply(run, {"seconds": 3.0})
    assert len(run.time) == len(run.counts) == len(time) - 300 and np.allclose(np.diff(run.time), 0.01)
    assert np.isclose(np.diff(run.counts[:, 0]).max(), 3.01)


@pytest.mark.parametrize("name", ["stuck", "hum"])
def test_a_fault_of_the_catalogue_is_diagnosed_as_itself(name):
    counts, log_z, rng = at_rest()
    counts = counts + 4 * rng.standard_normal(counts.shape)
    run = Run.of_counts(counts, log_z, np.arange(len(counts)) / 100)
    kind = type(next(e for e in LOGGED if e.id == name))
    channels = [5] if name == "stuck" else range(19)
    kind(channels).apply(run, FAULTS[name])
    found = diagnose_recording(PlainRecording(np.clip(np.rint(run.counts), 0, 4095), rate=100.0))
    assert [f.id for f in found.findings] == [name] and list(found.findings[0].channels) == list(channels)


def test_an_effect_is_one_class():
    """What it says of itself is all that the searches ask for."""

    class Half(Effect):
        id, name, stage = "half", "one half of the multiplexer creeps", "A"
        params = {"rate": Param("counts/s", -5, 5, "a made-up board", 0.1)}

        def apply(self, run, theta):
            run.counts[:, ::2] += theta["rate"] * run.clock[:, None]

    effect, (counts, log_z, _) = Half(), at_rest(1)
    run = Run.of_counts(counts.copy(), log_z, np.arange(len(counts)) / 100)
    effect.apply(run, {"rate": 2.0})
    assert np.allclose((run.counts - counts)[-1], np.where(np.arange(19) % 2, 0, 2 * run.time[-1]))
    assert not (effect.flexible or effect.before_skin or effect.per_channel or effect.undoes({}, 1.0))
