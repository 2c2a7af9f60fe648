"""What lies between force and electrodes: latency, low-pass, relaxation after load changes, hysteresis.

The force sensor's reading is regressed on what the electrodes say (ln Z and squares and products of its six
principal components; they know the place of the contact, force alone does not), ridge, on blocks of time left
out. An effect acts on the electrodes' side of the regression, so that it never changes what has to be
explained, and adds at most one number per component. Both sides are smoothed alike, by 20 ms, which takes the
electrodes' noise out of the comparison. Memory has a direction in time: an effect must beat itself run
backwards."""

import abc
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from .....sensor.channels import log_impedance
from ....evidence import sign_flip
from ...findings import KINDS, Finding
from ...recording import FORCE_MOVED
from ...session import Session

__all__ = ["BETWEEN", "ForceEffect", "ForceView", "find_between", "force_view", "lagged"]

_BLOCKS = 24
_SMOOTH = 0.02  # [s]
_RIDGE = 1e-4
_ROWS = 4000
_P = 0.02
# of the other's gain that a second effect needs: what a law a little different leaves is no effect
_REMAINDER = 0.1
# share of the blocks in which what has a memory explains the force better: 0.75 at most in real recordings
# without one, 0.79 or more in seven of eight with one
_MOSTLY = 0.77
_TIE = 1.64  # standard errors, paired over blocks
_KIN = 0.6  # of what one memory explains, which another explains, too: laws of memory are alike


