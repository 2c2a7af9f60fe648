"""The condensed tier of many worlds against one skin, whose state goes through a `Memory` in each step."""

import functools

import mujoco
import numpy as np
import pytest
import warp as wp

import biotac_mj
from biotac_mj.coupling.config import Config
from biotac_mj.coupling.steppers.fem import shared_model, skin_settings
from biotac_mj.geometry.skins import skin_reference
from biotac_mj.skin import GeomSet, SkinData
from biotac_mj.skin.condensed import CondensedSkin, CondensedStep, LinearSkin, Memory
from biotac_mj.skin.condensed.solve import phases
from biotac_mj.skin.contact.outside import leave_skin
from biotac_mj.skin.newton.worlds import BLOCK
from biotac_mj.skin.settings import Settings
from biotac_mj.skin.state import CONDENSED
from biotac_mj.skin.state_arrays import StateArrays

DEVICE = "cuda:0" if wp.is_cuda_available() else "cpu"
STILL = np.eye(3)


@functools.cache
def model(device="cpu", material=None, **skin):
    config = Config(name="b_", skin="coarse", material=material, options={"skin": skin})
    return shared_model(skin_reference("coarse")[1], Settings(*skin_settings(config)), device)


@functools.cache
def lowest():
    return model().rest.vert[:, 1].min()


def geom(kind, nworld, device="cpu"):
    size = {"sphere": (3.5e-3, 0, 0), "box": (7e-3, 4e-3, 7e-3), "capsule": (2e-3, 6e-3, 0)}[kind]
    return GeomSet([kind], [size], friction=[0.8], nworld=nworld, device=device), size[kind == "box"]


class Worlds:
    """`nworld` skins and one geom."""

    def __init__(self, kind, nworld=2, geoms=None, **settings):
        self.geoms, self.height = geom(kind, nworld, DEVICE)
        self.geoms = geoms or self.geoms
        self.data = SkinData(model(DEVICE, **settings), nworld)
        self.step = CondensedStep(
            model(DEVICE, **settings), LinearSkin.of(model(**settings)), self.data, self.geoms
        )
        self.tangent = wp.zeros((1, nworld), dtype=wp.spatial_matrixd, device=DEVICE)
        self.nworld = nworld
        self.geoms.struct.pos_last.fill_(wp.vec3d(np.nan, np.nan, np.nan))

    def press(self, pos, mat=STILL):
        """To poses (nworld, 3), or one of all; at first from outside, as those of a batch."""
        touching, outer = self.geoms.struct, model(DEVICE).outer
        touching.pos.assign(np.broadcast_to(pos, (self.nworld, 3))[None].copy())
        touching.mat.assign(np.broadcast_to(mat, (1, self.nworld, 3, 3)).copy())
        known = [self.data.worlds.wanted, outer.face, model(DEVICE).sample, self.data.rest_vert, touching]
        out = [touching.pos_last, touching.mat_last]
        blocks = dict(dim=out[0].shape, block_dim=BLOCK, device=DEVICE)
        wp.launch_tiled(leave_skin, inputs=known, outputs=out, **blocks)
        self.step.launch(self.tangent)
        return self.data.geom_memory(1, 1)[2].numpy()[0].copy()

    @property
    def pressure(self):
        return self.data.worlds.pressure.numpy() - self.data.rest_pressure.numpy()

    @property
    def reason(self):
        return self.data.worlds.reason.numpy()


def way(height, steps, depth=1.2e-3, slide=0.8e-3):
    """From just above the pad into it, and along it."""
    share = np.linspace(0, 1, steps)
    x = -12e-3 + slide * np.maximum(share - 0.5, 0)
    y = lowest() - height - 0.05e-3 + (depth + 0.05e-3) * np.minimum(2 * share, 1)
    return np.stack([x, y, 0.4e-3 * share], 1)


