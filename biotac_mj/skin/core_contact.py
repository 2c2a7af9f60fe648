"""Contact of the inner surface with the rigid core for the condensed tier: without friction, along directions fixed at rest.

The law is that of the full skin, sampled inside the faces; what differs is that a node moves the samples along its own direction away
from the core, and that the distance is trilinear in the core's grid.
"""

import dataclasses

import numpy as np
import warp as wp

from .contact import Geoms, face_samples
from .shapes import distance_bound
from .types import real, vec3

__all__ = ["CoreContact", "Meeting"]

wp.set_module_options({"enable_backward": False})

_PROBE = 2e-4  # half a step of the differences that give the directions, half a cell of the core's grid [m]


@wp.kernel
def _core_distance(
    # In:
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    core: Geoms,
    rest: wp.array2d(dtype=vec3),
    rest_gap: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    share: wp.array(dtype=real),
    kept: wp.array(dtype=int),
    # Out:
    near_out: wp.array(dtype=int),
    distance_out: wp.array2d(dtype=real),
):
    """Distances of the samples to the core, of faces that are kept or nearer to it than a share of their displacement."""
    f = wp.tid()
    t = face[f]
    x0 = x[t[0], 0]
    x1 = x[t[1], 0]
    x2 = x[t[2], 0]
    a = wp.length_sq(x0 - rest[t[0], 0])
    b = wp.length_sq(x1 - rest[t[1], 0])
    c = wp.length_sq(x2 - rest[t[2], 0])
    moved = wp.sqrt(wp.max(a, wp.max(b, c)))
    reach = share[0] * moved
    near = kept[f]
    if near == 1 or rest_gap[f] - moved < reach:
        half = real(0.5) * core.grids.spacing[core.grid[0]]
        for s in range(sample.shape[0]):
            w = sample[s]
            p = w[0] * x0 + w[1] * x1 + w[2] * x2
            d = distance_bound(core.kind[0], core.size[0], core.rounding[0], core.grids, core.grid[0], p) + half
            distance_out[f, s] = d
            if d < reach:
                near = 1
    near_out[f] = near


@dataclasses.dataclass
class Meeting:
    """Candidates of one step.

    Attributes:
      face: (n,) numbers of the faces. node: (k,) numbers of their free nodes.
      gap: (n nsample,) at displacements `at` (k,) along the nodes' directions [m].
      weight: (n nsample, k) of the nodes in each sample. stiffness: (n nsample,) [N/m].
    """

    face: np.ndarray
    node: np.ndarray
    gap: np.ndarray
    at: np.ndarray
    weight: np.ndarray
    stiffness: np.ndarray

    def force(self, u):
        """Forces (k,) at displacements u (k,), and the weights and stiffness of the samples that touch."""
        gap = self.gap + self.weight @ (u - self.at)
        closed = np.flatnonzero(gap < 0)
        B, k = self.weight[closed], self.stiffness[closed]
        return B.T @ (-k * gap[closed]), (B, k)


class CoreContact:
    """The inner faces of a model that can meet the core.

    Args:
      model: SkinModel with a core.
      x_wp, x: (nvert, 1) present positions of the nodes, as Warp array and as its view; at rest now.

    Attributes:
      node: (nnode,) free nodes. direction: (nnode, 3) away from the core.
    """

    def __init__(self, model, x_wp, x):
        self._rest = model.geometry.vert
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
        rest_gap, share, kept = (wp.zeros(n, dtype=t, device="cpu") for n, t in ((nface, real), (1, real), (nface, int)))
        near, gap = wp.zeros(nface, dtype=int, device="cpu"), wp.zeros((nface, nsample), dtype=real, device="cpu")
        self._rest_gap, self._share, self._kept, self._near, self._gap = (a.numpy() for a in (rest_gap, share, kept, near, gap))
        self._look = wp.launch(
            _core_distance, dim=nface, device="cpu", record_cmd=True,
            inputs=[model.core_surface.face, model.sample, model.core(1).struct, model.vert, rest_gap, x_wp, share, kept],
            outputs=[near, gap],
        )  # fmt: skip
        self._kept[:] = 1
        gradient = np.zeros((nface, 3))
        for axis in range(3):
            for sign in (1, -1):
                x[:, 0, axis] += sign * _PROBE
                self._look.launch()
                gradient[:, axis] += sign * self._gap.mean(1)
                x[:, 0] = self._rest
        nodal = np.zeros((model.nvert, 3))
        np.add.at(nodal, self._face, np.repeat(gradient[:, None], 3, 1))
        self.direction = nodal[self.node] / np.linalg.norm(nodal[self.node], axis=1, keepdims=True)
        self._look.launch()
        self._rest_gap[:] = self._gap.min(1)
        # the grid rounds edges of the core by micrometres: what starts outside stays outside
        self._offset = np.minimum(self._gap, 0)

    def meet(self, u, share, last: Meeting | None) -> Meeting:
        """Faces with a sample nearer to the core than a share of their displacement, and those of the last meeting.

        Args:
          u: (nvert, 3) displacements at the present positions, for which the faces are looked at [m].
          share: how much of its displacement a face may make in this step.
          last: candidates so far; returned as they are where there are no more.
        """
        self._share[0] = share
        self._kept[:] = 0
        if last is not None:
            self._kept[last.face] = 1
        self._look.launch()
        face = np.flatnonzero(self._near)
        if last is not None and len(face) == len(last.face):
            return last
        gap = self._gap[face] - self._offset[face]
        corner = self._number[self._face[face]]
        used = np.zeros(len(self.node) + 1, bool)
        used[corner] = True  # fixed corners, -1, mark the last
        node = np.flatnonzero(used[:-1])
        place = np.full(len(self.node) + 1, len(node))
        place[node] = np.arange(len(node))
        nsample = len(self._sample)
        weight = np.zeros((len(face), nsample, len(node) + 1))
        column = place[corner]
        for c in range(3):
            weight[np.arange(len(face))[:, None], np.arange(nsample), column[:, c : c + 1]] = self._sample[:, c]
        weight = weight[:, :, :-1].reshape(len(face) * nsample, len(node))
        at = np.einsum("ij,ij->i", u[self.node[node]], self.direction[node])
        return Meeting(face, node, gap.ravel(), at, weight, np.repeat(self._stiffness[face], nsample))
