"""A skin and its geoms that gradients can pass through: one world on the CPU, steps solved tightly."""

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..geometry.skin_geometry import SkinGeometry
from ..skin import GeomSet, Material, SkinData, SkinModel, SkinOptions
from ..skin.contact.meshes import DistanceGrid
from ..skin.program import Program
from ..skin.state_arrays import StateArrays
from ..skin.step import SkinStep, prepare_step
from ..skin.types import real, vec3
from .linear.inverse import FaceBlocks, Factors
from .memory_constants import constants_of

__all__ = ["NUMBERS", "TOLERANCE", "Skin", "refuse_beyond", "sum_corners"]

# of a step: the gradient is that of a balance, and wrong by as much as that is missed
TOLERANCE, MAX_NEWTON, MAX_WORK = 1e-6, 300, 6000
FINEST = 1e-9  # precision of linear solves, below which a step's own rounding is felt

# what a skin is made of, as its kernels take it: shear modulus and second constant of the law [Pa], stiffness
# of the contact [Pa/m], volume of the liquid without pressure [m^3], its bulk modulus over that [Pa/m^3]
NUMBERS = ("mu", "lam", "contact_stiffness", "natural", "kappa")


@wp.kernel(module=f"{__name__}.sums", enable_backward=False)
def sum_corners(
    # In:
    start: wp.array(dtype=int),
    slot: wp.array(dtype=int),
    corner: wp.array2d(dtype=vec3),
    # Out:
    sum_out: wp.array2d(dtype=vec3),
):
    """At the nodes, of what the elements' corners have."""
    i, w = wp.tid()
    total = vec3()
    for k in range(start[i], start[i + 1]):
        total += corner[slot[k], w]
    sum_out[i, w] = total


