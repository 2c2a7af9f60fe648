"""Gradients of a press against central differences, on a small skin."""

import dataclasses
import functools
import threading

import numpy as np
import pytest
import torch
import trimesh
from bubble import bubble
from gradients import STEPS, assert_slopes, balanced, ball, differences, inputs_of, loss_of, path
from grids import covering, first
from torch.autograd import forward_ad

from biotac_mj.differentiable import Skin, press
from biotac_mj.differentiable.linear.rest import areas_at
from biotac_mj.differentiable.linear.samples import differentiate_samples
from biotac_mj.differentiable.record import advance, follow
from biotac_mj.differentiable.skin import NUMBERS
from biotac_mj.differentiable.sweep import Inputs, Outputs, pull_back, push_forward
from biotac_mj.differentiable.touching import Anchors
from biotac_mj.geometry import load_skin
from biotac_mj.skin import ContactLaw, GeomSet, Material, SkinOptions, bake_distance_grid
from biotac_mj.skin import step as skin_step


def another_shape(skin):
    """Rest positions of a skin that is none's, all nodes moved."""
    return torch.tensor(skin.rest + 1e-5 * np.random.default_rng(6).normal(size=skin.rest.shape))


@pytest.mark.law
@pytest.mark.parametrize("element, liquid", first(["linear", "quadratic"], [True, False]))
def test_every_input_against_differences(element, liquid):
    """A press that sticks, slips and squeezes the skin on the core."""
    skin = ball(element=element, liquid=liquid)
    given = inputs_of(13, liquid) | {"rest_nodes": torch.tensor(skin.rest)}
    given = {name: value.requires_grad_() for name, value in given.items()}
    pressed = press(skin, **given)
    assert pressed.counts.slipped and pressed.counts.touched > 1 and not pressed.counts.lost
    assert np.abs(skin.data.core_force).max() > 0.01
    loss_of(pressed).backward()
    draw = np.random.default_rng(1)
    ways = {name: draw.normal(size=value.shape) for name, value in given.items()}
    ways = {name: torch.tensor(way / np.linalg.norm(way)) for name, way in ways.items()}
    assert_slopes(lambda moved: loss_of(press(skin, **given | moved)).item(), given, ways, STEPS, 3e-6)


def test_solves_that_begin_near_the_end_end_there_too(monkeypatch):
    """From where another press was, in fewer iterations; from nodes that are nowhere, along the path."""
    skin, counts = ball(0.18, liquid=True), []

    def counted(model, data, *given):
        skin_step(model, data, *given)
        counts.append(int(data.iterations[0]))

    monkeypatch.setattr("biotac_mj.differentiable.record.step", counted)
    pos, _ = path(9)
    given = skin, pos.numpy()[None], np.tile(np.eye(3), (1, 9, 1, 1, 1)), skin.friction, skin.own
    plain, far = follow(*given).steps, sum(counts)
    nodes = np.stack([one.x.numpy() for one in plain])
    nowhere = nodes + np.random.default_rng(0).normal(0, 2e-3, nodes.shape)
    for near, most in ((nodes, 0.7 * far), (nowhere, np.inf)):
        counts.clear()
        again = follow(*given, near=near).steps
        assert len(again) == len(plain)
        np.testing.assert_allclose(again[-1].x, plain[-1].x, rtol=0, atol=1e-8)
        np.testing.assert_allclose(again[-1].wrench, plain[-1].wrench, rtol=1e-4, atol=1e-6)
        assert sum(counts) < most


