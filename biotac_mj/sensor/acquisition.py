"""Converts impedances, pressure and temperature to 12-bit counts, slot by slot as the BioTac's multiplexer
does.

One frame of a BioTac is 10 ms = 44 slots at 4.4 kHz, 0.227 ms apart. Even slots are PAC (22 per frame, 2.2
kHz). The 22 odd ones are e1..e19, PDC, TAC, TDC, in this order, once per frame. Other designs have other
frames (`Design.slots`). The rates are from the SynTouch manual; the order of channels is not published:
CHOSEN as above.

Slot k = 1, 2, ... is at time k / 4400 s, so sampling times do not depend on the time step, and a reading at a
multiple of a frame is one whole frame in the order of its slots. One state vector per sensor holds all
memory, and noise is a function of (seed, slot), so a replay from a saved state is bit-equal.

`Acquisition` is one multiplexer whose state the caller owns. `BatchAcquisition` holds those of many worlds on
their device. Both launch the kernels of `acquisition_kernels`."""

import functools
import math
import threading

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from biotac_mj.sensor import acquisition_kernels as kernels
from biotac_mj.sensor import channels
from biotac_mj.sensor.acquisition_kernels import place_of, real
from biotac_mj.sensor.presets import SENSORS, Sensor

from ..fields import as_whole
from ..geometry.design import BIOTAC, Design
from ..launches import recorded


