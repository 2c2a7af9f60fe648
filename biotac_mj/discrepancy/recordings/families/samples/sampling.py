"""Faults of samples: coarse, held, lost, stuck, clipped and spiked ones. What is no measurement is masked."""

from collections.abc import Callable, Iterable

import numpy as np
from scipy.ndimage import median_filter, minimum_filter1d, uniform_filter1d
from scipy.stats import poisson

from .....sensor.channels import FULL_SCALE
from ....evidence import sign_flip
from ....noise import ROUNDING, noise_level, sound_noise
from ...confidence import NAMED, confidence
from ...findings import Finding
from ...recording import BUS_RATE, CLOCKED
from ...session import Session
from ..courses import BLOCKS
from ..noise.electronics import humming

__all__ = ["coarse", "fault", "quantised", "sampling_faults"]

_NAN = float("nan")
_FEW = 4  # electrodes that may jump for reasons of their own
# visits of a code, of whose neighbours one in a hundred is then missed by chance
_OFTEN = 5
_CUT, _CODES = 4, 16  # step and codes at least of one channel that is coarse alone
_LATER = 0.1  # of the rows, that are coarse at least where not all are
_CHANCE = 12.0  # nats: one in 1e5
_STILL = 12  # rows in which a channel without noise is told from one with it
_QUIET = 0.3  # of its usual noise: less comes by chance in 3 of 1000 such windows of a real sensor
_SHARE = 0.01  # of the rows
_LIMITED = 8  # electrodes that may each be limited
_STANDS = 8.0  # [counts] that a channel that stands still trembles by at most
_CALM = 0.45  # of the noise that all electrodes have elsewhere
_ALIVE = 1.2  # [counts] of noise, four times what rounding alone makes
# median difference over their RMS within windows: 0.67 of noise, 0.5 at least of real sensors
_UNEVEN = 0.36
_ROWS = 7  # times the noise that all of these leave the trace by
# times the noise and a count, that a sample leaves the trace by; share of samples of real recordings that do
_FAR, _BY_ITSELF = 20.0, 3e-6
_OFTEN_EACH = 3  # of these of one electrode at most, where any has them
_BESIDE, _HELD = 0.1, 0.3  # of the samples that leave the trace, side by side, and where rows are repeated
_GONE = 100  # counts that most electrodes leave for a row: no load comes and goes like that
_MOST = 12  # electrodes that leave and come back at once: no touch is over after a row or two
_BY_CHANCE = 1e-4  # share of rows that repeat the one before by rounding alone
# of the rate that a bus brings new rows at; 0.78 at least in a sixteenth of real recordings
_SLOW, _LASTING = 0.65, 0.25
# of the rows, repeated more often than a bus does: 0.01 at most in real recordings, 0.03 and more where rows
# are repeated at random
_UNEVENLY = 0.02
_HEIGHT = 1.3  # of the noise: what one that is read anew changes by, the root of two if nothing moves


def sampling_faults(session: Session, take: Callable[[Finding], bool]) -> None:
    """Offers all of them to `take`, in the order in which they have to be taken out; each is searched
    without the samples of those before it."""
    for find in (_off_rows, quantised, _held, _still, _spiked):
        for finding in find(session):
            take(finding)


def _rows(session):
    x = session.recording.electrodes[session.fit]
    return x, len(session.recording), session.recording.rate


def fault(
    session: Session,
    name: str,
    channels: Iterable[int],
    parameters: dict,
    mask: np.ndarray | None,
    note: str,
    strength: np.ndarray,
    blocks: int,
    correct: Callable | None = None,
) -> Finding:
    """A fault of samples, mask (n, 19), as a finding.

    Args:
      strength: (blocks,) how many times more often than chance allows, in nats, block by block.
    """
    at = np.flatnonzero(mask.any(1)) if mask is not None else np.array([0, len(session.recording) - 1])
    rate = session.recording.rate
    return Finding(
        name,
        tuple(int(k) for k in channels),
        parameters,
        float(np.sum(strength)),
        sign_flip(np.asarray(strength, float)),
        at[0] / rate,
        at[-1] / rate,
        note,
        clues={
            "nats": float(np.log1p(np.sum(strength))),
            "blocks": float(np.mean(np.asarray(strength) > 0)),
        },
        mask=mask,
        correct=correct,
    )


