"""Options of a press, and the path of its indenter: to the depth, then along the skin."""

import dataclasses
import math
import pathlib

import mujoco
import numpy as np

from ..coupling.settings import Settings
from ..fields import check_types, either
from ..geometry.rigid import quaternion_from_y
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.skins import place_of
from ..short_repr import short_repr
from ..skin.settings import read_dict
from ..units import SI, UNITS, question, read_quantity
from . import approach
from .indenter import Indenter, add_indenter

_DEEPEST, _LONGEST = 0.02, 0.05  # [m] the finger is 14 mm thick and 26 mm long
_LONGEST_STEP = 1.0  # [s]
_ROUND = 2 * math.pi + 1e-9  # [rad]
_FASTEST = 1.0  # [m/s]
_MOST_STEPS = 20_000  # each stores all nodes: a gigabyte for the default skin
_PLAIN = "indenter depth slide timestep speed hold two_way".split()
# keywords of `biotac_mj.attach` that a press sets itself
_OF_PRESS = ("coupling", "geoms", "rounding", "thermal", "textures", "on_error")
_KINDS = dict(depth="length", slide="length", speed="speed", timestep="time", hold="time")
LEAD = 5e-6  # the indenter starts this far before first contact [m]


@dataclasses.dataclass(frozen=True, init=False)
class PressOptions:
    """Options of a press: the fields below, and settings of the BioTac as further keywords.

        PressOptions(indenter="ring_7mm", depth=1.5e-3, skin="coarse", material="calibrated")

    Numbers are in SI units; lengths, angles, times and speeds may be texts with a unit, such as "1.5mm" or
    "30deg".

    Attributes:
      indenter: see `indenter.make_indenter`.
      location: (x [m], angle around the finger [rad]) or (x, y, z) [m], moved to the nearest point of the
        skin; None: see `geometry.skins.place_of`.
      direction: of the press (3,); None: the inward normal of the skin at the location.
      depth: travel from first contact [m].
      slide: travel along slide_direction after the press [m].
      slide_direction: (3,); its component perpendicular to `direction` is used.
      timestep: [s]. speed: of the indenter [m/s]. hold: pause at the end of the press and of the slide [s].
      two_way: whether a servo with mass and compliance moves the indenter, instead of a prescribed path.
      thermal: material of the indenter ("steel"), texture: of its surface ("cork"); see `SensorSettings`.
        None: without heat or vibration.
      settings: of the BioTac, as for `biotac_mj.attach`, except coupling, geoms, rounding, thermal, textures
        and on_error, which a press sets itself.

    Args:
      textures: the same as texture, by the name that attach uses.
      keywords: the fields, and the BioTac's settings by name, see `SettingKeywords`; friction is also that of
        the indenter, and `options` may be a .json file.

    Raises:
      ValueError: an impossible value. TypeError: an unknown keyword. FileNotFoundError: no such file.
    """

    indenter: str = "sphere_7mm"
    location: tuple | None = None
    direction: tuple | None = None
    depth: float = 2e-3
    slide: float = 0.0
    slide_direction: tuple = (1.0, 0.0, 0.0)
    timestep: float = 4e-3
    speed: float = 10e-3
    hold: float = 0.02
    two_way: bool = False
    thermal: str | dict | tuple | None = None
    texture: str | dict | tuple | None = None
    settings: Settings = Settings()

    def __init__(
        self,
        *,
        settings: Settings | dict | str | pathlib.Path | None = None,
        textures: str | dict | tuple | None = None,
        **keywords: object,
    ):
        fields = {f.name: f.default for f in dataclasses.fields(self)}
        given = {**fields, **{name: keywords.pop(name) for name in fields if name in keywords}}
        given["texture"] = either("texture", given["texture"], {"texture": textures}, "textures")
        keywords["options"] = read_dict(keywords.get("options"), "options")
        given["settings"] = Settings.of(settings, keywords, "PressOptions", _OF_PRESS, fields)
        given |= {name: read_quantity(name, given[name], kind) for name, kind in _KINDS.items()}
        if given["location"] is not None:
            given["location"] = _location(given["location"])
        for name, value in given.items():
            object.__setattr__(self, name, value)
        self.settings.config()  # refuses impossible values
        self._check()

    @property
    def keywords(self) -> dict:
        """The given options, by name."""
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "settings"}
        of_sensor = self.settings.keywords
        return {name: value for name, value in of_sensor.items() if name not in _OF_PRESS} | own

    def _check(self):
        check_types(self, _PLAIN)
        for name, least in (("depth", 1), ("timestep", 1), ("speed", 1), ("slide", 0), ("hold", 0)):
            value = getattr(self, name)
            if not (np.isfinite(value) and (value > 0 if least else value >= 0)):
                wanted = "a positive number" if least else "zero or a positive number"
                raise ValueError(f"{name} is {_said(name, value)}: it must be {wanted}")
        for name, most, why in (
            ("depth", _DEEPEST, "the finger ends there"),
            ("slide", _LONGEST, "the finger ends before"),
            ("timestep", _LONGEST_STEP, "a longer one is no press"),
            ("speed", _FASTEST, "what is faster is no press"),
        ):
            _refuse_larger(name, getattr(self, name), most, why, _KINDS[name])
        rests = self.hold * (2 if self.slide else 1)
        steps = ((self.depth + self.slide) / self.speed + rests) / self.timestep
        if steps > _MOST_STEPS:
            raise ValueError(
                f"this press takes {steps:.3g} steps of {_said('timestep', self.timestep)}: {_MOST_STEPS} at "
                "most; shorten hold, depth or slide, or raise speed or timestep"
            )
        for name in ("location", "direction", "slide_direction"):
            value = getattr(self, name)
            if value is not None and np.asarray(value).dtype.kind not in "fiu":
                raise ValueError(f"{name} is {value!r}: pass numbers")
            if value is not None and not np.isfinite(value).all():
                raise ValueError(f"{name} {value} contains NaN or infinite numbers")
        for i, value in enumerate(self.location or ()):
            if len(self.location) == 2 and i == 1:
                _refuse_larger("location's angle", value, _ROUND, "a finger is once round", "angle")
            else:
                _refuse_larger(f"location's {'xyz'[i]}", value, _LONGEST, "the finger ends before", "length")
        for name in ("direction", "slide_direction"):
            value = getattr(self, name)
            if value is not None and (len(value) != 3 or not np.linalg.norm(value)):
                raise ValueError(f"{name} {value} is no direction: give three numbers that are not all zero")


