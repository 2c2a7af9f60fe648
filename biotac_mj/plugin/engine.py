"""The engine plugin "biotac_mj.skin": MuJoCo's plugin interface, served from Python through ctypes.

MuJoCo calls the functions below from inside `mj_step`, on whatever thread steps; ctypes takes the interpreter
lock for each call. `errors` returns the exceptions that they raise, and the status sensor shows -1."""

import atexit
import ctypes
import dataclasses
import threading

import mujoco

from ..coupling import structs
from ..coupling.config import PLUGIN_NAME, Config
from .errors import guarded, watch_interrupts

# Everything that makes one BioTac, as strings in the model, so that a saved XML or MJB says it all: see
# `biotac_mj.coupling.config`.
ATTRIBUTES = tuple(field.name for field in dataclasses.fields(Config))

_INT, _PTR = ctypes.c_int, ctypes.c_void_p
_PASSIVE = int(mujoco.mjtPluginCapabilityBit.mjPLUGIN_PASSIVE)
_SENSOR = int(mujoco.mjtPluginCapabilityBit.mjPLUGIN_SENSOR)
_callbacks = {}  # functions of mjpPlugin in its order, by their names

_lock = threading.RLock()
_worlds = {}  # mjData address -> World, all BioTacs in it; holds only what the state and the model determine
_alive = []  # what C points to


def _callback(*kinds, returns=None, **options):
    """Makes a function one of mjpPlugin's by its name; kinds: ctypes of its arguments. options: of
    `guarded`."""

    def decorate(function):
        made = ctypes.CFUNCTYPE(returns, *kinds)(guarded(**options)(function))
        _callbacks[function.__name__.strip("_")] = made

    return decorate


def _raises(model, index):
    return structs.ModelView(model).config(index, "on_error") == '"raise"'


def _abandon(model, data, index, capability):
    if data in _worlds:
        _worlds[data].failed(index)


def _world(model, data, index):
    world = _worlds.get(data)
    if world is None:  # also the way of a copy made by mj_copyData, which has no init
        with _lock:
            world = _worlds.get(data)
            if world is None:
                from ..coupling.implicit.world import World

                view = structs.ModelView(model)
                mine = [i for i in range(view.nplugin) if view.plugin[i] == view.plugin[index]]
                world = _worlds[data] = World(view, structs.DataView(data, view), mine)
    return world


@_callback(_PTR, _INT, returns=_INT, failed=-1)
def _nstate(model, index):
    from ..coupling.setup import state_size  # late: `import biotac_mj` loads neither Warp nor the geometry

    return state_size(structs.ModelView(model), index)


@_callback(_PTR, _INT, _INT, returns=_INT, failed=0)
def _nsensordata(model, index, sensor):
    return 0


@_callback(_PTR, _PTR, _INT, returns=_INT, failed=-1)
def _init(model, data, index):
    with _lock:
        world = _worlds.get(data)
        if world is not None and index == world.begins:  # left over from an mjData at this address
            del _worlds[data]
        _world(model, data, index)
    return 0


@_callback(_PTR, _INT)
def _destroy(data, index):
    _worlds.pop(data, None)  # without the lock: a garbage collection calls this on any thread at any time


@_callback(_PTR, _PTR, _PTR, _INT)
def _copy(destination, model, source, index):
    with _lock:
        _worlds.pop(destination, None)


@_callback(_PTR, _PTR, _PTR, _INT)
def _reset(model, state, plugin_data, index):
    from ..coupling.setup import reset_state

    # of an mjData that there is, as it was made: masks of the model may be others now
    known = (world.instances.get(index) for world in list(_worlds.values()))
    setup = next((one.setup for one in known if one and one.state_address == state), None)
    reset_state(structs.ModelView(model), state, index, setup)


@_callback(_PTR, _PTR, _INT, _INT, raises=lambda model, _, index, __: _raises(model, index), abandon=_abandon)
def _compute(model, data, index, capability):
    world = _world(model, data, index)
    if index == world.begins:
        watch_interrupts()
    if capability == _PASSIVE:
        world.passive(index)
    elif capability == _SENSOR and index == world.last:
        world.sense_forces()


@_callback(_PTR, _PTR, _INT, raises=lambda model, _, index: _raises(model, index))
def _advance(model, data, index):
    _world(model, data, index).commit(index)


@_callback(*(_PTR,) * 4, _INT, raises=lambda model, *rest: _raises(model, rest[-1]))
def _visualize(model, data, option, scene, index):
    _world(model, data, index).instances[index].visualize()


_UNUSED = "act_dot sdf_distance sdf_gradient sdf_staticdistance sdf_attribute sdf_aabb".split()


class _Plugin(ctypes.Structure):
    """mjpPlugin of mjplugin.h."""

    _fields_ = [
        ("name", ctypes.c_char_p),
        ("nattribute", _INT),
        ("attributes", ctypes.POINTER(ctypes.c_char_p)),
        ("capabilityflags", _INT),
        ("needstage", _INT),
        *((name, type(called)) for name, called in _callbacks.items()),
        *((name, _PTR) for name in _UNUSED),
    ]


def register():
    """Makes the plugin known to MuJoCo; a second call does nothing.

    Raises:
      RuntimeError: MuJoCo refuses the plugin, for example because another library took its name.
    """
    with _lock:
        if _alive:
            return
        names = (ctypes.c_char_p * len(ATTRIBUTES))(*(name.encode() for name in ATTRIBUTES))
        plugin = _Plugin(
            name=PLUGIN_NAME.encode(),
            nattribute=len(ATTRIBUTES),
            attributes=names,
            capabilityflags=_PASSIVE | _SENSOR,
            needstage=int(mujoco.mjtStage.mjSTAGE_ACC),
            **_callbacks,
        )
        slot = structs.LIBRARY.mjp_registerPlugin(ctypes.byref(plugin))
        if slot < 0:
            raise RuntimeError(
                f"MuJoCo {mujoco.__version__} refused the plugin {PLUGIN_NAME!r}: "
                "is another copy of biotac_mj loaded?"
            )
        _alive.extend((names, plugin))
        atexit.register(_fall_silent, slot)


def world_of(model: mujoco.MjModel, data: mujoco.MjData):
    """The `World` of all BioTacs in an mjData; None where the model has none."""
    view = structs.ModelView(model._address)
    mine = [int(i) for i in view.body_plugin if i >= 0 and view.config(int(i), "skin")]
    return _world(model._address, data._address, mine[0]) if mine else None


def _fall_silent(slot):
    """When Python ends: an mjData that outlives it is freed by MuJoCo alone; a call into a finalized
    interpreter would crash."""
    get = structs.LIBRARY.mjp_getPluginAtSlot
    get.restype, get.argtypes = ctypes.POINTER(_Plugin), (_INT,)
    get(slot).contents.destroy = type(_callbacks["destroy"])()  # none
