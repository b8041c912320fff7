"""What a topic becomes: streams with stamps of their own."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.log.column import Column
from armlab.log.mcap.decode import Decoded
from armlab.log.topics.messages import TopicMessages
from armlab.log.topics.streams import JOINTS, Stream, TopicFields, rate_text, stem, streams_of
from armlab.wire import cdr


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


def test_names_and_rates() -> None:
    assert stem("/ft/wrench") == "ft.wrench"
    ns = np.arange(5) * 10_000_000
    column = {"x": Column(unit="1")}
    fast = Stream("/x", "", ns, None, {"x": np.zeros(5)}, column)
    slow = Stream("/y", "", ns[:1], None, {"x": np.zeros(1)}, column)
    assert (fast.rate, slow.rate) == (100.0, 0.0)
    assert rate_text([slow, fast]) == "/x 100 Hz, /y 1 message"
    assert fast.rows(ns > 0).log_ns[0] == 10_000_000
    assert fast.joints == ()


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


def test_a_topic_without_numbers_is_none() -> None:
    fields = TopicFields(JOINTS, {})
    nothing = Decoded(np.zeros(1, np.uint32), np.zeros(1, np.int64), {})
    assert streams_of("/x", fields, nothing) == ([], [])
