"""The table of features and paths (`scripts/features.py`), walked: every yes is a small press whose force the
feature changes, every no says what the table says."""

import dataclasses
import functools
import json

import features
import mujoco
import numpy as np
import pytest
import warp as wp
from features import FEATURES, PATHS, Absent, Refused
from test_batch import shell

import biotac_mj
from biotac_mj.calibration.comparison import evaluate
from biotac_mj.calibration.configurations import Configuration
from biotac_mj.calibration.fit import forces_and_jacobian, parameter
from biotac_mj.calibration.forward import simulate as forward
from biotac_mj.calibration.indentation import Indentation
from biotac_mj.coupling import register_readings
from biotac_mj.data.generation.generate import GenerateOptions
from biotac_mj.data.generation.making import Maker
from biotac_mj.data.generation.plan import Motion
from biotac_mj.data.generation.simulate import simulate
from biotac_mj.data.generation.vary import draw_worlds
from biotac_mj.discrepancy.trajectories.model.simulator import Simulator
from biotac_mj.discrepancy.trajectories.trajectory import Trajectory
from biotac_mj.skin import GeomSet, SkinData, SkinModel, step
from biotac_mj.skin.per_world import make_room, make_worlds
from biotac_mj.skin.settings import read_settings

DT, RADIUS = 0.01, 3.5e-3
# of the sphere's centre, against where it meets the shell: down onto the core, along, half way back, off [mm]
DEPTH = np.array([-0.005, 0.4, 0.8, 1.2, 1.5, 1.5, 1.5, 0.8, 0.3, -0.04])
ALONG = np.array([0, 0, 0, 0, 0, 0.15, 0.3, 0.3, 0.3, 0.3])
TIP = np.stack([-12e-3 + 1e-3 * ALONG, -6.661e-3 + 1e-3 * DEPTH, 0 * DEPTH], 1)
CENTRE = TIP - [0, RADIUS, 0]
TOOL, FRICTION = f"geom:sphere:{RADIUS}", 0.4
QUICK = {"CPU", "CUDA", "worlds", "condensed"}  # the others take a second or more
# of the peak force: what counts as a change, where 2e-4 does not; `compare` tells a mean over the way
SEEN = {"compare": 5e-6, "CUDA": 5e-5}
BASE_SKIN = {"contact_stiffness": 5e10, "tolerance": 1e-5, "max_newton": 100, "liquid": True}


class NoReadings:
    """A BioTac without channels."""

    nstate, rest = 0, {}

    def __init__(self, config, geometry):
        pass

    def reset(self, state):
        pass

    def advance(self, state, *_):
        return {}


register_readings("none", NoReadings)


@functools.cache
def skin_file(folder):
    path = folder / "shell.npz"
    shell().save(path)
    return str(path)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """The shell as a file, as settings name it."""
    return skin_file(tmp_path_factory.getbasetemp())


def uneven(seed=0):
    """(nelem,) factors on Young's modulus that vary along the finger and from element to element."""
    x = shell().vert[shell().elem].mean(1)[:, 0]
    rng = np.random.default_rng(seed)
    return np.exp(60 * (x + 8e-3) * rng.choice([-1, 1])) * rng.uniform(0.7, 1.1, len(x))


def settings(feature, there):
    """material and options with a feature or without it."""
    change = {"material": feature.material, "skin": feature.skin} if there else feature.without
    material = {"friction": FRICTION} | feature.base_material | change.get("material", {})
    options = {"skin": BASE_SKIN | feature.base_skin | change.get("skin", {})}
    if feature.modulus and there:
        options["modulus"] = uneven()
    return json.loads(json.dumps(material)), options


def made(material, options, device="cpu", worlds=None):
    """SkinModel of settings; with room for worlds that differ."""
    material, skin, modulus = read_settings(material, options)
    skin, modulus = make_room(skin, modulus, worlds or {}, len(shell().elem))
    return SkinModel(shell(), material, skin, device, modulus=modulus)


def walk(model, data, device="cpu"):
    """(n, nworld, 3) force on the sphere."""
    n = data.nworld
    geoms = GeomSet(["sphere"], [(RADIUS,)], friction=[model.material.friction], nworld=n, device=device)
    out = []
    for centre in CENTRE:
        geoms.set_pose(np.tile(centre, (n, 1, 1)), np.tile(np.eye(3), (n, 1, 1, 1)))
        step(model, data, geoms, DT)
        out.append(data.wrench[:, 0, :3])
    assert not data.nonconverged.any()
    return np.array(out)


def by_step(material, options, file, worlds=None, device="cpu"):
    materials, values, n = differing(material, worlds)
    model = made(material, options, device, values)
    return walk(model, make_worlds(model, n, materials, values), device)


def by_many(material, options, file, worlds=None):
    out = []
    for device in ["cpu", *(["cuda:0"] if wp.is_cuda_available() else [])]:
        if worlds:
            out.append(by_step(material, options, file, worlds, device))
        else:
            model = made(material, options, device)
            out.append(walk(model, SkinData(model, 2), device)[:, :1])
    return np.concatenate(out)


