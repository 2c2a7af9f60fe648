"""A table of states of the skin under a flat plate: direction of the plate, drag during the approach, load.

A large plate has no location of its own: its contact follows from its direction. So a state has four numbers
besides the force (pitch, roll and two drags), and the force, which is measured, is a coordinate of the table
instead of a result. Forces are divided by Young's modulus: with a liquid of constant volume and a contact
stiffness proportional to E, a skin twice as stiff has the same shapes at twice the force."""

import dataclasses

import numpy as np
from tqdm import tqdm

from ..cache import cached
from ..geometry.design import BIOTAC, Design
from ..geometry.skin_geometry import SkinGeometry
from ..skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, step
from ..skin.model import filled

_STEP = 1.6e-4  # [m] step towards the core
_DEEPEST = 4.5e-3  # [m] from first touch: more than skin and gap
_LOST = 3  # steps without equilibrium that end a path


@dataclasses.dataclass(frozen=True)
class PlateGrid:
    """Grid of a table of states.

    Attributes:
      pitch: angle of the plate from the pad towards the tip [rad], increasing.
      roll: of the plate about the finger's axis, to +z, from 0 on [rad]; the other side is the mirror image.
      drag: ratio of tangential and normal motion of the plate, increasing and above 0: each direction is
        approached straight and with these drags to both sides, along the finger and across it; (): no drag.
      load: normal force over Young's modulus, increasing [m^2].
    """

    pitch: tuple = tuple(np.radians([0, 5, 9, 14, 20, 30]).tolist())
    roll: tuple = tuple(np.radians([0, 13, 26, 40]).tolist())
    drag: tuple = (0.7, 1.4)
    load: tuple = tuple((np.geomspace(0.25, 24, 12) / 1.55e6).tolist())

    def __post_init__(self):
        for name in ("pitch", "roll", "load"):
            value = np.array(getattr(self, name), float)
            if value.ndim != 1 or len(value) < 2 or not (np.diff(value) > 0).all():
                raise ValueError(f"{name} of a plate's grid is {getattr(self, name)}: give rising numbers")
        drag = np.array([0.0, *self.drag])
        if self.roll[0] != 0 or self.load[0] <= 0 or not (np.diff(drag) > 0).all():
            raise ValueError(
                "a plate's grid needs rolls from 0 on, loads above 0 and a drags that rise above 0"
            )

    @property
    def drag_paths(self) -> np.ndarray:
        """(npath, 2) drag along the finger (towards the tip) and across it (to +z): none, then each to both
        sides, first all along it."""
        both = np.array([[d, -d] for d in self.drag]).ravel()
        none = np.zeros_like(both)
        return np.concatenate([np.zeros((1, 2)), np.stack([both, none], 1), np.stack([none, both], 1)])


@dataclasses.dataclass(frozen=True, eq=False)
class PlateStates:
    """States of one skin.

    Attributes:
      grid: its axes.
      node: (n,) nodes of the skin's inner surface. rest: (n, 3) their rest positions [m].
      xpos: (npitch, nroll, npath, nload, n, 3) their positions [m], single precision.
      force: (..., nload, 3) of the plate on the skin over Young's modulus, along the finger (towards the
        tip), across (to +z), towards the core [m^2].
      pressure: (..., nload) of the liquid over Young's modulus.
      reached: (npitch, nroll, npath) largest load of a path [m^2]; states beyond repeat its last.
      depth: (..., nload) travel of the plate towards the core from first touch [m].
      design: of the skin.
    """

    grid: PlateGrid
    node: np.ndarray
    rest: np.ndarray
    xpos: np.ndarray
    force: np.ndarray
    pressure: np.ndarray
    reached: np.ndarray
    depth: np.ndarray
    design: Design = BIOTAC

    def on(self, grid: PlateGrid) -> "PlateStates":
        """The states on a subgrid in pitch, roll and drag.

        Raises:
          ValueError: the grid has other values, or other loads.
        """
        mine, found = self.grid, []
        pairs = (mine.pitch, grid.pitch), (mine.roll, grid.roll), (mine.drag_paths, grid.drag_paths)
        for have, wanted in pairs:
            have, wanted = (np.array(v, float).reshape(len(v), -1) for v in (have, wanted))
            off = np.abs(have[:, None] - wanted).sum(-1)
            found.append(off.argmin(0))
            if off.min(0).max() > 1e-9 or grid.load != mine.load:
                raise ValueError("a grid has other pitches, rolls, drags or loads: choose among these")
        at = np.ix_(*found)
        parts = (getattr(self, name)[at] for name in ("xpos", "force", "pressure", "reached", "depth"))
        return PlateStates(grid, self.node, self.rest, *parts, self.design)


