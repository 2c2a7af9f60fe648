"""Adds the forces of the skins to MuJoCo's own force quantities: `cfrc_ext`, `cfrc_int`, `<force>`,
`<torque>`, `<touch>` and `<contact>`.

A skin acts through `qfrc_passive` and through rows of constraints, which are no forces on bodies for MuJoCo.
So after its constraint solver MuJoCo's own functions run once more while `mjData.contact` lists the skins
besides: each geom that a skin pushes is one contact, at the centre of pressure, with all six components of
what acts.

The rows of a skin lie where MuJoCo expects those of welds: what they push is left out there and counted
here."""

import ctypes
from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np
import warp as wp

from ..kernels import kernel_module
from ..skin.types import real, vec3, vec6
from .implicit.kinematics import row
from .implicit.metric import Metric
from .solid_contacts import CONTACT, contact_frame
from .structs import LIBRARY, DataView, ModelView, c_structs

_SENSORS = [int(getattr(mujoco.mjtSensor, f"mjSENS_{n}")) for n in ("FORCE", "TORQUE", "CONTACT", "TOUCH")]
_CONTACT, _TOUCH = _SENSORS[2:]
_ACC = int(mujoco.mjtStage.mjSTAGE_ACC)
_PYRAMIDAL = int(mujoco.mjtCone.mjCONE_PYRAMIDAL)
PYRAMID = 10  # edges of a contact's friction pyramid with six components
_TINY = wp.constant(wp.float64(1e-12))  # [N]

kernel_module(__name__)


@wp.kernel
def find_touches(
    # In:
    nsample: int,
    face: wp.array(dtype=wp.vec3i),
    group: wp.array(dtype=int),
    kept: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    x: wp.array2d(dtype=vec3),
    acting: wp.array2d(dtype=vec6),
    # Out:
    pos_out: wp.array2d(dtype=vec3),
    normal_out: wp.array2d(dtype=vec3),
    fraction_out: wp.array2d(dtype=real),
    wrench_out: wp.array2d(dtype=vec6),
):
    """Contact of each geom: centre of pressure, mean normal out of the skin there, fraction of the body's
    wrench, force and torque about the centre. Where no push is known the first geom gets all, on the axis of
    the wrench."""
    g, w = wp.tid()
    first = int(-1)
    for k in range(group.shape[0]):
        if group[k] == g:
            if first < 0:
                first = k
            pos_out[k, w] = vec3()
            normal_out[k, w] = vec3()
            fraction_out[k, w] = real(0.0)
            wrench_out[k, w] = vec6()
    total = real(0.0)
    for f in range(kept.shape[0]):
        if kept[f, w] == 1:
            t = face[f]
            a = x[t[0], w]
            b = x[t[1], w]
            c = x[t[2], w]
            n = wp.normalize(wp.cross(b - a, c - a))
            for s in range(nsample):
                k = geom[f * nsample + s, w]
                if k >= 0:
                    if group[k] == g:
                        push = wp.max(-wp.dot(force[f * nsample + s, w], n), real(0.0))
                        total += push
                        fraction_out[k, w] += push
                        pos_out[k, w] += push / real(3.0) * (a + b + c)
                        normal_out[k, w] += push * n
    pushed = wp.spatial_top(acting[g, w])
    square = wp.dot(pushed, pushed)
    if first < 0 or square < _TINY * _TINY:
        return
    if total < _TINY:
        pos_out[first, w] = wp.cross(pushed, wp.spatial_bottom(acting[g, w])) / square
        normal_out[first, w] = pushed
        fraction_out[first, w] = real(1.0)
        total = real(1.0)
    centre = vec3()
    for k in range(group.shape[0]):
        if group[k] == g and fraction_out[k, w] > real(0.0):
            centre += pos_out[k, w] / total
            pos_out[k, w] = pos_out[k, w] / fraction_out[k, w]
            normal_out[k, w] = wp.normalize(normal_out[k, w])
            fraction_out[k, w] = fraction_out[k, w] / total
    turn = wp.spatial_bottom(acting[g, w]) - wp.cross(centre, pushed)
    for k in range(group.shape[0]):
        if group[k] == g:
            fraction = fraction_out[k, w]
            for i in range(3):
                wrench_out[k, w][i] = fraction * pushed[i]
                wrench_out[k, w][i + 3] = fraction * turn[i]


