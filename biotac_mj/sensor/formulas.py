"""Formulas written once for arrays, kernels and tensors.

Such a formula uses numpy's names and casts (`np.exp`, `np.where`, `np.float64`), takes scalars, and calls no
other formula. Warp compiles its text, since it takes np.exp for wp.exp; PyTorch runs it with its own
functions in numpy's place."""

import inspect
import types
from collections.abc import Callable
from typing import TypeVar

import warp as wp

Number = TypeVar("Number")  # float64 in a kernel, an array or a tensor; the same for all arguments


def for_kernels(formula: Callable) -> wp.Function:
    """The formula as a function of float64 that kernels can call."""
    copy = types.FunctionType(formula.__code__, formula.__globals__, formula.__name__)
    copy.__annotations__ = dict.fromkeys(inspect.signature(formula).parameters, wp.float64)
    return wp.func(copy)


def with_names(formula: Callable, names: types.SimpleNamespace) -> Callable:
    """The formula with another module's functions in numpy's place."""
    return types.FunctionType(formula.__code__, formula.__globals__ | {"np": names}, formula.__name__)


def with_globals(module: types.ModuleType, names: dict) -> dict:
    """Globals of a module of kernels with other values of some names, in which its kernels and functions are
    plain ones: their text can run on something else than Warp's numbers, unless it assigns in place (+=)."""
    given = vars(module) | names
    for name, value in vars(module).items():
        if isinstance(value, (wp.Function, wp.Kernel)):
            given[name] = types.FunctionType(value.func.__code__, given, name)
    return given
