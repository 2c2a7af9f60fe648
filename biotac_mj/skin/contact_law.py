"""Contact beyond Coulomb and push: friction whose coefficient falls with pressure, and adhesion with
hysteresis.

Both act at the samples inside the faces, as contact itself does (`contact`), each on its share of the face's
area:

- mu = friction (p / friction_pressure)^-friction_exponent, p the push on a node over its area, linear between
  nodes (flat faces touch round bodies in spots, whose pressure is the mesh's). With exponent 1 the shear
  stress is one number whatever the pressure (smooth rubber: Sahli et al., PNAS 2018); Hertz's contact turns
  p^-n into N^(-n/3).
- traction t(g) at the gap g: the contact's own spring k carries on into tension up to the peak 2 W / range,
  then the traction falls in a straight line to zero at `adhesion_range`. The area under it is W, the work of
  adhesion, whatever k. A sample that has touched is parted by `adhesion_hysteresis` times W until it is out
  of range: both laws have one branch where it touches, so that within a step traction has a potential and
  energy is lost only by parting.
"""

import dataclasses
import math

import numpy as np
import warp as wp

from .elasticity import gather
from .lawful_contact import Laws, push
from .types import real, vec3

__all__ = ["ContactLaw", "WorldLaws", "contact_law", "world_laws"]

# range^2 = this W h / E*: softening then takes half of the stiffness E* / h of a patch as wide as a face
_RESOLVED = 4.0


@dataclasses.dataclass(frozen=True)
class ContactLaw:
    """Friction and adhesion of a skin with what touches it; the defaults are Coulomb's law and none.

    Attributes:
      friction_exponent: n in mu = friction (p / friction_pressure)^-n; the geoms' `friction` is the
        coefficient at that pressure.
      friction_pressure: [Pa]; the default is what a sphere of 7 mm presses with at 1 N (Hertz: 0.24 MPa on
        the average). Below a hundredth of it mu stays.
      adhesion: work of adhesion W [J/m^2] of surfaces that come together. Rubber: 0.02-0.1.
      adhesion_hysteresis: factor on W once surfaces have touched.
      adhesion_range: gap at which adhesion ends [m]; None takes the shortest that the mesh resolves, sqrt(4 W
        h / E*) with the work that parts the surfaces and h the length of the outer faces' edges. A shorter
        one snaps face by face.

    Raises:
      ValueError: a value is out of its range.
    """

    friction_exponent: float = 0.0
    friction_pressure: float = 3e5
    adhesion: float = 0.0
    adhesion_hysteresis: float = 1.0
    adhesion_range: float | None = None

    def __post_init__(self):
        if not -1 <= self.friction_exponent <= 2:
            raise ValueError(
                f"friction_exponent is {self.friction_exponent}: pass a number from -1 to 2; 0 is Coulomb's "
                "law"
            )
        if not (math.isfinite(self.friction_pressure) and self.friction_pressure > 0):
            raise ValueError(f"friction_pressure is {self.friction_pressure}: pass a positive number of Pa")
        if not (math.isfinite(self.adhesion) and self.adhesion >= 0):
            raise ValueError(f"adhesion is {self.adhesion}: pass a work >= 0 in J/m^2")
        if not (math.isfinite(self.adhesion_hysteresis) and self.adhesion_hysteresis >= 1):
            raise ValueError(
                f"adhesion_hysteresis is {self.adhesion_hysteresis}: parting takes at least the work of "
                "joining, pass >= 1"
            )
        if self.adhesion_range is not None and not (
            math.isfinite(self.adhesion_range) and self.adhesion_range > 0
        ):
            raise ValueError(f"adhesion_range is {self.adhesion_range}: pass a positive length in m, or None")


def contact_law(choice) -> ContactLaw | None:
    """A ContactLaw, a dict of its fields or None, as a ContactLaw or None.

    Raises:
      ValueError: anything else, or an unknown field.
    """
    if choice is None or isinstance(choice, ContactLaw):
        return choice
    fields = [f.name for f in dataclasses.fields(ContactLaw)]
    if not isinstance(choice, dict) or set(choice) - set(fields):
        raise ValueError(
            f"contact_law is {choice!r}: pass a ContactLaw, or a dict with some of {', '.join(fields)}"
        )
    return ContactLaw(**choice)


