"""One step of the skin: Newton's method on the balance of forces, each linear system by preconditioned
conjugate gradients."""

import contextlib

import numpy as np
import warp as wp
from threadpoolctl import ThreadpoolController

from . import clearance, contact, elasticity, lawful_contact
from .data import SkinData, view
from .geoms import GeomSet
from .model import SkinModel
from .preconditioner import Preconditioner
from .types import vec3

__all__ = ["step"]

# matrices of a few hundred rows: more threads of BLAS only wait for each other
_threads = ThreadpoolController()

_BALANCED = 1e-9  # [N] of residual on all nodes: rounding, where nothing touches
_PRESSURE_TOLERANCE = 0.01
_FACTOR = 25  # products of the tangent: about what a factor costs
_PRESSURE_NOISE = 1.0  # [Pa] a thirtieth of the sensor's resolution


def step(
    model: SkinModel, data: SkinData, geoms: GeomSet, dt: float | None = None, core_pos=None, core_mat=None
) -> None:
    """Advances every world to the balance of forces with the geoms where they are now.

    A world that does not converge within `options.max_newton` iterations keeps its last good state; it is
    counted in `data.nonconverged` and flagged in `data.converged`.

    Args:
      model, data: the skin.
      geoms: touching geoms, poses in the BioTac frame at the end of the step.
      dt: time step [s]; needed by implicit dynamics and by skin with a Prony series.
      core_pos, core_mat: (nworld, 3) [m], (nworld, 3, 3) pose of the BioTac frame in the world at the end of
        the step, for the inertia of implicit dynamics; None means that it does not move.

    Raises:
      ValueError: a geom deep inside the rigid core, geoms of another number of worlds, or implicit dynamics
        without a positive dt.
    """
    if geoms.nworld != data.nworld:
        raise ValueError(
            f"geoms are for {geoms.nworld} worlds and the data for {data.nworld}: make both for the same "
            "number"
        )
    if data.resident:
        _step_on_device(model, data, geoms, dt, core_pos, core_mat)
        return
    _refuse_core(model, geoms)
    if data.laws:
        data.laws.check(geoms)
    with _threads.limit(limits=1, user_api="blas"):
        _Step(model, data, geoms, dt, core_pos, core_mat).run()


def _step_on_device(model, data, geoms, dt, core_pos, core_mat):
    from .device_step import prepare_device
    from .device_worlds import INSIDE_CORE

    if model.options.dynamics == "implicit":
        if dt is None or not dt > 0:
            raise ValueError("implicit dynamics needs the time step: pass dt > 0")
        data.dt.fill_(dt)
        for array, last, value in (
            (data.frame_pos, data.frame_pos_last, core_pos),
            (data.frame_mat, data.frame_mat_last, core_mat),
        ):
            if value is None:
                wp.copy(array, last)
            else:
                array.assign(np.asarray(value, float))
    prepare_device(model, data, geoms).run()
    if model.has_core and geoms.count and (data.worlds.reason.numpy() == INSIDE_CORE).any():
        _refuse_core(model, geoms)


def _refuse_core(model, geoms):
    if not (model.has_core and geoms.count):
        return
    depth = wp.zeros((geoms.count, geoms.nworld), dtype=wp.float64, device=model.device)
    wp.launch(
        clearance.depth_in_core, depth.shape, [model.core_vert, geoms.struct], [depth], device=model.device
    )
    depth = depth.numpy()
    if depth.max() > model.options.max_core_depth:
        geom, world = np.unravel_index(depth.argmax(), depth.shape)
        raise ValueError(
            f"geom {geom} of world {world} ({geoms.types[geom]}) is {depth.max() * 1e3:.2f} mm inside the "
            "rigid core: "
            "no skin fits between them; move it out, press less deep or take smaller steps"
        )


