"""What is left once everything named is taken out: whether each electrode does what the others, and its own earlier
blocks, say it should."""

import dataclasses

import numpy as np

from .session import Session

__all__ = ["Rest", "rest"]


@dataclasses.dataclass
class Rest:
    """significant; text; cells: dicts (channel, from, to, counts, ratio) of what departs, the largest first;
    clues: numbers that the decision is made of."""

    significant: bool
    text: str
    cells: list
    clues: dict


def rest(session: Session) -> Rest:
    """Compares each electrode's residual with what its load leaves in electrodes of the same recording."""
    m = session.model()
    residual = m.alone()
    if not m.dimensions:
        common = m.shared(np.ones(len(m.used)))
        residual = residual - common[:, None]
    cells, time = m.levels(residual, every=True)
    inside = time < m.time[m.inside][-1]
    change = m.activity + 2 * m.noise
    cell = np.abs(cells) * m.slope
    fast = np.sqrt((residual[m.inside] ** 2).mean(0)) / change
    level = np.sqrt((cells[inside] ** 2).mean(0)) / change
    aside = np.sqrt((cells[~inside] ** 2).mean(0)) / change
    order = np.argsort(-np.maximum(level, aside))
    clues = {
        "fast1": float(np.log(np.sort(fast)[-1])), "fast3": float(np.log(np.sort(fast)[-3])),
        "level1": float(np.log(np.sort(level)[-1])), "level3": float(np.log(np.sort(level)[-3])),
        "aside1": float(np.log(np.sort(aside)[-1])), "aside3": float(np.log(np.sort(aside)[-3])),
        "fast": float(np.log(np.median(fast))), "level": float(np.log(np.median(level))), "aside": float(np.log(np.median(aside))),
        "counts1": float(np.log(np.sort(level * change * m.slope)[-1])), "counts3": float(np.log(np.sort(level * change * m.slope)[-3])),
    }  # fmt: skip
    listed = []
    for i in order[:3]:
        w = int(cell[:, i].argmax())
        listed.append({"channel": f"e{m.used[i] + 1}", "from": float(time[max(w - 1, 0)]), "to": float(time[min(w + 1, len(time) - 1)]),
                       "counts": float(cell[w, i]), "ratio": float(level[i])})  # fmt: skip
    return Rest(False, "", listed, clues)
