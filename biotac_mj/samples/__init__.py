"""Synthetic samples of the verbs' input files, for users without a real sensor: `biotac data samples`."""

import importlib.resources
import pathlib
import zipfile

from ..files import replacing
from .contents import EFFECT, OBJECT, TOUCHES

__all__ = ["EFFECT", "OBJECT", "SHIPPED_SEED", "TOUCHES", "make_samples"]

SHIPPED_SEED = 0  # of the samples in the package (scripts/make_samples.py), which need no simulation
_SET = "set"


def make_samples(
    folder: pathlib.Path | str, seed: int = SHIPPED_SEED, progress: bool = True
) -> list[pathlib.Path]:
    """Writes a synthetic recording of touches by a sphere in typical file formats, and a data set of it.

    electrodes.txt and forces.txt are rows of counts and of newtons at 100 Hz, with and without contact;
    log.csv has all channels and the sphere's pose, every fifth row; set/ has all touches with the simulated
    skin, for `biotac learn train`.

    Args:
      folder: created if missing; existing files of these names must be equal.
      seed: of the touches and the noise. SHIPPED_SEED is in the package, others are simulated.
      progress: whether to show a bar for the set.

    Returns:
      the paths written.

    Raises:
      ValueError: set/ holds another set, or the folder has another file of one of these names; nothing is
        written.
    """
    folder = pathlib.Path(folder)
    if seed == SHIPPED_SEED:
        files = _shipped()
        _place(folder, files, seed)
    else:
        from .simulated import make_set, record_touches, tables

        recording = record_touches(seed)
        files = tables(recording)
        _place(folder, files, seed)
        make_set(recording, folder / _SET, seed, progress)
    return [folder / name for name in files if not name.startswith(_SET)] + [folder / _SET]


def _shipped():
    """{name: content} of the files of SHIPPED_SEED."""
    archive = importlib.resources.files("biotac_mj.assets") / "samples.zip"
    with archive.open("rb") as file, zipfile.ZipFile(file) as found:
        return {name: found.read(name) for name in found.namelist()}


def _place(folder, files, seed):
    """Writes files unless different ones exist; a set may have no other shards."""
    there = [folder / name for name in files]
    others = set((folder / _SET).glob("*.h5")) - set(there) if seed == SHIPPED_SEED else ()
    for path, content in [*zip(there, files.values()), *((path, None) for path in others)]:
        if path.exists() and path.read_bytes() != content:
            raise ValueError(
                f"{path} is there and is no sample of seed {seed}: choose another folder, or remove it"
            )
    for path, content in zip(there, files.values()):
        with replacing(path) as temporary:
            temporary.write_bytes(content)
