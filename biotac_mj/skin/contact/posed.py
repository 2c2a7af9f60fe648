"""Geoms posed in the BioTac frame, and distances of points from them, in Warp.

The skin of another BioTac deforms as this one does. Two skins in contact are each solved against the surface
that parts their overlap as their thicknesses above core, nail and clamp (`docs/design.md`, "Skin on skin").
"""

import warp as wp

from ..types import mat33, real, vec3
from .meshes import TRILINEAR, Grids, grid_value, spline_field, to_triangles
from .shapes import (
    GEOM_TYPES,
    distance,
    distance_bound,
    distance_to_edge,
    lower_bound,
    primitive_distance,
)

WINDOW = 1.25  # radius around edges, over the distance of a face's corners from its samples, see `meet`
# angles between two normals [degrees] at edges of facets as narrow as the spacing of samples: up to the first
# it is a side of a solid, from the second on an edge
TURN = 10.0, 25.0
_FIRM = wp.constant(real(4.0))  # stiffness at an edge, where few samples take part, over that of a side
# height above the solid, over the window, in which the normal turns where a sample leaves a side for an edge
_ABOVE = wp.constant(real(0.1))
_BEYOND = wp.constant(real(0.3))  # barycentric distance outside a face at which an edge leaves it
SKIN, MESH = (wp.constant(GEOM_TYPES[name]) for name in ("skin", "mesh"))


@wp.struct
class Geoms:
    """Touching geoms in the BioTac frame, at the end and at the start of the step; arrays over worlds are
    [geom, world]."""

    count: int
    kind: wp.array(dtype=int)
    size: wp.array(dtype=vec3)
    rounding: wp.array(dtype=real)
    window: wp.array(dtype=real)  # radius around edges over that of a face, see `meet`; 0: no sharp edges
    grid: wp.array(dtype=int)
    # cosines of the angle between two normals up to which it is a side, and from which on an edge
    turn: wp.array(dtype=wp.vec2d)
    group: wp.array(dtype=int)
    friction: wp.array2d(dtype=real)
    pos: wp.array2d(dtype=vec3)
    mat: wp.array2d(dtype=mat33)
    pos_last: wp.array2d(dtype=vec3)
    mat_last: wp.array2d(dtype=mat33)
    grids: Grids
    # grid of the undeformed skin that they touch, if the skin of another BioTac is among them; the grid after
    # that of a skin is of its rigid parts
    own: int


@wp.struct
class LoadPath:
    """Path of the geoms within a step [geom, world]: from their poses in the last step, or clear of the skin,
    to their new poses."""

    pos_start: wp.array2d(dtype=vec3)
    mat_start: wp.array2d(dtype=mat33)
    pos_end: wp.array2d(dtype=vec3)
    mat_end: wp.array2d(dtype=mat33)


@wp.func
def place_on(geoms: Geoms, g: int, w: int, p: vec3):
    """Point p of the BioTac frame in the frame of geom g."""
    return wp.transpose(geoms.mat[g, w]) * (p - geoms.pos[g, w])


@wp.func
def least_to(geoms: Geoms, g: int, d: real):
    """Lower bound of the true distance if `distance_from` is d [m]."""
    if geoms.kind[g] == SKIN:
        return d - TRILINEAR * wp.max(geoms.grids.spacing[geoms.grid[g]], geoms.grids.spacing[geoms.own])
    return lower_bound(geoms.kind[g], geoms.grids, geoms.grid[g], d)


@wp.func
def _thickness(grids: Grids, k: int, p: vec3, outside: wp.vec4d):
    """Gradient and value of the thickness of skin k at a point that is `outside` off its undeformed shape."""
    through = spline_field(grids, k + 1, p) - outside
    if through[3] < real(0.0):
        return wp.vec4d()
    return through


@wp.func
def _turned(R: mat33, field: wp.vec4d):
    """A gradient and value in a frame in which the present one has the rotation R."""
    n = R * vec3(field[0], field[1], field[2])
    return wp.vec4d(n[0], n[1], n[2], field[3])


