"""The skin's stiffness in MuJoCo's dynamics: rows of constraints that add beta h^2 J' S J to the inertia,
across kinematic trees.

The force of the skin is W - beta h^2 S J a, with W its linear model at the pose reached without acceleration,
S = -dW/dx and J the Jacobian of the touching body relative to the BioTac. W goes into `qfrc_passive`. The
rest is exactly what a constraint row with regularisation R = 1 / (beta h^2 s) and reference
acceleration zero gives, one row for each of the six eigenvalues s of S. So MuJoCo's solver finds the
accelerations of object and finger together, with every other contact and limit. The rows' forces are equal
and opposite whatever the masses, and zero at rest, where a = 0. `docs/lab/coupling.md` compares this with the
alternatives.

`attach` leaves inactive weld constraints in the model ("slots") to make room for the rows; each body that can
touch gets one."""

import mujoco
import numpy as np

from ..structs import DataView, ModelView
from ..touching import Touching

__all__ = ["Metric"]

_MINVAL = 1e-15  # mjMINVAL
_EQUALITY = int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
_NEVER = int(mujoco.mjtSleepPolicy.mjSLEEP_NEVER)
_NEEDED = {
    name: int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}")) for name in ("constraint", "equality")
}
_PLAIN = 1.0, 0.0, 1.0, 0.0  # of a row: stiffness, damping, impedance, its derivative


