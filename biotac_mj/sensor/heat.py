"""Heat of a BioTac: one thermal state per sensor, stepped implicitly with the skin, many sensors at once.

    heater -> core -> liquid -> skin -> air              skin without contact
               |
           thermistor -> film -> skin -> contact -> body   one column of skin for each touching body

Heat flows through thin layers, so each path is one-dimensional: lumped capacities for the core, the core's
part under the contact with the thermistor, and the liquid; `NCELL` finite volumes through the skin; and the
touched body as a half-space with effusivity e = sqrt(k rho c) and temperature. The heat flux into a
half-space is e sqrt(s) times its surface temperature, which depends on all the past. It is approximated by a
sum of `NBRANCH` relaxing stores (`half_space`), so the state is short and a step is implicit (backward Euler:
stable for every step, first order).

When a contact grows, skin moves from the free column to the body's column with its heat, and the body's new
area has the body's own temperature. When it shrinks, the separated skin and body stay in their columns,
insulated, and are the first to touch again: a contact of fluctuating area meets the skin and body that it
left, not fresh ones at every step. Separated skin returns to the free column within the time in which the
liquid warms it. Heat in a separated body spreads sideways within the body's own time constant and is dropped.

`Heat` steps one sensor or the sensors of all worlds with the same kernel."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from biotac_mj.sensor.materials import Material

from ..kernels import kernel_module

kernel_module(__name__)

NCELL = 8  # finite volumes through the skin
NBRANCH = 10  # stores of a half-space
# The state: temperatures [C] of the thermistor (and the core around it), the core, the liquid; heat lost to
# the air and the mount and heat given to bodies since the reset [J]; the heater's power [W]; the liquid's
# temperature at which the electrodes show their rest counts, and its difference from it [C]; cells of the
# free skin, inside first; then per body the area [m^2] of skin in contact or recently separated, its cells,
# the body's surface, its stores, the body's effusivity [W s^0.5 / (m^2 K)], temperature [C] and conductivity
# [W/(m K)], so that a reset may change them; and the area [m^2] of the body in contact or recently so.
THERMISTOR, CORE, LIQUID, LOST, GIVEN, POWER, REFERENCE, ABOVE, FREE = range(9)
BODIES = FREE + NCELL
_SURFACE, _STORE = 1 + NCELL, 2 + NCELL
MADE = _STORE + NBRANCH
_EFFUSIVITY, _BODY_TEMPERATURE, _BODY_CONDUCTIVITY = MADE, MADE + 1, MADE + 2
_TAKEN = MADE + 3
BODY = MADE + 4

_LN_RATIO = 2.0  # ln of the ratio of neighbouring rates: error 1.4 % of the impedance at the worst frequency
_SLOWEST = 1e-5  # [1/s]

real = wp.float64
_CELL = 1.0 / NCELL
_LEAST = 1e-12  # [m^2] area that is divided by
_FOUR_PI = 4 * math.pi


def state_size(ngroup: int) -> int:
    """Length of the state of a sensor in contact with at most `ngroup` bodies."""
    return BODIES + BODY * ngroup


@dataclasses.dataclass(frozen=True)
class HeatParameters:
    """Constants of one sensor. Sources and intervals: docs/lab/sensor.md.

    Attributes:
      power: of the heater, which is the sensor's own electronics [W].
      ambient: temperature of the air and of the mount [C].
      core: heat capacity of the whole core [J/K]; near: of its part about the thermistor and under the
        contact; liquid: of the liquid.
      mount: core to mount [W/K]; inside: core to liquid [W/K]; spread: core to the part near the thermistor
        [W/K].
      area: of the skin [m^2]; thickness: of the skin [m].
      conductivity: of the rubber [W/(m K)]; capacity: its density times specific heat [J/(m^3 K)].
      gap: liquid to skin at rest [W/(m^2 K)]; film: core to skin where the skin is pressed on it.
      air: skin to air [W/(m^2 K)].
      contact: skin to body at 10 kPa, over the mean conductivity of the two [1/m].
    """

    power: float = 0.81
    ambient: float = 23.0
    core: float = 2.8
    liquid: float = 1.5
    near: float = 1.19
    mount: float = 0.0186
    inside: float = 0.0458
    spread: float = 0.643
    area: float = 1.24e-3
    thickness: float = 4.0e-4
    conductivity: float = 0.193
    capacity: float = 1.6e6
    gap: float = 600.0
    film: float = 266.0
    air: float = 16.0
    contact: float = 1.17e4

    def __post_init__(self):
        bad = [f.name for f in dataclasses.fields(self) if not math.isfinite(getattr(self, f.name))]
        not_positive = [f.name for f in dataclasses.fields(self)[2:] if getattr(self, f.name) <= 0]
        wrong = bad + not_positive
        if wrong or self.near >= self.core:
            what = f"{', '.join(wrong)} cannot be" if wrong else "near is more than the core has"
            raise ValueError(f"heat parameters: {what}; capacities, conductances and lengths are positive")

    def loss(self) -> float:
        """Heat loss without contact, per degree of the core above ambient [W/K]."""
        skin = self.area / (1 / self.gap + self.thickness / self.conductivity + 1 / self.air)
        return self.mount + 1 / (1 / self.inside + 1 / skin)

    def at_rest(self, temperature: float) -> "HeatParameters":
        """The same sensor with the power that keeps its core at a temperature [C] without contact."""
        return dataclasses.replace(self, power=self.loss() * (temperature - self.ambient))

    def rest(self, bodies: Sequence[Material] = ()) -> np.ndarray:
        """The steady state (nstate,) without contact of a sensor that these bodies can touch."""
        layers = self.thickness / self.conductivity
        skin = self.area / (1 / self.gap + layers + 1 / self.air)
        above = self.power / self.loss()
        flux = above / (1 / self.inside + 1 / skin) / self.area
        state = np.zeros(state_size(len(bodies)))
        for g, b in enumerate(bodies):
            begin = BODIES + BODY * g + MADE
            state[begin : begin + 3] = b.effusivity, b.temperature, b.conductivity
        state[[THERMISTOR, CORE]] = self.ambient + above
        state[LIQUID] = self.ambient + flux * (1 / self.gap + layers + 1 / self.air)
        depth = layers * (np.arange(NCELL) + 0.5) / NCELL
        state[FREE:BODIES] = state[LIQUID] - flux * (1 / self.gap + depth)
        state[POWER], state[REFERENCE] = self.power, state[LIQUID]
        return state


def begin_heat(
    temperature: float, warm_up: float = 0.0, cold: bool = False, bodies: Sequence[Material] = ()
) -> np.ndarray:
    """Initial state (nstate,) of a sensor whose core has a temperature [C] at the reset and warms up by
    `warm_up` [C]. cold: it is switched on at the reset and approaches that temperature. The heater's power is
    in the state, so sensors of one `Heat` may differ in it."""
    sensor = HeatParameters().at_rest(temperature)
    begin, reference = sensor.rest(bodies), sensor.rest()[LIQUID]
    if cold:
        begin = sensor.at_rest(sensor.ambient).rest(bodies)
        begin[POWER] = sensor.power
    else:
        begin[POWER] = sensor.at_rest(temperature + warm_up).power
    begin[REFERENCE], begin[ABOVE] = reference, begin[LIQUID] - reference
    return begin


_FIELDS = [field.name for field in dataclasses.fields(HeatParameters)]
Parameters = wp.types.vector(len(_FIELDS), real)
(
    _, _AMBIENT, _C_CORE, _C_LIQUID, _C_THERMISTOR, _MOUNT, _INSIDE, _SPREAD, _AREA, _THICKNESS,
    _CONDUCTIVITY, _CAPACITY, _GAP, _FILM, _AIR, _CONTACT,
) = range(len(_FIELDS))  # fmt: skip


def half_space() -> tuple[np.ndarray, np.ndarray, float, float]:
    """Stores that approximate a half-space of unit effusivity.

    1 / sqrt(s) = 1 / pi int dp / (sqrt(p) (s + p)). The trapezoidal rule in ln p with step h turns
    s / sqrt(s) = sqrt(s) into the sum of c s / (s + p), c = h sqrt(p) / pi: stores of capacity c / p behind a
    resistance 1 / c. The poles of the integrand bound the rule's error by 2 exp(-pi^2 / h) on the imaginary
    axis. The truncated terms are geometric series: the faster ones act as a capacity at the surface, the
    slower ones as a conductance to the undisturbed body.

    Returns:
      rate p (NBRANCH,) [1/s]; conductance c (NBRANCH,) [s^-1/2]; surface's capacity [s^1/2]; conductance to
      the undisturbed body [s^-1/2].
    """
    h = _LN_RATIO
    rate = _SLOWEST * np.exp(h * np.arange(NBRANCH))
    conductance = h / np.pi * np.sqrt(rate)
    tail = 1 / np.expm1(h / 2)  # sum of exp(-h j / 2), j = 1, 2, ...
    return rate, conductance, float(h / np.pi / np.sqrt(rate[-1]) * tail), float(conductance[0] * tail)


_RATE, _BRANCH, _FAST, _SLOW = half_space()
_rates, _branches = (wp.constant(wp.types.vector(NBRANCH, real)(*row)) for row in (_RATE, _BRANCH))


# The text of the kernel and its functions also runs on tensors, for gradients
# (`differentiable.temperatures`): it does not assign in place.


@wp.func
def _between_cells(layer: real, other: real):
    """Conductance from the middle of an outermost cell, whose neighbours are `layer` away, through a
    conductance `other` in series."""
    return real(1.0) / (real(0.5) / layer + real(1.0) / other)


@wp.func
def _touch(q: Parameters, area: real, force: real, body: real):
    """Conductance from the middle of the skin's outermost cell to a body of that conductivity [W/(m^2 K)].

    The contact's is h = a k (p / 10 kPa)^0.95 with the harmonic mean k of both conductivities: conforming
    rough surfaces (Yovanovich, 1981; Cooper, Mikic and Yovanovich, 1969, with the exponent 0.985). The slope
    of the asperities over their height and the hardness are one fitted coefficient a [1/m]."""
    pressure = wp.max(force / wp.max(area, real(_LEAST)), real(1.0))
    mean = real(2.0) * q[_CONDUCTIVITY] * body / (q[_CONDUCTIVITY] + body)
    h = q[_CONTACT] * mean * wp.pow(pressure / real(1.0e4), real(0.95))
    return _between_cells(q[_CONDUCTIVITY] / (q[_THICKNESS] * real(_CELL)), h)


@wp.func
def _fit(q: Parameters, area: wp.array2d(dtype=real), w: int):
    """Fraction of the bodies' contact area that fits on the skin: the nail's side stays free."""
    wanted = real(0.0)
    for g in range(area.shape[1]):
        wanted = wanted + wp.max(area[w, g], real(0.0))
    return wp.min(real(0.5) * q[_AREA] / wp.max(wanted, real(_LEAST)), real(1.0))


@wp.func
def _mixed(old: real, area: real, new: real, added: real):
    """Temperature of an area after another one is added."""
    return (old * area + new * added) / (area + added)


@wp.func
def _spread_sideways(taken: real, touched: real, effusivity: real, conductivity: real, dt: real):
    """Area of a body that is or was recently touched: a spot of radius r spreads over a disc twice as large
    in r^2 / 4 D, D = (k / e)^2."""
    ratio = effusivity / conductivity
    time = taken * ratio * ratio / real(_FOUR_PI)
    return touched + (taken - touched) * time / (time + dt)


@wp.func
def _eliminate(store: real, cell: real, known: real, pull: real, inner: real):
    """Eliminates a cell into the one inside it, at a conductance `inner`. `store` is the cell's heat capacity
    over the time step, `known` and `pull` the constant term and coefficient from outside. Returns the cell's
    constant term, its factor on the inner cell, and the inner cell's `known` and `pull`."""
    total = store + pull + inner
    fraction = inner / total
    mean = (store * cell + known) / total
    return mean, fraction, inner * mean, inner - inner * fraction


