"""Faults of samples: coarse, held, lost, stuck, clipped and spiked ones. What is no measurement is masked."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import median_filter, percentile_filter, uniform_filter1d

from ..evidence import sign_flip
from ..noise import noise_level
from .courses import BLOCKS
from .findings import Finding
from .session import Session

__all__ = ["lost", "quantised", "sampling_faults"]

_NAN = float("nan")
_FEW = 4  # electrodes that may jump for reasons of their own


def sampling_faults(session: Session, take: Callable[[Finding], bool]) -> None:
    """Offers all of them to `take`, in the order in which they have to be taken out; each is searched
    without the samples of those before it."""
    for find in (quantised, _held, _stuck, _clipped, _spiked):
        for finding in find(session):
            take(finding)


def _rows(session):
    x = session.recording.electrodes[session.fit]
    return x, len(session.recording), session.recording.rate


def _finding(session, name, channels, parameters, mask, note, strength, blocks, correct=None):
    """strength: (blocks,) how many times more often than chance allows, in nats, block by block."""
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
        clues={"nats": float(np.log1p(np.sum(strength))), "blocks": float(np.mean(np.asarray(strength) > 0))},
        mask=mask,
        correct=correct,
    )


def _by_block(flags, chance):
    """(blocks,) nats by which flags (n,) are more frequent than chance, in each block."""
    share = np.array([b.mean() for b in np.array_split(flags.astype(float), BLOCKS)])
    size = len(flags) / BLOCKS
    share, chance = np.clip(share, 1e-9, 1), np.clip(chance, 1e-9, 1)
    return np.sign(share - chance) * size * np.abs(share * np.log(share / chance) - share + chance)


# --- coarse


def quantised(session: Session) -> list[Finding]:
    """Coarse channels: every value on a lattice of more than one count."""
    x, _, _ = _rows(session)
    if np.any(x != np.rint(x)):
        return []
    blocks = np.array_split(x.astype(int), BLOCKS)
    step = np.array([_lattice(c) for c in x.T.astype(int)])
    coarse = np.flatnonzero(step >= 2)
    if not len(coarse):
        return []
    q = float(np.median(step[coarse]))
    # of a lattice of single counts every q-th value would be met by chance
    strength = [np.log(q) * sum(len(np.unique(b[:, k])) - 1 for k in coarse) for b in blocks]
    channels = range(19) if len(coarse) > 15 else coarse
    return [
        _finding(
            session,
            "quantise",
            channels,
            {"step": (q, q, q)},
            None,
            f"every value is a multiple of {q:g} counts (up to an offset)",
            strength,
            BLOCKS,
        )
    ]


def _lattice(x):
    values = np.unique(x)
    return int(np.gcd.reduce(np.diff(values))) if len(values) >= 4 else 1


# --- held rows


def _held(session):
    """Rows that repeat the one before for longer, or less evenly, than a bus slower than the logger
    explains; or that move in steps with nothing but white noise between them."""
    x, n, rate = _rows(session)
    same = (np.diff(session.recording.electrodes, axis=0) == 0).mean(1)
    held = np.concatenate([[False], same > 0.99])
    start, length = _runs(held)
    on = held[start]
    if on.any():
        runs = length[on]
        # a bus that is r times slower repeats floor(r) - 1 or floor(r) rows, the commonest runs
        usual = np.bincount(runs).argmax() + 1
        long = on & (length > usual)
        mask = np.zeros(n, bool)
        for s, k in zip(start[long], length[long]):
            mask[s : s + k] = True
        share = mask.mean()
        longest = length[long].max() if long.any() else 0
        if (share > 0.03 or longest >= max(8, 3 * usual)) and longest >= 2 + usual:
            seconds = float(mask.sum() / rate)
            strength = _by_block(mask[mask], 0.002)  # each part of the rows held, however few
            return [
                _finding(
                    session,
                    "freeze",
                    range(19),
                    {"seconds": (seconds, seconds, seconds)},
                    np.repeat(mask[:, None], 19, axis=1),
                    f"{seconds:.1f} s of rows repeat the one before in all electrodes, up to "
                    f"{longest / rate:.2f} s at a time",
                    strength,
                    BLOCKS,
                )
            ]
    return _dithered(session) if held.mean() < 0.4 and noise_level(x).mean() > 0.7 else []


def _dithered(session):
    x, n, rate = _rows(session)
    noise = np.median(np.abs(np.diff(x, axis=0)), axis=0) / 0.954
    step = (np.diff(x, axis=0) / np.maximum(noise, 0.5)) ** 2 + 1e-3
    step = np.minimum(step.mean(1), np.quantile(step.mean(1), 0.99))
    best = None
    for period in range(2, int(min(0.25 * rate, 40)) + 1):
        for phase in range(period):
            strong = step[phase::period]
            weak = np.delete(step, np.arange(phase, len(step), period))
            # the weakest kind of the others: rows held say all others are alike
            ratio = np.log(strong.mean() / weak.mean())
            if best is None or ratio > best[0]:
                best = ratio, period, phase
    ratio, period, phase = best
    blocks = np.array_split(np.arange(len(step)), BLOCKS)
    gain = np.array(
        [
            np.log(step[b][(b % period) == phase].mean() / step[b][(b % period) != phase].mean())
            for b in blocks
        ]
    )
    # what is held does not move: between the steps there is noise alone
    if ratio < 0.7 or np.median(gain) < 0.5:
        return []
    others = [np.log(step[(np.arange(len(step)) % period) == q].mean()) for q in range(period) if q != phase]
    if len(others) > 1 and np.ptp(others) > 0.5 * ratio:
        return []
    mask = np.zeros((n, 19), bool)
    mask[(np.arange(n) - phase - 1) % period != 0] = True
    seconds = period / rate
    return [
        _finding(
            session,
            "freeze",
            range(19),
            {"seconds": (seconds, seconds, seconds)},
            mask,
            f"all electrodes move every {period} rows only, with noise between",
            gain * len(step) / BLOCKS / period * 9,
            BLOCKS,
        )
    ]


def _stretch(mask):
    """What a mask (n,) says from its first to its last row, at least one row a block."""
    on = np.flatnonzero(mask)
    return mask[on[0] : max(on[-1] + 1, on[0] + BLOCKS)]


def _runs(x):
    """Starts and lengths of runs of equal values."""
    edge = np.concatenate([[0], np.flatnonzero(np.diff(x) != 0) + 1, [len(x)]])
    return edge[:-1], np.diff(edge)


# --- single channels


def _stuck(session):
    _, n, rate = _rows(session)
    free = ~session.masked[:, 0]
    whole = session.recording.electrodes
    found = []
    lattice = {k: f.parameters["step"][0] for f in session.findings if f.id == "quantise" for k in f.channels}
    # one channel that stands still while others move; a toggling last bit is no movement
    size = max(8, int(0.25 * rate))
    moves = np.array([_movement(c, size) for c in whole.T]).T  # (n,) range over `size` rows
    usual = np.median(moves[session.fit & free], axis=0)
    active = np.median(moves / np.maximum(usual, 0.5), axis=1) > 0.5
    steps = np.array([lattice.get(k, 1.0) for k in range(19)])
    # without noise a constant reading is no news; while it is stuck it has none
    halves = np.array_split(whole, 2)
    alive = np.maximum(*(noise_level(x) for x in halves)) > 0.7 * steps
    for k in range(19):
        if not alive[k] and not _edge_value(whole[:, k]):
            continue
        if usual[k] < 3 * lattice.get(k, 0.7) and not _edge_value(whole[:, k]):
            continue
        still = (moves[:, k] <= min(1, 0.2 * max(usual[k], 2))) & active & free
        mask = np.zeros((n, 19), bool)
        start, length = _runs(still)
        for s, m in zip(start, length):
            if still[s] and m >= 2 * size:
                mask[max(s - size // 2, 0) : s + m + size // 2, k] = True
        if mask.any():
            value = np.median(whole[mask[:, k], k])
            on = np.flatnonzero(mask[:, k])
            mask[on[0] : on[-1] + 1, k] |= np.abs(whole[on[0] : on[-1] + 1, k] - value) <= 1
        if mask.sum() < max(30, 3 * size) or _clip_like(whole[:, k], mask[:, k]):
            continue
        value = float(np.median(whole[mask[:, k], k]))
        chance = np.clip((moves[:, k] <= 1).mean() * 0.01, 1e-4, 0.5)
        strength = _by_block(_stretch(mask[:, k]), chance)
        found.append(
            _finding(
                session,
                "stuck",
                (k,),
                {"value": (value, value, value)},
                mask,
                f"{mask.sum() / rate:.1f} s without movement at {value:.0f} counts",
                strength,
                BLOCKS,
            )
        )
    return found if len(found) <= 6 else []


def _movement(x, size):
    """(n,) second largest less second smallest of the rows around, so that one sample's bit does not
    count."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    smooth = median_filter(x, 3, mode="nearest")
    return maximum_filter1d(smooth, size) - minimum_filter1d(smooth, size)


