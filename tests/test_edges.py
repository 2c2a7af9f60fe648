"""Edges, corners and rims sharper than a skin resolves: what slides without friction gives its work back."""

import itertools

import mujoco
import numpy as np
import pytest
import trimesh
import warp as wp

import biotac_mj
from biotac_mj.geometry import load_skin
from biotac_mj.skin.contact.meshes import bake_distance_grid
from biotac_mj.skin.contact.posed import Geoms, meet
from biotac_mj.skin.contact.shapes import primitive_distance
from biotac_mj.skin.geoms import GeomSet
from biotac_mj.skin.types import real, vec3

HALF = np.array([4e-3, 6e-3, 4e-3])  # of the box [m]
DEPTH, WAY = 1.3e-3, 3e-3  # [m] pressed, dragged
BEGIN, SURFACE = -12e-3, 8.5e-3  # [m] along the pad, and above its axis


def turned(angle, axis=(0.0, 1.0, 0.0)):
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, np.array(axis), np.radians(angle))
    return quat


def egg(around=16, along=10):
    """Corners of an ellipsoid's facets [m]."""
    turn, tilt = 2 * np.pi * np.arange(around) / around, np.pi * np.arange(along + 1)[:, None] / along
    x, y, z = np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)
    return np.stack([7.5e-3 * x, 5e-3 * y, 5e-3 * z + 0 * x], axis=-1).reshape(-1, 3)


def lowest(half, quat):
    """Height of a box's centre above its lowest point [m]."""
    mat = np.zeros(9)
    mujoco.mju_quat2Mat(mat, quat)
    corners = np.array(list(itertools.product((1, -1), repeat=3))) * half
    return -(corners @ mat.reshape(3, 3).T)[:, 2].min()


def shape(name):
    """MJCF of a geom, its rotation, and the height of its centre above its lowest point [m]."""
    if name.startswith(("edge", "mesh")):  # an edge across the way; upright at 0 degrees, flat at 45
        quat, half = turned(45 + float(name[4:])), "{} {} {}".format(*HALF)
        kind = 'type="mesh" mesh="box"' if name.startswith("mesh") else f'type="box" size="{half}"'
        return kind, quat, lowest(HALF, quat)
    if name.startswith("corner"):  # the diagonal points down; turned about it, and tilted
        spin, tilt = (float(angle) for angle in name[6:].split(",")) if name[6:] else (0.0, 0.0)
        quat = turned(125.2644, (0.5**0.5, -(0.5**0.5), 0))
        for turn in (turned(spin, (0, 0, 1)), turned(tilt, (0, 1, 0))):
            mujoco.mju_mulQuat(quat, turn, quat.copy())
        return 'type="box" size=".004 .004 .004"', quat, lowest(np.full(3, 4e-3), quat)
    if name == "rim":
        return 'type="cylinder" size=".004 .004"', turned(45), 4e-3 * 2**0.5
    if name.startswith("facets"):  # as large as the faces of the skin
        roll, yaw = (float(angle) for angle in name[6:].split(","))
        quat, mat = np.zeros(4), np.zeros(9)
        mujoco.mju_mulQuat(quat, turned(yaw, (0, 0, 1)), turned(roll, (1, 0, 0)))
        mujoco.mju_quat2Mat(mat, quat)
        return 'type="mesh" mesh="egg"', quat, -(egg() @ mat.reshape(3, 3).T)[:, 2].min()
    if name == "thin":  # an ellipsoid of 0.17 mm radius where it is sharpest
        return 'type="ellipsoid" size=".001 .004 .006"', turned(0), 6e-3
    return 'type="sphere" size=".0035"', turned(0), 3.5e-3


