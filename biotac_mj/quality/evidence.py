"""Evidence that an event is more frequent than by chance, block by block."""

import functools

import numpy as np
from scipy.special import kl_div, stdtr

BLOCKS = 16  # of a log; each counts as independent evidence
NAN = float("nan")
_DRAWS = 4000  # of signs

# scipy.stats.permutation_test draws new signs in each call and takes 40 to 350 times as long as `sign_flip`,
# which the diagnosis of one log calls 267 times in 12 s


def evidence(strength: np.ndarray) -> dict:
    """Fields `nats`, `p` and `features` of a Fault from its evidence strength (blocks,) [nats]."""
    strength = np.asarray(strength, float)
    nats = float(strength.sum())
    features = {"nats": float(np.log1p(nats)), "blocks": float(np.mean(strength > 0))}
    return {"nats": nats, "p": sign_flip(strength), "features": features}


def sign_flip(gain: np.ndarray) -> float:
    """p of mean(gain) > 0 under random signs. gain: (n,), one per block or trajectory. Exact for n <= 12."""
    gain = np.asarray(gain, float)
    n = len(gain)
    return float(np.mean(signs(n) @ gain >= gain.sum() - 1e-12 * np.abs(gain).sum()))


def signed_root_t(gain: np.ndarray) -> float:
    """p of mean(gain) > 0 by Student's t of the signed square roots; gain (n,), n at least 2, of log
    likelihoods.

    A gain is the square of what an effect does over its noise, so its root scatters by about one whatever its
    size, and one unit that gains much does not decide. Among six units a single small loss leaves a sign flip
    at 2/64 however much the others gain; here it counts as what it is."""
    root = np.sign(gain) * np.sqrt(np.abs(gain))
    error = max(float(root.std(ddof=1)) / np.sqrt(len(root)), 1e-9)
    return float(stdtr(len(root) - 1, -root.mean() / error))


@functools.lru_cache(maxsize=8)
def signs(n: int) -> np.ndarray:
    """(draws, n) of -1 and 1; all combinations for n <= 12."""
    if n <= 12:
        return 1.0 - 2 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1)
    sign = np.random.default_rng(0).choice([-1.0, 1.0], (_DRAWS, n))
    sign[0] = 1  # the data themselves, so that p > 0
    return sign


def by_block(flags: np.ndarray, chance: float) -> np.ndarray:
    """(blocks,) log-likelihood ratio [nats] of the rate of flags (n,) in each block against chance; blocks
    without a flag count one."""
    blocks = min(BLOCKS, len(flags))
    fraction = np.array([b.mean() for b in np.array_split(flags.astype(float), blocks)])
    return np.sign(fraction - chance) * len(flags) / blocks * kl_div(fraction, chance)


def runs(flags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First rows and lengths of the runs of set flags (n,)."""
    edge = np.flatnonzero(np.diff(np.pad(np.asarray(flags, np.int8), 1)))
    return edge[::2], edge[1::2] - edge[::2]


def stretch(flags: np.ndarray) -> np.ndarray:
    """Flags (n,) set from the first to the last set one, at least one row per block."""
    on = np.flatnonzero(flags)
    first = max(min(on[0], len(flags) - BLOCKS), 0)
    return flags[first : max(on[-1] + 1, first + BLOCKS)]
