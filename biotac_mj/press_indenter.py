"""The shapes that press: the paper's eight by name, any MuJoCo geom, any closed mesh.

An indenter's frame has its tip in front and +y along the way it goes, as the paper's files have it.
"""

import dataclasses
import pathlib

import mujoco
import numpy as np
import trimesh

__all__ = ["INDENTERS", "Indenter", "add_indenter", "make_indenter"]

_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3, "plane": 0}
_Z_TO_Y = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # columns: the geom's axes in the indenter's frame; its z goes ahead
_Z_TO_X = np.array([[0, 0, 1.0], [1.0, 0, 0], [0, 1.0, 0]])


@dataclasses.dataclass(frozen=True)
class Indenter:
    """One rigid shape.

    Attributes:
      name: how it was asked for.
      type: MuJoCo's geom type by name.
      size: MuJoCo's sizes [m]; empty for a mesh.
      rounding: fillet radius of the edges of a box or cylinder [m].
      pos, mat: pose of the geom in the indenter's frame, (3,) [m] and (3, 3).
      vert, face: (n, 3) [m], (m, 3), its surface in the indenter's frame: of a mesh exactly, else for pictures and rays.
    """

    name: str
    type: str
    size: tuple
    rounding: float
    pos: np.ndarray
    mat: np.ndarray
    vert: np.ndarray
    face: np.ndarray


def _ring(inner, outer, edge, height):
    """Surface of a ring about y with its rounded front rim at y = 0."""
    quarter = np.linspace(0, np.pi / 2, 9)
    rim_out = np.stack([outer - edge + edge * np.cos(quarter), -edge + edge * np.sin(quarter)], 1)
    rim_in = np.stack([inner + edge - edge * np.sin(quarter), -edge + edge * np.cos(quarter)], 1)
    profile = np.concatenate([[[inner, -height], [outer, -height]], rim_out, rim_in, [[inner, -height]]])
    mesh = trimesh.creation.revolve(1e3 * profile, sections=96)
    return mesh.vertices * 1e-3 @ _Z_TO_Y.T, mesh.faces


# The numbers in the names are diameters [mm]. Sizes, the lying cylinders and the radii of the edges (1 mm) are those of the paper's files and of this
# project's reference solutions; the stems on which the real ones are mounted are left out, because they never touch.
def _sphere(radius):
    return dict(type="sphere", size=(radius,), pos=np.array([0, -radius, 0]))


def _cylinder(radius, length):
    return dict(type="cylinder", size=(radius, length / 2), rounding=1e-3, pos=np.array([0, -radius, 0]), mat=_Z_TO_X)


INDENTERS = {
    "sphere_3-5mm": _sphere(1.75e-3),
    "sphere_7mm": _sphere(3.5e-3),
    "sphere_14mm": _sphere(7e-3),
    "cylinder_short_3-5mm": _cylinder(1.75e-3, 7e-3),
    "cylinder_short_7mm": _cylinder(3.5e-3, 7e-3),
    "cylinder_long_7mm": _cylinder(3.5e-3, 28e-3),
    "cube_14mm": dict(type="box", size=(7e-3, 7e-3, 7e-3), rounding=1e-3, pos=np.array([0, -7e-3, 0])),
    "ring_7mm": dict(type="mesh", size=()),
}


def _surface(kind, size, rounding):
    """Triangles of a geom in its own frame, edges rounded."""
    if kind == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=size[0])
    elif kind == "ellipsoid":
        mesh = trimesh.creation.icosphere(subdivisions=3)
        mesh.apply_scale(size)
    elif kind == "capsule":
        return _surface("cylinder", (size[0], size[0] + size[1]), size[0])
    elif kind == "cylinder":
        quarter = np.linspace(0, np.pi / 2, 9 if rounding else 2)
        r, z = (size[0] - rounding) + rounding * np.cos(quarter), (size[1] - rounding) + rounding * np.sin(quarter)
        profile = np.concatenate([[[0, -size[1]]], np.stack([r, -z], 1)[::-1], np.stack([r, z], 1), [[0, size[1]]]])
        mesh = trimesh.creation.revolve(1e3 * profile[np.r_[True, np.abs(np.diff(profile, axis=0)).max(1) > 1e-9]], sections=180)
        mesh.apply_scale(1e-3)
    elif kind == "box" and rounding:
        ball = trimesh.creation.icosphere(subdivisions=3, radius=rounding).vertices
        mesh = trimesh.convex.convex_hull(np.concatenate([ball + np.sign(ball) * (np.array(size) - rounding)]))
    elif kind == "box":
        mesh = trimesh.creation.box(extents=2 * np.array(size))
    else:
        mesh = trimesh.creation.box(extents=[2 * size[0], 2 * size[1], 1e-4])
        mesh.apply_translation([0, 0, -5e-5])
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _build(name, type, size, rounding=0.0, pos=(0, 0, 0), mat=None, surface=None):
    mat = np.eye(3) if mat is None else mat
    vert, face = surface or _surface(type, size, rounding)
    return Indenter(name, type, tuple(size), rounding, np.asarray(pos, float), mat, vert @ mat.T + pos, face)


