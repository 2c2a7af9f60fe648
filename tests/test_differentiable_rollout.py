"""Gradients of MuJoCo's steps with a BioTac in them, against central differences of the whole rollout."""

import mujoco
import numpy as np
import pytest
import torch
from blocks import four_nodes

import biotac_mj
from biotac_mj.differentiable import rollout

AGREE = 1e-10
SLIDE = (
    '<body pos="-0.01 0 {z}"><joint name="j" type="slide" axis="0 0 1" damping="1"/>'
    '<geom size="0.005" mass="0.1" friction="0.3"/></body>'
)
ARM = (
    '<body pos="-0.04 0 0.01595"><joint name="j" type="hinge" axis="0 1 0" damping="0.01"/>'
    '<joint name="s" type="slide" axis="0 1 0" damping="1"/>'
    '<geom type="capsule" fromto="0 0 0 0.03 0 -0.0025" size="0.005" mass="0.1" friction="0.3"/></body>'
)
FREE = '<body pos="-0.01 0 0.0136"><freejoint name="j"/><geom size="0.005" mass="0.1" friction="0.3"/></body>'
STEPS = {
    "qpos": 2e-7,
    "qvel": 1e-4,
    "ctrl": 1e-3,
    "qfrc_applied": 1e-3,
    "mocap_pos": 2e-7,
    "mocap_quat": 1e-4,
}


def scene(body, joints, tolerance=1e-9, **settings):
    motors = "".join(f'<motor joint="{name}"/>' for name in joints)
    sensor = '<jointpos joint="j"/>' if joints else ""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.002" integrator="implicitfast" tolerance="1e-12"/><worldbody>'
        f'<site name="fingertip" quat="1 -1 0 0"/>{body}</worldbody><actuator>{motors}</actuator>'
        f"<sensor>{sensor}</sensor></mujoco>"
    )
    settings = {"skin": four_nodes("coarse"), "options": {"skin": {"tolerance": tolerance}}} | settings
    handle = biotac_mj.attach(spec, site="fingertip", **settings)
    model = spec.compile()
    return model, mujoco.MjData(model), handle


def loss_of(rolled):
    """All that comes out, by chance."""
    draw, total = torch.Generator().manual_seed(1), 0.0
    parts = [(rolled.qpos, 1e2), (rolled.qvel, 1.0)]
    for name in rolled.nodes:
        parts += [(rolled.nodes[name], 1e2), (rolled.wrench[name], 1.0), (rolled.pressure[name], 1e-5)]
    parts += [(rolled.sensordata[..., :1], 1e2)]
    for value, scale in parts:
        weight = torch.randn(value.shape[-3:], generator=draw, dtype=torch.float64)
        total = total + scale * (weight * value).sum()
    return total


def check(model, data, given, exact, seed=5, **steps):
    """Along a way drawn for each input: within `exact` of its gradient's size."""
    given = {name: value.clone().requires_grad_() for name, value in given.items()}
    rolled = rollout(model, data, agree=AGREE, **given)
    assert not sum(rolled.lost)
    assert min(wrench.abs().max() for wrench in rolled.wrench.values()) > 0.3
    loss_of(rolled).backward()
    for name, value in given.items():
        way = torch.tensor(np.random.default_rng(seed).normal(size=value.shape))
        way, step = way / way.norm(), (STEPS | steps)[name]
        with torch.no_grad():
            ahead, back = (
                loss_of(rollout(model, data, agree=AGREE, **given | {name: value + s * step * way})).item()
                for s in (1, -1)
            )
        slope, wanted = (value.grad * way).sum().item(), (ahead - back) / (2 * step)
        print(
            f"{name}: {abs(slope / wanted - 1):.0e}, amiss {rolled.mismatch[0]:.0e}"
        )  # for the lab book: -rP
        assert slope == pytest.approx(wanted, rel=exact), name
    return rolled


def drawn(count, mean, spread=0.3):
    mean = np.array(mean)
    return torch.tensor(mean + spread * np.random.default_rng(0).normal(size=(count, len(mean))))