@wp.func
def _between_skins(geoms: Geoms, g: int, p: vec3, y: vec3, R: mat33):
    """Gradient and value of (d2 - d1) / 2 with the distances d1 from the own skin and d2 from the other,
    where these overlap of a d2 - (1 - a) d1 with the own share a of their thicknesses, and that share."""
    k = geoms.grid[g]
    other = spline_field(geoms.grids, k, y)
    straight = spline_field(geoms.grids, geoms.own, p)
    own = _turned(wp.transpose(R), straight)
    half = real(0.5) * (other - own)
    overlap = other + own
    if overlap[3] >= real(0.0):
        return half, real(0.5)
    theirs = _thickness(geoms.grids, k, y, other)
    mine = _turned(wp.transpose(R), _thickness(geoms.grids, geoms.own, p, straight))
    both = mine[3] + theirs[3]
    if both == real(0.0):
        return half, real(0.5)
    share = mine[3] / both
    turning = (theirs[3] * mine - mine[3] * theirs) / (both * both)  # its gradient
    turning[3] = real(0.0)
    return half + (share - real(0.5)) * overlap + overlap[3] * turning, share


@wp.func
def _apart(geoms: Geoms, g: int, p: vec3, y: vec3):
    """The value of `_between_skins`, but for errors of the grids."""
    k = geoms.grid[g]
    theirs = grid_value(geoms.grids, k, y)
    mine = grid_value(geoms.grids, geoms.own, p)
    half = real(0.5) * (theirs - mine)
    overlap = theirs + mine
    if overlap >= real(0.0):
        return half
    other = wp.max(grid_value(geoms.grids, k + 1, y) - theirs, real(0.0))
    own = wp.max(grid_value(geoms.grids, geoms.own + 1, p) - mine, real(0.0))
    if own + other == real(0.0):
        return half
    return half + (own / (own + other) - real(0.5)) * overlap


# a call copies all that Geoms hold: 1.6 kB, more work on the CPU than the distance from a sphere
@wp.func(inline=True)
def distance_from(geoms: Geoms, g: int, p: vec3, y: vec3, R: mat33):
    """Outward unit normal (x, y, z), in the geom's frame, and signed distance (w) [m] of point p of the
    BioTac frame from geom g with rotation R, in whose frame p is y."""
    if geoms.kind[g] == SKIN:
        least = _apart(geoms, g, p, y)
        if least_to(geoms, g, least) > real(0.0):  # surely outside: no contact here
            return wp.vec4d(real(1.0), real(0.0), real(0.0), least)
        field, _share = _between_skins(geoms, g, p, y, R)
        n = wp.normalize(vec3(field[0], field[1], field[2]))
        return wp.vec4d(n[0], n[1], n[2], field[3])
    return distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)


@wp.func
def bound_to(geoms: Geoms, g: int, p: vec3, y: vec3):
    """Lower bound of the distance of point p, y in the frame of geom g [m]; cheap far from the geom."""
    if geoms.kind[g] == SKIN:
        return least_to(geoms, g, _apart(geoms, g, p, y))
    return distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)


@wp.func
def face_radius(u: vec3, v: vec3):
    """Radius [m] of the ball around the centre of a face with edges u, v from its first corner."""
    middle = (u + v) / real(3.0)
    a = wp.length_sq(middle)
    return wp.sqrt(wp.max(a, wp.max(wp.length_sq(u - middle), wp.length_sq(v - middle))))


@wp.func
def touch_bound(geoms: Geoms, g: int, y: vec3, d: real, radius: real):
    """Lower bound of the distance to contact [m] of a point y in the frame of geom g, at a distance of at
    least d. radius: of its face, or of a ball around faces."""
    window = geoms.window[g] * radius
    if window == real(0.0):
        return d
    edge = distance_to_edge(geoms.kind[g], geoms.size[g], geoms.rounding[g], y, wp.max(d, real(0.0)))
    return wp.min(d, edge - window)


@wp.func
def _closest(geoms: Geoms, g: int, y: vec3, meshes: int):
    """Outward unit normal and distance, exact at any distance from a mesh."""
    if meshes == 1 and geoms.kind[g] == MESH:
        within = wp.abs(grid_value(geoms.grids, geoms.grid[g], y)) + geoms.grids.spacing[geoms.grid[g]]
        return to_triangles(geoms.grids, geoms.grid[g], y, within)
    return primitive_distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], y)


@wp.func
def _moved(b: vec3, u: vec3, v: vec3, by: vec3):
    """Barycentric coordinates of the point b of a triangle with edges u, v after a motion `by` in its
    plane."""
    uu = wp.dot(u, u)
    uv = wp.dot(u, v)
    vv = wp.dot(v, v)
    second = (vv * wp.dot(by, u) - uv * wp.dot(by, v)) / (uu * vv - uv * uv)
    third = (uu * wp.dot(by, v) - uv * wp.dot(by, u)) / (uu * vv - uv * uv)
    return b + vec3(-second - third, second, third)


