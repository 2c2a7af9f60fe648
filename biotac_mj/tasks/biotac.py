"""The BioTac as a composer Entity: attach it to any site of an arena or a robot. Its observables have their
own rate, delay and noise."""

import dataclasses
from collections.abc import Callable, Iterable

import mujoco
import numpy as np
from dm_control import composer, mjcf
from dm_control.composer.observation import observable

from .. import plugin
from ..coupling.config import TO_COME
from ..coupling.handle import SENSORS
from ..effects.sensors import take_sensor
from ..fields import refuse_unknown
from ..geometry import load_skin
from ..geometry.design import DESIGNS
from ..sensor.channels import FULL_SCALE
from ..sensor.materials import check_geoms, read_thermal
from ..sensor.presets import Sensor
from ..sensor.vibration import read_texture
from ..sensor.weighted import WeightedElectrodes
from ..short_repr import short_repr

TACTILE = ("electrodes", "pac", "pdc", "tac", "tdc")  # readings of the real sensor
ESTIMATED = ("contact_estimate",)  # drivers' estimate from these by a formula
PRIVILEGED = ("contact_force", "contact_patch", "skin")  # available in simulation only
_ALL = TACTILE + ESTIMATED + PRIVILEGED
_RATE = 100.0  # [Hz] of a frame: 19 electrodes, PDC, TAC, TDC once, PAC 22 times (BioTac manual)
_SURE = 5.0  # standard deviations: exceeded by chance once in a day of 19 electrodes
_PREFIX = "build_"  # of all names until the Entity has its own scope
_PLACE = "site", "body", "pos", "quat", "prefix"  # arguments of `attach` that an Entity does not use


class Reading(observable.Generic):
    """An observable in seconds: its rate and delay are converted to physics steps when the time step is
    known.

    Attributes:
      rate: sampling rate [Hz]; None: every physics step.
      lag: delay of a value [s].
      noise: f(values, random_state) -> values; None: no noise.
      find: f(values with noise) -> observation; None: these values.
    """

    def __init__(
        self,
        read: Callable[[mjcf.Physics], np.ndarray],
        rate: float | None = _RATE,
        lag: float = 0.0,
        noise: Callable | None = None,
        find: Callable | None = None,
    ):
        super().__init__(read)
        self.rate, self.lag, self.corruptor, self.find = rate, lag, noise, find

    def observation_callable(
        self, physics: mjcf.Physics, random_state: np.random.RandomState | None = None
    ) -> Callable[[], np.ndarray]:
        read = super().observation_callable(physics, random_state)
        return read if self.find is None else lambda: self.find(read())

    @property
    def noise(self) -> Callable | None:
        return self.corruptor

    @noise.setter
    def noise(self, value: Callable | None) -> None:
        self.corruptor = value

    def resolve(self, timestep: float) -> None:
        """Sets dm_control's `update_interval` and `delay` for a physics time step [s]."""
        self.update_interval = 1 if self.rate is None else max(1, round(1 / (self.rate * timestep)))
        self.delay = round(self.lag / timestep)


