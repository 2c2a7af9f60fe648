"""The multiplexer's state vector, and the kernels that sample a step's slots, for one sensor or many.

`acquisition` describes the slots. Noise is numpy's Philox 4x64 with one counter block for each slot: a
function of (seed, slot)."""

import functools
import math

import warp as wp

from biotac_mj.geometry.design import BIOTAC, Design
from biotac_mj.quiet import quiet_warp
from biotac_mj.sensor import channels
from biotac_mj.sensor.formulas import for_kernels
from biotac_mj.sensor.presets import MOST_LATENCY, numbers_of

from ..kernels import kernel_module

quiet_warp()

kernel_module(__name__)

SLOT_RATE = 4400.0  # [Hz]

# The state vector: the electrodes' impedances [ohm] at IMPEDANCE_TIME, the last step's pressure [Pa] and
# temperature [C]; filters: pressure below 1040 Hz and below 10 Hz [Pa], heating below 0.25 Hz [C/s]; PAC's
# last noise; counts; time of the reset [s], the last step's pressure and temperature, the state of PDC's
# relaxation [Pa]; per electrode the state of its low-pass and its last frames; the sensor's own constants, so
# that a reset may change them.
_HEAD = ("pressure", "temperature", "impedance_time", "filter", "hiss")
_BEGAN = ("began", "given_pressure", "given_temperature", "relaxed")


def _widths(n, frames, npac, nnumber):
    """Numbers of each field of the state vector, in order."""
    widths = {"impedance": n, **dict.fromkeys(_HEAD, 1), "filter": 3}
    widths |= {"sampled": n, "pdc": 1, "tac": 1, "tdc": 1, "pac": npac}
    return widths | {**dict.fromkeys(_BEGAN, 1), "past": (1 + frames) * n, "own": nnumber}


@wp.struct
class Place:
    """Offsets of the fields of a state vector (`place_of`) and of the sensor's constants, `nstate`, and the
    layout of a frame."""

    __annotations__ = dict.fromkeys(
        ("nelectrode", "slots", "frames", *_widths(0, 0, 0, 0), *numbers_of(0)[0], "nstate"), int
    )


@wp.struct
class Noise:
    """Noise of all worlds: whether there is any, 0 or 1, and each world's seed."""

    on: int
    seed: wp.array(dtype=wp.uint64)


@functools.cache
def place_of(design: Design) -> Place:
    """Offsets of the fields of the state of a sensor of this design."""
    n, place = design.nelectrode, Place()
    place.nelectrode, place.slots = n, design.slots
    place.frames = round(MOST_LATENCY * SLOT_RATE / design.slots) + 2
    numbers, nnumber = numbers_of(n)
    at = 0
    for name, width in _widths(n, place.frames, design.npac, nnumber).items():
        setattr(place, name, at)
        at += width
    place.nstate = at
    for name, inside in numbers.items():
        setattr(place, name, place.own + inside)
    return place


SLOTS_PER_FRAME = BIOTAC.slots
# for a BioTac's state
_AT = place_of(BIOTAC)
SAMPLED, SAMPLED_PDC, SAMPLED_TAC, SAMPLED_TDC, PAC, OWN, NSTATE = (
    getattr(_AT, name) for name in ("sampled", "pdc", "tac", "tdc", "pac", "own", "nstate")
)
_MOST_LOSS = 0.8  # fraction of the liquid

# [rad/s], from the manual. TAC is a band-pass: the temperature's rate, low-passed at 0.25 Hz. The manual also
# says 0.45 Hz; recorded TACs then have an unexplained 9.0 counts RMS, at 0.25 Hz 7.0
# (`benchmarks/thermal.py`).
_LOW, _HIGH, _TAC = (2 * math.pi * hertz for hertz in (1040.0, 10.0, 0.25))
_BAND = _LOW / (_LOW - _HIGH)  # s w2 / ((s + w1)(s + w2)) = band (w2 / (s + w2) - w1 / (s + w1))

real = wp.float64
block = wp.types.vector(4, wp.uint64)

_impedance_counts = for_kernels(channels.counts_from_impedance)
_pressure_counts = for_kernels(channels.counts_from_pressure)
_saturated = for_kernels(channels.saturated)
_pac_counts = for_kernels(channels.counts_from_pac)
_thermistor_counts = for_kernels(channels.thermistor_counts)
_heating_exponent = for_kernels(channels.heating_exponent)
_temperature_exponent = for_kernels(channels.temperature_exponent)
_electrode_noise = for_kernels(channels.electrode_noise)


