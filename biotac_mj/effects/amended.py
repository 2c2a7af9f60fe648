"""A model with effects: each effect becomes a change of the skin, its contact, its liquid or the sensor's
constants, so that every path that uses these has the effect."""

import dataclasses
import pathlib
import warnings
from collections.abc import Sequence

import numpy as np

from ..fields import either
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.skins import design_of, skin_reference
from ..geometry.tet_mesh import enclosed_volume
from ..sensor.presets import read_sensor
from ..short_repr import short_repr
from ..skin.model import SkinOptions
from ..skin.settings import plain, read_dict, read_material, read_modulus
from .catalogue import CATALOGUE
from .effect import STAGES, Effect, Whole
from .in_skin import memory_of, moduli
from .sensor_file import SensorFile, read_sensor_file
from .sensors import with_effects

Effects = str | pathlib.Path | Sequence[tuple[Effect, dict]]  # as in `attach`

_AIR = 101325.0  # [Pa]
# parameters that the diagnosis fits to residuals and that no running sensor has: independent changes of the
# film, the pressure or the skin, and a bus delay of PDC
_DIAGNOSIS_ONLY = ("film", "liquid", "more", "sink", "of_pdc")
_ORDER = {effect.id: i for i, effect in enumerate(CATALOGUE)}


@dataclasses.dataclass
class Model:
    """Settings of a sensor, as for `attach`; None stands for a default. Only `friction`, which the caller
    gives, is never None."""

    skin: str | pathlib.Path | SkinGeometry | None
    material: object
    options: dict | None
    sensor: object
    friction: object
    signal: str | pathlib.Path | None = None


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
      FileNotFoundError, ValueError: see `take_effects`; an effect that a running sensor cannot have; another
        signal than the file's.
    """
    file, where = take_effects(effects)
    signal = either("signal", model.signal, file.base, where)
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
    material = inside.rubber(material)
    if inside.contact or whole.air or whole.lost:
        given = options.get("skin")
        if not isinstance(given, SkinOptions):
            given = SkinOptions(**read_dict(given, "options['skin']"))
        options["skin"] = plain(with_liquid(inside.options(given), whole, skin_reference(skin)[1]))
    if inside.model:
        given = read_modulus(options.get("modulus"))
        options["modulus"] = plain(moduli(given, inside.model["modulus"], skin_reference(skin)[1]))
    return Model(skin, material, options, plain(vars(with_effects(sensor, of_sensor))), friction, signal)


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


def with_liquid(options: SkinOptions, whole: Whole, geometry: SkinGeometry) -> SkinOptions:
    """SkinOptions with the air in the liquid and without the lost part of it."""
    liquid, changes = _liquid(geometry), {}
    if whole.air:  # liquid and air in series: V / K + V0 / p0
        changes["bulk_modulus"] = 1 / (1 / options.bulk_modulus + whole.air / (_AIR * liquid))
    if whole.lost:
        changes["fill_volume"] = options.fill_volume - whole.lost * liquid
    return dataclasses.replace(options, **changes)


def _liquid(geometry):
    """Volume between skin and core [m^3]."""
    solids = (geometry.vert, geometry.inner_face), (geometry.core_vert, geometry.core_face)
    cavity, core = (abs(enclosed_volume(*solid)) for solid in solids)
    return cavity - core
