"""What mujoco_warp's own force quantities have of the skins, for all worlds at once (`coupling/loads.py` for
one): `cfrc_ext` and `cfrc_int` where mujoco_warp computes them, and the sensors `<force>`, `<torque>` and
`<touch>`."""

import typing

import mujoco
import numpy as np
import warp as wp
from mujoco_warp._src.ray import ray_geom

from ..skin.types import double, widen

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

__all__ = ["Loads"]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec3 = wp.vec3d
vec6 = wp.spatial_vectord
_FORCE, _TORQUE, _TOUCH = (
    int(getattr(mujoco.mjtSensor, f"mjSENS_{n}")) for n in ("FORCE", "TORQUE", "TOUCH")
)
_TINY = wp.constant(wp.float64(1e-12))  # [N]


@wp.kernel
def apply_wrenches(
    # In:
    core: int,
    body: wp.array(dtype=int),
    acting: wp.array2d(dtype=vec6),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    xipos: wp.array2d(dtype=wp.vec3),
    # In and out:
    applied: wp.array2d(dtype=wp.spatial_vector),
):
    """Adds what a skin does to its bodies, and these to its core, to xfrc_applied [world, body]."""
    w = wp.tid()
    turn = widen(xmat[w, core])
    total = vec6()
    for g in range(body.shape[0] + 1):
        b = core
        one = -total
        if g < body.shape[0]:
            b = body[g]
            one = acting[g, w]
            total += one
        force = turn * wp.spatial_top(one)
        torque = turn * wp.spatial_bottom(one)
        torque += wp.cross(double(xpos[w, core]) - double(xipos[w, b]), force)
        applied[w, b] = applied[w, b] + wp.spatial_vector(wp.vec3(force), wp.vec3(torque))


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
def write_wrench_sensors(
    # In:
    sensor: wp.array(dtype=int),
    sensor_type: wp.array(dtype=int),
    sensor_objid: wp.array(dtype=int),
    sensor_adr: wp.array(dtype=int),
    sensor_cutoff: wp.array(dtype=float),
    site_bodyid: wp.array(dtype=int),
    body_rootid: wp.array(dtype=int),
    site_xpos: wp.array2d(dtype=wp.vec3),
    site_xmat: wp.array2d(dtype=wp.mat33),
    com: wp.array2d(dtype=wp.vec3),
    internal: wp.array2d(dtype=wp.spatial_vector),
    # Out:
    sensordata_out: wp.array2d(dtype=float),
):
    """<force> and <torque> by cfrc_int."""
    k, w = wp.tid()
    i = sensor[k]
    site = sensor_objid[i]
    b = site_bodyid[site]
    inside = internal[w, b]  # torque first
    value = wp.spatial_bottom(inside)
    if sensor_type[i] == _TORQUE:
        lever = site_xpos[w, site] - com[w, body_rootid[b]]
        value = wp.spatial_top(inside) - wp.cross(lever, value)
    value = wp.transpose(site_xmat[w, site]) * value
    for a in range(3):
        v = value[a]
        if sensor_cutoff[i] > 0.0:
            v = wp.clamp(v, -sensor_cutoff[i], sensor_cutoff[i])
        sensordata_out[w, sensor_adr[i] + a] = v


@wp.kernel
def find_resultants(
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
    force_out: wp.array2d(dtype=real),
):
    """Of each body on a skin: centre of pressure, mean normal out of the skin there, and the force along
    it."""
    g, w = wp.tid()
    load = real(0.0)
    pos = vec3()
    normal = vec3()
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
                        load += push
                        pos += push / real(3.0) * (a + b + c)
                        normal += push * n
    size = real(0.0)
    if load > _TINY:
        pos_out[g, w] = pos / load
        normal = wp.normalize(normal)
        size = wp.max(wp.dot(wp.spatial_top(acting[g, w]), normal), real(0.0))
    normal_out[g, w] = normal
    force_out[g, w] = size


