"""SkinModel: the constants of a skin, shared by all worlds."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sp
import warp as wp
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from ..fields import as_real, check_choice, check_types
from ..geometry.edge_nodes import with_edge_nodes
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.surface import face_areas, node_areas
from ..geometry.tet_mesh import enclosed_volume
from ..quiet import announce_compilation
from ..threads import single_thread
from . import liquid
from .contact.faces import face_samples
from .contact.law import ContactLaw, contact_law
from .contact.meshes import bake_distance_grid
from .contact.penetration import rest_gap
from .geoms import GeomSet
from .precondition.block_inverse import DissectedInverse
from .precondition.supernodal import SupernodalFactor, elimination_of
from .program import compile_for_skin
from .rubber.law import LAWS
from .rubber.material import ELEMENTS, Material, material
from .rubber.tetrahedra import Tetrahedra, incidence
from .types import real, vec3

# (SkinModel) -> liquid.Rest; set by the module `fill`, which imports `step` and thus this module
solve_rest = None

_GRID_SPACING = 4e-4  # of the core's distance grid [m], whose spline smooths the edges of triangles
_GRID_MARGIN = 3e-3  # of the core's distance grid around the core [m]
_COLUMN = 1e-3  # width of the columns in which points of the core follow each other [m]
# pressure of the core over E above which skin counts as passing through the core, if it is also deeper in it
# than a geom may be; confined rubber may have such a pressure
_CRUSHED = 50.0


@dataclasses.dataclass(frozen=True)
class SkinOptions:
    """Options of the skin's solver.

    Attributes:
      element: "linear" (four nodes) or "quadratic" (ten nodes: does not lock); None takes the material's
        choice, or else the geometry's. As linear elements, ten-node tetrahedra are divided into eight; as
        quadratic ones, four-node tetrahedra get a node on every edge, after the geometry's own nodes
        (`with_edge_nodes`).
      dynamics: "quasistatic" (no inertia) or "implicit" (backward Euler with lumped masses).
      liquid: whether liquid fills the space between skin and core; None takes the material's choice.
      bulk_modulus: of the liquid [Pa]; water has 2.2e9; math.inf: incompressible.
      fill_volume: liquid beyond the volume of the unstressed skin [m^3], may be negative. It inflates the
        skin without contact.
      rest_pressure: alternatively, the liquid's pressure without contact, above the surroundings [Pa]; None
        takes the material's choice if fill_volume is 0.
      core_contact: whether the inner surface can touch the rigid core.
      core_clearance: inner faces closer to the core than this in the reference configuration have no contact
        with the core [m].
      max_core_depth: largest depth of a geom in the core [m]; no skin fits between a deeper geom and the
      core.
      contact_stiffness: pressure per overclosure k [Pa/m]; None: 180 E per millimetre, the ratio of the
        reference solutions, with each world's own E.
      stick_ratio: tangential stiffness of sticking contact relative to k.
      samples: contact is sampled at samples^2 points per face.
      contact_law: a ContactLaw, or a dict of its fields: load-dependent friction, adhesion. None: Coulomb's
        law. Full tier only.
      mass_damping, stiffness_damping: Rayleigh damping of implicit dynamics [1/s], [s].
      tolerance: a step has converged if the estimated energy norm of its error is below this fraction of that
        of the load. This and the next three are for the full tier; steps of the condensed tier have a
        tolerance and limits of their own.
      max_newton, max_cg: iteration limits of a try and of each linear solve.
      max_work: limit of evaluations of all forces and products with their tangent in a step; a step in
        contact takes some 80. The step then ends at its last equilibrium.

    Raises:
      ValueError: an option is out of its range.
    """

    dynamics: str = "quasistatic"
    liquid: bool | None = None
    bulk_modulus: float = 2.2e9
    fill_volume: float = 0.0
    rest_pressure: float | None = None
    core_contact: bool = True
    core_clearance: float = 2e-5
    max_core_depth: float = 5e-4
    contact_stiffness: float | None = None
    stick_ratio: float = 0.1
    samples: int = 3
    contact_law: ContactLaw | None = None
    mass_damping: float = 0.0
    stiffness_damping: float = 0.0
    tolerance: float = 1e-3
    max_newton: int = 120
    max_cg: int = 40
    max_work: int = 2500
    element: str | None = None

    def __post_init__(self):
        object.__setattr__(self, "contact_law", contact_law(self.contact_law))
        check_types(self)
        check_choice("unknown dynamics", self.dynamics, ("quasistatic", "implicit"))
        if self.element is not None:
            check_choice("unknown element", self.element, ELEMENTS, ", or None for the material's choice")
        if not self.bulk_modulus > 0:
            raise ValueError(
                f"bulk_modulus is {self.bulk_modulus}: pass a positive finite number of Pa, or math.inf"
            )
        if not math.isfinite(self.fill_volume + (self.rest_pressure or 0.0)) or (
            self.fill_volume and self.rest_pressure
        ):
            raise ValueError(
                f"fill_volume is {self.fill_volume} and rest_pressure {self.rest_pressure}: pass one of "
                "them, a finite number"
            )
        for name in ("stick_ratio", "tolerance"):
            as_real(name, getattr(self, name), 0.0, above=True)
        for name in ("core_clearance", "max_core_depth", "mass_damping", "stiffness_damping"):
            as_real(name, getattr(self, name), 0.0)
        if self.contact_stiffness is not None:
            as_real("contact_stiffness", self.contact_stiffness, 0.0, above=True, unit="Pa/m")
        if (self.mass_damping or self.stiffness_damping) and self.dynamics != "implicit":
            raise ValueError(
                "mass_damping and stiffness_damping act on a skin in motion: "
                "add dynamics='implicit', or leave them out"
            )
        for name, most in (
            ("samples", 16),
            ("max_newton", 100_000),
            ("max_cg", 100_000),
            ("max_work", 10**9),
        ):
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name)}: pass a number from 1 to {most}")


def stiffness_of_contact(material: Material) -> float:
    """Pressure per overclosure [Pa/m]: 180 E per millimetre, the ratio of the reference solutions."""
    return 180e3 * material.youngs_modulus


def filled(options: SkinOptions, material: Material) -> SkinOptions:
    """The options with the material's filling, unless they have their own."""
    if options.rest_pressure is not None:
        return options
    liquid = material.liquid if options.liquid is None else options.liquid
    wanted = material.rest_pressure if liquid and not options.fill_volume else 0.0
    return dataclasses.replace(options, rest_pressure=wanted)


