"""What a person can get wrong at the command line: a row is a verb, what is broken, and what is said of it.

A row ends in one line on stderr that holds the row's text, no traceback, an exit code that is not zero, and
nothing is written."""

import dataclasses
import json
import os
import pathlib
import shutil

import numpy as np
import pytest
from bad_rows import Row, h5, replaced
from good_input import ROWS as NROW
from good_input import make_files

from biotac_mj import cli
from biotac_mj.learning.training.config import LearningConfig
from biotac_mj.recordings.formats.text import RUPPEL as RUPPEL_COLUMNS
from biotac_mj.sensor.channels import ELECTRODES
from biotac_mj.skin.contact.law import ContactLaw
from biotac_mj.skin.model import SkinOptions
from biotac_mj.skin.rubber.material import Material


def drop(name):
    return h5(lambda file: file.__delitem__(name))


def put(name, value):
    """Another value for a data set: a function of the old one, or a value."""

    def do(file):
        old = file[name][()]
        del file[name]
        file[name] = value(old) if callable(value) else value

    return h5(do)


def attribute(name, value=None):
    def do(file):
        del file.attrs[name]
        if value is not None:
            file.attrs[name] = value

    return h5(do)


def group(name):
    def do(file):
        del file[name]
        file.create_group(name)

    return h5(do)


def arrays(**changes):
    """Other arrays in an .npz file; None leaves one out."""

    def do(path):
        with np.load(path) as file:
            found = dict(file)
        for name, value in changes.items():
            found[name] = value(found[name]) if callable(value) else value
        np.savez(path, **{name: value for name, value in found.items() if value is not None})

    return do


def text(value):
    return lambda path: path.write_text(value)


def cell(row, column, value, separator=" "):
    """Another word in a table."""

    def do(path):
        lines = path.read_text().splitlines()
        words = lines[row].split(separator)
        words[column] = value
        lines[row] = separator.join(words)
        path.write_text("\n".join(lines) + "\n")

    return do


def moved(factor, offset):
    """Other vertices in an .obj file: scaled, then moved along x."""

    def do(path):
        lines = [line.split() for line in path.read_text().splitlines()]
        for words in lines:
            if words[0] == "v":
                words[1:4] = (f"{factor * float(x) + off:.9g}" for x, off in zip(words[1:4], (offset, 0, 0)))
        path.write_text("\n".join(" ".join(words) for words in lines) + "\n")

    return do


def latin(path):
    path.write_bytes("{'name': 'ö'}".encode("latin-1"))


def scaled(factor):
    def do(path):
        np.savetxt(path, factor * np.loadtxt(path), "%.6g")

    return do


def entry(**changes):
    """Other entries in a file of JSON; None leaves one out."""

    def do(path):
        found = json.loads(path.read_text()) | changes
        path.write_text(json.dumps({name: value for name, value in found.items() if value is not None}))

    return do


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def nan_first(value):
    value = np.array(value, float)
    value.flat[0] = np.nan
    return value


def one_more_axis(value):
    return np.asarray(value)[..., None]


def as_text(value):
    return np.full(np.shape(value), b"a")


def weights(tensors=None, **meta):
    """Other tensors and another description in a file of weights."""

    def do(path):
        from safetensors import safe_open
        from safetensors.torch import save_file

        with safe_open(str(path), framework="pt") as file:
            found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - it is no dict
            said = json.loads(file.metadata()["biotac_mj"])
        said = {name: value for name, value in (said | meta).items() if value is not None}
        save_file(tensors(found) if tensors else found, str(path), {"biotac_mj": json.dumps(said)})

    return do


def described(path, said):
    """The same tensors with another description, JSON's text."""
    from safetensors.torch import load_file, save_file

    save_file(load_file(path), str(path), {"biotac_mj": said})


def without(name):
    return lambda found: {other: value for other, value in found.items() if other != name}


def poisoned(name):
    def do(found):
        found[name].view(-1)[0] = float("nan")
        return found

    return do


# --- the table

SKIN = "press --quiet --skin skin.npz"
FLOATS = ("vert", "core_vert", "nail_vert", "clamp_vert", "electrode_pos", "electrode_normal")
INDICES = ("elem", "outer_face", "inner_face", "fixed", "core_face", "nail_face", "clamp_face")
CALIBRATE = "lab calibrate press.h5 --quiet --indenter sphere_7mm"
WEB = "play press.h5"
NVIDIA = "data import nvidia.hdf5 --out out"
SET = "data export shard.h5 --quiet --out out"
CSV = "lab calibrate way.csv --quiet --indenter sphere_7mm"
RUPPEL = "data import ruppel.csv --out out"
SENSOR = "diagnose shard.h5 --quiet --effects sensor.yaml"
PATCH = "learn predict inverse.safetensors electrodes.txt"
TRAIN = "learn train shard.h5 --quiet --config config.json"
EVALUATE = "learn judge trained"
MESH = "lab mesh mesh --out out.npz"
# verbs that read a log of electrodes
LOGS = (
    "diagnose --quiet --electrodes electrodes.txt",
    "learn judge --quiet electrodes.txt",
    "learn predict inverse electrodes.txt",
    "lab estimate electrodes.txt --quiet",
    "data import electrodes.txt --out out",
)
WITH_FORCE = (
    "diagnose --quiet --electrodes electrodes.txt --force force.txt",
    "learn judge --quiet electrodes.txt --force force.txt",
    "data import electrodes.txt --force force.txt --out out",
)
MATERIAL = "press --quiet --skin coarse --material"
OPTIONS = "press --quiet --skin coarse --options"


def files_of_skins():
    for name in (*FLOATS, *INDICES):
        yield Row(SKIN, f"skin.npz has no {name}: pass 'coarse'", "skin.npz", arrays(**{name: None}))
        yield Row(SKIN, f"{name} of skin.npz has shape", "skin.npz", arrays(**{name: one_more_axis}))
        yield Row(SKIN, f"{name} of skin.npz holds", "skin.npz", arrays(**{name: as_text}))
    for name in FLOATS:
        yield Row(
            SKIN, f"{name} of skin.npz has values that are not", "skin.npz", arrays(**{name: nan_first})
        )
    for name in INDICES:
        yield Row(SKIN, f"{name} of skin.npz has negative", "skin.npz", arrays(**{name: lambda v: v - 9999}))
        yield Row(
            SKIN,
            f"skin.npz: {name} of skin 'coarse' names",
            "skin.npz",
            arrays(**{name: lambda v: v + 99999}),
        )
    yield Row(SKIN, "skin.npz is no skin", "skin.npz", cut)
    yield Row(SKIN, "skin.npz is no skin", "skin.npz", text("no"))
    yield Row(SKIN, "skin.npz is no skin (Object arrays", "skin.npz", arrays(vert=lambda v: np.array([{}])))
    for part in ("core", "nail", "clamp"):
        for said, change in (
            ("is not a manifold: ", lambda v: 0 * v),
            ("is open: 3 edges have one face only", lambda v: v[:1]),
            ("is inside out: flip its faces", lambda v: v[:, ::-1]),
        ):
            wrong = arrays(**{f"{part}_face": change})
            yield Row(SKIN, f"the {part} of skin skin.npz {said}", "skin.npz", wrong)
    for name in ("outer_face", "inner_face"):
        inside_out = arrays(**{name: lambda v: v[:, ::-1]})
        yield Row(SKIN, f"{name} of skin skin.npz is inside out: flip", "skin.npz", inside_out)
        for said, change in (
            ("0 triangles too many, 1 missing", lambda v: v[1:]),
            ("1 triangles too many, 0 missing", lambda v: np.concatenate([v, v[:1]])),
            ("1 triangles too many, 0 missing", lambda v: np.concatenate([v, v[:1, [0, 0, 1]]])),
        ):
            yield Row(SKIN, f"the surface of its tetrahedra: {said}", "skin.npz", arrays(**{name: change}))
    twice = arrays(elem=lambda v: np.concatenate([v, v[:1]]))
    yield Row(SKIN, "belong to more than two tetrahedra", "skin.npz", twice)
    turned = arrays(elem=lambda v: np.concatenate([v[:1, [1, 0, *range(2, v.shape[1])]], v[1:]]))
    said = "1 of 1382 tetrahedra of skin skin.npz are inverted or degenerate (first: 0, "
    yield Row(SKIN, said, "skin.npz", turned)
    for name in ("nail", "clamp"):
        said = f"the {name} of skin skin.npz encloses no volume"
        yield Row(SKIN, said, "skin.npz", arrays(**{f"{name}_vert": lambda v: 0 * v}))
    yield Row("press --quiet --material material.json", "('utf-8' codec", "material.json", latin)
    yield Row(SKIN, "elem has shape", "skin.npz", arrays(elem=lambda v: v[:, :3]))
    yield Row("press --skin mesh", "no skin at mesh: pass 'coarse'")
    yield Row(SKIN, "is it in millimetres? multiply it", "skin.npz", arrays(vert=lambda v: 1e3 * v))
    yield Row(SKIN, "was it scaled twice? multiply it", "skin.npz", arrays(vert=lambda v: 1e-3 * v))
    yield Row(SKIN, "mm from the origin of its frame, and", "skin.npz", arrays(core_vert=lambda v: v + 0.1))
    for name in ("electrode_pos", "electrode_normal"):
        for factor in (0, 9):
            if (name, factor) != ("electrode_pos", 0):
                change = arrays(**{name: lambda v, factor=factor: factor * v})
                yield Row(SKIN, "electrodes of skin skin.npz are not on its core", "skin.npz", change)


