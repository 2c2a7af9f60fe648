"""Where the electrodes are published to be."""

import numpy as np

__all__ = ["electrode_positions", "in_biotac_frame"]

# Lin et al. 2013, in their frame (x to the fingertip, z out of the nail) [mm]; E11..E16 mirror E1..E6
_ELECTRODES_MM = {
    1: (0.993, -4.855, -1.116),
    2: (-2.7, -3.513, -3.67),
    3: (-6.2, -3.513, -3.67),
    4: (-8, -4.956, -1.116),
    5: (-10.5, -3.513, -3.67),
    6: (-13.4, -4.956, -1.116),
    7: (4.763, 0, -2.33),
    8: (3.031, -1.95, -3.33),
    9: (3.031, 1.95, -3.33),
    10: (1.299, 0, -4.33),
    17: (-2.8, 0, -5.08),
    18: (-9.8, 0, -5.08),
    19: (-13.6, 0, -5.08),
}
_ORIGIN_X = -12.30  # [mm] of Lin's frame in the BioTac frame


def electrode_positions() -> np.ndarray:
    """(19, 3) [mm], in the frame of Lin et al."""
    table = {**_ELECTRODES_MM, **{k + 10: (x, -y, z) for k, (x, y, z) in _ELECTRODES_MM.items() if k <= 6}}
    return np.array([table[k] for k in range(1, 20)])


def in_biotac_frame(position: np.ndarray) -> np.ndarray:
    """Positions (n, 3) [mm] in Lin's frame turned into the BioTac frame: x' = -x - 12.30, y' = z, z' = y."""
    x, y, z = position.T
    return np.stack([_ORIGIN_X - x, z, y], axis=-1)
