"""A periodic disturbance: its line in the spectrum, when it is there, and how it is taken out."""

from typing import Any

import numpy as np
from scipy.stats import gamma

from .effect import Finding, Parameter, RecordedEffect

__all__ = ["Hum"]

_LEAST = 25.0  # nats: a weak line of a single electrode comes and goes in real recordings


class Hum(RecordedEffect):
    id, name, stage, unit = "hum", "mains hum or another periodic disturbance", "A", "counts"
    physics = "A sin(2 pi f t): mains, its alias, or a machine"
    params = {
        "amplitude": Parameter("counts", 0.3, 500, "1-10 counts"),
        "frequency": Parameter("Hz", 0.2, 2000, "up to half the rate"),
    }
    confusable = {"noise": "noise has no line in its spectrum"}

    def find(self, session: Any) -> list:
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
        theta = {
            "frequency": f,
            "weights": full,
            "start": 0.0 if whole else (offset + start) / rate,
            "end": np.inf if stop == len(x) else (offset + stop) / rate,
            "origin": (offset + start) / rate,
        }
        width = 0.5 / ((stop - start) / rate)
        parameters = {
            "frequency": (f, f - width / 2, f + width / 2),
            "amplitude": (float(np.median(amplitude)), float(amplitude.min()), float(amplitude.max())),
        }
        nats = min(k_segments * np.log(strength) * len(channels), 1e4)
        if nats < _LEAST:
            return []
        end = float(session.recording.time[-1]) if stop == len(x) else theta["end"]
        alias = "" if abs(f - 50) < 0.6 or abs(f - 60) < 0.6 else _alias(f, rate)
        return [
            Finding(
                self,
                tuple(channels),
                theta,
                parameters,
                nats,
                theta["start"],
                end,
                float(np.exp(-min(nats, 700))),
                note=f"a line {strength:.0f} times above the spectrum around it{alias}",
            )
        ]

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
        channels = sorted(
            {
                k
                for r, g, ch, _ in hits
                if abs(g - top[1]) < 1.5 * rate / size
                for k in (ch if len(ch) == 1 else ())
            }
        )
        common = [h for h in hits if len(h[2]) == 19 and abs(h[1] - top[1]) < 1.5 * rate / size]
        chosen = tuple(range(19)) if common or len(channels) > 12 else tuple(channels) or top[2]
        return top[0], top[1], chosen, segments

    def _wave(self, time, theta):
        on = (time >= theta["start"]) & (time < theta["end"])
        phase = 2 * np.pi * theta["frequency"] * (time - theta["origin"])
        return on[:, None] * (
            np.sin(phase)[:, None] * theta["weights"][0] + np.cos(phase)[:, None] * theta["weights"][1]
        )

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        return counts + self._wave(time, theta)

    def correct(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        return counts - self._wave(time, theta)


def _stretches(n, rate):
    """The whole record, its halves, thirds and quarters."""
    least = max(256, int(2 * rate))
    out = [(0, n)]
    for parts in (2, 3, 4):
        edges = np.linspace(0, n, parts + 1).astype(int)
        out += [
            (edges[i], edges[j])
            for i in range(parts)
            for j in range(i + 1, parts + 1)
            if (i, j) != (0, parts)
        ]
    return [(a, b) for a, b in out if b - a >= least]


def _when(x, rate, f, channels, start, stop):
    """First and last row of the stretch about start..stop in which the line is there, from its amplitude in
    short windows."""
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
