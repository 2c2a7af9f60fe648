"""Poses in, wrenches out: a BioTac's skin inside MuJoCo's step."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from .attachment import attach as attach
    from .config import Config as Config
    from .handle import Handle as Handle
    from .handle import handles as handles
    from .settings import ContactSettings as ContactSettings
    from .settings import SensorSettings as SensorSettings
    from .settings import SettingKeywords as SettingKeywords
    from .settings import Settings as Settings
    from .settings import SkinSettings as SkinSettings
    from .stepper import Geom as Geom
    from .stepper import Readings as Readings
    from .stepper import SkinResult as SkinResult
    from .stepper import SkinStepper as SkinStepper
    from .stepper import register_readings as register_readings
    from .stepper import register_stepper as register_stepper

__getattr__, __dir__ = lazy(__name__)
