"""A recording of one sensor, and the file format of recordings."""

import collections
import dataclasses
import json
import pathlib
import typing
from collections.abc import Sequence

import numpy as np

from ..fields import as_numbers, refuse_unknown
from ..files import hdf5
from ..geometry.design import BIOTAC, Design, design_of_channels, designs
from ..quality.clock import BUS_RATE, usual_step
from ..quality.repeats import repeated_rows
from ..reading import Array, Unfit, check_arrays, reading
from ..sensor.channels import FULL_SCALE, check_counts, check_force, log_impedance
from ..short_repr import short_repr

SCHEMA = "biotac_mj.recording/1"
UNITS = ("counts", "tared counts", "tared counts without sign", "volts", "normalised")
# least correlation of the baseline (`Recording.rest_correlation`) for electrodes in the usual order: five
# BioTacs in published recordings have 0.52 to 0.71, shuffled ones mostly less than this, a BioTac SP 0.02
REST_LIKE = 0.3
CLOCKED = "the file's times"  # `rate_source` of a recording whose file has times
_EDGE = 1.0  # [counts] distance of the results from the ends of the converter
_WHOLE = 0.02  # [counts] rounding of logs of whole counts minus a mean
_REACH = 100.0  # [m] from its frame's origin: a more distant position is not in metres
_REMEDY = "give a file that `biotac recording import` wrote"


class Field(typing.NamedTuple):
    """width: numbers per row, 0 for a scalar. units: allowed ones, the usual one first."""

    width: int
    units: tuple[str, ...]
    meaning: str


FIELDS = {
    "electrodes": Field(BIOTAC.nelectrode, UNITS, "e1, e2, ...; other designs have their own number"),
    "pdc": Field(0, UNITS, "pressure of the liquid"),
    "pac": Field(BIOTAC.npac, UNITS, "its vibration in a frame before the row, the latest sample last"),
    "tdc": Field(0, UNITS, "temperature"),
    "tac": Field(0, UNITS, "its change"),
    "force": Field(3, ("N",), "Fx Fy Fz, in the frame that `frame` names"),
    "torque": Field(3, ("N m",), "Tx Ty Tz"),
    "contact_pos": Field(3, ("m",), "where the object touches"),
    "object_pos": Field(3, ("m",), "the object's place"),
    "object_quat": Field(4, ("w x y z",), "its attitude"),
    "sensor_pos": Field(3, ("m",), "the sensor's place"),
    "sensor_quat": Field(4, ("w x y z",), "its attitude"),
}
CHANNELS = tuple(name for name, field in FIELDS.items() if field.units is UNITS)
_WORDS = ("object", "source", "frame", "rate_source")


