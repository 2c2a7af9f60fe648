"""`attach` puts a BioTac into any model, and says what is wrong when it cannot."""

import dataclasses
import inspect
import json
import re
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import spring_skin

import biotac_mj
from biotac_mj import batch
from biotac_mj.coupling import (
    Config,
    ContactSettings,
    SensorSettings,
    SettingKeywords,
    Settings,
    SkinSettings,
    attach,
    structs,
)
from biotac_mj.coupling.setup import Setup
from biotac_mj.coupling.show import electrode_colors
from biotac_mj.sensor.colors import FULL_CHANGE, change_map

WORLD = """<mujoco><worldbody><site name="mount" pos="0 0 .1" quat=".6 .8 0 0"/>
  <body name="arm" pos="0 .2 0"><joint name="elbow" axis="1 0 0"/>
    <geom name="arm" type="capsule" size=".01 .05" pos="0 0 -.08"/>
    <body name="hand"><joint name="wrist" axis="1 0 0"/>
      <geom name="hand" type="box" size=".01 .01 .01" pos="0 0 .06"/></body></body>
  <body name="cup" pos="0 0 1"><freejoint/><geom name="cup" type="sphere" size=".02" friction="0.4 0 0"/>
    <geom type="sphere" size=".01" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""


FEM = {"stepper": "fem", "skin": "coarse", "readings": "biotac"}


def spec_of(text=WORLD):
    return mujoco.MjSpec.from_string(text)


def springs(spec, **settings):
    place = {} if {"site", "body"} & settings.keys() else {"body": "world"}
    spring = {"skin": spring_skin.pad_geometry(), "stepper": "springs", "readings": "sum"}
    return attach(spec, **(spring | place | settings))


def touching(model, index=0):
    setup = Setup(structs.ModelView(model._address), index)
    return [g.name for g in setup.touching.geoms], setup


@pytest.fixture(autouse=True)
def no_errors():
    yield
    biotac_mj.plugin.check()


def test_pose_is_that_of_the_site_then_pos_and_quat():
    spec = spec_of()
    handle = springs(spec, site="mount", pos=[0.01, 0.02, 0.03], quat=[np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    turn, own = np.empty(9), np.empty(9)
    mujoco.mju_quat2Mat(turn, [0.6, 0.8, 0, 0])
    mujoco.mju_quat2Mat(own, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    np.testing.assert_allclose(
        data.body(handle.body).xpos, [0, 0, 0.1] + turn.reshape(3, 3) @ [0.01, 0.02, 0.03], atol=1e-12
    )
    np.testing.assert_allclose(
        data.body(handle.body).xmat.reshape(3, 3), turn.reshape(3, 3) @ own.reshape(3, 3), atol=1e-12
    )


def test_model_carries_the_skins_parts():
    spec, geometry = spec_of(), spring_skin.pad_geometry()
    handle = springs(spec, body="hand", prefix="tip_", skin=geometry)
    model = spec.compile()
    data = mujoco.MjData(model)
    for i, position in enumerate(geometry.electrode_pos, start=1):
        np.testing.assert_allclose(model.site(f"tip_e{i}").pos, position)
    node = np.unique(geometry.outer_face)
    np.testing.assert_allclose(model.skin_vert, geometry.vert[node], atol=1e-7)
    assert model.body(handle.body).parentid == model.body("hand").id
    dims = {
        c: model.sensor(handle.sensor_name(c)).dim[0]
        for c in ("electrodes", "pdc", "pac", "tac", "tdc", "contact_force", "status")
    }
    assert dims == dict(electrodes=19, pdc=1, pac=22, tac=1, tdc=1, contact_force=6, status=8)
    # the rigid core's mesh lies where the geometry says, whatever frame MuJoCo stores it in
    mujoco.mj_forward(model, data)
    geom = model.geom("tip_core")
    mesh = model.mesh(geom.dataid[0])
    world = (
        model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
        @ data.geom(geom.id).xmat.reshape(3, 3).T
        + data.geom(geom.id).xpos
    )
    local = (world - data.body(handle.body).xpos) @ data.body(handle.body).xmat.reshape(3, 3)
    np.testing.assert_allclose(
        sorted(local.round(6).tolist()), sorted(geometry.core_vert.round(6).tolist()), atol=1e-6
    )


def test_geoms_that_touch_by_default():
    """Colliding geoms, but those of the link it is fixed to, of the link's parent (as in MuJoCo's own
    filter), and of excluded bodies."""
    spec = spec_of()
    springs(spec, body="hand")
    assert touching(spec.compile())[0] == ["cup"]
    spec = spec_of(
        WORLD.replace("</worldbody>", '<geom name="floor" type="plane" size="1 1 1"/></worldbody>')
    )
    springs(spec, body="hand")
    names, setup = touching(spec.compile())
    assert sorted(names) == ["cup", "floor"]
    assert setup.touching.geoms[names.index("cup")].friction == pytest.approx(
        0.783414394
    )  # MuJoCo's rule: the larger
    spec = spec_of(
        WORLD.replace("</mujoco>", '<contact><exclude body1="hand" body2="arm"/></contact></mujoco>')
    )
    springs(spec, geoms=["arm"], body="hand", rounding={"arm": 1e-3})
    names, setup = touching(spec.compile())
    assert names == ["arm"] and setup.touching.geoms[0].rounding == 1e-3


def test_masks_count_as_in_mujoco():
    """A geom of another group meets the skin no more than its core; one bit in common is enough."""

    def cup(contype, conaffinity):
        masks = f'contype="{contype}" conaffinity="{conaffinity}"'
        return spec_of(WORLD.replace('name="cup" type', f'name="cup" {masks} type'))

    for masks, touches in (((2, 2), False), ((2, 3), True), ((0, 1), True), ((1, 0), True), ((0, 0), False)):
        spec = cup(*masks)
        springs(spec, body="hand")
        assert touching(spec.compile())[0] == ["cup"] * touches, masks
    spec = cup(2, 2)
    handle = springs(spec, body="hand")
    for geom in spec.body(handle.body).geoms:
        geom.contype |= 2
    assert touching(spec.compile())[0] == ["cup"]


def test_excluded_bodies_do_not_touch():
    spec = spec_of()
    springs(spec, body="hand")
    spec.add_exclude(bodyname1="biotac_core", bodyname2="cup")
    assert touching(spec.compile())[0] == []


def test_meshes_arrive_in_the_geoms_frame():
    text = WORLD.replace(
        "<worldbody>",
        '<asset><mesh name="tetra" vertex="0 0 0  .02 0 0  0 .02 0  0 0 .02"/></asset><worldbody>',
    )
    text = text.replace(
        "</worldbody>",
        '<body name="t" pos="1 0 0"><freejoint/><geom name="t" type="mesh" mesh="tetra"/></body></worldbody>',
    )
    spec = spec_of(text)
    springs(spec, body="hand", geoms=["t"])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom = touching(model)[1].touching.geoms[0]
    world = geom.vert @ data.geom("t").xmat.reshape(3, 3).T + data.geom("t").xpos - [1, 0, 0]
    np.testing.assert_allclose(
        sorted(world.round(6).tolist()), [[0, 0, 0], [0, 0, 0.02], [0, 0.02, 0], [0.02, 0, 0]], atol=1e-6
    )
    assert geom.face.shape == (4, 3)


def test_saved_xml_says_everything(tmp_path):
    spec = spec_of()
    handle = springs(
        spec, body="hand", rounding={"cup": 2e-3}, options={"stiffness": 500.0}, seed=7, coupling="one-way"
    )
    model = spec.compile()
    (tmp_path / "model.xml").write_text(spec.to_xml())
    again = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    assert touching(again)[1].config == handle.config == touching(model)[1].config
    a, b = mujoco.MjData(model), mujoco.MjData(again)
    mujoco.mj_step(model, a, 10)
    mujoco.mj_step(again, b, 10)
    np.testing.assert_allclose(a.sensordata, b.sensordata, rtol=1e-6)


def test_a_hand_with_biotacs_can_itself_be_attached():
    hand = spec_of(
        '<mujoco><worldbody><body name="palm"><geom type="box" size=".01 .01 .01" pos="0 0 '
        '-.03"/></body></worldbody></mujoco>'
    )
    for side in ("left", "right"):
        springs(hand, body="palm", prefix=f"{side}_", slots=4)
    scene = spec_of(WORLD)
    scene.attach(hand, frame=scene.worldbody.add_frame(pos=[0, 0, 0.5]), prefix="robot_")
    model = scene.compile()
    assert model.nplugin == 2
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 3)
    for side in ("left", "right"):
        assert data.sensor(f"robot_{side}_electrodes").data[0] == 3003  # "sum" counts steps
        assert data.sensor(f"robot_{side}_status").data[0] == 1


def test_room_for_more_bodies_must_be_there():
    spec = spec_of()
    springs(spec, body="hand", slots=0)
    with pytest.warns(
        RuntimeWarning,
        match=r"1 bodies can touch the BioTac 'biotac_core' but it has room for 0: give slots=1 to attach or "
        r"tasks.BioTac",
    ):
        with pytest.raises((ValueError, mujoco.FatalError)):
            mujoco.MjData(spec.compile())
    with pytest.raises(ValueError, match="room for 0"):
        biotac_mj.plugin.check()


@pytest.mark.parametrize(
    "settings, text",
    [
        (dict(site="top"), r"no site 'top' to attach to: the model has mount"),
        (dict(body="foot"), r"no body 'foot' to attach to: the model has world, arm, hand, cup"),
        (dict(site="mount", body="arm"), r"both site 'mount' and body 'arm' are given"),
        (dict(coupling="both"), r"unknown coupling 'both': choose one of two-way, one-way"),
        (dict(geoms=["cups"]), r"no geom 'cups' to touch: the model has arm, hand, cup"),
        (dict(rounding={"edge": 1e-3}), r"no geom 'edge' to touch"),
        (dict(friction=-1.0), r"the skin's friction is -1.0: give a finite number >= 0"),
        (dict(friction=float("nan")), r"the skin's friction is nan"),
        (dict(stepper="femm"), r"unknown stepper 'femm': choose one of .*springs"),
        (dict(readings="volts"), r"unknown readings 'volts': choose one of biotac, "),
        (dict(skin="/no/such/skin.npz"), r"no skin at .*skin.npz"),
        (dict(skin=3), r"skin is 3: pass one of coarse"),
        (dict(body=None), r"no place is given: pass site= or body=; body='world'"),
        (dict(pos=(0, 0)), r"pos is \(0, 0\): give 3 numbers"),
        (dict(pos=(0, 0, np.nan)), r"pos .* has an element that is nan: give a finite number"),
        (dict(quat=(0, 0, 0, 0)), r"quat is zero: give a rotation"),
        (dict(quat=(1, 0, np.inf, 0)), r"quat .* has an element that is inf"),
        (dict(prefix=None), r"prefix is None: give a text"),
        (dict(liquid="no"), r"liquid is 'no': pass true or false"),
        (dict(geoms="cup"), r"geoms is 'cup': give a list of names"),
        (dict(rounding={"cup": -1e-3}), r"rounding of 'cup' is -0.001: give a finite number >= 0"),
        (dict(rounding=1e-3), r"rounding is 0.001: pass a dict"),
        (dict(friction="high"), r"the skin's friction is 'high': give a finite number >= 0"),
        (dict(priority=0.5), r"priority is 0.5: give a whole number"),
        (dict(seed=-1), r"seed is -1: give a whole number from 0"),
        (dict(slots=-1), r"slots is -1: give a whole number from 0"),
        (dict(on_error="ignore"), r"unknown on_error 'ignore': choose one of warn, raise"),
        (dict(device="cuda:99"), r"no device 'cuda:99' on this machine: it has .*cpu"),
        (dict(stepper=None), r"stepper is None: pass a text"),
        (dict(options=[]), r"options is \[\]: give a dict"),
        (FEM | dict(coupling="one-way", options={"rounds": 4}), "rounds of options is of coupling='two-way'"),
        *(
            (FEM | dict(options={"rounds": n}), f"rounds of options is {n!r}: give a")
            for n in (0, 2.5, "4", 1001)
        ),
        (FEM | dict(options={"readings": 3}), r"options\['readings'\] is 3: a dict is needed"),
        (FEM | dict(options={"readings": {"temperature": -280.0}}), r"is -280.0 C: give a finite number"),
        (
            FEM | dict(options={"effects": 1}),
            r"options has 'effects': choose from skin, modulus, film, readings, rounds",
        ),
        (FEM | dict(options={"skin": {"tol": 1}}), r"options\['skin'\] has 'tol'"),
        (
            FEM | dict(options={"modulus": [1.0]}),
            r"modulus has shape \(1,\): give one factor for each of the",
        ),
        (FEM | dict(options={"modulus": "/no/such.npy"}), r"no modulus at /no/such.npy"),
        (FEM | dict(options={"readings": {"nois": 1}}), r"has 'nois': did you mean 'noise'\?"),
        (FEM | dict(options={"readings": {"noise": "a"}}), r"noise of options\['readings'\] is 'a'"),
        (FEM | dict(options={"readings": {"sensor": "9"}}), r"sensor is '9': pass one of '1', '2', '3'"),
        (
            FEM | dict(options={"readings": {"temperature": np.nan}}),
            r"temperature of options\['readings'\] is nan",
        ),
        (FEM | dict(material={"youngs_modulus": np.nan}), r"youngs_modulus is nan"),
        (FEM | dict(tier="condensed", options={"skin": {"dynamics": "implicit"}}), r"has no inertia"),
        (
            FEM | dict(liquid=False, options={"skin": {"fill_volume": 1e-8}}),
            r"fill_volume .* of the liquid, and this skin has none: turn it on",
        ),
        (FEM | dict(options={"skin": {"fill_volume": 1e-3}}), r"fill_volume 0.001 .*: take less than 1.75"),
        (
            FEM | dict(skin="coarse", options={"skin": {"rest_pressure": 1e7}}),
            r"no equilibrium .* of rest_pressure 1e\+07: .*; take less",
        ),
        (
            FEM | dict(liquid=True, options={"skin": {"liquid": False}}),
            r"liquid is True and options\['skin'\] has False: give one of them",
        ),
        (
            FEM | dict(sensor="epfl_f1", options={"readings": {"sensor": "phac_f0"}}),
            r"sensor is 'epfl_f1' and options\['readings'\] has 'phac_f0': give one of them",
        ),
        (FEM | dict(sensor={"pdc_rest": 5000}), r"pdc_rest of a sensor is 5000.0: rest counts .* 0 and 4095"),
        (FEM | dict(sensor={"pac_rest": -5}), r"pac_rest of a sensor is -5.0: rest counts"),
        (FEM | dict(options={"readings": {"temperature": 5e3}}), r"up to 73.96 \(TDC shows no more\)"),
        (
            FEM | dict(options={"film": {"electrode_radius": 1.0}}),
            r"electrode_radius is 1.0: the electrodes would touch; pass less than 0.0014 m",
        ),
        (FEM | dict(options={"film": {"electrode_radius": 2e-3}}), r"the electrodes would touch"),
        (
            FEM | dict(options={"film": {"residual_film": 1.0}}),
            r"residual_film is 1.0: the film at rest is nowhere thicker than 0.0024 m",
        ),
        (FEM | dict(thermal={"cup": []}), r"thermal is \[\]: give a material's name"),
        (
            FEM | dict(thermal={"cup": ["steel", "steel at"]}),
            r"material's name is 'steel at': give words alone",
        ),
        (FEM | dict(textures={"cup": []}), r"texture is \[\]: give a material's name"),
        (FEM | dict(textures={"cup": "cork at 40"}), r"material's name is 'cork at 40': give words alone"),
        (
            FEM | dict(textures={"cup": {"pitch": 1e-3, "height": 1.0}}),
            r"height of a texture is 1.0: .* what is larger is shape",
        ),
        (FEM | dict(textures={"cup": {"pitch": 1e-9, "height": 1e-5}}), r"pitch of a texture is 1e-09"),
        (FEM | dict(textures={"cup": {"roughness": True}}), r"roughness of a texture is True"),
    ],
)
def test_bad_settings_are_refused_at_once(settings, text):
    """... and leave the spec as it was."""
    spec = spec_of()
    before = spec.to_xml()
    with pytest.raises((ValueError, FileNotFoundError), match=text):
        springs(spec, **settings)
    assert spec.to_xml() == before


def test_every_seed_that_is_allowed_draws_a_sensor():
    """Up to 2^64 - 1, each its own."""
    seeds = (2**63, 2**63 + 1, 2**64 - 1)
    drawn = [springs(spec_of(), **FEM | dict(sensor="random", seed=seed)).numbers for seed in seeds]
    assert len({sensor.rest for sensor in drawn}) == 3


def test_what_both_places_say_alike_is_taken():
    given = {"skin": {"liquid": False}, "readings": {"sensor": "phac_f0"}}
    handle = springs(spec_of(), **FEM | dict(liquid=False, sensor="phac_f0", options=given))
    assert handle.numbers.pdc_rest == 1075


def test_what_is_no_spec_is_refused():
    with pytest.raises(TypeError, match="spec is MjModel: pass a mujoco.MjSpec"):
        springs(spec_of().compile(), body="hand")


def test_packages_that_are_missing_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "biotac_mj.learning.serve", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"needs torch: pip install 'biotac-mj\[learning\]'"):
        springs(spec_of(), **FEM | {"readings": "learned"})


def test_a_prefix_serves_one_biotac():
    spec = spec_of()
    springs(spec, body="hand")
    with pytest.raises(ValueError, match="prefix 'biotac_' is taken by another BioTac"):
        springs(spec, body="arm")


def test_an_unknown_channel_is_refused():
    handle = springs(spec_of())
    with pytest.raises(ValueError, match="has no channel 'e20': choose one of electrodes, pdc"):
        handle.sensor_name("e20")


def test_readings_are_left_out_or_set_as_in_a_batch():
    """By True, False or a dict, which stands for options["readings"] and has its signal besides."""

    def config(**settings):
        return attach(spec_of(), body="hand", skin="coarse", **settings).config

    assert config(readings=False) == config(readings="none") != config()
    assert config(readings=True) == config() == config(readings="biotac")
    quiet = {"noise": False, "film_every_step": True}
    assert config(readings=quiet) == config(options={"readings": quiet}) != config()
    nested = SensorSettings(individual="epfl_f1", options={"noise": False})
    told = config(sensor="epfl_f1", readings={"noise": False})
    assert config(readings={"sensor": "epfl_f1", "noise": False}) == told
    assert config(settings=Settings(sensor=nested)) == told
    both = config(readings={"noise": False}, options={"readings": {"film_every_step": True}}, sensor="2")
    assert both.options["readings"] == quiet | {"sensor": "2"}
    for wrong, said in (
        ({"readings": {"nose": 1}}, "did you mean 'noise'"),
        ({"readings": {"noise": 5}}, "noise"),
        ({"readings": {"noise": True}, "options": {"readings": {"noise": False}}}, "give one of them"),
        ({"readings": {"signal": "learned"}, "signal": "physics"}, "signal is 'physics' and readings has"),
        ({"readings": {"signal": "telepathy"}}, "unknown signal 'telepathy'"),
        ({"readings": False, "sensor": "2"}, "readings is False: leave signal, sensor"),
        ({"readings": {}, "options": {"readings": 5}}, "5"),
        ({"readings": {}, "options": 5}, "options is 5: give a dict"),
    ):
        with pytest.raises(ValueError, match=said):
            config(**wrong)


def test_all_channels_are_read_at_once():
    spec = spec_of()
    handle = springs(spec, body="hand")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.sensordata[:] = np.arange(model.nsensordata)
    read = handle.read(data)
    assert {handle.sensor_name(name) for name in read} == {model.sensor(i).name for i in range(model.nsensor)}
    for name, values in read.items():
        np.testing.assert_array_equal(values, handle.read(data, name))
    assert sorted(np.concatenate(list(read.values()))) == list(range(model.nsensordata))


def test_own_geoms_cannot_be_named():
    spec = spec_of()
    springs(spec, body="hand", geoms=["hand"])
    with (
        pytest.warns(RuntimeWarning, match="geom 'hand' is fixed to the BioTac and cannot touch it"),
        pytest.raises((ValueError, mujoco.FatalError)),
    ):
        mujoco.MjData(spec.compile())
    biotac_mj.plugin.clear_errors()


def test_settings_survive_as_text():
    config = Config(geoms=["a"], rounding={"a": 1e-3}, material={"young": 1e6}, seed=3, liquid=False)
    strings = config.strings()
    assert Config.parse(lambda name: strings.get(name, "")) == config
    assert Config.parse(lambda name: "") == Config()
    with pytest.raises(ValueError, match="plugin setting skin='coarse' is not JSON"):
        Config.parse(lambda name: "coarse" if name == "skin" else "")


def test_plain_mjcf_loads_without_the_plugin():
    code = (
        "import pathlib, mujoco\n"
        "folder = pathlib.Path(r'{}')\n"
        "m = mujoco.MjModel.from_xml_path(str(folder / 'biotac.xml'))\n"
        "assert m.nplugin == 0 and m.nsensordata == 58 and m.nskin == 1 and abs(m.body_mass[1] - 0.003965) "
        "< 1e-9\n"
        "mujoco.MjModel.from_xml_path(str(folder / 'scene_press.xml'))\n"
    )
    import importlib.resources

    with importlib.resources.as_file(importlib.resources.files("biotac_mj.mjcf")) as folder:
        assert subprocess.run([sys.executable, "-c", code.format(folder)]).returncode == 0


def test_inertia_in_the_mjcf_is_that_of_the_default_skin():
    """Mass, centre and inertia from the parts' volumes, by the divergence theorem over their surfaces and
    sums over the tetrahedra."""
    geometry = biotac_mj.load_skin("default")
    mass, first, second = 0.0, np.zeros(3), np.zeros((3, 3))

    def add(density, corner, sign=1.0):
        nonlocal mass, first, second
        m = sign * density * np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6
        total = corner.sum(axis=1)
        mass, first = mass + m.sum(), first + np.einsum("n,ni->i", m, total) / 4
        second = (
            second
            + (np.einsum("n,nai,naj->ij", m, corner, corner) + np.einsum("n,ni,nj->ij", m, total, total)) / 20
        )

    def cone(vert, face):
        return np.concatenate([np.zeros((len(face), 1, 3)), vert[face]], axis=1)

    add(1050.0, geometry.vert[geometry.tets])
    for part in ("core", "nail", "clamp"):
        add(1200.0, cone(getattr(geometry, f"{part}_vert"), getattr(geometry, f"{part}_face")))
    # liquid: the cavity, whose face normals point inwards,
    add(1000.0, cone(geometry.vert, geometry.inner_face), -1.0)
    add(1000.0, cone(geometry.core_vert, geometry.core_face), -1.0)  # without the core
    center = first / mass
    inertia = (
        np.trace(second) * np.eye(3)
        - second
        - mass * (center @ center * np.eye(3) - np.outer(center, center))
    )
    import importlib.resources

    with importlib.resources.as_file(importlib.resources.files("biotac_mj.mjcf")) as folder:
        model = mujoco.MjModel.from_xml_path(str(folder / "biotac.xml"))
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[1])
    stored = axes.reshape(3, 3) @ np.diag(model.body_inertia[1]) @ axes.reshape(3, 3).T
    assert model.body_mass[1] == pytest.approx(mass, rel=0.02)
    np.testing.assert_allclose(model.body_ipos[1], center, atol=1e-4)
    np.testing.assert_allclose(stored, inertia, atol=0.02 * inertia.max())


def test_a_map_of_electrodes_has_the_colors_of_the_render():
    change = np.linspace(-FULL_CHANGE, FULL_CHANGE, 257)
    share = 0.5 + 0.5 * change / FULL_CHANGE
    np.testing.assert_allclose(change_map()(share), electrode_colors(change), atol=0.01)


def test_colors_of_electrodes_show_sign_and_size():
    colors = electrode_colors(np.array([0.0, -300.0, 900.0]))
    np.testing.assert_allclose(colors, [[0.85, 0.85, 0.85, 1], [0.8, 0.15, 0.1, 1], [0.1, 0.3, 0.85, 1]])


def test_scene_update_shows_skin_and_electrodes():
    spec = spec_of(
        '<mujoco><worldbody><body name="ball" mocap="true" pos="-.01 -.0175 0"><geom type="sphere" '
        'size=".01"/></body></worldbody></mujoco>'
    )
    springs(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    scene = mujoco.MjvScene(model, maxgeom=100)
    mujoco.mjv_updateScene(
        model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL, scene
    )
    dent = np.abs(model.skin_vert[:, 1] - spring_skin.HEIGHT).max()
    assert dent == pytest.approx(0.5e-3, rel=0.05)  # the ball is half a millimetre deep
    # what is drawn, after MuJoCo's own skinning, is the dented surface of this very update
    drawn = np.array(scene.skinvert).reshape(-1, 3)[: model.nskinvert]
    np.testing.assert_allclose(drawn, model.skin_vert, atol=1e-6)
    assert len(np.unique(model.site_rgba[[model.site(f"biotac_e{i}").id for i in range(1, 20)]], axis=0)) > 1


def test_dm_control_loads_and_steps_it(tmp_path):
    dm_control = pytest.importorskip("dm_control.mujoco", reason="needs dm_control (extra control)")
    spec = spec_of()
    springs(spec, body="hand")
    spec.compile()
    physics = dm_control.Physics.from_xml_string(spec.to_xml())
    for _ in range(3):
        physics.step()
    # dm_control ends a step with mj_step1, which already shows the readings of the next one
    assert physics.named.data.sensordata["biotac_electrodes"][0] == 3004
    assert physics.named.data.sensordata["biotac_status"][0] == 1
    copied = physics.copy(share_model=True)
    physics.step()
    copied.step()
    assert np.array_equal(physics.data.sensordata, copied.data.sensordata)
    physics.reset()
    assert physics.data.plugin_state[0] == 0


def test_nodes_of_the_skin_from_the_handle():
    """`Handle.vert_xpos` gives the skin at rest, and of the right BioTac where there are two."""
    spec = mujoco.MjSpec()
    a = biotac_mj.attach(spec, body="world", prefix="a_", skin="coarse")
    b = biotac_mj.attach(spec, body="world", prefix="b_", skin="default", pos=(0, 0, 1))
    model = spec.compile()
    data = mujoco.MjData(model)
    for handle, skin in ((a, "coarse"), (b, "default")):
        np.testing.assert_array_equal(handle.vert_xpos(model, data), biotac_mj.load_skin(skin).vert)


# MuJoCo 4 has no plugin for bodies of its own any more
CABLE = (
    """<mujoco><extension><plugin plugin="mujoco.elasticity.cable"/></extension><worldbody>
  <body><plugin plugin="mujoco.elasticity.cable"/><geom type="capsule" size=".005 .02"/></body>
  </worldbody></mujoco>"""
    if mujoco.__version__ < "4"
    else "<mujoco/>"
)


@pytest.mark.filterwarnings("ignore:Attach conflict")
def test_handles_of_a_model_from_a_file_or_with_new_names():
    """They read by the names that they have there, with their settings; a cable has another plugin."""
    spec = spec_of()
    own = [springs(spec, site="mount", prefix=name, seed=k) for k, name in enumerate(("a_", "b_"))]
    model = mujoco.MjModel.from_xml_string(spec.to_xml())
    found = biotac_mj.handles(model)
    assert list(found.values()) == own and list(found) == ["a_", "b_"]
    scene = mujoco.MjSpec.from_string(CABLE)
    scene.attach(spec, prefix="left_", suffix="_1", frame=scene.worldbody.add_frame())
    model = scene.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    found = biotac_mj.handles(model)
    assert list(found) == ["left_a__1", "left_b__1"]
    for handle, before in zip(found.values(), own):
        assert handle.config == before.config
        assert set(handle.read(data)) == set(biotac_mj.coupling.handle.SENSORS)
        assert handle.read(data, "status")[0] == 1
        assert len(handle.vert_xpos(model, data)) == spring_skin.pad_geometry().nvert
        with pytest.raises(ValueError, match=r"no sensor '[ab]_pdc'.*biotac_mj.handles\(model\) has"):
            before.read(data, "pdc")
    with pytest.raises(TypeError, match="model is MjSpec: pass the compiled MjModel"):
        biotac_mj.handles(spec)


PUTTING = {
    "attach": (attach, "spec"),
    "add": (batch.add, "spec"),
    "batch.attach": (batch.attach, "mjm m d"),
    "make": (batch.make, "mjm nworld device"),
    "hand": (biotac_mj.attach_to_hand, "spec hand"),
}


@pytest.mark.parametrize("name", PUTTING)
def test_attach_batch_and_press_take_the_same_settings(name):
    """All by name but the first; one name has one default, whether it is written out or one of the
    keywords."""
    function, first = PUTTING[name]
    own, all_of = inspect.signature(function).parameters, settings_of_attach()
    placed = [one.name for one in own.values() if one.kind is one.POSITIONAL_OR_KEYWORD]
    assert placed == first.split()
    shared = [one for one in own if one in all_of and one not in placed]
    assert shared and shared == [one for one in all_of if one in shared]
    assert [one for one in shared if own[one].default != all_of[one]] == []


def settings_of_attach():
    """Parameter or keyword of `attach` -> its default."""
    own = inspect.signature(attach).parameters.values()
    return {one.name: one.default for one in own if one.kind is one.KEYWORD_ONLY} | {
        name: default_of(name) for name in SettingKeywords.__annotations__
    }


def default_of(keyword):
    """That of the one field that is set by it; `options` sets several."""
    stages = Settings(), SkinSettings(), ContactSettings(), SensorSettings()
    fields = [(stage, one) for stage in stages for one in dataclasses.fields(stage)]
    keywords = [
        getattr(stage, one.name)
        for stage, one in fields
        if (one.metadata.get("keyword") or one.name) == keyword and not one.metadata.get("option")
    ]
    return keywords[-1] if keyword != "options" else None


def test_settings_by_stage_are_those_by_keyword(tmp_path):
    """As an object, as dicts and as a file; a keyword takes the place of what they say."""
    keywords = dict(
        skin="coarse",
        tier="condensed",
        material="rubber",
        friction=0.4,
        rounding={"cup": 1e-3},
        sensor="epfl_f1",
        readings={"noise": False},
        options={"skin": {"tolerance": 1e-3}, "film": {"residual_film": 1e-5}, "rounds": 8},
        seed=3,
        on_error="raise",
    )
    stages = dict(
        skin=dict(mesh="coarse", tier="condensed", material="rubber", options={"tolerance": 1e-3}),
        contact=dict(friction=0.4, rounding={"cup": 1e-3}, rounds=8),
        sensor=dict(individual="epfl_f1", options={"noise": False}, film={"residual_film": 1e-5}),
        seed=3,
        on_error="raise",
    )
    path = tmp_path / "settings.json"
    path.write_text(json.dumps(stages))
    wanted = attach(spec_of(), body="hand", **keywords).config
    for settings in (Settings(**stages), stages, path, str(path)):
        assert attach(spec_of(), body="hand", settings=settings).config == wanted
    seventh = attach(spec_of(), body="hand", settings=stages, seed=7, friction=None).config
    assert seventh == dataclasses.replace(wanted, seed=7)


@pytest.mark.parametrize(
    ("settings", "kind", "said"),
    [
        (dict(colour="red"), TypeError, "a call of attach has 'colour': choose from design, skin, material"),
        (dict(texture={}), TypeError, "a call of attach has 'texture': did you mean 'textures'?"),
        (dict(settings=3), ValueError, "settings is int: pass a dict"),
        (dict(settings={"skn": {}}), ValueError, "settings has 'skn': did you mean 'skin'?"),
        (
            dict(settings={"skin": {"tear": 1}}),
            ValueError,
            "skin of settings has 'tear': did you mean 'tier'?",
        ),
        (dict(settings={"contact": 3}), ValueError, "contact of settings is 3: give ContactSettings"),
        (dict(settings={"sensor": {"readings": False, "signal": "physics"}}), ValueError, "is False: leave"),
        (dict(settings="nowhere.json"), FileNotFoundError, "no settings at nowhere.json"),
    ],
)
def test_bad_settings_by_stage_are_refused(settings, kind, said):
    with pytest.raises(kind, match=re.escape(said)):
        attach(spec_of(), body="hand", **settings)
