"""From impedances, pressure and temperature to 12-bit counts, slot by slot, as the BioTac's multiplexer does
it.

One frame is 10 ms = 44 slots at 4.4 kHz, 0.227 ms apart. Even slots are PAC (22 per frame, 2.2 kHz); the 22
odd ones are e1..e19, PDC, TAC, TDC, in this order, once per frame. Source of rates: SynTouch manual; which
channel has which slot is not published: CHOSEN as above.

Slot k = 1, 2, ... lies at time k / 4400 s: what is sampled when depends on the time alone, never on the
time step, and what is read at a multiple of 10 ms is one whole frame, in the order in which it was taken.
All memory lies in state vectors of NSTATE numbers; noise is made of numpy's Philox 4x64 with one counter
block per slot, a function of (seed, slot), so a replay from a saved state is bit-equal.

`Acquisition` is one multiplexer whose state the caller owns, `BatchAcquisition` has those of many worlds on
their device; both launch the kernels below."""

import inspect
import math
import threading
import types

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from biotac_mj.calm import calm_warp
from biotac_mj.sensor import channels
from biotac_mj.sensor.channels import ELECTRODES, NELECTRODE, NPAC
from biotac_mj.sensor.presets import MOST_LATENCY, NNUMBER, NUMBERS, SENSORS, Sensor

calm_warp()

__all__ = [
    "Acquisition",
    "BatchAcquisition",
    "HELD",
    "HELD_PDC",
    "HELD_TAC",
    "HELD_TDC",
    "NSTATE",
    "OWN",
    "PAC",
    "SLOTS_PER_FRAME",
    "SLOT_RATE",
]

wp.set_module_options({"enable_backward": False})

SLOT_RATE = 4400.0  # [Hz]
SLOTS_PER_FRAME = 44

# The state vector: the electrodes' impedances [ohm] at IMPEDANCE_TIME, the last step's pressure [Pa] and
# temperature [C]; filters: pressure below 1040 Hz and below 10 Hz [Pa], heating below 0.25 Hz [C/s]; PAC's
# last noise; counts; when the reset was [s], the pressure and temperature that the last step was given, what
# of the pressure PDC still remembers [Pa]; what the electrodes were; the
# sensor's own numbers, so that a reset may change them.
PRESSURE = NELECTRODE
TEMPERATURE, IMPEDANCE_TIME, FILTER = PRESSURE + 1, PRESSURE + 2, PRESSURE + 3
_HISS = FILTER + 3
HELD = _HISS + 1  # e1..e19, pdc, tac, tdc
HELD_PDC, HELD_TAC, HELD_TDC = HELD + NELECTRODE, HELD + NELECTRODE + 1, HELD + NELECTRODE + 2
PAC = HELD_TDC + 1  # the frame's slots
_BEGAN = PAC + NPAC
_GIVEN_PRESSURE, _GIVEN_TEMPERATURE, _LAG = _BEGAN + 1, _BEGAN + 2, _BEGAN + 3
_PAST = _BEGAN + 4  # of each electrode what a low-pass remembers, then the last frames
_FRAMES = round(MOST_LATENCY * SLOT_RATE / SLOTS_PER_FRAME) + 2
OWN = _PAST + (1 + _FRAMES) * NELECTRODE
NSTATE = OWN + NNUMBER
(
    _SCALE, _BASE, _NOISE, _WARM_SHARE, _DRIFT, _MIXING, _MIXED, _PDC_REST, _PDC_GAIN, _PDC_NOISE, _PAC_REST,
    _PAC_NOISE, _PAC_COLOUR, _TDC_NOISE, _TAC_REST, _TAC_NOISE, _WARM_UP, _WARM_TIME, _RELAX_SHARE,
    _RELAX_TIME, _LOSS, _PER_DEGREE, _POWER, _SATURATED, _KNEE, _LOWPASS, _LATENCY,
) = (OWN + at for at in NUMBERS.values())  # fmt: skip
_MOST_LOSS = 0.8  # of the liquid
_PERIOD = SLOTS_PER_FRAME / SLOT_RATE  # [s] of a frame

# [rad/s], manual. TAC is what passes 0.25 Hz upwards of the temperature: its rate, below 0.25 Hz. The manual
# has 0.45 Hz as well; of recorded TACs that leaves 9.0 counts RMS unexplained, 0.25 Hz 7.0
# (`benchmarks/thermal.py`).
_LOW, _HIGH, _TAC = (2 * math.pi * hertz for hertz in (1040.0, 10.0, 0.25))
_BAND = _LOW / (_LOW - _HIGH)  # s w2 / ((s + w1)(s + w2)) = band (w2 / (s + w2) - w1 / (s + w1))