def files_of_presses():
    for name in ("time", "force", "indenter_pose"):
        yield Row(CALIBRATE, f"press.h5 has no {name}: give the skin.h5", "press.h5", drop(name))
        yield Row(CALIBRATE, f"{name} of press.h5 has shape", "press.h5", put(name, one_more_axis))
        yield Row(CALIBRATE, f"{name} of press.h5 holds", "press.h5", put(name, as_text))
        yield Row(CALIBRATE, f"{name} of press.h5 has values that are", "press.h5", put(name, nan_first))
        yield Row(CALIBRATE, f"{name} of press.h5 is no array", "press.h5", group(name))
    yield Row(CALIBRATE, "press.h5 has no attribute parameters", "press.h5", attribute("parameters"))
    yield Row(CALIBRATE, "is no recorded press (Expecting", "press.h5", attribute("parameters", "no"))
    yield Row(CALIBRATE, "parameters has no indenter", "press.h5", attribute("parameters", "{}"))
    yield Row(CALIBRATE, "parameters is [1]: a dict", "press.h5", attribute("parameters", "[1]"))
    yield Row(
        CALIBRATE, "indenter of parameters is 3", "press.h5", attribute("parameters", '{"indenter": 3}')
    )
    yield Row(CALIBRATE, "time_s of indentation 'press' does not", "press.h5", put("time", lambda v: -v))
    yield Row(CALIBRATE, "positions must be in metres", "press.h5", put("indenter_pose", lambda v: 1e3 * v))
    yield Row(CALIBRATE, "give newtons, these look like mN", "press.h5", put("force", lambda v: 1e3 * v))
    yield Row(CALIBRATE, "press.h5 is no recorded press (", "press.h5", cut)
    yield Row(CALIBRATE, "press.h5 is no recorded press (", "press.h5", text(""))
    for name in ("vert_xpos", "outer_face", "time", "counts", "force"):
        yield Row(WEB, f"press.h5 has no {name}: make one", "press.h5", drop(name))
        yield Row(WEB, f"{name} of press.h5 has shape", "press.h5", put(name, one_more_axis))
        yield Row(WEB, f"{name} of press.h5 holds", "press.h5", put(name, as_text))
        yield Row(WEB, f"{name} of press.h5 is no array", "press.h5", group(name))
    for name in ("vert_xpos", "time", "counts", "force"):
        yield Row(WEB, f"{name} of press.h5 has values that are", "press.h5", put(name, nan_first))
        yield Row(WEB, "of press.h5 has shape", "press.h5", put(name, lambda v: v[1:]))
    yield Row(WEB, "faces of missing nodes", "press.h5", put("outer_face", lambda v: v + 99999))
    yield Row(WEB, "times that run back", "press.h5", put("time", lambda v: -v))
    yield Row(WEB, "these look like mN", "press.h5", put("force", lambda v: 1e4 * v))
    yield Row(WEB, "raw counts 0..4095 are needed", "press.h5", put("counts", lambda v: v / 1e4))
    yield Row(WEB, "press.h5 has no attribute skin", "press.h5", attribute("skin"))
    yield Row(WEB, "press.h5 is no recording", "press.h5", cut)


def files_of_nvidia():
    for name in ("electrode_vals/data", "contact_loc/data", "force_vec/data"):
        yield Row(NVIDIA, f"nvidia.hdf5 has no {name}: give", "nvidia.hdf5", drop(name))
        yield Row(NVIDIA, f"{name} of nvidia.hdf5 has shape", "nvidia.hdf5", put(name, one_more_axis))
        yield Row(NVIDIA, f"{name} of nvidia.hdf5 has shape", "nvidia.hdf5", put(name, lambda v: v[:, :2]))
        yield Row(NVIDIA, f"{name} of nvidia.hdf5 holds", "nvidia.hdf5", put(name, as_text))
        yield Row(NVIDIA, f"{name} of nvidia.hdf5 has values", "nvidia.hdf5", put(name, nan_first))
        yield Row(NVIDIA, f"{name} of nvidia.hdf5 is no array", "nvidia.hdf5", group(name))
    kind = "indenter_type/data"
    for change in (nan_first, lambda v: v + 0.5, lambda v: v[1:], lambda v: v[:, None] * np.ones(2)):
        yield Row(NVIDIA, f"{kind} of nvidia.hdf5 has", "nvidia.hdf5", put(kind, change))
    yield Row(NVIDIA, "is no recording of NVIDIA's", "nvidia.hdf5", put(kind, as_text))
    yield Row(NVIDIA, "is no recording of NVIDIA's", "nvidia.hdf5", group(kind))
    yield Row(NVIDIA, "nvidia.hdf5 is no recording", "nvidia.hdf5", cut)
    counts = "electrode_vals/data"
    yield Row(NVIDIA, "look like volts or normalised", "nvidia.hdf5", put(counts, lambda v: v / 4095))
    yield Row(NVIDIA, "raw counts 0..4095 are needed", "nvidia.hdf5", put(counts, lambda v: v - 4000))
    yield Row(NVIDIA, "these look like mN", "nvidia.hdf5", put("force_vec/data", lambda v: 1e3 * v))
    yield Row(NVIDIA, "metres are needed", "nvidia.hdf5", put("contact_loc/data", lambda v: 1e3 * v + 9))
    yield Row(f"{NVIDIA} --objects", "expected at least one argument")
    yield Row("data import nvidia.hdf5 nvidia.hdf5 --out out", "given twice")
    yield Row("data import electrodes.txt --out out --objects a b", "electrodes.txt is no file of NVIDIA's")


