"""Every task, by one test; the Entity's observables; touch and its estimators; bad input."""

import copy
import json
import os
import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest

pytest.importorskip("dm_control", reason="needs dm_control (extra control)")

# ruff: noqa: E402
from dm_control import composer, mjcf
from fit_estimators import fit_estimator

import biotac_mj
from biotac_mj.sensor.channels import REST_COUNTS
from biotac_mj.tasks import BioTac, load, scripted, suite, touch
from biotac_mj.tasks.biotac import ESTIMATED, PRIVILEGED, TACTILE

TASKS = [pytest.param(*pair, id="/".join(pair)) for pair in suite.tasks()]
# of what dm_control does alike with every task
A_FEW = [TASKS[0], *(pytest.param(*t.values, id=t.id, marks=pytest.mark.slow) for t in TASKS[1:])]
QUIET = {"noise": False}


@pytest.fixture(autouse=True)
def no_errors():
    import biotac_mj

    yield
    biotac_mj.plugin.check()


def rollout(domain, task, steps, seed, **settings):
    """Observations, rewards and positions of a random policy that pushes down, so that it touches."""
    env = load(domain, task, task_kwargs={"random": seed, "time_limit": 1e3, **settings})
    spec, rng = env.action_spec(), np.random.RandomState(seed)
    step, rows = env.reset(), []
    for _ in range(steps):
        action = rng.uniform(spec.minimum, spec.maximum, size=spec.shape)
        action[2 if domain == "finger" else -1] = -0.5 if domain == "finger" else 0.5
        step = env.step(action)
        for name, value in env.observation_spec().items():
            value.validate(step.observation[name])
        rows.append(
            np.concatenate(
                [np.ravel(v) for v in step.observation.values()] + [[step.reward], env.physics.data.qpos]
            )
        )
        assert 0.0 <= step.reward <= 1.0
    return np.array(rows), env


def check(domain, task, steps):
    first, env = rollout(domain, task, steps, 3)
    assert np.isfinite(first).all()
    again, _ = rollout(domain, task, steps, 3)
    np.testing.assert_array_equal(first, again)
    other, _ = rollout(domain, task, steps, 4)
    assert (other != first).any()
    touched = [np.abs(env.task.contact_force(env.physics, i)).max() for i in range(len(env.task.biotacs))]
    assert env.action_spec().shape == (len(env.action_spec().name.split("\t")),)
    assert env.task.hidden(env.physics).shape == (len(env.task.biotacs), len(env.task.estimated))
    return touched


# quick: a press and a grip, and one that looks for something
SLOWER = ("gripper/lift", "finger/roll_ball", "finger/follow_edge")


@pytest.mark.parametrize(
    "domain, task",
    [pytest.param(*t.values, id=t.id, marks=[pytest.mark.slow] if t.id in SLOWER else []) for t in TASKS],
)
def test_a_task_keeps_its_specs_and_repeats_its_seed(domain, task):
    """Specs hold, rewards lie in [0, 1], nothing is NaN, the same seed gives the same trajectory and another
    one another."""
    check(domain, task, 3)


@pytest.mark.slow
@pytest.mark.parametrize("domain, task", TASKS)
def test_a_task_for_200_steps(domain, task):
    """The same for 200 steps, in which what is there is touched."""
    assert max(check(domain, task, 200)) > 0.01


def test_an_episode_begins_anew():
    """A reset after contact leaves no trace: skin and readings start from rest, without a new compilation."""
    env = load("finger", "press", task_kwargs={"random": 0, "biotac": QUIET})
    env.reset()
    model = env.physics.model.ptr
    for _ in range(45):
        step = env.step(np.array([0, 0, -1.0]))
    entity = env.task.biotacs[0]
    assert entity.read(env.physics, "contact_force")[1] > 0.1
    assert np.abs(step.observation["finger/biotac/electrodes"] - REST_COUNTS["1"]).max() > 20
    step = env.reset()
    assert env.physics.model.ptr is model
    np.testing.assert_array_equal(step.observation["finger/biotac/electrodes"], REST_COUNTS["1"])
    np.testing.assert_array_equal(entity.read(env.physics, "contact_force"), 0.0)


