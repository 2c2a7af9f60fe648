"""Several BioTacs in a batch that hold one body, or hang on one finger: what is corrected for the
integrator's accelerations is found for all of them together; and what gives energy all the same does not
act."""

import os
import pathlib
import sys

import mujoco
import numpy as np
import pytest
import warp as wp
from scipy.linalg import block_diag

mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
sys.path.insert(0, str(pathlib.Path(__file__).parent))

# ruff: noqa: E402
from test_batch import ball_spec, make, read, shell

from biotac_mj import batch as batches
from biotac_mj.batch.batch import Batch
from biotac_mj.batch.implicit import integrator
from biotac_mj.coupling.implicit import energy, rounds
from biotac_mj.coupling.implicit.rounds import Marks

SKINS, NV, WORLDS, H2 = 3, 8, 16, 1.6e-5


def problem(seed, free):
    """Random synthetic mechanics of one world: Jacobians (skins, nv, 6), stiffnesses [N/m] of soft fingers
    (skins, 6, 6), accelerations without forces, M, M with what holds, and M - h D of light, heavily damped
    joints, the first six maybe those of a free body that spins fast."""
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(size=(SKINS, NV, 6)) * [1, 1, 1, 30, 30, 30]
    root = rng.normal(size=(SKINS, 6, 6)) * np.array([30, 30, 30, 0.1, 0.1, 0.1])[:, None]
    stiffness = root @ np.swapaxes(root, 1, 2) / 6
    mass = np.diag(rng.uniform(0.005, 0.02, NV)) + 1e-3
    damping = np.diag(rng.uniform(0.0, 5.0, NV))  # times the time step: up to four masses
    damped = mass + 4e-3 * damping
    if free:
        for matrix in (mass, damped):
            matrix[:6, 6:] = matrix[6:, :6] = 0.0
        spin = rng.normal(size=(6, 6)) * 0.02
        damped[:6, :6] += spin - spin.T
    held = mass + sum(H2 * j @ s @ j.T for j, s in zip(jacobian, stiffness))
    return jacobian, stiffness, np.linalg.solve(held, rng.normal(size=NV)), mass, held, damped


