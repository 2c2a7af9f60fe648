"""Launches for bodies that give way: what Newton's method of the full tier asks of them (`newton.bodies`)."""

import warp as wp

from .contact.posed import LoadPath
from .forces import Forces
from .newton import bodies
from .program import Launcher
from .types import real, vec3

__all__ = ["CompliantBodies"]


class CompliantBodies:
    """The bodies of the worlds that `forces` are of."""

    def __init__(self, forces: Forces):
        self._forces, self._k, self._data = forces, forces.k, forces.d
        self._kernels = bodies.bodies_kernels(self._data.precision)
        n, w = forces.geoms.ngroup, self._data.nworld
        self._groups, self._faces = (n, w), (forces.wrench_chunks, w)
        with wp.ScopedDevice(forces.m.device):
            self._touched_by = wp.zeros((forces.geoms.count, w), dtype=int)
            self._wrench = wp.zeros((n, w, 6), dtype=real)
            self._stiffness = wp.zeros((n, *self._faces), dtype=wp.spatial_matrixd)
            self._load = wp.zeros((2 * n, *self._faces), dtype=vec3)
            self._none = wp.zeros(self._groups, dtype=wp.spatial_vectord)
            self.needs_wrench = wp.zeros(w, dtype=int)
        # the same numbers, as kernels see them here
        self._data.drag.skin_wrench = wp.array(
            ptr=self._wrench.ptr, shape=self._groups, dtype=wp.spatial_vectord, device=self._wrench.device
        )

    @property
    def _of(self):
        return self._data.bodies, self._data.drag

    def begin(self, program: Launcher, touched_by: wp.array) -> None:
        """A step begins."""
        inputs = [self._data.worlds.wanted, touched_by, *self._of]
        self._launch(program, bodies.begin_bodies, self._groups, inputs)

    @property
    def looks(self) -> wp.array:
        """Worlds that look ahead."""
        return self._data.drag.looks

    def begin_pending(self, program: Launcher, path: LoadPath, any_out: wp.array) -> None:
        """Which worlds look ahead."""
        inputs = [self._forces.geoms.struct, path, self._data.drag, self._data.worlds]
        self._launch(program, bodies.begin_pending, self._groups[1], inputs, [any_out])

    def start_pending(self, program: Launcher) -> None:
        """They alone are active, and looked at where the step begins."""
        self._launch(program, bodies.switch_to, self._groups[1], [self.looks], [self._data.worlds.active])
        self.begin_path(program, self.looks)

    def find_pending(self, program: Launcher) -> None:
        """They are about to solve."""
        self._forces.decide(program, bodies.find_pending, [self._k.part, self._data.worlds])

    def end_pending(self, program: Launcher) -> None:
        """They have."""
        self._launch(program, bodies.end_pending, self._groups[1], [self._data.worlds, self._data.drag])

    def keep(self, program: Launcher, on: wp.array) -> None:
        """The way has come to where the bodies are."""
        self._set(program, self._data.bodies.posed, on, self._data.bodies.converged)

    def go_back(self, program: Launcher, on: wp.array) -> None:
        """They go on from there."""
        self._set(program, self._data.bodies.converged, on, self._data.bodies.posed)

    def let_go(self, program: Launcher, on: wp.array) -> None:
        """They go where they do without the skin."""
        self._set(program, self._none, on, self._data.bodies.posed)

    def find_unknown_wrenches(self, program: Launcher) -> None:
        """Which worlds do not know the wrenches with which the load path begins: `needs_wrench`."""
        inputs = [self._data.worlds, self._data.drag]
        self._launch(program, bodies.find_unknown_wrenches, self._groups[1], inputs, [self.needs_wrench])

    def begin_path(self, program: Launcher, on: wp.array) -> None:
        """They are those of where the skin was looked at last."""
        self.tell(program)
        for out in (self._data.bodies.begun, self._data.bodies.converged):
            self._set(program, self._data.drag.skin_wrench, on, out)

    def tell(self, program: Launcher) -> None:
        """Wrenches of the forces that were evaluated last."""
        self._forces.tell_wrench(program, self._touched_by, self._wrench)

    def settle(self, program: Launcher) -> None:
        """Checks the active worlds at the beginning of an iteration."""
        d, f = self._data, self._forces
        inputs = [f.wrench_chunk, f.geoms.struct, d.x, f.contact, d.worlds.active]
        self._launch(program, bodies.measure_drag, self._faces, inputs, [d.drag, self._stiffness])
        f.decide(program, bodies.settle_bodies, [self._stiffness, d.worlds.active, *self._of, d.worlds])

    def push(self, program: Launcher) -> None:
        """What the skin feels of that, added to the residual and its square."""
        self._push(program, 1.0, self._data.worlds.active, self._k.r, self._k.worth)

    def resist(self, program: Launcher) -> None:
        """Takes from the product q of p how much softer contact is since bodies give way."""
        on = self._data.worlds.running
        self._drag(program, self._k.p, on)
        self._forces.decide(program, bodies.respond, [self._load, on, *self._of, self._data.worlds])
        self._push(program, -1.0, on, self._k.q, self._k.part)

    def step(self, program: Launcher) -> None:
        """Where the solution dx takes the bodies: all of that."""
        on = self._data.worlds.active
        self._drag(program, self._k.dx, on)
        st = self._data.worlds
        self._forces.decide(program, bodies.find_step, [self._load, on, *self._of, st])
        self._launch(program, bodies.move_bodies, self._groups, [1, on, st, *self._of])

    def move(self, program: Launcher) -> None:
        """As much further as the nodes in a search."""
        st = self._data.worlds
        self._launch(program, bodies.move_bodies, self._groups, [0, st.moving, st, *self._of])

    def add_slope(self, program: Launcher, part: wp.array) -> None:
        """To that of the nodes, where the skin was looked at last."""
        self.tell(program)
        self._launch(program, bodies.add_slope, self._groups[1], [self._data.worlds, *self._of, part])

    def _drag(self, program, p, on):
        d, f = self._data, self._forces
        inputs = [f.wrench_chunk, d.x, f.contact, p, on, d.drag]
        self._launch(program, self._kernels.drag, self._faces, inputs, [self._load])

    def _push(self, program, sign, on, r, square):
        d, f, m = self._data, self._forces, self._forces.m
        surface = [m.free_mask, m.outer.start, m.outer.slot, d.x, f.contact]
        inputs = [self._k.chunk, sign, *surface, on, *self._of]
        self._launch(program, self._kernels.push_nodes, (self._k.nchunk, d.nworld), inputs, [r, square])

    def _set(self, program, value, on, out):
        self._launch(program, bodies.set_where, self._groups, [value, on, out])

    def _launch(self, program, kernel, dim, inputs, outputs=()):
        self._forces.launch(program, kernel, dim, inputs, outputs)