@pytest.mark.parametrize("element, liquid", covering(["linear", "quadratic"], [False, True]))
def test_one_step_to_rounding(element, liquid):
    """Nodes and anchors after a step that sticks, slips and presses on the core, by the pose, the anchors
    before and rest positions."""
    skin = ball(0.18, element=element, liquid=liquid)
    pos, _ = path(13)
    mat = np.tile(np.eye(3), (1, 13, 1, 1, 1))
    rest = another_shape(skin)
    steps = follow(skin, pos.numpy()[None], mat, skin.friction, skin.own, rest.numpy()).steps
    mixed = [r for r in steps if 0 < len(r.slips) < len(r.touches) and len(r.anchors.sample)]
    record, step = balanced(skin, mixed[-1])
    assert (skin.data.core.trial_geom.numpy() >= 0).any()
    draw = np.random.default_rng(5)
    free = skin.model.free_mask.numpy()[:, None]
    nodes, anchors = (
        1e3 * free * draw.normal(size=record.x[:, 0].shape),
        draw.normal(size=step.touching.stick.shape),
    )
    anchors_of_all = step.none()["anchor"]
    anchors_of_all[step.touching.sample] = torch.from_numpy(1e3 * anchors)
    none = torch.zeros(1, 1, 6).double(), torch.zeros(1).double()
    slopes = step.pull(torch.from_numpy(nodes)[:, None], *none, anchors_of_all, shape=True)
    rest.requires_grad_()
    areas = [areas_at(rest, surface.surface.face_np) for surface in (skin.data.outer, skin.data.core)]
    felt = [slopes[name][:, 0] for name in ("area", "core_area")]
    assert all(slope.any() for slope in felt)
    by_area = torch.autograd.grad(areas, rest, felt)[0].numpy()
    slopes["rest"] = torch.from_numpy(slopes["vert"] + by_area)
    slopes["anchor"] = slopes["anchor"][record.anchors.sample]

    def moved(h, name, way):
        shape = rest.detach().numpy()
        if name == "anchor":
            change = {"anchors": dataclasses.replace(record.anchors, anchor=record.anchors.anchor + h * way)}
        elif name == "pose":
            change = {"poses": record.poses | {"pos": record.poses["pos"] + h * way}}
        else:
            moved = torch.from_numpy(h * (1 - free) * way)[:, None]
            shape, change = shape + h * way, {"x": record.x + moved}
        skin.rest_at(shape)
        there, step = balanced(skin, dataclasses.replace(record, **change))
        after = skin.data.outer.trial_anchor.numpy()[step.touching.sample, 0]
        return (nodes * there.x[:, 0].numpy()).sum() + 1e3 * (anchors * after).sum()

    sizes = {
        "pose": ((1, 1, 3), 1e-8),
        "anchor": (record.anchors.anchor.shape, 1e-8),
        "rest": (rest.shape, 1e-8),
    }
    for name, (shape, size) in sizes.items():
        way = draw.normal(size=shape)
        expected = float((slopes[name][..., :3] * way).sum())
        found = differences(functools.partial(moved, name=name, way=way), size)
        assert found == pytest.approx(expected, rel=1e-6), name


# where a sphere is pressed (x, z) and how deep [m], which way it is dragged [rad], its friction, and how far
# beyond 1 mm the drag first ends [m]; in the first and the third one edges of the core's triangles would part
# two balances
DRAGS = [
    (-10.65e-3, -1.21e-3, 1.970e-3, 0.58, 0.5, 96e-6),
    (-9.48e-3, -1.88e-3, 1.642e-3, 3.21, 1.0, 50e-6),
    (-9.19e-3, 0.80e-3, 2.077e-3, 4.29, 1.0, 0.0),
    (-6.76e-3, -2.36e-3, 1.473e-3, 1.27, 0.5, 0.0),
    (-8.00e-3, 0.00e-3, 1.800e-3, 0.00, 0.5, 0.0),
]


