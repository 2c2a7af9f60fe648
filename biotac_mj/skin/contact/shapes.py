"""Signed distance from MuJoCo's geoms, in Warp: sphere, capsule, cylinder, ellipsoid, box, plane, and mesh
(see `meshes`). Points are in the geom's frame; `posed` transforms them.

A `rounding` radius r shrinks a box or a cylinder by r and grows it again by r: its edges become fillets of
radius r, its faces stay."""

import warp as wp

from ..types import real, vec3
from .meshes import NEAR_SURFACE, TRILINEAR, Grids, grid_value, mesh_distance, spline_field, to_triangles

# MuJoCo's mjtGeom, and the skin of another BioTac
GEOM_TYPES = {
    "plane": 0, "sphere": 2, "capsule": 3, "ellipsoid": 4, "cylinder": 5, "box": 6, "mesh": 7, "skin": 8,
}  # fmt: skip
# [m] largest cells whose error a bound may have; distances above which a bound need not be accurate
_COARSE, _NEAR = (wp.constant(real(2.5e-4)), wp.constant(real(5e-3)))


@wp.func
def _signs(p: vec3):
    s = vec3(real(1.0), real(1.0), real(1.0))
    for i in range(3):
        if p[i] < real(0.0):
            s[i] = real(-1.0)
    return s


@wp.func
def _rounded_box(half: vec3, r: real, p: vec3):
    q = wp.cw_mul(_signs(p), p) - (half - vec3(r, r, r))
    n = vec3()
    d = real(0.0)
    if wp.max(q) > real(0.0):
        out = wp.max(q, vec3())
        d = wp.length(out)
        n = out / d
    else:
        d = wp.max(q)
        axis = int(wp.argmax(q))
        n[axis] = real(1.0)
    n = wp.cw_mul(_signs(p), n)
    return wp.vec4d(n[0], n[1], n[2], d - r)


@wp.func
def _rounded_cylinder(radius: real, half: real, r: real, p: vec3):
    rho = wp.sqrt(p[0] * p[0] + p[1] * p[1])
    e = vec3(real(1.0), real(0.0), real(0.0))
    if rho > real(0.0):
        e = vec3(p[0] / rho, p[1] / rho, real(0.0))
    side = wp.sign(p[2])
    a = rho - (radius - r)
    b = wp.abs(p[2]) - (half - r)
    n = vec3()
    d = real(0.0)
    if a > real(0.0) and b > real(0.0):
        d = wp.sqrt(a * a + b * b)
        n = (a * e + vec3(real(0.0), real(0.0), b * side)) / d
    elif a > b:
        d = a
        n = e
    else:
        d = b
        n = vec3(real(0.0), real(0.0), side)
    return wp.vec4d(n[0], n[1], n[2], d - r)


@wp.func
def _ellipsoid(radii: vec3, p: vec3):
    """Closest point p_i r_i^2 / (t + r_i^2), t the largest root of sum (r_i p_i / (t + r_i^2))^2 = 1
    (Eberly): Newton from the left."""
    q = wp.cw_mul(_signs(p), p) + vec3(real(1.0e-12), real(1.0e-12), real(1.0e-12))
    r2 = wp.cw_mul(radii, radii)
    t = wp.max(wp.cw_mul(radii, q) - r2)
    for _ in range(50):
        g = real(-1.0)
        dg = real(0.0)
        for i in range(3):
            s = radii[i] * q[i] / (t + r2[i])
            g += s * s
            dg -= real(2.0) * s * s / (t + r2[i])
        step = -g / dg
        t += step
        if wp.abs(step) < real(1.0e-14) * r2[0]:
            break
    c = vec3()
    n = vec3()
    for i in range(3):
        c[i] = r2[i] * q[i] / (t + r2[i])
        n[i] = c[i] / r2[i]
    d = wp.length(q - c)
    if t < real(0.0):
        d = -d
    n = wp.cw_mul(_signs(p), wp.normalize(n))
    return wp.vec4d(n[0], n[1], n[2], d)


