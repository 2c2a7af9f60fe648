"""Kernels of mujoco_warp's step, found before it runs."""

import contextlib
import threading

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp

from biotac_mj import batch
from biotac_mj.batch import ahead
from biotac_mj.batch.ahead import _noted, kernels_of_step, launched_by
from biotac_mj.batch.hook import Hook
from biotac_mj.batch.implicit import integrator
from biotac_mj.skin.program import Fork

SCENE = """<mujoco><asset><mesh name="tet" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset><worldbody>
<body><freejoint/><geom type="cylinder" size=".1 .1"/></body>
<body pos="0 0 .15"><freejoint/><geom type="mesh" mesh="tet"/></body></worldbody></mujoco>"""


@wp.kernel(enable_backward=False)
def count(out: wp.array(dtype=int)):
    out[0] = 7


def test_all_that_a_step_launches_is_found_and_nothing_runs(monkeypatch):
    mjm = mujoco.MjModel.from_xml_string(SCENE)
    with wp.ScopedDevice("cpu"):
        m, d, out = mjw.put_model(mjm), mjw.make_data(mjm), wp.zeros(1, dtype=int)
        before = d.qpos.numpy().copy()
        elsewhere = []

        def step(m, d, real=mjw.step):
            # what another thread launches meanwhile is launched
            other = threading.Thread(target=lambda: wp.launch(count, 1, [], [out], device="cpu"))
            other.start()
            other.join()
            elsewhere.append(out.numpy()[0])
            real(m, d)
            elsewhere.append(d.time.numpy()[0])

        monkeypatch.setattr(mjw, "step", step)
        found = kernels_of_step(mjm, m)
        monkeypatch.undo()
        assert elsewhere == [7, 0.0]
        with launched() as needed:
            mjw.step(m, d)
    assert needed <= {module for module, _ in found}
    convex = [at for at, (module, _) in enumerate(found) if "ccd" in module.name]
    assert convex == list(range(len(convex))) and convex  # they take longest, and come first
    assert {found[at][0].options["optimization_level"] for at in convex} == {ahead._LEVEL}
    # compiled once each, for the blocks that it is launched by
    assert [found[at][1] for at in convex] == [m.block_dim.convex_ccd] * len({found[at][0] for at in convex})
    assert np.abs(d.qpos.numpy() - before).max() > 0
    hashes = [found[at][0].get_module_hash() for at in convex]
    kernels_of_step(mjm, m)  # as each BioTac of a model does
    assert [found[at][0].get_module_hash() for at in convex] == hashes


@contextlib.contextmanager
def launched():
    """Modules of the kernels that are launched meanwhile. Convex collisions are not run: each takes 7 s to
    compile."""
    found, real = set(), {name: getattr(wp, name) for name in ("launch", "launch_tiled")}

    def note(name):
        def launch(kernel, *given, **named):
            if np.prod(named["dim"] if "dim" in named else given[0]):
                found.add(kernel.module)
            if "ccd" not in kernel.module.name:
                real[name](kernel, *given, **named)

        return launch

    for name in real:
        setattr(wp, name, note(name))
    try:
        yield found
    finally:
        for name, function in real.items():
            setattr(wp, name, function)


def touched(control=None):
    """A condensed BioTac that a free ball touches, in two worlds: mjm, m, d, Batch."""
    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    ball = spec.worldbody.add_body(pos=[-12e-3, -11.5e-3, 0])
    ball.add_freejoint()
    ball.add_geom(size=[3.5e-3, 0, 0], mass=0.01)
    prefix = batch.add(spec, body="world", skin="coarse")
    mjm = spec.compile()
    mjd = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, mjd)
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=2)
    m.callback.control = control
    return mjm, m, d, batch.attach(mjm, m, d, prefix=prefix, skin="coarse", tier="condensed")


def test_what_is_launched_in_parallel_has_no_branch(monkeypatch):
    """A stream that forks from a captured one can record launches, but not Warp's conditional nodes."""
    run, forks = Fork.run, []

    def refuse(*_, **__):
        raise AssertionError("a branch or a loop in a Fork")

    def run_without(self, *branches):
        forks.append(len(branches))
        with monkeypatch.context() as inside:
            for name in ("capture_if", "capture_while"):
                inside.setattr(wp, name, refuse)
            run(self, *branches)

    with wp.ScopedDevice("cpu"):
        mjm, m, _, _ = touched()
        monkeypatch.setattr(Fork, "run", run_without)
        Hook.of(m).kernels(mjm, m)
    assert len(forks) > 10


