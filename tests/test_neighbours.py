"""Sensor classes for mjlab and Isaac Lab, in doubles of the scenes that call them there: neither framework is
needed."""

import sys
import types

import mujoco
import numpy as np
import pytest

mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
torch = pytest.importorskip("torch", reason="needs torch: pip install biotac_mj[learning]")

# ruff: noqa: E402
from test_batch import ball_spec, move, press_spec, shell, single

from biotac_mj import batch
from biotac_mj.neighbours import isaaclab, mjlab

QUIET = {"readings": {"noise": False}}


class Bridge:
    """As mjlab's WarpBridge around mujoco_warp's Model and Data."""

    def __init__(self, struct):
        self.struct = struct


class Scene:
    """What mjlab's Scene and its environment do with sensors, in their order."""

    def __init__(self, spec, sensors, nworld):
        self.spec, self.sensors = spec, {}
        for cfg in sensors:
            sensor = cfg.build()
            sensor.edit_spec(self.spec, {})
            self.sensors[cfg.name] = sensor
        self.mjm = self.spec.compile()
        data = mujoco.MjData(self.mjm)
        mujoco.mj_forward(self.mjm, data)
        self.m, self.d = mjw.put_model(self.mjm), mjw.put_data(self.mjm, data, nworld=nworld)
        for sensor in self.sensors.values():
            sensor.initialize(self.mjm, Bridge(self.m), Bridge(self.d), "cpu")

    def step(self):
        for sensor in self.sensors.values():
            sensor.begin_control_step()
        mjw.step(self.m, self.d)
        for sensor in self.sensors.values():
            sensor.update(self.mjm.opt.timestep)

    def reset(self, env_ids):
        for sensor in self.sensors.values():
            sensor.reset(env_ids)


def way(steps=8):
    """A sphere that goes 1 mm into the pad, or not at all: (steps, 2, 3) [m]."""
    start = np.array([-9e-3, -10.7e-3, 0])
    depth = np.linspace(0, 1e-3, steps)[:, None] * [0, 1, 0]
    return np.stack([start + depth, start - [0, 5e-3, 0] + 0 * depth], axis=1)


@pytest.mark.law
def test_mjlabs_scene_reads_what_a_single_simulation_reads():
    cfg = mjlab.BioTacSensorCfg(name="biotac", body="world", skin=shell(), coupling="one-way", settings=QUIET)
    scene = Scene(press_spec(), [cfg], nworld=2)
    sensor = scene.sensors["biotac"]
    assert cfg.prefixed_name == "biotac" and not sensor.requires_sensor_context
    rest = sensor.data.electrodes.clone()
    rows = []
    for pos in way():
        move(scene.d, pos)
        scene.step()
        data = sensor.data
        assert data is sensor.data and data.electrodes.shape == (2, 19) and data.pac.shape == (2, 22)
        rows.append(torch.cat([data.contact_force, data.electrodes], dim=1).numpy())
    rows = np.stack(rows)
    expected = single(way()[:, 0], shell(), {"coupling": "one-way", "options": QUIET})
    force = np.abs(expected[:, :3]).max()
    assert force > 0.1 and np.abs(rows[-1, 1, :3]).max() < 1e-9
    np.testing.assert_allclose(rows[:, 0, :3], expected[:, :3], atol=5e-3 * force)
    np.testing.assert_allclose(rows[:, 0, 6:], expected[:, 6:25], atol=2)
    scene.reset(torch.tensor([0]))
    move(scene.d, way()[0])
    scene.step()
    assert torch.abs(sensor.data.contact_force[0, :3]).max() < 1e-3 * force
    assert torch.abs(sensor.data.electrodes - rest).max() < 20


def test_mjlabs_scene_feels_the_skins_push():
    """Two-way: a ball of 10 g that falls comes to rest on the skin."""
    soon = {"options": {"loss": 2.0}}  # at rest
    cfg = mjlab.BioTacSensorCfg(name="tip", body="world", skin=shell(), settings=QUIET | soon)
    scene = Scene(ball_spec(), [cfg], nworld=2)
    for _ in range(60):
        scene.step()
    force = scene.sensors["tip"].data.contact_force[:, 1]
    assert torch.allclose(force, torch.full((2,), 0.0981), rtol=0.05)


def isaac(poses, nworld=2, **changes):
    spec = press_spec()
    batch.add(spec, body="world", skin=shell(), coupling="one-way")
    settings = {"skin": shell(), **QUIET}
    cfg = isaaclab.BioTacSensorCfg(
        model=spec.compile(), poses=poses, num_envs=nworld, **{"settings": settings, **changes}
    )
    return cfg.class_type(cfg)


