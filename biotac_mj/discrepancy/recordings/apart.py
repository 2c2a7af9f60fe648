"""What sets electrodes apart from the others of the same recording, whatever its cause: numbers of each, most
of them logarithms, which the electrodes of a sound sensor have alike. How far one stands above the median is
compared with recordings without an effect (`rest.py`)."""

import numpy as np

from ..noise import sound_noise
from .families.courses import BLOCKS
from .families.noise.size import left_of_others
from .model import Model

__all__ = ["SAID", "answers", "noises"]

_CELLS, _SHORT = 24, 60  # of noise, and rows of each at least
_SINCE = (0.5, 0.7)  # of the recording
# what an electrode does of which a number is unusual
SAID = {
    "noisy": "is noisier than the others",
    "dull": "has less noise than the others",
    "swings": "has noise that comes and goes",
    "tails": "is far off now and then",
    "equal": "repeats values",
    **{f"since {part}": "answers otherwise after some time" for part in _SINCE},
}


def noises(x: np.ndarray) -> dict:
    """Of counts x (n, c), no row a repetition: name -> (c,), of fifth differences less what the others' say
    of them, so that no load is in it, and of values that come again."""
    law, c = sound_noise(np.median(x, axis=0)), x.shape[1]
    own = np.abs(left_of_others(np.diff(x, n=5, axis=0) / np.sqrt(252) / law))
    size = max(_SHORT, len(own) // _CELLS)
    cells = own[: len(own) // size * size].reshape(-1, size, c)
    level = np.log(np.quantile(cells, 0.8, axis=1) / 1.28 + 0.2 / law)
    # beside the law and as it is: one that has as much as the others by either does not stand apart
    both = level - np.median(level, axis=1)[:, None], level + np.log(law)
    both = both[0], both[1] - np.median(both[1], axis=1)[:, None]
    low, high = np.quantile(both[0], [0.1, 0.9], axis=0)
    middle, loud = (np.array([np.quantile(b, q, axis=0) for b in both]) for q in (0.5, 0.85))
    usual, far = np.quantile(own, [0.6, 0.998], axis=0) + 0.1 / law
    step = np.diff(x, axis=0)
    swing = np.maximum(np.sqrt(np.mean(np.clip(step / law, -8, 8) ** 2, axis=0)) * law, 0.3)
    again = np.log(((step == 0).mean(0) + 0.01) / (0.4 / swing + 0.01))
    return {
        "noisy": loud.min(0),
        "dull": -middle.max(0),
        "swings": high - low,
        "tails": np.log(far / usual),
        "equal": again,
    }


def answers(m: Model) -> dict:
    """name -> (c,): how much better the others say each electrode used if it answers otherwise from some time
    on, in blocks left out; a logarithm of mean squares of changes within windows."""
    _, moment, floor, _ = m.moments(every=True)
    w, c = len(moment), len(m.used)
    k, time = np.arange(c), np.arange(w) / w
    P = np.linalg.inv(moment.mean(0) + np.diag(floor))
    own = P[:, :c] / np.diag(P)[:c]  # an electrode less what the others say of it
    blocks = min(BLOCKS, w)
    first = np.searchsorted(np.arange(w) * blocks // w, np.arange(blocks))
    said = moment @ own
    now = np.add.reduceat(np.einsum("ik,wik->wk", own, said), first)
    least = np.diff(np.append(first, w))[:, None] * floor[:c]
    out = {}
    for part in _SINCE:
        late = (time >= part)[:, None] * 1.0
        # its changes from then on, less what the others say of these
        of = np.tensordot(late[:, 0], moment, 1)[:, :c] / w
        of[k, k] = 0
        others = P @ of
        others -= own * others[k, k]
        others[k, k] = 0
        rest = moment @ others
        both = late * said[:, k, k] - np.einsum("ik,wik->wk", own, rest)
        alone = late * (moment[:, k, k] - 2 * rest[:, k, k]) + np.einsum("ik,wik->wk", others, rest)
        both, alone = np.add.reduceat(both, first), np.add.reduceat(alone, first)
        factor = (both.sum(0) - both) / (alone.sum(0) - alone + 1e-12)
        then = now - 2 * factor * both + factor**2 * alone
        out[f"since {part}"] = np.clip(np.log((now + least) / (then + least)), -1, 3).mean(0)
    return out
