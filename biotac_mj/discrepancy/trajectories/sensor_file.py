"""A sensor's YAML read back as a simulator."""

import pathlib
from collections.abc import Sequence

from ...effects.catalogue import by_id
from ...effects.effect import STAGES
from .in_skin import InSkinSimulator
from .simulator import SCHEMA, Simulator

__all__ = ["load_simulator"]


def load_simulator(path: pathlib.Path | str, extra: Sequence = ()) -> Simulator:
    """A Simulator from YAML; `extra` are your own effects.

    Raises:
      FileNotFoundError, ValueError: no file, no YAML, another schema, unknown effect or parameter.
    """
    import yaml

    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"no sensor file {path}: write one with Simulator().save(path), or leave --sensor out"
        )
    try:
        document = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise ValueError(
            f"{path} is no YAML ({str(error).splitlines()[0]}): write one with Simulator().save(path)"
        ) from None
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        found = document.get("schema") if isinstance(document, dict) else None
        raise ValueError(
            f"{path} has schema {found!r}, {SCHEMA!r} is needed: "
            "write it with this version's Simulator().save(path)"
        )
    effects, intervals = [], {}
    for stage, items in (document.get("stages") or {}).items():
        for item in items:
            effect = by_id(item["effect"], extra)
            theta = effect.default()
            for name, entry in item["parameters"].items():
                if name not in effect.params:
                    raise ValueError(
                        f"{path}: effect {effect.id!r} has no parameter {name!r}; "
                        f"it has {', '.join(effect.params)}"
                    )
                theta[name] = float(entry["value"])
                if "interval95" in entry:
                    intervals.setdefault(effect.id, {})[name] = tuple(entry["interval95"])
            if STAGES[effect.stage] != stage:
                raise ValueError(
                    f"{path}: effect {effect.id!r} acts at the stage {STAGES[effect.stage]!r}, not {stage!r}"
                )
            effects.append((effect, theta))
    keys = {k: document[k] for k in ("skin", "tier", "material", "sensor", "options") if k in document}
    kinds = {"reduced": Simulator, "in_skin": InSkinSimulator}
    kind = document.get("constitutive", "reduced")
    if kind not in kinds:
        raise ValueError(f"{path}: constitutive {kind!r} is none of {', '.join(kinds)}")
    return kinds[kind](
        **keys, effects=effects, modulus=float(document.get("modulus_factor", 1.0)), intervals=intervals
    )
