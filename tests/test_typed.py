"""Public functions and methods of the packages listed say what they take and give."""

import importlib
import inspect

import pytest
from imports import modules

# those that are done
TYPED = (
    "coupling",
    "batch",
    "press",
    "view",
    "effects",
    "geometry",
    "calibration",
    "differentiable",
    "tasks",
    "learning",
    "data",
    "recordings",
    "sensor",
    "discrepancy",
    "skin",
    "matching",
    "resimulation",
    "samples",
    "neighbours",
    "cli",
)


def _public_modules():
    return [name for name in modules() if name.split(".")[1:2] and name.split(".")[1] in TYPED]


@pytest.mark.parametrize("name", _public_modules())
def test_public_names_are_typed(name):
    module = importlib.import_module(name)
    untyped = []
    for public, thing in list(vars(module).items()):
        if public.startswith("_") or getattr(thing, "__module__", None) != name:  # told where it is made
            continue
        if inspect.isclass(thing):
            untyped += _untyped_methods(thing)
        elif inspect.isfunction(thing):
            untyped += _untyped(public, thing)
    assert not untyped, f"{name}: {', '.join(untyped)}"


def _untyped_methods(kind):
    out = []
    for name, member in vars(kind).items():
        made = getattr(member, "__func__", None) or getattr(member, "fget", None) or member
        made = getattr(made, "func", made)  # of a cached property
        own = (
            inspect.isfunction(made)
            and made.__module__ == kind.__module__
            and made.__qualname__.startswith(kind.__name__)
        )
        if own and (name == "__init__" or not name.startswith("_")):
            out += _untyped(f"{kind.__name__}.{name}", made)
    return out


def _untyped(name, function):
    signature = inspect.signature(function)
    parameters = list(signature.parameters.values())
    first = parameters[:1] if "." in name and parameters and parameters[0].name in ("self", "cls") else []
    missing = [p.name for p in parameters if p not in first and p.annotation is inspect.Parameter.empty]
    if signature.return_annotation is inspect.Signature.empty and not name.endswith("__init__"):
        missing.append("return")
    return [f"{name}({', '.join(missing)})"] if missing else []
