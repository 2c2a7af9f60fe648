"""What is kept on disk between processes: everything that goes in is in the key, and a bad file does no
harm."""

import ast
import dataclasses
import importlib.util
import io
import os
import pathlib
import re
import sys
import time
import types
import zipfile

import numpy as np
import pytest
from blocks import four_nodes
from imports import modules

from biotac_mj import cache
from biotac_mj.cache import Entry, cache_folder, cached, digest
from biotac_mj.calibration.forward import simulate
from biotac_mj.calibration.indentation import Indentation
from biotac_mj.data.objects import make_object
from biotac_mj.discrepancy import Trajectory
from biotac_mj.discrepancy.plates import tables
from biotac_mj.discrepancy.trajectories.model import solver
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.geometry.skins import load_skin, skin_reference
from biotac_mj.matching.states import PlateGrid, PlateStates, plate_states
from biotac_mj.sensor.film import FilmConduction
from biotac_mj.skin import Material, SkinModel, SkinOptions
from biotac_mj.skin.condensed.compliance import SurfaceCompliance
from biotac_mj.skin.condensed.linear import LinearSkin
from biotac_mj.skin.contact.meshes import bake_distance_grid
from biotac_mj.skin.fill import rest_state, rest_worlds
from biotac_mj.skin.modes import skin_modes
from biotac_mj.triangles import trimesh

SCRIPT = pathlib.Path(__file__).parents[1] / "scripts" / "fit_estimators.py"
GEOMETRY = four_nodes("coarse")
ARRAYS = [f.name for f in dataclasses.fields(SkinGeometry) if f.name not in ("name", "design")]


@pytest.fixture(autouse=True)
def own_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("BIOTAC_CACHE", str(tmp_path / "cache"))


# --- keys


class Asked(Exception):
    """For this file; nothing is computed."""


def fill(geometry, amount):
    rest_state(SkinModel(geometry, "default", SkinOptions(liquid=True, fill_volume=float(amount[0]))))


def fill_worlds(geometry, modulus, extra):
    model = SkinModel(geometry, "default", SkinOptions(liquid=True))
    liquid = types.SimpleNamespace(bulk_modulus=np.full(2, 2e9), extra=extra)
    rest_worlds(types.SimpleNamespace(model=model, liquid=liquid), 2 * [model.material], modulus)


def compliance(geometry, outer, inner, direction):
    SurfaceCompliance(SkinModel(geometry), outer, inner, direction)


def core(geometry):
    LinearSkin(SkinModel(geometry))


def film(geometry):
    FilmConduction(geometry)


def vector(geometry, field, outer, inner):
    class Opened(SurfaceCompliance):
        def _open(self):
            return None, None, None

    Opened(SkinModel(geometry), outer, inner, np.eye(3)[:1]).vector(field)


def modes(geometry, modulus):
    skin_modes(SkinModel(geometry, modulus=modulus))


def grid(_, vert, face):
    bake_distance_grid(vert, face)


def spline(_, vert, face):
    bake_distance_grid(vert, face, cells=8, smooth=True)


def plates(geometry, pitch):
    plate_states(geometry, Material(), grid=PlateGrid(tuple(pitch), (0.0, 0.3), (), (1e-7, 2e-7)), quiet=True)


def readings(geometry, xpos, rest, node, depth):
    states = PlateStates(PlateGrid(), node, rest, xpos, np.ones(3), np.ones(1), np.ones(1), depth)
    tables._readings(states, geometry, {})


def presses(geometry, poisson):
    pytest.importorskip("torch", reason="needs torch: pip install biotac_mj[learning]")
    from biotac_mj.differentiable.estimation.presses import Presses

    model = types.SimpleNamespace(material=Material(poissons_ratio=float(poisson[0])), options=SkinOptions())
    Presses(types.SimpleNamespace(model=model), geometry, "sphere_7mm")


def field(geometry, pos, mat):
    sim = solver.Solver(cache="fields")
    moves = Trajectory("a", "sphere_7mm", 0.0, np.arange(8.0), pos, mat, np.full((8, 19), 2500.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solver, "load_skin", lambda name: geometry)
        sim.solve([moves])


def recording(geometry):
    pytest.importorskip("dm_control", reason="needs dm_control: pip install biotac_mj[control]")
    spec = importlib.util.spec_from_file_location(SCRIPT.stem, SCRIPT)
    spec.loader.exec_module(script := importlib.util.module_from_spec(spec))
    script._recording("recordings", ["a BioTac", geometry, "press", 0], None)


def path(time, tip):
    return Indentation("a", "sphere_7mm", time, tip, np.array([1.0, 0, 0, 0]), np.eye(4, 3))


def indentation(geometry, time, tip, modulus):
    simulate(geometry, SkinOptions(), [Material()], path(time, tip), modulus=modulus)


def slopes(geometry, time, tip, modulus):
    pytest.importorskip("torch", reason="needs torch: pip install biotac_mj[learning]")
    from biotac_mj.differentiable.fit import Forces

    body = types.SimpleNamespace(geometry=geometry, options=SkinOptions(), modulus=modulus)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Forces, "prepare", lambda *_: (None, None))
        Forces()(body, Material(), [], np.zeros(0), path(time, tip))


