"""The fast tier as the coupling sees it: `skin.condensed` as a `SkinStepper`."""

import functools

import numpy as np

from ...geometry.skin_geometry import SkinGeometry
from ...skin.bodies import BodyMotion
from ...skin.condensed import CondensedSkin, Memory
from ...skin.condensed.memory import layout_of
from ..config import Config
from ..shared import trim_memory
from ..stepper import Geom, SkinResult
from .fem import FemStepper

_PATIENCE = 0.75  # of two-way skins: somebody waits for the step, and the next one goes on

_SAME = "wrench tangent converged iterations measured load_factor load cost slack".split()


class CondensedStepper(FemStepper):
    """The condensed skin of one BioTac: settings, model and geoms are those of the full FEM.

    The state holds what a `Memory` does."""

    def __init__(self, config: Config, geometry: SkinGeometry, geoms: list[Geom]):
        super().__init__(config, geometry, geoms)
        self._layout = layout_of(len(geoms))

    @functools.cached_property
    def _skin(self):
        hurry = {"patience": _PATIENCE} if self._config.coupling == "two-way" else {}
        skin = CondensedSkin(self._model, self._geom_set, **hurry)
        trim_memory()
        return skin

    @property
    def _proximity(self):
        return self._skin.proximity

    @functools.cached_property
    def _rest(self):
        return self._layout.rest()

    def vert_xpos(self, state: np.ndarray) -> np.ndarray:
        n = self._geometry.nvert  # quadratic elements have more nodes behind the skin's own
        return self._skin.nodes(self._read(state))[:n].copy()

    def solve_skin(
        self,
        state: np.ndarray,
        geom_pos: np.ndarray,
        geom_mat: np.ndarray,
        dt: float,
        core_pos: np.ndarray | None = None,
        core_mat: np.ndarray | None = None,
        near: SkinResult | None = None,
        spent: float = 0.0,
        bodies: BodyMotion | None = None,
    ) -> SkinResult:
        """See `SkinStepper`.

        Raises:
          ValueError: NaN in a pose.
        """
        memory = self._read(state)
        begin = self._read(near.state) if near is not None and bodies is not None else None
        out = self._skin.solve(memory, geom_pos, geom_mat, 1 - spent, bodies, begin)
        same = {name: getattr(out, name) for name in _SAME}
        vert, pressure = out.vert_xpos[: self._geometry.nvert], out.memory.pressure
        return SkinResult(out.memory.row, vert_xpos=vert, pressure=pressure, residual=out.error, **same)

    def contact_force(self, state: np.ndarray) -> np.ndarray:
        return self._skin.contact_force(self._read(state))[: self._geometry.nvert]

    def _push(self, state):
        return self._skin.normal_force_of_faces(self._read(state), self._touched_faces(state))

    def resting(self, state: np.ndarray) -> bool:
        return not self._part(state, "forces")[0]

    def pressure(self, state: np.ndarray) -> float:
        return float(self._part(state, "pressure")[0])

    def stay_at_rest(self, state: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray) -> None:
        self._place_geoms(state, geom_pos, geom_mat)
        for name in self._layout.of_skin:
            self._part(state, name)[:] = self._part(self._rest, name)

    def _read(self, state) -> Memory:
        return Memory(state, self._layout)