def files_of_sets():
    table = "id object kind split seed labelled parameters start stop".split()
    for name in (f"interaction/{name}" for name in table):
        yield Row(SET, f"shard.h5 has no {name}: generate", "shard.h5", drop(name))
        yield Row(SET, f"{name} of shard.h5 has shape", "shard.h5", put(name, one_more_axis))
        yield Row(SET, f"{name} of shard.h5 is no array", "shard.h5", group(name))
        wrong = put(name, lambda v: np.full(len(v), 1 + 1j))
        yield Row(SET, f"{name} of shard.h5 holds complex128", "shard.h5", wrong)
    columns = "displacement counts measured_counts contact_force wrench indenter_pos indenter_quat".split()
    for name in (f"step/{name}" for name in (*columns, "time", "converged")):
        yield Row(SET, f"{name} of shard.h5 has shape", "shard.h5", put(name, one_more_axis))
        yield Row(SET, "of shard.h5 has shape", "shard.h5", put(name, lambda v: v[1:]))
        yield Row(SET, f"{name} of shard.h5 holds", "shard.h5", put(name, as_text))
        yield Row(SET, f"{name} of shard.h5 is no array", "shard.h5", group(name))
    for name in ("counts", "wrench", "indenter_pos"):
        yield Row(SET, f"{name} of shard.h5 has values", "shard.h5", put(f"step/{name}", nan_first))
        yield Row(SET, f"shard.h5 has no column '{name}'", "shard.h5", drop(f"step/{name}"))
    yield Row(SET, "shard.h5 has no step/time", "shard.h5", drop("step/time"))
    yield Row(SET, "step/time of shard.h5 has values", "shard.h5", put("step/time", nan_first))
    for name in (f"geometry/{name}" for name in (*FLOATS, *INDICES)):
        yield Row(SET, f"shard.h5 has no {name}: generate", "shard.h5", drop(name))
        yield Row(SET, f"{name} of shard.h5 has shape", "shard.h5", put(name, one_more_axis))
    for name in FLOATS:
        yield Row(SET, f"{name} of shard.h5 has values", "shard.h5", put(f"geometry/{name}", nan_first))
    for name in ("interaction", "step"):
        yield Row(SET, f"shard.h5 has no group {name}", "shard.h5", drop(name))
    yield Row(SET, "names vertices", "shard.h5", put("geometry/fixed", lambda v: v + 99999))
    yield Row(SET, "do not divide its", "shard.h5", put("interaction/stop", lambda v: v + 1))
    yield Row(SET, "do not divide its", "shard.h5", put("interaction/start", lambda v: v[::-1]))
    yield Row(SET, "schema None: this version reads", "shard.h5", attribute("schema"))
    yield Row(SET, "schema 'x': this version reads", "shard.h5", attribute("schema", "x"))
    yield Row(SET, "channels in the order : e1 e2", "shard.h5", attribute("channels"))
    yield Row(SET, "is no readable shard (Expecting", "shard.h5", attribute("attributes", "no"))
    yield Row(SET, "attribute versions of shard.h5 is no dict", "shard.h5", attribute("versions", "[1]"))
    yield Row(SET, "is no readable shard", "shard.h5", cut)
    yield Row(SET, "is no readable shard", "shard.h5", text("no"))
    for name in ("kind", "split"):
        wrong = put(f"interaction/{name}", lambda v: [b"x"] * len(v))
        yield Row(SET, f"interaction/{name} of shard.h5 is 'x'", "shard.h5", wrong)
    half = attribute("attributes", json.dumps({"settings": {"count": 9}}))
    yield Row(
        "data export set --quiet --out out", "unfinished (4 of 9 interactions)", "set/shard-00000.h5", half
    )
    yield Row("learn train nowhere --quiet", "no shards (shard-*.h5) at nowhere")
    yield Row("learn train shard.h5 --quiet --splits jelly", "no object 'jelly'")
    yield Row("diagnose nowhere.h5 --quiet", "no measured data at nowhere.h5")


def files_of_text():
    for words in LOGS:
        file = "electrodes.txt"
        yield Row(words, "electrodes.txt is empty", file, text(""))
        wide = "a,b\n[1, 2]," + "x" * 200_000 + "\n"  # a cell wider than Python's reader of CSV takes
        yield Row(words, "no number in it", file, text(wide))
        yield Row(words, "line 1: 18 columns, 19 are", file, _fewer_columns)
        yield Row(words, "e4 is 'abc', not a finite", file, cell(3, 3, "abc"))
        yield Row(words, "e4 is 'nan', not a finite", file, cell(3, 3, "nan"))
        yield Row(words, "e1 is '1e999', not a finite", file, cell(0, 0, "1e999"))
        yield Row(words, "values; raw counts 0..4095", file, scaled(1 / 4095))
        yield Row(words, "raw counts 0..4095 are needed", file, scaled(-1))
        yield Row(words, "e2 of row 3 is 4096", file, cell(3, 1, "4096"))
        yield Row(words, "has no columns e19", file, _header_without_last)
        yield Row(words.replace(file, "nowhere.txt"), "nowhere.txt: no such file")
        judged = words.startswith("learn judge")  # a folder may be one of networks
        yield Row(words.replace(file, "mesh"), "no predictions in mesh" if judged else "mesh: no such file")
    for words in WITH_FORCE:
        yield Row(words, "force.txt is empty", "force.txt", text(""))
        yield Row(
            words, "line 1: 19 columns, 3 are", "force.txt", lambda path: shutil.copy("electrodes.txt", path)
        )
        yield Row(words, "Fy is 'x', not a finite", "force.txt", cell(9, 1, "x"))
        yield Row(words, "these look like mN", "force.txt", scaled(1e3))
        yield Row(words, f"{NROW - 1}", "force.txt", _one_row_less)
        yield Row(words.replace("force.txt", "nowhere"), "nowhere: no such file")
    yield Row(
        "diagnose --electrodes electrodes.txt --tdc tdc.txt", f"has {NROW - 1}", "tdc.txt", _one_row_less
    )
    yield Row("diagnose --electrodes electrodes.txt --tdc tdc.txt", "tdc is 'x'", "tdc.txt", cell(9, 0, "x"))
    for words, least in zip(LOGS[:2], ("at least 76 of this BioTac", "at least 400")):
        yield Row(words, least, "electrodes.txt", lambda path: path.write_text("\n".join(_lines(path)[:50])))
    for words, said in (
        ("--tare 0", "--tare: '0' is not a whole number"),
        ("--tare 9999", "--tare 9999"),
        ("--row 9999", "--row 9999"),
    ):
        yield Row(f"learn predict inverse electrodes.txt {words}", said)


def _lines(path):
    return path.read_text().splitlines()


def _fewer_columns(path):
    path.write_text("\n".join(line.rsplit(" ", 1)[0] for line in _lines(path)))


def _one_row_less(path):
    path.write_text("\n".join(_lines(path)[1:]))


def _header_without_last(path):
    path.write_text(" ".join(f"e{i}" for i in range(1, 19)) + " x\n" + path.read_text())


def files_of_csv():
    for name in ELECTRODES:
        change = replaced(",e19\n", ",other\n") if name == "e19" else replaced(f"{name},", "other,")
        yield Row(RUPPEL, f"ruppel.csv has no columns {name}: its", "ruppel.csv", change)
    yield Row(RUPPEL, "pac0 is 'x', not a finite", "ruppel.csv", cell(5, 7, "x", ","))
    yield Row(RUPPEL, "e1 is 'inf', not a finite", "ruppel.csv", cell(5, 12, "inf", ","))
    yield Row(RUPPEL, "e1 of row 4 is 5000", "ruppel.csv", cell(5, 12, "5000", ","))
    yield Row(RUPPEL, "these look like mN", "ruppel.csv", cell(5, 4, "900", ","))
    yield Row(RUPPEL, "ruppel.csv is empty", "ruppel.csv", text(""))
    yield Row(RUPPEL, "has a header and no rows", "ruppel.csv", text(",".join(RUPPEL_COLUMNS)))
    yield Row(RUPPEL, "ruppel.csv is no recording", "ruppel.csv", lambda path: path.write_bytes(b"\xff\0\0"))
    for name in ("time_s", "tip_x_m", "tip_y_m", "tip_z_m", "force_x_N", "force_y_N", "force_z_N"):
        yield Row(CSV, f"has no column '{name}'", "way.csv", replaced(name, "other"))
        for given in ("x", "nan"):
            said = f"line 4: {name} is {given!r}, not a finite number"
            yield Row(CSV, said, "way.csv", cell(3, _column(name), given, ","))
    yield Row(CSV, "column 'tip_x_mm' of way.csv has unit mm", "way.csv", replaced("tip_x_m", "tip_x_mm"))
    yield Row(CSV, "these look like mN", "way.csv", cell(5, 5, "-900", ","))
    yield Row(CSV, "positions must be in metres", "way.csv", cell(5, 1, "-12", ","))
    yield Row(CSV, "way.csv is empty", "way.csv", text(""))
    yield Row(CSV, "has a header and no rows", "way.csv", lambda path: path.write_text(_lines(path)[0]))
    yield Row(CSV, "it holds bytes, not text", "way.csv", lambda path: path.write_bytes(b"\1\2\0"))
    yield Row("lab calibrate way.csv --quiet", "does not say what pressed")
    yield Row("lab calibrate --quiet", "give either a file")
    yield Row("lab calibrate way.csv --synthetic", "give either a file")
    yield Row(
        "lab calibrate --synthetic --fit nu:0.2:0.9", "bounds of 'nu:0.2:0.9': Poisson's ratio 0.9 is outside"
    )
    yield Row("lab calibrate --synthetic --fit mu:-1:1", "bounds of 'mu:-1:1': material friction is -1")
    yield Row(f"{CSV} --fit jelly", "cannot fit 'jelly'")
    yield Row(f"{CSV} --fit E:1", "bounds of 'E:1' are not two numbers")
    yield Row(f"{CSV} --fit E:nan:1", "are no interval")
    yield Row(f"{CSV} --direction 0 0 0", "is no direction")
    yield Row(f"{CSV.replace('sphere_7mm', 'cone')}", "unknown indenter 'cone'")
    yield Row("lab compare --data way.csv", "does not say what pressed")
    yield Row("lab compare --reference-material foo", "unknown material 'foo'")
    yield Row("lab compare --data sphere_7mm=nowhere.csv", "no force-deflection data at nowhere.csv")


