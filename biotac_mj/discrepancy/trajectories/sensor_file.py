"""A sensor's YAML read back as a simulator."""

import pathlib
import reprlib
from collections.abc import Sequence

from ...effects.catalogue import by_id
from ...effects.effect import STAGES
from ...fields import check_entries, refuse_unknown
from ...reading import read_yaml
from .in_skin import InSkinSimulator
from .simulator import SCHEMA, Simulator

__all__ = ["load_simulator"]

_KINDS = {"reduced": Simulator, "in_skin": InSkinSimulator}
_KEYS = {
    "schema": str,
    "skin": str,
    "tier": str,
    "material": str | dict,
    "options": dict,
    "sensor": str,
    "constitutive": str,
    "modulus_factor": float,
    "stages": dict[str, list],
}
_EFFECT = {"effect": str, "name": str, "parameters": dict}
_PARAMETER = {"value": float, "unit": str, "interval95": list[float]}
_SLACK = 1e-6  # of the interval, for values rounded in the file


def load_simulator(path: pathlib.Path | str, extra: Sequence = ()) -> Simulator:
    """A Simulator from YAML; `extra` are your own effects.

    Raises:
      FileNotFoundError, ValueError: no file, no YAML, another schema, unknown effect or parameter.
    """
    remedy = "write one with Simulator().save(path)"
    document = read_yaml(path, "sensor file", f"{remedy}, or leave --sensor out")
    if document.get("schema") != SCHEMA:
        raise ValueError(
            f"{path} has schema {reprlib.repr(document.get('schema'))}, {SCHEMA!r} is needed: "
            "write it with this version's Simulator().save(path)"
        )
    refuse_unknown(document, _KEYS, str(path))
    check_entries(str(path), document, _KEYS, _KEYS)
    effects, intervals = [], {}
    for stage, items in document.get("stages", {}).items():
        for item in items:
            effect, theta, sure = _effect(f"{path}, stage {stage!r}", stage, item, extra)
            effects.append((effect, theta))
            if sure:
                intervals[effect.id] = sure
    kind = document.get("constitutive", "reduced")
    if kind not in _KINDS:
        raise ValueError(f"{path}: constitutive {kind!r} is none of {', '.join(_KINDS)}")
    given = {k: document[k] for k in ("skin", "tier", "material", "sensor", "options") if k in document}
    modulus = float(document.get("modulus_factor", 1.0))
    try:
        return _KINDS[kind](**given, effects=effects, modulus=modulus, intervals=intervals)
    except (ValueError, FileNotFoundError) as error:
        raise ValueError(f"{path}: {error}") from error


def _effect(where, stage, item, extra):
    """Effect, values of its parameters, and the intervals of those that have one."""
    check_entries(f"an effect of {where}", item, _EFFECT, ("name",))
    refuse_unknown(item, _EFFECT, f"an effect of {where}")
    effect = by_id(item["effect"], extra)
    where = f"{effect.id!r} of {where}"
    if STAGES[effect.stage] != stage:
        raise ValueError(f"effect {where} acts at the stage {STAGES[effect.stage]!r}")
    refuse_unknown(item["parameters"], effect.params, f"effect {where}")
    theta, sure = effect.default(), {}
    for name, entry in item["parameters"].items():
        check_entries(f"{name} of {where}", entry, _PARAMETER, ("unit", "interval95"))
        refuse_unknown(entry, _PARAMETER, f"{name} of {where}")
        low, high = effect.params[name].low, effect.params[name].high
        theta[name] = float(entry["value"])
        if not low - _SLACK * (high - low) <= theta[name] <= high + _SLACK * (high - low):
            raise ValueError(f"{name} of {where} is {theta[name]:g}: give a value from {low:g} to {high:g}")
        if "interval95" in entry:
            if len(entry["interval95"]) != 2:
                raise ValueError(f"interval95 of {name} of {where} must have two numbers")
            sure[name] = tuple(map(float, entry["interval95"]))
    return effect, theta, sure
