"""Single channels that stand still: stuck, or clipped at an end of what they read."""

import numpy as np
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from .....quality.noise import sound_noise
from .....sensor.channels import FULL_SCALE
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS
from .faults import by_block, fault, runs_of

__all__ = ["standing_still"]

_STILL = 12  # rows in which a channel without noise is told from one with it
_QUIET = 0.3  # of its usual noise: less comes by chance in 3 of 1000 such windows of a real sensor
_SHARE = 0.01  # of the rows
_LIMITED = 8  # electrodes that may each be limited
# of the range that a channel moves in, the half of its middle; of the samples there, how many a filter makes
# stand still: 0.45 to 0.61 in low-passes of three authors, none where there is a limit (34 channels of five)
_INNER, _FILTERED, _STAYS = 0.35, 0.2, 5
_STANDS = 8.0  # [counts] that a channel that stands still trembles by at most
_ALIVE = 1.2  # [counts] of noise, four times what rounding alone makes


def standing_still(session: Session) -> list[Finding]:
    """Channels that stand still: a live one has noise in every row. At an end of what it reads, to which it
    comes again and again, it is clipped, else stuck."""
    whole, rate = session.recording.electrodes, session.recording.rate
    coarse = {k for f in session.findings if f.id == "quantise" for k in f.channels}
    rows = np.flatnonzero(~session.masked.all(1) & ~session.recording.repeated)
    # values that are held all the time stand still by themselves
    if len(rows) < 4 * _STILL or any(f.id == "freeze" and f.mask is None for f in session.findings):
        return []
    x = whole[rows]
    bend = np.minimum(np.diff(x, n=2, axis=0) ** 2 / 6, 1e4)
    level = uniform_filter1d(x, _STILL, axis=0)[1:-1]
    law = sound_noise(level)
    size = np.sqrt(np.maximum(uniform_filter1d(bend, _STILL, axis=0), 0)) / law
    lively = size > 0.2 * np.quantile(size, 0.9, axis=0)
    usual, loud = (_middle(values, lively) for values in (size, law))
    others = np.nanmedian(usual)
    # spikes and bursts are not a channel's noise, nor is what is left to one that trembled from the start
    usual = np.where(usual > _QUIET * others, np.minimum(usual, others), others)
    # without noise a constant reading is no news
    alive = usual * np.where(np.isnan(loud), np.median(law, axis=0), loud) > _ALIVE
    # at an end of the converter nothing is measured, however little noise there was before
    railed = minimum_filter1d(np.isin(x, (0, FULL_SCALE)).astype(np.int8), _STILL, axis=0)[1:-1] > 0
    railed &= session.recording.absolute
    quiet = (size < _QUIET * usual) & alive | railed
    share = quiet.mean(0)
    found, ordered = [], np.sort(share)
    # where several stand still at times it is nothing of one channel, but at an end of what each reads
    alone = share > np.maximum(_SHARE, 6 * ordered[-3])
    for k in np.flatnonzero(alone | (share > np.maximum(_SHARE, 6 * ordered[-1 - _LIMITED]))):
        if k in coarse:
            continue
        at = np.zeros(len(x), bool)
        at[1:-1] = quiet[:, k]
        at = minimum_filter1d(at[::-1].astype(np.int8), 3)[::-1] > 0  # of windows that touch one another
        if not at.any():
            continue
        mask = np.zeros(whole.shape, bool)
        # a row that repeats another is as that one
        before = np.maximum(np.searchsorted(rows, np.arange(len(whole)), "right") - 1, 0)
        mask[:, k] = at[before]
        # of equal readings all are held or none: a window tells the middle of them alone
        run = np.cumsum(np.diff(whole[:, k], prepend=np.nan) != 0)
        mask[:, k] |= np.isin(run, run[mask[:, k]])
        found += [f for f in _stood(session, int(k), mask, rate) if alone[k] or f.id == "saturate"]
    return found


def _middle(values, on):
    """Median of values (n, 19) over the samples that are `on`, NaN where none is."""
    return np.ma.median(np.ma.masked_array(values, ~on), axis=0).filled(np.nan)


