"""Signed distances against MuJoCo's, closed forms and trimesh."""

import itertools

import mujoco
import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.optimize import minimize_scalar

from biotac_mj.geometry import indenter
from biotac_mj.geometry.closest import closest_on_face
from biotac_mj.skin import GeomSet, bake_distance_grid
from biotac_mj.skin.contact.meshes import Grids, pack_grids
from biotac_mj.skin.contact.posed import Geoms
from biotac_mj.skin.contact.shapes import distance, distance_bound
from biotac_mj.skin.contact.touch import SKINS

SIZES = {
    "sphere": (0.8, 0, 0),
    "capsule": (0.5, 0.7, 0),
    "cylinder": (0.6, 0.9, 0),
    "ellipsoid": (0.5, 0.8, 1.1),
    "box": (0.5, 0.8, 1.1),
}


@wp.kernel(enable_backward=False)
def _distances(
    geoms: Geoms,
    point: wp.array(dtype=wp.vec3d),
    out: wp.array(dtype=wp.vec4d),
    bound: wp.array(dtype=wp.float64),
):
    i = wp.tid()
    out[i] = distance(geoms.kind[0], geoms.size[0], geoms.rounding[0], geoms.grids, geoms.grid[0], point[i])
    bound[i] = distance_bound(
        geoms.kind[0], geoms.size[0], geoms.rounding[0], geoms.grids, geoms.grid[0], point[i]
    )


def evaluate(kind, size, points, rounding=0.0, grids=()):
    """Normals (n, 3), distances (n,) and their lower bounds (n,)."""
    geoms = GeomSet([kind], [size], rounding=[rounding], grids=grids)
    out, bound = wp.zeros(len(points), dtype=wp.vec4d), wp.zeros(len(points), dtype=wp.float64)
    wp.launch(
        _distances,
        dim=len(points),
        inputs=[geoms.struct, wp.array(points, dtype=wp.vec3d)],
        outputs=[out, bound],
        device="cpu",
    )
    return out.numpy()[:, :3], out.numpy()[:, 3], bound.numpy()


def cloud(n=300, reach=1.8, seed=0):
    return np.random.default_rng(seed).uniform(-reach, reach, (n, 3))


def gradient(kind, size, points, h=1e-6, **options):
    """Of the distance by central differences."""
    out = np.empty_like(points)
    for axis in range(3):
        offset = h * np.eye(3)[axis]
        out[:, axis] = (
            evaluate(kind, size, points + offset, **options)[1]
            - evaluate(kind, size, points - offset, **options)[1]
        ) / (2 * h)
    return out


@pytest.mark.parametrize("kind", [*SIZES, "plane"])
def test_outside_equals_mujoco(kind):
    """mj_geomDistance to a tiny sphere as the probe; its convex solver is told to be as exact as doubles
    allow."""
    size = SIZES.get(kind, (1, 1, 1))
    text = " ".join(map(str, size))
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option ccd_tolerance="1e-10" ccd_iterations="500"/><worldbody><geom name="shape" '
        f'type="{kind}" size="{text}"/>'
        '<body mocap="true"><geom name="probe" type="sphere" size="1e-4"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    points = cloud()
    _, ours, _ = evaluate(kind, () if kind == "plane" else size, points)
    outside = ours > 1e-3
    theirs = []
    for p in points[outside]:
        data.mocap_pos[0] = p
        mujoco.mj_kinematics(model, data)
        theirs.append(mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None) + 1e-4)
    assert outside.sum() > 100
    # sizes are about one; on ellipsoids some of MuJoCo's iterations stop early: see the next test
    error = abs(ours[outside] - theirs)
    assert np.quantile(error, 0.95) < 1e-6
    assert error.max() < (1e-4 if kind == "ellipsoid" else 1e-6)


def test_ellipsoid_equals_a_search():
    radii, points = np.array(SIZES["ellipsoid"]), cloud(60, seed=5)
    normal, ours, _ = evaluate("ellipsoid", radii, points)
    for p, n, d in zip(points, normal, ours):
        foot = p - d * n
        assert ((foot / radii) ** 2).sum() == pytest.approx(1, abs=1e-9)  # on the surface
        slope = foot / radii**2
        np.testing.assert_allclose(n, slope / np.linalg.norm(slope), atol=1e-9)  # and at right angles to it
        assert (d > 0) == (((p / radii) ** 2).sum() > 1)