class PlateTask(composer.Task):
    """A plate pushed against a BioTac's pad, along its own frame's +y."""

    def __init__(self, depth, **settings):
        self.arena, self.entity, self.depth = composer.Arena(), BioTac(**settings), depth
        self.arena.attach(
            self.entity, self.arena.mjcf_model.worldbody.add("site", name="mount", pos=[0, 0, 0.1])
        )
        self.plate = self.arena.mjcf_model.worldbody.add("body", name="plate", mocap=True, pos=[0, 0, -1])
        self.plate.add("geom", name="plate", type="box", size=[0.03, 0.01, 0.03])
        self.set_timesteps(0.01, 0.005)

    root_entity = property(lambda self: self.arena)

    def get_reward(self, physics):
        return 0.0

    def before_step(self, physics, action, random_state):
        time = min(physics.data.time / 0.1, 1.0)
        physics.data.mocap_pos[0] = [0, -8.3e-3 - 0.01 + time * self.depth, 0.1]


def environment(task, **settings):
    options = dict(
        random_state=0,
        recompile_mjcf_every_episode=False,
        strip_singleton_obs_buffer_dim=True,
        legacy_step=False,
    )
    return composer.Environment(task, **options | settings)


def test_presets_have_their_shapes_and_patches_their_place():
    """TACTILE and PRIVILEGED have the documented shapes; force and patch say where a plate presses: from the
    pad, along +y."""
    task = PlateTask(0.6e-3, noise=False)
    task.entity.observables.enable(TACTILE + PRIVILEGED)
    env = environment(task)
    step = env.reset()
    nouter = len(task.entity.outer)
    shapes = {"electrodes": (19,), "pac": (22,), "pdc": (1,), "tac": (1,), "tdc": (1,)}
    shapes |= {"contact_force": (6,), "contact_patch": (6,), "skin": (nouter, 3)}
    assert {name: step.observation[f"biotac/{name}"].shape for name in shapes} == shapes
    assert not step.observation["biotac/contact_patch"].any()
    for _ in range(15):
        step = env.step(np.zeros(0))
    force, patch, skin = (
        step.observation[f"biotac/{name}"] for name in ("contact_force", "contact_patch", "skin")
    )
    assert force[1] > 0.3 and force[1] > 5 * np.abs(force[[0, 2]]).max()
    np.testing.assert_allclose(patch[3:], -force[:3] / np.linalg.norm(force[:3]))
    # the plate's face has come to y = -8.3 + 0.6 mm, so the touching skin lies there
    assert (
        patch[1] == pytest.approx(-7.7e-3, abs=0.25e-3)
        and -0.018 < patch[0] < 0.006
        and abs(patch[2]) < 1.5e-3
    )
    assert skin[:, 1].min() == pytest.approx(-7.7e-3, abs=0.05e-3)  # nothing is behind the plate's face
    task.entity.observables.enable(("pdc",))
    assert list(environment(task).reset().observation) == ["biotac/pdc"]


def test_place_and_force_are_estimated_from_electrodes():
    """By the formula of drivers: nothing before a plate presses, then at the pad, along +y; a third of the
    force at least, and noise in it."""
    task = PlateTask(1.2e-3)
    task.entity.observables.enable((*ESTIMATED, "contact_force"))
    env = environment(task)
    step = env.reset()
    assert not step.observation["biotac/contact_estimate"].any()
    found = []
    for _ in range(15):
        step = env.step(np.zeros(0))
        found.append(step.observation["biotac/contact_estimate"])
    place, push = found[-1][:3], found[-1][3:]
    force = step.observation["biotac/contact_force"]
    assert place[1] < -5e-3 and -0.018 < place[0] < 0.006 and abs(place[2]) < 2e-3
    assert push[1] > 4 * np.abs(push[[0, 2]]).max() and 1 / 3 < push[1] / force[1] < 3
    assert np.ptp(found[-5:], axis=0)[4] > 0
    assert (
        "finger/biotac/contact_estimate"
        in load("finger", "press", {"observe": "estimated"}).reset().observation
    )


