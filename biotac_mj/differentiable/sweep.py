"""The gradient of a whole press: cotangents from its end to its beginning, tangents from its beginning to
its end.

The records of the steps are the checkpoints: memory grows with their number, and each step is made linear
again when it is its turn."""

import dataclasses

import numpy as np

from .linear.memory import Memory
from .linear.step import LinearStep
from .record import Record, Trajectory
from .skin import NUMBERS, Skin

__all__ = ["Anchors", "Inputs", "Outputs", "no_memory", "pull_back", "push_forward", "slope_of_reference"]


@dataclasses.dataclass
class Outputs:
    """What a press gives, or cotangents or tangents of it.

    Attributes:
      nodes: (nstep, nvert, 3) [m]. wrench: (nstep, ngroup, 6) of the skin on the geoms [N, N m].
      pressure: (nstep,) of the liquid above rest [Pa].
    """

    nodes: np.ndarray
    wrench: np.ndarray
    pressure: np.ndarray

    @classmethod
    def of(cls, trajectory: Trajectory) -> "Outputs":
        """What a press gave out."""
        steps, rest = trajectory.steps, trajectory.rest
        begin = rest.pressure if rest else 0.0
        return cls(
            np.array([r.x for r in steps]),
            np.array([r.wrench for r in steps]),
            np.array([r.pressure - begin for r in steps]),
        )


@dataclasses.dataclass
class Inputs:
    """Cotangents or tangents of the inputs of a press.

    Attributes:
      pose: (nstep, ngeom, 6) translations [m] and rotation vectors about the geoms' origins [rad], in the
        BioTac frame.
      friction: (ngeom,). numbers: of `skin.NUMBERS`.
      vert: (nvert, 3) rest positions [m], which move rubber and fixed nodes; area, core_area: (nface,) of
        outer faces and of those that can meet the core, which move contact [m^2]. None: they stay.
      constants: (c,) of the rubber's memory, see `memory_constants.constants_of`. None: they stay.
    """

    pose: np.ndarray
    friction: np.ndarray
    numbers: dict
    vert: np.ndarray | None = None
    area: np.ndarray | None = None
    core_area: np.ndarray | None = None
    constants: np.ndarray | None = None


def pull_back(skin: Skin, trajectory: Trajectory, outputs: Outputs, shape: bool = False) -> Inputs:
    """Cotangents of the inputs from those of the outputs; shape: of rest positions and areas too."""
    skin.rest_at(trajectory.vert)
    steps, holds = trajectory.steps, bool(skin.data.worlds.holds.numpy()[0])
    pose = np.zeros((len(steps), skin.geoms.count, 6))
    friction, numbers = np.zeros(skin.geoms.count), dict.fromkeys(NUMBERS, 0.0)
    x, pressure, anchors = np.zeros((skin.model.nvert, 3)), 0.0, Anchors()
    vert, area, core_area = np.zeros_like(x), *(np.zeros(n) for n in skin.surfaces)
    memory, constants = no_memory(skin), np.zeros(len(skin.constants))
    skin.factors.begin()

    def back(record, x, wrench, pressure):
        nonlocal anchors, vert, area, core_area, memory
        step = LinearStep(skin, record)
        given = step.pull(x, wrench, pressure, anchors.of(step.touching.sample), shape, memory)
        if memory:
            memory = given["memory"]
        if shape:
            vert, area, core_area = vert + given["vert"], area + given["area"], core_area + given["core_area"]
        anchors = Anchors(record.held.sample, given["anchor"])
        for name in NUMBERS:
            numbers[name] += float(given[name])
        last = given["reference"] * slope_of_reference(record) + (given["offset"] if holds else 0.0)
        return given, given["x_last"], float(last)

    for t in reversed(range(len(steps))):
        own = float(outputs.pressure[t])
        given, x, pressure = back(steps[t], x + outputs.nodes[t], outputs.wrench[t], pressure + own)
        pose[t] += given["pose"]
        pose[max(t - 1, 0)] += given["pose_last"]
        friction += given["friction"]
        constants += given.get("constants", 0.0)
    if trajectory.rest:
        x = back(trajectory.rest, x, np.zeros((0, 6)), pressure - float(outputs.pressure.sum()))[1]
    if not shape:
        return Inputs(pose, friction, numbers, constants=constants)
    return Inputs(pose, friction, numbers, vert + x, area, core_area, constants)  # a press begins at rest


