"""What resists the motion of bodies in one mjData besides the skins: inertia, and MuJoCo's constraints in the
states that its solver found. A sliding contact resists by the Hessian of its elliptic cone."""

from collections.abc import Sequence

import mujoco
import numpy as np
import warp as wp

from ...skin.types import real, vec6
from ..solid_contacts import contacts_of
from ..structs import DataView, ModelView
from .compliance import factor
from .kinematics import row, rows_of
from .rows import ROWS

_NEWTON = int(mujoco.mjtSolver.mjSOL_NEWTON)
_CONE = int(mujoco.mjtConstraintState.mjCNSTRSTATE_CONE)
_ENTRIES = "J", "J_colind"  # of the constraints' Jacobian; the others are of its rows


class Springs:
    """Factors of inertia and constraint rows, by the kernel of `compliance` on copies of MuJoCo's arrays.

    Args:
      nslot: how many slots of six rows each skin has.

    Attributes:
      own: (nslot,) first row of each slot of all skins, to write to.
      L: (1, nv, nv) wp.array, the factor that was found last. stiffness: (1, nv, nv) of all skins; held:
        a view of it.
    """

    def __init__(self, model: ModelView, data: DataView, nslot: Sequence[int]):
        self._model, self._data = model, data
        ends = np.cumsum([0, *nslot]).tolist()
        with wp.ScopedDevice("cpu"):
            rows = model.M_rownnz, model.M_rowadr, model.M_colind
            self._pattern = [wp.array(array, dtype=int) for array in rows]
            self._inertia, self._rows = wp.zeros((1, data.M.size), dtype=real), wp.zeros(1, dtype=int)
            self._own, self._one = wp.full((ends[-1], 1), -1, dtype=int), wp.ones(1, dtype=int)
            self.L, self.stiffness = (wp.zeros((1, model.nv, model.nv), dtype=real) for _ in range(2))
        self._parts = [rows_of(self._own, slice(a, b)) for a, b in zip(ends, ends[1:])]
        self.own = self._own.numpy()[:, 0]
        self._here = {"inertia": self._inertia.numpy(), "rows": self._rows.numpy()}
        self.held = self.stiffness.numpy()
        self._make_room(1, 1)

    def _make_room(self, rows, entries):
        """For so many constraint rows, and entries of their Jacobian that are not zero."""
        made, self._copies = ROWS[real](), {}
        made.sparse = 1  # also where MuJoCo's is not
        for name in ("state", "J", "D", "J_rownnz", "J_rowadr", "J_colind"):
            shape = (1, 1, entries) if name in _ENTRIES else (1, rows)
            array = wp.zeros(shape, dtype=real if name in "JD" else int, device="cpu")
            setattr(made, name, array)
            self._copies[name] = array.numpy().reshape(-1)
        cone, hessian = (wp.zeros((1, rows), dtype=kind, device="cpu") for kind in (int, vec6))
        self._cone, self._hessian = cone.numpy()[0], hessian.numpy()[0]
        self._room, self._factors = (rows, entries), {}
        self._arrays = [made, cone, hessian, wp.zeros_like(cone)]

    def take(self, inertia: np.ndarray | None) -> None:
        """Takes the rows as they are, and an inertia (nM,) laid out as MuJoCo's M; None: that."""
        rows, here = self._data.rows(), self._here
        state = self._data.row_states()
        cones = self._cones(state)
        if self._model.is_sparse:
            value, column, count, first = rows.efc_J, rows.efc_J_colind, rows.efc_J_rownnz, rows.efc_J_rowadr
        else:
            whole = rows.efc_J.reshape(-1, self._model.nv)
            there = whole != 0.0
            for begin, hessian in cones:
                mine = there[begin : begin + len(hessian)]
                mine[:] = mine.any(axis=0)
            (number, column), count = there.nonzero(), there.sum(axis=1)
            value, first = whole[number, column], np.cumsum(count) - count
        needed = len(count), len(value)
        if needed[0] > self._room[0] or needed[1] > self._room[1]:
            self._make_room(*(2 * n for n in needed))
        here["inertia"][0] = self._data.M if inertia is None else inertia
        here["rows"][0] = needed[0]
        given = state, value, rows.efc_D, count, first, column
        for copy, array in zip(self._copies.values(), given):
            copy[: array.size] = array
        self._cone[: needed[0]] = -1
        for begin, hessian in cones:
            mine, size = slice(begin, begin + len(hessian)), len(hessian)
            self._cone[mine], self._hessian[mine, size:], self._hessian[mine, :size] = begin, 0.0, hessian

    def _cones(self, state):
        """[(first row, Hessian (n, n))] of contacts that slide on their elliptic friction cones. MuJoCo's
        Newton solver leaves the Hessians."""
        newton = self._data.is_dual or self._model.opt.solver == _NEWTON
        out, sliding = [], newton and (state == _CONE).any()
        for contact in contacts_of(self._data) if sliding else ():
            begin, size = int(contact["efc_address"]), int(contact["dim"])
            if begin >= 0 and state[begin] == _CONE:
                out.append((begin, contact["H"].ravel()[: size * size].reshape(size, size)))
        return out

    def factor(self, skin: int | None) -> None:
        """Computes the factor L without the rows of one skin, or of all (None)."""
        if skin not in self._factors:
            own = self._own if skin is None else self._parts[skin]
            known = [self._one, self._inertia, *self._pattern, own, self._rows, *self._arrays, self.L]
            self._factors[skin] = row((factor, (1, 1), known))
        self._factors[skin]()
