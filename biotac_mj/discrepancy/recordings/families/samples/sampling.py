"""Faults of samples: coarse, held, stuck, clipped and spiked ones. What is no measurement is masked."""

from collections.abc import Callable

from ...findings import Finding
from ...session import Session
from .coarse import quantised
from .held import held_rows
from .spiked import off_rows, spiked
from .still import standing_still

__all__ = ["sampling_faults"]


def sampling_faults(session: Session, take: Callable[[Finding], bool]) -> None:
    """Offers all of them to `take`, in the order in which they have to be taken out; each is searched
    without the samples of those before it."""
    for find in (off_rows, quantised, held_rows, standing_still, spiked):
        for finding in find(session):
            take(finding)
