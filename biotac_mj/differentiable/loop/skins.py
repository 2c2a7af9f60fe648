"""Adjoint of a skin in MuJoCo's steps: the result in the plugin's state is solved again to a small tolerance,
starting from itself, and linearised there."""

import dataclasses
import typing
import weakref
from collections.abc import Iterable

import numpy as np
import torch

from ...coupling.instance import Instance
from ...coupling.setup import OUT_OF_REACH, STARTED
from ...coupling.steppers.fem import FemStepper
from ...skin.state import SavedState
from ..linear.memory import Memory
from ..linear.step import LinearStep
from ..memory_constants import write_constants
from ..record import Record, advance, hold_pressure
from ..skin import Skin
from ..sweep import no_memory, pull_pressure


@dataclasses.dataclass(frozen=True)
class SavedStep:
    """Saved data of a skin at the end of a step.

    Attributes:
      state: its state. wrench: (ngroup, 6) on the bodies in contact, as applied.
      idle: whether nothing was in reach. resting: whether it is at rest. gamma: (ngroup,) Newmark's, of the
        step.
      begun: initial poses (ngeom, 3), (ngeom, 3, 3) of the geoms in the step, None: the final ones; whole:
        whether these are the final ones of the step before.
    """

    state: SavedState
    wrench: np.ndarray
    idle: bool
    resting: bool
    gamma: np.ndarray
    begun: tuple | None
    whole: bool


@dataclasses.dataclass
class Cotangent:
    """Cotangent of a skin's state between two steps: nodes (nvert, 1, 3), pressure (1,), poses of the geoms
    (ngeom, 1, 6), anchors of all samples (nsample, 3) and memory of the rubber."""

    x: torch.Tensor
    pressure: torch.Tensor
    pose: torch.Tensor
    anchors: torch.Tensor
    memory: Memory | None

    @classmethod
    def none(cls, skin: Skin) -> "Cotangent":
        """Zeros."""
        nsample = skin.surfaces[0] * len(skin.weights)
        shapes = (skin.model.nvert, 1, 3), (1,), (skin.geoms.count, 1, 6), (nsample, 3)
        return cls(*(torch.zeros(shape, dtype=torch.float64) for shape in shapes), no_memory(skin))


class Pulled:
    """Result of a step's adjoint: `pose` (6 ngeom,) cotangent of the geoms' poses, and cotangents for the
    step before. It is linear, so results for several cotangents add.

    Args:
      pose, pose_last, x, pressure, anchor: cotangents of the step's inputs. memory: of the rubber, a
        dataclass of arrays, or None.
    """

    def __init__(
        self,
        pose: torch.Tensor,
        pose_last: torch.Tensor,
        x: torch.Tensor,
        pressure: torch.Tensor,
        anchor: torch.Tensor,
        memory: typing.Any | None,
    ):
        self.cotangents = [pose, pose_last, x, pressure, anchor]
        if memory is not None:
            self.cotangents += [getattr(memory, f.name) for f in dataclasses.fields(memory)]

    @property
    def pose(self) -> np.ndarray:
        return self.cotangents[0].numpy().ravel()

    def plus(self, others: Iterable["Pulled"], weights: Iterable[float]) -> "Pulled":
        """Adds weighted others."""
        for other, weight in zip(others, weights):
            self.cotangents = [a + weight * b for a, b in zip(self.cotangents, other.cotangents)]
        return self


