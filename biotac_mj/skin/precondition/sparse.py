"""Preconditioner of the linear solves on the CPU: sparse factor of the undeformed stiffness, corrected
exactly for contact and liquid.

Contact adds stiffness only between the touching nodes T, the liquid only along the gradient g of its volume.
With U = [unit vectors of T, g] and the small matrix D = diag(contact stiffness over T, K/V0), Woodbury's
identity gives

  (A0 + U D U^T)^-1 = A0^-1 - A0^-1 U (I + D W)^-1 D U^T A0^-1,      W = U^T A0^-1 U  (the compliance over T
  and g).

With compliant bodies W is replaced by W + R A R^T in I + D W, with their compliance A and rigid motions R of
T.
"""

import typing
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.linalg.lapack import dgetrf, dgetrs

from ...geometry.rigid import rigid_motions
from ..newton.worlds import NEGLIGIBLE_RESIDUAL
from ..program import Launcher
from ..types import DOUBLE
from . import Preconditioner, Residual
from .body_tangent import assemble, body_tangent
from .pushed_forward import PushForward, pushes_forward

if typing.TYPE_CHECKING:
    from ..geoms import GeomSet

_DENSE = 300  # coordinates below which a dense matrix of springs is faster than a sparse one
_FACTOR = 60  # cost of a factor in products of the tangent
_SYSTEM = 110_000  # entries of a Woodbury system that cost as much as a product


