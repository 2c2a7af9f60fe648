"""The files of a report: report.html (one file, to be sent), verdict.json, the amended sensor, figures."""

import importlib.resources
import json
import math
import pathlib
from collections.abc import Sequence

from ...effects.effect import STAGES
from ...effects.sensor_file import write_sensor_file
from ...files import replacing
from .text import cell, columns
from .verdict import Picture, Verdict

AMENDED = "sensor_amended.yaml"


def page(verdict: Verdict, pictures: Sequence[Picture] = ()) -> str:
    """The report as one HTML page; every name in it is escaped."""
    import jinja2

    source = importlib.resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    kept = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = kept.from_string(source)
    more = {"stages": STAGES, "columns": columns, "cell": cell}
    more["percent"] = lambda part: f"{part:.0%}" if math.isfinite(part) else ""
    return template.render(v=verdict, pictures=pictures, **more)


def write_report(verdict: Verdict, folder: pathlib.Path | str) -> list[pathlib.Path]:
    """Writes report.html, verdict.json, sensor_amended.yaml if the verdict has a sensor, and NAME.png of each
    picture; returns the paths, in this order."""
    folder, pictures, sensor = pathlib.Path(folder), verdict.pictures(), verdict.sensor()
    content = {
        "report.html": page(verdict, pictures).encode(),
        "verdict.json": json.dumps(verdict.to_dict(), indent=1, allow_nan=False).encode(),
    }
    drawn = {f"{one.name}.png": one.png for one in pictures}
    for name, data in (content | drawn).items():
        with replacing(folder / name) as temporary:
            temporary.write_bytes(data)
    if sensor is not None:
        write_sensor_file(folder / AMENDED, sensor)
    return [folder / name for name in (*content, *([] if sensor is None else [AMENDED]), *drawn)]
