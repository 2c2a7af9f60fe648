"""Indenters: the paper's eight by name, any MuJoCo geom, any closed mesh.

The frame of an indenter has its origin at the tip and presses along +y, as in the paper's files. Of `geom:`
it is at the geom's centre, with the geom's z along +y; of `mesh:` it is the file's.
"""

import dataclasses
import functools
import pathlib

import mujoco
import numpy as np

from ..geometry.indenters import INDENTERS, indenter
from ..geometry.rigid import UPRIGHT, Z_TO_Y, matrix
from ..geometry.solid import check_place, check_size, face_outwards, no_solid
from ..reading import reading
from ..triangles import trimesh
from ..units import read_quantity

_SMALLEST, _LARGEST = 1e-4, 0.5  # [m] along the longest axis
_STL_HEADER, _STL_FACE = 84, 50  # bytes of a binary STL, with the number of faces at the header's end
_ALONG = ("radius", "half length")
_SIZES = {
    "sphere": ("radius",), "capsule": _ALONG, "cylinder": _ALONG,
    "ellipsoid": ("semi axis x", "y", "z"), "box": ("half width x", "y", "z"), "plane": (),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Indenter:
    """One rigid shape.

    Attributes:
      name: the text that it was made from.
      type: MuJoCo's geom type by name.
      size: MuJoCo's sizes [m]; empty for a mesh.
      rounding: fillet radius of the edges of a box or cylinder [m].
      pos, quat: pose of the geom in the indenter's frame, (3,) [m] and (4,).
      vert, face: (n, 3) [m], (m, 3), its surface in the indenter's frame; of a geom an approximation, for
        pictures and rays.
    """

    name: str
    type: str
    size: tuple
    rounding: float
    pos: np.ndarray
    quat: np.ndarray
    vert: np.ndarray
    face: np.ndarray

    @functools.cached_property
    def geom(self) -> dict:
        """Arguments of `skin.GeomSet` for this shape alone; a mesh has a distance grid."""
        from ..skin.contact.meshes import bake_distance_grid

        grids = [bake_distance_grid(self.vert, self.face)] if self.type == "mesh" else []
        return {"types": [self.type], "sizes": [self.size], "rounding": [self.rounding], "grids": grids}

    def pose(self, pos: np.ndarray, mat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position (..., 3) [m] and rotation (..., 3, 3) of the geom for those of the indenter's frame, in
        which a mesh has its vertices."""
        if self.type == "mesh":
            return pos, mat
        return pos + mat @ self.pos, mat @ matrix(self.quat)


def _surface(kind, size):
    """Triangles of a MuJoCo geom in its own frame."""
    if kind in ("sphere", "ellipsoid"):
        mesh = trimesh.creation.icosphere(subdivisions=3)
        mesh.apply_scale(size)
    elif kind == "capsule":
        mesh = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=[48, 48])
        mesh.apply_translation(-mesh.bounds.mean(0))
    elif kind == "cylinder":
        mesh = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=96)
    elif kind == "box":
        mesh = trimesh.creation.box(extents=2 * np.array(size))
    else:
        mesh = trimesh.creation.box(extents=[2 * size[0], 2 * size[1], 1e-4])
        mesh.apply_translation([0, 0, -5e-5])  # its front is the plane
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def solid(
    name: str,
    kind: str,
    size: tuple,
    quat: np.ndarray,
    pos: np.ndarray = np.zeros(3),  # noqa: B008 - never written to
    rounding: float = 0.0,
) -> Indenter:
    """An indenter that is a MuJoCo geom; its surface has sharp edges."""
    vert, face = _surface(kind, size)
    return Indenter(name, kind, size, rounding, pos, quat, vert @ matrix(quat).T + pos, face)


def _from_geom(text):
    kind, _, sizes = text.partition(":")
    if kind not in _SIZES:
        raise ValueError(
            f"unknown geom type {kind!r} in 'geom:{text}': "
            f"use geom:TYPE:SIZE[,SIZE...] with TYPE one of {', '.join(_SIZES)}"
        )
    try:
        size = tuple(read_quantity("size", s, "length") for s in sizes.split(",") if s)
    except ValueError:
        raise ValueError(
            f"sizes {sizes!r} of 'geom:{text}' are not lengths: "
            "give half-sizes, as in geom:capsule:3mm,5mm or geom:capsule:0.003,0.005"
        ) from None
    if kind == "plane":
        size = size or (0.02, 0.02, 0.001)
    needed = _SIZES[kind] or _SIZES["box"]
    if len(size) != len(needed) or not all(np.isfinite(s) and s > 0 for s in size):
        example = ",".join(["3mm", "5mm", "5mm"][: len(needed)])
        raise ValueError(
            f"'geom:{text}' is no {kind}: give its {', '.join(needed)}, above 0, as in geom:{kind}:{example}"
        )
    if kind != "plane":
        check_size(2 * max(size), f"indenter geom:{text}", _SMALLEST, _LARGEST)
    return solid(f"geom:{text}", kind, size, Z_TO_Y)


def _from_file(path):
    with reading(path, "indenter mesh", "give mesh:FILE of a closed surface (obj, stl, ply) in metres"):
        raw = trimesh.load(path, force="mesh", process=False)  # processing would drop non-finite vertices
        sound = len(getattr(raw, "faces", ())) and np.isfinite(raw.vertices).all()
        mesh = trimesh.Trimesh(raw.vertices, raw.faces) if sound else None
    if not sound:
        wrong = "has vertices that are not finite" if len(getattr(raw, "faces", ())) else _why_no_faces(path)
        raise ValueError(f"the indenter mesh {path} {wrong}: give a closed surface in metres")
    check_size(mesh.extents.max(), f"indenter mesh {path}", _SMALLEST, _LARGEST)
    check_place(mesh.vertices, f"indenter mesh {path}")
    mesh.update_faces(mesh.unique_faces())
    vert = np.asarray(mesh.vertices)
    face = face_outwards(vert, np.asarray(mesh.faces))  # the inside of a closed surface is no question
    wrong = no_solid(vert, face)
    if wrong is not None:
        raise ValueError(f"the indenter mesh {path} {wrong}")
    return Indenter(f"mesh:{path}", "mesh", (), 0.0, np.zeros(3), UPRIGHT, vert, face)


def _why_no_faces(path):
    """Reason why trimesh finds no faces in a file."""
    content = pathlib.Path(path).read_bytes()
    if not content.strip():
        return "is empty"
    if b"\0" not in content:
        return "is text in which no face can be read"
    if str(path).lower().endswith(".stl") and len(content) >= _STL_HEADER:
        count = int.from_bytes(content[_STL_HEADER - 4 : _STL_HEADER], "little")
        whole = _STL_HEADER + _STL_FACE * count
        if len(content) != whole:
            return f"has {len(content)} of the {whole} bytes that its {count} faces need"
    return "has no faces"


def make_indenter(text: str) -> Indenter:
    """Makes an indenter from a text: a name of INDENTERS, "geom:TYPE:SIZE[,SIZE...]" with MuJoCo's types and
    sizes [m], or "mesh:FILE" in metres.

    A geom presses along its z axis: a capsule with its cap, a cylinder with its end, a plane with its front.

    Raises:
      ValueError: unknown name or type, sizes that do not fit it, or a mesh that is open, empty or not in
        metres.
      FileNotFoundError: no such mesh.
    """
    kind, _, description = text.partition(":")
    if kind == "geom":
        return _from_geom(description)
    if kind == "mesh":
        return _from_file(description)
    if text not in INDENTERS:
        raise ValueError(
            f"unknown indenter {text!r}: choose one of {', '.join(INDENTERS)}, or geom:TYPE:SIZE[,SIZE...] "
            "(geom:sphere:2.5mm is a sphere of that radius), or mesh:FILE"
        )
    shape = indenter(text)
    return Indenter(
        text,
        shape.geom_type,
        shape.size,
        shape.rounding if shape.size else 0.0,
        np.array(shape.pos),
        np.array(shape.quat),
        *shape.mesh(),
    )


def add_indenter(
    spec: mujoco.MjSpec, body: "mujoco._specs.MjsBody", shape: Indenter, exact: bool = True, **geom: object
) -> "mujoco._specs.MjsGeom":
    """Adds the indenter's geom, named "indenter", to a body of a spec with the indenter's frame.

    Args:
      exact: False: shapes with rounded edges become meshes, so that MuJoCo's rays see the rounding.
      geom: further properties of the geom.
    """
    if shape.type != "mesh" and (exact or not shape.rounding):
        size = np.zeros(3)
        size[: len(shape.size)] = shape.size
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.type.upper()}")
        return body.add_geom(name="indenter", type=kind, size=size, pos=shape.pos, quat=shape.quat, **geom)
    # a shell's inertia is defined for open and badly oriented triangles too
    mesh = spec.add_mesh(
        name="indenter", uservert=shape.vert.ravel(), userface=shape.face.ravel().astype(np.int32)
    )
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    return body.add_geom(name="indenter", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="indenter", **geom)
