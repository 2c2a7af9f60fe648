"""The two interfaces of the coupling: `SkinStepper`, a skin that takes poses and gives wrenches, and
`Readings`, which take the deformed skin and give counts."""

import dataclasses
import importlib
from collections.abc import Callable
from typing import Protocol

import numpy as np

from ..geometry.skin_geometry import SkinGeometry
from .config import Config


@dataclasses.dataclass(frozen=True, eq=False)
class Geom:
    """A shape that can touch the skin.

    Attributes:
      name: its name in the model ("" where it has none).
      type: "plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", or "skin" of another BioTac.
      size: (3,) MuJoCo's sizes [m].
      friction: sliding friction coefficient between it and the skin, combined by MuJoCo's rule.
      group: index of the touching body it belongs to, 0..ngroup-1.
      rounding: radius of its rounded edges [m].
      vert, face: (n, 3) [m], (m, 3) of a mesh or a skin in the geom's frame; None for the others.
      rigid: such a mesh of the core, nail and clamp under a skin; None for the others.
    """

    name: str
    type: str
    size: np.ndarray
    friction: float
    group: int
    rounding: float = 0.0
    vert: np.ndarray | None = None
    face: np.ndarray | None = None
    rigid: tuple[np.ndarray, np.ndarray] | None = None


@dataclasses.dataclass
class SkinResult:
    """A skin solved for the poses at the end of a step, in the BioTac frame.

    Attributes:
      state: (nstate,) the new state, committed by the caller; None: the skin rests as before (see
        `SkinStepper.stay_at_rest`).
      wrench: (ngroup, 6) of the skin ON each touching body, force then torque about the BioTac frame's origin
        [N, N m].
      tangent: (ngroup, 6, 6) -d wrench / d (translation, rotation vector about the origin), symmetric
        positive semi-definite.
      vert_xpos: (nvert, 3) deformed nodes [m]. pressure: of the liquid [Pa]. None: not known.
      converged, iterations, residual: how the solve went.
      load_factor: fraction of the touching bodies' motion in this step at which all this holds: 1 where it
        converged, or was cut off at an iterate that goes all the way; of their way into the skin, where they
        are deeper in the core than one fits.
      pose: (ngroup, 3), (ngroup, 3, 3) of the bodies at which it holds; the caller's.
      load: (k,) size of the force on each contact that the state holds [N], where somebody may want it.
      cost: of the solve, as a fraction of what a hard one may cost.
      slack: (ngroup,) of the bodies' models, see `implicit.rounds` [m].
      measured: False where an approximate tier leaves the range in which its error was measured.
    """

    state: np.ndarray | None
    wrench: np.ndarray
    tangent: np.ndarray
    vert_xpos: np.ndarray | None
    pressure: float | None = 0.0
    converged: bool = True
    iterations: int = 0
    residual: float = 0.0
    measured: bool = True
    load_factor: float = 1.0
    pose: tuple | None = None
    load: np.ndarray | None = None
    cost: float = 0.0
    slack: np.ndarray | float = 0.0

    @property
    def model(self) -> tuple:
        """Linear models of the touching bodies, as `setup.LINEAR` names their parts."""
        return self.wrench, self.tangent, *self.pose, self.slack


