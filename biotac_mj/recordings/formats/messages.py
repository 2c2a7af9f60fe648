"""Messages of ROS, of a bag or a running topic, whatever their package calls them: leaves by name, then
columns."""

import numpy as np

from .names import place_of
from .parts import Part, make_parts

__all__ = ["Topic"]

_SKIPPED = ("header", "bt_time", "__msgtype__")


class Topic:
    """Messages of one topic as they come.

    Args:
      name: of the topic; its words count: `/object/pose` is the object's.
    """

    def __init__(self, name: str):
        self.name = name.strip("/").replace("/", "_")
        self.time, self._columns, self._kept = [], {}, 0

    def __len__(self):
        return self._kept

    def add(self, message: object, received: float) -> bool:
        """Keeps a message, received then [s]; its header's stamp counts where it has one. False: it holds
        nothing
        that is known."""
        leaves = {}
        _leaves(message, self.name, leaves, 0)
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

    def parts(self) -> list[Part]:
        """What was kept, in order of time.

        Raises:
          ValueError: messages of one topic that differ in shape.
        """
        order = np.argsort(self.time, kind="stable")
        try:
            columns = {name: np.array(value)[order] for name, value in self._columns.items()}
        except ValueError:
            raise ValueError(f"topic {self.name} has messages of different length: record it again") from None
        return make_parts(self.name, {"time": np.array(self.time)[order], **columns})


def _fields(message):
    """Names of a message's fields: rosbags' are dataclasses, ROS 1 and 2 have slots."""
    names = getattr(message, "__dataclass_fields__", None) or getattr(message, "__slots__", ())
    return [name.lstrip("_") for name in names if name not in _SKIPPED and not name.startswith("__")]


def _leaves(value, name, out, depth):
    """Numbers of a message by their path."""
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
        for i, one in enumerate(value):
            if _fields(one) == ["name", "values"]:  # a channel of sensor_msgs, as tactile_msgs has them
                _leaves(one.values, f"{name}_{one.name}", out, depth + 1)
            else:
                _leaves(one, f"{name}_{i}", out, depth + 1)
    elif hasattr(value, "typecode"):  # array.array, ROS 2's
        out[name] = np.asarray(value, float)
    else:
        for field in _fields(value):
            if field not in _SKIPPED:
                _leaves(getattr(value, field), f"{name}_{field}", out, depth + 1)


def _stamp(message):
    """[s] of a message's header, 0 without."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None:
        return 0
    seconds = getattr(stamp, "sec", getattr(stamp, "secs", 0))
    return seconds + 1e-9 * getattr(stamp, "nanosec", getattr(stamp, "nsecs", 0))
