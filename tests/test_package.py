"""The package: light import, names, what the wheel carries."""

import importlib.resources
import importlib.util
import os
import re
import subprocess
import sys

import pytest

import biotac_mj


def run(code, **environ):
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, **environ},
        timeout=120,
    )


@pytest.mark.skipif(
    "BIOTAC_TEST_INSTALLED" not in os.environ, reason="make test-wheel and test-newest ask for it"
)
def test_what_is_tested_is_what_pip_installed(repo):
    """Here, and in a process that is started in this folder."""
    started = subprocess.run(
        [sys.executable, "-c", "import biotac_mj; print(biotac_mj.__file__)"],
        capture_output=True,
        text=True,
        cwd=repo,
    )
    for path in (biotac_mj.__file__, started.stdout.strip()):
        assert path and "site-packages" in path and not path.startswith(str(repo / "biotac_mj"))


def test_import_is_light():
    heavy = ("torch", "warp", "trimesh", "matplotlib", "scipy", "h5py", "mujoco_warp")
    code = f"import biotac_mj, sys; print(*[m for m in {heavy} if m in sys.modules])"
    result = run(code)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == ""


def test_import_registers_the_plugin():
    xml = "<mujoco><extension><plugin plugin='biotac_mj.skin'/></extension></mujoco>"
    code = f"mujoco.MjModel.from_xml_string({xml!r}); print('known')"
    assert "plugin biotac_mj.skin not found" in run("import mujoco; " + code).stderr
    assert run("import mujoco, biotac_mj; " + code).stdout.strip() == "known"


@pytest.mark.skipif(
    not sys.platform.startswith("linux"),
    reason="MUJOCO_GL=nonsense is Linux's way to ask for a library that is not there",
)
def test_a_gl_library_that_fails_does_not_stop_the_import():
    result = run(
        "import os, biotac_mj, mujoco; "
        "print(mujoco.MjModel.from_xml_string('<mujoco/>').nq, os.environ['MUJOCO_GL'])",
        MUJOCO_GL="nonsense",
    )
    assert result.stdout.split() == ["0", "disable"], result.stderr
    assert "MUJOCO_GL=nonsense does not work here" in result.stderr


@pytest.mark.slow
def test_warp_starts_in_silence_unless_asked():
    code = "from biotac_mj.arguments import check_device; check_device('cpu'); import biotac_mj.skin"
    quiet, loud = (run(code, BIOTAC_VERBOSE=asked) for asked in ("", "1"))
    assert quiet.returncode == 0 and quiet.stdout + quiet.stderr == ""
    assert "Warp" in loud.stdout + loud.stderr
    noted = (
        "import os; from biotac_mj.quiet import _without\nwith _without(b'a'): os.write(2, b'abc\\nxyz\\n')"
    )
    assert run(noted).stderr == "xyz\n"


@pytest.mark.parametrize("name", [n for n in biotac_mj.__all__ if n != "__version__"])
def test_public_names_are_there(name):
    assert getattr(biotac_mj, name) is not None and name in dir(biotac_mj)


@pytest.mark.parametrize("name", ["batch", "calibration", "data", "learning", "press", "tasks"])
def test_packages_are_attributes(name):
    assert getattr(biotac_mj, name).__name__ == f"biotac_mj.{name}" and name in dir(biotac_mj)


def test_unknown_name_says_what_there_is():
    with pytest.raises(AttributeError, match="no attribute 'atach'; it has .*attach"):
        _ = biotac_mj.atach


def test_data_is_found_as_resources():
    assert (importlib.resources.files("biotac_mj.mjcf") / "biotac.xml").is_file()
    for skin in ("coarse", "default", "fine"):
        assert (importlib.resources.files("biotac_mj.assets") / "skins" / f"{skin}.npz").is_file()


def test_versions_agree(repo):
    cff = (repo / "CITATION.cff").read_text()
    assert re.search(rf"^version: {re.escape(biotac_mj.__version__)}$", cff, re.MULTILINE)


def test_the_changelog_has_this_versions_notes(repo):
    """What the tag says: the section's own words in short, of this version or of what comes after it."""
    sections = (repo / "CHANGELOG.md").read_text().split("\n## ")[1:]
    top = sections[sections[0].startswith("[Unreleased]")]
    assert top.startswith(f"[{biotac_mj.__version__}] - ")
    notes = top.split("### In short\n")[1].split("\n### ")[0]
    assert 5 < len(notes.splitlines()) < 25


@pytest.mark.slow
def test_wheel_carries_plugin_model_and_meshes(repo, tmp_path):
    """Builds a wheel, unpacks it elsewhere and imports it from there, away from the checkout."""
    import shutil
    import zipfile

    # from a copy, so that neither an old build folder adds to the wheel nor this test leaves one
    source = tmp_path / "source"
    shutil.copytree(repo / "biotac_mj", source / "biotac_mj")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(repo / name, source)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    subprocess.run(
        [*pip, "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path, source],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    if importlib.util.find_spec("twine"):
        subprocess.run([sys.executable, "-m", "twine", "check", "--strict", wheel], check=True)
    with zipfile.ZipFile(wheel) as file:
        names = set(file.namelist())
        file.extractall(tmp_path / "site")
    assert {
        "biotac_mj/py.typed",
        "biotac_mj/plugin/__init__.py",
        "biotac_mj/mjcf/biotac.xml",
        "biotac_mj/assets/skins/default.npz",
    } <= names
    assert {str(path.relative_to(repo)) for path in (repo / "biotac_mj").rglob("*.py")} <= names
    assert {name.split("/")[0].split("-")[0] for name in names} == {"biotac_mj"}
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r}); import biotac_mj; "
        "print(biotac_mj.plugin.__file__, biotac_mj.load_skin('coarse').nvert)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(str(tmp_path / "site"))