def test_delay_noise_and_rate_belong_to_the_observable():
    task = PlateTask(0.6e-3)
    observables = task.entity.observables
    observables.enable(("electrodes", "pdc", "contact_force"))
    observables.contact_force.rate, observables.contact_force.lag = 1000.0, 0.03
    observables.pdc.noise, observables.pdc.rate = None, 25.0
    env = environment(task)
    env.reset()
    assert (observables.electrodes.update_interval, observables.electrodes.delay) == (2, 0)  # 100 Hz at 5 ms
    assert (observables.contact_force.update_interval, observables.contact_force.delay) == (1, 6)
    truth, seen, pdc, counts = [], [], [], []
    for _ in range(20):
        step = env.step(np.zeros(0))
        truth.append(task.entity.read(env.physics, "contact_force")[1])
        seen.append(step.observation["biotac/contact_force"][1])
        pdc.append(step.observation["biotac/pdc"][0])
        counts.append(step.observation["biotac/electrodes"])
    np.testing.assert_allclose(seen[4:], truth[1:-3])  # 30 ms are three control steps
    changes = np.flatnonzero(np.diff(pdc[3:18]))
    assert len(changes) and (np.diff(changes) >= 4).all()  # every 40 ms
    counts = np.array(counts)
    assert (counts == counts.round()).all() and counts.min() >= 0 and counts.max() <= 4095
    assert np.diff(counts[-5:], axis=0).any()  # noise, though the plate is still


def test_an_entity_takes_readings_as_attach_does_without_noise():
    """Noise is the observables', whichever place says otherwise."""
    told = {"film_every_step": True, "noise": True}
    one, other = (
        BioTac(**settings).handle.config for settings in ({"readings": told}, {"options": {"readings": told}})
    )
    assert one == other and one.options["readings"] == told | {"noise": False}


def test_entity_attaches_to_any_site_and_twice():
    arena = composer.Arena()
    for name in ("left", "right"):
        arena.attach(
            BioTac(name=name),
            arena.mjcf_model.worldbody.add("site", name=f"at_{name}", pos=[0.1 * (name == "left"), 0, 0]),
        )
    physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
    assert physics.model.nplugin == 2
    assert (
        physics.model.name2id("left/electrodes", "sensor") >= 0
        and physics.model.name2id("right/core", "body") >= 0
    )


def test_handles_of_an_environment():
    """With the models and data that dm_control wraps, or MuJoCo's own."""
    env = load("gripper", "hold")
    env.reset()
    physics = env.physics
    found = biotac_mj.handles(physics.model)
    assert list(found) == ["gripper/biotac_0/", "gripper/biotac_1/"]
    for handle, finger in zip(found.values(), env.task.biotacs):
        read, own = handle.read(physics.data), finger.read(physics)
        assert list(read) == list(own) and all((read[name] == own[name]).all() for name in read)
        with pytest.raises(ValueError, match="no channel 'e1'"):
            finger.read(physics, "e1")
        for model, data in ((physics.model, physics.data), (physics.model.ptr, physics.data.ptr)):
            assert (handle.vert_xpos(model, data) == finger.vert_xpos(physics)).all()
    env.close()


class Props(biotac_mj.tasks.Copyable, composer.Environment):
    """A BioTac on a site, and balls that are added after it."""

    def __init__(self, balls, seed=0, **biotac):
        arena = composer.Arena()
        self.finger = BioTac(noise=False, **biotac)
        arena.attach(self.finger, arena.mjcf_model.worldbody.add("site", name="mount", quat=[1, -1, 0, 0]))
        for i in range(balls):
            ball = arena.mjcf_model.worldbody.add("body", name=f"ball{i}", pos=[-0.01, 0.1 * i, 0.0135])
            ball.add("joint", type="slide", axis=[0, 0, 1])
            ball.add("geom", size=[5e-3], mass=0.02)
        super().__init__(composer.NullTask(arena), random_state=seed)


def test_props_after_the_robot_are_asked_for_by_number():
    with pytest.raises(ValueError, match="2 bodies can touch .* give slots=2 to attach or tasks.BioTac"):
        Props(2, slots=1)
    Props(2, slots=2).close()
    Props(12).close()  # of themselves there is room for 64


