"""Counts that overflow: a word loses its upper bits, and what leaves a band on one side comes back on the
other. No effect of the catalogue does that, and until it is undone every search finds something else."""

import dataclasses

import numpy as np

from ...quality.noise import noise_level
from .recording import PlainRecording

__all__ = ["unwrapped"]

_BITS = (7, 8, 9, 10, 11)  # that a word has left
_SURE = 16.0  # nats: by chance changes are as near to the size and ends of the band once in 9e6 times
_NEAR = 1 / 16  # of the band
_LOOSE = 1 / 4  # of the band, where others overflow: a load moves electrodes meanwhile
_TIMES = 3  # in each: what leaves and comes back once may be a spike
# of one that leaves and comes back once: of a band so large, for so many rows, from its one end to the other
_LARGE, _AWAY = 1024, 3
_SHARE = 0.8  # of the changes beyond half of the band that are overflows
_SHOWN = 4  # electrodes


def unwrapped(recording: PlainRecording) -> tuple[PlainRecording, str]:
    """The recording with the upper bits put back by going on from row to row, and what to say of it; the same
    recording and no text where nothing overflows. Which band a channel was in before the first row nobody
    knows: the one nearest to the other electrodes is taken."""
    x = recording.electrodes
    band, faulty = _faulty(x)
    if not len(faulty):
        return recording, ""
    out = x.copy()
    for k in faulty:
        step = np.diff(x[:, k])
        out[1:, k] = x[0, k] + np.cumsum(step - band * np.rint(step / band))
    sound = np.median(np.delete(out, faulty, axis=1)) if len(faulty) < x.shape[1] else np.median(out)
    for k in faulty:  # a whole number of bands that keeps it within what a converter gives
        shift = band * np.rint((sound - np.median(out[:, k])) / band)
        if np.ptp(x[:, k]) < band and 0 <= out[:, k].min() + shift and out[:, k].max() + shift <= 4095:
            out[:, k] += shift
    shown = ", ".join(f"e{k + 1}" for k in faulty[:_SHOWN])
    text = (
        f"counts of {shown}{' and others' if len(faulty) > _SHOWN else ''} overflow at {band:.0f}: upper "
        "bits are lost; what is said is of counts put back"
    )
    return dataclasses.replace(recording, electrodes=np.clip(out, 0, 4095)), text


def _faulty(x):
    """Counts after which channels x (n, 19) begin again, a power of two, and which do: those that leave and
    come back, and where some surely do, those that left for good, too."""
    noise = noise_level(x)
    for band in 2.0 ** np.array(_BITS):
        both, once, nats = [], [], 0.0
        for k in range(x.shape[1]):
            step = np.diff(x[:, k])
            rows = np.flatnonzero(np.abs(step) > band / 2)
            left = np.abs(step[rows] - band * np.rint(step[rows] / band))
            mine = rows[left < _NEAR * band]
            if len(rows) and (left < _LOOSE * band).mean() > _SHARE and np.ptp(x[rows[0] + 1 :, k]) < band:
                once.append(k)
            away = band >= _LARGE and len(mine) == 2 and _once(x[:, k], mine, band)
            if not away and len(mine) < max(_TIMES, _SHARE * len(rows)):
                continue
            after = x[mine[0] + 1 :, k]
            inside = after[: mine[-1] - mine[0]]
            ends = np.where(step[mine] < 0, x[mine + 1, k], x[mine, k])  # on the lower side
            same = np.unique(ends, return_counts=True)[1].max()  # what drops out does so to one count
            # one bit of a word that fails leaves the band
            few = away or 2 * same <= len(ends)
            if {1.0, -1.0} == {*np.sign(step[mine])} and np.ptp(inside) < band and few:
                both.append(k)
                near = np.maximum(left[left < _NEAR * band], noise[k]) + 1
                nats -= np.log(2 * near / band).sum() + (4 * np.log(_NEAR) if away else 0)
        if both and nats > _SURE:
            return float(band), np.union1d(both, once).astype(int)
    return 0.0, np.zeros(0, int)


def _once(x, rows, band):
    """Whether what leaves x (n,) after the first and comes back after the second of two rows does so from one
    end of a band to the other: neither a spike nor a wire that breaks begins and ends there."""
    ends = x[[rows[0], rows[0] + 1, rows[1], rows[1] + 1]] % band / band
    near = np.minimum(ends, 1 - ends) < _NEAR
    low = ends < 0.5
    across = (low == [low[0], not low[0], not low[0], low[0]]).all()
    one = np.abs(np.diff(x)[rows]).max() < 1.5 * band
    return rows[1] - rows[0] >= _AWAY and near.all() and across and one
