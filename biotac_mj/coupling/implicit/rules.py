"""Formulas for how the rounds of a coupled step go on, shared by `world.py` and `batch/`: functions of plain
numbers, for Python and Warp."""

import math
from typing import Any

# [m] change of the predicted pose, rotations over a lever of LEVER, below which a skin is not solved again: a
# solve leaves its bodies open by as much, and over so short a way its linear model errs by 5e-4 of the force
TOLERANCE = 5e-6
# a skin stays as it is while its bodies come no further than this from where it was solved [m]: there PAC
# changes by less than a tenth of a count; if the solve there has found what its linear model foretold, to so
# much of the wrenches
STILL, FORETOLD = 2e-9, 1e-6
# [m] a body that was moved further than this, and than it goes by itself in a step, was put there
TELEPORT = 1e-3
MAX_CORRECTIONS = 12  # of what the integrator's accelerations differ in from the constraint solver's
PATIENCE = 3  # unsettled steps in a row after which a skin that does not move begins anew from rest
EULER = 1.5  # gamma of backward Euler's member of the family of steps
LOSS_FREQUENCY = 50.0  # [Hz] at which the rubber has its loss factor
_UNKNOWN = math.inf  # [J] of energy
_LESS = 0.99  # of the push that gives a body what it may get: batches have single precision


def gamma_of(pace: Any, delay: Any) -> Any:
    """Newmark's gamma of a step of bodies that touched a skin in the last one.

    Args:
      pace: angular frequency [rad/s] at which they bounce on it, times the step. Above 2 a step does not
        resolve it, and damps it the more, up to backward Euler.
      delay: of the rubber's force, that is its loss, in steps.
    """
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
    """Energy that a skin can give a body, from the last step's, at most what the skin can hold: the mover of
    the body has put in the work against the forces before, or those now [J]."""
    return min(store - min(before, now), most)


def lacking(store: Any, given: Any) -> Any:
    """Energy that a body gets from a skin beyond what it has put in [J]. Each body of a skin has its own
    account: a body that presses a finger does not pay for others, except where its push moves them. So this
    much may come from what others have put in during the step itself (`spared`)."""
    lacks = given - max(store, type(store)(0.0))
    if lacks < type(store)(0.0):
        return type(store)(0.0)
    return lacks


def spared(left: Any, store: Any, given: Any) -> Any:
    """Growth of a body's energy account in a step [J], from `left` before it."""
    growth = store - given - left
    if growth > type(store)(0.0) and growth < type(store)(_UNKNOWN):
        return growth
    return type(store)(0.0)


def fraction_within(store: Any, without: Any, own: Any) -> Any:
    """Share of a wrench with which it gives a body no more energy than `store` [J], see `lacking`.

    Args:
      without: [J] work of the whole wrench on the way that the body goes without it. own: on the way by
        which it moves the body itself, which goes with the square of the fraction.
    """
    most = max(store, type(store)(0.0))
    root = math.sqrt(without * without + type(store)(4.0) * own * most)
    fraction = type(store)(0.0)
    if without > type(store)(0.0):
        fraction = (most + most) / (without + root)
    elif own > type(store)(0.0):
        fraction = (root - without) / (own + own)
    return type(store)(_LESS) * min(fraction, type(store)(1.0))


def poorly_corrected(wrong: Any, excess: Any, wrench: Any, tolerance: Any) -> Any:
    """Whether rows and passive forces together give the linear models too badly: by `wrong`, where `excess`
    is to be corrected of wrenches `wrench`, all largest entries [N]. Not where the simulation has blown up:
    nothing is greater than nan."""
    return wrong > tolerance * max(excess, wrench)
