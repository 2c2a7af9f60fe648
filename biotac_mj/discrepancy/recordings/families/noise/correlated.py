"""Noise that electrodes have in common: cross-talk between neighbours of the multiplexer, a supply."""

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_coeffs, savgol_filter

from .....geometry.electrodes import electrode_positions
from .....quality.noise import sound_noise
from ....evidence import sign_flip
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS
from .differences import calm_cells, differences

__all__ = ["correlated"]

_NAN = float("nan")
# channels' worth of a factor that noise has in common: 1.5 at most in real sensors, and in cross-talk
_FACTOR = 3.0
_LOUDER = 0.2  # than the law, as a logarithm: what touches do within rows is in the noise
_WAVE = 6.0  # times the median of the spectrum: 3 at most of noise, filtered or not
# sum of squared correlations beyond one factor: 0.2 in real pressed sensors, 0.6 in short pieces
_PAIRS = 0.25
# above which no load reaches: 1.1 at most of one, 1.4 to 4.4 of spatial cross-talk
_WIRED = 1.3
# share of it at one distance in channels, and of the three strongest pairs: 0.17 and 0.16 at most of a load,
# 0.4 or 0.3 and more of wires
_STRIDE, _THREE = 0.3, 0.25
_FEWEST = 6  # blocks behind the time from which on noise is correlated
# [counts] below which rounding is most of the noise, and its differences are neither white nor independent
_LEAST = 0.7