@dataclasses.dataclass(eq=False)
class Recording:
    """n rows of one sensor in order of time. Fields that were not recorded are None; missing values are NaN.

    Attributes:
      time: (n,) increasing [s].
      electrodes (n, nelectrode), pdc (n,), pac (n, 22), of a BioTac SP (n, 31), tdc
        (n,), tac (n,): in `units`, default raw counts.
      force, torque: (n, 3) [N], [N m].
      contact_pos, object_pos, sensor_pos: (n, 3) [m]; object_quat, sensor_quat: (n, 4) w x y z.
      name: unique in its file. object: what touched, "" if unknown.
      source: files that it comes from. frame: of forces and poses. rate_source: origin of the rate.
      notes: on changes by the importer.
      units: field -> one of UNITS.

    Raises:
      ValueError: invalid shapes, units or values; the text has their names.
    """

    time: np.ndarray
    electrodes: np.ndarray | None = None
    pdc: np.ndarray | None = None
    pac: np.ndarray | None = None
    tdc: np.ndarray | None = None
    tac: np.ndarray | None = None
    force: np.ndarray | None = None
    torque: np.ndarray | None = None
    contact_pos: np.ndarray | None = None
    object_pos: np.ndarray | None = None
    object_quat: np.ndarray | None = None
    sensor_pos: np.ndarray | None = None
    sensor_quat: np.ndarray | None = None
    name: str = "recording"
    object: str = ""
    source: str = ""
    frame: str = "the file's"
    rate_source: str = CLOCKED
    notes: tuple[str, ...] = ()
    units: dict[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        where = self.name
        if not isinstance(self.name, str) or not isinstance(self.units, dict):
            raise ValueError(
                f"name is {short_repr(self.name)} and units are {short_repr(self.units)}: a text and a "
                "dict of fields and their units are needed"
            )
        refuse_unknown(self.units, FIELDS, f"units of {where}")
        self.time = as_numbers(f"{where}: time", self.time)
        if self.time.ndim != 1 or not len(self.time):
            raise ValueError(f"{where}: time has shape {self.time.shape}: (n,) is needed, n at least 1")
        if not np.isfinite(self.time).all() or (np.diff(self.time) <= 0).any():
            raise ValueError(f"{where}: time does not increase: sort the rows and drop repeated ones")
        for name in self.fields:
            self._check_field(name)
        if not any(getattr(self, name) is not None for name in CHANNELS):
            raise ValueError(f"{where} has no channel of a sensor: one of {', '.join(CHANNELS)} is needed")
        for name in ("object_quat", "sensor_quat"):
            value = getattr(self, name)
            if value is not None and (np.abs(np.linalg.norm(value, axis=1) - 1) > 0.01).any():
                raise ValueError(f"{where}: {name} has rows that are no unit quaternions w x y z: scale them")
        if self.force is not None:
            check_force(self.force, where)
        if self.electrodes is not None and self.unit("electrodes") == "counts":
            check_counts(self.electrodes[np.isfinite(self.electrodes).all(1)], where)

    def _check_field(self, name):
        value, (width, units, _) = as_numbers(f"{self.name}: {name}", getattr(self, name)), FIELDS[name]
        setattr(self, name, value)
        if name == "electrodes" and value.ndim == 2 and self.design is None:
            raise ValueError(
                f"{self.name} has {value.shape[1]} electrodes: a recording is one of a "
                f"{' or a '.join(design.title for design in designs())}"
            )
        if name in ("electrodes", "pac"):
            width = (self.design or BIOTAC).widths[name]
        shape = (len(self.time), width) if width else (len(self.time),)
        if value.shape != shape:
            raise ValueError(f"{self.name}: {name} has shape {value.shape}, {shape} is needed, row by row")
        if np.isinf(value).any() or not np.isfinite(value).any():
            raise ValueError(f"{self.name}: {name} has infinite numbers, or none at all: leave it out")
        if self.unit(name) not in units:
            raise ValueError(
                f"{self.name}: {name} is in {self.unit(name)!r}: one of {', '.join(units)} is needed"
            )
        if name.endswith("_pos") and np.nanmax(np.abs(value)) > _REACH:
            raise ValueError(f"{self.name}: {name} reaches {np.nanmax(np.abs(value)):.3g}: metres are needed")

    def __len__(self):
        return len(self.time)

    @property
    def fields(self) -> list[str]:
        """Names of the recorded fields."""
        return [name for name in FIELDS if getattr(self, name) is not None]

    @property
    def design(self) -> Design | None:
        """The fingertip with this number of electrodes; None without electrodes."""
        return None if np.ndim(self.electrodes) != 2 else design_of_channels(self.electrodes.shape[1])

    def unit(self, name: str) -> str:
        """Unit of a field."""
        return self.units.get(name, FIELDS[name].units[0])

    @property
    def rate(self) -> float:
        """Mean rate of rows [Hz], without gaps."""
        return 1 / usual_step(self.time)[0] if len(self) > 1 else BUS_RATE

    @property
    def repeated(self) -> np.ndarray:
        """(n,) bool, rows that repeat the electrodes of the one before (`repeated_rows`)."""
        if self.electrodes is None:
            return np.zeros(len(self), bool)
        return repeated_rows(self.electrodes)

    @property
    def rest_correlation(self) -> float:
        """Correlation of the median ln Z with the mean pattern of the published sensors, see REST_LIKE. NaN
        without raw counts."""
        if self.electrodes is None or self.unit("electrodes") != "counts":
            return float("nan")
        return rest_correlation(self.electrodes)

    def counts(self) -> tuple[np.ndarray, list[str]]:
        """(n, nelectrode) electrodes as raw counts, and the assumptions made.

        Tared ones are shifted to the mean rest counts of the published sensors.

        Raises:
          ValueError: no electrodes, gaps, volts or normalised values.
        """
        if self.electrodes is None:
            raise ValueError(f"{self.name} has no electrodes: give a recording that has them")
        bad = ~np.isfinite(self.electrodes).all(1)
        if bad.any():
            raise ValueError(
                f"{self.name} lacks electrodes in {bad.sum()} rows, the first is row {np.argmax(bad)}: a gap "
                "cannot be guessed; cut the recording there or log it again"
            )
        unit = self.unit("electrodes")
        if unit == "counts":
            return self.electrodes, []
        if not unit.startswith("tared"):
            raise ValueError(
                f"{self.name}: the electrodes look like {unit} values; raw counts 0..4095 are needed: import "
                "them again with --scale, counts for one of their units"
            )
        return with_baseline(self.electrodes), [
            f"electrodes are {unit}: put on the mean rest of the published sensors, an assumption"
        ]

    def rows(self, which: slice | np.ndarray) -> "Recording":
        """The recording with some of its rows.

        Args:
          which: a slice, numbers (k,) of rows in order, or (n,) bool.

        Raises:
          ValueError: another type, or no existing row.
        """
        which = self._which(which)
        taken = {}
        for name in ("time", *self.fields):
            value = getattr(self, name)[which]
            taken[name] = value if name == "time" or np.isfinite(value).any() else None
        return dataclasses.replace(self, **taken)

    def _which(self, which):
        text, n = f"rows of {self.name} are {short_repr(which)}", len(self)
        if isinstance(which, slice):
            try:
                which = np.arange(n)[which]
            except (TypeError, ValueError):
                which = None
        try:
            which = np.asarray(which)
        except ValueError:  # rows of different lengths
            which = np.zeros(0, object)
        if which.dtype == bool and which.shape == (n,):
            which = np.flatnonzero(which)
        if which.ndim != 1 or which.dtype.kind not in "iu":
            raise ValueError(f"{text}: give a slice, numbers (k,) of rows, or ({n},) bool")
        if not len(which) or which.min() < -n or which.max() >= n:
            raise ValueError(f"{text}: give at least one of its {n} rows, and none else")
        return which


def check_recording(value: object) -> None:
    """Raises TypeError if it is not a Recording."""
    if not isinstance(value, Recording):
        raise TypeError(
            f"recording is {type(value).__name__}: pass a Recording, as biotac_mj.recordings.load_one gives"
        )


def designed(counts: np.ndarray) -> Design:
    """The fingertip whose number of electrodes is that of counts (n, nelectrode)."""
    return design_of_channels(counts.shape[1]) or BIOTAC


def rest_correlation(counts: np.ndarray) -> float:
    """Correlation of the median ln Z of counts (n, nelectrode) with the mean pattern of known sensors, over
    the electrodes that change, if any does: dead ones carry no information."""
    alive = np.nanmax(counts, axis=0) > np.nanmin(counts, axis=0)
    alive |= not alive.any()
    here, published = (log_impedance(of)[..., alive] for of in (counts, designed(counts).rest_counts))
    here = np.nanmedian(here, axis=0)
    return float(np.corrcoef(here, published)[0, 1]) if np.ptp(here) > 1e-9 else 0.0


def with_baseline(values: np.ndarray) -> np.ndarray:
    """(n, nelectrode) counts from tared values (n, nelectrode): plus the mean rest counts of known sensors,
    shifted as little as keeps all of an electrode's values off the ends of the converter. If values differ by
    whole counts, as after subtraction of a mean, the results are whole."""
    rest = designed(values).rest_counts.round()
    turn = np.exp(2j * np.pi * values)
    fraction = np.angle(turn.mean(0)) / (2 * np.pi)  # fractional count common to all values of an electrode
    whole = np.abs(values - fraction - np.rint(values - fraction)).max(0) < _WHOLE
    out = np.where(whole, np.rint(values - fraction), values)
    low, high = np.floor(_EDGE - out.min(0)), np.ceil(FULL_SCALE - _EDGE - out.max(0))
    # a range larger than the converter's means that the values were scaled: the ends are lost
    return np.clip(out + np.clip(rest, low, np.maximum(low, high)), _EDGE, FULL_SCALE - _EDGE)


def write(path: pathlib.Path | str, recordings: Sequence[Recording]) -> None:
    """Writes recordings to one HDF5 file, completely or not at all (`files.hdf5`); layout:
    docs/howto/file_formats.md.

    Raises:
      ValueError: no recording, or two of one name. OSError: it cannot be written.
    """
    if not all(isinstance(one, Recording) for one in recordings):
        raise ValueError(f"recordings are {short_repr(recordings)}: give a list of Recordings")
    twice = [name for name, n in collections.Counter(r.name for r in recordings).items() if n > 1]
    if not recordings or twice:
        raise ValueError(
            f"recordings need names of their own, {', '.join(twice) or 'none was given'}: rename"
        )
    with hdf5(path, track_order=True) as file:
        file.attrs["schema"] = SCHEMA
        for one in recordings:
            group = file.create_group(one.name.replace("/", "_"))
            for word in _WORDS:
                group.attrs[word] = getattr(one, word)
            group.attrs["notes"] = json.dumps(one.notes)
            for name in ("time", *one.fields):
                value = getattr(one, name)
                stored = group.create_dataset(name, data=value, compression="gzip", shuffle=True)
                stored.attrs["unit"] = "s" if name == "time" else one.unit(name)


def read(path: pathlib.Path | str) -> list[Recording]:
    """Reads the recordings of a file that `write` made.

    Raises:
      FileNotFoundError, ValueError: no such file, another schema, a missing or unknown name, or a wrong
        shape, type, unit or value; the text has the name.
    """
    import h5py

    with reading(path, "recording", _REMEDY), h5py.File(path) as file:
        schema = file.attrs.get("schema")
        if schema != SCHEMA:
            raise Unfit(
                f"{path} has schema {schema!r}: this version reads {SCHEMA}; import the recording again"
            )
        groups = {name: group for name, group in file.items() if isinstance(group, h5py.Group)}
        if not groups or len(groups) < len(file):
            raise Unfit(f"{path} has no recordings, or arrays outside of them: {_REMEDY}")
        return [_read_group(path, name, group) for name, group in groups.items()]


def _read_group(path, name, group):
    where = f"{name} of {path}"
    unknown = sorted(set(group) - {"time", *FIELDS})
    if unknown:
        raise Unfit(f"{where} has {', '.join(unknown)}: only time, {', '.join(FIELDS)} are known; {_REMEDY}")
    missing = [word for word in (*_WORDS, "notes") if word not in group.attrs]
    if missing:
        raise Unfit(f"{where} has no attribute {', '.join(missing)}: {_REMEDY}")
    wanted = {"time": Array(("n",))}
    for field in (key for key in FIELDS if key in group):
        width = {"electrodes": "nelectrode", "pac": "npac"}.get(field, FIELDS[field].width)
        wanted[field] = Array(("n", width) if width else ("n",), "number")
    check_arrays(where, group, wanted, _REMEDY)  # before reading
    found = {field: group[field][()] for field in wanted}
    check_arrays(where, found, wanted, _REMEDY)
    notes = json.loads(group.attrs["notes"])
    if not isinstance(notes, list):
        raise Unfit(f"attribute notes of {where} is no list: {_REMEDY}")
    words = {word: str(group.attrs[word]) for word in _WORDS}
    units = {field: str(group[field].attrs.get("unit")) for field in wanted if field != "time"}
    try:
        return Recording(**found, name=name, **words, notes=tuple(map(str, notes)), units=units)
    except ValueError as error:
        raise Unfit(f"{path}: {error}") from None
