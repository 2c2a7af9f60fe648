"""A press of many worlds at once as a function that PyTorch differentiates, backwards."""

import numpy as np
import torch

from ..skin import NUMBERS, Skin
from .linear import Sweep, pull_back
from .skin import NUMBERS as OWN
from .skin import SkinOfWorlds

__all__ = ["press_together"]

_PLACES = [NUMBERS.index(name) for name in OWN]


def press_together(
    skin: Skin,
    device: str,
    pos: torch.Tensor,
    mat: torch.Tensor,
    friction: torch.Tensor,
    numbers: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, list]:
    """Nodes (nworld, nstep, nvert, 3) [m] and wrenches (nworld, nstep, ngroup, 6) of all worlds, tensors of
    the device, and their `Changes`.

    Args:
      device: "cpu" or a CUDA device.
      pos: (nworld, nstep, ngeom, 3) [m]; mat: the same of (3, 3), in the BioTac frame.
      friction: (nworld, ngeom). numbers: (nworld, 5) of `skin.NUMBERS`.

    Raises:
      ValueError: see `together.skin.refuse_together`.
    """
    given = (a.to("cpu") for a in (pos, mat, friction, numbers))
    changes = []
    with skin.lock:
        if skin.together[0] != (len(pos), device):  # the last ones are kept
            worlds = SkinOfWorlds(skin, len(pos), device)
            skin.together = (len(pos), device), worlds, Sweep(worlds)
        worlds, sweep = skin.together[1:]
    nodes, wrench = _Together.apply(worlds, sweep, changes, skin.lock, *given)
    return nodes, wrench, changes


class _Together(torch.autograd.Function):
    @staticmethod
    def forward(context, worlds: SkinOfWorlds, sweep: Sweep, changes, lock, pos, mat, friction, numbers):
        own = [a.detach().numpy().copy() for a in (pos, mat, friction, numbers[:, _PLACES])]
        with lock, worlds.stream():
            x, records, wrenches, found = worlds.follow(*own)
            context.softness = worlds.softness
            nodes = x[1:].permute(2, 0, 1, 3).contiguous()
        changes += found
        context.worlds, context.sweep, context.lock = worlds, sweep, lock
        context.own, context.records = own, (records, x)
        return nodes, worlds.tensor(np.stack(wrenches, 1))

    @staticmethod
    def jvp(context, *tangents):
        raise NotImplementedError(
            "worlds pressed together have no gradients forwards: leave `together` out, or go backwards"
        )

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(context, nodes, wrench):
        worlds, (pos, mat, friction, numbers) = context.worlds, context.own
        with context.lock, worlds.stream():
            worlds.softness = context.softness
            found = pull_back(
                worlds, context.sweep, *context.records, pos, mat, friction, numbers, nodes, wrench
            )
        pose, friction, by_number = (torch.from_numpy(a) for a in found)
        move, turn = pose.split(3, -1)
        x, y, z = turn.unbind(-1)
        zero = torch.zeros_like(x)
        skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(mat.shape)
        numbers = torch.zeros(len(pose), len(NUMBERS), dtype=torch.float64)
        numbers[:, _PLACES] = by_number
        return None, None, None, None, move, 0.5 * skew @ torch.from_numpy(mat), friction, numbers