real = wp.float64
block = wp.types.vector(4, wp.uint64)
_FRAME = wp.constant(wp.int64(SLOTS_PER_FRAME))


def _compiled(formula):
    """A formula of `channels.py` for kernels."""
    copy = types.FunctionType(formula.__code__, formula.__globals__, formula.__name__)
    copy.__annotations__ = dict.fromkeys(inspect.signature(formula).parameters, real)
    return wp.func(copy)


_impedance_counts = _compiled(channels.counts_from_impedance)
_pressure_counts = _compiled(channels.counts_from_pressure)
_pac_counts = _compiled(channels.counts_from_pac)
_thermistor_counts = _compiled(channels.thermistor_counts)
_heating_exponent = _compiled(channels.heating_exponent)
_temperature_exponent = _compiled(channels.temperature_exponent)
_electrode_noise = _compiled(channels.electrode_noise)


@wp.func
def slots_until(time: real):
    """How many slots lie up to a time, slot 0 left out; the allowance keeps a slot on one side of a time that
    was summed up with rounding."""
    return wp.int64(wp.floor(time * real(SLOT_RATE) + real(1.0e-6)))


@wp.func
def _position(slot: wp.int64):
    """Of a slot in its frame; time may be negative."""
    position = wp.int32((slot - wp.int64(1)) % _FRAME)
    return wp.where(position < 0, position + SLOTS_PER_FRAME, position)


@wp.kernel
def find_due(
    # In:
    time: wp.array(dtype=real),
    dt: real,
    every_step: int,
    # Out:
    due_out: wp.array(dtype=int),
):
    """`Acquisition.needs_impedance` of each world."""
    w = wp.tid()
    before = slots_until(time[w])
    count = wp.int32(slots_until(time[w] + dt) - before)
    due = int(0)
    if every_step == 1:
        for k in range(1, wp.min(count, SLOTS_PER_FRAME) + 1):
            position = _position(before + wp.int64(k))
            if position % 2 == 1 and position < 2 * NELECTRODE:
                due = 1
    elif SLOTS_PER_FRAME - _position(before - wp.int64(1)) <= count:
        due = 1  # slot 1 of a frame, the first electrode's
    due_out[w] = due


@wp.func
def _high_product(a: wp.uint64, b: wp.uint64):
    """Upper half of the 128-bit product."""
    half = wp.uint64(32)
    mask = wp.uint64(0xFFFFFFFF)
    a0 = a & mask
    a1 = a >> half
    b0 = b & mask
    b1 = b >> half
    middle = a1 * b0 + ((a0 * b0) >> half)
    carry = a0 * b1 + (middle & mask)
    return a1 * b1 + (middle >> half) + (carry >> half)


@wp.func
def philox(counter: wp.uint64, key: wp.uint64):
    """Block `counter` of Philox 4x64-10 (Salmon et al., SC 2011) with this key, the upper words of which are
    zero."""
    c0 = counter
    c1 = wp.where(counter == wp.uint64(0), wp.uint64(1), wp.uint64(0))  # numpy's carries, before slot 0
    c2 = wp.uint64(0)
    c3 = wp.uint64(0)
    k0 = key
    k1 = wp.uint64(0)
    m0 = wp.uint64(0xD2E7470EE14C6C93)
    m1 = wp.uint64(0xCA5A826395121157)
    for _ in range(10):
        n0 = _high_product(m1, c2) ^ c1 ^ k0
        n1 = m1 * c2
        n2 = _high_product(m0, c0) ^ c3 ^ k1
        n3 = m0 * c0
        c0 = n0
        c1 = n1
        c2 = n2
        c3 = n3
        k0 += wp.uint64(0x9E3779B97F4A7C15)
        k1 += wp.uint64(0xBB67AE8584CAA73B)
    return block(c0, c1, c2, c3)


