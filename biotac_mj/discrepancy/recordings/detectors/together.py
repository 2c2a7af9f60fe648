"""Electrodes that change together: a connector or an amplifier may have several. Those that lie beside each
other have a touch, a bubble or a rub in common, which are no fault of electronics."""

import numpy as np

from ....geometry.design import BIOTAC, Design, electrode_positions

_MOST = 4  # electrodes that have an effect of their own, at most
_NEAR = 4  # neighbours of an electrode


def _neighbours(electrodes: np.ndarray, design: Design) -> bool:
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
    mine = float(size[used == k][0])
    largest = np.sort(size)[::-1][: min(_MOST, len(size) - 1) + 1]
    still = largest[1 + (largest[:-1] - largest[1:]).argmax()]  # after the widest gap
    with_it = used[size > still]
    if k in with_it and len(with_it) > 2 and not _neighbours(with_it, design):
        return mine - float(np.max(size[~np.isin(used, with_it)]))
    others = np.sort(size[used != k])[::-1]
    return mine - float(others[min(1, len(others) - 1)])
