"""Records of a press of all worlds of a skin, step by step, with all data for its gradient: the initial and
final state of every step. No step is solved twice."""

import dataclasses
import math

import numpy as np
import torch
import warp as wp

from ..skin import GeomSet, step
from ..skin.program import Launcher
from ..skin.state import SavedState
from .memory_constants import relaxed, write_constants
from .skin import NUMBERS, SkinWorlds
from .touching import Anchors, at_sharp_edges, find_touching, rows

_FROM_NEAR = 200  # of a step's work, which one that begins at given nodes may take: a good start takes 30
_NOTHING = 1e-15  # of the largest energy density of the rubber
_WORLD = (*NUMBERS, "softness", "offset", "reference")  # of `newton.worlds.Worlds` in a step


@dataclasses.dataclass(frozen=True)
class Changes:
    """Number of kinks of a step's force, where a gradient is one-sided, or jumps.

    Attributes:
      touched, separated: samples that began, ended contact. slipped, stuck: began, ended slip.
      yielded: friction elements of the rubber's points that began or ended slip. softened: points that began
        or ended to exceed their largest energy.
      sharp: samples in contact with an edge that is not rounded (`touching.at_sharp_edges`): the step may
        have several equilibria, and the gradient is for the one found.
      lost: 1 if the step found no equilibrium, or only by load increments, of which friction remembers the
        last: its gradient is unreliable.
    """

    touched: int = 0
    separated: int = 0
    slipped: int = 0
    stuck: int = 0
    lost: int = 0
    yielded: int = 0
    softened: int = 0
    sharp: int = 0


@dataclasses.dataclass
class Record:
    """One step of all worlds; tensors are on the skin's device.

    Attributes:
      geoms: in contact: the skin's, or none.
      x, x_last: (nvert, nworld, 3) nodes at its end and start [m].
      begun: initial state of a single world on the CPU, else None. In the step that fills a skin its largest
        energy is lower than any in the step, so that the rubber has not softened yet.
      anchors: at its start.
      poses: of the geoms by the names of `contact.faces.Geoms`, (ngeom, nworld, ...).
      numbers: of the worlds, (nworld,).
      wrench: (nworld, ngroup, 6) of the skin on the geoms. pressure: (nworld,) of the liquid above the
        surroundings [Pa].
      touches, slips: samples in contact, slipping, at its end.
      yields, loads: (nbranch n,) friction elements of the rubber's n points that slipped, (n,) points that
        exceeded their largest energy; empty without memory.
      changes: of each world, relative to the step before. smoothing: half width of first contact [m].
      dt: of the step [s]. constants: of the rubber's memory, see `memory_constants`.
    """

    geoms: GeomSet
    x: torch.Tensor
    x_last: torch.Tensor
    begun: SavedState | None
    anchors: Anchors
    poses: dict
    numbers: dict
    wrench: torch.Tensor
    pressure: torch.Tensor
    touches: torch.Tensor
    slips: torch.Tensor
    yields: np.ndarray
    loads: np.ndarray
    changes: list[Changes]
    dt: float
    constants: np.ndarray
    smoothing: float


@dataclasses.dataclass
class Trajectory:
    """Records of a press: of the filled skin at rest, None for a dry one, and of the steps; rest positions of
    its nodes (nvert, 3) [m]."""

    rest: Record | None
    steps: list
    vert: np.ndarray


def follow(
    skin: SkinWorlds,
    pos: np.ndarray,
    mat: np.ndarray,
    friction: np.ndarray,
    numbers: dict,
    vert: np.ndarray | None = None,
    dt: np.ndarray | None = None,
    constants: np.ndarray | None = None,
    smoothing: float = 0.0,
    near: np.ndarray | None = None,
) -> Trajectory:
    """Moves the geoms along paths, from skins at rest.

    Args:
      skin: the worlds.
      pos, mat: (nworld, nstep, ngeom, 3) [m], (nworld, nstep, ngeom, 3, 3) in the BioTac frame.
      friction: (ngeom,) or (nworld, ngeom). numbers: of NUMBERS, each of all worlds or (nworld,).
      vert: (nvert, 3) rest positions of the nodes [m]; None: the skin's.
      dt: (nstep,) times of the steps [s]; required for a Prony series.
      constants: of the rubber's memory; None: the skin's.
      smoothing: half width of first contact, see `press` [m].
      near: (nstep, nvert, nworld, 3) nodes at which the solves of the steps begin [m]; None: by the motion
        before.
    """
    data, geoms = skin.data, skin.geoms
    constants = skin.constants if constants is None else constants
    dt = np.ones(pos.shape[1]) if dt is None else dt
    vert = skin.rest if vert is None else vert
    skin.rest_at(vert)
    data.reset()
    data.worlds.guessed.zero_()
    data.worlds.spent.zero_()
    skin.write(numbers)
    skin.smooth(smoothing)
    geoms.set_friction(friction)
    rest = None
    if skin.model.has_liquid:
        hold_pressure(skin)
        # filled slowly, as in `skin.fill`: fully relaxed and virgin
        settled = relaxed(skin.model.material, constants)
        write_constants(data, settled)
        rest = advance(skin, skin.nothing, None, 1.0, settled)
        if hasattr(rest.begun, "worst"):
            rest.begun.worst[:] = -np.inf
    if data.memory:
        write_constants(data, constants)
        data.memory.forget(data.x)
    geoms.set_pose(pos[:, 0], mat[:, 0])
    geoms.advance()
    steps, before = [], None
    for t in range(pos.shape[1]):
        geoms.set_pose(pos[:, t], mat[:, t])
        if near is not None:
            data.increment.assign(near[t] - data.x.numpy())
            data.worlds.guessed.fill_(1)
            data.worlds.spent.fill_(skin.model.options.max_work - _FROM_NEAR)
        before = advance(skin, geoms, before, float(dt[t]), constants)
        if near is not None and not data.converged.all():  # a step that begins so takes no increments
            return follow(skin, pos, mat, friction, numbers, vert, dt, constants, smoothing)
        steps.append(before)
    return Trajectory(rest, steps, vert)