@wp.struct
class Meeting:
    """Contact of a sample with a geom: outward unit normal in the geom's frame, gap [m], barycentric
    coordinates at which the force acts, and weight of the sample."""

    normal: vec3
    gap: real
    at: vec3
    weight: real


@wp.func
def meet_side(dn: wp.vec4d, b: vec3):
    """Contact of a sample with barycentric coordinates b with a surface without edges; dn: its `distance`."""
    met = Meeting()
    met.normal = vec3(dn[0], dn[1], dn[2])
    met.gap = dn[3]
    met.at = b
    met.weight = real(1.0)
    return met


@wp.func
def meet(geoms: Geoms, g: int, w: int, y: vec3, dn: wp.vec4d, b: vec3, u: vec3, v: vec3, meshes: int):
    """Contact of a sample of a face with geom g.

    At an edge a solid has a cone of normals. The skin meets the edge with its own normal if the cone contains
    it, else with the nearest normal of the cone. The gap is the distance of the edge from the plane of the
    face, which does not depend on where along the face the edge lies, so that there is no tangential force.
    The force acts at the edge, by the samples within the window.

    Args:
      y, dn: the sample in the geom's frame and its `distance`. b: its barycentric coordinates. u, v: edges of
        the face from its first corner, in the BioTac frame. meshes: 0 if no geom is a mesh, which removes
        code.
    """
    met = meet_side(dn, b)
    window = geoms.window[g]
    if window == real(0.0):
        return met
    window = window * face_radius(u, v)
    if dn[3] > window:
        return met
    deep = wp.max(-dn[3], real(0.0))
    if distance_to_edge(geoms.kind[g], geoms.size[g], geoms.rounding[g], y, real(0.0)) > window + deep:
        return met
    along = wp.transpose(geoms.mat[g, w]) * u
    across = wp.transpose(geoms.mat[g, w]) * v
    inward = wp.normalize(wp.cross(across, along))
    # seen from inside the skin, the solid's closest point is its edge; the closest point of a second point
    # above it gives the normal
    probe = y + (window + real(2.0) * deep) * inward
    found = _closest(geoms, g, probe, meshes)
    probe = probe - found[3] * vec3(found[0], found[1], found[2]) + window * inward
    found = _closest(geoms, g, probe, meshes)
    normal = vec3(found[0], found[1], found[2])
    off = y - probe + found[3] * normal
    gap = wp.dot(normal, off)
    if gap > dn[3]:  # in a hollow
        return met
    # every sample touches a side of the solid; only samples of the face above an edge touch that, at the edge
    # the nearest side changes at once where a sample in the solid is as far from another one, and the force
    # with it: the side is that of a point above the sample, outside of the solid, where its normal is
    # continuous
    above = y + (_ABOVE * window - wp.min(gap, real(0.0))) * normal
    found = _closest(geoms, g, above, meshes)
    met.normal = vec3(found[0], found[1], found[2])
    met.gap = wp.dot(met.normal, y - above) + found[3]
    turn = geoms.turn[g]
    edge = wp.clamp((turn[0] - wp.dot(normal, met.normal)) / (turn[0] - turn[1]), real(0.0), real(1.0))
    near = wp.length_sq(off - gap * normal) / (window * window)
    at = _moved(b, along, across, -off)
    beyond = wp.max(-wp.min(at), real(0.0)) / _BEYOND
    if edge == real(0.0) or near >= real(1.0) or beyond >= real(1.0):
        met.weight = real(1.0) - edge
        return met
    blend = (real(1.0) - near) * (real(1.0) - beyond)
    blend = edge * _FIRM * blend * blend
    met.weight = real(1.0) - edge + blend
    blend = blend / met.weight
    met.at = b + blend * (at - b)
    met.normal = wp.normalize(met.normal + blend * (normal - met.normal))
    met.gap = met.gap + blend * (gap - met.gap)
    return met


@wp.func
def convected_anchor(geoms: Geoms, g: int, w: int, stick: vec3, y: vec3):
    """Anchor of the last step in the present frame of geom g, of a point at y there. On another skin it moves
    by the own share of the body's way, as the surface between both does."""
    if geoms.kind[g] == SKIN:
        p = geoms.mat[g, w] * y + geoms.pos[g, w]
        _field, share = _between_skins(geoms, g, p, y, geoms.mat[g, w])
        there = place_on(geoms, g, w, geoms.mat_last[g, w] * stick + geoms.pos_last[g, w])
        return there + share * (stick - there)
    return stick
