"""Residuals of trajectories with noise, model resolution and repeatability of the set-up taken into
account."""

import dataclasses

import numpy as np

from ..report.verdict import electrode_names
from .base.nuisance import KNOWN, Nuisance
from .model.fields import Fields
from .model.simulator import Simulator
from .settings import SETTINGS

_ITERATIONS = 3  # Gauss-Newton's, for an error of a pose
_FARTHEST = 3.0  # times `repeatability`, at which its derivatives are taken
# [m] of a pose from one trial to the next: a good stage with a remounted tool; pass your own
REPEATABILITY = 0.05e-3


@dataclasses.dataclass
class Comparison:
    """Data against a simulator: trajectories, noise, fields.

    The pose error b_i of every trial is marginalised: C_i = diag(sigma^2) + J_i S_b J_i', with J_i the
    fields' differences (Woodbury, rank 3). The part of the residual in the span of J_i is separated from the
    rest: three numbers of unit variance, each of which has the weight of a row. So the scatter of poses is
    not attributed to an effect, and an offset that all trials share is evidence. Electrodes are compared
    relative to their rest: the mean over all trajectories of row 0.

    modulus: of the base model as calibrated, a factor; J_i and S_b follow it.
    about: (trajectories, 3) errors of poses [m] at which J_i is taken; None: at the recorded poses (`posed`).
    noises: (width,) of the channels alone; sigma, sigmas: with the model's resolution, of all trajectories
    and of each.
    likelihoods: what `likelihood.of` has made of some of its trajectories.
    """

    sim: Simulator
    trajectories: list
    fields: Fields
    noise: dict
    repeatability: float = REPEATABILITY
    modulus: float = 1.0
    about: np.ndarray | None = None

    def __post_init__(self):
        free = np.array([t.electrodes[0] for t in self.trajectories])
        self.rest = free.mean(0)
        self.has_pdc = all(t.pdc is not None for t in self.trajectories)
        self.has_force = all(t.force is not None for t in self.trajectories)
        self.rest_pdc = np.mean([t.pdc[0] for t in self.trajectories]) if self.has_pdc else 0.0
        self.nelectrode, self.width, self.groups = self.sim.design.nelectrode, 0, {}
        sizes = {"electrodes": self.nelectrode, "pdc": int(self.has_pdc), "force": 3 * self.has_force}
        for name, size in sizes.items():
            if size:
                self.groups[name] = slice(self.width, self.width + size)
                self.width += size
        self.measured = [
            self._stack(t.electrodes - self.rest, None if t.pdc is None else t.pdc - self.rest_pdc, t.force)
            for t in self.trajectories
        ]
        self.noises, self.likelihoods = np.concatenate([self.noise[name] for name in self.groups]), {}
        # One deep press decides nothing of what the light ones can show; but relative sizes of electrodes are
        # not better known where a touch is light.
        floor = np.array([np.abs(m).max(0) for m in self.measured])
        floor[:, : self.nelectrode] = floor[:, : self.nelectrode].max(0)
        for s in self.groups.values():
            floor[:, s] = SETTINGS.resolution * floor[:, s].mean(1, keepdims=True)
        self.sigmas = np.hypot(self.noises, floor)
        self.sigma = np.sqrt((self.sigmas**2).mean(0))
        self._basis = []  # of each trajectory, orthonormal u of its whitened pose columns, u s v' = J
        for i in range(len(self.trajectories)):
            columns = self.moved(i, 0.0 if self.about is None else self.about[i])
            J = np.stack([(c * self.repeatability / self.sigmas[i]).ravel() for c in columns], axis=1)
            self._basis.append(np.linalg.svd(J, full_matrices=False))

    @property
    def channels(self) -> list[str]:
        """(width,) names."""
        more = (["pdc"] if self.has_pdc else []) + (["Fx", "Fy", "Fz"] if self.has_force else [])
        return electrode_names(range(self.nelectrode)) + more

    def _stack(self, electrodes, pdc, force):
        return np.column_stack(
            [electrodes, *([pdc] if self.has_pdc else []), *([force] if self.has_force else [])]
        )

    def moved(self, i: int, offset: np.ndarray | float = 0.0) -> list[np.ndarray]:
        """Derivative of trajectory i by its pose, (n, width) per metre along x, y and z, about an offset (3,)
        [m]."""
        scale = self.modulus * self.sim.modulus
        z = np.exp(self.fields.base[i]["log_z"]) / 1e4
        counts_per_log = -4095 * z / (z + 1) ** 2
        out = []
        for slope in self.fields.shifting(i, np.broadcast_to(offset, 3)):
            counts, pdc = counts_per_log * slope[:, 4:], scale * slope[:, 3] / 36.5
            out.append(self._stack(counts, pdc, scale * slope[:, :3]))
        return out

    def _split(self, i, residual):
        """Splits the whitened residual (n, width) of trajectory i: the part along its pose's derivatives
        (3,), and the rest (n width,)."""
        r, u = (residual / self.sigmas[i]).ravel(), self._basis[i][0]
        along = u.T @ r
        return along, r - u @ along

    def unposed(self, i: int, residual: np.ndarray) -> np.ndarray:
        """Residual (n, width) without the part that the most probable error of the trial's pose explains."""
        (along, across), (u, s, _) = self._split(i, residual), self._basis[i]
        return (across + u @ (along / (1 + s**2))).reshape(residual.shape) * self.sigmas[i]

    def astray(self, i: int, residual: np.ndarray) -> np.ndarray:
        """(3,) errors of the trial's pose, of unit variance by noise and repeatability together."""
        return self._split(i, residual)[0] / np.sqrt(1 + self._basis[i][1] ** 2)

    def poses(self, effects: list, nuisance: Nuisance = KNOWN) -> np.ndarray:
        """(trajectories, 3) most probable error of every trial's pose [m], in the BioTac's frame."""
        about, lines = self.posed(self.raw(effects, nuisance), effects, nuisance)
        return about._errors(lines)

    def _errors(self, residuals):
        """(trajectories, 3) most probable errors of poses [m], by straight lines."""
        out = []
        for i, r in enumerate(residuals):
            _, s, v = self._basis[i]
            out.append(self.repeatability * v.T @ (s / (1 + s**2) * self._split(i, r)[0]))
        return np.array(out)

    def posed(self, raw: list, effects: list, nuisance: Nuisance) -> tuple["Comparison", list[np.ndarray]]:
        """The same with derivatives at the most probable error of every pose, and residuals `raw` (n, width)
        of effects and nuisance as straight lines from there have them at the recorded poses: where the skin
        meets the core within such an error, those from the recorded pose are others."""
        out, lines, here = self, raw, self.raw(effects, nuisance)
        for _ in range(_ITERATIONS):
            about = out._errors(lines)
            far = np.linalg.norm(about, axis=1, keepdims=True) / (_FARTHEST * self.repeatability)
            about /= np.maximum(far, 1.0)
            out = dataclasses.replace(self, about=about)
            moved = self.raw(effects, nuisance, offsets=about)
            straight = [np.tensordot(o, out.moved(i, o), 1) for i, o in enumerate(about)]
            lines = [r + m - h + by for r, m, h, by in zip(raw, moved, here, straight)]
        return out, lines

    def predict(self, runs: list) -> list:
        """Per trajectory (n, width) about rest."""
        rest = np.mean([r.counts[0] for r in runs], axis=0)
        rest_pdc = np.mean([r.pdc[0] for r in runs])
        return [self._stack(r.counts - rest, r.pdc - rest_pdc, r.force) for r in runs]

    def vector(self, i: int, residual: np.ndarray) -> np.ndarray:
        """(n width + 3,) whose square is the trajectory's mean square: the whitened residual, rows together,
        and the pose's error in units of its repeatability."""
        along, across = self._split(i, residual)
        along = along / np.sqrt(1 + self._basis[i][1] ** 2)
        return np.concatenate([across / np.sqrt(self.width), along]) / np.sqrt(len(residual))

    def vectors(self, effects: list, nuisance: Nuisance = KNOWN) -> list:
        """`vector` of every trajectory."""
        return [self.vector(i, r) for i, r in enumerate(self.raw(effects, nuisance))]

    def raw(
        self,
        effects: list,
        nuisance: Nuisance = KNOWN,
        exact: bool | list = False,
        offsets: np.ndarray | None = None,
    ) -> list:
        """Residuals (n, width) in counts, counts and newtons; offsets: (trajectories, 3) of the poses [m]."""
        runs = self.sim.run(
            self.trajectories,
            self.fields,
            exact,
            [*self.sim.effects, *effects],
            offsets=offsets,
            nuisance=nuisance,
        )
        return [m - p for m, p in zip(self.measured, self.predict(runs))]