def _column(name):
    return "time_s tip_x_m tip_y_m tip_z_m force_x_N force_y_N force_z_N".split().index(name)


def files_of_sensors():
    def change(old, new, said):
        return Row(SENSOR, said, "sensor.yaml", replaced(old, new))

    yield change("modulus_factor: 1.0", "modulus_factor: -1.0", "the factor on the modulus is -1.0")
    yield change("modulus_factor: 1.0", "modulus_factor: 0", "the factor on the modulus is 0")
    yield change("modulus_factor: 1.0", "modulus_factor: .nan", "modulus_factor of sensor.yaml is nan")
    yield change("modulus_factor: 1.0", "modulus_factor: .inf", "the factor on the modulus is inf")
    yield change("modulus_factor: 1.0", "modulus_factor: soft", "modulus_factor of sensor.yaml is 'soft'")
    yield change("modulus_factor: 1.0", "modulus_factor: [1]", "modulus_factor of sensor.yaml is [1]")
    yield change("modulus_factor: 1.0", "modulus_factor: true", "modulus_factor of sensor.yaml is True")
    yield change("modulus_factor", "modulus_facto", "did you mean 'modulus_factor'?")
    yield change("tier: condensed", "tier: turbo", "tier of sensor.yaml is 'turbo': choose one of")
    for old, new, said in (
        ("tier: condensed", "tier: turbo", "tier of sensor.yaml is 'turbo': choose one of condensed, full"),
        ("constitutive: reduced", "constitutive: odd", "constitutive of sensor.yaml is 'odd': choose one of"),
        ("tier: condensed", "turbo: true", "sensor.yaml has 'turbo'"),
        ("sensor: '1'", f"sensor: {{rest: {[0.7] * 19}}}", "these look normalised; give counts of 12 bits"),
    ):
        words = "press --quiet --skin coarse --effects sensor.yaml"
        yield Row(words, said, "sensor.yaml", replaced(old, new))
    yield change("tier: condensed", "tier: 3", "tier of sensor.yaml is 3: pass a text")
    yield change("tier: condensed", "speed: fast", "sensor.yaml has 'speed'")
    yield change("skin: coarse", "skin: [a]", "skin of sensor.yaml is ['a']")
    yield change("sensor: '1'", "sensor: '7'", "sensor is '7': choose one of 1, 2, 3")
    yield change("sensor: '1'", "sensor: 1", "sensor of sensor.yaml is 1: pass a text")
    yield change("sensor: '1'", "sensor: {drift: 1.0}", "sensor.yaml: sensor has drift, which the diagnosis")
    yield change(
        "sensor: '1'",
        "sensor: {rest: [1]}",
        "rest of a sensor has 1 electrodes, and the skin is of BioTac (19 electrodes)",
    )
    yield change("material: default", "material: jelly", "unknown material 'jelly'")
    yield change("material: default", "material: {frction: 1}", "did you mean 'friction'?")
    yield change("material: default", "material: {friction: -1}", "material friction is -1: give a finite")
    yield change("material: default", "material: 7", "material of sensor.yaml is 7")
    yield change("sensor: '1'", "options: {skn: {}}", "did you mean 'skin'?")
    yield change("sensor: '1'", "options: [1]", "options of sensor.yaml is [1]")
    yield change("sensor: '1'", "options: {skin: {samples: 2.5}}", "samples is 2.5: pass a whole number")
    yield change("constitutive: reduced", "constitutive: odd", "constitutive of sensor.yaml is 'odd': choose")
    yield change("sensor/1", "sensor/0", "has schema 'biotac_mj.sensor/0'")
    yield change("  constitutive:\n", "  contact:\n", "acts at the stage 'constitutive'")
    yield change("effect: relax", "effect: jelly", "unknown effect 'jelly'")
    yield change("effect: relax", "effect: 3", "effect of an effect of sensor.yaml")
    yield change("      g:", "      gg:", "has 'gg': did you mean 'g'? choose from")
    yield change("value: 0.0", "value: .nan", "g of 'relax' of sensor.yaml, stage 'constitutive' is")
    yield change("value: 0.0", "value: -5", "is -5: give a value from")
    yield change("value: 0.0", "value: 1e9", "is '1e9'")
    yield change("value: 0.0", "value: soft", "is 'soft': pass a number")
    yield change("value: 0.0", "vale: 0.0", "has no value")
    yield change("        unit: '1'", "        interval95: [1]", "must have two numbers")
    yield change("        unit: '1'", "        interval95: [a, b]", "each a number")
    yield change("        unit: '1'", "        range: 3", "has 'range'")
    yield change("stages:", "stages: 7\nx:", "sensor.yaml has 'x'")
    yield Row(
        SENSOR, "stages of sensor.yaml is 7", "sensor.yaml", text("schema: biotac_mj.sensor/1\nstages: 7")
    )
    yield Row(SENSOR, "sensor.yaml is no sensor file", "sensor.yaml", text("a: [b"))
    yield Row(SENSOR, "it holds list", "sensor.yaml", text("[1]"))
    yield Row(SENSOR, "it holds NoneType", "sensor.yaml", text(""))
    yield Row(
        SENSOR,
        "could not determine a constructor",
        "sensor.yaml",
        text("a: !!python/object/apply:os.system [ls]"),
    )
    yield Row(SENSOR.replace("sensor.yaml", "nowhere"), "no sensor file at nowhere")


