"""`attach` makes the skins of a batch and hooks them into `mujoco_warp.step`; `make` makes skins for any
other simulator. Both take a model that `add` changed."""

import dataclasses
import pathlib
import typing

import mujoco
import numpy as np
import warp as wp

from ..coupling.config import Config, refuse_two_way
from ..coupling.handle import SENSORS
from ..coupling.implicit import energy, poses, rounds, rows
from ..coupling.implicit.metric import roots_of
from ..coupling.instance import NO_CONTACT, NO_PASSIVE
from ..coupling.sensing.counts import film_of
from ..coupling.settings import SensorSettings, SettingKeywords, Settings
from ..coupling.setup import skin_thickness
from ..coupling.steppers.fem import rest_geometry, shared_model, skin_settings
from ..coupling.structs import ModelView
from ..coupling.touching import Touching, find_geoms, friction_of
from ..fields import as_whole
from ..geometry import closest, core_surface
from ..geometry.skins import skin_of_design, skin_reference
from ..sensor import acquisition_kernels
from ..sensor.film import kernels as film_kernels
from ..sensor.materials import check_geoms, read_thermal
from ..sensor.signals import read_signal
from ..sensor.vibration import read_texture
from ..short_repr import short_repr
from ..skin import liquid, transfer
from ..skin.condensed import step as condensed_step
from ..skin.contact import clearance, meshes, outside
from ..skin.geoms import shapes_of
from ..skin.newton.worlds import BLOCK
from ..skin.per_world import make_room
from ..skin.program import compile_ahead, finish_compiling
from ..skin.rubber.material import Material
from ..skin.settings import Settings as SkinModelSettings
from ..skin.settings import read_material
from ..skin.step import kernels_for_cuda
from . import kernels, rest
from .ahead import kernels_of_step, launched_by
from .batch import Batch
from .hook import Hook
from .implicit import integrator
from .senses import Senses, draws
from .skin import BatchSkin
from .skins import PoseBatch
from .solid_contacts import set_solids

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

# what takes long to compile, or is launched first: it begins before the skin is made
_KERNELS = [meshes, closest, liquid, rest, rounds, film_kernels, core_surface]
_KERNELS += [kernels, transfer, acquisition_kernels, poses, rows, energy, integrator]
# keywords of `biotac_mj.attach` that a batch has no use for
_NOT_OF_WORLDS = ("device", "stepper", "on_error")
_ROWLESS = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT) | int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)


