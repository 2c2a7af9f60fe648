"""The engine plugin: everything a BioTac remembers is MuJoCo's own state, and nothing it does wrong crosses
into C."""

import copy
import gc
import pickle
import subprocess
import sys
import threading

import mujoco
import mujoco.rollout
import numpy as np
import pytest
import spring_skin

import biotac_mj
from biotac_mj.coupling import SkinResult, SkinStepper, attach, register_stepper, structs
from biotac_mj.coupling.setup import Setup

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


def two_biotacs(count=2, stepper="springs", readings="sum", extra="", **settings):
    """`count` pads of springs side by side, facing up; a ball rolls and slides on each."""
    bodies = "".join(
        f'<body name="ball{i}" pos="{i} 0 .0179"><freejoint/>'
        f'<geom name="ball{i}" type="sphere" size=".01" mass=".0{i + 1}" friction=".3"/></body>'
        for i in range(count)
    )
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.002" '
        f'integrator="implicitfast"/><worldbody>{bodies}{extra}</worldbody></mujoco>'
    )
    handles = [
        attach(
            spec,
            body="world",
            pos=[0.01 + i, 0, 0],
            quat=[np.sqrt(0.5), -np.sqrt(0.5), 0, 0],
            prefix=f"b{i}_",
            skin=spring_skin.pad_geometry(),
            stepper=stepper,
            readings=readings,
            friction=0.3,
            seed=i,
            **settings,
        )
        for i in range(count)
    ]
    return spec.compile(), handles


def start(model, speed=0.05):
    data = mujoco.MjData(model)
    data.qvel[0] = speed
    data.qvel[model.nv - 6 + 1] = speed
    return data


def state_of(model, data, kind=STATE):
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    return state


@pytest.fixture(autouse=True)
def no_errors():
    yield
    biotac_mj.plugin.check()


@pytest.fixture(scope="module")
def model():
    return two_biotacs()[0]


def test_views_show_what_mujoco_holds():
    """Every field of mjModel and mjData that MuJoCo's own bindings show, compared value by value."""
    model, _ = two_biotacs(extra='<geom type="plane" size="2 2 .1"/>')
    data = start(model)
    mujoco.mj_step(model, data, 5)
    model_view = structs.ModelView(model._address)
    compared = 0
    for view, real in ((model_view, model), (structs.DataView(data._address, model_view), data)):
        for name, (dtype, extents) in view._field.items():
            if dtype is None or not hasattr(real, name) or any("*" in str(e) for e in extents):
                continue
            value = getattr(real, name)
            value = np.frombuffer(value, np.uint8) if isinstance(value, bytes) else np.asarray(value)
            assert np.array_equal(
                view.array(name).ravel().astype(float), value.ravel().astype(float), equal_nan=True
            ), name
            compared += 1
        assert view.nv == model.nv if real is model else view.time == data.time
    assert compared > 400


@pytest.mark.parametrize("option", ["", 'solver="CG"', 'solver="PGS"', 'noslip_iterations="3"'])
def test_rows_that_push_are_those_that_hold(option):
    """Two bodies that tumble over a plane and each other, island by island: 65 states of 30 steps are not in
    `efc_state`."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="0.004" {option}/><worldbody><geom type="plane" size="1 1 1"/>'
        '<body pos="0 0 .0029"><freejoint/><geom size=".003" mass=".005"/></body><body pos=".00595 0 .0029">'
        '<freejoint/><geom type="box" size=".003 .003 .003" mass=".008"/></body></worldbody></mujoco>'
    )
    data, seen = mujoco.MjData(model), 0
    view = structs.DataView(data._address, structs.ModelView(model._address))
    data.qvel[:] = 0.3, 0.1, -0.2, 50, 20, 0, -0.2, 0.1, 0, 1, 30, -20
    for _ in range(30):
        mujoco.mj_forward(model, data)
        holds = view.row_states() == mujoco.mjtConstraintState.mjCNSTRSTATE_QUADRATIC
        np.testing.assert_array_equal(holds, data.efc_force > 0)
        seen += holds.sum()
        mujoco.mj_step(model, data)
    assert seen > 50


def test_a_reset_writes_the_whole_state():
    """MuJoCo does not know of contact exclusions when it asks for the state's size, and clears no memory."""
    spec = mujoco.MjSpec()
    for i in range(2):
        body = spec.worldbody.add_body(name=f"ball{i}", pos=[0.1 * i, 0, 0.1])
        body.add_freejoint()
        body.add_geom(size=[0.01, 0, 0], mass=0.01)
    spec.worldbody.add_body(name="finger", pos=[0, 0, 0.5])
    handle = attach(spec, body="finger", skin=spring_skin.pad_geometry(), stepper="springs", readings="sum")
    spec.add_exclude(bodyname1=handle.body, bodyname2="ball1")
    model = spec.compile()
    data = mujoco.MjData(model)
    view = structs.ModelView(model._address)
    assert view.plugin_statenum[0] > Setup(view, 0).nstate
    states = []
    for garbage in (np.nan, 7.0):
        data.plugin_state[:] = garbage
        mujoco.mj_resetData(model, data)
        states.append(data.plugin_state.copy())
    np.testing.assert_array_equal(*states)
    assert np.isfinite(states).all()
    mujoco.mj_step(model, data)


