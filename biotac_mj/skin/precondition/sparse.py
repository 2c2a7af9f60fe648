"""Preconditioner of the linear solves on the CPU: the rest stiffness' sparse factor, corrected exactly for
contact and liquid.

Contact adds stiffness only between the touching nodes T, the liquid only along the gradient g of its volume.
With U = [unit vectors of T, g] and the small matrix D = diag(contact stiffness over T, K/V0), Woodbury's
identity gives

  (A0 + U D U^T)^-1 = A0^-1 - A0^-1 U (I + D W)^-1 D U^T A0^-1,      W = U^T A0^-1 U  (the compliance over T
  and g).

Where bodies give way, contact is softer by their compliance A along rigid motions R of T: W + R A R^T stands
for W in I + D W.
"""

import typing
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.linalg.lapack import dgetrf, dgetrs

from ...geometry.rigid import rigid_motions
from ...threads import single_thread
from ..newton.worlds import NEGLIGIBLE_RESIDUAL, Worlds
from ..program import Launcher
from ..types import DOUBLE
from . import Residual
from .body_tangent import assemble, body_tangent
from .carried import Carrier, carries
from .supernodal import Elimination, SupernodalFactor, elimination_of

if typing.TYPE_CHECKING:
    from ..bodies import Bodies
    from ..geoms import GeomSet
    from ..newton.bodies import BodyContact

__all__ = ["SparseFactor", "SparsePreconditioner"]

_DENSE = 300  # springs on so few coordinates are multiplied faster with the zeros between them
_FACTOR = 60  # products of the tangent: about what a factor costs
_SYSTEM = 110_000  # of a small system's entries: about what takes as long as a product


class SparseFactor:
    """A sparse factor on the CPU, see `supernodal`.

    Args:
      elimination: of a matrix with the same pattern; None: `elimination_of` this one, kept as the attribute.
    """

    def __init__(
        self,
        stiffness: sp.csc_matrix,
        free: np.ndarray,
        vert: np.ndarray,
        elimination: Elimination | None = None,
    ):
        self.elimination = elimination or elimination_of(stiffness, vert[free])
        with single_thread():  # its fronts are small: more threads wait for each other
            self._solver = SupernodalFactor(stiffness, self.elimination, free)
        self.size = stiffness.shape[0]
        self._free = free
        self._index = np.full(len(vert), -1)
        self._index[free] = np.arange(len(free))
        self._cluster_nodes = self.elimination.clusters
        self._cluster = np.empty(len(free), int)
        self._member = np.empty(len(free), int)
        for number, members in enumerate(self._cluster_nodes):
            self._cluster[members], self._member[members] = number, np.arange(len(members))
        self._rows = {}

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Inverse times rhs: (nvert, nworld, 3) -> the same shape, zero at fixed nodes."""
        return self._solver.solve(rhs)

    def rows(self, nodes: np.ndarray) -> np.ndarray:
        """Rows of the inverse that belong to free nodes: (3 len(nodes), size) float32.

        A row is computed with the rest of its cluster of nodes, always the same one, so that it does not
        depend on the order of requests."""
        local = self._index[nodes]
        out = np.empty((len(nodes), 3, self.size), np.float32)
        mine = self._cluster[local]
        order = np.argsort(mine, kind="stable")
        for here in np.split(order, np.flatnonzero(np.diff(mine[order])) + 1) if len(order) else ():
            cluster = int(mine[here[0]])
            if cluster not in self._rows:
                rows = self._solver.rows(self._cluster_nodes[cluster])
                self._rows[cluster] = rows.reshape(-1, 3, self.size)
            out[here] = self._rows[cluster][self._member[local[here]]]
        return out.reshape(-1, self.size)

    def dof(self, nodes: np.ndarray) -> np.ndarray:
        """Positions of the nodes' coordinates in a row (3 len(nodes),)."""
        return (3 * self._index[nodes][:, None] + np.arange(3)).ravel()


