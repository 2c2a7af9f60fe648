"""Fingertips as a family: what a design is, and that the code has no number of electrodes of its own."""

import ast
import dataclasses
import json
import re

import mujoco
import numpy as np
import pytest
from imports import modules

from biotac_mj import attach, batch, load_skin
from biotac_mj.data.generation.generate import GenerateOptions, generate
from biotac_mj.data.generation.plan import plan_motions
from biotac_mj.data.importers import import_recordings
from biotac_mj.data.store import TactileSet
from biotac_mj.differentiable.estimation import presses
from biotac_mj.differentiable.estimation.estimate import Estimator
from biotac_mj.differentiable.estimation.presses import capsule_of
from biotac_mj.discrepancy import Simulator, Trajectory, diagnose
from biotac_mj.discrepancy.trajectories.trajectory import read_trajectories, write_trajectories
from biotac_mj.effects.catalogue import by_id
from biotac_mj.effects.sensors import take_sensor
from biotac_mj.geometry.design import BIOTAC, DESIGNS, Design, design_of_channels, read_design
from biotac_mj.geometry.rigid import matrix
from biotac_mj.press import PressOptions, press
from biotac_mj.press.approach import nearest_point
from biotac_mj.press.record import write_skin
from biotac_mj.recordings import Recording, load_one, write
from biotac_mj.recordings.formats.bags import write_bag
from biotac_mj.recordings.simulated import of_simulation
from biotac_mj.resimulation.resimulate import ResimulateOptions, resimulate
from biotac_mj.sensor.acquisition import Acquisition
from biotac_mj.sensor.acquisition_kernels import SLOT_RATE
from biotac_mj.sensor.channels import counts_from_log_impedance, log_impedance
from biotac_mj.sensor.presets import read_sensor, sensors_of

SP = read_design("biotac_sp")

# numbers that are 19 for another reason: a seed
OTHERS = {"data.generation.synthetic_sensor"}
# texts of what is a BioTac's alone: the package's first line, the manual's frame, messages of a driver, a log
OF_BIOTAC = {
    "biotac_mj", "tasks.biotac", "recordings.formats.bags", "recordings.formats.nvidia", "sensor.acquisition",
    "sensor.channels", "quality.log", "learning.networks.electrode_vae", "data.trajectories",
    "recordings.formats.text", "sensor.materials",
}  # fmt: skip
NINETEEN = re.compile(r"\b(19|e19|E19|nineteen)\b(?! ?(%|\.|mm|J|s\b))|\(19,|, 19\)|, 23\)|18 electrodes")


def constants(kind):
    """(module, line, value) of constants in the package, of modules that may have such."""
    for name, path in modules().items():
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if re.search("19|18|23|nineteen", text) else ():
            if isinstance(node, ast.Constant) and type(node.value) is kind:
                yield name.removeprefix("biotac_mj."), node.lineno, node.value


@pytest.mark.law
def test_the_code_has_no_nineteen_of_its_own():
    found = [
        f"{name}, line {line}" for name, line, value in constants(int) if value == 19 and name not in OTHERS
    ]
    assert not found, "\n".join(found)


