"""A press of all worlds of a skin step by step, with all that its gradient needs: the state in which every
step began, and where it ended. No step is solved a second time."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from ..skin import GeomSet, step
from ..skin.program import Launcher
from ..skin.state import SavedState
from .memory_constants import relaxed, write_constants
from .skin import NUMBERS, SkinWorlds
from .touching import Anchors, at_sharp_edges, find_touching, rows, touching_samples

__all__ = ["Changes", "Record", "Trajectory", "advance", "follow", "hold_pressure", "restore"]

_NOTHING = 1e-15  # of the largest energy density that rubber has borne
_WORLD = (*NUMBERS, "softness", "offset", "reference")  # of `newton.worlds.Worlds`, as a step had them


@dataclasses.dataclass(frozen=True)
class Changes:
    """Where the force of a step has a kink, at which a gradient holds on one side alone, or a jump.

    Attributes:
      touched, parted: samples that began, ceased to touch. slipped, stuck: began, ceased to slip.
      yielded: friction elements of the rubber's points that began or ceased to slip. softened: points that
        began or ceased to bear more than ever.
      sharp: samples that touch an edge which is not rounded (`touching.at_sharp_edges`): the step may have
        several balances, and the gradient is that of the one that was found.
      lost: 1 where the step found no balance, or only in parts, of which friction remembers the last: its
        gradient means little.
    """

    touched: int = 0
    parted: int = 0
    slipped: int = 0
    stuck: int = 0
    lost: int = 0
    yielded: int = 0
    softened: int = 0
    sharp: int = 0


@dataclasses.dataclass
class Record:
    """One step of all worlds; tensors lie where the skin does.

    Attributes:
      geoms: what touched: the skin's, or nothing.
      x, x_last: (nvert, nworld, 3) nodes when it ended and began [m].
      begun: state of a single world on the CPU when it began; with a largest energy below any in the step in
        which a filling comes to rest, which leaves rubber that has borne no more than that. Else None.
      anchors: what stuck then.
      poses: of the geoms by the names of `contact.faces.Geoms`, (ngeom, nworld, ...).
      numbers: of the worlds, (nworld,).
      wrench: (nworld, ngroup, 6) of the skin on the geoms. pressure: (nworld,) of the liquid above the
        surroundings [Pa].
      touches, slips: samples that touch, that slip, when it ends.
      yields, loads: (nbranch n,) friction elements of the rubber's n points that slipped in it, (n,) points
        that bore more than ever; empty without memory.
      on_core: samples that touch the core, when it ends.
      changes: of each world, against the step before. smoothing: half width of first touch [m].
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
    on_core: int
    changes: list[Changes]
    dt: float
    constants: np.ndarray
    smoothing: float


@dataclasses.dataclass
class Trajectory:
    """Records of a press: of the skin at rest on its filling, None of a dry one, and of the steps; rest
    positions of its nodes (nvert, 3) [m]."""

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
    guesses: Sequence[torch.Tensor | None] | None = None,
) -> Trajectory:
    """Takes the geoms along paths, from skins at rest.

    Args:
      skin: the worlds.
      pos, mat: (nworld, nstep, ngeom, 3) [m], (nworld, nstep, ngeom, 3, 3) in the BioTac frame.
      friction: (ngeom,) or (nworld, ngeom). numbers: of NUMBERS, each of all worlds or (nworld,).
      vert: (nvert, 3) rest positions of the nodes [m]; None: the skin's.
      dt: (nstep,) times of the steps [s]; needed by a Prony series.
      constants: of the rubber's memory; None: the skin's.
      smoothing: half width of first touch, see `press` [m].
      guesses: for each step nodes (nvert, nworld, 3) at which it begins to look for its balance [m], None:
        where the step before leads. Then the press ends with the first step that is lost.
    """
    data, geoms = skin.data, skin.geoms
    constants = skin.constants if constants is None else constants
    dt = np.ones(pos.shape[1]) if dt is None else dt
    vert = skin.rest if vert is None else vert
    skin.rest_at(vert)
    data.reset()
    skin.write(numbers)
    skin.smooth(smoothing)
    geoms.set_friction(friction)
    rest = None
    if skin.model.has_liquid:
        hold_pressure(skin)
        # filled slowly, as `skin.fill` does: after any time, and virgin
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
        if guesses and guesses[t] is not None:
            wp.to_torch(data.increment).copy_(guesses[t] - wp.to_torch(data.x))
            data.worlds.guessed.fill_(1)
        before = advance(skin, geoms, before, float(dt[t]), constants)
        steps.append(before)
        if guesses and any(changes.lost for changes in before.changes):
            break
    return Trajectory(rest, steps, vert)


