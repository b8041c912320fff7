"""Names by joint and frame, wrenches and poses at any depth of a message."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.log.mcap.message_layouts import MessageReader, assembled, read_blocks, split
from armlab.log.topics.streams import JOINTS, TopicFields, columns_of_fields
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


def test_joints_without_names_or_with_too_few(ros: Any) -> None:
    types = cdr.definitions(JOINTS, ros.store.generate_msgdef(JOINTS, ros_version=2)[0])
    for names in ((), ("a",), ("a", "a")):
        topic = TopicFields(JOINTS, types)
        values, columns, _ = columns_of_fields(topic, fields(ros, topic, ros.raw(ros.joints(1, names, [1.0, 2.0]))))
        np.testing.assert_array_equal(values["q"], [[1.0, 2.0]])
        assert columns["tau"].labels == ()


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
