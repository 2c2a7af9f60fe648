"""The sensor as the coupling sees it: counts of every channel from the deformed skin."""

import functools
import typing

import numpy as np
from numpy.typing import ArrayLike

from ...cache import digest
from ...effects.sensors import take_sensor
from ...geometry.skin_geometry import SkinGeometry
from ...sensor.acquisition_kernels import place_of
from ...sensor.film import FilmConduction, read_film
from ...sensor.heat import state_size
from ...sensor.materials import Material, read_thermal
from ...sensor.presets import Sensor, generator
from ...sensor.readings import PhysicsReadings, check_settings
from ...sensor.vibration import Texture, Vibration, read_texture
from ...sensor.vibration import state_size as vibration_size
from ...skin.modes import NMODE
from ...skin.settings import read_material
from ..config import Config
from ..shared import Shared
from ..stepper import Geom, SkinResult
from ..steppers.fem import FemStepper, rest_geometry
from .vibration import Shaking

if typing.TYPE_CHECKING:
    from ...learning.serve import NetworkFilm


_films = Shared(keep=4)  # by geometry and settings


class SensorReadings:
    """`PhysicsReadings` behind the `Readings` protocol.

    `config.options["readings"]` goes to it (noise, sensor, randomise, film_every_step, temperature,
    cold).

    The film, with its factorisations, is made at the first reset and shared by all sensors of one geometry.
    """

    _more = {"cold": bool}

    def __init__(self, config: Config, geometry: SkinGeometry):
        self._config, self._geometry, self._seed = config, geometry, config.noise_seed()
        settings = check_settings(config.options.get("readings", {}), self._more, design=geometry.design)
        self._film = film_of(config, geometry)
        self.sensor, self._options, _ = take_sensor(settings, config.own_seed(), geometry.design)
        self._bodies: list[Material] | None = None
        self._textures: list[Texture] | None = None
        self._geoms: list[Geom] = []
        self._shaking: Shaking | None = None
        self.nstate = place_of(geometry.design).nstate

    def feel_heat(self, geoms: list[Geom]) -> None:
        """Adds heat. A body has the material of the first of its geoms that `config.thermal` names."""
        self._bodies = materials_of(geoms, self._config.thermal, self._config.seed)
        self._geoms = geoms
        self.nstate += state_size(len(self._bodies))

    def feel_vibration(self, geoms: list[Geom], stepper: FemStepper) -> None:
        """A body has the texture of the first of its geoms that `config.textures` names."""
        self._textures = textures_of(geoms, self._config.textures, self._config.seed)
        self._geoms, self._shaking = geoms, Shaking(stepper, geoms)
        self.nstate += vibration_size(NMODE, len(self._textures))

    def shaking(self, before: np.ndarray, result: SkinResult, dt: float) -> tuple | None:
        """Excitation of the skin's modes in the step, for `advance`; see `Shaking.of_step`."""
        return self._shaking.of_step(before, result, dt)

    def _rest(self):
        return (
            rest_geometry(self._config, self._geometry) if self._config.stepper == "fem" else self._geometry
        )

    @property
    def film(self) -> FilmConduction:
        """Between skin and core."""
        rest, settings = self._rest(), self._film
        return _films.get(digest(rest, settings), lambda: FilmConduction(rest, **settings))

    @functools.cached_property
    def _physics(self):
        geometry, film = self._rest(), self.film
        sound = self._shaking and Vibration(self._shaking.modes, self._textures, seed=self._seed)
        more = {"film": film, "bodies": self._bodies, "vibration": sound, "sensor": self.sensor}
        more["textures"] = self._textures
        options = {name: value for name, value in self._options.items() if name != "weights"}
        return PhysicsReadings(geometry, seed=self._seed, **more, **options)

    @functools.cached_property
    def rest(self) -> dict:
        state = np.zeros(self.nstate)
        self._physics.reset(state)
        return self._physics.readings(state)

    def reset(self, state: np.ndarray) -> None:
        self._physics.reset(state)

    def draw(self, state: np.ndarray, seed: int) -> Sensor:
        """Resets to another sensor, other materials and textures, where the settings leave them open."""
        settings, own = self._config.options.get("readings", {}), self._config.own_seed(seed)
        sensor = take_sensor(settings, own, self._geometry.design)[0]
        bodies = self._bodies and materials_of(self._geoms, self._config.thermal, seed)
        textures = self._textures and textures_of(self._geoms, self._config.textures, seed)
        self._physics.reset(state, sensor=sensor, bodies=bodies, textures=textures)
        return sensor

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
    ) -> dict:
        self._physics.advance(state, time, dt, vert_xpos, pressure, area, force, shaking)
        return self._physics.readings(state)


class LearnedReadings(SensorReadings):
    """`SensorReadings` with a network in the place of the film, of `options["readings"]["weights"]`."""

    _more = {**SensorReadings._more, "weights": str | None}

    def __init__(self, config: Config, geometry: SkinGeometry):
        from ...learning.serve import NetworkFilm

        if "film" in config.options:
            raise ValueError("a network replaces the film: leave options['film'] out")
        super().__init__(config, geometry)
        self._network = NetworkFilm(geometry, self._options.get("weights"))

    @property
    def film(self) -> "NetworkFilm":
        """The network, which reads displacements from the unfilled skin."""
        return self._network


def film_of(config: Config, geometry: SkinGeometry | None = None) -> dict:
    """Settings of the film of a BioTac, for `FilmConduction`; see `sensor.film.read_film`."""
    radius = read_material(config.material).electrode_radius if config.stepper == "fem" else None
    return read_film(config.options.get("film"), radius, geometry)


def materials_of(geoms: list[Geom], wanted: dict, seed: ArrayLike = 0) -> list[Material]:
    """Thermal material of each body, from names as in `Config.thermal`; one of a list is drawn by the
    seed."""
    return _by_body(geoms, wanted, read_thermal, "plastic", generator(seed, 0x4EA7))


def textures_of(geoms: list[Geom], wanted: dict, seed: ArrayLike = 0) -> list[Texture]:
    """Likewise, of names as `Config.textures` has them."""
    return _by_body(geoms, wanted, read_texture, "smooth", generator(seed, 0x7E47))


def _by_body(geoms, wanted, read, else_, rng):
    bodies = [read(else_)] * (1 + max((g.group for g in geoms), default=-1))
    chosen = {k: v[rng.integers(len(v))] if isinstance(v, (list, tuple)) else v for k, v in wanted.items()}
    # after a further attach a name ends so
    named = [(g, value) for g in geoms for key, value in chosen.items() if g.name.endswith(key)]
    for geom, value in reversed(named):
        bodies[geom.group] = read(value)
    return bodies
