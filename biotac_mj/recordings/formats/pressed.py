"""skin.h5 of `biotac press` as a recording: a simulated sensor's counts and the indenter's poses."""

import json
import pathlib

import numpy as np

from ...geometry.design import SINGLES
from ...reading import Array, read_hdf5
from ..recording import Recording

KEYS = {
    "time": Array(("n",)),
    "counts": Array(("n", "nchannel")),
    "force": Array(("n", 3)),
    "indenter_pose": Array(("n", 7)),
}
_REMEDY = "give the skin.h5 of a `biotac press`, pressed again with this version"
_PAC = {"pac": Array(("n", "npac"))}


def read_press(path: pathlib.Path) -> list[Recording]:
    """The press as one recording, in the BioTac frame; force is that on the indenter.

    Raises:
      ValueError: another file, or one of an older version, without PAC's samples of a frame.
    """
    found, attributes = read_hdf5(path, "recorded press", _REMEDY, KEYS | _PAC, ("parameters",))
    n = found["counts"].shape[1] - len(SINGLES)
    counts = dict(zip(SINGLES, found["counts"].T[n:]))
    return [
        Recording(
            found["time"],
            electrodes=found["counts"][:, :n],
            pac=found["pac"],
            **{name: counts[name] for name in ("pdc", "tdc", "tac")},
            force=found["force"],
            object_pos=found["indenter_pose"][:, :3],
            object_quat=found["indenter_pose"][:, 3:],
            name="press",
            object=str(json.loads(attributes["parameters"]).get("indenter", "")),
            source=f"{path.name}: simulated",
            frame="BioTac",
        )
    ]


def settings_of(path: pathlib.Path | str, recording: Recording) -> dict | None:
    """Keywords of the press behind a recording, as `biotac press` wrote them into skin.h5: the file at
    `path`, or the one next to readings.csv if its counts are equal. None: no press."""
    there = pathlib.Path(path).parent / "skin.h5"
    if recording.electrodes is None or not there.is_file():
        return None
    try:
        found, attributes = read_hdf5(there, "recorded press", _REMEDY, KEYS, ("parameters",))
    except ValueError:
        return None
    same = np.array_equal(found["counts"][:, : -len(SINGLES)], recording.electrodes)
    return json.loads(attributes["parameters"]) if same else None
