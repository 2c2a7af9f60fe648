"""Effects on a press of a flat plate: properties of film, contact or rubber, each with the states or readings
of a skin with and without it."""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.core_surface import CoreSurface
from ..geometry.design import Design
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.surface import node_normals
from ..sensor.film import excitation_places
from ..skin import Material, SkinOptions
from ..skin.rubber.material import CALIBRATED_FILL, PRESETS
from .effect import Entry

RADIUS = PRESETS["calibrated"].electrode_radius  # [m] of the base model's electrodes
_FADE = 2e-3  # [m] distance from fixed nodes over which a shift of the wall fades
_TIP = -14e-3, -10e-3  # [m] range over which a shift of the tip's wall fades


def moved(geometry: SkinGeometry, outer: float, inner: float, tip: bool = False) -> SkinGeometry:
    """The skin with its outer and inner surface shifted outwards [m], at the tip only or everywhere but where
    it is fixed.

    Raises:
      ValueError: the shift inverts a tetrahedron.
    """
    vert, faces = geometry.vert, geometry.outer_face
    outside, inside = np.unique(faces), np.unique(geometry.inner_face)
    normal = node_normals(vert, faces)[outside]
    to_outside, nearest = cKDTree(vert[outside]).query(vert)
    to_inside = cKDTree(vert[inside]).query(vert)[0]
    to_surface = to_inside / (to_inside + to_outside)
    fade = _smooth(cKDTree(vert[geometry.fixed]).query(vert)[0] / _FADE)
    if tip:
        fade = fade * _smooth((_TIP[1] - vert[:, 0]) / (_TIP[1] - _TIP[0]))
    out = vert + ((outer * to_surface + inner * (1 - to_surface)) * fade)[:, None] * normal[nearest]
    edges = out[geometry.tets][:, 1:] - out[geometry.tets][:, :1]
    if not (np.linalg.det(edges) > 0).all():
        raise ValueError(f"a shift of {outer:g} and {inner:g} m turns tetrahedra over: give a smaller one")
    return dataclasses.replace(geometry, vert=out)


def _smooth(x):
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def bonded(geometry: SkinGeometry, below: float) -> SkinGeometry:
    """The skin, also fixed where its inner side is closer to the core's upper half than this [m]: no liquid
    gets there."""
    inside = np.unique(geometry.inner_face)
    gap = CoreSurface(geometry.core_vert, geometry.core_face).closest(geometry.vert[inside])[0]
    near = inside[(gap < below) & (geometry.vert[inside, 1] > -1e-3)]
    return dataclasses.replace(geometry, fixed=np.union1d(geometry.fixed, near))


@dataclasses.dataclass(frozen=True)
class PlateEffect(Entry):
    """An effect of one parameter.

    Attributes:
      id, name, stage, physics: as of an Entry.
      parameter, unit: fitted quantity; base, other: its value in the base model and at the solved change
        (amount 1).
      film: settings of FilmConduction for a design. material, options, shape: of a skin that must be solved.
      attach: arguments of `biotac_mj.attach` for a value of the parameter; None: no running sensor has it.
    """

    id: str
    name: str
    stage: str
    physics: str
    parameter: str = ""
    unit: str = "1"
    base: float = 0.0
    other: float = 1.0
    film: Callable[[Design], dict] | None = None
    material: Material | None = None
    options: SkinOptions | None = None
    shape: Callable[[SkinGeometry], SkinGeometry] | None = None
    attach: Callable[[float], dict] | None = None

    fits = frozenset()  # it has a search of its own

    @property
    def solved_anew(self) -> bool:
        """Whether it needs states of its own."""
        return self.film is None

    def value(self, amount: float) -> float:
        """Value of the parameter."""
        return self.base + amount * (self.other - self.base)


def _drawn_back(by):
    def film(design):
        places = excitation_places(design.excitation, design, published=True)
        return {"excitation": (places + [by, 0, 0]).tolist()}

    return film


PLATE = (
    PlateEffect(
        "electrode_radius", "radius of the electrodes", "T",
        "a wider disc includes more of the thick film at the tip", "radius", "m", RADIUS, 1.2e-3,
        film=lambda design: {"electrode_radius": 1.2e-3},
    ),
    PlateEffect(
        "residual_film", "film that stays under pressed skin", "T", "texture holds the skin off the core",
        "thickness", "m", 50e-6, 25e-6, film=lambda design: {"residual_film": 25e-6},
    ),
    PlateEffect(
        "excitation_place", "place of X1 to X4", "T", "the current path from the tip is longer",
        "shift to the clamp", "m", 0.0, 2e-3, film=_drawn_back(2e-3),
    ),
    PlateEffect(
        "friction", "friction of the plate", "K", "skin that slips is dragged less",
        "coefficient", "1", Material().friction, 0.2, material=Material(friction=0.2),
        attach=lambda value: {"material": {"friction": value}},
    ),
    PlateEffect(
        "law_and_nu", "law and compressibility of the rubber", "C",
        "Neo-Hookean rubber with nu 0.45 is less compressible in effect", "fraction of it", "1", 0.0, 1.0,
        material=Material("neo_hookean", poissons_ratio=0.45),
    ),
    PlateEffect(
        "soft_liquid", "compressible liquid (a bubble)", "C",
        "not all displaced volume bulges elsewhere", "fraction of a bulk modulus of 0.64 E", "1", 0.0,
        1.0,
        options=SkinOptions(bulk_modulus=1e6),
    ),
    PlateEffect(
        "fill", "fill of the sensor", "C", "more liquid: a thicker film, and a skin under tension",
        "liquid beyond that at rest", "m^3", 0.0, CALIBRATED_FILL,
        options=SkinOptions(fill_volume=CALIBRATED_FILL),
        attach=lambda value: {"options": {"skin": {"fill_volume": value}}},
    ),
    PlateEffect(
        "thickness", "thickness of the rubber", "C", "a thinner wall bends and bulges more",
        "outer surface", "m", 0.0, -0.3e-3, shape=lambda skin: moved(skin, -0.3e-3, 0.0),
    ),
    PlateEffect(
        "film_thickness", "film between core and skin", "T",
        "a film that is thicker at rest changes less by a bulge", "wall outwards", "m", 0.0, 0.2e-3,
        shape=lambda skin: moved(skin, 0.2e-3, 0.2e-3),
    ),
    PlateEffect(
        "tip_film", "film at the tip", "T", "a thinner film over E7 to E10 changes more",
        "tip's wall outwards", "m", 0.0, -0.4e-3, shape=lambda skin: moved(skin, -0.4e-3, -0.4e-3, tip=True),
    ),
    PlateEffect(
        "tip_rubber", "rubber at the tip", "C", "a thinner wall over E7 to E10 is more compliant",
        "tip's outer surface", "m", 0.0, -0.4e-3, shape=lambda skin: moved(skin, -0.4e-3, 0.0, tip=True),
    ),
    PlateEffect(
        "bond", "bond of the skin above the core's waist", "C",
        "skin that cannot lift off there leaves no way for liquid and current around the tip",
        "fraction of a bond below 0.1 mm", "1", 0.0, 1.0, shape=lambda skin: bonded(skin, 0.1e-3),
    ),
)  # fmt: skip
