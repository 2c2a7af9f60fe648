"""`biotac design new`: a folder with the design and the skin of a custom pad."""

import dataclasses
import json
import pathlib
from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist, squareform

from ..files import refuse_existing, write_json
from ..geometry.core_surface import CoreSurface
from ..geometry.design import DESIGNS, Design
from ..geometry.edge_nodes import with_edge_nodes
from ..geometry.making.assembly import EMPTY, FIXED_WITHIN, assemble, fixed_nodes
from ..geometry.making.importing import read_obj, read_tet_mesh
from ..geometry.making.pads import block, dome_core, dome_shell, on_ellipsoid, plate
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.solid import check_size
from ..geometry.tet_mesh import TetMesh, connected_cells, enclosed_volume
from .channels import counts_from_impedance
from .film import FilmConduction
from .film.conduction import ELECTRODE_RADIUS

_BACKING = 1.0  # [mm] thickness of the plate that carries a pad
_CELL = 1.2  # [mm] edge of the tetrahedra unless another is given
_FLAT = 240  # nodes that may touch at once in the condensed tier, in up to 1024 worlds (docs/lab/limits.md)


@dataclasses.dataclass(frozen=True)
class PadShape:
    """Shape of a pad: one of dome, block and mesh. Lengths in mm.

    Attributes:
      dome: semi-axes (along the finger, across it, depth) of half an ellipsoid on a flat backing: a shell of
        `thickness` with liquid over the `core`. core: its semi-axes, or an .obj [m] in the BioTac frame.
      block: size (along, across, depth) of solid rubber on a flat backing.
      mesh: .msh, .tet or .vtu [m] in the BioTac frame (tip at -x, pad at -y), its rim or back on the plane y
        = 0. With a core it is a shell over liquid, else solid.
      edge: of the generated tetrahedra; None: 1.2, of a block at least so much that all nodes of its front
        may touch at once in the condensed tier.

    Raises:
      ValueError: not exactly one shape, or an invalid size.
    """

    dome: tuple = ()
    block: tuple = ()
    mesh: str | pathlib.Path | None = None
    core: tuple | str | pathlib.Path | None = None
    thickness: float = 1.5
    edge: float | None = None

    def __post_init__(self):
        if bool(self.dome) + bool(self.block) + (self.mesh is not None) != 1:
            raise ValueError("a pad has one shape: give one of --dome, --block and --mesh")
        sizes = [*self.dome, *self.block, *(self.core if isinstance(self.core, tuple) else ())]
        if len(self.dome) not in (0, 3) or len(self.block) not in (0, 3) or min([*sizes, 1.0]) <= 0:
            raise ValueError(f"dome {self.dome} and block {self.block}: give three positive lengths [mm]")
        if not (self.thickness > 0 and (self.edge is None or self.edge > 0)):
            raise ValueError(f"thickness {self.thickness} and edge {self.edge}: give positive lengths [mm]")
        if self.dome and self.core is None:
            raise ValueError(
                "a dome is a shell over a core with liquid between: give --core, or --block for solid"
            )
        if self.block and self.core is not None:
            raise ValueError("a block is solid and has no core: leave --core out, or give --dome")
        if self.mesh is None:  # before it is meshed
            check_size(1e-3 * max(np.multiply(self.dome, (2, 2, 1)) if self.dome else self.block))
        if self.dome and isinstance(self.core, tuple):
            clearance = np.subtract(self.dome, self.core).min() - self.thickness
            if clearance <= 0:
                raise ValueError(
                    f"between core and skin of {self.thickness:g} mm are {clearance:.3g} mm at the least: no "
                    "liquid fits; give a smaller --core or --thickness"
                )

    @property
    def liquid(self) -> bool:
        """Whether there is liquid between core and skin, as electrodes need."""
        return self.core is not None