def changes_along(x, z, depth, angle, friction, first):
    """Changes of the force by each of 80 moves by 0.2 um [N], which follow a step down and five along, by 1
    mm, on skin that lies on the core."""
    radius, along = 4e-3, np.array([np.cos(angle), 0, np.sin(angle)])
    skin = Skin(load_skin("coarse"), "default", SkinOptions(liquid=False), ["sphere"], [[radius]], [friction])
    corner = skin.model.geometry.vert[skin.model.geometry.outer_face]
    weight = np.array([(i, j, 12 - i - j) for i in range(13) for j in range(13 - i)]) / 12
    point = np.einsum("sb,fbk->fsk", weight, corner).reshape(-1, 3) - [x, 0, z]
    lift = np.sqrt(np.maximum(radius**2 - point[:, 0] ** 2 - point[:, 2] ** 2, 0))
    touch = np.array([x, (point[:, 1] - lift)[lift > 0].min(), z])
    pos = touch + np.array([0, depth, 0]) + np.linspace(0, 1e-3, 6)[:, None] * along
    mat = np.tile(np.eye(3), (6, 1, 1, 1))
    before = follow(skin, pos[None, :5, None], mat[None, :5], skin.friction, skin.own).steps[-1]
    geoms, outer, force = skin.geoms, skin.data.outer, []
    begun, anchors = skin.state(geoms).save(), Anchors.of(outer)
    poses = {name: getattr(geoms.struct, name).numpy().copy() for name in ("pos_last", "mat_last")}
    for far in first + 2e-7 * np.arange(81):
        skin.state(geoms).load(begun)
        anchors.give(outer)
        for name, value in poses.items():
            getattr(geoms.struct, name).numpy()[:] = value
        geoms.set_pose(pos[5:] + far * along, mat[5])
        record = advance(skin, geoms, before, 1.0, skin.constants)
        assert not record.changes[0].lost and (skin.data.core.trial_geom.numpy() >= 0).any()
        force.append(record.wrench[0, 0, :3].numpy())
    return np.linalg.norm(np.diff(force, axis=0), axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("x, z, depth, angle, friction, first", DRAGS)
def test_moves_of_a_dragged_end_change_the_force_evenly(x, z, depth, angle, friction, first):
    change = changes_along(x, z, depth, angle, friction, first)
    assert change.max() < 3 * np.median(change)


@pytest.mark.parametrize(
    "material, options",
    [
        (Material("neo_hookean", 3e5, 0.48, 0.2, liquid=False), {"element": "quadratic"}),
        (Material("svk", 1e6, 0.3, 0.2, liquid=False, stiffening=0.5), {"element": "linear"}),
        (Material("linear", 1e6, 0.3, 0.2), {"element": "linear", "bulk_modulus": np.inf}),
        (Material(friction=0.2), {"element": "linear", "bulk_modulus": 1e7, "fill_volume": 5e-9}),
        pytest.param(
            Material(poissons_ratio=0.48, friction=0.2),
            {"element": "quadratic", "bulk_modulus": 1e7},
            marks=pytest.mark.slow,
        ),
    ],
    ids=["neo_hookean", "svk", "incompressible", "filled", "averaged"],
)
def test_gradients_are_differences_for_all_laws_and_liquids(material, options):
    """Of Young's modulus, Poisson's ratio, the path, a filling, and rest positions."""
    skin = ball(material=material, modulus=lambda at: 1 + 50 * at[:, 0], **options)
    # the volume of what hardly yields is known to rounding alone, and with it the pressure of differences
    exact = 3e-4 if np.isinf(skin.model.options.bulk_modulus) else 1e-5
    pos, quat = path(5, 2e-4)
    given = {"youngs_modulus": material.youngs_modulus, "poissons_ratio": material.poissons_ratio}
    sizes = {"pos": 1e-8, "youngs_modulus": 3e-4 * material.youngs_modulus, "poissons_ratio": 3e-4}
    sizes["rest_nodes"] = 3e-8
    if skin.model.has_liquid:
        given["fill_volume"], sizes["fill_volume"] = options.get("fill_volume", 0.0), 3e-12
    given = {
        name: torch.tensor(value, dtype=torch.float64, requires_grad=True) for name, value in given.items()
    }
    given["pos"], given["rest_nodes"] = pos.requires_grad_(), another_shape(skin).requires_grad_()
    loss_of(press(skin, quat=quat, **given)).backward()
    draw = torch.Generator().manual_seed(7)
    way = torch.randn(skin.rest.shape, generator=draw, dtype=torch.float64)
    ways = dict.fromkeys(sizes, 1.0) | {"rest_nodes": way}

    def loss(moved):
        return loss_of(press(skin, quat=quat, **given | moved)).item()

    assert_slopes(loss, given, ways, sizes, exact)


SHAPES = {
    "plane": [0], "sphere": [4e-3], "capsule": [3e-3, 4e-3], "cylinder": [4e-3, 3e-3],
    "box": [4e-3, 3e-3, 2e-3], "mesh": [0],
}  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
def test_samples_on_every_shape(shape):
    """Force and anchor by place, anchor, friction and stiffness; some points lie at a kink."""
    draw, n = np.random.default_rng(3), 200
    hull = trimesh.creation.icosphere(subdivisions=1, radius=4e-3)
    grids = [bake_distance_grid(hull.vertices, hull.faces)] if shape == "mesh" else ()
    rounding = 5e-4 * (shape in ("box", "cylinder"))
    geoms = GeomSet([shape], [SHAPES[shape]], rounding=[rounding], grids=grids)
    way = draw.normal(size=(n, 3))
    local = way / np.linalg.norm(way, axis=1, keepdims=True) * draw.uniform(2e-3, 3.7e-3, (n, 1))
    if shape == "plane":
        local[:, 2] = -0.01 * abs(local[:, 2])
    if shape == "mesh":
        points, face = trimesh.sample.sample_surface(hull, n, seed=4)
        local = points - 5e-5 * hull.face_normals[face]
    stick, ones = local + 2e-5 * draw.normal(size=(n, 3)), np.ones(n)
    given = [torch.from_numpy(a) for a in (local, stick, 0.5 * ones, 2e3 * ones)]
    kind, plane = torch.zeros(n, dtype=int), torch.zeros(n, 4).double()
    units = np.array([1e-2] * 3 + [1e-5] * 3)

    def felt(*given):
        return differentiate_samples(geoms.struct, kind, plane, *given, 0.1)

    own = felt(*given)
    assert (own.anchor != given[1]).any() or shape in ("sphere", "mesh")
    slopes = own.by_local, own.by_stick, own.by_friction[..., None], own.by_stiffness[..., None]
    for at, (slope, size) in enumerate(zip(slopes, (1e-9, 1e-9, 1e-5, 1e-2))):
        way = torch.from_numpy(draw.normal(size=given[at].shape))
        ends = []
        for h in (size, -size):
            one = felt(*given[:at], given[at] + h * way, *given[at + 1 :])
            ends.append(torch.cat([one.force, one.anchor], 1).numpy())
        found = (ends[0] - ends[1]) / (2 * size) / units
        expected = np.einsum("noi,ni->no", slope, way.reshape(n, -1)) / units
        error = np.abs(found - expected).max(1) / (np.abs(expected).max(1) + 1e-3)
        assert np.percentile(error, 97) < 1e-6


def test_tangents_and_cotangents_are_of_one_jacobian():
    skin = ball(element="linear", liquid=True, bulk_modulus=1e5)  # others' slopes drown in that of water
    pos, _ = path(9)
    mat = np.tile(np.eye(3), (1, 9, 1, 1, 1))
    trajectory = follow(skin, pos.numpy()[None], mat, skin.friction, skin.own)
    draw = np.random.default_rng(2)
    out = Outputs.of(trajectory)
    out = Outputs(*(draw.normal(size=a.shape) for a in (1e2 * out.nodes, out.wrench, 1e-4 * out.pressure)))
    areas = [surface.surface.area.numpy() for surface in (skin.data.outer, skin.data.core)]
    ahead = Inputs(
        1e-4 * draw.normal(size=(2, 1, 9, 1, 6)),
        draw.normal(size=(2, 1, 1)),
        {name: skin.own[name] * draw.normal(size=(2, 1)) for name in NUMBERS},
        1e-5 * draw.normal(size=(2, skin.model.nvert, 3)),
        *(area * draw.normal(size=(2, len(area))) for area in areas),
    )
    there, back = push_forward(skin, trajectory, ahead), pull_back(skin, trajectory, out, shape=True)
    for i in range(2):
        one = (there.nodes[i] * out.nodes).sum() + (there.wrench[i] * out.wrench).sum()
        one += (there.pressure[i] * out.pressure).sum()
        other = (ahead.pose[i] * back.pose).sum() + (ahead.friction[i] * back.friction).sum()
        other += sum((ahead.numbers[name][i] * back.numbers[name]).sum() for name in NUMBERS)
        shape = [
            (getattr(ahead, name)[i] * getattr(back, name)).sum() for name in ("vert", "area", "core_area")
        ]
        assert np.abs(shape).min() > 1e-4 * abs(one)  # else they would not be seen
        other += sum(shape)
        assert one == pytest.approx(other, rel=1e-7)


def test_torch_finds_the_gradients_right():
    skin = ball(element="linear", liquid=True, bulk_modulus=1e6)  # of water the pressure has noise
    pos, quat = path(5, 2e-4)
    stiff = torch.tensor(1.5, dtype=torch.float64, requires_grad=True)

    def wrench(pos, stiff, core_pos):
        core_quat = torch.tensor([1.0, 0.1, 0, 0], dtype=torch.float64).expand(5, 4)
        pressed = press(skin, 1e-3 * pos, quat, 1e-3 * core_pos, core_quat, youngs_modulus=1e6 * stiff)
        return pressed.wrench[-1], 1e-3 * pressed.pressure

    pos = (1e3 * pos).requires_grad_()
    core = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).repeat(5, 1).requires_grad_()
    # fast: of the Jacobian one product with vectors by chance, in which each of its entries is
    assert torch.autograd.gradcheck(
        wrench, (pos, stiff, core), eps=3e-6, atol=3e-5, rtol=1e-4, fast_mode=True
    )


