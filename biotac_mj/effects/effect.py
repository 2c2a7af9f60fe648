"""An effect that a simulator can have or miss: one class, one stage, parameters with units, bounds and
source.

Your own in ten lines:

    class HalfBoard(Effect):
        id, name, stage = "half_board", "one half of the multiplexer creeps", "A"
        physics = "the reference of every other electrode creeps while the session lasts"
        params = {"rate": Param("counts/s", -5, 5, "my own board", scale=0.1)}
        confusable = {"warmup": "one half of the electrodes or all"}

        def apply(self, run, theta):
            run.counts[:, ::2] += theta["rate"] * run.clock[:, None]

    diagnose(sim, data, effects=[*CATALOGUE, HalfBoard()])
"""

import abc
import copy
import dataclasses
import functools
import typing
from collections.abc import Sequence

import numpy as np

from ..geometry.design import BIOTAC, Design

if typing.TYPE_CHECKING:
    from ..sensor.presets import Sensor
    from .in_skin import Inside

__all__ = ["LAW", "STAGES", "Effect", "Param", "Run", "Whole", "shifted", "memory", "stop"]

# In the order in which they act. B and S change where the object is or its size, so the skin is solved again.
STAGES = {
    "S": "set-up",
    "B": "boundary",
    "K": "contact",
    "C": "constitutive",
    "T": "transduction",
    "A": "acquisition",
}

# reduced laws: what practice data with other forms of the same effects showed
# (docs/lab/discrepancy.md)
LAW = 0.08


@dataclasses.dataclass(frozen=True)
class Param:
    """A parameter of an effect: its bounds, its prior, and where both come from.

    Attributes:
      unit; low, high: bounds; source: of the bounds.
      scale: a realistic size, with which signatures are taken and the prior is made.
      start: value without the effect.
      shape: whether it does nothing by itself (a time constant, a knee); several values are tried.
    """

    unit: str
    low: float
    high: float
    source: str
    scale: float = 1.0
    start: float = 0.0
    shape: bool = False


@dataclasses.dataclass
class Run:
    """One trajectory on its way through the stages. n rows; effects change it in place.

    Attributes:
      time (n,) within the trajectory, clock (n,) of the session [s]; tool; heading (3,); depth (n,) [m];
      order: number in the session.
      offset (n, 3): of the object beyond where it was meant to be [m]; log_radius, log_friction: of the tool
        and the contact.
      bubble: volume of trapped air [m3].
      force (n, 3) [N], pressure (n,) [Pa], log_z (n, nelectrode): ln of the impedances [ohm]; before the
      skin is solved those without effects. counts (n, nelectrode), pdc (n,): after the converter, before
      rounding.
      temperature: (n,) above the first row of the session [C], or None.
      stiffness: (n,) d normal force / d depth [N/m], None where it is not known.
      answers: change of the rubber -> dict of force, pressure and log_z (shapes as above) by unit of it,
        where that has been solved; modulus: factor on the material's since.
      turn: (3,) or (n, 3) rotation vector by which the sensor is turned from the frame in which poses and
        force are given [rad].
      pos: (n, 3) of the object [m], None where only the place of its touch is known.
      session: dict that the effects of one simulation share from trajectory to trajectory.
    """

    time: np.ndarray
    clock: np.ndarray
    tool: str
    heading: np.ndarray
    depth: np.ndarray
    place: np.ndarray
    order: int
    offset: np.ndarray
    force: np.ndarray
    pressure: np.ndarray
    log_z: np.ndarray
    temperature: np.ndarray | None
    session: dict
    log_radius: float = 0.0
    log_friction: float = 0.0
    bubble: float = 0.0
    rest_log_z: np.ndarray | None = None
    counts: np.ndarray | None = None
    pdc: np.ndarray | None = None
    stiffness: np.ndarray | None = None
    answers: dict = dataclasses.field(default_factory=dict)
    modulus: float = 1.0
    pos: np.ndarray | None = None
    turn: float | np.ndarray = 0.0

    @classmethod
    def of_counts(
        cls, counts: np.ndarray, rest_log_z: np.ndarray, time: np.ndarray | None = None, **more: np.ndarray
    ) -> "Run":
        """A Run of counts (n, nelectrode) alone, in which nothing touches.

        Args:
          rest_log_z: (nelectrode,) ln of the impedances at rest [ohm]. time: (n,) [s]; None: all rows at
          once.
          more: other fields, such as force (n, 3) [N]."""
        n = len(counts)
        time = np.zeros(n) if time is None else time
        plain = {
            "clock": time,
            "tool": "",
            "heading": np.zeros(3),
            "depth": np.zeros(n),
            "place": np.zeros(3),
            "order": 0,
            "offset": np.zeros((n, 3)),
            "force": np.zeros((n, 3)),
            "pressure": np.zeros(n),
            "log_z": np.tile(rest_log_z, (n, 1)),
            "temperature": None,
            "session": {},
        }
        return cls(time=time, counts=counts, rest_log_z=rest_log_z, **plain | more)

    @property
    def rest(self) -> np.ndarray:
        """(nelectrode,) counts at rest."""
        return 4095 / (np.exp(self.rest_log_z) / 1e4 + 1)

    @property
    def normal_force(self) -> np.ndarray:
        """(n,) against the heading, positive while pressed [N]."""
        return np.maximum(-self.force @ self.heading, 0)

    def give(self, compliance: float | np.ndarray) -> np.ndarray:
        """(n,) x = compliance F(depth - x): how far something in series gives way [m]; compliance (n,) or one
        for all rows."""
        stiffness = 0.0 if self.stiffness is None else self.stiffness
        return compliance * self.normal_force / (1 + np.maximum(compliance, 0) * stiffness)

    def scale_load(self, factor: float | np.ndarray) -> None:
        """Multiplies what the rubber bears: force and the liquid's pressure (n,)."""
        factor = np.broadcast_to(factor, self.time.shape)
        self.force = self.force * factor[:, None]
        self.pressure = self.pressure * factor


