"""JSON files of benchmarks: written whole or not at all, and read back by a run that goes on."""

import json
import pathlib
from typing import Any

from biotac_mj.files import replacing

__all__ = ["read_json", "write_json"]


def write_json(path: pathlib.Path | str, content: Any) -> None:
    """Writes to a temporary name in the same folder, then renames it."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_json(path: pathlib.Path | str, missing: Any) -> Any:
    """What the file holds, or `missing` where there is none."""
    path = pathlib.Path(path)
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else missing