class Metric:
    """The rows between the BioTac's body and the bodies that can touch it.

    Raises:
      ValueError: the model has fewer slots than bodies that can touch.
    """

    def __init__(self, model: ModelView, touching: Touching, slots: list):
        self.model, self.core = model, touching.core
        self.body = touching.body
        tree = model.body_treeid
        roots = [int(model.body_weldid[b]) if tree[b] >= 0 else 0 for b in self.body]
        needed = sorted({root for root in roots if root or tree[self.core] >= 0})
        if len(needed) > len(slots):
            raise ValueError(
                f"{len(needed)} bodies can touch the BioTac {model.name('body', self.core)!r} but it has "
                f"room for {len(slots)}: give slots={len(needed)} to attach or tasks.BioTac, attach it after "
                "adding the objects, or name the geoms that may touch with geoms=[...]"
            )
        self.root = roots
        self._layout, self._written, self._known = None, {}, {}
        self.slot = dict(zip(needed, slots))
        for root, slot in self.slot.items():
            model.eq_obj1id[slot], model.eq_obj2id[slot] = self.core, root
            model.eq_active0[slot] = 1
        self._slots = np.array(list(self.slot.values()), dtype=np.int64)
        # MuJoCo does not see what the skin carries: a body asleep has no rows and would not be woken
        for t in {int(tree[b]) for b in (self.core, *self.slot)} - {-1}:
            model.tree_sleep_policy[t] = _NEVER

    def switch_on(self, data: DataView) -> bool:
        """Activates its constraint slots. Returns whether one was inactive, so that MuJoCo has to build its
        rows again.

        Raises:
          ValueError: the model's flags leave no room for them.
        """
        if not self.slot:
            return False
        model = self.model
        off = [name for name, flag in _NEEDED.items() if model.opt.disableflags & flag]
        if off:
            raise ValueError(
                f"two-way coupling needs MuJoCo's equality constraints and the flag {' and '.join(off)} is "
                "disabled: enable it, or use coupling='one-way'"
            )
        if data.eq_active[self._slots].all():
            return False
        data.eq_active[self._slots] = 1  # switched off with all others, or new to this mjData
        return True

    def find_rows(self, data: DataView) -> None:
        """Finds this step's rows, which MuJoCo has made, and takes their own meaning from them. MuJoCo has to
        make their reference accelerations again before `take_references`.

        They lie in the arena: none is made again after this.
        """
        model = self.model
        self._rows = {}
        if not self.slot:
            return
        ids, kinds = data.efc_id[: data.ne], data.efc_type[: data.ne]
        layout = ids.tobytes(), kinds.tobytes()
        if layout != self._layout:  # it rarely changes
            self._places, self._layout = self._find(ids, kinds), layout
        islands = data.map_efc2iefc if data.nisland else None
        for root, here in self._places.items():
            self._rows[root] = here, None if islands is None else islands[here]
        data.efc_KBIP[self._all] = _PLAIN
        data.efc_pos[self._all] = data.efc_margin[self._all]
        self._stiff, self._weight, self._regular = data.efc_J, data.efc_D, data.efc_R
        if islands is not None:
            self._island_weight, self._island_regular = data.iefc_D, data.iefc_R
        self._columns = None
        if model.is_sparse:
            self._columns = data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind
        self._filled = dict.fromkeys(self._rows, True)  # by MuJoCo
        self._written = {}

    def take_references(self, data: DataView) -> None:
        """Makes the reference accelerations of its rows zero. MuJoCo adds dJ/dt v of the weld that a row was:
        the position takes it off again."""
        if self.slot:
            data.efc_pos[self._all] += data.efc_aref[self._all]

    def _find(self, ids, kinds):
        places = {}
        for root, slot in self.slot.items():
            index = np.flatnonzero((ids == slot) & (kinds == _EQUALITY))
            if len(index) != 6:
                raise ValueError(
                    f"MuJoCo made {len(index)} of the 6 constraint rows between the BioTac and body "
                    f"{self.model.name('body', root)!r}: does that body sleep, or was the BioTac's equality "
                    "constraint changed?"
                )
            places[root] = slice(int(index[0]), int(index[0]) + 6)
        rows = np.concatenate([np.arange(here.start, here.stop) for here in places.values()])
        # neighbours as a rule; a slice is written faster than numbered rows
        self._all = slice(int(rows.min()), int(rows.max()) + 1) if len(rows) == np.ptp(rows) + 1 else rows
        return places

    @property
    def first_rows(self) -> list[int]:
        """The first row of each slot."""
        return [here.start for here, _ in self._rows.values()]

    def numbers(self) -> np.ndarray:
        """Numbers of its rows."""
        places = [np.arange(here.start, here.stop) for here, _ in self._rows.values()]
        return np.concatenate([np.zeros(0, int), *places])

    def release(self) -> None:
        """Leaves the rows without any stiffness."""
        for root, filled in self._filled.items() if self.slot else ():
            if filled:
                self._fill(root, 0.0, _MINVAL)
        if self.slot:
            self._filled, self._written = dict.fromkeys(self._rows, False), {}

    def write(self, jacobian: np.ndarray, tangent: np.ndarray, square: np.ndarray) -> None:
        """Puts the stiffness of tangents (ngroup, 6, 6) into the rows, of bodies that accelerations move by
        `square` (ngroup,) [m per m/s^2] in the step."""
        if not self.slot:
            return
        total, group_of = {}, {}
        self._written = {}
        stiff = square[:, None, None] * tangent
        for group in np.flatnonzero(stiff.any(axis=(1, 2))):
            root = self.root[group]
            if root in self.slot:  # bodies that are welded together move as one: their stiffnesses add
                total[root] = (jacobian[group], stiff[group] + (total[root][1] if root in total else 0.0))
                group_of[root] = group
        for root in self._rows:
            if root in total:
                relative, stiff = total[root]
                stiffness, basis = self._modes(root, stiff)
                value = np.maximum(stiffness, _MINVAL)
                rows = basis.T @ relative
                self._fill(root, rows, value)
                self._written[root] = group_of[root], basis, value, rows
            elif self._filled[root]:
                self._fill(root, 0.0, _MINVAL)
            self._filled[root] = root in total

    def _modes(self, root, stiff):
        """Eigenvalues (6,) and vectors of a stiffness: a step begins with that of the last one's end."""
        known, key = self._known.get(root), stiff.tobytes()
        if known is None or known[0] != key:
            stiffness, basis = np.linalg.eigh(stiff)
            known = key, stiffness, basis * (stiffness > 1e-12 * stiffness[-1])
            self._known[root] = known
        return known[1:]

    def excess(self, data: DataView, acceleration: np.ndarray) -> np.ndarray:
        """(ngroup, 6) what the rows push more than their stiffness does under accelerations (nv,) that
        MuJoCo's solver has just found: nothing but rounding, where it converged."""
        out = np.zeros((len(self.body), 6))
        for root, (group, basis, value, rows) in self._written.items():
            out[group] = basis @ (data.efc_force[self._rows[root][0]] + value * (rows @ acceleration))
        return out

    def _fill(self, root, rows, value):
        """Rows (6, nv) or one number for all entries; values (6,) or one for all."""
        here, place = self._rows[root]
        if self._columns is None:
            self._stiff[here.start * self.model.nv : here.stop * self.model.nv] = np.ravel(rows)
        elif np.ndim(rows) == 0:
            count, start, _ = self._columns
            self._stiff[start[here.start] : start[here.stop - 1] + count[here.stop - 1]] = rows
        else:
            count, start, column = self._columns
            for k, row in enumerate(rows, start=here.start):
                a, n = start[k], count[k]
                self._stiff[a : a + n] = row[column[a : a + n]]
        self._weight[here], self._regular[here] = value, 1.0 / value
        if place is not None:
            self._island_weight[place], self._island_regular[place] = value, 1.0 / value
