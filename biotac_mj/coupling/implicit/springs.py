"""What holds bodies in one mjData besides the skin that pushes them: their inertia, and MuJoCo's constraints
where its solver left them."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from ...skin.types import real
from ..structs import DataView, ModelView
from .compliance import factor
from .kinematics import row

__all__ = ["Springs"]

_INTEGER = "state", "J_rownnz", "J_rowadr", "J_colind"
_ENTRIES = "J", "J_colind"  # of the constraints' Jacobian; the others are of its rows


class Springs:
    """Factors of inertia and constraint rows, by the kernel of `compliance` on copies of MuJoCo's arrays.

    Args:
      nslot: how many slots of six rows each skin has.

    Attributes:
      own: of each skin, the first row of each slot, (nslot,) views to write to.
      L: (1, nv, nv) wp.array, the factor that was found last. stiffness: (1, nv, nv) of all skins.
    """

    def __init__(self, model: ModelView, data: DataView, nslot: Sequence[int]):
        self._model, self._data = model, data
        ends = np.cumsum([0, *nslot]).tolist()
        self._parts = [slice(*ab) for ab in zip(ends, ends[1:])]
        with wp.ScopedDevice("cpu"):
            rows = model.M_rownnz, model.M_rowadr, model.M_colind
            self._pattern = [wp.array(array, dtype=int) for array in rows]
            self._inertia, self._rows = wp.zeros((1, data.M.size), dtype=real), wp.zeros(1, dtype=int)
            self._own, self._one = wp.full((ends[-1], 1), -1, dtype=int), wp.ones(1, dtype=int)
            self.L, self.stiffness = (wp.zeros((1, model.nv, model.nv), dtype=real) for _ in range(2))
        self.own = [self._own.numpy()[part, 0] for part in self._parts]
        self._here = {"inertia": self._inertia.numpy(), "rows": self._rows.numpy()}
        self._make_room(1, 1)

    def _make_room(self, rows, entries):
        """For so many constraint rows, and entries of their Jacobian."""
        sparse = self._model.is_sparse
        names = ["state", "D", "J", *(_INTEGER[1:] if sparse else ())]
        shapes = {name: (1, 1, entries) if name in _ENTRIES else (1, rows) for name in names}
        if not sparse:
            shapes["J"] = 1, rows, self._model.nv
        kinds = {name: int if name in _INTEGER else real for name in names}
        arrays = {name: wp.zeros(shapes[name], dtype=kinds[name], device="cpu") for name in names}
        self._room, self._factors = (rows, entries), {}
        self._copies = {f"efc_{name}": array.numpy().reshape(-1) for name, array in arrays.items()}
        none = [wp.zeros((1,) * n, dtype=int, device="cpu") for n in (2, 2, 3)]
        self._arrays = [arrays["state"], arrays["J"], arrays["D"], int(sparse)]
        self._arrays += [arrays.get(name, other) for name, other in zip(_INTEGER[1:], none)]

    def take(self, inertia: np.ndarray | None) -> None:
        """Takes the rows as they are, and an inertia (nM,) laid out as MuJoCo's M; None: that."""
        rows, here = self._data.rows(), self._here
        needed = rows.efc_state.size, rows.efc_J.size
        if needed[0] > self._room[0] or needed[1] > self._room[1]:
            self._make_room(*(2 * n for n in needed))
        here["inertia"][0] = self._data.M if inertia is None else inertia
        here["rows"][0] = needed[0]
        for name, copy in self._copies.items():
            given = getattr(rows, name)
            copy[: given.size] = given

    def factor(self, skin: int | None) -> None:
        """Finds L of what was taken, without the rows of one skin, or of all (None)."""
        if skin not in self._factors:
            own = self._own if skin is None else self._own[self._parts[skin]]
            known = [self._one, self._inertia, *self._pattern, own, self._rows, *self._arrays, self.L]
            self._factors[skin] = row((factor, (1, 1), known))
        self._factors[skin]()
