"""Effects of single samples: stuck, frozen, clipped, coarse, spiked and swapped channels."""

from typing import Any

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

from ...noise import noise_level
from .effect import Finding, Parameter, RecordedEffect, runs, spans

__all__ = ["Freeze", "Quantise", "Saturate", "Spikes", "Stuck", "Swap"]

_NAN = float("nan")


class Stuck(RecordedEffect):
    id, name, stage, unit = "stuck", "stuck channel", "A", "s"
    physics = "an electrode repeats one count although its noise would change it: broken contact or driver"
    params = {"value": Parameter("counts", 0, 4095, "12-bit range")}
    confusable = {"saturate": "press harder: a stuck channel does not leave its value at all"}

    def find(self, session: Any) -> list:
        rows = np.flatnonzero(session.fit)
        return self.search(session, rows[0], rows[-1] + 1)

    def search(self, session: Any, first: int, last: int) -> list:
        found, rate = [], session.recording.rate
        x = session.recording.electrodes[first:last]
        whole = _frozen_rows(x, rate)
        repeat = np.array([_repeat_share(c) for c in x.T])
        # What the other electrodes do too (a filtered or coarse recording stands still at times) is no fault
        # of one.
        longest = np.array([runs(c)[1].max() for c in x.T])
        usual = float(np.median(longest[longest < 0.5 * len(x)])) if (longest < 0.5 * len(x)).any() else 1.0
        coarse = {k for f in session.findings if f.id == "quantise" for k in f.channels}
        for k in range(19):
            if k in coarse:
                continue
            p = repeat[k] if repeat[k] < 0.95 else np.median(repeat)
            if p > 0.9:
                continue  # without noise a constant reading is no news
            limit = max(10, 0.25 * rate, 4 * usual, np.log(1e-9 / len(x)) / np.log(max(p, 0.02)))
            start, length = runs(x[:, k])
            long = [(s, n) for s, n in zip(start, length) if n >= limit and not whole[s : s + n].mean() > 0.5]
            if not long or self._is_clip(x[:, k], long):
                continue
            mask = np.zeros(len(session.counts), bool)
            for s, n in long:
                mask[first + s : first + s + n] = True
            total = sum(n for _, n in long)
            s, n = max(long, key=lambda item: item[1])
            value = float(x[s, k])
            found.append(
                Finding(
                    self,
                    (k,),
                    {"mask": mask, "value": value},
                    {"value": (value, value, value)},
                    -total * np.log(max(p, 0.02)),
                    (first + long[0][0]) / rate,
                    (first + long[-1][0] + long[-1][1]) / rate,
                    p=float(max(p, 0.02) ** min(n, 200)),
                    note=f"{total / rate:.1f} s without any change; chance repeats {p:.0%} of samples",
                )
            )
        return found

    @staticmethod
    def _is_clip(x, long):
        """Runs at one end of the channel's range are clipping, unless they are most of the record."""
        if np.ptp(x) < 6 or sum(n for _, n in long) > 0.8 * len(x):
            return False
        return all(x[s] == x.max() for s, _ in long) or all(x[s] == x.min() for s, _ in long)

    def mask(self, counts: np.ndarray, time: np.ndarray, finding: Finding) -> np.ndarray:
        mask = np.zeros(counts.shape, bool)
        mask[:, finding.channels[0]] = finding.theta["mask"]
        return mask

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        out = counts.copy()
        out[theta["mask"], channels[0]] = theta["value"]
        return out


class Freeze(RecordedEffect):
    id, name, stage, unit = "freeze", "frozen log (all channels repeat: bus or logger dropout)", "A", "s"
    physics = "whole rows repeat for longer than a bus slower than the logger explains"
    params = {"seconds": Parameter("s", 0.1, 1e4, "longer than any bus period")}
    confusable = {"stuck": "one channel or all"}

    def find(self, session: Any) -> list:
        rows = np.flatnonzero(session.fit)
        return self.search(session, rows[0], rows[-1] + 1)

    def search(self, session: Any, first: int, last: int) -> list:
        rate = session.recording.rate
        whole = _frozen_rows(session.recording.electrodes[first:last], rate)
        if not whole.any():
            return []
        mask = np.zeros(len(session.counts), bool)
        mask[first:last] = whole
        where = np.flatnonzero(mask)
        seconds = whole.sum() / rate
        return [
            Finding(
                self,
                tuple(range(19)),
                {"mask": mask},
                {"seconds": (seconds, seconds, seconds)},
                20.0 + seconds,
                where[0] / rate,
                where[-1] / rate,
                p=0.0,
                note=f"{seconds:.1f} s of rows repeat the one before in all electrodes",
            )
        ]

    def mask(self, counts: np.ndarray, time: np.ndarray, finding: Finding) -> np.ndarray:
        return np.repeat(finding.theta["mask"][:, None], 19, axis=1)