class SkinStepper:
    """Base class of skins. A skin has `nstate`, `reset`, `solve_skin` and `vert_xpos`; the other methods are
    optional, and their docstrings say what their defaults mean.

    Making one must be cheap: MuJoCo reads `nstate` while it compiles, when contact exclusions are not yet
    known, perhaps with more geoms than there will be (so more geoms may not need less state). Heavy work
    belongs into the first `reset` or `solve_skin`.

    Attributes:
      nstate: size of its state.
      inertial: whether `solve_skin` needs the motion of the core.
      gives_way: whether `solve_skin` takes `bodies`; the state then holds for the poses to which its own
        wrenches bring them.
      surface_energy: the most that adhesion gives to bodies that come near [J].
      vibrates: whether it has the attributes that `sensing.vibration.Shaking` reads, for sensors that feel
        vibration.
    """

    nstate: int
    inertial = gives_way = vibrates = False
    surface_energy = 0.0

    def reset(self, state: np.ndarray) -> None:
        """Writes the rest state into state (nstate,)."""
        raise NotImplementedError

    def solve_skin(
        self, state: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray, dt: float, **more: object
    ) -> SkinResult:
        """Solves for the geoms' poses (ngeom, 3), (ngeom, 3, 3) at the end of the step; a function of its
        arguments alone, which keeps `state` as it is.

        Args:
          more: further facts about the step; a skin may ignore them. near: a converged result of the same
            step for poses not far from these, or None; Newton's method may begin from it. spent: fraction of
            a step's largest cost that earlier solves of it took; the skin spends at most the rest. core_pos
            (2, 3), core_mat (2, 3, 3), if `inertial`: the BioTac frame in the world at the start and at the
            end of the step. bodies (`skin.bodies.BodyMotion`), if it `gives_way`: motion of the touching
            bodies, or None.
        """
        raise NotImplementedError

    def vert_xpos(self, state: np.ndarray) -> np.ndarray:
        """(nvert, 3) nodes [m] of a state, for showing."""
        raise NotImplementedError

    def key(self, state: np.ndarray) -> bytes:
        """All of a state that a solve depends on."""
        return state.tobytes()

    def came_to(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Poses (ngeom, 3) [m], (ngeom, 3, 3) of the geoms for which a state holds; needed where results may
        not reach the target poses. None: they do."""
        return None

    def put(
        self, state: np.ndarray, placed: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray
    ) -> np.ndarray | None:
        """The state after the user placed some geoms, (ngeom,) of bool, at poses (ngeom, 3), (ngeom, 3, 3):
        they have no contact, and their path begins there, or where they just leave the skin at rest if they
        are inside it. A skin that nothing else touches is at rest, unless it has inertia or memory. None: the
        state as it is; bodies that were placed have slid there."""
        return None

    def resting(self, state: np.ndarray) -> bool:
        """Whether the skin is at rest in this state, so that a step changes it only if a geom touches."""
        return False

    def is_clear(self, geom_pos: np.ndarray, geom_mat: np.ndarray) -> bool | None:
        """Whether geoms at (ngeom, 3), (ngeom, 3, 3) leave the skin at rest alone; None where it is not
        known."""
        return None

    def is_out_of_reach(self, state: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray) -> bool:
        """Whether the skin rests and the geoms at (ngeom, 3), (ngeom, 3, 3) are further from it than they
        come in a step: it then costs next to nothing."""
        return False

    def stay_at_rest(self, state: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray) -> None:
        """Makes `state`, of a skin that is out of reach, what `solve_skin` would return."""
        raise NotImplementedError

    def pressure(self, state: np.ndarray) -> float | None:
        """Pressure of the liquid in a state [Pa]: a skin that says it is not solved again while bodies stay.
        None: the skin changes while nothing moves."""
        return None

    def contact_rows(self, state: np.ndarray) -> np.ndarray:
        """Contacts (k, 5) in a state, with forces `SkinResult.load`: sample of the outer surface, geom, and
        anchor in its frame [m]."""
        return np.zeros((0, 5))

    def contact_area(self, result: SkinResult) -> np.ndarray:
        """(ngroup,) area of the skin on which each body presses at the end of a solve [m^2], see
        `geometry.surface.pressure_area`; used by sensors with heat."""
        raise NotImplementedError

    def touched_faces(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Numbers (k,) of the geometry's outer faces that something touches in a state, the geom on each, and
        its normal push [N]. None: contacts are shown on the axis of the wrench."""
        return None

    def contact_force(self, state: np.ndarray) -> np.ndarray | None:
        """Contact forces (nvert, 3) on the nodes in a state [N], for `Handle.contact_pressure`."""
        return None

    def contact_push(self, state: np.ndarray) -> np.ndarray | None:
        """Normal contact forces (nface,) on the geometry's outer faces in a state [N], for the same."""
        return None


class Readings(Protocol):
    """Counts of the sensor's channels."""

    nstate: int
    rest: dict  # channel -> counts at rest; {} where unknown

    def reset(self, state: np.ndarray) -> None:
        """Writes the state at time zero into state (nstate,)."""

    def advance(
        self,
        state: np.ndarray,
        time: float,
        dt: float,
        vert_xpos: np.ndarray | None,
        pressure: float | None,
    ) -> dict:
        """Advances state in place over [time, time + dt] and returns channel -> counts. What is None is not
        known: its channels hold."""

    # Readings may have the methods below. With the first `advance` also gets area [m^2] and force [N],
    # (ngroup,) each, of what touches at the end of the step; with the others what `shaking` returns.

    def feel_heat(self, geoms: list[Geom]) -> None:
        """Heat flows between the sensor and these geoms; called first, it may change nstate."""

    def feel_vibration(self, geoms: list[Geom], stepper: SkinStepper) -> None:
        """The sensor feels how these geoms shake the stepper's skin; called first, it may change nstate."""

    def shaking(self, before: np.ndarray, result: SkinResult, dt: float) -> object:
        """Excitation of the skin's modes, from state `before`, by the step of dt [s]."""


class _NoReadings:
    """Leaves the channels at zero."""

    nstate = 0
    rest = {}

    def __init__(self, config, geometry):
        pass

    def reset(self, state):
        pass

    def advance(self, state, time, dt, vert_xpos, pressure):
        return {}


# A name, or where to find the factory the first time the name is used.
_steppers = {"fem": "biotac_mj.coupling.steppers.fem:FemStepper"}
_tiers = {"condensed": "biotac_mj.coupling.steppers.condensed:CondensedStepper"}  # instead of "fem"
_readings = {
    "biotac": "biotac_mj.coupling.sensing.counts:SensorReadings",
    "learned": "biotac_mj.coupling.sensing.counts:LearnedReadings",
    "none": _NoReadings,
}


def register_stepper(name: str, factory: Callable) -> None:
    """Makes factory(config, geometry, geoms) -> SkinStepper, or the class itself, known under a name
    that `attach(stepper=...)` takes."""
    _steppers[name] = factory


def register_readings(name: str, factory: Callable) -> None:
    """Makes factory(config, geometry) -> Readings known under a name that `attach(readings=...)` takes."""
    _readings[name] = factory


def _named(config):
    """The readings, or the network that they come from, as whoever made the settings named them."""
    if config.readings != "learned":
        return f"readings {config.readings!r}"
    return f"signal {config.options.get('readings', {}).get('weights') or 'learned'!r}"


def _factory(table, name):
    if isinstance(table[name], str):
        module, attribute = table[name].split(":")
        return getattr(importlib.import_module(module), attribute)
    return table[name]


def check_names(config: Config) -> None:
    """Raises ValueError if the settings name a stepper or readings that nobody registered."""
    for table, name, what in (
        (_steppers, config.stepper, "stepper"),
        (_readings, config.readings, "readings"),
    ):
        if name not in table:
            raise ValueError(
                f"unknown {what} {name!r}: "
                f"choose one of {', '.join(sorted(table))}, or register one in biotac_mj.coupling.stepper"
            )


def make_stepper(config: Config, geometry: SkinGeometry, geoms: list[Geom]) -> SkinStepper:
    """The skin that `config.stepper` names, of the tier that `config.tier` names.

    Raises:
      ValueError: the name is unknown, or its factory makes something else.
    """
    check_names(config)
    if config.tier in _tiers:
        return _factory(_tiers, config.tier)(config, geometry, geoms)
    made = _factory(_steppers, config.stepper)(config, geometry, geoms)
    if not isinstance(made, SkinStepper):
        raise ValueError(
            f"stepper {config.stepper!r} makes {type(made).__name__}: derive it from "
            "biotac_mj.coupling.SkinStepper"
        )
    return made


def make_readings(
    config: Config, geometry: SkinGeometry, geoms: list[Geom], stepper: SkinStepper | None
) -> Readings:
    """The readings that `config.readings` names, of the stepper's skin; without one they only serve to
    check the settings.

    Raises:
      ValueError: the name is unknown, or `config` has heat or vibration, which the readings or the stepper do
        not support.
    """
    check_names(config)
    try:
        readings = _factory(_readings, config.readings)(config, geometry)
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "safetensors"):
            raise
        raise ModuleNotFoundError(
            f"{_named(config)} needs {error.name}: pip install 'biotac-mj[learning]'", name=error.name
        ) from None
    if config.thermal is not None:
        if not hasattr(readings, "feel_heat"):
            raise ValueError(f"{_named(config)} knows no heat: leave thermal out")
        readings.feel_heat(geoms)
    if config.textures is not None:
        if not (hasattr(readings, "feel_vibration") and (stepper is None or stepper.vibrates)):
            raise ValueError(
                f"{_named(config)} on stepper {config.stepper!r} knows no vibration: leave textures out"
            )
        readings.feel_vibration(geoms, stepper)
    return readings
