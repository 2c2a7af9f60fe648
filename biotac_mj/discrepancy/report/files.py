"""The files of a report: report.html (one file, to be sent), verdict.json, the amended sensor, figures."""

import base64
import importlib.resources
import io
import json
import math
import pathlib
from collections.abc import Mapping

from ...effects.effect import STAGES
from ...effects.sensor_file import write_sensor_file
from ...files import replacing
from .text import cell, columns
from .verdict import Verdict

AMENDED = "sensor_amended.yaml"


def page(verdict: Verdict, pictures: Mapping[str, bytes] | None = None) -> str:
    """The report as one HTML page; every name in it is escaped. pictures: PNG by name."""
    import jinja2

    source = importlib.resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    kept = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = kept.from_string(source)
    more = {"stages": STAGES, "columns": columns, "cell": cell}
    more["percent"] = lambda part: f"{part:.0%}" if math.isfinite(part) else ""
    drawn = {name: base64.b64encode(png).decode() for name, png in (pictures or {}).items()}
    return template.render(v=verdict, pictures=drawn, **more)


def _png(figure):
    store = io.BytesIO()
    figure.savefig(store, dpi=110, format="png")
    return store.getvalue()


def write_report(verdict: Verdict, folder: pathlib.Path | str) -> list[pathlib.Path]:
    """Writes report.html, verdict.json, sensor_amended.yaml if the verdict has a sensor, and NAME.png of each
    picture; returns the paths, in this order."""
    folder, sensor = pathlib.Path(folder), verdict.sensor()
    pictures = {name: _png(figure) for name, figure in verdict.pictures().items()}
    content = {
        "report.html": page(verdict, pictures).encode(),
        "verdict.json": json.dumps(verdict.to_dict(), indent=1, allow_nan=False).encode(),
    }
    drawn = {f"{name}.png": png for name, png in pictures.items()}
    for name, data in (content | drawn).items():
        with replacing(folder / name) as temporary:
            temporary.write_bytes(data)
    if sensor is not None:
        write_sensor_file(folder / AMENDED, sensor)
    return [folder / name for name in (*content, *([] if sensor is None else [AMENDED]), *drawn)]
