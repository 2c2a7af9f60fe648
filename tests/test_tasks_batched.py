"""The tasks in batches: what a policy gets, when episodes end, what the libraries are handed; that the truth
solves them and chance does not. The hand is MuJoCo Menagerie's."""

import copy
import dataclasses
import json
import os
import pathlib

import numpy as np
import pytest
from PIL import Image

torch = pytest.importorskip("torch", reason="needs torch: pip install biotac_mj[learning]")
pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")

# ruff: noqa: E402
import biotac_mj
from biotac_mj.cli import main
from biotac_mj.cli.names import TASKS as NAMES
from biotac_mj.tasks.batched import (
    OBSERVE,
    TASKS,
    FollowEdge,
    RollRod,
    TaskSettings,
    gymnasium_env,
    make,
    rsl_rl_env,
    skrl_env,
)
from biotac_mj.tasks.batched.playing import find_policy, interval, seen_by
from biotac_mj.tasks.batched.policy import Policy, load_policy, read_card, save_policy
from biotac_mj.tasks.batched.ppo import Learner, Lessons, Numbers
from biotac_mj.tasks.batched.roll_rod import Settings
from biotac_mj.tasks.batched.task import BatchTask
from biotac_mj.tasks.batched.touch import Touch
from biotac_mj.tasks.batched.training import of_runs, tier_errors, train
from biotac_mj.view.offscreen import find_gl
from biotac_mj.view.policy import _said

HAND = pathlib.Path(os.environ.get("MENAGERIE_ROOT", "mujoco_menagerie")) / "shadow_hand" / "right_hand.xml"
needs_hand = pytest.mark.skipif(not HAND.is_file(), reason="set MENAGERIE_ROOT to a folder with shadow_hand")