def _by_block(flags, chance):
    """(blocks,) nats by which flags (n,) are more frequent than chance, in each block, of a row at least."""
    blocks = min(BLOCKS, len(flags))
    share = np.array([b.mean() for b in np.array_split(flags.astype(float), blocks)])
    size = len(flags) / blocks
    share, chance = np.clip(share, 1e-9, 1), np.clip(chance, 1e-9, 1)
    return np.sign(share - chance) * size * np.abs(share * np.log(share / chance) - share + chance)


# --- coarse


def quantised(session: Session) -> list[Finding]:
    """Coarse channels: of the codes that their noise should visit they leave out some, lattice or not."""
    x, _, _ = _rows(session)
    if np.any(x != np.rint(x)):
        return []
    x = x.astype(int)
    blocks = np.array_split(x, BLOCKS)
    lattice = np.array([_lattice([c]) for c in x.T])
    lattice = np.maximum(lattice, _lattice(x.T))  # where each takes too few values
    step = np.where(lattice > 1, lattice, [_spacing(c) for c in x.T])
    coarse, told = np.flatnonzero(step >= 2), np.isfinite(step)
    # levels that lie far apart look alike, but are no multiples of anything
    if 1 < len(coarse) < 0.5 * told.sum():
        coarse = np.flatnonzero(lattice > 1)
    if len(coarse) == 1:  # one converter reads all, but a channel's word may be cut
        codes = len(np.unique(x[:, coarse[0]]))
        coarse = coarse[(lattice[coarse] >= _CUT) & (codes >= _CODES)]
    if not len(coarse):
        return _coarse_since(session)
    q = float(np.median(step[coarse]))
    # of codes that noise takes it to by chance every q-th would be one of these
    strength = [np.log(q) * np.count_nonzero(np.diff(b[:, coarse], axis=0)) for b in blocks]
    channels = range(19) if len(coarse) > 0.75 * told.sum() else coarse
    found = fault(
        session,
        "quantise",
        channels,
        {"step": (q, q, q)},
        None,
        f"of the codes among those visited often only one in {q:.3g} is ever read",
        strength,
        BLOCKS,
    )
    if len(coarse) == 1:
        found.clues["cut"] = 1.0
    return [found]


def _coarse_since(session):
    """All channels or some that are coarse from some row on: the largest number that all differences from the
    last row have in common, back to where they no longer have one. Codes say so themselves, also in rows kept
    aside."""
    x = session.recording.electrodes
    if np.any(x != np.rint(x)):
        return []
    off = np.abs(x.astype(int) - x[-1].astype(int))[::-1]
    long, q, sure = _common(np.gcd.reduce(off, axis=1), off)
    if sure and (np.ptp(off[:long], axis=0) > 0).sum() > _FEW:
        channels = np.arange(19)
    else:
        each = [_common(off[:, k], off[:, [k]]) for k in range(19)]
        channels = np.array([k for k, (_, step, sure) in enumerate(each) if sure and step >= _CUT], int)
        if not len(channels):
            return []
        long, q = max(each[k][0] for k in channels), float(np.median([each[k][1] for k in channels]))
    parts = np.array_split(off[:long][:, channels], BLOCKS)
    since = (len(x) - long) / session.recording.rate
    found = fault(
        session,
        "quantise",
        channels,
        {"step": (q, q, q)},
        None,
        f"from {since:.1f} s on values are multiples of {q:.3g} apart",
        [np.log(q) * np.count_nonzero(np.diff(part, axis=0)) for part in parts],
        BLOCKS,
    )
    found.start = since
    found.p = min(found.p, float(np.exp(-2 * _CHANCE)))
    if len(channels) == 1:
        found.clues["cut"] = 1.0
    return [found]


def _common(numbers, off):
    """Of numbers (n,) how many of the first have a divisor in common, which, and whether so many changes of
    what they stand for, off (n, c), show that it is no chance, and begins at some row."""
    common = np.gcd.accumulate(numbers)
    steps = np.unique(common[common > 1])  # a row more may have a part of it in common by chance
    if not len(steps):
        return 0, 0.0, False
    rows = np.array([np.count_nonzero(common % step == 0) for step in steps])  # equal rows have all of it
    best = int((rows * np.log(steps)).argmax())
    long, q = int(rows[best]), float(steps[best])
    if long == len(numbers) or long < max(_LATER * len(numbers), 2 * BLOCKS):
        return long, q, False
    return long, q, np.count_nonzero(np.diff(off[:long], axis=0)) * np.log(q) > 2 * _CHANCE


