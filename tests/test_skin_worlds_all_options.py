"""One batch in which every option is on and differs by world, against each world alone: a model and data with
that world's material, modulus, law of contact and liquid and nothing else."""

import dataclasses
import functools

import numpy as np
import pytest
import warp as wp
from blocks import shell, skin

from biotac_mj.skin import ContactLaw, GeomSet, Material, SkinData, SkinModel, SkinOptions, step
from biotac_mj.skin.per_world import make_room, make_worlds

DEPTH = 1.2e-3
# shares of the depth, and of the way aside: adhesion has one balance where contact comes in small steps
WAY = ((0.0, 0), (0.3, 0), (0.35, 0), (0.4, 0), (0.8, 0.2), (1.0, 0.4), (0.5, 0.4), (-0.03, 0.4))
OPTIONS = SkinOptions(
    dynamics="implicit",
    mass_damping=20.0,
    stiffness_damping=1e-4,
    liquid=True,
    contact_stiffness=5e10,
    tolerance=1e-6,
    max_newton=100,
    max_cg=200,
)


@functools.cache
def body():
    """A filled ball of rubber round a rigid core, held on one side."""
    import trimesh

    vert, elem, inner = shell(10e-3, 8e-3, 1, 1)
    ball = trimesh.creation.icosphere(subdivisions=1)
    held = np.flatnonzero(vert[:, 2] < -6e-3)
    return skin(vert, elem, held, inner_face=inner, core=(7e-3 * ball.vertices, ball.faces.astype(np.int32)))


def draw(count, seed=1):
    """What the first `count` of 64 worlds are: materials, values for `make_worlds`, frictions, time steps,
    places and motions."""
    rng, n = np.random.default_rng(seed), 64
    materials = [
        Material(
            law="neo_hookean",
            youngs_modulus=rng.uniform(0.6e6, 1.5e6),
            poissons_ratio=rng.uniform(0.3, 0.45),
            density=rng.uniform(900, 3000),
            prony=((rng.uniform(0, 0.4), rng.uniform(0.01, 0.1)), (rng.uniform(0, 0.2), 0.3)),
            mullins=(rng.uniform(1.5, 4.0), rng.uniform(50, 500), rng.uniform(0, 0.4)),
            hysteresis=((rng.uniform(0, 0.5), rng.uniform(0.002, 0.01)),),
            stiffening=rng.uniform(0.1, 10.0),
        )
        for _ in range(n)
    ]
    values = {
        "modulus": rng.uniform(0.6, 1.6, (n, len(body().elem))),
        "adhesion": rng.choice([0.0, 0.02, 0.05], n),
        "adhesion_hysteresis": rng.uniform(1.0, 3.0, n),
        "friction_exponent": rng.uniform(0, 0.4, n),
        "friction_pressure": rng.uniform(1e4, 1e5, n),
        "bulk_modulus": rng.choice([0.0, 1e6, 2.2e9, np.inf], n),
        "fill_volume": rng.uniform(-1e-8, 2e-8, n),
    }
    values["fill_volume"][values["bulk_modulus"] == 0] = 0.0
    ways = dict(
        friction=rng.uniform(0.0, 0.8, n),
        dt=rng.uniform(2e-3, 2e-2, n),
        place=rng.uniform(-1e-3, 1e-3, (n, 2)),
        depth=rng.uniform(0.6, 1.0, n) * DEPTH,
        shake=rng.uniform(-2e-4, 2e-4, (n, 3)),
    )
    values, ways = ({name: value[:count] for name, value in one.items()} for one in (values, ways))
    return materials[:count], values, ways


def walk(model, data, ways, who, device):
    """(steps, nworld, 3) force on a sphere that goes in, aside and out, the frame shaken."""
    at = {name: value[who] for name, value in ways.items()}
    n = len(who)
    geoms = GeomSet(["sphere"], [(4e-3,)], nworld=n, device=device)
    geoms.set_friction(at["friction"][:, None])
    out = []
    for depth, aside in WAY:
        centre = np.column_stack([at["place"] + [4e-4 * aside, 0], 14e-3 - depth * at["depth"]])
        geoms.set_pose(centre[:, None], np.tile(np.eye(3), (n, 1, 1, 1)))
        frame = (at["shake"] * aside, np.tile(np.eye(3), (n, 1, 1)))
        step(model, data, geoms, at["dt"], *frame)
        assert data.converged.all(), np.flatnonzero(~data.converged)
        out.append(data.wrench[:, 0, :3])
    return np.array(out)


def together(n, device):
    materials, values, ways = draw(n)
    options = dataclasses.replace(OPTIONS, contact_law=ContactLaw())
    options, modulus = make_room(options, None, values, len(body().elem))
    model = SkinModel(body(), materials[0], options, device, modulus=modulus)
    data = make_worlds(model, n, materials, values)
    return walk(model, data, ways, np.arange(n), device)


def alone(n, w, device):
    materials, values, ways = draw(n)
    mine = {name: value[w] for name, value in values.items()}
    law = ContactLaw(
        *(mine[k] for k in ("friction_exponent", "friction_pressure", "adhesion", "adhesion_hysteresis"))
    )
    bulk, fill = mine["bulk_modulus"], mine["fill_volume"]
    options = dataclasses.replace(OPTIONS, contact_law=law, liquid=bool(bulk))
    if bulk:
        options = dataclasses.replace(options, bulk_modulus=bulk, fill_volume=fill)
    model = SkinModel(body(), materials[w], options, device, modulus=mine["modulus"])
    return walk(model, SkinData(model), ways, np.array([w]), device)[:, 0]


@pytest.mark.parametrize("n", [8, pytest.param(64, marks=pytest.mark.slow)])
@pytest.mark.parametrize("device, bound", [("cpu", 1e-5), ("cuda:0", 1e-4)])
def test_worlds_that_differ_in_everything_are_each_alone(n, device, bound):
    if device != "cpu" and not wp.is_cuda_available():
        pytest.skip("needs CUDA")
    forces = together(n, device)
    peak = abs(forces).max()
    assert peak > 0.1 and np.ptp(abs(forces).max((0, 2))) > 0.3 * peak
    away = {w: float(abs(forces[:, w] - alone(n, w, device)).max() / peak) for w in range(n)}
    assert not {w: a for w, a in away.items() if not a <= bound}
