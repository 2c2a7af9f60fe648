"""Numbers for the card of a skin."""

import numpy as np

from biotac_mj.geometry.closest import ray_distances
from biotac_mj.geometry.core_surface import CoreSurface
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.geometry.tet_mesh import TetMesh, enclosed_volume


def skin_numbers(skin: SkinGeometry) -> dict:
    """Numbers of a skin: counts, angles [deg], volumes [mm^3], thickness [mm], box [mm], gaps of the
    electrodes to the inner skin [mm].

    A ten-node tetrahedron counts as eight four-node ones. The thickness is the distance of each inner node
    from the outer surface, the fluid volume is that of the cavity minus that of the core, and a gap is the
    distance of an electrode from the inner surface along its normal."""
    mesh = TetMesh(skin.vert, skin.tets)
    vert = skin.vert * 1e3
    inner = skin.vert[np.unique(skin.inner_face)]
    thickness = 1e3 * np.abs(CoreSurface(skin.vert, skin.outer_face).closest(inner)[0])
    cavity, core = (
        -enclosed_volume(vert, skin.inner_face),
        enclosed_volume(skin.core_vert * 1e3, skin.core_face),
    )
    linked = skin.tets[np.isin(skin.tets, skin.outer_face).any(axis=1)]  # to an outer node
    rays = zip(skin.electrode_pos * 1e3, skin.electrode_normal)
    gaps = np.array([ray_distances(vert[skin.inner_face], *ray).min() for ray in rays])
    lowest = np.degrees(mesh.dihedral_angles.min(axis=1))
    return {
        "nodes": skin.nvert,
        "tetrahedra": skin.nelem,
        "nodes of a tetrahedron": skin.elem.shape[1],
        "outer nodes": len(np.unique(skin.outer_face)),
        "inner nodes": len(np.unique(skin.inner_face)),
        "held nodes": len(skin.fixed),
        "minimum dihedral angle": lowest.min(),
        "minimum dihedral angle, 1st percentile over tetrahedra": np.percentile(lowest, 1),
        "fraction of inner nodes two or more edges from the outside": 1
        - np.mean(np.isin(np.unique(skin.inner_face), linked)),
        "skin volume": mesh.volumes.sum() * 1e9,
        "cavity volume": cavity,
        "core volume": core,
        "fluid volume": cavity - core,
        "thickness median": np.median(thickness),
        "thickness minimum": thickness.min(),
        "thickness maximum": thickness.max(),
        "box": [vert.min(axis=0), vert.max(axis=0)],
        "gaps": np.where(np.isfinite(gaps), gaps, np.nan),
    }
