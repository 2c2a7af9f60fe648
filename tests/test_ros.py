"""Live topics of a running simulation, in stand-ins for ROS' libraries that are as strict as ROS: what is
published is what `write_bag` writes. No ROS is needed, and none was there."""

import array
import subprocess
import sys
import types

import mujoco
import numpy as np
import pytest
from test_hands import springs

import biotac_mj
from biotac_mj.neighbours.ros import Publisher
from biotac_mj.recordings import of_simulation, write_bag
from biotac_mj.recordings.formats.bags import DEFINITIONS, FORMS

ROS = ["rclpy", "rospy"]
RANGES = {"uint8": (0, 2**8), "uint16": (0, 2**16), "int32": (-(2**31), 2**31), "uint32": (0, 2**32)}
SCENE = """<mujoco><option timestep=".002"/><worldbody><site name="tip" quat="1 -1 0 0"/>
  <site name="other" pos="0 .2 0" quat="1 -1 0 0"/>
  <body name="ball" pos="-.01 0 .0125" euler="10 20 30"><freejoint/><geom size=".005" mass=".1"/></body>
  </worldbody></mujoco>"""
ENDED = []  # what is to be called at exit


class Time:
    """rospy's."""

    def __init__(self, secs=0, nsecs=0):
        assert type(secs) is int and type(nsecs) is int
        self.secs, self.nsecs = secs, nsecs


class Fake:
    """One of ROS' libraries with the packages of its messages, and what was published."""

    def __init__(self, patch, library, without=()):
        rosbags = pytest.importorskip("rosbags.typesys", reason="needs rosbags: pip install 'biotac-mj[ros]'")
        store = rosbags.Stores.ROS1_NOETIC if library == "rospy" else rosbags.Stores.ROS2_HUMBLE
        self.store, self.ros, self.patch = rosbags.get_typestore(store), 1 + (library == "rclpy"), patch
        for name, text in DEFINITIONS.items():
            self.store.register(rosbags.get_types_from_msg(text, name))
        self.kinds, self.sent, self.said = {}, [], []
        for other in ROS:
            patch.setitem(sys.modules, other, None)
        getattr(self, library)()
        packages = {}
        for name in self.store.fielddefs:
            package, _, kind = name.split("/")
            packages.setdefault(package, {})[kind] = self.kind(name)
        for package, kinds in packages.items():
            self.module(package), self.module(f"{package}.msg", **kinds)
        for package in without:
            patch.setitem(sys.modules, package, None), patch.delitem(sys.modules, f"{package}.msg")

    def module(self, name, **names):
        made = types.ModuleType(name)
        vars(made).update(names, __spec__=types.SimpleNamespace(), __path__=[])
        self.patch.setitem(sys.modules, name, made)

    def rclpy(self):
        running = []

        def create_node(name):
            assert running
            self.said.append(f"node {name}")
            return types.SimpleNamespace(
                create_publisher=self.advertise,
                destroy_publisher=lambda topic: self.said.append(f"end {topic.name}"),
                destroy_node=lambda: self.said.append("end node"),
            )

        start = lambda: running.append(1) or self.said.append("init")  # noqa: E731
        stop = lambda: running.clear() or self.said.append("shutdown")  # noqa: E731
        self.module("rclpy", ok=lambda: bool(running), init=start, shutdown=stop, create_node=create_node)

    def rospy(self):
        running = []
        self.module(
            "rospy",
            core=types.SimpleNamespace(is_initialized=lambda: bool(running)),
            init_node=lambda name, **settings: running.append(1) or self.said.append(f"node {name}"),
            signal_shutdown=lambda reason: self.said.append("shutdown"),
            Publisher=lambda topic, kind, queue_size: self.advertise(kind, topic, queue_size),
            Time=Time,
        )
        self.patch.setattr("atexit.register", lambda call, *words: ENDED.append((call, words)))

    def advertise(self, kind, name, queue):
        assert queue > 0

        def publish(message):
            assert type(message) is kind
            self.sent.append((name, message))

        end = lambda: self.said.append(f"end {name}")  # noqa: E731
        return types.SimpleNamespace(name=name, publish=publish, unregister=end)

    def kind(self, name):
        """Class of a message that takes what rclpy's would: Python's numbers in range, lists of the right
        length, messages of the right class, and no other field."""
        if name in self.kinds:
            return self.kinds[name]
        if self.ros == 1 and name == "builtin_interfaces/msg/Time":
            return Time
        fields = dict(self.store.fielddefs[name][1])

        def begin(message):
            for field, kind in fields.items():
                object.__setattr__(message, field, self.default(*kind))

        def put(message, field, value):
            if field not in fields:
                raise AttributeError(field)
            assert self.takes(value, *fields[field]), f"{field} = {value!r}"
            object.__setattr__(message, field, value)

        self.kinds[name] = type(name, (), {"__init__": begin, "__setattr__": put, "fields": fields})
        return self.kinds[name]

    def default(self, node, what):
        if node.name == "BASE":
            return "" if what[0] == "string" else 0
        return self.kind(what)() if node.name == "NAME" else []

    def takes(self, value, node, what):
        if node.name == "NAME":
            return type(value) is self.kind(what)
        if node.name == "BASE":
            if what[0] in RANGES:
                low, high = RANGES[what[0]]
                return type(value) is int and low <= value < high
            return type(value) is {"string": str, "float32": float, "float64": float}.get(what[0])
        kind, length = what
        fits = node.name == "SEQUENCE" or len(value) == length
        return type(value) in (list, array.array) and fits and all(self.takes(one, *kind) for one in value)