def test_all_launches_of_a_batch_step_are_found_data_unchanged():
    with wp.ScopedDevice("cpu"):
        asked = []
        mjm, m, d, skins = touched(control=lambda m, d: asked.append(d.nworld))
        found = {module for module, _ in Hook.of(m).kernels(mjm, m)}
        assert not asked and d.time.numpy().tolist() == [0, 0] and not skins.began.numpy().any()
        with launched() as needed:
            skins.reset()
            mjw.reset_data(m, d)
            mjw.step(m, d)
    # the ball is held by nothing else: of both sides of a branch this step needs no correction
    assert needed <= found and found - needed <= {integrator.step.module}
    assert any("condensed.solve" in module.name for module in found)
    assert skins.began.numpy().all() and (np.abs(skins.wrench).max((1, 2)) > 1e-3).all()


def test_another_simulators_batch_finds_its_launches():
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="ball", mocap=True).add_geom(size=[3.5e-3, 0, 0])
    prefix = batch.add(spec, body="world", skin="coarse")
    mjm = spec.compile()
    made = batch.make(mjm, 2, "cpu", prefix=prefix, skin="coarse", tier="condensed")
    where = [wp.zeros((2, mjm.nbody), dtype=kind, device="cpu") for kind in (wp.vec3, wp.mat33, wp.vec3)]
    where[1].fill_(wp.mat33(np.eye(3)))
    xpos, ball = where[0].numpy(), mjm.body("ball").id
    xpos[:, ball] = [-12e-3, -11.5e-3, 0]
    where[0].assign(xpos)
    found = {module for module, _ in launched_by(lambda: made.step(*where))}
    assert not made.began.numpy().any()
    with launched() as needed:
        made.step(*where)
        assert made.began.numpy().all() and (np.abs(made.wrench).max((1, 2)) > 1e-3).all()
        xpos[:, ball] = 1.0  # what was touched comes to rest
        where[0].assign(xpos)
        made.step(*where)
    assert found == needed and not made.wrench.any()


def test_warp_is_itself_again_after_an_error(monkeypatch):
    def step(m, d):
        raise RuntimeError("no step")

    mjm = mujoco.MjModel.from_xml_string(SCENE)
    launch, loop = wp.launch, wp.capture_while
    with wp.ScopedDevice("cpu"):
        m = mjw.put_model(mjm)
        monkeypatch.setattr(mjw, "step", step)
        with pytest.raises(RuntimeError, match="no step"):
            kernels_of_step(mjm, m)
    assert wp.launch is launch and wp.capture_while is loop


def test_a_level_that_the_user_chose_is_kept(monkeypatch):
    mjm = mujoco.MjModel.from_xml_string(SCENE)
    with wp.ScopedDevice("cpu"):
        m = mjw.put_model(mjm)
        monkeypatch.setattr(wp.config, "optimization_level", 3)
        for module, _ in kernels_of_step(mjm, m):
            module.options["optimization_level"] = None
        assert {module.options["optimization_level"] for module, _ in kernels_of_step(mjm, m)} == {None}


def test_what_is_launched_over_nothing_is_left_out():
    @wp.kernel
    def nothing(out: wp.array(dtype=int)):
        out[wp.tid()] = 1

    found = {}
    with _noted(found), wp.ScopedDevice("cpu"):
        wp.launch(nothing, (3, 0), [wp.zeros(1, dtype=int)])
        assert not found
        wp.launch(nothing, dim=1, inputs=[wp.zeros(1, dtype=int)])
    assert [threads for _, threads in found] == [256]


def test_the_block_count_is_that_of_the_modules_own_kernels():
    """As mujoco_warp asks on CUDA for collisions of convex shapes: compiled for these blocks alone."""

    @wp.kernel(module="unique", module_options={"block_dim": 64})
    def asked_for(out: wp.array(dtype=int)):
        out[0] = 1

    found = {}
    with _noted(found):
        assert wp.get_suggested_block_size(asked_for, wp.get_device("cpu"))[0] == 64
    assert [threads for _, threads in found] == [64]
