"""Effects between force and electrodes: latency, low-pass, relaxation after a load change, hysteresis.

Force is regressed on the electrodes (they know the place of the contact, force alone does not), ridge, cross-validated by contiguous
blocks of
time. An effect is a change of the force that the electrodes follow; it is judged by the logarithm of each block's error, block by block.
"""

import abc

import numpy as np
from scipy.signal import lfilter

from ..sensor.channels import log_impedance
from .evidence import sign_flip
from .recorded_effect import Finding, Parameter, RecordedEffect

__all__ = ["ForceView", "Hysteresis", "Latency", "LoadLowPass", "Relaxation", "force_features"]

_BLOCKS = 24
_MOST_ROWS = 12000


class ForceView:
    """Cross-validated prediction of force from electrodes on the rows to fit.

    Args:
      counts: (n, 19); force: (n, 3) [N]; fit: (n,) bool; usable: electrodes to use.
    """

    def __init__(self, counts, force, fit, usable):
        rows = np.flatnonzero(fit)
        self.rows, self.force = rows, force
        y = log_impedance(counts[:, usable])[rows]
        y = (y - y.mean(0)) / np.maximum(y.std(0), 1e-6)
        self.base = np.concatenate([np.ones((len(rows), 1)), y], axis=1)
        self.block = np.minimum(np.arange(len(rows)) * _BLOCKS // len(rows), _BLOCKS - 1)

    def errors(self, target, extra=None):
        """(blocks, 3) logarithm of the mean square error of each block left out; target (n, 3) over all rows of the recording."""
        t = target[self.rows]
        A = self.base if extra is None else np.concatenate([self.base, extra], axis=1)
        scale = np.maximum(np.abs(A).std(0), 1e-9)
        scale[0] = 1
        A = A / scale
        starts = np.searchsorted(self.block, np.arange(_BLOCKS + 1))
        G = np.stack([A[a:b].T @ A[a:b] for a, b in zip(starts[:-1], starts[1:])])
        H = np.stack([A[a:b].T @ t[a:b] for a, b in zip(starts[:-1], starts[1:])])
        ridge = 1e-3 * len(t) * np.eye(A.shape[1])
        ridge[0, 0] = 0
        out = np.empty((_BLOCKS, 3))
        for i, (a, b) in enumerate(zip(starts[:-1], starts[1:])):
            w = np.linalg.solve(G.sum(0) - G[i] + ridge, H.sum(0) - H[i])
            out[i] = np.log(np.maximum(((t[a:b] - A[a:b] @ w) ** 2).mean(0), 1e-12))
        return out

    def estimate(self):
        """(rows, 3) force as the electrodes say [N], each block predicted from the others."""
        t = self.force[self.rows]
        out = np.empty_like(t)
        ridge = 1e-3 * len(t) * np.eye(self.base.shape[1])
        ridge[0, 0] = 0
        for i in range(_BLOCKS):
            inside = self.block == i
            A = self.base[~inside]
            out[inside] = self.base[inside] @ np.linalg.solve(A.T @ A + ridge, A.T @ t[~inside])
        return out

    def explained(self):
        """Share of the force's variance that the electrodes predict, median over its components."""
        error = np.exp(self.errors(self.force)).mean(0)
        return float(np.median(1 - error / np.maximum(self.force[self.rows].var(0), 1e-12)))


class ForceEffect(RecordedEffect):
    """Subclasses write `see(force, rate, theta)`, the force that the electrodes follow, and its inverse `unsee`."""

    unit = "N"

    @abc.abstractmethod
    def see(self, force, rate, theta):
        """(n, 3) force that the electrodes follow [N]."""

    @abc.abstractmethod
    def unsee(self, force, rate, theta):
        """(n, 3) force that a sensor would have said from what the electrodes followed [N]: the inverse of `see`."""


class Latency(ForceEffect):
    id, name, stage = "latency", "latency between force and electrodes", "A"
    physics = "the electrodes are logged later (positive) or earlier than the force: V(t - d)"
    params = {"delay": Parameter("s", -0.3, 0.6, "0-100 ms; buses, buffers and drivers more")}
    confusable = {"lowpass": "a tap: delay shifts, a filter rounds", "relax": "longer holds"}

    def find(self, session):
        view = session.force_view()
        if view is None:
            return []
        rate, force = session.recording.rate, session.force
        reach = np.arange(int(np.floor(-0.3 * rate)), int(np.ceil(0.6 * rate)) + 1)
        coarse = reach[:: max(1, len(reach) // 30)]
        table = {int(d): view.errors(shift(force, d)) for d in coarse}
        best = min(table, key=lambda d: table[d].mean())
        step = max(1, len(reach) // 30)
        for d in range(best - step, best + step + 1):
            if d not in table:
                table[d] = view.errors(shift(force, d))
        delays = np.array(sorted(table))
        score = np.stack([table[d].mean(1) for d in delays])  # (lags, blocks)
        centre = int(np.argmin(score.mean(1)))
        exact = _vertex(delays, score.mean(1), centre)
        zero = table.get(0, view.errors(force)).mean(1)
        gain = zero - score[centre]
        p = sign_flip(gain)
        rng = np.random.default_rng(0)
        draws = []
        for _ in range(200):
            pick = score[:, rng.integers(0, _BLOCKS, _BLOCKS)].mean(1)
            draws.append(_vertex(delays, pick, int(np.argmin(pick))))
        low, high = np.quantile(draws, [0.025, 0.975])
        if p > 0.01 or abs(exact) < 0.6 or gain.mean() < 0.015 or low * high < 0:
            return []
        theta = {"delay": exact / rate, "start": 0.0, "end": np.inf}
        found = Finding(self, tuple(range(19)), theta, {"delay": (exact / rate, low / rate, high / rate)}, _nats(gain, session),
                        0.0, float(session.recording.time[-1]), p, note=f"errors of the force fall in {np.mean(gain > 0):.0%} of {_BLOCKS} blocks")  # fmt: skip  # noqa: E501
        found.theta["gain"] = gain
        part = _segment(delays, score)
        if part is not None:
            a, b, inside, outside = part
            t = session.recording.time[view.rows]
            edges = np.append(t[np.searchsorted(view.block, np.arange(_BLOCKS))], t[-1])
            found.theta.update(delay=inside / rate, start=edges[a], end=edges[b] if b < _BLOCKS else np.inf, otherwise=outside / rate)
            found.start, found.end = float(edges[a]), float(edges[b])
            found.parameters = {"delay": (inside / rate, (inside - 1.5) / rate, (inside + 1.5) / rate),
                                "delay_otherwise": (outside / rate, (outside - 1.5) / rate, (outside + 1.5) / rate)}  # fmt: skip
            found.note += (
                f"; {inside / rate * 1e3:.0f} ms from {edges[a]:.0f} s to {edges[b]:.0f} s, {outside / rate * 1e3:.0f} ms otherwise"
            )
        return [found]

    def see(self, force, rate, theta):
        late = shift(force, theta["delay"] * rate)
        if theta["start"] == 0 and not np.isfinite(theta["end"]):
            return late
        time = np.arange(len(force)) / rate
        on = ((time >= theta["start"]) & (time < theta["end"]))[:, None]
        return np.where(on, late, shift(force, theta.get("otherwise", 0.0) * rate))

    def unsee(self, force, rate, theta):
        time = np.arange(len(force)) / rate
        on = ((time >= theta["start"]) & (time < theta["end"]))[:, None]
        return np.where(on, shift(force, -theta["delay"] * rate), shift(force, -theta.get("otherwise", 0.0) * rate))

    def apply(self, counts, time, channels, theta):
        rate = (len(time) - 1) / (time[-1] - time[0])
        return shift(counts, theta["delay"] * rate)


class LoadLowPass(ForceEffect):
    id, name, stage = "lowpass", "low-pass filter", "A"
    physics = "tau dV/dt + V = U: electrodes follow force rounded"
    params = {"tau": Parameter("s", 0.002, 1.0, "electronics 3-150 ms")}
    confusable = {"latency": "a tap: delay shifts, a filter rounds", "relax": "longer holds"}

    def find(self, session):
        view = session.force_view()
        if view is None:
            return []
        rate, force = session.recording.rate, session.force
        taus = [t for t in np.geomspace(0.005, 0.6, 13) if t > 0.4 / rate]
        zero = view.errors(force).mean(1)
        score = np.stack([view.errors(lagged(force, t, rate)).mean(1) for t in taus])
        i = int(np.argmin(score.mean(1)))
        # Filtering takes noise out of the force, whatever the electrodes do: the same filter backwards in time does as well.
        backwards = view.errors(lagged(force[::-1], taus[i], rate)[::-1]).mean(1)
        gain = np.minimum(zero - score[i], backwards - score[i]) if backwards.mean() > zero.mean() else backwards - score[i]
        p = sign_flip(gain)
        if p > 0.01 or gain.mean() < 0.015:
            return []
        log_tau = _vertex(np.log(taus), score.mean(1), i)
        rng = np.random.default_rng(0)
        draws = []
        for _ in range(200):
            pick = score[:, rng.integers(0, _BLOCKS, _BLOCKS)].mean(1)
            draws.append(_vertex(np.log(taus), pick, int(np.argmin(pick))))
        low, high = np.exp(np.quantile(draws, [0.025, 0.975]))
        tau = float(np.exp(log_tau))
        found = Finding(self, tuple(range(19)), {"tau": tau, "gain": gain}, {"tau": (tau, low, high)}, _nats(gain, session), 0.0,
                        float(session.recording.time[-1]), p, note=f"errors of the force fall in {np.mean(gain > 0):.0%} of {_BLOCKS} blocks")  # fmt: skip  # noqa: E501
        return [found]

    def see(self, force, rate, theta):
        return lagged(force, theta["tau"], rate)

    def unsee(self, force, rate, theta):
        # F = V + tau dV/dt; the derivative over the filter's own time, so that it does not magnify the electrodes' noise
        return force + shift(force, -0.5 * theta["tau"] * rate) - shift(force, 0.5 * theta["tau"] * rate)

    def apply(self, counts, time, channels, theta):
        return lagged(counts, theta["tau"], (len(time) - 1) / (time[-1] - time[0]))


class Relaxation(ForceEffect):
    id, name, stage = "relax", "relaxation after load changes", "C"
    physics = "force answers a change of deformation at once and relaxes towards a part of it: G(t) = Ginf + G1 exp(-t / tau)"
    params = {
        "fraction": Parameter("1", -0.6, 1.0, "0.02-0.3 of silicone; with the liquid's flow more"),
        "tau": Parameter("s", 0.1, 60, "0.5 s and 4-7 s (PDC)"),
    }
    confusable = {"hyster": "hold 0, 1 and 30 s at the same depth", "lowpass": "longer holds", "latency": "a tap"}

    def find(self, session):
        view = session.force_view()
        if view is None:
            return []
        rate, force = session.recording.rate, session.force
        guess = view.estimate()
        zero = view.errors(force, guess).mean(1)
        seconds = len(view.rows) / rate
        taus = [t for t in (0.15, 0.3, 0.6, 1.2, 2.5, 5, 10, 20, 40) if t > 6 / rate and t < seconds / 12]
        best = None
        for tau in taus:
            memory = guess - lagged(guess, tau, rate)
            score = view.errors(force, np.concatenate([guess, memory], axis=1)).mean(1)
            if best is None or score.mean() < best[0].mean():
                best = score, tau, memory
        if best is None:
            return []
        score, tau, memory = best
        gain = zero - score
        p = sign_flip(gain)
        if p > 0.01 or gain.mean() < 0.02:
            return []
        residual = force[view.rows] - guess
        g = float((memory * residual / residual.var(0)).sum() / (memory**2 / residual.var(0)).sum())
        by_block = [
            float((memory[view.block == b] * residual[view.block == b]).sum() / (memory[view.block == b] ** 2).sum())
            for b in range(_BLOCKS)
        ]
        half = 2 * float(np.std(by_block)) / np.sqrt(_BLOCKS)
        if not 0.03 < abs(g) < 0.95 or abs(g) < half:
            return []
        found = Finding(self, tuple(range(19)), {"fraction": g, "tau": tau, "gain": gain},
                        {"fraction": (g, g - half, g + half), "tau": (tau, tau / 1.6, tau * 1.6)}, _nats(gain, session), 0.0,
                        float(session.recording.time[-1]), p, note=f"force {'overshoots' if g > 0 else 'lags'} what the electrodes say and comes back")  # fmt: skip  # noqa: E501
        return [found]

    def see(self, force, rate, theta):
        g, tau = theta["fraction"], theta["tau"]
        return force - g / (1 + g) * (force - lagged(force, tau * (1 + g), rate))

    def unsee(self, force, rate, theta):
        return force + theta["fraction"] * (force - lagged(force, theta["tau"], rate))


class Hysteresis(ForceEffect):
    id, name, stage = "hyster", "rate-independent hysteresis", "C"
    physics = "loading and unloading differ at equal electrodes, whatever the speed (Dahl, Prandtl-Ishlinskii)"
    params = {
        "fraction": Parameter("1", -1, 1, "loops of soft tactile sensors: 13-24 % of full scale"),
        "width": Parameter("N", 0.01, 5, "the record"),
    }
    confusable = {"relax": "hold 0, 1 and 30 s at the same depth", "latency": "two speeds a decade apart"}

    def find(self, session):
        view = session.force_view()
        if view is None:
            return []
        rate, force = session.recording.rate, session.force
        guess = view.estimate()
        zero = view.errors(force, guess).mean(1)
        smooth = lagged(guess, 3 / rate, rate)
        best = None
        for share in (0.15, 0.4, 1.0):
            width = share * smooth.std(0)
            loop = play(smooth, width)
            score = view.errors(force, np.concatenate([guess, loop], axis=1)).mean(1)
            if best is None or score.mean() < best[0].mean():
                best = score, width, loop
        score, width, loop = best
        gain = zero - score
        p = sign_flip(gain)
        if p > 0.01 or gain.mean() < 0.025:
            return []
        residual = force[view.rows] - guess
        eta = float((loop * residual / residual.var(0)).sum() / (loop**2 / residual.var(0)).sum())
        by_block = [
            float((loop[view.block == b] * residual[view.block == b]).sum() / max((loop[view.block == b] ** 2).sum(), 1e-9))
            for b in range(_BLOCKS)
        ]
        half = 2 * float(np.std(by_block)) / np.sqrt(_BLOCKS)
        if abs(eta) < half or abs(eta) < 0.03:
            return []
        theta = {"fraction": eta, "width": width, "gain": gain}
        return [Finding(self, tuple(range(19)), theta, {"fraction": (eta, eta - half, eta + half), "width": (float(np.median(width)), np.nan, np.nan)},  # noqa: E501
                        _nats(gain, session), 0.0, float(session.recording.time[-1]), p, note="the loop between loading and unloading does not depend on speed")]  # fmt: skip  # noqa: E501

    def see(self, force, rate, theta):
        return force - theta["fraction"] * play(lagged(force, 3 / rate, rate), theta["width"])

    def unsee(self, force, rate, theta):
        return force + theta["fraction"] * play(lagged(force, 3 / rate, rate), theta["width"])


def shift(x, delay):
    """x (n, m) delayed by a fractional number of rows; the ends hold."""
    n = len(x)
    at = np.clip(np.arange(n) - delay, 0, n - 1)
    low = np.minimum(at.astype(int), n - 2)
    part = (at - low)[:, None]
    return x[low] * (1 - part) + x[low + 1] * part


def lagged(x, tau, rate):
    """First-order low-pass of (n, m) with time constant tau [s], at rest before the first row."""
    a = np.exp(-1 / max(tau * rate, 1e-9))
    return lfilter([1 - a], [1, -a], x, axis=0, zi=a * x[:1])[0]


def play(x, width):
    """(n, m) elastic part of a play operator: follows x up to +-width (m,), then slips."""
    out = np.empty_like(x)
    z = np.zeros(x.shape[1])
    previous = x[0]
    for i, now in enumerate(x):
        z = np.clip(z + now - previous, -width, width)
        out[i], previous = z, now
    return out


def force_features(force):
    """(n, 16) of a force: components, place-like ratios, squares and products."""
    normal = np.where(np.abs(force[:, 2]) < 0.2, 0.2 * np.where(force[:, 2] < 0, -1, 1), force[:, 2])
    x = np.concatenate([force, np.clip(force[:, :2] / normal[:, None], -3, 3)], axis=1)
    i, j = np.triu_indices(3)
    return np.concatenate([np.ones((len(x), 1)), x, x[:, i] * x[:, j], x[:, 3:] * x[:, 2:3], x[:, 3:] ** 2], axis=1)


def _vertex(x, y, i):
    """Position of the minimum of a parabola through three points."""
    if not 0 < i < len(x) - 1:
        return float(x[i])
    a, b, c = y[i - 1], y[i], y[i + 1]
    if not np.isclose(x[i] - x[i - 1], x[i + 1] - x[i], rtol=0.3):
        return float(x[i])
    bend = a - 2 * b + c
    return float(x[i] + (0.5 * (a - c) / bend if bend > 0 else 0) * (x[i + 1] - x[i]))


def _nats(gain, session):
    """Evidence: half the summed log-error ratio, per independent second of a block."""
    seconds = session.fit.sum() / session.recording.rate
    per_block = max(1.0, seconds / _BLOCKS)
    return float(0.5 * 3 * gain.sum() * min(per_block, 20))


def _segment(delays, score):
    """A stretch of blocks whose delay differs from the others': first, last + 1, delay inside, delay outside; or None."""
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
    if abs(delays[i] - delays[o]) < 2 or len(affected) < 3 or (one - value) / nb < 0.02 or np.mean(affected > 0) < 0.8:
        return None
    if abs(delays[i]) < abs(delays[o]):  # what departs most from none is the effect
        if a == 0:
            return b, nb, float(delays[o]), float(delays[i])
        if b == nb:
            return 0, a, float(delays[o]), float(delays[i])
    return a, b, float(delays[i]), float(delays[o])