def corrected(steps, free):
    """What is left amiss [N] of the largest force, in each of the worlds, after so many steps."""
    worlds = [problem(w, free) for w in range(WORLDS)]
    jacobian, stiffness, first, mass, held, damped = (np.array(x) for x in zip(*worlds))
    entries = np.tril_indices(NV)
    count = np.arange(NV)
    with wp.ScopedDevice("cpu"):
        c = integrator.corrections(SKINS, WORLDS, NV)
        symmetric = (damped + damped.swapaxes(1, 2)) / 2
        factors = [wp.array(np.linalg.cholesky(a), dtype=wp.float64) for a in (held, symmetric)]
        factors += [wp.array(mass[:, *entries], dtype=float)]
        factors += [wp.array(a.astype(np.int32), dtype=int) for a in (count + 1, count * (count + 1) // 2)]
        factors += [wp.array(entries[1].astype(np.int32), dtype=int)]
        driven = np.zeros((6, WORLDS, NV))
        driven[..., :6] = np.linalg.inv(damped[:, :6, :6]).transpose(2, 0, 1)
        factors += [wp.zeros(int(free), dtype=int), wp.zeros(1, dtype=int), wp.array(driven, dtype=float)]
        c.jacobian.assign(np.ascontiguousarray(jacobian.swapaxes(0, 1)))
        c.model.tangent0.assign(np.ascontiguousarray(stiffness.swapaxes(0, 1)))
        c.square.fill_(H2)
        again = wp.zeros(1, dtype=int)
        wp.launch(integrator.begin_correction, WORLDS, [wp.ones(WORLDS, dtype=int), c])
        for left in range(steps, -1, -1):
            force = np.einsum("wkni,kwi->wn", jacobian, c.force.numpy())
            found = first + np.linalg.solve(held, force[:, :, None])[:, :, 0]
            moved = np.linalg.solve(damped, mass @ found[:, :, None])[:, :, 0]
            both = [wp.array(x, dtype=float) for x in (found, moved)]
            wp.launch(integrator.find_amiss, (WORLDS, 1), [*both, c, again])
            if left == 0:
                break
            wp.launch(integrator.respond, (WORLDS, 6 * SKINS), [*factors, c])
            wp.launch(integrator.write_slope, (WORLDS, SKINS, 6 * SKINS), [c])
            wp.launch(integrator.step, (WORLDS, 1), [c])
        left, size = c.amiss.numpy(), c.force.numpy()
    return np.abs(left).max(axis=(0, 2)) / np.abs(size).max(axis=(0, 2))


@pytest.mark.parametrize("free", [False, True])
def test_skins_on_the_same_joints_are_corrected_together(free):
    assert corrected(2, free).max() < 2e-4


def test_a_skin_that_does_not_act_lacks_nothing():
    """Nor does one that has let go: what its last model took is dropped before bodies are accelerated."""
    with wp.ScopedDevice("cpu"):
        c, still = integrator.corrections(4, 2, 1), wp.zeros((2, 1), dtype=float)
        c.acts.assign([1, 0, 1, 1])
        c.force.fill_(1.0)
        c.model.tangent0.assign(np.eye(6) * np.array([1, 1, 1, 0]).reshape(4, 1, 1, 1) * np.ones((2, 1, 1)))
        wp.launch(integrator.begin_correction, 2, [wp.array([1, 0], dtype=int), c])
        force = c.force.numpy()[:, :, 0]
        wp.launch(integrator.find_amiss, (2, 1), [still, still, c, wp.zeros(1, dtype=int)])
    assert force.T.tolist() == [[1.0, 0.0, 1.0, 0.0], [1.0] * 4]  # the second world is done
    assert (c.amiss.numpy()[:, 0, 0] == force[:, 0]).all() and (c.force.numpy()[:, :, 0] == force).all()


def test_a_skin_that_exceeds_its_energy_or_is_nan_does_not_act():
    n = 3
    with wp.ScopedDevice("cpu"):
        r, model = rounds.make_rounds(1, n), rounds.Model()
        r.here_mat = wp.array(np.tile(np.eye(3), (1, n, 1, 1)), dtype=wp.mat33d)
        ways = np.zeros((1, n, 6))
        ways[0, :, 0] = 1e-3, 1e-3, 1e-3  # [m]
        missing = np.zeros((1, n, 6))
        missing[0, 2, 0] = np.nan  # accelerations that are no number, of bodies that were sound
        r.straight.assign(ways)
        r.travel.assign(ways + missing)
        r.left, r.store, r.most = (wp.full((1, n), x, dtype=wp.float64) for x in (1e-4, 1e-4, 1e-3))
        wrench = np.zeros((1, n, 6))
        wrench[0, :, 0] = 5.0, 0.05, 0.05  # [N]: 5 mJ and 0.05 mJ of 0.1
        r.acting.assign(wrench + missing)
        model.wrench0 = wp.array(wrench, dtype=wp.spatial_vectord)
        model.tangent0 = wp.array(np.tile(np.eye(6), (1, n, 1, 1)), dtype=wp.spatial_matrixd)
        going, every = Marks(n), wp.ones(n, dtype=int)
        model_before = model.tangent0.numpy()[0, 1]
        # bodies that do not give way get the share of a push that gives what they have; where that was not
        # enough, or what acts is no number, the skin does not act
        known = [0.0, rounds.Solid(), wp.zeros((1, 1, n), dtype=wp.spatial_matrixd)]
        start = wp.array(np.full((n, 4), np.nan), dtype=float)
        wp.launch(energy.restrain, n, [every, *known, model, r, start, going.struct])
        share, whole = r.push.numpy()[0, :2] / (1e-4 / 5e-3, 1.0)
        assert 0.95 < share < 1.0 and whole == 1.0
        assert going.world.numpy().tolist() == [1, 0, 1]
        assert r.settled.numpy().all() and model.wrench0.numpy().any(axis=2).all()
        for changed in ([1, 0, 1], [1, 0, 0], [0, 0, 0]):
            going.clear()
            wp.launch(energy.restrain, n, [every, *known, model, r, start, going.struct])
            assert going.world.numpy().tolist() == changed
    assert np.isnan(start.numpy()[1]).all() and not start.numpy()[[0, 2]].any()
    assert r.push.numpy().tolist() == [[0, 1, 0]] and r.settled.numpy().tolist() == [0, 1, 0]
    for array in (model.wrench0, model.tangent0, r.withheld):
        assert not array.numpy()[0, [0, 2]].any()
    np.testing.assert_array_equal(model.tangent0.numpy()[0, 1], model_before)


def test_a_skin_that_does_not_act_leaves_bodies_to_themselves(monkeypatch):
    """What a ball on the pad does in the one step in which its skin is let go is its fall; then it is held
    again."""
    mjm, m, d, skin = make(ball_spec(), 2, options={"loss": 2.0})  # it comes to rest soon
    down, at = mjm.opt.gravity[1] * mjm.opt.timestep, mjm.sensor("biotac_contact_force").adr[0]
    for _ in range(30):
        mjw.step(m, d)
    force = d.sensordata.numpy()[:, at : at + 3]
    assert (np.linalg.norm(force, axis=1) > 0.02).all()  # it lies there
    known = d.qvel.numpy()[:, 0].copy()
    with monkeypatch.context() as patch:
        restrain, once = Batch.restrain, iter([1])

        def lets_go(self, d, taking_part, going):
            if next(once, 0):  # a push that gains although some of it is withheld
                r = self._of_step
                r.push.assign([[1.0, 0.0]])
                travel = r.travel.numpy()
                travel[0, 1] = r.acting.numpy()[0, 1]
                r.travel.assign(travel)
            restrain(self, d, taking_part, going)

        patch.setattr(Batch, "restrain", lets_go)
        mjw.step(m, d)
    read, speed = d.sensordata.numpy(), d.qvel.numpy()[:, 0]
    np.testing.assert_allclose(speed[1] - known[1], down, rtol=1e-4)
    assert abs(speed[0] - known[0]) < 0.5 * down
    status = mjm.sensor("biotac_status").adr[0]
    assert not read[1, at : at + 6].any() and read[0, at : at + 3].any()
    assert read[:, status].tolist() == [1, 0] and read[1, status + 7] == 1.0
    for _ in range(60):
        mjw.step(m, d)
    np.testing.assert_allclose(d.sensordata.numpy()[1, at + 1], 0.0981, rtol=0.01)  # its weight


def test_a_world_that_is_lost_changes_no_bit_of_others():
    """Of several skins on one body, too: what was no number before the step asks for no further solution."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 4e-3, [0, 0, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    ball = spec.worldbody.add_body(name="ball")
    ball.add_freejoint()
    ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[8e-3, 0, 0], mass=0.02)
    for k in range(2):  # pads of two fingers on slides, opposite each other
        sign = 1 - 2 * k
        finger = spec.worldbody.add_body(
            name=f"finger{k}", pos=[sign * 0.012, sign * 0.0152, 0], quat=[1 - k, 0, 0, k]
        )
        finger.mass, finger.inertia, finger.explicitinertial = 0.01, [1e-6] * 3, True
        finger.add_joint(name=f"in{k}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, -1, 0], damping=1.0)
        push = spec.add_actuator(name=f"push{k}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=f"in{k}")
        push.gainprm[0] = 1.0
    for k in range(2):
        batches.add(spec, body=f"finger{k}", prefix=f"f{k}_", skin=shell(), geoms=["ball"])
    mjm = spec.compile()
    mjd = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, mjd)

    def run(lost):
        m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=2, njmax=120)
        skins = [
            batches.attach(mjm, m, d, prefix=f"f{k}_", skin=shell(), readings=False, geoms=["ball"])
            for k in range(2)
        ]
        d.ctrl.fill_(0.3)
        out = []
        for i in range(18):
            if lost and i == 13:
                speed = d.qvel.numpy()
                speed[1, 3] = np.nan
                d.qvel.assign(speed)
            mjw.step(m, d)
            out.append(np.concatenate([d.qpos.numpy()[0], d.sensordata.numpy()[0]]))
        if not lost:
            jacobian = [one._jacobian.numpy()[:, 0].transpose(0, 2, 1).reshape(-1, mjm.nv) for one in skins]
            tangent = [S for one in skins for S in one.model.tangent0.numpy()[:, 0]]
            J = np.concatenate(jacobian)
            inertia = np.zeros((mjm.nv, mjm.nv))
            mujoco.mj_fullM(mjm, mjd, inertia)  # joints that slide, and a ball: the same in all poses
            modes = np.linalg.eigvals(J @ np.linalg.solve(inertia, J.T) @ block_diag(*tangent)).real
            stiffest.append(np.sqrt(modes.max()))
            frequency.extend(one._of_step.frequency.numpy()[:, 0].max() for one in skins)
        return np.array(out), [float(np.abs(one.wrench[0]).max()) for one in skins]

    frequency, stiffest = [], []
    (sound, force), (beside, _) = run(False), run(True)
    assert min(force) > 0.2  # both fingers hold the ball [N]
    # both make it bounce, and each knows
    np.testing.assert_allclose(frequency, stiffest[0], rtol=0.1)
    np.testing.assert_array_equal(beside, sound)


TUMBLING = [(0.1, [0.0, 0.0, 0.0]), (1.0, None), (0.4, [3.0, 50.0, -20.0]), (1.0, [20.0, -40.0, 30.0])]


def tumbling(tier, throws):
    """Positions, speeds and readings (step, number) of a light box in each world, thrown at a pad with speed
    [m/s] and spin [rad/s], or far above it (no spin); and rounds (step, world)."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 4e-3, [0, 9.81, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    box = spec.worldbody.add_body(name="box", pos=[-0.009, -0.0107, 0.001])
    box.add_freejoint()
    box.add_geom(
        name="box", type=mujoco.mjtGeom.mjGEOM_BOX, size=[4e-3, 3e-3, 3.5e-3], mass=2.4e-3, density=0
    )
    batches.add(spec, body="world", skin=shell())
    mjm = spec.compile()
    mjd = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, mjd)
    m = mjw.put_model(mjm)
    d = mjw.put_data(mjm, mjd, nworld=len(throws), nconmax=16, njmax=60)
    batches.attach(mjm, m, d, skin=shell(), tier=tier, readings={"noise": False})
    qpos, qvel = d.qpos.numpy(), d.qvel.numpy()
    for w, (speed, spin) in enumerate(throws):
        qvel[w, 1] = speed
        if spin is None:
            qpos[w, 1] -= 0.02
        else:
            qvel[w, 3:] = spin
    d.qpos.assign(qpos)
    d.qvel.assign(qvel)
    out, rounds = [], []
    for _ in range(12):
        mjw.step(m, d)
        out.append(np.concatenate([d.qpos.numpy(), d.qvel.numpy(), d.sensordata.numpy()], axis=1))
        rounds.append(read(mjm, d, "status")[:, 5].copy())
    return np.array(out), np.array(rounds)


@pytest.mark.parametrize(
    "tier, throws",
    [("condensed", TUMBLING), pytest.param("full", TUMBLING[:3], marks=pytest.mark.slow)],  # quick: the lost
)
def test_a_world_is_the_same_to_the_bit_beside_any_others(tier, throws):
    """Whether its skin settles at once, sleeps until a box comes, or needs rounds of its own: what the others
    of the batch still do changes nothing in it."""
    found, rounds = tumbling(tier, throws)
    assert (rounds[:, 0] == 1).all() and rounds[:, 2:].max() > 1  # the others need more
    for w in (0, 1, 3):
        if w < len(throws):
            alone, _ = tumbling(tier, [throws[w]])
            np.testing.assert_array_equal(found[:, w], alone[:, 0])


HAND = pathlib.Path(os.environ.get("MENAGERIE_ROOT", "mujoco_menagerie")) / "shadow_hand" / "right_hand.xml"
needs_hand = pytest.mark.skipif(not HAND.is_file(), reason="set MENAGERIE_ROOT to a folder with shadow_hand")


@needs_hand
@pytest.mark.slow
def test_a_rod_between_three_fingers_stays_there():
    """It was thrown at 1e9 m/s in the 36th step of one of three worlds."""
    torch = pytest.importorskip("torch")
    from biotac_mj.tasks.batched import RollRod

    env = RollRod(HAND, num_envs=3, device="cpu")
    draw = torch.Generator().manual_seed(3)
    for _ in range(9):
        _, _, terminated, _, _ = env.step(0.5 * torch.randn(3, env.num_actions, generator=draw))
        assert not terminated.any()
    speed = env.qvel.abs()
    assert torch.isfinite(speed).all() and speed.max() < 20.0
    assert sum(int(b.failed.numpy().sum()) for b in env.batches.values()) == 0


def test_a_body_that_the_engine_has_lost_is_owed_nothing():
    """Its work is no number: both it and a sound body beside it were owed the most that the skin can hold."""
    with wp.ScopedDevice("cpu"):
        r, left = rounds.make_rounds(2, 1), wp.zeros((2, 1), dtype=wp.float64)
        r.acting.assign(np.tile([1.0, 0, 0, 0, 0, 0], (2, 1, 1)))
        r.travel.assign(np.array([[[np.nan] * 6], [[-0.25, 0, 0, 0, 0, 0]]]))
        for pose in (r.here_mat, r.end_mat):
            pose.assign(np.tile(np.eye(3), (2, 1, 1, 1)))
        r.most.fill_(1.0)
        every, reason = wp.ones(1, dtype=int), wp.zeros(1, dtype=int)
        wp.launch(energy.conclude, 1, [every, reason, r, left])
    np.testing.assert_allclose(left.numpy()[:, 0], [0.0, 0.25])