class BioTac(composer.Entity):
    """A BioTac for composer: `robot.attach(BioTac(), site)`; its frame (tip -x, pad -y) is the site's.

    The skin's constants are built when the model is compiled and shared by all BioTacs with the same
    settings. An episode's reset writes the state at rest without rebuilding. The sensor's own noise is off:
    noise belongs to the observables, drawn from the environment's random state."""

    def _build(self, name="biotac", slots=TO_COME, noise=True, settings=None, **keywords):
        """
        Args:
          name: scope of its names.
          slots: number of bodies of the whole model that may touch it with two-way coupling.
          noise: whether the observables have the real sensor's noise.
          settings: `coupling.Settings`; None: a coarse skin of the condensed tier, which steps in real time,
            and on_error="raise", which ends the episode with the error of a step ("warn" continues without
            touch).
          keywords: the same by name, see `biotac_mj.attach`. Names of geoms in geoms, rounding, thermal and
            textures are those of the whole model. Every reset draws one of a list of materials or textures
            from the environment's random state, like sensor="random" and the effects of `randomise`.

        Raises:
          ValueError, FileNotFoundError: as `biotac_mj.attach`, a design without electrodes, or a placement
            argument (site, body, pos, quat, prefix).
        """
        from ..coupling import SettingKeywords, Settings, SkinSettings, attach

        if not isinstance(name, str) or not name.isprintable() or not name or "/" in name:
            raise ValueError(f"name is {short_repr(name)}: give a text without /, as 'biotac'")
        if not isinstance(noise, (bool, np.bool_)):
            raise ValueError(f"noise is {short_repr(noise)}: give True or False")
        for key in _PLACE:
            if key in keywords:
                raise ValueError(
                    f"BioTac got {key}={keywords[key]!r}: "
                    "an Entity is placed with robot.attach(BioTac(...), site)"
                )
        refuse_unknown(keywords, SettingKeywords.__annotations__, "the settings of a BioTac")
        if settings is None:
            mesh = "coarse" if keywords.get("design") in (None, *DESIGNS) else None  # a pad has one mesh
            settings = Settings(skin=SkinSettings(mesh=mesh, tier="condensed"), on_error="raise")
        chosen = Settings.of(settings, keywords, "BioTac")
        sensor, own = chosen.sensor, chosen.sensor.options
        check_geoms("thermal", sensor.thermal, read_thermal)
        check_geoms("textures", sensor.textures, read_texture)
        # settings by geom are resolved later: the arena is not here yet
        without_geoms = dataclasses.replace(
            chosen,
            contact=dataclasses.replace(chosen.contact, geoms=None, rounding=None),
            sensor=dataclasses.replace(
                sensor,
                options={**(own or {}), "noise": False} if isinstance(own, dict | None) else own,
                thermal=None if sensor.thermal is None else {},
                textures=None if sensor.textures is None else {},
            ),
        )
        spec = mujoco.MjSpec()
        self.handle = attach(spec, body="world", prefix=_PREFIX, slots=slots, settings=without_geoms)
        if not self.handle.design.nelectrode:
            raise ValueError(
                f"a {self.handle.design.title} has no readings to observe: use biotac_mj.attach for its force"
            )
        with plugin.explained():
            spec.compile()
        root = mjcf.from_xml_string(spec.to_xml())
        root.model = name
        for namespace in ("body", "geom", "mesh", "site", "sensor", "equality", "plugin", "deformable"):
            for element in root.find_all(namespace):
                element.name = element.name.removeprefix(_PREFIX)
        for element in root.find_all("default"):
            if (element.dclass or "").startswith(_PREFIX):
                element.dclass = element.dclass.removeprefix(_PREFIX).replace("main", "part")
        self._name_geoms(root, chosen)
        self._mjcf_root, self._noise, self._sensor = root, noise, self.handle.numbers
        self._outer, self._weighted = np.unique(load_skin(self.handle.config.skin).outer_face), None

    def _name_geoms(self, root, chosen):
        """Resolves settings of the arena's geoms."""
        rounding = {} if chosen.contact.rounding is None else chosen.contact.rounding
        named = {"geoms": chosen.contact.geoms, "rounding": rounding, "name": root.model}
        named |= {"thermal": chosen.sensor.thermal, "textures": chosen.sensor.textures}
        self.handle = dataclasses.replace(
            self.handle, config=dataclasses.replace(self.handle.config, **named)
        )
        texts = self.handle.config.strings()
        for entry in root.find("plugin", "skin").config:
            entry.value = texts[entry.key]

    def _build_observables(self):
        return BioTacObservables(self)

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        return self._mjcf_root

    @property
    def core(self) -> mjcf.Element:
        """The body whose frame is the BioTac frame."""
        return self._mjcf_root.find("body", "core")

    @property
    def outer(self) -> np.ndarray:
        """(nouter,) indices of the skin's nodes on its outer surface."""
        return self._outer

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        for reading in self.observables.readings():
            reading.resolve(physics.timestep())

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Draws random settings: sensor, effects, materials, textures."""
        if self._draws:
            found = self._here().draw(physics.model.ptr, physics.data.ptr, int(random_state.randint(2**31)))
            self._sensor = found or self._sensor

    @property
    def _draws(self):
        config = self.handle.config
        choices = [*(config.thermal or {}).values(), *(config.textures or {}).values()]
        open_ = take_sensor(config.options.get("readings", {}), design=self.handle.design)[2]
        return open_ or any(isinstance(value, (list, tuple)) for value in choices)

    @property
    def sensor(self) -> Sensor:
        """Its constants in this episode."""
        return self._sensor

    def read(self, physics: mjcf.Physics, channel: str | None = None) -> np.ndarray | dict[str, np.ndarray]:
        """Copy of a channel's present values, or of all channels: {channel: values}; see `Handle.read`."""
        if channel is None:
            return {name: self.read(physics, name) for name in SENSORS}
        self.handle.sensor_name(channel)  # raises for unknown channels
        return np.array(physics.bind(self._mjcf_root.find("sensor", channel)).sensordata)

    def contact_estimate(self, counts: np.ndarray) -> np.ndarray:
        """(6,) estimate by `sensor.WeightedElectrodes` from counts (nelectrode,) of the electrodes: contact
        position [m], and force on the BioTac [N], in its frame; zeros if no electrode falls by five times its
        noise.

        Raises:
          ValueError: a design with other electrodes, without a known scale of force.
        """
        if self._weighted is None:
            self._weighted = WeightedElectrodes(load_skin(self.handle.config.skin))
        change = counts - self.rest()
        change[np.abs(change) < _SURE * self.sensor.electrode_noise(counts)] = 0.0
        found = np.concatenate([self._weighted.place(change), self._weighted.force(change)])
        return np.zeros(6) if np.isnan(found).any() else found

    def rest(self) -> np.ndarray:
        """(nelectrode,) counts of the electrodes at rest."""
        return np.array(self.sensor.rest)

    def vert_xpos(self, physics: mjcf.Physics) -> np.ndarray:
        """Nodes of the skin (nvert, 3) [m] in the BioTac frame."""
        return self._here().vert_xpos(physics.model.ptr, physics.data.ptr)

    def _here(self):
        """Its handle in the whole model."""
        return dataclasses.replace(self.handle, prefix="", body=self.core.full_identifier)

    def contact_patch(self, physics: mjcf.Physics) -> np.ndarray:
        """(6,) contact on the skin, BioTac frame: the point of the deformed skin [m] nearest to the line of
        the total contact force, and the outward direction (against the force); zeros below 1 mN."""
        force = self.read(physics, "contact_force")
        size = np.linalg.norm(force[:3])
        if size < 1e-3:
            return np.zeros(6)
        along, lever = force[:3] / size, np.cross(force[:3], force[3:]) / size**2
        node = self.vert_xpos(physics)[self._outer]
        # of the two intersections, the one on the pushed side
        off = np.linalg.norm(np.cross(node - lever, along), axis=1) + 0.2 * node @ along
        return np.concatenate([node[off.argmin()], -along])