def leaves(value, path=""):
    """{path: number, text or list of numbers} of a message of rosbags or of Fake."""
    if hasattr(value, "nsecs"):
        return {f"{path}.sec": value.secs, f"{path}.nanosec": value.nsecs}
    if isinstance(value, np.ndarray):
        return {path: value.tolist()}
    if isinstance(value, list) and value and hasattr(value[0], "__dict__"):
        return {k: v for i, one in enumerate(value) for k, v in leaves(one, f"{path}.{i}").items()}
    fields = getattr(value, "fields", None) or getattr(value, "__dataclass_fields__", None)
    if fields is None:
        return {path: value}
    names = [name for name in fields if name != "__msgtype__"]
    return {k: v for name in names for k, v in leaves(getattr(value, name), f"{path}.{name}").items()}


@pytest.fixture(scope="module")
def pressed():
    """(model, finger, rows, their data): a ball on a fingertip with the base model's skin and electronics."""
    spec = mujoco.MjSpec.from_string(SCENE)
    finger = biotac_mj.attach(spec, site="tip", skin="coarse", tier="condensed")
    model = spec.compile()
    data = mujoco.MjData(model)
    steps = []
    for _ in range(30):
        mujoco.mj_step(model, data)
        kept = mujoco.MjData(model)
        kept.time, kept.sensordata[:] = data.time, data.sensordata
        kept.xpos[:], kept.xquat[:], kept.xmat[:] = data.xpos, data.xquat, data.xmat
        steps.append(kept)
    return model, finger, steps


def pose(data, core):
    """Of the ball in the BioTac frame."""
    turn = data.body(core).xmat.reshape(3, 3).T
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, (turn @ data.body("ball").xmat.reshape(3, 3)).ravel())
    return turn @ (data.body("ball").xpos - data.body(core).xpos), quat


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("library", ROS)
def test_what_is_published_is_what_a_bag_has(monkeypatch, tmp_path, pressed, library, form):
    fake = Fake(monkeypatch, library)
    model, finger, steps = pressed
    with Publisher(model, form=form, object="ball") as publisher:
        sent = [data for data in steps if publisher.publish(data)]
        topics = publisher.topics
    assert [round(data.time, 6) for data in sent] == [0.01, 0.02, 0.03, 0.04, 0.05, 0.06]

    reads = [finger.read(data) for data in sent]
    assert np.ptp([read["electrodes"] for read in reads], axis=0).max() > 5
    assert np.abs([read["contact_force"] for read in reads]).max() > 0.1
    where = [np.array(one) for one in zip(*(pose(data, finger.body) for data in sent))]
    recording = of_simulation([d.time for d in sent], reads, object_pos=where[0], object_quat=where[1])
    path = tmp_path / ("one.bag" if fake.ros == 1 else "one")
    assert write_bag(path, recording, fake.ros, form) == topics
    from rosbags.highlevel import AnyReader

    with AnyReader([path], default_typestore=fake.store) as bag:
        written = [(c.topic, bag.deserialize(raw, c.msgtype)) for c, _, raw in bag.messages()]
    assert len(written) == len(fake.sent) == 3 * len(sent)
    for topic in topics:
        pairs = [[leaves(m) for name, m in many if name == topic] for many in (written, fake.sent)]
        assert len(pairs[0]) == len(sent)
        for there, here in zip(*pairs):
            assert there.keys() == here.keys()
            for field, value in there.items():
                if topic == "/object/pose" and ".pose." in field:  # a quaternion by two ways
                    assert here[field] == pytest.approx(value, abs=1e-12), field
                else:
                    assert here[field] == value, (topic, field)