def attach(
    mjm: mujoco.MjModel,
    m: "mjw.Model",
    d: "mjw.Data",
    *,
    prefix: str = "biotac_",
    settings: Settings | dict | str | pathlib.Path | None = None,
    worlds: dict | None = None,
    **keywords: typing.Unpack[SettingKeywords],
) -> Batch:
    """Step 2 of 2, after `add(spec)` and the compilation: makes a skin for each world of a mujoco_warp Data
    and hooks them into its Model, so that `mjw.step(m, d)` steps them too. `biotac_mj.attach(spec)` is
    another function: for `mj_step` it does both steps at once, and takes the place of `add`.

        prefix = batch.add(spec, site="tip")
        mjm = spec.compile()
        mjd = mujoco.MjData(mjm)
        mujoco.mj_forward(mjm, mjd)
        m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=1024)
        biotac = batch.attach(mjm, m, d, prefix=prefix)

    Args:
      mjm: the MjModel, made from a spec that `add` changed; m, d: mujoco_warp's Model and Data of it. Make
        room for six constraint rows per touching body that moves: `mjw.put_data(mjm, mjd, nworld)` after
        `mj_forward` does, `mjw.make_data` with `njmax`.
      prefix: as given to `add`.
      settings, keywords: as for `biotac_mj.attach`, but for device, stepper and on_error; skin as given to
        `add`. friction is that of core, nail and clamp in m too. `coupling.Settings` lists what may differ by
        world: material, friction, seed, sensor, thermal and textures.
      worlds: in what the worlds differ besides: some of friction_exponent, friction_pressure, adhesion,
        adhesion_hysteresis (`ContactLaw`), bulk_modulus [Pa], fill_volume [m^3] (`SkinData.set_liquid`), each
        a number or (nworld,), and modulus (nworld, nelem). `batch.skin.data` changes them later.

    Raises:
      ValueError: the model has no such BioTac, is stepped by Runge-Kutta or `discrete`, has passive forces or
        (two-way) equality constraints disabled, or has no room for the rows; a number of materials or
        frictions that is not nworld; a value that cannot be. TypeError: no MjModel, Model or Data, or an
        unknown keyword.
    """
    chosen = _read_arguments(mjm, prefix, worlds, settings, keywords, "batch.attach", _NOT_OF_WORLDS)
    if not hasattr(m, "eq_active0") or not hasattr(d, "eq_active") or not hasattr(d, "njmax"):
        raise TypeError(
            f"m is {type(m).__name__} and d is {type(d).__name__}: pass mujoco_warp's Model and Data of mjm"
        )
    if m.nbody != mjm.nbody or d.qpos.shape[1] != mjm.nq:
        raise ValueError("m and d are of another model than mjm: make them with mjw.put_model(mjm), put_data")
    device = str(d.qpos.device)
    coupling = chosen.contact.coupling
    _check_model(mjm, coupling)
    refuse_two_way(coupling, chosen.options)
    if chosen.contact.threads is not None:
        raise ValueError("threads of options is of attach and mj_step: leave it out, worlds run side by side")
    chosen = chosen.amended()
    is_new = d.qpos.device.is_cuda and not Hook.is_of(m)
    made = mjm, prefix, chosen, d.nworld, device, worlds, kernels_of_step(mjm, m) if is_new else []
    touching, skin_of, geometry, config, friction = _skins(*made)
    set_solids(mjm, m, touching.core, friction, chosen.contact.priority)
    slots = {}
    if coupling == "two-way":
        slots = _slots(mjm, m, d, touching, prefix)
    addresses = [int(mjm.sensor_adr[i]) if (i := _sensor(mjm, prefix + c)) >= 0 else -1 for c in SENSORS]
    skin = skin_of(bool(slots) or chosen.sensor.textures is not None)
    senses = _senses(chosen, config, geometry, skin, touching, mjm)
    # one-way nothing moves by its forces
    solid = skin_thickness(geometry) if coupling == "two-way" and mjm.nv else None
    batch = Batch(mjm, touching, slots, skin, senses, addresses, solid, config.rounds, config.loss)
    hook = Hook.of(m)
    hook.add(batch, d)
    if d.qpos.device.is_cuda:
        compile_ahead(device, hook.kernels(mjm, m))
        finish_compiling()
    return batch


def make(
    mjm: mujoco.MjModel,
    nworld: int,
    device: str | None = None,
    *,
    prefix: str = "biotac_",
    settings: Settings | dict | str | pathlib.Path | None = None,
    worlds: dict | None = None,
    **keywords: typing.Unpack[SettingKeywords],
) -> PoseBatch:
    """Step 2 of 2 in place of `attach`, where another simulator steps `mjm`: makes a skin for
    each world, to which you give the bodies' poses after each step.

    Args:
      mjm: an MjModel made from a spec that `add` changed, one-way; its time step is that of the sensors.
      nworld: number of worlds.
      device: Warp device; None takes Warp's default.
      prefix, settings, worlds, keywords: as for `attach`, without coupling; friction is that of the skin
        alone: core, nail and clamp meet in the other simulator.

    Raises:
      ValueError, TypeError: see `attach`.
    """
    without = ("coupling", *_NOT_OF_WORLDS)
    chosen = _read_arguments(mjm, prefix, worlds, settings, keywords, "batch.make", without)
    refuse_two_way("one-way", chosen.options)
    nworld = as_whole("nworld", nworld, 1)
    try:
        device = str(wp.get_device(device))
    except (TypeError, ValueError, RuntimeError):
        there = ", ".join(one.alias for one in wp.get_devices())
        raise ValueError(f"device is {short_repr(device)}: this machine has {there}") from None
    chosen = chosen.amended()
    touching, skin_of, geometry, config, _ = _skins(mjm, prefix, chosen, nworld, device, worlds)
    skin = skin_of(chosen.sensor.textures is not None)
    made = PoseBatch(mjm, touching, skin, _senses(chosen, config, geometry, skin, touching, mjm))
    if made.device.is_cuda:
        shape = nworld, mjm.nbody
        where = [wp.zeros(shape, dtype=kind, device=device) for kind in (wp.vec3, wp.mat33, wp.vec3)]
        compile_ahead(device, launched_by(lambda: made.step(*where)))
        finish_compiling()
    return made


