"""Publishes a running simulation on ROS topics like a driver of the real sensor, with rclpy (ROS 2) or
rospy."""

import atexit
import importlib
import importlib.util
import re
import typing
from collections.abc import Callable, Mapping

import mujoco
import numpy as np

from ..coupling import Handle, handles
from ..recordings.formats.driver import FORMS, TOPICS, Messages, check_form, row_of
from ..recordings.simulated import force_on_object

if typing.TYPE_CHECKING:
    from typing import Self

__all__ = ["Publisher"]

_CLOCK = "rosgraph_msgs/msg/Clock"
_EARLY = 1e-3  # of a period: tolerance of a row's due time, for rounding errors of summed time steps
_QUEUE = 10  # messages that wait for a slow subscriber


class Publisher:
    """Publishes readings of a simulation's BioTacs, one message for each row of a real sensor.

    Messages and topics are those of `recordings.write_bag`: /biotac_pub (biotac_sensors/BioTacHand, whose
    `bt_data` has all BioTacs in order) or /tactile_states (tactile_msgs/TactileState); /wrench
    (geometry_msgs/WrenchStamped, on what touches); /object/pose (geometry_msgs/PoseStamped). Wrench and pose
    are in the BioTac frame. Stamps are simulation time. With several BioTacs each has its own /ff/wrench and
    /ff/object/pose, and its channels in tactile_msgs are named ff_electrodes etc.

        with Publisher(model) as publisher:
            while data.time < 10:
                mujoco.mj_step(model, data)
                publisher.publish(data)

    Args:
      model: the compiled MjModel.
      fingers: {name: Handle}, as from `attach_to_hand`; None: all of the model, by `biotac_mj.handles`.
      form: "biotac_sensors" or "tactile_msgs".
      object: name of the body whose pose is published; None: none.
      rate: messages per second of simulated time [Hz].
      clock: publish the time on /clock with each call, for nodes with `use_sim_time`.
      node: an rclpy node; None: a new one called biotac. ROS 1 has one node per process: an existing one is
        used.

    Raises:
      ValueError: ROS' library or a package of messages is missing or has other fields; an invalid form, rate,
        name or body; a model without BioTac. TypeError: model is no MjModel.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        fingers: Mapping[str, Handle] | None = None,
        form: str = "biotac_sensors",
        object: str | None = None,
        rate: float = 100.0,
        clock: bool = False,
        node: typing.Any = None,
    ):
        found = handles(model)
        if form not in FORMS or not isinstance(rate, (int, float)) or not 0 < rate < np.inf:
            raise ValueError(f"form is {form!r} and rate {rate}: choose one of {', '.join(FORMS)}, and Hz")
        if fingers is not None and not isinstance(fingers, Mapping):
            raise ValueError("fingers are a dict of handles by their names in the topics")
        if object is not None and not isinstance(object, str):
            raise ValueError(f"object is {object!r}: name the body whose pose is to be published")
        if object is not None and mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, object) < 0:
            raise ValueError(f"the model has no body {object!r}: name the one whose pose is to be published")
        self._fingers = _named(found if fingers is None else fingers)
        for handle in self._fingers.values():
            check_form(form, handle.design)
        self._form, self._object, self._rate = form, object, float(rate)
        self._row = self._sent = 0
        self._ros = _library()
        self._make = Messages(self._ros.build, self._ros.version, _as_list)
        empty = [
            {channel: np.zeros(width) for channel, width in _widths(handle).items()}
            for handle in self._fingers.values()
        ]
        pose = None if object is None else (np.zeros(3), np.eye(4)[0])
        sent = self._messages(0.0, [(read, pose) for read in empty])  # reports incompatible messages early
        if clock:
            self._ros.build(_CLOCK)
        self._ros.start(node)
        self._send = {
            f"/{topic}": self._ros.advertise(f"/{topic}", type(message)) for topic, message in sent.items()
        }
        self._clock = self._ros.advertise("/clock", self._ros.kind(_CLOCK)) if clock else None

    @property
    def topics(self) -> list[str]:
        """Names of its topics, without /clock; none after `close`."""
        return list(self._send)

    def publish(self, data: mujoco.MjData) -> bool:
        """Publishes a row if one is due; call it after every step.

        Rows are due at multiples of 1 / rate of `data.time`, except 0. The first call at or after that time
        sends one; missed rows are skipped. Time may go back at a reset.

        Returns:
          whether a row was published.

        Raises:
          ValueError: data of another model, readings that are not finite, as after an error, or a closed
            publisher. TypeError: data is no MjData.
        """
        if not self._send:
            raise ValueError("this Publisher is closed: make another one")
        reads = [(handle.read(data), self._pose(data, handle)) for handle in self._due(data)]
        if self._clock:
            self._clock(self._ros.build(_CLOCK, clock=self._make.stamp(data.time)))
        if not reads:
            return False
        for topic, message in self._messages(data.time, reads).items():
            self._send[f"/{topic}"](message)
        self._sent += 1
        return True

    def close(self) -> None:
        """Ends its topics, and its node and ROS 2 if it started them."""
        if self._send:
            self._send = {}
            self._ros.close()

    def __enter__(self) -> "Self":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _due(self, data):
        """Handles that are due."""
        if not hasattr(data, "sensordata"):
            raise TypeError(f"data is {type(data).__name__}: pass the MjData that is stepped")
        last, self._row = self._row, int(np.floor(data.time * self._rate + _EARLY))
        return [] if self._row in (0, last) else self._fingers.values()

    def _pose(self, data, handle):
        """pos (3,), quat (4,) of the object in the BioTac frame."""
        if self._object is None:
            return None
        core, thing = data.body(handle.body), data.body(self._object)
        back, quat = np.empty(4), np.empty(4)
        mujoco.mju_negQuat(back, core.xquat)
        mujoco.mju_mulQuat(quat, back, thing.xquat)
        pos = core.xmat.reshape(3, 3).T @ (thing.xpos - core.xpos)
        return pos, quat

    def _messages(self, time, reads):
        """{topic: message} of one row, from (readings of a Handle, pose) of each finger."""
        single, own, sensors, others = len(reads) == 1, TOPICS[self._form], [], {}
        for name, (read, pose) in zip(self._fingers, reads):
            for channel, width in _widths(self._fingers[name]).items():
                if not (read[channel].size == width and np.isfinite(read[channel]).all()):
                    raise ValueError(
                        f"{name}'s {channel} at {time:g} s is {read[channel]}: it cannot be sent"
                    )
            counts = {channel: value if value.size > 1 else value[0] for channel, value in read.items()}
            sensors.append(row_of(counts, "" if single else f"{name}_"))
            rows = {"wrench": (force_on_object(read["contact_force"]), np.zeros(3))}
            rows |= {} if pose is None else {"object/pose": pose}
            for topic, values in rows.items():
                place, frame = (topic, "biotac") if single else (f"{name}/{topic}", name)
                others[place] = self._make.of(topic, self._sent, time, values, frame)
        return {own: self._make.of(own, self._sent, time, sensors)} | others


def _widths(handle):
    return {**handle.design.widths, "contact_force": 6}


def _named(fingers):
    """{name that is valid in a ROS topic: Handle}."""
    out = {}
    for name, handle in fingers.items():
        word = re.sub(r"[^0-9A-Za-z]+", "_", str(name)).strip("_")
        word = word if word[:1].isalpha() else f"biotac_{word}".rstrip("_")
        if word in out:
            raise ValueError(f"two BioTacs are called {word} in ROS: pass fingers={{name: handle}}")
        out[word] = handle
    if not out:
        raise ValueError("no BioTac to publish: pass a model with one, or fingers={name: handle}")
    return out


def _as_list(values, dtype):
    """rclpy and rospy require Python numbers."""
    return np.asarray(values, dtype).tolist()


def _library():
    for name, ros in (("rclpy", _Ros2), ("rospy", _Ros1)):
        if importlib.util.find_spec(name):
            try:
                return ros(importlib.import_module(name))
            except ImportError as error:
                raise ValueError(
                    f"{name} is here and cannot be imported ({error}): run the Python that ROS was built for"
                ) from None
    raise ValueError(
        "publishing needs ROS' Python library, rclpy or rospy: source your ROS installation's setup.bash "
        "first, or write a bag with biotac_mj.recordings.write_bag"
    )


class _Ros:
    """Common to ROS 1 and 2: a package's messages by their ROS 2 names."""

    def __init__(self, library):
        self._library, self._kinds = library, {}

    def kind(self, name: str) -> type:
        """Class of a message, by its name, such as std_msgs/msg/Header."""
        if name not in self._kinds:
            package, _, kind = name.split("/")
            try:
                self._kinds[name] = getattr(importlib.import_module(f"{package}.msg"), kind)
            except (ImportError, AttributeError) as error:
                raise ValueError(
                    f"ROS has no {package}/{kind} here ({error}): build the package {package} in your "
                    "workspace and source its setup.bash"
                ) from None
        return self._kinds[name]

    def build(self, name: str, /, **fields: object) -> object:
        """A message with these fields, which it must have."""
        message = self.kind(name)()
        for field, value in fields.items():
            try:
                getattr(message, field)
                setattr(message, field, value)
            except (AttributeError, AssertionError) as error:
                raise ValueError(
                    f"{name} as ROS has it here takes no {field} as the driver's has ({error}): build the "
                    "package that your software for the real sensor uses"
                ) from None
        return message


