"""Drift, jump or changed gain of single electrodes: what one of them does and the others do not."""

import typing

import numpy as np

from ....sensor.channels import counts_from_log_impedance, log_impedance
from ..shapes import ShapeFit, correlation_length, evaluate_shape, fit_shapes
from .drifts import LENGTH, ONSET, Common, TimeShaped, counts_per_log, least_squares
from .effect import Finding, Parameter, RecordedEffect

if typing.TYPE_CHECKING:
    from ..timeline import Timeline

__all__ = ["Drift", "GainChange"]

# Nats under load. The place of a contact wanders too and bends the electrodes' relations, on recordings
# without effect up to 82 nats' worth (practice seeds); a fault stands out of what the other electrodes seem
# to do.
_SLOW, _ALONE = 90.0, 2.0
_STAYS, _GOES = 50.0, 80.0  # a gain that changes and stays so; one that comes and goes
# [s] a jump of a channel stays; what comes back sooner was a place pressed only then, or a loose contact
_COMES_BACK = 10.0
_STAYED = 0.4  # of the jump


class Drift(TimeShaped):
    id, name, stage = "drift", "drift or step of single electrodes", "A"
    physics = "one electrode moves away from what the others say: drifting or jumping offset of its channel"
    params = {
        "amplitude": Parameter("ln Z", -2, 2, "up to hundreds of counts (warm-up tables, Mongeon 2015)"),
        "tau": LENGTH,
        "onset": ONSET,
    }
    confusable = {
        "gain": "load the electrode before and after: an offset does not scale with the signal",
        "warmup": "one electrode or all",
    }

    def find(self, session: typing.Any) -> list:
        line = session.timeline()
        kinds = self.kinds if line.loaded else (*self.kinds, "pulse")
        best, evidence = None, {}
        slope = np.abs(np.median(counts_per_log(session.counts), axis=0))[line.used]
        common = max(
            (
                f.parameters["counts"][0]
                for f in session.findings
                if isinstance(f.effect, Common) and "counts" in f.parameters
            ),
            default=0.0,
        )
        for k in whole_electrodes(session, line):
            unit = np.zeros(len(line.used))
            unit[k] = 1
            series, sd = line.amplitude(unit)
            through = line.explained_by_others(k) if line.loaded else None
            if through is not None:
                series = through(line.value[:, k] - line.value[:, k].mean())
                sd = max(series.std(), line.noise[k])
            shape = fit_shapes(
                line.time, series, kinds, tests=len(line.used), floor=sd * 0.1, through=through
            )
            evidence[k] = 0.0 if shape is None else shape.nats
            if shape is None or shape.nats < (_SLOW if line.loaded else 8):
                continue
            size = (
                abs(shape.amplitude)
                * slope[k]
                * np.ptp(evaluate_shape(shape.kind, line.time, shape.onset, shape.tau, shape.end))
            )
            floor = max(2.0, 0.7 * line.noise[k] * np.sqrt(line.width) * slope[k])
            # Real electrodes share a gain to 3 %: what is left of it is no drift of their own.
            if size < max(floor, 0.12 * common) or (
                line.loaded and (shape.explained < 0.3 or size < 3 * floor)
            ):
                continue
            energy = np.sum((series - series.mean()) ** 2) * shape.explained / sd**2
            if best is None or energy > best[0]:
                best = energy, k, unit, shape
        if (
            best
            and line.loaded
            and best[3].nats < _ALONE * max((v for k, v in evidence.items() if k != best[1]), default=0.0)
        ):
            best = None
        if best is None or not line.loaded:
            jump = self._jump(session, line)
            if jump and (best is None or jump[0].nats > 50):
                return jump
        if best is None:
            return []
        _, k, unit, shape = best
        found = self._finding(session, line, unit, shape, (int(line.used[k]),))
        if not line.loaded:
            found.ties = ("gain",)  # without load an offset and a gain of the channel look alike
            found.note += "; unloaded, an offset and a gain of the channel look alike"
        return [found]

    def _jump(self, session, line):
        """One electrode changes its level from one second to the next while the others stand still."""
        known = session.known_jumps
        at, step, w = line.jumps(known)
        if not len(at):
            return []
        n, c = line.value.shape
        P = np.linalg.inv(line.covariance)
        alone = step @ P / np.diag(P)
        moving = np.sqrt((np.sort(np.abs(step), axis=1)[:, : c - 2] ** 2).mean(1))
        z = np.abs(alone) / np.hypot(line.noise * np.sqrt(2 / w), 0.5 * moving[:, None])
        order = np.sort(z, axis=1)
        lone = order[:, -2] < 0.35 * order[:, -1]
        whole = whole_electrodes(session, line)
        score = np.where(lone & np.isin(z.argmax(1), whole), order[:, -1], 0)
        slopes = np.abs(np.median(counts_per_log(session.counts), axis=0))[line.used]
        for _ in range(4):
            i = int(np.argmax(score))
            k = int(np.argmax(z[i]))
            slope = slopes[k]
            if score[i] < 10 or abs(alone[i, k]) * slope < 15:
                return []
            if not line.loaded or _lasts(line, k, at[i], alone[i, k]):
                break
            session.events[int(line.used[k]), round(float(line.time[at[i]]))] = float(
                abs(alone[i, k]) * slope
            )
            score[np.abs(at - at[i]) * line.period < _COMES_BACK] = 0
        else:
            return []
        time = float(line.time[at[i]])
        unit = np.zeros(c)
        unit[k] = 1
        half = 2 * float(line.noise[k]) / np.sqrt(w) + 0.5 * float(moving[i])
        value = float(alone[i, k]) if line.loaded else float(line.jump_at(at[i], known)[k])
        shape = ShapeFit(
            "step",
            time,
            0.0,
            np.inf,
            value,
            0.0,
            float(min(0.5 * score[i] ** 2 - np.log(n * c), 200)),
            half,
            n,
            1.0,
            {"amplitude": (value - half, value + half), "onset": (time - line.period, time + line.period)},
        )
        found = self._finding(session, line, unit, shape, (int(line.used[k]),))
        found.ties = ("gain",)
        found.note += f"; the other electrodes stand still meanwhile ({abs(value) * slope:.0f} counts)"
        return [found]


