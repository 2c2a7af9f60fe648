"""Simulation in the loop for recordings: what disagrees, in which stage, whose it is. Synthetic tables and
sensors; real recordings where BIOTAC_RECORDINGS has them."""

import dataclasses
import json
import os
import pathlib
import types

import mujoco
import numpy as np
import pytest
from made_up_plate import made_up_states
from verdicts import check_verdict

import biotac_mj
from biotac_mj.discrepancy.plates import models, tables
from biotac_mj.discrepancy.plates.diagnosis import diagnose_presses
from biotac_mj.discrepancy.recordings.recording import PlainRecording, read_recording
from biotac_mj.discrepancy.report.files import write_report
from biotac_mj.discrepancy.report.text import summary
from biotac_mj.discrepancy.verbs import diagnose_verb, diagnose_with_states
from biotac_mj.effects.plate import PLATE, bonded, moved
from biotac_mj.geometry.skins import load_skin
from biotac_mj.matching.fit import SIGNS, Constants
from biotac_mj.matching.response import Response
from biotac_mj.press.path import PressOptions
from biotac_mj.sensor.channels import REST_COUNTS, counts_from_log_impedance, log_impedance
from biotac_mj.skin.rubber.material import CALIBRATED_FILL

TIP = [6, 7, 8, 9]
MODULUS = 1.2e6  # [Pa] of the synthetic sensors
BY_ID = {m.id: m for m in PLATE}
TRIED = dataclasses.replace(BY_ID["friction"], base=0.0, other=1.0), BY_ID["fill"]
AT_TIP = [0.0, 0.8]


@pytest.fixture(scope="module")
def answers():
    """A synthetic base model with two changes, of the tip's answers and of E17 to E19."""
    states, log_z = made_up_states(drag=(1.0,))
    at_tip = np.isin(np.arange(19), TIP)
    here = Response(states, log_z)
    pairs = {
        "friction": (here, Response(states, log_z * np.where(np.arange(19) > 15, 0.6, 1.0))),
        "fill": (here, Response(states, log_z * np.where(at_tip, 1.8, 1.0))),
    }
    return here.with_changes(*(pairs[m.id] for m in TRIED))


def synthetic(answers, amount, seed):
    """A synthetic recording of a sensor that has an amount (2,) of the changes, with 3 counts of noise."""
    rng, n = np.random.default_rng(seed), 420
    time = np.arange(n) / n
    turn = lambda w, phase: np.sin(w * time + phase + seed)  # noqa: E731
    state = np.column_stack(
        [0.25 + 0.2 * turn(29, 0), 0.5 * turn(41, 1), 0.5 * turn(53, 2), 0.5 * turn(37, 3)]
    )
    pressing = 3 + 2 * turn(83, 4)
    rest = log_impedance(REST_COUNTS["2"]) + rng.normal(0, 0.02, 19)
    const = Constants(rest, np.ones(19), np.array([-0.1, np.log(0.3)]), MODULUS, np.array(amount))
    value, _ = answers.at_load(pressing / MODULUS, const.amount)(state, False)
    counts = counts_from_log_impedance(const.log_z(value[:, :19], time)) + rng.normal(0, 3, (n, 19))
    force = np.column_stack([value[:, 19:] * MODULUS, pressing]) @ np.linalg.inv(SIGNS)
    return PlainRecording(counts, force, rate=100.0, name=f"synthetic {seed}")