def inside_distance(kind, size, p):
    """Minus the distance to the surface from inside, in closed form or by a scalar search."""
    a, b, c = size
    if kind == "sphere":
        return np.linalg.norm(p) - a
    if kind == "capsule":
        return np.linalg.norm(p - [0, 0, np.clip(p[2], -b, b)]) - a
    if kind == "cylinder":
        return max(np.hypot(*p[:2]) - a, abs(p[2]) - b)
    return max(abs(p) - size)


@pytest.mark.parametrize("kind", ["sphere", "capsule", "cylinder", "box"])
def test_distances_inside_are_the_smallest_to_a_face(kind):
    points = cloud(2000)
    _, ours, _ = evaluate(kind, SIZES[kind], points)
    expected = np.array([inside_distance(kind, np.array(SIZES[kind]), p) for p in points])
    inside = expected < 0
    assert inside.sum() > 40
    np.testing.assert_allclose(ours[inside], expected[inside], atol=1e-12)
    np.testing.assert_array_equal(ours < 0, inside)


def test_distances_inside_an_ellipsoid_equal_a_search():
    """The nearest of very many points of the surface."""
    radii = np.array(SIZES["ellipsoid"])
    surface = trimesh.creation.icosphere(subdivisions=6).vertices * radii
    points = cloud(200, 1.1)
    inside = ((points / radii) ** 2).sum(1) < 0.98
    _, ours, _ = evaluate("ellipsoid", radii, points[inside])
    nearest = np.linalg.norm(points[inside][:, None] - surface[None], axis=2).min(1)
    assert (ours < 0).all()
    assert (-ours <= nearest + 1e-9).all()  # no surface point is nearer than the distance
    np.testing.assert_allclose(-ours, nearest, atol=5e-3)  # the surface's points are 0.02 apart


@pytest.mark.parametrize("kind", [*SIZES, "plane"])
def test_normal_is_the_gradient(kind):
    points = cloud(seed=1)
    normal, d, bound = evaluate(kind, SIZES.get(kind, ()), points)
    expected = gradient(kind, SIZES.get(kind, ()), points)
    smooth = abs(np.linalg.norm(expected, axis=1) - 1) < 1e-6  # off the medial axis
    assert smooth.mean() > 0.95
    np.testing.assert_allclose(normal[smooth], expected[smooth], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-12)
    assert (bound <= d + 1e-12).all()


@pytest.mark.parametrize("kind", ["box", "cylinder"])
def test_a_rounded_solid_is_a_smaller_one_grown(kind):
    """Outside, a rounded solid is the smaller one grown by r: MuJoCo's distance less r."""
    r, points = 0.2, cloud(seed=2)
    size = np.array(SIZES[kind])
    size[: 3 if kind == "box" else 2] -= r
    _, sharp, _ = evaluate(kind, SIZES[kind], points)
    _, small, _ = evaluate(kind, size, points)
    normal, rounded, _ = evaluate(kind, SIZES[kind], points, rounding=r)
    np.testing.assert_allclose(rounded, small - r, atol=1e-12)
    assert (rounded >= sharp - 1e-12).all()  # it loses its edges only
    face = (
        np.array([[0.51, 0, 0], [0.2, 0.1, 1.2]])
        if kind == "box"
        else np.array([[0.61, 0, 0], [0.1, 0.1, 1.0]])
    )
    np.testing.assert_allclose(
        evaluate(kind, SIZES[kind], face, rounding=r)[1], evaluate(kind, SIZES[kind], face)[1], atol=1e-12
    )
    smooth = rounded > 1e-6
    np.testing.assert_allclose(
        normal[smooth], gradient(kind, SIZES[kind], points[smooth], rounding=r), atol=1e-5
    )


def test_points_on_axes_have_a_normal():
    """Centres and axes, where the direction is not unique, still give a unit normal and the right
    distance."""
    for kind, depth in (
        ("sphere", 0.8),
        ("capsule", 0.5),
        ("cylinder", 0.6),
        ("box", 0.5),
        ("ellipsoid", 0.5),
    ):
        normal, d, _ = evaluate(kind, SIZES[kind], np.zeros((1, 3)))
        assert d[0] == pytest.approx(
            -depth, rel=1e-4
        )  # the ellipsoid's root is ill-conditioned at its very centre
        assert np.linalg.norm(normal) == pytest.approx(1)


