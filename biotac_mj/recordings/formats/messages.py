"""ROS messages of any package, from a bag or a running topic: fields by name, then columns."""

import numpy as np

from ..recording import CHANNELS
from .names import place_of
from .streams import Stream, make_streams

_SKIPPED = ("header", "bt_time", "__msgtype__")
# fields whose positions and orientations are not a sensor's: of joints and inertial units
_OTHER_POSES = {"effort", "orientation_covariance"}


class Topic:
    """Messages of one topic, collected.

    Args:
      name: of the topic; its words count: `/object/pose` is the object's.
    """

    def __init__(self, name: str):
        self.name = name.strip("/").replace("/", "_")
        self.time, self._columns, self._kept = [], {}, 0
        self._places = {}  # name of a list -> {sensor id of its element: number}

    def __len__(self):
        return self._kept

    def add(self, message: object, received: float) -> bool:
        """Stores a message, received at that time [s]; the stamp of its header has precedence. False: nothing
        in it is recognised."""
        leaves = {}
        if _OTHER_POSES.isdisjoint(_fields(message)):
            self._leaves(message, self.name, leaves, 0)
        leaves = {name: value for name, value in leaves.items() if place_of(name)}
        if not leaves:
            return False
        for name, value in leaves.items():
            self._columns.setdefault(name, [np.full_like(value, np.nan)] * self._kept).append(value)
        self._kept += 1
        for column in self._columns.values():
            if len(column) < self._kept:
                column.append(np.full_like(column[-1], np.nan))
        self.time.append(_stamp(message) or received)
        return True

    def streams(self) -> list[Stream]:
        """Collected data, in order of time.

        Raises:
          ValueError: messages of one topic differ in shape.
        """
        order = np.argsort(self.time, kind="stable")
        try:
            columns = {name: np.array(value)[order] for name, value in self._columns.items()}
        except ValueError:
            raise ValueError(f"topic {self.name} has messages of different length: record it again") from None
        streams = make_streams(self.name, {"time": np.array(self.time)[order], **columns})
        for name, places in self._places.items():
            for (serial, _), k in places.items():
                for stream in streams:
                    if stream.sensor == _joined(name, k).lower():
                        stream.called = serial
        return streams

    @property
    def has_channels(self) -> bool:
        """Whether it has channels of a sensor."""
        return any(place_of(name).field in CHANNELS for name in self._columns)

    def _leaves(self, value, name, out, depth):
        """Collects the numbers of a message by their path."""
        if depth > 8:
            return
        if isinstance(value, bool | int | float | np.number):
            out[name] = np.float64(value)
        elif isinstance(value, bytes | bytearray):
            out[name] = np.frombuffer(value, np.uint8).astype(float)
        elif isinstance(value, np.ndarray) or (
            isinstance(value, list | tuple) and value and np.isscalar(value[0])
        ):
            if np.asarray(value).dtype.kind in "fiu":
                out[name] = np.asarray(value, float)
        elif isinstance(value, list | tuple):
            if len(value) > 1 and {"position", "orientation"} <= set(_fields(value[0])):
                return  # several poses: their objects are unknown
            for one, k in zip(value, self._numbers(name, value)):
                if _fields(one) == ["name", "values"]:  # a channel of sensor_msgs, as in tactile_msgs
                    self._leaves(one.values, _joined(name, one.name), out, depth + 1)
                else:
                    self._leaves(one, _joined(name, k), out, depth + 1)
        elif hasattr(value, "typecode"):  # array.array, ROS 2's
            out[name] = np.asarray(value, float)
        else:
            for field in _fields(value):
                if field not in _SKIPPED:
                    self._leaves(getattr(value, field), _joined(name, field), out, depth + 1)

    def _numbers(self, name, value):
        """Numbers of a list's elements. An element that names its sensor keeps its number at any index,
        because drivers omit sensors that do not answer."""
        which = [(str(getattr(one, "bt_serial", "")), getattr(one, "bt_position", None)) for one in value]
        if (None in [position for _, position in which]) or len(set(which)) < len(which):
            return range(len(value))
        places = self._places.setdefault(name, {})
        return [places.setdefault(one, len(places)) for one in which]


def _joined(name, more):
    return f"{name}_{more}"


def _fields(message):
    """Names of a message's fields: rosbags uses dataclasses, ROS 1 and 2 slots."""
    names = getattr(message, "__dataclass_fields__", None) or getattr(message, "__slots__", ())
    return [name.lstrip("_") for name in names if name not in _SKIPPED and not name.startswith("__")]


def _stamp(message):
    """[s] of a message's header, 0 without."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None:
        return 0
    seconds = getattr(stamp, "sec", getattr(stamp, "secs", 0))
    return seconds + 1e-9 * getattr(stamp, "nanosec", getattr(stamp, "nsecs", 0))
