"""SkinData: state and results of a skin in every world."""

import types
import typing

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..fields import check_choice
from ..kernels import add_zeros, set_fields
from ..threads import single_thread
from .bodies import make_bodies
from .contact.broadphase import ClearanceCache
from .contact.faces import Contact, Laws
from .contact.law import WorldLaws
from .liquid import Liquid, Rest
from .model import SkinModel, Surface, stiffness_of_contact
from .newton.bodies import BodyContact
from .newton.nodes import SurfaceForces
from .newton.worlds import Worlds
from .precondition.dense import DensePreconditioner
from .precondition.sparse import SparsePreconditioner
from .program import Launcher
from .rubber.element_forces import ElementForces
from .rubber.material import Material
from .rubber.memory import RubberMemory, rubber_of_worlds
from .state import FULL, allocate, clear, options_of, zeros
from .types import Precision, mat33, real, vec3

if typing.TYPE_CHECKING:
    from .geoms import GeomSet
    from .precondition import Preconditioner


class ContactState:
    """Contact of one surface: anchors, and results of the last evaluation; see `state.VARIABLES`, where
    `holder` is its name."""

    def __init__(
        self,
        holder: str,
        surface: Surface,
        nsample: int,
        nvert: int,
        nworld: int,
        options: frozenset,
        tier: str,
    ):
        nface = len(surface.face)
        sizes = {"sample": nface * nsample, "face": nface, "vert": nvert, "world": nworld}
        self.surface, self.clearances = surface, ClearanceCache()
        allocate(holder, self, sizes, options, tier)
        if not self.bond.size:  # without a contact law they are equal
            self.bond = self.trial_geom
        self.trial_anchor = zeros(self.anchor.shape, vec3, tier)
        self.sample_force = zeros(self.anchor.shape, vec3, tier)  # of samples that touch [N]
        self.corner = zeros((3 * nface, nworld), vec3, tier)
        self.block = zeros((6 * nface, nworld), mat33, tier)
        self.forces = self._shared(SurfaceForces())
        cache = self.clearances
        cache.mark = wp.full(nworld, -1, dtype=int)
        add_zeros(cache, "travel", nworld)
        add_zeros(cache, "seen", 3 * nface, nworld)
        add_zeros(cache, "since", nface, nworld)
        add_zeros(cache, "count", 2)
        add_zeros(cache, "unknown near", nface * nworld)
        self._host = None

    def contact(
        self,
        sample: wp.array,
        stick_ratio: float,
        stiffness: wp.array,
        laws: Laws,
        x_last: wp.array,
        bound: wp.array,
    ) -> Contact:
        """`Contact` of this surface for kernels: its arrays, and the given fields."""
        out = self._shared(Contact())
        out.sample, out.stick_ratio, out.stiffness, out.laws = sample, stick_ratio, stiffness, laws
        out.x_last, out.bound = x_last, bound
        return out

    def _shared(self, struct):
        """A struct with those of its fields that the state or its surface has by the same name."""
        known = vars(self.surface) | vars(self)
        return set_fields(struct, **{name: known[name] for name in struct._cls.vars if name in known})

    def active(self, w: int) -> tuple[np.ndarray, np.ndarray]:
        """Touching faces (n,) of world w, and their tangents (n, 6, 3, 3), on the host."""
        if self._host is None or self.touching.device.is_cuda:
            # views on the CPU, which follow the arrays
            self._host = self.touching.numpy(), self.block.numpy()
        touching, block = self._host
        faces = touching[:, w].nonzero()[0]
        return faces, block[6 * faces[:, None] + np.arange(6), w]


