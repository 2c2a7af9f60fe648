"""Gradient of a whole press: cotangents from its end to its start, tangents from its start to its end.

The records of the steps are the checkpoints: memory grows with their number, and each step is linearised when
it is needed."""

import dataclasses

import numpy as np
import torch

from .linear.memory import Memory
from .linear.step import LinearStep
from .record import Record, Trajectory
from .skin import NUMBERS, SkinWorlds


@dataclasses.dataclass
class Outputs:
    """Outputs of a press, or cotangents or tangents of them.

    Attributes:
      nodes: (nworld, nstep, nvert, 3) [m]. wrench: (nworld, nstep, ngroup, 6) of the skin on the geoms
        [N, N m].
      pressure: (nworld, nstep) of the liquid above rest [Pa].
    """

    nodes: torch.Tensor
    wrench: torch.Tensor
    pressure: torch.Tensor

    @classmethod
    def of(cls, trajectory: Trajectory) -> "Outputs":
        """Outputs of a press, on the skin's device."""
        steps, rest = trajectory.steps, trajectory.rest
        begin = rest.pressure if rest else 0.0
        return cls(
            torch.stack([r.x for r in steps]).permute(2, 0, 1, 3).contiguous(),
            torch.stack([r.wrench for r in steps], 1),
            torch.stack([r.pressure - begin for r in steps], 1),
        )


@dataclasses.dataclass
class Inputs:
    """Cotangents or tangents of the inputs of a press, arrays of the host.

    Attributes:
      pose: (nworld, nstep, ngeom, 6) translations [m] and rotation vectors about the geoms' origins [rad], in
        the BioTac frame.
      friction: (nworld, ngeom). numbers: of `skin.NUMBERS`, (nworld,).
      vert: (nvert, 3) rest positions [m], for rubber and fixed nodes; area, core_area: (nface,) of outer
        faces and of those that can touch the core, for contact [m^2]. None: zero.
      constants: (c,) of the rubber's memory, see `memory_constants.constants_of`. None: zero.
    """

    pose: np.ndarray
    friction: np.ndarray
    numbers: dict
    vert: np.ndarray | None = None
    area: np.ndarray | None = None
    core_area: np.ndarray | None = None
    constants: np.ndarray | None = None


def pull_back(skin: SkinWorlds, trajectory: Trajectory, outputs: Outputs, shape: bool = False) -> Inputs:
    """Cotangents of the inputs from those of the outputs; shape: also of rest positions and areas."""
    skin.rest_at(trajectory.vert)
    steps, w, ngeom = trajectory.steps, skin.nworld, skin.geoms.count
    nodes, wrench, pressures = (
        torch.as_tensor(getattr(outputs, name), device=skin.torch_device)
        for name in ("nodes", "wrench", "pressure")
    )
    nodes, wrench, pressures = nodes.permute(1, 2, 0, 3), wrench.permute(1, 2, 0, 3), pressures.T
    like = steps[0].x
    pose, friction = like.new_zeros((len(steps), ngeom, w, 6)), like.new_zeros((ngeom, w))
    numbers = {name: like.new_zeros(w) for name in NUMBERS}
    x, pressure, anchor = torch.zeros_like(like), like.new_zeros(w), None
    vert, area, core_area = np.zeros(like[:, 0].shape), 0.0, 0.0
    memory, constants = no_memory(skin), np.zeros(len(skin.constants))
    skin.begin_solves()

    def back(record, x, wrench, pressure):
        nonlocal anchor, vert, area, core_area, memory
        step = LinearStep(skin, record)
        anchor = step.none()["anchor"] if anchor is None else anchor
        given = step.pull(x, wrench, pressure, anchor, shape, memory)
        if memory:
            memory = given["memory"]
        if shape:
            vert, area, core_area = vert + given["vert"], area + given["area"], core_area + given["core_area"]
        anchor = given["anchor"]
        for name in NUMBERS:
            numbers[name] += given[name]
        return given, given["x_last"], pull_pressure(skin, record, given)

    for t in reversed(range(len(steps))):
        given, x, pressure = back(steps[t], x + nodes[t], wrench[t], pressure + pressures[t])
        pose[t] += given["pose"]
        pose[max(t - 1, 0)] += given["pose_last"]
        friction += given["friction"]
        constants += given.get("constants", 0.0)
    if trajectory.rest:
        none = like.new_zeros((0, w, 6))
        x = back(trajectory.rest, x, none, pressure - pressures.sum(0))[1]
    numbers = {name: value.cpu().numpy() for name, value in numbers.items()}
    found = Inputs(
        pose.permute(2, 0, 1, 3).cpu().numpy(), friction.T.cpu().numpy(), numbers, constants=constants
    )
    if shape:  # a press starts at rest
        found.vert = vert + x[:, 0].numpy()
        found.area, found.core_area = area[:, 0].numpy(), core_area[:, 0].numpy()
    return found