@wp.func
def _exchange_areas(
    q: Parameters, dt: real, fit: real, area: wp.array2d(dtype=real), state: wp.array2d(dtype=real), w: int
):
    """Moves skin and bodies, with their heat, between the columns as contacts grow and shrink. Returns the
    area of the free skin [m^2]."""
    ngroup = area.shape[1]
    one = real(1.0)

    # separated areas stay for a while, as far as the pad has room for them
    warming = q[_CAPACITY] * q[_THICKNESS]
    warming = warming * (one / q[_GAP] + real(0.5) * q[_THICKNESS] / q[_CONDUCTIVITY])
    late = warming / (warming + dt)
    parted = real(0.0)
    wanted = real(0.0)
    for g in range(ngroup):
        wanted = wanted + wp.max(area[w, g], real(0.0))
        parted = parted + late * wp.max(
            state[w, BODIES + BODY * g] - fit * wp.max(area[w, g], real(0.0)), real(0.0)
        )
    room = wp.max(real(0.5) * q[_AREA] - fit * wanted, real(0.0))
    late = late * wp.min(room / wp.max(parted, real(_LEAST)), one)

    # areas change columns: first what leaves, then what enters
    free = q[_AREA]
    for g in range(ngroup):
        free = free - state[w, BODIES + BODY * g]
    for g in range(ngroup):
        b = BODIES + BODY * g
        touched = fit * wp.max(area[w, g], real(0.0))
        released = (one - late) * (state[w, b] - touched)
        if released > real(0.0):
            for i in range(NCELL):
                state[w, FREE + i] = _mixed(state[w, FREE + i], free, state[w, b + 1 + i], released)
            free = free + released
            state[w, b] = state[w, b] - released
        taken = state[w, b + _TAKEN]
        if taken > touched:
            state[w, b + _TAKEN] = _spread_sideways(
                taken, touched, state[w, b + _EFFUSIVITY], state[w, b + _BODY_CONDUCTIVITY], dt
            )
    for g in range(ngroup):
        b = BODIES + BODY * g
        touched = fit * wp.max(area[w, g], real(0.0))
        had = state[w, b]
        added = touched - had
        if added > real(0.0):
            for i in range(NCELL):
                state[w, b + 1 + i] = _mixed(state[w, b + 1 + i], had, state[w, FREE + i], added)
            free = free - added
            state[w, b] = touched
        had = state[w, b + _TAKEN]
        added = touched - had
        if added > real(0.0):
            for i in range(_SURFACE, MADE):
                state[w, b + i] = _mixed(state[w, b + i], had, state[w, b + _BODY_TEMPERATURE], added)
            state[w, b + _TAKEN] = touched
    return free


