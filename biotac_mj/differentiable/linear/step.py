"""A step at its balance, linear in all that it depends on: the implicit function theorem.

At the end of a step the forces f on the free nodes balance, f(x, u) = 0, with u all that the step was given.
So dx = K^-1 (df/du) du with the tangent K = -df/dx, and what the step gives out follows. Conjugate
gradients of a forward step take a symmetric tangent; here it is the consistent one, with the friction that
follows the normal force, the curvature of the geoms and the pressure that follows what lies dry on the core.
It is not symmetric, so a cotangent is solved with its transpose, by GMRES (`inverse` makes it short).

Columns of u, one after another: the nodes when the step began, the anchors then, poses of the geoms (a
translation and a rotation vector about the geom's own origin, both in the BioTac frame) when it ended and
began, frictions, areas at rest of outer faces and of those that can meet the core, and `skin.NUMBERS` with
the pressures `offset` and `reference` of `newton.worlds.Worlds`. Rest positions of nodes stand beside them:
they move the rubber's forces (`rest`) and the fixed nodes. So does what points of the rubber remember
(`memory`).
Rows of what comes out: wrenches of the groups, anchors of the samples that touch, the liquid's pressure."""

import numpy as np
import scipy.sparse as sp

from ...geometry.rigid import skew
from ...threads import single_thread
from ..record import Record, restore
from ..skin import NUMBERS, Skin
from ..touching import Held, look
from .inverse import RoughInverse, solve_by_gmres
from .memory import LinearMemory, Memory
from .rest import pull_rest, push_rest
from .samples import of_corners, slopes_of_samples
from .wet import differentiate_push, differentiate_volume

__all__ = ["GIVEN", "LinearStep"]

_SCALARS = (*NUMBERS, "offset", "reference")
GIVEN = ("x_last", "anchor", "pose", "pose_last", "friction", "area", "core_area", *_SCALARS)


