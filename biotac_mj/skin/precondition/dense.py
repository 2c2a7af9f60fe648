"""The preconditioner of `sparse.py` for all worlds at once, without a look back at the host: for CUDA.

Woodbury's identity with the inverse of the rest stiffness: first what the residual does at the touching
nodes, then the forces of contact and liquid that answer there, q = (I + D W)^-1 D u; these join the residual.
G = (I + D W)^-1 D is made explicitly, so that applying it is one short product. The inverse itself is that of
`dissected`, of nearly incompressible rubber carried into the present shape, see `carried`."""

import functools
import typing
from collections.abc import Callable

import numpy as np
import warp as wp

from ..newton.worlds import Worlds
from ..program import Fork, Launcher
from ..types import SINGLE, mat33
from . import Residual, body_tangent, sides, small
from . import touched as touch
from .inverse import Inverse

if typing.TYPE_CHECKING:
    from ..bodies import Bodies
    from ..geoms import GeomSet
    from ..newton.bodies import BodyContact

__all__ = ["FEW", "LANES_FEW", "THREADS_FEW", "DensePreconditioner"]

FEW = 16  # worlds that do not fill the device: work is split finer there
THREADS_FEW = 64  # of a block there, so that more multiprocessors take part
LANES_FEW = 8  # that share what is summed into a node there on CUDA: one would wait for read after read


