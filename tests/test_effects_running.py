"""Sensors that run with effects: what `biotac diagnose` found acts in a simulation, on every path that has
the sensor, and as the effect's own law says."""

import dataclasses
import os
import pathlib
import runpy
import warnings

import mujoco
import numpy as np
import pytest
import yaml
from blocks import four_nodes

import biotac_mj
from biotac_mj import cli
from biotac_mj.discrepancy import PlainRecording, Simulator, diagnose_recording
from biotac_mj.discrepancy.recordings.amended import running
from biotac_mj.discrepancy.report.files import write_report
from biotac_mj.discrepancy.report.text import summary
from biotac_mj.discrepancy.trajectories.model.sensor_file import load_simulator
from biotac_mj.effects.amended import Model, amend
from biotac_mj.effects.catalogue import CATALOGUE, by_id
from biotac_mj.effects.effect import Effect, Param, Run
from biotac_mj.effects.electrodes import Noise
from biotac_mj.effects.sensor_file import read_sensor_file
from biotac_mj.effects.sensors import with_effects
from biotac_mj.geometry import load_skin
from biotac_mj.recordings.own import noise
from biotac_mj.sensor.acquisition import Acquisition
from biotac_mj.sensor.channels import counts_from_impedance
from biotac_mj.sensor.presets import SENSORS, read_sensor
from biotac_mj.skin import Material, SkinModel, SkinOptions

REAL = os.environ.get("BIOTAC_RECORDINGS")
SKIN = four_nodes("coarse")
SET_UP = {"radius", "misalign", "depth0", "mount", "rocking", "rocking_torque", "force_cross"}
# of a press of 0.2 s what each effect has to change at least: counts of an electrode, of PDC, force [N]
FELT = {
    "relax": (0, 20, 0.1),
    "stiffen": (20, 20, 0.1),
    "inhomog": (20, 5, 0.02),
    "bubble": (2, 2, 0),
    "friction": (0, 0, 5e-4),
    "asper": (100, 0, 0),
    "gain": (50, 0, 0),
    "crosstalk": (5, 0, 0),
    "saturate": (50, 0, 0),
    "lowpass": (100, 0, 0),
    "latency": (100, 0, 0),
    "warmup": (1, 0, 0),
    "drift": (1, 0, 0),
    "pdc_gain": (0, 20, 0),
    "spots": (5, 1, 0.01),
    "offset": (80, 0, 0),
    "electrode_drift": (0.1, 0, 0),
    "swap": (100, 0, 0),
}


def theta_of(effect):
    """Three realistic sizes of an effect."""
    sizes = {n: np.clip(3 * p.scale, p.low, p.high) for n, p in effect.params.items() if not p.shape}
    return {**effect.default(), **sizes}