@wp.func
def draw_normal(slot: wp.int64, seed: wp.uint64):
    """Standard normal draw of a slot (Box-Muller: a fixed number of draws)."""
    raw = philox(wp.uint64(slot) + wp.uint64(1), seed)  # numpy counts on before it draws
    shift = wp.uint64(11)
    unit = real(1.0) / real(9007199254740992.0)
    u = (real(raw[0] >> shift) + real(0.5)) * unit
    v = (real(raw[1] >> shift) + real(0.5)) * unit
    return wp.sqrt(real(-2.0) * wp.log(u)) * wp.cos(real(2.0) * real(wp.pi) * v)


@wp.func
def _ramp(old: real, rise: real, memory: real, corner: real, t: real):
    """Exact response of corner / (s + corner) to the ramp old + rise t."""
    lag = rise / corner
    return old - lag + rise * t + (memory - old + lag) * wp.exp(-corner * t)


@wp.func
def _warmed(state: wp.array2d(dtype=real), w: int, time: real):
    """How much warmer than at the reset [C]."""
    since = wp.max(time - state[w, _BEGAN], real(0.0))
    return state[w, _WARM_UP] * (real(1.0) - wp.exp(-since / state[w, _WARM_TIME]))


@wp.func
def _warm_impedance(
    state: wp.array2d(dtype=real), impedance: wp.array2d(dtype=real), w: int, e: int, liquid: real,
    warmed: real, left: real,
):  # fmt: skip
    """Of an electrode where the liquid is warmer, and less is left of it [ohm]."""
    warmer = liquid + state[w, _WARM_SHARE + e] * warmed
    return impedance[w, e] * state[w, _SCALE + e] * wp.exp(-state[w, _PER_DEGREE] * warmer) / left


@wp.func
def _electrode(state: wp.array2d(dtype=real), w: int, e: int, fresh: int, new: real, share: real):
    """Counts without noise of an electrode, at a share of the way to the new impedance."""
    z = state[w, e]
    if fresh == 1:
        z += (new - z) * share
    power = state[w, _POWER]
    if power != real(1.0):
        rest = real(channels.DIVIDER) * (real(channels.FULL_SCALE) / state[w, _BASE + e] - real(1.0))
        z = rest * wp.pow(z / rest, power)
    return _impedance_counts(z)


@wp.func
def _late(state: wp.array2d(dtype=real), w: int, e: int, slot: wp.int64, counts: real):
    """Counts of an electrode after its low-pass and its latency: a frame is linear to the next."""
    past = _PAST + e
    tau = state[w, _LOWPASS]
    value = counts
    if tau > real(0.0):
        keep = wp.exp(real(-_PERIOD) / tau)
        value = keep * state[w, past] + (real(1.0) - keep) * counts
        state[w, past] = value
    behind = state[w, _LATENCY] / real(_PERIOD)
    if behind > real(0.0):
        frame = wp.int32((slot - wp.int64(1)) / _FRAME) % _FRAMES + _FRAMES
        state[w, past + (1 + frame % _FRAMES) * NELECTRODE] = value
        whole = wp.int32(behind)
        part = behind - real(whole)
        newer = state[w, past + (1 + (frame - whole) % _FRAMES) * NELECTRODE]
        older = state[w, past + (1 + (frame - whole - 1) % _FRAMES) * NELECTRODE]
        value = newer + part * (older - newer)
    return value


