"""Effects that the noise shows: low-pass filtering, cross-talk, mains hum, an electrode noisier than it should be.

Noise of a real unloaded sensor is white and independent between electrodes (docs/sensor.md), so its colour and its correlations are the
electronics'. Third differences take the load out; windows in which the load moves least are used.
"""

import numpy as np
from scipy.optimize import brentq
from scipy.stats import gamma

from .recorded_effect import Finding, Parameter, RecordedEffect, spans

__all__ = ["CommonNoise", "CrossTalk", "Hum", "LowPass", "Noise"]

_THIRD = np.array([1.0, -3.0, 3.0, -1.0])
_WINDOWS = 24
_ELECTRODES_MM = {  # Lin et al. 2013, in the sensor's frame [mm]; E11..E16 mirror E1..E6
    1: (0.993, -4.855, -1.116), 2: (-2.7, -3.513, -3.67), 3: (-6.2, -3.513, -3.67), 4: (-8, -4.956, -1.116), 5: (-10.5, -3.513, -3.67),
    6: (-13.4, -4.956, -1.116), 7: (4.763, 0, -2.33), 8: (3.031, -1.95, -3.33), 9: (3.031, 1.95, -3.33), 10: (1.299, 0, -4.33),
    17: (-2.8, 0, -5.08), 18: (-9.8, 0, -5.08), 19: (-13.6, 0, -5.08),
}  # fmt: skip


def electrode_positions():
    """(19, 3) [mm]."""
    table = {**_ELECTRODES_MM, **{k + 10: (x, -y, z) for k, (x, y, z) in _ELECTRODES_MM.items() if k <= 6}}
    return np.array([table[k] for k in range(1, 20)])


def windows(session, rows=None):
    """Third differences (without repeated rows) cut into windows: list of (first time, last time, (n, 19))."""
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


def differenced_correlation(pole):
    """Lag-1 autocorrelation of the third differences of noise with an exponential autocorrelation pole^|h|."""
    c = np.convolve(_THIRD, _THIRD[::-1])
    lags = np.arange(-3, 4)
    zero = (c * pole ** np.abs(lags)).sum()
    one = (c * pole ** np.abs(lags + 1)).sum()
    return one / zero


def pole_of(correlation):
    """Inverse of `differenced_correlation`, nan below white."""
    white, stiff = differenced_correlation(0.0), differenced_correlation(0.995)
    if not white < correlation:
        return 0.0
    return 0.995 if correlation >= stiff else brentq(lambda a: differenced_correlation(a) - correlation, 0.0, 0.995)


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


def quiet(cuts, share=0.5):
    """The windows in which the third differences are smallest."""
    energy = np.array([np.nanmedian(_mean(d**2)) for _, _, d in cuts])
    return [c for c, e in zip(cuts, energy) if e <= np.quantile(energy, share)]