class LoopSkin:
    """A BioTac's skin in a rollout.

    Raises:
      ValueError: a feature without gradient; the text has its name.
    """

    def __init__(self, name: str, instance: Instance):
        self.name, self.instance, stepper = name, instance, instance.setup.skin.stepper
        config = instance.setup.config
        if type(stepper) is not FemStepper:
            raise ValueError(
                f"BioTac {name!r} has stepper {config.stepper!r} in tier {config.tier!r}: gradients are "
                "those of the full tier's 'fem'"
            )
        if config.device != "cpu":
            raise ValueError(
                f"the skin of BioTac {name!r} is on {config.device}: attach it with device='cpu'"
            )
        if instance.touching.skins:
            raise ValueError(
                f"BioTac {name!r} can meet the skin of another: there are no gradients of that, so name the "
                "geoms that may touch in attach(geoms=)"
            )
        self.stepper = stepper

    @property
    def skin(self) -> Skin:
        """A differentiable skin, made on first use and shared by skins of the same kind."""
        if self.stepper not in _skins:
            geometry, (material, options, modulus), geoms = self.stepper.made_of
            meshes = self.stepper.grids
            args = [[g.type for g in geoms], [g.size for g in geoms], [g.friction for g in geoms]]
            args += [[g.group for g in geoms], [g.rounding for g in geoms], meshes]
            _skins[self.stepper] = Skin(geometry, material, options, *args, modulus=modulus)
        return _skins[self.stepper]

    @property
    def nvert(self) -> int:
        """Number of output nodes."""
        return self.stepper.made_of[0].nvert

    def part(self) -> np.ndarray:
        """The skin's segment of the plugin's current state."""
        return self.instance.setup.parts(self.instance.state)[2]

    def keep(self, before: np.ndarray) -> SavedStep:
        """Data after a step from a state (nstate,)."""
        before = before if self.instance.put is None else self.instance.put
        head, models, now, _ = self.instance.setup.parts(self.instance.state)
        ends, begun, whole = self.stepper.came_to(now), None, False
        resting = self.stepper.resting(now)
        if not resting:
            begun = self.stepper.begun_at(before, *ends)
            last = self.stepper.came_to(before)
            whole = begun is not None and all(np.array_equal(a, b) for a, b in zip(begun, last))
            begun = begun and tuple(a.copy() for a in begun)
        idle = head[STARTED] == OUT_OF_REACH
        wrench, gamma = models["wrench0"].copy(), np.full(len(models), self.instance.outcome.gamma)
        return SavedStep(self.stepper.used(now), wrench, bool(idle), resting, gamma, begun, whole)

    def nodes(self, state: SavedState) -> np.ndarray:
        """(nvert, 3) [m]."""
        return state.x[: self.nvert]

    def pressure(self, state: SavedState) -> float:
        """Pressure of the liquid above rest [Pa]."""
        return state.last_pressure - self.stepper.model.rest.pressure

    # --- backwards ---

    def record(self, before: SavedState, kept: SavedStep, dt: float) -> Record:
        """Solves a step of dt [s] again."""
        skin, geoms = self.skin, self.skin.geoms
        data = skin.data
        skin.rest_at(skin.rest)
        skin.write(skin.own)
        skin.smooth(0.0)
        geoms.set_friction(skin.friction)
        if data.memory:
            write_constants(data, skin.constants)
        increment = kept.state.x - before.x
        skin.state(geoms).load(before.replace(increment=increment, motion=np.zeros((geoms.count, 3))))
        data.worlds.guessed.fill_(1)
        if skin.model.has_liquid:
            hold_pressure(skin)
        ends = kept.state.geom_pos, kept.state.geom_mat
        geoms.set_pose(*(ends if kept.begun is None else kept.begun))
        geoms.advance()
        geoms.set_pose(*ends)
        return advance(skin, geoms, None, dt, skin.constants)

    def linear(self, before: SavedState, kept: SavedStep, dt: float) -> "LinearLoopStep":
        """Linearised step of dt [s] from a state."""
        return LinearLoopStep(self.skin, self.record(before, kept, dt), kept)


class LinearLoopStep:
    """A linearised step between states of the MuJoCo plugin."""

    def __init__(self, skin: Skin, record: Record, kept: SavedStep):
        self.skin, self.kept, self.record, self.step = skin, kept, record, LinearStep(skin, record)

    def pull(self, after: Cotangent, wrench: np.ndarray) -> Pulled:
        """From cotangents of the state and of the wrenches (ngroup, 6)."""
        wrench = torch.from_numpy(wrench)[:, None]
        given = self.step.pull(after.x, wrench, after.pressure, after.anchors, memory=after.memory)
        pressure = pull_pressure(self.skin, self.record, given)
        pose, last = given["pose"] + after.pose, given["pose_last"]
        if (
            not self.kept.whole
        ):  # the initial poses are the final ones, or those of first contact with the skin at rest
            pose, last = pose + last, 0.0 * last
        return Pulled(pose, last, given["x_last"], pressure, given["anchor"], given.get("memory"))

    def before(self, pulled: Pulled) -> Cotangent:
        """Cotangent of the state at the start of the step."""
        _, last, x, pressure, anchors, *memory = pulled.cotangents
        return Cotangent(x, pressure, last, anchors, Memory(*memory) if memory else None)


_skins = weakref.WeakKeyDictionary()