def of_a_shape(element):
    """What a press says of a wall that is thicker or thinner everywhere, and a dent, of the geometry's own
    nodes."""
    skin = ball(element=element, liquid=True, bulk_modulus=1e6)
    pos, quat = path(5, 2e-4)
    nodes = torch.from_numpy(skin.rest[: skin.given])
    size = nodes.norm(dim=1, keepdim=True)
    dent = torch.exp(-((nodes - nodes[nodes[:, 1].argmin()]) ** 2).sum(1, keepdim=True) / 4e-6)

    def wrench(shape):
        outwards = shape[0] * (size - 4.5e-3) / 1.5e-3 + shape[1] * dent
        pressed = press(skin, pos, quat, rest_nodes=nodes + 1e-3 * outwards * nodes / size)
        return pressed.wrench[-1], 1e-3 * pressed.pressure, 1e3 * pressed.nodes[-1].mean(0)

    return wrench, torch.tensor([0.05, -0.05], dtype=torch.float64, requires_grad=True)


@pytest.mark.slow  # quick: every input, rest nodes too
@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_gradcheck_of_a_shape(element):
    wrench, shape = of_a_shape(element)
    assert torch.autograd.gradcheck(wrench, (shape,), eps=3e-6, atol=3e-5, rtol=1e-4, fast_mode=True)


