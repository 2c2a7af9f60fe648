"""A model with effects: each effect becomes a change of the skin, its contact, its liquid or the sensor's
constants, so that every path that uses these has the effect."""

import dataclasses
import pathlib
import warnings
from collections.abc import Sequence

import numpy as np

from ..geometry.skin_geometry import SkinGeometry
from ..geometry.skins import design_of, skin_reference
from ..sensor.presets import Sensor, read_sensor
from ..short_repr import short_repr
from ..skin.contact.law import ContactLaw
from ..skin.model import SkinOptions
from ..skin.settings import plain, read_dict, read_material, read_modulus
from .catalogue import CATALOGUE
from .effect import STAGES, Effect, Whole
from .in_skin import memory_of
from .sensor_file import SensorFile, read_sensor_file
from .sensors import with_effects

__all__ = ["Effects", "Model", "amend", "amend_settings", "take_effects"]

Effects = str | pathlib.Path | Sequence[tuple[Effect, dict]]  # as in `attach`

_AIR = 101325.0  # [Pa]
# parameters that the diagnosis fits to residuals and that no running sensor has: independent changes of the
# film, the pressure or the skin, and a bus delay of PDC
_DIAGNOSIS_ONLY = ("film", "liquid", "more", "sink", "of_pdc")
_ORDER = {effect.id: i for i, effect in enumerate(CATALOGUE)}


@dataclasses.dataclass
class Model:
    """Settings of a sensor, as for `attach`: `skin`, `material`, `options` and `sensor` may be None.
    `friction` is the caller's."""

    skin: str | pathlib.Path | SkinGeometry | None
    material: object
    options: dict | None
    sensor: object
    friction: object


def take_effects(effects: Effects) -> tuple[SensorFile, str]:
    """A sensor file, or [(Effect, theta)] without a base model; and the source's name.

    Raises:
      FileNotFoundError, ValueError: see `sensor_file.read_sensor_file`; not such a list.
    """
    if isinstance(effects, (str, pathlib.Path)):
        return read_sensor_file(effects), str(effects)
    try:
        pairs = [(effect, {**effect.default(), **theta}) for effect, theta in effects]
    except (TypeError, ValueError, AttributeError):
        raise ValueError(
            f"effects is {short_repr(effects)}: give a sensor file, or a list of (Effect, theta)"
        ) from None
    return SensorFile({}, pairs, {}), "effects"


def amend(model: Model, effects: Effects) -> Model:
    """The model with effects; settings that it leaves open come from the base model of their file.

    Effects of the set-up (misalignment, the tool's radius) belong to the place of the data: they are ignored
    with a warning, like parameters that only the diagnosis has, such as a film's own lag.

    Args:
      effects: a sensor file, such as `biotac diagnose` writes, or [(Effect, theta)].

    Raises:
      FileNotFoundError, ValueError: see `take_effects`; an effect that a running sensor cannot have.
    """
    file, where = take_effects(effects)
    base, omitted = file.base, []
    skin = base.get("skin", "default") if model.skin is None else model.skin
    material = read_material(base.get("material") if model.material is None else model.material)
    options = {**base.get("options", {}), **(model.options or {})}
    given = base.get("sensor") if model.sensor is None else model.sensor
    sensor = read_sensor(given, design=design_of(skin))
    factor = float(base.get("modulus_factor", 1.0))
    material = dataclasses.replace(material, youngs_modulus=factor * material.youngs_modulus)
    whole, friction, of_sensor, of_rubber = Whole(), model.friction, [], []
    for effect, theta in sorted(file.effects, key=lambda pair: _ORDER.get(pair[0].id, len(_ORDER))):
        theta = effect.in_whole(whole, theta)
        if theta is None:
            continue
        if effect.of_setup(theta):
            omitted.append(effect)
        elif effect.runs:
            of_sensor.append((effect, theta))
        else:
            of_rubber.append((effect, theta))
    material = dataclasses.replace(material, youngs_modulus=whole.modulus * material.youngs_modulus)
    if friction is None:
        material = dataclasses.replace(material, friction=whole.friction * material.friction)
    elif whole.friction != 1.0:
        friction = whole.friction * np.asarray(friction, float)
    inside = memory_of(of_rubber)
    if inside.rest:
        raise ValueError(f"{where}: no running sensor can have the effect {inside.rest[0][0].id!r}")
    if omitted:
        names = ", ".join(f"{effect.id} ({STAGES[effect.stage]})" for effect in omitted)
        warnings.warn(f"{where}: left out, not of the sensor itself: {names}", stacklevel=4)
    diagnosis_only = [
        f"{e.id}'s {name}" for e, theta in file.effects for name in _DIAGNOSIS_ONLY if theta.get(name)
    ]
    if diagnosis_only:
        warnings.warn(f"{where}: left out, of the diagnosis alone: {', '.join(diagnosis_only)}", stacklevel=4)
    material = dataclasses.replace(material, **_joined(material, inside.material))
    if inside.contact or whole.air or whole.lost:
        liquid = _liquid(skin_reference(skin)[1])
        bulk, lost = whole.air / (_AIR * liquid), whole.lost * liquid
        options["skin"] = _skin_options(options.get("skin"), inside.contact, bulk, lost)
    if inside.model:
        options["modulus"] = _modulus(options.get("modulus"), inside.model["modulus"], skin)
    return Model(skin, material, options, _plain_sensor(with_effects(sensor, of_sensor)), friction)