def core_of(mjm: mujoco.MjModel, prefix: str) -> int:
    """Number of the body that is the core of the BioTac with a prefix.

    Raises:
      ValueError: the model has none, with the prefixes of those it has.
    """
    core = mujoco.mj_name2id(mjm, mujoco.mjtObj.mjOBJ_BODY, f"{prefix}core")
    if core >= 0:
        return core
    names = [mjm.body(i).name for i in range(mjm.nbody) if mjm.body(i).name]
    others = [name.removesuffix("core") for name in names if name.endswith("core")]
    if others:
        raise ValueError(
            f"no BioTac {short_repr(prefix)}: give prefix= one of {', '.join(map(repr, others))}"
        )
    raise ValueError(
        f"no BioTac {short_repr(prefix)}: add it to the spec with biotac_mj.batch.add; "
        f"the model's bodies are {', '.join(names)}"
    )


def _read_arguments(mjm, prefix, worlds, settings, keywords, call, without):
    """The Settings; refuses what later lines take for granted of the types."""
    if not isinstance(mjm, mujoco.MjModel):
        raise TypeError(f"mjm is {type(mjm).__name__}: pass the MjModel, compiled from what `add` changed")
    if not isinstance(prefix, str) or not prefix.isprintable():
        raise ValueError(f"prefix is {short_repr(prefix)}: give the text that `add` was given")
    if not isinstance(worlds, dict | None) or not all(isinstance(key, str) for key in worlds or ()):
        raise ValueError(f"worlds is {short_repr(worlds)}: give a dict of names and values")
    chosen = Settings.of(settings, keywords, call, without, ("prefix", "worlds"))
    if not isinstance(chosen.sensor.readings, bool):
        raise ValueError(
            f"readings is {short_repr(chosen.sensor.readings)}: pass True, False or a dict of settings"
        )
    return chosen


def _skins(mjm, prefix, chosen, nworld, device, worlds, of_engine=()):
    """Returns the geoms that can touch, a function (tangents wanted) -> BatchSkin, the geometry, the settings
    of one BioTac, and the skins' friction (nworld,). of_engine: modules that are compiled meanwhile, besides
    the skin's."""
    mesh, geometry = skin_reference(skin_of_design(chosen.skin.design, chosen.skin.mesh))
    materials = _materials(chosen.skin.material, nworld)
    first = materials[0] if materials else read_material(chosen.skin.material)
    of_worlds = [x.friction for x in materials] if materials else first.friction
    mu = _per_world(chosen.contact.friction, nworld, of_worlds)
    priority = chosen.contact.priority
    one = dataclasses.replace(
        chosen,
        skin=dataclasses.replace(chosen.skin, material=first),
        contact=dataclasses.replace(chosen.contact, coupling="two-way", friction=float(mu[0])),
        sensor=SensorSettings(film=chosen.sensor.film),  # the rest is of `senses`
        seed=0,
        device=device,
    )
    config = one.config(prefix, mesh, geometry)
    core = core_of(mjm, prefix)
    drawn = mujoco.mj_name2id(mjm, mujoco.mjtObj.mjOBJ_SKIN, f"{prefix}skin")
    if drawn >= 0 and mjm.skin_vertnum[drawn] != len(np.unique(geometry.outer_face)):
        raise ValueError(
            f"the BioTac {prefix!r} has another skin than {geometry.name!r}: give add and attach one"
        )
    meets = config
    if mjm.opt.disableflags & NO_CONTACT:  # nothing in the model touches
        meets = dataclasses.replace(config, geoms=[], rounding={})
    touching = Touching(ModelView(mjm._address), core, meets)
    touching.warn()  # not once a model: another may have been where this one is
    of_tier = condensed_step.kernels_for_cuda if config.tier == "condensed" else kernels_for_cuda
    first = of_tier(shapes_of([geom.type for geom in touching.geoms]))
    of_blocks = [(clearance, BLOCK), (outside, BLOCK), (integrator.step.module, integrator.BLOCK)]
    compile_ahead(device, [*first, *of_engine, *of_blocks, *((module, 256) for module in _KERNELS)])
    rubber, skin_options, modulus = skin_settings(config)
    differ = worlds or {}
    room = make_room(skin_options, modulus, differ, len(geometry.elem))
    made_with = SkinModelSettings(rubber, *room)
    fem = shared_model(geometry, made_with, device)
    twin = shared_model(geometry, made_with, "cpu") if config.tier == "condensed" else None
    frictions = friction_of(mjm, touching.geom, mu[:, None], priority)

    def build(tangents):
        return BatchSkin(
            fem,
            nworld,
            touching,
            geometry,
            frictions,
            materials,
            tangents,
            float(mjm.opt.timestep),
            differ,
            twin,
        )

    return touching, build, geometry, config, mu


