"""Shapes over time (step, ramp, exponential, pulse) fitted to one series, with evidence that knows the series
is not white."""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np

__all__ = ["ShapeFit", "correlation_length", "evaluate_shape", "fit_shapes"]


@functools.lru_cache(maxsize=4)
def _dictionary(n, first, last, kinds, onsets):
    """Labels (kind, onset, tau, end), centred columns (n, m) and their powers (m,) of all shapes to try."""
    t, length = np.linspace(first, last, n), last - first
    grid = (
        t[np.unique(np.linspace(max(2, n * 0.02), n * 0.97, 60).astype(int))]
        if onsets is None
        else np.asarray(onsets)
    )
    labels = []
    for kind in kinds:
        if kind == "exponential":
            start = np.concatenate([[t[0]], grid[::3]]) if onsets is None else grid
            taus = length * np.geomspace(0.01, 4, 14)
            labels += [
                (kind, o, tau, t[-1]) for o in start for tau in taus if o + 0.5 * tau < t[-1] or o == t[0]
            ]
        elif kind == "ramp":
            labels += [
                (kind, o, 0.0, t[-1])
                for o in (np.concatenate([[t[0]], grid[::2]]) if onsets is None else grid)
            ]
        elif kind == "step":
            labels += [(kind, o, 0.0, t[-1]) for o in grid]
        else:
            labels += [(kind, a, 0.0, b) for i, a in enumerate(grid[::2]) for b in grid[::2][i + 1 :]]
    columns = np.stack([evaluate_shape(k, t, o, tau, e) for k, o, tau, e in labels], axis=1)
    columns -= columns.mean(0)
    return labels, columns, (columns**2).sum(0)


@dataclasses.dataclass
class ShapeFit:
    """value(t) = level + amplitude * shape(t; onset, tau, end).

    Attributes:
      kind: "step", "ramp", "exponential" or "pulse"; onset, end, tau [s]; amplitude, level in the series'
        unit.
      nats: log-likelihood gained, of effectively independent samples, less the price of the parameters.
      sd: of the residual; neff: independent samples; explained: share of the variance.
      interval: name -> (low, high), 95 %.
    """

    kind: str
    onset: float
    tau: float
    end: float
    amplitude: float
    level: float
    nats: float
    sd: float
    neff: float
    explained: float
    interval: dict


def evaluate_shape(kind: str, t: np.ndarray, onset: float, tau: float, end: float) -> np.ndarray:
    """(n,) the unit shape at times t (n,) [s]."""
    since = np.maximum(t - onset, 0)
    if kind == "step":
        return (t >= onset).astype(float)
    if kind == "pulse":
        return ((t >= onset) & (t < end)).astype(float)
    if kind == "ramp":
        return since / max(t[-1] - t[0], 1e-9)
    return 1 - np.exp(-since / tau)