class Acquisition:
    """The multiplexer, its filters, its noise and its converter. Constant after construction; the caller owns
    the state.

    Every channel samples, at its slots, the signal interpolated linearly over the step that contains them,
    and holds the count until its next slot. The filters are first-order sections (PDC: low-pass 1040 Hz; PAC:
    band-pass 10-1040 Hz; TAC: the temperature's rate, low-pass 0.25 Hz), exact for that piecewise linear
    signal.

    Args:
      seed: of the noise, 0 .. 2**64 - 1; give every sensor its own.
      noise: False keeps quantisation only.
      film_every_step: see `needs_impedance`.
      sensor: preset whose constants `reset` writes into the state.
      film_rest: (n,) impedances of the film at rest [ohm]; None: this sensor's own.
      heat: whether a heat model (`sensor.heat`) computes the warm-up.
      design: of the sensor; n is its number of electrodes.

    Attributes:
      nstate: length of the state vector. place: offsets of its fields.

    Raises:
      ValueError: the seed is out of range.
    """

    def __init__(
        self,
        seed: int = 0,
        noise: bool = True,
        film_every_step: bool = False,
        sensor: Sensor = SENSORS["1"],
        film_rest: ArrayLike | None = None,
        heat: bool = False,
        design: Design = BIOTAC,
    ):
        self.seed = as_whole("seed", seed, 0, 2**64 - 1)
        self.noise, self.film_every_step = bool(noise), bool(film_every_step)
        self.sensor, self.design, self.place = sensor, design, place_of(design)
        self.nstate = self.place.nstate
        self._film_rest, self._heat = film_rest, heat
        self._own = sensor.numbers(film_rest, heat)

    def of(self, sensor: Sensor) -> "Acquisition":
        """The same multiplexer for another sensor."""
        more = self.film_every_step, sensor, self._film_rest, self._heat
        return Acquisition(self.seed, self.noise, *more, self.design)

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
          impedance: (n,) [ohm]; pressure: above rest [Pa]; temperature: [C], None: the sensor's; time: now
            [s]; liquid: temperature above that of the impedances [C].
        """
        self._check_state(state)
        at, n = self.place, self.place.nelectrode
        temperature = self.sensor.temperature if temperature is None else temperature
        state[at.own :], state[at.began] = self._own, time
        z = (
            self._check_impedance(impedance)
            * state[at.scale : at.base]
            * math.exp(-state[at.per_degree] * liquid)
        )
        state[at.impedance : at.impedance + n] = z
        state[at.pressure], state[at.temperature] = self._check_scalars(pressure, temperature)
        state[at.given_pressure : at.relaxed] = pressure, temperature
        state[at.relaxed] = 0.0
        state[at.impedance_time] = time
        state[at.filter : at.sampled] = pressure, pressure, 0.0, 0.0
        base = state[at.base : at.noise]
        rest = channels.impedance_from_counts(base)
        change = channels.counts_from_impedance(rest * (z / rest) ** state[at.power]) - base
        change = state[at.mixing : at.mixed].reshape(n, n) @ change
        change = channels.saturated(change, state[at.saturated], state[at.knee])
        state[at.sampled : at.pdc] = base + change
        state[at.past : at.own] = np.tile(base + change, 1 + at.frames)
        change = channels.counts_from_pressure(pressure) - channels.PDC_REST
        state[at.pdc] = state[at.pdc_rest] + state[at.pdc_gain] * change
        state[at.tac] = state[at.tac_rest]
        state[at.tdc] = channels.counts_from_temperature(temperature)
        state[at.pac : at.began] = state[at.pac_rest]
        state[at.sampled : at.began] = np.clip(np.rint(state[at.sampled : at.began]), 0, channels.FULL_SCALE)

    def needs_impedance(self, state: np.ndarray, time: float, dt: float) -> bool:
        """Whether `advance` over (time, time + dt] needs a new impedance; otherwise the film need not be
        solved.

        By default once per frame: in the step that contains the frame's first electrode slot. The electrodes
        keep that impedance until the next solution, so the last electrode's is up to one frame (10 ms) old, 5
        ms on average. This is causal and makes a 0.1 ms step affordable. With `film_every_step`, every step
        that contains an electrode slot.
        """
        return _one(self.design).find_due(time, dt, self.film_every_step)

    def advance(
        self,
        state: np.ndarray,
        time: float,
        dt: float,
        impedance: ArrayLike | None = None,
        pressure: float | None = 0.0,
        temperature: float | None = None,
        shaken: wp.array | None = None,
        liquid: float = 0.0,
    ) -> None:
        """Samples the slots in (time, time + dt].

        Args:
          state: (nstate,) float64, updated in place.
          time: at the start of the step [s]; dt: its length [s].
          impedance: (n,) at the end of the step [ohm]; None holds the last one (see `needs_impedance`).
          pressure: at the end of the step, above rest [Pa]; temperature: of the core then [C]; None keeps
            the last one.
          shaken: (1, n) float64 on the CPU, further band-passed pressure on PAC at each of the slots [Pa]
            (`vibration`).
          liquid: temperature at the end of the step above that of the impedances [C].

        Raises:
          ValueError: wrong shape, not finite, impedance not positive, or dt not positive. The state is
            unchanged then.
        """
        self._check_state(state)
        if not (math.isfinite(time) and math.isfinite(dt) and dt > 0):
            raise ValueError(f"time is {time} and dt is {dt}: pass finite seconds, dt positive")
        if impedance is not None:
            impedance = self._check_impedance(impedance)
        pressure = state[self.place.given_pressure] if pressure is None else pressure
        temperature = state[self.place.given_temperature] if temperature is None else temperature
        signals = self._check_scalars(pressure, temperature)
        _one(self.design).sample(self.seed, self.noise, state, time, dt, impedance, *signals, liquid, shaken)

    def readings(self, state: np.ndarray) -> dict:
        """Counts that the bus would report now.

        Returns:
          dict of counts: electrodes (n,) int, pdc int, pac (npac,) int in the order of the frame's PAC slots,
            tac int, tdc int.
        """
        self._check_state(state)
        sampled, at = state.astype(int), self.place
        return {
            "electrodes": sampled[at.sampled : at.pdc],
            "pdc": int(sampled[at.pdc]),
            "pac": sampled[at.pac : at.began],
            "tac": int(sampled[at.tac]),
            "tdc": int(sampled[at.tdc]),
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

    def _check_impedance(self, impedance):
        impedance, names = np.asarray(impedance, dtype=float), self.design.electrodes
        if impedance.shape != (len(names),):
            raise ValueError(
                f"impedance has shape {impedance.shape}: pass ({len(names)},) [ohm], one per electrode "
                f"{names[0]}..{names[-1]}"
            )
        if not (impedance.min(initial=1.0) > 0 and impedance.max(initial=1.0) < np.inf):
            bad = [names[i] for i in np.flatnonzero(~(np.isfinite(impedance) & (impedance > 0)))]
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
    """One world's CPU arrays and recorded launches, one set per thread; every `Acquisition` fills them and
    reads them back."""

    def __init__(self, design):
        at = place_of(design)
        self._time, self._pressure, self._temperature, self._liquid = (
            wp.zeros(1, dtype=real, device="cpu") for _ in "tpTl"
        )
        self._due, self._seed = (
            wp.zeros(1, dtype=int, device="cpu"),
            wp.zeros(1, dtype=wp.uint64, device="cpu"),
        )
        self._impedance = wp.zeros((1, at.nelectrode), dtype=real, device="cpu")
        self._state = wp.zeros((1, at.nstate), dtype=real, device="cpu")
        self.time, self.pressure, self.temperature, self.liquid, self.due, self.seed = (
            array.numpy()
            for array in (
                self._time, self._pressure, self._temperature, self._liquid, self._due, self._seed
            )
        )  # fmt: skip
        self.impedance, self.state = self._impedance.numpy()[0], self._state.numpy()[0]
        valid = wp.ones(1, dtype=int, device="cpu")
        self._at, self._still = at, wp.zeros((1, 0), dtype=real, device="cpu")
        self._signals = [self._due, valid, self._impedance, self._pressure, self._temperature]
        self._signals.append(self._liquid)
        self._found, self._sampled = {}, {}  # launches by the numbers that they have

    def find_due(self, time, dt, every_step):
        self.time[0] = time
        if (dt, every_step) not in self._found:
            known = [self._time, dt, int(every_step), self._at.nelectrode, self._at.slots]
            self._found = {(dt, every_step): recorded(kernels.find_due, 1, known, [self._due])}
        self._found[dt, every_step]()
        return bool(self.due[0])

    def sample(self, seed, noise, state, time, dt, impedance, pressure, temperature, liquid, shaken):
        shaken = self._still if shaken is None else shaken
        key = dt, noise, id(shaken)
        if key not in self._sampled:
            known = [self._at, dt, _noise(noise, self._seed), *self._signals, shaken]
            made = recorded(kernels.sample_slots, 1, known, [self._time, self._state])
            self._sampled = {key: made}
        self.state[:] = state
        self.seed[0], self.time[0], self.pressure[0], self.temperature[0] = seed, time, pressure, temperature
        self.liquid[0], self.due[0] = liquid, impedance is not None
        if impedance is not None:
            self.impedance[:] = impedance
        self._sampled[key]()
        state[:] = self.state


def _noise(on, seed):
    made = kernels.Noise()
    made.on, made.seed = int(bool(on)), seed
    return made


_mine = threading.local()


def _one(design):
    """This thread's `_One` for a design, made on first use, which compiles the kernels."""
    if not hasattr(_mine, "ones"):
        _mine.ones = {}
    if design not in _mine.ones:
        _mine.ones[design] = _One(design)
    return _mine.ones[design]