@dataclasses.dataclass
class Whole:
    """What effects change of a sensor as a whole: factors on friction and on the rubber's modulus, air in the
    liquid [m3], and the fraction of the liquid that is gone."""

    friction: float = 1.0
    modulus: float = 1.0
    air: float = 0.0
    lost: float = 0.0


class Effect(abc.ABC):
    """Subclasses set the attributes that differ from those here, and write `apply`.

    Attributes:
      id, name: of the effect. stage: key of STAGES. physics: what happens, in words.
      fits: in what the effect is looked for, a set of "poses" (trajectories with the object's poses), "log"
        (recordings without), "checkup" (segments of a checkup's protocol) and "plate" (presses of a flat
        plate). An id may have a form for each.
      params: {name: Param}. each: of every electrode, in `params` by its name. design: which has them.
      grid: values of the shape parameters that are tried.
      rare: further parameters, which the effect has only where the data ask for them (`given`).
      law: how far the true law may lie from this one: standard deviation as a fraction of a parameter, part
        of its interval.
      confusable: {id: experiment that separates the two}. equivalents: ids of other laws with the same
        appearance, separated only by much evidence. refit_with: ids of effects that are fitted
        wherever this one is.
      per_channel: whether each free parameter belongs to one electrode.
      of_pairs: whether it may have parameters of pairs of electrodes, which a search finds first.
      wiring: whether it says which electrode is read where, which has no other form.
      of_rest: whether it changes nothing but where electrodes rest, about which trajectories are compared.
      moves_object: whether it moves the object. pose_offset: whether it moves all poses alike, as their
        scatter from trial to trial does.
      remembers: whether rubber or contact can do it inside the skin, and films follow late.
      answers: names of differences of the skin (`discrepancy.trajectories.model.fields`) that it uses.
      instead_of: nuisance parameters of the base model in whose place it stands.
      sound: root mean square of its parameters up to which a sound sensor has it.
      drifts: whether it is a level that goes with the session's clock. in_noise: whether what is measured as
        noise has it in it. silent: whether an electrode shows one value whatever touches it.
      alike: whether a running sensor has it of all electrodes alike. most: {parameter: largest value that a
        running sensor can have}.
      detector: class of evidence by which logs show it, in whose terms a name's confidence is given
        (`discrepancy.recordings.confidence`).
    """

    id = name = stage = physics = ""
    fits: frozenset = frozenset({"poses"})
    params: dict = {}
    each: Param | None = None
    design: Design = BIOTAC
    grid: tuple = ({},)
    rare: dict = {}
    law = 0.0
    confusable: dict = {}
    equivalents: tuple = ()
    refit_with: tuple = ()
    per_channel = False
    of_pairs = False
    wiring = False
    of_rest = False
    moves_object = False
    pose_offset = False
    remembers = False
    answers: tuple = ()
    instead_of: tuple = ()
    sound = 0.0
    drifts = in_noise = silent = alike = False
    most: dict = {}
    detector = ""

    @abc.abstractmethod
    def apply(self, run: Run, theta: dict) -> None:
        """Changes `run` where the effect acts; theta has a value for every parameter, and no effect where all
        are at `Param.start`."""

    def in_skin(self, inside: "Inside", theta: dict) -> bool:
        """Writes what a skin becomes in which it acts itself (`in_skin.Inside`); False where it does not."""
        return False

    def in_whole(self, whole: "Whole", theta: dict) -> dict | None:
        """Writes what it changes of a sensor as a whole; returns the theta with which it acts besides, None
        where it does not."""
        return theta

    def of_setup(self, theta: dict) -> bool:
        """Whether it belongs to where data were taken, and not to the sensor."""
        return self.stage in ("S", "B")

    def in_sensor(self, sensor: "Sensor", theta: dict) -> dict | None:
        """Numbers of a running sensor (`sensor.presets.Sensor`) that has it; None where none can."""
        return None

    @property
    def runs(self) -> bool:
        """Whether a running sensor has it by its own numbers, and needs no other skin."""
        return self.stage in ("T", "A") and type(self).in_sensor is not Effect.in_sensor

    def applicable(self, trajectories: list) -> str | None:
        """Why the data cannot show the effect, or None."""
        return None

    def among(self, trajectories: list) -> "Effect":
        """The effect with the parameters that these trajectories can have."""
        return self

    def on(self, design: Design) -> "Effect":
        """The effect on another fingertip: with parameters for its electrodes."""
        if design == self.design:
            return self
        other = copy.copy(self)
        other.design = design
        if self.each is not None:
            besides = {n: p for n, p in self.params.items() if n not in self.design.electrodes}
            other.params = dict.fromkeys(design.electrodes, self.each) | besides
        return other

    def given(self, names: Sequence[str]) -> "Effect":
        """The effect with parameters of these names, where it takes its own from the data."""
        more = {name: p for name, p in self.rare.items() if name in names}
        if not more:
            return self
        other = copy.copy(self)
        other.params = {**self.params, **more}
        return other

    def only(self, names: Sequence[str]) -> "Effect":
        """The effect with these of its free parameters alone."""
        other = copy.copy(self)
        other.params = {n: p for n, p in self.params.items() if p.shape or n in names}
        return other

    def solved(self, names: Sequence[str]) -> "Effect":
        """The effect with parameters of these names, differences of the skin that were solved for it."""
        return self

    def joining(self, theta: dict) -> float | None:
        """Work of joining of the contact [J/m2] at which the skin has to be solved, or None."""
        return None

    def trends(self, change: list, clock: list) -> list:
        """What an effect of single electrodes adds to each of them, by one.

        Args:
          change: (n, nelectrode) per trajectory, what each electrode should have shown, from rest.
          clock: (n,) per trajectory, the session's clock [s].

        Returns:
          lists of (n, nelectrode) per trajectory, one list for each form that is tried.
        """
        return []

    def unsearched(self, theta: dict) -> list[int]:
        """Electrodes (from 0) whose rest says nothing by itself where the effect has these parameters."""
        return []

    def undoes(self, theta: dict, log_modulus: float) -> bool:
        """Whether it gives back what a modulus of the base model, a factor of exp(log_modulus), has taken."""
        return False

    def rejection_reason(self, theta: dict) -> str | None:
        """Why fitted parameters are not what the effect could be, or None."""
        return None

    def alias(self, theta: dict) -> tuple:
        """Ids of other effects that with fitted parameters like these are as likely, whatever fits better."""
        return ()

    def draw(self, rng: np.random.Generator, size: float = 1.0) -> dict:
        """A sensor's theta: normal about no effect, `size` times `scale` wide, within the bounds; on the
        possible side where there is but one. Shape parameters are one of the grid's."""
        theta = self.default() | dict(self.grid[rng.integers(len(self.grid))])
        for name in self.free:
            p = self.params[name]
            step = rng.normal(0.0, size * p.scale)
            theta[name] = float(np.clip(abs(step) if p.low == p.start else p.start + step, p.low, p.high))
        return theta

    @property
    def before_skin(self) -> bool:
        """Whether it changes what the skin is solved with."""
        return self.stage in ("S", "B")

    @property
    def free(self) -> list[str]:
        """Names of the parameters that are fitted; shape parameters come from `grid`, then are polished."""
        return [n for n, p in self.params.items() if not p.shape]

    def default(self) -> dict:
        """Parameters without effect, shape parameters from the first entry of the grid."""
        return {**{n: p.start for n, p in self.params.items()}, **self.grid[0]}