@pytest.mark.parametrize("form", FORMS)
def test_all_fingers_of_a_hand(monkeypatch, form):
    """One message with each one's numbers, and a wrench for each."""
    fake = Fake(monkeypatch, "rclpy")
    spec = mujoco.MjSpec.from_string(SCENE)
    sites = {"ff_": "tip", "1th_": "other"}
    fingers = {p: biotac_mj.attach(spec, site=s, prefix=p, **springs()) for p, s in sites.items()}
    model = spec.compile()
    data = mujoco.MjData(model)
    data.time, data.sensordata[:] = 0.01, np.arange(model.nsensordata)
    with Publisher(model, form=form) as publisher:
        assert publisher.publish(data)
    first = "/biotac_pub" if form == FORMS[0] else "/tactile_states"
    assert [name for name, _ in fake.sent] == [first, "/ff/wrench", "/biotac_1th/wrench"]
    reads = [handle.read(data) for handle in fingers.values()]
    message, *wrenches = [message for _, message in fake.sent]
    if form == FORMS[0]:
        assert [one.bt_position for one in message.bt_data] == [1, 2]
        found = [(one.electrode_data, one.pac_data, one.tac_data) for one in message.bt_data]
    else:
        values = {one.name: one.values for one in message.sensors}
        names = "electrodes", "pac", "tac"
        found = [
            (*(values[f"{p}_{n}"] for n in names[:2]), values[f"{p}_tac"][0]) for p in ("ff", "biotac_1th")
        ]
    for (electrodes, pac, tac), read, wrench, name in zip(found, reads, wrenches, ("ff", "biotac_1th")):
        assert electrodes == read["electrodes"].tolist() and pac == read["pac"].tolist()
        assert tac == read["tac"][0] and wrench.wrench.force.y == -read["contact_force"][1]
        assert wrench.header.frame_id == name
    with pytest.raises(ValueError, match="two BioTacs are called a in ROS"):
        Publisher(model, fingers=dict(zip(("a.", "a/"), fingers.values())))


@pytest.fixture
def still():
    """A model and data whose sensor reads counts, without steps."""
    spec = mujoco.MjSpec.from_string(SCENE)
    biotac_mj.attach(spec, site="tip", **springs())
    model = spec.compile()
    data = mujoco.MjData(model)
    data.sensordata[:] = 2000
    return model, data


@pytest.mark.parametrize("step,rate,expected", [(1e-3, 100, 200), (3e-3, 100, 200), (0.01, 100, 200),
                                                 (0.02, 100, 100), (5e-4, 50, 100)])  # fmt: skip
def test_rates_of_simulated_time(monkeypatch, still, step, rate, expected):
    fake = Fake(monkeypatch, "rclpy")
    model, data = still
    times = []
    with Publisher(model, rate=rate) as publisher:
        assert not publisher.publish(data)  # at 0
        for _ in range(round(2 / step)):
            data.time += step
            if publisher.publish(data):
                times.append(data.time)
        assert abs(len(times) - expected) <= (step == 3e-3)
        late = np.array(times) * rate % 1
        assert np.minimum(late, 1 - late).max() < step * rate + 1e-6
        if step != 3e-3:
            np.testing.assert_allclose(np.diff(times), 2 / expected, atol=1e-9)
        data.time = 0.0  # a reset
        assert not publisher.publish(data)
        data.time = 1 / rate
        assert publisher.publish(data) and not publisher.publish(data)
    assert len(fake.sent) == 2 * (len(times) + 1)


@pytest.mark.parametrize("library", ROS)
def test_the_clock_is_published_if_asked(monkeypatch, still, library):
    fake = Fake(monkeypatch, library)
    model, data = still
    with Publisher(model, clock=True) as publisher:
        for data.time in (0.004, 0.01):
            publisher.publish(data)
    stamps = [leaves(m)[".clock.nanosec"] for name, m in fake.sent if name == "/clock"]
    assert stamps == [4_000_000, 10_000_000] and len(fake.sent) == 4


