"""Levels over time: the strongest trend that one electrode or all share, and all trends fitted once more,
each with the others taken out.

Directions are ranked by the energy that a trend over time explains in units of the joint model (`model.py`),
so that an effect is charged to the channel that has it, and judged on blocks of time left out. Where
something moves, single electrodes are processes of the others and of time (`process.py`)."""

import numpy as np

from ....effects.logged import SHARED
from ....effects.sensing import Thermal
from ....quality.evidence import sign_flip
from ....sensor.channels import FULL_SCALE, counts_from_log_impedance, log_impedance, temperature_from_counts
from ..candidates import Candidate
from ..model import Model
from ..session import Session
from .process import process
from .trends import BLOCKS, SHARP, Trend, compare, sharp, trends

_LEAST = 1.0  # [counts]: what is smaller rounding does as well
# of a shared drift's shares about their mean: 8-15 % seen in a real unloaded sensor
_SCATTER = 0.12
_OFF = 0.7  # at most: the weakest of a real unloaded sensor has 65 % of the others' share
_PLAINLY = 3.3  # logarithm of its energy over another's, beyond which it is no matter of energy
_WARMER = 0.05  # [K] by which the thermistor has to change
_ALIKE = 0.9  # correlation of a trend with the thermistor's
_EXPLAINED = 0.35  # of the evidence that the thermistor alone has to explain
_NATS = 12.0  # of a drift beside a load
_ANSWERS = 0.8  # of what a drift explains beside a load, that a change of answers explains as well
_CANDIDATES = 3  # electrodes that may drift beside a load, the plainest first
_MOSTLY = 0.6  # least fraction of a trend that a multiple of the common one explains


def levels(session: Session, rejected: set) -> Candidate | None:
    """The strongest trend over time that one electrode or all have, none of those refused. Series that were
    put together have none, nor touches too short to be told from drift: levels differ by what is touched."""
    m = session.model()
    if session.recording.joints or not m.parted:
        return None
    number = len(m.used)
    everyone = np.ones(number)
    common, time = m.levels(m.shared(everyone))
    best = trends(common, time)[0]
    finding = _under_load(session, rejected, best)
    if finding is not None:
        return finding
    weight = everyone @ m.given.precision[:number, :number] @ everyone
    tried = [(_energy(best, time) * weight, None, best, common)]
    residual, _ = m.levels(m.residual())
    for i, k in enumerate(m.used):
        best = trends(residual[:, i], time)[0]
        tried.append((_energy(best, time) / m.given.noise[i] ** 2, int(k), best, residual[:, i]))
    tried.sort(key=lambda o: -o[0])
    size = {k: float(np.log(max(energy, 1e-12))) for energy, k, *_ in tried}
    tried = [o for o in tried if (o[1],) not in rejected]
    # of single electrodes the levels wander with a load as well
    for energy, k, trend, level in [o for o in tried if o[1] is None] if m.moved else tried[:6]:
        if k is None and trend.kind == "step" and sharp(level, time, trend.onset) <= SHARP:
            # where the load's level changes all drift a little: a step that does not stand out is none
            trend = trends(level, time, ("smooth",))[0]
        trend = trend.continued(level, time)
        if trend.p > 0.02 or trend.nats < 6 or energy < 30:
            continue
        slope = m.slope.mean() if k is None else m.slope[m.used == k][0]
        if trend.size * slope < max(_LEAST, session.step):
            continue
        if k is not None and _part_of_common(session, trend, trend.size):
            continue
        finding = _shared(session, trend) if k is None else _single(session, trend, k)
        finding.features["lead"] = _lead(size, k)
        return finding
    return None


def _lead(size, k):
    """Logarithm of the energy of electrode k, None of all alike, over the next one's, by logarithms of all:
    number -> size."""
    others = {j: s for j, s in size.items() if j is not None}
    if k is None:
        return size[None] - max(others.values())
    lead = _ahead(np.array([*others.values()]), [*others].index(k))
    return float(np.clip(lead, -1, _PLAINLY))


def _ahead(size, i):
    """Logarithm of the i-th size over the second of the others, by logarithms (c,): a connector may have
    two."""
    return float(size[i] - np.sort(np.delete(size, i))[-min(2, len(size) - 1)])