@wp.kernel
def sample_slots(
    # In:
    dt: real,
    noise: int,
    seed: wp.array(dtype=wp.uint64),
    due: wp.array(dtype=int),
    valid: wp.array(dtype=int),
    impedance: wp.array2d(dtype=real),
    pressure: wp.array(dtype=real),
    temperature: wp.array(dtype=real),
    liquid: wp.array(dtype=real),
    shaken: wp.array2d(dtype=real),
    # In, out:
    time: wp.array(dtype=real),
    state: wp.array2d(dtype=real),
):
    """`Acquisition.advance` of each world over (time, time + dt]."""
    w = wp.tid()
    now = time[w]
    fresh = due[w] * valid[w]
    span = now + dt - wp.min(state[w, IMPEDANCE_TIME], now)  # a clock that was set back does not extrapolate
    keep = wp.exp(-dt / state[w, _RELAX_TIME])
    lag = keep * state[w, _LAG] + (real(1.0) - keep) * state[w, _RELAX_TIME] / dt * (
        pressure[w] - state[w, _GIVEN_PRESSURE]
    )
    felt = pressure[w] + state[w, _RELAX_SHARE] * lag
    old = state[w, PRESSURE]
    rise = (felt - old) / dt
    warmed = _warmed(state, w, now + dt)
    warm = state[w, TEMPERATURE]
    heating = (temperature[w] + warmed - warm) / dt
    age = wp.max(now + dt - state[w, _BEGAN], real(0.0))
    left = wp.max(real(1.0) - state[w, _LOSS] * age / real(3600.0), real(1.0 - _MOST_LOSS))
    low = state[w, FILTER]
    high = state[w, FILTER + 1]
    tac = state[w, FILTER + 2]
    before = slots_until(now)
    for k in range(1, wp.int32(slots_until(now + dt) - before) + 1):
        slot = before + wp.int64(k)
        since = real(slot) / real(SLOT_RATE) - now
        position = _position(slot)
        channel = position / 2
        address = PAC + channel
        fast = _ramp(old, rise, low, real(_LOW), since)
        sound = real(_BAND) * (fast - _ramp(old, rise, high, real(_HIGH), since))
        if k <= shaken.shape[1]:
            sound += shaken[w, k - 1]
        value = _pac_counts(sound) - real(channels.PAC_REST) + state[w, _PAC_REST]
        deviation = state[w, _PAC_NOISE]
        if position % 2 == 1:
            address = HELD + channel
            if channel < NELECTRODE:
                share = real(1.0) - (dt - since) / span
                new = _warm_impedance(state, impedance, w, channel, liquid[w], warmed, left)
                value = _electrode(state, w, channel, fresh, new, share)
                base = state[w, _BASE + channel]
                change = value - base
                if state[w, _MIXED] != real(0.0):
                    change = real(0.0)
                    row = _MIXING + channel * NELECTRODE
                    for e in range(NELECTRODE):
                        if state[w, row + e] != real(0.0):
                            new = _warm_impedance(state, impedance, w, e, liquid[w], warmed, left)
                            other = _electrode(state, w, e, fresh, new, share)
                            change += state[w, row + e] * (other - state[w, _BASE + e])
                over = wp.max(wp.abs(change) - state[w, _KNEE], real(0.0)) * state[w, _SATURATED]
                value = _late(state, w, channel, slot, base + change - wp.sign(change) * over)
                value += state[w, _DRIFT + channel] * wp.max(now + since - state[w, _BEGAN], real(0.0))
                deviation = state[w, _NOISE + channel] * _electrode_noise(value)
            elif address == HELD_PDC:
                change = _pressure_counts(fast) - real(channels.PDC_REST)
                value = state[w, _PDC_REST] + state[w, _PDC_GAIN] * change
                deviation = state[w, _PDC_NOISE]
            elif address == HELD_TAC:
                rate = _ramp(heating, real(0.0), tac, real(_TAC), since)
                value = _thermistor_counts(_heating_exponent(rate))
                value += state[w, _TAC_REST] - real(channels.TAC_REST)
                deviation = state[w, _TAC_NOISE]
            else:
                value = _thermistor_counts(_temperature_exponent(warm + heating * since))
                deviation = state[w, _TDC_NOISE]
        if noise == 1:
            hiss = deviation * draw_normal(slot, seed[w])
            if position % 2 == 0:
                hiss += state[w, _PAC_COLOUR] * state[w, _HISS]
                state[w, _HISS] = hiss
            value += hiss
        # a step longer than a frame meets a channel more than once: the last one stays
        state[w, address] = wp.clamp(wp.rint(value), real(0.0), real(channels.FULL_SCALE))
    state[w, FILTER] = _ramp(old, rise, low, real(_LOW), dt)
    state[w, FILTER + 1] = _ramp(old, rise, high, real(_HIGH), dt)
    state[w, FILTER + 2] = _ramp(heating, real(0.0), tac, real(_TAC), dt)
    state[w, PRESSURE] = felt
    state[w, TEMPERATURE] = temperature[w] + warmed
    state[w, _GIVEN_PRESSURE] = pressure[w]
    state[w, _GIVEN_TEMPERATURE] = temperature[w]
    state[w, _LAG] = lag
    if fresh == 1:
        for e in range(NELECTRODE):
            state[w, e] = _warm_impedance(state, impedance, w, e, liquid[w], warmed, left)
        state[w, IMPEDANCE_TIME] = now + dt
    time[w] = now + dt


