"""Adds the forces of the skins to MuJoCo's own force quantities: `cfrc_ext`, `cfrc_int`, `<force>`,
`<torque>`, `<touch>` and `<contact>`.

A skin acts through `qfrc_passive` and through rows of constraints, which are no forces on bodies for MuJoCo.
So after its constraint solver MuJoCo's own functions run once more while `mjData.contact` lists the skins
besides: each geom that a skin pushes is one contact, at the centre of pressure, with all six components of
what acts.

The rows of a skin lie where MuJoCo expects those of welds: what they push is left out there and counted
here."""

import ctypes
from typing import NamedTuple

import mujoco
import numpy as np

from .solid_contacts import CONTACT, contact_frame
from .structs import LIBRARY, DataView, ModelView, c_structs

__all__ = ["PYRAMID", "Loads", "core_geom"]

LIBRARY.mj_rnePostConstraint.argtypes = LIBRARY.mj_sensorAcc.argtypes = (ctypes.c_void_p,) * 2
_FORCE, _TORQUE, _TOUCH, _CONTACT = (
    int(getattr(mujoco.mjtSensor, f"mjSENS_{n}")) for n in ("FORCE", "TORQUE", "TOUCH", "CONTACT")
)
_ACC = int(mujoco.mjtStage.mjSTAGE_ACC)
_PYRAMIDAL = int(mujoco.mjtCone.mjCONE_PYRAMIDAL)
PYRAMID = 10  # edges of a contact's friction pyramid with six components


class _Touch(NamedTuple):
    """A geom on a skin, in the world: the BioTac's body, the geom, centre of pressure [m], normal from core
    to geom, and force [N] and torque [N m] on the geom about the centre."""

    core: int
    geom: int
    pos: np.ndarray
    normal: np.ndarray
    force: np.ndarray
    torque: np.ndarray


class Loads:
    """Force quantities with all two-way skins of one mjData. Sensors with a delay have MuJoCo's contacts
    alone."""

    def __init__(self, model: ModelView, data: DataView, coupled: list):
        self.model, self.data, self.coupled = model, data, coupled
        kind, now = model.sensor_type, ~(model.sensor_delay > 0.0)
        self._again, self._arrays = _with_sensors(
            model, np.flatnonzero(now & np.isin(kind, (_FORCE, _TORQUE, _CONTACT)))
        )
        self._touch_sensors = np.flatnonzero(now & (kind == _TOUCH)).tolist()
        # others feel what a body gets, whatever the places are at which it gets it
        self._by_place = bool((now & np.isin(kind, (_TOUCH, _CONTACT))).any())
        self._touch = np.zeros((), CONTACT)  # what all touches have in common
        self._touch["friction"], self._touch["dim"] = 1.0, 6
        for name in ("flex", "elem", "vert"):
            self._touch[name] = -1
        self._core_geom = {t.touching.core: core_geom(model, t.touching.core) for t in coupled}

    def write(self, acting: dict) -> None:
        """Writes cfrc_ext, cfrc_int and the sensors. acting: {instance: wrenches (ngroup, 6) that its bodies
        get}, in the BioTac's frame."""
        touches = [t for instance, wrench in acting.items() for t in self._touches(instance, wrench)]
        if not touches:
            return
        data = self.data.struct
        kept = data.contact, data.ncon, data.efc_force
        contact, force = self._listed(touches)
        data.contact, data.ncon = contact.ctypes.data, len(contact)
        data.efc_force = force.ctypes.data
        try:
            LIBRARY.mj_rnePostConstraint(self.model.address, self.data.address)
            if self._again.nsensor:
                self._again.opt = self.model.struct.opt
                LIBRARY.mj_sensorAcc(ctypes.addressof(self._again), self.data.address)
        finally:
            data.contact, data.ncon, data.efc_force = kept
        for i in self._touch_sensors:
            self._add_touch(i, touches)

    def _touches(self, instance, wrench):
        core = instance.touching.core
        turned = self.data.xmat[core].reshape(3, 3).T
        for k, vectors in instance.touches(wrench, self._by_place):
            pos, normal, *load = vectors @ turned
            yield _Touch(core, int(instance.touching.geom[k]), self.data.xpos[core] + pos, normal, *load)

    def _listed(self, touches):
        """MuJoCo's contacts with the touches behind them, and the forces of all rows: none of the skins' own,
        and those of the touches."""
        data = self.data.struct
        contact = np.zeros(data.ncon + len(touches), CONTACT)
        force = np.zeros(data.nefc + PYRAMID * len(touches))
        ctypes.memmove(contact.ctypes.data, data.contact, data.ncon * CONTACT.itemsize)
        ctypes.memmove(force.ctypes.data, data.efc_force, data.nefc * 8)
        contact[data.ncon :] = self._touch
        for one in self.coupled:
            force[one.metric.numbers] = 0.0
        pyramidal = self.model.opt.cone == _PYRAMIDAL
        for k, t in enumerate(touches):
            row, one = data.nefc + PYRAMID * k, contact[data.ncon + k]
            frame = contact_frame(t.normal)
            one["pos"], one["frame"], one["efc_address"] = t.pos, frame.ravel(), row
            one["geom"] = one["geom1"], one["geom2"] = self._core_geom[t.core], t.geom
            value = np.concatenate([frame @ t.force, frame @ t.torque])
            if pyramidal:  # two edges: their sum is a fifth of the normal force, their difference a component
                value = (value[0] / 5 + value[1:, None] * np.array([1.0, -1.0])).ravel() / 2
            force[row : row + len(value)] = value
        return contact, force

    def _add_touch(self, sensor, touches):
        """Adds the touches whose ray out of the sensor's body meets the site, as MuJoCo does with its own.
        What a BioTac is welded to is one with it, but for the world."""
        model, data, site = self.model, self.data, int(self.model.sensor_objid[sensor])
        body, weld, root = int(model.site_bodyid[site]), model.body_weldid, model.body_rootid
        adr, cutoff = int(model.sensor_adr[sensor]), model.sensor_cutoff[sensor]

        def feels(other):
            one = other in self._core_geom and weld[body] == weld[other] and root[body] == root[other]
            return body == other or one

        for t in touches:
            if feels(int(model.geom_bodyid[t.geom])):
                ray = -t.normal
            elif feels(t.core):
                ray = t.normal
            else:
                continue
            zone = data.site_xpos[site], data.site_xmat[site], model.site_size[site]
            if mujoco.mju_rayGeom(*zone, t.pos, ray, int(model.site_type[site]), None) >= 0.0:
                data.sensordata[adr] += max(float(t.force @ t.normal), 0.0)
        if cutoff > 0.0:
            data.sensordata[adr] = min(data.sensordata[adr], cutoff)


def core_geom(model: ModelView, core: int) -> int:
    """Number of the geom that stands for the skin of BioTac `core`: the one that has the body's name."""
    mine, name = np.flatnonzero(model.geom_bodyid == core).tolist(), model.name("body", core)
    return next((g for g in mine if model.name("geom", g) == name), mine[0])


def _with_sensors(model, chosen):
    """The model as it is, but with these sensors alone, which MuJoCo computes at its last stage."""
    struct = c_structs("mjModel").from_buffer_copy(model.struct)
    struct.nsensor, struct.nplugin = len(chosen), 0
    arrays = {}  # which keep the memory
    for name in (name for name, *_ in struct._fields_ if name.startswith("sensor_")):
        arrays[name] = np.ascontiguousarray(getattr(model, name)[chosen])
        setattr(struct, name, arrays[name].ctypes.data)
    arrays["sensor_needstage"][:] = _ACC
    return struct, arrays
