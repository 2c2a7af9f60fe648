"""Gradients through rubber, liquid and film (extra `learning`, which has PyTorch)."""

from .counts import electrode_counts, pdc_counts
from .estimate import Estimate, Estimator
from .film import impedance
from .fit import calibrate
from .press import PARAMETERS, Pressed, press, relative_pose
from .skin import Skin

__all__ = [
    "PARAMETERS",
    "Estimate",
    "Estimator",
    "Pressed",
    "Skin",
    "calibrate",
    "electrode_counts",
    "impedance",
    "pdc_counts",
    "press",
    "relative_pose",
]
