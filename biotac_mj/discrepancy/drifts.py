"""Effects that develop over the record: the shared impedance gain (warm-up), other common changes, drift or gain of single electrodes."""

import numpy as np

from .recorded_effect import Finding, Parameter, RecordedEffect
from .recording import counts_of, log_impedance
from .shapes import ShapeFit, correlation_length, evaluate_shape, fit_shapes

__all__ = ["CountGain", "CountOffset", "Drift", "GainChange", "SharedGain", "Thermal"]

_LENGTH = Parameter("s", 0.1, 1e5, "the record; warm-up of real sensors: minutes (Mongeon 2015, finger_force_control)")
_ONSET = Parameter("s", 0, 1e6, "the record")


class TimeShaped(RecordedEffect):
    """ln Z += pattern * level(t), the level a step, a ramp, an exponential or a pulse."""

    unit = "counts"
    kinds = ("exponential", "ramp", "step")

    def apply(self, counts, time, channels, theta):
        return counts_of(log_impedance(counts) + np.outer(self._level(time, theta), theta["pattern"]))

    def correct(self, counts, time, channels, theta):
        return counts_of(log_impedance(counts) - np.outer(self._level(time, theta), theta["pattern"]))

    @staticmethod
    def _level(time, theta):
        if theta["kind"] == "ramp":  # keeps its slope beyond the part that was fitted
            return theta["amplitude"] * np.maximum(time - theta["onset"], 0) / theta["length"]
        return theta["amplitude"] * evaluate_shape(theta["kind"], time, theta["onset"], theta["tau"], theta["end"])

    def _finding(self, session, line, pattern, shape, channels):
        full = np.zeros(19)
        full[line.used] = pattern
        length = line.time[-1] - line.time[0]
        end = shape.end if shape.kind == "pulse" else np.inf
        theta = {
            "kind": shape.kind,
            "onset": shape.onset,
            "tau": shape.tau,
            "end": end,
            "amplitude": shape.amplitude,
            "pattern": full,
            "length": length,
        }
        if shape.onset <= line.time[0] + 1e-9:
            theta["onset"] = 0.0
        low, high = shape.interval.get("amplitude", (np.nan, np.nan))
        parameters = {"amplitude": (shape.amplitude, low, high)}
        reach = self._level(np.array([line.time[0], line.time[-1]]), theta)
        parameters["change"] = (reach[1] - reach[0] if shape.kind != "pulse" else shape.amplitude, np.nan, np.nan)
        if shape.kind == "exponential":
            parameters["tau"] = (shape.tau, *shape.interval.get("tau", (np.nan, np.nan)))
        if shape.onset > line.time[0] + 1e-9:
            parameters["onset"] = (shape.onset, *shape.interval.get("onset", (np.nan, np.nan)))
        slope = np.abs(np.median(_counts_per_log(session.counts), axis=0))
        sizes = np.abs(shape.amplitude * full) * slope * (np.ptp(evaluate_shape(shape.kind, line.time, shape.onset, shape.tau, shape.end)))
        parameters["counts"] = (float(np.median(sizes[list(channels)])), np.nan, np.nan)
        note = {"exponential": "levels off exponentially", "ramp": "goes on steadily", "step": "jumps", "pulse": "comes and goes"}[
            shape.kind
        ]
        stop = end if np.isfinite(end) else float(session.recording.time[-1])
        found = Finding(
            self, channels, theta, parameters, shape.nats, theta["onset"], stop, float(np.exp(-min(shape.nats, 700))), note=note
        )
        found.theta["shape"] = shape
        return found

    def statistic(self, session, line, finding):
        """Root mean square of the pattern's amplitude about the level of the part fitted [ln Z]."""
        return line.amplitude(finding.theta["pattern"][line.used])