class LowPass(RecordedEffect):
    id, name, stage, unit = "lowpass", "low-pass filter", "A", "pole of the noise"
    physics = "tau dV/dt + V = U: the noise, white in a real sensor, is coloured and fast changes are rounded"
    params = {"tau": Parameter("s", 0.002, 1.0, "electronics 3-150 ms")}
    confusable = {"latency": "a tap: delay shifts, a filter rounds", "relax": "longer holds"}

    def find(self, session):
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
                found.append(self._finding(session, value[calm][:, [k]], (k,), float(edges[0]), float(session.recording.time[-1]), edges))
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
        return Finding(self, channels, theta, {"tau": (tau[0], tau[1], tau[2])}, nats, theta["start"], end, float(np.exp(-min(nats, 700))),
                       note=f"correlation of neighbouring noise samples {pole:.2f}, white is 0")  # fmt: skip

    def apply(self, counts, time, channels, theta):
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
    physics = "V = (I + kappa K) U: part of the neighbours' signal and noise is added, neighbours in space or in the multiplexer's order"
    params = {"kappa": Parameter("1", 0.005, 0.5, "0-0.2"), "length": Parameter("mm", 1, 12, "2-6 mm, spacing of the electrodes")}
    confusable = {"gain": "drive one electrode alone", "common_noise": "cross-talk falls off with distance"}

    def find(self, session):
        result = self._correlation(session)
        if result is None:
            return []
        corr, n = result
        off = corr[np.triu_indices(19, 1)]
        # Movement correlates too, but more where it is livelier; cross-talk of the noise is there all the same.
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
        theta = {"kappa": value, "matrix": np.eye(19) + value * K, "centre": np.median(session.counts[session.fit], axis=0)}
        nats = min(0.5 * n * float(np.nansum((2 * value * K[np.triu_indices(19, 1)]) ** 2)), 1e4)
        parameters = {"kappa": (value, value - half, value + half)}
        if pattern.startswith("distance"):
            parameters["length"] = (float(pattern.split()[1]), np.nan, np.nan)
        note = f"noise of neighbours ({pattern}) is correlated by {2 * value:.2f}; a sensor's is independent (0.00)"
        return [
            Finding(
                self, channels, theta, parameters, nats, 0.0, float(session.recording.time[-1]), float(np.exp(-min(nats, 700))), note=note
            )
        ]

    @staticmethod
    def _correlation(session, rows=None, share=None):
        """Correlation (19, 19) of fifth differences in the quietest share of windows of 40 rows, and how many independent samples made
        it."""
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

    def correct(self, counts, time, channels, theta):
        return theta["centre"] + (counts - theta["centre"]) @ np.linalg.inv(theta["matrix"]).T

    def apply(self, counts, time, channels, theta):
        return theta["centre"] + (counts - theta["centre"]) @ theta["matrix"].T


class CommonNoise(RecordedEffect):
    id, name, stage, unit = "common_noise", "noise common to all channels (reference, supply)", "A", "mean correlation of noise"
    physics = "one noise is added to every channel"
    params = {"correlation": Parameter("1", 0.05, 1, "0.001 in a real sensor")}
    confusable = {"crosstalk": "cross-talk falls off with distance"}

    def find(self, session):
        result = CrossTalk._correlation(session)
        if result is None:
            return []
        corr, n = result
        off = corr[np.triu_indices(19, 1)]
        middle, spread = float(np.median(off)), float(np.subtract(*np.quantile(off, [0.75, 0.25])))
        if middle < 0.15 or middle < 1.0 * spread:
            return []
        nats = min(0.5 * n * middle**2 * 19, 1e4)
        return [Finding(self, tuple(range(19)), {}, {"correlation": (middle, middle - 2 / np.sqrt(n), middle + 2 / np.sqrt(n))}, nats, 0.0,
                        float(session.recording.time[-1]), float(np.exp(-min(nats, 700))), note="all pairs alike")]  # fmt: skip


