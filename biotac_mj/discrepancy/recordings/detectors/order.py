"""Channels that are not what they are called: each goes on, from one row to the next, where another was,
which needs no model of the load nor a long recording."""

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components

from ....quality.noise import noise_level
from ..candidates import Candidate
from ..session import Session

_ON = 1.8  # of what it may have moved by meanwhile: a channel goes on where another was
# of the same: by this much it jumps, in the median of those exchanged and each. In 740 recordings of four
# authors 23 exchanges reach 10.3, and of all else that goes on so 9.3
_JUMPS, _EACH = 10.0, 2.5
_ELSE = 4.0  # others jump by no more
_RARE = 3  # of these in a recording: what comes and goes is none


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

    def correct(counts, at):
        out = counts.copy()
        inside = (at > begins) & (at <= ends)
        out[np.ix_(inside, channels)] = counts[np.ix_(inside, source)]
        return out

    read = ", ".join(f"e{a + 1} carries e{b + 1}" for a, b in zip(source, channels))
    return Candidate(
        "swap",
        tuple(int(k) for k in channels),
        begins,
        ends,
        f"{read}: each goes on there from one row to the next",
        {"onset": (begins, begins - 1 / r.rate, begins + 1 / r.rate)},
        nats=float((size**2).sum() / 2),
        p=float(np.exp(-len(moved))) / len(rows),
        detector="slip",
        sudden=True,
        correct=correct,
        verified=True,  # by the rows themselves
    )


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
    order, out = straight.copy(), straight.copy()
    # what goes on where it was is not exchanged with others that happen to be there as well
    jumped = np.flatnonzero(np.diag(off) > _EACH)
    order[jumped] = jumped[linear_sum_assignment(np.minimum(off[np.ix_(jumped, jumped)], 50) ** 2)[1]]
    of = connected_components(np.eye(number)[order])[1]
    for cycle in (np.flatnonzero(of == k) for k in np.unique(of[order != straight])):
        now, then = np.diag(off)[cycle], off[cycle, order[cycle]]
        if then.max() < _ON and np.median(now) > _JUMPS:
            out[cycle] = order[cycle]
    return out
