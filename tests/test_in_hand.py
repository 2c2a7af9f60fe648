"""The task in the hand: what a policy gets, when episodes end, what the libraries are handed. The hand is
MuJoCo Menagerie's."""

import os
import pathlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch", reason="needs torch: pip install biotac_mj[learning]")
pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")

# ruff: noqa: E402
from biotac_mj.tasks.in_hand import RollRod, rsl_rl_env, skrl_env
from biotac_mj.tasks.in_hand.bank import Bank
from biotac_mj.tasks.in_hand.environment import Settings, rolled

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


def test_a_rod_is_rolled_about_its_own_axis():
    """By scipy's rotations: a turn about the rod's axis is what it is, also of a rod that leans, and a turn
    about another axis is none."""
    rng = np.random.default_rng(0)
    begun = Rotation.random(rng=rng)
    angle = rng.uniform(-3, 3, 20)
    tilt = Rotation.from_rotvec(np.column_stack([rng.uniform(-1, 1, (20, 2)), np.zeros(20)]))
    first = torch.tensor(begun.as_quat(scalar_first=True))
    for lean in (Rotation.identity(20), tilt):
        now = begun * lean * Rotation.from_rotvec(angle[:, None] * [0, 0, 1])
        quat = torch.tensor(now.as_quat(scalar_first=True))
        for sign in (1, -1):  # q and -q are one attitude
            np.testing.assert_allclose(rolled(first, sign * quat), angle, atol=1e-12)
    leaning = torch.tensor((begun * tilt).as_quat(scalar_first=True))
    np.testing.assert_allclose(rolled(first, leaning), 0.0, atol=1e-12)


@needs_hand
@pytest.mark.slow
def test_fingers_that_only_close_hold_the_rod():
    env = RollRod(HAND, num_envs=2, device="cpu")
    observations, _ = env.reset(seed=1)
    assert {k: tuple(v.shape) for k, v in observations.items()} == {
        "body": (2, 39),
        "touch": (2, 60),
        "state": (2, 6),
    }
    np.testing.assert_allclose(env.angle, 0.0, atol=1e-5)
    assert env.held.all() and not observations["touch"].any()
    with pytest.raises(ValueError, match="pass \\(2, 11\\)"):
        env.step(torch.zeros(2, 3))
    rest = torch.zeros(2, 11)
    for k in range(env.max_episode_length):
        observations, reward, terminated, truncated, extras = env.step(rest)
        assert not terminated.any()
        if k == env.max_episode_length - 2:
            force, error = env.force, (env.angle - env.target).abs()
    assert truncated.all() and extras["time_outs"].all()
    assert (force > 0.1).all() and (force < 2.0).all()  # all three fingers feel it [N]
    # paid for being held, and for the angle
    np.testing.assert_allclose(reward, 0.2 + torch.exp(-((extras["error"] / 0.1) ** 2)), rtol=1e-5)
    np.testing.assert_allclose(extras["error"], error, atol=5e-3)
    assert (env.episode_length_buf == 0).all() and not observations["touch"].any()


@needs_hand
@pytest.mark.slow
def test_libraries_get_what_they_ask_for():
    settings = Settings(substeps=1, decisions=3)
    env = RollRod(HAND, num_envs=2, device="cpu", settings=settings)
    for touch, width in ((True, 99), (False, 39)):
        pytest.importorskip("gymnasium")
        other = skrl_env(env, touch)
        assert other.single_observation_space["policy"].shape == (width,)
        observations, _ = other.reset(seed=0)
        assert observations["policy"].shape == (2, width)
        assert other.step(torch.zeros(2, 11))[0]["policy"].shape == (2, width)
    pytest.importorskip("rsl_rl", reason="needs RSL-RL: pip install rsl-rl-lib")
    worlds = rsl_rl_env(env)
    observations, reward, done, extras = worlds.step(torch.zeros(2, 11))
    assert observations["touch"].shape == (2, 60) and reward.shape == done.shape == (2,)
    assert done.dtype == torch.long and "time_outs" in extras


@needs_hand
@pytest.mark.slow
def test_episodes_begin_with_the_rod_held_wherever_that_was():
    """A state goes to another world with all that skins and sensors remember: from there both do the same to
    the last bit, however the worlds were thrown about before."""
    settings = Settings(
        timestep=2e-3,
        substeps=5,
        close=0.2,
        hold=0.2,
        release=0.25,
        prepare=30,
        decisions=3,
        begin="held",
        goal="place",
        target=(0.0, 2e-3),
        tolerance=5e-4,
        near=1e-3,
        lead=4e-3,
        actions="pads",
        rate=5e-4,
        reach=8e-3,
        work=240,
    )
    env = RollRod(HAND, num_envs=8, device="cpu", settings=settings)
    observations, _ = env.reset(seed=0)
    assert {k: v.shape[1] for k, v in observations.items()} == {"body": 34, "touch": 60, "state": 6}
    assert len(env.good) >= 4 and observations["touch"].abs().max() > 0.5  # it is touched already
    np.testing.assert_allclose(observations["state"][:, 1], 1e3 * env.place, rtol=1e-6)
    source = env.good[torch.arange(8) % len(env.good)]
    generator = torch.Generator().manual_seed(0)
    actions = 2 * torch.rand(2, 8, 6, generator=generator) - 1
    order = torch.randperm(8, generator=generator)
    ways = []
    for which in (torch.arange(8), order):
        env._bank.give(torch.arange(8), source[which])
        way = []
        for action in actions:
            env._advance(settings.rate * action[which])
            way.append((env.qpos.clone(), env.sensordata.clone()))
        ways.append(way)
    for (qpos, sensed), (other, felt) in zip(*ways, strict=True):
        np.testing.assert_array_equal(qpos[order], other)
        np.testing.assert_array_equal(sensed[order], felt)
    # pads that go one way while the thumb goes the other take the rod along
    env._bank.give(torch.arange(8), source)
    before = env.place.clone()
    roll = torch.tensor([1.0, 1.0, -1.0, 0.0, 0.0, 0.0]).expand(8, -1)
    for _ in range(8):
        env._advance(settings.rate * roll)
    assert (env.place > before + 3e-4).all()


def test_a_choice_that_is_none_is_named():
    for name in ("begin", "goal", "actions"):
        with pytest.raises(ValueError, match=f"{name}='other': choose one of"):
            RollRod("none.xml", settings=Settings(**{name: "other"}))


def test_as_many_worlds_as_a_table_has_rows_are_refused():
    """Their states and the table would be one to it: with seven the sensors' addresses were shuffled."""
    with pytest.raises(ValueError, match="take one more"):
        Bank(7, [])
    Bank(8, [])