def cycle(name, tier, skin, steps=40):
    """Drags a body without friction out and back over an elastic pad at one depth, after a first time.

    Returns:
      Force on the skin in the BioTac frame (2 steps, 3) [N], errors of pressure times area against it (k,),
      how many steps did not settle.
    """
    kind, quat, height = shape(name)
    corners = np.array(list(itertools.product((1, -1), repeat=3))) * HALF
    vert, facets = (" ".join(f"{c:.6f}" for c in points.ravel()) for points in (corners, egg()))
    start = np.array([BEGIN, 0, SURFACE + height])
    spec = mujoco.MjSpec.from_string(f"""
        <mujoco><option timestep=".004" gravity="0 0 0"/>
          <asset><mesh name="box" vertex="{vert}"/><mesh name="egg" vertex="{facets}"/></asset>
          <worldbody><site name="s" quat="1 -1 0 0"/>
            <body name="o" mocap="true" pos="{start[0]} 0 {start[2]}" quat="{" ".join(map(str, quat))}">
              <geom {kind} friction="0 0 0"/></body></worldbody></mujoco>""")
    handle = biotac_mj.attach(spec, site="s", tier=tier, skin=skin, friction=0.0, readings=False)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    way = np.concatenate([np.arange(1, steps + 1), np.arange(steps)[::-1]]) / steps
    force, errors, unsettled = [], [], 0
    for depth in np.linspace(0, DEPTH, 31)[1:]:
        data.mocap_pos[0] = start - [0, 0, depth]
        mujoco.mj_step(model, data)
    for k, share in enumerate(np.tile(way, 2)):
        data.mocap_pos[0] = start + [WAY * share, 0, -DEPTH]
        mujoco.mj_step(model, data)
        unsettled += handle.read(data, "status")[0] < 1
        if k >= len(way):
            force.append(handle.read(data, "contact_force")[:3].copy())
            if k % 3 == 0:
                errors.append(pressure_error(handle, model, data, load_skin(skin).outer_face, force[-1]))
    return np.array(force), np.array(errors), unsettled


def pressure_error(handle, model, data, face, force):
    """|F - sum p A| / |F| of the pressure on the faces."""
    corner = handle.vert_xpos(model, data)[face]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2
    pressure = handle.contact_pressure(model, data, of="faces")
    return np.linalg.norm(force + (pressure[:, None] * area).sum(0)) / np.linalg.norm(force)


def apparent_friction(force):
    """What is lost in a cycle, by its way and the load."""
    out, back = np.split(force, 2)
    return (out[:, 0].mean() - back[:, 0].mean()) / (out[:, 1].mean() + back[:, 1].mean())


EDGES = ["edge0", "edge20", "edge30", "edge45", "mesh0", "mesh20", "corner", "rim"]


TILTED = ["corner30,0", "corner0,10", "corner0,20", "corner30,20"]


@pytest.mark.parametrize("name", ["edge0", "edge20", "edge45", "corner", "rim", *TILTED])
def test_a_cycle_without_friction_gives_back_its_work(name):
    force, errors, unsettled = cycle(name, "condensed", "coarse")
    assert unsettled == 0 and force[:, 1].min() > 0.2
    assert abs(apparent_friction(force)) < 0.01
    assert np.median(errors) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("tier", ["condensed", "full"])
@pytest.mark.parametrize("name", EDGES)
def test_a_cycle_on_the_default_skin_gives_back_its_work(name, tier):
    force, errors, unsettled = cycle(name, tier, "default", steps=60)
    assert unsettled <= (2 if tier == "full" else 0)
    assert abs(apparent_friction(force)) < 0.01
    assert np.median(errors) < 0.02


@pytest.mark.parametrize("sides, begins", [(16, 2.0 / 0.9118), (24, 2.0 / 0.7832), (100, 10.0)])
def test_edges_of_narrow_facets_are_no_edges(sides, begins):
    """Facets of 1.17 mm, which are wider than the skin's faces with edges of 0.91 mm, of 0.78 mm, and of 0.19
    mm as those of the indenters, where samples are 0.2 mm apart."""
    turn = 2 * np.pi * np.arange(sides) / sides
    circle = 3e-3 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    prism = trimesh.convex.convex_hull(np.concatenate([circle, circle + [0, 0, 5e-3]]))
    geoms = GeomSet(["mesh"], [[]], grids=[bake_distance_grid(prism.vertices, prism.faces, cells=16)])
    geoms.resolve(2e-4, 3)
    angles = np.degrees(np.arccos(geoms.struct.turn.numpy()[0]))
    assert angles == pytest.approx([begins, 2.5 * begins], rel=1e-3)


