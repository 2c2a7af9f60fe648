"""Electrodes that change together: a connector or an amplifier may have several. Those that lie beside each
other have a touch, a bubble or a rub in common, which are no fault of electronics."""

import numpy as np

from ....geometry.design import BIOTAC, Design, electrode_positions

__all__ = ["MOST", "ahead", "beyond", "neighbours"]

MOST = 4  # electrodes that have an effect of their own, at most
_NEAR = 4  # neighbours of an electrode


def beyond(size: np.ndarray, most: int = MOST) -> np.ndarray:
    """(n,) of logarithms of sizes (n, c) the largest of the electrodes that do not change: the first after
    the widest gap between one size and the next, before which there are so many at most."""
    largest = np.sort(size, axis=1)[:, : -min(most, size.shape[1] - 1) - 2 : -1]
    gap = largest[:, :-1] - largest[:, 1:]
    return np.take_along_axis(largest, 1 + gap.argmax(1)[:, None], axis=1)[:, 0]


def neighbours(electrodes: np.ndarray, design: Design = BIOTAC) -> bool:
    """Whether electrodes (k,) of a design, numbers from 0, lie beside each other, as one patch."""
    place = electrode_positions(design)
    away = np.linalg.norm(place[:, None] - place[None], axis=2)
    rank = away.argsort(1).argsort(1)[np.ix_(electrodes, electrodes)]
    touching = (rank <= _NEAR) | (rank.T <= _NEAR)
    reached = touching[0]
    for _ in electrodes:
        reached = touching[reached].any(0)
    return bool(reached.all())


def ahead(size: np.ndarray, used: np.ndarray, k: int, design: Design = BIOTAC) -> float:
    """Logarithm of the size of electrode k over the largest one of the electrodes that do not change; size:
    logarithms (c,) of the electrodes used (c,). Two may change, more if they are no patch."""
    mine, others = float(size[used == k][0]), np.sort(size[used != k])[::-1]
    with_it = used[size > beyond(size[None])[0]]
    if k in with_it and len(with_it) > 2 and not neighbours(with_it, design):
        return mine - float(np.max(size[~np.isin(used, with_it)]))
    return mine - float(others[min(1, len(others) - 1)])
