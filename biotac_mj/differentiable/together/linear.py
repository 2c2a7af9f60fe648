"""A step of all worlds at its balance, linear in what it was given: `linear.step` for many dry, elastic
worlds at once.

The tangent's products go over the worlds in the elements' own kernel and over the samples of all worlds in
one of their own; the transposed solve is one for all."""

import numpy as np
import torch
import warp as wp

from ...skin.types import mat33, vec3
from ..linear.samples import of_corners, slopes_of_samples
from ..touching import Held
from .skin import RecordOfWorlds, SkinOfWorlds, push_nodes
from .solve import solve_worlds

__all__ = ["LinearWorlds"]

_DIGITS = 1e-4  # what products of a single inverse reduce a residual by, before it is measured anew


class LinearWorlds:
    """The step of a record; geoms are placed (`SkinOfWorlds.place`).

    Args:
      skin: the worlds. record: of the step. x_last: (nvert, nworld, 3) nodes when it began [m].
    """

    def __init__(self, skin: SkinOfWorlds, record: RecordOfWorlds, x_last: torch.Tensor):
        self.skin, self.record = skin, record
        skin.restore(record, x_last)
        self._stiffness = skin.data.worlds.contact_stiffness.numpy().copy()
        ratio = skin.model.options.stick_ratio
        self.touching = at = skin.look(record.x, x_last, record.held)
        self.slopes = self._slopes(at, skin.geoms, ratio)
        self.parts = [(at, self.slopes)]
        if skin.data.core:
            there = skin.look(record.x, record.x, Held.none(), core=True)
            self.parts.append((there, self._slopes(there, skin.model.core(skin.nworld), ratio)))
        # transposed
        blocks = [np.swapaxes(slopes.by_point[:, :3], 1, 2) for _, slopes in self.parts]
        self._many = sum(map(len, blocks))
        with wp.ScopedDevice(skin.device):
            node, weight = (
                np.concatenate([getattr(t, k) for t, _ in self.parts]) for k in ("node", "weight")
            )
            self._node, self._weight = wp.array(node, dtype=int), wp.array(weight, dtype=vec3)
            self._block = wp.array(np.ascontiguousarray(np.concatenate(blocks)), dtype=mat33)

    def _slopes(self, at, geoms, ratio):
        return slopes_of_samples(at, geoms.struct, self._stiffness[at.world] * at.area, ratio)

    def multiply(self, v: torch.Tensor) -> torch.Tensor:
        """The consistent tangent's transpose times v (nvert, nworld, 3), zero at fixed nodes."""
        skin = self.skin
        out = skin.multiply_rubber(v).clone()
        if self._many:
            pushed = torch.zeros_like(out)
            vectors = [wp.from_torch(a.reshape(-1, 3), dtype=vec3) for a in (v.contiguous(), pushed)]
            given = [self._node, self._weight, self._block]
            wp.launch(push_nodes, self._many, [*given, vectors[0]], [vectors[1]], device=skin.device)
            out -= pushed
        return out * skin.free

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """K^-T times right (nvert, nworld, 3), zero at fixed nodes."""
        skin = self.skin
        digits = _DIGITS if skin.single else 0.0
        return solve_worlds(self.multiply, skin.precondition, right * skin.free, skin.precision, digits)[0]

    def pull(self, x: torch.Tensor, wrench: np.ndarray, anchor: np.ndarray) -> dict:
        """Cotangents of what the step was given, from those of what it gives.

        Args:
          x: (nvert, nworld, 3). wrench: (nworld, ngroup, 6). anchor: (m, 3) of the samples that touch.

        Returns:
          x_last (nvert, nworld, 3), a tensor; anchor (nheld, 3); pose and pose_last (nworld, ngeom, 6);
          friction (nworld, ngeom); mu, lam, contact_stiffness (nworld,).
        """
        skin, at, slopes, held = self.skin, self.touching, self.slopes, self.record.held
        w, ngeom = skin.nworld, skin.geoms.count
        wrench = wrench[at.world, skin.geoms.groups[at.kind]]
        felt = np.einsum("mij,mi->mj", slopes.wrench_by_node, wrench)
        felt += np.einsum("mij,mi->mj", of_corners(at.weight, slopes.by_point[:, 3:]), anchor)
        balance = self.solve(self._at_nodes(x.clone(), at.node, felt))
        force = self._interpolate(balance, at) + np.einsum("mij,mi->mj", slopes.collect, wrench)
        six = np.concatenate([force, anchor], 1)

        def by(slope, six=six):
            return np.einsum("mij,mi->mj", slope, six)

        def of_geoms(number, value):
            out = np.zeros((ngeom * w, value.shape[1]))
            np.add.at(out, number, value)
            return out.reshape(ngeom, w, -1).swapaxes(0, 1)

        new, old = slopes.new, slopes.old
        last = of_corners(at.weight[new], slopes.by_last)
        given = {
            "pose": of_geoms(at.geom, by(slopes.by_pose)),
            "pose_last": of_geoms(at.geom[new], by(slopes.by_pose_last, six[new])),
            "friction": of_geoms(at.geom, by(slopes.by_friction))[..., 0],
            "x_last": self._at_nodes(torch.zeros_like(x), at.node[new], by(last, six[new])),
            "anchor": np.zeros((len(held.sample), 3)),
        }
        given["anchor"][at.old[old]] = by(slopes.by_stick[old], six[old])
        stiffness = np.bincount(at.world, at.area * by(slopes.by_springs)[:, 0], w)
        for there, own in self.parts[1:]:
            felt = np.einsum("mij,mi->mj", own.by_springs[:, :3], self._interpolate(balance, there))
            stiffness += np.bincount(there.world, there.area * felt[:, 0], w)
        given["contact_stiffness"] = stiffness
        given["mu"], given["lam"] = skin.rubber_by_moduli(balance)
        return given

    def _at_nodes(self, total, node, value):
        """`total` (nvert, nworld, 3) with values (m, 9) of the corners of faces with nodes (m, 3) added."""
        where, value = self.skin.tensor(node.ravel()), self.skin.tensor(value.reshape(-1, 3))
        total.view(-1, 3).index_add_(0, where, value)
        return total

    def _interpolate(self, v, at):
        """(m, 3) at the samples' points."""
        corner = v.reshape(-1, 3)[self.skin.tensor(at.node)].cpu().numpy()
        return np.einsum("ma,mak->mk", at.weight, corner)
