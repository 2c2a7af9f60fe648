"""Adds the forces of the skins to mujoco_warp's own force quantities, for all worlds at once
(`coupling/loads.py` for one): `cfrc_ext` and `cfrc_int` where mujoco_warp computes them, and the sensors
`<force>`, `<torque>`, `<touch>` and `<contact>`."""

import copy
import typing

import mujoco
import numpy as np
import warp as wp
from mujoco_warp._src.types import ContactType

from ..coupling.loads import PYRAMID, passes
from ..kernels import kernel_module
from ..skin.types import double, real, vec3, vec6, widen
from .engine import Contacts, contacts_of, copy_contact, vec5

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

kernel_module(__name__)

_FORCE, _TORQUE, _TOUCH, _CONTACT = (
    int(getattr(mujoco.mjtSensor, f"mjSENS_{n}")) for n in ("FORCE", "TORQUE", "TOUCH", "CONTACT")
)
_CONSTRAINT, _PYRAMID = wp.constant(int(ContactType.CONSTRAINT)), wp.constant(PYRAMID)


@wp.kernel
def clear_rows(
    # In:
    row: wp.array2d(dtype=int),
    # In and out:
    force: wp.array2d(dtype=float),
):
    """Takes the forces of a skin's rows, which lie where those of welds do."""
    s, w = wp.tid()
    first = row[s, w]
    if first >= 0:
        for i in range(6):
            force[w, first + i] = 0.0


@wp.kernel
def clear_sums(address: wp.array(dtype=int), sensordata_out: wp.array2d(dtype=float)):
    """Clears the touch sensors, to which mujoco_warp adds."""
    w, i = wp.tid()
    sensordata_out[w, address[i]] = 0.0


@wp.kernel
def copy_contacts(contact: Contacts, contact_out: Contacts):
    i = wp.tid()
    n = wp.min(contact.nacon[0], contact.dist.shape[0])
    if i == 0:
        contact_out.nacon[0] = n
    if i < n:
        copy_contact(contact, i, contact_out, i)


@wp.kernel
def list_touches(
    # In:
    core: int,
    core_geom: int,
    geom: wp.array(dtype=int),
    pyramidal: bool,
    row: int,
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    pos: wp.array2d(dtype=vec3),
    normal: wp.array2d(dtype=vec3),
    wrench: wp.array2d(dtype=vec6),
    # In and out:
    contact: Contacts,
    row_force: wp.array2d(dtype=float),
):
    """Adds the touches of a skin to the contacts, each with six components; rows from `row` on are theirs."""
    k, w = wp.tid()
    force = wp.spatial_top(wrench[k, w])
    if wp.dot(force, force) == real(0.0):
        return
    i = wp.atomic_add(contact.nacon, 0, 1)
    turn = widen(xmat[w, core])
    n = turn * normal[k, w]
    t = vec3(real(0.0), real(1.0), real(0.0))  # as MuJoCo makes frames
    if wp.abs(n[1]) >= real(0.5):
        t = vec3(real(0.0), real(0.0), real(1.0))
    t = wp.normalize(t - wp.dot(t, n) * n)
    frame = wp.matrix_from_rows(n, t, wp.cross(n, t))
    force = frame * (turn * force)
    torque = frame * (turn * wp.spatial_bottom(wrench[k, w]))
    contact.dist[i] = 0.0
    contact.pos[i] = wp.vec3(turn * pos[k, w] + double(xpos[w, core]))
    contact.frame[i] = wp.mat33(frame)
    contact.friction[i] = vec5(1.0, 1.0, 1.0, 1.0, 1.0)
    contact.dim[i] = 6
    contact.geom[i] = wp.vec2i(core_geom, geom[k])
    contact.worldid[i] = w
    contact.type[i] = _CONSTRAINT
    contact.adhesion[i] = 0.0
    first = row + _PYRAMID * k
    for c in range(_PYRAMID):
        contact.efc_address[i, c] = first + c
    if pyramidal:  # the mean of two edges' sum is the normal force's part, their difference a component
        for c in range(5):
            value = torque[wp.max(c - 2, 0)]
            if c < 2:
                value = force[c + 1]
            row_force[w, first + 2 * c] = float(force[0] / real(10.0) + value / real(2.0))
            row_force[w, first + 2 * c + 1] = float(force[0] / real(10.0) - value / real(2.0))
    else:
        for c in range(3):
            row_force[w, first + c] = float(force[c])
            row_force[w, first + 3 + c] = float(torque[c])