@wp.kernel
def reset_states(
    # In:
    mask: wp.array(dtype=bool),
    rest: wp.array2d(dtype=real),
    redraw: int,
    seed: wp.array(dtype=wp.uint64),
    # In, out:
    drawn: wp.array(dtype=int),
    # Out:
    row_out: wp.array(dtype=int),
    time_out: wp.array(dtype=real),
    temperature_out: wp.array(dtype=real),
    state_out: wp.array2d(dtype=real),
):
    """Rest states of worlds: row w of `rest`, with `redraw` after the first reset one that seed and number of
    the reset tell."""
    w = wp.tid()
    if not mask[w]:
        return
    row = w
    if redraw == 1:
        if drawn[w] > 0:
            row = wp.int32(philox(wp.uint64(drawn[w]), ~seed[w])[0] % wp.uint64(rest.shape[0]))
        drawn[w] = drawn[w] + 1
    for i in range(state_out.shape[1]):
        state_out[w, i] = rest[row, i]
    row_out[w] = row
    time_out[w] = real(0.0)
    temperature_out[w] = rest[row, _GIVEN_TEMPERATURE]


class Acquisition:
    """The multiplexer, its filters, its noise and its converter. Constant after construction; the state
    belongs to the caller.

    Every channel samples, at its slots, the signal interpolated linearly over the step that contains them,
    and holds the count until its next slot. The filters are first-order sections (PDC: low-pass 1040 Hz; PAC:
    band-pass 10-1040 Hz; TAC: the temperature's rate, low-pass 0.25 Hz), exact for that piecewise linear
    signal.

    Args:
      seed: of the noise, 0 .. 2**64 - 1; give every sensor its own.
      noise: False leaves quantisation only.
      film_every_step: see `needs_impedance`.
      sensor: whose own numbers `reset` writes.
      film_rest: (19,) the impedances that it is given at rest [ohm]; None: this sensor's own.
      heat: whether the temperatures that it is given warm it up (`sensor.heat`).

    Attributes:
      nstate: length of the state vector.

    Raises:
      ValueError: the seed is out of range.
    """

    nstate = NSTATE

    def __init__(
        self,
        seed: int = 0,
        noise: bool = True,
        film_every_step: bool = False,
        sensor: Sensor = SENSORS["1"],
        film_rest: ArrayLike | None = None,
        heat: bool = False,
    ):
        if int(seed) != seed or not 0 <= seed < 2**64:
            raise ValueError(f"seed is {seed}: pass an integer from 0 to 2**64 - 1")
        self.seed, self.noise, self.film_every_step = int(seed), bool(noise), bool(film_every_step)
        self.sensor = sensor
        self._film_rest, self._heat = film_rest, heat
        self._own = sensor.numbers(film_rest, heat)

    def of(self, sensor: Sensor) -> "Acquisition":
        """The same multiplexer of another sensor."""
        more = self.film_every_step, sensor, self._film_rest, self._heat
        return Acquisition(self.seed, self.noise, *more)

    def reset(
        self,
        state: np.ndarray,
        impedance: ArrayLike,
        pressure: float = 0.0,
        temperature: float | None = None,
        time: float = 0.0,
        liquid: float = 0.0,
    ) -> None:
        """Writes the steady state: every channel holds the noise-free count of these signals.

        Args:
          state: (nstate,) float64, written in place.
          impedance: (19,) [ohm]; pressure: above rest [Pa]; temperature: [C], None: the sensor's; time: now
            [s]; liquid: how much warmer it is than at the impedances [C].
        """
        self._check_state(state)
        temperature = self.sensor.temperature if temperature is None else temperature
        state[OWN:], state[_BEGAN] = self._own, time
        z = self._check_impedance(impedance) * state[_SCALE:_BASE] * math.exp(-state[_PER_DEGREE] * liquid)
        state[:NELECTRODE] = z
        state[PRESSURE], state[TEMPERATURE] = self._check_scalars(pressure, temperature)
        state[_GIVEN_PRESSURE:_LAG] = pressure, temperature
        state[_LAG] = 0.0
        state[IMPEDANCE_TIME] = time
        state[FILTER:HELD] = pressure, pressure, 0.0, 0.0
        base = state[_BASE:_NOISE]
        rest = channels.impedance_from_counts(base)
        change = channels.counts_from_impedance(rest * (z / rest) ** state[_POWER]) - base
        change = state[_MIXING:_MIXED].reshape(NELECTRODE, NELECTRODE) @ change
        change -= np.sign(change) * state[_SATURATED] * np.maximum(np.abs(change) - state[_KNEE], 0.0)
        state[HELD:HELD_PDC] = base + change
        state[_PAST:OWN] = np.tile(base + change, 1 + _FRAMES)
        change = channels.counts_from_pressure(pressure) - channels.PDC_REST
        state[HELD_PDC] = state[_PDC_REST] + state[_PDC_GAIN] * change
        state[HELD_TAC] = state[_TAC_REST]
        state[HELD_TDC] = channels.counts_from_temperature(temperature)
        state[PAC:_BEGAN] = state[_PAC_REST]
        state[HELD:_BEGAN] = np.clip(np.rint(state[HELD:_BEGAN]), 0, channels.FULL_SCALE)

    def needs_impedance(self, state: np.ndarray, time: float, dt: float) -> bool:
        """Whether `advance` over (time, time + dt] wants a new impedance, so that the film need not be solved
        otherwise.

        By default once per frame: in the step that holds the frame's first electrode slot. Until the next
        solution the electrodes hold that impedance, so what e19 reads is up to one frame (10 ms) old, 5 ms on
        average: causal, and what makes a 0.1 ms step affordable. With `film_every_step` whenever an electrode
        slot falls into the step.
        """
        return _one().find_due(time, dt, self.film_every_step)

    def advance(
        self,
        state: np.ndarray,
        time: float,
        dt: float,
        impedance: ArrayLike | None = None,
        pressure: float = 0.0,
        temperature: float | None = None,
        shaken: wp.array | None = None,
        liquid: float = 0.0,
    ) -> None:
        """Samples the slots in (time, time + dt].

        Args:
          state: (nstate,) float64, updated in place.
          time: at the start of the step [s]; dt: its length [s].
          impedance: (19,) at the end of the step [ohm]; None holds the last one (see `needs_impedance`).
          pressure: at the end of the step, above rest [Pa].
          temperature: of the core at the end of the step [C]; None keeps the last one.
          shaken: (1, n) float64 on the CPU, what PAC feels besides at each of the slots [Pa], of its band
            already (`vibration`).
          liquid: how much warmer it is at the end of the step than at the impedances [C].

        Raises:
          ValueError: wrong shape, not finite, impedance not positive, or dt not positive. The state is
            unchanged then.
        """
        self._check_state(state)
        if not (math.isfinite(time) and math.isfinite(dt) and dt > 0):
            raise ValueError(f"time is {time} and dt is {dt}: pass finite seconds, dt positive")
        if impedance is not None:
            impedance = self._check_impedance(impedance)
        temperature = state[_GIVEN_TEMPERATURE] if temperature is None else temperature
        signals = self._check_scalars(pressure, temperature)
        _one().sample(self.seed, self.noise, state, time, dt, impedance, *signals, liquid, shaken)

    def readings(self, state: np.ndarray) -> dict:
        """What the bus would report now.

        Returns:
          dict of counts: electrodes (19,) int, pdc int, pac (22,) int in the order of the frame's PAC slots,
            tac int, tdc int.
        """
        self._check_state(state)
        held = state.astype(int)
        return {
            "electrodes": held[HELD:HELD_PDC],
            "pdc": int(held[HELD_PDC]),
            "pac": held[PAC:_BEGAN],
            "tac": int(held[HELD_TAC]),
            "tdc": int(held[HELD_TDC]),
        }

    def _check_state(self, state):
        if not (
            isinstance(state, np.ndarray) and state.shape == (self.nstate,) and state.dtype == np.float64
        ):
            got = (
                f"{state.dtype} of shape {state.shape}"
                if isinstance(state, np.ndarray)
                else type(state).__name__
            )
            raise ValueError(
                f"state is {got}: pass a float64 array of shape ({self.nstate},), filled by reset()"
            )

    @staticmethod
    def _check_impedance(impedance):
        impedance = np.asarray(impedance, dtype=float)
        if impedance.shape != (NELECTRODE,):
            raise ValueError(
                f"impedance has shape {impedance.shape}: pass ({NELECTRODE},) [ohm], one per electrode "
                f"{ELECTRODES[0]}..{ELECTRODES[-1]}"
            )
        if not (impedance.min() > 0 and impedance.max() < np.inf):
            bad = [ELECTRODES[i] for i in np.flatnonzero(~(np.isfinite(impedance) & (impedance > 0)))]
            raise ValueError(
                f"impedance of {', '.join(bad)} is not a positive finite number [ohm]: check the skin's "
                "positions; keep the last good ones"
            )
        return impedance

    @staticmethod
    def _check_scalars(pressure, temperature):
        if not (math.isfinite(pressure) and math.isfinite(temperature)):
            raise ValueError(
                f"pressure is {pressure} Pa and temperature {temperature} C: both must be finite; keep the "
                "last good values"
            )
        return float(pressure), float(temperature)


