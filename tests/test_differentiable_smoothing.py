"""Presses with the kinks of contact smoothed."""

import functools

import numpy as np
import pytest
import torch
import trimesh
from bubble import bubble
from gradients import STEPS, ball, differences, inputs_of, loss_of, path
from grids import first

from biotac_mj.differentiable import Skin, press
from biotac_mj.skin import SkinOptions, bake_distance_grid

UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
WIDTH = 1e-6  # [m], of the size by which a millimetre's contact overcloses


@pytest.mark.law
@pytest.mark.parametrize("element, liquid", first(["linear", "quadratic"], [False, True]))
def test_every_input_against_differences(element, liquid):
    """A press that sticks, slips and squeezes the skin on the core."""
    # at 1e-10 two presses may end a Newton step apart, and what that leaves is 6e-6 of a difference by poses
    skin = ball(element=element, liquid=liquid, tolerance=1e-11)
    given = {name: value.requires_grad_() for name, value in inputs_of(9, liquid).items()}
    pressed = press(skin, smoothing=WIDTH, **given)
    assert pressed.counts.slipped and pressed.counts.touched > 1 and not pressed.counts.lost
    loss_of(pressed).backward()
    draw = np.random.default_rng(1)

    def moved(h, name, way):
        with torch.no_grad():
            return loss_of(press(skin, smoothing=WIDTH, **given | {name: given[name] + h * way})).item()

    for name, value in given.items():
        way = draw.normal(size=value.shape)
        way = torch.tensor(way / np.linalg.norm(way))
        found = differences(functools.partial(moved, name=name, way=way), STEPS[name])
        assert found == pytest.approx((value.grad * way).sum().item(), rel=3e-6), name


def slopes_about(touch, width, skin, pos, quat):
    """Of the force in the press' last step by how deep it is, 10 nm before and behind a depth [N/m]."""
    out = []
    for h in (-1e-8, 1e-8):
        deeper = torch.tensor(touch + h, dtype=torch.float64, requires_grad=True)
        way = pos + deeper * UP
        force = press(skin, way, quat, smoothing=width).wrench[-1, 0, :3].norm()
        out.append(torch.autograd.grad(force, deeper)[0].item())
    return out


def test_first_touch_has_one_slope():
    """A second sample touches: the slope jumps there by Coulomb's law, and hardly does by the smooth one."""
    skin = ball(element="linear", liquid=False)
    pos, quat = path(1)

    low, high = 4e-4, 8e-4
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        with torch.no_grad():
            press(skin, pos + middle * UP, quat)
        touches = (skin.data.outer.trial_geom.numpy() >= 0).sum()
        low, high = (low, middle) if touches > 1 else (middle, high)
    kink, smooth = (slopes_about(high, width, skin, pos, quat) for width in (0.0, WIDTH))
    assert abs(kink[1] - kink[0]) > 0.05 * abs(kink[0])
    assert abs(smooth[1] - smooth[0]) < 0.02 * abs(smooth[0])

    def pushed(h):
        with torch.no_grad():
            way = pos + (high + h) * UP
            return press(skin, way, quat, smoothing=WIDTH).wrench[-1, 0, :3].norm().item()

    assert differences(pushed, 2e-8) == pytest.approx(sum(smooth) / 2, rel=1e-5)


def test_a_press_without_is_coulombs():
    """Smoothing leaves nothing behind in the skin, and what it adds to a force falls with its width."""
    skin, (pos, quat) = ball(element="linear", liquid=False), path(9)
    before = press(skin, pos, quat).wrench
    bias = [(press(skin, pos, quat, smoothing=w).wrench - before)[-3].norm() for w in (1e-5, 1e-6, 1e-7)]
    assert torch.equal(press(skin, pos, quat).wrench, before)
    assert 0 < bias[2] < 0.2 * bias[1] < 0.04 * bias[0] < 0.05 * before[-1].norm()


@pytest.mark.parametrize("width", [-1e-6, np.nan, 1.0])
def test_a_width_that_cannot_be_is_named(width):
    with pytest.raises(ValueError, match="smoothing is .*: give a half width from 0 to 0.001 m"):
        press(ball(), *path(2), smoothing=width)


def test_a_mesh_is_smoothed_as_far_as_its_grid_is_exact():
    hull = trimesh.creation.icosphere(subdivisions=1, radius=3e-3)
    grid = bake_distance_grid(hull.vertices, hull.faces)
    skin = Skin(bubble(), options=SkinOptions(), types=["mesh"], sizes=[[0]], grids=[grid])
    spacing = skin.geoms.struct.grids.spacing.numpy().min()
    with pytest.raises(ValueError, match="smoothing is .*: give a half width from 0 to"):
        press(skin, *path(2), smoothing=0.5 * spacing)
