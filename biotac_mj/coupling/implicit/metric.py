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

from collections.abc import Sequence

import mujoco
import numpy as np
import warp as wp

from ...skin.types import real, vec6
from ..structs import MINVAL, DataView, ModelView
from ..touching import Touching
from .kinematics import row
from .rows import ROWS, write_rows

_EQUALITY = int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
_NEVER = int(mujoco.mjtSleepPolicy.mjSLEEP_NEVER)
_NEEDED = {
    name: int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}")) for name in ("constraint", "equality")
}
_PLAIN = 1.0, 0.0, 1.0, 0.0  # of a row: stiffness, damping, impedance, its derivative


def assign_slots(model: ModelView, touching: Touching, slots: list[int]) -> dict[int, int]:
    """Gives each body that can touch a BioTac one of its slots: {root of the body's weld: equality}.

    Raises:
      ValueError: there are fewer slots than bodies that can touch.
    """
    core, tree, (_, needed) = touching.core, model.body_treeid, roots_of(model, touching)
    if len(needed) > len(slots):
        raise ValueError(
            f"{len(needed)} bodies can touch the BioTac {model.name('body', core)!r} but it has "
            f"room for {len(slots)}: give slots={len(needed)} to attach or tasks.BioTac, attach it to a "
            "spec that has the objects, or name the geoms that may touch with geoms=[...]"
        )
    out = dict(zip(needed, slots))
    for root, slot in out.items():
        model.eq_obj1id[slot], model.eq_obj2id[slot] = core, root
        model.eq_active0[slot] = 1
    # MuJoCo does not see what the skin carries: a body asleep has no rows and would not be woken
    for t in {int(tree[b]) for b in (core, *out)} - {-1}:
        model.tree_sleep_policy[t] = _NEVER
    return out


def roots_of(model: ModelView | mujoco.MjModel, touching: Touching) -> tuple[list[int], list[int]]:
    """Root of the weld of each body that can touch, 0: the world; and those that move against the BioTac, in
    order, each of which needs a slot."""
    body, tree = touching.body, model.body_treeid
    roots = np.where(tree[body] >= 0, model.body_weldid[body], 0).tolist()
    return roots, [root for root in sorted(set(roots)) if root or tree[touching.core] >= 0]


class Metric:
    """The rows between the BioTacs of an mjData and the bodies that can touch them.

    Args:
      touchings: of the BioTacs. slots: of each, see `assign_slots`.
      stiffness: by how much accelerations move the bodies in the step [body, world] [m per m/s^2], their
        Jacobians, and the skins' stiffnesses against them.

    Attributes:
      first: number of the first row of each slot; numbers: of all rows.
    """

    def __init__(
        self,
        model: ModelView,
        touchings: Sequence[Touching],
        slots: Sequence[dict[int, int]],
        stiffness: tuple[wp.array, wp.array, wp.array],
    ):
        self._model, self._slot_of = model, []
        self._slots = np.array([slot for one in slots for slot in one.values()], dtype=np.int64)
        count = 0
        for touching, one in zip(touchings, slots):
            place = {root: count + k for k, root in enumerate(one)}
            self._slot_of += [place.get(root, -1) for root in roots_of(model, touching)[0]]
            count += len(one)
        self._layout, self._filled, self._held = None, False, None
        self.first, self.numbers = np.zeros(0, int), np.zeros(0, int)
        n = 6 * count
        with wp.ScopedDevice("cpu"):
            held, basis = ROWS[real](), wp.zeros((n, 1), dtype=vec6)
            held.J, held.D = wp.zeros((1, n, model.nv), dtype=real), wp.zeros((1, n), dtype=real)
            held.pos = held.aref = wp.zeros_like(held.D)
            first = wp.array(np.arange(0, n, 6, dtype=np.int32)[:, None], dtype=int)
            square, jacobian, tangent = stiffness
            known = [square, wp.array(np.array(self._slot_of, np.int32), dtype=int), first, jacobian, tangent]
        self._find_stiffness = row((write_rows, (count, 1, 1), [*known, 1, held, basis]))
        self._J, self._D, self._basis = held.J.numpy()[0], held.D.numpy()[0], basis.numpy().reshape(-1, 6, 6)

    def switch_on(self, data: DataView) -> bool:
        """Activates the constraint slots. Returns whether one was inactive, so that MuJoCo has to build its
        rows again.

        Raises:
          ValueError: the model's flags leave no room for them.
        """
        if not len(self._slots):
            return False
        off = [name for name, flag in _NEEDED.items() if self._model.opt.disableflags & flag]
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
        """Finds this step's rows, which MuJoCo has made, and takes their own meaning from them, and their
        reference accelerations.

        They lie in the arena: none is made again after this.
        """
        if len(self._slots):
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
            if self._model.is_sparse:
                mine, column = self.numbers, rows.efc_J_colind
                count, start = rows.efc_J_rownnz[mine], rows.efc_J_rowadr[mine]
                at = np.arange(count.sum()) + np.repeat(start - np.cumsum(count) + count, count)
                self._entries = rows.efc_J, at, (np.repeat(np.arange(len(mine)), count), column[at])
            else:
                self._entries = rows.efc_J.reshape(-1, self._model.nv), self._all, slice(None)
            self._filled, self._held = True, None  # by MuJoCo
        data.reference_constraints()  # of all rows
        if len(self._slots):
            # MuJoCo has added dJ/dt v of the weld that a row was: the position takes it off again
            rows.efc_pos[self._all] += rows.efc_aref[self._all]

    def _find(self, ids, kinds):
        model, first = self._model, []
        for slot in self._slots.tolist():
            index = np.flatnonzero((ids == slot) & (kinds == _EQUALITY))
            if len(index) != 6:
                raise ValueError(
                    f"MuJoCo made {len(index)} of the 6 constraint rows between the BioTac and body "
                    f"{model.name('body', model.eq_obj2id[slot])!r}: does that body sleep, or was the "
                    "BioTac's equality constraint changed?"
                )
            first.append(int(index[0]))
        self.first = np.array(first)
        self.numbers = rows = (self.first[:, None] + np.arange(6)).ravel()
        # neighbours as a rule; a slice is written faster than numbered rows
        near = (np.diff(rows) == 1).all()
        self._all = slice(int(rows[0]), int(rows[-1]) + 1) if near else rows

    def release(self) -> None:
        """Leaves the rows without any stiffness."""
        if self._filled:
            self._fill(0.0, MINVAL)
        self._filled, self._held = False, None

    def write(self, bodies: np.ndarray) -> None:
        """Puts the present stiffness into the rows; bodies: those that it holds."""
        if not len(self._slots):
            return
        self._find_stiffness()
        self._fill(self._J, self._D)
        held = {self._slot_of[g]: g for g in bodies.tolist() if self._slot_of[g] >= 0}
        self._filled, self._held = True, held

    def excess(self, acceleration: np.ndarray) -> np.ndarray:
        """Forces (nbody, 6) of the rows beyond those of their stiffness under accelerations (nv,) that
        MuJoCo's solver has just found: rounding errors, if it converged."""
        out = np.zeros((len(self._slot_of), 6))
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
