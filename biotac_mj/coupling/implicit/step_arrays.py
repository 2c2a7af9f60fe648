"""The coupled step of one skin in one world: the arrays and kernels of `rounds` and `energy` for MuJoCo, seen
from numpy."""

import math

import numpy as np
import warp as wp

from ...skin.newton.worlds import CONVERGED, NOT_CONVERGED
from ...skin.types import mat66, real, vec6
from ..setup import Setup
from . import energy, rounds
from .compliance import Response, add_stiffness
from .kinematics import Kinematics, row
from .marks import Marks
from .rounds import Model, Rounds, Solid
from .rows import keep_held
from .rules import LOSS_FREQUENCY
from .springs import Springs

wp.set_module_options({"enable_backward": False})


@wp.kernel
def find_off(
    # In:
    model: Model,
    r: Rounds,
    # Out:
    off_out: wp.array(dtype=real),
):
    """Largest distance from where the skin was solved [m], of the bodies that may touch it and of all."""
    for k in range(2):
        off_out[k] = rounds.distance_off(model, r, 0, real(1 - k))


class StepArrays:
    """Arrays (ngroup, ...) of a skin's step, views of what kernels work on; their names are those of `Rounds`
    and `Model`. A launch takes 1 us, several numpy calls on so few numbers.

    Args:
      kinematics: of the bodies. setup: of the BioTac. springs: of the mjData. inertial: whether its skin has
        inertia.

    Attributes:
      qacc: (nv,) accelerations for `evaluate`. wrench: (ngroup, 6) of `rounds.wrenches`.
      compliance: (ngroup, ngroup, 6, 6) of `Coupled`.
      stiffness: of the rows, see `Metric.record`.
      off: (2,) [m] of `evaluate`, see `find_off`. left_out: (ngroup,) of `energy.conclude` [J].
      find_energy, restrain, gains: functions that do the energy balance. They return whether the skin is
        greedy; whether push on a body had to be withheld; whether bodies get more energy than they have.
      models: views of wrench0, tangent0, pos0, mat0 and slack, in the last step and in this one.
    """

    def __init__(self, kinematics: Kinematics, setup: Setup, springs: Springs, inertial: bool):
        self._kinematics, shape = kinematics, (setup.ngroup, 1)
        self._loss, self._key, solid = setup.config.loss, None, Solid()
        solid.thickness, solid.area, solid.inertial = setup.thickness, 1.0, int(inertial)
        self._solid = solid
        with wp.ScopedDevice("cpu"):
            self._rounds = rounds.make_rounds(*shape)
            tangent = wp.zeros(shape, dtype=mat66)
            self._model, self._last = (rounds.make_model(*shape) for _ in range(2))
            self._rounds.surface = wp.array([setup.surface_energy], dtype=real)
            self._wrench, self._qacc = wp.zeros(shape, dtype=vec6), wp.zeros_like(kinematics.d.qvel)
            self._left_out = wp.zeros(shape, dtype=real)
            self._compliance = wp.zeros((setup.ngroup, *shape), dtype=wp.spatial_matrixd)
            self._off = wp.zeros(2, dtype=real)
            self._one, self._greedy = (wp.zeros(1, dtype=int) for _ in range(2))
            self._reason, self._marks = wp.zeros(1, dtype=int), Marks(1)
            self._led = wp.array(setup.touching.by_mocap, dtype=bool)
        self._one.fill_(1)
        self._tangent, self._keep_held = _seen(tangent), row((keep_held, shape, [tangent]))
        self.wrench, self.left_out = _seen(self._wrench), _seen(self._left_out)
        self.qacc, self.compliance = self._qacc.numpy()[0], self._compliance.numpy()[:, :, 0]
        self.off, self._is_marked, self._found = (
            a.numpy() for a in (self._off, self._marks.any, self._reason)
        )
        self._respond(springs)
        for part, names in ((self._rounds, Rounds.vars), (self._model, Model.vars)):
            for name in names:
                array = getattr(part, name)
                if isinstance(array, wp.array):
                    setattr(self, name, _seen(array))
        self.models = [(_seen(getattr(self._last, name)), getattr(self, name)) for name in Model.vars]

    def held(self, tangent: np.ndarray) -> np.ndarray:
        """The part of tangents (ngroup, 6, 6) that rows represent, see `rows.hold_by_rows`."""
        self._tangent[:] = tangent
        self._keep_held()
        return self._tangent.copy()

    def _respond(self, springs):
        """Makes the launches that find how the bodies respond to wrenches, with the factors of `springs`."""
        one, jacobian, r, L = self._one, self._kinematics.jacobian, self._rounds, springs.L
        self.stiffness, response = (r.square, jacobian, self._model.tangent0), Response(jacobian, self._model)
        self.find_compliance = row(*response.compliance(one, L, r.square, self._compliance))
        dim, stiffness = (1, jacobian.shape[2]), springs.stiffness
        self.add_stiffness = row((add_stiffness, dim, [jacobian, self._model, stiffness]))
        self.find_frequencies = row(*response.frequencies(one, stiffness, L, r.frequency))

    def record(self, step: float, ahead: float) -> None:
        """Makes the launches for a time step [s]; ahead: see `rounds.choose_gamma`."""
        if self._key == (step, ahead):
            return
        self._key, r, n = (step, ahead), self._rounds, self.wrench.shape[0]
        delay = self._loss / (2 * math.pi * LOSS_FREQUENCY * step)

        forces = rounds.wrenches, (n, 1), [self._model, r, self._wrench]
        one = [self._one]
        k = self._kinematics
        drift = k.bodies.drift(k.m, k.d, step, k.jacobian, r)
        self.begin = row(
            k.bodies.here(k.d, r.here_pos, r.here_mat),
            *drift,
            (rounds.begin_rounds, 1, [*one, self._led, r, self._last, self._model]),
            (rounds.choose_gamma, (n, 1), [step, ahead, delay, self._solid, self._last, r]),
            *drift,
        )
        self.use_euler = row((rounds.use_euler, 1, [step, *one, r]), *drift)
        self.find_wrenches = row(forces)
        self.evaluate = row(
            k.bodies.accelerate(step, k.jacobian, self._qacc, r),
            (find_off, 1, [self._model, r, self._off]),
            forces,
        )
        marks = self._marks.struct
        self.find_energy = self._marking(energy.find_energy, self._last, self._solid, r, self._greedy, marks)
        self.restrain = self._marking(energy.restrain, self._model, self._compliance, r, marks)
        self.gains = self._marking(energy.find_gain, 0.0, self._solid, r, marks)
        self._conclude = row((energy.conclude, 1, [*one, self._reason, r, self._left_out]))

    def conclude(self, converged: bool) -> np.ndarray:
        """(ngroup,) energy that is left to the bodies [J]."""
        self._found[0] = CONVERGED if converged else NOT_CONVERGED
        self._conclude()
        return self.left_out.copy()

    def _marking(self, kernel, *known):
        """A function that runs a kernel and returns whether it has marked the world."""
        run, marked = row((kernel, 1, [self._one, *known])), self._is_marked

        def find():
            marked[0] = 0
            run()
            return bool(marked[0])

        return find


def _seen(array):
    """A view of the only world of an array [item, world] or [world]."""
    view = array.numpy()
    return view[:, 0] if array.ndim == 2 else view
