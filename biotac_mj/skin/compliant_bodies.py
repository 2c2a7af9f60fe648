"""Launches of the kernels for compliant bodies in Newton's method of the full tier (`newton.bodies`)."""

import warp as wp

from .contact.posed import LoadPath
from .forces import Forces
from .newton import bodies, nodes
from .program import Launcher
from .types import real, vec3


class CompliantBodies:
    """The compliant bodies of all worlds of `forces`. Methods put launches into a program; `on` flags the
    worlds that take part."""

    def __init__(self, forces: Forces):
        self._forces, self._k, self._data = forces, forces.k, forces.d
        self._kernels = bodies.bodies_kernels(self._data.precision)
        n, w = forces.geoms.ngroup, self._data.nworld
        self._groups, self._faces = (n, w), (forces.wrench_chunks, w)
        with wp.ScopedDevice(forces.m.device):
            self._touched_by = wp.zeros((forces.geoms.count, w), dtype=int)
            self._wrench = wp.zeros((n, w, 6), dtype=real)
            self._stiffness = wp.zeros((n, *self._faces), dtype=wp.spatial_matrixd)
            self._touched = wp.zeros((n, *self._faces), dtype=int)
            self._load = wp.zeros((2 * n, *self._faces), dtype=vec3)
            self._least = wp.zeros(self._groups, dtype=wp.spatial_vectord)
            self._x_least = wp.zeros_like(self._data.x)
            self.needs_wrench = wp.zeros(w, dtype=int)
        # a view of `_wrench` with the type that the kernels here take
        self._data.body_contact.skin_wrench = wp.array(
            ptr=self._wrench.ptr, shape=self._groups, dtype=wp.spatial_vectord, device=self._wrench.device
        )

    @property
    def _structs(self):
        return self._data.bodies, self._data.body_contact

    @property
    def has_pending(self) -> wp.array:
        """(nworld,) flags of the worlds whose first iteration takes the geoms' motion as its load."""
        return self._data.body_contact.has_pending

    def begin(self, program: Launcher, touched_by: wp.array) -> None:
        """Starts a step."""
        inputs = [self._data.worlds.wanted, touched_by, *self._structs]
        self._launch(program, bodies.begin_bodies, self._groups, inputs)

    def begin_pending(self, program: Launcher, path: LoadPath, any_out: wp.array) -> None:
        """Finds the worlds whose bodies still have a motion to make, and that motion."""
        inputs = [self._forces.geoms.struct, path, self._data.body_contact, self._data.worlds]
        self._launch(program, bodies.begin_pending, self._groups[1], inputs, [any_out])

    def start_pending(self, program: Launcher) -> None:
        """Makes those worlds active; their forces are those at the start of the step."""
        inputs, outputs = [self.has_pending], [self._data.worlds.active]
        self._launch(program, bodies.copy_flags, self._groups[1], inputs, outputs)
        self.begin_path(program, self.has_pending)

    def find_pending(self, program: Launcher) -> None:
        """Starts their linear solve."""
        self._forces.decide(program, bodies.find_pending, [self._k.partial, self._data.worlds])

    def end_pending(self, program: Launcher) -> None:
        """Ends their first iteration."""
        inputs = [self._data.worlds, self._data.body_contact]
        self._launch(program, bodies.end_pending, self._groups[1], inputs)

    def accept(self, program: Launcher, on: wp.array) -> None:
        """Stores the wrenches at the end of an accepted load increment."""
        self._set(program, self._data.bodies.posed, on, self._data.bodies.converged)

    def restore(self, program: Launcher, on: wp.array) -> None:
        """Returns to the wrenches of the last accepted increment."""
        self._set(program, self._data.bodies.converged, on, self._data.bodies.posed)

    def keep_iterate(self, program: Launcher) -> None:
        """Keeps the iterate of the least error."""
        d, on = self._data, self._data.worlds.improved
        self._set(program, d.bodies.posed, on, self._least)
        self._set(program, d.x, on, self._x_least)

    def take_iterate(self, program: Launcher) -> None:
        """Takes it in the worlds that are cut off."""
        d, on = self._data, self._data.worlds.cut_off
        self._set(program, self._least, on, d.bodies.posed)
        self._set(program, self._x_least, on, d.x)

    def mark_unknown_wrenches(self, program: Launcher) -> None:
        """Marks (`needs_wrench`) worlds with a load increment whose wrenches at the start of the path have
        not been evaluated."""
        inputs = [self._data.worlds, self._data.body_contact]
        self._launch(program, bodies.mark_unknown_wrenches, self._groups[1], inputs, [self.needs_wrench])

    def begin_path(self, program: Launcher, on: wp.array) -> None:
        """Stores the wrenches of the last evaluation as those at the start of the load path."""
        self.compute_wrench(program)
        for out in (self._data.bodies.begun, self._data.bodies.converged):
            self._set(program, self._data.body_contact.skin_wrench, on, out)

    def compute_wrench(self, program: Launcher) -> None:
        """Computes the skin's wrenches on the bodies from the last evaluation of forces."""
        self._forces.compute_wrench(program, self._touched_by, self._wrench)

    def begin_iteration(self, program: Launcher) -> None:
        """Computes residual and compliance of the bodies in the active worlds, and adds the effect of that
        residual on the skin to r and its square."""
        d, f = self._data, self._forces
        inputs = [f.wrench_chunk, f.geoms.struct, d.x, f.contact, d.worlds.active]
        stiffness = [self._touched, self._stiffness]
        self._launch(program, bodies.measure_stiffness, self._faces, inputs, [d.body_contact, *stiffness])
        f.decide(program, bodies.begin_iteration, [*stiffness, d.worlds.active, *self._structs, d.worlds])
        self._add_body_forces(program, 1.0, d.worlds.active, self._k.r, self._k.norms)

    def soften_product(self, program: Launcher) -> None:
        """Subtracts from the product q the softening of the contact stiffness by the bodies' compliance."""
        on = self._data.worlds.running
        self._move_by_load(program, 0, self._k.p, on)
        self._add_body_forces(program, -1.0, on, self._k.q, self._k.partial)

    def step(self, program: Launcher) -> None:
        """Takes the bodies' full step for the solution dx."""
        on = self._data.worlds.active
        self._move_by_load(program, 1, self._k.dx, on)
        self._launch(program, bodies.move_bodies, self._groups, [1, on, self._data.worlds, *self._structs])

    def move(self, program: Launcher) -> None:
        """Moves the bodies by the change of the step length, as the nodes in a line search."""
        st = self._data.worlds
        self._launch(program, bodies.move_bodies, self._groups, [0, st.moving, st, *self._structs])

    def add_slope(self, program: Launcher, partial: wp.array) -> None:
        """Adds the bodies' part to the slope of the line search at the last evaluation."""
        self.compute_wrench(program)
        self._launch(program, bodies.add_slope, self._groups[1], [self._data.worlds, *self._structs, partial])

    def _move_by_load(self, program, ends, p, on):
        d, f = self._data, self._forces
        inputs = [f.wrench_chunk, d.x, f.contact, p, on, d.body_contact]
        self._launch(program, self._kernels.body_load, self._faces, inputs, [self._load])
        f.decide(program, bodies.body_motion, [ends, self._load, on, *self._structs, d.worlds])

    def _add_body_forces(self, program, sign, on, r, square):
        d, f, m = self._data, self._forces, self._forces.m
        surface = [m.free_mask, m.outer.start, m.outer.slot, d.x, f.contact]
        inputs = [self._k.chunk, sign, *surface, on, *self._structs]
        self._launch(program, self._kernels.add_body_forces, (self._k.nchunk, d.nworld), inputs, [r, square])

    def _set(self, program, value, on, out):
        self._launch(program, nodes.set_where, out.shape, [value, on, out])

    def _launch(self, program, kernel, dim, inputs, outputs=()):
        self._forces.launch(program, kernel, dim, inputs, outputs)
