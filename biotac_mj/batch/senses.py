"""The sensors of all worlds: film, acquisition, and heat and vibration where they are wanted."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..coupling.config import Config
from ..coupling.sensing.counts import materials_of, textures_of
from ..coupling.stepper import Geom
from ..effects.sensors import take_sensor
from ..geometry.design import BIOTAC, Design
from ..kernels import kernel_module
from ..sensor.acquisition import BatchAcquisition
from ..sensor.heat import ABOVE, THERMISTOR, Heat, begin_heat
from ..sensor.materials import Material
from ..sensor.presets import Sensor
from ..sensor.vibration import Modes, Texture, Vibration
from ..skin.modes import skin_modes
from ..skin.newton.worlds import CONVERGED, Worlds
from ..skin.touched import Touched
from .skin import BatchSkin

kernel_module(__name__)

_POOL = 256  # sensors that resets draw from, at least


class Draw(NamedTuple):
    """Properties of one world's sensor and of the bodies that touch it; None without heat, vibration."""

    sensor: Sensor
    bodies: list[Material] | None
    textures: list[Texture] | None


def draws(
    nworld: int,
    seed: ArrayLike,
    config: Config,
    settings: dict,
    thermal: dict | list | None,
    textures: dict | list | None,
    geoms: list[Geom],
    design: Design = BIOTAC,
) -> tuple[list[Draw], Callable[[int], Draw] | None]:
    """Draws the sensors with which worlds begin, or from which their resets draw.

    Args:
      nworld: number of worlds. seed: of world 0, world w has seed + w; or (nworld,).
      config: of the single sensor with which each world begins that has the world's seed.
      settings: of the readings; its "sensor", thermal and textures may be lists of one for each world.
      geoms: that can touch. design: of the sensors.

    Returns:
      [Draw], one for each world or more, and what a seed draws, where every reset draws one.

    Raises:
      ValueError: lists of another length, or what cannot be.
    """
    lists = {"sensor": settings.get("sensor"), "thermal": thermal, "textures": textures}
    lists = {name: value for name, value in lists.items() if isinstance(value, list)}
    for name, value in lists.items():
        if len(value) != nworld:
            raise ValueError(f"{len(value)} {name} for {nworld} worlds: pass one for each, or a single one")

    seeds = [int(s) for s in np.ravel(seed)]
    if np.ndim(seed) == 0:
        seeds = [seeds[0] + w for w in range(nworld)]

    def draw(key, own=settings, made=thermal, brushed=textures):
        sensor, _, drawn = take_sensor(own, config.own_seed(key), design)
        bodies = None if made is None else materials_of(geoms, made, key)
        surfaces = None if brushed is None else textures_of(geoms, brushed, key)
        choices = [*(made or {}).values(), *(brushed or {}).values()]
        return Draw(sensor, bodies, surfaces), drawn or any(isinstance(c, (list, tuple)) for c in choices)

    def of_world(w):
        own = {**settings, "sensor": lists["sensor"][w]} if "sensor" in lists else settings
        return draw(seeds[w], own, *(v[w] if isinstance(v, list) else v for v in (thermal, textures)))

    first, drawn = of_world(0)
    if lists:
        return [of_world(w)[0] for w in range(nworld)], None
    if not drawn:
        return [first] * nworld, None
    keys = [*seeds, *range(max(seeds) + 1, max(seeds) + 1 + _POOL - nworld)]
    return [draw(key)[0] for key in keys], lambda seed: draw(seed)[0]


@wp.kernel
def reset_rows(
    # In:
    mask: wp.array(dtype=bool),
    row: wp.array(dtype=int),
    rest: wp.array2d(dtype=wp.float64),
    # Out:
    state_out: wp.array2d(dtype=wp.float64),
):
    """Rest states of worlds: the row of `rest` that each has drawn."""
    w, i = wp.tid()
    if mask[w]:
        state_out[w, i] = rest[row[w], i]