def differing(material, worlds):
    """Materials of two worlds or None, values for `make_worlds`, number of worlds."""
    if not worlds:
        return None, {}, 1
    values = {name: value for name, value in worlds.items() if name != "material"}
    if "modulus" in values:
        values["modulus"] = np.stack([uneven(1), uneven(2)])
    materials = [read_settings(material | one).material for one in worlds.get("material", ())]
    return materials or None, values, 2


def pin():
    spec = mujoco.MjSpec()
    spec.option.timestep = DT
    body = spec.worldbody.add_body(name="pin", pos=CENTRE[0], mocap=True)
    body.add_geom(
        name="pin", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], friction=[0, 0.005, 1e-4]
    )
    return spec


def by_attach(material, options, file, worlds=None, tier="full", device="cpu"):
    spec = pin()
    handle = biotac_mj.attach(
        spec, body="world", skin=file, material=material, liquid=None, options=options, tier=tier,
        readings="none", coupling="one-way", device=device,
    )  # fmt: skip
    model = spec.compile()
    data = mujoco.MjData(model)
    out = []
    for centre in CENTRE:
        data.mocap_pos[0] = centre
        mujoco.mj_step(model, data)
        biotac_mj.plugin.check()
        out.append(-handle.read(data, "contact_force")[:3])
    assert handle.read(data, "status")[1] == 0
    return np.array(out)[:, None]


def by_batch(material, options, file, worlds=None):
    mjw = pytest.importorskip("mujoco_warp")
    from biotac_mj import batch as batches

    materials, values, _ = differing(material, worlds)
    spec = pin()
    batches.add(spec, body="world", skin=shell(), coupling="one-way")
    mjm = spec.compile()
    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        m, d = mjw.put_model(mjm), mjw.put_data(mjm, mujoco.MjData(mjm), nworld=2)
        batch = batches.attach(
            mjm, m, d, skin=shell(), material=materials or material, options=options, worlds=values,
            readings=False, coupling="one-way",
        )  # fmt: skip
        out = []
        for centre in CENTRE:
            d.mocap_pos.assign(np.tile(centre.astype(np.float32), (2, 1, 1)))
            mjw.step(m, d)
            out.append(batch.wrench[:, 0, :3])
        assert not batch.failed.numpy().any()
    return np.array(out)


def case():
    time = DT * np.arange(len(TIP))
    return Indentation("walk", TOOL, time, CENTRE, np.array([1.0, 0, 0, 0]), np.zeros((len(TIP), 3)))


def configured(options):
    material, skin, modulus = read_settings(None, options)
    return Configuration("shell", shell(), skin, modulus)


def by_calibrate(material, options, file, worlds=None):
    rubber, body = read_settings(material).material, configured(options)
    materials, _, _ = differing(material, worlds)
    if materials:
        answer = forward(body.geometry, body.options, materials, case(), modulus=body.modulus)
        return np.swapaxes(answer.force, 0, 1)
    p = parameter("E")
    force, jacobian, lost = forces_and_jacobian(body, rubber, [p], [rubber.youngs_modulus], case())
    assert lost == 0 and abs(jacobian).max() > 0.1
    return force[:, None]


def by_compare(material, options, file, worlds=None):
    out = evaluate(configured(options), read_settings(material).material, [case()])
    assert out.nonconverged == 0
    return np.array([[[out.force_mean, 0, 0]]])


def by_generate(material, options, file, worlds=None):
    vary = {}
    for name, value in (worlds or {}).items():
        if name == "material":  # what is drawn: a number, or a factor on the strengths
            (name, low), high = next(iter(value[0].items())), next(iter(value[1].values()))
            strength = read_settings(material).material.prony[0][0]
            value = (low[0][0] / strength, high[0][0] / strength) if name == "prony" else (low, high)
        vary[name] = list(value) or [0.5, 2.0]
    chosen = GenerateOptions(
        count=2, labelled=0, steps=len(TIP), rate=1 / DT, skin=file, material=material, options=options,
        vary=vary or None, tier="full",
    )  # fmt: skip
    maker = Maker(chosen, {})
    skins = None, {}
    if vary:
        *skins, drawn = draw_worlds(vary, maker.model.material, [[0, i, 2] for i in (2, 3)])
        assert drawn[0] != drawn[1]
    n = 2 if vary else 1
    motion = Motion("walk", {}, CENTRE, np.tile(np.eye(3), (len(TIP), 1, 1)))
    fields = simulate(maker.model, [TOOL] * n, [motion] * n, None, maker.time, *skins)
    assert fields.converged.all()
    return np.swapaxes(fields.wrench[..., :3], 0, 1)


def by_diagnose(material, options, file, worlds=None):
    n = len(TIP)
    mat = np.tile(np.eye(3), (n, 1, 1))
    one = Trajectory("walk", TOOL, 0.0, DT * np.arange(n), CENTRE, mat, np.full((n, 19), 2000.0))
    sim = Simulator(skin=file, tier="full", material=material, options=options)
    return sim.solve([one])[0]["force"][:, None]


