"""Record of a press: arrays, and the files `readings.csv` and `skin.h5`."""

import csv
import dataclasses
import json
import pathlib

import numpy as np

from ..files import hdf5, replacing
from ..geometry.skin_geometry import SkinGeometry
from ..versions import versions

_BEFORE, _AFTER = ("time_s", "depth_m", "force_x_N", "force_y_N", "force_z_N"), ("nonconverged", "tier")
NEAR_PEAK = 0.999  # of the largest force: a pause at it is the peak to its end, where channels have followed


@dataclasses.dataclass
class PressRecord:
    """One press, in the BioTac frame. n is the number of saved steps; row 0 is the start, 5 um before first
    contact.

    Attributes:
      geometry: the undeformed skin.
      parameters: the given options, as numbers and strings for JSON.
      time: (n,) [s].
      depth: (n,) travel of the indenter along its direction from first contact [m].
      force: (n, 3) of the skin on the indenter [N].
      counts: (n, nchannel) in the order of `Design.channels` [counts].
      nonconverged: (n,) int, steps of the skin so far that did not converge.
      vert_xpos: (n, nvert, 3) float32, nodes [m].
      indenter_pos, indenter_quat: (n, 3) [m], (n, 4), pose of the indenter's frame.
      indenter_vert, indenter_face: (p, 3) [m], (q, 3), its surface in that frame, for pictures.
      seconds: wall time of the steps [s].
      pac: (n, npac) samples of each row's latest frame [counts], or None.
      contact_pressure: (n, nvert) float32 of the indenter on the nodes [Pa], or None.
    """

    geometry: SkinGeometry
    parameters: dict
    time: np.ndarray
    depth: np.ndarray
    force: np.ndarray
    counts: np.ndarray
    nonconverged: np.ndarray
    vert_xpos: np.ndarray
    indenter_pos: np.ndarray
    indenter_quat: np.ndarray
    indenter_vert: np.ndarray
    indenter_face: np.ndarray
    seconds: float
    pac: np.ndarray | None = None
    contact_pressure: np.ndarray | None = None

    def __post_init__(self):
        n = len(self.time)
        shapes = dict(
            depth=(n,),
            force=(n, 3),
            counts=(n, len(self.geometry.design.channels)),
            nonconverged=(n,),
            vert_xpos=(n, self.geometry.nvert, 3),
            indenter_pos=(n, 3),
            indenter_quat=(n, 4),
        )
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(
                    f"{name} of a press with {n} saved steps has shape {np.shape(getattr(self, name))}: "
                    f"{shape} is needed"
                )

    @property
    def electrode_change(self) -> np.ndarray:
        """Change (n, nelectrode) of the electrodes from row 0 [counts]."""
        n = self.geometry.design.nelectrode
        return self.counts[:, :n] - self.counts[0, :n]

    @property
    def peak(self) -> int:
        """Index of the last saved step within 0.1 % of the largest force, which summary and pictures show."""
        force = np.linalg.norm(self.force, axis=1)
        return int(np.flatnonzero(force >= NEAR_PEAK * force.max())[-1])


def write_readings(record: PressRecord, path: pathlib.Path | str) -> None:
    """readings.csv: a header (channels are counts), then one row for each saved step."""
    tier = record.parameters.get("tier", "full")
    rows = np.column_stack([record.time, record.depth, record.force])
    with replacing(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*_BEFORE, *record.geometry.design.channels, *_AFTER])
        for row, counts, nonconverged in zip(rows, record.counts, record.nonconverged):
            writer.writerow(
                [
                    *(f"{value:.9g}" for value in row),
                    *(f"{value:.6g}" for value in counts),
                    int(nonconverged),
                    tier,
                ]
            )


def write_skin(record: PressRecord, path: pathlib.Path | str) -> None:
    """skin.h5: `vert_xpos` (n, nvert, 3) float32 [m], `contact_pressure` (n, nvert) float32 [Pa], the skin's
    topology, the readings; parameters and versions as JSON attributes."""
    geometry = record.geometry
    pose = np.concatenate([record.indenter_pos, record.indenter_quat], axis=1)
    columns = dict(
        time=(record.time, "s"),
        depth=(record.depth, "m"),
        force=(record.force, "N"),
        counts=(record.counts, "count"),
        indenter_pose=(pose, "m, then quaternion w x y z"),
        nonconverged=(record.nonconverged, "steps"),
    )
    if record.pac is not None:
        columns["pac"] = record.pac, "count"
    topology = dict(
        vert=(geometry.vert, "m"),
        elem=(geometry.tets, "node"),
        outer_face=(geometry.outer_face, "node"),
        inner_face=(geometry.inner_face, "node"),
        fixed=(geometry.fixed, "node"),
        indenter_vert=(record.indenter_vert, "m"),
        indenter_face=(record.indenter_face, "vertex"),
    )
    with hdf5(path) as file:
        for name, unit in (("vert_xpos", "m"), ("contact_pressure", "Pa")):
            value = getattr(record, name)
            if value is not None:
                kept = dict(dtype="f4", chunks=(1, *value.shape[1:]), compression="gzip", shuffle=True)
                file.create_dataset(name, data=value, **kept).attrs["unit"] = unit
        for name, (value, unit) in {**columns, **topology}.items():
            file[name] = value
            file[name].attrs["unit"] = unit
        file["counts"].attrs["names"] = geometry.design.channels
        file.attrs["skin"] = geometry.name
        file.attrs["tier"] = record.parameters.get("tier", "full")
        file.attrs["frame"] = "BioTac: tip at -x, pad at -y, nail at +y, clamp at +x"
        file.attrs["parameters"] = json.dumps(record.parameters)
        file.attrs["versions"] = json.dumps(versions())