def _from_geom(text):
    kind, _, sizes = text.partition(":")
    if kind not in _SIZES:
        raise ValueError(f"unknown geom type {kind!r} in 'geom:{text}': use geom:TYPE:SIZE[,SIZE...] with TYPE one of {', '.join(_SIZES)}")
    try:
        size = tuple(float(s) for s in sizes.split(",") if s)
    except ValueError:
        raise ValueError(f"sizes {sizes!r} of 'geom:{text}' are not numbers: give half-sizes in metres, as in geom:capsule:0.003,0.005") from None
    if kind == "plane":
        size = size or (0.02, 0.02, 0.001)
        needed = 3
    else:
        needed = _SIZES[kind]
    if len(size) != needed or not all(np.isfinite(s) and s > 0 for s in size):
        raise ValueError(f"a {kind} needs {needed} positive sizes in metres, 'geom:{text}' gives {list(size)}: as in geom:capsule:0.003,0.005")
    return _build(f"geom:{text}", kind, size, mat=_Z_TO_Y)


def _from_file(path):
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no indenter mesh at {path}: give mesh:FILE of a closed surface (obj, stl, ply) in metres")
    try:
        mesh = trimesh.load(path, force="mesh")
    except Exception as error:  # readers raise what they like
        raise ValueError(f"cannot read the indenter mesh {path} ({error}): give an obj, stl or ply file") from error
    if not len(getattr(mesh, "faces", ())) or not np.isfinite(mesh.vertices).all():
        raise ValueError(f"the indenter mesh {path} has no faces or vertices that are not finite: give a closed surface in metres")
    if mesh.extents.max() > 0.5:
        raise ValueError(f"the indenter mesh {path} is {mesh.extents.max():.3g} m long: it must be in metres; scale it from millimetres")
    if not mesh.is_watertight:
        raise ValueError(f"the indenter mesh {path} is open: its inside is not defined; close its holes")
    return _build(f"mesh:{path}", "mesh", (), surface=(np.asarray(mesh.vertices), np.asarray(mesh.faces)))


def make_indenter(text: str) -> Indenter:
    """The indenter that a text asks for: a name of INDENTERS, "geom:TYPE:SIZE[,SIZE...]" with MuJoCo's types and sizes [m], or "mesh:FILE" in metres.

    The z axis of a geom goes ahead: a capsule presses with its cap, a cylinder with its end, a plane with its front.

    Raises:
      ValueError: unknown name or type, sizes that do not fit it, or a mesh that is open, empty or not in metres.
      FileNotFoundError: no such mesh.
    """
    kind, _, rest = text.partition(":")
    if kind == "geom":
        return _from_geom(rest)
    if kind == "mesh":
        return _from_file(rest)
    if text == "ring_7mm":
        return _build(text, "mesh", (), surface=_ring(3.5e-3, 7e-3, 1e-3, 10e-3))
    if text not in INDENTERS:
        raise ValueError(f"unknown indenter {text!r}: choose one of {', '.join(INDENTERS)}, or geom:TYPE:SIZE[,SIZE...], or mesh:FILE")
    return _build(text, **INDENTERS[text])


def add_indenter(spec: mujoco.MjSpec, body, indenter: Indenter, exact: bool = True, **geom):
    """Adds the indenter's geom, named "indenter", to a body of a spec whose frame is the indenter's.

    Args:
      exact: False gives shapes with rounded edges as meshes, which MuJoCo's rays see with their rounding.
      geom: further properties of the geom.
    """
    if indenter.type != "mesh" and (exact or not indenter.rounding):
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, indenter.mat.ravel())
        size = np.zeros(3)
        size[: len(indenter.size)] = indenter.size
        return body.add_geom(name="indenter", type=getattr(mujoco.mjtGeom, f"mjGEOM_{indenter.type.upper()}"), size=size, pos=indenter.pos, quat=quat, **geom)
    # a shell's inertia is defined for open and badly oriented triangles too
    mesh = spec.add_mesh(name="indenter", uservert=indenter.vert.ravel(), userface=indenter.face.ravel().astype(np.int32))
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    return body.add_geom(name="indenter", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="indenter", **geom)
