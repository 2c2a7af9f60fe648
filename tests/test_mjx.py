"""BioTacs in JAX: the numbers of mujoco_warp's batch, from functions that are pure to the bit."""

import importlib.util
import pathlib
import sys

import mujoco
import numpy as np
import pytest
import warp as wp

mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
jax = pytest.importorskip("jax", reason="needs JAX: pip install biotac_mj[mjx]")
sys.path.insert(0, str(pathlib.Path(__file__).parent))

# ruff: noqa: E402
import jax.numpy as jnp
from test_batch import ball_spec, shell

from biotac_mj import batch, mjx

DEVICE = "cuda:0" if jax.default_backend() == "gpu" else "cpu"  # of `biotac_mj.mjx`
SPEED = jnp.array([0.0, 0.2, 0.6])  # [m/s] of a ball of 5 g towards the pad, in three worlds
REMEMBERS = {
    "tier": "condensed",
    "inertia": {"options": {"skin": {"dynamics": "implicit"}}},
    "rubber": {"material": {"prony": [[0.2, 0.05]], "mullins": [1.5, 1e4, 0.1]}},
    "friction": {"material": {"hysteresis": [[0.3, 0.05]]}},
    "contact": {"options": {"skin": {"contact_law": {"adhesion": 0.05, "friction_exponent": 0.3}}}},
    "liquid": {"options": {"skin": {"rest_pressure": 2000.0}}},
    "senses": {"thermal": {"ball": "aluminium"}, "textures": {"ball": "steel"}, "sensor": "random"},
}


LOSS = {"loss": 2.0}  # balls come to rest soon


def ball_model(mass=0.005):
    spec = ball_spec(mass)
    batch.add(spec, body="world", skin=shell())
    return spec.compile()


@pytest.fixture(scope="module")
def model():
    return mjx.put_model(ball_model(), skin=shell(), options=LOSS)


def worlds(model):
    data = jax.vmap(lambda seed: mjx.make_data(model, seed))(jnp.arange(len(SPEED)))
    return data.replace(qvel=SPEED[:, None])


def rolled(model, length):
    """A function of one world's data: that after so many steps, and what was in each."""

    def one(data, _):
        data = mjx.step(model, data)
        return data, (data.qpos, data.sensordata)

    return lambda data: jax.lax.scan(one, data, length=length)


def assert_same(first, second):
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for name, a, b in zip(vars(first), jax.tree.leaves(first), jax.tree.leaves(second)):
        np.testing.assert_array_equal(a, b, err_msg=name)