class DensePreconditioner:
    """For all worlds of one SkinData, see `precondition.Preconditioner`.

    Attributes:
      needs_torch: its products are torch's.

    Args:
      model: the SkinModel.
      surfaces: (outer, core) contact states, core None where there is none.
      st: Worlds.
      chunk: nodes summed by one thread.
      capacity: touching nodes that the small systems hold; contact beyond is left to conjugate gradients,
        which then take longer.
      bodies, drag: of bodies that give way, None where poses are prescribed.
    """

    precision = SINGLE

    def __init__(
        self,
        model: typing.Any,
        surfaces: tuple,
        st: Worlds,
        chunk: int,
        capacity: int,
        bodies: "Bodies | None" = None,
        body_contact: "BodyContact | None" = None,
    ):
        nworld = st.softness.shape[0]
        self._bodies, self._body_contact = bodies, body_contact
        self.m, self.nworld, self.chunk, self.capacity = model, nworld, chunk, capacity
        self.device = model.device
        self._launch = functools.partial(_launch, THREADS_FEW if nworld <= FEW else 256)
        self.liquid = int(model.has_liquid)
        n = model.nvert
        self._nodes = (n, nworld)
        index = np.full(n, -1, np.int32)
        index[model.free] = np.arange(len(model.free))
        size = self.liquid + 3 * capacity
        with wp.ScopedDevice(self.device):
            self._free = wp.array(index, dtype=int)
            none = (
                wp.zeros(0, dtype=int),
                wp.zeros((0, nworld), dtype=int),
                wp.zeros(0, dtype=wp.vec3i),
                wp.zeros((0, nworld), dtype=mat33),
            )
            self.slot = wp.zeros(self._nodes, dtype=int)
            self.node = wp.zeros((capacity, nworld), dtype=int)
            self._found, self._found_count = wp.zeros(self._nodes, dtype=int), wp.zeros(nworld, dtype=int)
            self.size = wp.zeros(nworld, dtype=int)
            self.full = wp.zeros(1, dtype=int)
            self._norm = wp.zeros((2, nworld), dtype=float)
            self._largest = wp.zeros(nworld, dtype=float)
            self._ring = model.ring
            links = nworld, capacity, self._ring.shape[1]
            self._link, self._spring = wp.zeros(links, dtype=int), wp.zeros(links, dtype=wp.mat33)
            self._W, self._A, self._G = (wp.zeros((nworld, size, size), dtype=float) for _ in range(3))
            self._pivot = wp.zeros((0 if self.device.is_cuda else nworld, size), dtype=int)
            self._all = wp.full(nworld, 1, dtype=int)
            self._u, self._q = wp.zeros((nworld, size), dtype=float), wp.zeros((nworld, size), dtype=float)
        lanes = LANES_FEW if self.device.is_cuda and nworld <= FEW else 1
        self._body_block = Inverse(model, nworld, chunk, self._launch, lanes)
        self.needs_torch = self._body_block.needs_torch
        self._beside = Fork(self.device, nworld <= FEW).run  # most sizes of small systems find nothing to do
        self._outer, self._row_group = surfaces[0], None
        self._surfaces = []
        for state in surfaces:
            if state is None:
                self._surfaces.append((none[2], none[0], none[0], none[1], none[3]))
            else:
                s = state.surface
                self._surfaces.append((s.face, s.start, s.slot, state.touching, state.block))

    def begin_step(self, program: Launcher, x: wp.array) -> None:
        """The inverse at rest serves every step; where it is carried, into the shapes that are in x then."""
        self._x = x

    def watch_products(self, program: Launcher, x: wp.array) -> None:
        """Nothing: an inverse takes longer than the products that it would save."""

    def renew(self, program: Launcher, x: wp.array) -> None:
        """Nothing, see `watch_products`."""

    def update(
        self,
        program: Launcher,
        st: Worlds,
        residual: Residual,
        z_out: wp.array,
        part_out: wp.array,
        in_parallel: Callable[..., None],
    ) -> None:
        """See `precondition.Preconditioner`."""
        norms, r, gradient = residual
        on, m, w = st.active, self.capacity, self.nworld
        outer, core = self._surfaces
        blocks = [self._link, self._spring]

        def find():
            self._launch(
                program,
                touch.find_touched,
                self._nodes,
                [self._free, *outer[1:4], *core[1:4], on],
                [self._found_count, self.slot, self._found, st.touched],
            )
            program.launch_blocks(
                touch.survey,
                [w],
                [m, norms, st, self._found],
                [self._found_count, self.slot, self.node, self.size, self._norm, self.full],
            )

        def carry():
            if self._body_block.carried:
                self._body_block.carried.measure(program, self._launch, self._x, on)

        def meet():
            self._meet(program, True, st, on, r, gradient)

        def make():
            self._make_system(program, st, on, self._bodies)

        def prepare():
            self._launch(
                program,
                small.small_stiffness,
                (self._ring.shape[1], m, w),
                [*outer, *core, self._ring, self.slot, self.node, self.size, on],
                blocks,
            )
            if not self.liquid:  # which has to be met first
                make()

        self._given = st, r, gradient
        in_parallel(find, carry) if self._body_block.carried else find()
        in_parallel(meet, prepare)
        if self.liquid:
            make()
        self._balance(program, st, on, r, gradient, z_out, part_out)

    def apply(
        self,
        program: Launcher,
        st: Worlds,
        part: wp.array,
        r: wp.array,
        gradient: wp.array,
        z_out: wp.array,
        part_out: wp.array,
    ) -> None:
        """z = approximate inverse of the tangent times r in the running worlds; `part` holds the square of r
        by chunks."""
        program.launch_blocks(sides.measure_norm, [self.nworld], [part, st.running], [self._norm])
        self._meet(program, False, st, st.running, r, gradient)
        self._balance(program, st, st.running, r, gradient, z_out, part_out)

    def _meet(self, program, first, st, on, r, gradient):
        here, out = (self.node, self.size), (self._W, self._u, self._largest)
        self._body_block.meet(program, first, st, on, r, gradient, self._norm, here, *out)

    def _make_system(self, program, st, on, bodies=None):
        """G of the present contact, once its springs and what the liquid does are known."""
        inverse, body_block, w = self._body_block.inverse, self._body_block, self.nworld
        # of many worlds each has one block; most touch with a third of the nodes that they may
        threads = self.capacity**2 if w <= FEW else 256
        entries = [inverse.half, inverse.rest, inverse.scale, self._free, self.node, self.size]
        given = [*entries, self.liquid, body_block.along, st, on, body_block.matrix, threads]
        self._launch(program, small.small_compliance, (w, threads), given, [self._W])
        if bodies is not None:
            outer = self._surfaces[0]
            touched = [self.liquid, *outer[1:4], self._body_contact.group, bodies, self._x]
            given = [*touched, self.node, self.size, st, on, threads]
            self._launch(program, small.add_bodies, (w, threads), given, [self._W])
        system = [self.liquid, self.size, self._link, self._spring, self._W, on, threads]
        self._launch(program, small.small_system, (w, threads), system, [self._A])
        self._invert(program, on)
        self._launch(program, small.small_answer, (w, threads), system, [self._G])

    def _invert(self, program, on):
        """The inverse of A, in W's place."""
        if self.device.is_cuda:
            from .native import invert

            invert(program, self._beside, self.liquid, self.size, on, self._A, self._W)
        else:
            self._launch(
                program,
                small.invert_serial,
                self.nworld,
                [self.liquid, self.size, on, self._A, self._pivot],
                [self._W],
            )

    def _balance(self, program, st, on, r, gradient, z_out, part_out):
        """What contact and liquid answer, and the result."""
        answer = [self.liquid, self.size, self._G, self._u, self._norm, st, on]
        self._launch(program, small.small_forces, self._u.shape, answer, [self._q, self._largest])
        here, q = (self.node, self.size), (self.slot, self._q, self._largest)
        self._body_block.balance(program, st, on, r, gradient, self._norm, here, *q, z_out, part_out)

    def measure_tangents(
        self, program: Launcher, geoms: "GeomSet", x: wp.array, tangent_out: wp.array
    ) -> None:
        """See `precondition.Preconditioner`. Of the inverse at rest, as those of many worlds on the CPU, and
        of the skin alone."""
        outer, rows = self._outer, (self.capacity, self.nworld)
        if self._body_block.carried or self._bodies is not None:
            self._body_block.as_at_rest(lambda: self._remake_system(program))
        if self._row_group is None:
            with wp.ScopedDevice(self.device):
                self._row_group = wp.zeros(rows, dtype=int)
                self._row_part = wp.zeros(rows, dtype=wp.spatial_matrixd)
        surface, nsample = outer.surface, len(self.m.sample)
        touched = [surface.start, surface.slot, nsample, outer.touching, outer.trial_geom, geoms.struct.group]
        here = [self.size, self.node]
        program.launch(body_tangent.group_rows, rows, [*here, *touched], [self._row_group])
        dragged = [self.liquid, *here, self._G, x, self._row_group]
        program.launch(body_tangent.drag_rows, rows, dragged, [self._row_part])
        sums = [self.size, self._row_group, self._row_part]
        program.launch(body_tangent.sum_rows, tangent_out.shape, sums, [tangent_out])

    def _remake_system(self, program):
        """Of all worlds, where they were looked at last; what carries them on is made anew then."""
        st, r, gradient = self._given
        if self.liquid:
            self._meet(program, True, st, self._all, r, gradient)
        self._make_system(program, st, self._all)


def _launch(threads, program, kernel, dim, inputs, outputs):
    program.launch(kernel, dim, inputs, outputs, threads)
