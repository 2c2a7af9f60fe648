"""The sensor as the coupling sees it: counts of every channel from the deformed skin."""

import functools

import numpy as np

from ..geometry.skin_geometry import SkinGeometry
from ..sensor.acquisition import Acquisition
from ..sensor.film import FilmConduction
from ..sensor.heat import state_size
from ..sensor.materials import Material, read_thermal
from ..sensor.readings import PhysicsReadings, check_settings
from ..sensor.vibration import Texture, Vibration, read_texture
from ..sensor.vibration import state_size as vibration_size
from ..skin.modes import NMODE
from .config import Config
from .fem import FemStepper, rest_geometry
from .stepper import Geom, SkinResult
from .vibration import Shaking

__all__ = ["SensorReadings"]


class SensorReadings:
    """`PhysicsReadings` behind the `Readings` protocol.

    `config.options["readings"]` goes to it (noise, sensor, film_every_step, temperature, cold).

    The film, with its factorisations, is made at the first reset and shared by all sensors of one geometry.
    """

    def __init__(self, config: Config, geometry: SkinGeometry):
        self._config, self._geometry, self._seed = config, geometry, config.seed
        self._options = check_settings(config.options.get("readings", {}), {"cold": bool})
        self._bodies: list[Material] | None = None
        self._shaking: Shaking | None = None
        self.nstate = Acquisition.nstate

    def feel_heat(self, geoms: list[Geom]) -> None:
        """A body is made of what the first of its geoms that `config.thermal` names is made of."""
        self._bodies = _by_body(geoms, self._config.thermal, read_thermal, "plastic")
        self.nstate += state_size(len(self._bodies))

    def feel_vibration(self, geoms: list[Geom], stepper: FemStepper) -> None:
        """A body has the texture of the first of its geoms that `config.textures` names."""
        self._textures: list[Texture] = _by_body(geoms, self._config.textures, read_texture, "smooth")
        self._shaking = Shaking(stepper, geoms)
        self.nstate += vibration_size(NMODE, len(self._textures))

    def shaking(self, before: np.ndarray, result: SkinResult, dt: float) -> tuple | None:
        """What the step of the skin does to its modes, for `advance`; see `Shaking.of_step`."""
        return self._shaking.of_step(before, result, dt)

    @functools.cached_property
    def _physics(self):
        geometry = (
            rest_geometry(self._config, self._geometry) if self._config.stepper == "fem" else self._geometry
        )
        film = _film(_Skin(geometry), self._options.get("sensor", "1"))
        sound = self._shaking and Vibration(self._shaking.modes, self._textures, seed=self._seed)
        more = {"film": film, "bodies": self._bodies, "vibration": sound}
        return PhysicsReadings(geometry, seed=self._seed, **more, **self._options)

    @functools.cached_property
    def rest(self) -> dict:
        state = np.zeros(self.nstate)
        self._physics.reset(state)
        return self._physics.readings(state)

    def reset(self, state: np.ndarray) -> None:
        self._physics.reset(state)

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
    ) -> dict:
        self._physics.advance(state, time, dt, vert_xpos, pressure, area, force, shaking)
        return self._physics.readings(state)


def _by_body(geoms, wanted, read, else_):
    """What each body has of what geoms are named to have."""
    bodies = [read(else_)] * (1 + max((g.group for g in geoms), default=-1))
    named = [(g, value) for g in geoms for key, value in wanted.items() if _is(g.name, key)]
    for geom, value in reversed(named):
        bodies[geom.group] = read(value)
    return bodies


def _is(name, key):
    return name == key or name.endswith(key)  # after a further attach


class _Skin:
    """A geometry, hashable by content."""

    def __init__(self, geometry):
        self.geometry = geometry
        self.key = (geometry.vert.tobytes(), geometry.core_vert.tobytes(), geometry.electrode_pos.tobytes())

    def __hash__(self):
        return hash(self.key)

    def __eq__(self, other):
        return self.key == other.key


@functools.lru_cache(maxsize=4)
def _film(skin, sensor):
    return FilmConduction(skin.geometry, sensor=sensor)