class SparsePreconditioner:
    """For all worlds of one SkinData, world by world in double precision; see `precondition.Preconditioner`.

    Nearly incompressible rubber, turned and strained, is no longer like that at rest: the inverse is carried
    into the present shape (`carried`). Where that is not enough, a lone world whose solves have taken more
    products than a factor costs gets that of its present shape, again and again, for this step alone, so that
    a step remains a function of the state it starts from. Worlds share a factor: not where there are many.
    """

    precision = DOUBLE

    def __init__(
        self,
        model: typing.Any,
        surfaces: tuple,
        st: Worlds,
        chunk: int,
        bodies: "Bodies | None" = None,
        body_contact: "BodyContact | None" = None,
    ):
        self._bodies, self._body_contact = bodies, body_contact
        self._model, self._surfaces = model, [s for s in surfaces if s]
        self._rest = self.factor = model.factor
        # of the free nodes, with a zero behind them for the fixed ones
        self._change = np.zeros(3 * len(model.free) + 3, np.float32)
        self._change_at = np.full(model.nvert, len(model.free))
        self._change_at[model.free] = np.arange(len(model.free))
        self._is_free = np.zeros(model.nvert, bool)
        self._is_free[model.free] = True
        nworld = st.softness.shape[0]
        self._softness, self._kappa = st.softness.numpy(), st.kappa.numpy()
        self._viscosity = st.viscosity.numpy()
        self._work = st.work.numpy()
        self._products, self._iterations = 0, st.iterations_cg.numpy()
        self._rows = self._rest_rows = {}
        self._small = [None] * nworld
        self._carrier, self._carried = None, False  # of nearly incompressible rubber, see `carried`
        self._gradient = self._along = None
        self.any_touch = st.touched

    # --- the factor of a step ---

    def begin_step(self, program: Launcher, x: wp.array) -> None:
        elements, ratio = self._model.elements, self._model.material.poissons_ratio
        if self._carrier is None and carries(elements, ratio):
            self._carrier = Carrier(elements, x)
        self._x = x.numpy()
        program.call(self._begin)

    def _begin(self):
        self._products = 0
        self.factor, self._rows = self._rest, self._rest_rows
        self._carried = self._carrier is not None

    def watch_products(self, program: Launcher, x: wp.array) -> None:
        """After a linear solve: renews the factor where solves take too long."""
        x = x.numpy()

        def watch():
            self._products += int(self._iterations[0])
            if self._products > _FACTOR:
                self._renew(x)

        if self._renews:
            program.call(watch)

    def renew(self, program: Launcher, x: wp.array) -> None:
        """Takes the factor of the shape x."""
        x = x.numpy()
        if self._renews:
            program.call(lambda: self._renew(x))

    @property
    def _renews(self):
        return self._model.material.poissons_ratio > 0.45 and len(self._small) == 1

    def _renew(self, x):
        self._products = 0
        self._work[0] += _FACTOR
        self.factor, self._rows = self._model.factor_at(x[:, 0]), {}
        self._carried = False

    # --- solves ---

    def update(
        self,
        program: Launcher,
        st: Worlds,
        residual: Residual,
        z_out: wp.array,
        partial_out: wp.array,
        in_parallel: Callable[..., None],
    ) -> None:
        """See `precondition.Preconditioner`."""
        norms, r, gradient = residual
        on, square, r, z, partial = (a.numpy() for a in (st.active, norms, r, z_out, partial_out))
        gradient = gradient.numpy() if len(gradient) else None
        touched, touching = self.any_touch.numpy(), [s.touching.numpy() for s in self._surfaces]

        def update():
            worlds = np.flatnonzero(on)
            z[:, self._of(worlds)], partial[:, :, self._of(worlds)] = 0, 0
            for w in worlds:
                touched[w] = any(t[:, w].any() for t in touching)
                self._small[w] = None
            rest = (touched[worlds] == 0) & (square[0].sum(0)[worlds] < NEGLIGIBLE_RESIDUAL**2)
            worlds = worlds[~rest]
            if not len(worlds):
                return
            these = self._of(worlds)
            if self._carried:
                self._carrier.measure(worlds)
            if gradient is None:
                y = self._solve(r[:, these], worlds)
            else:  # two right-hand sides take less than twice as long as one
                sides = np.concatenate([r[:, these].swapaxes(0, 1), gradient[:, these].swapaxes(0, 1)])
                y, along = np.split(self._solve(sides.swapaxes(0, 1), worlds), 2, axis=1)
                if self._along is None:
                    self._along = np.zeros(gradient.shape)
                self._gradient, self._along[:, these] = gradient, along
            for w in worlds:
                along = None if gradient is None else self._along[:, w]
                small = self._small[w] = self._small_system(w, along, self._carried)
                if small is not None:
                    self._work[w] += len(small[3]) ** 2 // _SYSTEM
            self._correct(worlds, y, r, z, partial)

        program.call(update)

    def apply(
        self,
        program: Launcher,
        st: Worlds,
        partial: wp.array,
        r: wp.array,
        gradient: wp.array,
        z_out: wp.array,
        partial_out: wp.array,
    ) -> None:
        """See `precondition.Preconditioner`."""
        on, r, z, out = (a.numpy() for a in (st.running, r, z_out, partial_out))

        def apply():
            worlds = np.flatnonzero(on)
            if len(worlds):
                self._correct(worlds, self._solve(r[:, self._of(worlds)], worlds), r, z, out)

        program.call(apply)

    def _solve(self, rhs, worlds):
        """The inverse, carried into the present shapes, times right-hand sides (nvert, k nworlds, 3)."""
        if not self._carried:
            return self.factor.solve(rhs)
        each = np.tile(worlds, rhs.shape[1] // len(worlds))
        return self._carrier.onward(each, self.factor.solve(self._carrier.back(each, rhs)))

    def _of(self, worlds):
        """An index for columns of these worlds; all of them are a view, not a copy."""
        return slice(None) if len(worlds) == len(self._small) else worlds

    def _small_system(self, w, along, carried):
        """Of world w: nodes that are touched, their rows of the inverse at rest, the system that is solved
        there and the compliance in it; along: the inverse times the liquid's gradient (nvert, 3)."""
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
        if carried:
            W = self._carrier.compliance(w, nodes, W)
        compliance, soft = np.zeros((size, size)), self._softness[w]
        compliance[:m, :m] = W * soft
        if self._gradient is not None:
            along = along * soft
            compliance[:m, m] = compliance[m, :m] = along[nodes].ravel()
            compliance[m, m] = np.vdot(self._gradient[:, w], along)
        softer = compliance
        if self._bodies is not None and m:
            softer = compliance.copy()
            softer[:m, :m] += self._give(w, nodes) / (1 + self._viscosity[w])  # bodies creep as the skin does
        return nodes, rows, _Solver(D, self._kappa[w], softer), compliance

    def _give(self, w, nodes):
        """R A R^T of the bodies that touch nodes (k,) of world w."""
        outer, n = self._surfaces[0], 3 * len(nodes)
        faces = np.flatnonzero(outer.touching.numpy()[:, w])
        group = np.full(len(self._is_free), -1)
        np.maximum.at(group, outer.surface.face_np[faces], self._body_contact.group.numpy()[faces, w, None])
        there, mine = np.unique(group[nodes], return_inverse=True)
        mine[group[nodes] < 0] = len(there)  # the core alone touches them
        rigid = np.zeros((len(nodes), 3, len(there) + 1, 6))
        rigid[np.arange(len(nodes)), :, mine] = rigid_motions(self._x[nodes, w], n).reshape(-1, 3, 6)
        rigid = rigid[:, :, : len(there)].reshape(n, -1)
        compliance = self._bodies.compliance.numpy()[there[:, None], there, w]
        return rigid @ compliance.swapaxes(1, 2).reshape(rigid.shape[1], -1) @ rigid.T

    def _compliance(self, w, nodes):
        """Rows of the inverse at `nodes` and their restriction to the nodes; kept while the set of nodes
        stays the same."""
        key = nodes.tobytes()
        if w not in self._rows or self._rows[w][0] != key:
            rows = self.factor.rows(nodes)
            self._rows[w] = key, rows, rows[:, self.factor.dof(nodes)].astype(float)
        return self._rows[w][1:]

    def _correct(self, worlds, y, r, z, partial):
        """From A0^-1 r of some worlds to z, r . z and gradient . z."""
        for k, w in enumerate(worlds):
            soft, small = self._softness[w], self._small[w]
            v = y[:, k] * soft
            if small is not None:
                nodes, rows, solver, _ = small
                m = 3 * len(nodes)
                u = v[nodes].reshape(-1)
                if self._gradient is not None:
                    u = np.append(u, np.vdot(self._gradient[:, w], v))
                q = solver(u) * soft
                if m:
                    push = self._carrier.push(w, nodes, q[:m]) if self._carried else q[:m]
                    np.dot(rows.T, push.astype(np.float32), self._change[:-3])
                    change = self._change.reshape(-1, 3).take(self._change_at, 0)
                    v -= self._carrier.onward([w], change[:, None])[:, 0] if self._carried else change
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
        geom = outer.trial_geom.numpy().reshape(len(face), -1, len(self._small))

        def measure():
            out[...] = 0
            for w, small in enumerate(self._small):
                active, blocks = outer.active(w)
                if small is None or not len(active):
                    continue
                if self._carried and not self._renews:
                    small = self._small_at_rest(w)
                nodes, _, solver, compliance = small
                if self._bodies is not None:  # the skin alone
                    solver = solver.against(compliance)
                group = geoms.groups[geom[active, :, w].max(1)]
                for g in np.unique(group):
                    mine = face[active[group == g]], blocks[group == g]
                    out[g, w] = body_tangent(nodes, compliance, solver, mine, x[:, w], nvert)

        program.call(measure)

    def _small_at_rest(self, w):
        """The small system without the present shape: tangents of many worlds are by the inverse at rest, as
        CUDA has it."""
        along = None
        if self._gradient is not None:
            along = self.factor.solve(self._gradient[:, w : w + 1])[:, 0]
        return self._small_system(w, along, False)


class _Solver:
    """q = (I + D W)^-1 D u, D of the springs (m, m) and, with a liquid, its bulk modulus over its volume."""

    def __init__(self, springs: np.ndarray, kappa: float, W: np.ndarray):
        few = sp.issparse(springs) or len(springs) < _DENSE
        self._springs, self._kappa = springs if few else sp.csr_matrix(springs), kappa
        matrix = self._stiffen(W)
        matrix.ravel()[:: len(W) + 1] += 1
        # as LAPACK has it, no copy; scipy's lu_factor and lu_solve take as long again for small ones
        self._factor, self._pivots, _ = dgetrf(matrix.T, overwrite_a=1)

    def __call__(self, u: np.ndarray) -> np.ndarray:
        return dgetrs(self._factor, self._pivots, self._stiffen(u), trans=1, overwrite_b=1)[0]

    def against(self, W: np.ndarray) -> "_Solver":
        """The same of another compliance."""
        return _Solver(self._springs, self._kappa, W)

    def _stiffen(self, u):
        m, out = self._springs.shape[0], np.empty(u.shape)
        out[:m] = self._springs @ u[:m]
        out[m:] = self._kappa * u[m:]
        return out
