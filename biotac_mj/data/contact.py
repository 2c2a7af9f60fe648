"""Contact position, depth and area of an object on the skin: labels of a set's time steps."""

import numpy as np

from ..geometry.skin_geometry import SkinGeometry
from ..geometry.surface import FORCE_TOUCHES, face_areas, node_areas, node_normals, pressure_area
from .schema import nodes_of


def contact_labels(
    geometry: SkinGeometry,
    displacement: np.ndarray,
    force: np.ndarray,
    rest: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """contact_pos, contact_normal, contact_depth and contact_area of n time steps, see `schema.Interaction`.

    Args:
      displacement: (n, nvert, 3) of the nodes against `geometry.vert` [m].
      force: (n, nouter, 3) of the object on the outer nodes [N].
      rest: (nvert, 3) displacements of the untouched skin, the zero of depth; None: 0.
    """
    outer, size = nodes_of(geometry), np.linalg.norm(np.asarray(force, float), axis=2)
    total = size.sum(1)
    touches = total > FORCE_TOUCHES
    weight = size / np.where(touches, total, 1.0)[:, None]
    at_rest = geometry.vert if rest is None else geometry.vert + rest
    facing = node_normals(at_rest, geometry.outer_face)[outer]
    pos, normal, depth = np.full((len(size), 3), np.nan), np.full((len(size), 3), np.nan), np.zeros(len(size))
    for i in np.flatnonzero(touches):
        vert = geometry.vert + np.asarray(displacement[i], float)
        pos[i] = weight[i] @ vert[outer]
        normal[i] = weight[i] @ node_normals(vert, geometry.outer_face)[outer]
        moved = (vert - at_rest)[outer][weight[i] > 0]
        depth[i] = max(0.0, -(moved * facing[weight[i] > 0]).sum(1).min())
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    at_node = node_areas(
        geometry.outer_face,
        np.linalg.norm(face_areas(at_rest, geometry.outer_face), axis=1),
        len(at_rest),
    )[outer]
    return {
        "contact_pos": pos,
        "contact_normal": normal,
        "contact_depth": depth,
        "contact_area": pressure_area(size, at_node),
    }
