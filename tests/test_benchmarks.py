"""The benchmarks run as documented, meet the bounds on stored cases and write the promised JSON."""

import contextlib
import copy
import dataclasses
import io
import json
import os
import pathlib
import runpy
import subprocess
import sys
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import scipy.stats

import biotac_mj
from biotac_mj.geometry.skins import load_skin


def _run(repo, script, *arguments):
    """A script in a process of its own."""
    here = pathlib.Path(biotac_mj.__file__).parents[1]  # this process's package is the other's
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, [str(here), os.environ.get("PYTHONPATH")])),
    }
    return subprocess.run(
        [sys.executable, repo / "benchmarks" / script, *map(str, arguments)],
        capture_output=True,
        text=True,
        env=env,
    )


def _run_here(repo, script, *arguments):
    """A script as Python runs it, in this process: its imports are there, its kernels loaded."""
    path, code = repo / "benchmarks" / script, 0
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch.object(sys, "argv", [str(path), *map(str, arguments)]),
        mock.patch.object(sys, "path", [str(path.parent), *sys.path]),
    ):
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as end:
            code = end.code or 0
    return subprocess.CompletedProcess(sys.argv, code, out.getvalue(), err.getvalue())


@pytest.mark.slow
def test_every_benchmark_starts_and_says_what_it_does(repo):
    """What it imports is there, its options are told, and nothing is measured or written."""
    for path in sorted((repo / "benchmarks").glob("*.py")):
        if "ArgumentParser" in path.read_text():
            done = _run_here(repo, path.name, "--help")
            assert done.returncode == 0 and done.stdout.startswith("usage: "), (path.name, done.stderr)


@pytest.fixture(scope="module")
def accuracy(repo):
    sys.path.insert(0, str(repo / "benchmarks"))
    import accuracy

    yield accuracy
    sys.path.remove(str(repo / "benchmarks"))


@pytest.mark.slow  # quick: what it measures, in test_true_contact.py
def test_rows_of_contact_are_judged_by_their_bars(accuracy, monkeypatch, capsys):
    import contact_table

    row = ["--rows", "around,wrist", "--tiers", "condensed"]
    assert contact_table.main(row) == 0
    said = capsys.readouterr().out.splitlines()[2:]
    assert len(said) == 3 and all(line.endswith("| met |") for line in said)
    assert "| force at a wrist, <force> | condensed | " in said[1]
    monkeypatch.setattr(contact_table.test_true_contact, "WEIGHT", 0.97 * 0.1 * 9.81)
    assert contact_table.main(row) == 1
    assert [line.endswith("| missed |") for line in capsys.readouterr().out.splitlines()[2:]] == [
        False,
        True,
        True,
    ]
    with pytest.raises(SystemExit):
        contact_table.main(["--rows", "weight"])
    assert "unknown row weight: choose from peak, pac" in capsys.readouterr().err


@pytest.mark.slow
def test_models_are_freed(repo, tmp_path):
    """Each cycle's model is of 20 MB and more."""
    done = _run(repo, "lives.py", "--cycles", 20, "--json", tmp_path / "out.json")
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "out.json").read_text())
    assert len(found["memory_mb"]) == 21 and found["growth_mb"] < 50


