"""Base class of effects: id, stage, and parameters with units, bounds and source.

`docs/howto/effects.md` and `docs/howto/extend.md` have examples of custom effects.
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

# In the order in which they act. B and S change the object's position or size, so the skin is solved again.
STAGES = {
    "S": "set-up",
    "B": "boundary",
    "K": "contact",
    "C": "constitutive",
    "T": "transduction",
    "A": "acquisition",
}


@dataclasses.dataclass(frozen=True)
class Param:
    """A parameter of an effect, with its bounds, its prior and their sources.

    Attributes:
      unit; low, high: bounds; source: of the bounds.
      scale: a realistic size, for signatures and the prior.
      start: value without the effect.
      shape: whether it has no effect by itself (a time constant, a knee); several values are tried.
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
    """One trajectory of n rows that passes through the stages; effects change it in place.

    Attributes:
      time (n,) within the trajectory, clock (n,) of the session [s]; tool; heading (3,); depth (n,) [m];
      order:
        number in the session.
      offset (n, 3): of the object from its commanded position [m]; log_radius, log_friction: of the tool and
        the contact.
      bubble: volume of trapped air [m3].
      force (n, 3) [N], pressure (n,) [Pa], log_z (n, nelectrode): ln of the impedances [ohm]; without effects
      until
        the skin is solved. counts (n, nelectrode), pdc (n,): after the converter, before rounding.
      temperature: (n,) above the first row of the session [C], or None.
      stiffness: (n,) d normal force / d depth [N/m], None if unknown.
      answers: change of the rubber -> (n, 4 + nelectrode) of force and pressure, per unit of the modulus, and
        log_z by one of it, for solved changes; modulus: factor on the material's since.
      turn: (3,) or (n, 3) rotation vector from the frame of poses and force to the sensor [rad].
      pos: (n, 3) of the object [m], None if only its contact position is known.
      session: dict shared by the effects of one simulation, from trajectory to trajectory.
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
    def of_counts(cls, counts: np.ndarray, rest_log_z: np.ndarray, **more: np.ndarray) -> "Run":
        """A Run of counts (n, nelectrode) without contact, its clock its time.

        Args:
          rest_log_z: (nelectrode,) ln of the impedances at rest [ohm]. more: other fields, such as time (n,)
            [s], 0 by default, or force (n, 3) [N]."""
        n = len(counts)
        time = more.get("time", np.zeros(n))
        plain = {
            "time": time,
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
        return cls(counts=counts, rest_log_z=rest_log_z, **plain | more)

    @property
    def rest(self) -> np.ndarray:
        """(nelectrode,) counts at rest."""
        return 4095 / (np.exp(self.rest_log_z) / 1e4 + 1)

    @property
    def normal_force(self) -> np.ndarray:
        """(n,) against the heading, positive while pressed [N]."""
        return np.maximum(-self.force @ self.heading, 0)

    def give(self, compliance: float | np.ndarray) -> np.ndarray:
        """(n,) displacement x = compliance F(depth - x) of a compliance in series [m]; compliance (n,) or one
        for all rows."""
        stiffness = 0.0 if self.stiffness is None else self.stiffness
        return compliance * self.normal_force / (1 + np.maximum(compliance, 0) * stiffness)

    def add(self, change: np.ndarray) -> None:
        """Adds a change (n, 4 + nelectrode) of force and pressure, per unit of the modulus, and of log_z."""
        self.force = self.force + self.modulus * change[:, :3]
        self.pressure = self.pressure + self.modulus * change[:, 3]
        self.log_z = self.log_z + change[:, 4:]

    def scale_load(self, factor: float | np.ndarray) -> None:
        """Multiplies the load on the rubber by a factor (n,): force and the liquid's pressure."""
        factor = np.broadcast_to(factor, self.time.shape)
        self.force = self.force * factor[:, None]
        self.pressure = self.pressure * factor


@dataclasses.dataclass
class Whole:
    """Changes of a sensor as a whole: factors on friction and on the rubber's modulus, air in the liquid
    [m3], and lost fraction of the liquid."""

    friction: float = 1.0
    modulus: float = 1.0
    air: float = 0.0
    lost: float = 0.0


