"""Exchanged channels: which carry each other's signal on one side of a time."""

import itertools

import numpy as np
from scipy.optimize import linear_sum_assignment

from ...evidence import sign_flip
from ..findings import Finding
from ..session import Session
from .courses import BLOCKS
from .wiring import Wiring, earlier

__all__ = ["exchanged"]

_MOST = 8  # channels
_PARTS = 9  # of the rows fitted, between whose edges channels may be exchanged
_EARNED = 0.95  # of the misfit left by an exchange at most


def exchanged(session: Session) -> Finding | None:
    """Channels that carry each other's signal on one side of a time: exchanges that lower the misfit to the
    Gaussian of the other side, one after another, so that cycles are found as well."""
    m = session.model()
    # levels are compared as they are: an electrode in another's place has the other's level
    x, number = (m.value + m.mean)[m.inside], len(m.used)
    if not m.dimensions:  # what all do alike, a warm-up, is no order
        x = x - m.shared(np.ones(number))[m.inside][:, None]
    n, best, straight = len(x), None, np.arange(number)
    if m.dimensions and m.time[m.inside][-1] < BLOCKS:
        return None
    edges = np.unique(np.linspace(0, n, _PARTS + 1).astype(int))
    gap = max(2, n // 44)
    for first, last in itertools.combinations(edges, 2):
        inside = np.arange(first + (gap if first else 0), last - (gap if last < n else 0))
        outside = np.r_[: max(first - gap, 0), min(last + gap, n) : n]
        if len(inside) < max(10, n // 12) or len(outside) < max(2 * number, len(inside)):
            continue
        mean, P = _usual(m, x[outside])
        order, cost = _reorder(x[inside], mean, P)
        if (order != straight).any():
            ratio = np.log(cost[0] / cost[1]) * len(inside)
            if best is None or ratio > best[0]:
                best = ratio, order, mean, P
    if best is None:
        return None
    _, order, mean, P = best

    def misfit(rows, by):
        d = rows[:, by] - mean
        return ((d @ P) * d).sum(1) / number

    for again in range(3):  # the rows between which exchanging makes most better, and then what is normal
        cost = np.clip(misfit(x, straight) - misfit(x, order), -200, 200)
        first, last = _span(np.concatenate([[0.0], np.cumsum(cost)]))
        where = np.zeros(n, bool)
        where[first:last] = True
        normal, other = x[~where], x[where]
        if len(normal) < max(10, number) or len(other) < 10:
            return None
        if again < 2:
            mean, P = _usual(m, normal)
            order = _reorder(other, mean, P)[0]
            if (order == straight).all():
                return None
    order = _needed(order, normal, other, mean, P)
    moved = np.flatnonzero(order != straight)
    if not 0 < len(moved) <= _MOST:
        return None
    usual = float(np.mean(misfit(normal, straight)))
    block = np.arange(len(other)) * min(BLOCKS, len(other)) // len(other)
    number_of = np.bincount(block)
    now, then = (np.bincount(block, misfit(other, by)) / number_of for by in (straight, order))
    gain = 0.5 * number * np.log((now + usual) / (then + usual))
    p = sign_flip(gain)
    if p > 0.01:
        return None
    time, last_time = m.time[m.inside], session.recording.time[-1]
    begins, ends = float(time[first] - m.period / 2), float(time[last - 1] + m.period / 2)
    # which side is right sound sensors say; else the channels were in order first
    inverse = np.argsort(order)
    if first == 0 and last < n:
        if not earlier(session, _wiring(m.used, order), ends):
            order, begins, ends = inverse, ends, float(last_time)
    elif last == n and first > 0 and earlier(session, _wiring(m.used, inverse), begins):
        order, begins, ends = inverse, 0.0, begins
    elif last == n:
        ends = float(last_time)
    channels, source = m.used[moved], m.used[order[moved]]

    def correct(counts, at):
        out = counts.copy()
        rows = (at > begins) & (at <= ends)
        out[np.ix_(rows, channels)] = counts[np.ix_(rows, source)]
        return out

    return Finding(
        "swap",
        tuple(int(k) for k in channels),
        {"onset": (begins, begins - m.period, begins + m.period)},
        float(gain.sum()),
        p,
        begins,
        ends,
        note=" ".join(f"e{a + 1} carries e{b + 1}" for a, b in zip(source, channels)),
        clues={
            "nats": float(gain.mean()) / number,
            "left": float(np.log(then.mean() / usual)),
            "ratio": float(np.log(now.mean() / then.mean())),
            "moved": float(len(moved)),
            "blocks": float(np.mean(gain > 0)),
            "seconds": float(np.log(m.time[m.inside][-1])),
        },
        correct=correct,
    )


def _wiring(used, order):
    """Of an order (c,) of the electrodes used (c,)."""
    whole = np.arange(19)
    whole[used] = used[order]
    moved = np.flatnonzero(whole != np.arange(19))
    return Wiring("swap", tuple(moved.tolist()), 1.0, tuple(whole.tolist()))


def _span(total):
    """First and last row between which a sum (n + 1,) grows most, a side that hardly changes it included."""
    low = np.minimum.accumulate(total)
    last = int(np.argmax(total - low))
    first = int(np.argmin(total[: last + 1]))
    grown = total[last] - total[first]
    first = 0 if total[first] - total[0] > -0.02 * grown else first
    last = len(total) - 1 if total[last] - total[-1] < 0.02 * grown else last
    return first, last


def _needed(order, normal, other, mean, P):
    """The exchanges of an order that all of their channels need by their own data: said by those channels
    that were not moved, each of a cycle misses its place by more than it did before, and fits the new one
    better. One that jumped beside another's level does not, nor one whose partner alone has changed."""
    order, straight = order.copy(), np.arange(len(order))
    covariance = np.linalg.inv(P)
    left = set(np.flatnonzero(order != straight))
    while left:
        cycle = [left.pop()]
        while order[cycle[-1]] != cycle[0]:
            cycle.append(order[cycle[-1]])
        left -= set(cycle)
        moved = np.flatnonzero(order != straight)
        for k in cycle:
            keep = np.append(np.setdiff1d(straight, moved), k)
            row = np.linalg.inv(covariance[np.ix_(keep, keep)])[-1]

            def off(x, k=k, keep=keep, row=row):
                """RMS of what channel k carries in its place against what those not moved say."""
                columns = np.append(keep[:-1], k)
                return np.sqrt(np.mean(((x - mean[columns]) @ row / row[-1]) ** 2))

            before = off(normal[:, keep])
            now = off(other[:, keep])
            then = off(other[:, np.append(keep[:-1], order[k])])
            if now < 2 * before or then > 0.6 * now:
                order[cycle] = cycle
                break
    return order


def _usual(m, normal):
    """Mean and precision of levels and changes of the side that is taken as normal."""
    mean = normal.mean(0)
    centred = normal - mean
    floor = m.noise**2 + (0.02 if m.dimensions else 0.005) ** 2  # ln Z: warm-up goes on between the sides
    return mean, np.linalg.inv(centred.T @ centred / len(normal) + np.diag(floor))


def _reorder(other, mean, P):
    """Order (c,) of columns that fits best, from exchanges one after another, begun at the order there is
    and at the one by levels alone; and mean misfit before and after."""
    n, number = other.shape
    second, first = other.T @ other / n, other.mean(0)
    slope, least = 2 * mean @ P, mean @ P @ mean

    def cost(order):
        return float((P * second[order[:, None], order]).sum() - slope @ first[order] + least)

    def improved(order):
        now = cost(order)
        for _ in range(6):
            best = now, order
            for a in range(number):
                for b in range(a + 1, number):
                    trial = order.copy()
                    trial[a], trial[b] = order[b], order[a]
                    best = min(best, (cost(trial), trial), key=lambda o: o[0])
            if best[0] > _EARNED * now:
                break
            now, order = best
        return order, now

    straight = np.arange(number)
    start = cost(straight)
    spread = np.sqrt(np.diag(np.linalg.inv(P)))
    distance = np.minimum(((first - mean[:, None]) / spread[:, None]) ** 2, 1e4)
    by_level = linear_sum_assignment(distance)[1]
    options = [improved(straight)]
    if 0 < (by_level != straight).sum() <= _MOST:
        options.append(improved(by_level))
    # every channel more has to earn its place
    order, now = min(options, key=lambda o: o[1] / _EARNED ** (o[0] != straight).sum())
    return order, (start, now)