def solved_geometry(
    geometry: SkinGeometry, material: Material, options: SkinOptions
) -> tuple[SkinGeometry, str]:
    """The geometry with all nodes of the solver, and its element, see `SkinOptions.element`."""
    element = options.element or material.element or geometry.element
    return (
        with_edge_nodes(geometry) if element == "quadratic" and geometry.element == "linear" else geometry
    ), element


@dataclasses.dataclass(frozen=True)
class Surface:
    """A contact surface of the skin: faces (nface, 3), reference areas (nface,) [m^2], which of them are
    bonded, since all their nodes are `fixed`, its nodes (n,), and CSR lists of the faces' corners at each of
    the skin's nodes."""

    face: wp.array
    area: wp.array
    bonded: wp.array
    node: wp.array
    start: wp.array
    slot: wp.array
    face_np: np.ndarray

    @classmethod
    def create(
        cls, vert: np.ndarray, face: np.ndarray, device: wp.DeviceLike, fixed: Sequence[int] = ()
    ) -> "Surface":
        start, slot = incidence(len(vert), face)
        return cls(
            wp.array(face, dtype=wp.vec3i, device=device),
            wp.array(np.linalg.norm(face_areas(vert, face), axis=1), dtype=real, device=device),
            wp.array(np.isin(face, fixed).all(axis=1), dtype=int, device=device),
            wp.array(np.unique(face), dtype=int, device=device),
            wp.array(start, dtype=int, device=device),
            wp.array(slot, dtype=int, device=device),
            face,
        )

    def rest_at(self, vert: np.ndarray) -> None:
        """Sets other reference positions (nvert, 3) [m]."""
        self.area.assign(np.linalg.norm(face_areas(vert, self.face_np), axis=1))

    def node_areas(self) -> np.ndarray:
        """(n,) areas of `node` [m^2]."""
        return node_areas(self.face_np, self.area.numpy(), len(self.start) - 1)[self.node.numpy()]


_STIFF_IN_VOLUME = 0.45  # Poisson's ratio above which half precision loses the compliance to volume change


