"""The paper's four configurations, the fit of their parameters to force-deflection data, and their comparison
with a reference."""

from .comparison import Comparison, comparison_table, evaluate, plan_indentations
from .configurations import CONFIGURATIONS, Configuration, configuration
from .fit import Calibration, FitParameter, calibrate, parameter
from .forward import Response, simulate
from .indentation import Indentation, plan_indentation, plan_shear, read_indentation, write_indentation
from .reference import stand_in
from .refinement import refined

__all__ = [
    "CONFIGURATIONS",
    "Calibration",
    "Comparison",
    "Configuration",
    "FitParameter",
    "Indentation",
    "Response",
    "calibrate",
    "comparison_table",
    "configuration",
    "evaluate",
    "parameter",
    "plan_indentation",
    "plan_indentations",
    "plan_shear",
    "read_indentation",
    "refined",
    "simulate",
    "stand_in",
    "write_indentation",
]
