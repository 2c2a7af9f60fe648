"""Exchanged channels: which carry each other's signal on one side of a time.

Where it happens between two rows (`slipped`) each goes on, from one to the next, where another was: no load
does that, and it needs neither its model nor a long recording. Else levels and changes of either side tell
it (`exchanged`)."""

import itertools

import numpy as np
from scipy.optimize import linear_sum_assignment

from ....quality.noise import noise_level
from ...evidence import sign_flip
from ..candidates import Candidate, Detector
from ..conditional import Conditional
from ..session import Session
from .trends import BLOCKS

__all__ = ["ORDER", "exchanged", "slipped"]

_MOST = 8  # channels
_PARTS = 9  # of the rows fitted, between whose edges channels may be exchanged
_EARNED = 0.95  # of the misfit left by an exchange at most
_ON = 1.8  # of what it may have moved by meanwhile: a channel goes on where another was
# of the same: by this much it jumps, in the median of those exchanged and each. In 740 recordings of four
# authors 23 exchanges reach 10.3, and of all else that goes on so 9.3
_JUMPS, _EACH = 10.0, 2.5
_ELSE = 4.0  # others jump by no more
_RARE = 3  # of these in a recording: what comes and goes is none


ORDER, SLIP = Detector("order"), Detector("slip", sudden=True)


def slipped(session: Session) -> Candidate | None:
    """Channels that from one row to the next go on where others were, until they do so back, if they do."""
    r = session.recording
    rows = np.flatnonzero(session.fit & ~r.repeated & ~session.masked.all(1))
    used = np.flatnonzero(~session.masked[rows].any(0))
    x = session.counts[np.ix_(rows, used)]
    if len(rows) < 200 or len(used) < 7:
        return None
    coarse = session.step
    noise, step = np.maximum(noise_level(x), max(0.7, coarse)), np.abs(np.diff(x, axis=0))
    sudden = (step > 5 * np.maximum(np.quantile(step, 0.9, axis=0), 2 * noise)).sum(1) >= 2
    found = []
    for t in np.flatnonzero(sudden[2:-2]) + 2:
        # ends of lines through the rows before and after, and what these lines leave open
        a, b = (x[t] - x[t - 2]) / 2, (x[t + 3] - x[t + 1]) / 2
        rough = np.maximum(3 * noise, np.abs(a) + np.abs(b)) + 1
        off = np.abs((x[t + 1] - b / 2)[:, None] - (x[t] + a / 2)) / np.sqrt(np.outer(rough, rough))
        order = _goes_on(off)
        here = np.diag(off)[order == np.arange(len(order))]
        if (order != np.arange(len(order))).any() and (here < _ELSE).all():
            found.append((t, order, off))
    if not 0 < len(found) <= _RARE:
        return None
    t, order, off = found[0]
    moved, begins = np.flatnonzero(order != np.arange(len(order))), r.time[rows[t]] + 0.5 / r.rate
    # a second exchange undoes the first or is another fault
    back = [s for s, other, _ in found[1:] if (other[order] == np.arange(len(order))).all()]
    ends = float(r.time[rows[back[0]]] + 0.5 / r.rate) if back else float(r.time[-1])
    carries = np.argsort(order)  # channel used[k] is read in place carries[k]
    channels, source = used[moved], used[carries[moved]]
    size = np.diag(off)[moved]
    finding = _swap(
        channels,
        source,
        (begins, ends),
        begins or ends,
        1 / r.rate,
        float((size**2).sum() / 2),
        float(np.exp(-len(moved))) / len(rows),
        SLIP,
        {},
    )
    finding.note += ": each goes on there from one row to the next"
    finding.verified = True  # by the rows themselves
    return finding


def _goes_on(off):
    """Order (c,) in which channels go on where others were, by how far off each after a row (c,) is from each
    before it (, c): a rotation of all, or else exchanges that all of their channels need."""
    number = len(off)
    straight = np.arange(number)
    turns = [np.roll(straight, k) for k in range(1, number)]
    rotation = min(turns, key=lambda o: np.median(off[straight, o]))
    fits = off[straight, rotation] < _ON
    if fits.sum() > 0.8 * number and np.median(np.diag(off)) > _JUMPS:
        return rotation
    order = linear_sum_assignment(np.minimum(off, 50) ** 2)[1]
    out = straight.copy()
    for cycle in _cycles(order):
        now, then = np.diag(off)[cycle], off[cycle, order[cycle]]
        if then.max() < _ON and np.median(now) > _JUMPS and now.min() > _EACH:
            out[cycle] = order[cycle]
    return out


