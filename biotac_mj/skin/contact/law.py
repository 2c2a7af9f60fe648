"""Contact laws beyond Coulomb's: pressure-dependent friction, and adhesion with hysteresis.

Both act at the samples of a face, each on its part of the face's area:

- mu = friction (p / friction_pressure)^-friction_exponent. p is the normal force on a node over the node's
  area, interpolated linearly: flat faces touch round bodies in spots, whose pressure depends on the mesh.
  With exponent 1 the shear stress does not depend on the pressure (smooth rubber: Sahli et al., PNAS 2018).
  In Hertz contact p^-n becomes N^(-n/3).
- traction t(g) at the gap g: the contact spring k continues into tension up to the peak 2 W / range, then the
  traction falls linearly to zero at `adhesion_range`. The area below is W, the work of adhesion, for any k. A
  sample that has touched needs `adhesion_hysteresis` times W to separate, until it is out of range. Loading
  and unloading have the same branch in contact, so that traction has a potential within a step, and energy is
  lost only by separation.
"""

import dataclasses
import typing

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ...fields import as_numbers, as_real, check_types, refuse_unknown
from ...geometry.surface import node_areas
from ...short_repr import short_repr
from ..types import real
from .faces import Laws

if typing.TYPE_CHECKING:
    from ..geoms import GeomSet

# range^2 = _RESOLVED W h / E*: the softening slope is then half of the stiffness E* / h of a patch of one
# face
_RESOLVED = 4.0


class GridTooCoarse(ValueError):
    """Adhesion acts beyond the range in which the distance from a mesh geom is exact."""


@dataclasses.dataclass(frozen=True)
class ContactLaw:
    """Friction and adhesion between a skin and the geoms; by default Coulomb friction without adhesion.

    Attributes:
      friction_exponent: n in mu = friction (p / friction_pressure)^-n; the geoms' `friction` is the
        coefficient at that pressure.
      friction_pressure: [Pa]; the default is about the pressure of a sphere of 7 mm at 1 N (Hertz: 0.24 MPa
        on average). mu is constant below a hundredth of it.
      adhesion: work of adhesion W of approaching surfaces [J/m^2]. Rubber: 0.02-0.1.
      adhesion_hysteresis: factor on W after contact.
      adhesion_range: gap at which adhesion ends [m]; None takes the shortest range that the mesh resolves,
        sqrt(4 W h / E*) with the work of separation W and the mean edge h of the outer faces. With a shorter
        range the skin snaps off face by face.

    Raises:
      ValueError: a value is out of its range.
    """

    friction_exponent: float = 0.0
    friction_pressure: float = 3e5
    adhesion: float = 0.0
    adhesion_hysteresis: float = 1.0
    adhesion_range: float | None = None

    def __post_init__(self):
        check_types(self)
        if not -1 <= self.friction_exponent <= 2:
            raise ValueError(
                f"friction_exponent is {self.friction_exponent}: pass a number from -1 to 2; 0 is Coulomb's "
                "law"
            )
        as_real("friction_pressure", self.friction_pressure, 0.0, above=True, unit="Pa")
        as_real("adhesion", self.adhesion, 0.0, unit="J/m^2")
        as_real("adhesion_hysteresis", self.adhesion_hysteresis, 1.0)  # separation takes the work of adhesion
        if self.adhesion_range is not None:
            as_real("adhesion_range", self.adhesion_range, 0.0, above=True, unit="m")


def contact_law(choice: ContactLaw | dict | None) -> ContactLaw | None:
    """Converts a ContactLaw, a dict of its fields, or None to a ContactLaw or None.

    Raises:
      ValueError: anything else, or an unknown field.
    """
    if choice is None or isinstance(choice, ContactLaw):
        return choice
    if not isinstance(choice, dict):
        raise ValueError(f"contact_law is {short_repr(choice)}: pass a ContactLaw, or a dict of its fields")
    refuse_unknown(choice, [f.name for f in dataclasses.fields(ContactLaw)], "contact_law")
    return ContactLaw(**choice)


