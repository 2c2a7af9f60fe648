"""`attach`: puts a BioTac into any MjSpec."""

import importlib.resources
import importlib.util
import pathlib
import typing
from collections.abc import Collection, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from ..fields import as_whole, either
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.skins import skin_reference
from ..sensor.materials import check_geoms, read_thermal
from ..sensor.vibration import read_texture
from ..shown import shown
from .config import PLUGIN_NAME, TO_COME, Config
from .handle import Handle
from .parts import add_parts, add_slots, check_place, check_touching
from .sensing.options import read_signal
from .stepper import check_names, make_readings
from .touching import geom_type, outside_geoms

if typing.TYPE_CHECKING:
    from ..skin import Material

__all__ = ["attach"]

_MOST_SLOTS = 100_000  # a second or two of attaching; beyond any scene


def attach(
    spec: mujoco.MjSpec,
    *,
    site: str | None = None,
    body: str | None = None,
    pos: ArrayLike = (0.0, 0.0, 0.0),
    quat: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    prefix: str = "biotac_",
    skin: str | pathlib.Path | SkinGeometry | None = None,
    material: "str | dict | Material | None" = None,
    liquid: bool | None = None,
    coupling: str = "two-way",
    geoms: Collection[str] | None = None,
    rounding: dict | None = None,
    thermal: dict | None = None,
    textures: dict | None = None,
    sensor: str | dict | None = None,
    randomise: Sequence[str] | dict | None = None,
    effects: str | pathlib.Path | Sequence[tuple] | None = None,
    friction: float | None = None,
    priority: int = 0,
    seed: int = 0,
    device: str = "cpu",
    stepper: str = "fem",
    tier: str = "full",
    readings: bool | dict | str = True,
    signal: str | pathlib.Path | None = None,
    options: dict | None = None,
    slots: int | None = None,
    on_error: str = "warn",
) -> Handle:
    """Adds a BioTac with its skin, sensors and engine plugin to a model.

    Add the objects that it shall touch first: the model gets room for the bodies that are in it now.

    Args:
      spec: the MjSpec to change.
      site, body: where the BioTac is fixed: the name of a site or of a body, one of them. body="world" is the
        world.
      pos, quat: (3,) [m], (4,) (w, x, y, z), pose of the BioTac frame at that site or body.
      prefix: of every name that is added. Give each BioTac of a model its own.
      skin: mesh of the skin: "coarse", "default" (None), "fine", a file that `biotac import-mesh` wrote, or a
        SkinGeometry.
      material: rubber, filling and electrodes: a preset's name, a dict of Material's fields, a .json file of
        them, or a Material. "calibrated" was fitted to real sensors. None is "default".
      liquid: whether there is liquid under the skin. None: the material's choice.
      coupling: "two-way"; or "one-way": the sensor reads, and pushes nothing.
      geoms: names of the geoms that touch the skin. None: all that collide and are not on the BioTac's own
        links.
      rounding: geom name -> radius of its rounded edges [m].
      thermal: geom name -> what it is made of. That is a name of `sensor.materials` ("steel", "glass at 40"
        [C]), or a dict with effusivity [W s^0.5 / (m^2 K)] and temperature [C]; of a list one is drawn. {}
        makes all of plastic at 23 C. None leaves heat out.
      textures: geom name -> its surface. That is a name of `sensor.vibration.ROUGHNESS` ("cork"), {"pitch":
        1e-3, "height": 5e-5} [m] of ridges, or {"roughness": 1e-6} [m]; of a list one is drawn. {} makes all
        smooth: PAC feels taps and stick-slip. None leaves vibration out.
      sensor: whose rest counts, noise and levels: a name of `sensor.presets.NAMES` ("epfl_f1"), "random"
        (drawn by seed and prefix), or a dict of fields of `sensor.presets.Sensor`. None is "1". The same as
        options["readings"]["sensor"].
      randomise: effects that are drawn by seed and prefix: their names ("dead", "crosstalk"), or {name:
        size}; see `effects.sensors.RANDOM`. The same as options["readings"]["randomise"].
      effects: what the sensor has beyond the base model: a file that `biotac diagnose` wrote
        (sensor_amended.yaml), or [(Effect, theta)]; see `effects.amended`. Skin, material, options and sensor
        are the file's where none is given here.
      friction: Coulomb coefficient of the skin. None: the material's.
      priority: contact priority of the skin, as MuJoCo's of a geom.
      seed: of the noise, and of what is drawn.
      device: where Warp solves the skin, "cpu" or "cuda:0".
      stepper: a skin of your own; see `biotac_mj.coupling.stepper`.
      tier: "full" finite elements, or "condensed" for real time on one CPU core.
      readings: False leaves the electrodes and the other channels out (force and status remain); True, or a
        dict of settings: noise, film_every_step, temperature, cold, weights, see
        `sensor.readings.PhysicsReadings`, the same as options["readings"]. Or the name of readings of your
        own, see `biotac_mj.coupling.stepper`.
      signal: where the electrodes come from: "physics", "learned", or a file of weights, *.safetensors; see
        `ReadingsOptions`.
      options: further settings, by part. "skin": SkinOptions or a dict of its fields. "modulus": a factor on
        Young's modulus for each element (nelem,), a .npy file of them, or a function of positions (n, 3) [m],
        asked at the elements' centroids. "film": residual_film, electrode_radius [m], excitation, see
        `sensor.film.read_film`. "readings": see there. "rounds": how often the skin is solved in a step at
        most. "threads": in how many the skins of the scene are solved side by side; the largest number
        counts, results are the same to the bit.
      slots: how many bodies may touch two-way. None: as many as are in `spec`, and some more.
      on_error: what happens when `mj_step` fails in this skin: "warn" goes on without its force, "raise"
        raises.

    Returns:
      Handle, to read the sensor.

    Raises:
      ValueError: no place or two, an unknown name anywhere, a value that cannot be, a device that is not
        there; the prefix is taken. The spec is then as it was.
      TypeError: spec is no MjSpec. FileNotFoundError: no such file.
      ModuleNotFoundError: CUDA or the readings need a package that is not installed.
    """
    check_place(spec, site, body, prefix, pos, quat)
    from ..skin.settings import plain

    if not isinstance(stepper, str):
        raise ValueError(f"stepper is {shown(stepper)}: give its name")
    if signal is not None and not isinstance(signal, (str, pathlib.Path)):
        raise ValueError(f"signal is {shown(signal)}: give 'physics', 'learned', or a file of weights")
    if not isinstance(options, (dict, type(None))):
        raise ValueError(f"options is {shown(options)}: give a dict")
    readings, signal, options = _readings(readings, signal, sensor, randomise, options)
    told = options.get("readings") if isinstance(options, dict) else None
    sensor, randomise = (
        either(name, value, told, "options['readings']")
        for name, value in (("sensor", sensor), ("randomise", randomise))
    )
    if effects is not None:
        from ..effects.amended import Model, amend

        amended = amend(Model(skin, material, options, sensor, friction), effects)
        skin, material, options = amended.skin, amended.material, amended.options
        sensor, friction = amended.sensor, amended.friction
    text, geometry = skin_reference("default" if skin is None else skin)

    material, options = plain(material), plain({} if options is None else options, geometry)
    own = {k: v for k, v in (("sensor", sensor), ("randomise", randomise)) if v is not None}
    if signal is not None:
        name, weights = read_signal(signal)
        readings = "biotac" if name == "physics" else name
        own |= {} if weights is None else {"weights": weights}
    if own and isinstance(options.get("readings", {}), dict):
        options = {**options, "readings": {**options.get("readings", {}), **own}}
    if stepper == "fem":
        either("liquid", liquid, options.get("skin"), "options['skin']")
        liquid, friction = _material_choices(material, liquid, friction)
    config = Config(
        skin=text,
        stepper=stepper,
        tier=tier,
        readings=readings,
        material=material,
        liquid=True if liquid is None else liquid,
        coupling=coupling,
        geoms=geoms,
        rounding={} if rounding is None else rounding,
        thermal=thermal,
        textures=textures,
        priority=priority,
        seed=seed,
        name=prefix,
        device=device,
        options=options,
        on_error=on_error,
        **({} if friction is None else {"friction": friction}),
    )
    check_geoms("thermal", config.thermal, read_thermal)
    check_geoms("textures", config.textures, read_texture)
    _check(config, geometry)
    named = *(config.geoms or ()), *config.rounding, *(config.thermal or {}), *(config.textures or {})
    check_touching(spec, named)
    _check_rounding(spec, config)
    if slots is not None:
        slots = as_whole("slots", slots, 0, _MOST_SLOTS)
    else:
        there = {g.parent.name or id(g.parent) for g in spec.geoms if g.contype or g.conaffinity}
        slots = len(there) + TO_COME
    core = add_parts(
        spec, geometry, site, body, pos, quat, prefix, config.friction, config.priority, config.geoms
    )
    _activate(spec, core, prefix + "skin", config)
    if config.coupling == "two-way":
        add_slots(spec, core, prefix, slots)
    return Handle(prefix, core.name, config)


def _readings(readings, signal, sensor, randomise, options):
    """The readings' name, the signal and the options, with what a dict of settings says in its places."""
    if isinstance(readings, dict):
        there = (options or {}).get("readings", {})
        if isinstance(there, dict):  # else what reads it says so
            own = {
                k: either(k, v, there, "options['readings']") for k, v in readings.items() if k != "signal"
            }
            options = {**(options or {}), "readings": {**there, **own}}
        return "biotac", either("signal", signal, readings, "readings"), options
    if isinstance(readings, bool | np.bool_):
        if not readings and not (signal is sensor is randomise is None):
            raise ValueError("readings is False: leave signal, sensor and randomise out")
        return "biotac" if readings else "none", signal, options
    if not isinstance(readings, str):
        raise ValueError(
            f"readings is {shown(readings)}: give True, False, a dict of settings, or the name of your own"
        )
    return readings, signal, options


def _material_choices(material, liquid, friction):
    from ..skin.settings import read_material

    chosen = read_material(material)
    return chosen.liquid if liquid is None else liquid, chosen.friction if friction is None else friction


def _check(config, geometry):
    """What would fail in the plugin's first call, or on the way of the readings."""
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
    """Of geoms that touch, solids whose sizes are known before the model is compiled."""
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
