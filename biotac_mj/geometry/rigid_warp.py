"""Rigid motions in Warp: poses, rotation vectors and small motions.

A small motion has the translation of the point at the origin first, then the rotation vector."""

import warp as wp

real = wp.float64
vec3 = wp.vec3d
mat33 = wp.mat33d
vec6 = wp.spatial_vectord

LEVER = 0.01  # [m] about the size of a fingertip: compares rotations with translations


@wp.func
def rotation(v: vec3):
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle2 = wp.dot(v, v)
    angle = wp.sqrt(angle2)
    a = real(1.0) - angle2 / real(6.0)
    b = real(0.5) - angle2 / real(24.0)
    if angle > real(1.0e-4):
        a = wp.sin(angle) / angle
        b = (real(1.0) - wp.cos(angle)) / angle2
    k = wp.skew(v)
    return wp.identity(n=3, dtype=real) + a * k + b * (k * k)


@wp.func
def motion(pos: vec3, mat: mat33, pos0: vec3, mat0: mat33):
    """Small motion from pose 0 to pos, mat."""
    turn = mat * wp.transpose(mat0)
    v = real(0.5) * vec3(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
    sine = wp.length(v)
    if sine > real(1.0e-9):
        v = wp.atan2(sine, real(0.5) * (wp.trace(turn) - real(1.0))) / sine * v
    t = pos - pos0 - wp.cross(v, pos0)
    return vec6(t[0], t[1], t[2], v[0], v[1], v[2])


@wp.func
def displace_at_once(pos: vec3, mat: mat33, m: vec6, here: vec3, spin: vec3):
    """The pose after a small motion that was measured with the body's reference point at `here`. The rotation
    vector `spin` is already in mat. The body rotates by the sum of both rotation vectors; two rotations in
    sequence would give another pose."""
    turn = vec3(m[3], m[4], m[5])
    p = pos + vec3(m[0], m[1], m[2]) + wp.cross(turn, here)
    return p, rotation(spin + turn) * wp.transpose(rotation(spin)) * mat


@wp.func
def motion_at_once(pos: vec3, mat: mat33, pos0: vec3, mat0: mat33, here: vec3, spin: vec3):
    """The small motion for which `displace_at_once` gives pos, mat from pose 0; exact to third order in turn
    and spin (Baker-Campbell-Hausdorff)."""
    m = motion(pos, mat, pos0, mat0)
    turn = vec3(m[3], m[4], m[5])
    both = wp.cross(turn, spin)
    t = turn + real(0.5) * both + wp.cross(turn - spin, both) / real(12.0)
    p = pos - pos0 - wp.cross(t, here)
    return vec6(p[0], p[1], p[2], t[0], t[1], t[2])


@wp.func
def size_of(m: vec6):
    """Largest component of a small motion, rotations times a lever arm [m]."""
    size = real(0.0)
    for i in range(3):
        size = wp.max(size, wp.max(wp.abs(m[i]), real(LEVER) * wp.abs(m[3 + i])))
    return size


@wp.func
def is_finite(pos: vec3, mat: mat33):
    total = real(0.0)
    for i in range(3):
        total += wp.abs(pos[i])
        for j in range(3):
            total += wp.abs(mat[i, j])
    return total < real(1.0e6)  # false for nan, too
