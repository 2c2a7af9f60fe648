"""The skins of all worlds behind one small interface: where the geoms will be goes in; wrenches, tangents and
the liquid's pressure come out. All is on the device."""

import functools
from collections.abc import Sequence

import numpy as np
import warp as wp

from ..coupling.steppers.fem import geom_set
from ..coupling.touching import Touching
from ..geometry.skin_geometry import SkinGeometry
from ..skin import SkinModel
from ..skin.condensed import CondensedStep, LinearSkin
from ..skin.contact.outside import leave_skin
from ..skin.newton.worlds import BLOCK
from ..skin.per_world import make_worlds
from ..skin.program import Fork, Launcher
from ..skin.state import CONDENSED, FULL, GUESS, MEMORY, allocate, zeros
from ..skin.state_arrays import StateArrays
from ..skin.step import launch_step, prepare_step
from ..skin.transfer import Transfer
from . import kernels
from .memory import arrays_of
from .rest import Rest

_WORK = 1000  # of a two-way condensed skin's solve: all worlds wait for the dearest


class BatchSkin:
    """`nworld` skins of one model and what touches them.

    Args:
      model: SkinModel.
      nworld: number of worlds.
      touching: `coupling.touching.Touching`, what can touch. geometry: of the skins.
      friction: (nworld, ngeom) Coulomb coefficients.
      materials: one Material for each world, or None for the model's.
      tangents: whether `tangent` is wanted.
      dt: time step [s], of rubber that relaxes and of implicit dynamics.
      worlds: in what the worlds differ besides, see `skin.per_world.make_worlds`.
      twin: the model on the CPU, of skins of the condensed tier; None: of the full one.

    Attributes (wp.arrays on the model's device, double precision unless stated otherwise):
      data: the SkinData: positions, materials and liquids.
      pos, mat: (ngeom, nworld) poses of the geoms in the BioTac frame, for the caller to write before
        `begin_solve`.
      inertial: whether the skins have inertia (implicit dynamics): then the caller also writes where the
        BioTac frames are, core_pos, core_mat (nworld,) when the step begins and data.frame_pos,
        data.frame_mat when it ends.
      fresh: (nworld,) int, 1 where no step was made since the reset: such a skin begins at rest on its core.
      rest: `rest.Rest`, which skins sleep, and which come to rest instead of being solved.
      x: (nvert, nworld) nodes [m].
      motion: (ngeom, nworld) of the geoms in the last step [m].
      fraction: (ngroup,) of what it does to each group that this skin answers for, see `Touching`.
      wrench: (ngroup, nworld) spatial_vectord of the skin ON each touching body about the BioTac frame's
        origin [N, N m].
      tangent: (ngroup, nworld) spatial_matrixd, -d wrench / d (translation, rotation vector).
      pressure: (nworld,) of the liquid above the model's rest [Pa]. error: (nworld,) of the last step in the
        energy norm, estimated.
      bodies: `skin.bodies.Bodies`, of skins with tangents: how what touches gives way, for the caller to
        write.
      by_mocap: (ngroup,) bool, bodies that a mocap body leads.
      slack: (ngroup, nworld) of the groups' models, see `coupling.implicit.rounds`; of length zero in the
        full tier and without tangents.
      kind: "full" or "condensed". tier: (nworld,) int, as `status` has it: 0 full, 1 condensed, -1 beyond
        what that was measured for.
      reason: (nworld,) int: 0, or why the last step failed (`skin.newton.worlds`). iterations: (nworld,) int
        of the last step.
    """

    def __init__(
        self,
        model: SkinModel,
        nworld: int,
        touching: Touching,
        geometry: SkinGeometry,
        friction: np.ndarray,
        materials: list | None = None,
        tangents: bool = True,
        dt: float | None = None,
        worlds: dict | None = None,
        twin: SkinModel | None = None,
    ):
        self.model, self.nworld, self._tangents = model, nworld, tangents
        self.data = make_worlds(model, nworld, materials, worlds, FULL if twin is None else CONDENSED)
        self.inertial = model.options.dynamics == "implicit"
        if dt is not None:
            self.data.dt.fill_(dt)
        self.geoms = geom_set(touching.geoms, geometry, nworld, model.device)
        self.geoms.set_friction(friction)
        self.ngroup, struct, st = self.geoms.ngroup, self.geoms.struct, self.data.worlds
        self.pos, self.mat = struct.pos, struct.mat
        self.x, self.reason, self.iterations, self.error = self.data.x, st.reason, st.iterations, st.error
        self.motion, self._touched_by, self._wrench = self.data.geom_memory(self.geoms.count, self.ngroup)
        self.data.laws.refuse_coarse_grids(self.geoms)
        self._condensed, self.kind = None, "full" if twin is None else "condensed"
        if twin is not None:
            _refuse_differences(self.data, materials, worlds)
            groups = self.ngroup if tangents else 0
            self._condensed = CondensedStep(model, LinearSkin.of(twin), self.data, self.geoms, groups=groups)
            self.data.rests_alike = True
            if tangents:
                self._condensed.most.fill_(float(min(_WORK, model.options.max_work)))
        else:
            if tangents:
                self.data.make_bodies_compliant(self.ngroup)
            prepare_step(model, self.data, self.geoms)
        self.bodies = None
        if tangents:
            self.bodies = self._condensed.bodies if self._condensed else self.data.bodies
        with wp.ScopedDevice(model.device):
            self.tier = (self._condensed or self.data.worlds).tier
            self.slack = self._condensed.slack if self._condensed else wp.zeros((0, nworld), dtype=wp.float64)
            allocate("batch", self, {"group": self.ngroup, "world": nworld})
            self.fraction, self._path = (
                wp.array(a, dtype=wp.float64) for a in (touching.fraction, touching.path)
            )
            self.by_mocap = wp.array(touching.by_mocap, dtype=bool)
            self._touched, self._bare = wp.zeros(nworld, dtype=int), wp.zeros(nworld, dtype=bool)
            self._every = wp.ones(nworld, dtype=int)
            self.core_pos = wp.zeros(nworld, dtype=wp.vec3d)
            self.core_mat = wp.zeros(nworld, dtype=wp.mat33d)
        self.rest = Rest(self)
        tier, of_tier = (CONDENSED, self._condensed.holders) if self._condensed else (FULL, {})
        holders = {"batch": self, "rest": self.rest, **of_tier}
        self.state = StateArrays(self.data, self.geoms, tier, **holders)
        self.state.prepare()
        self._kept = []
        self._going = wp.zeros(1, dtype=int, device=model.device)  # of `solve_group`

    @property
    def nbytes(self) -> int:
        """Device memory that grows with the number of worlds [bytes]."""
        return _world_bytes(self.nworld, self.data, self.geoms.struct, self)

    @property
    def outcome(self) -> list[wp.array]:
        """Contact found by a solve: touching geoms, `wrench`, `tangent`."""
        return [self._touched_by, self.wrench, self.tangent]

    def begin_solve(self) -> None:
        """Begins to solve the worlds that are `data.worlds.wanted` for the geoms where they are now, between
        `rest.begin_solve` and `rest.come_to_rest`; `solve_group` and `end_solve` follow. Launches only,
        without loops or branches in the condensed tier.

        A world without equilibrium there comes as far as it can (`data.worlds.load_factor`); one whose poses
        are not finite stays as it was. One that nothing touches any more comes to rest, and so does one that
        has not moved on for some steps: then without equilibrium."""
        m, d = self.model, self.data
        if self.inertial:
            frames = [self.core_pos, self.core_mat, d.frame_pos, d.frame_mat]
            self._launch(kernels.begin_at_rest, d.x.shape, [self.fresh, *frames, d.dt, d.x], [d.velocity])
            wp.copy(d.frame_pos_last, self.core_pos)
            wp.copy(d.frame_mat_last, self.core_mat)
            self.fresh.zero_()
        self._come_from_outside(d.worlds.wanted)
        if self._condensed:
            self._condensed.begin()
        else:
            launch_step(m, d, self.geoms)

    def put_bodies(self, placed: wp.array, began: wp.array, awake: wp.array, where: wp.array) -> None:
        """Lets bodies that were placed begin where the geoms are now, without contact, as `SkinStepper.put`
        does for one world, on skins at rest where nothing else touches them. Launches only.

        Args:
          placed: (ngroup, nworld) int, which bodies. began: (nworld,) int, whether a step was made.
          awake: (nworld,) int, which skins this step may solve. where: (nworld,) int, in which worlds bodies
            were placed.
        """
        outer, geoms, nsample = self.data.outer, self.geoms.struct, len(self.model.sample)
        self._launch(kernels.forget_poses, self.pos.shape, [placed, began, self.by_mocap, awake], [geoms])
        faces = len(self.model.outer.face), self.nworld
        self._touched.zero_()
        left = [outer.anchor_geom, self._touched]
        self._launch(kernels.forget_contacts, faces, [where, nsample, geoms], left)
        if self.rest.possible:
            self._launch(kernels.find_bare, self.nworld, [where, self._touched, began], [self._bare])
            self.state.reset_skin(self._bare)
        self._come_from_outside(where)

    def _come_from_outside(self, where):
        geoms = self.geoms.struct
        known = [where, self.model.outer.face, self.model.sample, self.data.rest_vert, geoms]
        blocks = dict(dim=self.pos.shape, block_dim=BLOCK, device=self.model.device)
        wp.launch_tiled(leave_skin, inputs=known, outputs=[geoms.pos_last, geoms.mat_last], **blocks)

    def end_solve(self) -> None:
        """The last part of a solve: wrenches, tangents, pressures. Without loops or branches in the condensed
        tier."""
        m, d = self.model, self.data
        wanted = self._tangents and self.ngroup
        if self._condensed:
            self._condensed.end(self.tangent if wanted else None)
        elif wanted:
            d.preconditioner.measure_tangents(Launcher(m.device), self.geoms, d.x, self.tangent)
        known = [d.rest_pressure, int(m.has_liquid), d.worlds, self._wrench, self.fraction, self._path]
        found = [self.pressure, self.wrench, self.tangent]
        self._launch(kernels.read_outputs, self.nworld, known, found)
        self.rest.end_solve()

    def prepare_keep(self) -> None:
        """Allocates the arrays of `keep`."""
        outer = self.data.outer
        self._contact = outer.kept, outer.anchor_geom, outer.anchor
        self._kept_contact = [zeros(a.shape, a.dtype, self.kind) for a in self._contact]
        memory, guesses = self.state.of_role(MEMORY), self.state.of_role(GUESS)
        memory = [a for a in memory if a not in self._contact]
        # as they lie in memory, so that whole blocks of it are copied
        lying = [a if a.is_contiguous else a.transpose() for a in [*memory, *guesses]]
        self._kept = [(a, wp.empty_like(a)) for a in lying]
        numbers = range(len(memory), len(self._kept))
        back = [
            (kept if a.is_contiguous else kept.transpose(), a)
            for a, (_, kept) in zip([*memory, *guesses], self._kept)
        ]
        self._put_back = Transfer(back, self.nworld, self.model.device, guesses=numbers)

    def keep(self) -> None:
        """Keeps what the skins remember, for `put_back`. Launches only."""
        for array, kept in self._kept:
            wp.copy(kept, array)
        self._copy_contact(self._every, self._contact, self._kept_contact)

    def put_back(self) -> None:
        """Gives the wanted worlds back what they remembered; where the last solve converged, the next one
        begins from it, as if the skin had gone there in the last step already. Launches only."""
        wanted = self.data.worlds.wanted
        self._put_back.launch_wanted(wanted, self.reason)
        self._copy_contact(wanted, self._kept_contact, self._contact)
        if self._condensed:
            known = [wanted, self.reason, self.rest.resets]
            self._launch(kernels.begin_near, self.nworld, known, [self._condensed.previous.begins])

    def _copy_contact(self, on, source, target):
        """Copies the anchors, most of the memory, of those faces alone that have some."""
        dim = source[0].shape[::-1]
        self._launch(kernels.copy_anchors, dim, [on, *source], target)

    def reset(self, mask: wp.array) -> None:
        """Puts the worlds of mask, (nworld,) wp.array of bool, back to rest. Launches only."""
        self.state.reset(mask)

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.model.device)