@pytest.mark.parametrize(
    "tolerance, agree, exact", [(1e-9, AGREE, 1e-4), pytest.param(1e-6, 1e-8, 2e-3, marks=pytest.mark.slow)]
)
def test_a_ball_pressed_by_its_weight(tolerance, agree, exact, monkeypatch):
    """It touches in flight, both ways coupled, with liquid; as finely as it goes and as is advised."""
    monkeypatch.setitem(globals(), "AGREE", agree)
    model, data, _ = scene(SLIDE.format(z=0.0136), ["j"], tolerance)
    given = {"qpos": torch.tensor(data.qpos), "qvel": torch.tensor([-0.08], dtype=torch.float64)}
    check(model, data, given | {"ctrl": drawn(6, [0.0])}, exact)


def test_worlds_are_each_alone_and_data_stays():
    model, data, handle = scene(SLIDE.format(z=0.0136), ["j"], tolerance=1e-6)
    before = data.qpos.copy(), data.plugin_state.copy()
    ctrl = drawn(4, [-1.0])
    both = torch.stack([ctrl, 2 * ctrl]).requires_grad_()
    speed = torch.tensor([-0.08], dtype=torch.float64)
    together = rollout(model, data, qvel=speed, ctrl=both)
    assert np.array_equal(data.qpos, before[0]) and np.array_equal(data.plugin_state, before[1])
    together.electrodes().sum().backward()
    one = (2 * ctrl).requires_grad_()
    alone = rollout(model, data, qvel=speed, ctrl=one)
    alone.electrodes().sum().backward()
    assert torch.equal(together.nodes["biotac_"][1], alone.nodes["biotac_"])
    assert one.grad.abs().max() > 0
    torch.testing.assert_close(both.grad[1], one.grad, rtol=1e-6, atol=0)
    # what is stepped is mj_step, but for how well bodies and skins agree; and counts are the sensor's
    data.qvel[:] = speed.numpy()
    for row in one.detach().numpy():
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
    assert alone.qpos[-1].detach().numpy() == pytest.approx(data.qpos, abs=1e-6)
    pressure = together.pdc().detach()
    assert pressure.shape == (2, 4) and (pressure[1, -1] > pressure[1, 0])
    assert alone.electrodes().shape == (19,)


@pytest.mark.slow
def test_an_arm_that_presses_and_slides():
    model, data, _ = scene(ARM, ["j", "s"])
    mean = np.array([0.01, 0.2])
    ctrl = torch.tensor(mean * (1 + 0.3 * np.random.default_rng(0).normal(size=(16, 2))))
    given = {"qpos": torch.tensor(data.qpos), "qvel": torch.zeros(2, dtype=torch.float64)}
    given |= {"ctrl": ctrl, "qfrc_applied": torch.zeros(16, 2, dtype=torch.float64)}
    check(model, data, given, 1e-4)


@pytest.mark.slow
def test_a_free_ball_pushed_along():
    """It comes to roll at 7 rad/s. What acts on it is the skin's wrench where it comes: `mismatch`."""
    model, data, _ = scene(FREE, [])
    speed = torch.zeros(6, dtype=torch.float64)
    speed[2] = -0.08
    push = torch.zeros(6, 6, dtype=torch.float64)
    push[:, 0], push[:, 2] = 0.3, -0.2
    start = torch.tensor(data.qpos)
    start[3:] *= 1.5  # MuJoCo makes it a unit again
    given = {"qpos": start, "qvel": speed, "qfrc_applied": push}
    rolled = check(model, data, given, 1e-4, qfrc_applied=1e-5)
    assert rolled.qvel[:, 3:].norm(dim=1).max() > 5.0
    assert rolled.mismatch[0] < 1e-6


@pytest.mark.slow
def test_a_mocap_ball_that_pushes_a_finger():
    """The BioTac moves, too; of a ball that turns, friction alone feels it."""
    model, data = finger_and_mocap_ball()
    count = 5
    pos = torch.tensor(data.mocap_pos).repeat(count, 1, 1)
    pos[:, 0, 2] -= 2e-4 * torch.arange(count)
    pos[:, 0, 1] += 1e-4 * torch.arange(count)
    turn = torch.tensor(0.002 * np.random.default_rng(2).normal(size=(count, 1, 4)))
    given = {"mocap_pos": pos, "mocap_quat": torch.tensor(data.mocap_quat) + turn}
    check(model, data, given | {"qvel": torch.tensor(data.qvel)}, 1e-4)


