"""Logs from other programs: streams of their topics, and tables read from whole files."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from armlab import log, robots
from armlab.errors import LogError, UnknownName
from armlab.log.column import Column
from armlab.log.mcap.decode import MessageReader, assembled, read_blocks
from armlab.log.topics.messages import TopicMessages
from armlab.log.topics.reader import WRENCH, Choice, is_foreign, read_topics, table_of_streams
from armlab.log.topics.streams import JOINTS, Stream, TopicFields, columns_of_fields, streams_of
from armlab.wire import cdr

UR = ("elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
STEP = 2_000_000  # ns


def ur_bag(ros: Any, count: int = 40) -> list[tuple[str, int, Any]]:
    """Return what `ros2 bag record -a` sees of a UR5e: joints at 500 Hz in its driver's order, the rest slower."""
    found: list[tuple[str, int, Any]] = []
    for i in range(count):
        ns = ros.start + i * STEP
        late = ns + 300_000  # recorded later than made
        if i == 2:
            found.append(("/tf_static", late, ros.transforms(ns, ("world", "base_link", [0, 0, 1]))))
        found.append(("/joint_states", late, ros.joints(ns, UR, i + np.arange(6))))
        if i % 2 == 0:
            found.append(("/ft/wrench", late, ros.wrench(ns, "tool0", [i, 1, 2, 3, 4, 5])))
        if i % 5 == 0:
            found.append(("/tf", late, ros.transforms(ns, ("base_link", "tool0", [i, 0, 0]))))
            found.append(("/commands", late, ros.numbers([i, -i])))
        if i % 20 == 0:
            text = ros.types["std_msgs/msg/String"](data="x" * i)
            found.append(("/robot_description", late, text))
    return found


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_of_a_ur5e(ros: Any, tmp_path: Path, storage: str) -> None:
    path = ros.bag(tmp_path / "bag", ur_bag(ros), storage)
    with pytest.raises(LogError) as caught:
        log.read(path)
    told = str(caught.value)
    assert "/joint_states 500 Hz, /ft/wrench 250 Hz, " in told
    assert "/tf_static (tf_static.world.base_link) 1 message" in told
    assert "clock='/joint_states', or read columns of one topic, columns=['q', 'qd', 'tau']" in told
    table = log.read(path, robot="ur5e", clock="joint_states")
    order = [UR.index(name) for name in robots.load("ur5e").joint_names]
    rows = np.arange(40)
    np.testing.assert_array_equal(table["q"], rows[:, None] + np.array(order))
    np.testing.assert_array_equal(table["tau"], 2 * table["q"])
    assert table.columns["qd"].labels == robots.load("ur5e").joint_names
    np.testing.assert_allclose(table.t, rows * 0.002, atol=1e-12)
    assert table.t0_ns == ros.start
    np.testing.assert_array_equal(table["wrench_raw"][:, 0], rows // 2 * 2)
    np.testing.assert_allclose(table["wrench_raw_age"], rows % 2 * 0.002, atol=1e-9)
    np.testing.assert_array_equal(table["tf.base_link.tool0"][:, 0, 3], rows // 5 * 5)
    assert table.columns["tf.base_link.tool0"].frame == "base_link"
    np.testing.assert_array_equal(table["tf_static.world.base_link"][:, 2, 3], np.ones(40))  # also before it was sent
    np.testing.assert_array_equal(table["commands"][:, 1], -(rows // 5 * 5))  # without stamps, less the delay of rows
    assert table.notes == (
        "skipped: /robot_description (std_msgs/msg/String)",
        "wrench_raw is /ft/wrench, in axes of tool0",
    )
    assert table.source[0].split()[:2] == [table.source[0].split()[0], "sha256"]
    assert len(list(table.states())) == 40


def test_columns_of_one_topic_need_no_clock(ros: Any, tmp_path: Path) -> None:
    path = ros.bag(tmp_path / "bag", ur_bag(ros))
    assert log.read(path, ["tau", "q"]).names == ("tau", "q")
    assert len(log.read(path, ["wrench_raw"])) == 20
    assert log.read(path, ["commands"]).t[1] == pytest.approx(0.01)
    aged = log.read(path, ["q", "wrench_raw", "wrench_raw_age"], clock="/joint_states")
    assert (aged.names, len(aged)) == (("q", "wrench_raw", "wrench_raw_age"), 40)
    slow = log.read(path, ["q"], clock="/tf")
    np.testing.assert_array_equal(slow["q"][:, 0], np.arange(0, 40, 5))
    with pytest.raises(UnknownName, match=r"'force'\. Known: commands, q, qd, tau, tf\.base_link\.tool0, .*wrench_raw"):
        log.read(path, ["force"])
    with pytest.raises(UnknownName, match=r"topic with numeric data in this file, got '/nix'\. Known: /commands"):
        log.read(path, clock="/nix")
    with pytest.raises(LogError, match=r"as clock= for .*, got /robot_description: std_msgs/msg/String\."):
        log.read(path, clock="/robot_description")


def test_joints_of_another_robot_are_listed_on_both_sides(ros: Any, tmp_path: Path) -> None:
    path = ros.bag(tmp_path / "bag", ur_bag(ros, 3))
    words = r"Only in the robot: panda_joint1, .*; only in the log: elbow_joint, .*_3_joint\."
    with pytest.raises(LogError, match=words):
        log.read(path, ["q"], robot="panda")
    with pytest.raises(UnknownName, match=r"library robot or the first part of a topic name in this file, got 'nix'"):
        log.read(path, robot="nix")
    only = ros.bag(tmp_path / "other", [("/x", ros.start, ros.numbers([1.0]))])
    with pytest.raises(LogError, match=r"a topic of type sensor_msgs/msg/JointState with the joints of ur5e .*got /x"):
        log.read(only, robot=robots.load("ur5e"))


def test_two_arms(ros: Any, tmp_path: Path) -> None:
    """Two robots of the same type, each in its own namespace; then a robot with a prefix in its joint names."""
    messages = []
    for i in range(4):
        ns = ros.start + i * STEP
        for side, sign in (("left", 1), ("right", -1)):
            messages.append((f"/{side}/joint_states", ns, ros.joints(ns, UR, sign * (i + np.arange(6)))))
            messages.append((f"/{side}/ft/wrench", ns, ros.wrench(ns, "tool0", [sign] * 6)))
    path = ros.bag(tmp_path / "bag", messages)
    with pytest.raises(LogError, match=r"Expected one arm in .*/left/joint_states \(elbow_joint.*/right/joint_states"):
        log.read(path)
    right = log.read(path, robot="right")
    assert right["q"][0, 1] == -1.0
    np.testing.assert_array_equal(right["wrench_raw"], -np.ones((4, 6)))
    left = log.read(path, clock="/left/joint_states")
    assert left["q"][0, 1] == 1.0
    np.testing.assert_array_equal(left["right.joint_states.q"], right["q"])
    np.testing.assert_array_equal(left["right.ft.wrench"], -np.ones((4, 6)))
    prefixed = [
        ("/joint_states", ros.start + i, ros.joints(ros.start + i, [f"b_{n}" for n in UR], range(6))) for i in (0, 9)
    ]
    table = log.read(ros.bag(tmp_path / "prefixed", prefixed), robot="ur5e")
    assert table.columns["q"].labels[0] == "b_shoulder_pan_joint"
    assert table["q"][0, 0] == 2.0


@pytest.mark.parametrize("kind", ["ros_joint_names", "joint_names"])
def test_topics_of_a_yumi(ros: Any, tmp_path: Path, kind: str) -> None:
    """`ros2 bag record` of the bridge's topics; in bags of both arms, names distinguish them."""
    arms = [robots.load(name) for name in ("yumi_left", "yumi_right")]
    messages = [
        (f"/{arm.name}/joint_states", ns, ros.joints(ns, reversed(getattr(arm, kind)), k + np.arange(7)[::-1]))
        for ns in (ros.start, ros.start + STEP)
        for k, arm in enumerate(arms)
    ]
    path = ros.bag(tmp_path / "bag", messages)
    for k, arm in enumerate(arms):
        table = log.read(path, ["q"], robot=arm.name)
        assert table.columns["q"].labels == getattr(arm, kind)
        np.testing.assert_array_equal(table["q"][0], k + np.arange(7))
    with pytest.raises(LogError, match="Only in the robot: "):
        log.read(path, ["q"], robot="ur5e")


def test_arm_and_gripper_on_one_topic(ros: Any, tmp_path: Path) -> None:
    """Two drivers publish on /joint_states: the arm is the one with more joints."""
    messages = []
    for i in range(6):
        ns = ros.start + i * STEP
        messages.append(("/joint_states", ns, ros.joints(ns, UR, i + np.arange(6))))
        if i % 2:
            messages.append(("/joint_states", ns + 5, ros.joints(ns + 5, ["finger"], [0.1 * i], efforts=False)))
    path = ros.bag(tmp_path / "bag", messages)
    table = log.read(path, clock="/joint_states")
    assert (len(table), table["q"].shape) == (6, (6, 6))
    assert table.columns["joint_states.q"].labels == ("finger",)
    np.testing.assert_allclose(table["joint_states.q"][2:, 0], [0.1, 0.1, 0.3, 0.3])
    assert "joint_states.tau" not in table
    assert len(log.read(path, ["q"])) == 6


def test_split_packed_and_unfinished_bags(ros: Any, tmp_path: Path) -> None:
    messages = ur_bag(ros)
    whole = log.read(ros.bag(tmp_path / "bag", messages), ["q"])
    for storage, mode in (("mcap", "file"), ("sqlite3", "file"), ("sqlite3", "message"), ("mcap", "message")):
        path = tmp_path / f"{storage}_{mode}"
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        bag = Writer(path, version=8, storage_plugin=plugin)
        bag.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
        with bag:
            connection = bag.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=ros.store)
            for topic, ns, message in messages:
                if topic == connection.topic:
                    bag.write(connection, ns, ros.raw(message))
        assert log.read(path, ["q"]).sha256 == whole.sha256, path
    killed = tmp_path / "run"
    killed.mkdir()  # ros2 bag record writes metadata.yaml at its end
    for number, part in enumerate((messages[:30], messages[30:])):
        made = ros.bag(tmp_path / f"part{number}", part)
        shutil.copy(made / f"part{number}.mcap", killed / f"run_{number}.mcap")
    assert log.read(killed, ["q"]).sha256 == whole.sha256
    data = (killed / "run_1.mcap").read_bytes()
    (killed / "run_1.mcap").write_bytes(data[:-300])
    with pytest.warns(UserWarning, match=r"run_1\.mcap was not finished: recovered"):
        torn = log.read(killed, ["q"])
    np.testing.assert_array_equal(torn["q"], whole["q"][: len(torn)])


@pytest.mark.parametrize("lost", [(), (1, 3)])
def test_a_bag_of_ros_1(ros: Any, tmp_path: Path, lost: tuple[int, ...]) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    path = tmp_path / "run.bag"
    with Ros1Writer(path) as bag:
        connection = bag.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        for i in range(5):
            ns = ros.start + i * STEP
            stamp = store.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
            header = store.types["std_msgs/msg/Header"](seq=i, stamp=stamp, frame_id="")
            numbers = i + np.arange(6.0)
            kind = store.types["sensor_msgs/msg/JointState"]
            message = kind(header=header, name=list(UR), position=numbers, velocity=numbers, effort=numbers)
            raw = bytes(store.serialize_ros1(message, kind.__msgtype__))
            bag.write(connection, ns, raw)
            if i in lost:
                bag.write(connection, ns + 1, raw[:-i])
    if lost:
        with pytest.warns(
            UserWarning, match=r"2 messages on /joint_states skipped: Expected a message of type sensor_msgs/msg/JointS"
        ):
            table = log.read(path, robot="ur5e")
    else:
        table = log.read(path, robot="ur5e")
    np.testing.assert_array_equal(table["q"][:, 0], 2 + np.arange(5))
    np.testing.assert_allclose(table.t, np.arange(5) * 0.002, atol=1e-12)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_damaged_messages_of_others_are_left_out_alone(ros: Any, tmp_path: Path, storage: str) -> None:
    messages = [(f"/n{i % 2}", ros.start + i, ros.numbers([i])) for i in range(12)]
    spoil = {4: lambda raw: b"", 6: lambda raw: raw[:-1], 7: lambda raw: b"\7" + raw}
    with pytest.MonkeyPatch.context() as patch:
        whole = ros.raw
        patch.setattr(ros, "raw", lambda one: spoil.get(int(one.data[0]), bytes)(whole(one)))
        path = ros.bag(tmp_path / "bag", messages, storage)
    with pytest.warns(UserWarning, match=r"2 messages on /n0 skipped: Expected .*; 1 message on /n1 skipped: Expected"):
        tables = log.read_topics(path)
    assert [note.partition(" skipped")[0] for note in tables["/n1"].notes] == ["2 messages on /n0", "1 message on /n1"]
    assert tables["/n0"]["n0"].ravel().tolist() == [0, 2, 8, 10]
    assert tables["/n1"]["n1"].ravel().tolist() == [1, 3, 5, 9, 11]


def test_topics_one_by_one(ros: Any, tmp_path: Path) -> None:
    path = ros.bag(tmp_path / "bag", ur_bag(ros))
    tables = read_topics(path, robot="ur5e")
    assert {name: len(table) for name, table in tables.items()} == {
        "/tf_static": 1, "/joint_states": 40, "/ft/wrench": 20, "/tf": 8, "/commands": 8,
    }  # fmt: skip
    assert tables["/tf"].notes[-1].startswith("skipped: /")
    assert tables["/joint_states"].columns["q"].labels == robots.load("ur5e").joint_names
    assert tables["/ft/wrench"].names == ("wrench_raw",)
    assert is_foreign(path)
    assert is_foreign(path / "bag.mcap")
    assert not is_foreign(tmp_path)
    assert tables["/commands"].source[0].startswith("bag sha256 ")
    with pytest.raises(LogError, match="Expected a log at"):
        read_topics(tmp_path / "none")


def bag_of_one(path: Path, text: str, raw: bytes) -> Path:
    """Write a ROS 1 bag with one message whose type may contain messages without fields."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(f"{text}\n{'=' * 80}\nMSG: lab_msgs/Nothing\n", "lab_msgs/msg/One"))
    with Ros1Writer(path) as bag:
        bag.write(bag.add_connection("/one", "lab_msgs/msg/One", typestore=store), 1, raw)
    return path


def test_messages_without_fields_in_a_bag_of_ros_1(tmp_path: Path) -> None:
    """Such messages take no byte in ROS 1 and one in ROS 2."""
    text = "Nothing a\nuint8 x\nbyte b\nbyte[2] c\nfloat64 y"
    path = bag_of_one(tmp_path / "run.bag", text, struct.pack("<B3bd", 7, -1, -2, 3, 2.5))
    table = read_topics(path)["/one"]
    assert {name: table[name].tolist() for name in table.names} == {
        "one.x": [7], "one.b": [-1], "one.c": [[-2, 3]], "one.y": [2.5],
    }  # fmt: skip
    path = bag_of_one(tmp_path / "endless.bag", "Nothing[] a", b"\xff\xff\xff\xff")  # as many as the message claims
    with pytest.warns(
        UserWarning, match=r"skipped: /one \(Expected at most 16 fields per byte in the elements of a of"
    ):
        assert read_topics(path) == {}


ROBOT = """\
std_msgs/Header header
sensor_msgs/JointState measured
geometry_msgs/WrenchStamped o_f_ext
geometry_msgs/PoseStamped[] poses
float64[7] gains
uint64 count
bool on
uint8[] picture
"""


def fields(ros: Any, topic: TopicFields, *raws: bytes) -> dict[str, np.ndarray]:
    reader = MessageReader(topic.type, topic.types, None, topic.named)
    blocks = ((np.array([row]), np.frombuffer(raw, np.uint8)[None]) for row, raw in enumerate(raws))
    return assembled(len(raws), read_blocks(len(raws), blocks, reader).pieces)


def test_a_state_of_one_message(ros: Any) -> None:
    """As the drivers of Franka arms send: everything in one message of their own type."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(ROBOT, "lab_msgs/msg/State"))
    topic = TopicFields("lab_msgs/msg/State", {name: entry[1] for name, entry in store.fielddefs.items()})
    raws = []
    for i in range(3):
        names = ["a", "b"] if i else ["b", "a"]  # another order is another layout
        joints = ros.joints(ros.start, names, [i, -i] if i else [-i, i])
        poses = [ros.pose(ros.start, "base", [i, 2, 3], (0, 0, 1, 0) if i else (0, 0, 0, 0))]
        parts = {"header": ros.header(ros.start, "link0"), "measured": joints, "poses": poses}
        parts |= {"o_f_ext": ros.wrench(ros.start, "tool", [i, 0, 0, 0, 0, 1]), "gains": np.full(7, float(i))}
        parts |= {"count": 2**64 - 1 if i == 2 else i, "on": i == 1, "picture": np.zeros(100, dtype=np.uint8)}
        message = store.types["lab_msgs/msg/State"](**parts)
        raws.append(bytes(store.serialize_cdr(message, "lab_msgs/msg/State")))
    values, columns, notes = columns_of_fields(topic, fields(ros, topic, *raws))
    assert list(values) == [
        "measured.q", "measured.qd", "measured.tau", "o_f_ext.wrench", "poses[0].pose", "gains", "count", "on",
    ]  # fmt: skip
    assert columns["measured.q"].labels == ("b", "a")
    np.testing.assert_array_equal(values["measured.q"], [[0, 0], [-1, 1], [-2, 2]])
    np.testing.assert_array_equal(values["o_f_ext.wrench"][:, 0], [0, 1, 2])
    assert (columns["o_f_ext.wrench"].frame, columns["o_f_ext.wrench"].unit) == ("tool", "N, N m")
    assert np.isnan(values["poses[0].pose"][0]).all()
    np.testing.assert_allclose(values["poses[0].pose"][1, :3], [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3]], atol=1e-15)
    assert notes == ["1 poses of poses[0].pose are missing: their quaternions do not have unit norm"]
    assert (columns["count"].kind, columns["on"].kind, columns["gains"].kind) == ("real", "flag", "real")


def test_states_without_a_joint_or_without_an_effort(ros: Any) -> None:
    topic = TopicFields(JOINTS, cdr.definitions(JOINTS, ros.store.generate_msgdef(JOINTS, ros_version=2)[0]))
    bare, named = ros.joints(1, (), [1.0, 2.0], efforts=False), ros.joints(1, ("a", "b"), [3.0, 4.0], efforts=False)
    messages = [ros.raw(one) for one in (ros.joints(1, (), []), bare, named)]
    assert columns_of_fields(topic, fields(ros, topic, messages[0])) == ({}, {}, [])
    values, _, notes = columns_of_fields(topic, fields(ros, topic, *messages[:2]))
    np.testing.assert_array_equal(values["q"], [[np.nan, np.nan], [1.0, 2.0]])
    assert notes == []
    values, _, notes = columns_of_fields(topic, fields(ros, topic, *messages))
    np.testing.assert_array_equal(values["q"], [[np.nan, np.nan], [np.nan, np.nan], [3.0, 4.0]])
    assert notes == [f"{name} of 1 messages are missing: the messages do not name the joints" for name in ("q", "qd")]


def streams(ros: Any, topic: str, messages: list[tuple[int, Any]]) -> list[Stream]:
    from armlab.log.topics.messages import _decoded

    kind = messages[0][1].__msgtype__
    into = TopicMessages()
    reader = into.reader(topic, kind, cdr.definitions(kind, ros.store.generate_msgdef(kind, ros_version=2)[0]))
    stamps = np.array([ns for ns, _ in messages])
    one, *_ = _decoded([ros.raw(message) for _, message in messages], stamps, bytes, reader)
    into.add(topic, one)
    ((_, fields, decoded),) = into.decoded()
    return streams_of(topic, fields, decoded)[0]


def test_names_order_and_stamps_of_a_topic(ros: Any) -> None:
    (one,) = streams(ros, "/a/pose", [(1, ros.pose(5, "base", [1, 2, 3]))])
    assert (list(one.values), one.columns["a.pose"].kind) == (["a.pose"], "pose")
    np.testing.assert_array_equal(one.stamp_ns, [5])
    vector = ros.types["geometry_msgs/msg/Vector3Stamped"]
    (two,) = streams(ros, "/v", [(1, vector(header=ros.header(0), vector=ros.vector("Vector3", 1, 2, 3)))])
    assert list(two.values) == ["v.vector.x", "v.vector.y", "v.vector.z"]
    assert two.stamp_ns is None  # never set
    (n,) = streams(ros, "/n", [(30, ros.numbers([3])), (10, ros.numbers([1])), (20, ros.numbers([2]))])
    assert (n.values["n"].tolist(), n.log_ns.tolist()) == ([1, 2, 3], [10, 20, 30])
    assert n.stamp_ns is None
    for start, stamped in ((ros.start, False), (0, True)):  # simulated time begins with 0; a wall clock in 1970
        messages = [(k, ros.joints(start * (k > 0) + k, ["a"], [1.0])) for k in range(3)]
        (one,) = streams(ros, "/joint_states", messages)
        assert (one.stamp_ns is not None) == stamped


def test_transforms_of_two_publishers(ros: Any) -> None:
    pairs = [("w", "b"), ("b", "base/link.1")], [("cam", "m")]
    messages = [(i, ros.transforms(i + 1, *((*pair, [i, 0, 0]) for pair in pairs[i % 2]))) for i in range(4)]
    body, camera = streams(ros, "/tf", messages)
    assert list(body.values) == ["tf.w.b", "tf.b.base/link.1"]
    np.testing.assert_array_equal(camera.stamp_ns, [2, 4])
    assert camera.values["tf.cam.m"][:, 0, 3].tolist() == [1, 3]


PATH = Path("run.mcap")
ROWS = np.arange(10)


def stream(
    topic: str, log_ns: np.ndarray, stamp_ns: np.ndarray | None = None, kind: str = "x", name: str = ""
) -> Stream:
    if kind == JOINTS:
        column = Column(unit="rad", labels=("a", "b"))
        values = {"q": np.stack([log_ns, log_ns], axis=1).astype(float)}
        return Stream(topic, kind, log_ns, stamp_ns, values, {"q": column})
    name = name or topic.strip("/")
    shape = (len(log_ns), 6) if kind == WRENCH else (len(log_ns),)
    column = Column(unit="N, N m" if kind == WRENCH else "1", frame="tool0")
    return Stream(topic, kind, log_ns, stamp_ns, {name: np.ones(shape) * len(topic)}, {name: column})


def test_a_header_of_another_clock_is_not_believed() -> None:
    log_ns = 10**18 + ROWS * 10**7
    arm = stream("/joint_states", log_ns, log_ns - 300, JOINTS)
    odd = stream("/cam", log_ns + 1000, ROWS * 10**7 + 5)
    plain = stream("/n", log_ns + 1000)
    table = table_of_streams(PATH, [odd, arm, plain], Choice(), ())
    assert (table.t0_ns, table.clock) == (10**18 - 300, "file")
    np.testing.assert_allclose(table["cam_age"][1:], 0.01 - 1e-6, atol=1e-8)
    np.testing.assert_allclose(table["n_age"][1:], 0.01 - 1e-6, atol=1e-8)
    by_log = table_of_streams(PATH, [arm, plain], Choice(clock="/n"), ())
    assert by_log.t0_ns == 10**18 + 1000  # a clock without headers: recording times are used
    np.testing.assert_allclose(by_log["q_age"], 1e-6, atol=1e-8)


def test_names_that_the_glossary_has_and_names_that_meet() -> None:
    ns = ROWS * 10**6
    streams = [stream("/tau", ns), stream("/t", ns), stream("/a/b", ns, name="a.b"), stream("/a.b", ns, name="a.b")]
    table = table_of_streams(PATH, streams, Choice(), ())
    assert table.names == ("topic.tau", "topic.t", "a.b", "a.b_2")
    two = [stream("/w1", ns, kind=WRENCH), stream("/w2", ns, kind=WRENCH)]
    assert table_of_streams(PATH, two, Choice(), ()).columns["w1"].frame == "tool0"
    one = table_of_streams(PATH, two[:1], Choice(), ())
    assert one.notes == ("wrench_raw is /w1, in axes of tool0",)
