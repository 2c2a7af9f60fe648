"""SkinData: everything about a skin that changes, for every world."""

import functools

import numpy as np
import warp as wp

from .contact_law import world_laws
from .launch import Launches
from .liquid import Liquid
from .model import SkinModel
from .stress_memory import StressMemory
from .types import mat33, real, vec3

__all__ = ["ContactState", "SkinData", "view"]


def view(array: wp.array):
    """The array's memory as numpy (CPU) or torch (CUDA), not copied: (item, nworld, ...)."""
    return wp.to_torch(array) if array.device.is_cuda else array.numpy()


class ContactState:
    """Contact of one surface: what it remembers (anchors) and what the last evaluation wrote."""

    def __init__(self, surface, nsample, nvert, nworld):
        nface = len(surface.face)
        self.surface, self.bond = surface, None
        self.anchor_geom = wp.full((nface * nsample, nworld), -1, dtype=int)
        self.anchor = wp.zeros((nface * nsample, nworld), dtype=vec3)
        self.trial_geom = wp.full((nface * nsample, nworld), -1, dtype=int)
        self.trial_anchor = wp.zeros((nface * nsample, nworld), dtype=vec3)
        self.sample_force = wp.zeros((nface * nsample, nworld), dtype=vec3)
        self.corner = wp.zeros((3 * nface, nworld), dtype=vec3)
        self.block = wp.zeros((6 * nface, nworld), dtype=mat33)
        self.touching = wp.zeros((nface, nworld), dtype=int)
        self.node_force = wp.zeros((nvert, nworld), dtype=vec3)
        self.seen = wp.zeros((3 * nface, nworld), dtype=vec3)
        self.clearance = wp.zeros((nface, nworld), dtype=real)
        self.kept = wp.zeros((nface, nworld), dtype=int)  # faces with anchors; of the device step

    def reset(self):
        self.clearance.zero_()
        self.anchor_geom.fill_(-1)
        for array in (self.trial_geom, self.touching, self.node_force, self.sample_force, self.kept):
            array.zero_()
        self.trial_geom.fill_(-1)

    def active(self, w):
        """Faces of world w that touch (n,) and their tangents (n, 6, 3, 3), on the host."""
        faces = np.flatnonzero(_host(view(self.touching)[:, w]))
        return faces, _host(view(self.block)[6 * faces[:, None] + np.arange(6), w])

    def commit(self):
        wp.copy(self.anchor_geom, self.trial_geom if self.bond is None else self.bond)
        wp.copy(self.anchor, self.trial_anchor)


class _Scalar:
    """An attribute (nworld,) that numpy holds, or a field of `Worlds` on the device, read when asked for."""

    def __init__(self, field, read=lambda value: value):
        self._field, self._read = field, read

    def __get__(self, data, owner=None):
        if data is None:
            return self
        return (
            data.__dict__[self._field]
            if data.worlds is None
            else self._read(getattr(data.worlds, self._field).numpy())
        )

    def __set__(self, data, value):
        if data.worlds is None:
            data.__dict__[self._field] = value
        else:
            getattr(data.worlds, self._field).fill_(0)