@wp.func
def _eliminate_column(
    q: Parameters,
    dt: real,
    b: int,
    touched: real,
    force: real,
    state: wp.array2d(dtype=real),
    scratch: wp.array2d(dtype=real),
    w: int,
):
    """Eliminates the body and its column of skin, which begins at state b: `known` and `pull` of the core's
    part near the thermistor, per area. All of a column shares the flux through its touching area."""
    one = real(1.0)
    dx = q[_THICKNESS] * real(_CELL)
    layer = q[_CONDUCTIVITY] / dx
    store = q[_CAPACITY] * dx / dt
    press = _between_cells(layer, q[_FILM])
    effusivity = state[w, b + _EFFUSIVITY]
    coverage = wp.min(touched / state[w, b], one)
    touch = _touch(q, touched, force, state[w, b + _BODY_CONDUCTIVITY])
    onto = touch * touched / wp.max(state[w, b + _TAKEN], real(1.0e-30))
    known = effusivity * real(_SLOW) * state[w, b + _BODY_TEMPERATURE]
    pull = effusivity * real(_SLOW)
    for i in range(NBRANCH):
        c = effusivity * _branches[i] / (one + dt * _rates[i])
        known = known + c * state[w, b + _STORE + i]
        pull = pull + c
    at = b + _SURFACE
    hold = effusivity * real(_FAST) / dt
    cell, passed, known, pull = _eliminate(hold, state[w, at], known, pull, onto)
    state[w, at] = cell
    scratch[w, at] = passed
    known = coverage * touch * cell
    pull = coverage * touch * (one - passed)
    for k in range(NCELL):
        i = b + NCELL - k
        inner = wp.where(k == NCELL - 1, coverage * press, layer)
        cell, passed, known, pull = _eliminate(store, state[w, i], known, pull, inner)
        state[w, i] = cell
        scratch[w, i] = passed
    return known, pull