def hold_pressure(skin: SkinWorlds) -> None:
    """The pressure of a liquid that keeps its volume is an unknown of its own."""
    incompressible = math.isinf(skin.model.options.bulk_modulus)
    kappa, keeps_volume = (wp.to_torch(getattr(skin.data.worlds, name)) for name in ("kappa", "keeps_volume"))
    keeps_volume.copy_((kappa == 0) | incompressible)


def advance(
    skin: SkinWorlds, geoms: GeomSet, before: Record | None, dt: float, constants: np.ndarray
) -> Record:
    """Makes a step of dt [s] from the state that the skin has, to where the geoms are now. before: the step
    before, None: there is none. constants: of the rubber's memory."""
    data, outer, struct = skin.data, skin.data.outer, geoms.struct
    begun = skin.state(geoms).save() if skin.model.has_liquid or data.memory else None
    anchors, x_last = Anchors.of(outer), wp.to_torch(data.x).clone()
    names = ("pos", "mat", "pos_last", "mat_last", "friction")
    poses = {name: wp.to_torch(getattr(struct, name)).clone() for name in names}
    step(skin.model, data, geoms, dt)
    x = wp.to_torch(data.x).clone()
    _put_poses(geoms, poses)  # the step makes the last poses these
    seen = find_touching(outer, skin.sample_weights, struct, x, x_last, anchors)
    sharp = seen.sample[at_sharp_edges(struct, seen)]
    geoms.advance()
    slips = (rows(outer.trial_anchor)[seen.sample] != seen.stick).any(1)
    slips &= rows(struct.friction)[seen.geom] > 0 if geoms.count else slips
    touches, slips = seen.sample, seen.sample[slips]
    yields, loads = _kink_branches(skin, geoms, begun, before, bool((x != x_last).any()))
    counts = {"lost": torch.as_tensor(~data.converged | (data.worlds.increment.numpy() > 0)).long()}
    of_worlds = {"sharp": sharp}
    if before is not None:
        stay, stayed = torch.isin(touches, before.touches), torch.isin(before.touches, touches)
        both = touches[stay]
        now, then = slips[torch.isin(slips, both)], before.slips[torch.isin(before.slips, both)]
        of_worlds |= {
            "touched": touches[~stay],
            "parted": before.touches[~stayed],
            "slipped": now[~torch.isin(now, before.slips)],
            "stuck": then[~torch.isin(then, slips)],
        }
        counts |= {"yielded": torch.tensor([(yields != before.yields).sum()])}
        counts |= {"softened": torch.tensor([(loads != before.loads).sum()])}
    counts |= {name: torch.bincount(s % skin.nworld, minlength=skin.nworld) for name, s in of_worlds.items()}
    counts = {name: count.expand(skin.nworld).tolist() for name, count in counts.items()}
    changes = [Changes(**{name: of[w] for name, of in counts.items()}) for w in range(skin.nworld)]
    pressure = skin.read("pressure")["pressure"] if skin.model.has_liquid else x.new_zeros(skin.nworld)
    on_core = len(touching_samples(data.core.trial_geom)[0]) if data.core else 0
    return Record(
        geoms, x, x_last, begun, anchors, poses, skin.read(*_WORLD), skin.tensor(data.wrench).clone(),
        pressure, touches, slips, yields, loads, on_core, changes, dt, constants, skin.smoothing,
    )  # fmt: skip


def _kink_branches(skin, geoms, begun, before, moved):
    """Which of the rubber's friction elements slipped in a step, and which points bore more than ever, by
    what they remember now and did when it began; rubber that lies still is on the side where it was."""
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
        # what has borne nothing but rounding has nothing to fall short of
        virgin = begun.worst <= _NOTHING * now.worst.max()
        loads = (now.worst > begun.worst) | virgin
    return slipped, loads


def restore(skin: SkinWorlds, record: Record) -> None:
    """Puts the skin where a step ended, with the contact and the liquid of there."""
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
    """Gives geoms what a record's `poses` has."""
    for name, value in poses.items():
        wp.to_torch(getattr(geoms.struct, name)).copy_(value)
