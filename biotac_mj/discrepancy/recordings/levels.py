"""Levels over time: the strongest course that one electrode or all share, and all courses fitted once more,
each with the others taken out.

Directions are ranked by the energy that a course over time explains in units of the joint model (`model.py`),
so that an effect is charged to the channel that has it, and judged on blocks of time left out."""

import numpy as np

from ...sensor.channels import counts_from_log_impedance, log_impedance
from .courses import courses
from .findings import Finding
from .session import Session
from .shared import course_clues, shared_drift

__all__ = ["levels", "settle"]

_LEAST = 1.0  # [counts]: what is smaller rounding does as well


def levels(session: Session, refused: set) -> Finding | None:
    """The strongest course over time that one electrode or all have, none of those refused."""
    m = session.model()
    number = len(m.used)
    everyone = np.ones(number)
    level, time = m.levels(m.shared(everyone))
    weight = everyone @ m.precision[:number, :number] @ everyone
    options = [(_energy(courses(level, time)[0], time) * weight, None, level)]
    alone, _ = m.levels(m.alone())
    for i, k in enumerate(m.used):
        best = courses(alone[:, i], time)[0]
        options.append((_energy(best, time) * m.precision[i, i], int(k), alone[:, i]))
    options.sort(key=lambda o: -o[0])
    coarse = [f for f in session.findings if f.id == "quantise"]
    for energy, k, level in [o for o in options if (o[1],) not in refused][:6]:
        course = courses(level, time, thorough=True)[0]
        if course.p > 0.02 or course.nats < 6 or energy < 30:
            continue
        slope = m.slope.mean() if k is None else m.slope[m.used == k][0]
        if course.size * slope < max(_LEAST, *(f.parameters["step"][0] for f in coarse), 0):
            continue
        if k is not None and course.kind == "smooth" and not m.parted:
            continue  # in so short a time an electrode creeps with the load as well
        if k is None and course.kind == "both":  # a jump of the supply beside a warm-up: one after the other
            course = course.parts()[0]
        return shared_drift(session, course, options) if k is None else _single(session, course, k, options)
    return None


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
    lead = next(o[0] for o in options if o[1] == k) / max(o[0] for o in options if o[1] not in (k, None))
    error = 2 * m.slope[i] * float(np.median(np.abs(np.diff(m.levels(m.alone())[0][:, i]))))
    return Finding(
        "drift",
        (k,),
        {"change": (change, change - error, change + error)},
        course.nats,
        course.p,
        course.start,
        time[-1],
        note=f"{'a step' if course.kind == 'step' else 'a course over time'} of "
        f"{course.size * m.slope[i]:.0f} counts against what the other electrodes say",
        clues=course_clues(session, course, course.size * m.slope[i], m.activity[i] * m.slope[i])
        | {"lead": float(np.clip(np.log(lead), -1, 2)), "stands": _stands(m, i), "course": course},
        correct=correct,
    )


def _stands(m, i):
    """Logarithm of how much more the levels of electrode i wander about their mean than those of the
    others, in counts."""
    level, _ = m.levels(m.alone())
    size = level.std(0) * m.slope + 0.3
    return float(np.log(size[i] / np.median(np.delete(size, i))))


def settle(session: Session) -> None:
    """Fits the courses again, each with all others taken out: what was found first had the others in it."""
    for _ in range(2):
        for finding in [f for f in session.findings if "course" in f.clues]:
            other = session.without(finding)
            m = other.model()
            if "share" in finding.clues:
                pattern = finding.clues["share"][m.used]
                series = m.shared(pattern)
            elif finding.channels[0] in m.used:
                series = m.alone()[:, int(np.flatnonzero(m.used == finding.channels[0])[0])]
            else:
                continue
            common = "share" in finding.clues
            kinds = ("step", "smooth", "both") if not common else (finding.clues["course"].kind,)
            course = courses(*m.levels(series), thorough=True, kinds=kinds)[0]
            options = [(1.0, None, None), (1.0, finding.channels[0], None), (1.0, -1, None)]
            again = (
                shared_drift(other, course, options)
                if common
                else _single(other, course, finding.channels[0], options)
            )
            finding.correct, finding.parameters, finding.start = again.correct, again.parameters, again.start
            finding.nats, finding.p, finding.note = again.nats, again.p, again.note
            finding.clues |= {k: v for k, v in again.clues.items() if k != "lead"}
            if "share" in finding.clues:
                finding.id, finding.ties = again.id, again.ties
            session.replay()