def test_of_a_shape_forwards_is_backwards():
    wrench, shape = of_a_shape("linear")
    with forward_ad.dual_level():
        ahead = forward_ad.unpack_dual(
            wrench(forward_ad.make_dual(shape.detach(), torch.ones(2).double()))[0]
        ).tangent
    weight = torch.randn(ahead.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    back = torch.autograd.grad((weight * wrench(shape)[0]).sum(), shape)[0].sum()
    along = weight * ahead
    assert abs(along.sum() - back) < 1e-6 * along.abs().sum() and back.abs() > 0.1 * along.abs().max()


@pytest.mark.parametrize("element, liquid", first(["linear", "quadratic"], [False, True]))
def test_a_shape_is_another_geometry(element, liquid):
    """Rest positions press as a skin made of them, and the next press is the skin's own again."""
    skin, other = ball(element=element, liquid=liquid), bubble()
    pos, quat = path(8)
    before = press(skin, pos, quat).wrench
    nodes = other.vert * (1 + 0.02 * np.cos(400 * other.vert[:, :1]))
    made = Skin(
        dataclasses.replace(other, vert=nodes), "default", skin.model.options, ["sphere"], [[3e-3]], [0.15]
    )
    expected, found = press(made, pos, quat), press(skin, pos, quat, rest_nodes=nodes)
    assert (expected.wrench[-1] - before[-1]).abs().max() > 0.01 * before[-1].abs().max()
    for one, two in zip((expected.nodes, expected.wrench), (found.nodes, found.wrench)):
        assert (one - two).abs().max() < 1e-6 * one.abs().max()
    assert torch.equal(press(skin, pos, quat).wrench, before)


def test_worlds_of_other_shapes_are_alone():
    """A backward pass lies at the shape that was pressed, whatever has been pressed since."""
    skin = ball(element="linear", liquid=True)
    pos, quat = path(6, 2e-4)
    first, shape = torch.from_numpy(skin.rest), another_shape(skin)
    both = torch.stack([first, shape]).requires_grad_()
    press(
        skin, pos.expand(2, -1, -1, -1), quat.expand(2, -1, -1, -1), rest_nodes=both
    ).wrench.sum().backward()
    for w, nodes in enumerate((first, shape)):
        alone = nodes.clone().requires_grad_()
        press(skin, pos, quat, rest_nodes=alone).wrench.sum().backward()
        assert torch.allclose(alone.grad, both.grad[w], rtol=1e-7)


@pytest.mark.slow  # quick: every step's inputs in five steps
def test_gradients_through_sixty_steps_are_differences():
    skin = ball(element="linear", liquid=True)
    pos, quat = path(60, 2e-5)
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    loss_of(press(skin, pos + shift, quat)).backward()
    way = torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64)

    def moved(h):
        with torch.no_grad():
            return loss_of(press(skin, pos + h * way, quat)).item()

    assert differences(moved, 1e-8) == pytest.approx((shift.grad @ way).item(), rel=1e-4)