@wp.kernel
def step_heat(
    # In:
    dt: real,
    parameters: wp.array(dtype=Parameters),
    area: wp.array2d(dtype=real),
    force: wp.array2d(dtype=real),
    # Out:
    state: wp.array2d(dtype=real),
    scratch: wp.array2d(dtype=real),
):
    """Block elimination: every layer is eliminated into the one inside it, the core is solved, then the
    layers are back-substituted. `scratch` holds a layer's factor on its inner neighbour, `state` meanwhile
    the constant term."""
    w = wp.tid()
    q = parameters[w]
    ngroup = area.shape[1]
    dx = q[_THICKNESS] * real(_CELL)
    layer = q[_CONDUCTIVITY] / dx
    store = q[_CAPACITY] * dx / dt

    fit = _fit(q, area, w)
    free = _exchange_areas(q, dt, fit, area, state, w)

    # free skin, from the air inwards
    outside = _between_cells(layer, q[_AIR])
    inlet = _between_cells(layer, q[_GAP])
    known = outside * q[_AMBIENT]
    pull = outside
    for k in range(NCELL):
        i = FREE + NCELL - 1 - k
        inner = wp.where(k == NCELL - 1, inlet, layer)
        cell, passed, known, pull = _eliminate(store, state[w, i], known, pull, inner)
        state[w, i] = cell
        scratch[w, i] = passed
    liquid_known = free * known
    liquid_pull = free * pull

    thermistor_known = real(0.0)
    thermistor_pull = real(0.0)
    for g in range(ngroup):
        b = BODIES + BODY * g
        patch = state[w, b]
        if patch > real(0.0):
            touched = fit * wp.max(area[w, g], real(0.0))
            known, pull = _eliminate_column(q, dt, b, touched, force[w, g], state, scratch, w)
            thermistor_known = thermistor_known + patch * known
            thermistor_pull = thermistor_pull + patch * pull

    thermistor_own, thermistor_passed, known, pull = _eliminate(
        q[_C_THERMISTOR] / dt, state[w, THERMISTOR], thermistor_known, thermistor_pull, q[_SPREAD]
    )
    liquid_cell, liquid_passed, liquid_known, liquid_pull = _eliminate(
        q[_C_LIQUID] / dt, state[w, LIQUID], liquid_known, liquid_pull, q[_INSIDE]
    )
    stored = (q[_C_CORE] - q[_C_THERMISTOR]) / dt
    core = stored * state[w, CORE] + state[w, POWER] + q[_MOUNT] * q[_AMBIENT] + known + liquid_known
    core = core / (stored + q[_MOUNT] + pull + liquid_pull)

    # back-substitution outwards
    thermistor = thermistor_own + thermistor_passed * core
    liquid = liquid_cell + liquid_passed * core
    state[w, CORE] = core
    state[w, THERMISTOR] = thermistor
    state[w, LIQUID] = liquid
    state[w, ABOVE] = liquid - state[w, REFERENCE]
    t = liquid
    for k in range(NCELL):
        state[w, FREE + k] = state[w, FREE + k] + scratch[w, FREE + k] * t
        t = state[w, FREE + k]
    lost = q[_MOUNT] * (core - q[_AMBIENT]) + free * outside * (t - q[_AMBIENT])
    given = real(0.0)
    for g in range(ngroup):
        b = BODIES + BODY * g
        patch = state[w, b]
        if patch > real(0.0):
            t = thermistor
            for i in range(1, _SURFACE + 1):
                inside = t
                state[w, b + i] = state[w, b + i] + scratch[w, b + i] * t
                t = state[w, b + i]
            for i in range(NBRANCH):
                at = b + _STORE + i
                a = dt * _rates[i]
                state[w, at] = (state[w, at] + a * t) / (real(1.0) + a)
            touched = fit * wp.max(area[w, g], real(0.0))
            touch = _touch(q, touched, force[w, g], state[w, b + _BODY_CONDUCTIVITY])
            given = given + touched * touch * (inside - t)
    state[w, LOST] = state[w, LOST] + dt * lost
    state[w, GIVEN] = state[w, GIVEN] + dt * given