def press(effects=None, **settings):
    """(18, 26) electrodes, PDC, contact force of a ball that presses the pad by 1 mm and is moved aside."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 8e-3, [0, 0, 0]
    ball = spec.worldbody.add_body(name="ball", mocap=True)
    ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[3.5e-3, 0, 0])
    handle = biotac_mj.attach(
        spec,
        body="world",
        coupling="one-way",
        effects=effects,
        options={"readings": {"noise": False}, "skin": {"element": "linear"}},
        on_error="raise",
        **{"skin": "coarse" if settings.get("tier") == "condensed" else SKIN, **settings},
    )
    model = spec.compile()
    data, out = mujoco.MjData(model), []
    for i in range(18):
        aside = 3e-4 if i > 11 else 0.0
        data.mocap_pos[0] = [-9e-3 + aside, -12.5e-3 + 2.2e-3 * min(i / 8, 1), 1e-3]
        mujoco.mj_step(model, data)
        biotac_mj.plugin.check()
        out.append(np.concatenate([handle.read(data, c) for c in ("electrodes", "pdc", "contact_force")]))
    return np.array(out)


@pytest.fixture(scope="module")
def plain_press():
    return {tier: press(tier=tier) for tier in ("full", "condensed")}


@pytest.mark.parametrize("name", FELT)
def test_an_effect_acts_in_mj_step(name, plain_press):
    effect = by_id(name)
    tier = "full" if effect.stage == "C" else "condensed"
    change = np.abs(press([(effect, theta_of(effect))], tier=tier) - plain_press[tier])
    found = change[:, :19].max(), change[:, 19].max(), change[:, 20:23].max()
    assert all(f >= least for f, least in zip(found, FELT[name])), found


def test_every_effect_acts_or_is_left_out_by_name():
    """Settings differ, or a warning or an error names the effect; so do new effects in the catalogue."""
    plain = repr(amend(Model(None, None, None, None, None), []))
    for effect in CATALOGUE:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                out = amend(Model(None, None, None, None, None), [(effect, theta_of(effect))])
            except ValueError as error:
                assert repr(effect.id) in str(error)
                continue
        left_out = [w for w in caught if f"not of the sensor itself: {effect.id} " in str(w.message)]
        assert (repr(out) != plain) == (not left_out), effect.id


def test_a_sensor_begins_as_the_session_left_it():
    """Softened by the work that was done, and without the liquid that was gone as the session began."""
    plain, fill = Model("coarse", None, None, None, None), by_id("fluidloss")
    fresh = amend(plain, [])
    soft = amend(plain, [(by_id("damage"), {"damage": 0.3})])
    assert soft.material.youngs_modulus == pytest.approx(0.7 * fresh.material.youngs_modulus)
    liquid = SkinModel(load_skin("coarse"), "default", SkinOptions(liquid=True)).liquid_volume
    options = amend(plain, [(fill, {"rate": 0.2, "before": 0.05})]).options
    assert options["skin"]["fill_volume"] == pytest.approx(-0.05 * liquid, rel=1e-3)
    assert "skin" not in amend(plain, [(fill, {"rate": 0.2})]).options


def test_rubber_keeps_what_it_has_of_its_own():
    own = Material(stiffening=2.0, prony=((0.2, 1.0),))
    plain, stiff = Material(), (by_id("stiffen"), {"c2": 0.3})
    more = [amend(Model(None, m, None, None, None), [stiff]).material for m in (plain, own)]
    assert more[1].stiffening == pytest.approx(2.0 + more[0].stiffening) and more[0].stiffening > 1
    assert more[1].prony == own.prony


def test_effects_of_the_set_up_are_left_out_by_name(plain_press):
    effects = [(by_id(name), theta_of(by_id(name))) for name in sorted(SET_UP)]
    effects.append((by_id("latency"), {"delay": -0.02}))
    with pytest.warns(UserWarning, match="not of the sensor itself: .*latency .acquisition"):
        np.testing.assert_array_equal(press(effects, tier="condensed"), plain_press["condensed"])


@pytest.mark.parametrize("name", ["asper", "gain", "crosstalk", "saturate", "fluidloss", "warmup"])
def test_the_acquisition_does_what_the_effect_says(name):
    """Of impedances that stand still for a while: counts of `Effect.apply`, rounded."""
    effect, time = by_id(name), 30.0
    theta = theta_of(effect)
    if name == "fluidloss":
        theta["before"] = 0.0  # that is the skin's
    sensor = SENSORS["1"]
    z = sensor.impedance * np.exp(np.random.default_rng(0).uniform(-0.4, 0.6, 19))
    run = Run(
        *(np.full(2, v) for v in (0.0, time)),
        tool="",
        heading=np.zeros(3),
        depth=np.zeros(2),
        place=np.zeros(3),
        order=0,
        offset=np.zeros((2, 3)),
        force=np.zeros((2, 3)),
        pressure=np.zeros(2),
        log_z=np.tile(np.log(z), (2, 1)),
        temperature=None,
        session={},
        rest_log_z=np.log(sensor.impedance),
    )
    if effect.stage == "T":
        effect.apply(run, theta)
    run.counts = counts_from_impedance(np.exp(run.log_z))
    if effect.stage == "A":
        effect.apply(run, theta)
    acquisition = Acquisition(noise=False, sensor=with_effects(sensor, [(effect, theta)]))
    state = np.zeros(acquisition.nstate)
    acquisition.reset(state, sensor.impedance)
    for i in range(int(time / 0.01)):
        acquisition.advance(state, 0.01 * i, 0.01, z)
    np.testing.assert_allclose(acquisition.readings(state)["electrodes"], run.counts[1], atol=0.6)


@pytest.mark.parametrize("name, value", [("lowpass", {"tau": 0.05}), ("latency", {"delay": 0.043})])
def test_electrodes_come_late(name, value):
    """Of a ramp of impedance: the same count later by the delay, or by the time constant."""
    sensor = SENSORS["1"]
    late = with_effects(sensor, [(by_id(name), value)])
    lag, out = next(iter(value.values())), []
    for one in (sensor, late):
        acquisition = Acquisition(noise=False, film_every_step=True, sensor=one)
        state = np.zeros(acquisition.nstate)
        acquisition.reset(state, sensor.impedance)
        rows = []
        for i in range(1000):
            acquisition.advance(state, 1e-3 * i, 1e-3, sensor.impedance * (1 + 2e-3 * (i + 1)))
            rows.append(acquisition.readings(state)["electrodes"][4])
        out.append(np.array(rows, float))
    times = np.interp(-out[1][-200:], -out[0], 1e-3 * np.arange(1000))  # counts fall
    assert np.median(1e-3 * np.arange(800, 1000) - times) == pytest.approx(lag, abs=6e-3)


def test_an_exchanged_electrode_reads_as_the_other_one():
    """Rest and changes: within the bend of counts over ln Z."""
    sensor, effect = SENSORS["1"], by_id("swap").given(["e3_reads_e9", "e9_reads_e3"])
    other = with_effects(sensor, [(effect, {"e3_reads_e9": 1.0, "e9_reads_e3": 1.0})])
    z = sensor.impedance * np.exp(np.linspace(-0.15, 0.15, 19))
    rows = []
    for one in (sensor, other):
        acquisition = Acquisition(noise=False, sensor=one)
        state = np.zeros(acquisition.nstate)
        acquisition.reset(state, one.impedance)
        for i in range(20):
            acquisition.advance(state, 0.01 * i, 0.01, one.impedance * z / sensor.impedance)
        rows.append(acquisition.readings(state)["electrodes"].astype(float))
    expected = rows[0].copy()
    expected[[2, 8]] = expected[[8, 2]]
    assert abs(rows[0][2] - rows[0][8]) > 100
    np.testing.assert_allclose(rows[1], expected, atol=8)


def test_offsets_and_noise_are_the_sensors():
    sensor = SENSORS["1"]
    size, noise = {**by_id("offset").default(), "e9": 58.0}, {**Noise().default(), "e2": 12.0}
    off, noisy = (with_effects(sensor, [one]) for one in ((by_id("offset"), size), (Noise(), noise)))
    np.testing.assert_allclose(np.array(off.rest) - sensor.rest, 58.0 * (np.arange(19) == 8))
    law = sensor.electrode_noise(np.array(sensor.rest))
    np.testing.assert_allclose(noisy.noise, np.hypot(law, 12.0 * (np.arange(19) == 1)))


def test_warmth_and_drift_have_each_electrodes_share():
    share = np.linspace(0.5, 1.5, 19)
    sensor = {"warm_up": 4.0, "warm_time": 1.0, "warm_share": share, "drift": np.linspace(-5, 5, 19)}
    one = read_sensor(sensor)
    acquisition = Acquisition(noise=False, sensor=one)
    state = np.zeros(acquisition.nstate)
    acquisition.reset(state, one.impedance)
    for i in range(1000):
        acquisition.advance(state, 0.01 * i, 0.01, one.impedance)
    warm = 4.0 * (1 - np.exp(-10.0))
    expected = counts_from_impedance(one.impedance * np.exp(-one.per_degree * warm * share))
    expected = expected + np.linspace(-5, 5, 19) * 9.99
    np.testing.assert_allclose(acquisition.readings(state)["electrodes"], expected, atol=1.5)


def test_a_sensor_file_is_attached_with_its_base_model(tmp_path):
    """The file that `diagnose` writes: its material and sensor where none is given, then its effects."""
    path = tmp_path / "sensor_amended.yaml"
    effects = [(by_id("gain"), {**by_id("gain").default(), "e9": -0.5}), (by_id("stiffen"), {"c2": 0.4})]
    Simulator(material={"youngs_modulus": 6e5}, sensor="2", effects=effects, modulus=1.5).save(path)
    spec = mujoco.MjSpec()
    handle = biotac_mj.attach(spec, body="world", effects=path)
    assert handle.config.skin == "coarse" and handle.numbers.rest == SENSORS["2"].rest
    assert handle.numbers.mixing[8][8] == pytest.approx(0.5)
    assert handle.config.material["youngs_modulus"] == pytest.approx(9e5)
    assert handle.config.material["stiffening"] > 1
    spec = mujoco.MjSpec()
    other = biotac_mj.attach(spec, body="world", effects=path, skin="default", material="rubber", sensor="3")
    assert other.config.skin == "default" and other.numbers.rest == SENSORS["3"].rest
    assert other.config.material["youngs_modulus"] == pytest.approx(1.5 * 2.8e5)
    assert other.numbers.mixing[8][8] == pytest.approx(0.5)


def test_batches_take_a_sensor_file(tmp_path):
    mjw = pytest.importorskip("mujoco_warp")
    path = tmp_path / "sensor.yaml"
    gain = {**by_id("pdc_gain").default(), "gain": 1.0}
    Simulator(effects=[(by_id("pdc_gain"), gain), (by_id("stiffen"), {"c2": 0.4})]).save(path)
    rows = []
    for effects in (None, path):
        spec = mujoco.MjSpec()
        spec.option.timestep = 8e-3
        ball = spec.worldbody.add_body(name="ball", mocap=True, pos=[-9e-3, -11e-3, 1e-3])
        ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[3.5e-3, 0, 0])
        biotac_mj.batch.add(spec, body="world", skin=SKIN, coupling="one-way")
        mjm = spec.compile()
        mjd = mujoco.MjData(mjm)
        mujoco.mj_forward(mjm, mjd)
        m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=2)
        settings = dict(skin=SKIN, coupling="one-way", readings={"noise": False})
        biotac_mj.batch.attach(mjm, m, d, effects=effects, **settings)
        for _ in range(3):
            mjw.step(m, d)
        names = ("biotac_pdc", "biotac_contact_force")
        rows.append([d.sensordata.numpy()[0, mjm.sensor(n).adr[0] : mjm.sensor(n).adr[0] + 2] for n in names])
    (pdc, force), (more, stiffer) = rows
    assert abs(stiffer[1]) > 1.05 * abs(force[1])
    assert more[0] - 2000 > 1.8 * (pdc[0] - 2000) > 100


def test_presses_take_a_sensor_file(tmp_path, monkeypatch):
    path = tmp_path / "sensor.yaml"
    Simulator(sensor="2", effects=[(by_id("gain"), {**by_id("gain").default(), "e1": 0.5})]).save(path)
    words = f"press --skin coarse --tier condensed --depth 0.3mm --no-render --quiet --out {tmp_path / 'o'}"
    assert cli.main([*words.split(), "--effects", str(path)]) in (0, None)
    row = (tmp_path / "o" / "readings.csv").read_text().splitlines()[-1]
    rest = np.array(SENSORS["2"].rest)
    counts = np.array([float(v) for v in row.split(",")[5:24]])
    assert np.median(np.abs(counts - rest)) < 60
    assert yaml.safe_load(path.read_text())["schema"] == "biotac_mj.sensor/1"
    assert read_sensor_file(path).effects[0][0].id == "gain"


def test_what_cannot_run_is_refused_by_name(tmp_path):
    class Own(Effect):
        id, name, stage, physics = "own", "of one's own", "A", ""
        params = {"rate": Param("counts/s", -5, 5, "", 0.1)}

        def apply(self, run, theta):
            pass

    nothing = Model(None, None, None, None, None)
    with pytest.raises(ValueError, match="no running sensor can have the effect 'own'"):
        amend(nothing, [(Own(), {"rate": 1.0})])
    with pytest.raises(ValueError, match=r"latency of a sensor is 0.4: give 0 or more, at most 0.11"):
        amend(nothing, [(by_id("latency"), {"delay": 0.4})])
    with pytest.raises(ValueError, match="give a sensor file, or a list"):
        amend(nothing, [1])
    with pytest.raises(FileNotFoundError, match="no sensor file at .*biotac diagnose"):
        amend(nothing, tmp_path / "none.yaml")
    with pytest.raises(ValueError, match="the condensed tier is elastic"), warnings.catch_warnings():
        biotac_mj.attach(
            mujoco.MjSpec(),
            body="world",
            tier="condensed",
            effects=[(by_id("relax"), {"g": 0.2, "tau": 1.0})],
        )


def _as_recorded(recording, rows, rate):
    """Rest, change over the rows' time and noise of simulated electrodes are the recording's."""
    measured = recording.electrodes
    count = round(len(rows) * recording.rate / rate)
    rest, drift = (
        np.median(a[: round(r)], axis=0) for a, r in ((measured, 2 * recording.rate), (rows, 2 * rate))
    )
    np.testing.assert_allclose(drift, rest, atol=6)
    ends = [np.median(a[n - round(2 * r) : n], axis=0) for a, n, r in (
        (measured, count, recording.rate), (rows, len(rows), rate))]  # fmt: skip
    changes = ends[0] - rest, ends[1] - drift
    assert np.abs(changes[0]).mean() > 20
    np.testing.assert_allclose(changes[1], changes[0], atol=0.15 * np.abs(changes[0]).mean() + 3)
    np.testing.assert_allclose(noise(rows), noise(measured), rtol=0.15, atol=0.3)


@pytest.mark.slow
def test_a_finger_behaves_like_a_recorded_sensor():
    """A synthetic recording of a sensor that rests and warms up, named, attached to a hand and run."""
    path = pathlib.Path(biotac_mj.__file__).parents[1] / "examples" / "finger_like_a_recording.py"
    example = runpy.run_path(str(path))
    recording, rows = example["main"]()
    _as_recorded(recording, rows, 100.0)


def test_the_sensor_of_a_plain_diagnosis_is_a_simulator(tmp_path):
    """Its rests are the film's; what acts in time is refused by name, and nothing is left out in silence."""
    rng = np.random.default_rng(3)
    one = SENSORS["phac_f1"]
    counts = np.rint(one.rest + one.electrode_noise(one.rest) * rng.standard_normal((2000, 19)))
    write_report(diagnose_recording(PlainRecording(counts)), tmp_path)
    sim = load_simulator(tmp_path / "sensor_amended.yaml")
    assert sim.skin == "default" and sim.tier == "full"
    coarse = dataclasses.replace(sim, skin="coarse")
    np.testing.assert_allclose(coarse.skin_and_film(0.0, 0.0)[1].rest, one.impedance, rtol=1e-3)
    coarse.save(tmp_path / "again.yaml")
    assert load_simulator(tmp_path / "again.yaml").sensor == sim.sensor
    with pytest.raises(ValueError, match="sensor has mixing, warm_up, which the diagnosis does not simulate"):
        dataclasses.replace(sim, sensor={"warm_up": 1.0, "mixing": (0.9 * np.eye(19)).tolist()})


