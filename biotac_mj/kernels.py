"""How the package's kernels are compiled, and their structs made."""

import typing

import numpy as np
import warp as wp

# Warp's flags repeat a function wherever it is called (LLVM inlines what has 40 times as many instructions as
# by its own limit), and end the search for SIMD operations early. By LLVM's own limits a press's kernels take
# a fifth less time to compile, and all but the elements' run as fast
_LIMITS = "-mllvm=-inline-", "-mllvm=-slp-"
_WARP = wp.config.cpu_compiler_flags  # kernels that are made later have the same
# PTX, which Warp makes by default, is compiled by the driver, one module at a time
wp.config.cuda_output = wp.config.cuda_output or "cubin"


def kernel_module(name: str, inlined: bool = False) -> str:
    """Names the Warp module of kernels: without adjoints, compiled for the CPU by LLVM's own limits. Other
    flags that `warp.config.cpu_compiler_flags` has when this file is imported remain.

    Args:
      name: of the Warp module; `__name__` for the kernels of a file that name no other.
      inlined: whether functions are repeated by Warp's limits: kernels of small matrices take half the time.

    Returns:
      The name, for `warp.kernel`.
    """
    flags = _WARP
    if flags is not None:
        limits = _LIMITS[1:] if inlined else _LIMITS
        flags = " ".join(flag for flag in flags.split() if not flag.startswith(limits))
    wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": flags}, name)
    return name


def set_fields(struct: typing.Any, **fields: typing.Any) -> typing.Any:
    """Sets fields of a Warp struct, and returns it. Arrays of numpy and lists become arrays of the declared
    type on the current device; others are taken as they are."""
    for name, value in fields.items():
        if isinstance(value, np.ndarray | list):
            declared = struct._cls.vars[name].type
            value = wp.array(value, dtype=declared.dtype, ndim=declared.ndim)
        setattr(struct, name, value)
    return struct


def add_zeros(struct: typing.Any, names: str, *shape: int) -> None:
    """Makes fields of a Warp struct, of these names, arrays of zeros of a shape and the declared types on the
    current device."""
    for name in names.split():
        setattr(struct, name, wp.zeros(shape, dtype=struct._cls.vars[name].type.dtype))
