"""One step of the condensed skin: candidates, Newton's method on the contact law, results."""

import dataclasses
import math
from typing import Any

import numpy as np

from ...geometry.rigid import cross
from ..rigid import rigid_motions
from .linear import Compliance, Lumped, Springs, cost, exact_fits, solve

__all__ = ["MAX_CONTACTS", "MAX_FORCES", "Effort", "Memory", "Outcome", "Step"]

MAX_FORCES, MAX_CONTACTS = 1024, 2048  # that a memory may have
_REACH = 2e-5  # faces nearer than this, plus what the geoms move in the step, are candidates [m]
_TOLERANCE = 1e-4  # of the residual in the energy norm: the error of single steps is heard as chatter
_MAX_NEWTON, _PASSES = 60, 4
_PASSING = 1e-2  # of the residual where geoms only pass, on the way of a hard step, in one pass
_ITERATION = 1.5e5  # of a Newton iteration's cost, what does not grow with the number of coordinates squared
_NEAR = 0.03  # error below which parts of a hard step take contact's exact stiffness
_SLOW = 8  # from this iteration on contact's exact stiffness is taken, and the skin creeps if it must
_LAG = 1.0  # of a skin that begins to creep: it resists like rubber that is stiffer by so much
_QUICKER, _SLOWER = 3.0, 4.0  # by which that shrinks where a whole step is good, and grows where none is
_AT_ONCE, _FIXED = 0.01, 1e5  # lag that is none, and with which skin is stiffer than contact
# of the residual where the force jumps, as at the edges of a mesh, so that a step goes no further than this
_ROUGH, _JUMP = 1e-3, 0.01
_PREPARE = 10  # iterations that candidates cost before the first one
_SETTLED = 3e-3  # relative change of pressure and softening between two passes that ends the step
_ROOT3 = math.sqrt(3)


def _largest(u):
    """Of the sizes of entries: without an array of them."""
    return max(float(u.max()), -float(u.min()))


@dataclasses.dataclass
class Memory:
    """What the skin remembers between steps.

    Attributes:
      started: whether a step was made.
      coordinate: (n,) contact coordinates with a force, ascending.
      force, change: (n,) forces and by how much they changed in the last step [N].
      pressure: of the liquid above that at rest [Pa]. bulge: the nonlinear part q of the cavity's volume
        [m^3], growth: by how much it grew in the last step.
      softening, swelling: s and c. after: (2,) what they are where the step left the skin, drift: (2,) by how
        much that grew in it.
      geom_pos, geom_mat, motion: (ngeom, 3) [m], (ngeom, 3, 3) at the end of the last step, (ngeom, 3) how
        far they moved in it [m].
      contacts: (k, 5) sample, geom and anchor (in the geom's frame) [m] of what touches.
    """

    started: bool
    coordinate: np.ndarray
    force: np.ndarray
    change: np.ndarray
    pressure: float
    bulge: float
    growth: float
    softening: float
    swelling: float
    after: np.ndarray
    drift: np.ndarray
    geom_pos: np.ndarray
    geom_mat: np.ndarray
    motion: np.ndarray
    contacts: np.ndarray

    @classmethod
    def rest(cls, ngeom: int) -> "Memory":
        none = np.zeros(0)
        pos, mat = np.zeros((ngeom, 3)), np.zeros((ngeom, 3, 3))
        return cls(
            False,
            none.astype(int),
            none,
            none,
            0.0,
            0.0,
            0.0,
            1.0,
            1.0,
            np.ones(2),
            np.zeros(2),
            pos,
            mat,
            pos,
            np.zeros((0, 5)),
        )


@dataclasses.dataclass
class Outcome:
    """A solved step: what to remember, wrench (ngroup, 6) of the skin on the geoms, their tangent (ngroup, 6,
    6), nodes (nvert, 3), volume of the liquid, whether the error of such a step has been measured; the size
    of the force (k,) on each of the memory's contacts; and the share of the geoms' motion at which this
    holds, 1 where the step converged; its cost, as a share of what a hard step may cost."""

    memory: Memory
    wrench: np.ndarray
    tangent: np.ndarray
    vert_xpos: np.ndarray
    volume: float
    measured: bool
    converged: bool
    iterations: int
    error: float
    load: np.ndarray
    reached: float = 1.0
    cost: float = 0.0

    def sound(self) -> bool:
        """Whether it is finite and a `Memory` of so much contact may be kept."""
        memory = self.memory
        few = len(memory.force) <= MAX_FORCES and len(memory.contacts) <= MAX_CONTACTS
        return few and math.isfinite(self.wrench.sum() + self.tangent.sum() + memory.force.sum())


