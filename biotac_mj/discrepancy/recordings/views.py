"""Views of a recording: numbers that a model says without having been given them; and which amendments each
view takes.

What was found need not help everywhere. A shared gain that load has blurred, say, may be right for the
lateral force and wrong for the normal one, whose own trend it resembles. Walk-forward trials inside the part
fitted decide: what develops over time is fitted again on the first rows alone and used on those that follow,
as the whole will be on the part kept aside, of which no row is looked at."""

import dataclasses
import typing
from collections.abc import Sequence

import numpy as np

from ...sensor.channels import counts_from_log_impedance, log_impedance
from .effects.drifts import TimeShaped
from .effects.electrode_drifts import GainChange
from .effects.loads import ForceEffect, force_features
from .effects.noises import LowPass
from .session import Session

if typing.TYPE_CHECKING:
    from .effects.effect import Finding
    from .timeline import Timeline

__all__ = ["Amended", "Choice", "VIEWS", "choose", "cross_residual", "options", "whole_line"]

# of the part fitted: each trial uses all rows up to an edge and is judged up to the next
_EDGES = (0.4, 0.55, 0.7, 0.85, 1.0)
_WEIGHTS = (1.0, 2.0, 3.0, 4.0)  # of the trials: the last ones are the most like what is to come
_LEAST_ROWS = 500  # in a trial
_SLACK = 0.005  # of the logarithm of the error: less does not decide against what was found


@dataclasses.dataclass(frozen=True)
class Choice:
    """How the findings enter a view.

    Attributes:
      time: what develops over time: "none", "held" (at its last fitted level) or "carried on".
      force: whether what lies between force and electrodes is taken into account.
    """

    time: str = "carried on"
    force: bool = True

    def text(self, findings: "Sequence[Finding]") -> str:
        """Which of the findings enter, in words."""
        late = " (held at its last fitted level)" if self.time == "held" else ""
        moving = [f.effect.name + late for f in findings if over_time(f) and self.time != "none"]
        between = [f.effect.name for f in findings if isinstance(f.effect, ForceEffect) and self.force]
        return ", ".join([*moving, *between]) or "nothing"


def over_time(finding: "Finding") -> bool:
    return isinstance(finding.effect, (TimeShaped, GainChange))


class Amended:
    """A recording with findings taken out as a Choice says.

    Attributes:
      counts: (n, 19); force: (n, 3) as the electrodes follow it [N], or None; session: of the same rows.
    """

    def __init__(self, session: Session, findings: "Sequence[Finding]", choice: Choice):
        recording = session.recording
        self.time = recording.time
        self.late = np.minimum(self.time, self.time[session.fit][-1]) if choice.time == "held" else self.time
        self.used = [
            f
            for f in findings
            if (choice.time != "none" or not over_time(f))
            and (choice.force or not isinstance(f.effect, ForceEffect))
        ]
        self.rate = recording.rate
        self.session = Session(recording, session.fit)
        self.session.masked = session.masked
        counts, force = recording.electrodes.copy(), recording.force
        for f in self.used:
            if isinstance(f.effect, ForceEffect):
                force = f.effect.see(force, self.rate, f.theta)
            else:
                counts = f.correct(counts, self._clock(f))
        self.counts, self.force = counts, force
        self.session.counts, self.session.force = counts, force

    def _clock(self, finding):
        return self.late if over_time(finding) else self.time

    def measured_counts(self, counts: np.ndarray) -> np.ndarray:
        """Counts (n, 19) with the findings put back."""
        for f in reversed(self.used):
            if not isinstance(f.effect, (ForceEffect, LowPass)):
                counts = f.apply(counts, self._clock(f))
        return counts

    def measured_force(self, force: np.ndarray) -> np.ndarray:
        """The force sensor's (n, 3) [N], of the force that the electrodes follow."""
        for f in reversed(self.used):
            if isinstance(f.effect, ForceEffect):
                force = f.effect.unsee(force, self.rate, f.theta)
        return force


# --- the views: Amended -> prediction, measured numbers (n or bins, components), time of the rows [s]


