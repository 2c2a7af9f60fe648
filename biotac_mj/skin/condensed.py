"""The real-time tier: a skin that is linear but for its contact, solved over the nodes that touch.

Displacements are u = s C (f + p g): C the inverse of the rest stiffness, f the contact forces of outer nodes (Coulomb friction) and of
inner nodes against the core (normal only), p the liquid's pressure, g the gradient of its volume at rest, s >= 1 the softening below.
The liquid's pressure follows in closed form from p = -K (g.u + q) / V0, with q what the exact volume of the deformed cavity adds to its
linear part. What is left is the contact law f = F(u) over the candidates, tens of coordinates, solved by Newton's method with a search
along the step (a semi-smooth Newton method; the contact law is that of the full skin, `contact.contact_force`).

A linear skin is too stiff at depth: real skin rolls around the indenter. The softening s = 1 + 1 / (h / d + 1 / s_max) of the largest
displacement d of a touching node is that effect fitted to the full FEM (docs/condensed.md).
"""

import dataclasses

import numpy as np
import warp as wp
from scipy.linalg import lapack

from . import contact, liquid
from .contact import Geoms
from .geoms import GeomSet
from .shapes import distance_bound
from .surface_compliance import SurfaceCompliance
from .types import mat33, real, vec3

__all__ = ["CondensedSkin", "Memory"]

wp.set_module_options({"enable_backward": False})

_SOFTENING = (6.5e-3, 0.30)  # h [m], s_max: fitted to the full FEM
_REACH = 2e-5  # faces and inner nodes nearer than this, plus what the geoms move in the step, are candidates [m]
_TOLERANCE = 1e-3  # of the residual in the energy norm, as in the full FEM
_MAX_NEWTON = 30
_VOLUME = 3e-3  # change of pressure, relative, below which the nonlinear part of the volume has settled


@wp.kernel
def _near(
    # In:
    face: wp.array(dtype=wp.vec3i),
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    reach: wp.array(dtype=real),
    # Out:
    near_out: wp.array(dtype=int),
):
    """Faces that a geom may touch."""
    f = wp.tid()
    t = face[f]
    x0 = x[t[0], 0]
    x1 = x[t[1], 0]
    x2 = x[t[2], 0]
    center = (x0 + x1 + x2) / real(3.0)
    radius = wp.sqrt(wp.max(wp.length_sq(x0 - center), wp.max(wp.length_sq(x1 - center), wp.length_sq(x2 - center))))
    near = int(0)
    for g in range(geoms.count):
        y = wp.transpose(geoms.mat[g, 0]) * (center - geoms.pos[g, 0])
        if distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y) < radius + reach[0]:
            near = 1
    near_out[f] = near


@wp.kernel
def _core_distance(
    # In:
    node: wp.array(dtype=int),
    core: Geoms,
    x: wp.array2d(dtype=vec3),
    # Out:
    distance_out: wp.array(dtype=real),
):
    """Distance of nodes to the core, trilinear in its grid."""
    i = wp.tid()
    half = real(0.5) * core.grids.spacing[core.grid[0]]
    distance_out[i] = distance_bound(core.kind[0], core.size[0], core.rounding[0], core.grids, core.grid[0], x[node[i], 0]) + half


