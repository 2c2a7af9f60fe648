"""Areas and normals of triangulated surfaces."""

import numpy as np


def face_areas(vert: np.ndarray, face: np.ndarray) -> np.ndarray:
    """(nface, 3) vector areas [m^2]: outward normals of faces (nface, 3) as long as the faces are large; vert
    (nvert, 3) [m]."""
    corner = vert[face]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2


def node_areas(face: np.ndarray, area: np.ndarray, nvert: int) -> np.ndarray:
    """(nvert, ...) shares of the nodes in areas (nface, ...) of faces (nface, 3): a third of each adjacent
    face."""
    out = np.zeros((nvert, *area.shape[1:]))
    np.add.at(out, face, area[:, None] / 3)
    return out


def node_normals(vert: np.ndarray, face: np.ndarray) -> np.ndarray:
    """(nvert, 3) unit outward normals at the nodes of a surface, means of the adjacent faces' by area; zero
    at other nodes."""
    out = node_areas(face, face_areas(vert, face), len(vert))
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return out / np.where(length > 0, length, 1.0)
