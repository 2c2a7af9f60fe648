"""Two electrodes that are connected to each other, or one that is read in two places: while a load moves both
by far more than their noise they read the same counts, and elsewhere they do not. No effect of the catalogue
does that to two at once; each alone would look like a drift."""

import itertools

import numpy as np
from scipy.ndimage import median_filter

from ...quality.noise import ROUNDING, noise_level
from .session import Session

__all__ = ["part_connected"]

# times the noise of both and a count, within which they read the same
_NEAR = 4.0
_ROWS, _SHARE = 50, 0.05  # of a stretch at least: rows, share of the record
# of the noise of both, the difference in a stretch at most; how much more they move meanwhile, and differ
# elsewhere. Of 880 recordings of five authors none that is sound has a stretch like that
_ALIKE, _MOVED, _ELSEWHERE = 1.3, 15.0, 10.0
_SAME = 0.3  # of the noise of both: less is one reading in two places, from the first row to the last, too


def part_connected(session: Session) -> None:
    """Masks electrodes while they read the same as another, and says so in `session.unnamed`."""
    rows = np.flatnonzero(~session.recording.repeated & ~session.masked.all(1))
    if not session.model().moved or len(rows) < 2 * _ROWS:
        return
    x = session.recording.electrodes[rows]
    noise = np.maximum(noise_level(x), ROUNDING)
    unsearched, time = np.zeros_like(session.masked), session.recording.time
    for pair in itertools.combinations(range(x.shape[1]), 2):
        stretch = _stretch(x[:, pair], float(np.hypot(*noise[list(pair)])))
        if stretch is None:
            continue
        first, last = rows[stretch[0]], rows[stretch[1] - 1]
        unsearched[first : last + 1, pair] = True
        session.unnamed.append(
            f"e{pair[0] + 1} and e{pair[1] + 1} read the same from {time[first]:.1f} s to {time[last]:.1f} "
            "s, whatever moves: connected, or one of them is read twice"
        )
    session.leave_out(unsearched)


def _stretch(x, noise):
    """First row and last + 1 of the longest stretch in which two electrodes x (n, 2) read the same, by the
    noise of their difference; None where that may be chance."""
    off = x[:, 0] - x[:, 1]
    near = np.abs(off) < _NEAR * noise + 1
    least = max(_ROWS, _SHARE * len(x))
    if near.sum() < least:
        return None
    near = median_filter(near.astype(np.int8), 5)
    edge = np.flatnonzero(np.diff(np.concatenate([[0], near, [0]])))
    first, last = max(zip(edge[::2], edge[1::2]), key=lambda e: e[1] - e[0], default=(0, 0))
    if last - first < least:
        return None
    alike = off[first:last].std() / noise
    moved = x[first:last].std(0).min() / noise
    elsewhere = np.concatenate([off[:first], off[last:]])
    if moved < _MOVED * max(alike, _SAME) or alike > _ALIKE:
        return None
    apart = len(elsewhere) > 20 and elsewhere.std() > _ELSEWHERE * noise
    return (int(first), int(last)) if apart or alike < _SAME else None
