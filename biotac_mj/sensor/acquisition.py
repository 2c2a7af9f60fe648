"""From impedances, pressure and temperature to 12-bit counts, slot by slot, as the BioTac's multiplexer does
it.

One frame is 10 ms = 44 slots at 4.4 kHz, 0.227 ms apart. Even slots are PAC (22 per frame, 2.2 kHz); the 22
odd ones are e1..e19, PDC,
TAC, TDC, in this order, once per frame. Source of rates: SynTouch manual; which channel has which slot is not
  published: CHOSEN as above.

Slot k lies at time k / 4400 s, so what is sampled when depends on the time alone, never on the time step. All
memory lives in a flat state vector that the caller owns; noise is a function of (seed, slot), so a replay
from a saved state is bit-equal."""

import functools
import math

import numpy as np

from biotac_mj.sensor import channels

__all__ = ["Acquisition", "FRAME_TIME", "SLOTS_PER_FRAME", "SLOT_RATE"]

SLOT_RATE = 4400.0  # [Hz]
SLOTS_PER_FRAME = 44
_DRAWN = 1024  # slots whose noise is drawn at once
FRAME_TIME = SLOTS_PER_FRAME / SLOT_RATE  # [s]

_LOW_PASS, _HIGH_PASS, _TAC_LOW_PASS = (
    2 * np.pi * hertz for hertz in (1040.0, 10.0, 22.6)
)  # [rad/s], manual

# The state vector.
_IMPEDANCE = slice(0, 19)  # at _IMPEDANCE_TIME [ohm]
_PRESSURE, _TEMPERATURE, _IMPEDANCE_TIME = 19, 20, 21
_FILTER = slice(22, 25)  # pressure below 1040 Hz and below 10 Hz [Pa], heating below 22.6 Hz [C/s]
_HELD = slice(25, 47)  # counts of e1..e19, pdc, tac, tdc
_PAC = slice(47, 69)  # counts of the frame's 22 PAC slots
_PDC_CHANNEL, _TAC_CHANNEL, _TDC_CHANNEL = 19, 20, 21

_CORNER = np.array([_LOW_PASS, _HIGH_PASS, _TAC_LOW_PASS])
_BAND = _LOW_PASS / (
    _LOW_PASS - _HIGH_PASS
)  # s w2 / ((s + w1)(s + w2)) = band (w2 / (s + w2) - w1 / (s + w1))
_POSITION = np.arange(SLOTS_PER_FRAME)
_ELECTRODE = (_POSITION % 2 == 1) & (_POSITION < 38)  # whether a slot of the frame is an electrode's
_ADDRESS = (
    np.where(_POSITION % 2 == 1, _HELD.start, _PAC.start) + _POSITION // 2
)  # of a slot's count in the state