class LinearStep:
    """The step of a record, see the module's docstring. What is given has the names of GIVEN:
    x_last (nvert, 3), anchor (nheld, 3), pose and pose_last (ngeom, 6), friction (ngeom,), area and core_area
    (nface,), else numbers.

    Raises:
      ValueError: a linear solve did not come to its end.
    """

    def __init__(self, skin: Skin, record: Record):
        self._skin, self.record = skin, record
        self.n, self.ngeom, self.ngroup = skin.model.nvert, record.geoms.count, record.geoms.ngroup
        sizes = [3 * self.n, 3 * len(record.held.sample), 6 * self.ngeom, 6 * self.ngeom, self.ngeom]
        sizes += skin.surfaces
        sizes += [1] * len(_SCALARS)
        ends = np.cumsum(sizes)
        self._columns = {name: slice(end - size, end) for name, size, end in zip(GIVEN, sizes, ends)}
        self.ngiven = int(ends[-1])
        free = np.zeros(self.n)
        free[skin.model.free] = 1
        self._free = np.repeat(free, 3)
        with single_thread():
            restore(skin, record)
            self.memory = LinearMemory(skin, record) if skin.data.memory else None
            self._contact()
            self._rubber()
            self._liquid()
            self._turn_pushes()
        # compressed once, not at every product
        self._own = {False: self._fx, True: self._fx.T.tocsr()}

    # --- derivatives of the parts ---

    def _contact(self):
        skin, record, model = self._skin, self.record, self._skin.model
        struct = record.geoms.struct
        at = look(skin.data.outer, skin.weights, struct, record.x, record.begun.x, record.held)
        self.touching = at
        slopes, by_x, self._felt_by = self._felt(at, struct)
        self._node = node = _coordinates(at.node)
        self._anchor_by_x = by_x[:, 3:]
        self._fx = _sum([(node, node, _spread(at.weight, by_x[:, :3]))], (3 * self.n, 3 * self.n))
        self._row = 6 * record.geoms.groups[at.geom][:, None] + np.arange(6)
        self._collect, self._wrench_by_x = slopes.collect, slopes.wrench_by_node
        self._core = self._dried = None
        if skin.data.core and (skin.data.core.trial_geom.numpy() >= 0).any():
            core = model.core(1).struct
            there = look(skin.data.core, skin.weights, core, record.x, record.x, Held.none())
            pushed, by_x, by = self._felt(there, core, alone=True)
            k, node = len(there.sample), _coordinates(there.node)
            by_x, by = by_x[:, :3], by[: 3 * k]
            three = _coordinates(np.arange(k)[:, None])
            self._core = there, pushed.own.force, _sum([(three, node, by_x)], (3 * k, 3 * self.n)), by
            self._fx = self._fx + _sum([(node, node, _spread(there.weight, by_x))], self._fx.shape)

    def _felt(self, at, struct, alone=False):
        """Slopes of the samples, and force (BioTac frame) and anchor (geom's) by the nodes of each sample's
        face (m, 6, 9), and by u (6m, ...): all forces, then all anchors. alone: geoms are no input."""
        skin, m = self._skin, len(at.sample)
        springs = self.record.numbers["contact_stiffness"] * at.area
        ratio, smoothing = skin.model.options.stick_ratio, 0.0 if alone else self.record.smoothing
        own = slopes_of_samples(at, struct, springs, ratio, smoothing)
        three = _coordinates(np.arange(m)[:, None])
        rows = np.concatenate([three, three + 3 * m], 1)
        by_x = of_corners(at.weight, own.by_point)
        column = {name: part.start for name, part in self._columns.items()}
        face = (at.sample // len(skin.weights))[:, None]
        surface = skin.data.core.surface if alone else skin.data.outer.surface
        stiffness = self.record.numbers["contact_stiffness"] / len(skin.weights)
        part = at.area * len(skin.weights) / surface.area.numpy()[face[:, 0]]
        area = column["core_area" if alone else "area"]
        blocks = [
            (rows, np.full((m, 1), column["contact_stiffness"]), at.area[:, None, None] * own.by_springs),
            (rows, area + face, stiffness * part[:, None, None] * own.by_springs),
        ]
        if alone or not m:
            return own, by_x, _sum(blocks, (6 * m, self.ngiven))
        six, old, new = 6 * at.geom[:, None] + np.arange(6), own.old, own.new
        blocks += [
            (rows, column["pose"] + six, own.by_pose),
            (rows, column["friction"] + at.geom[:, None], own.by_friction),
            (rows[old], column["anchor"] + _coordinates(at.old[old][:, None]), own.by_stick[old]),
            (rows[new], column["pose_last"] + six[new], own.by_pose_last),
            (rows[new], _coordinates(at.node[new]), of_corners(at.weight[new], own.by_last)),
        ]
        return own, by_x, _sum(blocks, (6 * m, self.ngiven))

    def _rubber(self):
        """Forces of the rubber are homogeneous in both its constants, and linear in the second on either side
        of where points feel no more of it (`Tetrahedra.cap`): two evaluations are exact. What is not, its
        past and its softening, is left to `memory`."""
        skin, numbers = self._skin, self.record.numbers
        mu, lam = numbers["mu"], numbers["lam"]
        with skin.another_lam(mu, lam) as other:
            there = skin.push_virgin_rubber()
        here = skin.virgin_rubber()
        by_lam = (there - here) / (other - lam)
        self._dense = {"lam": by_lam, "mu": (here - lam * by_lam) / mu}

    def _liquid(self):
        """The pressure is p = offset - kappa (V - natural), and pushes by the area vectors G."""
        skin, numbers, model = self._skin, self.record.numbers, self._skin.model
        self._push = self._pressure_by_x = np.zeros(3 * self.n)
        self._pressure_by = np.zeros(self.ngiven)
        self.pressure = 0.0
        if not model.has_liquid:
            return
        world = skin.read("pressure", "volume")
        kappa, reference, k = (numbers[name] for name in ("kappa", "reference", "contact_stiffness"))
        self.pressure, self._push = world["pressure"], skin.data.gradient.numpy()[:, 0].ravel()
        none = np.zeros((0, 3)), np.zeros(0, int)
        core, area = skin.data.core, model.inner.area
        if core:
            none = core.sample_force.numpy()[:, 0], core.trial_geom.numpy()[:, 0]
            area = core.surface.area
        volume = differentiate_volume(
            self.record.x, model.inner.face, model.core_slot, area, model.sample, *none, k, reference
        )
        by_x, by = volume.by_node.ravel(), np.zeros(self.ngiven)
        by[self._columns["contact_stiffness"]] = volume.by_stiffness
        by[self._columns["reference"]] = volume.by_reference
        if core:  # pressures alone count: a larger area is as a smaller force
            areas = self._columns["core_area"]
            lost = (volume.by_force * np.where(none[1][:, None] >= 0, none[0], 0.0)).sum(1)
            by[areas] = -lost.reshape(areas.stop - areas.start, -1).sum(1) / area.numpy()
        if self._core:
            at, force, force_by_x, force_by = self._core
            by_force = volume.by_force[at.sample].ravel()
            by_x, by = by_x + force_by_x.T @ by_force, by + force_by.T @ by_force
            self._dry(at, force, force_by_x, force_by, k, reference)
        self._pressure_by_x, self._pressure_by = -kappa * by_x, -kappa * by
        for name, value in (
            ("offset", 1.0), ("kappa", numbers["natural"] - world["volume"]), ("natural", kappa)
        ):  # fmt: skip
            self._pressure_by[self._columns[name]] += value

    def _dry(self, at, force, force_by_x, force_by, k, reference):
        """What the pressure pushes less where the core dries more of the skin."""
        core, s = self._skin.data.core, len(self._skin.weights)
        face = np.unique(at.sample // s)
        samples = s * face[:, None] + np.arange(s)
        pushes, geom = core.sample_force.numpy()[samples, 0], core.trial_geom.numpy()[samples, 0]
        pushes = np.where(geom[..., None] >= 0, pushes, 0.0)
        node = core.surface.face_np[face]
        corner, area = self.record.x[node], core.surface.area.numpy()[face]
        by_force, by_reference = differentiate_push(
            corner, area, self._skin.model.sample, pushes, geom, k, reference
        )
        m = len(face)
        rows = (3 * node[:, :, None] + np.arange(3)).reshape(m, 9)
        number = np.full(len(core.trial_geom), -1)
        number[at.sample] = np.arange(len(at.sample))
        f, i = np.nonzero(geom >= 0)
        columns = 3 * number[samples[f, i]][:, None] + np.arange(3)
        push = _sum([(rows[f], columns, by_force[f, :, i])], (3 * self.n, 3 * len(at.sample)))
        self._fx = self._fx + self.pressure * (push @ force_by_x)
        by_area = -np.einsum("mnsk,msk->mn", by_force, pushes) / area[:, None]  # as of the volume
        columns = self._columns["core_area"].start + face[:, None]
        self._dried = self.pressure * (
            push @ force_by + _sum([(rows, columns, by_area[..., None])], (3 * self.n, self.ngiven))
        )
        dense = np.zeros(3 * self.n)
        np.add.at(dense, rows, by_reference)
        self._dense["reference"] = self.pressure * dense

    def _turn_pushes(self):
        """The area vectors turn with their faces, where what is wet stays; what contact adds before that is
        known to the approximate inverse as well."""
        pushed, self._inverses = self._fx.tocoo(), {}
        nodes = np.unique(pushed.row // 3)
        self._nodes = nodes[self._free[3 * nodes] > 0]
        size = 3 * len(self._nodes)
        place = np.full(3 * self.n, -1)
        place[(3 * self._nodes[:, None] + np.arange(3)).ravel()] = np.arange(size)
        row, column = place[pushed.row], place[pushed.col]
        known = (row >= 0) & (column >= 0)
        entry = size * row[known] + column[known]
        self._stiff = -np.bincount(entry, pushed.data[known], size * size).reshape(size, size)
        if self.pressure == 0:
            return
        face = self._skin.model.inner.face_np
        corner = self.record.x[face]
        wet = self._skin.solver(self.record.geoms).k.wet.numpy()[:, 0]
        second = 0.5 * skew(corner[:, 2] - corner[:, 0])
        third = -0.5 * skew(corner[:, 1] - corner[:, 0])
        turn = np.concatenate([-second - third, second, third], 2)  # of -(x1 - x0) x (x2 - x0) / 2
        turn = self.pressure * np.einsum("fa,fij->faij", wet, turn).reshape(len(face), 9, 9)
        self._fx = self._fx + self._skin.of_inner_faces.sum(turn)

    # --- solves ---

    def _tangent(self, v, transpose=False):
        """The consistent tangent times v (3 nvert,), zero at fixed nodes."""
        return self._free * self._whole_tangent(self._free * v, transpose)

    def _whole_tangent(self, v, transpose=False):
        """The same with the fixed nodes."""
        left, right = self._push, self._pressure_by_x
        if transpose:
            left, right = right, left
        found = self._skin.multiply_rubber(v) - self._own[transpose] @ v
        if self._skin.model.has_liquid:
            found -= left * (right @ v)
        return found

    def _rough(self, transpose):
        """The approximate inverse, made when first asked for."""
        if transpose not in self._inverses:
            nodes, stiff = self._nodes, self._stiff
            a, b = -self._push * self._free, self._pressure_by_x * self._free
            if transpose:
                stiff, a, b = stiff.T, b, a
            soft = self.record.numbers["softness"]
            self._inverses[transpose] = RoughInverse(self._skin.factors, soft, nodes, stiff, a, b)
        return self._inverses[transpose]

    def solve(self, r: np.ndarray, transpose: bool = False, start: np.ndarray | None = None) -> np.ndarray:
        """K^-1 r, or K^-T r, of r (3 nvert,), from a `start` near it; zero at fixed nodes."""
        with single_thread():
            found, count = solve_by_gmres(
                lambda v: self._tangent(v, transpose),
                self._rough(transpose),
                r * self._free,
                self._skin.precision,
                start,
            )
            self._skin.factors.watch(count, self.record.x)
        return found

    # --- what comes out by what goes in ---

    def pull(
        self,
        x: np.ndarray,
        wrench: np.ndarray,
        pressure: float,
        anchor: np.ndarray,
        shape: bool = False,
        memory: Memory | None = None,
    ) -> dict:
        """Cotangents of what the step was given, from those of what it gives.

        Args:
          x: (nvert, 3). wrench: (ngroup, 6). pressure: a number.
          anchor: (m, 3) of the samples that touch.
          shape: of rest positions too, "vert" (nvert, 3).
          memory: of the rubber when the step has ended; None where it has none. Gives "memory" when it began,
            and "constants" of it.
        """
        wrench = wrench.ravel()[self._row]
        felt = np.einsum("mij,mi->mj", self._wrench_by_x, wrench)
        felt += np.einsum("mij,mi->mj", self._anchor_by_x, anchor)
        g = x.ravel() + pressure * self._pressure_by_x + self._at_nodes(self._node, felt)
        if memory:
            deformation = self.memory.pull_deformation(memory)
            g = g + self.memory.pull_nodes(deformation).ravel()
        balance = self.solve(g, transpose=True)
        pressure = pressure + self._push @ balance
        force = _interpolate(self.touching, balance) + np.einsum("mij,mi->mj", self._collect, wrench)
        given = self._felt_by.T @ np.concatenate([force.ravel(), anchor.ravel()])
        if self._core:
            given = given + self._core[3].T @ _interpolate(self._core[0], balance).ravel()
        if self._dried is not None:
            given = given + self._dried.T @ balance
        given = given + pressure * self._pressure_by
        for name, column in self._dense.items():
            given[self._columns[name]] += column @ balance
        given = self._named(given)
        if memory:
            own = self.memory.pull(memory, balance.reshape(-1, 3))
            given["memory"], given["constants"], moduli = own
            given |= {name: given[name] + slope for name, slope in moduli.items()}
        if shape:
            held = (1 - self._free) * (g - self._whole_tangent(balance, transpose=True))
            by_rubber = pull_rest(self._skin, self.record.x, balance.reshape(-1, 3))
            given["vert"] = held.reshape(-1, 3) + by_rubber
            if memory:
                given["vert"] = given["vert"] + self.memory.pull_rest(deformation)
        return given

    def push(
        self,
        given: dict,
        vert: np.ndarray | None = None,
        memory: Memory | None = None,
        constants: np.ndarray | None = None,
        near: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, float, np.ndarray, Memory | None]:
        """Tangents of what the step gives, as `pull` names them, from those of what it was given, of rest
        positions (nvert, 3), of what the rubber remembered and of that memory's constants; what is not named
        does not change. near: (nvert, 3) a guess of the nodes' tangents."""
        u = np.zeros(self.ngiven)
        for name, value in given.items():
            u[self._columns[name]] = np.ravel(value)
        pressure = self._pressure_by @ u
        felt = (self._felt_by @ u).reshape(2, -1, 3)
        force = self._push * pressure + self._at_nodes(
            self._node, _spread(self.touching.weight, felt[0, :, :, None])
        )
        if self._core:
            pushed = (self._core[3] @ u).reshape(-1, 3, 1)
            force += self._at_nodes(_coordinates(self._core[0].node), _spread(self._core[0].weight, pushed))
        if self._dried is not None:
            force += self._dried @ u
        for name, column in self._dense.items():
            force = force + column * u[self._columns[name]]
        if memory:
            moduli = {name: float(given.get(name, 0.0)) for name in ("mu", "lam")}
            force = force + self.memory.push_force(memory, constants, moduli).ravel()
        held = np.zeros(3 * self.n)
        if vert is not None:
            held = (1 - self._free) * vert.ravel()
            force = force + push_rest(self._skin, self.record.x, vert).ravel() - self._whole_tangent(held)
        x = self.solve(force, start=None if near is None else near.ravel() * self._free) + held
        if memory:
            memory = self.memory.push(memory, constants, moduli, x.reshape(-1, 3), vert)
        corner = x[self._node]
        wrench = np.einsum("mij,mj->mi", self._wrench_by_x, corner)
        wrench += np.einsum("mij,mj->mi", self._collect, felt[0])
        return (
            x.reshape(-1, 3),
            np.bincount(self._row.ravel(), wrench.ravel(), 6 * self.ngroup).reshape(-1, 6),
            float(pressure + self._pressure_by_x @ x),
            felt[1] + np.einsum("mij,mj->mi", self._anchor_by_x, corner),
            memory,
        )

    def _at_nodes(self, node, value):
        """(3 nvert,) sums of values by the coordinates `node`, both of one size."""
        return np.bincount(node.ravel(), value.ravel(), 3 * self.n)

    def _named(self, u):
        shapes = {"x_last": (-1, 3), "anchor": (-1, 3), "pose": (-1, 6), "pose_last": (-1, 6)}
        shapes |= dict.fromkeys(("friction", "area", "core_area"), (-1,)) | dict.fromkeys(_SCALARS, ())
        return {name: u[self._columns[name]].reshape(shapes[name]) for name in GIVEN}


def _coordinates(number):
    """(m, 3k) places of the coordinates of what has these numbers (m, k)."""
    return (3 * number[:, :, None] + np.arange(3)).reshape(len(number), 3 * number.shape[1])


def _spread(weight, block):
    """(m, 9, c) on the corners of faces, of blocks (m, 3, c) on a point of theirs."""
    return (weight[:, :, None, None] * block[:, None]).reshape(len(block), 9, block.shape[2])


def _sum(blocks, shape):
    """Sparse sum of dense blocks: tuples of rows (m, r), columns (m, c) and values (m, r, c)."""
    parts = [np.broadcast_arrays(r[:, :, None], c[:, None, :], v) for r, c, v in blocks]
    row, column, value = (np.concatenate([part[i].ravel() for part in parts]) for i in range(3))
    return sp.csr_matrix((value, (row, column)), shape=shape)


def _interpolate(at, v):
    """(m, 3) at the samples' points, of nodes (3 nvert,)."""
    return np.einsum("ma,mak->mk", at.weight, v.reshape(-1, 3)[at.node])
