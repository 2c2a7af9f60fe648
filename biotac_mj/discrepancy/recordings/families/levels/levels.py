"""Levels over time: the strongest course that one electrode or all share, and all courses fitted once more,
each with the others taken out.

Directions are ranked by the energy that a course over time explains in units of the joint model (`model.py`),
so that an effect is charged to the channel that has it, and judged on blocks of time left out. Where
something moves, single electrodes are processes of the others and of time (`process.py`)."""

import numpy as np

from .....geometry.electrodes import electrode_positions
from .....sensor.channels import FULL_SCALE, counts_from_log_impedance, log_impedance, temperature_from_counts
from ....evidence import sign_flip
from ...candidates import Candidate
from ...model import Model
from ...session import Session
from ..courses import BLOCKS, SHARP, Course, compare, courses, sharp
from .process import process
from .together import ahead

__all__ = ["levels", "settle"]

_LEAST = 1.0  # [counts]: what is smaller rounding does as well
# of a shared drift's shares about their mean: 8-15 % seen in a real unloaded sensor
_SHARES = 0.12
# off their median at most: the weakest of a real unloaded sensor has 65 % of it
_ALONE = 0.7
_NAN = float("nan")
_SHAPES = ("step", "smooth", "both")
_ALL_SHAPES = (*_SHAPES, "walk")
_PLAINLY = 3.3  # logarithm of its energy over another's, beyond which it is no matter of energy
_ALIKE = 0.9  # correlation of a course with the thermistor's
_TOLD = 0.35  # of the evidence that the thermistor alone has to explain
_NATS = 12.0  # of a drift beside a load
_ANSWERS = 0.8  # of what a drift explains beside a load, that a change of answers explains as well
_CANDIDATES = 3  # electrodes that may drift beside a load, the plainest first
_MOSTLY = 0.6  # of a course that what all do explains, which may be a share of it


def levels(session: Session, refused: set) -> Candidate | None:
    """The strongest course over time that one electrode or all have, none of those refused."""
    m = session.model()
    number = len(m.used)
    everyone = np.ones(number)
    level, time = m.levels(m.shared(everyone))
    best = courses(level, time)[0]
    finding = _beside(session, refused, best)
    if finding is not None:
        return finding
    weight = everyone @ m.given.precision[:number, :number] @ everyone
    options = [(_energy(best, time) * weight, None, level)]
    alone, _ = m.levels(m.alone())
    for i, k in enumerate(m.used):
        best = courses(alone[:, i], time)[0]
        options.append((_energy(best, time) / m.given.noise[i] ** 2, int(k), alone[:, i]))
    options.sort(key=lambda o: -o[0])
    coarse = [f for f in session.findings if f.id == "quantise"]
    tried = [o for o in options if (o[1],) not in refused]
    # of single electrodes the levels wander with a load as well
    for energy, k, level in [o for o in tried if o[1] is None] if m.moved else tried[:6]:
        course = courses(level, time, thorough=True, kinds=_SHAPES if k is None else _ALL_SHAPES)[0]
        if k is None and course.kind == "step" and sharp(level, time, course.onset) <= SHARP:
            # where the load's level changes all drift a little: a step that does not stand out is none
            course = courses(level, time, thorough=True, kinds=("smooth",))[0]
        if course.p > 0.02 or course.nats < 6 or energy < 30:
            continue
        slope = m.slope.mean() if k is None else m.slope[m.used == k][0]
        if course.size * slope < max(_LEAST, *(f.parameters["step"][0] for f in coarse), 0):
            continue
        if k is not None and _own_share(session, course, course.size):
            continue
        if k is None and course.kind == "both":  # a jump of the supply beside a warm-up: one after the other
            course = course.parts()[0]
        return _shared(session, course, options) if k is None else _single(session, course, k, options)
    return None


def _beside(session, refused, common):
    """The electrode that drifts beside a load most plainly, of those that were not refused, none whose drift
    may be its share of what all do (common: a course [ln Z])."""
    m = session.model()
    drifting = _drifting(session)
    every = process(m, drifting)
    if every is None:
        return None
    nats = np.array([every.nats(i) for i in range(len(m.used))])
    for i in np.argsort(-nats)[:_CANDIDATES]:
        k = int(m.used[i])
        if (k,) in refused or k in drifting or nats[i] < _NATS:
            continue
        course = every.course(int(i))
        if course.size * m.slope[i] < _LEAST or _own_share(session, course, course.size, common):
            continue
        finding = _single(session, course, k, [(1.0, k, None), (1.0, -1, None)])
        answers = every.answers(int(i))
        finding.clues |= {
            "likelier": float(nats[i] / len(course.gain)),
            "beyond": float((nats[i] - answers) / len(course.gain)),
            "seconds": float(np.log(m.time[-1])),
        }
        if answers > _ANSWERS * nats[i]:
            finding.ties = ("gain",)
        return finding
    return None


