"""The real-time tier as the coupling sees it: `skin.condensed` behind the protocol `SkinStepper`."""

import functools

import numpy as np

from ...geometry.skin_geometry import SkinGeometry
from ...skin.condensed import CondensedSkin, Memory
from ...skin.condensed.memory import MAX_CONTACTS, MAX_FORCES
from ..config import Config
from ..shared import trim_memory
from ..stepper import Geom, SkinResult
from .fem import PATIENT, FemStepper

__all__ = ["CondensedStepper"]

_AT_REST = 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0  # head of a resting skin, once a step was made
_PATIENCE = 0.75  # of two-way skins: somebody waits for the step, and the next one goes on


class CondensedStepper(FemStepper):
    """The condensed skin of one BioTac: settings, model and geoms are those of the full FEM.

    The state holds what a `Memory` does: pressure, the cavity's nonlinear volume, softening and swelling,
      poses and motion of the geoms,
    contact forces (how many, then coordinates, forces and last changes) and sticking contacts (how many, then
    sample, geom and anchor)."""

    def __init__(self, config: Config, geometry: SkinGeometry, geoms: list[Geom]):
        super().__init__(config, geometry, geoms)
        g = len(geoms)
        sizes = {
            "head": 10,
            "geom_pos": 3 * g,
            "geom_mat": 9 * g,
            "motion": 3 * g,
            "forces": 1 + 3 * MAX_FORCES,
            "contacts": 1 + 5 * MAX_CONTACTS,
        }
        ends = np.cumsum(list(sizes.values()))
        self._slices = {
            name: slice(int(end - size), int(end))
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }
        self._slices["started"] = slice(0, 1)
        self.nstate = int(ends[-1])

    @functools.cached_property
    def _skin(self):
        hurry = {"patience": _PATIENCE} if self._config.coupling == "two-way" else {}
        skin = CondensedSkin(self._model, self._geom_set, **hurry)
        trim_memory()
        return skin

    @property
    def _proximity(self):
        return self._skin.proximity

    def reset(self, state: np.ndarray) -> None:
        state[:] = 0
        self._write(state, Memory.rest(len(self._geoms)))

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
        patient: bool = False,
        spent: float = 0.0,
    ) -> SkinResult:
        """See `SkinStepper`.

        Raises:
          ValueError: NaN in a pose.
        """
        begin = None if near is None else self._read(near.state)
        bound = PATIENT if patient else 1
        out = self._skin.solve(self._read(state), geom_pos, geom_mat, begin, bound * (1 - spent))
        new = np.zeros_like(state)
        self._write(new, out.memory)
        return SkinResult(
            state=new,
            wrench=out.wrench,
            tangent=out.tangent,
            vert_xpos=out.vert_xpos[: self._geometry.nvert],
            pressure=out.memory.pressure,
            converged=out.converged,
            iterations=out.iterations,
            residual=out.error,
            measured=out.measured,
            reached=out.reached,
            load=out.load,
            cost=out.cost / bound,
        )

    def contact_force(self, state: np.ndarray) -> np.ndarray:
        return self._skin.contact_force(self._read(state))[: self._geometry.nvert]

    def resting(self, state: np.ndarray) -> bool:
        return not self._part(state, "forces")[0]

    def stay_at_rest(self, state: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray) -> None:
        super().stay_at_rest(state, geom_pos, geom_mat)
        self._part(state, "head")[:] = _AT_REST

    def key(self, state: np.ndarray) -> bytes:
        """All that a solve depends on: a state is mostly unused."""
        forces, contacts = self._part(state, "forces"), self._part(state, "contacts")
        head = state[: self._slices["forces"].start]
        return (
            head.tobytes()
            + forces[: 1 + 3 * int(forces[0])].tobytes()
            + contacts[: 1 + 5 * int(contacts[0])].tobytes()
        )

    def _read(self, state) -> Memory:
        head = self._part(state, "head")
        started, pressure, bulge, growth, softening, swelling = head[:6].tolist()
        forces, contacts = self._part(state, "forces"), self._part(state, "contacts")
        n, k = int(forces[0]), int(contacts[0])
        return Memory(
            started=bool(started),
            coordinate=forces[1 : 1 + n].astype(int),
            force=forces[1 + n : 1 + 2 * n].copy(),
            change=forces[1 + 2 * n : 1 + 3 * n],
            pressure=pressure,
            bulge=bulge,
            growth=growth,
            softening=softening,
            swelling=swelling,
            after=head[6:8].copy(),
            drift=head[8:].copy(),
            geom_pos=self._part(state, "geom_pos").reshape(-1, 3),
            geom_mat=self._part(state, "geom_mat").reshape(-1, 3, 3),
            motion=self._part(state, "motion").reshape(-1, 3),
            contacts=contacts[1 : 1 + 5 * k].reshape(k, 5),
        )

    def _write(self, state, memory):
        n, k = len(memory.coordinate), len(memory.contacts)
        head = memory.started, memory.pressure, memory.bulge, memory.growth, memory.softening, memory.swelling
        self._part(state, "head")[:] = *head, *memory.after, *memory.drift
        self._part(state, "geom_pos")[:] = np.ravel(memory.geom_pos)
        self._part(state, "geom_mat")[:] = np.ravel(memory.geom_mat)
        self._part(state, "motion")[:] = memory.motion.ravel()
        forces, contacts = self._part(state, "forces"), self._part(state, "contacts")
        forces[0], contacts[0] = n, k
        forces[1 : 1 + 3 * n] = np.concatenate([memory.coordinate, memory.force, memory.change])
        contacts[1 : 1 + 5 * k] = memory.contacts.ravel()