class Hum(RecordedEffect):
    id, name, stage, unit = "hum", "mains hum or another periodic disturbance", "A", "counts"
    physics = "A sin(2 pi f t): mains, its alias, or a machine"
    params = {"amplitude": Parameter("counts", 0.3, 500, "1-10 counts"), "frequency": Parameter("Hz", 0.2, 2000, "up to half the rate")}
    confusable = {"noise": "noise has no line in its spectrum"}

    def find(self, session):
        rate = session.recording.rate
        x = session.counts[session.fit]
        best = None
        for start, stop in _stretches(len(x), rate):
            found = self._line(x[start:stop], rate)
            if found and (best is None or found[0] > best[0] * 1.2):
                best = (*found, start, stop)
        if best is None:
            return []
        strength, f, channels, k_segments, start, stop = best
        f, _, _ = _refine(x[start:stop], rate, f, channels)
        start, stop = _when(x, rate, f, channels, start, stop)
        f, _, w = _refine(x[start:stop], rate, f, channels)
        amplitude = np.hypot(w[0], w[1])
        noise = np.std(np.diff(x[start:stop], n=2, axis=0), axis=0) / np.sqrt(6)
        if amplitude.max() < max(0.4, 0.12 * np.median(noise)):
            return []
        full = np.zeros((2, 19))
        full[:, list(channels)] = w
        offset = np.flatnonzero(session.fit)[0]
        whole = (start, stop) == (0, len(x))
        theta = {"frequency": f, "weights": full, "start": 0.0 if whole else (offset + start) / rate,
                 "end": np.inf if stop == len(x) else (offset + stop) / rate, "origin": (offset + start) / rate}  # fmt: skip
        width = 0.5 / ((stop - start) / rate)
        parameters = {
            "frequency": (f, f - width / 2, f + width / 2),
            "amplitude": (float(np.median(amplitude)), float(amplitude.min()), float(amplitude.max())),
        }
        nats = min(k_segments * np.log(strength) * len(channels), 1e4)
        end = float(session.recording.time[-1]) if stop == len(x) else theta["end"]
        alias = "" if abs(f - 50) < 0.6 or abs(f - 60) < 0.6 else _alias(f, rate)
        return [Finding(self, tuple(channels), theta, parameters, nats, theta["start"], end, float(np.exp(-min(nats, 700))),
                        note=f"a line {strength:.0f} times above the spectrum around it{alias}")]  # fmt: skip

    @staticmethod
    def _line(x, rate):
        """Strength, frequency, channels of the strongest narrow line, or None."""
        from scipy.signal import welch

        size = int(min(len(x), max(128, min(4 * rate, len(x) // 4))))
        f, power = welch(x, rate, nperseg=size, axis=0, detrend="linear")
        segments = max(1, 2 * len(x) // size - 1) * 0.75
        from scipy.ndimage import median_filter

        around = median_filter(power, size=(21, 1), mode="nearest")
        ratio = power / np.maximum(around, 1e-9)
        low = f > max(4 * rate / size, 0.5)
        limit = gamma.isf(1e-7 / len(f) / 19, segments) / segments * 1.5
        together = np.exp(np.log(np.maximum(ratio, 1e-9)).mean(1))
        hits = []
        wide = np.array([np.sum(together[max(i - 4, 0) : i + 5] > 0.4 * together[i]) for i in range(len(f))])
        for i in np.flatnonzero(low & (together > max(2.2, 1 + 8 / np.sqrt(segments * 19))) & (wide <= 5)):
            hits.append((together[i], f[i], tuple(range(19)), segments))
        for k in range(19):
            r = ratio[:, k]
            for i in np.flatnonzero(low & (r > max(limit, 4))):
                if np.sum(r[max(i - 4, 0) : i + 5] > 0.4 * r[i]) <= 5:
                    hits.append((r[i], f[i], (k,), segments))
        if not hits:
            return None
        top = max(hits)
        channels = sorted({k for r, g, ch, _ in hits if abs(g - top[1]) < 1.5 * rate / size for k in (ch if len(ch) == 1 else ())})
        common = [h for h in hits if len(h[2]) == 19 and abs(h[1] - top[1]) < 1.5 * rate / size]
        chosen = tuple(range(19)) if common or len(channels) > 12 else tuple(channels) or top[2]
        return top[0], top[1], chosen, segments

    def _wave(self, time, theta):
        on = (time >= theta["start"]) & (time < theta["end"])
        phase = 2 * np.pi * theta["frequency"] * (time - theta["origin"])
        return on[:, None] * (np.sin(phase)[:, None] * theta["weights"][0] + np.cos(phase)[:, None] * theta["weights"][1])

    def apply(self, counts, time, channels, theta):
        return counts + self._wave(time, theta)

    def correct(self, counts, time, channels, theta):
        return counts - self._wave(time, theta)


class Noise(RecordedEffect):
    id, name, stage, unit = "noise", "excess noise of single electrodes", "A", "times the law"
    physics = "an electrode's white noise is larger than the law min(15.8 (1 - E/4095), 6.6) counts scaled to the other electrodes"
    params = {"factor": Parameter("1", 1.8, 100, "a real sensor follows the law within 20 %")}
    confusable = {"hum": "a line in the spectrum", "spikes": "single samples"}

    def find(self, session):
        from ..sensor.channels import electrode_noise

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
                long = spans(excess > 2.5 * max(np.quantile(excess, 0.25), 0.3), edges, least=3) if not session.timeline().loaded else []
                if not long:
                    continue
                start, end = long[0]
                own = float(np.median(excess[(edges[:-1] >= start - 1e-9) & (edges[1:] <= end + 1e-9)]))
            n = len(cuts) * 60
            nats = min(0.1 * n * np.log(own) ** 2, 1e4)
            found.append(Finding(self, (int(k),), {}, {"factor": (float(own), np.nan, np.nan)}, nats, start, end, float(np.exp(-min(nats, 700))),  # noqa: E501
                                 note=f"{own:.1f} times as noisy as the other electrodes' law"))  # fmt: skip
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


def _stretches(n, rate):
    """The whole record, its halves, thirds and quarters."""
    least = max(256, int(2 * rate))
    out = [(0, n)]
    for parts in (2, 3, 4):
        edges = np.linspace(0, n, parts + 1).astype(int)
        out += [(edges[i], edges[j]) for i in range(parts) for j in range(i + 1, parts + 1) if (i, j) != (0, parts)]
    return [(a, b) for a, b in out if b - a >= least]


def _when(x, rate, f, channels, start, stop):
    """First and last row of the stretch about start..stop in which the line is there, from its amplitude in short windows."""
    size = int(max(64, min(2 * rate, (stop - start) // 6)))
    k = len(x) // size
    t = np.arange(size) / rate
    wave = np.exp(-2j * np.pi * f * t[:-1])
    y = np.diff(x[: k * size].reshape(k, size, -1)[:, :, list(channels)], axis=1)
    level = np.abs(np.einsum("i,kic->kc", wave * np.hanning(size - 1), y)).mean(1)
    inside = np.arange(k) * size
    known = (inside >= start) & (inside + size <= stop)
    if not known.any():
        return start, stop
    on = level > 0.5 * np.median(level[known])
    a, b = start // size, max(start // size + 1, stop // size)
    while a > 0 and on[max(a - 2, 0) : a].any():
        a -= 1
    while b < k and on[b : b + 2].any():
        b += 1
    while a < b - 2 and not on[a]:
        a += 1
    while b > a + 2 and not on[b - 1]:
        b -= 1
    return a * size, len(x) if b >= k else b * size


def _refine(x, rate, f, channels):
    """Frequency that explains most, with sine and cosine weights (2, channels)."""
    t = np.arange(len(x)) / rate
    y = np.diff(x[:, list(channels)], axis=0)  # differences take slow load out; a line stays a line

    def explained(g):
        phase = 2 * np.pi * g * t[:-1]
        basis = np.stack([np.sin(phase), np.cos(phase)], axis=1)
        w = 2 * basis.T @ y / len(y)
        return float((w**2).sum())

    width = max(0.25, rate / max(128, min(4 * rate, len(x) // 4)))
    grid = f + np.linspace(-width, width, int(min(801, 16 * width * len(x) / rate + 3)))
    best = max(grid, key=explained)
    fine = max(best + np.linspace(-1, 1, 41) * (grid[1] - grid[0]), key=explained)
    phase = 2 * np.pi * fine * t
    wave = np.stack([np.sin(phase), np.cos(phase)], axis=1)
    w, *_ = np.linalg.lstsq(np.diff(wave, axis=0), y, rcond=None)
    return float(fine), wave, w


def _alias(f, rate):
    for mains in (50, 60):
        for harmonic in (1, 2, 3):
            folded = abs(mains * harmonic - rate * round(mains * harmonic / rate))
            if abs(folded - f) < 0.3:
                return f"; {mains * harmonic} Hz mains folded at {rate:.4g} Hz would be {folded:.2f} Hz"
    return ""