def settings():
    for field in dataclasses.fields(Material):
        if field.type in (float, str):
            for value in ("[1]", "null", "true", '{"a": 1}'):
                given = f'{{"{field.name}":{value}}}'.replace(" ", "")
                yield Row(f"{MATERIAL} {given}", f"{field.name} is")
    for given, said in (
        ('{"frction":1}', "material has 'frction': did you mean 'friction'?"),
        ('{"friction":"a"}', "friction is 'a': pass a number"),
        ('{"friction":NaN}', "friction is nan: pass a finite number"),
        ('{"friction":Infinity}', "friction is inf: give a finite number >= 0"),
        ('{"friction":-1}', "material friction is -1: give a finite number >= 0"),
        ('{"youngs_modulus":0}', "must be from 100 to"),
        ('{"youngs_modulus":1e-300}', "must be from 100 to"),
        ('{"poissons_ratio":0.5}', "Poisson's ratio 0.5 is outside"),
        (
            '{"poissons_ratio":0.4999999999}',
            "Poisson's ratio is 0.5 less 1e-10, too little for double precision",
        ),
        ('{"law":"jelly"}', "unknown material law 'jelly'"),
        ('{"element":"cubic"}', "unknown element 'cubic'"),
        ('{"liquid":2}', "liquid is 2: pass true or false"),
        ('{"prony":3}', "prony is 3"),
        ('{"prony":[[1]]}', "prony is [[1]]"),
        ('{"prony":[[1,-1]]}', "tau positive"),
        ('{"mullins":[1,2]}', "mullins [1, 2]"),
        ('{"mullins":[0,2,3]}', "r must be above 1"),
        ('{"hysteresis":[["a",1]]}', "hysteresis is"),
        ('{"youngs_modulus":1' + "0" * 400 + "}", "youngs_modulus is"),
        ("{", "material is no JSON"),
        ("nowhere.json", "no material at nowhere.json"),
        ("jelly", "unknown material 'jelly'"),
    ):
        yield Row(f"{MATERIAL} {given}", said)
    for field in dataclasses.fields(SkinOptions):
        if field.type in (int, float):
            for value in ('"a"', "[1]", "null", "true"):
                yield Row(f'{OPTIONS} {{"skin":{{"{field.name}":{value}}}}}', f"{field.name} is")
        if field.type is int:
            yield Row(
                f'{OPTIONS} {{"skin":{{"{field.name}":2.5}}}}', f"{field.name} is 2.5: pass a whole number"
            )
            yield Row(
                f'{OPTIONS} {{"skin":{{"{field.name}":0}}}}', f"{field.name} is 0: pass a number from 1"
            )
        if field.type is float:
            yield Row(f'{OPTIONS} {{"skin":{{"{field.name}":NaN}}}}', f"{field.name} is nan")
    for field in dataclasses.fields(ContactLaw):
        given = f'{{"skin":{{"contact_law":{{"{field.name}":"a"}}}}}}'
        yield Row(f"{OPTIONS} {given}", f"{field.name} is 'a': pass a number")
    for given, said in (
        ("--sensor f9", "sensor is 'f9': pass one of '1'"),
        (
            '--sensor {"rest":[1]}',
            "rest of a sensor has 1 electrodes, and the skin is of BioTac (19 electrodes)",
        ),
        ('--sensor {"colour":1}', "sensor has 'colour': did you mean 'pac_colour'? choose from like, rest"),
        ("--sensor {rest", "is no JSON"),
        ("--randomise gremlins", "cannot randomise 'gremlins': choose from gain, dead"),
        ("--thermal mithril", "no material is known by 'mithril'"),
        ("--thermal steel mithril", "no material is known by 'mithril'"),
        ('--texture {"height":1}', "give a material, pitch and height, or roughness"),
        ('--thermal {"material":["steel"]}', "thermal is {'material': ['steel']}: give a material's name"),
        ('--thermal {"effusivity":[500]}', "holds something that is not a number"),
        ('--thermal {"material":"steel","temperature":-300}', "temperature of a body is -300.0 C: give"),
        ('--texture {"material":["cork"]}', "texture is {'material': ['cork']}: give a material's name"),
        ('--texture {"roughness":[1e-6]}', "roughness of a texture is [1e-06]"),
    ):
        yield Row(f"press --quiet --skin coarse {given}", said)
        yield Row(f"data generate --quiet --count 1 --labelled 0 {given}", said)
    for given, said in (
        ('{"skn":{}}', "options has 'skn': did you mean 'skin'?"),
        ('{"skin":{"sample":3}}', "options['skin'] has 'sample': did you mean 'samples'?"),
        ('{"skin":3}', "options['skin'] is int: pass a dict"),
        ('{"skin":{"contact_law":3}}', "contact_law is 3"),
        ('{"skin":{"contact_law":{"adhesn":3}}}', "contact_law has 'adhesn': did you mean 'adhesion'?"),
        ('{"skin":{"tolerance":-1}}', "tolerance is -1: give a finite number > 0"),
        ('{"skin":{"dynamics":"odd"}}', "unknown dynamics 'odd'"),
        ('{"skin":{"fill_volume":Infinity}}', "fill_volume is inf"),
        ('{"modulus":"nowhere.npy"}', "no modulus at nowhere.npy"),
        ('{"modulus":"electrodes.txt"}', "electrodes.txt is no modulus"),
        ('{"modulus":"a"}', "no modulus at a"),
        ('{"modulus":[-1,2]}', "modulus is [-1, 2]: pass a positive factor"),
        ('{"modulus":[1,"a"]}', "pass a positive factor"),
        ('{"modulus":3}', "modulus is 3: pass a positive factor"),
        ('{"readings":{"nose":true}}', "options['readings'] has 'nose': did you mean 'noise'?"),
        ('{"readings":{"noise":3}}', "noise of options['readings'] is 3: pass true or false"),
        ('{"readings":{"sensor":1}}', "sensor of options['readings'] is 1: pass a text or a dict"),
        ('{"effects":[]}', "options has 'effects'"),
        ("[1]", "no options at [1]"),
        ("nowhere.json", "no options at nowhere.json"),
        ("electrodes.txt", "electrodes.txt is no options"),
    ):
        yield Row(f"{OPTIONS} {given}", said)
    for verb in (
        "data generate --quiet --skin coarse",
        "lab calibrate way.csv --indenter sphere_7mm",
        "lab compare --quiet",
    ):
        yield Row(f'{verb} --options {{"skn":{{}}}}', "did you mean 'skin'?")
        yield Row(f'{verb} --options {{"skin":{{"samples":2.5}}}}', "samples is 2.5: pass a whole number")
        yield Row(f'{verb} --material {{"friction":"a"}}', "friction is 'a': pass a number")
    for given, said in (
        ('{"modulus":[1,2]}', "cannot vary 'modulus'"),
        ('{"friction":1}', "friction varies over 1"),
        ('{"friction":[2,1]}', "friction varies over"),
        ('{"friction":[1,NaN]}', "friction varies over"),
        ("[", "no vary at ["),
    ):
        yield Row(f"data generate --quiet --vary {given}", said)


def configs():
    for field in dataclasses.fields(LearningConfig):
        wrong = 3 if field.type in (str, bool) else "a"
        change = text(json.dumps({field.name: wrong}))
        yield Row(TRAIN, f"{field.name} is {wrong!r}: pass", "config.json", change)
        if field.type in (int, float):
            change = text(json.dumps({field.name: -1}))
            yield Row(TRAIN, f"{field.name} is -1: it must not be negative", "config.json", change)
        if field.type is int:
            change = text(json.dumps({field.name: 2.5}))
            yield Row(TRAIN, f"{field.name} is 2.5: pass a whole number", "config.json", change)
    yield Row(TRAIN, "did you mean 'steps'?", "config.json", text('{"stps": 3}'))
    yield Row(TRAIN, "config.json is no config", "config.json", text("no"))
    yield Row(TRAIN, "it holds list", "config.json", text("[]"))
    yield Row(TRAIN, "choose one of latent, decoded", "config.json", text('{"projection_loss": "odd"}'))
    yield Row(TRAIN.replace("config.json", "nowhere"), "no config at nowhere")


def weights_of_networks():
    for name in ("force_basis", "force_scale", "scale", "pod.basis", "pod.scale"):
        said = f"{name} of inverse.safetensors has weights that are not finite"
        yield Row(PATCH, said, "inverse.safetensors", weights(poisoned(name)))
        yield Row(PATCH, "inverse.safetensors", "inverse.safetensors", weights(without(name)))
    for name in ("mesh", "skin", "channels", "nvert", "nouter"):
        said = f"the description of inverse.safetensors has no {name}"
        yield Row(PATCH, said, "inverse.safetensors", weights(**{name: None}))
        said = f"{name} of the description of inverse.safetensors is {{}}"
        yield Row(PATCH, said, "inverse.safetensors", weights(**{name: {}}))
    yield Row(PATCH, "cannot read skin 'default'", "inverse.safetensors", weights(nvert=3))
    yield Row(PATCH, "was trained with channels a", "inverse.safetensors", weights(channels=["a"]))
    yield Row(PATCH, "outer nodes, the skin has", "inverse.safetensors", weights(nouter=3))
    yield Row(PATCH, "holds no model that reads", "inverse.safetensors", weights(direction="forward"))
    yield Row(PATCH, "is no file of weights", "inverse.safetensors", cut)
    yield Row(PATCH, "is no file of weights", "inverse.safetensors", text(""))
    yield Row(PATCH.replace("inverse", "forward"), "holds no model that reads electrodes")
    yield Row(PATCH.replace("inverse.safetensors", "nowhere"), "no file of weights at nowhere")
    yield Row(f"{PATCH} --skin coarse", "cannot read skin 'coarse'")
    yield Row("learn judge --new-sensor shard.h5 --weights force.txt", "force.txt is no file of weights")


