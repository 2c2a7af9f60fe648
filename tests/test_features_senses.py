"""The table of the sensor's features (`scripts/features.py`), walked: every yes is a press that slides,
on which a channel reads otherwise with the feature, every no says what the table says."""

import dataclasses
import functools

import mujoco
import numpy as np
import pytest
import warp as wp
from features import SENSE_PATHS, SENSES
from test_batch import RADIUS, shell

import biotac_mj
from biotac_mj.data.generation.generate import GenerateOptions
from biotac_mj.data.generation.making import Maker
from biotac_mj.data.generation.plan import Motion
from biotac_mj.data.generation.readings import read_motion
from biotac_mj.data.generation.simulate import simulate
from biotac_mj.data.generation.vary import draw_sense
from biotac_mj.press import PressOptions, press
from biotac_mj.sensor.channels import CHANNELS, NELECTRODE
from biotac_mj.sensor.film import FilmConduction, read_film

DT, N, SEED = 8e-3, 45, 3
WAY = np.stack(
    [
        -0.012 + 6e-5 * np.maximum(0, np.arange(N) - 20),
        -0.0108 + 4e-5 * np.minimum(np.arange(N), 20),
        1e-5 * np.maximum(0, np.arange(N) - 20),
    ],
    1,
)
MATERIAL = {"friction": 0.1}  # slides


def named(settings, name):
    """Settings with the touched geom's name."""
    return {
        key: {name: value["touched"]} if key in ("thermal", "textures") else value
        for key, value in settings.items()
    }


def scene():
    spec = mujoco.MjSpec()
    spec.option.timestep = DT
    pin = spec.worldbody.add_body(name="pin", pos=[-0.012, -0.03, 0], mocap=True)
    pin.add_geom(
        name="pin", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], friction=[0, 0.005, 1e-4]
    )
    return spec


def by_attach(settings, file, tier="full"):
    spec = scene()
    mine = named(settings, "pin")
    mine["options"] = {"readings": {"noise": False}, **mine.get("options", {})}
    handle = biotac_mj.attach(
        spec, body="world", skin=file, tier=tier, material=MATERIAL, coupling="one-way", seed=SEED, **mine
    )  # fmt: skip
    model = spec.compile()
    data, rows = mujoco.MjData(model), []
    for at in WAY:
        data.mocap_pos[0] = at
        mujoco.mj_step(model, data)
        rows.append({c: handle.read(data, c) for c in ("electrodes", "pdc", "pac", "tac")})
    return {c: np.array([row[c] for row in rows]) for c in rows[0]}


def by_batch(settings, file):
    mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        spec = scene()
        biotac_mj.batch.add(spec, body="world", skin=file, coupling="one-way")
        mjm = spec.compile()
        mjd = mujoco.MjData(mjm)
        mujoco.mj_forward(mjm, mjd)
        m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=1)
        biotac_mj.batch.attach(
            mjm, m, d, skin=file, material=MATERIAL, coupling="one-way", seed=SEED,
            readings={"noise": False}, **named(settings, "pin"),
        )  # fmt: skip
        rows = []
        for at in WAY:
            d.mocap_pos.assign(at.astype(np.float32)[None, None])
            mjw.step(m, d)
            seen, now = d.sensordata.numpy()[0], {}
            for channel in ("electrodes", "pdc", "pac", "tac"):
                sensor = mjm.sensor(f"biotac_{channel}")
                now[channel] = seen[sensor.adr[0] : sensor.adr[0] + sensor.dim[0]].copy()
            rows.append(now)
    return {c: np.array([row[c] for row in rows]) for c in rows[0]}


def by_tasks(settings, file):
    tasks = pytest.importorskip("biotac_mj.tasks", reason="needs dm_control: pip install biotac_mj[control]")
    mine = {"skin": "coarse", "noise": False, "material": MATERIAL, **named(settings, "plate")}
    env = tasks.load("finger", "press", task_kwargs={"random": SEED, "biotac": mine})
    names = {n.split("/")[-1]: n for n in env.observation_spec()}
    axes, rows = env.action_spec().name.split("\t"), []
    env.reset()
    for i in range(34):
        action = np.zeros(len(axes))
        action[axes.index("z")], action[axes.index("x")] = (-1.0, 0.0) if i < 20 else (0.0, 1.0)
        step = env.step(action)
        rows.append({c: np.ravel(step.observation[names[c]]) for c in ("electrodes", "pdc", "pac", "tac")})
    return {c: np.array([row[c] for row in rows]) for c in rows[0]}


