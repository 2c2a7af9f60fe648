"""Synthetic logs of a BioTac in the forms that people have: nobody measured them."""

import dataclasses
import gzip

import numpy as np
import scipy.io

from biotac_mj.recordings import Recording
from biotac_mj.sensor.channels import REST_COUNTS

ROWS = 420


def synthetic(n=ROWS, seed=0, rate=100.0, **changes):
    """A Recording with everything in it: a press that comes and goes, PAC with a line at 300 Hz."""
    rng = np.random.default_rng(seed)
    time = 5.0 + np.arange(n) / rate
    touch = np.clip(np.sin(np.arange(n) / 20), 0, 1)
    sample = np.arange(22 * n).reshape(n, 22) / 2200
    place = np.column_stack([0.001 * touch, 0 * touch, np.linspace(0, 0.01, n)])
    angle = np.linspace(0, 1, n)
    values = dict(
        electrodes=np.rint(
            REST_COUNTS["1"] - np.linspace(50, 300, 19) * touch[:, None] + rng.normal(0, 2, (n, 19))
        ),
        pdc=np.rint(1500 + 100 * touch),
        pac=np.rint(2047 + 40 * np.sin(2 * np.pi * 300 * sample) + rng.normal(0, 3, (n, 22))),
        tdc=np.rint(2000 + 10 * touch),
        tac=np.rint(2042 + 5 * touch),
        force=np.column_stack([0.1 * touch, 0 * touch, -2 * touch]) + rng.normal(0, 0.01, (n, 3)),
        torque=rng.normal(0, 1e-3, (n, 3)),
        object_pos=place,
        object_quat=np.column_stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle]),
        name="synthetic",
        object="ball",
        source="synthetic",
    )
    return Recording(time, **(values | changes))


def write_btd(path, one, batch=7, packed=False, sensors=1):
    """A native log: `sensors` of three on the bus."""
    order = [0, *range(17, 36), 1, 2, 3]
    lines = [
        "DataStructure: 2.0",
        "Serial Number: ,,SYNTHETIC01",
        "SampStructure: Pac,E1,Pac,E2",
        "Begin File",
    ]
    for k in range(len(one)):
        value = dict(zip(order[1:], [*one.electrodes[k], one.pdc[k], one.tac[k], one.tdc[k]]))
        samples = [s for pac, c in zip(one.pac[k], order[1:]) for s in ((0, pac), (c, value[c]))]
        for j, (c, v) in enumerate(samples):
            words = [f"{v:.0f} 0" if i < sensors else "0 1" for i in range(3)]
            lines.append(f"{one.time[k] + j / 4400:.6f} {k // batch} {k} {c} {' '.join(words)}")
    content = ("\n".join(lines) + "\n").encode()
    path.write_bytes(gzip.compress(content) if packed else content)


def write_csv(path, one, base=1, prefix="", time="time", rename=None):
    """Named columns in the order of nobody."""
    columns = {time: one.time}
    for name, width in (("pac", 22), ("e", 19)):
        value = one.pac if name == "pac" else one.electrodes
        columns |= {f"{prefix}{name}{i + base}": value[:, i] for i in range(width)}
    columns |= {f"{prefix}{name}": getattr(one, name) for name in ("pdc", "tac", "tdc")}
    for label, value in (("F", one.force), ("T", one.torque), ("object_pos_", one.object_pos)):
        columns |= {f"{label}{axis}": value[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"object_q{axis}": one.object_quat[:, i] for i, axis in enumerate("wxyz")}
    columns = {(rename or {}).get(name, name): value for name, value in columns.items()}
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, "%.9g", ",", header=",".join(columns), comments="")


def write_mat(path, one, **more):
    """As PHAC-2's: two sensors, time along the rows."""
    two = dataclasses.replace(one, electrodes=one.electrodes + 5)
    found = {}
    for sensor, r in (("F0", one), ("F1", two)):
        found[f"{sensor}Electrodes"] = r.electrodes.T.astype(np.uint16)
        found[f"{sensor}pac"] = r.pac.T.astype(np.uint16)
        found |= {
            f"{sensor}{name}": getattr(r, name)[None].astype(np.uint16) for name in ("pdc", "tac", "tdc")
        }
    scipy.io.savemat(path, found | {"JPos": np.zeros((1, len(one)))} | more)


def write_bag(folder, one, ros):
    """A bag of biotac_sensors/BioTacHand and a wrench (`ros` 1, or the storage of 2); its path."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from biotac_mj.recordings.formats.bags import DEFINITIONS

    types = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        types.register(get_types_from_msg(text, name))
    kind = types.types
    path = folder / ("synthetic.bag" if ros == 1 else f"synthetic_{ros}")
    writer = Writer1(path) if ros == 1 else Writer2(path, version=8, storage_plugin=StoragePlugin[ros])
    serialize = types.serialize_ros1 if ros == 1 else types.serialize_cdr
    hand, wrench = "biotac_sensors/msg/BioTacHand", "geometry_msgs/msg/WrenchStamped"
    with writer:
        topics = [
            writer.add_connection(t, k, typestore=types) for t, k in (("/biotac_pub", hand), ("/ft", wrench))
        ]
        zero = kind["builtin_interfaces/msg/Time"](0, 0)
        offsets = np.zeros(22, np.uint32), np.zeros(19, np.uint32)
        for i, t in enumerate(one.time):
            stamp = kind["builtin_interfaces/msg/Time"](int(t), round(t % 1 * 1e9))
            header = kind["std_msgs/msg/Header"](*([i] if ros == 1 else []), stamp, "")
            channels = [
                one.tdc[i],
                one.tac[i],
                one.pdc[i],
                one.pac[i].astype(np.uint16),
                one.electrodes[i].astype(np.uint16),
            ]
            data = [kind["biotac_sensors/msg/BioTacData"]("BT01", 1, *map(int, channels[:3]), *channels[3:])]
            times = kind["biotac_sensors/msg/BioTacTime"](zero, zero, 0, 0, 0, *offsets)
            received = int((t + 100) * 1e9)  # a logger late by much: the header counts
            writer.write(topics[0], received, serialize(kind[hand](header, "hand", data, times), hand))
            force, torque = (
                kind["geometry_msgs/msg/Vector3"](*map(float, v[i])) for v in (one.force, one.torque)
            )
            pull = kind["geometry_msgs/msg/Wrench"](force, torque)
            writer.write(topics[1], received, serialize(kind[wrench](header, pull), wrench))
    return path