def test_ellipsoid_far_and_flat():
    """A needle and a far point: the distance by a search over the ellipse."""
    radii, p = np.array([2e-3, 2e-3, 9e-3]), np.array([3e-3, 0, 10e-3])

    def away(t):
        return np.hypot(radii[0] * np.sin(t) - p[0], radii[2] * np.cos(t) - p[2])

    expected = minimize_scalar(away, bounds=(0, np.pi / 2), method="bounded", options=dict(xatol=1e-12)).fun
    _, d, _ = evaluate("ellipsoid", radii, p[None])
    assert d[0] == pytest.approx(expected, rel=1e-9)


# --- meshes  ---


@pytest.fixture(scope="module")
def ring():
    vert, face = indenter("ring_7mm").mesh()
    return trimesh.Trimesh(vert, face, process=False), bake_distance_grid(vert, face)


def test_ring_equals_trimesh(ring):
    """Near the surface the distance is the triangles'; trimesh works in millimetres, as its tolerances are
    absolute."""
    mesh, grid = ring
    rng = np.random.default_rng(0)
    on, index = trimesh.sample.sample_surface(mesh, 400, seed=1)
    points = on + mesh.face_normals[index] * rng.uniform(-2e-4, 5e-5, (400, 1))
    large = trimesh.Trimesh(mesh.vertices * 1e3, mesh.faces, process=False)
    expected = -trimesh.proximity.signed_distance(large, points * 1e3) * 1e-3
    normal, ours, bound = evaluate("mesh", (), points, grids=[grid])
    near = expected < 0.25 * grid.spacing  # farther out only a bound is needed
    assert near.sum() > 200
    np.testing.assert_allclose(
        ours[near], expected[near], atol=2e-8
    )  # single precision of a few millimetres is 1e-7 of them
    assert (bound <= expected + 1e-8).all()
    assert ((ours > 0) == (expected > 0))[abs(expected) > 1e-8].all()
    # normals lead away from the nearest point
    closest, _, _ = trimesh.proximity.closest_point(large, points * 1e3)
    away = (points * 1e3 - closest) * np.sign(expected)[:, None]
    clear = near & (abs(expected) > 1e-5)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    assert (
        np.einsum("ij,ij->i", away, normal)[clear] > 0.999
    ).mean() > 0.98  # the rest lies at equal distance of two triangles


def test_ring_has_a_hole(ring):
    """A tunnel, not its convex hull: the middle of the ring is outside, by the radius of the hole."""
    mesh, grid = ring
    centre = mesh.bounding_box.centroid[None]
    large = trimesh.Trimesh(mesh.vertices * 1e3, mesh.faces, process=False)
    expected = -trimesh.proximity.signed_distance(large, centre * 1e3)[0] * 1e-3
    _, d, _ = evaluate("mesh", (), centre, grids=[grid])
    assert expected > 1e-4
    assert d[0] == pytest.approx(expected, abs=0.5 * grid.spacing)  # from the grid


def test_deep_inside_and_far_away():
    cube = trimesh.creation.box(extents=[1e-2] * 3)
    grid = bake_distance_grid(cube.vertices, cube.faces, cells=20)
    points = np.array([[0, 0, 3e-3], [0, 3.5e-3, 1e-3], [1.0, 0, 0], [6e-3, 0, 0]])
    normal, d, _ = evaluate("mesh", (), points, grids=[grid])
    np.testing.assert_allclose(d[[0, 1, 3]], [-2e-3, -1.5e-3, 1e-3], atol=1e-6)
    np.testing.assert_allclose(normal[:2], [[0, 0, 1], [0, 1, 0]], atol=1e-3)
    assert d[2] > 0.9  # surely no contact