def test_ros_2_ends_what_it_started(monkeypatch, still):
    fake = Fake(monkeypatch, "rclpy")
    model, data = still
    with pytest.raises(RuntimeError), Publisher(model) as publisher:
        raise RuntimeError
    publisher.close()  # once more
    assert fake.said == ["init", "node biotac", "end /biotac_pub", "end /wrench", "end node", "shutdown"]
    with pytest.raises(ValueError, match="this Publisher is closed"):
        publisher.publish(data)
    import rclpy

    rclpy.init()
    node = rclpy.create_node("mine")
    fake.said.clear()
    with Publisher(model, node=node):
        pass
    assert fake.said == ["end /biotac_pub", "end /wrench"]
    with Publisher(model):
        pass
    assert fake.said[2:] == ["node biotac", "end /biotac_pub", "end /wrench", "end node"]


def test_ros_1_has_one_node_until_the_process_ends(monkeypatch, still):
    ENDED.clear()
    fake = Fake(monkeypatch, "rospy")
    model, data = still
    for _ in range(2):
        with Publisher(model) as publisher:
            data.time += 0.01
            assert publisher.publish(data)
    assert fake.said == ["node biotac", *["end /biotac_pub", "end /wrench"] * 2] and len(fake.sent) == 4
    ((end, words),) = ENDED
    end(*words)
    assert fake.said[-1] == "shutdown"
    with pytest.raises(ValueError, match="node is rclpy's, and ROS 1 is here"):
        Publisher(model, node=object())


@pytest.mark.parametrize("library", ROS)
def test_packages_that_are_missing_or_others_are_said(monkeypatch, still, library):
    for form in FORMS:
        fake = Fake(monkeypatch, library, without=FORMS)
        with pytest.raises(
            ValueError, match=f"ROS has no {form}/.*build the package {form} in your"
        ) as error:
            Publisher(still[0], form=form)
        assert "\n" not in str(error.value) and not fake.said  # nothing was started
    fake = Fake(monkeypatch, library)
    del fake.kinds["biotac_sensors/msg/BioTacData"].fields["tdc_data"]
    with pytest.raises(
        ValueError, match="biotac_sensors/msg/BioTacData as ROS has it here takes no tdc_data"
    ):
        Publisher(still[0])
    assert not fake.said


def test_without_ros_one_line_says_so(monkeypatch, still):
    for name in ROS:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(
        ValueError, match="rclpy or rospy: source .*setup.bash first, or write a bag"
    ) as error:
        Publisher(still[0])
    assert "\n" not in str(error.value)


def test_a_library_of_another_python_is_said(monkeypatch, still, tmp_path):
    monkeypatch.delitem(sys.modules, "rclpy", raising=False)
    (tmp_path / "rclpy.py").write_text("raise ImportError('no module _rclpy')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="rclpy is here and cannot be imported .*_rclpy.: run the Python"):
        Publisher(still[0])


def test_what_cannot_be_is_said(monkeypatch, still):
    Fake(monkeypatch, "rclpy")
    model, data = still
    empty = mujoco.MjModel.from_xml_string("<mujoco/>")
    for wrong, settings, text in (
        (model, {"form": "x"}, "form is 'x' and rate 100.0: choose one of biotac_sensors, tactile_msgs"),
        (model, {"rate": 0}, "rate 0: choose"),
        (model, {"object": "cube"}, "the model has no body 'cube'"),
        (empty, {}, "no BioTac to publish"),
    ):
        with pytest.raises(ValueError, match=text):
            Publisher(wrong, **settings)
    with pytest.raises(TypeError, match="model is str"):
        Publisher("hand.xml")
    with Publisher(model) as publisher:
        with pytest.raises(TypeError, match="data is MjModel: pass the MjData"):
            publisher.publish(model)
        data.time, data.sensordata[:] = 0.01, np.nan
        with pytest.raises(ValueError, match="biotac's electrodes at 0.01 s is .*nan"):
            publisher.publish(data)
        other = mujoco.MjData(empty)
        other.time = 0.02
        with pytest.raises(ValueError, match="the data's model has no sensor"):
            publisher.publish(other)


def test_it_loads_without_ros():
    code = "import sys; sys.modules.update(rclpy=None, rospy=None, rosbags=None)\n"
    code += (
        "from biotac_mj import neighbours; print(neighbours.ros.Publisher.__name__, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "Publisher False\n"