def _lasts(line, k, row, value):
    """Whether electrode used[k], departing by `value` [ln Z] at bin `row`, stays where it went, by what the
    others say."""
    departure = line.explained_by_others(k)(line.value[:, k] - line.value[:, k].mean())
    reach, gap = int(_COMES_BACK / line.period), int(round(0.6 / line.period))
    before, after = departure[max(row - reach, 0) : max(row - gap, 1)], departure[row + gap : row + reach]
    return len(after) > 2 and (np.median(after) - np.median(before)) / value > _STAYED


class GainChange(RecordedEffect):
    id, name, stage, unit = "gain", "per-electrode gain change", "A", "relative gain"
    physics = "from some time on one electrode's response to load is multiplied by a factor"
    params = {"gain": Parameter("1", -0.95, 3, "manufacturing scatter 3-15 %, damage more"), "onset": ONSET}
    confusable = {"drift": "load the electrode before and after", "saturate": "depth ladder at one place"}

    def find(self, session: typing.Any) -> list:
        line = session.timeline()
        if not line.loaded:
            return []
        best, alone = None, {}
        n = len(line.time)
        cuts = np.unique(np.linspace(0.04 * n, 0.96 * n, 48).astype(int))
        for k in whole_electrodes(session, line):
            through = line.explained_by_others(k)
            residual = through(line.value[:, k] - np.median(line.value[:, k]))
            signal = line.value[:, k] - np.median(line.value[:, k]) - residual
            if signal.std() < 4 * line.noise[k]:
                continue
            for start, stop in [(c, n) for c in cuts] + [
                (a, b) for i, a in enumerate(cuts[::4]) for b in cuts[::4][i + 1 :]
            ]:
                on = np.zeros(n)
                on[start:stop] = 1
                share = (stop - start) / n
                if (
                    not 0.1 < share < 0.9
                    or min(signal[on > 0].std(), signal[on == 0].std()) < 0.4 * signal.std()
                ):
                    continue  # a gain shows where the load changes, on both sides
                base = np.ones((n, 1))
                more = np.concatenate([base, through(np.stack([on, on * signal], axis=1))], axis=1)
                rss0, _ = least_squares(base, residual)
                rss1, w = least_squares(more, residual)
                alone[k] = max(alone.get(k, 0.0), float(np.log(rss0 / rss1)))
                if best is None or rss0 / rss1 > best[0]:
                    best = rss0 / rss1, k, start, stop, w, rss1, residual, signal, more
        if best is None:
            return []
        ratio, k, start, stop, w, rss1, residual, signal, more = best
        neff = max(4.0, n / correlation_length(residual - more @ w))
        nats = 0.5 * neff * np.log(ratio) - 2 * np.log(neff) - np.log(19) - 3
        gain = float(w[2])
        # Where the place of a contact bends the relations, several electrodes seem to change: a gain is one
        # electrode's.
        shared = max((v for i, v in alone.items() if i != k), default=0.0) > 0.6 * alone[k]
        if nats < (_STAYS if stop >= n else _GOES) or ratio < 1.6 or shared or not 0.08 < abs(gain) < 1.2:
            return []
        covariance = np.linalg.pinv(more.T @ more) * rss1 / n * n / neff
        half = 1.96 * float(np.sqrt(covariance[2, 2]))
        whole = stop >= n
        first = float(line.time[start] - line.period / 2)
        last = float(session.recording.time[-1]) if whole else float(line.time[stop - 1] + line.period / 2)
        channel = int(line.used[k])
        rest = float(np.median(line.value[:, k]))
        shift = float(w[1])
        theta = {
            "ratio": ratio,
            "gain": gain,
            "rest": rest,
            "start": first,
            "end": np.inf if whole else last,
            "shift": shift,
        }
        parameters = {
            "gain": (gain, gain - half, gain + half),
            "onset": (first, first - 2 * line.period, first + 2 * line.period),
        }
        note = f"its response to load changes by {gain:+.0%} against what the other electrodes say"
        return [
            Finding(
                self,
                (channel,),
                theta,
                parameters,
                nats,
                first,
                last,
                float(np.exp(-min(nats, 700))),
                note=note,
            )
        ]

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        return self._scale(counts, time, channels, theta, 1 + theta["gain"], theta["shift"], False)

    def correct(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        return self._scale(
            counts, time, channels, theta, 1 / max(1 + theta["gain"], 0.05), theta["shift"], True
        )

    @staticmethod
    def _scale(counts, time, channels, theta, factor, shift, inverse):
        out = counts.copy()
        rows = (time >= theta["start"]) & (time < theta["end"])
        z = log_impedance(counts[rows, channels[0]]) - theta["rest"]
        out[rows, channels[0]] = counts_from_log_impedance(
            theta["rest"] + ((z - shift) * factor if inverse else z * factor + shift)
        )
        return out


def whole_electrodes(session: typing.Any, line: "Timeline") -> list[int]:
    """Places in `line.used` of electrodes without clipped or stuck samples: what those hide must not be taken
    for a drift."""
    return [i for i, k in enumerate(line.used) if session.masked[session.fit, k].mean() < 0.03]
