"""Topics of a recording and their messages."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from armlab.log import Column, Tick, messages
from armlab.log.messages import (
    CLOCK_KEY,
    CLOCK_NAME_KEY,
    COLUMN_KEY,
    T0_KEY,
    Pen,
    Topic,
    clock_metadata,
    column_topic,
    definition,
    event,
    parameter,
    topic_name,
    topics,
)
from armlab.log.rows import RowLayout
from armlab.robots import Robot
from armlab.state import State

TYPES = ("Tick", "Column", "WrenchEstimate", "Parameter")
PARAMETER = "armlab_msgs/msg/Parameter"


@pytest.fixture(scope="module")
def store():
    """A reader that knows nothing but the texts in the file."""
    store = get_typestore(Stores.EMPTY)
    types: dict = {}
    for name in (*(f"armlab_msgs/msg/{own}" for own in TYPES), "rcl_interfaces/msg/Log", "sensor_msgs/msg/JointState"):
        types |= get_types_from_msg(definition(name), name)
    store.register(types)
    return store


def test_every_column_has_one_place_and_says_how_to_rebuild_it(robot: Robot) -> None:
    layout = RowLayout(robot, {"fext": Column((6,), unit="N", frame="base")})
    found = topics(layout, robot.joint_names)
    held = [name for topic in found for name in topic.fields]
    assert sorted(held) == sorted(set(layout.slots) - {"stamp_ns"})
    assert [topic.clock for topic in found].count(True) == 1
    metadata = next(topic for topic in found if topic.name == "columns/fext").metadata(layout.slots)
    about = json.loads(metadata[COLUMN_KEY + "fext"])
    assert about["unit"] == "N"
    assert about["frame"] == "base"
    assert about["fields"] == ["values"]
    assert about["shape"] == [6]
    assert CLOCK_KEY in found[0].metadata(layout.slots)
    assert all(isinstance(value, str) for topic in found for value in topic.metadata(layout.slots).values())


def test_numbers_are_where_sentinels_say(robot: Robot, store) -> None:
    """Each number of the row is its own place: decoded, none may be anywhere else."""
    layout = RowLayout(robot)
    values = {}
    for number, (name, slot) in enumerate(layout.slots.items()):
        if slot.dtype == "<f8":
            values[name] = (1000.0 * number + np.arange(slot.size)).reshape(slot.column.shape)
        else:
            values[name] = np.full(slot.column.shape, number + 1)
    row = layout.pack_values(values)
    for topic in topics(layout, robot.joint_names):
        if topic.name in ("tcp_pose", "wrench"):
            continue  # standard types, tested with rosbags' own store in test_recorder
        message = Pen(topic, layout.slots).message(row, 3_000_000_007)
        assert message is not None
        decoded = store.deserialize_cdr(bytes(message), topic.type)
        assert (decoded.header.stamp.sec, decoded.header.stamp.nanosec) == (3, 7)
        for name, (field,) in topic.fields.items():
            assert np.array_equal(np.ravel(getattr(decoded, field)), np.ravel(values[name])), name


def test_absent_sequences_are_empty_and_absent_messages_none(robot: Robot, rows: Callable, store) -> None:
    layout = RowLayout(robot)
    by_name = {topic.name: topic for topic in topics(layout, robot.joint_names)}
    x = np.ones(7)
    row = layout.pack(State(0.0, 0.004, x, x, np.full(7, np.nan)), None, Tick(1, -1, 5, 0, -1, 0))
    message = Pen(by_name["joint_states"], layout.slots).message(row, 5)
    assert message is not None
    decoded = store.deserialize_cdr(bytes(message), "sensor_msgs/msg/JointState")
    assert decoded.effort.size == 0
    assert decoded.position.tolist() == x.tolist()
    for name in ("joint_states_ref", "joint_states_sent", "wrench", "tcp_pose", "wrench_hat", "columns/q_ext"):
        assert Pen(by_name[name], layout.slots).message(row, 5) is None
    tick = Pen(by_name["tick"], layout.slots).message(row, 5)
    assert tick is not None
    assert store.deserialize_cdr(bytes(tick), "armlab_msgs/msg/Tick").clamped.size == 0


def test_parameters(store) -> None:
    decoded = store.deserialize_cdr(parameter(2_000_000_001, 7, "gain", np.array([1.0, 2.0]), "local 1"), PARAMETER)
    assert (decoded.sequence, decoded.name, decoded.value, decoded.who) == (7, "gain", "[1.0, 2.0]", "local 1")
    assert (decoded.stamp.sec, decoded.stamp.nanosec) == (2, 1)


def test_events_and_names(store) -> None:
    decoded = store.deserialize_cdr(event(2_000_000_001, "hé"), "rcl_interfaces/msg/Log")
    assert (decoded.msg, decoded.stamp.sec, decoded.stamp.nanosec, decoded.level) == ("hé", 2, 1, 20)
    assert topic_name("my arm-2") == "my_arm_2"
    assert Topic("x", "y", {}).frame_id == ""


def test_a_blank_message_is_zeros_and_empty_texts() -> None:
    known = messages.store()
    message = messages.blank("sensor_msgs/msg/JointState")
    assert (message.name, len(message.position), message.header.frame_id) == ([], 0, "")
    assert messages.blank("geometry_msgs/msg/WrenchStamped").wrench.torque.z == 0
    raw = bytes(known.serialize_cdr(message, "sensor_msgs/msg/JointState"))
    assert known.deserialize_cdr(raw, "sensor_msgs/msg/JointState").header.stamp.sec == 0


def test_a_column_by_itself_and_the_clock_beside_t() -> None:
    assert (column_topic("a b").name, column_topic("t").fields) == ("columns/a_b", {"t": ("values",)})
    assert clock_metadata(5, "robot") == {T0_KEY: "5", CLOCK_NAME_KEY: "robot"}
