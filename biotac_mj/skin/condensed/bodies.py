"""Compliant bodies in a solve, by the threads of a block.

A body is at its predicted pose under the predicted wrench; another wrench moves it by the compliance of its
inertia and of its other constraints. To contact, a body is thus a compliance of rank six in series with the
skin's own (`docs/design.md`). The geoms are at the poses for a wrench near equilibrium; while Newton's method
changes the wrench, the nodes are moved relative to them instead."""

import warp as wp

from ..block import block_sum, sum_of_lanes, sync
from ..bodies import Bodies, follow_wrench
from ..contact.faces import Contact
from ..contact.posed import Geoms
from ..newton.load_path import partial_turn
from ..types import real, vec3, vec6
from .structs import Constants, F, Scratch

_LEVER = wp.constant(real(1e-2))  # lever arm of rotations [m]


@wp.func
def _group_of(w: int, i: int, geoms: Geoms, touch: Contact, c: Constants):
    """Group of geoms that touched outer node i at the end of the last step; the first, if none did."""
    v = c.node[i]
    nsample = c.sample.shape[0]
    for m in range(c.start[v], c.start[v + 1]):
        f = c.slot[m] / 3
        if touch.kept[f, w] == 1:
            for n in range(nsample):
                g = touch.anchor_geom[f * nsample + n, w]
                if g >= 0:
                    return geoms.group[g]
    return 0


@wp.func
def find_groups(w: int, t: int, nnode: int, geoms: Geoms, c: Constants, s: Scratch):
    """Finds the position of each candidate node, and its group of geoms, kept until another one touches
    it."""
    groups = s.bodies.compliance.shape[0]
    for k in range(t, wp.where(groups > 0, nnode, 0), wp.block_dim()):
        s.arm[w, k] = s.x[c.node[s.node[w, k]], w]
        s.group[w, k] = 0
        if groups > 1:
            s.group[w, k] = _group_of(w, s.node[w, k], geoms, s.touch, c)
    sync()


@wp.func
def touching_group(f: int, w: int, geoms: Geoms, touch: Contact, nsample: int, group: int):
    """The group of geoms that touches face f; `group` where none does."""
    for n in range(nsample):
        g = touch.trial_geom[f * nsample + n, w]
        if g >= 0:
            return geoms.group[g]
    return group


@wp.func
def number_bodies(w: int, t: int, outer: int, s: Scratch):
    """Gives the bodies that touched nodes answer to, and that give way, their equations."""
    b = s.bodies
    groups = b.compliance.shape[0]
    for h in range(t, groups, wp.block_dim()):
        b.column[h, w] = -1
    sync()
    for m in range(t, wp.where(groups > 0, outer, 0), wp.block_dim()):
        h = s.group[w, s.touched[w, m]]
        gives = b.compliance[h, h, w]
        if wp.ddot(gives, gives) > real(0.0):
            b.column[h, w] = 0
    sync()
    if t == 0:
        column = int(0)
        for h in range(groups):
            if b.column[h, w] == 0:
                b.column[h, w] = column
                column += 6
        s.borders[w] = column
    sync()


@wp.func
def _set_motions(w: int, t: int, b: Bodies):
    """Computes the motions of all bodies by the listed wrenches."""
    sync()
    for h in range(t, b.motion.shape[0], wp.block_dim()):
        m = vec6()
        for g in range(b.motion.shape[0]):
            load = b.wrench[g, w]
            if not wp.dot(load, load) == real(0.0):  # most bodies are not touched
                m += b.compliance[h, g, w] * load
        b.motion[h, w] = m
    sync()


@wp.func
def _list_loads(w: int, t: int, p: int, nnode: int, s: Scratch):
    """Makes the wrench of each body that on the nodes of its group that vector[p] of the candidates is: by
    eight threads for each, on the CPU by the one."""
    b = s.bodies
    lanes = wp.min(wp.block_dim(), 8)
    for h in range(t / lanes, b.wrench.shape[0], wp.block_dim() / lanes):
        force = vec3()
        torque = vec3()
        for k in range(t % lanes, nnode, lanes):
            if s.group[w, k] == h:
                f = vec3(s.vector[w, p, 3 * k], s.vector[w, p, 3 * k + 1], s.vector[w, p, 3 * k + 2])
                force += f
                torque += wp.cross(s.arm[w, k], f)
        force = sum_of_lanes(force, lanes)
        torque = sum_of_lanes(torque, lanes)
        if t % lanes == 0:
            b.wrench[h, w] = vec6(force[0], force[1], force[2], torque[0], torque[1], torque[2])
    sync()


