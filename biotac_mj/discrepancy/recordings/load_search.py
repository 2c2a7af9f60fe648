"""Which effects act between force and electrodes: all are compared on the same measured force, and the best
evidence wins.

The force sensor's reading is regressed on what the electrodes say (ln Z and squares and products of its six
principal components; they know the place of the contact, force alone does not), ridge, cross-validated by
contiguous blocks of time. An effect acts on the electrodes' side of the regression, so that it never changes
what has to be explained, and adds at most one number per component. Both sides are smoothed alike, by 20 ms,
which takes the electrodes' noise out of the comparison. Memory has a direction in time: an effect must beat
itself run backwards."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ...sensor.channels import log_impedance
from ..evidence import sign_flip
from .effects.effect import Finding
from .effects.loads import ForceEffect, Hysteresis, Latency, LoadLowPass, Relaxation, play

__all__ = ["BETWEEN", "ForceView", "find_between"]

# one of each at most: what a law a little different leaves is no effect
_KINS = ([Latency(), LoadLowPass()], [Relaxation(), Hysteresis()])
BETWEEN = [effect for kin in _KINS for effect in kin]
_BLOCKS = 24
_SMOOTH = 0.02  # [s]
_RIDGE = 1e-4
_ROWS = 4000
# least mean fall of a block's log mean square error
_GAIN = {"latency": 0.03, "lowpass": 0.03, "relax": 0.06, "hyster": 0.06}
_FURTHER = 1.5  # times that beside another effect
_P = 0.02
# of the other's gain that a second effect needs: what a law a little different leaves is no effect
_REMAINDER = 0.1
_LEAST = 0.06  # fraction of a relaxation or a loop
_TIE = 1.64  # standard errors, paired over blocks


class ForceView:
    """Cross-validated prediction of force from electrodes on some contiguous rows.

    Args:
      counts: (n, 19); force: (n, 3) as the sensor said [N]; rows: (n,) bool, contiguous; usable: electrodes
        to use; rate: [Hz];
      chain: effects between force and electrodes that are known, list of (effect, theta).
    """

    def __init__(
        self,
        counts: np.ndarray,
        force: np.ndarray,
        rows: np.ndarray,
        usable: np.ndarray,
        rate: float,
        chain: Sequence[tuple] = (),
    ):
        self.rows, self.rate, self.chain = np.flatnonzero(rows), rate, list(chain)
        z = log_impedance(counts[np.ix_(self.rows, usable)])
        z = z - z.mean(0)
        u = np.linalg.svd(z, full_matrices=False)[0][:, :6] * np.sqrt(len(z))
        i, j = np.triu_indices(u.shape[1])
        x = np.concatenate([z, u[:, i] * u[:, j]], axis=1)
        self.x = self._smooth((x - x.mean(0)) / np.maximum(x.std(0), 1e-9))
        self.step = max(1, len(z) // _ROWS)
        self.target = self._smooth(force[self.rows])[:: self.step]
        m = len(self.target)
        self.edges = -(-np.arange(_BLOCKS + 1) * m // _BLOCKS)

    def _smooth(self, x):
        return gaussian_filter1d(x, _SMOOTH * self.rate, axis=0, mode="nearest")

    def errors(self, chain: Sequence[tuple] = ()) -> np.ndarray:
        """(blocks, 3) logarithm of the mean square error of each block left out, with effects besides those
        known."""
        return self._score(*self._features([*self.chain, *chain]))[0]

    def explained(self) -> float:
        """Share of the force's variance that the electrodes predict, median over its components."""
        return float(np.median(1 - np.exp(self.errors()).mean(0) / np.maximum(self.target.var(0), 1e-12)))

    def table(self, effect: ForceEffect, thetas: list[dict], chain: Sequence[tuple] = ()) -> np.ndarray:
        """(thetas, blocks) mean log error over the components, for each theta of an effect beside a chain."""
        chain, name = [*self.chain, *chain], effect.linear
        if name is None:
            return np.stack([self._score(*self._features([*chain, (effect, t)]))[0].mean(1) for t in thetas])
        out, without = np.empty((len(thetas), _BLOCKS)), self._features(chain)
        for other in {tuple((k, v) for k, v in t.items() if k != name) for t in thetas}:
            mine = [i for i, t in enumerate(thetas) if all(t[k] == v for k, v in other)]
            whole = self._features([*chain, (effect, dict(other) | {name: 1.0})])[0]
            out[mine] = self._score(*without, whole - without[0], [thetas[i][name] for i in mine]).mean(2)
        return out

    def _features(self, chain):
        """Columns for all components (rows, q) and further ones for each (components, rows, loops)."""
        x = self.x
        for effect, theta in chain:
            if not isinstance(effect, Hysteresis):
                x = _sided(effect.unsee, x, self.rate, self._here(theta))
        x, loops = x[:: self.step], np.zeros((3, len(self.target), 0))
        for effect, theta in chain:
            if isinstance(effect, Hysteresis):
                loops = np.concatenate([loops, self.loop(x, theta).T[:, :, None]], axis=2)
        return x, loops

    def _here(self, theta):
        """Times of a theta counted from the view's first row."""
        begin = self.rows[0] / self.rate
        return (
            theta | {"start": max(theta["start"] - begin, 0.0), "end": theta["end"] - begin}
            if "start" in theta
            else theta
        )

    def loop(self, x: np.ndarray, theta: dict) -> np.ndarray:
        """(rows, 3) elastic part of a play operator on what the electrodes say of the force."""
        said = self.predict(x)[0]
        width = theta["width"] if "width" in theta else theta["share"] * said.std(0)
        return _sided(lambda s, rate, t: play(s, width), said, self.rate, theta)

    def predict(self, x: np.ndarray, loop: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """(rows, 3) force by columns (rows, q), each block from the others [N], a loop's part left out, and
        the loop's factor (3,)."""
        A = np.concatenate([np.ones((len(x), 1)), x, *([] if loop is None else [loop])], axis=1)
        G, H, _ = self._products(A)
        q, out, factor = 1 + x.shape[1], np.empty(self.target.shape), np.zeros(3)
        for k in range(3):
            keep = np.r_[:q, q + k] if loop is not None else np.arange(q)
            w = _left_out(G[:, keep][:, :, keep], H[:, keep][:, :, [k]])
            factor[k] = w[:, -1].mean()
            for i, (a, b) in enumerate(zip(self.edges[:-1], self.edges[1:])):
                out[a:b, k] = A[a:b, :q] @ w[i, :q, 0]
        return out, factor

    def _products(self, A):
        spans = list(zip(self.edges[:-1], self.edges[1:]))
        t = self.target
        return (
            np.stack([A[a:b].T @ A[a:b] for a, b in spans]),
            np.stack([A[a:b].T @ t[a:b] for a, b in spans]),
            np.stack([(t[a:b] ** 2).sum(0) for a, b in spans]),
        )

    def _score(self, x, loops, change=None, shares=(0.0,)):
        """(shares, blocks, 3) log mean square error by columns x + share change and each component's loops,
        from one set of products."""
        q, more = x.shape[1], loops.shape[2]
        change = x[:, :0] if change is None else change
        G, H, T = self._products(np.concatenate([np.ones((len(x), 1)), x, *loops, change], axis=1))
        last = 1 + q + 3 * more  # first column of the change
        out = np.empty((len(shares), _BLOCKS, 3))
        for k in range(3) if more else [slice(None)]:
            keep = np.r_[: 1 + q, 1 + q + k * more : 1 + q + (k + 1) * more] if more else np.arange(1 + q)
            one = [k] if more else k
            for i, share in enumerate(shares):
                g, h = G[:, keep][:, :, keep], H[:, keep][:, :, one]
                if share:
                    cross = share * G[:, keep][:, :, last:]
                    g[:, :, 1 : 1 + q] += cross
                    g[:, 1 : 1 + q] += cross.transpose(0, 2, 1)
                    g[:, 1 : 1 + q, 1 : 1 + q] += share**2 * G[:, last:, last:]
                    h[:, 1 : 1 + q] += share * H[:, last:][:, :, one]
                w = _left_out(g, h)
                square = T[:, one] - 2 * (w * h).sum(1) + (w * (g @ w)).sum(1)
                out[i][:, one] = np.log(np.maximum(square / np.diff(self.edges)[:, None], 1e-12))
        return out


def find_between(session: Any) -> list:
    """Findings between force and electrodes: the set of effects that predicts the force best on blocks left
    out, each one needed in it."""
    view = session.force_view()
    if view is None:
        return []
    seconds = len(view.rows) / view.rate
    tried = {e.id: e.tried(view.rate, seconds) for e in BETWEEN}

    def best(effect, chain):
        """theta, mean log errors by block and the table of an effect beside a chain."""
        table = view.table(effect, tried[effect.id], chain)
        i = int(table.mean(1).argmin())
        return tried[effect.id][i], table[i], table

    def gain(effect, theta, score, chain, without):
        reference = without
        if effect.arrow:
            thetas = [theta | {"backwards": True}]
            if effect.linear:
                thetas = [t | {"backwards": True} for t in tried[effect.id] if t["tau"] == theta["tau"]]
            mirror = view.table(effect, thetas, chain)
            mirror = mirror[mirror.mean(1).argmin()]
            reference = mirror if mirror.mean() < without.mean() else without
        return reference - score

    null = view.errors().mean()

    def choose(effects, chain):
        """The effect of some that predicts best beside a chain, if its evidence is enough: list of none or
        one."""
        without, options = view.errors(chain).mean(1), []
        least = _REMAINDER * (null - without.mean())
        for effect in effects:
            theta, score, _ = best(effect, chain)
            g = gain(effect, theta, score, chain, without)
            if _enough(effect, g, bool(chain)) and g.mean() > least:
                options.append((score.mean(), effect, theta))
        return [min(options, key=lambda o: o[0])[1:]] if options else []

    first = choose(BETWEEN, [])
    if not first:
        return []
    mine, others = _KINS if first[0][0] in _KINS[0] else _KINS[::-1]
    second = choose(others, first)
    chain = [*choose(mine, second), *second] if second else first
    found = [_finding(session, view, c, [o for o in chain if o is not c], best, gain) for c in chain]
    return [f for f in found if abs(f.theta.get("fraction", 1.0)) >= _LEAST]


def _enough(effect, gain, beside):
    return gain.mean() > _GAIN[effect.id] * (_FURTHER if beside else 1) and sign_flip(gain) < _P


def _finding(session, view, one, rest, best, gain):
    effect = one[0]
    theta, score, table = best(effect, rest)
    without = view.errors(rest).mean(1)
    g = gain(effect, theta, score, rest, without)
    ties = []
    for other in next(kin for kin in _KINS if effect in kin):
        if other is not effect:
            rival, said, _ = best(other, rest)
            lead = said - score
            close = lead.mean() < _TIE * lead.std(ddof=1) / np.sqrt(_BLOCKS)
            if close and _enough(other, gain(other, rival, said, rest, without), bool(rest)):
                ties.append(other.id)
    thetas = effect.tried(view.rate, len(view.rows) / view.rate)
    parameters, theta = _parameters(effect, theta, thetas, table)
    shortest = thetas[0].get("tau")
    if isinstance(effect, Relaxation) and parameters["tau"][1] < 1.2 * shortest and "hyster" not in ties:
        # a memory as short as the movements: whether it fades or is worn off they do not show
        ties.append("hyster")
    if isinstance(effect, Hysteresis):
        x = view._features([*view.chain, *rest])[0]
        theta["width"] = theta.pop("share") * view.predict(x)[0].std(0)
        each = view.predict(x, view.loop(x, theta))[1]
        theta["fraction"] = float(np.median(each))
        parameters = {"fraction": (theta["fraction"], float(each.min()), float(each.max())),
                      "width": (float(np.median(theta["width"])), np.nan, np.nan)}  # fmt: skip
    seconds = session.fit.sum() / session.recording.rate
    # half the summed log-error ratio, per independent second of a block
    nats = float(0.5 * 3 * g.sum() * min(max(1.0, seconds / _BLOCKS), 20))
    note = "; ".join(
        filter(
            None,
            [effect.note(theta), f"errors of the force fall in {np.mean(g > 0):.0%} of {_BLOCKS} blocks"],
        )
    )
    last = float(session.recording.time[-1])
    found = Finding(
        effect, tuple(range(19)), theta, parameters, nats, 0.0, last, sign_flip(g), tuple(ties), note
    )
    if isinstance(effect, Latency):
        _in_a_stretch(
            found,
            np.array([t["delay"] * view.rate for t in thetas]),
            table,
            session.recording.time[view.rows],
        )
    return found


def _parameters(effect, theta, thetas, table):
    """name -> (value, low, high) and theta with the refined value: bootstrap over blocks, at least the grid's
    spacing."""
    rng = np.random.default_rng(0)
    draws = [table[:, rng.integers(0, _BLOCKS, _BLOCKS)].mean(1) for _ in range(200)]
    out = {}
    for name in [k for k in theta if k in effect.params]:
        values = np.array([t[name] for t in thetas])
        value = _profiled(values, table.mean(1))
        low, high = np.quantile([_profiled(values, d) for d in draws], [0.025, 0.975])
        out[name] = (value, float(low), float(high))
    return out, theta | {k: v[0] for k, v in out.items()}


def _profiled(values, score):
    """Value with the least score, the least over the other parameters, between the tried ones; values (n,),
    score (n,)."""
    distinct = np.unique(values)
    axis = np.log(distinct) if distinct[0] > 0 else distinct
    profile = np.array([score[values == v].min() for v in distinct])
    found = _vertex(axis, profile, int(profile.argmin()))
    return float(np.exp(found) if distinct[0] > 0 else found)


def _sided(act, x, rate, theta):
    """`act`, or the same run backwards in time."""
    return act(x[::-1], rate, theta)[::-1] if theta.get("backwards") else act(x, rate, theta)


def _left_out(G, H):
    """Weights (blocks, q, components) fitted without each block, from products by blocks; ridge in units of
    each column's variance."""
    total = G.sum(0)
    ridge = _RIDGE * np.diag(total).copy()
    ridge[0] = 0
    return np.linalg.solve(total - G + np.diag(ridge + 1e-9), H.sum(0) - H)


def _vertex(x, y, i):
    """Position of the minimum of a parabola through three points."""
    if not 0 < i < len(x) - 1:
        return float(x[i])
    bend, slope, _ = np.polyfit(x[i - 1 : i + 2] - x[i], y[i - 1 : i + 2], 2)
    return float(np.clip(x[i] - 0.5 * slope / max(bend, 1e-12), x[i - 1], x[i + 1]))


def _in_a_stretch(found, delays, table, time):
    """Narrows a latency to the stretch of blocks in which it acts, if its delay [rows] differs outside."""
    part = _segment(delays, table)
    if part is None:
        return
    a, b, inside, outside = part
    edges = time[np.minimum(np.arange(_BLOCKS + 1) * len(time) // _BLOCKS, len(time) - 1)]
    rate = (len(time) - 1) / (time[-1] - time[0])
    found.theta.update(
        delay=inside / rate, start=edges[a], end=edges[b] if b < _BLOCKS else np.inf, otherwise=outside / rate
    )
    found.start, found.end = float(edges[a]), float(edges[b])
    found.parameters = {
        "delay": (inside / rate, (inside - 1.5) / rate, (inside + 1.5) / rate),
        "delay_otherwise": (outside / rate, (outside - 1.5) / rate, (outside + 1.5) / rate),
    }
    found.note += (
        f"; {inside / rate * 1e3:.0f} ms from {edges[a]:.0f} s to {edges[b]:.0f} s, "
        f"{outside / rate * 1e3:.0f} ms otherwise"
    )


def _segment(delays, score):
    """A stretch of blocks whose delay differs from the others': first, last + 1, delay inside, delay outside;
    or None."""
    nb = score.shape[1]
    one = score.sum(1).min()
    best = None
    total = np.concatenate([np.zeros((len(score), 1)), np.cumsum(score, axis=1)], axis=1)
    for a in range(nb):
        for b in range(a + 3, nb + 1):
            if (a, b) == (0, nb) or nb - (b - a) < 3:
                continue
            inside = total[:, b] - total[:, a]
            outside = total[:, -1] - inside
            value = inside.min() + outside.min()
            if best is None or value < best[0]:
                best = value, a, b, int(inside.argmin()), int(outside.argmin())
    if best is None:
        return None
    value, a, b, i, o = best
    rows = np.zeros(nb, bool)
    rows[a:b] = True
    together = int(score.sum(1).argmin())
    better = np.where(rows, score[together] - score[i], score[together] - score[o])
    affected = better[np.abs(better) > 1e-12]
    if (
        abs(delays[i] - delays[o]) < 2
        or len(affected) < 3
        or (one - value) / nb < 0.02
        or np.mean(affected > 0) < 0.8
    ):
        return None
    if abs(delays[i]) < abs(delays[o]):  # what departs most from none is the effect
        if a == 0:
            return b, nb, float(delays[o]), float(delays[i])
        if b == nb:
            return 0, a, float(delays[o]), float(delays[i])
    return a, b, float(delays[i]), float(delays[o])