@pytest.fixture(scope="module")
def of_both(answers):
    """Two synthetic sensors whose tips answer more than the base model's, and what is found."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(models, "_ROWS", 50)
        recordings = [synthetic(answers, AT_TIP, seed) for seed in (1, 2)]
        return diagnose_presses(recordings, answers, TRIED, quiet=True)


def test_what_two_sensors_share_is_the_base_models(of_both):
    assert [f.id for f in of_both.named] == ["fill"] and "base model" in of_both.effects[0].note
    by_id = {f.id: f for f in of_both.models}
    for sensor, tested in zip(of_both.sensors, by_id["fill"].tested):
        assert set(sensor.worst) & set(TIP), "it finds the tip by itself"
        low, value, high = CALIBRATED_FILL * np.array([tested.low, tested.amount, tested.high])
        assert low < 0.8 * CALIBRATED_FILL < high and abs(value / CALIBRATED_FILL - 0.8) < 0.25
        assert tested.closed(sensor.worst) > 1 - 0.6**2


def test_what_is_written_runs(of_both, answers, tmp_path):
    verdict = of_both.to_dict()
    (effect,) = verdict["effects"]  # nothing else is in the first recording
    assert effect["id"] == "fill" and effect["confirmed"] and effect["ties"] == []
    off = [one for one in verdict["where"] if one.get("sensor") == "synthetic 1"]
    assert {one["channel"] for one in off} >= {f"e{k + 1}" for k in TIP}
    assert off[0]["counts"] > off[0]["expected"] and off[0]["p"] < 0.05
    paths = write_report(of_both, tmp_path)
    written = json.loads(paths[1].read_text())
    check_verdict(written)
    assert written["verdict"].startswith("found: fill")
    assert written["effects"][-1]["id"] == "fill" and "gap" in written and written["tried"]
    assert paths[-1].name == "where.png" and paths[-1].stat().st_size > 10_000
    assert "synthetic 2" in summary(of_both) and "synthetic 2" in paths[0].read_text()
    attached = {one["sensor"]: one["attach"] for one in verdict["tried"] if one["id"] == "fill"}
    fill = attached["synthetic 1"]["options"]["skin"]["fill_volume"]
    assert 0.5 * CALIBRATED_FILL < fill < 1.1 * CALIBRATED_FILL
    spec = mujoco.MjSpec()
    handle = biotac_mj.attach(spec, body="world", effects=paths[2], skin="coarse")
    assert handle.config.options["skin"]["fill_volume"] == pytest.approx(fill)
    assert handle.config.material["youngs_modulus"] == pytest.approx(MODULUS, rel=0.1)
    assert np.ptp(handle.numbers.rest) > 0 and spec.compile().nsensor
    pressed = PressOptions(effects=paths[2]).settings.amended()
    assert pressed.options["skin"]["fill_volume"] == pytest.approx(fill)


@pytest.mark.slow
def test_what_one_sensor_has_alone_is_the_sensors(answers, monkeypatch):
    monkeypatch.setattr(models, "_ROWS", 150)
    recordings = [synthetic(answers, AT_TIP, 1), synthetic(answers, [0.0, 0.0], 2)]
    found = diagnose_presses(recordings, answers, TRIED, quiet=True)
    finding = next(f for f in found.models if f.id == "fill")
    assert finding.significant == (True, False) and finding.whose == "sensor synthetic 1"
    assert found.named == []
    clean = found.sensors[1]
    assert not clean.off, "noise and the fit's own uncertainty are all there is"


def test_a_change_on_a_coarser_table():
    """One that is the same in all directions is so between the coarser table's nodes, too."""
    states, log_z = made_up_states()
    fewer = dataclasses.replace(states.grid, pitch=states.grid.pitch[::5], drag=states.grid.drag[-1:])
    drags = np.isin(np.abs(states.grid.drag_paths).sum(1), (0.0, states.grid.drag[-1]))
    part = log_z[::5][:, :, drags]
    more = 0.3 * np.array(states.grid.load)[:, None] / 1e-6 * np.isin(np.arange(19), TIP)
    pair = Response(states.on(fewer), part), Response(states.on(fewer), part + more)
    base = Response(states, log_z)
    there = base.with_changes(pair).amended(np.array([0.5]))
    load, state = np.full(2, states.grid.load[3]), np.array([[0.2, 0.3, 0.4, 0.1], [0.1, -0.2, 0.0, -0.5]])
    change = there.at_load(load)(state, False)[0] - base.at_load(load)(state, False)[0]
    assert np.allclose(change[:, :19], 0.5 * more[3], atol=1e-5) and np.allclose(change[:, 19:], 0, atol=1e-9)


def test_shapes_of_the_wall():
    geometry = load_skin("coarse")
    tip = moved(geometry, -0.4e-3, -0.4e-3, tip=True)
    shift = np.linalg.norm(tip.vert - geometry.vert, axis=1)
    assert shift[geometry.fixed].max() == 0 and shift[geometry.vert[:, 0] > -10e-3].max() == 0
    assert 0.35e-3 < shift.max() <= 0.4e-3 + 1e-9
    assert set(geometry.fixed) < set(bonded(geometry, 1e-4).fixed)
    with pytest.raises(ValueError, match="turns tetrahedra over"):
        moved(geometry, -2e-3, 1e-3)
    states, _ = made_up_states()
    with pytest.raises(ValueError, match="choose among these"):
        states.on(tables.COARSER)


def test_what_it_needs_is_told():
    given = {"electrodes": "e.txt", "simulate": True, **dict.fromkeys(("force", "data", "also", "which"))}
    with pytest.raises(ValueError, match="--electrodes E.txt --force F.txt --simulate"):
        diagnose_verb(types.SimpleNamespace(**given))


def test_the_example_says_what_it_needs(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "examples"))
    import the_tip

    monkeypatch.delenv("BIOTAC_RECORDINGS", raising=False)
    with pytest.raises(SystemExit, match="set BIOTAC_RECORDINGS"):
        the_tip.main([])
    with pytest.raises(SystemExit, match="nowhere.txt"):
        the_tip.main(["--press", "nowhere.txt", "nowhere.txt", "--out", "out/nowhere"])


@pytest.mark.slow
@pytest.mark.skipif("BIOTAC_RECORDINGS" not in os.environ, reason="set BIOTAC_RECORDINGS to real recordings")
def test_two_real_sensors_lack_the_same_at_the_tip(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "examples"))
    import the_tip

    folder = pathlib.Path(os.environ["BIOTAC_RECORDINGS"])
    recordings = [read_recording(*(folder / name for name in pair)) for pair in the_tip.PRESSES]
    base, _ = tables.base_response(load_skin("coarse"), quiet=True)
    found = diagnose_presses(recordings, base, (), quiet=True)
    for sensor in found.sensors:
        assert {6, 7, 8} <= set(sensor.worst)
        assert {"e7", "e8", "e9"} <= {one["channel"] for one in sensor.off}


@pytest.mark.slow  # quick: what two sensors share, and what is written
def test_one_recording_cannot_tell_whose_it_is(answers, monkeypatch, tmp_path, capsys):
    """From the verb on, with synthetic tables in place of the skin's."""
    monkeypatch.setattr(models, "_ROWS", 60)
    monkeypatch.setattr(tables, "base_response", lambda *_: (answers, None))
    monkeypatch.setattr(tables, "with_effects", lambda base, *_: base)
    recording = synthetic(answers, AT_TIP, 5)
    found = diagnose_with_states([recording], tmp_path, True, TRIED)
    fill = next(f for f in found.models if f.id == "fill")
    assert fill.significant == (True,) and fill.whose == "unknown"
    assert "verdict:" in capsys.readouterr().out
    with pytest.raises(ValueError, match="no force"):
        diagnose_with_states([dataclasses.replace(recording, force=None)], tmp_path, True, TRIED)
