"""The real-time tier: a skin that is linear but for its contact, solved over the nodes that touch.

Displacements are u = s C (f + p g): C the inverse of the rest stiffness, f the contact forces of outer nodes (Coulomb friction) and of
inner nodes against the core (normal only), p the liquid's pressure, g the gradient of its volume at rest, s >= 1 the softening below.
The liquid's pressure follows in closed form from p = -K (g.u + q) / V0, with q what the exact volume of the deformed cavity adds to its
linear part. What is left is the contact law f = F(u) over the candidates, tens of coordinates, solved by Newton's method with a search
along the step (a semi-smooth Newton method; the contact law is that of the full skin, `contact.contact_force`).

A linear skin is too stiff at depth: real skin rolls around the indenter. The softening s = 1 + 1 / (h / d + 1 / s_max) of the largest
displacement d of a touching node is that effect fitted to the full FEM (docs/condensed.md).
"""

import math

import numpy as np
import warp as wp
from scipy.linalg.blas import saxpy

from . import contact, liquid
from .condensed_step import Memory, Outcome, Step
from .contact import Geoms
from .core_contact import CoreContact
from .geoms import GeomSet
from .shapes import distance_bound
from .surface_compliance import SurfaceCompliance
from .types import mat33, real, vec3

__all__ = ["CondensedSkin", "Memory", "Outcome"]

wp.set_module_options({"enable_backward": False})

_REGION = 3e-3  # geoms may move this far before the region around them is chosen again [m]


@wp.kernel
def _near(
    # In:
    number: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    reach: wp.array(dtype=real),
    # Out:
    near_out: wp.array(dtype=int),
):
    """Faces with a sample that is nearer to a geom than the reach."""
    i = wp.tid()
    t = face[number[i]]
    x0 = x[t[0], 0]
    x1 = x[t[1], 0]
    x2 = x[t[2], 0]
    center = (x0 + x1 + x2) / real(3.0)
    radius = wp.sqrt(wp.max(wp.length_sq(x0 - center), wp.max(wp.length_sq(x1 - center), wp.length_sq(x2 - center))))
    near = int(0)
    for g in range(geoms.count):
        R = wp.transpose(geoms.mat[g, 0])
        y = R * (center - geoms.pos[g, 0])
        if distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y) < radius + reach[0]:
            for s in range(sample.shape[0]):
                b = sample[s]
                y = R * (b[0] * x0 + b[1] * x1 + b[2] * x2 - geoms.pos[g, 0])
                if distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y) < reach[0]:
                    near = 1
    near_out[i] = near


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


def _key(memory):
    return memory.coordinate.tobytes(), memory.force.tobytes(), memory.pressure, memory.softening


