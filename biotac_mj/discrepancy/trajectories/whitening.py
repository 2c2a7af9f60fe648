"""Residuals of trajectories with noise, model resolution and repeatability of the set-up taken into
account."""

import dataclasses

import numpy as np

from .nuisance import KNOWN, Nuisance
from .simulator import Fields, Simulator

__all__ = ["Comparison", "REPEATABILITY"]

# [m] of a pose from one trial to the next: a good stage with a remounted tool; pass your own
REPEATABILITY = 0.05e-3
# of a channel's largest change: the base model (mesh, tier, film) is not better than that (docs/condensed.md)
_RESOLUTION = 0.01


@dataclasses.dataclass
class Comparison:
    """Data against a simulator: trajectories, noise, fields.

    Whitening marginalises the pose error b_i of every trial: C_i = diag(sigma^2) + J_i S_b J_i', with J_i the
    fields' differences (Woodbury, rank 3). Electrodes are compared about their rest: the mean over all
    trajectories of row 0.
    """

    sim: Simulator
    trajectories: list
    fields: Fields
    noise: dict
    repeatability: float = REPEATABILITY

    def __post_init__(self):
        free = np.array([t.electrodes[0] for t in self.trajectories])
        self.rest = free.mean(0)
        self.has_pdc = all(t.pdc is not None for t in self.trajectories)
        self.has_force = all(t.force is not None for t in self.trajectories)
        self.rest_pdc = np.mean([t.pdc[0] for t in self.trajectories]) if self.has_pdc else 0.0
        self.groups = {"electrodes": slice(0, 19)}
        width = 19
        if self.has_pdc:
            self.groups["pdc"] = slice(width, width + 1)
            width += 1
        if self.has_force:
            self.groups["force"] = slice(width, width + 3)
            width += 3
        self.width = width
        self.measured = [
            self._stack(t.electrodes - self.rest, None if t.pdc is None else t.pdc - self.rest_pdc, t.force)
            for t in self.trajectories
        ]
        largest = np.max([np.abs(m).max(0) for m in self.measured], axis=0)
        sigma = np.concatenate(
            [
                self.noise["electrodes"],
                *([[self.noise["pdc"]]] if self.has_pdc else []),
                *([self.noise["force"]] if self.has_force else []),
            ]
        )
        floor = np.concatenate(
            [np.full(s.stop - s.start, _RESOLUTION * largest[s].mean()) for s in self.groups.values()]
        )
        self.sigma = np.hypot(sigma, floor)
        self._prepare()

    def _stack(self, electrodes, pdc, force):
        return np.column_stack(
            [electrodes, *([pdc] if self.has_pdc else []), *([force] if self.has_force else [])]
        )

    def _prepare(self):
        """Whitened pose columns of every trajectory (orthonormal) and how much each is shrunk."""
        self._basis = []
        for i in range(len(self.trajectories)):
            base = self.fields.base[i]
            z = np.exp(base["log_z"]) / 1e4
            counts_per_log = -4095 * z / (z + 1) ** 2
            columns = []
            for axis in "xyz":
                slope = self.fields.slopes[axis][i]
                columns.append(
                    self._stack(counts_per_log * slope["log_z"], slope["pressure"] / 36.5, slope["force"])
                    / self.sigma
                )
            J = np.stack([c.ravel() for c in columns], axis=1) * self.repeatability
            u, s, _ = np.linalg.svd(J, full_matrices=False)
            self._basis.append((u, 1 - 1 / np.sqrt(1 + s**2)))

    def predict(self, runs: list) -> list:
        """Per trajectory (n, width) about rest."""
        rest = np.mean([r.counts[0] for r in runs], axis=0)
        rest_pdc = np.mean([r.pdc[0] for r in runs])
        return [self._stack(r.counts - rest, r.pdc - rest_pdc, r.force) for r in runs]

    def whiten(self, i: int, residual: np.ndarray) -> np.ndarray:
        """(n, width) with unit covariance under noise, resolution and repeatability."""
        r = (residual / self.sigma).ravel()
        u, shrink = self._basis[i]
        return (r - u @ (shrink * (u.T @ r))).reshape(residual.shape)

    def residuals(self, effects: list | None, nuisance: Nuisance = KNOWN, exact: bool | list = False) -> list:
        """Whitened residuals of every trajectory."""
        runs = self.sim.run(
            self.trajectories, self.fields, exact, [*self.sim.effects, *effects], nuisance=nuisance
        )
        return [self.whiten(i, m - p) for i, (m, p) in enumerate(zip(self.measured, self.predict(runs)))]

    def raw(self, effects: list | None, nuisance: Nuisance = KNOWN, exact: bool | list = False) -> list:
        """Residuals (n, width) in counts, counts and newtons."""
        runs = self.sim.run(
            self.trajectories, self.fields, exact, [*self.sim.effects, *effects], nuisance=nuisance
        )
        return [m - p for m, p in zip(self.measured, self.predict(runs))]
