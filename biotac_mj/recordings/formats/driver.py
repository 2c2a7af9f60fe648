"""Messages like those of a real sensor's driver, built from any library's classes: bags and running
topics."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ...geometry.design import Design
from ...sensor.channels import NELECTRODE, NPAC
from ..recording import Recording

FORMS = ("biotac_sensors", "tactile_msgs")
TOPICS = dict(zip(FORMS, ("biotac_pub", "tactile_states")))
# of a topic's messages
KINDS = {
    "biotac_pub": "biotac_sensors/msg/BioTacHand",
    "tactile_states": "tactile_msgs/msg/TactileState",
    "wrench": "geometry_msgs/msg/WrenchStamped",
    "object/pose": "geometry_msgs/msg/PoseStamped",
}


_CHANNELS = ("electrodes", "pac", "pdc", "tac", "tdc")


def check_form(form: str, design: Design) -> None:
    """Raises ValueError if messages of a form cannot hold a sensor's electrodes."""
    if form == FORMS[0] and design.nelectrode != NELECTRODE:
        raise ValueError(
            f"messages of {FORMS[0]} hold {NELECTRODE} electrodes, and this is a {design.title}: "
            f"take the form {FORMS[1]}"
        )


def row_of(values: Mapping[str, np.ndarray], name: str = "") -> dict[str, object]:
    """Argument of `Messages.of` for one sensor: its channels as uint16, and its name.

    Args:
      values: electrodes (nelectrode,), pac (npac,), scalars pdc, tac, tdc; counts. name: prefix of its
        channels in tactile_msgs.
    """
    counts = {channel: np.rint(values[channel]).astype(np.uint16) for channel in _CHANNELS}
    return {"name": name, **counts}


def rows_of(recording: Recording, form: str) -> dict[str, list]:
    """Arguments of `Messages.of` for each row of a recording: {topic: n values}.

    Args:
      form: of FORMS.

    Raises:
      ValueError: a channel without raw counts in every row.
    """
    lacks = [
        channel
        for channel in _CHANNELS
        if getattr(recording, channel) is None
        or recording.unit(channel) != "counts"
        or not np.isfinite(getattr(recording, channel)).all()
    ]
    if lacks:
        raise ValueError(
            f"{recording.name} has no raw counts of {', '.join(lacks)} in every row, and messages of the "
            "sensor hold all channels: export a recording that has them, such as the skin.h5 of a press"
        )
    check_form(form, recording.design)
    columns = zip(*(getattr(recording, channel) for channel in _CHANNELS))
    out = {TOPICS[form]: [[row_of(dict(zip(_CHANNELS, row)))] for row in columns]}
    if recording.force is not None:
        torque = np.zeros((len(recording), 3)) if recording.torque is None else recording.torque
        out["wrench"] = list(zip(recording.force, torque))
    if recording.object_pos is not None and recording.object_quat is not None:
        out["object/pose"] = list(zip(recording.object_pos, recording.object_quat))
    return out


class Messages:
    """Builds the message of row `i` at `time` [s].

    Args:
      build: (name, such as std_msgs/msg/Header, fields by name) -> message; the fields of a time are `sec`
        and `nanosec`.
      ros: 1 or 2. array: (values, dtype) -> array type of the message library.
    """

    def __init__(self, build: Callable[..., object], ros: int, array: Callable = np.asarray):
        self._of, self._ros, self._array = build, ros, array

    def of(self, topic: str, i: int, time: float, values: Sequence, frame: str = "biotac") -> object:
        """The message of a topic.

        Args:
          topic: of KINDS. values: a row of `rows_of`; for the sensors' own topic a list of `row_of`.
        """
        numbered = {"seq": i} if self._ros == 1 else {}
        header = self._of("std_msgs/msg/Header", **numbered, stamp=self.stamp(time), frame_id=frame)
        return getattr(self, "_" + topic.replace("/", "_"))(KINDS[topic], header, *values)

    def stamp(self, time: float) -> object:
        """A time [s] of ROS."""
        seconds, nanoseconds = divmod(round(1e9 * time), 10**9)
        return self._of("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)

    def _biotac_pub(self, name, header, *sensors):
        data = [
            self._of(
                "biotac_sensors/msg/BioTacData",
                bt_serial=one["name"].strip("_") or "simulated",
                bt_position=position,
                tdc_data=int(one["tdc"]),
                tac_data=int(one["tac"]),
                pdc_data=int(one["pdc"]),
                pac_data=self._array(one["pac"], np.uint16),
                electrode_data=self._array(one["electrodes"], np.uint16),
            )
            for position, one in enumerate(sensors, 1)
        ]
        clock = self._of(
            "biotac_sensors/msg/BioTacTime",
            frame_start_time=self._of("builtin_interfaces/msg/Time", sec=0, nanosec=0),
            frame_end_time=header.stamp,
            tdc_ns_offset=0,
            tac_ns_offset=0,
            pdc_ns_offset=0,
            pac_ns_offset=self._array(np.zeros(NPAC), np.uint32),
            electrode_ns_offset=self._array(np.zeros(NELECTRODE), np.uint32),
        )
        return self._of(name, header=header, hand_id="", bt_data=data, bt_time=clock)

    def _tactile_states(self, name, header, *sensors):
        channels = [
            self._of(
                "sensor_msgs/msg/ChannelFloat32",
                name=one["name"] + channel,
                values=self._array(np.atleast_1d(one[channel]), np.float32),
            )
            for one in sensors
            for channel in _CHANNELS
        ]
        return self._of(name, header=header, sensors=channels)

    def _wrench(self, name, header, force, torque):
        wrench = self._of("geometry_msgs/msg/Wrench", force=self._vector(force), torque=self._vector(torque))
        return self._of(name, header=header, wrench=wrench)

    def _object_pose(self, name, header, pos, quat):
        turn = dict(zip("wxyz", map(float, quat)))
        pose = self._of(
            "geometry_msgs/msg/Pose",
            position=self._vector(pos, "Point"),
            orientation=self._of("geometry_msgs/msg/Quaternion", **turn),
        )
        return self._of(name, header=header, pose=pose)

    def _vector(self, value, name="Vector3"):
        return self._of(f"geometry_msgs/msg/{name}", **dict(zip("xyz", map(float, value))))