MOVES = {"time": np.arange(4.0), "tip": np.full((4, 3), 0.01), "modulus": np.ones(GEOMETRY.nelem)}
NODES = {"outer": np.array([3, 8]), "inner": np.array([700])}
# what computes each kind, and the arrays that it takes beside a skin
KINDS = {
    "rest": (fill, {"amount": np.array([1e-8])}),
    "rests": (fill_worlds, {"modulus": np.ones((2, GEOMETRY.nelem)), "extra": np.array([0, 1e-8])}),
    "stiffness": (compliance, {**NODES, "direction": np.eye(3)[:1]}),
    "core": (core, {}),
    "film": (film, {}),
    "vector": (vector, {"field": np.ones((GEOMETRY.nvert, 3)), **NODES}),
    "modes": (modes, {"modulus": np.ones(GEOMETRY.nelem)}),
    "grid": (grid, {"vert": GEOMETRY.core_vert, "face": GEOMETRY.core_face}),
    "spline": (spline, {"vert": GEOMETRY.core_vert, "face": GEOMETRY.core_face}),
    "plate-states": (plates, {"pitch": np.array([0.0, 0.2])}),
    "readings": (
        readings,
        {
            "xpos": np.ones((1, 1, 1, 1, 2, 3)),
            "rest": np.ones((2, 3)),
            "node": np.arange(2),
            "depth": np.ones(1),
        },
    ),
    "indentation": (indentation, MOVES),
    "slopes": (slopes, MOVES),
    "presses": (presses, {"poisson": np.array([0.4])}),
    "recording": (recording, {}),
    "field": (field, {"pos": np.full((8, 3), 0.01), "mat": np.tile(np.eye(3), (8, 1, 1))}),
}


def test_every_kind_that_the_package_keeps_is_tried_here():
    found = {
        node.args[0].value
        for path in (*modules().values(), SCRIPT)
        if re.search(r"\b(cached|Entry)\(", path.read_text())
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("cached", "Entry")
        if isinstance(node.args[0], ast.Constant)
    }
    assert found == set(KINDS)


def changed(name, array):
    """The array with as little as possible another content, which is as sound."""
    array = array.copy()
    if name == "fixed":
        return array[:-1]
    if array.dtype.kind == "i" and array.ndim == 2:
        array[0, :3] = array[0, [1, 2, 0]]  # the same face or tetrahedron, named from another corner
    elif array.dtype.kind == "i":
        array[-1] += 1
    elif name in ("pos", "mat"):
        array.flat[0] += 1e-8  # poses are rounded to a nanometre
    else:
        array.flat[0] = np.nextafter(array.flat[0], np.inf)
    return array


def key_of(kind, geometry, **arrays):
    (function, given), load = KINDS[kind], Entry.load
    with pytest.MonkeyPatch.context() as patch:

        def ask(entry):
            if entry.path.name.startswith(f"{kind}-"):
                raise Asked(entry.path.name)
            return load(entry)  # what a model itself takes from the cache

        patch.setattr(Entry, "load", ask)
        with pytest.raises(Asked) as asked:
            function(geometry, **given | arrays)
    return str(asked.value)


@pytest.mark.parametrize("kind", KINDS)
def test_any_array_that_goes_in_changes_the_key(kind):
    keys = [key_of(kind, GEOMETRY)]
    assert key_of(kind, dataclasses.replace(GEOMETRY)) == keys[0]
    if kind not in ("grid", "spline", "film"):  # these take a few of the arrays, or others
        for name in ARRAYS:
            other = dataclasses.replace(GEOMETRY, **{name: changed(name, getattr(GEOMETRY, name))})
            keys.append(key_of(kind, other))
    for name, array in KINDS[kind][1].items():
        keys.append(key_of(kind, GEOMETRY, **{name: changed(name, array)}))
    assert len(set(keys)) == len(keys)


