"""Design of a make of fingertips: positions of electrodes and excitation, slots of a frame, and measured
readings of single sensors (`docs/howto/pads.md`)."""

import dataclasses
import functools
import json
import os
import pathlib
import re

import numpy as np

from ..fields import refuse_unknown
from ..reading import read_json
from ..short_repr import short_repr
from .assets import asset_path

DESIGNS = ("biotac", "biotac_sp")  # shipped with the package
MOST_DISCS = 32  # electrodes and excitation; more were never simulated
MOST_EXCITATION = 4
SINGLES = ("pdc", "pac", "tdc", "tac")  # columns of stored counts after the electrodes
_LEAST_SLOTS = 2  # PAC's, and one channel's


@dataclasses.dataclass(frozen=True)
class Design:
    """A make of fingertips. Positions are in its published frame: x to the fingertip, z out of the nail [mm].

    Attributes:
      name: in messages and on cards.
      title: common name, with the number of electrodes.
      electrodes_mm: (nelectrode, 3) published positions of e1, e2, ..., near the core's surface.
      excitation: of X1, X2, ..., at most MOST_EXCITATION: (k, 3) positions [mm], or (k, 2) position x in the
        BioTac frame [m] and angle about the x axis from the pad's midline [rad] on a cylindrical core.
      origin_mm: negative x of the BioTac frame's origin, which lies on the axis, in the published frame [mm].
      slots: in a frame of the multiplexer, with PAC between all others; those beyond the channels are empty.
      sensor: default of `sensors`.
      sensors: {name: fields of a `sensor.presets.Sensor`}, as measured, or "ideal": the film's conductance.
      published: names of sensors of which only rest counts are known.
      patterns: names of sensors whose rest counts give the spread of "random" sensors.
      sources: {field: source}.

    Raises:
      ValueError: a value that cannot be.
    """

    name: str
    title: str
    electrodes_mm: tuple = ()
    excitation: tuple = ()
    origin_mm: float = 0.0
    slots: int = 0
    sensor: str = ""
    sensors: dict = dataclasses.field(default_factory=dict)
    published: tuple = ()
    patterns: tuple = ()
    sources: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        for name in ("name", "title", "sensor"):
            if not isinstance(getattr(self, name), str):
                raise ValueError(f"{name} of a design is {short_repr(getattr(self, name))}: give a text")
        for name, widths in (("electrodes_mm", (3,)), ("excitation", (2, 3))):
            given = getattr(self, name)
            try:
                value = np.array(given, float)
            except (TypeError, ValueError):
                value = np.zeros(())
            rows = value.ndim == 2 and value.shape[1] in widths and np.isfinite(value).all()
            if value.size and not rows:
                raise ValueError(
                    f"{name} of design {self.name!r} is {short_repr(given)}: give rows of "
                    f"{' or '.join(map(str, widths))} finite numbers"
                )
            object.__setattr__(self, name, tuple(map(tuple, value.tolist())) if value.size else ())
        n, k = len(self.electrodes_mm), len(self.excitation)
        if (n == 0) != (k == 0):
            raise ValueError(
                f"design {self.name!r} has {n} electrodes and {k} of excitation: give both, or neither for a "
                "pad that senses no impedance"
            )
        if k > MOST_EXCITATION or n + k > MOST_DISCS:
            raise ValueError(
                f"design {self.name!r} has {n} electrodes and {k} of excitation: at most "
                f"{MOST_EXCITATION} of excitation and {MOST_DISCS} together can be simulated"
            )
        least = _LEAST_SLOTS * (n + len(SINGLES) - 1)  # PAC has the slots between
        if self.slots == 0:
            object.__setattr__(self, "slots", least)
        whole = isinstance(self.slots, int) and not isinstance(self.slots, bool)
        if not whole or self.slots < least or self.slots % 2:
            raise ValueError(
                f"slots of design {self.name!r} are {short_repr(self.slots)}: a frame has PAC between all "
                f"other channels, give an even number of {least} or more"
            )
        for one, fields in self.sensors.items():
            if not isinstance(fields, dict) or len(fields.get("rest", ())) != n:
                raise ValueError(f"sensor {one!r} of design {self.name!r} needs {n} rest counts")
        if n and self.sensor not in self.sensors:
            raise ValueError(f"design {self.name!r} has no sensor {self.sensor!r}: name one of its sensors")

    def __hash__(self):
        return hash(self.name)

    @property
    def nelectrode(self) -> int:
        return len(self.electrodes_mm)

    @property
    def npac(self) -> int:
        """Samples of PAC in a frame."""
        return self.slots // 2

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the electrodes' channels."""
        return tuple(f"e{i + 1}" for i in range(self.nelectrode))

    @property
    def channels(self) -> tuple[str, ...]:
        """Columns of stored counts; PAC has its latest sample."""
        return (*self.electrodes, *SINGLES)

    @property
    def discs(self) -> tuple[str, ...]:
        """Names of the film's discs, the excitation electrodes last."""
        return (*map(str.upper, self.electrodes), *(f"X{i + 1}" for i in range(len(self.excitation))))

    @property
    def widths(self) -> dict[str, int]:
        """Numbers of each channel in one frame, in the order of sensor data."""
        return {"electrodes": self.nelectrode, "pdc": 1, "pac": self.npac, "tac": 1, "tdc": 1}

    @functools.cached_property
    def mirror(self) -> np.ndarray:
        """Index (nelectrode,) of the electrode that mirrors each one in the plane z = 0 of the BioTac
        frame."""
        place = np.array(self.electrodes_mm)
        return np.abs(place[:, None] * [1, -1, 1] - place).sum(-1).argmin(0)

    @functools.cached_property
    def radius(self) -> float | None:
        """Distance of electrodes from the axis of a cylindrical core [m]; None on a flat backing."""
        cylindrical = self.excitation and len(self.excitation[0]) == 2
        return 1e-3 * float(np.median(np.hypot(*np.array(self.electrodes_mm).T[1:]))) if cylindrical else None

    def in_biotac_frame(self, position: np.ndarray) -> np.ndarray:
        """Transforms positions (n, 3) [mm] from the published frame to the BioTac frame: (origin - x, z,
        y)."""
        x, y, z = np.asarray(position, float).T
        return np.stack([self.origin_mm - x, z, y], axis=-1)

    @functools.cached_property
    def rest_counts(self) -> np.ndarray:
        """Mean rest counts (nelectrode,) of the published sensors."""
        return np.mean(self.rests, axis=0)

    @property
    def rests(self) -> list:
        """Rest counts of `published` sensors; without any, of `patterns`, or else of all."""
        return [self.sensors[name]["rest"] for name in self.published or self.patterns or self.sensors]

    @functools.cached_property
    def text(self) -> str:
        """JSON of all fields, for `read_design` and stored skins."""
        return json.dumps(dataclasses.asdict(self))


