"""Table of presses of a geom all over a skin: sensor signals, contact quantities, and derivatives of both.

Positions are on a capsule about the finger, projected to the skin. Every press follows the inward normal, to
a depth that leaves the core clear. They are simulated once and cached on disk; values between them are
interpolated by splines."""

import dataclasses
import functools
import itertools
import sys
from collections.abc import Iterator

import numpy as np
import torch
import warp as wp
from scipy.interpolate import RegularGridInterpolator
from tqdm import tqdm

from ...cache import cached
from ...calibration import plan_indentation
from ...calibration.forward import Steps, steps_of
from ...calibration.indentation import Indentation
from ...data.generation.clearance import Placed, surface_samples
from ...geometry.core_surface import CoreSurface
from ...geometry.rigid import matrix
from ...geometry.skin_geometry import SkinGeometry
from ...press.indenter import make_indenter
from ...sensor.film import FilmConduction, NoFilmError
from ...skin import GeomSet, SkinModel
from ...skin.condensed import CondensedSkin, Memory
from ..record import Record, Trajectory, follow
from ..skin import Skin
from ..sweep import Inputs, push_forward

_TIP, _RADIUS = -14.5e-3, 7.2e-3  # [m] of a capsule about the x axis that approximates a clamped finger
_ROUND = np.radians([85, 64, 43, 21])  # angles on an end
_FRACTIONS = np.linspace(0, 1, 8)  # of the deepest press
_DEEPEST, _CLEAR = 2.4e-3, 0.6e-3  # [m] largest depth, least distance from the core, as `data.generation`
_FINER = 2  # interpolated points per point of the table
_LIGHTEST = 1 / 32  # fraction of the depth of the lightest press
_FILL = 1e-9  # [m^3] unit of the fill in derivatives
_TOLERANCE = 1e-4  # of the condensed tier: differences of presses are taken
_NUDGE = 1e-8  # [m] largest move of a node in differences: far under a film's thickness, far over rounding
_FLOORS, _MOVED = (25e-6, 100e-6), 0.5e-3  # [m] secants: residual films, shifts of the electrodes


@dataclasses.dataclass(frozen=True, eq=False)
class Capsule:
    """Capsule about the x axis that approximates a skin's shape, with presses at points on it.

    Attributes:
      tip, base: centres of its ends [m]. radius: [m].
      along: of the points, arc length from x = 0, to the base [m]. around: from the pad's midline [rad].
    """

    tip: float
    base: float
    radius: float
    along: np.ndarray
    around: np.ndarray

    def turn(self, along: np.ndarray) -> np.ndarray:
        """Angle [rad] of the normal towards the tip; negative: to the base."""
        return (np.maximum(0, self.tip - along) - np.maximum(0, along - self.base)) / self.radius

    def frame(self, along: float, around: float) -> np.ndarray:
        """(3, 3), its rows the outward normal, the direction around the finger, and the one along it."""
        turn = self.turn(along)
        out = np.array([-np.sin(turn), -np.cos(turn) * np.cos(around), np.cos(turn) * np.sin(around)])
        side = np.array([0, np.sin(around), np.cos(around)])
        return np.array([out, side, np.cross(out, side)])

    def at(self, along: float, around: float) -> np.ndarray:
        """(3,) point [m]."""
        return self.radius * self.frame(along, around)[0] + [min(max(along, self.tip), self.base), 0, 0]


def capsule_of(geometry: SkinGeometry) -> Capsule:
    """Capsule of a finger that ends at a clamp, or else of a dome on a backing."""
    if len(geometry.clamp_face):
        along = np.concatenate([_TIP - _RADIUS * _ROUND, np.linspace(_TIP, 3e-3, 7)])
        return Capsule(_TIP, np.inf, _RADIUS, along, np.radians(np.linspace(-92, 92, 8)))
    outer = geometry.vert[geometry.outer_face].reshape(-1, 3)
    radius = float(np.abs(outer[:, 2]).max())
    tip, base = min(outer[:, 0].min() + radius, 0.0), max(outer[:, 0].max() - radius, 0.0)
    ends = tip - radius * _ROUND, np.linspace(tip, base, 3), base + radius * _ROUND[::-1]
    return Capsule(tip, base, radius, np.concatenate(ends), np.radians(np.linspace(-85, 85, 8)))


def coarser(capsule: Capsule) -> Capsule:
    """A third of the places: every second along, five around."""
    around = np.linspace(capsule.around[0], capsule.around[-1], 5)
    return dataclasses.replace(capsule, along=capsule.along[::2], around=around)


