"""Whether force and electrodes are of the same time: both move when something touches, or one of them was
logged by another clock, or with another touch."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from .recording import FORCE_MOVED
from .session import Session

__all__ = ["apart"]

_BAND = (0.1, 1.0)  # [s] of smoothing between which touches move: noise is faster, drift slower
_RATE = 20.0  # [Hz] in which activities are compared
_LATE = 1.0  # [s] up to which what is late is an effect of the sensor
_LEAST = 15.0  # [s]: in less two logs that have nothing in common may look alike
# correlation of how much force and electrodes move, in 12 to 190 s of two real sensors: 0.70 to 0.96 as they
# are; with the force put 3.4 s off at least 0.68 there and 0.48 at most in time; turned around 0.57 at most
_FAR, _LESS, _NOTHING = 0.6, 0.15, 0.25


def apart(session: Session) -> str | None:
    """What is wrong between force and electrodes of a loaded sensor, None if nothing is seen."""
    r = session.recording
    n = len(r)
    if r.force is None or not session.loaded or r.force.std(0).max() < FORCE_MOVED or n / r.rate < _LEAST:
        return None
    step = max(1, round(r.rate / _RATE))
    a, b = (_activity(x, r.rate)[::step] for x in (session.counts, r.force))
    m, rate = len(a), r.rate / step
    size = 2 * m  # zeros behind: the end of a recording says nothing of its beginning
    both = np.fft.irfft(np.fft.rfft(a, size).conj() * np.fft.rfft(b, size), size)
    lag = (np.arange(size) + m) % size - m
    c = both / np.maximum(m - np.abs(lag), 1)
    near = np.abs(lag) <= _LATE * rate
    far = ~near & (np.abs(lag) <= m // 2)
    if not far.any():
        return None
    best = np.flatnonzero(far)[c[far].argmax()]
    here, there = c[near].max(), c[best]
    if there >= _FAR and there - here >= _LESS:
        when = "after" if lag[best] > 0 else "before"
        return (
            f"force and electrodes do not meet: it moves best as they do {abs(lag[best]) / rate:.1f} s "
            f"{when} them; were they logged by two clocks, or is one from another row on?"
        )
    if here < _NOTHING:
        return "force and electrodes move at different times: are they of the same touches?"
    return None


def _activity(x, rate):
    """(n,) how much the median column of x (n, k) moves, standardised; a column's fault does not count."""
    fast, slow = (gaussian_filter1d(x, s * rate, axis=0, mode="nearest") for s in _BAND)
    size = np.abs(fast - slow)
    if x.shape[1] > 3:
        size = np.median(size / np.maximum(size.mean(0), 1e-12), axis=1)
    else:
        size = np.linalg.norm(size, axis=1)
    size = np.log(size + np.quantile(size, 0.2) + 1e-12)
    return (size - size.mean()) / max(size.std(), 1e-12)