@pytest.mark.law
def test_texts_say_nelectrode_where_any_design_is_meant():
    found = [
        f"{name}, line {line}: {value.strip()[:60]}"
        for name, line, value in constants(str)
        if name not in OF_BIOTAC and NINETEEN.search(value)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("name", DESIGNS)
def test_a_design_is_the_same_after_its_text(name):
    design = read_design(name)
    assert read_design(design.text) == design and design.name == name
    assert design_of_channels(design.nelectrode) == design
    assert len(design.channels) == design.nelectrode + 4 and design.slots >= 2 * (design.nelectrode + 3)


@pytest.mark.parametrize("name", [n for n in DESIGNS if read_design(n).nelectrode])
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
    with pytest.raises(ValueError, match="design has 'colour'"):
        read_design(json.dumps({"name": "a", "title": "b", "colour": "red"}))
    with pytest.raises(FileNotFoundError, match="pass one of biotac, biotac_sp,.* or a folder"):
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
    with pytest.raises(ValueError, match="sensor '1' has 19 electrodes, and the skin is of BioTac SP .24"):
        attach(spec, body="world", design="biotac_sp", skin="coarse", sensor="1")
    with pytest.raises(ValueError, match="rest of a sensor has 19 electrodes, and the skin is of BioTac SP"):
        attach(spec, body="world", design="biotac_sp", skin="coarse", sensor={"rest": [3000.0] * 19})
    theirs = sensors_of(SP)["sp_mf"]
    for sensor in ("sp_mf", theirs, {"like": "sp_mf"}, {"noise": list(theirs.noise)}):
        with pytest.raises(ValueError, match="has 24 electrodes, and the skin is of BioTac .19 .* BioTac SP"):
            read_sensor(sensor)
    with pytest.raises(ValueError, match="the skin is one of BioTac SP .* and the design BioTac"):
        attach(spec, body="world", design="biotac", skin="biotac_sp/coarse")
    with pytest.raises(FileNotFoundError, match="no design at other: pass one of biotac, biotac_sp"):
        attach(spec, body="world", design="other")


def test_randomised_sensors_have_as_many_electrodes():
    sensor, _, drawn = take_sensor({"sensor": "random", "randomise": ["gain", "dead", "crosstalk"]}, 3, SP)
    assert drawn and len(sensor.rest) == 24 and np.shape(sensor.mixing) == (24, 24)


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """Two presses of simulated SPs, of the condensed tier."""
    folder = tmp_path_factory.mktemp("set")
    options = GenerateOptions(
        count=2, labelled=0, steps=8, skin="biotac_sp/coarse", tier="condensed", objects=("sphere_7mm",),
        kinds=("press",),
    )  # fmt: skip
    generate(folder, options, workers=0, progress=False)
    return folder


def test_a_set_of_sps_holds_their_channels(generated):
    with TactileSet(generated) as data:
        assert data.design == SP == data.geometry.design and data.attributes["settings"]["sensor"] == "sp_mf"
        counts, pac, impedance = (data[name][:] for name in ("counts", "pac", "impedance"))
    assert counts.shape == (16, 28) and pac.shape == (16, SP.npac) and impedance.shape == (16, 24)
    rest = sensors_of(SP)["sp_mf"]
    np.testing.assert_allclose(counts[[0, 8], :24], np.tile(rest.rest, (2, 1)), atol=5 * max(rest.noise))
    assert abs(counts[0, 24] - rest.pdc_rest) < 5 and np.ptp(counts[:8, :24], axis=0).max() > 100
    np.testing.assert_array_equal(counts[:, 25], pac[:, -1])


def of_presses(folder):
    """Trajectories of a set, as if a real sensor had been pressed."""
    with TactileSet(folder) as data:
        for i in range(len(data)):
            one = data.interaction(i)
            yield Trajectory(
                one.id, one.object, 10.0 * i, one.time, one.indenter_pos, matrix(one.indenter_quat),
                one.counts[:, :24].astype(float), one.counts[:, 24].astype(float), None, one.wrench[:, :3],
            )  # fmt: skip


def test_trajectories_of_an_sp_are_compared_with_an_sp(generated, tmp_path):
    written = list(of_presses(generated))
    write_trajectories(tmp_path / "measured.h5", written)
    read = read_trajectories(tmp_path / "measured.h5")
    assert len(read) == 2 and read[0].electrodes.shape == (8, 24)
    np.testing.assert_allclose(read[1].pdc, written[1].pdc)
    sim = Simulator(skin="biotac_sp/coarse")
    assert sim.design == SP and sim.sensor == "sp_mf"
    with pytest.raises(ValueError, match="has 24 electrodes, and the skin is of BioTac .19"):
        diagnose(Simulator(), read, progress=False)
    with pytest.raises(ValueError, match="sensor is '1': choose one of sp_ff, sp_mf, sp_th"):
        Simulator(skin="biotac_sp/coarse", sensor="1")
    # the same skin and film as the set's: what was generated comes back, but for noise and what changed
    # within a frame
    late = SP.slots / SLOT_RATE / np.diff(read[0].time)[0]
    for run, one in zip(sim.run(read), read):
        most = 5 * max(sensors_of(SP)["sp_mf"].noise) + late * np.abs(np.diff(run.counts, axis=0))
        assert (np.abs(run.counts - one.electrodes)[1:] < most).all()


@pytest.mark.slow
def test_diagnose_names_gains_of_an_sp():
    sim, n, rng = Simulator(skin="biotac_sp/coarse"), 12, np.random.default_rng(0)
    motions = plan_motions(load_skin(sim.skin), "sphere_7mm", [[3, i] for i in range(n)], 12, ("press",))
    time, none = 0.05 * np.arange(12), np.zeros((12, 3))
    data = [
        Trajectory(f"t{i}", "sphere_7mm", 9.0 * i, time, m.pos, m.mat, np.full((12, 24), 2e3), force=none)
        for i, m in enumerate(motions)
    ]
    gain = by_id("gain").on(SP)  # a change from rest is 1 + its number times as large
    hidden = dict(zip(SP.electrodes, rng.normal(0, 0.3, 24).tolist()))
    for one, run in zip(data, sim.run(data, effects=[(gain, gain.default() | hidden)])):
        one.electrodes = np.rint(run.counts + rng.normal(0, 4, run.counts.shape))
        one.force = run.force + rng.normal(0, 0.01, run.force.shape)
    found = diagnose(sim, data, progress=False)
    assert [f.id for f in found.effects] == ["gain"] and len(found.proof.before["channels"]) == 24 + 3
    change = np.ptp([one.electrodes for one in data], axis=(0, 1))
    told = {name: value.value for name, value in found.effects[0].parameters.items()}
    moved = [name for name, size in zip(SP.electrodes, change) if size > 200]
    assert len(moved) >= 8
    np.testing.assert_allclose([told[e] for e in moved], [hidden[e] for e in moved], atol=0.05)


@pytest.mark.slow
def test_a_recording_of_an_sp_is_simulated_again(generated, tmp_path):
    with TactileSet(generated) as data:
        one = data.interaction(0)
    before, row = 0.05 * np.arange(-12, 0), np.r_[np.zeros(12, int), np.arange(8)]
    recording = Recording(
        np.r_[before, one.time] + 1, electrodes=one.counts[row, :24], force=one.wrench[row, :3],
        object_pos=one.indenter_pos[row], object_quat=one.indenter_quat[row], object=one.object,
        name="sp", frame="BioTac",
    )  # fmt: skip
    options = ResimulateOptions(skin="biotac_sp/coarse")
    report = resimulate(recording, tmp_path / "again", options, workers=0, progress=False)
    assert report.interactions == 1 and report.agreement > 0.95
    with TactileSet(tmp_path / "again") as data:
        assert data.design == SP and data["measured_counts"].shape[1] == 28
    with pytest.raises(ValueError, match="sp has 24 electrodes, and the skin is of BioTac"):
        resimulate(recording, tmp_path / "other", ResimulateOptions(skin="coarse"))


def logged(rows=3):
    """A recording of a simulated SP."""
    read = {**{name: np.full(n, 2000.0) for name, n in SP.widths.items()}, "contact_force": np.zeros(6)}
    return of_simulation(0.01 * np.arange(1, rows + 1), [read] * rows)


def test_logs_of_sps_become_a_set_of_their_own(tmp_path):
    assert logged().design == SP and logged().pac.shape == (3, SP.npac)
    write(tmp_path / "sp.h5", [logged()])
    import_recordings([tmp_path / "sp.h5"], tmp_path / "set")
    with TactileSet(tmp_path / "set") as data:
        assert data.design == SP and data["measured_counts"].shape == (3, 28)
    other = Recording(0.01 * np.arange(3), electrodes=np.full((3, 19), 2500.0), name="other")
    write(tmp_path / "other.h5", [other])
    with pytest.raises(ValueError, match="sensors of BioTac .19 electrodes. and of BioTac SP"):
        import_recordings([tmp_path / "sp.h5", tmp_path / "other.h5"], tmp_path / "both")


def test_messages_with_room_for_an_sp_are_written_and_read(tmp_path):
    pytest.importorskip("rosbags")
    with pytest.raises(ValueError, match="hold 19 electrodes, .* BioTac SP .*: take the form tactile_msgs"):
        write_bag(tmp_path / "log.bag", logged(), ros=1)
    write_bag(tmp_path / "log.bag", logged(), ros=1, form="tactile_msgs")
    read = load_one(tmp_path / "log.bag")[0]
    assert read.design == SP and (read.electrodes == 2000).all()


def test_a_press_of_an_sp_is_a_recording_of_one(pressed, tmp_path):
    write_skin(pressed, tmp_path / "skin.h5")
    read = load_one(tmp_path / "skin.h5")[0]
    assert read.design == SP and read.pac.shape[1] == SP.npac
    np.testing.assert_allclose(read.pdc, pressed.counts[:, 24])


def test_points_of_a_dome_lie_over_all_of_it():
    skin = load_skin("biotac_sp/coarse")
    capsule = capsule_of(skin)
    at = [capsule.at(along, around) for along in capsule.along for around in capsule.around]
    place = np.array([nearest_point(skin, one)[0] for one in at])
    assert np.linalg.norm(place - at, axis=1).max() < 1e-3
    np.testing.assert_allclose(np.sort(place[:, 0]), np.sort(-place[:, 0]), atol=2e-4)
    assert place[:, 0].max() > 13e-3 and place[:, 1].min() < -10e-3


@pytest.mark.slow
def test_a_press_of_an_sp_is_estimated(monkeypatch):
    along, around = np.array([-6e-3, -2e-3, 2e-3, 6e-3]), np.radians([-25.0, 0, 25, 50])
    part = dataclasses.replace(capsule_of(load_skin("biotac_sp/coarse")), along=along, around=around)
    monkeypatch.setattr(presses, "capsule_of", lambda skin: part)
    monkeypatch.setattr(presses, "_FRACTIONS", np.linspace(0, 1, 5))
    estimator = Estimator(load_skin("biotac_sp/coarse"))
    table, rest = estimator.presses, np.array(sensors_of(SP)["sp_mf"].rest)
    assert table.signal.shape[1] == 25
    off = np.linalg.norm(table.outcome[:, 1:4] - [1e-3, -10.5e-3, 1e-3], axis=1) / 1e-3
    k = int(np.argmin(off + np.abs(table.outcome[:, 0] - np.log(0.5))))  # about 0.5 N
    found = estimator(counts_from_log_impedance(log_impedance(rest) + table.signal[k, :24]), rest)
    assert np.linalg.norm(found.centre - table.outcome[k, 1:4]) < 1e-3
    assert found.low < np.exp(table.outcome[k, 0]) < found.high
    with pytest.raises(ValueError, match="a row has 19 electrodes, and the skin is of BioTac SP"):
        estimator(np.full(19, 2500.0), np.full(19, 2600.0))


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
