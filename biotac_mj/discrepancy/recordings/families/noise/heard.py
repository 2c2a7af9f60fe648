"""Channels that hear the one beside them in the order in which the multiplexer reads them, by their noise.

A load reaches many electrodes, and says little of wiring. Noise is each channel's own: what noise of one
channel is left once all others have said what they know of it is in no other's, unless the one hears the
other. Of sound sensors, whose neighbours feel the same small movements, up to a third is in common."""

import numpy as np

from ....evidence import sign_flip
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS
from .differences import differences

__all__ = ["heard"]

_ORDER = 3  # of the differences, that leave the noise
_SPREAD = np.sqrt(20.0)  # of a third difference of white noise
_INDEPENDENT = 3.0  # rows for one of their differences that is independent
_CLIP = 3.0  # spreads, so that no outlier says what channels have in common
_OWN = 0.03  # of a channel's variance, that no other can know of
_LEAST = 1.2  # [counts] of noise, below which rounding is most of it
_FEWEST = 200  # differences
_MASKED = 0.1  # of a channel's samples at most
_DOUBT = 2.0  # standard errors less than was seen
# that neighbours' noise has in common at least, less these errors: 0.25 at most in 183 pieces of real sensors
# without an effect, 0.26 in others, of which no noise is common or filtered and no wave is left
_COMMON = 0.27
_SINCE = (0.0, 1 / 2, 2 / 3)  # of the rows fitted, that it is looked for in the rest of
_CHAIN, _MANY = 0.15, 4  # that many pairs of a chain have in common, and how many


def heard(session: Session) -> Finding | None:
    """The channels of which noise is the neighbour's, too."""
    d, rows = differences(session, _ORDER)
    known = np.isfinite(d).mean(0) > 1 - _MASKED if len(d) else np.zeros(19, bool)
    if len(d) < _FEWEST or known.sum() < 8:
        return None
    size = np.zeros(19)
    size[known] = 1.4826 * np.nanmedian(np.abs(d[:, known]), axis=0) / _SPREAD
    alive = size > _LEAST
    size = np.maximum(size, _LEAST)
    z = np.clip(np.nan_to_num(d) / size / _SPREAD, -_CLIP, _CLIP)
    # it may have begun later, or grown
    for since in _SINCE:
        product, both, P, error = _partial(z[int(since * len(z)) :], alive)
        low = both - _DOUBT * error
        if low.max() >= _COMMON:
            break
    k = int(low.argmax())
    if low[k] < _COMMON:
        return None
    p = sign_flip(np.array([b.mean() for b in np.array_split(product[:, k], BLOCKS)]))
    onset = float(session.recording.time[rows[int(since * len(z))]]) if since else 0.0
    chain = (low > _CHAIN).sum() >= _MANY
    pairs = np.flatnonzero(low > _CHAIN if chain else low >= _COMMON)
    channels = range(19) if chain else sorted({*pairs, *(pairs + 1)})
    share = np.zeros(19)  # of the one before, that each hears
    share[pairs + 1] = -P[pairs, pairs + 1] / P[pairs + 1, pairs + 1] * size[pairs + 1] / size[pairs]
    kappa = float(np.median(share[pairs + 1]))
    hears = np.eye(19) + np.diag(share[1:], -1)
    if chain:  # each mixes in the one before, the first the last
        hears = (1 - kappa) * np.eye(19) + kappa * np.eye(19)[np.roll(np.arange(19), 1)]
    undo = np.linalg.inv(hears)
    # of a chain nothing jumps where it is taken out from: it may have been there before
    near = session.fit
    if chain and since:
        near = near & (np.abs(session.recording.time - onset) < 1.0)
    centre = np.median(session.counts[near], axis=0)

    def correct(counts, at):
        out, late = counts.copy(), at >= onset
        out[late] = centre + (counts[late] - centre) @ undo.T
        return out

    names = ", ".join(
        f"e{i + 1} and e{i + 2} {both[i]:.2f}" for i in sorted(pairs, key=lambda i: -both[i])[:4]
    )
    return Finding(
        "crosstalk",
        tuple(int(i) for i in channels),
        {"kappa": (kappa, kappa - error, kappa + error)},
        float(len(product) / _INDEPENDENT * both[k] ** 2 / 2),
        p,
        onset,
        session.recording.time[-1],
        note=("" if not since else f"from {onset:.1f} s on at the latest, ")
        + f"noise that neighbours in the multiplexer's order have in common: {names}; which of two hears "
        "the other it does not say",
        clues={"heard": float(low[k] - _COMMON)},
        correct=correct,
    )


def _partial(z, alive):
    """Of standardised differences z (n, 19): products (n, 18) of what is left of neighbours once all others
    have said what they know of it, their correlations (18,), the precision (19, 19), and the error of one."""
    P = np.linalg.inv(z.T @ z / len(z) + _OWN * np.eye(19))
    left = z @ P / np.sqrt(np.diag(P))
    product = -left[:, :-1] * left[:, 1:]
    power = np.where(alive, (left**2).mean(0), np.inf)
    both = product.mean(0) / np.sqrt(power[:-1] * power[1:])
    return product, both, P, float(np.sqrt(_INDEPENDENT / len(z)))
