"""Shipped skins, the parametric BioTac, tetrahedral meshes and indenters, against closed forms, trimesh and
the paper's mesh."""

import dataclasses
import pathlib

import mujoco
import numpy as np
import pytest
import trimesh
from indenter_meshes import make_mesh
from parametric import BioTacDimensions, biotac_bodies, clamp_plate, nail_plate
from scipy.spatial import cKDTree

import biotac_mj
from biotac_mj.geometry import (
    INDENTERS,
    SKINS,
    SkinGeometry,
    TetMesh,
    asset_path,
    import_mesh,
    indenter,
    load_skin,
)
from biotac_mj.geometry.card import skin_numbers
from biotac_mj.geometry.design import electrode_positions
from biotac_mj.geometry.making.importing import read_obj
from biotac_mj.geometry.skins import design_of
from biotac_mj.geometry.surface import face_areas, node_areas, node_normals
from biotac_mj.geometry.tet_mesh import check_closed, enclosed_volume

PAPER = pathlib.Path(__file__).parents[2] / "shared" / "data" / "nvlabs_biotac_sim"
needs_paper = pytest.mark.skipif(
    not PAPER.is_dir(),
    reason="needs NVlabs/biotac_sim's mesh in ../shared/data, which is not part of the project",
)

# edge 2 sqrt 2, positive in this order
REGULAR = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])


@pytest.fixture(scope="module", params=SKINS)
def skin(request):
    return load_skin(request.param)


def test_volume_and_angles_of_a_regular_tetrahedron_are_exact():
    mesh = TetMesh(
        REGULAR, [[0, 1, 3, 2]] if np.linalg.det(REGULAR[1:] - REGULAR[0]) < 0 else [[0, 1, 2, 3]]
    ).check()
    np.testing.assert_allclose(mesh.volumes, 8 / 3)  # edge^3 / (6 sqrt 2)
    np.testing.assert_allclose(mesh.dihedral_angles, np.arccos(1 / 3))
    # so the faces point outwards
    np.testing.assert_allclose(enclosed_volume(mesh.vert, mesh.boundary), 8 / 3)