def correlated(session: Session) -> Finding | None:
    """Noise that electrodes have in common: with neighbours (cross-talk) or with all (reference, supply)."""
    d, rows = differences(session, 5)
    if len(d) < 40 * BLOCKS // 2 or _with_temperature(session, d, rows):
        return None
    cells, block, blocks = calm_cells(d, 0.3 if session.model().moved else 1.0)
    known = np.isfinite(cells)
    power = np.where(known, cells**2, 0).sum((0, 1)) / np.maximum(known.sum((0, 1)), 1)
    sd = np.sqrt(power / 252)
    alive = np.flatnonzero(sd > _LEAST)
    if len(alive) < 8:
        return None
    x = np.clip(np.nan_to_num(cells[:, :, alive]) / (sd[alive] * np.sqrt(252)), -3, 3)
    pairs = np.triu_indices(len(alive), 1)
    value = []
    for b in range(blocks):
        y = x[block == b].reshape(-1, len(alive))
        power = np.maximum((y**2).sum(0), 1e-9)
        value.append((y.T @ y / np.sqrt(np.outer(power, power)))[pairs])
    value = np.nan_to_num(np.array(value))  # (blocks, pairs)
    number = len(alive)
    # it may have been there from the first row on, or since some time
    since = [0, *range(2, blocks - _FEWEST + 1)]
    common, others = max((_explained(value[s:], number) for s in since), key=lambda e: e[1].sum())
    since = blocks - len(others)
    mean = value[since:].mean(0)
    size = len(x) * x.shape[1] / 2.9  # independent samples: fifth differences repeat each sample's noise
    error, last = 1 / np.sqrt(size), session.recording.time[-1]
    law = sound_noise(np.median(session.counts[session.fit], axis=0))
    louder = float(np.median(np.log(sd[alive] / law[alive])))
    clues = {
        "factor": float(np.log(max(common.mean(), 0.01))),
        "rest": float(np.log(max(others.sum() / blocks, 0.01))),
        "louder": louder,
        "loaded": float(session.loaded),
    }
    if (
        _peak(np.nan_to_num(cells[:, :, alive]) / sd[alive]) > _WAVE
    ):  # a wave, each electrode at its own phase
        return None
    p = sign_flip(others)
    wired = others.sum() / blocks > _WIRED or _few(
        mean - _factor(mean, number)[pairs], alive[np.array(pairs)]
    )
    if p < 0.02 and others.mean() > max(_PAIRS, 0.25 * common.mean()) and louder < _LOUDER and wired:
        K, parameters = _coupling(mean, alive, sd, 4 * error)
        matrix = np.linalg.inv(np.eye(19) + K)
        centre = np.median(session.counts[session.fit], axis=0)
        most = int(np.abs(mean).argmax())
        onset = session.recording.time[rows[len(rows) * since // blocks]] if since else 0.0

        def correct(counts, at):
            out, late = counts.copy(), at >= onset
            out[late] = centre + (counts[late] - centre) @ matrix.T
            return out

        return Finding(
            "crosstalk",
            tuple(range(19)),
            {"kappa": (parameters[0], parameters[0] - error, parameters[0] + error)}
            | ({"length": (parameters[1], _NAN, _NAN)} if len(parameters) > 1 else {}),
            float(size * others.sum()),
            p,
            onset,
            last,
            note=f"noise of some electrodes is correlated, of e{alive[pairs[0][most]] + 1} and "
            f"e{alive[pairs[1][most]] + 1} by {mean[most]:.2f}; a sensor's is independent",
            ties=("common_noise",) if common.mean() > others.mean() else (),
            clues=clues,
            correct=correct,
        )
    p = sign_flip(common)
    size_of = float(np.sqrt(max(2 * common.mean(), 0)))  # of n channels that are all alike: n
    if p < 0.01 and size_of > 0.02 * number:
        share = size_of / number
        return Finding(
            "common_noise",
            tuple(range(19)),
            {"correlation": (share, share - error, share + error)},
            float(size * common.sum() / 2),
            p,
            0.0,
            last,
            ties=("crosstalk",) if size_of < _FACTOR else (),
            note=f"noise has a part in common, as much as {1 + size_of:.1f} electrodes have alone",
            clues=clues,
            correct=_without_common(x.reshape(-1, number), sd) if number == 19 else None,
        )
    return None


def _explained(value, number):
    """Of correlations in blocks (b, pairs) of some number of channels: by the other blocks, what one factor
    explains of each block (b,), and what is left of pairs (b,)."""
    pairs = np.triu_indices(number, 1)
    common, others = np.empty(len(value)), np.empty(len(value))
    rest = np.array([np.delete(value, b, axis=0).mean(0) for b in range(len(value))])
    for b, (by, factor) in enumerate(zip(rest, _factor(rest, number))):
        one = factor[pairs]
        common[b], others[b] = one @ value[b], (by - one) @ (value[b] - one)
    return common, others


def _few(left, pairs):
    """Whether correlations (p,) of pairs (2, p) of electrodes, less what all have in common, are of few of
    them, or of electrodes that lie as many channels apart, as wires do. A load that moves faster than the
    smooth course has more dimensions than one, too, and those join all electrodes that it moves."""
    square = left**2
    apart = np.bincount(pairs[1] - pairs[0], square)
    return apart.max() > _STRIDE * square.sum() or np.sort(square)[-3:].sum() > _THREE * square.sum()


def _peak(cells):
    """How far the spectrum of what fifth differences (windows, rows, channels) have in common stands out at
    one frequency above its median: a noise has no such, a wave has."""
    rows = cells.shape[1]
    together = cells.reshape(-1, cells.shape[2])
    share = np.linalg.eigh(together.T @ together)[1][:, -1]
    power = (np.abs(np.fft.rfft((cells @ share) * np.hanning(rows), axis=1)) ** 2).mean(0)
    f = np.fft.rfftfreq(rows)
    power = (power / np.maximum(2 - 2 * np.cos(2 * np.pi * f), 1e-9) ** 5)[f > 0.15]
    return float(power.max() / np.median(power))


def _with_temperature(session, d, rows):
    """Whether what differences d (n, 19) have in common is the thermistor's."""
    if session.recording.tdc is None:
        return False
    common = np.nan_to_num(np.nanmean(d, axis=1))
    warm = np.diff(session.recording.tdc[np.r_[rows[0] - np.arange(5, 0, -1), rows]], n=5)
    both = np.array([common, warm])
    return bool(both.std(1).min() > 0 and abs(np.corrcoef(both)[0, 1]) > 0.5)


def _factor(pair, number):
    """(..., number, number) correlations that one factor explains of those of pairs (..., pairs), each
    channel with a share of its own: principal factor."""
    i, j = np.triu_indices(number, 1)
    whole = np.zeros((*pair.shape[:-1], number, number))
    whole[..., i, j] = whole[..., j, i] = pair
    own = np.full((*pair.shape[:-1], number), 0.3)
    each = np.arange(number)
    for _ in range(15):
        whole[..., each, each] = own
        size, axes = np.linalg.eigh(whole)
        share = axes[..., -1] * np.sqrt(np.maximum(size[..., -1:], 0.0))
        own = np.clip(share**2, 0, 0.98)
    return share[..., :, None] * share[..., None, :]


def _coupling(pair, alive, sd, least):
    """(19, 19) of a symmetric cross-talk by correlations of pairs (pairs,) of the channels `alive`, those
    below `least` nothing; and its size, with the length [mm] if neighbours have it."""
    K = np.zeros((19, 19))
    pairs = np.triu_indices(len(alive), 1)
    i, j = alive[pairs[0]], alive[pairs[1]]
    K[i, j] = np.where(np.abs(pair) > least, pair, 0) * sd[i] * sd[j] / (sd[i] ** 2 + sd[j] ** 2)
    K += K.T
    half = K[np.triu_indices(19, 1)]
    if not half.any():  # many pairs, none of which stands out by itself
        return K, (0.0,)
    p = electrode_positions()
    distance = np.linalg.norm(p[:, None] - p[None], axis=2)[np.triu_indices(19, 1)]
    near = {length: np.exp(-distance / length) for length in (2.0, 4.0, 6.0)}
    alike = {length: float(np.corrcoef(k, half)[0, 1]) for length, k in near.items()}
    best = max(alike, key=alike.get)
    if alike[best] > 0.8:
        k = near[best]
        return K, (float(k @ half / (k @ k) * k.max()), best)
    return K, (float(half[np.abs(half).argmax()]),)


def _without_common(x, sd):
    """Takes out the one noise that all channels have, each with a share of its own: the factor that their
    differences x (rows, channels), of unit size, have in common; of counts, what the factor's direction does
    from row to row beyond a smooth course, as smooth as rows left out there ask for. sd: (19,) of noise."""
    correlation = np.corrcoef(x.T)
    own = np.ones(len(correlation))
    for _ in range(20):  # principal factor
        size, axes = np.linalg.eigh(correlation - np.diag(own))
        factor = np.abs(axes[:, -1]) * np.sqrt(max(size[-1], 0.0))
        own = np.clip(1 - factor**2, 0.02, 1)
    share = factor * sd
    weight = factor / (own * sd)
    weight /= weight @ share

    def correct(counts, at):
        common = counts @ weight
        smooth, missed = [], []
        for rows in (5, 9, 17, 33, 65):
            course = savgol_filter(common, rows, 2, mode="nearest")
            without = (common - course) / (1 - savgol_coeffs(rows, 2)[rows // 2])
            smooth.append(course)
            missed.append(uniform_filter1d(without**2, 65))
        course = np.take_along_axis(np.array(smooth), np.argmin(missed, axis=0)[None], axis=0)[0]
        return counts - np.outer(common - course, share)

    return correct
