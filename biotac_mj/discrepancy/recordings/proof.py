"""Before and after, on the held-out part: of every finding by its own number in raw units, and of the
whole model in counts and newtons, beside the noise floor."""

import numpy as np

from ...effects.effect import shifted
from ...quality.noise import noise_level
from ...sensor.channels import counts_from_log_impedance, log_impedance
from ..evidence import further_off
from ..report.verdict import Gap, electrode_names
from .candidates import Candidate
from .detectors.latency import force_view
from .recording import FORCE_MOVED
from .session import Session

_BLOCKS = 8  # of the held-out rows, whose errors are compared

_FEWEST = 5  # samples
_TURNS = 0.3  # logarithm of path length over range: a trend that has turned cannot be extrapolated
_NOISELESS = 1e-6  # [N] that the noise of a force is taken for at least: a simulated one has none


def prove(session: Session, finding: Candidate) -> None:
    """Fills `gap`, `verified` and `written` of a finding: its number on rows that took no part in any fit,
    without and with it, and whether all electrodes are no further off there with it."""
    if finding.of_log:
        finding.verified = True  # its own samples are the evidence
    if finding.delay:
        gap = _force(session, finding)
    elif finding.correct is None and finding.mask is None:
        return
    elif finding.of_log:
        gap = _samples(session, finding)
    elif finding.places or finding.end < _aside_from(session):
        return  # it is over by then
    else:
        without = session.without(finding)
        gap = _counts(session, without, finding)
        finding.written = not further_off(*blocks(without, session))
    finding.gap = gap
    if gap is not None and finding.verified is None:
        finding.verified = gap.gained


def _rms(x):
    return float(np.sqrt(np.mean(x**2)))


def _aside(session):
    """Model of the session, and which of its bins were held out."""
    m = session.model()
    return m, m.time > _aside_from(session)


def _aside_from(session):
    """[s] of the last row fitted."""
    return session.recording.time[session.fit][-1]


def _counts(session, without, finding):
    """RMS, in the first quarter of the held-out rows, of the finding's electrodes about their prediction from
    the others, or for a common effect about their own level."""
    m, aside = _aside(session)
    bare = without.model()
    mine = np.flatnonzero(np.isin(m.used, finding.channels))
    if len(bare.used) != len(m.used) or not len(mine):
        return None
    # how a trend goes on is less sure the later
    first, noise, out = aside & (np.cumsum(aside) <= aside.sum() / 4), m.noise * m.slope, []
    for value in (bare.value + bare.mean - m.mean, m.value):
        if finding.of_all:
            series = m.shared(np.ones(len(m.used)), value)[:, None] * m.slope.mean()
        else:
            series = m.residual(value)[:, mine] * m.slope[mine]
        out.append(_rms(series[first]))
    if finding.of_all:
        what, floor = "the electrodes' common part about its level", _rms(noise) / np.sqrt(len(noise))
    else:
        what, floor = "electrode against what the others say", _rms(noise[mine])
    gap = Gap("counts", *out, floor, f"RMS of {what} in the part fitted, over the first quarter held out")
    # beside a load the level against the others wanders by itself
    if not gap.gained and (finding.under_load or finding.features.get("turns", 0.0) > _TURNS):
        return None
    if not finding.sudden:  # its evidence is in its own rows
        finding.verified = gap.gained
    return gap


def _samples(session, finding):
    """RMS error of the finding's samples against their prediction from the other electrodes, as logged and
    without it: samples that are no measurement against those that are."""
    m, late = session.model(), ~session.fit
    said = counts_from_log_impedance(m.value - m.residual() + m.mean)
    time, number = session.recording.time[late], session.counts.shape[1]
    expected = np.full((len(time), number), np.nan)
    for i, k in enumerate(m.used):
        expected[:, k] = np.interp(time, m.time, said[:, i])
    own = np.broadcast_to(np.isin(np.arange(number), finding.channels), expected.shape)
    touched = own if finding.mask is None else finding.mask[late]
    left = ~session.masked[late] & (own if finding.mask is None else finding.mask.any(0))
    out = []
    for counts, which in ((session.without(finding).counts, touched), (session.counts, left)):
        error = (counts[late] - expected)[which]
        error = error[np.isfinite(error)]
        if len(error) < _FEWEST:
            return None
        out.append(_rms(error))
    floor = _rms(noise_level(session.recording.electrodes[session.fit]))
    return Gap("counts", *out, floor, "RMS of samples against what the others say")


