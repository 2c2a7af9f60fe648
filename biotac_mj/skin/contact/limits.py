"""How far skin, geoms and core are from each other: what is looked at besides the contact forces."""

import warp as wp

from ..types import real, vec3
from .faces import Geoms
from .shapes import distance, distance_bound

__all__ = ["contact_inside_core", "crushed_on_core", "depth_in_core", "rest_gap"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def rest_gap(
    # In:
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    # Out:
    gap_out: wp.array(dtype=real),
):
    """Distance of every sample to the first geom."""
    f, s = wp.tid()
    t = face[f]
    b = sample[s]
    p = b[0] * x[t[0], 0] + b[1] * x[t[1], 0] + b[2] * x[t[2], 0]
    dn = distance(geoms.kind[0], geoms.size[0], geoms.rounding[0], geoms.grids, geoms.grid[0], p)
    gap_out[f * sample.shape[0] + s] = dn[3]


@wp.kernel
def crushed_on_core(
    # In:
    limit: real,
    face: wp.array(dtype=wp.vec3i),
    core: Geoms,
    x: wp.array2d(dtype=vec3),
    asked: wp.array(dtype=int),
    # Out:
    failed_out: wp.array(dtype=int),
):
    """Marks worlds with a corner of the inner surface deeper in the core than the limit: on its way
    through."""
    f, w = wp.tid()
    if asked[w] == 0:
        return
    R = wp.transpose(core.mat[0, w])
    for c in range(3):
        y = R * (x[face[f][c], w] - core.pos[0, w])
        bound = distance_bound(core.kind[0], core.size[0], core.rounding[0], core.grids, core.grid[0], y)
        if bound < -limit:  # too deep, perhaps
            dn = distance(core.kind[0], core.size[0], core.rounding[0], core.grids, core.grid[0], y)
            if dn[3] < -limit:
                failed_out[w] = 1


@wp.kernel
def contact_inside_core(
    # In:
    chunk: int,
    limit: real,
    core_vert: wp.array(dtype=vec3),
    geoms: Geoms,
    # Out:
    deep_out: wp.array(dtype=int),
):
    """Marks worlds in which a geom reaches deeper into the rigid core than the limit."""
    g, c, w = wp.tid()
    R = geoms.mat[g, w]
    for i in range(c * chunk, wp.min((c + 1) * chunk, core_vert.shape[0])):
        y = wp.transpose(R) * (core_vert[i] - geoms.pos[g, w])
        if (
            distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
            < -limit
        ):
            deep_out[w] = 1


@wp.kernel
def depth_in_core(
    # In:
    core_vert: wp.array(dtype=vec3),
    geoms: Geoms,
    # Out:
    depth_out: wp.array2d(dtype=real),
):
    """How deep each geom reaches into the rigid core, by the core's vertices inside the geom [geom,
    world]."""
    g, w = wp.tid()
    R = geoms.mat[g, w]
    deepest = real(0.0)
    for i in range(core_vert.shape[0]):
        y = wp.transpose(R) * (core_vert[i] - geoms.pos[g, w])
        bound = distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
        deepest = wp.min(deepest, bound)
    depth_out[g, w] = -deepest
