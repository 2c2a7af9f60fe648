"""`Acquisition` for many worlds on one device: slots, filters, noise and converter of `acquisition.py` in one
Warp kernel.

Each world has the same 69 numbers of state, its own clock and its own seed. Noise is numpy's Philox 4x64 with
one counter block per slot, so it is that of the single sensor with the same seed."""

import numpy as np
import warp as wp

from biotac_mj.sensor import acquisition, channels
from biotac_mj.sensor.acquisition import Acquisition

__all__ = ["BatchAcquisition"]

wp.set_module_options({"enable_backward": False})

real = wp.float64
block = wp.types.vector(4, wp.uint64)


def _constant(value):
    return wp.constant(wp.float64(value))


_RATE, _FULL = _constant(acquisition.SLOT_RATE), _constant(channels.FULL_SCALE)
_LOW, _HIGH, _TAC = (_constant(w) for w in acquisition._CORNER)
_BAND = _constant(acquisition._BAND)
_DIVIDER, _MIDDLE, _OTHER_NOISE = (
    _constant(channels._DIVIDER),
    _constant(channels._MIDDLE),
    _constant(channels.OTHER_NOISE),
)
_PDC_REST, _PDC_GAIN, _PAC_GAIN = (
    _constant(channels._PDC_REST),
    _constant(channels._PDC_GAIN),
    _constant(channels._PAC_GAIN),
)
_NOISE_SLOPE, _NOISE_LEVEL = _constant(channels._NOISE_SLOPE), _constant(channels._NOISE_LEVEL)
_STEADY = _constant(channels._heating(channels._MIDDLE))  # what the manual's formula gives where TAC rests
_FRAME = wp.constant(wp.int64(acquisition.SLOTS_PER_FRAME))
# The state vector, as `acquisition.py` lays it out.
_PRESSURE, _TEMPERATURE, _IMPEDANCE_TIME = 19, 20, 21
_FILTER, _HELD, _PAC = 22, 25, 47


@wp.func
def _first_slot(time: real):
    return wp.int64(wp.floor(time * _RATE + real(1.0e-6))) + wp.int64(1)


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
    frame = _FRAME
    first = _first_slot(time[w])
    last = _first_slot(time[w] + dt) - wp.int64(1)
    due = int(0)
    if every_step == 1:
        for k in range(wp.min(wp.int32(last - first) + 1, 44)):
            position = int((first + wp.int64(k)) % frame)
            if position % 2 == 1 and position < 38:
                due = 1
    elif (last + frame - wp.int64(1)) / frame > (first + frame - wp.int64(2)) / frame:
        due = 1
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
    """Block `counter` of Philox 4x64-10 (Salmon et al., SC 2011) with this key; the upper words of counter
    and key are zero."""
    c0 = counter
    c1 = wp.uint64(0)
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
def _normal(slot: wp.int64, seed: wp.uint64):
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
def _thermistor(exponent: real):
    return _FULL * real(155183.0) / (wp.exp(exponent) + real(46555.0))


@wp.func
def _quantised(counts: real):
    return wp.clamp(wp.rint(counts), real(0.0), _FULL)


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
    # In, out:
    time: wp.array(dtype=real),
    state: wp.array2d(dtype=real),
):
    """`Acquisition.advance` of each world over (time, time + dt]."""
    w = wp.tid()
    now = time[w]
    fresh = due[w] * valid[w]
    span = now + dt - wp.min(state[w, _IMPEDANCE_TIME], now)  # a clock that was set back does not extrapolate
    old = state[w, _PRESSURE]
    rise = (pressure[w] - old) / dt
    warm = state[w, _TEMPERATURE]
    heating = (temperature[w] - warm) / dt
    low = state[w, _FILTER]
    high = state[w, _FILTER + 1]
    tac = state[w, _FILTER + 2]
    first = _first_slot(now)
    count = int(_first_slot(now + dt) - first)
    for k in range(count):
        slot = first + wp.int64(k)
        since = real(slot) / _RATE - now
        position = int(slot % _FRAME)
        channel = position / 2
        address = _PAC + channel
        value = (
            _MIDDLE
            + _BAND * (_ramp(old, rise, low, _LOW, since) - _ramp(old, rise, high, _HIGH, since)) / _PAC_GAIN
        )
        deviation = _OTHER_NOISE
        if position % 2 == 1:
            address = _HELD + channel
            if channel < 19:
                z = state[w, channel]
                if fresh == 1:
                    z += (impedance[w, channel] - z) * (real(1.0) - (dt - since) / span)
                value = _FULL / (z / _DIVIDER + real(1.0))
                deviation = wp.clamp(_NOISE_SLOPE * (real(1.0) - value / _FULL), real(0.0), _NOISE_LEVEL)
            elif channel == 19:
                value = _PDC_REST + _ramp(old, rise, low, _LOW, since) / _PDC_GAIN
            elif channel == 20:
                value = _thermistor(
                    real(-41.07) / wp.min(_ramp(heating, real(0.0), tac, _TAC, since) + _STEADY, real(-0.1))
                )
            else:
                value = _thermistor(real(4025.0) / (warm + heating * since + real(273.15)))
        if noise == 1:
            value += deviation * _normal(slot, seed[w])
        state[w, address] = _quantised(value)
    state[w, _FILTER] = _ramp(old, rise, low, _LOW, dt)
    state[w, _FILTER + 1] = _ramp(old, rise, high, _HIGH, dt)
    state[w, _FILTER + 2] = _ramp(heating, real(0.0), tac, _TAC, dt)
    state[w, _PRESSURE] = pressure[w]
    state[w, _TEMPERATURE] = temperature[w]
    if fresh == 1:
        for e in range(19):
            state[w, e] = impedance[w, e]
        state[w, _IMPEDANCE_TIME] = now + dt
    time[w] = now + dt


