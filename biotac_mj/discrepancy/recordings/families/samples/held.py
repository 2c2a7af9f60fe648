"""Rows that are held: they repeat the one before, come slower than a bus brings them, or go on
with hardly any noise."""

import numpy as np

from .....quality.clock import BUS_RATE
from .....quality.noise import sound_noise
from .....recordings.recording import CLOCKED
from ...confidence import NAMED, confidence
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS
from ..noise.lines import humming
from .coarse import coarse
from .faults import by_block, fault, runs_of

__all__ = ["held_rows"]

_NAN = float("nan")
_STILL = 12  # rows in which a channel without noise is told from one with it
_CALM = 0.45  # of the noise that all electrodes have elsewhere
_ALIVE = 1.2  # [counts] of noise, four times what rounding alone makes
# median difference over their RMS within windows: 0.67 of noise, 0.5 at least of real sensors
_UNEVEN = 0.36
_BY_CHANCE = 1e-4  # share of rows that repeat the one before by rounding alone
# of the rate that a bus brings new rows at; 0.78 at least in a sixteenth of real recordings
_SLOW, _LASTING = 0.65, 0.25
# of the rows, repeated more often than a bus does: 0.01 at most in real recordings, 0.03 and more where rows
# are repeated at random
_UNEVENLY = 0.02
_HEIGHT = 1.3  # of the noise: what one that is read anew changes by, the root of two if nothing moves