def _drifting(session):
    """Electrodes that drift beside a load: what they do in the rows kept aside is not taken out."""
    return frozenset(f.channels[0] for f in session.findings if "likelier" in f.clues)


def _own_share(session, course, size, *common):
    """Whether a course of a size [ln Z] is mostly what all do, or have done, times something: an own share
    may be four standard deviations off."""
    found = [f.clues["course"] for f in session.findings if {"share", "course"} <= f.clues.keys()]
    y = course.sampled() - course.sampled().mean()
    for all_do in (*common, *found):
        g = all_do.sampled() - all_do.sampled().mean()
        if size < 4 * _SHARES * all_do.size and (y @ g) ** 2 > _MOSTLY * (y @ y) * (g @ g):
            return True
    return False


def _energy(course, time):
    y = course(time)
    return float(((y - y.mean()) ** 2).sum())


def _single(session, course, k, options):
    m = session.model()
    i = int(np.flatnonzero(m.used == k)[0])
    time = session.recording.time
    before = course(time[:1])[0]

    def correct(counts, at):
        out = counts.copy()
        out[:, k] = counts_from_log_impedance(log_impedance(counts[:, k]) - (course(at) - before))
        return out

    change = -float(course.sampled()[-1] - course.sampled()[0]) * m.slope[i]
    single = {o[1]: o[0] for o in options if o[1] is not None}
    lead = ahead(np.log(np.maximum([*single.values()], 1e-12)), np.array([*single]), k)
    error = 2 * m.slope[i] * float(np.median(np.abs(np.diff(m.levels(m.alone())[0][:, i]))))
    return Candidate(
        "drift",
        (k,),
        {"change": (change, change - error, change + error)},
        course.nats,
        course.p,
        course.start,
        time[-1],
        note=f"{'a step' if course.kind == 'step' else 'a course over time'} of "
        f"{course.size * m.slope[i]:.0f} counts against what the other electrodes say",
        clues=_clues(session, course, course.size * m.slope[i], m.activity[i] * m.slope[i])
        | dict(zip(("stands", "apart"), _stands(m, k)))
        | {"lead": float(np.clip(lead, -1, _PLAINLY)), "course": course},
        correct=correct,
    )


def _stands(m, k):
    """Logarithms of how much more the levels of electrode k wander about their mean than those of the others,
    in counts: than their median, than those that have no course of their own."""
    level, _ = m.levels(m.alone())
    size = np.log(level.std(0) * m.slope + 0.3)
    mine, others = size[m.used == k][0], size[m.used != k]
    return float(mine - np.median(others)), ahead(size, m.used, k)


def settle(session: Session) -> None:
    """Fits the courses again, each with all others taken out: what was found first had the others in it."""
    for _ in range(2):
        for finding in [f for f in session.findings if "course" in f.clues]:
            other = session.without(finding)
            m, place = other.model(), np.flatnonzero(other.model().used == finding.channels[0])
            common = "share" in finding.clues
            if not common and not len(place):
                continue
            every = process(m, _drifting(other)) if "likelier" in finding.clues else None
            if every is not None:
                course = every.course(int(place[0]))
            else:
                series = m.shared(finding.clues["share"][m.used]) if common else m.alone()[:, int(place[0])]
                kinds = _ALL_SHAPES if not common else (finding.clues["course"].kind,)
                course = courses(*m.levels(series), thorough=True, kinds=kinds)[0]
            options = [(1.0, None, None), (1.0, finding.channels[0], None), (1.0, -1, None)]
            again = (
                _shared(other, course, options)
                if common
                else _single(other, course, finding.channels[0], options)
            )
            finding.correct, finding.parameters, finding.start = again.correct, again.parameters, again.start
            finding.nats, finding.p, finding.note = again.nats, again.p, again.note
            finding.clues |= {k: v for k, v in again.clues.items() if k != "lead"}
            if common:
                finding.id, finding.ties = again.id, again.ties
            session.replay()


# --- a drift that all share, each with a share of its own


def _clues(session, course, size, activity):
    m = session.model()
    return {
        "nats": course.nats / len(course.gain),
        "size": float(np.log(size / (activity + 2 * np.median(m.noise * m.slope) + 1))),
        "counts": float(np.log(max(size, 0.1))),
        "turns": float(np.log(max(course.turns, 1.0))),
        "blocks": float(np.mean(course.gain > 0)),
        # under load what all share is told from it only where there is time for both
        "room": float(min(np.log(session.fit.sum() / session.recording.rate / 90), 0))
        if m.dimensions
        else 0.0,
    }