def electrodes_from_force(a: "Amended") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return (
        a.measured_counts(_from_force(a.force, a.counts, a.session.fit)),
        a.session.recording.electrodes,
        a.time,
    )


def electrodes_at_rest(a: "Amended") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    level = counts_from_log_impedance(log_impedance(a.counts[a.session.fit]).mean(0))
    return a.measured_counts(np.tile(level, (len(a.counts), 1))), a.session.recording.electrodes, a.time


def force_from_electrodes(a: "Amended") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear in ln Z, ridge."""
    z, fit = log_impedance(a.counts), a.session.fit
    mean, sd = z[fit].mean(0), np.maximum(z[fit].std(0), 1e-6)
    A = np.concatenate([np.ones((len(z), 1)), (z - mean) / sd], axis=1)
    ridge = 1e-3 * fit.sum() * np.eye(A.shape[1])
    ridge[0, 0] = 0
    w = np.linalg.solve(A[fit].T @ A[fit] + ridge, A[fit].T @ a.force[fit])
    return a.measured_force(A @ w), a.session.recording.force, a.time


def each_from_the_others(a: "Amended") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    line, deviation, _ = whole_line(a.session)
    e = np.median(a.session.recording.electrodes, axis=0)[line.used]
    residual = np.zeros((len(line.time), 19))  # zero of electrodes that are masked for the most part
    residual[:, line.used] = cross_residual(line, deviation) * e * (1 - e / 4095)
    return residual, np.zeros_like(residual), line.time


VIEWS = {
    "electrodes from force": electrodes_from_force, "force from electrodes": force_from_electrodes,
    "electrodes at rest": electrodes_at_rest, "each electrode from the others": each_from_the_others,
}  # fmt: skip


def squares(view: str, amended: "Amended", rows: np.ndarray) -> np.ndarray:
    """(components,) mean square error of a view on rows (n,) bool, of every force component or electrode;
    masked samples do not count."""
    said, measured, time = VIEWS[view](amended)
    inside = np.interp(time, amended.time, rows.astype(float)) > 0.5
    error = (said - measured)[inside] ** 2
    good = (
        ~amended.session.masked[inside]
        if error.shape[1] == 19 and len(said) == len(rows)
        else np.ones(error.shape, bool)
    )
    each = (error * good).sum(0) / np.maximum(good.sum(0), 1)
    # at rest all electrodes have the same choice
    return np.array([each.mean()]) if view == "electrodes at rest" else each


# --- trials  ---


def options(view: str, findings: "Sequence[Finding]") -> list:
    """The Choices that differ in a view, what was found first."""
    times = ("carried on", "held", "none") if any(over_time(f) for f in findings) else ("carried on",)
    forces = (
        (True, False)
        if "force" in view and any(isinstance(f.effect, ForceEffect) for f in findings)
        else (True,)
    )
    return [Choice(t, f) for f in forces for t in times]


def choose(session: Session, findings: "Sequence[Finding]", views: Sequence[str]) -> dict:
    """view -> (Choice of each component or of all, {option's text: mean log error against none
    (components,)}), by trials.

    Where no trial can tell, because nothing was found in its first rows, the findings enter as found.
    """
    out = {v: (options(v, findings)[:1], {}) for v in views}
    asked = {v: options(v, findings) for v in views}
    fitted = int(session.fit.sum())
    edges = np.rint(np.array(_EDGES) * fitted).astype(int)
    if edges[0] < _LEAST_ROWS or all(len(o) == 1 for o in asked.values()):
        return out
    score, weights = {v: [] for v in views}, []
    rows = np.arange(len(session.fit))
    for start, stop, weight in zip(edges[:-1], edges[1:], _WEIGHTS):
        trial = _fitted_again(session, findings, rows < start)
        judged = (rows >= start) & (rows < stop)
        weights.append(weight)
        for v in views:
            errors = [squares(v, Amended(trial, trial.findings, o), judged) for o in asked[v]]
            score[v].append(0.5 * np.log(np.maximum(errors, 1e-12)))
    for v in views:
        x = np.array(score[v])  # (trials, options, components)
        x = x - x[:, -1:]
        tells = np.ptp(x, axis=1).max(1) > 1e-9
        mean = np.average(x[tells], axis=0, weights=np.array(weights)[tells]) if tells.any() else 0 * x[0]
        best = [_best(asked[v], x[..., k], mean[:, k], wary="force" in v) for k in range(x.shape[2])]
        out[v] = [asked[v][i] for i in best], {o.text(findings): m.tolist() for o, m in zip(asked[v], mean)}
    return out


def _best(asked, x, mean, wary):
    """Number of the option with the least mean error (trials, options), what was found first where nothing
    tells.

    Wary, with force: regressions turn the load's own trend into a gain and a wrong gain into newtons, so two
    trials have to tell, and both of the last two that do have to improve.
    """
    allowed = list(range(len(asked)))
    if wary:
        for i, option in enumerate(asked):
            without = (
                asked.index(Choice("none", option.force)) if Choice("none", option.force) in asked else i
            )
            told = [row[i] - row[without] for row in x if abs(row[i] - row[without]) > 1e-9]
            if i != without and not (len(told) >= 2 and max(told[-2:]) < 0):
                allowed.remove(i)
    return min(allowed, key=lambda i: mean[i] - _SLACK * (i == 0))


def _fitted_again(session, findings, fit):
    """Session of the rows `fit`, with what develops over time found anew there; what is not found there is
    left out."""
    trial = Session(session.recording, fit)
    trial.masked = session.masked.copy()
    for f in findings:
        if over_time(f):
            again = [
                g
                for g in f.effect.find(trial)
                if g.channels == f.channels or min(len(g.channels), len(f.channels)) > 12
            ]
            if not again:
                continue
            f = again[0]
        trial.accept(f)
    return trial


# --- what the views need  ---


def whole_line(session: Session) -> "tuple[Timeline, np.ndarray, np.ndarray]":
    """Timeline of the whole record with the covariance of the part fitted: (timeline, deviation (m, c), rows
    fitted (m,))."""
    from .recording import Recording
    from .timeline import Timeline

    r = session.recording
    whole = Recording(np.clip(session.counts, 0, 4095), None, None, r.rate, r.rate_source, r.name)
    line = Timeline(whole, masked=session.masked)
    inside = line.time < r.time[session.fit][-1]
    known = session.timeline()
    place = [int(np.flatnonzero(line.used == k)[0]) for k in known.used if k in line.used]
    keep = [i for i, k in enumerate(known.used) if k in line.used]
    line.used, line.value, line.noise = line.used[place], line.value[:, place], line.noise[place]
    line.covariance = known.covariance[np.ix_(keep, keep)]
    return line, line.value - line.value[inside].mean(0), inside


def cross_residual(line: "Timeline", deviation: np.ndarray) -> np.ndarray:
    """(m, c) of every electrode against what the others predict [ln Z]."""
    P = np.linalg.inv(line.covariance)
    return deviation @ P / np.diag(P)


def _from_force(force, counts, fit):
    """(n, 19) counts as a quadratic, static function of force says, fitted on the rows to fit; ridge chosen
    by blocks of time."""
    y = log_impedance(counts)
    A = force_features(force)
    A[:, 1:] = (A[:, 1:] - A[fit, 1:].mean(0)) / np.maximum(A[fit, 1:].std(0), 1e-6)
    A = np.clip(A, -4, 4)  # no extrapolation of squares
    rows = np.flatnonzero(fit)
    block = np.minimum(np.arange(len(rows)) * 12 // len(rows), 11)
    best = None
    for strength in (1e-4, 1e-3, 1e-2, 1e-1, 1.0):
        ridge = strength * len(rows) * np.eye(A.shape[1])
        ridge[0, 0] = 0
        error = 0.0
        for b in range(0, 12, 2):
            train, test = rows[block != b], rows[block == b]
            w = np.linalg.solve(A[train].T @ A[train] + ridge, A[train].T @ y[train])
            error += ((y[test] - A[test] @ w) ** 2).sum()
        if best is None or error < best[0]:
            best = error, ridge
    w = np.linalg.solve(A[rows].T @ A[rows] + best[1], A[rows].T @ y[rows])
    return counts_from_log_impedance(A @ w)
