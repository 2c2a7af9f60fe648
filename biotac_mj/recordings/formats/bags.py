"""Bags of ROS 1 and 2, read and written without ROS by the library rosbags."""

import os
import pathlib
import tempfile
import typing

import numpy as np

from ...reading import reading
from ...sensor.channels import NELECTRODE, NPAC
from ..recording import Recording
from .messages import Topic
from .parts import Part

if typing.TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

__all__ = ["DEFINITIONS", "FORMS", "is_bag", "read_bag", "write_bag"]

FORMS = ("biotac_sensors", "tactile_msgs")

_MARKS = (b"#ROSBAG V", b"\x89MCAP", b"SQLite format 3")
_REMEDY = "give a .bag of ROS 1, the folder of a ROS 2 bag, or its .mcap or .db3 file; copy a cut one again"
# messages of biotac_sensors and tactile_msgs, which ROS does not bring
DEFINITIONS = {
    "biotac_sensors/msg/BioTacData": "string bt_serial\nuint16 bt_position\nuint16 tdc_data\nuint16 "
    "tac_data\n"
    "uint16 pdc_data\nuint16[22] pac_data\nuint16[19] electrode_data\n",
    "biotac_sensors/msg/BioTacTime": "builtin_interfaces/Time frame_start_time\nbuiltin_interfaces/Time "
    "frame_end_time\nuint32 tdc_ns_offset\nuint32 tac_ns_offset\nuint32 pdc_ns_offset\nuint32[22] "
    "pac_ns_offset\n"
    "uint32[19] electrode_ns_offset\n",
    "biotac_sensors/msg/BioTacHand": "std_msgs/Header header\nstring hand_id\nBioTacData[] bt_data\n"
    "BioTacTime bt_time\n",
    "tactile_msgs/msg/TactileState": "std_msgs/Header header\nsensor_msgs/ChannelFloat32[] sensors\n",
}


def is_bag(path: pathlib.Path) -> bool:
    """Whether a path is a bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        return file.read(16).startswith(_MARKS)


def read_bag(path: pathlib.Path) -> list[Part]:
    """Parts of all topics that hold something known.

    Raises:
      ValueError: rosbags is not installed, a damaged bag, or nothing in it is known; the text says what
      topics
        there are.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise ValueError(f"{path} is a bag of ROS: reading it needs pip install 'biotac-mj[ros]'") from None
    types = get_typestore(Stores.LATEST)
    for name, text in DEFINITIONS.items():
        types.register(get_types_from_msg(text, name))
    topics, seen = {}, []
    with reading(path / "metadata.yaml" if path.is_dir() else path, "bag of ROS", _REMEDY):
        with AnyReader([path], default_typestore=types) as bag:
            seen = sorted({f"{one.topic} ({one.msgtype})" for one in bag.connections})
            useless = set()
            for connection, received, raw in bag.messages():
                if connection.topic in useless:
                    continue
                topic = topics.setdefault(connection.topic, Topic(connection.topic))
                if not topic.add(bag.deserialize(raw, connection.msgtype), 1e-9 * received) and not len(
                    topic
                ):
                    useless.add(connection.topic)
    parts = [part for topic in topics.values() if len(topic) for part in topic.parts()]
    if not parts:
        raise ValueError(f"{path} has no topic of a BioTac: it has {', '.join(seen) or 'none at all'}")
    left = [name for name in seen if not len(topics.get(name.split(" ")[0], ()))]
    for part in parts:
        part.notes = [f"{path.name}: topic {part.source}", *part.notes]
        part.notes += [f"{path.name}: left out {', '.join(left)}"] if left else []
        part.source = path.name
    return parts


