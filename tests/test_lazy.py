"""Packages that load their names late: editors and type checkers, which read and do not run, see all of them,
and completion offers nothing else."""

import ast
import importlib

import pytest
from imports import modules

import biotac_mj

LATE = sorted(name for name, path in modules().items() if " = lazy(" in path.read_text())


@pytest.mark.parametrize("name", LATE)
def test_what_an_editor_sees_is_loaded_late(name):
    """`as` its own name makes an import public for a type checker."""
    package, seen = importlib.import_module(name), set()
    for node in ast.walk(ast.parse(modules()[name].read_text())):
        for alias in getattr(node, "names", ()):
            if isinstance(node, ast.ImportFrom) and alias.asname == alias.name:
                seen.add(alias.name)
    offered = {one for one in dir(package) if not one.startswith("_")}
    assert seen and offered - {"plugin"} == seen and seen >= set(package.__all__) - {"plugin", "__version__"}
    assert all(hasattr(package, one) for one in seen)
    with pytest.raises(AttributeError, match=f"module '{name}' has no attribute 'nothing'; it has "):
        _ = package.nothing


def test_the_reference_names_what_packages_export(repo):
    """All of docs/api.md is reached from `import biotac_mj` alone, and stands in an `__all__`."""
    assert len(LATE) > 6
    text = (repo / "docs/api.md").read_text()
    named = {line.split("`")[1] for line in text.splitlines() if line.startswith("### `")}
    assert len(named) > 50
    for path in named - {"biotac_mj.resimulation.resimulate.resimulate"}:  # its module has its name
        first = path.removeprefix("biotac_mj.").split(".")[0]
        assert first in dir(biotac_mj), path
        if path in modules():
            continue
        package = importlib.import_module(path.rpartition(".")[0])
        name = path.rpartition(".")[2]
        assert name in package.__all__ and hasattr(package, name), path