def test_forward_mode_gives_the_differences():
    skin = ball(element="linear", liquid=True, bulk_modulus=1e6)
    pos, quat = path(6, 2e-4)
    given = {"pos": pos, "quat": quat, "youngs_modulus": torch.tensor(1.4e6, dtype=torch.float64)}
    draw = torch.Generator().manual_seed(3)
    ways = {
        name: torch.randn(value.shape, generator=draw, dtype=torch.float64) for name, value in given.items()
    }
    scale = {"pos": 1e-4, "quat": 1e-2, "youngs_modulus": 1e4}
    with forward_ad.dual_level():
        dual = {name: forward_ad.make_dual(value, scale[name] * ways[name]) for name, value in given.items()}
        ahead = forward_ad.unpack_dual(loss_of(press(skin, **dual))).tangent.item()
    given = {name: value.clone().requires_grad_() for name, value in given.items()}
    loss_of(press(skin, **given)).backward()
    back = sum((value.grad * scale[name] * ways[name]).sum().item() for name, value in given.items())
    assert ahead == pytest.approx(back, rel=1e-6)


@pytest.mark.law
def test_worlds_are_alone():
    skin = ball(element="linear", liquid=False)
    pos, quat = path(6, 2e-4)
    both = torch.stack([pos, pos + 1e-4]).requires_grad_()
    friction = torch.tensor([[0.15], [0.4]], dtype=torch.float64)
    pressed = press(skin, both, quat.expand(2, -1, -1, -1), friction=friction)
    pressed.wrench.sum().backward()
    for w in range(2):
        one = both[w].detach().requires_grad_()
        alone = press(skin, one, quat, friction=friction[w])
        alone.wrench.sum().backward()
        assert torch.equal(alone.wrench, pressed.wrench[w])
        assert torch.allclose(one.grad, both.grad[w], rtol=1e-7)


@pytest.mark.parametrize(
    "change, said",
    [
        (dict(dynamics="implicit"), "implicit dynamics are not there: take"),
        (dict(contact_law=ContactLaw()), "contact_law are not there: leave it out"),
        (dict(rest_pressure=500.0), "give the same as fill_volume="),
    ],
)
def test_what_is_not_there_is_refused(change, said):
    with pytest.raises(ValueError, match=said):
        ball(**change)


def test_an_ellipsoid_is_refused():
    with pytest.raises(ValueError, match="ellipsoid are not there: take a mesh"):
        Skin(bubble(), types=["ellipsoid"], sizes=[[1e-3, 1e-3, 2e-3]])