def pad_skin(shape: PadShape, design: Design) -> SkinGeometry:
    """The skin of a pad on a flat backing.

    Raises:
      FileNotFoundError, ValueError: an unreadable file, or a mesh that cannot be simulated.
    """
    curved = None
    if shape.dome:
        outer, inner = (np.array(_xyz(shape.dome)), 0.0), (np.array(_xyz(shape.dome)) - shape.thickness, 0.0)
        mesh = dome_shell(outer, inner, max(4, round(1.6 * max(shape.dome) / (shape.edge or _CELL))))
        curved = {"outer": outer, "inner": inner}
    elif shape.block:
        size = np.array(_xyz(shape.block))
        mesh = block(size, _cells(size, shape.edge))
    else:
        mesh = read_tet_mesh(shape.mesh)
        mesh = TetMesh(1e3 * mesh.vert, mesh.elem)
        _check_mesh(mesh)
    backing = plate(_outline(mesh), _BACKING)
    core = EMPTY
    if isinstance(shape.core, tuple):
        core = dome_core((np.array(_xyz(shape.core)), 0.0), 30)
    elif shape.core is not None:
        vert, face = max(read_obj(shape.core), key=lambda body: abs(enclosed_volume(*body)))
        check_size(np.ptp(vert, axis=0).max(), "core", 1e-3)
        core = 1e3 * vert, face if enclosed_volume(vert, face) > 0 else face[:, ::-1]
        if (behind := core[0][:, 1].max()) > 1e3 * FIXED_WITHIN:
            raise ValueError(f"the core reaches {behind:.3g} mm behind the plane y = 0: cut it there")
    bodies = [(1e-3 * vert, face) for vert, face in ((core, backing) if len(core[1]) else (backing, EMPTY))]
    skin = assemble(design.name, TetMesh(1e-3 * mesh.vert, mesh.elem), *bodies, design=design)
    if shape.liquid and not len(skin.inner_face):
        raise ValueError("the mesh has no surface towards the core: mesh a shell, or leave --core out")
    if len(skin.inner_face) and not shape.liquid:
        raise ValueError("the mesh is a shell: give --core, under its liquid, or mesh a solid pad")
    if shape.liquid:
        free = np.setdiff1d(np.arange(skin.nvert), skin.fixed)
        room = 1e3 * CoreSurface(skin.core_vert, skin.core_face).closest(skin.vert[free])[0]
        if room.min() <= 0:
            raise ValueError(
                f"the core reaches {-room.min():.3g} mm into the skin: no liquid fits; give a smaller "
                "core, its .obj in metres"
            )
    project = None
    if curved is not None:

        def project(point, side):
            return 1e-3 * on_ellipsoid(1e3 * point, *curved[side])

    skin = with_edge_nodes(skin, project)
    on_plate = fixed_nodes(skin.vert, [body for body in bodies if len(body[1])])
    return dataclasses.replace(skin, fixed=np.union1d(skin.fixed, on_plate))


def new_design(
    folder: pathlib.Path | str,
    shape: PadShape,
    electrodes_mm: Sequence = (),
    excitation_mm: Sequence = (),
    title: str = "",
) -> Design:
    """Writes `design.json` and `default.npz` into a folder, for `attach(design=folder)`.

    Args:
      folder: its name is the design's.
      electrodes_mm, excitation_mm: (n, 3), (k, 3) points near the core, x to the fingertip, z out of the
        nail; both empty for a pad without electrodes, such as that of a camera.
      title: its name in messages.

    Raises:
      FileNotFoundError, ValueError: an invalid shape, or one that cannot be simulated; a folder that holds a
        design already, or has the name of one that is shipped.
    """
    folder = pathlib.Path(folder)
    refuse_existing(folder / "design.json")
    if folder.name in ("", "..", *DESIGNS):
        raise ValueError(f"{str(folder)!r} names no design of your own: give another folder")
    n = len(electrodes_mm)
    if n and not shape.liquid:
        raise ValueError(
            "electrodes feel the liquid between core and skin, and this pad is solid: give a core, or no "
            "electrodes"
        )
    known = {"name": folder.name, "title": title or f"pad {folder.name} ({n} electrodes)"}
    places = {"electrodes_mm": electrodes_mm, "excitation": excitation_mm}
    ideal = {"sensor": "ideal", "sensors": {"ideal": {"rest": [2000.0] * n}}} if n else {}
    design = Design(**known, **places, **ideal, sources={"all": "biotac design new"})
    skin = pad_skin(shape, design)
    if n:
        _check_places(skin)
        film = FilmConduction(skin, sensor=None)
        rest = np.clip(counts_from_impedance(film.rest), 1.0, 4094.0).round(1).tolist()
        design = dataclasses.replace(design, sensors={"ideal": {"rest": rest}})
        skin = dataclasses.replace(skin, design=design)
    skin.check(design.name)
    folder.mkdir(parents=True, exist_ok=True)
    skin.save(folder / "default.npz")
    write_json(folder / "design.json", json.loads(design.text))
    return design