def exchanged(session: Session) -> Candidate | None:
    """Channels that carry each other's signal on one side of a time: exchanges that lower the misfit to the
    Gaussian of the other side, one after another, so that cycles are found as well."""
    m = session.model()
    # levels are compared as they are: an electrode in another's place has the other's level
    x, number = (m.value + m.mean)[m.inside], len(m.used)
    if number < 2:  # the others stand still
        return None
    if not m.dimensions:  # what all do alike, a warm-up, is no order
        x = x - m.shared(np.ones(number))[m.inside][:, None]
    elif m.time[m.inside][-1] < BLOCKS:
        return None
    n, best, straight = len(x), None, np.arange(number)
    # warm-up goes on between the sides
    floor = m.noise**2 + (0.02 if m.dimensions else 0.005) ** 2  # [ln Z]
    gap = max(2, n // 44)
    for first, last in itertools.combinations(np.unique(np.linspace(0, n, _PARTS + 1).astype(int)), 2):
        inside = np.arange(first + (gap if first else 0), last - (gap if last < n else 0))
        outside = np.r_[: max(first - gap, 0), min(last + gap, n) : n]
        if len(inside) < max(10, n // 12) or len(outside) < max(2 * number, len(inside)):
            continue
        order, ratio = _reorder(x[inside], *_usual(x[outside], floor))
        if best is None or ratio * len(inside) > best[0]:
            best = ratio * len(inside), order, outside
    if best is None or (best[1] == straight).all():
        return None
    _, order, normal = best
    mean, given = _usual(x[normal], floor)
    for again in range(3):  # the rows between which exchanging makes most better, and then what is normal
        gain = given.misfit(x - mean) - given.misfit(x[:, order] - mean)
        first, last = _span(np.concatenate([[0.0], np.cumsum(np.clip(gain, -200, 200))]))
        where = np.zeros(n, bool)
        where[first:last] = True
        normal, other = x[~where], x[where]
        if len(normal) < max(10, number) or len(other) < 10:
            return None
        if again < 2:
            mean, given = _usual(normal, floor)
            order, _ = _reorder(other, mean, given)
    order = _needed(order, normal - mean, other, mean, given)
    moved = np.flatnonzero(order != straight)
    if not 0 < len(moved) <= _MOST:
        return None
    usual = float(given.misfit(normal - mean).mean())
    parts = np.array_split(other, min(BLOCKS, len(other)))
    now, then = (np.array([given.misfit(p[:, by] - mean).mean() for p in parts]) for by in (straight, order))
    gain = 0.5 * number * np.log((now + usual) / (then + usual))
    p = sign_flip(gain)
    if p > 0.01:
        return None
    time, end = m.time[m.inside], float(session.recording.time[-1])
    begins, ends = float(time[first] - m.period / 2), float(time[last - 1] + m.period / 2)
    if first == 0 and last < n:  # the channels were in order first
        order, begins, ends = np.argsort(order), ends, end
    elif last == n:
        ends = end
    return _swap(
        m.used[moved],
        m.used[order[moved]],
        (begins, ends),
        begins,
        m.period,
        float(gain.sum()),
        p,
        ORDER,
        {"nats": float(gain.mean()) / number, "ratio": float(np.log(now.mean() / then.mean()))},
    )


def _swap(channels, source, where, onset, within, nats, p, detector, features):
    """Of channels (k,) whose signals are found in source (k,), from and until [s]; onset [s], by what it may
    be off."""
    begins, ends = where

    def correct(counts, at):
        out = counts.copy()
        rows = (at > begins) & (at <= ends)
        out[np.ix_(rows, channels)] = counts[np.ix_(rows, source)]
        return out

    return Candidate(
        "swap",
        tuple(int(k) for k in channels),
        {"onset": (onset, onset - within, onset + within)},
        nats,
        p,
        begins,
        ends,
        detector,
        ", ".join(f"e{a + 1} carries e{b + 1}" for a, b in zip(source, channels)),
        features=features,
        correct=correct,
    )


def _span(total):
    """First and last row between which a sum (n + 1,) grows most, a side that hardly changes it included."""
    low = np.minimum.accumulate(total)
    last = int(np.argmax(total - low))
    first = int(np.argmin(total[: last + 1]))
    grown = total[last] - total[first]
    first = 0 if total[first] - total[0] > -0.02 * grown else first
    last = len(total) - 1 if total[last] - total[-1] < 0.02 * grown else last
    return first, last


def _needed(order, normal, other, mean, given):
    """The exchanges of an order that all of their channels need by their own data: said by those channels
    that were not moved, each of a cycle misses its place by more than it did before, and fits the new one
    better. One that jumped beside another's level does not, nor one whose partner alone has changed.

    Args:
      normal: (n, c) about the mean (c,); other: (m, c).
    """
    order, straight = order.copy(), np.arange(len(order))
    covariance = np.linalg.inv(given.precision)
    for cycle in _cycles(order):
        kept = np.flatnonzero(order == straight)
        for k in cycle:
            columns = np.append(kept, k)
            alone = Conditional(covariance[np.ix_(columns, columns)], np.zeros(len(columns)))
            before, now, then = (
                np.sqrt(np.mean(alone.residual(rows - mean[columns] * about)[:, -1] ** 2))
                for rows, about in (
                    (normal[:, columns], 0.0),
                    (other[:, columns], 1.0),
                    (other[:, np.append(kept, order[k])], 1.0),
                )
            )
            if now < 2 * before or then > 0.6 * now:
                order[cycle] = cycle
                break
    return order


def _cycles(order):
    """Lists of the channels of an order (c,) that go round in one another's places."""
    left, cycles = set(np.flatnonzero(order != np.arange(len(order))).tolist()), []
    while left:
        cycle = [left.pop()]
        while order[cycle[-1]] != cycle[0]:
            cycle.append(int(order[cycle[-1]]))
        left -= set(cycle)
        cycles.append(cycle)
    return cycles


def _usual(normal, floor):
    """Mean and Gaussian of levels and changes of rows (n, c) that are taken as normal."""
    mean = normal.mean(0)
    return mean, Conditional((normal - mean).T @ (normal - mean) / len(normal), floor)


def _reorder(other, mean, given):
    """Order (c,) of columns of rows (n, c) that fits best, from exchanges one after another, begun at the
    order there is and at the one by levels alone; and logarithm of the mean misfit before over after."""
    number = other.shape[1]
    first, second = other.mean(0), other.T @ other / len(other)
    slope, least = 2 * given.precision @ mean, mean @ given.precision @ mean
    straight = np.arange(number)
    pairs = np.tile(straight, (number * (number - 1) // 2, 1))
    rows, (a, b) = np.arange(len(pairs)), np.triu_indices(number, 1)
    pairs[rows, a], pairs[rows, b] = b, a

    def cost(orders):
        """(k,) of orders (k, c)."""
        moved = second[orders[:, :, None], orders[:, None]]
        return (given.precision * moved).sum((1, 2)) - first[orders] @ slope + least

    def improved(order):
        now = float(cost(order[None])[0])
        for _ in range(6):
            tried = order[pairs]
            costs = cost(tried)
            if costs.min() > _EARNED * now:
                break
            order, now = tried[costs.argmin()], float(costs.min())
        return order, now

    distance = np.minimum(
        ((first - mean[:, None]) / np.sqrt(np.diag(np.linalg.inv(given.precision)))[:, None]) ** 2, 1e4
    )
    by_level = linear_sum_assignment(distance)[1]
    options = [improved(straight)]
    if 0 < (by_level != straight).sum() <= _MOST:
        options.append(improved(by_level))
    # every channel more has to earn its place
    order, now = min(options, key=lambda o: o[1] / _EARNED ** (o[0] != straight).sum())
    return order, float(np.log(cost(straight[None])[0] / now))
