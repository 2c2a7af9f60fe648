"""Warp without its list of devices and of the modules it loads, which would go between a program's own
lines."""

import os

import warp as wp

__all__ = ["calm_warp"]


def calm_warp() -> None:
    """Leaves Warp its warnings; does nothing with BIOTAC_VERBOSE=1, or after the user set a log level."""
    if wp.config.log_level == wp.LOG_INFO and os.environ.get("BIOTAC_VERBOSE", "0") in ("", "0"):
        wp.config.log_level = wp.LOG_WARNING