def cube_mesh(n=2):
    """Unit cube of n^3 cells with six tetrahedra each (Kuhn)."""
    grid = np.stack(np.meshgrid(*[np.arange(n + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    index = {tuple(p): i for i, p in enumerate(grid)}
    elem = []
    for cell in np.ndindex(n, n, n):
        for order, even in (
            ((0, 1, 2), 1),
            ((1, 2, 0), 1),
            ((2, 0, 1), 1),
            ((0, 2, 1), 0),
            ((2, 1, 0), 0),
            ((1, 0, 2), 0),
        ):
            path = [np.array(cell)]
            for axis in order:
                path.append(path[-1] + np.eye(3, dtype=int)[axis])
            corner = [index[tuple(p)] for p in path]
            elem.append(corner if even else [corner[0], corner[2], corner[1], corner[3]])
    return TetMesh(grid / n, elem)


def test_the_boundary_of_a_cube_has_its_area_and_volume():
    mesh = cube_mesh().check()
    (part,) = mesh.boundary_components()
    np.testing.assert_allclose([mesh.volumes.sum(), enclosed_volume(mesh.vert, part)], 1.0)
    normal = np.cross(
        mesh.vert[part[:, 1]] - mesh.vert[part[:, 0]], mesh.vert[part[:, 2]] - mesh.vert[part[:, 0]]
    )
    assert np.linalg.norm(normal, axis=1).sum() / 2 == pytest.approx(6.0)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            lambda v, e: (np.where(np.arange(len(v))[:, None] == 5, np.nan, v), e),
            r"1 vertices are NaN or infinite, the first is vertex 5",
        ),
        (lambda v, e: (v, e + 1), r"name vertices outside 0\.\.26.*subtract 1"),
        (
            lambda v, e: (v, np.vstack([e[:3, [1, 0, 2, 3]], e[3:]])),
            r"3 tetrahedra are inverted \(negative volume\), the first is tetrahedron 0",
        ),
        (lambda v, e: (v, e[:, [1, 0, 2, 3]]), r"48 tetrahedra are inverted.*every tetrahedron"),
        (
            lambda v, e: (np.where(np.arange(len(v))[:, None] == e[7, 0], v[e[7, 1]], v), e),
            r"degenerate \(no volume\).*mesh again",
        ),
        (
            lambda v, e: (np.vstack([v, [[2.0, 2.0, 2.0]]]), e),
            r"1 vertices belong to no tetrahedron, the first is vertex 27",
        ),
        (lambda v, e: (v, np.vstack([e, e[:1]])), r"3 faces belong to more than two tetrahedra"),
        (
            lambda v, e: (
                np.vstack([v, v[0] + [[-1.0, 0, 0], [-1.0, -1, 0]]]),
                np.vstack([e, [[0, 1, 27, 28]]]),
            ),
            r"edges have more than two faces",
        ),
    ],
)
def test_check_says_what_is_wrong(change, text):
    mesh = cube_mesh()
    with pytest.raises(ValueError, match=text):
        TetMesh(*change(mesh.vert, mesh.elem)).check()


def test_arrays_of_bad_shapes_are_refused():
    with pytest.raises(ValueError, match=r"vert has shape \(3, 2\)"):
        TetMesh(np.zeros((3, 2)), [[0, 1, 2, 3]])
    with pytest.raises(ValueError, match=r"elem has shape \(0, 4\)"):
        TetMesh(REGULAR, np.zeros((0, 4)))


def test_areas_and_normals_of_a_box():
    """A node on no face has neither."""
    box = trimesh.creation.box(extents=[2.0, 2.0, 2.0])
    vert, face = np.concatenate([box.vertices, [[5.0, 5.0, 5.0]]]), np.asarray(box.faces)
    area = face_areas(vert, face)
    np.testing.assert_allclose(area.sum(0), 0, atol=1e-12)  # it is closed
    shares = node_areas(face, np.linalg.norm(area, axis=1), len(vert))
    np.testing.assert_allclose(shares, np.bincount(face.ravel(), minlength=9) * 2 / 3)
    assert shares.sum() == pytest.approx(24.0)
    normal = node_normals(vert, face)
    np.testing.assert_allclose(np.linalg.norm(normal[:-1], axis=1), 1)
    assert (normal[:-1] * box.vertices > 0).all() and not normal[-1].any()


def test_open_and_inconsistent_surfaces_are_refused():
    face = TetMesh(REGULAR, [[0, 1, 2, 3]]).boundary
    with pytest.raises(ValueError, match="skin is open: 3 edges have one face only.*fill the holes"):
        check_closed(face[1:], "skin")
    with pytest.raises(ValueError, match="faces of both orientations"):
        check_closed(np.vstack([face[:3], face[3:, ::-1]]))


# ---- shipped skins


def test_shipped_skin_is_sound(skin):
    mesh = TetMesh(skin.vert, skin.tets).check()
    assert (
        np.degrees(mesh.dihedral_angles.min()) > 10.0
    )  # of the eight parts of curved ones; the paper's mesh: 11.6
    assert np.degrees(TetMesh(skin.vert, skin.elem[:, :4]).dihedral_angles.min()) > 20.0
    parts = (skin.outer_face, skin.inner_face)
    for face in parts:
        check_closed(face)
    outer, inner = (enclosed_volume(skin.vert, face) for face in parts)
    assert inner < 0 < outer
    assert mesh.volumes.sum() == pytest.approx(outer + inner, rel=1e-10)
    assert len(skin.outer_face) + len(skin.inner_face) == len(mesh.boundary)


def test_shipped_skins_have_the_stated_sizes():
    nodes = [load_skin(name).nvert for name in SKINS]
    assert 2000 < nodes[0] < 3000 and 3600 < nodes[1] < 4400 and 11000 < nodes[2] < 19000


def test_boundary_lies_on_the_parametric_surfaces(skin):
    bodies = biotac_bodies()
    for face, body in ((skin.outer_face, bodies["outer"]), (skin.inner_face, bodies["cavity"])):
        distance = np.abs(body.distance(skin.vert[np.unique(face)] * 1e3))
        assert np.quantile(distance, 0.95) < 0.02
        assert distance.max() < 0.3  # in the tight corners around the clamp, where a tetrahedron would fold


def test_rigid_bodies_are_closed_and_face_outwards(skin):
    for vert, face in (
        (skin.core_vert, skin.core_face),
        (skin.nail_vert, skin.nail_face),
        (skin.clamp_vert, skin.clamp_face),
    ):
        check_closed(face)
        assert trimesh.Trimesh(vert * 1e3, face, process=False).volume > 0
    for name in ("core", "nail", "clamp"):
        ((vert, face),) = read_obj(asset_path(f"{name}.obj"))
        np.testing.assert_array_equal(vert, getattr(skin, f"{name}_vert"))
        np.testing.assert_array_equal(face, getattr(skin, f"{name}_face"))


def test_plates_have_their_closed_form_volume():
    d = BioTacDimensions()
    vert, face = nail_plate()
    straight = d.nail_x[1] - d.nail_x[0] - d.nail_half_width
    # the round ends are polygons: 24 chords of a half circle, 48 of a circle
    half_disc = 24 * 0.5 * d.nail_half_width**2 * np.sin(np.pi / 24)
    assert enclosed_volume(vert, face) == pytest.approx(
        (2 * d.nail_half_width * straight + half_disc) * d.nail_thickness
    )
    vert, face = clamp_plate()
    assert enclosed_volume(vert, face) == pytest.approx(
        48 * 0.5 * d.clamp_radius**2 * np.sin(2 * np.pi / 48) * d.clamp_thickness
    )


def test_held_nodes_are_those_on_rigid_bodies(skin):
    """Against trimesh's signed distance, which the module does not use; all held nodes and some of the
    others."""
    some = np.union1d(skin.fixed, np.random.default_rng(0).choice(skin.nvert, 400, replace=False))
    near = np.zeros(len(some), dtype=bool)
    for part in ("nail", "clamp", "core"):
        body = trimesh.Trimesh(
            getattr(skin, f"{part}_vert") * 1e3, getattr(skin, f"{part}_face"), process=False
        )
        close = np.abs(trimesh.proximity.signed_distance(body, skin.vert[some] * 1e3)) < 1e-2
        assert close.sum() >= 8  # the skin hangs on all three
        near |= close
    np.testing.assert_array_equal(some[near], skin.fixed)
    held = skin.vert[skin.fixed] * 1e3
    assert ((held[:, 1] > 1.8) | (held[:, 0] > 4.5)).all()  # never the pad


def test_electrodes_lie_on_the_core_and_face_outwards(skin):
    core = trimesh.Trimesh(skin.core_vert * 1e3, skin.core_face, process=False)
    _, distance, face = trimesh.proximity.closest_point(core, skin.electrode_pos * 1e3)
    assert distance.max() < 0.02
    np.testing.assert_allclose(np.linalg.norm(skin.electrode_normal, axis=1), 1.0, atol=1e-12)
    assert np.min(np.sum(core.face_normals[face] * skin.electrode_normal, axis=1)) > np.cos(np.radians(10))
    # E7-E10 on the facet
    np.testing.assert_allclose(skin.electrode_normal[6:10], [[-0.5, -np.sqrt(0.75), 0.0]] * 4, atol=1e-6)
    # E11..E16 mirror E1..E6
    np.testing.assert_allclose(skin.electrode_pos[10:16], skin.electrode_pos[:6] * [1, 1, -1], atol=1e-9)
    # Lin's table lies 0.245 mm below the surface of the cylinder; E1, E6 and their mirror images sit at its
    # tapering ends
    x, y, z = electrode_positions().T
    depth = np.linalg.norm(skin.electrode_pos * 1e3 - np.stack([-12.3 - x, z, y], axis=1), axis=1)
    assert (
        np.abs(np.delete(depth, [0, 5, 10, 15]) - 0.245).max() < 0.03 and np.abs(depth - 0.245).max() < 0.12
    )


def test_core_stays_inside_the_cavity():
    """Contact with the core does not begin in overlap: exactly for the surfaces, to the sag of chords (edge^2
    / 8 radius) for meshes."""
    bodies, skin = biotac_bodies(), load_skin("default")
    assert bodies["cavity"].distance(bodies["core"].project(skin.core_vert * 1e3)).max() < 0.005
    cavity = trimesh.Trimesh(skin.vert * 1e3, skin.inner_face[:, ::-1], process=False)
    overlap = -trimesh.proximity.signed_distance(cavity, skin.core_vert * 1e3)
    assert overlap[skin.core_vert[:, 0] < 4e-3].max() < 0.1
    assert (
        overlap.max() < 0.25 and (overlap > 0.05).mean() < 0.02
    )  # in the tight corner at the clamp curved tetrahedra would fold


def test_surfaces_are_mirror_symmetric():
    point = np.random.default_rng(0).uniform([-21, -8, -7], [6.6, 5, 7], (2000, 3))
    for body in biotac_bodies().values():
        np.testing.assert_array_equal(body.field(point), body.field(point * [1, 1, -1]))


def test_projection_and_normals_of_the_tip_are_a_sphere_s():
    """The core's tip is a sphere: distance zero, normals radial, and a point moved off it comes back."""
    body, d = biotac_bodies()["core"], BioTacDimensions()
    radius, angle = d.core[0][2], np.linspace(-0.6, 0.6, 9)
    below = radius * np.sin(0.13)  # under the rounded edge of the flat top, above the facet
    level = np.sqrt(radius**2 - below**2)
    centre = np.array([d.core_tip, 0.0, 0.0])
    sphere = centre + np.stack([-level * np.cos(angle), np.full(9, -below), level * np.sin(angle)], axis=1)
    np.testing.assert_allclose(body.distance(sphere), 0.0, atol=1e-9)
    np.testing.assert_allclose(body.normal(sphere), (sphere - centre) / radius, atol=1e-6)
    np.testing.assert_allclose(body.project(centre + 1.02 * (sphere - centre)), sphere, atol=1e-5)


def test_save_and_load_are_bit_equal(tmp_path, skin):
    again = load_skin(skin.save(tmp_path / "skin.npz"))
    assert isinstance(again, SkinGeometry) and again.name == skin.name
    np.testing.assert_array_equal(again.vert, skin.vert)
    np.testing.assert_array_equal(again.elem, skin.elem)


def test_who_changes_a_shipped_skin_changes_no_others():
    load_skin("coarse").vert[:] = 0.0
    assert load_skin("coarse").vert.any()


def test_missing_and_broken_skins(tmp_path):
    with pytest.raises(FileNotFoundError, match="pass 'coarse', 'default', 'fine'"):
        load_skin("defualt")
    (tmp_path / "x.npz").write_bytes(b"no zip")
    with pytest.raises(ValueError, match="no skin.*lab mesh"):
        load_skin(tmp_path / "x.npz")
    with pytest.raises(FileNotFoundError, match="missing asset 'skins/huge.npz'.*make_assets.py"):
        asset_path("skins/huge.npz")


# ---- against the paper's mesh


@needs_paper
def test_default_agrees_with_the_papers_mesh():
    ours, paper = skin_numbers(load_skin("default")), skin_numbers(import_mesh(PAPER))
    for key in ("thickness median", "fluid volume", "cavity volume", "core volume", "skin volume"):
        print(f"{key:18s} ours {ours[key]:9.3f}   paper {paper[key]:9.3f}")
        assert ours[key] == pytest.approx(paper[key], rel=0.05), key
    for mine, theirs in zip(ours["box"], paper["box"]):
        print("box", mine.round(3), theirs.round(3))
        np.testing.assert_allclose(mine, theirs, atol=0.2)
    print("gaps", ours["gaps"].round(2), paper["gaps"].round(2), sep="\n")
    np.testing.assert_allclose(ours["gaps"], paper["gaps"], atol=0.1)


@needs_paper
@pytest.mark.parametrize("name", SKINS)
def test_every_resolution_agrees_in_box_and_thickness(name):
    ours = skin_numbers(load_skin(name))
    np.testing.assert_allclose(ours["box"], [[-21.309, -8.309, -7.114], [6.65, 5.328, 7.112]], atol=0.2)
    assert ours["thickness median"] == pytest.approx(1.5585, rel=0.05)
    assert ours["fluid volume"] == pytest.approx(366.2, rel=0.05)


# ---- indenters

VOLUMES = {  # closed forms [mm^3]; solids with rounded edges by Pappus and Steiner
    "sphere_3-5mm": 4 / 3 * np.pi * 1.75**3,
    "sphere_7mm": 4 / 3 * np.pi * 3.5**3,
    "sphere_14mm": 4 / 3 * np.pi * 7**3,
    "cube_14mm": 12**3 + 6 * 12**2 + 3 * np.pi * 12 + 4 / 3 * np.pi,
}


def rounded_cylinder(radius, length, edge=1.0):
    """A fillet cuts (1 - pi/4) edge^2 off the rim's section; that piece's centroid (square less quarter disc)
    gives its volume (Pappus)."""
    area = (1 - np.pi / 4) * edge**2
    # from the corner's side, by first moments
    centroid = (0.5 * edge**3 - (np.pi / 4) * edge**2 * (edge - 4 * edge / (3 * np.pi))) / area
    return np.pi * radius**2 * length - 2 * area * 2 * np.pi * (radius - centroid)


@pytest.mark.parametrize("name", INDENTERS)
def test_indenters_have_their_volume_and_size(name):
    shape = indenter(name)
    vert, face = shape.mesh()
    check_closed(face, name)
    solid = trimesh.Trimesh(vert * 1e3, face, process=False)
    assert solid.bounds[1, 1] == pytest.approx(0.0, abs=1e-9)  # the tip
    if "cylinder" in name:
        radius, half = np.array(shape.size) * 1e3
        expected = rounded_cylinder(radius, 2 * half)
        np.testing.assert_allclose(solid.extents, [2 * half, 2 * radius, 2 * radius], rtol=2e-3)
    elif name == "ring_7mm":
        expected = rounded_cylinder(7.0, 7.0) - np.pi * 3.5**2 * 7 - _inner_rims(3.5)
    else:
        expected = VOLUMES[name]
    assert solid.volume == pytest.approx(expected, rel=0.01)  # chords of the tessellation
    made, triangles = make_mesh(shape)
    assert enclosed_volume(made, triangles) == pytest.approx(solid.volume * 1e-9, rel=1e-6)
    assert cKDTree(vert).query(made)[0].max() < 1e-11  # ten digits are stored


def _inner_rims(radius):
    area = 1 - np.pi / 4
    centroid = (0.5 - (np.pi / 4) * (1 - 4 / (3 * np.pi))) / area
    return 2 * area * 2 * np.pi * (radius + centroid)


def test_ring_is_a_ring():
    vert, face = indenter("ring_7mm").mesh()
    radius = np.hypot(vert[:, 0], vert[:, 2])
    assert radius.min() == pytest.approx(0.0035) and radius.max() == pytest.approx(0.007)
    assert len(vert) - len(face) / 2 == 0  # Euler number of a torus
    top = vert[vert[:, 1] > -1e-9]
    # flat between 1 mm rims
    np.testing.assert_allclose(
        [np.hypot(top[:, 0], top[:, 2]).min(), np.hypot(top[:, 0], top[:, 2]).max()],
        [0.0045, 0.006],
        rtol=1e-6,
    )


def test_geoms_of_indenters_fill_the_boxes_of_their_meshes():
    """Each shape as a MuJoCo geom occupies the box of its mesh (MuJoCo's sizes are half sizes, its cylinders
    lie along z)."""
    for name in INDENTERS:
        shape = indenter(name)
        if shape.geom_type == "mesh":
            continue
        spec = mujoco.MjSpec()
        size = list(shape.size) + [0.0] * (3 - len(shape.size))
        spec.worldbody.add_geom(
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.geom_type.upper()}"),
            size=size,
            pos=shape.pos,
            quat=shape.quat,
        )
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        vert, _ = shape.mesh()
        ray, geom = np.array([0.0, -1.0, 0.0]), np.zeros(1, dtype=np.int32)
        for x, z in ((0.0, 0.0), (0.3 * np.ptp(vert[:, 0]), 0.0)):
            hit = mujoco.mj_ray(model, data, np.array([x, 0.02, z]), ray, None, 1, -1, geom, None)
            inside = np.abs(vert[:, 2] - z) < 3e-4
            mine = trimesh.Trimesh(vert * 1e3, shape.mesh()[1], process=False).ray.intersects_location(
                [[x * 1e3 + 1e-4, 20.0, 1e-4]], [ray]
            )[0]
            assert inside.any() and hit == pytest.approx(0.02 - mine[:, 1].max() * 1e-3, abs=2e-5)