def correlation_length(residual: np.ndarray) -> float:
    """Samples per independent sample: 1 + 2 sum of autocorrelations up to the first that is not positive."""
    x = residual - residual.mean()
    n, power = len(x), float(x @ x)
    if power <= 0:
        return 1.0
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(x, size)) ** 2
    rho = np.fft.irfft(spectrum)[: n // 3] / power
    stop = np.flatnonzero(rho <= 0.05)
    return float(1 + 2 * rho[1 : stop[0] if len(stop) else len(rho)].sum())


def fit_shapes(
    t: np.ndarray,
    x: np.ndarray,
    kinds: Sequence[str] = ("exponential", "ramp", "step", "pulse"),
    onsets: np.ndarray | None = None,
    tests: int = 1,
    floor: float = 0.0,
    through: Callable[[np.ndarray], np.ndarray] | None = None,
) -> ShapeFit | None:
    """The best shape, or None where the constant does as well.

    Args:
      t: (n,) [s]; x: (n,). kinds: which shapes. onsets: times to try [s], None a grid over the record.
      tests: how many series are looked at: its logarithm is part of the price. floor: noise of x known
        beforehand.
      through: a linear function that x has been through and shapes have to go through, such as
        `Timeline.explained_by_others`.
    """
    n, length = len(t), t[-1] - t[0]
    labels, columns, power = _dictionary(
        n, float(t[0]), float(t[-1]), tuple(kinds), None if onsets is None else tuple(onsets)
    )
    if through is not None:
        columns = through(columns)
        columns = columns - columns.mean(0)
        # a shape that the others mimic is not found here
        power = np.maximum((columns**2).sum(0), 0.02 * power)
    centred = x - x.mean()
    total = float(centred @ centred)
    if total <= 0:
        return None
    drop = np.where(power > 1e-9, (columns.T @ centred) ** 2 / np.maximum(power, 1e-9), 0)
    # A pulse has one parameter more than the others: it must earn it.
    price = np.array([{"pulse": 3, "exponential": 3, "ramp": 2, "step": 2}[label[0]] for label in labels])
    best, chosen = -np.inf, None
    for kind in kinds:
        rows = [i for i, label in enumerate(labels) if label[0] == kind]
        # What begins with the record is the simpler story: a later onset has to be worth it.
        early = [i for i in rows if kind in ("exponential", "ramp") and labels[i][1] <= t[0]]
        later = [i for i in rows if i not in set(early)]
        for group, extra in ((early, 0.0), (later, 6.0 if early else 0.0)):
            if not group:
                continue
            i = group[int(np.argmax(drop[group]))]
            onset, tau, end = _polish(kind, t, centred, labels[i], length, through)
            shape = evaluate_shape(kind, t, onset, tau, end)
            seen = shape if through is None else through(shape)
            design = np.stack([np.ones(n), seen], axis=1)
            (level, amplitude), *_ = np.linalg.lstsq(design, x, rcond=None)
            residual = x - design @ [level, amplitude]
            rss = float(residual @ residual) + n * floor**2 * 1e-3
            neff = min(n, max(4.0, n / correlation_length(residual)))
            nats = (
                0.5 * neff * np.log(total / max(rss, 1e-30))
                - 0.5 * price[i] * np.log(neff)
                - np.log(tests)
                - 1.5
                - extra
            )
            if nats > best + (1.0 if chosen else 0.0):
                best = nats
                chosen = ShapeFit(
                    kind, onset, tau, end, amplitude, level, nats, np.sqrt(rss / n), neff, 1 - rss / total, {}
                )
    if chosen is None or chosen.nats <= 0:
        return None
    chosen.interval = _intervals(t, x, chosen, through)
    return chosen


def _polish(kind, t, x, label, length, through=None):
    """Local refinement of onset, tau, end by coordinate search on the explained variance."""
    _, onset, tau, end = label
    step = t[1] - t[0]
    values = {"onset": onset, "tau": tau, "end": end}
    moves = {
        "step": ["onset"],
        "pulse": ["onset", "end"],
        "ramp": ["onset"],
        "exponential": ["tau", "onset"],
    }[kind]
    if kind in ("ramp", "exponential") and onset <= t[0]:
        moves = [m for m in moves if m != "onset"]

    def explained(v):
        c = evaluate_shape(kind, t, v["onset"], v["tau"], v["end"])
        c = c if through is None else through(c)
        c = c - c.mean()
        power = c @ c
        return (c @ x) ** 2 / power if power > 1e-9 else 0.0

    now = explained(values)
    size = {"onset": length / 60, "end": length / 60, "tau": 0.4}
    for _ in range(40):
        improved = False
        for name in moves:
            for sign in (1, -1):
                trial = dict(values)
                if name == "tau":
                    trial[name] = float(
                        np.clip(values[name] * np.exp(sign * size[name]), 0.002 * length, 20 * length)
                    )
                else:
                    trial[name] = float(np.clip(values[name] + sign * size[name], t[0], t[-1]))
                if trial["end"] <= trial["onset"]:
                    continue
                value = explained(trial)
                if value > now * (1 + 1e-12):
                    values, now, improved = trial, value, True
        if not improved:
            size = {k: v / 2 for k, v in size.items()}
            if size["onset"] < step / 4 and size["tau"] < 1e-3:
                break
    return values["onset"], values["tau"], values["end"]


def _intervals(t, x, fit, through=None):
    """95 % intervals by linearisation, the residual's correlation in its scale; a step's onset by its
    profile."""
    base = {"amplitude": fit.amplitude, "tau": fit.tau, "onset": fit.onset, "end": fit.end}
    names = {
        "exponential": ["amplitude", "tau"],
        "ramp": ["amplitude"],
        "step": ["amplitude"],
        "pulse": ["amplitude"],
    }[fit.kind]
    if fit.kind in ("exponential", "ramp") and fit.onset > t[0]:
        names.append("onset")
    columns = [np.ones(len(t))]
    for name in names:
        h = {
            "amplitude": 1e-3 * (abs(fit.amplitude) + 1e-12),
            "tau": 1e-3 * max(fit.tau, 1e-9),
            "onset": 1e-3 * (t[-1] - t[0]),
        }[name]
        side = []
        for sign in (1, -1):
            v = {**base, name: base[name] + sign * h}
            side.append(v["amplitude"] * evaluate_shape(fit.kind, t, v["onset"], v["tau"], v["end"]))
        columns.append((side[0] - side[1]) / (2 * h))
    design = np.stack(columns, axis=1)
    if through is not None:
        design[:, 1:] = through(design[:, 1:])
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-30)
    normal = np.linalg.pinv((design / scale).T @ (design / scale), rcond=1e-10)
    sd = fit.sd * np.sqrt(np.diag(normal) * len(t) / fit.neff) / scale
    interval = {name: (base[name] - 1.96 * s, base[name] + 1.96 * s) for name, s in zip(names, sd[1:])}
    if fit.kind in ("step", "pulse"):
        slack = 2 * (t[1] - t[0]) * (1 + (fit.sd / max(abs(fit.amplitude), 1e-12)) ** 2)
        for name in ("onset", "end")[: 2 if fit.kind == "pulse" else 1]:
            interval[name] = (base[name] - slack, base[name] + slack)
    if "tau" in interval:
        interval["tau"] = (max(interval["tau"][0], 0.0), interval["tau"][1])
    return interval
