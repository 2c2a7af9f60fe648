"""Names of columns, variables and message fields in existing logs, and their meanings."""

import functools
import re
import typing

from ..recording import CHANNELS


class Place(typing.NamedTuple):
    """Meaning of a column.

    sensor: prefix of its name, "" if none. field: of `recording.FIELDS`. column: index in the field, None for
    the whole field; electrodes and PAC samples are numbered as written, from 0 or from 1.
    """

    sensor: str
    field: str
    column: int | None


_AXES = {"x": 0, "y": 1, "z": 2}
_QUATERNION = {"w": 0, "x": 1, "y": 2, "z": 3}
_BODIES = {
    "object": "object|obj|indenter|tool|target",
    "contact": "contact_?(?:point|loc|location)?",
    "sensor": "sensor|biotac|finger|hand|robot|ee|tcp",
}
_BEFORE = r"(?P<who>(?:.*[_\d])?)"
_COUNTS = r"(?:_(?:counts?|bits?|raw))?"
_POUND = 0.45359237  # [kg]
_MASSES = {"g": 1e-3, "kg": 1.0, "oz": _POUND / 16, "lb": _POUND}  # [kg] whose weights are units of force
# units of force, torque and position in names of columns, by what is written, in N, Nm and m
_UNITS = {
    "force": {"n": ("N", 1.0), "newton": ("N", 1.0), "newtons": ("N", 1.0)}
    | {
        f"{prefix}n": (f"{prefix}N", size)
        for prefix, size in {"m": 1e-3, "c": 0.01, "da": 10.0, "k": 1e3}.items()
    }
    | {mass + end: (f"{mass}f", 9.80665 * size) for mass, size in _MASSES.items() for end in ("", "f")},
    "torque": {"nm": ("Nm", 1.0), "nmm": ("Nmm", 1e-3), "mnm": ("mNm", 1e-3), "ncm": ("Ncm", 1e-2)},
    "pos": {"m": ("m", 1.0), "cm": ("cm", 1e-2), "mm": ("mm", 1e-3), "um": ("um", 1e-6)},
}
_WRITTEN = {field: f"(?:_?(?P<unit>{'|'.join(units)}))?" for field, units in _UNITS.items()}
_PATTERNS = [
    (re.compile(_BEFORE + pattern), field)
    for field, pattern in {
        "electrodes": r"(?:electrode_?data|electrodes?|elec|ele|biotac|e)_?(?P<n>\d+)"
        + _COUNTS
        + r"|(?:.*[_\d])?(?P<whole>electrode_?data|electrodes?)",
        "pac": r"pac(?:_?data)?_?(?P<n>\d*)" + _COUNTS,
        "pdc": r"pdc(?:_?data)?(?:_?0)?" + _COUNTS,
        "tdc": r"tdc(?:_?data)?(?:_?0)?" + _COUNTS,
        "tac": r"tac(?:_?data)?(?:_?0)?" + _COUNTS,
        "force": rf"(?:force_?|f_?)(?P<axis>[xyz]){_WRITTEN['force']}|(?:.*_)?(?P<whole>force)",
        "torque": rf"(?:torque_?|t_?|m_?)(?P<axis>[xyz]){_WRITTEN['torque']}|(?:.*_)?(?P<whole>torque)",
        "pos": rf"(?:position_?|pos_?|p_?)(?P<axis>[xyz]){_WRITTEN['pos']}"
        r"|(?:.*_)?(?P<whole>(?<!bt_)position|pos)",
        "quat": r"(?:orientation_?|quaternion_?|quat_?|rot_?|o_?|q_?)(?P<axis>[wxyz])"
        r"|(?:.*_)?(?P<whole>quaternion|quat)",
    }.items()
]
COUNTED = {"", "-", "count", "counts", "bit", "bits", "raw"}  # no unit, or counts
UNITS = {written: unit for units in _UNITS.values() for written, unit in units.items()}
_BRACKETED = re.compile(r"(.*[^\s_])[\s_]*[\[(]\s*(.*?)\s*[\])]\s*")
_CLOCK = re.compile(
    r"(?:(?:ros|rosbag|bag|system|host|unix|epoch|elapsed|log|date)_?)?(?:time_?stamp|times?|stamp)"
    r"(?:_?(?:s|secs?|seconds|ms|msecs?|us|usecs?|ns|nsecs?))?|t(?:_(?:s|ms|us|ns))?|secs?|seconds"
)


