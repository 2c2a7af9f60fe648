"""A small skin for gradients: a thick ball of rubber, held from above, around a rigid core, with room for
liquid between them."""

import blocks
import numpy as np
import trimesh

from biotac_mj.geometry.rigid import rotation

__all__ = ["bubble"]


def bubble(radius=6e-3, wall=1.5e-3, gap=0.4e-3, subdivisions=1):
    """A SkinGeometry; the tip is at -y."""
    vert, elem, inner = blocks.shell(radius, radius - wall, subdivisions=subdivisions, layers=2)
    # not in the directions of the mesh: nothing touches at a corner or an edge
    turn = rotation(np.array([[0.3, 0.4, 0.5]]))[0]
    core = trimesh.creation.icosphere(subdivisions=2, radius=radius - wall - gap)
    vert, hull = vert @ turn.T, core.vertices @ turn.T
    fixed = np.flatnonzero(vert[:, 1] > 0.3 * radius)
    return blocks.skin(vert, elem, fixed, inner_face=inner, name="bubble", core=(hull, core.faces))