def _cells(size, edge):
    """Cells (3,) of a block of a size (3,) [mm], see `PadShape.edge`."""
    length = edge or _CELL
    while True:
        cells = np.maximum(2, np.rint(size / length)).astype(int)
        if edge is not None or (2 * cells[0] + 1) * (2 * cells[2] + 1) <= _FLAT:
            return cells
        length *= 1.02


def _outline(mesh):
    """Outline (n, 2) in x and z of a backing that holds all of the mesh's back, and 5 % more."""
    back = mesh.vert[np.abs(mesh.vert[:, 1]) < 1e3 * FIXED_WITHIN][:, [0, 2]]
    if np.linalg.matrix_rank(back - back[0]) < 2:
        raise ValueError(
            "the mesh meets the plane y = 0 in a point or a line: a pad is held there by its rim or its back"
        )
    outline = back[ConvexHull(back).vertices]
    return outline + 0.05 * (outline - outline.mean(0))


def _check_mesh(mesh):
    """Raises a ValueError where a mesh [mm] is none of one pad on the plane y = 0."""
    parts = len(connected_cells(mesh.elem))
    if parts > 1:
        raise ValueError(f"the mesh has {parts} separate parts: give the mesh of one pad")
    top = mesh.vert[mesh.elem, 1].max()
    if abs(top) > 1e3 * FIXED_WITHIN:
        raise ValueError(
            f"the mesh ends at y = {top:.3g} mm, and a pad is held on the plane y = 0 and bulges to -y: move "
            "it there"
        )


def _check_places(skin):
    """Raises a ValueError where an electrode is not on the core, or two of them would touch."""
    design, disc = skin.design, 2e3 * ELECTRODE_RADIUS  # [mm]
    place = design.in_biotac_frame(np.array([*design.electrodes_mm, *design.excitation]))
    off = _off_core(skin, place)
    worst = int(off.argmax())
    if off[worst] > disc:
        units = {1e3: "are they in metres? ", 1e-3: "are they in micrometres? "}
        far = place[off > disc]
        meant = (asked for factor, asked in units.items() if (_off_core(skin, factor * far) <= disc).all())
        raise ValueError(
            f"{design.discs[worst]} is {off[worst]:.3g} mm off the core, and a disc is {disc:.3g} mm wide: "
            f"{next(meant, '')}give places on the core in mm, x to the fingertip, z out of the nail"
        )
    pair = squareform(pdist(place)) + np.diag(np.full(len(place), np.inf))
    i, k = np.unravel_index(pair.argmin(), pair.shape)
    if pair[i, k] <= disc:
        raise ValueError(
            f"{design.discs[i]} and {design.discs[k]} are {pair[i, k]:.3g} mm apart, and a disc is "
            f"{disc:.3g} mm wide: move them apart, or leave one out"
        )


def _off_core(skin, place):
    """Distance (n,) [mm] of places (n, 3) [mm] from the core's surface under the liquid."""
    backed = (skin.core_vert[skin.core_face, 1] > -FIXED_WITHIN).all(axis=1)  # faces that lie on the backing
    liquid = CoreSurface(skin.core_vert, skin.core_face[~backed])
    return 1e3 * np.abs(liquid.closest(1e-3 * place)[0])


def _xyz(lengths):
    """Along the finger, across it, depth -> along x, y, z of the BioTac frame."""
    along, across, depth = lengths
    return along, depth, across