class SparsePreconditioner(Preconditioner):
    """Preconditioner of all worlds of one SkinData in double precision, see `precondition.Preconditioner`.

    For nearly incompressible rubber the inverse is pushed forward into the deformed shape (`pushed_forward`).
    If the solves of a single world have taken more products than a factor costs, the deformed shape is
    factored, for the present step only, so that a step is a function of its start state: without this, 3 of
    12 steps of a cylinder on rubber with nu above 0.499 do not converge. Several worlds share the undeformed
    factor.
    """

    precision = DOUBLE

    def __init__(self, data: typing.Any):
        model, st = data.model, data.worlds
        self._bodies, self._body_contact = data.bodies, data.body_contact
        self._model, self._surfaces = model, [s for s in (data.outer, data.core) if s]
        self._rest = self.factor = model.factor
        # change of the free nodes, and a zero behind them for the fixed nodes
        self._change = np.zeros(3 * len(model.free) + 3, np.float32)
        self._change_at = np.full(model.nvert, len(model.free))
        self._change_at[model.free] = np.arange(len(model.free))
        self._is_free = np.zeros(model.nvert, bool)
        self._is_free[model.free] = True
        self._softness, self._kappa = st.softness.numpy(), st.kappa.numpy()
        self._viscosity = st.viscosity.numpy()
        self._work = st.work.numpy()
        self._products, self._iterations = 0, st.iterations_cg.numpy()
        self._rows = self._undeformed_rows = {}
        self._woodbury = [None] * data.nworld
        self._push_forward, self._pushed = None, False  # for nearly incompressible rubber
        self._gradient = self._along = None
        self._active, self._running, self._touched = (a.numpy() for a in (st.active, st.running, st.touched))

    # --- the factor of a step ---

    def begin_step(self, program: Launcher, x: wp.array) -> None:
        elements, ratio = self._model.elements, self._model.material.poissons_ratio
        if self._push_forward is None and pushes_forward(elements, ratio):
            self._push_forward = PushForward(elements, x)
        self._x = x.numpy()
        program.call(self._begin)

    def _begin(self):
        self._products = 0
        self.factor, self._rows = self._rest, self._undeformed_rows
        self._pushed = self._push_forward is not None

    def renew_if_due(self, program: Launcher, x: wp.array) -> None:
        """After a linear solve: renews the factor if solves take too long."""
        x = x.numpy()

        def check():
            self._products += int(self._iterations[0])
            if self._products > _FACTOR:
                self._renew(x)

        if self._renews:
            program.call(check)

    def renew(self, program: Launcher, x: wp.array) -> None:
        """Takes the factor of the shape x."""
        x = x.numpy()
        if self._renews:
            program.call(lambda: self._renew(x))

    @property
    def _renews(self):
        return self._model.material.poissons_ratio > 0.45 and len(self._woodbury) == 1

    def _renew(self, x):
        self._products = 0
        self._work[0] += _FACTOR
        self.factor, self._rows = self._model.factor_at(x[:, 0]), {}
        self._pushed = False

    # --- solves ---

    def update(
        self,
        program: Launcher,
        residual: Residual,
        z_out: wp.array,
        partial_out: wp.array,
        in_parallel: Callable[..., None],
    ) -> None:
        """See `precondition.Preconditioner`."""
        norms, r, gradient = residual
        square, r, z, partial = (a.numpy() for a in (norms, r, z_out, partial_out))
        gradient = None if gradient is None else gradient.numpy()
        touched, touching = self._touched, [s.touching.numpy() for s in self._surfaces]

        def update():
            worlds = np.flatnonzero(self._active)
            z[:, self._of(worlds)], partial[:, :, self._of(worlds)] = 0, 0
            for w in worlds:
                touched[w] = any(t[:, w].any() for t in touching)
                self._woodbury[w] = None
            rest = (touched[worlds] == 0) & (square[0].sum(0)[worlds] < NEGLIGIBLE_RESIDUAL**2)
            worlds = worlds[~rest]
            if not len(worlds):
                return
            these = self._of(worlds)
            if self._pushed:
                self._push_forward.measure(worlds)
            if gradient is None:
                y = self._solve(r[:, these], worlds)
            else:  # two right-hand sides take less than twice the time of one
                both = np.concatenate([r[:, these].swapaxes(0, 1), gradient[:, these].swapaxes(0, 1)])
                y, along = np.split(self._solve(both.swapaxes(0, 1), worlds), 2, axis=1)
                if self._along is None:
                    self._along = np.zeros(gradient.shape)
                self._gradient, self._along[:, these] = gradient, along
            for w in worlds:
                along = None if gradient is None else self._along[:, w]
                system = self._woodbury[w] = self._woodbury_system(w, along, self._pushed)
                if system is not None:
                    self._work[w] += len(system[3]) ** 2 // _SYSTEM
            self._correct(worlds, y, r, z, partial)

        program.call(update)

    def apply(self, program: Launcher, residual: Residual, z_out: wp.array, partial_out: wp.array) -> None:
        """See `precondition.Preconditioner`."""
        r, z, out = (a.numpy() for a in (residual.r, z_out, partial_out))

        def apply():
            worlds = np.flatnonzero(self._running)
            if len(worlds):
                self._correct(worlds, self._solve(r[:, self._of(worlds)], worlds), r, z, out)

        program.call(apply)

    def _solve(self, rhs, worlds):
        """The inverse, pushed forward, times right-hand sides (nvert, k nworlds, 3)."""
        if not self._pushed:
            return self.factor.solve(rhs)
        each = np.tile(worlds, rhs.shape[1] // len(worlds))
        return self._push_forward.apply(each, self.factor.solve(self._push_forward.pull_back(each, rhs)))

    def _of(self, worlds):
        """Index of the columns of these worlds; a slice, thus a view, for all of them."""
        return slice(None) if len(worlds) == len(self._woodbury) else worlds

    def _woodbury_system(self, w, along, pushed):
        """Woodbury system of world w: touching nodes, their rows of the undeformed inverse, solver,
        compliance W. along: (nvert, 3) the inverse times the gradient of the liquid's volume."""
        faces, blocks = [], []
        for state in self._surfaces:
            active, block = state.active(w)
            faces.append(state.surface.face_np[active])
            blocks.append(block)
        faces, blocks = np.concatenate(faces), np.concatenate(blocks)
        nodes = np.unique(faces)
        nodes = nodes[self._is_free[nodes]]
        m = 3 * len(nodes)
        size = m + (self._gradient is not None)
        if size == 0:
            return None
        D = assemble(nodes, faces, blocks, len(self._is_free))
        rows, W = self._compliance(w, nodes)
        if pushed:
            W = self._push_forward.compliance(w, nodes, W)
        compliance, soft = np.zeros((size, size)), self._softness[w]
        compliance[:m, :m] = W * soft
        if self._gradient is not None:
            along = along * soft
            compliance[:m, m] = compliance[m, :m] = along[nodes].ravel()
            compliance[m, m] = np.vdot(self._gradient[:, w], along)
        with_bodies = compliance
        if self._bodies is not None and m:
            with_bodies = compliance.copy()
            # the bodies have the artificial viscosity of the skin
            with_bodies[:m, :m] += self._body_compliance(w, nodes) / (1 + self._viscosity[w])
        return nodes, rows, _Solver(D, self._kappa[w], with_bodies), compliance

    def _body_compliance(self, w, nodes):
        """R A R^T (3k, 3k) of the bodies that touch nodes (k,) of world w."""
        outer, n = self._surfaces[0], 3 * len(nodes)
        faces = np.flatnonzero(outer.touching.numpy()[:, w])
        group = np.full(len(self._is_free), -1)
        np.maximum.at(group, outer.surface.face_np[faces], self._body_contact.group.numpy()[faces, w, None])
        there, mine = np.unique(group[nodes], return_inverse=True)
        mine[group[nodes] < 0] = len(there)  # touched by the core only
        rigid = np.zeros((len(nodes), 3, len(there) + 1, 6))
        rigid[np.arange(len(nodes)), :, mine] = rigid_motions(self._x[nodes, w], n).reshape(-1, 3, 6)
        rigid = rigid[:, :, : len(there)].reshape(n, -1)
        compliance = self._bodies.compliance.numpy()[there[:, None], there, w]
        return rigid @ compliance.swapaxes(1, 2).reshape(rigid.shape[1], -1) @ rigid.T

    def _compliance(self, w, nodes):
        """Rows of the inverse at `nodes`, and the block among the nodes; cached while the nodes do not
        change."""
        key = nodes.tobytes()
        if w not in self._rows or self._rows[w][0] != key:
            rows = self.factor.rows(nodes)
            self._rows[w] = key, rows, rows[:, self.factor.dof(nodes)].astype(float)
        return self._rows[w][1:]

    def _correct(self, worlds, y, r, z, partial):
        """Computes z, r . z and gradient . z of some worlds from y = A0^-1 r."""
        for k, w in enumerate(worlds):
            soft, system = self._softness[w], self._woodbury[w]
            v = y[:, k] * soft
            if system is not None:
                nodes, rows, solver, _ = system
                m = 3 * len(nodes)
                u = v[nodes].reshape(-1)
                if self._gradient is not None:
                    u = np.append(u, np.vdot(self._gradient[:, w], v))
                q = solver(u) * soft
                if m:
                    force = self._push_forward.pull_back_force(w, nodes, q[:m]) if self._pushed else q[:m]
                    np.dot(rows.T, force.astype(np.float32), self._change[:-3])
                    change = self._change.reshape(-1, 3).take(self._change_at, 0)
                    v -= self._push_forward.apply([w], change[:, None])[:, 0] if self._pushed else change
                if self._gradient is not None:
                    v -= q[m] * self._along[:, w]
            z[:, w] = v
            partial[0, 0, w] = np.vdot(r[:, w], v)
            if self._gradient is not None:
                partial[1, 0, w] = np.vdot(self._gradient[:, w], v)

    # --- tangents of touching bodies ---

    def measure_tangents(
        self, program: Launcher, geoms: "GeomSet", x: wp.array, tangent_out: wp.array
    ) -> None:
        """See `precondition.Preconditioner`."""
        outer, nvert = self._surfaces[0], len(self._is_free)
        face, x, out = outer.surface.face_np, x.numpy(), tangent_out.numpy()
        geom = outer.trial_geom.numpy().reshape(len(face), -1, len(self._woodbury))

        def measure():
            out[...] = 0
            for w, system in enumerate(self._woodbury):
                active, blocks = outer.active(w)
                if system is None or not len(active):
                    continue
                if self._pushed and not self._renews:
                    system = self._undeformed_system(w)
                nodes, _, solver, compliance = system
                if self._bodies is not None:  # without the compliance of the bodies
                    solver = solver.against(compliance)
                group = geoms.groups[geom[active, :, w].max(1)]
                for g in np.unique(group):
                    mine = face[active[group == g]], blocks[group == g]
                    out[g, w] = body_tangent(nodes, compliance, solver, mine, x[:, w], nvert)

        program.call(measure)

    def _undeformed_system(self, w):
        """Woodbury system of the undeformed inverse: tangents of several worlds use it, as on CUDA."""
        along = None
        if self._gradient is not None:
            along = self.factor.solve(self._gradient[:, w : w + 1])[:, 0]
        return self._woodbury_system(w, along, False)


class _Solver:
    """q = (I + D W)^-1 D u. D has the contact springs (m, m) and, with a liquid, kappa."""

    def __init__(self, springs: np.ndarray, kappa: float, W: np.ndarray):
        few = sp.issparse(springs) or len(springs) < _DENSE
        self._springs, self._kappa = springs if few else sp.csr_matrix(springs), kappa
        matrix = self._stiffen(W)
        matrix.ravel()[:: len(W) + 1] += 1
        # LAPACK's layout, without a copy; scipy's lu_factor and lu_solve take twice as long for small systems
        self._factor, self._pivots, _ = dgetrf(matrix.T, overwrite_a=1)

    def __call__(self, u: np.ndarray) -> np.ndarray:
        return dgetrs(self._factor, self._pivots, self._stiffen(u), trans=1, overwrite_b=1)[0]

    def against(self, W: np.ndarray) -> "_Solver":
        """A solver with the same springs and another compliance W."""
        return _Solver(self._springs, self._kappa, W)

    def _stiffen(self, u):
        m, out = self._springs.shape[0], np.empty(u.shape)
        out[:m] = self._springs @ u[:m]
        out[m:] = self._kappa * u[m:]
        return out