class SkinData:
    """State and outputs of `nworld` skins.

    Args:
      model: the SkinModel.
      nworld: number of worlds.
      material: None, or one Material of the model's law and effects for each world.
      modulus: (nworld, nelem) factors on Young's modulus of the solved elements; the model must have a
        modulus. None takes the model's.
      preconditioner: "sparse" (CPU, double precision) or "dense" (half precision, directions in single
        precision); None chooses by the model's device. With "dense", solves are slower if more than
        `contact_capacity` nodes touch in a world.
      tier: `state.FULL`, or CONDENSED for a `condensed` step, which has its own contact with the core, so
        that `core` is None.

    Attributes (all arrays lead with nworld, copies on the host):
      vert_xpos: (nworld, nvert, 3) nodal positions in the BioTac frame [m].
      contact_force: (nworld, nvert, 3) nodal forces of the touching geoms on the skin [N].
      core_force: (nworld, nvert, 3) nodal forces of the core on the inner surface [N].
      liquid_force: (nworld, nvert, 3) nodal forces of the liquid on the inner surface [N].
      reaction: (nworld, 3) force of core, nail and clamp on the fixed nodes [N].
      wrench: (nworld, ngroup, 6) of the skin ON each group of geoms, torque about the BioTac frame's origin
        [N, N m].
      pressure: (nworld,) of the liquid above that without contact [Pa].
      volume: (nworld,) of the liquid [m^3].
      converged: (nworld,) whether the last step converged.
      load_factor: (nworld,) fraction of the geoms' path in the last step at which positions, wrench, pressure
        and tangent are valid: 1 if it converged, or ended with its best iterate (`load_path.end_path`).
      nonconverged: (nworld,) number of steps since the reset that did not converge.
      iterations: (nworld,) Newton iterations of the last step.
      error: (nworld,) estimated relative error of the last step in the energy norm.

    On the device, [item, world] in Warp arrays that may be overwritten between steps:
      worlds: `newton.worlds.Worlds`, scalars of every world. rubber: `rubber.points.Rubber`.
      rest_vert: nodes without contact (nvert, 1), or (nvert, nworld) if worlds have rests of their own.
      rests: `liquid.Rest` of worlds with rests of their own, else None.
      laws: `contact.law.WorldLaws`. memory: RubberMemory, or None.
      x, velocity, dt, frame_pos, frame_mat: nodes [m], their velocities in the world [m/s], time step [s],
        and the pose of the BioTac frame in the world at the end of the step.
      bodies: `bodies.Bodies` of compliant bodies, see `make_bodies_compliant`; None: poses are prescribed.
      body_contact: their `newton.bodies.BodyContact`.

    Raises:
      ValueError: materials with other effects than the model's, an unknown or impossible preconditioner, or a
        modulus of another shape.
    """

    # most touching nodes in a world's dense Woodbury system. The matrix of up to 63 nodes fits into
    # registers; with geoms of a centimetre, which touch more, that limit took ten times as many products
    contact_capacity = 127

    def __init__(
        self,
        model: SkinModel,
        nworld: int = 1,
        material: list[Material] | None = None,
        modulus: np.ndarray | None = None,
        preconditioner: str | None = None,
        tier: str = FULL,
    ):
        materials = [model.material] * nworld if material is None else list(material)
        if len(materials) != nworld or any(m.law != model.material.law for m in materials):
            raise ValueError(f"pass one {model.material.law} material for each of the {nworld} worlds")
        self.options = model.rubber_options
        _refuse_other_kinds(materials, model.material, self.options)
        self.nworld, self.model, self.made_for = nworld, model, model.options
        self.rubber = rubber_of_worlds(model, materials, _modulus_of_worlds(model, modulus, nworld))
        options = options_of(model.material.extensions, model.options)
        sizes = len(model.sample), model.nvert, nworld
        with wp.ScopedDevice(model.device):
            allocate("data", self, {"vert": model.nvert, "world": nworld}, options, tier)
            self.gradient = wp.zeros_like(self.x)  # of the liquid's volume
            self.outer = ContactState("outer", model.outer, *sizes, options, tier)
            self.core = None
            if model.has_core and tier == FULL:  # the condensed tier has its own contact with the core
                self.core = ContactState("core", model.core_surface, *sizes, options, tier)
            self.rest_vert = wp.array(model.rest.vert[:, None], dtype=vec3)
            self.rest_pressure = wp.full(nworld, float(model.rest.pressure), dtype=real)
            self.dt = wp.zeros(nworld, dtype=real)
            self.frame_pos = wp.zeros(nworld, dtype=vec3)
            self.frame_mat = wp.array(np.tile(np.eye(3), (nworld, 1, 1)), dtype=mat33)
            wp.copy(self.frame_mat_last, self.frame_mat)
            self.worlds = Worlds()
            add_zeros(self.worlds, " ".join(Worlds.vars), nworld)
        self.rests, self.rests_alike = None, False  # the latter: all worlds must keep the model's rest
        self.worlds.wanted.fill_(1)
        self.worlds.mu, self.worlds.lam = self.rubber.mu, self.rubber.lam
        self.worlds.density.assign([float(m.density) for m in materials])
        stiffness = [model.options.contact_stiffness or stiffness_of_contact(m) for m in materials]
        self.worlds.contact_stiffness.assign(stiffness)
        self.laws = WorldLaws(model, materials, np.array(stiffness))
        self.worlds.load_dependent = self.laws.load_dependent
        self.liquid = Liquid(model, nworld, self.worlds) if model.inner is not None else None
        remembers = model.material.remembers
        self.memory = RubberMemory(model, self.rubber, self.options) if remembers else None
        self._preconditioner, self._chosen = None, _choose(model, preconditioner)
        self.steps, self._vectors, self.external = {}, None, None  # see `step`
        self.bodies = self.body_contact = None
        self._touched, self._of_groups, self._counts = {}, {}, (0, 0)
        self.reset()

    # --- parts of a step, made at the first access ---

    @property
    def chunk(self) -> int:
        """Nodes that one thread sums: few with few worlds, many with many worlds."""
        if not self.model.device.is_cuda:
            return self.model.nvert
        return 4 if self.nworld < 32 else 8 if self.nworld < 256 else 16

    @property
    def preconditioner(self) -> "Preconditioner":
        """A `precondition.Preconditioner`."""
        if self._preconditioner is None:
            self._preconditioner = self._chosen(self)
        return self._preconditioner

    @property
    def precision(self) -> Precision:
        """Precision of directions, a `types.Precision`."""
        return self._chosen.precision

    def element_forces(self) -> ElementForces:
        """The elements, with result arrays of their own."""
        return ElementForces(self.model.elements, self.rubber, self.options, self.precision)

    def geom_memory(self, count: int, ngroup: int) -> tuple[wp.array, wp.array, wp.array]:
        """Last motion of the geoms [geom, world], flags of those that touch, and wrenches on groups [group,
        world, 6]."""
        self._counts, touched = (count, ngroup), self.touched(count)
        if ngroup not in self._of_groups:
            shape = (ngroup, self.nworld, 6)
            self._of_groups[ngroup] = wp.zeros(shape, dtype=real, device=self.model.device)
        return touched.motion, touched.touched_by, self._of_groups[ngroup]

    def touched(self, count: int) -> types.SimpleNamespace:
        """Arrays of the holder "touched" in `state.VARIABLES`, for `count` geoms."""
        if count not in self._touched:
            self._touched[count] = types.SimpleNamespace()
            with wp.ScopedDevice(self.model.device):
                allocate("touched", self._touched[count], {"geom": count, "world": self.nworld})
        return self._touched[count]

    # --- set by the user ---

    def reset(self) -> None:
        """Resets every world to its state without contact, with its filling."""
        if self.liquid:
            self.liquid.reset()
        holders = [("data", self), ("worlds", self.worlds), ("outer", self.outer), ("core", self.core)]
        holders += [("rubber", self.rubber if self.memory else None)]
        holders += [("touched", touched) for touched in self._touched.values()]
        for holder, owner in holders:
            if owner is not None:
                clear(holder, owner, self)
        if self.memory:
            self.memory.forget(self.x)
        for wrench in self._of_groups.values():
            wrench.zero_()
        self._counts = (0, 0)
        self.set_external(None)

    def rest_at(self, rests: Rest) -> None:
        """Sets each world's own equilibrium without contact, and resets it. Call it before steps are
        recorded."""
        self.rests = rests
        with wp.ScopedDevice(self.model.device):
            self.rest_vert = wp.array(np.ascontiguousarray(np.swapaxes(rests.vert, 0, 1)), dtype=vec3, ndim=2)
        self.rest_pressure.assign(rests.pressure)
        self.liquid.rest_at(rests.pressure, rests.volume, rests.natural_volume)
        self.reset()

    def make_bodies_compliant(self, ngroup: int) -> None:
        """Makes the bodies of `ngroup` groups of geoms compliant: they move by `bodies.compliance` times the
        difference between the skin's wrench and `bodies.predicted`. Write these, and the origins, arms and
        spins, before each step."""
        self._forget_steps()
        self._preconditioner, w, n = None, self.nworld, 6 * ngroup
        with wp.ScopedDevice(self.model.device):
            self.bodies, self.body_contact = make_bodies(ngroup, w), BodyContact()
            add_zeros(self.body_contact, "group", len(self.model.outer.face), w)
            add_zeros(self.body_contact, "skin_wrench residual step displacement pending", ngroup, w)
            add_zeros(self.body_contact, "inverse", w, n, n)
            add_zeros(self.body_contact, "pivot", w, n)
            add_zeros(self.body_contact, "wrench_known has_pending", w)

    def _forget_steps(self):
        for one in self.steps.values():
            one.forget()
        self.steps.clear()

    def __del__(self):
        if hasattr(self, "steps"):  # not if __init__ failed
            self._forget_steps()

    def set_external(self, force: ArrayLike | None) -> None:
        """Loads the nodes in every step until `reset`.

        Args:
          force: (nworld, nvert, 3) [N], or None for no load.

        Raises:
          ValueError: a wrong shape or NaN.
        """
        shape = (self.nworld, self.model.nvert, 3)
        if force is None:
            if self.external is not None:
                self._forget_steps()  # they were recorded with loads
            self.external = None
            return
        force = np.asarray(force, float)
        if force.shape != shape or not np.isfinite(force).all():
            raise ValueError(
                f"external forces have shape {force.shape}: pass finite numbers of shape {shape}"
            )
        if self.external is None:
            self._forget_steps()  # they were recorded without loads
            self.external = wp.zeros_like(self.x)
        self.external.assign(np.ascontiguousarray(np.swapaxes(force, 0, 1)))

    def set_liquid(self, bulk_modulus: ArrayLike | None = None, fill_volume: ArrayLike | None = None) -> None:
        """Sets each world's liquid, from the next step on; `reset` keeps it.

        Args:
          bulk_modulus: (nworld,) or a number [Pa]; 0: no liquid; math.inf: incompressible.
          fill_volume: (nworld,) or a number: liquid in addition to the model's filling [m^3]. The skin
            inflates in the next step.

        Raises:
          ValueError: a model without liquid, NaN, a negative bulk modulus, a negative amount of liquid, or
            another filling of skins of the condensed tier.
        """
        if not self.model.has_liquid:
            raise ValueError("this model has no liquid: make it with SkinOptions(liquid=True)")
        if fill_volume is not None and self.rests_alike:
            raise ValueError(
                "skins of the condensed tier keep the filling that they were made with: give fill_volume in "
                "options['skin'], or choose the full tier"
            )
        self.liquid.set(bulk_modulus, fill_volume)

    # --- read by the user ---

    @property
    def converged(self) -> np.ndarray:
        return self.worlds.reason.numpy() == 0

    @property
    def load_factor(self) -> np.ndarray:
        return self.worlds.load_factor.numpy().copy()

    @property
    def nonconverged(self) -> np.ndarray:
        return self.worlds.nonconverged.numpy().astype(int)

    @property
    def iterations(self) -> np.ndarray:
        return self.worlds.iterations.numpy().astype(int)

    @property
    def error(self) -> np.ndarray:
        return self.worlds.error.numpy().copy()

    @property
    def motion(self) -> np.ndarray:
        """Motion (nworld, ngeom, 3) of the geoms in the last step [m]."""
        return _leading(self.geom_memory(*self._counts)[0])

    @property
    def wrench(self) -> np.ndarray:
        return _leading(self.geom_memory(*self._counts)[2])

    @property
    def pressure(self) -> np.ndarray:
        if not self.model.has_liquid:
            return np.zeros(self.nworld)
        return self.liquid.gauge_pressure - self.liquid.rest_pressure

    @property
    def volume(self) -> np.ndarray:
        return self.liquid.volume if self.liquid else np.zeros(self.nworld)

    @property
    def vert_xpos(self) -> np.ndarray:
        return _leading(self.x)

    @property
    def contact_force(self) -> np.ndarray:
        return _leading(self.outer.node_force)

    @property
    def core_force(self) -> np.ndarray:
        if self.core is None:
            return np.zeros((self.nworld, self.model.nvert, 3))
        return _leading(self.core.node_force)

    @property
    def liquid_force(self) -> np.ndarray:
        if not self.model.has_liquid:
            return np.zeros((self.nworld, self.model.nvert, 3))
        return self.liquid.gauge_pressure[:, None, None] * _leading(self.gradient)

    @property
    def reaction(self) -> np.ndarray:
        return -self.force.numpy()[self.model.fixed].sum(0)

    def tangent(self, geoms: "GeomSet") -> np.ndarray:
        """Stiffness (nworld, ngroup, 6, 6) against rigid motions of each group of geoms about the BioTac
        frame's origin after a step [N/m, N, N m]."""
        shape = (geoms.ngroup, self.nworld)
        out = wp.zeros(shape, dtype=wp.spatial_matrixd, device=self.model.device)
        if geoms.ngroup:
            with single_thread():
                self.preconditioner.measure_tangents(Launcher(self.model.device), geoms, self.x, out)
        return _leading(out)

    def stress(self) -> tuple[np.ndarray, np.ndarray]:
        """Cauchy stress (nworld, nelem, 3, 3) and von Mises stress (nworld, nelem) of the tetrahedra [Pa]."""
        rubber = self.rubber
        if self.memory:
            rubber = self.memory.at_present()
        cauchy, mises = self.element_forces().stress(self.x, rubber)
        return _leading(cauchy), _leading(mises)