class Heat:
    """Temperatures of `nworld` sensors on one device, each touched by up to `ngroup` bodies.

    Args:
      bodies: materials of the touching bodies, the same in every world.
      parameters: of all sensors, or (nworld,) of them.
      nworld: number of sensors.
      device: Warp device.

    Attributes:
      state: (nworld, nstate) wp.array float64, laid out by this module's constants; temperatures in [C].
      area: (nworld, ngroup) wp.array float64, contact area of each body [m^2]; write it before `advance`.
      force: (nworld, ngroup) wp.array float64, the normal force of each [N]; likewise.
      nstate: length of a sensor's state.

    Raises:
      ValueError: the number of parameters differs from the number of sensors.
    """

    def __init__(
        self,
        bodies: list[Material],
        parameters: HeatParameters | list[HeatParameters] = HeatParameters(),
        nworld: int = 1,
        device: str = "cpu",
    ):
        parameters = [parameters] * nworld if isinstance(parameters, HeatParameters) else list(parameters)
        if len(parameters) != nworld:
            raise ValueError(
                f"{len(parameters)} sets of heat parameters for {nworld} sensors: pass one, or one for each"
            )
        self.ngroup, self.nworld, self.device = len(bodies), nworld, wp.get_device(device)
        rest = np.array([p.rest(bodies) for p in parameters])
        self.nstate = rest.shape[1]
        numbers = np.array([dataclasses.astuple(p) for p in parameters], float)
        with wp.ScopedDevice(self.device):
            self.state = wp.array(rest, dtype=real)
            self._scratch = wp.zeros_like(self.state)
            self._constants = wp.array(numbers, dtype=Parameters)
            self.area = wp.zeros((nworld, self.ngroup), dtype=real)
            self.force = wp.zeros((nworld, self.ngroup), dtype=real)
        inputs = [1.0, self._constants, self.area, self.force]
        # packing the arguments takes longer than the step of one sensor
        self._step = wp.launch(
            step_heat, nworld, inputs, [self.state, self._scratch], device=self.device, record_cmd=True
        )

    def read_from(self, area: wp.array, force: wp.array) -> None:
        """Makes (nworld, ngroup) device arrays the source of `area` and `force`."""
        self.area, self.force = area, force
        self._step.set_param_at_index(2, area)
        self._step.set_param_at_index(3, force)

    def advance(self, dt: float) -> None:
        """Steps by dt [s] with `area` and `force`. A launch only: may be captured in a CUDA graph."""
        self._step.set_param_at_index_from_ctype(0, dt)
        self._step.launch()
