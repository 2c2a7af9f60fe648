"""Presses of a geom all over a skin: what the sensor tells of each, what there is to be told, and the slopes
of both.

Places lie on a capsule about the finger, moved to the skin. Every press goes along the inward normal, and at
most so deep that the core stays clear. They are simulated once and kept on disk; between them are splines."""

import dataclasses
import functools
import pathlib

import numpy as np
import torch
from scipy.interpolate import RegularGridInterpolator

from ...calibration import plan_indentation
from ...calibration.forward import Steps, steps_of
from ...geometry.skin_geometry import SkinGeometry
from ...sensor.channels import NELECTRODE
from ...sensor.core_surface import CoreSurface
from ...sensor.film import EXCITATION, FilmConduction, NoFilmError
from ...skin.cache import kept
from ..press import numbers_of
from ..record import Trajectory, follow
from ..skin import Skin
from ..sweep import Inputs, push_forward

__all__ = ["SIGNALS", "Presses", "outcome_of"]

SIGNALS = NELECTRODE + 1  # changes of ln Z, and of the liquid's pressure [kPa]
_TIP, _RADIUS = -14.5e-3, 7.2e-3  # [m] of a capsule about the x axis that is a finger's skin, roughly
_ROUND = np.radians([85, 64, 43, 21])  # of the tip
_ALONG = np.concatenate([_TIP - _RADIUS * _ROUND, np.linspace(_TIP, 3e-3, 7)])  # [m] on the capsule
_AROUND = np.radians(np.linspace(-92, 92, 8))
_SHARES = np.linspace(0, 1, 8)  # of the deepest press
_DEEPEST, _CLEAR = 2.6e-3, 0.6e-3  # [m] of a press, from the core: as `data.generation.plan` presses
_FINER = 2  # points for each of the table's
_LIGHTEST = 1 / 32  # share at which the lightest press is
_FILL = 1e-9  # [m^3] the unit of slopes by the fill
_WET = 0.1e-3  # [m] less liquid is none: the skin is bonded there
# Of sensors over which the electrodes' answers are made linear, as far as they spread: tilts [rad], fill [ul]
# and Poisson's ratio; residual film in the middle [m] and of its ln; ways of electrodes, together and
# each [m]; of X1 to X4 [m], [rad]; relief of the skin and how far it is alike [m]. The ranges that real
# sensors showed, as `data.generation.synthetic_sensor` has them with their sources
_SENSORS, _WAVES = 64, 64
_SPREADS = 0.2, 0.2, 67.0, 0.0375
_FILM, _FLOOR, _SHIFT, _EACH = 45e-6, 0.65, 0.58e-3, 0.3e-3
_CURRENT, _RELIEF, _LENGTH = (0.7e-3, 0.1), 0.2e-3, 2.7e-3


def outcome_of(wrench: torch.Tensor, middle: torch.Tensor) -> torch.Tensor:
    """(7,) of a press: ln of the force [N], the contact's centre [m], the force's direction.

    Args:
      wrench: (6,) of the skin on the geom. middle: (3,) of the samples that touch, on the resting skin [m],
        beside which the centre is on the force's line.
    """
    force, torque = wrench[:3], wrench[3:]
    along = force / force.norm()
    centre = torch.linalg.cross(force, torque) / (force @ force) + along * (along @ middle)
    return torch.cat([force.norm().log()[None], centre, -along])


