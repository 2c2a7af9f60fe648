"""Fits a state of the skin to each row of a recording, and constants of the sensor to all rows."""

import dataclasses
import typing

import numpy as np

from ..sensor.channels import FULL_SCALE, counts_from_log_impedance, log_impedance
from .response import Loaded, Response

# Fx, Fy, Fz of a recording as along, across, pressing
SIGNS = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_LOADED, _FEWEST = 0.5, 40  # [N] least force of a loaded row; least number of these
_COUNTS = 20.0  # [counts] error of an electrode that weighs as much as one sigma of a force or a prior
_CORRELATED = 25  # rows per independent one, relative to the priors: model errors hardly change between rows
_STEPS, _LEAST = 40, 16  # most and fewest joint steps
_NESTED = 8  # fewest steps if the search starts from a nested model
_AGAIN = (6, 14)  # steps before which all states are searched globally, as some are in a local minimum
_WIDE = 3.0  # standard deviation of a logarithm without a prior, in `tangent`
_STARTS = 3  # starting directions from the table for each row's state


@dataclasses.dataclass(frozen=True)
class Setup:
    """Free quantities of a fit, and their priors.

    Attributes:
      gains: sigma of the electrodes' factors on their change of ln Z about 1; 0: they are 1.
      offsets: sigma of ln Z at rest about the mean of the published sensors, with a free common level (the
        three published sensors scatter by 0.13 RMS).
      drift: sigma of the size a of a common change of ln Z, a (1 - exp(-t / tau)) (warm-up, published -0.23);
        0: none.
      shear: [N] sigma of the plate's tangential force about the measured one; 0: not used.
      modulus: initial Young's modulus [Pa]. hold_modulus: it is fixed.
      spread: sigma of the states about the middle of the table, in half widths of its axes; weak.
      amount: sigma of the amount of each of the response's changes; 0: none.
    """

    gains: float = 0.3
    offsets: float = 0.13
    drift: float = 0.25
    shear: float = 0.3
    modulus: float = 1.2e6
    hold_modulus: bool = False
    spread: float = 2.0
    amount: float = 0.0


@dataclasses.dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a recording.

    Attributes:
      counts: (n, nelectrode). force: (n, 3) of the plate on the skin, along the finger (towards the tip),
        across (to +z), pressing [N]. time: (n,) as a fraction of the recording.
    """

    counts: np.ndarray
    force: np.ndarray
    time: np.ndarray

    def __getitem__(self, which) -> "Rows":
        return Rows(self.counts[which], self.force[which], self.time[which])

    def __len__(self) -> int:
        return len(self.counts)


def rows_of(counts: np.ndarray, force: np.ndarray | None, every: int = 10) -> Rows:
    """Every tenth loaded row of raw counts (n, nelectrode) and force (n, 3) (across, along, away from the
    plate) [N].

    Raises:
      ValueError: no force, or too few loaded rows.
    """
    if force is None:
        raise ValueError("a match needs the force: give a file of Fx Fy Fz [N], as many rows")
    loaded = np.flatnonzero(np.linalg.norm(force, axis=1) > _LOADED)
    pushing = np.median(force[loaded, 2]) if len(loaded) else 0.0
    if pushing >= 0:
        raise ValueError(
            f"Fz is {pushing:.2g} N in the median of {len(loaded)} rows above {_LOADED} N: a press "
            "has it negative; give Fx Fy Fz [N] of the plate, z out of the sensor"
        )
    taken = loaded[::every]
    if len(taken) < _FEWEST:
        raise ValueError(
            f"{len(loaded)} rows have more than {_LOADED} N of force: {every * _FEWEST} are needed"
        )
    return Rows(counts[taken], force[taken] @ SIGNS, taken / len(counts))


class _Places(typing.NamedTuple):
    """Positions of constants in their vector: offset and gain of the electrodes; drift, ln of the modulus,
    and amounts of the response's changes."""

    offset: slice
    gain: slice
    drift: slice
    modulus: int
    amount: int

    @classmethod
    def of(cls, n):
        ends = slice(n), slice(n, 2 * n), slice(2 * n, 2 * n + 2)
        return cls(*ends, 2 * n + 2, 2 * n + 3)


