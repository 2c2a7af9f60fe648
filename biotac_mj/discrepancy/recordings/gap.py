"""Before and after, on the part kept aside: of each finding by the number that shows it, and of the whole
model in counts and newtons."""

from collections.abc import Sequence

import numpy as np

from ..noise import noise_level
from .effects.effect import Finding
from .effects.hum import Hum
from .effects.loads import ForceEffect
from .effects.noises import CrossTalk, LowPass, _lag_one, quiet, windows
from .session import Session
from .views import VIEWS, Amended, Choice, choose, cross_residual, whole_line

__all__ = ["gap", "statistics"]


def statistics(session: Session) -> list:
    """Fills `statistic` and `verified` of every finding; returns those that the part kept aside
    contradicts."""
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
        value = (
            float(np.nanmedian([np.nanmedian(_lag_one(c[2])[list(finding.channels)]) for c in quiet(cuts)]))
            if cuts
            else np.nan
        )
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
        return {
            "name": "share of rows affected",
            "unit": "1",
            "before": share,
            "after": 0.0,
            "part": place,
        }, None if not active else True
    before, after = values
    # Under load the others predict an electrode to some per cent: a gain must do better than chance
    # improvements.
    verified = None if not active else bool(after < (0.92 if effect.id == "gain" else 1.0) * before)
    return {"name": name, "unit": unit, "before": before, "after": after, "part": place}, verified


def _pattern_rms(session, finding, rows):
    line, deviation, _ = whole_line(session)
    pattern = finding.theta["pattern"][line.used]
    q = np.linalg.solve(line.covariance, pattern)
    series = deviation @ q / (pattern @ q)
    where = np.interp(line.time, session.recording.time, rows.astype(float)) > 0.5
    return float(np.sqrt((series[where] ** 2).mean()))


def _electrode_rms(session, channel, rows):
    line, deviation, _ = whole_line(session)
    k = int(np.flatnonzero(line.used == channel)[0])
    residual = cross_residual(line, deviation)[:, k]
    where = np.interp(line.time, session.recording.time, rows.astype(float)) > 0.5
    e = np.median(session.counts[:, channel])
    return float(np.sqrt((residual[where] ** 2).mean()) * e * (1 - e / 4095))


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
    """RMS error of force from electrodes, map and error both from the part kept aside, by blocks left out
    [N]."""
    view = session.force_view_of(~session.fit)
    return float("nan") if view is None else float(np.exp(0.5 * view.errors().mean()))


def gap(session: Session, findings: Sequence[Finding], late: Sequence[Finding] = ()) -> dict:
    """Views of the whole model before and after, on the part kept aside: RMS, of electrodes also one by one
    [counts].

    Args:
      session: with the rows fitted and the samples masked; findings: accepted on the rows fitted, in that
        order; late: those that begin in the part kept aside and have been fitted there: they enter
        `after_with_late` alone.

    `amendments` says which of the findings each view takes, `trials` why: see `views`.
    """
    recording = session.recording
    locked = ~session.fit
    loaded = session.timeline().loaded
    names = []
    if recording.force is not None and session.force_view() is not None:
        names += ["electrodes from force", "force from electrodes"]
    elif not loaded:
        names += ["electrodes at rest"]
    if loaded:
        names += ["each electrode from the others"]
    chosen = choose(session, findings, names)
    views = {}
    for name in names:
        choices, trials = chosen[name]
        before = _view(name, session, findings, [Choice("none", False)], locked)
        after = _view(name, session, findings, choices, locked)
        view = views[name] = {
            "unit": "N" if name.startswith("force") else "counts",
            "before": before.pop("rms"),
            "after": after.pop("rms"),
        }
        view["variance_removed"] = 1 - (view["after"] / max(view["before"], 1e-12)) ** 2
        view |= {f"{key}_before": value for key, value in before.items() if key != "wander"}
        view |= {f"{key}_after": value for key, value in after.items() if key != "wander"}
        if "wander" in before:
            floor = float(
                np.sqrt(
                    (
                        noise_level(recording.electrodes[session.fit], recording.repeated[session.fit]) ** 2
                    ).mean()
                )
            )
            closable = max(view["before"] ** 2 - floor**2, 1e-12)
            view["noise"] = floor
            view["closed"] = (
                float(np.clip((view["before"] ** 2 - view["after"] ** 2) / closable, -9, 1))
                if view["before"] > 1.05 * floor
                else float("nan")
            )
            view["drift_variance_removed"] = 1 - after["wander"] / max(before["wander"], 1e-12)
        view["amendments"] = [c.text(findings) for c in choices]
        view["trials"] = trials
        if late:
            view["after_with_late"] = _view(name, session, [*findings, *late], choices, locked)["rms"]
    return views


def _view(name, session, findings, choices, locked):
    """RMS of a view on the part kept aside, each of its components amended by its own choice (one choice: by
    that)."""
    said = None
    for choice in dict.fromkeys(choices):
        one, measured, time = VIEWS[name](Amended(session, findings, choice))
        mine = np.array([c == choice for c in choices]) if len(choices) > 1 else np.ones(one.shape[1], bool)
        said = one.copy() if said is None else said
        said[:, mine] = one[:, mine]
    inside = np.interp(time, session.recording.time, locked.astype(float)) > 0.5
    error = (said - measured)[inside]
    counts = error.shape[1] == 19 and len(said) == len(locked)
    good = ~session.masked[inside] if counts else np.ones(error.shape, bool)
    each = np.sqrt((error**2 * good).sum(0) / np.maximum(good.sum(0), 1))
    out = {
        "rms": float(np.sqrt((each**2).sum() / max((each > 0).sum(), 1))),
        "components" if name.startswith("force") else "channels": each.tolist(),
    }
    if counts:
        # Drift alone: means of many rows, about their own level, so that neither noise nor a constant offset
        # counts.
        width = max(1, len(error) // 60)
        m = len(error) // width
        slow = error[: m * width].reshape(m, width, -1).mean(1)
        out["wander"] = float(((slow - slow.mean(0)) ** 2).mean())
    return out
