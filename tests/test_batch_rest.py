"""Skins of a batch that rest and that nothing reaches: not solved, and nothing is different for it."""

import mujoco
import numpy as np
import pytest

mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")

# ruff: noqa: E402
import warp as wp
from test_batch import RADIUS, ball_spec, make, move, places, press, press_spec, read, shell

from biotac_mj.batch.rest import Rest
from biotac_mj.skin import newton
from biotac_mj.skin.contact.clearance import CLEAR, Clearance

CHANNELS = ("contact_force", "electrodes", "pdc", "status")


@pytest.fixture(autouse=True)
def where_batches_run(default_device):
    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        yield


@pytest.fixture
def restless(monkeypatch):
    """Makes batches that solve every skin in every step."""
    made = Rest.__init__

    def never(self, skin):
        made(self, skin)
        self.sleeps = False

    def apply():
        monkeypatch.setattr(Rest, "__init__", never)

    return apply


def rows_of(mjm, d):
    return np.concatenate([read(mjm, d, c) for c in CHANNELS], axis=1).copy()


def touch_and_part():
    """Readings (step, world, channel) of four worlds in which a ball presses, leaves and presses again, each
    at other times, and which skins took part in each step."""
    mjm, m, d, batch = make(press_spec(), 4, readings={"noise": False})
    start = places(4)
    rows, awake = [], []
    for k in range(40):
        swing = np.sin((k + 5 * np.arange(4)) / 4)
        depth = np.where(swing > 0, 1e-3, 20e-3) * swing
        depth[3] = -20e-3  # this one stays away
        way = depth / np.linalg.norm(start[:, 1:], axis=1)
        move(d, start * (1 - way[:, None] * [0, 1, 1]))
        mjw.step(m, d)
        rows.append(rows_of(mjm, d))
        awake.append(batch.rest.awake.numpy().copy())
    return np.array(rows), np.array(awake)


@pytest.mark.law
def test_readings_equal_those_of_skins_solved_every_step(restless):
    rows, awake = touch_and_part()
    assert awake[:, 3].sum() == 0
    assert 0.2 < awake[:, :3].mean() < 0.95 and (rows[:, :3, 1] != 0).any()
    restless()
    expected, always = touch_and_part()
    assert always.all()
    np.testing.assert_array_equal(rows, expected)


def test_a_step_in_which_all_rest_solves_nothing(monkeypatch):
    mjm, m, d, batch = make(ball_spec(), 3)
    qpos = d.qpos.numpy()
    qpos[:, 0] -= 0.02
    d.qpos.assign(qpos)
    mjw.step(m, d)
    calls = []
    monkeypatch.setattr(batch, "begin_solve", lambda *a: calls.append(1))
    for _ in range(3):
        mjw.step(m, d)
    assert not calls and not batch.rest.any.numpy()[0]
    assert (read(mjm, d, "status")[:, 0] == 1).all() and not read(mjm, d, "contact_force").any()


@pytest.mark.law
def test_clearances_equal_distances_of_points_from_spheres():
    """Of spheres that touch the skin, are near it, and are far from it, in one world after the other."""
    batch = make(press_spec(), 6, readings=False)[-1]
    skin, clearance = batch.skin, Clearance(batch.skin.model, 1, 6)
    corner = skin.model.rest.vert[skin.model.outer.face.numpy()]
    point = np.einsum("sk,fki->fsi", skin.model.sample.numpy(), corner).reshape(-1, 3)
    clearance.skin.radius, every = 1.0, wp.ones(6, dtype=int)  # [m] none is left out
    away = 1e-3 * np.array([-1, -0.5, 0.2, 0.5, 3, 9])
    centre = places(6) - away[:, None] * [0, 1, 0]
    for turn in range(6):
        at = np.roll(centre, turn, axis=0)
        skin.pos.assign(at[None])
        clearance.find(every, skin.geoms.struct, skin.data.laws.struct, skin.data.rest_vert)
        found = clearance.found.numpy()[:, 0]
        distance = np.linalg.norm(point[None] - at[:, None], axis=2).min(1) - RADIUS
        touched, near = distance < 0, (0 <= distance) & (distance < CLEAR)
        assert touched.sum() == 2 and near.sum() == 2
        np.testing.assert_array_equal(found < 0, touched)
        np.testing.assert_allclose(found[near], distance[near], rtol=0, atol=1e-9)
        assert (found[distance >= CLEAR] >= CLEAR).all()
        assert (found[~touched] <= distance[~touched] + 1e-9).all()