@wp.kernel
def reset_states(
    mask: wp.array(dtype=bool),
    rest: wp.array(dtype=real),
    time_out: wp.array(dtype=real),
    state_out: wp.array2d(dtype=real),
):
    w, i = wp.tid()
    if mask[w]:
        state_out[w, i] = rest[i]
        if i == 0:
            time_out[w] = real(0.0)


class BatchAcquisition:
    """The multiplexers of `nworld` sensors.

    Args:
      rest: (19,) impedance at rest [ohm], at which every world begins.
      nworld: number of worlds.
      seed: of world 0; world w has seed + w. Or (nworld,) of them, 0 .. 2**64 - 1.
      noise: False leaves quantisation only.
      film_every_step: see `Acquisition.needs_impedance`.
      temperature: of the core at rest [C].
      device: Warp device.

    Attributes:
      state: (nworld, 69) wp.array float64, each row the state vector of an `Acquisition`.
      time: (nworld,) wp.array float64 [s], each sensor's clock, zero at its reset.
      temperature: (nworld,) wp.array float64 [C], of the core at the end of the next step.
      due: (nworld,) wp.array int, written by `find_due`.

    Raises:
      ValueError: a seed out of range or another number of seeds than worlds.
    """

    def __init__(
        self,
        rest,
        nworld,
        seed=0,
        noise=True,
        film_every_step=False,
        temperature=channels.REST_TEMPERATURE,
        device="cpu",
    ):
        single = Acquisition(noise=noise, film_every_step=film_every_step)
        state = np.zeros(single.nstate)
        single.reset(state, rest, temperature=temperature)
        seeds = [int(seed) + w for w in range(nworld)] if np.ndim(seed) == 0 else [int(s) for s in seed]
        if len(seeds) != nworld:
            raise ValueError(
                f"{len(seeds)} seeds for {nworld} worlds: pass one for each, or a single one from which "
                "they count on"
            )
        for s in (min(seeds), max(seeds)):
            Acquisition(seed=s)  # refuses what is out of range
        self.nworld, self.device = nworld, wp.get_device(device)
        self._noise, self._every = int(single.noise), int(single.film_every_step)
        with wp.ScopedDevice(self.device):
            self.seed = wp.array(np.array(seeds, np.uint64), dtype=wp.uint64)
            self._rest = wp.array(state, dtype=real)
            self.state = wp.array(np.tile(state, (nworld, 1)), dtype=real)
            self.time = wp.zeros(nworld, dtype=real)
            self.temperature = wp.full(nworld, temperature, dtype=real)
            self.due = wp.zeros(nworld, dtype=int)

    def reset(self, mask):
        """Puts the worlds of mask, (nworld,) wp.array of bool, back to rest at time zero."""
        wp.launch(
            reset_states, self.state.shape, [mask, self._rest], [self.time, self.state], device=self.device
        )

    def find_due(self, dt):
        """Writes which worlds want a new impedance for the step of dt [s] from now; returns `due`."""
        wp.launch(find_due, self.nworld, [self.time, dt, self._every], [self.due], device=self.device)
        return self.due

    def advance(self, dt, impedance, valid, pressure):
        """Samples the slots of a step and moves the clocks. Launches only: may be captured in a CUDA graph.

        Args:
          dt: length of the step [s].
          impedance: (nworld, 19) wp.array float64 at the end of the step [ohm], looked at in the worlds that
            are `due` and `valid`.
          valid: (nworld,) wp.array int.
          pressure: (nworld,) wp.array float64, of the liquid at the end of the step above rest [Pa].
        """
        inputs = [
            dt,
            self._noise,
            self.seed,
            self.due,
            valid,
            impedance,
            pressure,
            self.temperature,
            self.time,
            self.state,
        ]
        wp.launch(sample_slots, self.nworld, inputs, device=self.device)