def trained_models():
    report, arrays_of = "trained/trajectory-0.json", "trained/trajectory-0.npz"
    for name in "split seed set interactions labelled device mesh inverse seconds".split():
        yield Row(EVALUATE, f"trajectory-0.json has no {name}", report, entry(**{name: None}))
        yield Row(EVALUATE, f"{name} of trained/trajectory-0.json is [3]", report, entry(**{name: [3]}))
    for name in "truth tare time owner object test".split():
        yield Row(EVALUATE, f"trajectory-0.npz has no {name}", arrays_of, arrays(**{name: None}))
        yield Row(
            EVALUATE, f"{name} of trained/trajectory-0.npz has", arrays_of, arrays(**{name: one_more_axis})
        )
    for name in "truth tare time predicted_linear".split():
        yield Row(EVALUATE, f"{name} of trained/trajectory-0.npz has", arrays_of, arrays(**{name: nan_first}))
    yield Row(EVALUATE, "none of both parts", arrays_of, arrays(test=lambda v: v & False))
    yield Row(EVALUATE, "says it is other-0", report, entry(split="other"))
    yield Row(EVALUATE, "is no result of", report, text("no"))
    yield Row(EVALUATE, "is no file of predictions", arrays_of, cut)
    yield Row("learn judge nowhere", "nowhere: no such file")
    yield Row("learn judge", "give one of a folder that")
    yield Row("learn judge trained --new-sensor shard.h5", "give one of a folder that")
    yield Row("learn judge trained --force force.txt", "--force goes with a recording")
    for words in (
        "electrodes.txt --json electrodes.txt",
        "electrodes.txt --force force.txt --json force.txt",
    ):
        yield Row(f"learn judge {words}", ".txt is one of the files that are read: give another name")
    own = "inverse.safetensors --out inverse.safetensors"
    yield Row(f"learn train {own}", "--out inverse.safetensors is one of the files that are read")
    for name in ("nowhere", "mesh", "/dev/null"):
        for words in ("learn judge", "diagnose", "diagnose --electrodes"):
            if (words, name) not in (("learn judge", "mesh"), ("diagnose", "nowhere")):
                yield Row(f"{words} {name} --quiet", f"{name}")
    yield Row("learn judge trained --weights forward.safetensors", "--weights goes with --new-sensor")
    yield Row("learn judge trained --sensor own.yaml", "--sensor goes with --new-sensor")
    yield Row("learn train electrodes.txt --force force.txt --out a", "go with one model: give --out FILE")
    yield Row("learn predict force.txt electrodes.txt", "force.txt is no file of weights")
    file = "forward.safetensors"
    yield Row(
        f"learn predict {file} electrodes.txt",
        "it describes itself by [1]",
        file,
        lambda path: described(path, "[1]"),
    )
    for name, said in (("p.txt", "ends in none of .csv"), ("force.txt/a.csv", "force.txt is a file")):
        yield Row(f"learn predict forward.safetensors electrodes.txt --out {name}", said)
    yield Row("learn predict forward.safetensors electrodes.txt", "holds no model that reads electrodes")
    for words, said in (
        ("--object spoon", "unknown object 'spoon'"),
        ("--object sphere_7mm", "has no pose of the object"),
        ("--object sphere_7mm --object-pose 1 2", "is no pose"),
        ("--poses fitted", "a match needs the force"),
        ("--poses fitted --object ring_7mm", "fitted poses are a plate's"),
        ("", "give --object, one of"),
    ):
        yield Row(f"data resimulate electrodes.txt --quiet --skin coarse --out out {words}", said)
    yield Row("learn train shard.h5 --quiet --out trained", "is of other settings (set, config")


def meshes():
    tet = "mesh/skin.tet"
    yield Row(MESH, "vertices are NaN or infinite", tet, cell(0, 1, "nan"))
    yield Row(MESH, "line 1: could not convert", tet, cell(0, 1, "x"))
    yield Row(MESH, "holds 0 vertices and 0 tetrahedra", tet, text(""))
    yield Row(MESH, "line 1 is cut short", tet, text("v 1 2\n"))
    yield Row(MESH, "is no text file", tet, lambda path: path.write_bytes(b"\xff\xfe\0v"))
    yield Row(MESH, "indices must be 0-based", tet, replaced("\nt ", "\nt 99999999999999999999 0 1 2\nt "))
    yield Row(MESH, "tetrahedra name vertices outside", tet, replaced("\nt ", "\nt -1 0 1 2\nt "))
    yield Row(MESH, "need three", "mesh/nail.obj", pathlib.Path.unlink)
    yield Row(MESH, "it needs one file ending in", tet, pathlib.Path.unlink)
    for part in ("core", "nail", "clamp"):
        path = f"mesh/{part}.obj"
        yield Row(MESH, f"{part}.obj, line 1: vertex", path, cell(0, 1, "nan"))
        yield Row(MESH, f"{part}.obj, line 1: vertex", path, cell(0, 3, "inf"))
        yield Row(MESH, f"{part}.obj, line 1: could not", path, cell(0, 1, "x"))
        yield Row(MESH, f"{part}.obj holds no usable faces", path, text("v 0 0 0\n"))
        yield Row(MESH, f"{part}.obj holds no usable faces", path, replaced("\nf ", "\nf 99999 1 2\nf "))
        yield Row(MESH, f"{part}.obj is no text file", path, lambda path: path.write_bytes(b"\xff\0"))
    for ending in ("msh", "vtu"):
        yield Row(f"lab mesh bad.{ending}", f"bad.{ending} is no mesh", f"bad.{ending}", text("no"))
    yield Row("lab mesh electrodes.txt", "is no mesh this can read")
    ball = "press --quiet --skin coarse --indenter mesh:ball.obj"
    yield Row(ball, "vertices that are not finite", "ball.obj", cell(0, 1, "nan"))
    yield Row(ball, "ball.obj is", "ball.obj", replaced("f ", "# "))
    yield Row(ball, "ball.obj", "ball.obj", text(""))
    for factor, offset, said in (
        (1e3, 0, "is it in millimetres? multiply it"),
        (1e-3, 0, "was it scaled twice? multiply it"),
        (1, 0.2, "mm from the origin of its frame"),
    ):
        yield Row(ball, said, "ball.obj", moved(factor, offset))
    yield Row(ball, "ball.obj is no indenter mesh", "ball.obj", cell(0, 1, "x"))
    stl = ball.replace("ball.obj", "ball.stl")
    for said, content in (
        ("ball.stl is empty", b""),
        ("ball.stl is text in which no face", b"solid ball\nfacet normal 0 0 1\nvertex 0 a 0\n"),
        ("ball.stl has 94 of the 184 bytes that its 2 faces", bytes(80) + b"\2\0\0\0" + bytes(10)),
        ("ball.stl has no faces", bytes(84)),
    ):
        yield Row(stl, said, "ball.stl", lambda path, content=content: path.write_bytes(content))
    yield Row(ball.replace("ball.obj", "nowhere.obj"), "no indenter mesh at nowhere.obj")


