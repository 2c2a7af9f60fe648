"""Fingertips as a family: what a design is, and that the code has no number of electrodes of its own."""

import ast
import json

import mujoco
import numpy as np
import pytest
from imports import modules

from biotac_mj import attach, batch, load_skin
from biotac_mj.data.generation.generate import GenerateOptions, generate
from biotac_mj.differentiable.estimation.estimate import Estimator
from biotac_mj.discrepancy.trajectories.model.simulator import Simulator
from biotac_mj.effects.sensors import take_sensor
from biotac_mj.geometry.design import BIOTAC, DESIGNS, Design, design_of_channels, read_design
from biotac_mj.press import PressOptions, press
from biotac_mj.recordings.formats.bags import write_bag
from biotac_mj.recordings.simulated import of_simulation
from biotac_mj.resimulation.resimulate import resimulate
from biotac_mj.sensor.acquisition import SLOT_RATE, Acquisition
from biotac_mj.sensor.presets import sensors_of

SP = read_design("biotac_sp")

# numbers that are 19 for another reason: a seed
OTHERS = {"data.generation.synthetic_sensor"}


def test_the_code_has_no_nineteen_of_its_own():
    found = [
        f"{name}, line {node.lineno}"
        for name, path in modules().items()
        if name.removeprefix("biotac_mj.") not in OTHERS
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and type(node.value) is int and node.value == 19
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("name", DESIGNS)
def test_a_design_is_the_same_after_its_text(name):
    design = read_design(name)
    assert read_design(design.text) == design and design.name == name
    assert design_of_channels(design.nelectrode) == design
    assert len(design.channels) == design.nelectrode + 4 and design.slots >= 2 * (design.nelectrode + 3)


@pytest.mark.parametrize("name", DESIGNS)
def test_the_mirror_turns_z_of_every_electrode(name):
    design = read_design(name)
    place = design.in_biotac_frame(np.array(design.electrodes_mm))
    np.testing.assert_allclose(place[design.mirror], place * [1, 1, -1], atol=1e-12)
    np.testing.assert_array_equal(design.mirror[design.mirror], np.arange(design.nelectrode))


def test_what_cannot_be_simulated_is_said():
    places = np.random.default_rng(0).normal(size=(31, 3)).tolist()
    for changes, said in (
        ({"electrodes_mm": places, "excitation": places[:2]}, "31 electrodes and 2 of excitation: at most 4"),
        ({"electrodes_mm": places[:6]}, "6 electrodes and 0 of excitation: give both, or neither"),
        ({"electrodes_mm": [[1, 2]], "excitation": [[0, 0, 0]]}, "give rows of 3 finite numbers"),
        ({"slots": 5}, "slots of design 'mine' are 5"),
        ({"electrodes_mm": places[:6], "excitation": places[:1]}, "no sensor ''"),
        ({"sensors": {"a": {"rest": [1.0]}}}, "sensor 'a' of design 'mine' needs 0 rest counts"),
    ):
        with pytest.raises(ValueError, match=said):
            Design("mine", "my pad", **changes)
    with pytest.raises(ValueError, match="a design has no 'colour'"):
        read_design(json.dumps({"name": "a", "title": "b", "colour": "red"}))
    with pytest.raises(FileNotFoundError, match="pass one of biotac, biotac_sp, or a folder"):
        read_design("nowhere")
    assert BIOTAC.nelectrode + 5 == read_design("biotac_sp").nelectrode


@pytest.fixture(scope="module")
def pressed():
    """A BioTac SP pressed by a sphere below E24, on the condensed tier."""
    options = PressOptions(
        design="biotac_sp", skin="coarse", tier="condensed", location=(-1.9e-3, 0.0), depth=1e-3, hold=0.03,
        indenter="geom:sphere:0.005", readings={"noise": False},
    )  # fmt: skip
    return press(options, progress=False).record


def test_an_sp_rests_at_its_sensors_counts_and_feels_a_press(pressed):
    rest = sensors_of(SP)[SP.sensor]
    np.testing.assert_allclose(pressed.counts[0, :24], rest.rest, atol=1)
    assert pressed.counts.shape[1] == len(SP.channels) and pressed.pac.shape[1] == SP.npac
    assert np.linalg.norm(pressed.force[-1]) > 0.5 and pressed.nonconverged[-1] == 0
    change = pressed.electrode_change[-1]
    assert change.argmin() == SP.electrodes.index("e24") and change[23] < -60
    # what lies on both sides of the midline answers alike
    np.testing.assert_allclose(change, change[SP.mirror], atol=25)
    pdc = pressed.counts[:, SP.channels.index("pdc")]
    assert pdc[-1] - rest.pdc_rest > 10


def test_an_sp_s_electrodes_are_renewed_every_14_ms():
    acquisition = Acquisition(noise=False, sensor=sensors_of(SP)["sp_mf"], design=SP)
    state, z, seen = np.zeros(acquisition.nstate), sensors_of(SP)["sp_mf"].impedance, []
    acquisition.reset(state, z)
    for step in range(600):
        due = acquisition.needs_impedance(state, step * 1e-3, 1e-3)
        acquisition.advance(state, step * 1e-3, 1e-3, z * (1 - 1e-3 * step) if due else None)
        seen.append(acquisition.readings(state))
    changes = (np.diff([row["electrodes"] for row in seen], axis=0) != 0).mean(0) / 1e-3
    np.testing.assert_allclose(changes, SLOT_RATE / SP.slots, rtol=0.05)
    assert {row["pdc"] for row in seen[50:]} == {1676} and seen[-1]["pac"].shape == (31,)


def test_a_design_and_what_is_not_of_it_are_refused_by_name():
    spec = mujoco.MjSpec()
    with pytest.raises(ValueError, match="sensor of a BioTac SP .24 electrodes. is '1': pass one of 'sp_ff'"):
        attach(spec, body="world", design="biotac_sp", skin="coarse", sensor="1")
    with pytest.raises(ValueError, match="rest of a sensor is .*, of 19 electrodes, and the design is"):
        attach(spec, body="world", design="biotac_sp", skin="coarse", sensor={"rest": [3000.0] * 19})
    with pytest.raises(ValueError, match="the skin is one of BioTac SP .* and the design BioTac"):
        attach(spec, body="world", design="biotac", skin="biotac_sp/coarse")
    with pytest.raises(FileNotFoundError, match="no design at other: pass one of biotac, biotac_sp"):
        attach(spec, body="world", design="other")


def test_randomised_sensors_have_as_many_electrodes():
    sensor, _, drawn = take_sensor({"sensor": "random", "randomise": ["gain", "dead", "crosstalk"]}, 3, SP)
    assert drawn and len(sensor.rest) == 24 and np.shape(sensor.mixing) == (24, 24)


def test_what_knows_the_biotac_alone_says_so(tmp_path):
    """The table of designs in docs/features.md."""
    said = "knows the BioTac .19 electrodes. alone, and this is a BioTac SP .24 electrodes.: leave it out"
    recording = of_simulation(
        [0.01],
        [{**{name: np.full(n, 2000.0) for name, n in SP.widths.items()}, "contact_force": np.zeros(6)}],
    )
    assert recording.design == SP and recording.pac.shape == (1, 22)
    for refused in (
        lambda: generate(tmp_path / "set", GenerateOptions(skin="biotac_sp/coarse"), progress=False),
        lambda: resimulate(recording, tmp_path / "again"),
        lambda: Estimator(load_skin("biotac_sp/coarse")),
        lambda: Simulator(skin="biotac_sp/coarse"),
        lambda: write_bag(tmp_path / "log.bag", recording, ros=1),
    ):
        with pytest.raises(ValueError, match=said):
            refused()


def test_an_sp_is_an_entity_of_dm_control():
    tasks = pytest.importorskip("biotac_mj.tasks")
    composer = pytest.importorskip("dm_control.composer")
    finger = tasks.BioTac(design="biotac_sp", sensor="random", skin="coarse", tier="condensed")
    arena = composer.Arena()
    arena.attach(finger)
    env = composer.Environment(composer.NullTask(arena), random_state=0)
    env.reset()
    env.step([])
    counts = finger.read(env.physics, "electrodes")
    np.testing.assert_allclose(counts, finger.rest(), atol=40)
    assert counts.shape == (24,) and len(finger.vert_xpos(env.physics)) == load_skin("biotac_sp/coarse").nvert
    env.close()


@pytest.mark.slow
def test_worlds_of_a_batch_read_what_a_single_sp_reads():
    mujoco_warp = pytest.importorskip("mujoco_warp")

    def scene():
        spec = mujoco.MjSpec()
        spec.option.gravity = np.zeros(3)
        body = spec.worldbody.add_body(name="ball", mocap=True, pos=[2e-3, -15e-3, 1e-3])
        body.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[5e-3, 0, 0])
        return spec

    said = {"design": "biotac_sp", "skin": "coarse", "coupling": "one-way", "seed": 5}
    spec = scene()
    handle = attach(spec, body="world", **said)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.mocap_pos[0] = [2e-3, -14.8e-3, 1e-3]
    spec = scene()
    prefix = batch.add(spec, body="world", **{k: said[k] for k in ("design", "skin", "coupling")})
    mjm = spec.compile()
    mjd = mujoco.MjData(mjm)
    mjd.mocap_pos[0] = data.mocap_pos[0]
    mujoco.mj_forward(mjm, mjd)
    m, d = mujoco_warp.put_model(mjm), mujoco_warp.put_data(mjm, mjd, nworld=2)
    batch.attach(mjm, m, d, prefix=prefix, **said)
    for _ in range(12):
        mujoco.mj_step(model, data)
        mujoco_warp.step(m, d)
    for channel in ("electrodes", "pdc", "pac"):
        start, width = (int(x[mjm.sensor(prefix + channel).id]) for x in (mjm.sensor_adr, mjm.sensor_dim))
        got = d.sensordata.numpy()[0, start : start + width]
        assert width == SP.widths[channel]
        # poses of a batch are of single precision: PAC, which moves by 2000 counts here, by so much
        np.testing.assert_allclose(got, handle.read(data, channel), atol=2, rtol=2e-3, err_msg=channel)
