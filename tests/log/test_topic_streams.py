"""Streams of columns out of topics of other programs, and tables of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.log.column import Column
from armlab.log.mcap.decode import MessageReader, assembled, read_blocks, split
from armlab.log.topics.messages import TopicMessages
from armlab.log.topics.reader import WRENCH, Choice, table_of_streams
from armlab.log.topics.streams import JOINTS, Stream, TopicFields, columns_of_fields, streams_of
from armlab.wire import cdr

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
    return split(assembled(len(raws), read_blocks(len(raws), blocks, reader).pieces))


def test_a_state_of_one_message(ros: Any) -> None:
    """As the drivers of Franka arms send: everything in one message of their own type."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(ROBOT, "lab_msgs/msg/State"))
    topic = TopicFields("lab_msgs/msg/State", {name: entry[1] for name, entry in store.fielddefs.items()})
    raws = []
    for i in range(3):
        names = ["a", "b"] if i else ["b", "a"]  # another order is another layout
        joints = ros.joints(ros.start, names, [i, -i] if i else [-i, i])
        poses = [ros.pose(ros.start, "base", [i, 2, 3], (0, 0, 1, 0) if i else (0, 0, 0, 0))]
        message = store.types["lab_msgs/msg/State"](
            header=ros.header(ros.start, "link0"),
            measured=joints,
            o_f_ext=ros.wrench(ros.start, "tool", [i, 0, 0, 0, 0, 1]),
            poses=poses,
            gains=np.full(7, float(i)),
            count=2**64 - 1 if i == 2 else i,
            on=i == 1,
            picture=np.zeros(100, dtype=np.uint8),
        )
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
    assert notes == ["1 poses of poses[0].pose are missing: no quaternion of length 1"]
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
    assert notes == [
        "q of 1 messages are missing: they do not name their joints",
        "qd of 1 messages are missing: they do not name their joints",
    ]


@pytest.mark.parametrize("names", [("map", "base/link.1"), ("a[0]", "b")])
def test_transforms_by_frame(ros: Any, names: tuple[str, str]) -> None:
    kind = "tf2_msgs/msg/TFMessage"
    topic = TopicFields(kind, cdr.definitions(kind, ros.store.generate_msgdef(kind, ros_version=2)[0]))
    one = ros.transforms(1, ("x", "y", [1, 0, 0]), (*names, [2, 0, 0]))
    other = ros.transforms(1, (*names, [3, 0, 0]))
    values, _, _ = columns_of_fields(topic, fields(ros, topic, ros.raw(one), ros.raw(other)))
    if "[" in names[0]:
        return  # such frames are none in ROS; nothing is raised
    np.testing.assert_array_equal(values["transforms[map>base/link.1].transform"][:, 0, 3], [2, 3])
    np.testing.assert_array_equal(values["transforms[x>y].transform"][:, 0, 3], [1, np.nan])


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


def test_messages_are_put_in_the_order_of_recording(ros: Any) -> None:
    (one,) = streams(ros, "/n", [(30, ros.numbers([3])), (10, ros.numbers([1])), (20, ros.numbers([2]))])
    assert one.values["n"].tolist() == [1, 2, 3]
    assert one.log_ns.tolist() == [10, 20, 30]
    assert one.stamp_ns is None


def test_a_message_of_one_column_has_the_name_of_its_topic(ros: Any) -> None:
    (one,) = streams(ros, "/a/pose", [(1, ros.pose(5, "base", [1, 2, 3]))])
    assert list(one.values) == ["a.pose"]
    assert one.columns["a.pose"].kind == "pose"
    assert one.stamp_ns is not None
    assert one.stamp_ns.tolist() == [5]
    vector = ros.types["geometry_msgs/msg/Vector3Stamped"]
    (two,) = streams(ros, "/v", [(1, vector(header=ros.header(0), vector=ros.vector("Vector3", 1, 2, 3)))])
    assert list(two.values) == ["v.vector.x", "v.vector.y", "v.vector.z"]
    assert two.stamp_ns is None  # never set


def test_a_first_stamp_that_is_not_set_is_no_beginning(ros: Any) -> None:
    """Of simulated time 0 is the beginning; of a wall clock it would be 1970."""
    for start, stamped in ((ros.start, False), (0, True)):
        messages = [(k, ros.joints(start * (k > 0) + k, ["a"], [1.0])) for k in range(3)]
        (one,) = streams(ros, "/joint_states", messages)
        assert (one.stamp_ns is not None) == stamped


def test_joints_that_never_come_together_and_transforms_of_two_publishers(ros: Any) -> None:
    messages = [(i, ros.joints(i + 1, ["f"] if i % 2 else ["a", "b"], [i] if i % 2 else [i, i])) for i in range(4)]
    arm, finger = streams(ros, "/joint_states", messages)
    assert (arm.joints, finger.joints) == (("a", "b"), ("f",))
    assert arm.stamp_ns is not None
    assert arm.stamp_ns.tolist() == [1, 3]
    assert finger.values["q"].tolist() == [[1], [3]]
    turned = arm.ordered(["b", "a"])
    assert turned.columns["q"].labels == ("b", "a")
    pairs = [("w", "b"), ("b", "t")], [("cam", "m")]
    messages = [(i, ros.transforms(i + 1, *((*pair, [i, 0, 0]) for pair in pairs[i % 2]))) for i in range(4)]
    body, camera = streams(ros, "/tf", messages)
    assert list(body.values) == ["tf.w.b", "tf.b.t"]
    assert camera.stamp_ns is not None
    assert camera.stamp_ns.tolist() == [2, 4]
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
    """A camera with a clock of its own; simulated time beside recorded time."""
    log_ns = 10**18 + ROWS * 10**7
    arm = stream("/joint_states", log_ns, log_ns - 300, JOINTS)
    odd = stream("/cam", log_ns + 1000, ROWS * 10**7 + 5)
    plain = stream("/n", log_ns + 1000)
    table = table_of_streams(PATH, [odd, arm, plain], Choice(), ())
    assert (table.t0_ns, table.clock) == (10**18 - 300, "file")
    np.testing.assert_allclose(table["cam_age"][1:], 0.01 - 1e-6, atol=1e-8)
    np.testing.assert_allclose(table["n_age"][1:], 0.01 - 1e-6, atol=1e-8)
    by_log = table_of_streams(PATH, [arm, plain], Choice(clock="/n"), ())
    assert by_log.t0_ns == 10**18 + 1000  # a clock without headers: everything when it was recorded
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