@dataclasses.dataclass(frozen=True, eq=False)
class Solved:
    """A solved step: nodes (nvert, 3) [m], pressure of the liquid above rest [Pa], wrench (6,) of the skin on
    the geom [N, N m], samples in contact (k,)."""

    x: np.ndarray
    pressure: float
    wrench: np.ndarray
    touches: np.ndarray


def outcome_of(wrench: torch.Tensor, middle: torch.Tensor) -> torch.Tensor:
    """(7,) outcome of a press: ln of the force [N], the contact's centre [m], the force's direction.

    Args:
      wrench: (6,) of the skin on the geom. middle: (3,) mean of the samples in contact, on the skin at rest
        [m]; the centre is its projection on the line of force.
    """
    force, torque = wrench[:3], wrench[3:]
    along = force / force.norm()
    centre = torch.linalg.cross(force, torque) / (force @ force) + along * (along @ middle)
    return torch.cat([force.norm().log()[None], centre, -along])


def deepest(indentation: Indentation, core: wp.array) -> float:
    """Depth at which an indenter is 0.6 mm from the core [m], at most 2.4 mm. All of its surface counts: a
    finger may be inside a ring.

    Args:
      indentation: a press of 2.4 mm. core: points of its surface, vec3 [m].
    """
    count = len(indentation.tip)
    placed = Placed(indentation.indenter, count)
    placed.place(indentation.tip, np.tile(matrix(indentation.quat), (count, 1, 1)))
    gap = np.minimum.accumulate(placed.nearest(core))
    if gap[-1] >= _CLEAR:
        return _DEEPEST
    return float(np.interp(-_CLEAR, -gap, np.linspace(0.0, _DEEPEST, count)))


def frame_of(steps: Steps, around: float) -> np.ndarray:
    """(2, 3) tilt axes of a press: one around the finger, one along it, both orthogonal to its path."""
    out = steps.pos[0, 0] - steps.pos[-1, 0]
    out = out / np.linalg.norm(out)
    first = np.array([0, np.sin(around), np.cos(around)])
    first -= out * (out @ first)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(out, first)])


