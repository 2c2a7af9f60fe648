"""Sensors, heat and vibration of batches: each world as the single sensor, and what resets draw."""

import mujoco
import numpy as np
import pytest
import warp as wp

mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")

# ruff: noqa: E402
import test_batch
from test_batch import RADIUS, make, read, shell

import biotac_mj
from biotac_mj import batch as batches
from biotac_mj.coupling.config import Config
from biotac_mj.coupling.sensing.vibration import Shaking
from biotac_mj.coupling.stepper import Geom
from biotac_mj.coupling.steppers.fem import FemStepper
from biotac_mj.sensor.acquisition_kernels import SAMPLED, SAMPLED_PDC
from biotac_mj.sensor.heat import BODIES, MADE, Heat
from biotac_mj.sensor.materials import material_of
from biotac_mj.sensor.presets import SENSORS
from biotac_mj.skin.modes import skin_modes
from biotac_mj.skin.touched import Touched

DT = 8e-3


@pytest.fixture(scope="module", autouse=True)
def where_batches_run(default_device):
    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        yield


def place(i):
    """(3,) of the sphere in step i: down for 20 steps, then along [m]."""
    return np.array([-0.012 + 6e-5 * max(0, i - 20), -0.0108 + 4e-5 * min(i, 20), 1e-5 * max(0, i - 20)])


def press_spec():
    """That of `test_batch`, in steps in which something warms."""
    spec = test_batch.press_spec()
    spec.option.timestep = DT
    return spec


def drive(m, d, steps, first=0):
    for i in range(first, first + steps):
        at = np.tile(place(i), (d.nworld, 1, 1)).astype(np.float32)
        d.mocap_pos.assign(at)
        mjw.step(m, d)


@pytest.mark.law
def test_what_the_device_feels_is_what_one_sensor_feels():
    """`Touched`, by chunks and rows, against `Shaking.of_step`, by lists of contacts."""
    geoms = [Geom("pin", "sphere", np.array([RADIUS, 0, 0]), 0.6, 0, 0.0, None, None)]
    stepper = FemStepper(Config(coupling="one-way"), shell(), geoms)
    shaking, state = Shaking(stepper, geoms), np.zeros(stepper.nstate)
    stepper.reset(state)
    touched = Touched(stepper._data, np.array([0]), 1, skin_modes(stepper.model))
    device = touched.device  # a single sensor's, whatever the batches run on
    slid = 0
    for i in range(32):
        touched.begin()
        result = stepper.solve_skin(state, place(i)[None], np.eye(3)[None], DT)
        expected = shaking.of_step(state, result, DT)
        area, state = stepper.contact_area(result), result.state
        stepper._data.dt.fill_(DT)
        wrench = wp.array(result.wrench[:, None], dtype=wp.spatial_vectord, device=device)
        touched.end(wrench, wp.array(result.tangent[:, None], dtype=wp.spatial_matrixd, device=device))
        np.testing.assert_allclose(touched.area.numpy()[0], area, rtol=1e-12)
        if expected is None:
            assert not touched.drive.numpy().any()
            continue
        force = np.linalg.norm(result.wrench[:, :3], axis=1)
        np.testing.assert_allclose(touched.force.numpy()[0], force, rtol=1e-12)
        for name, value in zip(("drive", "gain", "slip", "area"), expected, strict=True):
            mine = getattr(touched, name).numpy()[0]
            np.testing.assert_allclose(mine, value, rtol=1e-5, atol=1e-5 * np.abs(value).max(), err_msg=name)
        slid += expected[2][0] > 1e-3
    assert slid > 3


def single(steps, **settings):
    """Readings (steps, ...) of the same press by the plugin."""
    spec = press_spec()
    handle = biotac_mj.attach(spec, body="world", skin=shell(), coupling="one-way", **settings)
    model = spec.compile()
    data = mujoco.MjData(model)
    rows = []
    for i in range(steps):
        data.mocap_pos[0] = place(i)
        mujoco.mj_step(model, data)
        rows.append({c: handle.read(data, c) for c in ("electrodes", "pdc", "pac", "tac", "tdc")})
    return {c: np.array([row[c] for row in rows]) for c in rows[0]}


# the contact with this shell is small: a hotter body than there is makes up for it
FELT = {
    "thermal": {"pin": {"material": "steel", "temperature": 3.9e3}},
    "textures": {"pin": {"roughness": 3e-5}},
}


