"""What is left once everything named is taken out: whether each electrode does what the others, and its own
earlier blocks, say it should."""

import dataclasses

import numpy as np

from .confidence import probability
from .findings import Finding
from .recording import MIN_ROWS
from .session import Session

__all__ = ["Rest", "rest"]

_UNKNOWN = 0.33


@dataclasses.dataclass
class Rest:
    """significant; text; cells: dicts (channel, from, to, counts) of what departs, the largest first; clues:
    numbers that the decision is made of; confidence that something without a name is there."""

    significant: bool
    text: str
    cells: list
    clues: dict
    confidence: float


def rest(session: Session, weak: list[Finding]) -> Rest:
    """Compares what every electrode does with what the others say of it, in the rows fitted and in those
    kept aside, in units of what the load does to it."""
    m = session.model()
    residual = m.alone()
    cells, time = m.levels(residual, every=True)
    inside = time < m.time[m.inside][-1]
    change = m.activity + 2 * m.noise
    counts = np.abs(cells) * m.slope

    def size(x):
        return np.sqrt((x**2).mean(0)) / change

    parts = {"fast": size(residual[m.inside]), "level": size(cells[inside]), "aside": size(cells[~inside])}
    parts["counts"] = parts["level"] * change * m.slope
    clues = {}
    for name, value in parts.items():
        ordered = np.sort(value)
        clues |= {f"{name}{n}": float(np.log(ordered[-n])) for n in (1, 3)}
        clues[name] = float(np.log(np.median(value)))
    # what was seen and could not be named
    seen = [f.clues for f in weak if len(f.channels) == 1 and "nats" in f.clues and f.p < 0.02]
    clues["seen"] = max((c["nats"] for c in seen), default=0.0)
    clues["number"] = float(np.log1p(len(seen)))
    clues["stands"] = max((c.get("stands", 0.0) for c in seen), default=0.0)
    clues["seconds"] = float(np.log(m.time[m.inside][-1]))
    family = "left_loaded" if session.loaded else "left_unloaded"
    confidence = probability(family, clues)
    if len(session.recording) * session.fresh < MIN_ROWS:  # as few as a recording that is refused
        confidence = 0.0
    listed = []
    for i in np.argsort(-np.maximum(parts["level"], parts["aside"]))[:3]:
        w = int(counts[:, i].argmax())
        first, last = time[max(w - 1, 0)], time[min(w + 1, len(time) - 1)]
        listed.append(
            {
                "channel": f"e{m.used[i] + 1}",
                "from": float(first),
                "to": float(last),
                "counts": float(counts[w, i]),
            }
        )
    text = "what each electrode does, the others and its own earlier blocks explain"
    if confidence > _UNKNOWN:
        text = "; ".join(
            f"{c['channel']} departs from what the others say by up to {c['counts']:.0f} counts, most from "
            f"{c['from']:.0f} s to {c['to']:.0f} s"
            for c in listed
        )
    return Rest(confidence > _UNKNOWN, text, listed, clues, confidence)