class Saturate(RecordedEffect):
    id, name, stage, unit = (
        "saturate",
        "clipping (saturation of channels)",
        "A",
        "share of samples on the limit",
    )
    physics = "samples pile up on the largest or smallest value: converter or amplifier at its limit"
    params = {"level": Parameter("counts", 0, 4095, "12-bit range")}
    confusable = {
        "stuck": "a clipped channel leaves the limit when the load goes back",
        "gain": "depth ladder at one place",
    }

    def find(self, session: Any) -> list:
        hits = {}
        x = session.recording.electrodes[session.fit]
        free = ~session.masked[session.fit]
        for k in range(19):
            column = x[free[:, k], k]
            if len(column) < 100 or np.ptp(column) < 3:
                continue
            for side in (1, -1):
                level, mass, expected = _edge_mass(side * column)
                if mass >= max(15, 0.002 * len(column)) and mass > 6 * expected + 10:
                    hits.setdefault((side, round(level * side)), []).append(
                        (k, mass / len(column), mass, expected)
                    )
        found = []
        for (side, level), group in hits.items():
            channels = tuple(g[0] for g in group)
            at = np.flatnonzero((session.recording.electrodes[:, channels] == level).any(1) & session.fit)
            mass, expected = sum(g[2] for g in group), sum(max(g[3], 0.5) for g in group)
            found.append(
                Finding(
                    self,
                    channels,
                    {"level": float(level), "side": side},
                    {"level": (float(level), level - 0.5, level + 0.5)},
                    min(mass * np.log(mass / expected), 1e4),
                    at[0] / session.recording.rate,
                    at[-1] / session.recording.rate,
                    p=0.0,
                    note=f"{np.mean([g[1] for g in group]):.1%} of the samples lie on {level}, the "
                    f"{'largest' if side > 0 else 'smallest'} value",
                )
            )
        return found

    def mask(self, counts: np.ndarray, time: np.ndarray, finding: Finding) -> np.ndarray:
        level, side = finding.theta["level"], finding.theta["side"]
        mask = np.zeros(counts.shape, bool)
        columns = list(finding.channels)
        mask[:, columns] = side * counts[:, columns] >= side * level
        return mask

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        out = counts.copy()
        limit = np.minimum if theta["side"] > 0 else np.maximum
        out[:, list(channels)] = limit(out[:, list(channels)], theta["level"])
        return out


class Quantise(RecordedEffect):
    id, name, stage, unit = "quantise", "coarse quantisation", "A", "counts"
    physics = "values lie on multiples of more than one count: fewer bits, or a rounding logger"
    params = {"step": Parameter("counts", 2, 512, "3 to 11 of 12 bits")}
    confusable = {"stuck": "a coarse channel still takes several values"}

    def find(self, session: Any) -> list:
        rows = np.flatnonzero(session.fit)
        edges = np.linspace(rows[0], rows[-1] + 1, 25).astype(int)
        x = session.recording.electrodes
        if np.any(x[rows] != np.rint(x[rows])):
            return []
        whole = np.array([_lattice(x[rows, k]) for k in range(19)])
        rate = session.recording.rate
        if np.mean(whole >= 2) > 0.8:
            return [
                self._finding(
                    tuple(range(19)),
                    float(np.median(whole)),
                    0.0,
                    float(session.recording.time[-1]) + 1,
                    50.0,
                )
            ]
        step = np.array([[_lattice(x[a:b, k]) for k in range(19)] for a, b in zip(edges[:-1], edges[1:])])
        coarse = step >= 2
        found = []
        common = coarse.mean(1) > 0.8
        if common.any():
            for start, end in spans(common, edges / rate):
                inside = (edges[:-1] / rate >= start - 1e-9) & (edges[1:] / rate <= end + 1e-9)
                value = float(np.median(step[inside][coarse[inside]]))
                found.append(self._finding(tuple(range(19)), value, start, end, 50.0))
            return found
        for k in range(19):
            for start, end in spans(coarse[:, k], edges / rate, least=4):
                found.append(self._finding((k,), float(np.median(step[coarse[:, k], k])), start, end, 30.0))
        return found

    def _finding(self, channels, value, start, end, nats):
        note = f"every value is a multiple of {value:g} counts (up to an offset)"
        return Finding(
            self,
            channels,
            {"step": value, "start": start, "end": end},
            {"step": (value, value, value)},
            nats,
            start,
            end,
            0.0,
            note=note,
        )

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        out = counts.copy()
        rows = np.ix_((time >= theta["start"]) & (time < theta["end"]), channels)
        out[rows] = theta["step"] * np.rint(out[rows] / theta["step"])
        return out


