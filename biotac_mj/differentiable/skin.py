"""Differentiable skins and their geoms, with steps solved to a small tolerance."""

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike

from ..geometry.skin_geometry import SkinGeometry
from ..kernels import kernel_module
from ..skin import GeomSet, Material, SkinData, SkinModel, SkinOptions
from ..skin.contact.meshes import DistanceGrid
from ..skin.program import Program
from ..skin.rubber.element_forces import ElementForces
from ..skin.state_arrays import StateArrays
from ..skin.step import SkinStep, prepare_step
from ..skin.types import DOUBLE, real, vec3
from .linear.factors import Factors
from .memory_constants import constants_of

# tolerance of a step: the gradient is that of an equilibrium, so the residual is its error
TOLERANCE, MAX_NEWTON, MAX_WORK = 1e-6, 300, 6000
FINEST = 1e-9  # least precision of linear solves, below which a step's own rounding matters

# constants of a skin in its kernels: shear modulus and second constant of the law [Pa], stiffness of the
# contact [Pa/m], volume of the liquid without pressure [m^3], its bulk modulus over that [Pa/m^3]
NUMBERS = ("mu", "lam", "contact_stiffness", "natural", "kappa")


@wp.kernel(module=kernel_module(f"{__name__}.sums"))
def _sum_corners(
    # In:
    start: wp.array(dtype=int),
    slot: wp.array(dtype=int),
    corner: wp.array2d(dtype=vec3),
    # Out:
    sum_out: wp.array2d(dtype=vec3),
):
    """Sums the elements' corner values at the nodes."""
    i, w = wp.tid()
    total = vec3()
    for k in range(start[i], start[i + 1]):
        total += corner[slot[k], w]
    sum_out[i, w] = total


class _Replayed:
    """A program, recorded on its first run. On CUDA it is a graph from its second run on: the first one
    compiles its kernels and allocates PyTorch's workspaces, which is not allowed in a capture."""

    def __init__(self, device, record):
        self._device, self._record, self._program, self._graph = device, record, None, None

    def run(self):
        if self._program is None:
            self._program = Program(self._device, self._record)
            self._program.run()
            return
        if not self._device.is_cuda:
            self._program.run()
            return
        if self._graph is None:
            with wp.ScopedCapture(self._device) as capture:
                self._program.run()
            self._graph = capture.graph
        wp.capture_launch(self._graph)


