"""Results of a balanced skin, by the threads of a block: nodes, the liquid's volume, corrections, wrenches on
bodies and their tangents."""

import warp as wp

from ...kernels import kernel_module
from ..block import block_max, block_sum, sync
from ..contact.faces import thinned
from ..contact.posed import Geoms
from ..newton.worlds import Worlds, modulus_of
from ..types import mat66, real, vec3, widen
from .correction import softening_of, swelling_of
from .elimination import eliminate
from .lanes import dot_columns, sum_rows
from .states import Linear
from .structs import DU, Constants, F, G, Remembered, Scratch
from .system import fill_contact, gather_blocks

kernel_module(__name__)

_softening_of, _swelling_of = wp.func(softening_of), wp.func(swelling_of)


@wp.func
def place_nodes(w: int, t: int, count: int, pressure: real, l: Linear, c: Constants, s: Scratch):
    """Puts all nodes where count listed loads and a pressure above that at rest [Pa] bring them; what that
    adds to the cavity's volume, and its linear part [m^3]; the largest displacement [m]."""
    linear = real(0.0)
    largest = real(0.0)
    swollen = l.swell * pressure
    if wp.block_dim() == 1:
        sum_rows(c.row, c.largest, w, 3 * c.free.shape[0], count, s.loaded, s.load, s.sum)
    for i in range(t, c.free.shape[0], wp.block_dim()):
        u = wp.vec3()
        if wp.block_dim() == 1:
            u = wp.vec3(s.sum[w, 3 * i], s.sum[w, 3 * i + 1], s.sum[w, 3 * i + 2])
        else:
            u = dot_columns(c.row, c.largest, 3 * i, w, count, s.loaded, s.load)
        v = c.free[i]
        d = l.scale * vec3(u) + swollen * c.give[i]
        s.x[v, w] = c.rest[v, 0] + d
        largest = wp.max(largest, wp.length_sq(d))
        linear += wp.dot(c.gradient[i], d)
    linear = block_sum(linear)
    volume = real(0.0)
    for f in range(t, c.wet.shape[0], wp.block_dim()):
        face = c.wet[f]
        volume -= wp.dot(s.x[face[0], w], wp.cross(s.x[face[1], w], s.x[face[2], w])) / real(6.0)
    return block_sum(volume) - c.cavity, linear, wp.sqrt(block_max(largest))


@wp.func
def correct(w: int, t: int, nnode: int, pressure: real, modulus: real, c: Constants, s: Scratch):
    """Softening and swelling (`correction.Correction`) of the skin as it is; by which fraction its wall is
    squeezed (`contact.faces.thinned`), and how far its forces are spread [m^2]."""
    own = real(0.0)
    mean = vec3()
    for k in range(t, nnode, wp.block_dim()):
        weight = real(0.0)
        for a in range(3):
            f = s.vector[w, F, 3 * k + a]
            weight += f * f
        own += weight
        mean += weight * c.rest[c.node[s.node[w, k]], 0]
    total = block_sum(own)
    mean = block_sum(mean)
    depth = real(0.0)
    spread = real(0.0)
    squeezed = real(0.0)
    lost = real(0.0)
    if total > real(0.0):
        mean = mean / total
        sums = vec3()
        for k in range(t, nnode, wp.block_dim()):
            weight = real(0.0)
            for a in range(3):
                f = s.vector[w, F, 3 * k + a]
                weight += f * f
            if weight > real(0.0):
                i = c.node[s.node[w, k]]
                j = c.opposite[s.node[w, k]]
                depth = wp.max(depth, wp.length(s.x[i, w] - c.rest[i, 0]))
                across = s.x[i, w] - s.x[j, w]
                rest = c.rest[i, 0] - c.rest[j, 0]
                thin = real(1.0) - wp.length(across) / wp.length(rest)
                sums += weight / total * vec3(wp.length_sq(c.rest[i, 0] - mean), thin, thinned(across, rest))
        sums = block_sum(sums)
        spread = sums[0]
        squeezed = wp.max(sums[1], real(0.0))
        lost = wp.max(sums[2], real(0.0))
        depth = block_max(depth)
    softening = _softening_of(depth, spread, squeezed, c.depth, c.most, c.width, c.squeeze)
    return wp.vec2d(softening, _swelling_of(pressure, modulus, c.stretch)), lost, spread


