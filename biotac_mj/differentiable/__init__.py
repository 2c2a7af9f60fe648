"""Gradients through rubber, liquid and film (extra `learning`, which has PyTorch)."""

from .counts import electrode_counts, pdc_counts, tac_counts, tdc_counts
from .estimation.belief import Belief, Touch
from .estimation.estimate import Estimate, Estimator, change_of, pressure_change
from .film import impedance
from .fit import calibrate
from .heat import temperatures
from .press import PARAMETERS, Pressed, press, relative_pose
from .skin import Skin

__all__ = [
    "PARAMETERS",
    "Belief",
    "Estimate",
    "Estimator",
    "Pressed",
    "Skin",
    "Touch",
    "calibrate",
    "change_of",
    "electrode_counts",
    "impedance",
    "pdc_counts",
    "press",
    "pressure_change",
    "relative_pose",
    "tac_counts",
    "tdc_counts",
    "temperatures",
]