def memory(run: Run, x: np.ndarray, tau: float, of: str | None = None) -> np.ndarray:
    """(n, ...) x less its exponential memory: what has changed within about tau.

    Args:
      of: a name under which the session keeps what is left at the end of a trajectory: the next one, which
        follows by the session's clock, begins with that. None begins with nothing."""
    decay = _decay_matrix(np.ascontiguousarray(run.time, float).tobytes(), float(tau))
    out = (decay @ np.diff(x, axis=0).reshape(decay.shape[1], -1)).reshape(x.shape)
    if of is None:
        return out
    before = run.session.get((of, tau))
    if before is not None and run.clock[0] >= before[0]:
        since, kept, last = run.clock - before[0], before[1], before[2]
        # when in between it changed is not known
        weight = np.exp(-since / tau)[:, None], np.exp(-(since - 0.5 * since[0]) / tau)[:, None]
        more = weight[0] * np.ravel(kept) + weight[1] * np.ravel(x[0] - last)
        out = out + more.reshape(x.shape)
    run.session[of, tau] = float(run.clock[-1]), out[-1], x[-1]
    return out


def shifted(x: np.ndarray, time: np.ndarray, delay: float) -> np.ndarray:
    """(n, ...) x at times (n,) [s] as it was `delay` [s] before, or later where that is negative; straight
    lines between rows, the ends hold."""
    at = np.clip(time - delay, time[0], time[-1])
    i = np.clip(np.searchsorted(time, at, "right") - 1, 0, len(time) - 2)
    part = ((at - time[i]) / (time[i + 1] - time[i])).reshape(-1, *[1] * (x.ndim - 1))
    return x[i] + part * (x[i + 1] - x[i])


def stop(x: np.ndarray, limit: float | np.ndarray) -> np.ndarray:
    """(n, ...) stop operator: follows x from nothing, by no more than the limit either way."""
    out = np.zeros_like(x)
    for i in range(1, len(x)):
        out[i] = np.clip(out[i - 1] + x[i] - x[i - 1], -limit, limit)
    return out


@functools.lru_cache(maxsize=8)  # force, pressure and electrodes of a run forget alike
def _decay_matrix(time, tau):
    """(n, n - 1) fractions of the changes between times that remain at each; times (n,) [s], as bytes."""
    t = np.frombuffer(time)
    wait = np.diff(t) / tau
    weight = np.where(
        wait > 1e-9, -np.expm1(-wait) / np.maximum(wait, 1e-9), 1.0
    )  # exact for x linear in between
    since = np.maximum(t[:, None] - t[1:], 0) / tau
    return np.where(t[:, None] >= t[1:], np.exp(-since), 0.0) * weight