def _shared(session, course, options):
    m, time = session.model(), session.recording.time
    share = np.ones(19)
    own = {f.channels[0] for f in session.findings if len(f.channels) == 1 and f.correct is not None}
    share[m.used] = _shares(m, course, np.isin(m.used, list(own)))
    before = course(time[:1])[0]

    def correct(counts, at):
        return counts_from_log_impedance(log_impedance(counts) - np.outer(course(at) - before, share))

    sampled = course.sampled()
    change = float(sampled[-1] - sampled[0])
    size = course.size * float(m.slope.mean())
    others = max((o[0] for o in options if o[1] is not None), default=1.0)
    finding = Candidate(
        "warmup",
        tuple(range(19)),
        {},
        course.nats,
        course.p,
        course.start,
        time[-1],
        note=f"ln Z of all electrodes changes by {change:+.3f} ({size:.0f} counts); shares "
        f"{share[m.used].min():.2f} to {share[m.used].max():.2f}",
        clues=_clues(session, course, size, float((m.activity * m.slope).mean()))
        | {
            "lead": float(np.log(_energy_of_all(options) / max(others, 1e-9))),
            "uneven": _uneven(m, course),
            "seconds": float(np.log(session.fit.sum() / session.recording.rate)),
            "course": course,
            "share": share,
        },
        correct=correct,
    )
    _name_shared(session, finding, course, change)
    return finding


def _uneven(m, course):
    """Logarithm of how much electrodes differ in a course, against its median: a warm-up's are alike, a
    touch's are not; 0.2 under load, which hides it."""
    if m.dimensions:
        return float(np.log(0.2))
    level, time = m.levels(m.value)
    y = course(time)
    each = level.T @ (y - y.mean())
    spread = 1.4826 * np.median(np.abs(each - np.median(each)))
    return float(np.log(np.clip(spread / max(abs(np.median(each)), 1e-12), 0.05, 5)))


def _energy_of_all(options: list) -> float:
    """Energy of the direction that all electrodes share."""
    return next(o[0] for o in options if o[1] is None)


def _shares(m: Model, course: Course, own: np.ndarray) -> np.ndarray:
    """(c,) of a drift, about one: generalised least squares on the cells' levels, drawn towards their mean;
    where an electrode has a change of its own (c,) bool, the mean of its three neighbours'."""
    number = len(m.used)
    level, time = m.levels(m.value)
    g = course(time)
    g = g - g.mean()
    marginal = m.given.marginal()
    alone = m.levels(m.alone())[0]
    alone = alone - alone.mean(0)
    alone = alone - np.outer(g, g @ alone / max(g @ g, 1e-12))
    # the cells' levels wander by more than the changes within them, and remember where they have been
    memory = np.clip((alone[1:] * alone[:-1]).sum(0) / np.maximum((alone**2).sum(0), 1e-12), 0, 0.95)
    scatter = (alone**2).mean(0) * (1 + memory) / (1 - memory)
    worse = max(float(np.median(scatter / m.given.noise**2)), 1e-9)
    share = np.ones(number)
    for _ in range(
        3
    ):  # shares far off belong to a change of one electrode: they are drawn to the mean all the more
        off = (share - np.median(share)) / _SHARES
        pull = (1 / (1 + (off / 4) ** 2)) / _SHARES**2
        pull = (
            np.maximum(pull, 1 / _SHARES**2 * 0.05) if m.dimensions == 0 else np.full(number, 1 / _SHARES**2)
        )
        A = g @ g / worse * marginal + np.diag(pull)
        share = np.linalg.solve(A, marginal @ (level.T @ g) / worse + pull * np.median(share))
    if not m.dimensions:  # unloaded: a share that far off is a change of that electrode alone
        own = own | (np.abs(share - np.median(share)) > _ALONE)
    place = electrode_positions()[m.used]
    for i in np.flatnonzero(own):
        near = np.argsort(np.linalg.norm(place - place[i], axis=1) + 1e3 * own)[:3]
        share[i] = share[near].mean()
    return share


