"""What a BioTac on this skin would report: film conduction and acquisition tied together, for a step and for
stored motions."""

import numpy as np

from biotac_mj.fields import check_entries, refuse_unknown
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.sensor.acquisition import Acquisition
from biotac_mj.sensor.channels import REST_COUNTS, REST_TEMPERATURE
from biotac_mj.sensor.film import FilmConduction
from biotac_mj.sensor.heat import LIQUID, THERMISTOR, Heat, HeatParameters, electrode_factor
from biotac_mj.sensor.materials import Material
from biotac_mj.sensor.vibration import Vibration

__all__ = ["PhysicsReadings", "check_settings", "record"]

_SETTINGS = {"noise": bool, "sensor": str, "film_every_step": bool, "temperature": float}


class PhysicsReadings:
    """Counts of all channels from the deformed skin and the liquid's pressure. Constant: the state belongs to
    the caller.

    Args:
      geometry: the skin.
      seed: of the noise; give every sensor its own.
      noise: False leaves quantisation only.
      sensor: "1" | "2" | "3", whose published rest counts the electrodes show at rest.
      film_every_step: solve the film in every step that samples an electrode, not once per 10 ms frame (see
      `Acquisition.needs_impedance`).
      temperature: of the core at rest [C]; without `bodies` it is steady, TDC constant and TAC at mid-scale
        but for noise.
      bodies: of what is made what may touch, one of each body; the sensor then has a heat of its own
        (`sensor.heat`), which moves TDC, TAC and, with the liquid's temperature, all electrodes. None: it has
        none.
      cold: the sensor is switched on at the reset: it begins at the temperature around it and warms up.
      film: a FilmConduction to share between sensors of the same geometry; None builds one.
      vibration: of one sensor on the CPU, for what PAC feels of textures, taps and stick-slip; None: it feels
        the pressure of whole steps alone.

    Attributes:
      nstate: length of the state vector.
    """

    def __init__(
        self,
        geometry: SkinGeometry,
        seed: int = 0,
        noise: bool = True,
        sensor: str = "1",
        film_every_step: bool = False,
        temperature: float = REST_TEMPERATURE,
        film: FilmConduction | None = None,
        bodies: list[Material] | None = None,
        cold: bool = False,
        vibration: Vibration | None = None,
    ):
        self.film = FilmConduction(geometry, sensor=sensor) if film is None else film
        self.acquisition = Acquisition(seed=seed, noise=noise, film_every_step=film_every_step)
        self.temperature = temperature
        self._heat = self._begin = None
        if bodies is not None:
            sensor = HeatParameters().at_rest(temperature)
            self._heat = Heat(bodies, sensor)
            begins = sensor if not cold else sensor.at_rest(sensor.ambient)
            self._begin, self._liquid = begins.rest(len(bodies)), sensor.rest()[LIQUID]
        elif cold:
            raise ValueError("cold is of a sensor with heat: give bodies, in attach thermal")
        self._warm = slice(self.acquisition.nstate, self.acquisition.nstate)
        if self._heat is not None:
            self._warm = slice(self._warm.start, self._warm.start + self._heat.nstate)
        self._vibration = vibration
        self.nstate = self._warm.stop + (0 if vibration is None else vibration.nstate)
        self._rest, self._rest_vert = self.film.impedance(geometry.vert), geometry.vert

    def reset(
        self, state: np.ndarray, vert_xpos: np.ndarray | None = None, pressure: float = 0.0, time: float = 0.0
    ) -> None:
        """Writes the steady readings of a skin at vert_xpos (nvert, 3) [m], by default at rest, into state
        (nstate,)."""
        impedance = self._rest if vert_xpos is None else self.film.impedance(vert_xpos)
        temperature = self.temperature
        if self._heat is not None:
            state[self._warm] = self._begin
            temperature = self._begin[THERMISTOR]
            impedance = impedance * electrode_factor(self._begin[LIQUID], self._liquid)
        state[self._warm.stop :] = 0.0
        self.acquisition.reset(self._counts(state), impedance, pressure, temperature, time)

    def _counts(self, state):
        return state[: self.acquisition.nstate]

    def advance(
        self,
        state: np.ndarray,
        time: float,
        dt: float,
        vert_xpos: np.ndarray,
        pressure: float,
        area: np.ndarray | None = None,
        force: np.ndarray | None = None,
        shaking: tuple | None = None,
    ) -> None:
        """Samples the step (time, time + dt].

        Args:
          state: (nstate,) float64, updated in place.
          time: at the start of the step [s]; dt: its length [s].
          vert_xpos: (nvert, 3), nodes at the end of the step, BioTac frame [m].
          pressure: of the liquid at the end of the step, above rest [Pa].
          area, force: (nbody,) what each body touches [m^2] and its force [N], for heat; None: nothing
            touches.
          shaking: `drive`, `gain`, `slip` and `area` of `Vibration`; None: nothing moves the skin.

        Raises:
          ValueError: wrong shape or a value that is not finite; the state is unchanged then.
        """
        impedance, counts, temperature = None, self._counts(state), self.temperature
        heat = self._advance_heat(state, dt, area, force)
        if heat is not None:
            temperature = heat[THERMISTOR]
        if self.acquisition.needs_impedance(
            counts, time, dt
        ):  # a skin that nothing touches need not be solved again
            impedance = (
                self._rest if np.array_equal(vert_xpos, self._rest_vert) else self.film.impedance(vert_xpos)
            )
            if heat is not None:
                impedance = impedance * electrode_factor(heat[LIQUID], self._liquid)
        moved, shaken = self._vibrate(state, time, dt, shaking)
        self.acquisition.advance(counts, time, dt, impedance, pressure, temperature, shaken)
        if heat is not None:
            state[self._warm] = heat
        if moved is not None:
            state[self._warm.stop :] = moved

    def _advance_heat(self, state, dt, area, force):
        """The heat's state after the step, None without heat."""
        if self._heat is None:
            return None
        heat, own = self._heat, self._heat.state.numpy()[0]
        own[:] = state[self._warm]
        for array, given in ((heat.area, area), (heat.force, force)):
            array.numpy()[:] = 0.0 if given is None else given
        heat.advance(dt)
        return own

    def _vibrate(self, state, time, dt, shaking):
        """The vibration's state after the step and what PAC feels at its slots; None without one."""
        if self._vibration is None:
            return None, None
        v = self._vibration
        own = v.state.numpy()[0]
        own[:] = state[self._warm.stop :]
        v.time.numpy()[0] = time
        for i, array in enumerate((v.drive, v.gain, v.slip, v.area)):
            array.numpy()[0] = 0.0 if shaking is None else shaking[i]
        v.advance(dt)
        return own, v.pressure

    def readings(self, state: np.ndarray) -> dict:
        """dict of counts: electrodes (19,) int, pdc int, pac (22,) int, tac int, tdc int."""
        return self.acquisition.readings(self._counts(state))


