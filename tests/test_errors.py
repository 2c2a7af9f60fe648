"""What goes wrong inside mj_step comes out of it, whatever thread steps; so does Ctrl-C. What is shared is
freed."""

import collections
import concurrent.futures
import gc
import os
import signal
import subprocess
import sys
import threading
import time
import weakref

import mujoco
import mujoco.rollout
import numpy as np
import pytest
import spring_skin

import biotac_mj
from biotac_mj.coupling import attach, register_stepper
from biotac_mj.coupling.shared import Shared

BALL = '<body name="ball" pos="0 0 .0179"><freejoint/><geom type="sphere" size=".01" mass=".01"/></body>'
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


class Tearing(spring_skin.SpringSkin):
    """Raises once it is pressed with more than 1 N."""

    def solve_skin(self, state, geom_pos, geom_mat, dt, **more):
        result = super().solve_skin(state, geom_pos, geom_mat, dt, **more)
        if abs(result.wrench).max(initial=0.0) > 1.0:
            raise ArithmeticError("the skin tore")
        return result


register_stepper("tearing", Tearing)


def model_of(**settings):
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option integrator="implicitfast"/><worldbody>{BALL}</worldbody></mujoco>'
    )
    pose = {"pos": [0.01, 0, 0], "quat": [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]}
    springs = {"skin": spring_skin.pad_geometry(), "readings": "none"}
    attach(spec, body="world", prefix="b_", **pose, **springs | {"stepper": "tearing"} | settings)
    return spec.compile()


def falling(model):
    data = mujoco.MjData(model)
    data.qvel[2] = -0.5
    return data


def run(model, steps=20):
    data = falling(model)
    for _ in range(steps):
        mujoco.mj_step(model, data)


@pytest.fixture(autouse=True)
def nothing_is_left():
    yield
    biotac_mj.plugin.check()


@pytest.fixture(scope="module")
def model():
    return model_of(on_error="raise")


@pytest.mark.filterwarnings("error")
def test_an_error_ends_the_line_that_stepped(model):
    for _ in range(3):  # each time, not only the first
        data, after = falling(model), False
        with pytest.raises(ArithmeticError, match="the skin tore"):
            for _ in range(20):
                failed = data.sensor("b_status").data[0] == -1
                assert not failed
                mujoco.mj_step(model, data)
            after = True
        assert not after and data.sensor("b_status").data[0] == -1


def test_an_error_is_raised_in_the_thread_that_steps(model):
    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        for job in [pool.submit(run, model) for _ in range(6)]:
            assert isinstance(job.exception(), ArithmeticError)
        assert pool.submit(sys.gettrace).result() is None


@pytest.mark.parametrize("threads", [1, 3])
def test_errors_of_mujocos_threads_are_raised_in_the_main_one(model, threads):
    start = np.empty(mujoco.mj_stateSize(model, FULL))
    mujoco.mj_getState(model, falling(model), start, FULL)
    with pytest.raises(ArithmeticError, match="the skin tore"):
        mujoco.rollout.rollout(
            model, [mujoco.MjData(model) for _ in range(threads)], np.stack([start] * 4), nstep=9
        )


def test_the_default_warns_and_goes_on():
    model = model_of()
    with pytest.warns(RuntimeWarning, match="the skin tore"):
        run(model)
    with pytest.raises(ArithmeticError, match="the skin tore"):
        biotac_mj.plugin.check()


def test_a_kept_error_does_not_keep_the_model():
    class Big:
        pass

    class Holding(Tearing):
        def solve_skin(self, state, geom_pos, geom_mat, dt, **more):
            local = Big()
            alive.append(weakref.ref(local))
            return super().solve_skin(state, geom_pos, geom_mat, dt, **more)

    alive = []
    register_stepper("holding", Holding)
    with pytest.warns(RuntimeWarning, match="the skin tore"):
        run(model_of(stepper="holding"))
    gc.collect()
    assert alive and not any(ref() for ref in alive)
    biotac_mj.plugin.clear_errors()


@pytest.fixture
def heeded():
    """SIGINT, which a job in the background of a shell ignores, and with it all that it starts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_ends_the_loop_within_its_step(heeded):
    """Wherever in a step it comes, and nothing is left half done."""
    model, wait = model_of(stepper="springs"), np.random.default_rng(0)
    data, late = mujoco.MjData(model), collections.Counter()

    def interrupt(seconds):
        nonlocal at
        time.sleep(seconds)
        at = steps
        os.kill(os.getpid(), signal.SIGINT)

    for _ in range(25):
        steps, at = 0, None
        thread = threading.Thread(target=interrupt, args=(wait.uniform(0.0, 0.02),))
        try:
            thread.start()
            while steps < 5000:
                mujoco.mj_step(model, data)
                steps += 1
            late["never"] += 1
        except KeyboardInterrupt:
            late[steps - at] += 1
        thread.join()
    assert late["never"] == 0 and max(late) <= 1
    assert data.sensor("b_status").data[0] == 1


_LOOP = """
import mujoco, biotac_mj
spec = mujoco.MjSpec()
ball = spec.worldbody.add_body(name="ball", pos=(-12e-3, -11.5e-3, 0))
ball.add_freejoint()
ball.add_geom(size=[3.5e-3, 0, 0], mass=0.01)
biotac_mj.attach(spec, body="world", skin="coarse", tier="condensed", readings="none")
model = spec.compile()
data = mujoco.MjData(model)
mujoco.mj_step(model, data)
print("steps", flush=True)
while True:
    mujoco.mj_step(model, data)
