"""Contact of the inner surface with the rigid core for the condensed tier: without friction, along directions
fixed at rest.

The law is that of the full skin, sampled inside the faces; what differs is that a node moves the samples
along its own direction away from the core, and that the distance is trilinear in the core's grid."""

import dataclasses
import typing

import numpy as np
import warp as wp

from ...launches import recorded
from ..contact.faces import face_samples
from ..contact.meshes import grid_value
from ..contact.posed import Geoms
from ..types import real, vec3

if typing.TYPE_CHECKING:
    from ..model import SkinModel

__all__ = ["CoreContact", "Meeting"]

wp.set_module_options({"enable_backward": False})

# hollows of the core are wider than 5 mm [1/m]; gradients are averages [m]
CONCAVE, SLACK = (wp.constant(100.0), wp.constant(1e-4))
_PROBE = 2e-4  # half a step of the differences that give the directions, half a cell of the core's grid [m]


@wp.func
def _measure_face(
    f: int,
    # In:
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    core: Geoms,
    x: wp.array2d(dtype=vec3),
    # Out:
    distance_out: wp.array2d(dtype=real),
):
    t = face[f]
    least = real(1.0)
    for s in range(sample.shape[0]):
        w = sample[s]
        p = w[0] * x[t[0], 0] + w[1] * x[t[1], 0] + w[2] * x[t[2], 0]
        d = grid_value(core.grids, core.grid[0], p)
        distance_out[f, s] = d
        least = wp.min(least, d)
    return least


@wp.func
def _may_be_near(t: wp.vec3i, core: Geoms, x: wp.array2d(dtype=vec3), reach: real):
    """Whether a face can be nearer to the core than the reach, from one distance (which may change a little
    faster than its place does)."""
    center = (x[t[0], 0] + x[t[1], 0] + x[t[2], 0]) / real(3.0)
    radius = wp.max(
        wp.length_sq(x[t[0], 0] - center),
        wp.max(wp.length_sq(x[t[1], 0] - center), wp.length_sq(x[t[2], 0] - center)),
    )
    k = core.grid[0]
    far = grid_value(core.grids, k, center) - core.grids.spacing[k]
    return far < reach + real(1.2) * wp.sqrt(radius)


@wp.kernel
def _measure(
    # In:
    count: wp.array(dtype=int),
    number: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    core: Geoms,
    x: wp.array2d(dtype=vec3),
    # Out:
    distance_out: wp.array2d(dtype=real),
):
    """Distances of the samples of the first count[0] numbered faces to the core."""
    for i in range(count[0]):
        _measure_face(number[i], face, sample, core, x, distance_out)


@wp.kernel
def _meet(
    # In:
    node: wp.array(dtype=int),
    node_gap: wp.array(dtype=real),
    away: wp.array(dtype=vec3),
    start: wp.array(dtype=int),
    incident: wp.array(dtype=int),
    rest_gap: wp.array(dtype=real),
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    core: Geoms,
    rest: wp.array2d(dtype=vec3),
    x: wp.array2d(dtype=vec3),
    share: wp.array(dtype=real),
    # Out:
    seen_out: wp.array(dtype=int),
    distance_out: wp.array2d(dtype=real),
):
    """Marks with 2 the faces that are nearer to the core than a share of their displacement.

    What has moved by m and gets nearer by a share of m cannot touch if it began further away than both; nor
    if it went along the core: the distance to a convex body is convex, so it is at least what its gradient at
    rest says, and little less where the core is hollow."""
    most = real(1.0) + share[0]
    for i in range(node.shape[0]):
        n = node[i]
        u = x[n, 0] - rest[n, 0]
        length = wp.length(u)
        moved = most * length
        left = node_gap[i] + wp.dot(u, away[i]) - real(CONCAVE) * length * length - real(SLACK)
        if moved > node_gap[i] and left < share[0] * length:
            for k in range(start[i], start[i + 1]):
                f = incident[k]
                if seen_out[f] == 0 and moved > rest_gap[f]:
                    seen_out[f] = 1
                    t = face[f]
                    u0 = wp.length_sq(x[t[0], 0] - rest[t[0], 0])
                    u1 = wp.length_sq(x[t[1], 0] - rest[t[1], 0])
                    u2 = wp.length_sq(x[t[2], 0] - rest[t[2], 0])
                    reach = share[0] * wp.sqrt(wp.max(u0, wp.max(u1, u2)))
                    if _may_be_near(t, core, x, reach):
                        if _measure_face(f, face, sample, core, x, distance_out) < reach:
                            seen_out[f] = 2