class _Step:
    def __init__(self, model, data, geoms, dt, core_pos, core_mat):
        self.m, self.d, self.geoms = model, data, geoms
        self.x = view(data.x)
        self.start = self.x.copy()
        self.force = view(data.force)
        self.mask = view(model.free_mask)[:, None, None]
        self.gradient = view(data.gradient)
        self.kappa = data.liquid.stiffness if model.has_liquid else np.zeros(data.nworld)
        if data.liquid:
            data.liquid.begin()
        if not hasattr(data, "preconditioner"):
            data.preconditioner = Preconditioner(model, data.stiffness_scale)
        self.M = data.preconditioner
        if data.memory:
            data.memory.begin(dt)
            self.M.scale = data.stiffness_scale * data.memory.stiffness
        self.products = 0
        self.inertia = None
        if model.options.dynamics == "implicit":
            self._prepare_inertia(dt, core_pos, core_mat)

    def _prepare_inertia(self, dt, core_pos, core_mat):
        if dt is None or not dt > 0:
            raise ValueError("implicit dynamics needs the time step: pass dt > 0")
        d = self.d
        pos = d.core_pos if core_pos is None else np.asarray(core_pos, float)
        mat = d.core_mat if core_mat is None else np.asarray(core_mat, float)
        was, velocity = (
            d.x.numpy(),
            d.velocity.numpy(),
        )  # where free flight would take the nodes, seen from the moved frame
        world = np.einsum("wij,nwj->nwi", d.core_mat, was) + d.core_pos
        target = np.einsum("wji,nwj->nwi", mat, world + dt * velocity - pos)
        coefficient = self.m.material.density * self.m.elasticity.node_volume[:, None, None] / dt**2
        self.pose, self.world, self.dt = (pos, mat), world, dt
        self.target, self.inertia = target, coefficient

    def _motion(self):
        """How far each geom moves in this step: (nworld, ngeom, 3)."""
        struct = self.geoms.struct
        return np.swapaxes(struct.pos.numpy() - struct.pos_last.numpy(), 0, 1)

    def _predict(self):
        """Starts from the last step's increment, scaled by how much of the touching geoms' last motion this
        one repeats."""
        d = self.d
        if d.motion.shape[1] != self.geoms.count:
            return
        touching = d.touching_geoms(self.geoms.count)[..., None]
        now, last = self._motion() * touching, d.motion * touching
        square = (last * last).sum((1, 2))
        repeat = np.clip((now * last).sum((1, 2)) / np.where(square > 0, square, 1), 0, 2)
        self.x += repeat[:, None] * view(d.increment)

    def run(self):
        self.d.iterations[:] = 0
        self._predict()
        try:
            good = self._newton(np.ones(self.d.nworld, bool))
            if not good.all():  # the guess may have been the trouble
                self._back(~good)
                self._renew_factor(self.start)
                good |= self._newton(~good)
        finally:
            self.M.restore()
        self._finish(good)

    def _back(self, worlds):
        for w in np.flatnonzero(worlds):
            self.x[:, w] = self.start[:, w]

    def _renew_factor(self, x):
        """Nearly incompressible rubber, turned and strained, is no longer like that at rest: solved with the
        factor of its present shape.

        For this step alone, so that a step remains a function of the state it starts from. Worlds share a
        factor: not where there are many."""
        self.products = -np.inf  # once is enough until the next start
        if self.m.material.poissons_ratio > 0.45 and self.d.nworld == 1:
            with contextlib.suppress(ValueError):  # a tetrahedron is inverted: no factor there
                self.M.replace(self.m.factor_at(x[:, 0]))

    def _newton(self, active):
        """Newton's method in the active worlds; which of them are now in balance."""
        d, options = self.d, self.m.options
        asked = active
        self._evaluate()
        for iteration in range(options.max_newton + 1):
            residual = self.force * self.mask
            finite = np.isfinite(residual.sum((0, 2)))
            states = self._contacts()
            touched = np.logical_or.reduce([view(s.touching).any(0) for s in states])
            at_rest = ~touched & ((residual * residual).sum((0, 2)) < _BALANCED**2)
            if at_rest.all():
                self.M.clear()
                d.error = np.zeros(d.nworld)
                return asked & self._possible()
            z = self.M.update(
                states, residual, self.gradient * self.mask if self.m.has_liquid else None, self.kappa
            )
            error = (residual * z).sum((0, 2))
            load = (
                view(d.outer.node_force)
                + (view(d.core.node_force) if d.core else 0)
                + (0 if d.external is None else d.external)
            )
            work = np.abs((load * (self.x - view(d.rest_vert))).sum((0, 2))) + 1e-12
            d.error = np.sqrt(np.maximum(error, 0) / work)
            active = (
                asked
                & finite
                & ~at_rest
                & ~((error <= options.tolerance**2 * work) & self._pressure_settled(z))
            )
            if not active.any() or iteration == options.max_newton:
                break
            d.iterations += active
            self._line_search(self._conjugate_gradients(residual, z, active), residual, active)
            if self.products > _FACTOR:
                self._renew_factor(self.x)
        return asked & finite & ~active & self._possible()

    def _possible(self):
        """Worlds (nworld,) whose skin a body can have: balance of an inverted element, or of skin that went
        through the core, is none."""
        m, d = self.m, self.d
        good = np.ones(d.nworld, bool)
        if m.material.law != "linear":  # small strain: its determinant means nothing
            good &= m.elasticity.smallest_jacobian(d.elastic) > 0
        if m.has_core:
            depth = wp.zeros((len(d.core.surface.face), d.nworld), dtype=wp.float64, device=m.device)
            wp.launch(
                clearance.deepest_corner,
                depth.shape,
                [d.core.surface.face, m.core(d.nworld).struct, d.x],
                [depth],
                device=m.device,
            )
            good &= depth.numpy().max(0) < m.crushed_depth
        return good

    def _pressure_settled(self, z):
        """Whether the step z would hardly change the liquid's pressure. Its energy cannot tell: the liquid is
        almost incompressible."""
        if not self.m.has_liquid:
            return True
        change = self.kappa * np.abs((self.gradient * self.mask * z).sum((0, 2)))
        return change <= _PRESSURE_TOLERANCE * np.abs(self.d.liquid.gauge_pressure) + _PRESSURE_NOISE

    def _line_search(self, dx, residual, active):
        """Moves along dx to where the residual has (nearly) no component along it, by regula falsi where the
        full step overshoots.

        Along a descent direction of an energy that is its minimum; friction has no energy, its work along dx
        still has to balance."""
        base, slope = self.x.copy(), (residual * dx).sum((0, 2))
        low, high = np.zeros_like(slope), np.full_like(slope, np.nan)
        slope_low, slope_high = slope.copy(), slope.copy()
        alpha, soft = np.where(active, 1.0, 0.0), self.d.laws and self.d.laws.pulls
        side = np.zeros(len(slope), int)
        for _ in range(12):
            self.x[...] = base + alpha[:, None] * dx
            self._evaluate()
            now = (self.force * dx).sum((0, 2))
            valid = np.isfinite(now)
            if self.m.material.law == "neo_hookean":
                valid &= self.m.elasticity.smallest_jacobian(self.d.elastic) > 0.02
            enough = ~active | (valid & (now >= -0.5 * slope))
            enough &= ~active | (now <= 0.2 * slope if soft else np.isnan(high) | (now <= 0.5 * slope))
            if enough.all():
                break
            over = ~enough & (~valid | (now < 0))
            under = ~enough & ~over
            # Illinois: an end that stays twice loses half of its slope
            slope_low = np.where(over & (side == 1), slope_low / 2, slope_low)
            slope_high = np.where(under & (side == -1), slope_high / 2, slope_high)
            side = np.where(over, 1, np.where(under, -1, side))
            low, slope_low = np.where(under, alpha, low), np.where(under, now, slope_low)
            high, slope_high = (
                np.where(over, alpha, high),
                np.where(over, np.where(valid, now, -np.inf), slope_high),
            )
            with np.errstate(invalid="ignore", divide="ignore"):
                secant = low + (high - low) * slope_low / (slope_low - slope_high)
                further = alpha * np.clip(slope / np.maximum(slope - now, slope / 4), 1.25, 4)
            secant = np.where(np.isfinite(slope_high), secant, (low + high) / 2)
            secant = np.clip(secant, low + 0.05 * (high - low), high - 0.05 * (high - low))
            if soft:  # a pull that falls as the gap opens is in no tangent: the way goes on
                secant = np.where(np.isnan(high), further, secant)
            alpha = np.where(enough, alpha, secant)

    def _evaluate(self):
        """Forces at x: elastic, external, contact, core, liquid, inertia."""
        m, d = self.m, self.d
        n, w = m.nvert, d.nworld
        launch = d.launch
        m.elasticity.force(d.elastic, d.mu, d.lam, d.x, d.force)
        if d.memory:
            d.memory.add_force(d.x, d.force)
        if d.external is not None:
            self.force += d.external
        self._contact(d.outer, self.geoms)
        if m.has_core:
            self._contact(d.core, m.core(w))
        if d.liquid:
            d.liquid.evaluate(d.x, d.core)
        if m.has_liquid:
            launch(
                elasticity.gather,
                (n, w),
                [m.inner.start, m.inner.slot, d.liquid.gradient(d.x), 1.0, 0],
                [d.gradient],
            )
            self.force += d.liquid.gauge_pressure[:, None] * self.gradient
        if self.inertia is not None:
            self.force -= self.inertia * (
                self.x - self.target
            ) + m.options.mass_damping * self.dt * self.inertia * (self.x - self.start)
            if m.options.stiffness_damping:
                self.force -= (
                    m.options.stiffness_damping / self.dt * self._elastic_product(self.x - self.start)
                )

    def _contact(self, state, geoms):
        m, d = self.m, self.d
        surface, launch, kernel, known, out = state.surface, d.launch, contact.contact_force, [], []
        if state is d.core:
            kernel, known = contact.core_contact_force, [state.seen, state.clearance]
        elif d.laws:
            known, out = d.laws.inputs(launch, state, m.sample, m.contact_stiffness, geoms, d.x), [state.bond]
            kernel = lawful_contact.lawful_contact_force
        launch(
            kernel,
            state.touching.shape,
            [
                surface.face,
                surface.area,
                m.sample,
                m.contact_stiffness,
                m.options.stick_ratio,
                geoms.struct,
                d.x,
                d.x_last,
            ]
            + [state.anchor_geom, state.anchor, *known],
            [
                state.corner,
                state.block,
                state.touching,
                state.trial_geom,
                state.trial_anchor,
                state.sample_force,
                *out,
            ],
        )
        launch(
            elasticity.gather,
            (m.nvert, d.nworld),
            [surface.start, surface.slot, state.corner, 1.0, 0],
            [state.node_force],
        )
        self.force += view(state.node_force)

    def _contacts(self):
        return [self.d.outer] + ([self.d.core] if self.m.has_core else [])

    def _elastic_product(self, p):
        m, d = self.m, self.d
        view(d.direction)[...] = p
        m.elasticity.product(d.elastic, d.mu, d.lam, d.x, d.direction, d.product)
        if d.memory:
            d.memory.add_product(d.direction, d.product)
        return view(d.product)

    def _product(self, p):
        """Tangent of all forces times p."""
        m, d = self.m, self.d
        q = self._elastic_product(p)
        if self.inertia is not None:
            q *= 1 + m.options.stiffness_damping / self.dt
            q += (1 + m.options.mass_damping * self.dt) * self.inertia * p
        launch = d.launch
        for s in self._contacts():
            launch(
                contact.contact_product,
                s.touching.shape,
                [s.surface.face, s.touching, s.block, d.direction],
                [s.corner],
            )
            launch(
                elasticity.gather,
                (m.nvert, d.nworld),
                [s.surface.start, s.surface.slot, s.corner, 1.0, 1],
                [d.product],
            )
        if m.has_liquid:
            q += (self.kappa * (self.gradient * p).sum((0, 2)))[:, None] * self.gradient
            bend = d.liquid.gradient_derivative(d.x, d.direction)
            launch(
                elasticity.gather,
                (m.nvert, d.nworld),
                [m.inner.start, m.inner.slot, bend, 1.0, 0],
                [d.bending],
            )
            q -= d.liquid.gauge_pressure[:, None] * view(d.bending)
        return q * self.mask

    def _conjugate_gradients(self, residual, z, active):
        """Solves tangent dx = residual until the preconditioned residual has fallen by ten; worlds that are
        not active get zero."""
        r, p = residual, z.copy()
        dx = 0 * z
        rz = (r * z).sum((0, 2))
        first = rz
        running = active.astype(float)
        for _ in range(self.m.options.max_cg):
            q = self._product(p)
            self.products += 1
            curvature = (p * q).sum((0, 2))
            # negative curvature: the tangent is not positive definite there; what has been found so far is a
            # descent direction
            running = running * (curvature > 0)
            if not running.any():
                break
            alpha = running * rz / (curvature + (running == 0))
            dx += alpha[:, None] * p
            # a first step of length one says that the preconditioner is as good as the tangent
            running = running * (abs(alpha - 1) > 0.2)
            if not running.any():
                break
            r = r - alpha[:, None] * q
            z = self.M.apply(r)
            rz_next = (r * z).sum((0, 2))
            running = running * (rz_next > 1e-2 * first)
            if not running.any():
                break
            p = z + (rz_next / (rz + (rz == 0)))[:, None] * p
            rz = rz_next
        untouched = (dx * dx).sum((0, 2)) == 0
        if (untouched & active).any():  # negative curvature at once: the preconditioner's step
            chosen = (untouched & active).astype(float)
            dx += chosen[:, None] * p
        return dx

    def _hold(self, failed):
        """Puts worlds that did not converge back to where the step began, geoms too, so that forces and
        contacts are the last good ones.

        Returns what has to be written back when the step is over: the poses as they were set.
        """
        if not len(failed):
            return []
        struct, poses = self.geoms.struct, []
        for array, last in ((struct.pos, struct.pos_last), (struct.mat, struct.mat_last)):
            poses.append((array, view(array).copy()))
            for w in failed:
                view(array)[:, w] = view(last)[:, w]
        for w in failed:
            self.x[:, w] = self.start[:, w]
        self._evaluate()
        return poses

    def _finish(self, good):
        d = self.d
        d.converged = good
        d.nonconverged += ~good
        poses = self._hold(np.flatnonzero(~good))
        groups = self.geoms.ngroup
        wrench = wp.zeros((groups, d.nworld, 6), dtype=wp.float64, device=self.m.device)
        if groups:
            o = d.outer
            inputs = [
                o.surface.face,
                self.m.sample,
                self.geoms.struct,
                d.x,
                o.touching,
                o.trial_geom,
                o.sample_force,
            ]
            wp.launch(contact.contact_wrench, (groups, d.nworld), inputs, [wrench], device=self.m.device)
        d.wrench = np.swapaxes(wrench.numpy(), 0, 1).copy()
        d.outer.commit()
        if d.liquid:
            d.liquid.commit(good)
        if d.memory:
            d.memory.commit(d.x, good)
        d.motion = self._motion()
        view(d.increment)[...] = self.x - self.start
        self.geoms.advance()
        for array, now in poses:
            view(array)[...] = now
        wp.copy(d.x_last, d.x)
        if self.inertia is not None:
            pos, mat = self.pose
            world = np.einsum("wij,nwj->nwi", mat, d.x.numpy()) + pos
            wp.copy(
                d.velocity, wp.array((world - self.world) / self.dt, dtype=vec3, ndim=2, device=self.m.device)
            )
            d.core_pos, d.core_mat = pos.copy(), mat.copy()