@wp.func
def slots_until(time: real):
    """Number of slots up to a time, without slot 0. The tolerance keeps a slot on one side of a time that was
    summed with rounding errors."""
    return wp.int64(wp.floor(time * real(SLOT_RATE) + real(1.0e-6)))


@wp.func
def _position(slot: wp.int64, slots: int):
    """Position of a slot in its frame; time may be negative."""
    position = wp.int32((slot - wp.int64(1)) % wp.int64(slots))
    return wp.where(position < 0, position + slots, position)


@wp.kernel
def find_due(
    # In:
    time: wp.array(dtype=real),
    dt: real,
    every_step: int,
    nelectrode: int,
    slots: int,
    # Out:
    due_out: wp.array(dtype=int),
):
    """`Acquisition.needs_impedance` of each world."""
    w = wp.tid()
    before = slots_until(time[w])
    count = wp.int32(slots_until(time[w] + dt) - before)
    due = int(0)
    if every_step == 1:
        for k in range(1, wp.min(count, slots) + 1):
            position = _position(before + wp.int64(k), slots)
            if position % 2 == 1 and position < 2 * nelectrode:
                due = 1
    elif slots - _position(before - wp.int64(1), slots) <= count:
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
    """Block `counter` of Philox 4x64-10 (Salmon et al., SC 2011) with this key, whose upper words are
    zero."""
    c0 = counter
    c1 = wp.where(counter == wp.uint64(0), wp.uint64(1), wp.uint64(0))  # numpy's carry, before slot 0
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
    raw = philox(wp.uint64(slot) + wp.uint64(1), seed)  # numpy increments before it draws
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
def _warmed(at: Place, state: wp.array2d(dtype=real), w: int, time: real):
    """Temperature above that of the reset [C]."""
    since = wp.max(time - state[w, at.began], real(0.0))
    return state[w, at.warm_up] * (real(1.0) - wp.exp(-since / state[w, at.warm_time]))


@wp.func
def _warm_impedance(
    at: Place, state: wp.array2d(dtype=real), impedance: wp.array2d(dtype=real), w: int, e: int, liquid: real,
    warmed: real, remaining: real,
):  # fmt: skip
    """Impedance of an electrode [ohm] for a warmer liquid and a lost fraction of it."""
    warmer = liquid + state[w, at.warm_share + e] * warmed
    return impedance[w, e] * state[w, at.scale + e] * wp.exp(-state[w, at.per_degree] * warmer) / remaining


@wp.func
def _electrode(at: Place, state: wp.array2d(dtype=real), w: int, e: int, fresh: int, new: real, weight: real):
    """Noise-free counts of an electrode, interpolated towards the new impedance by `weight`."""
    z = state[w, at.impedance + e]
    if fresh == 1:
        z += (new - z) * weight
    power = state[w, at.power]
    if power != real(1.0):
        rest = real(channels.DIVIDER) * (real(channels.FULL_SCALE) / state[w, at.base + e] - real(1.0))
        z = rest * wp.pow(z / rest, power)
    return _impedance_counts(z)


@wp.func
def _late(at: Place, state: wp.array2d(dtype=real), w: int, e: int, slot: wp.int64, counts: real):
    """Counts of an electrode after its low-pass and its latency, linear between frames."""
    past = at.past + e
    period = real(at.slots) / real(SLOT_RATE)  # [s] of a frame
    tau = state[w, at.lowpass]
    value = counts
    if tau > real(0.0):
        keep = wp.exp(-period / tau)
        value = keep * state[w, past] + (real(1.0) - keep) * counts
        state[w, past] = value
    behind = state[w, at.latency] / period
    if behind > real(0.0):
        frame = wp.int32((slot - wp.int64(1)) / wp.int64(at.slots)) % at.frames + at.frames
        state[w, past + (1 + frame % at.frames) * at.nelectrode] = value
        whole = wp.int32(behind)
        fraction = behind - real(whole)
        newer = state[w, past + (1 + (frame - whole) % at.frames) * at.nelectrode]
        older = state[w, past + (1 + (frame - whole - 1) % at.frames) * at.nelectrode]
        value = newer + fraction * (older - newer)
    return value


