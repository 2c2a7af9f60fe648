"""Parameters of tests whose whole grid is too much for every day."""

import itertools

import pytest

__all__ = ["covering", "first"]


def first(*axes):
    """Every combination of the axes' values, for pytest.mark.parametrize: quick is that of the first values
    alone, where another quick test has the others."""
    quick, *slow = itertools.product(*axes)
    return [pytest.param(*quick), *(pytest.param(*other, marks=pytest.mark.slow) for other in slow)]


def covering(*axes):
    """Every combination of the axes' values, for pytest.mark.parametrize: quick are as few as have every
    value once, the others are slow."""
    axes = [tuple(axis) for axis in axes]
    quick = {tuple(k % len(axis) for axis in axes) for k in range(max(map(len, axes)))}
    return [
        pytest.param(
            *(axis[i] for axis, i in zip(axes, chosen)), marks=() if chosen in quick else pytest.mark.slow
        )
        for chosen in itertools.product(*(range(len(axis)) for axis in axes))
    ]