@wp.func
def _touches(w: int, group: int, geoms: Geoms, touched_by: wp.array2d(dtype=int)):
    """Whether a geom of the group touches: most groups do not."""
    touches = int(0)
    for g in range(geoms.count):
        if geoms.group[g] == group and touched_by[g, w] == 1:
            touches = 1
    return touches


@wp.func
def find_wrenches(
    w: int,
    t: int,
    nface: int,
    nnode: int,
    geoms: Geoms,
    c: Constants,
    s: Scratch,
    touched_by: wp.array2d(dtype=int),
    wrench: wp.array3d(dtype=real),
):
    """Wrenches of the skin ON each group of geoms: those of the samples and, to first order, the change by
    Newton's last step, by their fractions of each node."""
    for g in range(t, geoms.count, wp.block_dim()):
        touched_by[g, w] = 0
    sync()
    nsample = c.sample.shape[0]
    for k in range(t, nface, wp.block_dim()):
        f = s.face[w, k]
        for i in range(wp.where(s.touch.touching[f, w] == 1, nsample, 0)):
            g = s.touch.trial_geom[f * nsample + i, w]
            if g >= 0:
                touched_by[g, w] = 1
    sync()
    for group in range(wrench.shape[0]):
        if _touches(w, group, geoms, touched_by) == 0:
            for a in range(t, 6, wp.block_dim()):
                wrench[group, w, a] = real(0.0)
            continue
        force = vec3()
        torque = vec3()
        for k in range(t, nface, wp.block_dim()):
            f = s.face[w, k]
            if s.touch.touching[f, w] == 1:
                face = c.face[f]
                # what pushes elsewhere than at a sample, at an edge of a geom, has another torque
                other = vec3()
                for a in range(3):
                    other += wp.cross(s.x[face[a], w], s.touch.corner[3 * f + a, w])
                mine = int(-1)
                for i in range(nsample):
                    g = s.touch.trial_geom[f * nsample + i, w]
                    if g >= 0:
                        b = c.sample[i]
                        p = b[0] * s.x[face[0], w] + b[1] * s.x[face[1], w] + b[2] * s.x[face[2], w]
                        moment = wp.cross(p, s.touch.sample_force[f * nsample + i, w])
                        other -= moment
                        mine = geoms.group[g]
                        if mine == group:
                            force += s.touch.sample_force[f * nsample + i, w]
                            torque += moment
                if mine == group:
                    torque += other
        for k in range(t, nnode, wp.block_dim()):
            fraction = fraction_of(w, k, group, geoms, c, s)
            if fraction > real(0.0):
                rest = vec3()
                for a in range(3):
                    rest[a] = s.vector[w, F, 3 * k + a] - s.vector[w, G, 3 * k + a]
                force += fraction * rest
                torque += fraction * wp.cross(s.x[c.node[s.node[w, k]], w], rest)
        force = block_sum(force)
        torque = block_sum(torque)
        if t == 0:
            for a in range(3):
                wrench[group, w, a] = -force[a]
                wrench[group, w, 3 + a] = -torque[a]


@wp.func
def fraction_of(w: int, k: int, group: int, geoms: Geoms, c: Constants, s: Scratch):
    """Fraction of a candidate node that a group of geoms touches."""
    i = c.node[s.node[w, k]]
    nsample = c.sample.shape[0]
    mine = real(0.0)
    whole = real(0.0)
    for m in range(c.start[i], c.start[i + 1]):
        f = c.slot[m] / 3
        if s.touch.touching[f, w] == 1:
            for n in range(nsample):
                g = s.touch.trial_geom[f * nsample + n, w]
                if g >= 0:
                    b = c.sample[n][c.slot[m] % 3]
                    whole += b
                    if geoms.group[g] == group:
                        mine += b
    if whole > real(0.0):
        return mine / whole
    return real(0.0)


