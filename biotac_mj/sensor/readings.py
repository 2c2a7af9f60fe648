"""Counts of a BioTac from the deformed skin: film conduction and acquisition combined."""

import contextlib

import numpy as np

from biotac_mj.fields import check_entries, refuse_unknown
from biotac_mj.geometry.design import BIOTAC, Design
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.sensor.acquisition import Acquisition
from biotac_mj.sensor.channels import FULL_SCALE, check_temperature, temperature_from_counts
from biotac_mj.sensor.film import FilmConduction, NoFilmError
from biotac_mj.sensor.heat import ABOVE, THERMISTOR, Heat, begin_heat
from biotac_mj.sensor.materials import Material
from biotac_mj.sensor.presets import Sensor, read_sensor
from biotac_mj.sensor.vibration import Texture, Vibration

_SETTINGS = {
    "noise": bool,
    "sensor": str | dict,
    "randomise": list | dict,
    "film_every_step": bool,
    "temperature": float,
}


class PhysicsReadings:
    """Counts of all channels from the deformed skin and the liquid's pressure. Constant: the caller owns the
    state.

    Args:
      geometry: the skin.
      seed: of the noise; give every sensor its own.
      noise: False keeps quantisation only.
      sensor: see `presets.read_sensor`; "random" is drawn by the seed.
      film_every_step: solve the film in every step that samples an electrode, not once per 10 ms frame (see
        `Acquisition.needs_impedance`).
      temperature: of the core at the reset [C], None: the sensor's. Without `bodies` it changes only by the
        sensor's own warm-up.
      bodies: material of each body that may touch. The sensor then has a heat model (`sensor.heat`), which
        changes TDC, TAC and, through the liquid's temperature, all electrodes. None: no heat model.
      cold: the sensor is switched on at the reset: it starts at ambient temperature and warms up.
      film: a FilmConduction to share between sensors of the same geometry, or `learning.serve.NetworkFilm`;
        None builds one.
      vibration: of one sensor on the CPU, for PAC's response to taps, stick-slip and `textures` of the
        bodies; None: PAC has only the pressure of whole steps.

    Attributes:
      nstate: length of the state vector.
    """

    def __init__(
        self,
        geometry: SkinGeometry,
        seed: int = 0,
        noise: bool = True,
        sensor: str | dict | Sensor | None = None,
        film_every_step: bool = False,
        temperature: float | None = None,
        film: FilmConduction | None = None,
        bodies: list[Material] | None = None,
        cold: bool = False,
        vibration: Vibration | None = None,
        textures: list[Texture] | None = None,
    ):
        given = {"noise": noise, "film_every_step": film_every_step, "cold": cold}
        if temperature is not None:
            given["temperature"] = temperature
        check_settings(given, {"cold": bool}, "the readings")
        if not isinstance(geometry, SkinGeometry) or not (film is None or hasattr(film, "impedance")):
            raise ValueError(
                f"geometry is {type(geometry).__name__} and film {type(film).__name__}: pass a SkinGeometry, "
                "and a FilmConduction or None"
            )
        self.film = FilmConduction(geometry) if film is None else film
        own = self.sensor = read_sensor(sensor, seed, geometry.design)
        more = {
            "sensor": own,
            "film_rest": self.film.rest,
            "heat": bodies is not None,
            "design": geometry.design,
        }
        self.acquisition = Acquisition(seed=seed, noise=noise, film_every_step=film_every_step, **more)
        self._temperature, self._cold = temperature, cold
        self._heat = None
        if bodies is not None:
            self._heat = Heat(bodies)
        elif cold:
            raise ValueError("cold needs a sensor with heat: give bodies (in attach: thermal)")
        self._warm = slice(self.acquisition.nstate, self.acquisition.nstate)
        if self._heat is not None:
            self._warm = slice(self._warm.start, self._warm.start + self._heat.nstate)
        self._vibration, self._bodies, self._textures = vibration, bodies, textures or []
        self._shaken = slice(self._warm.stop, self._warm.stop + (vibration.nstate if vibration else 0))
        self.nstate = self._shaken.stop
        self._rest, self._rest_vert = self.film.impedance(geometry.vert), geometry.vert

    def reset(
        self,
        state: np.ndarray,
        vert_xpos: np.ndarray | None = None,
        pressure: float = 0.0,
        time: float = 0.0,
        sensor: Sensor | None = None,
        bodies: list[Material] | None = None,
        textures: list[Texture] | None = None,
        impedance: np.ndarray | None = None,
    ) -> None:
        """Writes the steady readings into state (nstate,) for a skin at vert_xpos (nvert, 3) [m], or for the
        film's impedance (n,) [ohm]; default: at rest. From now on the readings are those of `sensor`, touched
        by `bodies` with `textures`; default: those of the settings."""
        if impedance is None:
            impedance = self._rest if vert_xpos is None else self.film.impedance(vert_xpos)
        acquisition = self.acquisition if sensor is None else self.acquisition.of(sensor)
        own = acquisition.sensor
        temperature, liquid = own.temperature if self._temperature is None else self._temperature, 0.0
        if self._heat is not None:
            begin = begin_heat(temperature, own.warm_up, self._cold, bodies or self._bodies)
            state[self._warm] = begin
            temperature, liquid = begin[THERMISTOR], begin[ABOVE]
        if self._vibration is not None:
            state[self._shaken] = self._vibration.rest(textures or self._textures)
        acquisition.reset(self._counts(state), impedance, pressure, temperature, time, liquid)

    def _counts(self, state):
        return state[: self.acquisition.nstate]

    def advance(
        self,
        state: np.ndarray,
        time: float,
        dt: float,
        vert_xpos: np.ndarray | None,
        pressure: float | None,
        area: np.ndarray | None = None,
        force: np.ndarray | None = None,
        shaking: tuple | None = None,
        impedance: np.ndarray | None = None,
    ) -> None:
        """Samples the step (time, time + dt].

        Args:
          state: (nstate,) float64, updated in place.
          time: at the start of the step [s]; dt: its length [s].
          vert_xpos: (nvert, 3), nodes at the end of the step, BioTac frame [m]; None holds the impedance.
          pressure: of the liquid at the end of the step, above rest [Pa]; None holds the last one.
          area, force: (nbody,) contact area [m^2] and force [N] of each body, for heat; None: no contact.
          shaking: `drive`, `gain`, `slip` and `area` of `Vibration`; None: nothing moves the skin.
          impedance: (n,) of the film at the end of the step [ohm]; the film is not solved then.

        Raises:
          ValueError: wrong shape or a value that is not finite; the state is unchanged then.
        """
        counts, temperature, liquid = self._counts(state), None, 0.0
        heat = self._advance_heat(state, dt, area, force)
        if heat is not None:
            temperature, liquid = heat[THERMISTOR], heat[ABOVE]
        seen = impedance is None and vert_xpos is not None
        if seen and self.acquisition.needs_impedance(counts, time, dt):
            with contextlib.suppress(
                NoFilmError
            ):  # the film of a skin after a hard hit: electrodes hold, as in batches
                # without contact the film need not be solved again
                still = np.array_equal(vert_xpos, self._rest_vert)
                impedance = self._rest if still else self.film.impedance(vert_xpos)
        moved, shaken = self._vibrate(state, time, dt, shaking)
        self.acquisition.advance(counts, time, dt, impedance, pressure, temperature, shaken, liquid)
        if heat is not None:
            state[self._warm] = heat
        if moved is not None:
            state[self._shaken] = moved

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
        """The vibration's state after the step and the pressure on PAC at its slots; None without
        vibration."""
        if self._vibration is None:
            return None, None
        v = self._vibration
        own = v.state.numpy()[0]
        own[:] = state[self._shaken]
        v.time.numpy()[0] = time
        for i, array in enumerate((v.drive, v.gain, v.slip, v.area)):
            array.numpy()[0] = 0.0 if shaking is None else shaking[i]
        v.advance(dt)
        return own, v.pressure

    def readings(self, state: np.ndarray) -> dict:
        """dict of counts: electrodes (n,) int, pdc int, pac (npac,) int, tac int, tdc int."""
        return self.acquisition.readings(self._counts(state))


def check_settings(
    given: dict, more: dict | None = None, what: str = "options['readings']", design: Design = BIOTAC
) -> dict:
    """Returns settings of `PhysicsReadings`, given by name, after a check.

    Args:
      given: of noise, sensor, film_every_step, temperature. more: further names and their types.
      what: their name in errors. design: of the sensor.

    Raises:
      ValueError: not a dict, an unknown name, or an invalid value.
    """
    known = _SETTINGS | (more or {})
    check_entries(what, given, known, known)
    refuse_unknown(given, known, what)
    read_sensor(given.get("sensor"), design=design)
    hottest = float(temperature_from_counts(FULL_SCALE))
    check_temperature("temperature", given.get("temperature", 0.0), hottest, "TDC shows no more")
    return given
