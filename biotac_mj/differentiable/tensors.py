"""Arguments as tensors, with one-line errors; PyTorch in numpy's place."""

import math
import types
from collections.abc import Sequence

import numpy as np
import torch

from ..short_repr import short_repr

# numpy names in `sensor.formulas`
TORCH = types.SimpleNamespace(
    float64=float, pi=math.pi, exp=torch.exp, log=torch.log, where=torch.where, pow=torch.pow
)

_ARRAYS = torch.Tensor, np.ndarray, np.generic


def skew(v: torch.Tensor) -> torch.Tensor:
    """`geometry.rigid.skew` of tensors: (..., 3) to (..., 3, 3)."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape, 3)


def add_rows(into: torch.Tensor, at: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
    """Adds value (m, ...) to the rows `at` (m,) of `into`, with repetitions; returns it."""
    return into.index_add_(0, at.reshape(-1), value.reshape(-1, *into.shape[1:]))


def transposed(
    outputs: Sequence[torch.Tensor], inputs: Sequence[torch.Tensor], cotangents: Sequence[torch.Tensor]
) -> Sequence[torch.Tensor]:
    """Cotangents of the inputs of a linear map from those of its outputs."""
    pairs = [(out, given) for out, given in zip(outputs, cotangents) if out.requires_grad]
    if not pairs:
        return [torch.zeros_like(value) for value in inputs]
    out, given = zip(*pairs)
    how = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
    return torch.autograd.grad(out, inputs, given, **how)


def real_tensor(
    name: str, value: object, wanted: str = "give real numbers, as a tensor or an array of one shape"
) -> torch.Tensor:
    """A tensor of double precision, on its device.

    Raises:
      ValueError: `value` is no real tensor, in one line that begins with `name` and ends with `wanted`.
    """
    try:
        # PyTorch would drop imaginary parts
        if not (isinstance(value, _ARRAYS) and torch.as_tensor(value).is_complex()):
            return torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        pass
    said = f"of {value.dtype}" if isinstance(value, _ARRAYS) else short_repr(value)
    raise ValueError(f"{name} is {said}: {wanted}")