NUMBERS = {
    "press": "location:a,nan,1e9 depth:0,-1,a,nan,inf slide:-1,inf speed:0,-1,nan hold:-1,inf,1e12 "
    "timestep:0,-1,nan,1e-9 mu:-1,nan,a seed:-1,1.5,a,99999999999 device:gpu,cuda:0,cuda:x "
    "indenter:cone,geom:box:1 tier:turbo",
    "view": "seconds:-1,nan,inf,1e12 seed:-1 tier:turbo",
    "play": "port:0,-1,99999,a seed:-1",
    "lab calibrate way.csv": "noise:-1,nan,a seed:-1 configuration:gel device:gpu",
    "lab compare": "count:0,-1,a,1e3 seed:-1 configurations:gel indenters:cone device:gpu",
    "data generate": "count:0,-1,a,1.5 steps:0,7,99999 rate:0,-1,nan,inf labelled:-1 recordings:-1 batch:0 "
    "measured-batch:0 measured-seed:-1 workers:-1,99999 seed:-1 objects:spoon kinds:poke "
    "element:cubic device:tpu",
    "diagnose shard.h5": "rate:0,-1,nan,a locked:0,1,nan,-1 tier:turbo device:gpu",
    "data import electrodes.txt": "rate:0,nan,a block:0,-1,nan seed:-1",
    "learn train shard.h5": "seeds:-1,a,1.5 steps:0,-1,a device:gpu",
    "learn judge trained": "fraction:nan,a seed:-1",
    "learn predict inverse electrodes.txt": "tare:a,1.5 row:a",
    "lab estimate electrodes.txt": "rest:0,a row:a,99999 rate:0,nan indenter:cone material:jelly",
    "data resimulate electrodes.txt": "at-most:0,nan,a block:0,-1 batch:0 workers:-1 seed:-1 "
    "device:gpu,cuda:0 mount:a,nan",
    "learn predict forward.safetensors electrodes.txt": "tare:0,a,1.5 rate:0,nan",
}


def numbers():
    for verb, table in NUMBERS.items():
        for argument in table.split():
            name, _, values = argument.partition(":")
            for value in values.split(","):
                said = value if name == "indenter" else name
                out = " --out out" if verb.startswith(("data import", "data resimulate")) else ""
                yield Row(f"{verb} --{name}={value}{out}", said)
    yield Row(
        "lab estimate electrodes.txt --quiet --row 100",
        "row 100 of electrodes: ln Z differs from rest by 0.0",
    )
    yield Row(
        "lab estimate electrodes.txt --quiet --sensor 1", "--sensor 1 is for a file without a row untouched"
    )
    dead = cell(20, 3, "4095")
    said = "row 20 of electrodes: counts are not 19 numbers between 1 and 4094"
    yield Row("lab estimate electrodes.txt --quiet --row 20", said, "electrodes.txt", dead)
    flat = lambda path: np.savetxt(path, np.zeros((420, 3)), "%d")  # noqa: E731
    words = "learn judge --quiet electrodes.txt --force force.txt"
    yield Row(words, "electrodes: the force never changes, so that it cannot be learned", "force.txt", flat)
    for hold, timestep in (("20ms", "1e-9ms"), ("1e12s", "4ms")):
        yield Row(f"press --hold {hold} --timestep {timestep}", "steps of")
    for timestep in ("101ms", "1e30"):
        yield Row(f"press --timestep {timestep}", "to 100 ms can be given")
    for speed in ("1001mm/s", "1e99"):
        yield Row(f"press --speed {speed}", "1000 mm/s at most")
    # what is a thousand times too much is asked about, in the unit that people think in
    for words, asked in (
        ("--depth 1.5", "depth is 1.5 m: did you mean 1.5mm? 20 mm at most"),
        ("--depth 1500", "depth is 1500 m: 20 mm at most"),
        ("--location -12 17", "location's x is -12 m: did you mean -12mm?"),
        ("--location -12mm 17", "location's angle is 17 rad: did you mean 17deg?"),
        ("--slide 2", "slide is 2 m: did you mean 2mm?"),
        ("--speed 10", "speed is 10 m/s: did you mean 10mm/s?"),
        ("--timestep 4", "'4' is 4 s: 0 to 100 ms can be given; did you mean 4ms?"),
        ("--depth 2deg", "it is '2deg': give a number with a unit, as in 2mm (of m, mm, cm, um)"),
        ("--location here", "give a number with a unit, as in 2mm"),
        ("--location -12mm 3mm", "location is '3mm': give a number with a unit, as in 2deg"),
    ):
        yield Row(f"press --skin coarse {words}", asked)
    for verb in (
        "recording import --out out.h5",
        "recording show --out out",
        "learn judge",
        "data resimulate --out out",
    ):
        yield Row(f"{verb} /proc/self/mem", "/proc/self/mem: Input/output error: check the path")
    yield Row("press --location 1mm 2mm 3mm 4mm", "give x, x and an angle, or x, y and z")
    yield Row("press --skin coarse --location 40mm", "no skin at x = 40 mm")
    yield Row(
        "press --skin coarse --location 0 0 0", "location (0, 0, 0) mm lies inside the finger's rigid core"
    )
    yield Row("press --skin coarse --direction 0 -1 0", "leaves the skin")
    yield Row("press --direction 0 0 0", "is no direction")
    along = "press --skin coarse --slide 1mm --direction 0 1 0 --slide-direction 0 1 0"
    yield Row(along, "slide_direction is along the press")
    yield Row("press --two-way --one-way", "not allowed with")
    for option in ("truth rubber", "truth-skin coarse", "noise 0.1", "truth-liquid"):
        name = option.split()[0]
        yield Row(f"{CALIBRATE} --{option}", f"--{name} belongs to our own synthetic skin: give --synthetic")
    words = "lab compare --data sphere_7mm=way.csv --reference-material rubber"
    yield Row(words, "--reference-material belongs to our own synthetic skin: leave it out")
    yield Row("view --render out.png --hand force.txt", "force.txt is no hand (")
    yield Row("view --skin coarse --render o.xyz", "o.xyz is no picture: give a name that ends in one of")
    yield Row("press --indenter geom:sphere:3", "geom:sphere:3's largest dimension is 6000 mm, not")
    yield Row("press --indenter geom:box:0.003,0.003,300", "300's largest dimension is 6e+05 mm, not")
    yield Row("press --jelly", "no option --jelly")
    yield Row("", "the following arguments are required: VERB")
    yield Row("jelly", "invalid choice: 'jelly'")
    yield Row("view press.h5", "nothing takes press.h5")
    yield Row("generate", "no verb generate: it is `biotac data generate`")
    yield Row("evaluate", "no verb evaluate: it is `biotac learn judge`")
    yield Row("learn train electrodes.txt --out many", "electrodes.txt is no set: a folder of networks is")
    yield Row("view --render out.png --hand nowhere.xml", "no hand at nowhere.xml")
    yield Row("play roll_rod --render out.png", "out.png does not end in .gif")
    yield Row("diagnose", "nothing to diagnose")
    for data in ("set", "shard.h5"):
        yield Row(f"diagnose {data} --object abc", f"{data} records what touched: leave --object out")
    also = "diagnose --quiet --electrodes electrodes.txt --force force.txt --simulate --also"
    yield Row(f"{also} nowhere force.txt", "nowhere: no such file: check its name")
    yield Row(f"{also} electrodes.txt mesh", "mesh: no such file: it is a folder")
    for rate in ("1e-3", "1.9"):
        yield Row(
            f"diagnose --quiet --electrodes electrodes.txt --rate {rate}", f"rate is {float(rate):g}: give"
        )
    both = "shard.h5 and --electrodes electrodes.txt are both given: leave one out"
    yield Row("diagnose shard.h5 --electrodes electrodes.txt", both)
    for option in ("skin coarse", "effects sensor.yaml", "material default", "repeatability 1mm", "in-skin"):
        for words in ("diagnose --electrodes electrodes.txt", "diagnose electrodes.txt"):
            idle = f"--{option.split()[0]} can act only on a simulation along poses, and electrodes.txt"
            yield Row(f"{words} --quiet --{option}", f"{idle} has none")
    yield Row("data generate --count 4 --labelled 9", "labelled is 9")
    yield Row("data generate --skin nowhere.npz", "no skin at nowhere.npz")
    yield Row("data generate --count 2 --labelled 1 --measured-skin nowhere.npz", "no skin at nowhere.npz")
    yield Row("data import --out out", "the following arguments are required: FILE")