def _materials(material, nworld):
    if material is None or isinstance(material, (str, dict, Material)):
        return None
    numpys = isinstance(material, np.ndarray) and material.ndim
    if not isinstance(material, (list, tuple)) and not numpys:
        raise ValueError(
            f"material is {short_repr(material)}: pass a name, a dict or a Material, or a list of them"
        )
    out = [read_material(x) for x in material]
    if len(out) != nworld:
        raise ValueError(
            f"{len(out)} materials for {nworld} worlds: pass one for each, or a single one for all"
        )
    return out


def _per_world(value, nworld, default):
    try:
        out = np.asarray(default if value is None else value, float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"friction is {short_repr(value)}: pass finite numbers >= 0, one or ({nworld},)"
        ) from None
    if out.shape not in ((), (nworld,)) or not (np.isfinite(out).all() and (out >= 0).all()):
        raise ValueError(
            f"friction is {short_repr(value)} of shape {out.shape}: pass finite numbers >= 0, one or "
            f"({nworld},)"
        )
    return np.broadcast_to(out, nworld)


def _sensor(mjm, name):
    return mujoco.mj_name2id(mjm, mujoco.mjtObj.mjOBJ_SENSOR, name)


def _check_model(mjm, coupling):
    Config(coupling=coupling)
    if mjm.opt.integrator in (int(mujoco.mjtIntegrator.mjINT_RK4), int(mujoco.mjtIntegrator.mjINT_DISCRETE)):
        raise ValueError(
            "a batch steps its skins once per step: choose the integrator implicitfast, implicit or Euler"
        )
    if mjm.opt.disableflags & NO_PASSIVE == NO_PASSIVE:
        raise ValueError(
            "mujoco_warp asks for no passive forces where springs and dampers are both disabled: "
            "enable one of the flags"
        )
    if coupling == "two-way" and mjm.opt.disableflags & _ROWLESS:
        raise ValueError(
            "two-way coupling needs the flags constraint and equality: enable them, or use coupling='one-way'"
        )
    if mjm.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP):
        raise ValueError("a touched body must not sleep: disable the flag sleep")