class Skin:
    """A skin and what may touch it.

    Args:
      geometry: of the skin.
      material: a preset's name or a Material.
      options: SkinOptions; tolerance and limits are made at least as good as TOLERANCE, MAX_NEWTON and
        MAX_WORK.
      types, sizes, friction, groups, rounding, grids: of the geoms, as `skin.GeomSet` has them.
      modulus: factors on Young's modulus, as `skin.SkinModel` has them.
      precision: of the linear solves of a gradient; None: a hundredth of the steps' tolerance, which bounds
        what a gradient is worth, and FINEST at least.

    Attributes:
      model, data, geoms: SkinModel, SkinData of one world, GeomSet. nothing: a GeomSet of none.
      weights: (s, 3) barycentric, of the samples of a face.
      surfaces: numbers of outer faces, and of those that can meet the core.
      of_inner_faces: matrices of blocks of the faces that the liquid wets; None of a solid.
      factors: of its stiffness, for linear solves. own: NUMBERS of its material and filling.
      constants: of its memory, see `memory_constants.constants_of`; empty where it has none.
      rest: (nvert, 3) rest positions of all nodes that are solved [m]; the first `given` are the geometry's,
        others lie on its edges.
      smoothing: half width of first touch of what is pressed now [m].
      friction: (ngeom,) Coulomb's coefficients that a press has unless it is given others.
      made_of: geometry and modulus that it was given. made_with: what its GeomSet was.
      lock: of whoever presses it or asks for a gradient: its memory serves one thread at a time.

    Raises:
      ValueError: an option whose gradient is not there, see `refuse_beyond`, or what the parts raise.
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
        self.precision = max(FINEST, 1e-2 * tight.tolerance) if precision is None else precision
        self.model = SkinModel(geometry, material, tight, modulus=modulus)
        self.rest, self.given = self.model.geometry.vert.copy(), geometry.nvert
        self._lies = self.rest
        refuse_beyond(self.model)
        if "ellipsoid" in types:
            raise ValueError("gradients of an ellipsoid are not there: take a mesh, or spheres and capsules")
        self.data = SkinData(self.model)
        # before a step is recorded, which takes the kernels that know of it
        self.smoothing = 0.0
        self.data.laws.struct.smoothing = self._smoothing = wp.zeros(1, dtype=real, device="cpu")
        friction = np.full(len(types), self.model.material.friction) if friction is None else friction
        names = "types", "sizes", "friction", "groups", "rounding", "grids"
        self.made_of = geometry, modulus
        self.made_with = dict(zip(names, (types, sizes, friction, groups, rounding, grids)))
        self.geoms = GeomSet(**self.made_with)
        self.friction = self.geoms.struct.friction.numpy()[:, 0].copy()
        self.lock = threading.RLock()
        self.together = None, None, None  # what its worlds at once were made for, they, what goes back there
        self.nothing, self._states = GeomSet([], []), {}
        # one for its own use; the other is that of the steps, and knows the shape in which these left it
        self._elements, self._on = self.data.element_forces(), wp.ones(1, dtype=int, device="cpu")
        self._stepped = self.solver(self.geoms).k.elements
        self._direction = wp.zeros_like(self.data.x)
        # recorded: packing their arguments takes as long as what they do
        self._at_nodes = wp.zeros_like(self.data.x)
        x, on, p, total = self.data.x, self._on, self._direction, self._at_nodes
        elements, stepped, inverted = self._elements, self._stepped, self.data.worlds.inverted
        lists = [elements.start, elements.slot]

        def push(program):
            elements.push_corners(program, x, on, inverted)
            program.launch(sum_corners, total.shape, [*lists, elements.corner_force], [total])

        def collect(program):
            program.launch(sum_corners, total.shape, [*lists, stepped.corner_force], [total])

        def multiply(program):
            stepped.multiply_corners(program, x, p, on)
            program.launch(sum_corners, total.shape, [*lists, stepped.corner], [total])

        self._push, self._collect, self._multiply = (
            Program("cpu", record) for record in (push, collect, multiply)
        )
        core = self.data.core
        self.surfaces = len(self.model.outer.face), len(core.surface.face) if core else 0
        self.weights = self.model.sample.numpy()
        inner = self.model.inner  # None of a solid, which holds no liquid
        self.of_inner_faces = FaceBlocks(inner.face_np, self.model.nvert) if inner else None
        self.factors = Factors(self.model)
        self.own = self.read(*NUMBERS)
        self.constants = constants_of(self.model.material)

    def rest_at(self, vert: np.ndarray) -> None:
        """Lies at other rest positions (nvert, 3) [m], until it is told otherwise; a filled skin begins a
        press as far from them as from its own.

        Raises:
          ValueError: a tetrahedron would be inverted, degenerate or folded; then nothing has changed.
        """
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
        """The step of the skin under `self.geoms` or `self.nothing`."""
        return prepare_step(self.model, self.data, geoms)

    def state(self, geoms: GeomSet) -> StateArrays:
        """Of the skin under `self.geoms` or `self.nothing`."""
        if id(geoms) not in self._states:
            self._states[id(geoms)] = StateArrays(self.data, geoms)
        return self._states[id(geoms)]

    def multiply_rubber(self, p: np.ndarray) -> np.ndarray:
        """(3 nvert,) tangent of the rubber where forces were evaluated last (`record.restore`), times p
        (3 nvert,)."""
        self._direction.numpy()[:, 0] = p.reshape(-1, 3)
        return self._found(self._multiply)

    def _found(self, program):
        program.run()
        return self._at_nodes.numpy().ravel().copy()

    @contextlib.contextmanager
    def another_lam(self, mu: float, lam: float) -> Iterator[float]:
        """With another second constant of the law, which is told, on the same side of `Tetrahedra.cap`."""
        other = 2 * lam if lam > self.model.elements.cap * mu else 0.5 * (lam or mu)
        self.data.rubber.lam.fill_(other)
        yield other
        self.data.rubber.lam.fill_(lam)

    def virgin_rubber(self) -> np.ndarray:
        """`push_virgin_rubber` where forces were evaluated last."""
        return self.push_virgin_rubber() if self.data.memory else self._found(self._collect)

    def push_virgin_rubber(self) -> np.ndarray:
        """(3 nvert,) forces at the nodes of rubber whose points have no past stress and do not soften [N]."""
        rubber = self.data.rubber
        kept = [(a, wp.clone(a)) for a in (getattr(rubber, "past", None), rubber.mullins) if a is not None]
        for array, _ in kept:
            array.zero_()
        force = self._found(self._push)
        for array, value in kept:
            wp.copy(array, value)
        return force

    def point_slopes(self, change: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `ElementForces.point_slopes`, where the nodes are."""
        return self._elements.point_slopes(self.data.x, change)

    def read(self, *names: str) -> dict:
        """Numbers of `newton.worlds.Worlds` by name."""
        return {name: float(getattr(self.data.worlds, name).numpy()[0]) for name in names}

    def write(self, numbers: dict) -> None:
        """The inverse of `read`."""
        for name, value in numbers.items():
            getattr(self.data.worlds, name).fill_(value)


def refuse_beyond(model: SkinModel) -> None:
    """Raises ValueError, which names the option and what to do, where a skin has what no gradient is there
    for."""
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