@pytest.mark.law
def test_a_world_is_the_single_sensor():
    steps = 50
    one = single(steps, sensor="phac_f1", options={"readings": {"noise": False}}, **FELT)
    mjm, m, d, _ = make(
        press_spec(), 1, coupling="one-way", sensor="phac_f1", readings={"noise": False}, **FELT
    )
    rows = {channel: [] for channel in one}
    for i in range(steps):
        drive(m, d, 1, i)
        for channel, seen in rows.items():
            seen.append(read(mjm, d, channel).copy())
    for channel, expected in one.items():
        mine = np.array(rows[channel])
        slack = 1 + 0.02 * np.ptp(expected)  # poses are single precision, balances have a tolerance
        assert np.abs(mine[:, 0] - expected).max() <= slack, channel
    assert np.ptp(one["tac"]) > 3


def test_without_them_nothing_of_it_moves():
    def moved(**settings):
        mjm, m, d, _ = make(press_spec(), 1, coupling="one-way", readings={"noise": False}, **settings)
        drive(m, d, 45)
        return read(mjm, d, "tac")[0, 0], read(mjm, d, "pac")[0].copy()

    plain, felt = moved(), moved(**FELT)
    assert abs(plain[0] - 2047.5) <= 1 and felt[0] < 2045
    assert np.abs(felt[1] - plain[1]).max() > 15


def test_worlds_touch_other_materials_and_resets_draw_again():
    choice = {"thermal": {"pin": ["steel", "foam", "glass"]}, "sensor": "random"}
    mjm, m, d, batch = make(press_spec(), 4, coupling="one-way", seed=9, **choice)
    made = {}
    for _ in range(5):
        state = batch.senses.heat.state.numpy()[:, BODIES + MADE : BODIES + MADE + 3]
        rest = batch.senses.acquisition.state.numpy()[:, SAMPLED:SAMPLED_PDC].copy()
        for w in range(4):
            made.setdefault(w, []).append((*state[w], *rest[w]))
        batch.reset(np.array([True, True, True, False]))
    assert len(set(made[3])) == 1 and min(len(set(made[w])) for w in range(3)) > 2
    known = {material_of(name).effusivity for name in choice["thermal"]["pin"]}
    assert {row[0] for rows in made.values() for row in rows} <= known
    drive(m, d, 10)
    assert np.isfinite(d.sensordata.numpy()).all()


def test_worlds_begin_as_singles_of_their_seeds():
    """Sensor and material, whatever is drawn; a sensor of another name is another one."""
    drawn = {"sensor": "random", "randomise": ["crosstalk"], "thermal": {"pin": ["steel", "foam", "glass"]}}
    _, _, _, batch = make(press_spec(), 5, coupling="one-way", seed=9, **drawn)
    heat, counts = batch.senses.heat.state.numpy(), batch.senses.acquisition.state.numpy()
    for w in range(5):
        spec = press_spec()
        one = biotac_mj.attach(spec, body="world", skin=shell(), coupling="one-way", seed=9 + w, **drawn)
        other = biotac_mj.attach(spec, body="world", prefix="b_", skin=shell(), seed=9 + w, **drawn)
        assert one.numbers.rest != other.numbers.rest
        np.testing.assert_array_equal(counts[w, SAMPLED:SAMPLED_PDC], np.rint(one.numbers.rest))
        data = mujoco.MjData(spec.compile())
        made = heat[w, BODIES + MADE : BODIES + MADE + 3]
        state = data.plugin_state
        assert any((state[i : i + 3] == made).all() for i in np.flatnonzero(state == made[0]))