def _slots(mjm, m, d, touching, prefix):
    """{group that moves against the BioTac: weld constraint whose rows it gets}; the other welds are switched
    off, in m and d."""
    roots, needed = roots_of(mjm, touching)
    welds = [i for i in range(mjm.neq) if (mjm.eq(i).name or "").startswith(prefix + "couple")]
    place = {int(mjm.body_weldid[mjm.eq_obj2id[i]]): i for i in welds}
    without = [mjm.body(root).name or f"#{root}" for root in needed if root not in place]
    if without:
        raise ValueError(
            f"there is no room for two-way coupling of the BioTac {prefix!r} with {', '.join(without)}: add "
            "it after the objects, with coupling='two-way', or name the geoms that may touch with "
            "add(geoms=[...]) and attach(geoms=[...])"
        )
    rows = sum(
        6 if t == mujoco.mjtEq.mjEQ_WELD else 3 if t == mujoco.mjtEq.mjEQ_CONNECT else 1 for t in mjm.eq_type
    )
    if needed and d.njmax < rows + 7:
        raise ValueError(
            f"njmax is {d.njmax} and the equality constraints alone have {rows} rows: "
            "make the Data with a larger njmax"
        )
    active0, active = m.eq_active0.numpy().copy(), d.eq_active.numpy().copy()
    for root, weld in place.items():
        active0[weld] = active[:, weld] = root in needed
    m.eq_active0.assign(active0)
    d.eq_active.assign(active)
    return {g: place[root] for g, root in enumerate(roots) if root in needed}


def _senses(chosen, config, geometry, skin, touching, mjm):
    """The sensors of the worlds, or None."""
    nworld, device, seed = skin.nworld, str(skin.model.device), chosen.seed
    sensor, geometry = chosen.sensor, rest_geometry(config, geometry)
    thermal, textures = sensor.thermal, sensor.textures
    try:
        seeds = np.atleast_1d(seed)
    except ValueError:  # uneven lists
        seeds = np.zeros(0)
    if seeds.dtype.kind not in "iu" or seeds.min() < 0 or len(seeds) not in (1, nworld):
        raise ValueError(f"seed is {short_repr(seed)}: pass whole numbers >= 0, one or ({nworld},)")
    if sensor.left_out:
        if thermal is not None or textures is not None:
            raise ValueError("readings is False: leave signal, sensor, randomise, thermal and textures out")
        return None
    if not geometry.design.nelectrode:
        return None
    from ..sensor.film import BatchFilm, FilmConduction
    from ..sensor.readings import check_settings

    if not isinstance(sensor.options, dict | None):
        raise ValueError(f"readings is {short_repr(sensor.options)}: pass True, False or a dict of settings")
    given = {"sensor": sensor.individual, "randomise": sensor.randomise}
    settings = {**(sensor.options or {}), **{name: v for name, v in given.items() if v is not None}}
    many = settings.get("sensor")
    for one in many if isinstance(many, list) else [many]:
        check_settings(
            {
                k: v
                for k, v in {**settings, "sensor": one}.items()
                if v is not None or k not in ("sensor", "weights")
            },
            {"weights": str | None, "cold": bool},
            "readings",
            geometry.design,
        )
    for what, wanted, read in (("thermal", thermal, read_thermal), ("textures", textures, read_texture)):
        for one in wanted if isinstance(wanted, list) else [wanted]:
            check_geoms(what, one, read)
            find_geoms(ModelView(mjm._address), one or ())
    drawn = draws(nworld, seed, config, settings, thermal, textures, touching.geoms, geometry.design)
    signal = "physics" if sensor.signal is None else sensor.signal
    signal, weights = read_signal(signal, settings.pop("weights", None))
    if signal != "physics":
        if "film" in config.options:
            raise ValueError("a network replaces the film: leave options['film'] out")
        from ..learning.serve import LearnedBatchFilm

        film = LearnedBatchFilm(geometry, nworld, device, weights)
    else:
        film = BatchFilm(FilmConduction(geometry, **film_of(config)), nworld, device)
        if skin.data.rests is not None:  # fillings that differ: each rests at its own
            film.calibrate(skin.data.rest_vert)
    settings = {k: v for k, v in settings.items() if k not in ("sensor", "randomise")}
    seeds = [int(seed) + w for w in range(nworld)] if np.ndim(seed) == 0 else [int(s) for s in seed]
    seeds = [config.noise_seed(s) for s in seeds]
    return Senses(skin, film, touching.group, *drawn, seeds, float(mjm.opt.timestep), **settings)