@wp.kernel
def sample_slots(
    # In:
    at: Place,
    dt: real,
    noise: Noise,
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
    # no extrapolation if the clock was set back
    span = now + dt - wp.min(state[w, at.impedance_time], now)
    keep = wp.exp(-dt / state[w, at.relax_time])
    relaxed = keep * state[w, at.relaxed] + (real(1.0) - keep) * state[w, at.relax_time] / dt * (
        pressure[w] - state[w, at.given_pressure]
    )
    felt = pressure[w] + state[w, at.relax_fraction] * relaxed
    old = state[w, at.pressure]
    rise = (felt - old) / dt
    warmed = _warmed(at, state, w, now + dt)
    warm = state[w, at.temperature]
    heating = (temperature[w] + warmed - warm) / dt
    age = wp.max(now + dt - state[w, at.began], real(0.0))
    remaining = wp.max(real(1.0) - state[w, at.loss] * age / real(3600.0), real(1.0 - _MOST_LOSS))
    low = state[w, at.filter]
    high = state[w, at.filter + 1]
    tac = state[w, at.filter + 2]
    below = real(_LOW)
    above = real(_HIGH)
    slow = real(_TAC)
    before = slots_until(now)
    for k in range(1, wp.int32(slots_until(now + dt) - before) + 1):
        slot = before + wp.int64(k)
        since = real(slot) / real(SLOT_RATE) - now
        position = _position(slot, at.slots)
        channel = position / 2
        address = at.pac + channel
        fast = _ramp(old, rise, low, below, since)
        sound = real(_BAND) * (fast - _ramp(old, rise, high, above, since))
        if k <= shaken.shape[1]:
            sound += shaken[w, k - 1]
        value = _pac_counts(sound) - real(channels.PAC_REST) + state[w, at.pac_rest]
        deviation = state[w, at.pac_noise]
        if position % 2 == 1:
            if at.sampled + channel >= at.pac:  # a slot without channel
                continue
            address = at.sampled + channel
            if channel < at.nelectrode:
                weight = real(1.0) - (dt - since) / span
                new = _warm_impedance(at, state, impedance, w, channel, liquid[w], warmed, remaining)
                value = _electrode(at, state, w, channel, fresh, new, weight)
                base = state[w, at.base + channel]
                change = value - base
                if state[w, at.mixed] != real(0.0):
                    change = real(0.0)
                    row = at.mixing + channel * at.nelectrode
                    for e in range(at.nelectrode):
                        if state[w, row + e] != real(0.0):
                            new = _warm_impedance(at, state, impedance, w, e, liquid[w], warmed, remaining)
                            other = _electrode(at, state, w, e, fresh, new, weight)
                            change += state[w, row + e] * (other - state[w, at.base + e])
                saturated = _saturated(change, state[w, at.saturated], state[w, at.knee])
                value = _late(at, state, w, channel, slot, base + saturated)
                value += state[w, at.drift + channel] * wp.max(now + since - state[w, at.began], real(0.0))
                deviation = state[w, at.noise + channel] * _electrode_noise(value)
            elif address == at.pdc:
                change = _pressure_counts(fast) - real(channels.PDC_REST)
                value = state[w, at.pdc_rest] + state[w, at.pdc_gain] * change
                deviation = state[w, at.pdc_noise]
            elif address == at.tac:
                rate = _ramp(heating, real(0.0), tac, slow, since)
                value = _thermistor_counts(_heating_exponent(rate))
                value += state[w, at.tac_rest] - real(channels.TAC_REST)
                deviation = state[w, at.tac_noise]
            else:
                value = _thermistor_counts(_temperature_exponent(warm + heating * since))
                deviation = state[w, at.tdc_noise]
        if noise.on == 1:
            hiss = deviation * draw_normal(slot, noise.seed[w])
            if position % 2 == 0:
                hiss += state[w, at.pac_colour] * state[w, at.hiss]
                state[w, at.hiss] = hiss
            value += hiss
        # in a step longer than a frame a channel is sampled more than once: the last sample counts
        state[w, address] = wp.clamp(wp.rint(value), real(0.0), real(channels.FULL_SCALE))
    state[w, at.filter] = _ramp(old, rise, low, below, dt)
    state[w, at.filter + 1] = _ramp(old, rise, high, above, dt)
    state[w, at.filter + 2] = _ramp(heating, real(0.0), tac, slow, dt)
    state[w, at.pressure] = felt
    state[w, at.temperature] = temperature[w] + warmed
    state[w, at.given_pressure] = pressure[w]
    state[w, at.given_temperature] = temperature[w]
    state[w, at.relaxed] = relaxed
    if fresh == 1:
        for e in range(at.nelectrode):
            state[w, at.impedance + e] = _warm_impedance(
                at, state, impedance, w, e, liquid[w], warmed, remaining
            )
        state[w, at.impedance_time] = now + dt
    time[w] = now + dt


@wp.kernel
def reset_states(
    # In:
    at: Place,
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
    """Initial states of worlds: row w of `rest`, or, with `redraw` and after the first reset, a row drawn by
    seed and reset count."""
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
    temperature_out[w] = rest[row, at.given_temperature]