def _force(session, finding):
    """RMS error of force from electrodes [N]: map and error both from the held-out part, by blocks left
    out."""
    view = force_view(session, ~session.fit)
    if view is None:
        return None
    each = [view.errors().mean(1), view.at_delay(finding.delay)]
    out, worse = [float(np.exp(0.5 * e.mean())) for e in each], each[1] - each[0]
    if 0 <= worse.mean() < worse.std(ddof=1) / np.sqrt(len(worse)):  # not significant on these rows
        return None
    floor = float(np.mean(noise_level(session.recording.force[session.fit], None, _NOISELESS)))
    return Gap("N", *out, floor, "RMS error of force from electrodes, by blocks of that part")


def views(session: Session) -> dict[str, Gap]:
    """Errors of the whole model's predictions of the held-out part, before and after the findings that are
    written."""
    bare = session.without(*session.findings)
    session = session.without(*(f for f in session.findings if not f.written))
    out = {}
    sample = noise_level(session.recording.electrodes[session.fit])
    each = [_errors(s, session.loaded) for s in (bare, session)]
    if session.loaded:
        out["each electrode from the others"] = _view(
            "what each electrode reads beside the others", each, sample / np.sqrt(session.model().width)
        )
    else:
        out["electrodes at rest"] = _view("the electrodes at rest", each, sample)
    if session.recording.force is not None and session.recording.force.std(0).max() > FORCE_MOVED:
        # a drift under load may be right for the electrodes and wrong for the force, whose own trend it
        # resembles: the last fitted rows, predicted from those before them, choose
        fit = np.flatnonzero(session.fit)
        late = fit[int(0.7 * len(fit)) :]
        still = session.without(*(f for f in session.findings if f.trend is not None))
        best = min(
            (session, still), key=lambda s: np.sum(_force_errors(s, fit[: int(0.7 * len(fit))], late) ** 2)
        )
        each = [_force_errors(s, fit, np.flatnonzero(~s.fit)) for s in (bare, best)]
        noise = noise_level(session.recording.force[session.fit], None, _NOISELESS)
        out["force from electrodes"] = _view("the force as the electrodes tell it", each, noise)
    return out


def _view(name, errors, noise):
    each = [_by_channel(e) for e in errors]
    both = np.isfinite(each[0]) & np.isfinite(each[1])  # a channel that is no measurement has no error
    each = [np.where(both, e, np.nan) for e in each]
    before, after = (float(np.sqrt(np.nanmean(e**2))) for e in each)
    unit, channels = "N", ("Fx", "Fy", "Fz")
    if len(each[0]) != len(channels):
        unit, channels = "counts", electrode_names(range(len(each[0])))
    return Gap(unit, before, after, _rms(noise), name, channels, *(tuple(e.tolist()) for e in each))


def _by_channel(errors):
    """(c,) RMS of errors (n, c), nan of channels of which nothing is known."""
    known = np.isfinite(errors)
    square = np.where(known, errors**2, 0).sum(0) / np.maximum(known.sum(0), 1)
    return np.where(known.any(0), np.sqrt(square), np.nan)


def blocks(*sessions: Session) -> list[np.ndarray]:
    """Mean squares (blocks, 1) of the errors of held-out rows in each session, of what is known in all."""
    errors = [_errors(s, sessions[-1].loaded) for s in sessions]
    known = np.logical_and.reduce([np.isfinite(e) for e in errors])
    return [
        np.array([[part.mean()] for part in np.array_split(np.where(known, e**2, 0), _BLOCKS)])
        for e in errors
    ]


def _errors(s, loaded):
    """(n, nelectrode) errors [counts] of the held-out part, nan where nothing was measured: of bins, what
    each electrode reads beside the others; unloaded, of rows, about the level of the rows fitted."""
    if loaded:
        m, aside = _aside(s)
        out = np.full((aside.sum(), s.counts.shape[1]), np.nan)
        out[:, m.used] = m.residual()[aside] * m.slope
        return out
    level = counts_from_log_impedance(log_impedance(s.counts[s.fit]).mean(0))
    return np.where(s.masked, np.nan, s.counts - level)[~s.fit]


def _force_errors(s, fit, judged):
    """(n, 3) errors [N] on some rows of a linear map from ln Z, fitted on others."""
    z, force = log_impedance(s.filled()), s.recording.force
    z = shifted(z, s.recording.time, -sum(f.delay for f in s.findings))
    mean, sd = z[fit].mean(0), np.maximum(z[fit].std(0), 1e-6)
    A = np.column_stack([np.ones(len(z)), (z - mean) / sd])
    ridge = 1e-3 * len(fit) * np.eye(A.shape[1])
    ridge[0, 0] = 0
    said = A @ np.linalg.solve(A[fit].T @ A[fit] + ridge, A[fit].T @ force[fit])
    return (said - force)[judged]
