"""Gradients through rubber that remembers: relaxation, softening, friction elements."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from gradients import STEPS, assert_slopes, balanced, ball, differences, inputs_of, loss_of, path
from grids import first

from biotac_mj.differentiable import press
from biotac_mj.differentiable.linear.memory import LinearMemory, Memory
from biotac_mj.differentiable.record import follow, restore
from biotac_mj.differentiable.skin import NUMBERS
from biotac_mj.differentiable.sweep import Inputs, Outputs, pull_back, push_forward
from biotac_mj.skin import Material
from biotac_mj.skin.program import Launcher

MEMORY = {"prony": ((0.5, 0.03), (0.3, 0.4)), "mullins": (1.6, 2e3, 0.1), "hysteresis": ((0.4, 0.03),)}
ALL = tuple(MEMORY)
# by which each of their constants is moved
UNITS = {"prony": [[1.0, 0.05], [1.0, 0.5]], "mullins": [10.0, 1e4, 1.0], "hysteresis": [[1.0, 0.05]]}
DT = np.linspace(0.01, 0.03, 13)
# steps of one step's differences, where rounding is small; a quarter of them where points come to a kink
CLEAR = {"overstress": 6e-5, "slip": 2e-5, "constants": 6e-5, "worst": 1e-6, "mu": 4e-6, "lam": 4e-6}


def remembering(names=ALL, law="corotational", liquid=False, **options):
    own = {name: MEMORY[name] for name in names}
    material = Material(law, 1.5e6, 0.31, 0.15, liquid=liquid, **own)
    return ball(material=material, **options)


def there_and_back():
    """In so far that it slides and meets the core, then out again."""
    pos, quat = path(9)
    return torch.cat([pos, pos[:4].flip(0)]), quat[:1].expand(13, 1, 4)


def constants(names):
    return {name: torch.tensor(MEMORY[name], dtype=torch.float64) for name in names}


CASES = {
    "prony": (("prony",), "corotational", 3e-6),
    # these have kinks, near some of which a difference lies
    "hysteresis": (("hysteresis",), "neo_hookean", 1e-4),
    "mullins": (("mullins",), "svk", 1e-4),
    "all": (ALL, "linear", 1e-4),
}
QUICK = (("all", "linear", False),)


@pytest.mark.law
@pytest.mark.parametrize(
    "names, law, exact, element, liquid",
    [
        pytest.param(
            *CASES[name], element, liquid, id=f"{element}-{liquid}-{name}",
            marks=() if (name, element, liquid) in QUICK else pytest.mark.slow,
        )
        for element in ("linear", "quadratic") for liquid in (False, True) for name in CASES
    ],
)  # fmt: skip
def test_every_input_against_differences(names, law, exact, element, liquid):
    skin = remembering(names, law, element=element, liquid=liquid)
    pos, quat = there_and_back()
    given = inputs_of(13, liquid) | {"pos": pos, "quat": quat.clone(), "rest_nodes": torch.tensor(skin.rest)}
    given = {name: value.requires_grad_() for name, value in (given | constants(names)).items()}
    pressed = press(skin, dt=DT, **given)
    assert pressed.counts.slipped and pressed.counts.separated and not pressed.counts.lost
    loss_of(pressed).backward()
    draw = np.random.default_rng(1)
    ways = {name: draw.normal(size=value.shape) for name, value in given.items()}
    ways = {
        name: torch.tensor(way / np.linalg.norm(way) * UNITS.get(name, 1.0)) for name, way in ways.items()
    }
    sizes = {name: 0.3 * STEPS.get(name, 1e-4) for name in given}

    def loss(moved):
        return loss_of(press(skin, dt=DT, **given | moved)).item()

    assert_slopes(loss, given, ways, sizes, exact)


def sides_of(skin, step):
    """On which side of its kinks each point of the rubber and each sample is."""
    outer, at = skin.data.outer, step.touching
    slipping = at.sample[(outer.trial_anchor.numpy()[at.sample, 0] != at.stick.numpy()).any(1)]
    memory = step.memory
    bears = memory.energy > 1e-9 * memory.energy.max()  # what bears nothing is always on a kink
    samples = [np.isin(np.arange(len(outer.trial_geom)), some) for some in (at.sample.numpy(), slipping)]
    return np.concatenate([memory.slips.ravel(), memory.loads[bears], *samples])


@pytest.mark.parametrize("element, law", first(["linear", "quadratic"], ["neo_hookean", "corotational"]))
def test_one_step_to_rounding(element, law):
    """Nodes and memory after a step in which some points load and others unload, by the memory before, its
    constants and those of the law."""
    skin = remembering(ALL, law, element=element, modulus=lambda at: 1 + 50 * at[:, 0])
    pos, _ = there_and_back()
    mat = np.tile(np.eye(3), (1, 13, 1, 1, 1))
    steps = follow(skin, pos.numpy()[None], mat, skin.friction, skin.own, dt=DT).steps
    record, step = balanced(skin, steps[8])
    before, free = step.memory.before, skin.model.free_mask.numpy()[:, None]
    sides = sides_of(skin, step)
    assert 0.1 < (before.worst < step.memory.energy).mean() < 0.9 and step.memory.slips.any()
    draw = np.random.default_rng(5)

    def like(value, size):
        value = size * draw.normal(size=value.shape)
        return value if value.ndim == 1 else value + np.swapaxes(value, -2, -1)

    weights = {"overstress": 1e-3, "last": 1e-3, "worst": 1e-3, "slip": 1e2}
    weights = {name: like(getattr(before, name), size) for name, size in weights.items()}
    nodes = 1e3 * free * draw.normal(size=record.x[:, 0].shape)
    none = torch.zeros(1, 1, 6).double(), torch.zeros(1).double(), step.none()["anchor"]
    slopes = step.pull(torch.from_numpy(nodes)[:, None], *none, memory=Memory(**weights))
    slip = like(before.slip, 1e-2)
    ways = {
        "overstress": like(before.overstress, 1e3),
        "worst": before.worst * draw.normal(size=before.worst.shape),
        "slip": slip - np.trace(slip, axis1=-2, axis2=-1)[..., None, None] / 3 * np.eye(3),
        "constants": record.constants * draw.normal(size=len(record.constants)),
        "mu": 1e5,
        "lam": 1e5,
    }

    def moved(name, h):
        way = h * ways[name]
        if name == "constants":
            change = {"constants": record.constants + way}
        elif name in ("mu", "lam"):
            change = {"numbers": record.numbers | {name: record.numbers[name] + way}}
        else:
            memory = {
                k: getattr(before, k) + (way if k == name else 0) for k in ("overstress", "slip", "worst")
            }
            for k in ("overstress", "slip"):
                memory[k] = memory[k][..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
            change = {"begun": record.begun.replace(**memory)}
        there, step = balanced(skin, dataclasses.replace(record, **change))
        if not np.array_equal(sides_of(skin, step), sides):
            return None  # a kink lies between
        data = skin.data
        data.memory.commit_step(Launcher("cpu"), data.x, data.dt, data.worlds.failed)
        after = {k: getattr(data.rubber, k).numpy().reshape(w.shape) for k, w in weights.items()}
        felt = sum((w * after[k]).sum() for k, w in weights.items())
        return (nodes * there.x[:, 0].numpy()).sum() + felt, step.memory.before.last

    for name, way in ways.items():
        slope = slopes[name] if name in slopes else getattr(slopes["memory"], name)
        size, found = CLEAR[name], []
        while moved(name, size) is None or moved(name, -size) is None:
            size /= 4
            assert size > CLEAR[name] / 100, name
        for h in size * np.linspace(0.7, 1, 4):  # a mean has less of their noise
            ahead, back = moved(name, h), moved(name, -h)
            found.append((ahead[0] - back[0]) / (2 * h))
        # the stress that relaxes is not in the state: it is that of where the step began
        last = (ahead[1] - back[1]) / (2 * h)
        expected = float((slope * way).sum()) + (slopes["memory"].last * last).sum()
        assert np.mean(found) == pytest.approx(expected, rel=1e-6), name


def test_tangents_and_cotangents_are_of_one_jacobian():
    skin = remembering(law="neo_hookean", element="linear", liquid=True, bulk_modulus=1e5)
    pos, _ = there_and_back()
    mat, own = np.tile(np.eye(3), (1, 13, 1, 1, 1)), np.ones(len(skin.constants))
    trajectory = follow(skin, pos.numpy()[None], mat, skin.friction, skin.own, dt=DT)
    draw = np.random.default_rng(2)
    out = Outputs.of(trajectory)
    out = Outputs(*(draw.normal(size=a.shape) for a in (1e2 * out.nodes, out.wrench, 1e-4 * out.pressure)))
    areas = [surface.surface.area.numpy() for surface in (skin.data.outer, skin.data.core)]
    ahead = Inputs(
        1e-4 * draw.normal(size=(2, 1, 13, 1, 6)),
        draw.normal(size=(2, 1, 1)),
        {name: skin.own[name] * draw.normal(size=(2, 1)) for name in NUMBERS},
        1e-5 * draw.normal(size=(2, skin.model.nvert, 3)),
        *(area * draw.normal(size=(2, len(area))) for area in areas),
        10 * skin.constants * draw.normal(size=(2, len(own))),
    )
    there, back = push_forward(skin, trajectory, ahead), pull_back(skin, trajectory, out, shape=True)
    for i in range(2):
        one = (there.nodes[i] * out.nodes).sum() + (there.wrench[i] * out.wrench).sum()
        one += (there.pressure[i] * out.pressure).sum()
        by_constants = (ahead.constants[i] * back.constants).sum()
        assert abs(by_constants) > 1e-3 * abs(one)  # else it would not be seen
        other = (ahead.pose[i] * back.pose).sum() + (ahead.friction[i] * back.friction).sum() + by_constants
        other += sum((ahead.numbers[name][i] * back.numbers[name]).sum() for name in NUMBERS)
        other += sum((getattr(ahead, k)[i] * getattr(back, k)).sum() for k in ("vert", "area", "core_area"))
        assert one == pytest.approx(other, rel=1e-7)


@pytest.mark.slow
def test_torch_finds_the_gradients_right():
    skin = remembering(("prony",), element="linear", liquid=True, bulk_modulus=1e6)
    pos, quat = path(5, 2e-4)

    def felt(prony, stiff):
        pressed = press(skin, pos, quat, dt=0.02, prony=prony, youngs_modulus=1e6 * stiff)
        return pressed.wrench[-1], 1e-3 * pressed.pressure

    prony = torch.tensor(MEMORY["prony"], dtype=torch.float64, requires_grad=True)
    stiff = torch.tensor(1.5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(felt, (prony, stiff), eps=3e-6, atol=3e-5, rtol=1e-4)


@pytest.mark.slow  # quick: sixty steps without memory, every input with all
@pytest.mark.parametrize("names, by", [(("prony",), 3e-9), (ALL, 1e-8)], ids=["prony", "all"])
def test_gradients_through_sixty_steps_are_differences(names, by):
    """by: what poses are moved by [m]: over less rounding shows (with all, over 3 nm, 1.2e-4 on one processor
    and 1e-5 on another; over 10 nm 2e-6), over more a sample begins to touch."""
    skin = remembering(names, element="linear", liquid=True)
    pos, quat = path(40, 3e-5)
    pos, quat = torch.cat([pos, pos[:20].flip(0)]), quat[:1].expand(60, 1, 4)
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    prony = torch.tensor(MEMORY["prony"], dtype=torch.float64, requires_grad=True)
    loss_of(press(skin, pos + shift, quat, dt=5e-3, prony=prony)).backward()
    way = torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64)
    turn = torch.tensor([[1.0, 0.02], [-1.0, 0.3]], dtype=torch.float64)

    def moved(h, share=0.0, along=1.0):
        with torch.no_grad():
            given = dict(dt=5e-3, prony=prony + share * h * turn)
            return loss_of(press(skin, pos + along * h * way, quat, **given)).item()

    assert differences(moved, by) == pytest.approx((shift.grad @ way).item(), rel=1e-4)
    by_memory = functools.partial(moved, share=1.0, along=0.0)
    assert differences(by_memory, 1e-4) == pytest.approx((prony.grad * turn).sum().item(), rel=1e-4)


def test_a_press_is_that_of_the_material():
    """Constants that are given press as a skin made of them, and the next press is the skin's own again."""
    skin, (pos, quat) = remembering(element="linear"), there_and_back()
    before = press(skin, pos, quat, dt=DT).wrench
    other = {"prony": ((0.2, 0.1), (0.6, 0.02)), "mullins": (2.0, 1e3, 0.0), "hysteresis": ((0.1, 0.01),)}
    made = ball(material=dataclasses.replace(skin.model.material, **other), element="linear")
    given = {name: torch.tensor(value, dtype=torch.float64) for name, value in other.items()}
    expected, found = press(made, pos, quat, dt=DT), press(skin, pos, quat, dt=DT, **given)
    assert (expected.wrench - before).abs().max() > 0.01 * before.abs().max()
    assert (expected.wrench - found.wrench).abs().max() < 1e-7 * before.abs().max()
    assert torch.equal(press(skin, pos, quat, dt=DT).wrench, before)