def _lattice(columns):
    """Step of the lattice that all codes of columns of integers (n,) lie on; 1 where it may be chance."""
    gaps = np.concatenate([np.diff(np.unique(x)) for x in columns])
    step = int(np.gcd.reduce(gaps)) if len(gaps) else 1
    # each further code would lie on the lattice by chance once in `step` times
    return step if step > 1 and (len(gaps) - 1) * np.log(step) > _CHANCE else 1


def _spacing(x):
    """Typical distance of the codes that integers x (n,) visit, on a lattice or not; 1 where codes that are
    visited often have neighbours, nan where too few are."""
    value, count = np.unique(x[1:][np.diff(x) != 0], return_counts=True)  # one that stands still is no pile
    often = count >= _OFTEN
    if often.sum() < 3:
        return np.nan
    gap = np.diff(value)
    alone = np.minimum(np.append(gap, gap[-1]), np.insert(gap, 0, gap[0]))[often] > 1
    return float(np.median(gap[often[:-1]])) if alone.mean() > 0.8 else 1.0


def coarse(session: Session) -> bool:
    """Whether most channels are so coarse that noise seldom takes them from one code to another."""
    noise = sound_noise(np.median(session.recording.electrodes[session.fit], axis=0))
    return any(
        f.id == "quantise" and len(f.channels) > 9 and f.parameters["step"][0] > 2 * np.median(noise)
        for f in session.findings
    )


# --- held rows


def _held(session):
    """Rows that repeat the one before for longer, or less evenly, than a bus slower than the logger
    explains; or that move in steps with nothing but white noise between them."""
    _, n, rate = _rows(session)
    if coarse(session):  # rows repeat by chance
        return []
    same = (np.diff(session.recording.electrodes, axis=0) == 0).mean(1)
    held = np.concatenate([[False], same > 0.99])
    start, length = _runs(held)
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
            strength = _by_block(mask[mask], 0.002)  # each part of the rows held, however few
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
    strength = _by_block(mask[mask], 0.002)
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
    x, n, rate = _rows(session)
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
    start, length = _runs(calm)
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


def _stretch(mask):
    """What a mask (n,) says from its first to its last row, at least one row a block."""
    on = np.flatnonzero(mask)
    first = min(on[0], len(mask) - BLOCKS)
    return mask[first : max(on[-1] + 1, first + BLOCKS)]


def _runs(x):
    """Starts and lengths of runs of equal values."""
    edge = np.concatenate([[0], np.flatnonzero(np.diff(x) != 0) + 1, [len(x)]])
    return edge[:-1], np.diff(edge)


# --- single channels


def _still(session):
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
    start, length = _runs(mask[:, k])
    start, length = start[mask[start, k]], length[mask[start, k]]
    values = np.array([np.median(whole[a : a + n]) for a, n in zip(start, length)])
    ways = np.array([np.ptp(np.quantile(whole[a : a + n], [0.1, 0.9])) for a, n in zip(start, length)])
    # where the channel goes when it moves: next to nowhere beyond a limit
    ends = np.quantile(whole[moving], [0.03, 0.97]) if moving.any() else np.array([np.inf, -np.inf])
    on = np.flatnonzero(mask[:, k])
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
                _by_block(_stretch(flags), 0.003),
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


def _spiked(session):
    x = session.recording.electrodes
    coarse = np.zeros(19)
    for f in session.findings:
        if f.id == "quantise":
            coarse[list(f.channels)] = f.parameters["step"][0]
    bad = _outliers(x, coarse) & ~session.masked
    bad &= bad.sum(1, keepdims=True) <= _FEW  # what all do at once is of no channel
    number = bad.sum(0)  # each is told by the samples beside it, whatever is fitted
    off = np.abs(x - median_filter(x, size=(7, 1), mode="mirror"))
    far = bad & (off > _FAR * (noise_level(x, least=ROUNDING) + 1))
    minutes = len(x) / session.recording.rate / 60
    found = []
    for k in np.flatnonzero(number >= _FEW):
        if _in_a_row(session, bad[:, k]):
            if far[:, k].sum() >= _FEW:
                session.unnamed.append(
                    f"e{k + 1} leaves its trace {number[k]} times, often for more than one row: no spikes are"
                )
            continue
        mask = np.zeros(x.shape, bool)
        mask[:, k] = bad[:, k]
        rate = float(number[k] / minutes)
        found.append(
            fault(
                session,
                "spikes",
                (k,),
                {"rate": (rate, _NAN, _NAN)},
                mask,
                f"{number[k]} samples leave their neighbours by more than ten times the noise",
                _by_block(mask[:, k], 1e-5),
                BLOCKS,
            )
        )
        others = 1 + np.sort(number)[-4]  # a cable may carry three
        found[-1].p = float(poisson.sf(number[k] - 1, others))
        found[-1].clues["alone"] = float(np.log(number[k] / others))
        if far[:, k].sum() >= _FEW:
            _by_far(found[-1], far[:, k])
    return found + _anywhere(session, far)