def test_mujoco_finds_the_same_volumes_of_meshes():
    """MuJoCo computes the same volumes and refuses meshes whose faces are inconsistent."""
    for name in ("core.obj", "nail.obj", "clamp.obj", "indenters/ring_7mm.obj", "indenters/cube_14mm.obj"):
        spec = mujoco.MjSpec()
        mesh = spec.add_mesh(name="part", file=str(asset_path(name)))
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT
        body = spec.worldbody.add_body()
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="part", density=1000.0)
        ((vert, face),) = read_obj(asset_path(name))
        assert spec.compile().body_mass[1] == pytest.approx(1000.0 * enclosed_volume(vert, face), rel=1e-4)


def test_an_unknown_indenter_is_refused():
    with pytest.raises(
        ValueError, match="unknown indenter 'sphere_9mm': choose one of sphere_3-5mm, .*ring_7mm"
    ):
        indenter("sphere_9mm")


@pytest.mark.parametrize("wrong", [2**40, 0.5, np.nan])
def test_numbers_that_are_no_indices_are_refused(wrong, tmp_path):
    """2**40 wraps round to the same numbers in 32 bits."""
    skin = load_skin("coarse")
    with pytest.raises(ValueError, match="elem.*which is no index"):
        dataclasses.replace(skin, elem=skin.elem.astype(type(wrong)) + wrong)
    with pytest.raises(ValueError, match="elem.*which is no index"):
        TetMesh(skin.vert, skin.tets.astype(type(wrong)) + wrong)
    stored = dict(np.load(skin.save(tmp_path / "skin.npz")))
    np.savez(tmp_path / "skin.npz", **stored | {"elem": skin.elem.astype(np.int64) + 2**40})
    with pytest.raises(ValueError, match="skin.npz: elem"):
        load_skin(tmp_path / "skin.npz")