def write_bag(
    path: pathlib.Path | str, recording: Recording, ros: int = 2, form: str = "biotac_sensors"
) -> list[str]:
    """Writes a recording as a bag, such as a driver of the real sensor fills, a message for each row.

    Topics: biotac_pub (biotac_sensors/BioTacHand), or tactile_states (tactile_msgs/TactileState, one of its
    channels for each of the sensor's); wrench (geometry_msgs/WrenchStamped) and object/pose
    (geometry_msgs/PoseStamped) where the recording has them.

    Args:
      path: of the .bag, or of the folder of a ROS 2 bag (SQLite), which must not be there.
      ros: 1 or 2. form: of FORMS.

    Returns:
      the topics.

    Raises:
      ValueError: rosbags is not installed, the folder is there, or the recording has not all raw counts that
        the sensor sends.
    """
    try:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise ValueError(f"{path} is to be a bag of ROS: it needs pip install 'biotac-mj[ros]'") from None
    path = pathlib.Path(path)
    if ros not in (1, 2) or form not in FORMS:
        raise ValueError(f"ros is {ros} and form {form!r}: choose 1 or 2, and one of {', '.join(FORMS)}")
    if ros == 2 and path.exists():
        raise ValueError(f"{path} is there already: a bag of ROS 2 is a new folder, choose another name")
    counts = _all_counts(recording)
    types = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        types.register(get_types_from_msg(text, name))
    make = _Messages(types, ros)
    rows = {("biotac_pub" if form == FORMS[0] else "tactile_states"): getattr(make, form)}
    values, n = [counts], len(recording)
    if recording.force is not None:
        rows["wrench"] = make.wrench
        values.append([recording.force, np.zeros((n, 3)) if recording.torque is None else recording.torque])
    if recording.object_pos is not None and recording.object_quat is not None:
        rows["object/pose"] = make.pose
        values.append([recording.object_pos, recording.object_quat])
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:  # whole or not at all
        made = pathlib.Path(folder) / path.name
        writer = Writer1(made) if ros == 1 else Writer2(made, version=8)
        serialize = types.serialize_ros1 if ros == 1 else types.serialize_cdr
        with writer:
            places = {}
            for i, time in enumerate(recording.time):
                for (topic, kind), columns in zip(rows.items(), values):
                    message = kind(i, time, *(column[i] for column in columns))
                    name = message.__msgtype__
                    if topic not in places:
                        places[topic] = writer.add_connection(f"/{topic}", name, typestore=types)
                    writer.write(places[topic], round(1e9 * time), serialize(message, name))
        os.replace(made, path)
    return [f"/{topic}" for topic in rows]


def _all_counts(recording):
    """electrodes (n, 19), pac (n, 22), pdc, tac, tdc (n,) as uint16."""
    wanted = ("electrodes", "pac", "pdc", "tac", "tdc")
    lacks = [
        name
        for name in wanted
        if getattr(recording, name) is None
        or recording.unit(name) != "counts"
        or not np.isfinite(getattr(recording, name)).all()
    ]
    if lacks:
        raise ValueError(
            f"{recording.name} has no raw counts of {', '.join(lacks)} in every row, and messages of the "
            "sensor hold all channels: export a recording that has them, such as the skin.h5 of a press"
        )
    return [np.rint(getattr(recording, name)).astype(np.uint16) for name in wanted]


class _Messages:
    """Makes messages of row `i` at `time` [s]."""

    def __init__(self, types: "Typestore", ros: int):
        self._kinds, self._ros = types.types, ros

    def _of(self, name, *fields):
        return self._kinds[name](*fields)

    def _header(self, i, time):
        nanoseconds = round(1e9 * time)
        stamp = self._of("builtin_interfaces/msg/Time", *divmod(nanoseconds, 10**9))
        return self._of("std_msgs/msg/Header", *([i] if self._ros == 1 else []), stamp, "biotac")

    def biotac_sensors(self, i, time, electrodes, pac, pdc, tac, tdc):
        channels = [int(tdc), int(tac), int(pdc), pac, electrodes]
        data = self._of("biotac_sensors/msg/BioTacData", "simulated", 1, *channels)
        begin, header = self._of("builtin_interfaces/msg/Time", 0, 0), self._header(i, time)
        offsets = [0, 0, 0, np.zeros(NPAC, np.uint32), np.zeros(NELECTRODE, np.uint32)]
        clock = self._of("biotac_sensors/msg/BioTacTime", begin, header.stamp, *offsets)
        return self._of("biotac_sensors/msg/BioTacHand", header, "", [data], clock)

    def tactile_msgs(self, i, time, electrodes, pac, pdc, tac, tdc):
        named = dict(electrodes=electrodes, pac=pac, pdc=[pdc], tac=[tac], tdc=[tdc])
        channels = [
            self._of("sensor_msgs/msg/ChannelFloat32", name, np.asarray(value, np.float32))
            for name, value in named.items()
        ]
        return self._of("tactile_msgs/msg/TactileState", self._header(i, time), channels)

    def wrench(self, i, time, force, torque):
        vectors = [self._of("geometry_msgs/msg/Vector3", *map(float, v)) for v in (force, torque)]
        return self._of(
            "geometry_msgs/msg/WrenchStamped",
            self._header(i, time),
            self._of("geometry_msgs/msg/Wrench", *vectors),
        )

    def pose(self, i, time, pos, quat):
        point = self._of("geometry_msgs/msg/Point", *map(float, pos))
        turn = self._of("geometry_msgs/msg/Quaternion", *map(float, np.roll(quat, -1)))
        return self._of(
            "geometry_msgs/msg/PoseStamped",
            self._header(i, time),
            self._of("geometry_msgs/msg/Pose", point, turn),
        )