def test_kinks_of_rubber_are_counted():
    """Points that begin or cease to slip and to bear more than ever, as the deformation tells them apart."""
    pos, quat = there_and_back()
    assert "yielded=0, softened=0" in str(
        press(remembering(("prony",), element="linear"), pos, quat, dt=DT).counts
    )
    skin, sides = remembering(element="linear"), []
    mat = np.tile(np.eye(3), (1, 13, 1, 1, 1))
    steps = follow(skin, pos.numpy()[None], mat, skin.friction, skin.own, dt=DT).steps
    for record in steps:
        restore(skin, record)
        there = LinearMemory(skin, record)
        sides.append((there.slips.ravel(), there.loads))
    changed = [[int((a != b).sum()) for a, b in zip(*pair)] for pair in zip(sides, sides[1:])]
    found = [[record.changes[0].yielded, record.changes[0].softened] for record in steps[1:]]
    assert found == changed
    turn = steps[9].changes[0]  # the way back begins
    assert turn.softened > 100 and turn.yielded > 10
    assert steps[0].changes[0].yielded == steps[0].changes[0].softened == 0


def test_a_filled_skin_begins_relaxed():
    """A filling by `press` leaves the rubber as one by the skin's options."""
    pos, quat = there_and_back()
    options = dict(element="linear", liquid=True, bulk_modulus=1e7)
    filled = press(remembering(**options, fill_volume=2e-8), pos, quat, dt=DT)
    later = press(remembering(**options), pos, quat, dt=DT, fill_volume=torch.tensor(2e-8))
    assert (filled.wrench - later.wrench).abs().max() < 1e-6 * filled.wrench.abs().max()


def test_what_a_press_cannot_take_is_refused():
    skin, (pos, quat) = remembering(("prony",), element="linear"), path(3)
    with pytest.raises(ValueError, match=r"relaxes in time: give press a dt \[s\]"):
        press(skin, pos, quat)
    with pytest.raises(ValueError, match=r"dt has shape \(2,\): give a positive time"):
        press(skin, pos, quat, dt=[0.1, 0.1])
    with pytest.raises(ValueError, match="no mullins: leave it out"):
        press(skin, pos, quat, dt=0.1, mullins=torch.ones(3))
    with pytest.raises(ValueError, match=r"prony has shape \(1, 2\): pass \(2, 2\)"):
        press(skin, pos, quat, dt=0.1, prony=torch.ones(1, 2))
    with pytest.raises(ValueError, match="prony is 'a': give real numbers"):
        press(skin, pos, quat, dt=0.1, prony="a")
    with pytest.raises(ValueError, match="tau positive"):
        press(skin, pos, quat, dt=0.1, prony=torch.tensor([[0.5, -1.0], [0.1, 1.0]]))