class _Common(TimeShaped):
    def pattern(self, counts):
        raise NotImplementedError

    def find(self, session):
        line = session.timeline()
        pattern = self.pattern(np.exp(np.median(np.log(np.clip(session.counts[session.fit], 1, 4094)), axis=0)))[line.used]
        series, sd = line.amplitude(pattern)
        kinds = self.kinds if line.loaded else (*self.kinds, "pulse")
        shape = None if line.loaded else self._jump_of_all(line, pattern, session.known_jumps)
        shape = shape or fit_shapes(line.time, series, kinds, floor=sd * 0.1)
        if shape is None:
            return []
        late = line.loaded and (shape.kind == "step" or shape.onset > line.time[0])
        if shape.nats < (20 if late else 12 if line.loaded else 8):
            return []
        found = self._finding(session, line, pattern, shape, tuple(int(k) for k in line.used))
        if found.parameters["counts"][0] < max(1.0, 0.1 * np.median(line.noise) * 1000):
            return []
        if not line.loaded:
            # Unloaded every electrode shows its own amplitude of the same shape: do they follow the pattern?
            column = evaluate_shape(shape.kind, line.time, shape.onset, shape.tau, shape.end)
            column = column - column.mean()
            if shape.kind == "step" and shape.neff == len(line.time):  # a jump: its own change, free of slow drift
                own = line.jump_at(int(np.argmin(np.abs(line.time - shape.onset))), session.known_jumps)
            else:
                own = column @ (line.value - line.value.mean(0)) / (column @ column)
            # A few electrodes may have something of their own besides: they are not asked.
            ratio = own / pattern
            middle = np.median(ratio)
            inside = np.abs(ratio - middle) < 0.2 * abs(middle) + 4 * line.noise / np.sqrt(column @ column) / pattern
            if inside.sum() < max(8, 0.7 * len(pattern)):
                return []
            agreement = abs(float(own[inside] @ pattern[inside] / np.linalg.norm(own[inside]) / np.linalg.norm(pattern[inside])))
            if agreement < 0.93:
                return []
            fit = pattern * (own[inside] @ pattern[inside]) / (pattern[inside] @ pattern[inside])
            factor = float(np.mean(fit / pattern) / shape.amplitude) if abs(shape.amplitude) > 0 else 1.0
            shape.amplitude *= factor
            if "amplitude" in shape.interval:
                shape.interval["amplitude"] = tuple(sorted(v * factor for v in shape.interval["amplitude"]))
            found = self._finding(session, line, pattern, shape, tuple(int(k) for k in line.used))
            if agreement > 0.98 and self.id == "warmup":  # the electrodes' own shares, a few per cent about the pattern, belong to it
                share = np.where(inside, own / np.mean(fit / pattern), pattern)
                found = self._finding(session, line, share, shape, tuple(int(k) for k in line.used))
                found.parameters["spread"] = (float(np.std(share[inside] / pattern[inside])), np.nan, np.nan)
            noise = np.sqrt((line.noise**2) / (column @ column))
            found.theta["misfit"] = float(((((own - fit) / np.hypot(noise, 0.02 * np.abs(fit))) ** 2)[inside]).sum())
            found.note += f"; electrodes' own amplitudes agree with the pattern to {agreement:.4f} (cosine)"
        else:
            found.theta["misfit"] = -2 * shape.nats
        return [found]

    @staticmethod
    def _jump_of_all(line, pattern, known):
        """A step that all electrodes make within a bin, or None; unloaded, where nothing else moves."""
        at, step, w = line.jumps(known)
        if not len(at):
            return None
        size = np.median(step / pattern, axis=1)
        alike = (np.abs(step - size[:, None] * pattern) < 0.4 * np.abs(size[:, None] * pattern) + 4 * line.noise * np.sqrt(2 / w)).mean(1)
        score = np.where(alike > 0.8, np.abs(size) / (np.median(line.noise) * np.sqrt(2 / w) / 2), 0)
        i = int(np.argmax(score))
        # A slow drift changes within a window too: a jump stands out of its surroundings.
        if score[i] < 12 or abs(size[i]) < 8 * np.median(np.abs(size)):
            return None
        time, half = float(line.time[at[i]]), float(np.median(line.noise)) * np.sqrt(2 / w)
        value = float(np.median(line.jump_at(at[i], known) / pattern))
        return ShapeFit("step", time, 0.0, np.inf, value, 0.0, float(min(0.5 * score[i] ** 2, 400)), half, len(line.time), 1.0,
                        {"amplitude": (value - half, value + half), "onset": (time - line.period, time + line.period)})  # fmt: skip


class SharedGain(_Common):
    id, name, stage = "warmup", "shared impedance gain (warm-up)", "T"
    physics = "all impedances are multiplied by one factor that changes with time: the liquid's conductivity while the sensor warms up"
    params = {
        "amplitude": Parameter("ln Z", -1, 1, "-0.23 measured on an unloaded sensor over 190 s; Mongeon 2015: 10-17 % of full scale"),
        "tau": _LENGTH,
        "onset": _ONSET,
    }
    confusable = {
        "thermal": "log TDC", "count_offset": "electrodes with very different rest counts", "drift": "one electrode or all",
        "load": "a free segment at both ends of the record",
    }  # fmt: skip

    def pattern(self, counts):
        return np.ones(19)


