"""Puts a skin mesh and its rigid parts together: which surface is which, which nodes are held, where the
electrodes are."""

import numpy as np

from biotac_mj.geometry.design import BIOTAC, Design
from biotac_mj.geometry.electrodes import electrode_positions
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.geometry.tet_mesh import TetMesh, check_closed, enclosed_volume

__all__ = ["assemble", "held_nodes", "electrodes_on", "split_surfaces"]

HELD = 1e-5  # nodes within this distance of a rigid body are held [m] (Narang et al., ICRA 2021)


def split_surfaces(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """The outer face (n, 3) and the inner one (m, 3) of a shell, normals out of the material.

    Raises:
      ValueError: the boundary is not one outside around one cavity.
    """
    parts = mesh.boundary_components()
    if len(parts) != 2:
        raise ValueError(
            f"the skin's boundary has {len(parts)} closed part{'s' * (len(parts) != 1)}, not an outer and "
            "an inner surface: "
            "mesh the skin as one shell around one cavity"
        )
    outer, inner = parts
    for part, name in ((outer, "outer surface"), (inner, "inner surface")):
        check_closed(part, name)
    box = [(mesh.vert[part].min(axis=(0, 1)), mesh.vert[part].max(axis=(0, 1))) for part in parts]
    if (
        enclosed_volume(mesh.vert, outer) <= 0
        or enclosed_volume(mesh.vert, inner) >= 0
        or (box[0][0] > box[1][0]).any()
        or (box[0][1] < box[1][1]).any()
    ):
        raise ValueError(
            "the outer surface of the skin does not enclose the inner one: "
            "mesh the skin as one shell around one cavity"
        )
    return outer, inner


def held_nodes(vert: np.ndarray, bodies: object, tolerance: float = HELD) -> np.ndarray:
    """Sorted nodes within `tolerance` [m] of the surface of any of `bodies` = [(vert (n, 3) [m], face (m,
    3)), ...].

    Distances are computed in millimetres: trimesh drops small triangles of a mesh in metres.
    """
    near = np.zeros(len(vert), dtype=bool)
    for body_vert, body_face in bodies:
        low, high = body_vert.min(axis=0) - 2 * tolerance, body_vert.max(axis=0) + 2 * tolerance
        candidate = np.flatnonzero(((vert > low) & (vert < high)).all(axis=1))
        if len(candidate):
            _, distance, _ = _closest(body_vert, body_face, vert[candidate])
            near[candidate] |= distance < tolerance
    return np.flatnonzero(near).astype(np.int32)


def electrodes_on(
    core_vert: np.ndarray, core_face: np.ndarray, design: Design = BIOTAC
) -> tuple[np.ndarray, np.ndarray]:
    """E1..E19 of Lin et al. 2013 projected onto a core mesh: positions (19, 3) [m], unit outward normals (19,
    3).

    The table lies about 0.245 mm under the surface (the core there is 5.08 mm in radius). The normal is a
    mean over the faces around the point (area times a Gaussian of 0.25 mm), because one small face of a
    tessellated core says little."""
    point = design.in_biotac_frame(electrode_positions(design)) * 1e-3
    position, _, _ = _closest(core_vert, core_face, point)
    corner = core_vert[core_face]
    area_normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2
    centre = corner.mean(axis=1)
    weight = np.exp(-0.5 * (np.linalg.norm(position[:, None] - centre, axis=-1) / 2.5e-4) ** 2) + 1e-12
    normal = weight @ area_normal
    return position, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def assemble(
    name: str,
    mesh: TetMesh,
    core: object,
    nail: object,
    clamp: object,
    electrodes: object = None,
    design: Design = BIOTAC,
) -> SkinGeometry:
    """A checked SkinGeometry from a shell and three rigid bodies (vert [m], face).

    Raises:
      ValueError: see `TetMesh.check` and `split_surfaces`; a rigid body that is open; no held node; wrong
        units.
    """
    mesh.check()
    size = np.ptp(mesh.vert, axis=0).max() * 1e3
    if not 5.0 <= size <= 100.0:
        raise ValueError(
            f"the skin's largest dimension is {size:.4g} mm, not between 5 and 100 mm: is the file in metres?"
        )
    outer, inner = split_surfaces(mesh)
    for (vert, face), label in ((core, "core"), (nail, "nail plate"), (clamp, "clamp plate")):
        check_closed(np.asarray(face), label)
        if enclosed_volume(vert, face) <= 0:
            raise ValueError(f"the {label}'s normals point inwards: flip its faces")
    fixed = held_nodes(mesh.vert, (core, nail, clamp))
    if not len(fixed):
        raise ValueError(
            f"no skin node lies within {HELD} m of core, nail or clamp: "
            "are skin and rigid bodies in the same frame and units?"
        )
    position, normal = electrodes_on(*core, design) if electrodes is None else electrodes
    return SkinGeometry(
        name=name,
        vert=mesh.vert,
        elem=mesh.elem,
        outer_face=outer,
        inner_face=inner,
        fixed=fixed,
        core_vert=core[0],
        core_face=core[1],
        nail_vert=nail[0],
        nail_face=nail[1],
        clamp_vert=clamp[0],
        clamp_face=clamp[1],
        electrode_pos=position,
        electrode_normal=normal,
        design=design,
    )


def _closest(vert, face, point):
    """Closest points (n, 3) [m], distances (n,) [m] and faces (n,) of `point` (n, 3) [m] on a mesh."""
    from ..triangles import trimesh

    body = trimesh.Trimesh(np.asarray(vert) * 1e3, face, process=False)
    nearest, distance, index = trimesh.proximity.closest_point(body, np.asarray(point) * 1e3)
    return nearest * 1e-3, distance * 1e-3, index
