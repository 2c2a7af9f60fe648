"""Effects that the noise shows: low-pass filtering, cross-talk, an electrode noisier than it should be.

Noise of a real unloaded sensor is white and independent between electrodes (docs/sensor.md), so its colour
and its correlations are the electronics'. Third differences take the load out; windows in which the load
moves least are used."""

from typing import Any

import numpy as np
from scipy.optimize import brentq

from ....geometry.electrodes import electrode_positions
from .effect import Finding, Parameter, RecordedEffect, spans

__all__ = ["CommonNoise", "CrossTalk", "LowPass", "Noise"]

# nats of cross-talk under load: skin that moves correlates electrodes too, up to 84 nats of pairs (practice
# seeds)
_LOADED = 90.0
_THIRD = np.array([1.0, -3.0, 3.0, -1.0])
_WINDOWS = 24


def windows(session: Any, rows: np.ndarray | None = None) -> list[tuple]:
    """Third differences (without repeated rows) cut into windows: list of (first time, last time, (n,
    19))."""
    recording = session.recording
    where = np.flatnonzero((session.fit if rows is None else rows) & ~recording.repeated)
    x = session.counts[where]
    d = x[3:] - 3 * x[2:-1] + 3 * x[1:-2] - x[:-3]
    bad = session.masked[where]
    bad = bad[3:] | bad[2:-1] | bad[1:-2] | bad[:-3]
    d = np.where(bad, np.nan, d)
    t = where[3:] / recording.rate
    size = max(60, len(d) // _WINDOWS)
    return [(t[a], t[min(a + size, len(t)) - 1], d[a : a + size]) for a in range(0, len(d) - size // 2, size)]


def differenced_correlation(pole: float) -> float:
    """Lag-1 autocorrelation of the third differences of noise with an exponential autocorrelation
    pole^|h|."""
    c = np.convolve(_THIRD, _THIRD[::-1])
    lags = np.arange(-3, 4)
    zero = (c * pole ** np.abs(lags)).sum()
    one = (c * pole ** np.abs(lags + 1)).sum()
    return one / zero


def pole_of(correlation: float) -> float:
    """Inverse of `differenced_correlation`, nan below white."""
    white, stiff = differenced_correlation(0.0), differenced_correlation(0.995)
    if not white < correlation:
        return 0.0
    return (
        0.995
        if correlation >= stiff
        else brentq(lambda a: differenced_correlation(a) - correlation, 0.0, 0.995)
    )


def _lag_one(d):
    """(19,) lag-1 autocorrelation, zero-mean, nan-aware; nan for an electrode without noise."""
    pair = d[1:] * d[:-1]
    with np.errstate(invalid="ignore", divide="ignore"):
        power = _mean(d**2)
        out = _mean(pair) / power
    out[~(power > 0.8)] = np.nan  # below that rounding to counts is all there is
    return out


def _mean(x):
    """Mean over rows of what is known; nan where nothing is."""
    known = np.isfinite(x)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(known, x, 0).sum(0) / known.sum(0)


def quiet(cuts: list[tuple], share: float = 0.5) -> list[tuple]:
    """The windows in which the third differences are smallest."""
    energy = np.array([np.nanmedian(_mean(d**2)) for _, _, d in cuts])
    return [c for c, e in zip(cuts, energy) if e <= np.quantile(energy, share)]


class LowPass(RecordedEffect):
    id, name, stage, unit = "lowpass", "low-pass filter", "A", "pole of the noise"
    physics = "tau dV/dt + V = U: the noise, white in a real sensor, is coloured and fast changes are rounded"
    params = {"tau": Parameter("s", 0.002, 1.0, "electronics 3-150 ms")}
    confusable = {"latency": "a tap: delay shifts, a filter rounds", "relax": "longer holds"}

    def find(self, session: Any) -> list:
        cuts = windows(session)
        if len(cuts) < 4:
            return []
        value = np.array([_lag_one(d) for _, _, d in cuts])  # (w, 19)
        edges = np.array([c[0] for c in cuts] + [cuts[-1][1]])
        common = np.nanmedian(value, axis=1)
        limit = differenced_correlation(0.25)
        if np.isfinite(common).sum() < 4:
            return []
        found = []
        flag = np.where(np.isfinite(common), common > limit, False)
        # Movement of a loaded skin can imitate it in lively windows; in the quiet ones it cannot.
        calm = np.array([np.nanmedian(_mean(d**2)) for _, _, d in cuts])
        calm = calm <= np.quantile(calm, 0.6)
        stretches = spans(flag, edges, least=5)
        if flag[calm].mean() > 0.8:
            stretches = [(float(edges[0]), float(session.recording.time[-1]))]
        for start, end in stretches:
            inside = (edges[:-1] >= start - 1e-9) & (edges[1:] <= end + 1e-9)
            if not (inside & calm).any():
                continue
            found.append(self._finding(session, value[inside & calm], tuple(range(19)), start, end, edges))
        if found:
            return found[:1]
        if np.mean(flag) > 0.3:
            return []
        single = np.nanmedian(value[calm], axis=0)
        middle = np.nanmedian(single)
        for k in range(19):
            if np.isfinite(single[k]) and single[k] > max(limit, middle + 0.12):
                found.append(
                    self._finding(
                        session,
                        value[calm][:, [k]],
                        (k,),
                        float(edges[0]),
                        float(session.recording.time[-1]),
                        edges,
                    )
                )
        return found[:1]

    def _finding(self, session, value, channels, start, end, edges):
        r = session.recording
        rate = r.rate * (1 - r.repeated.mean())
        pole = pole_of(float(np.nanmedian(value)))
        centre = np.nanmedian(value, axis=1)
        spread = np.nanstd(centre) / np.sqrt(max(len(centre), 1)) + 0.01
        low, high = (pole_of(float(np.nanmedian(value)) + s * spread) for s in (-2, 2))
        tau = [-1 / (rate * np.log(min(max(p, 1e-3), 0.995))) for p in (pole, low, high)]
        n = value.size * 60
        nats = min(0.5 * n * pole**2, 1e4)
        theta = {
            "tau": tau[0],
            "start": start if start > edges[0] + 1e-9 else 0.0,
            "end": end + 1e9 * (end >= r.time[-1] - 1e-9),
            "rate": r.rate,
        }
        return Finding(
            self,
            channels,
            theta,
            {"tau": (tau[0], tau[1], tau[2])},
            nats,
            theta["start"],
            end,
            float(np.exp(-min(nats, 700))),
            note=f"correlation of neighbouring noise samples {pole:.2f}, white is 0",
        )

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        from scipy.signal import lfilter

        a = np.exp(-1 / (theta["tau"] * theta["rate"]))
        rows = np.flatnonzero((time >= theta["start"]) & (time < theta["end"]))
        out = counts.copy()
        if len(rows):
            x = counts[np.ix_(rows, channels)]
            out[np.ix_(rows, channels)] = lfilter([1 - a], [1, -a], x, axis=0, zi=a * x[:1])[0]
        return out


class CrossTalk(RecordedEffect):
    id, name, stage, unit = "crosstalk", "cross-talk between electrodes", "A", "mean correlation of noise"
    physics = (
        "V = (I + kappa K) U: part of the neighbours' signal and noise is added, "
        "neighbours in space or in the multiplexer's order"
    )
    params = {
        "kappa": Parameter("1", 0.005, 0.5, "0-0.2"),
        "length": Parameter("mm", 1, 12, "2-6 mm, spacing of the electrodes"),
    }
    confusable = {"gain": "drive one electrode alone", "common_noise": "cross-talk falls off with distance"}

    def find(self, session: Any) -> list:
        result = self._correlation(session)
        if result is None:
            return []
        corr, n = result
        off = corr[np.triu_indices(19, 1)]
        # Movement correlates too, but more where it is livelier; cross-talk of the noise is there all the
        # same.
        lively = self._correlation(session, share=1.0)[0][np.triu_indices(19, 1)]
        if np.sqrt((off**2).mean()) < 0.75 * np.sqrt((lively**2).mean()):
            return []
        patterns = _neighbour_patterns()
        white = np.nanmedian(off)
        best = None
        for name, K in patterns.items():
            k = K[np.triu_indices(19, 1)]
            x = off - white
            c = k - k.mean()
            kappa = float(np.nansum(c * x) / (c @ c))
            chance = len(x) / n  # of the squares, from so few samples
            left, total = np.nansum((x - x.mean() - kappa * c) ** 2), np.nansum((x - x.mean()) ** 2)
            share = float(1 - max(left - chance, 0.05 * total) / max(total - chance, 0.05 * total))
            if best is None or share > best[1]:
                best = name, share, kappa
        name, share, kappa = best
        K = patterns[name][np.triu_indices(19, 1)]
        z = kappa * np.sqrt(n * ((K - K.mean()) ** 2).sum())
        strong = np.flatnonzero((np.abs(corr - np.eye(19)) > max(0.15, 7 / np.sqrt(n))).any(1))
        if share > 0.4 and kappa > 0.06 and z > 7:
            channels, value, pattern = tuple(range(19)), kappa / 2, name
        elif 2 <= len(strong) <= 6:
            a, b = np.unravel_index(np.nanargmax(np.abs(corr - np.eye(19))), corr.shape)
            channels, value, pattern = tuple(int(i) for i in strong), float(corr[a, b]) / 2, "pair"
        else:
            return []
        K = patterns.get(pattern, np.zeros((19, 19)))
        if pattern == "pair":
            K = np.zeros((19, 19))
            for i in strong:
                for j in strong:
                    if i != j and abs(corr[i, j]) > 0.1:
                        K[i, j] = corr[i, j] / corr[a, b]
        half = 2 / np.sqrt(n)
        theta = {
            "kappa": value,
            "matrix": np.eye(19) + value * K,
            "centre": np.median(session.counts[session.fit], axis=0),
        }
        nats = min(0.5 * n * float(np.nansum((2 * value * K[np.triu_indices(19, 1)]) ** 2)), 1e4)
        if session.timeline().loaded and nats < _LOADED:
            return []
        parameters = {"kappa": (value, value - half, value + half)}
        if pattern.startswith("distance"):
            parameters["length"] = (float(pattern.split()[1]), np.nan, np.nan)
        note = (
            f"noise of neighbours ({pattern}) is correlated by {2 * value:.2f}; "
            "a sensor's is independent (0.00)"
        )
        return [
            Finding(
                self,
                channels,
                theta,
                parameters,
                nats,
                0.0,
                float(session.recording.time[-1]),
                float(np.exp(-min(nats, 700))),
                note=note,
            )
        ]

    @staticmethod
    def _correlation(session, rows=None, share=None):
        """Correlation (19, 19) of fifth differences in the quietest share of windows of 40 rows, and how many
        independent samples made it."""
        recording = session.recording
        share = (0.3 if session.timeline().loaded else 1.0) if share is None else share
        where = np.flatnonzero((session.fit if rows is None else rows) & ~recording.repeated)
        d = np.diff(session.counts[where], n=5, axis=0)
        bad = session.masked[where]
        d[np.any([bad[i : len(bad) - 5 + i] for i in range(6)], axis=0)] = 0
        size = 40
        k = len(d) // size
        if k < 8:
            return None
        block = d[: k * size].reshape(k, size, 19)
        power = (block**2).mean(1)
        calm = np.maximum(np.quantile(power, 0.1, axis=0), 1.0)
        energy = np.median(power / calm, axis=1)
        d = block[energy <= np.quantile(energy, share)].reshape(-1, 19)
        sd = d.std(0)
        alive = sd > 2.0  # fifth differences of rounding alone: 0.29 sqrt(252) = 4.6 counts; of nothing: 0
        if alive.sum() < 8 or len(d) < 100:
            return None
        # Single large samples (movement, spikes) must not decide a correlation.
        d = np.clip(d / np.where(alive, sd, 1), -3, 3)
        power = (d**2).sum(0)
        corr = d.T @ d / np.sqrt(np.outer(power, power) + 1e-12)
        corr[~alive], corr[:, ~alive] = 0, 0
        np.fill_diagonal(corr, 1)
        return corr, len(d) / 2.9  # C(20, 10) / C(10, 5)^2: fifth differences repeat each sample's noise

    def correct(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        return theta["centre"] + (counts - theta["centre"]) @ np.linalg.inv(theta["matrix"]).T

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        return theta["centre"] + (counts - theta["centre"]) @ theta["matrix"].T


class CommonNoise(RecordedEffect):
    id, name, stage, unit = (
        "common_noise",
        "noise common to all channels (reference, supply)",
        "A",
        "mean correlation of noise",
    )
    physics = "one noise is added to every channel"
    params = {"correlation": Parameter("1", 0.05, 1, "0.001 in a real sensor")}
    confusable = {"crosstalk": "cross-talk falls off with distance"}

    def find(self, session: Any) -> list:
        result = CrossTalk._correlation(session)
        if result is None:
            return []
        corr, n = result
        off = corr[np.triu_indices(19, 1)]
        middle, spread = float(np.median(off)), float(np.subtract(*np.quantile(off, [0.75, 0.25])))
        if middle < 0.15 or middle < 1.0 * spread:
            return []
        nats = min(0.5 * n * middle**2 * 19, 1e4)
        return [
            Finding(
                self,
                tuple(range(19)),
                {},
                {"correlation": (middle, middle - 2 / np.sqrt(n), middle + 2 / np.sqrt(n))},
                nats,
                0.0,
                float(session.recording.time[-1]),
                float(np.exp(-min(nats, 700))),
                note="all pairs alike",
            )
        ]


class Noise(RecordedEffect):
    id, name, stage, unit = "noise", "excess noise of single electrodes", "A", "times the law"
    physics = (
        "an electrode's white noise is larger than the law min(15.8 (1 - E/4095), "
        "6.6) counts scaled to the other electrodes"
    )
    params = {"factor": Parameter("1", 1.8, 100, "a real sensor follows the law within 20 %")}
    confusable = {"hum": "a line in the spectrum", "spikes": "single samples"}

    def find(self, session: Any) -> list:
        from ....sensor.channels import electrode_noise

        cuts = windows(session)
        if len(cuts) < 4:
            return []
        sd = np.sqrt(np.nan_to_num(np.array([_mean(d**2) for _, _, d in cuts])) / 20)
        law = electrode_noise(np.median(session.counts[session.fit], axis=0))
        ratio = np.maximum(sd, 0.3) / law
        calm = np.quantile(ratio, 0.3, axis=0)
        overall = np.median(calm)
        edges = np.array([c[0] for c in cuts] + [cuts[-1][1]])
        found = []
        for k in np.flatnonzero(session.masked[session.fit].mean(0) < 0.02):
            excess = ratio[:, k] / np.maximum(np.median(ratio, axis=1), 0.3 * overall)
            own = np.median(excess)
            if own > 2.5:
                start, end = float(edges[0]), float(session.recording.time[-1])
            else:
                long = (
                    spans(excess > 2.5 * max(np.quantile(excess, 0.25), 0.3), edges, least=3)
                    if not session.timeline().loaded
                    else []
                )
                if not long:
                    continue
                start, end = long[0]
                own = float(np.median(excess[(edges[:-1] >= start - 1e-9) & (edges[1:] <= end + 1e-9)]))
            n = len(cuts) * 60
            nats = min(0.1 * n * np.log(own) ** 2, 1e4)
            found.append(
                Finding(
                    self,
                    (int(k),),
                    {},
                    {"factor": (float(own), np.nan, np.nan)},
                    nats,
                    start,
                    end,
                    float(np.exp(-min(nats, 700))),
                    note=f"{own:.1f} times as noisy as the other electrodes' law",
                )
            )
        return found


def _neighbour_patterns():
    p = electrode_positions()
    d = np.linalg.norm(p[:, None] - p[None], axis=2)
    out = {f"distance {length:g} mm": np.exp(-d / length) * (1 - np.eye(19)) for length in (2, 4, 6)}
    # the strongest entry is one: kappa is the part that the nearest neighbour gives
    out = {name: K / K.max() for name, K in out.items()}
    out["order"] = (np.abs(np.subtract.outer(np.arange(19), np.arange(19))) == 1).astype(float)
    near = np.sort(d + 1e3 * np.eye(19), axis=1)[:, 3]
    out["nearest"] = ((d <= np.maximum(near[:, None], near[None])) & (d > 0)).astype(float)
    return out