@wp.kernel
def _assemble(
    # In:
    count: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    slot: wp.array(dtype=int),
    touching: wp.array2d(dtype=int),
    corner: wp.array2d(dtype=vec3),
    block: wp.array2d(dtype=mat33),
    # Out:
    force_out: wp.array(dtype=real),
    stiffness_out: wp.array(dtype=real),
):
    """Nodal forces and stiffness (count[1], count[1]) of the first count[0] faces; one thread, so that the order of sums is fixed."""
    n = count[1]
    for i in range(n):
        force_out[i] = real(0.0)
    for i in range(n * n):
        stiffness_out[i] = real(0.0)
    for f in range(count[0]):
        if touching[f, 0] == 1:
            t = face[f]
            for a in range(3):
                i = 3 * slot[t[a]]
                if i >= 0:
                    for k in range(3):
                        force_out[i + k] += corner[3 * f + a, 0][k]
                    for b in range(3):
                        j = 3 * slot[t[b]]
                        if j >= 0:
                            low = wp.min(a, b)
                            K = block[6 * f + low * (5 - low) // 2 + wp.max(a, b), 0]
                            for k in range(3):
                                for l in range(3):
                                    stiffness_out[(i + k) * n + j + l] += K[k, l]


@dataclasses.dataclass
class Memory:
    """What the skin remembers between steps.

    Attributes:
      started: whether a step was made.
      coordinate: (n,) contact coordinates with a force, ascending.
      force: (n,) [N].
      pressure: [Pa]. bulge: the nonlinear part q of the cavity's volume [m^3]. softening: s.
      geom_pos, geom_mat: (ngeom, 3) [m], (ngeom, 3, 3) at the end of the last step.
      contacts: (k, 5) sample, geom and anchor (in the geom's frame) [m] of what touches.
    """

    started: bool
    coordinate: np.ndarray
    force: np.ndarray
    pressure: float
    bulge: float
    softening: float
    geom_pos: np.ndarray
    geom_mat: np.ndarray
    contacts: np.ndarray

    @classmethod
    def rest(cls, ngeom):
        none = np.zeros(0)
        return cls(False, none.astype(int), none, 0.0, 0.0, 1.0, np.zeros((ngeom, 3)), np.zeros((ngeom, 3, 3)), np.zeros((0, 5)))


@dataclasses.dataclass
class Outcome:
    """A solved step: what to remember, wrench (ngroup, 6) of the skin on the geoms, their tangent (ngroup, 6, 6), nodes (nvert, 3)."""

    memory: Memory
    wrench: np.ndarray
    tangent: np.ndarray
    vert_xpos: np.ndarray
    volume: float
    converged: bool
    iterations: int
    error: float


class CondensedSkin:
    """One skin of the condensed tier and the geoms that touch it.

    Args:
      model: SkinModel on the CPU, quasi-static.
      geoms: GeomSet of one world.
      cache: whether to keep the compliance on disk (see `surface_compliance`).

    Raises:
      ValueError: a model on another device or with implicit dynamics.
    """

    def __init__(self, model, geoms: GeomSet, cache: bool = True):
        if model.device.is_cuda:
            raise ValueError("the condensed tier runs on the CPU: choose device='cpu', or the full tier on CUDA")
        if model.options.dynamics != "quasistatic":
            raise ValueError("the condensed tier has no inertia: choose dynamics='quasistatic' or the full tier")
        self.model, self.geoms = model, geoms
        g = model.geometry
        free = np.zeros(model.nvert, bool)
        free[model.free] = True
        self._face = g.outer_face.astype(np.int32)
        self._area = model.outer.area.numpy()
        self._outer = np.unique(g.outer_face)
        self._outer = self._outer[free[self._outer]]
        self._number = np.full(model.nvert, -1)
        self._number[self._outer] = np.arange(len(self._outer))
        self._rest = g.vert.astype(float)
        self._sample = contact.face_samples(model.options.samples)
        self._allocate(64, 300)
        self._prepare_core(free)
        self.compliance = SurfaceCompliance(model, self._outer, self._inner, self._away, cache)
        self._prepare_liquid()
        self._systems, self._fields = {}, {}

    # --- preparation -------------------------------------------------------------------------------------------------------------

    def _allocate(self, nface, ndof):
        """Buffers for nface candidate faces and ndof contact coordinates of outer nodes, and the kernels' launches on them."""
        m, nsample = self.model, len(self.model.sample)
        self._capacity = nface, ndof

        def zeros(shape, dtype):
            array = wp.zeros(shape, dtype=dtype, device="cpu")
            return array, array.numpy()

        if not hasattr(self, "_x"):
            self._x_wp, self._x = zeros((m.nvert, 1), vec3)
            self._last_wp, self._last = zeros((m.nvert, 1), vec3)
            self._slot_wp, self._slot = zeros(m.nvert, int)
            self._near_wp, self._near = zeros(len(self._face), int)
            self._reach_wp, self._reach = zeros(1, real)
            self._x[:, 0] = self._last[:, 0] = self._rest
            self._detect = self._record(
                _near, len(self._face), [m.outer.face, self.geoms.struct, self._x_wp, self._reach_wp], [self._near_wp]
            )
        self._count_wp, self._count = zeros(2, int)
        face, self._cface = zeros(nface, wp.vec3i)
        area, self._carea = zeros(nface, real)
        anchor_geom, self._anchor_geom = zeros((nface * nsample, 1), int)
        anchor, self._anchor = zeros((nface * nsample, 1), vec3)
        corner = zeros((3 * nface, 1), vec3)[0]
        block = zeros((6 * nface, 1), mat33)[0]
        touching, self._touching = zeros((nface, 1), int)
        geom, self._geom = zeros((nface * nsample, 1), int)
        trial, self._trial = zeros((nface * nsample, 1), vec3)
        force, self._force = zeros((nface * nsample, 1), vec3)
        nodal, self._nodal = zeros(ndof, real)
        stiffness, self._stiffness = zeros(ndof * ndof, real)
        o = m.options
        self._contact = self._record(
            contact.contact_force, (nface, 1),
            [face, area, m.sample, m.contact_stiffness, o.stick_ratio, self.geoms.struct, self._x_wp, self._last_wp, anchor_geom, anchor],
            [corner, block, touching, geom, trial, force],
        )  # fmt: skip
        self._gather = self._record(_assemble, 1, [self._count_wp, face, self._slot_wp, touching, corner, block], [nodal, stiffness])

    def _record(self, kernel, dim, inputs, outputs):
        return wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device="cpu", record_cmd=True)

    def _prepare_core(self, free):
        m = self.model
        if not m.has_core:
            self._inner, self._away = np.zeros(0, int), np.zeros((0, 3))
            return
        face = m.core_surface.face_np
        share = np.zeros(m.nvert)
        np.add.at(share, face, m.core_surface.area.numpy()[:, None] / 3)
        self._inner = np.unique(face)
        self._inner = self._inner[free[self._inner]]
        self._core_stiffness = m.contact_stiffness * share[self._inner]
        node = wp.array(self._inner, dtype=int, device="cpu")
        distance = wp.zeros(len(self._inner), dtype=real, device="cpu")
        self._core_distance = distance.numpy()
        self._measure = self._record(_core_distance, len(self._inner), [node, m.core(1).struct, self._x_wp], [distance])
        gradient = np.zeros((len(self._inner), 3))
        for axis in range(3):
            for sign in (1, -1):
                self._x[self._inner, 0, axis] = self._rest[self._inner, axis] + sign * 2e-4
                self._measure.launch()
                gradient[:, axis] += sign * self._core_distance
            self._x[:, 0] = self._rest
        self._away = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        self._measure.launch()
        # the grid rounds edges of the core by micrometres: what starts outside stays outside
        self._core_offset = np.minimum(self._core_distance, 0)

    def _prepare_liquid(self):
        m = self.model
        self._gradient = np.zeros((m.nvert, 3))
        self._give = np.zeros(self.compliance.size)
        if m.inner is None:
            self._linear_volume = 0.0
            return
        share = wp.zeros((len(m.inner.face), 1), dtype=real, device="cpu")
        self._share = share.numpy()
        self._volume = self._record(liquid.cavity_volume, share.shape, [m.inner.face, self._x_wp], [share])
        if not m.has_liquid:
            return
        corner = wp.zeros((3 * len(m.inner.face), 1), dtype=vec3, device="cpu")
        wp.launch(liquid.volume_gradient, dim=share.shape, inputs=[m.inner.face, self._x_wp], outputs=[corner], device="cpu")
        np.add.at(self._gradient, m.inner.face.numpy().ravel(), corner.numpy()[:, 0])
        self._gradient[m.fixed] = 0
        self._give = self.compliance.vector(self._gradient)
        self._gradient = self._gradient[m.free].ravel()
        self._liquid_give = float(self._gradient @ self._give)
        give = np.zeros((m.nvert, 3))
        give[m.free] = self._give.reshape(-1, 3)
        self._give_at = np.concatenate([give[self._outer].ravel(), np.einsum("ij,ij->i", give[self._inner], self._away)])

    def _measure_volume(self):
        if self.model.inner is not None:
            self._volume.launch()

    # --- a step ------------------------------------------------------------------------------------------------------------------

    def solve(self, memory: Memory, geom_pos, geom_mat) -> Outcome:
        """Solves for poses (ngeom, 3) [m], (ngeom, 3, 3) at the end of the step; a function of its arguments alone."""
        struct = self.geoms.struct
        last = (memory.geom_pos, memory.geom_mat) if memory.started else (geom_pos, geom_mat)
        if self.geoms.count:
            struct.pos.numpy()[:, 0], struct.mat.numpy()[:, 0] = geom_pos, geom_mat
            struct.pos_last.numpy()[:, 0], struct.mat_last.numpy()[:, 0] = last
        u = self.displacement(memory)
        self._last[:, 0] = self._x[:, 0] = self._rest + u
        moved = np.abs(geom_pos - last[0]).max(initial=0.0)
        step = _Step(self, memory, u, geom_pos, geom_mat, _REACH + 2 * moved)
        for _ in range(4):
            step.run()
            if not step.missed():
                break
        return step.outcome()

    def displacement(self, memory: Memory) -> np.ndarray:
        """(nvert, 3) of a memory [m]."""
        key = (memory.coordinate.tobytes(), memory.force.tobytes(), memory.pressure, memory.softening)
        if key not in self._fields:
            if len(self._fields) > 4:
                self._fields.clear()
            self._fields[key] = self._recover(memory.coordinate, memory.force, memory.pressure, memory.softening)
        return self._fields[key]

    def _recover(self, coordinate, force, pressure, softening):
        u = pressure * self._give
        if len(coordinate):
            sums = np.zeros(self.compliance.size, np.float32)
            for row, f in zip(self.compliance.row(coordinate.tolist()), force.astype(np.float32)):
                sums += f * row
            u += sums
        out = np.zeros((self.model.nvert, 3))
        out[self.model.free] = (softening / self.model.material.youngs_modulus * u).reshape(-1, 3)
        return out

    def _system(self, outer, inner):
        """Coordinates and compliance (n, n) over candidate outer nodes and inner nodes (numbers in self._inner), times E."""
        key = (outer.tobytes(), inner.tobytes())
        if key not in self._systems:
            if len(self._systems) > 64:
                self._systems.clear()
            c = np.concatenate([(3 * self._number[outer][:, None] + np.arange(3)).ravel(), 3 * len(self._outer) + inner])
            node = self.compliance.position(np.concatenate([outer, self._inner[inner]]))
            at = (3 * node[:, None] + np.arange(3)).ravel()
            part = np.array([row[at] for row in self.compliance.row(c.tolist())]).reshape(len(c), len(at))
            m = 3 * len(outer)
            W = np.empty((len(c), len(c)))
            W[:, :m] = part[:, :m]
            W[:, m:] = (part[:, m:].reshape(len(c), -1, 3) * self._away[inner]).sum(2)
            self._systems[key] = c, (W + W.T) / 2
        return self._systems[key]


