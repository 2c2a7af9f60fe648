"""Schema of a data set of tactile interactions: names, shapes, units. The file's layout is in
`docs/howto/file_formats.md`."""

import dataclasses
from collections.abc import Iterable

import numpy as np

from ..fields import check_choice
from ..geometry.design import BIOTAC, Design
from ..geometry.skin_geometry import SkinGeometry

SCHEMA = "biotac_mj.data/1"
KINDS = ("press", "slide", "twist", "tap", "recorded", "resimulated")
SPLITS = ("train", "validation", "test")
DISPLACEMENT_SCALE = 2.5e-7  # [m] per stored integer: rounding of at most 0.125 um, range of 8.19 mm

# Per time step: name -> (shape, stored type, unit). "nvert" and "nouter" are the skin's numbers of nodes,
# "nelectrode", "npac" and "nchannel" those of its design. PAC covers the frame before a row.
COLUMNS = {
    "time": ((), "f8", "s"),
    "displacement": (("nvert", 3), "i2", "m"),  # times DISPLACEMENT_SCALE
    "wrench": ((6,), "f4", "N, N m"),
    "contact_force": (("nouter", 3), "f4", "N"),
    "contact_pos": ((3,), "f4", "m"),
    "contact_normal": ((3,), "f4", "1"),
    "contact_depth": ((), "f4", "m"),
    "contact_area": ((), "f4", "m^2"),
    "pressure": ((), "f4", "Pa"),
    "impedance": (("nelectrode",), "f4", "ohm"),
    "counts": (("nchannel",), "f4", "count"),
    "pac": (("npac",), "u2", "count"),
    "indenter_pos": ((3,), "f8", "m"),
    "indenter_quat": ((4,), "f8", "w x y z"),
    "converged": ((), "u1", "0 or 1"),
    "measured_counts": (("nchannel",), "f4", "count"),
    "measured_pac": (("npac",), "f4", "count"),
    "measured_wrench": ((6,), "f4", "N, N m"),
}
FRAME = "BioTac: tip at -x, pad at -y, nail at +y, clamp at +x"
# NaN without contact or measurement
MAY_LACK = ("contact_pos", "contact_normal", "measured_counts", "measured_pac", "measured_wrench")


@dataclasses.dataclass
class Interaction:
    """One contact from start to end: n time steps in the BioTac frame. Fields that were not recorded are
    None.

    Attributes:
      id: unique in its set.
      object: as in `biotac data generate --objects`, or in the imported file.
      kind: of KINDS.
      split: of SPLITS, the default split by interaction.
      seed: of its random numbers.
      parameters: of its generation; JSON types.
      time: (n,) increasing [s].
      displacement: (n, nvert, 3) float32, nodes against the skin's `vert` [m].
      wrench: (n, 6) of the skin on the object, torque about the BioTac frame's origin [N, N m].
      contact_force: (n, nouter, 3) of the object on the nodes of the outer surface, `nodes_of(geometry)` [N].
      contact_pos: (n, 3) centre of the contact forces on the deformed skin, weighted by their norm [m];
        contact_normal: (n, 3) unit outward normal of the deformed skin there. Both NaN without contact.
      contact_depth: (n,) largest inward displacement of the nodes in contact, along the normals of the
        untouched skin [m]; contact_area: (n,) on which it presses [m^2], `surface.pressure_area`. Both 0
        without contact.
      pressure: (n,) of the liquid above rest [Pa].
      impedance: (n, nelectrode) e1, e2, ... of the simulated film [ohm].
      counts: (n, nchannel) simulated readings in the order of the design's `channels` [counts].
      pac: (n, npac) of these, PAC of the last frame in the order of time [counts].
      indenter_pos, indenter_quat: (n, 3) [m], (n, 4) w x y z, pose of the object's frame.
      converged: (n,) whether the skin's step converged.
      measured_counts: (n, nchannel) readings of the target sensor, real or synthetic; NaN for channels that
        it does not have.
      measured_pac: (n, npac) of these, PAC of the frame before the row, the latest sample last; NaN if
        missing.
      measured_wrench: (n, 6) measured with it; NaN if missing.
    """

    id: str
    object: str
    kind: str
    split: str
    seed: int
    parameters: dict
    time: np.ndarray
    displacement: np.ndarray | None = None
    wrench: np.ndarray | None = None
    contact_force: np.ndarray | None = None
    contact_pos: np.ndarray | None = None
    contact_normal: np.ndarray | None = None
    contact_depth: np.ndarray | None = None
    contact_area: np.ndarray | None = None
    pressure: np.ndarray | None = None
    impedance: np.ndarray | None = None
    counts: np.ndarray | None = None
    pac: np.ndarray | None = None
    indenter_pos: np.ndarray | None = None
    indenter_quat: np.ndarray | None = None
    converged: np.ndarray | None = None
    measured_counts: np.ndarray | None = None
    measured_pac: np.ndarray | None = None
    measured_wrench: np.ndarray | None = None

    @property
    def labelled(self) -> bool:
        """Whether it has measured counts."""
        return self.measured_counts is not None

    def check(
        self, nvert: int | None = None, nouter: int | None = None, design: Design = BIOTAC
    ) -> "Interaction":
        """Returns itself. design: of the sensor, for the numbers of its channels.

        Raises:
          ValueError: a wrong kind, split or shape, a time that does not increase, or an invalid NaN; the text
            has the name.
        """
        where = f"interaction {self.id!r}"
        check_choice(f"{where} has kind", self.kind, KINDS)
        check_choice(f"{where} has split", self.split, SPLITS)
        n = len(self.time)
        if not n:
            raise ValueError(f"{where} has no time steps: leave it out")
        sizes = {"nvert": nvert, "nouter": nouter} | channel_sizes(design)
        for name, (shape, _, unit) in COLUMNS.items():
            value = getattr(self, name)
            if value is None:
                continue
            wanted = (n, *(sizes.get(s, s) if isinstance(s, str) else s for s in shape))
            if None in wanted:
                raise ValueError(
                    f"{where} has {name} but its set has no skin: pass the geometry that the nodes belong to"
                )
            if np.shape(value) != wanted:
                raise ValueError(
                    f"{name} of {where} has shape {np.shape(value)}: {wanted} is needed [{unit}]"
                )
            if name not in MAY_LACK and not np.isfinite(value).all():
                raise ValueError(
                    f"{name} of {where} contains NaN or infinite numbers: "
                    "drop those steps, or keep the last good ones"
                )
        if n > 1 and not (np.diff(self.time) > 0).all():
            raise ValueError(f"time of {where} does not increase: sort its steps and drop repeated ones")
        return self


def frame_of(parameters: Iterable[dict]) -> str:
    """Frame of poses and forces: the BioTac's, or what recordings say of theirs, from interactions'
    parameters."""
    return "; ".join(sorted({one.get("frame", FRAME) for one in parameters}))


def channel_sizes(design: Design) -> dict[str, int]:
    """Sizes for "nelectrode", "npac" and "nchannel" in COLUMNS."""
    return {"nelectrode": design.nelectrode, "npac": design.npac, "nchannel": len(design.channels)}


def nodes_of(geometry: SkinGeometry) -> np.ndarray:
    """(nouter,) sorted nodes of a skin's outer surface, for which `contact_force` is stored."""
    return np.unique(geometry.outer_face)
