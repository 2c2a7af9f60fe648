"""Skins of one scene that are solved side by side."""

import concurrent.futures

import mujoco
import numpy as np
import pytest

import biotac_mj
from biotac_mj.geometry import load_skin
from biotac_mj.press.approach import surface_point
from biotac_mj.skin import GeomSet, SkinData, SkinModel, step
from biotac_mj.threads import run_in_threads

QUAT = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]


def balls_on_fingers(tier, threads, steps=25):
    """Three fingers beside each other and a ball over each, which is no other's."""
    top, _ = surface_point(load_skin("coarse"), -10e-3, 0.0)
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = 2e-3, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    handles = []
    for i in range(3):
        x, z = 0.1 * i + top[0], -top[1] + 5e-3 + 1e-4 * (1 + i)
        ball = spec.worldbody.add_body(name=f"ball{i}", pos=[x, -top[2], z])
        ball.add_freejoint()
        sphere = dict(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[5e-3, 0, 0], mass=0.02 * (1 + i))
        ball.add_geom(name=f"ball{i}", **sphere)
        spec.worldbody.add_body(name=f"finger{i}", pos=[0.1 * i, 0, 0])
    for i in range(3):
        options = {"threads": threads} if i == 1 else {}
        settings = dict(skin="coarse", geoms=[f"ball{i}"], tier=tier, readings="none", options=options)
        handles.append(biotac_mj.attach(spec, body=f"finger{i}", prefix=f"b{i}_", quat=QUAT, **settings))
    model = spec.compile()
    data, out = mujoco.MjData(model), []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        out.append(np.concatenate([data.qpos, *(h.read(data, "contact_force") for h in handles)]))
    biotac_mj.plugin.check()
    return np.array(out)


@pytest.mark.parametrize("tier", ["condensed", pytest.param("full", marks=pytest.mark.slow)])
def test_skins_are_the_same_to_the_bit_for_any_number_of_threads(tier):
    one = balls_on_fingers(tier, 1)
    assert (np.abs(one[:, 21:].reshape(len(one), 3, -1)).max((0, 2)) > 0.1).all()  # all touch
    for threads in (2, 3):
        assert (balls_on_fingers(tier, threads) == one).all()


def test_skins_in_threads_of_ones_own_share_nothing():
    """With Warp's tiles they did; a hand of five full skins ended the process (`benchmarks/hands.py --tiers
    full --threads 2`)."""
    model = SkinModel(load_skin("coarse"))
    low = model.rest.vert[:, 1].min()

    def press(depth):
        data, geoms = SkinData(model), GeomSet(["sphere"], [(3.5e-3,)], [0.8])
        for k in range(8):
            geoms.set_pose(np.array([[-12e-3, low - 3.5e-3 + depth * (k + 1) / 8, 0]]))
            step(model, data, geoms)
        return data.wrench

    depths = (4e-4, 6e-4, 8e-4)
    alone = [press(depth) for depth in depths]
    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        together = list(pool.map(press, depths))
    assert all((a == b).all() for a, b in zip(alone, together)) and abs(alone[2][0, 0, 1]) > 0.1


def test_all_tasks_end_before_the_first_error_is_raised():
    done = []

    def work(i):
        done.append(i)
        if i in (1, 2):
            raise ValueError(f"task {i}")

    with pytest.raises(ValueError, match="task 1"):
        run_in_threads([lambda i=i: work(i) for i in range(5)], 3)
    assert sorted(done) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"options": {"threads": 0}}, "threads of options is 0: give a whole number from 1 to 1000"),
        ({"options": {"threads": "2"}}, "threads of options is '2': give a whole number"),
        ({"options": {"threads": 2}, "coupling": "one-way"}, "threads of options is of coupling='two-way'"),
    ],
)
def test_numbers_of_threads_that_cannot_be_are_refused(settings, words):
    spec = mujoco.MjSpec()
    with pytest.raises(ValueError, match=words):
        biotac_mj.attach(spec, body="world", **settings)


def test_batches_have_no_threads():
    spec = mujoco.MjSpec()
    biotac_mj.batch.add(spec, body="world", coupling="one-way", skin="coarse")
    with pytest.raises(ValueError, match="one-way a skin is solved by itself"):
        biotac_mj.batch.make(spec.compile(), 2, options={"threads": 2})