@pytest.mark.parametrize("again", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_an_environment_of_ones_own_is_copied(again):
    """In the middle of an episode, and through the next reset, which compiles anew."""
    env = Props(1, seed=3)
    env.reset()
    for _ in range(20):
        env.step([])
    made = again(env)
    assert type(made) is Props and made.physics.time() == env.physics.time() > 0
    for _ in range(2):
        for _ in range(10):
            env.step([]), made.step([])
        a, b = (one.finger.read(one.physics) for one in (env, made))
        assert all((a[name] == b[name]).all() for name in a) and a["contact_force"].any()
        assert (env.physics.data.qpos == made.physics.data.qpos).all()
        env.reset(), made.reset()
    env.close(), made.close()


def test_an_environment_that_was_given_its_task_says_so():
    class Given(biotac_mj.tasks.Copyable, composer.Environment):
        pass

    env = Given(composer.NullTask(composer.Arena()))
    with pytest.raises(TypeError, match="Given was given its task: only one that it makes is copied"):
        copy.deepcopy(env)
    env.close()


def test_estimator_recovers_a_map_and_names_its_error():
    """Exact on a map that is linear in touch and quadratic in its shape; the reported error is that of
    episodes it has not seen."""
    rng = np.random.RandomState(0)
    x = rng.standard_normal((2000, 20))
    shape = 10 * x / (np.abs(x).sum(axis=1, keepdims=True) + 1)
    truth = np.stack([1 + 2 * x[:, 3] - shape[:, 0] * shape[:, 5], shape[:, 19] ** 2 - x[:, 7]], axis=1)
    episode = np.repeat(range(8), 250)
    fit = fit_estimator(x, truth, episode)
    np.testing.assert_allclose(fit(x[:5]), truth[:5], atol=2e-3)
    noisy = fit_estimator(x, truth + 0.3 * rng.standard_normal(truth.shape), episode)
    np.testing.assert_allclose(noisy.error, 0.3, rtol=0.15)
    with pytest.raises(ValueError, match="3 episodes: a fit needs four"):
        fit_estimator(x[:300], truth[:300], np.repeat(range(3), 100))


def test_every_estimator_says_what_it_was_fitted_on():
    """The package's estimators fit the tasks' own BioTac: no warning; the digest is one of the skin's
    content."""
    stored, config = touch.load_calibration(), BioTac().handle.config
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for controller in scripted.SCRIPTED.values():
            touch.check_fitted_on(controller().fit, stored, config)
            assert (
                touch.load_estimator(controller().fit).error.min() > 0
                if controller.task != "explore"
                else "explore/weight" in stored
            )
    assert touch.fitted_on(config) == touch.fitted_on(BioTac(name="other", slots=3, seed=5).handle.config)
    assert touch.fitted_on(config)["skin"] != touch.fitted_on(BioTac(skin="default").handle.config)["skin"]


@pytest.mark.parametrize(
    "settings, text",
    [
        (
            {"tier": "full"},
            r"'press' was fitted on a BioTac with tier 'condensed' \(here 'full'\).*--estimators press "
            r"--skin SKIN",
        ),
        ({"material": "rubber"}, r"with material 'default' \(here 'rubber'\)"),
        ({"skin": "default"}, r"with skin '\w{16}' \(here '\w{16}'\)"),
        ({"liquid": False}, r"liquid True \(here False\).*calibration=FILE"),
    ],
)
def test_a_controller_warns_of_another_biotac(settings, text):
    class Environment:  # as much of one as is looked at
        class task:
            biotacs = [BioTac(**settings)]

    with pytest.warns(touch.CalibrationWarning, match=text):
        scripted.make_controller("press", Environment)


def test_a_calibration_of_ones_own(tmp_path):
    """An estimator from a file, which does not say what it was fitted on."""
    own = dict(touch.load_calibration())
    own["press/weight"] = 0 * own["press/weight"]
    del own["press/fitted_on"]
    path = tmp_path / "own.npz"
    np.savez(path, **own)

    class Environment:
        class task:
            biotacs = [BioTac()]

    with pytest.warns(touch.CalibrationWarning, match="tier 'unknown'"):
        controller = scripted.make_controller("press", Environment, calibration=path)
    controller.reset()
    observation = {"a/electrodes": REST_COUNTS["1"], "a/pdc": np.array([2100.0]), "target": np.ones(1)}
    for _ in range(6):
        controller.act(observation)
    assert not controller.estimator(np.ones((1, 20))).any()


def test_touch_is_tared():
    reader, rng = touch.Touch(), np.random.RandomState(0)
    rest = {"a/electrodes": REST_COUNTS["2"], "a/pdc": np.array([2100.0])}
    for _ in range(5):
        assert not reader.update({k: v + rng.uniform(-2, 2, v.shape) for k, v in rest.items()}).any()
    assert reader.tared
    for _ in range(8):
        felt = reader.update({"a/electrodes": REST_COUNTS["2"] + 100, "a/pdc": np.array([2300.0])})
    assert felt.shape == (1, 20) and (felt[0, :19] < -0.5).all()  # counts rise where ln Z falls
    assert felt[0, 19] == pytest.approx(2.0, abs=0.05)
    with pytest.raises(
        ValueError, match="no electrodes in the observation: load the task with observe='tactile'"
    ):
        reader.update({"position": np.zeros(3)})


@pytest.mark.parametrize("domain, task", A_FEW)
def test_dm_controls_action_scale(domain, task):
    """As for a task of dm_control.suite: scaled bounds, and the same motion for the same share of them."""
    from dm_control.suite.wrappers import action_scale

    plain = load(domain, task, task_kwargs={"random": 0})
    scaled = action_scale.Wrapper(load(domain, task, task_kwargs={"random": 0}), minimum=-10.0, maximum=10.0)
    assert (scaled.action_spec().minimum == -10.0).all() and (scaled.action_spec().maximum == 10.0).all()
    assert scaled.action_spec().shape == plain.action_spec().shape
    action = np.linspace(-0.9, 0.9, plain.action_spec().shape[0])
    moved = []
    for env, factor in ((plain, 1.0), (scaled, 10.0)):
        env.reset()
        before = env.task.machine.position(env.physics)
        for _ in range(3):
            env.step(factor * action)
        moved.append(env.task.machine.position(env.physics) - before)
    np.testing.assert_allclose(moved[0], moved[1], rtol=1e-9, atol=1e-12)
    assert np.abs(moved[0]).max() > 5e-5


@pytest.mark.parametrize("domain, task", A_FEW)
def test_dm_controls_viewer(domain, task):
    """The viewer's own runtime, without its window."""
    from dm_control.viewer import runtime

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        shown = runtime.Runtime(environment=load(domain, task, task_kwargs={"random": 0}), policy=None)
    shown.tick(0.05, paused=False)
    shown.tick(0.05, paused=False)
    assert shown.get_time() > 0


_PIXELS = """
from dm_control.suite.wrappers import pixels
from biotac_mj.tasks import load, suite
for domain, task in suite.tasks():
    size = {"height": 48, "width": 64}
    env = pixels.Wrapper(load(domain, task, task_kwargs={"random": 0}), render_kwargs=size)
    picture = env.reset().observation["pixels"]
    assert picture.shape == (48, 64, 3) == env.observation_spec()["pixels"].shape, task
    assert picture.std() > 5, (task, picture)
size = {"height": 48, "width": 64, "camera_id": "side"}
env = pixels.Wrapper(load("finger", "press", task_kwargs={"random": 0}), render_kwargs=size)
picture = env.reset().observation["pixels"]
assert picture.shape == (48, 64, 3) == env.observation_spec()["pixels"].shape and picture.std() > 5, picture
beside = pixels.Wrapper(env._env, pixels_only=False, render_kwargs=size)
assert set(beside.reset().observation) > {"pixels", "position", "target"}
"""


@pytest.mark.slow
def test_dm_controls_pixels():
    """In a process of its own: dm_control chooses its renderer when it is imported."""
    from biotac_mj.view.offscreen import find_gl

    gl = find_gl()
    if gl not in ("egl", "osmesa"):
        pytest.skip("no GL library to render pixels with: install libosmesa6 or EGL")
    environ = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"} | {
        "MUJOCO_GL": gl
    }
    done = subprocess.run(
        [sys.executable, "-c", _PIXELS], env=environ, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr


def test_example_puts_it_on_an_existing_model(repo, capsys):
    """The arm comes to rest on the table: the fingertip carries its 50 g and the BioTac's own 3.965 g."""
    from test_examples import load as load_example

    force, step = load_example(repo, "existing_model").main()
    assert force[1] == pytest.approx((0.05 + 0.003965) * 9.81, rel=0.01)
    assert (
        step.observation["biotac/electrodes"].shape == (19,)
        and "force on the fingertip" in capsys.readouterr().out
    )


def test_an_entity_takes_settings_by_stage():
    """Its own defaults are those of no settings at all."""
    stages = {"skin": {"mesh": "coarse", "tier": "condensed"}, "seed": 3, "on_error": "raise"}
    by_stage, by_name = BioTac(settings=stages).handle.config, BioTac(seed=3).handle.config
    assert by_stage == by_name and not by_stage.options["readings"]["noise"]


@pytest.mark.parametrize(
    "call, text",
    [
        (lambda: load("arm", "press"), "no domain 'arm': choose one of finger, gripper"),
        (lambda: load("finger", "push"), "domain 'finger' has no task 'push': choose one of press"),
        (
            lambda: load("finger", "press", task_kwargs={"observe": "touch"}),
            "unknown preset of observe 'touch': choose one of tactile",
        ),
        (
            lambda: load("gripper", "hold", task_kwargs={"observ": "none"}),
            "task_kwargs of Hold has 'observ': did you mean 'observe'? choose from observe, "
            "physics_timestep, biotac, random, time_limit",
        ),
        (
            lambda: load("finger", "explore", task_kwargs={"object": ["box"]}),
            "task_kwargs of Explore has 'object': did you mean 'objects'? choose from objects, observe",
        ),
        (
            lambda: load("finger", "explore", task_kwargs={"objects": ["peg"]}),
            "no object 'peg': choose one of sphere_3-5mm",
        ),
        (lambda: BioTac(site="tip"), "BioTac got site='tip': an Entity is placed with robot.attach"),
        (lambda: BioTac(tier="fast"), "unknown tier 'fast': choose one of full, condensed"),
        (
            lambda: scripted.make_controller("juggle"),
            "no scripted controller for task 'juggle': there are press",
        ),
        (
            lambda: touch.load_estimator("juggle"),
            "no calibration of task 'juggle': run `python scripts/fit_estimators.py --estimators juggle`",
        ),
    ],
)
def test_bad_input_is_refused(call, text):
    with pytest.raises(ValueError) as caught:
        call()
    assert text in str(caught.value)


def test_scores_of_several_files_make_one_table(repo, tmp_path, monkeypatch, capsys):
    """A task that was run again counts from the last file; what is printed are means over its seeds."""
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    import importlib

    benchmark = importlib.import_module("tasks")

    def row(task, seed, score):
        return {
            "domain": "gripper",
            "task": task,
            "policy": "scripted",
            "seed": seed,
            "score": score,
            "last_second": score,
            "failed_steps": seed,
            "seconds": 2.0 + seed,
        }

    first, second = tmp_path / "first.json", tmp_path / "second.json"
    first.write_text(json.dumps({"rows": [row("hold", 0, 0.1), row("lift", 0, 0.5)]}))
    second.write_text(json.dumps({"rows": [row("hold", 0, 0.9), row("hold", 1, 0.7)]}))
    assert benchmark.main(["--markdown", str(first), str(second)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "| gripper/hold | 0.80 +- 0.10 | 50 % |  |  | 2, 0 | 2.5 | 1 |" in lines
    assert "| gripper/lift | 0.50 +- 0.00 | 0 % |  |  | 1, 0 | 2.0 | 0 |" in lines
    with pytest.raises(SystemExit):
        benchmark.main(["--tasks", "hold"])
    assert "--json FILE is missing" in capsys.readouterr().err


def test_an_unknown_observable_is_refused():
    with pytest.raises(ValueError, match="a BioTac has no observable 'e1': choose from electrodes, pac"):
        BioTac().observables.enable(("e1",))