class _Ros2(_Ros):
    version = 2

    def start(self, node: typing.Any) -> None:
        self._started = node is None and not self._library.ok()
        if self._started:
            self._library.init()
        self._made, self._topics = node is None, []
        self._node = self._library.create_node("biotac") if node is None else node

    def advertise(self, topic: str, kind: type) -> Callable[[object], None]:
        self._topics.append(self._node.create_publisher(kind, topic, _QUEUE))
        return self._topics[-1].publish

    def close(self) -> None:
        for topic in self._topics:
            self._node.destroy_publisher(topic)
        if self._made:
            self._node.destroy_node()
        if self._started and self._library.ok():  # Ctrl-C also ends it
            self._library.shutdown()


class _Ros1(_Ros):
    version = 1

    def build(self, name: str, /, **fields: object) -> object:
        if name == "builtin_interfaces/msg/Time":  # no message in ROS 1
            return self._library.Time(fields["sec"], fields["nanosec"])
        return super().build(name, **fields)

    def start(self, node: typing.Any) -> None:
        if node is not None:
            raise ValueError(
                "node is rclpy's, and ROS 1 is here: call rospy.init_node yourself, or leave it out"
            )
        if not self._library.core.is_initialized():
            self._library.init_node("biotac", anonymous=True, disable_signals=True)
            # ROS 1 cannot be started twice in a process
            atexit.register(self._library.signal_shutdown, "the simulation has ended")
        self._topics = []

    def advertise(self, topic: str, kind: type) -> Callable[[object], None]:
        self._topics.append(self._library.Publisher(topic, kind, queue_size=_QUEUE))
        return self._topics[-1].publish

    def close(self) -> None:
        for topic in self._topics:
            topic.unregister()