def test_noise_is_of_the_seed_and_the_name():
    """Two sensors of one seed have their own, in worlds as in singles; the default name's is the seed's."""
    names = {"a_": 0.0, "b_": 0.1}

    def spec():
        made = mujoco.MjSpec.from_string('<mujoco><option timestep="0.008"/></mujoco>')
        return made, dict(body="world", skin=shell())

    def single(names, seed):
        made, how = spec()
        fingers = [
            biotac_mj.attach(made, prefix=p, pos=(0, 0, z), seed=seed, **how) for p, z in names.items()
        ]
        data = mujoco.MjData(model := made.compile())
        for _ in range(4):
            mujoco.mj_step(model, data)
        return [finger.read(data, "pac") for finger in fingers]

    made, how = spec()
    for prefix, z in names.items():
        batches.add(made, prefix=prefix, pos=(0, 0, z), **how)
    mjm = made.compile()
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, mujoco.MjData(mjm), nworld=2)
    kept = [batches.attach(mjm, m, d, prefix=prefix, skin=how["skin"], seed=7) for prefix in names]
    for _ in range(4):
        mjw.step(m, d)
    for prefix, mine in zip(names, single(names, 8)):
        at = mjm.sensor(f"{prefix}pac")
        np.testing.assert_array_equal(d.sensordata.numpy()[1, at.adr[0] : at.adr[0] + at.dim[0]], mine)
    (a, b), (same,), (default,) = single(names, 8), single({"b_": 0.0}, 8), single({"biotac_": 0.0}, 8)
    np.testing.assert_array_equal(b, same)
    assert (a != b).any() and (a != default).any() and len(kept) == 2
    assert Config(name="biotac_", seed=8).noise_seed() == 8
    assert 0 <= Config(name="a_").noise_seed(2**64 - 1) < 2**64


def test_lists_give_every_world_its_own_and_stay():
    own = [{"pin": "steel"}, {"pin": "foam"}]
    mjm, m, d, batch = make(
        press_spec(), 2, coupling="one-way", thermal=own, sensor=["epfl_f2", "phac_f0"],
        readings={"noise": False},
    )  # fmt: skip
    drive(m, d, 1)
    for w, name in enumerate(("epfl_f2", "phac_f0")):
        np.testing.assert_allclose(read(mjm, d, "electrodes")[w], SENSORS[name].rest, atol=1)
    drive(m, d, 60, 1)
    cooled = read(mjm, d, "tac")[:, 0] - [SENSORS[n].tac_rest for n in ("epfl_f2", "phac_f0")]
    warming = Heat([]).state  # epfl_f2 warms up: TAC falls, steel lifts it again
    assert warming.shape[0] == 1 and cooled[0] != cooled[1]


def test_what_cannot_be_is_refused():
    for settings, text in (
        ({"sensor": ["1"]}, "1 sensor for 2 worlds: pass one for each"),
        ({"thermal": {"cup": "steel"}}, "no geom 'cup' to touch"),
        ({"thermal": ["steel", "foam"]}, "thermal is 'steel': give a dict, of geoms' names"),
        ({"thermal": {"pin": ["steel", "mithril"]}}, "no material is known by 'mithril'"),
        ({"readings": {"cold": True}}, "cold needs a sensor with heat"),
        ({"readings": False, "thermal": {}}, "readings is False: leave signal, sensor"),
        ({"randomise": ["gremlins"]}, "cannot randomise 'gremlins'"),
        ({"sensor": "phac_f0", "readings": {"sensor": "1"}}, "readings has '1': give one of them"),
        ({"liquid": False, "options": {"skin": {"liquid": True}}}, "has True: give one of them"),
    ):
        with pytest.raises(ValueError, match=text):
            make(press_spec(), 2, coupling="one-way", **settings)


@pytest.mark.slow
def test_worlds_that_are_told_poses_feel_the_same():
    """`batch.make`, which gets poses, against `batch.attach` in mujoco_warp's own step."""
    felt = {"sensor": "phac_f0", "readings": {"noise": False}, "seed": 4, **FELT}
    mjm, m, d, _ = make(press_spec(), 1, coupling="one-way", **felt)
    spec = press_spec()
    biotac_mj.batch.add(spec, body="world", skin=shell(), coupling="one-way")
    told = biotac_mj.batch.make(spec.compile(), 1, str(d.qpos.device), skin=shell(), **felt)
    for i in range(45):
        drive(m, d, 1, i)
        told.step(d.xpos, d.xmat, d.xipos)
    expected = {channel: read(mjm, d, channel) for channel in ("electrodes", "pdc", "pac", "tac", "tdc")}
    for channel, there in expected.items():
        mine = told.readings()[channel].numpy()
        assert np.abs(mine - there).max() <= 1 + 0.02 * np.ptp(there), channel
    assert np.abs(expected["tac"] - SENSORS["phac_f0"].tac_rest).max() > 2
