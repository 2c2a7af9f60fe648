"""A finer mesh of the same body, for fits of the material without the discretisation error of their mesh."""

import dataclasses

import numpy as np

from ..geometry.edge_nodes import EDGES, with_edge_nodes
from ..geometry.making.assembly import fixed_nodes
from ..geometry.skin_geometry import PARTS, SkinGeometry
from ..geometry.skins import load_skin

_PREFIX = "refined:"


def skin(name: str) -> SkinGeometry:
    """A skin for `load_skin`, or a refined one: "refined:default"."""
    return refined(load_skin(name.removeprefix(_PREFIX))) if name.startswith(_PREFIX) else load_skin(name)


def refined(geometry: SkinGeometry) -> SkinGeometry:
    """Every ten-node tetrahedron cut into eight along its own curves; new nodes on the rigid bodies are fixed
    too.

    Raises:
      ValueError: four-node tetrahedra.
    """
    if geometry.element != "quadratic":
        raise ValueError(
            f"skin {geometry.name!r} has four-node tetrahedra: "
            "pass one with ten nodes (`with_edge_nodes` makes them)"
        )
    barycentric = np.vstack([np.eye(4), np.eye(4)[EDGES].mean(1)])
    middle = barycentric[PARTS][:, EDGES].mean(2)  # (8 parts, 6 edges, 4)
    shape = np.concatenate(
        [middle * (2 * middle - 1), 4 * middle[..., EDGES[:, 0]] * middle[..., EDGES[:, 1]]], axis=2
    )
    fine = with_edge_nodes(dataclasses.replace(geometry, elem=geometry.tets))
    vert = fine.vert.copy()
    vert[fine.elem.reshape(-1, 8, 10)[:, :, 4:]] = np.einsum(
        "pmn,enk->epmk", shape, geometry.vert[geometry.elem]
    )
    bodies = [(getattr(fine, f"{b}_vert"), getattr(fine, f"{b}_face")) for b in ("core", "nail", "clamp")]
    touching = fixed_nodes(vert, bodies) if len(fine.nail_vert) else fine.fixed
    return dataclasses.replace(
        fine, name=_PREFIX + geometry.name, vert=vert, fixed=np.union1d(fine.fixed, touching)
    )