class SkinData:
    """State and outputs of `nworld` skins.

    Args:
      model: the SkinModel.
      nworld: number of worlds.
      material: None, or one Material of the model's law for each world.
      resident: whether all state lives on the device and `step` never looks back at the host (see
        `device_step`): on CUDA, always. Attributes are then copied when they are read, and a world's contact
        beyond `contact_capacity` touching nodes slows its solves.

    Attributes (all arrays lead with nworld, on the host):
      vert_xpos: (nworld, nvert, 3) nodal positions in the BioTac frame [m].
      contact_force: (nworld, nvert, 3) nodal forces of the touching geoms on the skin [N].
      core_force: (nworld, nvert, 3) nodal forces of the core on the inner surface [N].
      liquid_force: (nworld, nvert, 3) nodal forces of the liquid on the inner surface [N]; on the core it
        pushes the opposite way.
      reaction: (nworld, 3) force of core, nail and clamp on the fixed nodes [N].
      wrench: (nworld, ngroup, 6) of the skin ON each group of geoms, torque about the BioTac frame's origin
        [N, N m].
      pressure: (nworld,) of the liquid above its rest value, which is `model.rest.pressure` [Pa].
      volume: (nworld,) of the liquid [m^3].
      converged: (nworld,) whether the last step converged.
      nonconverged: (nworld,) number of steps that did not, since reset.
      iterations: (nworld,) Newton iterations of the last step.
      error: (nworld,) estimated relative error of the last step in the energy norm.
      memory: StressMemory of skin with `prony`, `mullins`, `hysteresis` or `stiffening`, or None; `reset`
        forgets.
    """

    converged = _Scalar("reason", lambda reason: reason == 0)
    nonconverged = _Scalar("nonconverged", lambda count: count.astype(int))
    iterations = _Scalar("iterations", lambda count: count.astype(int))
    error = _Scalar("error")
    # touching nodes in a world's small system; None: 63, all that a block of threads holds, but 127 on fine
    # skins
    contact_capacity = None

    def __init__(self, model: SkinModel, nworld: int = 1, material=None, resident: bool | None = None):
        materials = [model.material] * nworld if material is None else list(material)
        if len(materials) != nworld or any(m.law != model.material.law for m in materials):
            raise ValueError(f"pass one {model.material.law} material for each of the {nworld} worlds")
        if any(m.beyond_law != model.material.beyond_law for m in materials):
            raise ValueError(
                f"{', '.join(model.material.beyond_law)} are the model's: give the worlds' materials the same"
            )
        self.nworld, self.model = nworld, model
        self.resident = model.device.is_cuda if resident is None else resident
        if self.resident and model.extensions:
            raise ValueError(
                f"skin with {' and '.join(model.extensions)} is solved on the CPU's full tier only: choose "
                "device='cpu' and "
                "resident=False, or leave this out"
            )
        if model.device.is_cuda and not self.resident:
            raise ValueError(
                "on CUDA the state is always resident: leave resident out, or make the model on the CPU"
            )
        second = [m.bulk if m.law == "neo_hookean" else m.lame for m in materials]
        nsample = len(model.sample)
        with wp.ScopedDevice(model.device):
            self.mu = wp.array([m.mu for m in materials], dtype=real)
            self.lam = wp.array(second, dtype=real)
            self.x = wp.array(np.repeat(model.geometry.vert[:, None], nworld, 1), dtype=vec3, ndim=2)
            self.x_last = wp.clone(self.x)
            self.velocity = wp.zeros_like(self.x)  # of implicit dynamics, world frame
            self.force = wp.zeros_like(self.x)
            self.gradient = wp.zeros_like(self.x)  # of the liquid's volume
            self.increment = wp.zeros_like(self.x)  # of the last step: where the next one starts to look
            self.outer = ContactState(model.outer, nsample, model.nvert, nworld)
            self.core = (
                ContactState(model.core_surface, nsample, model.nvert, nworld) if model.has_core else None
            )
            self.rest_vert = wp.array(model.rest.vert[:, None], dtype=vec3)
        self.laws = world_laws(model, nworld, self.resident, self.outer)
        self.worlds, self.device_memory, self.device_steps = None, None, {}
        if self.resident:
            self._allocate_device()
        self.liquid = Liquid(model, nworld, self.worlds) if model.inner is not None else None
        self.memory = StressMemory(model, nworld, self.mu, self.lam) if model.material.extensions else None
        self.stiffness_scale = np.array([m.youngs_modulus for m in materials]) / model.material.youngs_modulus
        self.core_pos = np.zeros((nworld, 3))
        self.core_mat = np.tile(np.eye(3), (nworld, 1, 1))
        self.reset()

    # of steps from the host; never made where the state is resident

    @functools.cached_property
    def elastic(self):
        return self.model.elasticity.allocate(self.nworld)

    @functools.cached_property
    def launch(self):
        return Launches(self.model.device)

    @functools.cached_property
    def direction(self):
        return wp.zeros_like(self.x)

    @functools.cached_property
    def product(self):
        return wp.zeros_like(self.x)

    @functools.cached_property
    def bending(self):
        return wp.zeros_like(self.x)

    def _allocate_device(self):
        from .device_worlds import Worlds

        n = self.nworld
        with wp.ScopedDevice(self.model.device):
            self.worlds = Worlds()
            for name, variable in Worlds.vars.items():
                setattr(self.worlds, name, wp.zeros(n, dtype=variable.type.dtype))
            self.worlds.mu, self.worlds.lam = self.mu, self.lam
            self.dt = wp.zeros(n, dtype=real)
            self.frame_pos, self.frame_pos_last = (wp.zeros(n, dtype=vec3) for _ in range(2))
            self.frame_mat, self.frame_mat_last = (
                wp.array(np.tile(np.eye(3), (n, 1, 1)), dtype=mat33) for _ in range(2)
            )
        self._of_geoms, self._of_groups, self._counts = {}, {}, (0, 0)

    def geom_memory(self, count: int, ngroup: int):
        """What a resident state remembers of geoms: their last motion [geom, world], which of them touch,
        wrenches on groups."""
        self._counts = (count, ngroup)
        with wp.ScopedDevice(self.model.device):
            if count not in self._of_geoms:
                shape = (count, self.nworld)
                self._of_geoms[count] = wp.zeros(shape, dtype=vec3), wp.zeros(shape, dtype=int)
            if ngroup not in self._of_groups:
                self._of_groups[ngroup] = wp.zeros((ngroup, self.nworld, 6), dtype=real)
        return *self._of_geoms[count], self._of_groups[ngroup]

    def reset(self):
        """Puts every world back to rest: the skin on its filling, nothing touching."""
        rest = np.repeat(self.model.rest.vert[:, None], self.nworld, 1)
        for array in (self.x, self.x_last):
            wp.copy(array, wp.array(rest, dtype=vec3, ndim=2, device=array.device))
        self.velocity.zero_()
        self.increment.zero_()
        if self.resident:
            for arrays in (*self._of_geoms.values(), self._of_groups.values()):
                for array in arrays:
                    array.zero_()
        else:
            self._motion, self._wrench = np.zeros((self.nworld, 0, 3)), np.zeros((self.nworld, 0, 6))
        self.force.zero_()
        self.external = None
        for part in (self.outer, self.core, self.liquid):
            if part:
                part.reset()
        if self.memory:
            self.memory.reset(self.x)
        self.converged = np.ones(self.nworld, bool)
        self.nonconverged = np.zeros(self.nworld, int)
        self.iterations = np.zeros(self.nworld, int)
        self.error = np.zeros(self.nworld)

    def set_external(self, force):
        """Loads the nodes in every step from now on, until `reset`.

        Args:
          force: (nworld, nvert, 3) [N], or None for no load.

        Raises:
          ValueError: a wrong shape or NaN.
        """
        self.device_steps.clear()  # what was recorded knew the old loads
        if force is None:
            self.external = None
            return
        force = np.asarray(force, float)
        if force.shape != (self.nworld, self.model.nvert, 3) or not np.isfinite(force).all():
            raise ValueError(
                f"external forces have shape {force.shape}: pass finite numbers of shape "
                f"{(self.nworld, self.model.nvert, 3)}"
            )
        self.external_device = wp.array(
            np.ascontiguousarray(np.swapaxes(force, 0, 1)), dtype=vec3, ndim=2, device=self.x.device
        )
        self.external = view(self.external_device)

    def set_liquid(self, bulk_modulus=None, fill_volume=None):
        """Gives each world its liquid, from the next step on and through `reset`.

        Args:
          bulk_modulus: (nworld,) or a number [Pa]; 0: no liquid; math.inf keeps its volume.
          fill_volume: (nworld,) or a number: liquid beyond what the model's options fill in [m^3]. The skin
            swells in the next step.

        Raises:
          ValueError: a model without liquid, NaN, a negative bulk modulus, or less than no liquid.
        """
        if not self.model.has_liquid:
            raise ValueError("this model has no liquid: make it with SkinOptions(liquid=True)")
        liquid, rest = self.liquid, self.model.rest
        bulk = (
            liquid.bulk_modulus
            if bulk_modulus is None
            else np.array(np.broadcast_to(np.asarray(bulk_modulus, float), self.nworld))
        )
        extra = (
            liquid.extra
            if fill_volume is None
            else np.array(np.broadcast_to(np.asarray(fill_volume, float), self.nworld))
        )
        if not (bulk >= 0).all() or not (np.isfinite(extra) & (rest.natural_volume + extra > 0)).all():
            raise ValueError(
                "bulk moduli must be numbers >= 0 (or math.inf), fill volumes finite and not less than "
                "minus what there is"
            )
        liquid.bulk_modulus, liquid.extra = bulk, extra
        liquid.fill(rest.natural_volume + extra)
        liquid.last_pressure = np.where(bulk == 0, 0.0, liquid.last_pressure)

    @property
    def motion(self):
        """Of the geoms in the last step (nworld, ngeom, 3) [m]."""
        return _leading(self.geom_memory(*self._counts)[0]) if self.resident else self._motion

    @motion.setter
    def motion(self, value):
        if not self.resident:
            self._motion = value
            return
        array, *_ = self.geom_memory(value.shape[1], self._counts[1])
        if array.size:
            array.assign(np.ascontiguousarray(np.swapaxes(value, 0, 1)))

    @property
    def wrench(self):
        return _leading(self.geom_memory(*self._counts)[2]) if self.resident else self._wrench

    @wrench.setter
    def wrench(self, value):
        self._wrench = value

    @property
    def pressure(self):
        return (
            self.liquid.gauge_pressure - self.model.rest.pressure
            if self.model.has_liquid
            else np.zeros(self.nworld)
        )

    @property
    def volume(self):
        return self.liquid.volume if self.liquid else np.zeros(self.nworld)

    @property
    def vert_xpos(self):
        return _leading(self.x)

    @property
    def contact_force(self):
        return _leading(self.outer.node_force)

    @property
    def core_force(self):
        return _leading(self.core.node_force) if self.core else np.zeros((self.nworld, self.model.nvert, 3))

    @property
    def liquid_force(self):
        if not self.model.has_liquid:
            return np.zeros((self.nworld, self.model.nvert, 3))
        return self.liquid.gauge_pressure[:, None, None] * _leading(self.gradient)

    @property
    def reaction(self):
        return -self.force.numpy()[self.model.fixed].sum(0)

    def load(self, x, increment, motion, contacts, pressure=0.0):
        """Sets the state of a single world; the inverse of reading it.

        Args:
          x, increment: (nvert, 3) positions and last increment [m].
          motion: (ngeom, 3) of the geoms in the last step [m].
          contacts: (n, 5) sample, geom and anchor (in the geom's frame) [m] of what sticks, as `contacts`
            gives them.
          pressure: of the liquid above the surroundings [Pa], `liquid.last_pressure`.
        """
        for array, value in ((self.x, x), (self.x_last, x), (self.increment, increment)):
            wp.copy(array, wp.array(value[:, None], dtype=vec3, ndim=2, device=array.device))
        self.motion = np.array(motion)[None]
        if self.liquid:
            self.liquid.last_pressure = np.array([float(pressure)])
        geom, anchor = self.outer.anchor_geom.numpy().copy(), self.outer.anchor.numpy().copy()
        geom[:] = -1
        sample = contacts[:, 0].astype(int)
        geom[sample, 0], anchor[sample, 0] = contacts[:, 1].astype(np.int32), contacts[:, 2:]
        wp.copy(self.outer.anchor_geom, wp.array(geom, dtype=int, ndim=2, device=self.x.device))
        wp.copy(self.outer.anchor, wp.array(anchor, dtype=vec3, ndim=2, device=self.x.device))
        if self.resident:
            touched = np.zeros((self._counts[0], 1), np.int32)
            touched[contacts[:, 1].astype(int)] = 1
            self.geom_memory(*self._counts)[1].assign(touched)
            self.outer.kept.assign(
                (geom.reshape(len(self.outer.kept), -1).max(1) >= 0).astype(np.int32)[:, None]
            )

    def load_motion(self, velocity, core_pos, core_mat):
        """Sets what implicit dynamics remembers of a single world: nodal velocities (nvert, 3) [m/s] and the
        core's pose."""
        wp.copy(self.velocity, wp.array(velocity[:, None], dtype=vec3, ndim=2, device=self.x.device))
        self.core_pos, self.core_mat = np.array(core_pos)[None], np.array(core_mat)[None]
        if self.resident:
            self.frame_pos_last.assign(self.core_pos)
            self.frame_mat_last.assign(self.core_mat)

    def contacts(self) -> np.ndarray:
        """What touches in the first world: (n, 5) sample, geom and anchor (in the geom's frame) [m]."""
        geom = self.outer.anchor_geom.numpy()[:, 0]
        sample = np.flatnonzero(geom >= 0)
        return np.column_stack([sample, geom[sample], self.outer.anchor.numpy()[sample, 0]])

    def touching_geoms(self, ngeom: int):
        """Which geoms touched the outer surface when the last step ended: (nworld, ngeom) bool."""
        geom = view(self.outer.anchor_geom)
        return np.array([_host((geom == g).any(0)) for g in range(ngeom)], bool).reshape(ngeom, self.nworld).T

    def tangent(self, geoms) -> np.ndarray:
        """Stiffness (nworld, ngroup, 6, 6) against rigid motions of each group of geoms about the BioTac
        frame's origin, after a step."""
        face = self.outer.surface.face_np
        geom = self.outer.trial_geom.numpy().reshape(len(face), -1, self.nworld)
        x = self.x.numpy()
        out = np.zeros((self.nworld, geoms.ngroup, 6, 6))
        solved = self._preconditioner_of_state() if self.resident else self.preconditioner
        for w in range(self.nworld):
            active, blocks = self.outer.active(w)
            group = geoms.groups[geom[active, :, w].max(1)]
            for g in np.unique(group):
                mine = group == g
                out[w, g] = solved.tangent(w, (face[active[mine]], blocks[mine]), x[:, w])
        return out

    def _preconditioner_of_state(self):
        """Made anew: the device step keeps its own, of the last evaluation but one."""
        from .preconditioner import Preconditioner

        m = self.model
        mask = view(m.free_mask)[:, None, None]
        if m.device.is_cuda:
            from .batch_preconditioner import BatchPreconditioner as Preconditioner  # torch is for CUDA only
        made = Preconditioner(m, self.stiffness_scale)
        states = [self.outer] + ([self.core] if self.core else [])
        kappa = self.liquid.stiffness if m.has_liquid else np.zeros(self.nworld)
        made.update(
            states, view(self.force) * mask, view(self.gradient) * mask if m.has_liquid else None, kappa
        )
        return made

    def stress(self):
        """Cauchy stress (nworld, nelem, 3, 3) and von Mises stress (nworld, nelem) of the tetrahedra [Pa]."""
        cauchy, mises = self.model.elasticity.stress(self.mu, self.lam, self.x)
        if self.memory:
            self.memory.add_cauchy(self.x, cauchy, mises)
        return _leading(cauchy), _leading(mises)


def _host(array):
    return array if isinstance(array, np.ndarray) else array.cpu().numpy()


def _leading(array: wp.array) -> np.ndarray:
    return np.swapaxes(
        array.numpy(), 0, 1
    ).copy()  # never a view: the next step would change what the caller keeps
