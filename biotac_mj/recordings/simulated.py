"""Readings of a simulated BioTac as a recording."""

from collections.abc import Sequence

import numpy as np

from .recording import Recording

_NEEDED = "electrodes", "pdc", "pac", "tdc", "tac", "contact_force"


def of_simulation(time: np.ndarray, reads: Sequence[dict[str, np.ndarray]], **about: object) -> Recording:
    """Makes a Recording from readings of a simulation; `write` and `write_bag` take it as any other.

    Rows should be one frame of the sensor apart: 10 ms for a BioTac, 14 ms for a BioTac SP.

    Args:
      time: (n,) of the rows [s]. reads: n results of `Handle.read(data)`.
      about: further fields of Recording, such as object_pos, object_quat or name.

    Returns:
      the recording. Its force acts on the touching object, in the BioTac frame.

    Raises:
      ValueError: a row lacks a channel, or there are not as many times as rows.
    """
    reads = list(reads)
    for i, row in enumerate(reads):
        missing = [name for name in _NEEDED if name not in row] if isinstance(row, dict) else _NEEDED
        if missing:
            raise ValueError(f"row {i} has no {', '.join(missing)}: give what finger.read(data) answered")
    times = len(np.atleast_1d(time))
    if times != len(reads) or not reads:
        raise ValueError(f"{times} times for {len(reads)} rows: give one for each, and one at least")
    read = {name: np.array([row[name] for row in reads]) for name in _NEEDED}
    force = force_on_object(read.pop("contact_force"))
    flat = {name: value if value.shape[1] > 1 else value[:, 0] for name, value in read.items()}
    fields = {"name": "simulated", "source": "simulated", "frame": "BioTac", "force": force} | about
    return Recording(time, **flat, **fields)


def force_on_object(contact_force: np.ndarray) -> np.ndarray:
    """Force (..., 3) [N] on the touching object, from a BioTac's `contact_force` (..., 6)."""
    return -contact_force[..., :3]