class Entry:
    """What the catalogue says of an effect. Subclasses override these attributes.

    Attributes:
      id, name: of the effect. stage: key of STAGES. physics: description.
      fits: data in which the effect is searched, a set of "poses" (trajectories with the object's poses)
        and "log" (recordings without). An id may have a form for each.
      params: {name: Param}.
      confusable: {id: experiment that separates the two}. equivalents: ids of other laws with the same
        appearance, separated only by much evidence. refit_with: ids of effects that are fitted with it.
      drifts: whether it is a level that changes with the session's clock. in_noise: whether measured noise
        includes it. is_noise: whether it is noise, which a sensor's measured noise has. silent: whether an
        electrode has one value under any contact.
      runs: whether constants of a running sensor model it, without another skin. alike: whether a running
        sensor has it equally on all electrodes. most: {parameter: largest value that a running sensor can
        have}.
      requires: data that a recording needs to show it without poses: "force"; "tdc"; "rest" and "sign" of
        the counts; "time" to separate touches from drift; "load"; "change", that it begins or ends in the
        recording; "protocol" of a checkup; "poses", where nothing else suffices.
      detector: class of evidence in logs, which sets a name's confidence (`quality.confidence`).
    """

    id = name = stage = physics = ""
    fits: frozenset = frozenset({"poses"})
    params: dict = {}
    confusable: dict = {}
    equivalents: tuple = ()
    refit_with: tuple = ()
    drifts = in_noise = is_noise = silent = alike = runs = False
    most: dict = {}
    requires: frozenset = frozenset({"poses"})
    detector = ""

    def possible(self, values: dict) -> bool:
        """Whether found parameters, name -> (value, low, high), lie within their bounds."""
        return all(self.params[n].low <= v[0] <= self.params[n].high for n, v in values.items())


class Effect(Entry, abc.ABC):
    """An entry that acts on a run. Subclasses override attributes and implement `apply`.

    Attributes:
      each: the parameter that every electrode has, in `params` by its name. design: of the electrodes.
      grid: values of the shape parameters that are tried.
      rare: further parameters, added only if the data require them (`given`).
      per_channel: whether each free parameter belongs to one electrode, or one pair.
      wiring: whether it assigns electrodes to channels, and has no other form.
      of_rest: whether it changes only the baselines of electrodes, about which trajectories are compared.
      pose_offset: whether it moves all poses of the object equally, like their scatter between trials.
      answers: names of the sensitivities of the skin (`discrepancy.trajectories.model.fields`) that it uses.
      instead_of: nuisance parameters of the base model that it replaces.
      sound: root mean square of its parameters that a healthy sensor may have.
    """

    each: Param | None = None
    design: Design = BIOTAC
    grid: tuple = ({},)
    rare: dict = {}
    per_channel = False
    wiring = False
    of_rest = False
    pose_offset = False
    answers: tuple = ()
    instead_of: tuple = ()
    sound = 0.0

    @abc.abstractmethod
    def apply(self, run: Run, theta: dict) -> None:
        """Changes `run` at the effect's stage. theta has a value for every parameter; without effect all are
        at `Param.start`."""

    def in_skin(self, inside: "Inside", theta: dict) -> bool:
        """Writes its changes of a skin that models it (`in_skin.Inside`); False if no skin can."""
        return False

    def in_whole(self, whole: "Whole", theta: dict) -> dict | None:
        """Writes its changes of a sensor as a whole; returns the theta with which it acts besides, None if
        there are no changes."""
        return theta

    def of_setup(self, theta: dict) -> bool:
        """Whether it belongs to the place of the data, not to the sensor."""
        return self.stage in ("S", "B")

    def in_sensor(self, sensor: "Sensor", theta: dict) -> dict | None:
        """Constants of a running sensor (`sensor.presets.Sensor`) that has it; None if none can."""
        return None

    @property
    def runs(self) -> bool:
        return self.stage in ("T", "A") and type(self).in_sensor is not Effect.in_sensor

    def applicable(self, trajectories: list) -> str | None:
        """Reason why the data cannot show the effect, or None."""
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
        """The effect with parameters of these names, if the data determine them."""
        more = {name: p for name, p in self.rare.items() if name in names}
        if not more:
            return self
        other = copy.copy(self)
        other.params = {**self.params, **more}
        return other

    def only(self, names: Sequence[str]) -> "Effect":
        """The effect with only these of its free parameters."""
        other = copy.copy(self)
        other.params = {n: p for n, p in self.params.items() if p.shape or n in names}
        return other

    def solved(self, names: Sequence[str]) -> "Effect":
        """The effect for fields that have these sensitivities of the skin: an effect may have a parameter for
        each."""
        return self

    def joining(self, theta: dict) -> float | None:
        """Work of adhesion of the contact [J/m2] at which the skin must be solved, or None."""
        return None

    def undoes(self, theta: dict, log_modulus: float) -> bool:
        """Whether the effect cancels a factor exp(log_modulus) of the base model's modulus."""
        return False

    def rejection_reason(self, theta: dict) -> str | None:
        """Reason why fitted parameters are implausible for this effect, or None."""
        return None

    def alias(self, theta: dict) -> tuple:
        """Ids of other effects that are as likely with such parameters, whichever fits better."""
        return ()

    def draw(self, rng: np.random.Generator, size: float = 1.0) -> dict:
        """A sensor's theta: normal about no effect with standard deviation `size` times `scale`, within the
        bounds, or on the only possible side. Shape parameters are drawn from the grid."""
        theta = self.default() | dict(self.grid[rng.integers(len(self.grid))])
        for name in self.free:
            p = self.params[name]
            step = rng.normal(0.0, size * p.scale)
            theta[name] = float(np.clip(abs(step) if p.low == p.start else p.start + step, p.low, p.high))
        return theta

    @property
    def before_skin(self) -> bool:
        """Whether it changes the input of the skin's solve."""
        return self.stage in ("S", "B")

    @property
    def free(self) -> list[str]:
        """Names of the fitted parameters; shape parameters come from `grid` and are refined afterwards."""
        return [n for n, p in self.params.items() if not p.shape]

    def default(self) -> dict:
        """Parameters without effect; shape parameters from the first entry of the grid."""
        return {**{n: p.start for n, p in self.params.items()}, **self.grid[0]}


