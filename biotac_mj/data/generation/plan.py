"""Plans motions of objects: random presses, slides, twists and taps all over the sensing surface, clear of
the core."""

import dataclasses

import numpy as np
from scipy.spatial import cKDTree

from ...fields import check_choice
from ...geometry.core_surface import CoreSurface
from ...geometry.rigid import matrix, quaternion_from_y, rotation
from ...geometry.skin_geometry import SkinGeometry
from ...press.approach import normal_at
from ..objects import OBJECTS, make_object
from .clearance import Placed, first_touch, surface_samples

KINDS = ("press", "slide", "twist", "tap")
_PROBABILITY = (0.4, 0.3, 0.15, 0.15)
_TILT = np.radians(25.0)  # largest angle between the press and the skin's inward normal
_DEPTH = {
    "press": (0.4e-3, 2.4e-3),
    "slide": (0.4e-3, 1.6e-3),
    "twist": (0.4e-3, 1.6e-3),
    "tap": (0.2e-3, 1.2e-3),
}  # [m]
_SLIDE = (0.8e-3, 3e-3)  # [m]
_TWIST = np.radians((10.0, 35.0))
_BACK = 0.05  # [m] distance from which objects approach
_LEAD = 5e-6  # [m] distance of row 0 before first touch
# [m] least distance from the core: the skin is 1.5 mm thick there; forces reach some 20 N, as in the paper
_CLEAR = 0.6e-3
_FILM = 0.1e-3  # [m] least film under the sensing surface
_SHALLOW = 0.1e-3  # [m] least depth


@dataclasses.dataclass(frozen=True)
class Motion:
    """Path of one object, n time steps.

    Attributes:
      kind: of KINDS. parameters: as stored, JSON types.
      pos: (n, 3) of the object's frame [m]. mat: (n, 3, 3) its orientation.
    """

    kind: str
    parameters: dict
    pos: np.ndarray
    mat: np.ndarray


def sensing_faces(geometry: SkinGeometry) -> np.ndarray:
    """(k,) outer faces over liquid: in front of the clamp, if there is one (x < 3 mm), below the nail (y <
    0.5 mm), over more than 0.1 mm of film."""
    centre = geometry.vert[geometry.outer_face].mean(1)
    inner = np.unique(geometry.inner_face)
    gap = CoreSurface(geometry.core_vert, geometry.core_face).closest(geometry.vert[inner])[0]
    wet = (gap > _FILM) & ~np.isin(inner, geometry.fixed)
    beneath = cKDTree(geometry.vert[inner]).query(centre)[1]
    front = centre[:, 0] < (3e-3 if len(geometry.clamp_face) else np.inf)
    return np.flatnonzero(front & (centre[:, 1] < 0.5e-3) & wet[beneath])


def plan_motions(
    geometry: SkinGeometry,
    name: str,
    seeds: list,
    steps: int,
    kinds: tuple | list = KINDS,
    device: str = "cpu",
) -> list[Motion]:
    """One motion for each seed, independent of the others.

    Args:
      geometry: the skin at rest.
      name: of the object.
      seeds: lists of ints, see numpy's SeedSequence.
      steps: rows of each motion, row 0 just before first touch.
      kinds: of KINDS, to choose from.

    Raises:
      ValueError: unknown kind, too few steps, or no admissible motion.
    """
    for kind in kinds:
        check_choice("unknown kind of interaction", kind, KINDS)
    if steps < 8:
        raise ValueError(f"{steps} steps are too few for an interaction: take at least 8")
    planner = _Planner(geometry, name, steps, kinds, device)
    motions = [None] * len(seeds)
    for attempt in range(40):
        open_ = [i for i, motion in enumerate(motions) if motion is None]
        if not open_:
            return motions
        for i, motion in zip(open_, planner.draw([[*seeds[i], attempt] for i in open_])):
            motions[i] = motion
    raise ValueError(
        f"object {name!r} finds no room to touch the skin without meeting the core: make it smaller"
    )


