"""Importing meshes: the paper's own where it is at hand, small shells made here otherwise."""

import pathlib

import numpy as np
import pytest
from blocks import four_nodes
from meshing import write_obj

from biotac_mj.geometry import TetMesh, import_mesh
from biotac_mj.geometry.making.assembly import fixed_nodes, split_surfaces
from biotac_mj.geometry.making.importing import read_obj, read_tet_mesh

PAPER = pathlib.Path(__file__).parents[2] / "shared" / "data" / "nvlabs_biotac_sim"
TABLE = PAPER.parent / "electrodes_nv_frame_mm.csv"
needs_paper = pytest.mark.skipif(
    not PAPER.is_dir(),
    reason="needs NVlabs/biotac_sim's mesh in ../shared/data, which is not part of the project",
)


def write_tet(path, vert, elem):
    path.write_text(
        "".join(f"v {x:.17g} {y:.17g} {z:.17g} 1\n" for x, y, z in vert)
        + "".join("t " + " ".join(map(str, t)) + "\n" for t in elem)
    )
    return path


@pytest.fixture(scope="module")
def coarse():
    return four_nodes("coarse")


@pytest.fixture
def folder(tmp_path, coarse):
    """The coarse skin as somebody else would hand it over: a .tet and one .obj with the three bodies, one of
    them inside out."""
    write_tet(tmp_path / "skin.tet", coarse.vert, coarse.elem)
    write_obj(tmp_path / "core.obj", coarse.core_vert, coarse.core_face[:, ::-1])
    vert = np.vstack([coarse.nail_vert, coarse.clamp_vert])
    write_obj(
        tmp_path / "plates.obj",
        vert,
        np.vstack([coarse.nail_face, coarse.clamp_face + len(coarse.nail_vert)]),
    )
    return tmp_path


def test_a_skin_that_is_written_is_read_again(folder, coarse):
    skin = import_mesh(folder)
    np.testing.assert_array_equal(skin.vert, coarse.vert)
    np.testing.assert_array_equal(skin.outer_face, coarse.outer_face)
    np.testing.assert_array_equal(skin.inner_face, coarse.inner_face)
    np.testing.assert_array_equal(skin.fixed, coarse.fixed)
    np.testing.assert_allclose(skin.nail_vert.mean(0), coarse.nail_vert.mean(0), atol=1e-9)
    np.testing.assert_allclose(skin.clamp_vert.mean(0), coarse.clamp_vert.mean(0), atol=1e-9)
    assert np.linalg.norm(skin.electrode_pos - coarse.electrode_pos, axis=1).max() < 1e-4
    assert np.sum(skin.electrode_normal * coarse.electrode_normal, axis=1).min() > np.cos(np.radians(6))


@pytest.mark.parametrize("suffix", [".msh", ".vtu"])
def test_formats_of_meshio_are_read(folder, coarse, suffix):
    meshio = pytest.importorskip("meshio")
    (folder / "skin.tet").unlink()
    # a point of no tetrahedron and surface triangles, as mesh generators leave them
    points = np.vstack([coarse.vert, [[0.0, 0.0, 0.0]]])
    mesh = meshio.Mesh(points, [("triangle", coarse.outer_face), ("tetra", coarse.elem)])
    meshio.write(folder / f"skin{suffix}", mesh, **({"file_format": "gmsh22"} if suffix == ".msh" else {}))
    skin = import_mesh(folder)
    np.testing.assert_allclose(skin.vert, coarse.vert, rtol=1e-12)
    np.testing.assert_array_equal(skin.elem, coarse.elem)
    np.testing.assert_array_equal(skin.fixed, coarse.fixed)


def test_missing_and_ambiguous_paths_are_refused(tmp_path, folder):
    with pytest.raises(FileNotFoundError, match="no mesh at .*nothing.tet"):
        import_mesh(tmp_path / "nothing.tet")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"needs one file ending in \.tet, \.msh, \.vtu"):
        import_mesh(tmp_path / "empty")
    (folder / "other.tet").write_text("")
    with pytest.raises(ValueError, match="several meshes .*other.tet, skin.tet.*pass the path"):
        import_mesh(folder)
    with pytest.raises(ValueError, match="plates.obj is no mesh this can read"):
        import_mesh(folder / "plates.obj")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 zero 1\n", r"line 1: could not convert string to float.*v x y z w"),
        ("v 0 0\n", r"line 1 is cut short"),
        ("v 0 0 0 1\n", r"holds 1 vertices and 0 tetrahedra"),
        ("\n".join(["v 0 0 0 1", "t 0 1 2"]), r"line 2 is cut short"),
    ],
)
def test_a_tet_file_that_is_none_is_refused(tmp_path, text, message):
    (tmp_path / "a.tet").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_tet_mesh(tmp_path / "a.tet")


def test_binary_files_that_are_no_mesh_are_refused(tmp_path):
    for suffix in (".tet", ".msh", ".vtu"):
        path = tmp_path / f"a{suffix}"
        path.write_bytes(b"\xff\xfe\x00garbage")
        with pytest.raises(ValueError, match="export it again"):
            read_tet_mesh(path)


def test_a_mesh_without_tetrahedra_is_refused(tmp_path, coarse):
    meshio = pytest.importorskip("meshio")
    meshio.write(tmp_path / "surface.vtu", meshio.Mesh(coarse.vert, [("triangle", coarse.outer_face)]))
    with pytest.raises(ValueError, match=r"holds no linear tetrahedra, only \['triangle'\]"):
        import_mesh(tmp_path / "surface.vtu")


