"""Effects that develop over the record in all electrodes: the shared impedance gain (warm-up), temperature,
changes in counts."""

import abc
import typing

import numpy as np

from ....sensor.channels import counts_from_log_impedance, log_impedance
from ..shapes import ShapeFit, correlation_length, evaluate_shape, fit_shapes
from .effect import Finding, Parameter, RecordedEffect

if typing.TYPE_CHECKING:
    from ..recording import Recording
    from ..timeline import Timeline

__all__ = [
    "LENGTH",
    "ONSET",
    "Common",
    "CountGain",
    "CountOffset",
    "SharedGain",
    "Thermal",
    "TimeShaped",
    "counts_per_log",
    "least_squares",
]

LENGTH = Parameter(
    "s", 0.1, 1e5, "the record; warm-up of real sensors: minutes (Mongeon 2015, finger_force_control)"
)
ONSET = Parameter("s", 0, 1e6, "the record")


class TimeShaped(RecordedEffect):
    """ln Z += pattern * level(t), the level a step, a ramp, an exponential or a pulse."""

    unit = "counts"
    kinds = ("exponential", "ramp", "step")

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        return counts_from_log_impedance(
            log_impedance(counts) + np.outer(self._level(time, theta), theta["pattern"])
        )

    def correct(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        return counts_from_log_impedance(
            log_impedance(counts) - np.outer(self._level(time, theta), theta["pattern"])
        )

    @staticmethod
    def _level(time, theta):
        if theta["kind"] == "ramp":  # keeps its slope beyond the part that was fitted
            return theta["amplitude"] * np.maximum(time - theta["onset"], 0) / theta["length"]
        return theta["amplitude"] * evaluate_shape(
            theta["kind"], time, theta["onset"], theta["tau"], theta["end"]
        )

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
        parameters["change"] = (
            reach[1] - reach[0] if shape.kind != "pulse" else shape.amplitude,
            np.nan,
            np.nan,
        )
        if shape.kind == "exponential":
            parameters["tau"] = (shape.tau, *shape.interval.get("tau", (np.nan, np.nan)))
        if shape.onset > line.time[0] + 1e-9:
            parameters["onset"] = (shape.onset, *shape.interval.get("onset", (np.nan, np.nan)))
        slope = np.abs(np.median(counts_per_log(session.counts), axis=0))
        sizes = (
            np.abs(shape.amplitude * full)
            * slope
            * (np.ptp(evaluate_shape(shape.kind, line.time, shape.onset, shape.tau, shape.end)))
        )
        parameters["counts"] = (float(np.median(sizes[list(channels)])), np.nan, np.nan)
        note = {
            "exponential": "levels off exponentially",
            "ramp": "goes on steadily",
            "step": "jumps",
            "pulse": "comes and goes",
        }[shape.kind]
        stop = end if np.isfinite(end) else float(session.recording.time[-1])
        found = Finding(
            self,
            channels,
            theta,
            parameters,
            shape.nats,
            theta["onset"],
            stop,
            float(np.exp(-min(shape.nats, 700))),
            note=note,
        )
        found.theta["shape"] = shape
        return found

    def statistic(self, session: typing.Any, line: "Timeline", finding: Finding) -> tuple[np.ndarray, float]:
        """Root mean square of the pattern's amplitude about the level of the part fitted [ln Z]."""
        return line.amplitude(finding.theta["pattern"][line.used])


class Common(TimeShaped):
    @abc.abstractmethod
    def pattern(self, counts: np.ndarray) -> np.ndarray:
        """(19,) change of ln Z of each electrode for an amplitude of one, at these counts."""

    def find(self, session: typing.Any) -> list:
        line = session.timeline()
        pattern = self.pattern(
            np.exp(np.median(np.log(np.clip(session.counts[session.fit], 1, 4094)), axis=0))
        )[line.used]
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
            if shape.kind == "step" and shape.neff == len(
                line.time
            ):  # a jump: its own change, free of slow drift
                own = line.jump_at(int(np.argmin(np.abs(line.time - shape.onset))), session.known_jumps)
            else:
                own = column @ (line.value - line.value.mean(0)) / (column @ column)
            # A few electrodes may have something of their own besides: they are not asked.
            ratio = own / pattern
            middle = np.median(ratio)
            inside = (
                np.abs(ratio - middle)
                < 0.2 * abs(middle) + 4 * line.noise / np.sqrt(column @ column) / pattern
            )
            if inside.sum() < max(8, 0.7 * len(pattern)):
                return []
            agreement = abs(
                float(
                    own[inside]
                    @ pattern[inside]
                    / np.linalg.norm(own[inside])
                    / np.linalg.norm(pattern[inside])
                )
            )
            if not agreement >= 0.93:  # nan: none of it in the electrodes
                return []
            fit = pattern * (own[inside] @ pattern[inside]) / (pattern[inside] @ pattern[inside])
            factor = float(np.mean(fit / pattern) / shape.amplitude) if abs(shape.amplitude) > 0 else 1.0
            shape.amplitude *= factor
            if "amplitude" in shape.interval:
                shape.interval["amplitude"] = tuple(sorted(v * factor for v in shape.interval["amplitude"]))
            found = self._finding(session, line, pattern, shape, tuple(int(k) for k in line.used))
            if (
                agreement > 0.98 and self.id == "warmup"
            ):  # the electrodes' own shares, a few per cent about the pattern, belong to it
                share = np.where(inside, own / np.mean(fit / pattern), pattern)
                found = self._finding(session, line, share, shape, tuple(int(k) for k in line.used))
                found.parameters["spread"] = (float(np.std(share[inside] / pattern[inside])), np.nan, np.nan)
            noise = np.sqrt((line.noise**2) / (column @ column))
            found.theta["misfit"] = float(
                ((((own - fit) / np.hypot(noise, 0.02 * np.abs(fit))) ** 2)[inside]).sum()
            )
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
        alike = (
            np.abs(step - size[:, None] * pattern)
            < 0.4 * np.abs(size[:, None] * pattern) + 4 * line.noise * np.sqrt(2 / w)
        ).mean(1)
        score = np.where(alike > 0.8, np.abs(size) / (np.median(line.noise) * np.sqrt(2 / w) / 2), 0)
        i = int(np.argmax(score))
        # A slow drift changes within a window too: a jump stands out of its surroundings.
        if score[i] < 12 or abs(size[i]) < 8 * np.median(np.abs(size)):
            return None
        time, half = float(line.time[at[i]]), float(np.median(line.noise)) * np.sqrt(2 / w)
        value = float(np.median(line.jump_at(at[i], known) / pattern))
        return ShapeFit(
            "step",
            time,
            0.0,
            np.inf,
            value,
            0.0,
            float(min(0.5 * score[i] ** 2, 400)),
            half,
            len(line.time),
            1.0,
            {"amplitude": (value - half, value + half), "onset": (time - line.period, time + line.period)},
        )


class SharedGain(Common):
    id, name, stage = "warmup", "shared impedance gain (warm-up)", "T"
    physics = (
        "all impedances are multiplied by one factor that changes with time: the liquid's "
        "conductivity while the sensor warms up"
    )
    params = {
        "amplitude": Parameter(
            "ln Z",
            -1,
            1,
            "-0.23 measured on an unloaded sensor over 190 s; Mongeon 2015: 10-17 % of full scale",
        ),
        "tau": LENGTH,
        "onset": ONSET,
    }
    confusable = {
        "thermal": "log TDC",
        "count_offset": "electrodes with very different rest counts",
        "drift": "one electrode or all",
        "load": "a free segment at both ends of the record",
    }

    def pattern(self, counts: np.ndarray) -> np.ndarray:
        return np.ones(19)


class _InCounts(Common):
    """Patterns that are exact in counts, not in ln Z: theta["counts"] holds the factor from level to
    counts."""

    multiplies = False

    def _finding(self, session, line, pattern, shape, channels):
        found = super()._finding(session, line, pattern, shape, channels)
        counts = np.median(session.counts[session.fit], axis=0)[line.used]
        mass = (counts if self.multiplies else 1) / np.abs(counts_per_log(counts))
        found.theta["counts"] = -1 / float(mass.mean())
        return found

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        change = theta["counts"] * self._level(time, theta)[:, None]
        return np.clip(counts * (1 + change) if self.multiplies else counts + change, 0, 4095)

    def correct(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        change = theta["counts"] * self._level(time, theta)[:, None]
        return np.clip(counts / np.maximum(1 + change, 0.05) if self.multiplies else counts - change, 0, 4095)


class CountOffset(_InCounts):
    id, name, stage = "count_offset", "common offset in counts (reference voltage)", "A"
    physics = "all channels move by the same number of counts: reference or ground of the converter"
    params = {
        "amplitude": Parameter("relative to the mean electrode, ln Z", -1, 1, "up to some hundred counts"),
        "tau": LENGTH,
        "onset": ONSET,
    }
    confusable = {"warmup": "electrodes with very different rest counts", "count_gain": "the same"}

    def pattern(self, counts: np.ndarray) -> np.ndarray:
        v = 1 / np.abs(counts_per_log(counts))
        return v / v.mean()


class CountGain(_InCounts):
    multiplies = True
    id, name, stage = "count_gain", "common gain in counts (amplifier, excitation)", "A"
    physics = "all counts are multiplied by one factor: amplifier or excitation amplitude"
    params = {
        "amplitude": Parameter("relative to the mean electrode, ln Z", -1, 1, "some per cent"),
        "tau": LENGTH,
        "onset": ONSET,
    }
    confusable = {"warmup": "electrodes with very different rest counts", "count_offset": "the same"}

    def pattern(self, counts: np.ndarray) -> np.ndarray:
        v = counts / np.abs(counts_per_log(counts))
        return v / v.mean()


class Thermal(TimeShaped):
    id, name, stage = "thermal", "temperature dependence of conductivity", "T"
    physics = "all impedances follow the core's temperature, with a lag"
    params = {
        "slope": Parameter(
            "ln Z per C", -0.15, 0.0, "-0.064..-0.078 over five sensors; salt solutions -0.014..-0.028"
        ),
        "lag": Parameter("s", 0, 300, "liquid and thermistor 0.3-10 s; the core lags the liquid"),
    }
    confusable = {"warmup": "heater on and off: temperature goes back, age does not"}

    def find(self, session: typing.Any) -> list:
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
            rss, w = least_squares(design, series)
            if best is None or rss < best[0]:
                best = rss, lag, w, design
        rss, lag, w, design = best
        total = np.sum((series - series.mean()) ** 2)
        neff = max(4.0, len(series) / correlation_length(series - design @ w))
        nats = 0.5 * neff * np.log(total / max(rss, 1e-30)) - np.log(neff) - 2
        if nats < 10:
            return []
        half = 1.96 * np.sqrt(rss / neff / max(design[:, 1].var(), 1e-12) / 1.0)
        theta = {
            "slope": float(w[1]),
            "lag": lag,
            "temperature": temperature,
            "rate": recording.rate,
            "reference": float(temperature[0]),
            "pattern": np.ones(19),
        }
        parameters = {
            "slope": (float(w[1]), float(w[1] - half), float(w[1] + half)),
            "lag": (lag, np.nan, np.nan),
        }
        return [
            Finding(
                self,
                tuple(int(k) for k in line.used),
                theta,
                parameters,
                nats,
                0.0,
                float(recording.time[-1]),
                float(np.exp(-min(nats, 700))),
                ties=("warmup",),
                note="the common change follows TDC",
            )
        ]

    @staticmethod
    def temperature(recording: "Recording") -> np.ndarray:
        from ....sensor.channels import temperature_from_counts

        return temperature_from_counts(np.clip(recording.tdc, 1, 4094))

    @staticmethod
    def _level(time, theta):
        lagged = _lagged(theta["temperature"], theta["lag"], theta["rate"]) - theta["reference"]
        return theta["slope"] * np.interp(time, np.arange(len(lagged)) / theta["rate"], lagged)


def counts_per_log(counts: np.ndarray) -> np.ndarray:
    """dE / d ln Z of raw counts (negative)."""
    return -counts * (1 - counts / 4095)


def least_squares(design: np.ndarray, x: np.ndarray) -> tuple[float, np.ndarray]:
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