@pytest.mark.slow  # quick: the sensor of a plain diagnosis is a simulator
def test_an_amended_sensor_says_what_it_leaves_out():
    """A synthetic recording: one electrode does not warm up with the others, and a hum lies over all."""
    sensor = read_sensor({"like": "phac_f1", "warm_up": 5.0, "warm_time": 30.0, "noise": [3.0] * 19})
    share = np.ones(19)
    share[4] = 0.0
    time = np.arange(9000) / 100
    warm = 5.0 * (1 - np.exp(-time / 30.0))
    z = sensor.impedance * np.exp(-sensor.per_degree * np.outer(warm, share))
    rng = np.random.default_rng(2)
    counts = counts_from_impedance(z) + 3 * rng.standard_normal(z.shape)
    counts += 25 * np.sin(2 * np.pi * 31.3 * time)[:, None]
    diagnosis = diagnose_recording(PlainRecording(np.rint(counts)))
    file, left = diagnosis.sensor(), running(diagnosis.session)[1]
    assert "hum" in {f.id for f in diagnosis.findings} and "hum" in left
    assert "not in sensor_amended.yaml: mains hum" in summary(diagnosis)
    own = file.base["sensor"]
    assert own["warm_up"] * own["warm_share"][4] == pytest.approx(0.0, abs=0.6)
    drift = own["warm_up"] * np.delete(own["warm_share"], 4) * (1 - np.exp(-90 / own["warm_time"]))
    np.testing.assert_allclose(drift, warm[-1], rtol=0.15)
    assert np.median(own["noise"]) < 6  # not the 18 of the hum


@pytest.mark.skipif(REAL is None, reason="set BIOTAC_RECORDINGS to the folder of real recordings")
def test_a_finger_behaves_like_a_real_unloaded_sensor():
    path = pathlib.Path(biotac_mj.__file__).parents[1] / "examples" / "finger_like_a_recording.py"
    found = sorted(pathlib.Path(REAL).rglob("epfl_flat_press/SynImpF2.txt"))
    recording, rows = runpy.run_path(str(path))["main"](found[0])
    _as_recorded(recording, rows, 100.0)


def test_what_only_the_diagnosis_has_is_left_out_by_name():
    model = Model(None, None, None, None, None)
    relax = {"g": 0.2, "tau": 1.0, "film": 0.1, "more": 0.05, "liquid": 0.0}
    with pytest.warns(UserWarning, match=r"diagnosis alone: relax's film, relax's more, latency's of_pdc$"):
        amend(model, [(by_id("relax"), relax), (by_id("latency"), {"delay": 0.02, "of_pdc": 0.02})])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        amend(model, [(by_id("relax"), {"g": 0.2, "tau": 1.0, "film": 0.0})])
