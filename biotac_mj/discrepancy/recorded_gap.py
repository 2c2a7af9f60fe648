"""Before and after, on the part kept aside: of each finding by the number that shows it, and of the whole model in counts and newtons."""

import numpy as np

from .hum import Hum
from .loads import ForceEffect, ForceView, force_features
from .noises import CrossTalk, LowPass, _lag_one, quiet, windows
from .recorded_effect import Session
from .recording import counts_of, log_impedance
from .timeline import Timeline, noise_level

__all__ = ["gap", "statistics"]


def statistics(session) -> list:
    """Fills `statistic` and `verified` of every finding; returns those that the part kept aside contradicts."""
    for finding in session.findings:
        others = [f for f in session.findings if f is not finding]
        without = _replay(session, others)
        both = _replay(session, session.findings)
        finding.statistic, finding.verified = _compare(finding, without, both)
    return [f for f in session.findings if f.verified is False]


def _replay(session, findings):
    s = Session(session.recording, session.fit)
    s.masked = session.masked.copy()
    for f in findings:
        s._take_out(f)
    s.findings = list(findings)
    return s


def _compare(finding, without, both):
    effect, recording = finding.effect, without.recording
    locked = ~without.fit
    begin = recording.time[locked][0]
    active = finding.end > begin + 0.1 * (recording.time[-1] - begin)
    rows = locked if active else without.fit
    place = "part kept aside" if active else "part fitted (the effect ends before the part kept aside)"
    if "pattern" in finding.theta:
        slope = np.median(without.counts * (1 - without.counts / 4095), axis=0)
        size = float(np.median(slope[list(finding.channels)]))
        values = [size * _pattern_rms(s, finding, rows) for s in (without, both)]
        name, unit = "RMS of the pattern's amplitude about the level fitted", "counts"
    elif effect.id == "gain":
        values = [_electrode_rms(s, finding.channels[0], rows) for s in (without, both)]
        name, unit = "RMS of the electrode against what the others predict", "counts"
    elif isinstance(effect, Hum):
        values = [_line_amplitude(s, finding, rows) for s in (without, both)]
        name, unit = "amplitude of the line", "counts"
    elif isinstance(effect, CrossTalk):
        values = [_mean_correlation(s, rows) for s in (without, both)]
        name, unit = "RMS correlation of noise between electrodes", "1"
    elif isinstance(effect, LowPass):
        cuts = windows(without, rows)
        value = float(np.nanmedian([np.nanmedian(_lag_one(c[2])[list(finding.channels)]) for c in quiet(cuts)])) if cuts else np.nan
        values = [value, -0.75]
        name, unit = "lag-1 correlation of third differences (white: -0.75)", "1"
        return {"name": name, "unit": unit, "before": value, "after": -0.75, "part": place}, (
            bool(value > -0.72) if np.isfinite(value) else None
        )
    elif isinstance(effect, ForceEffect):
        active = True
        place = "part kept aside"
        values = [_force_error(s) for s in (without, both)]
        name, unit = "RMS error of force from electrodes, by blocks of that part", "N"
    else:
        flags = finding.effect.mask(recording.electrodes, recording.time, finding)
        share = float(flags[rows].any(1).mean()) if flags is not None else np.nan
        return {"name": "share of rows affected", "unit": "1", "before": share, "after": 0.0, "part": place}, None if not active else True
    before, after = values
    # Under load the others predict an electrode to some per cent: a gain must do better than chance improvements.
    verified = None if not active else bool(after < (0.92 if effect.id == "gain" else 1.0) * before)
    return {"name": name, "unit": unit, "before": before, "after": after, "part": place}, verified


def fitted_line(session, counts):
    """Timeline of the whole record with mean and covariance of the part fitted: (timeline, deviation (m, c), rows fitted (m,))."""
    line = session.timeline(slice(0, len(session.recording)), counts)
    known = session.timeline(None, counts)
    common = np.intersect1d(line.used, known.used)
    if len(common) < len(line.used) or len(common) < len(known.used):
        raise RuntimeError("electrodes differ between the parts")
    line.covariance = known.covariance
    inside = line.time < session.recording.time[session.fit][-1]
    return line, line.value - line.value[inside].mean(0), inside


def _pattern_rms(session, finding, rows):
    line, deviation, _ = _line(session)
    pattern = finding.theta["pattern"][line.used]
    q = np.linalg.solve(line.covariance, pattern)
    series = deviation @ q / (pattern @ q)
    where = np.interp(line.time, session.recording.time, rows.astype(float)) > 0.5
    return float(np.sqrt((series[where] ** 2).mean()))


def _electrode_rms(session, channel, rows):
    line, deviation, _ = _line(session)
    k = int(np.flatnonzero(line.used == channel)[0])
    residual = cross_residual(line, deviation)[:, k]
    where = np.interp(line.time, session.recording.time, rows.astype(float)) > 0.5
    e = np.median(session.counts[:, channel])
    return float(np.sqrt((residual[where] ** 2).mean()) * e * (1 - e / 4095))


def cross_residual(line, deviation):
    """(m, c) of every electrode against what the others predict [ln Z]."""
    P = np.linalg.inv(line.covariance)
    return deviation @ P / np.diag(P)


def _line(session):
    n = len(session.recording)
    line = Timeline(_as_recording(session), masked=session.masked)
    inside = line.time < session.recording.time[session.fit][-1]
    known = session.timeline()
    place = [int(np.flatnonzero(line.used == k)[0]) for k in known.used if k in line.used]
    keep = [i for i, k in enumerate(known.used) if k in line.used]
    line.used, line.value, line.noise = line.used[place], line.value[:, place], line.noise[place]
    line.covariance = known.covariance[np.ix_(keep, keep)]
    del n
    return line, line.value - line.value[inside].mean(0), inside


