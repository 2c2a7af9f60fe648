"""The real-time tier: a skin that is linear but for its contact, solved over the nodes that touch.

Displacements are u = C (s f + c p g): C the inverse of the stiffness at rest, f the contact forces of outer
nodes (Coulomb friction) and of inner nodes against the core (normal only), p the liquid's pressure above that
at rest, g the gradient of its volume at rest, s >= 1 and c <= 1 corrections. The liquid's pressure follows in
closed form from p = -K (g.u + q) / V0, with q what the exact volume of the deformed cavity adds to its linear
part. What is left is the contact law f = F(u) over the candidates, tens of coordinates, solved by Newton's
method with a search along the step (a semi-smooth Newton method; the contact law is that of the full skin,
`contact.touch_face`).

What skin does differently from a linear one, s and c, is fitted to the full FEM (`correction`).
"""

import dataclasses
import math
import typing
import weakref

import numpy as np
import warp as wp
from scipy.linalg.blas import saxpy
from scipy.spatial import cKDTree

from ...launches import recorded
from ...threads import single_thread
from .. import liquid
from ..geoms import GeomSet
from ..types import real, vec3
from .compliance import SurfaceCompliance
from .core_contact import CoreContact
from .correction import correction
from .faces import CandidateFaces
from .follow import follow
from .refusals import refuse
from .search import NearSearch, poses
from .step import Effort, Memory, Outcome, Step

if typing.TYPE_CHECKING:
    from ..model import SkinModel