def solve_group(skins: Sequence[BatchSkin], fork: Fork) -> None:
    """Goes on with solves that have begun until all are done, those of several skins side by side. Launches
    only."""
    condensed = [skin for skin in skins if skin.kind == CONDENSED and skin.model.device.is_cuda]
    if not condensed:  # these were solved when they began
        return
    going = condensed[0]._going

    def continue_all():
        going.zero_()
        fork.run(*(functools.partial(skin._condensed.continue_solve, going) for skin in condensed))

    going.fill_(1)
    wp.capture_while(going, continue_all)


def _refuse_differences(data, materials, worlds):
    """Worlds of the condensed tier share one compliance, times Young's modulus, and one rest."""
    ratios = {m.poissons_ratio for m in materials or ()}
    if len(ratios) > 1:
        raise ValueError(
            "the condensed tier has one compliance for all worlds: give their materials one poissons_ratio, "
            "or choose the full tier"
        )
    if data.rests is not None:
        raise ValueError(
            "worlds of the condensed tier have one rest: give one fill_volume, in options['skin'], and where "
            "the skin is filled one youngs_modulus; or choose the full tier"
        )
    if "modulus" in (worlds or {}):
        raise ValueError(
            "worlds of the condensed tier have one map of the modulus: leave modulus out of worlds, or "
            "choose the full tier"
        )


def _world_bytes(nworld, *roots):
    """Bytes of the arrays with a dimension of `nworld` (or two or four times that: right-hand sides) that
    objects hold."""
    found = {a.ptr: a for a in arrays_of(roots) if {nworld, 2 * nworld, 4 * nworld} & set(a.shape)}
    return sum(a.size * wp.types.type_size_in_bytes(a.dtype) for a in found.values())
