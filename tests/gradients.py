"""Presses of a small skin, for gradients beside central differences."""

import dataclasses

import numpy as np
import pytest
import torch
from bubble import bubble

from biotac_mj.differentiable import Skin
from biotac_mj.differentiable.linear.step import LinearStep
from biotac_mj.skin import SkinOptions

__all__ = ["STEPS", "assert_slopes", "balanced", "ball", "differences", "inputs_of", "loss_of", "path"]

TIGHT = 1e-10


def ball(friction=0.15, material="default", modulus=None, **options):
    """The bubble under a ball."""
    options = SkinOptions(**{"tolerance": TIGHT, **options})
    return Skin(bubble(), material, options, ["sphere"], [[3e-3]], [friction], modulus=modulus)


def path(count, stride=1e-4, depth=7e-4):
    """Down, then along: pos (count, 1, 3), quat (count, 1, 4)."""
    way = stride * np.arange(count)
    down, side = np.minimum(way, depth), np.maximum(way - depth, 0)
    pos = np.stack([3e-4 + side, down - 9e-3, 0 * side], 1)[:, None]
    return torch.tensor(pos), torch.tensor([1.0, 0.1, 0.2, 0.3], dtype=torch.float64).repeat(count, 1, 1)


def loss_of(pressed, seed=0):
    """All that comes out, by chance."""
    draw = torch.Generator().manual_seed(seed)
    weights = [
        torch.randn(t.shape, generator=draw, dtype=torch.float64) for t in (pressed.nodes, pressed.wrench)
    ]
    moments = torch.tensor([1, 1, 1, 1e2, 1e2, 1e2])
    pull = 1e-5 * pressed.pressure.sum()
    return 1e2 * (weights[0] * pressed.nodes).sum() + (weights[1] * moments * pressed.wrench).sum() + pull


def differences(value, size):
    """Slope at 0 of value(h), from steps of size and half of it: what is left is of the fourth order."""
    coarse, fine = ((value(h) - value(-h)) / (2 * h) for h in (size, size / 2))
    return (4 * fine - coarse) / 3


def assert_slopes(loss, given, ways, sizes, exact):
    """That gradients are those of differences, of several inputs in one: each is moved by its own step, the
    way in which it adds to the others. None adds less than a fiftieth of another, so that what is off by 50
    times `exact` in one alone is seen; a press for each would take four times as long.

    Args:
      loss: of a dict of inputs, a number. given: name -> input with its gradient. ways: name -> way that it
        is moved. sizes: name -> how far.
    """
    with torch.no_grad():
        slopes = {name: sizes[name] * (given[name].grad * way).sum().item() for name, way in ways.items()}
        groups = []
        for name in sorted(slopes, key=lambda name: -abs(slopes[name])):
            if not groups or len(groups[-1]) == 5 or abs(slopes[name]) < 0.02 * abs(slopes[groups[-1][0]]):
                groups.append([])
            groups[-1].append(name)
        for group in groups:
            # copysign: an input whose slope is left out, zero, is moved as well
            by = {name: np.copysign(sizes[name], slopes[name]) * ways[name] for name in group}
            found = differences(lambda h, by=by: loss({n: given[n] + h * way for n, way in by.items()}), 1.0)
            assert found == pytest.approx(sum(abs(slopes[name]) for name in group), rel=exact), group


# how far each input is moved by, along a unit vector
STEPS = {
    "pos": 1e-8, "quat": 1e-5, "friction": 3e-5, "youngs_modulus": 1e3, "poissons_ratio": 3e-4,
    "contact_stiffness": 3e8, "fill_volume": 3e-12, "bulk_modulus": 1e5, "rest_nodes": 1e-6,
}  # fmt: skip


def inputs_of(count, liquid):
    pos, quat = path(count)
    numbers = {
        "friction": [0.15],
        "youngs_modulus": 1.5e6,
        "poissons_ratio": 0.31,
        "contact_stiffness": 2.7e11,
    }
    if liquid:
        numbers |= {"fill_volume": 2e-9, "bulk_modulus": 1e7}
    own = {name: torch.tensor(value, dtype=torch.float64) for name, value in numbers.items()}
    return {"pos": pos, "quat": quat, **own}


def balanced(skin, record):
    """The record at a balance to rounding, by Newton's method with the consistent tangent; the step there."""
    for _ in range(8):
        step = LinearStep(skin, record)
        force = torch.from_numpy(skin.data.force.numpy() * skin.model.free_mask.numpy()[:, None, None])
        if force.norm() < 1e-10:
            break
        record = dataclasses.replace(record, x=record.x + step.solve(force))
    return record, step
