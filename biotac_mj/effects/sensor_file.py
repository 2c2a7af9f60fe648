"""A sensor's YAML file: its base model and its effects, stage by stage.

`biotac diagnose` writes its result as one (sensor_amended.yaml); its simulator and everything that runs a
sensor read it (`amended.py`)."""

import dataclasses
import pathlib

from ..fields import check_choice, check_entries, refuse_unknown
from ..files import replacing
from ..geometry.skins import design_of
from ..reading import read_yaml
from ..short_repr import short_repr
from .catalogue import by_id
from .effect import STAGES

SCHEMA = "biotac_mj.sensor/1"
_KEYS = {
    "schema": str,
    "skin": str,
    "tier": str,
    "material": str | dict,
    "options": dict,
    "sensor": str | dict,
    "signal": str,
    "constitutive": str,
    "modulus_factor": float,
    "stages": dict[str, list],
}
_CHOICES = {"tier": ("condensed", "full"), "constitutive": ("reduced", "in_skin")}
_EFFECT = {"effect": str, "name": str, "parameters": dict}
_PARAMETER = {"value": float, "unit": str, "interval95": list[float]}
_SLACK = 1e-6  # of the interval, for values rounded in the file


@dataclasses.dataclass
class SensorFile:
    """Content of a sensor file.

    Attributes:
      base: settings in the file among skin, tier, material, options, sensor and signal (as for `attach`),
        constitutive ("reduced" | "in_skin") and modulus_factor, on the material's Young's modulus.
      effects: [(Effect, theta)]. intervals: {effect id: {parameter: (low, high)}}, 95 %.
    """

    base: dict
    effects: list
    intervals: dict


def read_sensor_file(path: pathlib.Path | str) -> SensorFile:
    """Reads a YAML file.

    Raises:
      FileNotFoundError, ValueError: no file, no YAML, another schema, unknown effect or parameter.
    """
    remedy = "`biotac diagnose` writes one, sensor_amended.yaml"
    document = read_yaml(path, "sensor file", f"{remedy}; or leave it out")
    if document.get("schema") != SCHEMA:
        raise ValueError(
            f"{path} has schema {short_repr(document.get('schema'))}, {SCHEMA!r} is needed: "
            "let this version's `biotac diagnose` write it again"
        )
    refuse_unknown(document, _KEYS, str(path))
    check_entries(str(path), document, _KEYS, _KEYS)
    for name, known in _CHOICES.items():  # also if the reader has a choice of its own
        check_choice(f"{name} of {path} is", document.get(name, known[0]), known)
    effects, intervals = [], {}
    design = design_of(document.get("skin") or "default")
    for stage, items in document.get("stages", {}).items():
        for item in items:
            effect, theta, sure = _effect(f"{path}, stage {stage!r}", stage, item, design)
            effects.append((effect, theta))
            if sure:
                intervals[effect.id] = sure
    base = {name: value for name, value in document.items() if name not in ("schema", "stages")}
    return SensorFile(base, effects, intervals)


def write_sensor_file(path: pathlib.Path | str, file: SensorFile) -> None:
    """Writes a YAML file; `base` must have plain values."""
    import yaml

    stages = {stage: [] for stage in STAGES.values()}
    for effect, theta in file.effects:
        sure, parameters = file.intervals.get(effect.id, {}), {}
        for name, value in theta.items():
            parameters[name] = {"value": float(value), "unit": effect.params[name].unit}
            if name in sure:
                parameters[name]["interval95"] = [float(v) for v in sure[name]]
        entry = {"effect": effect.id, "name": effect.name, "parameters": parameters}
        stages[STAGES[effect.stage]].append(entry)
    document = {"schema": SCHEMA, **file.base, "stages": {k: v for k, v in stages.items() if v}}
    with replacing(path) as temporary:
        temporary.write_text(yaml.safe_dump(document, sort_keys=False))


def _effect(where, stage, item, design):
    """Effect, values of its parameters, and their intervals if given."""
    check_entries(f"an effect of {where}", item, _EFFECT, ("name",))
    refuse_unknown(item, _EFFECT, f"an effect of {where}")
    effect = by_id(item["effect"]).on(design).given(list(item["parameters"]))
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