@wp.kernel
def forget_films(mask: wp.array(dtype=bool), known_out: wp.array(dtype=int)):
    w = wp.tid()
    if mask[w]:
        known_out[w] = 0


@wp.kernel
def find_changed(
    # In:
    due: wp.array(dtype=int),
    awake: wp.array(dtype=int),
    st: Worlds,
    given_pressure: int,
    state: wp.array2d(dtype=wp.float64),
    # In and out:
    known: wp.array(dtype=int),
    pressure: wp.array(dtype=wp.float64),
    # Out:
    changed_out: wp.array(dtype=int),
    any_out: wp.array(dtype=int),
):
    """Finds due worlds whose film has changed since its last solution; `known` where it was solved since the
    skin moved. Film and pressure hold where the skin did not get to its bodies: as
    `coupling.instance.Instance` does."""
    w = wp.tid()
    if awake[w] == 1:
        known[w] = 0
    changed_out[w] = 0
    if st.reason[w] != CONVERGED and st.load_factor[w] < wp.float64(1.0):
        pressure[w] = state[w, given_pressure]
    elif due[w] == 1 and known[w] == 0:
        known[w] = 1
        changed_out[w] = 1
        any_out[0] = 1


class Senses:
    """Readings of the skins of a batch.

    Args:
      skin: BatchSkin. film: BatchFilm, or what stands for it.
      group: (ngeom,) body of each geom.
      rows: [Draw] of `draws`, from which resets draw if `of_seed`, (seed) -> Draw, is given.
      seed: see `BatchAcquisition`. dt: time step [s].
      cold, temperature: see `PhysicsReadings`. settings: noise, film_every_step.

    Attributes:
      acquisition: BatchAcquisition. heat: Heat, vibration: Vibration, or None.
    """

    def __init__(
        self,
        skin: BatchSkin,
        film: object,
        group: np.ndarray,
        rows: list[Draw],
        of_seed: Callable[[int], Draw] | None,
        seed: ArrayLike,
        dt: float,
        cold: bool = False,
        temperature: float | None = None,
        **settings: object,
    ):
        self._skin, self.film, self._dt = skin, film, dt
        self._of_seed, self._warmth = of_seed, (temperature, cold)
        device, nworld, ngroup = skin.model.device, skin.nworld, skin.ngroup
        warm, shaken = rows[0].bodies is not None, rows[0].textures is not None
        self.heat = self.vibration = self._touched = None
        with wp.ScopedDevice(device):
            self._known, self._changed = (wp.zeros(nworld, dtype=int) for _ in range(2))
        self._rests, begins = [], None
        if warm:
            self.heat = Heat(rows[0].bodies, nworld=nworld, device=device)
            begins = np.array([_begin(row, temperature, cold) for row in rows])
            self._rests.append((wp.array(begins, dtype=wp.float64, device=device), self.heat.state))
            temperature = begins[:, THERMISTOR]
        elif cold:
            raise ValueError("cold needs a sensor with heat: give thermal, {} if all is of plastic")
        self.acquisition = BatchAcquisition(
            film.rest,
            nworld,
            seed,
            temperature=temperature,
            liquid=begins[:, ABOVE] if warm else 0.0,
            sensor=[r.sensor for r in rows],
            redraw=of_seed is not None,
            heat=warm,
            device=device,
            design=film.design,
            **settings,
        )
        if warm:
            self.acquisition.temperature = self.heat.state[:, THERMISTOR]
            self.acquisition.liquid = self.heat.state[:, ABOVE]
        modes = skin_modes(skin.model) if shaken else None
        if shaken:
            few = Modes(modes.rate, modes.static_pressure)
            self.vibration = Vibration(
                few, rows[0].textures, nworld, self.acquisition.seed.numpy(), str(device)
            )
            rests = np.array([self.vibration.rest(r.textures) for r in rows])
            self._rests.append((wp.array(rests, dtype=wp.float64, device=device), self.vibration.state))
        if warm or shaken:
            t = self._touched = Touched(skin.data, group, ngroup, modes)
        if warm:
            self.heat.read_from(t.area, t.force)
        if shaken:
            clock = self.acquisition.seed, self.acquisition.time
            self.vibration.read_from(*clock, t.drive, t.gain, t.slip, t.area)
            self.vibration.prepare(dt)

    @property
    def nbytes(self) -> int:
        """Device memory that grows with the number of worlds [bytes]."""
        states = [self.acquisition.state, *(state for _, state in self._rests)]
        return self.film.nbytes + sum(state.capacity for state in states)

    @property
    def lasting(self) -> list[wp.array]:
        """The arrays (nworld, ...) that outlive a step."""
        a = self.acquisition
        own = [a.seed, a.drawn, a.row, a.time, a.state, self._known, self.film.impedance, self.film.valid]
        if not self.heat:  # else they are part of its state
            own += [a.temperature, a.liquid]
        return own + [state for _, state in self._rests]

    def drawn(self, seed: int) -> list[tuple[wp.array, np.ndarray]]:
        """Of the sensor that a seed draws, the values at rest in a world's rows of arrays of `lasting`; empty
        where none is drawn."""
        if not self._of_seed:
            return []
        row, a, warmth = self._of_seed(seed), self.acquisition, self._warmth[:1]
        begin = _begin(row, *self._warmth) if self.heat else None
        if self.heat:
            warmth = float(begin[THERMISTOR]), float(begin[ABOVE])
        rest = a.rest_state(row.sensor, *warmth)
        parts = [begin] if self.heat else []
        parts += [self.vibration.rest(row.textures)] if self.vibration else []
        found = [(a.state, rest)] + [(s, part) for (_, s), part in zip(self._rests, parts, strict=True)]
        return found if self.heat else [*found, (a.temperature, rest[a.place.given_temperature])]

    def reset(self, mask: wp.array) -> None:
        """Puts the worlds of mask, (nworld,) wp.array of bool, back to rest; may draw other sensors."""
        self.acquisition.reset(mask)
        wp.launch(forget_films, self._known.shape, [mask], [self._known], device=self._known.device)
        for rest, state in self._rests:
            inputs = [mask, self.acquisition.row, rest]
            wp.launch(reset_rows, state.shape, inputs, [state], device=state.device)

    def begin_step(self) -> None:
        """Before the skins are solved."""
        if self.vibration:
            self._touched.begin()

    def look(self, wrench: wp.array, tangent: wp.array, awake: wp.array, any: wp.array) -> None:
        """After it: heat, and which worlds want their film. Launches only.

        Args:
          wrench, tangent: (ngroup, nworld) of the skins ON the bodies. awake: (nworld,) int, 1 where the skin
            may have moved.
          any: (1,) int, becomes 1 where a world wants its film.
        """
        if self._touched:
            self._touched.end(wrench, tangent)
        if self.heat:
            self.heat.advance(self._dt)
        due = self.acquisition.find_due(self._dt)
        worlds, a = self._skin.data.worlds, self.acquisition
        inputs = [due, awake, worlds, a.place.given_pressure, a.state]
        outputs = [self._known, self._skin.pressure, self._changed, any]
        wp.launch(find_changed, self._skin.nworld, inputs, outputs, device=due.device)

    def solve_film(self) -> None:
        """The films that are wanted, after `look`. Launches only."""
        self.film.solve_film(self._skin.x, self._changed)

    def sample(self) -> wp.array:
        """The step's slots, after `solve_film`; returns the states (nworld, nstate). Launches only."""
        shaken = None
        if self.vibration:
            self.vibration.advance(self._dt)
            shaken = self.vibration.pressure
        film = self.film
        self.acquisition.advance(self._dt, film.impedance, film.valid, self._skin.pressure, shaken)
        return self.acquisition.state


def _begin(row, temperature, cold):
    warm = row.sensor.temperature if temperature is None else temperature
    return begin_heat(warm, row.sensor.warm_up, cold, row.bodies)