@pytest.mark.law
def test_isaac_labs_scene_reads_what_a_single_simulation_reads():
    """All is turned and moved: what counts is where the bodies are against each other."""
    turn = np.array([0.8, 0.36, -0.48, 0.0])
    mat = np.zeros(9)
    mujoco.mju_quat2Mat(mat, turn)
    mat, quat = mat.reshape(3, 3), torch.tensor(turn, dtype=torch.float32).expand(2, 4)
    now = {}
    sensor = isaac(lambda: now)
    assert sensor.is_initialized and sensor.num_instances == 2 and not sensor.set_debug_vis(True)
    assert not sensor.has_debug_vis_implementation and not sensor.supports_batch_update
    rows, dt = [], sensor.cfg.model.opt.timestep
    for pos in way():
        moved = torch.tensor([0.3, -0.2, 0.1] + pos @ mat.T, dtype=torch.float32)
        now = {"pin": (moved, quat), "biotac_core": (torch.tensor([[0.3, -0.2, 0.1]] * 2), quat)}
        sensor.update(dt)
        rows.append(torch.cat([sensor.data.contact_force, sensor.data.electrodes], dim=1).numpy())
    rows = np.stack(rows)
    expected = single(way()[:, 0], shell(), {"coupling": "one-way", "options": QUIET})
    force = np.abs(expected[:, :3]).max()
    np.testing.assert_allclose(rows[:, 0, :3], expected[:, :3], atol=5e-3 * force)
    np.testing.assert_allclose(rows[:, 0, 6:], expected[:, 6:25], atol=2)
    pushed = sensor.forces["pin"].numpy()
    np.testing.assert_allclose(pushed[0, :3], -mat @ rows[-1, 0, :3], atol=1e-3 * force)
    sensor.reset(env_ids=[0])
    now = {name: (pos + (5.0 if name == "pin" else 0.0), q) for name, (pos, q) in now.items()}
    sensor.update(dt)
    assert np.abs(sensor.data.contact_force[:, :3].numpy()).max() < 1e-9


def test_isaac_labs_finger_feels_what_its_biotac_touches():
    """A BioTac on a body of its own: what pushes the pin pushes that body back, about its centre of mass."""
    spec = press_spec()
    finger = spec.worldbody.add_body(name="finger", pos=[0.0, 0.0, 0.0])
    finger.add_freejoint()
    finger.add_geom(
        size=[4e-3, 0, 0], pos=[-0.03, 0.0, 0.0], mass=0.05, contype=0, conaffinity=0, name="bone"
    )
    batch.add(spec, body="finger", skin=shell(), coupling="one-way")
    here = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2)
    now = {}
    cfg = isaaclab.BioTacSensorCfg(
        model=spec.compile(), poses=lambda: now, num_envs=2, settings={"skin": shell(), **QUIET}
    )
    sensor = cfg.class_type(cfg)
    for pos in way():
        pin = torch.tensor(pos, dtype=torch.float32)
        now = {"pin": (pin, here), "finger": (torch.zeros(2, 3), here)}
        sensor.update(cfg.model.opt.timestep)
    forces = {name: f.numpy().astype(float) for name, f in sensor.forces.items()}
    assert np.linalg.norm(forces["pin"][:, :3], axis=1).max() > 0.1
    np.testing.assert_allclose(forces["finger"][:, :3], -forces["pin"][:, :3], rtol=1e-5)
    com = {n: np.asarray(now[n][0]) + cfg.model.body_ipos[cfg.model.body(n).id] for n in forces}
    turning = sum(f[:, 3:] + np.cross(com[n], f[:, :3]) for n, f in forces.items())
    np.testing.assert_allclose(turning, 0.0, atol=1e-5 * np.abs(forces["finger"]).max())


def test_isaac_labs_period_and_masks():
    """An environment's data are new when its period is over, or after its reset."""
    now = {"pin": (torch.tensor(way()[0], dtype=torch.float32), torch.tensor([[1.0, 0, 0, 0]] * 2))}
    sensor = isaac(lambda: now, update_period=6e-3)
    seen = []
    for k in range(7):
        pos = torch.tensor(way()[k], dtype=torch.float32)
        now = {"pin": (torch.stack([pos[0], pos[0]]), now["pin"][1])}
        if k == 5:
            sensor.reset(env_mask=np.array([False, True]))
        sensor.update(2e-3, force_recompute=k == 6)
        seen.append(sensor.data.contact_force[:, 1].clone())
    same = [(a == b).tolist() for a, b in zip(seen, seen[1:])]
    assert same == [[True] * 2, [True] * 2, [False] * 2, [True] * 2, [True, False], [False] * 2]


@pytest.mark.parametrize(
    ("poses", "changes", "text"),
    [
        (
            {"pen": (torch.zeros(2, 3), torch.ones(2, 4))},
            {},
            "poses name 'pen': the model's bodies are world, pin",
        ),
        ({"pin": (torch.zeros(3), torch.ones(2, 4))}, {}, r"shapes \(3,\) and \(2, 4\): \(2, 3\)"),
        ({}, {"history_length": 2}, "no history is kept, take 0"),
    ],
)
def test_what_isaac_labs_class_refuses(poses, changes, text):
    with pytest.raises(ValueError, match=text):
        isaac(lambda: poses, **changes).update(2e-3)
    with pytest.raises(ValueError, match="the model's time step 0.002 s: make them equal"):
        isaac(lambda: {}).update(1e-3)


def test_no_framework_is_imported():
    assert not {"mjlab", "isaaclab", "isaacsim"} & set(sys.modules)
    assert isinstance(mjlab, types.ModuleType) and mjlab.__name__ == "biotac_mj.neighbours.mjlab"
