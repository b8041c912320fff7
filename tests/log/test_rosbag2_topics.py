"""Which topics a table has, and that their messages hold it; whole bags are in test_rosbag2_file.py."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import LogError
from armlab.log import Column, Table
from armlab.log.file_formats.rosbag2 import BagTopic, columns_of, messages_of, topics_of, whole_poses

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