@pytest.mark.slow
@pytest.mark.skipif(DEVICE != "cpu", reason="on CUDA there are phases alone")
def test_phases_in_turns_do_what_one_kernel_does():
    """Two worlds that are out of step with each other: to the bit."""
    together, parted = Worlds("sphere"), Worlds("sphere")
    parted.step._phases = phases(parted.geoms.shapes)
    for i, pos in enumerate(way(together.height, 12)):
        poses = np.stack([pos, pos + [0, 0.3e-3 if i > 5 else -0.2e-3, 0]])
        expected, found = together.press(poses), parted.press(poses)
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(parted.data.x.numpy(), together.data.x.numpy())
    assert (np.abs(expected[:, 1]) > 0.5).all() and (together.reason == 0).all()


@pytest.mark.parametrize("kind", ["sphere", "capsule", pytest.param("box", marks=pytest.mark.slow)])
def test_worlds_press_as_one_skin_does(kind):
    many = Worlds(kind)
    one = CondensedSkin(model(), geom(kind, 1)[0])
    memory = Memory.rest(1)
    for pos in way(many.height, 24):
        out = one.solve(memory, pos[None], STILL[None])
        memory = out.memory
        wrench = many.press(pos)
        assert (many.reason == 0).all() and out.converged
        largest = np.abs(out.wrench[0]).max()
        np.testing.assert_array_equal(wrench[0], wrench[1])
        if DEVICE == "cpu":
            np.testing.assert_allclose(wrench[0], out.wrench[0], atol=1e-4 * largest)
            np.testing.assert_allclose(many.data.x.numpy()[:, 0], out.vert_xpos, atol=1e-7)
        # friction at an edge depends on how the balance was found
        np.testing.assert_allclose(wrench[0], out.wrench[0], atol=(5e-2 if kind == "box" else 5e-3) * largest)
        np.testing.assert_allclose(many.pressure[0], memory.pressure, rtol=5e-3, atol=2.0)
        if kind == "box":
            continue
        np.testing.assert_allclose(many.data.x.numpy()[:, 0], out.vert_xpos, atol=2e-5)
        if largest > 0.1:  # one sample that slips or does not is most of a light touch's stiffness
            stiff = many.tangent.numpy()[0, 0]
            np.testing.assert_allclose(stiff, out.tangent[0], atol=0.05 * np.abs(out.tangent[0]).max())
    assert -wrench[0, 1] > 0.3  # it was a press