def amend_settings(given: dict, kind: type, effects: Effects) -> dict:
    """Settings of a dataclass, such as PressOptions, with effects; default values of `kind` are replaced by
    those of the effects' file.

    Raises:
      FileNotFoundError, ValueError: see `amend`.
    """
    default = {f.name: f.default for f in dataclasses.fields(kind)}
    names = [f.name for f in dataclasses.fields(Model) if f.name in default]
    said = {name: None if given.get(name) == default[name] else given.get(name) for name in names}
    said["options"] = read_dict(said["options"], "options")
    out = amend(Model(**{f.name: said.get(f.name) for f in dataclasses.fields(Model)}), effects)
    return {**given, **{name: plain(getattr(out, name)) for name in names}}


def _joined(material, new):
    """The material with further terms of memory."""
    out = {k: v for k, v in new.items() if k not in ("prony", "hysteresis")}
    for name in ("prony", "hysteresis"):
        if new.get(name):
            out[name] = (*getattr(material, name), *new[name])
    return out


def _skin_options(given, contact, bulk, lost):
    options = given if isinstance(given, SkinOptions) else SkinOptions(**read_dict(given, "options['skin']"))
    changes = dict(contact)
    if "contact_law" in changes:
        law = options.contact_law or ContactLaw()
        changes["contact_law"] = dataclasses.replace(law, **changes["contact_law"])
    if bulk:  # liquid and air in series: V / K + V0 / p0
        changes["bulk_modulus"] = 1 / (1 / options.bulk_modulus + bulk)
    if lost:
        changes["fill_volume"] = options.fill_volume - lost
    if "tolerance" in changes:
        changes["tolerance"] = min(changes["tolerance"], options.tolerance)
    return plain(dataclasses.replace(options, **changes))


def _modulus(given, function, skin):
    """Combined factors on the elements' modulus."""
    before, geometry = read_modulus(given), skin_reference(skin)[1]
    factors = np.array(plain(function, geometry))
    if before is not None:
        factors = factors * (np.array(plain(before, geometry)) if callable(before) else before)
    return factors.tolist()


def _liquid(geometry):
    """Volume between skin and core [m^3]."""

    def volume(vert, face):
        a, b, c = (vert[face[:, i]] for i in range(3))
        return abs((np.cross(a, b) * c).sum()) / 6

    return volume(geometry.vert, geometry.inner_face) - volume(geometry.core_vert, geometry.core_face)


def _plain_sensor(sensor: Sensor) -> dict:
    return plain({f.name: getattr(sensor, f.name) for f in dataclasses.fields(sensor)})