class Spikes(RecordedEffect):
    id, name, stage, unit = "spikes", "spikes or dropouts of single samples", "A", "per minute"
    physics = "a few samples leave the trace and come back at once: bit errors, loose contact"
    params = {"rate": Parameter("1/min", 0, 6000, "up to every tenth sample")}
    confusable = {"noise": "noise is there in every sample"}

    def find(self, session: Any) -> list:
        rows = np.flatnonzero(session.fit)
        x = session.recording.electrodes[rows[0] : rows[-1] + 1]
        bad = np.zeros(session.counts.shape, bool)
        bad[rows[0] : rows[-1] + 1] = self.flag(x)
        bad &= ~session.masked
        count = bad.sum(0)
        minutes = len(x) / session.recording.rate / 60
        channels = tuple(np.flatnonzero(count >= 4))
        if not channels:
            return []
        at = np.flatnonzero(bad[:, channels].any(1)) / session.recording.rate
        value = float(count[list(channels)].sum() / minutes)
        return [
            Finding(
                self,
                channels,
                {},
                {"rate": (value, _NAN, _NAN)},
                10.0 * count.sum(),
                at[0],
                at[-1],
                0.0,
                note=f"{int(count.sum())} samples leave their neighbours by more than ten times the noise",
            )
        ]

    @staticmethod
    def flag(x: np.ndarray) -> np.ndarray:
        middle = median_filter(x, size=(7, 1), mode="nearest")
        off = np.abs(x - middle)
        before, after = np.roll(middle, 6, axis=0), np.roll(middle, -6, axis=0)
        # lively stretches leave the median by more
        around = uniform_filter1d(np.minimum(off, 200), 101, axis=0, mode="nearest")
        return (off > np.maximum(np.maximum(10 * noise_level(x), 25), 10 * around)) & (
            np.abs(before - after) < 0.3 * off
        )

    def mask(self, counts: np.ndarray, time: np.ndarray, finding: Finding) -> np.ndarray:
        mask = np.zeros(counts.shape, bool)
        columns = list(finding.channels)
        mask[:, columns] = self.flag(counts)[:, columns]
        return mask