def test_a_scan_gives_what_a_batch_gives(model):
    end, (qpos, sensordata) = jax.jit(jax.vmap(rolled(model, 100)))(worlds(model))
    mjd = mujoco.MjData(model.mjm)
    mujoco.mj_forward(model.mjm, mjd)
    with wp.ScopedDevice(DEVICE):
        m, d = mjw.put_model(model.mjm), mjw.put_data(model.mjm, mjd, nworld=len(SPEED))
        batch.attach(model.mjm, m, d, skin=shell(), options=LOSS)
    d.qvel.assign(np.array(SPEED)[:, None])
    for k in range(100):
        with wp.ScopedDevice(DEVICE):
            mjw.step(m, d)
        np.testing.assert_allclose(qpos[:, k], d.qpos.numpy(), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(sensordata[:, k], d.sensordata.numpy(), rtol=1e-6, atol=1e-9)
    read = mjx.readings(model, end)
    np.testing.assert_allclose(read["contact_force"][:, 1], 0.005 * 9.81, rtol=0.02)
    assert read["electrodes"].shape == (3, 19) and (np.ptp(sensordata[0, :, :19], axis=0) > 10).any()


@pytest.mark.parametrize(
    "remembers", [None, *(pytest.param(name, marks=pytest.mark.slow) for name in REMEMBERS)]
)
def test_data_hold_all_that_a_step_starts_from(model, remembers):
    """The same data give the same again, in another place of the batch, and alone, whatever was stepped in
    between."""
    if remembers:
        settings = {"tier": "condensed"} if remembers == "tier" else REMEMBERS[remembers]
        settings = settings | {"options": LOSS | settings.get("options", {})}
        model = mjx.put_model(ball_model(), skin=shell(), **settings)

    def end_of(data):
        return rolled(model, 9)(data)[0]

    run, order = jax.jit(jax.vmap(end_of)), jnp.array([2, 0, 1])
    middle = run(worlds(model))
    end = run(middle)
    assert (jnp.abs(mjx.readings(model, end)["contact_force"][:2, 1]) > 5e-3).all()
    run(end)
    assert_same(run(middle), end)
    assert_same(run(jax.tree.map(lambda x: x[order], middle)), jax.tree.map(lambda x: x[order], end))
    alone = jax.jit(end_of)(jax.tree.map(lambda x: x[1], middle))
    np.testing.assert_allclose(alone.qpos, end.qpos[1], rtol=1e-6)
    np.testing.assert_allclose(alone.sensordata, end.sensordata[1], rtol=1e-4, atol=1e-8)


def test_worlds_are_reset_by_jax(model):
    start = worlds(model)
    run = jax.jit(jax.vmap(lambda data: rolled(model, 12)(data)[0]))
    end, done = run(start), jnp.array([True, False, True])
    reset = jax.tree.map(lambda a, b: jnp.where(done.reshape(-1, *[1] * (a.ndim - 1)), a, b), start, end)
    again = run(reset)
    for w in (0, 2):  # single precision: mujoco_warp's solver goes on while any world wants it
        np.testing.assert_allclose(again.qpos[w], end.qpos[w], rtol=1e-6, atol=1e-8)
        for name, value in mjx.readings(model, end).items():
            now = mjx.readings(model, again)[name][w]
            off = {"pac": 2.0, "contact_force": 1e-5, "status": 1e-7}.get(name, 1e-8)
            np.testing.assert_allclose(now, value[w], rtol=1e-4, atol=off, err_msg=name)
    assert not np.array_equal(again.qpos[1], end.qpos[1])


def test_models_and_nested_worlds_go_through_jax(model):
    flat = jax.jit(jax.vmap(mjx.step, in_axes=(None, 0)))(model, worlds(model))
    twice = jax.tree.map(lambda x: jnp.stack([x, x[::-1]]), worlds(model))
    nested = jax.vmap(jax.vmap(mjx.step, in_axes=(None, 0)), in_axes=(None, 1), out_axes=1)(model, twice)
    assert_same(jax.tree.map(lambda x: x[0], nested), flat)
    assert_same(jax.tree.map(lambda x: x[1, ::-1], nested), flat)


def test_forward_leaves_skins_as_they_are(model):
    data = mjx.make_data(model)
    there = mjx.forward(model, data.replace(qpos=jnp.array([1e-3])))
    ball = model.mjm.body("ball").id
    assert there.xpos[ball, 1] == pytest.approx(model.mjm.body_pos[ball, 1] + 1e-3, rel=1e-6)
    np.testing.assert_array_equal(there.skins, data.skins)
    assert there.time == data.time == 0


def test_a_seed_is_a_worlds_noise_and_sensor(model):
    one, other, again = (jax.jit(lambda s: mjx.make_data(model, s))(seed) for seed in (3, 4, 3))
    assert_same(one, again)
    assert 0 < (one.skins != other.skins).sum() <= 2
    drawn = mjx.put_model(ball_model(), skin=shell(), sensor="random", readings={"noise": False})
    data = jax.vmap(lambda seed: mjx.make_data(drawn, seed))(jnp.array([0, 1, 0]))
    electrodes = mjx.readings(drawn, jax.vmap(mjx.step, (None, 0))(drawn, data))["electrodes"]
    np.testing.assert_array_equal(electrodes[0], electrodes[2])
    assert (electrodes[0] != electrodes[1]).sum() > 10


@pytest.mark.parametrize("seed", [0, 256, 2**32 - 1])
def test_a_seed_draws_the_sensor_that_a_batch_has(seed):
    own = {"sensor": "random", "randomise": ["drift"], "thermal": {"ball": ["steel", "plastic"]}}
    model = mjx.put_model(ball_model(), skin=shell(), **own)
    data = jax.jit(jax.vmap(lambda s: mjx.make_data(model, s)))(jnp.array([seed, 1], jnp.uint32))
    again = mjx.put_model(ball_model(), skin=shell(), **own)
    again._settings["seed"], again._worlds = seed, {}
    np.testing.assert_array_equal(data.skins[0], again.worlds(1).rest()["skins"][0])
    assert (data.skins[0] != data.skins[1]).sum() > 100


@pytest.mark.parametrize("seed", [-1, 2**32, 1.7, True, "1", [1, 2]])
def test_a_seed_that_is_none_is_named(model, seed):
    with pytest.raises(ValueError, match="seed is "):
        mjx.make_data(model, seed)
    with pytest.raises(ValueError, match="seed is of float32"):
        jax.jit(lambda s: mjx.make_data(model, s))(1.0)


def test_two_biotacs_have_noise_of_their_own():
    spec = ball_spec()
    for prefix, z in (("left_", 0.0), ("right_", 0.05)):
        batch.add(spec, body="world", skin=shell(), prefix=prefix, pos=[0, 0, z], geoms=["ball"])
    model = mjx.put_model(spec.compile(), skin=shell(), prefix=("left_", "right_"), geoms=["ball"])
    data = jax.jit(lambda: rolled(model, 8)(mjx.make_data(model))[0])()
    left, right = (mjx.readings(model, data, prefix) for prefix in ("left_", "right_"))
    assert left["contact_force"][1] > 5e-3 and right["contact_force"][1] == 0
    assert (left["pac"] != right["pac"]).any()


def test_what_cannot_be_is_refused_by_name(model):
    data = mjx.make_data(model)
    with pytest.raises(ValueError, match="biotac_mj.mjx.step has no gradient: .*differentiable.rollout"):
        jax.grad(lambda q: mjx.step(model, data.replace(qpos=q)).qpos.sum())(data.qpos)
    jax.grad(lambda q: mjx.step(model, data).qpos.sum() + q.sum())(data.qpos)
    with pytest.raises(ValueError, match=r"qpos has shape \(3, 1\), of one world it is \(1,\): put step of"):
        mjx.step(model, data.replace(qpos=jnp.zeros((3, 1))))
    with pytest.raises(ValueError, match="seed is of a world here: give it to make_data"):
        mjx.put_model(model.mjm, skin=shell(), seed=1)
    with pytest.raises(ValueError, match="no BioTac 'thumb_': give prefix= one of"):
        mjx.readings(model, data, "thumb_")
    with pytest.raises(TypeError, match="MjModel"):
        mjx.put_model("model.xml")


@pytest.mark.slow
def test_a_policy_learns_to_press_by_touch():
    pytest.importorskip("brax", reason="needs Brax: pip install brax")
    path = pathlib.Path(__file__).resolve().parents[1] / "examples" / "mjx_ppo.py"
    spec = importlib.util.spec_from_file_location("mjx_ppo", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    before, after = example.main(timesteps=4096)
    assert after < 0.7 * before