def held_rows(session: Session) -> list[Finding]:
    """Rows that repeat the one before for longer, or less evenly, than a bus slower than the logger
    explains; or that move in steps with nothing but white noise between them."""
    n, rate = len(session.recording), session.recording.rate
    if coarse(session):  # rows repeat by chance
        return []
    same = (np.diff(session.recording.electrodes, axis=0) == 0).mean(1)
    held = np.concatenate([[False], same > 0.99])
    start, length = runs_of(held)
    on = held[start]
    if on.any():
        runs = length[on]
        # a bus that is r times slower repeats floor(r) - 1 or floor(r) rows, the commonest runs, at any time
        each = [runs[(start[on] * BLOCKS // n) == b] for b in range(BLOCKS)]
        usual = int(np.quantile([np.bincount(r).argmax() if len(r) else 0 for r in each], 0.25)) + 1
        long = on & (length > usual)
        mask = np.zeros(n, bool)
        for s, k in zip(start[long], length[long]):
            mask[s : s + k] = True
        share = mask.mean()
        longest = length[long].max() if long.any() else 0
        if (share > 0.03 or longest >= max(8, 3 * usual)) and longest >= 2 + usual:
            seconds = float(mask.sum() / rate)
            strength = by_block(mask[mask], 0.002)  # each part of the rows held, however few
            note = f", up to {longest / rate:.2f} s at a time"
            return [_frozen(session, mask, seconds, note, strength)]
    return _slower(session, held) or (_dithered(session) if held.mean() < 0.4 else []) or _hung(session)


def _slower(session, held):
    """Rows held (n,) bool by what is no bus: a bus that is r times slower than the logger repeats a row
    ceil(r) - 1 times at most, and brings a new one a hundred times a second."""
    r, n = session.recording, len(held)
    if any(f.id == "quantise" for f in session.findings) or not held.any():
        return []
    unchanged = (np.diff(r.electrodes, axis=0) == 0)[~held[1:]].mean(0)
    if np.prod(np.clip(unchanged, 1e-2, 1)) > _BY_CHANCE:  # equal rows are nobody's fault
        return []
    fresh = np.flatnonzero(~held)
    repeats = np.diff(fresh) - 1
    often = max(1, int(np.ceil(n / len(fresh) - 1e-9)) - 1)
    block = fresh[:-1] * BLOCKS // n
    uneven = np.bincount(block, repeats > often, BLOCKS) / np.maximum(np.bincount(block, minlength=BLOCKS), 1)
    rates = np.array([r.rate * (1 - part.mean()) for part in np.array_split(held, BLOCKS)])
    # a rate that is only said may be another logger's: then the recording's own fastest parts are the bus
    bus = min(r.rate, BUS_RATE) if r.rate_source == CLOCKED else np.quantile(rates, 0.9)
    slow = rates < _SLOW * bus
    if slow.mean() >= _LASTING:
        when = np.repeat(slow, [len(part) for part in np.array_split(held, BLOCKS)])
        mask = held & when
        note = f"a new row {np.median(rates[slow]):.0f} times a second, where a bus brings {bus:.0f}"
    elif (repeats > often).mean() > _UNEVENLY and (uneven > 0.5 * _UNEVENLY).mean() > 0.5:
        mask = held
        note = f"{(repeats > often).mean():.1%} of them more often than the {often} of a bus as fast"
    else:
        return []
    seconds = float(mask.sum() / r.rate)
    strength = by_block(mask[mask], 0.002)
    return [_frozen(session, mask, seconds, f": {note}", strength)]


def _frozen(session, mask, seconds, note, strength):
    """Rows held, mask (n,), in all electrodes."""
    return fault(
        session,
        "freeze",
        range(19),
        {"seconds": (seconds, seconds, seconds)},
        np.repeat(mask[:, None], 19, axis=1),
        f"{seconds:.1f} s of rows repeat the one before in all electrodes{note}",
        strength,
        BLOCKS,
    )


def _dithered(session):
    """Values that are read now and then and tremble between: of the differences in a short window most are
    small and a few as large as noise makes them, in most electrodes, at whatever rows."""
    r = session.recording
    if any(f.id == "quantise" for f in session.findings):
        return []
    rows = np.flatnonzero(session.fit & ~r.repeated & ~session.masked.all(1))
    step = np.abs(np.diff(r.electrodes[rows], axis=0))
    k = len(step) // (2 * _STILL)
    if k < BLOCKS:
        return []
    cells = step[: k * 2 * _STILL].reshape(k, 2 * _STILL, 19)
    size = np.sqrt((cells**2).mean(1))
    lively = size > 2.5  # rounding alone makes differences uneven below
    uneven = np.where(lively, np.maximum(np.median(cells, axis=1), 0.5) / np.maximum(size, 0.1), np.nan)
    told = np.flatnonzero(lively.mean(0) > 0.2)
    if len(told) < 12:
        return []
    typical = np.nanmedian(uneven[:, told], axis=0)
    usual = np.maximum(np.median(step, axis=0), 0.5)
    jump = step > 3 * usual
    law = sound_noise(np.median(r.electrodes[rows], axis=0))
    height = [np.median(step[jump[:, e], e]) / law[e] for e in told if jump[:, e].any()]
    # a median over rows jumps as well, by less than noise does
    if np.median(typical) > _UNEVEN or np.median(height or [0.0]) < _HEIGHT:
        return []
    mask, together = None, jump.mean(1) > 0.25
    if jump[together].sum() > 0.8 * jump.sum():  # all at once: the rows between are none
        mask = np.repeat(_between(r.electrodes, 3 * usual)[:, None], 19, axis=1)
    seconds = float(1 / (r.rate * jump[:, told].mean()))
    strength = -np.log(np.array([np.nanmedian(b[:, told]) for b in np.array_split(uneven, BLOCKS)]) / 0.67)
    return [
        fault(
            session,
            "freeze",
            range(19),
            {"seconds": (seconds, _NAN, _NAN)},
            mask,
            f"electrodes take a new value every {seconds:.3f} s, and tremble between",
            np.nan_to_num(strength) * k,
            BLOCKS,
        )
    ]


def _hung(session):
    """Stretches in which the noise of all electrodes is far below what it is elsewhere and what a sensor's
    is: rows that are held, carried on by less noise."""
    x, n, rate = session.recording.electrodes[session.fit], len(session.recording), session.recording.rate
    rows = np.flatnonzero(~session.recording.repeated)
    k = (len(rows) - 3) // _STILL
    if k < 2 * BLOCKS or any(f.id == "quantise" for f in session.findings):
        return []
    bend = np.diff(session.recording.electrodes[rows], n=3, axis=0)[: k * _STILL]
    size = np.sqrt((bend.reshape(k, _STILL, 19) ** 2).mean(1) / 20)
    usual = np.median(size, axis=0)
    # neither a noise that was added elsewhere, nor rounding
    least = np.minimum(usual, sound_noise(np.median(x, axis=0)))
    left = np.median(size / np.maximum(least, _ALIVE), axis=1)
    calm = left < _CALM
    start, length = runs_of(calm)
    long = calm[start] & (length >= 4)
    # the last may be a filter that was switched on
    if np.median(usual) < _ALIVE or np.count_nonzero(long[:-1]) < 2:
        return []
    # a wave near half of the rate beats with the rows: it is no noise, and now and then it is small
    wave = humming(session)
    if wave is not None and confidence(wave) >= NAMED:
        return []
    mask, weight = np.zeros(n, bool), np.zeros(k)
    for a, m in zip(start[long], length[long]):
        mask[rows[a * _STILL] : rows[min((a + m) * _STILL, len(rows) - 1)]] = True
        weight[a : a + m] = _STILL * 19 * (0.5 * left[a : a + m] ** 2 - 0.5 - np.log(left[a : a + m] + 0.01))
    seconds = float(mask.sum() / rate)
    found = fault(
        session,
        "freeze",
        range(19),
        {"seconds": (seconds, seconds, seconds)},
        np.repeat(mask[:, None], 19, axis=1),
        f"for {seconds:.1f} s, in {long.sum()} stretches, all electrodes have hardly any noise",
        [part.sum() for part in np.array_split(weight, BLOCKS)],
        BLOCKS,
    )
    found.p = 0.5 ** int(length[long].sum())
    return [found]


def _between(x, usual):
    """(n,) bool, rows of x (n, 19) in which less than a quarter of the electrodes take a new value."""
    step = np.abs(np.diff(x, axis=0, prepend=x[:1]))
    return (step > usual).mean(1) <= 0.25
