"""The geoms that touch a skin: types, sizes, friction and poses as in MuJoCo, on the skin's device."""

from collections.abc import Iterable, Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..kernels import add_zeros, set_fields
from .contact.meshes import DistanceGrid, pack_grids
from .contact.posed import TURN, WINDOW, Geoms
from .contact.shapes import GEOM_TYPES
from .contact.touch import CORE, MESHES, SKINS, SOLIDS
from .state import allocate

# grids of a geom type that has some
_GRIDS = {"mesh": 1, "skin": 2}
# number of MuJoCo's three sizes that a geom type uses
SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3, "plane": 0, "mesh": 0, "skin": 0}


def check_rounding(what: str, size: np.ndarray, radius: float) -> None:
    """Raises ValueError if a solid of sizes (k,) [m] is too small for fillets of this radius [m]."""
    if not 0 <= radius <= np.min(size, initial=np.inf):
        raise ValueError(
            f"rounding of {what} is {radius}: a fillet's radius lies between 0 and the smallest size"
        )


def shapes_of(types: Iterable[str]) -> str:
    """Kind of shapes among geom types, see `contact.touch.contact_kernels`."""
    return SKINS if "skin" in types else MESHES if "mesh" in types else SOLIDS


class GeomSet:
    """Geoms in the BioTac frame.

    Args:
      types: (ngeom,) names of MuJoCo geom types, or "skin" for another BioTac's skin.
      sizes: MuJoCo sizes (ngeom, 3) [m]; shorter ones are padded with zeros.
      friction: Coulomb coefficients (ngeom,).
      groups: (ngeom,) body of each geom, 0..ngroup-1; None: one group.
      rounding: fillet radius of boxes and cylinders (ngeom,) [m].
      grids: one DistanceGrid for each mesh, and two for each skin, of its undeformed shape and of its rigid
        parts, both smooth; in the order of `types`.
      own: these two of the skin that they touch; needed if `types` has a skin.
      nworld: number of worlds.
      device: Warp device.

    Attributes:
      posed: whether poses were set; the first poses are also those of the previous step.

    Raises:
      ValueError: unknown type, a size that is not positive, a fillet larger than the solid, NaN, or a mesh
        or a skin without a grid.
    """

    def __init__(
        self,
        types: Sequence[str],
        sizes: Sequence,
        friction: ArrayLike | None = None,
        groups: ArrayLike | None = None,
        rounding: ArrayLike | None = None,
        grids: Sequence[DistanceGrid] = (),
        own: Sequence[DistanceGrid] = (),
        nworld: int = 1,
        device: wp.DeviceLike = "cpu",
    ):
        count = len(types)
        for kind in types:
            if kind not in GEOM_TYPES:
                raise ValueError(
                    f"geom type {kind!r} cannot touch the skin: use one of {', '.join(GEOM_TYPES)}"
                )
        need = np.array([_GRIDS.get(kind, 0) for kind in types], np.int32)
        number = np.where(need, np.cumsum(need) - need, 0)
        if need.sum() != len(grids) or not all(isinstance(g, DistanceGrid) for g in grids):
            raise ValueError(
                "every mesh geom needs one DistanceGrid: make it with bake_distance_grid(vert, face)"
            )
        skins = [grid for k, kind in zip(number, types) if kind == "skin" for grid in grids[k : k + 2]]
        if skins and (len(own) != 2 or any(grid.coefficient is None for grid in (*skins, *own))):
            raise ValueError(
                "a geom is a skin: pass own=, two DistanceGrids of the skin that it touches; all need "
                "bake_distance_grid(vert, face, smooth=True)"
            )
        size = np.zeros((count, 3))
        for row, given in zip(size, sizes, strict=True):
            row[: len(given)] = given
        for kind, row in zip(types, size, strict=True):
            if not np.isfinite(row).all() or (row[: SIZES[kind]] <= 0).any():
                raise ValueError(
                    f"a {kind} of size {row.tolist()} is not a solid: sizes must be positive and finite"
                )
        friction = np.zeros(count) if friction is None else np.asarray(friction, float)
        rounding = np.zeros(count) if rounding is None else np.asarray(rounding, float)
        for kind, row, radius in zip(types, size, rounding, strict=True):
            check_rounding(f"a {kind}", row[: SIZES[kind]], radius)
        groups = np.zeros(count, int) if groups is None else np.asarray(groups, int)
        if not (np.isfinite(friction).all() and (friction >= 0).all()):
            raise ValueError(f"friction {friction.tolist()} must be finite and not negative")
        self.types, self.count, self.nworld, self.device = list(types), count, nworld, wp.get_device(device)
        self.ngroup = int(groups.max()) + 1 if count else 0
        self.groups, self._grids, self._rounding = groups, list(grids), rounding
        struct = Geoms()
        with wp.ScopedDevice(self.device):
            set_fields(struct, count=count, kind=[GEOM_TYPES[k] for k in types], size=size, group=groups)
            set_fields(struct, rounding=rounding, grid=number)
            set_fields(struct, friction=np.repeat(friction[:, None], nworld, 1))
            set_fields(struct, mat=np.tile(np.eye(3), (count, nworld, 1, 1)))
            add_zeros(struct, "window turn", count)
            add_zeros(struct, "pos", count, nworld)
            allocate("geoms", struct, {"geom": count, "world": nworld})
        struct.own = len(grids)
        struct.grids, self._meshes = pack_grids([*grids, *own], self.device)
        self.struct = struct
        self.posed = False
        self.advance()

    @property
    def shapes(self) -> str:
        """Kind of their shapes, see `contact.touch.contact_kernels`."""
        if self.types == ["mesh"] and self._grids[0].coefficient is not None:
            return CORE
        return shapes_of(self.types)

    def resolve(self, spacing: float, samples: int) -> None:
        """Sets the windows around edges whose radius is below the spacing [m] of a skin's samples^2 contact
        samples in a face, and the angles from which on they count, see `contact.posed.meet`. The wider the
        facets beside an edge, the further it stands out of a smooth surface: facets as wide as the skin's
        faces would lock with them if samples alone touched, and narrow ones are as good as smooth. Wider
        ones lock no more: at smaller angles contact would only change from side to edge the more at once."""
        size = self.struct.size.numpy().reshape(-1, 3)
        curved = np.isin(self.types, "ellipsoid")  # a thin one has an edge
        radius = np.where(curved, size.min(1) ** 2 / np.maximum(size.max(1), 1e-12), self._rounding)
        edged = curved | np.isin(self.types, ("box", "cylinder", "mesh"))
        self.struct.window.assign(np.where(edged & (radius < spacing), WINDOW / samples, 0.0))
        meshes = zip(self.struct.grid.numpy().tolist(), self.types)
        width = np.array([self._grids[k].facet_width if kind == "mesh" else 0.0 for k, kind in meshes])
        width = np.clip(width, spacing, 2 / 3**0.25 * samples * spacing)  # at most an edge of the skin's
        turn = np.outer(spacing / width, TURN)
        self.struct.turn.assign(np.cos(np.radians(turn)))

    def advance(self) -> None:
        """Stores the present poses as those of the last step."""
        wp.copy(self.struct.pos_last, self.struct.pos)
        wp.copy(self.struct.mat_last, self.struct.mat)

    def set_pose(self, pos: ArrayLike, mat: ArrayLike | None = None) -> None:
        """Sets the poses of the geoms in the BioTac frame.

        Args:
          pos: (ngeom, 3) or (nworld, ngeom, 3) [m].
          mat: rotation matrices (ngeom, 3, 3) or (nworld, ngeom, 3, 3); None: unchanged.

        Raises:
          ValueError: NaN or a wrong shape.
        """
        self._assign(self.struct.pos, pos, (3,), "positions")
        if mat is not None:
            self._assign(self.struct.mat, mat, (3, 3), "rotations")
        if not self.posed:
            self.posed = True
            self.advance()

    def set_friction(self, friction: ArrayLike) -> None:
        """Sets the Coulomb coefficients (ngeom,) or (nworld, ngeom)."""
        self._assign(self.struct.friction, friction, (), "friction coefficients")

    def _assign(self, target, value, item, what):
        value = np.asarray(value, float)
        if value.shape == (self.count, *item):
            value = np.broadcast_to(value, (self.nworld, *value.shape))
        if value.shape != (self.nworld, self.count, *item):
            raise ValueError(
                f"geom {what} have shape {value.shape}: expected {(self.count, *item)} or "
                f"{(self.nworld, self.count, *item)}"
            )
        if not np.isfinite(value).all():
            raise ValueError(
                f"geom {what} contain NaN or infinite numbers: the simulation has diverged or a pose was "
                "never set"
            )
        if self.count:
            target.assign(np.ascontiguousarray(np.swapaxes(value, 0, 1)))