@pytest.mark.parametrize(
    "settings",
    [
        {"bulk_modulus": np.inf},
        {"liquid": False},
        pytest.param({"rest_pressure": 3e3}, marks=pytest.mark.slow),
        pytest.param({"material": "ansys"}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_liquids_and_materials_are_those_of_one_skin(settings):
    many = Worlds("sphere", 1, **settings)
    one, memory = CondensedSkin(model(**settings), geom("sphere", 1)[0]), Memory.rest(1)
    for pos in way(many.height, 12):
        out = one.solve(memory, pos[None], STILL[None])
        memory = out.memory
        wrench = many.press(pos)
    assert many.reason[0] == 0 and many.step.tier.numpy()[0] == (1 if out.measured else -1)
    np.testing.assert_allclose(wrench[0], out.wrench[0], atol=5e-3 * np.abs(out.wrench).max())
    np.testing.assert_allclose(many.pressure[0], memory.pressure, rtol=5e-3)


@pytest.mark.law
def test_a_wide_contact_is_that_of_the_single_skin():
    """A plane of which the coarse skin touches with more than a hundred nodes."""
    geoms = [GeomSet(["plane"], [(0, 0, 0)], friction=[0.8], nworld=1, device=d) for d in (DEVICE, "cpu")]
    many, one, memory = Worlds("sphere", 1, geoms=geoms[0]), CondensedSkin(model(), geoms[1]), Memory.rest(1)
    up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for depth in np.arange(-0.1e-3, 2.01e-3, 0.15e-3):
        pos = np.array([-12e-3, lowest() + depth, 0])
        out = one.solve(memory, pos[None], up[None])
        memory = out.memory
        wrench = many.press(pos, up)
    outer = memory.coordinate < 3 * len(one.linear.node)
    touched = len(np.unique(memory.coordinate[outer] // 3)) + np.count_nonzero(~outer)
    assert touched > 112 and many.reason[0] == 0 and out.converged
    np.testing.assert_allclose(wrench[0], out.wrench[0], atol=0.01 * np.abs(out.wrench).max())


def test_skin_that_meets_its_core():
    many, one, memory = Worlds("sphere", 1), CondensedSkin(model(), geom("sphere", 1)[0]), Memory.rest(1)
    for depth in np.arange(0.3e-3, 2.31e-3, 0.25e-3):
        pos = np.array([-12e-3, lowest() - many.height + depth, 0])
        out = one.solve(memory, pos[None], STILL[None])
        memory = out.memory
        wrench = many.press(pos)
        assert many.reason[0] == 0 and out.converged
        np.testing.assert_allclose(wrench[0], out.wrench[0], atol=0.02 * np.abs(out.wrench[0]).max())
    # nodes tell how far the surfaces overlap; on CUDA the grid of the core is another
    near = 2e-8 if DEVICE == "cpu" else 2e-5
    np.testing.assert_allclose(many.data.x.numpy()[:, 0], out.vert_xpos, atol=near)
    core = many.step.remembered.core_force.numpy().sum()
    loaded = memory.coordinate >= 3 * len(one.linear.node)
    assert core > 0.1  # the core carries some of it
    np.testing.assert_allclose(core, memory.force[loaded].sum(), rtol=0.02)


def test_worlds_go_their_own_ways():
    """Each ends where it would alone; one that is far off does nothing, one without a pose stays."""
    places = [0.2e-3, 0.9e-3, -5e-3, np.nan]
    many = Worlds("sphere", 4)
    for share in (0.5, 1.0):
        pos = np.array([[-12e-3, lowest() - many.height + share * d, 0] for d in places])
        wrench = many.press(pos)
    for w in (0, 1):
        alone = Worlds("sphere", 1)
        for share in (0.5, 1.0):
            found = alone.press([-12e-3, lowest() - alone.height + share * places[w], 0])
        np.testing.assert_array_equal(found[0], wrench[w])
    assert many.reason.tolist() == [0, 0, 0, 1]
    assert not wrench[2].any()


def test_moduli_and_frictions_of_worlds():
    """Forces go with Young's modulus where contact and liquid do too; without friction none is along the
    pad."""
    many = Worlds("sphere", 3)
    st = many.data.worlds
    for array in (st.mu, st.lam, st.contact_stiffness, st.kappa):
        array.assign(array.numpy() * np.array([1.0, 2.0, 1.0]))
    many.geoms.set_friction(np.array([[0.8], [0.8], [0.0]]))
    for pos in way(many.height, 16):
        wrench = many.press(pos)
    assert (many.reason == 0).all()
    np.testing.assert_allclose(wrench[1], 2 * wrench[0], rtol=2e-3, atol=1e-4)
    assert abs(wrench[2, 0]) < 0.5 * abs(wrench[0, 0])


def test_a_jump_ends_where_small_steps_do():
    many, slowly = Worlds("sphere", 1), Worlds("sphere", 1)
    deep = np.array([-12e-3, lowest() - many.height + 1.8e-3, 0])
    many.press(deep - [0, 3e-3, 0])
    wrench = many.press(deep)
    for share in np.linspace(0, 1, 12):
        expected = slowly.press(deep - [0, 2e-3 * (1 - share), 0])
    assert many.reason[0] == 0
    np.testing.assert_allclose(wrench[0], expected[0], atol=0.03 * np.abs(expected).max())


def test_a_first_step_inside_is_that_of_one_skin():
    many = Worlds("sphere", 1)
    deep = np.array([-12e-3, lowest() - many.height + 1.8e-3, 0])
    wrench = many.press(deep)
    out = CondensedSkin(model(), geom("sphere", 1)[0]).solve(Memory.rest(1), deep[None], STILL[None])
    assert many.reason[0] == 0 and out.converged
    np.testing.assert_allclose(wrench[0], out.wrench[0], atol=5e-3 * np.abs(out.wrench).max())


def test_a_geom_in_the_core_is_not_followed():
    many = Worlds("sphere", 1)
    pos = np.array([-12e-3, lowest() - many.height + 0.5e-3, 0])
    before = many.press(pos)
    wrench = many.press(pos + [0, 6e-3, 0])
    st = many.data.worlds
    assert many.reason[0] == 2 and 0 < st.load_factor.numpy()[0] < 1 and st.nonconverged.numpy()[0] == 1
    assert np.isfinite(wrench).all() and -wrench[0, 1] > -before[0, 1]
    again = many.press(pos)
    assert many.reason[0] == 0
    np.testing.assert_allclose(again[0, 1], before[0, 1], rtol=0.05)


def ball(tier, attach=True):
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 2e-3, [0, 9.81, 0]
    body = spec.worldbody.add_body(name="ball", pos=[-0.012, -0.0111, 0])
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0])
    body.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[3.5e-3, 0, 0], mass=0.01)
    if attach:
        biotac_mj.attach(spec, body="world", skin="coarse", tier=tier, readings="none")
    return spec


def batch_of(mjm, nworld=2, **settings):
    mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
    mjd = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, mjd)
    with wp.ScopedDevice(DEVICE):
        m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=nworld)
        b = biotac_mj.batch.attach(mjm, m, d, skin="coarse", readings=False, **settings)
    return m, d, b, lambda: mjw.step(m, d)