class CondensedSkin:
    """One skin of the condensed tier and the geoms that touch it.

    Args:
      model: SkinModel on the CPU, quasi-static.
      geoms: GeomSet of one world.
      cache: whether to keep the compliance on disk (see `surface_compliance`).

    Raises:
      ValueError: a model on another device, with implicit dynamics, or filled beyond its unstressed volume.
    """

    def __init__(self, model, geoms: GeomSet, cache: bool = True):
        if model.device.is_cuda:
            raise ValueError("the condensed tier runs on the CPU: choose device='cpu', or the full tier on CUDA")
        if model.options.dynamics != "quasistatic":
            raise ValueError("the condensed tier has no inertia: choose dynamics='quasistatic' or the full tier")
        if model.has_liquid and (model.options.fill_volume or model.options.rest_pressure):
            raise ValueError(
                "the condensed tier is linear about the unstressed skin: leave fill_volume and rest_pressure out, or use the full tier"
            )
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
        self._core = CoreContact(model, self._x_wp, self._x) if model.has_core else None
        if self._core and geoms.count:
            depth = wp.zeros((geoms.count, 1), dtype=real, device="cpu")
            self._depth = depth.numpy()
            self._depths = self._record(contact.depth_in_core, (geoms.count, 1), [model.core_vert, geoms.struct], [depth])
        self._inner = self._core.node if self._core else np.zeros(0, int)
        self._away = self._core.direction if self._core else np.zeros((0, 3))
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
            near, self._near = zeros(len(self._face), int)
            number, self._asked = zeros(len(self._face), int)
            self._reach_wp, self._reach = zeros(1, real)
            self._x[:, 0] = self._last[:, 0] = self._rest
            self._detect = self._record(
                _near, len(self._face), [number, m.outer.face, m.sample, self.geoms.struct, self._x_wp, self._reach_wp], [near]
            )
            self._region = None
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
        self._liquid_give = float(self._gradient[m.free].ravel() @ self._give)
        give = np.zeros((m.nvert, 3))
        give[m.free] = self._give.reshape(-1, 3)
        self._give_at = np.concatenate([give[self._outer].ravel(), np.einsum("ij,ij->i", give[self._inner], self._away)])

    def _measure_volume(self):
        if self.model.inner is not None:
            self._volume.launch()

    # --- a step ------------------------------------------------------------------------------------------------------------------

    def solve(self, memory: Memory, geom_pos, geom_mat) -> Outcome:
        """Solves for poses (ngeom, 3) [m], (ngeom, 3, 3) at the end of the step; a function of its arguments alone.

        Raises:
          ValueError: NaN in a pose, or a geom deep inside the core.
        """
        if not (math.isfinite(np.sum(geom_pos)) and math.isfinite(np.sum(geom_mat))):
            raise ValueError("geom poses contain NaN or infinite numbers: the simulation has diverged or a pose was never set")
        struct = self.geoms.struct
        last = (memory.geom_pos, memory.geom_mat) if memory.started else (geom_pos, geom_mat)
        if self.geoms.count:
            struct.pos.numpy()[:, 0], struct.mat.numpy()[:, 0] = geom_pos, geom_mat
            struct.pos_last.numpy()[:, 0], struct.mat_last.numpy()[:, 0] = last
        if not len(memory.force):  # at rest: what no sample touches changes nothing
            self._x[:, 0] = self._rest
            if not len(self._faces_near(0.0, geom_pos, geom_mat, 0.0)):
                return self._at_rest(geom_pos, geom_mat, geom_pos - last[0])
        self._refuse_core()
        u = self.displacement(memory)
        self._last[:, 0] = self._x[:, 0] = self._rest + u
        step = Step(self, memory, u, geom_pos, geom_mat, geom_pos - last[0])
        for _ in range(4):
            step.run()
            if not step.missed():
                break
        out = step.outcome()
        self._keep(out.memory, step.u)
        return out

    def _at_rest(self, pos, mat, motion):
        memory = Memory.rest(self.geoms.count)
        memory.started, memory.geom_pos, memory.geom_mat, memory.motion = True, np.array(pos), np.array(mat), motion
        n = self.geoms.ngroup
        return Outcome(memory, np.zeros((n, 6)), np.zeros((n, 6, 6)), self._rest.copy(), self.model.liquid_volume, True, 0, 0.0)

    def _refuse_core(self):
        limit = self.model.options.max_core_depth
        if self._core is None or not self.geoms.count:
            return
        self._depths.launch()
        if self._depth.max() > limit:
            g = int(self._depth.argmax())
            raise ValueError(
                f"geom {g} ({self.geoms.types[g]}) is {self._depth.max() * 1e3:.2f} mm inside the rigid core: no skin fits between them; "
                "move it out, press less deep or take smaller steps"
            )

    def _faces_near(self, reach, pos, mat, moved):
        """Faces with a sample nearer to a geom than the reach; `moved` bounds how far the nodes are from rest.

        Only a region around the geoms is searched, wider than what they and the skin can have moved since it was chosen.
        """
        if not self.geoms.count:
            return np.zeros(0, int)
        slack = moved + reach
        if self._region is not None:
            _, pos0, mat0, width = self._region
            turned = np.sqrt(((mat - mat0) ** 2).sum((1, 2))) * (np.sqrt((pos0 * pos0).sum(1)) + 0.05)
            slack += (turned + np.sqrt(((pos - pos0) ** 2).sum(1))).max()
        if self._region is None or slack > width:
            self._asked[:] = np.arange(len(self._face))
            here = self._x.copy()
            self._x[:, 0] = self._rest
            width = moved + reach + _REGION
            self._look(len(self._face), width)
            self._x[:] = here
            self._region = np.flatnonzero(self._near), np.array(pos), np.array(mat), width
        faces = self._region[0]
        if not len(faces):
            return faces
        self._asked[: len(faces)] = faces
        self._look(len(faces), reach)
        return faces[self._near[: len(faces)] == 1]

    def _look(self, count, reach):
        self._reach[0] = reach
        self._detect.set_dim(count)
        self._detect.launch()

    def displacement(self, memory: Memory) -> np.ndarray:
        """(nvert, 3) of a memory [m]."""
        key = _key(memory)
        if key not in self._fields:
            self._keep(memory, self._recover(memory.coordinate, memory.force, memory.pressure, memory.softening))
        return self._fields[key]

    def _keep(self, memory, u):
        if len(self._fields) > 4:
            self._fields.clear()
        self._fields[_key(memory)] = u

    def _recover(self, coordinate, force, pressure, softening):
        u = pressure * self._give
        if len(coordinate):
            sums = np.zeros(self.compliance.size, np.float32)
            for row, f in zip(self.compliance.row(coordinate.tolist()), force.tolist()):
                saxpy(row, sums, a=f)
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
            part = self.compliance.part(c, at)
            m = 3 * len(outer)
            W = np.empty((len(c), len(c)))
            W[:, :m] = part[:, :m]
            W[:, m:] = (part[:, m:].reshape(len(c), -1, 3) * self._away[inner]).sum(2)
            self._systems[key] = c, (W + W.T) / 2
        return self._systems[key]