class _InCounts(_Common):
    """Patterns that are exact in counts, not in ln Z: theta["counts"] holds the factor from level to counts."""

    multiplies = False

    def _finding(self, session, line, pattern, shape, channels):
        found = super()._finding(session, line, pattern, shape, channels)
        counts = np.median(session.counts[session.fit], axis=0)[line.used]
        mass = (counts if self.multiplies else 1) / np.abs(_counts_per_log(counts))
        found.theta["counts"] = -1 / float(mass.mean())
        return found

    def apply(self, counts, time, channels, theta):
        change = theta["counts"] * self._level(time, theta)[:, None]
        return np.clip(counts * (1 + change) if self.multiplies else counts + change, 0, 4095)

    def correct(self, counts, time, channels, theta):
        change = theta["counts"] * self._level(time, theta)[:, None]
        return np.clip(counts / np.maximum(1 + change, 0.05) if self.multiplies else counts - change, 0, 4095)


class CountOffset(_InCounts):
    id, name, stage = "count_offset", "common offset in counts (reference voltage)", "A"
    physics = "all channels move by the same number of counts: reference or ground of the converter"
    params = {
        "amplitude": Parameter("relative to the mean electrode, ln Z", -1, 1, "up to some hundred counts"),
        "tau": _LENGTH,
        "onset": _ONSET,
    }
    confusable = {"warmup": "electrodes with very different rest counts", "count_gain": "the same"}

    def pattern(self, counts):
        v = 1 / np.abs(_counts_per_log(counts))
        return v / v.mean()


class CountGain(_InCounts):
    multiplies = True
    id, name, stage = "count_gain", "common gain in counts (amplifier, excitation)", "A"
    physics = "all counts are multiplied by one factor: amplifier or excitation amplitude"
    params = {"amplitude": Parameter("relative to the mean electrode, ln Z", -1, 1, "some per cent"), "tau": _LENGTH, "onset": _ONSET}
    confusable = {"warmup": "electrodes with very different rest counts", "count_offset": "the same"}

    def pattern(self, counts):
        v = counts / np.abs(_counts_per_log(counts))
        return v / v.mean()


class Drift(TimeShaped):
    id, name, stage = "drift", "drift or step of single electrodes", "A"
    physics = "one electrode moves away from what the others say: drifting or jumping offset of its channel"
    params = {
        "amplitude": Parameter("ln Z", -2, 2, "up to hundreds of counts (warm-up tables, Mongeon 2015)"),
        "tau": _LENGTH,
        "onset": _ONSET,
    }
    confusable = {"gain": "load the electrode before and after: an offset does not scale with the signal", "warmup": "one electrode or all"}

    def find(self, session):
        line = session.timeline()
        kinds = self.kinds if line.loaded else (*self.kinds, "pulse")
        best = None
        slope = np.abs(np.median(_counts_per_log(session.counts), axis=0))[line.used]
        common = max(
            (f.parameters["counts"][0] for f in session.findings if isinstance(f.effect, _Common) and "counts" in f.parameters), default=0.0
        )
        for k in _whole_electrodes(session, line):
            unit = np.zeros(len(line.used))
            unit[k] = 1
            series, sd = line.amplitude(unit)
            through = line.explained_by_others(k) if line.loaded else None
            if through is not None:
                series = through(line.value[:, k] - line.value[:, k].mean())
                sd = max(series.std(), line.noise[k])
            shape = fit_shapes(line.time, series, kinds, tests=len(line.used), floor=sd * 0.1, through=through)
            if shape is None or shape.nats < (15 if line.loaded else 8):
                continue
            if line.loaded and shape.nats < 20:
                continue
            size = abs(shape.amplitude) * slope[k] * np.ptp(evaluate_shape(shape.kind, line.time, shape.onset, shape.tau, shape.end))
            floor = max(2.0, 0.7 * line.noise[k] * np.sqrt(line.width) * slope[k])
            # Real electrodes share a gain to 3 %: what is left of it is no drift of their own.
            if size < max(floor, 0.12 * common) or (line.loaded and (shape.explained < 0.3 or size < 3 * floor)):
                continue
            energy = np.sum((series - series.mean()) ** 2) * shape.explained / sd**2
            if best is None or energy > best[0]:
                best = energy, k, unit, shape
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
        score = np.where(lone, order[:, -1], 0)
        i = int(np.argmax(score))
        k = int(np.argmax(z[i]))
        slope = np.abs(np.median(_counts_per_log(session.counts), axis=0))[line.used][k]
        if score[i] < 10 or abs(alone[i, k]) * slope < 15:
            return []
        time = float(line.time[at[i]])
        unit = np.zeros(c)
        unit[k] = 1
        half = 2 * float(line.noise[k]) / np.sqrt(w) + 0.5 * float(moving[i])
        value = float(alone[i, k]) if line.loaded else float(line.jump_at(at[i], known)[k])
        shape = ShapeFit("step", time, 0.0, np.inf, value, 0.0, float(min(0.5 * score[i] ** 2 - np.log(n * c), 200)), half, n, 1.0,
                         {"amplitude": (value - half, value + half), "onset": (time - line.period, time + line.period)})  # fmt: skip
        found = self._finding(session, line, unit, shape, (int(line.used[k]),))
        found.ties = ("gain",)
        found.note += f"; the other electrodes stand still meanwhile ({abs(value) * slope:.0f} counts)"
        return [found]