def _under_load(session, rejected, common):
    """The electrode that drifts most clearly under load, of those that were not rejected, without those whose
    drift may be part of the common one (common: a trend [ln Z])."""
    m = session.model()
    drifting = _drifting(session)
    every = process(m, drifting)
    if every is None:
        return None
    nats = np.array([every.nats(i) for i in range(len(m.used))])
    for i in np.argsort(-nats)[:_CANDIDATES]:
        k = int(m.used[i])
        if (k,) in rejected or k in drifting or nats[i] < _NATS:
            continue
        trend = every.trend(int(i))
        if trend.size * m.slope[i] < _LEAST or _part_of_common(session, trend, trend.size, common):
            continue
        finding = _single(session, trend, k)
        answers = every.answers(int(i))
        finding.detector, finding.under_load = "process", True
        finding.features["likelier"] = float(nats[i] / len(trend.gain))
        if answers > _ANSWERS * nats[i]:
            finding.ties = ("gain",)
        return finding
    return None


def _drifting(session):
    """Electrodes that drift while they are loaded. Their drift is not removed from the held-out rows."""
    return frozenset(f.channels[0] for f in session.findings if f.under_load)


def _part_of_common(session, trend, size, *common):
    """Whether a trend of a size [ln Z] is mostly a multiple of a common trend, found or new: the multiple may
    be four standard deviations from the mean."""
    found = [f.trend for f in session.findings if f.fraction is not None]
    y = trend.sampled() - trend.sampled().mean()
    for all_do in (*common, *found):
        g = all_do.sampled() - all_do.sampled().mean()
        if size < 4 * _SCATTER * all_do.size and (y @ g) ** 2 > _MOSTLY * (y @ y) * (g @ g):
            return True
    return False


def _energy(trend, time):
    y = trend(time)
    return float(((y - y.mean()) ** 2).sum())


def _single(session, trend, k):
    m = session.model()
    i = int(np.flatnonzero(m.used == k)[0])
    time = session.recording.time
    before = trend(time[:1])[0]

    def correct(counts, at):
        out = counts.copy()
        out[:, k] = counts_from_log_impedance(log_impedance(counts[:, k]) - (trend(at) - before))
        return out

    change = -float(trend.sampled()[-1] - trend.sampled()[0]) * m.slope[i]
    error = 2 * m.slope[i] * float(np.median(np.abs(np.diff(m.levels(m.residual())[0][:, i]))))
    return Candidate(
        "drift",
        (k,),
        trend.start,
        time[-1],
        f"{'a step' if trend.kind == 'step' else 'a trend over time'} of "
        f"{trend.size * m.slope[i]:.0f} counts against what the other electrodes say",
        {"change": (change, change - error, change + error)},
        nats=trend.nats,
        p=trend.p,
        detector="one",
        features=_features(session, trend) | {"wandering": _wandering(m, i)},
        correct=correct,
        trend=trend,
    )


def _wandering(m, i):
    """Logarithm of how much more the levels of used electrode i wander about their mean, in counts, than
    those of the others."""
    level, _ = m.levels(m.residual())
    return _ahead(np.log(level.std(0) * m.slope + 0.3), i)


def settle(session: Session) -> None:
    """Fits the trends again, each with all others taken out: what was found first had the others in it."""
    for _ in range(2):
        for finding in [f for f in session.findings if f.trend is not None]:
            other = session.without(finding)
            m, place = other.model(), np.flatnonzero(other.model().used == finding.channels[0])
            common = finding.fraction is not None
            if not common and not len(place):
                continue
            every = process(m, _drifting(other)) if finding.under_load else None
            if every is not None:
                trend = every.trend(int(place[0]))
            else:
                series = m.shared(finding.fraction[m.used]) if common else m.residual()[:, int(place[0])]
                kinds = (finding.trend.kind,) if common else ("step", "smooth")
                levels_at = m.levels(series)
                trend = trends(*levels_at, kinds)[0].continued(*levels_at)
            again = _shared(other, trend) if common else _single(other, trend, finding.channels[0])
            finding.correct, finding.parameters, finding.start = again.correct, again.parameters, again.start
            finding.nats, finding.p, finding.message = again.nats, again.p, again.message
            finding.features |= again.features
            finding.trend, finding.fraction = again.trend, again.fraction
            if common:
                finding.id, finding.ties, finding.detector = again.id, again.ties, again.detector
            session.replay()


