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
    number: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    core: Geoms,
    x: wp.array2d(dtype=vec3),
    # Out:
    distance_out: wp.array2d(dtype=real),
):
    """Distance of the samples of some faces to the core."""
    i, s = wp.tid()
    t = face[number[i]]
    b = sample[s]
    p = b[0] * x[t[0], 0] + b[1] * x[t[1], 0] + b[2] * x[t[2], 0]
    half = real(0.5) * core.grids.spacing[core.grid[0]]
    distance_out[i, s] = distance_bound(core.kind[0], core.size[0], core.rounding[0], core.grids, core.grid[0], p) + half


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
      x_wp, x: (nvert, 1) positions of the nodes that distances are measured at, as Warp array and as its view; at rest now.

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
        number, out = wp.zeros(nface, dtype=int, device="cpu"), wp.zeros((nface, nsample), dtype=real, device="cpu")
        self._asked, self._out = number.numpy(), out.numpy()
        self._launch = wp.launch(
            _core_distance, dim=(nface, nsample), device="cpu", record_cmd=True,
            inputs=[number, model.core_surface.face, model.sample, model.core(1).struct, x_wp], outputs=[out],
        )  # fmt: skip
        everything = np.arange(nface)
        self._offset = np.zeros((nface, nsample))
        gradient = np.zeros((nface, 3))
        for axis in range(3):
            for sign in (1, -1):
                x[:, 0, axis] += sign * _PROBE
                gradient[:, axis] += sign * self._distance(everything).mean(1)
                x[:, 0] = self._rest
        nodal = np.zeros((model.nvert, 3))
        np.add.at(nodal, self._face, np.repeat(gradient[:, None], 3, 1))
        self.direction = nodal[self.node] / np.linalg.norm(nodal[self.node], axis=1, keepdims=True)
        # the grid rounds edges of the core by micrometres: what starts outside stays outside
        self._offset = np.minimum(self._distance(everything), 0)
        self._rest_gap = self._distance(everything).min(1)
        self._order = np.argsort(self._rest_gap, kind="stable")
        self._ordered_gap = self._rest_gap[self._order]

    def _distance(self, face):
        self._asked[: len(face)] = face
        self._launch.set_dim((len(face), len(self._sample)))
        self._launch.launch()
        return self._out[: len(face)] - self._offset[face]

    def meet(self, u, share, kept) -> Meeting:
        """Faces with a sample nearer to the core than a share of their displacement, and the faces `kept`.

        Args:
          u: (nvert, 3) displacements at the present positions [m].
          share: how much of its displacement a face may make in this step.
          kept: (n,) numbers of faces.
        """
        # the others cannot be near: no node has moved so far
        most = np.sqrt(3) * max(u.max(), -u.min())
        first = self._order[: np.searchsorted(self._ordered_gap, (1 + share) * most)]
        a, b, c = (np.einsum("ij,ij->i", u[n], u[n]) for n in self._face[first].T)
        length = np.zeros(len(self._face))
        length[first] = np.sqrt(np.maximum(np.maximum(a, b), c))
        reach = share * length
        reach[kept] = np.inf
        face = np.flatnonzero(self._rest_gap - length < reach)
        gap = self._distance(face)
        near = gap.min(1, initial=np.inf) < reach[face]
        face, gap = face[near], gap[near]
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
