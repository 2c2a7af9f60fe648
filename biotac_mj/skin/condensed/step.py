"""A step of condensed skins in many worlds: its arrays and launches."""

import dataclasses
import types

import warp as wp

from ...kernels import add_zeros
from ..bodies import make_bodies
from ..data import SkinData
from ..geoms import GeomSet
from ..model import SkinModel, SkinOptions
from ..program import Launcher
from ..state import CONDENSED, allocate
from ..types import real, vec3
from . import results
from .linear import LinearSkin
from .refusals import refuse
from .results import conclude, recall
from .solve import block_of, phases, whole_step
from .structs import NVECTOR, Previous, Remembered, Scratch


def kernels_for_cuda(shapes: str) -> list[tuple[types.ModuleType | wp.Module, int]]:
    """Modules of a step's kernels on CUDA that take long to compile, with their block sizes, for
    `program.compile_ahead`. shapes: see `GeomSet.shapes`."""
    kernels = [kernel.module for kernel in vars(phases(shapes)).values()]
    block = block_of(SkinOptions.samples)  # another number compiles when it is launched
    return [(module, block) for module in [*kernels, results]]


@dataclasses.dataclass(frozen=True)
class Room:
    """For contact: nodes that touch, whose dense system takes most of the memory, 2.1 MB a world where they
    are 240; samples that touch; coordinates of candidate nodes of both surfaces, and candidate faces of the
    inner one; and views, see `broadphase.choose_view`."""

    touched: int
    contacts: int = 1_000_000
    coordinates: int = 1_000_000
    core_faces: int = 100_000
    views: int = 1

    @classmethod
    def of_worlds(cls, nworld: int) -> "Room":
        """Capacity that fits the memory for `nworld` worlds."""
        return cls(240 if nworld <= 1024 else 144, coordinates=1584, core_faces=1024)


class CondensedStep:
    """A step of all wanted worlds by the condensed tier, with the interface of `skin.step`: poses in
    `geoms.struct`, positions, wrenches and pressures out.

    Args:
      model: SkinModel on any device. linear: LinearSkin of the same model on the CPU.
      data: of the skins. geoms: that touch them.
      room: capacity for contact; None: by the number of worlds.
      groups: number of groups of geoms with compliant bodies; 0: poses are prescribed.

    Attributes:
      remembered: `Remembered` between steps.
      most, spent: (nworld,) limit of a step's cost (`SkinOptions.max_work`), and its cost, in evaluations of
        contact.
      deep: (nworld,) int, 1: a geom is in the core.
      bodies: `Bodies`; the caller writes compliance, predicted wrenches and reference points before a launch.
      slack: (groups, nworld) of the groups' models, see `coupling.implicit.rounds`.
      previous: `Previous`; the caller lets a solve begin there.
      touch: `Contact` of the outer surface.
      tier: (nworld,) int, for the sensor `status`: 1, or -1 outside the range of measured errors.

    Raises:
      ValueError: unsupported settings, see `refusals`.
    """

    def __init__(
        self,
        model: SkinModel,
        linear: LinearSkin,
        data: SkinData,
        geoms: GeomSet,
        room: Room | None = None,
        groups: int = 0,
    ):
        refuse(model.material.extensions, model.options, model.has_liquid, False)
        self._model, self._data, self._geoms = model, data, geoms
        geoms.resolve(model.spacing, model.options.samples)
        self._constants, nworld = linear.constants(model), data.nworld
        with wp.ScopedDevice(model.device):
            self.remembered = Remembered()
            sizes = {"outer_node": len(linear.node), "inner_node": len(linear.inner), "world": nworld}
            allocate("condensed", self.remembered, sizes, tier=CONDENSED)
            allocate("step", self, sizes)
            room = room or Room.of_worlds(nworld)
            self._scratch = _scratch(model, linear, data, geoms.count, room, groups)
            self._no_tangents = wp.zeros((0, nworld), dtype=wp.spatial_matrixd)
        self.most, self.spent = self._scratch.most, self._scratch.spent
        self.bodies, self.previous = self._scratch.bodies, self._scratch.previous
        self.slack = self._scratch.slack
        self.most.fill_(float(model.options.max_work))
        self._going = wp.zeros(1, dtype=int, device=model.device)
        self._phases = phases(geoms.shapes) if model.device.is_cuda else None
        self._block = block_of(model.options.samples)
        law = [model.sample, model.options.stick_ratio, data.worlds.contact_stiffness, data.laws.struct]
        no_bound = wp.zeros((0, 0), dtype=real, device=model.device)
        self.touch = self._scratch.touch = data.outer.contact(*law, data.x_last, no_bound)

    def launch(self, tangent: wp.array | None = None, launcher: Launcher | None = None) -> None:
        """Launches only: may be captured in a CUDA graph, as the parts below may.

        Args:
          tangent: (ngroup, nworld) spatial_matrixd for -d wrench / d motion, or None.
          launcher: collects the launches; None: launch immediately.
        """
        launcher = launcher or Launcher(self._model.device)
        self.begin(launcher)
        if self._phases:
            going = self._going
            going.fill_(1)
            launcher.loop(going, lambda: (going.zero_(), self.continue_solve(going, launcher)))
        self.end(tangent, launcher)

    def begin(self, launcher: Launcher | None = None) -> None:
        """First part: on the CPU the whole solve; on CUDA call `continue_solve` until all worlds are done."""
        m, d, geoms = self._model, self._data, self._geoms
        launcher, n, c, s = launcher or Launcher(m.device), d.nworld, self._constants, self._scratch
        if self._phases:
            known = [m.law, geoms.struct, d.worlds]
            launcher.launch_blocks(self._phases.begin, [n], known, [s], block_dim=self._block)
            return
        launcher.launch(  # a thread for each, and no tiles: several skins may be solved at a time
            whole_step(),
            [n],
            [m.law, geoms.struct, d.rest_pressure, c],
            [s, self.remembered, d.worlds, d.outer.node_force, self.tier],
        )

    def continue_solve(self, going: wp.array, launcher: Launcher | None = None) -> None:
        """One round on CUDA: broad phase, Newton's method to its end, decision about the load. Sets going[0]
        if a world has not finished."""
        m, d, k = self._model, self._data, self._phases
        launcher = launcher or Launcher(m.device)
        known = [self._geoms.struct, self._constants]
        of_world = [self.remembered, d.worlds]
        out = [self._scratch, *of_world, d.outer.node_force, self.tier, going]
        for kernel, inputs, outputs in (
            (k.search, [*known, *of_world], [self._scratch]),
            (k.balance, known, [self._scratch]),
            (k.conclude, [known[0], d.rest_pressure, *known[1:]], out),
        ):
            launcher.launch_blocks(kernel, [d.nworld], inputs, outputs, block_dim=self._block)

    def end(self, tangent: wp.array | None = None, launcher: Launcher | None = None) -> None:
        """Last part: wrenches and tangents of the solves."""
        m, d, geoms = self._model, self._data, self._geoms
        _, touched_by, wrench = d.geom_memory(geoms.count, geoms.ngroup)
        tangent = self._no_tangents if tangent is None else tangent
        launcher = launcher or Launcher(m.device)
        known = [geoms.struct, self._constants, d.worlds.wanted, self._scratch]
        found = [touched_by, wrench, tangent]
        launcher.launch_blocks(conclude, [d.nworld], known, found, block_dim=self._block)

    def recall(self, launcher: Launcher) -> None:
        """Computes positions of the nodes from `remembered`, on the CPU."""
        d = self._data
        known = [self._model.law, self._constants, d.worlds, self.remembered]
        launcher.launch(recall, d.nworld, known, [self._scratch])

    @property
    def holders(self) -> dict:
        """Objects with the arrays that `state.StateArrays` copies."""
        return {"condensed": self.remembered, "step": self}


