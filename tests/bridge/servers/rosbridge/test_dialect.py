"""Golden messages of both dialects, and what is no type."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from armlab.bridge.servers.ros.topics import header, store
from armlab.bridge.servers.rosbridge.protocol import HEADER, TIME, Dialect, fields, flat, publish, read_type, type_name
from armlab.errors import CommandRefused

TYPES = store().types


def encoded(topic: str, message: Any, dialect: Dialect, seq: int) -> bytes:
    return publish(topic, flat(message, message.__msgtype__), dialect, seq)


def test_the_text_of_a_type_tells_the_dialect() -> None:
    assert read_type("sensor_msgs/JointState") == ("sensor_msgs/msg/JointState", "ros1")
    assert read_type("sensor_msgs/msg/JointState") == ("sensor_msgs/msg/JointState", "ros2")
    assert type_name("sensor_msgs/msg/JointState", "ros1") == "sensor_msgs/JointState"
    assert type_name("sensor_msgs/msg/JointState", "ros2") == "sensor_msgs/msg/JointState"


@pytest.mark.parametrize(
    "text", ["", "JointState", "a/b/c", "a/msg/", "/a", "a/srv/B", "a/" + "b" * 300, "1/A", "a/B\n"]
)
def test_what_is_no_type_is_refused(text: str) -> None:
    with pytest.raises(CommandRefused, match="such as sensor_msgs/JointState"):
        read_type(text)


def test_golden_joint_state_in_both_dialects() -> None:
    numbers = np.array([0.5, np.nan, np.inf])
    message = TYPES["sensor_msgs/msg/JointState"](
        header(5_000_000_250, "base"), ["a"], numbers, numbers[:0], numbers[:1]
    )
    assert encoded("/yumi/joint_states", message, "ros2", 7) == (
        b'{"op":"publish","topic":"/yumi/joint_states","msg":{"header":{"stamp":{"sec":5,"nanosec":250},'
        b'"frame_id":"base"},"name":["a"],"position":[0.5,null,null],"velocity":[],"effort":[0.5]}}'
    )
    assert encoded("/yumi/joint_states", message, "ros1", 7) == (
        b'{"op":"publish","topic":"/yumi/joint_states","msg":{"header":{"seq":7,"stamp":{"secs":5,"nsecs":250},'
        b'"frame_id":"base"},"name":["a"],"position":[0.5,null,null],"velocity":[],"effort":[0.5]}}'
    )


def test_messages_in_messages() -> None:
    pair = TYPES["diagnostic_msgs/msg/KeyValue"]("rate", "250")
    status = TYPES["diagnostic_msgs/msg/DiagnosticStatus"](
        level=1, name="n", message="m", hardware_id="h", values=[pair]
    )
    message = TYPES["diagnostic_msgs/msg/DiagnosticArray"](header(1), [status])
    found = json.loads(encoded("/d", message, "ros2", 1))["msg"]["status"]
    assert found == [
        {"level": 1, "name": "n", "message": "m", "hardware_id": "h", "values": [{"key": "rate", "value": "250"}]}
    ]


@pytest.mark.parametrize(("dialect", "names"), [("ros1", {"secs", "nsecs"}), ("ros2", {"sec", "nanosec"})])
def test_stamps_wherever_they_are(dialect: Dialect, names: set[str]) -> None:
    stamp = TYPES[TIME](1, 2)
    assert json.loads(encoded("/t", stamp, dialect, 1))["msg"].keys() == names
    assert json.loads(encoded("/t", TYPES[HEADER](stamp, "a"), dialect, 1))["msg"]["stamp"].keys() == names


def test_fields_are_those_of_the_definition() -> None:
    assert fields("std_msgs/msg/Float64MultiArray") == ("layout", "data")
    assert fields("std_msgs/msg/Empty") == ()


def test_text_that_looks_like_what_is_replaced_stays() -> None:
    words = '%b %% {"sec":1,"nanosec":2} {"stamp":{ \x00 \x01'
    message = TYPES["diagnostic_msgs/msg/KeyValue"]("key", words)
    assert json.loads(encoded("/k", message, "ros1", 1))["msg"] == {"key": "key", "value": words}


@pytest.mark.parametrize("dialect", ["ros1", "ros2"])
def test_messages_of_one_form_have_their_own_numbers(dialect: Dialect) -> None:
    """What is kept of a message for the next one is its text: none of its numbers, nor the topic or dialect."""
    kind = TYPES["abb_egm_msgs/msg/EGMChannelState"]
    for seq, active in enumerate([True, False, True], start=1):
        state = kind(
            name="a",
            active=active,
            egm_convergence_met=not active,
            egm_client_state=seq,
            motor_state=2,
            rapid_execution_state=3,
            utilization_rate=0.1 * seq,
        )
        message = TYPES["abb_egm_msgs/msg/EGMState"](header(10**9 * seq), [state])
        for topic in ("/a", "/b"):
            found = json.loads(encoded(topic, message, dialect, seq))
            assert found["topic"] == topic
            (channel,) = found["msg"]["egm_channels"]
            assert (channel["active"], channel["egm_convergence_met"]) == (active, not active)
            assert (channel["egm_client_state"], channel["utilization_rate"]) == (seq, 0.1 * seq)
            assert found["msg"]["header"]["stamp"].popitem() == ("nsecs" if dialect == "ros1" else "nanosec", 0)
            assert found["msg"]["header"].get("seq") == (seq if dialect == "ros1" else None)