OUT = {
    "press": ("--out", "readings.csv"),
    "lab calibrate way.csv": ("--out", "calibration.json"),
    "lab compare": ("--out", "compare.json"),
    "data generate": ("--out", "generate.json"),
    "diagnose shard.h5": ("--out", "verdict.json"),
    "data import electrodes.txt": ("--out", None),
    "data export shard.h5": ("--out", None),
    "learn train shard.h5": ("--out", None),
    "data resimulate electrodes.txt": ("--out", "resimulate.json"),
    "learn predict inverse electrodes.txt": ("--out", "contact.png"),
}
OUT_FILES = {"learn judge trained": "--json", "view": "--render", "lab estimate electrodes.txt": "--out"}
# what is read, before its name, and a file of that name that the verb writes
OVER_FOLDERS = {
    "press --effects ": "readings.csv",
    "lab calibrate way.csv --indenter sphere_7mm --material ": "calibration.json",
    "lab compare --data sphere_7mm=": "compare.json",
    "data generate --vary ": "generate.json",
    "diagnose shard.h5 --effects ": "sensor_amended.yaml",
    "diagnose --electrodes electrodes.txt --simulate --also electrodes.txt ": "verdict.json",
    "data resimulate ": "resimulate.json",
    "learn predict inverse ": "contact.json",
}
OVER_FILES = {
    "lab mesh skin.npz --out": "skin.npz",
    "hand mount force.txt --body a --out": "force.txt",
    "lab estimate electrodes.txt --known force.txt --out": "force.txt",
}


def outputs():
    for verb, (name, file) in OUT.items():
        yield Row(f"{verb} {name} force.txt", "force.txt is a file")
        yield Row(f"{verb} {name} force.txt/a/b", "lies under force.txt, which is a file")
        yield Row(f"{verb} {name} {'x' * 300}", "is too long for a name")
        yield Row(f"{verb} {name} {'x/' * 3000}", "too long")
        yield Row(
            f"{verb} {name} link",
            "link is a link to nothing",
            "link",
            lambda path: path.symlink_to("nowhere"),
        )
        yield Row(f"{verb} {name} /proc/self/x", "/proc/self/x cannot be written to")
        yield Row(f"{verb} {name} /dev/full", "/dev/full is a file")
        if file:
            made = lambda path: (path.parent.mkdir(), path.mkdir())  # noqa: E731
            yield Row(f"{verb} {name} there", f"there/{file} is there and is no file", f"there/{file}", made)
    for verb, name in OUT_FILES.items():
        yield Row(f"{verb} {name} mesh", "mesh is a folder")
        yield Row(f"{verb} {name} force.txt/a.png", "force.txt is a file")
        yield Row(f"{verb} {name} {'x' * 300}.png", "is too long for a name")
        yield Row(f"{verb} {name} /proc/self/x.png", "/proc/self cannot be written to")
        yield Row(f"{verb} {name} /dev/full", "is there and is no file")
    for words in (
        "press --out=",
        "press --effects=",
        "recording import electrodes.txt --out= --object=",
        "learn judge --json=",
    ):
        yield Row(words, "an empty argument at --")
    for words in (
        "recording show electrodes.txt --out a.png --recording=--",
        "lab compare --count=--",
        "data generate --count=--",
        "press --out=--",
        "press --location=--",
        "press --depth=--",
        "press --randomise=--",
        "press --effects=--",
        "hand mount force.txt --body=--",
    ):
        yield Row(words, f"no value in {words.split()[-1]}: give one, or leave the option out")
    yield Row("recording import shard.h5 --out shard.h5", "shard.h5 is there already: give a new")
    yield Row("recording show electrodes.txt --out electrodes.txt", "electrodes.txt is no picture: give a")
    yield Row("view --material material.json --render material.json", "material.json is no picture: give a")
    yield Row("recording import electrodes.txt --out a.csv", "a.csv does not end in .h5: give a name that")
    yield Row("recording export electrodes.txt --ros1 a.csv", "a.csv does not end in .bag: give a name that")
    yield Row("recording export electrodes.txt --ros1 force.txt", "force.txt is there already: give a new")
    yield Row("recording export electrodes.txt --ros2 mesh", "mesh is there already: give a new")
    yield Row("recording record --topic /a --out shard.h5", "shard.h5 is there already: give a new")
    for words, file in OVER_FOLDERS.items():
        made = lambda path: (path.parent.mkdir(), path.write_text("{}"))  # noqa: E731
        said = f"--out there: there/{file} is one of the files that are read: choose another folder"
        yield Row(f"{words}there/{file} --out there", said, f"there/{file}", made)
    for words, file in OVER_FILES.items():
        option = words.split()[-1]
        yield Row(f"{words} {file}", f"{option} {file} is one of the files that are read: give another name")
    yield Row("lab mesh mesh --out skin.h5", "does not end in .npz")
    yield Row("lab mesh mesh --out force.txt/a.npz", "force.txt is a file")
    yield Row(f"lab mesh mesh --out {'x' * 300}.npz", "is too long for a name")
    yield Row("data export shard.h5 --out mesh", "mesh is there already")
    yield Row("data import electrodes.txt --out set", "set/shard-00000.h5 is there already: give a new")


TABLES = (
    files_of_skins, files_of_presses, files_of_nvidia, files_of_sets, files_of_text, files_of_csv,
    files_of_sensors, settings, configs, weights_of_networks, trained_models, meshes, numbers, outputs,
)  # fmt: skip
ROWS = [row for table in TABLES for row in table()]


@pytest.fixture(scope="module")
def good(synthetic_press, tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    make_files(folder, synthetic_press)
    (folder / "set").mkdir()
    shutil.copy(folder / "shard.h5", folder / "set" / "shard-00000.h5")
    return folder


def everything(folder):
    """Name -> size and time of all that lies in a folder."""
    return {p: (p.lstat().st_size, p.lstat().st_mtime_ns) for p in folder.rglob("*") if not p.is_dir()}


def run(words, capsys):
    """(exit code, text on stderr) of a command line."""
    capsys.readouterr()
    try:
        code = cli.main(words)
    except SystemExit as stop:  # argparse's
        code = stop.code
    return code, capsys.readouterr().err


@pytest.mark.parametrize("row", ROWS, ids=str)
def test_bad_input_is_one_line(row, good, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    words = row.words.split()
    named = {f"{word}/".split("/")[0] for part in words for word in part.replace('"', ":").split(":")}
    for name in {*named, row.file.split("/")[0]} - {""}:
        if os.path.isdir(good / name):
            shutil.copytree(good / name, tmp_path / name)
        elif os.path.isfile(good / name):
            shutil.copy(good / name, tmp_path / name)
    if row.file:
        row.change(tmp_path / row.file)
    before = everything(tmp_path)
    code, said = run(words, capsys)
    assert row.text in said and said.startswith("biotac: error: ") and said.count("\n") == 1, said[-2000:]
    assert code == 2
    assert everything(tmp_path) == before


@pytest.mark.parametrize(("name", "said"), [("counts", "simulated"), ("measured_counts", "measured")])
@pytest.mark.parametrize(
    ("factor", "unit"), [(1e30, "raw counts 0..4095 are needed"), (1 / 4095, "look like volts")]
)
def test_training_takes_no_scaled_counts(name, said, factor, unit, good, tmp_path):
    """More interactions than the table's set has would be needed to come there from the command line."""
    from biotac_mj.learning.training.arrays import load_arrays

    shutil.copy(good / "shard.h5", tmp_path)
    load_arrays(tmp_path / "shard.h5")
    put(f"step/{name}", lambda v: (v * np.float64(factor)).astype(np.float32))(tmp_path / "shard.h5")
    with pytest.raises(ValueError, match=f"{said} counts of .*shard.h5: .*{unit}"):
        load_arrays(tmp_path / "shard.h5")


def test_the_table_is_long():
    assert len(ROWS) >= 400
    assert all(len(row.text) >= 2 for row in ROWS)
