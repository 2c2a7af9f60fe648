"""The skins of all worlds behind one small door: geoms where they will be in, wrenches, tangents and liquid out, all on the device."""

import numpy as np
import warp as wp

from ..skin import GeomSet, SkinData, SkinModel
from ..skin.contact import depth_in_core
from ..skin.solver import step

__all__ = ["BatchSkin"]

real = wp.float64


class BatchSkin:
    """`nworld` skins of one model and what touches them.

    Args:
      model: SkinModel.
      geoms: `coupling.stepper.Geom` descriptions of what can touch.
      grids: a distance grid for each mesh among them.
      friction: (nworld, ngeom) Coulomb coefficients.
      materials: one Material for each world, or None for the model's.
      tangents: whether `tangent` is wanted.

    Attributes (wp.arrays on the model's device, double precision):
      pos, mat: (ngeom, nworld) poses of the geoms in the BioTac frame, for the caller to write before `step`; pos_last, mat_last: of the
        last step.
      x: (nvert, nworld) nodes [m].
      wrench: (ngroup, nworld) spatial_vectord of the skin ON each touching body about the BioTac frame's origin [N, N m].
      tangent: (ngroup, nworld) spatial_matrixd, -d wrench / d (translation, rotation vector).
      pressure: (nworld,) above rest [Pa]. error: (nworld,) estimated relative error of the last step in the energy norm.
      converged, iterations: (nworld,) int of the last step.
      depth: (ngeom, nworld) how deep each geom reaches into the core, written by `find_depth` [m].
    """

    def __init__(self, model: SkinModel, nworld, geoms, grids, friction, materials=None, tangents=True):
        self.model, self.nworld, self._tangents = model, nworld, tangents
        self.data = SkinData(model, nworld, materials)
        self.geoms = GeomSet(
            [g.type for g in geoms],
            [g.size for g in geoms],
            [g.friction for g in geoms],
            [g.group for g in geoms],
            [g.rounding for g in geoms],
            grids,
            nworld=nworld,
            device=model.device,
        )
        self.geoms.set_friction(friction)
        self.ngroup = self.geoms.ngroup
        struct = self.geoms.struct
        self.pos, self.mat, self.pos_last, self.mat_last = struct.pos, struct.mat, struct.pos_last, struct.mat_last
        self.x = self.data.x
        with wp.ScopedDevice(model.device):
            self.wrench = wp.zeros((self.ngroup, nworld), dtype=wp.spatial_vectord)
            self.tangent = wp.zeros((self.ngroup, nworld), dtype=wp.spatial_matrixd)
            self.pressure = wp.zeros(nworld, dtype=real)
            self.error = wp.zeros(nworld, dtype=real)
            self.converged = wp.ones(nworld, dtype=int)
            self.iterations = wp.zeros(nworld, dtype=int)
            self.depth = wp.zeros((self.geoms.count, nworld), dtype=real)

    def find_depth(self):
        if self.model.has_core and self.geoms.count:
            wp.launch(depth_in_core, self.depth.shape, [self.model.core_vert, self.geoms.struct], [self.depth], device=self.model.device)

    def step(self, dt):
        """Solves every world for the geoms where they are now. `pos` and `mat` must be finite."""
        d = self.data
        step(self.model, d, self.geoms, dt)
        for target, value in (
            (self.wrench, np.swapaxes(d.wrench, 0, 1)),
            (self.pressure, d.pressure),
            (self.error, d.error),
            (self.converged, d.converged.astype(np.int32)),
            (self.iterations, d.iterations.astype(np.int32)),
        ):
            _fill(target, value)
        if self._tangents:
            _fill(self.tangent, np.swapaxes(d.tangent(self.geoms), 0, 1))

    def reset(self, mask):
        """Puts the worlds of mask (nworld,) bool back to rest."""
        mask = mask.numpy().astype(bool)
        d, rest = self.data, self.model.rest
        for array, value in (
            (d.x, rest.vert[:, None]),
            (d.x_last, rest.vert[:, None]),
            (d.velocity, 0.0),
            (d.increment, 0.0),
            (d.outer.anchor_geom, -1),
            *(((d.core.anchor_geom, -1), (d.core.clearance, 0.0)) if d.core else ()),
        ):
            host = array.numpy().copy()
            host[:, mask] = value
            _fill(array, host)
        if d.motion.shape[1]:
            d.motion[mask] = 0.0
        if d.liquid:
            d.liquid.last_pressure[mask] = rest.pressure
            d.liquid.gauge_pressure[mask] = rest.pressure
        for array, value in ((self.pressure, 0.0), (self.error, 0.0), (self.converged, 1), (self.iterations, 0)):
            host = array.numpy().copy()
            host[mask] = value
            _fill(array, host)


def _fill(target, value):
    wp.copy(target, wp.array(np.ascontiguousarray(value), dtype=target.dtype, ndim=target.ndim, device=target.device))
