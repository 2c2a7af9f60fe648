"""One skin of the condensed tier on the CPU, as a function of its state and the geoms' poses.

The step is that of many worlds (`step`). A single skin also loads any state, moves geoms that are too deep in
the core out of it one by one, and is solved again with geoms that come straight from outside if the first
solve does not converge."""

import dataclasses
import math
import typing

import numpy as np
import warp as wp

from ..bodies import BodyMotion, uncoupled_geoms
from ..contact.faces import NormalForces
from ..contact.proximity import ProximityQuery
from ..data import SkinData
from ..geoms import GeomSet
from ..newton.worlds import CONVERGED
from ..program import Program
from ..state import CONDENSED
from ..state_arrays import StateArrays
from .linear import LinearSkin
from .memory import MAX_CONTACTS, MAX_FORCES, Memory, Outcome, layout_of
from .refusals import refuse
from .step import CondensedStep, Room
from .structs import Remembered

if typing.TYPE_CHECKING:
    from ..model import SkinModel


_OF_BODIES = "compliance", "predicted", "origin", "arm", "spin"
_VIEWS = 16  # stored views of the broad phase, for several BioTacs that share a skin
_FAR = 1e-3  # motion above which geoms that leave the skin are not followed [m]
_LEVER = 1e-2  # lever arm of rotations, about the size of a fingertip [m]
_EFFORT = 1200.0  # limit of the first solve of a step, in evaluations: about 0.25 s on the coarse skin


