"""Writes docs/api.md, the public functions and classes with their docstrings, as Markdown that reads
anywhere.

    python scripts/api.py

`tests/test_site.py` says when a docstring has changed since.
"""

import importlib
import inspect
import pathlib
import re

__all__ = ["SECTIONS", "api"]

PAGE = pathlib.Path(__file__).parents[1] / "docs" / "api.md"
SECTIONS = {
    "The sensor in a model": """attach attach_to_hand Handle handles coupling.Settings coupling.SkinSettings
        coupling.ContactSettings coupling.SensorSettings coupling.SettingKeywords coupling.Config
        tasks.Mount""",
    "One press": """press.press press.PressResult press.PressOptions press.PressRecord press.write_readings
        press.write_skin press.report""",
    "Skin and geometry": """load_skin import_mesh SkinGeometry SkinModel SkinData step skin.SkinOptions
        skin.Material skin.ContactLaw skin.GeomSet""",
    "Film and electronics": """sensor.PhysicsReadings sensor.FilmConduction sensor.Sensor
        sensor.WeightedElectrodes""",
    "Batches": "batch",
    "JAX": "mjx",
    "Tasks": "tasks.load tasks.tasks tasks.register tasks.BioTac tasks.Copyable tasks.make_controller",
    "Data sets and recordings": """data.generate data.GenerateOptions data.GenerateReport data.TactileSet
        data.Interaction data.split_by_interaction data.split_by_object recordings.load recordings.load_one
        recordings.Loaded recordings.read recordings.write recordings.of_simulation recordings.write_bag
        recordings.Recording resimulation.resimulate.resimulate resimulation.ResimulateOptions""",
    "ROS, live": "neighbours.ros",
    "Effects and diagnosis": """effects.Effect discrepancy.diagnose discrepancy.diagnose_recording
        discrepancy.Verdict discrepancy.Finding discrepancy.read_recording discrepancy.PlainRecording
        discrepancy.Simulator discrepancy.trajectories.model.solver.Solver discrepancy.Trajectory""",
    "Gradients": """differentiable.Skin differentiable.press differentiable.Pressed differentiable.Changes
        differentiable.rollout differentiable.Rolled differentiable.impedance differentiable.electrode_counts
        differentiable.pdc_counts differentiable.temperatures differentiable.tdc_counts
        differentiable.tac_counts differentiable.for_jax differentiable.Forces""",
    "Calibration": "calibration.calibrate calibration.evaluate",
    "Pictures": "view.view view.build_scene view.Offscreen view.find_gl",
}
_INTRO = """# API

What is public, with the text of its docstrings: shapes, units, errors. Most models need only the first
section.
`python scripts/api.py` writes this page.
"""


def api() -> str:
    """The page."""
    out = [_INTRO]
    for title, names in SECTIONS.items():
        out.append(f"## {title}\n")
        for name in names.split():
            out += _entry(f"biotac_mj.{name}", _find(name))
    return "\n".join(out).rstrip() + "\n"


def _find(name):
    found = importlib.import_module("biotac_mj")
    for part in name.split("."):
        try:
            found = getattr(found, part)
        except AttributeError:
            found = importlib.import_module(f"{found.__name__}.{part}")
    return found


def _entry(name, found):
    if inspect.ismodule(found):
        names = [one for one in getattr(found, "__all__", dir(found)) if not one.startswith("_")]
        inner = [(f"{name}.{one}", getattr(found, one)) for one in names]
        doc = [_text(found)] if found.__doc__ else []
        return doc + [line for one in inner if callable(one[1]) for line in _entry(*one)]
    out = [f"### `{name}`\n", _signature(name.rpartition(".")[2], found), _text(found)]
    if inspect.isclass(found):
        for member, value in vars(found).items():
            documented = inspect.getdoc(value) if callable(value) or isinstance(value, property) else None
            function = value.__func__ if isinstance(value, (classmethod, staticmethod)) else value
            if not member.startswith("_") and inspect.isfunction(function) and inspect.getdoc(function):
                out += [_signature(f"{found.__name__}.{member}", function), _text(function)]
            elif not member.startswith("_") and isinstance(value, property) and documented:
                out.append(f"`{found.__name__}.{member}`\n\n{_text(value)}")
    return out


def _signature(name, found):
    try:
        given = inspect.signature(found)
    except (TypeError, ValueError):
        return f"```py\n{name}\n```\n"
    parts = [
        re.sub(r" at 0x[0-9a-f]+", "", str(one.replace(annotation=one.empty)))  # types are in the text
        for one in given.parameters.values()
        if one.name != "self"
    ]
    line = f"{name}({', '.join(parts)})"
    if len(line) > 100:
        line = f"{name}(\n    " + ",\n    ".join(parts) + ",\n)"
    return f"```py\n{line}\n```\n"


def _text(found):
    doc = inspect.getdoc(found)
    return f"```text\n{doc}\n```\n" if doc else ""


def main():
    PAGE.write_text(api())
    print(f"{PAGE}: {len(api().splitlines())} lines")


if __name__ == "__main__":
    main()
