"""Kernels of a step, with a block of threads for each world: on CUDA three, launched repeatedly until all
worlds have finished, since one of all phases takes minutes to compile; on the CPU one, since a launch takes
longer than most phases."""

import functools
import types

import warp as wp

from ...kernels import kernel_module
from ..contact.posed import Geoms
from ..contact.touch import SKINS
from ..newton.worlds import Worlds
from ..types import real, vec3
from .balance import newton_method
from .states import BALANCED, DONE, NEWTON, SEARCH
from .stepping import begin_step, conclude_balance, search
from .structs import Constants, Remembered, Scratch

LARGEST_BLOCK = 256  # threads of a world, the most samples of a face


def block_of(samples: int) -> int:
    """Threads of a world on CUDA for faces of samples^2 samples: 128 where they suffice, since twice as many
    skins are then solved at once (24 % more steps a second of five fingers that press, H200)."""
    return LARGEST_BLOCK // 2 if samples**2 <= LARGEST_BLOCK // 2 else LARGEST_BLOCK


@functools.cache
def whole_step() -> wp.Kernel:
    """Kernel with all phases and all shapes of geoms, for the CPU."""
    balance = newton_method(SKINS)

    @wp.kernel(module=kernel_module(f"{__name__}.whole"))
    def step(
        # In:
        law: int,
        geoms: Geoms,
        rest_pressure: wp.array(dtype=real),
        c: Constants,
        # In and out:
        s: Scratch,
        r: Remembered,
        st: Worlds,
        # Out:
        node_force_out: wp.array2d(dtype=vec3),
        tier_out: wp.array(dtype=int),
    ):
        w = wp.tid()
        begin_step(w, 0, law, geoms, s, st)
        while s.solve.phase[w] != DONE:
            if s.solve.phase[w] == SEARCH:
                search(w, 0, geoms, c, s, r, st)
            if s.solve.phase[w] == NEWTON:
                balance(w, 0, geoms, c, s)
            if s.solve.phase[w] == BALANCED:
                conclude_balance(w, 0, geoms, rest_pressure, c, s, r, st, node_force_out, tier_out)

    return step


@wp.kernel(module=kernel_module(f"{__name__}.begin"), launch_bounds=(LARGEST_BLOCK, 2))
def _begin(
    # In:
    law: int,
    geoms: Geoms,
    st: Worlds,
    # Out:
    s: Scratch,
):
    w, t = wp.tid()
    begin_step(w, t, law, geoms, s, st)


@wp.kernel(module=kernel_module(f"{__name__}.search"), launch_bounds=(LARGEST_BLOCK, 2))
def _search(
    # In:
    geoms: Geoms,
    c: Constants,
    r: Remembered,
    st: Worlds,
    # Out:
    s: Scratch,
):
    w, t = wp.tid()
    if s.solve.phase[w] == SEARCH:
        search(w, t, geoms, c, s, r, st)


@functools.cache
def _balance(shapes):
    balance = newton_method(shapes)

    @wp.kernel(module=kernel_module(f"{__name__}.balance.{shapes}"), launch_bounds=(LARGEST_BLOCK, 2))
    def _balance(
        # In:
        geoms: Geoms,
        c: Constants,
        # Out:
        s: Scratch,
    ):
        w, t = wp.tid()
        if s.solve.phase[w] == NEWTON:
            balance(w, t, geoms, c, s)

    return _balance


@wp.kernel(module=kernel_module(f"{__name__}.conclude"), launch_bounds=(LARGEST_BLOCK, 2))
def _conclude(
    # In:
    geoms: Geoms,
    rest_pressure: wp.array(dtype=real),
    c: Constants,
    # In and out:
    s: Scratch,
    r: Remembered,
    st: Worlds,
    # Out:
    node_force_out: wp.array2d(dtype=vec3),
    tier_out: wp.array(dtype=int),
    going_out: wp.array(dtype=int),
):
    """Sets going[0] if a world has not finished."""
    w, t = wp.tid()
    if s.solve.phase[w] == BALANCED:
        conclude_balance(w, t, geoms, rest_pressure, c, s, r, st, node_force_out, tier_out)
    if t == 0 and s.solve.phase[w] != DONE:
        going_out[0] = 1


def phases(shapes: str) -> types.SimpleNamespace:
    """Kernels for CUDA: `begin` once, then `search`, `balance` and `conclude` until all worlds are done."""
    return types.SimpleNamespace(begin=_begin, search=_search, balance=_balance(shapes), conclude=_conclude)
