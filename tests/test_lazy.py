"""Packages that load their names late: editors and type checkers, which read and do not run, see all of them,
and completion offers nothing else."""

import ast
import importlib

import pytest
from imports import modules

import biotac_mj

LATE = sorted(name for name, path in modules().items() if " = lazy(" in path.read_text())


def _for_editors(name):
    """{name: the module that it is imported from} of what stands under TYPE_CHECKING."""
    (block,) = (
        node
        for node in ast.parse(modules()[name].read_text()).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "typing.TYPE_CHECKING"
    )
    out = {}
    for node in block.body:
        for alias in node.names:
            assert alias.asname == alias.name, "`as` makes an import public for a type checker"
            out[alias.name] = "." * node.level + node.module if node.module else None
    return out


@pytest.mark.parametrize("name", LATE)
def test_what_is_loaded_late_is_what_an_editor_sees(name):
    package = importlib.import_module(name)
    assert _for_editors(name) == package._HOME
    offered = {one for one in dir(package) if not one.startswith("_")}
    assert offered - {"plugin"} == set(package._HOME)
    with pytest.raises(AttributeError, match=f"module '{name}' has no attribute 'nothing'; it has "):
        _ = package.nothing


def test_all_packages_of_the_reference_are_attributes(repo):
    """What docs/api.md names is reached from `import biotac_mj` alone."""
    assert len(LATE) > 6
    named = {line.split()[2] for line in (repo / "docs/api.md").read_text().splitlines() if ".. auto" in line}
    assert len(named) > 50
    for path in named:
        first = path.removeprefix("biotac_mj.").split(".")[0]
        assert first in dir(biotac_mj), path
        if path.count(".") == 2 and path not in modules():
            assert hasattr(getattr(biotac_mj, first), path.split(".")[2]), path