def test_each_biotac_reads_its_own_ball(model):
    data = start(model, 0.0)
    mujoco.mj_step(model, data, 300)
    for i in range(2):
        assert data.sensor(f"b{i}_contact_force").data[1] == pytest.approx(0.01 * (i + 1) * 9.81, rel=0.01)
        assert data.sensor(f"b{i}_electrodes").data[0] > 3290  # "sum" counts the steps there


def test_forward_twice_is_idempotent(model):
    data = start(model)
    mujoco.mj_step(model, data, 20)
    mujoco.mj_forward(model, data)
    sensors, force, acceleration, state = (
        data.sensordata.copy(),
        data.qfrc_passive.copy(),
        data.qacc.copy(),
        state_of(model, data),
    )
    for _ in range(3):
        mujoco.mj_forward(model, data)
    assert (
        np.array_equal(data.sensordata, sensors)
        and np.array_equal(data.qfrc_passive, force)
        and np.array_equal(data.qacc, acceleration)
    )
    assert np.array_equal(state_of(model, data), state)


def test_split_step_equals_step(model):
    a, b = start(model), start(model)
    for _ in range(20):
        mujoco.mj_step(model, a)
        mujoco.mj_step1(model, b)
        mujoco.mj_step2(model, b)
    assert np.array_equal(state_of(model, a), state_of(model, b))


def test_inverse_dynamics_recovers_the_applied_force(model):
    """mj_inverse asks the plugin too, with accelerations as its input: they must survive."""
    data = start(model)
    mujoco.mj_step(model, data, 20)
    data.qfrc_applied[0] = 0.02
    mujoco.mj_forward(model, data)
    acceleration = data.qacc.copy()
    mujoco.mj_inverse(model, data)
    assert np.array_equal(data.qacc, acceleration)
    np.testing.assert_allclose(data.qfrc_inverse, data.qfrc_applied, atol=1e-7)


def test_replay_from_a_saved_state_is_bit_equal(model):
    data = start(model)
    mujoco.mj_step(model, data, 30)
    saved = state_of(model, data)
    mujoco.mj_step(model, data, 30)
    end, sensors = state_of(model, data), data.sensordata.copy()
    for other in (data, mujoco.MjData(model)):
        mujoco.mj_setState(model, other, saved, STATE)
        mujoco.mj_step(model, other, 30)
        assert np.array_equal(state_of(model, other), end) and np.array_equal(other.sensordata, sensors)
    assert end[-model.npluginstate :].any()


def test_copies_go_on_alike(model):
    data = start(model)
    mujoco.mj_step(model, data, 30)
    other = mujoco.MjData(model)
    mujoco.mj_copyData(other, model, data)
    copies = [other, copy.copy(data), pickle.loads(pickle.dumps(data))]
    mujoco.mj_step(model, data, 30)
    for made in copies:
        mujoco.mj_step(model, made, 30)
        assert np.array_equal(state_of(model, made), state_of(model, data))


def test_reset_starts_over(model):
    data = start(model)
    mujoco.mj_step(model, data, 30)
    end = state_of(model, data)
    mujoco.mj_resetData(model, data)
    assert np.array_equal(data.plugin_state, mujoco.MjData(model).plugin_state)
    data.qvel[:] = start(model).qvel
    mujoco.mj_step(model, data, 30)
    assert np.array_equal(state_of(model, data), end)


def test_a_saved_binary_model_is_the_same_model(model, tmp_path):
    mujoco.mj_saveModel(model, str(tmp_path / "model.mjb"))
    loaded = mujoco.MjModel.from_binary_path(str(tmp_path / "model.mjb"))
    a, b = start(model), start(loaded)
    mujoco.mj_step(model, a, 20)
    mujoco.mj_step(loaded, b, 20)
    assert np.array_equal(state_of(model, a), state_of(loaded, b))