class BatchAcquisition:
    """The multiplexers of `nworld` sensors on one device, each with its own clock and seed. Each world's
    counts, including noise, equal those of a single sensor with its seed.

    Args:
      rest: (n,) impedance of the film at rest [ohm], the initial state of every world.
      nworld: number of worlds.
      seed: of world 0, world w has seed + w; or (nworld,) seeds, 0 .. 2**64 - 1.
      noise: False keeps quantisation only.
      film_every_step: see `Acquisition.needs_impedance`.
      temperature: of the core at rest [C]; None: each sensor's own. liquid: initial temperature of the liquid
        above that of the impedances [C]. One, or one for each sensor.
      sensor: of all worlds, or a list of one per world. With `redraw` the list may be longer, and every later
        reset draws from it by seed and reset count.
      heat, design: see `Acquisition`.
      device: Warp device.

    Attributes:
      place: see `Acquisition`.
      state: (nworld, nstate) wp.array float64, each row the state vector of an `Acquisition`.
      time: (nworld,) wp.array float64 [s], each sensor's clock, zero at its reset.
      temperature: (nworld,) wp.array float64, of the core at the end of the next step [C].
      liquid: (nworld,) wp.array float64, temperature of the liquid above that of the impedances [C].
      due: (nworld,) wp.array int, written by `find_due`.
      row: (nworld,) wp.array int, index of each world's sensor in the list. rest_states: (n, nstate) wp.array
        float64, initial states of the sensors of the list.
      seed: (nworld,) wp.array uint64. drawn: (nworld,) wp.array int, number of resets; redraws: 1 if resets
        draw a sensor.

    Raises:
      ValueError: a seed out of range, or a number of seeds or sensors that does not fit `nworld`.
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
        design: Design = BIOTAC,
    ):
        sensors = [sensor] * (1 if redraw else nworld) if isinstance(sensor, Sensor) else list(sensor)
        if not redraw and len(sensors) != nworld:
            raise ValueError(
                f"{len(sensors)} sensors for {nworld} worlds: pass one for each, or a single one"
            )
        self.place = place_of(design)
        self._film_rest, self._heat, self._design, n = rest, heat, design, len(sensors)
        warm = [None if temperature is None else float(t) for t in np.broadcast_to(temperature, n)]
        rest_state = functools.cache(self.rest_state)  # equal sensors are many
        rows = [*map(rest_state, sensors, warm, np.broadcast_to(liquid, n).tolist())]
        seeds = [int(seed) + w for w in range(nworld)] if np.ndim(seed) == 0 else [int(s) for s in seed]
        if len(seeds) != nworld:
            raise ValueError(
                f"{len(seeds)} seeds for {nworld} worlds: pass one for each, or a single one from which "
                "they count on"
            )
        for s in (min(seeds), max(seeds)):
            Acquisition(seed=s)  # refuses what is out of range
        self.nworld, self.device = nworld, wp.get_device(device)
        self._every, self.redraws = int(bool(film_every_step)), int(redraw)
        with wp.ScopedDevice(self.device):
            self.seed = wp.array(np.array(seeds, np.uint64), dtype=wp.uint64)
            self._noise = _noise(noise, self.seed)
            self.rest_states = wp.array(np.array(rows), dtype=real)
            self.drawn, self.row = (wp.zeros(nworld, dtype=int) for _ in range(2))
            self.state = wp.zeros((nworld, self.place.nstate), dtype=real)
            self.time, self.temperature, self.liquid = (wp.zeros(nworld, dtype=real) for _ in range(3))
            self.due = wp.zeros(nworld, dtype=int)
            self._still = wp.zeros((nworld, 0), dtype=real)
            self.reset(wp.full(nworld, True, dtype=bool))
            self.drawn.zero_()  # the owner's first reset is the beginning and draws nothing

    def rest_state(self, sensor: Sensor, temperature: float | None = None, liquid: float = 0.0) -> np.ndarray:
        """(nstate,) initial state of a sensor; temperature, liquid: see the class."""
        row, rest = np.zeros(self.place.nstate), self._film_rest
        single = Acquisition(sensor=sensor, film_rest=rest, heat=self._heat, design=self._design)
        single.reset(row, rest, temperature=temperature, liquid=liquid)
        return row

    def reset(self, mask: wp.array) -> None:
        """Resets the worlds of mask, (nworld,) wp.array of bool, to rest at time zero."""
        inputs = [self.place, mask, self.rest_states, self.redraws, self.seed, self.drawn]
        outputs = [self.row, self.time, self.temperature, self.state]
        wp.launch(kernels.reset_states, self.nworld, inputs, outputs, device=self.device)

    def find_due(self, dt: float) -> wp.array:
        """Marks the worlds that need a new impedance for the next step of dt [s]; returns `due`."""
        inputs = [self.time, dt, self._every, self.place.nelectrode, self.place.slots]
        wp.launch(kernels.find_due, self.nworld, inputs, [self.due], device=self.device)
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
          impedance: (nworld, n) wp.array float64 at the end of the step [ohm], used in worlds that are `due`
            and `valid`.
          valid: (nworld,) wp.array int.
          pressure: (nworld,) wp.array float64, of the liquid at the end of the step above rest [Pa].
          shaken: (nworld, n) wp.array float64, see `Acquisition.advance`.
        """
        inputs = [self.place, dt, self._noise, self.due, valid, impedance, pressure]
        inputs += [self.temperature, self.liquid, self._still if shaken is None else shaken]
        wp.launch(kernels.sample_slots, self.nworld, inputs, [self.time, self.state], device=self.device)