@pytest.mark.slow  # quick: test_skin_shipped.py, test_skin_contact.py
def test_accuracy_of_stored_cases(repo, shared, tmp_path):
    cases = tmp_path / "cases"
    cases.mkdir()
    bounds = {  # of force and displacement
        "A_sphere3.5_pad_core": (0.06, 0.04),
        "B_sphere3.5_pad_0.5mm": (0.03, 0.02),
        "L_sphere3.5_pad": (0.03, 0.02),
    }
    names = tuple(bounds)
    for name in names:
        (cases / f"{name}.npz").symlink_to(shared / "reference" / f"{name}.npz")
    skin = shared / "data" / "nvlabs_biotac_sim"
    done = _run_here(
        repo,
        "accuracy.py",
        "--cases",
        cases,
        "--json",
        tmp_path / "out.json",
        "--skin",
        skin,
        "--picture",
        tmp_path / "out.png",
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(" pass") == len(names)
    rows = json.loads((tmp_path / "out.json").read_text())["cases"]
    assert [row["name"] for row in rows] == list(names)
    for row in rows:
        force, displacement = bounds[row["name"]]
        assert 0 < row["force_error_rel"] <= force
        assert 0 < row["displacement_error_rel"] <= displacement
        assert row["seconds"] > 0
        assert row["not_converged"] == 0
        # the error is what the file says, not what the benchmark says
        stored = np.load(shared / "reference" / f"{row['name']}.npz")["force"]
        wrong = (
            np.linalg.norm(np.array(row["force"]) - stored, axis=1).mean()
            / np.linalg.norm(stored, axis=1).max()
        )
        assert row["force_error_rel"] == pytest.approx(wrong)
    assert (tmp_path / "out.png").read_bytes()[:4] == b"\x89PNG"


def test_a_case_that_cannot_be_solved_is_told(repo, shared, tmp_path):
    case = dict(np.load(shared / "reference" / "L_sphere3.5_pad.npz"))
    case["indenter"] = json.dumps({**json.loads(str(case["indenter"])), "shape": "cone"})
    np.savez(tmp_path / "odd.npz", **case)
    done = _run_here(
        repo,
        "accuracy.py",
        "--cases",
        tmp_path,
        "--json",
        tmp_path / "out.json",
        "--skin",
        shared / "data" / "nvlabs_biotac_sim",
    )
    assert done.returncode == 1
    assert (
        "unknown indenter shape 'cone': the case must hold a sphere, cube, cylinder or annulus" in done.stdout
    )
    assert json.loads((tmp_path / "out.json").read_text())["cases"][0]["force_error_rel"] is None


def test_a_folder_without_cases_is_said(repo, tmp_path):
    done = _run_here(repo, "accuracy.py", "--cases", tmp_path, "--json", tmp_path / "out.json")
    assert done.returncode == 2
    assert "pass the folder that holds them" in done.stderr
    assert not (tmp_path / "out.json").exists()


@pytest.mark.parametrize(
    "shape",
    [
        {"shape": "sphere", "radius": 0.00175},
        {
            "shape": "cylinder on its side, axis = indenter x",
            "radius": 0.0035,
            "length": 0.028,
            "edge_radius": 0.001,
        },
        {"shape": "cylinder on its side", "radius": 0.0035, "half_length": 0.014, "edge_radius": 0.001},
        {
            "shape": "cylinder on its side",
            "radius": 0.00175,
            "edge_radius": 0.001,
            "seed_mesh": "cylinder_short_3-5mm.obj",
        },
        {"shape": "cube, flat top at y=0", "half_width": 0.007, "edge_radius": 0.001},
        {
            "shape": "annulus about indenter y",
            "inner_radius": 0.0035,
            "outer_radius": 0.007,
            "edge_radius": 0.001,
        },
    ],
    ids=lambda shape: f"{shape['shape'].split()[0]} {len(shape)} {shape.get('seed_mesh', '')}",
)
def test_case_geoms_lie_where_the_cases_say(accuracy, shape):
    """The distance of points to each indenter, against formulas for the surface written from the cases'
    description."""
    import warp as wp

    from biotac_mj.skin.contact.penetration import rest_gap

    geoms, pos, mat = accuracy.case_geoms(shape, 0.0)
    # around the front
    point = np.random.default_rng(0).uniform(-1, 1, (20000, 3)) * [8e-3, 1e-3, 8e-3] - [0, 5e-4, 0]
    if shape["shape"].startswith("cylinder"):
        point *= [2, 1, 0.5]
    local = (point - pos[0]) @ mat[0]
    face = np.arange(len(local))[:, None] * [1, 1, 1]  # each face is a point
    gap = wp.zeros(len(local), dtype=wp.float64)
    inputs = [
        wp.array(face, dtype=wp.vec3i),
        wp.array([[1 / 3] * 3], dtype=wp.vec3d),
        geoms.struct,
        wp.array(local[:, None], dtype=wp.vec3d),
    ]
    wp.launch(rest_gap, dim=(len(local), 1), inputs=inputs, outputs=[gap], device="cpu")
    gap, expected = gap.numpy(), _distance(shape, point)
    near = (expected < 0) & (expected > -2e-4)  # where it would press
    assert near.sum() > 50
    np.testing.assert_allclose(
        gap[near], expected[near], atol=1.5e-6 if "annulus" in shape["shape"] else 1e-12
    )


def _distance(shape, p):
    kind, x, y, z = shape["shape"], *p.T
    edge = shape.get("edge_radius", 0)

    def rounded(*q):  # a box in any number of dimensions, shrunk by the edge's radius and grown again
        q = np.stack(q) + edge
        return np.linalg.norm(np.maximum(q, 0), axis=0) + np.minimum(q.max(0), 0) - edge

    if kind == "sphere":
        r = shape["radius"]
        return np.sqrt(x**2 + (y + r) ** 2 + z**2) - r
    if kind.startswith("cylinder"):
        r = shape["radius"]
        half = shape.get("half_length", shape.get("length", 0.007) / 2)
        return rounded(np.hypot(y + r, z) - r, np.abs(x) - half)
    if kind.startswith("cube"):
        h = shape["half_width"]
        return rounded(np.abs(x) - h, np.abs(y + h) - h, np.abs(z) - h)
    mean, half = (
        (shape["outer_radius"] + shape["inner_radius"]) / 2,
        (shape["outer_radius"] - shape["inner_radius"]) / 2,
    )
    return rounded(np.abs(np.hypot(x, z) - mean) - half, y)


def test_a_cylinder_without_length_is_refused(accuracy):
    with pytest.raises(ValueError, match="cylinder of unknown length.*give radius and length"):
        accuracy.case_geoms({"shape": "cylinder", "radius": 0.002}, 0.0)


@pytest.mark.slow
def test_speed_writes_rows(repo, tmp_path):
    done = _run_here(
        repo,
        "speed.py",
        "--device",
        "cpu",
        "--json",
        tmp_path / "speed.json",
        "--increments",
        5,
        "--skins",
        "coarse",
        "--elements",
        "quadratic",
    )
    assert done.returncode == 0, done.stderr
    everything = json.loads((tmp_path / "speed.json").read_text())["rows"]
    rows, condensed = ([row for row in everything if row["tier"] == tier] for tier in ("full", "condensed"))
    assert [row["liquid"] for row in rows] == [row["liquid"] for row in condensed] == [False, True]
    for row, ours in zip(condensed, rows):
        assert row["not_converged"] == 0 and row["ms_per_press"] == pytest.approx(5 * row["ms_per_step"])
        wrong = np.linalg.norm(np.array(row["force"]) - ours["force"], axis=1)
        assert (
            0 < row["force_error_rel"] == pytest.approx(wrong.mean() / ours["peak_force_N"])
            and row["force_error_to_1mm"] < 0.15
        )
    for row in rows:
        assert (row["device"], row["solver"], row["skin"], row["tier"], row["worlds"]) == (
            "cpu",
            "biotac_mj",
            "coarse",
            "full",
            1,
        )
        assert row["ms_per_press"] == pytest.approx(5 * row["ms_per_step"])
        assert row["not_converged"] == row["not_converged_tight"] == 0
        assert 0 < row["force_error_rel"] < 0.01
        assert np.all(np.diff(np.linalg.norm(row["force"], axis=1)) > 0)  # a deeper press is a harder press
    assert rows[1]["peak_force_N"] > rows[0]["peak_force_N"]  # the liquid carries load


@pytest.mark.slow
def test_speed_against_another_checkout(repo, accuracy, capsys):
    import speed

    (row,) = speed.compare(repo, [("coarse", "linear", True, "cpu", 1, 1)], turns=1)
    assert row["clock"] == "processor" and row["here_s"] > 0
    assert row["ratio"] == pytest.approx(row["here_s"] / row["against_s"]) and 0.1 < row["ratio"] < 10
    assert "ratio" in capsys.readouterr().out
    with pytest.raises(FileNotFoundError, match="has no biotac_mj/__init__.py: give the root of a checkout"):
        speed.compare(repo / "docs", [])


def test_bars_are_judged_by_what_is_better(accuracy):
    import gpu_bars

    each = {
        "batch_1024": [19.0, 17.0],
        "hand_256_pressed": [3e4, 2e4],
        "ansys_64": [9.5],
        "setup_batch": [1.0],
    }
    figures = {name: {"here": {"each": times}} for name, times in each.items()}
    figures["batch_1024"]["against"] = {"each": [34.0]}
    found = {
        "device": "made up",
        "cold": False,
        "tiny": False,
        "figures": figures,
        "failed": {"here hand": "x"},
    }
    lines = gpu_bars.table(found).splitlines()
    row = {
        line.split("|")[1].strip(): [c.strip() for c in line.split("|")[2:-1]]
        for line in lines
        if "|" in line
    }
    what = {name: row[gpu_bars.BARS[name][0]] for name in gpu_bars.BARS}
    assert what["batch_1024"] == ["ms a step", "**17** (19, 19)", "34", "0.500", "18", "12", "met"]
    assert what["hand_256_pressed"][-1] == "met" and what["ansys_64"][-1] == "missed"
    assert what["setup_batch"][-1] == "" and what["press_1_dry"][1] == "not measured"
    assert lines[-1] == "here hand: x"


@pytest.mark.slow  # quick: the measurements themselves, in this process
def test_bars_of_a_gpu_are_measured_by_processes(repo, tmp_path):
    done = _run_here(
        repo, "gpu_bars.py", "--json", tmp_path / "bars.json", "--device", "cpu", "--tiny", "--cases", "ansys"
    )
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "bars.json").read_text())
    assert found["figures"]["ansys_1"]["here"]["not_converged"] == 0 and not found["failed"]
    assert "preset ansys (nu 0.499), one world" in done.stdout


