"""`Settings`: what a BioTac is made with, by stage or by keyword, for `attach`, `batch.attach`, `batch.make`
and `press`."""

import dataclasses
import pathlib
import typing
from collections.abc import Collection, Sequence

import numpy as np

from ..fields import either, refuse_unknown
from ..geometry.skin_geometry import SkinGeometry
from ..sensor.signals import SIGNALS, read_signal
from ..short_repr import short_repr
from .config import Config

if typing.TYPE_CHECKING:
    from ..effects.amended import Effects
    from ..skin import Material, SkinOptions

Mesh = str | pathlib.Path | SkinGeometry


def _field(default, keyword=None, option=None):
    """A field that has another name as a keyword, or that is a key of the keyword `options`."""
    return dataclasses.field(default=default, metadata={"keyword": keyword, "option": option})


@dataclasses.dataclass(frozen=True, kw_only=True)
class SkinSettings:
    """The skin of a BioTac.

    Attributes:
      design: which fingertip: "biotac" (None), "biotac_sp", or a folder made by `biotac design new`; see
        `geometry.design`. A mesh in a file contains its design.
      mesh: of it, "coarse", "default" (None), "fine", a file that `biotac lab mesh` wrote, or a
        SkinGeometry. As a keyword it is `skin`.
      material: rubber, filling and electrodes: a preset's name, a dict of Material's fields, a .json file of
        them, or a Material. "calibrated" was fitted to real sensors. None is "default". In a batch also a
        sequence of one for each world, all of one law and element, with as many terms of memory.
      liquid: whether there is liquid under the skin. None: the material's choice.
      tier: "full" finite elements, or "condensed", fast and less exact, for hands and control.
      options: SkinOptions or a dict of its fields; as a keyword `options["skin"]`.
      modulus: a factor on Young's modulus for each element (nelem,), a .npy file of them, or a function of
        positions (n, 3) [m], called with the elements' centroids; as a keyword `options["modulus"]`.
    """

    design: str | pathlib.Path | None = None
    mesh: Mesh | None = _field(None, keyword="skin")
    material: "str | pathlib.Path | dict | Material | Sequence | None" = None
    liquid: bool | None = None
    tier: str = "full"
    options: "SkinOptions | dict | None" = _field(None, option="skin")
    modulus: object = _field(None, option="modulus")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactSettings:
    """Contact of a BioTac with other bodies.

    Attributes:
      coupling: "two-way"; or "one-way": the sensor reads, and pushes nothing.
      geoms: names of the geoms that touch the skin. None: all that collide and are not on the BioTac's own
        links.
      rounding: geom name -> radius of its rounded edges [m]; others are sharp.
      friction: Coulomb coefficient of the skin. None: the material's. In a batch also (nworld,).
      priority: contact priority of the skin, as MuJoCo's of a geom.
      loss: loss factor (tan delta) of the rubber at 50 Hz, in proportion to frequency: how bouncing bodies
        come to rest in two-way coupling. None: 0.2, typical of silicones (0.1 to 0.3); as a keyword
        `options["loss"]`.
      rounds: how often the skin is solved in a step at most; as a keyword `options["rounds"]`.
      threads: in how many threads the skins of the scene are solved side by side; the largest number counts,
        results are the same to the bit; as a keyword `options["threads"]`. Not in batches.
    """

    coupling: str = "two-way"
    geoms: Collection[str] | None = None
    rounding: dict | None = None
    friction: float | Sequence[float] | np.ndarray | None = None
    priority: int = 0
    loss: float | None = _field(None, option="loss")
    rounds: int | None = _field(None, option="rounds")
    threads: int | None = _field(None, option="threads")


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorSettings:
    """Readings of a BioTac.

    Attributes:
      readings: False leaves the electrodes and the other channels out (force and status remain). As a keyword
        it may be a dict of `options` below. Or the name of readings of your own, see
        `biotac_mj.coupling.stepper`; not in batches.
      signal: where the electrodes come from: "physics", conduction in the liquid film; "latent_projection",
        the networks of Narang et al. (ICRA 2021), for every skin of the BioTac; "learned", a network on film
        and strain over each electrode, for the default skin (both trained on synthetic data, see
        docs/lab/learning.md); or a file of weights that `biotac learn train` wrote, *.safetensors.
      individual: whose rest counts, noise and levels: a name of the design's `sensors` ("epfl_f1"), "random"
        (drawn by seed and prefix), or a dict of fields of `sensor.presets.Sensor`. None: the design's own. As
        a keyword it is `sensor`.
      randomise: effects that are drawn by seed and prefix: their names ("dead", "crosstalk"), or {name:
        size}; see `effects.sensors.RANDOM`.
      options: of the readings: noise, film_every_step, temperature, cold, weights, see
        `sensor.readings.PhysicsReadings`; as a keyword `options["readings"]`, where sensor and randomise may
        stand too.
      film: residual_film, electrode_radius [m], excitation, see `sensor.film.read_film`; as a keyword
        `options["film"]`.
      thermal: geom name -> what it is made of. That is a name of `sensor.materials` ("steel", "glass at 40"
        [C]), or a dict with effusivity [W s^0.5 / (m^2 K)] and temperature [C]; of a list one is drawn. {}
        makes all of plastic at 23 C. None leaves heat out.
      textures: geom name -> its surface. That is a name of `sensor.vibration.ROUGHNESS` ("cork"), {"pitch":
        1e-3, "height": 5e-5} [m] of ridges, or {"roughness": 1e-6} [m]; of a list one is drawn. {} makes all
        smooth: PAC feels taps and stick-slip. None leaves vibration out.

    In a batch individual, thermal and textures may be lists of one for each world, which resets leave as they
    are. Where something is drawn, world w begins with what a single sensor of its seed and prefix has, and
    every reset draws again, by its seed.
    """

    readings: bool | str = True
    signal: str | pathlib.Path | None = None
    individual: str | dict | Sequence | None = _field(None, keyword="sensor")
    randomise: Sequence[str] | dict | None = None
    options: dict | None = _field(None, option="readings")
    film: dict | None = _field(None, option="film")
    thermal: dict | Sequence[dict] | None = None
    textures: dict | Sequence[dict] | None = None

    def __post_init__(self):
        has_sensor = self.signal is not None or self.individual is not None or self.randomise is not None
        if self.left_out and has_sensor:
            raise ValueError("readings is False: leave signal, sensor and randomise out")

    @property
    def left_out(self) -> bool:
        """Whether there are no channels."""
        return isinstance(self.readings, bool | np.bool_) and not self.readings


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of a BioTac, by stage; None leaves the default.

        soft = Settings(skin=SkinSettings(mesh="coarse", material="rubber"), seed=3)
        biotac_mj.attach(spec, site="fingertip", settings=soft)
        biotac_mj.attach(spec, site="fingertip", skin="coarse", material="rubber", seed=3)  # the same

    Attributes:
      skin, contact, sensor: see there; each may be given as a dict of its fields.
      effects: what the sensor has beyond the base model: a file that `biotac diagnose` wrote
        (sensor_amended.yaml), or [(Effect, theta)]; see `effects.amended`. Skin, material, options and sensor
        are the file's where none is given here.
      seed: of the noise, and of what is drawn. In a batch of world 0, and world w has seed + w; or (nworld,).
      device: where Warp solves the skin, "cpu" or "cuda:0". Not in batches, which have their own.
      stepper: a skin of your own; see `biotac_mj.coupling.stepper`. Not in batches.
      more: what a skin of your own takes besides; as a keyword further keys of `options`.
      on_error: what happens when `mj_step` fails in this skin: "warn" goes on without its force, "raise"
        raises. Not in batches.

    Raises:
      ValueError: a stage is of another type, or has no such field.
    """

    skin: SkinSettings = SkinSettings()
    contact: ContactSettings = ContactSettings()
    sensor: SensorSettings = SensorSettings()
    effects: "Effects | None" = None
    seed: int | Sequence[int] | np.ndarray = 0
    device: str = "cpu"
    stepper: str = "fem"
    more: dict = dataclasses.field(default_factory=dict)
    on_error: str = "warn"

    def __post_init__(self):
        for name, kind in _STAGES.items():
            value = getattr(self, name)
            if isinstance(value, dict):
                refuse_unknown(value, _names(kind), f"{name} of settings")
                object.__setattr__(self, name, kind(**value))
            elif not isinstance(value, kind):
                raise ValueError(
                    f"{name} of settings is {short_repr(value)}: give {kind.__name__}, or a dict"
                )

    @classmethod
    def of(
        cls,
        settings: "Settings | dict | str | pathlib.Path | None" = None,
        keywords: dict | None = None,
        call: str = "attach",
        without: Collection[str] = (),
        also: Collection[str] = (),
    ) -> "Settings":
        """Settings, and on top of them keywords as `SettingKeywords` has them.

        Args:
          settings: Settings, a dict of its fields, a JSON text of it or a file; None is all by default.
          keywords: each replaces the value in `settings`; None is ignored.
          call: name of the function in errors. without: keywords that it does not take. also: further ones
            that it takes.

        Raises:
          TypeError: unknown keyword. ValueError: two different values of one setting; a value of a wrong
            type. FileNotFoundError: no such file.
        """
        keywords = dict(keywords or {})
        try:
            known = [name for name in _KEYWORDS if name not in without]
            refuse_unknown(keywords, (*known, *also, "settings"), f"a call of {call}")
        except ValueError as error:
            raise TypeError(str(error)) from None
        if not isinstance(settings, cls):
            from ..skin.settings import read_dict

            fields = read_dict(settings, "settings")
            refuse_unknown(fields, _names(cls), "settings")
            settings = cls(**fields)
        for name in without:
            value = settings._keyword(name)
            if value != _DEFAULT._keyword(name):
                raise ValueError(
                    f"{name} of settings is {short_repr(value)}: {call} takes none, leave it out"
                )
        options = keywords.pop("options", None)
        if not isinstance(options, dict | None) or not all(isinstance(key, str) for key in options or ()):
            raise ValueError(f"options is {short_repr(options)}: give a dict of names and values")
        keywords, options = _sensor_moved(keywords, dict(options or {}))
        changes = {_PLACES[name]: value for name, value in keywords.items()}
        return settings._with_options(options)._with(changes)

    @property
    def options(self) -> dict:
        """The settings that were given, as the keyword `options` takes them."""
        given = {name: self._at(place) for name, place in _OPTIONS.items()}
        return {**self.more, **{name: value for name, value in given.items() if value is not None}}

    @property
    def keywords(self) -> dict:
        """The settings as keywords of `attach`: {keyword: value}."""
        return {name: self._keyword(name) for name in _KEYWORDS}

    def _keyword(self, name):
        return self.options if name == "options" else self._at(_PLACES[name])

    def amended(self) -> "Settings":
        """The settings with their effects in skin, material, options and sensor.

        Raises:
          FileNotFoundError, ValueError: see `effects.amended.amend`.
        """
        if self.effects is None:
            return self
        from ..effects.amended import Model, amend
        from ..geometry.skins import skin_of_design

        skin, contact, sensor = self.skin, self.contact, self.sensor
        for name, value in (("material", skin.material), ("sensor", sensor.individual)):
            if isinstance(value, (list, tuple)):
                raise ValueError(f"{name} of each world beside effects: give one of them, or neither")
        mesh = skin.mesh if skin.design is None else skin_of_design(skin.design, skin.mesh)
        model = Model(mesh, skin.material, self.options, sensor.individual, contact.friction, sensor.signal)
        model = amend(model, self.effects)
        given = {"skin": model.skin, "material": model.material}
        if not sensor.left_out:
            given |= {"sensor": model.sensor, "signal": model.signal}
        changes = {_PLACES[name]: value for name, value in given.items()}
        changes[_PLACES["friction"]] = model.friction
        return dataclasses.replace(self._with_options(model.options)._with(changes), effects=None)

    def config(self, name: str = "", mesh: str = "default", geometry: SkinGeometry | None = None) -> Config:
        """The Config that travels in a model; the material's defaults apply where nothing is given.

        Args:
          name: of the sensor. mesh, geometry: see `geometry.skins.skin_reference`; a function for the modulus
            is evaluated on the geometry.

        Raises:
          ValueError: invalid value.
        """
        from ..skin.settings import plain, read_material

        skin, contact, sensor = self.skin, self.contact, self.sensor
        readings = sensor.readings
        if isinstance(readings, bool | np.bool_):
            dumb = geometry is not None and not geometry.design.nelectrode  # a pad without electrodes
            readings = "none" if sensor.left_out or dumb else "biotac"
        elif not isinstance(readings, str):
            raise ValueError(
                f"readings is {short_repr(readings)}: give True, False, a dict of settings, or the name of "
                "your own"
            )
        more = {"sensor": sensor.individual, "randomise": sensor.randomise}
        if sensor.signal is not None:
            weights = sensor.options.get("weights") if isinstance(sensor.options, dict) else None
            signal, more["weights"] = read_signal(sensor.signal, weights)
            readings = "biotac" if signal == "physics" else signal
        more = {key: value for key, value in more.items() if value is not None}
        material, options = plain(skin.material), plain(self.options, geometry)
        if more and isinstance(own := options.get("readings", {}), dict):
            options["readings"] = {**own, **more}
        liquid, friction = skin.liquid, contact.friction
        if isinstance(self.stepper, str) and self.stepper == "fem":
            either("liquid", liquid, options.get("skin"), "options['skin']")
            chosen = read_material(material)
            liquid = chosen.liquid if liquid is None else liquid
            friction = chosen.friction if friction is None else friction
        return Config(
            skin=mesh,
            stepper=self.stepper,
            tier=skin.tier,
            readings=readings,
            material=material,
            liquid=True if liquid is None else liquid,
            coupling=contact.coupling,
            geoms=contact.geoms,
            rounding={} if contact.rounding is None else contact.rounding,
            thermal=sensor.thermal,
            textures=sensor.textures,
            priority=contact.priority,
            seed=self.seed,
            name=name,
            device=self.device,
            options=options,
            on_error=self.on_error,
            **({} if friction is None else {"friction": friction}),
        )

    def _at(self, place):
        stage, field = place
        return getattr(getattr(self, stage) if stage else self, field)

    def _with(self, changes):
        """The settings with {(stage or "", field): value} instead; None is ignored where it is the
        default."""
        changes = {
            place: value
            for place, value in changes.items()
            if value is not None or _DEFAULT._at(place) is not None
        }
        own = {field: value for (stage, field), value in changes.items() if not stage}
        for name in _STAGES:
            inside = {field: value for (stage, field), value in changes.items() if stage == name}
            own[name] = dataclasses.replace(getattr(self, name), **inside)
        return dataclasses.replace(self, **own)

    def _with_options(self, options):
        """The settings with the values of the keyword `options` in their places."""
        own = {name: value for name, value in options.items() if name not in _OPTIONS}
        changes = {_OPTIONS[name]: value for name, value in options.items() if name in _OPTIONS}
        return self._with(changes | ({("", "more"): own} if own else {}))


class SettingKeywords(typing.TypedDict, total=False):
    """Settings as keywords; each belongs to a stage of `Settings`.

    A name that is given in two places, such as `sensor` and `readings={"sensor": ...}`, must have one value.

    Attributes:
      design, skin, material, liquid, tier: see `SkinSettings`.
      coupling, geoms, rounding, friction, priority: see `ContactSettings`.
      sensor, randomise, signal, thermal, textures: see `SensorSettings`.
      readings: True, False, a name, or a dict of settings: see `SensorSettings.readings` and `options`.
      effects, seed, device, stepper, on_error: see `Settings`.
      options: further ones by part: "skin" and "modulus" of `SkinSettings`, "film" and "readings" of
        `SensorSettings`, "loss", "rounds" and "threads" of `ContactSettings`.
    """

    design: str | pathlib.Path | None
    skin: Mesh | None
    material: "str | pathlib.Path | dict | Material | Sequence | None"
    liquid: bool | None
    coupling: str
    geoms: Collection[str] | None
    rounding: dict | None
    thermal: dict | Sequence[dict] | None
    textures: dict | Sequence[dict] | None
    sensor: str | dict | Sequence | None
    randomise: Sequence[str] | dict | None
    effects: "Effects | None"
    friction: float | Sequence[float] | np.ndarray | None
    priority: int
    seed: int | Sequence[int] | np.ndarray
    device: str
    stepper: str
    tier: str
    readings: bool | dict | str
    signal: str | pathlib.Path | None
    options: dict | None
    on_error: str


def _names(kind):
    return [field.name for field in dataclasses.fields(kind)]


_STAGES = {"skin": SkinSettings, "contact": ContactSettings, "sensor": SensorSettings}
_KEYWORDS = tuple(SettingKeywords.__annotations__)
_DEFAULT = Settings()
# keyword, or key of the keyword `options` -> (stage or "", field)
_PLACES, _OPTIONS = {}, {}
for _stage, _kind in (*_STAGES.items(), ("", Settings)):
    for _one in dataclasses.fields(_kind):
        if option := _one.metadata.get("option"):
            _OPTIONS[option] = _stage, _one.name
        elif _stage or _one.name not in _STAGES:
            _PLACES[_one.metadata.get("keyword") or _one.name] = _stage, _one.name


def _sensor_moved(keywords, options):
    """Keywords and options, with the settings of a sensor inside `readings` and options["readings"] moved to
    the keywords."""
    signal, readings = keywords.get("signal"), keywords.get("readings")
    if signal is not None and not isinstance(signal, (str, pathlib.Path)):
        raise ValueError(
            f"signal is {short_repr(signal)}: give one of {', '.join(SIGNALS)}, or a file of weights"
        )
    places = [("options['readings']", options.get("readings"), ("sensor", "randomise"))]
    if isinstance(readings, dict):
        places = [("readings", readings, ("signal", "sensor", "randomise")), *places]
        keywords["readings"] = True
    own = {}
    for where, given, of_sensor in places:
        if given is None:
            continue
        if not isinstance(given, dict):  # its reader raises the error
            return keywords, options
        for name in of_sensor:
            keywords[name] = either(name, keywords.get(name), given, where)
        rest = {name: value for name, value in given.items() if name not in of_sensor}
        own |= {name: either(name, own.get(name), rest, where) for name in rest}
    return keywords, {**options, "readings": own or None}
