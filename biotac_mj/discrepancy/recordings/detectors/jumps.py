"""Jumps of an electrode from one row to the next, which no load and no drift makes: straight lines on either
side do not meet, on no other electrode at that row, and it stays where it has jumped to. A touch that one
electrode alone feels makes such an edge as well; when the load is as it was it is gone, and a jump is not."""

import typing

import numpy as np
from scipy.ndimage import maximum_filter1d

from ....quality.adjacent import last_measured, line_ends
from ....quality.noise import noise_level
from ..candidates import Candidate
from ..conditional import Conditional
from ..session import Session

_LINE = 6  # rows of a line
_AROUND = 36  # rows on either side
_STAYS = 30  # rows after which it is still there
_HELD = 3  # rows from one that is read to the next, at most
_CLEAR = 6.0  # of the noise, at least
# times what happens on the electrode's own rows around, what any other electrode does there, and both
# together: at most 4.1, 3.0 and 8.4 in real recordings, of what stays and is there from one row to the next
_TIMES = 3.0
_ISOLATED = 2.0
_BOTH = 9.0
# of the step, from one row to the next: a touch takes several rows, of a bus slower than the logger two
_AT_ONCE = (0.75, 1.3)
_PASSING = 3.0  # times the plainest step of the same electrode that does not stay
# [s] of a bin that is compared with others, and how many of them at most
_MATCH, _BINS = 0.05, 1000
# of a jump, that is there whenever the load is as it was: 0.65 and more of jumps, 0.1 at most of touches, and
# anything where the load never is
_KEPT = 0.5
_MOST = 4  # edges of an electrode: one with more switches, and ends as unknown


class Edge(typing.NamedTuple):
    """A jump: time [s], step [counts], how many times what is around it (times) and what is on others
    (isolation)."""

    time: float
    step: float
    times: float
    isolation: float


def edges(session: Session) -> dict[int, list[Edge]]:
    """Electrode number -> its jumps in order, of electrodes with few."""
    r = session.recording
    rows = np.flatnonzero(~r.repeated)
    tick = r.tick[rows]
    masked = session.masked[rows]
    if len(rows) < 200:
        return {}
    x, h = last_measured(session.counts[rows], masked), _LINE
    noise = np.maximum(noise_level(x), 0.7)
    left, right, spread = line_ends(x, h)
    step = right - left
    size = np.abs(step) / noise / spread
    peak = (size >= maximum_filter1d(size, 25, axis=0)) & (size > _CLEAR)
    times = np.zeros_like(size)  # not used elsewhere
    times[peak] = size[peak] / np.maximum(_around(size, *np.nonzero(peak)), 1)
    second = np.sort(maximum_filter1d(size, 3, axis=0), axis=1)[:, [-2]]
    isolation = size / np.maximum(second, 1.0)
    clear = peak & (times > _TIMES) & (isolation > _ISOLATED) & (times * isolation > _BOTH)
    if not clear.any():
        return {}
    stays = _stays(x)
    found: dict[int, list[tuple]] = {}  # electrode: place and height of what stays
    passing = np.zeros(x.shape[1])  # times and isolation of the plainest step that does not
    for i, k in zip(*np.nonzero(clear)):
        at = i + h
        # it came back from where it measured nothing, or rows were held or missing meanwhile
        if masked[max(at - h, 0) : at + h, k].any() or tick[at] - tick[at - 1] > _HELD:
            continue
        if not np.ptp(x[at - h : at, k]) or not np.ptp(x[at : at + h, k]):
            continue  # it stands still there: stuck
        row = np.diff(x[at - 3 : at + 3, k])
        rough = 2 * noise[k] * spread
        least, most = _AT_ONCE
        if not least * abs(step[i, k]) - rough < np.abs(row).max() < most * abs(step[i, k]) + rough:
            continue
        height = stays[at, k]
        if 0.5 < height / step[i, k] < 1.6:
            within = abs(height - step[i, k]) < rough  # the error: nothing moves
            found.setdefault(int(k), []).append((i, height if within else step[i, k]))
        else:
            passing[k] = max(passing[k], times[i, k] * isolation[i, k])
    out = {
        k: [
            Edge(rows[i + h] / r.rate, float(height), float(times[i, k]), float(isolation[i, k]))
            for i, height in mine
            # where touches make such steps that pass, one of these stays now and then
            if times[i, k] * isolation[i, k] > _PASSING * passing[k]
        ]
        for k, mine in found.items()
    }
    return {k: mine for k, mine in out.items() if 0 < len(mine) <= _MOST}


