"""Linearised step at its equilibrium, by the implicit function theorem.

At the end of a step the forces f on the free nodes balance, f(x, u) = 0, with u all inputs of the step. So
dx = K^-1 (df/du) du with the tangent K = -df/dx, and the outputs follow. The conjugate gradients of a forward
step use a symmetric tangent; here it is the consistent one, with friction that depends on the normal force,
the curvature of the geoms and the pressure's dependence on the wet area. It is not symmetric, so cotangents
are solved with its transpose, by GMRES (preconditioned by `inverse`).

All worlds of a skin are linearised in parallel; tensors are on the skin's device, [item, world]. A single
world on the CPU may also have liquid (`liquid`), rubber with memory (`memory`) and other rest positions
(`rest`)."""

import torch
import warp as wp

from ...threads import single_thread
from ..record import Record, restore
from ..skin import NUMBERS, SkinWorlds
from ..tensors import transposed
from ..touching import Anchors, find_touching, rows
from .inverse import FaceBlocks, FactorInverse, StepInverse, solve_by_gmres
from .liquid import LinearLiquid
from .memory import LinearMemory, Memory
from .rest import push_rest
from .samples import LinearSurface

# inputs of a step, besides rest positions and memory of the rubber: nodes at its start (nvert, nworld, 3);
# anchors of all samples then (nsample nworld, 3); poses of the geoms at its end and start (ngeom, nworld, 6),
# a translation and a rotation vector about the geom's own origin, in the BioTac frame; frictions (ngeom,
# nworld); areas at rest of outer faces and of those that can touch the core (nface, nworld); and (nworld,)
# `skin.NUMBERS` and the pressures `offset` and `reference` of `newton.worlds.Worlds`
_SCALARS = (*NUMBERS, "offset", "reference")
GIVEN = ("x_last", "anchor", "pose", "pose_last", "friction", "area", "core_area", *_SCALARS)


