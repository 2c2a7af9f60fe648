"""Proximity queries: whether geoms are clear of the undeformed skin of one world, and where they come from
that are inside it."""

import typing

import numpy as np
import warp as wp

from ...geometry.surface import face_areas
from ...launches import recorded
from ..geoms import GeomSet
from ..program import Program
from ..types import mat33, real, vec3
from .clearance import BOUND, CLEAR, EXACT, TOUCH, Clearance, make_seen
from .faces import Laws
from .outside import leave_skin
from .penetration import measure_core

if typing.TYPE_CHECKING:
    from ..model import SkinModel

_CORE = 1e-6  # [m] accuracy of the position at which a geom leaves the core
_FAR = 1.0  # [m] most motion of a geom out of the skin


class ProximityQuery:
    """Queries about the undeformed skin and the geoms of one world, on the CPU.

    Args:
      model: SkinModel. geoms: GeomSet of one world. laws: of the contact.
    """

    def __init__(self, model: "SkinModel", geoms: GeomSet, laws: Laws):
        geoms.resolve(model.spacing, model.options.samples)
        struct = geoms.struct
        self._model, self._geoms = model, geoms
        self._now, self._last = (
            (a.numpy()[:, 0], b.numpy()[:, 0])
            for a, b in ((struct.pos, struct.mat), (struct.pos_last, struct.mat_last))
        )
        self._rest, self._face = np.ascontiguousarray(model.rest.vert, float), model.outer.face.numpy()
        with wp.ScopedDevice("cpu"):
            at, on = Clearance(model, geoms.count, 1, make_seen(geoms.count, 1)), wp.ones(1, dtype=int)
            x, core = wp.array(self._rest[:, None], dtype=vec3), wp.zeros(1, dtype=real)
            self._left, self._turned = (wp.zeros((geoms.count, 1), dtype=kind) for kind in (vec3, mat33))
        self._find = [
            Program("cpu", lambda p, wanted=wanted: at.find(on, struct, laws, x, wanted, p)).run
            for wanted in (BOUND, TOUCH, EXACT)
        ]
        self._meet = Program("cpu", lambda p: at.begin_where_met(on, struct, laws, x, p)).run
        self._finite, self._found, self._core = at.known.numpy(), at.found.numpy(), core.numpy()
        self._known = on, model.outer.face, model.sample, x, struct
        touch = max(float(a.numpy().max(initial=0.0)) for a in (laws.reach, laws.smoothing))
        near = max(CLEAR, touch)
        self._limits = near, touch, near
        self._measure_core = None
        if model.has_core and geoms.count:
            inputs = [model.core_vert, model.core(1).struct, struct]
            self._measure_core = recorded(measure_core, 1, inputs, [core])

    def clear(self, pos: np.ndarray, mat: np.ndarray, wanted: int = TOUCH) -> bool:
        """Whether geoms at (ngeom, 3) [m], (ngeom, 3, 3) do not touch the undeformed skin, and none is too
        `deep` in the core. wanted: EXACT: and are not near; BOUND: maybe False where they are not near."""
        self.pose(pos, mat)
        self._find[wanted]()
        (skin, core), limit = self._found[0].tolist(), self._model.options.max_core_depth
        return bool(self._finite[0]) and skin >= self._limits[wanted] and core >= -limit

    def met(
        self, pos0: np.ndarray, mat0: np.ndarray, pos: np.ndarray, mat: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses (ngeom, 3) [m], (ngeom, 3, 3) where the step of geoms that go from pos0, mat0 to pos, mat
        begins for a skin at rest, see `clearance.begin_where_met`."""
        self.pose(pos, mat)
        self._last[0][...], self._last[1][...] = pos0, mat0
        self._meet()
        return self._last[0].copy(), self._last[1].copy()

    def outside(self, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
        """Positions (ngeom, 3) [m] of the geoms after each is moved out of the undeformed skin, along the
        mean normal of the faces that it touches (`outside.leave_skin`); of one in the core that touches none,
        after it is made `shallow`."""
        if self.clear(pos, mat):
            return pos
        out = self._leave_skin(pos, mat)
        return self._leave_skin(self.shallow(out, mat), mat) if self.deep(out, mat) else out

    def _leave_skin(self, pos, mat):
        self.pose(pos, mat)
        left = self._left.numpy()[:, 0]
        left[...] = np.nan
        # not recorded beforehand: few geoms begin in a skin, and the kernel takes 2 s to compile
        wp.launch_tiled(
            leave_skin,
            dim=self._left.shape,
            inputs=self._known,
            outputs=[self._left, self._turned],
            block_dim=1,
            device="cpu",
        )
        return left.copy()

    def shallow(self, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
        """Positions (ngeom, 3) [m] of the geoms. Each one that is too `deep` in the core is moved out, along
        the mean normal of the undeformed faces that it touches, or that of the nearest, until a skin fits
        between; accurate to 1 um."""
        out, ways = pos.copy(), self._leave_skin(pos, mat) - pos
        for g, way in enumerate(ways):
            single = np.full_like(pos, 2 * _FAR)  # the others far away

            def is_free(distance, g=g, single=single, normal=0.0):
                single[g] = pos[g] + distance * normal
                return not self.deep(single, mat)

            if is_free(0.0):
                continue
            if not way.any():
                away = self._rest[self._face].mean(1) - pos[g]
                way = face_areas(self._rest, self._face[[np.einsum("ij,ij->i", away, away).argmin()]])[0]
            normal, high = way / np.linalg.norm(way), _CORE
            while high < _FAR and not is_free(high, normal=normal):
                high *= 2
            low = high / 2
            while high - low > _CORE:
                middle = (low + high) / 2
                low, high = (low, middle) if is_free(middle, normal=normal) else (middle, high)
            out[g] = pos[g] + high * normal
        return out

    def deep(self, pos: np.ndarray, mat: np.ndarray) -> bool:
        """Whether a geom at these poses is deeper inside the core than `max_core_depth`."""
        if self._measure_core is None:
            return False
        self.pose(pos, mat)
        self._measure_core()
        return -float(self._core[0]) > self._model.options.max_core_depth

    def pose(self, pos: np.ndarray, mat: np.ndarray) -> None:
        """Sets the geoms' poses (ngeom, 3), (ngeom, 3, 3)."""
        self._now[0][...], self._now[1][...] = pos, mat
