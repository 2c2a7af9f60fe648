"""Contact area and slip of each touching body, and the modal forces of its contact force and of a height
under it. For the sensors of all worlds, after a step.

The force of a body acts on the samples that it touches, in its own direction. A height is a motion in the
same direction, and its force follows from the tangent of the step. The speed of slip is the mean speed of the
friction anchors over the body."""

import numpy as np
import warp as wp

from ..geometry.surface import FORCE_TOUCHES, OF_HERTZ
from ..kernels import kernel_module
from .data import SkinData
from .modes import SkinModes
from .types import mat66, real, vec3, vec6

kernel_module(__name__)

_TOUCHES, _OF_HERTZ = wp.constant(real(FORCE_TOUCHES)), wp.constant(real(OF_HERTZ))

_CHUNK = 96  # faces, or nodes, that one thread sums
# sums of a chunk: force on samples, force on samples that touched before, its product with their anchors'
# motion
_LOAD, _LASTING, _PATH = range(3)


def faces_of(modes: SkinModes, face: np.ndarray, nvert: int) -> np.ndarray:
    """Modal forces [N kg^-1/2 / N] and, last, steady pressure [Pa/N] by a unit force on each face (nface, 3)
    of the outer surface of nvert nodes: (nface, nmode + 1, 3)."""
    place = np.zeros(nvert, int)
    place[modes.node] = np.arange(len(modes.node))
    each = np.concatenate([modes.shape, modes.static[None]])[:, place[face]]
    return each.mean(2).swapaxes(0, 1)


@wp.kernel
def sum_chunks(
    # In:
    nsample: int,
    group: wp.array(dtype=int),
    response: wp.array2d(dtype=vec3),
    kept: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    anchor: wp.array2d(dtype=vec3),
    geom_last: wp.array2d(dtype=int),
    anchor_last: wp.array2d(dtype=vec3),
    force: wp.array2d(dtype=vec3),
    # Out:
    sum_out: wp.array3d(dtype=vec6),
    response_out: wp.array4d(dtype=vec3),
):
    """Sums of a chunk of faces [group, chunk, world], by the threads of mode 0, and the response of mode m to
    the samples, weighted by the size of their forces [mode, group, chunk, world]. A sample that makes or
    loses contact has no force, so that it causes no knock."""
    m, c, w = wp.tid()
    for g in range(sum_out.shape[0]):
        response_out[m, g, c, w] = vec3()
        if m == 0:
            sum_out[g, c, w] = vec6()
    for f in range(c * _CHUNK, wp.min((c + 1) * _CHUNK, kept.shape[0])):
        if kept[f, w] == 1:
            for s in range(nsample):
                i = f * nsample + s
                k = geom[i, w]
                if k >= 0:
                    g = group[k]
                    load = wp.length(force[i, w])
                    if response.shape[0] > 0:
                        response_out[m, g, c, w] = response_out[m, g, c, w] + load * response[m, f]
                    if m == 0:
                        one = vec6()
                        one[_LOAD] = load
                        if geom_last[i, w] == k:
                            one[_LASTING] = load
                            path = load * (anchor[i, w] - anchor_last[i, w])
                            for a in range(3):
                                one[_PATH + a] = path[a]
                        sum_out[g, c, w] = sum_out[g, c, w] + one


@wp.kernel
def sum_pressure(
    # In:
    sample: wp.array(dtype=vec3),
    group: wp.array(dtype=int),
    node: wp.array(dtype=int),
    area: wp.array(dtype=real),
    start: wp.array(dtype=int),
    slot: wp.array(dtype=int),
    kept: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    # Out:
    sum_out: wp.array3d(dtype=wp.vec2d),
):
    """Force of each body on the nodes of a chunk, and its square over their areas [group, chunk, world]."""
    c, w = wp.tid()
    nsample = sample.shape[0]
    for g in range(sum_out.shape[0]):
        total = wp.vec2d()
        for n in range(c * _CHUNK, wp.min((c + 1) * _CHUNK, node.shape[0])):
            load = real(0.0)
            for k in range(start[node[n]], start[node[n] + 1]):
                f = slot[k] // 3
                if kept[f, w] == 1:
                    for s in range(nsample):
                        i = f * nsample + s
                        if geom[i, w] >= 0:
                            if group[geom[i, w]] == g:
                                load += sample[s][slot[k] % 3] * wp.length(force[i, w])
            total += wp.vec2d(load, load * load / area[n])
        sum_out[g, c, w] = total