def _edge_value(x):
    return bool(np.isin(x, (0, 4095)).mean() > 0.02)


def _clip_like(x, mask):
    """Stretches at one end of the channel's range, to which it comes back, are clipping, unless they are
    long."""
    if mask.mean() > 0.8 or not mask.any():
        return False
    value = np.median(x[mask])
    edge = value <= np.quantile(x, 0.001) + 2 or value >= np.quantile(x, 0.999) - 2
    return bool(edge and len(_runs(mask)[0]) > 4 and 5 < value < 4090)


def _clipped(session):
    hits = []
    x = session.recording.electrodes
    other = {k for f in session.findings if f.id in ("quantise", "stuck") for k in f.channels}
    for k in sorted(set(range(19)) - other):
        good = session.fit & ~session.masked[:, k]
        y = x[good, k]
        if len(y) < 100 or np.ptp(y) < 8 or noise_level(y[:, None])[0] < 0.7:
            continue
        for side in (1, -1):
            values, count = np.unique(side * y, return_counts=True)
            if len(values) < 12:
                continue
            # a pile at the limit, beside what lies within a few values below
            top = int(np.argmax(count[-4:])) + len(count) - 4
            pile, beyond = count[top], count[top + 1 :].sum()
            near = count[max(top - 12, 0) : max(top - 2, 1)]
            expected = max(float(np.median(near)), 1.0)
            if pile > 6 * expected + 12 and pile > 0.004 * len(y) and beyond < 0.25 * pile:
                hits.append((k, side, float(side * values[top]), pile, expected))
    found = []
    for side, level in {(h[1], round(h[2]) if h[2] in (0, 4095) else (h[0], h[2])) for h in hits}:
        group = [h for h in hits if h[1] == side and (h[2] == level or (h[0], h[2]) == level)]
        channels, limit = [h[0] for h in group], group[0][2]
        mask = np.zeros(x.shape, bool)
        mask[:, channels] = side * x[:, channels] >= side * limit - 2
        flags = mask[session.fit][:, channels].any(1)
        chance = min(0.5, sum(h[4] for h in group) / session.fit.sum())
        found.append(
            _finding(
                session,
                "saturate",
                channels,
                {"level": (limit, limit - 0.5, limit + 0.5)},
                mask,
                f"{flags.mean():.1%} of the samples lie on {limit:g}, the "
                f"{'largest' if side > 0 else 'smallest'} value",
                _by_block(flags, chance),
                BLOCKS,
            )
        )
        found[-1].beyond = side
        found[-1].clues |= {
            "pile": float(np.log(group[0][3] / group[0][4])),
            "share": float(np.log(flags.mean())),
        }
    return found