@pytest.mark.slow
def test_threads_equal_the_loop(model):
    def run(data):
        mujoco.mj_step(model, data, 60)

    serial, parallel = [start(model, 0.01 * i) for i in range(4)], [start(model, 0.01 * i) for i in range(4)]
    for data in serial:
        run(data)
    threads = [threading.Thread(target=run, args=(data,)) for data in parallel]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for a, b in zip(serial, parallel):
        assert np.array_equal(state_of(model, a), state_of(model, b))


@pytest.mark.law
def test_rollout_with_two_threads_equals_the_loop(model):
    starts = np.stack([state_of(model, start(model, 0.01 * i), FULL) for i in range(4)])
    states, sensors = mujoco.rollout.rollout(
        model, [mujoco.MjData(model), mujoco.MjData(model)], starts, nstep=25
    )
    for i in range(4):
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, starts[i], FULL)
        for k in range(25):
            mujoco.mj_step(model, data)
            assert np.array_equal(states[i, k], state_of(model, data, FULL))
            assert np.array_equal(sensors[i, k], data.sensordata)


class _Free(SkinStepper):
    """A linear spring that costs next to nothing, with a state as large as the real skin's."""

    nstate = 15000

    def __init__(self, config, geometry, geoms):
        self.vert, self.tangent = geometry.vert, np.diag([0.0, 500, 0, 0, 0, 0])[None]

    def reset(self, state):
        state[:] = 0.0

    def vert_xpos(self, state):
        return self.vert

    def solve_skin(self, state, geom_pos, geom_mat, dt, **more):
        return SkinResult(
            state, np.array([[0.0, -500 * (geom_pos[0, 1] + 0.018), 0, 0, 0, 0]]), self.tangent, self.vert
        )


register_stepper("free", _Free)


class _Breaking(spring_skin.SpringSkin):
    """Does not converge, or raises, once it is pressed with more than 1 N."""

    def solve_skin(self, state, geom_pos, geom_mat, dt, **more):
        result = super().solve_skin(state, geom_pos, geom_mat, dt, **more)
        result.iterations, result.residual = 7, 0.5
        if abs(result.wrench).max() > 1.0:
            if "raise" in self.options:
                raise ArithmeticError("the skin tore")
            result.converged, result.wrench, result.state = (
                False,
                result.wrench * np.nan,
                result.state * np.nan,
            )
        return result

    def __init__(self, config, geometry, geoms):
        super().__init__(config, geometry, geoms)
        self.options = config.options


register_stepper("breaking", _Breaking)


def test_a_step_that_does_not_converge_keeps_the_last_good_state():
    model, _ = two_biotacs(1, "breaking")
    data = start(model, 0.0)
    mujoco.mj_step(model, data)
    assert data.sensor("b0_status").data[0] == 1
    data.qvel[2] = -0.5
    for _ in range(200):
        before = data.plugin_state.copy()
        mujoco.mj_step(model, data)
        converged, failed, iterations, residual, *_ = data.sensor("b0_status").data
        if converged:
            continue
        assert (failed, iterations, residual) == (data.plugin_state[0], 7, 0.5)
        skin = slice(5 + 66, 5 + 66 + 7 * 81)
        assert np.array_equal(data.plugin_state[skin], before[skin])
        break
    else:
        pytest.fail("the ball never pressed hard enough")
    assert data.plugin_state[0] == 1 and np.isfinite(data.qpos).all() and np.isfinite(data.sensordata).all()


def test_an_exception_is_kept_warned_of_and_raised_on_request():
    model, _ = two_biotacs(1, "breaking", options={"raise": True})
    data = start(model, 0.0)
    data.qvel[2] = -0.5
    with pytest.warns(RuntimeWarning, match="the skin tore"):
        mujoco.mj_step(model, data)
    assert data.sensor("b0_status").data[0] == -1
    with pytest.raises(ArithmeticError, match="the skin tore"):
        biotac_mj.plugin.check()
    biotac_mj.plugin.check()  # told once


def test_an_interrupt_inside_a_solve_is_raised_by_the_step():
    class Interrupted(_Free):
        def solve_skin(self, state, geom_pos, geom_mat, dt, **more):
            if geom_pos[0, 1] > -0.0178:
                raise KeyboardInterrupt
            return super().solve_skin(state, geom_pos, geom_mat, dt, **more)

    register_stepper("interrupted", Interrupted)
    model, _ = two_biotacs(1, "interrupted", "none")
    data = start(model, 0.0)
    data.qvel[2] = -0.5
    with pytest.raises(KeyboardInterrupt):
        mujoco.mj_step(model, data)