def test_inverted_and_misnumbered_tetrahedra_are_refused(folder, coarse):
    elem = coarse.elem.copy()
    elem[11] = elem[11][[1, 0, 2, 3]]
    write_tet(folder / "skin.tet", coarse.vert, elem)
    with pytest.raises(ValueError, match="1 tetrahedra are inverted .* the first is tetrahedron 11"):
        import_mesh(folder)
    write_tet(folder / "skin.tet", coarse.vert, coarse.elem + 1)
    with pytest.raises(ValueError, match="subtract 1"):
        import_mesh(folder)


@pytest.mark.parametrize(
    ("factor", "size", "remedy"),
    [
        (1e3, r"2.79\d?e\+04", r"is it in millimetres\? multiply it by 0.001"),
        (1e-3, "0.0279", r"was it scaled twice\? multiply it by 1000"),
        (1e-6, "2.79", "scale it to metres"),
    ],
)
def test_meshes_in_wrong_units_are_refused(folder, coarse, factor, size, remedy):
    write_tet(folder / "skin.tet", coarse.vert * factor, coarse.elem)
    with pytest.raises(
        ValueError, match=rf"largest dimension is {size}.* mm, not between 5 and 100 mm: {remedy}"
    ):
        import_mesh(folder)


def test_missing_rigid_bodies_are_named(folder):
    (folder / "core.obj").unlink()
    with pytest.raises(
        ValueError, match=r"found 2 rigid bodies .*plates.obj.* need three: core, nail plate and clamp plate"
    ):
        import_mesh(folder)


def test_an_open_rigid_body_is_refused(folder, coarse):
    write_obj(folder / "core.obj", coarse.core_vert, coarse.core_face[1:])
    with pytest.raises(ValueError, match="core is open"):
        import_mesh(folder)


def test_rigid_bodies_that_hold_no_node_are_refused(folder, coarse):
    for name in ("core", "plates"):
        write_obj(folder / f"{name}.obj", *_shifted(folder / f"{name}.obj"))
    with pytest.raises(ValueError, match="no skin node lies within 1e-05 m.*same frame and units"):
        import_mesh(folder)


def _shifted(path):
    bodies = read_obj(path)
    start = np.cumsum([0] + [len(vert) for vert, _ in bodies])
    return np.vstack([vert for vert, _ in bodies]) + 0.1, np.vstack(
        [face + s for (_, face), s in zip(bodies, start)]
    )


def test_a_solid_is_no_skin():
    solid = TetMesh(np.vstack([np.zeros(3), np.eye(3)]) * 0.01, [[0, 1, 2, 3]]).check()
    with pytest.raises(ValueError, match="boundary has 1 closed part, not an outer and an inner surface"):
        split_surfaces(solid)


def test_two_solids_are_no_shell():
    one = np.vstack([np.zeros(3), np.eye(3)])
    with pytest.raises(ValueError, match="does not enclose the inner one"):
        split_surfaces(TetMesh(np.vstack([one, one + 3]), [[0, 1, 2, 3], [4, 5, 6, 7]]).check())


def test_held_nodes_against_a_plane():
    """A square of tiny triangles in metres, which trimesh would drop: a node is held when it is within 1e-5 m
    of the plane."""
    n = 41
    x, z = (g.ravel() for g in np.meshgrid(np.linspace(0, 4e-4, n), np.linspace(0, 4e-4, n), indexing="ij"))
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    face = np.concatenate([np.stack([a, a + 1, a + n], 1), np.stack([a + 1, a + n + 1, a + n], 1)])
    plane = np.stack([x, np.zeros(n * n), z], axis=1)
    height = np.linspace(0.0, 2e-5, 21)
    node = np.stack([np.full(21, 2.03e-4), height, np.full(21, 1.07e-4)], axis=1)
    np.testing.assert_array_equal(fixed_nodes(node, [(plane, face)]), np.flatnonzero(height < 1e-5))


@needs_paper
def test_the_mesh_of_the_paper_is_read():
    skin = import_mesh(PAPER)
    assert (skin.nvert, skin.nelem) == (4246, 15410)
    assert (len(np.unique(skin.outer_face)), len(skin.outer_face)) == (1686, 3368)
    assert (len(np.unique(skin.inner_face)), len(skin.inner_face)) == (1586, 3168)
    counts = [len(fixed_nodes(skin.vert, [body])) for body in _parts(skin)]
    assert counts == [145, 30, 225] and len(skin.fixed) == 400
    np.testing.assert_allclose(
        np.array([skin.core_vert.min(0), skin.core_vert.max(0)]) * 1e3,
        [[-19.324, -5.362, -5.332], [5.105, 3.652, 5.335]],
        atol=2e-3,
    )


@needs_paper
def test_papers_fixed_nodes_are_the_references():
    """The node list stored with the independent finite-element solutions."""
    case = PAPER.parents[1] / "reference" / "A_sphere3.5_pad_f400.npz"
    if not case.is_file():
        pytest.skip(f"needs {case.name} in ../shared/reference")
    np.testing.assert_array_equal(import_mesh(PAPER).fixed, np.sort(np.load(case)["fixed_nodes"]))


@needs_paper
def test_electrodes_of_the_paper_are_its_table_projected():
    """Against the table projected by ray casting: positions to 0.1 mm (E1 and E11 slide along the tip's
    edge), normals to 12 degrees."""
    skin, table = import_mesh(PAPER), np.loadtxt(TABLE, delimiter=",")
    assert np.linalg.norm(skin.electrode_pos * 1e3 - table[:, 4:7], axis=1).max() < 0.1
    assert np.sum(skin.electrode_normal * table[:, 7:10], axis=1).min() > np.cos(np.radians(12))


def _parts(skin):
    return (
        (skin.nail_vert, skin.nail_face),
        (skin.clamp_vert, skin.clamp_face),
        (skin.core_vert, skin.core_face),
    )
