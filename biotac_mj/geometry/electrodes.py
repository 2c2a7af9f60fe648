"""Where the electrodes are published to be."""

import numpy as np

__all__ = ["electrode_positions"]

_ELECTRODES_MM = {  # Lin et al. 2013, in the sensor's frame [mm]; E11..E16 mirror E1..E6
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


def electrode_positions() -> np.ndarray:
    """(19, 3) [mm]."""
    table = {**_ELECTRODES_MM, **{k + 10: (x, -y, z) for k, (x, y, z) in _ELECTRODES_MM.items() if k <= 6}}
    return np.array([table[k] for k in range(1, 20)])