def finger_and_mocap_ball():
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.002" integrator="implicitfast" tolerance="1e-12" gravity="0 0 0"/>'
        '<worldbody><body><joint name="j" type="slide" axis="0 0 1" damping="2"/>'
        '<joint type="slide" axis="0 1 0" damping="2"/>'
        '<geom size="0.002" mass="0.1" contype="0" conaffinity="0"/>'
        '<site name="fingertip" quat="1 -1 0 0"/></body>'
        '<body mocap="true" pos="-0.01 0 0.0137"><geom size="0.005" friction="0.3"/></body></worldbody>'
        '<sensor><jointpos joint="j"/></sensor></mujoco>'
    )
    options = {"skin": {"tolerance": 1e-9}}
    biotac_mj.attach(spec, site="fingertip", skin=four_nodes("coarse"), options=options)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.slow
def test_a_bar_on_two_fingers():
    """What one skin pushes the other feels, by the body between them."""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.002" integrator="implicitfast" tolerance="1e-12"/><worldbody>'
        '<site name="one" quat="1 -1 0 0"/><site name="two" pos="0 0.05 0" quat="1 -1 0 0"/>'
        '<body pos="-0.01 0.02 0.0136"><joint name="j" type="slide" axis="0 0 1" damping="1"/>'
        '<joint name="turn" axis="1 0 0" damping="1e-3"/>'
        '<geom name="a" pos="0 -0.02 0" size="0.005" mass="0.1"/>'
        '<geom name="b" pos="0 0.03 0" size="0.005" mass="0.1"/></body></worldbody>'
        '<actuator><motor joint="j"/><motor joint="turn"/></actuator>'
        '<sensor><jointpos joint="j"/></sensor></mujoco>'
    )
    for site, geom in (("one", "a"), ("two", "b")):
        options = {"skin": {"tolerance": 1e-9}}
        biotac_mj.attach(
            spec, site=site, prefix=site, geoms=[geom], skin=four_nodes("coarse"), options=options
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    speed = torch.tensor([-0.08, 0.2], dtype=torch.float64)
    check(
        model,
        data,
        {"qpos": torch.tensor(data.qpos), "qvel": speed, "ctrl": drawn(8, [0.0, 0.0], 0.02)},
        3e-4,
        qpos=2e-8,
    )


@pytest.mark.parametrize(
    "change, says",
    [
        ({"tier": "condensed"}, "full tier"),
        ({"options": {"skin": {"dynamics": "implicit"}}}, "implicit dynamics"),
    ],
)
def test_what_has_no_gradient_is_refused_by_name(change, says):
    model, data, _ = scene(SLIDE.format(z=0.0136), ["j"], **change)
    with pytest.raises(ValueError, match=says):
        ctrl = torch.zeros(1, 1, dtype=torch.float64, requires_grad=True)
        rollout(model, data, ctrl=ctrl)


def test_shapes_are_refused():
    model, data, _ = scene(SLIDE.format(z=0.0136), ["j"])
    for wrong, says in (({"nstep": -1}, "nstep is -1"), ({"nstep": 1.5}, "nstep is 1.5")):
        with pytest.raises(ValueError, match=says):
            rollout(model, data, **wrong)
    with pytest.raises(ValueError, match="agree is nan"):
        rollout(model, data, 1, agree=float("nan"))
    with pytest.raises(ValueError, match="of another model"):
        rollout(model, mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>")), 1)
    diverged = mujoco.MjData(model)
    diverged.qvel[:] = np.nan
    with pytest.raises(ValueError, match="data.qvel is not finite"):
        rollout(model, diverged, 1)
    with pytest.raises(ValueError, match="ctrl has shape"):
        rollout(model, data, ctrl=torch.zeros(3, 2))
    with pytest.raises(ValueError, match="numbers of steps"):
        rollout(model, data)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    with pytest.raises(ValueError, match="RK4"):
        rollout(model, data, 3)