def _refuse_other_kinds(materials, own, options):
    """Refuses materials with other effects than the model's: worlds share compiled code, and may differ in
    numbers only."""
    for m in materials:
        for name in ("rest_pressure", "electrode_radius"):
            if getattr(m, name) != getattr(own, name):
                raise ValueError(
                    f"a world's material has a {name} of {getattr(m, name)} and the model's of "
                    f"{getattr(own, name)}: these belong to all worlds; fill worlds by fill_volume"
                )
        missing = [name for name in m.extensions if name not in options]
        if missing:
            raise ValueError(
                f"a world's material has {' and '.join(missing)} and the model's has not: give the model's "
                "material a small one as well"
            )
        for name in ("prony", "hysteresis"):
            count, wanted = len(getattr(m, name)), len(getattr(own, name))
            if count != wanted:
                raise ValueError(
                    f"a world's material has {count} terms of {name} and the model's {wanted}: give it as "
                    "many, with a strength of zero where it has none"
                )


def _modulus_of_worlds(model, modulus, nworld):
    """Factors (nelem, nworld), or None."""
    if modulus is None:
        return None if model.modulus is None else np.repeat(model.modulus[:, None], nworld, 1)
    modulus, shape = np.asarray(modulus, float), (nworld, model.nelem)
    if model.modulus is None:
        raise ValueError(
            "the worlds have a modulus of their own and the model has none: make it with modulus="
        )
    if modulus.shape != shape or not (np.isfinite(modulus) & (modulus > 0)).all():
        raise ValueError(f"modulus has shape {modulus.shape}: pass positive factors of shape {shape}")
    return np.ascontiguousarray(modulus.T)


def _choose(model, preconditioner):
    known = {"sparse": SparsePreconditioner, "dense": DensePreconditioner}
    if preconditioner is None:
        preconditioner = "dense" if model.device.is_cuda else "sparse"
    check_choice("unknown preconditioner", preconditioner, known)
    if preconditioner == "sparse" and model.device.is_cuda:
        raise ValueError("the sparse preconditioner runs on the CPU: choose 'dense', or make the model there")
    return known[preconditioner]


def _leading(array: wp.array) -> np.ndarray:
    # a copy, since the next step would change a view
    return np.swapaxes(array.numpy(), 0, 1).copy()
