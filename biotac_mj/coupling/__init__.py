"""Poses in, wrenches out: a BioTac's skin inside MuJoCo's step."""

from .attach import Handle, attach
from .config import Config
from .stepper import Geom, Readings, SkinResult, SkinStepper, register_readings, register_stepper

__all__ = [
    "Config",
    "Geom",
    "Handle",
    "Readings",
    "SkinResult",
    "SkinStepper",
    "attach",
    "register_readings",
    "register_stepper",
]