def push_forward(
    skin: Skin, trajectory: Trajectory, inputs: Inputs, near: np.ndarray | None = None
) -> Outputs:
    """Tangents of the outputs from those of the inputs, k of them at once.

    Args:
      inputs: with arrays of a leading k: pose (k, nstep, ngeom, 6), friction (k, ngeom), numbers (k,), ...
      near: (k, nstep, nvert, 3) nodes' tangents of nearly the same press, from which less is left to find.

    Returns:
      Outputs with a leading k.
    """
    skin.rest_at(trajectory.vert)
    steps, k, holds = trajectory.steps, len(inputs.pose), bool(skin.data.worlds.holds.numpy()[0])
    n, ngroup = skin.model.nvert, skin.geoms.ngroup
    shape = k, len(steps)
    out = Outputs(np.zeros((*shape, n, 3)), np.zeros((*shape, ngroup, 6)), np.zeros(shape))
    x, pressure, anchors = np.zeros((k, n, 3)), np.zeros(k), [Anchors()] * k
    begin, moves, memory = np.zeros(k), inputs.vert is not None, [no_memory(skin)] * k
    constants = np.zeros((k, len(skin.constants))) if inputs.constants is None else inputs.constants
    if moves:
        x = x + inputs.vert
    skin.factors.begin()

    def ahead(record, t):
        step = LinearStep(skin, record)
        wrench = np.zeros((k, record.geoms.ngroup, 6))
        for i in range(k):
            given = {name: inputs.numbers[name][i] for name in NUMBERS}
            given |= {"x_last": x[i], "anchor": anchors[i].of(record.held.sample)}
            given["reference"] = pressure[i] * slope_of_reference(record)
            given["offset"] = pressure[i] if holds else 0.0
            if t is not None:
                given |= {"pose": inputs.pose[i, t], "pose_last": inputs.pose[i, max(t - 1, 0)]}
                given["friction"] = inputs.friction[i]
            if moves:
                given |= {"area": inputs.area[i], "core_area": inputs.core_area[i]}
            own = constants[i] if t is not None else 0 * constants[i]
            x[i], wrench[i], pressure[i], held, memory[i] = step.push(
                given,
                inputs.vert[i] if moves else None,
                memory[i],
                own,
                None if near is None or t is None else near[i, t],
            )
            anchors[i] = Anchors(step.touching.sample, held)
        return wrench

    if trajectory.rest:
        ahead(trajectory.rest, None)
        begin = pressure.copy()
    for t, record in enumerate(steps):
        out.wrench[:, t] = ahead(record, t)
        out.nodes[:, t], out.pressure[:, t] = x, pressure - begin
    return out


def slope_of_reference(record: Record) -> float:
    """Of `newton.worlds.Worlds.reference` by the last pressure: its size, but for a least one."""
    reference = record.numbers["reference"]
    pressure = record.begun.last_pressure
    return float(np.sign(pressure)) if abs(pressure) == reference else 0.0


def no_memory(skin: Skin) -> Memory | None:
    """A press begins at a state without any, and what that remembers stays as it is."""
    return Memory.none(skin.model.material, skin.data.memory.npoint) if skin.data.memory else None


class Anchors:
    """Vectors of samples by number; of others they are zero."""

    def __init__(self, sample: np.ndarray | None = None, value: np.ndarray | None = None):
        if sample is None:
            sample, value = np.zeros(0, int), np.zeros((0, 3))
        self._sample, self._value = sample, value

    def of(self, sample: np.ndarray) -> np.ndarray:
        """(m, 3) of samples (m,)."""
        out = np.zeros((len(sample), 3))
        both, here, there = np.intersect1d(sample, self._sample, return_indices=True)
        out[here] = self._value[there]
        return out
