"""The tasks in Gymnasium: its own checker is content, episodes repeat with their seed, several run side by
side."""

import copy
import pickle
import warnings

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="needs gymnasium (extra gymnasium)")
pytest.importorskip("dm_control", reason="needs dm_control (extra control)")

# ruff: noqa: E402
from gymnasium.utils.env_checker import check_env

import biotac_mj.tasks
from biotac_mj.sensor.channels import REST_COUNTS
from biotac_mj.tasks.environments import IDS, BioTacEnv

ids = biotac_mj.tasks.register()


def test_every_task_is_registered():
    assert ids == list(IDS) and "BioTac/Press-v0" in ids and "BioTac/FollowEdge-v0" in ids
    assert set(IDS.values()) == set(biotac_mj.tasks.tasks())
    assert biotac_mj.tasks.register() == ids  # twice does no harm


def checked(name):
    env = gymnasium.make(name, time_limit=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for harmless in (
            ".*Overriding environment.*",
            ".*precision lowered.*",
            ".*Box observation space.*infinity.*",
            ".*render.*",
            ".*glfw.*",
        ):
            warnings.filterwarnings("ignore", message=harmless)
        check_env(env.unwrapped, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space


def test_checker_is_content():
    checked("BioTac/Press-v0")


@pytest.mark.slow
@pytest.mark.parametrize("name", [i for i in IDS if i != "BioTac/Press-v0"])
def test_checker_is_content_with(name):
    checked(name)


def test_episode_ends_with_its_time_and_repeats_with_its_seed():
    env = gymnasium.make("BioTac/Press-v0", time_limit=0.05)
    action = np.array([0.3, -0.2, -1.0], np.float32)
    runs = []
    for _ in range(2):
        observation, info = env.reset(seed=5)
        rows, over = [observation["target"]], False
        while not over:
            observation, reward, terminated, over, info = env.step(action)
            assert observation in env.observation_space and 0 <= reward <= 1 and not terminated
            rows += [observation["position"], observation["finger/biotac/electrodes"]]
        runs.append(np.concatenate(rows))
    np.testing.assert_array_equal(*runs)
    assert len(runs[0]) == 1 + 5 * 22
    other, _ = env.reset(seed=6)
    assert other["target"] != runs[0][0]


@pytest.mark.slow
def test_several_side_by_side():
    envs = gymnasium.make_vec("BioTac/Press-v0", num_envs=2, vectorization_mode="sync", time_limit=0.05)
    observation, _ = envs.reset(seed=1)
    assert (
        observation["finger/biotac/electrodes"].shape == (2, 19)
        and observation["target"][0] != observation["target"][1]
    )
    for _ in range(6):
        observation, reward, terminated, truncated, _ = envs.step(np.zeros((2, 3), np.float32))
    assert reward.shape == (2,)
    envs.close()


def test_without_touch_there_is_none():
    names = BioTacEnv("finger", "press", observe="none").observation_space.keys()
    assert sorted(names) == ["position", "target"]


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="unknown render_mode 'human': choose rgb_array or None"):
        BioTacEnv("finger", "press", render_mode="human")
    with pytest.raises(ValueError, match="domain 'finger' has no task 'pres'"):
        BioTacEnv("finger", "pres")


def test_training_example_learns_from_touch_interface(repo, tmp_path):
    """The example's wrapper gives finite, scaled features, with touch and without; a training of a few steps
    runs to its end."""
    pytest.importorskip("stable_baselines3", reason="needs stable-baselines3 (extra examples)")
    from test_examples import load

    example = load(repo, "train_press")
    for touch, size in ((True, 22), (False, 2)):
        env = example.PressByTouch(touch)
        observation, _ = env.reset(seed=0)
        assert observation.shape == (size,) and np.abs(observation).max() < 5
        env.close()
    rows = example.train(True, steps=16, seed=0, rollout=16)
    assert rows and {"steps", "reward"} <= set(rows[0])


def test_pictures_need_no_setting(monkeypatch):
    """Without a window and with MUJOCO_GL unset the library that works is found; where there is none, one
    error before anything is drawn."""
    from biotac_mj.view.offscreen import find_gl

    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.raises(ValueError, match="no GL library to render with: install libosmesa6 or libegl1"):
        BioTacEnv("finger", "press", render_mode="rgb_array")
    monkeypatch.delenv("MUJOCO_GL")
    if find_gl() is None:
        pytest.skip("no GL library to render with: install libosmesa6 or EGL")
    env = BioTacEnv("finger", "press", render_mode="rgb_array", width=64, height=48)
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (48, 64, 3) and picture.std() > 5
    env.close()
    env.close()


AGAIN = [lambda x: pickle.loads(pickle.dumps(x)), copy.copy, copy.deepcopy]


def same(a, b):
    """Whether what two steps told is equal to the bit."""
    names = a[0].keys()
    return names == b[0].keys() and all(np.array_equal(a[0][k], b[0][k]) for k in names) and a[1:] == b[1:]


@pytest.mark.parametrize(
    "name, again",
    [
        ("BioTac/Press-v0", AGAIN[0]),
        pytest.param("BioTac/Lift-v0", AGAIN[1], marks=pytest.mark.slow),
        pytest.param("BioTac/Hold-v0", AGAIN[2], marks=pytest.mark.slow),
    ],
)
def test_a_copy_goes_on_where_it_was_made(name, again):
    """Through the episode's end and the next reset: skin, masses that were drawn, noise and the clock."""
    env = gymnasium.make(name, time_limit=0.12)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (20, *env.action_space.shape)).astype(np.float32)
    env.reset(seed=3)
    for action in actions[:5]:
        env.step(action)
    # a shallow copy of Gymnasium's wrappers has their environment, as Gymnasium means it
    made = again(env.unwrapped if again is copy.copy else env)
    assert made.unwrapped.spec == env.unwrapped.spec
    assert made.unwrapped.suite.physics.time() == pytest.approx(0.05)
    ends = []
    for action in actions[5:]:
        told = [x.step(action) for x in (env, made)]
        assert same(*told)
        ends.append(told[0][3])
        if ends[-1]:
            first, second = (x.reset()[0] for x in (env, made))
            assert same((first,), (second,))
    assert sum(ends) == 1
    plain, other = env.unwrapped.suite, made.unwrapped.suite
    assert plain.physics.model.ptr is not other.physics.model.ptr
    assert np.array_equal(plain.physics.model.body_mass, other.physics.model.body_mass)


