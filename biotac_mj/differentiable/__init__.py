"""Gradients through rubber, liquid and film (extra `learning`, which has PyTorch)."""

from .estimation.belief import Belief, Touch
from .estimation.estimate import Estimate, Estimator, change_of, pressure_change
from .fit import Forces
from .loop.rollout import Rolled, rollout
from .press import PARAMETERS, Pressed, press, relative_pose
from .readings.counts import electrode_counts, pdc_counts, tac_counts, tdc_counts
from .readings.film import impedance
from .readings.heat import temperatures
from .record import Changes
from .skin import Skin
from .with_jax import for_jax

__all__ = [
    "PARAMETERS",
    "Belief",
    "Changes",
    "Estimate",
    "Estimator",
    "Forces",
    "Pressed",
    "Rolled",
    "Skin",
    "Touch",
    "change_of",
    "electrode_counts",
    "for_jax",
    "impedance",
    "pdc_counts",
    "press",
    "pressure_change",
    "relative_pose",
    "rollout",
    "tac_counts",
    "tdc_counts",
    "temperatures",
]