def _in_a_row(session, bad):
    """Whether samples (n,) bool often stand side by side: a loose contact, or a word that overflows, leaves
    for longer than a sample. Rows that a logger repeats are one, where it does not repeat so many."""
    rows = np.flatnonzero(bad)
    fresh = np.unique(np.cumsum(~session.recording.repeated)[rows])
    return any(
        np.count_nonzero(np.diff(at) == 1) > max(1, share * len(at))
        for at, share in ((fresh, _BESIDE), (rows, _HELD))
    )


def _by_far(finding, far):
    """Samples far (n, ...) bool that no electrode has by itself."""
    finding.p = min(finding.p, float(poisson.sf(far.sum() - 1, _BY_ITSELF * 19 * len(far))))
    finding.clues["far"] = float(np.log(far.sum()))


def _anywhere(session, far):
    """Samples far (n, 19) bool of any electrode, now and then: bits or words lost on the way, whosever they
    are."""
    number = far.sum(0)
    hit = np.flatnonzero(number)
    if len(hit) < _FEW or number.sum() > _OFTEN_EACH * len(hit):  # more are a fault of their electrode
        return []
    rate = float(number.sum() * session.recording.rate / len(far) * 60)
    found = fault(
        session,
        "spikes",
        hit,
        {"rate": (rate, _NAN, _NAN)},
        far,
        f"{number.sum()} samples of {len(hit)} electrodes leave their neighbours by more than {_FAR:.0f} "
        "times the noise, one at a time",
        _by_block(far.any(1), 1e-5),
        BLOCKS,
    )
    found.p = 1.0
    _by_far(found, far)
    return [found]


def _off_rows(session):
    """Rows that most electrodes leave at once and come back to, however often."""
    x = session.recording.electrodes
    off = _outliers(x, np.zeros(19), often=True).sum(1) >= _MOST
    return _whole_rows(session, off) if off.any() else []


def _whole_rows(session, whole):
    """Rows (n,) bool that are no measurement, on any electrode."""
    rate = session.recording.rate
    mask = np.repeat(whole[:, None], 19, axis=1)
    f = fault(
        session,
        "spikes",
        range(19),
        {"rate": (float(whole.sum() * rate / len(whole) * 60), _NAN, _NAN)},
        mask,
        f"{whole.sum()} rows leave their neighbours on most electrodes at once and come back",
        _by_block(whole, 1e-5),
        BLOCKS,
    )
    f.p = float(poisson.sf(whole.sum() - 1, 1e-5 * len(whole)))
    f.clues["rows"] = float(np.log(whole.sum()))
    x = session.recording.electrodes
    off = np.abs(x - median_filter(x, size=(7, 1), mode="mirror"))[whole]
    if np.median(off, axis=1).min() > _GONE:
        f.clues["gone"] = 1.0
    return [f]


def _outliers(x, coarse, often=False):
    """(n, 19) bool of one or two samples that leave the trace and come back; coarse: (19,) step of codes.
    often: also where these are so frequent that they are most of what is around."""
    middle = median_filter(x, size=(7, 1), mode="mirror")  # the first and the last row are one of seven, too
    off = np.abs(x - middle)
    beside = np.pad(middle, ((6, 6), (0, 0)), mode="edge")
    before, after = beside[:-12], beside[12:]
    noise, lively = noise_level(x, least=ROUNDING), np.minimum(off, 200)
    if often:
        noise = np.minimum(noise, np.maximum(1.6 * np.median(off, axis=0), ROUNDING))
    least = (_ROWS if often else 10) * noise + 4 * coarse
    if often:  # those that stand alone are none of what is around
        next_to = np.pad(off, ((1, 1), (0, 0)), mode="edge")
        lively = np.where((off > least) & (np.maximum(next_to[:-2], next_to[2:]) < 0.3 * off), 0, lively)
    around = uniform_filter1d(lively, 101, axis=0, mode="mirror")
    # lively stretches leave the median by more
    limit = np.maximum(least, 10 * around)
    return (off > limit) & (np.abs(before - after) < 0.3 * off)