__all__ = ["CondensedSkin", "Memory", "Outcome"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _strain(
    # In:
    count: wp.array(dtype=int),
    number: wp.array(dtype=int),
    force: wp.array(dtype=real),
    outer: wp.array(dtype=int),
    opposite: wp.array(dtype=int),
    rest: wp.array2d(dtype=vec3),
    x: wp.array2d(dtype=vec3),
    # Out:
    strain_out: wp.array(dtype=real),
):
    """Largest displacement of the count[0] numbered outer nodes, mean square spread of their forces, share by
    which the wall is thinned.

    Means are weighted with the squares of the forces, so that a node that begins to touch changes nothing at
    once."""
    total = real(0.0)
    mean = vec3()
    for k in range(count[0]):
        w = force[k] * force[k]
        total += w
        mean += w * rest[outer[number[k]], 0]
    mean = mean / total
    depth = real(0.0)
    spread = real(0.0)
    thinned = real(0.0)
    for k in range(count[0]):
        w = force[k] * force[k] / total
        i = outer[number[k]]
        j = opposite[number[k]]
        depth = wp.max(depth, wp.length(x[i, 0] - rest[i, 0]))
        spread += w * wp.length_sq(rest[i, 0] - mean)
        thinned += w * (real(1.0) - wp.length(x[i, 0] - x[j, 0]) / wp.length(rest[i, 0] - rest[j, 0]))
    strain_out[0] = depth
    strain_out[1] = spread
    strain_out[2] = wp.max(thinned, real(0.0))


_compliances = weakref.WeakKeyDictionary()


def _compliance(model, outer, inner, direction, cache):
    """The rows of a model, shared by all its skins and kept by them: they hold the model, so it must not hold
    them."""
    mine = _compliances.setdefault(model, weakref.WeakValueDictionary())
    made = mine.get(cache)
    if made is None:
        made = mine[cache] = SurfaceCompliance(model, outer, inner, direction, cache)
    return made


def _key(memory):
    return (
        memory.coordinate.tobytes(),
        memory.force.tobytes(),
        memory.pressure,
        memory.softening,
        memory.swelling,
    )


class CondensedSkin:
    """One skin of the condensed tier and the geoms that touch it.

    Args:
      model: SkinModel on the CPU, quasi-static.
      geoms: GeomSet of one world.
      cache: whether to keep the compliance on disk (see `compliance`).
      patience: share of the effort that a hard step may cost before it ends short of its poses.

    Raises:
      ValueError: what the tier cannot do, see `refusals`.
    """

    def __init__(self, model: "SkinModel", geoms: GeomSet, cache: bool = True, patience: float = 2.5):
        refuse(model.material.extensions, model.options, model.has_liquid, model.device.is_cuda)
        self.model, self.geoms, self.patience = model, geoms, patience
        self.correction = correction(model.material.law)
        g = model.geometry
        free = np.zeros(model.nvert, bool)
        free[model.free] = True
        self._face = g.outer_face.astype(np.int32)
        self._area = model.outer.area.numpy()
        self._outer = np.unique(g.outer_face)
        self._outer = self._outer[free[self._outer]]
        self.nouter = len(self._outer)
        self._number = np.full(model.nvert, -1)
        self._number[self._outer] = np.arange(len(self._outer))
        self.rest = model.rest.vert.astype(float)
        self._prepare_positions()
        self.faces = CandidateFaces(model, geoms, self._x_wp, self._last_wp, self._slot_wp)
        self._core = CoreContact(model, self.rest, self._x_wp, self._x) if model.has_core else None
        self._poses = poses(geoms)
        self.search = NearSearch(model, geoms, self.rest, self._x_wp, self._x)
        self._inner = self._core.node if self._core else np.zeros(0, int)
        self._away = self._core.direction if self._core else np.zeros((0, 3))
        self.compliance = _compliance(model, self._outer, self._inner, self._away, cache)
        self._prepare_liquid()
        self._systems, self._fields, self._last_system = {}, {}, None
        self._away32 = self._away.astype(np.float32)
        self._prepare_strain()

    # --- preparation  ---

    def _prepare_positions(self):
        m = self.model

        def zeros(shape, dtype):
            array = wp.zeros(shape, dtype=dtype, device="cpu")
            return array, array.numpy()

        self._x_wp, self._x = zeros((m.nvert, 1), vec3)
        self._last_wp, self._last = zeros((m.nvert, 1), vec3)
        self._slot_wp, self.slot = zeros(m.nvert, int)
        self._x[:, 0] = self._last[:, 0] = self.rest

    def _prepare_strain(self):
        """What `strain` needs: each outer node's nearest across the wall."""
        g = self.model.geometry
        inner = np.unique(g.inner_face) if len(g.inner_face) else np.setdiff1d(self.model.fixed, g.outer_face)
        self._opposite = opposite = inner[cKDTree(self.rest[inner]).query(self.rest[self._outer])[1]]
        count, number = (
            wp.zeros(1, dtype=int, device="cpu"),
            wp.zeros(3 * len(self._outer), dtype=int, device="cpu"),
        )
        force, out = (
            wp.zeros(3 * len(self._outer), dtype=real, device="cpu"),
            wp.zeros(3, dtype=real, device="cpu"),
        )
        outer, opposite = (wp.array(a, dtype=int, device="cpu") for a in (self._outer, opposite))
        rest = wp.array(self.rest[:, None], dtype=vec3, device="cpu")
        self._touched, self._touched_force, self._touched_count, self._strains = (
            number.numpy(),
            force.numpy(),
            count.numpy(),
            out.numpy(),
        )
        self._measure_strain = recorded(
            _strain, 1, [count, number, force, outer, opposite, rest, self._x_wp], [out]
        )

    def strain(self, number: np.ndarray, force: np.ndarray) -> tuple[float, float, float]:
        """Largest displacement [m], spread [m^2] and squeezed share of the outer nodes (n,) with these forces
        (n,), as the skin is now."""
        n = len(number)
        if not n:
            return 0.0, 0.0, 0.0
        self._touched[:n], self._touched_force[:n], self._touched_count[0] = number, force, n
        self._measure_strain()
        return tuple(self._strains.tolist())

    def _prepare_liquid(self):
        m = self.model
        self._gradient = np.zeros((m.nvert, 3))
        self._give = np.zeros(self.compliance.size)
        if m.inner is None:
            return
        share = wp.zeros((len(m.inner.face), 1), dtype=real, device="cpu")
        self._share = share.numpy()
        self._volume = recorded(liquid.cavity_volume, share.shape, [m.inner.face, self._x_wp], [share])
        self._volume()
        self._cavity = float(self._share.sum())
        if not m.has_liquid:
            return
        corner = wp.zeros((3 * len(m.inner.face), 1), dtype=vec3, device="cpu")
        wp.launch(
            liquid.volume_gradient,
            dim=share.shape,
            inputs=[m.inner.face, self._x_wp],
            outputs=[corner],
            device="cpu",
        )
        np.add.at(self._gradient, m.inner.face.numpy().ravel(), corner.numpy()[:, 0])
        self._gradient[m.fixed] = 0
        self._give = self.compliance.vector(self._gradient)
        self._liquid_give = float(self._gradient[m.free].ravel() @ self._give)
        give = np.zeros((m.nvert, 3))
        give[m.free] = self._give.reshape(-1, 3)
        self._give_at = np.concatenate(
            [give[self._outer].ravel(), np.einsum("ij,ij->i", give[self._inner], self._away)]
        )

    def _measure_volume(self):
        if self.model.inner is not None:
            self._volume()

    # --- a step  ---

    def solve(
        self,
        memory: Memory,
        geom_pos: np.ndarray,
        geom_mat: np.ndarray,
        near: Memory | None = None,
        allowed: float = 1.0,
    ) -> Outcome:
        """Solves for poses (ngeom, 3) [m], (ngeom, 3, 3) at the end of the step; a function of its arguments
        alone. near: what a step from the same memory to poses not far from these came to, to begin from.
        allowed: of what a hard step may cost, by `patience`.

        Where that fails the geoms are followed there in parts; what comes back then holds for the poses in
        its memory, which are those asked for where `reached` is 1.

        Raises:
          ValueError: NaN in a pose.
        """
        if not (math.isfinite(np.sum(geom_pos)) and math.isfinite(np.sum(geom_mat))):
            raise ValueError(
                "geom poses contain NaN or infinite numbers: the simulation has diverged or a pose was "
                "never set"
            )
        with single_thread():
            out, u = follow(self, memory, geom_pos, geom_mat, near, allowed)
        self._keep(out.memory, u)
        return out

    def attempt(
        self,
        memory: Memory,
        u: np.ndarray | None,
        pos: np.ndarray,
        mat: np.ndarray,
        effort: Effort,
        moved: float | None = None,
        near: Memory | None = None,
        passing: bool = False,
    ) -> tuple[Outcome, np.ndarray] | None:
        """Solves for poses in one part.

        Args:
          memory, u: where it starts, and the displacements (nvert, 3) there [m]; None: they are found.
          effort: what it may cost.
          moved: how far points of the geoms go, where this is one of the parts of a hard step [m].
          near: see `solve`.
          passing: whether the geoms only pass there, so that a rough balance will do.

        Returns:
          The outcome and displacements, or None where no balance was found.
        """
        motion = self.pose(memory, pos, mat)
        if not len(memory.force) and self.untouched(pos, mat):  # what no sample touches changes nothing
            return self.at_rest(pos, mat, motion), np.zeros_like(self.rest)
        if self.search.deep(pos, mat):
            return None
        step = self._step(memory, u, pos, mat, motion, effort, moved, near, passing)
        try:
            for _ in range(4):
                step.run()
                if not (step.converged and step.missed()):
                    break
            out = step.outcome() if step.converged else None
        except np.linalg.LinAlgError:
            return None
        return (out, step.u) if out is not None and out.sound() else None

    def hold(self, memory: Memory) -> tuple[Outcome, np.ndarray]:
        """The skin as the memory has it, with the geoms where they are there, and the displacements."""
        pos, mat = memory.geom_pos, memory.geom_mat
        motion = self.pose(memory, pos, mat)
        if not len(memory.force):
            return self.at_rest(pos, mat, motion), np.zeros_like(self.rest)
        step = self._step(memory, None, pos, mat, motion, Effort(0.0))
        step.hold()
        return dataclasses.replace(step.outcome(), memory=memory), step.u

    def untouched(self, pos: np.ndarray, mat: np.ndarray) -> bool:
        """Whether no sample of the resting skin touches the geoms, posed so, and none is inside the core."""
        self._x[:, 0] = self.rest
        return not len(self.search.faces(0.0, 0.0, pos, mat)) and not self.search.deep(pos, mat)

    def pose(self, memory: Memory, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
        """Hands poses to the kernels; how far the geoms move there from the memory's (ngeom, 3) [m]."""
        last = (memory.geom_pos, memory.geom_mat) if memory.started else (pos, mat)
        if self.geoms.count:
            for array, value in zip(self._poses, (pos, mat, *last)):
                array[...] = value
        return pos - last[0]

    def _step(self, memory, u, pos, mat, motion, effort, moved=None, near=None, passing=False):
        u = self.displacement(memory) if u is None else u
        self._last[:, 0] = self._x[:, 0] = self.rest + u
        return Step(self, memory, u, pos, mat, motion, effort, moved, near, passing)

    def clear(self, geom_pos: np.ndarray, geom_mat: np.ndarray, margin: float) -> bool:
        """Whether the skin at rest is further than a margin [m] from geoms at these poses."""
        return self.search.clear(geom_pos, geom_mat, margin)

    def at_rest(self, pos: np.ndarray, mat: np.ndarray, motion: np.ndarray) -> Outcome:
        """Of geoms at these poses after this motion (ngeom, 3) [m], which touch nothing."""
        memory = Memory.rest(self.geoms.count)
        memory.started, memory.geom_pos, memory.geom_mat, memory.motion = (
            True,
            np.array(pos),
            np.array(mat),
            motion,
        )
        n = self.geoms.ngroup
        still = np.zeros((n, 6)), np.zeros((n, 6, 6)), self.rest.copy()
        return Outcome(memory, *still, self.model.rest.volume, True, True, 0, 0.0, np.zeros(0))

    def displacement(self, memory: Memory) -> np.ndarray:
        """(nvert, 3) of a memory [m]."""
        key = _key(memory)
        if key not in self._fields:
            self._keep(
                memory,
                self._recover(
                    memory.coordinate, memory.force, memory.pressure, memory.softening, memory.swelling
                ),
            )
        return self._fields[key]

    def contact_force(self, memory: Memory) -> np.ndarray:
        """(nvert, 3) of what touches on the nodes [N]."""
        out, outer = np.zeros((self.model.nvert, 3)), memory.coordinate < 3 * len(self._outer)
        node, axis = np.divmod(memory.coordinate[outer], 3)
        out[self._outer[node], axis] = memory.force[outer]
        return out

    def _keep(self, memory, u):
        if len(self._fields) > 16:
            self._fields.clear()
        self._fields[_key(memory)] = u

    def _recover(self, coordinate, force, pressure, softening, swelling):
        u = (pressure * swelling / softening) * self._give
        if len(coordinate):
            sums = np.zeros(self.compliance.size, np.float32)
            for row, f in zip(self.compliance.row(coordinate.tolist()), force.tolist()):
                saxpy(row, sums, a=f)
            u += sums
        out = np.zeros((self.model.nvert, 3))
        out[self.model.free] = (softening / self.model.material.youngs_modulus * u).reshape(-1, 3)
        return out

    def _system(self, outer, inner):
        """Coordinates and compliance (n, n) float32 over candidate outer nodes and inner nodes (numbers in
        self._inner), times E."""
        key = (outer.tobytes(), inner.tobytes())
        if key not in self._systems:
            if len(self._systems) > 64:
                self._systems.clear()
            c = np.concatenate(
                [(3 * self._number[outer][:, None] + np.arange(3)).ravel(), 3 * len(self._outer) + inner]
            )
            self._systems[key] = c, self._restricted(c, outer, inner)
        return self._systems[key]

    def _restricted(self, c, outer, inner):
        """Compliance over the coordinates c: entries that the last system had are copied, each is the same
        whenever it is computed."""
        W = np.empty((len(c), len(c)), np.float32)
        known, old = np.zeros(len(c), bool), None
        if self._last_system is not None:
            last, old = self._last_system
            place = np.full(self.compliance.count, -1)
            place[last] = np.arange(len(last))
            known = place[c] >= 0
            here = np.flatnonzero(known)
            if len(here):
                there = place[c[here]]
                W[np.ix_(here, here)] = old.take(there, 0).take(there, 1)
        new = np.flatnonzero(~known)
        if len(new):
            rows, columns = self._entries(c[new], c), self._entries(c, c[new])
            W[new] = (rows + columns.T) / 2  # rows are rounded one by one
            W[:, new] = W[new].T
        self._last_system = c, W
        return W

    def _entries(self, force, motion):
        """Motion along contact coordinates (k,) per unit force at contact coordinates (n,), times E: (n, k)
        float32."""
        first = 3 * len(self._outer)
        outer, inner = motion < first, motion[motion >= first] - first
        node = self.compliance.position(self._inner[inner])
        position = 3 * self.compliance.position(self._outer[motion[outer] // 3]) + motion[outer] % 3
        at = np.concatenate([position, (3 * node[:, None] + np.arange(3)).ravel()])
        fresh, m = self.compliance.part(force, at), len(position)
        out = np.empty((len(force), len(motion)), np.float32)
        out[:, outer] = fresh[:, :m]
        out[:, ~outer] = (fresh[:, m:].reshape(len(force), -1, 3) * self._away32[inner]).sum(2)
        return out