@pytest.mark.parametrize("again", [pytest.param(AGAIN[0], marks=pytest.mark.slow), AGAIN[2]])
def test_a_copy_of_a_loaded_task_goes_on(again):
    """With readings that are late, settings changed since, a hook, and a touch in the skin's memory."""
    env = biotac_mj.tasks.load(
        "finger",
        "press",
        task_kwargs={
            "random": 4,
            "observe": "privileged",
            "biotac": {"material": "rubber", "sensor": "random"},
        },
    )
    readings = env.task.biotacs[0].observables
    readings.contact_force.rate, readings.contact_force.lag = 1000.0, 0.03
    readings.pdc.noise, readings.tac.enabled = None, False
    env = again(env)  # before an episode, too
    readings = env.task.biotacs[0].observables
    assert (readings.contact_force.lag, readings.pdc.noise, readings.tac.enabled) == (0.03, None, False)
    readings.contact_force.resolve(env.physics.timestep())
    env.add_extra_hook("before_step", count)
    env.reset()
    down = np.array([0.2, 0.0, -1.0])
    while abs(env.task.contact_force(env.physics)[1]) < 0.5:
        env.step(down)
    made, time = again(env), env.physics.time()
    for field in ("sensordata", "qacc_warmstart", "plugin_state", "xpos"):
        assert np.array_equal(*(getattr(x.physics.data, field) for x in (env, made)))
    rest, other = (x.task.biotacs[0].sensor.rest for x in (env, made))
    assert np.array_equal(rest, other) and not np.array_equal(rest, REST_COUNTS["1"])
    counted.clear()
    for _ in range(6):
        told = [(x.step(down).observation, x.physics.time()) for x in (env, made)]
        assert same(*told)
    assert len(counted) == 12 and env.physics.time() == pytest.approx(time + 0.06)
    assert np.array_equal(env.physics.data.plugin_state, made.physics.data.plugin_state)
    before = env.physics.time()
    first, second = made.reset().observation, again(made).reset().observation
    assert env.physics.time() == before  # nothing is shared
    assert not np.array_equal(first["target"], second["target"])  # the next episode, not the first again


counted = []


def count(physics, action, random_state):
    counted.append(physics.time())


@pytest.mark.parametrize("again", [*(pytest.param(a, marks=pytest.mark.slow) for a in AGAIN[::2]), AGAIN[1]])
def test_a_copy_of_a_closed_environment_is_closed(again):
    env = BioTacEnv("finger", "press")
    env.close()
    made = again(env)
    assert made.suite is None and made.render() is None
    for use in (made.reset, lambda: made.step(np.zeros(3, np.float32))):
        with pytest.raises(ValueError, match="the environment is closed: make another one"):
            use()