def hold_pressure(skin: SkinWorlds) -> None:
    """Makes the pressure of an incompressible liquid an unknown."""
    incompressible = math.isinf(skin.model.options.bulk_modulus)
    kappa, keeps_volume = (wp.to_torch(getattr(skin.data.worlds, name)) for name in ("kappa", "keeps_volume"))
    keeps_volume.copy_((kappa == 0) | incompressible)


def advance(
    skin: SkinWorlds, geoms: GeomSet, before: Record | None, dt: float, constants: np.ndarray
) -> Record:
    """Solves a step of dt [s] from the skin's current state to the geoms' current poses. before: the step
    before, or None. constants: of the rubber's memory."""
    data, outer, struct = skin.data, skin.data.outer, geoms.struct
    begun = skin.state(geoms).save() if skin.model.has_liquid or data.memory else None
    anchors, x_last = Anchors.of(outer), wp.to_torch(data.x).clone()
    names = ("pos", "mat", "pos_last", "mat_last", "friction")
    poses = {name: wp.to_torch(getattr(struct, name)).clone() for name in names}
    step(skin.model, data, geoms, dt)
    x = wp.to_torch(data.x).clone()
    _put_poses(geoms, poses)  # the step overwrites the last poses
    touching = find_touching(outer, skin.sample_weights, struct, x, x_last, anchors)
    sharp = touching.sample[at_sharp_edges(struct, touching)]
    geoms.advance()
    slips = (rows(outer.trial_anchor)[touching.sample] != touching.stick).any(1)
    slips &= rows(struct.friction)[touching.geom] > 0 if geoms.count else slips
    touches, slips = touching.sample, touching.sample[slips]
    yields, loads = _kink_branches(skin, geoms, begun, before, bool((x != x_last).any()))
    counts = {"lost": torch.as_tensor(~data.converged | (data.worlds.increment.numpy() > 0)).long()}
    of_worlds = {"sharp": sharp}
    if before is not None:
        stay, stayed = torch.isin(touches, before.touches), torch.isin(before.touches, touches)
        both = touches[stay]
        now, then = slips[torch.isin(slips, both)], before.slips[torch.isin(before.slips, both)]
        of_worlds |= {
            "touched": touches[~stay],
            "separated": before.touches[~stayed],
            "slipped": now[~torch.isin(now, before.slips)],
            "stuck": then[~torch.isin(then, slips)],
        }
        counts |= {"yielded": torch.tensor([(yields != before.yields).sum()])}
        counts |= {"softened": torch.tensor([(loads != before.loads).sum()])}
    counts |= {name: torch.bincount(s % skin.nworld, minlength=skin.nworld) for name, s in of_worlds.items()}
    counts = {name: count.expand(skin.nworld).tolist() for name, count in counts.items()}
    changes = [Changes(**{name: of[w] for name, of in counts.items()}) for w in range(skin.nworld)]
    pressure = skin.read("pressure")["pressure"] if skin.model.has_liquid else x.new_zeros(skin.nworld)
    return Record(
        geoms, x, x_last, begun, anchors, poses, skin.read(*_WORLD), skin.tensor(data.wrench).clone(),
        pressure, touches, slips, yields, loads, changes, dt, constants, skin.smoothing,
    )  # fmt: skip


def _kink_branches(skin, geoms, begun, before, moved):
    """Friction elements of the rubber that slipped in a step, and points that exceeded their largest energy,
    by their memory before and after; rubber at rest stays on its side."""
    if not skin.data.memory:
        return np.zeros(0, bool), np.zeros(0, bool)
    n, material = skin.data.memory.npoint, skin.model.material
    if not moved:
        virgin = np.zeros(n * len(material.hysteresis), bool), np.ones(n, bool)
        return (before.yields, before.loads) if before else virgin
    now, slipped, loads = skin.state(geoms).save(), np.zeros(0, bool), np.ones(n, bool)
    if material.hysteresis:
        slipped = (now.slip != begun.slip).reshape(-1, 6).any(1)
    if material.mullins is not None:
        # points with energy of rounding size cannot fall below their largest
        virgin = begun.worst <= _NOTHING * now.worst.max()
        loads = (now.worst > begun.worst) | virgin
    return slipped, loads


def restore(skin: SkinWorlds, record: Record) -> None:
    """Puts the skin into the final state of a step, with its contact and liquid."""
    data = skin.data
    skin.write(record.numbers)
    skin.smooth(record.smoothing)
    if data.memory:
        write_constants(data, record.constants)
    if record.begun is not None:
        skin.state(record.geoms).load(record.begun)
    if data.memory:
        data.dt.fill_(record.dt)
        data.memory.begin_step(Launcher("cpu"), data.dt, data.worlds.softness)
        skin.write({"softness": record.numbers["softness"]})
    record.anchors.give(data.outer)
    wp.to_torch(data.x).copy_(record.x)
    _put_poses(record.geoms, record.poses)
    skin.solver(record.geoms).evaluate_forces()


def _put_poses(geoms: GeomSet, poses: dict) -> None:
    """Sets the geoms to a record's `poses`."""
    for name, value in poses.items():
        wp.to_torch(getattr(geoms.struct, name)).copy_(value)