@functools.cache
def _parsed(text):
    fields = json.loads(text)
    refuse_unknown(fields, [field.name for field in dataclasses.fields(Design)], "design")
    missing = [name for name in ("name", "title") if name not in fields]
    if missing:
        raise ValueError(f"a design needs {missing[0]!r}: give a text")
    lists = {name: tuple(fields[name]) for name in ("published", "patterns") if name in fields}
    return Design(**{**fields, **lists})


def read_design(given: "str | pathlib.Path | Design" = "biotac") -> Design:
    """A design from its name, its folder or file (design.json), or its JSON text.

    Raises:
      FileNotFoundError: the file does not exist.
      ValueError: the text is not a valid design.
    """
    if isinstance(given, Design):
        return given
    if not isinstance(given, (str, os.PathLike)):
        raise ValueError(f"design is {short_repr(given)}: pass one of {', '.join(DESIGNS)}, or its folder")
    text = os.fspath(given)
    if text.startswith("{"):
        return _parsed(text)
    path = asset_path(f"designs/{text}/design.json") if text in DESIGNS else pathlib.Path(text)
    path = path / "design.json" if path.is_dir() else path
    remedy = f"pass one of {', '.join(DESIGNS)}, or a folder made by `biotac design new`"
    return _parsed(json.dumps(read_json(path, "design", remedy)))


def designs() -> tuple[Design, ...]:
    """The shipped designs."""
    return tuple(map(read_design, DESIGNS))


def design_of_channels(nelectrode: int) -> Design | None:
    """The shipped design with this number of electrodes, or None."""
    return next((d for d in designs() if d.nelectrode == nelectrode), None)


def design_named(*texts: str) -> Design | None:
    """The shipped design that a log's names tell, or None: of columns, topics or sensors (biotac_sp_e1), and
    serial numbers (BTSP...). "BioTac" by itself names the family."""
    for design in designs():
        family, _, own = design.name.partition("_")
        mark = re.compile(rf"(?:{family}|bt)[^a-z0-9]*{own}(?![a-z])")
        if own and any(mark.search(text.lower()) for text in texts):
            return design
    return None


def check_nelectrode(design: Design, nelectrode: int, whose: str) -> None:
    """Raises ValueError if a recording, or a sensor, has another number of electrodes than the skin's
    design."""
    if nelectrode != design.nelectrode:
        other = design_of_channels(nelectrode)
        remedy = "take the skin of its own design" if other is None else f"take a skin of {other.title}"
        raise ValueError(f"{whose} has {nelectrode} electrodes, and the skin is of {design.title}: {remedy}")


BIOTAC = read_design("biotac")


def electrode_positions(design: Design = BIOTAC) -> np.ndarray:
    """(nelectrode, 3) [mm], in the design's published frame: that of Lin et al. 2013 for the BioTac."""
    return np.array(design.electrodes_mm)