def test_mesh_sphere_equals_sphere():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=3.5e-3)
    grid = bake_distance_grid(ball.vertices, ball.faces, cells=24)
    direction = np.random.default_rng(3).standard_normal((200, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = direction * np.random.default_rng(4).uniform(2.5e-3, 3.52e-3, (200, 1))
    normal, d, _ = evaluate("mesh", (), points, grids=[grid])
    sagitta = 3.5e-3 * (1 - np.cos(0.5 * ball.edges_unique_length.max() / 3.5e-3 * 2 / np.sqrt(3)))
    near = d > -grid.spacing
    np.testing.assert_allclose(d[near], (np.linalg.norm(points, axis=1) - 3.5e-3)[near], atol=1.5 * sagitta)
    np.testing.assert_allclose(
        d, np.linalg.norm(points, axis=1) - 3.5e-3, atol=1.5 * sagitta + 0.05 * grid.spacing
    )
    assert (np.einsum("ij,ij->i", normal, direction) > 0.998).all()  # facets lean by up to 2.3 degrees


@pytest.mark.parametrize("size", [(1.5e-2, 2e-3, 1.5e-2), (2e-3, 1e-2, 2e-3), (1.5e-2, 8e-3, 1.5e-3)])
def test_sharp_corners_have_an_outside(size):
    """Around thin edges and corners of a hull, out to millimetres, the side is that of its planes."""
    rng = np.random.default_rng(0)
    hull = trimesh.convex.convex_hull(rng.standard_normal((24, 3)) * size)
    grid = bake_distance_grid(np.array(hull.vertices), np.array(hull.faces), cells=48)
    ends = hull.vertices[hull.edges_unique[rng.integers(len(hull.edges_unique), size=20_000)]]
    share = rng.choice([0.0, 0.5, 1.0], (20_000, 1))
    spread = 10 ** rng.uniform(-6, -2.5, (20_000, 1)) * rng.standard_normal((20_000, 3))
    points = (1 - share) * ends[:, 0] + share * ends[:, 1] + spread
    height = (points @ hull.face_normals.T - (hull.triangles[:, 0] * hull.face_normals).sum(1)).max(1)
    _, d, _ = evaluate("mesh", (), points, grids=[grid])
    clear = np.abs(height) > 2e-8  # of rounding
    assert (np.sign(d) == np.sign(height))[clear].all()


def test_close_to_an_edge_normals_do_not_jump():
    """Five micrometres off edges and corners, where a nanometre of the nearest point turns the normal."""
    corner = 1e-3 * np.array([[0.0, 0, 0], [7, 1, 0], [2, 6, 1], [1, 2, 8]])
    solid = trimesh.Trimesh(corner, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    draw, away, normal = np.random.default_rng(0), 5e-6, []
    for (i, j), sides in zip(solid.face_adjacency_edges, solid.face_adjacency):
        out = solid.face_normals[sides].sum(0)
        share = draw.uniform(0.1, 0.9, (50, 1))
        normal.append(
            (share * corner[i] + (1 - share) * corner[j], np.tile(out / np.linalg.norm(out), (50, 1)))
        )
    out = corner - corner.mean(0)
    normal.append((corner, out / np.linalg.norm(out, axis=1, keepdims=True)))
    foot, normal = (np.concatenate(parts) for parts in zip(*normal))
    found, far, _ = evaluate(
        "mesh", (0, 0, 0), foot + away * normal, grids=[bake_distance_grid(corner, solid.faces)]
    )
    np.testing.assert_allclose(found, normal, atol=1e-9)
    np.testing.assert_allclose(far, away, atol=1e-14)


def test_two_meshes_keep_apart():
    """Grids lie one after another in memory: the second geom sees its own."""
    small, large = (trimesh.creation.box(extents=[s] * 3) for s in (4e-3, 8e-3))
    grids = [bake_distance_grid(m.vertices, m.faces, cells=16) for m in (small, large)]
    p = np.array([[0.0, 0, 3.95e-3]])
    assert evaluate("mesh", (), p, grids=grids[:1])[1] == pytest.approx(1.95e-3, abs=2e-5)
    both = GeomSet(["mesh", "sphere", "mesh"], [(), (1.0,), ()], grids=grids)
    assert both.struct.grid.numpy().tolist() == [0, 0, 1]

    out, bound = wp.zeros(1, dtype=wp.vec4d), wp.zeros(1, dtype=wp.float64)
    both.struct.grid = wp.array([1], dtype=int)
    wp.launch(
        _distances,
        dim=1,
        inputs=[both.struct, wp.array(p, dtype=wp.vec3d)],
        outputs=[out, bound],
        device="cpu",
    )
    assert out.numpy()[0, 3] == pytest.approx(-0.05e-3, abs=1e-8)


# --- bad input  ---


@pytest.mark.parametrize("face, text", [
    (lambda face: face[1:], "is open: its inside is not defined, 3 edges have one face only; close"),
    (lambda face: face[:0], "has no faces: give a triangle mesh"),
    (lambda face: face[:, ::-1], "is inside out: flip its faces, so that all normals point outwards"),
    (lambda face: np.concatenate([face[:1, ::-1], face[1:]]),
     "has faces of both orientations: make all normals point outwards"),
    (lambda face: np.concatenate([face, face[:, ::-1]]), "encloses no volume: give a solid"),
])  # fmt: skip
def test_a_mesh_that_bounds_no_solid_says_why(face, text):
    ball = trimesh.creation.icosphere(subdivisions=2)
    with pytest.raises(ValueError, match=text):
        bake_distance_grid(ball.vertices, face(ball.faces))


@pytest.mark.parametrize("arguments, text", [
    (dict(types=["hfield"], sizes=[(1,)]), "geom type 'hfield' cannot touch the skin: use one of plane, "
                                           "sphere, capsule"),
    (dict(types=["mesh"], sizes=[()]), r"every mesh geom needs one DistanceGrid: make it with "
                                       r"bake_distance_grid\(vert, face\)"),
    (dict(types=["sphere"], sizes=[(0.0,)]), r"a sphere of size \[0.0, 0.0, 0.0\] is not a solid: sizes "
                                             r"must be positive and finite"),
    (dict(types=["box"], sizes=[(1.0, 1.0)]), "a box of size .* is not a solid"),
    (dict(types=["sphere"], sizes=[(float("nan"),)]), "is not a solid"),
    (dict(types=["sphere"], sizes=[(1.0,)], friction=[-0.5]), r"friction \[-0.5\] must be finite and not "
                                                              r"negative"),
    (dict(types=["sphere"], sizes=[(1.0,)], friction=[np.nan]), r"friction \[nan\] must be finite"),
    (dict(types=["box"], sizes=[(1.0, 1.0, 1.0)], rounding=[2.0]), "rounding of a box is 2.0: a fillet's "
                                                                   "radius lies"),
    (dict(types=["sphere"], sizes=[(1.0,)], rounding=[np.nan]), "rounding of a sphere is nan"),
])  # fmt: skip
def test_bad_geoms_are_refused(arguments, text):
    with pytest.raises(ValueError, match=text):
        GeomSet(**arguments)


def test_poses_that_are_not_finite_are_refused():
    geoms = GeomSet(["sphere"], [(1.0,)], nworld=2)
    with pytest.raises(
        ValueError,
        match="geom positions contain NaN or infinite numbers: the simulation has diverged or a pose was",
    ):
        geoms.set_pose([[np.nan, 0, 0]])
    with pytest.raises(ValueError, match="geom rotations contain NaN"):
        geoms.set_pose([[0, 0, 0]], [np.full((3, 3), np.inf)])
    with pytest.raises(
        ValueError, match=r"geom positions have shape \(3,\): expected \(1, 3\) or \(2, 1, 3\)"
    ):
        geoms.set_pose([0, 0, 0])
    with pytest.raises(ValueError, match="geom friction coefficients contain NaN"):
        geoms.set_friction([np.nan])


@pytest.mark.slow
@pytest.mark.parametrize("radius", [4e-5, 4e-4, 4e-3])
def test_a_tiny_mesh_takes_no_more_memory(radius):
    """A screw, or a model in the wrong unit: the grid's margin is many times the mesh."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    grid = bake_distance_grid(ball.vertices, ball.faces)
    assert grid.value.size < 2.2e6
    points = np.array([[0.0, 0.0, 1.2 * radius], [1e-3 + radius, 0.0, 0.0], [0.0, 1.0, 0.0]])
    _, d, _ = evaluate("mesh", (), points, grids=[grid])
    np.testing.assert_allclose(d[:2], np.linalg.norm(points[:2], axis=1) - radius, atol=2 * grid.spacing)
    assert d[2] > 0.9


def bumpy_ball():
    """Smooth in places, sharp in others."""
    ball = trimesh.creation.icosphere(3, 5e-3)
    vert = np.array(ball.vertices)
    return vert * (1 + 0.25 * np.sin(900 * vert[:, :1])), np.array(ball.faces)


def corners_apart():
    """A box none of whose faces share a corner's number."""
    box = trimesh.creation.box((0.01, 0.008, 0.006)).subdivide().subdivide()
    return np.array(box.vertices)[box.faces].reshape(-1, 3), np.arange(3 * len(box.faces)).reshape(-1, 3)


@pytest.mark.parametrize("shape", [bumpy_ball, corners_apart])
def test_normals_tell_the_side_as_rays_do(shape):
    vert, face = shape()
    grid = bake_distance_grid(vert, face, spacing=5e-4, margin=1e-3)
    grids, _meshes = pack_grids([grid], "cpu")
    rng = np.random.default_rng(2)
    share = rng.dirichlet([0.2] * 3, 6000)  # near edges and corners
    base = (vert[face[rng.integers(len(face), size=len(share))]] * share[:, :, None]).sum(1)
    points = base + rng.normal(size=base.shape) * rng.choice([1e-6, 1e-5, 1e-4], size=(len(base), 1))
    found = []
    for normal in (grids.normal, wp.zeros_like(grids.normal)):
        grids.normal = normal
        found.append(of_grids(grids, points))
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("shape", [bumpy_ball, corners_apart])
def test_the_nearest_triangle_is_on_its_cells_list(shape):
    """As the tree finds it, and on the way the lists were taken."""
    vert, face = shape()
    grid = bake_distance_grid(vert, face, spacing=5e-4, margin=1e-3)
    grids, _meshes = pack_grids([grid], "cpu")
    assert (grid.of_cell >= 0).sum() == len(grid.lists.count) > 1000
    rng = np.random.default_rng(3)
    share = rng.dirichlet([1.0] * 3, 6000)
    base = (vert[face[rng.integers(len(face), size=len(share))]] * share[:, :, None]).sum(1)
    points = base + 2e-4 * rng.normal(size=base.shape)
    found = []
    for of_cell in (grids.of_cell, wp.full_like(grids.of_cell, -1)):
        grids.of_cell = of_cell
        found.append(of_grids(grids, points)[0, :, 3])
    # the tree's own choice is in single precision
    np.testing.assert_allclose(*found, rtol=0, atol=1e-8)
    everywhere = np.full(grid.value.shape, 7, np.int32)
    grids.of_cell = wp.array(everywhere.ravel(), dtype=int, device="cpu")
    # a wrong list is noticed
    assert abs(of_grids(grids, points)[0, :, 3] - found[0]).max() > 1e-4


@wp.kernel(enable_backward=False)
def to_places(corner: wp.array2d(dtype=wp.vec3), q: wp.array(dtype=wp.vec3d), out: wp.array(dtype=wp.vec3d)):
    i, k = wp.tid()
    at, _ = closest_on_face(corner, k, q[i])
    out[i * corner.shape[0] + k] = at


def test_the_nearest_point_of_a_flat_triangle_is_on_its_edge():
    """Two or three corners in one place, as merging leaves them: a segment, or a point."""
    rng = np.random.default_rng(4)
    begin, end = rng.normal(size=(2, 3)).astype(np.float32).astype(float)
    flat = [[begin, begin, end], [begin, end, end], [begin, end, begin], [begin, begin, begin]]
    q = rng.normal(size=(200, 3))
    out = wp.zeros(800, dtype=wp.vec3d, device="cpu")
    given = [wp.array(flat, dtype=wp.vec3, device="cpu"), wp.array(q, dtype=wp.vec3d, device="cpu")]
    wp.launch(to_places, (200, 4), given, [out], device="cpu")
    along = np.clip((q - begin) @ (end - begin) / ((end - begin) ** 2).sum(), 0, 1)
    segment = begin + along[:, None] * (end - begin)
    expected = np.stack([segment] * 3 + [np.tile(begin, (200, 1))], 1).reshape(-1, 3)
    np.testing.assert_allclose(out.numpy(), expected, atol=1e-12)


def test_corners_nearly_in_one_place():
    """A blade's faces have corners of their own, 0.1 pm apart, where rounding to 10 nm jumps: around its edge
    it is not smooth."""
    high = 5e-3 * np.tan(np.radians(3.0))
    blade = [[0, -5e-3, 0], [0, 5e-3, 0], *([5e-3, y, z] for z in (-high, high) for y in (-5e-3, 5e-3))]
    vert = (np.floor(np.array(blade) / 1e-8) + 0.5) * 1e-8
    face = np.array(
        [[0, 1, 3], [0, 3, 2], [0, 4, 5], [0, 5, 1], [2, 3, 5], [2, 5, 4], [0, 2, 4], [1, 5, 3]], np.int32
    )
    rng = np.random.default_rng(0)
    vert = vert[face].reshape(-1, 3) + rng.uniform(-1e-13, 1e-13, (3 * len(face), 3))
    grid = bake_distance_grid(vert, np.arange(len(vert)).reshape(-1, 3), cells=20)
    far, turn = 10 ** rng.uniform(-6, -3, 500), rng.uniform(-1.4, 1.4, 500)
    points = np.stack([-far * np.cos(turn), rng.uniform(-4e-3, 4e-3, 500), far * np.sin(turn)], 1)
    _, d, _ = evaluate("mesh", (), points, grids=[grid])
    assert (d > 0).all()


@wp.kernel(enable_backward=False)
def mesh_distances(grids: Grids, point: wp.array(dtype=wp.vec3d), out: wp.array2d(dtype=wp.vec4d)):
    k, i = wp.tid()
    out[k, i] = distance(7, wp.vec3d(), wp.float64(0.0), grids, k, point[i])


def of_grids(grids, points):
    """Normals and distances (ngrid, n, 4)."""
    out = wp.zeros((len(grids.mesh), len(points)), dtype=wp.vec4d, device="cpu")
    given = [grids, wp.array(points, dtype=wp.vec3d, device="cpu")]
    wp.launch(mesh_distances, out.shape, given, [out], device="cpu")
    return out.numpy()


def test_a_smooth_mesh_has_a_normal_without_jumps():
    """Along a line close to the surface, across many triangles."""
    body = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    angle = np.linspace(0, np.pi, 2000)
    line = 0.97 * np.stack([np.cos(angle), np.sin(angle), 0.1 * np.ones_like(angle)], 1)
    turned = {}
    for smooth in (False, True):
        grid = bake_distance_grid(body.vertices, body.faces, spacing=0.1, margin=0.5, smooth=smooth)
        normal = evaluate("mesh", (0, 0, 0), line, grids=[grid])[0]
        turned[smooth] = np.linalg.norm(np.diff(normal, axis=0), axis=1).max()
    step = np.pi / 1999
    assert turned[False] > 20 * step and turned[True] < 4 * step


def test_a_skin_whose_grid_has_edges_is_refused():
    ball = trimesh.creation.icosphere(subdivisions=1, radius=1.0)
    smooth, sharp = (bake_distance_grid(ball.vertices, ball.faces, cells=8, smooth=s) for s in (True, False))
    both = smooth, smooth
    assert GeomSet(["skin"], [()], grids=both, own=both).shapes == SKINS
    for grids, own in (((smooth, sharp), both), (both, (sharp, smooth)), (both, ())):
        with pytest.raises(ValueError, match="smooth=True"):
            GeomSet(["skin"], [()], grids=grids, own=own)


def test_smooth_and_sharp_meshes_are_one_set():
    """Each has the distance that it has alone, in any order."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=1.0)
    sharp, smooth, other = (
        bake_distance_grid(scale * ball.vertices, ball.faces, spacing=0.1, margin=0.5, smooth=is_smooth)
        for scale, is_smooth in ((1.0, False), (1.0, True), (0.9, True))
    )
    points = cloud(500, reach=1.2)
    found = {}
    for order in [[sharp], [smooth], [other], *itertools.permutations([sharp, smooth, other])]:
        grids, _meshes = pack_grids(order, "cpu")
        for grid, distances in zip(order, of_grids(grids, points)):
            np.testing.assert_array_equal(distances, found.setdefault(id(grid), distances))


def test_a_smooth_mesh_keeps_to_its_triangles_within_its_error():
    body = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    grid = bake_distance_grid(body.vertices, body.faces, spacing=0.1, margin=0.6, smooth=True)
    assert 0 < grid.error < 0.02
    points = cloud(20000, reach=1.5)
    _, found, bound = evaluate("mesh", (0, 0, 0), points, grids=[grid])
    exact = -trimesh.proximity.signed_distance(body, points)
    near = abs(exact) < 0.08  # farther off the grid tells
    assert abs(found - exact)[near].max() < 1.2 * grid.error
    assert (bound <= exact + 1e-6).all() and (bound < found + 1e-12)[near].all()
    normal, *_ = evaluate("mesh", (0, 0, 0), points[near], grids=[grid])
    slope = gradient("mesh", (0, 0, 0), points[near], grids=[grid])
    np.testing.assert_allclose(normal, slope, atol=1e-4)
