"""Presses for JAX are those for PyTorch, forwards and back."""

import numpy as np
import pytest
import torch
from gradients import ball, path

from biotac_mj.differentiable import for_jax, press

jax = pytest.importorskip("jax", reason="needs JAX: pip install biotac_mj[mjx]")
STEPS = 5


@pytest.fixture(autouse=True)
def double():
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.fixture(scope="module")
def pressed():
    """A function of (pos [m], E [MPa]), and a list that grows with its calls."""
    skin, (_, quat), calls = ball(element="linear", liquid=True, bulk_modulus=1e6), path(STEPS, 2e-4), []

    def function(pos, stiff):
        calls.append(1)
        out = press(skin, pos, quat, youngs_modulus=1e6 * stiff)
        return out.wrench[-1, 0, :3], 1e-3 * out.pressure

    return function, calls


def loss(force, pressure):
    return (force**2).sum() + (pressure * np.arange(1, STEPS + 1)).sum()


def test_gradients_are_those_of_pytorch(pressed):
    """Compiled, and with one press for both passes."""
    function, calls = pressed
    pos, stiff = path(STEPS, 2e-4)[0].requires_grad_(), torch.tensor(1.5).double().requires_grad_()
    force, pressure = function(pos, stiff)
    value = (force**2).sum() + (pressure * torch.arange(1, STEPS + 1)).sum()
    value.backward()
    calls.clear()
    jaxed = for_jax(function, (3,), (STEPS,))
    found = jax.jit(jax.value_and_grad(lambda *of: loss(*jaxed(*of)), (0, 1)))(pos.detach().numpy(), 1.5)
    assert len(calls) == 1
    assert float(found[0]) == pytest.approx(value.item(), rel=1e-12)
    assert np.allclose(found[1][0], pos.grad.numpy(), rtol=1e-12, atol=1e-12 * pos.grad.abs().max().item())
    assert float(found[1][1]) == pytest.approx(stiff.grad.item(), rel=1e-12)


def test_jacobians_press_once_and_worlds_are_alone(pressed):
    """`jacrev` presses once, `vmap` goes from world to world, and what no output hangs on has slope 0."""
    function, calls = pressed
    pos = path(STEPS, 2e-4)[0].numpy()
    force = for_jax(lambda pos, stiff, idle: function(pos, stiff)[0], (3,))
    calls.clear()
    by_stiff, by_idle = jax.jacrev(force, (1, 2))(pos, 1.5, 0.0)
    assert len(calls) == 1
    assert np.array_equal(by_idle, np.zeros(3))
    several = jax.vmap(force, (None, 0, None))(pos, np.array([1.5, 1.501]), 0.0)
    assert np.allclose((several[1] - several[0]) / 1e-3, by_stiff, rtol=5e-3, atol=1e-5)


def test_single_precision_is_said_to_be(pressed):
    jax.config.update("jax_enable_x64", False)
    force = for_jax(lambda pos: pressed[0](pos, torch.tensor(1.5))[0], (3,))
    out = force(path(STEPS, 2e-4)[0].numpy())
    assert out.dtype == np.float32 and np.isfinite(out).all()


def test_shapes_that_are_wrong_are_named(pressed):
    with pytest.raises(ValueError, match="no shapes"):
        for_jax(pressed[0])
    wrong = for_jax(lambda pos: pressed[0](pos, torch.tensor(1.5))[0], (4,))
    with pytest.raises(Exception, match=r"for_jax was told \[\(4,\)\]"):
        wrong(path(STEPS, 2e-4)[0].numpy())