@dataclasses.dataclass
class Meeting:
    """Candidates of one step.

    Attributes:
      face: (n,) numbers of the faces. node: (k,) numbers of their free nodes.
      gap: (n, nsample) at displacements `at` (k,) along the nodes' directions [m].
      corner: (n, 3) numbers among the nodes, k of one that is held. sample: (nsample, 3) its weights.
      stiffness: (n,) of each sample of a face [N/m].
    """

    face: np.ndarray
    node: np.ndarray
    gap: np.ndarray
    at: np.ndarray
    corner: np.ndarray
    sample: np.ndarray
    stiffness: np.ndarray

    def force(self, u: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Forces (k,) at displacements u (k,), and the weights and stiffness of the samples that touch."""
        moved = np.append(u - self.at, 0.0)[self.corner]
        gap = self.gap + moved @ self.sample.T
        face, sample = np.nonzero(gap < 0)
        B = np.zeros((len(face), len(u) + 1))
        B[np.arange(len(face))[:, None], self.corner[face]] = self.sample[sample]
        B, k = B[:, :-1], self.stiffness[face]
        return B.T @ (-k * gap[face, sample]), (B, k)


class CoreContact:
    """The inner faces of a model that can meet the core.

    Args:
      model: SkinModel with a core.
      rest: (nvert, 3) nodes at rest [m].
      x_wp, x: (nvert, 1) present positions of the nodes, as Warp array and as its view; at rest now.

    Attributes:
      node: (nnode,) free nodes. direction: (nnode, 3) away from the core.
    """

    def __init__(self, model: "SkinModel", rest: np.ndarray, x_wp: wp.array, x: np.ndarray):
        free = np.zeros(model.nvert, bool)
        free[model.free] = True
        self._face = model.core_surface.face_np
        self._sample = face_samples(model.options.samples)
        self._stiffness = model.contact_stiffness * model.core_surface.area.numpy() / len(self._sample)
        self.node = np.unique(self._face)
        self.node = self.node[free[self.node]]
        self._number = np.full(model.nvert, -1)
        self._number[self.node] = np.arange(len(self.node))
        nface, nsample = len(self._face), len(self._sample)
        surface = [model.core_surface.face, model.sample, model.core(1).struct]
        gap = wp.zeros((nface, nsample), dtype=real, device="cpu")
        number, count = wp.zeros(nface, dtype=int, device="cpu"), wp.zeros(1, dtype=int, device="cpu")
        self._asked, self._count, self._gap = number.numpy(), count.numpy(), gap.numpy()
        self._look = recorded(_measure, 1, [count, number, *surface, x_wp], [gap])
        everything = np.arange(nface)
        gradient = np.zeros((nface, 3))
        for axis in range(3):
            for sign in (1, -1):
                x[:, 0, axis] += sign * _PROBE
                gradient[:, axis] += sign * self._measured(everything).mean(1)
                x[:, 0] = rest
        nodal = np.zeros((model.nvert, 3))
        np.add.at(nodal, self._face, np.repeat(gradient[:, None], 3, 1))
        self.direction = nodal[self.node] / np.linalg.norm(nodal[self.node], axis=1, keepdims=True)
        rest_gap = self._measured(everything).min(1)
        # the grid rounds edges of the core by micrometres: what starts outside stays outside
        self._offset = np.minimum(self._gap, 0)
        self._corner = self._number[self._face]
        # of the nearest face of each node; held corners, -1, are the last
        node_gap = np.full(len(self.node) + 1, np.inf)
        np.minimum.at(node_gap, self._corner, rest_gap[:, None])
        order = np.argsort(self._corner.ravel(), kind="stable")
        order = order[self._corner.ravel()[order] >= 0]
        start = np.searchsorted(self._corner.ravel()[order], np.arange(len(self.node) + 1))
        constants = [
            (self.node, int),
            (node_gap[:-1], real),
            (self.direction, vec3),
            (start, int),
            (order // 3, int),
            (rest_gap, real),
        ]
        constants = [wp.array(array, dtype=dtype, device="cpu") for array, dtype in constants]
        still = wp.array(rest[:, None], dtype=vec3, device="cpu")
        share, seen = wp.zeros(1, dtype=real, device="cpu"), wp.zeros(nface, dtype=int, device="cpu")
        self._share, self._seen = share.numpy(), seen.numpy()
        none, nobody = np.zeros(0, int), np.zeros((0, 3), int)
        self._apart = Meeting(
            none, none, np.zeros((0, nsample)), np.zeros(0), nobody, self._sample, np.zeros(0)
        )
        self._search = recorded(_meet, 1, [*constants, *surface, still, x_wp, share], [seen, gap])

    def _measured(self, face):
        """Gaps (n, nsample) of faces (n,), before what they had at rest is taken off."""
        self._asked[: len(face)], self._count[0] = face, len(face)
        self._look()
        return self._gap[face]

    def meet(
        self, u: np.ndarray, share: float, last: Meeting | None, loaded: np.ndarray | None = None
    ) -> Meeting:
        """Faces with a sample nearer to the core than a share of their displacement, and those of the last
        meeting.

        Args:
          u: (nvert, 3) displacements at the present positions, which the Warp array holds [m].
          share: how much of its displacement a face may make in this step.
          last: candidates so far; returned as they are where there are no more.
          loaded: (m,) nodes, numbered as in `node`, whose faces are candidates in any case.
        """
        self._share[0], self._seen[:] = share, 0
        self._search()
        if last is not None:
            self._seen[last.face] = 2
        if loaded is not None:
            self._seen[np.isin(self._corner, loaded).any(1)] = 2
        face = np.flatnonzero(self._seen == 2)
        if last is not None and len(face) == len(last.face):
            return last
        if not len(face):
            return self._apart
        gap = self._measured(face) - self._offset[face]
        corner = self._corner[face]
        used = np.zeros(len(self.node) + 1, bool)
        used[corner] = True  # fixed corners, -1, mark the last
        node = np.flatnonzero(used[:-1])
        place = np.full(len(self.node) + 1, len(node))
        place[node] = np.arange(len(node))
        at = np.einsum("ij,ij->i", u[self.node[node]], self.direction[node])
        return Meeting(face, node, gap, at, place[corner], self._sample, self._stiffness[face])