@wp.func
def find_tangents(
    w: int,
    t: int,
    nnode: int,
    nin: int,
    l: Linear,
    geoms: Geoms,
    c: Constants,
    s: Scratch,
    touched_by: wp.array2d(dtype=int),
    tangent: wp.array2d(dtype=mat66),
):
    """Stiffness against rigid motions of each group of geoms about the origin, with springs D lumped at the
    nodes: (1 + D W)^-1 D, which is symmetric and positive semi-definite. Springs have no stiffness along
    which their nodes slip, and their inverse would drown W in its rounding."""
    outer, inner = gather_blocks(w, t, nnode, nin, c, s)
    for k in range(t, wp.min(outer, s.touched.shape[1]), wp.block_dim()):
        p = s.node[w, s.touched[w, k]]
        lumped = wp.mat33()
        for e in range(c.ring_start[p + 1] - c.ring_start[p]):
            lumped += s.block[w, k, e]
        s.block[w, k, 0] = lumped
    sync()
    equations = 3 * outer + inner
    wide = equations + 6
    room = wp.where(outer + inner <= s.touched.shape[1] and equations * wide <= s.matrix.shape[1], 1, 0)
    for group in range(tangent.shape[0]):
        most = real(0.0)
        if room == 1 and _touches(w, group, geoms, touched_by) == 1:
            for k in range(t, outer, wp.block_dim()):
                fraction = fraction_of(w, s.touched[w, k], group, geoms, c, s)
                s.vector[w, DU, k] = fraction  # no longer needed
                most = wp.max(most, fraction)
        most = block_max(most)
        solved = int(0)
        if most > real(0.0):
            fill_contact(w, t, outer, inner, wide, nnode, nin, 1.0, 1, l, c, s)
            for k in range(t, outer, wp.block_dim()):
                D = s.vector[w, DU, k] * widen(s.block[w, k, 0])
                turned = -D * wp.skew(s.x[c.node[s.node[w, s.touched[w, k]]], w])
                for a in range(3):
                    begin = (3 * k + a) * wide + equations
                    for b in range(3):
                        s.matrix[w, begin + b] = float(D[a, b])
                        s.matrix[w, begin + 3 + b] = float(turned[a, b])
            for m in range(t, 6 * inner, wp.block_dim()):
                s.matrix[w, (3 * outer + m / 6) * wide + equations + m % 6] = 0.0
            sync()
            solved = eliminate(s.matrix, w, equations, 6)
        if solved == 0:
            if t == 0:
                tangent[group, w] = mat66()
        else:
            for a in range(6):
                left = vec3()
                right = vec3()
                for k in range(t, outer, wp.block_dim()):
                    fraction = s.vector[w, DU, k]
                    at = s.x[c.node[s.node[w, s.touched[w, k]]], w]
                    v = vec3()
                    for b in range(3):
                        v[b] = real(s.matrix[w, (3 * k + b) * wide + equations + a])
                    left += fraction * v
                    right += fraction * wp.cross(at, v)
                left = block_sum(left)
                right = block_sum(right)
                if t == 0:
                    K = tangent[group, w]
                    for b in range(3):
                        K[a, b] = left[b]
                        K[a, 3 + b] = right[b]
                    tangent[group, w] = K
            if t == 0:
                K = tangent[group, w]
                tangent[group, w] = real(0.5) * (K + wp.transpose(K))


@wp.kernel(launch_bounds=(256, 2))
def conclude(
    # In:
    geoms: Geoms,
    c: Constants,
    wanted: wp.array(dtype=int),
    s: Scratch,
    # Out:
    touched_by_out: wp.array2d(dtype=int),
    wrench_out: wp.array3d(dtype=real),
    tangent_out: wp.array2d(dtype=mat66),
):
    """Wrenches and tangents at the end of a world's solve."""
    w, t = wp.tid()
    if wanted[w] == 0:
        return
    o = s.solve.increment[w]
    find_wrenches(w, t, o.nface, o.nnode, geoms, c, s, touched_by_out, wrench_out)
    if tangent_out.shape[0] > 0:
        find_tangents(w, t, o.nnode, o.nin, o.linear, geoms, c, s, touched_by_out, tangent_out)


@wp.kernel
def recall(
    # In:
    law: int,
    c: Constants,
    st: Worlds,
    r: Remembered,
    # Out:
    s: Scratch,
):
    """Nodes under the remembered forces; equal to the last digit to `place_nodes`, by one thread."""
    w = wp.tid()
    count = int(0)
    for i in range(c.node.shape[0]):
        for a in range(3):
            f = r.force[i, w][a]
            if f != real(0.0):
                s.loaded[w, count] = 3 * i + a
                s.load[w, count] = float(f)
                count += 1
    for i in range(c.inner.shape[0]):
        f = r.core_force[i, w]
        if f != real(0.0):
            s.loaded[w, count] = 3 * c.node.shape[0] + i
            s.load[w, count] = float(f)
            count += 1
    modulus = modulus_of(law, st.mu[w], st.lam[w])
    l = Linear()
    l.scale = r.solved[w][0] / modulus
    l.swell = r.solved[w][1] / modulus
    place_nodes(w, 0, count, r.pressure[w], l, c, s)