def _spiked(session):
    x = session.recording.electrodes
    bad = _outliers(x) & ~session.masked
    number = bad[session.fit].sum(0)
    minutes = session.fit.sum() / session.recording.rate / 60
    found = []
    for k in np.flatnonzero(number >= 4):
        mask = np.zeros(x.shape, bool)
        mask[:, k] = bad[:, k]
        rate = float(number[k] / minutes)
        found.append(
            _finding(
                session,
                "spikes",
                (k,),
                {"rate": (rate, _NAN, _NAN)},
                mask,
                f"{number[k]} samples leave their neighbours by more than ten times the noise",
                _by_block(mask[session.fit, k], 1e-5),
                BLOCKS,
            )
        )
    return found


def _outliers(x):
    """(n, 19) bool of one or two samples that leave the trace and come back."""
    middle = median_filter(x, size=(7, 1), mode="nearest")
    off = np.abs(x - middle)
    before, after = np.roll(middle, 6, axis=0), np.roll(middle, -6, axis=0)
    around = uniform_filter1d(np.minimum(off, 200), 101, axis=0, mode="nearest")
    # lively stretches leave the median by more
    limit = np.maximum(np.maximum(10 * noise_level(x), 25), 10 * around)
    return (off > limit) & (np.abs(before - after) < 0.3 * off)


# --- lost rows


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
    if np.median(noise) < 0.7 or not session.loaded:  # at rest nothing is missed
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
    # after rows that were held the load has moved on
    places = [
        i for i in places if not session.masked[max(rows[i + h] - 3 * h, 0) : rows[i + h] + 1].all(1).any()
    ]
    if not places:
        return []
    at = rows[np.array(places) + h]
    share = np.mean([np.mean(np.abs(jump[i]) > 3) for i in places])
    strength = np.zeros(BLOCKS)
    for row, i in zip(at, places):
        strength[int(row * BLOCKS / len(r))] += 0.5 * score[i] ** 2
    f = _finding(
        session,
        "lost_rows",
        range(19),
        {"seconds": (_NAN, _NAN, _NAN)},
        None,
        f"at {', '.join(f'{row / r.rate:.2f}' for row in sorted(at)[:6])} s all electrodes jump between "
        "two rows",
        strength,
        BLOCKS,
    )
    f.start, f.end = float(min(at) / r.rate), float(max(at) / r.rate)
    f.p = len(places) / len(score)  # rows that stand alone as much
    ratio = max(score[i] / max(around[i], 1) for i in places)
    f.clues |= {
        # up to a dozen times what is around it a place or two of every record jumps
        "times": float(np.clip(ratio, 12, 30)),
        "places": at / r.rate,
        "number": float(np.log(len(places))),
        "electrodes": float(share),
        "score": float(np.log(max(score[i] for i in places))),
    }
    return [f]