def push_forward(skin: SkinWorlds, trajectory: Trajectory, inputs: Inputs) -> Outputs:
    """Tangents of the outputs from k tangents of the inputs.

    Args:
      inputs: with arrays of a leading k: pose (k, nworld, nstep, ngeom, 6), friction (k, nworld, ngeom),
        numbers (k, nworld), ...

    Returns:
      Outputs with a leading k, arrays of the host.
    """
    skin.rest_at(trajectory.vert)
    steps, k, like = trajectory.steps, len(inputs.pose), trajectory.steps[0].x
    pose, friction = skin.tensor(inputs.pose).permute(0, 2, 3, 1, 4), skin.tensor(inputs.friction).mT
    numbers = {name: skin.tensor(inputs.numbers[name]) for name in NUMBERS}
    moves, none = inputs.vert is not None, like.new_zeros(skin.nworld)
    x, pressure, anchors = [torch.zeros_like(like)] * k, [none] * k, [None] * k
    memory, out = [no_memory(skin)] * k, []
    constants = np.zeros((k, len(skin.constants))) if inputs.constants is None else inputs.constants
    constants = torch.as_tensor(constants)
    if moves:
        vert, area, core_area = map(skin.tensor, (inputs.vert, inputs.area, inputs.core_area))
        x = [own + vert[i][:, None] for i, own in enumerate(x)]
    skin.begin_solves()

    def push_step(record, t):
        step, wrench = LinearStep(skin, record), []
        for i in range(k):
            given = {name: value[i] for name, value in numbers.items()} | {"x_last": x[i]}
            if anchors[i] is not None:
                given["anchor"] = anchors[i]
            given |= _push_pressure(skin, record, pressure[i])
            if t is not None:
                given |= {"pose": pose[i, t], "pose_last": pose[i, max(t - 1, 0)], "friction": friction[i]}
            if moves:
                given |= {"area": area[i][:, None], "core_area": core_area[i][:, None]}
            x[i], six, pressure[i], anchors[i], memory[i] = step.push(
                given,
                vert[i] if moves else None,
                memory[i],
                constants[i] if t is not None else 0 * constants[i],
            )
            wrench.append(six)
        return torch.stack(wrench)

    begin = none
    if trajectory.rest:
        push_step(trajectory.rest, None)
        begin = torch.stack(pressure)
    for t, record in enumerate(steps):
        wrench = push_step(record, t)
        out.append((torch.stack(x), wrench, torch.stack(pressure) - begin))
    nodes, wrench, pressures = (torch.stack(parts, 1) for parts in zip(*out))
    found = nodes.permute(0, 3, 1, 2, 4), wrench.permute(0, 3, 1, 2, 4), pressures.mT
    return Outputs(*(a.cpu().numpy() for a in found))


def pull_pressure(skin: SkinWorlds, record: Record, given: dict) -> torch.Tensor:
    """(nworld,) cotangent of the pressure at the start of a step, from those of the step's inputs."""
    keeps_volume = torch.as_tensor(skin.data.worlds.keeps_volume.numpy(), device=skin.torch_device)
    return given["reference"] * _slope_of_reference(record) + keeps_volume * given["offset"]


def _push_pressure(skin: SkinWorlds, record: Record, pressure: torch.Tensor) -> dict:
    """Tangents of a step's inputs by the pressure (nworld,) at its start."""
    keeps_volume = torch.as_tensor(skin.data.worlds.keeps_volume.numpy(), device=skin.torch_device)
    return {"reference": pressure * _slope_of_reference(record), "offset": pressure * keeps_volume}


def _slope_of_reference(record: Record) -> float:
    """Derivative of `newton.worlds.Worlds.reference`, the last pressure's size above a least one, by that
    pressure."""
    if record.begun is None:
        return 0.0
    pressure = record.begun.last_pressure
    return float(np.sign(pressure)) if abs(pressure) == float(record.numbers["reference"]) else 0.0


def no_memory(skin: SkinWorlds) -> Memory | None:
    """Zero memory: a press starts without any, and its initial memory is constant."""
    return Memory.none(skin.model.material, skin.data.memory.npoint) if skin.data.memory else None
