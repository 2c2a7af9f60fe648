"""A skin in two-way coupling: its solves in a step."""

import numpy as np

from ...skin.bodies import BodyMotion
from ...skin.newton.worlds import CONVERGED, NOT_CONVERGED
from ..instance import Instance, Outcome
from ..setup import LINEAR
from ..structs import DataView
from .rules import FORETOLD, STILL, TOLERANCE

# of what the solves of a step may cost together: what is left is not worth another one
_MOST = 0.9


class Coupled:
    """One of the skins of a `SkinGroup`, which gives it the structs and arrays that its kernels work on. Its
    model is wrench0 - tangent (pose - pose0).

    Args:
      arrays: of the group. number: of the skin. bodies: where they are in the arrays.

    Attributes:
      off: [m] how far the bodies go from where the skin was last solved.
      may_act: whether another solve is worth its cost: not after one that reached no equilibrium.
      settled: whether the skin was solved where the bodies go.
    """

    def __init__(self, instance: Instance, data: DataView, arrays: object, number: int, bodies: slice):
        self.instance, self.number, self.bodies = instance, number, bodies
        self._data, self._arrays = data, arrays
        self.begin()

    def begin(self) -> None:
        """Begins a step."""
        self.result, self._still, self.settled = None, False, True
        self.off, self.may_act, self._cost = np.inf, True, 0.0

    def part(self, name: str) -> np.ndarray:
        """The bodies' part of one of the arrays of the group."""
        return getattr(self._arrays, name)[self.bodies]

    def find_off(self) -> None:
        """Finds how far its bodies go from where it was solved. If that was in the last step, the skin may
        stay as it is."""
        off, of_all = self._arrays.off[self.number].tolist()
        if self.result is None:
            still = self.bodies.start < self.bodies.stop and off < STILL and of_all < TOLERANCE
            self._still = still and not self.part("placed").any()
            if self._still:
                self._take(self.instance.stay())
        self.off = np.inf if self.result is None else off

    def solve(self) -> None:
        """Solves the skin where its bodies go, which give way from there."""
        if not self.instance.setup.skin.stepper.gives_way:  # it takes poses only
            self.finish()
            return
        spin = self.part("drift")[:, 3:] + self.part("moved")[:, 3:]
        wrench = self.part("acting") / self.instance.touching.fraction[:, None]
        compliance, here = self._arrays.compliance[self.number].copy(), self.part("here_pos").copy()
        self._solve(BodyMotion(compliance, wrench, self.part("pos").copy(), here, spin))

    def finish(self) -> None:
        """Solves the skin where its bodies are sure to come."""
        self._solve(None)

    def _solve(self, bodies):
        pose = self.part("pos").copy(), self.part("mat").copy()
        result = self.instance.solve_for_pose(*pose, self._core_motion(), self.result, self._cost, bodies)
        self._cost += result.cost
        if self._still and self.result is None and result.converged:
            wrong, wrench = np.abs(result.wrench - self.part("acting")), np.abs(result.wrench)
            self.instance.stays = bool(wrong.max() < FORETOLD * wrench.max())
        self._take(result)
        self.may_act = result.converged and self._cost < _MOST
        for name, value in zip(LINEAR, result.model):
            self.part(name)[:] = value

    def _take(self, result):
        self.result = result
        self._arrays.reason[self.number] = (
            CONVERGED if result is not None and result.converged else NOT_CONVERGED
        )

    def _core_motion(self):
        if not self.instance.inertial:
            return ()
        step = self.instance.model.opt.timestep
        with self._data.ahead(self.instance.lead):
            return self.instance.kinematics.core_motion(step, step**2, self._arrays.qacc)

    def conclude(self, rounds: int) -> None:
        """Tells the instance how the step went."""
        acting = self.instance.seen(self.part("acting"))
        withheld = 1.0 - self.part("push").min(initial=1.0)
        of_bodies = (self.part(name).copy() for name in ("gamma", "frequency"))
        self.instance.outcome = Outcome(rounds, self.settled, withheld, None, acting, *of_bodies)
