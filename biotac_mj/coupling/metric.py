"""The skin's stiffness in MuJoCo's dynamics: rows of constraints that add h^2 J' S J to the inertia, across kinematic trees.

The force of the skin at the end of the step is W - h^2 S J a, with W its linear model at the pose reached without acceleration, S = -dW/dx and J
the Jacobian of the touching body relative to the BioTac. W goes into `qfrc_passive`. The rest is
exactly what a constraint row with regularisation R = 1 / (h^2 s) and reference acceleration zero gives, one row for each of the six
eigenvalues s of S. MuJoCo's solver so finds the accelerations of object and finger together, with every other contact and limit: equal
and opposite forces whatever the masses, nothing at rest, where a = 0. `docs/coupling.md` compares this with the alternatives.

`attach` leaves inactive weld constraints in the model ("slots") to make room for the rows; each body that can touch gets one.
"""

import mujoco
import numpy as np

__all__ = ["Metric"]

_MINVAL = 1e-15  # mjMINVAL


class Metric:
    """The rows between the BioTac's body and the bodies that can touch it.

    Raises:
      ValueError: the model has fewer slots than bodies that can touch.
    """

    def __init__(self, model, touching, slots):
        self.model, self.core = model, touching.core
        self.body = touching.body
        tree = model.body_treeid
        roots = [int(model.body_weldid[b]) if tree[b] >= 0 else 0 for b in self.body]
        needed = sorted({root for root in roots if root or tree[self.core] >= 0})
        if len(needed) > len(slots):
            raise ValueError(
                f"{len(needed)} bodies can touch the BioTac {model.name('body', self.core)!r} but it has room for {len(slots)}: "
                "attach it after adding the objects, pass attach(slots=...), or name the geoms that may touch with attach(geoms=[...])"
            )
        self.root = roots
        self.slot = dict(zip(needed, slots))
        for root, slot in self.slot.items():
            model.eq_obj1id[slot], model.eq_obj2id[slot] = self.core, root
            model.eq_active0[slot] = 1

    def jacobians(self, data):
        """(ngroup, 6, nv) of the touching bodies relative to the BioTac, about the origin of its frame and in that frame."""
        frame = data.xmat[self.core].reshape(3, 3)
        origin = np.ascontiguousarray(data.xpos[self.core])
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = frame.T
        own = data.jacobian(self.core, origin)
        return np.stack([turn @ (data.jacobian(int(b), origin) - own) for b in self.body]) if len(self.body) else np.zeros((0, 6, self.model.nv))

    def write(self, data, jacobian, tangent, horizon):
        """Puts the stiffness of tangents (ngroup, 6, 6) over `horizon` [s] into the rows."""
        if not self.slot:
            return
        rows = {}
        for group in np.flatnonzero(tangent.any(axis=(1, 2))) if horizon else ():
            root = self.root[group]
            if root in self.slot:  # bodies that are welded together move as one: their stiffnesses add
                rows[root] = (jacobian[group], tangent[group] + (rows[root][1] if root in rows else 0.0))
        self._write(data, rows, horizon)

    def _write(self, data, rows, horizon):
        model = self.model
        ids = data.efc_id[: data.ne]
        kinds = data.efc_type[: data.ne]
        equality = int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        stiff, sparse = data.efc_J, model.is_sparse
        weight, regular, pos, gains = data.efc_D, data.efc_R, data.efc_pos, data.efc_KBIP
        if sparse:
            count, start, column = data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind
        islands = data.nisland
        if islands:
            place, island_weight, island_regular = data.map_efc2iefc, data.iefc_D, data.iefc_R
        for root, slot in self.slot.items():
            index = np.flatnonzero((ids == slot) & (kinds == equality))
            if len(index) != 6:
                raise ValueError("two-way coupling needs MuJoCo's equality constraints: enable the flags constraint and equality, or use coupling='one-way'")
            first = index[0]
            here = slice(first, first + 6)
            jacobian, value = np.zeros((6, model.nv)), np.full(6, _MINVAL)
            if root in rows:
                relative, tangent = rows[root]
                stiffness, basis = np.linalg.eigh(0.5 * (tangent + tangent.T))
                used = stiffness > 1e-12 * max(stiffness[-1], 0.0)
                jacobian[used] = basis.T[used] @ relative
                value[used] = np.maximum(horizon * horizon * stiffness[used], _MINVAL)
            if sparse:
                for k in range(6):
                    a, n = start[first + k], count[first + k]
                    stiff[a : a + n] = jacobian[k, column[a : a + n]]
            else:
                stiff[first * model.nv : (first + 6) * model.nv] = jacobian.ravel()
            weight[here], regular[here], pos[here] = value, 1.0 / value, 0.0
            gains[here] = (0.0, 0.0, 1.0, 0.0)  # stiffness, damping, impedance, its derivative: reference acceleration 0
            if islands:
                island_weight[place[here]], island_regular[place[here]] = value, 1.0 / value