def _by_channel(counts, pac):
    one = {name: counts[:, CHANNELS.index(name)][:, None] for name in ("pdc", "tac")}
    return {"electrodes": counts[:, :NELECTRODE], "pac": pac, **one}


def by_press(settings, file):
    """Its table has one sample of PAC a step."""
    mine = {"texture" if key == "textures" else key: value for key, value in named(settings, "it").items()}
    mine = {key: value["it"] if key in ("texture", "thermal") else value for key, value in mine.items()}
    options = PressOptions(
        indenter=f"geom:sphere:{RADIUS}", depth=1e-3, slide=1e-3, skin=file, material=MATERIAL, timestep=DT,
        seed=SEED, **mine,
    )  # fmt: skip
    counts = press(options, progress=False)[0].counts
    return _by_channel(counts, counts[:, [CHANNELS.index("pac")]])


@functools.cache
def walked(file, tier, shaken):
    """Maker and fields of the way; the press does not depend on the sensor."""
    texture = {"roughness": 1e-6} if shaken else None
    chosen = GenerateOptions(
        count=1, labelled=0, steps=N, rate=1 / DT, skin=file, tier=tier, material=MATERIAL, texture=texture
    )
    maker = Maker(chosen, {})
    motion = Motion("walk", {}, WAY, np.tile(np.eye(3), (N, 1, 1)))
    tool = f"geom:sphere:{RADIUS}"
    return maker, simulate(maker.model, tool, [motion], None, maker.time, modes=maker.modes, tier=tier)


def by_generate(settings, file, tier="full"):
    maker, fields = walked(file, tier, "textures" in settings)
    mine = {"texture" if key == "textures" else key: value for key, value in named(settings, "it").items()}
    mine = {key: value["it"] if key in ("texture", "thermal") else value for key, value in mine.items()}
    options = dataclasses.replace(maker.options, **mine)
    sense, _ = draw_sense(options, [SEED, 0, 3], maker.few)
    film = FilmConduction(maker.geometry, **read_film((options.options or {}).get("film")))
    x = fields.vert_xpos(maker.geometry.vert, 0)
    read = read_motion(film, x, maker.time, fields.pressure[0], 1, sense, fields.touch(maker.model, 0))
    return _by_channel(read.counts, read.pac)


WALKS = {
    "attach": by_attach,
    "condensed": functools.partial(by_attach, tier="condensed"),
    "batch": by_batch,
    "tasks": by_tasks,
    "press": by_press,
    "generate": by_generate,
    "quick set": functools.partial(by_generate, tier="condensed"),
}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("skin") / "shell.npz"
    shell().save(path)
    return str(path)


@functools.cache
def plain(path, file):
    return WALKS[path]({}, file)


def test_every_path_is_walked():
    assert set(WALKS) == set(SENSE_PATHS)


def cells():
    """All of the table. Every day all senses by `attach` with the cheaper tier, one by each other
    path, and all that is refused."""
    for i, path in enumerate(SENSE_PATHS):
        for k, sense in enumerate(SENSES):
            quick = path == "condensed" or k == i or sense.cell(path) is not None
            marks = () if quick else pytest.mark.slow
            yield pytest.param(path, sense, id=f"{path}-{sense.name}", marks=marks)


@pytest.mark.parametrize(("path", "sense"), cells())
def test_a_sense_changes_its_channel_or_is_refused(path, sense, file):
    refused = sense.cell(path)
    if refused is not None:
        with pytest.raises(ValueError, match=refused.match):
            WALKS[path](sense.settings, file)
        return
    without, with_it = plain(path, file), WALKS[path](sense.settings, file)
    change = np.abs(with_it[sense.channel] - without[sense.channel])
    assert change.max() >= sense.least, f"{change.max()} counts"
