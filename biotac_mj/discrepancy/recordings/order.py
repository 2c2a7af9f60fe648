"""Exchanged channels: which carry each other's signal on one side of a time."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..evidence import sign_flip
from .courses import BLOCKS
from .findings import Finding
from .session import Session

__all__ = ["exchanged"]

_MOST = 8  # channels
_EARNED = 0.95  # of the misfit left by an exchange at most


def exchanged(session: Session) -> Finding | None:
    """Channels that carry each other's signal on one side of a time: exchanges that lower the misfit to the
    Gaussian of the other side, one after another, so that cycles are found as well."""
    m = session.model()
    # levels are compared as they are: an electrode in another's place has the other's level
    x, number = (m.value + m.mean)[m.inside], len(m.used)
    if not m.dimensions:  # what all do alike, a warm-up, is no order
        x = x - m.shared(np.ones(number))[m.inside][:, None]
    n, best = len(x), None
    if m.dimensions and m.time[m.inside][-1] < BLOCKS:
        return None
    for cut in np.unique(np.linspace(0.08 * n, 0.92 * n, 22).astype(int)):
        late = cut > n / 2
        gap = max(2, n // 44)
        normal, other = (x[: cut - gap], x[cut + gap :]) if late else (x[cut + gap :], x[: cut - gap])
        if len(other) < 10 or len(normal) < 2 * number:
            continue
        mean, P = _usual(m, normal)
        order, cost = _reorder(other, mean, P)
        if (order != np.arange(number)).any():
            ratio = np.log(cost[0] / cost[1])
            if best is None or ratio * len(other) > best[0]:
                best = ratio * len(other), cut, late, order, mean, P, normal, other
    if best is None:
        return None
    _, cut, late, order, mean, P, normal, other = best

    def misfit(rows, by):
        d = rows[:, by] - mean
        return ((d @ P) * d).sum(1) / number

    straight = np.arange(number)
    # the row at which exchanging turns from worse to better, and what lies on its side
    cost = np.clip(misfit(x, straight) - misfit(x, order), -200, 200)
    total = np.cumsum(cost)
    edge = int(np.argmin(total) if late else np.argmax(total))
    normal, other = (x[:edge], x[edge + 1 :]) if late else (x[edge + 1 :], x[:edge])
    if min(len(normal), len(other)) < 10:
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
    onset = float(m.time[edge] + m.period / 2)
    # which side is right nothing says: the channels were in order first
    order = order if late else np.argsort(order)
    channels, source = m.used[moved], m.used[order[moved]]
    last = session.recording.time[-1]

    def correct(counts, at):
        out = counts.copy()
        rows = at > onset
        out[np.ix_(rows, channels)] = counts[np.ix_(rows, source)]
        return out

    return Finding(
        "swap",
        tuple(int(k) for k in channels),
        {"onset": (onset, onset - m.period, onset + m.period)},
        float(gain.sum()),
        p,
        onset,
        float(last),
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

    def cost(order):
        return float((P * second[np.ix_(order, order)]).sum() - 2 * mean @ P @ first[order] + mean @ P @ mean)

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