class WorldLaws:
    """The model's ContactLaw in every world; a world may have its own exponent and work.

    Args:
      model: SkinModel on the CPU with a contact law; nworld: number of worlds.

    Attributes:
      range: (nworld,) at which adhesion ends [m].
    """

    def __init__(self, model, nworld):
        self.law, self.nworld = model.options.contact_law, nworld
        self.stiffness = model.contact_stiffness
        face, vert = model.outer.face_np, model.geometry.vert
        self.edge = float(np.linalg.norm(vert[face] - vert[np.roll(face, 1, 1)], axis=2).mean())
        self.modulus = model.material.youngs_modulus / (1 - model.material.poissons_ratio**2)
        self.struct = Laws()
        self.struct.pressure = self.law.friction_pressure
        area = np.bincount(face.ravel(), np.repeat(model.outer.area.numpy() / 3, 3), len(vert))
        self.struct.node_area = wp.array(area, dtype=real, device="cpu")
        self.node_push = wp.zeros((len(vert), nworld), dtype=vec3, device="cpu")
        for name in ("exponent", "work", "parting", "reach"):
            setattr(self.struct, name, wp.zeros(nworld, dtype=real, device="cpu"))
        self.bond = wp.full((len(face) * len(model.sample), nworld), -1, dtype=int, device="cpu")
        self.set(self.law.friction_exponent, self.law.adhesion)

    @property
    def range(self) -> np.ndarray:
        return self.struct.reach.numpy().copy()

    def set(self, friction_exponent=None, adhesion=None):
        """Gives each world its law, from the next step on.

        Args:
          friction_exponent, adhesion: (nworld,) or a number; see `ContactLaw`. None leaves them.

        Raises:
          ValueError: a value out of its range, or adhesion whose range is too short for the contact's
            stiffness.
        """
        s = self.struct
        n = s.exponent.numpy() if friction_exponent is None else np.asarray(friction_exponent, float)
        work = s.work.numpy() if adhesion is None else np.asarray(adhesion, float)
        for name, value in (("friction_exponent", n), ("adhesion", work)):
            if value.shape not in ((), (self.nworld,)):
                raise ValueError(f"{name} has shape {value.shape}: pass one number or ({self.nworld},)")
            for one in np.unique(value):
                dataclasses.replace(self.law, **{name: float(one)})  # refuses what no law can have
        parting = work * self.law.adhesion_hysteresis
        reach = (
            np.sqrt(_RESOLVED * parting * self.edge / self.modulus)
            if self.law.adhesion_range is None
            else self.law.adhesion_range
        )
        reach = np.where(parting > 0, reach, 0.0)
        if (4 * parting > self.stiffness * reach**2).any():
            raise ValueError(
                f"adhesion_range {np.max(reach):g} m is too short for a work of {np.max(parting):g} J/m^2: "
                "the contact's own springs of "
                f"{self.stiffness:g} Pa/m stretch by half of it; take a range above "
                f"{2 * np.sqrt(np.max(parting) / self.stiffness):.1e} m"
            )
        for array, value in ((s.exponent, n), (s.work, work), (s.parting, parting), (s.reach, reach)):
            array.fill_(0.0)
            array.numpy()[:] = value

    @property
    def pulls(self) -> bool:
        """Whether there is adhesion in any world."""
        return bool(self.struct.parting.numpy().any())

    def inputs(self, launch, state, sample, stiffness, geoms, x) -> list:
        """What `lawful_contact_force` needs beyond `contact.contact_force`: the laws, and how the geoms push
        the nodes now."""
        if self.struct.exponent.numpy().any():
            surface = state.surface
            launch(
                push,
                state.touching.shape,
                [surface.face, surface.area, sample, stiffness, geoms.struct, x],
                [state.corner],
            )
            launch(gather, x.shape, [surface.start, surface.slot, state.corner, 1.0, 0], [self.node_push])
        return [self.struct, self.node_push]

    def check(self, geoms):
        """Refuses meshes whose distance is not exact as far as adhesion reaches (ValueError)."""
        spacing = geoms.struct.grids.spacing.numpy()
        reach = self.struct.reach.numpy().max()
        if len(spacing) and reach > 0.4 * spacing.min():
            raise ValueError(
                f"adhesion reaches {reach * 1e6:.0f} um, and the distance to a mesh geom is exact within "
                f"{0.4e6 * spacing.min():.0f} um: "
                "bake its grid with a larger spacing, or shorten adhesion_range"
            )


def world_laws(model, nworld, resident, outer) -> WorldLaws | None:
    """WorldLaws of a model that has a contact law, known to the outer surface's ContactState; else None.

    Raises:
      ValueError: the state is resident, or on CUDA.
    """
    if model.options.contact_law is None:
        return None
    if resident or model.device.is_cuda:
        raise ValueError(
            "a contact law (load-dependent friction, adhesion) is solved on the CPU's full tier only: "
            "choose device='cpu' and "
            "resident=False, or leave contact_law out of SkinOptions"
        )
    laws = WorldLaws(model, nworld)
    outer.bond = laws.bond
    return laws
