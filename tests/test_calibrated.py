"""`material="calibrated"` and `options["film"]` reach the film on every path that has a sensor."""

import dataclasses

import mujoco
import numpy as np
import pytest

import biotac_mj
from biotac_mj.coupling.config import Config
from biotac_mj.coupling.sensing.counts import SensorReadings, film_of
from biotac_mj.data.generation.generate import GenerateOptions
from biotac_mj.data.generation.making import Maker
from biotac_mj.discrepancy.trajectories.model.simulator import Simulator
from biotac_mj.geometry import load_skin
from biotac_mj.press import PressOptions
from biotac_mj.press.indenter import make_indenter
from biotac_mj.press.path import plan_path
from biotac_mj.press.scene import build_scene
from biotac_mj.sensor.film import FilmConduction, read_film
from biotac_mj.skin import SkinData, SkinModel
from biotac_mj.skin.rubber.material import PRESETS
from biotac_mj.skin.settings import read_settings

SKIN, CALIBRATED = "coarse", PRESETS["calibrated"]


def of_config(config):
    return SensorReadings(config, load_skin(SKIN))._physics.film


def by_attach(material, options):
    handle = biotac_mj.attach(
        mujoco.MjSpec(), body="world", skin=SKIN, material=material, options=options, tier="condensed"
    )
    return of_config(handle.config), handle.config.material


def by_press(material, options):
    wanted = PressOptions(skin=SKIN, material=material, options=options)
    indenter = make_indenter(wanted.indenter)
    path = plan_path(load_skin(SKIN), indenter, wanted)
    config = build_scene(indenter, path, wanted)[1].config
    return of_config(config), config.material


def by_tasks(material, options):
    pytest.importorskip("dm_control", reason="needs dm_control: pip install biotac_mj[control]")
    from biotac_mj import tasks

    config = tasks.BioTac(skin=SKIN, material=material, options=options).handle.config
    return of_config(config), config.material


def by_batch(material, options):
    mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="ball", size=[0.01, 0, 0], pos=[0, -0.1, 0])
    biotac_mj.batch.add(spec, body="world", skin=SKIN, coupling="one-way")
    mjm = spec.compile()
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, mujoco.MjData(mjm), nworld=2)
    batch = biotac_mj.batch.attach(
        mjm, m, d, skin=SKIN, coupling="one-way", material=material, options=options
    )
    return batch.senses.film.film, batch.skin.model.material


def by_generate(material, options):
    maker = Maker(GenerateOptions(count=1, labelled=0, skin=SKIN, material=material, options=options), {})
    return FilmConduction(maker.geometry, **maker.film), maker.model.material


def by_diagnose(material, options):
    model, film = Simulator(skin=SKIN, material=material, options=options or {}).skin_and_film(0.0, 0.0)
    return film, model.material


WAYS = [by_attach, by_press, by_tasks, by_batch, by_generate, by_diagnose]


@pytest.mark.parametrize("way", WAYS)
def test_one_name_is_rubber_and_electrodes(way):
    film, rubber = way("calibrated", None)
    assert film.electrode_radius == CALIBRATED.electrode_radius
    assert rubber in ("calibrated", CALIBRATED)


@pytest.mark.parametrize("way", WAYS)
def test_options_go_before_the_material(way):
    film, _ = way("calibrated", {"film": {"electrode_radius": 7e-4, "residual_film": 3e-5}})
    assert (film.electrode_radius, film.residual_film) == (7e-4, 3e-5)


def test_the_default_film_is_its_own():
    assert film_of(Config()) == {} and read_film({"excitation": [[0, 1]] * 4}) == {"excitation": [[0, 1]] * 4}
    assert film_of(Config(material={"youngs_modulus": 1e6, "electrode_radius": 8e-4})) == {
        "electrode_radius": 8e-4
    }


@pytest.mark.parametrize(
    ("film", "said"),
    [
        (3, r"options\['film'\] is 3: a dict is needed"),
        ({"radius": 1e-3}, r"options\['film'\] has 'radius'"),
        ({"electrode_radius": "1"}, r"electrode_radius of options\['film'\] is '1': pass a number"),
        ({"electrode_radius": 0.0}, "electrode_radius is 0.0: give a finite number > 0"),
        ({"residual_film": float("inf")}, "residual_film is inf: give a finite number > 0"),
        ({"excitation": [[0, 1]]}, r"excitation is \[\[0, 1\]\]: pass \(4, 2\) finite numbers"),
    ],
)
def test_a_film_that_cannot_be_is_refused_at_once(film, said):
    with pytest.raises(ValueError, match=said):
        biotac_mj.attach(mujoco.MjSpec(), body="world", skin=SKIN, options={"film": film})


def test_paths_without_a_film_refuse_it():
    pytest.importorskip("torch", reason="needs torch: pip install biotac_mj[learning]")
    with pytest.raises(ValueError, match="a network replaces the film"):
        biotac_mj.attach(mujoco.MjSpec(), body="world", signal="learned", options={"film": {}})
    with pytest.raises(ValueError, match="options has 'film'"):
        read_settings(None, {"film": {}})


def test_wider_electrodes_rest_alike_and_respond_less_sharply():
    """Cell constants take the radius out at rest; under a press the change of ln Z is another one."""
    geometry = load_skin(SKIN)
    thin = geometry.vert.copy()
    thin[:, 1] += 3e-4 * (geometry.vert[:, 1] < -5e-3)
    films = [FilmConduction(geometry, electrode_radius=radius) for radius in (5e-4, 9e-4)]
    np.testing.assert_allclose(films[0].rest, films[1].rest, rtol=1e-9)
    a, b = (np.log(film.impedance(thin) / film.rest) for film in films)
    assert np.abs(a - b).max() > 0.02


def test_the_material_fills_the_skin_unless_options_differ():
    pressure = CALIBRATED.rest_pressure
    assert pressure > 0
    for options, found in (
        (None, pressure),
        ({"skin": {"rest_pressure": 0.0}}, 0.0),
        ({"skin": {"fill_volume": 1e-9}}, 0.0),
        ({"skin": {"liquid": False}}, 0.0),
    ):
        assert read_settings("calibrated", options).options.rest_pressure == found
    model = SkinModel(load_skin(SKIN), "calibrated")
    assert model.rest.pressure == pytest.approx(pressure, rel=1e-3)
    assert SkinModel(load_skin(SKIN)).options.rest_pressure == 0.0
    with pytest.raises(ValueError, match="a world's material has a rest_pressure of 0.0"):
        SkinData(model, 2, [CALIBRATED, dataclasses.replace(CALIBRATED, rest_pressure=0.0)])