class Swap(RecordedEffect):
    id, name, stage, unit = "swap", "swapped channels", "A", "log ratio of misfits"
    physics = "from some time on two electrodes carry each other's signal: cable or channel order"
    params = {"onset": Parameter("s", 0, 1e6, "the record")}
    confusable = {"gain": "a swap changes two channels at once, each to the other's level"}

    def find(self, session: Any) -> list:
        line = session.timeline()
        found = (None if line.loaded else self._exchanged(line, session)) or self._best(line, session)
        return [found] if found else []

    def _exchanged(self, line, session):
        """Unloaded: two electrodes take each other's level from one bin to the next."""
        at, step, w = line.jumps()
        best = None
        for i in np.argsort(-np.abs(step).max(1) if len(at) else np.zeros(0))[:40]:
            before, after = (
                line.value[at[i] - w : at[i]].mean(0),
                line.value[at[i] + 1 : at[i] + w + 1].mean(0),
            )
            a, b = np.argsort(-np.abs(step[i]))[:2]
            moved = abs(step[i, a]) + abs(step[i, b])
            left = abs(after[a] - before[b]) + abs(after[b] - before[a])
            slack = 6 * (line.noise[a] + line.noise[b]) / np.sqrt(w)
            if moved > 5 * slack and left < 0.1 * moved + slack and (best is None or moved > best[0]):
                best = moved, int(at[i]), int(a), int(b)
        if best is None:
            return None
        _, cut, a, b = best
        # The row itself: as it stands fits before it, exchanged after it.
        rate, pair = session.recording.rate, [int(line.used[a]), int(line.used[b])]
        first = max(int((line.time[cut] - 2 * line.period) * rate), 20)
        x = session.counts[first : int((line.time[cut] + 2 * line.period) * rate), pair]
        level = np.median(session.counts[first - 20 : first, pair], axis=0)
        cost = np.abs(x - level).sum(1) - np.abs(x - level[::-1]).sum(1)
        onset = (first + int(np.argmin(np.cumsum(cost))) + 1 - 0.5) / rate
        end = float(session.recording.time[-1])
        return Finding(self, tuple(int(line.used[k]) for k in (a, b)), {"start": onset, "end": end + 1},
                       {"onset": (onset, onset - line.period, onset + line.period)}, 100.0, onset, end, 0.0,
                       note="each takes the other's level from one moment to the next")  # fmt: skip

    def _best(self, line, session):
        z, t = line.value, line.time
        n, c = z.shape
        best = None
        for cut in np.unique(np.linspace(0.05 * n, 0.95 * n, 46).astype(int)):
            late = cut > n / 2  # the longer side says what is normal
            gap = max(2, n // 40)  # the change may lie a little beside the cut
            before, after = z[: max(cut - gap, 1)], z[cut + gap :]
            normal, other = (before, after) if late else (after, before)
            if len(other) < 8 or len(normal) < 3 * c:
                continue
            cov = (np.cov(normal.T) if line.loaded else line.covariance) + np.diag(line.noise**2 + 1e-8)
            P = np.linalg.inv(cov)
            mean = normal.mean(0)
            d = other - mean
            rows = ((d @ P) * d).sum(1)
            now = float(np.median(rows))
            raw = [(a, b) for a in range(c) for b in range(a + 1, c)]
            for a, b in raw:
                # two columns change places: the change of the quadratic form, only these columns are touched
                shift = other[:, b] - other[:, a]
                delta = 2 * shift * (d @ P[:, a] - d @ P[:, b]) + shift**2 * (P[a, a] + P[b, b] - 2 * P[a, b])
                after = float(np.median(rows + delta))
                ratio = np.log(max(now, 1e-9) / max(after, 1e-9))
                gain = 0.5 * c * ratio * min(len(other), len(normal)) / 8
                if ratio > 0.7 and (best is None or gain > best[0]):
                    best = gain, cut, late, a, b, ratio, after
        if best is None or best[0] < 20 or best[6] > (12 if line.loaded else 4) * c:
            return None
        gain, cut, late, a, b, ratio, _ = best
        onset = self._onset(z, t, a, b, cut, late, line)
        start, end = (onset, float(session.recording.time[-1])) if late else (0.0, onset)
        channels = tuple(int(line.used[i]) for i in (a, b))
        return Finding(
            self,
            channels,
            {"start": start, "end": end + (1 if late else 0)},
            {"onset": (onset, onset - line.period * 3, onset + line.period * 3)},
            gain,
            start,
            end,
            0.0,
            note=f"with the two exchanged the misfit of that part falls by a factor {np.exp(ratio):.3g}",
        )

    @staticmethod
    def _onset(z, t, a, b, cut, late, line):
        """The time at which exchanging the two turns from worse to better."""
        gap = max(2, len(t) // 40)
        pair = z[:, [a, b]]
        normal = pair[: cut - gap] if late else pair[cut + gap :]
        mean, sd = np.median(normal, axis=0), np.std(normal, axis=0) + line.noise[[a, b]]
        cost = ((((pair - mean) / sd) ** 2) - (((pair[:, ::-1] - mean) / sd) ** 2)).sum(1)
        cost = np.clip(cost, -50, 50)
        inside = slice(max(cut - 2 * gap, 0), min(cut + 2 * gap, len(t)))
        # as it stands is right before the onset, exchanged after it (or the other way round)
        total = np.cumsum(cost[inside])
        at = int(np.argmin(total) if late else np.argmax(total)) + inside.start
        return float(t[min(at, len(t) - 1)] + line.period / 2)

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        out = counts.copy()
        rows = (time >= theta["start"]) & (time < theta["end"])
        a, b = channels
        out[rows, a], out[rows, b] = counts[rows, b], counts[rows, a]
        return out

    correct = apply


def _repeat_share(x):
    """Share of samples equal to the one before, outside long runs."""
    start, length = runs(x)
    short = length[length <= 12]
    return float((short - 1).sum() / max(short.sum(), 1)) if len(short) > 5 else 1.0


def _frozen_rows(x, rate):
    same = np.concatenate([[False], (np.diff(x, axis=0) == 0).all(1)])
    if same.mean() > 0.98:
        return np.zeros(len(x), bool)
    start, length = runs(same.astype(int))
    typical = np.quantile(length[same[start]], 0.9) if same.any() else 0
    out = np.zeros(len(x), bool)
    for s, n in zip(start, length):
        if same[s] and n >= max(0.25 * rate, 6 * typical, 8):
            out[s : s + n] = True
    return out


def _edge_mass(x):
    """Largest value, how many samples have it, and the mean number on the next five values below."""
    values, count = np.unique(x, return_counts=True)
    if len(values) < 6:
        return values[-1], 0, np.inf
    near = values[-6:-1] >= values[-1] - 12 * max(np.median(np.diff(values)), 1)
    return values[-1], int(count[-1]), float(count[-6:-1][near].mean()) if near.any() else 0.0


def _lattice(x):
    """Greatest common step of integer values, 1 where there are too few values to tell."""
    values = np.unique(x.astype(int))
    if len(values) < 4:
        return 1
    return int(np.gcd.reduce(np.diff(values)))