class _Step:
    """One step of a CondensedSkin: candidates, Newton's method, results."""

    def __init__(self, skin, memory, u, geom_pos, geom_mat, reach):
        self.skin, self.memory, self.u, self.reach = skin, memory, u, reach
        self.pose = geom_pos, geom_mat
        self.faces = np.zeros(0, int)
        self.inner = np.zeros(0, int)
        self.softening, self.bulge = memory.softening, memory.bulge
        self.coordinate, self.force = memory.coordinate, memory.force
        self.iterations, self.error, self.converged = 0, 0.0, True
        self._measure_core()
        self._choose()

    def _measure_core(self):
        """Gap of the inner nodes at the present positions, and the displacement there that it belongs to."""
        s = self.skin
        if len(s._inner):
            s._measure.launch()
            self.gap = s._core_distance - s._core_offset
            self.at = np.einsum("ij,ij->i", self.u[s._inner], s._away)

    def _choose(self):
        """Candidates: faces and inner nodes that are near, and all that carry force."""
        s = self.skin
        near = np.zeros(0, int)
        if s.geoms.count:
            s._reach[0] = self.reach
            s._detect.launch()
            near = np.flatnonzero(s._near)
        faces = np.union1d(self.faces, near) if len(self.faces) else near
        inner = self.inner
        if len(s._inner):
            held = self.coordinate[self.coordinate >= 3 * len(s._outer)] - 3 * len(s._outer)
            inner = np.union1d(np.union1d(inner, held), np.flatnonzero(self.gap < self.reach))
        more = len(faces) > len(self.faces) or len(inner) > len(self.inner)
        self.faces, self.inner = faces, inner.astype(int)
        return more

    def missed(self):
        """Whether something touches that was no candidate; it is one now."""
        s = self.skin
        self.reach = 0.0
        self._measure_core()
        return self._choose()

    def _set(self):
        """Hands the candidate faces and their anchors to the kernels."""
        s, nsample = self.skin, len(self.skin.model.sample)
        n = len(self.faces)
        nodes = np.unique(s._face[self.faces])
        self.outer = nodes[s._number[nodes] >= 0]
        self.m = 3 * len(self.outer)
        nface, ndof = s._capacity
        if n > nface or self.m > ndof:
            s._allocate(max(nface, 2 * n), max(ndof, 2 * self.m))
        s._cface[:n], s._carea[:n] = s._face[self.faces], s._area[self.faces]
        s._count[:] = n, self.m
        s._slot[nodes] = -1
        s._slot[self.outer] = np.arange(len(self.outer))
        s._contact.set_dim((n, 1))
        self.nsample = n * nsample
        s._anchor_geom[: self.nsample] = -1
        contacts = self.memory.contacts
        if len(contacts):
            sample = contacts[:, 0].astype(int)
            place = np.searchsorted(self.faces, sample // nsample)
            known = place < n
            known[known] = self.faces[place[known]] == sample[known] // nsample
            here = place[known] * nsample + sample[known] % nsample
            s._anchor_geom[here, 0], s._anchor[here, 0] = contacts[known, 1], contacts[known, 2:]
        self.c, self.W = s._system(self.outer, self.inner)
        self.a = s._give_at[self.c] if s.model.has_liquid else None
        if len(self.inner):
            self.k, self.g0, self.u0 = s._core_stiffness[self.inner], self.gap[self.inner], self.at[self.inner]

    def _scaled(self, softening):
        """Compliance with the liquid and the displacement q alone makes, at a softening: u = W f + shift; p = -share (a.f c + q)."""
        s = self.skin
        scale = softening / s.model.material.youngs_modulus
        if self.a is None:
            return scale * self.W, 0.0
        m = s.model
        share = 1 / (m.liquid_volume / m.options.bulk_modulus + scale * s._liquid_give)
        a = scale * self.a
        self.share, self.along = share, a
        return scale * self.W - share * np.outer(a, a), -share * self.bulge * a

    def _evaluate(self, u):
        """Contact forces at displacements u (n,) of the contact coordinates and their stiffness blocks."""
        s, m = self.skin, self.m
        f = np.zeros(len(u))
        if m:
            s._x[self.outer, 0] = s._rest[self.outer] + u[:m].reshape(-1, 3)
            s._contact.launch()
            s._gather.launch()
            f[:m] = s._nodal[:m]
        if len(self.inner):
            gap = self.g0 + u[m:] - self.u0
            self.closed = gap < 0
            f[m:] = -self.k * gap * self.closed
        return f

    def _soften(self, u, f):
        touched = f[: self.m].reshape(-1, 3)
        loaded = (touched * touched).sum(1) > 0
        if not loaded.any():
            return 1.0
        v = u[: self.m].reshape(-1, 3)[loaded]
        depth = np.sqrt((v * v).sum(1).max())
        h, most = _SOFTENING
        return 1 + depth * most / (depth + h * most)

    def run(self):
        """Newton's method, repeated until the cavity's exact volume agrees."""
        if not len(self.faces) and not len(self.force):
            self.outer, self.nsample, self.pressure = self.faces, 0, 0.0
            return
        self._set()
        s = self.skin
        f = np.zeros(len(self.c))
        place = np.searchsorted(self.coordinate, self.c)
        known = place < len(self.coordinate)
        known[known] = self.coordinate[place[known]] == self.c[known]
        f[known] = self.force[place[known]]
        for _ in range(3):
            f = self._newton(f)
            order = np.argsort(self.c)
            order = order[f[order] != 0]
            self.coordinate, self.force = self.c[order], f[order]
            self.pressure = -self.share * float(self.along @ f + self.bulge) if self.a is not None else 0.0
            self._place(s._recover(self.coordinate, self.force, self.pressure, self.softening))
            s._measure_volume()
            if self.a is None:
                break
            bulge = float(s._share.sum()) - s.model.rest_volume - float(s._gradient @ self.u[s.model.free].ravel())
            change, self.bulge = self.share * abs(bulge - self.bulge), bulge
            if change < _VOLUME * abs(self.pressure) + 1.0:
                break

    def _place(self, u):
        s = self.skin
        self.u = u
        s._x[:, 0] = s._rest + u

    def _newton(self, f):
        W, shift = self._scaled(self.softening)
        u = W @ f + shift
        g = self._evaluate(u)
        self.converged = False
        for _ in range(_MAX_NEWTON):
            softening = self._soften(u, g)
            if abs(softening - self.softening) > 1e-5:
                self.softening = softening
                W, shift = self._scaled(softening)
                u = W @ f + shift
                g = self._evaluate(u)
            r = g - f
            Wr = W @ r
            self.error = np.sqrt(max(r @ Wr, 0.0) / (max(g @ (W @ g), 0.0) + 1e-14))
            if self.error < _TOLERANCE:
                self.converged = True
                return g
            self.iterations += 1
            D, on = self._springs()
            off = np.setdiff1d(np.arange(len(f)), on, assume_unique=True)
            df = r.copy()
            Won = W[on]
            matrix = D @ Won[:, on]
            matrix[range(len(on)), range(len(on))] += 1
            df[on] = lapack.dgesv(matrix, r[on] - D @ (Won[:, off] @ r[off]), overwrite_a=1)[2]
            du = W @ df
            f, u, g = self._search(f, u, df, du, float(r @ du))
        return g

    def _springs(self):
        """Stiffness of the closed contacts, and the contact coordinates that it couples."""
        s, m = self.skin, self.m
        K = s._stiffness[: m * m].reshape(m, m)
        sliding = np.flatnonzero(K.diagonal())
        closed = np.flatnonzero(self.closed) if len(self.inner) else self.inner
        n, k = len(sliding), len(closed)
        D = np.zeros((n + k, n + k))
        D[:n, :n] = K[np.ix_(sliding, sliding)]
        if k:
            D[range(n, n + k), range(n, n + k)] = self.k[closed]
        return D, np.concatenate([sliding, m + closed])

    def _search(self, f, u, df, du, slope):
        """Along the step to where the residual's work is at most half of what it was (Illinois' regula falsi where the step overshoots)."""
        low, high, at_low, at_high = 0.0, None, slope, None
        alpha = 1.0
        for _ in range(10):
            new_f, new_u = f + alpha * df, u + alpha * du
            g = self._evaluate(new_u)
            now = float((g - new_f) @ du)
            if abs(now) <= 0.5 * abs(slope):
                break
            if now > 0:
                if high is None:
                    break
                low, at_low, at_high = alpha, now, at_high / 2
            else:
                high, at_high, at_low = alpha, now, at_low if high is None else at_low / 2
            alpha = low + (high - low) * at_low / (at_low - at_high)
            alpha = min(max(alpha, low + 0.05 * (high - low)), high - 0.05 * (high - low))
        return new_f, new_u, g

    # --- results -----------------------------------------------------------------------------------------------------------------

    def outcome(self) -> Outcome:
        s = self.skin
        wrench, contacts = np.zeros((s.geoms.ngroup, 6)), np.zeros((0, 5))
        tangent = np.zeros((s.geoms.ngroup, 6, 6))
        nsample = len(s._sample)
        geom = s._geom[: self.nsample, 0]
        here = np.flatnonzero(geom >= 0)
        if len(here):
            face = self.faces[here // nsample]
            contacts = np.column_stack([face * nsample + here % nsample, geom[here], s._trial[here, 0]])
            point = np.einsum("kc,kci->ki", s._sample[here % nsample], s._x[s._face[face], 0])
            force = s._force[here, 0]
            load = np.concatenate([force, np.cross(point, force)], axis=1)
            group = s.geoms.groups[geom[here]]
            for k in np.unique(group):
                wrench[k] = -load[group == k].sum(0)
                tangent[k] = self._tangent(k)
        pos, mat = self.pose
        now = (self.coordinate, self.force, self.pressure, self.bulge, self.softening, np.array(pos), np.array(mat), contacts)
        memory = Memory(True, *now)
        volume = float(s._share.sum()) - s.model.rest_volume + s.model.liquid_volume if s.model.inner is not None else 0.0
        return Outcome(memory, wrench, tangent, s._rest + self.u, volume, self.converged, self.iterations, self.error)

    def _tangent(self, group):
        """Stiffness against rigid motions of a group of geoms about the origin, G' (D_g - D_g W (I + D W)^-1 D_g) G, symmetric."""
        s, m = self.skin, self.m
        D, on = self._springs()
        outer = on[on < m]
        n = len(outer)
        mine = D[:n, :n]
        if s.geoms.ngroup > 1:
            nface = len(self.faces)
            touching = s._touching[:nface, 0].copy()
            geom = s._geom[: self.nsample, 0].reshape(nface, -1).max(1)
            s._touching[:nface, 0] = touching * ((geom >= 0) & (s.geoms.groups[geom] == group))
            s._gather.launch()
            mine = s._stiffness[: m * m].reshape(m, m)[np.ix_(outer, outer)]
            s._touching[:nface, 0] = touching
            s._gather.launch()
        x = s._x[self.outer, 0]
        rigid = np.zeros((len(x), 3, 6))
        rigid[:, :, :3] = np.eye(3)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            rigid[:, i, 3 + j], rigid[:, i, 3 + k] = x[:, k], -x[:, j]
        rigid = rigid.reshape(m, 6)[outer]
        pull = np.zeros((len(on), 6))
        pull[:n] = mine @ rigid
        W = self._scaled(self.softening)[0][np.ix_(on, on)]
        give = W @ np.linalg.solve(np.eye(len(on)) + D @ W, pull)
        stiffness = rigid.T @ pull[:n] - pull.T @ give
        values, vectors = np.linalg.eigh((stiffness + stiffness.T) / 2)
        return (vectors * np.maximum(values, 0)) @ vectors.T