def test_a_ball_comes_to_rest_as_in_mj_step():
    spec = ball("condensed", attach=False)
    biotac_mj.batch.add(spec, body="world", skin="coarse")
    mjm = spec.compile()
    m, d, b, step = batch_of(mjm, tier="condensed")
    one = ball("condensed").compile()
    data = mujoco.MjData(one)
    force, status = mjm.sensor("biotac_contact_force").adr[0], mjm.sensor("biotac_status").adr[0]
    with wp.ScopedDevice(DEVICE):
        for _ in range(40):
            step()
            mujoco.mj_step(one, data)
            found = d.sensordata.numpy()[1]
            here = data.sensor("biotac_contact_force").data[:3]
            np.testing.assert_allclose(found[force : force + 3], here, atol=4e-3)
            assert found[status] == 1 and found[status + 4] == 1
        np.testing.assert_allclose(d.qpos.numpy()[:, 0], data.qpos[0], atol=1e-6)
        mask = wp.array([True, False], dtype=bool)
        b.reset(mask)
        assert not b.skin._condensed.remembered.force.numpy()[:, 0].any()
        assert b.skin._condensed.remembered.force.numpy()[:, 1].any()


def test_what_the_tier_cannot_do_is_said():
    spec = ball("condensed", attach=False)
    biotac_mj.batch.add(spec, body="world", skin="coarse")
    mjm = spec.compile()
    soft = [{"poissons_ratio": nu} for nu in (0.3, 0.35)]
    for settings, words in (
        ({"material": soft}, "one poissons_ratio"),
        ({"worlds": {"fill_volume": [0.0, 1e-9]}}, "one rest"),
        ({"worlds": {"modulus": np.ones((2, len(skin_reference("coarse")[1].elem)))}}, "one map"),
        ({"options": {"skin": {"dynamics": "implicit"}}}, "has no inertia"),
        ({"worlds": {"adhesion": 0.05}}, "Coulomb's law alone"),
        ({"material": {"prony": [[0.2, 0.1]]}}, "is elastic"),
    ):
        with pytest.raises(ValueError, match=words):
            batch_of(mjm, tier="condensed", **settings)
    with pytest.raises(ValueError, match="choose"):
        batch_of(mjm, tier="quick")
    with pytest.raises(ValueError, match="keep the filling"):
        batch_of(mjm, tier="condensed")[2].skin.data.set_liquid(fill_volume=1e-8)


def test_a_skin_that_is_put_to_rest_is_within_what_was_measured():
    many = Worlds("sphere")
    for depth in (1e-3, 2e-3, 2.8e-3):
        many.press([-12e-3, lowest() - many.height + depth, 0])
    assert many.step.tier.numpy().tolist() == [-1, -1]
    state = StateArrays(many.data, many.geoms, CONDENSED, **many.step.holders)
    state.prepare()
    state.reset_skin(wp.array([True, False], dtype=bool, device=DEVICE))
    assert many.step.tier.numpy().tolist() == [1, -1]
