"""The coupled step of all skins of one mjData: the arrays and kernels of `rounds` and `energy`, seen from
numpy."""

import math
import types
from collections.abc import Sequence

import numpy as np
import warp as wp

from ...kernels import kernel_module, set_fields
from ...skin.newton.worlds import CONVERGED, NOT_CONVERGED
from ...skin.types import mat66, real, vec6
from ..setup import Setup
from . import energy, rounds
from .compliance import Response, add_stiffness
from .kinematics import Kinematics, row, rows_of
from .rounds import MarkedWorlds, Model, Rounds, Solid
from .rows import keep_held
from .rules import LOSS_FREQUENCY
from .springs import Springs

kernel_module(__name__)


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
    """Arrays of the step of all skins of an mjData, the bodies of one after those of another, (nbody, ...):
    views of what kernels work on; their names are those of `Rounds` and `Model`. A stage of all skins is one
    call: a launch takes 1 us, several numpy calls on so few numbers.

    Args:
      kinematics: of the bodies. setups: of the BioTacs. springs: of the mjData.

    Attributes:
      awake: (nskin,) int, 1: the skin takes part in the step. began, inside: (nskin,) of `Rounds`.
      qacc: (nv,) accelerations for `evaluate`. wrench: (nbody, 6) of `rounds.wrenches`.
      compliance: of each skin, (ngroup, ngroup, 6, 6) of `Coupled`; find_compliance: functions that find it.
      stiffness: of the rows, see `Metric`.
      off: (nskin, 2) [m] of `evaluate`, see `find_off`. left_out: (nbody,) of `conclude` [J].
      find_energy, restrain, gains: functions that do the energy balance. They return whether a skin is
        greedy; whether push on a body had to be withheld; whether bodies get more energy than they have.
      last: {name: view} of the last step's `Model`.
    """

    def __init__(self, kinematics: Kinematics, setups: Sequence[Setup], springs: Springs):
        self._kinematics, self._key, shape = kinematics, None, kinematics.jacobian.shape[:2]
        with wp.ScopedDevice("cpu"):
            whole = rounds.make_rounds(*shape)
            model, last = (rounds.make_model(*shape) for _ in range(2))
            tangent, wrench = wp.zeros(shape, dtype=mat66), wp.zeros(shape, dtype=vec6)
            left_out, self._qacc = wp.zeros(shape, dtype=real), wp.zeros_like(kinematics.d.qvel)
            off, self._any = wp.zeros((len(setups), 2), dtype=real), wp.zeros(1, dtype=int)
            names = "awake", "began", "inside", "reason", "greedy", "marked"
            flags = {name: wp.zeros(len(setups), dtype=int) for name in names}
            self._skins = [types.SimpleNamespace() for _ in setups]
            for k, (skin, setup, part) in enumerate(zip(self._skins, setups, kinematics.parts)):
                skin.jacobian, skin.tangent = rows_of(kinematics.jacobian, part), rows_of(tangent, part)
                skin.wrench, skin.left_out, skin.off = rows_of(wrench, part), rows_of(left_out, part), off[k]
                skin.flags = {name: array[k : k + 1] for name, array in flags.items()}
                skin.rounds = _of_skin(Rounds, whole, part)
                skin.model, skin.last = (_of_skin(Model, one, part) for one in (model, last))
                skin.rounds.began, skin.rounds.inside = skin.flags["began"], skin.flags["inside"]
                skin.rounds.surface = wp.array([setup.skin.stepper.surface_energy], dtype=real)
                skin.marks = set_fields(MarkedWorlds(), world=skin.flags["marked"], any=self._any)
                skin.compliance = wp.zeros((setup.ngroup, setup.ngroup, 1), dtype=wp.spatial_matrixd)
                skin.by_mocap = wp.array(setup.touching.by_mocap, dtype=bool)
                skin.bodies, skin.loss = kinematics.bodies[k], setup.config.loss
                of_skin = {"thickness": setup.skin.thickness, "inertial": setup.skin.stepper.inertial}
                skin.solid = set_fields(Solid(), area=1.0, **of_skin)
        self._tangent = [_seen(skin.tangent) for skin in self._skins]
        self._keep_held = [row((keep_held, skin.tangent.shape, [skin.tangent])) for skin in self._skins]
        self.wrench, self.left_out, self.qacc = _seen(wrench), _seen(left_out), self._qacc.numpy()[0]
        self.compliance, self.off = [skin.compliance.numpy()[:, :, 0] for skin in self._skins], off.numpy()
        self.awake, self.began, self.inside, self._reason, *_ = (a.numpy() for a in flags.values())
        for kind, struct in ((Rounds, whole), (Model, model)):
            for name in kind.vars:
                if _is_of_bodies(array := getattr(struct, name)):
                    setattr(self, name, _seen(array))
        self.last = {name: _seen(getattr(last, name)) for name in Model.vars}
        self.stiffness = whole.square, kinematics.jacobian, model.tangent0
        self._respond(springs, (kinematics.jacobian, model))

    def held(self, skin: int, tangent: np.ndarray) -> np.ndarray:
        """The part of tangents (ngroup, 6, 6) of a skin that rows represent, see `rows.hold_by_rows`."""
        self._tangent[skin][:] = tangent
        self._keep_held[skin]()
        return self._tangent[skin].copy()

    def _respond(self, springs, whole):
        """Makes the launches that find how the bodies respond to wrenches, with the factors of `springs`."""
        L, stiffness = springs.L, springs.stiffness
        self.find_compliance, frequencies = [], []
        for skin in self._skins:
            response, r, awake = Response(skin.jacobian, skin.model), skin.rounds, skin.flags["awake"]
            self.find_compliance.append(row(*response.compliance(awake, L, r.square, skin.compliance)))
            frequencies += response.frequencies(awake, stiffness, L, r.frequency)
        self.find_frequencies = row((add_stiffness, stiffness.shape[:2], [*whole, stiffness]), *frequencies)

    def record(self, step: float, ahead: float) -> None:
        """Makes the launches for a time step [s]; ahead: see `rounds.choose_gamma`."""
        if self._key == (step, ahead):
            return
        self._key, k = (step, ahead), self._kinematics

        def drift(skin):
            return skin.bodies.drift(k.m, k.d, step, skin.jacobian, skin.rounds)

        def begin(skin):
            r, awake = skin.rounds, skin.flags["awake"]
            delay = skin.loss / (2 * math.pi * LOSS_FREQUENCY * step)
            return (
                skin.bodies.here(k.d, r.here_pos, r.here_mat),
                *drift(skin),
                (rounds.begin_rounds, 1, [awake, skin.by_mocap, r, skin.last, skin.model]),
                (rounds.choose_gamma, r.pos.shape, [step, ahead, delay, skin.solid, skin.last, r]),
                *drift(skin),
            )

        def forces(skin):
            return [(rounds.wrenches, skin.wrench.shape, [skin.model, skin.rounds, skin.wrench])]

        def evaluate(skin):
            moved = skin.bodies.accelerate(step, skin.jacobian, self._qacc, skin.rounds)
            return moved, (find_off, 1, [skin.model, skin.rounds, skin.off]), *forces(skin)

        def use_euler(skin):
            return (rounds.use_euler, 1, [step, skin.flags["greedy"], skin.rounds]), *drift(skin)

        def conclude(skin):
            flags = skin.flags["awake"], skin.flags["reason"]
            return [(energy.conclude, 1, [*flags, skin.rounds, skin.left_out])]

        stages = begin, use_euler, forces, evaluate, conclude
        self.begin, self.use_euler, self.find_wrenches, self.evaluate, self._conclude = map(self._row, stages)
        self.find_energy = self._marking(
            energy.find_energy, lambda s: (s.last, s.solid, s.rounds, s.flags["greedy"])
        )
        self.restrain = self._marking(energy.restrain, lambda s: (s.model, s.compliance, s.rounds))
        self.gains = self._marking(energy.find_gain, lambda s: (0.0, s.solid, s.rounds))

    def conclude(self, converged: Sequence[bool]) -> None:
        """Finds `left_out`, the energy that is left to the bodies. converged: whether each skin has."""
        self._reason[:] = np.where(converged, CONVERGED, NOT_CONVERGED)
        self._conclude()

    def _row(self, launches):
        """One call for the launches of all skins."""
        return row(*(launch for skin in self._skins for launch in launches(skin)))

    def _marking(self, kernel, known):
        """A function that runs a kernel and returns whether it has marked a skin."""
        run = self._row(lambda s: [(kernel, 1, [s.flags["awake"], *known(s), s.marks])])
        marked = self._any.numpy()

        def find():
            marked[0] = 0
            run()
            return bool(marked[0])

        return find


def _of_skin(kind, whole, part):
    """A struct with rows `part` of the arrays [body, world] of another, and its other fields."""
    one = kind()
    for name in kind.vars:
        value = getattr(whole, name)
        setattr(one, name, rows_of(value, part) if _is_of_bodies(value) else value)
    return one


def _is_of_bodies(value):
    return isinstance(value, wp.array) and value.ndim == 2


def _seen(array):
    """A view of the only world of an array [item, world]."""
    return array.numpy()[:, 0]