def test_nan_pose_names_the_geom():
    model, _ = two_biotacs(
        1, extra='<body name="probe" mocap="true"><geom name="tip" type="sphere" size=".01"/></body>'
    )
    data = start(model)
    data.mocap_pos[0, 1] = np.nan
    with pytest.warns(RuntimeWarning):
        mujoco.mj_forward(model, data)
    with pytest.raises(
        ValueError, match="NaN or a huge number in the pose of the BioTac or of geom tip: check mocap_pos"
    ):
        biotac_mj.plugin.check()
    biotac_mj.plugin.clear_errors()


@pytest.mark.parametrize("part, entry, value, text", [
    ("mocap_pos", 1, np.inf, "huge number in the pose of .* geom tip: check mocap_pos"),
    ("mocap_pos", 0, 1e30, "huge number in the pose of .* geom tip: check mocap_pos"),
    ("qpos", 0, np.inf, "huge number in qpos, so MuJoCo has reset the simulation: check"),
    ("qvel", 0, 1e30, "huge number in qvel, so MuJoCo has reset the simulation: check"),
    ("plugin_state", slice(None), np.nan, "no state of this model: call mj_resetData"),
    ("plugin_state", 3, np.nan, "no state of this model: call mj_resetData"),
    ("plugin_state", slice(4, None), 1e30, "no state of this model: call mj_resetData"),
])  # fmt: skip
def test_numbers_that_are_none_give_one_error(part, entry, value, text):
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><site name='tip'/><body name='probe' mocap='true' pos='0 0 .1'>"
        "<geom name='tip' size='.005'/></body><body pos='-.01 -.012 0'><freejoint/>"
        "<geom size='.005' mass='.01'/></body></worldbody></mujoco>"
    )
    biotac_mj.attach(spec, site="tip", skin="coarse", tier="condensed", readings="none", on_error="raise")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 3)
    getattr(data, part).flat[entry] = value
    with pytest.raises(ValueError, match=text):
        mujoco.mj_step(model, data)
    mujoco.mj_resetData(model, data)
    data.mocap_pos[0] = 0.1
    mujoco.mj_step(model, data)
    assert np.isfinite(data.qpos).all()


def test_discrete_integrator_is_refused_two_way(model):
    other = copy.copy(model)
    other.opt.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    with pytest.warns(RuntimeWarning, match="choose implicitfast"):
        mujoco.mj_step(other, mujoco.MjData(other))
    with pytest.raises(ValueError, match="integrator discrete"):
        biotac_mj.plugin.check()
    biotac_mj.plugin.clear_errors()


def test_disabled_equalities_are_refused_two_way(model):
    other = copy.copy(model)
    other.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EQUALITY
    with pytest.warns(RuntimeWarning, match="needs MuJoCo's equality constraints"):
        mujoco.mj_step(other, mujoco.MjData(other))
    biotac_mj.plugin.clear_errors()


@pytest.mark.parametrize("coupling, limit", [("one-way", 120), ("two-way", 320)])
def test_overhead_is_small_beside_the_skin(coupling, limit):
    """Calls of Python functions in a step whose skin costs nothing, 108 and 311 (docs/lab/coupling.md), on
    whatever machine."""
    ball = (
        '<body name="ball" pos="0 0 .0179"><joint type="slide" axis="0 0 1"/><geom type="sphere" '
        'size=".01" mass=".1"/></body>'
    )
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="0.002"/><worldbody>{ball}</worldbody></mujoco>'
    )
    quat = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]
    attach(
        spec,
        body="world",
        pos=[0.01, 0, 0],
        quat=quat,
        skin=spring_skin.pad_geometry(),
        stepper="free",
        readings="none",
        coupling=coupling,
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 50)  # what is made once
    calls = 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event == "call"

    gc.collect()  # what the collector calls is no part of a step
    gc.disable()
    sys.setprofile(count)
    mujoco.mj_step(model, data, 50)
    sys.setprofile(None)
    gc.enable()
    assert 50 * 20 < calls < 50 * limit


_OUTLIVED = """
import mujoco, biotac_mj, sys
ball = '<body><freejoint/><geom size=".01" mass=".01"/></body>'
spec = mujoco.MjSpec.from_string('<mujoco><worldbody>' + ball + '</worldbody></mujoco>')
biotac_mj.attach(spec, body="world", pos=[0, 0, 1], skin="coarse", readings="none")
class Kept:
    pass
kept = Kept()
# freed when no Python is left to call
kept.itself, kept.data = kept, mujoco.MjData(spec.compile())
sys.modules["kept"] = kept
"""


@pytest.mark.slow
def test_data_that_outlives_python_is_freed_without_a_crash():
    done = subprocess.run([sys.executable, "-c", _OUTLIVED], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, (done.returncode, done.stderr)