def test_a_skin_without_a_core_is_refused(tmp_path):
    """As a file and as an object, before MuJoCo meets it."""
    nothing = {"core_vert": np.zeros((0, 3)), "core_face": np.zeros((0, 3), int)}
    skin = dataclasses.replace(load_skin("coarse"), **nothing)
    with pytest.raises(ValueError, match="the core of skin .*skin.npz has no faces"):
        load_skin(skin.save(tmp_path / "skin.npz"))
    with pytest.raises(ValueError, match="the core of skin 'coarse' has no faces"):
        biotac_mj.attach(mujoco.MjSpec(), body="world", skin=skin)


def test_a_stored_skin_is_read_again_only_when_it_changes(shell, tmp_path, monkeypatch):
    read, path = [], dataclasses.replace(shell, name="first").save(tmp_path / "skin.npz")
    load = SkinGeometry.load
    monkeypatch.setattr(SkinGeometry, "load", lambda file: read.append(file) or load(file))
    skin = load_skin(path)
    skin.vert[:] = 0.0
    np.testing.assert_array_equal(load_skin(path).vert, shell.vert)  # callers have copies of their own
    assert design_of(path) == shell.design and len(read) == 1
    dataclasses.replace(shell, name="other").save(path)
    assert load_skin(path).name == "other" and len(read) == 2
