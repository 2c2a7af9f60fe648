"""Warp without its list of devices and of the modules it loads, which would go between a program's own
lines."""

import os
import pathlib
import sys

import warp as wp

__all__ = ["announce_compilation", "calm_warp"]


def calm_warp() -> None:
    """Leaves Warp its warnings; does nothing with BIOTAC_VERBOSE=1, or after the user set a log level."""
    if wp.config.log_level == wp.LOG_INFO and os.environ.get("BIOTAC_VERBOSE", "0") in ("", "0"):
        wp.config.log_level = wp.LOG_WARNING


def announce_compilation(device: wp.DeviceLike) -> None:
    """Says so on standard error where Warp has yet to compile the skin's kernels for a kind of device."""
    cuda = wp.get_device(device).is_cuda
    cache = pathlib.Path(wp.config.kernel_cache_dir)
    if not any(cache.glob(f"wp_biotac_mj.skin.*/*.{'cu' if cuda else 'cpp'}")):
        kind = "CUDA" if cuda else "the CPU"
        print(f"biotac_mj: compiling kernels for {kind}, once on this machine: some minutes", file=sys.stderr)
