"""The command line: help, errors in one line, and the files of a whole press."""

import argparse
import csv
import dataclasses
import pathlib
import re
import subprocess
import sys

import h5py
import numpy as np
import pytest
from matplotlib.image import imread

from biotac_mj import cli
from biotac_mj.data.generation.generate import GenerateOptions
from biotac_mj.press import PressOptions, indenter
from biotac_mj.press.indenter import make_indenter
from biotac_mj.skin.rubber.material import PRESETS


def test_names_in_the_help_are_the_real_ones():
    from biotac_mj.geometry import SKINS

    assert sorted(cli.INDENTERS) == sorted(indenter.INDENTERS)
    assert list(cli.MATERIALS) == list(PRESETS) and cli.SKINS == SKINS


def options_of(parser, verb=""):
    """(verb, action) of the whole command line."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                yield from options_of(inner, f"{verb} {name}".strip())
        else:
            yield verb, action


OUTPUTS = {
    f"{verb} {(*action.option_strings, action.dest)[0]}": action.type
    for verb, action in options_of(cli.parser())
    if action.dest in ("out", "json", "render", "picture", "ros1", "ros2", "folder")
    and action.nargs != 0  # a flag
}
# file or folder of an output -> what must be there for it to be refused
NEVER_REPLACED = {
    "recording import --out": "",
    "recording record --out": "",
    "checkup --out": "",
    "recording export --ros1": "",
    "recording export --ros2": "",
    "data import --out": "shard-00000.h5",
    "data export --out": "",
    "design new folder": "design.json",
}


def output(name, place):
    """An output in a folder, of the suffix that it must have."""
    for suffix in ("", ".h5", ".bag", ".gif", ".npz"):
        try:
            return OUTPUTS[name](str(place / f"made{suffix}"))
        except argparse.ArgumentTypeError as error:
            assert "does not end in" in str(error)


@pytest.mark.parametrize("name", OUTPUTS)
def test_an_output_is_checked_before_the_work(name, tmp_path):
    """While arguments are read, so before a verb begins."""
    good = output(name, tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(argparse.ArgumentTypeError, match="is a file|lies under"):
        OUTPUTS[name](good.replace(str(tmp_path), f"{tmp_path}/file/inside"))


@pytest.mark.parametrize("name", OUTPUTS)
def test_results_are_replaced_and_recordings_are_not(name, tmp_path):
    good = output(name, tmp_path)
    files = [pathlib.Path(good) / NEVER_REPLACED[name]] if name in NEVER_REPLACED else good.files
    for file in files:
        file.parent.mkdir(exist_ok=True)
        file.touch() if good.files else file.mkdir()
    if name not in NEVER_REPLACED:
        assert OUTPUTS[name](str(good)).files == files
        return
    with pytest.raises(argparse.ArgumentTypeError, match=f"{files[0]} is there already: give a new name"):
        OUTPUTS[name](str(good))


def test_help_shows_all_choices(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["press", "--help"])
    assert stop.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    options = (
        "--location --direction --depth --slide --slide-direction --timestep --speed --two-way "
        "--one-way --friction --seed --out --no-render"
    )
    geoms = "capsule cylinder ellipsoid box plane mesh:FILE"
    for choice in (
        *cli.INDENTERS,
        *cli.MATERIALS,
        *cli.SKINS,
        *options.split(),
        "--no-liquid",
        *geoms.split(),
    ):
        assert choice in text, choice


def test_without_a_verb_the_help_says_which_there_are(capsys, monkeypatch):
    """To a script it is an error all the same."""
    monkeypatch.setattr(sys, "argv", ["biotac"])
    for argv in ([], None):
        with pytest.raises(SystemExit) as stop:
            cli.main(argv)
        said = capsys.readouterr()
        assert stop.value.code == 2 and said.err.startswith("biotac: error: ")
        assert said.out.startswith("usage: biotac") and "diagnose" in said.out


def test_help_says_each_default(capsys):
    """0 and 1 too, which equal False and True."""
    for verb, text in (("lab estimate", "sensor at rest (default: 1)"), ("press", "noise (default: 0)")):
        with pytest.raises(SystemExit):
            cli.main([*verb.split(), "--help"])
        assert text in " ".join(capsys.readouterr().out.split())


def test_help_says_a_default_once(capsys):
    with pytest.raises(SystemExit):
        cli.main(["data", "export", "--help"])
    assert capsys.readouterr().out.count("(default: lerobot)") == 1


def test_defaults_are_those_of_the_dataclasses():
    """argparse keeps the command light: a press is a dataclass, but it brings MuJoCo and Warp along."""
    press = cli.parser().parse_args(["press"])
    options = PressOptions()
    for name in ("indenter", "depth", "slide", "timestep", "speed", "hold", "two_way"):
        assert getattr(press, name) == pytest.approx(getattr(options, name)), name
    assert tuple(press.slide_direction) == options.slide_direction
    made = cli.parser().parse_args(["data", "generate"])
    for field in dataclasses.fields(GenerateOptions):
        given = getattr(made, field.name)
        if given is not None and field.name not in ("objects", "kinds", "labelled"):
            assert given == field.default, field.name
    assert tuple(made.objects) == GenerateOptions().objects and tuple(made.kinds) == GenerateOptions().kinds


def test_units_mean_the_same_on_the_command_line_and_in_python():
    """With a unit, or plain numbers of SI; negative ones are no options."""
    words = "press --location -14mm -30deg --depth 1.5mm --slide 0.002 --speed 1cm/s --hold 5ms"
    with pytest.raises(SystemExit):
        cli.parser().parse_args(words.split())  # cm/s is none of ours
    args = cli.parser().parse_args(words.replace("1cm/s", "10mm/s").split())
    texts = PressOptions(location=args.location, depth="1.5mm", slide="2mm", speed="10mm/s", hold="0.005")
    plain = PressOptions(location=(-14e-3, -np.pi / 6), depth=1.5e-3, slide=2e-3, speed=0.01, hold=5e-3)
    assert PressOptions(location="-14mm -30deg") == PressOptions(location=plain.location)
    for micro in ("um", "\u00b5m", "\u03bcm"):  # the micro sign and the letter mu
        assert PressOptions(depth=f"1500{micro}").depth == pytest.approx(1.5e-3)
    assert PressOptions(location="-14mm") == PressOptions(location=(-14e-3, 0.0))
    for name in ("location", "depth", "slide", "speed", "hold"):
        assert getattr(texts, name) == pytest.approx(getattr(plain, name)), name
        if name != "location":
            assert getattr(args, name) == pytest.approx(getattr(plain, name)), name
    assert make_indenter("geom:capsule:3mm,5mm").size == pytest.approx((3e-3, 5e-3))
    for wrong, asked in (
        (dict(location=(-12e-3, 17)), "location's angle is 17 rad: did you mean 17deg"),
        (dict(location=(-12, 0)), "location's x is -12 m: did you mean -12mm"),
        (dict(speed=10), "speed is 10 m/s: did you mean 10mm/s"),
        (dict(depth=2.4), "depth is 2.4 m: did you mean 2.4mm"),
    ):
        with pytest.raises(ValueError, match=re.escape(asked)):
            PressOptions(**wrong)


@pytest.mark.parametrize(
    "words, value, said",
    [
        ("press --hold 20", None, "'20' is 20 s: did you mean 20ms? write 20s if not"),
        ("press --hold 2e5", None, "'2e5' is 200000 s: write 200000s if not"),
        ("press --hold 20s", 20.0, None),
        ("press --hold 0.5", 0.5, None),
        ("view --seconds 500ms", 0.5, None),
        ("view --seconds 300", None, "'300' is 300 s: 0 to 6e+04 ms can be given; did you mean 300ms?"),
        ("data import log.txt --out set --block 10s", 10.0, None),
        (
            "design new pad --block 0.02mm 9mm 9mm",
            None,
            "'0.02mm' is 2e-05 m: 0.1 to 100 mm can be given; did you mean 0.02m?",
        ),
        (
            "design new pad --block 20 9mm 9mm",
            None,
            "'20' is 20 m: 0.1 to 100 mm can be given; did you mean 20mm?",
        ),
        ("design new pad --block 200mm 9mm 9mm", None, "'200mm' is 0.2 m: 0.1 to 100 mm can be given"),
    ],
)
def test_a_quantity_out_of_range_is_asked_about(words, value, said, capsys):
    try:
        args = cli.parser().parse_args(words.split())
    except SystemExit:
        assert said in " ".join(capsys.readouterr().err.split())
    else:
        option = next(word[2:] for word in words.split() if word in ("--hold", "--seconds", "--block"))
        assert said is None and getattr(args, option) == value


def test_help_is_light():
    code = (
        "import sys; from biotac_mj.cli import parser; parser(); "
        "print({'warp', 'trimesh', 'matplotlib'} & set(sys.modules))"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "set()"
    )


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["press", "--indenter", "cone"], "unknown indenter 'cone': choose one of"),
        (["press", "--indenter", "geom:torus:1"], "unknown geom type 'torus'"),
        (["press", "--indenter", "mesh:nowhere.obj"], "no indenter mesh at nowhere.obj"),
        (
            ["press", "--skin", "nowhere.npz"],
            "no skin at nowhere.npz: pass 'coarse', 'default', 'fine', a design's folder or a file made",
        ),
        (["press", "--skin", "coarse", "--location", "40mm"], "no skin at x = 40 mm"),
        (
            ["press", "--skin", "coarse", "--material", "jelly"],
            "unknown material 'jelly': choose one of default, paper, rubber",
        ),
        (["press", "--depth", "-1mm"], "depth is -1 mm: it must be a positive number"),
        (["lab", "mesh", "nowhere"], "no mesh at nowhere"),
        (["play", "insert_peg", "--policy", "no.safetensors"], "no policy at no.safetensors: give script"),
    ],
)
def test_errors_are_one_line(words, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == 2
    err = capsys.readouterr().err
    assert err.startswith("biotac: error: ") and text in err and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["press", "--indentor", "cone"], "no option --indentor: did you mean --indenter? (`biotac press -"),
        (["press", "--design", "biotac_sp"], "no option --design: did you mean --skin biotac_sp/coarse?"),
        (["press", "--dep=1"], "no option --dep: did you mean --depth? (`biotac press --help`"),
        (
            ["hand", "mount", "hand.xml", "--bodi", "ff"],
            "no option --bodi: did you mean --body? (`biotac hand mount ",
        ),
        (["press", "--qqq"], "no option --qqq (`biotac press --help`"),
        (["press", "deep"], "nothing takes deep (`biotac press --help`"),
        (["pres"], "invalid choice: 'pres'"),
        (
            ["--skin", "coarse", "press"],
            "--skin stands before the verb: give the verb first, then its options",
        ),
    ],
)
def test_what_a_verb_does_not_know_it_says_itself(words, text, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    err = capsys.readouterr().err
    assert stop.value.code == 2 and text in err and err.count("\n") == 1


def test_view_without_a_display_says_what_to_do(capsys, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert cli.main(["view"]) == 2
    assert "no display to open a window on: use `biotac view --render FILE.png`" in capsys.readouterr().err


def test_a_press_in_which_most_steps_fail_says_so(capsys, tmp_path):
    lazy = 'press --skin coarse --timestep 20ms --no-render --options {"skin":{"max_newton":1}} --quiet --out'
    assert cli.main([*lazy.split(), str(tmp_path)]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert "steps did not converge, their readings may be wrong: press less deep" in last
    assert (tmp_path / "readings.csv").exists()


def test_press_writes_readings_skin_and_picture(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")  # the picture must not need a GL library
    out = tmp_path / "press"
    assert cli.main(["press", "--skin", "coarse", "--depth", "0.4mm", "--out", str(out), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert "no GL library works here" in said and "peak force" in said and "steps took" in said
    with open(out / "readings.csv") as file:
        rows = list(csv.DictReader(file))
    depth = np.array([float(row["depth_m"]) for row in rows])
    force = np.array([[float(row[f"force_{axis}_N"]) for axis in "xyz"] for row in rows])
    assert depth[0] == -5e-6 and depth[-1] == 4e-4 and np.linalg.norm(force[0]) < 1e-6
    # pushed along +y, the skin pushes back along -y; more with every step of the press
    pressing = force[depth < 4e-4]
    assert (np.diff(pressing[1:, 1]) < 0).all() and abs(force[-1, 1]) > 5 * np.abs(force[-1, [0, 2]]).max()
    with h5py.File(out / "skin.h5") as file:
        assert len(file["vert_xpos"]) == len(rows)
        moved = file["vert_xpos"][-1] - file["vert"][:]
        # the skin gives way by what the indenter travels, less what it overlaps in the contact's softness
        assert 0.7 * 4e-4 < moved[:, 1].max() < 1.08 * 4e-4
        assert np.abs(moved[file["fixed"][:]]).max() < 1e-8
    assert len(np.unique(imread(out / "press.png")[::4, ::4].reshape(-1, 4), axis=0)) > 100
    assert sorted(path.name for path in out.iterdir()) == ["press.png", "readings.csv", "skin.h5"]


def test_import_mesh_prints_a_table_and_stores_a_skin(shared, capsys, tmp_path):
    out = tmp_path / "real.npz"
    assert cli.main(["lab", "mesh", str(shared / "data" / "nvlabs_biotac_sim"), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    # numbers of the published mesh
    for name, value in (("nodes", 4246), ("tetrahedra", 15410), ("held nodes", 400)):
        assert any(
            line.split()[-1] == str(value) for line in said.splitlines() if line.strip().startswith(name)
        ), said
    from biotac_mj.geometry import load_skin

    assert load_skin(out).nvert == 4246


def test_what_a_verb_needs_and_is_not_there_is_named():
    """One line with the extra that brings it."""
    code = (
        "import sys; sys.modules['torch'] = None; from biotac_mj.cli import main; "
        "sys.exit(main(['learn', 'predict', 'm.safetensors', 'x.txt', '--out', 'y.csv']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2
    assert "biotac: error: this verb needs torch: pip install 'biotac-mj[learning]'" in done.stderr


def test_a_file_in_place_of_a_patchs_folder_is_refused(tmp_path, capsys):
    """Before the recording is read."""
    table = tmp_path / "q.csv"
    table.write_text("mine")
    assert cli.main(["learn", "predict", "inverse", "nosuch.csv", "--out", str(table)]) == 2
    assert f"{table} is a file: choose another folder" in capsys.readouterr().err
    assert table.read_text() == "mine"