class _One:
    """One world's arrays on the CPU and the kernels' recorded launches, a thread's own: what every
    `Acquisition` fills in and reads back."""

    def __init__(self):
        self._time, self._pressure, self._temperature, self._liquid = (
            wp.zeros(1, dtype=real, device="cpu") for _ in "tpTl"
        )
        self._due, self._seed = (
            wp.zeros(1, dtype=int, device="cpu"),
            wp.zeros(1, dtype=wp.uint64, device="cpu"),
        )
        self._impedance = wp.zeros((1, NELECTRODE), dtype=real, device="cpu")
        self._state = wp.zeros((1, NSTATE), dtype=real, device="cpu")
        self.time, self.pressure, self.temperature, self.liquid, self.due, self.seed = (
            array.numpy()
            for array in (
                self._time, self._pressure, self._temperature, self._liquid, self._due, self._seed
            )
        )  # fmt: skip
        self.impedance, self.state = self._impedance.numpy()[0], self._state.numpy()[0]
        valid = wp.ones(1, dtype=int, device="cpu")
        self._still = self._shaken = wp.zeros((1, 0), dtype=real, device="cpu")
        inputs = [1.0, 0, self._seed, self._due, valid, self._impedance, self._pressure, self._temperature]
        inputs += [self._liquid, self._still]
        state = [self._time, self._state]
        self._sample = wp.launch(sample_slots, 1, inputs, state, device="cpu", record_cmd=True)
        self._find = wp.launch(find_due, 1, [self._time, 1.0, 0], [self._due], device="cpu", record_cmd=True)

    def find_due(self, time, dt, every_step):
        self.time[0] = time
        self._find.set_param_at_index_from_ctype(1, dt)
        self._find.set_param_at_index_from_ctype(2, int(every_step))
        self._find.launch()
        return bool(self.due[0])

    def sample(self, seed, noise, state, time, dt, impedance, pressure, temperature, liquid, shaken):
        shaken = self._still if shaken is None else shaken
        if shaken is not self._shaken:
            self._shaken = shaken
            self._sample.set_param_at_index(9, shaken)
        self.state[:] = state
        self.seed[0], self.time[0], self.pressure[0], self.temperature[0] = seed, time, pressure, temperature
        self.liquid[0], self.due[0] = liquid, impedance is not None
        if impedance is not None:
            self.impedance[:] = impedance
        self._sample.set_param_at_index_from_ctype(0, dt)
        self._sample.set_param_at_index_from_ctype(1, int(noise))
        self._sample.launch()
        state[:] = self.state


