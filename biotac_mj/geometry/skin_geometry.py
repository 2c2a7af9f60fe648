"""Geometry of a skin: tetrahedral shell, its surfaces, the rigid parts that it is fixed to, electrodes."""

import dataclasses
import pathlib

import numpy as np

from ..files import write_npz
from ..reading import Array, read_npz
from ..short_repr import short_repr
from .design import BIOTAC, Design, read_design
from .solid import check_place, check_size, joined, no_solid
from .tet_mesh import TetMesh, check_closed, check_volumes, enclosed_volume, indices, triangle_numbers

# the eight four-node tetrahedra of a ten-node one: four at the corners, four around the octahedron's diagonal
# 4-9
PARTS = np.array(
    [
        [0, 4, 6, 7],
        [4, 1, 5, 8],
        [6, 5, 2, 9],
        [7, 8, 9, 3],
        [4, 9, 5, 6],
        [4, 9, 8, 5],
        [4, 9, 7, 8],
        [4, 9, 6, 7],
    ]
)
RIGID = "core", "nail", "clamp"
_SOLID = 1e-12  # least volume of core, nail and clamp [m^3], for which MuJoCo computes an inertia
_OFF = 1e-3  # largest distance of an electrode outside the core's box [m]
_INT_FIELDS = ("elem", "outer_face", "inner_face", "fixed", "core_face", "nail_face", "clamp_face")
# arrays of a stored skin; _INTO names the array that indices refer to
STORED = {
    "name": Array((), "text"),
    "vert": Array((None, 3)),
    "elem": Array((None, None), "index"),
    "outer_face": Array((None, 3), "index"),
    "inner_face": Array((None, 3), "index"),
    "fixed": Array((None,), "index"),
    **{f"{part}_vert": Array((None, 3)) for part in RIGID},
    **{f"{part}_face": Array((None, 3), "index") for part in RIGID},
    "electrode_pos": Array(("nelectrode", 3)),
    "electrode_normal": Array(("nelectrode", 3)),
}
_INTO = {name: f"{name[:-5]}_vert" if name[:-5] in RIGID else "vert" for name in _INT_FIELDS}


