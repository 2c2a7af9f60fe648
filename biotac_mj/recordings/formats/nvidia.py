"""NVIDIA's biotac{1,2,3}.hdf5 (Sundaralingam et al., ICRA 2019; Narang et al., 2021): many trajectories,
no times."""

import pathlib

import h5py
import numpy as np

from ...quality.clock import BUS_RATE
from ...reading import Array, read_hdf5, reading
from ...sensor.channels import NELECTRODE
from ..recording import Recording

_KEYS = {
    "electrode_vals/data": Array(("n", NELECTRODE)),
    "contact_loc/data": Array(("n", 3)),
    "force_vec/data": Array(("n", 3)),
}
_REACH = 0.5  # [m] a contact farther from the file's origin is not in metres
_JUMP = 0.5e-3  # [m] largest step within one trajectory


def read_nvidia(
    path: pathlib.Path, rate: float | None = None, objects: list[str] | None = None
) -> list[Recording]:
    """A recording for each trajectory, which ends where contact_loc jumps by more than 0.5 mm or the indenter
    changes.

    Keys electrode_vals/data (n, 19), contact_loc/data (n, 3) [m], force_vec/data (n, 3) [N],
    indenter_type/data (n,) or (n, 1); the last may be missing.

    Args:
      rate: of the samples [Hz], None: 100; the file has no times.
      objects: names of indenter types 0, 1, ...; None calls them indenter_0 and so on.

    Raises:
      FileNotFoundError, ValueError: no such file, or another layout; the text has the key.
    """
    remedy = f"give an HDF5 file with {', '.join(_KEYS)} and indenter_type/data, one row for each sample"
    data, _ = read_hdf5(path, "recording of NVIDIA's", remedy, _KEYS)
    electrodes, place, force = data.values()
    n = len(electrodes)
    if not n:
        raise ValueError(f"{path} has no samples: {remedy}")
    kind = _indenter_types(path, n)
    if np.abs(place).max() > _REACH:
        raise ValueError(f"contact_loc/data of {path} reaches {np.abs(place).max():.3g}: metres are needed")
    jump = np.linalg.norm(np.diff(place, axis=0), axis=1) > _JUMP
    edge = [0, *np.flatnonzero(jump | (np.diff(kind) != 0)) + 1, n]
    out = []
    for number, (a, b) in enumerate(zip(edge, edge[1:])):
        k = kind[a]
        if objects is not None and not 0 <= k < len(objects):
            raise ValueError(
                f"{path} has indenter type {k}, but {len(objects)} object names were given: name all of them"
            )
        out.append(
            Recording(
                np.arange(b - a) / (rate or BUS_RATE),
                electrodes[a:b],
                force=force[a:b],
                contact_pos=place[a:b],
                name=f"{path.stem}-{number:05d}",
                object=f"indenter_{k}" if objects is None else objects[k],
                source=path.name,
                rate_source="given" if rate else "assumed: the bus rate",
                notes=(f"rows {a} to {b - 1} of {path.name}",),
            )
        )
    return out


def _indenter_types(path, n):
    """(n,) whole numbers; zeros where the file has none."""
    name = "indenter_type/data"
    with reading(path, "recording of NVIDIA's", "fetch it again"), h5py.File(path) as file:
        kind = np.asarray(file[name][()], float).reshape(-1) if name in file else np.zeros(n)
    if len(kind) != n or not (np.isfinite(kind) & (kind == np.rint(kind))).all():
        raise ValueError(
            f"{name} of {path} has {len(kind)} entries for {n} samples, or some that are no whole numbers: "
            "it must have the number of the indenter for each sample"
        )
    return kind.astype(int)
