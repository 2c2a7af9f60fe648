"""Exchanged channels: which carry each other's signal on one side of a time.

Where it happens between two rows (`slipped`) each goes on, from one to the next, where another was: no load
does that, and it needs neither its model nor a long recording. Else levels and changes of either side tell
it (`exchanged`)."""

import itertools

import numpy as np
from scipy.optimize import linear_sum_assignment

from ....quality.noise import noise_level
from ....sensor.channels import counts_from_log_impedance, log_impedance
from ...evidence import sign_flip
from ..findings import Finding
from ..session import Session
from .courses import BLOCKS
from .levels.jumps import edges

__all__ = ["exchanged", "reversed_sign", "slipped"]

_MOST = 8  # channels
_PARTS = 9  # of the rows fitted, between whose edges channels may be exchanged
_EARNED = 0.95  # of the misfit left by an exchange at most
_ON = 1.8  # of what it may have moved by meanwhile: a channel goes on where another was
# of the same: by this much it jumps, in the median of those exchanged and each. In 740 recordings of four
# authors 23 exchanges reach 10.3, and of all else that goes on so 9.3
_JUMPS, _EACH = 10.0, 2.5
_ELSE = 4.0  # others jump by no more
_FEWEST = 6  # windows on either side of a time, whose sign differs
_NEAR = 0.2  # [s] on either side, whose levels are compared
_RARE = 3  # of these in a recording: what comes and goes is none


def slipped(session: Session) -> Finding | None:
    """Channels that from one row to the next go on where others were, until they do so back, if they do."""
    r = session.recording
    rows = np.flatnonzero(session.fit & ~r.repeated & ~session.masked.all(1))
    used = np.flatnonzero(~session.masked[rows].any(0))
    x = session.counts[np.ix_(rows, used)]
    if len(rows) < 200 or len(used) < 7:
        return None
    coarse = max((f.parameters["step"][0] for f in session.findings if f.id == "quantise"), default=0.0)
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
        {"slip": float(np.log(np.median(size)))},
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
    out, left = straight.copy(), set(np.flatnonzero(order != straight))
    while left:
        cycle = [left.pop()]
        while order[cycle[-1]] != cycle[0]:
            cycle.append(order[cycle[-1]])
        left -= set(cycle)
        now, then = np.diag(off)[cycle], off[cycle, order[cycle]]
        if then.max() < _ON and np.median(now) > _JUMPS and now.min() > _EACH:
            out[cycle] = order[cycle]
    return out


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
    if first == 0 and last < n:  # the channels were in order first
        order, begins, ends = np.argsort(order), ends, float(last_time)
    elif last == n:
        ends = float(last_time)
    return _swap(
        m.used[moved],
        m.used[order[moved]],
        (begins, ends),
        begins,
        m.period,
        float(gain.sum()),
        p,
        {
            "nats": float(gain.mean()) / number,
            "left": float(np.log(then.mean() / usual)),
            "ratio": float(np.log(now.mean() / then.mean())),
            "moved": float(len(moved)),
            "blocks": float(np.mean(gain > 0)),
            "seconds": float(np.log(m.time[m.inside][-1])),
        },
    )


