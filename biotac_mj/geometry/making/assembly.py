"""Assembles a skin mesh and its rigid parts: outer and inner surface, fixed nodes, electrodes."""

import numpy as np
from scipy.spatial import cKDTree

from biotac_mj.geometry.core_surface import CoreSurface
from biotac_mj.geometry.design import BIOTAC, Design, electrode_positions
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.geometry.solid import check_size
from biotac_mj.geometry.surface import face_areas
from biotac_mj.geometry.tet_mesh import TetMesh, check_closed, connected_cells, enclosed_volume

EMPTY = np.zeros((0, 3)), np.zeros((0, 3), np.int32)  # an absent rigid body
FIXED_WITHIN = 1e-5  # nodes within this distance of a rigid body are fixed [m] (Narang et al., ICRA 2021)


def split_surfaces(
    mesh: TetMesh, fixed: np.ndarray | None = None, core_vert: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The outer surface (n, 3) and the inner surface (m, 3) of a skin, with normals out of the material.

    A shell around a cavity has two closed surfaces. A dome or a block has one, which is divided by bonded
    faces, whose nodes are all fixed; the part closer to the core is the inner surface. A solid pad has no
    inner surface, and all of its surface is the outer one.

    Args:
      fixed: (n,) fixed nodes, for open skins. core_vert: (n, 3) [m] of the core, likewise.

    Raises:
      ValueError: the boundary is neither.
    """
    surfaces = mesh.boundary_components()
    if len(surfaces) == 1 and fixed is not None:
        return _open_surfaces(mesh, surfaces[0], fixed, core_vert)
    if len(surfaces) != 2:
        raise ValueError(
            f"the skin's boundary has {len(surfaces)} closed part{'s' * (len(surfaces) != 1)}, "
            "not an outer and an inner surface: mesh the skin as one shell around one cavity"
        )
    outer, inner = surfaces
    for surface, name in ((outer, "outer surface"), (inner, "inner surface")):
        check_closed(surface, name)
    box = [(mesh.vert[surface].min(axis=(0, 1)), mesh.vert[surface].max(axis=(0, 1))) for surface in surfaces]
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


def _open_surfaces(mesh, face, fixed, core_vert):
    free = face[~np.isin(face, fixed).all(axis=1)]
    if len(free) == len(face):
        raise ValueError(
            "the skin's boundary has 1 closed part and no face of it is held: mesh the skin as one shell "
            "around one cavity, or let the rim of a dome or the back of a block lie on the backing"
        )
    surfaces = connected_cells(free)
    if len(surfaces) > 2:
        raise ValueError(
            f"held faces cut the skin's surface into {len(surfaces)} parts: a solid pad has one, a dome "
            "an outer and an inner one"
        )
    if len(surfaces) == 1:
        return surfaces[0], np.zeros((0, 3), np.int32)
    distance = [cKDTree(core_vert).query(mesh.vert[np.unique(surface)])[0].mean() for surface in surfaces]
    inner = int(np.argmin(distance))
    return surfaces[1 - inner], surfaces[inner]


def fixed_nodes(vert: np.ndarray, bodies: object, tolerance: float = FIXED_WITHIN) -> np.ndarray:
    """Sorted nodes within `tolerance` [m] of the surface of any of `bodies` = [(vert (n, 3) [m], face (m,
    3)), ...]."""
    fixed = np.zeros(len(vert), dtype=bool)
    for body_vert, body_face in bodies:
        low, high = body_vert.min(axis=0) - 2 * tolerance, body_vert.max(axis=0) + 2 * tolerance
        candidate = np.flatnonzero(((vert > low) & (vert < high)).all(axis=1))
        if len(candidate):
            distance = CoreSurface(body_vert, body_face).closest(vert[candidate])[0]
            fixed[candidate] |= np.abs(distance) < tolerance
    return np.flatnonzero(fixed).astype(np.int32)


def electrodes_on(
    core_vert: np.ndarray, core_face: np.ndarray, design: Design = BIOTAC
) -> tuple[np.ndarray, np.ndarray]:
    """The design's electrodes projected onto a core mesh: positions (n, 3) [m], unit outward normals (n, 3).

    Lin et al.'s table for the BioTac lies about 0.245 mm under the surface (the core there is 5.08 mm in
    radius). The normal is a mean over the faces around the point (area times a Gaussian of 0.25 mm), because
    the normals of single faces of a tessellated core scatter."""
    if not design.nelectrode:
        return np.zeros((0, 3)), np.zeros((0, 3))
    point = design.in_biotac_frame(electrode_positions(design)) * 1e-3
    position = CoreSurface(core_vert, core_face).closest(point)[1]
    centre = core_vert[core_face].mean(axis=1)
    weight = np.exp(-0.5 * (np.linalg.norm(position[:, None] - centre, axis=-1) / 2.5e-4) ** 2) + 1e-12
    normal = weight @ face_areas(core_vert, core_face)
    return position, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def assemble(
    name: str,
    mesh: TetMesh,
    core: tuple,
    nail: tuple = EMPTY,
    clamp: tuple = EMPTY,
    electrodes: tuple | None = None,
    design: Design = BIOTAC,
) -> SkinGeometry:
    """A checked SkinGeometry from a shell, a dome or a block, and the rigid bodies that it is fixed to, each
    (vert [m], face). Nail and clamp are optional; a flat backing is a nail.

    Raises:
      ValueError: see `TetMesh.check` and `split_surfaces`; an open rigid body; no fixed node; wrong units.
    """
    mesh.check()
    check_size(np.ptp(mesh.vert, axis=0).max())
    bodies = [(core, "core"), (nail, "nail plate"), (clamp, "clamp plate")]
    for (vert, face), label in bodies:
        if not len(face):
            continue
        check_closed(np.asarray(face), label)
        if enclosed_volume(vert, face) <= 0:
            raise ValueError(f"the {label}'s normals point inwards: flip its faces")
    fixed = fixed_nodes(mesh.vert, [body for body, _ in bodies if len(body[1])])
    outer, inner = split_surfaces(mesh, fixed if len(fixed) else None, core[0])
    if not len(fixed):
        raise ValueError(
            f"no skin node lies within {FIXED_WITHIN} m of core, nail or clamp: "
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
