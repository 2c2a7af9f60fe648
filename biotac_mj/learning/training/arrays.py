"""A data set as tensors for training."""

import dataclasses
import pathlib
import typing

import numpy as np
import torch
from numpy.typing import ArrayLike

from ...sensor.channels import check_counts, counts_from_impedance, log_impedance
from ..networks.graph import SparseMatrix
from ..networks.points import SkinPoints

if typing.TYPE_CHECKING:
    from ...data import TactileSet


@dataclasses.dataclass
class Arrays:
    """All converged time steps of a set, n of them, on one device.

    Attributes:
      field: (n, nvert, 3) float16 displacements [mm]; (n, npoint, 3) of `at_points`.
      owner: (n,) number of the interaction; first: (n,) row of its first step; time: (n,) seconds since then.
      objects: (ninteraction,) str; labelled: (ninteraction,) bool: has measured counts.
      counts: (n, nelectrode) float32 measured counts, NaN where not labelled; tare: (n, nelectrode) those of
        the interaction's first row.
      simulated: (n, nelectrode) counts of the simulation's own film, without noise if the set has its
        impedances.
      force: (n, nouter) float16 norm of the contact force on the nodes `outer` [N].
      geometry: SkinGeometry. path: of the set. sensor: "real" if resimulated recordings have the measured
        counts, else "synthetic".
    """

    field: torch.Tensor
    owner: torch.Tensor
    first: torch.Tensor
    time: torch.Tensor
    objects: np.ndarray
    labelled: np.ndarray
    counts: torch.Tensor
    tare: torch.Tensor
    simulated: torch.Tensor
    force: torch.Tensor
    outer: np.ndarray
    geometry: object
    path: str = ""
    sensor: str = "synthetic"

    @property
    def device(self) -> torch.device:
        return self.field.device

    def rows(self, interactions: ArrayLike, labelled: bool = False) -> torch.Tensor:
        """Rows of these interactions; with `labelled` only rows with measured counts, without each
        interaction's tare row.

        Raises:
          ValueError: there are none.
        """
        wanted = torch.zeros(len(self.objects), dtype=torch.bool, device=self.device)
        wanted[torch.as_tensor(np.asarray(interactions, dtype=np.int64), device=self.device)] = True
        mask = wanted[self.owner]
        if labelled:
            mask &= torch.isfinite(self.counts).all(1) & (
                torch.arange(len(mask), device=self.device) != self.first
            )
        rows = mask.nonzero()[:, 0]
        if not len(rows):
            raise ValueError(
                f"one split has no {'labelled ' if labelled else ''}time steps: more interactions "
                "with measured counts are needed (biotac data generate --labelled), or another object"
            )
        return rows

    def change(self, rows: torch.Tensor) -> torch.Tensor:
        """(k, nelectrode) tared measured counts of rows."""
        return self.counts[rows] - self.tare[rows]

    def log_change(self, rows: torch.Tensor) -> torch.Tensor:
        """(k, nelectrode) d ln Z of rows relative to their tare."""
        return self._log_impedance(self.counts[rows], self.tare[rows])

    def film_change(self) -> torch.Tensor:
        """(n, nelectrode) d ln Z of all rows relative to their interaction's first, by the simulation's own
        film."""
        return self._log_impedance(self.simulated, self.simulated[self.first])

    def _log_impedance(self, counts, rest):
        value, before = (log_impedance(x.double().cpu().numpy()) for x in (counts, rest))
        return torch.as_tensor(value - before, dtype=torch.float32, device=self.device)

    @torch.no_grad()
    def at_points(self, points: SkinPoints) -> "Arrays":
        """The set with displacements at the points."""
        matrix = SparseMatrix(points.reading(self.geometry)).to(self.device)
        parts = [matrix.fields(u).half() for u in self.field.split(512)]
        return dataclasses.replace(self, field=torch.cat(parts))