# --- a drift that all share, each with a fraction of its own


def _features(session, trend):
    # under load a common drift is separable only in recordings long enough for both
    seconds = session.fit.sum() / session.recording.rate
    return {
        "nats": trend.nats / len(trend.gain),
        "turns": float(np.log(max(trend.turns, 1.0))),
        "room": float(min(np.log(seconds / 90), 0)) if session.model().dimensions else 0.0,
    }


def _shared(session, trend):
    m, time = session.model(), session.recording.time
    fraction = np.ones(session.counts.shape[1])
    own = {f.channels[0] for f in session.findings if len(f.channels) == 1 and f.correct is not None}
    fraction[m.used] = _fractions(m, trend, np.isin(m.used, list(own)))
    before = trend(time[:1])[0]

    def correct(counts, at):
        return counts_from_log_impedance(log_impedance(counts) - np.outer(trend(at) - before, fraction))

    sampled = trend.sampled()
    change = float(sampled[-1] - sampled[0])
    size = trend.size * float(m.slope.mean())
    finding = Candidate(
        "",  # named below
        tuple(range(len(fraction))),
        trend.start,
        time[-1],
        f"ln Z of all electrodes changes by {change:+.3f} ({size:.0f} counts); shares "
        f"{fraction[m.used].min():.2f} to {fraction[m.used].max():.2f}",
        nats=trend.nats,
        p=trend.p,
        features=_features(session, trend)
        | {
            "uneven": _uneven(m, trend),
            "seconds": float(np.log(session.fit.sum() / session.recording.rate)),
        },
        correct=correct,
        trend=trend,
        fraction=fraction,
    )
    _name_shared(session, finding, trend, change)
    return finding


def _uneven(m, trend):
    """Logarithm of how much electrodes differ in a trend, against its median: a warm-up's are alike, a
    touch's are not; 0.2 under load, which hides it."""
    if m.dimensions:
        return float(np.log(0.2))
    level, time = m.levels(m.value)
    y = trend(time)
    each = level.T @ (y - y.mean())
    spread = 1.4826 * np.median(np.abs(each - np.median(each)))
    return float(np.log(np.clip(spread / max(abs(np.median(each)), 1e-12), 0.05, 5)))


def _fractions(m: Model, trend: Trend, own: np.ndarray) -> np.ndarray:
    """Relative drift of each electrode (c,), about one: generalised least squares on the cells' levels,
    shrunk towards their median, which an electrode with a change of its own has, one in `own` (c,) or,
    where nothing moves, one so far off."""
    level, time = m.levels(m.value)
    g = trend(time) - trend(time).mean()
    marginal, residual = m.given.marginal(), m.levels(m.residual())[0]
    residual = residual - residual.mean(0) - np.outer(g, g @ residual / max(g @ g, 1e-12))
    # the cells' levels wander by more than the changes within them, and remember where they have been
    memory = np.clip((residual[1:] * residual[:-1]).sum(0) / np.maximum((residual**2).sum(0), 1e-12), 0, 0.95)
    scatter = (residual**2).mean(0) * (1 + memory) / (1 - memory)
    worse = max(float(np.median(scatter / m.given.noise**2)), 1e-9)
    precision = g @ g / worse * marginal + np.eye(len(m.used)) / _SCATTER**2
    middle = 1.0
    for _ in range(3):
        fraction = np.linalg.solve(precision, marginal @ (level.T @ g) / worse + middle / _SCATTER**2)
        middle = np.median(fraction)
    far = (not m.dimensions) & (np.abs(fraction - middle) > _OFF)
    return np.where(own | far, middle, fraction)


