"""Published positions of the electrodes."""

import numpy as np

from .design import BIOTAC, Design


def electrode_positions(design: Design = BIOTAC) -> np.ndarray:
    """(nelectrode, 3) [mm], in the design's published frame: that of Lin et al. 2013 for the BioTac."""
    return np.array(design.electrodes_mm)