@pytest.mark.parametrize("kind", KINDS)
def test_other_code_does_not_take_what_was_kept(kind, monkeypatch):
    before = key_of(kind, GEOMETRY)
    monkeypatch.setattr(cache, "_code", lambda names: "other code")
    assert key_of(kind, GEOMETRY) != before


@pytest.mark.parametrize("name", ARRAYS)
def test_skins_that_differ_in_one_array_have_other_files(name):
    path, _ = skin_reference(GEOMETRY)
    other = dataclasses.replace(GEOMETRY, **{name: changed(name, getattr(GEOMETRY, name))})
    other_path, _ = skin_reference(other)
    assert other_path != path and path == skin_reference(dataclasses.replace(GEOMETRY))[0]
    for one, file in ((GEOMETRY, path), (other, other_path)):
        assert np.array_equal(getattr(load_skin(file), name), getattr(one, name))
    assert path.startswith(str(cache_folder()))


def test_contents_that_differ_have_other_digests():
    a, b = np.arange(4.0), np.arange(4)
    contents = [
        [a], [a, a], [a.reshape(2, 2)], [a.astype(np.float32)], [b], [b[:2], b[2:]], [b[:3], b[3:]],
        [b"ab", b"c"], [b"a", b"bc"], [b"abc"], ["abc"], [["abc"]], [["a", "bc"]], [{"a": 1}], [{"a": 1.0}],
        [{"a": 2}], [None], [[]], [True], [PlateGrid()], [PlateGrid(drag=())],
        [dataclasses.asdict(PlateGrid())],
        [1, 2], [12], ["1", "2"],
    ]  # fmt: skip
    assert len({digest(*content) for content in contents}) == len(contents)
    assert digest({"a": 1, "b": a}) == digest({"b": a.copy(), "a": np.int64(1)})
    large = np.arange(3000.0)  # of which a repr shows six numbers
    assert digest({"a": large}) != digest({"a": np.where(large == 1500, -1, large)})
    with pytest.raises(TypeError, match="a function cannot be a part of a cache's key"):
        digest(lambda: 0)


def test_a_mesh_file_that_changed_is_another_object(tmp_path):
    path, found = tmp_path / "ball.stl", []
    for radius in (5e-3, 1e-3):
        trimesh.creation.icosphere(2, radius).export(path)
        found.append(make_object(f"mesh:{path}"))
        assert np.ptp(found[-1].vert, axis=0).max() == pytest.approx(2 * radius, rel=1e-6)
    assert digest(found[0]) != digest(found[1])


# --- files


def damaged(whole, key):
    """What a file of the cache may become, by name."""
    for at in range(len(whole)):
        yield f"bit {at}", whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :]
    for length in range(0, len(whole), 7):
        yield f"cut at {length}", whole[:length]
    yield "longer", whole + b"\0"
    np.save(array := io.BytesIO(), np.zeros(3))
    yield "an array", array.getvalue()
    for arrays in ({}, {"vert": np.zeros(2), "pressure": np.array(1.0)}):
        np.savez(archive := io.BytesIO(), key=np.array(key), **arrays)
        yield f"an archive of {list(arrays)}", archive.getvalue()


def test_a_file_that_is_not_as_it_was_written_is_not_read():
    entry = Entry("thing", [1.0])
    entry.save({"vert": np.arange(30.0).reshape(10, 3), "pressure": np.array(2.0)})
    whole, read = entry.path.read_bytes(), []
    for name, content in damaged(whole, entry.path.stem.split("-")[1]):
        entry.path.write_bytes(content)
        if entry.load() is not None:
            read.append(name)
    entry.path.write_bytes(whole)
    assert not read and entry.load()["vert"].shape == (10, 3)


@pytest.mark.parametrize("content", [b"", b"PK nonsense", "a bit", "another"])
def test_a_bad_file_is_made_again_without_a_word(content, capsys):
    wanted = {"a": np.arange(1000.0), "b": np.array("text")}
    made = []

    def make():
        made.append(1)
        return wanted

    def read(*inputs):
        found = cached("thing", inputs, make)
        assert found.keys() == wanted.keys() and all((found[k] == wanted[k]).all() for k in wanted)

    read(1.0, np.ones(3))
    read(1.0, np.ones(3))
    assert len(made) == 1
    (file,) = cache_folder().glob("thing-*.npz")
    if content == "a bit":
        content = bytearray(file.read_bytes())
        content[content.index(np.array(500.0).tobytes())] ^= 1
    elif content == "another":
        read(2.0)
        (other,) = set(cache_folder().glob("thing-*.npz")) - {file}
        content = other.read_bytes()
        made.pop()
    file.write_bytes(content)
    read(1.0, np.ones(3))
    read(1.0, np.ones(3))
    assert len(made) == 2 and not capsys.readouterr().err


