"""What MuJoCo's own force quantities have of the skins: `cfrc_ext`, `cfrc_int`, `<force>`, `<torque>` and
`<touch>`.

A skin acts through `qfrc_passive` and through rows of constraints, which are no forces on bodies for MuJoCo.
So after its constraint solver `mj_rnePostConstraint` runs once more, with the skins' wrenches in
`xfrc_applied` while it does; then the sensors that read its results are written again. For `<touch>` each
body that a skin touches is one contact, at the centre of pressure.

The rows of a skin lie where MuJoCo expects those of welds: what they push is left out there and counted
here."""

import ctypes
from typing import NamedTuple

import mujoco
import numpy as np

from ..geometry.rigid import cross
from .structs import LIBRARY, DataView, ModelView

__all__ = ["Loads"]

LIBRARY.mj_rnePostConstraint.argtypes = (ctypes.c_void_p,) * 2
_SENSORS = {
    int(getattr(mujoco.mjtSensor, f"mjSENS_{name.upper()}")): name for name in ("force", "torque", "touch")
}


class _Contact(NamedTuple):
    """One body on one skin, in the world: the bodies, centre of pressure [m], normal from core to body, and
    the normal force [N]."""

    core: int
    body: int
    pos: np.ndarray
    normal: np.ndarray
    force: float


class Loads:
    """Of all two-way skins of one mjData."""

    def __init__(self, model: ModelView, data: DataView, coupled: list):
        self.model, self.data, self.coupled = model, data, coupled
        kinds = [(i, _SENSORS.get(int(kind))) for i, kind in enumerate(model.sensor_type)]
        now = [(i, kind) for i, kind in kinds if kind and not model.sensor_delay[i] > 0.0]
        self._wrenches = [(i, kind) for i, kind in now if kind != "touch"]
        self._touches = [i for i, kind in now if kind == "touch"]

    def write(self, acting: dict) -> None:
        """Writes cfrc_ext, cfrc_int and the sensors. acting: {instance: wrenches (ngroup, 6) that its bodies
        get}, in the BioTac's frame."""
        loaded = {instance: wrench for instance, wrench in acting.items() if wrench.any()}
        if not loaded:
            return
        self._find_internal(loaded)
        for i, kind in self._wrenches:
            self._write_sensor(i, self._at_site(i)[3 if kind == "force" else 0 :][:3])
        if self._touches:
            contacts = [c for instance, wrench in loaded.items() for c in self._contacts(instance, wrench)]
            for i in self._touches:
                self._add_touch(i, contacts)

    def _find_internal(self, loaded):
        data = self.data
        rows = np.concatenate([np.zeros(0, int), *(i.metric.numbers() for i in self.coupled)])
        applied, pushed = data.xfrc_applied, data.efc_force
        kept = applied.copy(), pushed[rows].copy()
        pushed[rows] = 0.0
        for instance, wrench in loaded.items():
            core = instance.touching.core
            frame, body = data.xmat[core].reshape(3, 3), [*instance.touching.body, core]
            both = np.concatenate([wrench, -wrench.sum(axis=0)[None]])
            force, torque = both[:, :3] @ frame.T, both[:, 3:] @ frame.T
            applied[body, :3] += force
            applied[body, 3:] += torque + cross(data.xpos[core] - data.xipos[body], force)
        LIBRARY.mj_rnePostConstraint(self.model.address, data.address)
        applied[:], pushed[rows] = kept

    def _at_site(self, sensor):
        """Torque and force (6,) that a site's body gets from its parent, in the site's frame and about it."""
        model, data, site = self.model, self.data, int(self.model.sensor_objid[sensor])
        body = int(model.site_bodyid[site])
        turn, wrench = data.site_xmat[site].reshape(3, 3), data.cfrc_int[body]
        lever = data.site_xpos[site] - data.subtree_com[model.body_rootid[body]]
        return np.concatenate([(wrench[:3] - np.cross(lever, wrench[3:])) @ turn, wrench[3:] @ turn])

    def _write_sensor(self, sensor, value):
        model = self.model
        cutoff, start = model.sensor_cutoff[sensor], int(model.sensor_adr[sensor])
        if cutoff > 0.0:
            value = np.clip(value, -cutoff, cutoff)
        self.data.sensordata[start : start + len(value)] = value

    def _add_touch(self, sensor, contacts):
        """Adds the contacts whose ray out of the sensor's body meets the site, as MuJoCo does with its own.
        What a BioTac is welded to is one with it, but for the world."""
        model, data, site = self.model, self.data, int(self.model.sensor_objid[sensor])
        body, weld, root = int(model.site_bodyid[site]), model.body_weldid, model.body_rootid
        total = float(data.sensordata[model.sensor_adr[sensor]])
        for c in contacts:
            if body == c.body:
                ray = -c.normal
            elif weld[body] == weld[c.core] and root[body] == root[c.core]:
                ray = c.normal
            else:
                continue
            zone = data.site_xpos[site], data.site_xmat[site], model.site_size[site]
            if mujoco.mju_rayGeom(*zone, c.pos, ray, int(model.site_type[site]), None) >= 0.0:
                total += c.force
        self._write_sensor(sensor, np.array([total]))

    def _contacts(self, instance, wrench):
        """One contact for each body that a skin pushes."""
        core = instance.touching.core
        frame, origin = self.data.xmat[core].reshape(3, 3), self.data.xpos[core]
        for body, (pos, normal, force) in zip(instance.touching.body, instance.resultants(wrench)):
            if force > 0.0:
                yield _Contact(core, int(body), origin + frame @ pos, frame @ normal, force)
