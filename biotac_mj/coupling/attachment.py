"""`attach`: puts a BioTac into any MjSpec."""

import importlib.resources
import importlib.util
import pathlib
import typing

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from ..fields import as_whole
from ..geometry.skins import skin_of_design, skin_reference
from ..sensor.materials import check_geoms, read_thermal
from ..sensor.vibration import read_texture
from .config import PLUGIN_NAME, TO_COME, collides
from .handle import Handle
from .parts import add_parts, add_slots, check_place, check_touching
from .settings import SettingKeywords, Settings
from .stepper import check_names, make_readings
from .touching import geom_type, outside_geoms

_MOST_SLOTS = 100_000  # a second or two of attaching; beyond any scene


def attach(
    spec: mujoco.MjSpec,
    *,
    site: str | None = None,
    body: str | None = None,
    pos: ArrayLike = (0.0, 0.0, 0.0),
    quat: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    prefix: str = "biotac_",
    slots: int | None = None,
    settings: Settings | dict | str | pathlib.Path | None = None,
    **keywords: typing.Unpack[SettingKeywords],
) -> Handle:
    """Adds a BioTac with its skin, sensors and engine plugin to a model.

    Objects may come before or after it: there is room for those that are in the model now and for 64 more.

        biotac_mj.attach(spec, site="fingertip", skin="coarse", tier="condensed", thermal={"mug": "ceramic"})

    Args:
      spec: the MjSpec to change.
      site, body: where the BioTac is fixed: the name of a site or of a body, one of them. body="world" is the
        world.
      pos, quat: (3,) [m], (4,) (w, x, y, z), pose of the BioTac frame at that site or body.
      prefix: of every name that is added. Give each BioTac of a model its own, by which its noise and what is
        drawn are its own too.
      slots: how many bodies may touch two-way. None: as many as are in `spec`, and 64 more.
      settings: what the BioTac is made with, for code that gives the same to several functions: Settings, a
        dict of its fields, or a .json file of them.
      keywords: the same by name, on top of `settings`; see `coupling.Settings` for their values. Skin:
        `design` ("biotac", "biotac_sp", a folder), `skin` ("coarse", "default", "fine", a file), `material`,
        `liquid`, `tier` ("full", "condensed"), `stepper`. Contact: `coupling` ("two-way", "one-way"),
        `geoms`, `rounding`, `friction`, `priority`. Sensor: `readings`, `signal`, `sensor`, `randomise`,
        `thermal`, `textures`. Besides: `effects`, `seed`, `device`, `on_error` ("warn", "raise"), and further
        ones by part in `options`.

    Returns:
      Handle, to read the sensor.

    Raises:
      ValueError: no place or two, an unknown name anywhere, a value that cannot be, a device that is not
        there; the prefix is taken. The spec is then as it was.
      TypeError: spec is no MjSpec, or an unknown keyword. FileNotFoundError: no such file.
      ModuleNotFoundError: CUDA or the readings need a package that is not installed.
    """
    check_place(spec, site, body, prefix, pos, quat)
    own = ("site", "body", "pos", "quat", "prefix", "slots")
    chosen = Settings.of(settings, keywords, also=own).amended()
    text, geometry = skin_reference(skin_of_design(chosen.skin.design, chosen.skin.mesh))
    config = chosen.config(prefix, text, geometry)
    check_geoms("thermal", config.thermal, read_thermal)
    check_geoms("textures", config.textures, read_texture)
    _check(config, geometry)
    named = *(config.geoms or ()), *config.rounding, *(config.thermal or {}), *(config.textures or {})
    check_touching(spec, named, config.geoms)
    _check_rounding(spec, config)
    if slots is not None:
        slots = as_whole("slots", slots, 0, _MOST_SLOTS)
    else:
        there = {g.parent.name or id(g.parent) for g in spec.geoms if collides(g)}
        slots = len(there) + TO_COME
    core = add_parts(spec, geometry, site, body, pos, quat, prefix, config)
    _activate(spec, core, prefix + "skin", config)
    if config.coupling == "two-way":
        add_slots(spec, core, prefix, slots)
    return Handle(prefix, core.name, config)


def _check(config, geometry):
    """Raises errors that would otherwise occur in the plugin's first call or in the readings."""
    check_names(config)
    make_readings(config, geometry, [], None)
    if config.stepper == "fem":
        from ..skin.condensed.refusals import refuse
        from ..skin.model import check_modulus
        from .steppers.fem import rest_geometry, skin_settings

        material, options, modulus = skin_settings(config)
        liquid = config.liquid if options.liquid is None else options.liquid
        if config.tier == "condensed":
            refuse(material.extensions, options, liquid, config.device.startswith("cuda"))
        if modulus is not None:
            check_modulus(modulus, len(geometry.elem), f"{len(geometry.elem)} elements of {geometry.name!r}")
    if config.device != "cpu":
        _check_device(config.device)
    if config.stepper == "fem":
        rest_geometry(config, geometry)  # a filling that the skin has not, or does not hold


def _check_device(name):
    import warp

    try:
        found = warp.get_device(name)
    except (ValueError, RuntimeError):
        there = ", ".join(device.alias for device in warp.get_devices())
        raise ValueError(f"no device {name!r} on this machine: it has {there}") from None
    if found.is_cuda and importlib.util.find_spec("torch") is None:
        raise ModuleNotFoundError(f"device {name!r} needs torch: pip install 'biotac-mj[cuda]'")


def _check_rounding(spec, config):
    """Checks the rounding of touching solids whose sizes are known before the model is compiled."""
    from ..skin.geoms import SIZES, check_rounding

    for name, radius in config.rounding.items():
        if config.geoms is not None and name not in config.geoms:
            raise ValueError(outside_geoms(name))
        geom = next(g for g in spec.geoms if g.name == name)
        size = np.array(geom.size)[: SIZES.get(geom_type(geom.type), 0)]
        check_rounding(f"geom {name!r}", size[size > 0], radius)


def _activate(spec, body, name, config):
    if PLUGIN_NAME not in [p.plugin_name for p in spec.plugins]:
        spec.activate_plugin(PLUGIN_NAME)
    plugin = spec.add_plugin(name=name, plugin_name=PLUGIN_NAME, active=True)
    plugin.config = config.strings()
    # an instance that no body refers to would be lost when this model is attached to another
    body.plugin.active, body.plugin.name, body.plugin.plugin_name = True, name, PLUGIN_NAME