@dataclasses.dataclass(frozen=True)
class SkinGeometry:
    """A skin and the rigid parts around it, in the BioTac frame (tip at -x, pad at -y, nail at +y, clamp at
    +x).

    Attributes:
      name: on cards, in data sets and messages.
      vert: (nvert, 3) float64, nodes in the reference configuration [m].
      elem: (nelem, 4) or (nelem, 10) int32, tetrahedra with positive volume; ten nodes are corners, then
        edges (`edge_nodes.EDGES`).
      outer_face: (nouter, 3) int32, the surface that touches the world; normals point out of the skin
        material.
      inner_face: (ninner, 3) int32, the surface towards the liquid; normals point out of the skin material,
        towards the core.
      fixed: (nfixed,) int32, sorted nodes fixed to core, nail plate and clamp.
      core_vert, core_face: (n, 3) float64 [m], (m, 3) int32, the rigid core: closed, normals outwards.
      nail_vert, nail_face, clamp_vert, clamp_face: the same for nail plate and clamp plate.
      electrode_pos: (n, 3) float64, electrodes E1, E2, ... on the core's surface [m].
      electrode_normal: (n, 3) float64, unit outward normals of the core there.
      design: of the sensor, with n electrodes.
    """

    name: str
    vert: np.ndarray
    elem: np.ndarray
    outer_face: np.ndarray
    inner_face: np.ndarray
    fixed: np.ndarray
    core_vert: np.ndarray
    core_face: np.ndarray
    nail_vert: np.ndarray
    nail_face: np.ndarray
    clamp_vert: np.ndarray
    clamp_face: np.ndarray
    electrode_pos: np.ndarray
    electrode_normal: np.ndarray
    design: Design = BIOTAC

    def __post_init__(self):
        for field in dataclasses.fields(self):
            if field.name in ("name", "design"):
                continue
            value = getattr(self, field.name)
            try:
                array = np.ascontiguousarray(value, dtype=np.float64)
            except (TypeError, ValueError, OverflowError):
                raise ValueError(f"{field.name} is {short_repr(value)}: pass an array of numbers") from None
            if field.name in _INT_FIELDS:
                array = indices(f"{field.name} of skin {self.name!r}", array)
            object.__setattr__(self, field.name, array)
            width = 0 if field.name == "fixed" else 3
            if field.name != "elem" and array.shape[1:] != ((3,) if width else ()):
                needed = "(n, 3)" if width else "(n,)"
                raise ValueError(f"{field.name} has shape {np.shape(value)}: pass {needed}")
        if self.elem.ndim != 2 or self.elem.shape[1] not in (4, 10):
            raise ValueError(
                f"elem has shape {self.elem.shape}: pass (nelem, 4) or (nelem, 10) vertex indices"
            )
        if not len(self.electrode_pos) == len(self.electrode_normal) == self.design.nelectrode:
            raise ValueError(
                f"skin {self.name!r} has {len(self.electrode_pos)} electrodes, its design is "
                f"{self.design.title}: pass the design that it is of"
            )
        for name, vert in _INTO.items():
            index, count = getattr(self, name), len(getattr(self, vert))
            if index.size and not 0 <= index.min() <= index.max() < count:
                raise ValueError(
                    f"{name} of skin {self.name!r} names vertices {index.min()}..{index.max()}, "
                    f"it has {count}: indices must be 0-based; import the mesh again"
                )

    @property
    def nvert(self) -> int:
        return len(self.vert)

    @property
    def nelem(self) -> int:
        return len(self.elem)

    @property
    def element(self) -> str:
        """Kind of the tetrahedra: "linear" (four nodes) or "quadratic" (ten)."""
        return "linear" if self.elem.shape[1] == 4 else "quadratic"

    @property
    def tets(self) -> np.ndarray:
        """(n, 4) int32 four-node tetrahedra over all nodes: elem, or the eight parts (8 e .. 8 e + 7) of each
        ten-node tetrahedron e."""
        return self.elem if self.element == "linear" else self.elem[:, PARTS].reshape(-1, 4)

    def check(self, name: object) -> None:
        """Raises ValueError if the model of this skin is impossible; name: of the skin in the message."""
        check_size(np.ptp(self.vert, axis=0).max(initial=0) if len(self.vert) else 0.0, f"skin {name}")
        if not len(self.core_face):
            raise ValueError(
                f"the core of skin {name} has no faces: a BioTac's skin sits on a closed rigid core; import "
                "the mesh again"
            )
        check_place(self.core_vert, f"core of skin {name}")
        low, high = self.core_vert.min(0) - _OFF, self.core_vert.max(0) + _OFF
        length = np.linalg.norm(self.electrode_normal, axis=1)
        if (
            not ((self.electrode_pos >= low) & (self.electrode_pos <= high)).all()
            or (abs(length - 1) > 0.01).any()
        ):
            raise ValueError(
                f"the electrodes of skin {name} are not on its core, or their normals are not of length one: "
                "import the mesh again"
            )
        for part in RIGID:
            vert, face = getattr(self, f"{part}_vert"), getattr(self, f"{part}_face")
            if not len(face):
                continue
            check_closed(face, f"{part} of skin {name}")
            wrong = no_solid(vert, face)
            if wrong is None and enclosed_volume(vert, face) < _SOLID:
                wrong = "encloses no volume: import the mesh again"
            if wrong is not None:
                raise ValueError(f"the {part} of skin {name} {wrong}")
        if self.nelem:  # a skin of one's own stepper may be a surface alone
            self._check_surfaces(name)

    def _check_surfaces(self, name):
        """Raises ValueError unless the outer and the inner surface are the free surface of the tetrahedra,
        and these have volumes."""
        check_volumes(self.vert, self.elem, f"of skin {name} ")
        mesh = TetMesh(self.vert, self.tets)
        if (mesh.volumes <= 0).any():
            return  # curved edges fold a part of an element: `SkinModel` names it
        surface = _directed(mesh.boundary)
        for which in ("outer_face", "inner_face"):
            face = getattr(self, which)
            if len(face) and np.isin(_directed(face[:, ::-1]), surface).all():
                raise ValueError(
                    f"{which} of skin {name} is inside out: flip its faces, so that normals point out of the "
                    "rubber"
                )
        given, count = np.unique(
            _directed(np.concatenate([self.outer_face, self.inner_face])), return_counts=True
        )
        free = ~np.isin(mesh.boundary, self.fixed).all(axis=1)
        more = count.sum() - np.isin(given, surface).sum()
        missing = np.count_nonzero(~np.isin(surface[free], given))
        if more or missing or not len(self.outer_face):
            raise ValueError(
                f"outer_face and inner_face of skin {name} are not the surface of its tetrahedra: "
                f"{more} triangles too many, {missing} missing; import the mesh again"
            )

    @property
    def rigid(self) -> tuple[np.ndarray, np.ndarray]:
        """Mesh (n, 3) [m], (m, 3) of core, nail and clamp."""
        return joined([(getattr(self, f"{p}_vert"), getattr(self, f"{p}_face")) for p in RIGID])

    def save(self, path: pathlib.Path | str) -> pathlib.Path:
        """Writes an .npz file with positions in float64, so that a reload is equal to the bit."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        write_npz(path, **{**fields, "design": self.design.text})
        return pathlib.Path(path)

    @classmethod
    def load(cls, path: pathlib.Path | str) -> "SkinGeometry":
        """Reads what `save` wrote.

        Raises:
          FileNotFoundError: no such file.
          ValueError: the file is not a stored skin.
        """
        remedy = "pass 'coarse', 'default', 'fine', a design's folder or a file made by `biotac lab mesh`"
        found = read_npz(path, "skin", remedy, STORED, {"design": Array((), "text")})
        try:
            design = read_design(str(found.get("design", "biotac")))
            skin = cls(**found | {"name": str(found["name"]), "design": design})
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        skin.check(path)
        return skin


def _directed(face):
    """A number (n,) for each triangle (n, 3), the same for cyclic permutations."""
    turn = (face.argmin(axis=1)[:, None] + np.arange(3)) % 3
    return triangle_numbers(np.take_along_axis(face, turn, axis=1))
