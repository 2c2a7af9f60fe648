"""Formulas for how the rounds of a coupled step go on, shared by `world.py` and `batch/`. Functions of plain
numbers are for Python and Warp; those of arrays take one thread for each world."""

from typing import Any

import numpy as np
import warp as wp

from ...launches import recorded

__all__ = [
    "MAX_CORRECTIONS",
    "EULER",
    "LOSS_FREQUENCY",
    "PATIENCE",
    "TOLERANCE",
    "FixedPoint",
    "Seen",
    "TRIALS",
    "accelerated",
    "affordable",
    "beta_of",
    "gamma_of",
    "in_store",
    "place_of",
    "poorly_corrected",
    "remember",
    "stayed",
    "withheld_further",
]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec6 = wp.spatial_vectord

# [m] change of the predicted pose, rotations over a lever of LEVER, below which the skin is not solved again
TOLERANCE = 2e-6
MAX_CORRECTIONS = 12  # of what the integrator's accelerations differ in from the constraint solver's
PATIENCE = 3  # steps in which a skin may stay where it was, after which it begins anew from rest
EULER = 1.5  # gamma of backward Euler's member of the family of steps
LOSS_FREQUENCY = 50.0  # [Hz] at which the rubber has its loss factor
TRIALS = 4  # to find how much of its push a skin can pay for
_BISECTIONS = 12  # of that share
_CAUTION = 0.9
_MEMORY = 6  # earlier rounds that are remembered
_KEPT = _MEMORY + 1
_NEW = wp.constant(wp.float64(1e-16))  # of a squared change: less is none that others did not show


def gamma_of(pace: Any, delay: Any, touches: Any) -> Any:
    """Newmark's gamma of a step of a skin's bodies.

    Args:
      pace: angular frequency [rad/s] at which they bounce on it, times the step. Above 2 a step does not
        resolve it, and damps it the more, up to backward Euler.
      delay: of the rubber's force, that is its loss, in steps.
      touches: whether the skin had contact in the last step. Where it begins backward Euler looks ahead: how
        stiff it will be is not known, and a body must not go deep unseen.
    """
    if not touches:
        return type(pace)(1.5)
    unresolved = type(pace)(0.0)
    if pace > type(pace)(2.0):
        unresolved = type(pace)(1.0) - type(pace)(2.0) / pace
    return type(pace)(0.5) + max(delay, unresolved)


def beta_of(gamma: Any) -> Any:
    """Newmark's beta that goes with gamma: 1/12 with 1/2, the step of fourth order in phase; 1 with 3/2."""
    least = max(type(gamma)(1.5) - gamma, type(gamma)(0.0))
    return type(gamma)(0.25) * (gamma + type(gamma)(0.5)) * (gamma + type(gamma)(0.5)) - least * least / type(
        gamma
    )(6.0)


def in_store(store: Any, before: Any, now: Any, most: Any) -> Any:
    """Energy that a skin can give, of what the last step left in it, at most what it can hold: those who have
    moved bodies since put in what its forces then, or those now, did against them; all [J]."""
    return min(store - min(before, now), most)


def affordable(store: Any, none: Any, full: Any, bend: Any) -> Any:
    """Share of a skin's push that it has the energy for. none, full: work of what acts without any push, with
    all of it; bend: half of the curve between them: forces and ways are linear in the push while no other
    contact changes; all [J]."""
    low = type(store)(0.0)
    high = type(store)(1.0)
    for _ in range(_BISECTIONS):
        p = type(store)(0.5) * (low + high)
        if none + p * (full - none - bend) + p * p * bend > max(store, type(store)(0.0)):
            high = p
        else:
            low = p
    return low


def withheld_further(push: Any, store: Any, none: Any, given: Any) -> Any:
    """A smaller share of the push, after one that gave too much; none where even no push gives too much."""
    room = (max(store, type(store)(0.0)) - none) / (given - none)
    return type(store)(_CAUTION) * max(room, type(store)(0.0)) * push


def poorly_corrected(wrong: Any, excess: Any, wrench: Any, tolerance: Any) -> Any:
    """Whether rows and passive forces together give the linear models too badly: by `wrong`, where `excess`
    is to be corrected of wrenches `wrench`, all largest entries [N]. Not where the simulation has blown up:
    nothing is greater than nan."""
    return wrong > tolerance * max(excess, wrench)


def stayed(before: Any, reached: Any) -> Any:
    """Steps in a row in which a skin has stayed where it was, after one that went a share `reached` of its
    way; before: of the steps before it."""
    if reached > type(reached)(0.0):
        return type(before)(0)
    return before + type(before)(1)


