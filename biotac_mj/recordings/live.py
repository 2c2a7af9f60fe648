"""Recording while the sensor runs: topics of ROS 1 or 2, or lines from a serial port."""

import importlib
import pathlib
import time as clock
from collections.abc import Iterable

from ..geometry.design import BIOTAC, design_of_channels
from .formats.columns import parse_table
from .formats.joining import join
from .formats.messages import Topic
from .formats.streams import make_streams
from .recording import Recording


def record_topics(topics: list[str], seconds: float, object_name: str | None = None) -> list[Recording]:
    """Recordings of running topics.

    Raises:
      ValueError: neither ROS 1 nor ROS 2 is available, a topic without a publisher, or no message arrived.
    """
    listen = _ros2 if _is_here("rclpy") else _ros1 if _is_here("rospy") else None
    if listen is None:
        raise ValueError(
            "--topic needs ROS' Python library, rclpy or rospy: source your ROS installation's setup.bash "
            "first, or record a bag and give it to `biotac recording import`"
        )
    found = {name: Topic(name) for name in topics}
    listen(found, seconds)
    silent = [name for name, topic in found.items() if not len(topic)]
    if silent:
        raise ValueError(
            f"nothing of a BioTac came on {', '.join(silent)} in {seconds:g} s: is it published?"
        )
    return join([stream for topic in found.values() for stream in topic.streams()], object_name=object_name)


def _is_here(module):
    return importlib.util.find_spec(module) is not None


def _ros2(topics, seconds):
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from rosidl_runtime_py.utilities import get_message

    rclpy.init()
    node = rclpy.create_node("biotac_record")
    try:
        waiting, end = dict(topics), clock.monotonic() + seconds
        while clock.monotonic() < end:
            kinds = dict(node.get_topic_names_and_types()) if waiting else {}
            for name in [name for name in waiting if name in kinds]:
                topic = waiting.pop(name)
                node.create_subscription(
                    get_message(kinds[name][0]),
                    name,
                    lambda message, topic=topic: topic.add(message, clock.time()),
                    qos_profile_sensor_data,
                )
            rclpy.spin_once(node, timeout_sec=0.05)
    finally:
        node.destroy_node()
        rclpy.shutdown()


def _ros1(topics, seconds):
    import roslib.message
    import rospy

    rospy.init_node("biotac_record", anonymous=True, disable_signals=True)

    def add(raw, topic):  # bytes, with the name of their type
        kind = roslib.message.get_message_class(raw._connection_header["type"])
        topic.add(kind().deserialize(raw._buff), clock.time())

    waiting = [
        rospy.Subscriber(name, rospy.AnyMsg, add, callback_args=topic, queue_size=1000)
        for name, topic in topics.items()
    ]
    clock.sleep(seconds)
    for one in waiting:
        one.unregister()


def record_serial(
    port: str, baud: int, seconds: float, columns: list[str] | None = None, object_name: str | None = None
) -> list[Recording]:
    """A recording from a serial port that sends lines, each a row of numbers.

    Args:
      columns: their names (`names`); None: from the first line, else e1, e2, ... of the
        design with as many. Rows without a time column get their time of arrival.

    Raises:
      ValueError: pyserial is not installed, the port cannot be opened, or no complete line arrived.
    """
    if not _is_here("serial"):
        raise ValueError("--serial needs pyserial: pip install 'biotac-mj[serial]'")
    import serial

    lines, times = [], []
    try:
        with serial.Serial(port, baud, timeout=0.2) as device:
            device.readline()  # the first line is usually incomplete
            end = clock.monotonic() + seconds
            while clock.monotonic() < end:
                line = device.readline()
                if line.endswith(b"\n"):
                    lines.append(line)
                    times.append(clock.time())
    except (serial.SerialException, OSError) as error:
        raise ValueError(
            f"{port} cannot be read ({error}): is it plugged in, and have you the right to it?"
        ) from None
    if not lines:
        raise ValueError(
            f"no line came from {port} in {seconds:g} s: is --baud {baud} right, is the sensor on?"
        )
    return join(streams_of_lines(port, lines, times, columns), object_name=object_name)


def streams_of_lines(
    port: str, lines: Iterable[bytes], times: Iterable[float], columns: list[str] | None
) -> list:
    """Streams from lines that arrived at these times [s]; see `record_serial`.

    Raises:
      ValueError: lines that are not rows of numbers, or differ in length.
    """
    source = pathlib.Path(pathlib.Path(port).name)
    table = parse_table(source, b"".join(lines))
    names = columns or table.names or list((design_of_channels(table.width) or BIOTAC).electrodes)
    if table.width != len(names):
        raise ValueError(
            f"{port} sends {table.width} numbers a line, {len(names)} were expected "
            f"({names[0]}..{names[-1]}): name them with --columns"
        )
    value = table.numbers(list(range(len(names))), names)
    skipped = len(list(lines)) - len(value)  # header
    found = {"time": list(times)[skipped:]} | dict(zip(names, value.T))
    return make_streams(source.name, found)