def _as_recording(session):
    from .recording import Recording

    r = session.recording
    return Recording(np.clip(session.counts, 0, 4095), None, None, r.rate, r.rate_source, r.name)


def _line_amplitude(session, finding, rows):
    time = session.recording.time
    on = rows & (time >= finding.theta["start"]) & (time < finding.theta["end"])
    if on.sum() < 50:
        return float("nan")
    phase = 2 * np.pi * finding.theta["frequency"] * time[on]
    wave = np.stack([np.sin(phase), np.cos(phase)], axis=1)
    y = np.diff(session.counts[on][:, list(finding.channels)], axis=0)
    w, *_ = np.linalg.lstsq(np.diff(wave, axis=0), y, rcond=None)
    return float(np.median(np.hypot(w[0], w[1])))


def _mean_correlation(session, rows):
    result = CrossTalk._correlation(session, rows)
    if result is None:
        return float("nan")
    return float(np.sqrt((result[0][np.triu_indices(19, 1)] ** 2).mean()))


def _force_error(session):
    """RMS error of force from electrodes, map and error both from the part kept aside, by blocks left out [N]."""
    usable = np.flatnonzero(~(session.masked.mean(0) > 0.02))
    view = ForceView(session.counts, session.force, ~session.fit, usable)
    return float(np.exp(0.5 * view.errors(session.force).mean()))


def _force_rms(session):
    """RMS error of force from electrodes, fitted on one part and taken on the other [N]."""
    z = log_impedance(session.counts)
    fit, locked = session.fit, ~session.fit
    mean, sd = z[fit].mean(0), np.maximum(z[fit].std(0), 1e-6)
    A = np.concatenate([np.ones((len(z), 1)), (z - mean) / sd], axis=1)
    target = session.force
    ridge = 1e-3 * fit.sum() * np.eye(20)
    ridge[0, 0] = 0
    w = np.linalg.solve(A[fit].T @ A[fit] + ridge, A[fit].T @ target[fit])
    return float(np.sqrt(((target[locked] - A[locked] @ w) ** 2).mean()))


def gap(session, findings) -> dict:
    """Views of the whole model before and after: each with per-electrode RMS [counts] on the part kept aside."""
    recording, fit = session.recording, session.fit
    locked = ~fit
    measured = recording.electrodes
    loaded = session.timeline().loaded
    raw = Session(recording, fit)
    raw.masked = session.masked
    views = {}
    good = ~session.masked
    noise = noise_level(measured[fit], recording.repeated[fit])
    if recording.force is not None and session.force_view() is not None:
        before = _from_force(recording.force, measured, fit)
        after = _forward(_from_force(session.force, session.counts, fit), findings, recording.time)
        views["electrodes from force"] = _view(measured, before, after, locked, good, noise)
        one, two = _force_rms(raw), _force_rms(session)
        views["force from electrodes"] = {"unit": "N", "before": one, "after": two, "variance_removed": 1 - (two / max(one, 1e-12)) ** 2}
    elif not loaded:
        before = np.tile(counts_of(log_impedance(measured[fit]).mean(0)), (len(measured), 1))
        level = counts_of(log_impedance(session.counts[fit]).mean(0))
        after = _forward(np.tile(level, (len(measured), 1)), findings, recording.time)
        views["electrodes at rest"] = _view(measured, before, after, locked, good, noise)
    if loaded:
        values = []
        for s in (raw, session):
            line, deviation, inside = _line(s)
            e = np.median(measured, axis=0)[line.used]
            residual = cross_residual(line, deviation)[~inside] * e * (1 - e / 4095)
            values.append(np.sqrt((residual**2).mean(0)))
        before, after = (float(np.sqrt((v**2).mean())) for v in values)
        views["each electrode from the others"] = {
            "unit": "counts", "before": before, "after": after, "variance_removed": 1 - (after / max(before, 1e-12)) ** 2,
            "channels_before": values[0].tolist(), "channels_after": values[1].tolist(),
        }  # fmt: skip
    return views


def _forward(counts, findings, time):
    for f in reversed(findings):
        if not isinstance(f.effect, (ForceEffect, LowPass)):
            counts = f.apply(counts, time)
    return counts


def _from_force(force, counts, fit):
    """(n, 19) counts as a quadratic, static function of force says, fitted on the rows to fit; ridge chosen by blocks of time."""
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
    return counts_of(A @ w)


def _view(measured, before, after, locked, good, noise):
    weight = good[locked]

    def rms(prediction):
        error = np.where(weight, prediction[locked] - measured[locked], 0)
        return np.sqrt((error**2).sum(0) / np.maximum(weight.sum(0), 1))

    b, a = rms(before), rms(after)
    one, two, floor = (float(np.sqrt((v**2).mean())) for v in (b, a, noise))
    closable = max(one**2 - floor**2, 1e-12)
    # Drift alone: means of many rows, about their own level, so that neither noise nor a constant offset counts.
    width = max(1, len(measured[locked]) // 60)
    m = locked.sum() // width

    def wander(prediction):
        error = (prediction[locked] - measured[locked])[: m * width].reshape(m, width, -1).mean(1)
        return float(((error - error.mean(0)) ** 2).mean())

    return {
        "unit": "counts", "before": one, "after": two, "noise": floor, "variance_removed": 1 - (two / max(one, 1e-12)) ** 2,
        "closed": float(np.clip((one**2 - two**2) / closable, -9, 1)) if one > 1.05 * floor else float("nan"),
        "drift_variance_removed": 1 - wander(after) / max(wander(before), 1e-12),
        "channels_before": b.tolist(), "channels_after": a.tolist(),
    }  # fmt: skip