def test_standard_path_starts_at_first_touch(repo, accuracy):
    """No point of the skin, sampled in faces by another library, is inside the sphere at the start, and one
    is as soon as it moves."""
    import speed
    import trimesh

    from biotac_mj.geometry import load_skin

    geometry = load_skin("coarse")
    path, direction = speed.standard_path(geometry, 3)
    surface = trimesh.Trimesh(geometry.vert, geometry.outer_face, process=False)
    for k, center in enumerate(path[:2]):
        _, distance, _ = trimesh.proximity.closest_point(surface, center[None])
        assert distance[0] - speed.RADIUS == pytest.approx(-k * speed.INCREMENT, abs=2e-6 if k else 1e-8)
    np.testing.assert_allclose(
        np.diff(path, axis=0), speed.INCREMENT * np.tile(direction, (3, 1)), atol=1e-12
    )
    assert abs(path[0] @ [0, 0, 1]) < 1e-3
    assert direction[1] > 0.9  # from the pad towards the nail


@pytest.mark.slow  # a script of benchmarks/
@pytest.mark.filterwarnings("ignore")  # of pyplot
def test_peers_are_compared_at_equal_work(repo, tmp_path):
    """Three steps, ours and MuJoCo's flex on the CPU: rows, where it goes on, table and picture."""
    out, picture = tmp_path / "peers.json", tmp_path / "peers.png"
    common = ("--device", "cpu", "--skin", "coarse", "--steps", 3, "--json", out)
    done = _run_here(repo, "peers.py", *common, "--solvers", "ours", "--knobs", "1e-3,0.1,0")
    assert done.returncode == 0, done.stderr
    done = _run_here(repo, "peers.py", *common, "--solvers", "flex", "--worlds", 2, "--knobs", "100,10")
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    good, rough, failed, *flex = found["rows"]
    assert [row["solver"] for row in found["rows"]] == ["biotac_mj"] * 3 + ["MuJoCo flex"] * 2
    assert 1e-7 < good["error"] < 0.01 < rough["error"] and good["steps"] == 3
    assert failed["error"] is None and failed["note"].startswith("ValueError: ")
    assert 0 < flex[0]["error"] < 0.01 < 0.1 < flex[1]["error"]  # of more iterations the smaller
    assert all(row["ms_per_step"] > 0 for row in (good, rough, *flex)) and flex[0]["worlds"] == 2
    for name, row in (("biotac_mj", good), ("MuJoCo flex", flex[0])):  # they press alike
        assert np.linalg.norm(found["converged"][name][-1]) == pytest.approx(row["force_N"], rel=0.02)
        assert row["force_N"] == pytest.approx(good["force_N"], rel=0.2)
    before = out.read_text()
    done = _run_here(
        repo, "peers.py", *common, "--solvers", "ours", "--knobs", "0.1", "--table", "--figure", picture
    )
    assert done.returncode == 0, done.stderr
    assert out.read_text() == before  # nothing is measured twice
    assert "| 2 | MuJoCo flex | cpu | 100 iterations |" in done.stdout
    rows, at_equal_errors = done.stdout.split("\n\n")
    assert rows.count("\n| ") == 5 and "| 10 % | 1 % | 0.1 % |" in at_equal_errors
    ours = at_equal_errors[at_equal_errors.index("| 1 | biotac_mj") :].split("\n")[0].split("|")[4:7]
    quick, slow = sorted(row["ms_per_step"] for row in (good, rough))
    for cell in ours:  # between the two rows, or said to be outside
        assert cell.split()[0] in ("above", "below") or 0.9 * quick < float(cell) < 1.1 * slow
    assert picture.read_bytes()[:4] == b"\x89PNG"
    done = _run_here(repo, "peers.py", "--json", out, "--solvers", "springs")
    assert done.returncode == 2 and "unknown solver springs: choose from ours, vbd" in done.stderr
    done = _run_here(repo, "peers.py", "--json", out)
    assert done.returncode == 2 and "name another file" in done.stderr