class CondensedSkin:
    """One skin of the condensed tier and the geoms that touch it.

    Args:
      model: SkinModel on the CPU, quasi-static.
      geoms: GeomSet of one world.
      cache: whether to cache the compliance on disk (see `compliance`).
      patience: limit of the cost of a difficult step over `_EFFORT`; then it ends before its poses.

    Raises:
      ValueError: unsupported settings, see `refusals`.
    """

    def __init__(self, model: "SkinModel", geoms: GeomSet, cache: bool = True, patience: float = 2.5):
        refuse(model.material.extensions, model.options, model.has_liquid, model.device.is_cuda)
        self.model, self.geoms, self.linear = model, geoms, LinearSkin.of(model, cache)
        self._first = patience * _EFFORT
        self.rest = model.rest.vert.astype(float)
        self._data = SkinData(model, tier=CONDENSED)
        self.proximity = ProximityQuery(model, geoms, self._data.laws.struct)
        room = Room(MAX_FORCES // 3, MAX_CONTACTS, views=_VIEWS)
        self._step = step = CondensedStep(model, self.linear, self._data, geoms, room, geoms.ngroup)
        tangent = wp.zeros((geoms.ngroup, 1), dtype=wp.spatial_matrixd, device="cpu")
        self._tangent = tangent.numpy()
        self._run = Program("cpu", lambda program: step.launch(tangent, program)).run
        self._normal_forces = NormalForces(step.touch, geoms.struct, self._data.x)
        self._recall = Program("cpu", step.recall).run
        self._state = StateArrays(self._data, geoms, CONDENSED, layout_of(geoms.count), **step.holders)
        self._nodes, self._views = {}, self._view()
        previous, balance = step.previous, step.previous.balance
        arrays = {name: getattr(balance, name) for name in Remembered.vars}
        arrays |= {"pos": previous.pos, "mat": previous.mat, "begins": previous.begins}
        self._previous = {name: a.numpy()[:, 0] if a.ndim == 2 else a.numpy() for name, a in arrays.items()}
        self._held = None  # contents of the state that the arrays hold
        g = geoms.struct
        free = [wp.zeros_like(g.pos), wp.zeros_like(g.mat)]
        known = [step.bodies, g.group, g.pos, g.mat]
        self._uncouple = Program("cpu", lambda p: p.launch(uncoupled_geoms, g.pos.shape, known, free)).run
        self._uncoupled = [array.numpy()[:, 0] for array in free]

    def _view(self):
        """Numpy views of the world's arrays that a solve reads and writes besides its state."""
        d, g = self._data, self.geoms.struct
        _, touched_by, wrench = d.geom_memory(self.geoms.count, self.geoms.ngroup)
        of_items = {"x": d.x, "x_last": d.x_last, "node_force": d.outer.node_force, "wrench": wrench}
        of_items["slack"] = self._step.slack
        of_items |= {"sample_force": d.outer.sample_force, "touched_by": touched_by}
        of_items |= {name: getattr(g, name) for name in ("pos", "mat")}
        out = {name: array.numpy()[:, 0] for name, array in of_items.items()}
        scalars = {"most": self._step.most, "spent": self._step.spent}
        scalars |= {"tier": self._step.tier, "load_factor": d.worlds.load_factor}
        scalars |= {name: getattr(d.worlds, name) for name in ("iterations", "error", "reason")}
        bodies = self._step.bodies
        scalars |= {name: getattr(bodies, name) for name in _OF_BODIES}
        return out | {name: array.numpy() for name, array in scalars.items()}

    # --- a step  ---

    def solve(
        self,
        memory: Memory,
        geom_pos: np.ndarray,
        geom_mat: np.ndarray,
        allowed: float = 1.0,
        bodies: BodyMotion | None = None,
        near: Memory | None = None,
    ) -> Outcome:
        """Solves for poses (ngeom, 3) [m], (ngeom, 3, 3) at the end of the step; a pure function of its
        arguments.

        If that fails, the geoms are followed in load increments. Geoms without an earlier pose come from
        `outside`. The outcome is valid for the poses in its memory, which are the given ones if `load_factor`
        is 1. Geoms that are so deep inside the core that no skin fits are followed until it does not;
        `load_factor` is then the fraction of their path into the skin.

        Args:
          allowed: fraction of the limit by `patience`.
          bodies: compliance of the geoms' bodies; the outcome is then valid for the poses in its memory, to
            which its wrenches move the bodies. None: poses are prescribed.
          near: an equilibrium for similar poses, found from the same memory, at which Newton's method begins;
            with `bodies` alone.

        Raises:
          ValueError: NaN in a pose.
        """
        if not (math.isfinite(np.sum(geom_pos)) and math.isfinite(np.sum(geom_mat))):
            raise ValueError(
                "geom poses contain NaN or infinite numbers: the simulation has diverged or a pose was "
                "never set"
            )
        pos, mat, most, v = np.asarray(geom_pos), np.asarray(geom_mat), allowed * self._first, self._views
        v["compliance"][:] = v["predicted"][:] = 0.0
        if bodies is not None:
            v["compliance"][:, :, 0], v["predicted"][:, 0] = bodies.compliance, bodies.wrench
            v["origin"][:, 0], v["arm"][:, 0], v["spin"][:, 0] = bodies.pos, bodies.arm, bodies.spin
        self.proximity.pose(pos, mat)
        free_pose = pos, mat
        if bodies is not None:  # where the bodies go without the skin
            self._uncouple()
            free_pose = tuple(view.copy() for view in self._uncoupled)
        if not memory.started:  # as in the full tier: friction acts from the first touch on
            memory = self.outside(*free_pose)
        elif not len(memory.forces):
            pos0, mat0 = self.proximity.met(memory.geom_pos, memory.geom_mat, *free_pose)
            if (pos0 != memory.geom_pos).any() or (mat0 != memory.geom_mat).any():
                memory = memory.replace(geom_pos=pos0, geom_mat=mat0)
        if bodies is not None or not self.proximity.deep(pos, mat):
            return self._follow(memory, pos, mat, free_pose, most, near)
        shallow, outside = self.proximity.shallow(pos, mat), self.proximity.outside(pos, mat)
        fraction = min(np.linalg.norm(shallow - outside) / max(np.linalg.norm(pos - outside), 1e-12), 1.0)
        out = self._follow(memory, shallow, mat, (shallow, mat), most)
        return dataclasses.replace(out, converged=False, load_factor=fraction * out.load_factor)

    def _follow(self, memory, pos, mat, free_pose, most, near=None):
        """Solves for poses that are not too deep. free_pose: (pos, mat) without the skin. most: limit of the
        cost, in evaluations."""
        motion, turned = free_pose[0] - memory.geom_pos, np.abs(mat - memory.geom_mat).max(initial=0.0)
        far = np.abs(motion).max(initial=0.0) + _LEVER * turned
        if not len(memory.forces) or far > _FAR:
            if self.proximity.clear(*free_pose):  # the geoms do not touch the skin, or leave it
                return self.at_rest(*free_pose)
        out = self._solve(memory, pos, mat, most, near)
        if not out.converged and self.proximity.clear(*free_pose):
            return dataclasses.replace(self.at_rest(*free_pose), cost=out.cost)
        return out

    def _solve(self, memory, pos, mat, most, near):
        """Solves from a state to poses, as far as possible."""
        v = self._views
        self._load(memory)
        if near is not None:
            self._begin_at(near)
        v["pos"][:], v["mat"][:], v["most"][0] = pos, mat, most
        v["tier"][0] = -1  # without an equilibrium the error is not known
        self._run()
        load_factor, nodes = float(v["load_factor"][0]), v["x"].copy()
        if load_factor > 0:
            memory = Memory(self._state.save_row(), memory.layout)
            memory.layout.part(memory.row, "started")[:] = 1.0
            self._held = memory.layout.key(memory.row)
            self._keep(self._held, nodes)
        push = v["sample_force"][memory.contacts[:, 0].astype(int)]
        return Outcome(
            memory=memory,
            wrench=v["wrench"].copy(),
            tangent=self._tangent[:, 0].copy(),
            vert_xpos=nodes,
            measured=v["tier"][0] > 0,
            converged=v["reason"][0] == CONVERGED,
            iterations=int(v["iterations"][0]),
            error=float(v["error"][0]),
            load=np.sqrt((push * push).sum(axis=1)),
            load_factor=load_factor,
            cost=float(v["spent"][0]) / self._first,
            slack=v["slack"].copy(),
        )

    def _load(self, memory):
        """Loads a state."""
        v, before = self._views, memory.layout.key(memory.row)
        if before != self._held:  # as a rule a step begins where the last one of this skin has ended
            nodes = self.nodes(memory, before)
            self._state.load_row(memory.row)
            v["x"][:] = nodes
        self._held = None
        v["x_last"][:] = v["x"]
        # what no candidate writes
        v["node_force"][:] = 0.0

    def _begin_at(self, near):
        """Lets the next solve begin at an equilibrium."""
        v, outer = self._previous, near.coordinate < 3 * len(self.linear.node)
        v["force"][:] = v["core_force"][:] = 0.0
        v["force"].reshape(-1)[near.coordinate[outer]] = near.force[outer]
        v["core_force"][near.coordinate[~outer] - 3 * len(self.linear.node)] = near.force[~outer]
        v["pressure"][0], v["bulge"][0] = near.pressure, near.bulge
        v["solved"][0], v["after"][0] = near.solved, near.after
        v["pos"][:], v["mat"][:], v["begins"][0] = near.geom_pos, near.geom_mat, 1

    # --- at rest, and near it  ---

    def at_rest(self, pos: np.ndarray, mat: np.ndarray) -> Outcome:
        """Outcome for geoms at these poses, which do not touch the skin."""
        memory, n = Memory.rest(self.geoms.count), self.geoms.ngroup
        memory = memory.replace(started=1.0, geom_pos=pos, geom_mat=mat)
        still = np.zeros((n, 6)), np.zeros((n, 6, 6)), self.rest.copy()
        return Outcome(memory, *still, True, True, 0, 0.0, np.zeros(0))

    def outside(self, pos: np.ndarray, mat: np.ndarray) -> Memory:
        """State without contact: geoms at positions (ngeom, 3) [m] and rotations (ngeom, 3, 3) are moved out
        of the skin."""
        out = self.proximity.outside(pos, mat)
        return self.at_rest(out, mat).memory

    # --- what a memory says  ---

    def nodes(self, memory: Memory, contents: bytes = b"") -> np.ndarray:
        """Nodes (nvert, 3) of a state [m]; read only. contents: of the memory, if they are known."""
        if not len(memory.forces) and memory.pressure == 0:
            return self.rest
        contents = contents or memory.layout.key(memory.row)
        found = self._nodes.get(contents)
        if found is None:
            self._state.load_row(memory.row)
            self._held = None
            self._views["x"][:] = self.rest
            self._recall()
            found = self._views["x"].copy()
            self._keep(contents, found)
        return found

    def _keep(self, contents, nodes):
        if len(self._nodes) > 16:
            self._nodes.clear()
        self._nodes[contents] = nodes

    def contact_force(self, memory: Memory) -> np.ndarray:
        """Forces (nvert, 3) of the geoms on the nodes [N]."""
        out, outer = np.zeros((self.model.nvert, 3)), memory.coordinate < 3 * len(self.linear.node)
        node, axis = np.divmod(memory.coordinate[outer], 3)
        out[self.linear.node[node], axis] = memory.force[outer]
        return out

    def normal_force_of_faces(self, memory: Memory, touched: np.ndarray) -> np.ndarray:
        """Normal forces (nface,) of the geoms on the outer faces [N]. touched: (n,) indices of the faces that
        are evaluated; the others get 0."""
        v, self._held = self._views, None
        v["x"][:], v["pos"][:], v["mat"][:] = self.nodes(memory), memory.geom_pos, memory.geom_mat
        return self._normal_forces(touched)