class BioTacObservables(composer.Observables):
    """electrodes (nelectrode,), pac (npac,), pdc, tac, tdc (1,) [counts]; contact_estimate (6,) [m, N],
    contact_force (6,) [N, N m] on the BioTac and contact_patch (6,) [m, -] in its frame; skin (nouter, 3)
    [m]."""

    def readings(self) -> list[Reading]:
        """All observables, as a list of `Reading`s."""
        return [self.get_observable(name) for name in _ALL]

    def enable(self, names: Iterable[str]) -> None:
        """Enables a preset (TACTILE, ESTIMATED, PRIVILEGED) or some of the names, and disables all others.

        Raises:
          ValueError: an unknown name.
        """
        for name in names:
            if name not in _ALL:
                raise ValueError(f"a BioTac has no observable {name!r}: choose from {', '.join(_ALL)}")
        for name in _ALL:
            self.get_observable(name).enabled = name in names

    def _channel(self, name, noise, find=None):
        entity = self._entity

        def corrupt(counts, random_state):
            return np.clip(np.round(counts + noise(entity.sensor, counts, random_state)), 0, FULL_SCALE)

        return Reading(
            lambda physics: entity.read(physics, name),
            noise=corrupt if noise and entity._noise else None,
            find=find,
        )

    @composer.observable
    def electrodes(self) -> Reading:
        return self._channel("electrodes", _electrode_noise)

    @composer.observable
    def pac(self) -> Reading:
        return self._channel("pac", _pac_noise)

    @composer.observable
    def pdc(self) -> Reading:
        return self._channel("pdc", _white("pdc_noise"))

    @composer.observable
    def tac(self) -> Reading:
        return self._channel("tac", _white("tac_noise"))

    @composer.observable
    def tdc(self) -> Reading:
        return self._channel("tdc", _white("tdc_noise"))

    @composer.observable
    def contact_estimate(self) -> Reading:
        return self._channel("electrodes", _electrode_noise, self._entity.contact_estimate)

    @composer.observable
    def contact_force(self) -> Reading:
        return self._channel("contact_force", None)

    @composer.observable
    def contact_patch(self) -> Reading:
        return Reading(self._entity.contact_patch)

    @composer.observable
    def skin(self) -> Reading:
        entity = self._entity
        return Reading(lambda physics: entity.vert_xpos(physics)[entity.outer])


def _electrode_noise(sensor, counts, random_state):
    return sensor.electrode_noise(counts) * random_state.standard_normal(np.shape(counts))


def _white(name):
    def noise(sensor, counts, random_state):
        return getattr(sensor, name) * random_state.standard_normal(np.shape(counts))

    return noise


def _pac_noise(sensor, counts, random_state):
    """Noise that is coloured within a frame; its first sample has the stationary distribution."""
    out = sensor.pac_noise * random_state.standard_normal(np.shape(counts))
    out[0] /= np.sqrt(1 - sensor.pac_colour**2)
    for i in range(1, len(out)):
        out[i] += sensor.pac_colour * out[i - 1]
    return out
