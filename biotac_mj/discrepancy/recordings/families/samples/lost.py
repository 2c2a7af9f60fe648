"""Rows that are missing, by the file's clock or where all electrodes jump from one row to the next."""

import numpy as np
from scipy.ndimage import percentile_filter, uniform_filter1d

from .....quality.noise import noise_level
from ...confidence import NAMED, confidence
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS
from .coarse import coarse
from .faults import fault

__all__ = ["dropped", "lost"]

_NAN = float("nan")
_FEW = 4  # electrodes that may jump for reasons of their own
_BEGUN = 2.0  # [s] within which it is known when an effect on all electrodes begins
_CHANCE = 12.0  # nats: one in 1e5
_STILL = 12  # rows in which a channel without noise is told from one with it
# of places where rows may be lost, and times what a force does elsewhere that it does there: 5 and more where
# a logger lost rows, 0.9 at most where electrodes alone jump
_PLAINEST, _LEAPS = 3, 2.5
_END, _MEETS = 4, 2.0  # rows at either end, and their distance in noises where they meet


def dropped(session: Session) -> list[Finding]:
    """Rows that the file's own clock says are missing."""
    r = session.recording
    if r.missing is None or not r.missing.any():
        return []
    at = np.flatnonzero(r.missing)
    longest = at[np.argmax(r.missing[at])]
    strength = np.zeros(BLOCKS)
    np.add.at(strength, (at * BLOCKS) // len(r), _CHANCE)
    f = fault(
        session,
        "lost_rows",
        range(19),
        {"seconds": (float(r.missing.sum() / r.rate), _NAN, _NAN)},
        None,
        f"the clock: {r.missing.sum()} rows are missing in {len(at)} gap{'s' * (len(at) > 1)}, the longest "
        f"of {r.missing[longest]} before row {longest + 1}",
        strength,
        BLOCKS,
    )
    f.start, f.end, f.p = at[0] / r.rate, at[-1] / r.rate, np.exp(-_CHANCE)
    f.clues |= {"clock": 1.0, "places": at / r.rate}
    return [f]


def lost(session: Session) -> list[Finding]:
    """Places where all electrodes jump from one row to the next: straight lines on either side do not
    meet."""
    r = session.recording
    rows = np.flatnonzero(~r.repeated)
    good = session.masked[~session.masked.all(1)].mean(0) < 0.02
    x = session.counts[rows][:, good]
    masked = session.masked[rows][:, good]
    before = np.maximum.accumulate(np.where(masked, 0, np.arange(len(rows))[:, None]), axis=0)
    x = np.take_along_axis(x, before, axis=0)  # a masked sample is the last one that was measured
    n, h = len(x), 4
    noise = noise_level(x) if n >= 200 and good.any() else np.zeros(1)
    if np.median(noise) < 0.7 or coarse(session):
        return []
    # ends of least-squares lines of h rows on the left and on the right of every gap between rows
    line = np.vander(np.arange(h), 2)
    end = np.array([h - 0.5, 1.0]) @ np.linalg.pinv(line)
    left = sum(end[i] * x[i : n - h + 1 + i] for i in range(h))  # value half a row after rows i..i+h-1
    right = sum(end[::-1][i] * x[i : n - h + 1 + i] for i in range(h))
    jump = (right[h:] - left[:-h]) / noise / np.sqrt(2 * (end**2).sum())
    # a few electrodes that jump are no loss: of all others a fifth has to
    rest = np.sort(np.abs(jump), axis=1)[:, : max(4, jump.shape[1] - _FEW)]
    score = np.sqrt((rest**2).mean(1)) * ((rest > 3).mean(1) >= 0.2)
    # the load bends by as much on the rows around, a loss stands alone
    around = percentile_filter(score, 90, size=81)
    order = np.argsort(-score / np.maximum(around, 1))
    places = []
    for i in order[:60]:
        if score[i] > 3 * np.maximum(around[i], 1) and score[i] > 4 and all(abs(i - j) > 12 for j in places):
            places.append(int(i))
    # after rows that were held, trembling or not, the load has moved on
    bend = np.abs(np.diff(x, n=3, axis=0))
    usual = np.maximum(np.median(bend, axis=0), 0.5)
    # and where something else of all electrodes begins they all change
    begun = [
        f.start for f in session.findings if len(f.channels) > 12 and "course" not in f.clues and f.start > 0
    ]
    places = [
        i
        for i in places
        if all(abs(rows[i + h] / r.rate - start) > _BEGUN for start in begun)
        and not session.masked[max(rows[i + h] - 3 * h, 0) : rows[i + h] + 1].all(1).any()
        and np.median(bend[max(i + h - 2 * _STILL, 0) : i + h - 3] / usual) > 0.4
    ]
    places = _in_order(places, x, left[:-h], right[h:], h)
    if not places:
        return []
    change = (right[h:] - left[:-h])[places]
    # the same counts on every electrode are a supply's, not a load's
    lost_at = np.abs(change.mean(1)) <= 2 * change.std(1)
    if not lost_at.any() or not session.model().moved:  # at rest nothing is missed
        return []
    chosen = np.array(places)[lost_at]
    at = rows[chosen + h]
    strength = np.zeros(BLOCKS)
    np.add.at(strength, (at * BLOCKS) // len(r), 0.5 * score[chosen] ** 2)
    f = fault(
        session,
        "lost_rows",
        range(19),
        {"seconds": (_NAN, _NAN, _NAN)},
        None,
        f"at {', '.join(f'{row / r.rate:.2f}' for row in sorted(at)[:6])} s all electrodes jump between two "
        "rows",
        strength,
        BLOCKS,
    )
    f.start, f.end = float(min(at) / r.rate), float(max(at) / r.rate)
    f.p = len(chosen) / len(score)  # rows that stand alone as much
    f.clues |= {
        # up to a dozen times what is around it a place or two of every record jumps
        "times": float(np.clip(np.max(score[chosen] / np.maximum(around[chosen], 1)), 12, 30)),
        "places": at / r.rate,
        "number": float(np.log(len(chosen))),
        "electrodes": float(np.mean(np.abs(jump[chosen]) > 3)),
        "score": float(np.log(score[chosen].max())),
    }
    against = _not_lost(r, rows, chosen + h, noise, x)
    if against and confidence(f) >= NAMED:
        session.unnamed.append(f"{f.note}, {against}")
    return [] if against else [f]


def _not_lost(r, rows, at, noise, x):
    """What speaks against rows that are missing before some of the rows read x (n, c), the plainest first:
    what was recorded beside the electrodes misses them as well, and what was there before them comes before
    what is there after. Empty text: nothing."""
    if r.force is not None:
        share = [_leap(r.force, int(row)) for row in rows[at[:_PLAINEST]]]
        return "" if np.median(share) > _LEAPS else "and the force does not"
    if r.missing is not None:
        return "and the clock runs on"
    ends = np.abs(x[-_END:].mean(0) - x[:_END].mean(0)) / np.maximum(noise, 1)
    jump = np.abs(x[at[0] : at[0] + _END].mean(0) - x[at[0] - _END : at[0]].mean(0)) / np.maximum(noise, 1)
    if np.median(ends) < _MEETS and np.median(jump) > 5 * _MEETS:
        return "and the last row goes on with the first"
    return ""


def _leap(force, row):
    """By how many times what it does elsewhere a force (n, 3) changes at a row, the liveliest component."""
    before, after = _END + 1, _END - 1
    at = np.clip(np.r_[row, np.arange(10, len(force) - 10, 7)], before, len(force) - after)
    size = np.abs([force[i : i + after].mean(0) - force[i - before : i - 1].mean(0) for i in at])
    usual = np.quantile(size[1:], 0.9, axis=0)
    moved = usual > 0
    return float((size[0] / np.where(moved, usual, 1.0))[moved].max(initial=0.0))


def _in_order(places, x, left, right, h):
    """Places at which rows are missing, and not those of rows that come again, or that were written last
    first: from there it jumps back to what lies beside another place."""
    _, which, times = np.unique(x, axis=0, return_inverse=True, return_counts=True)
    again = uniform_filter1d((times[which.ravel()] > 1).astype(float), 2 * h) > 0.4
    size = np.array([np.linalg.norm(right[i] - left[i]) for i in places])
    out = []
    for a, i in enumerate(places):
        others = [j for b, j in enumerate(places) if b != a]
        back = [
            np.linalg.norm(left[i] - left[j]) + np.linalg.norm(right[i] - right[j]) < 0.25 * size[a]
            for j in others
        ]
        if not any(back) and not again[i : i + 2 * h].any():
            out.append(i)
    return out