class Touches:
    """`find_touches` in one world.

    Args:
      group: (ngeom,) body of each geom. face: (nface, 3) outer faces of a skin with `nvert` nodes.

    Attributes, for the caller to write:
      wrench: (ngroup, 6) on the bodies.
      kept, geom, force, x: what touches, with one sample a face: (nface,), (nface,), (nface, 3), (nvert, 3).
    """

    def __init__(self, group: np.ndarray, face: np.ndarray, nvert: int, ngroup: int):
        nface = len(face)
        given = (nface, int), (nface, int), (nface, vec3), (nvert, vec3), (ngroup, vec6)
        with wp.ScopedDevice("cpu"):
            fixed = [wp.array(face, dtype=wp.vec3i), wp.array(group, dtype=int)]
            given = [wp.zeros((n, 1), dtype=kind) for n, kind in given]
            found = [wp.zeros((len(group), 1), dtype=kind) for kind in (vec3, vec3, real, vec6)]
        self.kept, self.geom, self.force, self.x, self.wrench = (a.numpy()[:, 0] for a in given)
        self._found = [a.numpy()[:, 0] for a in found]
        self._find = row((find_touches, (ngroup, 1), [1, *fixed, *given, *found]))

    def find(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (k,) of geoms on which something acts, and (k, 4, 3): centre of pressure [m], normal out of
        the skin there, force [N], and torque [N m] about the centre."""
        self._find()
        pos, normal, fraction, wrench = self._found
        which = fraction.nonzero()[0]
        return which, np.concatenate([pos, normal, wrench], axis=1)[which].reshape(-1, 4, 3)


class Loads:
    """Force quantities with all two-way skins of one mjData. Sensors with a delay have MuJoCo's contacts
    alone."""

    def __init__(self, model: ModelView, data: DataView, coupled: list, metric: Metric):
        self.model, self.data, self._metric = model, data, metric
        self._core_geom = {t.touching.core: core_geom(model, t.touching.core) for t in coupled}
        found = passes(model, list(self._core_geom))
        self._again = [_with_sensors(model, *one) for one in found]
        # others feel what a body gets, whatever the places are at which it gets it
        kinds = {kind for sensors, _ in found for kind in model.sensor_type[sensors].tolist()}
        self._by_place = not kinds.isdisjoint((_TOUCH, _CONTACT))
        # sites that feel MuJoCo's contacts with a BioTac, whether its skin is touched or not
        self._welded = any((body != model.geom_bodyid).any() for _, body in found)
        self._touch = np.zeros((), CONTACT)  # what all touches have in common
        self._touch["friction"], self._touch["dim"] = 1.0, 6
        for name in ("flex", "elem", "vert"):
            self._touch[name] = -1

    def write(self, acting: dict) -> None:
        """Writes cfrc_ext, cfrc_int and the sensors. acting: {instance: wrenches (ngroup, 6) that its bodies
        get}, in the BioTac's frame."""
        data, touches = self.data.struct, []
        for instance, wrench in acting.items():
            which, vectors = instance.touches(wrench, self._by_place)
            if len(which):
                touches.append((instance.touching, which, vectors))
        if not touches and not self._welded:
            return
        kept = data.contact, data.ncon, data.efc_force
        contact, force = self._listed(touches)
        data.contact, data.ncon = contact.ctypes.data, len(contact)
        data.efc_force = force.ctypes.data
        try:
            LIBRARY.mj_rnePostConstraint(self.model.address, self.data.address)
            for again, _ in self._again:
                again.opt = self.model.struct.opt
                LIBRARY.mj_sensorAcc(ctypes.addressof(again), self.data.address)
        finally:
            data.contact, data.ncon, data.efc_force = kept

    def _listed(self, touches):
        """MuJoCo's contacts with the touches behind them, and the forces of all rows: none of the skins' own,
        and those of the touches."""
        data, count = self.data.struct, sum(len(which) for _, which, _ in touches)
        contact = np.zeros(data.ncon + count, CONTACT)
        force = np.zeros(data.nefc + PYRAMID * count)
        ctypes.memmove(contact.ctypes.data, data.contact, data.ncon * CONTACT.itemsize)
        ctypes.memmove(force.ctypes.data, data.efc_force, data.nefc * 8)
        contact[data.ncon :] = self._touch
        force[self._metric.numbers] = 0.0
        pyramidal = self.model.opt.cone == _PYRAMIDAL
        k, row = data.ncon, data.nefc
        for touching, which, vectors in touches:
            core = touching.core
            vectors = vectors @ self.data.xmat[core].reshape(3, 3).T
            for geom, (pos, normal, *load) in zip(touching.geom[which].tolist(), vectors):
                one, frame = contact[k], contact_frame(normal)
                one["pos"], one["frame"], one["efc_address"] = self.data.xpos[core] + pos, frame.ravel(), row
                one["geom"] = one["geom1"], one["geom2"] = self._core_geom[core], geom
                value = (load @ frame.T).ravel()
                if pyramidal:  # two edges: their sum is a fifth of the push, their difference a component
                    value = (value[0] / 5 + value[1:, None] * np.array([1.0, -1.0])).ravel() / 2
                force[row : row + len(value)] = value
                k, row = k + 1, row + PYRAMID
        return contact, force


def core_geom(model: ModelView, core: int) -> int:
    """Number of the geom that stands for the skin of BioTac `core`: the one that has the body's name."""
    mine, name = np.flatnonzero(model.geom_bodyid == core).tolist(), model.name("body", core)
    return next((g for g in mine if model.name("geom", g) == name), mine[0])


def passes(model: Any, cores: Collection[int]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Passes in which MuJoCo's functions compute its sensors of force, those with a delay left out: the
    numbers of the sensors, and the body (ngeom,) of each geom. A touch sensor feels a BioTac that is welded
    to its site's body as a part of this body: of what is fixed to the world only sites of the world do, and
    those of its own bodies.

    Args:
      model: mjModel, or that of mujoco_warp. cores: ids of the BioTacs' bodies.
    """

    def read(name):
        array = getattr(model, name)
        return array.numpy() if hasattr(array, "numpy") else array

    kind, delay = read("sensor_type"), np.atleast_2d(read("sensor_delay")).max(axis=0, initial=0.0)
    wanted = np.flatnonzero(np.isin(kind, _SENSORS) & ~(delay > 0.0))
    body, weld, root = (read(name) for name in ("geom_bodyid", "body_weldid", "body_rootid"))
    site = [int(read("site_bodyid")[read("sensor_objid")[i]]) if kind[i] == _TOUCH else -1 for i in wanted]
    alike, out = {}, []
    for i, b in zip(wanted.tolist(), site):
        mine = [c for c in cores if b not in (-1, c) and weld[c] == weld[b]]
        welded = [c for c in mine if b == 0 or root[c] == root[b]]
        alike.setdefault((b if welded else -1, *welded), []).append(i)
    for (b, *welded), sensors in alike.items():
        out.append((np.array(sensors), np.where(np.isin(body, welded), b, body)))
    return out


def _with_sensors(model, chosen, body):
    """The model as it is, but with these sensors alone, which MuJoCo computes at its last stage, and with
    geoms on these bodies."""
    struct = c_structs("mjModel").from_buffer_copy(model.struct)
    struct.nsensor, struct.nplugin = len(chosen), 0
    arrays = {"geom_bodyid": np.ascontiguousarray(body, np.int32)}  # which keep the memory
    struct.geom_bodyid = arrays["geom_bodyid"].ctypes.data
    for name in (name for name, *_ in struct._fields_ if name.startswith("sensor_")):
        arrays[name] = np.ascontiguousarray(getattr(model, name)[chosen])
        setattr(struct, name, arrays[name].ctypes.data)
    arrays["sensor_needstage"][:] = _ACC
    return struct, arrays
