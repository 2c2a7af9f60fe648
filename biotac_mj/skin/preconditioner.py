"""Preconditioner of the linear solves: the rest stiffness' inverse, corrected exactly for contact and liquid.

Contact adds stiffness only between the touching nodes T, the liquid only along the gradient g of its volume.
With U = [unit vectors of T, g] and the small matrix D = diag(contact stiffness over T, K/V0), Woodbury's
identity gives

  (A0 + U D U^T)^-1 = A0^-1 - A0^-1 U (I + D W)^-1 D U^T A0^-1,      W = U^T A0^-1 U  (the compliance over T
  and g).
"""

import numpy as np
from scipy.linalg import lu_factor, lu_solve

from .rigid import rigid_motions

__all__ = ["Preconditioner", "assemble", "body_tangent"]


class Preconditioner:
    """For all worlds of one SkinData; `update` after each evaluation of the forces, then `apply`."""

    def __init__(self, model, scale):
        self._rest, self.factor = model.factor, model.factor
        self.free_mask = np.zeros(model.nvert, bool)
        self.free_mask[model.free] = True
        self.free = model.free
        self.scale = scale
        self._rows = self._rest_rows = {}

    def replace(self, factor):
        """Takes another stiffness' factor until `restore`."""
        self.factor, self._rows = factor, {}

    def restore(self):
        """Takes the factor at rest again."""
        self.factor, self._rows = self._rest, self._rest_rows

    def update(self, states, residual, gradient, kappa):
        """Takes the tangents of contact and liquid; returns the approximate inverse of the new tangent times
        the residual.

        Args:
          states: ContactState of each surface that can touch, just evaluated.
          residual: (nvert, nworld, 3), zero at fixed nodes [N].
          gradient: (nvert, nworld, 3) of the liquid's volume, zero at fixed nodes [m^2], or None.
          kappa: (nworld,) K / V0 [Pa/m^3].
        """
        self.gradient, self.kappa = gradient, kappa
        if gradient is None:
            y = self.factor.solve(residual)
        else:  # two right-hand sides take little longer than one
            y, self.along = np.split(self.factor.solve(np.concatenate([residual, gradient], 1)), 2, axis=1)
        self.worlds = [self._small(w, states) for w in range(len(self.scale))]
        return self._correct(y)

    def clear(self):
        """For a skin that nothing touches."""
        self.gradient, self.along = None, None
        self.worlds = [None] * len(self.scale)

    def _small(self, w, states):
        faces, blocks = [], []
        for state in states:
            active, block = state.active(w)
            faces.append(state.surface.face_np[active])
            blocks.append(block)
        faces, blocks = np.concatenate(faces), np.concatenate(blocks)
        nodes = np.unique(faces)
        nodes = nodes[self.free_mask[nodes]]
        m = 3 * len(nodes)
        size = m + (self.gradient is not None)
        if size == 0:
            return None
        D = np.zeros((size, size))
        D[:m, :m] = assemble(nodes, faces, blocks, len(self.free_mask))
        rows, W = self._compliance(w, nodes)
        compliance = np.zeros((size, size))
        compliance[:m, :m] = W / self.scale[w]
        if self.gradient is not None:
            D[m, m] = self.kappa[w]
            along = self.along[:, w] / self.scale[w]
            compliance[:m, m] = compliance[m, :m] = along[nodes].ravel()
            compliance[m, m] = np.vdot(self.gradient[:, w], along)
        solver = _Solver(np.eye(size) + D @ compliance, D)
        return nodes, rows, solver, compliance, D

    def _compliance(self, w, nodes):
        """Rows of the inverse at `nodes` and their restriction to the nodes; kept while the set of nodes
        stays the same."""
        key = nodes.tobytes()
        if w not in self._rows or self._rows[w][0] != key:
            rows = self.factor.rows(nodes)
            self._rows[w] = key, rows, rows[:, self.factor.dof(nodes)].astype(float)
        return self._rows[w][1:]

    def apply(self, r):
        """Approximate inverse of the tangent times r: (nvert, nworld, 3), zero at fixed nodes."""
        return self._correct(self.factor.solve(r))

    def _correct(self, z):
        for w, small in enumerate(self.worlds):
            z[:, w] /= self.scale[w]
            if small is None:
                continue
            nodes, rows, solver, _, _ = small
            m = 3 * len(nodes)
            u = z[:, w][nodes].reshape(-1)
            if self.gradient is not None:
                u = np.append(u, np.vdot(self.gradient[:, w], z[:, w]))
            q = solver(u) / self.scale[w]
            if m:
                z[self.free, w] -= (rows.T @ q[:m].astype(np.float32)).reshape(-1, 3)
            if self.gradient is not None:
                z[:, w] -= q[m] * self.along[:, w]
        return z

    def tangent(self, w, blocks, x):
        """Stiffness (6, 6) of the skin against rigid motions of a body that touches it, see
        `body_tangent`."""
        small = self.worlds[w]
        if small is None:
            return np.zeros((6, 6))
        nodes, _, solver, compliance, _ = small
        return body_tangent(nodes, compliance, solver, blocks, x, len(self.free_mask))


def body_tangent(nodes, compliance, solver, blocks, x, nvert):
    """Stiffness of the skin against rigid motions of a body that touches it, 6 x 6 about the origin
    (translation, rotation vector).

    The body drags the contact springs D_g; the skin behind them gives way by the corrected compliance C = (A0
    + U D U^T)^-1 over
    T: G^T (D_g - D_g C D_g) G, with the body's rigid motions G at the touching nodes. The rest stiffness
      stands for the tangent
    here, as in the preconditioner.

    Args:
      nodes: (m,) touching free nodes.
      compliance: (3m [+ 1], ...) W over them (and the liquid).
      solver: u -> (I + D W)^-1 D u.
      blocks: (faces (n, 3), stiffness (n, 6, 3, 3)) of the body's contact alone.
      x: (nvert, 3) nodal positions.
      nvert: number of nodes.
    """
    if not len(blocks[0]):
        return np.zeros((6, 6))
    size, m = len(compliance), 3 * len(nodes)
    springs = np.zeros((size, size))
    springs[:m, :m] = assemble(nodes, *blocks, nvert)
    rigid = rigid_motions(x[nodes], size)
    pull = springs @ rigid
    give = compliance @ pull
    give -= compliance @ solver(give)
    stiffness = rigid.T @ pull - pull.T @ give
    values, vectors = np.linalg.eigh((stiffness + stiffness.T) / 2)
    return (vectors * np.maximum(values, 0)) @ vectors.T


def assemble(nodes, faces, blocks, nvert):
    """Contact stiffness (3m, 3m) over `nodes` from the blocks (n, 6, 3, 3) of faces (n, 3)."""
    position = np.full(nvert, len(nodes))
    position[nodes] = np.arange(len(nodes))
    dense = np.zeros((len(nodes) + 1, 3, len(nodes) + 1, 3))  # the last row and column catch fixed nodes
    for k, (a, b) in enumerate([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]):
        pa, pb = position[faces[:, a]], position[faces[:, b]]
        np.add.at(dense, (pa, slice(None), pb), blocks[:, k])
        if a != b:
            np.add.at(dense, (pb, slice(None), pa), blocks[:, k])
    return dense[:-1, :, :-1].reshape(3 * len(nodes), 3 * len(nodes))


class _Solver:
    """q = (I + D W)^-1 D u."""

    def __init__(self, matrix, D):
        self._lu, self._D = lu_factor(matrix, check_finite=False), D

    def __call__(self, u):
        return lu_solve(self._lu, self._D @ u, check_finite=False)