class _Planner:
    def __init__(self, geometry, name, steps, kinds, device):
        self.geometry, self.name, self.steps, self.device = geometry, name, steps, device
        # [m] of the foremost point ahead of the object's frame; OBJECTS have it at the origin
        self.tip = 0.0 if name in OBJECTS else make_object(name).vert[:, 1].max()
        self.kinds = list(kinds)
        probability = np.array([_PROBABILITY[KINDS.index(kind)] for kind in self.kinds])
        self.probability = probability / probability.sum()
        self.faces = geometry.outer_face[sensing_faces(geometry)]
        edge = geometry.vert[self.faces[:, 1:]] - geometry.vert[self.faces[:, :1]]
        area = np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1)
        self.area = area / area.sum()
        self.skin = surface_samples(geometry.vert, geometry.outer_face, device)
        self.core = surface_samples(geometry.core_vert, geometry.core_face, device, order=1)

    def draw(self, seeds):
        """A Motion or None for each seed."""
        drawn = [self._draw(np.random.default_rng(seed)) for seed in seeds]
        point, direction, mat = (np.array([d[key] for d in drawn]) for key in ("point", "direction", "mat"))
        point = point - self.tip * direction  # of the object's frame, when its tip is at the skin
        placed = Placed(self.name, len(drawn), self.device)
        travel = first_touch(placed, self.skin, point - _BACK * direction, mat, direction)
        start = point + (travel - _BACK)[:, None] * direction
        depth = np.array([d["depth"] for d in drawn])
        met = np.isfinite(travel) & (
            np.abs(travel - _BACK) < 4e-3
        )  # the object's tip touches, not its far end
        start[~met] = 1.0  # [m] out of reach
        paths = Placed(self.name, len(drawn) * self.steps, self.device)
        for _ in range(8):
            pos, turned = self._paths(drawn, start, depth)
            paths.place(pos.reshape(-1, 3), turned.reshape(-1, 3, 3))
            lack = _CLEAR - paths.nearest(self.core).reshape(len(drawn), -1).min(1)
            if not (lack > 1e-5).any():
                break
            depth -= np.where(lack > 1e-5, 1.1 * np.maximum(lack, 2e-5), 0)
        good = met & (lack <= 1e-5) & (depth >= _SHALLOW)
        out = []
        for i, d in enumerate(drawn):
            parameters = {
                key: np.asarray(value).tolist()
                for key, value in d.items()
                if key not in ("mat", "kind", "profile")
            }
            parameters |= {"depth": float(depth[i]), "start": start[i].tolist()}
            out.append(Motion(d["kind"], parameters, pos[i], turned[i]) if good[i] else None)
        return out

    def _draw(self, rng):
        kind = str(rng.choice(self.kinds, p=self.probability))
        corner = self.geometry.vert[self.faces[rng.choice(len(self.faces), p=self.area)]]
        point = rng.dirichlet(np.ones(3)) @ corner
        normal = normal_at(self.geometry, point)
        first, second = _across(normal)
        # uniform over the cap of directions around the inward normal
        tilt, round_ = np.arccos(rng.uniform(np.cos(_TILT), 1)), rng.uniform(0, 2 * np.pi)
        side = np.cos(round_) * first + np.sin(round_) * second
        direction = -np.cos(tilt) * normal + np.sin(tilt) * side
        spin = rng.uniform(0, 2 * np.pi)
        mat = rotation(spin * direction[None])[0] @ matrix(quaternion_from_y(direction))
        heading = rng.uniform(0, 2 * np.pi)
        slide = np.cos(heading) * first + np.sin(heading) * second
        return dict(
            kind=kind,
            point=point,
            direction=direction,
            mat=mat,
            spin=spin,
            depth=rng.uniform(*_DEPTH[kind]),
            slide_direction=slide,
            slide=rng.uniform(*_SLIDE) * (kind == "slide"),
            twist=rng.uniform(*_TWIST) * rng.choice([-1, 1]) * (kind == "twist"),
            profile=_profile(kind, self.steps, rng),
        )

    def _paths(self, drawn, start, depth):
        """Positions (k, n, 3) and orientations (k, n, 3, 3)."""
        pos, mat = [], []
        for d, at, deep in zip(drawn, start, depth):
            down, along = d["profile"]
            travel = down * deep
            travel[0] = -_LEAD
            pos.append(
                at + travel[:, None] * d["direction"] + (along * d["slide"])[:, None] * d["slide_direction"]
            )
            mat.append(rotation((along * d["twist"])[:, None] * d["direction"]) @ d["mat"])
        return np.array(pos), np.array(mat)


def _profile(kind, steps, rng):
    """Fractions of depth (n,) and of sliding distance (n,) at each time step."""
    last = steps - 1
    step = np.arange(steps)
    if kind == "tap":
        count = int(rng.integers(2, 4))
        phase = step * count / last
        return 1 - np.abs(2 * (phase - np.floor(phase)) - 1), np.zeros(steps)
    if kind == "press":
        # press only, or press and release
        turn = last if rng.random() < 0.5 else int(round(rng.uniform(0.5, 0.8) * last))
        return np.interp(step, [0, turn, last], [0, 1, 1 if turn == last else rng.uniform(0, 0.6)]), np.zeros(
            steps
        )
    turn = int(round(rng.uniform(0.35, 0.5) * last))
    return np.minimum(step / turn, 1), np.maximum(step - turn, 0) / (last - turn)


def _across(normal):
    """Two unit vectors orthogonal to a unit vector."""
    helper = np.eye(3)[np.abs(normal).argmin()]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)
