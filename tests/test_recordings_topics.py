"""Topics beside and between the sensors of a bag: whose force it is, which sensor, and what is no pose."""

import dataclasses
import types

import numpy as np
import pytest
from recorded import synthetic, write_bag

from biotac_mj.recordings import load
from biotac_mj.recordings.formats.joining import join
from biotac_mj.recordings.formats.messages import Topic

ONE, TWO = synthetic(60), synthetic(60, seed=1)


def message(**fields):
    """As rosbags' classes: fields of a dataclass."""
    return dataclasses.make_dataclass("Message", fields)(**fields)


def stamp(time):
    return message(stamp=message(sec=int(time), nanosec=int(time % 1 * 1e9)))


def hand(topic, sensors, there=lambda i, names: names):
    """A topic with these sensors, {serial number: Recording}; there: which come in which order."""
    out = Topic(topic)
    for i, time in enumerate(ONE.time):
        data = [
            message(
                bt_serial=name,
                bt_position=list(sensors).index(name),
                electrode_data=sensors[name].electrodes[i],
            )
            for name in there(i, list(sensors))
        ]
        out.add(message(header=stamp(time), bt_data=data), 0.0)
    return out.streams()


def wrench(topic, force):
    out = Topic(topic)
    for time, value in zip(ONE.time, force):
        out.add(message(header=stamp(time), force=message(**dict(zip("xyz", value)))), 0.0)
    return out.streams()


def test_a_sensor_keeps_its_number_whatever_the_order():
    first, second = join(
        hand(
            "hand",
            {"A": ONE, "B": TWO},
            lambda i, names: names[1:] if 20 <= i < 30 else names[:: 1 - 2 * (i > 40)],
        )
    )
    rows = np.r_[0:20, 30:60]
    assert (first.electrodes == ONE.electrodes[rows]).all()
    assert (second.electrodes == TWO.electrodes).all()


def test_fingers_without_a_sensor_are_left_out_and_named():
    """Their electrodes are zero. Where all fingers have sensors nothing is said."""
    none = types.SimpleNamespace(electrodes=0 * TWO.electrodes)
    (only,) = join(hand("hand", {"A": ONE, "B": none}))
    assert (only.electrodes == ONE.electrodes).all()
    assert [note for note in only.notes if "no sensor there" in note]
    for one in join(hand("hand", {"A": ONE, "B": TWO})):
        assert not [note for note in one.notes if "no sensor there" in note]


def test_each_finger_has_the_force_that_is_named_after_it():
    parts = hand("ff/biotac", {"": ONE}) + hand("th/biotac", {"": TWO})
    first, second = join(parts + wrench("ff/wrench", ONE.force) + wrench("th/wrench", -ONE.force))
    np.testing.assert_allclose(first.force, ONE.force, atol=1e-6)
    np.testing.assert_allclose(second.force, -ONE.force, atol=1e-6)


def test_serial_numbers_count_and_an_ambiguous_force_is_omitted():
    forces = wrench("ff/wrench", ONE.force) + wrench("th/wrench", -ONE.force)
    first, second = join(hand("hand", {"th": ONE, "ff": TWO}) + forces)
    np.testing.assert_allclose(first.force, -ONE.force, atol=1e-6)
    np.testing.assert_allclose(second.force, ONE.force, atol=1e-6)
    first, second = join(hand("hand", {"A": ONE, "B": TWO}) + forces)
    assert first.force is None and second.force is None
    assert any("left out force of th: no name says whose" in note for note in first.notes)


def test_joints_and_many_poses_are_no_pose_of_the_sensor():
    joints, poses, one = Topic("joint_states"), Topic("goals"), Topic("tip/pose")
    point, turn = message(x=1.0, y=2.0, z=3.0), message(x=0.0, y=0.0, z=0.0, w=1.0)
    pose = message(position=point, orientation=turn)
    joints.add(
        message(name=["a", "b", "c"], position=np.zeros(3), velocity=np.zeros(3), effort=np.zeros(3)), 1.0
    )
    poses.add(message(poses=[pose, pose]), 1.0)
    one.add(message(pose=pose), 1.0)
    assert len(joints) == 0 and len(poses) == 0
    assert set(one.streams()[0].fields) == {"sensor_pos", "sensor_quat"}


def test_a_topic_without_anything_whole_does_not_spoil_the_bag(tmp_path):
    """States of joints and controllers are in every robot's bag; they come in several lengths."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="needs rosbags: pip install 'biotac-mj[ros]'")
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from biotac_mj.recordings.formats.bags import DEFINITIONS

    types = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in (DEFINITIONS | {"my/msg/Arm": "float64[] position\n"}).items():
        types.register(get_types_from_msg(text, name))
    path = write_bag(tmp_path, ONE, "SQLITE3")
    with rosbag2.Writer(tmp_path / "arm", version=8) as writer:
        place = writer.add_connection("/arm", "my/msg/Arm", typestore=types)
        for k in (7, 2):
            row = types.types["my/msg/Arm"](np.zeros(k))
            writer.write(place, k, types.serialize_cdr(row, "my/msg/Arm"))
    with pytest.raises(ValueError, match=r"no topic of a BioTac: it has /arm"):
        load(tmp_path / "arm")
    assert len(load(path)[0]) == len(ONE)
