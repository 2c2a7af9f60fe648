"""What verdict.json has to be."""

import importlib.resources
import json

import jsonschema

__all__ = ["check_verdict", "schema"]


def check_verdict(verdict: dict) -> None:
    """Raises jsonschema.ValidationError where a verdict is not as the schema says."""
    jsonschema.validate(verdict, schema())


def schema() -> dict:
    """Of verdict.json."""
    path = importlib.resources.files("biotac_mj.discrepancy.report").joinpath("schema.json")
    return json.loads(path.read_text(encoding="utf-8"))
