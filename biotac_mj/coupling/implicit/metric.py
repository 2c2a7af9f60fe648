"""The skin's stiffness in MuJoCo's dynamics: rows of constraints that add beta h^2 J' S J to the inertia,
across kinematic trees.

The force of the skin is W - beta h^2 S J a, with W its linear model at the pose reached without acceleration,
S = -dW/dx and J the Jacobian of the touching body relative to the BioTac. W goes into `qfrc_passive`. The
rest is exactly what a constraint row with regularisation R = 1 / (beta h^2 s) and reference
acceleration zero gives, one row for each of the six pivots s of S = L D L'. So MuJoCo's solver finds the
accelerations of object and finger together, with every other contact and limit. The rows' forces are equal
and opposite whatever the masses, and zero at rest, where a = 0. `docs/lab/coupling.md` compares this with the
alternatives.

`attach` leaves inactive weld constraints in the model ("slots") to make room for the rows; each body that can
touch gets one."""

import mujoco
import numpy as np
import warp as wp

from ...skin.types import real, vec6
from ..structs import MINVAL, DataView, ModelView
from ..touching import Touching
from .kinematics import row
from .rows import write_rows

_EQUALITY = int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
_NEVER = int(mujoco.mjtSleepPolicy.mjSLEEP_NEVER)
_NEEDED = {
    name: int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}")) for name in ("constraint", "equality")
}
_PLAIN = 1.0, 0.0, 1.0, 0.0  # of a row: stiffness, damping, impedance, its derivative


class Metric:
    """The rows between the BioTac's body and the bodies that can touch it.

    Attributes:
      first: number of the first row of each slot; numbers: of all rows.

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
                f"room for {len(slots)}: give slots={len(needed)} to attach or tasks.BioTac, attach it to a "
                "spec that has the objects, or name the geoms that may touch with geoms=[...]"
            )
        self.root = roots
        self._layout, self._filled, self._held = None, False, None
        self.first, self.numbers = [], np.zeros(0, int)
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

    def record(self, square: wp.array, jacobian: wp.array, tangent: wp.array) -> None:
        """Makes the launch that finds rows of stiffnesses [group, world] against bodies with these Jacobians,
        which accelerations move by `square` in the step [m per m/s^2]."""
        slots, nv = list(self.slot), jacobian.shape[2]
        self._slot_of = [slots.index(root) if root in self.slot else -1 for root in self.root]
        n = 6 * len(slots)
        with wp.ScopedDevice("cpu"):
            J, D = wp.zeros((1, n, nv), dtype=real), wp.zeros((1, n), dtype=real)
            basis, unused = wp.zeros((n, 1), dtype=vec6), wp.zeros((1, n), dtype=real)
            first = wp.array(np.arange(0, n, 6, dtype=np.int32)[:, None], dtype=int)
            known = [square, wp.array(np.array(self._slot_of, np.int32), dtype=int), first, jacobian, tangent]
            none = [wp.zeros((1,) * ndim, dtype=int) for ndim in (2, 2, 3)]
        self._find_stiffness = row(
            (write_rows, (len(slots), 1, nv), [*known, 0, *none, J, D, unused, unused, basis])
        )
        self._J, self._D, self._basis = J.numpy()[0], D.numpy()[0], basis.numpy().reshape(-1, 6, 6)

    def find_rows(self, data: DataView) -> None:
        """Finds this step's rows, which MuJoCo has made, and takes their own meaning from them. MuJoCo has to
        make their reference accelerations again before `take_references`.

        They lie in the arena: none is made again after this.
        """
        if not self.slot:
            return
        rows = self._rows = data.rows()
        ids, kinds = rows.efc_id[: data.ne], rows.efc_type[: data.ne]
        layout = ids.tobytes(), kinds.tobytes()
        if layout != self._layout:  # it rarely changes
            self._find(ids, kinds)
            self._layout = layout
        rows.efc_KBIP[self._all] = _PLAIN
        rows.efc_pos[self._all] = rows.efc_margin[self._all]
        self._weights = [(rows.efc_D, rows.efc_R, self._all)]
        if data.nisland:
            self._weights.append((rows.iefc_D, rows.iefc_R, rows.map_efc2iefc[self._all]))
        if self.model.is_sparse:
            mine, column = self.numbers, rows.efc_J_colind
            count, start = rows.efc_J_rownnz[mine], rows.efc_J_rowadr[mine]
            at = np.arange(count.sum()) + np.repeat(start - np.cumsum(count) + count, count)
            self._entries = rows.efc_J, at, (np.repeat(np.arange(len(mine)), count), column[at])
        else:
            self._entries = rows.efc_J.reshape(-1, self.model.nv), self._all, slice(None)
        self._filled, self._held = True, None  # by MuJoCo

    def take_references(self) -> None:
        """Makes the reference accelerations of its rows zero. MuJoCo adds dJ/dt v of the weld that a row was:
        the position takes it off again."""
        if self.slot:
            self._rows.efc_pos[self._all] += self._rows.efc_aref[self._all]

    def _find(self, ids, kinds):
        self.first = []
        for root, slot in self.slot.items():
            index = np.flatnonzero((ids == slot) & (kinds == _EQUALITY))
            if len(index) != 6:
                raise ValueError(
                    f"MuJoCo made {len(index)} of the 6 constraint rows between the BioTac and body "
                    f"{self.model.name('body', root)!r}: does that body sleep, or was the BioTac's equality "
                    "constraint changed?"
                )
            self.first.append(int(index[0]))
        self.numbers = rows = (np.array(self.first)[:, None] + np.arange(6)).ravel()
        # neighbours as a rule; a slice is written faster than numbered rows
        near = (np.diff(rows) == 1).all()
        self._all = slice(int(rows[0]), int(rows[-1]) + 1) if near else rows

    def release(self) -> None:
        """Leaves the rows without any stiffness."""
        if self.slot and self._filled:
            self._fill(0.0, MINVAL)
        self._filled, self._held = False, None

    def write(self, groups: np.ndarray) -> None:
        """Puts the present stiffness into the rows; groups: those of the bodies that it holds."""
        if not self.slot:
            return
        self._find_stiffness()
        self._fill(self._J, self._D)
        held = {self._slot_of[g]: g for g in groups.tolist() if self._slot_of[g] >= 0}
        self._filled, self._held = True, held

    def excess(self, acceleration: np.ndarray) -> np.ndarray:
        """Forces (ngroup, 6) of the rows beyond those of their stiffness under accelerations (nv,) that
        MuJoCo's solver has just found: rounding errors, if it converged."""
        out = np.zeros((len(self.body), 6))
        if self._held:  # bodies that are welded together move as one
            push = self._rows.efc_force[self._all] + self._D * (self._J @ acceleration)
            wrench = (push.reshape(-1, 1, 6) @ self._basis)[:, 0]
            out[list(self._held.values())] = wrench[list(self._held)]
        return out

    def _fill(self, rows, weight):
        """Rows (n, nv) and their weights (n,), or one number for all."""
        jacobian, at, part = self._entries
        jacobian[at] = rows[part] if np.ndim(rows) else rows
        for weights, regular, where in self._weights:
            weights[where], regular[where] = weight, 1.0 / weight
