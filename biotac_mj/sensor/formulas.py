"""Formulas written once for arrays, kernels and tensors.

Such a formula uses numpy's names and casts (`np.exp`, `np.where`, `np.float64`), takes scalars, and calls no
other formula. Warp compiles its text, since it takes np.exp for wp.exp; PyTorch runs it with its own
functions in numpy's place."""

import inspect
import types
from collections.abc import Callable
from typing import TypeVar

import warp as wp

__all__ = ["Number", "for_kernels", "formulas_by_name", "with_names"]

Number = TypeVar("Number")  # float64 in a kernel, an array or a tensor; the same for all arguments


def for_kernels(formula: Callable) -> wp.Function:
    """The formula as a function of float64 that kernels can call."""
    copy = types.FunctionType(formula.__code__, formula.__globals__, formula.__name__)
    copy.__annotations__ = dict.fromkeys(inspect.signature(formula).parameters, wp.float64)
    return wp.func(copy)


def with_names(formula: Callable, names: types.SimpleNamespace) -> Callable:
    """The formula with another module's functions in numpy's place."""
    return types.FunctionType(formula.__code__, formula.__globals__ | {"np": names}, formula.__name__)


def formulas_by_name(module: types.ModuleType, make: Callable) -> types.SimpleNamespace:
    """Namespace of make(formula) for all formulas that the module exports, under their names."""
    return types.SimpleNamespace(**{name: make(getattr(module, name)) for name in module.__all__})