def memory(run: Run, x: np.ndarray, tau: float, of: str | None = None) -> np.ndarray:
    """(n, ...) x minus its exponential memory: the change within about tau.

    Args:
      of: key in the session for the memory at the end of a trajectory; the next one starts with it, decayed
        by the session's clock. None starts with nothing."""
    decay = _decay_matrix(np.ascontiguousarray(run.time, float).tobytes(), float(tau))
    out = (decay @ np.diff(x, axis=0).reshape(decay.shape[1], -1)).reshape(x.shape)
    if of is None:
        return out
    before = run.session.get((of, tau))
    if before is not None and run.clock[0] >= before[0]:
        since, kept, last = run.clock - before[0], before[1], before[2]
        # the time of the change in between is unknown
        weight = np.exp(-since / tau)[:, None], np.exp(-(since - 0.5 * since[0]) / tau)[:, None]
        more = weight[0] * np.ravel(kept) + weight[1] * np.ravel(x[0] - last)
        out = out + more.reshape(x.shape)
    run.session[of, tau] = float(run.clock[-1]), out[-1], x[-1]
    return out


def shifted(x: np.ndarray, time: np.ndarray, delay: float) -> np.ndarray:
    """(n, ...) x at times (n,) [s], delayed by `delay` [s] (advanced if negative); linear between rows,
    constant beyond the ends."""
    at = np.clip(time - delay, time[0], time[-1])
    i = np.clip(np.searchsorted(time, at, "right") - 1, 0, len(time) - 2)
    part = ((at - time[i]) / (time[i + 1] - time[i])).reshape(-1, *[1] * (x.ndim - 1))
    return x[i] + part * (x[i + 1] - x[i])


def stop(x: np.ndarray, limit: float | np.ndarray) -> np.ndarray:
    """(n, ...) stop operator: follows x from zero, at most to the limit in either direction."""
    out = np.zeros_like(x)
    for i in range(1, len(x)):
        out[i] = np.minimum(np.maximum(out[i - 1] + x[i] - x[i - 1], -limit), limit)
    return out


@functools.lru_cache(maxsize=512)  # runs of the same trajectories share it
def _decay_matrix(time, tau):
    """(n, n - 1) fraction of the change between times j and j + 1 that remains at time i; time: (n,) [s], as
    bytes, so that it can be a cache key."""
    t = np.frombuffer(time)
    wait = np.diff(t) / tau
    weight = np.where(
        wait > 1e-9, -np.expm1(-wait) / np.maximum(wait, 1e-9), 1.0
    )  # exact for x linear in between
    since = np.maximum(t[:, None] - t[1:], 0) / tau
    return np.where(t[:, None] >= t[1:], np.exp(-since), 0.0) * weight