def _around(size, row, column):
    """(k,) what 85 of 100 rows around rows (k,) of columns (k,) stay below, the jump itself left out."""
    offset = np.arange(-_AROUND, _AROUND + 1)
    offset = offset[np.abs(offset) > _LINE]
    padded = np.pad(size, ((_AROUND, _AROUND), (0, 0)), mode="symmetric")
    around = padded[row[:, None] + _AROUND + offset, column[:, None]]
    rank = int(0.85 * len(offset))
    return np.partition(around, rank, axis=1)[:, rank]


def _stays(x):
    """(n, nelectrode) by how much the mean of the rows after each row of x (n, nelectrode) lies above that of
    the rows before it, given the same change of the other electrodes: the load may have moved meanwhile."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    at = np.arange(len(x))
    a, b = np.maximum(at - _STAYS, 0), np.minimum(at + 1 + _STAYS, len(x))
    before = (total[at - (at > 0)] - total[a]) / np.maximum(at - 1 - a, 1)[:, None]
    after = (total[b] - total[np.minimum(at + 1, b)]) / np.maximum(b - at - 1, 1)[:, None]
    change = after - before
    change[[*at[:2], *at[-2:]]] = 0
    scale = np.maximum(1.4826 * np.median(np.abs(change), axis=0), 0.3)
    y = np.clip(change / scale, -_CLEAR, _CLEAR)  # jumps do not enter the correlation
    given = Conditional(y.T @ y / len(y), np.full(y.shape[1], 0.05))
    return change + (given.residual(y) - y) * scale


def _kept(session, k, at, total, jumping):
    """Fraction of the jumps of electrode k, at times (s,) [s] to total (s + 1,) [counts], that remains where
    all other electrodes read the same on both sides of a jump: the upper quartile of it over the fifth of the
    bins that match best. Electrodes `jumping` (j,) are not compared. Removing their jumps instead would match
    a touch that several electrodes feel with one that none of them felt."""
    r = session.recording
    width = max(1, round(_MATCH * r.rate))
    n = len(session.counts) // width
    time = r.time[: n * width].reshape(n, width).mean(1)
    clear = np.flatnonzero(np.abs(time[:, None] - at).min(1) > 2 * _MATCH)
    clear = clear[:: 1 + len(clear) // _BINS]
    x = session.counts[: n * width].reshape(n, width, -1).mean(1)[clear]
    z = np.delete(x, [k, *jumping], axis=1)
    z = (z - z.mean(0)) / np.maximum(z.std(0), 1.0)
    level = total[np.searchsorted(at, time[clear], "right")]
    difference = level[:, None] - level
    square = (z**2).sum(1)
    away = np.where(difference != 0, square[:, None] + square - 2 * z @ z.T, np.inf)
    nearest = away.argmin(1)
    rows = np.argsort(away.min(1))[: max(5, len(z) // 5)]
    rows = rows[np.isfinite(away.min(1)[rows])]
    if not len(rows):
        return 1.0
    return float(np.quantile((x[:, k] - x[nearest, k])[rows] / difference[rows, nearest[rows]], 0.75))


def jumped(session: Session) -> list[Candidate]:
    """Jumps of electrodes that nothing else was named of."""
    known = {k for f in session.findings if not f.of_all for k in f.channels}
    out, every = [], edges(session)
    for k, mine in every.items():
        if k in known:
            continue
        at, steps = np.array([e.time for e in mine]), np.array([e.step for e in mine])
        total = np.r_[0.0, np.cumsum(steps)]
        if _kept(session, k, at, total, list(every)) < _KEPT:
            continue  # where the load is as before, so is the electrode: it alone felt a touch
        last = float(total[-1])
        largest = float(np.abs(steps).max())
        places = " ".join(f"by {e.step:+.0f} counts at {e.time:.2f} s" for e in mine)

        def correct(counts, time, k=k, at=at, total=total):
            out = counts.copy()
            out[:, k] -= total[np.searchsorted(at, time + 1e-9, "right")]
            return out

        out.append(
            Candidate(
                "drift",
                (k,),
                float(at[0]),
                float(at[-1] if abs(last) < 0.3 * largest else session.recording.time[-1]),
                f"from one row to the next it jumps, alone of all: {places}",
                {"change": (last if abs(last) > 0.3 * largest else largest, np.nan, np.nan)},
                nats=float(sum(np.log(e.times) ** 2 for e in mine)),
                p=float(np.prod([len(session.counts) ** -0.5 / e.times for e in mine])),
                detector="jump",
                sudden=True,
                features={
                    "edge": float(np.log(max(e.times for e in mine))),
                    "isolation": float(np.log(max(e.isolation for e in mine))),
                },
                # where nothing moves a gain would have no effect
                ties=("gain", "flip") if session.loaded else (),
                correct=correct,
                verified=True,
            )
        )
    return out