@wp.struct
class Seen:
    """Rounds of x = g(x) [round, item, world]: x and g(x) - x in turn; changes of the latter between them,
    made orthogonal, and what x moved by in these; x to try next, what remains of g(x) - x [item, world]."""

    count: wp.array(dtype=int)
    x: wp.array3d(dtype=vec6)
    residual: wp.array3d(dtype=vec6)
    change: wp.array3d(dtype=vec6)
    move: wp.array3d(dtype=vec6)
    to: wp.array2d(dtype=vec6)
    left: wp.array2d(dtype=vec6)


@wp.func
def _product(a: wp.array3d(dtype=vec6), k: int, b: wp.array3d(dtype=vec6), m: int, w: int):
    total = real(0.0)
    for i in range(a.shape[1]):
        total += wp.dot(a[k, i, w], b[m, i, w])
    return total


@wp.func
def place_of(seen: Seen, w: int):
    """The round into which x and its residual go next."""
    return seen.count[w] % _KEPT


@wp.func
def accelerated(seen: Seen, w: int, part: real):
    """Anderson's acceleration, after x and its residual were put into their round: `seen.to` to try next.

    What was seen last counts most, where g has kinks (a joint reaches its limit). part: of what no earlier
    round explains.
    """
    items = seen.to.shape[0]
    count = seen.count[w]
    now = place_of(seen, w)
    for i in range(items):
        seen.to[i, w] = seen.x[now, i, w]
        seen.left[i, w] = seen.residual[now, i, w]
    used = int(0)
    for age in range(wp.min(count, _MEMORY)):
        new = (count - age) % _KEPT
        old = (count - age - 1) % _KEPT
        for i in range(items):
            seen.change[used, i, w] = seen.residual[new, i, w] - seen.residual[old, i, w]
            seen.move[used, i, w] = seen.x[new, i, w] - seen.x[old, i, w]
        size = _product(seen.change, used, seen.change, used, w)
        for k in range(used):
            share = _product(seen.change, k, seen.change, used, w)
            for i in range(items):
                seen.change[used, i, w] = seen.change[used, i, w] - share * seen.change[k, i, w]
                seen.move[used, i, w] = seen.move[used, i, w] - share * seen.move[k, i, w]
        rest = _product(seen.change, used, seen.change, used, w)
        if rest > _NEW * size:
            along = real(0.0)
            for i in range(items):
                seen.change[used, i, w] = seen.change[used, i, w] / wp.sqrt(rest)
                seen.move[used, i, w] = seen.move[used, i, w] / wp.sqrt(rest)
                along += wp.dot(seen.change[used, i, w], seen.left[i, w])
            for i in range(items):
                seen.left[i, w] = seen.left[i, w] - along * seen.change[used, i, w]
                seen.to[i, w] = seen.to[i, w] - along * seen.move[used, i, w]
            used += 1
    for i in range(items):
        seen.to[i, w] = seen.to[i, w] + part * seen.left[i, w]
    seen.count[w] = count + 1


@wp.kernel
def _accelerate(seen: Seen, part: wp.array(dtype=real)):
    accelerated(seen, wp.tid(), part[0])


def remember(items: int, nworld: int) -> Seen:
    """A `Seen` on Warp's default device that has seen nothing."""
    seen = Seen()
    seen.count = wp.zeros(nworld, dtype=int)
    for name, rounds in (("x", _KEPT), ("residual", _KEPT), ("change", _MEMORY), ("move", _MEMORY)):
        setattr(seen, name, wp.zeros((rounds, items, nworld), dtype=vec6))
    for name in ("to", "left"):
        setattr(seen, name, wp.zeros((items, nworld), dtype=vec6))
    return seen


class FixedPoint:
    """Anderson's acceleration of x = g(x) for x (n, 6): exact for a linear g after as many rounds as it has
    dimensions."""

    def __init__(self, n: int):
        with wp.ScopedDevice("cpu"):
            seen, part = remember(n, 1), wp.zeros(1, dtype=real)
        self._part, self._seen = part.numpy(), (seen, part)
        self._accelerate = recorded(_accelerate, 1, [seen, part])
        self._count, self._x, self._residual, self._to = (
            a.numpy() for a in (seen.count, seen.x, seen.residual, seen.to)
        )

    def begin(self) -> None:
        """Forgets what it saw."""
        self._count[0] = 0

    def next(self, x: np.ndarray, residual: np.ndarray, part: float = 1.0) -> np.ndarray:
        """The x (n, 6) to try after x (n, 6) left the residual g(x) - x (n, 6). part: of what no earlier
        round explains."""
        now = self._count[0] % _KEPT
        self._x[now, :, 0], self._residual[now, :, 0] = x, residual
        self._part[0] = part
        self._accelerate()
        return self._to[:, 0].copy()