class Presses:
    """n presses, at the table's points and between them.

    Args:
      skin: under one geom. geometry: of it. indenter: the geom, as `biotac press --indenter`.

    Attributes:
      signal: (n, SIGNALS), in the mean over sensors. by_press: (n, 4, SIGNALS) of it by two tilts of the way
        [rad], the fill [ul] and Poisson's ratio.
      by_sensor: (n, 4, SIGNALS) by ln of the residual film, by electrodes that lie further along and across
        the finger [mm], and by liquid that is thicker everywhere [0.1 mm].
      outcome: (n, 7) of `outcome_of`. outcome_by: (n, 4, 7) of it by what `by_press` is by.
      weight: (n,) ln of the share of the skin that each stands for.
    """

    def __init__(self, skin: Skin, geometry: SkinGeometry, indenter: str):
        self._skin, self._geometry, self._indenter = skin, geometry, indenter
        self._filled = dataclasses.replace(geometry, vert=skin.model.rest.vert[: len(geometry.vert)])
        self._core = CoreSurface(geometry.core_vert, geometry.core_face)
        axes = _ALONG, _AROUND, _SHARES
        made_of = skin.model.material, skin.model.options, indenter, pathlib.Path(__file__).read_bytes()
        inputs = [geometry.vert, geometry.elem, *made_of, *axes]
        table = kept("presses", inputs, self._make)
        along, around, share = (
            np.interp(np.arange((len(a) - 1) * _FINER + 1) / _FINER, np.arange(len(a)), a) for a in axes
        )
        share[0] = _LIGHTEST
        at = np.stack(np.meshgrid(along, around, share, indexing="ij"), -1).reshape(-1, 3)
        self.signal, self.by_press, self.by_sensor, self.left, self.outcome, self.outcome_by = (
            RegularGridInterpolator(axes, table[name], method="linear" if name == "left" else "cubic")(at)
            for name in ("signal", "by_press", "by_sensor", "left", "outcome", "outcome_by")
        )
        self.outcome[:, 0] += np.log(at[:, 2])
        self.weight = np.log(np.cos(np.maximum(0, (_TIP - at[:, 0]) / _RADIUS)))

    def simulate(self, along: float, around: float, share: float = 1.0) -> tuple[Trajectory, Steps]:
        """A press at a place [m], [rad]: its steps, and their way."""
        turn = max(0.0, (_TIP - along) / _RADIUS)
        out = np.array([-np.sin(turn), -np.cos(turn) * np.cos(around), np.cos(turn) * np.sin(around)])
        point = _RADIUS * out + [max(along, _TIP), 0, 0]

        def plan(depth):
            samples = len(_SHARES) - 1
            return plan_indentation(self._indenter, point, depth, 0.0, samples=samples, skin=self._filled)

        gap = self._core.closest(plan(_DEEPEST).tip[:1])[0][0]
        steps, skin = steps_of(plan(share * min(_DEEPEST, gap - _CLEAR)))[0], self._skin
        incompressible = np.isinf(skin.model.options.bulk_modulus)
        return follow(skin, steps.pos, steps.mat, skin.friction, skin.own, incompressible), steps

    def middle(self, touches: np.ndarray) -> np.ndarray:
        """(3,) of samples by number, on the resting skin [m]."""
        skin = self._skin
        face, weight = touches // len(skin.weights), skin.weights[touches % len(skin.weights)]
        corner = self._geometry.vert[skin.data.outer.surface.face_np[face]]
        return np.einsum("ma,mak->mk", weight, corner).mean(0)

    def _make(self):
        """The table: (along, around, share, ...) of each attribute, the force of the outcome over the
        share."""
        shape = len(_ALONG), len(_AROUND), len(_SHARES)
        widths = {
            "signal": (SIGNALS,), "by_press": (4, SIGNALS), "by_sensor": (4, SIGNALS), "left": (NELECTRODE,),
            "outcome": (7,), "outcome_by": (4, 7),
        }  # fmt: skip
        table = {name: np.zeros((*shape, *width)) for name, width in widths.items()}
        films, n = None, len(self._geometry.vert)
        for i, along in enumerate(_ALONG):
            for j, around in enumerate(_AROUND):
                with self._skin.lock:
                    trajectory, steps = self.simulate(along, around)
                    ahead = push_forward(self._skin, trajectory, self._tangents(steps, around))
                rest = trajectory.rest
                begun = ahead.nodes[:, steps.ends[0], :n]  # untouched
                films = films or _Films(self._geometry, trajectory.steps[steps.ends[0]].x[:n], begun)
                begin = rest.pressure if rest else 0.0
                for k, end in enumerate(steps.ends[1:], start=1):
                    record, here = trajectory.steps[end], (i, j, k)
                    read = films.read(record.x[:n], ahead.nodes[:, end, :n])
                    if read is None:  # beyond what can be read, as deep as it can
                        read = tuple(table[name][i, j, k - 1, ..., :NELECTRODE] for name in list(widths)[:4])
                    for name, value in zip(widths, read):
                        table[name][here][..., :NELECTRODE] = value
                    table["signal"][here][-1] = 1e-3 * (record.pressure - begin)
                    table["by_press"][here][:, -1] = 1e-3 * ahead.pressure[:, end]
                    wrench, middle = (
                        torch.from_numpy(a.copy()) for a in (record.wrench[0], self.middle(record.touches))
                    )
                    slopes = torch.autograd.functional.jacobian(
                        functools.partial(outcome_of, middle=middle), wrench
                    )
                    table["outcome"][here] = outcome_of(wrench, middle).numpy()
                    table["outcome"][here][0] -= np.log(_SHARES[k])
                    table["outcome_by"][here] = ahead.wrench[:, end, 0] @ slopes.numpy().T
        for name in ("outcome", "outcome_by"):
            table[name][:, :, 0] = table[name][:, :, 1]
        return table

    def _tangents(self, steps, around):
        """Two tilts of the way about its beginning, the fill and Poisson's ratio."""
        way = steps.pos[0, 0] - steps.pos[-1, 0]
        way = way / np.linalg.norm(way)
        first = np.array([0, np.sin(around), np.cos(around)])
        first -= way * (way @ first)
        first /= np.linalg.norm(first)
        pose = np.zeros((4, len(steps.pos), 1, 6))
        for k, axis in enumerate((first, np.cross(way, first))):
            pose[k, :, 0] = np.concatenate(
                [np.cross(axis, steps.pos[:, 0] - steps.pos[0, 0]), np.tile(axis, (len(steps.pos), 1))], 1
            )
        own, skin = self._skin.own, self._skin
        numbers = {name: np.zeros(4) for name in own}
        if skin.model.has_liquid:
            numbers["natural"][2], numbers["kappa"][2] = _FILL, -own["kappa"] / own["natural"] * _FILL

        def of_rubber(ratio):
            given = numbers_of(skin, {"poissons_ratio": ratio})
            return torch.stack([given["mu"], given["lam"]])

        ratio = torch.tensor(skin.model.material.poissons_ratio, dtype=torch.float64)
        slopes = torch.autograd.functional.jacobian(of_rubber, ratio)
        numbers["mu"][3], numbers["lam"][3] = slopes.tolist()
        return Inputs(pose, np.zeros((4, 1)), numbers)