@wp.kernel
def add_touch(
    # In:
    core: int,
    body: wp.array(dtype=int),
    sensor: wp.array(dtype=int),
    sensor_objid: wp.array(dtype=int),
    sensor_adr: wp.array(dtype=int),
    sensor_cutoff: wp.array(dtype=float),
    body_weldid: wp.array(dtype=int),
    body_rootid: wp.array(dtype=int),
    site_bodyid: wp.array(dtype=int),
    site_type: wp.array(dtype=int),
    site_size: wp.array(dtype=wp.vec3),
    site_xpos: wp.array2d(dtype=wp.vec3),
    site_xmat: wp.array2d(dtype=wp.mat33),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    pos: wp.array2d(dtype=vec3),
    normal: wp.array2d(dtype=vec3),
    force: wp.array2d(dtype=real),
    # In and out:
    sensordata: wp.array2d(dtype=float),
):
    """Adds the contacts whose ray out of the sensor's body meets its site."""
    k, w = wp.tid()
    i = sensor[k]
    site = sensor_objid[i]
    b = site_bodyid[site]
    turn = widen(xmat[w, core])
    for g in range(body.shape[0]):
        sign = real(0.0)
        if b == body[g]:
            sign = real(-1.0)
        elif body_weldid[b] == body_weldid[core] and body_rootid[b] == body_rootid[core]:
            sign = real(1.0)
        if sign != real(0.0) and force[g, w] > real(0.0):
            at = wp.vec3(turn * pos[g, w] + double(xpos[w, core]))
            ray = wp.vec3(sign * (turn * normal[g, w]))
            frame = site_xmat[w, site]
            away, _normal = ray_geom(site_xpos[w, site], frame, site_size[site], at, ray, site_type[site])
            if away >= 0.0:
                sensordata[w, sensor_adr[i]] = sensordata[w, sensor_adr[i]] + float(force[g, w])
    if sensor_cutoff[i] > 0.0:
        sensordata[w, sensor_adr[i]] = wp.min(sensordata[w, sensor_adr[i]], sensor_cutoff[i])


class Loads:
    """Of a mujoco_warp Model with batches; made before a capture begins. Delayed sensors lack the skins."""

    def __init__(self, m: "mjw.Model", d: "mjw.Data"):
        kind, late = m.sensor_type.numpy(), m.sensor_delay.numpy().max(axis=0, initial=0.0) > 0.0

        def those(kinds):
            return wp.array(np.flatnonzero(np.isin(kind, kinds) & ~late).astype(np.int32), dtype=int)

        with wp.ScopedDevice(d.qpos.device):
            self._wrench, self._touch = those((_FORCE, _TORQUE)), those((_TOUCH,))
            self._applied, self._rows = wp.empty_like(d.xfrc_applied), wp.empty_like(d.efc.force)

    def write(self, m: "mjw.Model", d: "mjw.Data", batches: list) -> None:
        """Writes them, when each `Batch` has found what acts; of those that move bodies. Launches only."""
        import mujoco_warp as mjw

        if m.opt.run_rne_postconstraint or m.sensor_rne_postconstraint:
            wp.copy(self._applied, d.xfrc_applied)
            wp.copy(self._rows, d.efc.force)
            for batch in batches:
                batch.apply_wrenches(d)
            mjw.rne_postconstraint(m, d)
            wp.copy(d.xfrc_applied, self._applied)
            wp.copy(d.efc.force, self._rows)
            sensors = [self._wrench, m.sensor_type, m.sensor_objid, m.sensor_adr, m.sensor_cutoff]
            frames = [m.site_bodyid, m.body_rootid, d.site_xpos, d.site_xmat, d.subtree_com, d.cfrc_int]
            shape = len(self._wrench), d.nworld
            wp.launch(write_wrench_sensors, shape, [*sensors, *frames], [d.sensordata], device=d.qpos.device)
        if len(self._touch):
            for batch in batches:
                batch.add_touch(m, d, self._touch)