class GainChange(RecordedEffect):
    id, name, stage, unit = "gain", "per-electrode gain change", "A", "relative gain"
    physics = "from some time on one electrode's response to load is multiplied by a factor"
    params = {"gain": Parameter("1", -0.95, 3, "manufacturing scatter 3-15 %, damage more"), "onset": _ONSET}
    confusable = {"drift": "load the electrode before and after", "saturate": "depth ladder at one place"}

    def find(self, session):
        line = session.timeline()
        if not line.loaded:
            return []
        best, alone = None, {}
        n = len(line.time)
        cuts = np.unique(np.linspace(0.04 * n, 0.96 * n, 48).astype(int))
        for k in _whole_electrodes(session, line):
            through = line.explained_by_others(k)
            residual = through(line.value[:, k] - np.median(line.value[:, k]))
            signal = line.value[:, k] - np.median(line.value[:, k]) - residual
            if signal.std() < 4 * line.noise[k]:
                continue
            for start, stop in [(c, n) for c in cuts] + [(a, b) for i, a in enumerate(cuts[::4]) for b in cuts[::4][i + 1 :]]:
                on = np.zeros(n)
                on[start:stop] = 1
                share = (stop - start) / n
                if not 0.1 < share < 0.9 or min(signal[on > 0].std(), signal[on == 0].std()) < 0.4 * signal.std():
                    continue  # a gain shows where the load changes, on both sides
                base = np.ones((n, 1))
                more = np.concatenate([base, through(np.stack([on, on * signal], axis=1))], axis=1)
                rss0, _ = _least_squares(base, residual)
                rss1, w = _least_squares(more, residual)
                alone[k] = max(alone.get(k, 0.0), float(np.log(rss0 / rss1)))
                if best is None or rss0 / rss1 > best[0]:
                    best = rss0 / rss1, k, start, stop, w, rss1, residual, signal, more
        if best is None:
            return []
        ratio, k, start, stop, w, rss1, residual, signal, more = best
        neff = max(4.0, n / correlation_length(residual - more @ w))
        nats = 0.5 * neff * np.log(ratio) - 2 * np.log(neff) - np.log(19) - 3
        gain = float(w[2])
        # Where the place of a contact bends the relations, several electrodes seem to change: a gain is one electrode's.
        shared = max((v for i, v in alone.items() if i != k), default=0.0) > 0.6 * alone[k]
        if nats < 25 or ratio < 1.6 or shared or not 0.08 < abs(gain) < 1.2:
            return []
        covariance = np.linalg.pinv(more.T @ more) * rss1 / n * n / neff
        half = 1.96 * float(np.sqrt(covariance[2, 2]))
        whole = stop >= n
        first = float(line.time[start] - line.period / 2)
        last = float(session.recording.time[-1]) if whole else float(line.time[stop - 1] + line.period / 2)
        channel = int(line.used[k])
        rest = float(np.median(line.value[:, k]))
        shift = float(w[1])
        theta = {"ratio": ratio, "gain": gain, "rest": rest, "start": first, "end": np.inf if whole else last, "shift": shift}
        parameters = {"gain": (gain, gain - half, gain + half), "onset": (first, first - 2 * line.period, first + 2 * line.period)}
        note = f"its response to load changes by {gain:+.0%} against what the other electrodes say"
        return [Finding(self, (channel,), theta, parameters, nats, first, last, float(np.exp(-min(nats, 700))), note=note)]

    def apply(self, counts, time, channels, theta):
        return self._scale(counts, time, channels, theta, 1 + theta["gain"], theta["shift"], False)

    def correct(self, counts, time, channels, theta):
        return self._scale(counts, time, channels, theta, 1 / max(1 + theta["gain"], 0.05), theta["shift"], True)

    @staticmethod
    def _scale(counts, time, channels, theta, factor, shift, inverse):
        out = counts.copy()
        rows = (time >= theta["start"]) & (time < theta["end"])
        z = log_impedance(counts[rows, channels[0]]) - theta["rest"]
        out[rows, channels[0]] = counts_of(theta["rest"] + ((z - shift) * factor if inverse else z * factor + shift))
        return out


