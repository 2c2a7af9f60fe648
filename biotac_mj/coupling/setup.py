"""Reads the setup of a BioTac from a model: settings, bodies, geoms, sensors, and the skin that it needs.
Also the layout of its plugin state."""

import ctypes
import functools
import threading

import numpy as np
from scipy.spatial import KDTree

from ..geometry.skin_geometry import SkinGeometry
from ..geometry.skins import file_state, load_skin
from .config import Config
from .shared import Shared
from .stepper import SkinResult, make_readings, make_stepper
from .structs import ModelView
from .touching import Touching, forget_notes

# head of the plugin state: steps that did not settle; 1 if the last committed step did, or less the steps in
# a row that did not; whether a step was made since the reset, and what was in reach of the skin in it
_HEAD = 3
FAILED, CONVERGED, STARTED = range(_HEAD)
# STAYED: the last solve left the skin as it was; negative where its error is not measured
REACHED, OUT_OF_REACH, STAYED = 1.0, 2.0, 3.0
# of a touching body, by the names of `rounds`: its linear model; the pose at the end of the step; the energy
# that it has in the skin at most [J], infinite where that is not known; the frequency at which it bounces
_FIELDS = {"wrench0": 6, "tangent0": (6, 6), "pos0": 3, "mat0": (3, 3), "end_pos": 3, "end_mat": (3, 3)}
MODEL = np.dtype([(name, float, _FIELDS.get(name, ())) for name in (*_FIELDS, "left", "frequency", "slack")])
LINEAR = "wrench0", "tangent0", "pos0", "mat0", "slack"


class _Skin:
    """A stepper and readings with the lock that lets one thread at a time use them: they share constants and
    scratch memory."""

    def __init__(self, config, geoms):
        self.geometry = load_skin(config.skin)
        self.stepper = make_stepper(config, self.geometry, geoms)
        self.readings = make_readings(config, self.geometry, geoms, self.stepper)
        self.lock = threading.Lock()
        self.solved = False  # whether it was once: its kernels and constants are made
        self.ngroup = 1 + max((g.group for g in geoms), default=-1)

    @functools.cached_property
    def thickness(self):
        return skin_thickness(self.geometry)

    @functools.cached_property
    def untouched(self):
        """Result of a step of a skin at rest that nothing reaches."""
        state, n = np.empty(self.stepper.nstate), self.ngroup
        self.stepper.reset(state)
        return SkinResult(None, np.zeros((n, 6)), np.zeros((n, 6, 6)), self.stepper.vert_xpos(state).copy())


def skin_thickness(geometry: SkinGeometry) -> float:
    """Largest distance of a free outer node from the core's nearest vertex [m]."""
    free = np.setdiff1d(geometry.outer_face, geometry.fixed)
    return float(KDTree(geometry.core_vert).query(geometry.vert[free])[0].max(initial=0.0))


# MuJoCo calls `nstate` of a model that it compiles and then frees it: the skins of a hand should last until
# its mjData is made, but those of the models before it are many megabytes
_skins = Shared(keep=8)
_asked = -1  # the instance of MuJoCo's last call: its calls are in the order of the instances


def _skin(config, touching):
    key = (tuple(config.strings().items()), touching.key(), file_state(config.skin))
    return _skins.get(key, lambda: _Skin(config, touching.geoms))


class Setup:
    """Setup of a plugin instance, read from the model: settings, bodies, geoms, sensors. The same for every
    mjData of the model.

    Raises:
      ValueError: no body refers to the instance, or its settings do not fit the model.
    """

    def __init__(self, model: ModelView, index: int, compiling: bool = False):
        self.model, self.index = model, index
        cores = np.flatnonzero(model.body_plugin == index)
        if len(cores) != 1:
            raise ValueError(
                f"plugin instance {index} of biotac_mj.skin is on {len(cores)} bodies: "
                "make it with biotac_mj.attach"
            )
        self.core = int(cores[0])
        self.config = Config.parse(lambda attribute: model.config(index, attribute))
        self.touching = Touching(model, self.core, self.config, compiling)
        self.skin = _skin(self.config, self.touching)
        self.ngroup = len(self.touching.body)

    @property
    def nstate(self) -> int:
        return (
            _HEAD + MODEL.itemsize // 8 * self.ngroup + self.skin.stepper.nstate + self.skin.readings.nstate
        )

    def parts(self, state: np.ndarray) -> tuple:
        """Head, models of the last step (ngroup,) of `MODEL`, the skin's and the readings' parts of a plugin
        state, as views."""
        a = _HEAD + MODEL.itemsize // 8 * self.ngroup
        b = a + self.skin.stepper.nstate
        c = b + self.skin.readings.nstate
        return state[:_HEAD], state[_HEAD:a].view(MODEL), state[a:b], state[b:c]

    def reset(self, state: np.ndarray) -> None:
        head, models, skin, readings = self.parts(state)
        head[:], models[:] = 0.0, 0.0
        models["mat0"] = models["end_mat"] = np.eye(3)  # though nothing touches
        head[CONVERGED] = 1.0
        with self.skin.lock:
            self.skin.stepper.reset(skin)
            self.skin.readings.reset(readings)

    def named(self, kind: str) -> dict:
        """{name inside the BioTac: id} of the model's objects of a kind, whatever prefixes and suffixes later
        attachments added."""
        before, _, after = self.model.name("body", self.core).rpartition("core")
        count = getattr(
            self.model, {"sensor": "nsensor", "site": "nsite", "skin": "nskin", "eq": "neq"}[kind]
        )
        names = (self.model.name(kind, i) for i in range(count))
        return {
            n[len(before) : len(n) - len(after)]: i
            for i, n in enumerate(names)
            if n.startswith(before) and n.endswith(after)
        }


def state_size(model: ModelView, index: int) -> int:
    """Upper bound of the size of the plugin state of instance `index`, in doubles. MuJoCo calls this while it
    compiles the model."""
    global _asked
    forget_notes(model)
    if index <= _asked:
        _skins.turn()
    _asked = index
    return Setup(model, index, compiling=True).nstate


def reset_state(model: ModelView, address: int, index: int, setup: Setup | None = None) -> None:
    """Writes the rest state of an instance at an address, for mj_resetData."""
    setup = setup or Setup(model, index)
    buffer = (ctypes.c_double * int(model.plugin_statenum[index])).from_address(address)
    state = np.frombuffer(buffer, np.float64)
    state[setup.nstate :] = 0.0  # of geoms that a contact exclusion keeps away: MuJoCo leaves there what was
    setup.reset(state)
