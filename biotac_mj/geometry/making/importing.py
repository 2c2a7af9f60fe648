"""Reads skins made elsewhere: `.tet` with `.obj` rigid bodies (as in NVlabs/biotac_sim), `.msh` and `.vtu`
through meshio."""

import contextlib
import io
import math
import pathlib

import numpy as np

from biotac_mj.geometry.making.assembly import assemble
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.geometry.tet_mesh import TetMesh, connected_cells, enclosed_volume
from biotac_mj.reading import read_text, reading

_MESHES = (".tet", ".msh", ".vtu")


def import_mesh(path: pathlib.Path | str, name: str | None = None) -> SkinGeometry:
    """A skin from a folder, or from a mesh file whose folder also holds the rigid bodies.

    The mesh is a tetrahedral shell in metres in the BioTac frame (`.tet`, `.msh`, `.vtu`). Every `.obj` of
    the same folder is read; together they must hold three closed bodies: the core (the largest), the nail
    plate, and the clamp plate (further to +x than the nail). Nodes within 1e-5 m of them are fixed;
    electrodes are those of Lin et al. 2013, projected onto this core.

    Raises:
      FileNotFoundError: no such path, or no mesh in the folder.
      ValueError: an unreadable file, missing rigid bodies, or a mesh that `assemble` refuses.
    """
    path = pathlib.Path(path)
    if path.is_dir():
        found = sorted(p for p in path.iterdir() if p.suffix in _MESHES)
        if not found:
            raise FileNotFoundError(f"no mesh in {path}: it needs one file ending in {', '.join(_MESHES)}")
        if len(found) > 1:
            raise ValueError(
                f"{path} holds several meshes ({', '.join(p.name for p in found)}): "
                "pass the path of one of them"
            )
        path = found[0]
    mesh = read_tet_mesh(path)
    core, nail, clamp = _rigid_bodies(path.parent)
    return assemble(name or path.parent.name, mesh, core, nail, clamp)


def read_tet_mesh(path: pathlib.Path | str) -> TetMesh:
    """Reads `.tet` (lines `v x y z w` and `t a b c d`, 0-based), `.msh` or `.vtu`; for the last two, nodes
    without a tetrahedron are dropped.

    Raises:
      FileNotFoundError: no such file.
      ValueError: it cannot be read, or holds no tetrahedra.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no mesh at {path}: pass a folder or a file ending in {', '.join(_MESHES)}")
    if path.suffix == ".tet":
        return _read_tet(path)
    if path.suffix not in _MESHES:
        raise ValueError(f"{path.name} is no mesh this can read: convert it to one of {', '.join(_MESHES)}")
    import meshio

    with (
        reading(path, "mesh", f"export it again as {path.suffix}"),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        try:
            mesh = meshio.read(path)
        except SystemExit:  # after saying why on stderr
            raise ValueError("it cannot be read") from None
        elem = mesh.cells_dict.get("tetra")
    if elem is None:
        raise ValueError(
            f"{path} holds no linear tetrahedra, only {sorted(mesh.cells_dict) or 'nothing'}: "
            "mesh the volume with 4-node tetrahedra"
        )
    if (elem >= len(mesh.points)).any() or (elem < 0).any():
        return TetMesh(mesh.points, elem)  # check() explains
    # such files also hold the points of curves and surfaces
    used, elem = np.unique(elem, return_inverse=True)
    return TetMesh(mesh.points[used], elem.reshape(-1, 4))


def _read_tet(path) -> TetMesh:
    vert, elem = [], []
    for number, line in enumerate(_lines(path), 1):
        word = line.split()
        try:
            if word and word[0] == "v":
                vert.append([float(w) for w in word[1:4]])
            elif word and word[0] == "t":
                elem.append([int(w) for w in word[1:5]])
        except ValueError as error:
            raise ValueError(
                f"{path}, line {number}: {error}; lines must read `v x y z w` or `t a b c d`"
            ) from error
        if (
            word
            and word[0] in "vt"
            and len((vert if word[0] == "v" else elem)[-1]) < (3 if word[0] == "v" else 4)
        ):
            raise ValueError(
                f"{path}, line {number} is cut short: lines must read `v x y z w` or `t a b c d`"
            )
    if elem and max(map(max, elem)) > len(vert):  # before numbers too large for arrays
        raise ValueError(f"{path} names vertex {max(map(max, elem))} of {len(vert)}: indices must be 0-based")
    if not vert or not elem:
        raise ValueError(
            f"{path} holds {len(vert)} vertices and {len(elem)} tetrahedra: "
            "lines must read `v x y z w` and `t a b c d` (0-based)"
        )
    return TetMesh(np.array(vert), np.array(elem))


def _lines(path):
    return read_text(path, "text file", "export it again").splitlines()


def read_obj(path: pathlib.Path | str) -> list[tuple[np.ndarray, np.ndarray]]:
    """The connected bodies of a Wavefront .obj, polygons cut into triangles, equal positions merged: [(vert
    (n, 3), face (m, 3)), ...].

    Raises:
      ValueError: it cannot be read.
    """
    vert, face = [], []
    for number, line in enumerate(_lines(path), 1):
        word = line.split()
        try:
            if word and word[0] == "v":
                x, y, z = (float(w) for w in word[1:4])
                if not math.isfinite(x + y + z):
                    raise ValueError(f"vertex {line.strip()[:60]!r} is not finite")
                vert.append((x, y, z))
            elif word and word[0] == "f":
                corner = [int(w.split("/")[0]) for w in word[1:]]
                corner = [c - 1 if c > 0 else len(vert) + c for c in corner]
                face += [(corner[0], corner[i], corner[i + 1]) for i in range(1, len(corner) - 1)]
        except ValueError as error:
            raise ValueError(
                f"{path}, line {number}: {error}; export the rigid bodies again as .obj"
            ) from error
    if not face or np.max(face) >= len(vert) or np.min(face) < 0:
        raise ValueError(
            f"{path} holds no usable faces ({len(vert)} vertices, {len(face)} triangles): "
            "export the rigid bodies again as .obj"
        )
    vert, index = np.unique(np.array(vert), axis=0, return_inverse=True)
    parts = [np.unique(part, return_inverse=True) for part in connected_cells(index.reshape(-1)[face])]
    return [(vert[used], local.reshape(-1, 3).astype(np.int32)) for used, local in parts]


def _rigid_bodies(folder):
    """Core, nail plate and clamp plate among the closed bodies of the folder's .obj files."""
    files = sorted(p for p in folder.iterdir() if p.suffix == ".obj")
    bodies = [body for file in files for body in read_obj(file)]
    if len(bodies) != 3:
        raise ValueError(
            f"found {len(bodies)} rigid bodies in the .obj files of {folder} "
            f"({', '.join(p.name for p in files) or 'none'}), need three: "
            "core, nail plate and clamp plate, closed, in metres, in the skin's frame"
        )
    bodies = [(vert, face if enclosed_volume(vert, face) > 0 else face[:, ::-1]) for vert, face in bodies]
    core, *plates = sorted(bodies, key=lambda body: -enclosed_volume(*body))
    nail, clamp = sorted(plates, key=lambda body: body[0][:, 0].mean())
    return core, nail, clamp
