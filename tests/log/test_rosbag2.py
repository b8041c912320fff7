"""Tables in a rosbag2."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from armlab import log
from armlab.errors import LogError, UnknownName
from armlab.lie import se3
from armlab.log import Column, Table
from armlab.log.file_formats.rosbag2 import (
    STORAGES,
    BagTopic,
    columns_of,
    is_ours,
    messages_of,
    read_rosbag2,
    topics_of,
    whole_poses,
    write_rosbag2,
)

START = 1_700_000_000_000_000_000


@pytest.fixture
def table() -> Table:
    rng = np.random.default_rng(3)
    values = {"q": rng.normal(size=(5, 2)), "tau": rng.normal(size=(5, 2)), "wrench": rng.normal(size=(5, 6))}
    values |= {"T_base_tool": se3.exp(rng.normal(size=(5, 6))), "seq": np.arange(5) + 2**60}
    values |= {"mode": np.array(["a", "", "grå", "d", "e"]), "late": np.arange(5) % 2 == 0}
    values |= {"J": rng.normal(size=(5, 2, 3)), "bits": np.arange(10).reshape(5, 2) % 2 == 1}
    columns = {"q": Column(labels=("elbow", "wrist")), "mode": Column(unit="1", kind="text"), "J": Column(unit="1")}
    columns["bits"] = Column(unit="1", kind="flag")
    return Table(1.0 + np.arange(5) * 0.004, values, columns, t0_ns=START, clock="robot", source=("here",))


@pytest.mark.parametrize("storage", STORAGES)
def test_what_another_program_reads(table: Table, tmp_path: Path, storage: str) -> None:
    path = log.write(table, tmp_path / "run.rosbag2", storage=storage)
    ending = {"mcap": "mcap", "sqlite3": "db3"}[storage]
    assert sorted(entry.name for entry in path.iterdir()) == ["metadata.yaml", f"run.rosbag2.{ending}"]
    assert "version: 8" in (path / "metadata.yaml").read_text()
    types, found = {}, {}
    with AnyReader([path]) as bag:
        for connection, stamp, raw in bag.messages():
            types[connection.topic] = connection.msgtype
            found.setdefault(connection.topic, []).append((stamp, bag.deserialize(raw, connection.msgtype)))
    assert Counter(len(messages) for messages in found.values()) == {5: len(types)}
    assert types == {
        "/t": "std_msgs/msg/Float64",
        "/joint_states": "sensor_msgs/msg/JointState",
        "/wrench": "geometry_msgs/msg/WrenchStamped",
        "/T_base_tool": "geometry_msgs/msg/PoseStamped",
        "/seq": "std_msgs/msg/Int64",
        "/mode": "std_msgs/msg/String",
        "/late": "std_msgs/msg/Bool",
        "/J": "std_msgs/msg/Float64MultiArray",
        "/bits": "std_msgs/msg/UInt8MultiArray",
    }
    stamp, joints = found["/joint_states"][1]
    assert stamp == START + 1_004_000_000
    assert (joints.header.stamp.sec, joints.header.stamp.nanosec) == (START // 10**9 + 1, 4_000_000)
    assert joints.name == ["elbow", "wrist"]
    np.testing.assert_array_equal(joints.position, table["q"][1])
    np.testing.assert_array_equal(joints.effort, table["tau"][1])
    assert len(joints.velocity) == 0
    wrench = found["/wrench"][2][1]
    assert wrench.header.frame_id == "base"
    assert wrench.wrench.torque.z == table["wrench"][2, 5]
    pose = found["/T_base_tool"][3][1].pose
    assert pose.position.y == table["T_base_tool"][3, 1, 3]
    size = pose.orientation.w**2 + pose.orientation.x**2 + pose.orientation.y**2 + pose.orientation.z**2
    assert size == pytest.approx(1.0)
    array = found["/J"][4][1]
    assert [(dim.size, dim.stride) for dim in array.layout.dim] == [(2, 6), (3, 3)]
    np.testing.assert_array_equal(array.data, table["J"][4].ravel())
    assert [message.data for _, message in found["/mode"]] == table["mode"].tolist()
    assert found["/seq"][2][1].data == 2**60 + 2
    assert callable(write_rosbag2)


def test_stamps_that_meet_and_times_before_zero(tmp_path: Path) -> None:
    """The order of rows is that of stamps; the clock is exact in /t."""
    table = Table([-5.0, -5.0 + 1e-15 * 4, 0.1, 0.1 + 1e-12], {"k": [1.0, 2.0, 3.0, 4.0]}, {"k": Column(unit="1")})
    again = log.read(log.write(table, tmp_path / "run.rosbag2"))
    assert again.sha256 == table.sha256


def test_times_that_ros_cannot_hold(table: Table, tmp_path: Path) -> None:
    late = Table(table.t, {"q": table["q"]}, t0_ns=2**62)
    with pytest.raises(LogError, match="before the year 2038"):
        log.write(late, tmp_path / "run.rosbag2")
    with pytest.raises(LogError, match=r"times of at most 2\.15e\+09 s"):
        log.write(Table([0.0, 1e300], {"q": np.zeros((2, 1))}), tmp_path / "run.rosbag2")
    with pytest.raises(UnknownName, match="storage"):
        log.write(table, tmp_path / "run.rosbag2", storage="postgres")
    assert not list(tmp_path.iterdir())


def test_whose_a_bag_is(table: Table, tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(tmp_path / "other", version=8, storage_plugin=StoragePlugin.SQLITE3) as bag:
        bag.add_connection("/armlab/chatter", "std_msgs/msg/String", typestore=store)
    assert not is_ours(tmp_path / "other")
    assert not is_ours(tmp_path)
    assert is_ours(log.write(table, tmp_path / "run.rosbag2"))
    with pytest.raises(LogError, match=r"a rosbag2 that armlab has written .*/armlab/chatter \(std_msgs/msg/String\)"):
        read_rosbag2(tmp_path / "other")


@pytest.mark.parametrize("storage", STORAGES)
def test_damaged_bags(table: Table, tmp_path: Path, storage: str, read_spoilt: Callable[..., None]) -> None:
    path = log.write(table, tmp_path / "run.rosbag2", storage=storage)
    for file in path.iterdir():
        read_spoilt(path, file, 5)
    assert log.read(path).names == table.names
    for file in path.glob("run*"):
        again = log.read(file)  # a piece of it alone is read as any other program's
        np.testing.assert_array_equal(again["q"], table["q"])
        file.unlink()
    with pytest.raises(LogError, match="a whole rosbag2"):
        log.read(path)


T = np.arange(3.0)


def test_poses_that_a_quaternion_can_hold() -> None:
    whole = np.tile(np.eye(4), (3, 1, 1))
    holes, scaled, partly = whole.copy(), whole * [1.0, 1.0, 1.0 + 1e-9, 1.0], whole.copy()
    holes[1], partly[2, 0, 0] = np.nan, np.nan
    values = {"whole": whole, "holes": holes, "scaled": scaled, "partly": partly}
    table = Table(T, values, dict.fromkeys(values, Column(unit="1, m", kind="pose")))
    assert whole_poses(table) == ["whole", "holes"]


def test_topics_have_names_that_ros_allows_and_none_comes_twice() -> None:
    columns = {"a.b": Column((), "1"), "a_b": Column((), "1"), "t?": Column((2,), "1"), "joint_states": Column((), "1")}
    columns |= {"q": Column((2,), "rad"), "qd_sent": Column((2,), "rad/s"), "words": Column((2,), "1", kind="text")}
    topics = topics_of(columns, [])
    assert [(topic.name, *topic.fields) for topic in topics] == [
        ("/t", "t"),
        ("/joint_states", "q"),
        ("/joint_states_sent", "qd_sent"),
        ("/a_b", "a.b"),
        ("/a_b_2", "a_b"),
        ("/t_", "t?"),
        ("/joint_states_2", "joint_states"),
        ("/words", "words"),
    ]


def test_messages_hold_the_columns() -> None:
    table = Table(T, {"k": np.arange(6).reshape(3, 2)}, {"k": Column(unit="1", kind="count")})
    topic = topics_of(table.columns, [])[1]
    raws = list(messages_of(topic, table, np.arange(3) * 10**9))
    np.testing.assert_array_equal(columns_of(topic, table.columns, raws)["k"], table["k"])
    with pytest.raises(LogError, match="messages of one length on /k"):
        columns_of(topic, table.columns, [*raws, raws[0] + b"\0" * 8])
    other = BagTopic("/k", topic.type, topic.fields)
    with pytest.raises(LogError, match="Expected 3 numbers in each message of /k, got 2"):
        columns_of(other, {"k": Column((3,), "1", kind="count")}, raws)
