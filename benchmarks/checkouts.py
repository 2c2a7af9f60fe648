"""Benchmarks that compare this checkout with another: what a process needs to import that one."""

import contextlib
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator

__all__ = ["beside", "first_on_path", "importable", "run_with"]

APART = ("plugin", "mjcf", "assets")  # packages that lay beside biotac_mj in older checkouts


@contextlib.contextmanager
def importable(root: pathlib.Path) -> Iterator[pathlib.Path]:
    """A folder for PYTHONPATH: the root itself, or of an older checkout one of symbolic links.

    Raises:
      FileNotFoundError: there is no biotac_mj.
    """
    package = root.resolve() / "biotac_mj"
    if not (package / "__init__.py").is_file():
        raise FileNotFoundError(f"{root} has no biotac_mj/__init__.py: give the root of a checkout")
    if all((package / name).exists() for name in APART):
        yield package.parent
        return
    with tempfile.TemporaryDirectory() as folder:
        links = pathlib.Path(folder) / "biotac_mj"
        links.mkdir()
        for path in (*package.iterdir(), *(package.parent / name for name in APART)):
            if path.exists() and not (links / path.name).exists():
                (links / path.name).symlink_to(path)
        yield pathlib.Path(folder)


@contextlib.contextmanager
def beside(other: pathlib.Path | None) -> Iterator[dict[str, pathlib.Path]]:
    """{"here": a folder for PYTHONPATH with this checkout, "against": one with another, where one is given}.

    Raises:
      FileNotFoundError: there is no biotac_mj.
    """
    roots = {"here": pathlib.Path(__file__).resolve().parents[1]} | ({"against": other} if other else {})
    with contextlib.ExitStack() as stack:
        yield {name: stack.enter_context(importable(root)) for name, root in roots.items()}


def first_on_path(folder: pathlib.Path) -> str:
    """PYTHONPATH with the folder before what is there already, where other packages may lie."""
    return os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])


def run_with(folder: pathlib.Path, arguments: list, threads: int | None = None) -> str:
    """What a new Python process prints that imports from the folder.

    Args:
      arguments: of Python. threads: of BLAS and OpenMP; None: the libraries choose.

    Raises:
      RuntimeError: the process failed.
    """
    limits = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    env = {name: value for name, value in os.environ.items() if name not in limits}
    env |= {"PYTHONPATH": first_on_path(folder)} | (dict.fromkeys(limits, str(threads)) if threads else {})
    done = subprocess.run([sys.executable, *map(str, arguments)], env=env, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{arguments[1:]} with {folder} failed:\n{done.stderr}")
    return done.stdout
