"""What is the same in all dialects of ROS 2."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.bridge.servers.ros import store
from armlab.bridge.servers.ros.types import content, domain_number, type_name
from armlab.errors import CommandRefused, ConfigError

TAKEN = {"std_msgs/msg/Float64MultiArray", "std_msgs/msg/String", "std_msgs/msg/Empty"}


def test_names_of_types() -> None:
    assert type_name("sensor_msgs/msg/JointState") == "sensor_msgs::msg::dds_::JointState_"


def test_the_domain_is_that_of_the_cell_else_of_the_environment() -> None:
    assert domain_number(7, {"ROS_DOMAIN_ID": "9"}) == 7
    assert domain_number(0, {"ROS_DOMAIN_ID": "9"}) == 0
    assert domain_number(None, {"ROS_DOMAIN_ID": "9"}) == 9
    assert domain_number(None, {}) == domain_number(None, {"ROS_DOMAIN_ID": ""}) == 0
    for wrong in ("233", "-1", "one", "1.0"):
        with pytest.raises(ConfigError, match="from 0 to 232"):
            domain_number(None, {"ROS_DOMAIN_ID": wrong})


def test_what_a_command_says() -> None:
    types = store().types
    layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
    array = types["std_msgs/msg/Float64MultiArray"](layout, np.arange(3.0))
    raw = bytes(store().serialize_cdr(array, array.__msgtype__))
    assert content(array.__msgtype__, raw).tolist() == [0.0, 1.0, 2.0]
    text = types["std_msgs/msg/String"]('{"gain": 2.0}')
    assert content(text.__msgtype__, bytes(store().serialize_cdr(text, text.__msgtype__))) == '{"gain": 2.0}'
    assert content("std_msgs/msg/Empty", b"\0\1\0\0\0\0\0\0") is None


@given(name=st.sampled_from(sorted(TAKEN)), data=st.binary(max_size=80))
def test_bytes_that_are_no_message_are_refused(name: str, data: bytes) -> None:
    for raw in (data, b"\0\1\0\0" + data, b"\0\0\0\0" + data):
        with contextlib.suppress(CommandRefused):
            found = content(name, raw)
            assert found is None or isinstance(found, str | np.ndarray)


def test_a_message_too_large_is_refused() -> None:
    with pytest.raises(CommandRefused, match="at most 131072 bytes"):
        content("std_msgs/msg/String", b"\0" * (2**17 + 1))
