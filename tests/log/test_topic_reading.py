"""Logs of other programs, as they come from a lab: what is read, and the sentence where something is missing."""

from __future__ import annotations

import contextlib
import shutil
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from armlab import log, robots
from armlab.errors import LogError, UnknownName
from armlab.log.topics.reader import is_foreign, read_topics

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
    assert "clock='/joint_states', or read columns of one, columns=['q', 'qd', 'tau']" in told
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
    np.testing.assert_array_equal(table["tf_static.world.base_link"][:, 2, 3], np.ones(40))  # before it was told, too
    np.testing.assert_array_equal(table["commands"][:, 1], -(rows // 5 * 5))  # without stamps, less the delay of rows
    assert table.notes == (
        "left out: /robot_description (std_msgs/msg/String)",
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
    with pytest.raises(UnknownName, match=r"topic with numbers in this file, got '/nix'\. Known: /commands"):
        log.read(path, clock="/nix")
    with pytest.raises(LogError, match=r"as clock= for .*, got /robot_description: std_msgs/msg/String\."):
        log.read(path, clock="/robot_description")


def test_joints_of_another_robot_are_listed_on_both_sides(ros: Any, tmp_path: Path) -> None:
    path = ros.bag(tmp_path / "bag", ur_bag(ros, 3))
    with pytest.raises(
        LogError, match=r"Only in the robot: panda_joint1, .*; only in the log: elbow_joint, .*_3_joint\."
    ):
        log.read(path, ["q"], robot="panda")
    with pytest.raises(UnknownName, match=r"robot of the library, or first part of topics in this file, got 'nix'"):
        log.read(path, robot="nix")
    only = ros.bag(tmp_path / "other", [("/x", ros.start, ros.numbers([1.0]))])
    with pytest.raises(
        LogError, match=r"a topic of type sensor_msgs/msg/JointState with the joints of ur5e .*got /x 1"
    ):
        log.read(only, robot=robots.load("ur5e"))


def test_two_arms(ros: Any, tmp_path: Path) -> None:
    """Two robots of one type, in a namespace each, and with a prefix in the names of the joints."""
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
    """`ros2 bag record` of the bridge's topics; bags of both arms are told apart by the names."""
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
    """Messages that are cut off are left out alone."""
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
        with pytest.warns(UserWarning, match=r"2 messages on /joint_states skipped: Expected a sensor_msgs/msg/JointS"):
            table = log.read(path, robot="ur5e")
    else:
        table = log.read(path, robot="ur5e")
    np.testing.assert_array_equal(table["q"][:, 0], 2 + np.arange(5))
    np.testing.assert_allclose(table.t, np.arange(5) * 0.002, atol=1e-12)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_damaged_bags_of_others(ros: Any, tmp_path: Path, storage: str, read_spoilt: Callable[..., None]) -> None:
    path = ros.bag(tmp_path / "bag", [one for one in ur_bag(ros, 8) if one[0] in ("/joint_states", "/tf")], storage)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for file in path.iterdir():
            read_spoilt(path, file, 6)
            with contextlib.suppress(LogError):
                log.read(file)


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
    assert tables["/tf"].notes[-1].startswith("left out: /")
    assert tables["/joint_states"].columns["q"].labels == robots.load("ur5e").joint_names
    assert tables["/ft/wrench"].names == ("wrench_raw",)
    assert is_foreign(path)
    assert is_foreign(path / "bag.mcap")
    assert not is_foreign(tmp_path)
    assert tables["/commands"].source[0].startswith("bag sha256 ")
    with pytest.raises(LogError, match="Expected a log at"):
        read_topics(tmp_path / "none")


def test_a_file_of_which_every_topic_is_left_out_says_so(ros: Any, tmp_path: Path) -> None:
    path = ros.bag(tmp_path / "bag", [("/words", ros.start, ros.store.types["std_msgs/msg/String"]("x"))])
    with pytest.warns(UserWarning, match=r"left out: /words \(std_msgs/msg/String\)"):
        assert read_topics(path) == {}


def bag_of_one(path: Path, text: str, raw: bytes) -> Path:
    """Write a ROS 1 bag with a message of a type that may hold messages without fields."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(f"{text}\n{'=' * 80}\nMSG: lab_msgs/Nothing\n", "lab_msgs/msg/One"))
    with Ros1Writer(path) as bag:
        bag.write(bag.add_connection("/one", "lab_msgs/msg/One", typestore=store), 1, raw)
    return path


def test_messages_without_fields_in_a_bag_of_ros_1(tmp_path: Path) -> None:
    """They have no byte in ROS 1 and one in ROS 2."""
    text = "Nothing a\nuint8 x\nbyte b\nbyte[2] c\nfloat64 y"
    path = bag_of_one(tmp_path / "run.bag", text, struct.pack("<B3bd", 7, -1, -2, 3, 2.5))
    table = read_topics(path)["/one"]
    assert {name: table[name].tolist() for name in table.names} == {
        "one.x": [7], "one.b": [-1], "one.c": [[-2, 3]], "one.y": [2.5],
    }  # fmt: skip


def test_a_bag_of_ros_1_whose_type_is_without_bound(tmp_path: Path) -> None:
    """Its reader would walk as many elements as a message of four bytes says."""
    path = bag_of_one(tmp_path / "run.bag", "Nothing[] a", b"\xff\xff\xff\xff")
    with pytest.warns(
        UserWarning, match=r"left out: /one \(Expected elements with a byte for each 16 fields in a of lab_msgs/"
    ):
        assert read_topics(path) == {}