def slopes_of_film(
    film: FilmConduction, x: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """ln Z (nelectrode,) of a film under nodes x (nvert, 3) [m], and its derivatives (k, nelectrode) along
    directions (k, nvert, 3) of them: central differences, which agree with PyTorch's to 1e-8 in a sixtieth of
    the time."""
    slopes = []
    for direction in directions:
        step = _NUDGE / max(np.abs(direction).max(), 1e-30)
        high, low = (np.log(film.impedance(x + size * direction)) for size in (step, -step))
        slopes.append((high - low) / (2 * step))
    return np.log(film.impedance(x)), np.array(slopes)


class Presses:
    """n presses, at the table's points and interpolated between them.

    Args:
      skin: with one geom. geometry: of it. indenter: the geom, as in `biotac press --indenter`.
      progress: whether to show a bar while the table is made.
      slopes: whether derivatives are computed too, of the full skin; without them the table is for starts
        of a search, by the condensed tier, with a third of the places.

    Attributes:
      at: (n, 3) along [m] and around [rad] the capsule, fraction of the deepest press there.
      signal: (n, nelectrode + 1), changes of ln Z, and of the liquid's pressure [kPa]. by_press: (n, 3,
        nelectrode + 1) derivatives by two tilts of the path [rad] and the fill [ul].
      by_sensor: (n, 3, nelectrode + 1) derivatives by ln of the residual film, and by shifts of the
        electrodes along and across the finger [mm].
      outcome: (n, 7) of `outcome_of`. outcome_by: (n, 3, 7) derivatives by tilts and fill.
      weight: (n,) ln of the fraction of the skin's area. deepest: (n,) whether it is the deepest at its
        position.
      capsule: that of the places.
    """

    def __init__(
        self, skin: Skin, geometry: SkinGeometry, indenter: str, progress: bool = False, slopes: bool = True
    ):
        self.skin, self.geometry, self._indenter, self._progress = skin, geometry, indenter, progress
        self._slopes = slopes
        self._core_samples = surface_samples(geometry.core_vert, geometry.core_face, "cpu")
        self.capsule = capsule = capsule_of(geometry) if slopes else coarser(capsule_of(geometry))
        axes = capsule.along, capsule.around, _FRACTIONS
        inputs = [geometry, skin.model.material, skin.model.options, make_indenter(indenter), *axes]
        code = "geometry", "skin", "sensor", "calibration", "differentiable"
        table = cached("presses", [*inputs, slopes], self._make, code)
        along, around, fraction = (
            np.interp(np.arange((len(a) - 1) * _FINER + 1) / _FINER, np.arange(len(a)), a) for a in axes
        )
        fraction[0] = _LIGHTEST
        self.at = at = np.stack(np.meshgrid(along, around, fraction, indexing="ij"), -1).reshape(-1, 3)
        for name, values in table.items():
            method = "cubic" if slopes else "linear"
            setattr(self, name, RegularGridInterpolator(axes, values, method=method)(at))
        self.outcome[:, 0] += np.log(at[:, 2])
        self.deepest = at[:, 2] == fraction[-1]
        self.weight = np.log(np.cos(capsule.turn(at[:, 0])))

    def simulate(self, along: float, around: float, fraction: float = 1.0) -> tuple[Trajectory, Steps]:
        """Simulates a press at a position [m], [rad]: its steps, and their path."""
        steps, skin = self.path(along, around, fraction), self.skin
        return follow(skin, steps.pos[None], steps.mat[None], skin.friction, skin.own), steps

    @functools.cached_property
    def _condensed(self):
        given, geoms = self.skin.model, GeomSet(**self.skin.made_with)
        geoms.set_friction(self.skin.friction)
        options = dataclasses.replace(given.options, tolerance=_TOLERANCE)
        return CondensedSkin(SkinModel(self.geometry, given.material, options), geoms)

    def approximate(self, pos: np.ndarray, mat: np.ndarray) -> Iterator[Solved]:
        """Steps of the condensed tier along a path (nstep, 1, 3) [m], (nstep, 1, 3, 3)."""
        memory, n = Memory.rest(1), len(self.geometry.vert)
        for one_pos, one_mat in zip(pos, mat):
            out = self._condensed.solve(memory, one_pos, one_mat)
            memory = out.memory
            touches = memory.contacts[:, 0].astype(int)
            yield Solved(out.vert_xpos[:n], float(memory.pressure), out.wrench[0], touches)

    def solved(self, record: Record, rest: Record | None) -> Solved:
        """A record of the full skin, and of the skin at rest."""
        pressure = float(record.pressure - (rest.pressure if rest else 0.0))
        x, wrench = record.x[: len(self.geometry.vert), 0].numpy(), record.wrench[0, 0].numpy()
        return Solved(x, pressure, wrench, record.touches.numpy())

    def outcome_of_step(self, step: Solved) -> np.ndarray:
        """(7,) of `outcome_of`."""
        middle = torch.from_numpy(self.middle(step.touches))
        return outcome_of(torch.from_numpy(step.wrench), middle).numpy()

    def outcome_slopes(self, step: Solved, wrench: np.ndarray) -> np.ndarray:
        """(k, 7) derivatives of `outcome_of` from those of the wrench (k, 6), at the same middle."""
        middle = torch.from_numpy(self.middle(step.touches))
        outcome = functools.partial(outcome_of, middle=middle)
        slopes = torch.autograd.functional.jacobian(outcome, torch.from_numpy(step.wrench))
        return wrench @ slopes.numpy().T

    def path(self, along: float, around: float, fraction: float = 1.0) -> Steps:
        """The steps of a press at a position [m], [rad]."""
        point, samples = self.capsule.at(along, around), len(_FRACTIONS) - 1
        plan = plan_indentation(self._indenter, point, _DEEPEST, 0.0, samples=samples, skin=self.geometry)
        part = fraction * deepest(plan, self._core_samples) / _DEEPEST
        return steps_of(dataclasses.replace(plan, tip=plan.tip[0] + part * (plan.tip - plan.tip[0])))[0]

    def middle(self, touches: np.ndarray) -> np.ndarray:
        """(3,) mean of samples given by number, on the skin at rest [m]."""
        skin = self.skin
        face, weight = touches // len(skin.weights), skin.weights[touches % len(skin.weights)]
        corner = self.geometry.vert[skin.data.outer.surface.face_np[face]]
        return np.einsum("ma,mak->mk", weight, corner).mean(0)

    def _make(self):
        """The table: (along, around, fraction, ...) of each attribute, with the outcome's force divided by
        the fraction."""
        capsule, width = self.capsule, self.geometry.design.nelectrode + 1
        shape = len(capsule.along), len(capsule.around), len(_FRACTIONS)
        widths = {"signal": (width,), "outcome": (7,)}
        if self._slopes:
            widths |= {"by_press": (3, width), "by_sensor": (3, width), "outcome_by": (3, 7)}
        of_films = [name for name in ("signal", "by_press", "by_sensor") if name in widths]
        table = {name: np.zeros((*shape, *width)) for name, width in widths.items()}
        n = len(self.geometry.vert)
        films = _Films(self.geometry, self.skin.model.rest.vert[:n], self._slopes)
        places = list(itertools.product(enumerate(capsule.along), enumerate(capsule.around)))
        shown = self._progress and self._slopes
        if shown:
            text = f"note: simulating {len(places)} presses all over the skin once, 2.5 s each on one core"
            print(text, file=sys.stderr, flush=True)  # a bar is hidden where stderr is a file
        for (i, along), (j, around) in tqdm(places, "table, once", unit="press", disable=not shown or None):
            with self.skin.lock:
                if self._slopes:
                    trajectory, steps = self.simulate(along, around)
                    tangents = push_forward(self.skin, trajectory, self._tangents(steps, around))
                    solved = [self.solved(record, trajectory.rest) for record in trajectory.steps]
                else:
                    steps = self.path(along, around)
                    solved = list(self.approximate(steps.pos, steps.mat))
            for k, end in enumerate(steps.ends[1:], start=1):
                step, here = solved[end], (i, j, k)
                directions = tangents.nodes[:, 0, end, :n] if self._slopes else None
                try:
                    read = films.read(step.x, directions)
                except NoFilmError:  # deeper than the film allows: use the deepest valid one
                    read = [table[name][i, j, k - 1, ..., :-1] for name in of_films]
                for name, value in zip(of_films, read):
                    table[name][here][..., :-1] = value
                table["signal"][here][-1] = 1e-3 * step.pressure
                table["outcome"][here] = self.outcome_of_step(step)
                table["outcome"][here][0] -= np.log(_FRACTIONS[k])
                if self._slopes:
                    table["by_press"][here][:, -1] = 1e-3 * tangents.pressure[:, 0, end]
                    table["outcome_by"][here] = self.outcome_slopes(step, tangents.wrench[:, 0, end, 0])
        for name in {"outcome", "outcome_by"} & table.keys():
            table[name][:, :, 0] = table[name][:, :, 1]
        return table

    def _tangents(self, steps, around):
        """Tangents of the path for two tilts about its start, and of the fill."""
        pose = np.zeros((3, 1, len(steps.pos), 1, 6))
        for k, axis in enumerate(frame_of(steps, around)):
            pose[k, 0, :, 0] = np.concatenate(
                [np.cross(axis, steps.pos[:, 0] - steps.pos[0, 0]), np.tile(axis, (len(steps.pos), 1))], 1
            )
        own = self.skin.own
        numbers = {name: np.zeros((3, 1)) for name in own}
        if self.skin.model.has_liquid:
            numbers["natural"][2], numbers["kappa"][2] = _FILL, -own["kappa"] / own["natural"] * _FILL
        return Inputs(pose, np.zeros((3, 1, 1)), numbers)


class _Films:
    """Electrode readings of a skin, for its own sensor and, with slopes, changed ones; rest: (nvert, 3) nodes
    without contact [m]."""

    def __init__(self, geometry, rest, slopes):
        core, at = CoreSurface(geometry.core_vert, geometry.core_face), geometry.electrode_pos
        films = [FilmConduction(geometry)]
        self._own, self._own_rest = films[0], np.log(films[0].impedance(rest))
        if not slopes:
            return
        films += [FilmConduction(geometry, residual_film=floor) for floor in _FLOORS]
        for axis in np.eye(3)[[0, 2]]:
            for size in (-_MOVED, _MOVED):
                _, foot, face = core.closest(at + size * axis)
                moved = {"electrode_pos": foot, "electrode_normal": core.normal[face]}
                films.append(FilmConduction(dataclasses.replace(geometry, **moved)))
        self._others = films[1:]
        self._rest = [np.log(film.impedance(rest)) for film in self._others]
        steps_apart = np.array([np.log(_FLOORS[1] / _FLOORS[0]), 2e3 * _MOVED, 2e3 * _MOVED])
        self._steps_apart = steps_apart[:, None]

    def read(self, x: np.ndarray, directions: np.ndarray | None) -> tuple[np.ndarray, ...]:
        """Changes of ln Z from rest (nelectrode,); with directions (k, nvert, 3) of the nodes also their
        derivatives along these (k, nelectrode), and by changes of the sensor (3, nelectrode)."""
        if directions is None:
            return (np.log(self._own.impedance(x)) - self._own_rest,)
        value, slopes = slopes_of_film(self._own, x, directions)
        others = [np.log(film.impedance(x)) - rest for film, rest in zip(self._others, self._rest)]
        by_other = (np.array(others[1::2]) - others[::2]) / self._steps_apart
        return value - self._own_rest, slopes, by_other