def _stood(session, k, mask, rate):
    """Findings of one channel that stands still in some samples (n, 19)."""
    whole, found = session.recording.electrodes[:, k], []
    moving = ~mask[:, k] & ~session.masked.all(1)
    start, length = runs_of(mask[:, k])
    start, length = start[mask[start, k]], length[mask[start, k]]
    values = np.array([np.median(whole[a : a + n]) for a, n in zip(start, length)])
    ways = np.array([np.ptp(np.quantile(whole[a : a + n], [0.1, 0.9])) for a, n in zip(start, length)])
    on = np.flatnonzero(mask[:, k])
    first = on[len(on) // 20]  # a limit may begin late, and a window may be quiet by chance
    if moving[first:].sum() > 0.2 * len(on):
        moving[:first] = False
    # where the channel goes when it moves: next to nowhere beyond a limit
    ends = np.quantile(whole[moving], [0.03, 0.97]) if moving.any() else np.array([np.inf, -np.inf])
    inner = np.abs(whole - ends.mean()) < _INNER * np.ptp(ends)
    between = np.abs(values - ends.mean()) < _INNER * np.ptp(ends)
    if between.sum() > _STAYS and np.ptp(values[between]) > _INNER * np.ptp(ends):
        if mask[inner, k].mean() > _FILTERED:
            return []
    stays = mask[on[0] : on[-1] + 1, k].mean() > 0.8  # a limit is left when the load goes back
    # and a limit is reached by going there: what lies far beyond where it moves is none
    near = np.abs(values - np.clip(values, *ends)) < np.ptp(ends)
    low, high = near & (values <= ends[0] + 3), near & (values >= ends[1] - 3)
    for side, mine in ((-1, low), (1, high), (0, None)):
        if side < 0 and not session.recording.signed:  # its rest
            continue
        if side and (mine.sum() < 2 or stays or np.ptp(ends) < 20 * _ALIVE):
            continue
        mine = np.ones(len(values), bool) if mine is None else mine
        if not side and np.median(ways[mine]) > _STANDS:
            continue  # it has no noise, but it goes somewhere: it is filtered, or answers less
        rest = mask.copy()
        for a, n in zip(start[~mine], length[~mine]):
            rest[a : a + n, k] = False
        if not rest.any() or (side == 0 and (found or length.max() < 0.25 * rate)):
            continue
        # nothing is fitted here, so what is mostly in the rows kept aside is told from these alone
        flags = rest[session.fit, k]
        if flags.sum() < rest[~session.fit, k].sum():
            flags = rest[:, k] & ~session.fit
        value = float(np.median(values[mine]))
        spread = float(np.ptp(values[mine])) / 2 + 0.5
        name, key = ("saturate", "level") if side else ("stuck", "value")
        text = ("largest" if side > 0 else "smallest") + " values" if side else "no end of what it reads"
        found.append(
            fault(
                session,
                name,
                (k,),
                {key: (value, value - spread, value + spread)},
                rest,
                f"{rest[:, k].mean():.1%} of the samples stand still at {value:.0f} counts, {text}",
                by_block(_stretch(flags), 0.003),
                BLOCKS,
            )
        )
        found[-1].beyond = side
        found[-1].clues |= {"share": float(np.log(flags.mean())), "runs": float(np.log(mine.sum()))}
        if side and value in (0, FULL_SCALE) and session.recording.absolute:
            found[-1].clues["rail"] = 1.0
        found[-1].p = 0.5 ** int(max(mine.sum(), flags.sum() // _STILL))
        if not side and np.ptp(ends) >= 20 * _ALIVE and (low.all() or high.all()):
            found[-1].ties = ("saturate",)  # of one stay at an end of what it reads
        if mine.sum() > 8 and not stays:  # it moves again and again: it does not answer there
            found[-1].ties = ("gain",) if side else ("gain", "saturate")
        if "rail" in found[-1].clues:  # an answer of the other sign takes levels to the converter's end, too
            found[-1].ties = (*found[-1].ties, "flip")
    return found


def _stretch(mask):
    """What a mask (n,) says from its first to its last row, at least one row a block."""
    on = np.flatnonzero(mask)
    first = min(on[0], len(mask) - BLOCKS)
    return mask[first : max(on[-1] + 1, first + BLOCKS)]