class WorldLaws:
    """The ContactLaw of a surface in every world; worlds may have laws of their own, see `set`.

    Args:
      model: SkinModel, perhaps with a contact law. materials: of each world. stiffness: (nworld,) of contact
        [Pa/m].

    Attributes:
      struct: `faces.Laws`, empty if the model has no contact law.
      load_dependent: (nworld,) Warp array, 1 if friction depends on pressure.
      range: (nworld,) gap at which adhesion ends [m].
    """

    def __init__(self, model: typing.Any, materials: list, stiffness: np.ndarray):
        nworld = len(materials)
        self.law, self.nworld, self.device = model.options.contact_law, nworld, model.device
        n, nvert = (nworld, model.nvert) if self.law else (0, 0)
        self.struct = Laws()
        with wp.ScopedDevice(self.device):
            for name in ("exponent", "pressure", "work", "separation", "reach"):
                setattr(self.struct, name, wp.zeros(n, dtype=real))
            self.struct.smoothing = wp.zeros(0, dtype=real)
            self.struct.node_area = wp.zeros(nvert, dtype=real)
            self.struct.node_normal_force = wp.zeros((nvert, nworld), dtype=real)
            self.load_dependent = wp.zeros(nworld, dtype=int)
        if self.law is None:
            return
        self.stiffness = stiffness
        face, vert = model.outer.face_np, model.geometry.vert
        self.edge = float(np.linalg.norm(vert[face] - vert[np.roll(face, 1, 1)], axis=2).mean())
        self.modulus = np.array([m.youngs_modulus / (1 - m.poissons_ratio**2) for m in materials])
        self.struct.node_area.assign(node_areas(face, model.outer.area.numpy(), nvert))
        self._values = {}
        law = self.law
        self.set(law.friction_exponent, law.adhesion, law.friction_pressure, law.adhesion_hysteresis)

    @property
    def range(self) -> np.ndarray:
        return self.struct.reach.numpy().copy()

    def set(
        self,
        friction_exponent: ArrayLike | None = None,
        adhesion: ArrayLike | None = None,
        friction_pressure: ArrayLike | None = None,
        adhesion_hysteresis: ArrayLike | None = None,
    ) -> None:
        """Sets each world's law, from the next step on.

        Args:
          friction_exponent, adhesion, friction_pressure, adhesion_hysteresis: (nworld,) or a number; see
            `ContactLaw`. None: unchanged.

        Raises:
          ValueError: a value out of its range, adhesion whose range is too short for the contact's stiffness,
            or a model without a contact law.
        """
        if self.law is None:
            raise ValueError(
                "this model has no contact law: make it with SkinOptions(contact_law=ContactLaw())"
            )
        given = dict(
            friction_exponent=friction_exponent,
            adhesion=adhesion,
            friction_pressure=friction_pressure,
            adhesion_hysteresis=adhesion_hysteresis,
        )
        values = dict(self._values)
        for name, value in given.items():
            if value is None:
                continue
            value = as_numbers(name, value)
            if value.shape not in ((), (self.nworld,)):
                raise ValueError(f"{name} has shape {value.shape}: pass one number or ({self.nworld},)")
            for one in np.unique(value):
                dataclasses.replace(self.law, **{name: float(one)})  # checks the value
            values[name] = np.broadcast_to(value, self.nworld).copy()
        separation = values["adhesion"] * values["adhesion_hysteresis"]
        reach = self.law.adhesion_range
        if reach is None:
            reach = np.sqrt(_RESOLVED * separation * self.edge / self.modulus)
        reach = np.where(separation > 0, reach, 0.0)
        shortest = 2 * np.sqrt(separation / self.stiffness)
        if (reach < shortest).any():
            w = int(np.argmax(shortest - reach))
            raise ValueError(
                f"adhesion_range {reach[w]:g} m is too short for a work of {separation[w]:g} J/m^2: the "
                f"contact's own springs of {self.stiffness[w]:g} Pa/m stretch by half of it; "
                f"take a range above {shortest[w]:.1e} m"
            )
        self._values, s = values, self.struct
        for array, value in (
            (s.exponent, values["friction_exponent"]),
            (s.pressure, values["friction_pressure"]),
            (s.work, values["adhesion"]),
            (s.separation, separation),
            (s.reach, reach),
            (self.load_dependent, (values["friction_exponent"] > 0).astype(np.int32)),
        ):
            array.assign(value)

    def refuse_coarse_grids(self, geoms: "GeomSet") -> None:
        """Raises GridTooCoarse if the distance from a mesh is not exact within the range of adhesion."""
        if self.law is None:
            return
        spacing = geoms.struct.grids.spacing.numpy()
        reach = self.struct.reach.numpy().max()
        if len(spacing) and reach > 0.4 * spacing.min():
            raise GridTooCoarse(
                f"adhesion reaches {reach * 1e6:.0f} um, and the distance to a mesh geom is exact within "
                f"{0.4e6 * spacing.min():.0f} um: bake its grid with a larger spacing, or shorten "
                "adhesion_range"
            )
