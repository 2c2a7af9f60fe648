"""skin.h5 of `biotac press` as a recording: what a simulated sensor read, with the indenter's poses."""

import json
import pathlib

from ...geometry.design import SINGLES
from ...reading import Array, read_hdf5
from ...sensor.channels import NPAC
from ..recording import Recording

__all__ = ["KEYS", "read_press"]

KEYS = {
    "time": Array(("n",)),
    "counts": Array(("n", "nchannel")),
    "force": Array(("n", 3)),
    "indenter_pose": Array(("n", 7)),
}
_PAC = {"pac": Array(("n", "npac"))}


def read_press(path: pathlib.Path) -> list[Recording]:
    """The press as one recording, in the BioTac frame; force is that on the indenter.

    Raises:
      ValueError: another file, or one that an older version wrote, without PAC's values of a frame.
    """
    remedy = "give the skin.h5 of a `biotac press`, pressed again with this version"
    found, attributes = read_hdf5(path, "recorded press", remedy, KEYS | _PAC, ("parameters",))
    n = found["counts"].shape[1] - len(SINGLES)
    counts = dict(zip(SINGLES, found["counts"].T[n:]))
    return [
        Recording(
            found["time"],
            electrodes=found["counts"][:, :n],
            pac=found["pac"][:, -NPAC:],
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
