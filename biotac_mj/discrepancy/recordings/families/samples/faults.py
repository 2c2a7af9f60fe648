"""Faults of samples as findings."""

from collections.abc import Callable, Iterable

import numpy as np

from ....evidence import sign_flip
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS

__all__ = ["by_block", "fault", "runs_of"]


def fault(
    session: Session,
    name: str,
    channels: Iterable[int],
    parameters: dict,
    mask: np.ndarray | None,
    note: str,
    strength: np.ndarray,
    blocks: int,
    correct: Callable | None = None,
) -> Finding:
    """A fault of samples, mask (n, 19), as a finding.

    Args:
      strength: (blocks,) how many times more often than chance allows, in nats, block by block.
    """
    at = np.flatnonzero(mask.any(1)) if mask is not None else np.array([0, len(session.recording) - 1])
    rate = session.recording.rate
    return Finding(
        name,
        tuple(int(k) for k in channels),
        parameters,
        float(np.sum(strength)),
        sign_flip(np.asarray(strength, float)),
        at[0] / rate,
        at[-1] / rate,
        note,
        clues={
            "nats": float(np.log1p(np.sum(strength))),
            "blocks": float(np.mean(np.asarray(strength) > 0)),
        },
        mask=mask,
        correct=correct,
    )


def by_block(flags: np.ndarray, chance: float) -> np.ndarray:
    """(blocks,) nats by which flags (n,) are more frequent than chance, in each block, of a row at least."""
    blocks = min(BLOCKS, len(flags))
    share = np.array([b.mean() for b in np.array_split(flags.astype(float), blocks)])
    size = len(flags) / blocks
    share, chance = np.clip(share, 1e-9, 1), np.clip(chance, 1e-9, 1)
    return np.sign(share - chance) * size * np.abs(share * np.log(share / chance) - share + chance)


def runs_of(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Starts and lengths of runs of equal values."""
    edge = np.concatenate([[0], np.flatnonzero(np.diff(x) != 0) + 1, [len(x)]])
    return edge[:-1], np.diff(edge)