def _name_shared(session, finding, course, change):
    """Which of the shared effects it is: temperature if TDC follows it, else by pattern, sign and course."""
    m = session.model()
    number = len(m.used)
    e = np.clip(np.median(session.counts[session.fit][:, m.used], axis=0), 1, FULL_SCALE - 1)
    level, time = m.levels(m.whole)
    block = np.arange(len(time)) * min(BLOCKS, len(time) // 2) // len(time)
    y = course(time)
    y = (y - y.mean()) / max(np.sqrt(((y - y.mean()) ** 2).sum()), 1e-12)
    amplitude = (level - level.mean(0)).T @ y  # (c + products,) of the course in every channel
    misfit = {}
    for name, pattern in (
        ("warmup", np.ones(number)),
        ("count_offset", 1 / m.slope),
        ("count_gain", e / m.slope),
    ):
        size = m.given.along(pattern, amplitude[None])[0]
        # every electrode has its own share: what is beyond that
        spread = m.given.noise**2 + (_SHARES * size * pattern) ** 2
        beyond = amplitude - size * np.r_[pattern, np.zeros(len(amplitude) - number)]
        left = m.given.residual(beyond[None])[0] if m.dimensions else beyond
        misfit[name] = float(left @ (left / spread))
    rising = change > 0
    # every sensor warms up, and to a course that is uneven a step fits as well: a step has to be sharp
    common, at = m.levels(m.shared(np.ones(number)))
    sudden = course.kind == "step" and sharp(common, at, course.onset) > SHARP
    order = ["fluidloss", "warmup"] if rising else ["warmup"]
    order = [*order, "count_offset", "count_gain"] if not sudden else ["count_offset", "count_gain", *order]
    best = min(misfit.values())
    close = [i for i in order if misfit.get("warmup" if i == "fluidloss" else i) < 2 * best + 12]
    tdc = session.recording.tdc
    ties = close[1:]
    finding.id = close[0]
    if tdc is not None:
        clock = session.recording.time
        warm = np.interp(time, clock, temperature_from_counts(tdc))
        if np.ptp(warm) > 0.05:
            series, _ = m.levels(m.shared(np.ones(number)))
            null = series - series.mean()
            A = np.column_stack([np.ones(len(warm)), warm])
            out = np.empty(len(series))
            for b in range(block[-1] + 1):
                rest = block != b
                out[~rest] = (series - A @ np.linalg.lstsq(A[rest], series[rest], rcond=None)[0])[~rest]
            scale = max(1.4826 * np.median(np.abs(np.diff(series))) / np.sqrt(2), 1e-9)
            gain = compare(null, out, block, scale)
            slope = float(np.linalg.lstsq(A, series, rcond=None)[0][1])
            told = sign_flip(gain) < 0.02
            alike = abs(np.corrcoef(y, warm)[0, 1]) > _ALIKE  # where both go one way they are not parted
            if alike and not told or told and gain.sum() <= _TOLD * finding.nats:
                ties = [*ties, "thermal"]
            elif told:
                ties, finding.id = [finding.id, *ties], "thermal"
                spread = float(np.sqrt(np.mean(out**2)) / (np.std(warm) * np.sqrt(len(warm))))
                finding.parameters = {"alpha": (-slope, -slope - 2 * spread, -slope + 2 * spread)}
                share, heat = finding.clues["share"], temperature_from_counts(tdc)

                def by_temperature(counts, at):
                    warmer = np.interp(at, clock, heat) - heat[0]
                    return counts_from_log_impedance(log_impedance(counts) - np.outer(slope * warmer, share))

                finding.correct = by_temperature
    if not session.recording.absolute:  # the patterns follow from the levels, the sign from the sign
        alike = ["warmup", "count_offset", "count_gain"]
        alike += ["fluidloss"] if not session.recording.signed or rising else []
        ties = [*ties, *(i for i in alike if i != finding.id and i not in ties)]
    finding.ties = tuple(ties)
    if finding.id == "warmup":
        finding.parameters = _warm_up(course)
    elif finding.id == "fluidloss":
        lost = 1 - np.exp(-np.array([change, 0.9 * change, 1.1 * change]))
        finding.parameters = {"rate": tuple(3600 / course.knots[-1] * lost)}
    elif finding.id == "count_offset":
        value = -change * float(m.slope.mean())
        finding.parameters = {"change": (value, _NAN, _NAN)}
    elif finding.id == "count_gain":
        value = -change * float((m.slope / e).mean())
        finding.parameters = {"change": (value, _NAN, _NAN)}


def _warm_up(course: Course) -> dict:
    """a, tau of a (1 - exp(-t / tau)) that is next to a course."""
    time = np.linspace(course.knots[0], course.knots[-1], 200)
    y = course(time) - course(time[:1])
    span = time[-1]
    fits = []
    for tau in np.geomspace(0.05, 20, 60) * span:
        basis = np.column_stack([1 - np.exp(-time / tau), np.ones(len(time))])
        w, *_ = np.linalg.lstsq(basis, y, rcond=None)
        fits.append((float(((y - basis @ w) ** 2).sum()), tau, w[0]))
    least = min(fits)
    near = [f for f in fits if f[0] < 1.5 * least[0] + 1e-4 * (y**2).sum()]
    return {
        name: (least[i], min(f[i] for f in near), max(f[i] for f in near))
        for name, i in (("a", 2), ("tau", 1))
    }