def check_settings(given: dict, more: dict | None = None, what: str = "options['readings']") -> dict:
    """Settings of `PhysicsReadings`, given by name, as they are.

    Args:
      given: of noise, sensor, film_every_step, temperature. more: further names and their types.
      what: they are, in errors.

    Raises:
      ValueError: not a dict, another name, or a value that cannot be.
    """
    known = _SETTINGS | (more or {})
    check_entries(what, given, known, known)
    refuse_unknown(given, known, what)
    if given.get("sensor", "") not in ("", *REST_COUNTS):
        raise ValueError(f"sensor is {given['sensor']!r}: pass one of {', '.join(map(repr, REST_COUNTS))}")
    return given


def record(readings: PhysicsReadings, time: np.ndarray, vert_xpos: np.ndarray, pressure: np.ndarray) -> dict:
    """Counts over a stored motion; impedance and pressure are linear between its samples.

    Args:
      readings: PhysicsReadings.
      time: (nt,) increasing [s]; vert_xpos: (nt, nvert, 3) [m]; pressure: (nt,) above rest [Pa].

    Returns:
      dict of int arrays, row i what the bus reports at time[i]: electrodes (nt, 19), pdc (nt,), pac (nt, 22),
        tac (nt,), tdc (nt,).

    Raises:
      ValueError: lengths that differ, or time that does not increase.
    """
    time, pressure = np.asarray(time, dtype=float), np.asarray(pressure, dtype=float)
    if time.ndim != 1 or not len(time) or len(vert_xpos) != len(time) or pressure.shape != time.shape:
        raise ValueError(
            f"time has shape {time.shape}, vert_xpos {len(vert_xpos)} samples, pressure {pressure.shape}: "
            "pass one of each per sample"
        )
    if not np.all(np.diff(time) > 0):
        raise ValueError(
            f"time does not increase after sample {int(np.argmax(~(np.diff(time) > 0)))}: sort the samples "
            "and drop repeated ones"
        )
    state = np.zeros(readings.nstate)
    readings.reset(state, vert_xpos[0], pressure[0], time[0])
    rows = [readings.readings(state)]
    for i in range(1, len(time)):
        readings.advance(state, time[i - 1], time[i] - time[i - 1], vert_xpos[i], pressure[i])
        rows.append(readings.readings(state))
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}
