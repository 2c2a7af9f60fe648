"""The engine plugin "biotac_mj.skin": MuJoCo's plugin interface, served from Python through ctypes.

MuJoCo calls the functions below from inside `mj_step`, on whatever thread steps; ctypes takes the interpreter
lock for each call. Nothing may be raised into C, so an exception is kept, reported as a RuntimeWarning, shown
as -1 in the status sensor and raised again by `check`."""

import atexit
import ctypes
import functools
import sys
import threading
import warnings

import mujoco

from ..coupling import structs
from ..coupling.config import PLUGIN_NAME

__all__ = ["ATTRIBUTES", "PLUGIN_NAME", "check", "clear_errors", "register"]

# Everything that makes one BioTac, as strings in the model, so that a saved XML or MJB says it all: see
# `biotac_mj.coupling.config`.
ATTRIBUTES = (
    "skin",
    "stepper",
    "readings",
    "material",
    "liquid",
    "coupling",
    "geoms",
    "rounding",
    "thermal",
    "friction",
    "priority",
    "tier",
    "seed",
    "device",
    "options",
)

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


class _Plugin(ctypes.Structure):
    """mjpPlugin of mjplugin.h."""

    _fields_ = [
        ("name", ctypes.c_char_p),
        ("nattribute", _INT),
        ("attributes", ctypes.POINTER(ctypes.c_char_p)),
        ("capabilityflags", _INT),
        ("needstage", _INT),
        *_CALLBACKS.items(),
        *(
            (name, _PTR)
            for name in (
                "act_dot",
                "sdf_distance",
                "sdf_gradient",
                "sdf_staticdistance",
                "sdf_attribute",
                "sdf_aabb",
            )
        ),
    ]


_lock = threading.RLock()
_worlds = {}  # mjData address -> World, all BioTacs in it; holds only what the state and the model determine
_errors = []
_MAX_ERRORS = 100
_alive = []  # what C points to


def _keep(error):
    with _lock:
        if len(_errors) < _MAX_ERRORS:
            _errors.append(error)
    try:
        warnings.warn(
            f"BioTac: {str(error) or type(error).__name__} (biotac_mj.plugin.check() raises it)",
            RuntimeWarning,
            stacklevel=3,
        )
    except RuntimeWarning:  # the user turned warnings into errors: it is kept above
        pass


def _guarded(on_error):
    def decorate(function):
        # what is left when MuJoCo frees the last mjData: this module's names are gone by then
        finalizing = sys.is_finalizing

        @functools.wraps(function)
        def call(*args):
            if finalizing():
                return on_error
            try:
                return function(*args)
            except BaseException as error:  # noqa: BLE001 - C cannot take it
                _keep(error)
                return on_error

        return call

    return decorate


def _world(model, data, index):
    world = _worlds.get(data)
    if world is None:  # also the way of a copy made by mj_copyData, which has no init
        with _lock:
            world = _worlds.get(data)
            if world is None:
                from ..coupling.world import World

                view = structs.ModelView(model)
                mine = [i for i in range(view.nplugin) if view.plugin[i] == view.plugin[index]]
                world = _worlds[data] = World(view, structs.DataView(data, view), mine)
    return world


@_guarded(-1)
def _nstate(model, index):
    from ..coupling.instance import state_size  # late: `import biotac_mj` loads neither Warp nor the geometry

    return state_size(structs.ModelView(model), index)


@_guarded(0)
def _nsensordata(model, index, sensor):
    return 0


@_guarded(-1)
def _init(model, data, index):
    with _lock:
        world = _worlds.get(data)
        if world is not None and index == min(world.instances):  # left over from an mjData at this address
            del _worlds[data]
        _world(model, data, index)
    return 0


@_guarded(None)
def _destroy(data, index):
    with _lock:
        _worlds.pop(data, None)


@_guarded(None)
def _copy(destination, model, source, index):
    with _lock:
        _worlds.pop(destination, None)


@_guarded(None)
def _reset(model, state, plugin_data, index):
    from ..coupling.instance import reset_state

    reset_state(structs.ModelView(model), state, index)


def _compute(model, data, index, capability):
    try:
        world = _world(model, data, index)
        if capability == _PASSIVE:
            world.passive(index)
        elif capability == _SENSOR:
            world.instances[index].sense()
    except BaseException as error:  # noqa: BLE001
        _keep(error)
        if data in _worlds:
            _worlds[data].failed(index)


@_guarded(None)
def _advance(model, data, index):
    _world(model, data, index).instances[index].commit_step()


@_guarded(None)
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
            needstage=int(mujoco.mjtStage.mjSTAGE_VEL),
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


def _fall_silent(slot):
    """When Python ends: an mjData that outlives it is freed by MuJoCo alone; a call into a finalized
    interpreter would crash."""
    get = structs.LIBRARY.mjp_getPluginAtSlot
    get.restype, get.argtypes = ctypes.POINTER(_Plugin), (_INT,)
    get(slot).contents.destroy = _CALLBACKS["destroy"]()  # none


def check():
    """Raises the first error that a BioTac met inside MuJoCo since the last call; returns None if there was
    none.

    Call it in long loops: a KeyboardInterrupt that came while a skin was solved is among the errors, for it
    cannot pass through C either.
    """
    with _lock:
        errors = list(_errors)
        _errors.clear()
    if errors:
        raise errors[0]


def clear_errors():
    """Forgets the kept errors."""
    with _lock:
        _errors.clear()
