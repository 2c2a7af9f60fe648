"""Bags of ROS 1 and 2, read without ROS by the library rosbags."""

import pathlib

from ..reading import reading
from .messages import Topic
from .parts import Part

__all__ = ["DEFINITIONS", "is_bag", "read_bag"]

_MARKS = (b"#ROSBAG V", b"\x89MCAP", b"SQLite format 3")
_REMEDY = "give a .bag of ROS 1, the folder of a ROS 2 bag, or its .mcap or .db3 file; copy a cut one again"
# biotac_sensors' messages, for ROS 2 bags that do not carry their definitions
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