"""


@pytest.mark.slow
def test_ctrl_c_ends_a_program_that_steps(heeded):
    program = subprocess.Popen(
        [sys.executable, "-c", _LOOP], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert program.stdout.readline() == "steps\n"  # and nothing else: Warp's start is silent
    program.send_signal(signal.SIGINT)
    _, errors = program.communicate(timeout=60)
    assert program.returncode == -signal.SIGINT and errors.rstrip().endswith("KeyboardInterrupt")


def test_compiling_is_announced(monkeypatch, tmp_path, capsys):
    import warp as wp

    from biotac_mj.quiet import announce_compilation

    wp.init()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    announce_compilation("cpu")
    assert "compiling kernels for the CPU, once" in capsys.readouterr().err
    (tmp_path / "wp_biotac_mj.skin.liquid_0").mkdir()
    (tmp_path / "wp_biotac_mj.skin.liquid_0" / "liquid.cpp").touch()
    announce_compilation("cpu")
    assert capsys.readouterr().err == ""


def test_threads_share_the_headers_that_a_press_compiles_first(monkeypatch, tmp_path):
    import warp as wp

    from biotac_mj.quiet import headers
    from biotac_mj.skin.program import _share_headers

    wp.init()
    runtime = wp._src.context.runtime
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(runtime, "_pch_dirs", {})
    monkeypatch.setattr(wp, "load_module", lambda *_, **__: runtime.get_clang_pch_dir())
    thread = headers.__wrapped__().result()
    assert thread != threading.get_ident()
    _share_headers(thread)
    assert runtime.get_clang_pch_dir() == runtime._pch_dirs[thread].name
    (tmp_path / "wp_biotac_mj.skin.liquid_0").mkdir()
    (tmp_path / "wp_biotac_mj.skin.liquid_0" / "liquid.cpp").touch()
    assert headers.__wrapped__() is None  # nothing will be compiled


def test_kernels_of_every_skin_are_compiled_beside_each_other(monkeypatch):
    """A module that is not in the list any more would be compiled alone, by the first launch."""
    import warp as wp

    import biotac_mj.coupling.implicit.poses
    import biotac_mj.coupling.steppers.fem
    import biotac_mj.sensor.film.conduction  # noqa: F401
    from biotac_mj.skin import program

    loaded = []
    monkeypatch.setattr(program, "_compiling", {})
    monkeypatch.setattr(wp, "load_module", lambda module, *_, **__: loaded.append(module.name))
    program.compile_for_skin("cpu")
    program.finish_compiling()
    listed = {f"biotac_mj.{name}" for name in (*program._MAKING, *program._STEPPING)}
    assert listed == set(loaded)


def test_a_handler_of_the_users_stays():
    seen = []
    before = signal.signal(signal.SIGINT, lambda *_: seen.append(1))
    try:
        model = model_of(stepper="springs")
        mujoco.mj_step(model, mujoco.MjData(model))
        signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert seen == [1]


def test_tasks_end_with_an_error():
    pytest.importorskip("dm_control", reason="needs dm_control (extra control)")
    biotac = {"stepper": "tearing", "tier": "full", "skin": spring_skin.pad_geometry(), "readings": "none"}
    assert biotac_mj.tasks.BioTac(**biotac).handle.config.on_error == "raise"
    with pytest.raises(ValueError, match="geom 'nope' of the BioTac's settings matches none"):
        with pytest.warns(RuntimeWarning):
            biotac_mj.tasks.load("finger", "press", {"biotac": biotac | {"geoms": ["nope"]}})


# --- what is shared is freed  ---


def test_shared_values_live_while_held_and_the_last_longer():
    class Value:
        pass

    made = []
    shared = Shared(keep=2)

    def make(key):
        return shared.get(key, lambda: made.append(key) or Value())

    held = make("a")
    make("b"), make("c")
    assert make("a") is held and made == ["a", "b", "c"]
    make("b")
    assert made == ["a", "b", "c", "b"]  # it had gone, "c" came after it
    shared.forget()
    assert make("a") is not held


def test_leftovers_of_an_earlier_user_are_freed_first():
    class Value:
        pass

    shared = Shared(keep=8)
    alive = [weakref.ref(shared.get(key, Value)) for key in "ab"]
    shared.turn()
    shared.get("a", None)  # it is used again
    assert alive[1]() is not None
    shared.get("c", lambda: Value() if alive[1]() is None else None)
    assert alive[0]() is not None and alive[1]() is None


def test_models_leave_no_skins_behind():
    """Each new material is many megabytes: only the last model's skins wait for its next mjData."""
    from biotac_mj.coupling import setup

    before = set(setup._skins._living)
    for n in range(4):
        model = model_of(material={"youngs_modulus": 3.21e5 + n})
        mujoco.mj_step(model, mujoco.MjData(model))
        del model
    gc.collect()
    assert len(set(setup._skins._living) - before) == 1


@pytest.mark.parametrize("tier", [pytest.param("full", marks=pytest.mark.slow), "condensed"])
def test_a_skin_is_freed_with_its_last_model(tier):
    """At once: what it recorded and what that works on are no circle that waits for the collector."""
    from biotac_mj.coupling import setup
    from biotac_mj.coupling.steppers import fem

    model = model_of(stepper="fem", skin="coarse", tier=tier, material={"youngs_modulus": 4.321e5})
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    world = sys.modules["biotac_mj.plugin.engine"]._worlds[data._address]
    alive = weakref.ref(world.instances[0].setup.skin.stepper._model)
    setup._skins.forget(), fem._models.forget()
    assert alive() is not None
    gc.disable()
    try:
        del data, model, world
        assert alive() is None
    finally:
        gc.enable()
