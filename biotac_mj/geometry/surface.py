"""Areas and normals of triangulated surfaces."""

import numpy as np

FORCE_TOUCHES = 1e-6  # [N]: less is no contact
OF_HERTZ = 9 / 8  # of `pressure_area`


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


def pressure_area(force: np.ndarray, area: np.ndarray) -> np.ndarray:
    """(n,) area [m^2] on which forces (n, nnode) [N] press nodes with areas (nnode,) [m^2]; 0 without force.

    9/8 (int p dA)^2 / int p^2 dA, which is the area of a contact whose pressure p falls to 0 at its edge as
    Hertz's does. An even pressure has 9/8 of its area. The pressure is a node's force over its area, so that
    the area follows the forces without steps; it is at least 9/8 of a node's."""
    square = (force**2 / area).sum(1)
    total = force.sum(1)
    return OF_HERTZ * np.divide(total**2, square, out=np.zeros(len(force)), where=total > FORCE_TOUCHES)


def node_normals(vert: np.ndarray, face: np.ndarray) -> np.ndarray:
    """(nvert, 3) unit outward normals at the nodes of a surface, means of the adjacent faces' by area; zero
    at other nodes."""
    out = node_areas(face, face_areas(vert, face), len(vert))
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return out / np.where(length > 0, length, 1.0)