class ForceEffect(abc.ABC):
    """Subclasses write `see(force, rate, theta)`, the force that the electrodes follow, its inverse
    `unsee`, and what is tried.

    Attributes:
      arrow: whether the effect has to beat itself run backwards in time: what has no memory looks alike from
        both ends.
      linear: parameter that `unsee` is linear in, or None.
    """

    id = ""
    arrow = True
    linear: str | None = None

    @abc.abstractmethod
    def tried(self, rate: float, seconds: float) -> list:
        """Parameters (dicts) to try on a record of `seconds` at `rate` [Hz]."""

    @abc.abstractmethod
    def see(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        """(n, m) force that the electrodes follow [N]."""

    @abc.abstractmethod
    def unsee(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        """(n, m) force that a sensor would have said from what the electrodes followed [N]: the inverse of
        `see`."""

    def note(self, theta: dict) -> str:
        """What was seen, in words."""
        return ""


class Latency(ForceEffect):
    id = "latency"
    arrow = False  # run backwards it is a delay of the other sign, which is tried as well

    def tried(self, rate: float, seconds: float) -> list:
        fine = max(1, round(0.01 * rate))
        near, far = np.arange(-5, 11) * fine, np.unique(np.geomspace(12 * fine, 0.6 * rate, 8).astype(int))
        rows = np.unique(np.concatenate([-far[far < 0.3 * rate], near, far]))
        return [{"delay": d / rate} for d in rows if d]

    def see(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return shift(force, theta["delay"] * rate)

    def unsee(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return shift(force, -theta["delay"] * rate)


class LoadLowPass(ForceEffect):
    id = "lowpass"

    def tried(self, rate: float, seconds: float) -> list:
        return [{"tau": t} for t in np.geomspace(0.007, 0.4, 12) if t > 0.4 / rate]

    def see(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return lagged(force, theta["tau"], rate)

    def unsee(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        # F = V + tau dV/dt; the derivative over the filter's own time, so that it does not magnify the
        # electrodes' noise
        return force + shift(force, -0.5 * theta["tau"] * rate) - shift(force, 0.5 * theta["tau"] * rate)


class Relaxation(ForceEffect):
    id = "relax"
    linear = "fraction"

    def tried(self, rate: float, seconds: float) -> list:
        fractions = (-0.25, -0.1, 0.08, 0.16, 0.3, 0.5)
        return [
            {"fraction": g, "tau": t}
            for t in (0.3, 0.5, 0.9, 1.6, 2.8, 5, 9, 16)
            if t < seconds / 8
            for g in fractions
        ]

    def see(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        g, tau = theta["fraction"], theta["tau"]
        return force - g / (1 + g) * (force - lagged(force, tau * (1 + g), rate))

    def unsee(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return force + theta["fraction"] * (force - lagged(force, theta["tau"], rate))

    def note(self, theta: dict) -> str:
        return (
            f"force {'overshoots' if theta['fraction'] > 0 else 'lags'} what the electrodes say and "
            "comes back"
        )


class Hysteresis(ForceEffect):
    id = "hyster"

    def tried(self, rate: float, seconds: float) -> list:
        # widths in standard deviations; the fraction is fitted
        return [{"share": share} for share in (0.15, 0.3, 0.6, 1.2)]

    def see(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return force - theta["fraction"] * play(lagged(force, 3 / rate, rate), theta["width"])

    def unsee(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return force + theta["fraction"] * play(lagged(force, 3 / rate, rate), theta["width"])

    def note(self, theta: dict) -> str:
        return "the loop between loading and unloading does not depend on speed"


def shift(x: np.ndarray, delay: float) -> np.ndarray:
    """x (n, m) delayed by a fractional number of rows; the ends hold."""
    n = len(x)
    at = np.clip(np.arange(n) - delay, 0, n - 1)
    low = np.minimum(at.astype(int), n - 2)
    part = (at - low)[:, None]
    return x[low] * (1 - part) + x[low + 1] * part


def lagged(x: np.ndarray, tau: float, rate: float) -> np.ndarray:
    """First-order low-pass of (n, m) with time constant tau [s], at rest before the first row."""
    a = np.exp(-1 / max(tau * rate, 1e-9))
    return lfilter([1 - a], [1, -a], x, axis=0, zi=a * x[:1])[0]


def play(x: np.ndarray, width: np.ndarray) -> np.ndarray:
    """(n, m) elastic part of a play operator: follows x up to +-width (m,), then slips."""
    out = np.empty_like(x)
    z = np.zeros(x.shape[1])
    previous = x[0]
    for i, now in enumerate(x):
        z = np.clip(z + now - previous, -width, width)
        out[i], previous = z, now
    return out


_KINS = ([Latency(), LoadLowPass()], [Relaxation(), Hysteresis()])
# one of each at most: what a law a little different leaves is no effect
BETWEEN = [effect for kin in _KINS for effect in kin]


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
                x = _sided(effect.unsee, x, self.rate, theta)
        x, loops = x[:: self.step], np.zeros((3, len(self.target), 0))
        for effect, theta in chain:
            if isinstance(effect, Hysteresis):
                loops = np.concatenate([loops, self.loop(x, theta).T[:, :, None]], axis=2)
        return x, loops

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


def force_view(session: Session, rows: np.ndarray, known: Sequence[Finding] = ()) -> ForceView | None:
    """ForceView of contiguous rows (n,) bool, None where force and electrodes are not related."""
    r = session.recording
    usable = np.flatnonzero(session.masked[rows].mean(0) < 0.02)
    if r.force is None or len(usable) < 6 or r.force[rows].std(0).max() < FORCE_MOVED:
        return None
    chain = [f.seen for f in known if f.seen is not None]
    return ForceView(session.counts, r.force, rows, usable, r.rate, chain)


def find_between(session: Session) -> list[Finding]:
    """Findings between force and electrodes: the set of effects that predicts the force best on blocks left
    out, each one needed in it."""
    view = force_view(session, session.fit)
    if view is None:
        return []
    seconds = len(view.rows) / view.rate
    tried = {e.id: e.tried(view.rate, seconds) for e in BETWEEN}

    def best(effect, chain):
        """theta, mean log errors by block and the table of an effect beside a chain."""
        table = view.table(effect, tried[effect.id], chain)
        i = int(table.mean(1).argmin())
        return tried[effect.id][i], table[i], table

    def mirrored(effect, theta, chain):
        """Mean log errors by block of an effect run backwards in time."""
        thetas = [theta | {"backwards": True}]
        if effect.linear:
            thetas = [t | {"backwards": True} for t in tried[effect.id] if t["tau"] == theta["tau"]]
        mirror = view.table(effect, thetas, chain)
        return mirror[mirror.mean(1).argmin()]

    def gain(effect, theta, score, chain, without):
        reference = without
        if effect.arrow:
            mirror = mirrored(effect, theta, chain)
            reference = mirror if mirror.mean() < without.mean() else without
        return reference - score

    null = view.errors().mean()

    def choose(effects, chain):
        """The effect of some that predicts best beside a chain: list of none or one."""
        without, options = view.errors(chain).mean(1), []
        least = _REMAINDER * (null - without.mean())
        for effect in effects:
            if not tried[effect.id]:  # in so short a recording
                continue
            theta, score, _ = best(effect, chain)
            g = gain(effect, theta, score, chain, without)
            if effect.arrow and np.mean(g > 0) < _MOSTLY:
                continue
            if sign_flip(g) < _P and g.mean() > max(least, 0):
                options.append((score.mean(), effect, theta))
        return [min(options, key=lambda o: o[0])[1:]] if options else []

    # what is late looks like what comes to rest: every real sensor is late, so that is taken out first
    late = choose(_KINS[0], [])
    memory = choose(_KINS[1], late)
    chain = [*(choose(_KINS[0], memory) if memory else late), *memory]
    return [_finding(session, view, c, [o for o in chain if o is not c], best, gain, mirrored) for c in chain]


def _finding(session, view, one, rest, best, gain, mirrored):
    effect = one[0]
    theta, score, table = best(effect, rest)
    without = view.errors(rest).mean(1)
    g = gain(effect, theta, score, rest, without)
    arrow = mirrored(effect, theta, rest).mean() - score.mean() if effect.linear else 0.0
    ties = ["creep"] if effect.id == "relax" else []  # a plateau takes longer than these holds
    for other in BETWEEN:
        known = [one for one, _ in rest]
        if other is not effect and other not in known and other.tried(view.rate, len(view.rows) / view.rate):
            rival, said, _ = best(other, rest)
            lead = said - score
            close = lead.mean() < _TIE * lead.std(ddof=1) / np.sqrt(_BLOCKS)
            close |= {effect, other} <= {*_KINS[1]} and (without - said).mean() > _KIN * g.mean()
            if close and sign_flip(gain(other, rival, said, rest, without)) < _P:
                if isinstance(other, Latency):  # of the two the one with less to explain
                    return _finding(session, view, (other, rival), rest, best, gain, mirrored)
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
        parameters = {
            "fraction": (theta["fraction"], float(each.min()), float(each.max())),
            "width": (float(np.median(theta["width"])), np.nan, np.nan),
        }
    seconds = session.fit.sum() / session.recording.rate
    # half the summed log-error ratio, per independent second of a block
    nats = float(0.5 * 3 * g.sum() * min(max(1.0, seconds / _BLOCKS), 20))
    size = abs(theta.get("fraction", theta.get("delay", theta.get("tau", 1.0)) * 10))
    return Finding(
        effect.id,
        tuple(range(19)),
        parameters,
        nats,
        sign_flip(g),
        0.0,
        float(session.recording.time[-1]),
        note="; ".join(
            filter(
                None,
                [effect.note(theta), f"errors of the force fall in {np.mean(g > 0):.0%} of {_BLOCKS} blocks"],
            )
        ),
        ties=tuple(ties),
        seen=(effect, theta),
        clues={
            "gain": float(np.log(max(g.mean(), 1e-4))),
            "blocks": float(np.mean(g > 0)),
            "size": float(np.log(max(size, 1e-3))),
            "explained": float(view.explained()),
            "seconds": float(np.log(seconds)),
            "arrow": float(arrow),
        },
    )


def _parameters(effect, theta, thetas, table):
    """name -> (value, low, high) and theta with the refined value: bootstrap over blocks, at least the grid's
    spacing."""
    rng = np.random.default_rng(0)
    draws = [table[:, rng.integers(0, _BLOCKS, _BLOCKS)].mean(1) for _ in range(200)]
    out = {}
    for name in [k for k in theta if k in KINDS[effect.id].params and k != "width"]:
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
