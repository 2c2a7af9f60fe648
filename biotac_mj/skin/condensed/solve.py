"""The kernels of a step of skins, a block for each world: on CUDA one for each phase of `states`, launched
again and again until all worlds are done; on the CPU one with all phases, since a launch costs more than most
of them."""

import functools
import types

import warp as wp

from ..contact.faces import Contact
from ..contact.posed import Geoms
from ..newton.worlds import Worlds
from ..types import real, vec3
from .balance import evaluation, take_step
from .states import BALANCED, DONE, EVALUATE, NEWTON, SEARCH
from .stepping import begin_step, conclude_balance, search
from .structs import Constants, Remembered, Scratch

__all__ = ["BLOCK", "whole_step", "phases"]

wp.set_module_options({"enable_backward": False})

BLOCK = 256  # threads of a world, as `touch.BLOCK`


@functools.cache
def whole_step(shapes: str) -> wp.Kernel:
    """All phases of skins that meet such shapes, see `contact.touch`: for the CPU."""
    evaluate = evaluation(shapes)

    @wp.kernel(module=f"{__name__}.{shapes}", enable_backward=False)
    def step(
        # In:
        law: int,
        geoms: Geoms,
        rest_pressure: wp.array(dtype=real),
        c: Constants,
        # In and out:
        x: wp.array2d(dtype=vec3),
        touch: Contact,
        s: Scratch,
        r: Remembered,
        st: Worlds,
        # Out:
        node_force_out: wp.array2d(dtype=vec3),
        tier_out: wp.array(dtype=int),
    ):
        w = wp.tid()
        begin_step(w, 0, 1, law, geoms, x, touch, c, s, r, st)
        while s.solve.phase[w] != DONE:
            if s.solve.phase[w] == SEARCH:
                search(w, 0, 1, geoms, x, touch, c, s, r, st)
            if s.solve.phase[w] == EVALUATE:
                evaluate(w, 0, 1, geoms, x, touch, c, s)
            if s.solve.phase[w] == NEWTON:
                take_step(w, 0, 1, geoms, x, touch, c, s)
            if s.solve.phase[w] == BALANCED:
                conclude_balance(
                    w, 0, 1, geoms, rest_pressure, x, touch, c, s, r, st, node_force_out, tier_out
                )  # fmt: skip

    return step


@wp.kernel(module=f"{__name__}.begin", enable_backward=False, launch_bounds=(BLOCK, 2))
def _begin(
    # In:
    law: int,
    geoms: Geoms,
    c: Constants,
    x: wp.array2d(dtype=vec3),
    touch: Contact,
    r: Remembered,
    st: Worlds,
    # Out:
    s: Scratch,
):
    w, t = wp.tid()
    begin_step(w, t, wp.block_dim(), law, geoms, x, touch, c, s, r, st)


@wp.kernel(module=f"{__name__}.search", enable_backward=False, launch_bounds=(BLOCK, 2))
def _search(
    # In:
    geoms: Geoms,
    c: Constants,
    x: wp.array2d(dtype=vec3),
    touch: Contact,
    r: Remembered,
    st: Worlds,
    # Out:
    s: Scratch,
):
    w, t = wp.tid()
    if s.solve.phase[w] == SEARCH:
        search(w, t, wp.block_dim(), geoms, x, touch, c, s, r, st)


@functools.cache
def _evaluate(shapes):
    evaluate = evaluation(shapes)

    @wp.kernel(module=f"{__name__}.evaluate.{shapes}", enable_backward=False, launch_bounds=(BLOCK, 2))
    def _evaluate(
        # In:
        geoms: Geoms,
        c: Constants,
        x: wp.array2d(dtype=vec3),
        touch: Contact,
        # Out:
        s: Scratch,
    ):
        w, t = wp.tid()
        if s.solve.phase[w] == EVALUATE:
            evaluate(w, t, wp.block_dim(), geoms, x, touch, c, s)

    return _evaluate


@wp.kernel(module=f"{__name__}.newton", enable_backward=False, launch_bounds=(BLOCK, 4))
def _take_step(
    # In:
    geoms: Geoms,
    c: Constants,
    x: wp.array2d(dtype=vec3),
    touch: Contact,
    # Out:
    s: Scratch,
):
    w, t = wp.tid()
    if s.solve.phase[w] == NEWTON:
        take_step(w, t, wp.block_dim(), geoms, x, touch, c, s)


@wp.kernel(module=f"{__name__}.conclude", enable_backward=False, launch_bounds=(BLOCK, 2))
def _conclude(
    # In:
    geoms: Geoms,
    rest_pressure: wp.array(dtype=real),
    c: Constants,
    # In and out:
    x: wp.array2d(dtype=vec3),
    touch: Contact,
    s: Scratch,
    r: Remembered,
    st: Worlds,
    # Out:
    node_force_out: wp.array2d(dtype=vec3),
    tier_out: wp.array(dtype=int),
    going_out: wp.array(dtype=int),
):
    """Sets going[0] where a world is not done."""
    w, t = wp.tid()
    if s.solve.phase[w] == BALANCED:
        conclude_balance(
            w, t, wp.block_dim(), geoms, rest_pressure, x, touch, c, s, r, st, node_force_out, tier_out
        )  # fmt: skip
    if t == 0 and s.solve.phase[w] != DONE:
        going_out[0] = 1


def phases(shapes: str) -> types.SimpleNamespace:
    """The kernels for CUDA: `begin` once, then `search`, `evaluate`, `conclude` and
    `newton` in turns, so that a world goes through as many of its phases in a turn as there can be."""
    return types.SimpleNamespace(
        begin=_begin, search=_search, evaluate=_evaluate(shapes), newton=_take_step, conclude=_conclude
    )