@dataclasses.dataclass(frozen=True, eq=False)
class Constants:
    """Constants of one sensor, common to all rows.

    Attributes:
      offset: (nelectrode,) ln Z at rest at the first row. gain: (nelectrode,) on its change. drift: size a,
        ln tau (tau as a fraction of the recording). modulus: Young's modulus [Pa]. amount: (k,) of each of
        the response's changes.
    """

    offset: np.ndarray
    gain: np.ndarray
    drift: np.ndarray
    modulus: float
    amount: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))

    def drifted(self, time: np.ndarray) -> np.ndarray:
        """(n,) common change of ln Z at times (n,)."""
        return self.drift[0] * (1 - np.exp(-time / np.exp(self.drift[1])))

    def log_z(self, change: np.ndarray, time: np.ndarray) -> np.ndarray:
        """(n, nelectrode) ln Z from changes (n, nelectrode) by the skin's state."""
        return self.offset + self.gain * change + self.drifted(time)[:, None]

    @property
    def _vector(self):
        return np.concatenate([self.offset, self.gain, self.drift, [np.log(self.modulus)], self.amount])

    @property
    def _places(self):
        return _Places.of(len(self.offset))

    def _like(self, vector):
        """Constants from a vector of the same length."""
        at = self._places
        drift, modulus = vector[at.drift], vector[at.modulus]
        drift = np.array([drift[0], np.clip(drift[1], -3.0, 1.0)])
        gain = np.clip(vector[at.gain], 0.1, 5.0)
        return Constants(vector[at.offset], gain, drift, float(np.exp(modulus)), vector[at.amount :])


@dataclasses.dataclass(frozen=True, eq=False)
class Match:
    """Fitted states of rows.

    Attributes:
      state: (n, 4) pitch, roll [rad], drag along and across. counts: (n, nelectrode) of the model. force:
        (n, 2) tangential of the model [N]. cost: (n,) sum of squares, in counts.
    """

    state: np.ndarray
    counts: np.ndarray
    force: np.ndarray
    cost: np.ndarray


# scipy.optimize.least_squares with this Jacobian as a sparse matrix takes as long to the same cost (170
# synthetic rows, 1.7 s). It would not replace the global search of states, and its bounds reject fixed
# states, such as drags of a table without drag.
def fit_constants(
    response: Response, rows: Rows, setup: Setup, begin: tuple[Constants, np.ndarray] | None = None
) -> tuple[Constants, Match]:
    """Fits constants and the states of all rows jointly: Gauss-Newton with the states eliminated in each
    step.

    Args:
      begin: initial constants and states (n, 4), for example of a nested model; None: global search.
    """
    const, state = begin or (_begin(response, rows, setup), None)
    more = len(response.changes) - len(const.amount)
    const = dataclasses.replace(const, amount=np.concatenate([const.amount, np.zeros(max(more, 0))]))
    problem = _Problem(response, rows, const, setup)
    if state is None:
        state = fit_states(response, rows, const, setup).state
    now, damp = problem.evaluate(state, const), 1e-2
    for number in range(_STEPS):
        if number in _AGAIN and not begin:
            const, state = now.const, fit_states(response, rows, now.const, setup, also=now.state).state
            now = problem.evaluate(state, const)
        new = problem.evaluate(*problem.step(now, damp))
        if new.cost < now.cost:
            small = now.cost - new.cost < 1e-4 * now.cost
            now, damp = new, max(damp / 5, 1e-6)
            if small and number > (_NESTED if begin else _LEAST):
                break
        else:
            damp *= 8
            if damp > 1e6:
                break
    return now.const, fit_states(response, rows, now.const, setup, also=now.state)