def test_what_a_press_cannot_take_is_refused():
    skin = ball(liquid=False)
    pos, quat = path(3)
    with pytest.raises(ValueError, match="press has .hardness.*choose from"):
        press(skin, pos, quat, hardness=1.0)
    with pytest.raises(ValueError, match="no liquid: leave fill_volume out"):
        press(skin, pos, quat, fill_volume=1e-9)
    with pytest.raises(ValueError, match=r"quat .*: pass \(nstep, 1, 3\)"):
        press(skin, pos, quat[:2])
    with pytest.raises(ValueError, match=r"rest_nodes has shape \(3, 3\): pass \("):
        press(skin, pos, quat, rest_nodes=torch.zeros(3, 3))
    with pytest.raises(ValueError, match="rest_nodes is not finite"):
        press(skin, pos, quat, rest_nodes=skin.rest * np.nan)
    with pytest.raises(ValueError, match="inverted or degenerate"):
        press(skin, pos, quat, rest_nodes=-skin.rest)
    with pytest.raises(ValueError, match="friction has shape"):
        press(skin, pos, quat, friction=torch.ones(4))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"youngs_modulus": -1.0}, "Young's modulus -1"),
        ({"poissons_ratio": 0.5}, "Poisson's ratio 0.5"),
        ({"poissons_ratio": np.nan}, "poissons_ratio"),
        ({"contact_stiffness": 0.0}, "contact_stiffness is 0.0"),
        ({"friction": [-1.0]}, "friction is"),
        ({"core_pos": torch.zeros(2, 3)}, "give both or neither"),
        ({"core_pos": "x", "core_quat": [1, 0, 0, 0]}, "core_pos is 'x': give real numbers, as a tensor or"),
        ({"dt": torch.tensor(0.1, requires_grad=True)}, r"dt requires a gradient, .*: pass dt.detach\(\)"),
        ({"dt": "x"}, r"dt is 'x': give a positive time \[s\], or \(2,\) of them"),
        ({"dt": 0.1j}, r"dt is 0.1j: give a positive time \[s\]"),
        ({"dt": torch.tensor(0.1j)}, r"dt is of torch.complex64: give a positive time \[s\]"),
        ({"dt": 0}, r"dt is 0.0: give a positive time \[s\]"),
        ({"dt": -0.1}, r"dt is -0.1: give a positive time \[s\]"),
        ({"dt": [0.1, np.nan]}, r"dt is \[0.1, nan\]: give a positive time \[s\]"),
        ({"dt": [0.1, 0.1, 0.1]}, r"dt has shape \(3,\): give a positive time \[s\], or \(2,\) of them"),
        ({"friction": np.array(["a"])}, "friction is of <U1: give real numbers"),
        ({"youngs_modulus": {}}, "youngs_modulus is {}: give real numbers"),
        ({"rest_nodes": [[1.0], [1.0, 2.0]]}, r"rest_nodes is \[\[1.0\], \[1.0, 2.0\]\]: give real numbers"),
    ],
)
def test_values_that_cannot_be_are_named(given, said):
    skin = ball()
    with pytest.raises(ValueError, match=said):
        press(skin, *path(2), **given)


def test_a_pose_that_is_none_is_named():
    skin, (pos, quat) = ball(), path(2)
    with pytest.raises(ValueError, match="quat is zero"):
        press(skin, pos, 0 * quat)
    with pytest.raises(ValueError, match="pos is empty or not finite"):
        press(skin, pos * np.nan, quat)
    with pytest.raises(ValueError, match="pos is 'x': give real numbers"):
        press(skin, "x", quat)
    with pytest.raises(ValueError, match="quat is of complex128: give real numbers"):
        press(skin, pos, 1j * quat.numpy())


def test_a_press_leaves_the_skins_friction():
    skin = ball()
    before = press(skin, *path(9)).wrench
    press(skin, *path(9), friction=[0.01])
    assert torch.equal(press(skin, *path(9)).wrench, before) and skin.friction == [0.15]


def test_two_threads_press_one_skin():
    """One waits for the other."""
    skin, found = ball(), []
    alone = press(skin, *path(9)).wrench
    threads = [threading.Thread(target=lambda: found.append(press(skin, *path(9)).wrench)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(torch.equal(wrench, alone) for wrench in found) and len(found) == 2


@pytest.mark.parametrize(
    "kind, size, rounding, sharp",
    [
        ("box", 3e-3, 0.0, True),
        ("box", 3e-3, 1e-3, False),
        ("cylinder", 3e-3, 0.0, True),
        ("sphere", 3e-3, 0.0, False),
    ],
)
def test_sharp_edges_are_counted(kind, size, rounding, sharp):
    """A step on an edge that is not rounded may have several balances; turned so that it comes first."""
    skin = Skin(bubble(), "default", types=[kind], sizes=[[size] * 3], friction=[0.15], rounding=[rounding])
    quat = torch.tensor([np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0]).expand(4, 1, 4)
    reach = {"box": 2**0.5 * size - (2**0.5 - 1) * rounding, "cylinder": 2**0.5 * size, "sphere": size}[kind]
    low = -bubble().vert[:, 1].min()
    pos = torch.zeros(4, 1, 3, dtype=torch.float64)
    pos[:, 0, 1] = torch.tensor([2e-4, 0.0, -2e-4, -4e-4]) * -1 - low - reach + 2e-4
    pressed = press(skin, pos, quat)
    assert pressed.wrench.abs().max() > 1e-2 and not pressed.counts.lost
    assert (pressed.counts.sharp > 0) == sharp


def test_linear_solves_are_as_good_as_the_steps():
    assert [ball(tolerance=t).precision for t in (1e-3, 1e-6, 1e-7, 1e-10)] == pytest.approx(
        [1e-8, 1e-8, 1e-9, 1e-9]
    )
    assert Skin(bubble(), precision=1e-5).precision == 1e-5