WALKS = {
    "CPU": by_step,
    "CUDA": functools.partial(by_step, device="cuda:0"),
    "worlds": by_many,
    "batch": by_batch,
    "attach": by_attach,
    "condensed": functools.partial(by_attach, tier="condensed"),
    "calibrate": by_calibrate,
    "compare": by_compare,
    "generate": by_generate,
    "diagnose": by_diagnose,
}
kept = {}


def cells(kind):
    out = []
    for feature in FEATURES:
        for path in PATHS:
            cell = feature.cell(path)
            if not isinstance(cell, kind):
                continue
            quick = path in QUICK and (
                path != "worlds" or feature.worlds
            )  # equal worlds are as the CPU's one
            marks = [] if quick or kind is Refused else [pytest.mark.slow]
            out.append(pytest.param(feature, path, id=f"{feature.name}, {path}", marks=marks))
    return out


def force(path, feature, there, file):
    """The force along the walk; what features share is walked once."""
    material, options = settings(feature, there)
    key = path, repr((material, options["skin"], "modulus" in options))
    if key not in kept:
        kept[key] = WALKS[path](material, options, file)
    return kept[key]


@pytest.mark.parametrize("feature, path", cells(type(None)))
def test_every_yes_changes_the_force(feature, path, file):
    if path == "CUDA" and not wp.is_cuda_available():
        pytest.skip("needs CUDA")
    if feature.worlds:
        material, options = settings(feature, True)
        one, other = np.moveaxis(WALKS[path](material, options, file, feature.worlds), 1, 0)
    else:
        one, other = force(path, feature, True, file), force(path, feature, False, file)
    peak = abs(one).max()
    assert peak > 0.1
    assert abs(one - other).max() > SEEN.get(path, 2e-4) * peak


@pytest.mark.parametrize("feature, path", cells(Refused))
def test_every_no_says_why(feature, path, file):
    material, options = settings(feature, True)
    with pytest.raises(ValueError, match=feature.cell(path).match):
        WALKS[path](material, options, file, feature.worlds)


def test_the_condensed_tier_is_refused_on_cuda(file):
    with pytest.raises(ValueError, match="the condensed tier runs on the CPU: choose device='cpu'"):
        by_attach({}, {"skin": BASE_SKIN}, file, tier="condensed", device="cuda:0")


def test_the_table_is_whole():
    names = [feature.name for feature in FEATURES]
    assert len(set(names)) == len(names)
    for feature in FEATURES:
        assert set(feature.cells) <= set(PATHS)
        assert all(isinstance(cell, (Refused, Absent)) and cell.why for cell in feature.cells.values())


def test_the_page_is_that_of_the_table(repo):
    page = (repo / "docs" / "features.md").read_text()
    assert page == features.markdown(), "run python scripts/features.py > docs/features.md"


def test_the_paths_agree(file):
    """One skin by all paths on the CPU, with memory, a modulus by element and a contact law."""
    feature = dataclasses.replace(
        FEATURES[0],
        skin={"contact_law": {"adhesion": 0.05, "adhesion_range": 5e-5, "friction_exponent": 0.3}},
        material={"prony": [[0.4, 0.02]], "hysteresis": [[0.3, 0.003]], "stiffening": 5.0},
        base_skin={"tolerance": 1e-6, "element": "linear"},
        modulus=True,
    )
    material, options = settings(feature, True)
    expected = by_step(material, options, file)[:, 0]
    for path, bound in (("attach", 1e-5), ("calibrate", 1e-2)):  # a fit takes long ways in several steps
        got = WALKS[path](material, options, file)[:, 0]
        np.testing.assert_allclose(got, expected, atol=bound * abs(expected).max(), err_msg=path)


def test_a_modulus_travels_as_numbers_a_file_or_a_function(file, tmp_path):
    """`attach` keeps it in the model, so that the three are one."""
    x = shell().vert[shell().elem].mean(1)

    def factor(at):
        return 1 - 30 * (at[:, 0] + 8e-3)

    np.save(tmp_path / "factors.npy", factor(x))
    material, options = {"friction": FRICTION}, {"skin": BASE_SKIN | {"element": "linear"}}
    forms = factor(x), factor, str(tmp_path / "factors.npy")
    forces = [by_attach(material, options | {"modulus": form}, file) for form in forms]
    even = by_attach(material, options, file)
    assert abs(forces[0] - even).max() > 0.01 * abs(even).max()
    assert all((one == forces[0]).all() for one in forces)
    with pytest.raises(FileNotFoundError, match="write one factor per element with numpy.save"):
        read_settings(None, {"modulus": "nowhere.npy"})
    with pytest.raises(
        ValueError, match="options has 'modlus': did you mean 'modulus'\\? choose from skin, modulus"
    ):
        read_settings(None, {"modlus": 1})
    with pytest.raises(ValueError, match="options\\['skin'\\] has 'adhesion': .*choose from"):
        read_settings(None, {"skin": {"adhesion": 1}})
