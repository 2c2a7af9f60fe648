"""A press step by step, with all that its gradient needs: the state in which every step began, and where it
ended. No step is solved a second time."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..skin import GeomSet, step
from ..skin.program import Launcher
from ..skin.state import SavedState
from .memory_constants import relaxed, write_constants
from .skin import NUMBERS, Skin
from .touching import Held, at_sharp_edges, look

__all__ = ["Changes", "Record", "Trajectory", "advance", "follow", "restore"]

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
    """One step.

    Attributes:
      geoms: what touched: the skin's, or nothing.
      x: (nvert, 3) nodes when it ended [m].
      begun: state when it began; with a largest energy below any in the step in which a filling comes to
        rest, which leaves rubber that has borne no more than that.
      held: what stuck then.
      poses: of the geoms by the names of `contact.faces.Geoms`, (ngeom, ...).
      numbers: of the world.
      wrench: (ngroup, 6) of the skin on the geoms. pressure: of the liquid above the surroundings [Pa].
      touches, slips: samples that touch, that slip, when it ends.
      yields, loads: (nbranch n,) friction elements of the rubber's n points that slipped in it, (n,) points
        that bore more than ever; empty without memory.
      on_core: samples that touch the core, when it ends.
      changes: against the step before. smoothing: half width of first touch [m].
      dt: of the step [s]. constants: of the rubber's memory, see `memory_constants`.
    """

    geoms: GeomSet
    x: np.ndarray
    begun: SavedState
    held: Held
    poses: dict
    numbers: dict
    wrench: np.ndarray
    pressure: float
    touches: np.ndarray
    slips: np.ndarray
    yields: np.ndarray
    loads: np.ndarray
    on_core: int
    changes: Changes
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
    skin: Skin,
    pos: np.ndarray,
    mat: np.ndarray,
    friction: np.ndarray,
    numbers: dict,
    incompressible: bool,
    vert: np.ndarray | None = None,
    dt: np.ndarray | None = None,
    constants: np.ndarray | None = None,
    smoothing: float = 0.0,
    near: Sequence[np.ndarray | None] | None = None,
) -> Trajectory:
    """Takes the geoms along a path, from a skin at rest.

    Args:
      skin: the skin.
      pos, mat: (nstep, ngeom, 3) [m], (nstep, ngeom, 3, 3) in the BioTac frame.
      friction: (ngeom,). numbers: of NUMBERS.
      incompressible: whether the liquid's pressure is an unknown of its own.
      vert: (nvert, 3) rest positions of the nodes [m]; None: the skin's.
      dt: (nstep,) times of the steps [s]; needed by a Prony series.
      constants: of the rubber's memory; None: the skin's.
      smoothing: half width of first touch, see `press` [m].
      near: for each step nodes (nvert, 3) at which it begins to look for its balance [m], None: where the
        step before leads. Then the press ends with the first step that is lost.
    """
    data, geoms = skin.data, skin.geoms
    constants = skin.constants if constants is None else constants
    dt = np.ones(len(pos)) if dt is None else dt
    vert = skin.rest if vert is None else vert
    skin.rest_at(vert)
    data.reset()
    skin.write(numbers)
    skin.smooth(smoothing)
    geoms.set_friction(friction)
    rest = None
    if skin.model.has_liquid:
        data.worlds.holds.fill_(int(incompressible or numbers["kappa"] == 0))
        # filled slowly, as `skin.fill` does: after any time, and virgin
        calm = relaxed(skin.model.material, constants)
        write_constants(data, calm)
        rest = advance(skin, skin.nothing, None, 1.0, calm)
        if hasattr(rest.begun, "worst"):
            rest.begun.worst[:] = -np.inf
    if data.memory:
        write_constants(data, constants)
        data.memory.forget(data.x)
    geoms.set_pose(pos[0], mat[0])
    geoms.advance()
    steps, before = [], None
    for t, (p, m, h) in enumerate(zip(pos, mat, dt)):
        geoms.set_pose(p, m)
        if near and near[t] is not None:
            data.increment.numpy()[:, 0] = near[t] - data.x.numpy()[:, 0]
            data.worlds.guessed.fill_(1)
        before = advance(skin, geoms, before, float(h), constants)
        steps.append(before)
        if near and before.changes.lost:
            break
    return Trajectory(rest, steps, vert)


def advance(skin: Skin, geoms: GeomSet, before: Record | None, dt: float, constants: np.ndarray) -> Record:
    """Makes a step of dt [s] from the state that the skin has, to where the geoms are now. before: the step
    before, None: there is none. constants: of the rubber's memory."""
    data, outer, struct = skin.data, skin.data.outer, geoms.struct
    begun, held = skin.state(geoms).save(), Held.of(outer)
    names = ("pos", "mat", "pos_last", "mat_last", "friction")
    poses = {name: getattr(struct, name).numpy()[:, 0].copy() for name in names}
    step(skin.model, data, geoms, dt)
    x = data.x.numpy()[:, 0].copy()
    for name, value in poses.items():  # the step makes the last poses these
        getattr(struct, name).numpy()[:, 0] = value
    seen = look(outer, skin.weights, struct, x, begun.x, held)
    geoms.advance()
    slips = (outer.trial_anchor.numpy()[seen.sample, 0] != seen.stick).any(1)
    touches, slips = seen.sample, seen.sample[slips & (poses["friction"][seen.geom] > 0)]
    yields, loads = _sides(skin, geoms, begun, before, bool((x != begun.x).any()))
    changes = Changes(
        lost=int(not data.converged[0] or data.worlds.increment.numpy()[0] > 0),
        sharp=int(at_sharp_edges(struct, seen).sum()),
    )
    if before is not None:
        both = np.intersect1d(touches, before.touches)
        changes = dataclasses.replace(
            changes,
            touched=len(touches) - len(both),
            parted=len(before.touches) - len(both),
            slipped=len(np.setdiff1d(np.intersect1d(slips, both), before.slips)),
            stuck=len(np.setdiff1d(np.intersect1d(before.slips, both), slips)),
            yielded=int((yields != before.yields).sum()),
            softened=int((loads != before.loads).sum()),
        )
    pressure = skin.read("pressure")["pressure"] if skin.model.has_liquid else 0.0
    end = skin.read(*_WORLD), data.wrench[0], pressure
    on_core = int((data.core.trial_geom.numpy() >= 0).sum()) if data.core else 0
    past = dt, constants, skin.smoothing
    return Record(geoms, x, begun, held, poses, *end, touches, slips, yields, loads, on_core, changes, *past)


def _sides(skin, geoms, begun, before, moved):
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


def restore(skin: Skin, record: Record) -> None:
    """Puts the skin where a step ended, with the contact and the liquid of there."""
    data, struct = skin.data, record.geoms.struct
    skin.write(record.numbers)
    skin.smooth(record.smoothing)
    if data.memory:
        write_constants(data, record.constants)
    skin.state(record.geoms).load(record.begun)
    if data.memory:
        data.dt.fill_(record.dt)
        data.memory.begin_step(Launcher("cpu"), data.dt, data.worlds.softness)
        skin.write({"softness": record.numbers["softness"]})
    record.held.give(data.outer)
    data.x.numpy()[:, 0] = record.x
    for name, value in record.poses.items():
        getattr(struct, name).numpy()[:, 0] = value
    skin.solver(record.geoms).evaluate_forces()