def _location(value):
    """Lengths, and the angle of a position along and around the finger, in SI."""
    parts = value.split() if isinstance(value, str) else value
    if not np.iterable(parts) or isinstance(parts, bytes) or not 1 <= len(parts) <= 3:
        given = short_repr(value)
        raise ValueError(f"location is {given}: give x, x and an angle, or x, y and z, as in -12mm 30deg")
    kinds = ("length", "angle") if len(parts) < 3 else ("length",) * 3
    found = tuple(read_quantity("location", one, kind) for one, kind in zip(parts, kinds))
    return found if len(found) > 1 else (*found, 0.0)


def _refuse_larger(name, value, most, why, kind):
    if abs(value) > most:
        usual, factor = list(UNITS[kind].items())[1]
        raise ValueError(
            f"{name} is {value:g} {SI[kind]}: {question(value, most, kind)}{most / factor:.4g} {usual} at "
            f"most, {why}"
        )


def _said(name, value):
    """A length or time for messages, in the usual unit: 2.4 mm."""
    usual, factor = list(UNITS[_KINDS[name]].items())[1]
    return f"{value / factor:.6g} {usual}"


@dataclasses.dataclass(frozen=True)
class Path:
    """Path of an indenter's frame, which only translates.

    Attributes:
      start: (3,) its origin at first contact [m].
      quat: (4,) its orientation.
      direction, slide_direction: (3,) unit vectors, perpendicular to each other.
      depth, slid: (n,) travel at each step [m]; row 0 is the start before first contact.
      room: from first contact to where the indenter meets core, nail or clamp, along the direction [m].
    """

    start: np.ndarray
    quat: np.ndarray
    direction: np.ndarray
    slide_direction: np.ndarray
    depth: np.ndarray
    slid: np.ndarray
    room: float

    def position(self, depth: float, slid: float = 0.0) -> np.ndarray:
        """Origin (3,) of the frame after these travels [m]."""
        return self.start + depth * self.direction + slid * self.slide_direction


def plan_path(geometry: SkinGeometry, indenter: Indenter, options: PressOptions) -> Path:
    """Plans the path of the indenter: from 5 um before first contact with the undeformed skin, in equal steps
    to the depth, then along the skin.

    Raises:
      ValueError: no skin at the location, a location inside the core, an indenter that misses the skin, a
        direction out of the skin, or a slide along the direction.
    """
    location = place_of(geometry) if options.location is None else options.location
    if len(location) == 2:
        point, normal = approach.surface_point(geometry, *location)
    else:
        if approach.is_inside(geometry.core_vert, geometry.core_face, location):
            place = ", ".join(f"{1e3 * v:g}" for v in location)
            raise ValueError(
                f"location ({place}) mm lies inside the finger's rigid core: give a place on its skin, or x "
                "and an angle around the finger"
            )
        point, normal = approach.nearest_point(geometry, location)
    direction = -normal if options.direction is None else np.asarray(options.direction, float)
    direction = direction / np.linalg.norm(direction)
    if direction @ normal >= 0:
        raise ValueError(
            f"direction {direction.round(3).tolist()} leaves the skin at {(1e3 * point).round(2).tolist()} "
            "mm: it must point into it"
        )
    across = np.asarray(options.slide_direction, float)
    across = across - (across @ direction) * direction
    if options.slide and np.linalg.norm(across) < 1e-3 * np.linalg.norm(options.slide_direction):
        raise ValueError("slide_direction is along the press: give one across it")
    across = across / max(np.linalg.norm(across), 1e-30)

    quat = quaternion_from_y(direction)
    spec = mujoco.MjSpec()
    back = 0.05 + np.abs(indenter.vert).max()  # clear of the finger
    add_indenter(
        spec, spec.worldbody.add_body(pos=point - back * direction, quat=quat), indenter, exact=False
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    travel = approach.first_touch(geometry.vert, geometry.outer_face, model, data, direction)
    if not np.isfinite(travel):
        raise ValueError(
            "the indenter passes the skin without touching it: change the location or the direction"
        )
    room = approach.first_touch(*geometry.rigid, model, data, direction) - travel
    start = point + (travel - back) * direction

    step = options.speed * options.timestep

    def ramp(length):
        count = int(np.ceil(length / step - 1e-9))
        return length * np.arange(1, count + 1) / max(count, 1)

    hold = np.zeros(int(round(options.hold / options.timestep)))
    down, along = ramp(options.depth), ramp(options.slide)
    depth = np.concatenate(
        [
            [-LEAD],
            down,
            hold + options.depth,
            0 * along + options.depth,
            (hold if options.slide else hold[:0]) + options.depth,
        ]
    )
    slid = np.concatenate([[0], 0 * down, hold, along, (hold if options.slide else hold[:0]) + options.slide])
    return Path(start, quat, direction, across, depth, slid, room)
