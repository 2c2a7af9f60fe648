"""Gradients of many worlds pressed at once."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp
from gradients import STEPS, assert_slopes, ball, loss_of, path
from torch.autograd import forward_ad

from biotac_mj.differentiable import press
from biotac_mj.differentiable.linear.inverse import StepInverse, solve_by_gmres
from biotac_mj.differentiable.linear.step import LinearStep
from biotac_mj.differentiable.record import follow
from biotac_mj.differentiable.skin import NUMBERS as OF_SKIN
from biotac_mj.differentiable.skin import SkinWorlds
from biotac_mj.skin import Material

CUDA = pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")
OFF = [[0, 0, 0], [5e-5, 0, 2e-5], [-3e-4, -1e-4, 0]]
NUMBERS = {
    "friction": [[0.15], [0.25], [0.05]],
    "youngs_modulus": [1.5e6, 1.3e6, 2e6],
    "poissons_ratio": [0.31, 0.35, 0.45],
    "contact_stiffness": [2.7e11, 2.5e11, 3e11],
}


def worlds(nworld, count=13):
    """Presses that stick, slip and barrier the skin on the core, each world its own."""
    pos, quat = path(count)
    given = {"pos": pos + torch.tensor(OFF[:nworld])[:, None, None], "quat": quat.expand(nworld, -1, -1, -1)}
    given |= {name: torch.tensor(value[:nworld], dtype=torch.float64) for name, value in NUMBERS.items()}
    return {name: value.double().clone().requires_grad_() for name, value in given.items()}


def gradients(skin, given, **options):
    """Of a loss of all that comes out, by all that goes in."""
    pressed = press(skin, **given, **options)
    names = ("nodes", "wrench", "pressure")
    on_host = dataclasses.replace(pressed, **{name: getattr(pressed, name).cpu() for name in names})
    return pressed, torch.autograd.grad(loss_of(on_host), list(given.values()))


@pytest.mark.parametrize("element", ["linear", pytest.param("quadratic", marks=pytest.mark.slow)])
def test_worlds_together_are_worlds_alone(element):
    skin = ball(element=element, liquid=False)
    (alone, one), (together, other) = (gradients(skin, worlds(3), together=t) for t in (None, "cpu"))
    assert torch.equal(alone.nodes, together.nodes) and torch.equal(alone.wrench, together.wrench)
    assert alone.changes == together.changes
    assert together.counts.slipped and together.counts.touched and not together.counts.lost
    for name, a, b in zip(NUMBERS, one, other):
        assert (a - b).abs().max() < 1e-6 * a.abs().max(), name


@pytest.mark.law
@pytest.mark.parametrize("element", ["linear", pytest.param("quadratic", marks=pytest.mark.slow)])
def test_every_input_against_differences(element):
    skin = ball(element=element, liquid=False)
    given = worlds(2)
    pressed = press(skin, **given, together="cpu")
    assert (skin.in_worlds(2, "cpu").data.core_force != 0).any((1, 2)).all()
    loss_of(pressed).backward()
    draw = np.random.default_rng(1)
    ways = {name: draw.normal(size=value.shape) for name, value in given.items()}
    ways = {name: torch.tensor(way / np.linalg.norm(way)) for name, way in ways.items()}

    def loss(moved):
        return loss_of(press(skin, **given | moved, together="cpu")).item()

    assert_slopes(loss, given, ways, STEPS, 3e-6)


def test_a_backward_pass_is_of_its_own_press():
    """Whatever has been pressed since, with other constants."""
    skin = ball(element="linear", liquid=False)
    given = worlds(2, 9)
    pressed = press(skin, **given, together="cpu")
    press(skin, *path(12), youngs_modulus=3e6, together="cpu")
    press(skin, **worlds(2, 12) | {"youngs_modulus": torch.tensor([3e6, 4e6])}, together="cpu")
    press(skin, *path(12), rest_nodes=1.02 * skin.rest)
    found = torch.autograd.grad(loss_of(pressed), given["pos"])[0]
    expected = gradients(skin, worlds(2, 9), together="cpu")[1][0]
    assert torch.equal(found, expected)


def test_one_world_needs_no_number():
    skin, (pos, quat) = ball(element="linear", liquid=False), path(6, 2e-4)
    expected, found = press(skin, pos, quat), press(skin, pos, quat, together="cpu")
    assert torch.equal(expected.wrench, found.wrench) and found.pressure.shape == (6,)


def test_what_is_not_there_is_refused():
    pos, quat = path(3)
    dry = ball(element="linear", liquid=False)
    prony = Material("linear", 1.5e6, 0.31, 0.15, liquid=False, prony=((0.5, 0.03),))
    with pytest.raises(ValueError, match="liquid is not there for worlds that go together: leave"):
        press(ball(), pos, quat, together="cpu")
    with pytest.raises(ValueError, match="prony, mullins or hysteresis is not there"):
        press(ball(material=prony), pos, quat, dt=0.1, together="cpu")
    with pytest.raises(ValueError, match="rest_nodes is not there"):
        press(dry, pos, quat, rest_nodes=dry.rest, together="cpu")
    with pytest.raises(ValueError, match="smoothing is not there"):
        press(dry, pos, quat, smoothing=1e-6, together="cpu")
    with pytest.raises(ValueError, match="together is 'gpu': give 'cpu', or a CUDA device"):
        press(dry, pos, quat, together="gpu")


def test_forwards_is_backwards():
    skin, given = ball(element="linear", liquid=False), worlds(2, 5)
    draw = torch.Generator().manual_seed(3)
    ways = {n: torch.randn(v.shape, generator=draw, dtype=torch.float64) for n, v in given.items()}
    ways = {name: STEPS[name] * way for name, way in ways.items()}
    with forward_ad.dual_level():
        dual = {name: forward_ad.make_dual(value.detach(), ways[name]) for name, value in given.items()}
        ahead = forward_ad.unpack_dual(loss_of(press(skin, **dual, together="cpu"))).tangent.item()
    back = sum((g * ways[n]).sum().item() for n, g in zip(given, gradients(skin, given, together="cpu")[1]))
    assert ahead == pytest.approx(back, rel=1e-6)


@pytest.mark.parametrize("transpose", [False, True])
@pytest.mark.parametrize("preconditioner", ["sparse", "dense"])
def test_inverse_of_steps_solves_as_the_factor_does(preconditioner, transpose):
    """What CUDA takes, here on the CPU, in double and in single precision, where skin lies on the core."""
    skin, given = ball(element="linear", liquid=False), worlds(2)
    both = SkinWorlds(skin.model, skin.made_with, 2, skin.precision, preconditioner)
    pos, mat = given["pos"].detach().numpy(), np.tile(np.eye(3), (2, 13, 1, 1, 1))
    numbers = {name: skin.own[name] for name in OF_SKIN}
    record = follow(both, pos, mat, given["friction"].detach().numpy(), numbers).steps[-1]
    assert (
        (both.data.core.trial_geom.numpy() >= 0).any()
        and len(record.slips)
        and not any(change.lost for change in record.changes)
    )
    step = LinearStep(both, record)
    right = torch.randn(record.x.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = step.solve(right, transpose)
    step._inverses[transpose] = inverse = StepInverse(both, *step._blocks, transpose)
    assert inverse(right).dtype is (torch.float32 if preconditioner == "dense" else torch.float64)
    before = both.products
    found = step.solve(right, transpose)
    assert both.products - before < 60
    assert (found - expected).abs().max() < 1e-6 * expected.abs().max()


@pytest.mark.parametrize("single", [False, True])
def test_systems_of_worlds_are_each_solved(single):
    """Unsymmetric ones, one without a right-hand side, by an inverse that is near and may be single."""
    draw = torch.Generator().manual_seed(2)
    n, w = 40, 3
    A = torch.eye(3 * n) * torch.logspace(0, 4, 3 * n) + 0.2 * torch.randn(w, 3 * n, 3 * n, generator=draw)
    A, near = A.double(), torch.logspace(0, 4, 3 * n).double()
    right = torch.randn(n, w, 3, generator=draw, dtype=torch.float64)
    right[:, 1] = 0

    def rows(v):
        return v.permute(1, 0, 2).reshape(w, -1)

    def product(v):
        return torch.einsum("wij,wj->wi", A, rows(v)).view(w, n, 3).permute(1, 0, 2)

    def inverse(v):
        found = (rows(v) / near).view(w, n, 3).permute(1, 0, 2)
        return found.float() if single else found

    def solve(error, most):
        how = {"digits": 1e-4, "restart": 40} if single else {}
        return solve_by_gmres(product, inverse, right, error, most, **how)

    x, count = solve(1e-9, 400)
    exact = torch.linalg.solve(A, rows(right))
    assert (rows(x) - exact).abs().max() < 1e-7 * exact.abs().max()
    assert count > 10 and not x[:, 1].any()
    with pytest.raises(ValueError, match="of world 0 was not solved with 3 products"):
        solve(1e-9, 3)


@CUDA
@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_cuda_is_the_cpu(element):
    """The balance is met to the step's tolerance, and no better with directions in single precision."""
    skin = ball(element=element, liquid=False, tolerance=1e-6)
    (alone, one), (together, other) = (gradients(skin, worlds(3), together=t) for t in (None, "cuda:0"))
    assert together.nodes.is_cuda and not together.counts.lost
    assert (alone.wrench - together.wrench.cpu()).abs().max() < 1e-4 * alone.wrench.abs().max()
    for name, a, b in zip(("pos", "quat", *NUMBERS), one, other):
        assert (a - b).abs().max() < 1e-3 * a.abs().max(), name


@CUDA
def test_tensors_of_cuda_have_gradients_there():
    skin = ball(element="linear", liquid=False)
    given = {name: value.detach().cuda().requires_grad_() for name, value in worlds(2, 9).items()}
    for together in (None, "cuda:0"):
        found = gradients(skin, given, together=together)[1]
        assert all(g.is_cuda and g.any() for g in found)