@wp.kernel
def write_bodies(
    # In:
    dt: wp.array(dtype=real),
    wrench: wp.array2d(dtype=vec6),
    tangent: wp.array2d(dtype=mat66),
    sums: wp.array3d(dtype=vec6),
    response: wp.array4d(dtype=vec3),
    pressure: wp.array3d(dtype=wp.vec2d),
    # Out:
    area_out: wp.array2d(dtype=real),
    force_out: wp.array2d(dtype=real),
    slip_out: wp.array2d(dtype=real),
    drive_out: wp.array2d(dtype=real),
    gain_out: wp.array3d(dtype=real),
):
    """Modal force and gain of mode m, whose last row is the steady pressure; mode 0 also writes area, force
    and slip."""
    m, w = wp.tid()
    drive = real(0.0)
    for g in range(sums.shape[0]):
        total = vec6()
        mean = vec3()
        for c in range(sums.shape[1]):
            total += sums[g, c, w]
            mean += response[m, g, c, w]
        force = -vec3(wrench[g, w][0], wrench[g, w][1], wrench[g, w][2])
        size = wp.length(force)
        if m == 0:
            path = vec3(total[_PATH], total[_PATH + 1], total[_PATH + 2])
            if total[_LASTING] > real(0.0):
                path = path / total[_LASTING]
            pressed = wp.vec2d()
            for c in range(pressure.shape[1]):
                pressed += pressure[g, c, w]
            area_out[w, g] = real(0.0)
            if pressed[0] > _TOUCHES:
                area_out[w, g] = _OF_HERTZ * pressed[0] * pressed[0] / pressed[1]
            force_out[w, g] = size
            slip_out[w, g] = real(0.0)
            if dt[w] > real(0.0):
                slip_out[w, g] = wp.length(path) / dt[w]
        if gain_out.shape[2] > 0:
            gain = real(0.0)
            if total[_LOAD] > real(0.0) and size > real(0.0):
                along = force / size
                stiff = real(0.0)
                for a in range(3):
                    for b in range(3):
                        stiff += along[a] * tangent[g, w][a, b] * along[b]
                one = wp.dot(mean, along) / total[_LOAD]
                drive += size * one
                gain = stiff * one
            gain_out[w, g, m] = gain
    if m < drive_out.shape[1]:
        drive_out[w, m] = drive


class Touched:
    """Contact of the bodies with the skins of all worlds of a SkinData.

    Args:
      data: of the skins. group: (ngeom,) body of each geom. ngroup: number of bodies.
      modes: of the skin; None: without `drive` and `gain`.

    Attributes (wp.arrays float64, written by `end`):
      area, force, slip: (nworld, ngroup) contact area of each body [m^2], see `pressure_area`, force [N] and
        speed of slip [m/s].
      drive: (nworld, nmode) modal force of all contacts [N kg^-1/2].
      gain: (nworld, ngroup, nmode + 1) modal forces by a height under each body [N kg^-1/2 / m] and, last,
        its steady pressure [Pa/m].
    """

    def __init__(self, data: SkinData, group: np.ndarray, ngroup: int, modes: SkinModes | None = None):
        model, self._data, nworld = data.model, data, data.nworld
        nface, self.device = len(model.outer.face_np), model.device
        nmode = 0 if modes is None else len(modes.rate)
        self._rows = nmode + 1
        response = np.zeros((0, nface, 3))
        if modes is not None:
            response = np.ascontiguousarray(faces_of(modes, model.outer.face_np, model.nvert).swapaxes(0, 1))
        chunks, nodes = (-(-n // _CHUNK) for n in (nface, len(model.outer.node)))
        with wp.ScopedDevice(self.device):
            self._group = wp.array(np.asarray(group, np.int32), dtype=int)
            self._response = wp.array(response, dtype=vec3, ndim=2)
            self._geom, self._anchor = wp.empty_like(data.outer.anchor_geom), wp.empty_like(data.outer.anchor)
            self._geom.fill_(-1)
            self._node_area = wp.array(model.outer.node_areas(), dtype=real)
            self._pressure = wp.zeros((ngroup, nodes, nworld), dtype=wp.vec2d)
            self._sums = wp.zeros((ngroup, chunks, nworld), dtype=vec6)
            self._response_sums = wp.zeros((self._rows, ngroup, chunks, nworld), dtype=vec3)
            self.area, self.force, self.slip = (wp.zeros((nworld, ngroup), dtype=real) for _ in range(3))
            self.drive = wp.zeros((nworld, nmode), dtype=real)
            self.gain = wp.zeros((nworld, ngroup, nmode + 1 if nmode else 0), dtype=real)

    def begin(self) -> None:
        """To be called before a step. Launches only."""
        if self._response.shape[0]:  # slip is needed with modes only
            wp.copy(self._geom, self._data.outer.anchor_geom)
            wp.copy(self._anchor, self._data.outer.anchor)

    def end(self, wrench: wp.array, tangent: wp.array) -> None:
        """To be called after a step. Launches only.

        Args:
          wrench: (ngroup, nworld) spatial_vectord of the skin ON each body [N, N m].
          tangent: (ngroup, nworld) spatial_matrixd, -d wrench / d motion; used with modes only.
        """
        d, nworld = self._data, self._data.nworld
        outer, shape = d.outer, (self._rows, self._sums.shape[1], nworld)
        surface, sample = d.model.outer, d.model.sample
        inputs = [sample, self._group, surface.node, self._node_area, surface.start, surface.slot]
        inputs += [outer.kept, outer.anchor_geom, outer.sample_force]
        wp.launch(sum_pressure, self._pressure.shape[1:], inputs, [self._pressure], device=self.device)
        inputs = [len(sample), self._group, self._response, outer.kept]
        inputs += [outer.anchor_geom, outer.anchor, self._geom, self._anchor, outer.sample_force]
        wp.launch(sum_chunks, shape, inputs, [self._sums, self._response_sums], device=self.device)
        inputs = [d.dt, wrench, tangent, self._sums, self._response_sums, self._pressure]
        outputs = [self.area, self.force, self.slip, self.drive, self.gain]
        wp.launch(write_bodies, (self._rows, nworld), inputs, outputs, device=self.device)
