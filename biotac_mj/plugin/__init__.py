"""The MuJoCo engine plugin that steps a BioTac's skin inside `mj_step`. Importing it registers it."""

from .engine import ATTRIBUTES, PLUGIN_NAME, register
from .errors import check, clear_errors, explained

__all__ = ["ATTRIBUTES", "PLUGIN_NAME", "check", "clear_errors", "explained", "register"]

register()
