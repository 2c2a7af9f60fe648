"""What verdict.json has to be."""

import importlib.resources
import json

import jsonschema

__all__ = ["check_verdict"]


def check_verdict(verdict: dict) -> None:
    """Raises jsonschema.ValidationError where a verdict is not as the schema says."""
    schema = importlib.resources.files("biotac_mj.discrepancy.report").joinpath("schema.json")
    jsonschema.validate(verdict, json.loads(schema.read_text(encoding="utf-8")))
