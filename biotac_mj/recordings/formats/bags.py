"""Reads and writes bags of ROS 1 and 2 without ROS, through the library rosbags."""

import os
import pathlib
import tempfile

from ...files import refuse_existing
from ...reading import reading
from ..recording import Recording
from .driver import FORMS, KINDS, Messages, rows_of
from .messages import Topic
from .streams import Stream

_MARKS = (b"#ROSBAG V", b"\x89MCAP", b"SQLite format 3")
_REMEDY = "give a .bag of ROS 1, the folder of a ROS 2 bag, or its .mcap or .db3 file; copy a cut one again"
# definitions of biotac_sensors and tactile_msgs, which ROS does not include
DEFINITIONS = {
    "biotac_sensors/msg/BioTacData": "string bt_serial\nuint16 bt_position\nuint16 tdc_data\nuint16 "
    "tac_data\nuint16 pdc_data\nuint16[22] pac_data\nuint16[19] electrode_data\n",
    "biotac_sensors/msg/BioTacTime": "builtin_interfaces/Time frame_start_time\nbuiltin_interfaces/Time "
    "frame_end_time\nuint32 tdc_ns_offset\nuint32 tac_ns_offset\nuint32 pdc_ns_offset\nuint32[22] "
    "pac_ns_offset\nuint32[19] electrode_ns_offset\n",
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


def _library(path, store):
    """Message types of one of rosbags' stores with those of DEFINITIONS, its reader, and writers for ROS 1
    and 2.

    Raises:
      ValueError: rosbags is not installed."""
    try:
        from rosbags import highlevel, rosbag1, rosbag2, typesys
    except ImportError:
        raise ValueError(f"{path} is a bag of ROS: it needs pip install 'biotac-mj[ros]'") from None
    types = typesys.get_typestore(typesys.Stores[store])
    for name, text in DEFINITIONS.items():
        types.register(typesys.get_types_from_msg(text, name))
    return types, highlevel.AnyReader, (rosbag1.Writer, rosbag2.Writer)


def read_bag(path: pathlib.Path) -> list[Stream]:
    """Streams of all topics with recognised content.

    Raises:
      ValueError: rosbags is not installed, the bag is damaged, or nothing is recognised; the text lists the
        topics.
    """
    types, reader, _ = _library(path, "LATEST")
    topics, seen = {}, []
    with reading(path / "metadata.yaml" if path.is_dir() else path, "bag of ROS", _REMEDY):
        with reader([path], default_typestore=types) as bag:
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
    streams, kept = [], set()
    for name, topic in topics.items():
        if len(topic):
            try:
                streams += topic.streams()
                kept.add(name)
            except ValueError:
                if topic.has_channels:
                    raise
    if not streams:
        raise ValueError(f"{path} has no topic of a BioTac: it has {', '.join(seen) or 'none at all'}")
    unused = [name for name in seen if name.split(" ")[0] not in kept]
    for stream in streams:
        stream.notes = [f"{path.name}: topic {stream.source}", *stream.notes]
        stream.notes += [f"{path.name}: left out {', '.join(unused)}"] if unused else []
        stream.source = path.name
    return streams


def write_bag(
    path: pathlib.Path | str, recording: Recording, ros: int = 2, form: str = "biotac_sensors"
) -> list[str]:
    """Writes a recording as a bag like a driver of the real sensor does, one message per row.

    Topics: biotac_pub (biotac_sensors/BioTacHand), or tactile_states (tactile_msgs/TactileState, one channel
    for each of the sensor's); wrench (geometry_msgs/WrenchStamped) and object/pose
    (geometry_msgs/PoseStamped) if the recording has them.

    Args:
      path: of the .bag, or of a new folder for a ROS 2 bag (SQLite).
      ros: 1 or 2. form: of FORMS.

    Returns:
      the topics.

    Raises:
      ValueError: rosbags is not installed, the folder exists, or a raw channel of the sensor is missing.
    """
    path = pathlib.Path(path)
    if ros not in (1, 2) or form not in FORMS:
        raise ValueError(f"ros is {ros} and form {form!r}: choose 1 or 2, and one of {', '.join(FORMS)}")
    refuse_existing(path)
    rows = rows_of(recording, form)
    types, _, writers = _library(path, "ROS1_NOETIC" if ros == 1 else "ROS2_HUMBLE")
    make = Messages(lambda name, /, **fields: types.types[name](**fields), ros)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:  # whole or not at all
        made = pathlib.Path(folder) / path.name
        writer = writers[0](made) if ros == 1 else writers[1](made, version=8)
        serialize = types.serialize_ros1 if ros == 1 else types.serialize_cdr
        with writer:
            places = {
                topic: writer.add_connection(f"/{topic}", KINDS[topic], typestore=types) for topic in rows
            }
            for i, time in enumerate(recording.time):
                for topic, values in rows.items():
                    message = make.of(topic, i, time, values[i])
                    writer.write(places[topic], round(1e9 * time), serialize(message, KINDS[topic]))
        os.replace(made, path)
    return [f"/{topic}" for topic in rows]