class Effort:
    """What a step may cost, counted so that it is the same on every machine.

    Args:
      most: of the whole step; a Newton iteration over n candidate coordinates costs `_ITERATION` + n^2 and
        the linear solve, of whose products each costs n^2 / 10; another length along a step, `_ITERATION`.
    """

    def __init__(self, most: float):
        self.left, self._until, self.spent = most, 0.0, 0.0

    def renew(self, left: float) -> None:
        """Lets a second way cost so much more."""
        self.left, self._until = left, 0.0

    def allow(self, share: float) -> None:
        """Lets what comes next take a share of what is left."""
        self._until = (1 - share) * self.left

    def spend(self, n: int, linear: float = 0.0, times: int = 1) -> bool:
        """Counts iterations over n coordinates with what their linear solves cost; whether there is something
        left."""
        cost = times * (_ITERATION + n * n + linear)
        self._count(cost)
        return self.left > self._until

    def multiply(self, n: int, products: int) -> None:
        """Counts products over n coordinates."""
        self._count(0.1 * products * n * n)

    def look_again(self) -> None:
        """Counts another evaluation."""
        self._count(_ITERATION)

    def _count(self, cost):
        self.left -= cost
        self.spent += cost


class Step:
    """One step of a CondensedSkin: candidates, Newton's method, results."""

    def __init__(
        self,
        skin: Any,
        memory: Memory,
        u: np.ndarray,
        geom_pos: np.ndarray,
        geom_mat: np.ndarray,
        motion: np.ndarray,
        effort: Effort,
        moved: float | None = None,
        near: Memory | None = None,
        passing: bool = False,
    ):
        self.tolerance, self.passes = (_PASSING, 1) if passing else (_TOLERANCE, _PASSES)
        self.skin, self.memory, self.u, self.effort = skin, memory, u, effort
        self.pose = geom_pos, geom_mat
        self.coupled = moved is not None
        moved = moved if self.coupled else 2 * np.abs(motion).max(initial=0.0)
        self.reach = _REACH + moved
        self.share = min(1.0, 1.5 * moved / max(_largest(u), 1e-9))
        self.faces = np.zeros(0, int)
        self.inner = np.zeros(0, int)
        self.meeting = self._looked = self._room = None
        # how much of the geoms' last motion this one repeats: so much of the last changes is expected again
        last = memory.motion.ravel()
        self.motion, self.repeat = (
            motion,
            min(max(float(motion.ravel() @ last) / max(float(last @ last), 1e-20), 0.0), 2.0),
        )
        self.bulge, self.pressure = memory.bulge + self.repeat * memory.growth, memory.pressure
        self.coordinate, self.force = memory.coordinate, memory.force
        self.iterations, self.error, self.converged = 0, 0.0, True
        self.softening, self.swelling = (memory.after + self.repeat * memory.drift).tolist()
        if near is not None:
            self.coordinate, self.force, self.bulge = near.coordinate, near.force, near.bulge
            self.pressure, (self.softening, self.swelling) = near.pressure, near.after.tolist()
        self.after, self.squeezed, self.spread = np.ones(2), 0.0, 0.0
        self._choose()

    def _choose(self):
        """Candidates: faces that are near a geom or the core; whether there are more than before."""
        s, near = self.skin, self.faces
        count = len(self.faces) + len(self.inner)
        if not self._all_known():
            near = s.search.faces(self.reach, _ROOT3 * _largest(self.u), *self.pose)
            self._looked, self._room = self.u, self.reach
        if len(self.faces) and near is not self.faces:
            chosen = np.zeros(len(s._face), bool)
            chosen[self.faces] = chosen[near] = True
            near = np.flatnonzero(chosen)
        self.faces = near
        if s._core:
            self.meeting = s._core.meet(self.u, self.share, self.meeting)
            self.inner = self.meeting.node
        return len(self.faces) + len(self.inner) > count

    def _all_known(self):
        """Whether the skin has moved so little since its faces were searched that what touches is known."""
        # a distance may change a little faster than its place: grids are trilinear
        return self._room is not None and 2 * _ROOT3 * _largest(self.u - self._looked) < self._room

    def missed(self) -> bool:
        """Whether something touches that was no candidate; it is one now."""
        self.reach = self.share = 0.0
        return self._choose()

    def _nodes(self):
        """Numbers of the candidate faces' nodes, ascending."""
        used = np.zeros(len(self.skin._number), bool)
        used[self.skin._face[self.faces]] = True
        return used.nonzero()[0]

    def _set(self):
        """Hands the candidate faces and their anchors to the kernels."""
        s = self.skin
        corner, nodes = s._face[self.faces], self._nodes()
        self.outer = nodes[s._number[nodes] >= 0]
        self.m = 3 * len(self.outer)
        s.slot[nodes] = -1
        s.slot[self.outer] = np.arange(len(self.outer))
        s.faces.choose(self.faces, corner, s._area[self.faces], len(self.outer), self.memory.contacts)
        self.c, self.rest_W = s._system(self.outer, self.inner)
        self.a = s._give_at[self.c] if s.model.has_liquid else None

    def _scaled(self):
        """Softened compliance with the liquid, and the displacement that q alone makes: u = W f + shift; p =
        -share (a.f + q)."""
        s = self.skin
        scale = self.softening / s.model.material.youngs_modulus
        if self.a is None:
            return Compliance(self.rest_W, scale), 0.0
        swell = self.swelling / s.model.material.youngs_modulus
        self.share = 1 / (s.model.rest.natural_volume / s.model.options.bulk_modulus + swell * s._liquid_give)
        self.along = scale * self.a
        return Compliance(
            self.rest_W, scale, self.share * swell / scale, self.along
        ), -self.share * self.bulge * swell * self.a

    def _evaluate(self, u):
        """Contact forces (n,) at displacements u (n,) of the contact coordinates."""
        s, m = self.skin, self.m
        f = np.zeros(len(u))
        self.closed = None
        if m:
            s._x[self.outer, 0] = s.rest[self.outer] + u[:m].reshape(-1, 3)
            s.faces.evaluate()
            f[:m] = s.faces.force.ravel()
        if len(self.inner):
            f[m:], self.closed = self.meeting.force(u[m:])
        return f

    def _springs(self):
        """Stiffness of what touches at the last evaluation."""
        return Springs(self.skin.faces, self.closed, len(self.inner))

    def _correct(self):
        """s and c (2,) of the skin as it is."""
        s = self.skin
        outer = self.coordinate < 3 * len(s._outer)
        depth, spread, squeezed = s.strain(self.coordinate[outer] // 3, self.force[outer])
        self.squeezed, self.spread = squeezed, spread
        softening = s.correction.softening(depth, spread, squeezed)
        return np.array([softening, s.correction.swelling(self.pressure, s.model.material.youngs_modulus)])

    def run(self) -> None:
        """Newton's method, repeated until the cavity's exact volume agrees."""
        s = self.skin
        if not len(self.faces) and not len(self.force):
            self.outer = self.faces
            self.pressure = self.bulge = 0.0
            s._measure_volume()
            return
        self.converged = False
        if not self.effort.spend(3 * len(self._nodes()) + len(self.inner), times=_PREPARE):
            return
        self._set()
        f = self._at_candidates(self.force)
        if self.force is self.memory.force:
            f += self.repeat * self._at_candidates(self.memory.change)
        for number in range(self.passes):
            f = self.last = self._newton(f)
            if not self.converged:
                break
            if not f.any():  # nothing touches any more
                self.bulge = 0.0
            order = np.argsort(self.c)
            order = order[f[order] != 0]
            self.coordinate, self.force = self.c[order], f[order]
            self.pressure = -self.share * float(self.along @ f + self.bulge) if self.a is not None else 0.0
            self._place(s._recover(self.coordinate, self.force, self.pressure, self.softening, self.swelling))
            s._measure_volume()
            self.after = self._correct()
            settled = bool((np.abs(self.after - (self.softening, self.swelling)) < _SETTLED).all())
            if self.a is not None:
                bulge = float(s._share.sum()) - s._cavity - float(np.vdot(s._gradient, self.u))
                settled &= self.share * abs(bulge - self.bulge) < _SETTLED * abs(self.pressure) + 1.0
                self.bulge = bulge
            if settled or number == self.passes - 1:
                break
            f *= self.softening / self.after[0]
            self.softening, self.swelling = self.after.tolist()

    def hold(self) -> None:
        """Instead of `run`: the balance that the memory holds, to the last digits, which contact's stiffness
        needs."""
        memory = self.memory
        self.softening, self.swelling = memory.softening, memory.swelling
        if self.skin._core:
            first = 3 * len(self.skin._outer)
            loaded = memory.coordinate[memory.coordinate >= first] - first
            self.meeting = self.skin._core.meet(self.u, 0.0, None, loaded)
            self.inner = self.meeting.node
        self._set()
        f = self.last = self._at_candidates(self.force)
        self._scaled()
        if self.a is not None:  # what it was when the pressure was found
            self.bulge = -memory.pressure / self.share - float(self.along @ f)
        self.W, shift = self._scaled()
        self._evaluate(self.W @ f + shift)
        self.lumped, self.converged = None, False
        self._place(self.u)
        self.skin._measure_volume()
        self.after = self._correct()

    def _at_candidates(self, force):
        """Values (n,) of self.coordinate at the candidates; zero elsewhere."""
        out = np.zeros(len(self.c))
        if len(self.coordinate):
            place = np.minimum(np.searchsorted(self.coordinate, self.c), len(self.coordinate) - 1)
            known = self.coordinate[place] == self.c
            out[known] = force[place[known]]
        return out

    def _place(self, u):
        s = self.skin
        self.u = u
        s._x[:, 0] = s.rest + u

    def _newton(self, f):
        """Balanced forces, from forces f.

        Where friction, or a skin that snaps, leads Newton's method round in circles, the skin creeps: each
        iteration is a step of time of rubber with viscosity, which resists its motion as rubber stiffer by
        the lag would. It slides and snaps to where real skin comes to rest; near there the steps grow and
        are Newton's again, so what is found is a balance without viscosity."""
        self.W, shift = self._scaled()
        u = self.W @ f + shift
        g = self._evaluate(u)
        self.converged, self.lumped, self.error, lag, alpha = False, None, math.inf, 0.0, 1.0
        for number in range(_MAX_NEWTON):
            springs = self._springs()
            slow = number >= _SLOW
            exact = (slow or self.coupled and self.error <= _NEAR) and exact_fits(springs)
            coupled = self.coupled or exact
            if exact:
                self.skin.faces.differ()
            elif coupled:
                self.skin.faces.couple()
            if not self.effort.spend(len(f), cost(len(springs.on), coupled)):
                break
            r, last = g - f, self.error
            if lag:
                df, du, _, products = solve(self.W.stiffer(1 / (1 + lag)), springs, r, None, coupled)
                df, self.lumped = df / (1 + lag), None
            else:
                df, du, self.lumped, products = solve(self.W, springs, r, self.lumped, coupled)
            self.effort.multiply(len(f), products)
            slope, work = float(r @ du), float(df @ du)
            left = max(abs(slope), work) if coupled else max(slope, 0.0)
            self.error = (1 + lag) * math.sqrt(left / (abs(float((f + df) @ (u + du))) + 1e-14))
            rough = max(self.tolerance, _ROUGH) if alpha < _JUMP else self.tolerance
            if self.error < rough and not lag:
                self.converged = True
                self._evaluate(u + du)  # the contacts of the balanced skin
                return f + df
            self.iterations += 1
            if lag and slope <= 0:
                lag, g = _SLOWER * lag, self._evaluate(u)
                continue
            f, u, g, alpha, found = self._search(f, u, df, du, slope, lag * work)
            if slow and not (found and alpha == 1.0 and (lag or self.error < last)):
                lag = max(_SLOWER * lag, _LAG)
                if lag > _FIXED:
                    break
            else:
                lag = lag / _QUICKER if lag > _AT_ONCE and self.error > _TOLERANCE else 0.0
        return f

    def _search(self, f, u, df, du, slope, held):
        """Along the step to where the residual's work, but for what viscosity holds at its end, is at most
        half of what it was (Illinois' regula falsi where the step overshoots); its length, and whether it is
        found."""
        along = math.copysign(1.0, slope) * du
        low, high, at_low, at_high = 0.0, None, abs(slope), None
        alpha = 1.0
        for length in range(10):
            if length:
                self.effort.look_again()
            new_f, new_u = f + alpha * df, u + alpha * du
            g = self._evaluate(new_u)
            now = float((g - new_f) @ along) - alpha * held
            if abs(now) <= 0.5 * abs(slope):
                return new_f, new_u, g, alpha, True
            if now > 0:
                if high is None:
                    break
                low, at_low, at_high = alpha, now, at_high / 2
            else:
                high, at_high, at_low = alpha, now, at_low if high is None else at_low / 2
            alpha = low + (high - low) * at_low / (at_low - at_high)
            alpha = min(max(alpha, low + 0.05 * (high - low)), high - 0.05 * (high - low))
        return new_f, new_u, g, alpha, False

    # --- results  ---

    def outcome(self) -> Outcome:
        s = self.skin
        wrench, contacts, size = np.zeros((s.geoms.ngroup, 6)), np.zeros((0, 5)), np.zeros(0)
        tangent = np.zeros((s.geoms.ngroup, 6, 6))
        if len(self.outer):
            contacts = s.faces.contacts()
        if len(contacts):
            size = np.linalg.norm(s.faces.sample_forces(), axis=1)
            load, share = s.faces.loads()
            # what Newton's last step changed, to first order; the samples' forces are those of the stiff law
            # after it
            x, n = s._x[self.outer, 0], len(self.outer)
            rest = self.last[: 3 * n].reshape(n, 3) - s.faces.force
            wrench = -load - share @ np.concatenate([rest, cross(x, rest)], axis=1)
            self._tangents(tangent, share, x)
        pos, mat = self.pose
        now = (
            self.coordinate,
            self.force,
            self._change(),
            self.pressure,
            self.bulge,
            self.bulge - self.memory.bulge if len(self.force) else 0.0,
            self.softening,
            self.swelling,
            self.after,
            self.after - self.memory.after if len(self.memory.force) else np.zeros(2),
            np.array(pos),
            np.array(mat),
            self.motion,
            contacts,
        )
        memory = Memory(True, *now)
        volume = float(s._share.sum()) - s._cavity + s.model.rest.volume if s.model.inner is not None else 0.0
        measured = s.correction.measured(s.model.material.poissons_ratio, self.squeezed, self.spread)
        return Outcome(
            memory,
            wrench,
            tangent,
            s.rest + self.u,
            volume,
            measured,
            self.converged,
            self.iterations,
            self.error,
            size,
        )

    def _change(self):
        """Of the forces since the step began."""
        memory = self.memory
        if not len(self.force) or not len(memory.force):
            return 0 * self.force
        place = np.minimum(np.searchsorted(memory.coordinate, self.coordinate), len(memory.coordinate) - 1)
        return self.force - np.where(memory.coordinate[place] == self.coordinate, memory.force[place], 0)

    def _tangents(self, out, share, x):
        """Stiffness (ngroup, 6, 6) against rigid motions of each group of geoms about the origin, springs
        lumped at the nodes."""
        springs = self._springs()
        if not len(springs.outer):  # only held nodes are touched
            return
        rigid = rigid_motions(x, len(self.c))
        lumped = self.lumped if self.lumped and self.lumped.fits(springs) else Lumped(springs, self.W)
        for k in np.flatnonzero(share.any(axis=1)):  # what touches nothing has no stiffness
            mine = rigid
            if len(out) > 1:
                mine = rigid.copy()
                mine[: self.m] *= np.repeat(share[k], 3)[:, None]
            K = lumped.stiffness(mine)
            out[k] = (K + K.T) / 2
