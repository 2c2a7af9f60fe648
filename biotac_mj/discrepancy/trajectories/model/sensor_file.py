"""A sensor's YAML read back as a simulator."""

import pathlib

from ....effects.sensor_file import read_sensor_file
from .in_skin import InSkinSimulator
from .simulator import Simulator

_KINDS = {"reduced": Simulator, "in_skin": InSkinSimulator}


def load_simulator(path: pathlib.Path | str) -> Simulator:
    """A Simulator from YAML.

    Raises:
      FileNotFoundError, ValueError: see `effects.sensor_file.read_sensor_file`; a model that cannot be.
    """
    file = read_sensor_file(path)
    kind = file.base.get("constitutive", "reduced")
    if kind not in _KINDS:
        raise ValueError(f"{path}: constitutive {kind!r} is none of {', '.join(_KINDS)}")
    known = ("skin", "tier", "material", "sensor", "options")
    given = {name: file.base[name] for name in known if name in file.base}
    modulus = float(file.base.get("modulus_factor", 1.0))
    try:
        return _KINDS[kind](**given, effects=file.effects, modulus=modulus, intervals=file.intervals)
    except (ValueError, FileNotFoundError) as error:
        raise ValueError(f"{path}: {error}") from error