class _Films:
    """What the electrodes of many sensors read, and how that goes with what is each sensor's own.

    Args:
      geometry: of the skin. rest: (nvert, 3) nodes untouched [m]. ways: (4, nvert, 3) of these by two tilts
        [rad], the fill [ul] and Poisson's ratio.
    """

    def __init__(self, geometry, rest, ways):
        draw, core = np.random.default_rng(0), CoreSurface(geometry.core_vert, geometry.core_face)
        gap, above, _ = core.closest(rest)
        out = (rest - above) / np.maximum(gap, _WET)[:, None] * (gap > _WET)[:, None]
        self._ways = draw.normal(size=(_SENSORS, 4)) * _SPREADS
        self._films, self._thicker, own = [], [], []
        for way in self._ways:
            floor = draw.normal(0, _FLOOR)
            moved = draw.normal(0, _SHIFT, 3) * [1, 0, 1] + draw.normal(0, _EACH, (NELECTRODE, 3))
            current = np.array(EXCITATION) + draw.uniform(-1, 1, (4, 2)) * _CURRENT
            wave, phase = draw.normal(size=(_WAVES, 3)) / _LENGTH, draw.uniform(0, 2 * np.pi, _WAVES)

            def relief(at, wave=wave, phase=phase):
                return _RELIEF * np.sqrt(2 / _WAVES) * np.cos(at @ wave.T + phase).sum(1)

            thin = _FILM * np.exp(floor)
            film, foot = self._film(geometry, core, moved, residual_film=thin, excitation=current)
            thicker = relief(above)[:, None] * out
            self._films.append((film, np.log(film.impedance(rest + thicker + np.tensordot(way, ways, 1)))))
            self._thicker.append(thicker)
            along, _, across = 1e3 * (foot - geometry.electrode_pos).T
            own.append([np.full(NELECTRODE, floor), along, across, 1e4 * relief(foot)])
        own = np.moveaxis(own, 2, 0)  # of each electrode: sensors, what is their own
        ways = np.broadcast_to(self._ways, (NELECTRODE, *self._ways.shape))
        self._by = np.concatenate([np.ones((NELECTRODE, _SENSORS, 1)), ways, own], 2)
        self._inverse = np.linalg.pinv(self._by)

    @staticmethod
    def _film(geometry, core, moved, **of):
        """A film under electrodes that are moved (19, 3) [m] as far as there is liquid over them, and where
        they are."""
        for share in (1.0, 0.75, 0.5, 0.25, 0.0):
            _, foot, face = core.closest(geometry.electrode_pos + share * moved)
            there = dataclasses.replace(geometry, electrode_pos=foot, electrode_normal=core.normal[face])
            try:
                return FilmConduction(there, **of), foot
            except ValueError:
                if not share:
                    raise

    def read(self, x: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, ...] | None:
        """Regression over sensors of the changes of ln Z from rest with nodes x (nvert, 3) and their ways
        (4, nvert, 3): in the mean (19,), by the ways (4, 19), by what is the sensor's own (4, 19), and what
        is left (19,), RMS. None: too few have a film."""
        kept, change = [], []
        for k, ((film, rest), thicker) in enumerate(zip(self._films, self._thicker)):
            try:
                read = film.impedance(x + thicker + np.tensordot(self._ways[k], ways, 1))
            except NoFilmError:
                continue
            kept.append(k)
            change.append(np.log(read) - rest)
        by, change = self._by[:, kept], np.array(change).T
        spare = len(kept) - by.shape[2]
        if spare < len(self._films) // 2:
            return None
        inverse = self._inverse if len(kept) == len(self._films) else np.linalg.pinv(by)
        found = np.einsum("eck,ek->ec", inverse, change)
        left = change - np.einsum("ekc,ec->ek", by, found)
        found = found.T
        return found[0], found[1:5], found[5:], np.sqrt((left**2).sum(1) / spare)
