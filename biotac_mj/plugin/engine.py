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
_CALLBACKS = {
    "nstate": ctypes.CFUNCTYPE(_INT, _PTR, _INT),
    "nsensordata": ctypes.CFUNCTYPE(_INT, _PTR, _INT, _INT),
    "init": ctypes.CFUNCTYPE(_INT, _PTR, _PTR, _INT),
    "destroy": ctypes.CFUNCTYPE(None, _PTR, _INT),
    "copy": ctypes.CFUNCTYPE(None, _PTR, _PTR, _PTR, _INT),
    "reset": ctypes.CFUNCTYPE(None, _PTR, _PTR, _PTR, _INT),
    "compute": ctypes.CFUNCTYPE(None, _PTR, _PTR, _INT, _INT),
    "advance": ctypes.CFUNCTYPE(None, _PTR, _PTR, _INT),
    "visualize": ctypes.CFUNCTYPE(None, _PTR, _PTR, _PTR, _PTR, _INT),
}

_UNUSED = "act_dot sdf_distance sdf_gradient sdf_staticdistance sdf_attribute sdf_aabb".split()


class _Plugin(ctypes.Structure):
    """mjpPlugin of mjplugin.h."""

    _fields_ = [
        ("name", ctypes.c_char_p),
        ("nattribute", _INT),
        ("attributes", ctypes.POINTER(ctypes.c_char_p)),
        ("capabilityflags", _INT),
        ("needstage", _INT),
        *_CALLBACKS.items(),
        *((name, _PTR) for name in _UNUSED),
    ]


_lock = threading.RLock()
_worlds = {}  # mjData address -> World, all BioTacs in it; holds only what the state and the model determine
_alive = []  # what C points to


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


@guarded(failed=-1)
def _nstate(model, index):
    from ..coupling.setup import state_size  # late: `import biotac_mj` loads neither Warp nor the geometry

    return state_size(structs.ModelView(model), index)


@guarded(failed=0)
def _nsensordata(model, index, sensor):
    return 0


@guarded(failed=-1)
def _init(model, data, index):
    with _lock:
        world = _worlds.get(data)
        if world is not None and index == world.begins:  # left over from an mjData at this address
            del _worlds[data]
        _world(model, data, index)
    return 0


@guarded()
def _destroy(data, index):
    _worlds.pop(data, None)  # without the lock: a garbage collection calls this on any thread at any time


@guarded()
def _copy(destination, model, source, index):
    with _lock:
        _worlds.pop(destination, None)


@guarded()
def _reset(model, state, plugin_data, index):
    from ..coupling.setup import reset_state

    # of an mjData that there is, as it was made: masks of the model may be others now
    known = (world.instances.get(index) for world in list(_worlds.values()))
    setup = next((one.setup for one in known if one and one.state_address == state), None)
    reset_state(structs.ModelView(model), state, index, setup)


@guarded(raises=lambda model, data, index, capability: _raises(model, index), abandon=_abandon)
def _compute(model, data, index, capability):
    world = _world(model, data, index)
    if index == world.begins:
        watch_interrupts()
    if capability == _PASSIVE:
        world.passive(index)
    elif capability == _SENSOR and index == world.last:
        world.sense_forces()


@guarded(raises=lambda model, data, index: _raises(model, index))
def _advance(model, data, index):
    _world(model, data, index).commit(index)


@guarded(raises=lambda model, data, option, scene, index: _raises(model, index))
def _visualize(model, data, option, scene, index):
    _world(model, data, index).instances[index].visualize()


def register():
    """Makes the plugin known to MuJoCo; a second call does nothing.

    Raises:
      RuntimeError: MuJoCo refuses the plugin, for example because another library took its name.
    """
    with _lock:
        if _alive:
            return
        functions = dict(
            nstate=_nstate,
            nsensordata=_nsensordata,
            init=_init,
            destroy=_destroy,
            copy=_copy,
            reset=_reset,
            compute=_compute,
            advance=_advance,
            visualize=_visualize,
        )
        callbacks = {name: _CALLBACKS[name](function) for name, function in functions.items()}
        names = (ctypes.c_char_p * len(ATTRIBUTES))(*(name.encode() for name in ATTRIBUTES))
        plugin = _Plugin(
            name=PLUGIN_NAME.encode(),
            nattribute=len(ATTRIBUTES),
            attributes=names,
            capabilityflags=_PASSIVE | _SENSOR,
            needstage=int(mujoco.mjtStage.mjSTAGE_ACC),
            **callbacks,
        )
        slot = structs.LIBRARY.mjp_registerPlugin(ctypes.byref(plugin))
        if slot < 0:
            raise RuntimeError(
                f"MuJoCo {mujoco.__version__} refused the plugin {PLUGIN_NAME!r}: "
                "is another copy of biotac_mj loaded?"
            )
        _alive.extend((callbacks, names, plugin))
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
    get(slot).contents.destroy = _CALLBACKS["destroy"]()  # none
