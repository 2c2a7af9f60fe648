"""What can be seen of something hidden at all, by an observer who has the same signal without it."""

import numpy as np

__all__ = ["SEEN", "seen_nats"]

SEEN = (
    20.0  # nats from which an effect counts as detectable: some hundred names, channels and times are tried
)
_BANDS = 1.5  # factor from one edge of a band of frequencies to the next
_RIDGE = 1e-4  # of a regressor's variance


def seen_nats(counts: np.ndarray, clean: np.ndarray, force: np.ndarray | None = None) -> float | None:
    """How unlikely what electrodes do not say of each other is once something is hidden.

    Each electrode less what all others, and the force, say of it by least squares, the force less what the
    electrodes say, and the mean of all by itself, with and without what is hidden. Both are taken for
    Gaussian with a spectrum in bands; their Kullback-Leibler divergence counts, of the channel in which it
    is largest. How electrodes go together and how loud each is, is known of the signal without it; a name,
    a channel and a time are not asked for, so this is the most that any method could use.

    Args:
      counts, clean: (n, 19), with and without what is hidden; force: (n, 3) or None.

    Returns:
      nats; None where rows are missing.
    """
    if len(counts) != len(clean):
        return None
    hidden, sound = _left(counts, force), _left(clean, force)
    frequencies = len(hidden)
    edges = np.geomspace(4, frequencies, int(np.log(frequencies) / np.log(_BANDS))).astype(int)
    edges = np.unique([1, *edges, frequencies])
    nats = 0.0
    for a, b in zip(edges[:-1], edges[1:]):
        ratio = sound[a:b].mean(0) / hidden[a:b].mean(0)
        nats = nats + (b - a) * (ratio - 1 - np.log(ratio))
    return float(np.max(nats))


def _left(counts, force):
    """(frequencies, channels) power of what is left of each channel, over rounding."""
    inside = np.clip(np.abs(counts), 1, 4094)
    z = -np.log(inside / (4095 - inside))
    channels = z if force is None else np.hstack([z, force])
    channels = channels - channels.mean(0)
    size = np.r_[1 / (inside * (1 - inside / 4095)).mean(0), np.full(channels.shape[1] - 19, 0.01)]
    channels = channels / size  # counts, and hundredths of a newton
    G = channels.T @ channels
    P = np.linalg.inv(G + np.diag(_RIDGE * np.diag(G) + len(G)))
    alone = channels @ P / np.diag(P)
    alone = np.column_stack([alone, channels[:, :19].mean(1)])
    return np.abs(np.fft.rfft(alone, axis=0)) ** 2 + len(alone) / 12