def _swap(channels, source, where, onset, within, nats, p, clues):
    """Of channels (k,) whose signals are found in source (k,), from and until [s]; onset [s], by what it may
    be off."""
    begins, ends = where

    def correct(counts, at):
        out = counts.copy()
        rows = (at > begins) & (at <= ends)
        out[np.ix_(rows, channels)] = counts[np.ix_(rows, source)]
        return out

    return Finding(
        "swap",
        tuple(int(k) for k in channels),
        {"onset": (onset, onset - within, onset + within)},
        nats,
        p,
        begins,
        ends,
        note=" ".join(f"e{a + 1} carries e{b + 1}" for a, b in zip(source, channels)),
        clues=clues,
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

    def changes(order):
        """(c, c) by which each exchange of two changes the cost: all at once take a twentieth of the time."""
        S, f = second[order[:, None], order], first[order]
        D, p, s = P @ S, np.diag(P), np.diag(S)
        apart = D - np.diag(D)[:, None] + p[:, None] * (s[:, None] - S) - P * (s - S)
        own = (p[:, None] - p) * (s - s[:, None]) + (slope[:, None] - slope) * (f[:, None] - f)
        return 2 * (apart + apart.T) + own

    def improved(order):
        order, now = order.copy(), cost(order)
        for _ in range(6):
            gained = changes(order)
            a, b = np.unravel_index(gained.argmin(), gained.shape)
            if now + gained[a, b] > _EARNED * now:
                break
            order[[a, b]] = order[[b, a]]
            now = cost(order)
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


def reversed_sign(session: Session) -> Finding | None:
    """The electrode whose sign is reversed on one side of a time: its changes within windows are likelier
    with the other sign, by what the others say of them on the other side."""
    m = session.model()
    if not m.dimensions or m.time[m.inside][-1] < BLOCKS:
        return None
    _, moment, floor, middle = m.moments()
    w, c, best = len(moment), len(m.used), None
    gap = max(1, w // 44)
    for first, last in itertools.combinations(np.unique(np.linspace(0, w, _PARTS + 1).astype(int)), 2):
        inside = np.arange(first + gap * (first > 0), last - gap * (last < w))
        outside = np.r_[: max(first - gap, 0), min(last + gap, w) : w]
        if len(inside) < w / 12 or len(outside) < max(2 * _FEWEST, len(inside)):
            continue
        plain, turned, _ = _both_signs(moment, floor, outside, c)
        gain = 0.5 * np.log(plain / turned)
        k = int(gain[inside].sum(0).argmax())
        if best is None or gain[inside, k].sum() > best[0]:
            best = gain[inside, k].sum(), k, outside
    if best is None or best[0] <= 0:
        return None
    _, k, outside = best
    for _ in range(2):  # the windows that are likelier so, and then what is normal
        plain, turned, weight = _both_signs(moment, floor, outside, c)
        plain, turned = plain[:, k], turned[:, k]
        gain = 0.5 * np.log(plain / turned)
        first, last = _span(np.concatenate([[0.0], np.cumsum(gain)]))
        outside = np.r_[:first, last:w]
        if last - first < _FEWEST or len(outside) < _FEWEST:
            return None
    inside = slice(first, last)
    p = sign_flip(gain[inside])
    if p > 0.01:
        return None
    half, end = 0.5 * (middle[1] - middle[0]), float(session.recording.time[-1])
    # where the level jumps, too, there it was
    jumps = [float(e.time) for e in edges(session).get(int(m.used[k]), ())]
    begins, ends = (
        next((t for t in jumps if abs(t - at) < 2 * half), float(at))
        for at in (middle[first] - half, middle[last - 1] + half)
    )
    if first == 0:  # the sign was right first, and may be so again
        begins, ends = ends, next((t for t in jumps if t > ends + 2 * half), end)
    elif last == w and ends not in jumps:
        ends = end
    return _reversed(
        session,
        k,
        m.whole @ weight[k] * (-1.0 if first == 0 else 1.0),
        (begins, ends),
        half,
        gain[inside],
        p,
        {
            "nats": float(gain[inside].mean()),
            "ratio": float(np.log(plain[inside].mean() / turned[inside].mean())),
            "blocks": float(np.mean(gain[inside] > 0)),
        },
    )


def _both_signs(moment, floor, normal, c):
    """(w, c) mean squares of what electrodes do beside what the others say by the Gaussian of some windows,
    as they are and with the other sign, over moments (w, q, q) of changes; and weights (c, q) of
    the others."""
    P = np.linalg.inv(moment[normal].mean(0) + np.diag(floor))[:c]
    weight = -P / np.diag(P)[:, None]
    weight[np.arange(c), np.arange(c)] = 0
    said = np.einsum("kj,wkj->wk", weight, moment[:, :c])
    both = np.einsum("wii->wi", moment)[:, :c] + np.einsum("ki,wij,kj->wk", weight, moment, weight)
    return both - 2 * said + floor[:c], both + 2 * said + floor[:c], weight


def _reversed(session, i, said, where, within, gain, p, clues):
    """Of used electrode i, of which the others say (m,), from and until [s], by what each may be off."""
    m, (begins, ends) = session.model(), where
    k, late, value = int(m.used[i]), (m.time > begins) & (m.time <= ends), m.value[:, i]
    # about the level about which it goes on as the others say
    near = m.inside & (np.abs(m.time - begins) < _NEAR)
    twice = (value + said)[near & late].mean() + (value - said)[near & ~late].mean() + 2 * m.mean[i]

    def correct(counts, at):
        out, rows = counts.copy(), (at > begins) & (at <= ends)
        out[rows, k] = counts_from_log_impedance(twice - log_impedance(counts[rows, k]))
        return out

    return Finding(
        "flip",
        (k,),
        {"factor": (-1.0, np.nan, np.nan)},
        float(gain.sum()),
        p,
        begins,
        ends,
        note=f"from {begins:.1f} s on its changes have the other sign, by what the others say of them, "
        f"within {within:.1f} s",
        clues=clues,
        correct=correct,
    )
