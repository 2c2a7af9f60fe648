"""Sensors, heat and vibration in tasks: what a reset draws, what moves in an episode."""

import numpy as np
import pytest

pytest.importorskip("dm_control", reason="needs dm_control: pip install biotac_mj[control]")

from biotac_mj.sensor.presets import SENSORS  # noqa: E402
from biotac_mj.tasks import load  # noqa: E402

FEEL = {"thermal": {"plate": ["steel", "foam"]}, "textures": {"plate": ["cork", "carpet"]}}


def made(seed=0, task=("finger", "press"), **biotac):
    return load(*task, task_kwargs={"random": seed, "biotac": {"skin": "coarse", **biotac}})


def key(env, channel):
    return next(name for name in env.observation_spec() if name.endswith(f"/{channel}"))


def test_a_reset_draws_a_sensor_by_the_seed():
    rests, shown = [], []
    for seed in (0, 0, 1):
        env = made(seed, sensor="random", randomise=["dead", "gain"])
        for _ in range(2):
            step = env.reset()
            rests.append(env.task.biotacs[0].sensor)
            shown.append(step.observation[key(env, "electrodes")])
            noise = rests[-1].electrode_noise(np.array(rests[-1].rest))
            assert (np.abs(shown[-1] - env.task.biotacs[0].rest()) <= 5 * noise + 1).all()
    assert rests[0] == rests[2] and rests[1] == rests[3] and (shown[0] == shown[2]).all()
    assert len({r.rest for r in rests}) == 4


def test_a_preset_is_shown_with_its_noise():
    env = made(sensor="phac_f0")
    step = env.reset()
    sensor = SENSORS["phac_f0"]
    assert step.observation[key(env, "pdc")] == pytest.approx(sensor.pdc_rest, abs=2)
    assert step.observation[key(env, "tdc")] == pytest.approx(sensor.tdc_rest, abs=2)
    pac = np.concatenate([env.reset().observation[key(env, "pac")] - sensor.pac_rest for _ in range(6)])
    rows = pac.reshape(6, 22)
    assert (rows[:, 1:] * rows[:, :-1]).mean() > 0.5 * (rows**2).mean()  # colour, not white


def pressed(seconds=0.5, **biotac):
    """Readings (n, ...) of TDC, TAC and PAC while the finger goes down and along."""
    env = made(noise=False, **biotac)
    env.reset()
    seen = {name: [] for name in ("tdc", "tac", "pac")}
    spec = env.action_spec()
    for i in range(round(seconds / 0.01)):
        action = np.zeros(spec.shape)
        action[spec.name.split("\t").index("z")] = -1.0 if i < 20 else 0.0
        if i > 25:
            action[0] = 1.0 if i % 20 < 10 else -1.0
        step = env.step(action)
        for name, rows in seen.items():
            rows.append(step.observation[key(env, name)])
    return env, {name: np.array(rows) for name, rows in seen.items()}


@pytest.mark.slow  # quick: heat in tasks (test_features_senses.py), vibration in the coupling
def test_heat_and_vibration_move_tac_and_pac():
    _, plain = pressed()
    _, felt = pressed(thermal={"plate": "steel"}, textures={"plate": {"roughness": 3e-6}})
    assert np.ptp(plain["tac"]) <= 1 and np.ptp(felt["tac"]) > 10
    # from sample to sample, where the pressure of whole steps is smooth
    fine = [np.abs(np.diff(seen["pac"][30:], n=2, axis=1)).mean() for seen in (plain, felt)]
    assert fine[1] > 2 * fine[0], fine


def test_materials_are_drawn_at_a_reset():
    env = made(3, **FEEL)
    states = []
    for _ in range(6):
        env.reset()
        states.append(env.physics.data.plugin_state.copy())
    assert len(np.unique(states, axis=0)) > 1
    with pytest.raises(ValueError, match="no material is known by 'unobtainium'"):
        made(thermal={"plate": ["steel", "unobtainium"]})
    with pytest.raises(ValueError, match="thermal is .'steel'.: pass a dict or None"):
        made(thermal=["steel"])


@pytest.mark.parametrize("sense", ["thermal", "textures"])
def test_a_geom_that_is_not_there_is_said(sense):
    with pytest.raises(ValueError, match="no geom 'plait' to touch: the model has"):
        made(**{sense: {"plait": "cork"}})


def test_gymnasium_draws_by_the_seed_of_its_reset():
    gymnasium = pytest.importorskip("gymnasium", reason="needs gymnasium: pip install biotac_mj[gymnasium]")
    biotac = {"skin": "coarse", "sensor": "random", "thermal": {"plate": ["steel", "foam"]}}
    env = gymnasium.make("biotac_mj.tasks.environments:BioTac/Press-v0", biotac=biotac)
    name = next(name for name in env.observation_space if name.endswith("/electrodes"))
    first, again, other = (env.reset(seed=seed)[0][name] for seed in (0, 0, 1))
    assert (first == again).all() and np.abs(first - other).max() > 30
    env.close()