def join(sets: list[Arrays]) -> Arrays:
    """Several sets as one, with the geometry of the first; their fields have the same shape. Contact forces
    are dropped if the outer nodes differ."""
    shift, shifted = 0, []
    for a in sets:
        begin = sum(len(p.owner) for p in shifted)
        shifted.append(dataclasses.replace(a, owner=a.owner + shift, first=a.first + begin))
        shift += len(a.objects)
    tensors = ["field", "owner", "first", "time", "counts", "tare", "simulated"]
    if len({a.force.shape[1] for a in sets}) == 1:
        tensors.append("force")
    whole = {k: torch.cat([getattr(p, k) for p in shifted]) for k in tensors}
    whole |= {k: np.concatenate([getattr(p, k) for p in shifted]) for k in ("objects", "labelled")}
    return dataclasses.replace(shifted[0], **whole)


def spread_rows(rows: torch.Tensor, count: int) -> torch.Tensor:
    """At most `count` of rows (k,), evenly spaced."""
    if len(rows) <= count:
        return rows
    return rows[torch.linspace(0, len(rows) - 1, count, device=rows.device).long()]


def check_columns(data: "TactileSet") -> None:
    """Raises ValueError if a set lacks a column for training."""
    for name in ("displacement", "counts", "measured_counts", "contact_force"):
        if name not in data.columns:
            raise ValueError(
                f"{data.path} has no column {name}, only {', '.join(data.columns)}: a set with deformed skin "
                "and readings comes from `biotac data generate --labelled N`, or `biotac data resimulate`"
            )


def load_arrays(path: pathlib.Path | str, device: torch.device | str = "cpu") -> Arrays:
    """Reads a set (docs/howto/file_formats.md).

    Args:
      path: folder or shard. device: of torch.

    Raises:
      FileNotFoundError: no such set.
      ValueError: no displacements or measured counts in it, channels in another order, NaN, or interactions
        without a row before touch.
    """
    from ...data import TactileSet

    with TactileSet(path) as data:
        check_columns(data)
        names, n = data.design.channels, data.design.nelectrode
        for file in data._files:
            channels = [c.decode() if isinstance(c, bytes) else str(c) for c in file.attrs["channels"]]
            if tuple(channels) != names:
                raise ValueError(
                    f"{file.filename} has its channels in the order {' '.join(channels)}: "
                    f"{' '.join(names)} is needed"
                )
        nstep = int(data.stop[-1])
        good = data["converged"][:nstep].astype(bool) if "converged" in data.columns else np.ones(nstep, bool)
        good[data.start] = True
        keep = np.flatnonzero(good)
        owner = np.repeat(np.arange(len(data)), data.stop - data.start)[keep]
        first = np.searchsorted(keep, data.start)[owner]
        field = np.empty((len(keep), data.geometry.nvert, 3), np.float16)
        for a in range(0, len(keep), 2048):
            field[a : a + 2048] = 1e3 * data["displacement"][keep[a : a + 2048]]
        if not np.isfinite(field).all():
            raise ValueError(
                f"{path} holds displacements that are not finite: "
                "make the set again, or leave those interactions out"
            )
        measured = data["measured_counts"][keep][:, :n]
        counts = data["counts"][keep][:, :n]
        check_counts(counts, f"simulated counts of {path}")
        check_counts(np.where(np.isnan(measured), counts, measured), f"measured counts of {path}")
        labelled = np.asarray(data.labelled)
        force = np.zeros((len(keep), data["contact_force"].shape[1]), np.float16)
        for a in range(0, len(keep), 2048):
            force[a : a + 2048] = np.linalg.norm(data["contact_force"][keep[a : a + 2048]], axis=2)
        time = data["time"][keep]
        simulated = counts_from_impedance(data["impedance"][keep]) if "impedance" in data.columns else counts
        tensor = lambda value, kind: torch.as_tensor(np.asarray(value), dtype=kind, device=device)  # noqa: E731
        return Arrays(
            field=tensor(field, torch.float16),
            owner=tensor(owner, torch.int64),
            first=tensor(first, torch.int64),
            time=tensor(time - time[first], torch.float32),
            objects=np.asarray(data.object),
            labelled=labelled,
            counts=tensor(measured, torch.float32),
            tare=tensor(measured[first], torch.float32),
            simulated=tensor(simulated, torch.float32),
            force=tensor(force, torch.float16),
            outer=np.unique(data.geometry.outer_face),
            geometry=data.geometry,
            path=str(path),
            sensor="real" if (data.kind[labelled] == "resimulated").all() else "synthetic",
        )