class SkinWorlds:
    """A skin in several worlds on one device, and its geoms.

    Args:
      model: of the skin. made_with: arguments of `skin.GeomSet`. nworld: number of worlds.
      precision: of the linear solves of a gradient.
      preconditioner: of the steps, see `SkinData`.
      smooths: whether first contact can be smooth.
      owner: another skin that owns the model and changes its rest positions, or None.

    Attributes:
      model, data, geoms: SkinModel, SkinData, GeomSet. nothing: an empty GeomSet. nworld, device: of them.
      weights: (s, 3) barycentric, of the samples of a face; sample_weights: the same, a tensor on the device.
      surfaces: numbers of outer faces, and of those that can touch the core.
      factors: of its stiffness, for linear solves on the CPU. products: number since `begin_solves`.
      constants: of its memory, see `memory_constants.constants_of`; empty without memory.
      rest: (nvert, 3) rest positions of all solved nodes [m].
      smoothing: half width of first contact in the current press [m].
      lock: held during a press or a gradient: the skin's state serves one thread at a time.
    """

    def __init__(
        self,
        model: SkinModel,
        made_with: dict,
        nworld: int,
        precision: float,
        preconditioner: str | None = None,
        smooths: bool = False,
        owner: "SkinWorlds | None" = None,
    ):
        self.model, self.made_with, self.nworld, self.precision = model, made_with, nworld, precision
        self.device, self.lock = model.device, threading.RLock()
        self.rest = model.geometry.vert.copy()
        self._lies, self._owner = self.rest, owner
        self.data = data = SkinData(model, nworld, preconditioner=preconditioner)
        self.smoothing, self._smoothing = 0.0, None
        if smooths:  # before a step is recorded, which then uses kernels with smoothing
            self._smoothing = wp.zeros(nworld, dtype=real, device=self.device)
            data.laws.struct.smoothing = self._smoothing
        self.geoms = GeomSet(**made_with, nworld=nworld, device=self.device)
        self.nothing, self._states = GeomSet([], [], nworld=nworld, device=self.device), {}
        core = data.core
        self.surfaces = len(model.outer.face), len(core.surface.face) if core else 0
        self.weights = model.sample.numpy()
        self.constants = constants_of(model.material)
        self.factors, self.products = None if self.device.is_cuda else Factors(model), 0
        with wp.ScopedDevice(self.device):
            self._on = wp.ones(nworld, dtype=int)
            direction, at_nodes = (wp.zeros_like(data.x) for _ in range(2))
        self._direction, self._at_nodes = (wp.to_torch(array) for array in (direction, at_nodes))
        self.sample_weights = torch.as_tensor(self.weights, device=self.torch_device).double()
        # a separate preconditioner; the steps' one, if it has double precision, belongs to the shape in which
        # they left it
        parts = model.elements, data.rubber, data.options, DOUBLE
        self._elements, steps = ElementForces(*parts), self.solver(self.geoms)
        self._stepped = steps.k.elements if data.precision is DOUBLE else self._elements
        # recorded, because packing their arguments takes as long as their work
        x, on, p, total = data.x, self._on, direction, at_nodes
        elements, stepped, inverted = self._elements, self._stepped, data.worlds.inverted
        lists = [elements.start, elements.slot]

        def push(program):
            elements.evaluate_corners(program, x, on, inverted)
            program.launch(_sum_corners, total.shape, [*lists, elements.corner_force], [total])

        def collect(program):
            program.launch(_sum_corners, total.shape, [*lists, stepped.corner_force], [total])

        def multiply(program):
            stepped.multiply_corners(program, x, p, on)
            program.launch(_sum_corners, total.shape, [*lists, stepped.corner], [total])

        self._push, self._collect, self._multiply = (
            _Replayed(self.device, record) for record in (push, collect, multiply)
        )
        # inputs of the steps' preconditioner: `touching` and `block` of the surfaces; k.r; its output k.z
        self.precondition = _Replayed(self.device, steps.put_preconditioner)
        self.invert = _Replayed(self.device, steps.put_inverse)

    # --- tensors ---

    @property
    def torch_device(self) -> torch.device:
        """The device in PyTorch's form."""
        return torch.device(str(self.device))

    def tensor(self, array: np.ndarray) -> torch.Tensor:
        """On the device."""
        return torch.as_tensor(np.ascontiguousarray(array), device=self.torch_device)

    @contextlib.contextmanager
    def stream(self) -> Iterator[None]:
        """Makes PyTorch launch on Warp's stream."""
        if not self.device.is_cuda:
            yield
            return
        torch.cuda.synchronize(self.torch_device)
        with torch.cuda.stream(wp.stream_to_torch(self.device)):
            yield
        torch.cuda.synchronize(self.torch_device)

    # --- the skin ---

    def rest_at(self, vert: np.ndarray) -> None:
        """Changes the rest positions to (nvert, 3) [m]; a filled skin starts a press as far from them as from
        its own.

        Raises:
          ValueError: a tetrahedron would be inverted, degenerate or folded; the skin is then unchanged.
        """
        if self._owner:
            self._owner.rest_at(vert)
            return
        if np.array_equal(vert, self._lies):
            return
        self.model.elements.rest_at(vert)
        self.model.outer.rest_at(vert)
        for surface in (self.model.inner, self.data.core and self.data.core.surface):
            if surface:
                surface.rest_at(vert)
        self.data.rest_vert.assign((vert + (self.model.rest.vert - self.rest))[:, None])
        self._lies = vert.copy()

    def smooth(self, width: float) -> None:
        """Smooths the kinks of contact over a half width [m] of first touch, 0 for none."""
        if width != self.smoothing:
            self.smoothing = width
            self._smoothing.fill_(width)

    def solver(self, geoms: GeomSet) -> SkinStep:
        """The step of the skin with `self.geoms` or `self.nothing`."""
        return prepare_step(self.model, self.data, geoms)

    def state(self, geoms: GeomSet) -> StateArrays:
        """State of the skin with `self.geoms` or `self.nothing`."""
        if id(geoms) not in self._states:
            self._states[id(geoms)] = StateArrays(self.data, geoms)
        return self._states[id(geoms)]

    def read(self, *names: str) -> dict:
        """Numbers of `newton.worlds.Worlds` by name, (nworld,)."""
        return {name: wp.to_torch(getattr(self.data.worlds, name)).clone() for name in names}

    def write(self, numbers: dict) -> None:
        """Inverse of `read`; numbers are common to all worlds or (nworld,)."""
        for name, value in numbers.items():
            wp.to_torch(getattr(self.data.worlds, name)).copy_(torch.as_tensor(value))

    # --- linear algebra ---

    def begin_solves(self) -> None:
        """Call before a gradient, which must not depend on earlier ones."""
        self.products = 0
        if self.factors:
            self.factors.begin()

    def count_products(self, count: int, x: torch.Tensor) -> None:
        """Call after a solve that took so many products with the tangent at x (nvert, nworld, 3) [m]."""
        self.products += count
        if self.factors and self.nworld == 1:
            self.factors.count(count, x[:, 0].numpy())

    def multiply_rubber(self, p: torch.Tensor) -> torch.Tensor:
        """Tangent of the rubber at the last evaluation of forces (`record.restore`), times p (nvert, nworld,
        3)."""
        self._direction.copy_(p)
        return self._found(self._multiply)

    def _found(self, program):
        program.run()
        return self._at_nodes.clone()

    @contextlib.contextmanager
    def another_lam(self) -> Iterator[torch.Tensor]:
        """Temporarily sets another second constant of the law (nworld,), which is returned, on the same side
        of `Tetrahedra.cap`."""
        mu, array = wp.to_torch(self.data.rubber.mu), wp.to_torch(self.data.rubber.lam)
        lam = array.clone()
        half = 0.5 * torch.where(lam == 0, mu, lam)
        other = torch.where(lam > self.model.elements.cap * mu, 2 * lam, half)
        array.copy_(other)
        yield other
        array.copy_(lam)

    def rubber_slopes(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Derivatives of the rubber's forces (nvert, nworld, 3) by both its constants, at the last
        evaluation.

        Forces are homogeneous in both constants, and linear in the second on either side of `Tetrahedra.cap`:
        two evaluations are exact. `linear.memory` has the derivatives of history and softening."""
        mu, lam = (wp.to_torch(getattr(self.data.rubber, name)).clone() for name in ("mu", "lam"))
        with self.another_lam() as other:
            there = self._push_virgin()
        at_hand = self._stepped is not self._elements and not self.data.memory
        here = self._found(self._collect) if at_hand else self._push_virgin()
        by_lam = (there - here) / (other - lam)[:, None]
        return (here - lam[:, None] * by_lam) / mu[:, None], by_lam

    def _push_virgin(self):
        """Forces of rubber without past stress and softening [N]."""
        rubber = self.data.rubber
        past = [getattr(rubber, "past", None), rubber.mullins] if self.data.memory else []
        kept = [(a, wp.clone(a)) for a in past if a is not None]
        for array, _ in kept:
            array.zero_()
        force = self._found(self._push)
        for array, value in kept:
            wp.copy(array, value)
        return force

    def point_slopes(self, change: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `ElementForces.point_slopes`, at the current nodes."""
        return self._elements.point_slopes(self.data.x, change)


class Skin(SkinWorlds):
    """A skin and its geoms, in a single world on the CPU.

    Args:
      geometry: of the skin.
      material: a preset's name or a Material.
      options: SkinOptions; tolerance and limits are tightened to TOLERANCE, MAX_NEWTON and MAX_WORK.
      types, sizes, friction, groups, rounding, grids: of the geoms, as in `skin.GeomSet`.
      modulus: factors on Young's modulus, as in `skin.SkinModel`.
      precision: of the linear solves of a gradient; None: a hundredth of the steps' tolerance, which limits
        the gradient's accuracy, and at least FINEST.

    Attributes:
      model, data, geoms: SkinModel, SkinData of one world, GeomSet; others see `SkinWorlds`.
      rest: (nvert, 3) rest positions of all solved nodes [m]; the first `given` are the geometry's, others
        are on its edges.
      own: NUMBERS of its material and filling. friction: (ngeom,) default Coulomb coefficients of a press.

    Raises:
      ValueError: an option without gradient, see `refuse_beyond`, or errors of the parts.
    """

    def __init__(
        self,
        geometry: SkinGeometry,
        material: str | Material = "default",
        options: SkinOptions | None = None,
        types: Sequence[str] = (),
        sizes: Sequence = (),
        friction: ArrayLike | None = None,
        groups: ArrayLike | None = None,
        rounding: ArrayLike | None = None,
        grids: Sequence[DistanceGrid] = (),
        modulus: ArrayLike | Callable | None = None,
        precision: float | None = None,
    ):
        given = options or SkinOptions()
        tight = dataclasses.replace(
            given,
            tolerance=min(given.tolerance, TOLERANCE),
            max_newton=max(given.max_newton, MAX_NEWTON),
            max_work=max(given.max_work, MAX_WORK),
        )
        model = SkinModel(geometry, material, tight, modulus=modulus)
        refuse_beyond(model)
        if "ellipsoid" in types:
            raise ValueError("gradients of an ellipsoid are not there: take a mesh, or spheres and capsules")
        friction = np.full(len(types), model.material.friction) if friction is None else friction
        names = "types", "sizes", "friction", "groups", "rounding", "grids"
        made_with = dict(zip(names, (types, sizes, friction, groups, rounding, grids)))
        precision = max(FINEST, 1e-2 * tight.tolerance) if precision is None else precision
        super().__init__(model, made_with, 1, precision, smooths=True)
        self._made_of, self.given = (geometry, modulus), geometry.nvert
        self.friction = self.geoms.struct.friction.numpy()[:, 0].copy()
        self.own = {name: float(value) for name, value in self.read(*NUMBERS).items()}
        self._worlds = None, None

    def in_worlds(self, nworld: int, device: str) -> SkinWorlds:
        """The skin in several worlds on "cpu" or a CUDA device; the last ones are cached."""
        with self.lock:
            if self._worlds[0] != (nworld, device):
                model, owner = self.model, self
                if wp.get_device(device).is_cuda:
                    geometry, modulus = self._made_of
                    model = SkinModel(geometry, model.material, model.options, device, modulus=modulus)
                    owner = None
                made = SkinWorlds(model, self.made_with, nworld, self.precision, owner=owner)
                made.lock = self.lock  # it may share the model
                self._worlds = (nworld, device), made
            return self._worlds[1]


def refuse_beyond(model: SkinModel) -> None:
    """Raises ValueError with the option and a remedy if a skin has a feature without gradient."""
    o = model.options
    if o.dynamics != "quasistatic":
        raise ValueError("gradients of implicit dynamics are not there: take dynamics='quasistatic'")
    if o.contact_law is not None:
        raise ValueError("gradients of a contact_law are not there: leave it out, friction is Coulomb's then")
    if o.rest_pressure:
        fill = model.rest.natural_volume - model.liquid_volume
        raise ValueError(
            f"gradients of a skin filled to rest_pressure are not there: give the same as "
            f"fill_volume={fill:.6g} and rest_pressure=0"
        )