def bounce():
    """Heights and forces (step, world, 4) of balls that fall on the pad from 10 and 14 mm."""
    mjm, m, d, batch = make(ball_spec(), 2, readings=False)
    qpos = d.qpos.numpy()
    qpos[:, 0] -= [10e-3, 14e-3]
    d.qpos.assign(qpos)
    out = []
    for _ in range(60):
        mjw.step(m, d)
        out.append(np.concatenate([d.qpos.numpy(), read(mjm, d, "contact_force")[:, :3]], axis=1))
    return np.array(out)


@pytest.mark.slow
def test_a_ball_bounces_on_a_sleeping_skin_as_on_a_solved_one(restless):
    found = bounce()
    restless()
    expected = bounce()
    assert np.abs(expected[..., 1:]).max() > 0.05
    np.testing.assert_allclose(found[:23, :, 0], expected[:23, :, 0], atol=1e-9)  # before any touch
    # solves that begin a rounding apart end apart by the tolerance of the solver, most in single precision
    off = 1e-6 if wp.is_cuda_available() else 2e-7
    np.testing.assert_allclose(found[..., :1], expected[..., :1], atol=off)
    np.testing.assert_allclose(found[..., 1:], expected[..., 1:], atol=2e-3 * np.abs(expected[..., 1:]).max())


def test_what_is_put_into_a_resting_skin_or_changed_wakes_it():
    mjm, m, d, batch = make(press_spec(), 3, skin="coarse", options={"skin": {"liquid": True}})
    start = places(3)
    start[:, 1:] *= 3
    for _ in range(2):
        move(d, start)
        mjw.step(m, d)
    assert not batch.rest.awake.numpy().any()
    pressure = batch.skin.pressure.numpy().copy()
    natural = batch.skin.data.worlds.natural.numpy()
    natural[1] *= 1.002  # more liquid
    batch.skin.data.worlds.natural.assign(natural)
    mjw.step(m, d)
    assert batch.rest.awake.numpy().tolist() == [0, 1, 0]
    assert batch.skin.pressure.numpy()[1] > pressure[1] + 50
    for _ in range(4):
        mjw.step(m, d)
    assert not batch.rest.awake.numpy().any()
    batch.reset([False, True, False])  # which has as much liquid as before
    mjw.step(m, d)
    assert batch.rest.awake.numpy().tolist() == [0, 1, 0]
    assert batch.skin.pressure.numpy()[1] > pressure[1] + 50
    start[0] = np.nan
    move(d, start)
    mjw.step(m, d)
    assert batch.rest.awake.numpy()[0] == 1 and read(mjm, d, "status")[0, 0] == -1
    assert newton.worlds.NOT_FINITE == batch.skin.reason.numpy()[0]


@pytest.mark.parametrize("place", [(-12e-3, 0.0, 0.0), (-8e-3, 1e-3, 0.0)])
def test_a_geom_inside_the_core_wakes_the_skin(place):
    """A ball so small that it is nowhere near the skin."""
    spec = mujoco.MjSpec.from_string("""
      <mujoco><worldbody>
        <body name="bead" mocap="true" pos="0 -.05 0"><geom size=".0005"/></body>
      </worldbody></mujoco>
    """)
    mjm, m, d, batch = make(spec, 1, skin="coarse")
    for _ in range(2):
        mjw.step(m, d)
    assert not batch.rest.awake.numpy().any()
    move(d, [place])
    mjw.step(m, d)
    assert batch.rest.awake.numpy().all()


def test_a_body_beside_the_pad_lets_it_rest_until_it_is_near():
    mjm, m, d, batch = make(press_spec(), 4)
    start = places(4)
    outwards = start * [0, 1, 1] / np.linalg.norm(start[:, 1:], axis=1, keepdims=True)
    gap = np.array([0.2e-3, 0.8e-3, 10e-3, 20e-3])  # its faces are 4 mm wide
    for _ in range(3):
        move(d, start + gap[:, None] * outwards)
        mjw.step(m, d)
    assert batch.rest.awake.numpy().tolist()[2:] == [0, 0]
    assert batch.rest.awake.numpy()[0] == 1
    for _ in press(m, d, start, 4, [1e-3] * 4):
        pass
    assert (
        batch.rest.awake.numpy().all() and (np.abs(read(mjm, d, "contact_force")[:, :3]).max(1) > 0.05).all()
    )
    assert shell().nvert == batch.vert_xpos.shape[1]
