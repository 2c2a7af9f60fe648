"""What sets electrodes apart from the others of the same recording, whatever its cause: numbers of each, most
of them logarithms, which the electrodes of a sound sensor have alike. How far one stands above the median is
compared with recordings without an effect (`rest.py`)."""

import numpy as np

from ..noise import sound_noise
from .families.noise.size import left_of_others

__all__ = ["SAID", "noises"]

_CELLS, _SHORT = 24, 60  # of noise, and rows of each at least
# what an electrode does of which a number is unusual
SAID = {
    "noisy": "is noisier than the others",
    "dull": "has less noise than the others",
    "swings": "has noise that comes and goes",
    "tails": "is far off now and then",
    "equal": "repeats values",
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