def test_a_hand_that_is_not_there_or_another_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="shadow_hand/right_hand.xml of MuJoCo Menagerie"):
        RollRod(tmp_path / "none.xml")
    other = tmp_path / "other.xml"
    other.write_text(
        "<mujoco><worldbody><body><joint name='a'/><geom size='.01'/></body></worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match="has no joint"):
        RollRod(other)


def test_a_choice_that_is_none_is_named():
    with pytest.raises(ValueError, match="choose one of none, binary, force, electrodes"):
        make("follow_edge", 1, observe="smell")
    with pytest.raises(ValueError, match="choose one of roll_rod, insert_peg, follow_edge"):
        make("juggle", 1)


def play(env, act):
    """An episode from the first decision: successes (num_envs,), and the last observations and forces before
    its end."""
    env.reset(seed=3)
    success = torch.zeros(env.num_envs, dtype=torch.bool)
    over = success.clone()
    for _ in range(env.max_episode_length):
        seen, force = {name: env.observe(name)["touch"] for name in OBSERVE}, env.force.clone()
        _, _, terminated, truncated, extras = env.step(act(env))
        success |= extras["success"] & ~over
        over |= terminated | truncated
    return success, seen, force


def drawn(seed):
    draw = torch.Generator().manual_seed(seed)
    return lambda env: 2 * torch.rand(env.num_envs, env.num_actions, generator=draw) - 1


@pytest.mark.slow
@pytest.mark.parametrize("task", ["follow_edge", "insert_peg", "roll_rod"])
def test_the_truth_solves_a_task_and_chance_does_not(task):
    if task == "roll_rod" and not HAND.is_file():
        pytest.skip("set MENAGERIE_ROOT to a folder with shadow_hand")
    env = make(
        task, 6, device="cpu", seed=1, sensor="random", **({"hand": HAND} if task == "roll_rod" else {})
    )
    success, seen, force = play(env, lambda env: env.script())
    assert success.float().mean() > 0.8
    fingers = len(env.batches)
    widths = {name: touch.shape[1] // fingers for name, touch in seen.items()}
    assert list(widths.values()) == [0, 1, 6, 20, 42, 20]
    assert seen["binary"].all()  # all fingers touch in the end
    # the drivers' formula tells a firm grip, also of sensors whose gains are their own; a rim lets few
    # electrodes fall
    if task == "insert_peg":
        told = seen["force"].unflatten(1, (fingers, 6))[..., :3].norm(dim=2)
        assert (told / force).min() > 0.3 and (told / force).max() < 3.0
    assert play(env, drawn(0))[0].float().mean() < 0.4


def test_an_observation_has_the_last_decisions():
    """The newest first; an episode that has just begun repeats its first."""
    settings = dataclasses.replace(FollowEdge.settings, substeps=1, decisions=4)
    env = make("follow_edge", 2, device="cpu", settings=settings, history=3)

    def split(observations):
        body, touch = observations["body"].unflatten(1, (3, 13)), observations["touch"].unflatten(1, (3, 20))
        return torch.cat([body, touch], dim=2).unbind(1)

    seen = [split(env.reset(seed=0)[0])]
    for _ in range(4):
        seen.append(split(env.step(torch.ones(2, 4))[0]))
    for begun in (seen[0], seen[4]):
        assert torch.equal(begun[0], begun[1]) and torch.equal(begun[0], begun[2])
    for before, now in zip(seen[:3], seen[1:4], strict=True):
        assert torch.equal(now[1], before[0]) and torch.equal(now[2], before[1])
        assert not torch.equal(now[0], before[0])
    with pytest.raises(ValueError, match="history"):
        make("follow_edge", 1, device="cpu", history=0)


def test_the_engine_runs_on_the_device_of_the_task(monkeypatch):
    """mujoco_warp launches on Warp's default device, which may be another."""
    import mujoco_warp
    import warp

    entered, called = [], []

    class Scope(warp.ScopedDevice):
        def __enter__(self):
            entered.append(self.device)
            return super().__enter__()

        def __exit__(self, *raised):
            entered.pop()
            return super().__exit__(*raised)

    def watched(name, function):
        def call(m, d, *rest):
            called.append(name)
            assert entered and entered[-1] == d.qpos.device, f"{name} outside of the task's device"
            return function(m, d, *rest)

        return call

    monkeypatch.setattr(warp, "ScopedDevice", Scope)
    for name in ("reset_data", "step"):
        monkeypatch.setattr(mujoco_warp, name, watched(name, getattr(mujoco_warp, name)))
    env = make("follow_edge", 1, device="cpu", settings=dataclasses.replace(FollowEdge.settings, substeps=1))
    env.reset()
    env.step(torch.zeros(1, 4))
    assert set(called) == {"reset_data", "step"}


def test_errors_of_the_model_differ_between_episodes():
    """Of all electrodes of a finger, of each one, of PDC, of PAC; an electrode that does not change has as
    large an error as the others."""
    settings = dataclasses.replace(FollowEdge.settings, substeps=1, decisions=2)
    env = make("follow_edge", 3, observe="electrodes+pac", settings=settings, device="cpu", model_error=0.1)

    def felt():
        """(3, 42) of changes of 100 counts in all channels."""
        env.step(torch.zeros(3, 4))
        env.sensordata[:, env._touch._place] = env.rest_counts + 100.0
        env._sense()
        return env.observe()["touch"]

    seen = felt()
    electrodes, pdc, pac = seen.split([19, 1, 22], dim=1)
    assert torch.allclose(pac, pac[:, :1].expand_as(pac), rtol=1e-5)
    assert len(pdc.unique()) == len(pac[:, 0].unique()) == 3 and len(electrodes.unique()) == 57
    assert 0.05 < electrodes.std() < 0.3 and abs(seen.mean() - 1) < 0.2
    changes, errors = torch.zeros(1, 1, 42), torch.zeros(1, 1, 22)
    changes[..., :19:2], errors[..., 3:] = 100.0, torch.linspace(-0.1, 0.1, 19)
    off = env._touch.with_errors(changes, errors) - changes
    np.testing.assert_allclose(off[0, 0, :19], 100 * (10 / 19) ** 0.5 * errors[0, 0, 3:], atol=1e-4)
    assert not off[..., 19:].any()
    env.reset()
    assert not torch.isclose(felt(), seen).any()  # another episode
    env.model_error = (0.0, 0.1, 0.0)
    env.reset()
    electrodes, pdc, pac = felt().split([19, 1, 22], dim=1)
    for part in (electrodes, pac):
        assert torch.allclose(part, torch.ones_like(part), atol=1e-5)
    assert len(pdc.unique()) == 3
    for wrong in (-0.1, (0.1, 0.1), "much"):
        with pytest.raises(ValueError, match="model_error"):
            make("follow_edge", 1, device="cpu", model_error=wrong)


def test_a_lesson_is_sensed_anew():
    """With other noise of the encoders, the same where a young episode repeats its first decision, and other
    errors of the model, which stay; without both as a policy saw it."""
    settings = dataclasses.replace(FollowEdge.settings, substeps=1, encoder=1e-3)
    env = make("follow_edge", 2, settings=settings, device="cpu", history=4, model_error=(0.0, 0.1, 0.0))
    for _ in range(2):
        env.step(torch.ones(2, 4))
    sensed = {name: value.repeat(200, *[1] * (value.ndim - 1)) for name, value in env.sensed().items()}
    sensed["changes"] = sensed["changes"] + 100.0
    body, touch = env.sense_anew("electrodes", **sensed).split([4 * 13, 4 * 20], dim=1)
    noise = body.unflatten(1, (4, 13)) - sensed["body"]
    np.testing.assert_allclose(noise[:, 3], noise[:, 2], atol=1e-5)
    assert not torch.isclose(noise[:, 1, :8], noise[:, 0, :8]).all(1).any() and not noise[..., 8:].any()
    deviation = 1e-3 * torch.tensor([100.0, 100.0, 100.0, 1.0])
    wanted = torch.cat([deviation, deviation / settings.timestep])
    np.testing.assert_allclose(noise[:, :3, :8].std((0, 1)), wanted, rtol=0.1)
    changes = touch.unflatten(1, (4, 20)) * 100
    np.testing.assert_allclose(changes[..., :19], sensed["changes"][:, :, 0, :19], atol=1e-3)
    gain = changes[..., 19] / sensed["changes"][:, :, 0, 19]
    np.testing.assert_allclose(gain.std(0), 0.1, rtol=0.15)
    assert torch.allclose(gain, gain[:, :1].expand_as(gain), rtol=1e-5)
    deviations = 0.0, 0.0, 0.0, 0.2  # in place of the environment's; the last of each electrode
    changes = env.sense_anew("electrodes", **sensed, model_error=deviations)[:, 4 * 13 :]
    changes = changes.unflatten(1, (4, 20))
    assert (changes[..., 19] * 100 - sensed["changes"][:, :, 0, 19]).abs().max() < 1e-3
    np.testing.assert_allclose(changes[..., :19].std(0) / changes[..., :19].mean(0), 0.2, rtol=0.2)
    env.model_error, env._blur = (0.0, 0.0, 0.0), 0.0 * env._blur
    env.reset()
    seen = env.observe()
    assert torch.equal(
        env.sense_anew("electrodes", **env.sensed()), torch.cat([seen["body"], seen["touch"]], 1)
    )


@needs_hand
def test_a_lesson_has_another_goal_and_what_is_done_for_it():
    """As the script would do in the same state, had the goal been that; in all its decisions."""
    settings = dataclasses.replace(Settings(), substeps=1, prepare=0)
    env = make("roll_rod", 2, hand=HAND, device="cpu", settings=settings, history=3)
    env.step(torch.ones(2, 6))
    first, before = env.script(), env._place_before.clone()
    sensed, wish = env.change_goal(env.sensed(), first)
    env._target = 1e-3 * sensed["body"][:, 0, -2]
    assert (env.target - env.cfg.target[0] >= 0).all() and (env.target <= env.cfg.target[1]).all()
    env._place_before[:] = torch.nan
    np.testing.assert_allclose(wish, env.script(), atol=1e-5)
    assert not torch.isclose(wish, first)[:, :3].any() and torch.equal(env._place_before, before)
    body = torch.cat(env._sense_body(0.0, 0.0), dim=1)
    np.testing.assert_allclose(sensed["body"][:, 0], body, atol=1e-6)
    assert torch.equal(sensed["body"][..., -2], sensed["body"][:, :1, -2].expand(2, 3))


def test_a_lesson_has_the_errors_of_a_tier_in_its_decisions():
    """Those of a random episode, of the same decisions, times a factor; a share of the RMS of their kind."""
    settings = dataclasses.replace(FollowEdge.settings, substeps=1)
    env = make("follow_edge", 2, settings=settings, device="cpu", history=4)
    for _ in range(2):
        env.step(torch.ones(2, 4))
    sensed = {name: value.repeat(200, *[1] * (value.ndim - 1)) for name, value in env.sensed().items()}
    sensed["changes"] = 100.0 + 0.0 * sensed["changes"]
    measured = torch.zeros(4, 1, 1, 42)
    measured[..., :20] = torch.tensor([0.1, 0.2, -0.4, 9.0]).view(4, 1, 1, 1)
    env._blur = 0.0
    seen = env.sense_anew("electrodes", **sensed, measured=measured)[:, 4 * 13 :].unflatten(1, (4, 20)) - 1
    assert torch.allclose(seen, seen[..., :1].expand_as(seen), atol=1e-5)
    factor = seen[:, 0, 0] / -0.4
    for k, off in enumerate((-0.4, 0.2, 0.1, 0.1)):  # the first decision is repeated
        np.testing.assert_allclose(seen[:, k, 0], off * factor, atol=1e-5)
    assert abs(factor.mean() - 0.5) < 0.15 and abs(factor.std() - 0.7) < 0.15


def test_errors_of_a_tier_are_those_of_the_same_episodes():
    """None between two of the same; a tenth less is a tenth of what is there, as a share of its RMS."""
    settings = dataclasses.replace(FollowEdge.settings, substeps=1, decisions=3)
    env, other = (make("follow_edge", 2, device="cpu", settings=settings, sensor="random") for _ in range(2))
    for one in (env, other):
        one.prepare_held, one.good = lambda seed: None, torch.arange(2)
    assert not tier_errors(env, other).any()
    here = []
    env.sensed = lambda: here.append(BatchTask.sensed(env)["changes"]) or {"changes": here[-1]}
    other.sensed = lambda: {"changes": 0.9 * BatchTask.sensed(other)["changes"]}
    found = tier_errors(env, other)
    wanted = torch.stack([-0.1 * c[:, 0] / (env._touch.rms(c[:, 0]) + 5.0) for c in here])
    assert found.shape == (3, 2, 1, 42) and wanted.abs().max() > 1e-3
    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_lessons_lack_electrodes_in_all_their_decisions():
    """As many of each finger, others in each lesson; PDC and PAC are there. Without a number all are."""
    touch = Touch.__new__(Touch)
    touch._split = [19, 1, 22]
    changes = 1.0 + torch.rand(300, 4, 2, 42)
    out = touch.without(changes, 2, torch.Generator().manual_seed(0))
    assert torch.equal(out[..., 19:], changes[..., 19:])
    gone = out[..., :19] == 0
    assert (gone.sum(-1) == 2).all() and torch.equal(gone, gone[:, :1].expand_as(gone))
    assert torch.equal(out[..., :19][~gone], changes[..., :19][~gone])
    often = gone[:, 0].float().mean(0)
    assert 0.04 < often.min() and often.max() < 0.18 and not torch.equal(gone[:, 0, 0], gone[:, 0, 1])


def test_electrodes_of_a_finger_have_one_scale():
    """So that those that hardly change count little, as in counts; what is not alike has its own."""
    settings = dataclasses.replace(FollowEdge.settings, substeps=1)
    env = make("follow_edge", 2, device="cpu", settings=settings, history=2)
    for observe in OBSERVE[:-1]:
        assert len(env.alike(observe)) == seen_by(env, observe).shape[1]
    alike = env.alike("electrodes")
    assert len(alike[:26].unique()) == 26 and not set(alike[:26].tolist()) & set(alike[26:].tolist())
    assert torch.equal(alike[26:46], alike[46:]) and len(alike[26:46].unique()) == 2
    torch.manual_seed(0)
    seen = torch.randn(50, len(alike)) * torch.rand(len(alike)) + 3.0
    at_once, in_parts = Policy(len(alike), 1), Policy(len(alike), 1)
    at_once.update_statistics(seen, alike)
    for part in (seen[:20], seen[20:]):
        in_parts.update_statistics(part, alike)
    for policy in (at_once, in_parts):
        variance = policy.square - policy.mean.square()
        wanted = torch.stack([seen.var(0, correction=0)[alike == k].mean() for k in alike])
        np.testing.assert_allclose(variance, wanted, rtol=1e-2, atol=1e-4)


def test_sensors_in_learning_have_their_own_gain_of_pdc():
    env = of_runs("follow_edge", [("electrodes", 0)], 4, "cpu")
    acquired = next(iter(env.batches.values())).senses.acquisition
    first = acquired.state.numpy()[:, acquired.place.pdc_gain].copy()
    assert len(np.unique(first)) == 4 and 0.02 < first.std() < 0.5 and min(env.model_error) > 0
    env.reset()
    assert (acquired.state.numpy()[:, acquired.place.pdc_gain] != first).all()  # of another sensor


def test_libraries_get_what_they_ask_for():
    pytest.importorskip("gymnasium")
    env = make("follow_edge", 2, device="cpu")
    assert {k: v.shape[1] for k, v in env.observe().items()} == {"body": 13, "touch": 20, "state": 4}
    with pytest.raises(ValueError, match="pass \\(2, 4\\)"):
        env.step(torch.zeros(2, 3))
    other = skrl_env(env)
    assert other.single_observation_space["policy"].shape == (33,)
    observations, _ = other.reset(seed=0)
    assert observations["policy"].shape == (2, 33)
    assert other.step(torch.zeros(2, 4))[0]["policy"].shape == (2, 33)
    vector = gymnasium_env(env)
    seen, _ = vector.reset(seed=0)
    assert vector.observation_space.contains(seen) and not seen[:, 13:].any()
    seen, reward, ended, over, told = vector.step(vector.action_space.sample())
    assert vector.observation_space.contains(seen) and reward.shape == ended.shape == over.shape == (2,)
    assert told["success"].shape == (2,) and "final_obs" not in told
    with pytest.raises(ValueError, match="all worlds are reset"):
        vector.reset(options={"reset_mask": [True, False]})
    for one in (env, vector, other):
        with pytest.raises(TypeError, match="make another"):
            copy.deepcopy(one)
    pytest.importorskip("rsl_rl", reason="needs RSL-RL: pip install rsl-rl-lib")
    worlds = rsl_rl_env(env)
    observations, reward, done, extras = worlds.step(torch.zeros(2, 4))
    assert observations["touch"].shape == (2, 20) and reward.shape == done.shape == (2,)
    assert done.dtype == torch.long and "time_outs" in extras


def test_gymnasium_gets_the_last_observation_of_an_episode():
    """Beside the first of the next, of worlds that ended alone, as its own vector environments give it."""
    pytest.importorskip("gymnasium")
    settings = dataclasses.replace(FollowEdge.settings, substeps=1, decisions=3, encoder=0.0)
    env = make("follow_edge", 2, device="cpu", settings=settings)
    vector = gymnasium_env(env)
    vector.reset(seed=0)
    env.episode_length_buf[1] = 1
    for _ in range(2):
        seen, _, _, over, told = vector.step(np.ones((2, 4), np.float32))
    assert over.tolist() == told["_final_obs"].tolist() == told["_final_info"].tolist() == [False, True]
    last = told["final_obs"]
    assert last[0] is None and last[1].shape == seen[1].shape
    np.testing.assert_allclose(last[1][8:12], seen[0][8:12])  # goals of the actions, alike in both
    assert not seen[1][8:12].any() and seen[0][8:12].all()
    final = told["final_info"]
    assert final["error"][1] == told["error"][1] and final["_error"].tolist() == [False, True]
    assert {n: final[n].dtype for n in ("success", "error")} == {"success": bool, "error": np.float32}


def test_learned_touch_needs_sensors_with_a_network():
    env = make("follow_edge", 1, device="cpu")
    with pytest.raises(ValueError, match="observe is 'learned': .*observe='learned'"):
        env.observe("learned")
    with pytest.raises(ValueError, match="observe is 'learned': .*without signal="):
        make("follow_edge", 1, device="cpu", observe="learned", signal="physics")


def test_a_seed_repeats_an_episode_with_its_random_sensor():
    env = make("follow_edge", 2, device="cpu", sensor="random")
    touch = []
    for seed in (3, 4, 3):
        env.reset(seed=seed)
        touch.append([env.step(torch.zeros(2, 4))[0]["touch"].clone() for _ in range(3)])
    first, other, again = (torch.stack(one) for one in touch)
    assert torch.equal(first, again) and not torch.equal(first, other)


def learn_a_line(learner, updates, lessons=None):
    """Paid is an action that is minus half of what is seen, and next to it nothing; a teacher says so. How
    far the policy is from that line in the end."""
    draw = torch.Generator().manual_seed(0)
    learner.update_statistics(*2 * [torch.randn(512, 1, generator=draw)])
    for _ in range(updates):
        for _ in range(4):
            seen = torch.randn(128, 1, generator=draw)
            action = learner.act(seen, seen)
            paid = -(action + 0.5 * seen).square()[:, 0]
            learner.record(paid, torch.ones(128, dtype=torch.bool), torch.zeros(128, dtype=torch.bool))
            if lessons:
                lessons.add({"seen": seen}, -0.5 * seen)
        learner.update(seen, lessons is None)
        for _ in range(20 if lessons else 0):
            sensed, taught = lessons.draw(128)
            learner.imitate(sensed["seen"], taught)
    seen = torch.linspace(-2, 2, 41)[:, None]
    with torch.no_grad():
        return float((learner.policy(seen) + 0.5 * seen).abs().max())


def test_a_learner_finds_what_is_paid():
    numbers = Numbers(steps=4, gamma=0.0, divergence=0.03)
    learner = Learner(1, 1, 1, 0, "cpu", numbers)
    assert learn_a_line(learner, 30) < 0.15 and learner.policy.explore.max() < 0.4


def test_a_teacher_is_followed_sooner_than_reward():
    """In a third of the updates."""
    numbers = Numbers(steps=4, gamma=0.0)
    alone = learn_a_line(Learner(1, 1, 1, 0, "cpu", numbers), 10)
    taught = learn_a_line(Learner(1, 1, 1, 0, "cpu", numbers), 10, Lessons(1000, 0, "cpu"))
    assert taught < 0.1 and taught < 0.5 * alone


def test_only_the_newest_lessons_are_remembered():
    """Four of size 4, of six that were given."""
    lessons = Lessons(4, 0, "cpu")
    for k in range(3):
        number = torch.tensor([[2.0 * k], [2.0 * k + 1]])
        lessons.add({"body": number, "changes": 10 * number}, -number)
    sensed, taught = lessons.draw(200)
    assert set(taught[:, 0].tolist()) == {-2.0, -3.0, -4.0, -5.0}
    for name, factor in (("body", 1), ("changes", 10)):
        np.testing.assert_array_equal(sensed[name], -factor * taught)


def test_a_policy_comes_back_from_its_file(tmp_path):
    torch.manual_seed(0)
    policy, path = Policy(3, 2), tmp_path / "policy.safetensors"
    policy.update_statistics(torch.randn(50, 3) * torch.tensor([1.0, 10.0, 100.0]))
    policy.layers.half().float()  # weights as a file has them
    save_policy(path, policy, {"task": "insert_peg", "success": 0.5})
    other, card = load_policy(path)
    seen = torch.randn(4, 3)
    assert torch.equal(policy(seen), other(seen)) and card == {"task": "insert_peg", "success": 0.5}
    path.write_bytes(b"no tensors")
    with pytest.raises(ValueError, match="is no policy .*batched.training"):
        load_policy(path)
    with pytest.raises(FileNotFoundError, match="no policy at"):
        load_policy(tmp_path / "none.safetensors")


@pytest.mark.parametrize(
    "task, name, observe, actions",
    [
        ("roll_rod", None, "electrodes+pac", 6),
        ("roll_rod", "electrodes", "electrodes", 6),
        ("insert_peg", None, "electrodes", 3),
        ("follow_edge", None, "electrodes", 4),
    ],
)
def test_policies_that_ship_have_cards(task, name, observe, actions):
    """What they saw and how they did, of data that are called synthetic."""
    policy, card = load_policy(find_policy(task, name))
    assert card["task"] == task and card["data"] == "synthetic" and card["observe"] == observe
    assert 0 < card["low"] < card["success"] <= card["high"] <= 1 and card["episodes"] >= 64
    seen = torch.zeros(2, len(policy.mean))
    assert policy(seen).shape == (2, actions) and torch.isfinite(policy(seen)).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "task, name",
    [("roll_rod", None), ("roll_rod", "electrodes"), ("insert_peg", None), ("follow_edge", None)],
)
def test_policies_that_ship_do_as_their_cards_say(task, name, capsys):
    if task == "roll_rod" and not HAND.is_file():
        pytest.skip("needs MuJoCo Menagerie (set MENAGERIE_ROOT)")
    more = [*(["--policy", name] if name else []), *(["--hand", str(HAND)] if task == "roll_rod" else [])]
    assert main(["play", task, "--episodes", "8", "--json", *more]) == 0
    score = json.loads(capsys.readouterr().out)
    assert score["agrees"] and score["card"] == read_card(find_policy(task, name))


@pytest.mark.parametrize(
    "runs, minutes, told",
    [([("none", 0)], float("nan"), "nan minutes"), ([("none", 0), ("none", 0)], 1.0, "given twice")],
)
def test_what_cannot_be_learned_is_said(tmp_path, runs, minutes, told):
    with pytest.raises(ValueError, match=told):
        train(None, "follow_edge", runs, minutes, tmp_path)


@pytest.mark.slow
def test_a_policy_learns_and_is_played_as_its_card_says(tmp_path, capsys):
    settings = FollowEdge.settings
    settings = dataclasses.replace(settings, substeps=1, decisions=3)
    env = make("follow_edge", 4, device="cpu", settings=settings, sensor="random")
    runs = [("electrodes", 0), ("none", 1)]
    with pytest.raises(FileNotFoundError, match="leave out --resume"):
        train(env, "follow_edge", runs, 0.0, tmp_path, resume=True)
    cards = train(env, "follow_edge", runs, 0.01, tmp_path)
    assert [(c["observe"], c["seed"], c["episodes"]) for c in cards] == [("electrodes", 0, 2), ("none", 1, 2)]
    assert all(0 <= c["low"] <= c["success"] <= c["high"] <= 1 for c in cards)
    path = tmp_path / "follow_edge-none-1.safetensors"
    before = cards[0]["decisions"]
    again = train(env, "follow_edge", runs, 0.0, tmp_path, resume=True)
    assert again[0]["decisions"] == before > 0
    assert train(env, "follow_edge", runs, 0.01, tmp_path, resume=True)[0]["decisions"] > before
    cards = train(env, "follow_edge", runs, 0.0, tmp_path, resume=True)
    assert read_card(path) == json.loads(json.dumps(cards[1])) and cards[1]["decisions"] > 0
    capsys.readouterr()
    assert main(["play", "follow_edge", "--policy", str(path), "--episodes", "3", "--json"]) == 0
    score = json.loads(capsys.readouterr().out)
    assert score["episodes"] == 3 and score["card"] == read_card(path) and score["agrees"]
    assert score["card"]["settings"]["decisions"] == 3
    words = ["play", "follow_edge", "--policy", str(path), "--episodes", "3", "--json", "--tier", "condensed"]
    assert main(words) == 0  # a card says nothing of other settings
    score = json.loads(capsys.readouterr().out)
    assert score["biotac"] == {"tier": "condensed"} and score["agrees"] is None
    assert main([*words, "--skin", "nowhere"]) == 2 and "no skin at nowhere" in capsys.readouterr().err
    assert main(["play", "insert_peg", "--policy", str(path), "--episodes", "3"]) == 2
    assert "is a policy of follow_edge" in capsys.readouterr().err
    if find_gl():
        picture = tmp_path / "task.gif"
        assert main(["play", "follow_edge", "--policy", str(path), "--render", str(picture)]) == 0
        with Image.open(picture) as film:
            assert film.n_frames == 12 and film.size == (480, 540)  # four episodes


def test_a_score_says_what_else_would_agree_with_a_card():
    score = {"task": "roll_rod", "policy": "shipped", "agrees": True, "card": interval(86, 96)}
    said = _said(score | interval(12, 16))
    assert "0.75 (0.51 to 0.90) of 16 episodes; that agrees with its card: 0.90 (0.82 to 0.94) of 96" in said
    assert said.endswith("of 96, as 0.69 to 1.00 would in 16 episodes")
    assert interval(11, 16)["high"] >= interval(86, 96)["low"] > interval(10, 16)["high"]


def test_what_only_a_task_has_is_refused_elsewhere(capsys):
    assert main(["play", "follow_edge", "--hand", "hand.xml", "--episodes", "1"]) == 2
    assert "hand is not of follow_edge" in capsys.readouterr().err
    assert main(["play", "press.h5", "--episodes", "3"]) == 2
    said = "--episodes is of one task, and press.h5 is none: pass one of roll_rod, insert_peg"
    assert said in capsys.readouterr().err
    assert main(["play", "follow_edge", "--policy", "electrodes", "--episodes", "1"]) == 2
    assert "electrodes is a policy of roll_rod: play that" in capsys.readouterr().err
    with pytest.raises(FileNotFoundError, match="no policy of juggle comes .* give --policy script"):
        find_policy("juggle")


@pytest.mark.parametrize("more", [["--render", "x.gif"], ["--window"], ["--port", "8123"]])
def test_a_task_is_played_in_one_way(more, capsys):
    assert main(["play", "follow_edge", "--policy", "random", "--episodes", "1", *more]) == 2
    assert f"episodes and {more[0][2:]} exclude each other" in capsys.readouterr().err
    assert main(["play", "follow_edge", "--policy", "random", "--json", *more]) == 2
    assert "json is of scores: give episodes too" in capsys.readouterr().err


def test_settings_and_skin_of_others_are_no_tasks():
    for other in (biotac_mj.coupling.settings.Settings(), TaskSettings(), {"decisions": 3}):
        with pytest.raises(
            ValueError, match=r"settings are .*pass the task's, dataclasses.replace\(FollowEdge.settings"
        ):
            make("follow_edge", 1, device="cpu", settings=other)
    with pytest.raises(ValueError, match="skin is of a BioTac SP.*: .*leave it out"):
        make("follow_edge", 1, device="cpu", skin="biotac_sp/coarse")


def test_a_misspelt_keyword_is_answered_with_those_of_the_task():
    with pytest.raises(TypeError, match=r"has 'observes': did you mean 'observe'\? .*history.*sensor"):
        make("follow_edge", num_envs=2, observes="force")
    with pytest.raises(TypeError, match="has 'hands': did you mean 'hand'"):
        make("roll_rod", hands=None)
    assert tuple(TASKS) == NAMES


@needs_hand
@pytest.mark.slow
def test_fingers_that_only_close_hold_the_rod():
    env = RollRod(HAND, num_envs=2, device="cpu", settings=Settings(prepare=0, decisions=20, encoder=0.0))
    observations, _ = env.reset(seed=1)
    assert {k: tuple(v.shape) for k, v in observations.items()} == {
        "body": (2, 34),
        "touch": (2, 60),
        "state": (2, 5),
    }
    assert env.held.all() and not observations["touch"].any()
    rest = torch.zeros(2, 6)
    for k in range(env.max_episode_length):
        observations, reward, terminated, truncated, extras = env.step(rest)
        assert not terminated.any()
        if k == env.max_episode_length - 2:
            force, error = env.force, env.error
    assert truncated.all() and extras["time_outs"].all()
    assert (force > 0.1).all() and (force < 2.0).all()  # all three fingers feel it [N]
    # paid for being held, and for the place
    near = env.cfg.near
    np.testing.assert_allclose(reward, 0.2 + 1 / (1 + (extras["error"] / near) ** 2), rtol=1e-5)
    np.testing.assert_allclose(extras["error"], error, atol=2e-4)
    assert (env.episode_length_buf == 0).all() and not observations["touch"].any()


@pytest.mark.slow
def test_episodes_begin_with_the_peg_held_wherever_that_was():
    """A state goes to another world with all that skins and sensors remember: from there both do the same to
    the last bit, however the worlds were thrown about before."""
    env = make("insert_peg", 6, device="cpu", seed=2)
    observations, _ = env.reset(seed=0)
    assert len(env.good) == 6 and observations["touch"].abs().max() > 0.5  # it is touched already
    source = env.good
    generator = torch.Generator().manual_seed(0)
    actions = 2 * torch.rand(2, 6, 3, generator=generator) - 1
    order = torch.randperm(6, generator=generator)
    ways = []
    for which in (torch.arange(6), order):
        env._bank.give(torch.arange(6), source[which])
        way = []
        for action in actions:
            env._advance(env._moves(action[which]))
            way.append((env.qpos.clone(), env.sensordata.clone()))
        ways.append(way)
    for (qpos, sensed), (other, felt) in zip(*ways, strict=True):
        np.testing.assert_array_equal(qpos[order], other)
        np.testing.assert_array_equal(sensed[order], felt)