class SkinModel:
    """Constants of a skin on one device.

    With quadratic elements on a geometry of four-node tetrahedra, `geometry` has a node on each edge after
    the nodes of the given geometry, so that `vert_xpos[:, :given.nvert]` belongs to these.

    Args:
      geometry: the skin.
      material: a preset's name or a Material.
      options: SkinOptions.
      device: "cpu" or a CUDA device of Warp.
      fixed: (n,) nodes of the given geometry that do not move, instead of its own.
      core_faces: (n,) inner faces of the given geometry that can touch the core, instead of all that are
        clear of it in the reference configuration.
      modulus: factors on Young's modulus: (nelem,) for the elements of the given geometry, or a function of
        reference positions (n, 3) [m] that returns (n,), evaluated at the centroids of the solved elements.

    Attributes:
      modulus: (nelem,) of the solved elements, or None.
      spacing: of contact samples [m].
      elements: Tetrahedra. stiffness: of the undeformed skin, over the free coordinates, sparse [N/m].

    Raises:
      ValueError: NaN, inverted tetrahedra, an unknown material, no fixed nodes, a modulus of another shape or
        not positive.
    """

    def __init__(
        self,
        geometry: SkinGeometry,
        material_choice: str | Material = "default",
        options: SkinOptions | None = None,
        device: wp.DeviceLike = "cpu",
        fixed: np.ndarray | None = None,
        core_faces: np.ndarray | None = None,
        modulus: ArrayLike | Callable | None = None,
    ):
        self.material: Material = material(material_choice)
        self.options = filled(options or SkinOptions(), self.material)
        self.device = wp.get_device(device)
        announce_compilation(self.device)
        compile_for_skin(self.device)
        self._cores, self._rest = {}, None
        self._elimination = None
        self.law = LAWS[self.material.law]
        vert = geometry.vert
        if not np.isfinite(vert).all():
            raise ValueError(
                f"skin {geometry.name!r} has {(~np.isfinite(vert)).any(1).sum()} nodes that are NaN or "
                "infinite: repair the mesh"
            )
        if fixed is not None:
            geometry = dataclasses.replace(geometry, fixed=fixed)
        given = geometry
        geometry, self.element = solved_geometry(given, self.material, self.options)
        if core_faces is not None and geometry is not given:
            core_faces = (4 * np.asarray(core_faces)[:, None] + np.arange(4)).ravel()
        elem = geometry.elem if self.element == "quadratic" else geometry.tets
        self.geometry, vert = geometry, geometry.vert
        self.nvert, self.nelem, self._elem = len(vert), len(elem), elem
        self.fixed = geometry.fixed.astype(int)
        if not len(self.fixed):
            raise ValueError(
                f"skin {geometry.name!r} has no fixed nodes: it would float away; fix those on core, nail "
                "and clamp"
            )
        self.free = np.setdiff1d(np.arange(self.nvert), self.fixed)
        self.has_liquid = self.material.liquid if self.options.liquid is None else self.options.liquid
        self.contact_stiffness = self.options.contact_stiffness or stiffness_of_contact(self.material)
        crushed = _CRUSHED * self.material.youngs_modulus / self.contact_stiffness
        self.crushed_depth = max(crushed, self.options.max_core_depth)  # [m]

        self.modulus = None if modulus is None else self._moduli(modulus, given)
        self.elements = Tetrahedra(vert, elem, self.law, self.device, self.modulus)
        mask = np.zeros(self.nvert)
        mask[self.free] = 1
        with wp.ScopedDevice(self.device):
            self.vert = wp.array(vert[:, None], dtype=vec3)
            self.free_mask = wp.array(mask, dtype=real)
            self.sample = wp.array(face_samples(self.options.samples), dtype=vec3)
            self.outer = Surface.create(vert, geometry.outer_face, self.device, self.fixed)
            self.spacing = math.sqrt(np.median(self.outer.area.numpy()) / len(self.sample))
            self.inner = (
                Surface.create(vert, geometry.inner_face, self.device) if len(geometry.inner_face) else None
            )
        self.has_liquid = bool(self.has_liquid and self.inner is not None)
        wet = (np.diff(self.inner.start.numpy()) > 0) & (mask > 0) if self.has_liquid else []
        self.wet_node = wp.array(wet, dtype=int, device=self.device)
        if (self.options.fill_volume or self.options.rest_pressure) and not self.has_liquid:
            raise ValueError(
                "fill_volume and rest_pressure are of the liquid, and this skin has none: "
                "turn it on (liquid=True, --liquid), or leave them out"
            )
        self.has_core = bool(self.options.core_contact and self.inner is not None and len(geometry.core_face))
        if self.has_core:
            faces = self._core_faces() if core_faces is None else geometry.inner_face[core_faces]
            self.core_surface = Surface.create(vert, faces, self.device)
            # neighbours follow each other: `penetration.geoms_core_clearance` passes over those of a far one
            order = np.lexsort((geometry.core_vert[:, 2], *geometry.core_vert[:, :2].T // _COLUMN))
            self.core_vert = wp.array(geometry.core_vert[order], dtype=vec3, device=self.device)
            center = geometry.core_vert.mean(0)
            self.core_center = vec3(*center)
            self.core_radius = float(np.linalg.norm(geometry.core_vert - center, axis=1).max())
        if self.inner is not None:
            self.core_slot = self._core_slots()
        self.rest_volume, self.liquid_volume = self._volumes()

    @property
    def rubber_options(self) -> tuple[str, ...]:
        """Effects of the rubber beyond its law: of modulus, prony, mullins, hysteresis and stiffening."""
        return (*([] if self.modulus is None else ["modulus"]), *self.material.extensions)

    def _moduli(self, modulus, given):
        """Factors (nelem,) on Young's modulus of the solved elements."""
        if callable(modulus):
            at = self.geometry.vert[self._elem[:, :4]].mean(1)
            factor, n, what = np.asarray(modulus(at), float), self.nelem, f"{self.nelem} positions"
        else:
            factor, n = np.asarray(modulus, float), len(given.elem)
            what = f"{n} elements of {given.name!r}"
        check_modulus(factor, n, what)
        # the eight linear parts of a ten-node tetrahedron follow each other
        return np.repeat(factor, self.nelem // n)

    @functools.cached_property
    def ring(self) -> wp.array:
        """Nodes (nvert, most) that share a contact face with each node, including itself, padded by -1."""
        faces = [s.face.numpy() for s in (self.outer, self.core_surface if self.has_core else None) if s]
        faces, n = np.concatenate(faces).astype(np.int64), self.nvert
        pairs = np.unique(np.concatenate([n * faces[:, a] + faces[:, b] for a in range(3) for b in range(3)]))
        node, other = np.divmod(pairs, n)
        at = np.arange(len(pairs)) - np.searchsorted(node, node)
        ring = np.full((n, at.max(initial=0) + 1), -1, np.int32)
        ring[node, at] = other
        return wp.array(ring, dtype=int, device=self.device)

    def core(self, nworld: int) -> GeomSet:
        """The rigid core as the only geom that the inner surface can touch, without friction."""
        if nworld not in self._cores:
            self._cores[nworld] = self._core_geoms(nworld, self.device)
        return self._cores[nworld]

    def _core_geoms(self, nworld, device):
        grid = _core_grid(self.geometry.core_vert.tobytes(), self.geometry.core_face.tobytes())
        return GeomSet(["mesh"], [(0, 0, 0)], friction=[0.0], grids=[grid], nworld=nworld, device=device)

    def _core_faces(self) -> np.ndarray:
        """Inner faces that can touch the core: not those closer to it than the clearance, which are bonded to
        it or cut into it."""
        face = self.geometry.inner_face
        core, count = self._core_geoms(1, "cpu"), len(face) * len(self.sample)
        gap = wp.zeros(count, dtype=real, device="cpu")
        inner, sample, vert = (of.to("cpu") for of in (self.inner.face, self.sample, self.vert))
        # on CUDA this kernel, which is needed once, takes half a minute to compile
        wp.launch(rest_gap, (len(face), len(sample)), [inner, sample, core.struct, vert], [gap], device="cpu")
        return face[gap.numpy().reshape(len(face), -1).min(1) > self.options.core_clearance]

    def _core_slots(self):
        """Index of each inner face among those that can touch the core; -1: it cannot."""
        face = self.geometry.inner_face
        slot = np.full(len(face), -1, np.int32)
        if self.has_core:
            number = {tuple(f): i for i, f in enumerate(self.core_surface.face_np.tolist())}
            slot[:] = [number.get(tuple(f), -1) for f in face.tolist()]
        return wp.array(slot, dtype=int, device=self.device)

    def _volumes(self):
        if self.inner is None:
            return 0.0, 0.0
        g = self.geometry
        cavity, core = -enclosed_volume(g.vert, g.inner_face), enclosed_volume(g.core_vert, g.core_face)
        if cavity - core <= 0:
            raise ValueError(
                f"the core ({core * 1e9:.0f} mm^3) does not fit into the cavity ({cavity * 1e9:.0f} mm^3): "
                "check the meshes' frames and units"
            )
        return cavity, cavity - core

    @functools.cached_property
    def opposite(self) -> wp.array:
        """(n,) the node across the wall from each of `outer.node`; itself where there is no wall."""
        g, node = self.geometry, self.outer.node.numpy()
        wall = np.unique(g.inner_face) if len(g.inner_face) else np.setdiff1d(self.fixed, g.outer_face)
        found = wall[cKDTree(g.vert[wall]).query(g.vert[node])[1]] if len(wall) else node
        return wp.array(found.astype(np.int32), dtype=int, device=self.device)

    @property
    def rest(self) -> liquid.Rest:
        """Skin and liquid without contact, inflated if the options have a filling; solved at the first
        access."""
        if self._rest is None:
            self._rest = solve_rest(self)
        return self._rest

    @rest.setter
    def rest(self, value: liquid.Rest) -> None:
        self._rest = value

    @functools.cached_property
    def stiffness(self) -> sp.csc_matrix:
        """Stiffness (3 nfree, 3 nfree) of the undeformed skin without the liquid, sparse [N/m]."""
        return self._of_free(self.elements.rest_stiffness(self.material.mu, self.material.lame))

    @functools.cached_property
    def factor(self) -> SupernodalFactor:
        """Sparse factor of `stiffness`, on the CPU."""
        return self.factor_of(self.stiffness)

    @functools.cached_property
    def inverse(self) -> DissectedInverse:
        """Inverse of `stiffness` by dense blocks, for CUDA."""
        points, thirds = self.geometry.vert[self.free], self.material.poissons_ratio > _STIFF_IN_VOLUME
        return DissectedInverse(self.stiffness, points, self.device, thirds)

    def factor_at(self, vert_xpos: np.ndarray) -> SupernodalFactor:
        """Sparse factor of the skin in a deformed shape, see `Tetrahedra.deformed`; always positive definite.
        On the CPU.

        The directions along which nearly incompressible rubber resists volume change depend on the
        deformation. At nu 0.4999 conjugate gradients need a few iterations with this factor, and hundreds
        with that of the undeformed skin.

        Args:
          vert_xpos: (nvert, 3) [m].
        """
        stiffness = self.elements.deformed(vert_xpos).rest_stiffness(self.material.mu, self.material.lame)
        return self.factor_of(self._of_free(stiffness))

    def factor_of(self, stiffness: sp.csc_matrix) -> SupernodalFactor:
        """Sparse factor of a matrix with the pattern of `stiffness`."""
        if self._elimination is None:
            self._elimination = elimination_of(stiffness, self.geometry.vert[self.free])
        with single_thread():  # its fronts are small: more threads would wait for each other
            return SupernodalFactor(stiffness, self._elimination, self.free)

    def _of_free(self, stiffness):
        dof = (3 * self.free[:, None] + np.arange(3)).ravel()
        return stiffness[dof][:, dof]


def check_modulus(factor: np.ndarray, n: int, what: str) -> None:
    """Raises ValueError unless `factor` has n positive factors on Young's modulus, one for each `what`."""
    if factor.shape != (n,):
        raise ValueError(
            f"modulus has shape {factor.shape}: give one factor for each of the {what}, shape ({n},)"
        )
    if not (np.isfinite(factor) & (factor > 0)).all():
        raise ValueError(
            f"{(~(factor > 0) | ~np.isfinite(factor)).sum()} of the {n} factors of modulus are not "
            "positive finite numbers"
        )


@functools.lru_cache(maxsize=8)
def _core_grid(vert, face):
    vert, face = np.frombuffer(vert).reshape(-1, 3), np.frombuffer(face, np.int32).reshape(-1, 3)
    return bake_distance_grid(vert, face, spacing=_GRID_SPACING, margin=_GRID_MARGIN, smooth=True)
