"""Numbers of a report as JSON has them."""

import math
from typing import Any

import numpy as np

__all__ = ["plain_values"]


def plain_values(x: Any) -> Any:
    if isinstance(x, dict):
        return {str(k): plain_values(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [plain_values(v) for v in x]
    if isinstance(x, np.ndarray):
        return plain_values(x.tolist())
    if isinstance(x, (bool, np.bool_)):
        return bool(x)
    if isinstance(x, (int, np.integer)):
        return int(x)
    if isinstance(x, (float, np.floating)):
        return float(x) if math.isfinite(x) else None
    return x