def _scratch(model, linear, data, ngeom, room, groups):
    s, w = Scratch(), data.nworld
    nface, nouter, ninner = len(model.outer.face_np), len(linear.node), len(linear.inner)
    ncore = len(model.core_surface.face_np) if model.has_core else 0
    touched, core_faces = min(room.touched, nouter + ninner), min(room.core_faces, ncore)
    n, ring = min(room.coordinates, 3 * nouter + ninner), model.ring.shape[1]
    kept = 0 if model.device.is_cuda else n  # by one thread; rows that are never used take no memory
    nodes, columns = min(n // 3, nouter), min(kept, 3 * touched)
    for names, *shape in (
        ("turn most spent deep borders", w),
        ("near face free close_to", w, nface),
        ("near_core", w, ncore),
        ("look", w, max(nface, ncore)),
        ("core_face", w, core_faces),
        ("gap now", w, core_faces, len(model.sample)),
        ("place node force", w, nouter),
        ("core_place core_node core_force stiff", w, ninner),
        ("arm group", w, nodes),
        ("coordinate loaded loaded_place load", w, n),
        ("vector", w, NVECTOR, n),
        ("on", w, min(n, nouter + ninner)),
        ("touched", w, touched),
        ("block core_block", w, touched, ring),
        ("held push column column_place", w, 3 * touched),
        ("matrix", w, (3 * touched + 6 * max(groups, 1)) ** 2),
        ("sum", w, 3 * max(kept, len(model.free))),
        ("ready", w, kept),
        ("last", w, kept + 1),
        ("last_column", w, columns + 1),
        ("seen", w, room.views, nface),
        ("seen_depth", w, room.views),
        ("seen_mat", room.views, ngeom, w),
        ("slack", groups, w),
        ("pos mat from_pos from_mat held_pos held_mat sought_pos sought_mat", ngeom, w),
        ("sought_x", model.nvert, w),
    ):
        add_zeros(s, names, *shape)
    s.between, s.columns = (wp.empty((w, kept * many), dtype=float) for many in (kept, columns))
    s.far = wp.ones((w, room.views, nface), dtype=real)  # until a geom comes near
    s.seen_pos = wp.full((room.views, ngeom, w), vec3(wp.nan, wp.nan, wp.nan), dtype=vec3)
    s.x, s.most_contacts, s.bodies = data.x, room.contacts, make_bodies(groups, w)
    add_zeros(s.solve, "phase stepping increment newton", w)
    s.previous, sizes = Previous(), {"outer_node": nouter, "inner_node": ninner, "world": w}
    allocate("condensed", s.previous.balance, sizes, tier=CONDENSED)
    add_zeros(s.previous, "pos mat", ngeom if groups else 0, w)
    add_zeros(s.previous, "begins", w)
    return s