class Thermal(_Common):
    id, name, stage = "thermal", "temperature dependence of conductivity", "T"
    physics = "all impedances follow the core's temperature, with a lag"
    params = {
        "slope": Parameter("ln Z per C", -0.15, 0.0, "-0.064..-0.078 over five sensors; salt solutions -0.014..-0.028"),
        "lag": Parameter("s", 0, 300, "liquid and thermistor 0.3-10 s; the core lags the liquid"),
    }
    confusable = {"warmup": "heater on and off: temperature goes back, age does not"}

    def find(self, session):
        recording = session.recording
        if recording.tdc is None:
            return []
        line = session.timeline()
        series, _ = line.amplitude(np.ones(len(line.used)))
        temperature = self.temperature(recording)
        if np.ptp(temperature[session.fit]) < 0.2:
            return []
        best = None
        for lag in (0.0, 0.5, 1, 2, 4, 8, 16, 32, 64, 128):
            x = np.interp(line.time, recording.time, _lagged(temperature, lag, recording.rate))
            design = np.stack([np.ones(len(x)), x], axis=1)
            rss, w = _least_squares(design, series)
            if best is None or rss < best[0]:
                best = rss, lag, w, design
        rss, lag, w, design = best
        total = np.sum((series - series.mean()) ** 2)
        neff = max(4.0, len(series) / correlation_length(series - design @ w))
        nats = 0.5 * neff * np.log(total / max(rss, 1e-30)) - np.log(neff) - 2
        if nats < 10:
            return []
        half = 1.96 * np.sqrt(rss / neff / max(design[:, 1].var(), 1e-12) / 1.0)
        theta = {"slope": float(w[1]), "lag": lag, "temperature": temperature, "rate": recording.rate, "reference": float(temperature[0]),
                 "pattern": np.ones(19)}  # fmt: skip
        parameters = {"slope": (float(w[1]), float(w[1] - half), float(w[1] + half)), "lag": (lag, np.nan, np.nan)}
        return [Finding(self, tuple(int(k) for k in line.used), theta, parameters, nats, 0.0, float(recording.time[-1]), float(np.exp(-min(nats, 700))),  # noqa: E501
                        ties=("warmup",), note="the common change follows TDC")]  # fmt: skip

    @staticmethod
    def temperature(recording):
        from ..sensor.channels import temperature_from_counts

        return temperature_from_counts(np.clip(recording.tdc, 1, 4094))

    @staticmethod
    def _level(time, theta):
        lagged = _lagged(theta["temperature"], theta["lag"], theta["rate"]) - theta["reference"]
        return theta["slope"] * np.interp(time, np.arange(len(lagged)) / theta["rate"], lagged)


def _whole_electrodes(session, line):
    """Places in `line.used` of electrodes without clipped or stuck samples: what those hide must not be taken for a drift."""
    return [i for i, k in enumerate(line.used) if session.masked[session.fit, k].mean() < 0.03]


def _counts_per_log(counts):
    """dE / d ln Z of raw counts (negative)."""
    return -counts * (1 - counts / 4095)


def _least_squares(design, x):
    w, *_ = np.linalg.lstsq(design, x, rcond=None)
    residual = x - design @ w
    return float(residual @ residual) + 1e-30, w


def _lagged(x, lag, rate):
    """First-order low-pass with time constant `lag` [s]."""
    if lag <= 0:
        return x
    from scipy.signal import lfilter

    a = np.exp(-1 / (lag * rate))
    return lfilter([1 - a], [1, -a], x, zi=[a * x[0]])[0]
