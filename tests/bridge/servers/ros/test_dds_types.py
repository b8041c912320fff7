"""Names and bytes on DDS: those of ROS 2, by two codecs that know nothing of each other."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.ros import Commands, Topics, store
from armlab.bridge.servers.row import RowSchema

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")

from armlab.bridge.servers.ros.dds import carrier, struct, topic_name
from armlab.bridge.servers.ros.types import type_name

ARM = robots.load("yumi_left")
PUBLISHED = {one.type for one in Topics({ARM.name: ARM}, RowSchema.of([ARM])).published.values()}
TAKEN = set(Commands("cell", {ARM.name: ARM}).types.values())
BYTES = bytes.fromhex(  # JointState of 1.000000002 s, frame "f", joints a and b, by hand
    "00010000 01000000 02000000 02000000 66000000 02000000 02000000 61000000 02000000 62000000 02000000"
    "0000000000000000 000000000000f03f 00000000 02000000 000000000000f03f 0000000000000040"
)


def message(name: str, seed: int = 0) -> Any:
    """A message of a type, all of it filled in: texts of every length, sequences of two."""
    count = iter(range(seed, 1000))

    def value(kind: Any, about: Any) -> Any:
        if kind.name == "NAME":
            return message(about, next(count))
        if kind.name == "SEQUENCE":
            found = [value(*about[0]) for _ in range(2)]
            return np.array(found) if isinstance(found[0], float) else found
        k = next(count)
        return {"string": "x" * (k % 9), "bool": k % 2 == 1, "float64": k + 0.25}.get(about[0], k % 200)

    return store().types[name](*(value(*about) for _, about in store().fielddefs[name][1]))


def plain(value: Any) -> Any:
    """The same message as a dataclass of cyclonedds."""
    if isinstance(value, list | np.ndarray):
        return [plain(one) for one in value]
    if is_dataclass(value):
        made = struct(value.__msgtype__)
        return made(*(plain(getattr(value, one.name)) for one in fields(made)))
    return value.item() if isinstance(value, np.generic) else value


def test_names() -> None:
    assert topic_name("/yumi_left/joint_states") == "rt/yumi_left/joint_states"
    assert type_name("sensor_msgs/msg/JointState") == "sensor_msgs::msg::dds_::JointState_"
    for name in PUBLISHED | TAKEN:
        assert carrier(name).__idl_typename__ == struct(name).__idl_typename__ == type_name(name)


def test_golden_bytes() -> None:
    types = store().types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 2), "f")
    joints = types["sensor_msgs/msg/JointState"](
        header, ["a", "b"], np.array([0.0, 1.0]), np.zeros(0), np.array([1.0, 2.0])
    )
    assert bytes(store().serialize_cdr(joints, "sensor_msgs/msg/JointState")) == BYTES
    assert plain(joints).serialize(use_version_2=False) == BYTES
    assert carrier("sensor_msgs/msg/JointState")(BYTES).serialize() == BYTES
    assert carrier("sensor_msgs/msg/JointState").deserialize(BYTES).cdr == BYTES


@pytest.mark.parametrize("name", sorted(PUBLISHED | TAKEN))
def test_both_codecs_agree(name: str) -> None:
    for seed in range(9):
        ours = message(name, seed)
        expected = bytes(store().serialize_cdr(ours, name))
        assert plain(ours).serialize(use_version_2=False) == expected
        again = struct(name).deserialize(expected)
        assert again.serialize(use_version_2=False) == expected
