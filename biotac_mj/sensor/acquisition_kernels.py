"""The multiplexer's state vector, and the kernels that sample a step's slots into it, of one sensor or many.

See `acquisition` for what the slots are. Noise is made of numpy's Philox 4x64 with one counter block for each
slot: a function of (seed, slot)."""

import math

import warp as wp

from biotac_mj.quiet import quiet_warp
from biotac_mj.sensor import channels
from biotac_mj.sensor.channels import NELECTRODE, NPAC
from biotac_mj.sensor.formulas import for_kernels
from biotac_mj.sensor.presets import MOST_LATENCY, NNUMBER, NUMBERS

quiet_warp()

__all__ = [
    "HELD", "HELD_PDC", "HELD_TAC", "HELD_TDC", "NSTATE", "OWN", "PAC", "SLOTS_PER_FRAME", "SLOT_RATE",
    "draw_normal", "find_due", "real", "reset_states", "sample_slots", "slots_until",
]  # fmt: skip

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
HISS = FILTER + 3
HELD = HISS + 1  # e1..e19, pdc, tac, tdc
HELD_PDC, HELD_TAC, HELD_TDC = HELD + NELECTRODE, HELD + NELECTRODE + 1, HELD + NELECTRODE + 2
PAC = HELD_TDC + 1  # the frame's slots
BEGAN = PAC + NPAC
GIVEN_PRESSURE, GIVEN_TEMPERATURE, LAG = BEGAN + 1, BEGAN + 2, BEGAN + 3
PAST = BEGAN + 4  # of each electrode what a low-pass remembers, then the last frames
FRAMES = round(MOST_LATENCY * SLOT_RATE / SLOTS_PER_FRAME) + 2
OWN = PAST + (1 + FRAMES) * NELECTRODE
NSTATE = OWN + NNUMBER
(
    SCALE, BASE, NOISE, WARM_SHARE, DRIFT, MIXING, MIXED, PDC_REST, PDC_GAIN, PDC_NOISE, PAC_REST,
    PAC_NOISE, PAC_COLOUR, TDC_NOISE, TAC_REST, TAC_NOISE, WARM_UP, WARM_TIME, RELAX_SHARE,
    RELAX_TIME, LOSS, PER_DEGREE, POWER, SATURATED, KNEE, LOWPASS, LATENCY,
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
    since = wp.max(time - state[w, BEGAN], real(0.0))
    return state[w, WARM_UP] * (real(1.0) - wp.exp(-since / state[w, WARM_TIME]))


@wp.func
def _warm_impedance(
    state: wp.array2d(dtype=real), impedance: wp.array2d(dtype=real), w: int, e: int, liquid: real,
    warmed: real, left: real,
):  # fmt: skip
    """Of an electrode where the liquid is warmer, and less is left of it [ohm]."""
    warmer = liquid + state[w, WARM_SHARE + e] * warmed
    return impedance[w, e] * state[w, SCALE + e] * wp.exp(-state[w, PER_DEGREE] * warmer) / left


@wp.func
def _electrode(state: wp.array2d(dtype=real), w: int, e: int, fresh: int, new: real, share: real):
    """Counts without noise of an electrode, at a share of the way to the new impedance."""
    z = state[w, e]
    if fresh == 1:
        z += (new - z) * share
    power = state[w, POWER]
    if power != real(1.0):
        rest = real(channels.DIVIDER) * (real(channels.FULL_SCALE) / state[w, BASE + e] - real(1.0))
        z = rest * wp.pow(z / rest, power)
    return _impedance_counts(z)


@wp.func
def _late(state: wp.array2d(dtype=real), w: int, e: int, slot: wp.int64, counts: real):
    """Counts of an electrode after its low-pass and its latency: a frame is linear to the next."""
    past = PAST + e
    tau = state[w, LOWPASS]
    value = counts
    if tau > real(0.0):
        keep = wp.exp(real(-_PERIOD) / tau)
        value = keep * state[w, past] + (real(1.0) - keep) * counts
        state[w, past] = value
    behind = state[w, LATENCY] / real(_PERIOD)
    if behind > real(0.0):
        frame = wp.int32((slot - wp.int64(1)) / _FRAME) % FRAMES + FRAMES
        state[w, past + (1 + frame % FRAMES) * NELECTRODE] = value
        whole = wp.int32(behind)
        part = behind - real(whole)
        newer = state[w, past + (1 + (frame - whole) % FRAMES) * NELECTRODE]
        older = state[w, past + (1 + (frame - whole - 1) % FRAMES) * NELECTRODE]
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
    keep = wp.exp(-dt / state[w, RELAX_TIME])
    lag = keep * state[w, LAG] + (real(1.0) - keep) * state[w, RELAX_TIME] / dt * (
        pressure[w] - state[w, GIVEN_PRESSURE]
    )
    felt = pressure[w] + state[w, RELAX_SHARE] * lag
    old = state[w, PRESSURE]
    rise = (felt - old) / dt
    warmed = _warmed(state, w, now + dt)
    warm = state[w, TEMPERATURE]
    heating = (temperature[w] + warmed - warm) / dt
    age = wp.max(now + dt - state[w, BEGAN], real(0.0))
    left = wp.max(real(1.0) - state[w, LOSS] * age / real(3600.0), real(1.0 - _MOST_LOSS))
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
        value = _pac_counts(sound) - real(channels.PAC_REST) + state[w, PAC_REST]
        deviation = state[w, PAC_NOISE]
        if position % 2 == 1:
            address = HELD + channel
            if channel < NELECTRODE:
                share = real(1.0) - (dt - since) / span
                new = _warm_impedance(state, impedance, w, channel, liquid[w], warmed, left)
                value = _electrode(state, w, channel, fresh, new, share)
                base = state[w, BASE + channel]
                change = value - base
                if state[w, MIXED] != real(0.0):
                    change = real(0.0)
                    row = MIXING + channel * NELECTRODE
                    for e in range(NELECTRODE):
                        if state[w, row + e] != real(0.0):
                            new = _warm_impedance(state, impedance, w, e, liquid[w], warmed, left)
                            other = _electrode(state, w, e, fresh, new, share)
                            change += state[w, row + e] * (other - state[w, BASE + e])
                shown = _saturated(change, state[w, SATURATED], state[w, KNEE])
                value = _late(state, w, channel, slot, base + shown)
                value += state[w, DRIFT + channel] * wp.max(now + since - state[w, BEGAN], real(0.0))
                deviation = state[w, NOISE + channel] * _electrode_noise(value)
            elif address == HELD_PDC:
                change = _pressure_counts(fast) - real(channels.PDC_REST)
                value = state[w, PDC_REST] + state[w, PDC_GAIN] * change
                deviation = state[w, PDC_NOISE]
            elif address == HELD_TAC:
                rate = _ramp(heating, real(0.0), tac, real(_TAC), since)
                value = _thermistor_counts(_heating_exponent(rate))
                value += state[w, TAC_REST] - real(channels.TAC_REST)
                deviation = state[w, TAC_NOISE]
            else:
                value = _thermistor_counts(_temperature_exponent(warm + heating * since))
                deviation = state[w, TDC_NOISE]
        if noise == 1:
            hiss = deviation * draw_normal(slot, seed[w])
            if position % 2 == 0:
                hiss += state[w, PAC_COLOUR] * state[w, HISS]
                state[w, HISS] = hiss
            value += hiss
        # a step longer than a frame meets a channel more than once: the last one stays
        state[w, address] = wp.clamp(wp.rint(value), real(0.0), real(channels.FULL_SCALE))
    state[w, FILTER] = _ramp(old, rise, low, real(_LOW), dt)
    state[w, FILTER + 1] = _ramp(old, rise, high, real(_HIGH), dt)
    state[w, FILTER + 2] = _ramp(heating, real(0.0), tac, real(_TAC), dt)
    state[w, PRESSURE] = felt
    state[w, TEMPERATURE] = temperature[w] + warmed
    state[w, GIVEN_PRESSURE] = pressure[w]
    state[w, GIVEN_TEMPERATURE] = temperature[w]
    state[w, LAG] = lag
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
    temperature_out[w] = rest[row, GIVEN_TEMPERATURE]