def test_unknown_skin_is_refused(repo, tmp_path):
    done = _run_here(repo, "speed.py", "--json", tmp_path / "speed.json", "--skins", "huge")
    assert done.returncode == 2
    assert "unknown skin huge: choose from coarse, default, fine" in done.stderr


@pytest.mark.slow
def test_startup_beside_another_checkout(repo, tmp_path):
    out = tmp_path / "out.json"
    case = ["--tiers", "condensed", "--skins", "coarse", "--fills", "0", "--runs", "1", "--threads", "1"]
    done = _run(repo, "startup.py", "--json", out, *case, "--against", repo)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(out.read_text())["rows"]
    for name in ("here", "against"):
        stages = row[name]
        assert all(0 < stages[stage]["cpu_s"] < 60 for stage in ("import", "attach", "step"))
        assert stages["all"]["cpu_s"] == pytest.approx(sum(v["cpu_s"] for v in stages.values()) / 2)
    ratio = row["here"]["all"]["cpu_s"] / row["against"]["all"]["cpu_s"]
    assert f"({ratio:.2f})" in done.stdout
    done = _run(repo, "startup.py", "--json", out, *case, "--against", tmp_path)
    assert done.returncode and "give the root of a checkout" in done.stderr


@pytest.mark.slow
def test_random_presses_go_on_where_they_were_stopped(repo, tmp_path, monkeypatch, capsys):
    """Presses of worlds that differ are made, counted and kept; the totals are those of the rows."""
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    import robustness

    monkeypatch.setattr(robustness, "MOST", 2)
    arguments = ["--json", str(tmp_path / "out.json"), "--tier", "full", "--worlds", "2", "--seed", "3"]
    first = robustness.main([*arguments, "--presses", "2"])
    assert first["presses"] == 2 and first["nan"] == first["exceptions"] == first["stuck"] == 0
    rows = [json.loads(line)["rows"] for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert len(rows) == 1 and all(row["most_N"] > 0 and row["steps"] > 5 for row in rows[0])
    assert rows[0][0]["geom"] != rows[0][1]["geom"]
    asked, made = [], rows[0][0] | {"steps": 7, "stuck": True, "not_converged": 5}
    monkeypatch.setattr(robustness, "press_batch", lambda *a: asked.append(a[-1]) or [made, made])
    both = robustness.main([*arguments, "--presses", "4"])
    assert asked == [1]
    assert both["steps"] == first["steps"] + 14 and both["stuck"] == 2 and both["presses"] == 4
    assert json.loads((tmp_path / "out.json").read_text()) == both
    assert robustness.main([*arguments, "--presses", "40", "--minutes", "0"]) == both and asked == [1]
    assert 0 < both["most_work"] and 1 <= both["work_ratio"] <= both["most_work"]


@pytest.mark.slow
@pytest.mark.parametrize("seed, number", [(2001, 3218), (2001, 3524), (8103, 49)])
def test_a_skin_that_snaps_off_a_geom_finds_its_balance(repo, monkeypatch, seed, number):
    """Newton's method alone goes round in circles in these random presses: an ellipsoid slips off the skin,
    a cylinder turns in it, and skin lies in a rim as far from the side as from the end."""
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    import robustness

    (row,) = robustness.press_batch("coarse", seed, "condensed", "cpu", 1, number)
    assert row["most_N"] > 0.4 and row["steps"] > 20
    assert not row["failures"] and not row["infeasible"] and not row["nan"] and row["exception"] is None


@pytest.mark.slow
@pytest.mark.parametrize("seed, number", [(31, 142), (8105, 70)])
def test_a_skin_stays_where_an_edge_makes_the_force_jump(repo, monkeypatch, seed, number):
    """A corner of a mesh in stiff rubber: no place has a balance to 1e-4, and the step went in circles. A
    mesh of few wide facets."""
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    import robustness

    (row,) = robustness.press_batch("coarse", seed, "condensed", "cpu", 1, number)
    assert row["geom"] == "mesh" and row["most_N"] > 0.4 and row["steps"] > 20
    assert not row["failures"] and not row["nan"] and row["exception"] is None


@pytest.mark.slow  # quick: friction of test_skin_friction_law.py
def test_much_friction_on_a_small_geom_finds_its_balance(repo, monkeypatch):
    """An ellipsoid that slides at friction 1.2: with a tangent that holds the push of what slips, Newton's
    method has no way there in three of these steps."""
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    import robustness

    (row,) = robustness.press_batch("coarse", 9001, "full", "cpu", 1, 24)
    assert row["most_N"] > 0.1 and row["steps"] > 20 and not row["failures"] and row["exception"] is None


SLIDES = pytest.mark.xfail(strict=True, reason="one of its twelve steps takes 5082 units of work")


@pytest.mark.slow  # quick: when skin creeps, and how deep in the core it may be
@pytest.mark.parametrize(
    "seed, number, work",
    [pytest.param(9001, 21, 1, marks=SLIDES), (9001, 21, 4), (9002, 72, 1), (5150, 10, 1), (9001, 34, 1)],
)
def test_hard_presses_find_their_balance(repo, monkeypatch, seed, number, work):
    """A box that slides on all but incompressible rubber: one step takes twice the work that it may, and
    another is lost where that one ended; with four times the work all settle. A mesh that is
    pressed with 1.8 kN, under which the core is met 0.3 mm deep; soft skin that slips off a thin ellipsoid,
    where for 26 iterations the error does not fall; an ellipsoid that slides with friction 0.94, where the
    tangent is not symmetric."""
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    import robustness

    def with_work(*args, made=robustness.skin_model):
        model = copy.copy(made(*args))
        model.options = dataclasses.replace(model.options, max_work=work * model.options.max_work)
        return model

    monkeypatch.setattr(robustness, "skin_model", with_work)
    (row,) = robustness.press_batch("coarse", seed, "full", "cpu", 1, number)
    assert row["most_N"] > 1 and row["steps"] > 10 and not row["failures"] and row["exception"] is None


@pytest.mark.parametrize("loaded", [False, True])
def test_numbers_of_a_sensor_are_found_in_its_recording(repo, tmp_path, loaded):
    """Synthetic: three minutes of a sensor that warms up, with and without force on it."""
    from biotac_mj.sensor.channels import counts_from_log_impedance, log_impedance
    from biotac_mj.sensor.presets import PER_DEGREE, SENSORS

    rng, n, rate = np.random.default_rng(0), 21000, 118.0
    rest, time = np.array(SENSORS["epfl_f2"].rest), np.arange(21000) / 118.0
    force = np.stack([0.2 * np.sin(time), 0.1 * np.cos(time), -3 + 2.9 * np.cos(2 * time)], 1)
    log_z = log_impedance(rest) - PER_DEGREE * 4.0 * (1 - np.exp(-time / 90.0))[:, None]
    if loaded:
        slope = 0.05 * np.sin(np.arange(19))
        log_z = log_z - slope * force[:, 2:] + 0.3 * slope * force[:, :1]
        np.savetxt(tmp_path / "force.txt", force)
    noise = np.linspace(1, 6, 19)
    counts = np.rint(counts_from_log_impedance(log_z) + noise * rng.normal(size=(n, 19)))
    np.savetxt(tmp_path / "electrodes.txt", counts, "%d")
    more = ["--force", tmp_path / "force.txt"] if loaded else []
    out = tmp_path / "out.json"
    done = _run_here(
        repo, "sensor_presets.py", tmp_path / "electrodes.txt", "--rate", rate, "--json", out, *more
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())["electrodes.txt"]
    np.testing.assert_allclose(found["rest"], rest, atol=20 if loaded else 4)
    np.testing.assert_allclose(found["noise"], noise, rtol=0.1, atol=0.1)
    assert found["warm_up"] == pytest.approx(4.0, rel=0.1) and found["loaded"] is loaded
    assert found["warm_time"] == pytest.approx(90.0, rel=0.1)


def test_speed_in_the_hand_counts_what_was_lost(repo, accuracy):
    """Of two runs the least time and the most that went wrong; held is what decisions 8 to 17 took."""
    import in_hand_speed

    def row(decision, ms, lost=0, unsettled=0.0):
        rates = {"ms_per_step": ms, "hand_steps_per_s": 64e3 / ms, "unsettled": unsettled, "lost": lost}
        return {"checkout": "here", "worlds": 64, "decision": decision, **rates, "held": 1.0, "force_n": 0.5}

    runs = [row(-1, 1.0), *(row(k, 8.0 if k else 2.0, lost=k == 9) for k in range(18))]
    again = [row(k, 9.0 if k % 2 else 4.0, unsettled=1.0) for k in range(-1, 18)]
    rows = in_hand_speed.best(runs + again)
    assert [r["ms_per_step"] for r in rows] == [1.0, 2.0, *[8.0, 4.0] * 8, 8.0]
    (one,) = in_hand_speed.summary(rows)
    assert (one["nothing_near"], one["near"]) == (64e3, 32e3) and one["lost"] == 1 and one["unsettled"] == 1.0
    assert one["held"] == pytest.approx(64e3 / 6.0)  # as many decisions took 4 ms as 8
    setup = {"checkout": "here", "worlds": 64, "import_s": 1.0, "seconds": 9.0}
    setup |= {"modules_compiled": 3, "modules_before": 40, "kept_before": 2}
    found = {"device": "made up", "seed": 1, "settings": {"here": {}}, "setup_s": [setup], "rows": rows}
    found["failed"] = [{"checkout": "here", "worlds": 8, "why": "x"}]
    lines = in_hand_speed.table(found).splitlines()
    assert "| here | 64 | 1.0 | 9.0 | 3 (40) | 2 |" in lines and "here, 8 worlds: x" in lines
    assert "| here | 64 | 64000 | 32000 | 10667 | 1 | 1 |" in lines


def test_touch_is_weighed_against_none(repo, accuracy):
    """One seed by its episodes, several by their rates."""
    import touch_pays

    def card(observe, hits, seed=0):
        of = {"task": "insert_peg", "observe": observe, "seed": seed, "minutes": 4.0, "decisions": 9}
        return of | {"success": hits / 50, "low": 0.1, "high": 0.9, "episodes": 50}

    moved = {**card("electrodes", 30), "low": 0.46, "high": 0.72}
    found = {"device": "made up", "policies": [card("electrodes", 40), card("none", 10)], "transfer": [moved]}
    lines = touch_pays.table(found).splitlines()
    assert "| insert_peg | electrodes | 0 | 4.0 | 9 | 0.80 (0.10 to 0.90) | 0.60 (0.46 to 0.72) |" in lines
    p = scipy.stats.fisher_exact([[40, 10], [10, 40]], "greater").pvalue
    low, high = scipy.stats.binomtest(40, 50).proportion_ci(method="wilson")
    there = "0.60 (0.46 to 0.72)"
    pooled = f"0.80 ({low:.2f} to {high:.2f}) | 0.80, 0.80 | {p:.2g} | {there} |"
    assert f"| insert_peg | electrodes | {pooled}" in lines
    assert any(
        line.startswith("| insert_peg | none | 0.20") and "|  | not played |" in line for line in lines
    )
    hits = {"force": [30, 35, 40, 45], "none": [0, 7, 9, 16]}
    several = [card(name, hits[name][k], k) for name in hits for k in (3, 1, 0, 2)]  # paired by their seeds
    lines = touch_pays.table({"device": "made up", "policies": several}).splitlines()
    gain = np.subtract(hits["force"], hits["none"]) / 50
    p = scipy.stats.t.sf(gain.mean() / (gain.std(ddof=1) / 2), 3)
    (line,) = [line for line in lines if line.startswith("| insert_peg | force | 0.75 (")]
    assert f"| 0.60, 0.90 | {p:.2g} |" in line


def test_files_of_touch_are_read_and_drawn_as_one(tmp_path, accuracy, capsys):
    import touch_pays
    from PIL import Image

    def card(observe, success):
        of = {"task": "insert_peg", "observe": observe, "seed": 0, "minutes": 4.0, "decisions": 9}
        return of | {"success": success, "low": 0.1, "high": 0.9, "episodes": 50}

    files = [tmp_path / f"{name}.json" for name in "ab"]
    for file, some in zip(files, ([card("none", 0.2)], [card("none", 0.4), card("force", 0.6)]), strict=True):
        file.write_text(json.dumps({"device": "made up", "policies": some}))
    picture = tmp_path / "picture.png"
    assert touch_pays.main(["--table", *map(str, files), "--draw", str(picture)]) == 0
    told = capsys.readouterr().out
    assert "| insert_peg | none | 0 | 4.0 | 9 | 0.40" in told and "| force | 0 | 4.0 | 9 | 0.60" in told
    assert "0.20 (0.10" not in told  # the later file counts
    with Image.open(picture) as image:
        assert min(image.size) > 200


@pytest.mark.parametrize("to, changed", [("tier", 1), ("skin", 2), ("sensor", 4)])
def test_policies_play_where_one_thing_more_differs(to, changed, tmp_path, accuracy, monkeypatch):
    """The rest stays as the card has it."""
    import touch_pays

    from biotac_mj.tasks.batched import playing, policy

    card = {"task": "follow_edge", "observe": "electrodes", "seed": 0}
    card["biotac"] = {"tier": "condensed", "skin": "coarse", "sensor": "epfl_f1", "randomise": ["gain"]}
    policy.save_policy(tmp_path / "follow_edge-electrodes-0.safetensors", policy.Policy(33, 4), card)
    made = {}
    monkeypatch.setattr(
        playing, "make", lambda task, n, **k: made.update(k, n=n) or SimpleNamespace(device="cpu")
    )
    monkeypatch.setattr(playing, "play", lambda env, acts: [{"success": 0.5} for _ in acts])
    (score,) = touch_pays.transfer([*tmp_path.glob("*.safetensors")], 3, to)
    assert score == {"task": "follow_edge", "observe": "electrodes", "seed": 0, "success": 0.5}
    assert made["n"] == 3 and sum(made[name] != value for name, value in card["biotac"].items()) == changed


HAND = pathlib.Path(os.environ.get("MENAGERIE_ROOT", "mujoco_menagerie")) / "shadow_hand" / "right_hand.xml"


@pytest.mark.slow
@pytest.mark.skipif(not HAND.is_file(), reason="set MENAGERIE_ROOT to a folder with shadow_hand")
def test_worlds_of_the_hand_are_timed_by_decision(repo, tmp_path):
    pytest.importorskip("torch", reason="needs torch: pip install biotac_mj[learning]")
    file = tmp_path / "out.json"
    done = _run_here(
        repo, "in_hand_speed.py", "--json", file, "--worlds", 2, "--device", "cpu", "--decisions", 1
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(file.read_text())
    assert found["setup_s"][0]["seconds"] > 0 and found["setup_s"][0]["modules_before"] >= 0
    away, row = found["rows"]
    assert [away[name] for name in ("decision", "lost", "held", "force_n")] == [-1, 0, 1.0, 0.0]
    assert (row["worlds"], row["decision"], row["lost"], row["held"]) == (2, 0, 0, 1.0)
    assert row["hand_steps_per_s"] == pytest.approx(2e3 / row["ms_per_step"]) and row["unsettled"] == 0


@pytest.mark.slow
@pytest.mark.skipif(not HAND.is_file(), reason="set MENAGERIE_ROOT to a folder with shadow_hand")
def test_a_rod_of_the_batch_goes_as_in_mj_step(repo, tmp_path):
    pytest.importorskip("torch", reason="needs torch: pip install biotac_mj[learning]")
    file = tmp_path / "out.json"
    done = _run_here(repo, "lost_rods.py", "--json", file, "--worlds", 2, "--device", "cpu", "--decisions", 6)
    assert done.returncode == 0, done.stdout + done.stderr
    (row,) = json.loads(file.read_text())["rows"]
    assert row["lost"] is None and row["mj_step"] is None
    assert min(row["force_n"]) > 0.1 and row["apart_mm"] < 0.01


@pytest.mark.slow
def test_steps_of_one_core_are_timed_beside_another_checkout(repo, tmp_path):
    """A ball of 100 g at rest weighs 0.981 N in both."""
    file = tmp_path / "out.json"
    done = _run_here(repo, "one_core.py", "--json", file, "--cases", "ball", "--against", repo)
    assert done.returncode == 0, done.stderr
    turns = json.loads(file.read_text())["cases"]["ball"]
    for (turn,) in (turns["here"], turns["against"]):
        row = turn["at rest"]
        assert row["force_n"] == [pytest.approx(0.981, rel=0.01)] and row["unsettled"] == 0
        assert 0 < row["ms_median"] <= row["ms_most"]
    assert "| ball | at rest | 20" in done.stdout and "ratio of medians" in done.stdout
    with pytest.raises(FileNotFoundError, match="has no biotac_mj/__init__.py: give the root of a checkout"):
        _run_here(repo, "one_core.py", "--json", file, "--cases", "ball", "--against", tmp_path)


def test_fields_of_two_tiers_are_compared_node_by_node(repo, monkeypatch):
    """A press whose inner surface and electrodes move a tenth further is off by a tenth, and by no more."""
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    import condensed

    geometry = load_skin("coarse")
    moved = 2e-4 * np.sin(300 * geometry.vert[:, :1]) * geometry.vert / 7e-3

    def record(factor):
        return SimpleNamespace(
            geometry=geometry,
            depth=np.array([0.0, 1e-3]),
            vert_xpos=np.stack([geometry.vert, geometry.vert + factor * moved]),
            electrode_change=factor * np.array([np.zeros(19), np.arange(19.0)]),
            force=np.array([np.zeros(3), [0.0, 0.0, factor]]),
        )

    (row,) = condensed.compare_fields(record(1.0), record(1.1), [[100.0], [120.0]], [1.0])
    assert row["pressure"] == pytest.approx(1.2) and row["force"] == pytest.approx(1.1)
    for name in ("bulge", "pressed", "electrodes"):
        assert row[name] == pytest.approx(1.1) and row[f"{name}_left"] < 1e-6