def _name_shared(session, finding, trend, change):
    """Identifies the shared effect: temperature if TDC follows it, else by pattern, sign and trend."""
    m = session.model()
    middle = np.clip(np.median(session.counts[session.fit][:, m.used], axis=0), 1, FULL_SCALE - 1)
    misfit = _misfits(m, middle, trend)
    # every sensor warms up, and to a trend that is uneven a step fits as well: a step has to be sharp
    common, at = m.levels(m.shared(np.ones(len(m.used))))
    sudden = trend.kind == "step" and sharp(common, at, trend.onset) > SHARP
    order = [e for e in sorted(SHARED, key=lambda e: e.drifts == sudden) if change > 0 or not e.rises]
    # what comes slowly is the session's whatever its pattern: electrodes have shares of their own of it
    alike = [e for e in order if e.drifts and not sudden or misfit[e.id] < 2 * min(misfit.values()) + 12]
    time = np.linspace(trend.knots[0], trend.knots[-1], 200)
    samples = time, trend(time) - trend(time[:1])
    found = {e.id: e.of_trend(*samples, m.slope, middle) for e in alike}
    best, *ties = [e for e in alike if e.possible(found[e.id])] or alike
    finding.id, finding.parameters, ties = best.id, found[best.id], [e.id for e in ties]
    finding.detector = alike[0].detector  # by which way all go, whatever is possible
    ties = _by_temperature(session, finding, trend, ties)
    if not session.recording.absolute:  # the patterns follow from the levels, the sign from the sign
        alike = [e.id for e in SHARED if not e.rises or change > 0 or not session.recording.signed]
        ties = [*ties, *(i for i in alike if i != finding.id and i not in ties)]
    finding.ties = tuple(ties)


def _misfits(m, middle, trend):
    """id -> by how much electrodes differ in a trend beyond the effect's pattern and their shares of it."""
    level, time = m.levels(m.whole)
    y = trend(time)
    y = (y - y.mean()) / max(np.sqrt(((y - y.mean()) ** 2).sum()), 1e-12)
    amplitude = (level - level.mean(0)).T @ y  # (c + products,) of the trend in every channel
    out = {}
    for effect in SHARED:
        pattern = effect.pattern(m.slope, middle)
        size = m.given.along(pattern, amplitude[None])[0]
        spread = m.given.noise**2 + (_SCATTER * size * pattern) ** 2
        beyond = amplitude - size * np.r_[pattern, np.zeros(len(amplitude) - len(pattern))]
        residual = m.given.residual(beyond[None])[0] if m.dimensions else beyond
        out[effect.id] = float(residual @ (residual / spread))
    return out


def _by_temperature(session, finding, trend, ties):
    """Names a drift of all after the temperature where the thermistor explains it, on blocks left out;
    returns the ids that it is tied with."""
    if session.recording.tdc is None:
        return ties
    m, clock, heat = session.model(), session.recording.time, temperature_from_counts(session.recording.tdc)
    series, time = m.levels(m.shared(np.ones(len(m.used))))
    warm = np.interp(time, clock, heat)
    if np.ptp(warm) <= _WARMER:
        return ties
    block = np.arange(len(time)) * min(BLOCKS, len(time) // 2) // len(time)
    A, out = np.column_stack([np.ones(len(warm)), warm]), np.empty(len(series))
    for b in range(block[-1] + 1):
        rest = block != b
        out[~rest] = (series - A @ np.linalg.lstsq(A[rest], series[rest], rcond=None)[0])[~rest]
    scale = max(1.4826 * np.median(np.abs(np.diff(series))) / np.sqrt(2), 1e-9)
    gain = compare(series - series.mean(), out, block, scale)
    predicted = sign_flip(gain) < 0.02
    alike = abs(np.corrcoef(trend(time), warm)[0, 1]) > _ALIKE  # where both go one way they are not parted
    if not predicted:
        return [*ties, "thermal"] if alike else ties
    if gain.sum() <= _EXPLAINED * finding.nats:
        return [*ties, "thermal"]
    finding.detector = Thermal.detector  # another channel predicts it, whatever its cause
    slope = float(np.linalg.lstsq(A, series, rcond=None)[0][1])
    spread = float(np.sqrt(np.mean(out**2)) / (np.std(warm) * np.sqrt(len(warm))))
    alpha = {"alpha": (-slope, -slope - 2 * spread, -slope + 2 * spread)}
    if not Thermal().possible(alpha):
        return ties
    ties, finding.id, finding.parameters = [finding.id, *ties], "thermal", alpha
    fraction = finding.fraction

    def correct(counts, at):
        warmer = np.interp(at, clock, heat) - heat[0]
        return counts_from_log_impedance(log_impedance(counts) - np.outer(slope * warmer, fraction))

    finding.correct = correct
    return ties
