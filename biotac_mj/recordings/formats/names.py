"""What columns, variables and fields of messages are called in the wild, and what they are."""

import functools
import re
import typing

__all__ = ["Place", "is_time", "place_of"]


class Place(typing.NamedTuple):
    """Where a column belongs.

    sensor: what stands before its name, "" if nothing. field: of `recording.FIELDS`. column: its place in it,
    None for the whole; numbers of electrodes and PAC samples as they are written, from 0 or from 1.
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
_PATTERNS = [
    (re.compile(_BEFORE + pattern), field)
    for field, pattern in {
        "electrodes": r"(?:electrode_?data|electrodes?|elec|ele|e)_?(?P<n>\d+)"
        r"|(?:.*[_\d])?(?P<whole>electrode_?data|electrodes?)",
        "pac": r"pac(?:_?data)?_?(?P<n>\d*)",
        "pdc": r"pdc(?:_?data)?(?:_?0)?",
        "tdc": r"tdc(?:_?data)?(?:_?0)?",
        "tac": r"tac(?:_?data)?(?:_?0)?",
        "force": r"(?:force_?|f_?)(?P<axis>[xyz])(?:_?n)?|(?:.*_)?(?P<whole>force)",
        "torque": r"(?:torque_?|t_?|m_?)(?P<axis>[xyz])(?:_?nm)?|(?:.*_)?(?P<whole>torque)",
        "pos": r"(?:position_?|pos_?|p_?)(?P<axis>[xyz])(?:_?m)?|(?:.*_)?(?P<whole>(?<!bt_)position|pos)",
        "quat": r"(?:orientation_?|quaternion_?|quat_?|rot_?|o_?|q_?)(?P<axis>[wxyz])"
        r"|(?:.*_)?(?P<whole>quaternion|quat)",
    }.items()
]
_CHANNELS = ("electrodes", "pac", "pdc", "tdc", "tac")


def is_time(name: str) -> bool:
    """Whether a column is the clock."""
    return (
        re.fullmatch(r"(time|times|timestamp|t|stamp|secs?|seconds)(_?\[?(s|ms|us|ns)\]?)?", _plain(name))
        is not None
    )


@functools.cache
def place_of(name: str) -> Place | None:
    """Where a column of this name belongs, None if nowhere.

    `e1`, `ele1`, `field.bt_data0.electrode_data0`, `F0Electrodes`, `pac22`, `Fx`, `wrench.force.x`,
    `posx`, `ow`,
    `object_pos_x`. Poses without a body are the sensor's; px py pz are where it touches.
    """
    plain = _plain(name)
    for pattern, field in _PATTERNS:
        found = pattern.fullmatch(plain)
        if not found:
            continue
        parts = found.groupdict()
        who = (parts["who"] or "").strip("_")
        if field in _CHANNELS:
            number = parts.get("n")
            whole = parts.get("whole")
            if whole:
                who = plain[: -len(whole)].strip("_")
            return Place(who, field, int(number) if number else None)
        axis, whole = parts["axis"], parts["whole"]
        who = plain[: -len(whole)] if whole else who
        body, who = _body(who.strip("_"))
        if field in ("pos", "quat"):
            point = plain in ("px", "py", "pz")
            field = f"{'contact' if point else body or 'sensor'}_{field}"
            if field == "contact_quat":
                return None
        column = None if whole else (_QUATERNION if field.endswith("quat") else _AXES)[axis]
        return Place(who, field, column)
    return None


def _body(who):
    """(body, what is left) of what stands before a force or pose."""
    who = re.sub(r"(^|_)(wrench|pose|data|transform)(?=_|$)", "", who).strip("_")
    for body, pattern in _BODIES.items():
        left = re.sub(rf"(^|_)({pattern})(?=_|$)", "", who)
        if left != who:
            return body, left.strip("_")
    return "", who


def _plain(name):
    return re.sub(r"[\[\]. /:()\-]+", "_", name.strip().lower()).strip("_%#'\"")