@wp.func
def move_nodes(w: int, t: int, nnode: int, p: int, out: int, shifted: int, s: Scratch):
    """Adds to vector[out] how the nodes move relative to their bodies by forces vector[p]; with `shifted`
    from where the geoms are."""
    b = s.bodies
    if b.compliance.shape[0] > 0:
        _list_loads(w, t, p, nnode, s)
        for h in range(t, wp.where(shifted == 1, b.wrench.shape[0], 0), wp.block_dim()):
            b.wrench[h, w] = b.wrench[h, w] + b.posed[h, w]
        _set_motions(w, t, b)
        for k in range(t, nnode, wp.block_dim()):
            m = b.motion[s.group[w, k], w]
            u = vec3(m[0], m[1], m[2]) + wp.cross(vec3(m[3], m[4], m[5]), s.arm[w, k])
            for a in range(3):
                s.vector[w, out, 3 * k + a] = s.vector[w, out, 3 * k + a] + u[a]
        sync()


@wp.func
def place_bodies(w: int, t: int, load_factor: real, geoms: Geoms, s: Scratch):
    """Puts the geoms to a fraction of their path, where the wrenches `posed` then bring their bodies."""
    b = s.bodies
    for h in range(t, b.motion.shape[0], wp.block_dim()):
        b.wrench[h, w] = (
            b.posed[h, w] - (real(1.0) - load_factor) * b.begun[h, w] - load_factor * b.predicted[h, w]
        )
    _set_motions(w, t, b)
    for g in range(t, geoms.count, wp.block_dim()):
        pos = s.pos[g, w]
        mat = s.mat[g, w]
        if load_factor < real(1.0):
            pos = s.from_pos[g, w] + load_factor * (pos - s.from_pos[g, w])
            mat = partial_turn(s.from_mat[g, w], s.mat[g, w], load_factor)
        if b.motion.shape[0] > 0:
            h = geoms.group[g]
            pos, mat = follow_wrench(h, w, b, b.motion[h, w], pos, mat)
        geoms.pos[g, w] = pos
        geoms.mat[g, w] = mat
    sync()


@wp.func
def pose_by_load(w: int, t: int, load_factor: real, nnode: int, geoms: Geoms, c: Constants, s: Scratch):
    """Puts the geoms where the forces vector[F] of the candidates bring their bodies; by how much a point of
    theirs moves so at most [m]."""
    b = s.bodies
    groups = b.compliance.shape[0]
    if groups == 0:
        return real(0.0)
    for k in range(t, nnode, wp.block_dim()):
        s.arm[w, k] = s.x[c.node[s.node[w, k]], w]
    sync()
    _list_loads(w, t, F, nnode, s)
    for h in range(t, groups, wp.block_dim()):
        load = b.wrench[h, w]
        b.wrench[h, w] = -load - b.posed[h, w]
        b.posed[h, w] = -load
    _set_motions(w, t, b)
    far = real(0.0)
    for h in range(groups):
        m = b.motion[h, w]
        far = wp.max(far, wp.length(vec3(m[0], m[1], m[2])) + _LEVER * wp.length(vec3(m[3], m[4], m[5])))
    sync()
    place_bodies(w, t, load_factor, geoms, s)
    return far


@wp.func
def sum_forces(w: int, t: int, geoms: Geoms, c: Constants, s: Scratch):
    """Makes the wrenches `posed` those of the forces on all outer nodes that a solve begins with."""
    b = s.bodies
    groups = b.compliance.shape[0]
    for i in range(t, wp.where(groups > 0, c.node.shape[0], 0), wp.block_dim()):
        mine = int(-1)
        if wp.length_sq(s.force[w, i]) > real(0.0):
            mine = wp.where(groups > 1, _group_of(w, i, geoms, s.touch, c), 0)
        s.look[w, i] = mine  # which has no other use before faces are sought
    for h in range(groups):
        force = vec3()
        torque = vec3()
        for i in range(t, c.node.shape[0], wp.block_dim()):  # as above: each thread reads what it wrote
            if s.look[w, i] == h:
                force += s.force[w, i]
                torque += wp.cross(s.x[c.node[i], w], s.force[w, i])
        force = block_sum(force)
        torque = block_sum(torque)
        if t == 0:
            b.posed[h, w] = -vec6(force[0], force[1], force[2], torque[0], torque[1], torque[2])
    sync()