class Acquisition:
    """The multiplexer, its filters, its noise and its converter. Constant after construction; the state
    belongs to the caller.

    Every channel samples, at its slots, the signal interpolated linearly over the step that contains them,
    and holds the count until its next slot. The filters are first-order sections (PDC: low-pass 1040 Hz; PAC:
    band-pass 10-1040 Hz; TAC: low-pass 22.6 Hz), exact for that piecewise linear signal.

    Args:
      seed: of the noise, 0 .. 2**64 - 1; give every sensor its own.
      noise: False leaves quantisation only.
      film_every_step: see `needs_impedance`.

    Attributes:
      nstate: length of the state vector.
    """

    nstate = 69

    def __init__(self, seed=0, noise=True, film_every_step=False):
        if int(seed) != seed or not 0 <= seed < 2**64:
            raise ValueError(f"seed is {seed}: pass an integer from 0 to 2**64 - 1")
        self.seed, self.noise, self.film_every_step = int(seed), bool(noise), bool(film_every_step)

    def reset(self, state, impedance, pressure=0.0, temperature=channels.REST_TEMPERATURE, time=0.0):
        """Writes the steady state: every channel holds the noise-free count of these signals.

        Args:
          state: (nstate,) float64, written in place.
          impedance: (19,) [ohm]; pressure: above rest [Pa]; temperature: [C]; time: now [s].
        """
        self._check_state(state)
        state[_IMPEDANCE] = self._check_impedance(impedance)
        state[_PRESSURE], state[_TEMPERATURE] = self._check_scalars(pressure, temperature)
        state[_IMPEDANCE_TIME] = time
        state[_FILTER] = pressure, pressure, 0.0
        state[_HELD] = np.concatenate(
            [
                channels.counts_from_impedance(impedance),
                [
                    channels.counts_from_pressure(pressure),
                    channels.counts_from_heating(0.0),
                    channels.counts_from_temperature(temperature),
                ],
            ]
        )
        state[_PAC] = channels.counts_from_pac(0.0)
        state[_HELD.start :] = _quantise(state[_HELD.start :])

    def needs_impedance(self, state, time, dt):
        """Whether `advance` over (time, time + dt] wants a new impedance, so that the film need not be solved
        otherwise.

        By default once per frame: in the step that holds the frame's first electrode slot. Until the next
          solution the electrodes hold
        that impedance, so what e19 reads is up to one frame (10 ms) old, 5 ms on average: causal, and what
        makes a 0.1 ms step affordable. With `film_every_step` whenever an electrode slot falls into the step.
        """
        first, last = _slots(time, dt)
        if self.film_every_step:
            slot = np.arange(first, min(last, first + SLOTS_PER_FRAME) + 1) % SLOTS_PER_FRAME
            return bool(np.any((slot % 2 == 1) & (slot < 2 * 19)))
        return (last - 1) // SLOTS_PER_FRAME > (first - 2) // SLOTS_PER_FRAME

    def advance(self, state, time, dt, impedance=None, pressure=0.0, temperature=None):
        """Samples the slots in (time, time + dt].

        Args:
          state: (nstate,) float64, updated in place.
          time: at the start of the step [s]; dt: its length [s].
          impedance: (19,) at the end of the step [ohm]; None holds the last one (see `needs_impedance`).
          pressure: at the end of the step, above rest [Pa].
          temperature: of the core at the end of the step [C]; None keeps the last one.

        Raises:
          ValueError: wrong shape, not finite, impedance not positive, or dt not positive. The state is
            unchanged then.
        """
        self._check_state(state)
        if not (math.isfinite(time) and math.isfinite(dt) and dt > 0):
            raise ValueError(f"time is {time} and dt is {dt}: pass finite seconds, dt positive")
        if impedance is not None:
            impedance = self._check_impedance(impedance)
        new_pressure, new_temperature = self._check_scalars(
            pressure, state[_TEMPERATURE] if temperature is None else temperature
        )

        first, last = _slots(time, dt)
        slot = np.arange(first, last + 1)
        end = np.append(
            slot / SLOT_RATE - time, dt
        )  # the last entry is the end of the step: the filters' new memory
        since = end[:-1]
        heating = (new_temperature - state[_TEMPERATURE]) / dt
        old = np.array([state[_PRESSURE], state[_PRESSURE], heating])
        rise = (new_pressure - state[_PRESSURE]) / dt
        lag = np.array([rise / _LOW_PASS, rise / _HIGH_PASS, 0.0])
        # Exact response of w / (s + w) to the ramp old + rise t.
        filtered = (
            (old - lag)
            + (_CORNER * lag) * end[:, None]
            + (state[_FILTER] - old + lag) * np.exp(-_CORNER * end[:, None])
        )

        if len(slot):
            position = slot % SLOTS_PER_FRAME
            electrode = _ELECTRODE[position]
            value = self._signals(
                state,
                time,
                dt,
                impedance,
                position,
                electrode,
                since,
                filtered,
                state[_TEMPERATURE] + heating * since,
            )
            if self.noise:
                value += self._noise(first, electrode, value)
            # A step longer than a frame meets a channel more than once: numpy keeps the last assignment.
            state[_ADDRESS[position]] = _quantise(value)

        state[_FILTER] = filtered[-1]
        state[_PRESSURE], state[_TEMPERATURE] = new_pressure, new_temperature
        if impedance is not None:
            state[_IMPEDANCE], state[_IMPEDANCE_TIME] = impedance, time + dt

    def readings(self, state):
        """What the bus would report now.

        Returns:
          dict of counts: electrodes (19,) int, pdc int, pac (22,) int in the order of the frame's PAC slots,
            tac int, tdc int.
        """
        self._check_state(state)
        held = state[_HELD].astype(int)
        return {
            "electrodes": held[:19],
            "pdc": int(held[_PDC_CHANNEL]),
            "pac": state[_PAC].astype(int),
            "tac": int(held[_TAC_CHANNEL]),
            "tdc": int(held[_TDC_CHANNEL]),
        }

    def _signals(self, state, time, dt, impedance, position, electrode, since, filtered, temperature):
        """Noise-free counts (nslot,) of what each slot samples."""
        value = channels.counts_from_pac(_BAND * (filtered[:-1, 0] - filtered[:-1, 1]))
        channel = position[electrode] // 2
        now = state[_IMPEDANCE][channel]
        if impedance is not None:
            span = (
                time + dt - min(state[_IMPEDANCE_TIME], time)
            )  # a clock that was set back does not extrapolate
            now += (impedance[channel] - now) * (1 - (dt - since[electrode]) / span)
        value[electrode] = channels.counts_from_impedance(now)
        for which, convert, source in (
            (_PDC_CHANNEL, channels.counts_from_pressure, filtered[:, 0]),
            (_TAC_CHANNEL, channels.counts_from_heating, filtered[:, 2]),
            (_TDC_CHANNEL, channels.counts_from_temperature, temperature),
        ):
            start = (
                int(2 * which + 1 - position[0]) % SLOTS_PER_FRAME
            )  # this channel's first slot in the step
            if start < len(value):
                value[start::SLOTS_PER_FRAME] = convert(source[start : len(value) : SLOTS_PER_FRAME])
        return value

    def _noise(self, first, electrode, value):
        """White noise (nslot,)."""
        block, start = divmod(first, _DRAWN)
        normal = _normals(self.seed, block)[start : start + len(value)]
        while len(normal) < len(value):
            block += 1
            normal = np.append(normal, _normals(self.seed, block)[: len(value) - len(normal)])
        return np.where(electrode, channels.electrode_noise(value), channels.OTHER_NOISE) * normal

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
        if impedance.shape != (19,):
            raise ValueError(
                f"impedance has shape {impedance.shape}: pass (19,) [ohm], one per electrode e1..e19"
            )
        if not (impedance.min() > 0 and impedance.max() < np.inf):
            bad = [f"e{i + 1}" for i in np.flatnonzero(~(np.isfinite(impedance) & (impedance > 0)))]
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


@functools.lru_cache(maxsize=64)
def _normals(seed, block):
    """Standard normal draws (_DRAWN,) of a block of slots: one Philox counter per slot, whatever steps cut
    the time into."""
    raw = (
        np.random.Philox(key=seed, counter=block * _DRAWN % 2**64)
        .random_raw(4 * _DRAWN)
        .reshape(-1, 4)[:, :2]
    )
    uniform = ((raw >> np.uint64(11)) + 0.5) * 2.0**-53
    return np.sqrt(-2 * np.log(uniform[:, 0])) * np.cos(
        2 * np.pi * uniform[:, 1]
    )  # Box-Muller: a fixed number of draws per slot


def _slots(time, dt):
    """First and last slot in (time, time + dt]; the allowance keeps a slot on one side of a time that was
    summed up with rounding."""
    return math.floor(time * SLOT_RATE + 1e-6) + 1, math.floor((time + dt) * SLOT_RATE + 1e-6)


def _quantise(counts):
    return np.minimum(np.maximum(np.rint(counts), 0), channels.FULL_SCALE)