@pytest.mark.parametrize("content", [b"", b"PK nonsense", "another", "design", "encrypted"])
def test_a_bad_file_of_a_skin_does_not_reach_who_comes_next(content):
    path, _ = skin_reference(GEOMETRY)
    if content == "another":
        other = dataclasses.replace(GEOMETRY, electrode_pos=GEOMETRY.electrode_pos[::-1])
        content = pathlib.Path(skin_reference(other)[0]).read_bytes()
    elif isinstance(content, str):
        name, content = content, bytearray(pathlib.Path(path).read_bytes())
        with zipfile.ZipFile(path) as file:
            within = file.getinfo("design.npy").header_offset + 200
        content[content.rfind(b"PK\1\2") + 8 if name == "encrypted" else within] ^= 1
    pathlib.Path(path).write_bytes(content)
    assert skin_reference(GEOMETRY)[0] == path
    assert np.array_equal(load_skin(path).electrode_pos, GEOMETRY.electrode_pos)


def test_what_takes_long_is_said(monkeypatch, tmp_path, capsys):
    """Only then, and not where it is read from disk."""
    monkeypatch.setenv("BIOTAC_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "_PATIENCE", 0.05)
    for seconds, says in ((0.5, True), (0.5, False), (0.0, False)):
        cache.cached("grid", [seconds], lambda seconds=seconds: time.sleep(seconds) or {"a": np.zeros(1)}, ())
        assert ("biotac_mj: computing the distances around a mesh, once" in capsys.readouterr().err) == says


def test_a_skin_is_stored_where_the_cache_cannot_be(monkeypatch, tmp_path):
    (tmp_path / "taken").write_text("")
    monkeypatch.setenv("BIOTAC_CACHE", str(tmp_path / "taken"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    path, _ = skin_reference(GEOMETRY)
    assert path.startswith(str(tmp_path / "temporary")) and load_skin(path).nvert == GEOMETRY.nvert


def test_the_cache_stays_within_its_size(monkeypatch):
    """What was used last stays, whatever its kind; what was just made always does, and stored skins."""

    def read(kind, i):
        return cached(kind, [i], lambda: {"a": np.zeros(100_000, np.uint8)})

    monkeypatch.setenv("BIOTAC_CACHE_GB", "0.00035")
    other = cache_folder() / "notes.txt"
    other.parent.mkdir(parents=True, exist_ok=True)
    other.write_text("not ours")
    skin, _ = skin_reference(GEOMETRY)
    files = {}
    for age, i in enumerate((0, 1, 2)):
        read("plate", i)
        (files[i],) = set(cache_folder().glob("*.npz")) - set(files.values())
        os.utime(files[i], (age, age))
    read("plate", 0)  # used again
    read("grid", 3)
    assert files[0].exists() and files[2].exists() and not files[1].exists() and other.exists()
    monkeypatch.setenv("BIOTAC_CACHE_GB", "0")
    read("grid", 4)
    assert len(list(cache_folder().glob("*.npz"))) == 1 and os.path.exists(skin)
    monkeypatch.setenv("BIOTAC_CACHE_GB", "much")
    with pytest.raises(ValueError, match=r"^BIOTAC_CACHE_GB must be a number of gigabytes.*'much'$"):
        read("grid", 5)


def test_the_folder_is_the_systems_unless_the_user_names_one(monkeypatch, tmp_path):
    assert cache_folder() == tmp_path / "cache"
    monkeypatch.delenv("BIOTAC_CACHE")
    if sys.platform == "linux":
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert cache_folder() == tmp_path / "biotac_mj"
    assert "biotac_mj" in cache_folder().parts


def test_skins_with_equal_meshes_do_not_share_a_model():
    """Two that differ in the rigid core, one after the other."""
    from biotac_mj.coupling.steppers.fem import shared_model
    from biotac_mj.skin.settings import read_settings

    geometry = load_skin("coarse")
    other = dataclasses.replace(geometry, core_vert=geometry.core_vert * [1, 0.97, 0.97])
    models = [shared_model(g, read_settings(), "cpu") for g in (geometry, other, geometry)]
    assert models[0] is models[2] and models[1] is not models[0]
    found, given = (np.unique(vert, axis=0) for vert in (models[1].core_vert.numpy(), other.core_vert))
    assert abs(found - given).max() < 1e-12  # the model has them in another order