_mine = threading.local()


def _one():
    """This thread's `_One`, made when it is first used: that compiles the kernels."""
    if not hasattr(_mine, "one"):
        _mine.one = _One()
    return _mine.one


class BatchAcquisition:
    """The multiplexers of `nworld` sensors on one device, each with its own clock and seed: worlds get the
    counts, noise included, of single ones with their seeds.

    Args:
      rest: (19,) impedance that the film gives at rest [ohm], at which every world begins.
      nworld: number of worlds.
      seed: of world 0; world w has seed + w. Or (nworld,) of them, 0 .. 2**64 - 1.
      noise: False leaves quantisation only.
      film_every_step: see `Acquisition.needs_impedance`.
      temperature: of the core at rest [C]; None: each sensor's own. liquid: how much warmer the liquid is
        then than at the impedances [C]. One, or one for each sensor.
      sensor: Sensor of all worlds, or a list: one for each world, and (`redraw`) more that every later reset
        of a world draws from, by seed and number of the reset.
      heat: see `Acquisition`.
      device: Warp device.

    Attributes:
      state: (nworld, NSTATE) wp.array float64, each row the state vector of an `Acquisition`.
      time: (nworld,) wp.array float64 [s], each sensor's clock, zero at its reset.
      temperature: (nworld,) wp.array float64, of the core at the end of the next step [C].
      liquid: (nworld,) wp.array float64, how much warmer the liquid is than at the impedances [C].
      due: (nworld,) wp.array int, written by `find_due`.
      row: (nworld,) wp.array int, which sensor of the list each world has.

    Raises:
      ValueError: a seed out of range or another number of seeds or sensors than worlds.
    """

    def __init__(
        self,
        rest: ArrayLike,
        nworld: int,
        seed: ArrayLike = 0,
        noise: bool = True,
        film_every_step: bool = False,
        temperature: ArrayLike | None = None,
        liquid: ArrayLike = 0.0,
        sensor: Sensor | list[Sensor] = SENSORS["1"],
        redraw: bool = False,
        heat: bool = False,
        device: str = "cpu",
    ):
        sensors = [sensor] * (1 if redraw else nworld) if isinstance(sensor, Sensor) else list(sensor)
        if not redraw and len(sensors) != nworld:
            raise ValueError(
                f"{len(sensors)} sensors for {nworld} worlds: pass one for each, or a single one"
            )
        rows, states = np.zeros((len(sensors), NSTATE)), {}
        warm = [None if temperature is None else float(t) for t in np.broadcast_to(temperature, len(sensors))]
        for row, *one in zip(
            rows, sensors, warm, np.broadcast_to(liquid, len(sensors)).tolist(), strict=True
        ):
            if tuple(one) not in states:
                single = Acquisition(sensor=one[0], film_rest=rest, heat=heat)
                single.reset(row, rest, temperature=one[1], liquid=one[2])
                states[tuple(one)] = row
            row[:] = states[tuple(one)]
        seeds = [int(seed) + w for w in range(nworld)] if np.ndim(seed) == 0 else [int(s) for s in seed]
        if len(seeds) != nworld:
            raise ValueError(
                f"{len(seeds)} seeds for {nworld} worlds: pass one for each, or a single one from which "
                "they count on"
            )
        for s in (min(seeds), max(seeds)):
            Acquisition(seed=s)  # refuses what is out of range
        self.nworld, self.device = nworld, wp.get_device(device)
        self._noise, self._every, self._redraw = int(bool(noise)), int(bool(film_every_step)), int(redraw)
        with wp.ScopedDevice(self.device):
            self.seed = wp.array(np.array(seeds, np.uint64), dtype=wp.uint64)
            self._rest = wp.array(rows, dtype=real)
            self._drawn, self.row = (wp.zeros(nworld, dtype=int) for _ in range(2))
            self.state = wp.zeros((nworld, NSTATE), dtype=real)
            self.time, self.temperature, self.liquid = (wp.zeros(nworld, dtype=real) for _ in range(3))
            self.due = wp.zeros(nworld, dtype=int)
            self._still = wp.zeros((nworld, 0), dtype=real)
            self.reset(wp.full(nworld, True, dtype=bool))
            self._drawn.zero_()  # the first reset by whoever has it is the beginning, and draws nothing

    def reset(self, mask: wp.array) -> None:
        """Puts the worlds of mask, (nworld,) wp.array of bool, back to rest at time zero."""
        inputs = [mask, self._rest, self._redraw, self.seed, self._drawn]
        outputs = [self.row, self.time, self.temperature, self.state]
        wp.launch(reset_states, self.nworld, inputs, outputs, device=self.device)

    def find_due(self, dt: float) -> wp.array:
        """Writes which worlds want a new impedance for the step of dt [s] from now; returns `due`."""
        wp.launch(find_due, self.nworld, [self.time, dt, self._every], [self.due], device=self.device)
        return self.due

    def advance(
        self,
        dt: float,
        impedance: wp.array,
        valid: wp.array,
        pressure: wp.array,
        shaken: wp.array | None = None,
    ) -> None:
        """Samples the slots of a step and moves the clocks. Launches only: may be captured in a CUDA graph.

        Args:
          dt: length of the step [s].
          impedance: (nworld, 19) wp.array float64 at the end of the step [ohm], looked at in the worlds that
            are `due` and `valid`.
          valid: (nworld,) wp.array int.
          pressure: (nworld,) wp.array float64, of the liquid at the end of the step above rest [Pa].
          shaken: (nworld, n) wp.array float64, see `Acquisition.advance`.
        """
        inputs = [dt, self._noise, self.seed, self.due, valid, impedance, pressure]
        inputs += [self.temperature, self.liquid, self._still if shaken is None else shaken]
        wp.launch(sample_slots, self.nworld, inputs, [self.time, self.state], device=self.device)