@wp.kernel(enable_backward=False)
def _push(y: wp.array(dtype=vec3), u: vec3, v: vec3, geoms: Geoms, out: wp.array(dtype=vec3)):
    """Force over stiffness [m] of the samples y in the middle of faces with edges u, v on geom 0."""
    i = wp.tid()
    dn = primitive_distance(geoms.kind[0], geoms.size[0], geoms.rounding[0], y[i])
    third = real(1.0 / 3.0)
    met = meet(geoms, 0, 0, y[i], dn, vec3(third, third, third), u, v, 0)
    out[i] = -wp.min(met.gap, real(0.0)) * met.weight * met.normal


@pytest.mark.parametrize("kind, size", [("box", [4e-3, 6e-3, 4e-3]), ("cylinder", [4e-3, 4e-3])])
@pytest.mark.parametrize("tilt", [0.0, 6.5, 20.0, 45.0, 80.0])
def test_force_is_continuous_where_two_sides_are_as_near(kind, size, tilt):
    """A sample 12 um below a side goes out past an edge, under skin that is so far off the side's normal."""
    geoms = GeomSet([kind], [size])
    geoms.resolve(2e-4, 3)
    geoms.set_pose(np.zeros((1, 3)), np.eye(3)[None])
    z = np.arange(-60e-6, 20e-6, 2e-8)
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    u, v = vec3(0.0, 5e-4, 0.0), vec3(-5e-4 * s, 0.0, 5e-4 * c)  # the skin is on the side of -(u x v)
    if np.cross(v, u)[0] < 0:
        u = -u
    out = wp.zeros(len(z), dtype=vec3)
    y = wp.array(np.stack([np.full(len(z), 4e-3 - 12e-6), 0 * z, 4e-3 + z], axis=1), dtype=vec3)
    wp.launch(_push, len(z), [y, u, v, geoms.struct], [out])
    force = out.numpy()
    jump = np.linalg.norm(np.diff(force, axis=0), axis=1)
    assert force[:, 0].max() > 1e-6
    assert jump.max() < 0.05 * np.linalg.norm(force, axis=1).max()


@pytest.mark.parametrize("tier", ["condensed", pytest.param("full", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["facets90,30", "facets90,70"])
def test_a_cycle_of_a_faceted_egg_gives_back_its_work(name, tier):
    force, _errors, _unsettled = cycle(name, tier, "coarse")
    assert force[:, 1].min() > 0.4
    assert abs(apparent_friction(force)) < 0.01


@pytest.mark.parametrize("tier", ["condensed", pytest.param("full", marks=pytest.mark.slow)])
def test_a_cycle_of_a_thin_ellipsoid_gives_back_its_work(tier):
    force, *_ = cycle("thin", tier, "coarse")
    assert abs(apparent_friction(force)) < 0.02


@pytest.mark.parametrize("tier", ["condensed", pytest.param("full", marks=pytest.mark.slow)])
def test_each_step_along_a_thin_ellipsoid_settles(tier):
    assert cycle("thin", tier, "coarse")[2] == 0


def test_a_mesh_is_met_as_the_box_that_it_is():
    box, mesh = (cycle(name, "condensed", "coarse", steps=6)[0] for name in ("edge20", "mesh20"))
    np.testing.assert_allclose(mesh, box, atol=2e-3 * abs(box).max())


def test_an_edge_pushes_along_the_normal_of_the_skin():
    """It pushes along the skin's normal, and what is along the way is the skin's slope."""
    force, *_ = cycle("edge0", "condensed", "coarse")
    assert abs(force[:, 0]).max() < 0.15 * force[:, 1].mean()