class LinearStep:
    """The linearised step of a record, see the module's docstring. Outputs: nodes (nvert, nworld, 3),
    wrenches of the groups (ngroup, nworld, 6), pressures of the liquid (nworld,) and anchors of the samples
    in contact.

    Attributes:
      touching: samples of the outer surface in contact. memory: a LinearMemory, or None.

    Raises:
      ValueError: a linear solve did not converge.
    """

    def __init__(self, skin: SkinWorlds, record: Record):
        self._skin, self.record = skin, record
        self._free = wp.to_torch(skin.model.free_mask)[:, None, None].double()
        self._inverses = {}
        with single_thread():
            restore(skin, record)
            self.memory = LinearMemory(skin, record) if skin.data.memory else None
            self._contact()
            self._by_rubber = dict(zip(("mu", "lam"), skin.rubber_slopes()))
            self._liquid = LinearLiquid(skin, record, self._core) if skin.model.has_liquid else None
        surfaces = [surface for surface in (self._outer, self._core) if surface]
        self._blocks = [surface.blocks() for surface in surfaces]
        turn = [self._liquid.turn] if self._liquid else []
        self._all_blocks = FaceBlocks.joined(self._blocks + turn)

    def _contact(self):
        skin, record = self._skin, self.record
        data, ratio = skin.data, skin.model.options.stick_ratio
        stiffness, struct = record.numbers["contact_stiffness"], record.geoms.struct
        x, x_last, samples = record.x, record.x_last, skin.sample_weights
        at = self.touching = find_touching(data.outer, samples, struct, x, x_last, record.anchors)
        self._outer = LinearSurface(at, struct, data.outer, stiffness, ratio, record.smoothing)
        group = torch.as_tensor(record.geoms.groups, device=x.device).long()
        self._group = (group[at.kind] if len(at.geom) else at.geom) * skin.nworld + at.world
        self._core = None
        if data.core and (rows(data.core.trial_geom) >= 0).any():
            core, none = skin.model.core(skin.nworld).struct, Anchors.none(x.device)
            there = find_touching(data.core, samples, core, x, x, none)
            self._core = LinearSurface(there, core, data.core, stiffness, ratio, core=True)

    # --- solves ---

    def _tangent(self, v, transpose=False):
        """The consistent tangent times v (nvert, nworld, 3), zero at fixed nodes."""
        return self._free * self._whole_tangent(self._free * v, transpose)

    def _whole_tangent(self, v, transpose=False):
        """The consistent tangent including rows of the fixed nodes."""
        found = self._skin.multiply_rubber(v) - self._all_blocks.multiply(v, transpose)
        if self._liquid:
            left, right = self._liquid.push, self._liquid.by_node
            if transpose:
                left, right = right, left
            found -= left * (right * v).sum()
        return found

    def _inverse(self, transpose):
        """The approximate inverse, made on first use."""
        if transpose not in self._inverses:
            skin, (outer, *core) = self._skin, self._blocks
            if skin.device.is_cuda:
                made = StepInverse(skin, outer, core[0] if core else None, transpose)
            else:
                liquid = self._liquid
                ends = (-liquid.push * self._free, liquid.by_node * self._free) if liquid else (None, None)
                free = self._free[:, 0, 0].numpy() > 0
                soft = self.record.numbers["softness"]
                blocks = FaceBlocks.joined(self._blocks)
                made = FactorInverse(skin.factors, soft, blocks, free, *ends, transpose)
            self._inverses[transpose] = made
        return self._inverses[transpose]

    def solve(self, r: torch.Tensor, transpose: bool = False) -> torch.Tensor:
        """K^-1 r or K^-T r for r (nvert, nworld, 3); zero at fixed nodes."""
        with single_thread():
            inverse = self._inverse(transpose)
            found, count = solve_by_gmres(
                lambda v: self._tangent(v, transpose),
                inverse,
                r * self._free,
                self._skin.precision,
                digits=inverse.digits,
                restart=inverse.restart,
            )
            self._skin.count_products(count, self.record.x)
        return found

    # --- what comes out by what goes in ---

    def none(self) -> dict:
        """Zeros for the inputs, by name."""
        skin, like = self._skin, self.record.x
        w, ngeom, (outer, core) = skin.nworld, self.record.geoms.count, skin.surfaces
        shapes = {"x_last": (*like.shape[:2], 3), "anchor": (outer * len(skin.weights) * w, 3)}
        shapes |= dict.fromkeys(("pose", "pose_last"), (ngeom, w, 6)) | {"friction": (ngeom, w)}
        shapes |= {"area": (outer, w), "core_area": (core, w)} | dict.fromkeys(_SCALARS, (w,))
        return {name: like.new_zeros(shapes[name]) for name in GIVEN}

    def _load(self, given):
        """Forces on the nodes (nvert, nworld, 3) and pressures by tangents of the step's inputs, at fixed
        nodes, without those of the rubber's memory and rest."""
        force, core_felt = torch.zeros_like(self.record.x), None
        self._outer.at_nodes(self._outer.push(given)[0], force)
        if self._core:
            core_felt = self._core.push(given)[0]
            self._core.at_nodes(core_felt, force)
        pressure = force.new_zeros(self._skin.nworld)
        if self._liquid:
            pressure, pushed = self._liquid.change(given, core_felt)
            force = force + pushed
        for name, column in self._by_rubber.items():
            force = force + column * given[name][:, None]
        return force, pressure

    def _ends(self, given, x, pressure):
        """Tangents of wrenches, pressures and anchors by those of the inputs, the nodes and the pressure at
        fixed nodes."""
        outer, at = self._outer, self.touching
        force, anchor = outer.push(given, x)
        turn = torch.linalg.cross(at.point, force) + torch.linalg.cross(outer.points(x), outer.force)
        wrench = x.new_zeros((self.record.geoms.ngroup, self._skin.nworld, 6))
        wrench.view(-1, 6).index_add_(0, self._group, -torch.cat([force, turn], 1))
        if self._liquid:
            pressure = pressure + (self._liquid.by_node * x).sum()
        return wrench, pressure, torch.zeros_like(given["anchor"]).index_copy(0, at.sample, anchor)

    def pull(
        self,
        x: torch.Tensor,
        wrench: torch.Tensor,
        pressure: torch.Tensor,
        anchor: torch.Tensor,
        shape: bool = False,
        memory: Memory | None = None,
    ) -> dict:
        """Cotangents of the step's inputs, by the names of GIVEN, from those of its outputs: the transpose of
        `push`, which PyTorch finds.

        Args:
          x: (nvert, nworld, 3). wrench: (ngroup, nworld, 6). pressure: (nworld,).
          anchor: (nsample nworld, 3), ignored for samples without contact.
          shape: also of rest positions, "vert" (nvert, 3).
          memory: of the rubber at the end of the step; None without memory. Adds "memory" at its start, and
            "constants" of it.
        """
        with torch.enable_grad():
            inputs = {name: value.requires_grad_() for name, value in self.none().items()}
            nodes = torch.zeros_like(x).requires_grad_()
            force, held = self._load(inputs)
            ends = self._ends(inputs, nodes, held)
        cotangents = wrench, pressure, anchor
        g = x + transposed(ends, [nodes], cotangents)[0]
        if memory:
            deformation = self.memory.pull_deformation(memory)
            g += torch.from_numpy(self.memory.pull_nodes(deformation))[:, None]
        balance = self.solve(g, transpose=True)
        found = transposed((force, *ends), list(inputs.values()), (balance, *cotangents))
        given = dict(zip(inputs, found))
        if memory:
            own = self.memory.pull(memory, balance[:, 0].numpy())
            given["memory"], given["constants"], moduli = own
            for name, slope in moduli.items():
                given[name] += slope
        if shape:
            fixed = (1 - self._free) * (g - self._whole_tangent(balance, transpose=True))
            with torch.enable_grad():
                vert = torch.zeros_like(x[:, 0]).requires_grad_()
                moved = push_rest(self._skin, self.record.x[:, 0].numpy(), vert)
            (by_rubber,) = transposed([moved], [vert], [balance[:, 0]])
            given["vert"] = (fixed[:, 0] + by_rubber).numpy()
            if memory:
                given["vert"] += self.memory.pull_rest(deformation)
        return given

    def push(
        self,
        given: dict,
        vert: torch.Tensor | None = None,
        memory: Memory | None = None,
        constants: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, Memory | None]:
        """Tangents of the step's outputs, as named in `pull`, from those of its inputs, of rest positions
        (nvert, 3), of the old memory and of the memory's constants; omitted ones are zero."""
        given = self.none() | given
        force, held = self._load(given)
        if memory:
            moduli = {name: float(given[name]) for name in ("mu", "lam")}
            own = constants.numpy()
            force += torch.from_numpy(self.memory.push_force(memory, own, moduli))[:, None]
        fixed = torch.zeros_like(force)
        if vert is not None:
            fixed = (1 - self._free) * vert[:, None]
            moved = push_rest(self._skin, self.record.x[:, 0].numpy(), vert)
            force += moved[:, None] - self._whole_tangent(fixed)
        x = self.solve(force) + fixed
        if memory:
            there = None if vert is None else vert.numpy()
            memory = self.memory.push(memory, own, moduli, x[:, 0].numpy(), there)
        return x, *self._ends(given, x, held), memory
