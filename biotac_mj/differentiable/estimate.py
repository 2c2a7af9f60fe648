"""Contact from electrodes: the press that makes the simulated sensor read what was measured.

A geom comes straight to the skin, along its inward normal; where it ends has three coordinates. A small table
of presses tells where to begin, Gauss and Newton's method with exact slopes finds the end. What the
electrodes leave open is told by their slopes there and by how badly they are met.

Of what all electrodes share, as with the liquid's temperature, nothing is told: a common change is free."""

import dataclasses

import numpy as np
import torch
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import least_squares
from scipy.stats import t as student
from torch.autograd import forward_ad

from ..calibration import plan_indentation
from ..calibration.forward import Steps, steps_of
from ..geometry.skin_geometry import SkinGeometry
from ..sensor.channels import FULL_SCALE, NELECTRODE, electrode_noise, log_impedance
from ..sensor.film import FilmConduction, NoFilmError
from ..skin import Material, SkinOptions
from ..skin.cache import kept
from .film import impedance
from .record import Trajectory, follow
from .skin import Skin
from .sweep import Inputs, push_forward

__all__ = ["Estimate", "Estimator"]

# By how much of its change an electrode is off, as another sensor's gains are: they scatter by 0.25 to 0.29
# in two sensors (docs/lab/real_match.md)
GAIN = 0.27
_ALONG = np.arange(-0.018, 0.003, 2.5e-3)  # [m] places of the table along the finger
_AROUND = np.radians(np.arange(-87.5, 88, 25))  # and around it
_DEPTHS = np.arange(0, 2.1e-3, 2.5e-4)  # [m] of its presses
_TRIES = 4  # places of the table from which the search between them begins
_SCALE = 1e-3, 0.15, 3e-4  # of what it moves: place along, angle around [rad], depth
_FAR = 5e-4  # [m] the longest move at once: contact changes beyond
_NEAR, _LESS = 1e-5, 0.01  # [m] a move, and a gain of what is missed, that end the search
_CONFIDENCE = 0.95
_PRECISION = 1e-4  # of slopes


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One contact; errors are half widths of 95 % intervals, from the slopes and what is missed.

    Attributes:
      centre, centre_error: (3,) of the contact on the resting skin, on the force's line [m].
      force, force_error: (3,) of the geom on the skin [N].
      size, size_error: of the force [N].
      pos: (3,) of the geom [m], quat its attitude (4,), both in the BioTac frame.
      missed: how much of the electrodes' change is not met, as a share of its RMS.
      lost: steps of the press without a balance. settled: whether the search came to its end.
    """

    centre: np.ndarray
    centre_error: np.ndarray
    force: np.ndarray
    force_error: np.ndarray
    size: float
    size_error: float
    pos: np.ndarray
    quat: np.ndarray
    missed: float
    lost: int
    settled: bool


class Estimator:
    """Inverts one skin under one geom.

    Args:
      geometry: of the skin. indenter: as `biotac press --indenter`, one geom or mesh.
      material, options: of the skin: force goes with its modulus.

    Raises:
      ValueError: what `Skin` refuses.
    """

    def __init__(
        self,
        geometry: SkinGeometry,
        indenter: str = "sphere_7mm",
        material: str | Material = "default",
        options: SkinOptions | None = None,
    ):
        self.geometry, self.indenter = geometry, indenter
        _, shape = steps_of(self._plan((_ALONG[0], 0.0), _DEPTHS[-1]))
        self.skin = Skin(geometry, material, options, **shape, precision=_PRECISION)
        self.film = FilmConduction(geometry)
        self._rest = self._table = None

    def __call__(self, counts: np.ndarray, rest: np.ndarray, most: int = 12) -> Estimate:
        """The contact at which electrodes read counts (19,), and untouched rest (19,); at most so many
        presses.

        Raises:
          ValueError: shapes, or counts that hardly differ from rest.
        """
        counts, rest = np.asarray(counts, float), np.asarray(rest, float)
        for name, value in (("counts", counts), ("rest", rest)):
            if value.shape != (NELECTRODE,) or not ((value >= 1) & (value <= FULL_SCALE - 1)).all():
                raise ValueError(
                    f"{name} are not {NELECTRODE} numbers between 1 and {FULL_SCALE - 1:.0f}: an electrode "
                    "at its end tells no impedance; choose another row"
                )
        change = log_impedance(counts) - log_impedance(rest)
        noise = electrode_noise(rest) * 0.5 * np.abs(log_impedance(rest + 1) - log_impedance(rest - 1))
        changed = np.sqrt((change**2).mean())
        if changed < 3 * np.sqrt((noise**2).mean()):
            raise ValueError(
                f"ln Z differs from rest by {changed:.4f}, which may be noise: choose a row under load, or "
                "another rest"
            )
        sigma = np.sqrt(noise**2 + GAIN**2 * (change**2 + changed**2))
        target = _Target(change, sigma)
        steps, quat = self._begin(target)
        shift, damping, settled = np.zeros(3), 1e-3, False
        best = self._look(steps, shift, target)
        for _ in range(most - 1):
            normal = best.slopes.T @ best.slopes
            move = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), best.slopes.T @ best.missed)
            move *= min(1.0, _FAR / np.linalg.norm(move))
            there = self._look(steps, shift + move, target)
            if there is not None and there.cost < best.cost:
                settled = np.linalg.norm(move) < _NEAR or best.cost - there.cost < _LESS * best.cost
                best, shift, damping = there, shift + move, damping / 4
            else:
                settled, damping = np.linalg.norm(move) < _NEAR, 8 * damping
            if settled:
                break
        return self._estimate(best, steps.pos[-1, 0] + shift, quat, target, settled)

    def _plan(self, place, depth, samples=4):
        return plan_indentation(self.indenter, place, depth, 0.0, samples=samples, skin=self.geometry)

    def _follow(self, pos, mat):
        skin = self.skin
        incompressible = np.isinf(skin.model.options.bulk_modulus)
        trajectory = follow(skin, pos, mat, skin.friction, skin.own, incompressible)
        if self._rest is None:
            self._rest = self._read(trajectory.rest) if trajectory.rest else self.film.rest
        return trajectory

    def _read(self, record):
        return self.film.impedance(record.x[: len(self.geometry.vert)])

    def _begin(self, target):
        """Steps of the press that fits best between those of the table, and the geom's attitude."""
        if self._table is None:
            model = self.skin.model
            inputs = [model.geometry.vert, model.geometry.elem, model.material, model.options]
            inputs += [self.indenter, _ALONG, _AROUND, _DEPTHS]
            log_z = kept("estimate-table", inputs, self._make_table)["log_z"]
            self._table = RegularGridInterpolator((_ALONG, _AROUND, _DEPTHS), log_z, method="cubic")
        table = self._table

        nodes = np.stack(np.meshgrid(*table.grid, indexing="ij"), -1)
        off = (target.missed(table.values) ** 2).sum(-1)
        low, high = (np.array([axis[k] for axis in table.grid]) for k in (0, -1))
        tries = [
            least_squares(
                lambda at: target.missed(table(at)[0]),
                np.clip(nodes[place][off[place].argmin()], low + 1e-9, high - 1e-9),
                bounds=(low, high),
                x_scale=_SCALE,
                ftol=1e-3,
            )
            for place in zip(*np.unravel_index(np.argsort(off.min(2), None)[:_TRIES], off.shape[:2]))
        ]
        x, angle, depth = min(tries, key=lambda found: found.cost).x
        plan = self._plan((x, angle), max(depth, _DEPTHS[1] / 4))
        return steps_of(plan)[0], plan.quat

    def _make_table(self):
        log_z = np.zeros((len(_ALONG), len(_AROUND), len(_DEPTHS), NELECTRODE))
        for i, x in enumerate(_ALONG):
            for j, angle in enumerate(_AROUND):
                steps, _ = steps_of(self._plan((x, angle), _DEPTHS[-1], len(_DEPTHS) - 1))
                trajectory = self._follow(steps.pos, steps.mat)
                for k, end in enumerate(steps.ends[1:], start=1):
                    try:
                        log_z[i, j, k] = np.log(self._read(trajectory.steps[end]) / self._rest)
                    except NoFilmError:  # beyond what can be read, as deep as it can
                        log_z[i, j, k] = log_z[i, j, k - 1]
        return {"log_z": log_z}

    def _look(self, steps: Steps, shift, target):
        """A press that is shifted; None where the film tears."""
        pos, skin = steps.pos + shift, self.skin
        with skin.lock:
            trajectory = self._follow(pos, steps.mat)
            ways = np.zeros((3, len(pos), 1, 6))
            ways[:, :, 0, :3] = np.eye(3)[:, None]
            given = Inputs(ways, np.zeros((3, 1)), {name: np.zeros(3) for name in skin.own})
            ahead = push_forward(skin, trajectory, given)
        nodes = torch.from_numpy(trajectory.steps[-1].x)
        slopes = []
        try:
            for way in ahead.nodes[:, -1]:
                with forward_ad.dual_level():
                    dual = forward_ad.make_dual(nodes, torch.from_numpy(np.ascontiguousarray(way)))
                    value, slope = forward_ad.unpack_dual(impedance(self.film, dual).log())
                slopes.append(target.weigh(slope.numpy()))
        except NoFilmError:
            return None
        missed = target.missed(value.numpy() - np.log(self._rest))
        return _Look(trajectory, ahead.wrench[:, -1, 0], np.stack(slopes, 1), missed, float(missed @ missed))

    def _estimate(self, best, pos, quat, target, settled):
        record, skin = best.trajectory.steps[-1], self.skin
        face, weight = record.touches // len(skin.weights), skin.weights[record.touches % len(skin.weights)]
        corner = self.geometry.vert[skin.data.outer.surface.face_np[face]]
        middle = torch.from_numpy(np.einsum("ma,mak->mk", weight, corner).mean(0))
        free = NELECTRODE - 4
        covariance = np.linalg.inv(best.slopes.T @ best.slopes) * best.cost / free
        wide = student.ppf((1 + _CONFIDENCE) / 2, free)

        def centre(wrench):
            force, torque = wrench[:3], wrench[3:]
            along = force / force.norm()
            return torch.linalg.cross(force, torque) / (force @ force) + along * (along @ middle)

        wrench = torch.from_numpy(record.wrench[0].copy())

        def error(function):
            slopes = torch.autograd.functional.jacobian(function, wrench).reshape(-1, 6).numpy()
            slopes = slopes @ best.wrench.T
            return wide * np.sqrt(np.einsum("ij,jk,ik->i", slopes, covariance, slopes))

        return Estimate(
            centre=centre(wrench).numpy(),
            centre_error=error(centre),
            force=-record.wrench[0, :3],
            force_error=error(lambda wrench: wrench[:3]),
            size=float(np.linalg.norm(record.wrench[0, :3])),
            size_error=float(error(lambda wrench: wrench[:3].norm())[0]),
            pos=pos,
            quat=quat,
            missed=float(np.sqrt(((best.missed * target.sigma) ** 2).sum() / (target.change**2).sum())),
            lost=sum(one.changes.lost for one in best.trajectory.steps),
            settled=bool(settled),
        )


@dataclasses.dataclass(frozen=True)
class _Target:
    """Changes of ln Z to be met (19,), and how well (19,)."""

    change: np.ndarray
    sigma: np.ndarray

    def weigh(self, value: np.ndarray) -> np.ndarray:
        """(..., 19) over sigma, without what all electrodes share."""
        scaled, common = value / self.sigma, 1 / np.linalg.norm(1 / self.sigma) / self.sigma
        return scaled - (scaled @ common)[..., None] * common

    def missed(self, log_z: np.ndarray) -> np.ndarray:
        """What changes (..., 19) of ln Z miss."""
        return self.weigh(self.change - log_z)


@dataclasses.dataclass(frozen=True)
class _Look:
    """A press: wrench by its shift (3, 6), slopes (19, 3) and what is missed (19,), both over sigma."""

    trajectory: Trajectory
    wrench: np.ndarray
    slopes: np.ndarray
    missed: np.ndarray
    cost: float