def frame(pitch: float, roll: float) -> np.ndarray:
    """(3, 3), rows in the BioTac frame: towards the tip along the plate, across it (to +z), from the plate to
    the core."""
    sp, cp, sr, cr = np.sin(pitch), np.cos(pitch), np.sin(roll), np.cos(roll)
    inwards = np.array([sp, cp * cr, -cp * sr])
    along = np.array([-cp, sp * cr, -sp * sr])
    return np.array([along, [0.0, sr, cr], inwards])


def plate_states(
    geometry: SkinGeometry,
    material: Material,
    options: SkinOptions | None = None,
    grid: PlateGrid | None = None,
    quiet: bool = False,
) -> PlateStates:
    """The table of a skin, cached on disk pitch by pitch, so that an interrupted run continues. Skins that
    differ only in Young's modulus share it; for a filled one the table holds for a filling proportional to E.

    Raises:
      ValueError: a rate-dependent material: states are equilibria.
    """
    grid, options = grid or PlateGrid(), filled(options or SkinOptions(), material)
    if material.remembers:
        raise ValueError("a table of states has no rate effects: leave prony, mullins and hysteresis out")
    if not options.rest_pressure and options.contact_stiffness is None:  # else shapes do not scale with E
        material = dataclasses.replace(material, youngs_modulus=Material().youngs_modulus)
    node = np.unique(geometry.inner_face)
    model = SkinModel(geometry, material, options)
    drag_paths = np.array([(roll, *drag_path) for roll in grid.roll for drag_path in grid.drag_paths])
    parts = []
    for pitch in tqdm(grid.pitch, desc="states of a plate", unit="pitch", disable=quiet or None):

        def make(pitch=pitch):
            axes = np.array([frame(pitch, roll) for roll in drag_paths[:, 0]])
            return _press(model, node, axes, drag_paths[:, 1:], np.array(grid.load))

        inputs = [geometry, material, options, pitch, drag_paths, grid.load]
        parts.append(cached("plate-states", inputs, make, ("geometry", "skin", "matching/states")))
    shape = len(grid.pitch), len(grid.roll), len(grid.drag_paths)
    stacked = {key: np.stack([p[key] for p in parts]) for key in parts[0]}
    found = {k: v.reshape(*shape, *v.shape[2:]) for k, v in stacked.items()}
    return PlateStates(grid, node, model.rest.vert[node], **found, design=geometry.design)


def _press(model, node, axes, drag_paths, load):
    """States along drag paths (npath, 2) of plates with directions axes (npath, 3, 3), one per world: xpos
    (npath, nload, n, 3), force, pressure, depth, reached."""
    npath, E = len(drag_paths), model.material.youngs_modulus
    data = SkinData(model, npath)
    geoms = GeomSet(["plane"], [(0, 0, 0)], nworld=npath)
    geoms.set_friction([model.material.friction])
    outer = np.unique(model.geometry.outer_face)
    along, across, inwards = np.swapaxes(axes, 0, 1)
    start = (model.rest.vert[outer] @ inwards.T).min(0)[:, None] * inwards
    push = drag_paths[:, :1] * along + drag_paths[:, 1:] * across + inwards
    mat = np.stack([along, np.cross(inwards, along), inwards], 2)[:, None]
    rest = model.rest.vert[node]
    track = [[(0.0, rest, np.zeros(3), 0.0, 0.0)] for _ in range(npath)]
    going, lost, depth = np.ones(npath, bool), np.zeros(npath, int), np.zeros(npath)
    while going.any():
        depth[going] += _STEP
        geoms.set_pose((start + depth[:, None] * push)[:, None], mat)
        step(model, data, geoms)
        wrench, pressure, x = data.wrench[:, 0, :3], data.pressure, data.vert_xpos[:, node]
        good = data.converged
        lost = np.where(good, 0, lost + 1)
        for w in np.flatnonzero(going & good):
            force = -axes[w] @ wrench[w] / E
            if force[2] > track[w][-1][0]:
                track[w].append((force[2], x[w], force, pressure[w] / E, depth[w]))
        top = np.array([t[-1][0] for t in track])
        going &= (top < load[-1]) & (depth < _DEEPEST) & (lost < _LOST)
    columns = ("xpos", "force", "pressure", "depth")
    out = {"reached": top} | {name: [] for name in columns}
    for t in track:
        at = np.array([row[0] for row in t])
        k = np.clip(np.searchsorted(at, load), 1, len(at) - 1)
        f = np.clip((load - at[k - 1]) / (at[k] - at[k - 1]), 0, 1)
        for column, name in enumerate(columns, 1):
            value = np.array([row[column] for row in t])
            weight = f.reshape(-1, *[1] * (value.ndim - 1))
            out[name].append((1 - weight) * value[k - 1] + weight * value[k])
    out["xpos"] = np.array(out["xpos"], np.float32)
    return {key: np.array(value) for key, value in out.items()}