@wp.func
def primitive_distance(kind: int, size: vec3, rounding: real, p: vec3):
    """`distance` from a geom that is no mesh."""
    if kind == 0:
        return wp.vec4d(real(0.0), real(0.0), real(1.0), p[2])
    if kind == 2 or kind == 3:
        q = p
        if kind == 3:
            q = vec3(p[0], p[1], p[2] - wp.clamp(p[2], -size[1], size[1]))
        r = wp.length(q)
        n = vec3(real(0.0), real(0.0), real(1.0))
        if r > real(0.0):
            n = q / r
        return wp.vec4d(n[0], n[1], n[2], r - size[0])
    if kind == 4:
        return _ellipsoid(size, p)
    if kind == 5:
        return _rounded_cylinder(size[0], size[1], rounding, p)
    return _rounded_box(size, rounding, p)


@wp.func
def distance_to_edge(kind: int, size: vec3, rounding: real, p: vec3, d: real):
    """Lower bound of the distance from the nearest edge or corner [m] of a point at distance d from the
    surface; |d| for a mesh."""
    q = wp.cw_mul(_signs(p), p) - (size - vec3(rounding, rounding, rounding))
    if kind == 5:
        rho = wp.sqrt(p[0] * p[0] + p[1] * p[1])
        return (
            wp.length(vec3(rho - size[0] + rounding, wp.abs(p[2]) - size[1] + rounding, real(0.0))) - rounding
        )
    if kind == 6:
        out = wp.max(q, vec3())
        least = real(wp.inf)
        for i in range(3):  # along axis i
            a = q[(i + 1) % 3]
            b = q[(i + 2) % 3]
            least = wp.min(least, a * a + b * b + out[i] * out[i])
        return wp.sqrt(least) - rounding
    return wp.abs(d)


@wp.func
def distance(kind: int, size: vec3, rounding: real, grids: Grids, grid: int, p: vec3):
    """Outward unit normal (x, y, z) and signed distance (w) [m] of point p in the geom's frame. The normal of
    a smooth mesh is the gradient of its spline."""
    if kind == 7:
        return mesh_distance(grids, grid, p)
    return primitive_distance(kind, size, rounding, p)


@wp.func
def lower_bound(kind: int, grids: Grids, grid: int, d: real):
    """Lower bound of the true distance if `distance` is d [m]: a grid has errors at sharp tips."""
    if kind == 7 and d > TRILINEAR * grids.spacing[grid]:
        return d - TRILINEAR * grids.spacing[grid]
    if kind == 7:  # the values of a spline at two points may differ by more than the points' distance
        return d - real(2.0) * grids.error[grid]
    return d


@wp.func
def rough_bound(kind: int, size: vec3, rounding: real, grids: Grids, grid: int, p: vec3):
    """Lower bound of the distance [m] that is evaluated on the grid of a mesh alone."""
    if kind == 7:
        return grid_value(grids, grid, p) - TRILINEAR * grids.spacing[grid]
    return primitive_distance(kind, size, rounding, p)[3]


@wp.func
def distance_bound(kind: int, size: vec3, rounding: real, grids: Grids, grid: int, p: vec3):
    """Lower bound of the distance [m], exact only near the surface, and cheap elsewhere."""
    bound = rough_bound(kind, size, rounding, grids, grid, p)
    if kind == 7 and bound > -(real(1.0) + TRILINEAR) * grids.spacing[grid]:
        h = grids.spacing[grid]
        if grids.spline[grid] >= 0:
            if bound < (NEAR_SURFACE - TRILINEAR) * h:
                bound = wp.max(bound, spline_field(grids, grid, p)[3] - real(2.0) * grids.error[grid])
        elif h > _COARSE and bound < _NEAR:
            # a large mesh has large cells: its grid alone would keep too many faces
            bound = wp.max(bound, to_triangles(grids, grid, p, real(4.0) * h)[3])
    return bound