def is_time(name: str) -> bool:
    """Whether a column is the clock."""
    return _CLOCK.fullmatch(_plain(name)) is not None


def is_stamp(name: str) -> bool:
    """Whether a column is `field.header.stamp`, the sending time: used as the clock if there is no other."""
    return re.fullmatch(r"(.*_)?header_stamp", _plain(name)) is not None


def is_part_of_stamp(name: str) -> bool:
    """Whether a column is seconds, or nanoseconds, of a stamp, as in `header.stamp.nsecs`."""
    return re.fullmatch(r"(.*_)?(secs?|nsecs?|nanosecs?)", _plain(name)) is not None


@functools.cache
def place_of(name: str) -> Place | None:
    """Meaning of a column of this name, None if unknown.

    `e1`, `ele1`, `field.bt_data0.electrode_data0`, `F0Electrodes`, `pac22`, `Fx`, `wrench.force.x`, `posx`,
    `ow`, `object_pos_x`. Poses without a body are the sensor's; px py pz is the contact position.
    """
    plain = _plain(name)
    for pattern, field in _PATTERNS:
        found = pattern.fullmatch(plain)
        if not found:
            continue
        parts = found.groupdict()
        prefix = (parts["who"] or "").strip("_")
        if field in CHANNELS:
            number = parts.get("n")
            whole = parts.get("whole")
            if whole:
                prefix = plain[: -len(whole)].strip("_")
            return Place(prefix, field, int(number) if number else None)
        axis, whole = parts["axis"], parts["whole"]
        prefix = plain[: -len(whole)] if whole else prefix
        body, prefix = _split_body(prefix.strip("_"))
        if field in ("pos", "quat"):
            point = re.fullmatch(f"(.*_)?p[xyz]{_WRITTEN['pos']}", plain)
            field = f"{body or ('contact' if point else 'sensor')}_{field}"
            if field == "contact_quat":
                return None
        column = None if whole else (_QUATERNION if field.endswith("quat") else _AXES)[axis]
        return Place(prefix, field, column)
    place = place_of(found[1]) if (found := _BRACKETED.fullmatch(name)) else None
    return place if place and place.field == "electrodes" else None  # in whatever unit


def unit_of(name: str) -> tuple[str, float]:
    """Unit in the name of a column that `place_of` recognises, "" if none, and its size in N, Nm or m: ("mm",
    1e-3) for `object_pos_x [mm]`."""
    plain = _plain(name)
    found = next((f for pattern, _ in _PATTERNS if (f := pattern.fullmatch(plain))), None)
    unit = (found.groupdict().get("unit") if found else None) or ""
    return UNITS.get(unit, ("", 1.0))


def unit_named(unit: str) -> tuple[str, float]:
    """A unit of force, torque or position as written, and its size in N, Nm or m; ("", 1) for others."""
    words = {"newton": "N", "newtons": "N", "meter": "m", "metre": "m", "meters": "m", "metres": "m"}
    unit = words.get(unit.lower(), unit)
    return next((known for known in UNITS.values() if known[0] == unit), ("", 1.0))


def other_unit(name: str) -> str:
    """Unit in brackets in the name of an electrode, "" if none or counts.

    Raises:
      ValueError: the name of a force, torque or position has another unit in brackets than those known.
    """
    found = _BRACKETED.fullmatch(name)
    place, whole = (place_of(found[1]), place_of(name)) if found else (None, None)
    if place is None:
        return ""
    if place.field == "electrodes":
        return "" if found[2].lower() in COUNTED else found[2]
    units = _UNITS.get(place.field.rpartition("_")[2])
    if units and (whole is None or whole.field != place.field):
        known = ", ".join(dict.fromkeys(unit for unit, _ in units.values()))
        raise ValueError(
            f"column {name!r} has unit {found[2]}: {known} are known; convert the numbers and rename it"
        )
    return ""


def _split_body(prefix):
    """(body, remainder) of the prefix of a force or pose."""
    prefix = re.sub(r"(^|_)(wrench|pose|data|transform)(?=_|$)", "", prefix).strip("_")
    for body, pattern in _BODIES.items():
        remainder = re.sub(rf"(^|_)({pattern})(?=_|$)", "", prefix)
        if remainder != prefix:
            return body, remainder.strip("_")
    return "", prefix


def _plain(name):
    return re.sub(r"[\[\]. /:()\-]+", "_", name.strip().lower()).strip("_%#'\"")
