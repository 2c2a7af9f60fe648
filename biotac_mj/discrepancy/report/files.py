"""The files of a report: report.html (one file, to be sent), verdict.json and figures."""

import base64
import dataclasses
import functools
import importlib.resources
import io
import json
import math
import pathlib
from collections.abc import Sequence

from ...effects.effect import STAGES
from ...files import replacing
from .text import cell, columns
from .verdict import Verdict

__all__ = ["Picture", "page", "write"]


@dataclasses.dataclass(frozen=True)
class Picture:
    """A figure of a report.

    Attributes:
      name: of its file, without suffix. section: "curves", "gap", "where", "tried" or "unknown". figure: of
        matplotlib.
    """

    name: str
    section: str
    figure: object

    @functools.cached_property
    def png(self) -> bytes:
        store = io.BytesIO()
        self.figure.savefig(store, dpi=110, format="png")
        return store.getvalue()

    @property
    def data(self) -> str:
        return base64.b64encode(self.png).decode()


def page(verdict: Verdict, pictures: Sequence[Picture] = ()) -> str:
    """The report as one HTML page; every name in it is escaped."""
    import jinja2

    source = importlib.resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    kept = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = kept.from_string(source)
    more = {"stages": STAGES, "columns": columns, "cell": cell, "percent": _percent}
    return template.render(v=verdict, pictures=pictures, **more)


def _percent(share):
    return f"{share:.0%}" if math.isfinite(share) else ""


def write(
    verdict: Verdict, pictures: Sequence[Picture], folder: pathlib.Path | str
) -> tuple[pathlib.Path, ...]:
    """Writes report.html, verdict.json and NAME.png of every picture; returns the paths, in this order."""
    folder = pathlib.Path(folder)
    content = {
        "report.html": page(verdict, pictures).encode(),
        "verdict.json": json.dumps(verdict.to_dict(), indent=1, allow_nan=False).encode(),
        **{f"{one.name}.png": one.png for one in pictures},
    }
    for name, data in content.items():
        with replacing(folder / name) as temporary:
            temporary.write_bytes(data)
    return tuple(folder / name for name in content)