def fit_states(
    response: Response,
    rows: Rows,
    const: Constants,
    setup: Setup,
    electrodes: np.ndarray | None = None,
    also: np.ndarray | None = None,
) -> Match:
    """The best state of every row for known constants.

    Args:
      electrodes: numbers of the used ones; None: all.
      also: (n, 4) further starting states in addition to the table's best nodes.
    """
    problem = _Problem(response, rows, const, setup, electrodes)
    starts = problem.best_nodes(const)
    if also is not None:
        starts = np.concatenate([starts, also[None]])
    found = [problem.descend(start, const) for start in starts]
    best = np.argmin([cost for _, cost in found], axis=0)
    state, cost = (np.array([f[i] for f in found])[best, np.arange(len(rows))] for i in (0, 1))
    value, _ = problem.loaded(const)(state, False)
    counts = counts_from_log_impedance(const.log_z(value[:, :-2], rows.time))
    return Match(state, counts, value[:, -2:] * const.modulus, cost)


def tangent(
    response: Response, rows: Rows, const: Constants, state: np.ndarray, setup: Setup
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """The model of n rows as a linear one about constants and states (n, 4), with m parameters: four of each
    row's state, then combinations of the free constants, the last of which is the last constant alone.

    Returns:
      residual (n, nelectrode + 2) measured less modelled: electrodes [counts], tangential forces [N]; columns
      (m, n, nelectrode + 2) increase of the model by one standard deviation of each prior; away (m,) from the
      priors' means in these; standard deviation of the last constant.
    """
    problem = _Problem(response, rows, const, setup)
    now, n, free = problem.evaluate(state, const), len(rows), problem._free
    used = [*problem.electrodes, -2, -1]
    unit = np.append(np.ones(len(problem.electrodes)), [setup.shear / _COUNTS] * 2)
    half, weight = _COUNTS / problem._pull, _COUNTS * np.sqrt(_CORRELATED)
    P, at = problem._prior[:, free] / weight, problem._prior_at / weight
    # what has no prior, the common level and the modulus, has a wide one
    factor = np.linalg.cholesky(P.T @ P + np.eye(len(free)) / _WIDE**2)
    spread = np.linalg.inv(factor).T
    states = np.zeros((n, 4, n, len(used)))
    states[np.arange(n), :, np.arange(n)] = (now.Js[:, used] * half).swapaxes(1, 2) * unit
    constants = np.moveaxis(problem._constant_slopes(now)[:, used][..., free] @ spread, -1, 0) * unit
    columns = np.concatenate([states.reshape(-1, *constants.shape[1:]), constants])
    away = factor.T @ const._vector[free] - spread.T @ (P.T @ at)
    away = np.append((state - problem._middle) / half, away)
    return -now.r[:, used] * unit, columns, away, float(spread[-1, -1])


@dataclasses.dataclass(frozen=True, eq=False)
class _Now:
    """State of the search: states, constants, values (n, nelectrode + 2), residuals (n, m), their derivatives
    by the states (n, m, 4), cost."""

    state: np.ndarray
    const: Constants
    value: np.ndarray
    r: np.ndarray
    Js: np.ndarray
    cost: float


class _Problem:
    """Residuals of rows and their derivatives."""

    def __init__(self, response, rows, const, setup, electrodes=None):
        self.response, self.rows, self.setup = response, rows, setup
        n = response.states.design.nelectrode
        self.electrodes = np.arange(n) if electrodes is None else np.asarray(electrodes)
        self._middle = (response.high + response.low) / 2
        half = (response.high - response.low) / 2
        self._pull = _COUNTS / (setup.spread * np.where(half > 0, half, 1.0))
        self._loaded = None, None
        self._free, self._prior, self._prior_at = _prior(setup, const, response.states.design)

    def loaded(self, const: Constants) -> Loaded:
        key = const._vector[const._places.modulus :].tobytes()
        if key != self._loaded[0]:
            self._loaded = key, self._at(const)
        return self._loaded[1]

    def _at(self, const):
        return self.response.at_load(self.rows.force[:, 2] / const.modulus, const.amount)

    def residuals(self, value, state, const):
        """(n, m): electrodes in counts, then shear and prior in the same unit; and counts (n, nelectrode)."""
        counts = counts_from_log_impedance(const.log_z(value[:, :-2], self.rows.time))
        r = [(counts - self.rows.counts)[:, self.electrodes], self._pull * (state - self._middle)]
        if self.setup.shear:
            shear = value[:, -2:] * const.modulus - self.rows.force[:, :2]
            r.append(_COUNTS / self.setup.shear * shear)
        return np.concatenate(r, 1), counts

    def state_slopes(self, slope, counts, const):
        """(n, m, 4) derivatives of the residuals from those of the response (n, nelectrode + 2, 4)."""
        J = [((_slope(counts) * const.gain)[..., None] * slope[:, :-2])[:, self.electrodes]]
        J.append(np.broadcast_to(np.diag(self._pull), (len(counts), 4, 4)))
        if self.setup.shear:
            J.append(_COUNTS / self.setup.shear * const.modulus * slope[:, -2:])
        return np.concatenate(J, 1)

    def evaluate(self, state, const) -> _Now:
        value, slope = self.loaded(const)(state)
        r, counts = self.residuals(value, state, const)
        prior = self._prior @ const._vector - self._prior_at
        cost = float((r * r).sum() + (prior * prior).sum())
        return _Now(state, const, value, r, self.state_slopes(slope, counts, const), cost)

    def step(self, now, damp):
        """New states and constants: damped least squares of all residuals (Schur complement)."""
        Js, r, free = now.Js, now.r, self._free
        Jc = self._constant_slopes(now)[..., free]
        P = self._prior[:, free]
        prior = self._prior @ now.const._vector - self._prior_at
        H = np.einsum("nmi,nmj->nij", Js, Js)
        H = H + damp * np.einsum("nii->ni", H)[:, :, None] * np.eye(4)
        cross = np.einsum("nmi,nmj->nij", Js, Jc)
        gs, gc = np.einsum("nmi,nm->ni", Js, r), np.einsum("nmj,nm->j", Jc, r) + P.T @ prior
        A = np.einsum("nmi,nmj->ij", Jc, Jc) + P.T @ P
        lead = np.linalg.solve(H, cross)
        S = A + damp * np.diag(np.diag(A)) - np.einsum("nij,nik->jk", cross, lead)
        change = -np.linalg.solve(S, gc - np.einsum("nij,ni->j", lead, gs))
        move = -np.linalg.solve(H, (gs + cross @ change)[..., None])[..., 0]
        vector = now.const._vector
        vector[free] += change
        at = now.const._places.modulus
        vector[at] = np.clip(vector[at], *(np.log(now.const.modulus) + [-0.3, 0.3]))
        state = np.clip(now.state + move, self.response.low, self.response.high)
        return state, now.const._like(vector)

    def _constant_slopes(self, now):
        """(n, m, nconstant) derivatives of the residuals by the constants."""
        const, time = now.const, self.rows.time
        counts = counts_from_log_impedance(const.log_z(now.value[:, :-2], time))
        vector, at, n = const._vector, const._places, len(const.offset)
        J, e, slope = np.zeros((*now.r.shape, len(vector))), np.arange(n), _slope(counts)
        J[:, e, e] = slope
        J[:, e, at.gain.start + e] = slope * now.value[:, :-2]
        ratio, tau = np.exp(-time / np.exp(const.drift[1])), np.exp(const.drift[1])
        J[:, :n, at.drift.start] = slope * (1 - ratio)[:, None]
        J[:, :n, at.drift.start + 1] = slope * (-const.drift[0] * ratio * time / tau)[:, None]
        for i in self._free[self._free >= at.modulus]:  # constants that change the table
            there = const._like(vector + _PROBE * (np.arange(len(vector)) == i))
            value, _ = self._at(there)(now.state, False)
            J[..., i] = (self.residuals(value, now.state, there)[0] - now.r) / _PROBE
        return J

    def descend(self, state, const, steps=12):
        """Levenberg-Marquardt for each row separately: states (n, 4), costs (n,)."""
        loaded, damp = self.loaded(const), np.full(len(state), 1e-2)

        def evaluate(state):
            value, slope = loaded(state)
            r, counts = self.residuals(value, state, const)
            return r, self.state_slopes(slope, counts, const), (r * r).sum(1)

        r, J, cost = evaluate(state)
        for _ in range(steps):
            H, g = np.einsum("nmi,nmj->nij", J, J), np.einsum("nmi,nm->ni", J, r)
            H = H + damp[:, None, None] * np.einsum("nii->ni", H)[:, :, None] * np.eye(4)
            new = state - np.linalg.solve(H, g[..., None])[..., 0]
            new = np.clip(new, self.response.low, self.response.high)
            new_r, new_J, new_cost = evaluate(new)
            better = new_cost < cost
            damp = np.where(better, damp / 4, damp * 6)
            state, r = np.where(better[:, None], new, state), np.where(better[:, None], new_r, r)
            J, cost = np.where(better[:, None, None], new_J, J), np.where(better, new_cost, cost)
        return state, cost

    def best_nodes(self, const):
        """(_STARTS, n, 4) nodes of the table nearest to each row, in different directions."""
        loaded, out = self.loaded(const), np.zeros((_STARTS, len(self.rows), 4))
        nodes = self.response.nodes
        for n, row in enumerate(loaded.table):
            value = row.reshape(-1, row.shape[-1])
            time = np.full(len(value), self.rows.time[n])
            counts = counts_from_log_impedance(const.log_z(value[:, :-2], time))
            cost = ((counts - self.rows.counts[n])[:, self.electrodes] ** 2).sum(1)
            if self.setup.shear:
                shear = (value[:, -2:] * const.modulus - self.rows.force[n, :2]) / self.setup.shear
                cost = cost + _COUNTS**2 * (shear * shear).sum(1)
            cost = cost.reshape(nodes.shape[:2])
            direction = np.argsort(cost.min(1))[:_STARTS]
            out[: len(direction), n] = nodes[direction, cost[direction].argmin(1)]
        return out


_PROBE = 1e-2  # finite difference of ln E and amounts


def _slope(counts):
    """d counts / d ln Z."""
    return -counts * (1 - counts / FULL_SCALE)


def _known_baseline(design):
    """(nelectrode,) mean ln Z at rest of the known sensors."""
    return np.mean([log_impedance(counts) for counts in design.rests], axis=0)


def _prior(setup, const, design):
    """Free constants (k,), and matrix and right-hand side of the priors: residuals P vector - at."""
    weight, size = _COUNTS * np.sqrt(_CORRELATED), len(const._vector)
    n, place = design.nelectrode, const._places
    free = [np.arange(n)]
    P, at = [np.zeros((n, size))], [np.zeros(n)]
    P[0][:, :n] = (np.eye(n) - 1 / n) * weight / setup.offsets
    at[0] = P[0][:, :n] @ _known_baseline(design)
    if setup.gains:
        free.append(np.arange(place.gain.start, place.gain.stop))
        P.append(np.zeros((n, size)))
        P[-1][:, place.gain] = np.eye(n) * weight / setup.gains
        at.append(np.full(n, weight / setup.gains))
    if setup.drift:
        free.append(np.arange(place.drift.start, place.drift.stop))
        P.append(np.zeros((2, size)))
        P[-1][[0, 1], free[-1]] = weight / setup.drift, weight
        at.append(np.array([0.0, weight * np.log(_TAU)]))
    if not setup.hold_modulus:
        free.append(np.array([place.modulus]))
    if setup.amount and size > place.amount:
        free.append(np.arange(place.amount, size))
        P.append(np.eye(size)[free[-1]] * weight / setup.amount)
        at.append(np.zeros(len(free[-1])))
    return np.concatenate(free), np.concatenate(P), np.concatenate(at)


_TAU = 0.4  # initial time constant of the drift over the length of the recording, sigma a factor e


def _begin(response, rows, setup):
    """Constants from the known baseline, with a common level such that the table's best nodes fit the
    rows."""
    start = np.array([0.0, np.log(_TAU)])
    none = np.zeros(len(response.changes))
    rest = _known_baseline(response.states.design)
    const = Constants(rest, np.ones(len(rest)), start, setup.modulus, amount=none)
    for _ in range(4):
        problem = _Problem(response, rows, const, setup)
        value, _ = problem.loaded(const)(problem.best_nodes(const)[0], False)
        residual = log_impedance(rows.counts) - const.log_z(value[:, :-2], rows.time)
        const = dataclasses.replace(const, offset=const.offset + np.median(residual))
    return const
