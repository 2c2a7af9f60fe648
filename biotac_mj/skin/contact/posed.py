"""Geoms posed in the BioTac frame, and how far points of the skin are from them, in Warp.

The skin of another BioTac gives way as this one does. Two that press against each other meet where the
distances d1, d2 from either's shape at rest are the same: on the surface of zeros of (d2 - d1) / 2, which is
what each skin is solved against, and which lies halfway if they are alike (`docs/design.md`, "Skin on skin").
"""

import warp as wp

from ..types import mat33, real, vec3
from .meshes import TRILINEAR, Grids, grid_value, mesh_field
from .shapes import GEOM_TYPES, distance, distance_bound, lower_bound, rough_bound

__all__ = [
    "SKIN",
    "Geoms",
    "Way",
    "bound_to",
    "distance_from",
    "distance_to",
    "held_at",
    "least_to",
    "place_on",
    "rough_bound_to",
]

wp.set_module_options({"enable_backward": False})

SKIN = wp.constant(GEOM_TYPES["skin"])


@wp.struct
class Geoms:
    """Touching geoms in the BioTac frame, at the end and at the start of the step; arrays over worlds are
    [geom, world]."""

    count: int
    kind: wp.array(dtype=int)
    size: wp.array(dtype=vec3)
    rounding: wp.array(dtype=real)
    grid: wp.array(dtype=int)
    group: wp.array(dtype=int)
    friction: wp.array2d(dtype=real)
    pos: wp.array2d(dtype=vec3)
    mat: wp.array2d(dtype=mat33)
    pos_last: wp.array2d(dtype=vec3)
    mat_last: wp.array2d(dtype=mat33)
    grids: Grids
    own: int  # grid of the skin that they touch, as it rests, where another one's is among them


@wp.struct
class Way:
    """Of the geoms within a step [geom, world]: from where they were in the last one, or where nothing
    touched, to where they are asked to be."""

    pos_start: wp.array2d(dtype=vec3)
    mat_start: wp.array2d(dtype=mat33)
    pos_end: wp.array2d(dtype=vec3)
    mat_end: wp.array2d(dtype=mat33)


@wp.func
def place_on(geoms: Geoms, g: int, w: int, p: vec3):
    """Point p of the BioTac frame in that of geom g."""
    return wp.transpose(geoms.mat[g, w]) * (p - geoms.pos[g, w])


@wp.func
def least_to(geoms: Geoms, g: int, d: real):
    """The least that a `distance_to` d may be [m]."""
    if geoms.kind[g] == SKIN:
        return d - TRILINEAR * wp.max(geoms.grids.spacing[geoms.grid[g]], geoms.grids.spacing[geoms.own])
    return lower_bound(geoms.kind[g], geoms.grids, geoms.grid[g], d)


@wp.func
def _between_skins(geoms: Geoms, g: int, p: vec3, y: vec3, R: mat33):
    theirs = grid_value(geoms.grids, geoms.grid[g], y)
    mine = grid_value(geoms.grids, geoms.own, p)
    d = real(0.5) * (theirs - mine)
    if least_to(geoms, g, d) > real(0.0):  # surely outside: no contact here
        return wp.vec4d(real(1.0), real(0.0), real(0.0), d)
    other = mesh_field(geoms.grids, geoms.grid[g], y, theirs)
    own = mesh_field(geoms.grids, geoms.own, p, mine)
    n = vec3(other[0], other[1], other[2]) - wp.transpose(R) * vec3(own[0], own[1], own[2])
    n = wp.normalize(n)
    return wp.vec4d(n[0], n[1], n[2], real(0.5) * (other[3] - own[3]))


@wp.func
def distance_from(geoms: Geoms, g: int, p: vec3, y: vec3, R: mat33):
    """`distance_to` of a geom turned by R, in whose frame p is y."""
    if geoms.kind[g] == SKIN:
        return _between_skins(geoms, g, p, y, R)
    return distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)


@wp.func
def distance_to(geoms: Geoms, g: int, w: int, p: vec3):
    """Outward unit normal (x, y, z), in the geom's frame, and signed distance (w) [m] of point p of the
    BioTac frame from geom g."""
    return distance_from(geoms, g, p, place_on(geoms, g, w, p), geoms.mat[g, w])


@wp.func
def _bound_between(geoms: Geoms, g: int, p: vec3, y: vec3):
    apart = grid_value(geoms.grids, geoms.grid[g], y) - grid_value(geoms.grids, geoms.own, p)
    return least_to(geoms, g, real(0.5) * apart)


@wp.func
def bound_to(geoms: Geoms, g: int, p: vec3, y: vec3):
    """Lower bound of the distance [m] of point p, which geom g has at y in its frame: cheap where that is
    far."""
    if geoms.kind[g] == SKIN:
        return _bound_between(geoms, g, p, y)
    return distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)


@wp.func
def rough_bound_to(geoms: Geoms, g: int, p: vec3, y: vec3):
    """`bound_to` that asks no mesh: of one, by its grid alone."""
    if geoms.kind[g] == SKIN:
        return _bound_between(geoms, g, p, y)
    return rough_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)


@wp.func
def held_at(geoms: Geoms, g: int, w: int, stick: vec3):
    """Where an anchor of the last step is on geom g now: of another skin halfway, since that gives way
    too."""
    if geoms.kind[g] == SKIN:
        there = place_on(geoms, g, w, geoms.mat_last[g, w] * stick + geoms.pos_last[g, w])
        return real(0.5) * (stick + there)
    return stick