class Loads:
    """Force quantities of a mujoco_warp Model with batches; made before a capture begins. Sensors with a
    delay lack the skins."""

    def __init__(self, m: "mjw.Model", d: "mjw.Data", batches: list):
        kind, adr = m.sensor_type.numpy(), m.sensor_adr.numpy()
        found = passes(m, [batch._core for batch in batches])
        sums = [adr[i] for sensors, _ in found for i in sensors if kind[i] == _TOUCH]
        self._forces = bool(m.opt.run_rne_postconstraint or m.sensor_rne_postconstraint)
        self._lists = self._forces or bool(found)
        with wp.ScopedDevice(d.qpos.device):
            self._sums = wp.array(np.array(sums, np.int32), dtype=int)
            self._again = [_with_sensors(m, *one) for one in found]
            if self._lists:
                self._prepare_contacts(d, batches)

    def _prepare_contacts(self, d, batches):
        """A Data like `d` whose contacts have room for the skins'."""
        ngeom = sum(batch.ngeom for batch in batches)
        room, rows = d.naconmax + d.nworld * ngeom, d.njmax + _PYRAMID * ngeom
        self._data = copy.copy(d)
        self._data.contact, self._data.efc = copy.copy(d.contact), copy.copy(d.efc)
        for name in set(Contacts.vars) - {"nacon"}:
            given = getattr(d.contact, name)
            shape = (room, max(_PYRAMID, given.shape[1])) if given.ndim == 2 else (room,)
            setattr(self._data.contact, name, wp.zeros(shape, dtype=given.dtype))
        for name in ("force", "type", "id"):  # what is read of rows; those of touches have no type
            given = getattr(d.efc, name)
            setattr(self._data.efc, name, wp.zeros((d.nworld, rows), dtype=given.dtype))
        self._data.nacon = wp.zeros(1, dtype=int)
        self._data.naconmax, self._data.njmax = room, rows
        self._mujocos, self._listed = contacts_of(d), contacts_of(self._data)

    def write(self, m: "mjw.Model", d: "mjw.Data", batches: list) -> None:
        """Writes the force quantities, after each `Batch` has computed the forces that act on its bodies.
        mujoco_warp's own functions evaluate them, on its contacts and those of the skins. Launches only."""
        from mujoco_warp._src import sensor
        from mujoco_warp._src.smooth import rne_postconstraint

        if not self._lists:
            return
        device = d.qpos.device
        wp.launch(copy_contacts, d.naconmax, [self._mujocos], [self._listed], device=device)
        for name in ("force", "type", "id"):
            wp.copy(getattr(self._data.efc, name)[:, : d.njmax], getattr(d.efc, name))
        row = d.njmax
        for batch in batches:
            batch.find_touches()
            batch.list_touches(m, d, row, [self._listed, self._data.efc.force])
            row += _PYRAMID * batch.ngeom
        if self._forces:
            rne_postconstraint(m, self._data)
        sums = d.nworld, len(self._sums)
        wp.launch(clear_sums, sums, [self._sums], [d.sensordata], device=device)
        for again in self._again:
            sensor.sensor_acc(again, self._data, skip_rne_postconstraint=True)
            wp.launch(  # mujoco_warp cuts tendons' sums alone
                sensor._tendon_actuator_force_cutoff,
                (d.nworld, again.sensor_touch_adr.size),
                [m.sensor_type, m.sensor_datatype, m.sensor_adr, m.sensor_cutoff, again.sensor_touch_adr],
                [d.sensordata, d.sensordata],
                device=device,
            )


def _with_sensors(m, chosen, body):
    """The Model with these sensors of force alone, and with geoms on these bodies."""
    again, kind = copy.copy(m), m.sensor_type.numpy()[chosen]

    def those(*kinds):
        return wp.array(chosen[np.isin(kind, kinds)].astype(np.int32), dtype=int)

    again.callback, again.geom_bodyid = type(m.callback)(), wp.array(body.astype(np.int32), dtype=int)
    again.sensor_acc_adr, again.sensor_contact_acc_adr = those(_FORCE, _TORQUE), those(_CONTACT)
    again.sensor_touch_adr, none = those(_TOUCH), those()
    again.sensor_tendonactfrc_adr = again.sensor_limitfrc_adr = again.sensor_stage_acc_adr = none
    return again
