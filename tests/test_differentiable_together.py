"""Gradients of many worlds pressed at once."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp
from gradients import STEPS, assert_slopes, ball, loss_of, path
from torch.autograd import forward_ad

from biotac_mj.differentiable import press
from biotac_mj.differentiable.together.solve import Gmres, refuse_unsolved
from biotac_mj.skin import Material
from biotac_mj.skin.program import Program
from biotac_mj.skin.types import DOUBLE, SINGLE

CUDA = pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")
OFF = [[0, 0, 0], [5e-5, 0, 2e-5], [-3e-4, -1e-4, 0]]
NUMBERS = {
    "friction": [[0.15], [0.25], [0.05]],
    "youngs_modulus": [1.5e6, 1.3e6, 2e6],
    "poissons_ratio": [0.31, 0.35, 0.45],
    "contact_stiffness": [2.7e11, 2.5e11, 3e11],
}


def worlds(nworld, count=13):
    """Presses that stick, slip and squeeze the skin on the core, each world its own."""
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


@pytest.mark.parametrize("element", ["linear", pytest.param("quadratic", marks=pytest.mark.slow)])
def test_every_input_against_differences(element):
    skin = ball(element=element, liquid=False)
    given = worlds(2)
    pressed = press(skin, **given, together="cpu")
    assert (skin.together[1].data.core_force != 0).any((1, 2)).all()
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
    with forward_ad.dual_level(), pytest.raises(NotImplementedError, match="no gradients forwards: leave"):
        press(dry, forward_ad.make_dual(pos, pos), quat, together="cpu")


@pytest.mark.parametrize("single", [False, True])
def test_systems_of_worlds(single):
    """Unsymmetric ones, one without a right-hand side, by an inverse that is near and may be single."""
    draw = torch.Generator().manual_seed(2)
    n, w = 40, 3
    A = torch.eye(3 * n) * torch.logspace(0, 4, 3 * n) + 0.2 * torch.randn(w, 3 * n, 3 * n, generator=draw)
    A, near = A.double(), torch.logspace(0, 4, 3 * n).double()
    right = torch.randn(n, w, 3, generator=draw, dtype=torch.float64)
    right[:, 1] = 0

    precision = SINGLE if single else DOUBLE
    p, q, r, z = (wp.zeros((n, w), dtype=precision.vec, device="cpu") for _ in range(4))
    part = wp.zeros((1, n // 8, w), dtype=wp.float64, device="cpu")
    mask, on = wp.ones(n, dtype=wp.float64, device="cpu"), wp.zeros(w, dtype=int, device="cpu")

    def solve(error, most):
        gmres = Gmres(precision, 8, mask, p, q, r, z, part, on, error, most)
        wp.to_torch(gmres.right).copy_(right)

        def product(v, out):
            v, flags = wp.to_torch(v).double().permute(1, 0, 2).reshape(w, -1), wp.to_torch(on).bool()
            found = torch.einsum("wij,wj->wi", A, v).view(w, n, 3).permute(1, 0, 2)
            wp.to_torch(out)[:, flags] = found[:, flags].to(wp.to_torch(out))

        def inverse(v):
            v = wp.to_torch(v)
            wp.to_torch(z).copy_(
                (v.permute(1, 0, 2).reshape(w, -1) / near.to(v)).view(w, n, 3).permute(1, 0, 2)
            )

        def record(program):
            products = (p, q), (gmres.x, gmres.product)
            calls = [lambda own=own: program.call(lambda: product(*own)) for own in products]
            gmres.put(program, *calls, lambda v: program.call(lambda: inverse(v)))

        Program("cpu", record).run()
        return wp.to_torch(gmres.x), gmres

    x, gmres = solve(1e-9, 400)
    exact = torch.linalg.solve(A, right.permute(1, 0, 2).reshape(w, -1))
    assert (x.permute(1, 0, 2).reshape(w, -1) - exact).abs().max() < 1e-7 * exact.abs().max()
    assert gmres.taken.numpy()[1] > 10 and not x[:, 1].any() and not gmres.failed.numpy().any()
    failed = solve(1e-9, 3)[1].failed.numpy()
    assert failed[0] == failed[2] == 4 and failed[1] == 0
    with pytest.raises(ValueError, match="of world 0 was not solved with 3 products"):
        refuse_unsolved(failed)


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
